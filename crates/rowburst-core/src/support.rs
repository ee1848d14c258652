//! Sets of active voxels, outside which a video is zero.

use crate::Shape;
use rayon::prelude::*;
use std::sync::Arc;

/// A set of active voxels; a solver restricted to it keeps all others at zero. Clones share its memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Support {
    shape: Shape,
    mask: Arc<Vec<u8>>,
}

/// Part of a bin's voxels above which all become active; larger restricts bins for little gain (docs/design/007).
const MAX_ACTIVE_FRACTION: f64 = 1.0 / 3.0;

/// Correlation of an added voxel over the largest of its bin; smaller adds more voxels that are dark (docs/design/007).
const MIN_CORRELATION_RATIO: f32 = 0.5;

impl Support {
    /// All voxels of videos of `shape`.
    pub fn full(shape: Shape) -> Self {
        Self {
            shape,
            mask: Arc::new(vec![1; shape.voxels()]),
        }
    }

    /// The voxels that are 1 in `mask`, `[t, y, x]`; others are 0.
    ///
    /// # Panics
    /// If the length does not match.
    pub fn from_mask(mask: Vec<u8>, shape: Shape) -> Self {
        assert_eq!(mask.len(), shape.voxels(), "length of the mask");
        Self {
            shape,
            mask: Arc::new(mask),
        }
    }

    /// The voxels that are active in both.
    ///
    /// # Panics
    /// If the shapes differ.
    #[must_use]
    pub fn intersect(&self, other: &Self) -> Self {
        let pairs = self.mask.par_iter().zip_eq(other.mask.par_iter());
        Self::from_mask(pairs.map(|(a, b)| a & b).collect(), self.shape)
    }

    /// In each bin, the voxels of `video` above `thresholds[bin]` and their eight neighbours.
    ///
    /// All voxels of a bin are active if its threshold is zero, or if these voxels are more than a third of the bin.
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
            unrestrict_if_dense(mask);
        });
        Self {
            shape,
            mask: Arc::new(mask),
        }
    }

    /// Adds, in the bins `bins`, the voxels whose `correlation` is above half of the bin's largest, and their eight
    /// neighbours.
    ///
    /// If more than a third of such a bin is then active, all of its voxels become active.
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
            let threshold = MIN_CORRELATION_RATIO * bin.iter().copied().fold(0.0f32, f32::max);
            if threshold > 0.0 {
                let mask = &mut all[t * pixels..(t + 1) * pixels];
                mark_with_neighbours(mask, bin, self.shape.columns, threshold);
                unrestrict_if_dense(mask);
            }
        }
        self
    }

    /// Adds, in the bins `bins`, the voxels of `before` where `video` is above `threshold`.
    ///
    /// # Panics
    /// If a length or the shape of `before` does not match.
    #[must_use]
    pub fn with_still_lit(
        mut self,
        before: &Self,
        video: &[f32],
        threshold: f32,
        bins: impl Iterator<Item = usize>,
    ) -> Self {
        assert_eq!(before.shape, self.shape, "shape of the support before");
        assert_eq!(video.len(), self.shape.voxels(), "length of the video");
        let pixels = self.shape.pixels();
        let all = Arc::make_mut(&mut self.mask);
        for t in bins {
            for i in t * pixels..(t + 1) * pixels {
                all[i] |= before.mask[i] & u8::from(video[i] > threshold);
            }
        }
        self
    }

    /// Adds all voxels of the crowded bins, those with more than `max_active` active voxels.
    #[must_use]
    pub fn with_crowded_bins_unrestricted(mut self, max_active: usize) -> Self {
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

    /// 1 for an active voxel, 0 for others; `[t, y, x]`.
    #[inline]
    pub fn mask(&self) -> &[u8] {
        &self.mask
    }

    /// Indices of the active pixels of bin `t`; `None` if all are active.
    pub fn pixels_of(&self, t: usize) -> Option<Vec<usize>> {
        let pixels = self.shape.pixels();
        let bin = &self.mask[t * pixels..(t + 1) * pixels];
        let active: Vec<usize> = (0..pixels).filter(|&i| bin[i] == 1).collect();
        (active.len() < pixels).then_some(active)
    }

    /// Whether each row of each bin has an active voxel, `[t, y]`.
    pub fn active_rows(&self) -> Vec<bool> {
        let lines = self.mask.par_chunks_exact(self.shape.columns);
        lines.map(|line| line.contains(&1)).collect()
    }

    /// Whether both have the same active voxels in `bins`.
    pub fn equals_in_bins(&self, other: &Self, bins: std::ops::Range<usize>) -> bool {
        let pixels = self.shape.pixels();
        let voxels = bins.start * pixels..bins.end * pixels;
        self.mask[voxels.clone()] == other.mask[voxels]
    }

    /// Part of the voxels of each bin that are active, from 0 to 1.
    pub fn fractions(&self) -> Vec<f64> {
        let pixels = self.shape.pixels();
        let bins = self.mask.par_chunks_exact(pixels);
        bins.map(|bin| {
            bin.iter().map(|&active| usize::from(active)).sum::<usize>() as f64 / pixels as f64
        })
        .collect()
    }

    /// Part of the voxels that are active, from 0 to 1.
    pub fn fraction(&self) -> f64 {
        let active: usize = self
            .mask
            .par_iter()
            .map(|&active| usize::from(active))
            .sum();
        active as f64 / self.mask.len() as f64
    }

    /// Sets all inactive voxels of `video` to zero. Elements behind those of the shape stay as they are.
    pub fn zero_outside(&self, video: &mut [f32]) {
        video
            .par_iter_mut()
            .zip(self.mask.par_iter())
            .for_each(|(v, &active)| *v *= f32::from(active));
    }
}

/// Makes all voxels of a dense bin active: one of which more than [`MAX_ACTIVE_FRACTION`] is.
fn unrestrict_if_dense(mask: &mut [u8]) {
    let active = mask.iter().filter(|&&active| active == 1).count();
    if active as f64 > MAX_ACTIVE_FRACTION * mask.len() as f64 {
        mask.fill(1);
    }
}

/// Marks the voxels of `bin` above `threshold` and their eight neighbours.
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
        support.zero_outside(&mut dimmed);
        assert_eq!(dimmed.iter().sum::<f32>(), 13.0);
    }

    #[test]
    fn an_intersection_has_the_voxels_of_both() {
        let shape = Shape::new(1, 1, 4);
        let first = Support::from_mask(vec![1, 1, 0, 0], shape);
        let second = Support::from_mask(vec![0, 1, 1, 0], shape);
        assert_eq!(first.intersect(&second).mask(), [0, 1, 0, 0]);
        assert_eq!(first.intersect(&Support::full(shape)), first);
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
    fn lit_voxels_of_a_bin_stay_active() {
        let shape = Shape::new(2, 6, 6);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[7], video[36 + 7], video[28]) = (0.1, 0.1, 0.1);
        let mut mask = vec![0u8; shape.voxels()];
        (mask[7], mask[8], mask[36 + 7]) = (1, 1, 1);
        let before = Support::from_mask(mask, shape);
        let support = Support::above(&video, shape, &[1.0, 1.0]);
        let support = support.with_still_lit(&before, &video, 0.05, [0].into_iter());
        // Not the dark voxel 8, not voxel 28, which was inactive, and none of the other bin.
        assert_eq!(support.pixels_of(0), Some(vec![7]));
        assert_eq!(support.pixels_of(1), Some(vec![]));
    }

    #[test]
    fn threshold_zero_and_dense_bins_are_unrestricted() {
        let shape = Shape::new(2, 4, 4);
        let video: Vec<f32> = (0..32)
            .map(|i| if i % 16 < 4 { 1.0 } else { 0.0 })
            .collect();
        let support = Support::above(&video, shape, &[0.0, 0.5]);
        assert_eq!(support.pixels_of(0), None);
        assert_eq!(support.pixels_of(1), None);
    }
}
