//! Cross-validation with pixels that the solver does not see.
//!
//! A video may fit the noise of the pixels that it was made from. At held-out pixels its error
//! `⟨(w(b − A v)/σ)²⟩` is that of the video plus that of the noise, so a smaller error means a better video
//! (cross-validation: Stone 1974; for compressed sensing: Ward 2009).

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;
use rowburst_optics::RollingShutter;

/// Fraction of the pixels held out; larger decides better and leaves less for the fit (docs/design/011).
const HELD_OUT_FRACTION: f64 = 0.05;

/// Relative fall of the held-out error over two checks below which it has settled; smaller takes longer.
const SETTLED_CHANGE: f64 = 0.01;

/// Fixed seed of the draw, so that results are reproducible.
const SEED: u64 = 0x0526_d017;

/// The held-out pixels: a random [`HELD_OUT_FRACTION`] of those that each instant reads.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct HeldOut {
    pixels: Vec<usize>,
}

impl HeldOut {
    /// Draws from the pixels with a weight above zero: at least one for each instant that has 10 or more of
    /// them, none for the others. Each `set` is another draw.
    pub fn draw(shutter: &RollingShutter, weights: Option<&[f32]>, set: u64) -> Self {
        let mut rng = Pcg64::seed_from_u64(SEED + set);
        let mut pixels = Vec::new();
        for instant in 0..shutter.rows_of_instants().len() {
            let mut usable = shutter.indices_of(instant);
            usable.retain(|&i| weights.is_none_or(|w| w[i] > 0.0));
            let count = match usable.len() {
                0..10 => 0,
                n => ((HELD_OUT_FRACTION * n as f64).round() as usize).max(1),
            };
            usable.shuffle(&mut rng);
            pixels.extend_from_slice(&usable[..count]);
        }
        pixels.sort_unstable();
        Self { pixels }
    }

    /// Indices of the pixels in the frame, in ascending order.
    pub fn pixels(&self) -> &[usize] {
        &self.pixels
    }
}

/// Root mean square of the held-out residuals.
pub(super) fn rms(values: &[f64]) -> f64 {
    let squares: f64 = values.iter().map(|v| v * v).sum();
    (squares / values.len().max(1) as f64).sqrt()
}

/// Whether the held-out error no longer falls: `errors` are those of the checks so far.
pub(super) fn is_settled(errors: &[f64]) -> bool {
    match errors {
        [.., before, _, last] => *last > (1.0 - SETTLED_CHANGE) * before,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_optics::camera::CameraParams;
    use rowburst_optics::{Camera, Image, Psf, Sensor, Shutter};

    #[test]
    fn takes_a_twentieth_of_each_instant() {
        let camera = Camera::new(CameraParams {
            rows: 8,
            columns: 50,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let psf = Psf::new(Image::from_fn(5, 5, |_, _| 1.0)).unwrap();
        let shutter = RollingShutter::new(&camera, &psf);
        let mut weights = vec![1.0f32; 400];
        // Half of the pixels of the first instant, which reads the middle rows, are bad.
        weights[150..200].fill(0.0);
        let held_out = HeldOut::draw(&shutter, Some(&weights), 0);
        for instant in 0..4 {
            let of_instant = shutter.indices_of(instant);
            let count = of_instant
                .iter()
                .filter(|i| held_out.pixels().contains(i))
                .count();
            assert_eq!(count, if instant == 0 { 3 } else { 5 });
        }
        assert!(held_out.pixels().iter().all(|&i| weights[i] > 0.0));
        assert_eq!(held_out, HeldOut::draw(&shutter, Some(&weights), 0));
    }
}
