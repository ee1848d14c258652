//! A planned set-up as the command line and Python meet it: numbers, trials, page.

mod page;
mod summary;

pub use summary::{DesignSummary, SuccessMapSummary};

use crate::event::{Event, Observer};
use page::Page;
use rowburst::camera::CameraParams;
use rowburst::design::count::{ChangeCount, change_rms, count_change};
use rowburst::design::sparsity::{SparsityParams, SuccessMap, success_map, trial_camera};
use rowburst::design::{Assessment, LightParams, assess};
use rowburst::linop::LinearOperator;
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::vecmath::norm_squared;
use rowburst::{Camera, Error, Parameter, Psf, Result, RollingShutter, Sensor, Shutter, Video};
use rowburst_io::OutputFolder;
use std::path::PathBuf;
use std::time::Instant;

/// What is to be assessed.
pub struct DesignInputs {
    /// Camera and field.
    pub camera: Camera,
    /// Lens and diffuser.
    pub optics: SpeckleOptics,
    /// The light and what the sensor makes of it.
    pub light: LightParams,
    /// The file of the recorded PSF; `None` without one.
    pub psf_file: Option<PathBuf>,
    /// SNR of the trials, ascending; empty for the usual ones.
    pub trial_snrs: Vec<f64>,
    /// A video of the scene, which is fitted to the field.
    pub scene: Option<Video>,
    /// Seed of speckle, scenes and noise.
    pub seed: u64,
}

/// An assessed set-up.
pub struct Design {
    inputs: DesignInputs,
    assessment: Assessment,
    /// The trials, if there were some.
    map: Option<SuccessMap>,
    /// The recorded PSF.
    psf: Option<Psf>,
    /// The content of `design.json`.
    pub summary: DesignSummary,
}

impl Design {
    /// Writes the page, its pictures and `design.json`.
    ///
    /// # Errors
    /// Failed writes.
    pub fn write(&self, folder: &OutputFolder, reproduce: Option<&str>) -> Result<()> {
        let psf = self.psf.clone();
        let psf = psf.or_else(|| self.inputs.simulated_psf(&self.assessment));
        let page = Page {
            inputs: &self.inputs,
            assessment: &self.assessment,
            map: self.map.as_ref(),
            psf: psf.as_ref(),
            summary: &self.summary,
            reproduce,
        };
        page.write(folder)
    }
}

impl DesignInputs {
    /// Assesses the set-up with a recorded PSF if there is one; with `trials` by trial reconstructions as well, which
    /// `observer` may stop. `start` is the zero of the time that is reported.
    ///
    /// # Errors
    /// Those of [`assess`] and [`success_map`].
    pub fn run(
        self,
        psf: Option<Psf>,
        trials: bool,
        start: Instant,
        observer: Observer,
    ) -> Result<Design> {
        let assessment = self.assess(psf.as_ref())?;
        let change = match &self.scene {
            Some(scene) => self.count_change(scene, &assessment, psf.as_ref())?,
            None => None,
        };
        let map = if trials {
            Some(self.success_map(&assessment, psf.as_ref(), observer)?)
        } else {
            None
        };
        let seconds = start.elapsed().as_secs_f64();
        Ok(Design {
            summary: DesignSummary::new(&self, &assessment, map.as_ref(), seconds)
                .with_change(change),
            inputs: self,
            assessment,
            map,
            psf,
        })
    }

    /// How many numbers of an instant speak about the change of `scene`; the noise is that of the expected SNR. `None`
    /// where an instant reads too many pixels.
    fn count_change(
        &self,
        scene: &Video,
        assessment: &Assessment,
        psf: Option<&Psf>,
    ) -> Result<Option<ChangeCount>> {
        let psf = match psf {
            Some(psf) => psf.clone(),
            None => self.simulated(&self.camera, assessment.envelope_fwhm_px)?,
        };
        let video = scene::fit(scene, self.camera.video_shape())?;
        let operator = RollingShutter::new(&self.camera, &psf);
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(video.data(), &mut frame);
        let rms = (norm_squared(&frame) / frame.len() as f64).sqrt();
        let sigma = rms / assessment.signal.snr;
        Ok(count_change(&operator, sigma, change_rms(&video)))
    }

    /// The closed forms, with a recorded PSF if there is one.
    fn assess(&self, psf: Option<&Psf>) -> Result<Assessment> {
        assess(&self.camera, &self.optics, &self.light, psf)
    }

    /// A speckle PSF of all displacements that the camera needs; `None` where it cannot be simulated.
    fn simulated_psf(&self, assessment: &Assessment) -> Option<Psf> {
        self.simulated(&self.camera, assessment.envelope_fwhm_px)
            .ok()
    }

    /// Trial reconstructions, with the given PSF, or with speckle of the grain and, where the trial camera is smaller, an
    /// envelope in proportion.
    fn success_map(
        &self,
        assessment: &Assessment,
        psf: Option<&Psf>,
        observer: Observer,
    ) -> Result<SuccessMap> {
        let camera = trial_camera(&self.camera)?;
        let part = camera.rows() as f64 / self.camera.rows() as f64;
        let psf = match psf {
            Some(psf) => psf.clone(),
            None => self.simulated(&camera, part * assessment.envelope_fwhm_px)?,
        };
        let grain_px = assessment
            .measured_grain_px
            .unwrap_or_else(|| assessment.grains.fwhm_px());
        let mut params = SparsityParams::for_camera(&camera, grain_px, self.seed);
        if !self.trial_snrs.is_empty() {
            params.snrs = self.trial_snrs.clone();
        }
        success_map(&camera, &psf, &params, &mut |part| {
            let answer = observer(Event::Trials {
                camera: &camera,
                part,
            });
            answer.map_break(|_| ())
        })
    }

    /// A speckle PSF of all displacements that `camera` needs, its envelope `fwhm_px` wide.
    fn simulated(&self, camera: &Camera, fwhm_px: f64) -> Result<Psf> {
        let (field_rows, field_columns) = camera.field();
        let optics = self.optics.with_envelope(fwhm_px);
        speckle_psf(
            &optics,
            (camera.rows() + field_rows - 1) | 1,
            (camera.columns() + field_columns - 1) | 1,
            self.seed,
        )
    }
}

/// The usual light, with the noise of `camera`: each value as given, or else from the camera, or else the usual one.
pub fn light_of(
    camera: &Camera,
    read_noise_electrons: Option<f64>,
    full_well_electrons: Option<f64>,
) -> LightParams {
    let sensor = camera.sensor();
    let gain = sensor.gain_electrons_per_count;
    let of_counts = sensor.full_well_counts.zip(gain);
    let of_counts = of_counts.map(|(counts, gain)| counts * gain);
    let usual = LightParams::default();
    let well = full_well_electrons
        .or(of_counts)
        .or(usual.full_well_electrons);
    let bits = sensor.bit_depth.unwrap_or(16);
    LightParams {
        read_noise_electrons: read_noise_electrons
            .or(sensor.read_noise_electrons)
            .unwrap_or(usual.read_noise_electrons),
        electrons_per_count: gain.or(well.map(|well| well / f64::from(bits).exp2())),
        full_well_electrons: well,
        ..usual
    }
}

/// The SNRs of trials, ascending and each once.
///
/// # Errors
/// One that is no number above zero.
pub fn checked_snrs(given: &[f64]) -> Result<Vec<f64>> {
    let mut trial_snrs = given.to_vec();
    if let Some(bad) = trial_snrs.iter().find(|s| !(s.is_finite() && **s > 0.0)) {
        return Err(Error::input(
            Parameter::TrialSnr,
            bad,
            "a signal-to-noise ratio is a number above zero",
            "Leave it out for 8 to 256.",
        ));
    }
    trial_snrs.sort_by(f64::total_cmp);
    trial_snrs.dedup();
    Ok(trial_snrs)
}

/// The camera of the paper: the Zyla's middle 108 rows.
pub fn paper_camera() -> CameraParams {
    CameraParams {
        rows: 108,
        columns: 108,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    }
}
