//! The command `rowburst`: one rolling-shutter frame in, a 100,000 fps video out.
//!
//! Turns arguments into calls of the library and writes files; it holds no maths. Results go to
//! standard output, messages to standard error. Exit status: 0 success, 1 the work failed, 2 the
//! input or the command line is wrong, 130 Ctrl-C.

mod args;
#[cfg(feature = "batch")]
mod batch;
#[cfg(feature = "view")]
mod browser;
mod calibrate;
mod capture;
mod check;
mod cite;
#[cfg(feature = "batch")]
mod cluster;
mod demo;
mod design;
mod figure;
mod init;
mod inputs;
#[cfg(feature = "view")]
mod live;
mod log;
mod option_names;
mod output;
mod progress;
mod project;
mod reconstruct;
mod rerun;
mod schema;
mod shared_args;
mod shell;
mod simulate;
mod sweep;
#[cfg(feature = "view")]
mod view;

use args::{Cli, Verb};
use clap::Parser;
use rowburst::ErrorKind;
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
    if let Some(threads) = cli.threads {
        let _ = THREADS.set(threads);
    }
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(cli.threads.map_or(0, usize::from))
        .stack_size(STACK_BYTES)
        .build();
    match pool {
        Ok(pool) => pool.install(|| run_verb(cli, process_start)),
        Err(error) => {
            eprintln!("error: no threads: {error}");
            1
        }
    }
}

/// Stack of a thread: that of a main thread.
const STACK_BYTES: usize = 8 << 20;

/// Runs the command on the threads of the present pool; the exit status.
fn run_verb(cli: Cli, process_start: Instant) -> u8 {
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
        #[cfg(not(feature = "batch"))]
        Verb::Batch(_) => Err(left_out()),
        #[cfg(feature = "view")]
        Verb::View(args) => view::run(&args),
        Verb::Rerun(args) => rerun::run(&args, process_start),
        Verb::Cite(args) => cite::run(&args),
        Verb::Figure(args) => figure::run(&args),
        Verb::Calibrate(args) => calibrate::run(&args),
        Verb::Design(args) => design::run(&args),
        Verb::New(args) => project::create(&args),
        Verb::Status(args) => project::status(&args),
        Verb::Check(args) => check::run(&args),
        Verb::Capture(args) => capture::run(&args),
        #[cfg(feature = "view")]
        Verb::Live(args) => live::run(&args),
        Verb::Schema(args) => schema::run(&args),
        Verb::Completions(args) => shell::completions(&args),
        Verb::Man(args) => shell::man(&args),
    });
    match done {
        Ok(()) if progress::is_interrupted() => progress::INTERRUPTED,
        Ok(()) => 0,
        Err(error) if progress::is_interrupted() && error.kind() == ErrorKind::Cancelled => {
            eprintln!("{}", option_names::message(&error));
            progress::INTERRUPTED
        }
        Err(error) => {
            eprintln!("error: {}", option_names::message(&error));
            if error.is_input() { 2 } else { 1 }
        }
    }
}

/// What `batch` says where it is not in this build.
#[cfg(not(feature = "batch"))]
fn left_out() -> rowburst::Error {
    rowburst::Error::input(
        rowburst::error::Subject::default(),
        "a command that is not in this build",
        "it brings the Zarr archive, which takes long to compile",
        "Build it in: cargo install --locked --path crates/rowburst-cli --features batch. Releases and the Python package have it.",
    )
    .within("rowburst batch")
}

/// What was typed, for reports that repeat it.
static TYPED: OnceLock<Vec<OsString>> = OnceLock::new();

/// The number of threads where it was typed, for the same.
static THREADS: OnceLock<u16> = OnceLock::new();

fn typed(arguments: Vec<OsString>) -> &'static [OsString] {
    TYPED.get_or_init(|| arguments)
}
