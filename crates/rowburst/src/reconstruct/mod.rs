//! Reconstruction of a video from one frame. This module joins the optical model to the solver.
//!
//! [`Problem`] solves `min ½‖W(b − A v)‖² + τ R(v)` over `v ≥ 0` for one frame, [`Sequence`] for
//! consecutive frames of one scene, and [`Chunked`] for videos that do not fit into memory. [`Model`]
//! holds `A`, [`Prior`] is `R`, and [`Fit`] says whether the result explains the frame.

mod checkpoint;
mod choose;
mod chunked;
mod covered_rows;
mod data_step;
mod exclusion;
mod fit;
mod foreign;
mod frame_data;
mod given_video;
mod held_out;
mod held_out_check;
mod held_out_run;
mod model;
mod model_check;
mod prior;
mod self_calibration;
mod sequence;
mod sigma;
mod stray_light;
mod wrong_model;
mod x_step;

use checkpoint::Checkpoint;
use choose::BestTrial;
pub use choose::{CANDIDATES, Candidate, Choice, DENSE_CANDIDATES, OPEN_CANDIDATES};
pub use chunked::{Chunked, SolvedChunk};
pub use data_step::DataStep;
pub use fit::{Fit, FitStatistics, TrimmedChiSquared, Verdict};
pub use model::Model;
pub use prior::Prior;
use rowburst_core::error::Subject;
pub use self_calibration::{
    Calibration, FoundParameter, HeldOutErrors, ModelParameter, SelfCalibration, calibrate,
};
pub use sequence::Sequence;
pub use sigma::estimate_sigma;

use frame_data::FrameData;
use held_out_run::HeldOutRun;
use rowburst_core::linop::Background;
use rowburst_core::{Error, ErrorKind, Parameter, Result, phrase};
use rowburst_optics::measurement::Measurement;
use rowburst_optics::{Camera, Image, PatchSet, Shutter, Video};
use rowburst_solve::admm::{Admm, AdmmParams, Progress, Solution, TauRule, Tuning};
use rowburst_solve::prox::Prox;
use rowburst_solve::{Certificate, DataTerm, StopReason};
use sigma::Bands;
use std::ops::ControlFlow;
use stray_light::StrayLight;
use tracing::info;

/// Revision of the algorithm. Every change that alters the numbers for the same input raises it by
/// one, also within a version of the program. An archive of many frames is not continued with another
/// revision.
pub const ALGORITHM_REVISION: u32 = 39;

/// Thirds of the iterations that may find `τ` before its factor applies; larger leaves fewer for the final `τ`.
const TAU_SEARCH_THIRDS: usize = 2;

/// Most iterations for a frame that does not belong to its PSF: enough to show that the fit is bad.
const WRONG_MODEL_ITERATIONS: usize = 80;

/// Options of a reconstruction.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Options {
    /// The prior; `None`: the candidate that predicts held-out pixels best ([`CANDIDATES`], in dense scenes
    /// [`OPEN_CANDIDATES`] and [`DENSE_CANDIDATES`]).
    pub prior: Option<Prior>,
    /// The rule for `τ`.
    pub tau: Tau,
    /// Standard deviation of the noise in counts, for a pixel with weight 1; `None`: taken from the
    /// calibration or else estimated (see [`SigmaSource`]).
    pub noise_sigma: Option<f64>,
    /// Limit of the number of iterations; `None`: the solver's default.
    pub max_iterations: Option<usize>,
    /// Whether the frame corrects its PSF and its camera.
    pub self_calibration: SelfCalibration,
    /// Uses every pixel with a weight above zero: no search for foreign pixels.
    pub keep_all_pixels: bool,
    /// Takes the frame and `σ` as they are: no search for foreign pixels and no effective `σ`, which take time.
    pub is_preview: bool,
    /// The constants of the solver; unstable. The search for foreign pixels and self-calibration have the standard ones, with the
    /// brightness not capped.
    pub tuning: Tuning,
}

/// What the options say of every run of the solver.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct SolverSettings {
    /// See [`Options::max_iterations`].
    pub max_iterations: Option<usize>,
    /// See [`Options::tuning`].
    pub tuning: Tuning,
}

impl SolverSettings {
    /// For runs that judge a model, a prior or pixels: these are judged at fixed iterations, for which the patience of
    /// [`Tuning::coupled`] is too long; its thresholds of dim bins go with it (docs/design/025).
    pub fn of_a_trial(mut self) -> Self {
        self.tuning.coupled = self.tuning.small;
        self
    }

    /// For trials that look for foreign pixels or errors of the model. Both look like faint light in dim bins; a threshold by
    /// the brightest bins keeps it out (docs/design/007).
    pub fn of_a_search(self) -> Self {
        let mut settings = self.of_a_trial();
        settings.tuning.max_brightness_ratio = f64::MAX;
        settings
    }
}

impl Options {
    /// Checks the values that no frame can make right.
    ///
    /// # Errors
    /// A `τ` or `σ` that is not finite and above zero, or a constant of the solver that [`Tuning::check`] refuses.
    pub fn check(&self) -> Result<()> {
        for (name, value) in [
            (Parameter::Tau, self.tau.given()),
            (Parameter::NoiseSigma, self.noise_sigma),
        ] {
            if let Some(value) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
                return Err(Error::input(
                    name,
                    value,
                    "the value is a finite number above zero",
                    "Leave it out: the program estimates it.",
                ));
            }
        }
        check_tuning(self.tuning)
    }

    /// The data term of a frame. With a given `τ` the objective is that of the video itself. Where rows share bins and the
    /// noise follows the light, factors of rows would add degrees of freedom that dark pixels cannot test (docs/design/032).
    fn frame_data(&self, model: &Model, measurement: &Measurement) -> FrameData {
        let rows_share_bins = !model.operator().time().is_disjoint();
        if self.tau.given().is_some() || rows_share_bins && measurement.noise().is_some() {
            FrameData::unscaled(model, measurement)
        } else {
            FrameData::new(model, measurement)
        }
    }

    fn solver_settings(&self) -> SolverSettings {
        SolverSettings {
            max_iterations: self.max_iterations,
            tuning: self.tuning,
        }
    }
}

/// The rule for `τ` of `½‖W(b − A v)‖² + τ R(v)`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Tau {
    /// The discrepancy principle. The noise level is that of [`Problem::sigma`]; where it is unknown,
    /// held-out pixels determine it.
    #[default]
    Auto,
    /// The discrepancy principle with the noise level that predicts held-out pixels best.
    HeldOut,
    /// This value; it is finite and above zero.
    Given(f64),
}

impl Tau {
    /// The value, if it is given.
    fn given(self) -> Option<f64> {
        match self {
            Self::Given(tau) => Some(tau),
            Self::Auto | Self::HeldOut => None,
        }
    }
}

/// The source of the noise level `σ`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum SigmaSource {
    /// [`Options::noise_sigma`].
    Given,
    /// Gain and read noise of the sensor.
    Calibration,
    /// The frequencies of the frame that the PSF passes least ([`estimate_sigma`]).
    Frame,
    /// The noise level at which the video predicts held-out pixels best.
    HeldOut,
}

impl SigmaSource {
    /// The description in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Given => "given",
            Self::Calibration => "from the calibration",
            Self::Frame => "estimated from the frame",
            Self::HeldOut => "by held-out pixels",
        }
    }
}

/// The reconstruction of one frame, set up and ready to run.
pub struct Problem {
    data: FrameData,
    measurement: Measurement,
    /// Whether each pixel is foreign and left out.
    excluded: Vec<bool>,
    options: Options,
    sigma: f64,
    /// The noise of a pixel with weight 1 together with the error of the model.
    effective_sigma: f64,
    /// Whether the support of the check of the model exceeds a third of the voxels.
    is_dense: bool,
    /// Frame, PSF and shutter do not belong together: no search mends the model, and all priors are as good.
    has_wrong_model: bool,
    /// Held-out error over `sigma` where the frame sees too little of the scene to judge the model by it.
    undersampled_error: Option<f64>,
    /// A shutter of another kind that explains the frame, which the camera's does not.
    other_shutter: Option<Shutter>,
    sigma_source: SigmaSource,
    /// The PSF without the floor that its capture shows, with which all else is found.
    psf_floor: Option<Calibration>,
    calibration: Option<Calibration>,
    /// Smooth stray light, which was taken away from `measurement`.
    stray_light: Option<StrayLight>,
    tau_factor: f64,
    camera: Camera,
    bands: Bands,
    /// Whether the check has shown that the model explains the frame.
    passed_check: bool,
    /// That check, from which the final run goes on if it has the same prior.
    checked_run: Option<HeldOutRun>,
    /// The result of the last check on held-out pixels, for a run that is stopped before it has a better one.
    last_check: Option<Box<RunResult>>,
}

/// A reconstructed video, with the quantities that judge it.
///
/// It holds the video in memory. Of a video too large for that, [`Chunked`] gives one `Reconstruction` for each chunk,
/// and of a raw colour frame there is one for each plane.
///
/// Extensions have their place here. With a fourth axis `video`, `background` and `coverage` become `[c, t, y, x]`; the
/// fields of the frame's shape stay. A mask of what the frame determines of a found PSF, gain or offset belongs to
/// [`Calibration`], beside the values. For complex values [`Video`] takes the type of its elements as a parameter;
/// residual, weights and fit stay real, as frames are.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// The video in counts, `[t, y, x]`.
    pub video: Video,
    /// The background in `video`, `[t, y, x]`; `None` for a prior without a background.
    pub background: Option<Video>,
    /// `W(b − A v)/σ`, `[y, x]`; 0 at pixels with weight 0.
    pub normalised_residual: Image,
    /// Root mean square of `W(b − A v)/σ` over the pixels with weight above 0.
    pub residual_over_sigma: f64,
    /// The prior, given or chosen.
    pub prior: Prior,
    /// The candidates and the choice; `None` where the prior was not chosen.
    pub choice: Option<Choice>,
    /// `τ` at the end.
    pub tau: f64,
    /// `½‖W(b − A v)‖² + τ R(v)` at the end, with a lower bound of its minimum. The bound holds for
    /// this `τ`, over videos on the support that are at most twice as bright.
    pub certificate: Certificate,
    /// The weights `W` at the end, `[y, x]`; `None`: all 1.
    pub weights: Option<Vec<f32>>,
    /// Noise of a pixel with weight 1, in counts.
    pub sigma: f64,
    /// Noise and error of the model at a pixel with weight 1, in counts: `τ` follows from it. It is `sigma` where the
    /// model explains the frame, where the frame sees too little of the scene to tell, and where `sigma` is given.
    pub effective_sigma: f64,
    /// 1 at the foreign pixels, which were left out, else 0; `[y, x]`.
    pub excluded: Vec<u8>,
    /// 1 at the voxels that the frame observes, else 0; `[t, y, x]`. The others are zero in `video`.
    pub coverage: Vec<u8>,
    /// The source of `sigma`.
    pub sigma_source: SigmaSource,
    /// The correction of PSF and camera that the video is made with; `None`: as given.
    pub calibration: Option<Calibration>,
    /// Smooth stray light that was taken away from the frame before the correction of the camera, `[y, x]`, in counts; `None`:
    /// none was found.
    pub stray_light: Option<Image>,
    /// Number of iterations.
    pub iterations: usize,
    /// Why the solver stopped.
    pub stop_reason: StopReason,
    /// Fraction of the voxels that are in the support at the end.
    pub support_fraction: f64,
    /// Whether the model explains the frame.
    pub fit: Fit,
}

impl Reconstruction {
    /// Part of the pixels that are foreign and were left out.
    pub fn excluded_fraction(&self) -> f64 {
        ones(&self.excluded)
    }

    /// Part of the voxels that the frame observes.
    pub fn coverage_fraction(&self) -> f64 {
        ones(&self.coverage)
    }

    /// The frame that the video explains: `measurement` without the stray light, and as an ideal camera would have measured
    /// it. The foreign pixels keep their weights.
    ///
    /// # Panics
    /// If the frame has another size.
    #[must_use]
    pub fn corrected(&self, measurement: &Measurement) -> Measurement {
        let corrected = match &self.stray_light {
            Some(light) => measurement.without_light(light.data()),
            None => measurement.clone(),
        };
        match &self.calibration {
            Some(calibration) => calibration.corrected(&corrected),
            None => corrected,
        }
    }
}

impl Problem {
    /// Sets up the reconstruction of `measurement`: the operator, the Gram blocks and the noise level.
    /// `psf` is one PSF for the whole field (`&Psf`) or one for each patch of it (`&PatchSet`).
    ///
    /// # Errors
    /// Those of [`Problem::with_model`].
    pub fn new(
        measurement: &Measurement,
        camera: &Camera,
        psf: impl Into<PatchSet>,
        options: Options,
    ) -> Result<Self> {
        Self::with_model(&Model::new(camera, psf), measurement, options)
    }

    /// Sets up the reconstruction of one of several frames that share `model`.
    ///
    /// # Errors
    /// A frame of another size than the camera's, a flat PSF ([`PatchSet::check_contrast`]), a `τ` or `σ` that is not finite
    /// and above zero, a constant of the solver that [`Tuning::check`] refuses, a prior with a term over
    /// time for a video of one bin ([`Prior::check_bins`]), or [`Model::cancel`].
    pub fn with_model(model: &Model, measurement: &Measurement, options: Options) -> Result<Self> {
        let (camera, psf) = (model.camera(), model.psfs());
        let image = measurement.image();
        if (image.rows(), image.columns()) != (camera.rows(), camera.columns()) {
            return Err(Error::input(
                Parameter::Frame,
                format!("{}×{} pixels", image.rows(), image.columns()),
                format!("the camera has {}×{}", camera.rows(), camera.columns()),
                phrase!["Give the frame of ", Parameter::Camera, "."],
            )
            .with_kind(ErrorKind::Shape));
        }
        psf.check_contrast()?;
        options.check()?;
        check_tau_has_use(options.tau.given(), measurement, camera)?;
        let bands = Bands::new(measurement, psf.central());
        let (sigma, sigma_source) = noise_of(measurement, &bands, &options);
        if !(sigma.is_finite() && sigma > 0.0) {
            return Err(Error::input(
                Parameter::Frame,
                format!("a noise level of {sigma}, {}", sigma_source.name()),
                "the noise level is above zero: a frame holds light and noise",
                phrase![
                    "Check the frame, gain and read noise, or give ",
                    Parameter::NoiseSigma,
                    "."
                ],
            ));
        }
        if let Some(prior) = options.prior {
            prior.check_bins(camera.video_shape().bins)?;
        }
        model.cancel().check()?;
        let data = options.frame_data(model, measurement);
        model.cancel().check()?;
        info!(
            "set up a frame: σ {sigma:.4e} counts {}, {} usable pixels",
            sigma_source.name(),
            data.measurement_count()
        );
        Ok(Self {
            camera: camera.clone(),
            bands,
            data,
            excluded: vec![false; measurement.image().data().len()],
            measurement: measurement.clone(),
            options,
            sigma,
            effective_sigma: sigma,
            is_dense: false,
            has_wrong_model: false,
            undersampled_error: None,
            other_shutter: None,
            sigma_source,
            psf_floor: None,
            calibration: None,
            stray_light: None,
            tau_factor: 1.0,
            passed_check: false,
            checked_run: None,
            last_check: None,
        })
    }

    /// Multiplies the `τ` of the discrepancy principle by `tau_factor`. With the prior and the
    /// [`Candidate::tau_factor`] of [`Problem::choose`], [`Problem::solve`] gives the video of the
    /// automatic choice. The factor has no effect where `τ` is given or `solve` chooses the prior.
    ///
    /// # Panics
    /// If `tau_factor` is not above zero.
    #[must_use]
    pub fn with_tau_factor(self, tau_factor: f64) -> Self {
        assert!(tau_factor > 0.0, "a factor above zero, not {tau_factor}");
        Self { tau_factor, ..self }
    }

    /// The options.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// Noise of a pixel with weight 1, in counts. A guess where held-out pixels will determine it.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// Chooses the noise level and the prior where they are left open, and runs the solver. `observer`
    /// is called after every iteration and may stop the run; the result is then the video so far.
    ///
    /// # Errors
    /// An objective that is not finite: the numbers overflowed. A run that is cancelled before its first iteration.
    pub fn solve(
        mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<Reconstruction> {
        let mut residual_history = Vec::new();
        let found = self.choose_and_run(&mut |progress| {
            if progress.iteration == 1 {
                residual_history.clear();
            }
            residual_history.push(progress.residual_rms);
            observer(progress)
        });
        let found = found.unwrap_or_else(|partial| {
            let partial = self.better_partial(partial);
            // It may be of a search with another prior than that of the data.
            let background = partial.prior.background();
            if background != self.data.background() {
                self.data.reset(background, None);
            }
            *partial
        });
        if found.solution.iterations == 0 {
            self.data.cancel().check()?;
        }
        self.build_reconstruction(found, &residual_history)
    }

    /// The better one of a run that was stopped and the last check on held-out pixels: a later search may just have begun,
    /// or look at the frame through a loose fit.
    fn better_partial(&mut self, partial: Box<RunResult>) -> Box<RunResult> {
        let stop_reason = partial.solution.stop_reason;
        match self.last_check.take() {
            Some(mut check)
                if partial.solution.iterations == 0 || check.misfit() < partial.misfit() =>
            {
                check.solution.stop_reason = stop_reason;
                check
            }
            _ => partial,
        }
    }

    /// Adds residual, background and fit statistics to the result of a run.
    fn build_reconstruction(
        &self,
        found: RunResult,
        residual_history: &[f64],
    ) -> Result<Reconstruction> {
        let RunResult {
            prior,
            choice,
            solution,
        } = found;
        if !solution.certificate.primal.is_finite() {
            return Err(Error::work(
                Subject::named("reconstruction"),
                "the numbers overflowed",
                phrase![
                    "Check that frame and PSF hold plausible values, and give ",
                    Parameter::NoiseSigma,
                    "."
                ],
            )
            .with_kind(ErrorKind::Overflow));
        }
        let shape = self.data.video_shape();
        let measurement_count = self.data.measurement_count() as f64;
        let residual_rms =
            rowburst_core::vecmath::norm(&solution.residual) / measurement_count.sqrt();
        let residual = solution.residual.iter();
        let normalised_residual = Image::new(
            self.camera.rows(),
            self.camera.columns(),
            residual
                .map(|r| (f64::from(*r) / self.sigma) as f32)
                .collect(),
        )?;
        let background = self.background_of(prior, &solution.video)?;
        let stray_light = self.stray_light.as_ref().map(StrayLight::image);
        let coverage = self.data.coverage();
        let excluded: Vec<u8> = self.excluded.iter().map(|&e| u8::from(e)).collect();
        let video = Video::new(shape, self.data.video(solution.video))?;
        let scaled = self.data.measurements().iter();
        let measured: Vec<f32> = scaled
            .map(|b| (f64::from(*b) / self.sigma) as f32)
            .collect();
        let fit = fit::judge(&fit::FitInput {
            normalised_residual: &normalised_residual,
            measured: &measured,
            weights: self.data.weights(),
            camera: &self.camera,
            other_shutter: self.other_shutter.as_ref(),
            bands: &self.bands,
            video: &video,
            degrees_of_freedom: solution.degrees_of_freedom,
            max_freedom: self.options.tuning.max_freedom,
            residual_history,
            sigma: self.sigma,
            effective_sigma: self.effective_sigma,
            undersampled_error: self.undersampled_error,
            excluded_fraction: ones(&excluded),
            sigma_source: self.sigma_source,
            tau_is_given: matches!(self.options.tau, Tau::Given(_)),
            stop_reason: solution.stop_reason,
            support_fraction: solution.support_fraction,
        });
        Ok(Reconstruction {
            video,
            background,
            normalised_residual,
            residual_over_sigma: residual_rms / self.sigma,
            tau: solution.tau,
            certificate: solution.certificate,
            weights: self.data.weights().map(<[f32]>::to_vec),
            prior,
            choice,
            sigma: self.sigma,
            effective_sigma: self.effective_sigma,
            excluded,
            coverage,
            sigma_source: self.sigma_source,
            calibration: self.whole_calibration(),
            stray_light,
            iterations: solution.iterations,
            stop_reason: solution.stop_reason,
            support_fraction: solution.support_fraction,
            fit,
        })
    }

    /// The background of a stacked video; `None` for a prior without one.
    fn background_of(&self, prior: Prior, stacked: &[f32]) -> Result<Option<Video>> {
        let shape = self.data.video_shape();
        let background = prior.background();
        if background == Background::None {
            return Ok(None);
        }
        let mut alone = stacked.to_vec();
        alone[..background.first_len(shape)].fill(0.0);
        Video::new(shape, background.sum(shape, &alone).into_owned()).map(Some)
    }

    /// Chooses the prior and its factor on `τ`, as [`Problem::solve`] does where no prior is given, and
    /// stops there. Returns `None` for a video of one bin, for a frame with too few pixels to hold out, and for one that does
    /// not belong to the PSF.
    ///
    /// # Errors
    /// The observer stopped it; the error is the reason.
    pub fn choose(
        mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<Option<Choice>, StopReason> {
        let stopped = |found: Box<RunResult>| found.solution.stop_reason;
        self.resolve_tau_rule(observer).map_err(stopped)?;
        self.check_model(Prior::STANDARD, observer)
            .map_err(stopped)?;
        if self.has_wrong_model {
            return Ok(None);
        }
        let rule = self.tau_rule();
        let chosen = self.compare_priors(rule, observer).map_err(stopped)?;
        Ok(chosen.map(|(choice, _)| choice))
    }

    /// Determines the rule for `τ`. Where the noise level is unknown or is to be found afresh, runs the solver on
    /// held-out pixels and sets `sigma`. The error is the result so far of a run that the observer stopped.
    fn resolve_tau_rule(
        &mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<TauRule, Box<RunResult>> {
        let default_prior = self.options.prior.unwrap_or(Prior::STANDARD);
        let is_unknown = self.sigma_source == SigmaSource::HeldOut && self.options.tau == Tau::Auto;
        if is_unknown || self.options.tau == Tau::HeldOut {
            let settings = self.options.solver_settings().of_a_trial();
            self.sigma = choose::noise_level(&mut self.data, default_prior, settings, observer)?;
            self.sigma_source = SigmaSource::HeldOut;
            self.effective_sigma = self.sigma;
            info!(
                "noise level by held-out pixels: σ {:.4e} counts",
                self.sigma
            );
        }
        Ok(self.tau_rule())
    }

    /// The rule for `τ` at the present effective noise level.
    fn tau_rule(&self) -> TauRule {
        match self.options.tau {
            Tau::Given(tau) => TauRule::Fixed(tau),
            Tau::Auto | Tau::HeldOut => TauRule::Discrepancy {
                sigma: self.effective_sigma,
            },
        }
    }

    /// Compares the candidates on held-out pixels. Returns the choice and the best trial; `None` for one bin or too few
    /// pixels.
    fn compare_priors(
        &mut self,
        rule: TauRule,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<Option<(Choice, Option<BestTrial>)>, Box<RunResult>> {
        // The candidates differ only in their terms over time.
        if self.data.video_shape().bins == 1 || !choose::can_choose(&self.data) {
            return Ok(None);
        }
        let checked = match self.checked_run.take() {
            Some(run) if !self.is_dense && run.rule() == rule => Some(run),
            Some(run) => {
                self.last_check = Some(Box::new(run.into_result(&self.data)));
                None
            }
            None => None,
        };
        let settings = self.options.solver_settings().of_a_trial();
        let refinement = self.calibration.as_ref().and_then(|c| c.psf_refinement);
        let conditions = choose::Conditions {
            is_dense: self.is_dense,
            has_refined_psf: refinement.is_some(),
            checked,
        };
        choose::choose_prior(
            &mut self.data,
            rule,
            self.sigma,
            settings,
            conditions,
            observer,
        )
        .map(Some)
    }

    /// Makes the choices that are left open, then runs the solver. The error is the result so far of a
    /// choice that the observer stopped.
    fn choose_and_run(
        &mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<RunResult, Box<RunResult>> {
        let default_prior = self.options.prior.unwrap_or(Prior::STANDARD);
        let trials = match self.options.prior {
            Some(_) => 0,
            None => CANDIDATES.len(),
        };
        let mut before_trials = |progress: &Progress| {
            let label = match progress.label {
                "" => "checking the model",
                label => label,
            };
            observer(&Progress {
                label,
                runs_left: trials + 1,
                ..*progress
            })
        };
        self.resolve_tau_rule(&mut before_trials)?;
        self.check_model(default_prior, &mut before_trials)?;
        let rule = self.tau_rule();
        let (choice, mut best_trial) = match self.options.prior {
            Some(_) => (None, None),
            None if self.has_wrong_model => (None, None),
            None => match self.compare_priors(rule, observer)? {
                Some((choice, best_trial)) => (Some(choice), best_trial),
                None => (None, None),
            },
        };
        if best_trial.is_some() {
            self.last_check = None;
        }
        let (prior, tau_factor) = match &choice {
            Some(choice) => (choice.best().prior, choice.best().tau_factor),
            None => {
                let found = self.tau_factor_at_rest(default_prior, rule, observer)?;
                (default_prior, self.tau_factor * found)
            }
        };
        let settings = self.options.solver_settings();
        let mut params = prior.admm_params(self.data.video_shape(), rule, settings);
        if self.has_wrong_model {
            params.max_iterations = params.max_iterations.min(WRONG_MODEL_ITERATIONS);
        }
        info!("final run: prior {prior}, factor {tau_factor} on τ");
        let checkpoint = best_trial.as_mut().and_then(BestTrial::take_checkpoint);
        let (mut run, mut prox) = match self.begin_run(prior, params, checkpoint, observer) {
            Ok(begun) => begun,
            Err(stopped) => return Ok(self.better_result(*stopped, choice, best_trial)),
        };
        let video_form = self.data.video_form(prior.background());
        let mut observe = |progress: &Progress| video_form.observe(progress, observer);
        let mut run_until = |run: &mut Admm, data: &mut FrameData, until| {
            run.run(data, &mut *prox, until, &mut observe)
        };
        let mut stop_reason = None;
        if tau_factor != 1.0 && rule.is_discrepancy() {
            // The factor applies to the `τ` of the discrepancy principle, so the run finds that `τ` first.
            run.set_tolerance(choose::TOLERANCE);
            let reason = run_until(
                &mut run,
                &mut self.data,
                TAU_SEARCH_THIRDS * params.max_iterations / 3,
            );
            match reason {
                StopReason::TimeBudget | StopReason::Interrupted => stop_reason = Some(reason),
                _ => {
                    run.set_tau_rule(TauRule::Fixed(tau_factor * run.tau()), &self.data);
                    run.set_tolerance(params.tolerance);
                }
            }
        }
        let stop_reason = stop_reason
            .unwrap_or_else(|| run_until(&mut run, &mut self.data, params.max_iterations));
        let solution = run.into_solution(&self.data, &*prox, stop_reason);
        info!(
            "final run: {} iterations, {}, τ {:.4e}",
            solution.iterations,
            stop_reason.name(),
            solution.tau
        );
        let result = RunResult::new(prior, solution);
        Ok(self.better_result(result, choice, best_trial))
    }

    /// The factor on `τ` for a video that is one picture, which the discrepancy principle smooths too little; 1 for others.
    fn tau_factor_at_rest(
        &mut self,
        prior: Prior,
        rule: TauRule,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<f64, Box<RunResult>> {
        let is_open = rule.is_discrepancy() && self.tau_factor == 1.0 && !self.options.is_preview;
        let has_use = choose::is_one_picture(&prior, &self.data) && choose::can_choose(&self.data);
        if !is_open || !has_use || self.has_wrong_model {
            return Ok(1.0);
        }
        if let Some(run) = self.checked_run.take() {
            self.last_check = Some(Box::new(run.into_result(&self.data)));
        }
        let settings = self.options.solver_settings().of_a_trial();
        choose::tau_factor(&mut self.data, prior, rule, self.sigma, settings, observer)
    }

    /// The beginning of the final run. Where the model explains the frame, it is one without held-out pixels: that of the check,
    /// or for another prior one like it, so that a prior gives the same video chosen or given. `checkpoint` is such a
    /// beginning, of the trial of `prior`.
    fn begin_run(
        &mut self,
        prior: Prior,
        params: AdmmParams,
        checkpoint: Option<Checkpoint>,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<(Admm, Box<dyn Prox>), Box<RunResult>> {
        let checkpoint = checkpoint.filter(|c| c.run.prior == prior && self.is_explained(&c.check));
        let checked = self.checked_run.take();
        // Where rows share bins a trial takes other constants than a final run.
        if self.passed_check && params.tau.is_discrepancy() && !self.data.is_coupled() {
            if let Some(checkpoint) = checkpoint {
                return Ok(checkpoint.with_all_pixels(&mut self.data));
            }
            let begun = match checked {
                Some(checked) if checked.prior == prior => checked,
                _ => self.held_out_run(0.0, prior, observer)?.1,
            };
            return Ok(begun.with_all_pixels(&mut self.data));
        }
        self.data.reset(prior.background(), None);
        let run = Admm::new(&self.data, self.data.shape(), params);
        Ok((run, self.data.prox(&prior)))
    }

    /// `result` with the choice that led to it. A run that was stopped early may fit worse than the trial of its prior, or
    /// than the check; then these count.
    fn better_result(
        &mut self,
        result: RunResult,
        choice: Option<Choice>,
        best_trial: Option<BestTrial>,
    ) -> RunResult {
        let stop_reason = result.solution.stop_reason;
        if let StopReason::Interrupted | StopReason::TimeBudget = stop_reason {
            let found = match best_trial {
                Some(best_trial) if best_trial.misfit() < result.misfit() => {
                    best_trial.stopped(stop_reason)
                }
                Some(_) => Box::new(result),
                None => self.better_partial(Box::new(result)),
            };
            return RunResult { choice, ..*found };
        }
        RunResult { choice, ..result }
    }
}

/// Part of the values that are 1.
fn ones(mask: &[u8]) -> f64 {
    let count: usize = mask.iter().map(|&v| usize::from(v)).sum();
    count as f64 / mask.len().max(1) as f64
}

/// A callback after every iteration, which may stop the run.
type Observer<'o> = dyn FnMut(&Progress) -> ControlFlow<StopReason> + 'o;

/// The result of a run of the solver.
struct RunResult {
    prior: Prior,
    choice: Option<Choice>,
    solution: Solution,
}

impl RunResult {
    fn new(prior: Prior, solution: Solution) -> Self {
        Self {
            prior,
            choice: None,
            solution,
        }
    }

    /// Norm of `W(b − A v)`, 0 at held-out pixels.
    fn misfit(&self) -> f64 {
        rowburst_core::vecmath::norm(&self.solution.residual)
    }
}

/// A given `τ` over the largest sum of the frame's light that a voxel can explain, above which the video is zero by far.
const MAX_TAU_OVER_LIGHT: f64 = 1e3;

/// Refuses a `τ` so large that the video is zero for any frame of this brightness.
fn check_tau_has_use(tau: Option<f64>, measurement: &Measurement, camera: &Camera) -> Result<()> {
    let values = measurement.image().data().iter();
    let brightest = values.fold(0.0f64, |max, v| max.max(f64::from(v.abs())));
    let params = camera.params();
    let row_times = 1.0 + params.exposure_us / params.row_time_us;
    let limit = MAX_TAU_OVER_LIGHT * brightest * row_times;
    match tau.filter(|tau| *tau > limit) {
        None => Ok(()),
        Some(tau) => Err(Error::input(
            Parameter::Tau,
            format!("{tau:e}"),
            format!("above {limit:.1e} the video of this frame is zero"),
            "Leave it out: the program finds it.",
        )),
    }
}

/// Refuses constants of the solver that make no sense.
fn check_tuning(tuning: Tuning) -> Result<()> {
    tuning.check().map_err(|error| {
        let remedy = "Start from Tuning::STANDARD and change constants by Tuning::set.";
        Error::input(Parameter::Tuning, error.name(), error.to_string(), remedy)
    })
}

/// The standard deviation of the noise in counts, and its source.
fn noise_of(measurement: &Measurement, bands: &Bands, options: &Options) -> (f64, SigmaSource) {
    match (options.noise_sigma, measurement.sigma()) {
        (Some(sigma), _) => (sigma, SigmaSource::Given),
        (None, Some(sigma)) => (sigma, SigmaSource::Calibration),
        (None, None) => match bands.sigma(measurement) {
            Some(sigma) => (sigma, SigmaSource::Frame),
            // A guess until held-out pixels determine it.
            None => (
                rms(measurement.image().data()) / 256.0,
                SigmaSource::HeldOut,
            ),
        },
    }
}

fn rms(values: &[f32]) -> f64 {
    rowburst_core::vecmath::norm(values) / (values.len() as f64).sqrt()
}
