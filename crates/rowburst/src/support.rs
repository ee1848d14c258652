//! Which voxels may be lit.

use crate::Shape;
use rayon::prelude::*;
use std::sync::Arc;

/// A set of voxels; a solver restricted to it keeps all others dark. Clones share it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Support {
    shape: Shape,
    mask: Arc<Vec<u8>>,
}

/// A bin of which more than this part is in the support is left open: the restriction
/// would gain nothing.
const MAX_ACTIVE_FRACTION: f64 = 1.0 / 3.0;

impl Support {
    /// Every voxel.
    pub fn full(shape: Shape) -> Self {
        Self {
            shape,
            mask: Arc::new(vec![1; shape.voxels()]),
        }
    }

    /// In each bin, the voxels of `video` above `thresholds[bin]` and their eight
    /// neighbours; all voxels of a bin whose threshold is zero.
    ///
    /// # Panics
    /// If a length does not match.
    pub fn above(video: &[f32], shape: Shape, thresholds: &[f64]) -> Self {
        assert_eq!(video.len(), shape.voxels(), "length of the video");
        assert_eq!(thresholds.len(), shape.bins, "one threshold for each bin");
        let pixels = shape.pixels();
        let mut mask = vec![0u8; shape.voxels()];
        let bins = mask
            .par_chunks_exact_mut(pixels)
            .zip(video.par_chunks_exact(pixels));
        bins.zip(thresholds).for_each(|((mask, bin), &threshold)| {
            if threshold > 0.0 {
                mark_with_neighbours(mask, bin, shape.columns, threshold as f32);
            } else {
                mask.fill(1);
            }
            open_if_crowded(mask);
        });
        Self {
            shape,
            mask: Arc::new(mask),
        }
    }

    /// The same with, in the bins `bins`, the voxels whose value in `correlation` is
    /// at least half of the bin's largest, and their eight neighbours.
    ///
    /// # Panics
    /// If a length does not match.
    #[must_use]
    pub fn with_correlated(mut self, correlation: &[f32], bins: &[usize]) -> Self {
        assert_eq!(
            correlation.len(),
            self.shape.voxels(),
            "length of the video"
        );
        let pixels = self.shape.pixels();
        let all = Arc::make_mut(&mut self.mask);
        for &t in bins {
            let bin = &correlation[t * pixels..(t + 1) * pixels];
            let half = 0.5 * bin.iter().copied().fold(0.0f32, f32::max);
            if half > 0.0 {
                let mask = &mut all[t * pixels..(t + 1) * pixels];
                mark_with_neighbours(mask, bin, self.shape.columns, half);
                open_if_crowded(mask);
            }
        }
        self
    }

    /// The same with all of a bin of which more than `max_active` voxels are in it.
    #[must_use]
    pub fn with_crowded_bins_open(mut self, max_active: usize) -> Self {
        let pixels = self.shape.pixels();
        if max_active < pixels {
            for bin in Arc::make_mut(&mut self.mask).chunks_exact_mut(pixels) {
                if bin.iter().map(|&active| usize::from(active)).sum::<usize>() > max_active {
                    bin.fill(1);
                }
            }
        }
        self
    }

    /// 1 where a voxel may be lit, else 0; `[t, y, x]`.
    pub fn mask(&self) -> &[u8] {
        &self.mask
    }

    /// Indices of the pixels of bin `t` that may be lit; `None` where all may.
    pub fn pixels_of(&self, t: usize) -> Option<Vec<usize>> {
        let pixels = self.shape.pixels();
        let bin = &self.mask[t * pixels..(t + 1) * pixels];
        let active: Vec<usize> = (0..pixels).filter(|&i| bin[i] == 1).collect();
        (active.len() < pixels).then_some(active)
    }

    /// Whether a row of a bin holds a voxel that may be lit, `[t, y]`.
    pub fn active_rows(&self) -> Vec<bool> {
        let lines = self.mask.par_chunks_exact(self.shape.columns);
        lines.map(|line| line.contains(&1)).collect()
    }

    /// Whether both admit the same voxels in `bins`.
    pub fn agrees_with(&self, other: &Self, bins: std::ops::Range<usize>) -> bool {
        let pixels = self.shape.pixels();
        let voxels = bins.start * pixels..bins.end * pixels;
        self.mask[voxels.clone()] == other.mask[voxels]
    }

    /// Part of all voxels that may be lit.
    pub fn fraction(&self) -> f64 {
        let active: usize = self
            .mask
            .par_iter()
            .map(|&active| usize::from(active))
            .sum();
        active as f64 / self.mask.len() as f64
    }

    /// Sets all voxels outside the support to zero, and leaves what follows the video.
    pub fn apply(&self, video: &mut [f32]) {
        video
            .par_iter_mut()
            .zip(self.mask.par_iter())
            .for_each(|(v, &active)| *v *= f32::from(active));
    }
}

fn open_if_crowded(mask: &mut [u8]) {
    let active = mask.iter().filter(|&&active| active == 1).count();
    if active as f64 > MAX_ACTIVE_FRACTION * mask.len() as f64 {
        mask.fill(1);
    }
}

fn mark_with_neighbours(mask: &mut [u8], bin: &[f32], columns: usize, threshold: f32) {
    let rows = bin.len() / columns;
    for y in 0..rows {
        for x in 0..columns {
            if bin[y * columns + x] > threshold {
                for near in y.saturating_sub(1)..(y + 2).min(rows) {
                    let line = near * columns;
                    mask[line + x.saturating_sub(1)..line + (x + 2).min(columns)].fill(1);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bright_voxels_and_their_neighbours() {
        let shape = Shape::new(2, 7, 8);
        let mut video = vec![0.0f32; shape.voxels()];
        video[2 * 8 + 3] = 1.0;
        video[56] = 1.0;
        let support = Support::above(&video, shape, &[0.5, 0.5]);
        let active = support.pixels_of(0).unwrap();
        assert_eq!(active, [10, 11, 12, 18, 19, 20, 26, 27, 28]);
        assert_eq!(support.pixels_of(1).unwrap(), [0, 1, 8, 9]);
        assert!((support.fraction() - 13.0 / 112.0).abs() < 1e-12);
        let mut dimmed = vec![1.0f32; shape.voxels()];
        support.apply(&mut dimmed);
        assert_eq!(dimmed.iter().sum::<f32>(), 13.0);
    }

    #[test]
    fn correlated_voxels_are_added() {
        let shape = Shape::new(2, 9, 9);
        let mut correlation = vec![0.1f32; shape.voxels()];
        correlation[81 + 40] = 1.0;
        correlation[81 + 42] = 0.6;
        let dark = Support::above(&vec![0.0; shape.voxels()], shape, &[0.5, 0.5]);
        let support = dark.with_correlated(&correlation, &[1]);
        assert_eq!(support.pixels_of(0), Some(vec![]));
        assert_eq!(support.pixels_of(1).unwrap().len(), 15);
    }

    #[test]
    fn threshold_zero_and_crowded_bins_are_open() {
        let shape = Shape::new(2, 4, 4);
        let video: Vec<f32> = (0..32)
            .map(|i| if i % 16 < 4 { 1.0 } else { 0.0 })
            .collect();
        let support = Support::above(&video, shape, &[0.0, 0.5]);
        assert_eq!(support.pixels_of(0), None);
        assert_eq!(support.pixels_of(1), None);
    }
}
