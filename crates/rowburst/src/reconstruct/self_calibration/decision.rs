//! Which of several corrections explains the frames best, and whether held-out pixels confirm it.

use super::super::RunResult;
use super::super::choose;
use super::super::held_out;
use super::super::held_out_check::EFFECTIVE_SIGMA;
use super::calibrator::{Correction, Trial};
use super::parameters::ModelParameter;
use super::psf_error::Capture;
use super::psf_model::PsfModel;
use super::refine::relative_change;
use super::search::{
    BLUR_STEPS, JUDGED_ITERATIONS, LOOSE_ITERATIONS, Proposal, Search, confirming, judging,
};
use super::step::{Free, step};
use super::{Calibration, Finding, FoundParameter, HeldOutErrors};
use rowburst_optics::TimingChange;
use tracing::debug;

/// The parameters that steps find together.
const FREE: [ModelParameter; 12] = [
    ModelParameter::Scale,
    ModelParameter::Rotation,
    ModelParameter::Anisotropy,
    ModelParameter::Shear,
    ModelParameter::Floor,
    ModelParameter::Offset,
    ModelParameter::SlopeX,
    ModelParameter::SlopeY,
    ModelParameter::Vignetting,
    ModelParameter::HalfGain,
    ModelParameter::Exposure,
    ModelParameter::HalfDelay,
];
/// Parameters that make nearly the same change of a frame as others do together.
const GROUPS: [&[ModelParameter]; 7] = [
    &[ModelParameter::Blur],
    &[
        ModelParameter::Floor,
        ModelParameter::Offset,
        ModelParameter::SlopeX,
        ModelParameter::SlopeY,
    ],
    &[ModelParameter::Vignetting],
    &[ModelParameter::HalfGain],
    &[ModelParameter::Exposure],
    &[ModelParameter::HalfDelay],
    &[
        ModelParameter::Scale,
        ModelParameter::Rotation,
        ModelParameter::Anisotropy,
        ModelParameter::Shear,
    ],
];
/// First noise level of the search over the light of the frames; larger stands larger errors of the model.
const START_LEVEL: f64 = 0.05;
/// The same over the noise of the sensor.
const MIN_START_LEVEL: f64 = 3.0;
/// Error of the judging pixels over `σ` up to which the model explains the frame.
pub(super) const EXPLAINED: f64 = 1.35;
/// Error of the judging pixels of a first sharper PSF over that of the PSF as given, below which a blur alone is searched
/// for. Parameters sought before a blur find others in its place.
const BLUR_ALONE: f64 = 0.8;
/// The same below which the parameters are sought with that blur: other faults look like a blur, too.
const BLUR_FIRST: f64 = 0.5;
/// The same after the parameters, and below which the blur is taken.
const BLUR_BESIDE: f64 = 0.93;
/// Noise level over that error in the search for a blur after the parameters.
const BLUR_LEVEL: f64 = 0.6;
/// Error of the judging pixels of a simpler correction over that of the full one, up to which it is preferred.
const SIMPLER: f64 = 1.01;
/// The same from which rows have stray light of their own.
const ROWS_ARE_THERE: f64 = 1.5;
/// Error of the judging pixels with another timing over that with the timing as given, below which it is kept; larger finds
/// ghosts of other faults.
const WORTH_TIMING: f64 = 0.98;
/// Error of the judging pixels with a refined PSF over that before, below which the refinement is kept.
const WORTH_REFINING: f64 = 0.97;
/// The same over that with parameters, below which these were ghosts of an error of the PSF itself.
const REFINED_ALONE: f64 = 0.8;
/// Error of the judging pixels with a PSF refined at once over that before, below which no parameters are sought where all
/// rows see one picture; larger bends the PSF in place of a turn.
const REFINED_FIRST: f64 = 0.3;
/// Error of the judging pixels after the parameters over that before, above which their PSF is not refined.
const PARAMETERS_FAIL: f64 = 0.95;
/// Error of held-out pixels after over that before, above which a correction is not worth it: a real capture has a small
/// gain by a wrong blur.
pub(super) const MIN_GAIN: f64 = 0.9;
/// Error of held-out pixels after a correction over the contrast of the frames, above which it is not plausible: the PSF
/// belongs to another diffuser.
pub(super) const MAX_MISFIT: f64 = 0.12;
/// The same of a loose reconstruction, or after the parameters, above which no more is tried.
const HOPELESS_MISFIT: f64 = 0.45;
/// Error of held-out pixels over the noise of the sensor up to which any clear gain counts.
const PLAUSIBLE: f64 = 2.5;
/// Error after a correction over that before, up to which a larger error counts: a wrong PSF is bent a little towards the
/// frames.
const LARGE_GAIN: f64 = 0.5;
/// Floor over the mean of the PSF's capture, above which it is not plausible: the light under a capture is fainter than
/// the speckle.
const MAX_FLOOR: f64 = 0.7;
/// Standard errors of the paired differences by which the squared residuals of the judging pixels must fall.
const MIN_JUDGING_GAIN: f64 = 4.0;
/// The same of the confirming pixels, among which nothing was chosen.
const MIN_CONFIRMING_GAIN: f64 = 2.0;

impl Correction {
    /// The parameters that steps find and that are not zero.
    fn free_parameters(&self) -> Vec<ModelParameter> {
        let free = FREE.into_iter();
        free.filter(|p| self.parameters[*p] != 0.0).collect()
    }
}

impl Search<'_, '_, '_> {
    /// The correction that predicts held-out pixels best; `light` is the root mean square of the frame.
    pub fn find(
        &mut self,
        given: &Proposal,
        light: f64,
        capture: Option<&Capture>,
    ) -> Result<Proposal, Box<RunResult>> {
        let Some(capture) = capture else {
            let blurred = self.blur(given, &BLUR_STEPS[..1], BLUR_ALONE)?;
            let found = self.find_parameters(given, light)?;
            return self.completed(given, blurred, found);
        };
        if capture.noise.is_some() {
            let limit = WORTH_REFINING * given.error;
            if let Some(refined) = self.refine(given, capture, limit, true, &[])?
                && refined.error < limit
            {
                return Ok(refined);
            }
        }
        if self.is_hopeless(given, light)? {
            return Ok(given.clone());
        }
        if self.calibrator.is_one_picture() {
            // Steps in the parameters take longest here.
            let limit = (REFINED_FIRST * given.error).max(EXPLAINED * self.sigma);
            if let Some(refined) = self.refine(given, capture, given.error, false, &[])?
                && refined.error < limit
            {
                return Ok(refined);
            }
        }
        let blurred = self.blur(given, &BLUR_STEPS[..1], BLUR_ALONE)?;
        if blurred.error < EXPLAINED * self.sigma {
            return Ok(blurred);
        }
        let start = if blurred.error < BLUR_FIRST * given.error {
            &blurred
        } else {
            given
        };
        let found = self.find_parameters(start, light)?;
        if found.error > HOPELESS_MISFIT * self.calibrator.contrast() {
            return Ok(found);
        }
        if found.error > EXPLAINED * self.sigma {
            if let Some(refined) = self.refined_beside(&found, capture)? {
                return Ok(refined);
            }
            let limit = REFINED_ALONE * found.error;
            if let Some(refined) = self.refine(given, capture, limit, false, &[])?
                && refined.error < limit
            {
                // The parameters were ghosts of an error of the PSF itself.
                return Ok(refined);
            }
        }
        let found = self.completed(given, blurred, found)?;
        if found.error > EXPLAINED * self.sigma && found.error < PARAMETERS_FAIL * given.error {
            let limit = WORTH_REFINING * found.error;
            let free = found.correction.free_parameters();
            if let Some(refined) = self.refine(&found, capture, limit, false, &free)?
                && refined.error < limit
            {
                return Ok(refined);
            }
        }
        Ok(found)
    }

    /// The PSF of `found` refined with its parameters, where these leave no more than noise of the capture explains: other
    /// parameters would be ghosts of it. The negligible ones are left out.
    fn refined_beside(
        &mut self,
        found: &Proposal,
        capture: &Capture,
    ) -> Result<Option<Proposal>, Box<RunResult>> {
        if capture.noise.is_none() {
            return Ok(None);
        }
        let start = Proposal {
            correction: without_rows(&found.correction.without_negligible()),
            ..found.clone()
        };
        let free = start.correction.free_parameters();
        let limit = WORTH_REFINING * found.error;
        let refined = self.refine(&start, capture, limit, true, &free)?;
        Ok(refined.filter(|refined| refined.error < limit))
    }

    /// Compares `found` with the PSF as given, on the judging and on the confirming pixels. `given_error` is the held-out
    /// error without a correction at the noise of the sensor.
    pub fn confirm(
        &mut self,
        found: &Proposal,
        given_error: f64,
        is_filtered: bool,
    ) -> Result<Option<Finding>, Box<RunResult>> {
        let given = self.calibrator.given();
        let level = (EFFECTIVE_SIGMA * given_error).max(self.sigma);
        let before = self.run(&given, level, JUDGED_ITERATIONS)?;
        let mut after = self.run(&found.correction, found.level, JUDGED_ITERATIONS)?;
        let (judged_before, judged_after) = (judging(&before), judging(&after));
        let (error_before, error_after) =
            (held_out::rms(&judged_before), held_out::rms(&judged_after));
        let is_plausible =
            error_after < PLAUSIBLE * self.sigma || error_after < LARGE_GAIN * error_before;
        if !is_plausible
            || found.correction.parameters[ModelParameter::Floor] > MAX_FLOOR
            || !is_clear_gain(&judged_before, &judged_after, MIN_JUDGING_GAIN)
            || !is_clear_gain(
                &confirming(&before),
                &confirming(&after),
                MIN_CONFIRMING_GAIN,
            )
        {
            return Ok(None);
        }
        let correction = &found.correction;
        let parameters: Vec<ModelParameter> = ModelParameter::ALL
            .into_iter()
            .filter(|p| correction.parameters[*p] != 0.0)
            .collect();
        let free = Free {
            parameters: &parameters,
            has_row_offsets: correction.has_row_offsets(),
        };
        let (calibrator, sigma) = (&mut self.calibrator, found.level);
        let report = step(calibrator, &mut correction.clone(), &mut after, sigma, free);
        let with_errors = parameters.iter().zip(report.standard_errors);
        let parameters = with_errors.map(|(&parameter, standard_error)| FoundParameter {
            parameter,
            value: correction.parameters[parameter],
            standard_error,
        });
        let psfs = calibrator.psfs(correction);
        let is_refined = is_filtered || correction.refined.is_some();
        let psf_refinement = is_refined.then(|| {
            let capture = calibrator.given_psfs().central();
            let model = PsfModel::new(capture).psf(&correction.parameters);
            relative_change(&model, psfs.central())
        });
        let (gain, offset) = calibrator.pixels(correction);
        let sensor_sigma = self.sigma;
        let held_out = |trials: &[Trial]| {
            held_out::rms(&[judging(trials), confirming(trials)].concat()) / sensor_sigma
        };
        let held_out = HeldOutErrors {
            before: held_out(&before),
            after: held_out(&after),
        };
        let light_before = match &before[..] {
            [before] => Some(before.data.light(&before.video)),
            _ => None,
        };
        Ok(Some(Finding {
            calibration: Calibration {
                parameters: parameters.collect(),
                row_offsets: if correction.has_row_offsets() {
                    correction.row_offsets.clone()
                } else {
                    Vec::new()
                },
                psf_refinement,
                psfs,
                gain,
                offset,
                held_out: Some(held_out),
                residual_before: None,
            },
            light_before,
            held_out,
            explains: held_out.after < EXPLAINED,
        }))
    }

    /// Whether a loose reconstruction predicts so little of the frames that no correction will help.
    fn is_hopeless(&mut self, given: &Proposal, light: f64) -> Result<bool, Box<RunResult>> {
        let limit = HOPELESS_MISFIT * self.calibrator.contrast();
        if given.error < limit {
            return Ok(false);
        }
        let level = (START_LEVEL * light).max(MIN_START_LEVEL * self.sigma);
        let trials = self.run(&given.correction, level, LOOSE_ITERATIONS)?;
        let error = Proposal::new(&given.correction, level, &trials).error;
        debug!(
            "self-calibration: held-out error of a loose reconstruction {:.3} of the contrast",
            error / self.calibrator.contrast()
        );
        Ok(error > limit)
    }

    /// All parameters together, from those of `start` on.
    fn find_parameters(
        &mut self,
        start: &Proposal,
        light: f64,
    ) -> Result<Proposal, Box<RunResult>> {
        let level = (START_LEVEL * light).max(MIN_START_LEVEL * self.sigma);
        self.all_parameters(start, level)
    }

    /// The parameters that steps may correct.
    fn free_parameters(&self) -> Vec<ModelParameter> {
        let free = FREE.into_iter();
        free.filter(|p| self.correctable.has(*p) && self.calibrator.can_tell(*p))
            .collect()
    }

    /// All parameters that may be corrected together, from those of `start` and the noise level `level` on.
    fn all_parameters(&mut self, start: &Proposal, level: f64) -> Result<Proposal, Box<RunResult>> {
        let all = self.free_parameters();
        let found = self.some_parameters(start, level, &all)?;
        if found.correction.parameters.timing() == TimingChange::default() {
            return Ok(found);
        }
        let mut start = start.clone();
        start.correction.parameters.drop_timing();
        let others: Vec<_> = all.into_iter().filter(|p| !p.is_of_timing()).collect();
        let as_timed = self.some_parameters(&start, level, &others)?;
        Ok(if found.error < WORTH_TIMING * as_timed.error {
            found
        } else {
            as_timed
        })
    }

    /// The same of `parameters` and the stray light of rows.
    fn some_parameters(
        &mut self,
        start: &Proposal,
        level: f64,
        parameters: &[ModelParameter],
    ) -> Result<Proposal, Box<RunResult>> {
        if parameters.is_empty() && !self.correctable.row_offsets {
            return Ok(start.clone());
        }
        let free = Free {
            parameters,
            has_row_offsets: self.correctable.row_offsets,
        };
        self.parameters(start.correction.clone(), free, level)
    }

    /// The parameters `found` with a blur beside them, if it helps, and without the negligible ones.
    fn completed(
        &mut self,
        given: &Proposal,
        blurred: Proposal,
        mut found: Proposal,
    ) -> Result<Proposal, Box<RunResult>> {
        if found.error > MIN_GAIN * given.error {
            return Ok(blurred.better(found));
        }
        if found.error > EXPLAINED * self.sigma {
            let level = (BLUR_LEVEL * found.error).max(self.sigma);
            let sharp = self.judge(&found.correction, level)?;
            let both = self.blur(&sharp, &BLUR_STEPS, BLUR_BESIDE)?;
            found = found.better(sharp);
            if both.error < BLUR_BESIDE * found.error {
                let level = (BLUR_LEVEL * both.error).max(self.sigma);
                found = found.better(self.all_parameters(&both, level)?);
            }
        }
        let simpler = self.simplified(found)?;
        Ok(blurred.better(simpler))
    }

    /// `found` without its negligible parameters, and without each group of parameters that is not needed to predict
    /// held-out pixels as well. Nearly the same change of a frame may be made by several parameters together.
    fn simplified(&mut self, found: Proposal) -> Result<Proposal, Box<RunResult>> {
        let simplest = without_rows(&found.correction.without_negligible());
        let trial = self.found_anew(simplest, found.level)?;
        let mut found = if trial.error <= SIMPLER * found.error {
            trial
        } else {
            let mut found = found;
            if trial.error < ROWS_ARE_THERE * found.error {
                // Rows may hide even stray light.
                found = self.simpler(without_rows(&found.correction), found)?;
            }
            let remaining = found.correction.without_negligible();
            self.simpler(remaining, found)?
        };
        let is_there = |found: &Proposal, group: &[ModelParameter]| {
            group.iter().any(|p| found.correction.parameters[*p] != 0.0)
        };
        for group in GROUPS {
            let rows = usize::from(found.correction.has_row_offsets());
            let count = rows + GROUPS.iter().filter(|g| is_there(&found, g)).count();
            if count < 2 || !is_there(&found, group) {
                continue;
            }
            let mut correction = found.correction.clone();
            for &parameter in group {
                correction.parameters[parameter] = 0.0;
            }
            found = self.simpler(correction, found)?;
        }
        Ok(found)
    }

    /// The parameters of `correction` that are not zero, found anew, if they predict held-out pixels as well as `found`;
    /// else `found`.
    fn simpler(
        &mut self,
        correction: Correction,
        found: Proposal,
    ) -> Result<Proposal, Box<RunResult>> {
        if correction == found.correction {
            return Ok(found);
        }
        let simpler = self.found_anew(correction, found.level)?;
        Ok(if simpler.error <= SIMPLER * found.error {
            simpler
        } else {
            found
        })
    }

    /// The parameters of `correction` that are not zero, found anew from the noise level `level` on.
    fn found_anew(
        &mut self,
        correction: Correction,
        level: f64,
    ) -> Result<Proposal, Box<RunResult>> {
        let parameters = correction.free_parameters();
        let free = Free {
            parameters: &parameters,
            has_row_offsets: correction.has_row_offsets(),
        };
        self.parameters(correction, free, level)
    }
}

/// The same correction without stray light of rows.
fn without_rows(correction: &Correction) -> Correction {
    Correction {
        row_offsets: vec![0.0; correction.row_offsets.len()],
        ..correction.clone()
    }
}

/// Whether the residuals of the same pixels fall clearly from `before` to `after`: their squares by so many standard
/// errors.
fn is_clear_gain(before: &[f64], after: &[f64], standard_errors: f64) -> bool {
    held_out::rms(after) < MIN_GAIN * held_out::rms(before)
        && choose::gain(before, after) > standard_errors
}
