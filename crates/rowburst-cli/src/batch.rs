//! `rowburst batch`: a recording in, one archive of videos out.

use crate::args::BatchArgs;
use crate::inputs::calibration_from_args;
use crate::option_names::CommandLine;
use crate::output::print_line;
use crate::progress::{Interrupt, Kept, print_note};
use crate::shared_args::ForceArgs;
use crate::sweep;
use indicatif::{ProgressBar, ProgressStyle};
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_batch::{
    Batch, BatchFiles, BatchInputs, ChosenPrior, Event, FrameRow, RetryPolicy, Status,
    ThreadAllocation, load_batch, name_correction_file,
};
use rowburst_io::{Calibration, Frames, FromMetadata, gaps};
use rowburst_run::options::{UserOptions, parse_prior, parse_tau};
use rowburst_run::{
    MetadataNumbers, SweepRow, is_logging, peak_memory_bytes, short, sweep_label, sweep_lines,
    sweep_path,
};
use serde::Serialize;
use std::io::IsTerminal;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What a run of `batch` ends with.
#[derive(Debug, Serialize)]
struct BatchSummary {
    version: &'static str,
    archive: String,
    table: String,
    stitched: Option<String>,
    /// In the recording.
    frames: usize,
    /// With a video, and without, by this run and all before.
    done: usize,
    failed: usize,
    /// Neither.
    left: usize,
    /// Through by this run.
    frames_this_run: usize,
    failed_this_run: usize,
    prior: String,
    prior_reason: String,
    prior_frame: Option<usize>,
    /// What the recording has corrected of PSF and camera; null: they were used as given.
    self_calibration: Option<serde_json::Value>,
    /// The frames that this was found from.
    self_calibration_frames: Vec<usize>,
    metadata: MetadataNumbers,
    frame_period_us: Option<f64>,
    dead_us: Option<f64>,
    threads: usize,
    frames_at_once: usize,
    threads_per_frame: usize,
    /// What all frames share, and the choice of the prior.
    setup_seconds: f64,
    /// The frames.
    seconds: f64,
    frames_per_second: Option<f64>,
    peak_memory_bytes: Option<u64>,
    warnings: Vec<String>,
}

/// `threads` are those that were asked for.
pub fn run(args: &BatchArgs, threads: Option<u16>) -> Result<()> {
    if let (Some(threads), Some(_)) = (threads, &args.scheduler) {
        return Err(Error::input(
            Parameter::Threads,
            threads,
            "with --scheduler the workers reconstruct the frames, with their own threads",
            "Leave it out, and start the workers with dask worker --nthreads.",
        ));
    }
    let cancel = Cancel::from(Interrupt::listen(Kept::Frames).run);
    if !args.sweep.is_empty() {
        return run_sweep(args, &cancel);
    }
    let (summary, _) = run_one(args, &cancel)?;
    if args.json {
        print_line(serde_json::to_string_pretty(&summary).expect("plain numbers and text"));
    } else {
        print_summary(&summary);
    }
    refuse_failed(&args.output, summary.failed)
}

/// Frames that failed are an exit status of 1, whatever the others are. The archive stays.
fn refuse_failed(archive: &Path, failed: usize) -> Result<()> {
    if failed == 0 {
        return Ok(());
    }
    Err(Error::work(
        archive,
        format!("{failed} frames failed; the others have their videos"),
        format!(
            "See {}/rowburst/frames.csv; --retry-failed tries them again.",
            archive.display()
        ),
    ))
}

/// A batch for each point of the sweep, each into an archive of its own; killed, the same command
/// goes on.
fn run_sweep(args: &BatchArgs, cancel: &Cancel) -> Result<()> {
    let points = sweep::points(&args.sweep)?;
    let runs = points.iter().map(|point| {
        let mut point_args = args.clone();
        point_args.sweep.clear();
        point_args.output = sweep_path(&args.output, &sweep_label(point), ".zarr");
        for (key, value) in point {
            match *key {
                "prior" => {
                    parse_prior(value)?;
                    point_args.prior = Some(value.clone());
                }
                "tau" => {
                    parse_tau(value)?;
                    point_args.tau = Some(value.clone());
                }
                "noise-sigma" => point_args.noise_sigma = Some(sweep::parse_number(key, value)?),
                _ => point_args.max_iterations = Some(sweep::parse_count(key, value)?),
            }
        }
        Ok((sweep_label(point), point_args))
    });
    // A value that is none is found before the first run, which may take hours.
    let runs: Vec<(String, BatchArgs)> = runs.collect::<Result<_>>()?;
    let folder = rowburst_io::OutputFolder::create(&args.output)?;
    let mut rows: Vec<SweepRow> = Vec::new();
    let mut failed = 0;
    for (point, point_args) in runs {
        eprintln!("{point}");
        let (summary, lines) = run_one(&point_args, cancel)?;
        failed += summary.failed;
        let done: Vec<&FrameRow> = lines.iter().filter(|l| l.status == Status::Done).collect();
        let good = done.iter().filter(|l| l.fit.as_deref() == Some("good"));
        rows.push(SweepRow {
            point,
            output: point_args.output.display().to_string(),
            prior: Some(summary.prior),
            tau: median(done.iter().filter_map(|l| l.tau)),
            residual_over_sigma: median(done.iter().filter_map(|l| l.residual_over_sigma)),
            psnr_db: None,
            ssim: None,
            fit: Some(format!("{} of {} good", good.count(), lines.len())),
            seconds: done.iter().map(|l| l.seconds).sum(),
            error: None,
        });
    }
    // An archive knows itself whether it is of the same batch.
    let table = sweep::write(folder.path(), ForceArgs { force: true }, &rows)?;
    if args.json {
        print_line(serde_json::to_string_pretty(&rows).expect("plain numbers and text"));
    } else {
        sweep_lines(&rows).into_iter().for_each(print_line);
        print_line(format!(
            "table, with medians over the frames: {}",
            table.display()
        ));
    }
    refuse_failed(&args.output, failed)
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let n = values.len();
    (n > 0).then(|| 0.5 * (values[(n - 1) / 2] + values[n / 2]))
}

/// One batch, through; the lines of its frames.
fn run_one(args: &BatchArgs, cancel: &Cancel) -> Result<(BatchSummary, Vec<FrameRow>)> {
    let began = Instant::now();
    let (inputs, calibration, from_metadata) = load_input(args, cancel)?;
    let batch = Batch::open(inputs, &args.output)
        .map_err(|e| name_correction_file(e, &args.frames, &calibration))?;
    let frames = &batch.inputs().frames;
    let range = parse_frame_range(args.frames_range.as_deref(), frames.count())?;
    // Held until the end: no other process makes these frames.
    let _claim = batch.claim(range.clone())?;
    if args.stitch {
        batch.clock_to_stitch()?;
    }
    if let Some(scheduler) = &args.scheduler {
        crate::cluster::run(args, scheduler)?;
    }
    let missing = gaps(&**frames);
    let missing_words = missing_words(&missing, &**frames);
    missing_words.iter().for_each(|words| eprintln!("{words}"));

    let retry = if args.retry_failed && args.scheduler.is_none() {
        RetryPolicy::RetryFailed
    } else {
        RetryPolicy::SkipFailed
    };
    let pending = batch.pending(range.clone(), retry)?;
    let bar = bar(pending.len(), range.len());
    let prior = batch.prior(cancel, &|event| show(&bar, &batch, event))?;
    let Some(prior) = prior else {
        bar.finish_and_clear();
        return Err(stopped(args));
    };
    let threads = rayon::current_num_threads();
    // With a budget frames follow each other.
    let most = args
        .concurrent_frames
        .map(usize::from)
        .or(args.time_budget_s.map(|_| 1));
    let allocation = ThreadAllocation::new(threads, pending.len(), &batch.inputs().model, most);
    let setup_seconds = began.elapsed().as_secs_f64();
    let (table, seconds) = run_pending(&batch, &pending, &prior, allocation, cancel, &bar)?;
    if cancel.is_cancelled() {
        return Err(stopped(args));
    }
    let rows = batch.rows()?;
    refuse_if_all_failed(args, &rows, &range)?;
    let stitched = if args.stitch {
        Some(stitch(args, &batch, cancel)?)
    } else {
        None
    };

    let of = |status| rows.iter().filter(move |row| row.status == status);
    let ours = rows.iter().filter(|row| pending.contains(&row.frame));
    let failed_ours = ours.clone().filter(|row| row.status == Status::Failed);
    let summary = BatchSummary {
        version: env!("CARGO_PKG_VERSION"),
        archive: args.output.display().to_string(),
        table: table.display().to_string(),
        stitched,
        frames: frames.count(),
        done: of(Status::Done).count(),
        failed: of(Status::Failed).count(),
        left: frames.count() - rows.len(),
        frames_this_run: ours.count(),
        failed_this_run: failed_ours.count(),
        prior: prior.prior.clone(),
        prior_reason: prior.reason.clone(),
        prior_frame: prior.frame,
        self_calibration: batch.self_calibration().map(|(found, _)| found.clone()),
        self_calibration_frames: batch
            .self_calibration()
            .map_or_else(Vec::new, |(_, frames)| frames.to_vec()),
        metadata: MetadataNumbers::from(&from_metadata),
        frame_period_us: batch.clock().map(|clock| clock.frame_period_us),
        dead_us: batch.clock().map(|clock| clock.dead_us()),
        threads,
        frames_at_once: allocation.concurrent_frames,
        threads_per_frame: allocation.threads_per_frame,
        setup_seconds,
        seconds,
        frames_per_second: (!pending.is_empty()).then(|| pending.len() as f64 / seconds),
        peak_memory_bytes: peak_memory_bytes(),
        warnings: warnings(&rows, [from_metadata.warnings, missing_words].concat()),
    };
    Ok((summary, rows))
}

/// Reconstructs the pending frames and writes the table of all: its path, and the seconds of the reconstructions.
fn run_pending(
    batch: &Batch,
    pending: &[usize],
    prior: &ChosenPrior,
    allocation: ThreadAllocation,
    cancel: &Cancel,
    bar: &ProgressBar,
) -> Result<(PathBuf, f64)> {
    let started = Instant::now();
    bar.reset_eta();
    let ran = batch.run(pending, prior, allocation, &CommandLine, cancel, &|event| {
        show(bar, batch, event);
    });
    let seconds = started.elapsed().as_secs_f64();
    bar.finish_and_clear();
    // On a full disk the first error is the one that helps.
    match ran {
        Ok(()) => Ok((batch.write_table()?, seconds)),
        Err(error) => {
            let _ = batch.write_table();
            Err(error)
        }
    }
}

/// The inputs of the batch, with the calibration and the metadata that they come from.
fn load_input(
    args: &BatchArgs,
    cancel: &Cancel,
) -> Result<(BatchInputs, Calibration, FromMetadata)> {
    let files = BatchFiles {
        experiment: &args.experiment,
        frames: &args.frames,
        calibration: calibration_from_args(&args.calibration),
        options: UserOptions {
            prior: args.prior.as_deref(),
            tau: args.tau.as_deref(),
            noise_sigma: args.noise_sigma,
            self_calibrate: args.self_calibrate.as_deref(),
            keep_all_pixels: args.keep_all_pixels,
            max_iterations: args.max_iterations.map(|n| n as usize),
            time_budget_s: args.time_budget_s,
        },
        frame_period_us: args.frame_period_us,
        version: env!("CARGO_PKG_VERSION"),
    };
    let loaded = load_batch(&files, cancel, &mut print_note)?;
    Ok((loaded.inputs, loaded.calibration, loaded.from_metadata))
}

/// `A:B` of `count` frames.
fn parse_frame_range(text: Option<&str>, count: usize) -> Result<Range<usize>> {
    let Some(text) = text else {
        return Ok(0..count);
    };
    let number = |part: &str, other: usize| match part.trim() {
        "" => Some(other),
        digits => digits.parse().ok(),
    };
    let ends = text.split_once(':');
    let ends = ends.and_then(|(a, b)| Some((number(a, 0)?, number(b, count)?)));
    match ends {
        Some((first, end)) if first < end && first < count => {
            if end > count {
                eprintln!("note: --frames-range {text} ends beyond the last of the {count} frames");
            }
            Ok(first..end.min(count))
        }
        _ => Err(Error::input(
            Parameter::FramesRange,
            format!("\"{text}\""),
            format!("a range A:B of the {count} frames has 0 ≤ A < B, and A < {count}"),
            "Write 0:100 for the first hundred, 100: for the rest.",
        )),
    }
}

fn bar(left: usize, of: usize) -> ProgressBar {
    if !std::io::stderr().is_terminal() || is_logging() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(of as u64);
    let style = ProgressStyle::with_template(
        "{bar:30} frame {pos} of {len}, {elapsed} so far, {eta} left; {msg}",
    );
    bar.set_style(style.expect("the template is valid"));
    bar.set_position((of - left) as u64);
    bar.reset_eta();
    bar
}

fn show(bar: &ProgressBar, batch: &Batch, event: Event) {
    match event {
        Event::Calibrating => bar.set_message("looking for errors of PSF and camera"),
        Event::Choosing { frame } => {
            let words = format!(
                "choosing the prior on {}",
                batch.inputs().frames.name(frame)
            );
            if bar.is_hidden() {
                eprintln!("{words}");
            } else {
                bar.set_message(words);
            }
        }
        Event::FrameFinished(row) => {
            bar.inc(1);
            match (row.status, row.residual_over_sigma) {
                (Status::Done, Some(level)) => {
                    let fit = row.fit.as_deref().unwrap_or_default();
                    bar.set_message(format!("{}: residual/σ {level:.2}, {fit}", row.name));
                }
                _ => bar.suspend(|| eprintln!("{} failed: {}", row.name, row.message)),
            }
        }
        Event::Stitched { of } => {
            bar.set_length(of as u64);
            bar.inc(1);
        }
    }
}

fn stopped(args: &BatchArgs) -> Error {
    Error::work(&args.output, "stopped", "Run the same command to resume.")
        .with_kind(ErrorKind::Cancelled)
}

/// A run of which nothing came did not work.
fn refuse_if_all_failed(args: &BatchArgs, rows: &[FrameRow], range: &Range<usize>) -> Result<()> {
    let ours = || rows.iter().filter(|row| range.contains(&row.frame));
    match ours().next() {
        Some(first) if ours().all(|row| row.status == Status::Failed) => Err(Error::work(
            &args.frames,
            format!(
                "all {} frames failed; the first: {}",
                range.len(),
                first.message
            ),
            format!(
                "See {}/rowburst/frames.csv; --retry-failed tries them again.",
                args.output.display()
            ),
        )),
        _ => Ok(()),
    }
}

fn stitch(args: &BatchArgs, batch: &Batch, cancel: &Cancel) -> Result<String> {
    let bar = bar(0, 0);
    bar.set_message("stitching");
    let path = batch.stitch(cancel, &|event| show(&bar, batch, event));
    bar.finish_and_clear();
    let path = path?.ok_or_else(|| stopped(args))?;
    Ok(path.display().to_string())
}

/// Gaps in the numbering of the frames: one sentence, with the first of them.
fn missing_words(missing: &[(usize, u64, u64)], frames: &dyn Frames) -> Vec<String> {
    let count: u64 = missing
        .iter()
        .map(|(_, first, last)| last - first + 1)
        .sum();
    let Some(&(before, _, _)) = missing.first() else {
        return Vec::new();
    };
    vec![format!(
        "{count} frames are missing by the numbers in the names, the first after {}; the time axis includes them",
        frames.name(before)
    )]
}

fn warnings(rows: &[FrameRow], mut warnings: Vec<String>) -> Vec<String> {
    let mut add = |what: &str, of: &dyn Fn(&FrameRow) -> bool| {
        let count = rows.iter().filter(|row| of(row)).count();
        if let Some(first) = rows.iter().find(|row| of(row)) {
            let (name, message) = (&first.name, &first.message);
            warnings.push(format!("{what} {count} frames, first {name}: {message}"));
        }
    };
    add("no video of", &|row| row.status == Status::Failed);
    add("a bad fit of", &|row| row.fit.as_deref() == Some("bad"));
    add("a suspicious fit of", &|row| {
        row.fit.as_deref() == Some("suspicious")
    });
    warnings
}

fn print_summary(summary: &BatchSummary) {
    print_line(format!(
        "{}: {} of {} frames have their video",
        summary.archive, summary.done, summary.frames
    ));
    if let Some(rate) = summary.frames_per_second {
        print_line(format!(
            "this run: {} frames in {} s, {} per second ({} concurrently, {} thread(s) each)",
            summary.frames_this_run,
            short(summary.seconds),
            short(rate),
            summary.frames_at_once,
            summary.threads_per_frame
        ));
    }
    print_line(format!(
        "prior: {} ({})",
        summary.prior, summary.prior_reason
    ));
    if let Some(found) = &summary.self_calibration {
        print_line(format!(
            "PSF and camera were corrected by {} frames: {found}",
            summary.self_calibration_frames.len()
        ));
    }
    if let (Some(period), Some(dead)) = (summary.frame_period_us, summary.dead_us) {
        print_line(format!(
            "a frame every {period} µs, of which {} µs are dead time",
            short(dead)
        ));
    }
    print_line(format!("table: {}", summary.table));
    if let Some(stitched) = &summary.stitched {
        print_line(format!("one time axis: {stitched}"));
    }
    for warning in &summary.warnings {
        eprintln!("warning: {warning}");
    }
}
