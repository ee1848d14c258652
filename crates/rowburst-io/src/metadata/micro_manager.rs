//! Micro-Manager: a JSON record for each image, in TIFF tag 51123 or in `metadata.txt`.
//!
//! Keys as of Micro-Manager 1.4 and 2.0 (`Exposure-ms`, or `Exposure` of Pycro-Manager, `ROI`, `Binning`,
//! `BitDepth`, `PixelSizeUm`); a property of a device is `DEVICE-PROPERTY`, as the device adapters name them:
//! the table of `properties.rs` knows them.

use super::properties::read_properties;
use super::{Metadata, binning_of, bits_of, name_of, positive, stem_of};
use serde_json::{Map, Value};
use std::path::Path;

/// Longest `metadata.txt` that is read: some 5 kB an image, so that of 50,000 images.
const MAX_BYTES: u64 = 1 << 28;

/// The record in the tag of an image.
pub(super) fn of_tag(json: &str, source: &str) -> Metadata {
    match serde_json::from_str::<Map<String, Value>>(json) {
        Ok(record) => of_records(&[&record], source),
        Err(error) => Metadata::note(format!("{source} is not JSON ({error}); it is not used")),
    }
}

/// The record of the image `path` in `metadata.txt` or `NAME_metadata.txt` beside it.
pub(super) fn sidecar(path: &Path) -> Metadata {
    let folder = path.parent().unwrap_or(Path::new(""));
    let names = [
        format!("{}_metadata.txt", stem_of(path)),
        "metadata.txt".into(),
    ];
    let Some(file) = names
        .map(|n| folder.join(n))
        .into_iter()
        .find(|f| f.is_file())
    else {
        return Metadata::default();
    };
    let name = name_of(&file);
    if file.metadata().map_or(0, |m| m.len()) > MAX_BYTES {
        return Metadata::note(format!("{name} is longer than 256 MiB; it is not used"));
    }
    let text = match std::fs::read(&file) {
        Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
        Err(error) => return Metadata::note(format!("{name} cannot be read ({error})")),
    };
    // An acquisition that was stopped leaves the last brace out.
    let whole = serde_json::from_str::<Map<String, Value>>(&text);
    let all = match whole.or_else(|error| {
        let closed = format!("{}}}", text.trim_end().trim_end_matches(','));
        serde_json::from_str(&closed).map_err(|_| error)
    }) {
        Ok(all) => all,
        Err(error) => {
            return Metadata::note(format!("{name} is not JSON ({error}); it is not used"));
        }
    };
    let image = name_of(path);
    let is_record = |key: &str| key.starts_with("FrameKey") || key.starts_with("Metadata-");
    let is_own = |key: &str, record: &Map<String, Value>| {
        key.ends_with(&format!("/{image}"))
            || text_of(record.get("FileName")) == Some(image.clone())
    };
    let mut first = None;
    let mut of_file = None;
    for (key, value) in &all {
        if let Value::Object(record) = value
            && is_record(key)
        {
            first = first.or(Some(record));
            if is_own(key, record) {
                of_file = Some(record);
                break;
            }
        }
    }
    let summary = match all.get("Summary") {
        Some(Value::Object(summary)) => Some(summary),
        _ => None,
    };
    let scope = match summary.and_then(|s| s.get("InitialScopeData")) {
        Some(Value::Object(scope)) => Some(scope),
        _ => None,
    };
    let records = [of_file.or(first), scope, summary];
    let records: Vec<_> = records.into_iter().flatten().collect();
    if records.is_empty() {
        return Metadata::default();
    }
    of_records(&records, &format!("Micro-Manager's {name}"))
}

/// What `records` say, the first before the others.
fn of_records(records: &[&Map<String, Value>], source: &str) -> Metadata {
    let text = |key: &str| records.iter().find_map(|r| text_of(r.get(key)));
    let number = |key: &str| text(key)?.trim().parse::<f64>().ok();
    let camera = text("Core-Camera").or(text("Camera"));
    let property = |name: &str| -> Option<String> {
        if let Some(camera) = &camera
            && let Some(value) = text(&format!("{camera}-{name}"))
        {
            return Some(value);
        }
        let ending = format!("-{name}");
        let found = records.iter().flat_map(|r| r.iter());
        let mut found = found.filter(|(key, _)| key.ends_with(&ending));
        found.find_map(|(_, value)| text_of(Some(value)))
    };
    let roi = text("ROI").and_then(|roi| roi_of(&roi));
    let size = number("Height").zip(number("Width"));
    let size = size.map(|(rows, columns)| (rows as usize, columns as usize));
    let reading = read_properties(&property).metadata;
    let notes = reading.notes.into_iter();
    let notes = notes.map(|note| format!("{source}: {note}")).collect();
    let binning = text("Binning").or(property("Binning"));
    Metadata {
        sources: vec![source.into()],
        size: roi.map(|(_, size)| size).or(size).filter(|s| s.0 * s.1 > 0),
        origin: roi.map(|(origin, _)| origin),
        shutter: reading.shutter,
        row_time_us: reading.row_time_us,
        // Pycro-Manager writes `Exposure`, in ms as well.
        exposure_us: number("Exposure-ms")
            .or(number("Exposure"))
            .and_then(|ms| positive(ms * 1e3)),
        // What was asked for, not what was kept: Interval_ms is no frame period.
        frame_period_us: None,
        binning: binning.and_then(|b| binning_of(&b)),
        bit_depth: number("BitDepth").and_then(bits_of),
        pixel_pitch_um: number("PixelSizeUm")
            .or(number("PixelSize_um"))
            .and_then(positive),
        bayer: None,
        notes,
    }
}

/// A text or a number, bare or as the property maps of version 2 wrap it.
fn text_of(value: Option<&Value>) -> Option<String> {
    match value? {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) => Some(number.to_string()),
        Value::Object(map) => text_of(map.get("scalar").or(map.get("PropVal"))),
        _ => None,
    }
}

/// First row and column, rows and columns.
type Roi = ((usize, usize), (usize, usize));

/// `x-y-width-height`.
fn roi_of(text: &str) -> Option<Roi> {
    let numbers: Option<Vec<usize>> = text.split('-').map(|n| n.trim().parse().ok()).collect();
    match numbers?[..] {
        [x, y, width, height] if width > 0 && height > 0 => Some(((y, x), (height, width))),
        _ => None,
    }
}
