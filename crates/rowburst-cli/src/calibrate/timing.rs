//! To be written.

use clap::Args;
use rowburst::Result;

/// To be written.
#[derive(Debug, Args)]
pub struct TimingArgs {}

pub fn run(_args: &TimingArgs) -> Result<()> {
    unimplemented!("{}", "timing")
}
