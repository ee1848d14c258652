//! `rowburst reconstruct`: files in, video and report out.

use crate::args::ReconstructArgs;
use crate::inputs::{calibration_of, read_psfs};
use crate::outcome::say;
use crate::progress::{Bar, stop_on_ctrl_c};
use rowburst::Result;
use rowburst::measurement::correct;
use rowburst::reconstruct::{Recipe, Verdict};
use rowburst_io::{Experiment, OutputFolder};
use rowburst_run::inputs::{
    check_memory, naming_file, psf_of, read_corrections, read_frame, read_truth,
};
use rowburst_run::options::{chosen_prior, chosen_tau, time_budget};
use rowburst_run::{Outcome, Task, Traces, Wanted, short, solve, thousands};
use std::time::Instant;

/// `began` is the start of the process.
pub fn run(args: &ReconstructArgs, began: Instant) -> Result<()> {
    let folder = OutputFolder::create(&args.output)?;
    let experiment = Experiment::read(&args.experiment)?;
    let camera = experiment.camera()?;
    let recipe = Recipe {
        prior: chosen_prior(args.prior.as_deref(), &experiment)?,
        tau: chosen_tau(args.tau.as_deref(), &experiment)?,
        noise_sigma: args.noise_sigma,
        max_iterations: args.max_iterations.map(|n| n as usize),
    };
    let budget = time_budget(args.time_budget_s)?;
    let calibration = calibration_of(&args.calibration, &experiment);
    let psf_path = psf_of(&calibration, &experiment)?;
    let (raw, container_end) = read_frame(&args.frame)?;
    let corrections = read_corrections(&calibration, container_end)?;
    let psfs = read_psfs(psf_path, &camera, corrections.dark.as_ref())?;
    let measurement = correct(&raw, &camera, &corrections)
        .map_err(|e| naming_file(e, &args.frame, &calibration))?;
    check_memory(&args.experiment, &camera)?;
    let truth = args
        .truth
        .as_deref()
        .map(|path| read_truth(path, &camera))
        .transpose()?;
    let direct = args.direct.as_deref().map(read_frame).transpose()?;
    let direct = direct.map(|(image, _)| image);
    drop((raw, corrections));
    let wanted = Wanted::read(&args.region, &args.photodiode, camera.video_shape())?;

    let stop = stop_on_ctrl_c("the best so far will be written");
    #[cfg(feature = "view")]
    let mut page = crate::view::watching(args, &camera, &stop)?;
    let task = Task {
        camera,
        psfs,
        measurement,
        recipe,
        budget,
        truth,
        truth_file: args.truth.clone(),
        direct,
        seed: args.seed,
    };
    let mut bar = Bar::new(stop);
    let solved = solve(task, began, &mut |progress, seen| {
        #[cfg(feature = "view")]
        if let Some(page) = &mut page {
            page.show(progress, seen);
        }
        bar.show(progress, seen)
    });
    bar.finish();
    let mut solved = solved?;
    let mut traces = solved.traces(wanted, args.debias);
    solved.take_debiased(&mut traces);
    #[cfg(feature = "view")]
    if let Some(page) = &page {
        page.writing();
    }
    let title = format!("Rowburst: {}", args.frame.display());
    let outcome = solved.write(&traces, &folder, &title, Some(&command_line(args)))?;
    if args.json {
        let json = serde_json::to_string_pretty(&outcome).expect("plain numbers and text");
        say(json);
    } else {
        print_summary(&outcome, args, &traces);
    }
    #[cfg(feature = "view")]
    if let Some(page) = page {
        return page.stay(&args.output);
    }
    Ok(())
}

/// What makes the same result again.
fn command_line(args: &ReconstructArgs) -> String {
    let mut line = format!(
        "rowburst reconstruct {} --frame {}",
        args.experiment.display(),
        args.frame.display()
    );
    let paths = [
        ("--psf", &args.calibration.psf),
        ("--dark", &args.calibration.dark),
        ("--flat", &args.calibration.flat),
        ("--bad-pixels", &args.calibration.bad_pixels),
        ("--truth", &args.truth),
        ("--direct", &args.direct),
    ];
    for (flag, path) in paths {
        if let Some(path) = path {
            line += &format!(" {flag} {}", path.display());
        }
    }
    if args.debias {
        line += " --debias";
    }
    let regions = args.region.iter().map(|r| format!(" --region {r}"));
    let diodes = args.photodiode.iter();
    line.extend(regions.chain(diodes.map(|p| format!(" --photodiode {}", p.display()))));
    let texts = [
        ("--prior", args.prior.clone()),
        ("--tau", args.tau.clone()),
        ("--noise-sigma", args.noise_sigma.map(|v| v.to_string())),
        ("--time-budget-s", args.time_budget_s.map(|v| v.to_string())),
        (
            "--max-iterations",
            args.max_iterations.map(|v| v.to_string()),
        ),
    ];
    for (flag, text) in texts {
        if let Some(text) = text {
            line += &format!(" {flag} {text}");
        }
    }
    line + &format!(" -o {}", args.output.display())
}

fn print_summary(outcome: &Outcome, args: &ReconstructArgs, traces: &Traces) {
    say(format_args!(
        "{} frames of {}×{} at {} fps from one frame, in {:.2} s (set-up {:.2} s, {} iterations, {})",
        outcome.frames,
        outcome.rows,
        outcome.columns,
        thousands(outcome.frame_rate_hz),
        outcome.setup_seconds + outcome.seconds,
        outcome.setup_seconds,
        outcome.iterations,
        outcome.stop_reason,
    ));
    if let (Some(psnr), Some(ssim)) = (outcome.psnr_db, outcome.ssim) {
        say(format_args!(
            "PSNR {psnr:.2} dB, SSIM {ssim:.4} against the truth"
        ));
    }
    say(format_args!(
        "residual/σ {:.3}, τ {} ({}), σ {} ({}), prior {}",
        outcome.residual_over_sigma,
        short(outcome.tau),
        outcome.tau_rule,
        short(outcome.noise_sigma),
        outcome.noise_sigma_source,
        outcome.prior,
    ));
    if outcome.prior_choice.held_out_pixels.is_some() {
        say(format_args!("prior: {}", outcome.prior_choice.reason));
    }
    say(&outcome.certificate);
    if outcome.fit == Verdict::Good.name() {
        say(format_args!("the fit is good: {}", outcome.fit_reason));
    }
    if let Some(debias) = &outcome.debias {
        let before = debias
            .psnr_db_before
            .map_or(String::new(), |db| format!(", PSNR before {db:.2} dB"));
        say(format_args!(
            "debiased: light × {:.4}, bright parts × {:.4}{before}",
            debias.light_ratio, debias.bright_light_ratio
        ));
    }
    for line in traces.summary() {
        say(line);
    }
    for warning in &outcome.warnings {
        say(format_args!("warning: {warning}"));
    }
    say(format_args!(
        "open {}",
        args.output.join("report.html").display()
    ));
}
