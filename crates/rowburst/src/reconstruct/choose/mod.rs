//! The automatic choices: `τ` and the prior that predict held-out pixels best.
//!
//! **Prior.** Each of [`CANDIDATES`] is run without the pixels held out (see `HeldOut`), and
//! the one with the smallest error there is then run on the whole frame. Candidates that are far
//! behind are given up early.
//!
//! **Strength.** The discrepancy principle counts what the fit chooses freely, and noise that is a
//! little stronger or weaker than on average moves it by a factor of 2 in `τ` and more. So from
//! where it ends, each candidate goes on with half or twice the `τ` as long as that predicts the
//! held-out pixels better; the factor goes with the prior into the run on the whole frame. A moving
//! digit gains 0.5 to 2.3 dB by it (seeds 1 to 5, signal-to-noise ratio 256).

mod level;
mod trial;

pub(super) use level::noise_level;
pub(super) use trial::TOLERANCE;

use super::frame_data::FrameData;
use super::{Prior, RunResult};
use crate::solve::StopReason;
use crate::solve::admm::{Progress, Solution, TauRule};
use crate::vecmath::norm;
use std::ops::ControlFlow;
use trial::Trial;

/// Sees every iteration and may stop it.
type Observer<'o> = dyn FnMut(&Progress) -> ControlFlow<StopReason> + 'o;

/// The priors that `auto` chooses among, the one that is kept where others are no better first.
///
/// Not among them, since none was best by more than 0.7 dB on digits, LEDs and moving digits:
/// `tv3d`, `wavelet` (ten times the time) and `l1`, each with the support.
pub const CANDIDATES: [&str; 3] = [
    "tv+2*tdiff+support",
    "tv+0.5*tdiff+support",
    "group+support",
];

/// What is tried as well where a scene is not sparse: light on more than a third of the voxels is
/// often that of a background. 12 px digits and a moving one before a background three times as
/// bright: 33.5 and 32.0 dB, without it 16.6 and 15.0 dB.
pub const DENSE_CANDIDATES: [&str; 1] = ["tv+0.5*tdiff+0.3*l1+background+support"];
const DENSE_SUPPORT: f64 = 1.0 / 3.0;

/// Candidates whose held-out error is above that of the best so far by this are not tried with
/// another `τ`: none that was then chosen gained as much by it.
const MAX_TUNING_ERROR_RATIO: f64 = 1.06;

/// Part by which an error must be smaller than that of the prior or the `τ` before it, times the
/// root of the number of pixels held out; less is chance. Of 600 pixels it is half a per cent: of a moving
/// digit (seed 2) `group+support` predicted them better than `tv+0.5*tdiff+support` by 0.3 %, and was
/// 3 dB worse; where it is better (LEDs) it is so by 4 to 7 %. Half or twice the `τ` was no better
/// for LEDs and larger digits where it gained less than that; for moving digits it gains 0.6 to 3 %.
const SIGNIFICANCE: f64 = 0.12;

/// See [`SIGNIFICANCE`].
fn margin(held_out: usize) -> f64 {
    SIGNIFICANCE / (held_out.max(1) as f64).sqrt()
}

/// What `auto` chose among.
#[derive(Debug, Clone, PartialEq)]
pub struct Choice {
    /// The candidates in the order in which they were tried.
    pub candidates: Vec<Candidate>,
    /// Number of pixels held out.
    pub held_out: usize,
}

/// A candidate and how well it predicts pixels that it has not seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The prior.
    pub prior: Prior,
    /// `τ` over that of the discrepancy principle.
    pub tau_factor: f64,
    /// Rms of `W(b − A v)/σ` over the pixels held out.
    pub error: f64,
    /// Part of the voxels that it lets be lit.
    pub support: f64,
    /// Whether it was given up before its end.
    pub given_up: bool,
}

impl Candidate {
    /// The prior, and the factor on `τ` where it is not 1.
    pub fn name(&self) -> String {
        if self.tau_factor == 1.0 {
            self.prior.to_string()
        } else {
            format!(
                "{} with {} times the τ of the discrepancy principle",
                self.prior, self.tau_factor
            )
        }
    }
}

impl Choice {
    /// The candidate with the smallest error, where it is smaller than that of all before it by
    /// more than chance (half a per cent with 600 pixels).
    ///
    /// # Panics
    /// If there is none.
    pub fn best(&self) -> Candidate {
        let margin = margin(self.held_out);
        let better = |best: Candidate, next: &Candidate| {
            // An error that is no number never is the smaller one.
            if next.error < (1.0 - margin) * best.error || best.error.is_nan() {
                *next
            } else {
                best
            }
        };
        let (first, rest) = self.candidates.split_first().expect("there are candidates");
        rest.iter().fold(*first, better)
    }

    /// Why, as a plain sentence without a full stop.
    pub fn reason(&self) -> String {
        let best = self.best();
        let others = self.candidates.iter().filter(|c| **c != best).map(|c| {
            let given_up = if c.given_up { ", given up" } else { "" };
            format!("{} {:.3} σ{given_up}", c.name(), c.error)
        });
        let smallest = self.candidates.iter().all(|c| c.error >= best.error);
        format!(
            "{} predicts {} pixels that it had not seen to {:.3} σ; {}{}",
            best.name(),
            self.held_out,
            best.error,
            others.collect::<Vec<_>>().join("; "),
            if smallest {
                String::new()
            } else {
                format!(
                    "; differences below {:.1} % are taken for chance, and the earlier prior is kept",
                    100.0 * margin(self.held_out)
                )
            }
        )
    }
}

/// Fewest pixels held out that a choice may rest on: their mean square scatters by a fifth.
const MIN_HELD_OUT_PIXELS: usize = 50;

/// Whether the frame has the pixels for a choice.
pub(super) fn can_choose(data: &FrameData) -> bool {
    data.held_out().pixels().len() >= MIN_HELD_OUT_PIXELS
}

/// What the best trial has found, without the pixels that were held out.
pub(super) struct BestTrial {
    prior: Prior,
    solution: Solution,
}

impl BestTrial {
    /// Rms of `W(b − A v)`, but for a factor that all runs on a frame share.
    pub fn misfit(&self) -> f64 {
        norm(&self.solution.residual)
    }

    /// The same as the end of a run that was stopped, for `data` that it was found with.
    pub fn stopped(mut self, data: &FrameData, reason: StopReason) -> Box<RunResult> {
        self.solution.stop_reason = reason;
        let prox = self.prior.prox(data.shape());
        Box::new(RunResult::new(
            self.prior,
            &*prox,
            data.shape(),
            self.solution,
        ))
    }
}

/// Tries the candidates without the pixels that are held out; also what the best of them has found.
/// Where the observer stops it, the best so far.
pub(super) fn choose_prior(
    data: &mut FrameData,
    rule: TauRule,
    sigma: f64,
    max_iterations: Option<usize>,
    observer: &mut Observer,
) -> Result<(Choice, Option<BestTrial>), Box<RunResult>> {
    let held_out = data.held_out();
    let mut choice = Choice {
        candidates: Vec::new(),
        held_out: held_out.pixels().len(),
    };
    let mut best: Vec<f64> = Vec::new();
    let mut best_trial: Option<BestTrial> = None;
    let mut run = |choice: &mut Choice, name: &str| -> Result<(), Box<RunResult>> {
        let prior: Prior = name.parse().expect("a candidate is a prior");
        data.start(prior.background(), Some(held_out.clone()));
        let trial = Trial::new(data, prior, rule, sigma, max_iterations);
        let max_error = choice
            .candidates
            .iter()
            .map(|c| MAX_TUNING_ERROR_RATIO * c.error);
        let max_error = max_error.fold(f64::INFINITY, f64::min);
        let (candidate, errors, found) = match trial.run(data, &best, max_error, observer) {
            Ok(ended) => ended,
            Err(stopped) => {
                let Some(best_trial) = best_trial.take() else {
                    return Err(stopped);
                };
                data.start(best_trial.prior.background(), Some(held_out.clone()));
                return Err(best_trial.stopped(data, stopped.solution.stop_reason));
            }
        };
        choice.candidates.push(candidate);
        if choice.best() == candidate {
            best = errors;
            best_trial = Some(BestTrial {
                prior,
                solution: found.solution,
            });
        }
        Ok(())
    };
    for name in CANDIDATES {
        run(&mut choice, name)?;
    }
    if choice.best().support > DENSE_SUPPORT {
        for name in DENSE_CANDIDATES {
            run(&mut choice, name)?;
        }
    }
    Ok((choice, best_trial))
}

fn rms(values: &[f64]) -> f64 {
    let squares: f64 = values.iter().map(|v| v * v).sum();
    (squares / values.len().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chance_does_not_choose_another_prior() {
        let candidate = |prior: &str, error: f64| Candidate {
            prior: prior.parse().unwrap(),
            tau_factor: 1.0,
            error,
            support: 0.03,
            given_up: false,
        };
        let mut choice = Choice {
            candidates: vec![
                candidate("tv+support", 1.120),
                candidate("group+support", 1.117),
            ],
            held_out: 583,
        };
        assert_eq!(choice.best(), choice.candidates[0]);
        assert!(
            choice.reason().contains("taken for chance"),
            "{}",
            choice.reason()
        );
        choice.candidates.push(candidate("l1+support", 1.06));
        assert_eq!(choice.best(), choice.candidates[2]);
        assert!(!choice.reason().contains("chance"), "{}", choice.reason());
        // A run that overflowed is never the best.
        choice.candidates.push(candidate("tv+support", f64::NAN));
        assert_eq!(choice.best(), choice.candidates[2]);
    }
}
