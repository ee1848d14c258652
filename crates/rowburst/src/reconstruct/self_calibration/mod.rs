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
mod psf_model;
mod refine;
mod request;
mod search;
mod step;

pub use parameters::ModelParameter;
pub use request::SelfCalibration;

use super::Observer;
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
    /// Gain of each pixel, `[y, x]`, by vignetting and by the gains of the halves.
    pub gain: Vec<f32>,
    /// Stray light of each pixel, `[y, x]`, in counts.
    pub offset: Vec<f32>,
    /// Root mean square of the residuals of held-out pixels over the noise of the sensor, of the best reconstruction without
    /// a correction.
    pub held_out_before: f64,
    /// The same after.
    pub held_out_after: f64,
    /// `W(b − A v)/σ` of the frame, `[y, x]`, of the best reconstruction without a correction; `None`: of several frames.
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

/// A parameter that the frame has told.
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
            Some(Finding { calibration, .. }) => info!(
                "self-calibration: confirmed, held-out error {:.3} σ before and {:.3} σ after",
                calibration.held_out_before, calibration.held_out_after
            ),
            None => info!("self-calibration: not confirmed"),
        }
        Ok(finding)
    }
}

/// One correction of PSF and camera from several frames of the same camera, which tell more than one. `None`: the model
/// explains them ([`SelfCalibration::AUTO`]), held-out pixels do not confirm a correction, all frames are dense or too
/// small to tell, or the observer stopped it.
///
/// # Errors
/// Those of [`Problem::with_model`].
pub fn calibrate(
    model: &Model,
    measurements: &[Measurement],
    options: Options,
    observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
) -> Result<Option<Calibration>> {
    let prior = options.prior.unwrap_or(Prior::STANDARD);
    let mut checks = Vec::new();
    for measurement in measurements {
        let mut problem = Problem::with_model(model, measurement, options)?;
        match problem.check_alone(prior, observer) {
            Ok(check) => checks.extend(check),
            Err(_) => return Ok(None),
        }
    }
    let is_explained = checks.iter().all(|check| check.is_explained);
    if checks.is_empty() || is_explained && !options.self_calibration.is_on() {
        return Ok(None);
    }
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
        correctable: options.self_calibration.correctable,
        measurements: &checks
            .into_iter()
            .map(|check| check.measurement)
            .collect::<Vec<_>>(),
    };
    let finding = frames.calibrate(prior, observer);
    Ok(finding.ok().flatten().map(|finding| finding.calibration))
}

/// How well the model as given explains a frame.
struct FrameCheck {
    /// The frame without the pixels that stand out.
    measurement: Measurement,
    sigma: f64,
    held_out_error: f64,
    is_explained: bool,
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
        Ok((!self.is_dense).then(|| FrameCheck {
            measurement: self.measurement.without(&self.excluded),
            sigma: self.sigma,
            held_out_error: check.held_out_rms,
            is_explained: self.is_explained(&check),
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
        let model = Model::new(&self.camera, calibration.psfs.clone());
        let model = model.with_cancel(self.data.cancel());
        self.data = self.options.frame_data(&model, &self.measurement);
        self.calibration = Some(calibration);
        self.exclude(excluded);
    }
}
