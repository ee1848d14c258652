//! Terms `w ‖K v‖` of a prior that are solved in their dual.

use dyn_clone::DynClone;

/// One term `w ‖K v‖` of a [`Composite`](super::Composite) prior, with its dual variable `p`.
///
/// By duality `s w ‖K v‖ = max ⟨p, K v⟩` over the ball `‖p‖_* ≤ s w` of the dual norm, with `s` the scale of the
/// prox. So a term needs only `Kᵀ p` and a projected gradient step of `p`.
pub trait DualTerm: DynClone + Send {
    /// An upper bound of `‖K‖²`.
    fn norm_squared(&self) -> f64;

    /// `z −= Kᵀ p`.
    fn subtract_adjoint(&self, z: &mut [f32]);

    /// `p ← P(p + step·K z)`, with `P` the projection onto the dual ball of `radius`; returns `‖K z‖`.
    fn step(&mut self, z: &[f32], step: f32, radius: f32) -> f64;

    /// `p *= factor`.
    fn rescale(&mut self, factor: f32);

    /// `‖K z‖`.
    fn value(&self, z: &[f32]) -> f64;

    /// Estimate of the number of values in `z` that are free under this term alone. Differences below `tolerance`
    /// count as zero.
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64;
}

dyn_clone::clone_trait_object!(DualTerm);

/// `p *= factor`, in parallel.
pub(super) fn scale(p: &mut [f32], factor: f32) {
    use rayon::prelude::*;
    p.par_iter_mut().for_each(|p| *p *= factor);
}
