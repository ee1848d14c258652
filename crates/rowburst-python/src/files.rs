//! Metadata of files, metrics of videos, and the table of a sweep.

use crate::array::video;
use crate::error::{subject, to_py_err};
use crate::experiment::metadata_of;
use crate::threads::detached;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rowburst::bayer::Bayer;
use rowburst::metrics::{psnr_db, ssim};
use rowburst::{Error, ErrorKind, Shutter, Video};
use rowburst_io::{ForeignFiles, OutputFolder};
use rowburst_run::{SweepRow, sweep_csv, sweep_lines, sweep_path};
use std::path::PathBuf;

/// What the metadata of a frame's file say, by the names of the camera's arguments; notes and sources with it.
#[pyfunction]
pub fn _metadata(
    py: Python<'_>,
    path: PathBuf,
) -> PyResult<(Bound<'_, PyDict>, Vec<String>, Vec<String>)> {
    let found = metadata_of(py, &path)?;
    let settings = PyDict::new(py);
    if let Some((rows, columns)) = found.size {
        settings.set_item("rows", rows)?;
        settings.set_item("columns", columns)?;
    }
    let shutter = found.shutter.as_ref().map(Shutter::name);
    let text = [
        ("shutter", shutter),
        ("bayer", found.bayer.map(Bayer::name)),
    ];
    for (name, value) in text {
        if let Some(value) = value {
            settings.set_item(name, value)?;
        }
    }
    let numbers = [
        ("row_time_us", found.row_time_us),
        ("exposure_us", found.exposure_us),
        ("frame_period_us", found.frame_period_us),
        ("pixel_pitch_um", found.pixel_pitch_um),
    ];
    for (name, value) in numbers {
        if let Some(value) = value {
            settings.set_item(name, value)?;
        }
    }
    if let Some(binning) = found.binning {
        settings.set_item("binning", binning)?;
    }
    if let Some(bits) = found.bit_depth {
        settings.set_item("bit_depth", bits)?;
    }
    Ok((settings, found.sources, found.notes))
}

fn pair(video_value: &Bound<'_, PyAny>, truth: &Bound<'_, PyAny>) -> PyResult<(Video, Video)> {
    let (found, truth) = (video(video_value, "video")?, video(truth, "truth")?);
    if found.shape() == truth.shape() {
        return Ok((found, truth));
    }
    let error = Error::input(
        subject("truth"),
        format!("a video of {}", truth.shape()),
        format!("it has the shape of the video, {}", found.shape()),
        "Crop one of them.",
    );
    Err(to_py_err(error.with_kind(ErrorKind::Shape)))
}

/// The PSNR in decibels, with the maximum of the truth as the peak.
#[pyfunction]
pub fn _psnr_db(
    py: Python<'_>,
    video: &Bound<'_, PyAny>,
    truth: &Bound<'_, PyAny>,
) -> PyResult<f64> {
    let (video, truth) = pair(video, truth)?;
    detached(py, || psnr_db(video.data(), truth.data()))
}

/// The mean SSIM of the bins.
#[pyfunction]
pub fn _ssim(py: Python<'_>, video: &Bound<'_, PyAny>, truth: &Bound<'_, PyAny>) -> PyResult<f64> {
    let (video, truth) = pair(video, truth)?;
    detached(py, || ssim(&video, &truth))
}

/// A row of the table of a sweep.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Row {
    point: String,
    output: String,
    prior: Option<String>,
    tau: Option<f64>,
    residual_over_sigma: Option<f64>,
    psnr_db: Option<f64>,
    ssim: Option<f64>,
    fit: Option<String>,
    seconds: f64,
    error: Option<String>,
}

impl From<Row> for SweepRow {
    fn from(row: Row) -> Self {
        Self {
            point: row.point,
            output: row.output,
            prior: row.prior,
            tau: row.tau,
            residual_over_sigma: row.residual_over_sigma,
            psnr_db: row.psnr_db,
            ssim: row.ssim,
            fit: row.fit,
            seconds: row.seconds,
            error: row.error,
        }
    }
}

/// The folder of the point with this label.
#[pyfunction]
pub fn _sweep_path(folder: PathBuf, label: &str) -> PathBuf {
    sweep_path(&folder, label, "")
}

/// The lines of the table.
#[pyfunction]
pub fn _sweep_lines(rows: Vec<Row>) -> Vec<String> {
    let rows: Vec<SweepRow> = rows.into_iter().map(SweepRow::from).collect();
    sweep_lines(&rows)
}

/// Writes `sweep.csv`.
#[pyfunction]
pub fn _save_sweep(folder: PathBuf, rows: Vec<Row>) -> PyResult<()> {
    let rows: Vec<SweepRow> = rows.into_iter().map(SweepRow::from).collect();
    let write = || {
        let folder = OutputFolder::claim(&folder, "sweep", ForeignFiles::Accept)?;
        folder.write_bytes("sweep.csv", sweep_csv(&rows).as_bytes())
    };
    write().map_err(to_py_err)
}
