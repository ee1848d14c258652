//! An operator whose outputs are weighted.

use super::LinearOperator;
use std::borrow::Cow;

/// `W A`: element `i` of the output of `operator` times `weights[i]`.
///
/// Adjoint: `Aᵀ W`. Cost: that of `operator`.
pub struct WeightedOperator<O> {
    operator: O,
    weights: Option<Vec<f32>>,
}

impl<O: LinearOperator> WeightedOperator<O> {
    /// `W A`; without weights `A` itself.
    ///
    /// # Panics
    /// If the number of weights is not that of the outputs.
    pub fn new(operator: O, weights: Option<Vec<f32>>) -> Self {
        if let Some(weights) = &weights {
            assert_eq!(
                weights.len(),
                operator.range_len(),
                "one weight for each output"
            );
        }
        Self { operator, weights }
    }

    /// `A`.
    pub fn inner(&self) -> &O {
        &self.operator
    }

    /// `W y`.
    pub fn weigh<'y>(&self, y: &'y [f32]) -> Cow<'y, [f32]> {
        match &self.weights {
            None => Cow::Borrowed(y),
            Some(weights) => y.iter().zip(weights).map(|(y, w)| y * w).collect(),
        }
    }

    /// `W`, if not all 1.
    pub fn weights(&self) -> Option<&[f32]> {
        self.weights.as_deref()
    }
}

impl<O: LinearOperator> LinearOperator for WeightedOperator<O> {
    fn domain_len(&self) -> usize {
        self.operator.domain_len()
    }

    fn range_len(&self) -> usize {
        self.operator.range_len()
    }

    fn apply(&self, x: &[f32], y: &mut [f32]) {
        self.operator.apply(x, y);
        if let Some(weights) = &self.weights {
            y.iter_mut().zip(weights).for_each(|(y, w)| *y *= w);
        }
    }

    fn adjoint(&self, y: &[f32], x: &mut [f32]) {
        self.operator.adjoint(&self.weigh(y), x);
    }
}
