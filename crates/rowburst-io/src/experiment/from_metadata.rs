//! What an experiment file leaves open and a frame's metadata says.
//!
//! The file counts wherever it says something. Another size is an error, since the frame is then
//! none of this experiment; another exposure, row time, binning, bit depth or readout order a
//! warning, from 1 % on where it is a measured number.

use crate::metadata::Metadata;
use rowburst::bayer::Bayer;
use rowburst::error::Subject;
use rowburst::{Error, Parameter, Result, Shutter};
use std::path::Path;

/// What came from the metadata of a frame, and where it contradicts the experiment file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FromMetadata {
    /// Where metadata was found.
    pub sources: Vec<String>,
    /// Keys of the experiment file that it left open, with the values taken.
    pub values: Vec<(String, String)>,
    /// Contradictions, and metadata that cannot be used.
    pub warnings: Vec<String>,
}

impl FromMetadata {
    /// One line for people; `None` where nothing was taken.
    pub fn summary_line(&self) -> Option<String> {
        let values = self.values.iter().map(|(k, v)| format!("{k} = {v}"));
        let values = values.collect::<Vec<_>>().join(", ");
        (!values.is_empty()).then(|| format!("{values} (from {})", self.sources.join(", ")))
    }
}

/// Part by which measured numbers may differ without a word.
const RELATIVE_TOLERANCE: f64 = 0.01;

/// Fills an experiment from metadata.
pub(super) struct Filling<'a> {
    pub experiment: &'a Path,
    pub metadata: &'a Metadata,
    pub from_metadata: FromMetadata,
}

impl<'a> Filling<'a> {
    pub fn new(experiment: &'a Path, metadata: &'a Metadata) -> Self {
        Self {
            experiment,
            metadata,
            from_metadata: FromMetadata {
                sources: metadata.sources.clone(),
                values: Vec::new(),
                warnings: metadata.notes.clone(),
            },
        }
    }

    /// The file's value, or else that of the metadata.
    pub fn number(
        &mut self,
        key: &str,
        in_file: Option<f64>,
        in_metadata: Option<f64>,
    ) -> Option<f64> {
        let is_same = |a: f64, b: f64| (a - b).abs() <= RELATIVE_TOLERANCE * b.abs();
        self.value(
            key,
            in_file,
            in_metadata,
            |a, b| is_same(*a, *b),
            f64::to_string,
        )
    }

    pub fn count(
        &mut self,
        key: &str,
        in_file: Option<usize>,
        in_metadata: Option<usize>,
    ) -> Option<usize> {
        self.value(key, in_file, in_metadata, |a, b| a == b, usize::to_string)
    }

    /// The readout order; that of a custom shutter cannot be compared.
    pub fn shutter(&mut self, in_file: Option<Shutter>) -> Option<Shutter> {
        let is_same = |a: &Shutter, b: &Shutter| matches!(a, Shutter::Custom(_)) || a == b;
        let name = |s: &Shutter| format!("\"{}\"", s.name());
        let in_metadata = self.metadata.shutter.clone();
        self.value("shutter", in_file, in_metadata, is_same, name)
    }

    /// The mosaic of the colours.
    pub fn bayer(&mut self, in_file: Option<Bayer>) -> Option<Bayer> {
        let name = |b: &Bayer| format!("\"{}\"", b.name());
        self.value("bayer", in_file, self.metadata.bayer, |a, b| a == b, name)
    }

    /// A length at the object or the sensor: taken, but not compared, since both have the name.
    pub fn pitch(&mut self, in_file: Option<f64>, factor: f64) -> Option<f64> {
        let in_metadata = self.metadata.pixel_pitch_um.map(|p| p * factor);
        self.value(
            "pixel_pitch_um",
            in_file,
            in_metadata,
            |_, _| true,
            f64::to_string,
        )
    }

    /// Rows, columns and binning of the working grid.
    ///
    /// A frame that the camera has binned is on that grid; binning that the file alone asks for is
    /// still to be done.
    pub fn size(
        &mut self,
        rows: Option<usize>,
        columns: Option<usize>,
        binning: Option<usize>,
    ) -> Result<(Option<usize>, Option<usize>, Option<usize>)> {
        let cameras = self.metadata.binning;
        let Some((frame_rows, frame_columns)) = self.metadata.size else {
            return Ok((rows, columns, self.count("binning", binning, cameras)));
        };
        let is_to_be_binned = |side: usize, in_file: Option<usize>| match (in_file, binning) {
            (Some(in_file), Some(binning)) => {
                in_file.saturating_mul(binning) == side && in_file != side
            }
            (None, Some(binning)) => {
                binning > 1 && cameras.unwrap_or(1) == 1 && side.is_multiple_of(binning)
            }
            _ => false,
        };
        let divisor = if is_to_be_binned(frame_rows, rows) {
            binning.unwrap_or(1)
        } else {
            1
        };
        let mut side = |key: Parameter,
                        in_file: Option<usize>,
                        frame: usize|
         -> Result<Option<usize>> {
            match in_file {
                Some(in_file) if in_file.saturating_mul(divisor) != frame => Err(Error::input(
                    Subject::in_file(self.experiment, format!("[camera] {key}")).of(key),
                    in_file,
                    format!(
                        "the frame has {frame} {key} by its metadata ({})",
                        self.metadata.sources.join(", ")
                    ),
                    format!(
                        "Give the frame of this experiment, or correct {key} (without it, it is taken from the metadata)."
                    ),
                )),
                Some(in_file) => Ok(Some(in_file)),
                None => {
                    let size = frame / divisor;
                    self.from_metadata
                        .values
                        .push((key.name().into(), size.to_string()));
                    Ok(Some(size))
                }
            }
        };
        let rows = side(Parameter::Rows, rows, frame_rows)?;
        let columns = side(Parameter::Columns, columns, frame_columns)?;
        // Binning still to be done is no contradiction to a camera that did not bin.
        let cameras = cameras.filter(|&c| divisor == 1 || c != 1);
        Ok((rows, columns, self.count("binning", binning, cameras)))
    }

    fn value<T>(
        &mut self,
        key: &str,
        in_file: Option<T>,
        in_metadata: Option<T>,
        is_same: impl Fn(&T, &T) -> bool,
        words: impl Fn(&T) -> String,
    ) -> Option<T> {
        match (in_file, in_metadata) {
            (None, Some(in_metadata)) => {
                self.from_metadata
                    .values
                    .push((key.into(), words(&in_metadata)));
                Some(in_metadata)
            }
            (Some(in_file), Some(in_metadata)) => {
                if !is_same(&in_file, &in_metadata) {
                    self.from_metadata.warnings.push(format!(
                        "{key} is {} in {} and {} in the metadata ({}): the experiment file takes precedence",
                        words(&in_file),
                        self.experiment.display(),
                        words(&in_metadata),
                        self.metadata.sources.join(", ")
                    ));
                }
                Some(in_file)
            }
            (in_file, None) => in_file,
        }
    }
}
