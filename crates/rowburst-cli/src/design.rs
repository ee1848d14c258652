//! To be written.

use clap::Args;
use rowburst::Result;

/// To be written.
#[derive(Debug, Args)]
pub struct DesignArgs {}

pub fn run(_args: &DesignArgs) -> Result<()> {
    unimplemented!("design")
}
