//! What each prior is for: small scenes on which it does better than total variation
//! in space, and one table of all priors on all scenes (printed with `--ignored`).

use rand::{RngExt, SeedableRng};
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Problem, Recipe};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shape, Shutter, Video};
use std::ops::ControlFlow;

const ROWS: usize = 48;
const COLUMNS: usize = 40;

fn camera(shutter: Shutter) -> Camera {
    Camera::new(CameraParams {
        rows: ROWS,
        columns: COLUMNS,
        shutter,
        row_time_us: 10.0,
        exposure_us: 10.0,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .unwrap()
}

/// A scene seen at SNR 256 through a speckle, two rows at a time.
struct Case {
    camera: Camera,
    psf: Psf,
    truth: Video,
    measurement: Measurement,
}

impl Case {
    fn new(scene: impl Fn(Shape) -> Video) -> Self {
        let camera = camera(Shutter::DualInsideOut);
        let optics = SpeckleOptics {
            diffuser_fwhm_deg: 0.5,
            ..SpeckleOptics::demo()
        };
        let psf = speckle_psf(&optics, 2 * ROWS - 1, 2 * COLUMNS - 1, 5).unwrap();
        let truth = scene(camera.video_shape());
        let operator = RollingShutter::new(&camera, &psf);
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(truth.data(), &mut frame);
        let noiseless = Image::new(ROWS, COLUMNS, frame).unwrap();
        let recorded = Noise::Gaussian { snr: 256.0 }
            .apply(&noiseless, camera.sensor(), 7)
            .unwrap();
        Self {
            measurement: Measurement::new(recorded.frame).unwrap(),
            camera,
            psf,
            truth,
        }
    }

    /// PSNR of the reconstruction with `prior`.
    fn psnr(&self, prior: &str) -> f64 {
        let recipe = Recipe {
            prior: prior.parse().unwrap(),
            ..Recipe::default()
        };
        let problem = Problem::new(&self.measurement, &self.camera, &self.psf, recipe).unwrap();
        let start = std::time::Instant::now();
        let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
        let psnr = psnr_db(found.video.data(), self.truth.data());
        println!(
            "{prior:>20}: {psnr:.1} dB, residual/σ {:.2}, {} iterations, {:.1} s",
            found.residual_over_sigma,
            found.iterations,
            start.elapsed().as_secs_f64()
        );
        psnr
    }
}

fn video(shape: Shape, value: impl Fn(usize, f64, f64) -> f64) -> Video {
    let data = (0..shape.voxels())
        .map(|i| {
            let (t, pixel) = (i / shape.pixels(), i % shape.pixels());
            let (y, x) = (pixel / shape.columns, pixel % shape.columns);
            value(t, y as f64, x as f64) as f32
        })
        .collect();
    Video::new(shape, data).unwrap()
}

/// A value of 0 to 1 for each of `bins` × `count`.
fn traces(bins: usize, count: usize, seed: u64) -> Vec<f64> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    (0..bins * count).map(|_| rng.random()).collect()
}

fn spot(y: f64, x: f64, (cy, cx): (f64, f64), sigma: f64) -> f64 {
    (-((y - cy).powi(2) + (x - cx).powi(2)) / (2.0 * sigma * sigma)).exp()
}

/// Twelve points at fixed places, each bin of each as bright as chance has it.
fn blinking_points(shape: Shape) -> Video {
    let places: Vec<(f64, f64)> = (0..12)
        .map(|i| ((5 + i * 17 % 38) as f64, (4 + i * 11 % 32) as f64))
        .collect();
    let brightness = traces(shape.bins, 12, 1);
    video(shape, |t, y, x| {
        let lights = places.iter().zip(&brightness[12 * t..]);
        lights.map(|(place, b)| b * spot(y, x, *place, 0.6)).sum()
    })
}

fn moving_digit(shape: Shape) -> Video {
    scene::moving_digit(shape, 12, 1, 3).unwrap()
}

/// Three striped patches that overlap, each with a random trace.
fn blinking_textures(shape: Shape) -> Video {
    let brightness = traces(shape.bins, 3, 2);
    video(shape, |t, y, x| {
        let patch = |i: usize| {
            let place = [(14.0, 12.0), (24.0, 26.0), (34.0, 14.0)][i];
            let (fy, fx) = [(0.9, 0.5), (0.3, 1.1), (1.0, -0.7)][i];
            spot(y, x, place, 5.0) * (0.5 + 0.5 * (fy * y + fx * x).cos())
        };
        (0..3).map(|i| brightness[3 * t + i] * patch(i)).sum()
    })
}

/// Two soft blobs somewhere else in every bin.
fn smooth_blobs(shape: Shape) -> Video {
    let places = traces(shape.bins, 4, 3);
    video(shape, |t, y, x| {
        let at = &places[4 * t..];
        let place = |i: usize| (8.0 + 32.0 * at[i], 8.0 + 24.0 * at[i + 1]);
        spot(y, x, place(0), 5.0) + 0.7 * spot(y, x, place(2), 4.0)
    })
}

#[test]
#[ignore = "a table to look at"]
fn every_prior_on_every_scene() {
    type Scene = fn(Shape) -> Video;
    let scenes: [(&str, Scene); 4] = [
        ("blinking points", blinking_points),
        ("moving digit", moving_digit),
        ("blinking textures", blinking_textures),
        ("smooth blobs", smooth_blobs),
    ];
    for (name, scene) in scenes {
        let case = Case::new(scene);
        println!("{name}");
        for prior in [
            "tv",
            "l1",
            "tv+0.5*tdiff",
            "tv3d",
            "tv3d-aniso",
            "dct",
            "wavelet",
            "group",
            "group+0.2*l1",
            "lowrank",
            "lowrank+0.2*tv",
            "auto",
            "group+support",
        ] {
            case.psnr(prior);
        }
    }
}
