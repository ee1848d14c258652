//! Progress bar and Ctrl-C: observers of the solver.

use indicatif::{HumanDuration, ProgressBar, ProgressStyle};
use rowburst::Cancel;
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst_run::{Chunk, Event, IterationMetrics, is_logging};
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::time::{Duration, Instant};

/// The bar of a run.
pub struct Bar {
    bar: ProgressBar,
    stop: Arc<AtomicBool>,
    /// When the first iteration was shown.
    began: Option<Instant>,
    /// Iterations shown.
    iterations: u64,
}

impl Bar {
    /// A bar, hidden where standard error is no terminal or has the log; the run ends where `stop` is set.
    pub fn new(stop: Arc<AtomicBool>) -> Self {
        let bar = if std::io::stderr().is_terminal() && !is_logging() {
            ProgressBar::new(1)
        } else {
            ProgressBar::hidden()
        };
        let bar = Self {
            bar,
            stop,
            began: None,
            iterations: 0,
        };
        bar.set_template("{bar:30} iteration {pos} of {len}; {msg}");
        bar
    }

    fn set_template(&self, template: &str) {
        let style = ProgressStyle::with_template(template);
        self.bar.set_style(style.expect("the template is valid"));
    }

    /// The flag that ends the run.
    pub fn stop(&self) -> &Arc<AtomicBool> {
        &self.stop
    }

    /// Shows an event. The answer ends the run where the flag is set.
    pub fn show(&mut self, event: Event) -> ControlFlow<StopReason> {
        if let Event::Iteration { .. } = event {
            Phase::Running.enter();
        }
        match event {
            Event::Note(note) => eprintln!("{note}"),
            Event::Plane(site) => {
                self.finish();
                eprintln!("{}", site.name());
            }
            Event::Iteration {
                progress,
                chunk: Some(chunk),
                ..
            } => self.show_chunk(progress, chunk),
            Event::Iteration {
                progress, metrics, ..
            } => self.show_iteration(progress, metrics),
            Event::Writing => {
                self.finish();
                if !is_interrupted() {
                    Phase::Writing.enter();
                }
            }
            _ => {}
        }
        if self.stop.load(Ordering::Relaxed) {
            ControlFlow::Break(StopReason::Interrupted)
        } else {
            ControlFlow::Continue(())
        }
    }

    fn show_iteration(&mut self, progress: &Progress, metrics: &IterationMetrics) {
        let level = metrics.residual_over_sigma;
        let elapsed = self.began.get_or_insert_with(Instant::now).elapsed();
        self.iterations += 1;
        let left = longest_time_left(elapsed, self.iterations, progress);
        let left = HumanDuration(left);
        if progress.iteration == 1 {
            self.bar.reset();
        }
        self.bar.set_length(progress.max_iterations as u64);
        self.bar.set_position(progress.iteration as u64);
        self.bar.set_message(match progress.label {
            "" => format!("residual/σ {level:.2}; at most {left:#} left; {HINT}"),
            label => format!(
                "{label}: residual/σ {level:.2}; at most {left:#} left, all runs together; {HINT}"
            ),
        });
    }

    fn show_chunk(&self, progress: &Progress, chunk: &Chunk) {
        if progress.iteration == 1 {
            self.set_template(
                "{bar:30} bin {pos} of {len}, {eta} left; {msg}; Ctrl-C keeps the finished chunks",
            );
            self.bar.set_position(chunk.bins.start as u64);
        }
        self.bar.set_length(chunk.video_bins as u64);
        self.bar
            .set_message(format!("iteration {}", progress.iteration));
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// What Ctrl-C does while the bar is there.
const HINT: &str = "Ctrl-C writes the video so far";

/// The time that is left at most, over this run and those that follow it, after `iterations` in the time `elapsed`.
fn longest_time_left(elapsed: Duration, iterations: u64, progress: &Progress) -> Duration {
    let of_this = progress.max_iterations.saturating_sub(progress.iteration);
    let left = of_this + progress.runs_left * progress.max_iterations;
    // To whole seconds, which do not flicker.
    let seconds = elapsed.as_secs_f64() / iterations as f64 * left as f64;
    Duration::from_secs_f64(seconds.ceil())
}

/// Prints a note on the inputs of a run that has no bar.
pub fn print_note(event: Event) -> ControlFlow<StopReason> {
    if let Event::Note(note) = event {
        eprintln!("{note}");
    }
    ControlFlow::Continue(())
}

/// The phase that the program is in.
static PHASE: AtomicU8 = AtomicU8::new(Phase::SetUp as u8);
/// Whether Ctrl-C has ended the run.
static IS_INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// A phase of the program, which decides what Ctrl-C does.
#[derive(Clone, Copy)]
enum Phase {
    /// Reading and setting up: there is no result yet.
    SetUp,
    /// Iterating.
    Running,
    /// Writing a result that is complete.
    Writing,
    /// All work is done, and the program is there to be looked at.
    Done,
}

impl Phase {
    fn enter(self) {
        PHASE.store(self as u8, Ordering::Relaxed);
    }

    fn is_now(self) -> bool {
        PHASE.load(Ordering::Relaxed) == self as u8
    }
}

/// A run begins: it has no result yet.
pub fn begin_run() {
    Phase::SetUp.enter();
}

/// Exit status of a program that Ctrl-C has ended.
pub const INTERRUPTED: u8 = 130;

/// Longest time from Ctrl-C to the end where there is nothing to write.
const GRACE: Duration = Duration::from_millis(500);

/// Whether Ctrl-C has ended the run.
pub fn is_interrupted() -> bool {
    IS_INTERRUPTED.load(Ordering::Relaxed)
}

/// Waits for Ctrl-C, which then ends the program with status 0.
#[cfg(feature = "view")]
pub fn wait_for_ctrl_c() -> ! {
    Phase::Done.enter();
    loop {
        std::thread::park();
    }
}

/// What Ctrl-C cancels.
#[derive(Clone, Default)]
pub struct Interrupt {
    /// Reading, set-up and iterations; the result so far is then written.
    pub run: Arc<AtomicBool>,
    /// Writing: by the second Ctrl-C.
    pub writing: Cancel,
}

/// What is kept after Ctrl-C.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kept {
    /// The result so far, if there is one.
    Result,
    /// The frames that are finished, from which the same command resumes.
    #[cfg(feature = "batch")]
    Frames,
    /// The chunks that are finished, from which the same command resumes.
    Chunks,
    /// The frames that are recorded.
    Recorded,
}

impl Kept {
    /// Whether the program has or will have something to keep, so that it ends by itself.
    fn has_something(self) -> bool {
        let is_kept_at_once = match self {
            Self::Result | Self::Chunks => false,
            #[cfg(feature = "batch")]
            Self::Frames => true,
            Self::Recorded => true,
        };
        is_kept_at_once || Phase::Running.is_now() || Phase::Writing.is_now()
    }

    fn text(self) -> &'static str {
        match self {
            Self::Result => "the current result will be written",
            #[cfg(feature = "batch")]
            Self::Frames => "finished frames are kept; the same command resumes",
            Self::Chunks => "finished chunks are kept; the same command resumes",
            Self::Recorded => "the frames so far are kept",
        }
    }
}

impl Interrupt {
    /// Listens for Ctrl-C. Where nothing is to be kept the program ends within a second, as after a second Ctrl-C.
    pub fn listen(kept: Kept) -> Self {
        let interrupt = Self::default();
        let cancelled = interrupt.clone();
        // A handler that cannot be set leaves Ctrl-C to end the program: no reason to fail.
        let _ = ctrlc::set_handler(move || {
            if Phase::Done.is_now() {
                std::process::exit(0);
            }
            IS_INTERRUPTED.store(true, Ordering::Relaxed);
            let is_second = cancelled.run.swap(true, Ordering::Relaxed);
            if !is_second && kept.has_something() {
                eprintln!(
                    "\nstopping; {} (Ctrl-C again to quit immediately)",
                    kept.text()
                );
                return;
            }
            eprintln!("\nstopping");
            cancelled.writing.cancel();
            std::thread::sleep(GRACE);
            std::process::exit(INTERRUPTED.into());
        });
        interrupt
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::solve::admm::VideoOfIteration;

    #[test]
    fn the_time_left_is_that_of_all_runs() {
        let progress = |iteration, runs_left| Progress {
            label: "testing prior 2 of 3, tv",
            runs_left,
            iteration,
            max_iterations: 300,
            video: VideoOfIteration::Solved(&[]),
            residual_rms: 1.0,
            objective: 1.0,
            tau: 1.0,
            change: 0.1,
            support_fraction: 0.1,
        };
        let elapsed = Duration::from_secs(10);
        let seconds = |progress| longest_time_left(elapsed, 500, &progress).as_secs();
        // 100 iterations of this trial, another trial and the final run, at 0.02 s each.
        assert_eq!(seconds(progress(200, 2)), 14);
        assert_eq!(seconds(progress(300, 0)), 0);
    }
}
