//! The search for a correction: reconstructions that leave pixels out, and steps between them.

use super::super::RunResult;
use super::super::choose::{self, Observer};
use super::calibrator::{Calibrator, Correction, Trial};
use super::parameters::Parameter;
use super::step::{Free, StepReport, step};

/// Most iterations of a reconstruction between two steps.
pub(super) const ITERATIONS: usize = 120;
/// Most iterations of a reconstruction that is only judged; fewer compare videos that have not settled.
const JUDGED_ITERATIONS: usize = 100;
/// Most iterations of a reconstruction well above the noise of the sensor.
const LOOSE_ITERATIONS: usize = 60;
/// Noise level over that of the sensor above which a reconstruction is a loose one.
const LOOSE_LEVEL: f64 = 1.5;
/// Most rounds of a reconstruction and a step.
const MAX_ROUNDS: usize = 9;
/// Noise level of a round over that of the one before.
const LEVEL_RATIO: f64 = 0.5;
/// Noise level of a round over what the step before has left; smaller fits the error of the model.
const REMAINING_RATIO: f64 = 1.1;
/// Least noise level of a round over the held-out error of the one before.
const HELD_OUT_RATIO: f64 = 0.7;
/// Change of a parameter over the width of its prior below which it is found.
const SMALL_CHANGE: f64 = 0.02;
/// The same over its standard error.
const SMALL_CHANGE_IN_ERRORS: f64 = 2.0;
/// Rms change of the stray light of rows over the mean of the frame below which it is found.
const SMALL_ROW_CHANGE: f64 = 5e-4;
/// Fall of the held-out error within a round, in parts of it, below which a round at the same level is the last.
const MIN_FALL: f64 = 0.03;
/// First steps of the search for a blur, in pixels²: sharper, and more blurred.
pub(super) const BLUR_STEPS: [f64; 2] = [-0.15, 0.1];
/// Most times that such a step is doubled.
const MAX_DOUBLINGS: usize = 4;
/// Resolution of the search for a blur, in pixels².
const BLUR_RESOLUTION: f64 = 0.03;

/// A correction with what a reconstruction under it predicts.
#[derive(Debug, Clone)]
pub(super) struct Candidate {
    pub correction: Correction,
    /// Noise level of the reconstruction, in counts.
    pub level: f64,
    /// Weighted residuals of the held-out pixels, in counts.
    pub held_out: Vec<f64>,
}

impl Candidate {
    /// Root mean square of the held-out residuals.
    pub fn error(&self) -> f64 {
        choose::rms(&self.held_out)
    }

    /// The one with the smaller error.
    pub fn better(self, other: Self) -> Self {
        if other.error() < self.error() {
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
    pub observer: &'o mut Observer<'c>,
}

impl Search<'_, '_, '_> {
    /// Reconstructs under `correction` at the noise level `level`.
    pub fn run(
        &mut self,
        correction: &Correction,
        level: f64,
        iterations: usize,
    ) -> Result<Trial, Box<RunResult>> {
        self.calibrator
            .run(correction, level, iterations, self.observer)
    }

    /// Judges `correction` at the noise level `level`.
    pub fn judge(
        &mut self,
        correction: &Correction,
        level: f64,
    ) -> Result<Candidate, Box<RunResult>> {
        let trial = self.run(correction, level, JUDGED_ITERATIONS)?;
        Ok(Candidate {
            correction: correction.clone(),
            level,
            held_out: trial.held_out,
        })
    }

    /// Changes the parameters `free` from those of `correction` on, by reconstructions at noise levels that fall from
    /// `start` to that of the sensor, each followed by a step. Returns the last reconstruction.
    pub fn parameters(
        &mut self,
        mut correction: Correction,
        free: Free,
        start: f64,
    ) -> Result<Candidate, Box<RunResult>> {
        let mut level = start;
        let mut last_error = f64::INFINITY;
        for round in 1.. {
            let iterations = if level > LOOSE_LEVEL * self.sigma {
                LOOSE_ITERATIONS
            } else {
                ITERATIONS
            };
            let trial = self.run(&correction, level, iterations)?;
            let candidate = Candidate {
                correction: correction.clone(),
                level,
                held_out: trial.held_out.clone(),
            };
            let error = candidate.error();
            if round == MAX_ROUNDS
                || self.is_last_level(level) && error > (1.0 - MIN_FALL) * last_error
            {
                return Ok(candidate);
            }
            last_error = if self.is_last_level(level) {
                error
            } else {
                f64::INFINITY
            };
            let residual_rms = trial.residual_rms;
            let report = self.steps(&mut correction, trial, level, free);
            let is_found = is_found(&candidate.correction, &correction, free, &report)
                && self.moves_few_rows(&candidate.correction, &correction);
            if self.is_last_level(level) && is_found {
                return Ok(candidate);
            }
            let remaining = report.remaining_sigma;
            let is_explained = (remaining / residual_rms.max(f64::MIN_POSITIVE)).min(1.0);
            level = (LEVEL_RATIO * level)
                .min(REMAINING_RATIO * remaining)
                .max(HELD_OUT_RATIO * error * is_explained)
                .max(self.sigma);
        }
        unreachable!("the loop returns")
    }

    /// Two steps with the same video: the second one around the result of the first.
    fn steps(
        &mut self,
        correction: &mut Correction,
        mut trial: Trial,
        level: f64,
        free: Free,
    ) -> StepReport {
        step(&mut self.calibrator, correction, &mut trial, level, free);
        let mut trial = Trial {
            data: self.calibrator.data(correction),
            ..trial
        };
        step(&mut self.calibrator, correction, &mut trial, level, free)
    }

    /// Whether a step has changed the stray light of the rows by little.
    fn moves_few_rows(&self, before: &Correction, after: &Correction) -> bool {
        let pairs = before.row_offsets.iter().zip(&after.row_offsets);
        let changes: Vec<f64> = pairs.map(|(b, a)| a - b).collect();
        choose::rms(&changes) < SMALL_ROW_CHANGE * self.calibrator.mean()
    }

    fn is_last_level(&self, level: f64) -> bool {
        level <= 1.001 * self.sigma
    }

    /// Searches for the blur of the PSF, at the noise level of `start`. Goes on where one of `first_steps`
    /// lowers the held-out error to `descent` of it.
    ///
    /// The error is not linear in the blur, and at a level well above the noise it hardly changes, so steps of
    /// [`Self::parameters`] do not find it (docs/design/026).
    pub fn blur(
        &mut self,
        start: &Candidate,
        first_steps: &[f64],
        descent: f64,
    ) -> Result<Candidate, Box<RunResult>> {
        let blur = |c: &Candidate| c.correction.parameters[Parameter::Blur];
        for &first in first_steps {
            let mut tried = vec![start.clone()];
            let mut step = first;
            for _ in 0..=MAX_DOUBLINGS {
                let next = self.blurred(start, blur(start) + step)?;
                let last = &tried[tried.len() - 1];
                let limit = if tried.len() == 1 { descent } else { 1.0 };
                let has_fallen = next.error() < limit * last.error();
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
                    .min_by(|a, b| tried[*a].error().total_cmp(&tried[*b].error()))
                    .expect("blurs were tried");
                let sides = [
                    best.checked_sub(1),
                    Some(best + 1).filter(|i| *i < tried.len()),
                ];
                let gap = |i: &usize| (blur(&tried[*i]) - blur(&tried[best])).abs();
                let widest = sides
                    .into_iter()
                    .flatten()
                    .max_by(|a, b| gap(a).total_cmp(&gap(b)));
                let other = widest.expect("two blurs were tried");
                if gap(&other) < 2.0 * BLUR_RESOLUTION {
                    return Ok(tried.swap_remove(best));
                }
                let between = (blur(&tried[best]) + blur(&tried[other])) / 2.0;
                let next = self.blurred(start, between)?;
                tried.insert(best.max(other), next);
            }
        }
        Ok(start.clone())
    }

    fn blurred(&mut self, start: &Candidate, blur: f64) -> Result<Candidate, Box<RunResult>> {
        let mut correction = start.correction.clone();
        correction.parameters[Parameter::Blur] = blur;
        self.judge(&correction, start.level)
    }

    /// A reconstruction of `candidate` without a second set of pixels, and the standard error of each of the parameters
    /// `free`.
    pub fn repeat(
        &mut self,
        candidate: &Candidate,
        free: &[Parameter],
    ) -> Result<(Candidate, Vec<f64>), Box<RunResult>> {
        self.calibrator.hold_out_others();
        let mut trial = self.run(&candidate.correction, candidate.level, JUDGED_ITERATIONS)?;
        let repeated = Candidate {
            held_out: trial.held_out.clone(),
            ..candidate.clone()
        };
        let free = Free {
            parameters: free,
            has_row_offsets: candidate.correction.has_row_offsets(),
        };
        let mut correction = candidate.correction.clone();
        let report = step(
            &mut self.calibrator,
            &mut correction,
            &mut trial,
            candidate.level,
            free,
        );
        Ok((repeated, report.standard_errors))
    }
}

/// Whether a step has changed the parameters by little.
fn is_found(before: &Correction, after: &Correction, free: Free, report: &StepReport) -> bool {
    let pairs = free.parameters.iter().zip(&report.standard_errors);
    pairs.clone().all(|(&p, standard_error)| {
        let change = (after.parameters[p] - before.parameters[p]).abs();
        change < (SMALL_CHANGE * p.prior_width()).max(SMALL_CHANGE_IN_ERRORS * standard_error)
    })
}
