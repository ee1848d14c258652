//! Parses the options of the user: prior, `τ` and time budget.

use rowburst::guide::GuideModel;
use rowburst::reconstruct::{Options, Prior, SelfCalibration, Tau};
use rowburst::{Error, Parameter, Result};
use rowburst_io::Experiment;
use std::time::Duration;

/// Options as a user types them. What is left open comes from the experiment file.
#[derive(Debug, Clone, Copy, Default)]
pub struct UserOptions<'a> {
    /// The prior; see [`parse_prior`].
    pub prior: Option<&'a str>,
    /// The rule for `τ`; see [`parse_tau`].
    pub tau: Option<&'a str>,
    /// See [`Options::noise_sigma`].
    pub noise_sigma: Option<f64>,
    /// When a frame corrects its PSF and its camera; see [`parse_self_calibration`].
    pub self_calibrate: Option<&'a str>,
    /// See [`Options::keep_all_pixels`].
    pub keep_all_pixels: bool,
    /// See [`Options::max_iterations`].
    pub max_iterations: Option<usize>,
    /// The time budget of a frame.
    pub time_budget_s: Option<f64>,
}

impl UserOptions<'_> {
    /// Parses the options and fills those that are left open from `experiment`. Also returns the time budget.
    ///
    /// # Errors
    /// A text that is not an option, or a number that is out of range.
    pub fn resolve(&self, experiment: &Experiment) -> Result<(Options, Option<Duration>)> {
        let options = Options {
            prior: resolve_prior(self.prior, experiment)?,
            tau: resolve_tau(self.tau, experiment)?,
            noise_sigma: self.noise_sigma,
            max_iterations: self.max_iterations,
            keep_all_pixels: self.keep_all_pixels,
            self_calibration: parse_self_calibration(self.self_calibrate)?,
            ..Options::default()
        };
        Ok((options, parse_time_budget(self.time_budget_s)?))
    }
}

/// The prior `name`, or else that of the experiment file; `None` for `auto`.
///
/// # Errors
/// Those of [`parse_prior`].
fn resolve_prior(name: Option<&str>, experiment: &Experiment) -> Result<Option<Prior>> {
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
fn resolve_tau(text: Option<&str>, experiment: &Experiment) -> Result<Tau> {
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

/// Parses when a frame corrects its PSF and its camera, and what of them; `None` is `auto`. See [`SelfCalibration`].
///
/// # Errors
/// Another text.
pub fn parse_self_calibration(text: Option<&str>) -> Result<SelfCalibration> {
    text.map_or(Ok(SelfCalibration::default()), str::parse)
}

/// Parses the model of a guide: `auto`, `motion`, `gain`, `still` or `places`; `None` is `auto`.
///
/// # Errors
/// Another text.
pub fn parse_guide_model(text: Option<&str>) -> Result<GuideModel> {
    let Some(text) = text else {
        return Ok(GuideModel::default());
    };
    let known = GuideModel::ALL.into_iter().find(|m| m.name() == text);
    known.ok_or_else(|| {
        Error::input(
            Parameter::GuideModel,
            format!("\"{text}\""),
            "the model is auto, motion, gain, still or places",
            "Leave it out: the program chooses it.",
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
