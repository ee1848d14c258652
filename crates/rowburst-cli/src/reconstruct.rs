//! `rowburst reconstruct`: files in, video and report out.

use crate::args::ReconstructArgs;
use crate::inputs::{
    calibration_of, check_memory, naming_file, psf_of, read_corrections, read_frame, read_psfs,
    read_truth,
};
use crate::outcome::{
    FitNumbers, HistoryPoint, Outcome, PriorCandidate, PriorChoice, peak_memory_bytes, say, short,
};
use crate::progress::{Watch, stop_on_ctrl_c};
use crate::traces::{self, DebiasNumbers, Traces, Wanted};
use crate::view_files::{self, ViewFiles};
use rowburst::measurement::{Measurement, correct};
use rowburst::metrics::{psnr_db, ssim};
use rowburst::reconstruct::{Prior, Problem, Recipe, Reconstruction, SigmaSource, Tau, Verdict};
use rowburst::simulate::direct_frame;
use rowburst::{Camera, Error, Image, PatchSet, Result, Video};
use rowburst_io::{Experiment, OutputFolder, TiffScale, write_npy_video, write_tiff_video};
use rowburst_report::{Direct, DirectOrigin, Iteration, Judgement, Player, ReportInput};
use std::time::{Duration, Instant};

/// Files of a result, and what they are.
const FILES: &[(&str, &str)] = &[
    ("video.npy", "the video, float32 [t, y, x], in counts"),
    (
        "video.tif",
        "the same as an ImageJ time stack (Fiji, napari)",
    ),
    #[cfg(feature = "mp4")]
    ("video.mp4", "the same slowed down, for browsers and slides"),
    (
        "traces.csv",
        "brightness over time of the brightest spots and regions, with standard errors",
    ),
    ("report.html", "this page"),
    (
        "view.json, view-*.npy",
        "what rowburst view shows beside the video",
    ),
    ("result.json", "the numbers, for programs"),
];

/// Beside them where the prior has a background.
const BACKGROUND_FILE: (&str, &str) = (
    "background.npy",
    "the part of the video that is background, float32 [t, y, x]",
);

/// `began` is the start of the process.
pub fn run(args: &ReconstructArgs, began: Instant) -> Result<()> {
    let folder = OutputFolder::create(&args.output)?;
    let experiment = Experiment::read(&args.experiment)?;
    let camera = experiment.camera()?;
    let recipe = recipe_of(args, &experiment)?;
    let budget = time_budget(args)?;
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
    let page = crate::view::watching(args, &camera, &stop)?;
    let started = Instant::now();
    let problem = Problem::new(&measurement, &camera, &psfs, recipe)?;
    let setup = started.elapsed();
    let left = budget.map(|b| b.saturating_sub(setup));
    let mut watch = Watch::new(problem.sigma(), truth.as_ref(), left, stop);
    #[cfg(feature = "view")]
    {
        watch = watch.shown_by(page.as_ref().map(|page| page.live()));
    }
    let solved = problem.solve(&mut |progress| watch.observe(progress));
    let seconds = watch.seconds();
    watch.finish();
    let mut found = solved?;
    watch.rescale(found.sigma);
    let mut traces = traces::find(wanted, args.debias, &found, &measurement, &camera, &psfs);
    let debias = traces.debiased.take().map(|debiased| {
        let before = std::mem::replace(&mut found.video, debiased.video);
        DebiasNumbers {
            light_ratio: debiased.light,
            bright_light_ratio: debiased.bright_light,
            untouched_bins: debiased.untouched_bins,
            psnr_db_before: truth.as_ref().map(|t| psnr_db(before.data(), t.data())),
            ssim_before: truth.as_ref().map(|t| ssim(&before, t)),
        }
    });

    let run = Run {
        args,
        camera: &camera,
        psfs: &psfs,
        measurement: &measurement,
        truth: truth.as_ref(),
        direct: direct.as_ref(),
        found: &found,
        traces: &traces,
        curve: &watch.curve,
    };
    let mut outcome = run.outcome(recipe, setup.as_secs_f64(), seconds);
    outcome.debias = debias;
    let started_after = watch.started_after(began);
    let points = watch.curve.iter();
    outcome.history = points
        .map(|p| HistoryPoint::new(p, started_after))
        .collect();
    #[cfg(feature = "view")]
    if let Some(page) = &page {
        page.writing();
    }
    let outcome = run.write(&folder, outcome)?;
    let json = serde_json::to_string_pretty(&outcome).expect("plain numbers and text");
    if args.json {
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

fn recipe_of(args: &ReconstructArgs, experiment: &Experiment) -> Result<Recipe> {
    let (prior, tau) = (args.prior.as_deref(), args.tau.as_deref());
    let prior = chosen_prior(prior, experiment)?;
    Ok(Recipe {
        // A choice takes a run for each candidate: a budget has no time for it.
        prior: prior.or(args.time_budget_s.map(|_| Prior::STANDARD)),
        tau: chosen_tau(tau, experiment)?,
        noise_sigma: args.noise_sigma,
        max_iterations: args.max_iterations.map(|n| n as usize),
    })
}

/// The prior of the command line, or else of the experiment; `None` for `auto`.
pub fn chosen_prior(name: Option<&str>, experiment: &Experiment) -> Result<Option<Prior>> {
    match (name, &experiment.reconstruction.prior) {
        (Some(name), _) => prior_of(name),
        (None, Some(name)) => prior_of(name).map_err(|mut error| {
            if let Error::Input { subject, .. } = &mut error {
                *subject = format!("{}: [reconstruction] prior", experiment.path.display());
            }
            error
        }),
        (None, None) => Ok(None),
    }
}

/// The rule for `τ` of the command line, or else of the experiment.
pub fn chosen_tau(text: Option<&str>, experiment: &Experiment) -> Result<Tau> {
    Ok(match (text, experiment.reconstruction.tau) {
        (None, tau) => tau.unwrap_or_default(),
        (Some("auto"), _) => Tau::Auto,
        (Some("held-out"), _) => Tau::HeldOut,
        (Some(text), _) => Tau::Given(text.parse().map_err(|_| {
            Error::input(
                "--tau",
                format!("\"{text}\""),
                "τ is auto, held-out or a number above zero",
                "Leave it out: the program finds it.",
            )
        })?),
    })
}

/// A prior by its name; `None` for `auto`.
fn prior_of(name: &str) -> Result<Option<Prior>> {
    match name.trim() {
        "auto" => Ok(None),
        name => name.parse().map(Some),
    }
}

fn time_budget(args: &ReconstructArgs) -> Result<Option<Duration>> {
    let Some(seconds) = args.time_budget_s else {
        return Ok(None);
    };
    match Duration::try_from_secs_f64(seconds) {
        Ok(budget) if !budget.is_zero() => Ok(Some(budget)),
        _ => Err(Error::input(
            "--time-budget-s",
            seconds,
            "a budget is a number of seconds above zero",
            "Leave it out to run until it has converged.",
        )),
    }
}

/// A finished run, ready to be written.
struct Run<'a> {
    args: &'a ReconstructArgs,
    camera: &'a Camera,
    psfs: &'a PatchSet,
    measurement: &'a Measurement,
    truth: Option<&'a Video>,
    direct: Option<&'a Image>,
    found: &'a Reconstruction,
    traces: &'a Traces,
    curve: &'a [Iteration],
}

impl Run<'_> {
    fn outcome(&self, recipe: Recipe, setup_seconds: f64, seconds: f64) -> Outcome {
        let found = self.found;
        let shape = found.video.shape();
        Outcome {
            version: env!("CARGO_PKG_VERSION"),
            prior: found.prior.to_string(),
            prior_choice: self.choice(recipe),
            tau: found.tau,
            tau_rule: match (recipe.tau, found.sigma_source) {
                (Tau::Given(_), _) => "given",
                (_, SigmaSource::HeldOut) => "held-out pixels",
                _ => "discrepancy principle",
            },
            noise_sigma: found.sigma,
            noise_sigma_source: found.sigma_source.name(),
            residual_over_sigma: found.residual_over_sigma,
            objective: found.certificate.primal,
            objective_excess: Some(found.certificate.excess()).filter(|e| e.is_finite()),
            certificate: found.certificate.to_string(),
            support_fraction: found.support,
            iterations: found.iterations,
            stop_reason: found.stop_reason.name(),
            seconds,
            setup_seconds,
            peak_memory_bytes: None,
            frames: shape.bins,
            rows: shape.rows,
            columns: shape.columns,
            frame_rate_hz: self.camera.time().frame_rate_hz(),
            bad_pixels: self.measurement.bad(),
            saturated_pixels: self.measurement.saturated(),
            threads: rayon::current_num_threads(),
            seed: self.args.seed,
            psnr_db: self.truth.map(|t| psnr_db(found.video.data(), t.data())),
            ssim: self.truth.map(|t| ssim(&found.video, t)),
            fit: found.fit.verdict.name(),
            fit_reason: found.fit.reason.clone(),
            fit_statistics: FitNumbers::from(&found.fit.statistics),
            traces: self.traces.outcome(self.truth),
            trace_errors: self.traces.numbers.clone(),
            debias: None,
            history: Vec::new(),
            warnings: self.warnings(),
        }
    }

    /// How the prior came about.
    fn choice(&self, recipe: Recipe) -> PriorChoice {
        match &self.found.choice {
            Some(choice) => PriorChoice {
                reason: choice.reason(),
                held_out_pixels: Some(choice.held_out),
                candidates: choice.candidates.iter().map(PriorCandidate::from).collect(),
            },
            None => PriorChoice {
                reason: match recipe.prior {
                    _ if self.args.time_budget_s.is_some() && self.args.prior.is_none() => {
                        "the standard one: a time budget leaves no time to choose"
                    }
                    Some(_) => "given",
                    None => "not chosen: a single bin or a small frame leaves nothing to choose by, or it was stopped before",
                }
                .into(),
                held_out_pixels: None,
                candidates: Vec::new(),
            },
        }
    }

    /// What the user should know before trusting the video.
    fn warnings(&self) -> Vec<String> {
        let found = self.found;
        let mut warnings = Vec::new();
        if found.fit.verdict != Verdict::Good {
            warnings.push(format!(
                "the fit is {}: {}",
                found.fit.verdict.name(),
                found.fit.reason
            ));
        }
        if found.video.max() <= 0.0 {
            warnings.push("the video is dark: noise of this level explains the whole frame; check --noise-sigma".into());
        }
        let missing = self.measurement.saturated();
        if missing > 0 {
            warnings.push(format!("{missing} saturated pixels were left out"));
        }
        warnings.extend(self.traces.warnings());
        if let (true, Some(why)) = (self.args.debias, &self.traces.numbers.missing_because) {
            warnings.push(format!("--debias had no effect: {why}"));
        }
        warnings
    }

    /// Writes all files, `result.json` last: where it is, the result is whole.
    fn write(&self, folder: &OutputFolder, mut outcome: Outcome) -> Result<Outcome> {
        let video = &self.found.video;
        let time = self.camera.time();
        // That of an earlier run would vouch for files that are no longer its own.
        folder.remove("result.json")?;
        folder.write("video.npy", |w| write_npy_video(w, video))?;
        folder.remove("background.npy")?;
        if let Some(background) = &self.found.background {
            folder.write("background.npy", |w| write_npy_video(w, background))?;
        }
        let scale = TiffScale {
            frame_interval_s: time.bin_duration_us() * 1e-6,
            pixel_pitch_um: self.camera.sensor().pixel_pitch_um,
        };
        folder.write("video.tif", |w| write_tiff_video(w, video, scale))?;
        self.traces.write(folder, time)?;
        let mp4 = encoded(video)?;
        if let Some(mp4) = &mp4 {
            folder.write_bytes("video.mp4", mp4)?;
        }

        outcome.peak_memory_bytes = peak_memory_bytes();
        let computed = self.truth.filter(|_| self.direct.is_none());
        let computed = computed.map(|truth| direct_frame(self.camera, truth));
        let direct = match (self.direct, &computed) {
            (Some(image), _) => Some((image, DirectOrigin::Given)),
            (None, Some(image)) => Some((image, DirectOrigin::Truth)),
            (None, None) => None,
        };
        let reproduce = self.command_line();
        let placed = self.traces.placed();
        let title = format!("Rowburst: {}", self.args.frame.display());
        let headline = headline(&outcome);
        let settings = self.settings(&outcome);
        let files = ViewFiles {
            title: &title,
            camera: self.camera,
            video,
            truth: self.truth.map(|truth| (truth, self.args.truth.as_deref())),
            frame: self.measurement.image(),
            psf: self.psfs.central().image(),
            residual: &self.found.residual,
            direct: direct.map(|(image, _)| image),
            traces: &placed,
            course: self.curve,
            headline: &headline,
            settings: &settings,
            fit: (outcome.fit, &outcome.fit_reason),
            warnings: &outcome.warnings,
            command: &reproduce,
        };
        let view = view_files::write(folder, &files)?;
        let player = page_of(folder, &files, &view);
        let report = rowburst_report::render(&ReportInput {
            title: &title,
            frame: self.measurement.image(),
            psf: self.psfs.central().image(),
            video,
            truth: self.truth,
            direct: direct.map(|(image, origin)| Direct { image, origin }),
            residual: &self.found.residual,
            traces: &placed,
            instants: self.camera.instants(),
            time,
            convergence: self.curve,
            headline,
            fit: Some(Judgement {
                verdict: outcome.fit,
                reason: &outcome.fit_reason,
            }),
            settings,
            pixel_pitch_um: self.camera.sensor().pixel_pitch_um,
            mp4: mp4.as_deref(),
            player: player.as_ref().map(|(bundle, data)| Player {
                script: &bundle.script,
                style: &bundle.style,
                data,
            }),
            files: FILES
                .iter()
                .chain(self.found.background.as_ref().map(|_| &BACKGROUND_FILE))
                .map(|&(name, what)| (name.into(), what.into()))
                .collect(),
            reproduce: Some(&reproduce),
        })?;
        for picture in &report.pictures {
            folder.write_bytes(&picture.name, &picture.png)?;
        }
        folder.write_bytes("report.html", report.html.as_bytes())?;
        drop(report);
        outcome.peak_memory_bytes = peak_memory_bytes();
        let json = serde_json::to_string_pretty(&outcome).expect("plain numbers and text");
        folder.write_bytes("result.json", format!("{json}\n").as_bytes())?;
        Ok(outcome)
    }

    fn command_line(&self) -> String {
        let args = self.args;
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

    fn settings(&self, outcome: &Outcome) -> Vec<(String, Vec<(String, String)>)> {
        let camera = self.camera;
        let sensor = camera.sensor();
        let pair = |name: &str, value: String| (name.to_string(), value);
        let mut of_camera = vec![
            pair(
                "rows × columns",
                format!("{} × {}", camera.rows(), camera.columns()),
            ),
            pair("shutter", camera.shutter().name().into()),
            pair("row_time_us", camera.params().row_time_us.to_string()),
            pair("exposure_us", camera.params().exposure_us.to_string()),
            pair("bins_per_row", camera.params().bins_per_row.to_string()),
            pair(
                "field",
                format!("{} × {}", camera.field().0, camera.field().1),
            ),
            pair("binning", sensor.binning.to_string()),
        ];
        let optional = [
            ("pixel_pitch_um", sensor.pixel_pitch_um),
            ("bit_depth", sensor.bit_depth.map(f64::from)),
            ("bias_counts", sensor.bias_counts),
            ("gain_electrons_per_count", sensor.gain_electrons_per_count),
            ("read_noise_electrons", sensor.read_noise_electrons),
            ("full_well_counts", sensor.full_well_counts),
        ];
        for (name, value) in optional {
            if let Some(value) = value {
                of_camera.push(pair(name, value.to_string()));
            }
        }
        let psf = self.psfs.central().image();
        let of_solver = vec![
            pair("objective", "½‖W(b − Av)‖² + τ R(v), v ≥ 0".into()),
            pair("prior R", outcome.prior.clone()),
            pair("its choice", outcome.prior_choice.reason.clone()),
            pair(
                "τ",
                format!("{} ({})", short(outcome.tau), outcome.tau_rule),
            ),
            pair(
                "σ",
                format!(
                    "{} counts ({})",
                    short(outcome.noise_sigma),
                    outcome.noise_sigma_source
                ),
            ),
            pair("residual/σ", format!("{:.4}", outcome.residual_over_sigma)),
            pair("fit", format!("{}: {}", outcome.fit, outcome.fit_reason)),
            pair(
                "χ² per degree of freedom",
                format!(
                    "{} ± {}",
                    short(outcome.fit_statistics.chi_squared),
                    short(outcome.fit_statistics.chi_squared_error)
                ),
            ),
            pair(
                "noise over σ, outside the optics' band",
                outcome
                    .fit_statistics
                    .noise_floor
                    .map_or("not measurable".into(), |v| format!("{v:.2}")),
            ),
            pair(
                "residual/σ inside it",
                outcome
                    .fit_statistics
                    .passed_level
                    .map_or("not measurable".into(), |v| format!("{v:.2}")),
            ),
            pair(
                "free values per measurement",
                format!("{:.2}", outcome.fit_statistics.freedom),
            ),
            pair(
                "objective at the end",
                format!("{}; {}", short(outcome.objective), outcome.certificate),
            ),
            pair(
                "voxels allowed to be lit",
                format!("{:.2} %", 100.0 * outcome.support_fraction),
            ),
            pair(
                "standard errors of traces",
                match (&outcome.trace_errors, &outcome.trace_errors.missing_because) {
                    (_, Some(why)) => format!("not known: {why}"),
                    (errors, None) => format!(
                        "light changes over {:.1} px by {:.2} of its brightness, χ² {:.2}, found in {:.2} s",
                        errors.prior_length_px.unwrap_or(f64::NAN),
                        errors.prior_amplitude.unwrap_or(f64::NAN),
                        errors.chi_squared.unwrap_or(f64::NAN),
                        errors.seconds
                    ),
                },
            ),
            pair(
                "debiased",
                outcome.debias.as_ref().map_or("no".into(), |d| {
                    let psnr = d.psnr_db_before.zip(outcome.psnr_db);
                    let psnr = psnr.map_or(String::new(), |(a, b)| format!(", PSNR {a:.1} to {b:.1} dB"));
                    format!(
                        "yes: light × {:.4}, bright parts × {:.4}{psnr}; residual and fit are those before",
                        d.light_ratio, d.bright_light_ratio
                    )
                }),
            ),
            pair("iterations", outcome.iterations.to_string()),
            pair("stopped", outcome.stop_reason.into()),
            pair(
                "PSF",
                match self.psfs.psfs().len() {
                    1 => format!("{} × {} pixels", psf.rows(), psf.columns()),
                    n => format!("{n} patches of {} × {} pixels", psf.rows(), psf.columns()),
                },
            ),
            pair(
                "bad and saturated pixels",
                format!("{} and {}", outcome.bad_pixels, outcome.saturated_pixels),
            ),
        ];
        let of_run = vec![
            pair("rowburst", outcome.version.into()),
            pair("threads", outcome.threads.to_string()),
            pair(
                "set-up and solving",
                format!(
                    "{:.2} s and {:.2} s",
                    outcome.setup_seconds, outcome.seconds
                ),
            ),
            pair(
                "peak memory",
                outcome
                    .peak_memory_bytes
                    .map_or("unknown".into(), |b| format!("{} MB", b / 1_000_000)),
            ),
            pair(
                "warnings",
                if outcome.warnings.is_empty() {
                    "none".into()
                } else {
                    outcome.warnings.join("; ")
                },
            ),
        ];
        vec![
            ("Camera".into(), of_camera),
            ("Reconstruction".into(), of_solver),
            ("Run".into(), of_run),
        ]
    }
}

/// The viewer's page with its data, for the report; `None` where the program has none, or the video
/// is too large for one file.
#[cfg(feature = "view")]
fn page_of(
    folder: &OutputFolder,
    files: &ViewFiles,
    view: &serde_json::Value,
) -> Option<(rowburst_view::Bundle, String)> {
    crate::view::offline(folder.path(), files, view)
}

/// In a build without the viewer.
#[cfg(not(feature = "view"))]
fn page_of(_: &OutputFolder, _: &ViewFiles, _: &serde_json::Value) -> Option<(Bundle, String)> {
    None
}

/// Script and style of a page that is not there.
#[cfg(not(feature = "view"))]
struct Bundle {
    script: String,
    style: String,
}

/// The video as MP4; `None` in a build without the feature `mp4`.
#[cfg(feature = "mp4")]
fn encoded(video: &Video) -> Result<Option<Vec<u8>>> {
    let mut mp4 = Vec::new();
    rowburst_io::write_mp4(&mut mp4, video)?;
    Ok(Some(mp4))
}

/// The video as MP4; `None` in a build without the feature `mp4`.
#[cfg(not(feature = "mp4"))]
fn encoded(_: &Video) -> Result<Option<Vec<u8>>> {
    Ok(None)
}

fn headline(outcome: &Outcome) -> Vec<(String, String)> {
    let mut lines = Vec::new();
    if let Some(psnr) = outcome.psnr_db {
        lines.push(("PSNR".to_string(), format!("{psnr:.1} dB")));
    }
    if let Some(ssim) = outcome.ssim {
        lines.push(("SSIM".to_string(), format!("{ssim:.4}")));
    }
    lines.extend([
        ("Fit".to_string(), outcome.fit.to_string()),
        (
            "Residual/σ".to_string(),
            format!("{:.2}", outcome.residual_over_sigma),
        ),
        (
            "Frame rate".to_string(),
            format!("{} fps", thousands(outcome.frame_rate_hz)),
        ),
        ("Frames".to_string(), outcome.frames.to_string()),
        (
            "Time".to_string(),
            format!("{:.2} s", outcome.setup_seconds + outcome.seconds),
        ),
    ]);
    lines
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

/// A whole number with a comma every three digits.
fn thousands(value: f64) -> String {
    let digits = format!("{value:.0}");
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}
