//! The files of a result folder for the viewer: `view.json`, and pictures beside it.

use rowburst::{Camera, Image, Result, Shutter, Video};
use rowburst_io::{OutputFolder, write_npy_image, write_npy_video};
use rowburst_report::{AnnotatedTrace, Iteration, REGION_COLOURS};
use serde_json::{Value, json};
use std::path::Path;

/// Most points of a photodiode's signal in `view.json`; larger makes a larger file than a screen can show.
const MAX_SIGNAL_POINTS: usize = 5000;

/// The file to which the true video is copied.
pub(crate) const TRUTH: &str = "view-truth.npy";

/// The file of [`ViewFiles::excluded`].
const EXCLUDED: &str = "excluded.npy";

/// The file of [`ViewFiles::coverage`].
const COVERAGE: &str = "coverage.npy";

/// The values that the viewer shows, borrowed.
pub struct ViewFiles<'a> {
    /// Title of the page.
    pub title: &'a str,
    /// The camera.
    pub camera: &'a Camera,
    /// The reconstructed video.
    pub video: &'a Video,
    /// The true video, and the file that it was read from.
    pub truth: Option<(&'a Video, Option<&'a Path>)>,
    /// The corrected frame.
    pub frame: &'a Image,
    /// The PSF, or that of the middle of the field.
    pub psf: &'a Image,
    /// `W(b − A v)/σ`.
    pub residual: &'a Image,
    /// 1 at the foreign pixels of the frame, which were left out; `[y, x]`.
    pub excluded: &'a [u8],
    /// 1 at the voxels that the frame observes; `[t, y, x]`.
    pub coverage: &'a [u8],
    /// The frame of the scene without the diffuser.
    pub direct: Option<&'a Image>,
    /// The traces, whose regions are drawn over the video.
    pub traces: &'a [AnnotatedTrace],
    /// The points of the convergence curve.
    pub convergence: &'a [Iteration],
    /// The main numbers: pairs of name and value.
    pub headline: &'a [(String, String)],
    /// The table of settings: groups of pairs of name and value.
    pub settings: &'a [(String, Vec<(String, String)>)],
    /// The verdict of the fit and its reason.
    pub fit: (&'a str, &'a str),
    /// Warnings for the user.
    pub warnings: &'a [String],
    /// The command that reproduces the result.
    pub command: &'a str,
}

impl ViewFiles<'_> {
    /// Whether any pixel of the frame was left out.
    pub(crate) fn has_excluded(&self) -> bool {
        self.excluded.contains(&1)
    }

    /// Whether the frame does not observe some voxel.
    pub(crate) fn has_unobserved(&self) -> bool {
        self.coverage.contains(&0)
    }
}

/// Writes the pictures, then `view.json`, and returns the content of `view.json`.
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
        // The folder holds it already (rowburst demo).
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

/// Whether `path` is the file `name` of `folder`.
fn is_in(path: &Path, folder: &OutputFolder, name: &str) -> bool {
    let full = |path: &Path| path.canonicalize().ok();
    full(path).is_some_and(|path| Some(path) == full(&folder.path().join(name)))
}

/// The content of `view.json`. Numbers that are not finite become null.
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
    let convergence = files.convergence.iter();
    let mut view = json!({
        "version": 1,
        "title": files.title,
        "bin_duration_us": time.bin_duration_us(),
        "start_us": time.start_us(),
        "trigger_delay_us": camera.sensor().trigger_delay_us,
        "magnification": camera.sensor().magnification,
        "gain_electrons_per_count": camera.sensor().gain_electrons_per_count,
        "pixel_pitch_um": camera.sensor().pixel_pitch_um,
        "ranges": ranges,
        "truth": truth,
        "shutter": {
            "instants": camera.readout_instants(),
            "is_global": *camera.shutter() == Shutter::Global,
            "row_time_us": camera.params().row_time_us,
            "exposure_us": camera.params().exposure_us,
            "bins_per_row": camera.params().bins_per_row,
        },
        // First and last bin that each row of the frame integrates.
        "row_bins": camera.instants().iter().map(bins_of).collect::<Vec<_>>(),
        "traces": files.traces.iter().enumerate().map(trace).collect::<Vec<_>>(),
        "course": convergence.map(|p| json!({
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
    });
    // A mask is named where it marks anything; the result has both files in any case.
    if files.has_excluded() {
        view["excluded"] = json!(EXCLUDED);
    }
    if files.has_unobserved() {
        let observed = files.coverage.iter().filter(|&&voxel| voxel != 0).count();
        view["coverage"] = json!(COVERAGE);
        view["coverage_fraction"] = json!(observed as f64 / files.coverage.len() as f64);
    }
    view
}

/// A trace in `view.json`, with its number and colour in the figures of the report.
fn trace((i, annotated): (usize, &AnnotatedTrace)) -> Value {
    let trace = &annotated.trace;
    let region = trace.region;
    let diodes = annotated.photodiodes.iter();
    json!({
        "region": { "y": region.y, "x": region.x, "rows": region.rows, "columns": region.columns },
        "number": i + 1,
        "colour": REGION_COLOURS.get(i),
        "requested": annotated.is_requested,
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

/// The smallest range that holds 0 and all finite values.
fn range(video: &Video) -> (f32, f32) {
    let values = video.data().iter().filter(|v| v.is_finite());
    values.fold((0.0, 0.0), |(low, high), &v| (v.min(low), v.max(high)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::camera::CameraParams;
    use rowburst::traces::{Region, Trace};
    use rowburst::{Sensor, Shape};

    /// `view.json` of a frame of 2×2 pixels with these masks.
    fn view_of(excluded: &[u8], coverage: &[u8]) -> Value {
        let camera = Camera::new(CameraParams {
            rows: 2,
            columns: 2,
            shutter: Shutter::Global,
            row_time_us: 1.0,
            exposure_us: 1.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let image = Image::new(2, 2, vec![1.0; 4]).unwrap();
        let files = ViewFiles {
            title: "",
            camera: &camera,
            video: &Video::zeros(Shape::new(1, 2, 2)),
            truth: None,
            frame: &image,
            psf: &image,
            residual: &image,
            excluded,
            coverage,
            direct: None,
            traces: &[],
            convergence: &[],
            headline: &[],
            settings: &[],
            fit: ("good", ""),
            warnings: &[],
            command: "",
        };
        describe(&files, None)
    }

    #[test]
    fn traces_have_the_numbers_and_colours_of_the_report() {
        let region = Region {
            y: 1,
            x: 0,
            rows: 1,
            columns: 2,
        };
        let video = Video::zeros(Shape::new(3, 2, 2));
        let annotated = |is_requested| AnnotatedTrace {
            trace: Trace::without_errors(region, &video),
            frequency: None,
            photodiodes: Vec::new(),
            is_requested,
        };
        let (first, ninth) = (trace((0, &annotated(true))), trace((8, &annotated(false))));
        assert_eq!(first["number"], 1);
        assert_eq!(first["colour"], REGION_COLOURS[0]);
        assert_eq!(first["requested"], true);
        // More are not drawn.
        assert_eq!(ninth["colour"], Value::Null);
        assert_eq!(ninth["requested"], false);
    }

    #[test]
    fn masks_are_named_where_they_mark_anything() {
        let plain = view_of(&[0; 4], &[1; 4]);
        for key in ["excluded", "coverage", "coverage_fraction"] {
            assert!(plain.get(key).is_none(), "{key}");
        }
        let marked = view_of(&[0, 0, 1, 0], &[0, 1, 1, 1]);
        assert_eq!(marked["excluded"], "excluded.npy");
        assert_eq!(marked["coverage"], "coverage.npy");
        assert_eq!(marked["coverage_fraction"], 0.75);
    }
}
