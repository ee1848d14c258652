//! Preconditioned conjugate gradients for `(A P Aᵀ + ρI) y = r`, with `P` the projection onto the support.
//!
//! They are for operators whose `A Aᵀ` has no small blocks: exposures longer than a row, or a global shutter. They are
//! flexible: directions follow the formula of Polak and Ribière, so the preconditioner may itself be solved inexactly
//! (Notay, SIAM J. Sci. Comput. 22, 1444, 2000).

use rowburst_core::Support;
use rowburst_core::linop::LinearOperator;
use rowburst_core::vecmath::{dot, norm};

/// An approximate inverse of `A Aᵀ + ρI`, symmetric and positive definite.
pub trait Preconditioner: Send {
    /// Most iterations of a call for videos that are restricted to a support or not, see
    /// [`ConjugateGradient::early_calls`] for early ones. Larger makes fewer x-steps inexact and costs time
    /// (docs/design/025).
    fn max_iterations(&self, is_restricted: bool, is_early: bool) -> usize;

    /// Writes the approximation of `(A Aᵀ + ρI)⁻¹ r` to `out`.
    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]);
}

/// Residual over `ρ‖y‖` at which a x-step stops; larger drives `ρ` to nothing, smaller costs time (docs/design/004).
pub const TOLERANCE: f64 = 0.1;

/// Calls after which `A P Aᵀ y` is computed afresh; more let rounding errors add up.
const RENEWAL_INTERVAL: usize = 25;

/// The solver; it starts each call from the last solution.
pub struct ConjugateGradient {
    preconditioner: Box<dyn Preconditioner>,
    /// The last solution `y`, and `A P Aᵀ y`.
    y: Vec<f32>,
    gram_y: Vec<f32>,
    /// Whether `gram_y` is that of another support.
    is_stale: bool,
    /// Calls since the last change of the operator.
    calls: usize,
    /// So many calls from the first one on are early ones, for which a coarse solution will do; 0: none.
    pub early_calls: usize,
    support: Option<Support>,
}

impl ConjugateGradient {
    /// Starts from zero for `length` measurements.
    pub fn new(preconditioner: Box<dyn Preconditioner>, length: usize) -> Self {
        Self {
            preconditioner,
            y: vec![0.0; length],
            gram_y: vec![0.0; length],
            is_stale: false,
            calls: 0,
            early_calls: 0,
            support: None,
        }
    }

    /// Restricts videos to `support` from now on.
    pub fn restrict(&mut self, support: &Support, preconditioner: Box<dyn Preconditioner>) {
        self.support = Some(support.clone());
        self.is_stale = true;
        self.preconditioner = preconditioner;
    }

    /// Prepares for another operator: the next call starts from zero.
    ///
    /// Videos are restricted to `support` (`None`: every voxel).
    pub fn restart(&mut self, support: Option<&Support>, preconditioner: Box<dyn Preconditioner>) {
        self.y.fill(0.0);
        self.gram_y.fill(0.0);
        self.is_stale = false;
        self.calls = 0;
        self.support = support.cloned();
        self.preconditioner = preconditioner;
    }

    /// The next call starts from zero.
    pub fn forget(&mut self) {
        self.y.fill(0.0);
        self.gram_y.fill(0.0);
        self.is_stale = false;
    }

    /// Writes the solution to `y`, and `A P Aᵀ y` to `gram_y`. Returns whether the residual of `y` is at most `tolerance`
    /// times `ρ‖y‖`.
    ///
    /// `gram_y` belongs to the returned `y`, whether or not this reached the tolerance. The next call starts from it.
    pub fn solve(
        &mut self,
        operator: &dyn LinearOperator,
        r: &[f32],
        rho: f64,
        tolerance: f64,
        y: &mut [f32],
        gram_y: &mut [f32],
    ) -> bool {
        let mut video = vec![0.0f32; operator.domain_len()];
        let mut gram = |x: &[f32], out: &mut [f32]| {
            operator.adjoint(x, &mut video);
            if let Some(support) = &self.support {
                support.zero_outside(&mut video);
            }
            operator.apply(&video, out);
        };
        y.copy_from_slice(&self.y);
        if self.is_stale || self.calls % RENEWAL_INTERVAL == RENEWAL_INTERVAL - 1 {
            gram(y, &mut self.gram_y);
            self.is_stale = false;
        }
        let max_iterations = self
            .preconditioner
            .max_iterations(self.support.is_some(), self.calls < self.early_calls);
        self.calls += 1;
        gram_y.copy_from_slice(&self.gram_y);
        let mut residual: Vec<f32> = (0..r.len())
            .map(|i| r[i] - gram_y[i] - rho as f32 * y[i])
            .collect();
        let is_reached = |residual: &[f32], y: &[f32]| norm(residual) <= tolerance * rho * norm(y);
        let mut preconditioned = vec![0.0f32; r.len()];
        let mut direction = vec![0.0f32; r.len()];
        let mut product = vec![0.0f32; r.len()];
        let mut before = vec![0.0f32; r.len()];
        // rᵀ M⁻¹ r with the residual r and the preconditioner M⁻¹.
        let mut residual_product = f64::INFINITY;
        // On a support one at least is taken: otherwise the error of a call stays near the tolerance, and a run that
        // converges is held up (docs/design/033).
        let fewest = usize::from(self.support.is_some());
        for iteration in 0..max_iterations {
            if iteration >= fewest && is_reached(&residual, y) {
                break;
            }
            self.preconditioner
                .apply(&residual, rho, &mut preconditioned);
            let next = dot(&residual, &preconditioned);
            if next <= 0.0 {
                break;
            }
            let beta = ((next - dot(&before, &preconditioned)) / residual_product) as f32;
            residual_product = next;
            for (d, s) in direction.iter_mut().zip(&preconditioned) {
                *d = s + beta * *d;
            }
            gram(&direction, &mut product);
            let curvature = dot(&direction, &product) + rho * dot(&direction, &direction);
            let step = (residual_product / curvature) as f32;
            before.copy_from_slice(&residual);
            for i in 0..r.len() {
                y[i] += step * direction[i];
                gram_y[i] += step * product[i];
                residual[i] -= step * (product[i] + rho as f32 * direction[i]);
            }
        }
        self.y.copy_from_slice(y);
        self.gram_y.copy_from_slice(gram_y);
        is_reached(&residual, y)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_core::Shape;

    const N: usize = 6;

    /// `A = I`.
    struct Identity;

    impl LinearOperator for Identity {
        fn domain_len(&self) -> usize {
            N
        }

        fn range_len(&self) -> usize {
            N
        }

        fn apply(&self, x: &[f32], y: &mut [f32]) {
            y.copy_from_slice(x);
        }

        fn adjoint(&self, y: &[f32], x: &mut [f32]) {
            x.copy_from_slice(y);
        }
    }

    /// No preconditioning.
    struct Plain;

    impl Preconditioner for Plain {
        fn max_iterations(&self, _: bool, _: bool) -> usize {
            5
        }

        fn apply(&mut self, r: &[f32], _: f64, out: &mut [f32]) {
            out.copy_from_slice(r);
        }
    }

    /// A residual within the tolerance is lowered on a support, so that errors do not add up from call to call.
    #[test]
    fn a_call_on_a_support_takes_an_iteration() {
        for is_restricted in [false, true] {
            let mut solver = ConjugateGradient::new(Box::new(Plain), N);
            if is_restricted {
                solver.restrict(&Support::full(Shape::new(1, 2, 3)), Box::new(Plain));
            }
            let (mut y, mut gram_y) = (vec![0.0; N], vec![0.0; N]);
            for (r, expected) in [(2.0, 1.0), (2.02, if is_restricted { 1.01 } else { 1.0 })] {
                assert!(solver.solve(&Identity, &[r; N], 1.0, 0.1, &mut y, &mut gram_y));
                assert!(y.iter().all(|y| (y - expected).abs() < 1e-5), "{y:?}");
            }
        }
    }
}
