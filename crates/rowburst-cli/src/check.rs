//! `rowburst check`: is a set-up good?

use crate::inputs::calibration_from_args;
use crate::output::print_line;
use crate::progress::{Bar, Interrupt, Kept};
use crate::shared_args::CalibrationArgs;
use clap::Args;
use rowburst::error::Subject;
use rowburst::{Error, Result};
use rowburst_io::OutputFolder;
use rowburst_run::{CheckParams, short};
use std::path::PathBuf;
use std::sync::Arc;

/// Tell by one frame of a blinking light whether a set-up is good.
///
/// The light is one point that blinks at a known frequency behind the diffuser. Row time, readout order, saturation,
/// contrast and model error are each compared with a limit. Exit status 1 where one fails.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst check psf/experiment.toml --frame led.tif --frequency-hz 20000 -o check"
)]
pub struct CheckArgs {
    /// The experiment file with its PSF
    pub experiment: PathBuf,
    /// A frame of the light (.npy, .tif, …)
    #[arg(long)]
    pub frame: PathBuf,
    /// Frequency of the light in hertz, below 0.45 of the video's frame rate
    #[arg(long, allow_hyphen_values = true)]
    pub frequency_hz: f64,
    #[command(flatten)]
    pub calibration: CalibrationArgs,
    /// Print the findings as JSON
    #[arg(long)]
    pub json: bool,
    /// Also keep the findings in this folder, as check.json: rowburst status reads them
    #[arg(short, long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,
}

pub fn run(args: &CheckArgs) -> Result<()> {
    let interrupt = Interrupt::listen(Kept::Result);
    let mut bar = Bar::new(Arc::clone(&interrupt.run));
    let params = CheckParams {
        experiment: &args.experiment,
        frame: &args.frame,
        calibration: calibration_from_args(&args.calibration),
        frequency_hz: args.frequency_hz,
        cancel: Arc::clone(&interrupt.run).into(),
    };
    let found = params.run(&mut |event| bar.show(event));
    bar.finish();
    let found = found?;
    // An interrupted run has compared nothing.
    rowburst::Cancel::from(Arc::clone(&interrupt.run)).check()?;
    let json = serde_json::to_string_pretty(&found).expect("plain numbers and text");
    if let Some(folder) = &args.output {
        OutputFolder::create(folder)?.write_bytes("check.json", json.as_bytes())?;
    }
    if args.json {
        print_line(json);
    } else {
        for check in &found.checks {
            let word = if check.passed { "pass" } else { "FAIL" };
            print_line(format_args!(
                "{word}  {:<11} {} (limit {})",
                check.name,
                check.found,
                short(check.limit)
            ));
            if !check.passed {
                print_line(format_args!("                  {}", check.remedy));
            }
        }
    }
    if found.passed {
        return Ok(());
    }
    let failed = found.checks.iter().filter(|c| !c.passed).map(|c| c.name);
    let failed: Vec<_> = failed.collect();
    Err(Error::work(
        Subject::named("the set-up"),
        format!("{} is not within its limit", failed.join(", ")),
        "Follow the remedies above.",
    ))
}
