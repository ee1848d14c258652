//! The run of a candidate on the pixels that are not held out.

use super::super::frame_data::FrameData;
use super::super::{Prior, RunResult, show};
use super::{Candidate, Observer, margin, rms};
use crate::prox::Prox;
use crate::solve::StopReason;
use crate::solve::admm::{Admm, AdmmParams, Progress, TauRule};

/// How close to its minimum a candidate is run.
pub(in crate::reconstruct) const TOLERANCE: f64 = 0.01;

/// Held-out error over that of the best so far after as many iterations at which a candidate
/// is given up, early and late; LEDs stand at 3 after 100 iterations of a prior that ends best.
const EARLY_ERROR_RATIO: f64 = 6.0;
const LATE_ERROR_RATIO: f64 = 1.5;
const FIRST_CHECK: usize = 100;
const LATE_FROM: usize = 200;
const CHECK_INTERVAL: usize = 20;

/// Factor from one `τ` to the next that is tried, the farthest from where the discrepancy principle
/// ended, and the iterations that each is given.
const TAU_STEP: f64 = 2.0;
const MAX_TAU_FACTOR: f64 = 8.0;
const TUNING_ITERATIONS: usize = 30;

/// A strength of a candidate, the held-out error there and the part of the voxels that may be lit.
#[derive(Clone, Copy)]
struct TauTrial {
    tau_factor: f64,
    error: f64,
    support: f64,
}

/// A candidate that is being tried.
pub(super) struct Trial {
    prior: Prior,
    prox: Box<dyn Prox>,
    run: Admm,
    params: AdmmParams,
    sigma: f64,
}

impl Trial {
    /// A run from a dark video, for `data` without the pixels that are held out; errors are in
    /// units of `sigma`.
    pub fn new(
        data: &FrameData,
        prior: Prior,
        rule: TauRule,
        sigma: f64,
        max_iterations: Option<usize>,
    ) -> Self {
        let params = AdmmParams {
            tolerance: TOLERANCE,
            ..prior.admm_params(data.shape(), rule, max_iterations)
        };
        Self {
            prior,
            prox: prior.prox(data.shape()),
            run: Admm::new(data, data.shape(), params),
            params,
            sigma,
        }
    }

    /// Runs to the end, or until it is hopelessly worse than `best`, the course of the errors of
    /// the best so far; then tries other `τ` where the error is at most `max_error`. Also returns
    /// the course of its errors, and what it has found.
    pub fn run(
        mut self,
        data: &mut FrameData,
        best: &[f64],
        max_error: f64,
        observer: &mut Observer,
    ) -> Result<(Candidate, Vec<f64>, Box<RunResult>), Box<RunResult>> {
        let mut errors = Vec::new();
        let given_up = loop {
            // In pieces: an observer cannot ask the data for the held-out error.
            let until = (self.run.iterations() + CHECK_INTERVAL).max(FIRST_CHECK);
            let (error, ended) = match self.run_until(data, until, observer) {
                Ok(seen) => seen,
                Err(reason) => return Err(self.into_result(data, reason)),
            };
            let then = best.get(errors.len()).or(best.last());
            let limit = if self.run.iterations() < LATE_FROM {
                EARLY_ERROR_RATIO
            } else {
                LATE_ERROR_RATIO
            };
            errors.push(error);
            if ended || then.is_some_and(|then| error > limit * then) {
                break !ended;
            }
        };
        let mut found = TauTrial {
            tau_factor: 1.0,
            error: errors[errors.len() - 1],
            support: self.run.support(),
        };
        let is_free = matches!(self.params.tau, TauRule::Discrepancy { .. });
        if is_free && !given_up && found.error <= max_error {
            found = match self.tune(data, found, observer) {
                Ok(found) => found,
                Err(reason) => return Err(self.into_result(data, reason)),
            };
        }
        let candidate = Candidate {
            prior: self.prior,
            tau_factor: found.tau_factor,
            error: found.error,
            support: found.support,
            given_up,
        };
        let reason = StopReason::IterationLimit;
        Ok((candidate, errors, self.into_result(data, reason)))
    }

    /// Goes on with half of `τ`, or twice, as long as the held-out error falls; where it was
    /// smallest.
    fn tune(
        &mut self,
        data: &mut FrameData,
        mut best: TauTrial,
        observer: &mut Observer,
    ) -> Result<TauTrial, StopReason> {
        let tau = self.run.tau();
        let margin = margin(data.held_out_count());
        for direction in [1.0 / TAU_STEP, TAU_STEP] {
            let mut factor = direction;
            while (1.0 / MAX_TAU_FACTOR..=MAX_TAU_FACTOR).contains(&factor) {
                self.run.set_tau_rule(TauRule::Fixed(factor * tau), data);
                let until = self.run.iterations() + TUNING_ITERATIONS;
                let (error, _) = self.run_until(data, until, observer)?;
                if error >= (1.0 - margin) * best.error || error.is_nan() {
                    break;
                }
                best = TauTrial {
                    tau_factor: factor,
                    error,
                    support: self.run.support(),
                };
                factor *= direction;
            }
            if best.tau_factor != 1.0 {
                break;
            }
        }
        Ok(best)
    }

    /// Iterates up to `until` or the end; the held-out error, and whether it has ended.
    fn run_until(
        &mut self,
        data: &mut FrameData,
        until: usize,
        observer: &mut Observer,
    ) -> Result<(f64, bool), StopReason> {
        let until = until.min(self.params.max_iterations);
        let (background, shape) = (self.prior.background(), data.shape());
        let label = format!("trying {}", self.prior);
        let reason = self.run.run(data, &mut *self.prox, until, &mut |progress| {
            let progress = Progress {
                label: &label,
                ..*progress
            };
            show(background, shape, &progress, observer)
        });
        match reason {
            StopReason::TimeBudget | StopReason::Interrupted => Err(reason),
            reason => {
                let error = rms(&data.held_out_residuals(self.run.video())) / self.sigma;
                let ended = reason == StopReason::Converged || until == self.params.max_iterations;
                Ok((error, ended))
            }
        }
    }

    /// What a run that was stopped has found.
    fn into_result(self, data: &FrameData, reason: StopReason) -> Box<RunResult> {
        let solution = self.run.solution(data, &*self.prox, reason);
        Box::new(RunResult::new(
            self.prior,
            &*self.prox,
            data.shape(),
            solution,
        ))
    }
}
