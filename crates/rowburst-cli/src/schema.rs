//! `rowburst schema`: the JSON Schemas of the experiment file and of `result.json`.

use crate::args::{SchemaArgs, SchemaOf};
use crate::output::print_line;
use rowburst::Result;

/// Prints the schema.
pub fn run(args: &SchemaArgs) -> Result<()> {
    match args.file {
        SchemaOf::Experiment => print_line(rowburst_io::experiment_schema().trim_end()),
        SchemaOf::Result => print_line(rowburst_run::RESULT_SCHEMA.trim_end()),
    }
    Ok(())
}
