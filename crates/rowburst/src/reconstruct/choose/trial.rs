//! The trial of a candidate: a run on the pixels that are not held out.

use super::super::checkpoint::Checkpoint;
use super::super::frame_data::FrameData;
use super::super::held_out::{is_settled, rms};
use super::super::held_out_check::FIRST_CHECK_ITERATION;
use super::super::held_out_run::{ErrorAt, HeldOutRun};
use super::super::{Prior, RunResult};
use super::{Candidate, MIN_GAIN, Observer, gain};
use rowburst_core::linop::Background;
use rowburst_solve::admm::{Progress, TauRule};
use tracing::debug;

/// [`AdmmParams::tolerance`](rowburst_solve::admm::AdmmParams::tolerance) of a trial; larger is faster and compares less
/// exact videos.
pub(in crate::reconstruct) const TOLERANCE: f64 = 0.01;

/// Limits `(from iteration, ratio)`: a candidate stops where its held-out error exceeds `ratio` times that of the best after
/// as many iterations; smaller may stop the best (docs/design/011).
const MAX_ERROR_RATIOS: [(usize, f64); 4] = [(0, 20.0), (80, 6.0), (100, 3.0), (200, 1.5)];
/// Iteration at which a candidate is compared the second time, after [`FIRST_CHECK_ITERATION`]; smaller may stop the best.
const SECOND_COMPARISON: usize = 60;
/// Iteration from which on errors tell whether a candidate has settled; smaller judges what has not.
const FIRST_CHECK: usize = 80;
/// Iterations between two comparisons; larger stops candidates later.
const CHECK_INTERVAL: usize = 20;

/// Factor from one tried `τ` to the next; smaller is finer and takes more runs (docs/design/011).
const TAU_STEP: f64 = 2.0;
/// Largest factor on the `τ` of the discrepancy principle, up and down; larger tries more values.
const MAX_TAU_FACTOR: f64 = 8.0;
/// Least factor after a refinement of the PSF by the frame; smaller fits the video to errors of the PSF, which the refinement
/// has fitted to the video (docs/design/011).
const MIN_TAU_FACTOR_REFINED: f64 = 0.5;
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
    /// The held-out error at each check and comparison.
    pub errors: Vec<ErrorAt>,
    /// The held-out residuals over `σ` at the end.
    pub residuals: Vec<f64>,
    pub run: HeldOutRun,
    /// Its checkpoint, if one was to be kept.
    pub checkpoint: Option<Checkpoint>,
}

/// The run of a candidate.
pub(super) struct Trial {
    run: HeldOutRun,
    sigma: f64,
    /// Least factor on the `τ` of the discrepancy principle.
    min_tau_factor: f64,
    /// Whether a checkpoint is kept.
    keeps_checkpoint: bool,
    label: String,
    /// See [`Progress::runs_left`].
    runs_left: usize,
}

/// The errors from [`FIRST_CHECK`] on.
fn late_errors(errors: &[ErrorAt]) -> Vec<f64> {
    let late = errors.iter().filter(|at| at.iteration >= FIRST_CHECK);
    late.map(|at| at.error).collect()
}

/// The error of another trial after `iteration` iterations, or at its next comparison, or at its end; `None` before its
/// first one.
fn error_at(errors: &[ErrorAt], iteration: usize) -> Option<f64> {
    if errors.first()?.iteration > iteration {
        return None;
    }
    let next = errors.iter().find(|at| at.iteration >= iteration);
    next.or(errors.last()).map(|at| at.error)
}

/// Held-out error over that of the best candidate above which a candidate is stopped after so many iterations.
fn max_error_ratio(iterations: usize) -> f64 {
    let begun = MAX_ERROR_RATIOS
        .iter()
        .filter(|(from, _)| *from <= iterations);
    begun.fold(f64::INFINITY, |least, (_, ratio)| least.min(*ratio))
}

/// Whether the video of `prior` is one picture, all of it.
pub(in crate::reconstruct) fn is_one_picture(prior: &Prior, data: &FrameData) -> bool {
    let is_one_bin = data.video_shape().bins == 1 || prior.background() == Background::Alone;
    is_one_bin && !prior.support
}

impl Trial {
    /// The trial that begins with `run`, whose held-out errors are divided by `sigma`.
    pub fn new(mut run: HeldOutRun, sigma: f64) -> Self {
        run.admm.set_tolerance(TOLERANCE);
        Self {
            label: format!("testing prior {}", run.prior),
            run,
            sigma,
            min_tau_factor: 1.0 / MAX_TAU_FACTOR,
            keeps_checkpoint: false,
            runs_left: 0,
        }
    }

    /// The same, which tries few smaller `τ` if the frame has refined its PSF.
    pub fn after_refinement(mut self, has_refined_psf: bool) -> Self {
        if has_refined_psf {
            self.min_tau_factor = MIN_TAU_FACTOR_REFINED;
        }
        self
    }

    /// Sets whether the trial keeps a checkpoint.
    pub fn keeping_checkpoint(self, keeps_checkpoint: bool) -> Self {
        Self {
            keeps_checkpoint,
            ..self
        }
    }

    /// The same, shown as trial `number` of `count` before the final run.
    pub fn numbered(self, number: usize, count: usize) -> Self {
        Self {
            label: format!("testing prior {number} of {count}, {}", self.run.prior),
            runs_left: count - number + 1,
            ..self
        }
    }

    /// Runs until the solver stops, or until the held-out error is far above `best_errors`, those of the best candidate,
    /// or settles above `max_error`. Then tries other `τ` where the error is at most `max_error`. The error is the result so
    /// far of a run that the observer stopped.
    pub fn run(
        mut self,
        data: &mut FrameData,
        best_errors: &[ErrorAt],
        max_error: f64,
        observer: &mut Observer,
    ) -> Result<TrialResult, Box<RunResult>> {
        let mut until = self.run.admm.iterations().max(FIRST_CHECK_ITERATION);
        // Those of a check that the trial goes on from.
        let earlier = self.run.errors.iter().filter(|at| at.iteration < until);
        let mut errors: Vec<ErrorAt> = earlier
            .map(|at| ErrorAt {
                error: at.error / self.sigma,
                ..*at
            })
            .collect();
        let mut checkpoint = None;
        let (residuals, stopped_early) = loop {
            // The run pauses for each check, since an observer has no access to the held-out pixels.
            let (residuals, ended) = self.run_until(data, until, observer)?;
            if std::mem::take(&mut self.keeps_checkpoint) && !ended {
                checkpoint = Checkpoint::of(&self.run, data);
            }
            let iteration = self.run.admm.iterations();
            let error = rms(&residuals);
            errors.push(ErrorAt { iteration, error });
            let best_error = error_at(best_errors, iteration);
            let is_settled = is_settled(&late_errors(&errors));
            let ended = ended || (!self.run.prior.support && is_settled);
            let is_behind = best_error.is_some_and(|best_error| {
                error > max_error_ratio(iteration) * best_error || is_settled && error > max_error
            });
            if ended || is_behind {
                break (residuals, !ended);
            }
            until = (iteration + CHECK_INTERVAL).max(SECOND_COMPARISON);
        };
        let mut found = TauTrial {
            tau_factor: 1.0,
            residuals,
            support_fraction: self.run.admm.support_fraction(),
        };
        let is_tunable = self.run.rule().is_discrepancy() && !stopped_early;
        let is_one_picture = is_one_picture(&self.run.prior, data);
        // A limit of 0 is for trials that keep their `τ`.
        let is_close = rms(&found.residuals) <= max_error || is_one_picture && max_error > 0.0;
        if is_tunable && is_close {
            found = if is_one_picture {
                self.smooth(data, found, observer)?
            } else {
                self.tune(data, found, observer)?
            };
        }
        let candidate = Candidate {
            prior: self.run.prior,
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
            run: self.run,
            checkpoint,
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
    ) -> Result<TauTrial, Box<RunResult>> {
        let tau = self.run.admm.tau();
        let last = self
            .run
            .admm
            .max_iterations()
            .saturating_sub(TUNING_ITERATIONS);
        while lowest.tau_factor < MAX_TAU_FACTOR_AT_REST && self.run.admm.iterations() <= last {
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
    ) -> Result<TauTrial, Box<RunResult>> {
        let admm = &mut self.run.admm;
        admm.set_tau_rule(TauRule::Fixed(factor * tau), data);
        let last = admm.iterations() + TUNING_ITERATIONS;
        let residuals = loop {
            let until = self.run.admm.iterations() + TUNING_STEP;
            let (residuals, ended) = self.run_until(data, until, observer)?;
            if ended || until >= last || gain(before, &residuals) < -CLEAR_LOSS {
                break residuals;
            }
        };
        debug!(
            "{} with τ multiplied by {factor}: held-out error {:.4} σ",
            self.run.prior,
            rms(&residuals)
        );
        Ok(TauTrial {
            tau_factor: factor,
            residuals,
            support_fraction: self.run.admm.support_fraction(),
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
    ) -> Result<TauTrial, Box<RunResult>> {
        let tau = self.run.admm.tau();
        let directions: &[f64] = if self.run.prior.support {
            &[1.0 / TAU_STEP, TAU_STEP]
        } else {
            &[TAU_STEP]
        };
        for &direction in directions {
            let mut factor = direction;
            while (self.min_tau_factor..=MAX_TAU_FACTOR).contains(&factor) {
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
    ) -> Result<(Vec<f64>, bool), Box<RunResult>> {
        let until = until.min(self.run.admm.max_iterations());
        let (label, runs_left) = (&*self.label, self.runs_left);
        let has_converged = self.run.run(data, until, &mut |progress| {
            observer(&Progress {
                label,
                runs_left,
                ..*progress
            })
        })?;
        let residuals = data.held_out_residuals(self.run.admm.video()).into_iter();
        let residuals = residuals.map(|r| r / self.sigma).collect();
        let ended = has_converged || until == self.run.admm.max_iterations();
        Ok((residuals, ended))
    }
}
