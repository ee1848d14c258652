//! The threads of this process: started by the first computation, and absent after a fork.
//!
//! A fork copies the memory of a process and only the thread that called it. Rayon's pool then exists
//! without its threads, and waits for them for ever; so the process that started them is recorded.

use crate::error::{WorkError, to_py_err};
use crate::log;
use pyo3::prelude::*;
use rayon::ThreadPool;
use rowburst::{Error, Parameter};
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

/// The process that started the threads; 0 before they are started.
static OWNER: AtomicU32 = AtomicU32::new(0);
/// Number of threads to start; 0 for rayon's default.
static REQUESTED: AtomicUsize = AtomicUsize::new(0);
/// The started pool, or why it could not be started. It is not rayon's global one, which other libraries may use.
static POOL: OnceLock<Result<Arc<ThreadPool>, String>> = OnceLock::new();

/// Runs `work` on the threads of this process, without the interpreter's lock.
///
/// # Errors
/// A process that was forked after the threads were started.
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    let pool = start()?;
    log::begin(py)?;
    let done = py.detach(|| pool.install(work));
    log::flush(py)?;
    Ok(done)
}

/// The threads of this process. They are started if they do not run yet.
///
/// # Errors
/// A process that was forked after the threads were started, or threads that the system refuses.
pub fn start() -> PyResult<Arc<ThreadPool>> {
    let here = std::process::id();
    let owner = OWNER.compare_exchange(0, here, Ordering::AcqRel, Ordering::Acquire);
    if owner.is_err_and(|owner| owner != here) {
        return Err(forked());
    }
    let pool = POOL.get_or_init(|| {
        let threads = REQUESTED.load(Ordering::Relaxed);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build()
            .map(Arc::new)
            .map_err(|error| error.to_string())
    });
    pool.clone().map_err(|reason| {
        let remedy = "Call rowburst.set_threads with a smaller number before anything is computed.";
        to_py_err(Error::work(Parameter::Threads, reason, remedy))
    })
}

/// Threads for one caller alone.
///
/// # Errors
/// No thread, or more than the system allows.
pub fn pool_of(threads: usize) -> PyResult<Arc<ThreadPool>> {
    if threads == 0 {
        let rule = "there is at least one";
        let error = Error::input(Parameter::Threads, 0, rule, "Leave it out for all threads.");
        return Err(to_py_err(error));
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    pool.map(Arc::new).map_err(|reason| {
        let remedy = "Give a smaller number.";
        to_py_err(Error::work(Parameter::Threads, reason, remedy))
    })
}

/// The error of a process whose threads stayed in its parent.
fn forked() -> PyErr {
    WorkError::new_err(
        "process: it was forked from a process in which rowburst had already computed; threads do not survive \
         a fork, so nothing can be computed here. Start processes by multiprocessing.get_context(\"spawn\") or \
         \"forkserver\" (PyTorch: DataLoader(..., multiprocessing_context=\"spawn\"); concurrent.futures: \
         mp_context=), or compute nothing with rowburst before the fork.",
    )
}

/// Sets the number of threads of this process, before anything is computed.
///
/// Later only the number that runs already is accepted.
#[pyfunction]
pub fn set_threads(threads: crate::whole::Whole) -> PyResult<()> {
    let threads = threads.named("threads")?;
    if threads == 0 {
        let rule = "there is at least one";
        let error = Error::input(Parameter::Threads, 0, rule, "Give the number of cores.");
        return Err(to_py_err(error));
    }
    let owner = OWNER.load(Ordering::Acquire);
    if owner == 0 {
        REQUESTED.store(threads, Ordering::Relaxed);
        return Ok(());
    }
    if owner != std::process::id() {
        return Err(forked());
    }
    let running = running_threads();
    if running == threads {
        return Ok(());
    }
    Err(to_py_err(Error::work(
        Parameter::Threads,
        format!(
            "{threads} are requested and {running} run already: their number is fixed by the first computation"
        ),
        "Restart the interpreter (in Jupyter, the kernel) and call rowburst.set_threads first, or set the \
         environment variable RAYON_NUM_THREADS.",
    )))
}

/// Number of threads that run.
fn running_threads() -> usize {
    let pool = POOL.get().and_then(|pool| pool.as_ref().ok());
    pool.map_or(0, |pool| pool.current_num_threads())
}

/// Number of threads that computations use.
#[pyfunction]
pub fn threads() -> usize {
    if OWNER.load(Ordering::Acquire) == std::process::id() {
        return running_threads();
    }
    // As rayon counts, without starting the threads.
    let requested = Some(REQUESTED.load(Ordering::Relaxed));
    let variable = || std::env::var("RAYON_NUM_THREADS").ok()?.parse().ok();
    let cores = || std::thread::available_parallelism().map_or(1, usize::from);
    let is_positive = |n: &usize| *n > 0;
    let found = requested.filter(is_positive);
    let found = found.or_else(|| variable().filter(is_positive));
    found.unwrap_or_else(cores)
}
