use super::*;
use crate::camera::CameraParams;
use crate::{Sensor, Shutter};

fn camera(sensor: Sensor) -> Camera {
    Camera::new(CameraParams {
        rows: 4,
        columns: 6,
        shutter: Shutter::TopDown,
        row_time_us: 1.0,
        exposure_us: 1.0,
        bins_per_row: 1,
        field: None,
        sensor,
    })
    .unwrap()
}

fn ramp(rows: usize, columns: usize) -> Image {
    Image::from_fn(rows, columns, |y, x| 100.0 + (y * columns + x) as f32)
}

#[test]
fn frames_without_light_in_usable_pixels_are_refused() {
    let mask = Image::from_fn(4, 6, |y, _| if y == 0 { 255.0 } else { 0.0 });
    let saturating = Corrections {
        saturation_counts: Some(255.0),
        ..Corrections::default()
    };
    let refused = |raw: &Image, corrections: &Corrections| {
        let error = correct(raw, &camera(Sensor::default()), corrections);
        error.unwrap_err().to_string()
    };
    let message = refused(&mask, &saturating);
    assert!(message.contains("but 6 saturated and 0 bad"), "{message}");
    assert!(correct(&mask, &camera(Sensor::default()), &Corrections::default()).is_ok());
    let own_dark = Corrections {
        dark: Some(ramp(4, 6)),
        ..Corrections::default()
    };
    let message = refused(&ramp(4, 6), &own_dark);
    assert!(message.contains("less the dark"), "{message}");
}

#[test]
fn dark_flat_and_bad_pixels() {
    let raw = ramp(4, 6);
    let corrections = Corrections {
        dark: Some(Image::from_fn(4, 6, |_, _| 100.0)),
        flat: Some(Image::from_fn(
            4,
            6,
            |y, _| if y == 1 { 150.0 } else { 200.0 },
        )),
        bad_pixels: Some(Image::from_fn(4, 6, |y, x| {
            if (y, x) == (2, 3) { 255.0 } else { 0.0 }
        })),
        saturation_counts: Some(123.0),
    };
    let m = correct(&raw, &camera(Sensor::default()), &corrections).unwrap();
    // The mean response over the 22 usable pixels is (6·50 + 16·100)/22.
    let mean = 1900.0 / 22.0;
    assert!((f64::from(m.image().at(1, 2)) - 8.0 * mean / 50.0).abs() < 1e-4);
    assert!((f64::from(m.image().at(3, 1)) - 19.0 * mean / 100.0).abs() < 1e-4);
    let weights = m.weights().unwrap();
    assert_eq!(
        (weights[2 * 6 + 3], weights[3 * 6 + 5], weights[0]),
        (0.0, 0.0, 1.0)
    );
    assert_eq!((m.bad(), m.saturated()), (1, 1));
}

#[test]
fn weights_follow_shot_and_read_noise() {
    let sensor = Sensor {
        bias_counts: Some(100.0),
        gain_electrons_per_count: Some(2.0),
        read_noise_electrons: Some(3.0),
        ..Sensor::default()
    };
    let m = correct(&ramp(4, 6), &camera(sensor), &Corrections::default()).unwrap();
    // No light has the noise of one electron.
    let sigma = |count: f64| (((count * 2.0).max(1.0) + 9.0) / 4.0).sqrt();
    let weights = m.weights().unwrap();
    for count in [0, 5, 23] {
        let expected = m.sigma().unwrap() / sigma(count as f64);
        assert!((f64::from(weights[count]) - expected).abs() < 1e-6);
    }
}

#[test]
fn raw_pixels_are_binned() {
    let sensor = Sensor {
        binning: 2,
        ..Sensor::default()
    };
    let m = correct(
        &ramp(8, 12),
        &camera(sensor.clone()),
        &Corrections::default(),
    )
    .unwrap();
    assert_eq!(m.image(), &ramp(8, 12).binned(2));
    assert_eq!(m.weights(), None);
    assert!(
        correct(
            &ramp(4, 6),
            &camera(sensor.clone()),
            &Corrections::default()
        )
        .is_ok()
    );
    let error = correct(&ramp(4, 12), &camera(sensor), &Corrections::default()).unwrap_err();
    assert!(error.to_string().contains("8×12 before binning"), "{error}");
}

#[test]
fn a_binned_frame_takes_the_corrections_of_raw_pixels() {
    let sensor = Sensor {
        binning: 2,
        gain_electrons_per_count: Some(2.0),
        read_noise_electrons: Some(3.0),
        ..Sensor::default()
    };
    let dark = Image::from_fn(8, 12, |y, x| 90.0 + ((3 * y + x) % 5) as f32);
    let flat = Image::from_fn(8, 12, |y, x| dark.at(y, x) + 400.0 + (y / 2) as f32);
    let raw = Image::from_fn(8, 12, |y, x| dark.at(y, x) + 10.0 * (1.0 + (x / 2) as f32));
    let corrections = Corrections {
        dark: Some(dark),
        flat: Some(flat),
        bad_pixels: Some(Image::from_fn(8, 12, |y, x| {
            f32::from(u8::from((y, x) == (5, 6)))
        })),
        saturation_counts: None,
    };
    let camera = camera(sensor);
    let of_raw = correct(&raw, &camera, &corrections).unwrap();
    let of_binned = correct(&raw.binned(2), &camera, &corrections).unwrap();
    assert_eq!((of_raw.bad(), of_binned.bad()), (1, 1));
    assert_eq!(of_binned.weights().unwrap()[15], 0.0);
    for i in (0..24).filter(|&i| i != 15) {
        let of = |m: &Measurement| {
            let sigma = m.sigma().unwrap() / f64::from(m.weights().unwrap()[i]);
            (f64::from(m.image().data()[i]), sigma)
        };
        let (raw, binned) = (of(&of_raw), of(&of_binned));
        assert!((raw.0 / binned.0 - 1.0).abs() < 1e-4, "{raw:?} {binned:?}");
        assert!((raw.1 / binned.1 - 1.0).abs() < 1e-2, "{raw:?} {binned:?}");
    }
    // A raw frame still has the other three pixels of the block.
    assert!(of_raw.weights().unwrap()[15] > 0.0);
}

#[test]
fn a_flat_without_a_dark_frame_loses_the_bias() {
    let sensor = Sensor {
        bias_counts: Some(100.0),
        ..Sensor::default()
    };
    let corrections = Corrections {
        flat: Some(Image::from_fn(
            4,
            6,
            |_, x| if x < 3 { 200.0 } else { 300.0 },
        )),
        ..Corrections::default()
    };
    let m = correct(&ramp(4, 6), &camera(sensor), &corrections).unwrap();
    assert!((m.image().at(1, 1) - 7.0 * 1.5).abs() < 1e-4);
    assert!((m.image().at(1, 4) - 10.0 * 0.75).abs() < 1e-4);
}

#[test]
fn whole_counts_have_the_noise_of_rounding() {
    let noise = |bit_depth| {
        let sensor = Sensor {
            gain_electrons_per_count: Some(2.0),
            read_noise_electrons: Some(1.0),
            bit_depth,
            ..Sensor::default()
        };
        let m = correct(&ramp(4, 6), &camera(sensor), &Corrections::default());
        m.unwrap().sigma().unwrap().powi(2)
    };
    assert!((noise(Some(12)) - noise(None) - 1.0 / 12.0).abs() < 1e-6);
}

#[test]
fn a_pixel_that_is_bad_and_saturated_counts_once() {
    let corrections = Corrections {
        bad_pixels: Some(Image::from_fn(4, 6, |y, _| f32::from(u8::from(y == 3)))),
        saturation_counts: Some(117.0),
        ..Corrections::default()
    };
    let m = correct(&ramp(4, 6), &camera(Sensor::default()), &corrections).unwrap();
    assert_eq!((m.bad(), m.saturated()), (6, 1));
}

#[test]
fn corrections_say_what_is_wrong_with_them() {
    let says = |corrections: Corrections, words: [&str; 2]| {
        let error = correct(&ramp(4, 6), &camera(Sensor::default()), &corrections);
        let message = error.unwrap_err().to_string();
        assert!(words.iter().all(|w| message.contains(w)), "{message}");
    };
    let odd = |value: f32| {
        Some(Image::from_fn(4, 6, |y, x| {
            if (y, x) == (2, 5) { value } else { 200.0 }
        }))
    };
    let none = Corrections::default;
    says(
        Corrections {
            dark: odd(f32::NAN),
            ..none()
        },
        ["dark: found NaN at row 2, column 5", "finite"],
    );
    says(
        Corrections {
            flat: odd(-3.0),
            ..none()
        },
        ["flat: found -3 at row 2, column 5", "bad_pixels"],
    );
    says(
        Corrections {
            flat: Some(ramp(4, 5)),
            ..none()
        },
        ["flat: found 4×5 pixels", "4×6"],
    );
    let nan = Image::from_fn(
        4,
        6,
        |y, x| if (y, x) == (1, 1) { f32::NAN } else { x as f32 },
    );
    let message = Measurement::new(nan).unwrap_err().to_string();
    assert!(message.contains("NaN at row 1, column 1"), "{message}");
}

#[test]
fn frames_without_information_are_refused() {
    let camera = camera(Sensor {
        bit_depth: Some(8),
        ..Sensor::default()
    });
    let refused = |image: Image| {
        correct(&image, &camera, &Corrections::default())
            .unwrap_err()
            .to_string()
    };
    assert!(refused(Image::zeros(4, 6)).contains("zero in every pixel"));
    assert!(refused(Image::from_fn(4, 6, |_, _| 255.0)).contains("255 in every pixel"));
    assert!(
        refused(Image::from_fn(4, 6, |y, _| if y < 3 { 255.0 } else { 9.0 })).contains("18 of 24")
    );
    let mut nan = ramp(4, 6);
    nan.data_mut()[8] = f32::NAN;
    assert!(refused(nan).contains("row 1, column 2"));
}
