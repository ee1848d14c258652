//! A request to stop, which every part of a run looks at.

use crate::error::Subject;
use crate::{Error, ErrorKind, Result};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A token that cancels a run from another thread. Clones are of one request.
///
/// A set-up ends with an error within a second. A run that has iterated ends with
/// `StopReason::Interrupted` and the result of its last iteration.
#[derive(Debug, Clone, Default)]
pub struct Cancel(Arc<AtomicBool>);

impl Cancel {
    /// Asks for the end of the run.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether the end was asked for.
    #[inline]
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// An error where the end was asked for.
    ///
    /// # Errors
    /// The run is cancelled.
    pub fn check(&self) -> Result<()> {
        if self.is_cancelled() {
            Err(Self::error())
        } else {
            Ok(())
        }
    }

    /// The error of a run that is cancelled before it has a result.
    pub fn error() -> Error {
        Error::work(
            Subject::named("reconstruction"),
            "cancelled",
            "There is no result yet.",
        )
        .with_kind(ErrorKind::Cancelled)
    }
}

/// Another name for a flag that stops a run.
impl From<Arc<AtomicBool>> for Cancel {
    fn from(flag: Arc<AtomicBool>) -> Self {
        Self(flag)
    }
}
