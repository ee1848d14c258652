//! `design.json` and the summary: the numbers of a design.

#![allow(missing_docs, reason = "the fields are the keys of design.json")]

use super::DesignInputs;
use crate::short;
use rowburst::design::count::ChangeCount;
use rowburst::design::sparsity::{SuccessMap, recoverable, usual_constant};
use rowburst::design::{Assessment, fits_full_well, shortcomings};
use serde::Serialize;

/// Everything that `design.json` says.
#[derive(Debug, Clone, Serialize)]
pub struct DesignSummary {
    pub version: &'static str,
    pub grain_px: f64,
    pub grain_fwhm_px: f64,
    /// Of the PSF that was given.
    pub measured_grain_px: Option<f64>,
    pub grain_sampled: bool,
    pub speckle_contrast: f64,
    pub image_na: f64,
    pub image_distance_mm: f64,
    pub diffuser_deg: f64,
    pub smallest_diffuser_deg: f64,
    pub envelope_fwhm_px: f64,
    /// Rows from the bottom of the field to the top of the sensor.
    pub reach_needed_px: usize,
    /// Light that the worst row gets over that of a row level with the source.
    pub reach: f64,
    pub reach_met: bool,
    pub light_lost_mean: f64,
    pub light_lost_worst: f64,
    pub frame_rate_hz: f64,
    pub frames: usize,
    pub camera_frame_rate_hz: f64,
    pub frame_rate_gain: f64,
    pub electrons_mean: f64,
    pub electrons_peak: f64,
    pub noise_electrons: f64,
    pub saturates: bool,
    pub snr_per_pixel: f64,
    pub spectral_bandwidth_nm: f64,
    pub diffraction_bandwidth_nm: f64,
    pub path_bandwidth_nm: f64,
    pub source_bandwidth_nm: f64,
    /// Part of the speckle's contrast that the source keeps.
    pub contrast_kept: f64,
    pub measurements_per_bin: f64,
    pub field_pixels: usize,
    pub bright_pixels: usize,
    pub recoverable_pixels_per_bin: f64,
    /// More than half of the bins came back at the most pixels tried.
    pub recoverable_is_lower_bound: bool,
    /// `C` of `m = C·k·ln(n/k)` at the expected SNR; null where nothing is recovered.
    pub sparsity_constant: Option<f64>,
    /// "trials", or "rule" where the trials were left out.
    pub sparsity_source: &'static str,
    pub success_map: Option<SuccessMapSummary>,
    /// Numbers of an instant that speak about the change of the given scene; null without one.
    pub informative_measurements: Option<f64>,
    pub measurements_of_instant: Option<usize>,
    pub seed: u64,
    pub seconds: f64,
    pub warnings: Vec<String>,
}

/// The success map as numbers.
#[derive(Debug, Clone, Serialize)]
pub struct SuccessMapSummary {
    pub rows: usize,
    pub columns: usize,
    pub measurements_per_bin: f64,
    pub field_pixels: usize,
    pub trials: usize,
    pub reconstructions: usize,
    pub largest_relative_error: f64,
    pub nonzero_pixels: Vec<usize>,
    pub snr: Vec<f64>,
    /// Part of the bins that came back right, `[snr][nonzero_pixels]`.
    pub success: Vec<Vec<f64>>,
    pub half_success_pixels: Vec<f64>,
    pub sparsity_constants: Vec<Option<f64>>,
}

impl SuccessMapSummary {
    fn new(map: &SuccessMap) -> Self {
        Self {
            rows: map.sensor.0,
            columns: map.sensor.1,
            measurements_per_bin: map.measurements_per_bin,
            field_pixels: map.field_pixels,
            trials: map.trials,
            reconstructions: map.reconstructions,
            largest_relative_error: map.params.tolerance,
            nonzero_pixels: map.params.ks.clone(),
            snr: map.params.snrs.clone(),
            success: map.rates.clone(),
            half_success_pixels: map.k50.clone(),
            sparsity_constants: map
                .params
                .snrs
                .iter()
                .map(|&s| map.constant_at(s))
                .collect(),
        }
    }
}

impl DesignSummary {
    pub(super) fn new(
        inputs: &DesignInputs,
        assessment: &Assessment,
        map: Option<&SuccessMap>,
        seconds: f64,
    ) -> Self {
        let snr = assessment.signal.snr;
        let constant = match map {
            Some(map) => map.constant_at(snr),
            None => Some(usual_constant(snr)),
        };
        let pixels = constant.map_or(0.0, |c| {
            recoverable(assessment.measurements_per_bin, c, assessment.field_pixels)
        });
        let aperture = inputs.optics.aperture;
        Self {
            version: env!("CARGO_PKG_VERSION"),
            grain_px: assessment.grains.grain_px,
            grain_fwhm_px: assessment.grains.fwhm_px(),
            measured_grain_px: assessment.measured_grain_px,
            grain_sampled: assessment.grains.is_sampled(),
            speckle_contrast: assessment.grains.contrast(),
            image_na: aperture.na(),
            image_distance_mm: aperture.image_distance_mm(),
            diffuser_deg: inputs.optics.diffuser_fwhm_deg,
            smallest_diffuser_deg: assessment.smallest_diffuser_deg,
            envelope_fwhm_px: assessment.envelope_fwhm_px,
            reach_needed_px: assessment.spread.needed_px,
            reach: assessment.spread.reach,
            reach_met: assessment.spread.reach >= rowburst::design::MIN_ROW_LIGHT,
            light_lost_mean: assessment.spread.lost_mean,
            light_lost_worst: assessment.spread.lost_worst,
            frame_rate_hz: assessment.frame_rate_hz,
            frames: assessment.frames,
            camera_frame_rate_hz: assessment.camera_frame_rate_hz,
            frame_rate_gain: assessment.frame_rate_hz / assessment.camera_frame_rate_hz,
            electrons_mean: assessment.signal.mean,
            electrons_peak: assessment.signal.peak,
            noise_electrons: assessment.signal.noise,
            saturates: !fits_full_well(&inputs.camera, &assessment.signal, &inputs.light),
            snr_per_pixel: snr,
            spectral_bandwidth_nm: assessment.bandwidth_nm,
            diffraction_bandwidth_nm: assessment.diffraction_bandwidth_nm,
            path_bandwidth_nm: assessment.path_bandwidth_nm,
            source_bandwidth_nm: inputs.light.source_bandwidth_nm,
            contrast_kept: assessment.contrast_kept,
            measurements_per_bin: assessment.measurements_per_bin,
            field_pixels: assessment.field_pixels,
            bright_pixels: inputs.light.bright_pixels,
            recoverable_pixels_per_bin: pixels,
            recoverable_is_lower_bound: map.is_some_and(|m| m.is_lower_bound_at(snr)),
            sparsity_constant: constant,
            sparsity_source: if map.is_some() { "trials" } else { "rule" },
            success_map: map.map(SuccessMapSummary::new),
            informative_measurements: None,
            measurements_of_instant: None,
            seed: inputs.seed,
            seconds,
            warnings: shortcomings(
                assessment,
                &inputs.camera,
                &inputs.optics,
                &inputs.light,
                pixels,
            ),
        }
    }

    /// The summary with the count of a scene.
    pub(super) fn with_change(mut self, change: Option<ChangeCount>) -> Self {
        self.informative_measurements = change.map(|c| c.informative);
        self.measurements_of_instant = change.map(|c| c.of);
        if let Some(count) = change.filter(ChangeCount::is_too_few) {
            self.warnings.push(format!(
                "the scene is too dense: {:.0} of {} numbers an instant speak about its change; a second camera may help",
                count.informative, count.of
            ));
        }
        self
    }

    pub fn json(&self) -> String {
        serde_json::to_string_pretty(self).expect("plain numbers and text")
    }

    /// The numbers in words, as (heading, [(quantity, value)]).
    #[expect(clippy::too_many_lines, reason = "one table of the numbers")]
    pub fn sections(&self) -> Vec<(String, Vec<(String, String)>)> {
        let line = |name: &str, value: String| (name.to_string(), value);
        let percent = |part: f64| format!("{:.1} %", 100.0 * part);
        let mut speckle = vec![
            line(
                "grain λ/(2NA)",
                format!(
                    "{:.2} px, {}",
                    self.grain_px,
                    if self.grain_sampled {
                        "sampled"
                    } else {
                        "undersampled"
                    }
                ),
            ),
            line(
                "width in the pixels",
                format!("{:.2} px at half maximum", self.grain_fwhm_px),
            ),
            line(
                "contrast in the pixels",
                format!("{:.2}", self.speckle_contrast),
            ),
        ];
        if let Some(grain) = self.measured_grain_px {
            speckle.push(line("width of the given PSF", format!("{grain:.2} px")));
        }
        let reach = vec![
            line(
                "diffuser",
                format!(
                    "{}°, an envelope of {:.0} px",
                    short_angle(self.diffuser_deg),
                    self.envelope_fwhm_px
                ),
            ),
            line(
                "smallest diffuser",
                format!("{:.2}°", self.smallest_diffuser_deg),
            ),
            line(
                "bottom of the field to top row",
                format!(
                    "{} rows, {} of the light: {}",
                    self.reach_needed_px,
                    percent(self.reach),
                    if self.reach_met {
                        "reached"
                    } else {
                        "not reached"
                    }
                ),
            ),
            line(
                "light outside the sensor",
                format!(
                    "{} on the mean, {} at worst",
                    percent(self.light_lost_mean),
                    percent(self.light_lost_worst)
                ),
            ),
        ];
        let time = vec![
            line("video", format!("{} frames", self.frames)),
            line("frame rate", format!("{:.0} fps", self.frame_rate_hz)),
            line(
                "gain",
                format!(
                    "{:.0} times the {:.0} fps of the camera",
                    self.frame_rate_gain, self.camera_frame_rate_hz
                ),
            ),
        ];
        let light = vec![
            line(
                "electrons in a pixel",
                format!(
                    "{:.0} on the mean, about {:.0} in the brightest",
                    self.electrons_mean, self.electrons_peak
                ),
            ),
            line(
                "noise",
                format!("{} electrons", short(self.noise_electrons)),
            ),
            line("SNR per pixel", format!("{:.1}", self.snr_per_pixel)),
        ];
        let colour = vec![
            line(
                "bandwidth of the speckle",
                format!(
                    "{:.1} nm (diffraction {:.1}, path {:.1})",
                    self.spectral_bandwidth_nm,
                    self.diffraction_bandwidth_nm,
                    self.path_bandwidth_nm
                ),
            ),
            line(
                "contrast kept",
                format!(
                    "{} with {} nm",
                    percent(self.contrast_kept),
                    self.source_bandwidth_nm
                ),
            ),
        ];
        vec![
            ("Speckle".into(), speckle),
            ("Reach".into(), reach),
            ("Time".into(), time),
            ("Light".into(), light),
            ("Colour".into(), colour),
            ("Sparsity".into(), self.sparsity()),
        ]
    }

    fn sparsity(&self) -> Vec<(String, String)> {
        let line = |name: &str, value: String| (name.to_string(), value);
        let source = match &self.success_map {
            Some(map) => format!(
                "{} trials of {} bins, {}×{} pixels",
                map.reconstructions, map.trials, map.rows, map.columns
            ),
            None => "rule of the paper's camera; the trials were left out".into(),
        };
        let mut lines = vec![
            line(
                "measurements of a bin",
                format!(
                    "{:.0} for {} field pixels",
                    self.measurements_per_bin, self.field_pixels
                ),
            ),
            line(
                "recoverable",
                format!(
                    "{} {:.0} scattered pixels a bin at SNR {:.0}",
                    if self.recoverable_is_lower_bound {
                        "at least"
                    } else {
                        "about"
                    },
                    self.recoverable_pixels_per_bin,
                    self.snr_per_pixel
                ),
            ),
            line(
                "C in m = C·k·ln(n/k)",
                self.sparsity_constant
                    .map_or("none: nothing is recovered".into(), |c| format!("{c:.2}")),
            ),
            line("found by", source),
        ];
        let count = self
            .informative_measurements
            .zip(self.measurements_of_instant);
        lines.extend(count.map(|(informative, of)| {
            let value = format!("{informative:.0} of {of} numbers of an instant");
            line("speak about the scene's change", value)
        }));
        lines
    }
}

fn short_angle(degrees: f64) -> String {
    let text = format!("{degrees:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_string()
}
