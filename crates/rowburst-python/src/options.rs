//! The options of a reconstruction, from what Python gives.

use crate::error::to_py_err;
use crate::whole::{Number, Whole, is_bool, optional};
use pyo3::prelude::*;
use rowburst::reconstruct::{Options, Prior, SelfCalibration, Tau};
use rowburst::solve::admm::Tuning;
use rowburst::{Error, Parameter};
use rowburst_run::options::{parse_prior, parse_self_calibration, parse_tau};
use std::collections::BTreeMap;

/// Other values of the solver's constants, by name.
pub type Constants = BTreeMap<String, Number>;

/// The standard constants of the solver with the values that a user gives.
pub fn tuning_of(constants: Option<Constants>) -> PyResult<Tuning> {
    let constants = constants.unwrap_or_default().into_iter();
    let values = constants.map(|(name, value)| {
        let value = value.named(&format!("tuning[{name}]"))?;
        Ok::<_, PyErr>((name, value))
    });
    tuning_from(&values.collect::<PyResult<Vec<_>>>()?)
}

/// The standard constants of the solver with other values of some.
pub fn tuning_from(values: &[(String, f64)]) -> PyResult<Tuning> {
    let mut tuning = Tuning::STANDARD;
    let named = values.iter().map(|(name, value)| (name.as_str(), *value));
    tuning.set_all(named).map_err(|error| {
        let remedy = "The names are the fields of rowburst::solve::admm::Tuning.";
        let at_fault = values.iter().find(|(name, _)| name == error.name());
        let found = at_fault.map_or_else(String::new, |(name, value)| format!("{name} = {value}"));
        to_py_err(Error::input(
            Parameter::Tuning,
            found,
            error.to_string(),
            remedy,
        ))
    })?;
    Ok(tuning)
}

/// The options of frames that use PSF and camera as given.
pub fn options_from(
    prior: &str,
    tau: Option<&Bound<'_, PyAny>>,
    noise_sigma: Option<f64>,
    max_iterations: Option<Whole>,
    keep_all_pixels: bool,
) -> PyResult<Options> {
    Ok(Options {
        self_calibration: SelfCalibration::OFF,
        prior: prior_from(prior)?,
        tau: tau_from(tau)?,
        noise_sigma,
        max_iterations: iterations_from(max_iterations)?,
        keep_all_pixels,
        ..Options::default()
    })
}

/// The limit of the number of iterations; `None`: that of the solver.
pub fn iterations_from(max_iterations: Option<Whole>) -> PyResult<Option<usize>> {
    match optional(max_iterations, "max_iterations")? {
        Some(0) => {
            let rule = "a run has at least one iteration";
            let error = Error::input(Parameter::MaxIterations, 0, rule, "Leave it out.");
            Err(to_py_err(error))
        }
        most => Ok(most),
    }
}

/// Whether the frame corrects PSF and camera, by name.
pub fn self_calibration_from(name: &str) -> PyResult<SelfCalibration> {
    parse_self_calibration(Some(name)).map_err(to_py_err)
}

/// A prior by its text; `None`: `auto`.
pub fn prior_from(name: &str) -> PyResult<Option<Prior>> {
    parse_prior(name).map_err(to_py_err)
}

/// `None` and text as on the command line, or a number.
pub fn tau_from(tau: Option<&Bound<'_, PyAny>>) -> PyResult<Tau> {
    match tau {
        None => Ok(Tau::Auto),
        Some(value) if is_bool(value)? => Err(to_py_err(Error::input(
            Parameter::Tau,
            value.str()?.to_string(),
            "τ is \"auto\", \"held-out\" or a number above zero",
            "Leave it out for \"auto\".",
        ))),
        Some(value) => match value.extract::<f64>() {
            Ok(number) => Ok(Tau::Given(number)),
            Err(_) => parse_tau(&value.str()?.to_string()).map_err(to_py_err),
        },
    }
}
