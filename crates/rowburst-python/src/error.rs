//! The library's errors as Python exceptions.

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use rowburst::error::{Names, Subject, Tool};
use rowburst::{Error, ErrorKind, Parameter};

pyo3::create_exception!(
    rowburst,
    InputError,
    PyValueError,
    "An input breaks a rule: the message names the input, its value, the rule and the remedy.\n\n\
     ``kind`` says what is wrong, ``parameter`` and ``path`` which input, ``value`` what was found;\n\
     ``rule`` and ``remedy`` are the words of the message. They are None where they do not apply."
);
pyo3::create_exception!(
    rowburst,
    WorkError,
    PyRuntimeError,
    "The work itself failed: a full disk, no memory, numbers that overflowed.\n\n\
     It has the attributes of :class:`InputError`."
);

/// The attributes of an exception.
const ATTRIBUTES: [&str; 6] = ["kind", "parameter", "path", "value", "rule", "remedy"];

/// Declares the attributes of the exceptions, which are None until an error sets them.
pub fn declare_attributes(py: Python<'_>) -> PyResult<()> {
    for class in [py.get_type::<InputError>(), py.get_type::<WorkError>()] {
        for attribute in ATTRIBUTES {
            class.setattr(attribute, py.None())?;
        }
    }
    Ok(())
}

/// The argument `name` as the subject of an error; `darks[3]` is one of the `darks`.
pub fn subject(name: &str) -> Subject {
    let part = name.split('[').next().unwrap_or(name);
    let mut all = Parameter::ALL.iter().copied();
    let known = all.find(|p| argument(*p) == part);
    match known.or_else(|| Parameter::from_name(&part.to_lowercase())) {
        Some(parameter) => Subject::item(parameter, name),
        None => Subject::named(name),
    }
}

/// `error` as an exception with its data, in the names of Python.
pub fn to_py_err(error: Error) -> PyErr {
    let message = error.message(&Arguments);
    let exception = if error.is_input() {
        InputError::new_err(message)
    } else {
        WorkError::new_err(message)
    };
    Python::attach(|py| match set_attributes(py, &exception, &error) {
        Ok(()) => exception,
        Err(failed) => failed,
    })
}

fn set_attributes(py: Python<'_>, exception: &PyErr, error: &Error) -> PyResult<()> {
    let value = exception.value(py);
    let words = |text: String| (!text.is_empty()).then_some(text);
    let remedy = Arguments.remedy(error);
    value.setattr(intern!(py, "kind"), error.kind().name())?;
    value.setattr(intern!(py, "parameter"), error.parameter().map(argument))?;
    value.setattr(
        intern!(py, "path"),
        error.path().map(|path| path.display().to_string()),
    )?;
    value.setattr(intern!(py, "value"), error.value())?;
    value.setattr(intern!(py, "rule"), words(error.rule().text(&Arguments)))?;
    value.setattr(
        intern!(py, "remedy"),
        remedy.unwrap_or_else(|| error.remedy().text(&Arguments)),
    )
}

/// The name of a parameter as an argument.
fn argument(parameter: Parameter) -> &'static str {
    match parameter {
        Parameter::DiameterMm => "pupil_mm",
        Parameter::ImageDistanceMm => "focal_length_mm",
        Parameter::DiffuserFwhmDeg => "diffuser_deg",
        Parameter::HeightPx => "digit_px",
        Parameter::SuccessMap => "trials",
        Parameter::Output => "folder",
        Parameter::Region => "regions",
        Parameter::PartBins => "bins_per_chunk",
        Parameter::RmsPhase => "diffuser_phase",
        Parameter::Write => "formats",
        other => other.name(),
    }
}

/// The names of Python.
pub struct Arguments;

impl Names for Arguments {
    fn name(&self, parameter: Parameter) -> String {
        match parameter {
            Parameter::Camera => "the Camera".to_string(),
            // Sentences name it to leave the map out.
            Parameter::SuccessMap => "trials=False".to_string(),
            other => argument(other).to_string(),
        }
    }

    fn subject(&self, parameter: Parameter) -> String {
        argument(parameter).to_string()
    }

    fn setting(&self, parameter: Parameter, value: &str) -> String {
        match parameter {
            Parameter::Region => format!("({})", value.replace(',', ", ")),
            Parameter::Bins => format!("bins=({})", value.replace("..", ", ")),
            Parameter::ExposuresMs => {
                format!("exposures_ms=[{}]", value.replace(',', ", "))
            }
            other => format!("{}={value}", argument(other)),
        }
    }

    fn tool(&self, tool: Tool) -> String {
        let call = match tool {
            Tool::Reconstruct => "rb.reconstruct",
            Tool::Batch => "rb.batch",
            Tool::CalibrateSensor => "rb.calibrate.sensor",
            Tool::CalibratePsf => "rb.calibrate.psf",
            Tool::CalibratePatches => "rb.calibrate.psf(positions_mm=…)",
            Tool::CalibrateTiming => "rb.calibrate.timing",
            other => return format!("`{}`", other.name()),
        };
        format!("`{call}`")
    }

    fn remedy(&self, error: &Error) -> Option<String> {
        match (error.parameter()?, error.kind()) {
            (Parameter::Psf, ErrorKind::Missing) => {
                Some("Give psf=, or an experiment that names the file of the PSF.".to_string())
            }
            (Parameter::FramePeriodUs, ErrorKind::Missing) => {
                Some("Give frame_period_us=.".to_string())
            }
            (Parameter::PartBins, ErrorKind::Unsupported) => Some(
                "Call `rb.reconstruct`; if memory is short, make field smaller or bin the frame."
                    .to_string(),
            ),
            _ => None,
        }
    }
}
