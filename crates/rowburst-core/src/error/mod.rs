//! Errors: what is at fault, as data, and the words for a person.
//!
//! An [`Error`] knows its [`ErrorKind`], the [`Parameter`] or the file at fault, the offending value, the rule that the
//! value breaks and a remedy. The words name parameters by [`Phrase`]s, so that every interface shows its own names
//! ([`Names`]): the library says `noise_sigma` where the command line says `--noise-sigma`.

mod parameter;
mod phrase;

pub use parameter::Parameter;
pub use phrase::{Fragment, LibraryNames, Names, Phrase, Tool, With};

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Result of a fallible call of this library.
pub type Result<T> = std::result::Result<T, Error>;

/// What kind of error it is: what a program does about it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// A value breaks a rule.
    Invalid,
    /// Something that is needed is not given.
    Missing,
    /// A name that does not exist.
    Unknown,
    /// Sizes that do not fit each other.
    Shape,
    /// A value that is not a finite number.
    NotFinite,
    /// Data that hold too little light, signal or range for their purpose.
    NoSignal,
    /// Inputs that contradict each other.
    Conflict,
    /// Correct input that this version cannot handle.
    Unsupported,
    /// A file that does not exist.
    NotFound,
    /// A file that cannot be read, or is damaged or of another format.
    Unreadable,
    /// A file or folder that would be overwritten.
    Exists,
    /// The disk or the operating system failed.
    Io,
    /// There is not enough memory.
    Memory,
    /// Numbers that overflowed.
    Overflow,
    /// The user or the caller stopped it.
    Cancelled,
    /// Other work that failed.
    Failed,
}

impl ErrorKind {
    /// Whether the input is at fault, and the caller must change it; otherwise the work itself failed.
    pub fn is_input(self) -> bool {
        match self {
            Self::Invalid
            | Self::Missing
            | Self::Unknown
            | Self::Shape
            | Self::NotFinite
            | Self::NoSignal
            | Self::Conflict
            | Self::Unsupported
            | Self::NotFound
            | Self::Unreadable
            | Self::Exists => true,
            Self::Io | Self::Memory | Self::Overflow | Self::Cancelled | Self::Failed => false,
        }
    }

    /// Its name as data, such as `not-finite`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Invalid => "invalid",
            Self::Missing => "missing",
            Self::Unknown => "unknown",
            Self::Shape => "shape",
            Self::NotFinite => "not-finite",
            Self::NoSignal => "no-signal",
            Self::Conflict => "conflict",
            Self::Unsupported => "unsupported",
            Self::NotFound => "not-found",
            Self::Unreadable => "unreadable",
            Self::Exists => "exists",
            Self::Io => "io",
            Self::Memory => "memory",
            Self::Overflow => "overflow",
            Self::Cancelled => "cancelled",
            Self::Failed => "failed",
        }
    }
}

/// What went wrong, as data and in words that a user can act on.
///
/// Mistakes of the programmer (wrong slice lengths inside the library) panic instead, and a solver that did not
/// converge is a `StopReason`.
#[derive(Clone)]
pub struct Error(Box<Detail>);

#[derive(Clone)]
struct Detail {
    kind: ErrorKind,
    subject: Subject,
    /// Where the subject is, outermost first.
    locations: Vec<Place>,
    value: String,
    /// Empty where the work failed.
    rule: Phrase,
    remedy: Phrase,
    source: Option<Arc<dyn std::error::Error + Send + Sync>>,
}

/// What an error is about: a parameter, a file, or work by its name.
#[derive(Debug, Clone, Default)]
pub struct Subject {
    parameter: Option<Parameter>,
    path: Option<PathBuf>,
    label: Option<String>,
    setting: Option<String>,
    index: Option<usize>,
}

impl Subject {
    /// A part of `parameter`, or one of several that it names.
    pub fn item(parameter: Parameter, label: impl Into<String>) -> Self {
        Self {
            parameter: Some(parameter),
            label: Some(label.into()),
            ..Self::default()
        }
    }

    /// `parameter` with its value, where the error is about what follows from it.
    pub fn setting(parameter: Parameter, value: impl ToString) -> Self {
        Self {
            parameter: Some(parameter),
            setting: Some(value.to_string()),
            ..Self::default()
        }
    }

    /// Element `index` of a list, counted from 0; `noun` and the number from 1 name it in messages: "frame 3".
    pub fn element(parameter: Parameter, noun: &str, index: usize) -> Self {
        Self {
            index: Some(index),
            ..Self::item(parameter, format!("{noun} {}", index + 1))
        }
    }

    /// A file, and where in it.
    pub fn in_file(path: impl Into<PathBuf>, place: impl fmt::Display) -> Self {
        let path = path.into();
        Self {
            parameter: None,
            label: Some(format!("{}: {place}", path.display())),
            path: Some(path),
            ..Self::default()
        }
    }

    /// A line of a text file, counted from 1.
    pub fn line(path: impl Into<PathBuf>, line: usize) -> Self {
        let path = path.into();
        Self {
            label: Some(format!("{}, line {line}", path.display())),
            path: Some(path),
            ..Self::default()
        }
    }

    /// What has no parameter, such as work: "writing PNG".
    pub fn named(label: impl Into<String>) -> Self {
        Self {
            label: Some(label.into()),
            ..Self::default()
        }
    }

    /// The same subject, which is the value of `parameter`.
    #[must_use]
    pub fn of(self, parameter: Parameter) -> Self {
        Self {
            parameter: Some(parameter),
            ..self
        }
    }
}

impl From<Parameter> for Subject {
    fn from(parameter: Parameter) -> Self {
        Self {
            parameter: Some(parameter),
            ..Self::default()
        }
    }
}

impl From<PathBuf> for Subject {
    fn from(path: PathBuf) -> Self {
        Self {
            path: Some(path),
            ..Self::default()
        }
    }
}

impl From<&Path> for Subject {
    fn from(path: &Path) -> Self {
        path.to_path_buf().into()
    }
}

impl From<&PathBuf> for Subject {
    fn from(path: &PathBuf) -> Self {
        path.clone().into()
    }
}

/// Where the subject of an error is: a file, or words.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum Place {
    /// A file or folder.
    File(PathBuf),
    /// Words, such as the name of one of several frames.
    Text(String),
    /// What is made with this value of a parameter.
    Setting(Parameter, String),
}

impl Place {
    fn text(&self, names: &dyn Names) -> String {
        match self {
            Self::File(path) => path.display().to_string(),
            Self::Text(text) => text.clone(),
            Self::Setting(parameter, value) => names.setting(*parameter, value),
        }
    }
}

impl From<&Path> for Place {
    fn from(path: &Path) -> Self {
        Self::File(path.to_path_buf())
    }
}

impl From<&&Path> for Place {
    fn from(path: &&Path) -> Self {
        Self::File(path.to_path_buf())
    }
}

impl From<&PathBuf> for Place {
    fn from(path: &PathBuf) -> Self {
        Self::File(path.clone())
    }
}

impl From<PathBuf> for Place {
    fn from(path: PathBuf) -> Self {
        Self::File(path)
    }
}

impl From<&str> for Place {
    fn from(text: &str) -> Self {
        Self::Text(text.to_string())
    }
}

impl From<String> for Place {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

impl Error {
    /// Input that breaks a rule, of [`ErrorKind::Invalid`] until [`Self::with_kind`].
    pub fn input(
        subject: impl Into<Subject>,
        found: impl ToString,
        rule: impl Into<Phrase>,
        remedy: impl Into<Phrase>,
    ) -> Self {
        Self(Box::new(Detail {
            kind: ErrorKind::Invalid,
            subject: subject.into(),
            locations: Vec::new(),
            value: found.to_string(),
            rule: rule.into(),
            remedy: remedy.into(),
            source: None,
        }))
    }

    /// Work that failed, of [`ErrorKind::Failed`] until [`Self::with_kind`].
    pub fn work(
        subject: impl Into<Subject>,
        reason: impl ToString,
        remedy: impl Into<Phrase>,
    ) -> Self {
        Self::input(subject, reason, "", remedy).with_kind(ErrorKind::Failed)
    }

    /// The same error of another kind.
    #[must_use]
    pub fn with_kind(mut self, kind: ErrorKind) -> Self {
        self.0.kind = kind;
        self
    }

    /// The same error with its cause.
    #[must_use]
    pub fn with_source(mut self, source: impl std::error::Error + Send + Sync + 'static) -> Self {
        self.0.source = Some(Arc::new(source));
        self
    }

    /// The same error with `place` (usually a file) in front of its subject.
    #[must_use]
    pub fn within(mut self, place: impl Into<Place>) -> Self {
        self.0.locations.insert(0, place.into());
        self
    }

    /// The same error about `parameter`, where none is known yet; a file at fault keeps its name.
    #[must_use]
    pub fn of(mut self, parameter: Parameter) -> Self {
        self.0.subject.parameter.get_or_insert(parameter);
        self
    }

    /// The same error with another name for its subject in the message.
    #[must_use]
    pub fn named(mut self, label: impl Into<String>) -> Self {
        self.0.subject.label = Some(label.into());
        self
    }

    /// The kind.
    pub fn kind(&self) -> ErrorKind {
        self.0.kind
    }

    /// Whether the input is at fault ([`ErrorKind::is_input`]).
    pub fn is_input(&self) -> bool {
        self.0.kind.is_input()
    }

    /// The parameter at fault.
    pub fn parameter(&self) -> Option<Parameter> {
        self.0.subject.parameter
    }

    /// The file at fault.
    pub fn path(&self) -> Option<&Path> {
        let within = self.0.locations.iter().rev().find_map(|place| match place {
            Place::File(path) => Some(path.as_path()),
            _ => None,
        });
        self.0.subject.path.as_deref().or(within)
    }

    /// Where the subject is, outermost first.
    pub fn locations(&self) -> &[Place] {
        &self.0.locations
    }

    /// The offending value, or why the work failed.
    pub fn value(&self) -> &str {
        &self.0.value
    }

    /// The offending value where it is a number.
    pub fn number(&self) -> Option<f64> {
        self.0.value.parse().ok()
    }

    /// The rule that the value breaks; empty where the work failed.
    pub fn rule(&self) -> &Phrase {
        &self.0.rule
    }

    /// What to do about it.
    pub fn remedy(&self) -> &Phrase {
        &self.0.remedy
    }

    /// The name of one of several that is at fault, such as "frame 3".
    pub fn label(&self) -> Option<&str> {
        self.0.subject.label.as_deref()
    }

    /// Index of the list's element that is at fault, counted from 0.
    pub fn index(&self) -> Option<usize> {
        self.0.subject.index
    }

    /// The message, with the names that `names` has for parameters.
    pub fn message(&self, names: &dyn Names) -> String {
        use fmt::Write;
        let Detail {
            subject, locations, ..
        } = &*self.0;
        let mut text = String::new();
        for place in locations {
            text += &place.text(names);
            text += ": ";
        }
        match subject {
            Subject {
                label: Some(label), ..
            } => text += label,
            Subject {
                path: Some(path), ..
            } => write!(text, "{}", path.display()).expect("a string grows"),
            Subject {
                parameter: Some(parameter),
                setting: Some(value),
                ..
            } => text += &names.setting(*parameter, value),
            Subject {
                parameter: Some(parameter),
                ..
            } => text += &names.subject(*parameter),
            _ => text.truncate(text.len().saturating_sub(2)),
        }
        text + ": " + &self.explanation(names)
    }

    /// The message without the name of what is at fault.
    pub fn explanation(&self, names: &dyn Names) -> String {
        let remedy = names
            .remedy(self)
            .unwrap_or_else(|| self.0.remedy.text(names));
        format!("{}. {remedy}", self.reason(names))
    }

    /// What was found, and the rule that it breaks: the message without the name of what is at fault and without the remedy.
    pub fn reason(&self, names: &dyn Names) -> String {
        let value = &self.0.value;
        if self.0.rule.is_empty() {
            value.clone()
        } else {
            format!("found {value}; {}", self.0.rule.text(names))
        }
    }
}

/// Equal kinds and messages; causes are not compared.
impl PartialEq for Error {
    fn eq(&self, other: &Self) -> bool {
        self.kind() == other.kind() && self.to_string() == other.to_string()
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.message(&LibraryNames))
    }
}

impl fmt::Debug for Error {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Error")
            .field("kind", &self.0.kind)
            .field("parameter", &self.0.subject.parameter)
            .field("message", &self.to_string())
            .finish_non_exhaustive()
    }
}

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        let source = self.0.source.as_deref()?;
        Some(source)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::phrase;

    /// An interface with names of its own.
    struct Flags;

    impl Names for Flags {
        fn name(&self, parameter: Parameter) -> String {
            format!("--{}", parameter.name().replace('_', "-"))
        }

        fn setting(&self, parameter: Parameter, value: &str) -> String {
            format!("{} {value}", self.name(parameter))
        }

        fn tool(&self, tool: Tool) -> String {
            format!("`{}`", tool.name())
        }
    }

    fn too_small() -> Error {
        Error::input(
            Parameter::NoiseSigma,
            -1.5,
            "it is above zero",
            phrase!["Leave ", Parameter::NoiseSigma, " out."],
        )
    }

    #[test]
    fn is_data() {
        let error = too_small();
        assert_eq!(error.kind(), ErrorKind::Invalid);
        assert!(error.is_input());
        assert_eq!(error.parameter(), Some(Parameter::NoiseSigma));
        assert_eq!(error.number(), Some(-1.5));
        assert_eq!(error.path(), None);
    }

    #[test]
    fn shows_the_names_of_each_interface() {
        let library = "noise_sigma: found -1.5; it is above zero. Leave noise_sigma out.";
        let flags = "--noise-sigma: found -1.5; it is above zero. Leave --noise-sigma out.";
        assert_eq!(too_small().to_string(), library);
        assert_eq!(too_small().message(&Flags), flags);
    }

    #[test]
    fn names_the_innermost_file() {
        let error = Error::input(Parameter::Psf, "no light", "a PSF holds light", "Wait.");
        let error = error.within(Path::new("psf.tif")).within("frame 3");
        assert_eq!(error.path(), Some(Path::new("psf.tif")));
        let text = "frame 3: psf.tif: PSF: found no light; a PSF holds light. Wait.";
        assert_eq!(error.to_string(), text);
    }

    #[test]
    fn keeps_its_cause() {
        let cause = std::io::Error::from(std::io::ErrorKind::StorageFull);
        let error = Error::work(Subject::named("writing"), "disk full", "Free space.");
        let error = error.with_kind(ErrorKind::Io).with_source(cause);
        assert!(!error.is_input());
        let source = std::error::Error::source(&error).unwrap();
        let source = source.downcast_ref::<std::io::Error>().unwrap();
        assert_eq!(source.kind(), std::io::ErrorKind::StorageFull);
        assert_eq!(error.to_string(), "writing: disk full. Free space.");
    }
}
