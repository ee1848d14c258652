//! The log of a run: the events of all crates of Rowburst (`tracing`), given to one function.
//!
//! Nothing is logged until [`set_log`] is called. No event lies in a loop over pixels, voxels or iterations.

use std::fmt::{self, Write};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Mutex, PoisonError};
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::Interest;
use tracing::{Event, Metadata, Subscriber};

/// How much is logged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum LogLevel {
    /// Nothing.
    Off,
    /// Every step of a run.
    Steps,
    /// Parts of steps as well.
    Details,
}

/// An event.
#[derive(Debug, Clone)]
pub struct LogMessage {
    /// [`LogLevel::Steps`] or [`LogLevel::Details`].
    pub level: LogLevel,
    /// What has happened.
    pub text: String,
}

/// What messages are given to.
type Sink = Box<dyn Fn(LogMessage) + Send>;

static MAX_LEVEL: AtomicU8 = AtomicU8::new(LogLevel::Off as u8);
static SINK: Mutex<Option<Sink>> = Mutex::new(None);

/// Gives the messages of this process to `sink` from now on, as [`set_log_level`] says. `sink` is called on the thread
/// of the event; it must not log itself.
///
/// A program with a `tracing` subscriber of its own sees the events there, and `sink` gets none.
pub fn set_log(sink: impl Fn(LogMessage) + Send + 'static) {
    *SINK.lock().unwrap_or_else(PoisonError::into_inner) = Some(Box::new(sink));
    // The second call finds the subscriber of the first.
    let _ = tracing::subscriber::set_global_default(Log);
}

/// Sets how much is logged.
pub fn set_log_level(level: LogLevel) {
    MAX_LEVEL.store(level as u8, Ordering::Relaxed);
}

/// Whether the steps of a run are logged.
pub fn is_logging() -> bool {
    MAX_LEVEL.load(Ordering::Relaxed) >= LogLevel::Steps as u8
}

fn level_of(metadata: &Metadata) -> LogLevel {
    if *metadata.level() <= tracing::Level::INFO {
        LogLevel::Steps
    } else {
        LogLevel::Details
    }
}

/// The subscriber of the crates of Rowburst.
struct Log;

impl Subscriber for Log {
    fn register_callsite(&self, metadata: &'static Metadata<'static>) -> Interest {
        if metadata.is_event() && metadata.target().starts_with("rowburst") {
            Interest::sometimes()
        } else {
            Interest::never()
        }
    }

    fn enabled(&self, metadata: &Metadata) -> bool {
        metadata.target().starts_with("rowburst")
            && MAX_LEVEL.load(Ordering::Relaxed) >= level_of(metadata) as u8
    }

    fn event(&self, event: &Event) {
        let mut text = Text(String::new());
        event.record(&mut text);
        let message = LogMessage {
            level: level_of(event.metadata()),
            text: text.0,
        };
        if let Some(sink) = &*SINK.lock().unwrap_or_else(PoisonError::into_inner) {
            sink(message);
        }
    }

    // There are no spans.
    fn new_span(&self, _: &Attributes) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// The text of an event: its message, then its fields.
struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // Writing to a String cannot fail.
        let _ = match field.name() {
            "message" => write!(self.0, "{value:?}"),
            name => write!(self.0, ", {name} {value:?}"),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    #[test]
    fn events_are_logged_by_level() {
        let texts = Arc::new(Mutex::new(Vec::new()));
        let log = Arc::clone(&texts);
        set_log(move |message| log.lock().unwrap().push(message.text));
        let events = || {
            tracing::info!("a step");
            tracing::debug!("a detail");
        };
        events();
        set_log_level(LogLevel::Steps);
        events();
        set_log_level(LogLevel::Details);
        events();
        set_log_level(LogLevel::Off);
        events();
        assert_eq!(*texts.lock().unwrap(), ["a step", "a step", "a detail"]);
    }
}
