//! The affine map from the field to a guide, and its first estimate by registration on a coarse picture of the scene.

use super::least_squares::project;
use super::picture::{self, GuideSample};
use rayon::prelude::*;
use rowburst_core::Shape;
use rowburst_core::vecmath::{dot, solve_normal};
use rowburst_optics::Image;

/// The guide's place of a field pixel, `x + d(x)` with `d_y = p₀ + p₁ η + p₂ ξ`, `d_x = p₃ + p₄ η + p₅ ξ` in pixels of the
/// field. `η` and `ξ` are the distances from the field's centre along y and x over half its longer side.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Affine {
    /// `p₀ … p₅` in pixels.
    pub parameters: [f64; 6],
}

impl Affine {
    /// Shift along y and x at the centre, in pixels of the field.
    pub fn shift_px(&self) -> (f64, f64) {
        (self.parameters[0], self.parameters[3])
    }

    /// Angle by which the map turns, in degrees; `half_side` is half of the field's longer side in pixels.
    pub fn rotation_deg(&self, half_side: f64) -> f64 {
        let p = &self.parameters;
        (0.5 * (p[2] - p[4]) / half_side).atan().to_degrees()
    }

    /// How far the map is from the identity: the largest part of the allowed shift, turn or change of size.
    pub(super) fn deviation(&self, half_side: f64) -> f64 {
        let p = self.parameters;
        let shift = p[0].hypot(p[3]) / half_side / MAX_SHIFT;
        let linear = [p[1], p[5], p[2], p[4]].map(|v| v.abs() / half_side / MAX_LINEAR);
        linear.into_iter().fold(shift, f64::max)
    }

    /// Magnification of the map: above 1 where the guide shows the scene larger than assumed.
    pub fn magnification(&self, half_side: f64) -> f64 {
        let p = &self.parameters;
        1.0 + 0.5 * (p[1] + p[5]) / half_side
    }
}

/// Largest shift over half the longer side, and largest turn in radians or change of size, of a guide that belongs to the
/// frame; larger keeps pictures of another magnification.
const MAX_SHIFT: f64 = 0.3;
const MAX_LINEAR: f64 = 0.12;

/// Coordinates of the field.
#[derive(Debug, Clone, Copy)]
pub(super) struct Field {
    pub rows: usize,
    pub columns: usize,
}

impl Field {
    /// Those of the pictures of a video.
    pub fn of(shape: Shape) -> Self {
        Self {
            rows: shape.rows,
            columns: shape.columns,
        }
    }

    /// Half of the longer side.
    pub fn half_side(self) -> f64 {
        0.5 * self.rows.max(self.columns) as f64
    }

    /// `(η, ξ)` of the pixel `i`.
    pub fn place(self, i: usize) -> (f32, f32) {
        let of =
            |at: usize, n: usize| ((at as f64 - 0.5 * (n as f64 - 1.0)) / self.half_side()) as f32;
        (
            of(i / self.columns, self.rows),
            of(i % self.columns, self.columns),
        )
    }

    /// Displacement of a place along y and x.
    pub fn displacement_at(self, affine: &Affine, y: f32, x: f32) -> [f32; 2] {
        let of = |at: f32, n: usize| (at - 0.5 * (n as f32 - 1.0)) / self.half_side() as f32;
        let (eta, xi) = (of(y, self.rows), of(x, self.columns));
        let p = affine.parameters.map(|p| p as f32);
        [p[0] + p[1] * eta + p[2] * xi, p[3] + p[4] * eta + p[5] * xi]
    }

    /// Displacement of every pixel along y and x.
    pub fn displacement(self, affine: &Affine) -> (Vec<f32>, Vec<f32>) {
        let pixels = 0..self.rows * self.columns;
        pixels
            .map(|i| {
                let (y, x) = (i / self.columns, i % self.columns);
                let [dy, dx] = self.displacement_at(affine, y as f32, x as f32);
                (dy, dx)
            })
            .unzip()
    }

    /// What the voxel `v` of a video of this field takes of a guide at rest.
    pub fn sample(self, map: &Affine, v: usize) -> GuideSample {
        let p = v % (self.rows * self.columns);
        let (y, x) = ((p / self.columns) as f32, (p % self.columns) as f32);
        let [dy, dx] = self.displacement_at(map, y, x);
        GuideSample {
            at: [y + dy, x + dx],
            weight: 1.0,
        }
    }

    /// The guide seen from the field.
    pub fn warp(self, guide: &Image, affine: &Affine) -> Image {
        let (dy, dx) = self.displacement(affine);
        Image::from_fn(self.rows, self.columns, |y, x| {
            let i = y * self.columns + x;
            picture::at(guide, y as f32 + dy[i], x as f32 + dx[i]).0
        })
    }
}

/// Largest shift of the search in pixels of a field of 108, and its step; larger finds worse starts and takes time.
const SEARCH_SHIFT_PX: f64 = 8.0;
const SEARCH_STEP_PX: f64 = 2.0;
/// Turns and changes of magnification of the search, over half the longer side.
const SEARCH_LINEAR: [f64; 3] = [-0.03, 0.0, 0.03];
/// Blurs of the refinement in pixels of a field of 108.
const BLURS_PX: [f64; 3] = [3.0, 2.0, 1.2];
/// Gauss–Newton steps at each blur.
const STEPS: usize = 6;
/// Standard deviations of a shift, and of the other parameters, in pixels of a field of 108: the prior of the refinement.
const SHIFT_PX: f64 = 4.0;
const LINEAR_PX: f64 = 2.0;

/// The affine map under which `guide` resembles `coarse`, a coarse picture of the scene, most, with the correlation of the
/// two. The map is near the identity.
pub(super) fn register(coarse: &Image, guide: &Image) -> (Affine, f64) {
    let field = Field {
        rows: coarse.rows(),
        columns: coarse.columns(),
    };
    let unit = field.half_side() / 54.0;
    let mut best = search(field, coarse, guide);
    for blur in BLURS_PX {
        let (from, to) = (guide.blurred(blur * unit), coarse.blurred(blur * unit));
        for _ in 0..STEPS {
            let next = step(field, &to, &from, &best, unit);
            let is_better = correlation(&to, &field.warp(&from, &next))
                > correlation(&to, &field.warp(&from, &best));
            if !is_better {
                break;
            }
            best = next;
        }
    }
    let blur = BLURS_PX[2] * unit;
    let warped = field.warp(&guide.blurred(blur), &best);
    (best, correlation(&coarse.blurred(blur), &warped))
}

/// The best of a grid of shifts, turns and magnifications, on pictures of half the resolution.
fn search(full: Field, coarse: &Image, guide: &Image) -> Affine {
    let (rows, columns) = (full.rows.div_ceil(2), full.columns.div_ceil(2));
    let field = Field { rows, columns };
    let half = field.half_side();
    let unit = half / 54.0;
    let blurred = |picture| picture::on_grid(picture, rows, columns).blurred(BLURS_PX[0] * unit);
    let (from, to) = (blurred(guide), blurred(coarse));
    let reach = (SEARCH_SHIFT_PX / SEARCH_STEP_PX) as i32;
    let shift = |k: i32| f64::from(k) * SEARCH_STEP_PX * unit;
    let mut maps = Vec::new();
    for turn in SEARCH_LINEAR.map(|turn| turn * half) {
        for grow in SEARCH_LINEAR.map(|grow| grow * half) {
            for (i, j) in (-reach..=reach).flat_map(|i| (-reach..=reach).map(move |j| (i, j))) {
                let parameters = [shift(i), grow, turn, shift(j), -turn, grow];
                maps.push(Affine { parameters });
            }
        }
    }
    let score = |map: &Affine| correlation(&to, &field.warp(&from, map));
    let scores: Vec<f64> = maps.par_iter().map(score).collect();
    let best = (0..maps.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b]));
    let parameters = maps[best.expect("a grid of maps")].parameters;
    let scale = full.half_side() / half;
    Affine {
        parameters: parameters.map(|p| p * scale),
    }
}

/// A Gauss–Newton step of `Σ (α G(x + d) + γ − m)²` with the prior.
fn step(field: Field, to: &Image, from: &Image, affine: &Affine, unit: f64) -> Affine {
    let (dy, dx) = field.displacement(affine);
    let pixels = to.data().len();
    let (mut values, mut along_y, mut along_x) =
        (vec![0.0; pixels], vec![0.0; pixels], vec![0.0; pixels]);
    for i in 0..pixels {
        let (y, x) = ((i / field.columns) as f32, (i % field.columns) as f32);
        (values[i], along_y[i], along_x[i]) = picture::at(from, y + dy[i], x + dx[i]);
    }
    let one = vec![1.0; pixels];
    let fit = project(&[&values, &one], to.data());
    let residual: Vec<f32> = (0..pixels)
        .map(|i| to.data()[i] - (fit[0] * f64::from(values[i]) + fit[1]) as f32)
        .collect();
    let gain = fit[0] as f32;
    let columns: Vec<Vec<f32>> = (0..6)
        .map(|k| {
            let gradient = if k < 3 { &along_y } else { &along_x };
            let factor = |i: usize| {
                let (eta, xi) = field.place(i);
                [1.0, eta, xi][k % 3]
            };
            (0..pixels)
                .map(|i| gain * gradient[i] * factor(i))
                .collect()
        })
        .chain([values.clone(), one.clone()])
        .collect();
    let mut gram: Vec<Vec<f64>> = columns
        .iter()
        .map(|a| columns.iter().map(|b| dot(a, b)).collect())
        .collect();
    let mut rhs: Vec<f64> = columns.iter().map(|a| dot(a, &residual)).collect();
    let power = dot(&residual, &residual) / (pixels as f64).sqrt();
    for k in 0..6 {
        let width = if k % 3 == 0 { SHIFT_PX } else { LINEAR_PX };
        let weight = power / (width * unit).powi(2);
        gram[k][k] += weight;
        rhs[k] -= weight * affine.parameters[k];
    }
    let Some(found) = solve_normal(&gram, &rhs) else {
        return *affine;
    };
    let mut next = *affine;
    for (p, d) in next.parameters.iter_mut().zip(found) {
        *p += d.clamp(-3.0 * unit, 3.0 * unit);
    }
    next
}

/// Correlation coefficient of two pictures.
pub(super) fn correlation(a: &Image, b: &Image) -> f64 {
    let n = a.data().len() as f64;
    let mean = |image: &Image| image.data().iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    let (ma, mb) = (mean(a), mean(b));
    let covariance = dot(a.data(), b.data()) - n * ma * mb;
    let variance = |image: &Image, m: f64| dot(image.data(), image.data()) - n * m * m;
    covariance
        / (variance(a, ma) * variance(b, mb))
            .sqrt()
            .max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_simulate::scene::{DenseScene, dense};

    #[test]
    fn a_shifted_turned_and_larger_picture_is_registered() {
        let video = dense(DenseScene::Still, Shape::new(1, 108, 108), 5).unwrap();
        let picture = Image::new(108, 108, video.into_data()).unwrap();
        let field = Field {
            rows: 108,
            columns: 108,
        };
        // 3 px down, 4 px left, 2° and 2 %.
        let parameters = [3.0, 1.08, 1.88, -4.0, -1.88, 1.08];
        let truth = Affine { parameters };
        let scene = field.warp(&picture, &truth);
        let (found, score) = register(&scene.blurred(2.0), &picture);
        assert!(score > 0.98);
        assert!((found.rotation_deg(54.0) - 2.0).abs() < 0.1);
        assert!((found.magnification(54.0) - 1.02).abs() < 0.003);
        let (dy, dx) = field.displacement(&truth);
        let (fy, fx) = field.displacement(&found);
        let worst = (0..dy.len()).map(|i| (dy[i] - fy[i]).hypot(dx[i] - fx[i]));
        assert!(worst.fold(0.0, f32::max) < 0.6);
    }
}
