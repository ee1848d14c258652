//! Sums of priors of any kind, with `v ≥ 0`.
//!
//! ```text
//! R(v) = R_variation(v) + w_g Σ_pixels ‖v[·, y, x]‖₂ + Σ_i w_i ‖K_i v‖_i
//! ```
//!
//! **Exact part.** `v ≥ 0`, the support, ℓ1 and the group norm over time (`group`, ℓ2,1:
//! few places, any trace; Yuan & Lin 2006) have a prox in closed form together: subtract,
//! cut at zero, shrink each pixel's trace as a whole.
//!
//! **Dual part.** The others are solved in the dual like [`Variation`]: with
//! `c(p) = Dᵀp_v + Σ K_iᵀ p_i` the primal point is `z(p) = prox_exact(q − c(p))`, and
//! every term takes projected gradient steps `p_i ← P_i(p_i + step_i K_i z(p))` with
//! `step_i = 1.9 / (‖K_i‖ Σ_j ‖K_j‖)`, which keeps `Σ step_i ‖K_i‖² < 2` (Pock & Chambolle
//! 2011): a transform of norm 1 is not held back by differences of norm 3 beside it. Duals
//! are kept from call to call.
//!
//! **Accuracy.** `R` is homogeneous, so the duality gap of the prox at `z(p)` is
//! `s R(z) − ⟨q − z, z⟩`, and `‖z − prox(q)‖ ≤ √(2 gap)` as the prox is strongly convex.
//! The steps go on until this is below how far `q` has moved since the last call, which
//! is the outer solver's own error (a relative-error criterion as in Eckstein & Yao
//! 2018), and at least 2; a cap of 4 bounds the time of a call.

use super::dual::DualTerm;
use super::{Prox, Variation, VariationWeights};
use crate::vecmath::{distance_squared, simd};
use crate::{Shape, Support};
use rayon::prelude::*;

/// Largest error of a prox over the outer solver's last movement.
const ACCURACY: f64 = 1.0;

/// Fewest and most dual steps of a call inside an outer solver. With the dual kept, what a call
/// leaves undone the next one does: at most 2, 4 or 12 steps a call gave a moving digit
/// the same 29.8 dB in the same 200 iterations of `tv3d`, and soft blobs the same 22.6 dB of
/// `wavelet` with 2 and 12; the bound on the error is pessimistic, and 12 steps took twice the time.
const MIN_STEPS: usize = 2;
const MAX_STEPS: usize = 4;

/// Length of a dual step over the largest that is safe by half; up to 2 converges.
const STEP: f64 = 1.9;

/// A sum of a [`Variation`], a group norm over time and other terms.
pub struct Composite {
    shape: Shape,
    variation: Variation,
    group: f64,
    terms: Vec<WeightedTerm>,
    min_steps: usize,
    max_steps: usize,
    /// `q` of the last call, and the point where the terms have been subtracted; empty without any.
    last: Vec<f32>,
    point: Vec<f32>,
    scale: f64,
    steps_taken: usize,
}

struct WeightedTerm {
    weight: f64,
    term: Box<dyn DualTerm>,
}

impl Composite {
    /// The sum with all duals at zero; weights of zero leave a part out.
    pub fn new(shape: Shape, variation: VariationWeights, group: f64) -> Self {
        Self {
            shape,
            variation: Variation::new(shape, variation),
            group,
            terms: Vec::new(),
            min_steps: MIN_STEPS,
            max_steps: MAX_STEPS,
            last: Vec::new(),
            point: Vec::new(),
            scale: 0.0,
            steps_taken: 0,
        }
    }

    /// The same plus `weight` times `term`.
    #[must_use]
    pub fn with(mut self, weight: f64, term: impl DualTerm + 'static) -> Self {
        let term = Box::new(term);
        self.terms.push(WeightedTerm { weight, term });
        self
    }

    /// The same with `steps` dual steps a call, for a prox that stands alone.
    #[must_use]
    pub fn with_steps(mut self, steps: usize) -> Self {
        (self.min_steps, self.max_steps) = (steps, steps);
        self
    }

    /// Dual steps of the last call.
    pub fn steps_taken(&self) -> usize {
        self.steps_taken
    }

    fn rescale_duals(&mut self, scale: f64) {
        if self.scale > 0.0 && self.scale != scale {
            let factor = (scale / self.scale) as f32;
            self.terms
                .iter_mut()
                .for_each(|part| part.term.rescale(factor));
        }
        self.variation.set_scale(scale);
        self.scale = scale;
    }

    /// `z(p)`.
    fn primal(&mut self, q: &[f32], z: &mut [f32]) {
        if self.terms.is_empty() {
            self.variation.primal(q, self.scale, z);
        } else {
            self.point.clear();
            self.point.extend_from_slice(q);
            for part in &self.terms {
                part.term.subtract_adjoint(&mut self.point);
            }
            self.variation.primal(&self.point, self.scale, z);
        }
        if self.group > 0.0 {
            shrink_traces(z, self.shape.pixels(), (self.scale * self.group) as f32);
        }
    }

    /// One step of every dual from `z(p)`; returns the gap there.
    fn step_duals(&mut self, q: &[f32], z: &[f32], norms: f64) -> f64 {
        let mut value = self.variation.value(z) + self.group_norm(z);
        for WeightedTerm { weight, term } in &mut self.terms {
            let step = STEP / (term.norm_squared().sqrt() * norms);
            let radius = self.scale * *weight;
            value += *weight * term.step(z, step as f32, radius as f32);
        }
        if self.variation.is_dual() {
            let step = STEP / (self.variation.norm_squared().sqrt() * norms);
            self.variation.step_dual(z, self.scale, step as f32);
        }
        (self.scale * value - inner_rest(q, z)).max(0.0)
    }

    fn group_norm(&self, z: &[f32]) -> f64 {
        if self.group == 0.0 {
            return 0.0;
        }
        let squares = squares_of_traces(z, self.shape.pixels());
        let norms = squares.iter().map(|s| f64::from(*s).sqrt());
        self.group * norms.sum::<f64>()
    }
}

impl Prox for Composite {
    fn prox(&mut self, q: &[f32], scale: f64, z: &mut [f32]) {
        assert_eq!(q.len(), self.shape.voxels(), "length of the point");
        assert_eq!(z.len(), self.shape.voxels(), "length of the result");
        self.rescale_duals(scale);
        self.primal(q, z);
        self.steps_taken = 0;
        let terms = self
            .terms
            .iter()
            .map(|part| part.term.norm_squared().sqrt());
        let norms = terms.sum::<f64>() + self.variation.norm_squared().sqrt();
        if norms == 0.0 {
            return;
        }
        let moved = if self.last.is_empty() {
            f64::INFINITY
        } else {
            distance_squared(q, &self.last).sqrt()
        };
        self.last.clear();
        self.last.extend_from_slice(q);
        for step in 1..=self.max_steps {
            let gap = self.step_duals(q, z, norms);
            // Before the fewest steps are done, and while it is coarser than the outer error.
            if step > self.min_steps && (2.0 * gap).sqrt() <= ACCURACY * moved {
                break;
            }
            self.primal(q, z);
            self.steps_taken = step;
        }
    }

    fn value(&self, z: &[f32]) -> f64 {
        let terms = self
            .terms
            .iter()
            .map(|part| part.weight * part.term.value(z));
        self.variation.value(z) + self.group_norm(z) + terms.sum::<f64>()
    }

    /// The least of what each term leaves free: a fit is no freer than under its
    /// strictest term. A term of voxels or groups leaves free what is lit.
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        let terms = self.terms.iter();
        terms
            .map(|part| part.term.degrees_of_freedom(z, tolerance))
            .fold(self.variation.degrees_of_freedom(z, tolerance), f64::min)
    }

    fn restrict(&mut self, support: &Support) {
        self.variation.restrict(support);
    }

    fn subtract_dual(&self, v: &mut [f32]) {
        for part in &self.terms {
            part.term.subtract_adjoint(v);
        }
        self.variation.subtract_dual(v);
        if self.group > 0.0 {
            // Of all traces in the ball the one that leaves least.
            v.par_iter_mut().for_each(|v| *v = v.max(0.0));
            shrink_traces(v, self.shape.pixels(), (self.scale * self.group) as f32);
        }
    }
}

/// `⟨q − z, z⟩`.
fn inner_rest(q: &[f32], z: &[f32]) -> f64 {
    const CHUNK: usize = 1 << 14;
    let parts: Vec<f64> = q
        .par_chunks(CHUNK)
        .zip(z.par_chunks(CHUNK))
        .map(|(q, z)| {
            let products = q
                .iter()
                .zip(z)
                .map(|(q, z)| f64::from(q - z) * f64::from(*z));
            products.sum()
        })
        .collect();
    parts.iter().sum()
}

/// `Σ_t z[t]²` of every pixel.
fn squares_of_traces(z: &[f32], pixels: usize) -> Vec<f32> {
    const CHUNK: usize = 1 << 10;
    let mut squares = vec![0.0f32; pixels];
    squares
        .par_chunks_mut(CHUNK)
        .enumerate()
        .for_each(|(i, sums)| {
            for bin in z.chunks_exact(pixels) {
                let bin = &bin[i * CHUNK..i * CHUNK + sums.len()];
                simd(
                    #[inline(always)]
                    || sums.iter_mut().zip(bin).for_each(|(sum, z)| *sum += z * z),
                );
            }
        });
    squares
}

/// The prox of `radius·Σ_pixels ‖trace‖₂`: every trace shortened by `radius`.
fn shrink_traces(z: &mut [f32], pixels: usize, radius: f32) {
    let mut factors = squares_of_traces(z, pixels);
    for factor in &mut factors {
        let norm = factor.sqrt();
        *factor = if norm > radius {
            1.0 - radius / norm
        } else {
            0.0
        };
    }
    z.par_chunks_exact_mut(pixels)
        .for_each(|bin| bin.iter_mut().zip(&factors).for_each(|(z, f)| *z *= f));
}
