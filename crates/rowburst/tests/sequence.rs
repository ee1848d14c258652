//! A live view: each frame from the end of the last one.

use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Model, Options, Prior, Problem, Sequence};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::solve::StopReason;
use rowburst::{Camera, Image, Sensor, Shape, Shutter, Video};
use std::ops::ControlFlow;

const SIDE: usize = 48;

fn model() -> Model {
    let camera = Camera::new(CameraParams {
        rows: SIDE,
        columns: SIDE,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    });
    let psf = speckle_psf(&SpeckleOptics::demo(), 2 * SIDE - 1, 2 * SIDE - 1, 1);
    Model::new(&camera.unwrap(), psf.unwrap()).with_cached_gram()
}

fn measured(model: &Model, truth: &Video, seed: u64) -> Measurement {
    let mut frame = vec![0.0; model.operator().range_len()];
    model.operator().apply(truth.data(), &mut frame);
    let noiseless = Image::new(SIDE, SIDE, frame).unwrap();
    let sensor = model.camera().sensor();
    let recorded = Noise::Gaussian { snr: 256.0 }.apply(&noiseless, sensor, seed);
    Measurement::new(recorded.unwrap().frame).unwrap()
}

fn digits(shape: Shape) -> Video {
    scene::digits(shape, 10, 2).unwrap()
}

/// `video` a pixel to the right.
fn moved(video: &Video) -> Video {
    let mut values = video.data().to_vec();
    for row in values.chunks_exact_mut(video.shape().columns) {
        row.rotate_right(1);
    }
    Video::new(video.shape(), values).unwrap()
}

fn options() -> Options {
    Options {
        prior: Some(Prior::STANDARD),
        // A sequence does not check the model.
        is_preview: true,
        ..Options::default()
    }
}

/// Stops after so many iterations.
fn after(
    iterations: usize,
) -> impl FnMut(&rowburst::solve::admm::Progress) -> ControlFlow<StopReason> {
    move |progress| {
        if progress.iteration >= iterations {
            ControlFlow::Break(StopReason::TimeBudget)
        } else {
            ControlFlow::Continue(())
        }
    }
}

/// The first frame is that of a run by itself, to the bit; what follows takes fewer iterations to
/// the same quality, also where the scene has moved.
#[test]
fn a_frame_is_warm_started_from_the_previous_one() {
    let model = model();
    let truth = digits(model.camera().video_shape());
    let mut sequence = Sequence::new(model.clone(), options());
    let first = measured(&model, &truth, 1);
    let (whole, is_warm_started) = sequence.reconstruct(&first, &mut after(1000)).unwrap();
    assert!(!is_warm_started);
    let alone = Problem::with_model(&model, &first, options()).unwrap();
    let alone = alone.solve(&mut after(1000)).unwrap();
    assert_eq!(whole.video, alone.video);
    assert_eq!(whole.tau.to_bits(), alone.tau.to_bits());

    let mut truth = truth;
    let mut gains = Vec::new();
    for seed in 2..5 {
        // A twentieth brighter each time, and in the end elsewhere.
        truth = Video::new(
            truth.shape(),
            truth.data().iter().map(|v| 1.05 * v).collect(),
        )
        .unwrap();
        if seed == 4 {
            truth = moved(&truth);
        }
        let frame = measured(&model, &truth, seed);
        let (found, is_warm_started) = sequence.reconstruct(&frame, &mut after(20)).unwrap();
        assert!(is_warm_started);
        let db = |iterations| {
            let problem = Problem::with_model(&model, &frame, options()).unwrap();
            let found = problem.solve(&mut after(iterations)).unwrap();
            psnr_db(found.video.data(), truth.data())
        };
        let warm = psnr_db(found.video.data(), truth.data());
        gains.push((warm, db(20), db(1000)));
    }
    // From the last one, from nothing, to the end.
    let good = |(warm, cold, whole): &(f64, f64, f64)| *warm > cold + 3.0 && *warm > whole - 3.0;
    assert!(gains.iter().all(good), "{gains:.1?}");
}

/// Frames that are stopped after a few iterations together come as far as one run.
#[test]
fn short_runs_add_up() {
    let model = model();
    let truth = digits(model.camera().video_shape());
    let mut sequence = Sequence::new(model.clone(), options());
    let mut course = Vec::new();
    for seed in 1..16 {
        let frame = measured(&model, &truth, seed);
        let (found, _) = sequence.reconstruct(&frame, &mut after(4)).unwrap();
        assert_eq!(found.iterations, 4);
        course.push(psnr_db(found.video.data(), truth.data()));
    }
    assert!(course[14] > course[0] + 10.0, "{course:.1?}");
}

/// The support follows a scene that moves, also where a frame has as many iterations as lie between two updates. After many
/// moves the last video may explain too little of a frame, which then begins afresh.
#[test]
fn a_moving_scene_is_followed() {
    let model = model();
    for iterations in [5, 10, 11] {
        let mut truth = digits(model.camera().video_shape());
        let mut sequence = Sequence::new(model.clone(), options());
        let first = measured(&model, &truth, 1);
        sequence.reconstruct(&first, &mut after(1000)).unwrap();
        let (mut course, mut fresh_starts) = (Vec::new(), 0);
        for seed in 2..20 {
            if seed % 3 == 0 {
                truth = moved(&truth);
            }
            let frame = measured(&model, &truth, seed);
            let (found, is_warm_started) = sequence
                .reconstruct(&frame, &mut after(iterations))
                .unwrap();
            fresh_starts += usize::from(!is_warm_started);
            course.push(psnr_db(found.video.data(), truth.data()));
        }
        let is_good = course.iter().all(|db| *db > 22.0);
        assert!(is_good, "{iterations} iterations a frame: {course:.1?}");
        assert!(fresh_starts <= 1, "{fresh_starts}: {course:.1?}");
    }
}

/// A frame of another scene is what it would be by itself, to the bit.
#[test]
fn another_scene_starts_afresh() {
    let model = model();
    let shape = model.camera().video_shape();
    // Also with a prior that has no support.
    let tv = Options {
        prior: Some("tv".parse().unwrap()),
        ..options()
    };
    for options in [options(), tv] {
        check_another_scene(&model, shape, options);
    }
}

fn check_another_scene(model: &Model, shape: Shape, options: Options) {
    let mut sequence = Sequence::new(model.clone(), options);
    let leds = scene::leds(shape, 9.6, 6.5, 1).unwrap().0;
    let first = measured(model, &digits(shape), 1);
    sequence.reconstruct(&first, &mut after(60)).unwrap();
    let frame = measured(model, &leds, 2);
    let (found, is_warm_started) = sequence.reconstruct(&frame, &mut after(60)).unwrap();
    assert!(!is_warm_started);
    let alone = Problem::with_model(model, &frame, options).unwrap();
    assert_eq!(found.video, alone.solve(&mut after(60)).unwrap().video);
}
