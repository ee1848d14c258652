//! The laws that every [`LinearOperator`] obeys, as checks that any test can run.

use super::{LinearOperator, Scalar};
use rand::{RngExt, SeedableRng};

/// Checks linearity, the adjoint identity and overwriting on seeded random vectors, to 84 times the
/// precision of `T`.
///
/// # Panics
/// Names the law that is broken, with the numbers.
pub fn check<T: Scalar>(operator: &(impl LinearOperator<T> + ?Sized), seed: u64) {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let mut random = |length: usize| -> Vec<T> {
        (0..length)
            .map(|_| T::nearest(rng.random_range(-1.0..1.0)))
            .collect()
    };
    let (x1, x2) = (random(operator.domain_len()), random(operator.domain_len()));
    let y = random(operator.range_len());
    let nan = T::nearest(f64::NAN);
    let is_finite = |v: &T| (*v).into().is_finite();
    let apply = |x: &[T]| {
        let mut y = vec![nan; operator.range_len()];
        operator.apply(x, &mut y);
        assert!(
            y.iter().all(is_finite),
            "apply leaves old values in its output"
        );
        y
    };
    let mut at = vec![nan; operator.domain_len()];
    operator.adjoint(&y, &mut at);
    assert!(
        at.iter().all(is_finite),
        "adjoint leaves old values in its output"
    );

    // 1e-5 in f32.
    let tolerance = 84.0 * epsilon::<T>();
    let (a1, a2) = (apply(&x1), apply(&x2));
    let (left, right) = (dot(&a1, &y), dot(&x1, &at));
    let bound = tolerance * (norm(&a1) * norm(&y)).max(norm(&x1) * norm(&at));
    assert!(
        (left - right).abs() <= bound,
        "<Ax,y> = {left}, <x,Aᵀy> = {right}"
    );

    let mixed = |a: &[T], b: &[T]| -> Vec<T> {
        let (two, half) = (T::from(2.0), T::from(0.5));
        a.iter().zip(b).map(|(&a, &b)| two * a - half * b).collect()
    };
    let (found, expected) = (apply(&mixed(&x1, &x2)), mixed(&a1, &a2));
    let difference: Vec<T> = found.iter().zip(&expected).map(|(&f, &e)| f - e).collect();
    let error = norm(&difference);
    assert!(
        error <= tolerance * (norm(&a1) + norm(&a2)),
        "not linear: error {error}"
    );
}

/// The smallest power of two that changes 1 when it is added.
fn epsilon<T: Scalar>() -> f64 {
    let one = T::from(1.0);
    let mut step = 1.0;
    while one + T::nearest(step / 2.0) != one {
        step /= 2.0;
    }
    step
}

fn dot<T: Scalar>(a: &[T], b: &[T]) -> f64 {
    a.iter().zip(b).map(|(&a, &b)| a.into() * b.into()).sum()
}

fn norm<T: Scalar>(a: &[T]) -> f64 {
    dot(a, a).sqrt()
}
