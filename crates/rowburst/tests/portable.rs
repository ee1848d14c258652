//! The loops as every processor has them give what those of this processor give, to 1e-6 (`ROWBURST_SIMD`).

use rowburst::camera::CameraParams;
use rowburst::linop::{LinearOperator, Scalar};
use rowburst::prox::{Prox, Variation, VariationWeights};
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shutter};
use std::process::Command;

/// Forward, adjoint and a prox, of sides that fill no vector, in both engines.
fn numbers<T: Scalar>() -> Vec<f64> {
    let wave = |i: usize| ((i * i % 1013) as f64 * 0.37).sin() + 1.1;
    let mut all = Vec::new();
    for (shutter, size) in [
        (Shutter::DualInsideOut, (26, 27)),
        (Shutter::Global, (17, 19)),
    ] {
        let camera = Camera::new(CameraParams {
            rows: size.0,
            columns: size.1,
            shutter,
            row_time_us: 9.6,
            exposure_us: 9.6,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let (rows, columns) = (2 * size.0 - 1, 2 * size.1 - 1);
        let psf = Psf::new(Image::from_fn(rows, columns, |y, x| {
            wave(y * 60 + x) as f32
        }))
        .unwrap();
        let operator = RollingShutter::<T>::with_precision(&camera, &psf);
        let video: Vec<T> = (0..operator.domain_len())
            .map(|i| T::nearest(wave(i)))
            .collect();
        let mut frame = vec![T::zero(); operator.range_len()];
        let mut back = video.clone();
        operator.apply(&video, &mut frame);
        operator.adjoint(&frame, &mut back);
        let q: Vec<f32> = back.iter().map(|v| (*v).into() as f32).collect();
        let mut z = q.clone();
        let weights = VariationWeights {
            space: 1.0,
            time: 0.5,
            l1: 0.1,
        };
        let shape = operator.video_shape();
        Variation::new(shape, weights).prox(&q, 0.3 * f64::from(q[7]), &mut z);
        all.extend(frame.iter().chain(&back).map(|v| -> f64 { (*v).into() }));
        all.extend(z.iter().map(|v| f64::from(*v)));
    }
    all
}

/// Prints what [`the_portable_loops_agree`] compares with; a test by itself it is not.
#[test]
#[ignore = "run by the_portable_loops_agree"]
fn print_numbers() {
    for value in numbers::<f32>().iter().chain(&numbers::<f64>()) {
        println!("number {:016x}", value.to_bits());
    }
}

#[test]
fn the_portable_loops_agree() {
    let program = std::env::current_exe().unwrap();
    let portable = Command::new(program)
        .args(["--ignored", "--exact", "print_numbers", "--nocapture"])
        .env("ROWBURST_SIMD", "portable")
        .output()
        .unwrap();
    assert!(portable.status.success());
    let text = String::from_utf8(portable.stdout).unwrap();
    let bits = text.lines().filter_map(|line| line.split("number ").nth(1));
    let portable: Vec<f64> = bits
        .map(|bits| f64::from_bits(u64::from_str_radix(bits, 16).unwrap()))
        .collect();
    let (single, double) = (numbers::<f32>(), numbers::<f64>());
    assert_eq!(portable.len(), single.len() + double.len());
    let error = |a: &[f64], b: &[f64]| {
        let far: f64 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
        (far / b.iter().map(|b| b * b).sum::<f64>()).sqrt()
    };
    let (low, high) = portable.split_at(single.len());
    let (low, high) = (error(low, &single), error(high, &double));
    assert!(low < 1e-6 && high < 1e-6, "{low} {high}");
    // Where the processor has more than the portable loops use, they are others.
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma") {
        assert!(low > 0.0);
    }
}
