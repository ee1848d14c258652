//! The operator laws (linearity, adjoint, overwriting) for every kind of camera, with
//! odd, even and non-square shapes, and for both ways of convolving.

use rand::{RngExt, SeedableRng};
use rowburst::camera::CameraParams;
use rowburst::linop::{LinearOperator, WeightedOperator, laws};
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shutter};

#[test]
fn every_camera_obeys_them() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(4);
    let shutters = [
        Shutter::TopDown,
        Shutter::BottomUp,
        Shutter::DualInsideOut,
        Shutter::DualOutsideIn,
        Shutter::Global,
    ];
    let sizes = [
        ((10, 8), None, (19, 15)),
        ((11, 6), Some((15, 13)), (9, 40)),
        ((40, 33), Some((61, 50)), (30, 21)),
    ];
    for shutter in &shutters {
        for ((rows, columns), field, (psf_rows, psf_columns)) in sizes {
            for (exposure_us, bins_per_row) in [(1.0, 1), (0.4, 3), (2.5, 2)] {
                let camera = Camera::new(CameraParams {
                    rows,
                    columns,
                    shutter: shutter.clone(),
                    row_time_us: 1.0,
                    exposure_us,
                    bins_per_row,
                    field,
                    sensor: Sensor::default(),
                })
                .unwrap();
                let values = (0..psf_rows * psf_columns).map(|_| rng.random_range(0.0f32..1.0));
                let image = Image::new(psf_rows, psf_columns, values.collect()).unwrap();
                let psf = Psf::new(image).unwrap();
                laws::check(&RollingShutter::<f64>::with_precision(&camera, &psf), 3);
                let operator = RollingShutter::new(&camera, &psf);
                laws::check(&operator, 1);
                let weights = (0..operator.range_len()).map(|i| (i % 3) as f32).collect();
                laws::check(&WeightedOperator::new(operator, Some(weights)), 2);
            }
        }
    }
}

/// The sum of the conventions, term by term in float64.
fn brute_force(camera: &Camera, psf: &Psf, video: &[f32]) -> Vec<f64> {
    let shape = camera.video_shape();
    let (oy, ox) = camera.field_offset();
    let mut frame = Vec::new();
    for r in 0..camera.rows() {
        let run = &camera.time().instants()[camera.instants()[r]];
        for x in 0..camera.columns() {
            let mut sum = 0.0f64;
            for (k, weight) in run.weights.iter().enumerate() {
                for y in 0..shape.rows {
                    for field_x in 0..shape.columns {
                        let at = ((run.first_bin + k) * shape.rows + y) * shape.columns + field_x;
                        let dy = r as isize - (y as isize - oy as isize);
                        let dx = x as isize - (field_x as isize - ox as isize);
                        sum +=
                            weight * f64::from(video[at]) * f64::from(psf.at_displacement(dy, dx));
                    }
                }
            }
            frame.push(sum);
        }
    }
    frame
}

#[test]
fn global_wide_fields_and_parts_of_rows_agree_with_brute_force() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(9);
    let cases = [
        (Shutter::Global, 30, 24, Some((44, 39)), 1.0, 1),
        (Shutter::Global, 31, 17, None, 1.0, 1),
        (Shutter::DualInsideOut, 12, 9, Some((17, 14)), 0.7, 3),
        (Shutter::TopDown, 7, 8, Some((10, 8)), 2.3, 2),
    ];
    for (shutter, rows, columns, field, exposure_us, bins_per_row) in cases {
        let name = format!("{} {rows}×{columns} {field:?}", shutter.name());
        let camera = Camera::new(CameraParams {
            rows,
            columns,
            shutter,
            row_time_us: 1.0,
            exposure_us,
            bins_per_row,
            field,
            sensor: Sensor::default(),
        })
        .unwrap();
        let values = (0..23 * 28).map(|_| rng.random_range(0.0f32..1.0));
        let psf = Psf::new(Image::new(23, 28, values.collect()).unwrap()).unwrap();
        let video: Vec<f32> = (0..camera.video_shape().voxels())
            .map(|_| rng.random())
            .collect();
        let expected = brute_force(&camera, &psf, &video);
        let error = |frame: &[f64]| {
            let differences = frame.iter().zip(&expected).map(|(f, e)| (f - e).powi(2));
            let norm: f64 = expected.iter().map(|e| e * e).sum();
            (differences.sum::<f64>() / norm).sqrt()
        };
        let mut frame = vec![f32::NAN; expected.len()];
        RollingShutter::new(&camera, &psf).apply(&video, &mut frame);
        let frame: Vec<f64> = frame.into_iter().map(f64::from).collect();
        assert!(
            error(&frame) < 1e-5,
            "{name}: relative error {}",
            error(&frame)
        );
        let video: Vec<f64> = video.into_iter().map(f64::from).collect();
        let mut frame = vec![f64::NAN; expected.len()];
        RollingShutter::with_precision(&camera, &psf).apply(&video, &mut frame);
        assert!(
            error(&frame) < 1e-12,
            "{name}, f64: relative error {}",
            error(&frame)
        );
    }
}
