//! When frames and bins are, in microseconds from the first exposure of the first frame: the start of exposure of the row
//! that is read first.

use rowburst::{Camera, Error, Parameter, Result};
use rowburst_io::Frames;

/// The clock of a recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clock {
    /// From the start of a frame to that of the next.
    pub frame_period_us: f64,
    /// Of a bin.
    pub bin_us: f64,
    /// Start of a frame's first bin, from the frame's first exposure.
    pub first_bin_us: f64,
    /// Of the video of a frame.
    pub video_us: f64,
}

/// Part of the readout by which a period may be too short: it is a measured number.
const TOLERANCE: f64 = 1e-3;

impl Clock {
    /// # Errors
    /// A period shorter than the readout of a frame.
    pub fn new(camera: &Camera, frame_period_us: f64) -> Result<Self> {
        let time = camera.time();
        let bin_us = time.bin_duration_us();
        let bins_per_row = camera.params().bins_per_row.min(time.bins());
        // Without the bins that long exposures see before the first row is read.
        let readout_us = bin_us * (time.instants().len() * bins_per_row).min(time.bins()) as f64;
        if !frame_period_us.is_finite() || frame_period_us < readout_us * (1.0 - TOLERANCE) {
            return Err(Error::input(
                Parameter::FramePeriodUs,
                frame_period_us,
                format!("a frame is read for {readout_us:.3} µs before the next one can begin"),
                "Give the time from the start of one frame to that of the next: 1e6 over the camera's frames per second.",
            ));
        }
        Ok(Self {
            frame_period_us,
            bin_us,
            first_bin_us: time.start_us(),
            video_us: bin_us * time.bins() as f64,
        })
    }

    /// Between the last bin of a frame and the first of the next; 0 where exposures overlap.
    pub fn dead_us(&self) -> f64 {
        (self.frame_period_us - self.video_us).max(0.0)
    }

    /// Start of each frame's first exposure; missing frames are counted.
    pub fn starts_us(&self, frames: &dyn Frames) -> Vec<f64> {
        let first = frames.number(0);
        (0..frames.count())
            .map(|index| (frames.number(index) - first) as f64 * self.frame_period_us)
            .collect()
    }
}
