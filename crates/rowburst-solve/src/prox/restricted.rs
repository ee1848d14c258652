//! A prior whose videos are zero outside a fixed set of voxels.

use super::Prox;
use rowburst_core::Support;

/// A prior with the constraint that videos are zero outside a set of voxels, whatever support a solver chooses.
#[derive(Clone)]
pub struct Restricted {
    prior: Box<dyn Prox>,
    allowed: Support,
}

impl Restricted {
    /// `prior`, for videos that are zero outside `allowed`.
    pub fn new(mut prior: Box<dyn Prox>, allowed: Support) -> Self {
        prior.restrict(&allowed);
        Self { prior, allowed }
    }
}

impl Prox for Restricted {
    fn prox(&mut self, q: &[f32], scale: f64, z: &mut [f32]) {
        self.prior.prox(q, scale, z);
    }

    fn value(&self, z: &[f32]) -> f64 {
        self.prior.value(z)
    }

    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        self.prior.degrees_of_freedom(z, tolerance)
    }

    fn restrict(&mut self, support: &Support) {
        self.prior.restrict(&support.intersect(&self.allowed));
    }

    fn set_refined(&mut self, is_refined: bool) {
        self.prior.set_refined(is_refined);
    }

    fn subtract_dual(&self, v: &mut [f32]) {
        self.prior.subtract_dual(v);
        // The prior is infinite for videos with light outside, so any dual point is valid there.
        self.allowed.zero_outside(v);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prox::{Variation, VariationWeights};
    use rowburst_core::Shape;

    fn tv(shape: Shape) -> Box<dyn Prox> {
        let weights = VariationWeights {
            space: 1.0,
            time: 0.5,
            l1: 0.0,
        };
        Box::new(Variation::new(shape, weights))
    }

    /// Light stays inside the allowed voxels, whatever support a solver chooses, and the dual point says so.
    #[test]
    fn light_stays_inside() {
        let shape = Shape::new(2, 3, 4);
        let mask: Vec<u8> = (0..24).map(|i| u8::from(i % 3 != 0)).collect();
        let mut prior = Restricted::new(tv(shape), Support::from_mask(mask.clone(), shape));
        let q: Vec<f32> = (0..24).map(|i| 1.0 + (i % 5) as f32).collect();
        let mut z = vec![f32::NAN; 24];
        for support in [None, Some(Support::full(shape))] {
            if let Some(support) = support {
                prior.restrict(&support);
            }
            prior.prox(&q, 0.1, &mut z);
            for (v, allowed) in z.iter().zip(&mask) {
                assert_eq!(*v > 0.0, *allowed == 1, "{z:?}");
            }
        }
        let mut dual = q.clone();
        prior.subtract_dual(&mut dual);
        assert!(
            dual.iter()
                .zip(&mask)
                .all(|(d, allowed)| *allowed == 1 || *d == 0.0)
        );
        let mut free = tv(shape);
        assert_eq!(prior.value(&z), free.value(&z));
        free.prox(&q, 0.1, &mut z);
        assert!(z.iter().all(|v| *v > 0.0));
    }
}
