//! Parses the options of the user: prior, `τ` and time budget.

use rowburst::reconstruct::{Prior, SelfCalibration, Tau};
use rowburst::{Error, Parameter, Result};
use rowburst_io::Experiment;
use std::time::Duration;

/// The prior `name`, or else that of the experiment file; `None` for `auto`.
///
/// # Errors
/// Those of [`parse_prior`].
pub fn resolve_prior(name: Option<&str>, experiment: &Experiment) -> Result<Option<Prior>> {
    match (name, &experiment.reconstruction.prior) {
        (Some(name), _) => parse_prior(name),
        (None, Some(name)) => parse_prior(name).map_err(|error| {
            error
                .named("[reconstruction] prior")
                .within(&experiment.path)
        }),
        (None, None) => Ok(None),
    }
}

/// The rule for `τ` of `text`, or else that of the experiment file.
///
/// # Errors
/// Those of [`parse_tau`].
pub fn resolve_tau(text: Option<&str>, experiment: &Experiment) -> Result<Tau> {
    match text {
        None => Ok(experiment.reconstruction.tau.unwrap_or_default()),
        Some(text) => parse_tau(text),
    }
}

/// Parses a rule for `τ`: `auto`, `held-out` or a number.
///
/// # Errors
/// A text that is none of these. The set-up of the reconstruction checks the range of the number.
pub fn parse_tau(text: &str) -> Result<Tau> {
    Ok(match text {
        "auto" => Tau::Auto,
        "held-out" => Tau::HeldOut,
        text => Tau::Given(text.parse().map_err(|_| {
            Error::input(
                Parameter::Tau,
                format!("\"{text}\""),
                "τ is auto, held-out or a number above zero",
                "Leave it out: the program finds it.",
            )
        })?),
    })
}

/// Parses a prior (see [`Prior`]); `None` for `auto`.
///
/// # Errors
/// A text that is not a prior.
pub fn parse_prior(name: &str) -> Result<Option<Prior>> {
    match name.trim() {
        "auto" => Ok(None),
        name => name.parse().map(Some),
    }
}

/// Parses when a frame corrects its PSF and its camera: `off`, `auto` or `on`; `None` is `auto`.
///
/// # Errors
/// Another text.
pub fn parse_self_calibration(text: Option<&str>) -> Result<SelfCalibration> {
    let Some(text) = text else {
        return Ok(SelfCalibration::default());
    };
    let known = SelfCalibration::ALL.into_iter().find(|s| s.name() == text);
    known.ok_or_else(|| {
        Error::input(
            Parameter::SelfCalibrate,
            format!("\"{text}\""),
            "self-calibration is off, auto or on",
            "Leave it out: a frame that the model does not explain corrects its PSF and camera.",
        )
    })
}

/// A time budget of `seconds`.
///
/// # Errors
/// A number that is not above zero, or too large for a [`Duration`].
pub fn parse_time_budget(seconds: Option<f64>) -> Result<Option<Duration>> {
    let Some(seconds) = seconds else {
        return Ok(None);
    };
    match Duration::try_from_secs_f64(seconds) {
        Ok(budget) if !budget.is_zero() => Ok(Some(budget)),
        _ => Err(Error::input(
            Parameter::TimeBudgetS,
            seconds,
            "a budget is a number of seconds above zero",
            "Leave it out to run until it has converged.",
        )),
    }
}
