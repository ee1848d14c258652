//! Frames that the model does not explain: foreign pixels, a wrong PSF, voxels that the frame does not observe.

mod common;

use common::distorted;
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::{self, Corrections, Measurement};
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Options, Prior, Problem, Reconstruction, SelfCalibration, Verdict};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shape, Shutter, Video};
use std::ops::ControlFlow;

const ROWS: usize = 64;
const COLUMNS: usize = 60;

#[derive(Clone)]
struct Case {
    camera: Camera,
    psf: Psf,
    truth: Video,
    frame: Image,
}

fn camera(shutter: Shutter, field: Option<(usize, usize)>) -> Camera {
    Camera::new(CameraParams {
        rows: ROWS,
        columns: COLUMNS,
        shutter,
        row_time_us: 10.0,
        exposure_us: 10.0,
        bins_per_row: 1,
        field,
        sensor: Sensor::default(),
    })
    .unwrap()
}

fn psf(camera: &Camera, seed: u64) -> Psf {
    psf_of(0.6, camera, seed)
}

/// The PSF of a diffuser that scatters by `diffuser_fwhm_deg` degrees.
fn psf_of(diffuser_fwhm_deg: f64, camera: &Camera, seed: u64) -> Psf {
    let optics = SpeckleOptics {
        diffuser_fwhm_deg,
        ..SpeckleOptics::demo()
    };
    let (rows, columns) = camera.field();
    speckle_psf(&optics, ROWS + rows - 1, COLUMNS + columns - 1, seed).unwrap()
}

/// The noiseless frame.
fn light(camera: &Camera, psf: &Psf, truth: &Video) -> Image {
    let operator = RollingShutter::new(camera, psf);
    let mut light = vec![0.0; operator.range_len()];
    operator.apply(truth.data(), &mut light);
    // The transforms leave rounding errors where there is no light.
    light.iter_mut().for_each(|v| *v = v.max(0.0));
    Image::new(ROWS, COLUMNS, light).unwrap()
}

fn recorded(camera: &Camera, psf: &Psf, truth: &Video, seed: u64) -> Image {
    let noise = Noise::Gaussian { snr: 256.0 };
    let recorded = noise.apply(&light(camera, psf, truth), camera.sensor(), seed);
    recorded.unwrap().frame
}

impl Case {
    /// A moving digit.
    fn new() -> Self {
        Self::of(|shape| scene::moving_digit(shape, 10, 1, 3).unwrap())
    }

    /// Three LEDs that flash.
    fn leds() -> Self {
        Self::of(|shape| scene::leds(shape, 10.0, 6.5, 5).unwrap().0)
    }

    fn of(scene: impl FnOnce(Shape) -> Video) -> Self {
        let camera = camera(Shutter::DualInsideOut, None);
        let psf = psf(&camera, 5);
        let truth = scene(camera.video_shape());
        let frame = recorded(&camera, &psf, &truth, 7);
        Self {
            camera,
            psf,
            truth,
            frame,
        }
    }

    /// The PSNR with the pixels `is_masked` left out by hand.
    fn psnr_without(&self, frame: &Image, is_masked: &[bool]) -> f64 {
        let kept = Measurement::new(frame.clone()).unwrap().without(is_masked);
        let options = Options {
            prior: Some(Prior::STANDARD),
            keep_all_pixels: true,
            ..Options::default()
        };
        let by_hand = Problem::new(&kept, &self.camera, &self.psf, options).unwrap();
        self.psnr(&by_hand.solve(&mut |_| ControlFlow::Continue(())).unwrap())
    }

    fn solve(&self, frame: &Image, options: Options) -> Reconstruction {
        let measurement = Measurement::new(frame.clone()).unwrap();
        let options = Options {
            prior: Some(Prior::STANDARD),
            ..options
        };
        let problem = Problem::new(&measurement, &self.camera, &self.psf, options).unwrap();
        problem.solve(&mut |_| ControlFlow::Continue(())).unwrap()
    }

    fn psnr(&self, found: &Reconstruction) -> f64 {
        psnr_db(found.video.data(), self.truth.data())
    }
}

/// The frame with `value` at the pixels `is_planted(y, x)`, and their mask.
fn planted(
    frame: &Image,
    value: f32,
    is_planted: impl Fn(usize, usize) -> bool,
) -> (Image, Vec<u8>) {
    let at = |y, x| {
        if is_planted(y, x) {
            value
        } else {
            frame.at(y, x)
        }
    };
    let mask = Image::from_fn(ROWS, COLUMNS, |y, x| f32::from(u8::from(is_planted(y, x))));
    let mask = mask.data().iter().map(|v| *v as u8).collect();
    (Image::from_fn(ROWS, COLUMNS, at), mask)
}

/// A value that changes without a pattern, from 0 to 99.
fn scatter(y: usize, x: usize) -> usize {
    (y.wrapping_mul(7919) ^ x.wrapping_mul(104_729) ^ (y * x).wrapping_mul(31)) % 100
}

/// A frame of the model keeps all pixels and its noise level, and the video is as good as without the check.
#[test]
fn nothing_is_left_out_of_a_frame_of_the_model() {
    let case = Case::new();
    let found = case.solve(&case.frame, Options::default());
    let unchecked = Options {
        is_preview: true,
        ..Options::default()
    };
    let before = case.solve(&case.frame, unchecked);
    assert_eq!(found.excluded_fraction(), 0.0);
    assert_eq!(found.stray_light, None);
    assert_eq!(found.effective_sigma, found.sigma);
    assert_eq!(found.fit.verdict, Verdict::Good, "{}", found.fit.reason);
    let (now, before) = (case.psnr(&found), case.psnr(&before));
    assert!(now > before - 0.2, "{now} dB, {before} without the check");
}

/// Hot and dead pixels, a caption and a dead row are found, and the video is as good as with them masked by hand.
#[test]
fn foreign_pixels_are_left_out() {
    let case = Case::new();
    let bright = 1.3 * case.frame.max();
    let hot = |y: usize, x: usize| scatter(y, x) == 3;
    let caption =
        |y: usize, x: usize| (5..11).contains(&y) && (4..50).contains(&x) && scatter(y, x) < 40;
    let faults: [(&str, (Image, Vec<u8>)); 4] = [
        ("hot", planted(&case.frame, bright, hot)),
        ("dead", planted(&case.frame, 0.0, hot)),
        ("caption", planted(&case.frame, bright, caption)),
        ("dead row", planted(&case.frame, 0.0, |y, _| y == 20)),
    ];
    for (name, (frame, mask)) in faults {
        let found = case.solve(&frame, Options::default());
        let missed = mask
            .iter()
            .zip(&found.excluded)
            .filter(|(m, e)| m > e)
            .count();
        let wrong = mask
            .iter()
            .zip(&found.excluded)
            .filter(|(m, e)| m < e)
            .count();
        assert_eq!(
            missed,
            0,
            "{name}: of {}",
            mask.iter().filter(|m| **m == 1).count()
        );
        assert!(wrong <= 4, "{name}: {wrong} other pixels");
        let is_masked: Vec<bool> = mask.iter().map(|m| *m == 1).collect();
        let (db, hand) = (case.psnr(&found), case.psnr_without(&frame, &is_masked));
        assert!(db > hand - 0.3, "{name}: {db} dB, {hand} masked by hand");
        let keep = Options {
            keep_all_pixels: true,
            ..Options::default()
        };
        let kept = case.solve(&frame, keep);
        assert_eq!(kept.excluded_fraction(), 0.0);
        assert!(
            case.psnr(&kept) < db - 5.0,
            "{name}: {} dB with all pixels",
            case.psnr(&kept)
        );
        if found.excluded_fraction() > 0.005 {
            assert!(
                found.fit.reason.contains("belong to no video"),
                "{}",
                found.fit.reason
            );
        }
    }
}

/// A dark caption with soft edges is found although it keeps the video of some instants from settling: their most covered
/// row is left out as a whole, and comes back at the end. In some frames an instant keeps the light of a few letters, and
/// which ones differs from processor to processor: so the mean of several counts. Without such rows it is 46 dB, with the
/// caption masked by hand 52.
#[test]
fn a_dark_caption_over_flashing_leds_is_left_out() {
    let case = Case::leds();
    let ink = |y: usize, x: usize| {
        let radius = ((y % 9) as f32 - 4.0).hypot((x % 8) as f32 - 3.5);
        let is_line = (10..28).contains(&y);
        f32::from(u8::from(is_line)) * (1.2 - (radius - 2.2).abs()).clamp(0.0, 1.0)
    };
    let mut decibels = Vec::new();
    for seed in 1..=5 {
        let clean = recorded(&case.camera, &case.psf, &case.truth, seed);
        let frame = Image::from_fn(ROWS, COLUMNS, |y, x| clean.at(y, x) * (1.0 - ink(y, x)));
        let found = case.solve(&frame, Options::default());
        let kept = (0..ROWS * COLUMNS).filter(|&i| found.excluded[i] == 0);
        let kept_ink = kept.filter(|i| ink(i / COLUMNS, i % COLUMNS) > 0.05);
        assert!(kept_ink.count() < 30, "seed {seed}");
        decibels.push(case.psnr(&found));
    }
    let mean = decibels.iter().sum::<f64>() / decibels.len() as f64;
    assert!(mean > 48.0, "{decibels:?}");
}

/// A reflection, half as bright as the frame, and a faint one, are taken away, also with a PSF that is 0.3 % too large; no
/// pixel is left out for them. With that PSF the loss is 0.5 to 1.2 dB in most frames and 4 in some, which differ from
/// processor to processor: what is left of the reflection and the parameters of the camera make up for each other.
#[test]
fn smooth_stray_light_is_taken_away() {
    let case = Case::new();
    for (part, is_exact) in [(0.5, true), (0.1, true), (0.5, false)] {
        let mut case = case.clone();
        if !is_exact {
            case.psf = distorted(&case.psf, 1.003, 0.0);
        }
        let spot = |y: usize, x: usize| {
            let square = (y as f32 - 24.0).powi(2) + (x as f32 - 36.0).powi(2);
            part * case.frame.max() * (-square / 72.0).exp()
        };
        let frame = Image::from_fn(ROWS, COLUMNS, |y, x| case.frame.at(y, x) + spot(y, x));
        let found = case.solve(&frame, Options::default());
        let stray_light = found.stray_light.as_ref().expect("stray light");
        let error = Image::from_fn(ROWS, COLUMNS, |y, x| stray_light.at(y, x) - spot(y, x));
        let rms = |image: &Image| {
            let sum: f64 = image.data().iter().map(|v| f64::from(*v).powi(2)).sum();
            (sum / image.data().len() as f64).sqrt()
        };
        let name = format!("{part} of the frame, exact {is_exact}");
        let error = rms(&error) / found.sigma;
        let (most, most_loss) = if is_exact { (1.0, 1.0) } else { (3.0, 5.0) };
        assert!(
            error < most,
            "{name}: the stray light is wrong by {error} σ"
        );
        assert!(found.excluded_fraction() < 0.01, "{name}");
        let clean = case.solve(&case.frame, Options::default());
        let (db, clean_db) = (case.psnr(&found), case.psnr(&clean));
        assert!(
            db > clean_db - most_loss,
            "{name}: {db} dB, {clean_db} without it"
        );
        let kept = Options {
            self_calibration: SelfCalibration::OFF,
            ..Options::default()
        };
        let kept = case.solve(&frame, kept);
        assert_eq!(kept.stray_light, None);
        assert!(case.psnr(&kept) < db - 4.0, "{name}");
        let measurement = Measurement::new(frame.clone()).unwrap();
        let corrected = found.corrected(&measurement);
        if found.calibration.is_none() {
            let expected = frame.at(24, 36) - stray_light.at(24, 36);
            assert_eq!(corrected.image().at(24, 36), expected);
        }
    }
}

/// An instant of which one row is usable gathers its light later than others, and is reconstructed as well.
#[test]
fn a_dead_row_costs_flashing_leds_little() {
    let case = Case::leds();
    let pixels = 0..ROWS * COLUMNS;
    let is_dead: Vec<bool> = pixels.map(|i| i / COLUMNS == 11).collect();
    let without = case.psnr_without(&case.frame, &is_dead);
    let with = case.psnr_without(&case.frame, &vec![false; is_dead.len()]);
    assert!(without > with - 1.0, "{without} dB, {with} with the row");
}

/// A flash does not hide LEDs that are dimmer: exposures of one row and of three, 48 and 35 dB where thresholds follow the
/// brightness of the flash.
#[test]
fn a_flash_does_not_hide_dim_leds() {
    for (exposure_us, times_as_bright, min_psnr_db) in [(10.0, 5.0, 51.0), (30.0, 8.0, 39.0)] {
        let params = CameraParams {
            exposure_us,
            ..camera(Shutter::DualInsideOut, None).params().clone()
        };
        let camera = Camera::new(params).unwrap();
        let psf = psf(&camera, 5);
        let shape = camera.video_shape();
        let (leds, _) = scene::leds(shape, 10.0, 6.5, 5).unwrap();
        let mut truth = leds.data().to_vec();
        let brightest = truth.iter().copied().fold(0.0, f32::max);
        let flash = 12;
        truth[flash * shape.pixels() + 40 * shape.columns + 20] = times_as_bright * brightest;
        let truth = Video::new(shape, truth).unwrap();
        let frame = recorded(&camera, &psf, &truth, 7);
        let case = Case {
            camera,
            psf,
            truth,
            frame,
        };
        let found = case.solve(&case.frame, Options::default());
        let at_other_instants = |video: &Video| -> Vec<f32> {
            let bins = video.data().chunks_exact(shape.pixels()).enumerate();
            let others = bins.filter(|(t, _)| *t != flash);
            others.flat_map(|(_, bin)| bin.to_vec()).collect()
        };
        let psnr = psnr_db(
            &at_other_instants(&found.video),
            &at_other_instants(&case.truth),
        );
        assert!(psnr > min_psnr_db, "{exposure_us} µs: {psnr} dB");
        let fit = &found.fit;
        assert_eq!(
            fit.verdict,
            Verdict::Good,
            "{exposure_us} µs: {}",
            fit.reason
        );
    }
}

/// Hot pixels are found where gain and read noise are known, too: a pixel's weight follows from its own counts, so that of a
/// hot one is small.
#[test]
fn hot_pixels_of_a_sensor_of_known_noise_are_left_out() {
    let case = Case::new();
    let camera = Camera::new(CameraParams {
        sensor: Sensor {
            bit_depth: Some(16),
            bias_counts: Some(100.0),
            gain_electrons_per_count: Some(0.5),
            read_noise_electrons: Some(1.6),
            ..Sensor::default()
        },
        ..case.camera.params().clone()
    });
    let camera = camera.unwrap();
    let noise = Noise::Camera {
        peak_electrons: 20_000.0,
    };
    let light = light(&camera, &case.psf, &case.truth);
    let recorded = noise.apply(&light, camera.sensor(), 7).unwrap();
    let scaled = case.truth.data().iter();
    let truth: Vec<f32> = scaled.map(|v| v * recorded.scale as f32).collect();
    let hot = |y: usize, x: usize| scatter(y, x) == 3;
    let (frame, mask) = planted(&recorded.frame, recorded.frame.max(), hot);
    let psnr_of = |measurement: &Measurement, keep_all_pixels| {
        let options = Options {
            prior: Some(Prior::STANDARD),
            keep_all_pixels,
            ..Options::default()
        };
        let problem = Problem::new(measurement, &camera, &case.psf, options).unwrap();
        let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
        (psnr_db(found.video.data(), &truth), found)
    };
    let measurement = measurement::correct(&frame, &camera, &Corrections::default()).unwrap();
    let (db, found) = psnr_of(&measurement, false);
    let pairs = mask.iter().zip(&found.excluded);
    assert_eq!(pairs.filter(|(planted, found)| planted > found).count(), 0);
    let is_masked: Vec<bool> = mask.iter().map(|m| *m == 1).collect();
    let (by_hand, _) = psnr_of(&measurement.without(&is_masked), true);
    assert!(db > by_hand - 0.3, "{db} dB, {by_hand} masked by hand");
}

/// With a PSF of another capture the noise level includes the error of the model; a noise level that is given does not.
#[test]
fn a_wrong_psf_has_an_effective_noise_level() {
    let case = Case::new();
    // A PSF with some of another speckle pattern.
    let other = psf(&case.camera, 6);
    let mixed = Image::from_fn(
        case.psf.image().rows(),
        case.psf.image().columns(),
        |y, x| 0.9 * case.psf.image().at(y, x) + 0.1 * other.image().at(y, x),
    );
    let wrong = Case {
        psf: Psf::new(mixed).unwrap(),
        camera: case.camera.clone(),
        truth: case.truth.clone(),
        frame: case.frame.clone(),
    };
    let as_given = Options {
        self_calibration: SelfCalibration::OFF,
        ..Options::default()
    };
    let found = wrong.solve(&wrong.frame, as_given);
    assert!(
        found.effective_sigma > 2.0 * found.sigma,
        "{}",
        found.effective_sigma / found.sigma
    );
    assert!(
        found.residual_over_sigma > 1.5,
        "{}",
        found.residual_over_sigma
    );
    assert_eq!(
        found.fit.verdict,
        Verdict::Suspicious,
        "{}",
        found.fit.reason
    );
    assert!(
        found.fit.reason.contains("of its light"),
        "{}",
        found.fit.reason
    );
    assert!(
        found.excluded_fraction() <= 0.002,
        "{}",
        found.excluded_fraction()
    );
    let given = Options {
        noise_sigma: Some(found.sigma),
        ..as_given
    };
    let at_sigma = wrong.solve(&wrong.frame, given);
    assert_eq!(at_sigma.effective_sigma, at_sigma.sigma);
    assert!(
        wrong.psnr(&found) > wrong.psnr(&at_sigma),
        "{}",
        wrong.psnr(&at_sigma)
    );
}

/// A diffuser that scatters too little leaves light that no observed voxel explains. It belongs to the scene.
#[test]
fn the_light_of_a_scene_that_is_observed_in_part_is_kept() {
    let as_given = Options {
        self_calibration: SelfCalibration::OFF,
        ..Options::default()
    };
    let all = Options {
        keep_all_pixels: true,
        ..as_given
    };
    for seed in 1..=8 {
        let mut case = Case::new();
        case.psf = psf_of(0.1, &case.camera, seed);
        case.frame = recorded(&case.camera, &case.psf, &case.truth, 7);
        let found = case.solve(&case.frame, as_given);
        let psnr_db = case.psnr(&found);
        let with_all_db = case.psnr(&case.solve(&case.frame, all));
        let excluded = found.excluded_fraction();
        assert!(found.coverage_fraction() < 1.0, "PSF {seed}");
        assert!(excluded < 0.01, "PSF {seed}: {excluded} left out");
        assert!(
            psnr_db > with_all_db - 0.1,
            "PSF {seed}: {psnr_db} dB, {with_all_db} dB with all pixels"
        );
    }
}

/// Voxels whose light reaches no pixel are marked and dark: of a field larger than the light of the PSF.
#[test]
fn voxels_that_are_not_observed_are_dark() {
    for shutter in [Shutter::DualInsideOut, Shutter::DualOutsideIn] {
        let field = (ROWS + 40, COLUMNS + 40);
        let camera = camera(shutter, Some(field));
        // A PSF of 25×25 pixels: light from farther than 12 pixels outside does not reach the sensor.
        let small = Psf::new(Image::from_fn(25, 25, |y, x| (1 + scatter(y, x)) as f32)).unwrap();
        let truth = scene::moving_digit(camera.video_shape(), 10, 1, 3).unwrap();
        let frame = recorded(&camera, &small, &truth, 7);
        let measurement = Measurement::new(frame).unwrap();
        for prior in ["tv+0.5*tdiff", "tv+0.5*tdiff+support"] {
            let options = Options {
                prior: Some(prior.parse().unwrap()),
                max_iterations: Some(60),
                ..Options::default()
            };
            let problem = Problem::new(&measurement, &camera, &small, options).unwrap();
            let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
            let fraction = found.coverage_fraction();
            assert!((0.01..0.9).contains(&fraction), "{fraction}");
            let pairs = found.video.data().iter().zip(&found.coverage);
            let unseen_light = pairs.filter(|(v, c)| **c == 0 && **v != 0.0).count();
            assert_eq!(unseen_light, 0, "{prior}");
            // A corner of the field is farther from each row than the PSF reaches.
            assert_eq!(found.coverage[0], 0);
        }
    }
    let whole = Case::new();
    let found = whole.solve(
        &whole.frame,
        Options {
            is_preview: true,
            ..Options::default()
        },
    );
    assert_eq!(found.coverage_fraction(), 1.0);
}
