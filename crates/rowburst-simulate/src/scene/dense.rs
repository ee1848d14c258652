//! Dense scenes: light everywhere, of which a part changes.
//!
//! They have what people film with an ordinary camera: a still picture, a thing that crosses a bench, a vibrating beam, a
//! turning wheel, and cells that stay and flicker. Their textures have a power spectrum `f^−2.6` and patches with edges.
//! Lengths are for a field of 108 pixels and scale with it; motions take the whole video.

use super::require_field_size;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64;
use rowburst_core::fft::{Fft2, smooth_length};
use rowburst_core::{Result, Shape};
use rowburst_optics::{Image, Video};
use rustfft::num_complex::Complex32;
use std::f64::consts::{PI, TAU};

/// Smallest side of a field.
const MIN_SIDE: usize = 24;
/// Width of an edge (logistic) in pixels.
const EDGE_PX: f64 = 0.5;

/// A dense scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DenseScene {
    /// Nothing moves.
    Still,
    /// A textured disc crosses a textured still picture.
    Bench,
    /// A textured beam, clamped at the left, vibrates at 1.8 periods in the video.
    Beam,
    /// A textured wheel with six dark spokes turns by 54°.
    Wheel,
    /// Cells stay in place and flicker; a fifth of the pixels is lit.
    Cells,
    /// Discs that do not touch flicker and are never dark; a tenth of the pixels is lit.
    Spots,
}

impl DenseScene {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self::Still,
        Self::Bench,
        Self::Beam,
        Self::Wheel,
        Self::Cells,
        Self::Spots,
    ];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Still => "still",
            Self::Bench => "bench",
            Self::Beam => "beam",
            Self::Wheel => "wheel",
            Self::Cells => "cells",
            Self::Spots => "spots",
        }
    }
}

/// The video of a dense scene, with values from 0 to 1.
///
/// # Errors
/// A field with a side below 24 pixels.
pub fn dense(scene: DenseScene, shape: Shape, seed: u64) -> Result<Video> {
    require_field_size(shape, MIN_SIDE, MIN_SIDE, "a dense scene")?;
    let mut painter = Painter {
        shape,
        unit: shape.rows.min(shape.columns) as f64 / 108.0,
        rng: Pcg64::seed_from_u64(seed ^ STREAM),
    };
    Ok(match scene {
        DenseScene::Still => {
            let picture = painter.texture(0.2, 0.9);
            painter.video(|_, y, x| f64::from(picture.at(y, x)))
        }
        DenseScene::Bench => painter.bench(),
        DenseScene::Beam => painter.beam(),
        DenseScene::Wheel => painter.wheel(),
        DenseScene::Cells => painter.cells(),
        DenseScene::Spots => painter.spots(),
    })
}

/// Tells the random numbers of dense scenes from those of noise and PSF of the same seed.
const STREAM: u64 = 0x6465_6e73;

/// What the scenes are made with.
struct Painter {
    shape: Shape,
    /// Pixels per pixel of a field of 108.
    unit: f64,
    rng: Pcg64,
}

/// 1 inside an edge (`distance` below zero), 0 outside.
fn soft(distance: f64) -> f64 {
    1.0 / (1.0 + (distance / EDGE_PX).clamp(-50.0, 50.0).exp())
}

impl Painter {
    fn video(&self, value: impl Fn(usize, usize, usize) -> f64) -> Video {
        let Shape {
            bins,
            rows,
            columns,
        } = self.shape;
        let mut video = Video::zeros(self.shape);
        for t in 0..bins {
            let bin = video.bin_mut(t);
            for y in 0..rows {
                for x in 0..columns {
                    bin[y * columns + x] = value(t, y, x).clamp(0.0, 1.0) as f32;
                }
            }
        }
        video
    }

    /// Centre of the field, `(y, x)`.
    fn centre(&self) -> (f64, f64) {
        let half = |n: usize| n as f64 / 2.0;
        (half(self.shape.rows), half(self.shape.columns))
    }

    /// A texture with values from `low` to `high`.
    fn texture(&mut self, low: f64, high: f64) -> Image {
        let (rows, columns) = (self.shape.rows, self.shape.columns);
        let n = smooth_length(rows.max(columns));
        let fft = Fft2::new(n);
        let mut points: Vec<Complex32> = (0..n * n)
            .map(|_| {
                let sample: f32 = StandardNormal.sample(&mut self.rng);
                Complex32::new(sample, 0.0)
            })
            .collect();
        fft.forward(&mut points);
        let frequency = |k: usize| k.min(n - k) as f64 / n as f64;
        for (i, point) in points.iter_mut().enumerate() {
            let f = frequency(i / n).hypot(frequency(i % n));
            let gain = if i == 0 {
                0.0
            } else {
                f.powf(-1.3) * (-(f / 0.3).powi(4)).exp()
            };
            *point *= gain as f32;
        }
        fft.inverse(&mut points);
        let power: f64 = points.iter().map(|p| f64::from(p.re).powi(2)).sum();
        let scale = 0.11 / (power / (n * n) as f64).sqrt();
        let mut picture = Image::from_fn(rows, columns, |y, x| {
            (0.5 + scale * f64::from(points[y * n + x].re)) as f32
        });
        for _ in 0..14 {
            self.add_patch(&mut picture);
        }
        let mut picture = picture.blurred(0.6);
        let (least, most) = (f64::from(picture.min()), f64::from(picture.max()));
        let scale = (high - low) / (most - least);
        for p in picture.data_mut() {
            *p = (low + (f64::from(*p) - least) * scale) as f32;
        }
        picture
    }

    /// A rectangle of another brightness.
    fn add_patch(&mut self, picture: &mut Image) {
        let (rows, columns) = (self.shape.rows, self.shape.columns);
        let mut side = || ((self.rng.random_range(8.0..34.0) * self.unit) as usize).max(2);
        let (height, width) = (side(), side());
        let y0 = self.rng.random_range(0..rows - 2);
        let x0 = self.rng.random_range(0..columns - 2);
        let level = 0.65 * self.rng.random::<f32>();
        for y in y0..(y0 + height).min(rows) {
            for x in x0..(x0 + width).min(columns) {
                let pixel = &mut picture.data_mut()[y * columns + x];
                *pixel = 0.35 * *pixel + level;
            }
        }
    }

    fn bench(&mut self) -> Video {
        let (still, object) = (self.texture(0.05, 0.7), self.texture(0.4, 1.0));
        let (unit, bins) = (self.unit, self.shape.bins as f64);
        let angle = self.rng.random_range(0.0..TAU);
        let (half_y, half_x) = (22.0 * unit * angle.sin(), 22.0 * unit * angle.cos());
        let (y0, x0) = self.centre();
        self.video(|t, y, x| {
            let s = 2.0 * (t as f64 + 0.5) / bins - 1.0;
            let (cy, cx) = (y0 + s * half_y, x0 + s * half_x);
            let (dy, dx) = (y as f64 - cy, x as f64 - cx);
            let inside = soft(dy.hypot(dx) - 15.0 * unit);
            let back = f64::from(still.at(y, x));
            back * (1.0 - inside) + sample(&object, dy + y0, dx + x0) * inside
        })
    }

    fn beam(&mut self) -> Video {
        let (still, object) = (self.texture(0.1, 0.6), self.texture(0.3, 1.0));
        let (unit, bins) = (self.unit, self.shape.bins as f64);
        let phase = self.rng.random_range(0.0..TAU);
        let (y0, columns) = (self.centre().0, self.shape.columns as f64);
        self.video(|t, y, x| {
            let swing = (TAU * 1.8 * t as f64 / bins + phase).sin();
            let bent = y as f64 - 4.0 * unit * (x as f64 / columns).powi(2) * swing;
            let inside = soft((bent - y0).abs() - 12.0 * unit);
            let back = f64::from(still.at(y, x));
            back * (1.0 - inside) + sample(&object, bent, x as f64) * inside
        })
    }

    fn wheel(&mut self) -> Video {
        let (still, object) = (self.texture(0.1, 0.7), self.texture(0.3, 1.0));
        let (unit, bins) = (self.unit, self.shape.bins as f64);
        let direction = if self.rng.random::<bool>() { 1.0 } else { -1.0 };
        let start = self.rng.random_range(0.0..TAU);
        let (y0, x0) = self.centre();
        self.video(|t, y, x| {
            let (dy, dx) = (y as f64 - y0, x as f64 - x0);
            let inside = soft(dy.hypot(dx) - 30.0 * unit);
            let back = f64::from(still.at(y, x)) * (1.0 - inside);
            if inside < 1e-6 {
                return back;
            }
            let angle = start + direction * 0.3 * PI * t as f64 / bins;
            let (c, s) = (angle.cos(), angle.sin());
            let is_spoke = (6.0 * (dy.atan2(dx) - angle)).cos() > 0.6;
            let shade = if is_spoke { 0.25 } else { 1.0 };
            let light = sample(&object, y0 + c * dy - s * dx, x0 + s * dy + c * dx);
            back + light * shade * inside
        })
    }

    fn cells(&mut self) -> Video {
        let Shape {
            bins,
            rows,
            columns,
        } = self.shape;
        let mut video = Video::zeros(self.shape);
        let mut is_active = vec![false; rows * columns];
        let margin = 3.0 * self.unit;
        while is_active.iter().filter(|l| **l).count() * 5 < rows * columns {
            let cy = self.rng.random_range(margin..rows as f64 - margin);
            let cx = self.rng.random_range(margin..columns as f64 - margin);
            let radius = self.rng.random_range(2.2..4.2) * self.unit.max(0.5);
            let at = |i: usize| {
                soft(((i / columns) as f64 - cy).hypot((i % columns) as f64 - cx) - radius)
            };
            let shape: Vec<(usize, f64)> = (0..rows * columns)
                .map(|i| (i, at(i)))
                .filter(|(_, s)| *s > 1e-4)
                .collect();
            let overlap = shape
                .iter()
                .filter(|(i, s)| is_active[*i] && *s > 0.2)
                .count();
            if overlap > 4 {
                continue;
            }
            let flicker = self.flicker();
            let brightness = self.rng.random_range(0.5..1.0);
            for (i, s) in shape {
                is_active[i] |= s > 0.5;
                for (t, level) in flicker.iter().enumerate().take(bins) {
                    video.bin_mut(t)[i] += (brightness * s * (0.15 + 0.85 * level)) as f32;
                }
            }
        }
        video.data_mut().iter_mut().for_each(|v| *v = v.min(1.0));
        video
    }

    fn spots(&mut self) -> Video {
        let (rows, columns) = (self.shape.rows as f64, self.shape.columns as f64);
        let radius = 3.0 * self.unit;
        let margin = radius + 2.0 * self.unit;
        let count = (0.1 * rows * columns / (PI * radius * radius)) as usize;
        let mut centres: Vec<(f64, f64)> = Vec::new();
        while centres.len() < count {
            let cy = self.rng.random_range(margin..rows - margin);
            let cx = self.rng.random_range(margin..columns - margin);
            let is_apart =
                |(y, x): &(f64, f64)| (y - cy).hypot(x - cx) > 2.0 * radius + 3.0 * self.unit;
            if centres.iter().all(is_apart) {
                centres.push((cy, cx));
            }
        }
        let levels: Vec<Vec<f64>> = (0..count)
            .map(|_| {
                let brightness = self.rng.random_range(0.5..0.95);
                let flicker = self.flicker();
                let level = flicker.iter().map(|f| brightness * (0.5 + 0.5 * f));
                level.collect()
            })
            .collect();
        self.video(|t, y, x| {
            let distances = centres
                .iter()
                .map(|(cy, cx)| (y as f64 - cy).hypot(x as f64 - cx));
            let light = distances.zip(&levels);
            0.02 + light
                .map(|(d, level)| level[t] * soft(d - radius))
                .sum::<f64>()
        })
    }

    /// A smooth line over the bins with values from 0 to 1.
    fn flicker(&mut self) -> Vec<f64> {
        let bins = self.shape.bins;
        let noise: Vec<f32> = (0..bins)
            .map(|_| StandardNormal.sample(&mut self.rng))
            .collect();
        let noise = Image::from_fn(1, bins, |_, t| noise[t]);
        let line = noise.blurred(0.1 * bins as f64);
        let (least, most) = (f64::from(line.min()), f64::from(line.max()));
        let range = (most - least).max(f64::MIN_POSITIVE);
        let values = line.data().iter();
        values.map(|v| (f64::from(*v) - least) / range).collect()
    }
}

/// The picture at `(y, x)` by linear interpolation, mirrored at its edges.
fn sample(picture: &Image, y: f64, x: f64) -> f64 {
    let fold = |at: f64, n: usize| {
        let (end, period) = ((n - 1) as f64, 2.0 * (n - 1) as f64);
        let at = at.rem_euclid(period);
        at.min(period - at).min(end - 1e-6)
    };
    let (y, x) = (fold(y, picture.rows()), fold(x, picture.columns()));
    let (i, j) = (y as usize, x as usize);
    let (f, g) = (y - i as f64, x - j as f64);
    let p = |y, x| f64::from(picture.at(y, x));
    (p(i, j) * (1.0 - g) + p(i, j + 1) * g) * (1.0 - f)
        + (p(i + 1, j) * (1.0 - g) + p(i + 1, j + 1) * g) * f
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_still_scene_alone_does_not_change() {
        let shape = Shape::new(12, 30, 36);
        for scene in DenseScene::ALL {
            let video = dense(scene, shape, 3).unwrap();
            let changes = video.bin(0) != video.bin(11);
            assert_eq!(changes, scene != DenseScene::Still, "{}", scene.name());
            let range = video.data().iter().all(|v| (0.0..=1.0).contains(v));
            assert!(range, "{}", scene.name());
            assert_eq!(video, dense(scene, shape, 3).unwrap());
            assert_ne!(video, dense(scene, shape, 4).unwrap());
        }
    }

    /// They are never dark, so that a picture at any time shows them all.
    #[test]
    fn a_tenth_of_the_pixels_is_in_a_spot_and_never_dark() {
        let video = dense(DenseScene::Spots, Shape::new(10, 108, 108), 1).unwrap();
        let least = |i: usize| (0..10).map(|t| video.bin(t)[i]).fold(1.0, f32::min);
        let lit = (0..108 * 108).filter(|&i| least(i) > 0.2).count();
        assert!((800..1400).contains(&lit), "{lit}");
    }

    #[test]
    fn a_fifth_of_the_pixels_has_a_cell() {
        let video = dense(DenseScene::Cells, Shape::new(10, 60, 60), 1).unwrap();
        let brightest = |i: usize| (0..10).map(|t| video.bin(t)[i]).fold(0.0, f32::max);
        let lit = (0..3600).filter(|&i| brightest(i) > 0.2).count();
        assert!((600..1300).contains(&lit), "{lit}");
    }
}
