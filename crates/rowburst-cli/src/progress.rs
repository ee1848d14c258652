//! Progress bar and Ctrl-C: observers of the solver.

use indicatif::{ProgressBar, ProgressStyle};
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst_run::{Chunk, Event, IterationMetrics, is_logging};
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The bar of a run.
pub struct Bar {
    bar: ProgressBar,
    stop: Arc<AtomicBool>,
}

impl Bar {
    /// A bar, hidden where standard error is no terminal or has the log; the run ends where `stop` is set.
    pub fn new(stop: Arc<AtomicBool>) -> Self {
        let bar = if std::io::stderr().is_terminal() && !is_logging() {
            ProgressBar::new(1)
        } else {
            ProgressBar::hidden()
        };
        let template = "{bar:30} iteration {pos} of {len}, at most {eta} left; {msg}";
        let bar = Self { bar, stop };
        bar.set_template(template);
        bar
    }

    fn set_template(&self, template: &str) {
        let style = ProgressStyle::with_template(template);
        self.bar.set_style(style.expect("the template is valid"));
    }

    /// The flag that ends the run.
    #[cfg(feature = "view")]
    pub fn stop(&self) -> &Arc<AtomicBool> {
        &self.stop
    }

    /// Shows an event. The answer ends the run where the flag is set.
    pub fn show(&mut self, event: Event) -> ControlFlow<StopReason> {
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
            Event::Writing => self.finish(),
            _ => {}
        }
        if self.stop.load(Ordering::Relaxed) {
            ControlFlow::Break(StopReason::Interrupted)
        } else {
            ControlFlow::Continue(())
        }
    }

    fn show_iteration(&self, progress: &Progress, metrics: &IterationMetrics) {
        let level = metrics.residual_over_sigma;
        if progress.iteration == 1 {
            self.bar.reset();
        }
        self.bar.set_length(progress.max_iterations as u64);
        self.bar.set_position(progress.iteration as u64);
        self.bar.set_message(match progress.label {
            "" => format!("residual/σ {level:.2}"),
            label => format!("{label}: residual/σ {level:.2}"),
        });
    }

    fn show_chunk(&self, progress: &Progress, chunk: &Chunk) {
        if progress.iteration == 1 {
            self.set_template("{bar:30} bin {pos} of {len}, {eta} left; {msg}");
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

/// Prints a note on the inputs of a run that has no bar.
pub fn print_note(event: Event) -> ControlFlow<StopReason> {
    if let Event::Note(note) = event {
        eprintln!("{note}");
    }
    ControlFlow::Continue(())
}

/// Set once all work is done, and the program is there to be looked at.
static IS_DONE: AtomicBool = AtomicBool::new(false);

/// Waits for Ctrl-C, which then ends the program with status 0.
#[cfg(feature = "view")]
pub fn wait_for_ctrl_c() -> ! {
    IS_DONE.store(true, Ordering::Relaxed);
    loop {
        std::thread::park();
    }
}

/// A flag that Ctrl-C sets, after which the program says `talk`; a second Ctrl-C ends the program
/// at once.
pub fn stop_on_ctrl_c(talk: &'static str) -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    // A handler that cannot be set leaves Ctrl-C to end the program: no reason to fail.
    let _ = ctrlc::set_handler(move || {
        if IS_DONE.load(Ordering::Relaxed) {
            std::process::exit(0);
        }
        if flag.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("\nstopping; {talk} (Ctrl-C again to quit immediately)");
    });
    stop
}
