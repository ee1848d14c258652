//! Estimates the support: the set of active voxels (docs/design/007).

use super::brightness::brightness;
use super::tuning::{KindTuning, Tuning};
use crate::DataHints;
use rayon::prelude::*;
use rowburst_core::{Shape, Support};
use std::num::NonZeroUsize;

/// The bright voxels of a video and their neighbours, updated every few iterations.
///
/// A bin is unrestricted if all of its voxels are active. It is underfit if its support cannot explain its
/// measurements: the root mean square of its residual is too large and no longer falls. A bin is crowded if its x-step
/// takes all voxels though some are inactive, see [`Self::x_step_support`].
#[derive(Clone)]
pub(super) struct SupportEstimator {
    shape: Shape,
    tuning: Tuning,
    /// `None` before the first update.
    support: Option<Support>,
    /// The support with more unrestricted bins, see [`Self::x_step_support`].
    x_step_support: Option<Support>,
    fraction: f64,
    is_stable: bool,
    /// See [`DataHints::max_restricted_voxels`].
    max_restricted_voxels: usize,
    kind_tuning: KindTuning,
    bins: Vec<BinState>,
    /// Root mean square of each bin's residual at the last update; infinite before the first one, and after a widening.
    residual_rms: Vec<f64>,
    /// Whether each bin is unrestricted.
    is_unrestricted: Vec<bool>,
}

/// What underfit bins have become.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum BinState {
    /// Its threshold was lowered so many times; from [`KindTuning::unrestricted_level`] on all of its voxels are active.
    Widened(usize),
    /// Its light was still spread at the first restriction: its threshold is lowered once, up to the next update.
    Spread,
}

impl BinState {
    /// As long as a bin was never underfit.
    const INITIAL: Self = Self::Widened(0);

    /// The state at the next update.
    fn at_next_update(self) -> Self {
        match self {
            Self::Spread => Self::INITIAL,
            Self::Widened(_) => self,
        }
    }

    /// The state of a bin that is underfit.
    fn widened(self) -> Self {
        match self {
            Self::Widened(times) => Self::Widened(times + 1),
            Self::Spread => Self::Widened(1),
        }
    }

    /// Whether the bin was widened as often as it may be.
    fn is_widest(self, tuning: &KindTuning) -> bool {
        let most = tuning.max_widenings.map_or(usize::MAX, NonZeroUsize::get);
        matches!(self, Self::Widened(times) if times >= most)
    }

    /// The threshold over that of a bin that was never underfit; 0: all voxels are active.
    fn threshold_ratio(self, tuning: &KindTuning) -> f64 {
        let is_restricted = |times| {
            tuning
                .unrestricted_level
                .is_none_or(|level| times < level.get())
        };
        match self {
            Self::Widened(times) if is_restricted(times) => {
                tuning.widening_factor.powi(times as i32)
            }
            Self::Spread => tuning.widening_factor,
            _ => 0.0,
        }
    }
}

/// The bins that their support cannot explain.
#[derive(Debug, Clone, Copy)]
pub(super) struct Underfit<'a> {
    /// Indices of the bins; at least one.
    pub bins: &'a [usize],
    /// `Aᵀ(b − A v)`, which is largest where the video lacks light.
    pub correlation: &'a [f32],
}

impl SupportEstimator {
    /// All voxels of videos of `shape` are active at first.
    ///
    /// A bin with more than [`DataHints::max_restricted_voxels`] is never restricted in the x-step.
    pub fn new(shape: Shape, hints: DataHints, tuning: &Tuning) -> Self {
        Self {
            shape,
            tuning: *tuning,
            support: None,
            x_step_support: None,
            fraction: 1.0,
            is_stable: false,
            max_restricted_voxels: hints.max_restricted_voxels,
            kind_tuning: *tuning.for_kind(hints.kind),
            bins: vec![BinState::INITIAL; shape.bins],
            residual_rms: vec![f64::INFINITY; shape.bins],
            is_unrestricted: vec![true; shape.bins],
        }
    }

    /// The support; `None`: every voxel.
    pub fn support(&self) -> Option<&Support> {
        self.support.as_ref()
    }

    /// The support of the x-step, which has all voxels of crowded bins: those with more active ones than
    /// [`DataHints::max_restricted_voxels`], whose restricted blocks would take longer. The prior alone keeps the
    /// inactive voxels of such a bin at zero.
    pub fn x_step_support(&self) -> Option<&Support> {
        self.x_step_support.as_ref()
    }

    /// Part of the voxels that are active, from 0 to 1.
    pub fn fraction(&self) -> f64 {
        self.fraction
    }

    /// Whether some bin is unrestricted; a change of `ρ` then costs a factor of the bin's whole block. Crowded bins,
    /// which cost the same, do not count.
    pub fn has_unrestricted_bin(&self) -> bool {
        self.is_unrestricted.contains(&true)
    }

    /// Whether few voxels became inactive in the last update, no bin was widened, and none is spread.
    pub fn is_stable(&self) -> bool {
        self.is_stable
    }

    /// Lets the support change again.
    pub fn allow_changes(&mut self) {
        self.is_stable = false;
    }

    /// Prepares for another frame, which starts from the support of the last one.
    pub fn forget_underfit_bins(&mut self) {
        self.bins.fill(BinState::INITIAL);
        self.residual_rms.fill(f64::INFINITY);
    }

    /// The underfit bins: their `residual_rms` is above `reference` by [`Tuning::underfit_ratio`] and above
    /// [`Tuning::stall_ratio`] of the last one.
    ///
    /// Unrestricted bins are never underfit, nor are those that were widened [`KindTuning::max_widenings`] times.
    /// `residual_rms` is kept for the next call.
    pub fn underfit_bins(&mut self, residual_rms: Vec<f64>, reference: f64) -> Vec<usize> {
        let is_underfit = |t: &usize| {
            let (now, before) = (residual_rms[*t], self.residual_rms[*t]);
            now > self.tuning.underfit_ratio * reference
                && now > self.tuning.stall_ratio * before
                && !self.is_unrestricted[*t]
                && !self.bins[*t].is_widest(&self.kind_tuning)
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
    /// The threshold is [`Tuning::support_threshold`] of `brightness`, or of a dimmer bin's own, see
    /// [`KindTuning::min_bin_brightness`]. In the bins of `underfit` it is lowered, and the voxels with the largest
    /// correlation are added. Of bins that were
    /// widened, active voxels stay active while they are above [`KindTuning::kept_threshold`] of `brightness`. At the
    /// first update the threshold is lowered, too, in bins that would lose much of their light, up to the next update.
    pub fn update(
        &mut self,
        video: &[f32],
        brightness: f64,
        underfit: Option<Underfit>,
    ) -> Support {
        let underfit_bins = underfit.map_or(&[][..], |underfit| underfit.bins);
        self.widen(underfit_bins);
        let tuning = self.tuning;
        let threshold = tuning.support_threshold * brightness;
        if self.support.is_none() {
            self.find_spread_bins(video, threshold);
        }
        let kind_tuning = self.kind_tuning;
        let bins = self
            .bins
            .iter()
            .zip(video.chunks_exact(self.shape.pixels()));
        let thresholds: Vec<f64> = bins
            .map(|(state, bin)| {
                let ratio = state.threshold_ratio(&kind_tuning);
                threshold * ratio * bin_brightness_ratio(bin, brightness, &kind_tuning)
            })
            .collect();
        let mut support = Support::above(video, self.shape, &thresholds);
        if let Some(before) = &self.support {
            let widened = (0..self.shape.bins).filter(|&t| self.bins[t] != BinState::INITIAL);
            let kept = kind_tuning.kept_threshold * brightness;
            support = support.with_still_lit(before, video, kept as f32, widened);
        }
        if let Some(Underfit { bins, correlation }) = underfit {
            support = support.with_correlated(correlation, bins);
        }
        let fraction = support.fraction();
        self.is_stable = self.support.is_some()
            && underfit_bins.is_empty()
            && fraction > tuning.stable_ratio * self.fraction
            && self
                .bins
                .iter()
                .all(|bin| matches!(bin, BinState::Widened(_)));
        self.fraction = fraction;
        let bins = support.mask().par_chunks_exact(self.shape.pixels());
        self.is_unrestricted = bins.map(|bin| !bin.contains(&0)).collect();
        self.x_step_support = Some(
            support
                .clone()
                .with_crowded_bins_unrestricted(self.max_restricted_voxels),
        );
        self.support = Some(support.clone());
        support
    }

    /// Finds the bins that have more than [`KindTuning::max_cut_light`] of their light at or below `threshold`: it is still
    /// spread, as where few pixels of a bin are usable.
    fn find_spread_bins(&mut self, video: &[f32], threshold: f64) {
        let bins = video.chunks_exact(self.shape.pixels());
        for (state, bin) in self.bins.iter_mut().zip(bins) {
            let light = |is_counted: &dyn Fn(f64) -> bool| -> f64 {
                let values = bin.iter().map(|v| f64::from(*v));
                values.filter(|v| is_counted(*v)).sum()
            };
            let cut = light(&|v| v <= threshold);
            if cut > self.kind_tuning.max_cut_light * light(&|_| true) {
                *state = BinState::Spread;
            }
        }
    }

    /// Widens the `underfit_bins`, and ends the time of spread ones.
    fn widen(&mut self, underfit_bins: &[usize]) {
        for bin in &mut self.bins {
            *bin = bin.at_next_update();
        }
        for &t in underfit_bins {
            self.bins[t] = self.bins[t].widened();
        }
    }
}

/// Brightness of a bin over `of_video`, the capped one of the video, from [`KindTuning::min_bin_brightness`] to 1.
fn bin_brightness_ratio(bin: &[f32], of_video: f64, tuning: &KindTuning) -> f64 {
    if tuning.min_bin_brightness >= 1.0 {
        return 1.0;
    }
    let ratio = brightness(bin) / of_video;
    ratio.max(tuning.min_bin_brightness).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ProblemKind;

    fn second_bin(correlation: &[f32]) -> Option<Underfit<'_>> {
        Some(Underfit {
            bins: &[1],
            correlation,
        })
    }

    #[test]
    fn a_bin_is_widened_once_its_residual_no_longer_falls() {
        let shape = Shape::new(2, 9, 9);
        let mut estimator = SupportEstimator::new(shape, DataHints::default(), &Tuning::STANDARD);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[40], video[81 + 40]) = (1.0, 1.0);
        let mut faint = video.clone();
        faint[81 + 10] = 0.1;
        let support = estimator.update(&video, 1.0, None);
        assert_eq!(support.fraction(), 2.0 * 9.0 / 162.0);
        assert!(!estimator.is_stable());
        // A first residual, one that falls, and one that has stalled: only the last is underfit, and not twice in a
        // row.
        assert!(estimator.underfit_bins(vec![1.0, 8.0], 1.0).is_empty());
        assert!(estimator.underfit_bins(vec![1.0, 4.0], 1.0).is_empty());
        assert_eq!(estimator.underfit_bins(vec![1.0, 3.9], 1.0), [1]);
        let support = estimator.update(&faint, 1.0, second_bin(&faint));
        assert_eq!(support.mask()[81 + 10], 1);
        assert!(!estimator.is_stable());
        assert!(estimator.underfit_bins(vec![1.0, 3.9], 1.0).is_empty());
        estimator.update(&faint, 1.0, None);
        assert!(estimator.is_stable());
        // After five widenings a bin is unrestricted and is not widened further.
        for _ in 0..4 {
            assert_eq!(estimator.underfit_bins(vec![1.0, 3.9], 1.0), [1]);
            estimator.update(&faint, 1.0, second_bin(&faint));
            estimator.underfit_bins(vec![1.0, 3.9], 1.0);
        }
        assert_eq!(estimator.support().unwrap().pixels_of(1), None);
        assert!(estimator.underfit_bins(vec![1.0, 3.9], 1.0).is_empty());
    }

    #[test]
    fn a_bin_whose_light_is_still_spread_loses_it_later() {
        let shape = Shape::new(2, 9, 9);
        let mut video = vec![0.0f32; shape.voxels()];
        // A quarter of the light of the second bin is below the threshold, which is 0.12.
        (video[40], video[81 + 40], video[81 + 10]) = (1.0, 0.3, 0.1);
        for (kind, stays) in [(ProblemKind::Small, true), (ProblemKind::Coupled, false)] {
            let hints = DataHints {
                kind,
                ..DataHints::default()
            };
            let mut tuning = Tuning::STANDARD;
            tuning.coupled.min_bin_brightness = 1.0;
            let mut estimator = SupportEstimator::new(shape, hints, &tuning);
            let support = estimator.update(&video, 1.0, None);
            assert_eq!(support.mask()[81 + 10] == 1, stays, "{kind:?}");
            assert_eq!(support.pixels_of(0).unwrap().len(), 9);
            // The light that has not gathered by the next update is haze.
            let support = estimator.update(&video, 1.0, None);
            assert_eq!(support.mask()[81 + 10], 0, "{kind:?}");
        }
    }

    #[test]
    fn a_widened_bin_of_coupled_rows_keeps_added_voxels_that_show_light() {
        let shape = Shape::new(2, 9, 9);
        let hints = DataHints {
            kind: ProblemKind::Coupled,
            ..DataHints::default()
        };
        let mut estimator = SupportEstimator::new(shape, hints, &Tuning::STANDARD);
        let mut video = vec![0.0f32; shape.voxels()];
        (video[40], video[81 + 40]) = (1.0, 1.0);
        estimator.update(&video, 1.0, None);
        let mut lacking = vec![0.0f32; shape.voxels()];
        lacking[81 + 10] = 1.0;
        estimator.update(&video, 1.0, second_bin(&lacking));
        // Light of a hundredth is far below the threshold.
        video[81 + 10] = 0.01;
        let support = estimator.update(&video, 1.0, None);
        assert_eq!(support.mask()[81 + 10], 1);
        assert_eq!(support.pixels_of(1).unwrap().len(), 9 + 1);
        // It is widened four times at most, and not unrestricted.
        estimator.underfit_bins(vec![1.0, 9.0], 1.0);
        for times in 1..9 {
            let underfit = estimator.underfit_bins(vec![1.0, 9.0], 1.0);
            assert_eq!(underfit.is_empty(), times >= 4, "{times}");
            let lacking = second_bin(&lacking).filter(|_| !underfit.is_empty());
            estimator.update(&video, 1.0, lacking);
            estimator.underfit_bins(vec![1.0, 9.0], 1.0);
        }
        assert!(estimator.support().unwrap().pixels_of(1).is_some());
    }

    #[test]
    fn faint_light_stays_in_dim_bins_of_coupled_rows() {
        let shape = Shape::new(3, 9, 9);
        let mut video = vec![0.0f32; shape.voxels()];
        // The threshold is 0.12; in the second bin, which is dimmer, 0.024, and in a third, dark one 0.012.
        (video[40], video[81 + 40], video[81 + 10]) = (1.0, 0.2, 0.05);
        (video[162 + 40], video[162 + 16]) = (0.015, 0.01);
        for (kind, stays) in [(ProblemKind::Small, false), (ProblemKind::Coupled, true)] {
            let hints = DataHints {
                kind,
                ..DataHints::default()
            };
            let mut tuning = Tuning::STANDARD;
            tuning.small.max_cut_light = 1.0;
            let mut estimator = SupportEstimator::new(shape, hints, &tuning);
            let support = estimator.update(&video, 1.0, None);
            assert_eq!(support.mask()[81 + 10] == 1, stays, "{kind:?}");
            assert_eq!(support.mask()[162 + 40] == 1, stays, "{kind:?}");
            assert_eq!(support.mask()[162 + 16], 0, "{kind:?}");
        }
    }
}
