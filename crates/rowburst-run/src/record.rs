//! What repeats a run: camera, options and input files with their hashes, in `result.json`.

#![allow(missing_docs, reason = "the fields are the keys of result.json")]

use crate::formats::VideoFormat;
use crate::movie::MovieStyle;
use crate::options::UserOptions;
use rowburst::bayer::Bayer;
use rowburst::camera::CameraParams;
use rowburst::error::{Subject, Tool};
use rowburst::{Error, ErrorKind, Parameter, Result, Sensor, Shutter, phrase};
use rowburst_io::{Calibration, Experiment, GuideFile, relative_path, sha256};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Camera, options and inputs of a run. With it `result.json` alone repeats the run.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RunRecord {
    /// Start of the run, in UTC, as in 2026-11-24T13:45:18Z.
    pub date: String,
    /// The command as it was typed.
    pub command: String,
    /// The camera and the field, with what metadata has filled in; the keys are those of the experiment file.
    pub camera: CameraNumbers,
    pub options: OptionNumbers,
    /// The files that were read. Paths are relative to the folder of result.json where there is such a path.
    pub inputs: Vec<InputFile>,
    /// SHA-256 of the video's file.
    pub video_sha256: Option<String>,
}

/// The camera and the field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct CameraNumbers {
    pub rows: usize,
    pub columns: usize,
    pub shutter: String,
    /// The instant at which each row is read, of a custom shutter.
    pub row_order: Option<Vec<usize>>,
    pub row_time_us: f64,
    pub exposure_us: f64,
    pub bins_per_row: usize,
    pub field_rows: Option<usize>,
    pub field_columns: Option<usize>,
    pub binning: usize,
    pub pixel_pitch_um: Option<f64>,
    pub magnification: Option<f64>,
    pub trigger_delay_us: Option<f64>,
    pub bit_depth: Option<u32>,
    pub bias_counts: Option<f64>,
    pub gain_electrons_per_count: Option<f64>,
    pub read_noise_electrons: Option<f64>,
    pub full_well_counts: Option<f64>,
    pub bayer: Option<String>,
}

/// The options of a run, those of the experiment file included.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct OptionNumbers {
    pub prior: Option<String>,
    pub tau: Option<String>,
    pub noise_sigma: Option<f64>,
    pub self_calibrate: Option<String>,
    pub keep_all_pixels: bool,
    pub max_iterations: Option<usize>,
    pub time_budget_s: Option<f64>,
    /// The first bin and the one after the last.
    pub bins: Option<[usize; 2]>,
    pub part_bins: Option<usize>,
    pub debias: bool,
    pub seed: u64,
    #[serde(default)]
    pub guide_model: Option<String>,
    /// The middle of the exposure of each guide and its length; null: unknown.
    #[serde(default)]
    pub guide_exposures_us: Vec<Option<[f64; 2]>>,
    pub regions: Vec<String>,
    /// Whether `video.mp4` has no strip with the time.
    pub no_stamp: bool,
    /// The formats of the video; null: the default.
    pub write: Option<Vec<VideoFormat>>,
}

/// A file that was read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct InputFile {
    /// What it is: `experiment`, `frame`, `psf`, `dark` and so on.
    pub role: String,
    pub path: String,
    pub sha256: String,
}

/// What an input is for.
pub(crate) mod role {
    pub const EXPERIMENT: &str = "experiment";
    pub const FRAME: &str = "frame";
    pub const PSF: &str = "psf";
    pub const PSF_STACK: &str = "psf_stack";
    pub const PSF_CAPTURE: &str = "psf_capture";
    pub const DARK: &str = "dark";
    pub const FLAT: &str = "flat";
    pub const BAD_PIXELS: &str = "bad_pixels";
    pub const TRUTH: &str = "truth";
    pub const DIRECT: &str = "direct";
    pub const PHOTODIODE: &str = "photodiode";
    pub const GUIDE: &str = "guide";
}

impl RunRecord {
    /// The record for `result.json` in `folder`, which holds the video `video`.
    pub(crate) fn finished(&self, folder: &Path, video: &str) -> Result<Self> {
        let mut record = self.placed_in(folder);
        record.video_sha256 = Some(sha256(&folder.join(video))?);
        Ok(record)
    }

    /// The record for `result.json` in `folder`, without the hash of the video.
    pub(crate) fn placed_in(&self, folder: &Path) -> Self {
        let mut record = self.clone();
        for input in &mut record.inputs {
            input.path = relative_path(Path::new(&input.path), folder);
        }
        record
    }

    /// Reads the record of the result in `folder`, and the whole of its `result.json`.
    ///
    /// # Errors
    /// A folder without a result, or a result of arrays or of 0.1, which has no record.
    pub fn read(folder: &Path) -> Result<(Self, Value)> {
        let path = folder.join("result.json");
        let bad = |found: String| {
            Error::input(
                &path,
                found,
                "a run is repeated from the result.json of a whole result, of this version or a later one",
                phrase!["Run ", Tool::Reconstruct, " again, and keep its folder."],
            )
        };
        let text = std::fs::read(&path).map_err(|e| bad(e.to_string()))?;
        let value: Value = serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))?;
        let record = value.get("run").cloned().unwrap_or_default();
        if record.is_null() {
            return Err(bad(
                "no record of the run: it is of an earlier version, or made of arrays in memory"
                    .into(),
            ));
        }
        let record = serde_json::from_value(record).map_err(|e| bad(e.to_string()))?;
        Ok((record, value))
    }

    /// The record with the inputs that are not at their places, seen from the result in `folder`, at those of equal name
    /// and SHA-256 in `inputs` or a folder within it. Others stay.
    ///
    /// # Errors
    /// `inputs` is no folder that can be read.
    pub fn with_inputs_of(mut self, folder: &Path, inputs: &Path) -> Result<Self> {
        let found = files_below(inputs, MAX_INPUT_DEPTH).map_err(|error| {
            Error::input(
                inputs,
                error,
                "inputs are looked for in a folder that can be read",
                "Give the folder that holds them.",
            )
        })?;
        for input in &mut self.inputs {
            let is_equal = |path: &Path| sha256(path).is_ok_and(|found| found == input.sha256);
            if is_equal(&folder.join(&input.path)) {
                continue;
            }
            let name = Path::new(&input.path).file_name();
            let mut candidates = found.iter().filter(|path| path.file_name() == name);
            if let Some(path) = candidates.find(|path| is_equal(path)) {
                let whole = path.canonicalize().unwrap_or_else(|_| path.clone());
                input.path = whole.to_string_lossy().into_owned();
            }
        }
        Ok(self)
    }

    /// Checks the hashes of all inputs but the experiment file, whose content the record has. `folder` is that of the
    /// result. Returns a sentence on an experiment file that has changed.
    ///
    /// # Errors
    /// Inputs that are missing or have changed, all of them.
    pub fn check_inputs(&self, folder: &Path) -> Result<Option<String>> {
        let mut note = None;
        let mut changed = Vec::new();
        for input in &self.inputs {
            let path = folder.join(&input.path);
            let fault = match sha256(&path) {
                Ok(found) if found == input.sha256 => continue,
                Ok(_) => "has changed",
                Err(_) => "is missing",
            };
            let text = format!("{} {} {fault}", input.role, path.display());
            if input.role == role::EXPERIMENT {
                note = Some(format!("{text}; the camera is that of result.json"));
            } else {
                changed.push(text);
            }
        }
        if changed.is_empty() {
            return Ok(note);
        }
        Err(Error::input(
            folder.join("result.json"),
            changed.join("; "),
            "a run is repeated with the files that it was made of, by their SHA-256",
            phrase![
                "Put the files back as they were, name the folder that holds them with ",
                Parameter::Inputs,
                ", or reconstruct anew with those that are there."
            ],
        )
        .with_kind(ErrorKind::Conflict))
    }

    /// The experiment of the run; paths of its files are those of the inputs, seen from `folder`.
    ///
    /// # Errors
    /// A record that was edited by hand.
    pub fn experiment(&self, folder: &Path) -> Result<Experiment> {
        let file = |role: &str| self.files(role, folder).next();
        let mut experiment = Experiment::new(self.camera.params(folder)?);
        experiment.path = folder.join("result.json");
        let bayer = self.camera.bayer.as_deref();
        experiment.bayer = bayer.and_then(Bayer::from_name);
        experiment.calibration = Calibration {
            psf: file(role::PSF),
            dark: file(role::DARK),
            flat: file(role::FLAT),
            bad_pixels: file(role::BAD_PIXELS),
        };
        let guides = self.files(role::GUIDE, folder);
        let guides = guides.zip(&self.options.guide_exposures_us);
        experiment.guides = guides
            .map(|(image, exposure)| GuideFile {
                image,
                time_us: exposure.map(|[time, _]| time),
                exposure_us: exposure.map(|[_, length]| length),
            })
            .collect();
        Ok(experiment)
    }

    /// The frame of the run.
    pub fn frame(&self, folder: &Path) -> PathBuf {
        self.files(role::FRAME, folder).next().unwrap_or_default()
    }

    /// The true video, the frame without diffuser and the photodiodes.
    pub fn further_files(&self, folder: &Path) -> FurtherFiles {
        FurtherFiles {
            truth: self.files(role::TRUTH, folder).next(),
            direct: self.files(role::DIRECT, folder).next(),
            photodiodes: self.files(role::PHOTODIODE, folder).collect(),
        }
    }

    fn files<'a>(&'a self, role: &'a str, folder: &'a Path) -> impl Iterator<Item = PathBuf> + 'a {
        let inputs = self.inputs.iter().filter(move |input| input.role == role);
        inputs.map(move |input| folder.join(&input.path))
    }
}

/// Folders within one another in which inputs are looked for; larger takes long in the folder of all of a user's files.
const MAX_INPUT_DEPTH: usize = 4;

/// The files of `folder` and of the folders within it, to the depth `depth`, sorted.
fn files_below(folder: &Path, depth: usize) -> std::io::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let (path, kind) = entry.and_then(|entry| Ok((entry.path(), entry.file_type()?)))?;
        if kind.is_dir() && depth > 1 {
            // What cannot be read holds no inputs.
            files.extend(files_below(&path, depth - 1).unwrap_or_default());
        } else if !kind.is_dir() {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// Files of a run that the reconstruction itself does not need.
pub struct FurtherFiles {
    /// The true video.
    pub truth: Option<PathBuf>,
    /// The frame without diffuser.
    pub direct: Option<PathBuf>,
    /// The photodiodes.
    pub photodiodes: Vec<PathBuf>,
}

impl CameraNumbers {
    pub(crate) fn new(experiment: &Experiment) -> Self {
        let (params, sensor) = (&experiment.params, &experiment.params.sensor);
        let row_order = match &params.shutter {
            Shutter::Custom(order) => Some(order.clone()),
            _ => None,
        };
        Self {
            rows: params.rows,
            columns: params.columns,
            shutter: params.shutter.name().into(),
            row_order,
            row_time_us: params.row_time_us,
            exposure_us: params.exposure_us,
            bins_per_row: params.bins_per_row,
            field_rows: params.field.map(|field| field.0),
            field_columns: params.field.map(|field| field.1),
            binning: sensor.binning,
            pixel_pitch_um: sensor.pixel_pitch_um,
            magnification: sensor.magnification,
            trigger_delay_us: sensor.trigger_delay_us,
            bit_depth: sensor.bit_depth,
            bias_counts: sensor.bias_counts,
            gain_electrons_per_count: sensor.gain_electrons_per_count,
            read_noise_electrons: sensor.read_noise_electrons,
            full_well_counts: sensor.full_well_counts,
            bayer: experiment.bayer.map(|mosaic| mosaic.name().into()),
        }
    }

    fn params(&self, folder: &Path) -> Result<CameraParams> {
        let shutter = match &self.row_order {
            Some(order) => Some(Shutter::Custom(order.clone())),
            None => Shutter::from_name(&self.shutter),
        };
        let shutter = shutter.ok_or_else(|| {
            Error::input(
                Subject::in_file(folder.join("result.json"), "run.camera.shutter"),
                format!("\"{}\"", self.shutter),
                format!("the shutter is one of {}", Shutter::NAMES.join(", ")),
                "Undo the change of result.json.",
            )
        })?;
        Ok(CameraParams {
            rows: self.rows,
            columns: self.columns,
            shutter,
            row_time_us: self.row_time_us,
            exposure_us: self.exposure_us,
            bins_per_row: self.bins_per_row,
            field: self.field_rows.zip(self.field_columns),
            sensor: Sensor {
                binning: self.binning,
                pixel_pitch_um: self.pixel_pitch_um,
                magnification: self.magnification,
                trigger_delay_us: self.trigger_delay_us,
                bit_depth: self.bit_depth,
                bias_counts: self.bias_counts,
                gain_electrons_per_count: self.gain_electrons_per_count,
                read_noise_electrons: self.read_noise_electrons,
                full_well_counts: self.full_well_counts,
            },
        })
    }
}

impl OptionNumbers {
    /// With the choices for the files.
    #[must_use]
    pub fn with_files(self, movie: MovieStyle, write: Option<Vec<VideoFormat>>) -> Self {
        Self {
            no_stamp: matches!(movie, MovieStyle::Plain),
            write,
            ..self
        }
    }

    /// As a user types them.
    pub fn typed(&self) -> UserOptions<'_> {
        UserOptions {
            prior: self.prior.as_deref(),
            tau: self.tau.as_deref(),
            noise_sigma: self.noise_sigma,
            self_calibrate: self.self_calibrate.as_deref(),
            keep_all_pixels: self.keep_all_pixels,
            max_iterations: self.max_iterations,
            time_budget_s: self.time_budget_s,
        }
    }
}

/// The present time in UTC, as in 2026-11-24T13:45:18Z.
pub(crate) fn utc_now() -> String {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    utc_text(since.map_or(0, |time| time.as_secs()))
}

/// The time `seconds` after the start of 1970. The date by H. Hinnant's `civil_from_days`.
fn utc_text(seconds: u64) -> String {
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era =
        (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_index = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_index + 2) / 5 + 1;
    let month = if month_index < 10 {
        month_index + 3
    } else {
        month_index - 9
    };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    let (hour, minute) = (second / 3600, second / 60 % 60);
    format!(
        "{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{:02}Z",
        second % 60
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        assert_eq!(utc_text(0), "1970-01-01T00:00:00Z");
        assert_eq!(utc_text(951_782_400), "2000-02-29T00:00:00Z");
        assert_eq!(utc_text(1_795_528_799), "2026-11-24T13:59:59Z");
    }
}
