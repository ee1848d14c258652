//! How well a video predicts pixels that it has not seen.
//!
//! Where camera, PSF and noise level are right, its error there is little above the noise. It is far above the noise
//! where the model is wrong: an effective noise level of 0.85 times the error then serves the reconstruction best, and
//! foreign pixels are looked for (docs/design/020).

use super::Observer;
use super::foreign;
use super::frame_data::FrameData;
use super::held_out::{is_settled, rms};
use super::held_out_run::{ErrorAt, HeldOutRun};
use super::{Prior, Problem, RunResult};
use rowburst_core::vecmath::norm;
use rowburst_solve::DataTerm;
use rowburst_solve::admm::TauRule;
use tracing::info;

/// Most iterations of a check; fewer compare a video that has not settled.
pub(super) const CHECK_ITERATIONS: usize = 100;
/// The same where some rows of the video are seen weakly (docs/design/032).
const CHECK_ITERATIONS_OF_WEAK_ROWS: usize = 200;
/// Iteration at which a check may end early; smaller judges a video that has not taken shape.
pub(super) const FIRST_CHECK_ITERATION: usize = 30;
/// Iterations between two such moments; larger ends checks later.
pub(super) const CHECK_STEP: usize = 10;
/// Iteration from which a support of many voxels tells that the scene is dense; smaller takes the first support for
/// the last.
const FIRST_DENSE_ITERATION: usize = 50;
/// Part of the voxels in the support above which a scene is dense; smaller tries the priors of dense scenes on more.
pub(super) const DENSE_SUPPORT: f64 = 1.0 / 3.0;
/// Residual over `σ` above which the model does not explain the frame.
pub(super) const MAX_RESIDUAL: f64 = 1.06;
/// Held-out error over `σ` above which the model does not explain the frame; smaller doubts good models.
const MAX_HELD_OUT_ERROR: f64 = 1.35;
/// Standard deviations by which the limit of the held-out error is widened; smaller doubts small frames.
const DEVIATIONS: f64 = 2.0;
/// Effective noise level over the held-out error; larger smooths more, smaller follows the error of the model.
pub(super) const EFFECTIVE_SIGMA: f64 = 0.85;
/// Part of the pixels with a residual far above the others that noise explains.
const MAX_OUTLIERS: f64 = 2e-4;

/// How well a run on the pixels that are not held out explains the frame.
pub(super) struct HeldOutCheck {
    /// `A v` of its video, at all pixels.
    pub light: Vec<f32>,
    pub residual_rms: f64,
    /// Indices of the held-out pixels.
    held_out_pixels: Vec<usize>,
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
        let held_out_rms = rms(&held_out);
        Self {
            light: data.predicted(video),
            residual_rms: run.residual_rms,
            held_out_rms,
            held_out_scale: foreign::robust_scale(
                &mut held_out.iter().map(|r| r.abs()).collect::<Vec<_>>(),
            ),
            held_out_pixels: data.held_out_pixels().to_vec(),
            held_out,
            support_fraction: run.admm.support_fraction(),
        }
    }

    /// How far the held-out error of few pixels may lie above its mean by chance, in parts of it.
    fn allowed_deviation(&self) -> f64 {
        DEVIATIONS / (2.0 * self.held_out.len().max(1) as f64).sqrt()
    }

    /// The held-out error at the pixels that are not `excluded`.
    pub fn held_out_rms_without(&self, excluded: &[bool]) -> f64 {
        let pairs = self.held_out_pixels.iter().zip(&self.held_out);
        let kept = pairs.filter(|(pixel, _)| !excluded[**pixel]);
        rms(&kept.map(|(_, residual)| *residual).collect::<Vec<_>>())
    }

    /// The noise level that serves the reconstruction best where the model does not explain the frame, at least
    /// `sigma`.
    pub fn effective_sigma(&self, sigma: f64) -> f64 {
        (EFFECTIVE_SIGMA * self.held_out_rms).max(sigma)
    }
}

impl Problem {
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
            && is_settled(errors)
    }

    /// Whether the video explains less than none: more iterations do not save it.
    fn explains_nothing(&self, check: &HeldOutCheck) -> bool {
        let light = norm(self.data.measurements());
        check.residual_rms > light / (self.data.measurement_count() as f64).sqrt()
    }

    /// Runs `prior` on the pixels that are not held out, at most until the model explains the frame.
    pub(super) fn held_out_check(
        &mut self,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let (check, run) = self.held_out_run(0.0, prior, observer)?;
        self.last_check = Some(Box::new(run.into_result(&self.data)));
        Ok(check)
    }

    /// The same, at most until the held-out error is below `error`. Also returns the run, which can continue.
    pub(super) fn held_out_run(
        &mut self,
        error: f64,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<(HeldOutCheck, HeldOutRun), Box<RunResult>> {
        // A `τ` that is given may fit no frame: the model is not to blame.
        let rule = TauRule::Discrepancy {
            sigma: self.effective_sigma,
        };
        let settings = self.options.solver_settings().of_a_trial();
        let mut run = HeldOutRun::new(&mut self.data, prior, rule, settings);
        let last = if self.data.has_weakly_seen_rows() {
            CHECK_ITERATIONS_OF_WEAK_ROWS
        } else {
            CHECK_ITERATIONS
        };
        let mut until = FIRST_CHECK_ITERATION;
        let mut errors = Vec::new();
        let (mut was_wide, mut explained_nothing) = (false, false);
        loop {
            let has_converged = run.run(&mut self.data, until, observer)?;
            let check = HeldOutCheck::of(&run, &self.data);
            errors.push(check.held_out_rms);
            let has_converged = has_converged || self.is_stationary(&check, &errors);
            // Once alone, bins that fitted badly may just have been opened.
            let is_wide = prior.support && check.support_fraction > DENSE_SUPPORT;
            let is_dense = is_wide && was_wide && until >= FIRST_DENSE_ITERATION;
            was_wide = is_wide;
            let is_done = check.held_out_rms < error || self.is_explained(&check);
            let is_over = has_converged || is_dense || until >= last;
            // Once alone, a bin may just have been opened.
            let explains_nothing = self.explains_nothing(&check);
            let is_hopeless = explains_nothing && explained_nothing;
            explained_nothing = explains_nothing;
            if is_over || is_done || is_hopeless {
                self.is_dense |= is_dense;
                info!(
                    "check of the model, prior {prior}: residual {:.3} σ, held-out error {:.3} σ, {:.1} % of the voxels active",
                    check.residual_rms / self.sigma,
                    check.held_out_rms / self.sigma,
                    100.0 * check.support_fraction
                );
                let iterations = (FIRST_CHECK_ITERATION..).step_by(CHECK_STEP);
                let errors = iterations.zip(errors);
                run.errors
                    .extend(errors.map(|(iteration, error)| ErrorAt { iteration, error }));
                return Ok((check, run));
            }
            until += CHECK_STEP;
        }
    }
}
