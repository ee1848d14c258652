//! The automatic choices: `τ` and the prior that predict held-out pixels best.
//!
//! **Prior.** Each of [`CANDIDATES`] is run without the pixels held out (see `HeldOut`), and
//! the one with the smallest error there is then run on the whole frame. Candidates that are far
//! behind are given up early. On LEDs, digits and a moving digit, at signal-to-noise ratios of 8 and
//! 256 (seven scenes, four priors, the mean of three draws of pixels), the prior with the smallest
//! error was the best against the truth, or within 0.4 dB of it.
//!
//! **τ** where no `σ` is known: the noise level that the discrepancy principle is to aim at
//! falls by `√2` from step to step, each going on from the one before, until the held-out
//! error rises: then what is followed is noise. The highest level within a standard error of the
//! lowest error is taken (Breiman et al. 1984). Without the support, so that the path is that of a
//! convex problem. Then that level and its neighbours are tried with the whole prior.

use super::data::FrameData;
use super::{Found, Prior, show};
use crate::prox::Prox;
use crate::solve::admm::{Admm, AdmmParams, Progress, TauRule};
use crate::solve::{DataTerm, StopReason};
use crate::vecmath::norm;
use std::ops::ControlFlow;

/// The priors that `auto` chooses among, the standard one first.
///
/// Not among them, since none was best by more than 0.6 dB on any of the scenes above: `tv3d`,
/// `wavelet` (ten times the time) and `l1`, each with the support.
pub const CANDIDATES: [&str; 3] = [
    "tv+0.5*tdiff+support",
    "tv+2*tdiff+support",
    "group+support",
];

/// What is tried as well where a scene is not sparse: light on more than a third of the voxels is
/// often that of a background. 12 px digits and a moving one before a background three times as
/// bright: 33.5 and 32.0 dB, without it 16.6 and 15.0 dB.
pub const DENSE_CANDIDATES: [&str; 1] = ["tv+0.5*tdiff+0.3*l1+background+support"];
const DENSE: f64 = 1.0 / 3.0;

/// Factors on the noise level that are tried with the best prior, as long as they help, where the
/// signal-to-noise ratio of the frame is below this. At 256 none helped in any scene; at 8 digits gain
/// 1.9 dB from 1.15, since what counts as chosen freely by the fit is then mostly noise.
const SLACKS: [f64; 2] = [1.1, 1.2];
const NOISY: f64 = 64.0;

/// Held-out error over that of the best so far after as many iterations at which a candidate
/// is given up, early and late; LEDs stand at 3 after 100 iterations of a prior that ends best.
const HOPELESS: f64 = 6.0;
const BEHIND: f64 = 1.5;
const EARLY: usize = 100;
const LATE: usize = 200;
const LOOK_EVERY: usize = 20;

/// Part by which a prior's error must be smaller than that of one before it: less is chance with 600
/// pixels. Of a moving digit (seed 2) `group+support` predicted them better by 0.3 %, and was 3 dB
/// worse; where it is better (LEDs) it is so by 4 to 7 %.
const MARGIN: f64 = 0.005;

/// How close to its minimum a candidate is run.
const TOLERANCE: f64 = 0.01;

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
    /// Noise level that the discrepancy principle aimed at, over `σ`.
    pub slack: f64,
    /// Rms of `W(b − A v)/σ` over the pixels held out.
    pub error: f64,
    /// Part of the voxels that it lets be lit.
    pub support: f64,
    /// Whether it was given up before its end.
    pub given_up: bool,
}

impl Candidate {
    /// The prior, and the factor on the noise level where it is not 1.
    pub fn name(&self) -> String {
        if self.slack == 1.0 {
            self.prior.to_string()
        } else {
            format!(
                "{} with the noise taken {} times as strong",
                self.prior, self.slack
            )
        }
    }
}

impl Choice {
    /// The candidate with the smallest error; a prior only where it is smaller by half a per cent
    /// than that of all before it.
    ///
    /// # Panics
    /// If there is none.
    pub fn best(&self) -> Candidate {
        let better = |best: Candidate, next: &Candidate| {
            let part = if next.prior == best.prior {
                1.0
            } else {
                1.0 - MARGIN
            };
            // An error that is no number never is the smaller one.
            if next.error < part * best.error || best.error.is_nan() {
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
                ""
            } else {
                "; differences below half a per cent are taken for chance, and the earlier prior is kept"
            }
        )
    }
}

type Observer<'o> = dyn FnMut(&Progress) -> ControlFlow<StopReason> + 'o;

/// Fewest pixels held out that a choice may rest on: their mean square scatters by a fifth.
const FEWEST_PIXELS: usize = 50;

/// Whether the frame has the pixels for a choice.
pub(super) fn can_choose(data: &FrameData) -> bool {
    data.held_out().pixels().len() >= FEWEST_PIXELS
}

/// Tries the candidates without the pixels that are held out; what there is so far where the
/// observer stops it.
pub(super) fn choose_prior(
    data: &mut FrameData,
    rule: TauRule,
    sigma: f64,
    most: Option<usize>,
    observer: &mut Observer,
) -> Result<Choice, Box<Found>> {
    let held_out = data.held_out();
    let noise = sigma * (data.informative() as f64).sqrt();
    let is_noisy = norm(data.measured()) < NOISY * noise;
    let mut choice = Choice {
        candidates: Vec::new(),
        held_out: held_out.pixels().len(),
    };
    let mut best: Vec<f64> = Vec::new();
    let mut run = |choice: &mut Choice, prior: Prior, slack: f64| -> Result<bool, Box<Found>> {
        data.start(prior.second_part(), Some(held_out.clone()));
        let params = AdmmParams {
            tolerance: TOLERANCE,
            ..prior.admm_params(data.shape(), slackened(rule, slack), most)
        };
        let (candidate, errors) = try_candidate(data, prior, &params, sigma, &best, observer)?;
        let candidate = Candidate { slack, ..candidate };
        choice.candidates.push(candidate);
        if choice.best() == candidate {
            best = errors;
        }
        Ok(choice.best() == candidate)
    };
    let named = |name: &str| name.parse().expect("a candidate is a prior");
    for name in CANDIDATES {
        run(&mut choice, named(name), 1.0)?;
    }
    if choice.best().support > DENSE {
        for name in DENSE_CANDIDATES {
            run(&mut choice, named(name), 1.0)?;
        }
    }
    if matches!(rule, TauRule::Discrepancy { .. }) && is_noisy {
        for slack in SLACKS {
            let prior = choice.best().prior;
            if !run(&mut choice, prior, slack)? {
                break;
            }
        }
    }
    Ok(choice)
}

/// The rule for noise that is `slack` times as strong.
pub(super) fn slackened(rule: TauRule, slack: f64) -> TauRule {
    match rule {
        TauRule::Fixed(_) => rule,
        TauRule::Discrepancy { sigma } => TauRule::Discrepancy {
            sigma: slack * sigma,
        },
    }
}

/// Runs a candidate; also returns the course of its errors. `best` is that of the best so far.
fn try_candidate(
    data: &mut FrameData,
    prior: Prior,
    params: &AdmmParams,
    sigma: f64,
    best: &[f64],
    observer: &mut Observer,
) -> Result<(Candidate, Vec<f64>), Box<Found>> {
    let shape = data.shape();
    let label = format!("trying {prior}");
    let mut prox = prior.prox(shape);
    let mut run = Admm::new(data, shape, *params);
    let mut errors = Vec::new();
    loop {
        // In pieces: an observer cannot ask the data for the held-out error.
        let until = (run.iterations() + LOOK_EVERY)
            .max(EARLY)
            .min(params.max_iterations);
        let reason = run.run(data, &mut *prox, until, &mut |progress| {
            let progress = Progress {
                label: &label,
                ..*progress
            };
            show(prior.second_part(), shape, &progress, observer)
        });
        if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
            return Err(so_far(run, data, prior, prox, reason));
        }
        let error = rms(&data.errors_held_out(run.video())) / sigma;
        let then = best.get(errors.len()).or(best.last());
        let limit = if run.iterations() < LATE {
            HOPELESS
        } else {
            BEHIND
        };
        let given_up = then.is_some_and(|then| error > limit * then);
        errors.push(error);
        let ended = reason == StopReason::Converged || until == params.max_iterations;
        if ended || given_up {
            let candidate = Candidate {
                prior,
                slack: 1.0,
                error,
                support: run.support(),
                given_up: given_up && !ended,
            };
            return Ok((candidate, errors));
        }
    }
}

/// What a run that was stopped has found.
fn so_far(
    run: Admm,
    data: &FrameData,
    prior: Prior,
    prox: Box<dyn Prox>,
    reason: StopReason,
) -> Box<Found> {
    let solution = run.solution(data, &*prox, reason);
    Box::new(Found {
        prior,
        prox,
        choice: None,
        solution,
    })
}

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
pub(super) fn noise_level(
    data: &mut FrameData,
    prior: Prior,
    most: Option<usize>,
    observer: &mut Observer,
) -> Result<f64, Box<Found>> {
    let shape = data.shape();
    let whole = prior;
    let prior = Prior {
        support: false,
        ..prior
    };
    let held_out = data.held_out();
    data.start(prior.second_part(), Some(held_out.clone()));
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
            show(prior.second_part(), shape, &progress, observer)
        });
        if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
            return Err(so_far(run, data, prior, prox, reason));
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
        run.aim_at(rule(sigma), data);
    }
    drop((run, prox));
    let level = highest.unwrap_or(sigma);
    let mut tried: Vec<(f64, f64)> = Vec::new();
    for sigma in [level / FALL, level, level * FALL] {
        data.start(whole.second_part(), Some(held_out.clone()));
        let params = AdmmParams {
            tolerance: TOLERANCE,
            ..whole.admm_params(shape, rule(sigma), most)
        };
        let (candidate, _) = try_candidate(data, whole, &params, 1.0, &[], observer)?;
        tried.push((sigma, candidate.error));
    }
    let best = tried.iter().min_by(|a, b| a.1.total_cmp(&b.1));
    Ok(best.map_or(level, |(sigma, _)| *sigma))
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
        let candidate = |prior: &str, slack: f64, error: f64| Candidate {
            prior: prior.parse().unwrap(),
            slack,
            error,
            support: 0.03,
            given_up: false,
        };
        let mut choice = Choice {
            candidates: vec![
                candidate("tv+support", 1.0, 1.120),
                candidate("group+support", 1.0, 1.117),
            ],
            held_out: 583,
        };
        assert_eq!(choice.best(), choice.candidates[0]);
        assert!(
            choice.reason().contains("taken for chance"),
            "{}",
            choice.reason()
        );
        // The same prior with another noise level is no other prior.
        choice.candidates.push(candidate("tv+support", 1.1, 1.119));
        assert_eq!(choice.best(), choice.candidates[2]);
        choice.candidates.push(candidate("l1+support", 1.0, 1.06));
        assert_eq!(choice.best(), choice.candidates[3]);
        assert!(!choice.reason().contains("chance"), "{}", choice.reason());
        // A run that overflowed is never the best.
        choice
            .candidates
            .push(candidate("tv+support", 1.0, f64::NAN));
        assert_eq!(choice.best(), choice.candidates[3]);
    }
}
