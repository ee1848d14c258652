//! The data term of a fit: residuals of fitted and of held-out pixels in units of σ.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;
use rowburst_core::{Cancel, LinearOperator, Shape};
use rowburst_optics::{InstantWeights, Measurement, RollingShutter};

/// Part of the pixels of every row that is held out; larger decides better and leaves less for the fit.
const HELD_OUT_FRACTION: f64 = 0.1;
/// Fixed seed of the draw, so that results are reproducible.
const SEED: u64 = 0x0026_d017;

/// A frame with its operator, with pixels for the fit and pixels that judge it.
pub(super) struct FrameFit<'a> {
    operator: &'a RollingShutter,
    counts: &'a [f32],
    /// `W/σ` of the fitted pixels; 0 at the others.
    fitted: Vec<f32>,
    /// `W/σ` of the held-out pixels; 0 at the others.
    held_out: Vec<f32>,
    cancel: &'a Cancel,
}

impl<'a> FrameFit<'a> {
    /// The frame `measurement` with noise `sigma` at pixels of weight 1.
    pub fn new(
        operator: &'a RollingShutter,
        measurement: &'a Measurement,
        sigma: f64,
        cancel: &'a Cancel,
    ) -> Self {
        let counts = measurement.image().data();
        let mut fitted: Vec<f32> = match measurement.weights() {
            Some(weights) => weights.iter().map(|w| w / sigma as f32).collect(),
            None => vec![1.0 / sigma as f32; counts.len()],
        };
        let mut held_out = vec![0.0; counts.len()];
        for at in draw(&fitted, measurement.image().columns()) {
            held_out[at] = std::mem::take(&mut fitted[at]);
        }
        Self {
            operator,
            counts,
            fitted,
            held_out,
            cancel,
        }
    }

    /// The same frame with every usable pixel fitted.
    pub fn with_all_pixels(&self) -> Self {
        let sums = self.fitted.iter().zip(&self.held_out);
        Self {
            fitted: sums.map(|(a, b)| a + b).collect(),
            held_out: self.held_out.clone(),
            ..*self
        }
    }

    /// Shape of the video.
    pub fn shape(&self) -> Shape {
        self.operator.video_shape()
    }

    /// What stops the run.
    pub fn cancel(&self) -> &Cancel {
        self.cancel
    }

    /// `W A v/σ` at the fitted pixels.
    pub fn apply(&self, video: &[f32]) -> Vec<f32> {
        let mut frame = self.light_of(video);
        scale(&mut frame, &self.fitted);
        frame
    }

    /// `Aᵀ W r/σ`, the adjoint of [`Self::apply`].
    pub fn adjoint(&self, residual: &[f32]) -> Vec<f32> {
        let mut frame = residual.to_vec();
        scale(&mut frame, &self.fitted);
        let mut video = vec![0.0; self.operator.domain_len()];
        self.operator.adjoint(&frame, &mut video);
        video
    }

    /// `W b/σ` at the fitted pixels.
    pub fn target(&self) -> Vec<f32> {
        let mut frame = self.counts.to_vec();
        scale(&mut frame, &self.fitted);
        frame
    }

    /// Light of a pixel of an even video that gives the frame's mean.
    pub fn mean_light(&self) -> f64 {
        let one = self.apply(&vec![1.0; self.operator.domain_len()]);
        let product = rowburst_core::vecmath::dot(&one, &self.target());
        product / rowburst_core::vecmath::norm_squared(&one).max(f64::MIN_POSITIVE)
    }

    /// Number of pixels of the frame.
    pub fn pixels(&self) -> usize {
        self.counts.len()
    }

    /// Number of fitted pixels.
    pub fn fitted_count(&self) -> usize {
        self.fitted.iter().filter(|w| **w > 0.0).count()
    }

    /// The bins of each instant with their weights.
    pub fn instants(&self) -> &[InstantWeights] {
        self.operator.time().instants()
    }

    /// Indices of the pixels that are read at an instant.
    pub fn pixels_of(&self, instant: usize) -> Vec<usize> {
        self.operator.indices_of(instant)
    }

    /// Columns of the frame.
    pub fn columns(&self) -> usize {
        self.operator.frame_shape().1
    }

    /// Mean of `line`, one value for each bin, over the exposure of each row.
    pub fn row_means(&self, line: &[f32]) -> Vec<f32> {
        let mut means = vec![0.0; self.operator.frame_shape().0];
        let columns = self.columns();
        for (i, instant) in self.operator.time().instants().iter().enumerate() {
            let total: f64 = instant.weights.iter().sum();
            let values = instant.weights.iter().zip(&line[instant.first_bin..]);
            let mean = values.map(|(w, v)| w * f64::from(*v)).sum::<f64>() / total;
            for at in self.operator.indices_of(i).into_iter().step_by(columns) {
                means[at / columns] = mean as f32;
            }
        }
        means
    }

    /// Rms of `W(b − A v)/σ` over the fitted pixels, and over the held-out pixels.
    pub fn errors(&self, video: &[f32]) -> (f64, f64) {
        let light = self.light_of(video);
        let rms = |weights: &[f32]| {
            let values = self.counts.iter().zip(&light).zip(weights);
            let sum: f64 = values
                .map(|((b, a), w)| (f64::from(b - a) * f64::from(*w)).powi(2))
                .sum();
            let count = weights.iter().filter(|w| **w > 0.0).count();
            (sum / count.max(1) as f64).sqrt()
        };
        (rms(&self.fitted), rms(&self.held_out))
    }

    fn light_of(&self, video: &[f32]) -> Vec<f32> {
        let mut frame = vec![0.0; self.operator.range_len()];
        self.operator.apply(video, &mut frame);
        frame
    }
}

fn scale(values: &mut [f32], weights: &[f32]) {
    values.iter_mut().zip(weights).for_each(|(v, w)| *v *= w);
}

/// The same share of the usable pixels of every row.
fn draw(weights: &[f32], columns: usize) -> Vec<usize> {
    let mut rng = Pcg64::seed_from_u64(SEED);
    let rows = weights.chunks_exact(columns).enumerate();
    let drawn = rows.flat_map(|(row, weights)| {
        let mut usable: Vec<usize> = (0..columns).filter(|&x| weights[x] > 0.0).collect();
        usable.shuffle(&mut rng);
        usable.truncate((HELD_OUT_FRACTION * usable.len() as f64).round() as usize);
        usable.into_iter().map(move |x| row * columns + x)
    });
    drawn.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_holds_out_the_same_share_of_its_usable_pixels() {
        let (rows, columns) = (6, 40);
        let mut weights = vec![1.0; rows * columns];
        weights[..20].fill(0.0);
        let drawn = draw(&weights, columns);
        let count = |row| drawn.iter().filter(|at| **at / columns == row).count();
        assert_eq!((0..rows).map(count).collect::<Vec<_>>(), [2, 4, 4, 4, 4, 4]);
        assert!(drawn.iter().all(|at| weights[*at] > 0.0));
    }
}
