//! What follows from the check of the model: foreign pixels are left out, PSF and camera are corrected, and the effective
//! noise level is set (docs/design/020).

use super::Observer;
use super::choose;
use super::exclusion::count;
use super::foreign::{self, BrokenLines, Foreign};
use super::held_out_check::{CHECK_ITERATIONS, EFFECTIVE_SIGMA, HeldOutCheck};
use super::held_out_run::HeldOutRun;
use super::self_calibration::{Finding, HeldOutErrors};
use super::{Prior, Problem, RunResult, SigmaSource, Tau, stray_light};
use rowburst_core::vecmath::norm;
use rowburst_optics::Shutter;
use rowburst_solve::DataTerm;
use tracing::{debug, info};

/// Effective noise level over what a refined PSF leaves, where the check calls the frame explained; larger smooths more.
const EXPLAINED_SIGMA: f64 = 0.72;
/// Effective noise level over the light of the frame at most; near 1 no video explains the frame as well as noise does.
const MAX_EFFECTIVE_SIGMA: f64 = 0.5;
/// Effective noise level by the check of a refined PSF over that by its search, above which the check has not settled;
/// smaller follows the error of the model.
const UNSETTLED: f64 = 2.0;
/// Residual over that of a video whose degrees of freedom take all that they may, up to which a fit is as free as that; larger
/// keeps the noise level of the sensor where the model is wrong.
const FREE_FIT: f64 = 1.02;
/// Held-out error at the effective noise level over that at the noise of the sensor, above which the effective one only
/// smooths; smaller does not follow errors of the PSF.
const SMOOTHING_RISE: f64 = 1.15;
/// Participation of a check's video over the number of measurements, above which no correction is looked for where the frame
/// sees too little of the scene; smaller misses stray light on small sensors.
const MAX_SEARCHED_PARTICIPATION: f64 = 0.5;
/// Held-out error after a correction of the model over that before, below which all pixels are judged again with it;
/// larger corrects the model for what foreign pixels do.
const CLEAR_CORRECTION: f64 = 0.7;
/// Held-out error over that with all pixels, at the same pixels, above which foreign pixels are not believed to be foreign.
const MAX_ERROR_RATIO: f64 = 0.98;
/// The same where the PSF has been corrected or many pixels are left out; larger leaves pixels out where PSF or camera are
/// wrong.
const DOUBTFUL_ERROR_RATIO: f64 = 0.5;
/// Part of the pixels from which they are many.
const MANY_EXCLUDED: f64 = 0.01;
/// The same ratio times the part of the pixels that are left out, at most: the more there are, the more of the error
/// they have to be. Larger leaves the light of a scene out that the frame observes in part.
const MAX_RATIO_TIMES_EXCLUDED: f64 = 0.02;
/// Held-out error without the pixels that stand out over that with them, above which PSF and camera are corrected first:
/// foreign pixels are most of the error where there are any; smaller searches for corrections of what they do.
const FOREIGN_ERROR_RATIO: f64 = 0.8;
/// Noise level of all pixels over that without the foreign ones, above which foreign pixels have raised it; larger takes
/// them for noise.
const MAX_SIGMA_RATIO: f64 = 1.2;
/// Smooth part of what a loose fit leaves from which there may be bright stray light; smaller looks for it where foreign
/// pixels or a wrong PSF are all that is wrong.
const MIN_SMOOTH_PART: f64 = 0.2;
/// Held-out error over `σ` without stray light up to which nothing else is wrong; larger leaves PSF and camera uncorrected.
const NEARLY_EXPLAINED: f64 = 2.0;
/// Standard deviation of most held-out residuals over the held-out error, below which the error is that of few pixels, which
/// are foreign; larger looks for them where PSF or camera are wrong.
const FEW_PIXELS_SCALE: f64 = 0.33;

/// Held-out error less offsets of the rows over that before, above which they are not believed; smaller asks for a gain that the
/// video of a dense scene, which has absorbed them, does not show.
const MAX_RISE: f64 = 1.02;

/// What is wrong with a frame whose pixels are not.
enum Cause {
    StrayLight,
    /// PSF or camera: a correction, if there is one.
    Model(Option<Box<Finding>>),
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
        let (mut check, run) = self.check_without_psf_floor(prior, observer)?;
        let mut run = Some(run);
        let is_global = *self.camera.shutter() == Shutter::Global;
        if is_global && !self.is_explained(&check) {
            self.last_check = run.take().map(|run| Box::new(run.into_result(&self.data)));
            self.has_wrong_model = self.has_other_shutter(&check, observer)?;
        }
        if !self.has_wrong_model && self.opens(&mut prior) {
            let opened = self.held_out_run(0.0, prior, observer)?;
            (check, run) = (opened.0, Some(opened.1));
        }
        if self.is_explained(&check) && !self.options.self_calibration.is_on() {
            info!("the model explains the frame");
            self.subtract_row_offsets(&mut check, &mut run, prior, observer)?;
            (self.passed_check, self.checked_run) = (true, run);
            return Ok(());
        }
        let may_be_undersampled = run
            .as_ref()
            .is_some_and(|run| self.may_be_undersampled(run));
        self.keep_as_result(run.take());
        if may_be_undersampled && !self.has_turned_frame() {
            self.judge_undersampling(&check, prior, observer)?;
            if self.undersampled_error.is_some() {
                self.has_wrong_model =
                    self.calibrates() && self.has_other_shutter(&check, observer)?;
                return Ok(());
            }
        }
        check = self.correct_model(check, prior, observer)?;
        self.opens(&mut prior);
        self.subtract_row_offsets(&mut check, &mut run, prior, observer)?;
        self.keep_as_result(run);
        self.judge_undersampling(&check, prior, observer)?;
        let is_estimated =
            self.options.noise_sigma.is_none() && self.sigma_source != SigmaSource::HeldOut;
        if is_estimated {
            let light =
                norm(self.data.measurements()) / (self.data.measurement_count() as f64).sqrt();
            let most = (MAX_EFFECTIVE_SIGMA * light).max(self.sigma);
            if self.undersampled_error.is_none() {
                self.effective_sigma = self.effective_sigma_after(&check).min(most);
            }
            info!("effective σ {:.4e} counts", self.effective_sigma);
        }
        Ok(())
    }

    /// Whether the light of a check's video is spread over so many voxels that the frame may see too little of them to find a
    /// correction. It is not judged where a correction is asked for by name.
    fn may_be_undersampled(&self, run: &HeldOutRun) -> bool {
        let limit = MAX_SEARCHED_PARTICIPATION * self.data.measurement_count() as f64;
        !self.options.self_calibration.is_on() && run.admm.participation() > limit
    }

    /// Keeps the result of a check, the last user of `data`, for a run that is stopped before it has a better one.
    fn keep_as_result(&mut self, check: Option<HeldOutRun>) {
        if let Some(check) = check {
            self.last_check = Some(Box::new(check.into_result(&self.data)));
        }
    }

    /// The last check as the result of a run that was `stopped` before it was better.
    fn last_check_or(&mut self, stopped: Box<RunResult>) -> Box<RunResult> {
        match self.last_check.take() {
            Some(mut result) => {
                result.solution.stop_reason = stopped.solution.stop_reason;
                result
            }
            None => stopped,
        }
    }

    /// The check of the model. Where the PSF shows a floor, that is subtracted, unless only the PSF as given explains the frame.
    fn check_without_psf_floor(
        &mut self,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<(HeldOutCheck, HeldOutRun), Box<RunResult>> {
        let Some(floor) = self.find_psf_floor() else {
            return self.held_out_run(0.0, prior, observer);
        };
        let corrected_data = self.data_with(floor.psfs.clone());
        let given_data = std::mem::replace(&mut self.data, corrected_data);
        info!(
            "the PSF has a floor of {:.3} of its mean",
            floor.parameters[0].value
        );
        let sigma = self.sigma;
        self.psf_floor = Some(floor);
        if self.sigma_source == SigmaSource::HeldOut {
            // The floor has disturbed the noise level.
            self.resolve_tau_rule(observer)?;
        }
        let corrected = self.held_out_run(0.0, prior, observer)?;
        if self.is_explained(&corrected.0) {
            return Ok(corrected);
        }
        let is_dense = std::mem::take(&mut self.is_dense);
        let corrected_data = std::mem::replace(&mut self.data, given_data);
        let corrected_sigma = std::mem::replace(&mut self.sigma, sigma);
        self.effective_sigma = sigma;
        let stopped = match self.held_out_run(0.0, prior, observer) {
            Ok(as_given) if self.is_explained(&as_given.0) => {
                self.psf_floor = None;
                return Ok(as_given);
            }
            as_given => as_given.err(),
        };
        self.data = corrected_data;
        (self.sigma, self.effective_sigma) = (corrected_sigma, corrected_sigma);
        self.is_dense = is_dense;
        match stopped {
            Some(stopped) => {
                self.keep_as_result(Some(corrected.1));
                Err(self.last_check_or(stopped))
            }
            None => Ok(corrected),
        }
    }

    /// Subtracts offsets of the rows from the frame of a dense scene, where held-out pixels confirm them. `check` is the last one
    /// of the model, and `run` its run if `data` has had no other since: both are then those of the corrected frame. Where
    /// offsets were tried in vain there is no run.
    fn subtract_row_offsets(
        &mut self,
        check: &mut HeldOutCheck,
        run: &mut Option<HeldOutRun>,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<(), Box<RunResult>> {
        let found = self.find_row_offsets(check, observer);
        let Ok(Some(mut calibration)) = found else {
            return found.map(|_| ()).map_err(|stopped| {
                self.keep_as_result(run.take());
                self.last_check_or(stopped)
            });
        };
        self.keep_as_result(run.take());
        let given = self.measurement.clone();
        self.set_measurement(calibration.corrected(&given));
        match self.held_out_run(0.0, prior, observer) {
            Ok((after, corrected)) if after.held_out_rms < MAX_RISE * check.held_out_rms => {
                calibration.held_out = Some(HeldOutErrors {
                    before: check.held_out_rms / self.sigma,
                    after: after.held_out_rms / self.sigma,
                });
                self.calibration = Some(calibration);
                (*check, *run) = (after, Some(corrected));
                Ok(())
            }
            tried => {
                info!("the offsets of the rows are not confirmed");
                self.set_measurement(given);
                match tried {
                    Ok(_) => Ok(()),
                    Err(stopped) => Err(self.last_check_or(stopped)),
                }
            }
        }
    }

    /// Where the scene is dense and no prior is given, sets `prior` to the one that assumes least. Returns whether it did.
    fn opens(&self, prior: &mut Prior) -> bool {
        let is_open = self.is_dense && self.options.prior.is_none();
        if is_open {
            *prior = choose::open_prior();
        }
        is_open
    }

    /// The noise level that serves the reconstruction best after all corrections, with `check` as the last check. What a
    /// refined PSF leaves is known from the pixels that its search has not seen.
    fn effective_sigma_after(&self, check: &HeldOutCheck) -> f64 {
        let refined = self.calibration.as_ref();
        let refined = refined.filter(|calibration| calibration.psf_refinement.is_some());
        let left = refined.and_then(|calibration| calibration.held_out);
        let left = left.map_or(0.0, |errors| errors.after * self.sigma);
        if self.is_explained(check) {
            (EXPLAINED_SIGMA * left).max(self.sigma)
        } else {
            let checked = check.effective_sigma(self.sigma);
            let found = (EFFECTIVE_SIGMA * left).max(self.sigma);
            if refined.is_some() && checked > UNSETTLED * found {
                found
            } else {
                checked.max(found)
            }
        }
    }

    /// Finds whether the frame sees too little of the scene to judge the model by `check`, which is of the present noise level,
    /// that of the sensor. The video then fits the pixels that it has seen with all the freedom that it may have, and misses the
    /// held-out ones; a larger noise level smooths it, and it misses them by more (docs/design/035). Keeps the last check as
    /// a result.
    fn judge_undersampling(
        &mut self,
        check: &HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<(), Box<RunResult>> {
        let calibration = self.calibration.as_ref();
        let has_refined_psf = calibration.is_some_and(|c| c.psf_refinement.is_some());
        // A support cannot be that free in a dense scene, a refined PSF knows its own error, and a noise level by held-out pixels
        // follows from the error that would be judged.
        let is_judged_otherwise = self.has_wrong_model
            || self.is_dense
            || has_refined_psf
            || self.sigma_source == SigmaSource::HeldOut;
        let least_residual = self.sigma * (1.0 - self.options.tuning.max_freedom).sqrt();
        let is_free = check.residual_rms <= FREE_FIT * least_residual;
        if is_judged_otherwise || !is_free || self.is_explained(check) {
            return Ok(());
        }
        let (last_check, present) = (self.last_check.take(), self.effective_sigma);
        self.effective_sigma = check.effective_sigma(self.sigma);
        let smoothed = self.held_out_run(0.0, prior, observer);
        self.effective_sigma = present;
        // As it was before: a smoothed video tells nothing about that.
        self.is_dense = false;
        self.last_check = last_check;
        let (smoothed, _) = smoothed.map_err(|stopped| self.last_check_or(stopped))?;
        let ratio = smoothed.held_out_rms / check.held_out_rms;
        info!("held-out error at a larger noise level over that at σ: {ratio:.3}");
        if ratio > SMOOTHING_RISE {
            self.undersampled_error = Some(check.held_out_rms / self.sigma);
        }
        Ok(())
    }

    /// Looks for what is wrong where `check` does not explain the frame: foreign pixels, stray light, PSF or camera. Returns
    /// the check after the corrections.
    ///
    /// Pixels stand out of a loose fit where they are foreign and where PSF or camera are wrong. If the model explains the
    /// frame without them, they are foreign and nothing else is wrong: the shortest search. If it explains little more, its
    /// error is that of most pixels, and they have not raised the noise level, PSF and camera are corrected at once, else
    /// after the rounds for foreign pixels. The correction is found without them; where it helps, all pixels are judged again.
    /// Smooth stray light is looked for after PSF and camera, but before all else where it is bright.
    fn correct_model(
        &mut self,
        check: HeldOutCheck,
        mut prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        self.has_wrong_model = self.has_wrong_model || self.has_turned_frame();
        if self.has_wrong_model {
            return Ok(check);
        }
        let found = self.find_foreign(observer)?;
        if self.take_bright_stray_light(&found, &check, prior, observer)? {
            return self.judge_again(prior, observer);
        }
        if !self.calibrates() {
            return self.exclude_foreign_and_stray_light(found, check, prior, observer);
        }
        let none = vec![false; self.excluded.len()];
        let (standing_out, sigma_with_all) = (found.pixels.clone(), self.sigma);
        let without = self.check_without_standing_out(&standing_out, prior, observer)?;
        if !self.calibrates() {
            // Foreign pixels have hidden that the scene is dense.
            self.opens(&mut prior);
            self.exclude(none);
            return self.exclude_foreign_and_stray_light(found, check, prior, observer);
        }
        let start = without.as_ref().unwrap_or(&check);
        // No error of PSF and camera raises the noise beyond the cut-off of the optics.
        let have_raised_sigma = sigma_with_all > MAX_SIGMA_RATIO * self.sigma;
        let is_followed = found.is_followed || have_raised_sigma;
        let is_model_first = !have_raised_sigma && is_of_model(start, check.held_out_rms);
        // Of a global shutter others were looked for at once.
        let is_known = *self.camera.shutter() == Shutter::Global && without.is_none();
        if self.is_of_another_camera(start, is_followed, is_known, prior, observer)? {
            self.has_wrong_model = true;
            self.exclude(none);
            return Ok(check);
        }
        let mut tried = None;
        if is_model_first
            && !self.is_explained(start)
            && !(is_followed && self.has_foreign_psf(start, prior, observer)?)
        {
            let mut finding = match self.find_cause(prior, start, observer)? {
                Cause::StrayLight => return self.judge_again(prior, observer),
                Cause::Model(finding) => finding,
            };
            if let Some(finding) = finding.take_if(|finding| is_clear(finding)) {
                return self.judge_corrected(*finding, prior, observer);
            }
            tried = Some(finding);
        }
        self.exclude(none.clone());
        let check = self.exclude_foreign(found, check, prior, observer)?;
        let is_explained = self.is_explained(&check);
        if is_explained && !self.options.self_calibration.is_on() {
            return Ok(check);
        }
        let excluded = self.excluded.clone();
        let start = match &without {
            Some(without) if !excluded.contains(&true) => {
                self.exclude(standing_out);
                without
            }
            _ => &check,
        };
        // Without foreign pixels it is the same search again.
        let tried = tried.filter(|_| !excluded.contains(&true));
        if tried.is_none() && is_followed && self.has_foreign_psf(start, prior, observer)? {
            self.exclude(excluded);
            self.has_wrong_model = true;
            return Ok(check);
        }
        let cause = match tried {
            Some(finding) => Cause::Model(finding),
            None => self.find_cause(prior, start, observer)?,
        };
        let Cause::Model(mut pending) = cause else {
            return self.judge_again(prior, observer);
        };
        if let Some(finding) = pending.take_if(|finding| is_clear(finding)) {
            return self.judge_corrected(*finding, prior, observer);
        }
        self.exclude(excluded.clone());
        let Some(finding) = pending.filter(|_| !is_explained) else {
            return Ok(check);
        };
        self.apply_correction(*finding, excluded);
        self.held_out_check(prior, observer)
    }

    /// A correction of PSF and camera, which comes first since it has fewer unknowns; smooth stray light, which is then taken
    /// away, where the correction does not explain the frame.
    fn find_cause(
        &mut self,
        prior: Prior,
        start: &HeldOutCheck,
        observer: &mut Observer,
    ) -> Result<Cause, Box<RunResult>> {
        let finding = self.find_correction(prior, start, observer)?;
        let explains = finding.as_ref().is_some_and(|finding| finding.explains);
        if !explains && self.take_stray_light(start, false, prior, observer)? {
            return Ok(Cause::StrayLight);
        }
        Ok(Cause::Model(finding.map(Box::new)))
    }

    /// Whether a frame that `check` does not explain belongs to another PSF, unless foreign pixels may explain that, or to
    /// another shutter, unless that `is_known`.
    fn is_of_another_camera(
        &mut self,
        check: &HeldOutCheck,
        may_have_foreign: bool,
        is_known: bool,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        Ok(!self.is_explained(check)
            && (!may_have_foreign && self.has_foreign_psf(check, prior, observer)?
                || !is_known && self.has_other_shutter(check, observer)?))
    }

    /// The check without the pixels `standing_out`, which are left out then; `None`: there are none.
    fn check_without_standing_out(
        &mut self,
        standing_out: &[bool],
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<Option<HeldOutCheck>, Box<RunResult>> {
        if !standing_out.contains(&true) {
            return Ok(None);
        }
        self.exclude(standing_out.to_vec());
        self.held_out_check(prior, observer).map(Some)
    }

    /// [`Self::exclude_foreign`], and takes smooth stray light away where that does not explain the frame.
    fn exclude_foreign_and_stray_light(
        &mut self,
        found: Foreign,
        check: HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let check = self.exclude_foreign(found, check, prior, observer)?;
        if self.take_stray_light(&check, false, prior, observer)? {
            return self.judge_again(prior, observer);
        }
        Ok(check)
    }

    /// Judges all pixels again, and corrects what is left, after smooth stray light has been taken away.
    fn judge_again(
        &mut self,
        mut prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        self.exclude(vec![false; self.excluded.len()]);
        if self.sigma_source == SigmaSource::HeldOut {
            // The stray light has disturbed the noise level.
            self.resolve_tau_rule(observer)?;
        }
        let mut check = self.held_out_check(prior, observer)?;
        if !self.options.self_calibration.is_on() {
            if self.is_explained(&check) {
                return Ok(check);
            }
            // The stray light may have hidden that the scene is dense.
            if self.opens(&mut prior) {
                check = self.held_out_check(prior, observer)?;
            }
            if check.held_out_rms < NEARLY_EXPLAINED * self.sigma {
                // What is left of the stray light is no error of PSF and camera.
                let found = self.find_foreign(observer)?;
                return self.exclude_foreign(found, check, prior, observer);
            }
        }
        let check = self.correct_model(check, prior, observer)?;
        if self.has_wrong_model {
            return Ok(check);
        }
        self.correct_stray_light(check, prior, observer)
    }

    /// Takes smooth stray light away where it may be much of what a loose fit leaves, since it hides foreign pixels.
    fn take_bright_stray_light(
        &mut self,
        found: &Foreign,
        check: &HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        if !self.looks_for_stray_light() {
            return Ok(false);
        }
        let shape = self.data.shutter().frame_shape();
        let part = stray_light::smooth_part_of(&found.loose_residual, shape);
        debug!("smooth part of what a loose fit leaves: {part:.3}");
        if part < MIN_SMOOTH_PART {
            return Ok(false);
        }
        self.take_stray_light(check, true, prior, observer)
    }

    /// Applies a correction and judges all pixels again with it.
    fn judge_corrected(
        &mut self,
        finding: Finding,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let none = vec![false; self.excluded.len()];
        let sensor_sigma = self.sigma;
        self.exclude(none.clone());
        self.apply_correction(finding, none);
        let check = self.held_out_check(prior, observer)?;
        // Many foreign pixels raise the noise level that is estimated from the frame.
        let is_noise_known = self.sigma < MAX_SIGMA_RATIO * sensor_sigma;
        // Foreign pixels must explain half of the error, which is never below the noise of the sensor.
        if is_noise_known && self.is_explained(&check)
            || DOUBTFUL_ERROR_RATIO * check.held_out_rms < sensor_sigma
        {
            return Ok(check);
        }
        let found = self.find_foreign(observer)?;
        self.exclude_foreign_and_stray_light(found, check, prior, observer)
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
                is_followed: true,
                loose_residual: Vec::new(),
            });
        }
        // Foreign pixels may have raised an estimate from the frame.
        let least_level = match self.sigma_source {
            SigmaSource::Given | SigmaSource::Calibration => self.sigma,
            SigmaSource::Frame | SigmaSource::HeldOut => 0.0,
        };
        let instants = self.camera.instants();
        let lines = BrokenLines::new(&self.measurement, instants);
        // The weights of foreign pixels follow from their own light, and hide bright ones in a loose fit.
        let measurement = self.measurement.without(&self.excluded);
        let weight = measurement.typical_weight();
        self.data.set_frame(&measurement.with_even_noise());
        let found = foreign::find(
            &mut self.data,
            instants,
            &lines,
            least_level / weight,
            observer,
        );
        self.data.set_frame(&measurement);
        if let Ok(found) = &found {
            info!(
                "{:.2} % of the pixels stand out at a noise level of {:.1} σ",
                100.0 * count(&found.pixels) as f64 / found.pixels.len() as f64,
                weight * found.level / self.sigma
            );
        }
        found.map(|found| Foreign {
            level: weight * found.level,
            ..found
        })
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
        let with_all = check.held_out_rms;
        let without = self.check_without(found, with_all, &lines.is_broken, prior, observer)?;
        let excluded_fraction = count(&self.excluded) as f64 / self.excluded.len() as f64;
        let ratio = without.held_out_rms / check.held_out_rms_without(&self.excluded);
        info!(
            "without {:.2} % of the pixels, which stand out: held-out error {:.3} σ, {ratio:.3} times that of these pixels before",
            100.0 * excluded_fraction,
            without.held_out_rms / self.sigma
        );
        // What a corrected PSF leaves is largest at bright pixels, which are not foreign.
        let is_corrected = self.calibration.is_some();
        let are_many = excluded_fraction >= MANY_EXCLUDED;
        let max_ratio = if is_corrected || are_many {
            DOUBTFUL_ERROR_RATIO.min(MAX_RATIO_TIMES_EXCLUDED / excluded_fraction)
        } else {
            MAX_ERROR_RATIO
        };
        let is_sure = self.is_explained(&without) && !is_corrected && !are_many;
        if is_sure || ratio < max_ratio {
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
        let asked = self.options.self_calibration;
        asked.is_on() || !asked.is_off() && !self.is_dense
    }

    /// Whether the model is checked on held-out pixels before the run.
    pub(super) fn is_checked(&self) -> bool {
        let has_use = !self.options.keep_all_pixels
            || self.options.noise_sigma.is_none()
            || !self.options.self_calibration.is_off();
        let is_long = self
            .options
            .max_iterations
            .is_none_or(|max| max > CHECK_ITERATIONS);
        // A guess of the noise level tells nothing about the model.
        let is_known =
            self.sigma_source != SigmaSource::HeldOut || !matches!(self.options.tau, Tau::Given(_));
        has_use && is_known && is_long && !self.options.is_preview && choose::can_choose(&self.data)
    }
}

/// Whether a correction explains so much that all pixels are judged again with it.
fn is_clear(finding: &Finding) -> bool {
    finding.explains || finding.error_ratio() < CLEAR_CORRECTION
}

/// Whether the error without the pixels that stand out is that of PSF or camera: it is nearly as large as that with them, `rms`,
/// and that of most pixels.
fn is_of_model(without: &HeldOutCheck, rms: f64) -> bool {
    without.held_out_rms > FOREIGN_ERROR_RATIO * rms
        && without.held_out_scale > FEW_PIXELS_SCALE * without.held_out_rms
}
