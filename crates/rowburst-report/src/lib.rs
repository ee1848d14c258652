//! The report of a reconstruction: pictures, plots and one HTML page that opens offline.
//!
//! Pure: values in, bytes out; the caller writes the files. [`render`] draws every
//! figure once, as SVG. The page holds that SVG, so that it is sharp on any screen
//! and follows the light or dark theme; [`Picture::png`] is the same SVG rasterised
//! on white with a font of its own, so no font of the system is asked for.
//!
//! ```text
//! ReportInput ─▶ figures/* ─▶ Figure (SVG + panels of pixels) ─▶ page (HTML)
//! Sheet (calibrations, design) ─▶ curves and maps ─┘
//!   analysis: projection, stats                                └─▶ Picture (PNG)
//! ```

mod chart;
mod colour;
mod figure;
mod figures;
mod format;
mod layout;
mod page;
mod panel;
mod pixels;
mod projection;
mod render_text;
mod sheet;
mod stats;

use rowburst::design::count::ChangeCount;
use rowburst::error::Subject;
use rowburst::traces::{Frequency, Trace};
use rowburst::{Error, Image, Result, Sensor, TimeGrid, Video};

pub use figures::REGION_COLOURS;
pub use layout::{ComposedFigure, FigureOptions, Layout, compose};
pub use render_text::render_text;
pub use sheet::{Curve, Drawing, Ink, Plot, Scale, Sheet};

/// What a report is made of. Everything is borrowed; nothing is changed or copied whole.
#[derive(Debug, Clone)]
pub struct ReportInput<'a> {
    /// Title of the page.
    pub title: &'a str,
    /// The captured frame `[y, x]`, in counts (or whatever the solver was given).
    pub frame: &'a Image,
    /// The point spread function `[y, x]`, of any size.
    pub psf: &'a Image,
    /// The point spread function before self-calibration, of the same size; `None`: it was not corrected.
    pub given_psf: Option<&'a Image>,
    /// The reconstruction `[t, y, x]`; its field may be larger than the sensor.
    pub video: &'a Video,
    /// The true video, of the reconstruction's shape (simulations).
    pub truth: Option<&'a Video>,
    /// The scene as the camera sees it without the diffuser, of any size.
    pub direct: Option<Direct<'a>>,
    /// The traces to be drawn; at most eight are.
    pub traces: &'a [AnnotatedTrace],
    /// `(b − A v)/σ`, dimensionless, of the frame's size. Values that are not finite are shown grey.
    pub residual: &'a Image,
    /// 1 at the pixels `[y, x]` of the frame that were left out, else 0; `None`: no pixel was.
    pub excluded: Option<&'a [u8]>,
    /// 1 at the voxels `[t, y, x]` that the frame observes, else 0; `None`: it observes all.
    pub coverage: Option<&'a [u8]>,
    /// Smooth stray light that was taken away from the frame, of its size, in counts; `None`: none was found.
    pub stray_light: Option<&'a Image>,
    /// The residual with PSF and camera as given, where the frame has corrected them.
    pub residual_before: Option<&'a Image>,
    /// Instant `k[r]` at which row `r` of the frame is read.
    pub instants: &'a [usize],
    /// The time axis of the video: bin duration, and which bins each instant integrates.
    pub time: &'a TimeGrid,
    /// Whether the still part of the video and the change from it are drawn apart, as of a dense scene.
    pub draws_change: bool,
    /// How many numbers of an instant speak about that change, where it is known.
    pub change_count: Option<ChangeCount>,
    /// The course of the solver, one entry for each recorded iteration; may be empty.
    pub convergence: &'a [Iteration],
    /// The few big numbers, as (name, value with unit).
    pub headline: Vec<(String, String)>,
    /// Whether the model explains the frame.
    pub fit: Option<FitVerdict<'a>>,
    /// Sections of the table of all numbers and settings needed to repeat the run,
    /// as (section, [(name, value)]).
    pub settings: Vec<(String, Vec<(String, String)>)>,
    /// The sensor: pitch and magnification for scale bars, gain for electrons, delay after the trigger.
    pub sensor: &'a Sensor,
    /// The video as an MP4 file, to be played in the page.
    pub mp4: Option<&'a [u8]>,
    /// The page of the viewer, which then takes the movie's place.
    pub player: Option<Player<'a>>,
    /// Files written beside the report, as (name, what it is).
    pub files: Vec<(String, String)>,
    /// The command line that repeats the run.
    pub reproduce: Option<&'a str>,
}

/// A page that plays the video within the report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Player<'a> {
    /// JavaScript, which finds its place in the element `rowburst`.
    pub script: &'a str,
    /// CSS.
    pub style: &'a str,
    /// JSON, which the script finds in the element `rowburst-data`.
    pub data: &'a str,
}

/// A frame without the diffuser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Direct<'a> {
    /// The frame `[y, x]`.
    pub image: &'a Image,
    /// Where it comes from.
    pub origin: DirectOrigin,
}

/// Where a frame without the diffuser comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DirectOrigin {
    /// It was given, in units of its own.
    Given,
    /// It was computed from the true video, in the units of the frame.
    Truth,
}

/// A trace with what is known of it.
#[derive(Debug, Clone, PartialEq)]
pub struct AnnotatedTrace {
    /// Values and errors.
    pub trace: Trace,
    /// What repeats in it.
    pub frequency: Option<Frequency>,
    /// Signals of photodiodes laid over it.
    pub photodiodes: Vec<AlignedSignal>,
    /// Whether the user asked for its region.
    pub is_requested: bool,
}

/// A photodiode's signal in the units and on the clock of a trace.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedSignal {
    /// Its name.
    pub name: String,
    /// Correlation with the trace.
    pub correlation: f64,
    /// Microseconds on the clock of the video, and light.
    pub points: Vec<(f64, f64)>,
}

/// What is thought of a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitVerdict<'a> {
    /// `good`, or another word, which is then drawn as a warning.
    pub verdict: &'a str,
    /// Why, without a full stop.
    pub reason: &'a str,
}

/// One recorded iteration of the solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Iteration {
    /// Number of the iteration, from 1.
    pub iteration: usize,
    /// Wall-clock time since the start, in seconds.
    pub seconds: f64,
    /// Objective `½‖W(b − A v)‖² + τ‖Ψ v‖₁`.
    pub objective: f64,
    /// Root mean square of `(b − A v)/σ`.
    pub residual_over_sigma: f64,
    /// Relative change of the video, `‖v − v'‖/‖v‖`.
    pub change: f64,
    /// Peak signal-to-noise ratio against the truth, in dB.
    pub psnr_db: Option<f64>,
}

/// A finished report.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// The page: one file without any external reference.
    pub html: String,
    /// The pictures of the page, each a file to be put beside it.
    pub pictures: Vec<Picture>,
}

/// One picture of the report.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// File name, such as `frame.png`.
    pub name: String,
    /// The PNG file, 8-bit RGB.
    pub png: Vec<u8>,
    /// What is seen, as plain text.
    pub caption: String,
}

/// Renders the page and its pictures.
///
/// Cost: two passes over each video and no copy of either; besides the pictures
/// themselves at most one raster of a picture is held at a time.
///
/// # Errors
/// Inputs whose sizes contradict each other; a picture that cannot be encoded.
pub fn render(input: &ReportInput) -> Result<Report> {
    check(input)?;
    let mut entries = Vec::new();
    let mut pictures = Vec::new();
    for drawn in figures::all(input, None) {
        let name = format!("{}.png", drawn.name);
        pictures.push(Picture {
            png: drawn.figure.png()?,
            caption: drawn.caption.clone(),
            name: name.clone(),
        });
        let entry = page::Entry {
            svg: drawn.figure.svg(drawn.name, &drawn.alt)?,
            wide: drawn.figure.is_wide(),
            file: name,
            caption: drawn.caption,
        };
        entries.push((drawn.section, entry));
    }
    Ok(Report {
        html: page::page(input, entries),
        pictures,
    })
}

fn check(input: &ReportInput) -> Result<()> {
    let shape = input.video.shape();
    let frame = (input.frame.rows(), input.frame.columns());
    let mismatch = |subject: &'static str, found: String, rule: String| {
        Err(Error::input(
            Subject::named(subject),
            found,
            rule,
            "Give the report the values of one and the same reconstruction.",
        ))
    };
    if let Some(truth) = input.truth.map(Video::shape).filter(|&t| t != shape) {
        return mismatch(
            "true video",
            truth.to_string(),
            format!("it has the shape of the reconstruction, {shape}"),
        );
    }
    let residual = (input.residual.rows(), input.residual.columns());
    if residual != frame {
        return mismatch(
            "residual map",
            format!("{}×{} pixels", residual.0, residual.1),
            format!("it has the size of the frame, {}×{}", frame.0, frame.1),
        );
    }
    let pixels = frame.0 * frame.1;
    if let Some(other) = input.excluded.filter(|mask| mask.len() != pixels) {
        return mismatch(
            "mask of excluded pixels",
            format!("{} values", other.len()),
            format!("there is one for each of the {pixels} pixels of the frame"),
        );
    }
    if let Some(other) = input.coverage.filter(|mask| mask.len() != shape.voxels()) {
        return mismatch(
            "coverage",
            format!("{} values", other.len()),
            format!("there is one for each voxel of the video of {shape}"),
        );
    }
    if input.instants.len() != frame.0 {
        return mismatch(
            "instants",
            format!("{} entries", input.instants.len()),
            format!("there is one for each of the {} rows", frame.0),
        );
    }
    let is_other = |t: &AnnotatedTrace| {
        t.trace.region.check(shape).is_err() || t.trace.value.len() != shape.bins
    };
    if let Some(other) = input.traces.iter().find(|t| is_other(t)) {
        return mismatch(
            "trace",
            format!(
                "{:?} in {} bins",
                other.trace.region,
                other.trace.value.len()
            ),
            format!("it lies in the video of {shape}"),
        );
    }
    if input.time.bins() != shape.bins {
        return mismatch(
            "time grid",
            format!("{} bins", input.time.bins()),
            format!("it has the bins of the video, {}", shape.bins),
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests;
