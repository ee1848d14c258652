//! The metadata of an OME-Zarr 0.5 image, <https://ngff.openmicroscopy.org/0.5/>.
//!
//! Written as JSON: the structs of `ome_zarr_metadata` hold scales as f32, in which a bin of
//! 9.6 µs is one of 9.600000381 µs. That crate checks what is written here in a test.

use crate::Scratch;
use rowburst::Result;
use serde_json::{Value, json};
use std::path::Path;

/// An axis of an image.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Axis {
    pub name: &'static str,
    /// time, space, or nothing.
    pub kind: Option<&'static str>,
    pub unit: Option<&'static str>,
    /// Distance of neighbours in `unit`.
    pub scale: f64,
    /// Coordinate of the middle of the first in `unit`.
    pub origin: f64,
}

impl Axis {
    /// `y` or `x` from the first pixel of the sensor, in micrometres where the pitch of a pixel is known. The field
    /// begins `offset_px` pixels before the sensor.
    pub fn space(name: &'static str, pitch_um: Option<f64>, offset_px: usize) -> Self {
        let scale = pitch_um.unwrap_or(1.0);
        Self {
            name,
            kind: Some("space"),
            unit: pitch_um.map(|_| "micrometer"),
            scale,
            origin: 0.0 - scale * offset_px as f64,
        }
    }
}

/// Writes the group of the image `path`, whose only resolution is the array `0`.
pub(crate) fn write_group(
    path: &Path,
    axes: &[Axis],
    attributes: &Value,
    scratch: &Scratch,
) -> Result<()> {
    let text = serde_json::to_string_pretty(&group(axes, attributes)).expect("plain JSON");
    scratch.put(&path.join("zarr.json"), text.as_bytes())
}

fn group(axes: &[Axis], attributes: &Value) -> Value {
    let scale: Vec<f64> = axes.iter().map(|axis| axis.scale).collect();
    let origin: Vec<f64> = axes.iter().map(|axis| axis.origin).collect();
    let axes: Vec<Value> = axes
        .iter()
        .map(|axis| {
            let mut value = json!({"name": axis.name});
            for (key, text) in [("type", axis.kind), ("unit", axis.unit)] {
                if let Some(text) = text {
                    value[key] = text.into();
                }
            }
            value
        })
        .collect();
    json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": {
            "ome": {
                "version": "0.5",
                "multiscales": [{
                    "name": "video",
                    "axes": axes,
                    "datasets": [{
                        "path": "0",
                        "coordinateTransformations": [
                            {"type": "scale", "scale": scale},
                            {"type": "translation", "translation": origin},
                        ],
                    }],
                }],
            },
            "rowburst": attributes,
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ome_zarr_metadata::v0_5::OmeZarrGroupMetadata;
    use validatrix::Validate;

    fn axis(name: &'static str, kind: Option<&'static str>, unit: Option<&'static str>) -> Axis {
        Axis {
            name,
            kind,
            unit,
            scale: 9.6,
            origin: 4.8,
        }
    }

    fn is_valid(axes: &[Axis]) -> bool {
        let text = group(axes, &json!({})).to_string();
        let read: OmeZarrGroupMetadata = serde_json::from_str(&text).unwrap();
        read.attributes.ome.validate().is_ok()
    }

    #[test]
    fn it_is_valid_by_another_program() {
        let frame = axis("frame", Some("time"), None);
        let t = axis("t", None, Some("microsecond"));
        let (y, x) = (Axis::space("y", Some(6.5), 0), Axis::space("x", None, 3));
        assert_eq!((y.origin, x.origin), (0.0, -3.0));
        assert!(is_valid(&[frame.clone(), t.clone(), y.clone(), x.clone()]));
        // The order of the axes is what forbids calling t the time.
        let time = axis("t", Some("time"), Some("microsecond"));
        assert!(!is_valid(&[
            frame.clone(),
            time.clone(),
            y.clone(),
            x.clone()
        ]));
        let free = axis("frame", None, None);
        assert!(!is_valid(&[free, time.clone(), y.clone(), x.clone()]));
        assert!(is_valid(&[time, y, x]));
    }
}
