//! Solution of `(G + C Cᵀ + ρI) y = r`, where `G` has small blocks and `C Cᵀ` couples them all. `C` belongs to
//! unknowns that every measurement sees, such as a static background.
//!
//! With `H = (G + ρI)⁻¹`, which the blocks' factors give, `δ = Cᵀ y` solves
//!
//! ```text
//! (I + Cᵀ H C) δ = Cᵀ H r,     y = H (r − C δ)
//! ```
//!
//! (the Schur complement of `G + ρI`; Golub & Van Loan, 4th ed., section 3.2.11). Preconditioned conjugate gradients
//! solve this from the last `δ`. Their residual is `g = Cᵀ y − δ`, and that of the whole system is `−C g`.

use rowburst_core::linop::LinearOperator;
use rowburst_core::vecmath::{dot, norm};

/// Most iterations of a call; larger makes fewer x-steps inexact and costs time.
const ITERATIONS: usize = 60;
/// Iterations between checks of the error, each of which costs a product with `C`; larger stops later.
const CHECK_INTERVAL: usize = 3;

/// The error `‖C g‖` at which a call stops, over `ρ‖y‖`; as in [`super::conjugate_gradient`] (docs/design/004).
const TOLERANCE: f64 = 0.1;

/// `inverse(v, ρ, h)` is an approximation of `(ρI + h Cᵀ C)⁻¹ v`, up to a factor; a preconditioner.
pub type Inverse<'a> = &'a dyn Fn(&[f32], f64, f64) -> Vec<f32>;

/// Mean eigenvalue of `ρH` that the preconditioner assumes; a wrong value costs iterations.
const ASSUMED_EIGENVALUE: f64 = 0.5;

/// What the solver knows of the matrix.
pub struct CoupledSystem<'a> {
    /// `blocks(r, y)` computes `y = H r`.
    pub blocks: &'a mut dyn FnMut(&[f32], &mut [f32]),
    /// `C`.
    pub coupling: &'a dyn LinearOperator,
    /// The preconditioner.
    pub inverse: Inverse<'a>,
}

/// The solver; it keeps `δ` from call to call.
#[derive(Default)]
pub struct CoupledBlocks {
    delta: Vec<f32>,
}

impl CoupledBlocks {
    /// Writes the solution to `y`, and `(G + C Cᵀ) y` to `gram_y`. Returns whether `y` reached the tolerance.
    ///
    /// `gram_y` belongs to the returned `y`, whether or not this reached the tolerance.
    pub fn solve(
        &mut self,
        system: CoupledSystem,
        r: &[f32],
        rho: f64,
        y: &mut [f32],
        gram_y: &mut [f32],
    ) -> bool {
        let CoupledSystem {
            blocks,
            coupling,
            inverse,
        } = system;
        let (n, m) = (coupling.domain_len(), coupling.range_len());
        self.delta.resize(n, 0.0);
        // y = H (r − C δ)
        let mut c_delta = vec![0.0f32; m];
        coupling.apply(&self.delta, &mut c_delta);
        let rhs: Vec<f32> = r.iter().zip(&c_delta).map(|(r, c)| r - c).collect();
        blocks(&rhs, y);
        let mut g = vec![0.0f32; n];
        coupling.adjoint(y, &mut g);
        g.iter_mut().zip(&self.delta).for_each(|(g, d)| *g -= d);
        let precondition = |g: &[f32]| inverse(g, rho, ASSUMED_EIGENVALUE);
        let mut preconditioned = precondition(&g);
        let mut direction = preconditioned.clone();
        // gᵀ M⁻¹ g with the preconditioner M⁻¹.
        let mut residual_product = dot(&g, &preconditioned);
        let (mut c_direction, mut hc_direction) = (vec![0.0f32; m], vec![0.0f32; m]);
        let mut chc_direction = vec![0.0f32; n];
        let mut c_g = vec![0.0f32; m];
        let mut is_accurate = false;
        for k in 0..=ITERATIONS {
            if k.is_multiple_of(CHECK_INTERVAL) {
                coupling.apply(&g, &mut c_g);
                is_accurate = norm(&c_g) <= TOLERANCE * rho * norm(y);
                if is_accurate || k == ITERATIONS || residual_product <= 0.0 {
                    break;
                }
            }
            coupling.apply(&direction, &mut c_direction);
            blocks(&c_direction, &mut hc_direction);
            coupling.adjoint(&hc_direction, &mut chc_direction);
            let curvature = dot(&direction, &direction) + dot(&direction, &chc_direction);
            let step = (residual_product / curvature) as f32;
            for i in 0..n {
                self.delta[i] += step * direction[i];
                g[i] -= step * (direction[i] + chc_direction[i]);
            }
            for (y, hc_direction) in y.iter_mut().zip(&hc_direction) {
                *y -= step * hc_direction;
            }
            preconditioned = precondition(&g);
            let next = dot(&g, &preconditioned);
            let beta = (next / residual_product) as f32;
            residual_product = next;
            for (d, s) in direction.iter_mut().zip(&preconditioned) {
                *d = s + beta * *d;
            }
        }
        // G y = r − C δ − ρ y, and C Cᵀ y = C δ + C g.
        for i in 0..m {
            gram_y[i] = r[i] - rho as f32 * y[i] + c_g[i];
        }
        is_accurate
    }

    /// Makes the next call start from `δ = 0`.
    pub fn reset(&mut self) {
        self.delta.fill(0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blocks::Blocks;
    use rand::{RngExt, SeedableRng};

    struct Dense(Vec<Vec<f32>>);

    impl LinearOperator for Dense {
        fn domain_len(&self) -> usize {
            self.0[0].len()
        }
        fn range_len(&self) -> usize {
            self.0.len()
        }
        fn apply(&self, x: &[f32], y: &mut [f32]) {
            for (y, row) in y.iter_mut().zip(&self.0) {
                *y = row.iter().zip(x).map(|(a, x)| a * x).sum();
            }
        }
        fn adjoint(&self, y: &[f32], x: &mut [f32]) {
            x.fill(0.0);
            for (y, row) in y.iter().zip(&self.0) {
                x.iter_mut().zip(row).for_each(|(x, a)| *x += a * y);
            }
        }
    }

    /// Blocks 2×2 with `G = diag(1, 2, 3, …)`, and a coupling of three columns.
    #[test]
    fn solves_the_whole_system() {
        let m = 8;
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        let mut random =
            |n: usize| -> Vec<f32> { (0..n).map(|_| rng.random_range(-1.0f32..1.0)).collect() };
        let coupling = Dense((0..m).map(|_| random(3)).collect());
        let r = random(m);
        let indices = (0..m / 2).map(|i| vec![2 * i, 2 * i + 1]).collect();
        let mut blocks = Blocks::new(indices, |i, mut g: faer::MatMut<f64>| {
            g[(0, 0)] = (2 * i + 1) as f64;
            g[(1, 1)] = (2 * i + 2) as f64;
        });
        let mut solver = CoupledBlocks::default();
        let plain = |g: &[f32], _: f64, _: f64| g.to_vec();
        let (mut y, mut gram_y) = (vec![f32::NAN; m], vec![f32::NAN; m]);
        let rho = 0.1;
        let mut blocks = |r: &[f32], y: &mut [f32]| blocks.solve(r, rho, y);
        let system = CoupledSystem {
            blocks: &mut blocks,
            coupling: &coupling,
            inverse: &plain,
        };
        assert!(solver.solve(system, &r, rho, &mut y, &mut gram_y));
        let mut ct_y = vec![0.0; 3];
        coupling.adjoint(&y, &mut ct_y);
        let mut cct_y = vec![0.0; m];
        coupling.apply(&ct_y, &mut cct_y);
        for i in 0..m {
            let gram = (i + 1) as f32 * y[i] + cct_y[i];
            assert!((gram - gram_y[i]).abs() < 1e-4, "{gram} {}", gram_y[i]);
            let left = gram + rho as f32 * y[i] - r[i];
            assert!(
                left.abs() < 0.1 * rho as f32 * norm(&y) as f32 + 1e-5,
                "{left}"
            );
        }
    }
}
