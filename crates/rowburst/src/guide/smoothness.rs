//! The prior of a motion: neighbours move alike, but for edges between things.
//!
//! ```text
//! E(θ) = W [ 2ε² Σ_edges (√(1 + |Δθ|²/ε²) − 1) + p Σ_points |θ|² ],   |θ|² = Σ_k √(1 + k) (θ_ky² + θ_kx²)
//! ```
//!
//! with the differences `Δθ` of neighbouring control points, of all modes and both axes in one square (docs/design/028). Small differences cost
//! their square, as a membrane does; those of an edge, where a thing passes before another, only their size (Charbonnier).

use super::basis::Spline;

/// `W`, the weight of a squared difference in 1/px² on a field of 108; larger is smoother.
const WEIGHT: f64 = 20.0;
/// `ε`, the difference of an edge in pixels; smaller allows sharper edges.
const EDGE_PX: f64 = 0.1;
/// `p`, the pull to rest.
const PULL: f64 = 0.001;

/// The prior of sets of control points, `[axis][mode, point]`.
pub(super) struct Smoothness {
    /// Pixels per pixel of a field of 108.
    unit: f64,
    /// `√(1 + k)` of each mode.
    weights: Vec<f64>,
}

/// Factors of the squared differences that give the prior's gradient at a motion.
pub(super) struct EdgeFactors(Vec<f32>);

impl Smoothness {
    /// The prior of the modes `orders`.
    pub fn new(orders: std::ops::RangeInclusive<usize>, unit: f64) -> Self {
        Self {
            unit,
            weights: orders.map(|k| (1.0 + k as f64).sqrt()).collect(),
        }
    }

    /// `|Δθ|²` of each edge, in pixels of a field of 108.
    fn squares(&self, spline: &Spline, axes: [&[f32]; 2]) -> Vec<f64> {
        let mut squares = vec![0.0; spline.edges()];
        for values in axes {
            let modes = values.chunks_exact(spline.points()).zip(&self.weights);
            for (values, weight) in modes {
                spline.for_each_edge(|edge, at, other| {
                    let difference = f64::from(values[other] - values[at]) / self.unit;
                    squares[edge] += weight * difference * difference;
                });
            }
        }
        squares
    }

    /// `E(θ)`.
    pub fn energy(&self, spline: &Spline, axes: [&[f32]; 2]) -> f64 {
        let squares = self.squares(spline, axes);
        let edges: f64 = squares
            .iter()
            .map(|s| (1.0 + s / EDGE_PX.powi(2)).sqrt() - 1.0)
            .sum();
        let mut rest = 0.0;
        for values in axes {
            for (values, weight) in values.chunks_exact(spline.points()).zip(&self.weights) {
                let sum: f64 = values.iter().map(|v| f64::from(*v).powi(2)).sum();
                rest += weight * sum / self.unit.powi(2);
            }
        }
        WEIGHT * (2.0 * EDGE_PX.powi(2) * edges + PULL * rest)
    }

    /// The factors at a motion.
    pub fn factors(&self, spline: &Spline, axes: [&[f32]; 2]) -> EdgeFactors {
        let squares = self.squares(spline, axes);
        let factor = |s: &f64| (1.0 / (1.0 + s / EDGE_PX.powi(2)).sqrt()) as f32;
        EdgeFactors(squares.iter().map(factor).collect())
    }

    /// Adds `H d` to `out` for one axis, with the positive `H` whose `H θ` is half the gradient of `E` at the motion of
    /// `factors`.
    pub fn add_product(
        &self,
        spline: &Spline,
        factors: &EdgeFactors,
        values: &[f32],
        out: &mut [f32],
    ) {
        let points = spline.points();
        let modes = values
            .chunks_exact(points)
            .zip(out.chunks_exact_mut(points));
        for ((values, out), mode) in modes.zip(&self.weights) {
            let weight = WEIGHT * mode / self.unit.powi(2);
            let pull = (PULL * weight) as f32;
            let weight = weight as f32;
            for (out, value) in out.iter_mut().zip(values) {
                *out += pull * value;
            }
            spline.for_each_edge(|edge, at, other| {
                let change = weight * factors.0[edge] * (values[other] - values[at]);
                out[at] -= change;
                out[other] += change;
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ripple(length: usize, step: f32) -> Vec<f32> {
        (0..length).map(|i| 0.3 * (i as f32 * step).sin()).collect()
    }

    #[test]
    fn the_product_is_half_the_gradient_of_the_energy() {
        let spline = Spline::new(30, 42, 6.0);
        let prior = Smoothness::new(1..=2, 1.5);
        let (y, x) = (
            ripple(2 * spline.points(), 0.7),
            ripple(2 * spline.points(), 1.3),
        );
        let direction = ripple(y.len(), 2.1);
        let mut product = vec![0.0; y.len()];
        let factors = prior.factors(&spline, [&y, &x]);
        prior.add_product(&spline, &factors, &y, &mut product);
        let moved = |step: f32| -> f64 {
            let y: Vec<f32> = y
                .iter()
                .zip(&direction)
                .map(|(v, d)| v + step * d)
                .collect();
            prior.energy(&spline, [&y, &x])
        };
        let slope = (moved(0.01) - moved(-0.01)) / 0.02;
        let expected = 2.0 * rowburst_core::vecmath::dot(&product, &direction);
        assert!((slope / expected - 1.0).abs() < 1e-2, "{slope} {expected}");
    }

    #[test]
    fn an_edge_costs_its_size_and_a_ripple_its_square() {
        let spline = Spline::new(60, 60, 6.0);
        let prior = Smoothness::new(0..=0, 1.0);
        let rest = vec![0.0; spline.points()];
        let energy = |height: f32| {
            let step = |i: usize| if i % 10 < 5 { 0.0 } else { height };
            let values: Vec<f32> = (0..spline.points()).map(step).collect();
            // Without the pull to rest.
            let pull = WEIGHT * PULL * 50.0 * f64::from(height).powi(2);
            prior.energy(&spline, [&values, &rest]) - pull
        };
        assert!((energy(20.0) / energy(10.0) - 2.0).abs() < 0.05);
        assert!((energy(0.02) / energy(0.01) - 4.0).abs() < 0.05);
    }
}
