//! Estimates the support: the set of active voxels (docs/design/007).

use super::tuning::Tuning;
use crate::{Shape, Support};
use rayon::prelude::*;

/// The bright voxels of a video and their neighbours, updated every few iterations.
///
/// A bin is unrestricted if all of its voxels are active. It is underfit if its support cannot explain its
/// measurements: the root mean square of its residual is too large and no longer falls.
pub(super) struct SupportEstimator {
    shape: Shape,
    tuning: Tuning,
    /// `None` before the first update.
    support: Option<Support>,
    /// The support with more unrestricted bins, see [`Self::data_support`].
    data_support: Option<Support>,
    fraction: f64,
    is_stable: bool,
    /// Most active voxels of a bin that is restricted in the data step; `usize::MAX` without large blocks.
    max_restricted: usize,
    /// How often each bin has been widened. A level above [`Tuning::unrestricted_level`] counts the updates down for
    /// which the bin stays unrestricted.
    levels: Vec<usize>,
    /// Root mean square of each bin's residual at the last update; infinite before the first one, and after a widening.
    residual_rms: Vec<f64>,
    /// Whether each bin is unrestricted.
    is_unrestricted: Vec<bool>,
}

impl SupportEstimator {
    /// All voxels of videos of `shape` are active at first.
    ///
    /// A bin with more than `max_restricted` active voxels is never restricted in the data step.
    pub fn new(shape: Shape, max_restricted: usize, tuning: &Tuning) -> Self {
        Self {
            shape,
            tuning: *tuning,
            support: None,
            data_support: None,
            fraction: 1.0,
            is_stable: false,
            max_restricted,
            levels: vec![0; shape.bins],
            residual_rms: vec![f64::INFINITY; shape.bins],
            is_unrestricted: vec![true; shape.bins],
        }
    }

    /// The support; `None`: every voxel.
    pub fn support(&self) -> Option<&Support> {
        self.support.as_ref()
    }

    /// The support of the data step, in which bins with more than `max_restricted` active voxels are unrestricted:
    /// their restricted blocks would take longer. The prior alone keeps the other voxels of such a bin at zero.
    pub fn data_support(&self) -> Option<&Support> {
        self.data_support.as_ref()
    }

    /// Part of the voxels that are active, from 0 to 1.
    pub fn fraction(&self) -> f64 {
        self.fraction
    }

    /// Whether some bin is unrestricted; a change of `ρ` then costs a factor of the bin's whole block.
    pub fn has_unrestricted_bin(&self) -> bool {
        self.is_unrestricted.contains(&true)
    }

    /// Whether the last update changed little and no bin is temporarily unrestricted.
    pub fn is_stable(&self) -> bool {
        self.is_stable
    }

    /// Prepares for another frame, which starts from the support of the last one.
    pub fn reset(&mut self) {
        self.is_stable = false;
        self.levels.fill(0);
        self.residual_rms.fill(f64::INFINITY);
    }

    /// The underfit bins: their `residual_rms` is above `reference` by [`Tuning::underfit_ratio`] and above
    /// [`Tuning::stall_ratio`] of the last one.
    ///
    /// Unrestricted bins are never underfit. `residual_rms` is kept for the next call.
    pub fn underfit_bins(&mut self, residual_rms: Vec<f64>, reference: f64) -> Vec<usize> {
        let is_underfit = |t: &usize| {
            let (now, before) = (residual_rms[*t], self.residual_rms[*t]);
            now > self.tuning.underfit_ratio * reference
                && now > self.tuning.stall_ratio * before
                && !self.is_unrestricted[*t]
        };
        let underfit_bins: Vec<usize> = (0..residual_rms.len()).filter(is_underfit).collect();
        self.residual_rms = residual_rms;
        for &t in &underfit_bins {
            self.residual_rms[t] = f64::INFINITY;
        }
        underfit_bins
    }

    /// Sets the support to the bright voxels of `video` and their neighbours, and returns it.
    ///
    /// The threshold is [`Tuning::support_threshold`] of `brightness`. In the `underfit_bins` it is lowered, and the voxels with
    /// the largest `correlation`, `Aᵀ(b − A v)`, are added.
    pub fn update(
        &mut self,
        video: &[f32],
        brightness: f64,
        correlation: &[f32],
        underfit_bins: &[usize],
    ) -> Support {
        self.widen(underfit_bins);
        let tuning = self.tuning;
        let threshold = |level: &usize| {
            if *level >= tuning.unrestricted_level {
                0.0
            } else {
                tuning.support_threshold * brightness * tuning.widening_factor.powi(*level as i32)
            }
        };
        let thresholds: Vec<f64> = self.levels.iter().map(threshold).collect();
        let support = Support::above(video, self.shape, &thresholds)
            .with_correlated(correlation, underfit_bins);
        let fraction = support.fraction();
        self.is_stable = self.support.is_some()
            && underfit_bins.is_empty()
            && fraction > tuning.stable_ratio * self.fraction
            && self
                .levels
                .iter()
                .all(|level| *level <= tuning.unrestricted_level);
        self.fraction = fraction;
        let bins = support.mask().par_chunks_exact(self.shape.pixels());
        self.is_unrestricted = bins.map(|bin| !bin.contains(&0)).collect();
        self.data_support = Some(
            support
                .clone()
                .with_crowded_bins_unrestricted(self.max_restricted),
        );
        self.support = Some(support.clone());
        support
    }

    /// Widens the `underfit_bins` by one level, or makes them unrestricted for [`Tuning::unrestricted_updates`]
    /// updates where blocks are large.
    ///
    /// The remaining updates of a temporarily unrestricted bin are counted down; after the last one its level is 0.
    fn widen(&mut self, underfit_bins: &[usize]) {
        let unrestricted = self.tuning.unrestricted_level;
        for level in self
            .levels
            .iter_mut()
            .filter(|level| **level > unrestricted)
        {
            *level -= 1;
            if *level == unrestricted {
                *level = 0;
            }
        }
        let has_large_blocks = self.max_restricted < usize::MAX;
        for &t in underfit_bins {
            self.levels[t] = if has_large_blocks {
                unrestricted + self.tuning.unrestricted_updates
            } else {
                self.levels[t] + 1
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bin_is_widened_once_its_residual_no_longer_falls() {
        let shape = Shape::new(2, 9, 9);
        let mut estimator = SupportEstimator::new(shape, usize::MAX, &Tuning::STANDARD);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[40], video[81 + 40]) = (1.0, 1.0);
        let mut faint = video.clone();
        faint[81 + 10] = 0.1;
        let support = estimator.update(&video, 1.0, &video, &[]);
        assert_eq!(support.fraction(), 2.0 * 9.0 / 162.0);
        assert!(!estimator.is_stable());
        // A first residual, one that falls, and one that has stalled: only the last is underfit, and not twice in a
        // row.
        assert!(estimator.underfit_bins(vec![1.0, 8.0], 1.0).is_empty());
        assert!(estimator.underfit_bins(vec![1.0, 4.0], 1.0).is_empty());
        assert_eq!(estimator.underfit_bins(vec![1.0, 3.9], 1.0), [1]);
        let support = estimator.update(&faint, 1.0, &faint, &[1]);
        assert_eq!(support.mask()[81 + 10], 1);
        assert!(!estimator.is_stable());
        assert!(estimator.underfit_bins(vec![1.0, 3.9], 1.0).is_empty());
        estimator.update(&faint, 1.0, &faint, &[]);
        assert!(estimator.is_stable());
        // After five widenings a bin is unrestricted and is not widened further.
        for _ in 0..4 {
            assert_eq!(estimator.underfit_bins(vec![1.0, 3.9], 1.0), [1]);
            estimator.update(&faint, 1.0, &faint, &[1]);
            estimator.underfit_bins(vec![1.0, 3.9], 1.0);
        }
        assert_eq!(estimator.support().unwrap().pixels_of(1), None);
        assert!(estimator.underfit_bins(vec![1.0, 3.9], 1.0).is_empty());
    }

    #[test]
    fn a_bin_of_a_large_sensor_is_unrestricted_for_a_while() {
        let shape = Shape::new(2, 9, 9);
        let mut estimator = SupportEstimator::new(shape, 50, &Tuning::STANDARD);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[40], video[81 + 40]) = (1.0, 1.0);
        estimator.update(&video, 1.0, &video, &[]);
        estimator.underfit_bins(vec![1.0, 4.0], 1.0);
        assert_eq!(estimator.underfit_bins(vec![1.0, 3.9], 1.0), [1]);
        estimator.update(&video, 1.0, &video, &[1]);
        for _ in 1..Tuning::STANDARD.unrestricted_updates {
            assert_eq!(estimator.support().unwrap().pixels_of(1), None);
            assert!(estimator.underfit_bins(vec![1.0, 3.9], 1.0).is_empty());
            estimator.update(&video, 1.0, &video, &[]);
            assert!(!estimator.is_stable());
        }
        estimator.update(&video, 1.0, &video, &[]);
        assert_eq!(estimator.support().unwrap().pixels_of(1).unwrap().len(), 9);
        estimator.update(&video, 1.0, &video, &[]);
        assert!(estimator.is_stable());
    }
}
