//! The seam between cameras and everything else.

use crate::settings::Settings;
use rowburst::error::Subject;
use rowburst::{Cancel, Error, ErrorKind, Image, Result};
use rowburst_io::{Capture, SampleFormat};

/// A frame as the camera gave it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Number of rows; `y` is the axis that the shutter scans.
    pub rows: usize,
    /// Number of columns.
    pub columns: usize,
    /// Counts, row after row.
    pub counts: Vec<u16>,
    /// Number of the frame as the source counts; a gap is a dropped frame.
    pub number: u64,
    /// Time of the frame in microseconds on the clock of the source, where it has one.
    pub time_us: Option<u64>,
}

impl Frame {
    /// The frame as a reconstruction takes it: the same values as a file of 16-bit counts.
    ///
    /// # Errors
    /// A frame without pixels.
    pub fn capture(&self) -> Result<Capture> {
        let counts = self.counts.iter().map(|&count| f32::from(count));
        Ok(Capture {
            image: Image::new(self.rows, self.columns, counts.collect())?,
            format: SampleFormat::Counts { bits: 16 },
        })
    }
}

/// What a source gives next.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Delivery {
    /// A whole frame.
    Frame(Frame),
    /// Frames that never arrived.
    Dropped {
        /// Number of the first one.
        first: u64,
        /// Number of the last one.
        last: u64,
    },
    /// A frame of which a part is missing or damaged.
    Incomplete {
        /// What arrived; missing pixels are zero. `None` where nothing can be used.
        frame: Option<Frame>,
        /// Number of the frame.
        number: u64,
        /// What is wrong with it.
        reason: String,
    },
    /// There are no more frames.
    End,
}

/// A number of a camera that can be set while frames come.
#[derive(Debug, Clone, PartialEq)]
pub struct Control {
    /// Its name as the driver spells it, such as `ExposureTime`.
    pub name: String,
    /// Its value.
    pub value: f64,
    /// Smallest value that the camera takes now.
    pub min: f64,
    /// Largest value that the camera takes now.
    pub max: f64,
    /// Unit of the value, where the driver says it.
    pub unit: Option<String>,
}

/// A camera, or what plays one.
pub trait Source: Send {
    /// What a user calls it, such as `play:recording.tif`.
    fn name(&self) -> String;

    /// The settings as they are now.
    ///
    /// # Errors
    /// A camera that does not answer.
    fn settings(&mut self) -> Result<Settings>;

    /// Waits for the next frame.
    ///
    /// # Errors
    /// A camera that does not answer any more, or [`rowburst::ErrorKind::Cancelled`].
    fn next(&mut self, cancel: &Cancel) -> Result<Delivery>;

    /// Leaves out the frames that wait, so that the next one is the latest; returns how many.
    ///
    /// # Errors
    /// Those of [`Self::next`].
    fn skip_to_latest(&mut self) -> Result<u64> {
        Ok(0)
    }

    /// What can be set while frames come: exposure and gain, where the source has them.
    ///
    /// # Errors
    /// A camera that does not answer.
    fn controls(&mut self) -> Result<Vec<Control>> {
        Ok(Vec::new())
    }

    /// Sets one of [`Self::controls`].
    ///
    /// # Errors
    /// A name that is none of them, or a value that the camera refuses.
    fn set(&mut self, name: &str, value: f64) -> Result<()> {
        Err(Error::input(
            Subject::named(self.name()),
            format!("{name} = {value}"),
            "this source has no such control",
            "Set it in the camera's own program.",
        )
        .with_kind(ErrorKind::Unknown))
    }
}
