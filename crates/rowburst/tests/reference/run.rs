//! What the reference solvers share: when to stop, and what they return.

use super::certifier::residual;
use super::{Certifier, Objective};
use rowburst::solve::admm::{Progress, VideoOfIteration};
use rowburst::solve::{Certificate, StopReason};
use std::ops::ControlFlow;

/// When a reference solver stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Most iterations.
    pub max_iterations: usize,
    /// [`Certificate::excess`] at which it stops: how far the objective may be above its
    /// minimum.
    pub tolerance: f64,
}

impl Default for Limits {
    /// 0.01 % within 20,000 iterations.
    fn default() -> Self {
        Self {
            max_iterations: 20_000,
            tolerance: 1e-4,
        }
    }
}

/// What a reference solver found.
#[derive(Debug, Clone)]
pub struct CertifiedSolution {
    /// The video, `[t, y, x]`.
    pub video: Vec<f32>,
    /// Its objective, and the bound of the minimum.
    pub certificate: Certificate,
    /// Iterations done.
    pub iterations: usize,
    /// Why it stopped.
    pub stop_reason: StopReason,
}

/// Iterations from one certificate to the next: one costs about as much as an iteration.
const CHECK_INTERVAL: usize = 20;

/// Watches a solver: shows its iterates to the observer, certifies them, and stops it.
pub(super) struct Watch<'a, 'o> {
    objective: &'a Objective<'a>,
    certifier: Certifier<'a>,
    certificate: Certificate,
    limits: Limits,
    observer: Observer<'o>,
    iterations: usize,
}

type Observer<'o> = &'o mut dyn FnMut(&Progress) -> ControlFlow<StopReason>;

/// An iterate with its duals.
pub(super) struct Iterate<'v> {
    pub video: &'v [f32],
    /// `A v`.
    pub light: &'v [f32],
    /// Relative change of the video.
    pub change: f64,
    /// The solver's `y`; `None`: the residual.
    pub y: Option<&'v [f32]>,
    /// The dual of the differences, within its balls.
    pub p: &'v [f32],
}

impl<'a, 'o> Watch<'a, 'o> {
    pub fn new(objective: &'a Objective<'a>, limits: Limits, observer: Observer<'o>) -> Self {
        Self {
            objective,
            certifier: Certifier::new(objective),
            certificate: Certificate {
                primal: f64::INFINITY,
                dual: 0.0,
            },
            limits,
            observer,
            iterations: 0,
        }
    }

    /// To be called after each iteration.
    pub fn see(&mut self, iterate: &Iterate) -> ControlFlow<StopReason> {
        self.iterations += 1;
        let k = self.iterations;
        let certifies =
            k == 1 || k.is_multiple_of(CHECK_INTERVAL) || k == self.limits.max_iterations;
        if certifies {
            self.certify(iterate);
        }
        (self.observer)(&Progress {
            label: "",
            runs_left: 0,
            iteration: k,
            max_iterations: self.limits.max_iterations,
            video: VideoOfIteration::Solved(iterate.video),
            residual_rms: self.objective.residual_rms(iterate.light),
            objective: self.certificate.primal,
            tau: self.objective.tau(),
            change: iterate.change,
            support_fraction: 1.0,
        })?;
        if certifies && self.certificate.excess() <= self.limits.tolerance {
            return ControlFlow::Break(StopReason::Converged);
        }
        if k >= self.limits.max_iterations {
            return ControlFlow::Break(StopReason::IterationLimit);
        }
        ControlFlow::Continue(())
    }

    /// Iterations seen.
    pub fn iterations(&self) -> usize {
        self.iterations
    }

    fn certify(&mut self, iterate: &Iterate) {
        let rest = residual(self.objective, iterate.light);
        self.certifier.improve_with(&rest, iterate.p);
        if let Some(y) = iterate.y {
            self.certifier.improve_with(y, iterate.p);
        }
        self.certificate = Certificate {
            primal: self.objective.value_with(iterate.video, iterate.light),
            dual: self.certifier.best(),
        };
    }

    /// The result; `A v` is computed afresh.
    pub fn finish(self, video: Vec<f32>, stop_reason: StopReason) -> CertifiedSolution {
        let mut light = vec![0.0; self.objective.operator().range_len()];
        self.objective.operator().apply(&video, &mut light);
        CertifiedSolution {
            certificate: Certificate {
                primal: self.objective.value_with(&video, &light),
                dual: self.certifier.best(),
            },
            video,
            iterations: self.iterations,
            stop_reason,
        }
    }
}

/// `‖a − b‖ / ‖a‖`, 0 where `a` is zero.
pub(super) fn relative_change(now: &[f32], before: &[f32]) -> f64 {
    let size = rowburst::vecmath::norm(now);
    if size == 0.0 {
        0.0
    } else {
        rowburst::vecmath::distance_squared(now, before).sqrt() / size
    }
}

/// The first video, and `A` of it: `start` without what is below zero, or darkness.
///
/// # Panics
/// If its length is not that of the problem.
pub(super) fn begin(objective: &Objective, start: Option<&[f32]>) -> (Vec<f32>, Vec<f32>) {
    let operator = objective.operator();
    let mut light = vec![0.0; operator.range_len()];
    let Some(start) = start else {
        return (vec![0.0; operator.domain_len()], light);
    };
    assert_eq!(start.len(), operator.domain_len(), "length of the start");
    let video: Vec<f32> = start.iter().map(|v| v.max(0.0)).collect();
    operator.apply(&video, &mut light);
    (video, light)
}
