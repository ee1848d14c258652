//! The files of a job, in `OUT.zarr/rowburst`.

use crate::calibration::CalibrationFile;
use crate::choice::{ChosenPrior, Probe};
use crate::table::FrameRow;
use rowburst::error::With;
use rowburst::{Error, ErrorKind, Parameter, Result, phrase};
use rowburst_zarr::{Lock, Scratch};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Version of these files.
const FORMAT: u32 = 2;

/// What a job was begun with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct JobFile {
    format: u32,
    pub identity: BTreeMap<String, String>,
    pub probes: Vec<Probe>,
    /// The kind of numbers that all frames have.
    #[serde(rename = "numbers")]
    pub pixel_format: String,
    /// The frame that a prior is chosen on.
    pub brightest: usize,
}

impl JobFile {
    pub fn new(
        identity: BTreeMap<String, String>,
        probes: Vec<Probe>,
        pixel_format: String,
        brightest: usize,
    ) -> Self {
        Self {
            format: FORMAT,
            identity,
            probes,
            pixel_format,
            brightest,
        }
    }
}

/// The recording's clock, which may be told later than the job is begun.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct ClockFile {
    pub frame_period_us: f64,
}

/// The folder.
pub(crate) struct State {
    folder: PathBuf,
}

impl State {
    /// The folder of the archive `out`, which is made where nothing is in its way.
    pub fn create(out: &Path) -> Result<Self> {
        let refuse = |found: &str| {
            Err(Error::input(
                out,
                found,
                "a batch writes to a folder that is new, empty, or that of the same batch",
                phrase!["Choose another folder", With(Parameter::Output), "."],
            ))
        };
        let folder = out.join("rowburst");
        match fs::read_dir(out) {
            Ok(mut entries) => {
                if entries.next().is_some() && !folder.is_dir() {
                    return refuse("a folder with something else in it");
                }
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(_) if out.is_file() => {
                return refuse("a file where a folder is needed");
            }
            Err(error) => return refuse(&format!("a folder that cannot be read ({error})")),
        }
        let rows = folder.join("frames");
        if let Err(error) = fs::create_dir_all(rows) {
            return refuse(&format!("a folder that cannot be written to ({error})"));
        }
        Ok(Self { folder })
    }

    /// Keeps other processes from beginning this job, or from joining the table.
    pub fn lock(&self) -> Result<Lock> {
        Lock::wait(&self.folder.join("lock"))
    }

    /// Keeps other processes from choosing the prior as well.
    pub fn lock_choice(&self) -> Result<Lock> {
        Lock::wait(&self.folder.join("choice.lock"))
    }

    /// A place for files that are not whole yet. The caller holds the lock.
    pub fn scratch(&self) -> Result<Scratch> {
        Scratch::open(&self.folder.join("tmp"))
    }

    /// The folder of the ranges of frames that processes work on.
    pub fn claims(&self) -> PathBuf {
        self.folder.join("claims")
    }

    /// The table's path.
    pub fn table(&self) -> PathBuf {
        self.folder.join("frames.csv")
    }

    pub fn job(&self) -> Result<Option<JobFile>> {
        let path = self.folder.join("job.json");
        let job: Option<JobFile> = read(&path)?;
        match job {
            Some(job) if job.format != FORMAT => Err(Error::input(
                path,
                format!("format {}", job.format),
                format!("this version of the program knows format {FORMAT}"),
                phrase![
                    "Resume with the version that it was started with, or choose another folder",
                    With(Parameter::Output),
                    "."
                ],
            )),
            job => Ok(job),
        }
    }

    /// Begins the job. The folder is a Zarr group as well, so that those who list the archive do
    /// not stumble over it.
    pub fn write_job(&self, scratch: &Scratch, job: &JobFile) -> Result<()> {
        let group = serde_json::json!({"zarr_format": 3, "node_type": "group", "attributes": {}});
        write(scratch, &self.folder.join("zarr.json"), &group)?;
        write(scratch, &self.folder.join("job.json"), job)
    }

    pub fn clock(&self) -> Result<Option<ClockFile>> {
        read(&self.folder.join("clock.json"))
    }

    pub fn write_clock(&self, scratch: &Scratch, clock: &ClockFile) -> Result<()> {
        write(scratch, &self.folder.join("clock.json"), clock)
    }

    pub fn prior(&self) -> Result<Option<ChosenPrior>> {
        read(&self.folder.join("prior.json"))
    }

    pub fn write_prior(&self, scratch: &Scratch, prior: &ChosenPrior) -> Result<()> {
        write(scratch, &self.folder.join("prior.json"), prior)
    }

    pub fn calibration(&self) -> Result<Option<CalibrationFile>> {
        read(&self.folder.join("calibration.json"))
    }

    pub fn write_calibration(&self, scratch: &Scratch, file: &CalibrationFile) -> Result<()> {
        write(scratch, &self.folder.join("calibration.json"), file)
    }

    /// Where the files lie.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The lines of all frames that are through.
    pub fn rows(&self, count: usize) -> Result<Vec<FrameRow>> {
        let rows = (0..count).map(|frame| read(&self.row(frame)));
        rows.filter_map(Result::transpose).collect()
    }

    pub fn write_row(&self, scratch: &Scratch, row: &FrameRow) -> Result<()> {
        write(scratch, &self.row(row.frame), row)
    }

    fn row(&self, frame: usize) -> PathBuf {
        self.folder.join(format!("frames/{frame:06}.json"))
    }
}

fn read<T: DeserializeOwned>(path: &Path) -> Result<Option<T>> {
    let text = match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        text => text,
    };
    let value = text.map_err(|e| e.to_string());
    let value = value.and_then(|text| serde_json::from_slice(&text).map_err(|e| e.to_string()));
    value.map(Some).map_err(|reason| {
        Error::work(
            path,
            format!("cannot be read ({reason})"),
            phrase![
                "The archive was changed by hand or the disk is damaged: choose another folder",
                With(Parameter::Output),
                "."
            ],
        )
        .with_kind(ErrorKind::Io)
    })
}

fn write<T: Serialize>(scratch: &Scratch, path: &Path, value: &T) -> Result<()> {
    let text = serde_json::to_string_pretty(value).expect("plain numbers and text");
    scratch.put(path, text.as_bytes())
}
