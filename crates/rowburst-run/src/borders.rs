//! The borders between the chunks of a video, at which one fades into the next.
//!
//! The video of a chunk at its end is kept in a file of its own until the next chunk is complete. So a chunk that was
//! written, but not noted as complete when the run was killed, is written again with the same bits.

use rowburst::reconstruct::SolvedChunk;
use rowburst::{Result, Shape};
use rowburst_io::{ChunkedVideoFile, OutputFolder};

/// The file of the borders of an interrupted run.
pub const BORDERS_FILE: &str = "borders.npy.part";

/// Writes chunks whose videos fade into one another.
pub struct Borders {
    /// The ends of the last two chunks, one after the other; `None`: chunks do not fade.
    file: Option<ChunkedVideoFile>,
    /// See [`rowburst::reconstruct::Chunked::faded_bins`].
    faded_bins: usize,
    /// Pixels of a bin.
    pixels: usize,
}

impl Borders {
    /// Of a video of `shape`, which fades over `faded_bins` on each side of a border.
    ///
    /// # Errors
    /// Failed reads and writes.
    pub fn open(folder: &OutputFolder, shape: Shape, faded_bins: usize) -> Result<Self> {
        let path = folder.path().join("borders.npy");
        let ends = Shape::new(4 * faded_bins, shape.rows, shape.columns);
        Ok(Self {
            file: match faded_bins {
                0 => None,
                _ => Some(ChunkedVideoFile::open(&path, ends)?),
            },
            faded_bins,
            pixels: shape.pixels(),
        })
    }

    /// Whether an interrupted run can go on from them.
    pub fn are_resumed(&self) -> bool {
        self.file.as_ref().is_none_or(ChunkedVideoFile::is_resumed)
    }

    /// First bin of the end of chunk `index` in the file.
    fn place(&self, index: usize) -> usize {
        index % 2 * 2 * self.faded_bins
    }

    /// Writes chunk `index`, whose first bin is `start`, to `video`.
    ///
    /// # Errors
    /// Failed reads and writes.
    pub fn write_chunk(
        &mut self,
        video: &mut ChunkedVideoFile,
        index: usize,
        start: usize,
        chunk: &SolvedChunk,
    ) -> Result<()> {
        if index == 0 || self.file.is_none() {
            return video.write(start, chunk.video());
        }
        let before = self.end_of(index - 1)?;
        video.write(start - self.faded_bins, &chunk.faded_from(&before))?;
        let own = &chunk.video()[self.faded_bins * self.pixels..];
        video.write(start + self.faded_bins, own)
    }

    /// Keeps the end of chunk `index` for the next one.
    ///
    /// # Errors
    /// A failed write.
    pub fn keep(&mut self, index: usize, chunk: &SolvedChunk) -> Result<()> {
        let place = self.place(index);
        match &mut self.file {
            Some(file) => file.write(place, chunk.end_border()),
            None => Ok(()),
        }
    }

    /// The end of chunk `index`.
    fn end_of(&mut self, index: usize) -> Result<Vec<f32>> {
        let place = self.place(index);
        let mut end = Vec::new();
        if let Some(file) = &mut self.file {
            for bin in place..place + 2 * self.faded_bins {
                end.extend(file.read(bin)?);
            }
        }
        Ok(end)
    }
}
