//! The prior of a motion: neighbours move alike, but for edges between things.
//!
//! ```text
//! E(θ) = W [ Σ_edges ρ(|Δθ|²) + p Σ_points ρ(|θ|²) ],   ρ(s) = 2ε² (√(1 + s/ε²) − 1),   |θ|² = Σ_k √(1 + k) (θ_ky² + θ_kx²)
//! ```
//!
//! with the differences `Δθ` of neighbouring control points, of all modes and both axes in one square (docs/design/028). Small differences cost
//! their square, as a membrane does; those of an edge, where a thing passes before another, only their size (Charbonnier). Displacements
//! are penalised by the same function, since most points rest and some move far.

use super::basis::Spline;

/// `W`, the weight of a squared difference in 1/px² on a field of 108; larger is smoother.
const WEIGHT: f64 = 20.0;
/// `ε` in pixels, the difference of an edge and the displacement of what moves; smaller allows sharper edges.
const EDGE_PX: f64 = 0.1;
/// `p`, the pull to rest; larger keeps more at rest.
const PULL: f64 = 0.2;

/// The prior of sets of control points, `[axis][mode, point]`.
pub(super) struct Smoothness {
    /// Pixels per pixel of a field of 108.
    unit: f64,
    /// `√(1 + k)` of each mode.
    weights: Vec<f64>,
}

/// Factors of the squares that give the prior's gradient at a motion.
pub(super) struct PriorFactors {
    /// Those of the differences.
    edges: Vec<f32>,
    /// Those of the displacements of the points.
    points: Vec<f32>,
}

impl Smoothness {
    /// The prior of the modes `orders`.
    pub fn new(orders: std::ops::RangeInclusive<usize>, unit: f64) -> Self {
        Self {
            unit,
            weights: orders.map(|k| (1.0 + k as f64).sqrt()).collect(),
        }
    }

    /// `|Δθ|²` of each edge, in pixels of a field of 108.
    fn squares_of_edges(&self, spline: &Spline, axes: [&[f32]; 2]) -> Vec<f64> {
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

    /// `|θ|²` of each point, in pixels of a field of 108.
    fn squares_of_points(&self, spline: &Spline, axes: [&[f32]; 2]) -> Vec<f64> {
        let mut squares = vec![0.0; spline.points()];
        for values in axes {
            let modes = values.chunks_exact(spline.points()).zip(&self.weights);
            for (values, weight) in modes {
                for (square, value) in squares.iter_mut().zip(values) {
                    *square += weight * (f64::from(*value) / self.unit).powi(2);
                }
            }
        }
        squares
    }

    /// `E(θ)`.
    pub fn energy(&self, spline: &Spline, axes: [&[f32]; 2]) -> f64 {
        let sum = |squares: Vec<f64>| -> f64 {
            let roots = squares.iter().map(|s| (1.0 + s / EDGE_PX.powi(2)).sqrt());
            2.0 * EDGE_PX.powi(2) * roots.map(|root| root - 1.0).sum::<f64>()
        };
        let points = self.squares_of_points(spline, axes);
        WEIGHT * (sum(self.squares_of_edges(spline, axes)) + PULL * sum(points))
    }

    /// The factors at a motion.
    pub fn factors(&self, spline: &Spline, axes: [&[f32]; 2]) -> PriorFactors {
        let factor = |s: &f64| (1.0 / (1.0 + s / EDGE_PX.powi(2)).sqrt()) as f32;
        let factors = |squares: Vec<f64>| squares.iter().map(factor).collect();
        PriorFactors {
            edges: factors(self.squares_of_edges(spline, axes)),
            points: factors(self.squares_of_points(spline, axes)),
        }
    }

    /// Adds `H d` to `out` for one axis, with the positive `H` whose `H θ` is half the gradient of `E` at the motion of
    /// `factors`.
    pub fn add_product(
        &self,
        spline: &Spline,
        factors: &PriorFactors,
        values: &[f32],
        out: &mut [f32],
    ) {
        let points = spline.points();
        let modes = values
            .chunks_exact(points)
            .zip(out.chunks_exact_mut(points));
        for ((values, out), mode) in modes.zip(&self.weights) {
            let weight = (WEIGHT * mode / self.unit.powi(2)) as f32;
            let rest = out.iter_mut().zip(values).zip(&factors.points);
            rest.for_each(|((out, value), factor)| *out += PULL as f32 * weight * factor * value);
            spline.for_each_edge(|edge, at, other| {
                let change = weight * factors.edges[edge] * (values[other] - values[at]);
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
            prior.energy(&spline, [&values, &rest])
        };
        assert!((energy(20.0) / energy(10.0) - 2.0).abs() < 0.05);
        assert!((energy(0.02) / energy(0.01) - 4.0).abs() < 0.05);
    }
}
