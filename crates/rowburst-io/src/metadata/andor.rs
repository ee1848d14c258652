//! Andor Solis: private TIFF tags (as tifffile names them), and the text that Solis writes with an
//! exported file.

use super::{Metadata, binning_of, name_of, positive, stem_of};
use crate::tiff::Tags;
use std::path::Path;

/// A text of Solis is a page long.
const MAX_BYTES: u64 = 1 << 20;

/// `AndorExposureTime` (4876) and `AndorKineticCycleTime` (4878), in seconds.
pub(super) fn of_tags(tags: &Tags, source: &str) -> Metadata {
    let exposure_us = tags.andor_exposure_s.and_then(|s| positive(s * 1e6));
    let frame_period_us = tags.andor_cycle_s.and_then(|s| positive(s * 1e6));
    if exposure_us.is_none() && frame_period_us.is_none() {
        return Metadata::default();
    }
    Metadata {
        sources: vec![source.into()],
        exposure_us,
        frame_period_us,
        ..Metadata::default()
    }
}

/// The text `NAME.txt` or `NAME_info.txt` beside an exported file.
pub(super) fn sidecar(path: &Path) -> Metadata {
    let folder = path.parent().unwrap_or(Path::new(""));
    let stem = stem_of(path);
    let files = [format!("{stem}.txt"), format!("{stem}_info.txt")];
    let mut files = files.map(|name| folder.join(name)).into_iter();
    let is_short = |file: &Path| file.metadata().is_ok_and(|m| m.len() <= MAX_BYTES);
    let Some(file) = files.find(|file| file.is_file() && is_short(file)) else {
        return Metadata::default();
    };
    match std::fs::read(&file) {
        Ok(bytes) => parse(
            &String::from_utf8_lossy(&bytes),
            &format!("Andor's {}", name_of(&file)),
        ),
        Err(_) => Metadata::default(),
    }
}

/// Lines `Key:  value`; a text without the exposure is none of Solis'.
fn parse(text: &str, source: &str) -> Metadata {
    let value = |key: &str| -> Option<&str> {
        let mut lines = text.lines().filter_map(|line| line.split_once(':'));
        lines.find_map(|(k, v)| (k.trim() == key).then_some(v.trim()))
    };
    let seconds = |key: &str| positive(value(key)?.parse::<f64>().ok()? * 1e6);
    let Some(exposure_us) = seconds("Exposure Time (secs)") else {
        return Metadata::default();
    };
    let sides = (value("Horizontal Binning"), value("Vertical Binning"));
    let binning = match sides {
        (Some(x), Some(y)) => binning_of(&format!("{x}x{y}")),
        _ => value("Binning").and_then(binning_of),
    };
    Metadata {
        sources: vec![source.into()],
        exposure_us: Some(exposure_us),
        frame_period_us: seconds("Kinetic Cycle Time (secs)"),
        binning,
        ..Metadata::default()
    }
}
