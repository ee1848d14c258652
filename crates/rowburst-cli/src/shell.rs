//! `rowburst completions` and `rowburst man`: the command line for shells and for `man`.

use crate::args::{Cli, CompletionsArgs, ManArgs};
use crate::output::print_line;
use clap::{Command, CommandFactory};
use rowburst::{Error, Result};
use rowburst_io::OutputFolder;
use std::io::Write;

/// Prints the script that completes commands in a shell.
pub fn completions(args: &CompletionsArgs) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "rowburst", &mut script);
    // A reader that has gone away is no error.
    let _ = std::io::stdout().write_all(&script);
    Ok(())
}

/// Writes a manual page for the program and for each verb.
pub fn man(args: &ManArgs) -> Result<()> {
    let folder = OutputFolder::create(&args.output)?;
    let mut command = Cli::command().disable_help_subcommand(true);
    command.build();
    write_pages(&command, &folder)?;
    print_line(args.output.display());
    Ok(())
}

fn write_pages(command: &Command, folder: &OutputFolder) -> Result<()> {
    let page = clap_mangen::Man::new(command.clone());
    folder.write(&page.get_filename(), |w| {
        let failed = |e: std::io::Error| {
            Error::work(
                rowburst::error::Subject::named("the manual page"),
                e,
                "Try another folder.",
            )
        };
        page.render(w).map_err(failed)
    })?;
    command
        .get_subcommands()
        .try_for_each(|verb| write_pages(verb, folder))
}
