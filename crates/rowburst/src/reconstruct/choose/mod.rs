//! Automatic choice of the prior and of `τ` by held-out pixels.
//!
//! **Prior.** Each of [`CANDIDATES`] is run without the held-out pixels (see `HeldOut`). A later one replaces the best
//! before it where its squared error at these pixels is smaller by more than [`MIN_GAIN`] standard errors of the paired
//! differences; one with foreground and background replaces a foreground where it is smaller at all. Candidates that are
//! far behind the best, or settle above it, are stopped early. The best is then run on the whole frame. Where the first one shows that the scene
//! is dense, [`OPEN_CANDIDATES`] take the place of the others.
//!
//! **Factor on `τ`.** The discrepancy principle depends on the noise of the frame: noise a little stronger or
//! weaker than on average changes `τ` by a factor of 2 and more. So each candidate continues from the end of its
//! run with half or twice its `τ`, as long as that predicts the held-out pixels better; the factor goes with
//! the prior into the run on the whole frame (docs/design/011). Of a video that is one picture τ is doubled alone, up to
//! where the error does not fall, with a named prior, too.

mod level;
mod trial;

pub(super) use level::noise_level;
pub(super) use trial::{TOLERANCE, is_one_picture};

use super::SolverSettings;
use super::checkpoint::Checkpoint;
use super::frame_data::FrameData;
use super::held_out_check::DENSE_SUPPORT;
use super::held_out_run::{ErrorAt, HeldOutRun};
use super::{Observer, Prior, RunResult};
use rowburst_core::linop::Background;
use rowburst_core::vecmath::norm;
use rowburst_solve::StopReason;
use rowburst_solve::admm::{Solution, TauRule};
use tracing::info;
use trial::{Trial, TrialResult};

/// Priors of `auto`; an earlier one is kept where later ones are no better. More candidates cost a run each
/// (`docs/design/011`).
pub const CANDIDATES: [&str; 3] = [
    "tv+2*tdiff+support",
    "tv+0.5*tdiff+support",
    "group+support",
];

/// Priors of `auto` in place of the other [`CANDIDATES`] where the support of the first exceeds a third of the voxels: it
/// tells nothing there. A stiller one comes first: the frame says little of what a dense scene does meanwhile
/// (`docs/design/011`). The first one holds that the scene is at rest.
pub const OPEN_CANDIDATES: [&str; 4] = ["background", "tv+16*tdiff", "tv+8*tdiff", "tv+2*tdiff"];

/// Priors that `auto` tries after [`OPEN_CANDIDATES`]: much of the light may be still (`docs/design/011`).
pub const DENSE_CANDIDATES: [&str; 1] = ["tv+2*tdiff+background"];

/// Held-out error over the best up to which other `τ` are tried; larger costs time (docs/design/011).
const MAX_TUNING_ERROR_RATIO: f64 = 1.06;

/// Gain in standard errors that counts; smaller follows chance (docs/design/011).
const MIN_GAIN: f64 = 1.0;
/// The same of a prior with a background; smaller takes a scene that moves for a still one, larger the reverse
/// (docs/design/011).
const MIN_BACKGROUND_GAIN: f64 = 0.0;

/// Fall of the mean square from `before` to `after`, two errors of each pixel, in standard errors of the paired
/// differences; NaN where an error is.
pub(super) fn gain(before: &[f64], after: &[f64]) -> f64 {
    let differences: Vec<f64> = before
        .iter()
        .zip(after)
        .map(|(b, a)| b * b - a * a)
        .collect();
    let n = differences.len().max(2) as f64;
    let mean = differences.iter().sum::<f64>() / n;
    let squares: f64 = differences.iter().map(|d| (d - mean).powi(2)).sum();
    let standard_error = (squares / (n * (n - 1.0))).sqrt();
    if mean == 0.0 {
        0.0
    } else {
        mean / standard_error
    }
}

/// The one of [`OPEN_CANDIDATES`] that assumes least: what moves must not look foreign.
pub(super) fn open_prior() -> Prior {
    let [.., last] = OPEN_CANDIDATES;
    last.parse().expect("a candidate is a prior")
}

/// The candidates of `auto` with their held-out errors.
#[derive(Debug, Clone, PartialEq)]
pub struct Choice {
    /// The candidates in their order of preference.
    pub candidates: Vec<Candidate>,
    /// Number of held-out pixels.
    pub held_out: usize,
}

/// A candidate and how well it predicts held-out pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The prior.
    pub prior: Prior,
    /// Factor on the `τ` of the discrepancy principle.
    pub tau_factor: f64,
    /// Root mean square of `W(b − A v)/σ` over the held-out pixels.
    pub error: f64,
    /// Fraction of the voxels that are in its support.
    pub support_fraction: f64,
    /// Whether it was stopped early because it was far behind the best or had settled above it.
    pub stopped_early: bool,
    /// How far its squared error lies below that of the best candidate before it, in standard errors of the paired
    /// differences; `None` for the first.
    pub gain: Option<f64>,
}

impl Candidate {
    /// The gain from which it replaces the best one before it, `best`. A background before other light assumes least of a
    /// dense scene: that most of it is still. A scene at rest is simpler than that.
    fn min_gain(&self, best: &Self) -> f64 {
        match (self.prior.background(), best.prior.background()) {
            (Background::None | Background::Alone, _) | (_, Background::Alone) => MIN_GAIN,
            (Background::Static | Background::PerBin, _) => MIN_BACKGROUND_GAIN,
        }
    }

    /// The name of the prior, with the factor on `τ` where it is not 1.
    pub fn name(&self) -> String {
        if self.tau_factor == 1.0 {
            self.prior.to_string()
        } else {
            format!("{} with τ multiplied by {}", self.prior, self.tau_factor)
        }
    }
}

impl Choice {
    /// The best candidate. A candidate replaces the best one before it where its error is smaller by more than chance, one
    /// with a background where its error is not larger by more than chance.
    ///
    /// # Panics
    /// If there are no candidates.
    pub fn best(&self) -> Candidate {
        let better = |best: Candidate, next: &Candidate| {
            // A candidate whose error is NaN is never the best.
            let is_better = |gain| gain > next.min_gain(&best);
            if next.gain.is_none_or(is_better) || best.error.is_nan() {
                *next
            } else {
                best
            }
        };
        let (first, rest) = self.candidates.split_first().expect("there are candidates");
        rest.iter().fold(*first, better)
    }

    /// The best candidate for other frames of the recording, which may move: not a scene at rest.
    ///
    /// # Panics
    /// If there are no candidates.
    pub fn best_for_others(&self) -> Candidate {
        let is_at_rest = |c: &Candidate| c.prior.background() == Background::Alone;
        let others = self.candidates.iter().filter(|c| !is_at_rest(c));
        let nearest = others.min_by(|a, b| a.error.total_cmp(&b.error));
        match nearest {
            Some(nearest) if is_at_rest(&self.best()) => *nearest,
            _ => self.best(),
        }
    }

    /// The reason for the choice, as a sentence without a full stop.
    pub fn reason(&self) -> String {
        let best = self.best();
        let others = self.candidates.iter().filter(|c| **c != best).map(|c| {
            let stopped_early = if c.stopped_early {
                ", stopped early"
            } else {
                ""
            };
            format!("{} {:.3} σ{stopped_early}", c.name(), c.error)
        });
        let smallest = self.candidates.iter().all(|c| c.error >= best.error);
        format!(
            "{} {} on {} held-out pixels: {:.3} σ; {}{}",
            best.name(),
            if smallest {
                "has the smallest error"
            } else {
                "is not clearly worse than others"
            },
            self.held_out,
            best.error,
            others.collect::<Vec<_>>().join("; "),
            if smallest {
                String::new()
            } else {
                format!(
                    "; differences of at most {MIN_GAIN} standard error are not significant, so the prior that assumes less is kept"
                )
            }
        )
    }
}

/// Fewest held-out pixels that a choice may rest on; fewer decide by chance (docs/design/011).
const MIN_HELD_OUT_PIXELS: usize = 50;

/// Whether the frame has enough pixels to hold out for a choice.
pub(super) fn can_choose(data: &FrameData) -> bool {
    data.held_out().pixels().len() >= MIN_HELD_OUT_PIXELS
}

/// The result of the best trial, which did not see the held-out pixels.
pub(super) struct BestTrial {
    prior: Prior,
    solution: Solution,
    checkpoint: Option<Checkpoint>,
}

impl BestTrial {
    /// Norm of `W(b − A v)`, 0 at held-out pixels.
    pub fn misfit(&self) -> f64 {
        norm(&self.solution.residual)
    }

    /// The trial's checkpoint, the first time, if one was kept.
    pub fn take_checkpoint(&mut self) -> Option<Checkpoint> {
        self.checkpoint.take()
    }

    /// The trial as the result of a run that was stopped for `reason`.
    pub fn stopped(mut self, reason: StopReason) -> Box<RunResult> {
        self.solution.stop_reason = reason;
        Box::new(RunResult::new(self.prior, self.solution))
    }
}

/// The candidates that were tried so far, in their order of preference.
struct Trials {
    choice: Choice,
    /// The rank of each candidate in the order of preference.
    ranks: Vec<usize>,
    /// The held-out residuals of each candidate.
    residuals: Vec<Vec<f64>>,
    /// The held-out errors of the best candidate at each check and comparison.
    best_errors: Vec<ErrorAt>,
    best: Option<BestTrial>,
}

impl Trials {
    /// Tries the candidate whose rank in the order of preference is `rank`, after `count` trials in all.
    fn run(
        &mut self,
        (rank, trial): (usize, Trial),
        count: usize,
        data: &mut FrameData,
        observer: &mut Observer,
    ) -> Result<(), Box<RunResult>> {
        let number = self.ranks.len() + 1;
        let trial = trial.numbered(number, count.max(number));
        let found = trial.run(data, &self.best_errors, self.max_tuning_error(), observer);
        let found = match (found, self.best.take()) {
            (Err(stopped), Some(best)) => {
                data.reset(best.prior.background(), Some(data.held_out()));
                return Err(best.stopped(stopped.solution.stop_reason));
            }
            (found, best) => {
                self.best = best;
                found?
            }
        };
        let candidate = found.candidate;
        info!(
            "tried prior {}: held-out error {:.4} σ, factor {} on τ{}",
            candidate.prior,
            candidate.error,
            candidate.tau_factor,
            if candidate.stopped_early {
                ", stopped early"
            } else {
                ""
            }
        );
        self.insert(rank, found, data);
        Ok(())
    }

    fn insert(&mut self, rank: usize, found: TrialResult, data: &FrameData) {
        let at = self.ranks.partition_point(|before| *before < rank);
        let candidates = &mut self.choice.candidates;
        self.ranks.insert(at, rank);
        candidates.insert(at, found.candidate);
        self.residuals.insert(at, found.residuals);
        // Each is compared with the best before it, as in [`Choice::best`].
        let mut best = 0;
        for next in 1..candidates.len() {
            let gained = gain(&self.residuals[best], &self.residuals[next]);
            candidates[next].gain = Some(gained);
            let min_gain = candidates[next].min_gain(&candidates[best]);
            if gained > min_gain || candidates[best].error.is_nan() {
                best = next;
            }
        }
        candidates[0].gain = None;
        if best == at {
            let prior = found.candidate.prior;
            let solution = found.run.into_result(data).solution;
            self.best_errors = found.errors;
            self.best = Some(BestTrial {
                prior,
                solution,
                checkpoint: found.checkpoint,
            });
        }
    }

    /// Whether the support of the best candidate tells nothing.
    fn is_dense(&self) -> bool {
        self.choice.best().support_fraction > DENSE_SUPPORT
    }

    /// The largest error at which other `τ` are tried.
    fn max_tuning_error(&self) -> f64 {
        let errors = self.choice.candidates.iter().map(|c| c.error);
        MAX_TUNING_ERROR_RATIO * errors.fold(f64::INFINITY, f64::min)
    }
}

/// The factor on the `τ` of the discrepancy principle that predicts held-out pixels best with `prior`, by a trial without
/// these pixels. The error is the result so far where the observer stopped it.
pub(super) fn tau_factor(
    data: &mut FrameData,
    prior: Prior,
    rule: TauRule,
    sigma: f64,
    settings: SolverSettings,
    observer: &mut Observer,
) -> Result<f64, Box<RunResult>> {
    let run = HeldOutRun::new(data, prior, rule, settings);
    let trial = Trial::new(run, sigma).numbered(1, 1);
    let found = trial.run(data, &[], f64::INFINITY, observer)?;
    Ok(found.candidate.tau_factor)
}

/// What is known of a frame before priors are compared.
pub(super) struct Conditions {
    /// Whether the scene is dense.
    pub is_dense: bool,
    /// Whether the PSF was refined by the frame.
    pub has_refined_psf: bool,
    /// A run of one of the candidates on the pixels that are not held out, by the same rule.
    pub checked: Option<HeldOutRun>,
}

/// Tries the candidates without the held-out pixels, in a dense scene those for such scenes. A candidate that was checked
/// comes first, and its run goes on. Returns the choice and the best trial. The error is the result so far where the observer
/// stopped it: the best trial, or the first one.
pub(super) fn choose_prior(
    data: &mut FrameData,
    rule: TauRule,
    sigma: f64,
    settings: SolverSettings,
    conditions: Conditions,
    observer: &mut Observer,
) -> Result<(Choice, Option<BestTrial>), Box<RunResult>> {
    let Conditions {
        is_dense,
        has_refined_psf,
        checked,
    } = conditions;
    let held_out = data.held_out();
    let mut trials = Trials {
        choice: Choice {
            candidates: Vec::new(),
            held_out: held_out.pixels().len(),
        },
        ranks: Vec::new(),
        residuals: Vec::new(),
        best_errors: Vec::new(),
        best: None,
    };
    let parse = |name: &&str| name.parse::<Prior>().expect("a candidate is a prior");
    let parse_all = |names: &[&str]| -> Vec<Prior> { names.iter().map(parse).collect() };
    let mut priors = parse_all(if is_dense {
        &OPEN_CANDIDATES
    } else {
        &CANDIDATES
    });
    // Where rows share bins a final run has other constants than a trial.
    let keeps_checkpoint = checked.is_some() && !data.is_coupled();
    let trial_of = |run| Trial::new(run, sigma).after_refinement(has_refined_psf);
    let new_trial = |data: &mut FrameData, prior: Prior| {
        let run = HeldOutRun::new(data, prior, rule, settings);
        // The x-step of a static background starts from its last solution, which a copy lacks.
        let is_alone = prior.background() == Background::None;
        trial_of(run).keeping_checkpoint(keeps_checkpoint && is_alone)
    };
    let position = |run: &HeldOutRun| priors.iter().position(|prior| *prior == run.prior);
    let first = match checked.and_then(|run| Some((position(&run)?, run))) {
        Some((rank, run)) => {
            let trial = trial_of(run).keeping_checkpoint(keeps_checkpoint);
            (rank, trial)
        }
        None => {
            // A candidate ends early only after another. In dense scenes the last one, which assumes least, sets the pace.
            let rank = if is_dense { priors.len() - 1 } else { 0 };
            (rank, new_trial(data, priors[rank]))
        }
    };
    let tried = priors[first.0];
    trials.run(first, priors.len(), data, observer)?;
    if !is_dense && trials.is_dense() {
        priors = parse_all(&OPEN_CANDIDATES);
        priors.push(tried);
        trials.ranks[0] = priors.len() - 1;
    }
    for (rank, &prior) in priors.iter().enumerate() {
        if !trials.ranks.contains(&rank) {
            let trial = new_trial(data, prior);
            trials.run((rank, trial), priors.len(), data, observer)?;
        }
    }
    if trials.is_dense() {
        let count = priors.len() + DENSE_CANDIDATES.len();
        for prior in parse_all(&DENSE_CANDIDATES) {
            let trial = new_trial(data, prior);
            trials.run((trials.ranks.len(), trial), count, data, observer)?;
        }
    }
    Ok((trials.choice, trials.best))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chance_does_not_choose_another_prior() {
        let candidate = |prior: &str, error: f64, gain: Option<f64>| Candidate {
            prior: prior.parse().unwrap(),
            tau_factor: 1.0,
            error,
            support_fraction: 0.03,
            stopped_early: false,
            gain,
        };
        let mut choice = Choice {
            candidates: vec![
                candidate("tv+support", 1.120, None),
                candidate("group+support", 1.117, Some(0.8)),
            ],
            held_out: 583,
        };
        assert_eq!(choice.best(), choice.candidates[0]);
        assert!(
            choice.reason().contains("not significant"),
            "{}",
            choice.reason()
        );
        choice
            .candidates
            .push(candidate("l1+support", 1.06, Some(4.0)));
        assert_eq!(choice.best(), choice.candidates[2]);
        assert!(
            !choice.reason().contains("not significant"),
            "{}",
            choice.reason()
        );
        // A background is taken where it is better at all.
        for (gain, is_taken) in [(0.4, true), (-0.4, false)] {
            let mut dense = choice.clone();
            let background = candidate("tv+2*tdiff+background", 1.07, Some(gain));
            dense.candidates.push(background);
            assert_eq!(dense.best() == background, is_taken);
        }
        // One picture for a scene at rest is none for other frames.
        let mut at_rest = choice.clone();
        at_rest.candidates[0] = candidate("background", 1.05, None);
        at_rest.candidates[2].gain = Some(0.1);
        assert_eq!(at_rest.best(), at_rest.candidates[0]);
        assert_eq!(at_rest.best_for_others(), at_rest.candidates[2]);
        assert_eq!(choice.best_for_others(), choice.best());
        // A run that overflowed is never the best.
        choice
            .candidates
            .push(candidate("tv+support", f64::NAN, Some(f64::NAN)));
        assert_eq!(choice.best(), choice.candidates[2]);
    }

    /// Errors that differ in the same sense at every pixel are told apart where their mean squares are not.
    #[test]
    fn gains_are_those_of_pairs() {
        let before: Vec<f64> = (0..200).map(|i| (f64::from(i) * 1.3).sin() * 2.0).collect();
        let after: Vec<f64> = before.iter().map(|b| 0.99 * b).collect();
        assert!(gain(&before, &after) > MIN_GAIN);
        assert!(gain(&after, &before) < -MIN_GAIN);
        assert_eq!(gain(&before, &before), 0.0);
        // The same errors in another order.
        let other: Vec<f64> = (0..200).map(|i| before[(i + 71) % 200]).collect();
        assert!(gain(&before, &other).abs() < MIN_GAIN);
    }
}
