//! What a result folder keeps for the viewer: `view.json`, and pictures beside it.

use rowburst::{Camera, Image, Result, Shutter, Video};
use rowburst_io::{OutputFolder, write_npy_image, write_npy_video};
use rowburst_report::{AnnotatedTrace, Iteration};
use serde_json::{Value, json};
use std::path::Path;

/// Most points of a photodiode's signal that are kept; a screen shows no more.
const MAX_SIGNAL_POINTS: usize = 5000;

/// The file of the true video, where it is copied.
pub(crate) const TRUTH: &str = "view-truth.npy";

/// All of it, borrowed.
pub struct ViewFiles<'a> {
    /// Of the page.
    pub title: &'a str,
    /// The camera.
    pub camera: &'a Camera,
    /// The video.
    pub video: &'a Video,
    /// The true video, and the file that it came from.
    pub truth: Option<(&'a Video, Option<&'a Path>)>,
    /// The corrected frame.
    pub frame: &'a Image,
    /// The PSF, or the one in the middle of the field.
    pub psf: &'a Image,
    /// `W(b − A v)/σ`.
    pub residual: &'a Image,
    /// The scene without the diffuser.
    pub direct: Option<&'a Image>,
    /// What is drawn over the video.
    pub traces: &'a [AnnotatedTrace],
    /// The points of the convergence curve.
    pub course: &'a [Iteration],
    /// Name and value.
    pub headline: &'a [(String, String)],
    /// Groups of name and value.
    pub settings: &'a [(String, Vec<(String, String)>)],
    /// Verdict and reason.
    pub fit: (&'a str, &'a str),
    /// What the user should know.
    pub warnings: &'a [String],
    /// What makes the same result again.
    pub command: &'a str,
}

/// Writes the pictures, then `view.json`; returns what that says.
pub fn write(folder: &OutputFolder, files: &ViewFiles) -> Result<Value> {
    let images = [
        ("view-frame.npy", Some(files.frame)),
        ("view-psf.npy", Some(files.psf)),
        ("view-residual.npy", Some(files.residual)),
        ("view-direct.npy", files.direct),
    ];
    for (name, image) in images {
        match image {
            Some(image) => folder.write(name, |w| write_npy_image(w, image))?,
            None => folder.remove(name)?,
        }
    }
    let truth = match files.truth {
        // It lies in the folder already (rowburst demo).
        Some((_, Some(path))) if is_in(path, folder, "truth.npy") => {
            folder.remove(TRUTH)?;
            Some("truth.npy")
        }
        Some((truth, _)) => {
            folder.write(TRUTH, |w| write_npy_video(w, truth))?;
            Some(TRUTH)
        }
        None => {
            folder.remove(TRUTH)?;
            None
        }
    };
    let view = describe(files, truth);
    folder.write_bytes("view.json", format!("{view}\n").as_bytes())?;
    Ok(view)
}

fn is_in(path: &Path, folder: &OutputFolder, name: &str) -> bool {
    let full = |path: &Path| path.canonicalize().ok();
    full(path).is_some_and(|path| Some(path) == full(&folder.path().join(name)))
}

/// `view.json`; numbers that are not finite become null.
pub(crate) fn describe(files: &ViewFiles, truth: Option<&str>) -> Value {
    let camera = files.camera;
    let time = camera.time();
    let bins_of = |instant: &usize| {
        let weights = &time.instants()[*instant];
        [
            weights.first_bin,
            weights.first_bin + weights.weights.len() - 1,
        ]
    };
    let mut ranges = json!({ "video": range(files.video) });
    if let Some((truth, _)) = files.truth {
        ranges["truth"] = json!(range(truth));
    }
    let course = files.course.iter();
    json!({
        "version": 1,
        "title": files.title,
        "bin_duration_us": time.bin_duration_us(),
        "pixel_pitch_um": camera.sensor().pixel_pitch_um,
        "ranges": ranges,
        "truth": truth,
        "shutter": {
            "instants": camera.instants(),
            "is_global": *camera.shutter() == Shutter::Global,
            "row_time_us": camera.params().row_time_us,
            "exposure_us": camera.params().exposure_us,
            "bins_per_row": camera.params().bins_per_row,
        },
        // First and last bin that each row of the frame integrates.
        "row_bins": camera.instants().iter().map(bins_of).collect::<Vec<_>>(),
        "traces": files.traces.iter().map(trace).collect::<Vec<_>>(),
        "course": course.map(|p| json!({
            "iteration": p.iteration,
            "seconds": p.seconds,
            "objective": p.objective,
            "residual_over_sigma": p.residual_over_sigma,
            "change": p.change,
            "psnr_db": p.psnr_db,
        })).collect::<Vec<_>>(),
        "headline": files.headline,
        "settings": files.settings,
        "fit": { "verdict": files.fit.0, "reason": files.fit.1 },
        "warnings": files.warnings,
        "command": files.command,
    })
}

fn trace(annotated: &AnnotatedTrace) -> Value {
    let trace = &annotated.trace;
    let region = trace.region;
    let diodes = annotated.photodiodes.iter();
    json!({
        "region": { "y": region.y, "x": region.x, "rows": region.rows, "columns": region.columns },
        "value": trace.value,
        "debiased": trace.debiased,
        "standard_error": trace.standard_error,
        "frequency_hz": annotated.frequency.as_ref().map(|f| f.hertz),
        "frequency_error_hz": annotated.frequency.as_ref().map(|f| f.error_hz),
        "photodiodes": diodes.map(|d| json!({
            "name": d.name,
            "correlation": d.correlation,
            "points": d.points.iter().step_by(d.points.len().div_ceil(MAX_SIGNAL_POINTS).max(1)).collect::<Vec<_>>(),
        })).collect::<Vec<_>>(),
    })
}

/// Smallest and largest value, with 0.
fn range(video: &Video) -> (f32, f32) {
    let values = video.data().iter().filter(|v| v.is_finite());
    values.fold((0.0, 0.0), |(low, high), &v| (v.min(low), v.max(high)))
}
