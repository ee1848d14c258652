//! Where light may be.

use crate::{Shape, Support};
use rayon::prelude::*;

/// Threshold of the support over the brightness of the video.
const THRESHOLD: f64 = 0.12;
/// Misfit of a bin over the bound at which its support is widened. The misfit of a bin
/// of 216 pixels scatters by 5 %.
const UNDERFIT_RATIO: f64 = 1.3;
/// Misfit of a bin over that at the last look, below which it is still falling: a support that was
/// just found needs some iterations before it can be said to lack light.
const STALL_RATIO: f64 = 0.85;
/// What the threshold of a bin is multiplied by each time its support is widened, and
/// the level at which every voxel is allowed.
const THRESHOLD_FACTOR: f64 = 0.125;
const OPEN_LEVEL: usize = 5;
/// Looks for which a bin of a wide sensor is opened that its support cannot explain: its light takes
/// long to show, and the block of half of its voxels as long to factor as that of all.
const OPEN_UPDATES: usize = 5;

/// The bright voxels of a video and their neighbours, found anew every few iterations.
pub(super) struct SupportEstimator {
    shape: Shape,
    support: Option<Support>,
    /// The same, but for bins that are left open in the data step.
    data_support: Option<Support>,
    fraction: f64,
    is_settled: bool,
    /// Most voxels of a bin that the data step is restricted to.
    max_active: usize,
    /// How often the support of each bin has been widened, and its misfit at the last look.
    levels: Vec<usize>,
    misfits: Vec<f64>,
    /// Bins of which every voxel is allowed: no support of theirs lacks light.
    is_open: Vec<bool>,
}

impl SupportEstimator {
    /// Iteration at which the support is found first: the video has taken shape.
    pub const FIRST_UPDATE: usize = 20;

    /// Iterations from one look to the next.
    pub const UPDATE_INTERVAL: usize = 10;

    /// All of videos of `shape`; later at most `max_active` of a bin, or all.
    pub fn new(shape: Shape, max_active: usize) -> Self {
        Self {
            shape,
            support: None,
            data_support: None,
            fraction: 1.0,
            is_settled: false,
            max_active,
            levels: vec![0; shape.bins],
            misfits: vec![f64::INFINITY; shape.bins],
            is_open: vec![true; shape.bins],
        }
    }

    /// Whether iteration `k` looks.
    pub fn is_due(k: usize) -> bool {
        k >= Self::FIRST_UPDATE && (k - Self::FIRST_UPDATE).is_multiple_of(Self::UPDATE_INTERVAL)
    }

    /// `None`: every voxel.
    pub fn support(&self) -> Option<&Support> {
        self.support.as_ref()
    }

    /// The places that the data step knows of: where a bin has too many for a block of them all of it,
    /// and the prior alone keeps the rest dark.
    pub fn data_support(&self) -> Option<&Support> {
        self.data_support.as_ref()
    }

    /// Part of the voxels that may be lit.
    pub fn fraction(&self) -> f64 {
        self.fraction
    }

    /// Whether every voxel of a bin is allowed, so that another `ρ` costs a factor of all its measurements.
    pub fn has_open_bin(&self) -> bool {
        self.is_open.contains(&true)
    }

    /// Whether the last look changed little.
    pub fn is_settled(&self) -> bool {
        self.is_settled
    }

    /// Another frame is to be explained, from the places of the last one.
    pub fn reset(&mut self) {
        self.is_settled = false;
        self.levels.fill(0);
        self.misfits.fill(f64::INFINITY);
    }

    /// Bins that the support cannot explain: their misfit is above `expected` and no longer falls.
    pub fn underfit_bins(&mut self, misfits: Vec<f64>, expected: f64) -> Vec<usize> {
        let is_underfit = |t: &usize| {
            let (now, before) = (misfits[*t], self.misfits[*t]);
            now > UNDERFIT_RATIO * expected && now > STALL_RATIO * before && !self.is_open[*t]
        };
        let underfit_bins: Vec<usize> = (0..misfits.len()).filter(is_underfit).collect();
        self.misfits = misfits;
        for &t in &underfit_bins {
            self.misfits[t] = f64::INFINITY;
        }
        underfit_bins
    }

    /// The bright voxels of `video` with neighbours. The threshold of the bins `underfit_bins` falls, and the
    /// brightest places of `correlation` are added to them.
    pub fn update(
        &mut self,
        video: &[f32],
        brightness: f64,
        (correlation, underfit_bins): (&[f32], &[usize]),
    ) -> Support {
        self.widen(underfit_bins);
        let threshold = |level: &usize| match *level {
            OPEN_LEVEL.. => 0.0,
            level => THRESHOLD * brightness * THRESHOLD_FACTOR.powi(level as i32),
        };
        let thresholds: Vec<f64> = self.levels.iter().map(threshold).collect();
        let support = Support::above(video, self.shape, &thresholds)
            .with_correlated(correlation, underfit_bins);
        let fraction = support.fraction();
        self.is_settled = self.support.is_some()
            && underfit_bins.is_empty()
            && fraction > 0.9 * self.fraction
            && self.levels.iter().all(|level| *level <= OPEN_LEVEL);
        self.fraction = fraction;
        let bins = support.mask().par_chunks_exact(self.shape.pixels());
        self.is_open = bins.map(|bin| !bin.contains(&0)).collect();
        self.data_support = Some(support.clone().with_crowded_bins_open(self.max_active));
        self.support = Some(support.clone());
        support
    }

    /// Allows more of the bins `underfit_bins`. Levels above [`OPEN_LEVEL`] count the looks of a bin that is open
    /// for a while.
    fn widen(&mut self, underfit_bins: &[usize]) {
        for level in self.levels.iter_mut().filter(|level| **level > OPEN_LEVEL) {
            *level -= 1;
            if *level == OPEN_LEVEL {
                *level = 0;
            }
        }
        let has_large_blocks = self.max_active < usize::MAX;
        for &t in underfit_bins {
            self.levels[t] = if has_large_blocks {
                OPEN_LEVEL + OPEN_UPDATES
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
    fn a_bin_is_widened_once_its_misfit_no_longer_falls() {
        let shape = Shape::new(2, 9, 9);
        let mut estimator = SupportEstimator::new(shape, usize::MAX);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[40], video[81 + 40]) = (1.0, 1.0);
        let mut faint = video.clone();
        faint[81 + 10] = 0.1;
        let support = estimator.update(&video, 1.0, (&video, &[]));
        assert_eq!(support.fraction(), 2.0 * 9.0 / 162.0);
        assert!(!estimator.is_settled());
        // No look before, still falling, no longer: only then, and not at once again.
        assert!(estimator.underfit_bins(vec![1.0, 8.0], 1.0).is_empty());
        assert!(estimator.underfit_bins(vec![1.0, 4.0], 1.0).is_empty());
        assert_eq!(estimator.underfit_bins(vec![1.0, 3.9], 1.0), [1]);
        let support = estimator.update(&faint, 1.0, (&faint, &[1]));
        assert_eq!(support.mask()[81 + 10], 1);
        assert!(!estimator.is_settled());
        assert!(estimator.underfit_bins(vec![1.0, 3.9], 1.0).is_empty());
        estimator.update(&faint, 1.0, (&faint, &[]));
        assert!(estimator.is_settled());
        // Widened five times, a bin is open, and is not widened further.
        for _ in 0..4 {
            assert_eq!(estimator.underfit_bins(vec![1.0, 3.9], 1.0), [1]);
            estimator.update(&faint, 1.0, (&faint, &[1]));
            estimator.underfit_bins(vec![1.0, 3.9], 1.0);
        }
        assert_eq!(estimator.support().unwrap().pixels_of(1), None);
        assert!(estimator.underfit_bins(vec![1.0, 3.9], 1.0).is_empty());
    }

    #[test]
    fn a_bin_of_a_large_sensor_is_opened_for_a_while() {
        let shape = Shape::new(2, 9, 9);
        let mut estimator = SupportEstimator::new(shape, 50);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[40], video[81 + 40]) = (1.0, 1.0);
        estimator.update(&video, 1.0, (&video, &[]));
        estimator.underfit_bins(vec![1.0, 4.0], 1.0);
        assert_eq!(estimator.underfit_bins(vec![1.0, 3.9], 1.0), [1]);
        estimator.update(&video, 1.0, (&video, &[1]));
        for _ in 1..OPEN_UPDATES {
            assert_eq!(estimator.support().unwrap().pixels_of(1), None);
            assert!(estimator.underfit_bins(vec![1.0, 3.9], 1.0).is_empty());
            estimator.update(&video, 1.0, (&video, &[]));
            assert!(!estimator.is_settled());
        }
        estimator.update(&video, 1.0, (&video, &[]));
        assert_eq!(estimator.support().unwrap().pixels_of(1).unwrap().len(), 9);
        estimator.update(&video, 1.0, (&video, &[]));
        assert!(estimator.is_settled());
    }
}
