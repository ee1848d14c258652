//! The noise level where nothing tells it.
//!
//! The noise level that the discrepancy principle is to aim at
//! falls by `√2` from step to step, each going on from the one before, until the held-out
//! error rises: then what is followed is noise. The highest level within a standard error of the
//! lowest error is taken (Breiman et al. 1984). Without the support, so that the path is that of a
//! convex problem. Then that level and its neighbours are tried with the whole prior.

use super::super::frame_data::FrameData;
use super::super::{Prior, RunResult, show};
use super::trial::Trial;
use super::{Observer, rms};
use crate::solve::admm::{Admm, AdmmParams, Progress, TauRule};
use crate::solve::{DataTerm, StopReason};
use crate::vecmath::norm;

/// Highest noise level of the path over the rms of the frame, the factor from one to the next,
/// and the lowest.
const MAX_SIGMA_RATIO: f64 = 0.25;
const SIGMA_STEP: f64 = std::f64::consts::FRAC_1_SQRT_2;
const MIN_SIGMA_RATIO: f64 = 1e-5;

/// Iterations of the first level, and of the others.
const FIRST_LEVEL_ITERATIONS: usize = 60;
const LEVEL_ITERATIONS: usize = 25;

/// The path has passed its lowest error where it is above it by so many standard errors.
const RISE_IN_STANDARD_ERRORS: f64 = 2.0;

/// The noise level at which the discrepancy principle predicts held-out pixels best, in counts.
pub(in crate::reconstruct) fn noise_level(
    data: &mut FrameData,
    prior: Prior,
    max_iterations: Option<usize>,
    observer: &mut Observer,
) -> Result<f64, Box<RunResult>> {
    let shape = data.shape();
    let whole = prior;
    let prior = Prior {
        support: false,
        ..prior
    };
    let held_out = data.held_out();
    data.start(prior.background(), Some(held_out.clone()));
    let rms_of_frame = norm(data.measured()) / (data.measurement_count() as f64).sqrt();
    let mut sigma = MAX_SIGMA_RATIO * rms_of_frame;
    let rule = |sigma| TauRule::Discrepancy { sigma };
    // The certificate has no say: the next level is another problem.
    let params = AdmmParams {
        tolerance: 0.0,
        ..prior.admm_params(shape, rule(sigma), max_iterations)
    };
    let mut prox = prior.prox(shape);
    let mut run = Admm::new(data, shape, params);
    let mut path: Vec<(f64, f64)> = Vec::new();
    let mut highest = None;
    while sigma >= MIN_SIGMA_RATIO * rms_of_frame {
        let until = run.iterations()
            + if path.is_empty() {
                FIRST_LEVEL_ITERATIONS
            } else {
                LEVEL_ITERATIONS
            };
        let reason = run.run(data, &mut *prox, until, &mut |progress| {
            let progress = Progress {
                label: "finding the noise level",
                ..*progress
            };
            show(prior.background(), shape, &progress, observer)
        });
        if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
            let solution = run.solution(data, &*prox, reason);
            return Err(Box::new(RunResult::new(prior, &*prox, shape, solution)));
        }
        let errors = data.held_out_residuals(run.video());
        let (error, standard_error) = (rms(&errors), (0.5 / errors.len() as f64).sqrt());
        path.push((sigma, error));
        let lowest = path.iter().map(|p| p.1).fold(f64::INFINITY, f64::min);
        highest = path
            .iter()
            .find(|p| p.1 <= lowest * (1.0 + standard_error))
            .map(|p| p.0);
        if error > lowest * (1.0 + RISE_IN_STANDARD_ERRORS * standard_error) {
            break;
        }
        sigma *= SIGMA_STEP;
        run.set_tau_rule(rule(sigma), data);
    }
    drop((run, prox));
    let level = highest.unwrap_or(sigma);
    let mut level_errors: Vec<(f64, f64)> = Vec::new();
    for sigma in [level / SIGMA_STEP, level, level * SIGMA_STEP] {
        data.start(whole.background(), Some(held_out.clone()));
        let trial = Trial::new(data, whole, rule(sigma), 1.0, max_iterations);
        let (candidate, ..) = trial.run(data, &[], 0.0, observer)?;
        level_errors.push((sigma, candidate.error));
    }
    let best = level_errors.iter().min_by(|a, b| a.1.total_cmp(&b.1));
    Ok(best.map_or(level, |(sigma, _)| *sigma))
}
