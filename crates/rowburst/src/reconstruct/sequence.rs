//! Frames of one scene, one after another: a live view.
//!
//! From one frame to the next most of a scene stays as it is. The solver goes on from where the last
//! frame ended: its video, its duals, the support, `ρ`, and the factors of the Gram blocks, which
//! hold as long as neither support nor `ρ` moves. What changed is found by the data step, and new
//! places by the looks at the support (see [`crate::solve::admm`]). A frame that was stopped early is
//! not lost: the next one goes on from there. Where the last video explains little of the new frame,
//! it begins from nothing.

use super::sigma::Bands;
use super::{
    Model, Options, Prior, Problem, Reconstruction, RunResult, SigmaSource, Tau, noise_of,
};
use crate::Result;
use crate::measurement::Measurement;
use crate::prox::Prox;
use crate::solve::admm::{Admm, Progress, TauRule};
use crate::solve::{DataTerm, StopReason};
use crate::vecmath::distance_squared;
use std::ops::ControlFlow;

/// Part of the variance of a frame that the last video may leave unexplained; beyond, it is of
/// another scene.
const MAX_UNEXPLAINED: f64 = 0.5;

/// Reconstructs frames of the same camera, each from the end of the last one.
///
/// What comes out depends on the frames before, within [`crate::solve::admm::AdmmParams::tolerance`]
/// where it converges: for a live view, not for a measurement. The prior is the recipe's, or
/// [`Prior::STANDARD`].
pub struct Sequence {
    model: Model,
    options: Options,
    previous: Option<PreviousFrame>,
}

/// The end of the last frame.
struct PreviousFrame {
    problem: Problem,
    prox: Box<dyn Prox>,
    run: Admm,
}

impl Sequence {
    /// A sequence without frames yet. With [`Model::with_cached_gram`] a frame that starts from nothing
    /// is set up sooner.
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

    /// Forgets what it has seen: the next frame starts from nothing.
    pub fn reset(&mut self) {
        self.previous = None;
    }

    /// The video of the next frame, and whether it went on from the last one; `observer` sees every
    /// iteration and may stop it: what a time budget needs.
    ///
    /// # Errors
    /// Those of [`Problem::with_model`] and [`Problem::solve`]; the next frame then starts from nothing.
    pub fn next(
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
            None => match self.first(measurement, observer)? {
                Ok(first) => *first,
                Err(stopped) => return Ok((*stopped, false)),
            },
        };
        let mut history = Vec::new();
        let reason = current.run(&mut history, observer);
        let found = current.build_reconstruction(reason, &history)?;
        self.previous = Some(current);
        Ok((found, is_warm_started))
    }

    /// A run from nothing; what there is where the observer stopped the search for the noise level.
    fn first(
        &self,
        measurement: &Measurement,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<std::result::Result<Box<PreviousFrame>, Box<Reconstruction>>> {
        let mut problem = Problem::with_model(&self.model, measurement, self.options)?;
        let rule = match problem.rule(observer) {
            Ok(rule) => rule,
            Err(partial) => return Ok(Err(Box::new(problem.build_reconstruction(*partial, &[])?))),
        };
        let (shape, prior) = (problem.data.shape(), problem.prior());
        problem.data.start(prior.background(), None);
        let params = prior.admm_params(shape, rule, self.options.max_iterations);
        Ok(Ok(Box::new(PreviousFrame {
            run: Admm::new(&problem.data, shape, params),
            prox: prior.prox(shape),
            problem,
        })))
    }
}

impl Problem {
    fn prior(&self) -> Prior {
        self.options.prior.unwrap_or(Prior::STANDARD)
    }
}

impl PreviousFrame {
    fn run(
        &mut self,
        history: &mut Vec<f64>,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> StopReason {
        let shape = self.problem.data.shape();
        let background = self.problem.prior().background();
        let (data, max_iterations) = (&mut self.problem.data, self.run.max_iterations());
        self.run
            .run(data, &mut *self.prox, max_iterations, &mut |progress| {
                history.push(progress.residual_rms);
                super::show(background, shape, progress, observer)
            })
    }

    fn build_reconstruction(
        &mut self,
        reason: StopReason,
        history: &[f64],
    ) -> Result<Reconstruction> {
        let (problem, prox) = (&self.problem, &*self.prox);
        let solution = self.run.snapshot(&problem.data, prox, reason);
        let found = RunResult::new(problem.prior(), prox, problem.data.shape(), solution);
        problem.build_reconstruction(found, history)
    }

    /// The same with the data of the next frame; `None` where that is of another scene.
    fn advance(mut self, measurement: &Measurement) -> Option<Self> {
        let problem = &mut self.problem;
        problem.data.next(measurement);
        problem.bands = Bands::new(measurement, problem.data.psfs().central());
        let (sigma, source) = noise_of(measurement, &problem.bands, &problem.options);
        if source != SigmaSource::HeldOut {
            // Weights that stayed have the reference of the law that they come from.
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
        // A run that was stopped early has no video yet that could explain anything.
        if !self.run.is_warming_up() && !explains_most_variance(problem, self.run.video()) {
            return None;
        }
        self.run.warm_start(&problem.data);
        Some(self)
    }
}

/// Whether `video` explains most of what varies in the frame.
fn explains_most_variance(problem: &Problem, video: &[f32]) -> bool {
    let data = &problem.data;
    let measured = data.measured();
    let mut seen = vec![0.0; measured.len()];
    data.operator().apply(video, &mut seen);
    let mean = measured.iter().map(|b| f64::from(*b)).sum::<f64>() / measured.len() as f64;
    let varies = distance_squared(measured, &vec![mean as f32; measured.len()]);
    distance_squared(measured, &seen) <= MAX_UNEXPLAINED * varies
}
