//! A margin of pixels around a guide, fitted to the frame. It covers the part of the field that the guide does not show.
//!
//! ```text
//! argmin_u ‖r − a A B (u − u₀)‖²/ρ² + Σ_edges (Δu)²/s²
//! ```
//!
//! with the residual `r` of the frame in σ for the present margin `u₀`, its rms `ρ` (not below 1), the gain `a`, the interpolation
//! `B` of the margin for the voxels, and the mean square `s²` of the differences of neighbours in the guide. At the inner border the
//! neighbours of `u` are pixels of the guide.

use super::affine::Affine;
use super::frame_fit::FrameFit;
use super::least_squares::conjugate_gradients;
use super::picture::{self, GuideSample};
use rayon::prelude::*;
use rowburst_core::vecmath::norm_squared;
use rowburst_optics::Image;

/// Width of the margin in pixels of a field of 108; larger allows larger shifts of the guide, and takes time.
const WIDTH_PX: f64 = 12.0;
/// Conjugate gradients of a fit, which goes on from the one before; more gain little.
const ITERATIONS: usize = 20;
/// Least difference of neighbours over the greatest value, so that an even guide has a prior.
const SMOOTHEST: f64 = 1e-6;

/// The margin of a picture on the grid of the field.
#[derive(Clone, Copy)]
pub(super) struct Margin {
    /// Width in pixels.
    pub width: usize,
}

/// Weight of a pixel of the margin in a voxel of a bin.
struct Entry {
    voxel: u32,
    pixel: u32,
    weight: f32,
}

impl Margin {
    /// The margin on a field with `unit` pixels per pixel of a field of 108.
    pub fn new(unit: f64) -> Self {
        let width = (WIDTH_PX * unit).ceil() as usize;
        Self { width }
    }

    /// The picture with a margin of the values of its edge.
    pub fn around(self, picture: &Image) -> Image {
        let width = self.width;
        let inner = |at: usize, n: usize| at.saturating_sub(width).min(n - 1);
        let (rows, columns) = (picture.rows(), picture.columns());
        Image::from_fn(rows + 2 * width, columns + 2 * width, |y, x| {
            picture.at(inner(y, rows), inner(x, columns))
        })
    }

    /// The map from the field to the picture with its margin.
    pub fn map(self, affine: &Affine) -> Affine {
        let mut map = *affine;
        map.parameters[0] += self.width as f64;
        map.parameters[3] += self.width as f64;
        map
    }

    fn contains(self, padded: &Image, y: usize, x: usize) -> bool {
        let is_outer = |at: usize, n: usize| at < self.width || at + self.width >= n;
        is_outer(y, padded.rows()) || is_outer(x, padded.columns())
    }

    /// Fits the margin of `padded`, whose part in each voxel is `sample`, to the residual `residual` of the frame.
    pub fn fill(
        self,
        padded: &mut Image,
        frame: &FrameFit,
        sample: impl Fn(usize) -> GuideSample + Sync,
        residual: &[f32],
        gain: f64,
    ) {
        let entries = self.entries(padded, frame, sample);
        if entries.iter().all(Vec::is_empty) || frame.cancel().is_cancelled() {
            return;
        }
        let power = norm_squared(residual) / frame.fitted_count().max(1) as f64;
        let data_weight = (1.0 / power.max(1.0)) as f32;
        let (prior_weight, gain) = ((1.0 / self.roughness(padded)) as f32, gain as f32);
        let shape = frame.shape();
        let light = |u: &[f32]| {
            let mut video = vec![0.0; shape.voxels()];
            let bins = video.par_chunks_mut(shape.pixels()).zip(&entries);
            bins.for_each(|(bin, entries)| {
                for e in entries {
                    bin[e.voxel as usize] += gain * e.weight * u[e.pixel as usize];
                }
            });
            frame.apply(&video)
        };
        let adjoint = |frame_light: &[f32]| {
            let video = frame.adjoint(frame_light);
            let mut u = vec![0.0; padded.data().len()];
            for (bin, entries) in video.chunks_exact(shape.pixels()).zip(&entries) {
                for e in entries {
                    u[e.pixel as usize] += gain * e.weight * bin[e.voxel as usize];
                }
            }
            u
        };
        let smooth = |u: &[f32]| self.curvature(padded, u);
        let mut rhs = adjoint(residual);
        let prior = smooth(padded.data());
        for (r, p) in rhs.iter_mut().zip(&prior) {
            *r = data_weight * *r - prior_weight * p;
        }
        let normal = |d: &[f32]| {
            let mut product = adjoint(&light(d));
            let prior = smooth(d);
            for (r, p) in product.iter_mut().zip(&prior) {
                *r = data_weight * *r + prior_weight * p;
            }
            product
        };
        let change = conjugate_gradients(normal, &rhs, ITERATIONS, 1e-2, frame.cancel());
        if change.iter().all(|c| c.is_finite()) {
            let pixels = padded.data_mut().iter_mut().zip(&change);
            pixels.for_each(|(p, c)| *p += c);
        }
    }

    /// `Σ_edges (Δu)²/s²` of the margin.
    pub fn energy(self, padded: &Image) -> f64 {
        let mut sum = 0.0;
        self.for_each_edge(padded, |at, other, is_in_margin| {
            if is_in_margin {
                sum += f64::from(padded.data()[other] - padded.data()[at]).powi(2);
            }
        });
        sum / self.roughness(padded)
    }

    /// Mean square of the differences of neighbours within the picture.
    fn roughness(self, padded: &Image) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        self.for_each_edge(padded, |at, other, is_in_margin| {
            if !is_in_margin {
                sum += f64::from(padded.data()[other] - padded.data()[at]).powi(2);
                count += 1.0;
            }
        });
        let least = (SMOOTHEST * f64::from(padded.max())).powi(2).max(1e-30);
        (sum / f64::max(count, 1.0)).max(least)
    }

    /// Half the gradient of the sum of squared differences of `u` at the pixels of the margin.
    fn curvature(self, padded: &Image, u: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; u.len()];
        self.for_each_edge(padded, |at, other, is_in_margin| {
            if is_in_margin {
                let change = u[other] - u[at];
                out[at] -= change;
                out[other] += change;
            }
        });
        self.clear_inner(padded, &mut out);
        out
    }

    fn clear_inner(self, padded: &Image, values: &mut [f32]) {
        for (i, value) in values.iter_mut().enumerate() {
            if !self.contains(padded, i / padded.columns(), i % padded.columns()) {
                *value = 0.0;
            }
        }
    }

    /// Calls `act` for all pairs of neighbours, with whether one of them is in the margin.
    fn for_each_edge(self, padded: &Image, mut act: impl FnMut(usize, usize, bool)) {
        let (rows, columns) = (padded.rows(), padded.columns());
        for y in 0..rows {
            for x in 0..columns {
                let is_outer = self.contains(padded, y, x);
                let at = y * columns + x;
                if x + 1 < columns {
                    act(at, at + 1, is_outer || self.contains(padded, y, x + 1));
                }
                if y + 1 < rows {
                    act(
                        at,
                        at + columns,
                        is_outer || self.contains(padded, y + 1, x),
                    );
                }
            }
        }
    }

    /// The entries of each bin.
    fn entries(
        self,
        padded: &Image,
        frame: &FrameFit,
        sample: impl Fn(usize) -> GuideSample + Sync,
    ) -> Vec<Vec<Entry>> {
        let (pixels, columns) = (frame.shape().pixels(), padded.columns());
        let of_bin = |t: usize| {
            let mut entries = Vec::new();
            for voxel in 0..pixels {
                let sample = sample(t * pixels + voxel);
                for (pixel, part) in picture::corners(padded, sample.at) {
                    if self.contains(padded, pixel / columns, pixel % columns) {
                        entries.push(Entry {
                            voxel: voxel as u32,
                            pixel: pixel as u32,
                            weight: sample.weight * part,
                        });
                    }
                }
            }
            entries
        };
        (0..frame.shape().bins)
            .into_par_iter()
            .map(of_bin)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::affine::Field;
    use super::*;
    use rowburst_core::{Cancel, LinearOperator};
    use rowburst_optics::{Camera, CameraParams, Measurement, RollingShutter, Sensor, Shutter};
    use rowburst_simulate::scene::{DenseScene, dense};
    use rowburst_simulate::{SpeckleOptics, speckle_psf};

    const N: usize = 40;
    /// Rows of the field above the guide.
    const ABOVE: usize = 4;

    #[test]
    fn the_picture_with_its_margin_lies_where_it_was() {
        let picture = Image::from_fn(20, 30, |y, x| (3 * y + x) as f32);
        let margin = Margin::new(0.3);
        let padded = margin.around(&picture);
        assert_eq!((padded.rows(), padded.columns()), (28, 38));
        let field = Field {
            rows: 20,
            columns: 30,
        };
        let map = margin.map(&Affine::default());
        let seen = field.warp(&padded, &map);
        let worst = seen.data().iter().zip(picture.data());
        assert!(worst.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) < 1e-3);
    }

    #[test]
    fn the_frame_tells_what_lies_above_the_guide() {
        let camera = Camera::new(CameraParams {
            rows: N,
            columns: N,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let psf = speckle_psf(&SpeckleOptics::demo(), 2 * N - 1, 2 * N - 1, 3).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let scene = dense(DenseScene::Still, camera.video_shape(), 3).unwrap();
        let mut frame = vec![0.0; N * N];
        operator.apply(scene.data(), &mut frame);
        let measurement = Measurement::new(Image::new(N, N, frame).unwrap()).unwrap();
        let cancel = Cancel::default();
        let frame = FrameFit::new(&operator, &measurement, 1e-4, &cancel);
        let truth = |y: usize, x: usize| scene.bin(0)[y.min(N - 1) * N + x];
        let guide = Image::from_fn(N, N, |y, x| truth(y + ABOVE, x));
        let margin = Margin { width: 8 };
        let mut padded = margin.around(&guide);
        let place = |v: usize| {
            let (y, x) = (v / N % N, v % N);
            [(y + 8 - ABOVE) as f32, (x + 8) as f32]
        };
        let voxels = scene.data().len();
        let sample = |v: usize| GuideSample {
            at: place(v),
            weight: 1.0,
        };
        let error = |padded: &Image| -> f32 {
            let pixels = (0..ABOVE * N).map(|i| (i / N, i % N));
            let pairs = pixels.map(|(y, x)| padded.at(y + 8 - ABOVE, x + 8) - truth(y, x));
            pairs.map(|e| e * e).sum()
        };
        let before = error(&padded);
        for _ in 0..3 {
            let at = |v: usize| picture::at(&padded, place(v)[0], place(v)[1]).0;
            let light = frame.apply(&(0..voxels).map(at).collect::<Vec<f32>>());
            let pairs = frame.target().into_iter().zip(light);
            let residual: Vec<f32> = pairs.map(|(t, l)| t - l).collect();
            margin.fill(&mut padded, &frame, sample, &residual, 1.0);
        }
        let after = error(&padded);
        assert!(after < 0.1 * before, "{before} {after}");
    }
}
