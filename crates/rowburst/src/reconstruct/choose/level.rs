//! The noise level where nothing tells it.
//!
//! The noise level that the discrepancy principle is to aim at
//! falls by `√2` from step to step, each going on from the one before, until the held-out
//! error rises: then what is followed is noise. The highest level within a standard error of the
//! lowest error is taken (Breiman et al. 1984). Without the support, so that the path is that of a
//! convex problem. Then that level and its neighbours are tried with the whole prior.

use super::super::data::FrameData;
use super::super::{Prior, RunResult, show};
use super::trial::Trial;
use super::{Observer, rms};
use crate::solve::admm::{Admm, AdmmParams, Progress, TauRule};
use crate::solve::{DataTerm, StopReason};
use crate::vecmath::norm;

/// Highest noise level of the path over the rms of the frame, the factor from one to the next,
/// and the lowest.
const HIGHEST: f64 = 0.25;
const FALL: f64 = std::f64::consts::FRAC_1_SQRT_2;
const LOWEST: f64 = 1e-5;

/// Iterations of the first level, and of the others.
const FIRST_LEVEL: usize = 60;
const LEVEL: usize = 25;

/// The path has passed its lowest error where it is above it by so many standard errors.
const RISEN: f64 = 2.0;

/// The noise level at which the discrepancy principle predicts held-out pixels best, in counts.
pub(in crate::reconstruct) fn noise_level(
    data: &mut FrameData,
    prior: Prior,
    most: Option<usize>,
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
    let rms_of_frame = norm(data.measured()) / (data.informative() as f64).sqrt();
    let mut sigma = HIGHEST * rms_of_frame;
    let rule = |sigma| TauRule::Discrepancy { sigma };
    // The certificate has no say: the next level is another problem.
    let params = AdmmParams {
        tolerance: 0.0,
        ..prior.admm_params(shape, rule(sigma), most)
    };
    let mut prox = prior.prox(shape);
    let mut run = Admm::new(data, shape, params);
    let mut path: Vec<(f64, f64)> = Vec::new();
    let mut highest = None;
    while sigma >= LOWEST * rms_of_frame {
        let until = run.iterations() + if path.is_empty() { FIRST_LEVEL } else { LEVEL };
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
        let errors = data.errors_held_out(run.video());
        let (error, standard_error) = (rms(&errors), (0.5 / errors.len() as f64).sqrt());
        path.push((sigma, error));
        let lowest = path.iter().map(|p| p.1).fold(f64::INFINITY, f64::min);
        highest = path
            .iter()
            .find(|p| p.1 <= lowest * (1.0 + standard_error))
            .map(|p| p.0);
        if error > lowest * (1.0 + RISEN * standard_error) {
            break;
        }
        sigma *= FALL;
        run.set_tau_rule(rule(sigma), data);
    }
    drop((run, prox));
    let level = highest.unwrap_or(sigma);
    let mut level_errors: Vec<(f64, f64)> = Vec::new();
    for sigma in [level / FALL, level, level * FALL] {
        data.start(whole.background(), Some(held_out.clone()));
        let trial = Trial::new(data, whole, rule(sigma), 1.0, most);
        let (candidate, ..) = trial.run(data, &[], 0.0, observer)?;
        level_errors.push((sigma, candidate.error));
    }
    let best = level_errors.iter().min_by(|a, b| a.1.total_cmp(&b.1));
    Ok(best.map_or(level, |(sigma, _)| *sigma))
}
