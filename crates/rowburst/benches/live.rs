//! What a time budget gives: `cargo bench --workspace --bench live`. Sequences of 20 frames of
//! 108×108×54 at SNR 256 that change slowly: digits that move by a pixel every second frame, and three LEDs
//! that are a bin further each time. For each budget, the PSNR of the frames alone, each from nothing,
//! and in sequence, each from the end of the last one; then frame by frame for 0.1 s. `--verbose`: every budget.

use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Model, Options, Prior, Sequence};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::solve::StopReason;
use rowburst::{Camera, Image, Sensor, Shape, Shutter, Video};
use std::ops::ControlFlow;
use std::time::Instant;

const SIDE: usize = 108;
const FRAMES: usize = 20;
const BUDGETS: [f64; 5] = [0.03, 0.1, 0.3, 1.0, 3.0];
const SHOWN: f64 = 0.1;

/// `video` moved by pixels to the right and bins ahead; what leaves comes in on the other side.
fn moved(video: &Video, pixels: usize, bins: usize) -> Video {
    let shape = video.shape();
    let at = |i: usize| {
        let (t, rest) = (i / shape.pixels(), i % shape.pixels());
        let (y, x) = (rest / shape.columns, rest % shape.columns);
        let from = (x + shape.columns - pixels % shape.columns) % shape.columns;
        ((t + bins) % shape.bins) * shape.pixels() + y * shape.columns + from
    };
    let values = (0..shape.voxels()).map(|i| video.data()[at(i)]).collect();
    Video::new(shape, values).expect("the same shape")
}

fn sequences(shape: Shape) -> Vec<(&'static str, Vec<Video>)> {
    let digits = scene::digits(shape, 12, 1).expect("digits fit");
    let leds = scene::leds(shape, 9.6, 6.5, 1).expect("LEDs fit").0;
    vec![
        (
            "digits that move",
            (0..FRAMES).map(|k| moved(&digits, k / 2, 0)).collect(),
        ),
        (
            "LEDs that run on",
            (0..FRAMES).map(|k| moved(&leds, 0, k)).collect(),
        ),
    ]
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The camera of the bench.
fn camera() -> Camera {
    Camera::new(CameraParams {
        rows: SIDE,
        columns: SIDE,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .expect("a valid camera")
}

/// The noisy frame of `truth`.
fn measure(model: &Model, camera: &Camera, truth: &Video, seed: u64) -> Measurement {
    let mut frame = vec![0.0; model.operator().range_len()];
    model.operator().apply(truth.data(), &mut frame);
    let noiseless = Image::new(SIDE, SIDE, frame).expect("a frame");
    let noise = Noise::Gaussian { snr: 256.0 };
    let recorded = noise
        .apply(&noiseless, camera.sensor(), seed)
        .expect("light");
    Measurement::new(recorded.frame).expect("light")
}

/// The solution of one frame.
struct Run {
    psnr_db: f64,
    iterations: usize,
    is_warm_started: bool,
    seconds: f64,
}

/// Solves the next frame of `sequence` within `budget` seconds.
fn solve_next(
    sequence: &mut Sequence,
    measurement: &Measurement,
    truth: &Video,
    budget: f64,
) -> Run {
    let began = Instant::now();
    let (found, is_warm_started) = sequence
        .reconstruct(measurement, &mut |_| {
            if began.elapsed().as_secs_f64() > budget {
                return ControlFlow::Break(StopReason::TimeBudget);
            }
            ControlFlow::Continue(())
        })
        .expect("a video");
    let seconds = began.elapsed().as_secs_f64();
    Run {
        psnr_db: psnr_db(found.video.data(), truth.data()),
        iterations: found.iterations,
        is_warm_started,
        seconds,
    }
}

fn main() {
    let camera = camera();
    let side = 2 * SIDE - 1;
    let psf = speckle_psf(&SpeckleOptics::demo(), side, side, 1).expect("valid optics");
    let verbose = std::env::args().any(|a| a == "--verbose");
    let began = Instant::now();
    let model = Model::new(&camera, &psf).with_cached_gram();
    println!(
        "Model: {:.0} ms, once.\n",
        1e3 * began.elapsed().as_secs_f64()
    );
    let options = Options {
        prior: Some(Prior::STANDARD),
        is_preview: true,
        ..Options::default()
    };
    println!(
        "| scene | budget (s) | from zero (dB) | in sequence: first, then median and minimum of frames 2 to {FRAMES} (dB) | iterations | warm-started frames | longest frame (s) |"
    );
    println!("|---|---|---|---|---|---|---|");
    let mut shown = Vec::new();
    for (name, truths) in sequences(camera.video_shape()) {
        let measured: Vec<Measurement> = truths
            .iter()
            .zip(1..)
            .map(|(truth, seed)| measure(&model, &camera, truth, seed))
            .collect();
        for budget in BUDGETS {
            let mut sequence = Sequence::new(model.clone(), options);
            let next = |sequence: &mut Sequence, k: usize| {
                solve_next(sequence, &measured[k], &truths[k], budget)
            };
            let alone: Vec<f64> = [0, 7, 14]
                .map(|k| {
                    sequence.reset();
                    next(&mut sequence, k).psnr_db
                })
                .to_vec();
            sequence.reset();
            let runs: Vec<_> = (0..FRAMES).map(|k| next(&mut sequence, k)).collect();
            let later: Vec<f64> = runs[1..].iter().map(|r| r.psnr_db).collect();
            let least = later.iter().copied().fold(f64::INFINITY, f64::min);
            let iterations = median(runs[1..].iter().map(|r| r.iterations as f64).collect());
            let longest = runs.iter().map(|r| r.seconds).fold(0.0, f64::max);
            let warm_started = runs.iter().filter(|r| r.is_warm_started).count();
            println!(
                "| {name} | {budget} | {:.1} | {:.1}, {:.1}, {least:.1} | {iterations} | {warm_started} | {longest:.2} |",
                median(alone),
                runs[0].psnr_db,
                median(later),
            );
            if budget == SHOWN || verbose {
                let each: Vec<String> = runs.iter().map(|r| format!("{:.1}", r.psnr_db)).collect();
                shown.push(format!("{name}, {budget} s: {}", each.join(" ")));
            }
        }
    }
    println!("\nFrame by frame (dB):\n");
    for line in shown {
        println!("- {line}");
    }
}
