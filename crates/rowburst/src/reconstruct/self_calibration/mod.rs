//! Self-calibration: the frame corrects its PSF and its camera.
//!
//! A sparse video needs few of a frame's numbers, so the others tell what is wrong with the model. The parameters are
//! found by reconstructions at falling noise levels, each followed by a Gauss–Newton step (`step`); a blur by a search
//! (`search`); the PSF itself by `refine`. Judging pixels, which no reconstruction sees, choose among the corrections.
//! Confirming pixels, which no part of the search sees, must confirm the choice. Several frames of one camera tell more
//! than one (docs/design/026).

mod calibrator;
mod decision;
mod parameters;
mod psf_error;
mod psf_floor;
mod psf_model;
mod refine;
mod request;
mod row_offsets;
mod search;
mod step;

pub use parameters::ModelParameter;
pub use request::SelfCalibration;

use super::Observer;
use super::frame_data::FrameData;
use super::held_out_check::HeldOutCheck;
use super::{Model, Options, Prior, Problem, RunResult};
use calibrator::Calibrator;
use decision::{MAX_MISFIT, MIN_GAIN};
use psf_error::Capture;
use request::Correctable;
use rowburst_core::linop::Background;
use rowburst_core::{Cancel, Result};
use rowburst_optics::measurement::Measurement;
use rowburst_optics::{Camera, Image, PatchSet, RollingShutter};
use rowburst_solve::StopReason;
use rowburst_solve::admm::Progress;
use search::{Proposal, Search};
use std::ops::ControlFlow;
use tracing::info;

/// A correction of PSF and camera, which held-out pixels have confirmed or the PSF itself shows.
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
    /// Gain of each pixel, `[y, x]`, by vignetting and by the gains of the halves.
    pub gain: Vec<f32>,
    /// Stray light of each pixel, `[y, x]`, in counts.
    pub offset: Vec<f32>,
    /// Errors of held-out pixels; `None`: the correction was read from the PSF alone.
    pub held_out: Option<HeldOutErrors>,
    /// `W(b − A v)/σ` of the frame, `[y, x]`, of the best reconstruction without a correction; `None`: of several frames,
    /// and where only the PSF's floor or offsets of rows were subtracted.
    pub residual_before: Option<Image>,
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

    /// The camera with the timing that was found.
    #[must_use]
    pub fn corrected_camera(&self, camera: &Camera) -> Camera {
        let value = |parameter| {
            let found = self.parameters.iter().find(|p| p.parameter == parameter);
            found.map_or(0.0, |p| p.value)
        };
        camera.retimed(ModelParameter::timing(value))
    }
}

/// Root mean squares of the residuals of held-out pixels over the noise of the sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldOutErrors {
    /// Of the best reconstruction without a correction.
    pub before: f64,
    /// Of that with it.
    pub after: f64,
}

/// A parameter that the frame, or the PSF itself, has told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundParameter {
    /// Which one.
    pub parameter: ModelParameter,
    /// Its value; see [`ModelParameter`] for the unit.
    pub value: f64,
    /// Its standard error.
    pub standard_error: f64,
}

/// Frames of one camera with the PSFs as given.
pub(super) struct Frames<'f> {
    pub camera: &'f Camera,
    pub shutter: &'f RollingShutter,
    pub cancel: &'f Cancel,
    pub psfs: &'f PatchSet,
    /// The frames without foreign pixels.
    pub measurements: &'f [Measurement],
    /// Noise of a pixel with weight 1, in counts.
    pub sigma: f64,
    /// Error of held-out pixels of the model as given, in counts.
    pub held_out_error: f64,
    correctable: Correctable,
}

/// A correction that held-out pixels confirm, not applied yet.
pub(super) struct Finding {
    pub calibration: Calibration,
    /// `A v` at all pixels of the best reconstruction without a correction; `None`: there are several frames.
    pub light_before: Option<Vec<f32>>,
    /// Errors of held-out pixels.
    pub held_out: HeldOutErrors,
    /// Whether the model then explains the frames.
    pub explains: bool,
}

impl Finding {
    /// Error of held-out pixels after the correction over that before.
    pub fn error_ratio(&self) -> f64 {
        self.held_out.after / self.held_out.before
    }
}

impl Frames<'_> {
    /// Searches for a correction of PSF and camera. Returns it if held-out pixels confirm it.
    pub fn calibrate(
        &self,
        prior: Prior,
        observer: &mut Observer,
    ) -> std::result::Result<Option<Finding>, Box<RunResult>> {
        let prior = match prior.background() {
            Background::None => prior,
            _ => Prior::STANDARD,
        };
        let capture = match self.psfs.psfs() {
            [psf] => Some(Capture::new(psf)),
            _ => None,
        };
        let anchor = capture.as_ref().map(|capture| &capture.anchor);
        let anchor = anchor.filter(|anchor| self.correctable.psf && *anchor != self.psfs.central());
        let mut search = Search {
            calibrator: Calibrator::new(
                self.shutter,
                self.camera,
                self.cancel,
                self.psfs,
                anchor,
                self.measurements,
                prior,
            ),
            sigma: self.sigma,
            correctable: self.correctable,
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
            info!("self-calibration: nothing found");
            return Ok(None);
        }
        let finding = search.confirm(&found, given.error, anchor.is_some())?;
        match &finding {
            Some(Finding { held_out, .. }) => info!(
                "self-calibration: confirmed, held-out error {:.3} σ before and {:.3} σ after",
                held_out.before, held_out.after
            ),
            None => info!("self-calibration: not confirmed"),
        }
        Ok(finding)
    }
}

/// One correction of PSF and camera from several frames of the same camera, which tell more than one. `None`: the model
/// explains them ([`SelfCalibration::AUTO`]), held-out pixels do not confirm a correction, all frames are dense or too
/// small to tell and the PSF shows no floor, or the observer stopped it.
///
/// # Errors
/// Those of [`Problem::with_model`].
pub fn calibrate(
    given: &Model,
    measurements: &[Measurement],
    options: Options,
    observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
) -> Result<Option<Calibration>> {
    let asked = options.self_calibration;
    let mut floor = measurements
        .first()
        .and_then(|first| asked.psf_floor(given.psfs(), first.image().data().len()));
    let without = floor
        .as_ref()
        .map(|floor| Model::new(given.camera(), floor.psfs.clone()).with_cancel(given.cancel()));
    let mut model = without.as_ref().unwrap_or(given);
    let Some(mut checks) = check_each(model, measurements, options, observer)? else {
        return Ok(None);
    };
    if checks.is_empty() {
        return Ok(None);
    }
    if floor.is_some() && !are_explained(&checks) {
        let Some(as_given) = check_each(given, measurements, options, observer)? else {
            return Ok(None);
        };
        if are_explained(&as_given) {
            (model, checks, floor) = (given, as_given, None);
        }
    }
    checks.retain(|check| !check.is_dense);
    if checks.is_empty() || are_explained(&checks) && !asked.is_on() {
        return Ok(floor);
    }
    let prior = options.prior.unwrap_or(Prior::STANDARD);
    let rms = |of: fn(&FrameCheck) -> f64| {
        (checks.iter().map(|c| of(c).powi(2)).sum::<f64>() / checks.len() as f64).sqrt()
    };
    let frames = Frames {
        camera: model.camera(),
        shutter: model.shutter(),
        cancel: model.cancel(),
        psfs: model.psfs(),
        sigma: rms(|check| check.sigma),
        held_out_error: rms(|check| check.held_out_error),
        correctable: asked.correctable,
        measurements: &checks
            .into_iter()
            .map(|check| check.measurement)
            .collect::<Vec<_>>(),
    };
    let Ok(finding) = frames.calibrate(prior, observer) else {
        return Ok(None);
    };
    Ok(match (floor, finding) {
        (Some(floor), Some(finding)) => Some(floor.followed_by(finding.calibration)),
        (floor, finding) => finding.map(|finding| finding.calibration).or(floor),
    })
}

/// The check of each frame that can tell; `None`: the observer stopped one.
fn check_each(
    model: &Model,
    measurements: &[Measurement],
    options: Options,
    observer: &mut Observer,
) -> Result<Option<Vec<FrameCheck>>> {
    let prior = options.prior.unwrap_or(Prior::STANDARD);
    let mut checks = Vec::new();
    for measurement in measurements {
        let mut problem = Problem::with_model(model, measurement, options)?;
        match problem.check_alone(prior, observer) {
            Ok(check) => checks.extend(check),
            Err(_) => return Ok(None),
        }
    }
    Ok(Some(checks))
}

fn are_explained(checks: &[FrameCheck]) -> bool {
    checks.iter().all(|check| check.is_explained)
}

/// How well the model as given explains a frame.
struct FrameCheck {
    /// The frame without the pixels that stand out.
    measurement: Measurement,
    sigma: f64,
    held_out_error: f64,
    is_explained: bool,
    is_dense: bool,
}

impl Problem {
    /// The check of a frame among others; `None` where it cannot tell.
    fn check_alone(
        &mut self,
        prior: Prior,
        observer: &mut Observer,
    ) -> std::result::Result<Option<FrameCheck>, Box<RunResult>> {
        self.resolve_tau_rule(observer)?;
        if !self.is_checked() {
            return Ok(None);
        }
        let mut check = self.held_out_check(prior, observer)?;
        if !self.is_explained(&check) {
            let found = self.find_foreign(observer)?;
            self.exclude(found.pixels);
            check = self.held_out_check(prior, observer)?;
        }
        Ok(Some(FrameCheck {
            measurement: self.measurement.without(&self.excluded),
            sigma: self.sigma,
            held_out_error: check.held_out_rms,
            is_explained: self.is_explained(&check),
            is_dense: self.is_dense,
        }))
    }

    /// Searches for a correction of PSF and camera; `before` is the check of the model as given. Returns it if held-out
    /// pixels confirm it.
    pub(super) fn find_correction(
        &self,
        prior: Prior,
        before: &HeldOutCheck,
        observer: &mut Observer,
    ) -> std::result::Result<Option<Finding>, Box<RunResult>> {
        let frames = Frames {
            camera: &self.camera,
            shutter: self.data.shutter(),
            cancel: self.data.cancel(),
            psfs: self.data.psfs(),
            measurements: &[self.measurement.without(&self.excluded)],
            sigma: self.sigma,
            held_out_error: before.held_out_rms,
            correctable: self.options.self_calibration.correctable,
        };
        frames.calibrate(prior, observer)
    }

    /// The frame with `psfs`.
    pub(super) fn data_with(&self, psfs: PatchSet) -> FrameData {
        let model = Model::new(&self.camera, psfs).with_cancel(self.data.cancel());
        self.options.frame_data(&model, &self.measurement)
    }

    /// The PSF without the floor that it shows, where a floor may be corrected.
    pub(super) fn find_psf_floor(&self) -> Option<Calibration> {
        let pixels = self.measurement.image().data().len();
        let asked = self.options.self_calibration;
        asked.psf_floor(self.data.psfs(), pixels)
    }

    /// All that was corrected of PSF and camera.
    pub(super) fn whole_calibration(&self) -> Option<Calibration> {
        match (&self.psf_floor, &self.calibration) {
            (Some(floor), Some(found)) => Some(floor.followed_by(found.clone())),
            (Some(only), None) | (None, Some(only)) => Some(only.clone()),
            (None, None) => None,
        }
    }

    /// Applies a correction to PSF and frame, with the pixels `excluded` left out.
    pub(super) fn apply_correction(&mut self, finding: Finding, excluded: Vec<bool>) {
        let mut calibration = finding.calibration;
        let image = self.measurement.image();
        calibration.residual_before = finding.light_before.map(|light| {
            let weights = self.measurement.weights();
            let normalised = image
                .data()
                .iter()
                .zip(light)
                .enumerate()
                .map(|(i, (b, a))| {
                    let weight = weights.map_or(1.0, |w| f64::from(w[i]));
                    (weight * (f64::from(*b) - f64::from(a)) / self.sigma) as f32
                });
            Image::new(image.rows(), image.columns(), normalised.collect())
                .expect("the size of the frame")
        });
        self.measurement = calibration.corrected(&self.measurement);
        self.camera = calibration.corrected_camera(&self.camera);
        self.data = self.data_with(calibration.psfs.clone());
        self.calibration = Some(calibration);
        self.exclude(excluded);
    }
}
