//! `rowburst cite`: the methods of a result, for a paper.

use crate::args::CiteArgs;
use crate::output::print_line;
use rowburst::Result;

pub fn run(args: &CiteArgs) -> Result<()> {
    print_line(rowburst_run::cite(&args.result)?);
    Ok(())
}
