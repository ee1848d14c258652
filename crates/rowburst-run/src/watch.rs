//! The clock beside the solver: its time, its budget and its course.

use crate::task::IterationMetrics;
use rowburst::Video;
use rowburst::metrics::psnr_db;
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst_report::Iteration;
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

/// Every iteration up to this one is a point of the convergence curve; most of the quality is
/// gained in these.
const DENSE_RECORD_ITERATIONS: usize = 50;
/// Iterations between two points after these.
const RECORD_INTERVAL: usize = 5;

/// Watches a run.
pub struct RunClock<'a> {
    start: Instant,
    budget: Option<Duration>,
    sigma: f64,
    truth: Option<&'a Video>,
    /// Iterations of all runs.
    iterations: usize,
    /// Time spent on comparing with the truth and on showing, which is not the solver's.
    untimed: Duration,
    metrics: IterationMetrics,
    /// The points of the convergence curve.
    pub curve: Vec<Iteration>,
}

impl<'a> RunClock<'a> {
    /// Starts the clock of the solver, which `budget` counts from.
    pub fn new(sigma: f64, truth: Option<&'a Video>, budget: Option<Duration>) -> Self {
        Self {
            start: Instant::now(),
            budget,
            sigma,
            truth,
            iterations: 0,
            untimed: Duration::ZERO,
            metrics: IterationMetrics {
                seconds: 0.0,
                residual_over_sigma: f64::NAN,
                psnr_db: None,
            },
            curve: Vec::new(),
        }
    }

    /// Seconds from `began` to the start of the solver's clock.
    pub fn start_offset_s(&self, began: Instant) -> f64 {
        (self.start - began).as_secs_f64()
    }

    /// Seconds of the solver so far.
    pub fn seconds(&self) -> f64 {
        (self.start.elapsed() - self.untimed).as_secs_f64()
    }

    /// Does with the last iteration what takes no time of the solver's.
    pub fn untimed<T>(&mut self, what: impl FnOnce(&IterationMetrics) -> T) -> T {
        let began = Instant::now();
        let done = what(&self.metrics);
        self.untimed += began.elapsed();
        done
    }

    /// Sees one iteration.
    pub fn observe(&mut self, progress: &Progress) -> ControlFlow<StopReason> {
        let seconds = self.seconds();
        self.iterations += 1;
        if progress.iteration == 1 {
            // Another run: the curve is that of the last one.
            self.curve.clear();
        }
        self.metrics = IterationMetrics {
            seconds,
            residual_over_sigma: progress.residual_rms / self.sigma,
            psnr_db: None,
        };
        if progress.iteration <= DENSE_RECORD_ITERATIONS
            || progress.iteration.is_multiple_of(RECORD_INTERVAL)
        {
            let compared = Instant::now();
            let truth = self.truth;
            self.metrics.psnr_db = truth.map(|truth| psnr_db(progress.video, truth.data()));
            self.curve.push(Iteration {
                iteration: progress.iteration,
                seconds,
                objective: progress.objective,
                residual_over_sigma: self.metrics.residual_over_sigma,
                change: progress.change,
                psnr_db: self.metrics.psnr_db,
            });
            self.untimed += compared.elapsed();
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
}
