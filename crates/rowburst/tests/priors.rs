//! What each prior is for: small scenes on which it does better than total variation
//! in space, and one table of all priors on all scenes (printed with `--ignored`).

use rand::{RngExt, SeedableRng};
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{DENSE_CANDIDATES, OPEN_CANDIDATES, Options, Problem, Tau};
use rowburst::simulate::scene::DenseScene;
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
        let options = Options {
            prior: Some(prior.parse().unwrap()),
            ..Options::default()
        };
        let problem = Problem::new(&self.measurement, &self.camera, &self.psf, options).unwrap();
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

/// Three speckled patches of 7 × 7 pixels, each with a random trace.
fn blinking_textures(shape: Shape) -> Video {
    let brightness = traces(shape.bins, 3, 2);
    let texture = traces(49, 3, 4);
    video(shape, |t, y, x| {
        let patch = |i: usize| {
            let (y0, x0) = [(8.0, 6.0), (20.0, 25.0), (34.0, 12.0)][i];
            let inside = (0.0..7.0).contains(&(y - y0)) && (0.0..7.0).contains(&(x - x0));
            if inside {
                texture[((y - y0) * 7.0 + x - x0) as usize * 3 + i]
            } else {
                0.0
            }
        };
        (0..3).map(|i| brightness[3 * t + i] * patch(i)).sum()
    })
}

/// A bright field with three long waves, other ones in every bin.
fn waves(shape: Shape) -> Video {
    let random = traces(shape.bins, 9, 5);
    video(shape, |t, y, x| {
        let wave = |i: usize| {
            let of = &random[9 * t + 3 * i..];
            let (ky, kx) = ((6.0 * of[0]).floor(), (6.0 * of[1]).floor());
            let along = |k: f64, at: f64, n: usize| {
                (std::f64::consts::PI * (at + 0.5) * k / n as f64).cos()
            };
            (0.3 + 0.7 * of[2]) * along(ky, y, ROWS) * along(kx, x, COLUMNS)
        };
        3.0 + (0..3).map(wave).sum::<f64>()
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

/// Discs and a bar three times as bright as the digit that moves before them, flickering with
/// `flicker` as a whole.
fn before_a_background(shape: Shape, flicker: f64) -> Video {
    let moving = moving_digit(shape);
    let level = traces(shape.bins, 1, 6);
    video(shape, |t, y, x| {
        let disc = |cy: f64, cx: f64, r: f64| f64::from(u8::from((y - cy).hypot(x - cx) < r));
        let bar = f64::from(u8::from((30.0..34.0).contains(&y) && x > 6.0));
        let still = 3.0 * disc(14.0, 10.0, 6.0) + 1.5 * disc(25.0, 30.0, 5.0) + bar;
        let at = t * shape.pixels() + y as usize * shape.columns + x as usize;
        f64::from(moving.data()[at]) + (1.0 + flicker * (level[t] - 0.5)) * still
    })
}

/// `prior` is better than `tv` by at least `by` dB on `scene`, and at least `at_least`.
fn beats_tv(scene: fn(Shape) -> Video, prior: &str, by: f64, at_least: f64) {
    let case = Case::new(scene);
    let (tv, found) = (case.psnr("tv"), case.psnr(prior));
    assert!(
        found > tv + by && found > at_least,
        "{prior} {found}, tv {tv}"
    );
}

#[test]
fn group_finds_points_that_blink_at_fixed_places() {
    beats_tv(blinking_points, "group", 9.0, 37.0);
}

#[test]
fn a_background_is_separated() {
    let still = |shape| before_a_background(shape, 0.0);
    beats_tv(still, "tv+0.5*tdiff+0.3*l1+background", 6.0, 24.0);
    let flickering = |shape| before_a_background(shape, 0.6);
    beats_tv(flickering, "tv+0.5*tdiff+l1+lowrank-background", 1.0, 15.0);
}

/// The check of the model explains a wheel before its support is known; a support tells nothing there.
#[test]
fn auto_compares_still_priors_in_a_dense_scene() {
    let case = Case::new(|shape| scene::dense(DenseScene::Wheel, shape, 1).unwrap());
    let options = Options::default();
    let problem = Problem::new(&case.measurement, &case.camera, &case.psf, options).unwrap();
    let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
    let choice = found.choice.unwrap();
    let tried: Vec<String> = choice
        .candidates
        .iter()
        .map(|c| c.prior.to_string())
        .collect();
    let dense = OPEN_CANDIDATES.iter().chain(&DENSE_CANDIDATES);
    for prior in dense {
        assert!(
            tried.iter().any(|t| t == prior),
            "{prior} is not in {tried:?}"
        );
    }
    assert!(!tried.iter().any(|t| t == "group+support"), "{tried:?}");
    assert!(!found.prior.support, "{}", found.prior);
}

/// Of a scene at rest one picture predicts as well as any video, and is the better one; the discrepancy principle alone
/// would smooth it too little.
#[test]
fn auto_takes_a_scene_at_rest_for_one_picture() {
    let case = Case::new(|shape| scene::dense(DenseScene::Still, shape, 1).unwrap());
    let problem = |prior: Option<&str>| {
        let options = Options {
            prior: prior.map(|prior| prior.parse().unwrap()),
            ..Options::default()
        };
        Problem::new(&case.measurement, &case.camera, &case.psf, options).unwrap()
    };
    let solved = |problem: Problem| problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
    let psnr = |video: &Video| psnr_db(video.data(), case.truth.data());
    let found = solved(problem(None));
    assert_eq!(found.prior.to_string(), "background");
    let (video, shape) = (&found.video, case.truth.shape());
    assert_eq!(video.shape(), shape);
    assert!((1..shape.bins).all(|t| video.bin(t) == video.bin(0)));
    assert_eq!(found.background.as_ref(), Some(video));
    let [at_rest, named, stiff] = [
        psnr(video),
        psnr(&solved(problem(Some("background"))).video),
        psnr(&solved(problem(Some("tv+16*tdiff"))).video),
    ];
    println!("{at_rest:.2} dB, by name {named:.2} dB, tv+16*tdiff {stiff:.2} dB");
    assert!(at_rest > stiff + 1.0 && (named - at_rest).abs() < 0.5);
}

/// The first noise levels of a picture without dark areas are far above what its video leaves, and tell nothing.
#[test]
fn a_noise_level_by_held_out_pixels_is_that_of_a_dense_scene() {
    for scene in [DenseScene::Still, DenseScene::Wheel] {
        let case = Case::new(|shape| scene::dense(scene, shape, 1).unwrap());
        let options = Options {
            prior: Some("tv+8*tdiff".parse().unwrap()),
            tau: Tau::HeldOut,
            ..Options::default()
        };
        let problem = Problem::new(&case.measurement, &case.camera, &case.psf, options).unwrap();
        let expected = problem.sigma();
        let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
        let ratio = found.sigma / expected;
        println!("{ratio:.2} times σ");
        assert!((0.5..2.0).contains(&ratio), "{ratio}");
    }
}

#[test]
fn tv3d_follows_a_moving_digit() {
    beats_tv(moving_digit, "tv3d", 3.5, 28.5);
    beats_tv(moving_digit, "tv3d-aniso", 3.0, 28.0);
}

/// Alone, and better beside a term that says where the light is.
#[test]
fn lowrank_finds_textures_that_blink() {
    beats_tv(blinking_textures, "lowrank", 1.0, 22.5);
    beats_tv(blinking_textures, "lowrank+0.3*group", 5.0, 26.5);
}

#[test]
fn wavelet_finds_soft_blobs() {
    beats_tv(smooth_blobs, "wavelet", 2.5, 22.8);
}

#[test]
fn dct_finds_waves() {
    beats_tv(waves, "dct", 0.8, 20.0);
}

/// Multiplying the weights of a prior multiplies nothing but `1/τ`.
#[test]
fn a_common_weight_changes_nothing() {
    let case = Case::new(blinking_points);
    let (one, four) = (case.psnr("group"), case.psnr("4*group"));
    assert!((one - four).abs() < 0.01, "{one} {four}");
}

#[test]
fn a_prior_over_time_is_refused_for_one_bin() {
    let frame = Image::from_fn(ROWS, COLUMNS, |y, x| (1 + (y * x) % 7) as f32);
    let measurement = Measurement::new(frame).unwrap();
    let psf = Psf::new(Image::from_fn(5, 5, |_, _| 1.0)).unwrap();
    let set_up = |prior: &str| {
        let options = Options {
            prior: Some(prior.parse().unwrap()),
            noise_sigma: Some(1.0),
            ..Options::default()
        };
        Problem::new(&measurement, &camera(Shutter::Global), &psf, options)
    };
    assert!(set_up("tv+0.5*tdiff+support").is_ok() && set_up("dct").is_ok());
    let error = set_up("tv+group").err().unwrap().to_string();
    assert!(error.contains("group compares bins"), "{error}");
}

#[test]
#[ignore = "a table to look at"]
fn every_prior_on_every_scene() {
    type Scene = fn(Shape) -> Video;
    let scenes: [(&str, Scene); 5] = [
        ("blinking points", blinking_points),
        ("moving digit", moving_digit),
        ("blinking textures", blinking_textures),
        ("smooth blobs", smooth_blobs),
        ("waves", waves),
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
            "lowrank+0.3*group",
            "tv+0.5*tdiff+support",
            "tv3d+support",
            "tv3d-aniso+support",
            "group+support",
        ] {
            case.psnr(prior);
        }
    }
}
