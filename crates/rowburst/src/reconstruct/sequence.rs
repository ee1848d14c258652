//! Consecutive frames of one scene with warm starts, for a live view.
//!
//! Most of a scene stays the same from one frame to the next. So the solver starts each frame from the
//! end of the last one: its video, its duals, the support, `ρ`, and the factors of the Gram blocks, which
//! are valid as long as support and `ρ` stay. The x-step finds changes of active voxels, and the
//! updates of the support find new active voxels (see [`rowburst_solve::admm`]). A frame that was stopped
//! early is continued by the next one. A frame starts from zero where the last video explains too little
//! of it (docs/design/014).

use super::sigma::Bands;
use super::{
    Model, Options, Prior, Problem, Reconstruction, RunResult, SigmaSource, Tau, noise_of,
};
use rowburst_core::vecmath::distance_squared;
use rowburst_core::{Cancel, Result};
use rowburst_optics::measurement::Measurement;
use rowburst_solve::admm::{Admm, Progress, TauRule};
use rowburst_solve::prox::Prox;
use rowburst_solve::{DataTerm, StopReason};
use std::ops::ControlFlow;

/// Unexplained part of a frame's variance above which it starts from zero; larger keeps old videos longer
/// (docs/design/014).
const MAX_UNEXPLAINED: f64 = 0.5;

/// Reconstructs consecutive frames of the same camera, each with a warm start from the last one.
///
/// The video of a frame depends on the frames before, for converged frames within
/// [`rowburst_solve::admm::AdmmParams::tolerance`]. So it suits a live view, not a measurement. The prior
/// is that of the options, or [`Prior::STANDARD`].
pub struct Sequence {
    model: Model,
    options: Options,
    /// The run of the last frame.
    previous: Option<FrameRun>,
}

/// The run of a frame; its end is the start of the next one.
struct FrameRun {
    problem: Problem,
    prox: Box<dyn Prox>,
    run: Admm,
}

/// A run from zero.
enum Start {
    /// The run, before its first iteration.
    Ready(Box<FrameRun>),
    /// The result so far of a search for the noise level that the observer stopped.
    Stopped(Box<Reconstruction>),
}

impl Sequence {
    /// A sequence without frames. A model with [`Model::with_cached_gram`] makes frames that start from
    /// zero faster.
    pub fn new(model: Model, options: Options) -> Self {
        let options = Options {
            prior: Some(options.prior.unwrap_or(Prior::STANDARD)),
            ..options
        };
        Self {
            model,
            options,
            previous: None,
        }
    }

    /// Lets `cancel` stop the set-up of frames that start from zero. A frame that was cancelled is no start for the next.
    pub fn set_cancel(&mut self, cancel: &Cancel) {
        let was_cancelled = |last: &mut FrameRun| last.problem.data.cancel().is_cancelled();
        self.previous.take_if(was_cancelled);
        self.model = self.model.clone().with_cancel(cancel);
    }

    /// Drops the last frame, so that the next one starts from zero.
    pub fn reset(&mut self) {
        self.previous = None;
    }

    /// Reconstructs the next frame. Also returns whether it had a warm start from the last one.
    /// `observer` is called after every iteration and may stop the run, as for a time budget.
    ///
    /// # Errors
    /// Those of [`Problem::with_model`] and [`Problem::solve`]; the next frame then starts from zero.
    pub fn reconstruct(
        &mut self,
        measurement: &Measurement,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<(Reconstruction, bool)> {
        let advanced = self
            .previous
            .take()
            .and_then(|previous| previous.advance(measurement));
        let is_warm_started = advanced.is_some();
        let mut current = match advanced {
            Some(previous) => previous,
            None => match self.start(measurement, observer)? {
                Start::Ready(frame_run) => *frame_run,
                Start::Stopped(stopped) => return Ok((*stopped, false)),
            },
        };
        let mut residual_history = Vec::new();
        let reason = current.run(&mut residual_history, observer);
        let found = current.build_reconstruction(reason, &residual_history)?;
        self.previous = Some(current);
        Ok((found, is_warm_started))
    }

    /// Sets up a run from zero, and searches for the noise level where it is unknown.
    fn start(
        &self,
        measurement: &Measurement,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<Start> {
        let mut problem = Problem::with_model(&self.model, measurement, self.options)?;
        let rule = match problem.resolve_tau_rule(observer) {
            Ok(rule) => rule,
            Err(partial) => {
                let stopped = problem.build_reconstruction(*partial, &[])?;
                return Ok(Start::Stopped(Box::new(stopped)));
            }
        };
        let prior = problem.prior();
        problem.data.reset(prior.background(), None);
        let shape = problem.data.shape();
        let params = prior.admm_params(shape, rule, self.options.solver_settings());
        Ok(Start::Ready(Box::new(FrameRun {
            run: Admm::new(&problem.data, shape, params),
            prox: problem.data.prox(&prior),
            problem,
        })))
    }
}

impl Problem {
    /// The prior that is given, or the standard one.
    fn prior(&self) -> Prior {
        self.options.prior.unwrap_or(Prior::STANDARD)
    }
}

impl FrameRun {
    fn run(
        &mut self,
        residual_history: &mut Vec<f64>,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> StopReason {
        let background = self.problem.prior().background();
        let video_form = self.problem.data.video_form(background);
        let (data, max_iterations) = (&mut self.problem.data, self.run.max_iterations());
        self.run
            .run(data, &mut *self.prox, max_iterations, &mut |progress| {
                residual_history.push(progress.residual_rms);
                video_form.observe(progress, observer)
            })
    }

    fn build_reconstruction(
        &mut self,
        reason: StopReason,
        residual_history: &[f64],
    ) -> Result<Reconstruction> {
        let (problem, prox) = (&self.problem, &*self.prox);
        let solution = self.run.snapshot(&problem.data, prox, reason);
        let found = RunResult::new(problem.prior(), solution);
        problem.build_reconstruction(found, residual_history)
    }

    /// Prepares the warm start of the next frame; `None` where the last video explains too little of it.
    fn advance(mut self, measurement: &Measurement) -> Option<Self> {
        let problem = &mut self.problem;
        problem.data.set_frame(measurement);
        problem.bands = Bands::new(measurement, problem.data.psfs().central());
        let (sigma, source) = noise_of(measurement, &problem.bands, &problem.options);
        if source != SigmaSource::HeldOut {
            // Weights that were kept refer to the `σ` of the noise model that they come from.
            problem.sigma = match source {
                SigmaSource::Calibration => problem.data.calibrated_sigma()?,
                _ => sigma,
            };
            problem.sigma_source = source;
        }
        if problem.options.tau == Tau::Auto {
            let sigma = problem.sigma;
            let rule = TauRule::Discrepancy { sigma };
            self.run.set_tau_rule(rule, &problem.data);
        }
        // The video of a run that was stopped during its warm-up explains nothing yet.
        if !self.run.is_warming_up() && !explains_most_variance(problem, self.run.video()) {
            return None;
        }
        self.run.warm_start(&problem.data);
        Some(self)
    }
}

/// Whether `video` explains enough of the variance of the frame.
fn explains_most_variance(problem: &Problem, video: &[f32]) -> bool {
    let data = &problem.data;
    let measured = data.measurements();
    let mut predicted = vec![0.0; measured.len()];
    data.operator().apply(video, &mut predicted);
    let mean = measured.iter().map(|b| f64::from(*b)).sum::<f64>() / measured.len() as f64;
    let variance_sum = distance_squared(measured, &vec![mean as f32; measured.len()]);
    distance_squared(measured, &predicted) <= MAX_UNEXPLAINED * variance_sum
}
