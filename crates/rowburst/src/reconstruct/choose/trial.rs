//! The trial of a candidate: a run on the pixels that are not held out.

use super::super::SolverSettings;
use super::super::frame_data::FrameData;
use super::super::held_out_run::HeldOutRun;
use super::super::{Prior, RunResult, observe_sum};
use super::{Candidate, MIN_GAIN, Observer, gain, rms};
use rowburst_core::linop::Background;
use rowburst_solve::StopReason;
use rowburst_solve::admm::{Admm, AdmmParams, Progress, TauRule};
use rowburst_solve::prox::Prox;
use tracing::debug;

/// [`AdmmParams::tolerance`] of a trial; larger is faster and compares less exact videos.
pub(in crate::reconstruct) const TOLERANCE: f64 = 0.01;

/// Held-out error over that of the best candidate at [`FIRST_COMPARISON`] that stops a candidate; smaller may stop the best
/// (docs/design/011).
const FIRST_ERROR_RATIO: f64 = 20.0;
/// The same from [`FIRST_CHECK`] on, each error over that of the best after as many iterations.
const EARLY_ERROR_RATIO: f64 = 6.0;
/// The same from [`LATE_FROM`] on.
const LATE_ERROR_RATIO: f64 = 1.5;
/// Iteration at which a candidate is first compared; smaller may stop the best.
const FIRST_COMPARISON: usize = 60;
/// Iteration of the first check, from which on errors tell whether a candidate has settled; smaller judges what has not.
const FIRST_CHECK: usize = 80;
/// First iteration at which [`LATE_ERROR_RATIO`] applies; smaller may stop the best.
const LATE_FROM: usize = 200;
/// Iterations between two comparisons; larger stops candidates later.
const CHECK_INTERVAL: usize = 20;

/// Relative fall of the held-out error over two checks below which it has settled; smaller takes longer.
const SETTLED_CHANGE: f64 = 0.01;

/// Factor from one tried `τ` to the next; smaller is finer and takes more runs (docs/design/011).
const TAU_STEP: f64 = 2.0;
/// Largest factor on the `τ` of the discrepancy principle, up and down; larger tries more values.
const MAX_TAU_FACTOR: f64 = 8.0;
/// Largest factor for a video that is one picture; larger tries more values (docs/design/011).
const MAX_TAU_FACTOR_AT_REST: f64 = 64.0;
/// Iterations for each tried `τ`; fewer compare videos that have not settled.
const TUNING_ITERATIONS: usize = 30;
/// Iterations between two looks at a tried `τ`; larger ends one that is worse later.
const TUNING_STEP: usize = 10;
/// Loss in standard errors at which a tried `τ` is given up; smaller follows chance.
const CLEAR_LOSS: f64 = 3.0;

/// A factor on `τ`, with the held-out residuals and the fraction of voxels in the support at this factor.
struct TauTrial {
    tau_factor: f64,
    /// The held-out residuals over `σ`.
    residuals: Vec<f64>,
    support_fraction: f64,
}

/// The result of a trial.
pub(super) struct TrialResult {
    pub candidate: Candidate,
    /// The held-out error at each check.
    pub errors: Vec<f64>,
    /// The held-out residuals over `σ` at the end.
    pub residuals: Vec<f64>,
    pub run_result: Box<RunResult>,
}

/// The run of a candidate.
pub(super) struct Trial {
    prior: Prior,
    prox: Box<dyn Prox>,
    run: Admm,
    params: AdmmParams,
    sigma: f64,
    label: String,
    /// See [`Progress::runs_left`].
    runs_left: usize,
}

/// Whether the held-out error no longer falls.
pub(in crate::reconstruct) fn is_settled(errors: &[f64]) -> bool {
    match errors {
        [.., before, _, last] => *last > (1.0 - SETTLED_CHANGE) * before,
        _ => false,
    }
}

/// Held-out error over that of the best candidate above which a candidate is stopped after so many iterations.
fn max_error_ratio(iterations: usize) -> f64 {
    match iterations {
        ..FIRST_CHECK => FIRST_ERROR_RATIO,
        FIRST_CHECK..LATE_FROM => EARLY_ERROR_RATIO,
        LATE_FROM.. => LATE_ERROR_RATIO,
    }
}

/// Whether the video of `prior` is one picture, all of it.
pub(in crate::reconstruct) fn is_one_picture(prior: &Prior, data: &FrameData) -> bool {
    let is_one_bin = data.video_shape().bins == 1 || prior.background() == Background::Alone;
    is_one_bin && !prior.support
}

impl Trial {
    /// A run from a zero video. `data` holds out its pixels already; held-out errors are divided by `sigma`.
    pub fn new(
        data: &FrameData,
        prior: Prior,
        rule: TauRule,
        sigma: f64,
        settings: SolverSettings,
    ) -> Self {
        let params = AdmmParams {
            tolerance: TOLERANCE,
            ..prior.admm_params(data.shape(), rule, settings)
        };
        Self {
            prior,
            prox: data.prox(&prior),
            run: Admm::new(data, data.shape(), params),
            params,
            sigma,
            label: format!("testing prior {prior}"),
            runs_left: 0,
        }
    }

    /// The trial that goes on from a run on the same pixels by the same rule.
    pub fn after(run: HeldOutRun, sigma: f64) -> Self {
        let prior = run.prior;
        let (mut run, prox, params) = run.into_parts();
        run.set_tolerance(TOLERANCE);
        Self {
            prior,
            prox,
            run,
            params: AdmmParams {
                tolerance: TOLERANCE,
                ..params
            },
            sigma,
            label: format!("testing prior {prior}"),
            runs_left: 0,
        }
    }

    /// The same, shown as trial `number` of `count` before the final run.
    pub fn numbered(self, number: usize, count: usize) -> Self {
        Self {
            label: format!("testing prior {number} of {count}, {}", self.prior),
            runs_left: count - number + 1,
            ..self
        }
    }

    /// Runs until the solver stops, or until the held-out error is far above `best_errors`, those of the best
    /// candidate at each check. Then tries other `τ` where the error is at most `max_error`. The error is the
    /// result so far of a run that the observer stopped.
    pub fn run(
        mut self,
        data: &mut FrameData,
        best_errors: &[f64],
        max_error: f64,
        observer: &mut Observer,
    ) -> Result<TrialResult, Box<RunResult>> {
        let mut errors = Vec::new();
        let (residuals, stopped_early) = loop {
            // The run pauses for each check, since an observer has no access to the held-out pixels.
            let until = (self.run.iterations() + CHECK_INTERVAL).max(FIRST_COMPARISON);
            let (residuals, ended) = match self.run_until(data, until, observer) {
                Ok(check) => check,
                Err(reason) => return Err(self.into_result(data, reason)),
            };
            let best_error = best_errors.get(errors.len()).or(best_errors.last());
            let limit = max_error_ratio(self.run.iterations());
            let error = rms(&residuals);
            if ended || self.run.iterations() >= FIRST_CHECK {
                errors.push(error);
            }
            let ended = ended || (!self.prior.support && is_settled(&errors));
            if ended || best_error.is_some_and(|best_error| error > limit * best_error) {
                break (residuals, !ended);
            }
        };
        let mut found = TauTrial {
            tau_factor: 1.0,
            residuals,
            support_fraction: self.run.support_fraction(),
        };
        let is_tunable = self.params.tau.is_discrepancy() && !stopped_early;
        let is_one_picture = is_one_picture(&self.prior, data);
        // A limit of 0 is for trials that keep their `τ`.
        let is_close = rms(&found.residuals) <= max_error || is_one_picture && max_error > 0.0;
        if is_tunable && is_close {
            let tuned = if is_one_picture {
                self.smooth(data, found, observer)
            } else {
                self.tune(data, found, observer)
            };
            found = match tuned {
                Ok(found) => found,
                Err(reason) => return Err(self.into_result(data, reason)),
            };
        }
        let candidate = Candidate {
            prior: self.prior,
            tau_factor: found.tau_factor,
            error: rms(&found.residuals),
            support_fraction: found.support_fraction,
            stopped_early,
            gain: None,
        };
        Ok(TrialResult {
            candidate,
            errors,
            residuals: found.residuals,
            run_result: self.into_result(data, StopReason::IterationLimit),
        })
    }

    /// Continues with twice `τ`, then of that, until the held-out error does not fall. Returns the last factor, unless it
    /// predicts worse than the one before by a standard error: the `τ` of the discrepancy principle is too small for a
    /// scene at rest, whose edges count as many more degrees of freedom than the frame has of it (docs/design/011). The
    /// residuals are those of the lowest error.
    fn smooth(
        &mut self,
        data: &mut FrameData,
        mut lowest: TauTrial,
        observer: &mut Observer,
    ) -> Result<TauTrial, StopReason> {
        let tau = self.run.tau();
        let last = self.params.max_iterations.saturating_sub(TUNING_ITERATIONS);
        while lowest.tau_factor < MAX_TAU_FACTOR_AT_REST && self.run.iterations() <= last {
            let factor = TAU_STEP * lowest.tau_factor;
            let next = self.try_factor(factor, tau, &lowest.residuals, data, observer)?;
            let gain = gain(&lowest.residuals, &next.residuals);
            if gain.is_nan() || gain <= 0.0 {
                if gain > -MIN_GAIN {
                    lowest.tau_factor = next.tau_factor;
                }
                break;
            }
            lowest = next;
        }
        Ok(lowest)
    }

    /// Continues with `factor` times `tau`, until it is clearly worse than with the residuals `before`.
    fn try_factor(
        &mut self,
        factor: f64,
        tau: f64,
        before: &[f64],
        data: &mut FrameData,
        observer: &mut Observer,
    ) -> Result<TauTrial, StopReason> {
        self.run.set_tau_rule(TauRule::Fixed(factor * tau), data);
        let last = self.run.iterations() + TUNING_ITERATIONS;
        let residuals = loop {
            let until = self.run.iterations() + TUNING_STEP;
            let (residuals, ended) = self.run_until(data, until, observer)?;
            if ended || until >= last || gain(before, &residuals) < -CLEAR_LOSS {
                break residuals;
            }
        };
        debug!(
            "{} with τ multiplied by {factor}: held-out error {:.4} σ",
            self.prior,
            rms(&residuals)
        );
        Ok(TauTrial {
            tau_factor: factor,
            residuals,
            support_fraction: self.run.support_fraction(),
        })
    }

    /// Continues with half of `τ`, then of that, as long as the held-out error falls; where the first half does
    /// not help, with twice of it. Returns the best factor. A video without support follows the noise at a smaller `τ`,
    /// so only a larger one is tried.
    fn tune(
        &mut self,
        data: &mut FrameData,
        mut best: TauTrial,
        observer: &mut Observer,
    ) -> Result<TauTrial, StopReason> {
        let tau = self.run.tau();
        let directions: &[f64] = if self.prior.support {
            &[1.0 / TAU_STEP, TAU_STEP]
        } else {
            &[TAU_STEP]
        };
        for &direction in directions {
            let mut factor = direction;
            while (1.0 / MAX_TAU_FACTOR..=MAX_TAU_FACTOR).contains(&factor) {
                let next = self.try_factor(factor, tau, &best.residuals, data, observer)?;
                let gain = gain(&best.residuals, &next.residuals);
                if gain.is_nan() || gain <= MIN_GAIN {
                    break;
                }
                best = next;
                factor *= direction;
            }
            if best.tau_factor != 1.0 {
                break;
            }
        }
        Ok(best)
    }

    /// Iterates until iteration `until` or the end. Returns the held-out residuals over `σ`, and whether the run has
    /// ended.
    fn run_until(
        &mut self,
        data: &mut FrameData,
        until: usize,
        observer: &mut Observer,
    ) -> Result<(Vec<f64>, bool), StopReason> {
        let until = until.min(self.params.max_iterations);
        let (background, shape) = (self.prior.background(), data.video_shape());
        let (label, runs_left) = (&*self.label, self.runs_left);
        let reason = self.run.run(data, &mut *self.prox, until, &mut |progress| {
            let progress = Progress {
                label,
                runs_left,
                ..*progress
            };
            observe_sum(background, shape, &progress, observer)
        });
        match reason {
            StopReason::TimeBudget | StopReason::Interrupted => Err(reason),
            reason => {
                let residuals = data.held_out_residuals(self.run.video()).into_iter();
                let residuals = residuals.map(|r| r / self.sigma).collect();
                let ended = reason == StopReason::Converged || until == self.params.max_iterations;
                Ok((residuals, ended))
            }
        }
    }

    /// The result so far, stopped for `reason`.
    fn into_result(self, data: &FrameData, reason: StopReason) -> Box<RunResult> {
        let solution = self.run.into_solution(data, &*self.prox, reason);
        Box::new(RunResult::new(self.prior, solution))
    }
}
