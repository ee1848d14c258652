//! A frame corrects its PSF and its camera.

mod common;

use common::distorted;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64;
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{
    FoundParameter, ModelParameter, Options, Prior, Problem, Reconstruction, SelfCalibration,
    Verdict,
};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::solve::StopReason;
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shutter, Video};
use std::ops::ControlFlow;

const ROWS: usize = 64;
const COLUMNS: usize = 60;

struct Case {
    camera: Camera,
    psf: Psf,
    truth: Video,
    light: Image,
}

/// A camera with an exposure of so many rows.
fn camera_of(exposure: f64) -> Camera {
    Camera::new(CameraParams {
        rows: ROWS,
        columns: COLUMNS,
        shutter: Shutter::DualInsideOut,
        row_time_us: 10.0,
        exposure_us: 10.0 * exposure,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .unwrap()
}

impl Case {
    /// A moving digit, exposed for so many rows.
    fn new(exposure: f64) -> Self {
        let shape = camera_of(exposure).video_shape();
        Self::with_truth(
            camera_of(exposure),
            scene::moving_digit(shape, 10, 1, 3).unwrap(),
        )
    }

    /// A scene before `camera`.
    fn with_truth(camera: Camera, truth: Video) -> Self {
        let optics = SpeckleOptics {
            diffuser_fwhm_deg: 0.6,
            ..SpeckleOptics::demo()
        };
        let psf = speckle_psf(&optics, 2 * ROWS - 1, 2 * COLUMNS - 1, 5).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let mut light = vec![0.0; operator.range_len()];
        operator.apply(truth.data(), &mut light);
        // The transforms leave rounding errors where there is no light.
        light.iter_mut().for_each(|v| *v = v.max(0.0));
        Self {
            light: Image::new(ROWS, COLUMNS, light).unwrap(),
            camera,
            psf,
            truth,
        }
    }

    /// The reconstruction of the frame of `light` with the PSF `psf`, and its PSNR.
    fn solve(&self, light: &Image, psf: &Psf, when: SelfCalibration) -> (Reconstruction, f64) {
        let noise = Noise::Gaussian { snr: 256.0 };
        let frame = noise.apply(light, self.camera.sensor(), 7).unwrap().frame;
        let measurement = Measurement::new(frame).unwrap();
        let options = Options {
            prior: Some(Prior::STANDARD),
            self_calibration: when,
            ..Options::default()
        };
        let problem = Problem::new(&measurement, &self.camera, psf, options).unwrap();
        let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
        let psnr = psnr_db(found.video.data(), self.truth.data());
        (found, psnr)
    }

    /// The reconstruction with the default options, and the number of iterations of all its runs.
    fn solve_automatically(&self, light: &Image, psf: &Psf) -> (Reconstruction, usize) {
        self.solve_until(usize::MAX, light, psf)
    }

    /// The same, stopped after `most` iterations.
    fn solve_until(&self, most: usize, light: &Image, psf: &Psf) -> (Reconstruction, usize) {
        let noise = Noise::Gaussian { snr: 256.0 };
        let frame = noise.apply(light, self.camera.sensor(), 7).unwrap().frame;
        let measurement = Measurement::new(frame).unwrap();
        let problem = Problem::new(&measurement, &self.camera, psf, Options::default()).unwrap();
        let mut iterations = 0;
        let voxels = self.camera.video_shape().voxels();
        let found = problem.solve(&mut |progress| {
            // Checks with another shutter have videos of another shape.
            assert_eq!(progress.video.get().len(), voxels);
            iterations += 1;
            if iterations == most {
                ControlFlow::Break(StopReason::Interrupted)
            } else {
                ControlFlow::Continue(())
            }
        });
        let found = found.unwrap();
        assert_eq!(found.video.shape(), self.camera.video_shape());
        (found, iterations)
    }
}

fn value_of(found: &Reconstruction, parameter: ModelParameter) -> f64 {
    let calibration = found.calibration.as_ref().expect("a correction");
    let of = |p: &&rowburst::reconstruct::FoundParameter| p.parameter == parameter;
    calibration
        .parameters
        .iter()
        .find(of)
        .map_or(0.0, |p| p.value)
}

/// A frame of the model is left as it is, also where it is asked to correct it. The runs begin otherwise, so their videos
/// differ a little.
#[test]
fn a_right_model_stays() {
    let case = Case::new(1.0);
    let (off, expected) = case.solve(&case.light, &case.psf, SelfCalibration::OFF);
    for when in [SelfCalibration::AUTO, SelfCalibration::ON] {
        let (found, psnr) = case.solve(&case.light, &case.psf, when);
        assert!(found.calibration.is_none());
        assert_eq!(found.effective_sigma, off.effective_sigma);
        assert!((psnr - expected).abs() < 0.2, "{psnr} dB, {expected} dB");
    }
}

/// Only what is listed is corrected, and a list is found sooner.
#[test]
fn only_what_is_listed_is_corrected() {
    let case = Case::new(1.0);
    let larger = distorted(&case.psf, 1.01, 0.0);
    let (all, of_all) = case.solve(&case.light, &larger, SelfCalibration::AUTO);
    let (some, of_some) = case.solve(&case.light, &larger, "scale,rotation_deg".parse().unwrap());
    assert!((of_all - of_some).abs() < 0.5, "{of_all} {of_some}");
    let found = some.calibration.expect("the scale is found").parameters;
    let names: Vec<&str> = found.iter().map(|p| p.parameter.name()).collect();
    assert_eq!(names, ["scale"]);
    assert!(all.calibration.is_some());
    let (other, _) = case.solve(
        &case.light,
        &larger,
        "vignetting,psf_refinement".parse().unwrap(),
    );
    let is_of_list = |p: &FoundParameter| p.parameter == ModelParameter::Vignetting;
    assert!(
        other
            .calibration
            .is_none_or(|c| c.parameters.iter().all(is_of_list))
    );
}

/// A PSF of another size and angle, vignetting and stray light are found, one by one and at exposures longer than a row.
#[test]
fn parameters_are_found() {
    for exposure in [1.0, 2.5] {
        let case = Case::new(exposure);
        let (_, perfect) = case.solve(&case.light, &case.psf, SelfCalibration::OFF);
        let mean = case.light.data().iter().sum::<f32>() / case.light.data().len() as f32;
        let vignetted = Image::from_fn(ROWS, COLUMNS, |y, x| {
            let place = |at: usize, length: usize| 2.0 * at as f32 / (length - 1) as f32 - 1.0;
            let (y_part, x_part) = (place(y, ROWS), place(x, COLUMNS));
            case.light.at(y, x) * (1.0 - 0.1 * (y_part * y_part + x_part * x_part))
        });
        let stray = Image::from_fn(ROWS, COLUMNS, |y, x| case.light.at(y, x) + 0.08 * mean);
        let faults = [
            (
                distorted(&case.psf, 1.01, 0.0),
                &case.light,
                ModelParameter::Scale,
                -0.0099,
                5e-4,
            ),
            (
                distorted(&case.psf, 1.0, 0.4),
                &case.light,
                ModelParameter::Rotation,
                0.4,
                0.02,
            ),
            (
                case.psf.clone(),
                &vignetted,
                ModelParameter::Vignetting,
                -0.2,
                0.02,
            ),
            (case.psf.clone(), &stray, ModelParameter::Offset, 0.08, 0.02),
        ];
        let step = if exposure == 1.0 { 1 } else { 2 };
        for (psf, light, parameter, expected, tolerance) in faults.into_iter().step_by(step) {
            let name = format!("{} at {exposure} rows", parameter.name());
            let (_, before) = case.solve(light, &psf, SelfCalibration::OFF);
            let (found, after) = case.solve(light, &psf, SelfCalibration::AUTO);
            println!("{name}: {before:.2} -> {after:.2} dB, perfect {perfect:.2}");
            assert!(found.calibration.is_some(), "{name}: nothing was corrected");
            let value = value_of(&found, parameter);
            assert!(
                (value.abs() - f64::abs(expected)).abs() < tolerance,
                "{name}: {value}"
            );
            assert!(
                after > perfect - 1.0,
                "{name}: {before} -> {after} dB of {perfect}"
            );
            assert!(after > before + 1.0, "{name}: {before} -> {after} dB");
            assert_ne!(
                found.fit.verdict,
                Verdict::Bad,
                "{name}: {}",
                found.fit.reason
            );
        }
    }
}

/// A lower half that is read later than the upper one, and another gain of it, at an exposure of a row; an exposure of
/// several rows that is longer than given.
#[test]
fn the_timing_is_found() {
    let in_lower_half =
        |case: &Case, of: &dyn Fn(&Video) -> Image, lower: &dyn Fn(f32, f32) -> f32| {
            let shape = case.truth.shape();
            let bins = (1..shape.bins).chain([shape.bins - 1]);
            let later = bins.flat_map(|t| case.truth.bin(t).to_vec()).collect();
            let later = of(&Video::new(shape, later).unwrap());
            Image::from_fn(ROWS, COLUMNS, |y, x| {
                let (light, of_next_bin) = (case.light.at(y, x), later.at(y, x));
                if y < ROWS / 2 {
                    light
                } else {
                    lower(light, of_next_bin)
                }
            })
        };
    let delayed = |now: f32, next: f32| 0.8 * now + 0.2 * next;
    let brighter = |now: f32, _: f32| 1.04 * now;
    let camera = camera_of(2.5);
    let digits = scene::digits(camera.video_shape(), 8, 3).unwrap();
    let (row, rows) = (Case::new(1.0), Case::with_truth(camera, digits));
    // With 3 rows of exposure in place of 2.5 the video has as many bins.
    let light_of = |exposure: f64, video: &Video| -> Image {
        Case::with_truth(camera_of(exposure), video.clone()).light
    };
    let (short, long) = (&rows.light, light_of(3.0, &rows.truth));
    let longer = Image::from_fn(ROWS, COLUMNS, |y, x| {
        0.6 * short.at(y, x) + 0.4 * long.at(y, x)
    });
    let of_row = |video: &Video| light_of(1.0, video);
    let faults = [
        (
            &row,
            in_lower_half(&row, &of_row, &delayed),
            ModelParameter::HalfDelay,
            0.2,
        ),
        (
            &row,
            in_lower_half(&row, &of_row, &brighter),
            ModelParameter::HalfGain,
            0.04,
        ),
        (&rows, longer, ModelParameter::Exposure, 0.2),
    ];
    for (case, light, parameter, expected) in faults {
        let name = format!("{} of {expected}", parameter.name());
        let (_, perfect) = case.solve(&case.light, &case.psf, SelfCalibration::OFF);
        let (_, before) = case.solve(&light, &case.psf, SelfCalibration::OFF);
        let (found, after) = case.solve(&light, &case.psf, SelfCalibration::AUTO);
        println!("{name}: {before:.2} -> {after:.2} dB, perfect {perfect:.2}");
        assert!(found.calibration.is_some(), "{name}: nothing was corrected");
        let value = value_of(&found, parameter);
        assert!(
            (value - expected).abs() < 0.05 * expected,
            "{name}: {value}"
        );
        assert!(after > before + 1.0, "{name}: {before} -> {after} dB");
        assert_eq!(found.video.shape(), case.camera.video_shape());
    }
}

/// The PSF of another diffuser is not bent until it fits, and the verdict names it.
#[test]
fn another_diffuser_stays() {
    let case = Case::new(1.0);
    let optics = SpeckleOptics {
        diffuser_fwhm_deg: 0.6,
        ..SpeckleOptics::demo()
    };
    let other = speckle_psf(&optics, 2 * ROWS - 1, 2 * COLUMNS - 1, 6).unwrap();
    let (found, _) = case.solve(&case.light, &other, SelfCalibration::AUTO);
    assert!(found.calibration.is_none());
    assert_ne!(found.fit.verdict, Verdict::Good);
    let reason = &found.fit.reason;
    assert!(reason.contains("does not belong to this frame"), "{reason}");
}

/// That a frame does not belong to its PSF is seen early: neither corrections nor priors are tried, and the verdict names
/// the PSF.
#[test]
fn a_mirrored_psf_is_seen_early() {
    let case = Case::new(1.0);
    let mirrored = |image: &Image| {
        let (rows, columns) = (image.rows(), image.columns());
        Image::from_fn(rows, columns, |y, x| image.at(y, columns - 1 - x))
    };
    let (right, right_iterations) = case.solve_automatically(&case.light, &case.psf);
    assert_eq!(right.fit.verdict, Verdict::Good, "{}", right.fit.reason);
    let mirrored_psf = Psf::new(mirrored(case.psf.image())).unwrap();
    let wrong = [
        ("mirrored PSF", &case.light, &mirrored_psf),
        ("mirrored frame", &mirrored(&case.light), &case.psf),
    ];
    for (name, light, psf) in wrong {
        let (found, iterations) = case.solve_automatically(light, psf);
        println!("{name}: {iterations} iterations, {right_iterations} where nothing is wrong");
        assert!(found.calibration.is_none(), "{name}");
        assert!(found.choice.is_none(), "{name}");
        let reason = &found.fit.reason;
        assert!(
            reason.contains("does not belong to this frame"),
            "{name}: {reason}"
        );
        assert!(iterations < 4 * right_iterations, "{name}: {iterations}");
    }
}

/// A shutter of another kind is named, and nothing else is looked for.
#[test]
fn another_shutter_is_named() {
    let mut case = Case::new(1.0);
    let (light, psf) = (case.light.clone(), case.psf.clone());
    let (_, right_iterations) = case.solve_automatically(&light, &psf);
    for shutter in [Shutter::TopDown, Shutter::Global] {
        let params = CameraParams {
            shutter,
            ..case.camera.params().clone()
        };
        case.camera = Camera::new(params).unwrap();
        let (found, iterations) = case.solve_automatically(&light, &psf);
        let name = case.camera.shutter().name();
        println!("{name}: {iterations} iterations, {right_iterations} with the right shutter");
        let reason = &found.fit.reason;
        assert!(reason.contains("dual-inside-out"), "{name}: {reason}");
        assert_eq!(found.fit.verdict, Verdict::Bad, "{name}");
        assert!(
            found.calibration.is_none() && found.choice.is_none(),
            "{name}"
        );
        assert!(iterations < 2 * right_iterations, "{name}: {iterations}");
        for most in (20..iterations).step_by(150) {
            let (stopped, _) = case.solve_until(most, &light, &psf);
            assert_eq!(stopped.stop_reason, StopReason::Interrupted);
        }
    }
}

/// The PSF from a capture whose brightest pixel has so many electrons.
fn photographed(psf: &Psf, electrons: f64) -> Psf {
    let image = psf.image();
    let electrons = electrons / f64::from(image.max());
    let mut rng = Pcg64::seed_from_u64(1);
    let capture = image.data().iter().map(|&p| {
        let (mean, noise): (f64, f64) = (f64::from(p) * electrons, StandardNormal.sample(&mut rng));
        (mean + noise * mean.sqrt()).max(0.0) as f32
    });
    let capture = Image::new(image.rows(), image.columns(), capture.collect()).unwrap();
    Psf::new(capture).unwrap()
}

/// A noisy capture of a PSF that is too large, in a lens that vignettes: PSF and parameters are found together.
#[test]
fn parameters_are_found_beside_a_noisy_psf() {
    let case = Case::new(1.0);
    let vignetted = Image::from_fn(ROWS, COLUMNS, |y, x| {
        let place = |at: usize, length: usize| 2.0 * at as f32 / (length - 1) as f32 - 1.0;
        let (y_part, x_part) = (place(y, ROWS), place(x, COLUMNS));
        case.light.at(y, x) * (1.0 - 0.1 * (y_part * y_part + x_part * x_part))
    });
    let noisy = photographed(&case.psf, 1000.0);
    let psf = photographed(&distorted(&case.psf, 1.01, 0.0), 1000.0);
    let (_, alone) = case.solve(&case.light, &noisy, SelfCalibration::AUTO);
    let (_, before) = case.solve(&vignetted, &psf, SelfCalibration::OFF);
    let (found, after) = case.solve(&vignetted, &psf, SelfCalibration::AUTO);
    println!("{before:.2} -> {after:.2} dB, with noise alone {alone:.2} dB");
    assert!(
        after > alone - 1.0,
        "{after} dB, with noise alone {alone} dB"
    );
    assert!((value_of(&found, ModelParameter::Scale) + 0.0099).abs() < 1e-3);
    assert!((value_of(&found, ModelParameter::Vignetting) + 0.2).abs() < 0.03);
    let calibration = found.calibration.expect("a correction");
    assert!(calibration.psf_refinement.is_some());
    let others = calibration.parameters.iter().map(|p| p.parameter);
    let ghosts = others.filter(|p| *p == ModelParameter::Blur);
    assert_eq!(ghosts.count(), 0, "{:?}", calibration.parameters);
}

/// A noisy capture of the PSF is refined.
#[test]
fn a_noisy_psf_is_refined() {
    let case = Case::new(1.0);
    let psf = photographed(&case.psf, 200.0);
    let (_, before) = case.solve(&case.light, &psf, SelfCalibration::OFF);
    let (found, after) = case.solve(&case.light, &psf, SelfCalibration::AUTO);
    println!("{before:.2} -> {after:.2} dB");
    let calibration = found.calibration.expect("a correction");
    assert!(
        calibration
            .psf_refinement
            .is_some_and(|change| change > 0.01)
    );
    assert!(after > before + 0.7, "{before} -> {after} dB");
    let error = |psf: &Psf| -> f64 {
        let pairs = psf.image().data().iter().zip(case.psf.image().data());
        pairs
            .map(|(p, q)| f64::from(p - q).powi(2))
            .sum::<f64>()
            .sqrt()
    };
    assert!(error(&calibration.psfs.psfs()[0]) < 0.8 * error(&psf));
}

/// A refined PSF fits the video that it was refined with, so the held-out pixels would prefer a τ that is too small.
#[test]
fn a_refined_psf_does_not_lower_tau_far() {
    let case = Case::new(1.0);
    let psf = photographed(&case.psf, 200.0);
    let (found, _) = case.solve_automatically(&case.light, &psf);
    let calibration = found.calibration.expect("a correction");
    assert!(calibration.psf_refinement.is_some());
    let choice = found.choice.expect("a choice");
    for candidate in &choice.candidates {
        assert!(candidate.tau_factor >= 0.5, "{choice:?}");
    }
}
