//! The command `rowburst`: one rolling-shutter frame in, a 100,000 fps video out.
//!
//! Turns arguments into calls of the library and writes files; it holds no maths. Results go to
//! standard output, messages to standard error. Exit status: 0 success, 1 the work failed, 2 the
//! input or the command line is wrong.

mod args;
#[cfg(feature = "batch")]
mod batch;
mod calibrate;
#[cfg(feature = "batch")]
mod cluster;
mod demo;
mod design;
mod figure;
mod init;
mod inputs;
mod log;
mod output;
mod progress;
mod reconstruct;
mod schema;
mod shared_args;
mod shell;
mod simulate;
mod sweep;
#[cfg(feature = "view")]
mod view;

use args::{Cli, Verb};
use clap::Parser;
use rowburst::Error;
use std::ffi::OsString;
use std::sync::OnceLock;
use std::time::Instant;

/// Runs the command with its arguments, of which the first is the name of the program; the exit status.
pub fn run(arguments: Vec<OsString>) -> u8 {
    let process_start = Instant::now();
    let cli = Cli::parse_from(typed(arguments));
    if cli.verbose {
        log::start(process_start);
    }
    if let Some(threads) = cli.threads
        && let Err(error) = rayon::ThreadPoolBuilder::new()
            .num_threads(threads.into())
            .build_global()
    {
        eprintln!("error: --threads {threads}: {error}");
        return 1;
    }
    if cli.verbose {
        log::describe_machine();
    }
    let done = rowburst::vecmath::check_environment().and_then(|()| match cli.verb {
        Verb::Demo(args) => demo::run(&args, process_start),
        Verb::Init(args) => init::run(&args),
        Verb::Simulate(args) => simulate::run(&args),
        Verb::Reconstruct(args) => reconstruct::run(&args, process_start),
        #[cfg(feature = "batch")]
        Verb::Batch(args) => batch::run(&args, cli.threads),
        #[cfg(feature = "view")]
        Verb::View(args) => view::run(&args),
        Verb::Figure(args) => figure::run(&args),
        Verb::Calibrate(args) => calibrate::run(&args),
        Verb::Design(args) => design::run(&args),
        Verb::Schema(args) => schema::run(&args),
        Verb::Completions(args) => shell::completions(&args),
        Verb::Man(args) => shell::man(&args),
    });
    match done {
        Ok(()) => 0,
        Err(error) => {
            eprintln!("error: {error}");
            match error {
                Error::Input { .. } => 2,
                Error::Work { .. } => 1,
            }
        }
    }
}

/// What was typed, for reports that repeat it.
static TYPED: OnceLock<Vec<OsString>> = OnceLock::new();

fn typed(arguments: Vec<OsString>) -> &'static [OsString] {
    TYPED.get_or_init(|| arguments)
}
