//! Measures the time of a run, ends it at its time budget, and records its convergence.

use crate::event::IterationMetrics;
use rowburst::Video;
use rowburst::metrics::psnr_db;
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst_report::Iteration;
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

/// Last iteration up to which every iteration is a point of the convergence curve; larger records more and
/// compares more often with the truth.
const DENSE_RECORD_ITERATIONS: usize = 50;
/// Iterations between two later points; smaller records more.
const RECORD_INTERVAL: usize = 5;

/// The clock and the recorder of a run. The observer of the solver calls [`Self::observe`].
pub struct RunClock<'a> {
    solver_start: Instant,
    budget: Option<Duration>,
    sigma: f64,
    truth: Option<&'a Video>,
    /// Iterations so far, with those of candidates of the prior.
    iterations: usize,
    /// Time of comparisons with the truth and of [`Self::untimed`], which is not the solver's.
    untimed: Duration,
    /// Metrics of the last iteration.
    metrics: IterationMetrics,
    /// The points of the convergence curve.
    pub convergence: Vec<Iteration>,
}

impl<'a> RunClock<'a> {
    /// Starts the clock. `sigma` is the noise level in counts; `budget` limits the time of the solver from now on.
    pub fn new(sigma: f64, truth: Option<&'a Video>, budget: Option<Duration>) -> Self {
        Self {
            solver_start: Instant::now(),
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
            convergence: Vec::new(),
        }
    }

    /// Time from `process_start` to the start of the clock, in seconds.
    pub fn start_offset_s(&self, process_start: Instant) -> f64 {
        (self.solver_start - process_start).as_secs_f64()
    }

    /// Time of the solver so far, in seconds.
    pub fn seconds(&self) -> f64 {
        (self.solver_start.elapsed() - self.untimed).as_secs_f64()
    }

    /// Calls `act` with the metrics of the last iteration, and does not count its time as the solver's.
    pub fn untimed<T>(&mut self, act: impl FnOnce(&IterationMetrics) -> T) -> T {
        let untimed_start = Instant::now();
        let result = act(&self.metrics);
        self.untimed += untimed_start.elapsed();
        result
    }

    /// Records an iteration. Breaks where the next iteration would exceed the time budget.
    pub fn observe(&mut self, progress: &Progress) -> ControlFlow<StopReason> {
        let seconds = self.seconds();
        self.iterations += 1;
        if progress.iteration == 1 {
            // Another run has begun; the curve holds the last run alone.
            self.convergence.clear();
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
            self.metrics.psnr_db = truth.map(|truth| psnr_db(&progress.video.get(), truth.data()));
            self.convergence.push(Iteration {
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
            Some(budget) if seconds + per_iteration > budget.as_secs_f64() => {
                ControlFlow::Break(StopReason::TimeBudget)
            }
            _ => ControlFlow::Continue(()),
        }
    }

    /// Replaces the noise level by `sigma`, which the run has determined, also in the convergence curve.
    pub fn rescale(&mut self, sigma: f64) {
        let factor = self.sigma / sigma;
        for point in &mut self.convergence {
            point.residual_over_sigma *= factor;
        }
        self.sigma = sigma;
    }
}
