//! From a measurement to a video: the only place where physics meets the solver.

mod choose;
mod chunked;
mod data_step;
mod fit;
mod frame_data;
mod held_out;
mod model;
mod prior;
mod sequence;
mod sigma;

use choose::BestTrial;
pub use choose::{CANDIDATES, Candidate, Choice, DENSE_CANDIDATES};
pub use chunked::Chunked;
pub use data_step::DataStep;
pub use fit::{Fit, FitStatistics, TrimmedChiSquared, Verdict};
pub use model::Model;
pub use prior::{FurtherWeights, Prior};
pub use sequence::Sequence;
pub use sigma::estimate_sigma;

use crate::linop::Background;
use crate::measurement::Measurement;
use crate::prox::Prox;
use crate::solve::admm::{self, Admm, Progress, Solution, TauRule};
use crate::solve::{Certificate, DataTerm, StopReason};
use crate::{Camera, Error, Image, PatchSet, Result, Shape, Video};
use frame_data::FrameData;
use sigma::Bands;
use std::ops::ControlFlow;

/// Raised by one with every change that gives other numbers for the same input, also within a
/// version of the program: archives of many frames are not continued across it.
pub const ALGORITHM_REVISION: u32 = 6;

/// What the user chooses.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Options {
    /// The prior; `None`: the one of [`CANDIDATES`] that predicts held-out pixels best.
    pub prior: Option<Prior>,
    /// How `τ` is found.
    pub tau: Tau,
    /// Standard deviation of the noise in counts; `None`: from the calibration, or
    /// else from the frame itself.
    pub noise_sigma: Option<f64>,
    /// Most iterations; `None`: the solver's default.
    pub max_iterations: Option<usize>,
}

/// How `τ` of `½‖W(b − Av)‖² + τ R(v)` is found.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Tau {
    /// By the discrepancy principle where the noise level is known or can be read from the
    /// frame, else by held-out pixels.
    #[default]
    Auto,
    /// By the pixels that are held out: the noise level is the one that predicts them best.
    HeldOut,
    /// Given.
    Given(f64),
}

/// Where the noise level comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SigmaSource {
    /// The user gave it.
    Given,
    /// Gain and read noise of the sensor.
    Calibration,
    /// The part of the frame's spectrum that the optics do not pass.
    Frame,
    /// The level at which held-out pixels are predicted best.
    HeldOut,
}

impl SigmaSource {
    /// The word in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Given => "given",
            Self::Calibration => "from the calibration",
            Self::Frame => "estimated from the frame",
            Self::HeldOut => "by held-out pixels",
        }
    }
}

/// A reconstruction set up and ready to run.
pub struct Problem {
    data: FrameData,
    options: Options,
    sigma: f64,
    sigma_source: SigmaSource,
    tau_factor: f64,
    camera: Camera,
    bands: Bands,
}

/// A reconstructed video with what is needed to judge it.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// The video in counts, `[t, y, x]`.
    pub video: Video,
    /// The part of it that the prior has as its background.
    pub background: Option<Video>,
    /// `W(b − A v)/σ`, `[y, x]`; 0 where a pixel holds no information.
    pub residual: Image,
    /// Root mean square of the residual over the pixels that hold information.
    pub residual_over_sigma: f64,
    /// The prior.
    pub prior: Prior,
    /// What it was chosen among, where it was.
    pub choice: Option<Choice>,
    /// `τ` at the end.
    pub tau: f64,
    /// `½‖W(b − A v)‖² + τ R(v)` at the end, and a bound of its minimum from below: over videos up
    /// to twice as bright, on the support, for this `τ`.
    pub certificate: Certificate,
    /// `W` that the video was found with, `[y, x]`; `None`: all 1.
    pub weights: Option<Vec<f32>>,
    /// Noise of a pixel with weight 1, in counts.
    pub sigma: f64,
    /// Where `sigma` comes from.
    pub sigma_source: SigmaSource,
    /// Iterations done.
    pub iterations: usize,
    /// Why the solver stopped.
    pub stop_reason: StopReason,
    /// Part of the voxels that were allowed to be lit at the end.
    pub support: f64,
    /// Whether the model explains the frame.
    pub fit: Fit,
}

impl Problem {
    /// Sets up the reconstruction of `measurement`: operator, Gram factors, noise level.
    /// `psf` is one for the whole field (`&Psf`) or one for each part of it (`&PatchSet`).
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

    /// Sets up the reconstruction of one of many frames that share `model`.
    ///
    /// # Errors
    /// A `τ` or `σ` that is not above zero, a noise level that cannot be found, or a
    /// prior over time for a video of one bin.
    pub fn with_model(model: &Model, measurement: &Measurement, options: Options) -> Result<Self> {
        let (camera, psf) = (model.camera(), model.psfs());
        let tau = match options.tau {
            Tau::Given(tau) => Some(tau),
            Tau::Auto | Tau::HeldOut => None,
        };
        for (name, value) in [("--tau", tau), ("--noise-sigma", options.noise_sigma)] {
            if let Some(value) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
                return Err(Error::input(
                    name,
                    value,
                    "the value is a finite number above zero",
                    "Leave it out: the program finds it.",
                ));
            }
        }
        let bands = Bands::new(measurement, psf.central());
        let (sigma, sigma_source) = noise_of(measurement, &bands, &options);
        if let Some(prior) = options.prior {
            prior.check_bins(camera.video_shape().bins)?;
        }
        Ok(Self {
            camera: camera.clone(),
            bands,
            data: FrameData::new(model, measurement),
            options,
            sigma,
            sigma_source,
            tau_factor: 1.0,
        })
    }

    /// The same for a given prior with `tau_factor` times the `τ` of the discrepancy principle: the
    /// other half of what [`Problem::choose`] finds. It has no say where `τ` is given.
    ///
    /// # Panics
    /// If `tau_factor` is not above zero.
    #[must_use]
    pub fn with_tau_factor(self, tau_factor: f64) -> Self {
        assert!(tau_factor > 0.0, "a strength above zero, not {tau_factor}");
        Self { tau_factor, ..self }
    }

    /// What the user chose.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// Noise of a pixel with weight 1, in counts; a guess where held-out pixels are to tell.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// Solves it; `observer` sees every iteration and may stop it.
    ///
    /// # Errors
    /// Numbers that overflowed.
    pub fn solve(
        mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<Reconstruction> {
        let mut history = Vec::new();
        let found = self.find(&mut |progress| {
            if progress.iteration == 1 {
                history.clear();
            }
            history.push(progress.residual_rms);
            observer(progress)
        });
        self.build_reconstruction(found.unwrap_or_else(|partial| *partial), &history)
    }

    /// Judges what was found.
    fn build_reconstruction(&self, found: RunResult, history: &[f64]) -> Result<Reconstruction> {
        let RunResult {
            prior,
            freedom,
            choice,
            solution,
        } = found;
        if !solution.certificate.primal.is_finite() {
            return Err(Error::work(
                "reconstruction",
                "the numbers overflowed",
                "Check that frame and PSF hold plausible values, and give --noise-sigma.",
            ));
        }
        let shape = self.data.shape();
        let measurement_count = self.data.measurement_count() as f64;
        let residual_rms = crate::vecmath::norm(&solution.residual) / measurement_count.sqrt();
        let residual: Vec<f32> = solution
            .residual
            .iter()
            .map(|r| (f64::from(*r) / self.sigma) as f32)
            .collect();
        let columns = self.camera.columns();
        let residual = Image::new(residual.len() / columns, columns, residual)?;
        let background = match prior.background() {
            Background::None => None,
            background => {
                let mut stacked = solution.video.clone();
                stacked[..shape.voxels()].fill(0.0);
                Some(Video::new(
                    shape,
                    background.sum(shape, &stacked).into_owned(),
                )?)
            }
        };
        let video = Video::new(shape, self.data.sum(solution.video))?;
        let scaled = self.data.measured().iter();
        let measured: Vec<f32> = scaled
            .map(|b| (f64::from(*b) / self.sigma) as f32)
            .collect();
        let fit = fit::judge(&fit::FitInput {
            residual: &residual,
            measured: &measured,
            weights: self.data.weights(),
            camera: &self.camera,
            bands: &self.bands,
            video: &video,
            freedom,
            history,
            sigma: self.sigma,
            sigma_source: self.sigma_source,
            tau_is_given: matches!(self.options.tau, Tau::Given(_)),
            stop_reason: solution.stop_reason,
            support: solution.support,
        });
        Ok(Reconstruction {
            video,
            background,
            residual,
            residual_over_sigma: residual_rms / self.sigma,
            tau: solution.tau,
            certificate: solution.certificate,
            weights: self.data.weights().map(<[f32]>::to_vec),
            prior,
            choice,
            sigma: self.sigma,
            sigma_source: self.sigma_source,
            iterations: solution.iterations,
            stop_reason: solution.stop_reason,
            support: solution.support,
            fit,
        })
    }

    /// Chooses the prior, and the strength that goes with it, as [`Problem::solve`] does where none
    /// is given, and no more; `None` where there is nothing to choose by.
    ///
    /// # Errors
    /// Why the observer stopped it.
    pub fn choose(
        mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<Option<Choice>, StopReason> {
        let stopped = |found: Box<RunResult>| found.solution.stop_reason;
        let rule = self.rule(observer).map_err(stopped)?;
        let chosen = self.choice(rule, observer).map_err(stopped)?;
        Ok(chosen.map(|(choice, _)| choice))
    }

    /// How `τ` is found; where no noise level is known held-out pixels tell it now.
    fn rule(
        &mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<TauRule, Box<RunResult>> {
        let standard = self.options.prior.unwrap_or(Prior::STANDARD);
        let is_unknown = self.sigma_source == SigmaSource::HeldOut && self.options.tau == Tau::Auto;
        if is_unknown || self.options.tau == Tau::HeldOut {
            let max_iterations = self.options.max_iterations;
            self.sigma = choose::noise_level(&mut self.data, standard, max_iterations, observer)?;
            self.sigma_source = SigmaSource::HeldOut;
        }
        Ok(match self.options.tau {
            Tau::Given(tau) => TauRule::Fixed(tau),
            Tau::Auto | Tau::HeldOut => TauRule::Discrepancy { sigma: self.sigma },
        })
    }

    fn choice(
        &mut self,
        rule: TauRule,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<Option<(Choice, Option<BestTrial>)>, Box<RunResult>> {
        // The candidates differ in how they treat time.
        if self.data.shape().bins == 1 || !choose::can_choose(&self.data) {
            return Ok(None);
        }
        let max_iterations = self.options.max_iterations;
        choose::choose_prior(&mut self.data, rule, self.sigma, max_iterations, observer).map(Some)
    }

    /// The choices that are left to the program, then the run; what there is so far where the
    /// observer stops them.
    fn find(
        &mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<RunResult, Box<RunResult>> {
        let rule = self.rule(observer)?;
        let (choice, best_trial) = match self.options.prior {
            Some(_) => (None, None),
            None => match self.choice(rule, observer)? {
                Some((choice, best_trial)) => (Some(choice), best_trial),
                None => (None, None),
            },
        };
        let standard = self.options.prior.unwrap_or(Prior::STANDARD);
        let (prior, tau_factor) = choice.as_ref().map_or((standard, self.tau_factor), |c| {
            (c.best().prior, c.best().tau_factor)
        });
        let shape = self.data.shape();
        self.data.start(prior.background(), None);
        let mut prox = prior.prox(shape);
        let params = prior.admm_params(shape, rule, self.options.max_iterations);
        let mut run = Admm::new(&self.data, shape, params);
        let mut run_until = |run: &mut Admm, data: &mut FrameData, until| {
            run.run(data, &mut *prox, until, &mut |progress| {
                show(prior.background(), shape, progress, observer)
            })
        };
        let mut stop_reason = None;
        if tau_factor != 1.0 && matches!(rule, TauRule::Discrepancy { .. }) {
            // As in the trial: first to where the principle leads, then on from there.
            run.set_tolerance(choose::TOLERANCE);
            let reason = run_until(&mut run, &mut self.data, 2 * params.max_iterations / 3);
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
        let solution = run.solution(&self.data, &*prox, stop_reason);
        // Stopped soon after its start: the trial of this prior was nearer.
        if let (StopReason::Interrupted | StopReason::TimeBudget, Some(best_trial)) =
            (stop_reason, best_trial)
            && best_trial.misfit() < crate::vecmath::norm(&solution.residual)
        {
            let found = best_trial.stopped(&self.data, stop_reason);
            return Ok(RunResult { choice, ..*found });
        }
        Ok(RunResult {
            choice,
            ..RunResult::new(prior, &*prox, shape, solution)
        })
    }
}

/// Shows `observer` the video that both parts make.
fn show(
    background: Background,
    shape: Shape,
    progress: &Progress,
    observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
) -> ControlFlow<StopReason> {
    match background {
        Background::None => observer(progress),
        background => observer(&Progress {
            video: &background.sum(shape, progress.video),
            ..*progress
        }),
    }
}

/// What a run ends with.
struct RunResult {
    prior: Prior,
    /// Degrees of freedom of the video.
    freedom: f64,
    choice: Option<Choice>,
    solution: Solution,
}

impl RunResult {
    fn new(prior: Prior, prox: &dyn Prox, shape: Shape, solution: Solution) -> Self {
        let faint = (0.01 * admm::brightness(&solution.video[..shape.voxels()])) as f32;
        Self {
            prior,
            freedom: prox.degrees_of_freedom(&solution.video, faint),
            choice: None,
            solution,
        }
    }
}

/// The standard deviation of the noise, and where it is known from.
fn noise_of(measurement: &Measurement, bands: &Bands, options: &Options) -> (f64, SigmaSource) {
    match (options.noise_sigma, measurement.sigma()) {
        (Some(sigma), _) => (sigma, SigmaSource::Given),
        (None, Some(sigma)) => (sigma, SigmaSource::Calibration),
        (None, None) => match bands.sigma(measurement) {
            Some(sigma) => (sigma, SigmaSource::Frame),
            // Until held-out pixels tell.
            None => (
                rms(measurement.image().data()) / 256.0,
                SigmaSource::HeldOut,
            ),
        },
    }
}

fn rms(values: &[f32]) -> f64 {
    crate::vecmath::norm(values) / (values.len() as f64).sqrt()
}
