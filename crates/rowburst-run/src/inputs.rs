//! Files into values: frames, PSFs and videos of an experiment.

use rowburst::measurement::Corrections;
use rowburst::{Camera, Error, Image, PatchSet, Psf, Result, Video};
use rowburst_io::{
    Calibration, Capture, Experiment, SampleFormat, is_patch_set, read_image, read_patch_set,
    read_video,
};
use std::path::Path;

/// The files that are given, or else those of the experiment.
pub fn resolve_calibration(given: Calibration, experiment: &Experiment) -> Calibration {
    let from_file = experiment.calibration.clone();
    Calibration {
        psf: given.psf.or(from_file.psf),
        dark: given.dark.or(from_file.dark),
        flat: given.flat.or(from_file.flat),
        bad_pixels: given.bad_pixels.or(from_file.bad_pixels),
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
    let Capture { image, format } = read_image(path)?;
    Ok((image, format.saturation_limit()))
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
    let needed = voxels.and_then(|n| n.checked_mul(VIDEO_COPIES));
    // Never less than 64 MiB: after a smaller block is given back, glibc keeps all later
    // blocks of that size for itself, and the peak of memory rises by a fifth.
    let tried = needed.map(|n| n.max(16 << 20));
    if tried.is_some_and(|n| Vec::<f32>::new().try_reserve_exact(n).is_ok()) {
        return Ok(());
    }
    Err(Error::work(
        experiment.display().to_string(),
        format!("no memory for {VIDEO_COPIES} copies of a video of {shape}"),
        "Make [field] smaller, bin the frame, or use a machine with more memory.",
    ))
}

/// Copies of the video, in float32, that a reconstruction holds at its peak.
const VIDEO_COPIES: usize = 12;

/// The PSF of a capture on the working grid of `camera`, and what is to be said of it.
///
/// A file of integers is a raw capture: the camera's dark frame (if it has the same
/// size) or bias is taken from it, and what falls below zero is set to zero. A file of
/// floats is taken as it is. With binning, a PSF of the raw sensor's size, or larger
/// than the working grid can use, is binned.
///
/// # Errors
/// Those of [`Psf::new`].
pub fn psf_from(
    capture: Capture,
    camera: &Camera,
    dark: Option<&Image>,
) -> Result<(Psf, Option<String>)> {
    let Capture { mut image, format } = capture;
    if matches!(format, SampleFormat::Counts { .. }) {
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
    let mut note = None;
    let binning = camera.sensor().binning;
    if binning > 1 {
        let (rows, columns) = (image.rows(), image.columns());
        let raw = (camera.rows() * binning, camera.columns() * binning);
        let (field_rows, field_columns) = camera.field();
        let too_large =
            rows > camera.rows() + field_rows && columns > camera.columns() + field_columns;
        if (rows, columns) == raw || too_large {
            note = Some(format!("{rows}×{columns} raw pixels, binned by {binning}"));
            image = image.binned(binning);
        }
    }
    Ok((Psf::new(image)?, note))
}

/// The PSFs of `path`: a patch set as it is, one image as [`psf_from`] takes it.
///
/// # Errors
/// A file that cannot be read, or holds no PSF.
pub fn read_psfs(
    path: &Path,
    camera: &Camera,
    dark: Option<&Image>,
) -> Result<(PatchSet, Option<String>)> {
    if is_patch_set(path) {
        return Ok((read_patch_set(path)?, None));
    }
    let capture = read_image(path)?;
    let found = psf_from(capture, camera, dark).map_err(|e| e.within(path.display()))?;
    let note = found.1.map(|note| format!("{}: {note}", path.display()));
    Ok((found.0.into(), note))
}

/// The true video, checked against the shape that `camera` gives.
pub fn read_truth(path: &Path, camera: &Camera) -> Result<Video> {
    checked_truth(read_video(path)?, &path.display().to_string(), camera)
}

/// `video` checked against the shape that `camera` gives; `subject` names it in errors.
///
/// # Errors
/// Another shape, or a value that is not finite.
pub fn checked_truth(video: Video, subject: &str, camera: &Camera) -> Result<Video> {
    let shape = video.shape();
    if let Some(bad) = video.data().iter().position(|v| !v.is_finite()) {
        return Err(Error::input(
            subject,
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
            subject,
            shape,
            format!("the camera gives a video of {}", camera.video_shape()),
            "Leave --truth out, or give the truth on the grid of the reconstruction.",
        ));
    }
    Ok(video)
}
