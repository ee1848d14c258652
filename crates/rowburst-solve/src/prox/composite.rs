//! Sums of priors of any kind, with `v ≥ 0`.
//!
//! ```text
//! R(v) = R_variation(v) + w_g Σ_pixels ‖v[·, y, x]‖₂ + Σ_i w_i ‖K_i v‖_i
//! ```
//!
//! **Exact part.** `v ≥ 0`, the support, ℓ1 and the group norm over time together have a prox in closed form:
//! subtract, cut at zero, and shrink each pixel's trace as a whole. The group norm (`group`, ℓ2,1; Yuan & Lin 2006)
//! favours few active pixels, each with any trace.
//!
//! **Dual part.** The other terms are solved in the dual like [`Variation`]. With `c(p) = Dᵀp_v + Σ K_iᵀ p_i` the
//! primal point is `z(p) = prox_exact(q − c(p))`. Every term takes projected gradient steps
//! `p_i ← P_i(p_i + step_i K_i z(p))` with `step_i = 1.9 / (‖K_i‖ Σ_j ‖K_j‖)`, so `Σ step_i ‖K_i‖² < 2` (Pock &
//! Chambolle 2011). A term with a small norm takes larger steps than one with a large norm. Duals are kept from call
//! to call.
//!
//! **Accuracy.** `R` is homogeneous, so the duality gap of the prox at `z(p)` is `s R(z) − ⟨q − z, z⟩`. The prox is
//! strongly convex, so `‖z − prox(q)‖ ≤ √(2 gap)`. A call takes steps until this bound is below the movement of `q`
//! since the last call, which is the outer solver's own error (a relative-error criterion as in Eckstein & Yao 2018).
//! It takes at least 2 and at most 4 steps, 6 where it is refined (docs/design/012, 033).

use super::dual::DualTerm;
use super::term::{Coupling, TermForm, TermSpec};
use super::variation::REFINED_STEPS;
use super::{Prox, Variation, VariationWeights};
use rayon::prelude::*;
use rowburst_core::vecmath::{distance_squared, simd};
use rowburst_core::{Shape, Support};

/// The term `group`.
pub const GROUP: TermSpec = TermSpec {
    name: "group",
    favours: "few active pixels, each with any trace",
    coupling: Coupling::All,
    excludes: None,
    unit: |shape| 2.0 * (shape.bins as f64).sqrt(),
    form: TermForm::Traces,
};

/// Largest error bound of a prox over the last movement of `q`; smaller takes more steps.
const ACCURACY: f64 = 1.0;

/// Fewest dual steps of a call.
const MIN_STEPS: usize = 2;

/// Most dual steps of a call; more cost time and gain nothing, since the dual is kept (docs/design/012).
const MAX_STEPS: usize = 4;

/// `Σ step_i ‖K_i‖²`; larger is faster but must stay below 2 to converge.
const STEP: f64 = 1.9;

/// A sum of a [`Variation`], a group norm over time and other terms.
#[derive(Clone)]
pub struct Composite {
    shape: Shape,
    variation: Variation,
    group: f64,
    terms: Vec<WeightedTerm>,
    min_steps: usize,
    max_steps: usize,
    /// See [`Prox::set_refined`].
    is_refined: bool,
    /// `q` of the last call with duals; empty before it.
    last: Vec<f32>,
    /// Buffer for `q − Σ K_iᵀ p_i`; empty without terms.
    point: Vec<f32>,
    scale: f64,
    steps_taken: usize,
}

#[derive(Clone)]
struct WeightedTerm {
    weight: f64,
    term: Box<dyn DualTerm>,
}

impl Composite {
    /// The sum without further terms, with all duals at zero. A part with weight zero is absent.
    pub fn new(shape: Shape, variation: VariationWeights, group: f64) -> Self {
        Self {
            shape,
            variation: Variation::new(shape, variation),
            group,
            terms: Vec::new(),
            min_steps: MIN_STEPS,
            max_steps: MAX_STEPS,
            is_refined: false,
            last: Vec::new(),
            point: Vec::new(),
            scale: 0.0,
            steps_taken: 0,
        }
    }

    /// The sum plus `weight` times `term`.
    #[must_use]
    pub fn with(mut self, weight: f64, term: Box<dyn DualTerm>) -> Self {
        self.terms.push(WeightedTerm { weight, term });
        self
    }

    /// The same with exactly `steps` dual steps a call. A prox outside an outer solver needs more than the default; the
    /// tests take up to 5000.
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

    /// Computes `z(p)`.
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

    /// Takes one step of every dual from `z = z(p)`; returns the duality gap at `z`.
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
        (self.scale * value - gap_inner_product(q, z)).max(0.0)
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
        let max_steps = if self.is_refined {
            self.max_steps.max(REFINED_STEPS)
        } else {
            self.max_steps
        };
        for step in 1..=max_steps {
            let gap = self.step_duals(q, z, norms);
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

    /// The smallest estimate of all terms: a fit is no freer than under its strictest term.
    ///
    /// ℓ1 and the group norm leave all active voxels free.
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        let terms = self.terms.iter();
        terms
            .map(|part| part.term.degrees_of_freedom(z, tolerance))
            .fold(self.variation.degrees_of_freedom(z, tolerance), f64::min)
    }

    fn restrict(&mut self, support: &Support) {
        self.variation.restrict(support);
    }

    fn set_refined(&mut self, is_refined: bool) {
        self.is_refined = is_refined;
    }

    fn subtract_dual(&self, v: &mut [f32]) {
        for part in &self.terms {
            part.term.subtract_adjoint(v);
        }
        self.variation.subtract_dual(v);
        if self.group > 0.0 {
            // The dual of the group norm is the trace in the ball that leaves the smallest remainder.
            v.par_iter_mut().for_each(|v| *v = v.max(0.0));
            shrink_traces(v, self.shape.pixels(), (self.scale * self.group) as f32);
        }
    }
}

/// `⟨q − z, z⟩`.
fn gap_inner_product(q: &[f32], z: &[f32]) -> f64 {
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

/// The prox of `radius·Σ_pixels ‖trace‖₂`: it shortens the norm of every trace by `radius`.
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
