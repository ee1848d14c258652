//! How many numbers of an instant speak about the change of a known scene; see [`count_change`] for the formula.

use rowburst_optics::Video;
pub use rowburst_optics::forward::count::{ChangeCount, MIN_INFORMATIVE, count_change};

/// Root mean square of what a video has beside its mean over time.
pub fn change_rms(video: &Video) -> f64 {
    let shape = video.shape();
    let sum: f64 = (0..shape.pixels())
        .map(|i| {
            let values = (0..shape.bins).map(|t| f64::from(video.bin(t)[i]));
            let mean = values.clone().sum::<f64>() / shape.bins as f64;
            values.map(|v| (v - mean).powi(2)).sum::<f64>()
        })
        .sum();
    (sum / shape.voxels() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_core::linop::LinearOperator;
    use rowburst_optics::camera::CameraParams;
    use rowburst_optics::{Camera, RollingShutter, Sensor, Shutter};
    use rowburst_simulate::scene::{DenseScene, dense};
    use rowburst_simulate::{SpeckleOptics, speckle_psf};

    fn operator(n: usize) -> (Camera, RollingShutter) {
        let camera = Camera::new(CameraParams {
            rows: n,
            columns: n,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let psf = speckle_psf(&SpeckleOptics::demo(), 2 * n - 1, 2 * n - 1, 1).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        (camera, operator)
    }

    #[test]
    fn counts_between_none_and_all_and_grows_with_the_change() {
        let (_, operator) = operator(24);
        let of = |change| count_change(&operator, 1.0, change).unwrap().informative;
        assert_eq!(of(0.0), 0.0);
        let counts = [1e-3, 1.0, 10.0, 1e6].map(of);
        assert!(counts.windows(2).all(|w| w[0] < w[1]), "{counts:?}");
        assert!(counts[0] < 0.1 && counts[3] > 47.0 && counts[3] <= 48.0 + 1e-6);
    }

    #[test]
    fn a_beam_is_beyond_the_line_and_cells_are_not() {
        let (camera, operator) = operator(54);
        let of = |scene| {
            let video = dense(scene, camera.video_shape(), 3).unwrap();
            let mut frame = vec![0.0; operator.range_len()];
            operator.apply(video.data(), &mut frame);
            let rms = rowburst_core::vecmath::norm(&frame) / (frame.len() as f64).sqrt();
            count_change(&operator, rms / 256.0, change_rms(&video)).unwrap()
        };
        let (beam, cells) = (of(DenseScene::Beam), of(DenseScene::Cells));
        assert!(beam.is_too_few(), "{beam:?}");
        assert!(!cells.is_too_few(), "{cells:?}");
        assert!(of(DenseScene::Still).informative < 1e-3);
    }
}
