//! Progress bar, time budget and Ctrl-C: all are observers of the solver.

use indicatif::{ProgressBar, ProgressStyle};
use rowburst::Video;
use rowburst::metrics::psnr_db;
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst_report::Iteration;
#[cfg(feature = "view")]
use rowburst_view::{Live, Point};
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

/// Time between two videos that are shown while it runs.
#[cfg(feature = "view")]
const BETWEEN_PICTURES: Duration = Duration::from_millis(250);

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
    /// The page that watches.
    #[cfg(feature = "view")]
    page: Option<(Arc<Live>, Instant)>,
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
            #[cfg(feature = "view")]
            page: None,
            curve: Vec::new(),
        }
    }

    /// Shows the run to `live`, too.
    #[cfg(feature = "view")]
    #[must_use]
    pub fn shown_by(mut self, live: Option<Arc<Live>>) -> Self {
        self.page = live.map(|live| (live, self.start));
        self
    }

    #[cfg(feature = "view")]
    fn show(&mut self, progress: &Progress, seconds: f64, psnr_db: Option<f64>) {
        let sigma = self.sigma;
        let Some((live, last)) = &mut self.page else {
            return;
        };
        let point = Point {
            iteration: progress.iteration,
            max_iterations: progress.max_iterations,
            seconds,
            residual_over_sigma: progress.residual_rms / sigma,
            psnr_db,
        };
        live.point(progress.label, point);
        if live.is_wanted() && last.elapsed() > BETWEEN_PICTURES {
            live.show(progress.video);
            *last = Instant::now();
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
        let compared = Instant::now();
        #[cfg(feature = "view")]
        let mut psnr = None;
        if progress.iteration <= RECORD_ALL || progress.iteration.is_multiple_of(RECORD_EVERY) {
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
            #[cfg(feature = "view")]
            {
                psnr = self.curve.last().and_then(|point| point.psnr_db);
            }
        }
        #[cfg(feature = "view")]
        self.show(progress, seconds, psnr);
        self.aside += compared.elapsed();
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
        eprintln!("\nstopping; {talk} (Ctrl-C again to leave at once)");
    });
    stop
}
