//! A result that is shown: the folder of a reconstruction, or a video alone.
//!
//! Only the files named here are ever served. `view.json` and the arrays beside it are written
//! by `rowburst reconstruct`; a folder of an earlier version, without them, shows the video and its
//! numbers.

use crate::array::Array;
use rowburst::error::{Tool, With};
use rowburst::{Error, Parameter, Result, phrase};
use rowburst_io::read_image;
use serde_json::{Map, Value, json};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Files that may be taken from a result folder, with their types.
pub const DOWNLOADS: [(&str, &str); 7] = [
    ("video.npy", "application/octet-stream"),
    ("video.tif", "image/tiff"),
    ("video.mp4", "video/mp4"),
    ("traces.csv", "text/csv; charset=utf-8"),
    ("report.html", "text/html; charset=utf-8"),
    ("result.json", "application/json"),
    ("background.npy", "application/octet-stream"),
];

/// Pictures of a result: their names in the page and their files.
pub const IMAGES: [(&str, &str); 4] = [
    ("frame", "view-frame.npy"),
    ("psf", "view-psf.npy"),
    ("residual", "view-residual.npy"),
    ("direct", "view-direct.npy"),
];

/// Files that the true video may be in: a copy, or the file itself where it lies in the folder.
pub const TRUTHS: [&str; 2] = ["view-truth.npy", "truth.npy"];

/// The mask of the frame's pixels that were left out.
const EXCLUDED: &str = "excluded.npy";

/// The mask of the voxels that the frame observes.
const COVERAGE: &str = "coverage.npy";

/// A description of more than this is none.
const MAX_JSON_BYTES: u64 = 64 << 20;

/// A result, ready to be served.
pub struct ResultFiles {
    /// The folder or the video.
    path: PathBuf,
    is_folder: bool,
    /// What tells this result from one that is written in its place.
    stamp: FileStamp,
    meta: Value,
    /// By name; `video` is always there.
    arrays: Vec<(&'static str, Array)>,
    images: Vec<(&'static str, PathBuf)>,
}

/// Time and size of the file that is written last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct FileStamp(Option<(SystemTime, u64)>);

impl FileStamp {
    fn of(path: &Path) -> Self {
        let metadata = fs::metadata(path).ok();
        Self(metadata.and_then(|m| Some((m.modified().ok()?, m.len()))))
    }
}

impl ResultFiles {
    /// Opens a folder that `rowburst reconstruct` or `demo` has written, or a video file.
    ///
    /// # Errors
    /// A path that is missing, a folder that is no result or not a whole one, damaged files.
    pub fn open(path: &Path) -> Result<Self> {
        match fs::metadata(path) {
            Ok(metadata) if metadata.is_dir() => Self::folder(path),
            Ok(_) => Self::video(path),
            Err(error) => Err(Error::input(
                path,
                error,
                "a result is the folder that rowburst reconstruct has written, or a video (.npy, .tif)",
                "Check the path.",
            )),
        }
    }

    fn folder(path: &Path) -> Result<Self> {
        let there = |name: &str| file_in(path, name).is_some();
        if !there("result.json") {
            return Err(incomplete_result(path));
        }
        // Before anything is read: what is written meanwhile is another result.
        let stamp = FileStamp::of(&path.join("result.json"));
        let result = read_json(&path.join("result.json"))?;
        let view = if there("view.json") {
            read_json(&path.join("view.json"))?
        } else {
            Value::Null
        };
        let Some(video_path) = file_in(path, "video.npy") else {
            return Err(Error::input(
                path,
                "no video.npy in it, or a link to a file elsewhere",
                "a result folder holds its video",
                "Run the reconstruction again, or give the video itself.",
            ));
        };
        let video = Array::open(&video_path, range(&view, "video"))?;
        let shape = video.shape();
        let mut arrays = vec![("video", video)];
        let truth = view["truth"].as_str();
        if let Some(name) = truth.filter(|name| TRUTHS.contains(name) && there(name)) {
            let truth = Array::open(&path.join(name), range(&view, "truth"))?;
            // One that was replaced since is not that of this result.
            if truth.shape() == shape {
                arrays.push(("truth", truth));
            }
        }
        // `view.json` names a mask that marks anything.
        let is_named = |key: &str, file: &str| view[key].as_str() == Some(file) && there(file);
        if is_named("coverage", COVERAGE) {
            let coverage = Array::open(&path.join(COVERAGE), Some((0.0, 1.0)))?;
            if coverage.shape() == shape {
                arrays.push(("coverage", coverage));
            }
        }
        let mut images = Vec::new();
        let mut sizes = Map::new();
        for (name, file) in IMAGES {
            if there(file) {
                let image = read_image(&path.join(file))?.image;
                sizes.insert(name.into(), json!([image.rows(), image.columns()]));
                images.push((name, path.join(file)));
            }
        }
        if is_named("excluded", EXCLUDED) {
            let mask = read_image(&path.join(EXCLUDED))?.image;
            let size = json!([mask.rows(), mask.columns()]);
            if sizes.get("frame") == Some(&size) {
                sizes.insert("excluded".into(), size);
                images.push(("excluded", path.join(EXCLUDED)));
            }
        }
        let step = view["bin_duration_us"]
            .as_f64()
            .or_else(|| Some(1e6 / result["frame_rate_hz"].as_f64()?));
        let step = step.filter(|us| us.is_finite() && *us > 0.0);
        let downloads = DOWNLOADS.iter().map(|d| d.0).filter(|name| there(name));
        let meta = json!({
            "name": name_of(path),
            "images": sizes,
            "files": downloads.collect::<Vec<_>>(),
            "bin_duration_us": step,
            "view": view,
            "result": result,
        });
        Ok(Self::new(path, true, stamp, meta, arrays, images))
    }

    fn video(path: &Path) -> Result<Self> {
        let stamp = FileStamp::of(path);
        let video = Array::open(path, None)?;
        let meta = json!({
            "name": name_of(path), "images": {}, "files": [],
            "bin_duration_us": null, "view": null, "result": null,
        });
        let arrays = vec![("video", video)];
        Ok(Self::new(path, false, stamp, meta, arrays, Vec::new()))
    }

    fn new(
        path: &Path,
        is_folder: bool,
        stamp: FileStamp,
        mut meta: Value,
        arrays: Vec<(&'static str, Array)>,
        images: Vec<(&'static str, PathBuf)>,
    ) -> Self {
        let [bins, rows, columns] = arrays[0].1.shape();
        meta["shape"] = json!([bins, rows, columns]);
        let ranges = arrays.iter();
        let ranges = ranges.map(|(name, array)| (name.to_string(), json!(array.range())));
        meta["ranges"] = Value::Object(ranges.collect());
        Self {
            path: path.to_path_buf(),
            is_folder,
            stamp,
            meta,
            arrays,
            images,
        }
    }

    /// What the page needs to know before it asks for pictures.
    pub fn meta(&self) -> &Value {
        &self.meta
    }

    /// The folder or the video that was opened.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether its files are still those that were opened.
    pub(crate) fn is_current(&self) -> bool {
        let last = if self.is_folder {
            &self.path.join("result.json")
        } else {
            &self.path
        };
        self.stamp.0.is_some() && self.stamp == FileStamp::of(last)
    }

    /// The video `name`.
    pub(crate) fn array(&self, name: &str) -> Option<&Array> {
        Some(&self.arrays.iter().find(|(n, _)| *n == name)?.1)
    }

    /// The picture `name`.
    pub(crate) fn image(&self, name: &str) -> Option<&Path> {
        Some(&self.images.iter().find(|(n, _)| *n == name)?.1)
    }

    /// A file to be taken away, with its type.
    pub(crate) fn download(&self, name: &str) -> Option<(PathBuf, &'static str)> {
        let (name, kind) = DOWNLOADS.iter().find(|(n, _)| *n == name)?;
        let file = self.is_folder.then(|| file_in(&self.path, name))?;
        Some((file?, *kind))
    }
}

/// The file `name` in `folder`; `None` where there is none, or where a symbolic link leads out of the folder.
fn file_in(folder: &Path, name: &str) -> Option<PathBuf> {
    let file = folder.join(name).canonicalize().ok()?;
    let is_inside = file.starts_with(folder.canonicalize().ok()?);
    (is_inside && file.is_file()).then_some(file)
}

fn range(view: &Value, name: &str) -> Option<(f32, f32)> {
    let pair = view["ranges"][name].as_array()?;
    let at = |i: usize| pair.get(i)?.as_f64().map(|v| v as f32);
    Some((at(0)?, at(1)?))
}

fn name_of(path: &Path) -> String {
    let full = path.canonicalize().unwrap_or_else(|_| path.into());
    let name = full.file_name().unwrap_or(full.as_os_str());
    name.to_string_lossy().into_owned()
}

fn read_json(path: &Path) -> Result<Value> {
    let bad = |found: String| {
        Error::input(
            path,
            found,
            "it is written by rowburst reconstruct as JSON",
            "Run the reconstruction again.",
        )
    };
    let bytes = fs::metadata(path).map_err(|e| bad(e.to_string()))?.len();
    if bytes > MAX_JSON_BYTES {
        return Err(bad(format!("a file of {bytes} bytes")));
    }
    let text = fs::read(path).map_err(|e| bad(e.to_string()))?;
    serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))
}

/// Files of folders that other commands write, and these commands.
const OTHER_RESULTS: [(&str, &str); 6] = [
    ("design.json", "design"),
    ("sensor.json", "calibrate sensor"),
    ("psf.json", "calibrate psf"),
    ("timing.json", "calibrate timing"),
    ("simulation.json", "simulate"),
    (
        "sweep.csv",
        "reconstruct --sweep: each point has a folder of its own in it",
    ),
];

/// A folder without `result.json`, which is written last.
fn incomplete_result(path: &Path) -> Error {
    if let Some((file, verb)) = OTHER_RESULTS
        .iter()
        .find(|(file, _)| path.join(file).is_file())
    {
        return Error::input(
            path,
            format!("{file}: a folder of rowburst {verb}"),
            "the viewer shows the result of a reconstruction, which has result.json",
            "Open the report.html in it with a browser, or give the folder of a reconstruction.",
        );
    }
    let begun = ["video.npy", "view.json", "report.html", "video.tif"];
    let begun = begun.iter().find(|name| path.join(name).is_file());
    let (found, remedy) = match begun {
        Some(name) => (
            format!("{name}, but no result.json"),
            "The reconstruction is still running, or was killed: wait for it, or run it again."
                .into(),
        ),
        None if path.join("zarr.json").is_file() || path.join(".zgroup").is_file() => (
            "a Zarr archive".to_string(),
            phrase![
                "Open it in napari, or reconstruct one frame of it with ",
                Tool::Reconstruct,
                "."
            ],
        ),
        None => (
            "no result.json".to_string(),
            phrase![
                "Give the folder that was given to rowburst reconstruct",
                With(Parameter::Output),
                "."
            ],
        ),
    };
    Error::input(
        path,
        found,
        "result.json is written last and marks a complete result",
        remedy,
    )
}
