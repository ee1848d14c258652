//! `rowburst reconstruct --bins` and `--part-bins`: a range of bins, and a video part by part.

use crate::args::ReconstructArgs;
use crate::output::print_line;
use crate::progress::ChunkBar;
use rowburst::reconstruct::Verdict;
use rowburst::{Error, Parameter, Result};
use rowburst_io::OutputFolder;
use rowburst_run::{ChunkedSummary, ChunkedTask, run_chunked, short, thousands};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A range of bins, `FIRST..END`.
pub fn parse_bins(text: &str) -> Result<Range<usize>> {
    let ends = text
        .split_once("..")
        .map(|(a, b)| (a.trim().parse(), b.trim().parse()));
    match ends {
        Some((Ok(first), Ok(end))) => Ok(first..end),
        _ => Err(Error::input(
            Parameter::Bins,
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
) -> Result<ChunkedSummary> {
    let mut bar = ChunkBar::new(stop);
    let summary = run_chunked(task, folder, &mut |part, bins, progress| {
        bar.show(part, bins, progress)
    });
    bar.finish();
    summary
}

/// Says what was found.
pub fn print_summary(summary: &ChunkedSummary, args: &ReconstructArgs) -> Result<()> {
    if args.json {
        print_line(serde_json::to_string_pretty(summary).expect("plain numbers and text"));
        return Ok(());
    }
    print_line(format_args!(
        "{} frames of {}×{} at {} fps from one frame, in {} chunks and {:.1} s ({} s per bin)",
        summary.frames,
        summary.rows,
        summary.columns,
        thousands(summary.frame_rate_hz),
        summary.parts.len(),
        summary.seconds,
        short(summary.seconds_per_bin),
    ));
    print_line(format_args!(
        "residual/σ {:.3}, σ {} ({}), prior {}",
        summary.residual_over_sigma,
        short(summary.noise_sigma),
        summary.noise_sigma_source,
        summary.prior,
    ));
    if summary.fit == Verdict::Good.name() {
        print_line(format_args!("the fit is good: {}", summary.fit_reason));
    }
    for warning in &summary.warnings {
        print_line(format_args!("warning: {warning}"));
    }
    print_line(format_args!(
        "open {}",
        args.output.join("report.html").display()
    ));
    Ok(())
}
