//! To be written.

use clap::Args;
use rowburst::Result;

/// To be written.
#[derive(Debug, Args)]
pub struct SensorArgs {}

pub fn run(_args: &SensorArgs) -> Result<()> {
    unimplemented!("{}", "sensor")
}
