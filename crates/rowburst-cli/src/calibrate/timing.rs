//! `rowburst calibrate timing`: frames of a blinking light into row time, shutter and exposure.

mod files;

use crate::output::print_line;
use crate::shared_args::ForceArgs;
use clap::{Args, ValueHint};
use files::TimingFiles;
use rowburst::calibrate::timing::Timing;
use rowburst::{Error, Parameter, Result};
use rowburst_io::Calibration;
use rowburst_run::calibrate::timing::{exposure, row_time, shutter_names};
use rowburst_run::inputs::naming_file;
use rowburst_run::short;
use std::path::PathBuf;

/// Row time, shutter and exposure from frames of a blinking light.
///
/// The light lights all rows at once and changes in a known way: it blinks at a known
/// frequency, or follows a waveform given in a file.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  rowburst calibrate timing led.png --frequency-hz 1000 -o timing\n  rowburst calibrate timing led1.tif led2.tif --frequency-hz 2000 --duty 0.5 --dark dark.tif --experiment experiment.toml -o timing\n  rowburst calibrate timing chirp.tif --signal chirp.csv --json\nA line of chirp.csv is time_us,value: the light is a straight line from each to the next; two lines of one time are a step."
)]
pub struct TimingArgs {
    /// Frames of the light, all of one camera setting (.npy, .tif, .png, .h5, …; colour is averaged)
    #[arg(required = true, value_hint = ValueHint::FilePath)]
    pub frames: Vec<PathBuf>,
    /// Frequency of the light in hertz
    #[arg(
        long,
        required_unless_present = "signal",
        conflicts_with = "signal",
        allow_hyphen_values = true
    )]
    pub frequency_hz: Option<f64>,
    /// Duty cycle of a square wave, from 0 to 1; the exposure can be measured where it is not one half
    #[arg(long, requires = "frequency_hz", allow_hyphen_values = true)]
    pub duty: Option<f64>,
    /// The waveform of the light: a line time_us,value for each corner
    #[arg(long)]
    pub signal: Option<PathBuf>,
    /// Repeat the waveform from its last time on, instead of holding its last value
    #[arg(long, requires = "signal", conflicts_with = "frequency_hz")]
    pub repeat: bool,
    /// A frame without light, instead of the experiment's
    #[arg(long)]
    pub dark: Option<PathBuf>,
    /// A frame of even, steady light, instead of the experiment's
    #[arg(long)]
    pub flat: Option<PathBuf>,
    /// An experiment file to start from: its row time (within 30 %) resolves aliases, and the output
    /// folder gets a copy with the measured numbers
    #[arg(long)]
    pub experiment: Option<PathBuf>,
    /// Print timing.json to standard output instead of a summary
    #[arg(long)]
    pub json: bool,
    /// Folder for timing.json, report.html, plots and experiment.toml
    #[arg(short, long)]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub force: ForceArgs,
}

pub fn run(args: &TimingArgs) -> Result<()> {
    let folder = args
        .output
        .as_deref()
        .map(|path| args.force.claim(path, "calibrate timing"))
        .transpose()?;
    let files = TimingFiles::read(args)?;
    // Without a folder there is no copy of the experiment.
    let experiment = files.experiment.as_ref().filter(|_| folder.is_some());
    let calibrated = files.inputs.calibrate(experiment);
    let calibrated = calibrated.map_err(|e| naming(e, args, &files.calibration))?;
    if let Some(folder) = &folder {
        calibrated.write(folder, Some(&command_line(args)))?;
    }
    let timing = &calibrated.timing;
    for warning in &timing.warnings {
        eprintln!("warning: {warning}");
    }
    if args.json {
        let json = serde_json::to_string_pretty(&calibrated.summary);
        print_line(json.expect("plain numbers and text"));
    } else {
        print(timing, args);
    }
    Ok(())
}

/// Names the file or the option in an error of the library.
fn naming(error: Error, args: &TimingArgs, calibration: &Calibration) -> Error {
    let path_text = |path: &PathBuf| path.display().to_string();
    match (error.parameter(), error.index()) {
        (Some(Parameter::Frames), Some(frame)) => match args.frames.get(frame) {
            Some(path) => error.named(path_text(path)),
            None => error,
        },
        (Some(Parameter::Frames), None) => {
            let names: Vec<_> = args.frames.iter().map(path_text).collect();
            error.named(names.join(", "))
        }
        (Some(Parameter::Signal), _) => {
            let path = args.signal.as_ref().map(path_text);
            error.named(path.unwrap_or_default())
        }
        (Some(Parameter::ExpectedRowTimeUs), _) => error.named("[camera] row_time_us"),
        (Some(Parameter::Duty | Parameter::FrequencyHz), _) => error,
        _ => naming_file(error, &args.frames[0], calibration),
    }
}

fn print(timing: &Timing, args: &TimingArgs) {
    print_line(format!("row time  {}", row_time(timing)));
    print_line(format!("shutter   {}", shutter_names(timing)));
    if let Some(advice) = &timing.advice {
        print_line(format!("          {advice}"));
    }
    print_line(format!("exposure  {}", exposure(timing)));
    print_line(format!("          {}", timing.exposure_basis));
    print_line(format!("readout   {} ms", short(timing.readout_ms)));
    if let Some(output) = &args.output {
        print_line(format!(
            "written   {}",
            output.join("report.html").display()
        ));
    }
}

fn command_line(args: &TimingArgs) -> String {
    let mut line = "rowburst calibrate timing".to_string();
    for frame in &args.frames {
        line += &format!(" {}", frame.display());
    }
    let numbers = [("--frequency-hz", args.frequency_hz), ("--duty", args.duty)];
    for (flag, number) in numbers {
        if let Some(number) = number {
            line += &format!(" {flag} {number}");
        }
    }
    let paths = [
        ("--signal", &args.signal),
        ("--dark", &args.dark),
        ("--flat", &args.flat),
        ("--experiment", &args.experiment),
        ("-o", &args.output),
    ];
    for (flag, path) in paths {
        if let Some(path) = path {
            line += &format!(" {flag} {}", path.display());
        }
    }
    if args.repeat {
        line += " --repeat";
    }
    line
}
