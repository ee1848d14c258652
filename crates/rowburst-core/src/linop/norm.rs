//! The norm of an operator by power iteration.

use super::LinearOperator;
use crate::vecmath::norm;
use rand::{RngExt, SeedableRng};

/// Relative change of the estimate at which the iteration stops, and most iterations.
/// The error of the Rayleigh quotient is the square of that of the vector, so a tight
/// cluster at the top costs no accuracy.
const TOLERANCE: f64 = 1e-5;
const ITERATIONS: usize = 500;

/// `‖A‖`, the largest singular value, from below: power iteration on `AᵀA` from a fixed
/// start, until it changes by less than 10⁻⁵ in an iteration.
///
/// Steps that must not exceed a bound need a margin: the solvers take 2 %.
pub fn operator_norm(operator: &dyn LinearOperator) -> f64 {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
    // Mostly positive, so that the mean, which optics pass best, is well represented;
    // not constant, which differences do not see.
    let mut x: Vec<f32> = (0..operator.domain_len())
        .map(|_| rng.random_range(-0.5f32..1.0))
        .collect();
    let mut y = vec![0.0f32; operator.range_len()];
    let mut estimate = 0.0;
    for _ in 0..ITERATIONS {
        let size = norm(&x);
        if size == 0.0 {
            return 0.0;
        }
        x.iter_mut()
            .for_each(|x| *x = (f64::from(*x) / size) as f32);
        operator.apply(&x, &mut y);
        let last = std::mem::replace(&mut estimate, norm(&y));
        if (estimate - last).abs() <= TOLERANCE * estimate {
            break;
        }
        operator.adjoint(&y, &mut x);
    }
    estimate
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Shape;
    use crate::linop::{Axis, Differences, WeightedOperator};

    /// `diag(1, −3, 2)` above a row of zeros.
    struct Diagonal;

    impl LinearOperator for Diagonal {
        fn domain_len(&self) -> usize {
            3
        }
        fn range_len(&self) -> usize {
            4
        }
        fn apply(&self, x: &[f32], y: &mut [f32]) {
            y.copy_from_slice(&[x[0], -3.0 * x[1], 2.0 * x[2], 0.0]);
        }
        fn adjoint(&self, y: &[f32], x: &mut [f32]) {
            x.copy_from_slice(&[y[0], -3.0 * y[1], 2.0 * y[2]]);
        }
    }

    #[test]
    fn of_a_diagonal_its_largest_element() {
        assert!((operator_norm(&Diagonal) - 3.0).abs() < 1e-4);
        let scaled = WeightedOperator::new(Diagonal, Some(vec![1e-6; 4]));
        assert!((operator_norm(&scaled) - 3e-6).abs() < 1e-10);
        assert_eq!(
            operator_norm(&WeightedOperator::new(Diagonal, Some(vec![0.0; 4]))),
            0.0
        );
    }

    /// `DᵀD` along an axis of `n` voxels has the eigenvalues `4 sin²(πk/2n)`, `k < n`.
    #[test]
    fn of_differences_the_closed_form() {
        for n in [2, 5, 30] {
            let operator = Differences::new(Shape::new(1, 1, n), vec![Axis::Columns]);
            let exact = 2.0 * (std::f64::consts::FRAC_PI_2 * (n - 1) as f64 / n as f64).sin();
            let found = operator_norm(&operator);
            assert!(
                found <= exact * (1.0 + 1e-6) && found > 0.998 * exact,
                "{n}: {found}, {exact}"
            );
        }
    }
}
