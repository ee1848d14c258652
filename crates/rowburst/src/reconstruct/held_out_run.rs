//! A run of the solver on the pixels that are not held out.

use super::SolverSettings;
use super::frame_data::{FrameData, RunState};
use super::{Observer, Prior, RunResult};
use rowburst_solve::StopReason;
use rowburst_solve::admm::{Admm, AdmmParams, TauRule};
use rowburst_solve::prox::Prox;

/// A run on the pixels that are not held out.
#[derive(Clone)]
pub(super) struct HeldOutRun {
    pub prior: Prior,
    prox: Box<dyn Prox>,
    pub admm: Admm,
    params: AdmmParams,
    pub residual_rms: f64,
    /// The held-out error at each check of the model.
    pub errors: Vec<ErrorAt>,
}

/// The held-out error of a run after so many iterations.
#[derive(Debug, Clone, Copy)]
pub(super) struct ErrorAt {
    pub iteration: usize,
    pub error: f64,
}

impl HeldOutRun {
    /// A run from a zero video.
    pub fn new(
        data: &mut FrameData,
        prior: Prior,
        rule: TauRule,
        settings: SolverSettings,
    ) -> Self {
        let held_out = data.held_out();
        data.reset(prior.background(), Some(held_out));
        Self::without_reset(data, prior, rule, settings)
    }

    /// A run from a zero video on all pixels of `data`, which is as new and for the background of `prior`.
    pub fn without_reset(
        data: &FrameData,
        prior: Prior,
        rule: TauRule,
        settings: SolverSettings,
    ) -> Self {
        let params = prior.admm_params(data.shape(), rule, settings);
        Self {
            prior,
            prox: data.prox(&prior),
            admm: Admm::new(data, data.shape(), params),
            params,
            residual_rms: 0.0,
            errors: Vec::new(),
        }
    }

    /// Root mean square of the weighted residual at the last iteration.
    pub fn residual_rms(&self) -> f64 {
        self.residual_rms
    }

    /// Iterates up to iteration `until` or until it converges, and returns whether it has. The error is the result so far
    /// of a run that the observer stopped.
    pub fn run(
        &mut self,
        data: &mut FrameData,
        until: usize,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        let video_form = data.video_form(self.prior.background());
        let residual_rms = &mut self.residual_rms;
        let reason = self
            .admm
            .run(data, &mut *self.prox, until, &mut |progress| {
                *residual_rms = progress.residual_rms;
                video_form.observe(progress, observer)
            });
        if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
            let solution = self.admm.snapshot(data, &*self.prox, reason);
            return Err(Box::new(RunResult::new(self.prior, solution)));
        }
        Ok(reason == StopReason::Converged)
    }
}

impl HeldOutRun {
    /// Goes on with all pixels from `state`, where another run has used `data` since.
    pub fn resume_with_all_pixels(
        mut self,
        state: RunState,
        data: &mut FrameData,
    ) -> (Admm, Box<dyn Prox>) {
        data.resume_with_all_pixels(self.prior.background(), state);
        self.admm.set_tolerance(self.params.tolerance);
        self.admm.reweight(data);
        (self.admm, self.prox)
    }

    /// Goes on with all pixels: with those that are held out, too.
    pub fn with_all_pixels(mut self, data: &mut FrameData) -> (Admm, Box<dyn Prox>) {
        data.release_held_out();
        self.admm.reweight(data);
        (self.admm, self.prox)
    }

    /// The rule for `τ`.
    pub fn rule(&self) -> TauRule {
        self.params.tau
    }

    /// The result of a run that has ended.
    pub fn into_result(self, data: &FrameData) -> RunResult {
        let reason = StopReason::IterationLimit;
        let solution = self.admm.into_solution(data, &*self.prox, reason);
        RunResult::new(self.prior, solution)
    }
}
