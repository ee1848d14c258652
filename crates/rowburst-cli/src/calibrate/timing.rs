//! `rowburst calibrate timing`: frames of a blinking light into row time, shutter and exposure.

mod files;
mod sheet;

use crate::output::print_line;
use clap::{Args, ValueHint};
use files::TimingInputs;
use rowburst::calibrate::timing::{Lamp, Timing, TimingParams, calibrate};
use rowburst::{Error, Result};
use rowburst_io::OutputFolder;
use rowburst_run::inputs::naming_file;
use rowburst_run::short;
use serde::Serialize;
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
}

/// Everything that `timing.json` says.
#[derive(Debug, Serialize)]
struct TimingSummary {
    version: &'static str,
    row_time_us: f64,
    row_time_us_error: f64,
    shutters: Vec<&'static str>,
    exposure_us: Option<f64>,
    exposure_us_error: Option<f64>,
    exposure_basis: String,
    readout_ms: f64,
    /// Periods of the light during the readout; null for a course from a file.
    periods: Option<f64>,
    /// Of each frame, the part of a period since the light's maximum when row time 0 ends;
    /// null for a course from a file.
    phases: Option<Vec<f64>>,
    /// The same moment on the clock of the file; null for a light of known frequency.
    time_offsets_us: Option<Vec<f64>>,
    modulation_depth: f64,
    explained_variance: f64,
    candidates: Vec<CandidateSummary>,
    frames: usize,
    rows: usize,
    columns: usize,
    warnings: Vec<String>,
    /// The light that would decide between the shutters left; null where one is left.
    advice: Option<String>,
}

#[derive(Debug, Serialize)]
struct CandidateSummary {
    shutter: &'static str,
    row_time_us: f64,
    chi2_per_freedom: f64,
    chi2_excess: f64,
    left: bool,
}

pub fn run(args: &TimingArgs) -> Result<()> {
    let folder = args
        .output
        .as_deref()
        .map(OutputFolder::create)
        .transpose()?;
    let inputs = TimingInputs::read(args)?;
    let params = TimingParams {
        dark: inputs.dark.clone(),
        flat: inputs.flat.clone(),
        saturation_counts: inputs.saturation_counts,
        expected_row_time_us: inputs.expected_row_time_us,
        ..TimingParams::default()
    };
    let mut timing =
        calibrate(&inputs.frames, &inputs.light, &params).map_err(|e| naming(e, args, &inputs))?;
    timing.warnings.extend(inputs.warnings.iter().cloned());
    let written = match &folder {
        Some(folder) => inputs.experiment_with(&timing, folder),
        None => None,
    };
    if let Some((_, notes)) = &written {
        timing.warnings.extend(notes.iter().cloned());
    }
    let summary = summary(&timing, &inputs);
    let json = serde_json::to_string_pretty(&summary).expect("plain numbers and text");
    if let Some(folder) = &folder {
        // That of an earlier run would vouch for files that are no longer its own.
        folder.remove("timing.json")?;
        sheet::write(folder, args, &timing, written.is_some())?;
        if let Some((experiment, _)) = &written {
            inputs.write_experiment(folder, experiment)?;
        }
        folder.write_bytes("timing.json", format!("{json}\n").as_bytes())?;
    }
    for warning in &timing.warnings {
        eprintln!("warning: {warning}");
    }
    if args.json {
        print_line(json);
    } else {
        print(&timing, args);
    }
    Ok(())
}

/// Names the file or the option in an error of the library.
fn naming(mut error: Error, args: &TimingArgs, inputs: &TimingInputs) -> Error {
    if let Error::Input { subject, .. } = &mut error {
        let number = subject
            .strip_prefix("frame ")
            .and_then(|n| n.parse::<usize>().ok());
        if let Some(path) = number.and_then(|n| args.frames.get(n - 1)) {
            *subject = path.display().to_string();
            return error;
        }
        match subject.as_str() {
            "frames" => {
                let names: Vec<_> = args
                    .frames
                    .iter()
                    .map(|p| p.display().to_string())
                    .collect();
                *subject = names.join(", ");
                return error;
            }
            "signal" => {
                let path = args.signal.as_ref().map(|p| p.display().to_string());
                *subject = path.unwrap_or_default();
            }
            "duty" => *subject = "--duty".into(),
            "expected_row_time_us" => *subject = "[camera] row_time_us".into(),
            text if text.starts_with("frequency_hz") => {
                *subject = format!(
                    "--frequency-hz{}",
                    text.trim_start_matches("frequency_hz").replace(" = ", " ")
                );
            }
            _ => return naming_file(error, &args.frames[0], &inputs.calibration),
        }
    }
    error
}

fn summary(timing: &Timing, inputs: &TimingInputs) -> TimingSummary {
    let periodic = matches!(inputs.light, Lamp::Periodic { .. });
    let phases = timing.phases.clone();
    TimingSummary {
        version: env!("CARGO_PKG_VERSION"),
        row_time_us: timing.row_time_us,
        row_time_us_error: timing.row_time_us_error,
        shutters: timing.shutters.iter().map(|s| s.name()).collect(),
        exposure_us: timing.exposure_us.map(|e| e.0),
        exposure_us_error: timing.exposure_us.map(|e| e.1),
        exposure_basis: timing.exposure_basis.clone(),
        readout_ms: timing.readout_ms,
        periods: timing.periods,
        phases: periodic.then(|| phases.clone()),
        time_offsets_us: (!periodic).then_some(phases),
        modulation_depth: timing.modulation_depth,
        explained_variance: timing.explained,
        candidates: timing
            .candidates
            .iter()
            .map(|c| CandidateSummary {
                shutter: c.shutter.name(),
                row_time_us: c.row_time_us,
                chi2_per_freedom: c.chi2,
                chi2_excess: c.excess,
                left: c.is_consistent,
            })
            .collect(),
        frames: inputs.frames.len(),
        rows: inputs.frames[0].rows(),
        columns: inputs.frames[0].columns(),
        warnings: timing.warnings.clone(),
        advice: timing.advice.clone(),
    }
}

fn names(timing: &Timing) -> String {
    let names: Vec<&str> = timing.shutters.iter().map(|s| s.name()).collect();
    names.join(" or ")
}

fn row_time(timing: &Timing) -> String {
    with_error(timing.row_time_us, timing.row_time_us_error)
}

/// A value with the digits that its error leaves.
fn with_error(value: f64, error: f64) -> String {
    if !error.is_finite() {
        return format!("{} µs", short(value));
    }
    let digits = (1.0 - error.max(1e-9).log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{value:.digits$} ± {error:.digits$} µs")
}

fn exposure(timing: &Timing) -> String {
    match timing.exposure_us {
        Some((value, error)) => with_error(value, error),
        None => "not shown".into(),
    }
}

fn print(timing: &Timing, args: &TimingArgs) {
    print_line(format!("row time  {}", row_time(timing)));
    print_line(format!("shutter   {}", names(timing)));
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
