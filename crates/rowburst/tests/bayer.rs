//! A raw colour frame on the whole road: three scenes, one mosaic, four planes reconstructed.

use rowburst::bayer::{Bayer, Colour, plane_camera, plane_image, plane_psf};
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Options, Prior, Problem};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::{Camera, Image, RollingShutter, Sensor, Shape, Shutter, Video};
use std::ops::ControlFlow;

const ROWS: usize = 96;
const COLUMNS: usize = 80;

/// Each cell of the scene covers 2×2 pixels of the sensor.
fn on_sensor(scene: &Video) -> Vec<f32> {
    let shape = scene.shape();
    let mut fine = Vec::new();
    for t in 0..shape.bins {
        for y in 0..ROWS {
            for x in 0..COLUMNS {
                fine.push(scene.bin(t)[(y / 2) * shape.columns + x / 2]);
            }
        }
    }
    fine
}

#[test]
fn planes_give_the_scenes_of_their_colours() {
    let camera = Camera::new(CameraParams {
        rows: ROWS,
        columns: COLUMNS,
        shutter: Shutter::DualInsideOut,
        row_time_us: 10.0,
        exposure_us: 10.0,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .unwrap();
    let optics = SpeckleOptics {
        diffuser_fwhm_deg: 0.5,
        ..SpeckleOptics::demo()
    };
    let psf = speckle_psf(&optics, 2 * ROWS - 1, 2 * COLUMNS - 1, 5).unwrap();
    let operator = RollingShutter::new(&camera, &psf);
    let shape = Shape::new(ROWS / 2, ROWS / 2, COLUMNS / 2);
    let truth_of = |colour: Colour| scene::moving_digit(shape, 8, 1, colour as u64 + 3).unwrap();
    let frame_of = |colour: Colour| {
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(&on_sensor(&truth_of(colour)), &mut frame);
        Image::new(ROWS, COLUMNS, frame).unwrap()
    };
    let mosaic = Bayer::Grbg;
    let sites = mosaic.sites();
    let frames = sites.map(|site| frame_of(site.colour));
    let noiseless = Image::from_fn(ROWS, COLUMNS, |y, x| frames[2 * (y % 2) + x % 2].at(y, x));
    let noise = Noise::Gaussian { snr: 256.0 };
    let raw = noise.apply(&noiseless, camera.sensor(), 7).unwrap().frame;

    let options = Options {
        prior: Some(Prior::STANDARD),
        ..Options::default()
    };
    for site in sites {
        let plane = plane_camera(&camera, site).unwrap();
        // Both halves in turn: a row in every instant, nothing is lost in time.
        assert_eq!(plane.camera.video_shape(), shape);
        assert_eq!(plane.start_us, 0.0);
        let psf = plane_psf(&psf, site).unwrap();
        let measurement = Measurement::new(plane_image(&raw, site)).unwrap();
        let problem = Problem::new(&measurement, &plane.camera, &psf, options).unwrap();
        let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
        let psnr = |colour| psnr_db(found.video.data(), truth_of(colour).data());
        let others = [Colour::Red, Colour::Green, Colour::Blue];
        let other = others.into_iter().filter(|c| *c != site.colour);
        let other = other.map(psnr).fold(0.0, f64::max);
        let own = psnr(site.colour);
        println!("{}: {own:.1} dB, another colour {other:.1}", site.name());
        // Half of the measurements of a dual shutter for each bin, as with a single one.
        assert!(
            own > 22.0 && own > other + 4.0,
            "{}: {own} {other}",
            site.name()
        );
    }
}
