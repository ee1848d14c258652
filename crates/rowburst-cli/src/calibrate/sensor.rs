//! `rowburst calibrate sensor`: darks and flats into the sensor's part of an experiment.

mod report;

use crate::calibrate::experiment_of;
use crate::output::print_line;
use clap::Args;
use rowburst::calibrate::sensor::{FullSign, SensorCalibration, Stack, calibrate};
use rowburst::{Error, Image, Result, Sensor};
use rowburst_io::{
    Calibration, Experiment, IMAGE_ENDINGS, OutputFolder, is_image, read_stack, write_npy_image,
    write_png8,
};
use rowburst_run::short;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Bias, noise, gain, full well and bad pixels from dark and flat frames.
///
/// Darks: 20 or more with the cap on, at the exposure and gain of use. Flats: raw frames of
/// even, steady light, two or more at each of several levels, from dim to just saturated; one level
/// at half of the range will do. Files, folders and multi-page stacks may be mixed.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst calibrate sensor --darks darks/ --flats flats/ --experiment experiment.toml -o sensor\n  rowburst reconstruct sensor/experiment.toml --frame capture.tif -o result"
)]
pub struct SensorArgs {
    /// Frames without light: files (.npy, .tif, .png, .bmp, .h5, .mat, .fits, .cihx; stacks too) or folders of them
    #[arg(long, required = true, num_args = 1.., value_name = "FRAME")]
    pub darks: Vec<PathBuf>,
    /// Frames of even light, two or more at each level: files, stacks or folders
    #[arg(long, required = true, num_args = 1.., value_name = "FRAME")]
    pub flats: Vec<PathBuf>,
    /// An experiment file; a copy with the results is written to the folder
    #[arg(long, value_name = "EXPERIMENT.toml")]
    pub experiment: Option<PathBuf>,
    /// Print sensor.json to standard output instead of a summary
    #[arg(long)]
    pub json: bool,
    /// Folder for maps, summary and report
    #[arg(short, long)]
    pub output: PathBuf,
}

pub fn run(args: &SensorArgs) -> Result<()> {
    let experiment = args
        .experiment
        .as_deref()
        .map(|path| experiment_of(path, &args.flats))
        .transpose()?;
    let darks = Stack::new("darks", read_frames("--darks", &args.darks)?)?;
    let flats = Stack::new("flats", read_frames("--flats", &args.flats)?)?;
    if let Some(experiment) = &experiment {
        check_fits(experiment, &darks)?;
        check_kept(experiment, &args.output)?;
    }
    eprintln!("{} darks, {} flats", darks.len(), flats.len());
    let calibration = calibrate(&darks, &flats)?;
    for warning in &calibration.warnings {
        eprintln!("warning: {warning}");
    }
    let summary = summary(&calibration, &darks, &flats);
    let folder = OutputFolder::create(&args.output)?;
    write(args, &folder, &calibration, experiment, &summary)?;
    if args.json {
        print_line(format_args!("{summary:#}"));
    } else {
        print_summary(&calibration, &folder);
    }
    Ok(())
}

/// The frames of `paths`, with names for messages; those of a folder by file name.
fn read_frames(option: &str, paths: &[PathBuf]) -> Result<Vec<(String, Image)>> {
    let mut frames = Vec::new();
    for path in paths {
        let files = if path.is_dir() {
            files_of(option, path)?
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
fn files_of(option: &str, folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|error| {
        Error::work(
            folder.display().to_string(),
            format!("cannot read: {error}"),
            "Check its permissions.",
        )
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
            folder.display().to_string(),
            "a folder without images",
            format!("{option} takes frames as {IMAGE_ENDINGS}, or folders of them"),
            "Name the folder that the frames lie in.",
        ));
    }
    Ok(files)
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
        darks.name(0),
        format!("{rows}×{columns} pixels"),
        format!(
            "{} has {}×{} raw pixels (rows and columns times binning = {binning})",
            experiment.path.display(),
            expected.0,
            expected.1
        ),
        "Record darks and flats as the raw frames are, or correct rows, columns and binning in [camera].",
    ))
}

/// The experiment file that is given keeps its comments: it is not written over.
fn check_kept(experiment: &Experiment, output: &Path) -> Result<()> {
    let written = output.join("experiment.toml").canonicalize();
    match (experiment.path.canonicalize(), written) {
        (Ok(given), Ok(written)) if given == written => Err(Error::input(
            "--experiment",
            experiment.path.display(),
            "the calibrated experiment is written to another folder than the one it is made from",
            "Choose another folder with -o.",
        )),
        _ => Ok(()),
    }
}

/// `sensor.json`.
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

/// Writes all files, `sensor.json` last: where it is, the calibration is whole.
fn write(
    args: &SensorArgs,
    folder: &OutputFolder,
    calibration: &SensorCalibration,
    experiment: Option<Experiment>,
    summary: &Value,
) -> Result<()> {
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
    if let Some(experiment) = experiment {
        let text = calibrated(experiment, calibration, folder.path()).to_toml(folder.path());
        folder.write_bytes("experiment.toml", text.as_bytes())?;
    }
    let report = report::render(calibration, args)?;
    for picture in &report.pictures {
        folder.write_bytes(&picture.name, &picture.png)?;
    }
    folder.write_bytes("report.html", report.html.as_bytes())?;
    folder.write_bytes("sensor.json", format!("{summary:#}\n").as_bytes())
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

fn print_summary(calibration: &SensorCalibration, folder: &OutputFolder) {
    let faults = &calibration.faults;
    let count = |flags: &[bool]| flags.iter().filter(|f| **f).count();
    print_line(format_args!(
        "gain {} electrons per count (±{:.1} %), read noise {} electrons, bias {} counts",
        short(calibration.gain_electrons_per_count),
        100.0 * calibration.gain_error,
        short(calibration.read_noise_electrons),
        short(calibration.bias_counts)
    ));
    match calibration.full_well {
        Some(full) => print_line(format_args!("full well {} counts", short(full.counts))),
        None => print_line("full well not reached by these flats"),
    }
    print_line(format_args!(
        "{} bad pixels: {} hot, {} dead, {} unstable",
        faults.count(),
        count(&faults.hot),
        count(&faults.dead),
        count(&faults.unstable)
    ));
    print_line(format_args!("{}/report.html", folder.path().display()));
}
