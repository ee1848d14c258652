//! A completed reconstruction: its numbers, its report and its folder of results.

use crate::artifacts::{Output, json_of};
use crate::format::percent;
use crate::formats::{VideoFormat, is_written, write_formats};
use crate::guide::{
    GUIDE_PICTURE, GuideOutcome, PLACES_LABELS, PLACES_TRACES, write_picture, write_places,
};
use crate::movie::{MovieStyle, encode_movie};
use crate::numbers::{headline, settings};
use crate::player::{MakePlayer, PlayerPage, player_of};
use crate::schema::RESULT_SCHEMA_VERSION;
use crate::summary::{
    CalibrationNumbers, ChangeNumbers, FitNumbers, HistoryPoint, MetadataNumbers, PriorCandidate,
    PriorChoice, ReconstructionSummary, peak_memory_bytes,
};
use crate::task::Task;
use crate::traces::{self, DebiasNumbers, TraceRequest, Traces};
use crate::view_files::{self, TRUTH, ViewFiles};
use rowburst::design::count::{change_rms, count_change};
use rowburst::linop::Background;
use rowburst::metrics::{psnr_db, ssim};
use rowburst::reconstruct::{Reconstruction, SigmaSource, Tau, Verdict};
use rowburst::simulate::direct_frame;
use rowburst::solve::StopReason;
use rowburst::vecmath::instruction_set;
use rowburst::{Cancel, Image, PatchSet, Result, RollingShutter};
use rowburst_io::{OutputFolder, write_npy_image, write_npy_u8, write_npy_video, write_patch_set};
use rowburst_report::{Direct, DirectOrigin, FitVerdict, Iteration, Player, Report, ReportInput};
use std::borrow::Cow;
use tracing::info;

/// Files of a result, with their descriptions.
const FILES: &[(&str, &str)] = &[
    ("video.npy", "the video, float32 [t, y, x], in counts"),
    (
        "video.tif",
        "the same as an ImageJ time stack (Fiji, napari)",
    ),
    ("video.ome.zarr", "the same as an OME-Zarr image (napari)"),
    ("video.mat", "the same for MATLAB, (rows, columns, frames)"),
    ("video.h5", "the same as HDF5, [t, y, x]"),
    #[cfg(feature = "mp4")]
    ("video.mp4", "the same slowed down, for browsers and slides"),
    (
        "traces.csv",
        "brightness over time of the brightest spots and regions, with standard errors",
    ),
    (
        "excluded.npy",
        "1 at the foreign pixels that were left out, u8 [y, x]",
    ),
    (
        "coverage.npy",
        "0 at the voxels that the frame does not observe, u8 [t, y, x]",
    ),
    ("report.html", "this page"),
    (
        "view.json, view-*.npy",
        "what rowburst view shows beside the video",
    ),
    ("result.json", "the numbers, for programs"),
];

/// Part of the pixels left out, and of the voxels not observed, from which there is a warning; smaller warns of a few hot
/// pixels.
const MIN_WARNED_FRACTION: f64 = 0.005;

/// Part of the voxels in the support from which a scene is dense; smaller counts for sparse scenes, whose change need not be
/// white.
const DENSE_FRACTION: f64 = 0.3;

/// The further file of a run that corrected its PSF.
const CORRECTED_PSF: &str = "psf-corrected.npy";
const CORRECTED_PSF_FILE: (&str, &str) = (
    CORRECTED_PSF,
    "the PSF as the frame has corrected it, float32 [y, x]: the PSF for the next frames",
);

/// The further file of a frame with smooth stray light.
const STRAY_LIGHT: &str = "stray-light.npy";
const STRAY_LIGHT_FILE: (&str, &str) = (
    STRAY_LIGHT,
    "smooth stray light that was taken away from the frame, in counts, float32 [y, x]",
);

/// The further file of a prior with a background.
const BACKGROUND_FILE: (&str, &str) = (
    "background.npy",
    "the part of the video that is background, float32 [t, y, x]",
);

/// The further file of a run with a guide.
const GUIDE_FILE: (&str, &str) = (
    GUIDE_PICTURE,
    "the guide as seen from the field, left, and the mean of the video over time: they must show the same places",
);

/// The further files of a run with the places of a guide.
const PLACES_FILES: [(&str, &str); 2] = [
    (
        PLACES_TRACES,
        "the trace of each place of the guide with its standard error, in counts",
    ),
    (
        PLACES_LABELS,
        "the place of each pixel of the field, from 1, int64 [y, x]; 0: none",
    ),
];

/// A task with its reconstruction.
pub struct CompletedTask {
    /// The task. After self-calibration it has the corrected PSFs and the corrected frame.
    pub task: Task,
    /// The PSFs as given; `None`: they were not corrected.
    pub given_psfs: Option<PatchSet>,
    /// The reconstruction. After [`Self::evaluate`] with `debias` its video is the refitted one.
    pub reconstruction: Reconstruction,
    /// What the guide gave; `None` without one. Where it is used, the video is that of its model, and the prior of the
    /// reconstruction means nothing.
    pub guide: Option<GuideOutcome>,
    /// The effect of debiasing; `None` without it.
    pub debias: Option<DebiasNumbers>,
    /// Time of the set-up in seconds: operator, Gram blocks, noise level.
    pub setup_seconds: f64,
    /// Time of the solver in seconds.
    pub seconds: f64,
    /// Time from the start of the program to the start of the solver, in seconds.
    pub start_offset_s: f64,
    /// The points of the convergence curve.
    pub convergence: Vec<Iteration>,
}

/// Title and origin of a report.
pub struct ReportMeta<'a> {
    /// Title of the page.
    pub title: &'a str,
    /// The command that reproduces the result.
    pub reproduce: Option<&'a str>,
    /// The files beside the page, with their descriptions.
    pub files: Vec<(String, String)>,
}

impl CompletedTask {
    /// Computes the requested traces and those of the brightest spots; with `debias` also the refitted video
    /// for [`Self::evaluate`].
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

    /// Computes the requested traces; with `debias` the refitted video replaces that of the reconstruction.
    pub fn evaluate(&mut self, request: TraceRequest, debias: bool) -> Traces {
        let mut traces = self.traces(request, debias);
        self.take_debiased(&mut traces);
        traces
    }

    /// Replaces the video of the reconstruction by the refitted video of `traces`, if there is one. Residual and
    /// fit stay those of the reconstruction.
    fn take_debiased(&mut self, traces: &mut Traces) {
        let Some(debiased) = traces.debiased.take() else {
            return;
        };
        let mut video = debiased.video;
        let coverage = &self.reconstruction.coverage;
        for (voxel, observed) in video.data_mut().iter_mut().zip(coverage) {
            *voxel *= f32::from(*observed);
        }
        let before = std::mem::replace(&mut self.reconstruction.video, video);
        traces.replace_values(&self.reconstruction.video);
        let truth = self.task.truth.as_ref();
        self.debias = Some(DebiasNumbers {
            light_ratio: debiased.light_ratio,
            bright_light_ratio: debiased.bright_light_ratio,
            untouched_bins: debiased.untouched_bins,
            psnr_db_before: truth.map(|t| psnr_db(before.data(), t.data())),
            ssim_before: truth.map(|t| ssim(&before, t)),
        });
    }

    /// The content of `result.json`. The peak memory is left open.
    pub fn summary(&self, traces: &Traces) -> ReconstructionSummary {
        let reconstruction = &self.reconstruction;
        let (options, truth) = (&self.task.options, self.task.truth.as_ref());
        let shape = reconstruction.video.shape();
        let (rows_before, columns_before) = self.task.camera.field_offset();
        ReconstructionSummary {
            schema_version: RESULT_SCHEMA_VERSION,
            version: env!("CARGO_PKG_VERSION"),
            prior: match self.used_guide() {
                Some(guide) => format!("guide {}", guide.numbers.model),
                None => reconstruction.prior.to_string(),
            },
            change_count: self.change_count(),
            guide: self.guide.as_ref().map(|guide| guide.numbers.clone()),
            prior_choice: self.choice(),
            tau: reconstruction.tau,
            tau_rule: match (options.tau, reconstruction.sigma_source) {
                _ if self.used_guide().is_some() => "none: the video is that of a guide",
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
            effective_sigma: reconstruction.effective_sigma,
            residual_over_sigma: reconstruction.residual_over_sigma,
            objective: reconstruction.certificate.primal,
            objective_excess: Some(reconstruction.certificate.excess()).filter(|e| e.is_finite()),
            certificate: reconstruction.certificate.to_string(),
            support_fraction: reconstruction.support_fraction,
            iterations: reconstruction.iterations,
            stop_reason: reconstruction.stop_reason.name(),
            seconds: self.seconds,
            setup_seconds: self.setup_seconds,
            peak_memory_bytes: None,
            frames: shape.bins,
            rows: shape.rows,
            columns: shape.columns,
            first_row: -(rows_before as i64),
            first_column: -(columns_before as i64),
            frame_rate_hz: self.task.camera.time().frame_rate_hz(),
            start_us: self.task.camera.time().start_us(),
            trigger_delay_us: self.task.camera.sensor().trigger_delay_us,
            metadata: MetadataNumbers::from(&self.task.from_metadata),
            bad_pixels: self.task.measurement.bad(),
            saturated_pixels: self.task.measurement.saturated(),
            self_calibration: reconstruction
                .calibration
                .as_ref()
                .map(CalibrationNumbers::new),
            excluded_fraction: reconstruction.excluded_fraction(),
            stray_light_fraction: self.stray_light_fraction(),
            coverage_fraction: reconstruction.coverage_fraction(),
            threads: rayon::current_num_threads(),
            simd: instruction_set(),
            seed: self.task.seed,
            psnr_db: truth.map(|t| psnr_db(reconstruction.video.data(), t.data())),
            ssim: truth
                .filter(|_| !self.is_stopped())
                .map(|t| ssim(&reconstruction.video, t)),
            fit: reconstruction.fit.verdict.name(),
            fit_reason: reconstruction.fit.reason.clone(),
            fit_statistics: FitNumbers::from(&reconstruction.fit.statistics),
            traces: traces.trace_numbers(truth),
            trace_errors: traces.standard_errors.clone(),
            debias: self.debias.clone(),
            history: self
                .convergence
                .iter()
                .map(|point| HistoryPoint::new(point, self.start_offset_s))
                .collect(),
            warnings: self.warnings(traces),
            run: None,
        }
    }

    /// Part of the light of the frame that is smooth stray light.
    pub fn stray_light_fraction(&self) -> f64 {
        let Some(stray) = &self.reconstruction.stray_light else {
            return 0.0;
        };
        let sum = |image: &Image| image.data().iter().map(|v| f64::from(*v)).sum::<f64>();
        let stray = sum(stray);
        // The measurement has been corrected.
        stray / (stray + sum(self.task.measurement.image()))
    }

    /// Whether the user stopped the run, and waits.
    fn is_stopped(&self) -> bool {
        self.reconstruction.stop_reason == StopReason::Interrupted
    }

    /// The guide that the video is made with.
    fn used_guide(&self) -> Option<&GuideOutcome> {
        self.guide.as_ref().filter(|guide| guide.numbers.used)
    }

    /// Whether there are traces of the places of a guide.
    fn has_places(&self) -> bool {
        let guide = self.guide.as_ref();
        guide.is_some_and(|guide| guide.numbers.known_places.is_some())
    }

    /// Whether the video is one picture in all bins.
    fn is_at_rest(&self) -> bool {
        self.reconstruction.prior.background() == Background::Alone && self.used_guide().is_none()
    }

    /// The note that the program has taken the scene for one at rest.
    fn rest_note(&self) -> Option<String> {
        let is_chosen = self.reconstruction.choice.is_some() && self.is_at_rest();
        is_chosen.then(|| {
            "taken for a scene at rest: one picture predicts held-out pixels as well as a video, and is in all bins; \
             the prior tv+16*tdiff allows for change"
                .into()
        })
    }

    /// How many numbers of an instant speak about the change of a dense scene.
    fn change_count(&self) -> Option<ChangeNumbers> {
        let reconstruction = &self.reconstruction;
        let video = &reconstruction.video;
        let is_dense = reconstruction.support_fraction >= DENSE_FRACTION && !self.is_at_rest();
        if !is_dense || video.shape().bins == 1 || self.is_stopped() {
            return None;
        }
        let operator = RollingShutter::new(&self.task.camera, self.task.psfs.clone());
        let change_rms = change_rms(video);
        let count = count_change(&operator, reconstruction.sigma, change_rms)?;
        Some(ChangeNumbers {
            informative: count.informative,
            of: count.of,
            change_rms,
        })
    }

    /// The warning of a dense scene whose change the frame does not tell.
    fn density_warning(&self) -> Option<String> {
        let numbers = self.change_count()?;
        let count = numbers.count();
        let is_told = self.used_guide().is_some() || !count.is_too_few();
        (!is_told).then(|| {
            format!(
                "too dense: {:.0} of {} numbers an instant speak about the change; believe the still part only",
                count.informative, count.of
            )
        })
    }

    /// How the prior was chosen.
    fn choice(&self) -> PriorChoice {
        if let Some(guide) = self.used_guide() {
            return PriorChoice {
                reason: format!("guide {}", guide.numbers.reason),
                held_out_pixels: None,
                candidates: Vec::new(),
            };
        }
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
                        "standard prior: no automatic choice with a time budget"
                    }
                    Some(_) => "given",
                    None => "standard prior: not compared with others (one bin, a small frame, stopped before, or a frame that does not belong to this PSF)",
                }
                .into(),
                held_out_pixels: None,
                candidates: Vec::new(),
            },
        }
    }

    /// Warnings that the user should read before trusting the video.
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
            warnings.push("the video is zero everywhere: the frame is consistent with noise of this level alone; check noise_sigma".into());
        }
        let missing = self.task.measurement.saturated();
        if missing > 0 {
            warnings.push(format!("{missing} saturated pixels were excluded"));
        }
        if let Some(found) = &reconstruction.calibration {
            let numbers = CalibrationNumbers::new(found);
            let what = if found.held_out.is_some() {
                "the frame has corrected its PSF and camera"
            } else {
                "the PSF has even light under it, the black level of its capture, which was taken away"
            };
            warnings.push(format!(
                "{what}: {numbers}; {CORRECTED_PSF} is the PSF for the next frames"
            ));
        }
        if let Some(guide) = self.guide.as_ref().filter(|guide| !guide.numbers.used) {
            warnings.push(format!("the guide was {}", guide.numbers.reason));
        }
        let guide = self.guide.as_ref();
        warnings.extend(guide.into_iter().flat_map(|g| g.numbers.places_warnings()));
        warnings.extend(self.rest_note());
        warnings.extend(self.density_warning());
        warnings.extend(self.coverage_warnings());
        warnings.extend(traces.warnings());
        if let (true, Some(why)) = (traces.debias_was_wanted, &traces.debias_failure) {
            warnings.push(format!("debiasing had no effect: {why}"));
        }
        warnings
    }

    /// Warnings of pixels that were left out and of voxels that the frame does not observe.
    fn coverage_warnings(&self) -> Vec<String> {
        let reconstruction = &self.reconstruction;
        let mut warnings = Vec::new();
        let excluded_fraction = reconstruction.excluded_fraction();
        if excluded_fraction >= MIN_WARNED_FRACTION {
            let excluded = reconstruction.excluded.iter().filter(|&&e| e == 1);
            warnings.push(format!(
                "{} foreign pixels ({} of the frame) belong to no video and were left out; see the report",
                excluded.count(),
                percent(excluded_fraction)
            ));
        }
        if reconstruction.stray_light.is_some() {
            warnings.push(format!(
                "smooth stray light ({} of the light) belongs to no video and was taken away from the frame; see the report",
                percent(self.stray_light_fraction())
            ));
        }
        let unobserved_fraction = 1.0 - reconstruction.coverage_fraction();
        if unobserved_fraction >= MIN_WARNED_FRACTION {
            warnings.push(format!(
                "{} of the voxels are not observed by the frame and are zero",
                percent(unobserved_fraction)
            ));
        }
        warnings
    }

    /// Writes all files into `folder`. `result.json` is written last, so a folder that has it is complete.
    ///
    /// # Errors
    /// Failed writes.
    pub fn write(&self, traces: &Traces, output: &Output) -> Result<ReconstructionSummary> {
        self.write_until(traces, output, &Cancel::default())
    }

    /// Like [`Self::write`]. Once `cancel` asks for the end only the files of [`Self::write_stopped`] are written.
    ///
    /// # Errors
    /// Failed writes.
    pub(crate) fn write_until(
        &self,
        traces: &Traces,
        output: &Output,
        cancel: &Cancel,
    ) -> Result<ReconstructionSummary> {
        if cancel.is_cancelled() {
            return self.write_stopped(traces, output);
        }
        let folder = output.folder;
        let mut summary = self.summary(traces);
        info!(
            "residual {:.4} σ, the fit is {}",
            summary.residual_over_sigma, summary.fit
        );
        let video = &self.reconstruction.video;
        let camera = &self.task.camera;
        self.write_arrays(folder)?;
        write_formats(folder, output.formats, video, camera)?;
        traces.write(folder, camera.time())?;
        if cancel.is_cancelled() {
            return self.write_stopped(traces, output);
        }
        let mp4 = encode_movie(video, camera.time(), output.movie)?;
        if cancel.is_cancelled() {
            return self.write_stopped(traces, output);
        }
        let writes_mp4 = is_written(output.formats, VideoFormat::Mp4, video.shape().voxels());
        if let Some(mp4) = mp4.as_ref().filter(|_| writes_mp4) {
            folder.write_bytes("video.mp4", mp4)?;
        }

        summary.peak_memory_bytes = peak_memory_bytes();
        let is_there = |name: &str| {
            let of_video = VideoFormat::ALL.into_iter().find(|format| {
                name.strip_prefix("video.")
                    .is_some_and(|end| end.ends_with(format.name()))
            });
            of_video.is_none_or(|format| is_written(output.formats, format, video.shape().voxels()))
        };
        let stray_light = self.reconstruction.stray_light.as_ref();
        let report_meta = ReportMeta {
            title: output.title,
            reproduce: output.reproduce,
            files: FILES
                .iter()
                .filter(|(name, _)| is_there(name))
                .chain(
                    self.reconstruction
                        .background
                        .as_ref()
                        .map(|_| &BACKGROUND_FILE),
                )
                .chain(self.given_psfs.as_ref().map(|_| &CORRECTED_PSF_FILE))
                .chain(stray_light.map(|_| &STRAY_LIGHT_FILE))
                .chain(self.guide.as_ref().map(|_| &GUIDE_FILE))
                .chain(PLACES_FILES.iter().filter(|_| self.has_places()))
                .map(|&(name, what)| (name.into(), what.into()))
                .collect(),
        };
        let page = self.write_view(traces, &summary, output)?;
        if cancel.is_cancelled() {
            return self.write_stopped(traces, output);
        }
        let report =
            self.report_of(traces, &summary, report_meta, mp4.as_deref(), page.as_ref())?;
        for picture in &report.pictures {
            folder.write_bytes(&picture.name, &picture.png)?;
        }
        folder.write_bytes("report.html", report.html.as_bytes())?;
        drop(report);
        summary.peak_memory_bytes = peak_memory_bytes();
        summary.run = output.finished_record("video.npy")?;
        folder.remove_stale()?;
        let json = json_of(&summary);
        folder.write_bytes("result.json", format!("{json}\n").as_bytes())?;
        Ok(summary)
    }

    /// Writes the video and the masks.
    fn write_arrays(&self, folder: &OutputFolder) -> Result<()> {
        let video = &self.reconstruction.video;
        // The file of an earlier run does not describe the new files.
        folder.remove("result.json")?;
        folder.write("video.npy", |w| write_npy_video(w, video))?;
        folder.remove("video.mp4")?;
        self.write_optional(folder)?;
        let frame = self.task.measurement.image();
        folder.write("excluded.npy", |w| {
            write_npy_u8(
                w,
                &[frame.rows(), frame.columns()],
                &self.reconstruction.excluded,
            )
        })?;
        let shape = video.shape();
        folder.write("coverage.npy", |w| {
            let shape = [shape.bins, shape.rows, shape.columns];
            write_npy_u8(w, &shape, &self.reconstruction.coverage)
        })
    }

    /// Writes what a run that was stopped has, within a second: the video, `traces`, and what the viewer shows. There is no
    /// report, no movie and no other format. `result.json` is written last.
    ///
    /// # Errors
    /// Failed writes.
    pub(crate) fn write_stopped(
        &self,
        traces: &Traces,
        output: &Output,
    ) -> Result<ReconstructionSummary> {
        let folder = output.folder;
        self.write_arrays(folder)?;
        folder.remove("report.html")?;
        traces.write(folder, self.task.camera.time())?;
        let mut summary = self.summary(traces);
        let (title, command) = (output.title, output.reproduce);
        self.with_view(traces, &summary, title, command, |files| {
            let files = ViewFiles {
                truth: None,
                ..*files
            };
            view_files::write(folder, &files)
        })?;
        summary.peak_memory_bytes = peak_memory_bytes();
        // The hash of a large video takes longer than its file.
        summary.run = output.record.map(|record| record.placed_in(output.path()));
        folder.remove_stale()?;
        let json = json_of(&summary);
        folder.write_bytes("result.json", format!("{json}\n").as_bytes())?;
        Ok(summary)
    }

    /// Writes the files that only some runs have, and removes those of an earlier run.
    fn write_optional(&self, folder: &OutputFolder) -> Result<()> {
        for name in [
            "background.npy",
            CORRECTED_PSF,
            "change.png",
            "psf-correction.png",
            "residual-before.png",
            STRAY_LIGHT,
            "stray-light.png",
            GUIDE_PICTURE,
            PLACES_TRACES,
            PLACES_LABELS,
        ] {
            folder.remove(name)?;
        }
        let found = &self.reconstruction;
        if let Some(guide) = &self.guide {
            write_picture(folder, &guide.registered, &found.video)?;
            write_places(folder, guide, self.task.camera.time())?;
        }
        if let Some(calibration) = &found.calibration {
            write_corrected_psf(folder, &calibration.psfs)?;
        }
        if let Some(stray_light) = &found.stray_light {
            folder.write(STRAY_LIGHT, |w| write_npy_image(w, stray_light))?;
        }
        if let Some(background) = &found.background {
            folder.write("background.npy", |w| write_npy_video(w, background))?;
        }
        Ok(())
    }

    /// The report alone, with the movie and the viewer's page in it where there are any.
    ///
    /// # Errors
    /// A movie that cannot be encoded, or a figure that cannot be drawn.
    pub fn report(
        &self,
        traces: &Traces,
        report_meta: ReportMeta,
        player: MakePlayer,
    ) -> Result<Report> {
        let mut summary = self.summary(traces);
        summary.peak_memory_bytes = peak_memory_bytes();
        let time = self.task.camera.time();
        let mp4 = encode_movie(&self.reconstruction.video, time, MovieStyle::Stamped)?;
        let (title, command) = (report_meta.title, report_meta.reproduce);
        let page = self.with_view(traces, &summary, title, command, |files| {
            let truth = files.truth.map(|_| TRUTH);
            player(files, &view_files::describe(files, truth))
        });
        self.report_of(traces, &summary, report_meta, mp4.as_deref(), page.as_ref())
    }

    /// Writes the files that the viewer shows beside the video. Returns the viewer's page for the report, if any.
    fn write_view(
        &self,
        traces: &Traces,
        summary: &ReconstructionSummary,
        output: &Output,
    ) -> Result<Option<PlayerPage>> {
        self.with_view(traces, summary, output.title, output.reproduce, |files| {
            let view = view_files::write(output.folder, files)?;
            Ok(player_of(output.path())(files, &view))
        })
    }

    /// Calls `act` with the files of the viewer.
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
            residual: &self.reconstruction.normalised_residual,
            excluded: &self.reconstruction.excluded,
            coverage: &self.reconstruction.coverage,
            direct: direct.as_ref().map(|(image, _)| image.as_ref()),
            traces: &traces.annotated(),
            convergence: &self.convergence,
            headline: &headline(summary),
            settings: &settings(task, summary),
            fit: (summary.fit, &summary.fit_reason),
            warnings: &summary.warnings,
            command: command.unwrap_or_default(),
        })
    }

    /// The frame of the scene without the diffuser: given, or computed from the truth.
    pub(crate) fn direct(&self) -> Option<(Cow<'_, Image>, DirectOrigin)> {
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

    /// The report of `summary`, with `mp4` and `page` in it.
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
            given_psf: self.given_psfs.as_ref().map(|psfs| psfs.central().image()),
            video: &self.reconstruction.video,
            truth: task.truth.as_ref(),
            direct: direct.as_ref().map(|(image, origin)| Direct {
                image,
                origin: *origin,
            }),
            residual: &self.reconstruction.normalised_residual,
            stray_light: self.reconstruction.stray_light.as_ref(),
            residual_before: {
                let calibration = self.reconstruction.calibration.as_ref();
                calibration.and_then(|found| found.residual_before.as_ref())
            },
            excluded: Some(&self.reconstruction.excluded),
            coverage: Some(&self.reconstruction.coverage),
            draws_change: summary.change_count.is_some(),
            change_count: summary.change_count.as_ref().map(ChangeNumbers::count),
            traces: &annotated,
            instants: task.camera.instants(),
            time: task.camera.time(),
            convergence: &self.convergence,
            headline: headline(summary),
            fit: Some(FitVerdict {
                verdict: summary.fit,
                reason: &summary.fit_reason,
            }),
            settings: settings(task, summary),
            sensor: task.camera.sensor(),
            mp4,
            player: page.map(|page| Player {
                script: page.script,
                style: page.style,
                data: &page.data,
            }),
            files: report_meta.files,
            reproduce: report_meta.reproduce,
        })
    }
}

/// Writes the PSF that the frame has corrected, or one for each patch of the field.
fn write_corrected_psf(folder: &OutputFolder, psfs: &PatchSet) -> Result<()> {
    match psfs.psfs() {
        [psf] => folder.write(CORRECTED_PSF, |w| write_npy_image(w, psf.image())),
        _ => write_patch_set(folder, CORRECTED_PSF.trim_end_matches(".npy"), psfs),
    }
}
