//! `rowburst calibrate sensor`: darks and flats into the sensor's part of an experiment.

use crate::calibrate::experiment_of;
use crate::output::print_line;
use crate::progress::print_note;
use crate::shared_args::ForceArgs;
use clap::Args;
use rowburst::calibrate::sensor::SensorCalibration;
use rowburst::{Error, Parameter, Result};
use rowburst_io::{Experiment, OutputFolder};
use rowburst_run::calibrate::sensor::{calibrate_frames, read_frames};
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
    #[command(flatten)]
    pub force: ForceArgs,
}

pub fn run(args: &SensorArgs) -> Result<()> {
    let experiment = args
        .experiment
        .as_deref()
        .map(|path| experiment_of(path, &args.flats))
        .transpose()?;
    if let Some(experiment) = &experiment {
        check_kept(experiment, &args.output)?;
    }
    let darks = read_frames(Parameter::Darks, &args.darks)?;
    let flats = read_frames(Parameter::Flats, &args.flats)?;
    let sensor = calibrate_frames(darks, flats, experiment, &mut print_note)?;
    for warning in &sensor.calibration.warnings {
        eprintln!("warning: {warning}");
    }
    let folder = args.force.claim(&args.output, "calibrate sensor")?;
    sensor.write(&folder, Some(&command_line(args)))?;
    if args.json {
        print_line(format_args!("{:#}", sensor.summary));
    } else {
        print_summary(&sensor.calibration, &folder);
    }
    Ok(())
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
    let kinds = [&faults.hot, &faults.dead, &faults.unstable].map(|flags| count(flags));
    let several = if kinds.iter().sum::<usize>() > faults.count() {
        " (some are of several kinds)"
    } else {
        ""
    };
    print_line(format_args!(
        "{} bad pixels: {} hot, {} dead, {} unstable{several}",
        faults.count(),
        kinds[0],
        kinds[1],
        kinds[2]
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
