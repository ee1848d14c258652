//! Leaves foreign pixels out in rounds, until the model explains the others.
//!
//! Each round reconstructs without the foreign pixels found so far and without held-out ones, and judges all pixels by
//! the video. The noise level falls from round to round, since a fit to the noise of the sensor would absorb faint
//! foreign pixels that are not found yet. Pixels are added in each round; they come back near the noise of the sensor and
//! at the end (docs/design/020).

use super::Observer;
use super::foreign::{Foreign, Pixels, Residual, Scales};
use super::held_out_check::{
    CHECK_ITERATIONS, CHECK_STEP, DENSE_SUPPORT, FIRST_CHECK_ITERATION, HeldOutCheck, MAX_RESIDUAL,
};
use super::held_out_run::HeldOutRun;
use super::sigma::Bands;
use super::{Prior, Problem, RunResult, SigmaSource, noise_of};
use rowburst_solve::DataTerm;
use tracing::debug;

/// Noise level of a round over that of the one before; smaller absorbs foreign pixels that are not found yet.
const LEVEL_RATIO: f64 = 0.5;
/// Noise level over `σ` below which it is the last one: the estimate of `σ` differs a little from round to round.
const LAST_LEVEL_RATIO: f64 = 1.1;
/// Most rounds at a noise level that the video does not reach, and at that of the sensor; more find few further pixels.
const MAX_ROUNDS: usize = 4;
/// Noise level over `σ` from which pixels come back between rounds; larger takes faint foreign pixels back.
const READMISSION_LEVEL: f64 = 4.0;
/// Factor on the limit of a residual below which a pixel comes back between rounds; larger takes faint foreign pixels back.
const EARLY_READMISSION: f64 = 0.4;
/// Fall of the held-out error in another round at the same level, in parts of it, below which the next one is not worth its
/// time; larger misses faint foreign pixels.
const MIN_FALL: f64 = 0.03;
/// Factors on that limit at the end: where many pixels are excluded, the video predicts them poorly.
const READMISSIONS: [f64; 3] = [4.0, 1.0, 1.0];
/// Part of the pixels that come back below which another check is not worth its time.
const FEW_PIXELS: f64 = 1e-4;
/// Held-out error over that before above which a readmission is undone.
const READMISSION_ERROR_RATIO: f64 = 1.02;

/// What the rounds do besides judging single pixels.
#[derive(Clone, Copy)]
pub(super) struct Rounds<'a> {
    /// Whether each pixel is in a broken line: these stay out.
    pub broken: &'a [bool],
    /// Whether a row whose instant does not settle is left out as a whole.
    pub leaves_rows_out: bool,
    /// Factors on the limit of a residual below which a pixel comes back at the end, one after the other.
    pub readmissions: &'a [f64],
}

impl Problem {
    /// Leaves the pixels `found` out, and others that prove to be foreign; takes those back that the video predicts, if
    /// it predicts held-out ones better than with all pixels (`with_all`).
    pub(super) fn check_without(
        &mut self,
        found: Foreign,
        with_all: f64,
        broken: &[bool],
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let rounds = Rounds {
            broken,
            leaves_rows_out: true,
            readmissions: &READMISSIONS,
        };
        let mut level = found.level;
        let mut check =
            self.exclude_from_level(&mut level, found.pixels, rounds, prior, observer)?;
        if self.is_explained(&check) || check.held_out_rms < with_all {
            check = self.readmit(check, &mut level, rounds, prior, observer)?;
            check = self.retry_covered_rows(check, broken, prior, observer)?;
        }
        if !self.is_explained(&check) {
            // The effective noise level is that of a plain fit to the noise of the sensor.
            self.effective_sigma = self.sigma;
            check = self.held_out_check(prior, observer)?;
        }
        Ok(check)
    }

    /// Takes those pixels back that the video of `check` predicts, unless the model then explains the frame less well.
    pub(super) fn readmit(
        &mut self,
        mut check: HeldOutCheck,
        level: &mut f64,
        rounds: Rounds,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let few = negligible_count(&self.excluded);
        let mut undone = None;
        // Pixels with which the last rounds at the noise of the sensor began: they would be the same again.
        let mut last_start = None;
        for &factor in rounds.readmissions {
            let before = self.excluded.clone();
            let excluded = self.without_predicted(&check, factor, rounds.broken);
            let is_last_level = *level < LAST_LEVEL_RATIO * self.sigma;
            let start = is_last_level.then(|| excluded.clone());
            let is_same = undone == Some(factor) || (is_last_level && start == last_start);
            if is_same || count(&before).saturating_sub(count(&excluded)) <= few {
                continue;
            }
            last_start = start;
            let was_explained = self.is_explained(&check);
            let next = self.exclude_from_level(level, excluded, rounds, prior, observer)?;
            let is_better = next.held_out_rms <= READMISSION_ERROR_RATIO * check.held_out_rms;
            if self.is_explained(&next) || (!was_explained && is_better) {
                check = next;
            } else {
                self.exclude(before);
                undone = Some(factor);
            }
        }
        Ok(check)
    }

    /// Checks the model without the pixels `excluded`, at the noise level `level` and then at smaller ones down to that
    /// of the sensor, as long as the video reaches them. Leaves further pixels out that prove to be foreign. A fit to
    /// the noise of the sensor at once would absorb them. Where only some instants keep the video from a level, the check is
    /// repeated without their most doubtful rows, see [`Residual::unsettled_rows`].
    pub(super) fn exclude_from_level(
        &mut self,
        level: &mut f64,
        mut excluded: Vec<bool>,
        rounds: Rounds,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        // At the same level, one after the other.
        let mut repeats = 0;
        let mut last_error = f64::INFINITY;
        loop {
            self.exclude(excluded);
            if *level < LAST_LEVEL_RATIO * self.sigma {
                *level = self.sigma;
            }
            let check = self.robust_check(*level, prior, observer)?;
            let is_last_level = *level <= self.sigma;
            if is_last_level && self.is_explained(&check) {
                return Ok(check);
            }
            let (new, mut unsettled_rows) = self.judge_pixels(&check, 1.0);
            if !rounds.leaves_rows_out {
                unsettled_rows.fill(false);
            }
            let added = new.iter().zip(&self.excluded).filter(|(n, e)| **n && !**e);
            // In a dense scene each round finds a few others.
            let is_complete = added.count()
                <= if self.is_dense {
                    negligible_count(&new)
                } else {
                    0
                };
            debug!(
                "without {} pixels at a noise level of {:.2} σ: residual {:.3} σ, held-out error {:.3} σ, {} stand out",
                count(&self.excluded),
                *level / self.sigma,
                check.residual_rms / self.sigma,
                check.held_out_rms / self.sigma,
                count(&new)
            );
            excluded = self.excluded.clone();
            if !is_last_level && check.residual_rms <= MAX_RESIDUAL * *level {
                (repeats, last_error) = (0, f64::INFINITY);
                *level = (LEVEL_RATIO * *level).max(self.sigma);
                if *level < READMISSION_LEVEL * self.sigma {
                    excluded = self.without_predicted(&check, EARLY_READMISSION, rounds.broken);
                }
            } else {
                repeats += 1;
                let falls = check.held_out_rms < (1.0 - MIN_FALL) * last_error;
                // A wrong PSF keeps the video from the level at all instants alike.
                let can_settle = is_last_level || unsettled_rows.contains(&true);
                if is_complete || !falls || !can_settle || repeats >= MAX_ROUNDS {
                    return Ok(check);
                }
                last_error = check.held_out_rms;
                add(&mut excluded, &unsettled_rows);
            }
            let found = new.iter().zip(&self.excluded).map(|(n, e)| *n && !e);
            add(&mut excluded, &found.collect::<Vec<_>>());
        }
    }

    /// The excluded pixels without those whose residual is below `factor` times the limit of foreign pixels.
    fn without_predicted(&self, check: &HeldOutCheck, factor: f64, broken: &[bool]) -> Vec<bool> {
        let foreign = self.foreign(check, factor);
        let pixels = foreign.iter().zip(&self.excluded).zip(broken);
        pixels
            .map(|((foreign, excluded), broken)| *broken || *excluded && *foreign)
            .collect()
    }

    /// The foreign pixels by the video of `check`; the limit of excluded ones is multiplied by `factor`.
    pub(super) fn foreign(&self, check: &HeldOutCheck, factor: f64) -> Vec<bool> {
        self.judge_pixels(check, factor).0
    }

    /// The same, and those of [`Residual::unsettled_rows`].
    pub(super) fn judge_pixels(&self, check: &HeldOutCheck, factor: f64) -> (Vec<bool>, Vec<bool>) {
        let weights = self.measurement.weights();
        let weight = |i: usize| weights.map_or(1.0, |w| w[i]);
        let weigh = |values: &[f32]| -> Vec<f32> {
            values
                .iter()
                .enumerate()
                .map(|(i, v)| weight(i) * v)
                .collect()
        };
        let is_usable: Vec<bool> = (0..self.excluded.len()).map(|i| weight(i) > 0.0).collect();
        let measured = weigh(self.measurement.image().data());
        let instants = self.camera.instants();
        let pixels = Pixels {
            measured: &measured,
            is_usable: &is_usable,
            instants,
        };
        let scales = Scales::Settled {
            excluded_scale: check.held_out_scale,
            factor,
        };
        let residual = Residual::new(pixels, &weigh(&check.light), &self.excluded, scales);
        let unsettled_rows = residual.unsettled_rows(instants, &self.excluded);
        (residual.is_foreign, unsettled_rows)
    }

    /// As [`Problem::held_out_check`], at the noise level `level` and with the influence of large residuals bounded: foreign
    /// pixels that are not found yet disturb their whole instant otherwise. Ends once the video reaches the level.
    pub(super) fn robust_check(
        &mut self,
        level: f64,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        self.effective_sigma = level;
        let (rule, settings) = (
            self.tau_rule(),
            self.options.solver_settings().of_a_search(),
        );
        let mut run = HeldOutRun::new(&mut self.data, prior, rule, settings);
        let (measured, is_usable) = (self.data.measurements().to_vec(), self.data.usable());
        let none = vec![false; measured.len()];
        let mut until = FIRST_CHECK_ITERATION;
        let mut errors = Vec::new();
        loop {
            let has_converged = run.run(&mut self.data, until, observer)?;
            let check = HeldOutCheck::of(&run, &self.data);
            errors.push(check.held_out_rms);
            let has_converged = has_converged || self.is_stationary(&check, &errors);
            let is_reached = until > FIRST_CHECK_ITERATION
                && level > self.sigma
                && check.residual_rms <= MAX_RESIDUAL * level;
            let is_explained = || level <= self.sigma && self.is_explained(&check);
            if has_converged || until >= CHECK_ITERATIONS || is_reached || is_explained() {
                self.is_dense |= prior.support && check.support_fraction > DENSE_SUPPORT;
                return Ok(check);
            }
            let pixels = Pixels {
                measured: &measured,
                is_usable: &is_usable,
                instants: self.camera.instants(),
            };
            let fitted = run.admm.fitted();
            let scales = Scales::Fitting { level };
            let robust = Residual::new(pixels, fitted, &none, scales);
            self.data.set_measurements(robust.bounded());
            run.admm.replace_measurements();
            until += CHECK_STEP;
        }
    }

    /// Leaves the pixels `excluded` out. They may have disturbed the estimate of the noise level.
    pub(super) fn exclude(&mut self, excluded: Vec<bool>) {
        let kept = self.measurement.without(&excluded);
        self.excluded = excluded;
        self.data.set_frame(&kept);
        self.bands = Bands::new(&kept, self.data.psfs().central());
        let (sigma, source) = noise_of(&kept, &self.bands, &self.options);
        if source != SigmaSource::HeldOut {
            (self.sigma, self.sigma_source) = (sigma, source);
            self.effective_sigma = sigma;
        }
    }
}

/// Adds the pixels of `others` to `mask`.
fn add(mask: &mut [bool], others: &[bool]) {
    mask.iter_mut().zip(others).for_each(|(m, o)| *m |= o);
}

/// Number of pixels that are not worth another check.
pub(super) fn negligible_count(mask: &[bool]) -> usize {
    (FEW_PIXELS * mask.len() as f64) as usize
}

/// Number of pixels in `mask`.
pub(super) fn count(mask: &[bool]) -> usize {
    mask.iter().filter(|m| **m).count()
}
