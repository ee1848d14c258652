//! `rowburst batch --scheduler`: the same batch on the workers of a Dask scheduler.
//!
//! The engine is Dask, which lives in Python: this hands the work to `python3 -m rowburst.dask`, whose
//! workers run the code of `rowburst batch` on parts of the same archive.

use crate::args::BatchArgs;
use rowburst::error::Subject;
use rowburst::{Error, Result};
use std::ffi::OsString;
use std::path::Path;
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// Names the Python that has the package, where it is not `python3`.
const PYTHON: &str = "ROWBURST_PYTHON";

/// Has the workers of `scheduler` make what is left of the batch.
pub fn run(args: &BatchArgs, scheduler: &str) -> Result<()> {
    let python = std::env::var_os(PYTHON).unwrap_or_else(|| "python3".into());
    check_package(&python)?;
    // What it says of the result is said again, as without a scheduler.
    let status = Command::new(&python)
        .args(["-m", "rowburst.dask"])
        .args(dask_arguments(args, scheduler))
        .stdout(Stdio::null())
        .status();
    match status {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(Error::work(
            Subject::named(scheduler),
            format!("the run on the cluster ended with {status}"),
            "Finished frames are kept; run the same command to resume.",
        )),
        Err(error) => Err(Error::work(
            PathBuf::from(python),
            error,
            "Check that it can be run.",
        )),
    }
}

fn check_package(python: &OsString) -> Result<()> {
    let asked = Command::new(python)
        .args(["-c", "import distributed, rowburst.dask"])
        .stdin(Stdio::null())
        .output();
    let why = match asked {
        Ok(output) if output.status.success() => return Ok(()),
        Ok(output) => {
            let text = String::from_utf8_lossy(&output.stderr).into_owned();
            text.lines().last().unwrap_or("no reason given").to_string()
        }
        Err(error) => error.to_string(),
    };
    Err(Error::work(
        Subject::named("--scheduler"),
        format!(
            "{} has no package rowburst with Dask ({why})",
            python.display()
        ),
        format!(
            "Run pip install 'rowburst[dask]', or set {PYTHON} to the Python that has it; without a scheduler no Python is needed."
        ),
    ))
}

/// The arguments as `rowburst.dask` has them.
fn dask_arguments(args: &BatchArgs, scheduler: &str) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = vec![args.experiment.clone().into()];
    let mut option = |name: &str, value: Option<OsString>| {
        if let Some(value) = value {
            // In one word: a value may begin with a minus.
            let mut word = OsString::from(format!("--{name}="));
            word.push(value);
            arguments.push(word);
        }
    };
    let path = |path: &Path| Some(path.as_os_str().to_owned());
    let of = |path: &Option<std::path::PathBuf>| path.clone().map(OsString::from);
    let number = |value: Option<f64>| value.map(|v| v.to_string().into());
    option("frames", path(&args.frames));
    option("output", path(&args.output));
    option("scheduler", Some(scheduler.into()));
    option("psf", of(&args.calibration.psf));
    option("dark", of(&args.calibration.dark));
    option("flat", of(&args.calibration.flat));
    option("bad-pixels", of(&args.calibration.bad_pixels));
    option("prior", args.prior.clone().map(OsString::from));
    option("tau", args.tau.clone().map(OsString::from));
    option("noise-sigma", number(args.noise_sigma));
    option(
        "max-iterations",
        args.max_iterations.map(|n| n.to_string().into()),
    );
    option("frame-period-us", number(args.frame_period_us));
    option(
        "self-calibrate",
        args.self_calibrate.clone().map(OsString::from),
    );
    if args.keep_all_pixels {
        arguments.push("--keep-all-pixels".into());
    }
    if args.retry_failed {
        arguments.push("--retry-failed".into());
    }
    arguments
}
