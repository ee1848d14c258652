//! Takes frames from the source as they come, and keeps the latest.

use super::keep::Keeper;
use rowburst::{Cancel, ErrorKind, Result};
use rowburst_capture::{Delivery, Ended, Frame, Source};
use rowburst_view::Monitor;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// The latest frame; a newer one replaces it.
#[derive(Default)]
pub struct Latest {
    slot: Mutex<Slot>,
    arrived: Condvar,
}

#[derive(Default)]
struct Slot {
    frame: Option<(Arc<Frame>, Instant)>,
    /// Whether the solver has not had it yet.
    is_new: bool,
    /// Frames that were replaced before the solver had them.
    skipped: u64,
}

impl Latest {
    /// Replaces the frame.
    pub fn put(&self, frame: Frame) {
        let mut slot = self.lock();
        slot.skipped += u64::from(slot.is_new);
        slot.frame = Some((Arc::new(frame), Instant::now()));
        slot.is_new = true;
        self.arrived.notify_all();
    }

    /// The latest frame, which stays.
    pub fn look(&self) -> Option<Arc<Frame>> {
        let slot = self.lock();
        slot.frame.as_ref().map(|(frame, _)| Arc::clone(frame))
    }

    /// Waits for a frame that was not taken yet; also when it arrived.
    pub fn take(&self, longest: Duration) -> Option<(Arc<Frame>, Instant)> {
        let waited = self
            .arrived
            .wait_timeout_while(self.lock(), longest, |slot| !slot.is_new);
        let (mut slot, _) = waited.unwrap_or_else(PoisonError::into_inner);
        if !std::mem::take(&mut slot.is_new) {
            return None;
        }
        slot.frame.clone()
    }

    /// Frames that the solver never had.
    pub fn skipped(&self) -> u64 {
        self.lock().skipped
    }

    // What is behind the lock is whole after every statement.
    fn lock(&self) -> MutexGuard<'_, Slot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The thread of the source.
pub struct Grabber {
    pub source: Box<dyn Source>,
    pub latest: Arc<Latest>,
    pub monitor: Arc<Monitor>,
    pub keeper: Keeper,
    pub cancel: Cancel,
}

impl Grabber {
    /// Takes frames until Ctrl-C. A source that ends or fails is shown, and what is recorded is kept.
    pub fn run(mut self) -> Result<()> {
        let (mut frames, mut dropped, mut incomplete) = (0u64, 0, 0u64);
        let start = Instant::now();
        while !self.cancel.is_cancelled() {
            self.answer();
            match self.source.next(&self.cancel) {
                Ok(Delivery::End) => {
                    self.keeper.source_ended(&Ended::SourceEnd, &self.monitor);
                    self.monitor.set("ended", "the source has no more frames");
                    break;
                }
                Ok(delivery) => {
                    self.keeper.record(&delivery, &self.monitor);
                    match delivery {
                        Delivery::Frame(frame) => {
                            frames += 1;
                            self.latest.put(frame);
                        }
                        Delivery::Dropped { first, last } => dropped += last - first + 1,
                        Delivery::Incomplete { .. } | Delivery::End => incomplete += 1,
                    }
                }
                Err(error) if error.kind() == ErrorKind::Cancelled => break,
                Err(error) => {
                    let told = error.to_string();
                    self.keeper
                        .source_ended(&Ended::Failed(error), &self.monitor);
                    self.monitor.set("ended", told);
                    break;
                }
            }
            self.monitor.set("frames", frames);
            self.monitor.set("dropped", dropped);
            self.monitor.set("incomplete", incomplete);
            self.monitor.set("skipped", self.latest.skipped());
            let seconds = start.elapsed().as_secs_f64();
            self.monitor
                .set("frames_per_second", frames as f64 / seconds);
        }
        // Requests are answered also after the end of the source.
        while !self.cancel.is_cancelled() {
            self.answer();
            std::thread::sleep(super::WAIT);
        }
        self.keeper.finish()
    }

    fn answer(&mut self) {
        let frame = self.latest.look();
        self.keeper.answer(&self.monitor, frame, &mut *self.source);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(number: u64) -> Frame {
        Frame {
            rows: 1,
            columns: 1,
            counts: vec![0],
            number,
            time_us: None,
        }
    }

    #[test]
    fn the_latest_frame_replaces_those_before() {
        let latest = Latest::default();
        assert!(latest.take(Duration::ZERO).is_none());
        (0..5).for_each(|number| latest.put(frame(number)));
        assert_eq!(latest.take(Duration::ZERO).unwrap().0.number, 4);
        assert_eq!(latest.skipped(), 4);
        // It is taken once, and stays to be looked at.
        assert!(latest.take(Duration::ZERO).is_none());
        assert_eq!(latest.look().unwrap().number, 4);
    }
}
