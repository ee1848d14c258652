//! The search for a correction: reconstructions that leave pixels out, and steps between them.

use super::super::Observer;
use super::super::RunResult;
use super::super::held_out;
use super::calibrator::{Calibrator, Correction, Trial};
use super::parameters::ModelParameter;
use super::request::Correctable;
use super::step::{Free, StepReport, step};
use tracing::info;

/// Most iterations of a reconstruction between two steps.
const ITERATIONS: usize = 120;
/// Most iterations of a reconstruction that is only judged; fewer compare videos that have not settled.
pub(super) const JUDGED_ITERATIONS: usize = 100;
/// Most iterations of a reconstruction well above the noise of the sensor.
pub(super) const LOOSE_ITERATIONS: usize = 60;
/// Noise level over that of the sensor above which a reconstruction is a loose one.
const LOOSE_LEVEL: f64 = 1.5;
/// Most rounds of a reconstruction and a step.
const MAX_ROUNDS: usize = 9;
/// Noise level of a round over that of the one before.
const LEVEL_RATIO: f64 = 0.5;
/// Noise level of a round over what the step before has left; smaller fits the error of the model.
const REMAINING_RATIO: f64 = 1.1;
/// Least noise level of a round over the error of the judging pixels in the one before.
const HELD_OUT_RATIO: f64 = 0.7;
/// Change of a parameter over the width of its prior below which it is found.
const SMALL_CHANGE: f64 = 0.02;
/// The same over its standard error.
const SMALL_CHANGE_IN_ERRORS: f64 = 2.0;
/// Rms change of the stray light of rows over the mean of the frame below which it is found.
const SMALL_ROW_CHANGE: f64 = 5e-4;
/// Fall of the error within a round, in parts of it, below which a round at much the same noise level is the last.
pub(super) const MIN_FALL: f64 = 0.03;
/// Noise level over that of the round before from which it is much the same.
const MAX_LEVEL_RATIO: f64 = 0.9;
/// First steps of the search for a blur, in pixels²: sharper, and more blurred.
pub(super) const BLUR_STEPS: [f64; 2] = [-0.15, 0.1];
/// Most times that such a step is doubled.
const MAX_DOUBLINGS: usize = 4;
/// Resolution of the search for a blur, in pixels².
const BLUR_RESOLUTION: f64 = 0.03;

/// A correction with how well reconstructions under it predict.
#[derive(Debug, Clone)]
pub(super) struct Proposal {
    pub correction: Correction,
    /// Noise level of the reconstructions, in counts.
    pub level: f64,
    /// Root mean square of the weighted residuals of the judging pixels, in counts.
    pub error: f64,
}

impl Proposal {
    /// The proposal of the reconstructions `trials`.
    pub fn new(correction: &Correction, level: f64, trials: &[Trial]) -> Self {
        Self {
            correction: correction.clone(),
            level,
            error: held_out::rms(&judging(trials)),
        }
    }

    /// The one with the smaller error.
    pub fn better(self, other: Self) -> Self {
        if other.error < self.error {
            other
        } else {
            self
        }
    }
}

/// A search in progress.
pub(super) struct Search<'p, 'o, 'c> {
    pub calibrator: Calibrator<'p>,
    /// Noise of the sensor, in counts.
    pub sigma: f64,
    pub correctable: Correctable,
    pub observer: &'o mut Observer<'c>,
}

impl Search<'_, '_, '_> {
    /// Reconstructs all frames under `correction` at the noise level `level`.
    pub fn run(
        &mut self,
        correction: &Correction,
        level: f64,
        iterations: usize,
    ) -> Result<Vec<Trial>, Box<RunResult>> {
        (0..self.calibrator.frame_count())
            .map(|frame| {
                self.calibrator
                    .run(frame, correction, level, iterations, self.observer)
            })
            .collect()
    }

    /// Judges `correction` at the noise level `level`.
    pub fn judge(
        &mut self,
        correction: &Correction,
        level: f64,
    ) -> Result<Proposal, Box<RunResult>> {
        let trials = self.run(correction, level, JUDGED_ITERATIONS)?;
        Ok(Proposal::new(correction, level, &trials))
    }

    /// Most iterations of a reconstruction at the noise level `level` that a step follows.
    pub fn iterations_at(&self, level: f64) -> usize {
        if level > LOOSE_LEVEL * self.sigma {
            LOOSE_ITERATIONS
        } else {
            ITERATIONS
        }
    }

    /// Changes the parameters `free` from those of `correction` on, by reconstructions at noise levels that fall from
    /// `start` to that of the sensor, each followed by a step. Returns the best of the last two reconstructions.
    pub fn parameters(
        &mut self,
        mut correction: Correction,
        free: Free,
        start: f64,
    ) -> Result<Proposal, Box<RunResult>> {
        let mut level = start;
        let mut last: Option<Proposal> = None;
        for round in 1.. {
            let mut trials = self.run(&correction, level, self.iterations_at(level))?;
            let proposal = Proposal::new(&correction, level, &trials);
            info!(
                "self-calibration, round {round}: noise level {:.3} σ, held-out error {:.3} σ",
                level / self.sigma,
                proposal.error / self.sigma
            );
            let has_stalled = last.as_ref().is_some_and(|last| {
                level > MAX_LEVEL_RATIO * last.level
                    && proposal.error > (1.0 - MIN_FALL) * last.error
            });
            if round == MAX_ROUNDS || has_stalled {
                return Ok(match last {
                    Some(last) => last.better(proposal),
                    None => proposal,
                });
            }
            let residual_rms = held_out::rms(&residuals(&trials));
            let calibrator = &mut self.calibrator;
            let report = step(calibrator, &mut correction, &mut trials, level, free);
            let is_found = is_found(&proposal.correction, &correction, free, &report)
                && self.moves_few_rows(&proposal.correction, &correction);
            if self.is_last_level(level) && is_found {
                return Ok(proposal);
            }
            let remaining = report.remaining_sigma;
            let unexplained_part = (remaining / residual_rms.max(f64::MIN_POSITIVE)).min(1.0);
            let error = proposal.error;
            last = Some(proposal);
            level = (LEVEL_RATIO * level)
                .min(REMAINING_RATIO * remaining)
                .max(HELD_OUT_RATIO * error * unexplained_part)
                .max(self.sigma);
        }
        unreachable!("the loop returns")
    }

    /// Whether a step has changed the stray light of the rows by little.
    fn moves_few_rows(&self, before: &Correction, after: &Correction) -> bool {
        let pairs = before.row_offsets.iter().zip(&after.row_offsets);
        let changes: Vec<f64> = pairs.map(|(b, a)| a - b).collect();
        held_out::rms(&changes) < SMALL_ROW_CHANGE * self.calibrator.mean()
    }

    fn is_last_level(&self, level: f64) -> bool {
        level <= 1.001 * self.sigma
    }

    /// Searches for the blur of the PSF, at the noise level of `start`. Goes on where one of `first_steps`
    /// lowers the error of the judging pixels to `descent` of it.
    ///
    /// The error is not linear in the blur, and at a level well above the noise it hardly changes, so steps of
    /// [`Self::parameters`] do not find it (docs/design/026).
    pub fn blur(
        &mut self,
        start: &Proposal,
        first_steps: &[f64],
        descent: f64,
    ) -> Result<Proposal, Box<RunResult>> {
        if !self.correctable.has(ModelParameter::Blur) {
            return Ok(start.clone());
        }
        let blur = |c: &Proposal| c.correction.parameters[ModelParameter::Blur];
        for &first in first_steps {
            let mut tried = vec![start.clone()];
            let mut step = first;
            for _ in 0..=MAX_DOUBLINGS {
                let next = self.blurred(start, blur(start) + step)?;
                let last = &tried[tried.len() - 1];
                let limit = if tried.len() == 1 { descent } else { 1.0 };
                let has_fallen = next.error < limit * last.error;
                tried.push(next);
                if !has_fallen {
                    break;
                }
                step *= 2.0;
            }
            if tried.len() == 2 {
                continue;
            }
            tried.sort_by(|a, b| blur(a).total_cmp(&blur(b)));
            loop {
                let best = (0..tried.len())
                    .min_by(|a, b| tried[*a].error.total_cmp(&tried[*b].error))
                    .expect("blurs were tried");
                let points: Vec<(f64, f64)> =
                    tried.iter().map(|p| (blur(p), p.error.powi(2))).collect();
                let Some(next) = next_blur(&points, best) else {
                    return Ok(tried.swap_remove(best));
                };
                let at = tried.partition_point(|p| blur(p) < next);
                tried.insert(at, self.blurred(start, next)?);
            }
        }
        Ok(start.clone())
    }

    fn blurred(&mut self, start: &Proposal, blur: f64) -> Result<Proposal, Box<RunResult>> {
        let mut correction = start.correction.clone();
        correction.parameters[ModelParameter::Blur] = blur;
        let proposal = self.judge(&correction, start.level)?;
        info!(
            "self-calibration, blur {blur:.3} px²: held-out error {:.3} σ",
            proposal.error / self.sigma
        );
        Ok(proposal)
    }
}

/// The blur to try next: the minimum of the parabola through the best of `points`, pairs of blur and squared error, and its
/// neighbours. `None`: the best is known well enough, or has a neighbour on one side alone.
fn next_blur(points: &[(f64, f64)], best: usize) -> Option<f64> {
    let ((left, e_left), (middle, e_middle), (right, e_right)) = (
        *points.get(best.checked_sub(1)?)?,
        points[best],
        *points.get(best + 1)?,
    );
    let (down, up) = (
        (e_middle - e_left) / (middle - left),
        (e_right - e_middle) / (right - middle),
    );
    let curvature = (up - down) / (right - left);
    let vertex = (left + middle) / 2.0 - down / (2.0 * curvature);
    // At the best itself nothing would be learnt: then the wider side is tried.
    let next = if (vertex - middle).abs() >= BLUR_RESOLUTION {
        vertex
    } else if middle - left > right - middle {
        middle - BLUR_RESOLUTION
    } else {
        middle + BLUR_RESOLUTION
    };
    let is_new = |other: f64| (next - other).abs() >= 0.999 * BLUR_RESOLUTION;
    (is_new(left) && is_new(right) && next > left && next < right).then_some(next)
}

/// The residuals of the judging pixels of all frames.
pub(super) fn judging(trials: &[Trial]) -> Vec<f64> {
    trials.iter().flat_map(|t| t.judging.clone()).collect()
}

/// The residuals of the confirming pixels of all frames.
pub(super) fn confirming(trials: &[Trial]) -> Vec<f64> {
    trials.iter().flat_map(|t| t.confirming.clone()).collect()
}

/// The root mean square residual of each frame.
fn residuals(trials: &[Trial]) -> Vec<f64> {
    trials.iter().map(|t| t.residual_rms).collect()
}

/// Whether a step has changed the parameters by little.
fn is_found(before: &Correction, after: &Correction, free: Free, report: &StepReport) -> bool {
    let pairs = free.parameters.iter().zip(&report.standard_errors);
    pairs.clone().all(|(&p, standard_error)| {
        let change = (after.parameters[p] - before.parameters[p]).abs();
        change < (SMALL_CHANGE * p.prior_width()).max(SMALL_CHANGE_IN_ERRORS * standard_error)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A few reconstructions find the blur of the smallest error, also where the error rises more steeply on one side.
    #[test]
    fn blurs_are_found_in_few_trials() {
        let error = |blur: f64| {
            let distance = blur + 0.19;
            1.5 + distance.powi(2) * if distance > 0.0 { 300.0 } else { 60.0 }
        };
        let mut points: Vec<(f64, f64)> = [-0.6, -0.3, -0.15, 0.0].map(|b| (b, error(b))).into();
        let best = |points: &[(f64, f64)]| {
            let order = |a: &usize, b: &usize| points[*a].1.total_cmp(&points[*b].1);
            (0..points.len()).min_by(order).expect("points")
        };
        while let Some(next) = next_blur(&points, best(&points)) {
            let at = points.partition_point(|p| p.0 < next);
            points.insert(at, (next, error(next)));
        }
        let found = points[best(&points)].0;
        assert!((found + 0.19).abs() < BLUR_RESOLUTION, "{found}");
        assert!(points.len() <= 9, "{}", points.len());
        // The best blur at an end has no neighbour.
        assert_eq!(next_blur(&[(0.0, 2.0), (0.1, 1.0)], 1), None);
    }
}
