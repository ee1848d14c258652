//! Self-calibration: the frame corrects its PSF and its camera.
//!
//! A sparse video needs few of a frame's numbers, so the others tell what is wrong with the model. The parameters are
//! found by reconstructions at falling noise levels, each followed by a Gauss–Newton step (`step`); a blur by a search
//! (`search`). A correction is kept only if pixels that no reconstruction has seen clearly confirm it
//! (docs/design/026).

mod calibrator;
mod parameters;
mod psf_error;
mod psf_model;
mod refine;
mod search;
mod step;

pub use parameters::Parameter;

use super::choose::Observer;
use super::frame_data::FrameData;
use super::held_out_check::HeldOutCheck;
use super::{Model, Prior, Problem, RunResult};
use crate::linop::Background;
use crate::measurement::Measurement;
use crate::{Image, PatchSet, Psf};
use calibrator::Calibrator;
use psf_error::Capture;
use search::{BLUR_STEPS, Candidate, Search};
use step::Free;

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
    /// The frame as an ideal camera would have measured it, all pixels included.
    pub measurement: Measurement,
    /// Root mean square of the weighted residuals of held-out pixels before, in counts.
    pub held_out_before: f64,
    /// The same after.
    pub held_out_after: f64,
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
/// First noise level of the search over the light of the frame, and over the noise of the sensor; larger stands larger
/// errors of the model.
const START_LEVEL: (f64, f64) = (0.05, 3.0);
/// Held-out error over `σ` up to which the model explains the frame.
const EXPLAINED: f64 = 1.35;
/// Held-out error of a first sharper PSF over that of the PSF as given, below which a blur alone is searched for.
/// Parameters sought before a blur find others in its place.
const BLUR_ALONE: f64 = 0.8;
/// The same after the parameters, and below which the blur is taken.
const BLUR_BESIDE: f64 = 0.93;
/// Noise level over the held-out error in the search for a blur after the parameters.
const BLUR_LEVEL: f64 = 0.6;
/// Held-out error of a simpler correction over that of the full one, up to which it is preferred.
const SIMPLER: f64 = 1.01;
/// Held-out error of a refined PSF over that before below which the refinement is kept.
const WORTH_REFINING: f64 = 0.97;
/// Rms of the stray light of rows over the mean of the frame below which there is none.
const NEGLIGIBLE_ROW_OFFSET: f64 = 0.005;
/// Held-out error after over that before, above which a correction is not worth it: a real capture has a small gain by a
/// wrong blur.
const MIN_GAIN: f64 = 0.9;
/// Standard errors by which the squared held-out residuals must fall on average.
const MIN_GAIN_IN_ERRORS: f64 = 4.0;
/// The same between different sets of pixels, whose scatter does not cancel.
const MIN_GAIN_ELSEWHERE: f64 = 2.0;

/// A correction that held-out pixels confirm, not applied yet.
pub(super) struct Confirmed {
    calibration: Calibration,
    /// Whether the model then explains the frame.
    pub explains: bool,
}

impl Problem {
    /// Searches for a correction of PSF and camera; `before` is the check of the model as given. Returns it if held-out
    /// pixels confirm it.
    pub(super) fn find_correction(
        &mut self,
        prior: Prior,
        before: &HeldOutCheck,
        observer: &mut Observer,
    ) -> Result<Option<Confirmed>, Box<RunResult>> {
        let prior = match prior.background() {
            Background::None => prior,
            _ => Prior::STANDARD,
        };
        let camera = self.camera.clone();
        let kept = self.measurement.without(&self.excluded);
        let (psfs, capture) = match self.data.psfs().psfs() {
            [psf] => {
                let capture = Capture::new(psf.image());
                let (rows, columns) = (psf.image().rows(), psf.image().columns());
                let anchor = Image::new(rows, columns, capture.anchor.clone());
                let psf = Psf::new(anchor.expect("the size of the capture"));
                (
                    psf.map_or_else(|_| self.data.psfs().clone(), |psf| (&psf).into()),
                    Some(capture),
                )
            }
            _ => (self.data.psfs().clone(), None),
        };
        let mut search = Search {
            calibrator: Calibrator::new(&camera, &psfs, kept, prior),
            sigma: self.sigma,
            observer,
        };
        let given = Candidate {
            correction: search.calibrator.uncorrected(),
            level: self.sigma,
            held_out: before.held_out.clone(),
        };
        let light = super::rms(self.measurement.image().data());
        let found = search.find(&given, light, capture.as_ref())?;
        if found.error() > MIN_GAIN * given.error()
            || !is_clearly_better(&given.held_out, &found.held_out)
        {
            return Ok(None);
        }
        let free: Vec<Parameter> = Parameter::ALL
            .into_iter()
            .filter(|p| found.correction.parameters[*p] != 0.0)
            .collect();
        let (repeated, standard_errors) = search.repeat(&found, &free)?;
        if !is_confirmed(&given.held_out, &repeated.held_out) {
            return Ok(None);
        }
        let parameters = free.iter().zip(standard_errors);
        let correction = found.correction.clone();
        Ok(Some(Confirmed {
            calibration: Calibration {
                parameters: parameters
                    .map(|(&parameter, standard_error)| FoundParameter {
                        parameter,
                        value: correction.parameters[parameter],
                        standard_error,
                    })
                    .collect(),
                row_offsets: if correction.has_row_offsets() {
                    correction.row_offsets.clone()
                } else {
                    Vec::new()
                },
                psf_refinement: correction.refinement(
                    search
                        .calibrator
                        .model_psfs(&correction.parameters)
                        .central(),
                ),
                psfs: search.calibrator.psfs(&correction),
                measurement: search.calibrator.corrected(&self.measurement, &correction),
                held_out_before: given.error(),
                held_out_after: found.error(),
            },
            explains: found.error() < EXPLAINED * self.sigma,
        }))
    }

    /// Applies a correction to PSF and frame, with the pixels `excluded` left out.
    pub(super) fn apply_correction(&mut self, confirmed: Confirmed, excluded: Vec<bool>) {
        self.measurement = confirmed.calibration.measurement.clone();
        let model = Model::new(&self.camera, confirmed.calibration.psfs.clone());
        self.data = FrameData::new(&model, &self.measurement);
        self.calibration = Some(confirmed.calibration);
        self.exclude(excluded);
    }
}

impl Search<'_, '_, '_> {
    /// The correction that predicts held-out pixels best; `light` is the root mean square of the frame.
    fn find(
        &mut self,
        given: &Candidate,
        light: f64,
        capture: Option<&Capture>,
    ) -> Result<Candidate, Box<RunResult>> {
        let Some(capture) = capture else {
            return self.find_parameters(given, light);
        };
        if capture.noise.is_some()
            && let Some(refined) = self.refine(given, capture, true)?
            && refined.error() < WORTH_REFINING * given.error()
        {
            return Ok(refined);
        }
        let mut found = self.find_parameters(given, light)?;
        if found.error() > EXPLAINED * self.sigma {
            for start in [found.clone(), given.clone()] {
                if let Some(refined) = self.refine(&start, capture, false)?
                    && refined.error() < WORTH_REFINING * found.error()
                {
                    found = refined;
                }
            }
        }
        Ok(found)
    }

    /// The parameters that predict held-out pixels best.
    fn find_parameters(
        &mut self,
        given: &Candidate,
        light: f64,
    ) -> Result<Candidate, Box<RunResult>> {
        let blurred = self.blur(given, &BLUR_STEPS[..1], BLUR_ALONE)?;
        if blurred.error() < EXPLAINED * self.sigma {
            return Ok(blurred);
        }
        let all = Free {
            parameters: &FREE,
            has_row_offsets: true,
        };
        let start = (START_LEVEL.0 * light).max(START_LEVEL.1 * self.sigma);
        let mut found = self.parameters(given.correction.clone(), all, start)?;
        if found.error() > EXPLAINED * self.sigma {
            let level = (BLUR_LEVEL * found.error()).max(self.sigma);
            let sharp = self.judge(&found.correction, level)?;
            let both = self.blur(&sharp, &BLUR_STEPS, BLUR_BESIDE)?;
            found = found.better(sharp);
            if both.error() < BLUR_BESIDE * found.error() {
                let level = (BLUR_LEVEL * both.error()).max(self.sigma);
                found = found.better(self.parameters(both.correction, all, level)?);
            }
        }
        let simpler = self.simplified(&found)?;
        Ok(blurred.better(simpler))
    }

    /// `found` without its negligible parameters, if it predicts held-out pixels as well. Nearly the same change of a
    /// frame may be made by several parameters together.
    fn simplified(&mut self, found: &Candidate) -> Result<Candidate, Box<RunResult>> {
        let mut correction = found.correction.clone();
        let free: Vec<Parameter> = FREE
            .into_iter()
            .filter(|p| correction.parameters[*p].abs() > p.negligible())
            .collect();
        let negligible = NEGLIGIBLE_ROW_OFFSET * self.calibrator.mean();
        let has_row_offsets = super::choose::rms(&correction.row_offsets) > negligible;
        if free.len() == FREE.len() && has_row_offsets {
            return Ok(found.clone());
        }
        for parameter in FREE.into_iter().filter(|p| !free.contains(p)) {
            correction.parameters[parameter] = 0.0;
        }
        if !has_row_offsets {
            correction.row_offsets.fill(0.0);
        }
        let free = Free {
            parameters: &free,
            has_row_offsets,
        };
        let simpler = self.parameters(correction, free, found.level)?;
        Ok(if simpler.error() <= SIMPLER * found.error() {
            simpler
        } else {
            found.clone()
        })
    }
}

/// Whether residuals of other held-out pixels than those of `before` are as clearly smaller.
fn is_confirmed(before: &[f64], after: &[f64]) -> bool {
    let (mean_before, error_before) = mean_square(before);
    let (mean_after, error_after) = mean_square(after);
    mean_after < MIN_GAIN * MIN_GAIN * mean_before
        && mean_before - mean_after > MIN_GAIN_ELSEWHERE * error_before.hypot(error_after)
}

/// Whether the squares of paired residuals fall clearly.
fn is_clearly_better(before: &[f64], after: &[f64]) -> bool {
    let falls: Vec<f64> = before
        .iter()
        .zip(after)
        .map(|(b, a)| b * b - a * a)
        .collect();
    let count = falls.len().max(2) as f64;
    let mean = falls.iter().sum::<f64>() / count;
    let variance = falls.iter().map(|f| (f - mean).powi(2)).sum::<f64>() / (count - 1.0);
    mean > MIN_GAIN_IN_ERRORS * (variance / count).sqrt()
}

/// Mean of the squares, and its standard error.
fn mean_square(residuals: &[f64]) -> (f64, f64) {
    let count = residuals.len().max(2) as f64;
    let mean = residuals.iter().map(|r| r * r).sum::<f64>() / count;
    let variance = residuals
        .iter()
        .map(|r| (r * r - mean).powi(2))
        .sum::<f64>()
        / (count - 1.0);
    (mean, (variance / count).sqrt())
}
