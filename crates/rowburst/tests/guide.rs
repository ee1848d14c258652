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
        Self::exposed(10.0, seed, |camera| {
            dense(scene, camera.video_shape(), seed).unwrap()
        })
    }

    /// A frame of `exposure_us` of a video for the camera.
    fn exposed(exposure_us: f64, seed: u64, video: impl Fn(&Camera) -> Video) -> Self {
        let camera = Camera::new(CameraParams {
            rows: N,
            columns: N,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let truth = video(&camera);
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
        self.fit_with(Guide { image, exposure }, GuideModel::Auto)
            .unwrap()
    }

    fn fit_with(&self, guide: Guide, model: GuideModel) -> rowburst::Result<GuideFit> {
        self.fit_all(&[guide], model)
    }

    fn fit_all(&self, guides: &[Guide], model: GuideModel) -> rowburst::Result<GuideFit> {
        fit(
            &self.camera,
            &self.operator,
            &self.measurement,
            self.sigma,
            guides,
            model,
            &Cancel::default(),
        )
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
    assert!(gain > 4.0, "{gain} dB over the scene at rest");
}

#[test]
fn key_frames_of_any_brightness_are_as_good_as_one_picture() {
    let case = Case::new(DenseScene::Bench, 5);
    let bins = case.truth.shape().bins;
    let guide = |bin: usize, brightness: f32| {
        let mut image = case.picture(bin, (0, 0));
        image.data_mut().iter_mut().for_each(|p| *p *= brightness);
        let exposure = Some(GuideExposure {
            time_us: (bin as f64 + 0.5) * 10.0,
            exposure_us: 10.0,
        });
        Guide { image, exposure }
    };
    let psnr = |guides: &[Guide]| {
        let found = case.fit_all(guides, GuideModel::Motion).unwrap();
        assert!(found.used, "{}", found.reason);
        case.psnr(found.video.data())
    };
    let one = psnr(&[guide(bins / 2, 1.0)]);
    let three = psnr(&[guide(0, 3.0), guide(bins / 2, 1.0), guide(bins - 1, 0.5)]);
    assert!(
        three > one - 0.5,
        "{one} dB with one, {three} dB with three"
    );
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

/// A video of discs that do not touch and flicker, each with a trace of its own, and the number of each pixel's disc.
fn flickering_discs(camera: &Camera, count: usize, seed: u64) -> (Video, Vec<Option<usize>>) {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let mut draw = move || -> f64 { StandardNormal.sample(&mut rng) };
    let mut centres: Vec<(usize, usize)> = Vec::new();
    let mut tries = 0;
    while centres.len() < count {
        tries += 1;
        assert!(tries < 100_000, "the field has room");
        let place = |z: f64| 4 + (1e4 * z.abs()) as usize % (N - 8);
        let (y, x) = (place(draw()), place(draw()));
        let is_free = |&(v, w): &(usize, usize)| v.abs_diff(y).pow(2) + w.abs_diff(x).pow(2) >= 49;
        if centres.iter().all(is_free) {
            centres.push((y, x));
        }
    }
    let disc_of = |i: usize| {
        let is_inside =
            |&(y, x): &(usize, usize)| y.abs_diff(i / N).pow(2) + x.abs_diff(i % N).pow(2) <= 6;
        centres.iter().position(is_inside)
    };
    let discs: Vec<Option<usize>> = (0..N * N).map(disc_of).collect();
    let tones: Vec<[f64; 3]> = (0..count).map(|_| [draw(), draw(), draw()]).collect();
    let mut video = Video::zeros(camera.video_shape());
    for t in 0..video.shape().bins {
        let bin = video.bin_mut(t);
        for (pixel, disc) in bin.iter_mut().zip(&discs) {
            let brightness = disc.map(|k| {
                let [gain, rate, phase] = tones[k];
                let turn = t as f64 * (0.3 + 0.5 * rate.abs()) + 3.0 * phase;
                (0.6 + 0.2 * gain.clamp(-1.0, 1.0)) * (1.0 + 0.7 * turn.sin())
            });
            *pixel = brightness.unwrap_or(0.02) as f32;
        }
    }
    (video, discs)
}

/// The light of known places is a small problem: their traces have honest errors, at 5 to 20 % of the pixels lit and also
/// where an exposure is longer than a row.
#[test]
fn known_places_have_traces_with_honest_errors() {
    for (count, exposure_us) in [(12, 10.0), (25, 10.0), (48, 10.0), (25, 40.0)] {
        let seed = count as u64;
        let video = |camera: &Camera| flickering_discs(camera, count, seed).0;
        let case = Case::exposed(exposure_us, seed, video);
        let discs = flickering_discs(&case.camera, count, seed).1;
        let shape = case.truth.shape();
        let mean = (0..N * N).map(|i| {
            let of = |t: usize| case.truth.bin(t)[i] / shape.bins as f32;
            (0..shape.bins).map(of).sum()
        });
        let guide = Guide {
            image: Image::new(N, N, mean.collect()).unwrap(),
            exposure: None,
        };
        let found = case.fit_with(guide, GuideModel::Places).unwrap();
        assert!(found.used, "{}", found.reason);
        let places = found.known_places.as_ref().unwrap();
        assert_eq!(places.traces.len(), count);
        let dark = discs.iter().position(Option::is_none).unwrap();
        let (mut covered, mut error, mut power) = (0, 0.0, 0.0);
        for trace in &places.traces {
            let middle = (trace.centre.0.round() as usize) * N + trace.centre.1.round() as usize;
            assert!(discs[middle].is_some(), "{:?}", trace.centre);
            for t in 0..shape.bins {
                let truth = f64::from(case.truth.bin(t)[middle] - case.truth.bin(t)[dark]);
                let deviation = trace.value[t] - truth;
                covered += usize::from(deviation.abs() <= 1.96 * trace.standard_error[t]);
                error += deviation.powi(2);
                power += truth.powi(2);
            }
        }
        let coverage = covered as f64 / (count * shape.bins) as f64;
        let relative = (error / power).sqrt();
        assert!(
            (0.90..=0.985).contains(&coverage),
            "{count} places: {coverage}"
        );
        assert!(relative < 0.2, "{count} places: {relative}");
    }
}

/// A frame without the light of the guide drops it, whatever its sign.
#[test]
fn places_of_a_frame_without_light_are_dropped() {
    let mut case = Case::exposed(10.0, 3, |camera| flickering_discs(camera, 12, 3).0);
    let guide = Guide {
        image: case.picture(5, (0, 0)),
        exposure: None,
    };
    let dark = Image::from_fn(N, N, |y, x| -case.measurement.image().at(y, x));
    case.measurement = Measurement::new(dark).unwrap();
    let found = case.fit_with(guide, GuideModel::Places).unwrap();
    assert!(!found.used, "{}", found.reason);
}

#[test]
fn pictures_of_something_else_are_dropped() {
    let case = Case::new(DenseScene::Bench, 8);
    let middle = case.truth.shape().bins / 2;
    let honest = case.picture(middle, (0, 0));
    let mirrored = Image::from_fn(N, N, |y, x| honest.at(y, N - 1 - x));
    let other = Case::new(DenseScene::Wheel, 9).picture(3, (0, 0));
    let clipped = Image::from_fn(N, N, |y, x| honest.at(y, x).min(0.4 * honest.max()));
    // The picture at 1.3 times the magnification.
    let place = |i: usize| (0.5 * (N as f64 - 1.0) * (1.0 - 1.0 / 1.3) + i as f64 / 1.3).round();
    let larger = Image::from_fn(N, N, |y, x| honest.at(place(y) as usize, place(x) as usize));
    for (name, lie) in [
        ("larger", larger),
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
