//! Work whose instructions `scripts/instructions` counts under valgrind.
//!
//! `instructions SUBJECT TIMES` does everything that the subject needs, and the subject itself
//! `TIMES` times; the difference of two counts is the subject alone. Nothing is drawn at random, and
//! one thread does it all, so that a count repeats.

use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::{Options, Prior, Problem, Tau};
use rowburst::solve::StopReason;
use rowburst::solve::admm::Tuning;
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shutter};
use std::hint::black_box;
use std::ops::ControlFlow;

/// The paper's camera.
const PAPER: (usize, usize) = (108, 108);
/// A stripe of a wide sensor, about as many voxels.
const WIDE: (usize, usize) = (32, 1024);
/// Half the paper's camera: valgrind makes the solver a hundred times slower.
const HALF: (usize, usize) = (54, 54);

fn camera((rows, columns): (usize, usize)) -> Camera {
    Camera::new(CameraParams {
        rows,
        columns,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .expect("a valid camera")
}

/// A number from 0 to 1 that looks like noise.
fn noise(i: usize) -> f32 {
    let mut bits = i as u32 + 1;
    for _ in 0..3 {
        bits = (bits ^ (bits >> 15)).wrapping_mul(0x2c1b_3c6d);
    }
    (bits >> 8) as f32 / 16_777_216.0
}

/// Grains of a pixel under a Gaussian envelope: it covers every displacement of the camera.
fn psf(camera: &Camera) -> Psf {
    let (height, width) = (2 * camera.rows() - 1, 2 * camera.columns() - 1);
    let fall = |i: usize, n: usize| (-18.0 * (i as f32 / n as f32 - 0.5).powi(2)).exp();
    let values = (0..height * width)
        .map(|i| noise(i).powi(3) * fall(i / width, height) * fall(i % width, width))
        .collect();
    Psf::new(Image::new(height, width, values).expect("a size")).expect("light")
}

/// A bright square in each bin, in places that differ.
fn squares(camera: &Camera) -> Vec<f32> {
    let shape = camera.video_shape();
    let mut video = vec![0.0; shape.voxels()];
    for (t, bin) in video
        .chunks_exact_mut(shape.rows * shape.columns)
        .enumerate()
    {
        let (y, x) = (37 * t % (shape.rows - 10), 61 * t % (shape.columns - 10));
        for line in bin.chunks_exact_mut(shape.columns).skip(y).take(8) {
            line[x..x + 8].fill(1.0);
        }
    }
    video
}

fn forward(size: (usize, usize), times: usize) {
    let camera = camera(size);
    let operator = RollingShutter::new(&camera, psf(&camera));
    // No voxel is zero: what is passed over where a row is dark is not counted on.
    let video: Vec<f32> = squares(&camera).iter().map(|v| v + 0.1).collect();
    let mut frame = vec![0.0; operator.range_len()];
    for _ in 0..times {
        operator.apply(black_box(&video), black_box(&mut frame));
    }
}

fn adjoint(size: (usize, usize), times: usize) {
    let camera = camera(size);
    let operator = RollingShutter::new(&camera, psf(&camera));
    let frame: Vec<f32> = (0..operator.range_len()).map(noise).collect();
    let mut video = vec![0.0; operator.domain_len()];
    for _ in 0..times {
        operator.adjoint(black_box(&frame), black_box(&mut video));
    }
}

/// What is measured of the squares at an SNR of about 200.
fn measurement(camera: &Camera, psf: &Psf) -> Measurement {
    let operator = RollingShutter::new(camera, psf);
    let mut frame = vec![0.0; operator.range_len()];
    operator.apply(&squares(camera), &mut frame);
    let level = rowburst::vecmath::norm(&frame) / (frame.len() as f64).sqrt() / 60.0;
    for (i, value) in frame.iter_mut().enumerate() {
        *value += level as f32 * (noise(i) - 0.5);
    }
    let image = Image::new(camera.rows(), camera.columns(), frame).expect("a size");
    Measurement::new(image).expect("light")
}

fn problem(camera: &Camera, psf: &Psf, measurement: &Measurement, options: Options) -> Problem {
    Problem::new(measurement, camera, psf, options).expect("a valid problem")
}

/// What a user gets who chooses nothing but the prior.
fn standard() -> Options {
    Options {
        prior: Some(Prior::STANDARD),
        is_preview: true,
        ..Options::default()
    }
}

/// The same without a stop by the certificate: the iterations after the warm-up, on the support.
fn never_converged() -> Options {
    let mut tuning = Tuning::STANDARD;
    // Smaller than f32 can prove.
    tuning.tolerance = 1e-12;
    Options {
        tuning,
        ..standard()
    }
}

/// The bare iteration: no factor is renewed, no support is sought.
fn bare() -> Options {
    Options {
        prior: Some("tv+0.5*tdiff".parse().expect("a prior")),
        tau: Tau::Given(1e-6),
        is_preview: true,
        ..Options::default()
    }
}

fn set_up(times: usize) {
    let camera = camera(HALF);
    let psf = psf(&camera);
    let measurement = measurement(&camera, &psf);
    for _ in 0..times {
        black_box(problem(&camera, &psf, black_box(&measurement), standard()));
    }
}

fn iterations(options: Options, times: usize) {
    let camera = camera(HALF);
    let psf = psf(&camera);
    let problem = problem(&camera, &psf, &measurement(&camera, &psf), options);
    let found = problem.solve(&mut |progress| {
        if progress.iteration == times {
            ControlFlow::Break(StopReason::Interrupted)
        } else {
            ControlFlow::Continue(())
        }
    });
    let found = found.expect("finite numbers");
    assert_eq!(found.iterations, times, "{:?}", found.stop_reason);
    black_box(found);
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let (Some(subject), Some(Ok(times))) = (words.first(), words.get(1).map(|w| w.parse())) else {
        eprintln!("usage: instructions SUBJECT TIMES; scripts/instructions runs it");
        std::process::exit(2);
    };
    rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .use_current_thread()
        .build_global()
        .expect("nothing has used the threads yet");
    match subject.as_str() {
        "forward" => forward(PAPER, times),
        "adjoint" => adjoint(PAPER, times),
        "forward-wide" => forward(WIDE, times),
        "adjoint-wide" => adjoint(WIDE, times),
        "set-up" => set_up(times),
        "iterations" => iterations(standard(), times),
        "late-iterations" => iterations(never_converged(), times),
        "bare-iterations" => iterations(bare(), times),
        _ => {
            eprintln!("no subject \"{subject}\"");
            std::process::exit(2);
        }
    }
}
