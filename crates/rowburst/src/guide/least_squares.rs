//! Conjugate gradients for the normal equations of a fit.

use rowburst_core::Cancel;
use rowburst_core::vecmath::dot;

/// Approximate solution of `N x = rhs` from zero; `normal` is `N`, symmetric and positive definite.
///
/// Stops after `iterations`, at a residual of `tolerance` times that of the start, or when cancelled.
pub(super) fn conjugate_gradients(
    normal: impl FnMut(&[f32]) -> Vec<f32>,
    rhs: &[f32],
    iterations: usize,
    tolerance: f64,
    cancel: &Cancel,
) -> Vec<f32> {
    let identity = |r: &[f32]| r.to_vec();
    preconditioned_gradients(normal, identity, rhs, iterations, tolerance, cancel)
}

/// The same with a preconditioner, an approximate inverse of `N`.
pub(super) fn preconditioned_gradients(
    mut normal: impl FnMut(&[f32]) -> Vec<f32>,
    preconditioner: impl Fn(&[f32]) -> Vec<f32>,
    rhs: &[f32],
    iterations: usize,
    tolerance: f64,
    cancel: &Cancel,
) -> Vec<f32> {
    let mut x = vec![0.0f32; rhs.len()];
    let mut residual = rhs.to_vec();
    let mut direction = preconditioner(&residual);
    let mut power = dot(&residual, &direction);
    let end = tolerance * tolerance * power;
    for _ in 0..iterations {
        if power <= end || power == 0.0 || cancel.is_cancelled() {
            break;
        }
        let product = normal(&direction);
        let curvature = dot(&direction, &product);
        if curvature <= 0.0 {
            break;
        }
        let step = (power / curvature) as f32;
        for i in 0..x.len() {
            x[i] += step * direction[i];
            residual[i] -= step * product[i];
        }
        let preconditioned = preconditioner(&residual);
        let next = dot(&residual, &preconditioned);
        let beta = (next / power) as f32;
        power = next;
        for (d, r) in direction.iter_mut().zip(&preconditioned) {
            *d = r + beta * *d;
        }
    }
    x
}

/// Coefficients `c` of the columns for which `Σ c_k columns_k` is nearest to `target`; zeros where they are not unique.
pub(super) fn project(columns: &[&[f32]], target: &[f32]) -> Vec<f64> {
    let gram: Vec<Vec<f64>> = columns
        .iter()
        .map(|a| columns.iter().map(|b| dot(a, b)).collect())
        .collect();
    let rhs: Vec<f64> = columns.iter().map(|a| dot(a, target)).collect();
    rowburst_core::vecmath::solve_normal(&gram, &rhs).unwrap_or_else(|| vec![0.0; columns.len()])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_solve_a_small_problem() {
        let n = [[4.0f32, 1.0], [1.0, 3.0]];
        let normal = |x: &[f32]| (0..2).map(|i| n[i][0] * x[0] + n[i][1] * x[1]).collect();
        let x = conjugate_gradients(normal, &[1.0, 2.0], 5, 0.0, &Cancel::default());
        assert!((x[0] - 1.0 / 11.0).abs() < 1e-5 && (x[1] - 7.0 / 11.0).abs() < 1e-5);
        let c = project(&[&[1.0, 0.0, 0.0], &[1.0, 1.0, 0.0]], &[3.0, 2.0, 9.0]);
        assert!((c[0] - 1.0).abs() < 1e-9 && (c[1] - 2.0).abs() < 1e-9);
    }
}
