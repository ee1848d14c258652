//! The objective at a fixed `τ`, as the reference solvers and the certificate see it.
//!
//! ```text
//! F(v) = ½‖b − A v‖² + τ R(v),  v ≥ 0,     R(v) = w_s Σ ‖(∂y v, ∂x v)‖ + w_t Σ |∂t v| + w_1 Σ |v|
//! ```
//!
//! with the differences stacked in one operator `K`, so `τ R(v) = max ⟨K v, p⟩ + τ w_1 Σ v` over
//! the `p` in the balls of radius `τ w`. This is written apart from
//! [`rowburst::prox::Variation`], so that each can be checked against the other.

use rowburst::Shape;
use rowburst::linop::{Axis, Differences, LinearOperator};
use rowburst::prox::VariationWeights;
use rowburst::solve::DataTerm;
use rowburst::vecmath::distance_squared;

/// `F` above, of one problem.
pub struct Objective<'a> {
    data: &'a dyn DataTerm,
    shape: Shape,
    weights: VariationWeights,
    tau: f64,
    differences: Differences,
}

impl<'a> Objective<'a> {
    /// The objective of `data` over videos of `shape`.
    ///
    /// # Panics
    /// If the operator does not take videos of this shape, `τ` is not above zero, or a weight is below zero.
    pub fn new(data: &'a dyn DataTerm, shape: Shape, weights: VariationWeights, tau: f64) -> Self {
        assert_eq!(
            data.operator().domain_len(),
            shape.voxels(),
            "the operator takes videos of this shape"
        );
        assert!(tau.is_finite() && tau > 0.0, "τ is above zero: {tau}");
        for weight in [weights.space, weights.time, weights.l1] {
            assert!(weight.is_finite() && weight >= 0.0, "a weight: {weight}");
        }
        let mut axes = Vec::new();
        if weights.space > 0.0 {
            axes.extend([Axis::Rows, Axis::Columns]);
        }
        if weights.time > 0.0 {
            axes.push(Axis::Time);
        }
        Self {
            differences: Differences::new(shape, axes),
            data,
            shape,
            weights,
            tau,
        }
    }

    /// `A`.
    pub fn operator(&self) -> &dyn LinearOperator {
        self.data.operator()
    }

    /// `b`.
    pub fn measurements(&self) -> &[f32] {
        self.data.measurements()
    }

    /// `K`: rows and columns if `w_s` is not zero, then bins if `w_t` is not.
    pub fn differences(&self) -> &Differences {
        &self.differences
    }

    /// Shape of the video.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// The weights in `R`.
    pub fn weights(&self) -> VariationWeights {
        self.weights
    }

    /// `τ`.
    pub fn tau(&self) -> f64 {
        self.tau
    }

    /// `τ w_1`: the weight of `Σ v` in the objective.
    pub fn l1_threshold(&self) -> f64 {
        self.tau * self.weights.l1
    }

    /// `F(v)`.
    ///
    /// # Panics
    /// If a length does not match.
    pub fn value(&self, video: &[f32]) -> f64 {
        let mut light = vec![0.0; self.operator().range_len()];
        self.operator().apply(video, &mut light);
        self.value_with(video, &light)
    }

    /// `F(v)` where `A v` is known.
    pub(super) fn value_with(&self, video: &[f32], light: &[f32]) -> f64 {
        let mut steps = vec![0.0; self.differences.range_len()];
        self.differences.apply(video, &mut steps);
        let absolute: f64 = video.iter().map(|v| f64::from(v.abs())).sum();
        0.5 * distance_squared(self.measurements(), light)
            + self.l1_threshold() * absolute
            + self.variation(&steps)
    }

    /// `τ (w_s Σ ‖·‖ + w_t Σ |·|)` of the differences `K v`.
    pub(super) fn variation(&self, steps: &[f32]) -> f64 {
        let (space, time) = steps.split_at(self.spatial());
        let (rows, columns) = space.split_at(space.len() / 2);
        let lengths = rows.iter().zip(columns);
        let isotropic: f64 = lengths
            .map(|(a, b)| (f64::from(*a).powi(2) + f64::from(*b).powi(2)).sqrt())
            .sum();
        let absolute: f64 = time.iter().map(|d| f64::from(d.abs())).sum();
        self.tau * (self.weights.space * isotropic + self.weights.time * absolute)
    }

    /// Puts every element of a dual `p` of the differences into its ball of radius `τ w`.
    pub(super) fn project(&self, p: &mut [f32]) {
        let (space, time) = p.split_at_mut(self.spatial());
        let (rows, columns) = space.split_at_mut(space.len() / 2);
        let radius = (self.tau * self.weights.space) as f32;
        for (a, b) in rows.iter_mut().zip(columns) {
            let shrink = radius / radius.max((*a * *a + *b * *b).sqrt());
            (*a, *b) = (*a * shrink, *b * shrink);
        }
        let radius = (self.tau * self.weights.time) as f32;
        time.iter_mut().for_each(|p| *p = p.clamp(-radius, radius));
    }

    /// Root mean square of `b − A v` over the measurements that carry information.
    pub(super) fn residual_rms(&self, light: &[f32]) -> f64 {
        (distance_squared(self.measurements(), light) / self.data.measurement_count() as f64).sqrt()
    }

    fn spatial(&self) -> usize {
        if self.weights.space > 0.0 {
            2 * self.shape.voxels()
        } else {
            0
        }
    }
}
