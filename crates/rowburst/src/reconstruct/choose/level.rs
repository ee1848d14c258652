//! Estimate of an unknown noise level by held-out pixels.
//!
//! The noise level `σ` of the discrepancy principle falls by `√2` from step to step, or to `√½` of what the video leaves
//! where that is less, with a warm start from the step before, until the held-out error rises because the video follows
//! the noise. The highest `σ` whose error is within a standard error of the lowest one is selected (the
//! one-standard-error rule; Breiman et al. 1984). The path is run without the support, so that each problem is convex. At
//! the end the selected `σ` and its neighbours are tried with the whole prior, and the best one is the result.

use super::super::SolverSettings;
use super::super::frame_data::FrameData;
use super::super::held_out::rms;
use super::super::held_out_run::HeldOutRun;
use super::super::{Prior, RunResult};
use super::Observer;
use super::trial::Trial;
use rowburst_core::vecmath::norm;
use rowburst_solve::admm::{Admm, AdmmParams, Progress, TauRule};
use rowburst_solve::{DataTerm, StopReason};
use tracing::debug;

/// Noise level at which the path begins, over the rms of the frame; larger takes more steps.
const MAX_SIGMA_RATIO: f64 = 0.25;
/// Factor from one noise level to the next; closer to 1 is finer and takes more steps.
const SIGMA_STEP: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// Noise level below which the path ends, over the rms of the frame; smaller takes more steps.
const MIN_SIGMA_RATIO: f64 = 1e-5;

/// Iterations at the first noise level; fewer compare videos that have not settled.
const FIRST_LEVEL_ITERATIONS: usize = 60;
/// Iterations at each later noise level; fewer lag behind the minimum, more cost time.
const LEVEL_ITERATIONS: usize = 25;

/// Rise of the held-out error above its lowest, in standard errors, that ends the path; smaller follows chance.
const RISE_IN_STANDARD_ERRORS: f64 = 2.0;

/// The noise levels that were tried, from the highest on. It is the controller of `τ` by held-out pixels, and acts between
/// runs, by [`Admm::set_tau_rule`]: a level is judged when its video has settled.
struct NoiseLevelPath {
    /// Noise level in counts, and the held-out error of its video in counts rms.
    levels: Vec<(f64, f64)>,
    /// Standard error of a held-out error, over itself.
    standard_error: f64,
}

impl NoiseLevelPath {
    /// A path whose errors are of `held_out` pixels each.
    fn new(held_out: usize) -> Self {
        Self {
            levels: Vec::new(),
            standard_error: (0.5 / held_out as f64).sqrt(),
        }
    }

    /// Iterations at the next level.
    fn iterations(&self) -> usize {
        if self.levels.is_empty() {
            FIRST_LEVEL_ITERATIONS
        } else {
            LEVEL_ITERATIONS
        }
    }

    fn push(&mut self, sigma: f64, error: f64) {
        self.levels.push((sigma, error));
    }

    fn lowest_error(&self) -> f64 {
        let errors = self.levels.iter().map(|level| level.1);
        errors.fold(f64::INFINITY, f64::min)
    }

    /// The highest level whose error is within a standard error of the lowest one.
    fn selected(&self) -> Option<f64> {
        let limit = self.lowest_error() * (1.0 + self.standard_error);
        let mut levels = self.levels.iter();
        levels.find(|level| level.1 <= limit).map(|level| level.0)
    }

    /// Whether the last error has risen: the video follows the noise.
    fn has_risen(&self) -> bool {
        let limit = self.lowest_error() * (1.0 + RISE_IN_STANDARD_ERRORS * self.standard_error);
        self.levels.last().is_some_and(|level| level.1 > limit)
    }
}

/// The noise level in counts at which the discrepancy principle predicts held-out pixels best. The error is the
/// result so far of a run that the observer stopped.
pub(in crate::reconstruct) fn noise_level(
    data: &mut FrameData,
    prior: Prior,
    settings: SolverSettings,
    observer: &mut Observer,
) -> Result<f64, Box<RunResult>> {
    let full_prior = prior;
    let prior = prior.without_support();
    let held_out = data.held_out();
    data.reset(prior.background(), Some(held_out.clone()));
    let shape = data.shape();
    let rms_of_frame = norm(data.measurements()) / (data.measurement_count() as f64).sqrt();
    let mut sigma = MAX_SIGMA_RATIO * rms_of_frame;
    let rule = |sigma| TauRule::Discrepancy { sigma };
    // No stop by the certificate, since every noise level is another problem.
    let params = AdmmParams {
        tolerance: 0.0,
        ..prior.admm_params(shape, rule(sigma), settings)
    };
    let mut prox = data.prox(&prior);
    let mut run = Admm::new(data, shape, params);
    let video_form = data.video_form(prior.background());
    let mut path = NoiseLevelPath::new(held_out.pixels().len());
    // What the video of a level leaves of the pixels that it is made from.
    let mut residual_rms = f64::INFINITY;
    while sigma >= MIN_SIGMA_RATIO * rms_of_frame {
        let until = run.iterations() + path.iterations();
        let reason = run.run(data, &mut *prox, until, &mut |progress| {
            residual_rms = progress.residual_rms;
            let progress = Progress {
                label: "estimating the noise level",
                ..*progress
            };
            video_form.observe(&progress, observer)
        });
        if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
            let solution = run.into_solution(data, &*prox, reason);
            return Err(Box::new(RunResult::new(prior, solution)));
        }
        let error = rms(&data.held_out_residuals(run.video()));
        debug!(
            "noise level {sigma:.4e}: held-out error {error:.4e}, τ {:.4e}",
            run.tau()
        );
        path.push(sigma, error);
        if path.has_risen() {
            break;
        }
        // A video that fits better than asked for, as that of an even scene, tells nothing of the levels between.
        sigma = SIGMA_STEP * sigma.min(residual_rms);
        run.set_tau_rule(rule(sigma), data);
    }
    drop((run, prox));
    let level = path.selected().unwrap_or(sigma);
    let mut level_errors: Vec<(f64, f64)> = Vec::new();
    for sigma in [level / SIGMA_STEP, level, level * SIGMA_STEP] {
        let run = HeldOutRun::new(data, full_prior, rule(sigma), settings);
        let trial_result = Trial::new(run, 1.0).run(data, &[], 0.0, observer)?;
        level_errors.push((sigma, trial_result.candidate.error));
    }
    let best = level_errors.iter().min_by(|a, b| a.1.total_cmp(&b.1));
    Ok(best.map_or(level, |(sigma, _)| *sigma))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_level_within_a_standard_error_of_the_lowest_is_selected() {
        // A standard error of 0.1.
        let mut path = NoiseLevelPath::new(50);
        assert_eq!(
            (path.selected(), path.iterations()),
            (None, FIRST_LEVEL_ITERATIONS)
        );
        for (sigma, error) in [(4.0, 2.0), (2.8, 1.2), (2.0, 1.05), (1.4, 1.0)] {
            path.push(sigma, error);
            assert!(!path.has_risen(), "{sigma}");
        }
        assert_eq!(
            (path.selected(), path.iterations()),
            (Some(2.0), LEVEL_ITERATIONS)
        );
        path.push(1.0, 1.19);
        assert!(!path.has_risen());
        path.push(0.7, 1.21);
        assert!(path.has_risen());
        assert_eq!(path.selected(), Some(2.0));
    }
}
