//! Traces of a result: of the brightest spots and of the regions that were asked for.
//! Keys are those of the file; the README says what they mean.
#![allow(missing_docs)]

use crate::summary::short;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::Reconstruction;
use rowburst::traces::{
    Alignment, Frequency, Photodiode, Refit, RefitInput, Region, Trace, brightest_regions,
    frequency_of,
};
use rowburst::{Camera, Error, PatchSet, Result, RollingShutter, Shape, TimeGrid, Video};
use rowburst_io::{OutputFolder, read_photodiode, write_csv};
use rowburst_report::{AlignedSignal, AnnotatedTrace};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// Most spots that are found by themselves.
const MAX_AUTO_REGIONS: usize = 6;
/// Side of a region that is given by its middle alone.
const DEFAULT_REGION_SIDE: usize = 3;

/// What is asked for.
#[derive(Default)]
pub struct TraceRequest {
    /// `Y,X` or `Y,X,ROWS,COLUMNS` of each region.
    regions: Vec<Region>,
    photodiodes: Vec<(String, Photodiode)>,
}

impl TraceRequest {
    /// Reads regions and photodiodes, before the work begins.
    pub fn read(regions: &[String], photodiodes: &[PathBuf], shape: Shape) -> Result<Self> {
        let regions = regions.iter().map(|text| region(text, shape));
        let photodiodes = photodiodes.iter().map(|path| {
            let name = path.file_name().unwrap_or(path.as_os_str());
            Ok((name.to_string_lossy().into_owned(), read_photodiode(path)?))
        });
        Ok(Self {
            regions: regions.collect::<Result<_>>()?,
            photodiodes: photodiodes.collect::<Result<_>>()?,
        })
    }
}

/// A region as it is typed: its middle, or its first row and column with its size.
fn region(text: &str, shape: Shape) -> Result<Region> {
    let parts: Option<Vec<usize>> = text.split(',').map(|p| p.trim().parse().ok()).collect();
    let wrong = |rule: String| {
        let remedy = "Give the middle of a spot, as in --region 40,52, or first row, first column, rows and columns, as in --region 36,48,9,9.";
        Error::input("--region", format!("\"{text}\""), rule, remedy)
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

/// Traces with all that is known of them.
pub struct Traces {
    pub traces: Vec<Trace>,
    /// What repeats in each.
    pub frequencies: Vec<Option<Frequency>>,
    photodiodes: Vec<(String, Photodiode, Option<Alignment>)>,
    pub numbers: ErrorNumbers,
    /// The refitted video, where it was wanted and could be had.
    pub debiased: Option<rowburst::traces::DebiasedVideo>,
    /// Whether it was wanted.
    pub debias_was_wanted: bool,
}

/// How standard errors came about, in `result.json`.
#[derive(Debug, Clone, Serialize)]
pub struct ErrorNumbers {
    /// Why there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub missing_because: Option<String>,
    /// Rms of lit voxels over the brightness of the video, as the frame has it.
    pub prior_amplitude: Option<f64>,
    /// Distance over which light changes, as the frame has it.
    pub prior_length_px: Option<f64>,
    /// Misfit of the refit per degree of freedom.
    pub chi_squared: Option<f64>,
    /// What all errors were multiplied by because of it.
    pub inflation: Option<f64>,
    pub seconds: f64,
}

/// A trace in `result.json`.
#[derive(Debug, Clone, Serialize)]
pub struct TraceNumbers {
    pub region: RegionNumbers,
    /// Largest value of the refit.
    pub peak: f64,
    pub mean_standard_error: Option<f64>,
    pub frequency_hz: Option<f64>,
    pub frequency_error_hz: Option<f64>,
    /// Of the sine of this frequency.
    pub amplitude: Option<f64>,
    pub amplitude_error: Option<f64>,
    /// Whether the frequency cannot be told from half the frame rate.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frequency_is_half_rate: Option<bool>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub harmonics: Vec<HarmonicNumbers>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub photodiodes: Vec<PhotodiodeNumbers>,
    /// Of the best photodiode.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub photodiode_correlation: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<TruthNumbers>,
}

/// First pixel and size of a region.
#[derive(Debug, Clone, Serialize)]
pub struct RegionNumbers {
    pub y: usize,
    pub x: usize,
    pub rows: usize,
    pub columns: usize,
}

/// A harmonic that was fitted along, and where it appears.
#[derive(Debug, Clone, Serialize)]
pub struct HarmonicNumbers {
    pub order: usize,
    pub appears_at_hz: f64,
    pub amplitude: f64,
}

/// A photodiode over its trace.
#[derive(Debug, Clone, Serialize)]
pub struct PhotodiodeNumbers {
    pub file: String,
    pub correlation: f64,
    /// Added to its times.
    pub shift_us: f64,
    pub gain: f64,
    pub offset: f64,
}

/// How a trace compares with the truth's.
#[derive(Debug, Clone, Serialize)]
pub struct TruthNumbers {
    pub rms_error: f64,
    /// The same of the video's trace.
    pub video_rms_error: f64,
    /// Slope of the trace over the truth's: 1 is the right amplitude.
    pub amplitude_ratio: f64,
    pub video_amplitude_ratio: f64,
    /// Bins in which the 95 % interval holds the truth, of those with light.
    pub covered_bins: usize,
    pub lit_bins: usize,
}

/// Finds the traces of a finished reconstruction. `debias` asks for the refitted video, too.
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
    if time.bins() > 1 {
        for spot in brightest_regions(video, MAX_AUTO_REGIONS) {
            if !regions.contains(&spot) {
                regions.push(spot);
            }
        }
    }
    let operator = RollingShutter::new(camera, psfs);
    let refit = Refit::new(RefitInput {
        operator: &operator,
        measured: measurement.image().data(),
        weights: reconstruction.weights.as_deref(),
        sigma: reconstruction.sigma,
        video,
    });
    let missing_because = match (&refit, time.bins()) {
        (_, 1) => Some("the video has one bin".to_string()),
        (Err(error), _) => Some(error.to_string()),
        (Ok(_), _) => None,
    };
    let refit = refit.ok().filter(|_| missing_because.is_none());
    let traces = match &refit {
        Some(refit) => refit.traces(&regions),
        None => {
            let without = |r: &Region| Trace::without_errors(*r, video);
            regions.iter().map(without).collect()
        }
    };
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
        photodiodes,
        debiased: refit.as_ref().filter(|_| debias).map(Refit::video),
        debias_was_wanted: debias,
        numbers: ErrorNumbers {
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

impl Traces {
    /// Photodiodes that fit no trace, and regions without errors.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        for (name, _, aligned) in &self.photodiodes {
            if aligned.is_none() {
                warnings.push(format!(
                    "{name} was not laid over a trace: it covers less than half of the video, or nothing changes"
                ));
            }
        }
        if self.numbers.inflation.is_some_and(|by| by > 1.0) {
            warnings.push(format!(
                "standard errors of traces were multiplied by {:.2}: the lit voxels do not explain the frame to within σ",
                self.numbers.inflation.unwrap_or(1.0)
            ));
        }
        warnings
    }

    /// For the report.
    pub fn annotated(&self) -> Vec<AnnotatedTrace> {
        let annotated = |i: usize| AnnotatedTrace {
            trace: self.traces[i].clone(),
            frequency: self.frequencies[i].clone(),
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

    fn over(&self, i: usize) -> impl Iterator<Item = (&String, &Photodiode, &Alignment)> {
        let aligned = self.photodiodes.iter();
        let aligned = aligned.filter_map(|(name, diode, a)| Some((name, diode, a.as_ref()?)));
        aligned.filter(move |(_, _, a)| a.trace == i)
    }

    /// For `result.json`.
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

    /// Writes `traces.csv`: a line for each bin, with its middle.
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
            for what in ["value", "debiased", "standard_error"] {
                heading.push(format!("{place}_{what}"));
            }
        }
        let row = |t: usize| -> Vec<f64> {
            let mut row = vec![(t as f64 + 0.5) * time.bin_duration_us()];
            for trace in &self.traces {
                row.extend([trace.value[t], trace.debiased[t], trace.standard_error[t]]);
            }
            row
        };
        folder.write("traces.csv", |w| {
            write_csv(w, &heading, (0..time.bins()).map(row))
        })
    }

    /// Lines for a person.
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
        lit_bins: active.len(),
    }
}

/// What `--debias` did, in `result.json`.
#[derive(Debug, Clone, Serialize)]
pub struct DebiasNumbers {
    /// Light of the refit over light of the reconstruction.
    pub light_ratio: f64,
    /// The same where the reconstruction is above half of its brightness.
    pub bright_light_ratio: f64,
    /// Bins with too many lit voxels, which were left as they were.
    pub untouched_bins: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_db_before: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ssim_before: Option<f64>,
}
