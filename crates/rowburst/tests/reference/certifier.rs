//! A strict lower bound of an objective's minimum, by the dual problem.
//!
//! With `τ R(v) = max_p ⟨K v, p⟩ + τ w_1 Σ v` (see [`super::Objective`]) the dual of
//! `min_{v≥0} ½‖b − A v‖² + τ R(v)` is
//!
//! ```text
//! max D(y) = ⟨b, y⟩ − ½‖y‖²   over  Aᵀy − Kᵀp ≤ τ w_1,  p in the balls of radius τ w
//! ```
//!
//! (Fenchel; Boyd & Vandenberghe 2004, ch. 5). A `y` is feasible if it satisfies the constraint with some `p`. Every
//! feasible `y` gives `D(y) ≤ min F`, and at the minimum `y = b − A v` makes both sides equal. A residual is turned
//! into a feasible `y`, and `F(v) − D(y)` bounds the distance of `F(v)` from the minimum:
//!
//! 1. Fit `p` by accelerated projected gradient steps on `½‖(Aᵀy − Kᵀp − τ w_1)₊‖²`, from the last `p`. (Without
//!    differences there is no `p`, and step 2 is exact.)
//! 2. Remove the rest of the violation. Either scale `y` and `p` down (where `w_1 > 0`), or subtract from `y` the
//!    measurements of a video that is constant in each bin, which lowers `Aᵀy` everywhere. The better result counts.
//! 3. Take the best of all `s·y` with `0 ≤ s ≤ 1`, which are feasible too.
//!
//! The largest bound found is kept, since every bound stays valid. Sums are f64 and `Aᵀy` is f32, so rounding changes
//! the bound by about 10⁻⁶ of the objective.

use super::Objective;
use rowburst::linop::LinearOperator;
use rowburst::solve::Certificate;
use rowburst::vecmath::{dot, norm_squared};

/// Finds [`Certificate`]s of one objective. It keeps the largest bound and the last `p`.
pub struct Certifier<'a> {
    objective: &'a Objective<'a>,
    /// The dual of the differences.
    p: Vec<f32>,
    /// The largest bound so far.
    best: f64,
    /// `AᵀA1`.
    gram_of_ones: Vec<f32>,
}

impl<'a> Certifier<'a> {
    /// Starts with the bound 0.
    pub fn new(objective: &'a Objective<'a>) -> Self {
        let operator = objective.operator();
        let mut image_of_ones = vec![0.0; operator.range_len()];
        let mut gram_of_ones = vec![1.0; operator.domain_len()];
        operator.apply(&gram_of_ones, &mut image_of_ones);
        operator.adjoint(&image_of_ones, &mut gram_of_ones);
        Self {
            objective,
            p: vec![0.0; objective.differences().range_len()],
            // `y = 0` is feasible.
            best: 0.0,
            gram_of_ones,
        }
    }

    /// The certificate of `video`, which may be any with `v ≥ 0`: `y` is its residual, and `p` is fitted in `steps`
    /// steps.
    ///
    /// # Panics
    /// If a length does not match.
    pub fn certify(&mut self, video: &[f32], steps: usize) -> Certificate {
        let objective = self.objective;
        let mut light = vec![0.0; objective.operator().range_len()];
        objective.operator().apply(video, &mut light);
        let residual = residual(objective, &light);
        let mut adjoint_y = vec![0.0; video.len()];
        objective.operator().adjoint(&residual, &mut adjoint_y);
        self.fit(&adjoint_y, steps);
        let p = std::mem::take(&mut self.p);
        self.bound(&residual, &adjoint_y, &p);
        self.p = p;
        Certificate {
            primal: objective.value_with(video, &light),
            dual: self.best,
        }
    }

    /// The largest bound so far.
    pub(super) fn best(&self) -> f64 {
        self.best
    }

    /// Improves the bound by a solver's duals: `y`, and `p` within its balls.
    pub(super) fn improve_with(&mut self, y: &[f32], p: &[f32]) {
        let mut adjoint_y = vec![0.0; self.gram_of_ones.len()];
        self.objective.operator().adjoint(y, &mut adjoint_y);
        self.bound(y, &adjoint_y, p);
    }

    /// The `p` that is fitted to `y` in `steps` steps.
    pub(super) fn fit_p(mut self, y: &[f32], steps: usize) -> Vec<f32> {
        let mut adjoint_y = vec![0.0; self.gram_of_ones.len()];
        self.objective.operator().adjoint(y, &mut adjoint_y);
        self.fit(&adjoint_y, steps);
        self.p
    }

    /// Step 1 of the module's list, for `adjoint_y = Aᵀy`.
    fn fit(&mut self, adjoint_y: &[f32], steps: usize) {
        let k = self.objective.differences();
        if self.p.is_empty() {
            return;
        }
        let step = (1.0 / k.norm_squared_bound()) as f32;
        let l1_threshold = self.objective.l1_threshold() as f32;
        let (mut violation, mut descent) =
            (vec![0.0f32; adjoint_y.len()], vec![0.0f32; self.p.len()]);
        let mut extrapolated = self.p.clone();
        let mut t = 1.0f64;
        for _ in 0..steps {
            k.adjoint(&extrapolated, &mut violation);
            for (violation, adjoint_y) in violation.iter_mut().zip(adjoint_y) {
                *violation = (adjoint_y - *violation - l1_threshold).max(0.0);
            }
            k.apply(&violation, &mut descent);
            for (extrapolated, descent) in extrapolated.iter_mut().zip(&descent) {
                *extrapolated += step * descent;
            }
            self.objective.project(&mut extrapolated);
            let next = 0.5 * (1.0 + (1.0 + 4.0 * t * t).sqrt());
            let momentum = ((t - 1.0) / next) as f32;
            for (p, extrapolated) in self.p.iter_mut().zip(&mut extrapolated) {
                let new = *extrapolated;
                *extrapolated += momentum * (new - *p);
                *p = new;
            }
            t = next;
        }
    }

    /// Steps 2 and 3 of the module's list, for `adjoint_y = Aᵀy`.
    fn bound(&mut self, y: &[f32], adjoint_y: &[f32], p: &[f32]) {
        let objective = self.objective;
        let mut violation = vec![0.0f32; adjoint_y.len()];
        objective.differences().adjoint(p, &mut violation);
        for (violation, adjoint_y) in violation.iter_mut().zip(adjoint_y) {
            *violation = adjoint_y - *violation;
        }
        let l1_threshold = objective.l1_threshold();
        let largest = violation
            .iter()
            .fold(0.0f64, |largest, &v| largest.max(f64::from(v)));
        let s = if largest > 0.0 {
            l1_threshold / largest
        } else {
            f64::INFINITY
        };
        // p may be scaled down, but not up.
        let max_s = if p.is_empty() { s } else { s.min(1.0) };
        self.best = self.best.max(self.best_scaled(y, max_s));
        violation.iter_mut().for_each(|v| *v -= l1_threshold as f32);
        self.shift_into_feasibility(y, &violation);
    }

    /// The second way of step 2: subtracts from `y` a multiple of the measurements of a video that is constant in
    /// each bin.
    ///
    /// The constant is what the bin's voxels with a `violation` above zero need if the bin is alone. The multiple
    /// accounts for bins that share their instants.
    fn shift_into_feasibility(&mut self, y: &[f32], violation: &[f32]) {
        let pixels = self.objective.shape().pixels();
        let mut light = vec![0.0f32; violation.len()];
        let bins = violation
            .chunks_exact(pixels)
            .zip(self.gram_of_ones.chunks_exact(pixels));
        for (light, (violation, gram_of_ones)) in light.chunks_exact_mut(pixels).zip(bins) {
            light.fill(largest_ratio(violation, gram_of_ones) as f32);
        }
        let operator = self.objective.operator();
        let mut measured_light = vec![0.0f32; y.len()];
        operator.apply(&light, &mut measured_light);
        operator.adjoint(&measured_light, &mut light);
        let multiple = largest_ratio(violation, &light);
        if !(multiple > 0.0 && multiple.is_finite()) {
            return;
        }
        let shifted: Vec<f32> = y
            .iter()
            .zip(&measured_light)
            .map(|(&y, &measured_light)| {
                (f64::from(y) - multiple * f64::from(measured_light)) as f32
            })
            .collect();
        self.best = self.best.max(self.best_scaled(&shifted, 1.0));
    }

    /// The largest `D(s·y)` for `0 ≤ s ≤ max_s`.
    fn best_scaled(&self, y: &[f32], max_s: f64) -> f64 {
        let (linear, quadratic) = (dot(self.objective.measurements(), y), norm_squared(y));
        if linear <= 0.0 || quadratic == 0.0 {
            return 0.0;
        }
        let s = (linear / quadratic).min(max_s);
        s * linear - 0.5 * s * s * quadratic
    }
}

/// The largest `violation/response` of the voxels with `violation > 0`, at least 0.
fn largest_ratio(violation: &[f32], response: &[f32]) -> f64 {
    let pairs = violation
        .iter()
        .zip(response)
        .filter(|(violation, _)| **violation > 0.0);
    pairs.fold(0.0, |largest, (&violation, &response)| {
        let ratio = if response > 0.0 {
            f64::from(violation) / f64::from(response)
        } else {
            f64::INFINITY
        };
        largest.max(ratio)
    })
}

/// `b − A v`, with `light = A v`.
pub(super) fn residual(objective: &Objective, light: &[f32]) -> Vec<f32> {
    let pairs = objective.measurements().iter().zip(light);
    pairs.map(|(b, a)| b - a).collect()
}
