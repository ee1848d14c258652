//! The numbers, the report and the folder of a sensor's calibration.

mod report;

use crate::event::{Event, Observer};
use rowburst::calibrate::sensor::{FullSign, SensorCalibration, Stack, calibrate};
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Image, Parameter, Result, Sensor, phrase};
use rowburst_io::{
    Calibration, Experiment, IMAGE_ENDINGS, OutputFolder, is_image, read_stack, write_npy_image,
    write_png8,
};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// The frames of `paths`, with names for messages; those of a folder by file name. `parameter` names them in errors.
///
/// # Errors
/// Files that cannot be read, and folders without images.
pub fn read_frames(parameter: Parameter, paths: &[PathBuf]) -> Result<Vec<(String, Image)>> {
    let mut frames = Vec::new();
    for path in paths {
        let files = if path.is_dir() {
            files_of(parameter, path)?
        } else {
            vec![path.clone()]
        };
        for file in files {
            let pages = read_stack(&file)?;
            let several = pages.len() > 1;
            for (page, image) in pages.into_iter().enumerate() {
                let mut name = file.display().to_string();
                if several {
                    name += &format!(" page {}", page + 1);
                }
                frames.push((name, image));
            }
        }
    }
    Ok(frames)
}

/// The images in `folder`, by name.
fn files_of(parameter: Parameter, folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|error| {
        Error::work(
            Subject::from(folder).of(parameter),
            format!("cannot read: {error}"),
            "Check its permissions.",
        )
        .with_kind(ErrorKind::Io)
    })?;
    let is_image = |path: &PathBuf| {
        let hidden = path
            .file_name()
            .is_some_and(|name| name.to_string_lossy().starts_with('.'));
        !hidden && path.is_file() && is_image(path)
    };
    let mut files: Vec<PathBuf> = entries
        .flatten()
        .map(|e| e.path())
        .filter(is_image)
        .collect();
    files.sort();
    if files.is_empty() {
        return Err(Error::input(
            Subject::from(folder).of(parameter),
            "a folder without images",
            phrase![
                parameter,
                format!(" takes frames as {IMAGE_ENDINGS}, or folders of them")
            ],
            "Name the folder that the frames lie in.",
        ));
    }
    Ok(files)
}

/// A calibrated sensor.
pub struct CalibratedSensor {
    /// Maps, levels and faults.
    pub calibration: SensorCalibration,
    /// The content of `sensor.json`.
    pub summary: Value,
    /// The experiment that the sensor is for.
    experiment: Option<Experiment>,
}

/// Calibrates the sensor by `darks` and `flats`, frames with their names. A copy of `experiment` takes over the results.
/// `observer` hears how many frames there are.
///
/// # Errors
/// Those of [`Stack::new`] and [`calibrate`], and frames that do not have the pixels of the experiment's sensor.
pub fn calibrate_frames(
    darks: Vec<(String, Image)>,
    flats: Vec<(String, Image)>,
    experiment: Option<Experiment>,
    observer: Observer,
) -> Result<CalibratedSensor> {
    let darks = Stack::new(Parameter::Darks, darks)?;
    let flats = Stack::new(Parameter::Flats, flats)?;
    if let Some(experiment) = &experiment {
        check_fits(experiment, &darks)?;
    }
    let counts = format!("{} darks, {} flats", darks.len(), flats.len());
    let _ = observer(Event::Note(&counts));
    let calibration = calibrate(&darks, &flats)?;
    Ok(CalibratedSensor {
        summary: summary(&calibration, &darks, &flats),
        calibration,
        experiment,
    })
}

/// Calibration frames are raw: they have the sensor's pixels before binning.
fn check_fits(experiment: &Experiment, darks: &Stack) -> Result<()> {
    let params = &experiment.params;
    let binning = params.sensor.binning;
    let expected = (params.rows * binning, params.columns * binning);
    if darks.size() == expected {
        return Ok(());
    }
    let (rows, columns) = darks.size();
    Err(Error::input(
        Subject::item(Parameter::Darks, darks.name(0)),
        format!("{rows}×{columns} pixels"),
        format!(
            "{} has {}×{} raw pixels (rows and columns times binning = {binning})",
            experiment.path.display(),
            expected.0,
            expected.1
        ),
        "Record darks and flats as the raw frames are, or correct rows, columns and binning in [camera].",
    ).with_kind(ErrorKind::Shape))
}

/// The content of `sensor.json`.
fn summary(calibration: &SensorCalibration, darks: &Stack, flats: &Stack) -> Value {
    let faults = &calibration.faults;
    let count = |flags: &[bool]| flags.iter().filter(|f| **f).count();
    let (rows, columns) = darks.size();
    let gain = calibration.gain_electrons_per_count;
    let levels: Vec<Value> = calibration
        .levels
        .iter()
        .map(|level| {
            json!({
                "light_counts": level.light,
                "flats": level.frames.len(),
                "clipped_fraction": level.clipped,
            })
        })
        .collect();
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "rows": rows,
        "columns": columns,
        "darks": darks.len(),
        "flats": flats.len(),
        "flat_pairs": calibration.pairs,
        "flat_levels": levels,
        "bias_counts": calibration.bias_counts,
        "dark_signal_counts": Value::Null,
        "read_noise_electrons": calibration.read_noise_electrons,
        "read_noise_rms_electrons": calibration.read_noise_rms_electrons,
        "gain_electrons_per_count": gain,
        "gain_relative_error": calibration.gain_error,
        "full_well_counts": calibration.full_well.map(|full| full.counts),
        "full_well_sign": calibration.full_well.map(|full| match full.sign {
            FullSign::Clipped => "readings pile up",
            FullSign::Turnover => "variance falls",
        }),
        "bad_pixels": faults.count(),
        "hot_pixels": count(&faults.hot),
        "dead_pixels": count(&faults.dead),
        "unstable_pixels": count(&faults.unstable),
        "response_non_uniformity": calibration.non_uniformity,
        "flat_relative_error": calibration.flat_error,
        "banding_counts": calibration.banding.row_counts,
        "banding_electrons": calibration.banding.row_counts * gain,
        "banding_is_real": calibration.banding.is_real,
        "fixed_row_pattern_counts": calibration.banding.fixed_counts,
        "remarks": calibration.remarks(),
        "warnings": calibration.warnings,
    })
}

impl CalibratedSensor {
    /// Writes maps, keys, report and, with an experiment, a copy of it with the results. `sensor.json` is written last:
    /// where it is, the calibration is whole. `reproduce` is the command that repeats it.
    ///
    /// # Errors
    /// Failed writes.
    pub fn write(&self, folder: &OutputFolder, reproduce: Option<&str>) -> Result<()> {
        let calibration = &self.calibration;
        folder.remove("sensor.json")?;
        let maps = [
            ("dark.npy", &calibration.dark),
            ("flat.npy", &calibration.flat),
            ("response.npy", &calibration.response),
            ("read_noise.npy", &calibration.read_noise),
        ];
        for (name, map) in maps {
            folder.write(name, |w| write_npy_image(w, map))?;
        }
        let (rows, columns) = (calibration.dark.rows(), calibration.dark.columns());
        let mask: Vec<u8> = (0..rows * columns)
            .map(|i| if calibration.faults.is_bad(i) { 255 } else { 0 })
            .collect();
        folder.write("bad_pixels.png", |w| write_png8(w, rows, columns, &mask))?;
        folder.write_bytes("sensor.toml", keys(calibration).as_bytes())?;
        if let Some(experiment) = self.experiment.clone() {
            let text = calibrated(experiment, calibration, folder.path()).to_toml(folder.path());
            folder.write_bytes("experiment.toml", text.as_bytes())?;
        }
        let report = report::render(calibration, self.experiment.is_some(), reproduce)?;
        for picture in &report.pictures {
            folder.write_bytes(&picture.name, &picture.png)?;
        }
        folder.write_bytes("report.html", report.html.as_bytes())?;
        folder.remove_stale()?;
        folder.write_bytes("sensor.json", format!("{:#}\n", self.summary).as_bytes())
    }
}

/// `experiment` with what was `found` about the sensor; the files lie in `folder`.
fn calibrated(
    experiment: Experiment,
    calibration: &SensorCalibration,
    folder: &Path,
) -> Experiment {
    let mut params = experiment.params;
    params.sensor = Sensor {
        bias_counts: Some(calibration.bias_counts.max(0.0)),
        gain_electrons_per_count: Some(calibration.gain_electrons_per_count),
        read_noise_electrons: Some(calibration.read_noise_electrons),
        // What these flats do not reach an earlier calibration may have known.
        full_well_counts: calibration
            .full_well
            .map(|full| full.counts)
            .or(params.sensor.full_well_counts),
        ..params.sensor
    };
    Experiment {
        params,
        calibration: Calibration {
            dark: Some(folder.join("dark.npy")),
            flat: Some(folder.join("flat.npy")),
            bad_pixels: Some(folder.join("bad_pixels.png")),
            ..experiment.calibration
        },
        ..experiment
    }
}

/// `sensor.toml`: the keys to be copied into an experiment file.
fn keys(calibration: &SensorCalibration) -> String {
    let mut text = String::from("# For an experiment file in this folder.\n[camera]\n");
    text += &format!("bias_counts = {:?}\n", calibration.bias_counts.max(0.0));
    text += &format!(
        "gain_electrons_per_count = {:?}\nread_noise_electrons = {:?}\n",
        calibration.gain_electrons_per_count, calibration.read_noise_electrons
    );
    if let Some(full) = calibration.full_well {
        text += &format!("full_well_counts = {:?}\n", full.counts);
    }
    text + "\n[calibration]\ndark = \"dark.npy\"\nflat = \"flat.npy\"\nbad_pixels = \"bad_pixels.png\"\n"
}
