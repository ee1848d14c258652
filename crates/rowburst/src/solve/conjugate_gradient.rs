//! Preconditioned conjugate gradients for `(A P Aᵀ + ρI) y = r`, where `A Aᵀ` has no
//! small blocks: exposures longer than a row, a global shutter.

use crate::Support;
use crate::linop::LinearOperator;
use crate::vecmath::{dot, norm};

/// An approximate inverse of `A Aᵀ + ρI`, symmetric and positive definite.
pub trait Preconditioner: Send {
    /// Overwrites `out`.
    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]);
}

/// Most iterations of one call.
const ITERATIONS: usize = 100;

/// The residual at which a call stops, over `ρ‖y‖`, which is what the data term leaves
/// unexplained. The caller accounts for what is left, and the next call starts from
/// this one's result.
const TOLERANCE: f64 = 0.1;

/// State kept from call to call.
pub struct ConjugateGradient {
    preconditioner: Box<dyn Preconditioner>,
    /// The last solution: the start of the next.
    y: Vec<f32>,
    support: Option<Support>,
}

impl ConjugateGradient {
    /// Starts from zero for `length` measurements.
    pub fn new(preconditioner: Box<dyn Preconditioner>, length: usize) -> Self {
        Self {
            preconditioner,
            y: vec![0.0; length],
            support: None,
        }
    }

    /// From now on videos are zero outside `support`.
    pub fn restrict(&mut self, support: &Support, preconditioner: Option<Box<dyn Preconditioner>>) {
        self.support = Some(support.clone());
        if let Some(preconditioner) = preconditioner {
            self.preconditioner = preconditioner;
        }
    }

    /// Another operator: starts from zero with videos restricted to `support`, if there is one.
    pub fn restart(&mut self, support: Option<&Support>, preconditioner: Box<dyn Preconditioner>) {
        self.y.fill(0.0);
        self.support = support.cloned();
        self.preconditioner = preconditioner;
    }

    /// Overwrites `y`, and `gram_y` with `A P Aᵀ y`, exact for the `y` returned; whether
    /// `y` has reached the tolerance.
    pub fn solve(
        &mut self,
        operator: &dyn LinearOperator,
        r: &[f32],
        rho: f64,
        y: &mut [f32],
        gram_y: &mut [f32],
    ) -> bool {
        let mut video = vec![0.0f32; operator.domain_len()];
        let mut gram = |x: &[f32], out: &mut [f32]| {
            operator.adjoint(x, &mut video);
            if let Some(support) = &self.support {
                support.apply(&mut video);
            }
            operator.apply(&video, out);
        };
        y.copy_from_slice(&self.y);
        gram(y, gram_y);
        let mut rest: Vec<f32> = (0..r.len())
            .map(|i| r[i] - gram_y[i] - rho as f32 * y[i])
            .collect();
        let mut s = vec![0.0f32; r.len()];
        self.preconditioner.apply(&rest, rho, &mut s);
        let mut direction = s.clone();
        let mut product = vec![0.0f32; r.len()];
        let mut slope = dot(&rest, &s);
        let is_reached = |rest: &[f32], y: &[f32]| norm(rest) <= TOLERANCE * rho * norm(y);
        for _ in 0..ITERATIONS {
            if is_reached(&rest, y) || slope <= 0.0 {
                break;
            }
            gram(&direction, &mut product);
            let curvature = dot(&direction, &product) + rho * dot(&direction, &direction);
            let step = (slope / curvature) as f32;
            for i in 0..r.len() {
                y[i] += step * direction[i];
                gram_y[i] += step * product[i];
                rest[i] -= step * (product[i] + rho as f32 * direction[i]);
            }
            self.preconditioner.apply(&rest, rho, &mut s);
            let next = dot(&rest, &s);
            let beta = (next / slope) as f32;
            slope = next;
            for (d, s) in direction.iter_mut().zip(&s) {
                *d = s + beta * *d;
            }
        }
        self.y.copy_from_slice(y);
        is_reached(&rest, y)
    }
}
