//! Smooth functions of time and place: cosines, the modes of a free beam, and cubic B-splines on a coarse grid.

use rayon::prelude::*;
use std::f64::consts::PI;

/// Cosines over the bins, `√2 cos(πk(t + ½)/T)` and 1 for k = 0: mean square 1.
fn cosine(k: usize, bin: f64, bins: usize) -> f64 {
    if k == 0 {
        return 1.0;
    }
    2.0f64.sqrt() * (PI * k as f64 * (bin + 0.5) / bins as f64).cos()
}

/// The first `count` cosines over `bins`, `[k][t]`.
pub(super) fn cosines(count: usize, bins: usize) -> Vec<Vec<f32>> {
    let line = |k| {
        (0..bins)
            .map(|t| cosine(k, t as f64, bins) as f32)
            .collect()
    };
    (0..count).map(line).collect()
}

/// Modes of a free beam over the bins, with mean square 1: a constant, a line, then vibrations. They are the orthogonal
/// functions with the least mean square second derivative, so that a motion of constant velocity needs one of them. Before the first
/// bin and after the last they go on as lines.
pub(super) fn beam_mode(k: usize, bin: f64, bins: usize) -> f64 {
    let x = (bin + 0.5) / bins as f64 - 0.5;
    if k < 2 {
        return if k == 0 { 1.0 } else { 12.0f64.sqrt() * x };
    }
    let root = BEAM_ROOTS.get(k - 2).copied();
    let beta = root.unwrap_or((k as f64 - 0.5) * PI);
    let inside = x.clamp(-0.5, 0.5);
    let (at, end) = (beta * inside, 0.5 * beta);
    let (value, slope) = if k.is_multiple_of(2) {
        (
            at.cos() / end.cos() + at.cosh() / end.cosh(),
            at.sinh() / end.cosh() - at.sin() / end.cos(),
        )
    } else {
        (
            at.sin() / end.sin() + at.sinh() / end.sinh(),
            at.cos() / end.sin() + at.cosh() / end.sinh(),
        )
    };
    value + beta * slope * (x - inside)
}

/// Roots of `cosh(β) cos(β) = 1`; the later ones are `(k − ½)π`.
const BEAM_ROOTS: [f64; 4] = [4.730_041, 7.853_205, 10.995_608, 14.137_165];

/// Control points that a pixel depends on, and their weights.
type Taps = [(usize, f32); 4];

/// Cubic B-splines: images from control points on a coarse grid.
#[derive(Clone)]
pub(super) struct Spline {
    along_y: Vec<Taps>,
    along_x: Vec<Taps>,
    grid: (usize, usize),
}

impl Spline {
    /// Images of `rows` × `columns` pixels with a control point every `spacing` pixels, at least four along a side.
    pub fn new(rows: usize, columns: usize, spacing: f64) -> Self {
        let points = |n: usize| ((n as f64 / spacing).round() as usize).max(4);
        let grid = (points(rows), points(columns));
        Self {
            along_y: taps(rows, grid.0),
            along_x: taps(columns, grid.1),
            grid,
        }
    }

    /// Number of control points.
    pub fn points(&self) -> usize {
        self.grid.0 * self.grid.1
    }

    /// The images of several sets of control points, one after another.
    pub fn expand(&self, control: &[f32]) -> Vec<f32> {
        let (rows, columns) = (self.along_y.len(), self.along_x.len());
        let mut images = vec![0.0; control.len() / self.points() * rows * columns];
        let pairs = images.par_chunks_mut(rows * columns);
        pairs
            .zip(control.par_chunks(self.points()))
            .for_each(|(image, control)| self.expand_one(control, image));
        images
    }

    fn expand_one(&self, control: &[f32], image: &mut [f32]) {
        let (width, columns) = (self.grid.1, self.along_x.len());
        let mut line = vec![0.0f32; width];
        for (taps, out) in self.along_y.iter().zip(image.chunks_exact_mut(columns)) {
            line.fill(0.0);
            for &(at, weight) in taps {
                let control = &control[at * width..(at + 1) * width];
                line.iter_mut()
                    .zip(control)
                    .for_each(|(l, c)| *l += weight * c);
            }
            for (out, taps) in out.iter_mut().zip(&self.along_x) {
                *out = taps.iter().map(|&(at, weight)| weight * line[at]).sum();
            }
        }
    }

    /// The adjoint of [`Self::expand`].
    pub fn reduce(&self, images: &[f32]) -> Vec<f32> {
        let pixels = self.along_y.len() * self.along_x.len();
        let mut control = vec![0.0; images.len() / pixels * self.points()];
        let pairs = control.par_chunks_mut(self.points());
        pairs
            .zip(images.par_chunks(pixels))
            .for_each(|(control, image)| self.reduce_one(image, control));
        control
    }

    fn reduce_one(&self, image: &[f32], control: &mut [f32]) {
        let (width, columns) = (self.grid.1, self.along_x.len());
        let mut line = vec![0.0f32; width];
        for (taps, values) in self.along_y.iter().zip(image.chunks_exact(columns)) {
            line.fill(0.0);
            for (value, taps) in values.iter().zip(&self.along_x) {
                taps.iter()
                    .for_each(|&(at, weight)| line[at] += weight * value);
            }
            for &(at, weight) in taps {
                let control = &mut control[at * width..(at + 1) * width];
                control
                    .iter_mut()
                    .zip(&line)
                    .for_each(|(c, l)| *c += weight * l);
            }
        }
    }

    /// Calls `act(edge, at, other)` for each pair of neighbouring control points.
    pub fn for_each_edge(&self, mut act: impl FnMut(usize, usize, usize)) {
        let (rows, width) = self.grid;
        let mut edge = 0;
        for y in 0..rows {
            for x in 0..width {
                let at = y * width + x;
                let others = [(x + 1 < width, at + 1), (y + 1 < rows, at + width)];
                for (_, other) in others.into_iter().filter(|(exists, _)| *exists) {
                    act(edge, at, other);
                    edge += 1;
                }
            }
        }
    }

    /// Number of pairs of neighbouring control points.
    pub fn edges(&self) -> usize {
        let (rows, width) = self.grid;
        rows * (width - 1) + width * (rows - 1)
    }
}

/// The taps of `n` pixels on `points` control points; those beyond the edge count for the edge.
fn taps(n: usize, points: usize) -> Vec<Taps> {
    let tap = |i: usize| {
        let x = (i as f64 + 0.5) / n as f64 * points as f64 - 0.5;
        let first = x.floor() as isize - 1;
        std::array::from_fn(|k| {
            let point = first + k as isize;
            let at = point.clamp(0, points as isize - 1) as usize;
            (at, b_spline((x - point as f64).abs()) as f32)
        })
    };
    (0..n).map(tap).collect()
}

/// The cubic B-spline at distance `d`.
fn b_spline(d: f64) -> f64 {
    if d < 1.0 {
        2.0 / 3.0 - d * d + d * d * d / 2.0
    } else {
        (2.0 - d).max(0.0).powi(3) / 6.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_core::vecmath::dot;

    #[test]
    fn splines_sum_to_one_and_reduce_is_the_adjoint() {
        let spline = Spline::new(31, 22, 6.0);
        let one = spline.expand(&vec![1.0; spline.points()]);
        assert!(one.iter().all(|v| (v - 1.0).abs() < 1e-5));
        let control: Vec<f32> = (0..2 * spline.points())
            .map(|i| (i as f32 * 0.7).sin())
            .collect();
        let images: Vec<f32> = (0..2 * 31 * 22).map(|i| (i as f32 * 0.3).cos()).collect();
        let forward = dot(&spline.expand(&control), &images);
        let back = dot(&control, &spline.reduce(&images));
        assert!((forward - back).abs() < 1e-4 * forward.abs().max(1.0));
    }

    #[test]
    fn modes_of_a_beam_are_orthonormal() {
        let bins = 400;
        let modes: Vec<Vec<f64>> = (0..9)
            .map(|k| (0..bins).map(|t| beam_mode(k, t as f64, bins)).collect())
            .collect();
        for (j, a) in modes.iter().enumerate() {
            for (k, b) in modes.iter().enumerate() {
                let product: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                let expected = f64::from(u8::from(j == k));
                assert!((product / bins as f64 - expected).abs() < 1e-3, "{j} {k}");
            }
        }
    }

    #[test]
    fn modes_go_on_as_lines_beyond_the_video() {
        let bins = 54;
        for k in 0..8 {
            let at = |bin: f64| beam_mode(k, bin, bins);
            let step = |from: f64| at(from + 1.0) - at(from);
            assert!((step(60.0) - step(5000.0)).abs() < 1e-6, "{k}");
            // Value and slope at the end of the last bin.
            let (before, after) = (at(53.5) - at(53.49), at(53.51) - at(53.5));
            assert!(
                (before - after).abs() < 0.02 * after.abs() + 1e-9,
                "{k} {before} {after}"
            );
        }
    }

    #[test]
    fn each_pair_of_neighbours_is_visited_once() {
        let spline = Spline::new(30, 42, 6.0);
        let mut pairs = Vec::new();
        spline.for_each_edge(|edge, at, other| {
            assert_eq!(edge, pairs.len());
            pairs.push((at, other));
        });
        assert_eq!(pairs.len(), spline.edges());
        assert_eq!(pairs.len(), 5 * 6 + 7 * 4);
        pairs.sort_unstable();
        pairs.dedup();
        assert_eq!(pairs.len(), spline.edges());
        assert!(pairs.iter().all(|(a, b)| b - a == 1 || b - a == 7));
    }
}
