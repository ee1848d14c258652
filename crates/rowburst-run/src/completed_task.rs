//! A finished reconstruction: its numbers, its report and its folder of results.

use crate::movie::{MovieStyle, encode_movie};
use crate::numbers::{headline, settings};
use crate::player::{MakePlayer, PlayerPage};
use crate::summary::{
    FitNumbers, HistoryPoint, MetadataNumbers, PriorCandidate, PriorChoice, ReconstructionSummary,
    peak_memory_bytes,
};
use crate::task::Task;
use crate::traces::{self, DebiasNumbers, TraceRequest, Traces};
use crate::view_files::{self, TRUTH, ViewFiles};
use rowburst::metrics::{psnr_db, ssim};
use rowburst::reconstruct::{Reconstruction, SigmaSource, Tau, Verdict};
use rowburst::simulate::direct_frame;
use rowburst::vecmath::instruction_set;
use rowburst::{Image, Result};
use rowburst_io::{OutputFolder, TiffScale, write_npy_video, write_tiff_video};
use rowburst_report::{Direct, DirectOrigin, FitVerdict, Iteration, Player, Report, ReportInput};
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
pub struct CompletedTask {
    /// What was to be done.
    pub task: Task,
    /// What was found; where it was debiased with that video.
    pub reconstruction: Reconstruction,
    /// What debiasing did.
    pub debias: Option<DebiasNumbers>,
    /// Operator, Gram factors, noise level.
    pub setup_seconds: f64,
    /// The solver alone.
    pub seconds: f64,
    /// Seconds from the start of the program to that of the solver.
    pub(crate) start_offset_s: f64,
    /// The course of the run.
    pub curve: Vec<Iteration>,
}

/// What a folder of results says of where it comes from.
pub struct ResultMeta<'a> {
    /// Of the pages.
    pub title: &'a str,
    /// What makes the same result again.
    pub reproduce: Option<&'a str>,
    /// Makes the viewer's page for the report.
    pub player: Option<MakePlayer>,
    /// What `video.mp4` shows.
    pub movie: MovieStyle,
}

/// What a report says of where it comes from.
pub struct ReportMeta<'a> {
    /// Of the page.
    pub title: &'a str,
    /// What makes the same result again.
    pub reproduce: Option<&'a str>,
    /// The files that lie beside the page, and what they are.
    pub files: Vec<(String, String)>,
}

impl CompletedTask {
    /// Finds the traces that are wanted and those of the brightest spots; with `debias` the
    /// refitted video, too, for [`CompletedTask::take_debiased`].
    pub fn traces(&self, request: TraceRequest, debias: bool) -> Traces {
        let task = &self.task;
        traces::find(
            request,
            debias,
            &self.reconstruction,
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
        let before = std::mem::replace(&mut self.reconstruction.video, debiased.video);
        let truth = self.task.truth.as_ref();
        self.debias = Some(DebiasNumbers {
            light_ratio: debiased.light_ratio,
            bright_light_ratio: debiased.bright_light_ratio,
            untouched_bins: debiased.untouched_bins,
            psnr_db_before: truth.map(|t| psnr_db(before.data(), t.data())),
            ssim_before: truth.map(|t| ssim(&before, t)),
        });
    }

    /// Everything that `result.json` says.
    pub fn summary(&self, traces: &Traces) -> ReconstructionSummary {
        let reconstruction = &self.reconstruction;
        let (options, truth) = (&self.task.options, self.task.truth.as_ref());
        let shape = reconstruction.video.shape();
        ReconstructionSummary {
            version: env!("CARGO_PKG_VERSION"),
            prior: reconstruction.prior.to_string(),
            prior_choice: self.choice(),
            tau: reconstruction.tau,
            tau_rule: match (options.tau, reconstruction.sigma_source) {
                (Tau::Given(_), _) => "given",
                (_, SigmaSource::HeldOut) => "held-out pixels",
                _ if reconstruction
                    .choice
                    .as_ref()
                    .is_some_and(|c| c.best().tau_factor != 1.0) =>
                {
                    "held-out pixels, from the discrepancy principle on"
                }
                _ => "discrepancy principle",
            },
            noise_sigma: reconstruction.sigma,
            noise_sigma_source: reconstruction.sigma_source.name(),
            residual_over_sigma: reconstruction.residual_over_sigma,
            objective: reconstruction.certificate.primal,
            objective_excess: Some(reconstruction.certificate.excess()).filter(|e| e.is_finite()),
            certificate: reconstruction.certificate.to_string(),
            support_fraction: reconstruction.support,
            iterations: reconstruction.iterations,
            stop_reason: reconstruction.stop_reason.name(),
            seconds: self.seconds,
            setup_seconds: self.setup_seconds,
            peak_memory_bytes: None,
            frames: shape.bins,
            rows: shape.rows,
            columns: shape.columns,
            frame_rate_hz: self.task.camera.time().frame_rate_hz(),
            metadata: MetadataNumbers::from(&self.task.from_metadata),
            bad_pixels: self.task.measurement.bad(),
            saturated_pixels: self.task.measurement.saturated(),
            threads: rayon::current_num_threads(),
            simd: instruction_set(),
            seed: self.task.seed,
            psnr_db: truth.map(|t| psnr_db(reconstruction.video.data(), t.data())),
            ssim: truth.map(|t| ssim(&reconstruction.video, t)),
            fit: reconstruction.fit.verdict.name(),
            fit_reason: reconstruction.fit.reason.clone(),
            fit_statistics: FitNumbers::from(&reconstruction.fit.statistics),
            traces: traces.trace_numbers(truth),
            trace_errors: traces.numbers.clone(),
            debias: self.debias.clone(),
            history: self
                .curve
                .iter()
                .map(|point| HistoryPoint::new(point, self.start_offset_s))
                .collect(),
            warnings: self.warnings(traces),
        }
    }

    /// How the prior came about.
    fn choice(&self) -> PriorChoice {
        let prior = self.task.options.prior;
        match &self.reconstruction.choice {
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
        let reconstruction = &self.reconstruction;
        let mut warnings = self.task.from_metadata.warnings.clone();
        if reconstruction.fit.verdict != Verdict::Good {
            warnings.push(format!(
                "the fit is {}: {}",
                reconstruction.fit.verdict.name(),
                reconstruction.fit.reason
            ));
        }
        if reconstruction.video.max() <= 0.0 {
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
    pub fn write(
        &self,
        traces: &Traces,
        folder: &OutputFolder,
        result_meta: ResultMeta,
    ) -> Result<ReconstructionSummary> {
        let mut summary = self.summary(traces);
        let video = &self.reconstruction.video;
        let camera = &self.task.camera;
        // That of an earlier run would vouch for files that are no longer its own.
        folder.remove("result.json")?;
        folder.write("video.npy", |w| write_npy_video(w, video))?;
        folder.remove("video.mp4")?;
        folder.remove("background.npy")?;
        if let Some(background) = &self.reconstruction.background {
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
        let mp4 = encode_movie(video, camera.time(), result_meta.movie)?;
        if let Some(mp4) = &mp4 {
            folder.write_bytes("video.mp4", mp4)?;
        }

        summary.peak_memory_bytes = peak_memory_bytes();
        let report_meta = ReportMeta {
            title: result_meta.title,
            reproduce: result_meta.reproduce,
            files: FILES
                .iter()
                .chain(
                    self.reconstruction
                        .background
                        .as_ref()
                        .map(|_| &BACKGROUND_FILE),
                )
                .map(|&(name, what)| (name.into(), what.into()))
                .collect(),
        };
        let page = self.write_view(traces, &summary, folder, &result_meta)?;
        let report =
            self.report_of(traces, &summary, report_meta, mp4.as_deref(), page.as_ref())?;
        for picture in &report.pictures {
            folder.write_bytes(&picture.name, &picture.png)?;
        }
        folder.write_bytes("report.html", report.html.as_bytes())?;
        drop(report);
        summary.peak_memory_bytes = peak_memory_bytes();
        let json = serde_json::to_string_pretty(&summary).expect("plain numbers and text");
        folder.write_bytes("result.json", format!("{json}\n").as_bytes())?;
        Ok(summary)
    }

    /// The report alone, with its film or its player in it.
    ///
    /// # Errors
    /// A film that cannot be encoded.
    pub fn report(
        &self,
        traces: &Traces,
        report_meta: ReportMeta,
        player: Option<MakePlayer>,
    ) -> Result<Report> {
        let mut summary = self.summary(traces);
        summary.peak_memory_bytes = peak_memory_bytes();
        let time = self.task.camera.time();
        let mp4 = encode_movie(&self.reconstruction.video, time, MovieStyle::Stamped)?;
        let (title, command) = (report_meta.title, report_meta.reproduce);
        let page = self.with_view(traces, &summary, title, command, |files| {
            let truth = files.truth.map(|_| TRUTH);
            player.and_then(|make| make(files, &view_files::describe(files, truth)))
        });
        self.report_of(traces, &summary, report_meta, mp4.as_deref(), page.as_ref())
    }

    /// Writes what the viewer shows beside the video; the page for one file, where there is one.
    fn write_view(
        &self,
        traces: &Traces,
        summary: &ReconstructionSummary,
        folder: &OutputFolder,
        result_meta: &ResultMeta,
    ) -> Result<Option<PlayerPage>> {
        self.with_view(
            traces,
            summary,
            result_meta.title,
            result_meta.reproduce,
            |files| {
                let view = view_files::write(folder, files)?;
                let make = result_meta.player.as_ref();
                Ok(make.and_then(|make| make(files, &view)))
            },
        )
    }

    /// Does something with all that the viewer shows.
    fn with_view<T>(
        &self,
        traces: &Traces,
        summary: &ReconstructionSummary,
        title: &str,
        command: Option<&str>,
        act: impl FnOnce(&ViewFiles) -> T,
    ) -> T {
        let (task, direct) = (&self.task, self.direct());
        let truth = task.truth.as_ref();
        act(&ViewFiles {
            title,
            camera: &task.camera,
            video: &self.reconstruction.video,
            truth: truth.map(|truth| (truth, task.truth_file.as_deref())),
            frame: task.measurement.image(),
            psf: task.psfs.central().image(),
            residual: &self.reconstruction.residual,
            direct: direct.as_ref().map(|(image, _)| image.as_ref()),
            traces: &traces.annotated(),
            course: &self.curve,
            headline: &headline(summary),
            settings: &settings(task, summary),
            fit: (summary.fit, &summary.fit_reason),
            warnings: &summary.warnings,
            command: command.unwrap_or_default(),
        })
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
        summary: &ReconstructionSummary,
        report_meta: ReportMeta,
        mp4: Option<&[u8]>,
        page: Option<&PlayerPage>,
    ) -> Result<Report> {
        let task = &self.task;
        let direct = self.direct();
        let annotated = traces.annotated();
        rowburst_report::render(&ReportInput {
            title: report_meta.title,
            frame: task.measurement.image(),
            psf: task.psfs.central().image(),
            video: &self.reconstruction.video,
            truth: task.truth.as_ref(),
            direct: direct.as_ref().map(|(image, origin)| Direct {
                image,
                origin: *origin,
            }),
            residual: &self.reconstruction.residual,
            traces: &annotated,
            instants: task.camera.instants(),
            time: task.camera.time(),
            convergence: &self.curve,
            headline: headline(summary),
            fit: Some(FitVerdict {
                verdict: summary.fit,
                reason: &summary.fit_reason,
            }),
            settings: settings(task, summary),
            pixel_pitch_um: task.camera.sensor().pixel_pitch_um,
            mp4,
            player: page.map(|page| Player {
                script: &page.script,
                style: &page.style,
                data: &page.data,
            }),
            files: report_meta.files,
            reproduce: report_meta.reproduce,
        })
    }
}
