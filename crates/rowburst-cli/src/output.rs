//! Results on standard output.

use std::io::Write;

/// Writes a line of results to standard output; a reader that has gone away is no error.
pub fn print_line(line: impl std::fmt::Display) {
    let _ = writeln!(std::io::stdout(), "{line}");
}
