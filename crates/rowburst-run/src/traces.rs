//! Traces of a reconstruction: brightness over time of the brightest spots and of requested regions.
//!
//! Fields of the structs for `result.json` are the keys of the file; the README explains them.
#![allow(missing_docs, reason = "the fields are the keys of result.json")]

use crate::format::short;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::{Reconstruction, Verdict};
use rowburst::traces::{
    Alignment, Frequency, Photodiode, Refit, RefitInput, Region, Trace, brightest_regions,
    frequency_of,
};
use rowburst::{
    Camera, Error, Parameter, PatchSet, Result, RollingShutter, Shape, TimeGrid, Video, phrase,
};
use rowburst_io::{OutputFolder, read_photodiode, write_csv};
use rowburst_report::{AlignedSignal, AnnotatedTrace};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// Most spots that are found automatically; larger adds traces of fainter spots.
const MAX_AUTO_REGIONS: usize = 6;
/// Misfit of the refit over the noise, above which there is no refitted video; larger lets it follow
/// an error of the model.
const MAX_DEBIAS_MISFIT: f64 = 1.3;
/// Side in pixels of a region that is given by its middle alone; larger averages more pixels.
const DEFAULT_REGION_SIDE: usize = 3;

/// The requested regions, and photodiodes to compare with.
#[derive(Default)]
pub struct TraceRequest {
    regions: Vec<Region>,
    photodiodes: Vec<(String, Photodiode)>,
    /// Whether traces are those of the video alone, without standard errors, which take long.
    skips_errors: bool,
}

impl TraceRequest {
    /// The same traces without standard errors and refitted video.
    #[must_use]
    pub(crate) fn without_errors(self) -> Self {
        Self {
            skips_errors: true,
            ..self
        }
    }

    /// Parses the regions and reads the files of the photodiodes. A region is `Y,X` (its middle) or
    /// `Y,X,ROWS,COLUMNS`.
    ///
    /// # Errors
    /// A region that is not of this form or not in the field of `shape`, or a file that cannot be read.
    pub fn read(regions: &[String], photodiodes: &[PathBuf], shape: Shape) -> Result<Self> {
        let regions = regions.iter().map(|text| region(text, shape));
        let photodiodes = photodiodes.iter().map(|path| {
            let name = path.file_name().unwrap_or(path.as_os_str());
            Ok((name.to_string_lossy().into_owned(), read_photodiode(path)?))
        });
        Ok(Self {
            regions: regions.collect::<Result<_>>()?,
            photodiodes: photodiodes.collect::<Result<_>>()?,
            skips_errors: false,
        })
    }
}

/// Parses a region: its middle, or its first row and column with its size.
fn region(text: &str, shape: Shape) -> Result<Region> {
    let parts: Option<Vec<usize>> = text.split(',').map(|p| p.trim().parse().ok()).collect();
    let wrong = |rule: String| {
        let remedy = phrase![
            "Give the middle of a spot, as in ",
            (Parameter::Region, "40,52"),
            ", or first row, first column, rows and columns, as in ",
            (Parameter::Region, "36,48,9,9"),
            "."
        ];
        Error::input(Parameter::Region, format!("\"{text}\""), rule, remedy)
    };
    let field = format!(
        "rows are 0 to {}, columns 0 to {}",
        shape.rows - 1,
        shape.columns - 1
    );
    match parts.as_deref() {
        Some(&[y, x]) if y < shape.rows && x < shape.columns => {
            Ok(Region::centred_at(y, x, DEFAULT_REGION_SIDE, shape))
        }
        Some(&[_, _]) => Err(wrong(format!("the pixel lies in the field: {field}"))),
        Some(&[y, x, rows, columns]) => {
            let region = Region {
                y,
                x,
                rows,
                columns,
            };
            region.check(shape).map(|()| region).map_err(|_| {
                wrong(format!(
                    "the region has pixels and lies in the field: {field}"
                ))
            })
        }
        _ => Err(wrong("a region is two or four whole numbers from 0".into())),
    }
}

/// Traces with their frequencies, photodiodes and standard errors.
pub struct Traces {
    pub traces: Vec<Trace>,
    /// The number of traces, from the first on, whose regions were requested.
    pub requested: usize,
    /// The frequency of each trace, if there is one.
    pub frequencies: Vec<Option<Frequency>>,
    /// File name and signal of each photodiode, and its alignment with a trace.
    photodiodes: Vec<(String, Photodiode, Option<Alignment>)>,
    pub standard_errors: StandardErrorNumbers,
    /// The refitted video, where it was requested and could be computed.
    pub debiased: Option<rowburst::traces::DebiasedVideo>,
    /// Whether the refitted video was requested.
    pub debias_was_wanted: bool,
    /// Why there can be none.
    pub debias_failure: Option<String>,
    /// The number of bins of each trace that the frame does not observe. They have no standard error.
    unobserved_bins: Vec<usize>,
    /// The values of each trace before the refitted video took the place of the reconstruction; empty without debiasing.
    before_debias: Vec<Vec<f64>>,
}

/// The estimate of the standard errors, in `result.json`.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct StandardErrorNumbers {
    /// The reason why there are no standard errors.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub missing_because: Option<String>,
    /// Amplitude of the Gaussian prior: root mean square of the active voxels over the brightness of the video.
    pub prior_amplitude: Option<f64>,
    /// Correlation length of the Gaussian prior.
    pub prior_length_px: Option<f64>,
    /// `χ²` of the refit per degree of freedom.
    pub chi_squared: Option<f64>,
    /// Factor on all standard errors because of `chi_squared`; 1 unless the misfit is significant.
    pub inflation: Option<f64>,
    pub seconds: f64,
}

/// A trace in `result.json`.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct TraceNumbers {
    pub region: RegionNumbers,
    /// Largest value of the refit.
    pub peak: f64,
    pub mean_standard_error: Option<f64>,
    pub frequency_hz: Option<f64>,
    pub frequency_error_hz: Option<f64>,
    /// Amplitude of the sine of this frequency.
    pub amplitude: Option<f64>,
    pub amplitude_error: Option<f64>,
    /// Whether the frequency cannot be distinguished from half the frame rate.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frequency_is_half_rate: Option<bool>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub harmonics: Vec<HarmonicNumbers>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub photodiodes: Vec<PhotodiodeNumbers>,
    /// Largest correlation with a photodiode.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub photodiode_correlation: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<TruthNumbers>,
}

/// First pixel and size of a region.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RegionNumbers {
    pub y: usize,
    pub x: usize,
    pub rows: usize,
    pub columns: usize,
}

/// A harmonic of the fitted frequency, and the frequency at which it appears.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct HarmonicNumbers {
    pub order: usize,
    pub appears_at_hz: f64,
    pub amplitude: f64,
}

/// A photodiode that is aligned with the trace.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct PhotodiodeNumbers {
    pub file: String,
    pub correlation: f64,
    /// Shift that is added to its times.
    pub shift_us: f64,
    pub gain: f64,
    pub offset: f64,
}

/// Comparison of a trace with that of the truth.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct TruthNumbers {
    /// Root mean square error of the refitted trace.
    pub rms_error: f64,
    /// The same for the trace of the video.
    pub video_rms_error: f64,
    /// Slope of the refitted trace against that of the truth; 1 is the right amplitude.
    pub amplitude_ratio: f64,
    /// The same for the trace of the video.
    pub video_amplitude_ratio: f64,
    /// Number of active bins in which the 95 % interval contains the truth.
    pub covered_bins: usize,
    /// Number of bins in which the truth is active.
    #[serde(rename = "lit_bins")]
    pub active_bins: usize,
}

/// Computes the traces of a completed reconstruction; with `debias` also the refitted video.
pub fn find(
    request: TraceRequest,
    debias: bool,
    reconstruction: &Reconstruction,
    measurement: &Measurement,
    camera: &Camera,
    psfs: &PatchSet,
) -> Traces {
    let started = Instant::now();
    let video = &reconstruction.video;
    let time = camera.time();
    let mut regions = request.regions;
    let requested = regions.len();
    if time.bins() > 1 {
        for spot in brightest_regions(video, MAX_AUTO_REGIONS) {
            if !regions.contains(&spot) {
                regions.push(spot);
            }
        }
    }
    let operator = RollingShutter::new(camera, psfs);
    let input = RefitInput {
        operator: &operator,
        measured: measurement.image().data(),
        weights: reconstruction.weights.as_deref(),
        sigma: reconstruction.sigma,
        video,
    };
    let refit = if time.bins() == 1 {
        Err("the video has one bin".to_string())
    } else if request.skips_errors {
        Err("the run was stopped".to_string())
    } else {
        Refit::new(input).map_err(|error| error.to_string())
    };
    let (refit, missing_because) = match refit {
        Ok(refit) => (Some(refit), None),
        Err(reason) => (None, Some(reason)),
    };
    let debias_failure = missing_because.clone().or(refit
        .as_ref()
        .and_then(|refit| misfit_of_debiasing(refit, reconstruction.fit.verdict)));
    let mut traces: Vec<Trace> = match &refit {
        Some(refit) => refit.traces(&regions),
        None => {
            let without = |r: &Region| Trace::without_errors(*r, video);
            regions.iter().map(without).collect()
        }
    };
    let unobserved_bins = traces
        .iter_mut()
        .map(|trace| clear_unobserved_bins(trace, &reconstruction.coverage, video.shape()))
        .collect();
    let rate = time.frame_rate_hz();
    let frequency = |t: &Trace| frequency_of(&t.debiased, &t.standard_error, rate);
    let photodiodes = request.photodiodes.into_iter();
    let photodiodes = photodiodes.map(|(name, diode)| {
        let aligned = diode.align(&traces, time);
        (name, diode, aligned)
    });
    let photodiodes = photodiodes.collect();
    Traces {
        frequencies: traces.iter().map(frequency).collect(),
        requested,
        photodiodes,
        debiased: refit
            .as_ref()
            .filter(|_| debias && debias_failure.is_none())
            .map(Refit::video),
        debias_was_wanted: debias,
        debias_failure,
        unobserved_bins,
        before_debias: Vec::new(),
        standard_errors: StandardErrorNumbers {
            missing_because,
            prior_amplitude: refit.as_ref().map(Refit::amplitude),
            prior_length_px: refit.as_ref().map(Refit::length_px),
            chi_squared: refit.as_ref().map(Refit::chi_squared),
            inflation: refit.as_ref().map(Refit::inflation),
            seconds: started.elapsed().as_secs_f64(),
        },
        traces,
    }
}

/// Why `refit` is no video, where the model does not explain the frame: without the prior it would follow what is wrong
/// with the model.
fn misfit_of_debiasing(refit: &Refit, verdict: Verdict) -> Option<String> {
    let what = if refit.inflation() > MAX_DEBIAS_MISFIT {
        format!(
            "the model misses the frame by {:.1} times the noise",
            refit.inflation()
        )
    } else if verdict == Verdict::Bad {
        "the fit is bad".into()
    } else {
        return None;
    };
    Some(format!(
        "{what}, and without a prior the video would follow the error; check the PSF, or let the frame correct it by self-calibration"
    ))
}

/// Removes the estimate and its standard error from the bins in which the frame does not observe all of the trace's
/// region. Returns their number.
fn clear_unobserved_bins(trace: &mut Trace, coverage: &[u8], shape: Shape) -> usize {
    let mut count = 0;
    for (t, coverage) in coverage.chunks_exact(shape.pixels()).enumerate() {
        let mut pixels = trace.region.indices(shape.columns);
        if pixels.any(|i| coverage[i] == 0) {
            trace.debiased[t] = trace.value[t];
            trace.standard_error[t] = f64::NAN;
            count += 1;
        }
    }
    count
}

impl Traces {
    /// Warnings: bins that the frame does not observe, photodiodes that match no trace, and standard errors that were
    /// increased.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        for (trace, &count) in self.traces.iter().zip(&self.unobserved_bins) {
            if count > 0 {
                let region = trace.region;
                warnings.push(format!(
                    "the frame does not observe all of the region at row {}, column {} in {count} of {} bins: there its trace has no standard error",
                    region.y + region.rows / 2,
                    region.x + region.columns / 2,
                    trace.value.len()
                ));
            }
        }
        for (name, _, aligned) in &self.photodiodes {
            if aligned.is_none() {
                warnings.push(format!(
                    "{name} was not aligned with a trace: it covers less than half of the video, or one of the two is constant"
                ));
            }
        }
        if self.standard_errors.inflation.is_some_and(|by| by > 1.0) {
            warnings.push(format!(
                "standard errors of traces were inflated by {:.2}: the active voxels do not explain the frame to within σ",
                self.standard_errors.inflation.unwrap_or(1.0)
            ));
        }
        warnings
    }

    /// Takes the values of the traces from `video`, which has replaced that of the reconstruction.
    pub(crate) fn replace_values(&mut self, video: &Video) {
        self.before_debias = self
            .traces
            .iter_mut()
            .map(|trace| std::mem::replace(&mut trace.value, trace.region.mean_of(video)))
            .collect();
    }

    /// The traces for the report.
    pub fn annotated(&self) -> Vec<AnnotatedTrace> {
        let annotated = |i: usize| AnnotatedTrace {
            trace: self.traces[i].clone(),
            frequency: self.frequencies[i].clone(),
            is_requested: i < self.requested,
            photodiodes: self
                .over(i)
                .map(|(name, diode, a)| AlignedSignal {
                    name: name.clone(),
                    correlation: a.correlation,
                    points: diode
                        .points()
                        .map(|(t, v)| (t + a.shift_us, a.gain * v + a.offset))
                        .collect(),
                })
                .collect(),
        };
        (0..self.traces.len()).map(annotated).collect()
    }

    /// The photodiodes that are aligned with trace `i`.
    fn over(&self, i: usize) -> impl Iterator<Item = (&String, &Photodiode, &Alignment)> {
        let aligned = self.photodiodes.iter();
        let aligned = aligned.filter_map(|(name, diode, a)| Some((name, diode, a.as_ref()?)));
        aligned.filter(move |(_, _, a)| a.trace == i)
    }

    /// The traces for `result.json`.
    pub fn trace_numbers(&self, truth: Option<&Video>) -> Vec<TraceNumbers> {
        let numbers = |i: usize| {
            let trace = &self.traces[i];
            let frequency = self.frequencies[i].as_ref();
            let photodiodes: Vec<PhotodiodeNumbers> = self
                .over(i)
                .map(|(name, _, a)| PhotodiodeNumbers {
                    file: name.clone(),
                    correlation: a.correlation,
                    shift_us: a.shift_us,
                    gain: a.gain,
                    offset: a.offset,
                })
                .collect();
            let best = photodiodes.iter().map(|p| p.correlation).reduce(f64::max);
            let harmonics = frequency.iter().flat_map(|f| &f.harmonics);
            TraceNumbers {
                region: RegionNumbers {
                    y: trace.region.y,
                    x: trace.region.x,
                    rows: trace.region.rows,
                    columns: trace.region.columns,
                },
                peak: trace
                    .debiased
                    .iter()
                    .copied()
                    .fold(f64::NEG_INFINITY, f64::max),
                mean_standard_error: trace.mean_standard_error(),
                frequency_hz: frequency.map(|f| f.hertz),
                frequency_error_hz: frequency.map(|f| f.error_hz).filter(|e| e.is_finite()),
                amplitude: frequency.map(|f| f.amplitude),
                amplitude_error: frequency
                    .map(|f| f.amplitude_error)
                    .filter(|e| e.is_finite()),
                frequency_is_half_rate: frequency.map(|f| f.is_half_rate),
                harmonics: harmonics
                    .map(|h| HarmonicNumbers {
                        order: h.order,
                        appears_at_hz: h.hertz,
                        amplitude: h.amplitude,
                    })
                    .collect(),
                photodiode_correlation: best,
                photodiodes,
                truth: truth.map(|truth| against(trace, truth)),
            }
        };
        (0..self.traces.len()).map(numbers).collect()
    }

    /// Writes `traces.csv`: a line for each bin, which begins with the time of its middle in µs from the start of the
    /// first exposure.
    pub fn write(&self, folder: &OutputFolder, time: &TimeGrid) -> Result<()> {
        let mut heading = vec!["time_us".to_string()];
        for trace in &self.traces {
            let Region {
                y,
                x,
                rows,
                columns,
            } = trace.region;
            let place = format!("y{y}_x{x}_{rows}x{columns}");
            let columns = ["value", "debiased", "standard_error", "before_debias"];
            let count = columns.len() - usize::from(self.before_debias.is_empty());
            for what in &columns[..count] {
                heading.push(format!("{place}_{what}"));
            }
        }
        let row = |t: usize| -> Vec<f64> {
            let mut row = vec![time.middle_us(t)];
            for (i, trace) in self.traces.iter().enumerate() {
                row.extend([trace.value[t], trace.debiased[t], trace.standard_error[t]]);
                row.extend(self.before_debias.get(i).map(|before| before[t]));
            }
            row
        };
        folder.write("traces.csv", |w| {
            write_csv(w, &heading, (0..time.bins()).map(row))
        })
    }

    /// Lines for the command line: frequencies and photodiodes.
    pub fn summary_lines(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for (trace, frequency) in self.traces.iter().zip(&self.frequencies) {
            let Some(f) = frequency else { continue };
            let region = trace.region;
            lines.push(format!(
                "row {}, column {}: {:.0} ± {:.0} Hz{}, amplitude {} ± {}",
                region.y + region.rows / 2,
                region.x + region.columns / 2,
                f.hertz,
                f.error_hz,
                if f.is_half_rate {
                    " (half the frame rate)"
                } else {
                    ""
                },
                short(f.amplitude),
                short(f.amplitude_error),
            ));
        }
        for (name, _, aligned) in &self.photodiodes {
            if let Some(a) = aligned {
                let region = self.traces[a.trace].region;
                lines.push(format!(
                    "{name}: correlation {:.4} with row {}, column {}, shifted by {:.2} µs",
                    a.correlation,
                    region.y + region.rows / 2,
                    region.x + region.columns / 2,
                    a.shift_us,
                ));
            }
        }
        lines
    }
}

/// Compares a trace with that of the truth.
fn against(trace: &Trace, truth: &Video) -> TruthNumbers {
    let expected = trace.region.mean_of(truth);
    let rms = |values: &[f64]| {
        let squares = values.iter().zip(&expected).map(|(v, w)| (v - w).powi(2));
        (squares.sum::<f64>() / expected.len() as f64).sqrt()
    };
    let slope = |values: &[f64]| {
        let n = expected.len() as f64;
        let mean = |of: &[f64]| of.iter().sum::<f64>() / n;
        let (x, y) = (mean(&expected), mean(values));
        let pairs = || expected.iter().zip(values);
        let xy: f64 = pairs().map(|(w, v)| (w - x) * (v - y)).sum();
        let xx: f64 = expected.iter().map(|w| (w - x).powi(2)).sum();
        if xx > 0.0 { xy / xx } else { 1.0 }
    };
    let largest = expected.iter().copied().fold(0.0, f64::max);
    let active = |t: &usize| expected[*t] > 0.01 * largest && trace.standard_error[*t].is_finite();
    let active: Vec<usize> = (0..expected.len()).filter(active).collect();
    let covers = |t: &&usize| {
        (trace.debiased[**t] - expected[**t]).abs() <= 1.96 * trace.standard_error[**t]
    };
    TruthNumbers {
        rms_error: rms(&trace.debiased),
        video_rms_error: rms(&trace.value),
        amplitude_ratio: slope(&trace.debiased),
        video_amplitude_ratio: slope(&trace.value),
        covered_bins: active.iter().filter(covers).count(),
        active_bins: active.len(),
    }
}

/// The effect of debiasing, in `result.json`.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct DebiasNumbers {
    /// Sum of the refitted video over that of the reconstruction.
    pub light_ratio: f64,
    /// The same over voxels where the reconstruction is above half of its brightness.
    pub bright_light_ratio: f64,
    /// Number of bins with too many active voxels, which were left unchanged.
    pub untouched_bins: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db_before: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ssim_before: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_that_the_frame_does_not_observe_have_no_standard_error() {
        let shape = Shape::new(3, 4, 5);
        let mut trace = Trace {
            region: Region::centred_at(1, 1, 3, shape),
            value: vec![1.0, 2.0, 3.0],
            debiased: vec![1.5, 2.5, 3.5],
            standard_error: vec![0.1; 3],
        };
        let mut coverage = vec![1_u8; shape.voxels()];
        assert_eq!(clear_unobserved_bins(&mut trace, &coverage, shape), 0);
        // A pixel of the region in bin 1, and one outside of it in bin 2.
        coverage[shape.pixels() + 2 * shape.columns] = 0;
        coverage[2 * shape.pixels() + 4] = 0;
        assert_eq!(clear_unobserved_bins(&mut trace, &coverage, shape), 1);
        assert_eq!(trace.debiased, [1.5, 2.0, 3.5]);
        let is_known: Vec<bool> = trace.standard_error.iter().map(|e| e.is_finite()).collect();
        assert_eq!(is_known, [true, false, true]);
    }
}
