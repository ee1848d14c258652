//! What the axes of a video are in, before there is a result that says so.

use rowburst::{Camera, Sensor};
use serde_json::{Value, json};

/// Units of the axes of a video; the keys are those of `view.json`.
#[derive(Debug, Clone, PartialEq)]
pub struct VideoAxes {
    /// Duration of a bin in microseconds.
    pub bin_duration_us: f64,
    /// Start of the first bin, in microseconds from the start of exposure of the row that is read first.
    pub start_us: f64,
    /// Pitch of the pixels, magnification, gain and delay after the trigger.
    pub sensor: Sensor,
}

impl VideoAxes {
    /// Those of the videos of a camera.
    pub fn of(camera: &Camera) -> Self {
        Self {
            bin_duration_us: camera.time().bin_duration_us(),
            start_us: camera.time().start_us(),
            sensor: camera.sensor().clone(),
        }
    }

    /// Those of frames that are not reconstructed.
    pub fn of_frame(exposure_us: f64, pixel_pitch_um: Option<f64>) -> Self {
        Self {
            bin_duration_us: exposure_us,
            start_us: 0.0,
            sensor: Sensor {
                pixel_pitch_um,
                ..Sensor::default()
            },
        }
    }

    /// As `view.json` has them.
    pub(crate) fn view(&self, title: &str) -> Value {
        json!({
            "title": title,
            "start_us": self.start_us,
            "trigger_delay_us": self.sensor.trigger_delay_us,
            "pixel_pitch_um": self.sensor.pixel_pitch_um,
            "magnification": self.sensor.magnification,
            "gain_electrons_per_count": self.sensor.gain_electrons_per_count,
        })
    }
}
