//! How well a video predicts pixels that it has not seen.
//!
//! Where camera, PSF and noise level are right, its error there is little above the noise. It is far above the noise
//! where the model is wrong: an effective noise level of 0.85 times the error then serves the reconstruction best, and
//! foreign pixels are looked for (docs/design/020).

use super::choose::{self, Observer, rms};
use super::exclusion::count;
use super::foreign::{self, BrokenLines, Foreign};
use super::frame_data::FrameData;
use super::{Prior, Problem, RunResult, SelfCalibration, SigmaSource, Tau, observe_sum};
use crate::prox::Prox;
use crate::solve::StopReason;
use crate::solve::admm::{Admm, TauRule};
use tracing::info;

/// Most iterations of a check; fewer compare a video that has not settled.
pub(super) const CHECK_ITERATIONS: usize = 100;
/// Iteration at which a check may end early; smaller judges a video that has not taken shape.
pub(super) const FIRST_CHECK_ITERATION: usize = 30;
/// Iterations between two such moments; larger ends checks later.
pub(super) const CHECK_STEP: usize = 10;
/// Iteration from which a support of many voxels tells that the scene is dense; smaller takes the first support for
/// the last.
const FIRST_DENSE_ITERATION: usize = 50;
/// Residual over `σ` above which the model does not explain the frame.
pub(super) const MAX_RESIDUAL: f64 = 1.06;
/// Held-out error over `σ` above which the model does not explain the frame; smaller doubts good models.
const MAX_HELD_OUT_ERROR: f64 = 1.35;
/// Standard deviations by which the limit of the held-out error is widened; smaller doubts small frames.
const DEVIATIONS: f64 = 2.0;
/// Effective noise level over the held-out error; larger smooths more, smaller follows the error of the model.
pub(super) const EFFECTIVE_SIGMA: f64 = 0.85;
/// The same over what a refined PSF leaves, where the check calls the frame explained.
const EXPLAINED_SIGMA: f64 = 0.72;
/// Part of the pixels with a residual far above the others that noise explains.
const MAX_OUTLIERS: f64 = 2e-4;

/// Held-out error after a correction of the model over that before, below which it is made before the rest of the foreign
/// pixels is looked for; larger corrects the model for what foreign pixels do.
const CLEAR_CORRECTION: f64 = 0.7;
/// Held-out error over that with all pixels above which foreign pixels are not believed to be foreign.
const MAX_ERROR_RATIO: f64 = 0.98;
/// The same where many are left out, or the PSF has been corrected: the error falls by that alone, since they are no longer
/// held out.
const MAX_ERROR_RATIO_OF_MANY: f64 = 0.5;
/// Part of the pixels from which they are many.
const MANY_EXCLUDED: f64 = 0.01;

/// A run on the pixels that are not held out.
pub(super) struct HeldOutRun {
    prior: Prior,
    prox: Box<dyn Prox>,
    pub admm: Admm,
    residual_rms: f64,
}

impl HeldOutRun {
    /// A run from a zero video.
    pub fn new(
        data: &mut FrameData,
        prior: Prior,
        rule: TauRule,
        max_iterations: Option<usize>,
    ) -> Self {
        let held_out = data.held_out();
        data.reset(prior.background(), Some(held_out));
        Self::without_reset(data, prior, rule, max_iterations)
    }

    /// A run from a zero video on all pixels of `data`, which is as new and for the background of `prior`.
    pub fn without_reset(
        data: &FrameData,
        prior: Prior,
        rule: TauRule,
        max_iterations: Option<usize>,
    ) -> Self {
        let params = prior.admm_params(data.shape(), rule, max_iterations);
        Self {
            prior,
            prox: data.prox(&prior),
            admm: Admm::new(data, data.shape(), params),
            residual_rms: 0.0,
        }
    }

    /// Root mean square of the weighted residual at the last iteration.
    pub fn residual_rms(&self) -> f64 {
        self.residual_rms
    }

    /// Iterates up to iteration `until` or until it converges, and returns whether it has. The error is the result so far
    /// of a run that the observer stopped.
    pub fn run(
        &mut self,
        data: &mut FrameData,
        until: usize,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        let (prior, shape) = (self.prior, data.shape());
        let residual_rms = &mut self.residual_rms;
        let reason = self
            .admm
            .run(data, &mut *self.prox, until, &mut |progress| {
                *residual_rms = progress.residual_rms;
                observe_sum(prior.background(), shape, progress, observer)
            });
        if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
            let solution = self.admm.snapshot(data, &*self.prox, reason);
            return Err(Box::new(RunResult::new(
                prior,
                &*self.prox,
                shape,
                solution,
            )));
        }
        Ok(reason == StopReason::Converged)
    }
}

/// How well a run on the pixels that are not held out explains the frame.
pub(super) struct HeldOutCheck {
    /// `A v` of its video, at all pixels.
    pub light: Vec<f32>,
    pub residual_rms: f64,
    /// Weighted residuals of the held-out pixels.
    pub held_out: Vec<f64>,
    pub held_out_rms: f64,
    /// Standard deviation of most held-out residuals, by their median.
    pub held_out_scale: f64,
    pub support_fraction: f64,
}

impl HeldOutCheck {
    /// The check of a run so far.
    pub fn of(run: &HeldOutRun, data: &FrameData) -> Self {
        let video = run.admm.video();
        let held_out = data.held_out_residuals(video);
        Self {
            light: data.predicted(video),
            residual_rms: run.residual_rms,
            held_out_rms: rms(&held_out),
            held_out_scale: foreign::robust_scale(
                &mut held_out.iter().map(|r| r.abs()).collect::<Vec<_>>(),
            ),
            held_out,
            support_fraction: run.admm.support_fraction(),
        }
    }

    /// How far the held-out error of few pixels may lie above its mean by chance, in parts of it.
    fn allowed_deviation(&self) -> f64 {
        DEVIATIONS / (2.0 * self.held_out.len().max(1) as f64).sqrt()
    }

    /// The noise level that serves the reconstruction best where the model does not explain the frame, at least
    /// `sigma`.
    fn effective_sigma(&self, sigma: f64) -> f64 {
        (EFFECTIVE_SIGMA * self.held_out_rms).max(sigma)
    }
}

impl Problem {
    /// Checks the model on held-out pixels. Where it does not explain the frame, leaves foreign pixels out and sets the
    /// effective noise level. The error is the result so far of a run that the observer stopped.
    pub(super) fn check_model(
        &mut self,
        mut prior: Prior,
        observer: &mut Observer,
    ) -> Result<(), Box<RunResult>> {
        if !self.is_checked() {
            return Ok(());
        }
        let mut check = self.held_out_check(prior, observer)?;
        if self.is_dense && self.options.prior.is_none() {
            prior = choose::open_prior();
            check = self.held_out_check(prior, observer)?;
        }
        if self.is_explained(&check) && self.options.self_calibration != SelfCalibration::On {
            info!("the model explains the frame");
            return Ok(());
        }
        check = self.correct_model(check, prior, observer)?;
        let is_estimated =
            self.options.noise_sigma.is_none() && self.sigma_source != SigmaSource::HeldOut;
        if is_estimated {
            self.effective_sigma = self.effective_sigma_after(&check);
            info!("effective σ {:.4} counts", self.effective_sigma);
        }
        Ok(())
    }

    /// The noise level that serves the reconstruction best after all corrections, with `check` as the last check. What a
    /// refined PSF leaves is known from the pixels that its search has not seen.
    fn effective_sigma_after(&self, check: &HeldOutCheck) -> f64 {
        let refined = self.calibration.as_ref();
        let refined = refined.filter(|calibration| calibration.psf_refinement.is_some());
        let left = refined.map_or(0.0, |calibration| calibration.held_out_after * self.sigma);
        if self.is_explained(check) {
            (EXPLAINED_SIGMA * left).max(self.sigma)
        } else {
            check
                .effective_sigma(self.sigma)
                .max(EFFECTIVE_SIGMA * left)
        }
    }

    /// Looks for what is wrong where `check` does not explain the frame: foreign pixels, PSF or camera. Returns the
    /// check after the corrections.
    ///
    /// Pixels stand out of a loose fit where they are foreign and where PSF or camera are wrong. Without them PSF and
    /// camera are corrected first: if that explains the frame, no pixel is foreign.
    fn correct_model(
        &mut self,
        check: HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let found = self.find_foreign(observer)?;
        if !self.calibrates() {
            return self.exclude_foreign(found, check, prior, observer);
        }
        let none = vec![false; self.excluded.len()];
        let mut without = None;
        if found.pixels.contains(&true) {
            self.exclude(found.pixels.clone());
            without = Some(self.held_out_check(prior, observer)?);
        }
        let without = without.as_ref().unwrap_or(&check);
        let is_explained = self.is_explained(without);
        let mut pending = None;
        if !is_explained || self.options.self_calibration == SelfCalibration::On {
            pending = self.find_correction(prior, without, observer)?;
        }
        self.exclude(none.clone());
        if let Some(finding) =
            pending.take_if(|found| found.explains || found.error_ratio() < CLEAR_CORRECTION)
        {
            self.apply_correction(finding.calibration, none);
            let check = self.held_out_check(prior, observer)?;
            if self.is_explained(&check) {
                return Ok(check);
            }
            let found = self.find_foreign(observer)?;
            return self.exclude_foreign(found, check, prior, observer);
        }
        let check = self.exclude_foreign(found, check, prior, observer)?;
        if is_explained || self.is_explained(&check) {
            return Ok(check);
        }
        if self.excluded.contains(&true) {
            pending = self.find_correction(prior, &check, observer)?.or(pending);
        }
        let Some(finding) = pending else {
            return Ok(check);
        };
        self.apply_correction(finding.calibration, self.excluded.clone());
        self.held_out_check(prior, observer)
    }

    /// Pixels that stand out at a loose fit, if foreign pixels are to be left out.
    pub(super) fn find_foreign(
        &mut self,
        observer: &mut Observer,
    ) -> Result<Foreign, Box<RunResult>> {
        if self.options.keep_all_pixels {
            return Ok(Foreign {
                pixels: vec![false; self.excluded.len()],
                level: self.sigma,
            });
        }
        // Foreign pixels may have raised an estimate from the frame.
        let least_level = match self.sigma_source {
            SigmaSource::Given | SigmaSource::Calibration => self.sigma,
            SigmaSource::Frame | SigmaSource::HeldOut => 0.0,
        };
        let instants = self.camera.instants();
        let lines = BrokenLines::new(&self.measurement, instants);
        foreign::find(&mut self.data, instants, &lines, least_level, observer)
    }

    /// Leaves the pixels `found`, and others that prove to be foreign, out where the video then predicts better than in
    /// `check`. Returns the check that holds then.
    fn exclude_foreign(
        &mut self,
        found: Foreign,
        check: HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        if !found.pixels.contains(&true) {
            return Ok(check);
        }
        let lines = BrokenLines::new(&self.measurement, self.camera.instants());
        let without = self.check_without(found, &lines.is_broken, prior, observer)?;
        let excluded_fraction = count(&self.excluded) as f64 / self.excluded.len() as f64;
        // What a corrected PSF leaves is largest at bright pixels, which are not foreign.
        let is_doubtful = self.calibration.is_some();
        let max_ratio = if is_doubtful || excluded_fraction >= MANY_EXCLUDED {
            MAX_ERROR_RATIO_OF_MANY
        } else {
            MAX_ERROR_RATIO
        };
        info!(
            "without {:.2} % of the pixels, which stand out: held-out error {:.3} σ",
            100.0 * excluded_fraction,
            without.held_out_rms / self.sigma
        );
        if self.is_explained(&without) && !is_doubtful
            || without.held_out_rms < max_ratio * check.held_out_rms
        {
            if self.sigma_source == SigmaSource::HeldOut {
                // Foreign pixels have disturbed the noise level.
                self.resolve_tau_rule(observer)?;
            }
            return Ok(without);
        }
        // The video predicts no better without them: it is the model that is wrong.
        self.exclude(vec![false; self.excluded.len()]);
        Ok(check)
    }

    /// Whether the frame may correct PSF and camera.
    fn calibrates(&self) -> bool {
        match self.options.self_calibration {
            SelfCalibration::Off => false,
            SelfCalibration::Auto => !self.is_dense,
            SelfCalibration::On => true,
        }
    }

    /// Whether the model explains the pixels that are not left out to the noise of the sensor.
    pub(super) fn is_explained(&self, check: &HeldOutCheck) -> bool {
        let foreign = self.foreign(check, 1.0);
        let pairs = foreign.iter().zip(&self.excluded);
        let outliers = pairs.filter(|(foreign, excluded)| **foreign && !**excluded);
        check.residual_rms <= MAX_RESIDUAL * self.sigma
            && check.held_out_rms
                <= MAX_HELD_OUT_ERROR * (1.0 + check.allowed_deviation()) * self.sigma
            && outliers.count() as f64 <= (MAX_OUTLIERS * foreign.len() as f64).max(1.0)
    }

    /// Whether a check of a dense scene, which may never explain the frame, would learn little from more iterations.
    pub(super) fn is_stationary(&self, check: &HeldOutCheck, errors: &[f64]) -> bool {
        self.is_dense
            && check.residual_rms <= MAX_RESIDUAL * self.effective_sigma
            && choose::is_settled(errors)
    }

    /// Whether the model is checked on held-out pixels before the run.
    pub(super) fn is_checked(&self) -> bool {
        let has_use = !self.options.keep_all_pixels
            || self.options.noise_sigma.is_none()
            || self.options.self_calibration != SelfCalibration::Off;
        let is_long = self
            .options
            .max_iterations
            .is_none_or(|max| max > CHECK_ITERATIONS);
        // A guess of the noise level tells nothing about the model.
        let is_known =
            self.sigma_source != SigmaSource::HeldOut || !matches!(self.options.tau, Tau::Given(_));
        has_use && is_known && is_long && !self.options.is_preview && choose::can_choose(&self.data)
    }

    /// Runs `prior` on the pixels that are not held out, at most until the model explains the frame.
    pub(super) fn held_out_check(
        &mut self,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        // A `τ` that is given may fit no frame: the model is not to blame.
        let rule = TauRule::Discrepancy {
            sigma: self.effective_sigma,
        };
        let max_iterations = self.options.max_iterations;
        let mut run = HeldOutRun::new(&mut self.data, prior, rule, max_iterations);
        let mut until = FIRST_CHECK_ITERATION;
        let mut errors = Vec::new();
        let mut was_wide = false;
        loop {
            let has_converged = run.run(&mut self.data, until, observer)?;
            let check = HeldOutCheck::of(&run, &self.data);
            errors.push(check.held_out_rms);
            let has_converged = has_converged || self.is_stationary(&check, &errors);
            // Once alone, bins that fitted badly may just have been opened.
            let is_wide = prior.support && check.support_fraction > choose::DENSE_SUPPORT;
            let is_dense = is_wide && was_wide && until >= FIRST_DENSE_ITERATION;
            was_wide = is_wide;
            if has_converged || is_dense || until >= CHECK_ITERATIONS || self.is_explained(&check) {
                self.is_dense |= is_dense;
                info!(
                    "check of the model, prior {prior}: residual {:.3} σ, held-out error {:.3} σ, {:.1} % of the voxels active",
                    check.residual_rms / self.sigma,
                    check.held_out_rms / self.sigma,
                    100.0 * check.support_fraction
                );
                return Ok(check);
            }
            until += CHECK_STEP;
        }
    }
}
