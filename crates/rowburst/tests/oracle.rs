//! The forward model against brute force in float64 (`tests/oracle`).

mod common;

use common::{camera_of, oracle_cases, read_f32};
use rowburst::linop::LinearOperator;
use rowburst::{Image, Psf, RollingShutter};

#[test]
fn every_case_agrees_to_1e_5() {
    for case in oracle_cases() {
        let camera = camera_of(&case);
        let (shape, psf) = read_f32(&case.join("psf.npy"));
        let psf = Psf::new(Image::new(shape[0], shape[1], psf).unwrap()).unwrap();
        let (_, video) = read_f32(&case.join("video.npy"));
        let (_, expected) = read_f32(&case.join("frame.npy"));
        let operator = RollingShutter::new(&camera, &psf);
        let mut frame = vec![f32::NAN; operator.range_len()];
        operator.apply(&video, &mut frame);
        let error = rowburst::vecmath::distance_squared(&frame, &expected).sqrt()
            / rowburst::vecmath::norm(&expected);
        println!("{}: {error:.2e}", case.display());
        assert!(error < 1e-5, "{}: relative error {error}", case.display());
    }
}
