//! ADMM with the exact proximal step of the data term.
//!
//! `min_v f(v) + τ R(v)` is split into `x = z`: `x` takes the step of the data term,
//!
//! ```text
//! x = argmin ½‖b − A x‖² + ρ/2 ‖x − p‖² = p + Aᵀ (A Aᵀ + ρI)⁻¹ (b − A p),   p = z − u
//! ```
//!
//! and `z` the prox of the prior with `β = τ/ρ` (Boyd et al. 2011; over-relaxed), of a point `q`; the scaled dual is
//! what that leaves, `u = q − z`, and is not kept.
//! `A z` is the only product with `A` in an iteration: `A x` follows from the solve,
//! and `A q` by addition.
//!
//! **Threshold.** `β` is what the prior takes from the video in a step; it is a fixed
//! part of the video's own brightness, so nothing depends on the units of the data. At first
//! it is larger: digits of 18 px come within 0.5 dB of their end after 60 iterations, three LEDs after 57
//! (`cargo bench --bench solver`; 158 and 88 with a constant one in a trial).
//!
//! **τ by discrepancy.** With the noise `σ` known the problem is `min R(v)` with
//! `‖b − A v‖² ≤ σ²(m − df)`: the same iteration, with `ρ` now the multiplier that
//! puts `x` on the bound, corrected a little in every iteration; `τ = ρβ` comes out.
//! The `df` values that the fit spends (see [`Prox::degrees_of_freedom`]) take their
//! share of the noise with them, so the bound lies below `σ²m`; at `σ²m` itself
//! pictures of digits are over-smoothed (1.5 dB in a trial without the support).
//!
//! **Support.** A sparse scene lights few voxels. Once the video has taken shape, it is
//! restricted to its bright voxels and their neighbours, found anew every few
//! iterations: the limit of reweighted ℓ1 (Candès, Wakin & Boyd 2008). The data then
//! determine what is left far better, and the iteration, whose slow part is light that
//! hides in dark voxels, converges in a few steps. Where
//! they cannot explain what was measured of a bin, and come no nearer to it, its threshold is
//! lowered and the voxels are added to which the residual points, `Aᵀ(b − A v)`; in the end all are.
//! With hundreds of voxels for each measurement the video takes shape slowly, and all this waits for it.
//!
//! **When it stops.** Every `y` and every `c` of the prior's dual (`⟨c, v⟩ ≤ τ R(v)`) give
//!
//! ```text
//! min F ≥ ⟨b, y⟩ − ½‖y‖² − v_max Σ (Aᵀy − c)₊     over videos 0 ≤ v ≤ v_max on the support
//! ```
//!
//! (weak duality; Boyd & Vandenberghe 2004, ch. 5). The data step gives `y = b − A x` and the
//! prior's step `c`, and their excess `(Aᵀy − c)₊` is at most `ρ` times how far the video has
//! moved, so the bound closes as the iteration ends. `v_max` is twice the brightest voxel. It
//! stops once the objective is proved to be within [`AdmmParams::tolerance`] of its minimum:
//! for the `τ` that was found and on the support that was found.

mod state;
mod support_estimator;

pub(crate) use state::{MAX_FREEDOM, brightness};

use super::{Certificate, DataTerm, StopReason};
use crate::Shape;
use crate::prox::Prox;
use state::State;
use std::ops::ControlFlow;

/// How `τ` is found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TauRule {
    /// Given.
    Fixed(f64),
    /// By the discrepancy principle, for noise of this standard deviation.
    Discrepancy {
        /// Standard deviation of the noise in the units of `b`.
        sigma: f64,
    },
}

/// Parameters of [`solve`]; `default` is what the tables in the documentation use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdmmParams {
    /// How `τ` is found.
    pub tau: TauRule,
    /// Over-relaxation, between 1 and 2.
    pub relaxation: f64,
    /// `β` over the brightness of the video.
    pub threshold: f64,
    /// Most iterations.
    pub max_iterations: usize,
    /// [`Certificate::excess`] at which it stops: how far the objective may be above its
    /// minimum. With the support found from iteration 60 on, digits, LEDs and a moving digit ended
    /// within 0.1 dB of each other for 0.05 to 0.001, larger digits gained 1.5 dB.
    pub tolerance: f64,
    /// Whether the video is restricted to its support.
    pub support: bool,
}

impl AdmmParams {
    /// The defaults with `tau`.
    pub fn new(tau: TauRule) -> Self {
        Self {
            tau,
            relaxation: 1.7,
            // In a trial that began at 0.12, digits of 12 px ended within 0.5 dB of each other
            // from 0.01 to 0.03, larger ones within 0.9, LEDs within 1.2; the larger, the fewer
            // iterations.
            threshold: 0.015,
            max_iterations: 300,
            tolerance: 1e-3,
            support: true,
        }
    }
}

/// What an observer sees after each iteration.
#[derive(Debug, Clone, Copy)]
pub struct Progress<'a> {
    /// What the run is for, where it is not the last one.
    pub label: &'a str,
    /// Iterations done.
    pub iteration: usize,
    /// Most iterations.
    pub max_iterations: usize,
    /// The video of this iteration, `[t, y, x]`.
    pub video: &'a [f32],
    /// Root mean square of `b − A v` over the measurements that carry information.
    pub residual_rms: f64,
    /// `½‖b − A v‖² + τ R(v)` at the last iteration that computed it.
    pub objective: f64,
    /// `τ` of this iteration.
    pub tau: f64,
    /// How far the point whose prox the video is has moved, in sizes of the video before; 1 from a dark one. Under the
    /// same prox the video moves no farther.
    pub change: f64,
    /// Part of the voxels that may be lit.
    pub support: f64,
}

/// What [`solve`] found.
#[derive(Debug, Clone)]
pub struct Solution {
    /// The video, `[t, y, x]`.
    pub video: Vec<f32>,
    /// `b − A v`.
    pub residual: Vec<f32>,
    /// `τ` at the end.
    pub tau: f64,
    /// Iterations done.
    pub iterations: usize,
    /// Why it stopped.
    pub stop_reason: StopReason,
    /// Part of the voxels that may be lit.
    pub support: f64,
    /// `½‖b − A v‖² + τ R(v)` at the end, and how far it is from its minimum at most.
    pub certificate: Certificate,
}

/// Minimises `½‖b − A v‖² + τ R(v)` over `v ≥ 0` of `shape`, from `v = 0`.
///
/// `observer` sees every iteration and may stop it; the video so far is returned. Runs of several threads in one pool
/// wait for each other, an iteration at a time: give each its own pool if its time counts.
///
/// # Panics
/// If the shapes of `data`, `prior` and `shape` disagree.
pub fn solve(
    data: &mut dyn DataTerm,
    prior: &mut dyn Prox,
    shape: Shape,
    params: &AdmmParams,
    observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
) -> Solution {
    let mut run = Admm::new(data, shape, *params);
    let stop_reason = run.run(data, prior, params.max_iterations, observer);
    run.solution(data, prior, stop_reason)
}

/// A run that can be halted, be given another `τ` and go on from where it is.
pub struct Admm {
    state: State,
    params: AdmmParams,
    /// At the last iteration that computed it.
    objective: f64,
}

/// Iterations from one certificate to the next: one costs a product with `Aᵀ` and a few passes.
const CERTIFY_EVERY: usize = 5;

impl Admm {
    /// A dark video.
    ///
    /// # Panics
    /// If the shapes of `data` and `shape` disagree.
    pub fn new(data: &dyn DataTerm, shape: Shape, params: AdmmParams) -> Self {
        Self {
            state: State::new(data, shape, &params),
            params,
            objective: f64::INFINITY,
        }
    }

    /// Iterates up to iteration `until`, or until it has converged. `observer` sees every
    /// iteration and may stop it.
    pub fn run(
        &mut self,
        data: &mut dyn DataTerm,
        prior: &mut dyn Prox,
        until: usize,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> StopReason {
        let (state, params) = (&mut self.state, &self.params);
        for k in state.iterations + 1..=until {
            // On a thread of the pool: else each parallel loop would wake one and wait for it.
            let change = rayon::scope(|_| {
                if k > 1 {
                    state.update_parameters(data, prior, params);
                }
                let change = state.data_step(data, params);
                state.prior_step(data, prior);
                change
            });
            state.iterations = k;
            if k % CERTIFY_EVERY == 1 {
                self.objective = state.objective(data, prior);
            }
            let verdict = observer(&Progress {
                label: "",
                iteration: k,
                max_iterations: params.max_iterations.max(until),
                video: state.video(),
                residual_rms: state.residual_rms(data),
                objective: self.objective,
                tau: state.tau(),
                change,
                support: state.support_fraction(),
            });
            if let ControlFlow::Break(reason) = verdict {
                return reason;
            }
            if k.is_multiple_of(CERTIFY_EVERY) && state.is_settled(params) {
                let certificate = state.certify(data, prior);
                if certificate.excess() <= params.tolerance {
                    return StopReason::Converged;
                }
            }
        }
        StopReason::IterationLimit
    }

    /// From now on `τ` is found by this rule.
    pub fn set_tau_rule(&mut self, rule: TauRule, data: &dyn DataTerm) {
        self.state.set_tau_rule(rule, data);
    }

    /// From now on it has converged at this [`AdmmParams::tolerance`].
    pub fn set_tolerance(&mut self, tolerance: f64) {
        self.params.tolerance = tolerance;
    }

    /// Whether it has done so few iterations that its video tells nothing of the scene yet.
    pub fn is_warming_up(&self) -> bool {
        self.state.is_warming_up()
    }

    /// Most iterations.
    pub fn max_iterations(&self) -> usize {
        self.params.max_iterations
    }

    /// `τ` so far.
    pub fn tau(&self) -> f64 {
        self.state.tau()
    }

    /// Iterations done.
    pub fn iterations(&self) -> usize {
        self.state.iterations
    }

    /// Part of the voxels that may be lit.
    pub fn support(&self) -> f64 {
        self.state.support_fraction()
    }

    /// The video so far.
    pub fn video(&self) -> &[f32] {
        self.state.video()
    }

    /// From now on it runs on `data` that hold another frame, from where the last one ended.
    pub fn warm_start(&mut self, data: &dyn DataTerm) {
        self.state.warm_start(data);
    }

    /// The run so far; it can go on.
    pub fn snapshot(
        &mut self,
        data: &dyn DataTerm,
        prior: &dyn Prox,
        stop_reason: StopReason,
    ) -> Solution {
        let solution = self.state.finish(data, prior, stop_reason);
        self.state.restore_video(&solution.video);
        solution
    }

    /// The end of the run.
    pub fn solution(
        mut self,
        data: &dyn DataTerm,
        prior: &dyn Prox,
        stop_reason: StopReason,
    ) -> Solution {
        self.state.finish(data, prior, stop_reason)
    }
}
