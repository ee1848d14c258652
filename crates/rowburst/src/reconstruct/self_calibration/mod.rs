//! Self-calibration: the frame corrects its PSF and its camera.
//!
//! A sparse video needs few of a frame's numbers, so the others tell what is wrong with the model. The parameters are
//! found by reconstructions at falling noise levels, each followed by a Gauss–Newton step (`step`); a blur by a search
//! (`search`); the PSF itself by `refine`. Judging pixels, which no reconstruction sees, choose among the corrections.
//! Confirming pixels, which no part of the search sees, must confirm the choice. Several frames of one camera tell more
//! than one (docs/design/026).

mod calibrator;
mod parameters;
mod psf_error;
mod psf_model;
mod refine;
mod search;
mod step;

pub use parameters::Parameter;

use super::choose::{self, Observer};
use super::frame_data::FrameData;
use super::held_out_check::HeldOutCheck;
use super::{Model, Prior, Problem, RunResult};
use crate::linop::Background;
use crate::measurement::Measurement;
use crate::{Camera, Image, PatchSet, Psf, RollingShutter};
use calibrator::{Calibrator, Trial};
use psf_error::Capture;
use psf_model::PsfModel;
use search::{BLUR_STEPS, JUDGED_ITERATIONS, Proposal, Search, confirming, judging};
use step::{Free, step};

/// When a frame corrects its PSF and its camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SelfCalibration {
    /// Never.
    Off,
    /// Where the model does not explain the frame.
    #[default]
    Auto,
    /// Always.
    On,
}

impl SelfCalibration {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Off, Self::Auto, Self::On];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Auto => "auto",
            Self::On => "on",
        }
    }
}

/// A correction of PSF and camera that held-out pixels have confirmed.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The parameters that differ from what was given.
    pub parameters: Vec<FoundParameter>,
    /// Stray light of each row of the frame, in counts; empty: none.
    pub row_offsets: Vec<f64>,
    /// Rms change of the PSF's pixels by its refinement over the PSF's rms; `None`: it was not refined.
    pub psf_refinement: Option<f64>,
    /// The corrected PSFs.
    pub psfs: PatchSet,
    /// Gain of each pixel, `[y, x]`, 1 at the centre: what vignetting leaves of the light.
    pub gain: Vec<f32>,
    /// Stray light of each pixel, `[y, x]`, in counts.
    pub offset: Vec<f32>,
    /// Root mean square of the weighted residuals of held-out pixels, in counts, of the best reconstruction without a
    /// correction.
    pub held_out_before: f64,
    /// The same after.
    pub held_out_after: f64,
}

impl Calibration {
    /// A frame as an ideal camera would have measured it.
    ///
    /// # Panics
    /// If the frame has another size.
    #[must_use]
    pub fn corrected(&self, measurement: &Measurement) -> Measurement {
        measurement.adjusted(&self.gain, &self.offset)
    }
}

/// A parameter that the frame has told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundParameter {
    /// Which one.
    pub parameter: Parameter,
    /// Its value; see [`Parameter`] for the unit.
    pub value: f64,
    /// Its standard error.
    pub standard_error: f64,
}

/// The parameters that steps find together.
const FREE: [Parameter; 9] = [
    Parameter::Scale,
    Parameter::Rotation,
    Parameter::Anisotropy,
    Parameter::Shear,
    Parameter::Floor,
    Parameter::Offset,
    Parameter::SlopeX,
    Parameter::SlopeY,
    Parameter::Vignetting,
];
const ALL_FREE: Free = Free {
    parameters: &FREE,
    has_row_offsets: true,
};
/// First noise level of the search over the light of the frames; larger stands larger errors of the model.
const START_LEVEL: f64 = 0.05;
/// The same over the noise of the sensor.
const MIN_START_LEVEL: f64 = 3.0;
/// Error of the judging pixels over `σ` up to which the model explains the frame.
const EXPLAINED: f64 = 1.35;
/// Error of the judging pixels of a first sharper PSF over that of the PSF as given, below which a blur alone is searched for.
/// Parameters sought before a blur find others in its place.
const BLUR_ALONE: f64 = 0.8;
/// The same below which the parameters are sought with that blur: other faults look like a blur, too.
const BLUR_FIRST: f64 = 0.5;
/// The same after the parameters, and below which the blur is taken.
const BLUR_BESIDE: f64 = 0.93;
/// Noise level over that error in the search for a blur after the parameters.
const BLUR_LEVEL: f64 = 0.6;
/// Error of the judging pixels of a simpler correction over that of the full one, up to which it is preferred.
const SIMPLER: f64 = 1.01;
/// Error of the judging pixels with a refined PSF over that before, below which the refinement is kept.
const WORTH_REFINING: f64 = 0.97;
/// The same over that with parameters, below which these were ghosts of an error of the PSF itself.
const REFINED_ALONE: f64 = 0.8;
/// Error of the judging pixels after the parameters over that before, above which their PSF is not refined.
const PARAMETERS_FAIL: f64 = 0.95;
/// Rms of the stray light of rows over the mean of the frames below which there is none.
const NEGLIGIBLE_ROW_OFFSET: f64 = 0.005;
/// Error of held-out pixels after over that before, above which a correction is not worth it: a real capture has a small
/// gain by a wrong blur.
const MIN_GAIN: f64 = 0.9;
/// Error of held-out pixels after a correction over the contrast of the frames, above which it is not plausible: the PSF
/// belongs to another diffuser.
const MAX_MISFIT: f64 = 0.2;
/// The same after the parameters, above which no more is tried.
const HOPELESS_MISFIT: f64 = 0.3;
/// Standard errors of the paired differences by which the squared residuals of the judging pixels must fall.
const MIN_JUDGING_GAIN: f64 = 4.0;
/// The same of the confirming pixels, among which nothing was chosen.
const MIN_CONFIRMING_GAIN: f64 = 2.0;
/// Noise level of the reconstruction without a correction over its held-out error, as without self-calibration.
const EFFECTIVE_SIGMA: f64 = 0.85;

/// Frames of one camera with the PSFs as given.
pub(super) struct Frames<'f> {
    pub camera: &'f Camera,
    pub shutter: &'f RollingShutter,
    pub psfs: &'f PatchSet,
    /// The frames without foreign pixels.
    pub measurements: &'f [Measurement],
    /// Noise of a pixel with weight 1, in counts.
    pub sigma: f64,
    /// Error of held-out pixels of the model as given, in counts.
    pub held_out_error: f64,
}

/// A correction that held-out pixels confirm, not applied yet.
pub(super) struct Finding {
    pub calibration: Calibration,
    /// Whether the model then explains the frames.
    pub explains: bool,
}

impl Finding {
    /// Error of held-out pixels after the correction over that before.
    pub fn error_ratio(&self) -> f64 {
        self.calibration.held_out_after / self.calibration.held_out_before
    }
}

impl Frames<'_> {
    /// Searches for a correction of PSF and camera. Returns it if held-out pixels confirm it.
    pub fn calibrate(
        &self,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<Option<Finding>, Box<RunResult>> {
        let prior = match prior.background() {
            Background::None => prior,
            _ => Prior::STANDARD,
        };
        let capture = match self.psfs.psfs() {
            [psf] => Some(Capture::new(psf.image())),
            _ => None,
        };
        let anchor = capture.as_ref().and_then(|capture| {
            let image = self.psfs.central().image();
            let anchor = Image::new(image.rows(), image.columns(), capture.anchor.clone());
            capture.noise.as_ref()?;
            Psf::new(anchor.expect("the size of the capture")).ok()
        });
        let mut search = Search {
            calibrator: Calibrator::new(
                self.shutter,
                self.camera,
                self.psfs,
                anchor.as_ref(),
                self.measurements,
                prior,
            ),
            sigma: self.sigma,
            observer,
        };
        let given = Proposal {
            correction: search.calibrator.uncorrected(),
            level: self.sigma,
            error: self.held_out_error,
        };
        let squares = self.measurements.iter();
        let squares = squares.map(|m| super::rms(m.image().data()).powi(2));
        let light = (squares.sum::<f64>() / self.measurements.len() as f64).sqrt();
        let found = search.find(&given, light, capture.as_ref())?;
        let is_identity = found.correction.is_identity() && anchor.is_none();
        let limit = (MIN_GAIN * given.error).min(MAX_MISFIT * search.calibrator.contrast());
        if is_identity || found.error > limit {
            return Ok(None);
        }
        search.confirm(&found, given.error, anchor.is_some())
    }
}

impl Problem {
    /// Searches for a correction of PSF and camera; `before` is the check of the model as given. Returns it if held-out
    /// pixels confirm it.
    pub(super) fn find_correction(
        &self,
        prior: Prior,
        before: &HeldOutCheck,
        observer: &mut Observer,
    ) -> Result<Option<Finding>, Box<RunResult>> {
        let frames = Frames {
            camera: &self.camera,
            shutter: self.data.shutter(),
            psfs: self.data.psfs(),
            measurements: &[self.measurement.without(&self.excluded)],
            sigma: self.sigma,
            held_out_error: before.held_out_rms,
        };
        frames.calibrate(prior, observer)
    }

    /// Applies a correction to PSF and frame, with the pixels `excluded` left out.
    pub(super) fn apply_correction(&mut self, calibration: Calibration, excluded: Vec<bool>) {
        self.measurement = calibration.corrected(&self.measurement);
        let model = Model::new(&self.camera, calibration.psfs.clone());
        self.data = FrameData::new(&model, &self.measurement);
        self.calibration = Some(calibration);
        self.exclude(excluded);
    }
}

impl Search<'_, '_, '_> {
    /// The correction that predicts held-out pixels best; `light` is the root mean square of the frame.
    fn find(
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
            if let Some(refined) = self.refine(given, capture, limit, true)?
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
            let limit = REFINED_ALONE * found.error;
            if let Some(refined) = self.refine(given, capture, limit, false)?
                && refined.error < limit
            {
                // The parameters were ghosts of an error of the PSF itself.
                return Ok(refined);
            }
        }
        let found = self.completed(given, blurred, found)?;
        if found.error > EXPLAINED * self.sigma && found.error < PARAMETERS_FAIL * given.error {
            let limit = WORTH_REFINING * found.error;
            if let Some(refined) = self.refine(&found, capture, limit, false)?
                && refined.error < limit
            {
                return Ok(refined);
            }
        }
        Ok(found)
    }

    /// Compares `found` with the PSF as given, on the judging and on the confirming pixels. `given_error` is the held-out
    /// error without a correction at the noise of the sensor.
    fn confirm(
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
        if !is_clear_gain(&judged_before, &judged_after, MIN_JUDGING_GAIN)
            || !is_clear_gain(
                &confirming(&before),
                &confirming(&after),
                MIN_CONFIRMING_GAIN,
            )
        {
            return Ok(None);
        }
        let correction = &found.correction;
        let parameters: Vec<Parameter> = Parameter::ALL
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
            refine::relative_change(&model, psfs.central())
        });
        let (gain, offset) = calibrator.pixels(correction);
        let held_out =
            |trials: &[Trial]| choose::rms(&[judging(trials), confirming(trials)].concat());
        let held_out_after = held_out(&after);
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
                held_out_before: held_out(&before),
                held_out_after,
            },
            explains: held_out_after < EXPLAINED * self.sigma,
        }))
    }

    /// All parameters together, from those of `start` on.
    fn find_parameters(
        &mut self,
        start: &Proposal,
        light: f64,
    ) -> Result<Proposal, Box<RunResult>> {
        let level = (START_LEVEL * light).max(MIN_START_LEVEL * self.sigma);
        self.parameters(start.correction.clone(), ALL_FREE, level)
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
                found = found.better(self.parameters(both.correction, ALL_FREE, level)?);
            }
        }
        let simpler = self.simplified(&found)?;
        Ok(blurred.better(simpler))
    }

    /// `found` without its negligible parameters, if it predicts held-out pixels as well. Nearly the same change of a
    /// frame may be made by several parameters together.
    fn simplified(&mut self, found: &Proposal) -> Result<Proposal, Box<RunResult>> {
        let mut correction = found.correction.clone();
        let free: Vec<Parameter> = FREE
            .into_iter()
            .filter(|p| correction.parameters[*p].abs() > p.negligible())
            .collect();
        let negligible = NEGLIGIBLE_ROW_OFFSET * self.calibrator.mean();
        let has_row_offsets = choose::rms(&correction.row_offsets) > negligible;
        if free.len() == FREE.len() && has_row_offsets {
            return Ok(found.clone());
        }
        for parameter in Parameter::ALL {
            if correction.parameters[parameter].abs() <= parameter.negligible() {
                correction.parameters[parameter] = 0.0;
            }
        }
        if !has_row_offsets {
            correction.row_offsets.fill(0.0);
        }
        let free = Free {
            parameters: &free,
            has_row_offsets,
        };
        let simpler = self.parameters(correction, free, found.level)?;
        Ok(if simpler.error <= SIMPLER * found.error {
            simpler
        } else {
            found.clone()
        })
    }
}

/// Whether the residuals of the same pixels fall clearly from `before` to `after`: their squares by so many standard
/// errors.
fn is_clear_gain(before: &[f64], after: &[f64], standard_errors: f64) -> bool {
    choose::rms(after) < MIN_GAIN * choose::rms(before)
        && choose::gain(before, after) > standard_errors
}
