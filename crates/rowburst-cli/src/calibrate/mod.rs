//! `rowburst calibrate`: a lab's own captures into an experiment that reconstructs well.

mod psf;
mod sensor;
mod timing;

use clap::{Args, Subcommand};
use rowburst::Result;
use rowburst_io::{Experiment, read_metadata};
use std::path::{Path, PathBuf};

/// Calibrate a camera and a diffuser from captures of your own.
#[derive(Debug, Args)]
pub struct CalibrateArgs {
    #[command(subcommand)]
    pub verb: CalibrateVerb,
}

#[derive(Debug, Subcommand)]
pub enum CalibrateVerb {
    /// Bias, noise, gain, full well and bad pixels from dark and flat frames
    Sensor(sensor::SensorArgs),
    /// PSF and its quality from captures of a point source; patches from several positions
    Psf(psf::PsfArgs),
    /// Row time, shutter and exposure from frames of a blinking light
    Timing(timing::TimingArgs),
}

/// The experiment, which must not agree with calibration captures in exposure or size: their
/// metadata is asked only where the file alone leaves something open.
fn experiment_of(path: &Path, captures: &[PathBuf]) -> Result<Experiment> {
    let alone = Experiment::read(path);
    let (Err(error), Some(first)) = (&alone, captures.first()) else {
        return alone;
    };
    let metadata = read_metadata(first);
    let filled = Experiment::read_with(path, &metadata);
    let filled = filled.map_err(|_| error.clone())?;
    if let Some(from_metadata) = filled.from_metadata.summary_line() {
        eprintln!("{from_metadata}");
    }
    Ok(filled)
}

pub fn run(args: &CalibrateArgs) -> Result<()> {
    match &args.verb {
        CalibrateVerb::Sensor(args) => sensor::run(args),
        CalibrateVerb::Psf(args) => psf::run(args),
        CalibrateVerb::Timing(args) => timing::run(args),
    }
}
