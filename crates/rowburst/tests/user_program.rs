//! What a user writes from the documentation: calibrate, reconstruct, save, and answer an error by its kind.

use ndarray::Array3;
use rowburst::calibrate::psf::{MergeParams, NamedCapture, centred_psfs, merge};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::{
    Camera, CameraParams, Corrections, ErrorKind, Image, LinearOperator, Options, Parameter,
    RawFrame, Result, RollingShutter, Sensor, Shutter,
};

/// Counts without light.
const BIAS: f32 = 100.0;

fn camera() -> Result<Camera> {
    Camera::new(CameraParams {
        rows: 24,
        columns: 24,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor {
            bias_counts: Some(f64::from(BIAS)),
            ..Sensor::default()
        },
    })
}

/// Captures of a laboratory: a point source, and a moving scene.
fn captures(camera: &Camera) -> Result<(Image, Image)> {
    let psf = speckle_psf(&SpeckleOptics::demo(), 47, 47, 1)?;
    let scale = 40_000.0 / psf.image().max();
    let source = Image::from_fn(47, 47, |y, x| BIAS + scale * psf.image().at(y, x));
    let truth = scene::moving_digit(camera.video_shape(), 12, 1, 1)?;
    let mut light = vec![0.0; 24 * 24];
    RollingShutter::<f32>::new(camera, &psf).apply(truth.data(), &mut light);
    let top = light.iter().copied().fold(0.0, f32::max);
    let counts = Image::from_fn(24, 24, |y, x| BIAS + 4000.0 * light[y * 24 + x] / top);
    Ok((source, counts))
}

#[test]
fn calibrate_reconstruct_and_save() -> Result<()> {
    let camera = camera()?;
    let (source, counts) = captures(&camera)?;

    let dark = Some(Image::from_fn(source.rows(), source.columns(), |_, _| BIAS));
    let shot = NamedCapture {
        name: "psf.tif".into(),
        image: source,
    };
    let light = merge(
        &[shot],
        &MergeParams {
            dark,
            ..MergeParams::default()
        },
    )?;
    let psf = centred_psfs(&[&light.image], &[(0.0, 0.0)])?.remove(0);

    let cropped = RawFrame::new(Image::zeros(20, 24));
    let frame = match cropped.correct(&camera, &Corrections::default()) {
        Err(error) if error.kind() == ErrorKind::Shape => {
            assert_eq!(error.parameter(), Some(Parameter::Frame));
            RawFrame::new(counts).correct(&camera, &Corrections::default())?
        }
        other => other?,
    };
    let result = rowburst::reconstruct(&frame, &camera, &psf, &Options::default())?;

    let shape = result.video.shape();
    let sides = (shape.bins, shape.rows, shape.columns);
    let video = Array3::from_shape_vec(sides, result.video.into_data()).unwrap();
    let path = std::env::temp_dir().join(format!("user_program_{}.npy", std::process::id()));
    ndarray_npy::write_npy(&path, &video).unwrap();
    let read: Array3<f32> = ndarray_npy::read_npy(&path).unwrap();
    std::fs::remove_file(&path).unwrap();
    assert_eq!(read, video);
    assert!(video.sum() > 0.0);
    Ok(())
}
