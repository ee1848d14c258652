//! Words with the names of parameters as data.

use super::{Error, Parameter};
use std::borrow::Cow;

/// A sentence of an error, in which parameters stand as data; see [`crate::phrase!`].
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Phrase(Vec<Fragment>);

/// A part of a [`Phrase`].
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Fragment {
    /// Words that all interfaces share.
    Text(Cow<'static, str>),
    /// The name of a parameter.
    Name(Parameter),
    /// A parameter with a value, as a user gives it.
    Setting(Parameter, Cow<'static, str>),
    /// How a parameter is given, where the sentence says already what it is.
    With(Parameter),
    /// The call that runs a tool.
    Tool(Tool),
}

/// How a parameter is given, within a [`crate::phrase!`]: " with -o" on a command line, nothing elsewhere.
#[derive(Debug, Clone, Copy)]
pub struct With(pub Parameter);

/// A tool of the program that a remedy refers to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Tool {
    /// Recovers the video of one frame.
    Reconstruct,
    /// Recovers the videos of a recording.
    Batch,
    /// Calibrates the sensor.
    CalibrateSensor,
    /// Calibrates the PSF.
    CalibratePsf,
    /// Calibrates the PSF at several positions of the field.
    CalibratePatches,
    /// Calibrates the readout.
    CalibrateTiming,
}

impl Tool {
    /// Its name, such as "calibrate sensor".
    pub fn name(self) -> &'static str {
        match self {
            Self::Reconstruct => "reconstruct",
            Self::Batch => "batch",
            Self::CalibrateSensor => "calibrate sensor",
            Self::CalibratePsf | Self::CalibratePatches => "calibrate psf",
            Self::CalibrateTiming => "calibrate timing",
        }
    }
}

/// The names that an interface has for parameters and tools.
pub trait Names {
    /// The name within a sentence: `--noise-sigma`.
    fn name(&self, parameter: Parameter) -> String;

    /// The name as the subject of a message.
    fn subject(&self, parameter: Parameter) -> String {
        match parameter {
            Parameter::Psf => "PSF".to_string(),
            Parameter::PatchSet => "patch set".to_string(),
            Parameter::NoiselessFrame => "noiseless frame".to_string(),
            Parameter::StandardErrors => "standard errors of traces".to_string(),
            Parameter::SpeckleOptics => "speckle optics".to_string(),
            Parameter::NonZeroPixels => "non-zero pixels per bin".to_string(),
            Parameter::SuccessMap => "success map".to_string(),
            Parameter::Memory => "memory".to_string(),
            other => self.name(other),
        }
    }

    /// The parameter with a value, as a user gives it: `--noise-sigma 2`.
    fn setting(&self, parameter: Parameter, value: &str) -> String;

    /// The addition to a sentence that says how the parameter is given: " with --noise-sigma".
    fn with(&self, _parameter: Parameter) -> String {
        String::new()
    }

    /// The call that runs a tool.
    fn tool(&self, tool: Tool) -> String;

    /// A remedy that fits this interface better than that of the error.
    fn remedy(&self, _error: &Error) -> Option<String> {
        None
    }
}

/// The names of the library itself.
pub struct LibraryNames;

impl Names for LibraryNames {
    fn name(&self, parameter: Parameter) -> String {
        parameter.name().to_string()
    }

    fn setting(&self, parameter: Parameter, value: &str) -> String {
        format!("{} = {value}", parameter.name())
    }

    fn tool(&self, tool: Tool) -> String {
        format!("`{}`", tool.name())
    }
}

impl Phrase {
    /// A phrase of these parts.
    pub fn new(fragments: impl IntoIterator<Item = Fragment>) -> Self {
        Self(fragments.into_iter().collect())
    }

    /// The parts.
    pub fn fragments(&self) -> &[Fragment] {
        &self.0
    }

    /// Whether it has no words.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The words, with the names that `names` has.
    pub fn text(&self, names: &dyn Names) -> String {
        let words = self.0.iter().map(|fragment| match fragment {
            Fragment::Text(text) => text.to_string(),
            Fragment::Name(parameter) => names.name(*parameter),
            Fragment::Setting(parameter, value) => names.setting(*parameter, value),
            Fragment::With(parameter) => names.with(*parameter),
            Fragment::Tool(tool) => names.tool(*tool),
        });
        words.collect()
    }
}

impl From<&'static str> for Phrase {
    fn from(text: &'static str) -> Self {
        if text.is_empty() {
            return Self::default();
        }
        Self(vec![text.into()])
    }
}

impl From<String> for Phrase {
    fn from(text: String) -> Self {
        Self(vec![text.into()])
    }
}

impl From<&'static str> for Fragment {
    fn from(text: &'static str) -> Self {
        Self::Text(text.into())
    }
}

impl From<String> for Fragment {
    fn from(text: String) -> Self {
        Self::Text(text.into())
    }
}

impl From<Parameter> for Fragment {
    fn from(parameter: Parameter) -> Self {
        Self::Name(parameter)
    }
}

impl From<(Parameter, &'static str)> for Fragment {
    fn from((parameter, value): (Parameter, &'static str)) -> Self {
        Self::Setting(parameter, value.into())
    }
}

impl From<With> for Fragment {
    fn from(With(parameter): With) -> Self {
        Self::With(parameter)
    }
}

impl From<Tool> for Fragment {
    fn from(tool: Tool) -> Self {
        Self::Tool(tool)
    }
}

/// A [`Phrase`] of words, parameters, `(parameter, "value")`, [`With`](crate::error::With) and tools.
///
/// ```
/// use rowburst_core::{Parameter, phrase};
///
/// let remedy = phrase!["Check the gain, or give ", Parameter::NoiseSigma, "."];
/// assert_eq!(remedy.text(&rowburst_core::error::LibraryNames), "Check the gain, or give noise_sigma.");
/// ```
#[macro_export]
macro_rules! phrase {
    ($($part:expr),+ $(,)?) => {
        $crate::error::Phrase::new([$($crate::error::Fragment::from($part)),+])
    };
}
