//! `(G + C Cᵀ + ρI) y = r` where `G` has small blocks and `C` joins them all: a part of the
//! unknowns that every measurement sees, such as a background that stands still.
//!
//! With `H = (G + ρI)⁻¹`, which the blocks' factors give, `δ = Cᵀ y` is the solution of
//!
//! ```text
//! (I + Cᵀ H C) δ = Cᵀ H r,     y = H (r − C δ)
//! ```
//!
//! (the Schur complement of `G + ρI`; Golub & Van Loan, 4th ed., section 3.2.11), by
//! preconditioned conjugate gradients from the last `δ`. Its residual `g = Cᵀ y − δ` leaves
//! `C g` of the whole system.

use crate::linop::LinearOperator;
use crate::vecmath::{dot, norm};

/// Most iterations of one call, and from one look at the error to the next.
const ITERATIONS: usize = 60;
const CHECK_INTERVAL: usize = 3;

/// The error at which a call stops, over `ρ‖y‖`, as in [`super::conjugate_gradient`].
const TOLERANCE: f64 = 0.1;

/// An approximate inverse of `ρI + h Cᵀ C`: of a vector, `ρ` and `h`.
pub type Inverse<'a> = &'a dyn Fn(&[f32], f64, f64) -> Vec<f32>;

/// Mean eigenvalue of `ρH` that the preconditioner supposes: about half of what a block
/// measures is not explained by what it lights.
const UNEXPLAINED: f64 = 0.5;

/// State kept from call to call.
#[derive(Default)]
pub struct Bordered {
    delta: Vec<f32>,
}

impl Bordered {
    /// `blocks(r, y)` is `y = H r`. Overwrites `y`, and `gram_y` with `(G + C Cᵀ) y`, exact for the `y` returned; whether
    /// `y` is as good as it should be.
    pub fn solve(
        &mut self,
        blocks: &mut dyn FnMut(&[f32], &mut [f32]),
        border: &dyn LinearOperator,
        inverse: Inverse,
        (r, rho): (&[f32], f64),
        y: &mut [f32],
        gram_y: &mut [f32],
    ) -> bool {
        let (n, m) = (border.domain_len(), border.range_len());
        self.delta.resize(n, 0.0);
        // y = H (r − C δ)
        let mut light = vec![0.0f32; m];
        border.apply(&self.delta, &mut light);
        let rest: Vec<f32> = r.iter().zip(&light).map(|(r, l)| r - l).collect();
        blocks(&rest, y);
        let mut g = vec![0.0f32; n];
        border.adjoint(y, &mut g);
        g.iter_mut().zip(&self.delta).for_each(|(g, d)| *g -= d);
        let precondition = |g: &[f32]| inverse(g, rho, UNEXPLAINED);
        let mut s = precondition(&g);
        let mut direction = s.clone();
        let mut slope = dot(&g, &s);
        let (mut seen, mut answer) = (vec![0.0f32; m], vec![0.0f32; m]);
        let mut pull = vec![0.0f32; n];
        let mut left = vec![0.0f32; m];
        let mut is_good = false;
        for k in 0..=ITERATIONS {
            if k.is_multiple_of(CHECK_INTERVAL) {
                border.apply(&g, &mut left);
                is_good = norm(&left) <= TOLERANCE * rho * norm(y);
                if is_good || k == ITERATIONS || slope <= 0.0 {
                    break;
                }
            }
            border.apply(&direction, &mut seen);
            blocks(&seen, &mut answer);
            border.adjoint(&answer, &mut pull);
            let curvature = dot(&direction, &direction) + dot(&direction, &pull);
            let step = (slope / curvature) as f32;
            for i in 0..n {
                self.delta[i] += step * direction[i];
                g[i] -= step * (direction[i] + pull[i]);
            }
            for i in 0..m {
                y[i] -= step * answer[i];
                light[i] += step * seen[i];
            }
            s = precondition(&g);
            let next = dot(&g, &s);
            let beta = (next / slope) as f32;
            slope = next;
            for (d, s) in direction.iter_mut().zip(&s) {
                *d = s + beta * *d;
            }
        }
        // G y = r − C δ − ρ y, and C Cᵀ y = C δ + C g.
        for i in 0..m {
            gram_y[i] = r[i] - rho as f32 * y[i] + left[i];
        }
        is_good
    }

    /// Starts from nothing.
    pub fn reset(&mut self) {
        self.delta.fill(0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solve::GramSolver;
    use crate::solve::blocks::Blocks;
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

    /// Blocks 2×2 with `G = diag(1, 2, 3, …)`, and a border of three columns.
    #[test]
    fn solves_the_whole_system() {
        let m = 8;
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        let mut random =
            |n: usize| -> Vec<f32> { (0..n).map(|_| rng.random_range(-1.0f32..1.0)).collect() };
        let border = Dense((0..m).map(|_| random(3)).collect());
        let r = random(m);
        let indices = (0..m / 2).map(|i| vec![2 * i, 2 * i + 1]).collect();
        let mut blocks = Blocks::new(indices, |i, mut g: faer::MatMut<f64>| {
            g[(0, 0)] = (2 * i + 1) as f64;
            g[(1, 1)] = (2 * i + 2) as f64;
        });
        let mut solver = Bordered::default();
        let plain = |g: &[f32], _: f64, _: f64| g.to_vec();
        let (mut y, mut gram_y) = (vec![f32::NAN; m], vec![f32::NAN; m]);
        let rho = 0.1;
        let mut blocks = |r: &[f32], y: &mut [f32]| blocks.solve(r, rho, y);
        assert!(solver.solve(&mut blocks, &border, &plain, (&r, rho), &mut y, &mut gram_y));
        let mut pull = vec![0.0; 3];
        border.adjoint(&y, &mut pull);
        let mut seen = vec![0.0; m];
        border.apply(&pull, &mut seen);
        for i in 0..m {
            let gram = (i + 1) as f32 * y[i] + seen[i];
            assert!((gram - gram_y[i]).abs() < 1e-4, "{gram} {}", gram_y[i]);
            let left = gram + rho as f32 * y[i] - r[i];
            assert!(
                left.abs() < 0.1 * rho as f32 * norm(&y) as f32 + 1e-5,
                "{left}"
            );
        }
    }
}
