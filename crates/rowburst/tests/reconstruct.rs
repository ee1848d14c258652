//! The whole road on small problems of every kind: simulate, reconstruct, compare.

use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::{Corrections, Measurement, correct};
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{
    Options, Prior, Problem, Reconstruction, SelfCalibration, Tau, Verdict,
};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::solve::StopReason;
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shutter, Video};
use std::ops::ControlFlow;

fn camera(
    (rows, columns): (usize, usize),
    shutter: Shutter,
    exposure_us: f64,
    field: Option<(usize, usize)>,
) -> Camera {
    Camera::new(CameraParams {
        rows,
        columns,
        shutter,
        row_time_us: 10.0,
        exposure_us,
        bins_per_row: 1,
        field,
        sensor: Sensor::default(),
    })
    .unwrap()
}

struct Case {
    camera: Camera,
    psf: Psf,
    truth: Video,
    frame: Image,
    sigma: f64,
}

impl Case {
    /// A moving digit seen at SNR 256.
    fn new(shutter: Shutter, exposure_us: f64, field: Option<(usize, usize)>) -> Self {
        let camera = camera((48, 40), shutter, exposure_us, field);
        let truth = scene::moving_digit(camera.video_shape(), 8, 1, 3).unwrap();
        Self::of_scene(camera, truth, 0.5)
    }

    /// A video seen at SNR 256 through a diffuser of this angle.
    fn of_scene(camera: Camera, truth: Video, diffuser_fwhm_deg: f64) -> Self {
        let optics = SpeckleOptics {
            diffuser_fwhm_deg,
            ..SpeckleOptics::demo()
        };
        let (rows, columns) = (camera.rows(), camera.columns());
        let field = camera.field();
        let psf = speckle_psf(&optics, rows + field.0 - 1, columns + field.1 - 1, 5).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(truth.data(), &mut frame);
        let noiseless = Image::new(rows, columns, frame).unwrap();
        let recorded = Noise::Gaussian { snr: 256.0 }
            .apply(&noiseless, camera.sensor(), 7)
            .unwrap();
        Self {
            camera,
            psf,
            truth,
            frame: recorded.frame,
            sigma: recorded.sigma,
        }
    }

    fn solve(&self, options: Options) -> Reconstruction {
        let measurement = Measurement::new(self.frame.clone()).unwrap();
        let problem = Problem::new(&measurement, &self.camera, &self.psf, options).unwrap();
        problem.solve(&mut |_| ControlFlow::Continue(())).unwrap()
    }

    /// The scene seen through `psf` by a camera of known gain and read noise.
    fn with_shot_noise(&self, psf: &Psf) -> (Camera, Measurement) {
        let camera = Camera::new(CameraParams {
            sensor: Sensor {
                gain_electrons_per_count: Some(0.5),
                read_noise_electrons: Some(2.0),
                ..Sensor::default()
            },
            ..self.camera.params().clone()
        })
        .unwrap();
        let operator = RollingShutter::new(&camera, psf);
        let mut light = vec![0.0; operator.range_len()];
        operator.apply(self.truth.data(), &mut light);
        // The rounding of a transform.
        light.iter_mut().for_each(|v| *v = v.max(0.0));
        let noise = Noise::Camera {
            peak_electrons: 20_000.0,
        };
        let noiseless = Image::new(48, 40, light).unwrap();
        let recorded = noise.apply(&noiseless, camera.sensor(), 7).unwrap();
        let measurement = correct(&recorded.frame, &camera, &Corrections::default()).unwrap();
        (camera, measurement)
    }

    fn psnr(&self, found: &Reconstruction) -> f64 {
        psnr_db(found.video.data(), self.truth.data())
    }
}

/// Every shutter, exposures shorter and longer than a row, a field beyond the sensor:
/// with the data step exact (blocks) and iterative (long exposure, global). A single
/// shutter has 40 measurements a bin for a digit of 30 pixels: hard.
#[test]
fn every_kind_of_camera_gives_a_good_video() {
    let shuffled: Vec<usize> = (0..48).map(|r| (r * 7) % 24).collect();
    let cases = [
        (Shutter::DualInsideOut, 10.0, None, 36.0),
        (Shutter::DualOutsideIn, 5.0, None, 36.5),
        (Shutter::Custom(shuffled), 10.0, None, 36.0),
        (Shutter::TopDown, 10.0, None, 26.5),
        (Shutter::BottomUp, 10.0, None, 26.5),
        (Shutter::DualInsideOut, 25.0, None, 34.0),
        (Shutter::DualInsideOut, 10.0, Some((60, 52)), 38.0),
        (Shutter::Global, 10.0, None, 42.0),
    ];
    let mut failed = false;
    for (shutter, exposure_us, field, at_least) in cases {
        let name = format!("{} {exposure_us} {field:?}", shutter.name());
        let case = Case::new(shutter, exposure_us, field);
        let found = case.solve(Options::default());
        let psnr = case.psnr(&found);
        println!(
            "{name}: {psnr:.1} dB, residual/σ {:.2}, σ/true {:.2}, {} iterations, {:?}",
            found.residual_over_sigma,
            found.sigma / case.sigma,
            found.iterations,
            found.stop_reason
        );
        failed |= psnr < at_least;
    }
    assert!(!failed, "a video is worse than it should be");
}

/// Bins that their support does not explain are widened step by step, on wide sensors as on others.
#[test]
fn leds_on_a_wide_sensor_converge() {
    let camera = camera((40, 520), Shutter::DualInsideOut, 10.0, None);
    for seed in [1, 2] {
        let (truth, _) = scene::leds(camera.video_shape(), 10.0, 6.5, seed).unwrap();
        let case = Case::of_scene(camera.clone(), truth, 2.5);
        let found = case.solve(options_with_known_noise(&case));
        let (psnr, residual) = (case.psnr(&found), found.residual_over_sigma);
        println!("seed {seed}: {psnr:.1} dB, residual/σ {residual:.2}");
        assert_eq!(found.stop_reason, StopReason::Converged, "seed {seed}");
        assert!(
            psnr > 62.0 && residual < 1.05,
            "seed {seed}: {psnr} dB, {residual} σ"
        );
    }
}

/// 54 digits of this height on 64×64 pixels: much light for the rows of the frame.
fn extended_case(exposure_us: f64, digit_px: usize) -> Case {
    let camera = camera((64, 64), Shutter::DualInsideOut, exposure_us, None);
    let truth = scene::digits(camera.video_shape(), digit_px, 1).unwrap();
    Case::of_scene(camera, truth, 0.5)
}

/// Options of a run that corrects neither pixels nor the model.
fn options_without_corrections() -> Options {
    Options {
        self_calibration: SelfCalibration::OFF,
        keep_all_pixels: true,
        ..Options::default()
    }
}

/// The same with a named prior and the noise known.
fn options_with_known_noise(case: &Case) -> Options {
    Options {
        prior: Some(Prior::STANDARD),
        noise_sigma: Some(case.sigma),
        ..options_without_corrections()
    }
}

/// A frame that sees too little of a scene does not predict held-out pixels, though nothing is wrong with it. A noise level by
/// their error would blur the video.
#[test]
fn a_frame_that_sees_too_little_of_the_scene_is_not_smoothed() {
    for (exposure_us, digit_px) in [(10.0, 18), (25.0, 16)] {
        let case = extended_case(exposure_us, digit_px);
        let found = case.solve(options_without_corrections());
        let with_known_noise = case.solve(options_with_known_noise(&case));
        let (psnr, known) = (case.psnr(&found), case.psnr(&with_known_noise));
        println!("{exposure_us} µs: {psnr:.1} dB, {known:.1} with known noise");
        assert_eq!(found.effective_sigma, found.sigma, "{exposure_us} µs");
        assert!(psnr > known - 1.0, "{psnr} dB, {known} dB with known noise");
        let reason = &found.fit.reason;
        assert!(reason.contains("sees too little"), "{reason}");
    }
}

/// Such a frame cannot tell what is wrong with its model, so nothing is looked for.
#[test]
fn a_frame_that_sees_too_little_of_the_scene_is_not_searched_for_corrections() {
    let case = extended_case(25.0, 16);
    let iterations_of = |options| {
        let measurement = Measurement::new(case.frame.clone()).unwrap();
        let problem = Problem::new(&measurement, &case.camera, &case.psf, options).unwrap();
        let mut iterations = 0;
        let found = problem.solve(&mut |_| {
            iterations += 1;
            ControlFlow::Continue(())
        });
        (iterations, found.unwrap())
    };
    let (iterations, found) = iterations_of(Options::default());
    let (without_corrections, expected) = iterations_of(options_without_corrections());
    assert_eq!(iterations, without_corrections);
    assert_eq!(found.video.data(), expected.video.data());
    assert_eq!(found.excluded_fraction(), 0.0);
}

/// Whenever it is stopped, the noise level of the result is one that was found to hold.
#[test]
fn a_noise_level_that_is_tried_in_vain_leaves_no_trace() {
    let case = extended_case(10.0, 18);
    let options = Options {
        prior: Some(Prior::STANDARD),
        ..options_without_corrections()
    };
    for most in (10..250).step_by(20) {
        let measurement = Measurement::new(case.frame.clone()).unwrap();
        let problem = Problem::new(&measurement, &case.camera, &case.psf, options).unwrap();
        let mut iterations = 0;
        let found = problem.solve(&mut |_| {
            iterations += 1;
            if iterations < most {
                ControlFlow::Continue(())
            } else {
                ControlFlow::Break(StopReason::Interrupted)
            }
        });
        let found = found.unwrap();
        println!(
            "{most}: {:.1} dB, {}",
            case.psnr(&found),
            found.stop_reason.name()
        );
        assert_eq!(found.effective_sigma, found.sigma, "{most} iterations");
        assert_eq!(
            found.stop_reason,
            StopReason::Interrupted,
            "{most} iterations"
        );
    }
}

/// A larger threshold and a later restriction help where rows share bins.
#[test]
fn an_extended_scene_is_restricted_later() {
    let case = extended_case(25.0, 16);
    let options = options_with_known_noise(&case);
    let mut without = options;
    without.tuning.coupled.max_extended_factor = 1.0;
    without.tuning.coupled.latest_extended_restriction = 1;
    let [psnr, without] = [options, without].map(|o| case.psnr(&case.solve(o)));
    println!("{psnr:.1} dB, {without:.1} with neither");
    assert!(psnr > without + 0.5, "{psnr} dB, {without} with neither");
}

/// A PSF that is cut off leaves pixels dark, which have a fiftieth of the noise of others. Where rows share bins, no step of the
/// solver would be accurate with their weights.
#[test]
fn dark_pixels_do_not_spoil_an_exposure_longer_than_a_row() {
    for exposure_us in [10.1, 25.0] {
        let case = Case::new(Shutter::DualInsideOut, exposure_us, None);
        let whole = case.psf.image();
        let (top, left) = ((whole.rows() - 47) / 2, (whole.columns() - 41) / 2);
        let cut = Image::from_fn(47, 41, |y, x| {
            whole.data()[(y + top) * whole.columns() + x + left]
        });
        let psf = Psf::new(cut).unwrap();
        let (camera, measurement) = case.with_shot_noise(&psf);
        let options = Options {
            prior: Some(Prior::STANDARD),
            ..Options::default()
        };
        let problem = Problem::new(&measurement, &camera, &psf, options).unwrap();
        let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
        // The video is in counts of the camera.
        let (video, truth) = (found.video.data(), case.truth.data());
        let common: f32 = video.iter().zip(truth).map(|(v, t)| v * t).sum();
        let factor = common / video.iter().map(|v| v * v).sum::<f32>();
        let scaled: Vec<f32> = video.iter().map(|v| factor * v).collect();
        let psnr = psnr_db(&scaled, truth);
        println!(
            "{exposure_us} µs: {psnr:.1} dB, residual/σ {:.2}, {} iterations",
            found.residual_over_sigma, found.iterations
        );
        assert_eq!(found.stop_reason, StopReason::Converged);
        assert_eq!(found.fit.verdict, Verdict::Good);
        assert!(psnr > 29.5, "{psnr} dB");
    }
}

/// Blocks of more than a thousand measurements, whose factors are the dear part; the second with products in f32.
#[test]
fn a_large_sensor_gives_a_good_video() {
    for columns in [520, 1030] {
        let case = wide(columns);
        let options = Options {
            prior: Some(Prior::SEPARABLE),
            ..Options::default()
        };
        let found = case.solve(options);
        let psnr = case.psnr(&found);
        println!(
            "{columns} columns: {psnr:.1} dB, residual/σ {:.2}, {} iterations",
            found.residual_over_sigma, found.iterations
        );
        assert_eq!(found.fit.verdict, Verdict::Good);
        assert!(psnr > 45.0, "{psnr} dB");
        // Far less than the factors have digits for.
        let found = case.solve(Options {
            tau: Tau::Given(1e-6 * found.tau),
            max_iterations: Some(3),
            ..options
        });
        assert!(found.video.data().iter().all(|v| v.is_finite()));
    }
}

/// Digits on a sensor of 24 rows.
fn wide(columns: usize) -> Case {
    let camera = Camera::new(CameraParams {
        rows: 24,
        columns,
        shutter: Shutter::DualInsideOut,
        row_time_us: 10.0,
        exposure_us: 10.0,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .unwrap();
    let demo = SpeckleOptics::demo();
    let optics = SpeckleOptics {
        diffuser_fwhm_deg: 5.0 * demo.diffuser_fwhm_deg,
        ..demo
    };
    let psf = speckle_psf(&optics, 47, 2 * columns - 1, 1).unwrap();
    let truth = scene::digits(camera.video_shape(), 12, 1).unwrap();
    let operator = RollingShutter::new(&camera, &psf);
    let mut frame = vec![0.0; operator.range_len()];
    operator.apply(truth.data(), &mut frame);
    // Of the transforms' rounding.
    frame.iter_mut().for_each(|v: &mut f32| *v = v.max(0.0));
    let noiseless = Image::new(24, columns, frame).unwrap();
    let recorded = Noise::Gaussian { snr: 256.0 }
        .apply(&noiseless, camera.sensor(), 7)
        .unwrap();
    Case {
        camera,
        psf,
        truth,
        frame: recorded.frame,
        sigma: recorded.sigma,
    }
}

/// The diffuser sends little light over half of the sensor, so a digit that is far from the rows of its instant is seen
/// weakly. Its light must not end nearer to these rows.
#[test]
fn light_far_from_the_rows_that_are_read_stays_where_it_is() {
    for exposure_us in [10.0, 25.0] {
        let camera = camera((96, 48), Shutter::DualInsideOut, exposure_us, None);
        for seed in [2, 3] {
            let truth = scene::digits(camera.video_shape(), 12, seed).unwrap();
            let case = Case::of_scene(camera.clone(), truth, 0.35);
            let found = case.solve(Options {
                prior: Some(Prior::STANDARD),
                noise_sigma: Some(case.sigma),
                keep_all_pixels: true,
                self_calibration: SelfCalibration::OFF,
                ..Options::default()
            });
            let psnr = psnr_db(found.video.data(), case.truth.data());
            let at_least = if exposure_us == 10.0 { 28.0 } else { 27.0 };
            assert!(psnr > at_least, "{exposure_us} µs, seed {seed}: {psnr} dB");
            println!(
                "{exposure_us} µs, seed {seed}: {psnr} dB, {:?}",
                found.fit.verdict
            );
        }
    }
}

/// Multiplying the frame by a constant multiplies the video, and nothing else.
#[test]
fn nothing_depends_on_the_units_of_the_frame() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let found = case.solve(Options::default());
    let scaled = Case {
        frame: Image::from_fn(48, 40, |y, x| 4096.0 * case.frame.at(y, x)),
        ..Case::new(Shutter::DualInsideOut, 10.0, None)
    };
    let found_scaled = scaled.solve(Options::default());
    let expected: Vec<f32> = found.video.data().iter().map(|v| 4096.0 * v).collect();
    let error = rowburst::vecmath::distance_squared(found_scaled.video.data(), &expected).sqrt()
        / rowburst::vecmath::norm(&expected);
    assert!(error < 1e-3, "{error}");
}

/// With τ given, the result is the minimum: no nearby video has a lower objective.
#[test]
fn a_fixed_tau_reaches_the_minimum() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let prior: Prior = "tv+0.5*tdiff".parse().unwrap();
    let auto = case.solve(Options {
        prior: Some(prior),
        ..Options::default()
    });
    let options = Options {
        prior: Some(prior),
        tau: Tau::Given(auto.tau),
        max_iterations: Some(2000),
        ..Options::default()
    };
    let found = case.solve(options);
    let operator = RollingShutter::new(&case.camera, &case.psf);
    let penalty = prior.prox(case.camera.video_shape());
    let objective = |video: &[f32]| {
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(video, &mut frame);
        0.5 * rowburst::vecmath::distance_squared(&frame, case.frame.data())
            + auto.tau * penalty.value(video)
    };
    let best = objective(found.video.data());
    assert!((best - found.certificate.primal).abs() < 1e-3 * best);
    for other in [
        case.truth.data(),
        auto.video.data(),
        &vec![0.0; found.video.data().len()][..],
    ] {
        for step in [1.0, 0.1, 0.01, -0.01] {
            let moved = found.video.data().iter().zip(other);
            let moved: Vec<f32> = moved.map(|(v, o)| (v + step * (o - v)).max(0.0)).collect();
            assert!(
                objective(&moved) >= best * (1.0 - 1e-3),
                "step {step}: {} < {best}",
                objective(&moved)
            );
        }
    }
}

#[test]
fn the_noise_is_read_from_the_frame() {
    for seed_case in [Shutter::DualInsideOut, Shutter::Global] {
        let case = Case::new(seed_case, 10.0, None);
        let measurement = Measurement::new(case.frame.clone()).unwrap();
        let estimate = rowburst::reconstruct::estimate_sigma(&measurement, &case.psf).unwrap();
        assert!(
            (0.8..1.3).contains(&(estimate / case.sigma)),
            "{}",
            estimate / case.sigma
        );
    }
}

#[test]
fn the_noise_is_read_from_a_frame_that_lacks_pixels_in_every_row() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let corrections = Corrections {
        bad_pixels: Some(Image::from_fn(48, 40, |y, x| {
            if (7 * y) % 40 == x { 1.0 } else { 0.0 }
        })),
        ..Corrections::default()
    };
    let measurement = correct(&case.frame, &case.camera, &corrections).unwrap();
    let estimate = rowburst::reconstruct::estimate_sigma(&measurement, &case.psf).unwrap();
    let ratio = estimate / case.sigma;
    assert!((0.7..1.6).contains(&ratio), "{ratio}");
}

#[test]
fn an_observer_can_stop_it() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let measurement = Measurement::new(case.frame.clone()).unwrap();
    let problem = Problem::new(&measurement, &case.camera, &case.psf, Options::default()).unwrap();
    let found = problem
        .solve(&mut |progress| match progress.iteration {
            7 => ControlFlow::Break(StopReason::TimeBudget),
            _ => ControlFlow::Continue(()),
        })
        .unwrap();
    assert_eq!(
        (found.iterations, found.stop_reason),
        (7, StopReason::TimeBudget)
    );
    assert!(found.video.max() > 0.0);
}

/// Bad pixels with weight zero do no harm.
#[test]
fn pixels_of_weight_zero_are_ignored() {
    use rowburst::measurement::{Corrections, correct};
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    // A prior that is named: the choice among priors has other pixels to go by.
    let options = Options {
        prior: Some(Prior::STANDARD),
        ..Options::default()
    };
    let clean = case.psnr(&case.solve(options));
    let is_bad = |y: usize, x: usize| (y * 40 + x).is_multiple_of(67);
    let broken = Image::from_fn(48, 40, |y, x| {
        if is_bad(y, x) {
            1.0
        } else {
            case.frame.at(y, x)
        }
    });
    let corrections = Corrections {
        bad_pixels: Some(Image::from_fn(48, 40, |y, x| {
            f32::from(u8::from(is_bad(y, x)))
        })),
        ..Corrections::default()
    };
    let measurement = correct(&broken, &case.camera, &corrections).unwrap();
    let problem = Problem::new(&measurement, &case.camera, &case.psf, options).unwrap();
    let found = problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
    let psnr = case.psnr(&found);
    println!("clean {clean:.1} dB, with 1.5 % bad pixels {psnr:.1} dB");
    assert!(psnr > clean - 1.0, "{psnr} against {clean}");
}

/// The choice is that of the smallest error, and its video is that of the prior named.
#[test]
fn the_prior_is_the_one_that_predicts_held_out_pixels_best() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let found = case.solve(Options::default());
    let choice = found.choice.as_ref().expect("there was a choice");
    println!("{}", choice.reason());
    assert_eq!(found.prior, choice.best().prior);
    assert!(
        choice
            .candidates
            .iter()
            .all(|c| c.error >= choice.best().error)
    );
    // A twentieth of two rows, for each of 24 instants.
    assert_eq!(choice.held_out, 24 * 4);
    let options = Options {
        prior: Some(found.prior),
        ..Options::default()
    };
    let measurement = Measurement::new(case.frame.clone()).unwrap();
    let problem = Problem::new(&measurement, &case.camera, &case.psf, options).unwrap();
    let named = problem
        .with_tau_factor(choice.best().tau_factor)
        .solve(&mut |_| ControlFlow::Continue(()))
        .unwrap();
    assert!(named.choice.is_none());
    assert_eq!(named.video, found.video);
}

/// So it is with shot noise, where each trial has its own weights of the pixels.
#[test]
fn a_chosen_prior_gives_the_video_of_the_prior_named_with_shot_noise() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let (camera, measurement) = case.with_shot_noise(&case.psf);
    let problem = |prior| {
        let options = Options {
            prior,
            ..Options::default()
        };
        Problem::new(&measurement, &camera, &case.psf, options).unwrap()
    };
    let run = |problem: Problem| problem.solve(&mut |_| ControlFlow::Continue(())).unwrap();
    let found = run(problem(None));
    let best = found.choice.as_ref().expect("there was a choice").best();
    let named = run(problem(Some(found.prior)).with_tau_factor(best.tau_factor));
    assert!(found.weights.is_some());
    assert_eq!(named.weights, found.weights);
    assert_eq!(named.video, found.video);
}

/// Stopped while another prior is tried, or soon after the last run has begun, the result is the
/// best so far.
#[test]
fn what_is_stopped_while_priors_are_tried_is_the_best_so_far() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let whole = case.psnr(&case.solve(Options::default()));
    let measurement = Measurement::new(case.frame.clone()).unwrap();
    // The check of the model, from which a trial goes on, two more trials, then the run on the whole frame, which counts anew.
    for stopped in [3, 4] {
        let options = Options::default();
        let problem = Problem::new(&measurement, &case.camera, &case.psf, options).unwrap();
        let mut run = 0;
        let found = problem
            .solve(&mut |progress| {
                run += usize::from(progress.iteration == 1);
                if run == stopped && progress.iteration == 3 {
                    ControlFlow::Break(StopReason::Interrupted)
                } else {
                    ControlFlow::Continue(())
                }
            })
            .unwrap();
        let psnr = case.psnr(&found);
        println!("stopped in run {stopped}: {psnr:.1} dB of {whole:.1}");
        assert_eq!(found.stop_reason, StopReason::Interrupted);
        assert!(psnr > whole - 3.0, "{psnr} of {whole} in run {stopped}");
    }
}

/// Without a noise level, held-out pixels find one that serves as well.
#[test]
fn held_out_pixels_find_tau() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let solve = |tau| {
        case.solve(Options {
            prior: Some(Prior::STANDARD),
            tau,
            ..Options::default()
        })
    };
    let (known, found) = (solve(Tau::Auto), solve(Tau::HeldOut));
    let (psnr, reached) = (case.psnr(&known), case.psnr(&found));
    println!(
        "{psnr:.1} dB with σ {:.3e}, {reached:.1} dB with {:.3e}",
        known.sigma, found.sigma
    );
    assert!(reached > psnr - 1.0, "{reached} against {psnr}");
}

/// What the certificate says holds: no candidate of another solver's run is lower.
#[test]
fn the_certificate_is_a_bound() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let solve = |iterations, tau| {
        case.solve(Options {
            prior: Some("tv+0.5*tdiff".parse().unwrap()),
            tau,
            max_iterations: Some(iterations),
            ..Options::default()
        })
    };
    let tau = Tau::Given(solve(300, Tau::Auto).tau);
    let (short, long) = (solve(100, tau), solve(3000, tau));
    println!("{}; {}", short.certificate, long.certificate);
    assert!(short.certificate.dual <= long.certificate.primal);
    assert!(short.certificate.excess() > long.certificate.excess());
    assert!(long.certificate.excess() <= 1e-3 && long.stop_reason == StopReason::Converged);
}

/// A PSF that shows no place is an error, where it was a panic or an infinite penalty.
#[test]
fn a_flat_psf_is_an_error() {
    let case = Case::new(Shutter::DualInsideOut, 10.0, None);
    let flat = Psf::new(Image::from_fn(41, 41, |_, _| 1.0)).unwrap();
    let measurement = Measurement::new(case.frame.clone()).unwrap();
    for prior in [None, Some(Prior::STANDARD)] {
        for tau in [Tau::Auto, Tau::Given(1e-3)] {
            let options = Options {
                prior,
                tau,
                ..Options::default()
            };
            let error = rowburst::reconstruct(&measurement, &case.camera, &flat, &options);
            let message = error.unwrap_err().to_string();
            assert!(message.contains("it is flat"), "{message}");
        }
    }
}
