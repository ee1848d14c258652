//! What the files of a frame say of how it was recorded.
//!
//! Micro-Manager (TIFF tag 51123, `metadata.txt`), OME-XML, Andor Solis (TIFF tags, text beside
//! the file), `rowburst capture` (JSON beside the file). Nothing here fails: what cannot be read is a note, since the pixels do not need it.

mod andor;
mod capture;
mod micro_manager;
mod ome;
mod properties;

pub use capture::{CAPTURE_KIND, capture_record_path, read_capture_record, reading_of_record};
pub use properties::{
    CameraReading, Finding, Origin, Provenance, origin_of_property, read_properties,
};

use crate::ome_sizes::is_ome;
use crate::recording::images_in;
use crate::source::{ArrayPath, Colour, Format, Source};
use crate::{fits, photron, tiff};
use rowburst::Shutter;
use rowburst::bayer::Bayer;
use std::path::Path;

/// What is known of a frame beside its pixels; `None` where nothing is said.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Metadata {
    /// Where it was found, such as "OME-XML in a.ome.tif".
    pub sources: Vec<String>,
    /// Rows and columns of the frame as it was recorded.
    pub size: Option<(usize, usize)>,
    /// First row and column of the frame on the sensor.
    pub origin: Option<(usize, usize)>,
    /// Order of the rows, where the camera names it.
    pub shutter: Option<Shutter>,
    /// From one row to the next, in microseconds.
    pub row_time_us: Option<f64>,
    /// Exposure, in microseconds.
    pub exposure_us: Option<f64>,
    /// From the start of a frame to that of the next, in microseconds.
    pub frame_period_us: Option<f64>,
    /// Sensor pixels along a side of one pixel of the file.
    pub binning: Option<usize>,
    /// Bits of the converter.
    pub bit_depth: Option<u32>,
    /// Pitch of a pixel of the file; in microscopy that at the object.
    pub pixel_pitch_um: Option<f64>,
    /// The mosaic of a colour sensor whose frames are raw.
    pub bayer: Option<Bayer>,
    /// What was there and could not be used, and why.
    pub notes: Vec<String>,
}

impl Metadata {
    /// Whether it says anything.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Takes from `other` what is not known yet.
    fn fill(&mut self, other: Self) {
        let Self {
            sources,
            size,
            origin,
            shutter,
            row_time_us,
            exposure_us,
            frame_period_us,
            binning,
            bit_depth,
            pixel_pitch_um,
            bayer,
            notes,
        } = other;
        self.sources.extend(sources);
        self.size = self.size.or(size);
        self.origin = self.origin.or(origin);
        self.shutter = self.shutter.take().or(shutter);
        self.row_time_us = self.row_time_us.or(row_time_us);
        self.exposure_us = self.exposure_us.or(exposure_us);
        self.frame_period_us = self.frame_period_us.or(frame_period_us);
        self.binning = self.binning.or(binning);
        self.bit_depth = self.bit_depth.or(bit_depth);
        self.pixel_pitch_um = self.pixel_pitch_um.or(pixel_pitch_um);
        self.bayer = self.bayer.or(bayer);
        self.notes.extend(notes);
    }

    fn note(text: impl Into<String>) -> Self {
        Self {
            notes: vec![text.into()],
            ..Self::default()
        }
    }
}

/// What the file of a frame or a stack, the files beside it, or the first file of a folder say.
/// What stands in the file itself comes before what stands beside it.
pub fn read_metadata(path: &Path) -> Metadata {
    let array_path = ArrayPath::of(path);
    let file = if array_path.file.is_dir() {
        match images_in(&array_path.file).map(|names| names.into_iter().next()) {
            Ok(Some(name)) => array_path.file.join(name),
            _ => return Metadata::default(),
        }
    } else {
        array_path.file
    };
    let mut found = match Format::of_name(&file) {
        Some(Format::Tiff) => in_tiff(&file),
        Some(Format::Fits) => in_fits(path),
        Some(Format::Photron) => in_photron(&file),
        _ => Metadata::default(),
    };
    found.fill(capture::sidecar(&file));
    found.fill(micro_manager::sidecar(&file));
    found.fill(andor::sidecar(&file));
    found
}

/// What a record of Micro-Manager says, the JSON object of an image; `source` is where it stands.
pub fn micro_manager_metadata(json: &str, source: &str) -> Metadata {
    micro_manager::of_tag(json, source)
}

fn in_tiff(path: &Path) -> Metadata {
    let name = name_of(path);
    // Errors are those of the pixels, which say them better.
    let tags = Source::open(path, Colour::Refused);
    let tags = tags.and_then(|(source, file)| tiff::tags(&source, file));
    let Ok(tags) = tags else {
        return Metadata::default();
    };
    let mut found = Metadata::default();
    if let Some(json) = &tags.micro_manager {
        found.fill(micro_manager::of_tag(
            json,
            &format!("Micro-Manager's tag in {name}"),
        ));
    }
    if let Some(xml) = tags.description.as_deref().filter(|d| is_ome(d)) {
        found.fill(ome::parse(xml, &format!("OME-XML in {name}")));
    }
    found.fill(andor::of_tags(&tags, &format!("Andor's tags in {name}")));
    found
}

/// `EXPTIME` or `EXPOSURE` in seconds, `XBINNING`, `YBINNING`, `XPIXSZ` in micrometres, `BAYERPAT`.
fn in_fits(path: &Path) -> Metadata {
    let opened = Source::open(path, Colour::Refused);
    let opened = opened.and_then(|(source, file)| fits::Stack::open(&source, file));
    let Ok(stack) = opened else {
        return Metadata::default();
    };
    let cards = stack.cards();
    let exposure_s = cards.number("EXPTIME").or(cards.number("EXPOSURE"));
    let sides = cards.text("XBINNING").zip(cards.text("YBINNING"));
    Metadata {
        sources: vec![format!("the header of {}", name_of(path))],
        size: Some(stack.size()),
        exposure_us: exposure_s.and_then(|s| positive(s * 1e6)),
        binning: sides.and_then(|(x, y)| binning_of(&format!("{x}x{y}"))),
        pixel_pitch_um: cards.number("XPIXSZ").and_then(positive),
        bayer: cards.text("BAYERPAT").and_then(Bayer::from_name),
        ..Metadata::default()
    }
}

/// Rate, shutter time and depth of a header of Photron.
fn in_photron(path: &Path) -> Metadata {
    let opened = Source::open(path, Colour::Refused);
    let Ok(stack) = opened.and_then(|(source, _)| photron::Stack::open(&source)) else {
        return Metadata::default();
    };
    let header = stack.header();
    Metadata {
        sources: vec![format!("Photron's header of {}", name_of(path))],
        size: Some(header.size()),
        exposure_us: header.exposure_s.and_then(|s| positive(s * 1e6)),
        frame_period_us: header.rate_hz.and_then(|hz| positive(1e6 / hz)),
        bit_depth: Some(header.depth()),
        ..Metadata::default()
    }
}

fn name_of(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

/// The name of a file without `.tif`, `.ome.tif` and the like.
fn stem_of(path: &Path) -> String {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    stem.strip_suffix(".ome").unwrap_or(&stem).to_string()
}

/// A number above zero, which all quantities here are.
fn positive(value: f64) -> Option<f64> {
    (value.is_finite() && value > 0.0).then_some(value)
}

/// `2`, `2x2`: sensor pixels along a side; `None` where the sides differ.
fn binning_of(text: &str) -> Option<usize> {
    let mut sides = text.split(['x', 'X', '×']).map(|s| s.trim().parse().ok());
    let first: usize = sides.next()??;
    let alike = sides.all(|side| side == Some(first));
    (alike && (1..=64).contains(&first)).then_some(first)
}

/// Bits of a converter; other numbers are none.
fn bits_of(bits: f64) -> Option<u32> {
    (bits.fract() == 0.0 && (1.0..=16.0).contains(&bits)).then_some(bits as u32)
}

#[cfg(test)]
mod tests;
