//! Is a set-up good? One frame of a light of known frequency, behind the diffuser, tells.
//!
//! The light is one point that blinks. Its reconstructed trace has the known frequency where the row time is right, and
//! is steady where the readout order is; the fit tells whether PSF and noise are.

use crate::event::Observer;
use crate::options::UserOptions;
use crate::setup::{Frame, Setup};
use crate::solve::solve;
use crate::traces::TraceRequest;
use crate::{CompletedTask, short};
use rowburst::calibrate::psf::statistics;
use rowburst::reconstruct::{Options, Verdict};
use rowburst::{Camera, Cancel, Error, ErrorKind, Parameter, Result, Shutter};
use rowburst_io::{Calibration, Experiment, read_metadata};
use serde::Serialize;
use std::path::Path;
use std::time::Instant;

/// The prior, so that none is searched for.
const PRIOR: &str = "tv+0.5*tdiff+support";
/// Largest part of the pixels that may be saturated.
const MAX_SATURATED: f64 = 1e-3;
/// Smallest contrast of the PSF: a point source of one colour gives 0.9 to 1.
const MIN_CONTRAST: f64 = 0.5;
/// Largest relative error of the row time, where the trace's frequency is known better than that.
const MAX_ROW_TIME_ERROR: f64 = 0.01;
/// Standard errors of the frequency that are taken for no error.
const STANDARD_ERRORS: f64 = 3.0;
/// Smallest part of the light's variance that one frequency explains.
const MIN_SHARE: f64 = 0.6;
/// Difference of that part between two readout orders that means nothing.
const SHARE_TOLERANCE: f64 = 0.05;
/// Largest χ² of the residual of a model that fits, and how many of its standard errors are taken for chance: the
/// limits of the verdict of the fit.
const MAX_CHI_SQUARED: f64 = 1.25;
const CHI_SQUARED_ERRORS: f64 = 4.0;
/// Largest part of the frame rate at which a blinking light is told from its alias.
const MAX_FREQUENCY_PART: f64 = 0.45;

/// One finding of the check.
#[derive(Debug, Clone, Serialize)]
pub struct CheckItem {
    /// Its name: `saturation`, `contrast`, `row-time`, `shutter` or `model`.
    pub name: &'static str,
    /// Whether it is within its limit.
    pub passed: bool,
    /// What was measured; `None` where the frame does not show it.
    pub value: Option<f64>,
    /// The limit.
    pub limit: f64,
    /// What was measured, in words.
    pub found: String,
    /// What to do where it failed.
    pub remedy: &'static str,
}

/// The check of a set-up.
#[derive(Debug, Clone, Serialize)]
pub struct SetupCheck {
    /// Whether every finding is within its limit.
    pub passed: bool,
    /// The findings.
    pub checks: Vec<CheckItem>,
}

/// What is checked.
pub struct CheckParams<'a> {
    /// The experiment file, with a PSF.
    pub experiment: &'a Path,
    /// A frame of one blinking point behind the diffuser.
    pub frame: &'a Path,
    /// Files that replace those of the experiment.
    pub calibration: Calibration,
    /// Frequency of the light in hertz.
    pub frequency_hz: f64,
    /// Stops the check.
    pub cancel: Cancel,
}

impl CheckParams<'_> {
    /// Checks the set-up.
    ///
    /// # Errors
    /// Files that cannot be read, a frequency that the frame cannot show, or a frame that cannot be reconstructed.
    pub fn run(self, observer: Observer) -> Result<SetupCheck> {
        let experiment = Experiment::read_with(self.experiment, &read_metadata(self.frame))?;
        let options = UserOptions {
            prior: Some(PRIOR),
            self_calibrate: Some("off"),
            ..UserOptions::default()
        };
        let setup = Setup::read(
            &experiment,
            self.calibration,
            &options,
            &self.cancel,
            observer,
        )?;
        check_frequency(self.frequency_hz, &setup.camera)?;
        let frame = Frame::read(self.frame)?;
        let first = [saturation(&frame, &setup.camera), contrast(&setup)];
        let completed = solve(setup.clone().task(&frame, None)?, Instant::now(), observer)?;
        let shutter = shutter(&setup, &frame, share_of(&completed), observer)?;
        let mut checks = Vec::from(first);
        checks.push(row_time(&completed, self.frequency_hz));
        checks.push(shutter);
        checks.push(model(&completed));
        Ok(SetupCheck {
            passed: checks.iter().all(|check| check.passed),
            checks,
        })
    }
}

fn check_frequency(frequency_hz: f64, camera: &Camera) -> Result<()> {
    let most = MAX_FREQUENCY_PART * 1e6 / camera.time().bin_duration_us();
    if frequency_hz > 0.0 && frequency_hz <= most {
        return Ok(());
    }
    Err(Error::input(
        Parameter::FrequencyHz,
        frequency_hz,
        format!(
            "the light blinks at up to {} Hz for this row time",
            short(most)
        ),
        "Let it blink slower.",
    )
    .with_kind(ErrorKind::Invalid))
}

fn saturation(frame: &Frame, camera: &Camera) -> CheckItem {
    let limits = [
        camera.sensor().saturation_counts(),
        frame.capture.format.saturation_limit(),
    ];
    let limit = limits.into_iter().flatten().fold(f64::INFINITY, f64::min);
    let pixels = frame.capture.image.data();
    let saturated = pixels.iter().filter(|&&p| f64::from(p) >= limit).count();
    let part = saturated as f64 / pixels.len() as f64;
    CheckItem {
        name: "saturation",
        passed: part <= MAX_SATURATED,
        value: Some(part),
        limit: MAX_SATURATED,
        found: format!("{:.2} % of the pixels are saturated", 100.0 * part),
        remedy: "Shorten the exposure or dim the light.",
    }
}

fn contrast(setup: &Setup) -> CheckItem {
    let contrast = statistics(setup.psfs.central().image()).contrast;
    CheckItem {
        name: "contrast",
        passed: contrast >= MIN_CONTRAST,
        value: Some(contrast),
        limit: MIN_CONTRAST,
        found: format!("the speckle contrast of the PSF is {contrast:.2}"),
        remedy: "Take the PSF anew with a smaller point source or a spectral filter, and check that nothing vibrates.",
    }
}

/// The row time by the frequency of the brightest trace that has one.
fn row_time(completed: &CompletedTask, frequency_hz: f64) -> CheckItem {
    let traces = completed.traces(TraceRequest::default(), false);
    let numbers = traces.trace_numbers(None);
    let found = numbers
        .iter()
        .find_map(|trace| Some((trace.frequency_hz?, trace.frequency_error_hz)));
    let camera = &completed.task.camera;
    let Some((measured_hz, error_hz)) = found else {
        return CheckItem {
            name: "row-time",
            passed: false,
            value: None,
            limit: MAX_ROW_TIME_ERROR,
            found: "no point of the video blinks with one frequency".into(),
            remedy: "Check that the light blinks and is one point behind the diffuser, and that the PSF is of this diffuser.",
        };
    };
    let error = measured_hz / frequency_hz - 1.0;
    let tolerance = STANDARD_ERRORS * error_hz.unwrap_or(0.0) / frequency_hz;
    let limit = MAX_ROW_TIME_ERROR.max(tolerance);
    let row_time_us = camera.params().row_time_us;
    CheckItem {
        name: "row-time",
        passed: error.abs() <= limit,
        value: Some(error),
        limit,
        found: format!(
            "the light appears at {} Hz, so the row time is {} µs, not {} µs",
            short(measured_hz),
            short(row_time_us * (1.0 + error)),
            short(row_time_us)
        ),
        remedy: "Measure the row time: rowburst calibrate timing.",
    }
}

/// Whether the light blinks as steadily with the declared readout order as with any other: a wrong order shuffles the
/// trace in time. Orders that are the reverse of each other cannot be told apart by a periodic light.
fn shutter(setup: &Setup, frame: &Frame, own: f64, observer: Observer) -> Result<CheckItem> {
    let declared = setup.camera.shutter().clone();
    let (mut best, mut alike) = (own, Vec::new());
    for other in [
        Shutter::TopDown,
        Shutter::BottomUp,
        Shutter::DualInsideOut,
        Shutter::DualOutsideIn,
    ] {
        if other == declared {
            continue;
        }
        let share = share_with(setup, frame, other.clone(), observer)?;
        if share >= own - SHARE_TOLERANCE {
            alike.push(format!("{} ({share:.2})", other.name()));
        }
        best = best.max(share);
    }
    let limit = MIN_SHARE.max(best - SHARE_TOLERANCE);
    let others = if alike.is_empty() {
        "no other order does as well".to_string()
    } else {
        format!("so do {}", alike.join(", "))
    };
    Ok(CheckItem {
        name: "shutter",
        passed: own >= limit,
        value: Some(own),
        limit,
        found: format!(
            "with {} one frequency explains {own:.2} of the light's trace; {others}",
            declared.name()
        ),
        remedy: "Set shutter in the experiment to the order that the camera reads; rowburst calibrate timing finds it.",
    })
}

/// Part of the variance of the brightest trace that one frequency explains.
fn share_of(completed: &CompletedTask) -> f64 {
    let traces = completed.traces(TraceRequest::default(), false);
    let first = traces.frequencies.first();
    first.and_then(Option::as_ref).map_or(0.0, |f| f.share)
}

/// The same with another readout order.
fn share_with(setup: &Setup, frame: &Frame, shutter: Shutter, observer: Observer) -> Result<f64> {
    let mut params = setup.camera.params().clone();
    params.shutter = shutter;
    let setup = Setup {
        camera: Camera::new(params)?,
        options: Options {
            // The traces alone matter.
            keep_all_pixels: true,
            ..setup.options
        },
        ..setup.clone()
    };
    let completed = solve(setup.task(frame, None)?, Instant::now(), observer)?;
    Ok(share_of(&completed))
}

fn model(completed: &CompletedTask) -> CheckItem {
    let fit = &completed.reconstruction.fit;
    CheckItem {
        name: "model",
        passed: fit.verdict == Verdict::Good,
        value: Some(fit.statistics.chi_squared),
        limit: MAX_CHI_SQUARED + CHI_SQUARED_ERRORS * fit.statistics.chi_squared_error,
        found: format!(
            "the fit is {}, χ² of the residual is {:.2}: {}",
            fit.verdict.name(),
            fit.statistics.chi_squared,
            fit.reason
        ),
        remedy: "Take the PSF anew, with this diffuser at this place; then darks and flats.",
    }
}
