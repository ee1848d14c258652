//! A result as text, for a page that is one file and asks nobody.
//!
//! Videos become 8-bit numbers, pictures stay float32; both are packed by gzip, which takes little
//! for a scene that is mostly dark, and written as base64 in JSON.

use crate::array::quantise8;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use flate2::Compression;
use flate2::write::GzEncoder;
use rowburst::{Image, Video};
use serde_json::{Map, Value, json};
use std::io::Write;

/// Most bytes of the text: a file of this size can still be sent by mail (docs/design/018).
const MAX_BYTES: usize = 12_000_000;
/// Most voxels: the browser unpacks them all; larger takes longer to pack (docs/design/018).
const MAX_VOXELS: usize = 80_000_000;
/// Pictures of more pixels are left out; the report has them as figures.
const MAX_PIXELS: usize = 1 << 20;

/// What goes into the page.
pub struct Offline<'a> {
    /// Name of the result.
    pub name: &'a str,
    /// What `view.json` says.
    pub view: &'a Value,
    /// The videos by name; `video` is the first.
    pub videos: &'a [(&'static str, &'a Video)],
    /// The pictures by name.
    pub pictures: &'a [(&'static str, &'a Image)],
    /// 1 at the voxels that the frame observes, else 0; `None` where it observes all.
    pub coverage: Option<&'a [u8]>,
}

impl Offline<'_> {
    /// The JSON that the page reads; `None` where it would be too large.
    ///
    /// # Panics
    /// If there is no video.
    pub fn json(&self) -> Option<String> {
        let shape = self.videos[0].1.shape();
        let arrays = self.videos.len() + usize::from(self.coverage.is_some());
        if shape.voxels() * arrays > MAX_VOXELS {
            return None;
        }
        let (mut videos, mut ranges) = (Map::new(), Map::new());
        let (mut pictures, mut sizes) = (Map::new(), Map::new());
        for (name, video) in self.videos {
            let (numbers, range) = quantise8(video);
            videos.insert(name.to_string(), packed(&numbers).into());
            ranges.insert(name.to_string(), json!(range));
        }
        if let Some(coverage) = self.coverage {
            // On the scale of a video: 254 is 1.
            let numbers: Vec<u8> = coverage.iter().map(|&voxel| 254 * voxel.min(1)).collect();
            videos.insert("coverage".into(), packed(&numbers).into());
            ranges.insert("coverage".into(), json!([0.0, 1.0]));
        }
        for (name, image) in self.pictures {
            if image.data().len() > MAX_PIXELS {
                continue;
            }
            let bytes: Vec<u8> = image.data().iter().flat_map(|v| v.to_le_bytes()).collect();
            pictures.insert(name.to_string(), packed(&bytes).into());
            sizes.insert(name.to_string(), json!([image.rows(), image.columns()]));
        }
        let text = json!({
            "meta": {
                "name": self.name,
                "shape": [shape.bins, shape.rows, shape.columns],
                "ranges": ranges,
                "images": sizes,
                "files": [],
                "bin_duration_us": self.view["bin_duration_us"],
                "view": self.view,
                "result": null,
            },
            "videos": videos,
            "pictures": pictures,
        })
        .to_string();
        (text.len() <= MAX_BYTES).then_some(text)
    }
}

fn packed(bytes: &[u8]) -> String {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
    let written = encoder.write_all(bytes).and_then(|()| encoder.finish());
    BASE64_STANDARD.encode(written.expect("memory takes what is written"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::read::GzDecoder;
    use rowburst::Shape;
    use std::io::Read;

    #[test]
    fn the_page_gets_back_what_was_put_in() {
        let video = Video::new(Shape::new(2, 1, 3), vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.08]).unwrap();
        let frame = Image::new(1, 2, vec![1.5, -2.5]).unwrap();
        let offline = Offline {
            name: "a",
            view: &json!({ "bin_duration_us": 9.6 }),
            videos: &[("video", &video)],
            pictures: &[("frame", &frame)],
            coverage: Some(&[1, 1, 0, 1, 1, 0]),
        };
        let json: Value = serde_json::from_str(&offline.json().unwrap()).unwrap();
        let bytes = |value: &Value| {
            let packed = BASE64_STANDARD.decode(value.as_str().unwrap()).unwrap();
            let mut bytes = Vec::new();
            GzDecoder::new(&packed[..]).read_to_end(&mut bytes).unwrap();
            bytes
        };
        assert_eq!(bytes(&json["videos"]["video"]), [0, 50, 100, 150, 200, 254]);
        assert_eq!(
            bytes(&json["pictures"]["frame"]),
            [0, 0, 192, 63, 0, 0, 32, 192]
        );
        assert_eq!(
            bytes(&json["videos"]["coverage"]),
            [254, 254, 0, 254, 254, 0]
        );
        assert_eq!(json["meta"]["ranges"]["coverage"], json!([0.0, 1.0]));
        assert_eq!(json["meta"]["shape"], json!([2, 1, 3]));
        assert_eq!(json["meta"]["images"]["frame"], json!([1, 2]));
        assert_eq!(json["meta"]["bin_duration_us"], 9.6);
    }

    #[test]
    fn what_is_too_large_is_left_out() {
        let video = Video::zeros(Shape::new(1, 1, 1));
        let frame = Image::new(1025, 1024, vec![0.0; 1025 * 1024]).unwrap();
        let view = Value::String("x".repeat(MAX_BYTES));
        let mut offline = Offline {
            name: "a",
            view: &Value::Null,
            videos: &[("video", &video)],
            pictures: &[("frame", &frame)],
            coverage: None,
        };
        let json: Value = serde_json::from_str(&offline.json().unwrap()).unwrap();
        assert_eq!(json["pictures"], json!({}));
        assert_eq!(json["videos"].get("coverage"), None);
        offline.view = &view;
        assert_eq!(offline.json(), None);
    }
}
