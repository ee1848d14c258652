//! To be written.

use clap::Args;
use rowburst::Result;

/// To be written.
#[derive(Debug, Args)]
pub struct PsfArgs {}

pub fn run(_args: &PsfArgs) -> Result<()> {
    unimplemented!("{}", "psf")
}
