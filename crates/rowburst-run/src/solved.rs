//! A finished reconstruction: its numbers, its report and its folder of results.

use crate::outcome::{
    FitNumbers, HistoryPoint, MetadataNumbers, Outcome, PriorCandidate, PriorChoice,
    peak_memory_bytes, short,
};
use crate::task::Task;
use crate::traces::{self, DebiasNumbers, Traces, Wanted};
use crate::view_files::{self, ViewFiles};
use rowburst::metrics::{psnr_db, ssim};
use rowburst::reconstruct::{Reconstruction, SigmaSource, Tau, Verdict};
use rowburst::simulate::direct_frame;
use rowburst::{Image, Result, Video};
use rowburst_io::{OutputFolder, TiffScale, write_npy_video, write_tiff_video};
use rowburst_report::{Direct, DirectOrigin, Iteration, Judgement, Player, Report, ReportInput};
use std::borrow::Cow;

/// Files of a result, and what they are.
const FILES: &[(&str, &str)] = &[
    ("video.npy", "the video, float32 [t, y, x], in counts"),
    (
        "video.tif",
        "the same as an ImageJ time stack (Fiji, napari)",
    ),
    #[cfg(feature = "zarr")]
    ("video.ome.zarr", "the same as an OME-Zarr image (napari)"),
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

/// A solved task.
pub struct Solved {
    /// What was to be done.
    pub task: Task,
    /// What was found; where it was debiased with that video.
    pub found: Reconstruction,
    /// What debiasing did.
    pub debias: Option<DebiasNumbers>,
    /// Operator, Gram factors, noise level.
    pub setup_seconds: f64,
    /// The solver alone.
    pub seconds: f64,
    /// Seconds from the start of the program to that of the solver.
    pub(crate) started_after: f64,
    /// The course of the run.
    pub curve: Vec<Iteration>,
}

/// What a folder of results says of where it comes from.
pub struct About<'a> {
    /// Of the pages.
    pub title: &'a str,
    /// What makes the same result again.
    pub reproduce: Option<&'a str>,
    /// Makes the viewer's page for the report.
    pub player: Option<MakePlayer>,
}

/// From what the viewer shows, and `view.json`, to its page; `None` where the video is too large.
pub type MakePlayer = Box<dyn Fn(&ViewFiles, &serde_json::Value) -> Option<PlayerPage>>;

/// The viewer's page for one file.
pub struct PlayerPage {
    /// Its code.
    pub script: String,
    /// Its looks.
    pub style: String,
    /// What it shows.
    pub data: String,
}

/// What a report says of where it comes from.
pub struct Words<'a> {
    /// Of the page.
    pub title: &'a str,
    /// What makes the same result again.
    pub reproduce: Option<&'a str>,
    /// The files that lie beside the page, and what they are.
    pub files: Vec<(String, String)>,
}

impl Solved {
    /// Finds the traces that are wanted and those of the brightest spots; with `debias` the
    /// refitted video, too, for [`Solved::take_debiased`].
    pub fn traces(&self, wanted: Wanted, debias: bool) -> Traces {
        let task = &self.task;
        traces::find(
            wanted,
            debias,
            &self.found,
            &task.measurement,
            &task.camera,
            &task.psfs,
        )
    }

    /// Puts the refitted video of `traces`, if it has one, in the place of the reconstruction's.
    pub fn take_debiased(&mut self, traces: &mut Traces) {
        let Some(debiased) = traces.debiased.take() else {
            return;
        };
        let before = std::mem::replace(&mut self.found.video, debiased.video);
        let truth = self.task.truth.as_ref();
        self.debias = Some(DebiasNumbers {
            light_ratio: debiased.light,
            bright_light_ratio: debiased.bright_light,
            untouched_bins: debiased.untouched_bins,
            psnr_db_before: truth.map(|t| psnr_db(before.data(), t.data())),
            ssim_before: truth.map(|t| ssim(&before, t)),
        });
    }

    /// Everything that `result.json` says.
    pub fn outcome(&self, traces: &Traces) -> Outcome {
        let found = &self.found;
        let (recipe, truth) = (&self.task.recipe, self.task.truth.as_ref());
        let shape = found.video.shape();
        Outcome {
            version: env!("CARGO_PKG_VERSION"),
            prior: found.prior.to_string(),
            prior_choice: self.choice(),
            tau: found.tau,
            tau_rule: match (recipe.tau, found.sigma_source) {
                (Tau::Given(_), _) => "given",
                (_, SigmaSource::HeldOut) => "held-out pixels",
                _ if found
                    .choice
                    .as_ref()
                    .is_some_and(|c| c.best().strength != 1.0) =>
                {
                    "held-out pixels, from the discrepancy principle on"
                }
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
            seconds: self.seconds,
            setup_seconds: self.setup_seconds,
            peak_memory_bytes: None,
            frames: shape.bins,
            rows: shape.rows,
            columns: shape.columns,
            frame_rate_hz: self.task.camera.time().frame_rate_hz(),
            metadata: MetadataNumbers::from(&self.task.taken),
            bad_pixels: self.task.measurement.bad(),
            saturated_pixels: self.task.measurement.saturated(),
            threads: rayon::current_num_threads(),
            seed: self.task.seed,
            psnr_db: truth.map(|t| psnr_db(found.video.data(), t.data())),
            ssim: truth.map(|t| ssim(&found.video, t)),
            fit: found.fit.verdict.name(),
            fit_reason: found.fit.reason.clone(),
            fit_statistics: FitNumbers::from(&found.fit.statistics),
            traces: traces.outcome(truth),
            trace_errors: traces.numbers.clone(),
            debias: self.debias.clone(),
            history: self
                .curve
                .iter()
                .map(|point| HistoryPoint::new(point, self.started_after))
                .collect(),
            warnings: self.warnings(traces),
        }
    }

    /// How the prior came about.
    fn choice(&self) -> PriorChoice {
        let prior = self.task.recipe.prior;
        match &self.found.choice {
            Some(choice) => PriorChoice {
                reason: choice.reason(),
                held_out_pixels: Some(choice.held_out),
                candidates: choice.candidates.iter().map(PriorCandidate::from).collect(),
            },
            None => PriorChoice {
                reason: match prior {
                    None if self.task.budget.is_some() => {
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
    fn warnings(&self, traces: &Traces) -> Vec<String> {
        let found = &self.found;
        let mut warnings = self.task.taken.warnings.clone();
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
        let missing = self.task.measurement.saturated();
        if missing > 0 {
            warnings.push(format!("{missing} saturated pixels were left out"));
        }
        warnings.extend(traces.warnings());
        if let (true, Some(why)) = (traces.debias_was_wanted, &traces.numbers.missing_because) {
            warnings.push(format!("--debias had no effect: {why}"));
        }
        warnings
    }

    /// Writes all files into `folder`, `result.json` last: where it is, the result is whole.
    ///
    /// # Errors
    /// Failed writes.
    pub fn write(&self, traces: &Traces, folder: &OutputFolder, about: About) -> Result<Outcome> {
        let mut outcome = self.outcome(traces);
        let video = &self.found.video;
        let camera = &self.task.camera;
        // That of an earlier run would vouch for files that are no longer its own.
        folder.remove("result.json")?;
        folder.write("video.npy", |w| write_npy_video(w, video))?;
        folder.remove("video.mp4")?;
        folder.remove("background.npy")?;
        if let Some(background) = &self.found.background {
            folder.write("background.npy", |w| write_npy_video(w, background))?;
        }
        let scale = TiffScale {
            frame_interval_s: camera.time().bin_duration_us() * 1e-6,
            pixel_pitch_um: camera.sensor().pixel_pitch_um,
        };
        folder.write("video.tif", |w| write_tiff_video(w, video, scale))?;
        #[cfg(feature = "zarr")]
        rowburst_zarr::write_video(
            &folder.path().join("video.ome.zarr"),
            video,
            camera.time().bin_duration_us(),
            camera.sensor().pixel_pitch_um,
        )?;
        traces.write(folder, camera.time())?;
        let mp4 = encoded(video)?;
        if let Some(mp4) = &mp4 {
            folder.write_bytes("video.mp4", mp4)?;
        }

        outcome.peak_memory_bytes = peak_memory_bytes();
        let words = Words {
            title: about.title,
            reproduce: about.reproduce,
            files: FILES
                .iter()
                .chain(self.found.background.as_ref().map(|_| &BACKGROUND_FILE))
                .map(|&(name, what)| (name.into(), what.into()))
                .collect(),
        };
        let page = self.write_view(traces, &outcome, folder, &about)?;
        let report = self.report_of(traces, &outcome, words, mp4.as_deref(), page.as_ref())?;
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

    /// The report alone, with its film in it.
    ///
    /// # Errors
    /// A film that cannot be encoded.
    pub fn report(&self, traces: &Traces, words: Words) -> Result<Report> {
        let mut outcome = self.outcome(traces);
        outcome.peak_memory_bytes = peak_memory_bytes();
        let mp4 = encoded(&self.found.video)?;
        self.report_of(traces, &outcome, words, mp4.as_deref(), None)
    }

    /// What the viewer shows beside the video; the page for one file, where there is one.
    fn write_view(
        &self,
        traces: &Traces,
        outcome: &Outcome,
        folder: &OutputFolder,
        about: &About,
    ) -> Result<Option<PlayerPage>> {
        let (task, direct) = (&self.task, self.direct());
        let truth = task.truth.as_ref();
        let files = ViewFiles {
            title: about.title,
            camera: &task.camera,
            video: &self.found.video,
            truth: truth.map(|truth| (truth, task.truth_file.as_deref())),
            frame: task.measurement.image(),
            psf: task.psfs.central().image(),
            residual: &self.found.residual,
            direct: direct.as_ref().map(|(image, _)| image.as_ref()),
            traces: &traces.placed(),
            course: &self.curve,
            headline: &headline(outcome),
            settings: &self.settings(outcome),
            fit: (outcome.fit, &outcome.fit_reason),
            warnings: &outcome.warnings,
            command: about.reproduce.unwrap_or_default(),
        };
        let view = view_files::write(folder, &files)?;
        let make = about.player.as_ref();
        Ok(make.and_then(|make| make(&files, &view)))
    }

    /// The scene without the diffuser: the frame that was given, or computed from the truth.
    fn direct(&self) -> Option<(Cow<'_, Image>, DirectOrigin)> {
        let task = &self.task;
        match (&task.direct, &task.truth) {
            (Some(image), _) => Some((Cow::Borrowed(image), DirectOrigin::Given)),
            (None, Some(truth)) => {
                let computed = direct_frame(&task.camera, truth);
                Some((Cow::Owned(computed), DirectOrigin::Truth))
            }
            (None, None) => None,
        }
    }

    fn report_of(
        &self,
        traces: &Traces,
        outcome: &Outcome,
        words: Words,
        mp4: Option<&[u8]>,
        page: Option<&PlayerPage>,
    ) -> Result<Report> {
        let task = &self.task;
        let direct = self.direct();
        let placed = traces.placed();
        rowburst_report::render(&ReportInput {
            title: words.title,
            frame: task.measurement.image(),
            psf: task.psfs.central().image(),
            video: &self.found.video,
            truth: task.truth.as_ref(),
            direct: direct.as_ref().map(|(image, origin)| Direct {
                image,
                origin: *origin,
            }),
            residual: &self.found.residual,
            traces: &placed,
            instants: task.camera.instants(),
            time: task.camera.time(),
            convergence: &self.curve,
            headline: headline(outcome),
            fit: Some(Judgement {
                verdict: outcome.fit,
                reason: &outcome.fit_reason,
            }),
            settings: self.settings(outcome),
            pixel_pitch_um: task.camera.sensor().pixel_pitch_um,
            mp4,
            player: page.map(|page| Player {
                script: &page.script,
                style: &page.style,
                data: &page.data,
            }),
            files: words.files,
            reproduce: words.reproduce,
        })
    }

    fn settings(&self, outcome: &Outcome) -> Vec<(String, Vec<(String, String)>)> {
        let camera = &self.task.camera;
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
        if let Some(taken) = self.task.taken.summary() {
            of_camera.push(pair("from metadata", taken));
        }
        let psf = self.task.psfs.central().image();
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
                match self.task.psfs.psfs().len() {
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

/// A whole number with a comma every three digits.
pub fn thousands(value: f64) -> String {
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
