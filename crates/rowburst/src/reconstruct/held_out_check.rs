//! How well a video predicts pixels that it has not seen.
//!
//! Where camera, PSF and noise level are right, its error there is little above the noise. It is far above the noise
//! where the model is wrong: an effective noise level of 0.85 times the error then serves the reconstruction best, and
//! foreign pixels are looked for (docs/design/020).

use super::choose::{self, Observer, rms};
use super::foreign::{self, BrokenLines, Residual, RowScales};
use super::frame_data::FrameData;
use super::sigma::Bands;
use super::{Prior, Problem, RunResult, SigmaSource, noise_of, observe_sum};
use crate::measurement::Measurement;
use crate::solve::StopReason;
use crate::solve::admm::{Admm, TauRule};

/// Iterations of a check; fewer compare a video that has not settled.
const CHECK_ITERATIONS: usize = 100;
/// Residual over `σ` above which the model does not explain the frame.
const MAX_RESIDUAL: f64 = 1.06;
/// Held-out error over `σ` above which the model does not explain the frame; smaller doubts good models.
const MAX_HELD_OUT_ERROR: f64 = 1.35;
/// Standard deviations by which the limit of the held-out error is widened; smaller doubts small frames.
const DEVIATIONS: f64 = 2.0;
/// Effective noise level over the held-out error; larger smooths more, smaller follows the error of the model.
const EFFECTIVE_SIGMA: f64 = 0.85;
/// Part of the pixels with a residual far above the others that noise explains.
const MAX_OUTLIERS: f64 = 2e-4;

/// How often foreign pixels are judged again by the video without them; more find few further ones.
const REJUDGEMENTS: usize = 4;
/// Factor on the held-out error up to which the first judgement takes excluded pixels back: where many are excluded, the
/// video predicts them poorly. A foreign one is found again.
const FIRST_READMISSION: f64 = 4.0;
/// Part of the pixels that a new judgement changes below which it no longer counts; smaller costs time.
const FEW_PIXELS: f64 = 1e-3;
/// Held-out error over that with all pixels above which foreign pixels are not believed to be foreign.
const MAX_ERROR_RATIO: f64 = 0.98;

/// Held-out error over the best of the judgements above which that one counts instead of the last one.
const BEST_ERROR_RATIO: f64 = 1.1;

/// A run on the pixels that are not held out, with its error at the held-out ones.
pub(super) struct HeldOutCheck {
    /// `A v` of its video, at all pixels.
    light: Vec<f32>,
    residual_rms: f64,
    held_out_rms: f64,
    held_out_count: usize,
    support_fraction: f64,
}

impl HeldOutCheck {
    /// Runs the solver. The error is the result so far of a run that the observer stopped.
    pub fn new(
        data: &mut FrameData,
        prior: Prior,
        rule: TauRule,
        max_iterations: Option<usize>,
        observer: &mut Observer,
    ) -> Result<Self, Box<RunResult>> {
        let shape = data.shape();
        let held_out = data.held_out();
        data.reset(prior.background(), Some(held_out));
        let mut prox = data.prox(&prior);
        let params = prior.admm_params(shape, rule, max_iterations);
        let mut run = Admm::new(data, shape, params);
        let mut residual_rms = 0.0;
        let reason = run.run(data, &mut *prox, CHECK_ITERATIONS, &mut |progress| {
            residual_rms = progress.residual_rms;
            observe_sum(prior.background(), shape, progress, observer)
        });
        if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
            let solution = run.into_solution(data, &*prox, reason);
            return Err(Box::new(RunResult::new(prior, &*prox, shape, solution)));
        }
        Ok(Self {
            light: data.predicted(run.video()),
            residual_rms,
            held_out_rms: rms(&data.held_out_residuals(run.video())),
            held_out_count: data.held_out_count(),
            support_fraction: run.support_fraction(),
        })
    }

    /// Whether the model explains the pixels of `measurement` that are not `excluded` to the noise `sigma`.
    pub fn is_explained(&self, sigma: f64, measurement: &Measurement, excluded: &[bool]) -> bool {
        let foreign = self.foreign(measurement, excluded, 1.0);
        let pairs = foreign.iter().zip(excluded);
        let count = pairs
            .filter(|(foreign, excluded)| **foreign && !**excluded)
            .count();
        self.residual_rms <= MAX_RESIDUAL * sigma
            && self.held_out_rms <= MAX_HELD_OUT_ERROR * (1.0 + self.allowed_deviation()) * sigma
            && count as f64 <= (MAX_OUTLIERS * excluded.len() as f64).max(1.0)
    }

    /// Part of the voxels that are active, from 0 to 1.
    pub fn support_fraction(&self) -> f64 {
        self.support_fraction
    }

    /// How far the held-out error of few pixels may lie above its mean by chance, in parts of it.
    fn allowed_deviation(&self) -> f64 {
        DEVIATIONS / (2.0 * self.held_out_count.max(1) as f64).sqrt()
    }

    /// The foreign pixels of `measurement` by this run's video, which was made without those `excluded`. Their scale is at
    /// least `readmission` times the held-out error.
    pub fn foreign(
        &self,
        measurement: &Measurement,
        excluded: &[bool],
        readmission: f64,
    ) -> Vec<bool> {
        let weight = |i: usize| measurement.weights().map_or(1.0, |w| w[i]);
        let weigh = |values: &[f32]| -> Vec<f32> {
            values
                .iter()
                .enumerate()
                .map(|(i, v)| weight(i) * v)
                .collect()
        };
        let is_usable: Vec<bool> = (0..excluded.len()).map(|i| weight(i) > 0.0).collect();
        let (measured, fitted) = (weigh(measurement.image().data()), weigh(&self.light));
        let columns = measurement.image().columns();
        let scales = RowScales::Settled {
            excluded_scale: readmission * self.held_out_rms,
        };
        Residual::new(&measured, &fitted, columns, &is_usable, excluded, scales).is_foreign
    }

    /// The noise level that serves the reconstruction best where the model does not explain the frame, at least
    /// `sigma`.
    pub fn effective_sigma(&self, sigma: f64) -> f64 {
        (EFFECTIVE_SIGMA * self.held_out_rms).max(sigma)
    }
}

impl Problem {
    /// Checks the model on held-out pixels. Where it does not explain the frame, leaves foreign pixels out and sets the
    /// effective noise level. The error is the result so far of a run that the observer stopped.
    pub(super) fn check_model(
        &mut self,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<(), Box<RunResult>> {
        if !self.is_checked() {
            return Ok(());
        }
        let mut check = self.held_out_check(prior, observer)?;
        if check.is_explained(self.sigma, &self.measurement, &self.excluded) {
            return Ok(());
        }
        if !self.options.keep_all_pixels {
            // Foreign pixels may have raised an estimate from the frame.
            let least_level = match self.sigma_source {
                SigmaSource::Given | SigmaSource::Calibration => self.sigma,
                SigmaSource::Frame | SigmaSource::HeldOut => 0.0,
            };
            let lines = BrokenLines::new(&self.measurement, self.camera.instants());
            let found = foreign::find(&mut self.data, &lines, least_level, observer)?;
            if found.contains(&true) {
                let without = self.check_without(found, &lines.is_broken, prior, observer)?;
                if without.held_out_rms < MAX_ERROR_RATIO * check.held_out_rms {
                    check = without;
                    if self.sigma_source == SigmaSource::HeldOut {
                        // Foreign pixels have disturbed the noise level.
                        self.resolve_tau_rule(observer)?;
                    }
                } else {
                    // The video predicts no better without them: it is the model that is wrong.
                    self.exclude(vec![false; self.excluded.len()]);
                }
            }
        }
        let is_explained = check.is_explained(self.sigma, &self.measurement, &self.excluded);
        let is_estimated =
            self.options.noise_sigma.is_none() && self.sigma_source != SigmaSource::HeldOut;
        if is_estimated && !is_explained {
            self.effective_sigma = check.effective_sigma(self.sigma);
        }
        Ok(())
    }

    /// Leaves the pixels `found` out and checks the model again, which judges all pixels anew, until they stay the same.
    fn check_without(
        &mut self,
        mut found: Vec<bool>,
        broken: &[bool],
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let mut rounds = 0;
        // The smallest held-out error, and the pixels that were left out for it.
        let mut best = (f64::INFINITY, Vec::new());
        loop {
            self.exclude(found);
            let check = self.held_out_check(prior, observer)?;
            let is_explained = check.is_explained(self.sigma, &self.measurement, &self.excluded);
            let readmission = if rounds == 0 && is_explained {
                FIRST_READMISSION
            } else {
                1.0
            };
            found = check.foreign(&self.measurement, &self.excluded, readmission);
            found.iter_mut().zip(broken).for_each(|(f, b)| *f |= b);
            let pairs = || found.iter().zip(&self.excluded);
            let new = pairs().filter(|(new, old)| **new && !**old).count() as f64;
            let returned = pairs().filter(|(new, old)| !**new && **old).count() as f64;
            let few = FEW_PIXELS * found.len() as f64;
            // A wrong model has pixels at the edge of being foreign; else every foreign pixel counts.
            let max_new = if is_explained { 0.0 } else { few };
            rounds += 1;
            let error = check.held_out_rms;
            if error < best.0 {
                best = (error, self.excluded.clone());
            }
            if (new <= max_new && returned <= few) || rounds > REJUDGEMENTS {
                if error <= BEST_ERROR_RATIO * best.0 {
                    return Ok(check);
                }
                self.exclude(best.1);
                return self.held_out_check(prior, observer);
            }
        }
    }

    /// Whether the model is checked on held-out pixels before the run.
    fn is_checked(&self) -> bool {
        let has_use = !self.options.keep_all_pixels || self.options.noise_sigma.is_none();
        let is_long = self
            .options
            .max_iterations
            .is_none_or(|max| max > CHECK_ITERATIONS);
        has_use && is_long && !self.options.is_preview && choose::can_choose(&self.data)
    }

    /// Runs `prior` on the pixels that are not held out.
    pub(super) fn held_out_check(
        &mut self,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let rule = self.tau_rule();
        let max_iterations = self.options.max_iterations;
        let check = HeldOutCheck::new(&mut self.data, prior, rule, max_iterations, observer)?;
        self.is_dense = prior.support && check.support_fraction() > choose::DENSE_SUPPORT;
        Ok(check)
    }

    /// Leaves the pixels `excluded` out. They may have disturbed the estimate of the noise level.
    fn exclude(&mut self, excluded: Vec<bool>) {
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
