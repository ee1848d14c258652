//! The smooth mean intensity under a speckle pattern.
//!
//! A diffuser's envelope is close to a Gaussian, so its logarithm is modelled as a
//! quadratic in `y` and `x`. Means of speckle over a cell are gamma distributed, with a
//! spread in proportion to the mean: the likelihood is maximised by iterated least
//! squares (gamma regression with a logarithmic link), where a cell brighter than
//! [`MAX_RATIO`] times the model counts as [`MAX_RATIO`], so that a bright spot does not lift it.
//! What a quadratic cannot follow (a flat top, a vignette) is a smooth factor on top.

use super::filter::smoothed;
use rowburst_core::vecmath::solve_normal;
use rowburst_optics::Image;

/// A cell's ratio to the model above which it counts as this: means over nine grains
/// of speckle pass it once in a thousand cells.
const MAX_RATIO: f64 = 2.5;

/// Floor of the model against its maximum: ratios to less than this are noise.
const MIN_RELATIVE_ENVELOPE: f64 = 1e-3;

/// Means over square cells, a log-quadratic model of them, and what is left.
pub(super) struct Envelope {
    cell: usize,
    rows: usize,
    columns: usize,
    means: Vec<f64>,
    coefficients: [f64; 6],
    size: (usize, usize),
}

impl Envelope {
    /// Of the non-negative `light` with speckle of `grain` pixels.
    pub fn fit(light: &Image, grain: f64) -> Self {
        let size = (light.rows(), light.columns());
        let cell = (3.0 * grain).round() as usize;
        let cell = cell.clamp(1, (size.0.min(size.1) / 6).max(1));
        let binned = light.binned(cell);
        let mut envelope = Self {
            cell,
            rows: binned.rows(),
            columns: binned.columns(),
            means: binned.data().iter().map(|&p| f64::from(p)).collect(),
            coefficients: [0.0; 6],
            size,
        };
        envelope.regress();
        envelope
    }

    /// Position of a pixel in units of half the image from its middle.
    fn place(&self, y: f64, x: f64) -> (f64, f64) {
        (
            (2.0 * y + 1.0) / self.size.0 as f64 - 1.0,
            (2.0 * x + 1.0) / self.size.1 as f64 - 1.0,
        )
    }

    fn terms(&self, y: f64, x: f64) -> [f64; 6] {
        let (v, u) = self.place(y, x);
        [1.0, v, u, v * v, v * u, u * u]
    }

    fn middle(&self, i: usize) -> f64 {
        (i * self.cell) as f64 + (self.cell - 1) as f64 / 2.0
    }

    fn regress(&mut self) {
        let cells: Vec<[f64; 6]> = (0..self.means.len())
            .map(|i| self.terms(self.middle(i / self.columns), self.middle(i % self.columns)))
            .collect();
        let mean = self.means.iter().sum::<f64>() / self.means.len() as f64;
        self.coefficients[0] = mean.max(f64::MIN_POSITIVE).ln();
        for _ in 0..60 {
            let (mut normal, mut slope) = ([[0.0; 6]; 6], [0.0; 6]);
            for (terms, &mean) in cells.iter().zip(&self.means) {
                let error = (mean / dot(&self.coefficients, terms).exp()).min(MAX_RATIO) - 1.0;
                for (i, row) in normal.iter_mut().enumerate() {
                    for j in 0..6 {
                        row[j] += terms[i] * terms[j];
                    }
                    slope[i] += terms[i] * error;
                }
            }
            // A grid of fewer than three cells along a side leaves a term open.
            for (i, row) in normal.iter_mut().enumerate() {
                row[i] += 1e-6 * cells.len() as f64;
            }
            let Some(step) = solve_normal(&normal, &slope) else {
                break;
            };
            let largest = step.iter().fold(0.0f64, |m, s| m.max(s.abs()));
            let damping = (0.5 / largest.max(1e-300)).min(1.0);
            for (c, s) in self.coefficients.iter_mut().zip(step) {
                *c += damping * s;
            }
            if largest < 1e-6 {
                break;
            }
        }
    }

    /// The model at every pixel.
    pub fn quadratic(&self) -> Image {
        let image = Image::from_fn(self.size.0, self.size.1, |y, x| {
            dot(&self.coefficients, &self.terms(y as f64, x as f64))
                .clamp(-80.0, 80.0)
                .exp() as f32
        });
        let least = MIN_RELATIVE_ENVELOPE as f32 * image.max();
        let mut image = image;
        image.data_mut().iter_mut().for_each(|p| *p = p.max(least));
        image
    }

    /// The model times the smooth rest at every pixel, both without the light within
    /// `radius` of a place `(y, x, radius)`.
    pub fn without(&mut self, core: Option<(f64, f64, f64)>) -> Image {
        let outside = |y: f64, x: f64| match core {
            Some((cy, cx, radius)) => (y - cy).hypot(x - cx) > radius + self.cell as f64,
            None => true,
        };
        let model = self.quadratic();
        let mut ratio = Image::zeros(self.rows, self.columns);
        let mut kept = Image::zeros(self.rows, self.columns);
        for i in 0..self.means.len() {
            let (y, x) = (self.middle(i / self.columns), self.middle(i % self.columns));
            if outside(y, x) {
                let at = f64::from(model.at(y as usize, x as usize));
                ratio.data_mut()[i] = (self.means[i] / at).min(MAX_RATIO) as f32;
                kept.data_mut()[i] = 1.0;
            }
        }
        let sigma = self.rows.min(self.columns) as f64 / 8.0;
        let (ratio, kept) = (smoothed(&ratio, sigma), smoothed(&kept, sigma));
        let rest = Image::from_fn(self.rows, self.columns, |y, x| {
            if kept.at(y, x) > 0.05 {
                ratio.at(y, x) / kept.at(y, x)
            } else {
                1.0
            }
        });
        Image::from_fn(self.size.0, self.size.1, |y, x| {
            model.at(y, x) * self.between(&rest, y, x)
        })
    }

    /// Bilinear interpolation of a value per cell.
    fn between(&self, cells: &Image, y: usize, x: usize) -> f32 {
        let part = |at: usize, count: usize| {
            let p = (at as f64 - self.middle(0)) / self.cell as f64;
            let p = p.clamp(0.0, (count - 1) as f64);
            let i = (p as usize).min(count.saturating_sub(2));
            (i, (i + 1).min(count - 1), (p - i as f64) as f32)
        };
        let (y0, y1, v) = part(y, self.rows);
        let (x0, x1, u) = part(x, self.columns);
        let top = cells.at(y0, x0) * (1.0 - u) + cells.at(y0, x1) * u;
        let bottom = cells.at(y1, x0) * (1.0 - u) + cells.at(y1, x1) * u;
        top * (1.0 - v) + bottom * v
    }
}

/// The local mean of `light` over [`LOCAL_GRAINS`] grains, free of the broadening that
/// plain smoothing gives a narrow envelope.
pub(super) fn local_mean(light: &Image, grain: f64) -> Image {
    let model = Envelope::fit(light, grain).quadratic();
    let ratio = Image::from_fn(light.rows(), light.columns(), |y, x| {
        light.at(y, x) / model.at(y, x)
    });
    let sigma = (LOCAL_GRAINS * grain).min(light.rows().min(light.columns()) as f64 / 6.0);
    let ratio = smoothed(&ratio, sigma);
    Image::from_fn(light.rows(), light.columns(), |y, x| {
        ratio.at(y, x) * model.at(y, x)
    })
}

/// Wide enough that the mean over the window holds over a thousand grains and takes none
/// of their contrast away, narrow enough to follow an envelope and a ballistic core.
const LOCAL_GRAINS: f64 = 12.0;

fn dot(a: &[f64; 6], b: &[f64; 6]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
