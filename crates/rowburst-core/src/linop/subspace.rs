//! An operator without the part of its outputs that lies in a subspace.

use super::LinearOperator;
use faer::{ColMut, ColRef, Mat};
use std::sync::Arc;

/// A subspace, by orthonormal columns `Q`.
pub struct Subspace(Mat<f32>);

impl Subspace {
    /// The span of orthonormal columns.
    pub fn new(columns: Mat<f32>) -> Self {
        Self(columns)
    }

    /// `y ← (I − QQᵀ) y`: the part of `y` that is orthogonal to the subspace.
    pub fn remove(&self, y: &mut [f32]) {
        let inside = &self.0 * (self.0.transpose() * ColRef::from_slice(y));
        let mut outside = ColMut::from_slice_mut(y);
        outside -= inside;
    }
}

/// `(I − QQᵀ) A`: `operator` without the part of its output that lies in the subspace of `Q`.
///
/// Adjoint: `Aᵀ (I − QQᵀ)`. Cost: that of `operator`, and two products for each element of `Q`.
pub struct WithoutSubspace<O> {
    operator: O,
    subspace: Arc<Subspace>,
}

impl<O: LinearOperator> WithoutSubspace<O> {
    /// `operator` without `subspace`.
    pub fn new(operator: O, subspace: Arc<Subspace>) -> Self {
        Self { operator, subspace }
    }
}

impl<O: LinearOperator> LinearOperator for WithoutSubspace<O> {
    fn domain_len(&self) -> usize {
        self.operator.domain_len()
    }

    fn range_len(&self) -> usize {
        self.operator.range_len()
    }

    fn apply(&self, x: &[f32], y: &mut [f32]) {
        self.operator.apply(x, y);
        self.subspace.remove(y);
    }

    fn adjoint(&self, y: &[f32], x: &mut [f32]) {
        let mut outside = y.to_vec();
        self.subspace.remove(&mut outside);
        self.operator.adjoint(&outside, x);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linop::{Cosine, OverBins, laws};
    use crate::vecmath::norm;

    #[test]
    fn removes_its_subspace_alone() {
        let columns = Mat::from_fn(30, 4, |i, j| {
            if i == 3 * j {
                0.6
            } else if i == 3 * j + 1 {
                -0.8
            } else {
                0.0
            }
        });
        let subspace = Subspace::new(columns.clone());
        for j in 0..4 {
            let mut column: Vec<f32> = columns.col(j).iter().copied().collect();
            subspace.remove(&mut column);
            assert!(norm(&column) < 1e-6);
        }
        let mut outside = vec![0.0; 30];
        (outside[0], outside[1], outside[20]) = (0.8, 0.6, 2.0);
        let before = outside.clone();
        subspace.remove(&mut outside);
        let change: Vec<f32> = outside.iter().zip(&before).map(|(o, b)| o - b).collect();
        assert!(norm(&change) < 1e-6);
        let operator = OverBins::new(1, Cosine::new(5, 6));
        laws::check(&WithoutSubspace::new(operator, Arc::new(subspace)), 3);
    }
}
