//! The guide of a task: pictures of a second camera, and what they gave.

use crate::format::short;
use crate::inputs::read_capture;
use crate::options::parse_guide_model;
use rowburst::guide::{Guide, GuideExposure, GuideFit, GuideModel, KnownPlaces, fit};
use rowburst::reconstruct::Problem;
use rowburst::{Camera, Cancel, Image, Result, TimeGrid};
use rowburst_io::{Experiment, GuideFile, OutputFolder, write_csv, write_npy_i64, write_png16};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Pictures of the scene by a second camera, with the model of the video.
#[derive(Debug, Clone)]
pub struct GuideTask {
    /// The pictures.
    pub guides: Vec<Guide>,
    /// The model.
    pub model: GuideModel,
}

impl GuideTask {
    /// Reads the pictures `files`, taken at unknown times, or else those of the experiment file. `None` without any.
    /// `cancel` stops it between two of them.
    ///
    /// # Errors
    /// A file that cannot be read, a model that does not exist, or a cancelled run.
    pub fn read(
        files: &[PathBuf],
        experiment: &Experiment,
        model: Option<&str>,
        cancel: &Cancel,
    ) -> Result<Option<Self>> {
        let model = parse_guide_model(model)?;
        let files = guide_files(files, experiment);
        let guides: Result<Vec<Guide>> =
            files.iter().map(|file| read_guide(file, cancel)).collect();
        let guides = guides?;
        Ok((!guides.is_empty()).then_some(Self { guides, model }))
    }

    /// Fits the video of the frame of `problem` with the guides.
    pub(crate) fn fit(
        &self,
        problem: &Problem,
        camera: &Camera,
        cancel: &Cancel,
    ) -> Result<GuideFit> {
        fit(
            camera,
            problem.operator(),
            problem.measurement(),
            problem.sigma(),
            &self.guides,
            self.model,
            cancel,
        )
    }
}

/// The pictures `files`, taken at unknown times, or else those of the experiment file.
pub(crate) fn guide_files(files: &[PathBuf], experiment: &Experiment) -> Vec<GuideFile> {
    if files.is_empty() {
        return experiment.guides.clone();
    }
    let given = files.iter().map(|image| GuideFile {
        image: image.clone(),
        ..GuideFile::default()
    });
    given.collect()
}

fn read_guide(file: &GuideFile, cancel: &Cancel) -> Result<Guide> {
    cancel.check()?;
    Ok(Guide {
        image: read_capture(&file.image)?.image,
        exposure: file.time_us.map(|time_us| GuideExposure {
            time_us,
            exposure_us: file.exposure_us.unwrap_or(0.0),
        }),
    })
}

/// What a guide gave.
#[derive(Debug, Clone)]
pub struct GuideOutcome {
    /// The numbers of `result.json`.
    pub numbers: GuideNumbers,
    /// The guide seen from the field, with greatest value 1.
    pub registered: Image,
    /// The place of each pixel of the field, `[y, x]`, from 1; 0: none. Empty for other models than places.
    pub labels: Vec<i64>,
}

/// What a guide gave; a key of `result.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct GuideNumbers {
    /// Whether the video is made with the guide.
    pub used: bool,
    /// Why it was used or dropped.
    pub reason: String,
    /// The model of the video: motion, gain, still or places.
    pub model: String,
    /// Counts of the video per unit of the guide.
    pub gain: f64,
    /// Counts of the video where the guide is zero.
    pub offset: f64,
    /// Blur of the guide that fits the frame best, in pixels of the field.
    pub blur_px: f64,
    /// The map from the field to the guide, as found.
    pub affine: AffineNumbers,
    /// Correlation of the registered guide with the coarse picture of the scene that the frame gives without it.
    pub correlation: f64,
    /// Rms displacement of a motion over the field and the bins, in pixels; null for other models.
    pub displacement_px: Option<f64>,
    /// Rms error of held-out pixels over σ.
    pub held_out: f64,
    /// The same of a coarse video without a guide.
    pub held_out_without: f64,
    /// The models that were tried.
    pub trials: Vec<GuideTrialNumbers>,
    /// The traces of the places; null for other models, and where the guide was dropped.
    pub known_places: Option<PlacesNumbers>,
}

/// The traces of the places of a guide.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct PlacesNumbers {
    /// `χ²` of the fit per degree of freedom.
    pub chi_squared: f64,
    /// Factor on all standard errors because of it; 1 unless the misfit is significant.
    pub inflation: f64,
    /// Number of places whose mean standard error is above half of their mean light: they are not told apart.
    pub uncertain: usize,
    /// The places, from label 1 on.
    pub traces: Vec<PlaceNumbers>,
}

/// The trace of a place.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct PlaceNumbers {
    /// Its number in `places.npy`.
    pub label: usize,
    /// Row of the centre of its light on the field, in pixels.
    pub y: f64,
    /// Column of the centre.
    pub x: f64,
    /// Number of its pixels.
    pub pixels: usize,
    /// Mean light of its pixels above the rest in each bin, in counts.
    pub value: Vec<f64>,
    /// Standard error of `value`.
    pub standard_error: Vec<f64>,
}

/// Mean standard error over mean light above which a trace is uncertain.
const UNCERTAIN: f64 = 0.5;
/// Factor on standard errors above which the places of the guide are doubted.
const MAX_INFLATION: f64 = 1.5;

impl PlacesNumbers {
    fn new(places: &KnownPlaces) -> Self {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let traces = places.traces.iter();
        let is_uncertain =
            |t: &&rowburst::guide::PlaceTrace| mean(&t.standard_error) > UNCERTAIN * mean(&t.value);
        Self {
            chi_squared: places.chi_squared,
            inflation: places.inflation,
            uncertain: traces.clone().filter(is_uncertain).count(),
            traces: traces
                .enumerate()
                .map(|(i, trace)| PlaceNumbers {
                    label: i + 1,
                    y: trace.centre.0,
                    x: trace.centre.1,
                    pixels: trace.pixels,
                    value: trace.value.clone(),
                    standard_error: trace.standard_error.clone(),
                })
                .collect(),
        }
    }
}

/// The map from the field to a guide.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct AffineNumbers {
    /// Shift at the centre along y and x, in pixels of the field.
    pub shift_px: (f64, f64),
    /// Turn in degrees.
    pub rotation_deg: f64,
    /// Size of the scene in the guide over that in the field.
    pub magnification: f64,
    /// `p₀ … p₅` in pixels: the guide's place of a pixel is `y + p₀ + p₁ η + p₂ ξ`, `x + p₃ + p₄ η + p₅ ξ`, where `η` and
    /// `ξ` are the distances from the centre along y and x over half the longer side.
    pub parameters: [f64; 6],
}

/// A model that was tried.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct GuideTrialNumbers {
    /// The model.
    pub model: String,
    /// Highest mode in time of a motion; null for other models.
    pub order: Option<usize>,
    /// Rms error of the fitted pixels over σ.
    pub fitted: f64,
    /// Rms error of the held-out pixels over σ.
    pub held_out: f64,
}

impl GuideOutcome {
    pub(crate) fn new(found: &GuideFit) -> Self {
        let shape = found.video.shape();
        let half_side = 0.5 * shape.rows.max(shape.columns) as f64;
        let affine = &found.affine;
        // Traces of a guide that does not belong to the frame are none.
        let known_places = found.known_places.as_ref().filter(|_| found.used);
        let trials = found.trials.iter().map(|trial| GuideTrialNumbers {
            model: trial.model.name().into(),
            order: trial.order,
            fitted: trial.fitted,
            held_out: trial.held_out,
        });
        Self {
            numbers: GuideNumbers {
                used: found.used,
                reason: found.reason.clone(),
                model: found.model.name().into(),
                gain: found.gain,
                offset: found.offset,
                blur_px: found.blur_px,
                affine: AffineNumbers {
                    shift_px: affine.shift_px(),
                    rotation_deg: affine.rotation_deg(half_side),
                    magnification: affine.magnification(half_side),
                    parameters: affine.parameters,
                },
                correlation: found.correlation,
                displacement_px: found.displacement_px,
                held_out: found.best().held_out,
                held_out_without: found.held_out_without,
                trials: trials.collect(),
                known_places: known_places.map(PlacesNumbers::new),
            },
            registered: found.registered.clone(),
            labels: known_places
                .map(|places| places.labels.iter().map(|l| i64::from(*l)).collect())
                .unwrap_or_default(),
        }
    }
}

impl GuideNumbers {
    /// The numbers for the report, as pairs of name and value.
    pub(crate) fn lines(&self) -> Vec<(String, String)> {
        let affine = &self.affine;
        let (y, x) = affine.shift_px;
        let pair = |name: &str, value: String| (name.to_string(), value);
        let mut lines = vec![
            pair("guide", self.reason.clone()),
            pair("model of the video", self.model.clone()),
            pair(
                "gain, offset and blur of the guide",
                format!(
                    "{} counts, {} counts, {} px",
                    short(self.gain),
                    short(self.offset),
                    short(self.blur_px)
                ),
            ),
            pair(
                "map to the guide",
                format!(
                    "shift {y:.2} px down and {x:.2} px right, turned by {:.2}°, {:.3} times as large",
                    affine.rotation_deg, affine.magnification
                ),
            ),
        ];
        lines.extend(self.known_places.as_ref().map(|places| {
            let value = format!(
                "{}; {} of them uncertain, standard errors grown by {:.2} (places.csv)",
                places.traces.len(),
                places.uncertain,
                places.inflation
            );
            pair("places", value)
        }));
        lines
    }

    /// What the traces of places cannot tell.
    pub(crate) fn places_warnings(&self) -> Vec<String> {
        let Some(places) = self.known_places.as_ref().filter(|_| self.used) else {
            return Vec::new();
        };
        let mut warnings = Vec::new();
        if places.uncertain > 0 {
            warnings.push(format!(
                "{} of {} places have standard errors above half of their light: they are too many, too small or too dim",
                places.uncertain,
                places.traces.len()
            ));
        }
        if places.inflation > MAX_INFLATION {
            warnings.push(format!(
                "the places of the guide explain the frame to {:.2} σ only: a place is missing or has moved, or the guide is blurred; the standard errors of their traces were inflated by {:.1}",
                places.chi_squared.sqrt(),
                places.inflation
            ));
        }
        warnings
    }
}

/// Writes the registered guide beside the mean of `video` over time, to be compared by eye.
pub(crate) fn write_picture(
    folder: &OutputFolder,
    registered: &Image,
    video: &rowburst::Video,
) -> Result<()> {
    let shape = video.shape();
    let mut mean = Image::zeros(shape.rows, shape.columns);
    for t in 0..shape.bins {
        let pixels = mean.data_mut().iter_mut().zip(video.bin(t));
        pixels.for_each(|(m, v)| *m += v / shape.bins as f32);
    }
    const GAP: usize = 4;
    let (registered, mean) = (stretched(registered), stretched(&mean));
    let columns = 2 * shape.columns + GAP;
    let mut pixels = vec![u16::MAX; shape.rows * columns];
    for y in 0..shape.rows {
        let line = &mut pixels[y * columns..(y + 1) * columns];
        line[..shape.columns]
            .copy_from_slice(&registered[y * shape.columns..(y + 1) * shape.columns]);
        line[shape.columns + GAP..]
            .copy_from_slice(&mean[y * shape.columns..(y + 1) * shape.columns]);
    }
    folder.write(GUIDE_PICTURE, |w| {
        write_png16(w, shape.rows, columns, &pixels)
    })
}

/// Writes the places of a guide: their traces, a line for each bin, and the place of each pixel.
pub(crate) fn write_places(
    folder: &OutputFolder,
    guide: &GuideOutcome,
    time: &TimeGrid,
) -> Result<()> {
    let Some(places) = &guide.numbers.known_places else {
        return Ok(());
    };
    let mut heading = vec!["time_us".to_string()];
    for place in &places.traces {
        let label = place.label;
        heading.extend([
            format!("place{label}"),
            format!("place{label}_standard_error"),
        ]);
    }
    let row = |t: usize| -> Vec<f64> {
        let traces = places.traces.iter();
        let pairs = traces.flat_map(|place| [place.value[t], place.standard_error[t]]);
        std::iter::once(time.middle_us(t)).chain(pairs).collect()
    };
    folder.write(PLACES_TRACES, |w| {
        write_csv(w, &heading, (0..time.bins()).map(row))
    })?;
    let shape = [guide.registered.rows(), guide.registered.columns()];
    folder.write(PLACES_LABELS, |w| write_npy_i64(w, &shape, &guide.labels))
}

/// The traces of places, and the place of each pixel, in a folder of results.
pub(crate) const PLACES_TRACES: &str = "places.csv";
pub(crate) const PLACES_LABELS: &str = "places.npy";

/// The picture of a guide in a folder of results.
pub(crate) const GUIDE_PICTURE: &str = "guide.png";

/// Grey values from the least to the greatest.
fn stretched(image: &Image) -> Vec<u16> {
    let (least, most) = (image.min(), image.max());
    let scale = f32::from(u16::MAX) / (most - least).max(f32::MIN_POSITIVE);
    let values = image.data().iter();
    values
        .map(|v| ((v - least) * scale).round() as u16)
        .collect()
}
