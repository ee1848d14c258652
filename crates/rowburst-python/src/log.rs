//! The log of the library in Python's `logging`, under the name `rowburst`.
//!
//! Threads that work do not wait for the interpreter's lock: their messages are kept until the thread that called them
//! looks for signals or returns, and are handed over there.

use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use rowburst_run::{LogLevel, LogMessage, set_log, set_log_level};
use std::sync::{Mutex, Once, PoisonError};

/// Levels of `logging`.
const INFO: u8 = 20;
const DEBUG: u8 = 10;

static LOGGER: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
static MESSAGES: Mutex<Vec<LogMessage>> = Mutex::new(Vec::new());
static START: Once = Once::new();

fn logger(py: Python<'_>) -> PyResult<&Bound<'_, PyAny>> {
    let logger = LOGGER.get_or_try_init(py, || {
        let logging = py.import("logging")?;
        logging
            .call_method1("getLogger", ("rowburst",))
            .map(Bound::unbind)
    })?;
    Ok(logger.bind(py))
}

/// Asks the logger which messages it wants from now on.
pub fn begin(py: Python<'_>) -> PyResult<()> {
    let logger = logger(py)?;
    let wants = |level: u8| logger.call_method1("isEnabledFor", (level,))?.is_truthy();
    let level = if wants(DEBUG)? {
        LogLevel::Details
    } else if wants(INFO)? {
        LogLevel::Steps
    } else {
        set_log_level(LogLevel::Off);
        return Ok(());
    };
    START.call_once(|| {
        set_log(|message| {
            let mut messages = MESSAGES.lock().unwrap_or_else(PoisonError::into_inner);
            messages.push(message);
        });
    });
    set_log_level(level);
    Ok(())
}

/// Hands the messages so far to the logger.
pub fn flush(py: Python<'_>) -> PyResult<()> {
    let messages = std::mem::take(&mut *MESSAGES.lock().unwrap_or_else(PoisonError::into_inner));
    for message in messages {
        let level = match message.level {
            LogLevel::Details => DEBUG,
            LogLevel::Steps | LogLevel::Off => INFO,
        };
        logger(py)?.call_method1("log", (level, "%s", message.text))?;
    }
    Ok(())
}
