//! A figure for a paper from a result folder, or from a reconstruction in memory.

use crate::completed_task::CompletedTask;
use crate::traces::Traces;
use rowburst::error::{Subject, Tool};
use rowburst::traces::{Region, Trace, frequency_of};
use rowburst::{Error, Image, Result, Sensor, TimeGrid, Video, phrase};
use rowburst_io::{read_image, read_video};
use rowburst_report::{
    AlignedSignal, AnnotatedTrace, ComposedFigure, Direct, DirectOrigin, FigureOptions,
    ReportInput, compose,
};
use serde::Deserialize;
use std::path::Path;

/// What a figure needs of `view.json`.
#[derive(Deserialize)]
struct ViewRecord {
    title: String,
    pixel_pitch_um: Option<f64>,
    bin_duration_us: f64,
    // Absent in results of 0.1.
    start_us: Option<f64>,
    magnification: Option<f64>,
    trigger_delay_us: Option<f64>,
    gain_electrons_per_count: Option<f64>,
    truth: Option<String>,
    shutter: ShutterRecord,
    traces: Vec<TraceRecord>,
}

#[derive(Deserialize)]
struct ShutterRecord {
    instants: Vec<usize>,
    is_global: bool,
    row_time_us: f64,
    exposure_us: f64,
    bins_per_row: usize,
}

#[derive(Deserialize)]
struct TraceRecord {
    region: RegionRecord,
    value: Vec<f64>,
    debiased: Vec<Option<f64>>,
    /// Null where it is not known.
    standard_error: Vec<Option<f64>>,
    photodiodes: Vec<PhotodiodeRecord>,
    /// Absent in results of 0.1.
    #[serde(default)]
    requested: bool,
}

#[derive(Deserialize)]
struct RegionRecord {
    y: usize,
    x: usize,
    rows: usize,
    columns: usize,
}

#[derive(Deserialize)]
struct PhotodiodeRecord {
    name: String,
    correlation: f64,
    points: Vec<(f64, f64)>,
}

/// The figure of a folder that `rowburst reconstruct` has written.
///
/// # Errors
/// A folder that lacks files of a whole result, and those of [`compose`].
pub fn figure_of_folder(folder: &Path, options: &FigureOptions) -> Result<ComposedFigure> {
    check_complete(folder)?;
    let view = read_view(&folder.join("view.json"))?;
    let image = |name: &str| -> Result<Image> { Ok(read_image(&folder.join(name))?.image) };
    let (frame, psf, residual) = (
        image("view-frame.npy")?,
        image("view-psf.npy")?,
        image("view-residual.npy")?,
    );
    let direct = folder.join("view-direct.npy");
    let direct = direct
        .is_file()
        .then(|| image("view-direct.npy"))
        .transpose()?;
    let video = read_video(&folder.join("video.npy"))?;
    let excluded = read_mask(folder, "excluded.npy")?;
    let coverage = read_mask(folder, "coverage.npy")?;
    let truth = view.truth.as_deref();
    let truth = truth.map(|name| read_truth(folder, name)).transpose()?;
    let time = view
        .shutter
        .time(view.bin_duration_us, &folder.join("view.json"))?;
    let time = match view.start_us.filter(|us| us.is_finite()) {
        Some(start_us) => time.starting_at(start_us),
        None => time,
    };
    let rate = time.frame_rate_hz();
    let traces: Vec<AnnotatedTrace> = view.traces.into_iter().map(|t| t.annotated(rate)).collect();
    compose(
        &ReportInput {
            title: &view.title,
            frame: &frame,
            psf: &psf,
            given_psf: None,
            stray_light: None,
            residual_before: None,
            draws_change: false,
            change_count: None,
            video: &video,
            truth: truth.as_ref(),
            direct: direct.as_ref().map(|image| Direct {
                image,
                origin: DirectOrigin::Given,
            }),
            residual: &residual,
            excluded: excluded.as_deref(),
            coverage: coverage.as_deref(),
            traces: &traces,
            instants: &view.shutter.instants,
            time: &time,
            convergence: &[],
            headline: Vec::new(),
            fit: None,
            settings: Vec::new(),
            sensor: &Sensor {
                pixel_pitch_um: view.pixel_pitch_um,
                magnification: view.magnification,
                trigger_delay_us: view.trigger_delay_us,
                gain_electrons_per_count: view.gain_electrons_per_count,
                ..Sensor::default()
            },
            mp4: None,
            player: None,
            files: Vec::new(),
            reproduce: None,
        },
        options,
    )
    .map_err(|e| e.within(folder))
}

/// Refuses a folder that lacks the files of a complete result.
fn check_complete(folder: &Path) -> Result<()> {
    let missing = ["result.json", "view.json"]
        .iter()
        .find(|name| !folder.join(name).is_file());
    match missing {
        Some(missing) => Err(Error::input(
            folder,
            format!("no {missing}"),
            "a figure is drawn from a whole result, which has view.json and result.json",
            phrase!["Run ", Tool::Reconstruct, ", and give its folder."],
        )),
        None => Ok(()),
    }
}

fn read_view(path: &Path) -> Result<ViewRecord> {
    let bad = |found: String| {
        Error::input(
            path,
            found,
            "it is written by this version of the program",
            "Run the reconstruction again.",
        )
    };
    let text = std::fs::read(path).map_err(|e| bad(e.to_string()))?;
    serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))
}

/// A mask of the folder; `None` for a result of 0.1, which has none.
fn read_mask(folder: &Path, name: &str) -> Result<Option<Vec<u8>>> {
    let path = folder.join(name);
    if !path.is_file() {
        return Ok(None);
    }
    let mask = read_video(&path)?;
    Ok(Some(
        mask.data().iter().map(|&v| u8::from(v > 0.0)).collect(),
    ))
}

/// The true video, which lies in the folder.
fn read_truth(folder: &Path, name: &str) -> Result<Video> {
    let name = Path::new(name).file_name().unwrap_or_default();
    read_video(&folder.join(name))
}

impl ShutterRecord {
    fn time(&self, bin_duration_us: f64, path: &Path) -> Result<TimeGrid> {
        let instants = self.instants.iter().max().map_or(0, |last| last + 1);
        let positive = |v: f64| v.is_finite() && v > 0.0;
        let times = [self.row_time_us, self.exposure_us, bin_duration_us];
        if instants == 0 || self.bins_per_row == 0 || !times.into_iter().all(positive) {
            return Err(Error::input(
                Subject::in_file(path, "shutter"),
                format!("{instants} instants, times {times:?} µs"),
                "there are instants, and times are above zero",
                "Run the reconstruction again.",
            ));
        }
        Ok(if self.is_global {
            TimeGrid::single(bin_duration_us)
        } else {
            let exposure = self.exposure_us / self.row_time_us;
            TimeGrid::rolling(instants, self.row_time_us, exposure, self.bins_per_row)
        })
    }
}

impl TraceRecord {
    fn annotated(self, rate_hz: f64) -> AnnotatedTrace {
        let numbers = |values: Vec<Option<f64>>| -> Vec<f64> {
            values.into_iter().map(|v| v.unwrap_or(f64::NAN)).collect()
        };
        let trace = Trace {
            region: Region {
                y: self.region.y,
                x: self.region.x,
                rows: self.region.rows,
                columns: self.region.columns,
            },
            value: self.value,
            debiased: numbers(self.debiased),
            standard_error: numbers(self.standard_error),
        };
        let same = trace.debiased.len() == trace.standard_error.len();
        let frequency = same
            .then(|| frequency_of(&trace.debiased, &trace.standard_error, rate_hz))
            .flatten();
        let diodes = self.photodiodes.into_iter();
        AnnotatedTrace {
            trace,
            frequency,
            is_requested: self.requested,
            photodiodes: diodes
                .map(|d| AlignedSignal {
                    name: d.name,
                    correlation: d.correlation,
                    points: d.points,
                })
                .collect(),
        }
    }
}

impl CompletedTask {
    /// The figure of this reconstruction, as [`figure_of_folder`] gives it of its folder.
    ///
    /// # Errors
    /// Those of [`compose`].
    pub fn figure(
        &self,
        traces: &Traces,
        title: &str,
        options: &FigureOptions,
    ) -> Result<ComposedFigure> {
        let (task, found) = (&self.task, &self.reconstruction);
        let direct = self.direct();
        compose(
            &ReportInput {
                title,
                frame: task.measurement.image(),
                psf: task.psfs.central().image(),
                given_psf: None,
                stray_light: None,
                residual_before: None,
                draws_change: false,
                change_count: None,
                video: &found.video,
                truth: task.truth.as_ref(),
                direct: direct.as_ref().map(|(image, _)| Direct {
                    image,
                    origin: DirectOrigin::Given,
                }),
                residual: &found.normalised_residual,
                excluded: Some(&found.excluded),
                coverage: Some(&found.coverage),
                traces: &traces.annotated(),
                instants: task.camera.instants(),
                time: task.camera.time(),
                convergence: &[],
                headline: Vec::new(),
                fit: None,
                settings: Vec::new(),
                sensor: task.camera.sensor(),
                mp4: None,
                player: None,
                files: Vec::new(),
                reproduce: None,
            },
            options,
        )
    }
}
