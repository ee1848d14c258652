//! Dense scenes with the picture of a second camera: honest pictures help, others are dropped.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rowburst::camera::CameraParams;
use rowburst::guide::{Guide, GuideExposure, GuideFit, GuideModel, fit};
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Options, Problem, Tau};
use rowburst::simulate::scene::{DenseScene, dense};
use rowburst::simulate::{SpeckleOptics, speckle_psf};
use rowburst::{
    Camera, Cancel, Image, LinearOperator, Measurement, Psf, RollingShutter, Sensor, Shutter, Video,
};
use std::ops::ControlFlow;

const N: usize = 72;

/// A frame of a dense scene.
struct Case {
    camera: Camera,
    psf: Psf,
    operator: RollingShutter,
    measurement: Measurement,
    sigma: f64,
    truth: Video,
}

impl Case {
    fn new(scene: DenseScene, seed: u64) -> Self {
        let camera = Camera::new(CameraParams {
            rows: N,
            columns: N,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let truth = dense(scene, camera.video_shape(), seed).unwrap();
        let psf = speckle_psf(&SpeckleOptics::demo(), 2 * N - 1, 2 * N - 1, seed).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let mut light = vec![0.0; N * N];
        operator.apply(truth.data(), &mut light);
        let light = Image::new(N, N, light).unwrap();
        let recorded = Noise::Gaussian { snr: 256.0 }
            .apply(&light, camera.sensor(), seed)
            .unwrap();
        let counts = truth.data().iter().map(|v| v * recorded.scale as f32);
        let truth = Video::new(truth.shape(), counts.collect()).unwrap();
        Self {
            measurement: Measurement::new(recorded.frame).unwrap(),
            sigma: recorded.sigma,
            truth,
            operator,
            psf,
            camera,
        }
    }

    /// A picture of a bin, seen from `(y, x)` pixels beside the field, with noise of 1 %.
    fn picture(&self, bin: usize, (dy, dx): (isize, isize)) -> Image {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
        let noise: Vec<f32> = (0..N * N)
            .map(|_| StandardNormal.sample(&mut rng))
            .collect();
        let (bin, peak) = (self.truth.bin(bin), self.truth.max());
        let at = |i: usize, d: isize| (i as isize + d).clamp(0, N as isize - 1) as usize;
        Image::from_fn(N, N, |y, x| {
            0.3 * (bin[at(y, dy) * N + at(x, dx)] + 0.01 * peak * noise[y * N + x])
        })
    }

    fn fit(&self, image: Image, bin: Option<usize>) -> GuideFit {
        let exposure = bin.map(|bin| GuideExposure {
            time_us: (bin as f64 + 0.5) * 10.0,
            exposure_us: 10.0,
        });
        let guide = Guide { image, exposure };
        fit(
            &self.camera,
            &self.operator,
            &self.measurement,
            self.sigma,
            &[guide],
            GuideModel::Auto,
            &Cancel::default(),
        )
        .unwrap()
    }

    /// The frame with `act` on its counts, checked and fitted with the picture of the bin `middle`.
    fn fit_disturbed(&self, middle: usize, act: impl FnOnce(&mut [f32])) -> (GuideFit, Problem) {
        let mut image = self.measurement.image().clone();
        act(image.data_mut());
        let measurement = Measurement::new(image).unwrap();
        let options = Options::default();
        let mut problem = Problem::new(&measurement, &self.camera, &self.psf, options).unwrap();
        problem.check(&mut |_| ControlFlow::Continue(())).unwrap();
        let guide = Guide {
            image: self.picture(middle, (1, 1)),
            exposure: Some(GuideExposure {
                time_us: (middle as f64 + 0.5) * 10.0,
                exposure_us: 10.0,
            }),
        };
        let found = fit(
            &self.camera,
            problem.operator(),
            &problem.kept_measurement(),
            problem.effective_sigma(),
            &[guide],
            GuideModel::Auto,
            &Cancel::default(),
        );
        (found.unwrap(), problem)
    }

    fn psnr(&self, video: &[f32]) -> f64 {
        psnr_db(video, self.truth.data())
    }
}

#[test]
fn a_picture_of_a_moving_scene_is_registered_and_moved() {
    let case = Case::new(DenseScene::Bench, 5);
    let middle = case.truth.shape().bins / 2;
    let found = case.fit(case.picture(middle, (2, -1)), Some(middle));
    assert!(found.used, "{}", found.reason);
    assert_eq!(found.model, GuideModel::Motion);
    // The guide shows pixel (y, x) at (y − 2, x + 1).
    let (y, x) = found.affine.shift_px();
    assert!((y + 2.0).abs() < 0.5 && (x - 1.0).abs() < 0.5, "{y} {x}");
    // 0.3 of the counts, and its greatest value is 1.
    assert!((found.gain * 0.3 - 1.0).abs() < 0.3, "{}", found.gain);
    let still = case.truth.bin(middle).repeat(case.truth.shape().bins);
    let gain = case.psnr(found.video.data()) - case.psnr(&still);
    assert!(gain > 1.5, "{gain} dB over the scene at rest");
}

#[test]
fn the_places_of_flickering_cells_get_their_brightness() {
    let case = Case::new(DenseScene::Cells, 6);
    let middle = case.truth.shape().bins / 2;
    let found = case.fit(case.picture(middle, (1, 2)), None);
    assert!(found.used, "{}", found.reason);
    assert_eq!(found.model, GuideModel::Gain);
    let still = case.truth.bin(middle).repeat(case.truth.shape().bins);
    assert!(case.psnr(found.video.data()) > case.psnr(&still) + 1.0);
}

#[test]
fn pictures_of_something_else_are_dropped() {
    let case = Case::new(DenseScene::Bench, 8);
    let middle = case.truth.shape().bins / 2;
    let honest = case.picture(middle, (0, 0));
    let mirrored = Image::from_fn(N, N, |y, x| honest.at(y, N - 1 - x));
    let other = Case::new(DenseScene::Wheel, 9).picture(3, (0, 0));
    let clipped = Image::from_fn(N, N, |y, x| honest.at(y, x).min(0.4 * honest.max()));
    for (name, lie) in [
        ("mirrored", mirrored),
        ("other", other),
        ("clipped", clipped),
    ] {
        let found = case.fit(lie, None);
        assert!(!found.used, "{name}: {}", found.reason);
        assert!(found.reason.starts_with("dropped"), "{}", found.reason);
    }
}

#[test]
fn the_video_of_a_guide_is_judged_like_any_other() {
    let case = Case::new(DenseScene::Still, 3);
    let options = Options {
        noise_sigma: Some(case.sigma),
        ..Options::default()
    };
    let problem = || Problem::new(&case.measurement, &case.camera, &case.psf, options).unwrap();
    let judged = problem().judge(case.truth.clone(), 8.0).unwrap();
    assert!((judged.residual_over_sigma - 1.0).abs() < 0.05);
    let dark = Video::zeros(case.truth.shape());
    assert!(problem().judge(dark, 8.0).unwrap().residual_over_sigma > 50.0);
}

/// What a shifted guide does not show comes from the frame.
#[test]
fn the_edge_that_a_guide_does_not_show_is_reconstructed() {
    let case = Case::new(DenseScene::Beam, 15);
    let middle = case.truth.shape().bins / 2;
    // It begins with row 6 of the field.
    let found = case.fit(case.picture(middle, (6, 0)), Some(middle));
    assert!(found.used, "{}", found.reason);
    let strip_error = |value: &dyn Fn(usize, usize) -> f32| -> f64 {
        let truth = case.truth.bin(middle);
        let pixels = (0..5).flat_map(|y| (0..N).map(move |x| (y, x)));
        pixels
            .map(|(y, x)| f64::from(value(y, x) - truth[y * N + x]).powi(2))
            .sum()
    };
    let rim = strip_error(&|_, x| case.truth.bin(middle)[6 * N + x]);
    let edge = strip_error(&|y, x| found.video.bin(middle)[y * N + x]);
    assert!(edge < 0.5 * rim, "{edge} of {rim}");
}

/// Hot pixels and a caption are left out before a guide is fitted, and cost little.
#[test]
fn foreign_pixels_do_not_reach_a_guide() {
    let case = Case::new(DenseScene::Beam, 14);
    let middle = case.truth.shape().bins / 2;
    let peak = case.measurement.image().max();
    let (clean, _) = case.fit_disturbed(middle, |_| {});
    let hot = |counts: &mut [f32]| {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        for value in counts {
            let is_hot = rng.random::<f32>() < 0.01;
            *value += if is_hot {
                rng.random_range(0.3..2.0) * peak
            } else {
                0.0
            };
        }
    };
    let caption = |counts: &mut [f32]| {
        for y in 60..68 {
            counts[y * N + 8..y * N + 40].fill(1.5 * peak);
        }
    };
    let reference = case.psnr(clean.video.data());
    for (name, (found, problem)) in [
        ("hot", case.fit_disturbed(middle, hot)),
        ("caption", case.fit_disturbed(middle, caption)),
    ] {
        assert!(found.used, "{name}: {}", found.reason);
        let psnr = case.psnr(found.video.data());
        assert!(psnr > reference - 1.5, "{name}: {psnr} of {reference} dB");
        let judged = problem
            .judge(found.video, found.degrees_of_freedom)
            .unwrap();
        let fraction = judged.excluded_fraction();
        assert!((0.005..0.15).contains(&fraction), "{name}: {fraction}");
    }
}

#[test]
fn a_judged_video_is_zero_where_the_frame_does_not_see() {
    let case = Case::new(DenseScene::Still, 3);
    // The first instant reads the two rows in the middle.
    let is_unread: Vec<bool> = (0..N * N)
        .map(|i| (N / 2 - 1..=N / 2).contains(&(i / N)))
        .collect();
    let measurement = case.measurement.without(&is_unread);
    let options = Options {
        noise_sigma: Some(case.sigma),
        ..Options::default()
    };
    let problem = Problem::new(&measurement, &case.camera, &case.psf, options).unwrap();
    let judged = problem.judge(case.truth.clone(), 8.0).unwrap();
    assert!(judged.coverage[..N * N].iter().all(|c| *c == 0));
    assert!(judged.video.bin(0).iter().all(|v| *v == 0.0));
    assert_eq!(judged.video.bin(1), case.truth.bin(1));
}

/// A dense video that follows the noise predicts held-out pixels no worse, so these do not end the fall of the noise level.
#[test]
fn the_noise_level_by_held_out_pixels_stays_at_the_noise() {
    for (scene, seed) in [(DenseScene::Still, 16), (DenseScene::Beam, 17)] {
        let case = Case::new(scene, seed);
        let options = Options {
            prior: Some("tv+8*tdiff".parse().unwrap()),
            tau: Tau::HeldOut,
            max_iterations: Some(60),
            ..Options::default()
        };
        let problem = Problem::new(&case.measurement, &case.camera, &case.psf, options).unwrap();
        let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
        let ratio = found.sigma / case.sigma;
        assert!(ratio > 0.85, "{}: {ratio} of the noise", scene.name());
    }
}

#[test]
fn several_pictures_need_times_of_their_own() {
    let case = Case::new(DenseScene::Still, 3);
    let guide = Guide {
        image: case.picture(0, (0, 0)),
        exposure: None,
    };
    let fitted = fit(
        &case.camera,
        &case.operator,
        &case.measurement,
        case.sigma,
        &[guide.clone(), guide],
        GuideModel::Auto,
        &Cancel::default(),
    );
    let error = fitted.unwrap_err().to_string();
    assert!(error.contains("a time of its own"), "{error}");
}
