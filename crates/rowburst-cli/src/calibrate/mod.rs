//! `rowburst calibrate`: a lab's own captures into an experiment that reconstructs well.

mod psf;
mod sensor;
mod timing;

use clap::{Args, Subcommand};
use rowburst::Result;

/// Calibrate a camera and a diffuser from captures of your own.
#[derive(Debug, Args)]
pub struct CalibrateArgs {
    #[command(subcommand)]
    pub what: What,
}

#[derive(Debug, Subcommand)]
pub enum What {
    /// Bias, noise, gain, full well and bad pixels from dark and flat frames
    Sensor(sensor::SensorArgs),
    /// PSF and its quality from captures of a point source; patches from several places
    Psf(psf::PsfArgs),
    /// Row time, shutter and exposure from frames of a blinking light
    Timing(timing::TimingArgs),
}

pub fn run(args: &CalibrateArgs) -> Result<()> {
    match &args.what {
        What::Sensor(args) => sensor::run(args),
        What::Psf(args) => psf::run(args),
        What::Timing(args) => timing::run(args),
    }
}
