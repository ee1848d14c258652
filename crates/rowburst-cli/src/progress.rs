//! Progress bar, time budget and Ctrl-C: all are observers of the solver.

use indicatif::{ProgressBar, ProgressStyle};
use rowburst::Video;
use rowburst::metrics::psnr_db;
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst_report::Iteration;
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Every iteration up to this one is a point of the convergence curve; most of the quality is
/// gained in these.
const RECORD_ALL: usize = 50;
/// Iterations between two points after these.
const RECORD_EVERY: usize = 5;

/// Watches a run.
pub struct Watch<'a> {
    start: Instant,
    budget: Option<Duration>,
    stop: Arc<AtomicBool>,
    bar: ProgressBar,
    sigma: f64,
    truth: Option<&'a Video>,
    /// Iterations of all runs.
    iterations: usize,
    /// Time spent on comparing with the truth, which is not the solver's.
    aside: Duration,
    /// The points of the convergence curve.
    pub curve: Vec<Iteration>,
}

impl<'a> Watch<'a> {
    /// Starts the clock of the solver; `started` is the start of the whole run, which
    /// the budget counts from.
    pub fn new(
        sigma: f64,
        truth: Option<&'a Video>,
        budget: Option<Duration>,
        stop: Arc<AtomicBool>,
    ) -> Self {
        let bar = if std::io::stderr().is_terminal() {
            ProgressBar::new(1)
        } else {
            ProgressBar::hidden()
        };
        let style =
            ProgressStyle::with_template("{bar:30} iteration {pos}, at most {eta} left; {msg}");
        bar.set_style(style.expect("the template is valid"));
        Self {
            start: Instant::now(),
            budget,
            stop,
            bar,
            sigma,
            truth,
            iterations: 0,
            aside: Duration::ZERO,
            curve: Vec::new(),
        }
    }

    /// Seconds from `began` to the start of the solver's clock.
    pub fn started_after(&self, began: Instant) -> f64 {
        (self.start - began).as_secs_f64()
    }

    /// Seconds of the solver so far.
    pub fn seconds(&self) -> f64 {
        (self.start.elapsed() - self.aside).as_secs_f64()
    }

    /// Sees one iteration.
    pub fn observe(&mut self, progress: &Progress) -> ControlFlow<StopReason> {
        let seconds = self.seconds();
        self.iterations += 1;
        if progress.iteration == 1 {
            // Another run: the curve is that of the last one.
            self.curve.clear();
            self.bar.reset();
        }
        if progress.iteration <= RECORD_ALL || progress.iteration.is_multiple_of(RECORD_EVERY) {
            let compared = Instant::now();
            self.curve.push(Iteration {
                iteration: progress.iteration,
                seconds,
                objective: progress.objective,
                residual_over_sigma: progress.residual_rms / self.sigma,
                change: progress.change,
                psnr_db: self
                    .truth
                    .map(|truth| psnr_db(progress.video, truth.data())),
            });
            self.aside += compared.elapsed();
        }
        self.bar.set_length(progress.max_iterations as u64);
        self.bar.set_position(progress.iteration as u64);
        let level = progress.residual_rms / self.sigma;
        self.bar.set_message(match progress.label {
            "" => format!("residual/σ {level:.2}"),
            label => format!("{label}: residual/σ {level:.2}"),
        });
        if self.stop.load(Ordering::Relaxed) {
            return ControlFlow::Break(StopReason::Interrupted);
        }
        let per_iteration = seconds / self.iterations as f64;
        match self.budget {
            // The next iteration would end beyond the budget.
            Some(budget) if seconds + per_iteration > budget.as_secs_f64() => {
                ControlFlow::Break(StopReason::TimeBudget)
            }
            _ => ControlFlow::Continue(()),
        }
    }

    /// Takes `sigma` for the noise level, which was found meanwhile.
    pub fn rescale(&mut self, sigma: f64) {
        let factor = self.sigma / sigma;
        for point in &mut self.curve {
            point.residual_over_sigma *= factor;
        }
        self.sigma = sigma;
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// A flag that Ctrl-C sets, after which the program says `talk`; a second Ctrl-C ends the program
/// at once.
pub fn stop_on_ctrl_c(talk: &'static str) -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&stop);
    // A handler that cannot be set leaves Ctrl-C to end the program: no reason to fail.
    let _ = ctrlc::set_handler(move || {
        if flag.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("\nstopping; {talk} (Ctrl-C again to leave at once)");
    });
    stop
}
