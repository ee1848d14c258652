use super::*;
use rowburst_optics::{Sensor, TimeGrid};
use rowburst_simulate::noise::Noise;

const FREQUENCY_HZ: f64 = 1000.0;

/// A frame of `light` (from 0 to 1 over time in µs) by the camera's own time grid: the
/// mean of the light over fine bins, weighed as the forward model weighs them.
fn frame(
    rows: usize,
    shutter: &Shutter,
    row_time_us: f64,
    exposure_us: f64,
    light: impl Fn(f64) -> f64,
) -> Image {
    let k = shutter.instants(rows).unwrap();
    let bins_per_row = 16;
    let grid = TimeGrid::rolling(
        count_of(&k),
        row_time_us,
        exposure_us / row_time_us,
        bins_per_row,
    );
    let bin = grid.bin_duration_us();
    let video: Vec<f64> = (0..grid.bins())
        .map(|j| {
            (0..4)
                .map(|q| light((j as f64 + (f64::from(q) + 0.5) / 4.0) * bin))
                .sum::<f64>()
                / 4.0
        })
        .collect();
    let seen = |instant: usize| -> f64 {
        let weights = &grid.instants()[instant];
        let run = &video[weights.first_bin..];
        weights
            .weights
            .iter()
            .zip(run)
            .map(|(w, v)| w * v)
            .sum::<f64>()
    };
    let middle = 0.5 * rows as f64;
    let lamp = |y: usize, x: usize| {
        let (dy, dx) = (
            (y as f64 - 0.8 * middle) / rows as f64,
            (x as f64 - 3.0) / 16.0,
        );
        1.0 - 0.6 * dy * dy - 0.2 * dx * dx
    };
    Image::from_fn(rows, 8, |y, x| (100.0 * lamp(y, x) * seen(k[y])) as f32)
}

/// The signal-to-noise ratio of every pixel.
fn noisy(image: &Image, snr: f64, seed: u64) -> Image {
    Noise::Gaussian { snr }
        .apply(image, &Sensor::default(), seed)
        .unwrap()
        .frame
}

fn square(phase: f64) -> impl Fn(f64) -> f64 {
    move |t: f64| {
        if (t * FREQUENCY_HZ * 1e-6 + phase).rem_euclid(1.0) < 0.5 {
            1.0
        } else {
            0.05
        }
    }
}

const PLAIN: Lamp = Lamp::Periodic {
    frequency_hz: FREQUENCY_HZ,
    duty: None,
};

fn found(image: Image, light: &Lamp) -> Timing {
    calibrate(&[image], light, &TimingParams::default()).unwrap()
}

#[test]
fn row_times_from_5_to_40_us_are_found() {
    for (i, row_time) in [5.0, 9.6, 14.57, 23.3, 40.0].into_iter().enumerate() {
        let rows = if row_time < 9.0 { 1024 } else { 512 };
        for (shutter, rows) in [(Shutter::TopDown, rows), (Shutter::DualInsideOut, 2 * rows)] {
            let image = frame(rows, &shutter, row_time, 60.0, square(0.13));
            let timing = found(noisy(&image, 20.0, i as u64), &PLAIN);
            let off = timing.row_time_us / row_time - 1.0;
            println!(
                "{row_time} {shutter:?}: {off:+.1e} ± {:.1e}",
                timing.row_time_us_error / row_time
            );
            assert!(off.abs() < 2e-3, "{row_time} µs: {}", timing.row_time_us);
            assert!((timing.row_time_us - row_time).abs() < 4.0 * timing.row_time_us_error);
        }
    }
}

#[test]
fn one_sweep_and_two_are_told_apart_by_a_square_wave() {
    for phase in [0.21, 0.77] {
        for (pair, twin, rows) in [
            (Shutter::TopDown, Shutter::BottomUp, 512),
            (Shutter::DualInsideOut, Shutter::DualOutsideIn, 1024),
        ] {
            for shutter in [&pair, &twin] {
                let image = noisy(&frame(rows, shutter, 9.6, 40.0, square(phase)), 20.0, 5);
                let timing = found(image, &PLAIN);
                assert_eq!(
                    timing.shutters.len(),
                    2,
                    "{shutter:?} {phase}: {:?}",
                    timing.candidates
                );
                assert!(
                    timing.shutters.contains(&pair) && timing.shutters.contains(&twin),
                    "{shutter:?} {phase}: {:?}",
                    timing.candidates
                );
                assert!(timing.advice.unwrap().contains("chirp"));
            }
        }
    }
}

#[test]
fn a_square_wave_shows_the_exposure() {
    for (shutter, rows) in [(Shutter::DualInsideOut, 1024), (Shutter::TopDown, 512)] {
        for exposure in [30.0, 100.0, 400.0] {
            let image = noisy(&frame(rows, &shutter, 9.6, exposure, square(0.3)), 20.0, 9);
            let timing = found(image, &PLAIN);
            let (got, error) = timing.exposure_us.expect(&timing.exposure_basis);
            println!("{shutter:?} {exposure}: {got:.2} ± {error:.2}");
            assert!(
                (got / exposure - 1.0).abs() < 0.05,
                "{exposure}: {got} ± {error}"
            );
        }
    }
}

#[test]
fn a_sine_does_not_show_the_exposure() {
    let sine = |t: f64| 1.0 + 0.7 * (std::f64::consts::TAU * t * FREQUENCY_HZ * 1e-6).sin();
    let image = noisy(&frame(1024, &Shutter::TopDown, 9.6, 100.0, sine), 20.0, 2);
    let timing = found(image, &PLAIN);
    assert_eq!(timing.exposure_us, None, "{}", timing.exposure_basis);
    assert!((timing.row_time_us / 9.6 - 1.0).abs() < 2e-3);
}

#[test]
fn the_error_of_the_row_time_is_calibrated() {
    let (mut within_1, mut within_3, seeds) = (0, 0, 60);
    let truth = 9.6;
    let image = frame(384, &Shutter::TopDown, truth, 200.0, square(0.37));
    for seed in 0..seeds {
        let timing = found(noisy(&image, 5.0, seed), &PLAIN);
        let off = (timing.row_time_us - truth).abs() / timing.row_time_us_error;
        within_1 += u32::from(off < 1.0);
        within_3 += u32::from(off < 3.0);
    }
    println!("within one error {within_1}, three {within_3} of {seeds}");
    assert!((32..=52).contains(&within_1), "{within_1}");
    assert!(within_3 >= 58, "{within_3}");
}

/// A shorter search than the default one, for the time that a test may take.
fn narrow() -> TimingParams {
    TimingParams {
        row_times_us: (8.0, 24.0),
        ..TimingParams::default()
    }
}

/// A chirp from 1 to 5 kHz over 12 ms, dark before and after.
fn chirp() -> (Waveform, impl Fn(f64) -> f64) {
    let value = |t: f64| {
        if !(0.0..12_000.0).contains(&t) {
            return 0.0;
        }
        let t = t * 1e-3;
        0.5 - 0.5 * (std::f64::consts::TAU * (t + 2.0 / 12.0 * t * t)).cos()
    };
    let points: Vec<(f64, f64)> = (0..=2400)
        .map(|i| (f64::from(i) * 5.0, value(f64::from(i) * 5.0)))
        .collect();
    (Waveform::new(&points, Extension::Holds).unwrap(), value)
}

#[test]
fn a_chirp_tells_all_orders_and_the_exposure() {
    let (waveform, value) = chirp();
    let light = Lamp::Waveform(waveform);
    for (shutter, rows) in ORDERS.into_iter().zip([512, 511, 1024, 1023]) {
        let image = noisy(
            &frame(rows, &shutter, 14.3, 90.0, |t| value(t + 2000.0)),
            20.0,
            4,
        );
        let timing = calibrate(&[image], &light, &narrow()).unwrap();
        println!(
            "{shutter:?}: {} ± {}, {:?}",
            timing.row_time_us, timing.row_time_us_error, timing.exposure_us
        );
        assert_eq!(timing.shutters, [shutter], "{:?}", timing.candidates);
        assert!((timing.row_time_us / 14.3 - 1.0).abs() < 2e-3);
        let (exposure, _) = timing.exposure_us.expect(&timing.exposure_basis);
        assert!((exposure / 90.0 - 1.0).abs() < 0.05, "{exposure}");
        assert_eq!(timing.advice, None);
    }
}

#[test]
fn an_unequal_double_pulse_tells_the_direction() {
    let points = [
        (0.0, 0.0),
        (0.0, 1.0),
        (900.0, 1.0),
        (900.0, 0.0),
        (2500.0, 0.0),
        (2500.0, 1.0),
        (2800.0, 1.0),
        (2800.0, 0.0),
        (4000.0, 0.0),
    ];
    let light = Lamp::Waveform(Waveform::new(&points, Extension::Holds).unwrap());
    let value = |t: f64| {
        if (0.0..900.0).contains(&t) || (2500.0..2800.0).contains(&t) {
            1.0
        } else {
            0.0
        }
    };
    for shutter in ORDERS {
        let image = noisy(
            &frame(1024, &shutter, 9.6, 50.0, |t| value(t - 700.0)),
            20.0,
            4,
        );
        let timing = calibrate(&[image], &light, &narrow()).unwrap();
        assert_eq!(timing.shutters, [shutter], "{:?}", timing.candidates);
        assert!(
            (timing.row_time_us / 9.6 - 1.0).abs() < 2e-3,
            "{}",
            timing.row_time_us
        );
    }
}

#[test]
fn several_frames_agree_or_are_refused() {
    let image = |phase, row_time, seed| {
        noisy(
            &frame(512, &Shutter::BottomUp, row_time, 60.0, square(phase)),
            5.0,
            seed,
        )
    };
    let params = TimingParams::default();
    let one = calibrate(&[image(0.1, 9.6, 1)], &PLAIN, &params).unwrap();
    let three = [image(0.1, 9.6, 1), image(0.5, 9.6, 2), image(0.75, 9.6, 3)];
    let three = calibrate(&three, &PLAIN, &params).unwrap();
    assert!(three.row_time_us_error < 0.8 * one.row_time_us_error);
    assert!((three.row_time_us - 9.6).abs() < 4.0 * three.row_time_us_error);
    let two = [image(0.1, 9.6, 1), image(0.5, 19.2, 2)];
    let Err(error) = calibrate(&two, &PLAIN, &params) else {
        panic!("frames of two row times");
    };
    assert!(error.to_string().contains("disagree"), "{error}");
}

#[test]
fn a_still_scene_is_taken_out_of_several_frames() {
    let scene = |y: usize| 1.0 + 0.5 * (y as f32 * 0.7).sin() + 0.4 * ((y / 37) % 2) as f32;
    let image = |phase, seed| {
        let lit = frame(512, &Shutter::TopDown, 9.6, 60.0, square(phase));
        let lit = Image::from_fn(512, 8, |y, x| lit.at(y, x) * scene(y));
        noisy(&lit, 20.0, seed)
    };
    let frames: Vec<Image> = [0.1, 0.42, 0.75, 0.6]
        .into_iter()
        .zip(1..)
        .map(|(phase, seed)| image(phase, seed))
        .collect();
    let timing = calibrate(&frames, &PLAIN, &TimingParams::default()).unwrap();
    let one = calibrate(&frames[..1], &PLAIN, &TimingParams::default()).unwrap();
    println!(
        "{} ± {}, one {} ± {}",
        timing.row_time_us, timing.row_time_us_error, one.row_time_us, one.row_time_us_error
    );
    assert!((timing.row_time_us - 9.6).abs() < 4.0 * timing.row_time_us_error);
    assert!(timing.row_time_us_error < 0.3 * one.row_time_us_error);
    assert!(timing.shutters.contains(&Shutter::TopDown) && timing.shutters.len() == 2);
}

#[test]
fn poor_frames_are_refused_with_a_remedy() {
    let refused = |image: Image, frequency_hz: f64, words: [&str; 2]| {
        let light = Lamp::Periodic {
            frequency_hz,
            duty: None,
        };
        let error =
            calibrate(&[noisy(&image, 20.0, 3)], &light, &TimingParams::default()).unwrap_err();
        assert!(error.is_input());
        for word in words {
            assert!(error.to_string().contains(word), "{error}");
        }
    };
    let top = Shutter::TopDown;
    // 512 rows of 4 µs are 2 periods of 1 kHz.
    refused(
        frame(512, &top, 4.0, 50.0, square(0.1)),
        FREQUENCY_HZ,
        ["periods of the light", "Blink faster"],
    );
    refused(
        frame(512, &top, 9.6, 50.0, |_| 1.0),
        FREQUENCY_HZ,
        ["no stripes", "shorten the exposure"],
    );
    // 40 kHz at 9.6 µs: 0.384 cycles per row.
    let fast = |t: f64| square(0.1)(40.0 * t);
    refused(
        frame(512, &top, 9.6, 3.0, fast),
        40_000.0,
        ["alias", "Blink more slowly"],
    );
    let expected = TimingParams {
        expected_row_time_us: Some(9.6),
        ..TimingParams::default()
    };
    let light = Lamp::Periodic {
        frequency_hz: 90_000.0,
        duty: None,
    };
    let error = calibrate(&[frame(512, &top, 9.6, 3.0, fast)], &light, &expected).unwrap_err();
    assert!(error.to_string().contains("two row times"), "{error}");
}

#[test]
fn saturation_is_told_and_takes_the_exposure_away() {
    let clean = frame(512, &Shutter::TopDown, 9.6, 60.0, square(0.2));
    let end = f64::from(clean.max()) * 0.7;
    let clipped = Image::from_fn(512, 8, |y, x| clean.at(y, x).min(end as f32));
    let params = TimingParams {
        saturation_counts: Some(end),
        ..TimingParams::default()
    };
    let timing = calibrate(&[clipped], &PLAIN, &params).unwrap();
    assert!(timing.warnings[0].contains("saturated"));
    assert_eq!(timing.exposure_us, None);
    assert!((timing.row_time_us / 9.6 - 1.0).abs() < 2e-3);
}

/// A frame of `rows` rows, of a dual shutter of 9.6 µs, under a square wave of `hertz`.
fn dual_frame(rows: usize, hertz: f64) -> Image {
    let light = move |t: f64| {
        let is_on = (t * hertz * 1e-6 + 0.2).rem_euclid(1.0) < 0.5;
        if is_on { 1.0 } else { 0.05 }
    };
    noisy(
        &frame(rows, &Shutter::DualInsideOut, 9.6, 9.6, light),
        256.0,
        1,
    )
}

fn judged(image: &Image, frequency_hz: f64, expected_row_time_us: Option<f64>) -> Result<Timing> {
    let lamp = Lamp::Periodic {
        frequency_hz,
        duty: None,
    };
    let params = TimingParams {
        expected_row_time_us,
        ..TimingParams::default()
    };
    calibrate(std::slice::from_ref(image), &lamp, &params)
}

/// 108 rows in pairs are read in half a period of 1000 Hz, which the expected row time tells. The frequency that the error
/// recommends works.
#[test]
fn a_light_that_is_too_slow_is_judged_by_the_expected_row_time() {
    let image = dual_frame(108, 1000.0);
    let message = judged(&image, 1000.0, Some(9.6)).unwrap_err().to_string();
    assert!(message.contains("0.52 to 1.04 periods"), "{message}");
    let numbers = message.split("Blink at ").nth(1).unwrap();
    let least: f64 = numbers.split(" Hz").next().unwrap().parse().unwrap();
    let best: f64 = numbers
        .split("about ")
        .nth(1)
        .and_then(|text| text.split(" Hz").next())
        .unwrap()
        .parse()
        .unwrap();
    for hertz in [least, best] {
        let timing = judged(&dual_frame(108, hertz), hertz, Some(9.6)).unwrap();
        assert!(
            (timing.row_time_us - 9.6).abs() < 0.2,
            "{}",
            timing.row_time_us
        );
    }
    // Without an expected row time so few periods cannot be counted, and the error does not.
    let message = judged(&image, 1000.0, None).unwrap_err().to_string();
    assert!(message.contains("fewer than 3 periods"), "{message}");
    assert!(!message.contains("1.95"), "{message}");
}

#[test]
fn a_frequency_in_another_unit_is_asked_for() {
    let image = dual_frame(108, 10_000.0);
    let message = judged(&image, 10.0, Some(9.6)).unwrap_err().to_string();
    assert!(message.contains("Is the frequency 10 kHz?"), "{message}");
    let timing = judged(&image, 10.0, None).unwrap();
    let warnings = timing.warnings.join("; ");
    assert!(warnings.contains("of 10 Hz, or of 10 kHz?"), "{warnings}");
    assert!(
        judged(&image, 10_000.0, None)
            .unwrap()
            .warnings
            .iter()
            .all(|w| !w.contains("kHz"))
    );
}

#[test]
fn half_and_double_the_expected_row_time_are_refused() {
    let image = dual_frame(216, 10_000.0);
    for (typed, hertz) in [(5_000.0, "10000 Hz"), (20_000.0, "10000 Hz")] {
        let message = judged(&image, typed, Some(9.6)).unwrap_err().to_string();
        assert!(
            message.contains(&format!("Does the light blink at {hertz}")),
            "{message}"
        );
    }
}
