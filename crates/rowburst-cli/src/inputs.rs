//! Files into values: frames, PSFs and videos of an experiment.

use crate::args::CalibrationArgs;
use rowburst::measurement::Corrections;
use rowburst::{Camera, Error, Image, PatchSet, Psf, Result, Video};
use rowburst_io::{
    Calibration, Capture, Experiment, Level, is_patch_set, read_image, read_patch_set, read_video,
};
use std::path::Path;

/// The files of the command line, or else of the experiment.
pub fn calibration_of(args: &CalibrationArgs, experiment: &Experiment) -> Calibration {
    let (own, other) = (args.clone(), experiment.calibration.clone());
    Calibration {
        psf: own.psf.or(other.psf),
        dark: own.dark.or(other.dark),
        flat: own.flat.or(other.flat),
        bad_pixels: own.bad_pixels.or(other.bad_pixels),
    }
}

/// The file of the PSF, which a reconstruction needs.
pub fn psf_of<'c>(calibration: &'c Calibration, experiment: &Experiment) -> Result<&'c Path> {
    calibration.psf.as_deref().ok_or_else(|| {
        Error::input(
            experiment.path.display().to_string(),
            "no PSF",
            "a reconstruction needs the point-spread function",
            "Give --psf FILE, or psf = \"FILE\" under [calibration].",
        )
    })
}

/// A recorded frame, and the counts at which its file ends if they are integers.
pub fn read_frame(path: &Path) -> Result<(Image, Option<f64>)> {
    let Capture { image, level } = read_image(path)?;
    let end = match level {
        Level::Counts { bits } if bits <= 16 => Some(f64::from(1u32 << bits) - 1.0),
        Level::Counts { .. } | Level::Float => None,
    };
    Ok((image, end))
}

/// Dark, flat and bad pixels of `calibration`.
pub fn read_corrections(
    calibration: &Calibration,
    container_end: Option<f64>,
) -> Result<Corrections> {
    let read = |path: &Option<std::path::PathBuf>| -> Result<Option<Image>> {
        path.as_deref().map(read_finite).transpose()
    };
    Ok(Corrections {
        dark: read(&calibration.dark)?,
        flat: read(&calibration.flat)?,
        bad_pixels: read(&calibration.bad_pixels)?,
        saturation_counts: container_end,
    })
}

/// A correction: every pixel counts, so every pixel is finite.
fn read_finite(path: &Path) -> Result<Image> {
    let image = read_image(path)?.image;
    match image.first_non_finite() {
        None => Ok(image),
        Some((y, x)) => Err(Error::input(
            path.display().to_string(),
            format!("{} at row {y}, column {x}", image.at(y, x)),
            "every pixel of a dark, a flat or a mask is a finite number",
            "Record it again, or replace the pixel by the mean of its neighbours.",
        )),
    }
}

/// Names the file in an error of the corrections: that of `frame` where it is none of
/// `calibration`.
pub fn naming_file(error: Error, frame: &Path, calibration: &Calibration) -> Error {
    let subject = match &error {
        Error::Input { subject, .. } | Error::Work { subject, .. } => subject.as_str(),
    };
    let path = match subject {
        "dark" => calibration.dark.as_deref(),
        "flat" => calibration.flat.as_deref(),
        "bad_pixels" => calibration.bad_pixels.as_deref(),
        _ => None,
    };
    let place = path.unwrap_or(frame).display().to_string();
    error.within(place)
}

/// Refuses a video that this machine has no memory for, before anything is allocated:
/// the program would be ended without a word.
pub fn check_memory(experiment: &Path, camera: &Camera) -> Result<()> {
    let shape = camera.video_shape();
    let voxels = shape
        .rows
        .checked_mul(shape.columns)
        .and_then(|pixels| pixels.checked_mul(shape.bins));
    let needed = voxels.and_then(|n| n.checked_mul(COPIES));
    // Never less than 64 MiB: after a smaller block is given back, glibc keeps all later
    // blocks of that size for itself, and the peak of memory rises by a fifth.
    let tried = needed.map(|n| n.max(16 << 20));
    if tried.is_some_and(|n| Vec::<f32>::new().try_reserve_exact(n).is_ok()) {
        return Ok(());
    }
    Err(Error::work(
        experiment.display().to_string(),
        format!("no memory for {COPIES} copies of a video of {shape}"),
        "Make [field] smaller, bin the frame, or use a machine with more memory.",
    ))
}

/// Copies of the video, in float32, that a reconstruction holds at its peak.
const COPIES: usize = 12;

/// The PSF of `path` on the working grid of `camera`.
///
/// A file of integers is a raw capture: the camera's dark frame (if it has the same
/// size) or bias is taken from it, and what falls below zero is set to zero. A file of
/// floats is taken as it is. With binning, a PSF of the raw sensor's size, or larger
/// than the working grid can use, is binned.
fn read_psf(path: &Path, camera: &Camera, dark: Option<&Image>) -> Result<Psf> {
    let Capture { mut image, level } = read_image(path)?;
    if matches!(level, Level::Counts { .. }) {
        match dark.filter(|d| (d.rows(), d.columns()) == (image.rows(), image.columns())) {
            Some(dark) => image
                .data_mut()
                .iter_mut()
                .zip(dark.data())
                .for_each(|(p, d)| *p -= d),
            None => {
                let bias = camera.sensor().bias_counts.unwrap_or(0.0) as f32;
                image.data_mut().iter_mut().for_each(|p| *p -= bias);
            }
        }
        image.data_mut().iter_mut().for_each(|p| *p = p.max(0.0));
    }
    let binning = camera.sensor().binning;
    if binning > 1 {
        let (rows, columns) = (image.rows(), image.columns());
        let raw = (camera.rows() * binning, camera.columns() * binning);
        let (field_rows, field_columns) = camera.field();
        let too_large =
            rows > camera.rows() + field_rows && columns > camera.columns() + field_columns;
        if (rows, columns) == raw || too_large {
            eprintln!(
                "{}: {rows}×{columns} raw pixels, binned by {binning}",
                path.display()
            );
            image = image.binned(binning);
        }
    }
    Psf::new(image).map_err(|e| e.within(path.display()))
}

/// The PSFs of `path`: a patch set as it is, one image as [`read_psf`] takes it.
pub fn read_psfs(path: &Path, camera: &Camera, dark: Option<&Image>) -> Result<PatchSet> {
    if is_patch_set(path) {
        return read_patch_set(path);
    }
    read_psf(path, camera, dark).map(PatchSet::from)
}

/// The true video, checked against the shape that `camera` gives.
pub fn read_truth(path: &Path, camera: &Camera) -> Result<Video> {
    let video = read_video(path)?;
    let shape = video.shape();
    if let Some(bad) = video.data().iter().position(|v| !v.is_finite()) {
        return Err(Error::input(
            path.display().to_string(),
            format!(
                "{} at bin {}, row {}, column {}",
                video.data()[bad],
                bad / shape.pixels(),
                bad % shape.pixels() / shape.columns,
                bad % shape.columns
            ),
            "every value of the truth is a finite number",
            "Leave --truth out to reconstruct without a comparison.",
        ));
    }
    if shape != camera.video_shape() {
        return Err(Error::input(
            path.display().to_string(),
            shape,
            format!("the camera gives a video of {}", camera.video_shape()),
            "Leave --truth out, or give the truth on the grid of the reconstruction.",
        ));
    }
    Ok(video)
}
