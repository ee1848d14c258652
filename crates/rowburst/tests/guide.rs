//! Dense scenes with the picture of a second camera: honest pictures help, others are dropped.

use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rowburst::camera::CameraParams;
use rowburst::guide::{Guide, GuideExposure, GuideFit, GuideModel, fit};
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Options, Problem};
use rowburst::simulate::scene::{DenseScene, dense};
use rowburst::simulate::{SpeckleOptics, speckle_psf};
use rowburst::{
    Camera, Cancel, Image, LinearOperator, Measurement, Psf, RollingShutter, Sensor, Shutter, Video,
};

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
