//! Any finite frame, PSF and legal camera up to 32×32 gives a result or an error: never a panic, NaN or hang.

#[path = "../../rowburst-io/tests/common/mutator.rs"]
mod mutator;

use mutator::{Chance, run_cases};
use rowburst::camera::CameraParams;
use rowburst::reconstruct::{Options, Prior, SelfCalibration, Tau};
use rowburst::{Camera, Image, PatchSet, Psf, Sensor, Shutter};
use rowburst_io::{Capture, SampleFormat};
use rowburst_run::{Bias, Frame, Setup, TraceRequest, solve};
use std::ops::ControlFlow;
use std::time::Instant;

/// Largest side of frame and field.
const SIDE: usize = 32;
const PRIORS: [&str; 9] = [
    "tv",
    "tv+0.5*tdiff+support",
    "l1",
    "group+support",
    "tv+2*tdiff+background",
    "tdiff",
    "tv+support",
    "tv+lowrank-background",
    "tv+8*tdiff",
];

/// From 0 to 1.
fn part(chance: &mut Chance) -> f64 {
    chance.below(1 << 20) as f64 / f64::from(1 << 20)
}

/// `10^x` with `x` from `low` to `high`.
fn power(chance: &mut Chance, low: f64, high: f64) -> f64 {
    10f64.powf(low + (high - low) * part(chance))
}

/// A picture of one of many kinds: noise, dots, flat, empty, huge or with negative numbers.
fn picture(chance: &mut Chance, rows: usize, columns: usize) -> Image {
    let kind = chance.below(8);
    let scale = match chance.below(4) {
        0 => power(chance, -30.0, 36.0),
        _ => power(chance, 0.0, 4.0),
    };
    let offset = if kind == 6 { -0.5 } else { 0.0 };
    let mut values = Vec::with_capacity(rows * columns);
    for at in 0..rows * columns {
        let (y, x) = (at / columns, at % columns);
        let value = match kind {
            0 => 0.0,
            1 => 1.0,
            2 => f64::from(u8::from(chance.below(40) == 0)),
            3 => f64::from(u8::from((y, x) == (rows / 2, columns / 2))),
            4 => part(chance).powi(8),
            5 => (y + x) as f64,
            _ => part(chance) + offset,
        };
        let largest = f64::from(f32::MAX);
        values.push((scale * value).clamp(-largest, largest) as f32);
    }
    Image::new(rows, columns, values).unwrap()
}

fn shutter(chance: &mut Chance, rows: usize) -> Shutter {
    match chance.below(6) {
        0 => Shutter::TopDown,
        1 => Shutter::BottomUp,
        2 => Shutter::DualInsideOut,
        3 => Shutter::DualOutsideIn,
        4 => Shutter::Custom((0..rows).map(|_| chance.below(rows)).collect()),
        _ => Shutter::Global,
    }
}

fn params(chance: &mut Chance) -> CameraParams {
    let (rows, columns) = (1 + chance.below(SIDE), 1 + chance.below(SIDE));
    let row_time_us = power(chance, -1.0, 3.0);
    let maybe = |chance: &mut Chance, value: f64| (chance.below(3) == 0).then_some(value);
    let has_field = chance.below(4) == 0;
    CameraParams {
        rows,
        columns,
        shutter: shutter(chance, rows),
        row_time_us,
        exposure_us: row_time_us * [0.3, 1.0, 1.0, 2.5, 6.0][chance.below(5)],
        bins_per_row: 1 + chance.below(2),
        field: has_field.then(|| (rows + chance.below(5), columns + chance.below(5))),
        sensor: Sensor {
            bias_counts: maybe(chance, 100.0),
            gain_electrons_per_count: maybe(chance, 0.5),
            read_noise_electrons: maybe(chance, 2.0),
            full_well_counts: maybe(chance, 5000.0),
            ..Sensor::default()
        },
    }
}

fn options(chance: &mut Chance) -> Options {
    let prior = PRIORS.get(chance.below(2 * PRIORS.len()));
    Options {
        prior: prior.map(|name| name.parse::<Prior>().unwrap()),
        tau: match chance.below(4) {
            0 => Tau::Given(power(chance, -30.0, 30.0)),
            1 => Tau::HeldOut,
            _ => Tau::Auto,
        },
        noise_sigma: (chance.below(3) == 0).then(|| power(chance, -20.0, 20.0)),
        max_iterations: (chance.below(2) == 0).then(|| 1 + chance.below(60)),
        self_calibration: [
            SelfCalibration::OFF,
            SelfCalibration::AUTO,
            SelfCalibration::ON,
        ][chance.below(3)],
        keep_all_pixels: chance.below(2) == 0,
        ..Options::default()
    }
}

/// Reconstructs one random input; whether there was a result.
fn reconstruct(case: u64) -> bool {
    let chance = &mut Chance::new(case);
    let params = params(chance);
    let (rows, columns) = (params.rows, params.columns);
    let sides = (1 + chance.below(40), 1 + chance.below(40));
    let (Ok(camera), Ok(psf)) = (
        Camera::new(params),
        Psf::new(picture(chance, sides.0, sides.1)),
    ) else {
        return false;
    };
    let setup = Setup {
        options: options(chance),
        ..Setup::new(camera, PatchSet::from(psf))
    };
    let frame = Frame {
        capture: Capture {
            image: picture(chance, rows, columns),
            format: SampleFormat::Float,
        },
        bias: Bias::Contained,
        file: None,
    };
    let Ok(task) = setup.task(&frame, None) else {
        return false;
    };
    let Ok(mut completed) = solve(task, Instant::now(), &mut |_| ControlFlow::Continue(())) else {
        return false;
    };
    let traces = completed.evaluate(TraceRequest::default(), chance.below(3) == 0);
    let summary = completed.summary(&traces);
    let found = &completed.reconstruction;
    let is_fine = |v: &f32| v.is_finite() && *v >= 0.0;
    assert!(found.video.data().iter().all(is_fine), "a video of light");
    let numbers = [
        summary.tau,
        summary.residual_over_sigma,
        summary.noise_sigma,
    ];
    assert!(numbers.iter().all(|v| v.is_finite()), "{numbers:?}");
    true
}

#[test]
fn any_input_gives_a_result_or_an_error() {
    let results = std::sync::atomic::AtomicU64::new(0);
    run_cases("any input", 0, &|case| {
        let is_result = reconstruct(case);
        results.fetch_add(u64::from(is_result), std::sync::atomic::Ordering::Relaxed);
    });
    println!("{} with a result", results.into_inner());
}
