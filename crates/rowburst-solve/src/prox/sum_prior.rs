//! The prior of a video that is a sum of two components, each with its own prior.
//!
//! ```text
//! R(v) = min { R_1(s) + R_2(l) : s + E l = v,  s, l ≥ 0 }
//! ```
//!
//! This is the infimal convolution of `R_1` and `R_2`. The component `s` moves before a background `l`. The
//! background is static (`E` shows one picture in all bins) or has low rank (`E` is the identity; `L + S`: Candès,
//! Li, Ma & Wright 2011; Otazo, Candès & Sodickson 2015). The unknown is the vector `[s, l]` of
//! [`rowburst_core::linop::WithBackground`]; the prox acts on each component by itself.
//!
//! The support restricts the component `s` alone.

use super::Prox;
use rowburst_core::Support;

/// `R_1(s) + R_2(l)` over vectors `[s, l]`.
#[derive(Clone)]
pub struct SumPrior {
    first: Box<dyn Prox>,
    second: Box<dyn Prox>,
    /// Length of `s`.
    length: usize,
}

impl SumPrior {
    /// `first(s) + second(l)` for an `s` of `length` elements.
    pub fn new(length: usize, first: Box<dyn Prox>, second: Box<dyn Prox>) -> Self {
        Self {
            first,
            second,
            length,
        }
    }
}

impl Prox for SumPrior {
    fn prox(&mut self, q: &[f32], scale: f64, z: &mut [f32]) {
        let (q_first, q_second) = q.split_at(self.length);
        let (z_first, z_second) = z.split_at_mut(self.length);
        self.first.prox(q_first, scale, z_first);
        self.second.prox(q_second, scale, z_second);
    }

    fn value(&self, z: &[f32]) -> f64 {
        let (first, second) = z.split_at(self.length);
        self.first.value(first) + self.second.value(second)
    }

    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        let (first, second) = z.split_at(self.length);
        self.first.degrees_of_freedom(first, tolerance)
            + self.second.degrees_of_freedom(second, tolerance)
    }

    fn restrict(&mut self, support: &Support) {
        self.first.restrict(support);
    }

    fn set_refined(&mut self, is_refined: bool) {
        self.first.set_refined(is_refined);
        self.second.set_refined(is_refined);
    }

    fn subtract_dual(&self, v: &mut [f32]) {
        let (first, second) = v.split_at_mut(self.length);
        self.first.subtract_dual(first);
        self.second.subtract_dual(second);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prox::{Variation, VariationWeights};
    use rowburst_core::Shape;

    /// ℓ1 with weights 1 and 3: each component is shrunk by its own weight.
    #[test]
    fn each_component_has_its_prior() {
        let l1 = |shape, weight| -> Box<dyn Prox> {
            let weights = VariationWeights {
                space: 0.0,
                time: 0.0,
                l1: weight,
            };
            Box::new(Variation::new(shape, weights))
        };
        let first = l1(Shape::new(2, 1, 2), 1.0);
        let mut prox = SumPrior::new(4, first, l1(Shape::new(1, 1, 2), 3.0));
        let mut z = [f32::NAN; 6];
        prox.prox(&[1.0, 0.05, -1.0, 2.0, 1.0, 0.2], 0.1, &mut z);
        for (z, expected) in z.iter().zip([0.9, 0.0, 0.0, 1.9, 0.7, 0.0]) {
            assert!((z - expected).abs() < 1e-6);
        }
        assert!((prox.value(&z) - (2.8 + 3.0 * 0.7)).abs() < 1e-6);
        assert_eq!(prox.degrees_of_freedom(&z, 1e-3), 3.0);
        let mut over = [0.2f32, 0.1, 0.0, 0.05, 0.4, 0.3];
        prox.subtract_dual(&mut over);
        for (over, expected) in over.iter().zip([0.1, 0.0, -0.1, -0.05, 0.1, 0.0]) {
            assert!((over - expected).abs() < 1e-6);
        }
    }
}
