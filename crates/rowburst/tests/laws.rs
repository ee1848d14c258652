//! The operator laws (linearity, adjoint, overwriting) for every kind of camera, with
//! odd, even and non-square shapes, and for both ways of convolving.

use rand::{RngExt, SeedableRng};
use rowburst::camera::CameraParams;
use rowburst::linop::{LinearOperator, Weighted, laws};
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
                let operator = RollingShutter::new(&camera, &Psf::new(image).unwrap());
                laws::check(&operator, 1);
                let weights = (0..operator.range_len()).map(|i| (i % 3) as f32).collect();
                laws::check(&Weighted::new(operator, Some(weights)), 2);
            }
        }
    }
}
