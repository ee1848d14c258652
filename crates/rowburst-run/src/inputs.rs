//! Reads the files of an experiment: frames, corrections, PSFs and true videos.

use rowburst::error::Subject;
use rowburst::measurement::Corrections;
use rowburst::{
    Camera, Cancel, Error, ErrorKind, Image, Parameter, PatchSet, Psf, Result, Shape, Video, phrase,
};
use rowburst_io::{
    Calibration, Capture, Experiment, SampleFormat, is_patch_set, read_image, read_patch_set,
    read_psf_capture, read_video, read_video_shape,
};
use std::path::Path;
use tracing::info;

/// The calibration files: each of `given`, or else that of the experiment file.
pub fn resolve_calibration(given: Calibration, experiment: &Experiment) -> Calibration {
    let from_file = experiment.calibration.clone();
    Calibration {
        psf: given.psf.or(from_file.psf),
        dark: given.dark.or(from_file.dark),
        flat: given.flat.or(from_file.flat),
        bad_pixels: given.bad_pixels.or(from_file.bad_pixels),
    }
}

/// The file of the PSF.
///
/// # Errors
/// No PSF in `calibration`.
pub fn psf_path<'c>(calibration: &'c Calibration, experiment: &Experiment) -> Result<&'c Path> {
    calibration.psf.as_deref().ok_or_else(|| {
        Error::input(
            &experiment.path,
            "no PSF",
            "a reconstruction needs the point-spread function",
            "Give the PSF of the diffuser.",
        )
        .of(Parameter::Psf)
        .with_kind(ErrorKind::Missing)
    })
}

/// Reads dark, flat and bad pixels of `calibration`. The level of saturation is left open.
///
/// # Errors
/// A file that cannot be read, or a pixel that is not finite.
pub fn read_corrections(calibration: &Calibration) -> Result<Corrections> {
    read_corrections_until(calibration, &Cancel::default())
}

/// [`read_corrections`], which `cancel` stops between two files.
pub(crate) fn read_corrections_until(
    calibration: &Calibration,
    cancel: &Cancel,
) -> Result<Corrections> {
    let read = |path: &Option<std::path::PathBuf>| -> Result<Option<Image>> {
        cancel.check()?;
        path.as_deref().map(read_finite).transpose()
    };
    Ok(Corrections {
        dark: read(&calibration.dark)?,
        flat: read(&calibration.flat)?,
        bad_pixels: read(&calibration.bad_pixels)?,
        saturation_counts: None,
    })
}

/// Reads an image, such as a frame or a correction.
pub(crate) fn read_capture(path: &Path) -> Result<Capture> {
    let capture = read_image(path)?;
    let (rows, columns) = (capture.image.rows(), capture.image.columns());
    info!("read {}: {rows}×{columns} pixels", path.display());
    Ok(capture)
}

/// Reads a correction. All its pixels have to be finite.
fn read_finite(path: &Path) -> Result<Image> {
    let image = read_capture(path)?.image;
    match image.first_non_finite() {
        None => Ok(image),
        Some((y, x)) => Err(Error::input(
            path,
            format!("{} at row {y}, column {x}", image.at(y, x)),
            "every pixel of a dark, a flat or a mask is a finite number",
            "Record it again, or replace the pixel by the mean of its neighbours.",
        )
        .with_kind(ErrorKind::NotFinite)),
    }
}

/// Puts the file at fault in front of an error of the corrections: dark, flat or bad pixels of
/// `calibration`, else `frame`.
pub fn naming_file(error: Error, frame: &Path, calibration: &Calibration) -> Error {
    let path = match error.parameter() {
        Some(Parameter::Dark) => calibration.dark.as_deref(),
        Some(Parameter::Flat) => calibration.flat.as_deref(),
        Some(Parameter::BadPixels) => calibration.bad_pixels.as_deref(),
        _ => None,
    };
    error.within(path.unwrap_or(frame))
}

/// The PSF of a capture on the working grid of `camera`, and a note for the user if the capture was binned.
///
/// A capture of integers is raw: the dark frame (if it has the same size) or else the bias is subtracted
/// from it, and negative values are set to zero. A capture of floats is used as it is. With binning, a
/// capture of the raw sensor's size, or larger than the working grid can use, is binned.
///
/// # Errors
/// Those of [`Psf::new`].
pub fn psf_from_capture(
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

/// Reads the PSFs of `path`: a patch set as it is, or one image by [`psf_from_capture`], with what a file beside it says of
/// its capture. Also returns the note.
///
/// # Errors
/// A file that cannot be read, or holds no PSF.
pub fn read_psfs(
    path: &Path,
    camera: &Camera,
    dark: Option<&Image>,
) -> Result<(PatchSet, Option<String>)> {
    if is_patch_set(path) {
        let set = read_patch_set(path)?;
        info!("read {}: {} PSFs", path.display(), set.psfs().len());
        return Ok((set, None));
    }
    let read = read_capture(path)?;
    let capture = read_psf_capture(path, &read.image);
    let (psf, note) = psf_from_capture(read, camera, dark).map_err(|e| e.within(path))?;
    // Binning changes the noise and the size of a pinhole.
    let psf = psf.with_capture(capture.filter(|_| note.is_none()));
    let note = note.map(|note| format!("{}: {note}", path.display()));
    Ok((psf.into(), note))
}

/// Reads the true video and checks it by [`checked_truth`]. One of another shape is refused before it is read.
///
/// # Errors
/// A file that cannot be read, and those of [`checked_truth`].
pub fn read_truth(path: &Path, camera: &Camera) -> Result<Video> {
    let subject = Subject::from(path).of(Parameter::Truth);
    check_truth_shape(read_video_shape(path)?, &subject, camera)?;
    let video = read_video(path)?;
    info!("read {}: {}", path.display(), video.shape());
    checked_truth(video, subject, camera)
}

/// Checks that `video` is finite and has the shape that `camera` gives. `subject` is the truth in errors.
///
/// # Errors
/// Another shape, or a value that is not finite.
pub fn checked_truth(video: Video, subject: Subject, camera: &Camera) -> Result<Video> {
    let shape = video.shape();
    check_truth_shape(shape, &subject, camera)?;
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
            phrase![
                "Leave ",
                Parameter::Truth,
                " out to reconstruct without a comparison."
            ],
        )
        .with_kind(ErrorKind::NotFinite));
    }
    Ok(video)
}

fn check_truth_shape(shape: Shape, subject: &Subject, camera: &Camera) -> Result<()> {
    if shape == camera.video_shape() {
        return Ok(());
    }
    Err(Error::input(
        subject.clone(),
        shape,
        format!("the camera gives a video of {}", camera.video_shape()),
        phrase![
            "Leave ",
            Parameter::Truth,
            " out, or give the truth on the grid of the reconstruction."
        ],
    ))
}
