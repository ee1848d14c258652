//! `rowburst reconstruct`: reads a frame and its calibration, writes the video and the report.

use crate::args::ReconstructArgs;
use crate::chunked;
use crate::colour;
use crate::inputs::{read_psfs, resolve_calibration};
use crate::output::print_line;
use crate::progress::{Bar, stop_on_ctrl_c};
use crate::sweep;
use rowburst::measurement::{Measurement, correct};
use rowburst::reconstruct::{Chunked, Options, Verdict};
use rowburst::{Camera, Error, PatchSet, Result};
use rowburst_io::{Experiment, FromMetadata, OutputFolder, read_metadata};
use rowburst_run::inputs::{
    check_memory, naming_file, psf_path, read_corrections, read_frame, read_truth,
};
use rowburst_run::options::{
    parse_self_calibration, parse_time_budget, resolve_prior, resolve_tau,
};
use rowburst_run::{
    ChunkedSummary, ChunkedTask, CompletedTask, MovieStyle, ReconstructionSummary, ResultMeta,
    Task, TraceRequest, Traces, player_of, short, solve, thousands,
};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Runs the command. `process_start` is the time at which the process started.
pub fn run(args: &ReconstructArgs, process_start: Instant) -> Result<()> {
    let stop = stop_on_ctrl_c("the current result will be written");
    if !args.sweep.is_empty() {
        return run_sweep(args, &stop);
    }
    let experiment = read_experiment(args)?;
    if let Some(mosaic) = experiment.bayer {
        return colour::run(args, experiment, mosaic, process_start, &stop);
    }
    let artifacts = match run_one(args, experiment, process_start, stop)? {
        Artifacts::Whole(artifacts) => artifacts,
        Artifacts::Chunked(summary) => return chunked::print_summary(&summary, args),
    };
    if args.json {
        let json =
            serde_json::to_string_pretty(&artifacts.summary).expect("plain numbers and text");
        print_line(json);
    } else {
        print_summary(&artifacts.summary, args, &artifacts.traces);
    }
    #[cfg(feature = "view")]
    if let Some(page) = artifacts.page {
        return page.serve_until_ctrl_c(&args.output);
    }
    Ok(())
}

/// The results of a run, which are written already.
enum Artifacts {
    Whole(Box<WholeArtifacts>),
    Chunked(Box<ChunkedSummary>),
}

/// A reconstruction of the whole video.
struct WholeArtifacts {
    summary: ReconstructionSummary,
    traces: Traces,
    /// The live page of the run, if one is open.
    #[cfg(feature = "view")]
    page: Option<crate::view::LivePage>,
}

/// Runs every point of the sweep. A run that fails does not stop the others; the sweep fails if all do.
fn run_sweep(args: &ReconstructArgs, stop: &Arc<AtomicBool>) -> Result<()> {
    let points = sweep::points(&args.sweep)?;
    let runs = points.iter().map(|point| {
        let mut point_args = args.clone();
        point_args.sweep.clear();
        point_args.output = sweep::point_path(&args.output, point, "");
        for (key, value) in point {
            match *key {
                "prior" => point_args.prior = Some(value.clone()),
                "tau" => point_args.tau = Some(value.clone()),
                "noise-sigma" => point_args.noise_sigma = Some(sweep::parse_number(key, value)?),
                _ => point_args.max_iterations = Some(sweep::parse_count(key, value)?),
            }
        }
        Ok((sweep::label(point), point_args))
    });
    // All values are parsed before the first run.
    let runs: Vec<(String, ReconstructArgs)> = runs.collect::<Result<_>>()?;
    let mut rows: Vec<sweep::Row> = Vec::new();
    let mut first_error = None;
    for (point, point_args) in runs {
        let point_start = Instant::now();
        eprintln!("{point}");
        let artifacts = read_experiment(&point_args)
            .and_then(refuse_colour)
            .and_then(|experiment| run_one(&point_args, experiment, point_start, Arc::clone(stop)));
        let summary = match &artifacts {
            Ok(Artifacts::Whole(artifacts)) => Some(&artifacts.summary),
            _ => None,
        };
        rows.push(sweep::Row {
            point,
            output: point_args.output.display().to_string(),
            prior: summary.map(|s| s.prior.clone()),
            tau: summary.map(|s| s.tau),
            residual_over_sigma: summary.map(|s| s.residual_over_sigma),
            psnr_db: summary.and_then(|s| s.psnr_db),
            ssim: summary.and_then(|s| s.ssim),
            fit: summary.map(|s| s.fit.to_string()),
            seconds: point_start.elapsed().as_secs_f64(),
            error: artifacts.as_ref().err().map(ToString::to_string),
        });
        if let Err(error) = artifacts {
            first_error.get_or_insert(error);
        }
        if stop.load(Ordering::Relaxed) {
            break;
        }
    }
    let table = sweep::write(&args.output, &rows)?;
    if args.json {
        print_line(serde_json::to_string_pretty(&rows).expect("plain numbers and text"));
    } else {
        sweep::lines(&rows).into_iter().for_each(print_line);
        print_line(format_args!("table: {}", table.display()));
    }
    match first_error {
        Some(error) if rows.iter().all(|row| row.error.is_some()) => Err(error),
        _ => Ok(()),
    }
}

/// Reads the experiment file. Metadata of the frame's file fills the keys that are left open.
fn read_experiment(args: &ReconstructArgs) -> Result<Experiment> {
    let experiment = Experiment::read_with(&args.experiment, &read_metadata(&args.frame))?;
    if let Some(from_metadata) = experiment.from_metadata.summary_line() {
        eprintln!("{from_metadata}");
    }
    Ok(experiment)
}

/// Refuses colour frames, which a sweep cannot compare.
fn refuse_colour(experiment: Experiment) -> Result<Experiment> {
    match experiment.bayer {
        None => Ok(experiment),
        Some(mosaic) => Err(Error::input(
            "--sweep",
            format!("raw frames of the mosaic {}", mosaic.name()),
            "their planes are reconstructed separately, and a sweep compares one video",
            "Leave --sweep out.",
        )),
    }
}

/// Reconstructs one frame and writes the output folder.
fn run_one(
    args: &ReconstructArgs,
    experiment: Experiment,
    process_start: Instant,
    stop: Arc<AtomicBool>,
) -> Result<Artifacts> {
    let folder = OutputFolder::create(&args.output)?;
    let inputs = load(args, experiment)?;
    if args.part_bins.is_some() {
        let summary = run_in_chunks(args, inputs, &folder, stop)?;
        return Ok(Artifacts::Chunked(Box::new(summary)));
    }
    check_memory(&args.experiment, &inputs.camera)?;
    let (task, request) = load_task(args, inputs)?;
    let run = solve_task(args, task, process_start, stop)?;
    let artifacts = write(args, run, request, &folder)?;
    Ok(Artifacts::Whole(Box::new(artifacts)))
}

/// The inputs of a reconstruction, of the whole video or in chunks.
struct Inputs {
    camera: Camera,
    psfs: PatchSet,
    measurement: Measurement,
    options: Options,
    budget: Option<Duration>,
    from_metadata: FromMetadata,
}

/// The options of the command line, and of the experiment file where it leaves them open.
pub fn options(args: &ReconstructArgs, experiment: &Experiment) -> Result<Options> {
    Ok(Options {
        prior: resolve_prior(args.prior.as_deref(), experiment)?,
        tau: resolve_tau(args.tau.as_deref(), experiment)?,
        noise_sigma: args.noise_sigma,
        max_iterations: args.max_iterations.map(|n| n as usize),
        keep_all_pixels: args.keep_all_pixels,
        self_calibration: parse_self_calibration(args.self_calibrate.as_deref())?,
        is_preview: false,
        ..Options::default()
    })
}

/// Parses the options, then reads and corrects the frame. With `--bins` camera and frame are those of these bins.
fn load(args: &ReconstructArgs, experiment: Experiment) -> Result<Inputs> {
    let camera = experiment.camera()?;
    let options = options(args, &experiment)?;
    let budget = parse_time_budget(args.time_budget_s)?;
    let calibration = resolve_calibration(&args.calibration, &experiment);
    let psf_path = psf_path(&calibration, &experiment)?;
    let (raw, saturation_limit) = read_frame(&args.frame)?;
    let corrections = read_corrections(&calibration, saturation_limit)?;
    let psfs = read_psfs(psf_path, &camera, corrections.dark.as_ref())?;
    let measurement = correct(&raw, &camera, &corrections)
        .map_err(|e| naming_file(e, &args.frame, &calibration))?;
    drop((raw, corrections));
    let (camera, measurement) = match &args.bins {
        None => (camera, measurement),
        Some(bins) => {
            let part = camera.subset(chunked::parse_bins(bins)?)?;
            let rows: Vec<usize> = part.sensor_rows().collect();
            let measurement = measurement.select_rows(&rows);
            (part, measurement)
        }
    };
    Ok(Inputs {
        camera,
        psfs,
        measurement,
        options,
        budget,
        from_metadata: experiment.from_metadata,
    })
}

/// Reconstructs the video in chunks of bins, each written before the next one starts.
fn run_in_chunks(
    args: &ReconstructArgs,
    inputs: Inputs,
    folder: &OutputFolder,
    stop: Arc<AtomicBool>,
) -> Result<ChunkedSummary> {
    let Inputs {
        camera,
        psfs,
        measurement,
        options,
        ..
    } = inputs;
    let task = ChunkedTask {
        chunked: Chunked::new(camera, psfs, measurement, options)?,
        tau: options.tau,
        bins_per_chunk: args.part_bins.filter(|n| *n > 0),
        title: &format!("Rowburst: {}", args.frame.display()),
        reproduce: Some(&command_line(args)),
        movie: movie_style(args),
        from_metadata: &inputs.from_metadata,
    };
    chunked::run(&task, folder, stop)
}

/// Reads the inputs that only the whole video has: truth, direct frame, regions and photodiodes.
fn load_task(args: &ReconstructArgs, inputs: Inputs) -> Result<(Task, TraceRequest)> {
    let truth = args
        .truth
        .as_deref()
        .map(|path| read_truth(path, &inputs.camera))
        .transpose()?;
    let direct = args.direct.as_deref().map(read_frame).transpose()?;
    let direct = direct.map(|(image, _)| image);
    let request = TraceRequest::read(&args.region, &args.photodiode, inputs.camera.video_shape())?;
    let task = Task {
        camera: inputs.camera,
        psfs: inputs.psfs,
        measurement: inputs.measurement,
        options: inputs.options,
        budget: inputs.budget,
        truth,
        truth_file: args.truth.clone(),
        direct,
        seed: args.seed,
        from_metadata: inputs.from_metadata,
    };
    Ok((task, request))
}

/// A reconstruction that is not written yet.
struct CompletedRun {
    completed: CompletedTask,
    /// The live page of the run, if one is open.
    #[cfg(feature = "view")]
    page: Option<crate::view::LivePage>,
}

/// Runs the solver, with the progress bar and, if requested, the live page.
fn solve_task(
    args: &ReconstructArgs,
    task: Task,
    process_start: Instant,
    stop: Arc<AtomicBool>,
) -> Result<CompletedRun> {
    #[cfg(feature = "view")]
    let mut page = crate::view::open_live_page(args, &task.camera, &stop)?;
    #[cfg(not(feature = "view"))]
    let _ = args;
    let mut bar = Bar::new(stop);
    let completed = solve(task, process_start, &mut |progress, metrics| {
        #[cfg(feature = "view")]
        if let Some(page) = &mut page {
            page.show(progress, metrics);
        }
        bar.show(progress, metrics)
    });
    bar.finish();
    Ok(CompletedRun {
        completed: completed?,
        #[cfg(feature = "view")]
        page,
    })
}

/// Computes the traces and writes all files of the result.
fn write(
    args: &ReconstructArgs,
    run: CompletedRun,
    request: TraceRequest,
    folder: &OutputFolder,
) -> Result<WholeArtifacts> {
    let mut completed = run.completed;
    let mut traces = completed.traces(request, args.debias);
    completed.take_debiased(&mut traces);
    #[cfg(feature = "view")]
    if let Some(page) = &run.page {
        page.mark_writing();
    }
    let title = format!("Rowburst: {}", args.frame.display());
    let reproduce = command_line(args);
    let result_meta = ResultMeta {
        title: &title,
        reproduce: Some(&reproduce),
        player: player_of(folder.path()),
        movie: movie_style(args),
    };
    let summary = completed.write(&traces, folder, result_meta)?;
    Ok(WholeArtifacts {
        summary,
        traces,
        #[cfg(feature = "view")]
        page: run.page,
    })
}

/// The style of `video.mp4` that the arguments select.
pub(crate) fn movie_style(args: &ReconstructArgs) -> MovieStyle {
    if args.no_stamp {
        MovieStyle::Plain
    } else {
        MovieStyle::Stamped
    }
}

/// The command that reproduces the result, quoted for a shell.
pub(crate) fn command_line(args: &ReconstructArgs) -> String {
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
fn print_summary(summary: &ReconstructionSummary, args: &ReconstructArgs, traces: &Traces) {
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
        print_line(format_args!("corrected by the frame: {found}"));
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
    for line in traces.summary_lines() {
        print_line(line);
    }
    for warning in &summary.warnings {
        print_line(format_args!("warning: {warning}"));
    }
    print_line(format_args!(
        "open {}",
        args.output.join("report.html").display()
    ));
}
