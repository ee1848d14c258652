//! `rowburst`: one rolling-shutter frame in, a 100,000 fps video out.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(rowburst_cli::run(std::env::args_os().collect()))
}
