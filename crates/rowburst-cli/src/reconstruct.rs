//! `rowburst reconstruct`: reads a frame and its calibration, writes the video and the report.

use crate::args::ReconstructArgs;
use crate::inputs::calibration_from_args;
use crate::option_names;
use crate::output::print_line;
use crate::progress::{Bar, Interrupt, Kept, begin_run};
use crate::sweep;
use rowburst::error::Subject;
use rowburst::reconstruct::{Options, Verdict};
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_io::Experiment;
use rowburst_run::options::{UserOptions, parse_prior, parse_tau};
use rowburst_run::{
    Artifacts, ChunkedSummary, ColourSummary, MovieStyle, Output, ReconstructionSummary, Request,
    RequestParams, RunRecord, Summary, SweepRow, VideoFormat, read_experiment, short, sweep_label,
    sweep_lines, sweep_path, thousands,
};
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

/// Runs the command. `process_start` is the time at which the process started.
pub fn run(args: &ReconstructArgs, process_start: Instant) -> Result<()> {
    let kept = match args.part_bins {
        Some(_) => Kept::Chunks,
        None => Kept::Result,
    };
    let interrupt = Interrupt::listen(kept);
    if !args.sweep.is_empty() {
        return run_sweep(args, &interrupt);
    }
    let mut bar = Bar::new(Arc::clone(&interrupt.run));
    let experiment = read_experiment(&args.experiment, &args.frame, &mut |e| bar.show(e))?;
    #[cfg(feature = "view")]
    if args.view && experiment.bayer.is_some() {
        return Err(Error::input(
            Subject::named("--view"),
            "a raw Bayer frame",
            "its four planes are reconstructed separately, and the option is for one video",
            "Leave it out.",
        )
        .with_kind(ErrorKind::Unsupported));
    }
    let run = run_one(args, &experiment, process_start, bar, &interrupt.writing)?;
    if args.json {
        print_line(run.artifacts.summary.json());
    } else {
        print_summary(&run.artifacts);
    }
    #[cfg(feature = "view")]
    if let Some(page) = run.page {
        return page.serve_until_ctrl_c(&args.output);
    }
    Ok(())
}

/// A run that is complete.
struct Run {
    artifacts: Artifacts,
    /// The live page of the run, if one is open.
    #[cfg(feature = "view")]
    page: Option<crate::view::LivePage>,
}

/// Reconstructs one frame and writes the output folder, with the progress bar and, if requested, the live page.
fn run_one(
    args: &ReconstructArgs,
    experiment: &Experiment,
    process_start: Instant,
    mut bar: Bar,
    stop_writing: &Cancel,
) -> Result<Run> {
    let folder = args
        .force
        .claim(&args.output, "reconstruct")?
        .with_cancel(stop_writing);
    let params = RequestParams {
        cancel: Arc::clone(bar.stop()).into(),
        ..request_params(args)?
    };
    let reproduce = command_line(args);
    let formats = args
        .write
        .as_deref()
        .map(VideoFormat::parse_list)
        .transpose()?;
    let movie = if args.no_stamp {
        MovieStyle::Plain
    } else {
        MovieStyle::Stamped
    };
    let record = RunRecord::new(experiment, &args.frame, &params, &reproduce);
    let request = Request::read(experiment, &args.frame, params, &mut |e| bar.show(e))?;
    let mut record = record?;
    record.options = record.options.with_files(movie, formats.clone());
    #[cfg(feature = "view")]
    let mut page = match &request {
        Request::Whole { task, .. } => crate::view::open_live_page(args, &task.camera, bar.stop())?,
        Request::Chunked(_) | Request::Colour(_) => None,
    };
    let title = format!("Rowburst: {}", args.frame.display());
    let output = Output {
        folder: &folder,
        title: &title,
        reproduce: Some(&reproduce),
        movie,
        formats: formats.as_deref(),
        record: Some(&record),
    };
    let artifacts = request.run(&output, process_start, &mut |event| {
        #[cfg(feature = "view")]
        if let Some(page) = &mut page {
            page.show(event);
        }
        bar.show(event)
    });
    bar.finish();
    Ok(Run {
        artifacts: artifacts?,
        #[cfg(feature = "view")]
        page,
    })
}

/// The files and the options of the command line.
fn request_params(args: &ReconstructArgs) -> Result<RequestParams<'_>> {
    Ok(RequestParams {
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
        truth: args.truth.as_deref(),
        direct: args.direct.as_deref(),
        guides: args.guide.as_slice(),
        guide_model: args.guide_model.as_deref(),
        regions: &args.region,
        photodiodes: &args.photodiode,
        bins: args.bins.as_deref().map(parse_bins).transpose()?,
        bins_per_chunk: args.part_bins,
        debias: args.debias,
        seed: args.seed,
        ..RequestParams::default()
    })
}

/// Parses a range of bins, `FIRST..END`.
fn parse_bins(text: &str) -> Result<Range<usize>> {
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

/// Runs every point of the sweep. A run that fails does not stop the others; the sweep then fails at the end.
fn run_sweep(args: &ReconstructArgs, interrupt: &Interrupt) -> Result<()> {
    let points = sweep::points(&args.sweep)?;
    let runs = points.iter().map(|point| {
        let mut point_args = args.clone();
        point_args.sweep.clear();
        point_args.output = sweep_path(&args.output, &sweep_label(point), "");
        for (key, value) in point {
            set_option(&mut point_args, key, value)?;
        }
        Ok((sweep_label(point), point_args))
    });
    // All values are checked before the first run.
    let runs: Vec<(String, ReconstructArgs)> = runs.collect::<Result<_>>()?;
    let mut rows: Vec<SweepRow> = Vec::new();
    let mut first_error = None;
    let mut table = None;
    for (point, point_args) in runs {
        begin_run();
        let point_start = Instant::now();
        eprintln!("{point}");
        let run = run_point(&point_args, point_start, interrupt);
        let summary = match &run {
            Ok(Artifacts {
                summary: Summary::Whole(summary),
                ..
            }) => Some(summary),
            _ => None,
        };
        let row = SweepRow {
            point,
            output: point_args.output.display().to_string(),
            seconds: point_start.elapsed().as_secs_f64(),
            error: run.as_ref().err().map(option_names::message),
            ..SweepRow::default()
        };
        rows.push(match summary {
            Some(summary) => row.with_summary(summary),
            None => row,
        });
        if let Err(error) = run {
            first_error.get_or_insert(error);
        }
        // What Ctrl-C ends in the middle of a later point keeps the table of these.
        table = Some(sweep::write(&args.output, args.force, &rows)?);
        if interrupt.run.load(Ordering::Relaxed) {
            break;
        }
    }
    if args.json {
        print_line(serde_json::to_string_pretty(&rows).expect("plain numbers and text"));
    } else {
        sweep_lines(&rows).into_iter().for_each(print_line);
        if let Some(table) = table {
            print_line(format_args!("table: {}", table.display()));
        }
    }
    refuse_failed(args, &rows, first_error)
}

/// Gives `args` the value of a swept option.
fn set_option(args: &mut ReconstructArgs, key: &str, value: &str) -> Result<()> {
    let mut options = Options::default();
    match key {
        "prior" => {
            parse_prior(value)?;
            args.prior = Some(value.into());
        }
        "tau" => {
            options.tau = parse_tau(value)?;
            args.tau = Some(value.into());
        }
        "noise-sigma" => {
            options.noise_sigma = Some(sweep::parse_number(key, value)?);
            args.noise_sigma = options.noise_sigma;
        }
        _ => args.max_iterations = Some(sweep::parse_count(key, value)?),
    }
    options.check()
}

/// Points that failed are an exit status, whatever the others are.
fn refuse_failed(
    args: &ReconstructArgs,
    rows: &[SweepRow],
    first_error: Option<Error>,
) -> Result<()> {
    let failed = rows.iter().filter(|row| row.error.is_some()).count();
    match first_error {
        None => Ok(()),
        Some(error) if failed == rows.len() => Err(error),
        Some(error) if error.kind() == ErrorKind::Cancelled => Err(error),
        Some(error) => Err(Error::work(
            &args.output,
            format!(
                "{failed} of {} points failed; the first: {}",
                rows.len(),
                option_names::message(&error)
            ),
            "The table has all points.",
        )),
    }
}

/// Runs a point of a sweep. Refuses colour frames, which a sweep cannot compare.
fn run_point(
    args: &ReconstructArgs,
    point_start: Instant,
    interrupt: &Interrupt,
) -> Result<Artifacts> {
    let mut bar = Bar::new(Arc::clone(&interrupt.run));
    let experiment = read_experiment(&args.experiment, &args.frame, &mut |e| bar.show(e))?;
    if let Some(mosaic) = experiment.bayer {
        return Err(Error::input(
            Subject::named("--sweep"),
            format!("raw frames of the mosaic {}", mosaic.name()),
            "their planes are reconstructed separately, and a sweep compares one video",
            "Leave --sweep out.",
        ));
    }
    Ok(run_one(args, &experiment, point_start, bar, &interrupt.writing)?.artifacts)
}

/// The command that reproduces the result, quoted for a shell.
fn command_line(args: &ReconstructArgs) -> String {
    let path = |path: &PathBuf| path.display().to_string();
    let mut words: Vec<String> = ["rowburst", "reconstruct"].map(String::from).into();
    words.extend([path(&args.experiment), "--frame".into(), path(&args.frame)]);
    let mut option = |flag: &str, value: Option<String>| {
        if let Some(value) = value {
            words.extend([flag.to_string(), value]);
        }
    };
    option("--psf", args.calibration.psf.as_ref().map(path));
    option("--dark", args.calibration.dark.as_ref().map(path));
    option("--flat", args.calibration.flat.as_ref().map(path));
    let bad_pixels = args.calibration.bad_pixels.as_ref();
    option("--bad-pixels", bad_pixels.map(path));
    option("--truth", args.truth.as_ref().map(path));
    option("--direct", args.direct.as_ref().map(path));
    option("--guide", args.guide.as_ref().map(path));
    option("--guide-model", args.guide_model.clone());
    for region in &args.region {
        option("--region", Some(region.clone()));
    }
    for diode in &args.photodiode {
        option("--photodiode", Some(path(diode)));
    }
    option("--prior", args.prior.clone());
    option("--tau", args.tau.clone());
    let number = |value: Option<f64>| value.map(|v| v.to_string());
    option("--noise-sigma", number(args.noise_sigma));
    option("--self-calibrate", args.self_calibrate.clone());
    option("--time-budget-s", number(args.time_budget_s));
    let max_iterations = args.max_iterations.map(|v| v.to_string());
    option("--max-iterations", max_iterations);
    option("--bins", args.bins.clone());
    option("--part-bins", args.part_bins.map(|v| v.to_string()));
    option("--write", args.write.clone());
    let seed = Some(args.seed).filter(|seed| *seed != 0);
    option("--seed", seed.map(|seed| seed.to_string()));
    option("--threads", crate::THREADS.get().map(|n| n.to_string()));
    let flags = [
        ("--keep-all-pixels", args.keep_all_pixels),
        ("--debias", args.debias),
        ("--no-stamp", args.no_stamp),
    ];
    let flags = flags.iter().filter(|(_, is_set)| *is_set);
    words.extend(flags.map(|(flag, _)| flag.to_string()));
    words.extend(["-o".to_string(), path(&args.output)]);
    shell_words::join(words)
}

/// Prints the summary for a person.
pub fn print_summary(artifacts: &Artifacts) {
    let file = artifacts.first_file();
    match &artifacts.summary {
        Summary::Whole(summary) => {
            print_whole(summary, &artifacts.trace_lines);
            print_warnings(&summary.warnings);
            print_line(format_args!("open {}", file.display()));
        }
        Summary::Chunked(summary) => {
            print_chunked(summary);
            print_warnings(&summary.warnings);
            print_line(format_args!("open {}", file.display()));
        }
        Summary::Colour(summary) => {
            print_colour(summary);
            print_warnings(&summary.warnings);
            print_line(format_args!("video: {}", file.display()));
        }
    }
}

fn print_warnings(warnings: &[String]) {
    for warning in warnings {
        print_line(format_args!("warning: {warning}"));
    }
}

/// Prints the numbers of a video that was reconstructed as a whole.
fn print_whole(summary: &ReconstructionSummary, trace_lines: &[String]) {
    print_line(format_args!(
        "{} frames of {}×{} at {} fps from one frame, in {:.2} s (set-up {:.2} s, {} iterations, {})",
        summary.frames,
        summary.rows,
        summary.columns,
        thousands(summary.frame_rate_hz),
        summary.setup_seconds + summary.seconds,
        summary.setup_seconds,
        summary.iterations,
        summary.stop_reason,
    ));
    if let (Some(psnr), Some(ssim)) = (summary.psnr_db, summary.ssim) {
        print_line(format_args!(
            "PSNR {psnr:.2} dB, SSIM {ssim:.4} against the truth"
        ));
    }
    let effective_sigma = if summary.effective_sigma == summary.noise_sigma {
        String::new()
    } else {
        format!(", effective σ {}", short(summary.effective_sigma))
    };
    print_line(format_args!(
        "residual/σ {:.3}, τ {} ({}), σ {} ({}){effective_sigma}, prior {}",
        summary.residual_over_sigma,
        short(summary.tau),
        summary.tau_rule,
        short(summary.noise_sigma),
        summary.noise_sigma_source,
        summary.prior,
    ));
    if summary.prior_choice.held_out_pixels.is_some() {
        print_line(format_args!("prior: {}", summary.prior_choice.reason));
    }
    if let Some(found) = &summary.self_calibration {
        let by = if found.held_out_before.is_some() {
            "by the frame"
        } else {
            "PSF"
        };
        print_line(format_args!("corrected {by}: {found}"));
    }
    print_line(&summary.certificate);
    if summary.fit == Verdict::Good.name() {
        print_line(format_args!("the fit is good: {}", summary.fit_reason));
    }
    if let Some(debias) = &summary.debias {
        let before = debias.psnr_db_before.map_or(String::new(), |db| {
            format!(", PSNR before debiasing {db:.2} dB")
        });
        print_line(format_args!(
            "debiased: total light × {:.4}, bright voxels × {:.4}{before}",
            debias.light_ratio, debias.bright_light_ratio
        ));
    }
    trace_lines.iter().for_each(print_line);
}

/// Prints the numbers of a video that was reconstructed in chunks.
fn print_chunked(summary: &ChunkedSummary) {
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
}

/// Prints the numbers of a raw colour frame.
fn print_colour(summary: &ColourSummary) {
    print_line(format_args!(
        "{} frames of {}×{} in colour at {} fps from one raw {} frame",
        summary.frames,
        summary.rows,
        summary.columns,
        thousands(summary.frame_rate_hz),
        summary.bayer
    ));
    for plane in &summary.planes {
        let left_out = if plane.excluded_fraction > 0.0 {
            format!(
                ", {:.1} % of the pixels left out",
                100.0 * plane.excluded_fraction
            )
        } else {
            String::new()
        };
        print_line(format_args!(
            "{}: prior {}, residual/σ {:.3}, the fit is {}{left_out}, {:.2} s",
            plane.name, plane.prior, plane.residual_over_sigma, plane.fit, plane.seconds
        ));
    }
}
