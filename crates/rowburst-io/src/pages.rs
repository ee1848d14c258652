//! What readers of all formats give: the pages of a file, at once or one at a time.

use crate::source::Source;
use rowburst::error::Tool;
use rowburst::{Error, ErrorKind, Image, Result, phrase};
use std::path::Path;

/// One image as it was read.
#[derive(Debug, Clone, PartialEq)]
pub struct Capture {
    /// The pixels. Integers beyond 2²⁴ are rounded to the nearest f32.
    pub image: Image,
    /// What kind of numbers the file holds.
    pub format: SampleFormat,
}

/// What kind of numbers a file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleFormat {
    /// Integers: counts of a sensor.
    Counts {
        /// Bits that the largest count of the container takes, not those of the converter:
        /// 12-bit counts lie in 16 bits. 1, 8, 16, 32 or 64, one fewer where there is a sign.
        bits: u32,
    },
    /// Floating point.
    Float,
}

impl SampleFormat {
    /// Whether it has integers that f32 rounds.
    pub fn exceeds_f32(self) -> bool {
        matches!(self, Self::Counts { bits } if bits > f32::MANTISSA_DIGITS)
    }

    /// The largest count that the container holds, where a sensor may reach it: of integers
    /// of up to 16 bits.
    pub fn saturation_limit(self) -> Option<f64> {
        match self {
            Self::Counts { bits } if bits <= 16 => Some(f64::from(bits).exp2() - 1.0),
            Self::Counts { .. } | Self::Float => None,
        }
    }
}

/// A frame of whole numbers, exactly as its file has them: a [`Capture`] rounds those beyond 2²⁴.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IntegerFrame {
    /// Rows of the frame.
    pub rows: usize,
    /// Columns of the frame.
    pub columns: usize,
    /// The pixels, in C order. Numbers of 64 bits without a sign have their bits in an `i64`.
    pub data: Vec<i64>,
    /// What kind of numbers the file holds.
    pub format: SampleFormat,
}

impl IntegerFrame {
    /// A frame of numbers that f32 holds exactly; floating-point numbers are cut to whole ones.
    pub(crate) fn of_pages(pages: &Pages) -> Self {
        Self {
            rows: pages.rows,
            columns: pages.columns,
            data: pages.data.iter().map(|&v| v as i64).collect(),
            format: pages.format,
        }
    }
}

impl From<Capture> for IntegerFrame {
    fn from(capture: Capture) -> Self {
        Self {
            rows: capture.image.rows(),
            columns: capture.image.columns(),
            data: capture.image.data().iter().map(|&v| v as i64).collect(),
            format: capture.format,
        }
    }
}

/// The one image that `pages` must be; of several, those after the first need no data.
pub(crate) fn single(path: &Path, pages: Pages) -> Result<Capture> {
    if pages.count != 1 {
        return Err(Error::input(
            path,
            format!(
                "a stack of {} pages of {}×{} pixels",
                pages.count, pages.rows, pages.columns
            ),
            "one image is needed here",
            phrase![
                "Save the page that you mean as a separate file; ",
                Tool::Batch,
                " reads recordings."
            ],
        )
        .with_kind(ErrorKind::Shape));
    }
    let image = Image::new(pages.rows, pages.columns, pages.data);
    Ok(Capture {
        image: image.map_err(|e| e.within(path))?,
        format: pages.format,
    })
}

/// The pages of a file, all of one size, one after the other.
#[derive(Debug, Clone)]
pub(crate) struct Pages {
    pub count: usize,
    pub rows: usize,
    pub columns: usize,
    pub data: Vec<f32>,
    pub format: SampleFormat,
}

/// In which order the sides of a frame lie in HDF5.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Axes {
    /// `[frame, y, x]`.
    Plain,
    /// `[frame, x, y]`: MATLAB's `(y, x, frame)`.
    Matlab,
}

/// An opened file of frames.
pub(crate) trait Stack: Send {
    /// Number of frames, at least one.
    fn count(&self) -> usize;

    /// What a user calls a frame.
    fn name(&self, at: usize) -> String {
        format!("[{at}]")
    }

    /// Reads one frame; sizes and kinds of numbers may differ from frame to frame.
    fn page(&mut self, source: &Source, at: usize) -> Result<Pages>;

    /// Reads one frame of integers, exactly. Formats with integers of more than 24 bits have a method of their own.
    fn integers(&mut self, source: &Source, at: usize) -> Result<IntegerFrame> {
        let page = self.page(source, at)?;
        Ok(IntegerFrame::of_pages(&page))
    }
}

/// The first frame of a file, with the number of its frames as the count.
pub(crate) fn first_page(source: &Source, stack: &mut dyn Stack) -> Result<Pages> {
    let count = stack.count();
    let first = stack.page(source, 0)?;
    Ok(Pages { count, ..first })
}

/// All frames of a file, which must have one size and one kind of numbers.
pub(crate) fn all_pages(source: &Source, stack: &mut dyn Stack) -> Result<Pages> {
    let count = stack.count();
    let mut all = stack.page(source, 0)?;
    for at in 1..count {
        let page = stack.page(source, at)?;
        if (page.rows, page.columns, page.format) != (all.rows, all.columns, all.format) {
            return Err(source.error(
                format!(
                    "{} of {}×{} pixels after frames of {}×{}, or of another kind",
                    stack.name(at),
                    page.rows,
                    page.columns,
                    all.rows,
                    all.columns
                ),
                "the frames of a stack have one size and one kind of pixel",
                "Save the frames that belong together as one stack.",
            ));
        }
        if at == 1 {
            let missing = page.data.len().saturating_mul(count - 1);
            all.data.try_reserve_exact(missing).map_err(|_| {
                Error::work(
                    source.path,
                    format!("no memory for {count} frames"),
                    "Crop or bin the images, or use a machine with more memory.",
                )
                .with_kind(ErrorKind::Memory)
            })?;
        }
        all.data.extend(page.data);
    }
    all.count = count;
    Ok(all)
}
