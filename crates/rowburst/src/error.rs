//! Errors, sorted by who must act.

/// Result of a fallible call of this library.
pub type Result<T> = std::result::Result<T, Error>;

/// What went wrong, in words that a user can act on.
///
/// Programmer mistakes (wrong slice lengths inside the library) panic instead,
/// and a solver that did not converge is a [`crate::solve::StopReason`].
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The input breaks a rule: the user must change it.
    #[error("{subject}: found {found}; {rule}. {remedy}")]
    Input {
        /// What is wrong: a file, a key, an option.
        subject: String,
        /// The offending value.
        found: String,
        /// The rule it breaks.
        rule: String,
        /// What to do about it.
        remedy: String,
    },
    /// The work itself failed (disk full, numbers that overflowed).
    #[error("{subject}: {reason}. {remedy}")]
    Work {
        /// What was being done, or the file it was done to.
        subject: String,
        /// Why it failed.
        reason: String,
        /// What to do about it.
        remedy: String,
    },
}

impl Error {
    /// An [`Error::Input`] from its four parts.
    pub fn input(
        subject: impl Into<String>,
        found: impl ToString,
        rule: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Self::Input {
            subject: subject.into(),
            found: found.to_string(),
            rule: rule.into(),
            remedy: remedy.into(),
        }
    }

    /// An [`Error::Work`] from its three parts.
    pub fn work(
        subject: impl Into<String>,
        reason: impl ToString,
        remedy: impl Into<String>,
    ) -> Self {
        Self::Work {
            subject: subject.into(),
            reason: reason.to_string(),
            remedy: remedy.into(),
        }
    }

    /// The same error with `place` (usually a path) in front of its subject.
    #[must_use]
    pub fn within(mut self, place: impl std::fmt::Display) -> Self {
        match &mut self {
            Self::Input { subject, .. } | Self::Work { subject, .. } => {
                *subject = format!("{place}: {subject}");
            }
        }
        self
    }
}
