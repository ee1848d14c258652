//! What a run leaves on disk.

use crate::chunked_summary::ChunkedSummary;
use crate::colour_summary::ColourSummary;
use crate::formats::VideoFormat;
use crate::movie::MovieStyle;
use crate::record::RunRecord;
use crate::summary::ReconstructionSummary;
use rowburst::Result;
use rowburst_io::{OutputFolder, StoredVideo};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// The folder that a run writes to, and the words and the style of its report.
#[derive(Clone, Copy)]
pub struct Output<'a> {
    /// The folder.
    pub folder: &'a OutputFolder,
    /// Title of the report and of the viewer's page.
    pub title: &'a str,
    /// The command that reproduces the result.
    pub reproduce: Option<&'a str>,
    /// Whether `video.mp4` shows the time of each bin.
    pub movie: MovieStyle,
    /// The formats of the video; `None`: `.npy`, `.mp4`, and up to 64 MB `.tif`.
    pub formats: Option<&'a [VideoFormat]>,
    /// What repeats the run; `None` for arrays in memory.
    pub record: Option<&'a RunRecord>,
}

/// A folder of results that is complete.
///
/// The video of a chunked run is on disk alone ([`Self::open_video`]); a raw colour frame has a folder for each plane beside
/// the video in colour.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Artifacts {
    /// The folder.
    pub folder: PathBuf,
    /// The content of its `result.json`.
    pub summary: Summary,
    /// Frequencies and photodiodes of the traces, in sentences.
    pub trace_lines: Vec<String>,
}

/// The content of `result.json`.
#[derive(Debug, Clone, Serialize)]
#[serde(untagged)]
pub enum Summary {
    /// Of a video that was reconstructed as a whole.
    Whole(Box<ReconstructionSummary>),
    /// Of a video that was reconstructed in chunks.
    Chunked(Box<ChunkedSummary>),
    /// Of a raw colour frame.
    Colour(Box<ColourSummary>),
}

impl Artifacts {
    /// Lists the artifacts of a run that is complete.
    pub(crate) fn new(output: &Output, summary: Summary, trace_lines: Vec<String>) -> Self {
        Self {
            folder: output.folder.path().into(),
            summary,
            trace_lines,
        }
    }

    /// The file of the video: `[t, y, x]`, or `[t, y, x, colour]` of a raw colour frame.
    pub fn video(&self) -> PathBuf {
        self.folder.join(match self.summary {
            Summary::Whole(_) | Summary::Chunked(_) => "video.npy",
            Summary::Colour(_) => "colour.npy",
        })
    }

    /// The video, read from the disk bin by bin: of a run in chunks there is no other.
    ///
    /// # Errors
    /// A file that has been removed, or the video of a raw colour frame, which has a fourth axis: [`Self::video`] and the
    /// folders of the planes have it.
    pub fn open_video(&self) -> Result<StoredVideo> {
        StoredVideo::open(&self.video())
    }

    /// The file that a person opens first: the report, or the video where there is none.
    pub fn first_file(&self) -> PathBuf {
        let file = self.folder.join(match self.summary {
            Summary::Whole(_) | Summary::Chunked(_) => "report.html",
            Summary::Colour(_) => "colour.tif",
        });
        if file.is_file() { file } else { self.video() }
    }
}

impl Summary {
    /// The text of `result.json`.
    pub fn json(&self) -> String {
        json_of(self)
    }
}

/// `value` as it is written to a file of results.
pub(crate) fn json_of(value: &impl Serialize) -> String {
    serde_json::to_string_pretty(value).expect("plain numbers and text")
}

impl<'a> Output<'a> {
    /// The output of a part of the result, in a folder of its own.
    pub(crate) fn part(&self, folder: &'a OutputFolder, title: &'a str) -> Self {
        Self {
            folder,
            title,
            record: None,
            ..*self
        }
    }

    /// The record of the run for `result.json`, beside the file `video`.
    pub(crate) fn finished_record(&self, video: &str) -> rowburst::Result<Option<RunRecord>> {
        let record = self
            .record
            .map(|record| record.finished(self.path(), video));
        record.transpose()
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}
