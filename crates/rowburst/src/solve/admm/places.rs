//! Where light may be.

use crate::{Shape, Support};

/// Iteration at which the support is found first, and from then on every so many.
const FIRST: usize = 20;
const EVERY: usize = 10;
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

/// The bright voxels of a video and their neighbours, found anew every few iterations.
pub(super) struct Places {
    shape: Shape,
    support: Option<Support>,
    fraction: f64,
    is_settled: bool,
    /// How often the support of each bin has been widened, and its misfit at the last look.
    levels: Vec<usize>,
    misfits: Vec<f64>,
}

impl Places {
    pub fn everywhere(shape: Shape) -> Self {
        Self {
            shape,
            support: None,
            fraction: 1.0,
            is_settled: false,
            levels: vec![0; shape.bins],
            misfits: vec![f64::INFINITY; shape.bins],
        }
    }

    /// Whether iteration `k` looks.
    pub fn are_due(k: usize) -> bool {
        k >= FIRST && (k - FIRST).is_multiple_of(EVERY)
    }

    /// `None`: every voxel.
    pub fn support(&self) -> Option<&Support> {
        self.support.as_ref()
    }

    /// Part of the voxels that may be lit.
    pub fn fraction(&self) -> f64 {
        self.fraction
    }

    /// Whether the last look changed little.
    pub fn are_settled(&self) -> bool {
        self.is_settled
    }

    /// Bins that the support cannot explain: their misfit is above `expected` and no longer falls.
    pub fn missed(&mut self, misfits: Vec<f64>, expected: f64) -> Vec<usize> {
        let is_missed = |t: &usize| {
            let (now, before) = (misfits[*t], self.misfits[*t]);
            now > MISFIT * expected && now > FALLING * before && self.levels[*t] < OPEN
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
        for &t in missed {
            self.levels[t] += 1;
        }
        let cut = |level: &usize| match *level {
            OPEN => 0.0,
            level => THRESHOLD * brightness * LEVEL_STEP.powi(level as i32),
        };
        let cuts: Vec<f64> = self.levels.iter().map(cut).collect();
        let support = Support::above(video, self.shape, &cuts).with_missed(correlation, missed);
        let fraction = support.fraction();
        self.is_settled =
            self.support.is_some() && missed.is_empty() && fraction > 0.9 * self.fraction;
        self.fraction = fraction;
        self.support = Some(support.clone());
        support
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bin_is_widened_once_its_misfit_no_longer_falls() {
        let shape = Shape::new(2, 9, 9);
        let mut places = Places::everywhere(shape);
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
}
