//! The record that `rowburst capture` writes beside a recording, `NAME.json`.

use super::properties::{CameraReading, read_properties};
use super::{Metadata, name_of, stem_of};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The kind that the record names.
pub const CAPTURE_KIND: &str = "rowburst capture";

/// A record of a day is some megabytes long.
const MAX_BYTES: u64 = 1 << 28;

/// Where the record of the recording `path` is.
pub fn capture_record_path(path: &Path) -> PathBuf {
    path.with_file_name(format!("{}.json", stem_of(path)))
}

/// The record of the recording `path`, where there is one.
pub fn read_capture_record(path: &Path) -> Option<Value> {
    let file = capture_record_path(path);
    let length = file.metadata().ok()?.len();
    if length > MAX_BYTES {
        return None;
    }
    let record: Value = serde_json::from_slice(&std::fs::read(file).ok()?).ok()?;
    (record["kind"] == CAPTURE_KIND).then_some(record)
}

/// What the properties in a record say.
pub fn reading_of_record(record: &Value) -> CameraReading {
    let none = Vec::new();
    let properties = record["settings"]["properties"].as_array().unwrap_or(&none);
    read_properties(&|name| {
        let found = properties.iter().find(|p| p["name"] == name);
        found.and_then(|p| p["value"].as_str()).map(String::from)
    })
}

pub(super) fn sidecar(path: &Path) -> Metadata {
    let Some(record) = read_capture_record(path) else {
        return Metadata::default();
    };
    let mut metadata = reading_of_record(&record).metadata;
    // The file itself has the size of its frames.
    metadata.size = None;
    metadata.sources = vec![format!(
        "the settings in {}",
        name_of(&capture_record_path(path))
    )];
    metadata
}
