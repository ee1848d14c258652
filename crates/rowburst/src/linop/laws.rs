//! The laws that every [`LinearOperator`] obeys, as checks that any test can run.

use super::LinearOperator;
use crate::vecmath::{distance_squared, dot, norm};
use rand::{RngExt, SeedableRng};

/// Checks linearity, the adjoint identity and overwriting on seeded random vectors.
///
/// # Panics
/// Names the law that is broken, with the numbers.
pub fn check(operator: &dyn LinearOperator, seed: u64) {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let mut random = |length: usize| -> Vec<f32> {
        (0..length)
            .map(|_| rng.random_range(-1.0f32..1.0))
            .collect()
    };
    let (x1, x2) = (random(operator.domain_len()), random(operator.domain_len()));
    let y = random(operator.range_len());
    let apply = |x: &[f32]| {
        let mut y = vec![f32::NAN; operator.range_len()];
        operator.apply(x, &mut y);
        assert!(
            y.iter().all(|v| v.is_finite()),
            "apply leaves old values in its output"
        );
        y
    };
    let mut at = vec![f32::NAN; operator.domain_len()];
    operator.adjoint(&y, &mut at);
    assert!(
        at.iter().all(|v| v.is_finite()),
        "adjoint leaves old values in its output"
    );

    let (a1, a2) = (apply(&x1), apply(&x2));
    let (left, right) = (dot(&a1, &y), dot(&x1, &at));
    let bound = 1e-5 * (norm(&a1) * norm(&y)).max(norm(&x1) * norm(&at));
    assert!(
        (left - right).abs() <= bound,
        "<Ax,y> = {left}, <x,Aᵀy> = {right}"
    );

    let mix: Vec<f32> = x1.iter().zip(&x2).map(|(a, b)| 2.0 * a - 0.5 * b).collect();
    let expected: Vec<f32> = a1.iter().zip(&a2).map(|(a, b)| 2.0 * a - 0.5 * b).collect();
    let error = distance_squared(&apply(&mix), &expected).sqrt();
    assert!(
        error <= 1e-5 * (norm(&a1) + norm(&a2)),
        "not linear: error {error}"
    );
}
