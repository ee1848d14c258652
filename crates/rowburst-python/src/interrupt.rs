//! Work on a thread of its own, which Ctrl-C leaves at once.
//!
//! The calling thread waits and listens for signals, and calls the progress function, since programs with windows
//! allow that on their own thread alone. After Ctrl-C the work ends in the background, within a second where it looks at
//! [`Reporter::cancel`].

use crate::error::to_py_err;
use crate::log;
use crate::threads::Threads;
use pyo3::prelude::*;
use rowburst::{Cancel, Error, Parameter};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

/// Time between two looks for Ctrl-C; shorter costs processor time.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// A message from the thread that works.
enum Message<P, T> {
    Progress(P),
    Done(thread::Result<T>),
}

/// Whether the caller wants the work to go on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    Continue,
    /// End with the current result.
    Finish,
    /// The result is of no use any more.
    Abandon,
}

/// The way of the thread that works to the one that waits.
pub struct Reporter<P, T> {
    cancel: Cancel,
    messages: SyncSender<Message<P, T>>,
    answers: Receiver<Answer>,
    is_heard: bool,
}

impl<P, T> Reporter<P, T> {
    /// Asks the caller, who sees `progress` where there is a progress function.
    pub fn ask(&self, progress: impl FnOnce() -> P) -> Answer {
        if self.is_abandoned() {
            return Answer::Abandon;
        }
        if !self.is_heard {
            return Answer::Continue;
        }
        let sent = self.messages.send(Message::Progress(progress()));
        let answer = sent.ok().and_then(|()| self.answers.recv().ok());
        answer.unwrap_or(Answer::Abandon)
    }

    /// Whether nobody waits for the result any more.
    pub fn is_abandoned(&self) -> bool {
        self.cancel.is_cancelled()
    }

    /// Cancelled where nobody waits for the result any more.
    pub fn cancel(&self) -> &Cancel {
        &self.cancel
    }
}

/// A progress function: its answer, or the exception that it raised.
pub type OnProgress<'f, P> = &'f dyn Fn(Python<'_>, P) -> PyResult<Answer>;

/// Ends calls of other Python threads, which do not hear Ctrl-C.
#[pyclass(name = "_Cancel", module = "rowburst._rowburst", frozen)]
#[derive(Default)]
pub struct PyCancel {
    pub cancel: Cancel,
}

#[pymethods]
impl PyCancel {
    #[new]
    fn new() -> Self {
        Self::default()
    }

    /// Ends the calls that have this token; they raise a WorkError.
    fn cancel(&self) {
        self.cancel.cancel();
    }
}

/// Does `work` without the interpreter's lock, on `threads` threads; `None`: as many as the process has.
///
/// # Errors
/// Ctrl-C, an exception of `on_progress`, and those of [`Threads::borrow`].
pub fn interruptibly<P: Send + 'static, T: Send + 'static>(
    py: Python<'_>,
    threads: Option<usize>,
    on_progress: Option<OnProgress<'_, P>>,
    work: impl FnOnce(&Reporter<P, T>) -> T + Send + 'static,
) -> PyResult<T> {
    interruptibly_with(py, threads, Cancel::default(), on_progress, work)
}

/// Like [`interruptibly`], until `cancel` is cancelled.
///
/// # Errors
/// Those of [`interruptibly`], and that it is cancelled.
pub fn interruptibly_with<P: Send + 'static, T: Send + 'static>(
    py: Python<'_>,
    threads: Option<usize>,
    cancel: Cancel,
    on_progress: Option<OnProgress<'_, P>>,
    work: impl FnOnce(&Reporter<P, T>) -> T + Send + 'static,
) -> PyResult<T> {
    let threads = Threads::borrow(threads)?;
    log::begin(py)?;
    let (messages, inbox) = sync_channel(0);
    // Only to lend it to the closure below: there is one receiver.
    let inbox = Mutex::new(inbox);
    let next = || {
        let inbox = inbox.lock().unwrap_or_else(PoisonError::into_inner);
        inbox.recv_timeout(POLL_INTERVAL)
    };
    let (answer, answers) = sync_channel(0);
    let reporter = Reporter {
        cancel: cancel.clone(),
        messages,
        answers,
        is_heard: on_progress.is_some(),
    };
    let result = reporter.messages.clone();
    let job = move || {
        let done = catch_unwind(AssertUnwindSafe(move || {
            threads.install(move || work(&reporter))
        }));
        // Where nobody waits any more, the result is dropped.
        let _ = result.send(Message::Done(done));
    };
    let spawned = thread::Builder::new().name("rowburst".into()).spawn(job);
    spawned.map_err(|error| {
        let remedy = "End other programs, or raise the limit of processes (ulimit -u).";
        to_py_err(Error::work(Parameter::Threads, error, remedy))
    })?;
    let abandon = |error: PyErr| {
        cancel.cancel();
        error
    };
    loop {
        let message = py.detach(next);
        log::flush(py).map_err(abandon)?;
        match message {
            Ok(Message::Done(Ok(done))) => return Ok(done),
            Ok(Message::Done(Err(panic))) => resume_unwind(panic),
            Ok(Message::Progress(progress)) => {
                py.check_signals().map_err(abandon)?;
                let on_progress = on_progress.expect("only a heard reporter sends progress");
                let found = on_progress(py, progress).map_err(abandon)?;
                // Not sent where the thread has ended, which the next message tells.
                let _ = answer.send(found);
            }
            Err(RecvTimeoutError::Timeout) => {
                py.check_signals().map_err(abandon)?;
                cancel.check().map_err(to_py_err)?;
            }
            Err(RecvTimeoutError::Disconnected) => {
                unreachable!("the thread sends its result before it ends")
            }
        }
    }
}
