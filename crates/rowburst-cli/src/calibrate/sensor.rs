//! `rowburst calibrate sensor`: darks and flats into the sensor's part of an experiment.

use crate::calibrate::experiment_of;
use crate::output::print_line;
use clap::Args;
use rowburst::ErrorKind;
use rowburst::calibrate::sensor::{SensorCalibration, Stack, calibrate};
use rowburst::error::Subject;
use rowburst::{Error, Parameter, Result};
use rowburst_io::{Experiment, OutputFolder};
use rowburst_run::calibrate::sensor::{read_frames, summary, write};
use rowburst_run::short;
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
    let darks = Stack::new(
        Parameter::Darks,
        read_frames(Parameter::Darks, &args.darks)?,
    )?;
    let flats = Stack::new(
        Parameter::Flats,
        read_frames(Parameter::Flats, &args.flats)?,
    )?;
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
    let reproduce = Some(command_line(args));
    write(
        &folder,
        &calibration,
        experiment,
        &summary,
        reproduce.as_deref(),
    )?;
    if args.json {
        print_line(format_args!("{summary:#}"));
    } else {
        print_summary(&calibration, &folder);
    }
    Ok(())
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

/// The experiment file that is given keeps its comments: it is not written over.
fn check_kept(experiment: &Experiment, output: &Path) -> Result<()> {
    let written = output.join("experiment.toml").canonicalize();
    match (experiment.path.canonicalize(), written) {
        (Ok(given), Ok(written)) if given == written => Err(Error::input(
            Parameter::Experiment,
            experiment.path.display(),
            "the calibrated experiment is written to another folder than the one it is made from",
            "Choose another folder with -o.",
        )),
        _ => Ok(()),
    }
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

fn command_line(args: &SensorArgs) -> String {
    let mut line = String::from("rowburst calibrate sensor --darks");
    for path in &args.darks {
        line += &format!(" {}", path.display());
    }
    line += " --flats";
    for path in &args.flats {
        line += &format!(" {}", path.display());
    }
    if let Some(path) = &args.experiment {
        line += &format!(" --experiment {}", path.display());
    }
    line + &format!(" -o {}", args.output.display())
}
