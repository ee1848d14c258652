//! What the camera records without the diffuser: the rolling-shutter artefact of
//! the paper's Fig. 1a, where every row shows the scene at its own time.
//!
//! ```text
//! b[r, x] = Σ_j w[r, j] · v[j, r + oy, x + ox]                       (Eq. 2)
//! ```

use rowburst_optics::{Camera, Image, Video};

/// The frame of `camera` when the scene `video` is imaged sharply onto it.
///
/// # Shapes
/// `video` has the shape `camera.video_shape()`; the frame is rows × columns.
///
/// # Units
/// Those of the video times row times.
///
/// # Panics
/// If the video has another shape.
pub fn direct_frame(camera: &Camera, video: &Video) -> Image {
    let shape = camera.video_shape();
    assert_eq!(video.shape(), shape, "a scene has the camera's video shape");
    let (oy, ox) = camera.field_offset();
    let columns = camera.columns();
    let mut frame = Image::zeros(camera.rows(), columns);
    let rows = frame.data_mut().chunks_exact_mut(columns);
    for ((row, r), &k) in rows.zip(camera.sensor_rows()).zip(camera.instants()) {
        let instant = &camera.time().instants()[k];
        let start = (r + oy) * shape.columns + ox;
        for (i, &weight) in instant.weights.iter().enumerate() {
            let bin = video.bin(instant.first_bin + i);
            for (pixel, &value) in row.iter_mut().zip(&bin[start..start + columns]) {
                *pixel += (weight * f64::from(value)) as f32;
            }
        }
    }
    frame
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_optics::camera::CameraParams;
    use rowburst_optics::{Sensor, Shutter};

    fn camera(exposure_us: f64, field: Option<(usize, usize)>) -> Camera {
        Camera::new(CameraParams {
            rows: 3,
            columns: 2,
            shutter: Shutter::BottomUp,
            row_time_us: 10.0,
            exposure_us,
            bins_per_row: 1,
            field,
            sensor: Sensor::default(),
        })
        .unwrap()
    }

    /// Voxel `(t, y, x)` has the value `100 t + 10 y + x`.
    fn labelled(camera: &Camera) -> Video {
        let mut video = Video::zeros(camera.video_shape());
        let columns = video.shape().columns;
        for t in 0..video.shape().bins {
            for (i, value) in video.bin_mut(t).iter_mut().enumerate() {
                *value = (100 * t + 10 * (i / columns) + i % columns) as f32;
            }
        }
        video
    }

    #[test]
    fn every_row_shows_its_own_time() {
        let camera = camera(10.0, None);
        let frame = direct_frame(&camera, &labelled(&camera));
        assert_eq!(frame.data(), &[200.0, 201.0, 110.0, 111.0, 20.0, 21.0]);
    }

    #[test]
    fn a_long_exposure_sums_bins_by_their_overlap() {
        let camera = camera(15.0, None);
        // The last row is read at the end of bin 1 and holds half of bin 0.
        let frame = direct_frame(&camera, &labelled(&camera));
        assert_eq!(frame.row(2), &[0.5 * 20.0 + 120.0, 0.5 * 21.0 + 121.0]);
        assert_eq!(frame.row(0), &[0.5 * 200.0 + 300.0, 0.5 * 201.0 + 301.0]);
    }

    #[test]
    fn a_larger_field_is_centred_on_the_sensor() {
        let camera = camera(10.0, Some((6, 5)));
        // Offsets (6 − 3)/2 = 1 and (5 − 2)/2 = 1.
        let frame = direct_frame(&camera, &labelled(&camera));
        assert_eq!(frame.data(), &[211.0, 212.0, 121.0, 122.0, 31.0, 32.0]);
    }
}
