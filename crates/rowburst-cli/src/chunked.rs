//! `rowburst reconstruct --bins` and `--part-bins`: a range of bins, and a video part by part.

use crate::args::ReconstructArgs;
use crate::outcome::say;
use crate::progress::ChunkBar;
use rowburst::reconstruct::Verdict;
use rowburst::{Error, Result};
use rowburst_io::OutputFolder;
use rowburst_run::{ChunkedTask, PartsOutcome, run_chunked, short, thousands};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A range of bins, `FIRST..END`.
pub fn bins_of(text: &str) -> Result<Range<usize>> {
    let ends = text
        .split_once("..")
        .map(|(a, b)| (a.trim().parse(), b.trim().parse()));
    match ends {
        Some((Ok(first), Ok(end))) => Ok(first..end),
        _ => Err(Error::input(
            "--bins",
            format!("\"{text}\""),
            "a range is its first bin and the one after its last, FIRST..END",
            "Give for example --bins 0..32.",
        )),
    }
}

/// A video that is found part by part, with a bar.
pub fn run(
    task: &ChunkedTask,
    folder: &OutputFolder,
    stop: Arc<AtomicBool>,
) -> Result<PartsOutcome> {
    let mut bar = ChunkBar::new(stop);
    let outcome = run_chunked(task, folder, &mut |part, bins, progress| {
        bar.show(part, bins, progress)
    });
    bar.finish();
    outcome
}

/// Says what was found.
pub fn print_summary(outcome: &PartsOutcome, args: &ReconstructArgs) -> Result<()> {
    if args.json {
        say(serde_json::to_string_pretty(outcome).expect("plain numbers and text"));
        return Ok(());
    }
    say(format_args!(
        "{} frames of {}×{} at {} fps from one frame, in {} parts and {:.1} s ({} s a bin)",
        outcome.frames,
        outcome.rows,
        outcome.columns,
        thousands(outcome.frame_rate_hz),
        outcome.parts.len(),
        outcome.seconds,
        short(outcome.seconds_per_bin),
    ));
    say(format_args!(
        "residual/σ {:.3}, σ {} ({}), prior {}",
        outcome.residual_over_sigma,
        short(outcome.noise_sigma),
        outcome.noise_sigma_source,
        outcome.prior,
    ));
    if outcome.fit == Verdict::Good.name() {
        say(format_args!("the fit is good: {}", outcome.fit_reason));
    }
    for warning in &outcome.warnings {
        say(format_args!("warning: {warning}"));
    }
    say(format_args!(
        "open {}",
        args.output.join("report.html").display()
    ));
    Ok(())
}
