//! How bright a frame is, from how bright its scene is.

use super::require_positive;
use rowburst_core::{Error, Parameter, Result};
use rowburst_optics::{Camera, Image, Video};

/// Mean electrons of the brightest pixel of the frame, raw and before binning, where the
/// brightest scene pixel sends `scene_electrons` to the sensor in one bin.
///
/// ```text
/// e[r, x] = b[r, x] · scene_electrons · bins_per_row / (max(v) · binning²),      b = A v
/// ```
///
/// The PSF sums to 1, so these electrons spread over it; most fall on rows that are read at
/// another time, and are lost. `A` counts time in row times: a bin is `1/bins_per_row` of one.
///
/// # Shapes
/// `noiseless` is `A v`, the frame of `scene` without noise.
///
/// # Units
/// Electrons.
///
/// # Errors
/// `scene_electrons` that is not a number above zero, a dark scene.
pub fn peak_electrons(
    camera: &Camera,
    scene: &Video,
    noiseless: &Image,
    scene_electrons: f64,
) -> Result<f64> {
    require_positive(
        Parameter::SceneElectrons,
        scene_electrons,
        "electrons",
        "Give those of the brightest scene pixel in one bin, such as 200.",
    )?;
    let brightest = f64::from(scene.max());
    if !(brightest.is_finite() && brightest > 0.0) {
        return Err(Error::input(
            Parameter::Scene,
            format!("a brightest value of {brightest}"),
            "the brightest scene pixel is above zero, or electrons cannot be counted from it",
            "Check that the scene is not empty.",
        ));
    }
    let raw_pixels = (camera.sensor().binning as f64).powi(2);
    let per_unit = scene_electrons * camera.params().bins_per_row as f64 / (brightest * raw_pixels);
    Ok(f64::from(noiseless.max()) * per_unit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::Noise;
    use rowburst_core::linop::LinearOperator;
    use rowburst_optics::camera::CameraParams;
    use rowburst_optics::{Psf, RollingShutter, Sensor, Shutter};

    fn camera(bins_per_row: usize, binning: usize, shutter: Shutter) -> Camera {
        Camera::new(CameraParams {
            rows: 20,
            columns: 16,
            shutter,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row,
            field: None,
            sensor: Sensor {
                binning,
                ..Sensor::default()
            },
        })
        .unwrap()
    }

    /// A PSF that spreads light evenly over 5×5 pixels.
    fn even() -> Psf {
        Psf::new(Image::from_fn(5, 5, |_, _| 1.0)).unwrap()
    }

    fn noiseless(camera: &Camera, scene: &Video) -> Image {
        let operator = RollingShutter::new(camera, even());
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(scene.data(), &mut frame);
        frame.iter_mut().for_each(|b| *b = b.max(0.0));
        Image::new(camera.rows(), camera.columns(), frame).unwrap()
    }

    /// One pixel, always lit: every row of the PSF is read once and gets a fifth.
    #[test]
    fn electrons_are_those_that_the_scene_sends() {
        // (bins a row, binning, light of a row time over that of a bin)
        for (bins_per_row, binning, bins) in [(1, 1, 1.0), (2, 1, 2.0), (1, 2, 1.0)] {
            let camera = camera(bins_per_row, binning, Shutter::TopDown);
            let shape = camera.video_shape();
            let mut scene = Video::zeros(shape);
            for t in 0..shape.bins {
                scene.bin_mut(t)[10 * shape.columns + 8] = 4.0;
            }
            let frame = noiseless(&camera, &scene);
            let electrons = peak_electrons(&camera, &scene, &frame, 5000.0).unwrap();
            let want = 5000.0 * bins / 25.0 / (binning * binning) as f64;
            assert!((electrons / want - 1.0).abs() < 1e-4, "{electrons} {want}");

            let noise = Noise::Camera {
                peak_electrons: electrons,
            };
            let sum: f64 = (0..40)
                .map(|seed| noise.apply(&frame, camera.sensor(), seed).unwrap())
                .map(|r| r.frame.data().iter().map(|&p| f64::from(p)).sum::<f64>())
                .sum::<f64>()
                / 40.0
                * (binning * binning) as f64;
            // 40 frames of some 5000 electrons: within 5 standard errors.
            let total = 5000.0 * bins;
            let allowed = 5.0 * (total / 40.0).sqrt();
            assert!((sum - total).abs() < allowed, "{sum} {total}");
        }
    }

    #[test]
    fn a_brighter_unit_changes_nothing() {
        let camera = camera(1, 1, Shutter::DualInsideOut);
        let shape = camera.video_shape();
        let values = (0..shape.voxels()).map(|i| (i % 7) as f32).collect();
        let scene = Video::new(shape, values).unwrap();
        let mut brighter = scene.clone();
        brighter.data_mut().iter_mut().for_each(|v| *v *= 1000.0);
        let of = |scene: &Video| {
            peak_electrons(&camera, scene, &noiseless(&camera, scene), 200.0).unwrap()
        };
        assert!((of(&scene) / of(&brighter) - 1.0).abs() < 1e-5);
    }

    #[test]
    fn bad_input_is_refused() {
        let camera = camera(1, 1, Shutter::TopDown);
        let dark = Video::zeros(camera.video_shape());
        let frame = Image::zeros(20, 16);
        assert!(peak_electrons(&camera, &dark, &frame, 200.0).is_err());
        let mut lit = dark;
        lit.data_mut()[0] = 1.0;
        for electrons in [0.0, -2.0, f64::NAN, f64::INFINITY] {
            let error = peak_electrons(&camera, &lit, &frame, electrons).unwrap_err();
            assert!(error.to_string().contains("scene_electrons"), "{error}");
        }
    }
}
