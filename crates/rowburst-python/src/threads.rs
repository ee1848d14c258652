//! The threads of this process: started by the first computation, and absent after a fork.
//!
//! A fork copies the memory of a process and only the thread that called it. Rayon's pools then exist without their
//! threads, and would never answer; so the process that started them is recorded.

use crate::error::{WorkError, to_py_err};
use crate::log;
use pyo3::prelude::*;
use rayon::ThreadPool;
use rowburst::{Error, Parameter};
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};

/// The process that started the threads; 0 before they are started.
static OWNER: AtomicU32 = AtomicU32::new(0);
/// Number of threads to start; 0 for rayon's default.
static REQUESTED: AtomicUsize = AtomicUsize::new(0);
/// Number of threads of a call that does not choose its own, once some are started.
static STARTED: OnceLock<usize> = OnceLock::new();
/// Pools that no call uses. They are not rayon's global one, which other libraries may use.
static IDLE: Mutex<Vec<ThreadPool>> = Mutex::new(Vec::new());
/// Most threads of a call on a machine that has not as many cores: each thread takes memory.
const MAX_THREADS: usize = 1024;
/// Most pools that are kept.
const MAX_IDLE: usize = 8;

/// The threads of one call. Each call has a pool of its own: in a shared one a thread that waits could begin another
/// call, and wait for a lock that it holds itself.
pub struct Threads(Option<ThreadPool>);

impl Threads {
    /// Idle threads of this process, or new ones; `None`: as many as [`set_threads`] says.
    ///
    /// # Errors
    /// A process that was forked after threads were started, or threads that the system refuses.
    pub fn borrow(count: Option<usize>) -> PyResult<Self> {
        check_process()?;
        let count = count.or_else(|| STARTED.get().copied());
        let mut idle = IDLE.lock().unwrap_or_else(PoisonError::into_inner);
        let same = |pool: &ThreadPool| Some(pool.current_num_threads()) == count;
        if let Some(at) = idle.iter().position(same) {
            return Ok(Self(Some(idle.swap_remove(at))));
        }
        drop(idle);
        let requested = count.unwrap_or_else(|| REQUESTED.load(Ordering::Relaxed));
        let pool = rayon::ThreadPoolBuilder::new().num_threads(requested);
        let pool = pool.build().map_err(|reason| {
            let remedy = "Give a smaller number, or call rowburst.set_threads with one first.";
            to_py_err(Error::work(Parameter::Threads, reason, remedy))
        })?;
        if count.is_none() {
            STARTED.get_or_init(|| pool.current_num_threads());
        }
        Ok(Self(Some(pool)))
    }

    /// Runs `work` on these threads.
    pub fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.0
            .as_ref()
            .expect("it is there until the drop")
            .install(work)
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        let mut idle = IDLE.lock().unwrap_or_else(PoisonError::into_inner);
        if idle.len() < MAX_IDLE {
            idle.extend(self.0.take());
        }
    }
}

/// Runs `work` on threads of this process, without the interpreter's lock.
///
/// # Errors
/// Those of [`Threads::borrow`].
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    let threads = Threads::borrow(None)?;
    log::begin(py)?;
    let done = py.detach(|| threads.install(work));
    log::flush(py)?;
    Ok(done)
}

/// Checks that threads of this process can run.
///
/// # Errors
/// A process that was forked after threads were started.
pub fn check_process() -> PyResult<()> {
    let here = std::process::id();
    let owner = OWNER.compare_exchange(0, here, Ordering::AcqRel, Ordering::Acquire);
    if owner.is_err_and(|owner| owner != here) {
        return Err(forked());
    }
    Ok(())
}

/// Checks the number of threads of a call.
///
/// # Errors
/// No thread, or more than [`MAX_THREADS`] and than there are cores.
pub fn checked_count(threads: usize) -> PyResult<usize> {
    checked(threads, "Leave it out for all threads.")
}

fn checked(threads: usize, remedy: &'static str) -> PyResult<usize> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let most = MAX_THREADS.max(cores);
    if (1..=most).contains(&threads) {
        return Ok(threads);
    }
    let rule = format!("there is at least one, and at most {most}");
    let error = Error::input(Parameter::Threads, threads, rule, remedy);
    Err(to_py_err(error))
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
///
/// Parameters
/// ----------
/// threads : int
///     Number of threads.
///
/// Raises
/// ------
/// InputError
///     The number is below 1.
/// WorkError
///     Another number runs already, or the process was forked.
///
/// Examples
/// --------
/// >>> rb.set_threads(rb.threads())
#[allow(clippy::doc_lazy_continuation)]
#[pyfunction]
pub fn set_threads(threads: crate::whole::Whole) -> PyResult<()> {
    let threads = checked(threads.named("threads")?, "Give the number of cores.")?;
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

/// Number of threads of a call, once some are started.
fn running_threads() -> usize {
    STARTED.get().copied().unwrap_or_else(expected_threads)
}

/// Number of threads that computations use.
///
/// Returns
/// -------
/// int
///     Threads of this process.
///
/// Examples
/// --------
/// >>> rb.threads() >= 1
/// True
#[allow(clippy::doc_lazy_continuation)]
#[pyfunction]
pub fn threads() -> usize {
    if OWNER.load(Ordering::Acquire) == std::process::id() {
        return running_threads();
    }
    expected_threads()
}

/// Number of threads as rayon counts, without starting them.
fn expected_threads() -> usize {
    let requested = Some(REQUESTED.load(Ordering::Relaxed));
    let variable = || std::env::var("RAYON_NUM_THREADS").ok()?.parse().ok();
    let cores = || std::thread::available_parallelism().map_or(1, usize::from);
    let is_positive = |n: &usize| *n > 0;
    let found = requested.filter(is_positive);
    let found = found.or_else(|| variable().filter(is_positive));
    found.unwrap_or_else(cores)
}
