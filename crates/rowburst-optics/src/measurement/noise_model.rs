//! How the noise of a pixel follows its light.

/// Shot, read and rounding noise of every pixel of a measurement:
/// `variance = slope·light + dark_variance`, light and noise in counts.
///
/// With the weights of the light that a model expects, `½‖W(b − A v)‖²` has the gradient of
/// the likelihood of a Poisson count with the floor's variance added to it (shifted Poisson;
/// Snyder, Hammoud & White 1993): `Aᵀ(b − A v)/(slope·A v + dark_variance)`. Following the light
/// is Fisher scoring of that likelihood (iteratively reweighted least squares).
#[derive(Debug, Clone, PartialEq)]
pub struct NoiseModel {
    slope: Vec<f32>,
    dark_variance: Vec<f32>,
    reference: f64,
}

impl NoiseModel {
    /// The law of pixels with these slopes (counts) and floors (counts²); a floor that is
    /// infinite is that of a pixel without information. The noise that `light` has in the
    /// median is that of weight 1.
    ///
    /// # Panics
    /// If the lengths differ.
    pub fn new(slope: Vec<f32>, dark_variance: Vec<f32>, light: &[f32]) -> Self {
        assert_eq!(slope.len(), dark_variance.len(), "a floor for each slope");
        let mut model = Self {
            slope,
            dark_variance,
            reference: 1.0,
        };
        let mut known: Vec<f64> = model
            .variances(light)
            .filter(|variance| variance.is_finite())
            .collect();
        if !known.is_empty() {
            let middle = known.len() / 2;
            model.reference = known
                .select_nth_unstable_by(middle, f64::total_cmp)
                .1
                .sqrt();
        }
        model
    }

    /// The law of some of the pixels, with the same reference.
    pub(super) fn picked(&self, pick: impl Fn(&[f32]) -> Vec<f32>) -> Self {
        Self {
            slope: pick(&self.slope),
            dark_variance: pick(&self.dark_variance),
            reference: self.reference,
        }
    }

    /// The same law with the pixels of `is_excluded` without information.
    pub(super) fn without(&self, is_excluded: &[bool]) -> Self {
        let mut model = self.clone();
        let floors = model.dark_variance.iter_mut().zip(is_excluded);
        floors
            .filter(|(_, excluded)| **excluded)
            .for_each(|(floor, _)| *floor = f32::INFINITY);
        model
    }

    /// The law of the light `(counts − offset)/gain`.
    pub(super) fn adjusted(&self, gain: &[f32], offset: &[f32]) -> Self {
        let mut model = self.clone();
        let slopes = model.slope.iter_mut().zip(&mut model.dark_variance);
        for ((slope, variance), (g, o)) in slopes.zip(gain.iter().zip(offset)) {
            *variance = (*variance + *slope * o).max(0.0) / (g * g);
            *slope /= g;
        }
        model
    }

    /// Standard deviation of a pixel with weight 1, in counts.
    pub fn sigma(&self) -> f64 {
        self.reference
    }

    /// `σ_ref/σ` of every pixel that expects `light` counts, 0 without information.
    ///
    /// # Panics
    /// If the length is not that of the law.
    pub fn weights(&self, light: &[f32]) -> Vec<f32> {
        self.variances(light)
            .map(|variance| (self.reference / variance.sqrt()) as f32)
            .collect()
    }

    /// A pixel that expects less than one electron has the noise of one: the slope is the
    /// counts of an electron.
    fn variances<'a>(&'a self, light: &'a [f32]) -> impl Iterator<Item = f64> + 'a {
        assert_eq!(light.len(), self.slope.len(), "light of every pixel");
        let laws = self.slope.iter().zip(&self.dark_variance);
        laws.zip(light).map(|((&slope, &dark_variance), &light)| {
            f64::from(slope) * f64::from(light.max(slope)) + f64::from(dark_variance)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variance_is_that_of_electrons() {
        // Half a count for an electron, 3 electrons of read noise.
        let model = NoiseModel::new(
            vec![0.5; 3],
            vec![2.25, 2.25, f32::INFINITY],
            &[8.0, 8.0, 8.0],
        );
        // 16 electrons and 9 electrons².
        assert!((model.sigma() - 0.5 * 25f64.sqrt()).abs() < 1e-6);
        let weights = model.weights(&[8.0, -1.0, 8.0]);
        assert!((weights[0] - 1.0).abs() < 1e-6);
        assert!((f64::from(weights[1]) - 2.5 / (0.5 * 10f64.sqrt())).abs() < 1e-6);
        assert_eq!(weights[2], 0.0);
    }
}
