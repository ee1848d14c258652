//! A field wider than the memory effect's range: patches against a single PSF.

use rand::{RngExt, SeedableRng};
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Options, Prior, Problem};
use rowburst::simulate::scene;
use rowburst::{Camera, Image, PatchSet, Psf, RollingShutter, Sensor, Shutter};
use std::ops::ControlFlow;

const ROWS: usize = 48;
const COLUMNS: usize = 64;

/// A complex speckle field with a grain of three pixels.
fn field(rng: &mut rand_pcg::Pcg64, rows: usize, columns: usize) -> Vec<(f32, f32)> {
    let (high, wide) = (rows + 2, columns + 2);
    let white: Vec<(f32, f32)> = (0..high * wide)
        .map(|_| {
            let phase = rng.random_range(0.0..std::f32::consts::TAU);
            (phase.cos(), phase.sin())
        })
        .collect();
    (0..rows * columns)
        .map(|at| {
            let near = (0..9).map(|k| white[(at / columns + k / 3) * wide + at % columns + k % 3]);
            near.fold((0.0, 0.0), |sum, e| (sum.0 + e.0, sum.1 + e.1))
        })
        .collect()
}

/// The PSF at `dx` pixels from the middle of the field: `|cos θ E₀ + sin θ E₁|²`, so that
/// the correlation of intensities falls as `cos² Δθ`, to a half over 16 pixels.
fn psf_at(dx: f64, fields: &[Vec<(f32, f32)>; 2]) -> Psf {
    let (sin, cos) = (dx / 16.0 * std::f64::consts::FRAC_PI_4).sin_cos();
    let (sin, cos) = (sin as f32, cos as f32);
    let mix = |a: &(f32, f32), b: &(f32, f32)| {
        (cos * a.0 + sin * b.0).powi(2) + (cos * a.1 + sin * b.1).powi(2)
    };
    let pairs = fields[0].iter().zip(&fields[1]);
    let values = pairs.map(|(a, b)| mix(a, b)).collect();
    Psf::new(Image::new(2 * ROWS - 1, 2 * COLUMNS - 1, values).unwrap()).unwrap()
}

/// Captures every `spacing` pixels along x.
fn captured(spacing: i32, fields: &[Vec<(f32, f32)>; 2]) -> PatchSet {
    let places: Vec<f64> = (-32..=32)
        .filter(|x| x % spacing == 0)
        .map(f64::from)
        .collect();
    let psfs = places.iter().map(|&dx| psf_at(dx, fields)).collect();
    PatchSet::new(psfs, places.iter().map(|&dx| (0.0, dx)).collect()).unwrap()
}

#[test]
fn patches_beat_a_single_psf_on_a_wide_field() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(21);
    let size = (2 * ROWS - 1, 2 * COLUMNS - 1);
    let fields = [(); 2].map(|()| field(&mut rng, size.0, size.1));
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
    // The optics: a PSF of its own every second pixel.
    let operator = RollingShutter::new(&camera, captured(2, &fields));
    let truth = scene::digits(camera.video_shape(), 8, 4).unwrap();
    let mut frame = vec![0.0; operator.range_len()];
    operator.apply(truth.data(), &mut frame);
    let frame = Image::new(ROWS, COLUMNS, frame).unwrap();
    let noise = Noise::Gaussian { snr: 256.0 };
    let recorded = noise.apply(&frame, camera.sensor(), 7).unwrap();
    let measurement = Measurement::new(recorded.frame).unwrap();
    let psnr = |psfs: PatchSet| {
        let options = Options {
            prior: Some(Prior::STANDARD),
            max_iterations: Some(120),
            ..Options::default()
        };
        let problem = Problem::new(&measurement, &camera, psfs, options).unwrap();
        let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
        psnr_db(found.video.data(), truth.data())
    };
    let single = psnr(psf_at(0.0, &fields).into());
    let patches = psnr(captured(8, &fields));
    println!("single PSF {single:.1} dB, nine patches {patches:.1} dB");
    assert!(patches > single + 6.0 && patches > 30.0);
}
