//! The settings of a camera: its properties as the driver gives them, and what they mean.

use rowburst_io::{CameraReading, Metadata, Origin, origin_of_property, read_properties};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A property of a camera.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Property {
    /// Its name as the driver spells it.
    pub name: String,
    /// Its value as the driver gives it; `None` where it is unknown.
    pub value: Option<String>,
    /// `read`, `calculated` or `unknown`.
    pub origin: String,
}

/// The settings of a source.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settings {
    /// The source, such as `play:recording.tif`.
    pub source: String,
    /// Model and serial number of the camera, where they are known.
    pub camera: Option<String>,
    /// All properties.
    pub properties: Vec<Property>,
}

/// The keys of the experiment file without which nothing is reconstructed.
pub(crate) const REQUIRED: [&str; 5] = ["rows", "columns", "shutter", "row_time_us", "exposure_us"];

/// Properties that set the gain, as drivers name them; the first that a camera has counts.
const GAIN_PROPERTIES: [&str; 8] = [
    "Sensitivity/DynamicRange",
    "SimplePreAmpGainControl",
    "PreAmpGain",
    "CONVERSION FACTOR COEFF",
    "Gain",
    "GainRaw",
    "GainAbs",
    "gain",
];

/// Properties that set how fast pixels are read.
const READOUT_RATE_PROPERTIES: [&str; 7] = [
    "PixelReadoutRate",
    "ReadoutRate",
    "READOUT SPEED",
    "ScanMode",
    "PixelRate",
    "Pixelrate",
    "DeviceClockFrequency",
];

impl Settings {
    /// Adds a property as the driver gives it: read, or calculated by the driver.
    pub fn push(&mut self, name: impl Into<String>, value: impl ToString) {
        let name = name.into();
        let origin = origin_of_property(&name);
        self.push_as(name, value, origin);
    }

    /// Adds a property.
    pub fn push_as(&mut self, name: impl Into<String>, value: impl ToString, origin: Origin) {
        self.properties.push(Property {
            name: name.into(),
            value: Some(value.to_string()),
            origin: origin.name().into(),
        });
    }

    /// The value of a property.
    pub fn value(&self, name: &str) -> Option<&str> {
        let found = self.properties.iter().find(|p| p.name == name)?;
        found.value.as_deref()
    }

    /// What the properties mean.
    pub fn reading(&self) -> CameraReading {
        read_properties(&|name| self.value(name).map(String::from))
    }

    /// The settings that `metadata` of a recording holds, under the keys of the experiment file.
    pub(crate) fn push_metadata(&mut self, metadata: &Metadata) {
        let text = |value: Option<f64>| value.map(|v| v.to_string());
        let count = |value: Option<usize>| value.map(|v| v.to_string());
        let shutter = metadata.shutter.as_ref().map(|s| s.name().to_string());
        let values = [
            ("shutter", shutter),
            ("row_time_us", text(metadata.row_time_us)),
            ("exposure_us", text(metadata.exposure_us)),
            ("frame_period_us", text(metadata.frame_period_us)),
            ("binning", count(metadata.binning)),
            ("bit_depth", metadata.bit_depth.map(|bits| bits.to_string())),
            ("pixel_pitch_um", text(metadata.pixel_pitch_um)),
            ("top", count(metadata.origin.map(|(top, _)| top))),
            ("left", count(metadata.origin.map(|(_, left)| left))),
        ];
        for (name, value) in values {
            if let Some(value) = value
                && self.value(name).is_none()
            {
                self.push(name, value);
            }
        }
    }

    /// Names the keys that nothing says, so that a reader of the file sees that they are unknown.
    pub fn mark_unknown(&mut self) {
        let reading = self.reading();
        for key in REQUIRED {
            let is_known = reading.provenance.iter().any(|p| p.key == key);
            if !is_known && !self.properties.iter().any(|p| p.name == key) {
                self.properties.push(Property {
                    name: key.into(),
                    value: None,
                    origin: Origin::Unknown.name().into(),
                });
            }
        }
    }

    /// What must be the same for two captures to belong together.
    pub fn fingerprint(&self) -> Fingerprint {
        let reading = self.reading();
        let metadata = &reading.metadata;
        let text = |value: Option<String>| value.unwrap_or_else(|| "unknown".into());
        let pair = |value: Option<(usize, usize)>| text(value.map(|(y, x)| format!("{y}×{x}")));
        let microseconds = |value: Option<f64>| text(value.map(|v| format!("{v:.6} µs")));
        let shutter = metadata.shutter.as_ref().map(|s| s.name().to_string());
        let first_of = |names: &[&str]| {
            let found = names.iter().find_map(|name| self.value(name));
            text(found.map(String::from))
        };
        let values = [
            ("camera", text(self.camera.clone())),
            ("gain", first_of(&GAIN_PROPERTIES)),
            ("readout rate", first_of(&READOUT_RATE_PROPERTIES)),
            ("size", pair(metadata.size)),
            ("origin", pair(metadata.origin)),
            ("binning", text(metadata.binning.map(|b| b.to_string()))),
            ("shutter", text(shutter)),
            ("row time", microseconds(metadata.row_time_us)),
            ("exposure", microseconds(metadata.exposure_us)),
            ("bit depth", text(metadata.bit_depth.map(|b| b.to_string()))),
        ];
        Fingerprint(values.map(|(k, v)| (k.to_string(), v)).into())
    }
}

/// Settings that tell whether two captures belong together.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Fingerprint(BTreeMap<String, String>);

impl Fingerprint {
    /// The settings among `keys` that differ, as "row time 9.6 µs, not 10 µs".
    pub fn differences(&self, other: &Self, keys: &[&str]) -> Vec<String> {
        let mut found = Vec::new();
        for key in keys {
            if let (Some(own), Some(others)) = (self.0.get(*key), other.0.get(*key))
                && own != others
            {
                found.push(format!("{key} {own}, not {others}"));
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(row_time: &str) -> Settings {
        let mut settings = Settings::default();
        settings.push("rows", 12);
        settings.push("columns", 10);
        settings.push("RowReadTime", row_time);
        settings
    }

    #[test]
    fn fingerprints_name_what_differs() {
        let (a, b) = (settings("9.6e-6"), settings("1e-5"));
        let found = a
            .fingerprint()
            .differences(&b.fingerprint(), &["size", "row time"]);
        assert_eq!(found, ["row time 9.600000 µs, not 10.000000 µs"]);
        assert!(
            a.fingerprint()
                .differences(&b.fingerprint(), &["size"])
                .is_empty()
        );
    }

    #[test]
    fn gain_rate_and_camera_are_part_of_it() {
        let with = |gain: &str, camera: &str| {
            let mut settings = settings("9.6e-6");
            settings.push("SimplePreAmpGainControl", gain);
            settings.push("PixelReadoutRate", "560 MHz");
            settings.camera = Some(camera.into());
            settings.fingerprint()
        };
        let keys = ["gain", "readout rate", "camera"];
        let found = with("16-bit", "Zyla VSC-1").differences(&with("12-bit", "Zyla VSC-2"), &keys);
        assert_eq!(
            found,
            [
                "gain 16-bit, not 12-bit",
                "camera Zyla VSC-1, not Zyla VSC-2"
            ]
        );
    }

    #[test]
    fn what_a_driver_calculates_is_not_read() {
        let mut settings = Settings::default();
        settings.push("Line Time [us]", 27.77);
        settings.push("RowReadTime", "9.6e-6");
        let origins = settings.properties.iter().map(|p| p.origin.as_str());
        assert_eq!(origins.collect::<Vec<_>>(), ["calculated", "read"]);
    }

    #[test]
    fn what_nothing_says_is_marked() {
        let mut settings = settings("9.6e-6");
        settings.mark_unknown();
        let unknown: Vec<_> = settings
            .properties
            .iter()
            .filter(|p| p.origin == "unknown")
            .map(|p| p.name.as_str())
            .collect();
        assert_eq!(unknown, ["shutter", "exposure_us"]);
    }
}
