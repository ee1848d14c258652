//! Where light may be.

use crate::{Shape, Support};
use rayon::prelude::*;

/// Threshold of the support over the brightness of the video.
const THRESHOLD: f64 = 0.12;
/// Misfit of a bin over the bound at which its support is widened. The misfit of a bin
/// of 216 pixels scatters by 5 %.
const MISFIT: f64 = 1.3;
/// Misfit of a bin over that at the last look, below which it is still falling: a support that was
/// just found needs some iterations before it can be said to lack light.
const FALLING: f64 = 0.85;
/// What the threshold of a bin is multiplied by each time its support is widened, and
/// the level at which every voxel is allowed.
const LEVEL_STEP: f64 = 0.125;
const OPEN: usize = 5;
/// Looks for which a bin of a wide sensor is opened that its support cannot explain: its light takes
/// long to show, and the block of half of its voxels as long to factor as that of all.
const OPEN_FOR: usize = 5;

/// The bright voxels of a video and their neighbours, found anew every few iterations.
pub(super) struct Places {
    shape: Shape,
    support: Option<Support>,
    /// The same, but for bins that are left open in the data step.
    data_support: Option<Support>,
    fraction: f64,
    is_settled: bool,
    /// Most voxels of a bin that the data step is restricted to.
    most: usize,
    /// How often the support of each bin has been widened, and its misfit at the last look.
    levels: Vec<usize>,
    misfits: Vec<f64>,
    /// Bins of which every voxel is allowed: no support of theirs lacks light.
    is_open: Vec<bool>,
}

impl Places {
    /// Iteration at which the support is found first: the video has taken shape.
    pub const FIRST: usize = 20;

    /// Iterations from one look to the next.
    pub const EVERY: usize = 10;

    /// All of videos of `shape`; later at most `most` of a bin, or all.
    pub fn everywhere(shape: Shape, most: usize) -> Self {
        Self {
            shape,
            support: None,
            data_support: None,
            fraction: 1.0,
            is_settled: false,
            most,
            levels: vec![0; shape.bins],
            misfits: vec![f64::INFINITY; shape.bins],
            is_open: vec![true; shape.bins],
        }
    }

    /// Whether iteration `k` looks.
    pub fn are_due(k: usize) -> bool {
        k >= Self::FIRST && (k - Self::FIRST).is_multiple_of(Self::EVERY)
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
    pub fn are_settled(&self) -> bool {
        self.is_settled
    }

    /// Another frame is to be explained, from the places of the last one.
    pub fn unsettle(&mut self) {
        self.is_settled = false;
        self.levels.fill(0);
        self.misfits.fill(f64::INFINITY);
    }

    /// Bins that the support cannot explain: their misfit is above `expected` and no longer falls.
    pub fn missed(&mut self, misfits: Vec<f64>, expected: f64) -> Vec<usize> {
        let is_missed = |t: &usize| {
            let (now, before) = (misfits[*t], self.misfits[*t]);
            now > MISFIT * expected && now > FALLING * before && !self.is_open[*t]
        };
        let missed: Vec<usize> = (0..misfits.len()).filter(is_missed).collect();
        self.misfits = misfits;
        for &t in &missed {
            self.misfits[t] = f64::INFINITY;
        }
        missed
    }

    /// The bright voxels of `video` with neighbours. The threshold of the bins `missed` falls, and the
    /// brightest places of `correlation` are added to them.
    pub fn find(
        &mut self,
        video: &[f32],
        brightness: f64,
        (correlation, missed): (&[f32], &[usize]),
    ) -> Support {
        self.widen(missed);
        let cut = |level: &usize| match *level {
            OPEN.. => 0.0,
            level => THRESHOLD * brightness * LEVEL_STEP.powi(level as i32),
        };
        let cuts: Vec<f64> = self.levels.iter().map(cut).collect();
        let support = Support::above(video, self.shape, &cuts).with_missed(correlation, missed);
        let fraction = support.fraction();
        self.is_settled = self.support.is_some()
            && missed.is_empty()
            && fraction > 0.9 * self.fraction
            && self.levels.iter().all(|level| *level <= OPEN);
        self.fraction = fraction;
        let bins = support.mask().par_chunks_exact(self.shape.pixels());
        self.is_open = bins.map(|bin| !bin.contains(&0)).collect();
        self.data_support = Some(support.clone().opening_above(self.most));
        self.support = Some(support.clone());
        support
    }

    /// Allows more of the bins `missed`. Levels above [`OPEN`] count the looks of a bin that is open
    /// for a while.
    fn widen(&mut self, missed: &[usize]) {
        for level in self.levels.iter_mut().filter(|level| **level > OPEN) {
            *level -= 1;
            if *level == OPEN {
                *level = 0;
            }
        }
        let is_wide = self.most < usize::MAX;
        for &t in missed {
            self.levels[t] = if is_wide {
                OPEN + OPEN_FOR
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
        let mut places = Places::everywhere(shape, usize::MAX);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[40], video[81 + 40]) = (1.0, 1.0);
        let mut faint = video.clone();
        faint[81 + 10] = 0.1;
        let support = places.find(&video, 1.0, (&video, &[]));
        assert_eq!(support.fraction(), 2.0 * 9.0 / 162.0);
        assert!(!places.are_settled());
        // No look before, still falling, no longer: only then, and not at once again.
        assert!(places.missed(vec![1.0, 8.0], 1.0).is_empty());
        assert!(places.missed(vec![1.0, 4.0], 1.0).is_empty());
        assert_eq!(places.missed(vec![1.0, 3.9], 1.0), [1]);
        let support = places.find(&faint, 1.0, (&faint, &[1]));
        assert_eq!(support.mask()[81 + 10], 1);
        assert!(!places.are_settled());
        assert!(places.missed(vec![1.0, 3.9], 1.0).is_empty());
        places.find(&faint, 1.0, (&faint, &[]));
        assert!(places.are_settled());
        // Widened five times, a bin is open, and is not widened further.
        for _ in 0..4 {
            assert_eq!(places.missed(vec![1.0, 3.9], 1.0), [1]);
            places.find(&faint, 1.0, (&faint, &[1]));
            places.missed(vec![1.0, 3.9], 1.0);
        }
        assert_eq!(places.support().unwrap().pixels_of(1), None);
        assert!(places.missed(vec![1.0, 3.9], 1.0).is_empty());
    }

    #[test]
    fn a_bin_of_a_wide_sensor_is_opened_for_a_while() {
        let shape = Shape::new(2, 9, 9);
        let mut places = Places::everywhere(shape, 50);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[40], video[81 + 40]) = (1.0, 1.0);
        places.find(&video, 1.0, (&video, &[]));
        places.missed(vec![1.0, 4.0], 1.0);
        assert_eq!(places.missed(vec![1.0, 3.9], 1.0), [1]);
        places.find(&video, 1.0, (&video, &[1]));
        for _ in 1..OPEN_FOR {
            assert_eq!(places.support().unwrap().pixels_of(1), None);
            assert!(places.missed(vec![1.0, 3.9], 1.0).is_empty());
            places.find(&video, 1.0, (&video, &[]));
            assert!(!places.are_settled());
        }
        places.find(&video, 1.0, (&video, &[]));
        assert_eq!(places.support().unwrap().pixels_of(1).unwrap().len(), 9);
        places.find(&video, 1.0, (&video, &[]));
        assert!(places.are_settled());
    }
}
