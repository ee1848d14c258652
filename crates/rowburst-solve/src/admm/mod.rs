//! ADMM (Boyd et al. 2011) with the proximal step of the data term.
//!
//! `min_v ½‖b − A v‖² + τ R(v)` is split into two variables with `x = z`. `x` takes the step of the data term,
//!
//! ```text
//! x = argmin ½‖b − A x‖² + ρ/2 ‖x − p‖² = p + Aᵀ (A Aᵀ + ρI)⁻¹ (b − A p),   p = z − u
//! ```
//!
//! and `z` that of the prior: `z = prox(q)` with the threshold `β = τ/ρ` and `q = x̂ + u`. Here `x̂ = αx + (1−α)z` is
//! the over-relaxed `x` (Boyd et al. 2011, section 3.4.3). The dual step is `u ← u + x̂ − z = q − z`: `q` is stored in
//! place of `u`. An iteration has one product with `A`, which is `A z`: `A x` follows from the solve, and `A q` by
//! addition.
//!
//! [`Admm::run`] is the loop, and its `iteration` the three steps. What adapts between iterations is a controller, a file
//! each; `controllers.rs` has their order, `phase.rs` what each waits for, and [`Tuning`] their constants. A run from its
//! first to its last iteration is told in `docs/design/027`.
//!
//! **Threshold.** `β` is a fixed part of the video's brightness, so no constant of the solver has a unit. At first it
//! is larger: large steps find the shapes, small ones the details (`docs/design/006`). Where rows share bins, it is also larger
//! for a scene with much light for the number of measurements, which is haze for long (`docs/design/034`). The brightness is
//! at most twice that of the dimmest bins that hold 10 % of `Σ v²`, which would be faint beside a flash
//! (`docs/design/007`).
//!
//! **τ by discrepancy.** With the noise `σ` known, the problem is `min R(v)` subject to `‖b − A v‖² ≤ σ²(m − df)` for
//! `m` measurements. The iteration is the same. `x` is to be the point within the bound nearest to `p`, with `1/ρ`
//! as its Lagrange multiplier; `ρ` is corrected between iterations until it is, and `τ = ρβ` results. A fit with `df`
//! degrees of freedom (see [`Prox::degrees_of_freedom`]) also fits their share of the noise, so its residual is below
//! `σ²m`. The bound `σ²m` would over-smooth the video (`docs/design/005`).
//!
//! **Support.** In a sparse scene few voxels are active. Once the video has taken shape, it is restricted to its
//! bright voxels and their neighbours, which are updated every few iterations: the limit of reweighted ℓ1 (Candès,
//! Wakin & Boyd 2008). The data determine these voxels far better. The iteration then converges in a few steps, since
//! its slow part is light that stays as haze in inactive voxels. A bin of which more than a third is active is
//! unrestricted. A bin whose residual is too large and no longer falls is underfit: its threshold is lowered, and the
//! voxels to which the residual points, `Aᵀ(b − A v)`, are added; in the end all of its voxels are active
//! (`docs/design/007`). Where rows share bins, the first restriction comes later, and
//! underfit bins are widened gently and not unrestricted (`docs/design/025`). A video that takes shape slowly is restricted later:
//! one with hundreds of voxels for each pixel of the frame (`docs/design/008`), and where rows share bins an extended scene
//! (`docs/design/034`).
//!
//! **Acceleration.** On a support that no longer changes an iteration is a fixed map, and Anderson acceleration needs fewer of
//! them (`acceleration.rs`, `docs/design/033`).
//!
//! **Stopping.** Every `y` and every `c` of the prior's dual (`⟨c, v⟩ ≤ β R(v)`) give
//!
//! ```text
//! min F ≥ ρ⟨b, y⟩ − ½ρ²‖y‖² − ρ v_max Σ (Aᵀy − c)₊     over videos 0 ≤ v ≤ v_max on the support
//! ```
//!
//! (weak duality at the dual points `ρy` and `ρc`; Boyd & Vandenberghe 2004, ch. 5). Here `ρy = b − A x` of the x-step,
//! and `c` is that of the z-step. Their excess `(Aᵀy − c)₊` is at most the change of the video plus `x − z`, so the gap
//! closes as the iteration converges. `v_max` is twice the brightest voxel. The solver stops once the objective is
//! proved to be within [`AdmmParams::tolerance`] of its minimum, for the `τ` and on the support that it found
//! (`docs/design/009`).

mod acceleration;
mod active_set;
mod brightness;
mod continuation;
mod controllers;
mod discrepancy;
mod noise_weights;
mod penalty;
mod phase;
mod stopping;
mod support_estimator;
mod tuning;
mod variables;

pub use brightness::brightness;
pub use tuning::{KindTuning, Tuning, TuningError};

use super::{Certificate, DataTerm, StopReason};
use crate::prox::Prox;
use acceleration::Acceleration;
use controllers::Controllers;
use rowburst_core::Shape;
use std::borrow::Cow;
use std::fmt;
use std::ops::ControlFlow;
use stopping::Stopping;
use variables::Variables;

/// How `τ` is found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TauRule {
    /// `τ` has this value.
    Fixed(f64),
    /// The discrepancy principle gives `τ`: the residual is as large as the noise.
    Discrepancy {
        /// Standard deviation of the noise in the units of `b`.
        sigma: f64,
    },
}

impl TauRule {
    /// Whether the discrepancy principle gives `τ`.
    pub fn is_discrepancy(self) -> bool {
        matches!(self, Self::Discrepancy { .. })
    }
}

/// Parameters of [`Admm`]; [`Self::new`] has the defaults.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdmmParams {
    /// How `τ` is found.
    pub tau: TauRule,
    /// `β` over the brightness: [`Tuning::threshold`] times the factor of a prior whose terms act on more than a voxel.
    pub threshold: f64,
    /// Most iterations.
    pub max_iterations: usize,
    /// [`Certificate::excess`] at which it stops, by default [`Tuning::tolerance`]; 0: no certificate stops it.
    pub tolerance: f64,
    /// Whether the video is restricted to its support, see the module's head.
    pub support: bool,
    /// The constants of the solver; unstable.
    pub tuning: Tuning,
}

impl AdmmParams {
    /// The defaults with `tau`.
    pub fn new(tau: TauRule) -> Self {
        Self::with_tuning(tau, Tuning::STANDARD)
    }

    /// The defaults with `tau` and other constants of the solver.
    pub fn with_tuning(tau: TauRule, tuning: Tuning) -> Self {
        Self {
            tau,
            threshold: tuning.threshold,
            max_iterations: 300,
            tolerance: tuning.tolerance,
            support: true,
            tuning,
        }
    }
}

/// The state of a run that an observer sees after each iteration.
#[derive(Debug, Clone, Copy)]
pub struct Progress<'a> {
    /// Purpose of a preliminary run, such as the prior that it tries; empty for the final run.
    pub label: &'a str,
    /// Runs that follow this one, such as further trials and the final run, as far as that is known.
    pub runs_left: usize,
    /// Iterations done.
    pub iteration: usize,
    /// Most iterations.
    pub max_iterations: usize,
    /// The video of this iteration, `[t, y, x]`.
    pub video: VideoOfIteration<'a>,
    /// Root mean square of `b − A v` over the measurements with a weight above zero.
    pub residual_rms: f64,
    /// `½‖b − A v‖² + τ R(v)` at the last iteration that computed it.
    pub objective: f64,
    /// `τ` of this iteration.
    pub tau: f64,
    /// Relative change of the iteration: `‖q − q'‖/‖v'‖`, with `q'` and `v'` those of the iteration before and
    /// `v = prox(q)`, or 1 where `v' = 0`. Under the same prox the video moves no farther than `q`. Acceleration of a settled
    /// run, which moves `q` on, does not count.
    pub change: f64,
    /// Part of the voxels that are active, from 0 to 1.
    pub support_fraction: f64,
}

/// The video of an iteration, which takes time only where it is asked for.
#[derive(Clone, Copy)]
pub enum VideoOfIteration<'a> {
    /// It is what the solver looks for.
    Solved(&'a [f32]),
    /// It is computed from that, such as the sum of foreground and background.
    Computed(&'a dyn Fn() -> Vec<f32>),
}

impl<'a> VideoOfIteration<'a> {
    /// The video, `[t, y, x]`.
    pub fn get(self) -> Cow<'a, [f32]> {
        match self {
            Self::Solved(video) => Cow::Borrowed(video),
            Self::Computed(video) => Cow::Owned(video()),
        }
    }
}

impl fmt::Debug for VideoOfIteration<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Solved(_) => "Solved",
            Self::Computed(_) => "Computed",
        })
    }
}

/// The result of [`solve`].
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
    /// Part of the voxels that are active, from 0 to 1.
    pub support_fraction: f64,
    /// Degrees of freedom of the video, see [`Prox::degrees_of_freedom`].
    pub degrees_of_freedom: f64,
    /// `½‖b − A v‖² + τ R(v)` at the end, and a lower bound of its minimum.
    pub certificate: Certificate,
}

/// Minimises `½‖b − A v‖² + τ R(v)` over `v ≥ 0` of `shape`, from `v = 0`.
///
/// `observer` sees every iteration and may stop the run; the result is then that of the last iteration. Runs that
/// share a thread pool wait for each other's iterations; give each its own pool where time counts.
///
/// # Panics
/// As [`Admm::new`], or if the shape of `prior` disagrees.
pub fn solve(
    data: &mut dyn DataTerm,
    prior: &mut dyn Prox,
    shape: Shape,
    params: &AdmmParams,
    observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
) -> Solution {
    let mut run = Admm::new(data, shape, *params);
    let stop_reason = run.run(data, prior, params.max_iterations, observer);
    run.into_solution(data, prior, stop_reason)
}

/// A run of the solver that can be stopped, take another rule for `τ`, and continue.
#[derive(Clone)]
pub struct Admm {
    /// See [`KindTuning::relaxation`].
    relaxation: f64,
    /// See [`AdmmParams::max_iterations`].
    max_iterations: usize,
    variables: Variables,
    controllers: Controllers,
    acceleration: Acceleration,
    stopping: Stopping,
    /// `½‖b − A v‖² + τ R(v)` at the last iteration that computed it.
    objective: f64,
}

impl Admm {
    /// A run that begins at `v = 0`.
    ///
    /// # Panics
    /// If the shapes of `data` and `shape` disagree, or a constant has a value that [`Tuning::check`] refuses.
    pub fn new(data: &dyn DataTerm, shape: Shape, params: AdmmParams) -> Self {
        assert!(
            data.operator().domain_len() >= shape.voxels(),
            "the operator takes videos of this shape"
        );
        if let Err(error) = params.tuning.check() {
            panic!("{error}");
        }
        let kind = data.capabilities().hints.kind;
        Self {
            relaxation: params.tuning.for_kind(kind).relaxation,
            max_iterations: params.max_iterations,
            variables: Variables::new(data, shape.columns),
            controllers: Controllers::new(data, shape, &params),
            acceleration: Acceleration::default(),
            stopping: Stopping::new(&params),
            objective: f64::INFINITY,
        }
    }

    /// Iterates up to iteration `until`, counted from the start of the frame, or until it converges.
    ///
    /// `observer` sees every iteration and may stop the run, as [`super::Capabilities::cancel`] does within an iteration.
    pub fn run(
        &mut self,
        data: &mut dyn DataTerm,
        prior: &mut dyn Prox,
        until: usize,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> StopReason {
        for k in self.iterations() + 1..=until {
            // Runs on a thread of the pool. Otherwise each parallel loop would wake a thread and wait for it.
            let change = rayon::scope(|_| {
                self.controllers.adapt(&mut self.variables, data, prior);
                self.iteration(data, prior)
            });
            let Some(change) = change else {
                return StopReason::Interrupted;
            };
            self.controllers.schedule.finish_iteration();
            if self.stopping.computes_objective(k) {
                self.objective = stopping::objective(&self.variables, self.tau(), data, prior);
            }
            if let ControlFlow::Break(reason) = observer(&self.progress(until, change, data)) {
                return reason;
            }
            if self.stopping.certifies(k) && self.controllers.is_settled() {
                let certificate = self.certify(data, prior);
                if self.stopping.has_converged(&certificate) {
                    return StopReason::Converged;
                }
            }
        }
        StopReason::IterationLimit
    }

    /// One iteration of ADMM. Returns the change of `q`, see [`Progress::change`]; `None`: the run is cancelled.
    fn iteration(&mut self, data: &mut dyn DataTerm, prior: &mut dyn Prox) -> Option<f64> {
        let Self {
            variables,
            controllers,
            acceleration,
            ..
        } = self;
        let support = controllers.active_set.x_step_support();
        let rho = controllers.penalty.rho();
        let change = variables.x_step(data, rho, self.relaxation, support)?;
        let is_accelerated = if controllers.is_fixed_map() {
            acceleration.accelerate(variables, support)
        } else {
            acceleration.forget();
            false
        };
        prior.set_refined(is_accelerated);
        variables.z_step(prior, controllers.threshold(variables));
        variables.dual_step(data);
        Some(change)
    }

    fn progress<'a>(&'a self, until: usize, change: f64, data: &dyn DataTerm) -> Progress<'a> {
        Progress {
            label: "",
            runs_left: 0,
            iteration: self.iterations(),
            max_iterations: self.max_iterations.max(until),
            video: VideoOfIteration::Solved(&self.variables.z),
            residual_rms: self.variables.residual_rms(data),
            objective: self.objective,
            tau: self.tau(),
            change,
            support_fraction: self.support_fraction(),
        }
    }

    fn certify(&mut self, data: &dyn DataTerm, prior: &dyn Prox) -> Certificate {
        let Self {
            variables,
            controllers,
            stopping,
            ..
        } = self;
        let (penalty, supports) = (&controllers.penalty, controllers.supports());
        stopping.certify(variables, penalty, supports, data, prior)
    }

    /// Sets how `τ` is found from now on.
    pub fn set_tau_rule(&mut self, rule: TauRule, data: &dyn DataTerm) {
        self.controllers.set_tau_rule(rule, data);
        self.acceleration.forget();
    }

    /// Sets [`AdmmParams::tolerance`].
    pub fn set_tolerance(&mut self, tolerance: f64) {
        self.stopping.set_tolerance(tolerance);
    }

    /// Whether the run is still so short that its video says little about the scene.
    pub fn is_warming_up(&self) -> bool {
        self.controllers.schedule.is_warming_up()
    }

    /// Most iterations.
    pub fn max_iterations(&self) -> usize {
        self.max_iterations
    }

    /// `τ` of the last iteration.
    pub fn tau(&self) -> f64 {
        self.controllers.penalty.tau()
    }

    /// Iterations done.
    pub fn iterations(&self) -> usize {
        self.controllers.schedule.iterations()
    }

    /// Part of the voxels that are active, from 0 to 1.
    pub fn support_fraction(&self) -> f64 {
        self.controllers.active_set.fraction()
    }

    /// The number of voxels of equal brightness that would share the light of the video alike: its participation ratio
    /// `(Σ v)² / Σ v²`.
    pub fn participation(&self) -> f64 {
        self.controllers.participation(&self.variables)
    }

    /// The video of the last iteration, `[t, y, x]`.
    pub fn video(&self) -> &[f32] {
        &self.variables.z
    }

    /// `A v` of that video.
    pub fn fitted(&self) -> &[f32] {
        &self.variables.az
    }

    /// Is to be called after the measurements of the data term were replaced, where the run goes on as it was: iterations that it
    /// remembers were those of the old ones.
    pub fn replace_measurements(&mut self) {
        self.acceleration.forget();
    }

    /// Continues with `data`, which hold another frame, from the end of the last frame's run.
    pub fn warm_start(&mut self, data: &dyn DataTerm) {
        self.controllers.forget_underfit_bins();
        self.reweight(data);
    }

    /// Continues with `data`, which hold the same frame with other weights. Iterations are counted anew.
    pub fn reweight(&mut self, data: &dyn DataTerm) {
        self.controllers.warm_start(data);
        self.acceleration.forget();
        self.variables.x_residual_norm = None;
        // `A` contains the weights of the measurements, which may be others.
        self.variables.update_products(data);
    }

    /// The result so far; the run can continue.
    pub fn snapshot(
        &mut self,
        data: &dyn DataTerm,
        prior: &dyn Prox,
        stop_reason: StopReason,
    ) -> Solution {
        let solution = self.take_solution(data, prior, stop_reason);
        self.variables.z.clone_from(&solution.video);
        solution
    }

    /// Ends the run and returns its result.
    pub fn into_solution(
        mut self,
        data: &dyn DataTerm,
        prior: &dyn Prox,
        stop_reason: StopReason,
    ) -> Solution {
        self.take_solution(data, prior, stop_reason)
    }

    /// The result, with the video that it takes out of the variables.
    fn take_solution(
        &mut self,
        data: &dyn DataTerm,
        prior: &dyn Prox,
        stop_reason: StopReason,
    ) -> Solution {
        Solution {
            certificate: self.certify(data, prior),
            residual: self.variables.residual(data),
            tau: self.tau(),
            iterations: self.iterations(),
            stop_reason,
            support_fraction: self.support_fraction(),
            degrees_of_freedom: self.controllers.degrees_of_freedom(&self.variables, prior),
            video: std::mem::take(&mut self.variables.z),
        }
    }
}
