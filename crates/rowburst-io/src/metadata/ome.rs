//! OME-XML: the text in the first page of an OME-TIFF.
//!
//! Of the first `Image`: `Pixels` (`SizeX`, `SizeY`, `SignificantBits`, `PhysicalSizeX`,
//! `TimeIncrement`), the first `Plane`'s `ExposureTime`, `DetectorSettings`' `Binning`. Units as
//! the schema of 2016-06 names them.

use super::{Metadata, binning_of, bits_of, positive};
use crate::ome_sizes::TagNameExt;
use roxmltree::{Document, Node};

/// What the first image of the text says.
pub(super) fn parse(xml: &str, source: &str) -> Metadata {
    let text = xml.trim_start_matches('\u{feff}').trim();
    let document = match Document::parse(text) {
        Ok(document) => document,
        Err(error) => {
            return Metadata::note(format!("{source} is not XML ({error}); it is not used"));
        }
    };
    let named = |name: &'static str| {
        document
            .descendants()
            .find(move |n| n.has_tag_name_of(name))
    };
    let Some(pixels) = named("Pixels") else {
        return Metadata::default();
    };
    let number = |node: Node, key: &str| node.attribute(key)?.trim().parse::<f64>().ok();
    let side = |key: &str| pixels.attribute(key)?.trim().parse::<usize>().ok();
    let plane = pixels.children().find(|n| n.has_tag_name_of("Plane"));
    let exposure = plane.and_then(|plane| {
        let unit = plane.attribute("ExposureTimeUnit").unwrap_or("s");
        Some(number(plane, "ExposureTime")? * microseconds(unit)?)
    });
    let period = number(pixels, "TimeIncrement").and_then(|time| {
        let unit = pixels.attribute("TimeIncrementUnit").unwrap_or("s");
        Some(time * microseconds(unit)?)
    });
    let pitch = number(pixels, "PhysicalSizeX").and_then(|size| {
        let unit = pixels.attribute("PhysicalSizeXUnit").unwrap_or("µm");
        Some(size * micrometres(unit)?)
    });
    let is_counts = |kind: &str| kind.starts_with("uint") || kind.starts_with("int");
    let counts = pixels.attribute("Type").is_some_and(is_counts);
    let bits = number(pixels, "SignificantBits").filter(|_| counts);
    let binning = named("DetectorSettings").and_then(|n| n.attribute("Binning"));
    let several = |key: &str| side(key).is_some_and(|n| n > 1);
    let mut notes = Vec::new();
    if several("SizeC") || several("SizeZ") {
        notes.push(format!(
            "{source} has several channels or planes in depth: its pages are taken as frames in the order of the file"
        ));
    }
    Metadata {
        sources: vec![source.into()],
        size: side("SizeY").zip(side("SizeX")).filter(|s| s.0 * s.1 > 0),
        exposure_us: exposure.and_then(positive),
        frame_period_us: period.and_then(positive),
        binning: binning.and_then(binning_of),
        bit_depth: bits.and_then(bits_of),
        pixel_pitch_um: pitch.and_then(positive),
        notes,
        ..Metadata::default()
    }
}

fn microseconds(unit: &str) -> Option<f64> {
    Some(match unit {
        "s" => 1e6,
        "ms" => 1e3,
        "µs" | "μs" => 1.0,
        "ns" => 1e-3,
        "min" => 60e6,
        _ => return None,
    })
}

fn micrometres(unit: &str) -> Option<f64> {
    Some(match unit {
        "µm" | "μm" => 1.0,
        "nm" => 1e-3,
        "mm" => 1e3,
        "m" => 1e6,
        _ => return None,
    })
}
