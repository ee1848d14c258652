//! The phases of a run, and what ends each of them.

use super::brightness::brightness;
use super::tuning::{KindTuning, Tuning};
use crate::ProblemKind;
use rowburst_core::Shape;

/// What a run is doing.
///
/// A *step* is an iteration that brings the run forward: all but those that a wait repeats. Each update is due at certain
/// steps, so a wait or a warm start, which go back some steps, repeat the updates of these.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    /// The video takes shape while `β` falls. Ends at step [`KindTuning::first_restriction`].
    WarmUp,
    /// The warm-up of a video that takes shape slowly. Repeats the last [`Tuning::decline_window`] steps of the warm-up while
    /// one of two reasons holds. The limits count the repeated steps, see [`Schedule::steps_with_repeats`].
    ///
    /// - With hundreds of voxels for each pixel of the frame bins still get brighter where others do not change any more, and a
    ///   restriction would cut off light that still rises. Holds until every bin has become darker over a window or was found
    ///   dark, at most up to [`Tuning::latest_first_restriction`].
    /// - An extended scene, see [`super::controllers::Controllers::extent`], is still haze, which a restriction would keep. Holds
    ///   until it is no longer extended, at most up to [`KindTuning::latest_extended_restriction`].
    Waiting,
    /// The video is restricted to its support, and `β` follows its brightness. Ends at step [`KindTuning::settled_from`].
    Settling,
    /// `β` is constant, and the run stops as soon as its certificate permits. Ends with the run.
    Settled,
}

/// The position of a run in its phases.
#[derive(Clone)]
pub(super) struct Schedule {
    phase: Phase,
    /// Steps done, see [`Phase`].
    step: usize,
    /// Steps that waits have repeated.
    repeated_steps: usize,
    /// Iterations done since the start of the run or of the present frame.
    iterations: usize,
    tuning: Tuning,
    kind_tuning: KindTuning,
}

impl Schedule {
    pub fn new(tuning: &Tuning, kind: ProblemKind) -> Self {
        Self {
            phase: Phase::WarmUp,
            step: 0,
            repeated_steps: 0,
            iterations: 0,
            tuning: *tuning,
            kind_tuning: *tuning.for_kind(kind),
        }
    }

    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// Steps done.
    pub fn step(&self) -> usize {
        self.step
    }

    /// Steps done, those that a wait has repeated counted each time. Also counts the steps of earlier frames.
    pub fn steps_with_repeats(&self) -> usize {
        self.step + self.repeated_steps
    }

    /// Iterations done.
    pub fn iterations(&self) -> usize {
        self.iterations
    }

    /// Whether the video is still taking shape.
    pub fn is_warming_up(&self) -> bool {
        matches!(self.phase, Phase::WarmUp | Phase::Waiting)
    }

    /// Whether the step of the first restriction is reached, though the video may wait.
    pub fn has_reached_first_restriction(&self) -> bool {
        self.phase != Phase::WarmUp || self.step >= self.kind_tuning.first_restriction
    }

    /// Whether the step is a multiple of `interval`.
    pub fn is_multiple_of(&self, interval: usize) -> bool {
        self.step.is_multiple_of(interval)
    }

    /// Counts an iteration.
    pub fn finish_iteration(&mut self) {
        self.iterations += 1;
        self.step += 1;
    }

    /// Whether all steps of the warm-up are done, and the video is restricted now or waits.
    pub fn is_at_end_of_warm_up(&self) -> bool {
        self.is_warming_up() && self.step >= self.kind_tuning.first_restriction
    }

    /// Enters the next phase if the present one has ended. At the end of the warm-up `must_wait` repeats its last steps.
    pub fn advance(&mut self, must_wait: bool) {
        if self.is_at_end_of_warm_up() && must_wait {
            self.phase = Phase::Waiting;
            let repeated = self.tuning.decline_window.min(self.step);
            self.step -= repeated;
            self.repeated_steps += repeated;
        } else if self.is_at_end_of_warm_up() {
            self.phase = Phase::Settling;
        } else if self.phase == Phase::Settling && self.step >= self.kind_tuning.settled_from {
            self.phase = Phase::Settled;
        }
    }

    /// Begins another frame. At most the steps after [`KindTuning::warm_start_step`] are repeated, and the next update of
    /// the support comes when it would have come without a new frame.
    pub fn warm_start(&mut self) {
        let start = self.kind_tuning.warm_start_step;
        let past_start = self.step.saturating_sub(start);
        self.step = self.step.min(start) + past_start % self.tuning.support_interval;
        self.iterations = 0;
        if self.step < self.kind_tuning.first_restriction {
            self.phase = Phase::WarmUp;
        } else if !self.is_warming_up() {
            self.phase = Phase::Settling;
        }
    }
}

/// Watches the brightness of each bin until it falls. A bin without light counts as fallen, already at the first look.
#[derive(Clone)]
pub(super) struct DeclineDetector {
    /// Relative fall that counts.
    decline: f64,
    /// Brightness of each bin at the last look; 0 once it has fallen or was dark.
    rising_brightness: Vec<f64>,
}

impl DeclineDetector {
    pub fn new(bins: usize, tuning: &Tuning) -> Self {
        Self {
            decline: tuning.decline,
            rising_brightness: vec![f64::MIN_POSITIVE; bins],
        }
    }

    /// Whether some bin of `video` has had light at every call, and has not yet become darker from one to the next.
    pub fn is_rising(&mut self, video: &[f32], shape: Shape) -> bool {
        let bins = video.chunks_exact(shape.pixels());
        for (before, bin) in self.rising_brightness.iter_mut().zip(bins) {
            if *before > 0.0 {
                let now = brightness(bin);
                *before = if now > (1.0 - self.decline) * *before {
                    now
                } else {
                    0.0
                };
            }
        }
        self.rising_brightness.iter().any(|before| *before > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The phase of each iteration from the second on, with `must_wait` by iterations done.
    fn phases(
        schedule: &mut Schedule,
        count: usize,
        must_wait: impl Fn(usize) -> bool,
    ) -> Vec<Phase> {
        (0..count)
            .map(|_| {
                schedule.finish_iteration();
                let must_wait = must_wait(schedule.iterations());
                schedule.advance(must_wait);
                schedule.phase()
            })
            .collect()
    }

    #[test]
    fn phases_follow_each_other() {
        let mut schedule = Schedule::new(&Tuning::STANDARD, ProblemKind::Small);
        let phases = phases(&mut schedule, 60, |_| false);
        assert!(phases[..19].iter().all(|p| *p == Phase::WarmUp));
        assert!(phases[19..39].iter().all(|p| *p == Phase::Settling));
        assert!(phases[39..].iter().all(|p| *p == Phase::Settled));
        assert_eq!((schedule.step(), schedule.iterations()), (60, 60));
    }

    #[test]
    fn a_wait_repeats_the_last_steps_of_the_warm_up() {
        let mut schedule = Schedule::new(&Tuning::STANDARD, ProblemKind::Small);
        let phases = phases(&mut schedule, 60, |done| done < 33);
        assert!(phases[..19].iter().all(|p| *p == Phase::WarmUp));
        // The bins are looked at after 20, 25, 30 and 35 iterations.
        assert!(phases[19..34].iter().all(|p| *p == Phase::Waiting));
        assert_eq!(phases[34], Phase::Settling);
        assert_eq!((schedule.step(), schedule.iterations()), (45, 60));
    }

    /// The end of a wait would never come if each frame counted its own steps.
    #[test]
    fn a_wait_over_many_short_frames_counts_all_steps() {
        let mut schedule = Schedule::new(&Tuning::STANDARD, ProblemKind::Small);
        let mut iterations = 0;
        while schedule.is_warming_up() {
            if iterations % 7 == 0 {
                schedule.warm_start();
            }
            let must_wait = schedule.steps_with_repeats() < 60;
            schedule.advance(must_wait);
            schedule.finish_iteration();
            iterations += 1;
        }
        assert_eq!(iterations, 61);
    }

    #[test]
    fn a_warm_start_keeps_the_rhythm_of_the_support() {
        for done in [5, 19, 20, 26, 33, 57, 142] {
            let mut schedule = Schedule::new(&Tuning::STANDARD, ProblemKind::Small);
            phases(&mut schedule, done, |_| false);
            schedule.warm_start();
            assert_eq!(schedule.iterations(), 0);
            assert_eq!(schedule.step() % 10, done % 10);
            assert!(schedule.step() <= done && schedule.step() < 36);
            assert_eq!(schedule.is_warming_up(), done < 20, "{done}");
        }
    }

    #[test]
    fn every_bin_must_become_darker_once() {
        let shape = Shape::new(2, 1, 2);
        let mut detector = DeclineDetector::new(2, &Tuning::STANDARD);
        assert!(detector.is_rising(&[1.0, 0.0, 1.0, 0.0], shape));
        assert!(detector.is_rising(&[0.9, 0.0, 1.1, 0.0], shape));
        // The first bin has fallen, so it may rise again.
        assert!(detector.is_rising(&[2.0, 0.0, 1.1, 0.0], shape));
        assert!(!detector.is_rising(&[2.0, 0.0, 1.0, 0.0], shape));
    }

    #[test]
    fn a_dark_bin_is_not_waited_for() {
        let shape = Shape::new(2, 1, 2);
        let mut detector = DeclineDetector::new(2, &Tuning::STANDARD);
        assert!(detector.is_rising(&[1.0, 0.0, 0.0, 0.0], shape));
        assert!(!detector.is_rising(&[0.9, 0.0, 1.0, 0.0], shape));
    }
}
