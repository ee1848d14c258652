//! An example of a term, see CONTRIBUTING.md: the second differences of every trace.
//!
//! ```text
//! R(v) = Σ |v[t−1] − 2 v[t] + v[t+1]|
//! ```
//!
//! over the bins that have two neighbours. It favours light that rises and falls evenly. The dual ball is a box,
//! `|p| ≤ s w`.

use super::dual::{self, DualTerm};
use super::term::{Coupling, TermSpec};
use rowburst_core::Shape;

/// The term `tcurve`.
pub const TCURVE: TermSpec = TermSpec {
    coupling: Coupling::Neighbours,
    ..TermSpec::dual("tcurve", "light that rises and falls evenly", |shape| {
        Box::new(Curvature::new(shape))
    })
};

/// The second differences of a video over its bins.
#[derive(Clone)]
pub struct Curvature {
    pixels: usize,
    dual: Vec<f32>,
}

impl Curvature {
    /// The term with its dual at zero.
    pub fn new(shape: Shape) -> Self {
        Self {
            pixels: shape.pixels(),
            dual: vec![0.0; shape.bins.saturating_sub(2) * shape.pixels()],
        }
    }

    /// `K z`.
    pub fn differences(&self, z: &[f32]) -> impl Iterator<Item = f32> {
        let later = z
            .iter()
            .skip(self.pixels)
            .zip(z.iter().skip(2 * self.pixels));
        z.iter().zip(later).map(|(a, (b, c))| a - 2.0 * b + c)
    }
}

impl DualTerm for Curvature {
    fn norm_squared(&self) -> f64 {
        16.0
    }

    fn subtract_adjoint(&self, z: &mut [f32]) {
        for (factor, bin) in [(1.0, 0), (-2.0, 1), (1.0, 2)] {
            let z = z.iter_mut().skip(bin * self.pixels);
            z.zip(&self.dual).for_each(|(z, p)| *z -= factor * p);
        }
    }

    fn step(&mut self, z: &[f32], step: f32, radius: f32) -> f64 {
        let differences: Vec<f32> = self.differences(z).collect();
        for (p, d) in self.dual.iter_mut().zip(&differences) {
            *p = (*p + step * d).clamp(-radius, radius);
        }
        differences.iter().map(|d| f64::from(d.abs())).sum()
    }

    fn rescale(&mut self, factor: f32) {
        dual::scale(&mut self.dual, factor);
    }

    fn value(&self, z: &[f32]) -> f64 {
        self.differences(z).map(|d| f64::from(d.abs())).sum()
    }

    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        // The first two bins are free, and then each place where a trace bends.
        let free = z.iter().take(2 * self.pixels).filter(|z| **z > 0.0).count();
        let bends = self.differences(z).filter(|d| d.abs() > tolerance).count();
        (free + bends) as f64
    }
}
