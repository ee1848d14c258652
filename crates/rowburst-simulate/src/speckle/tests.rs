//! Statistics of speckle (Goodman, chapters 3 and 4) and the limits of the optics.

use super::*;

/// Grains of 8 px in an envelope of 320 px: the pixels blur next to nothing.
fn fine() -> SpeckleOptics {
    SpeckleOptics {
        wavelength_nm: 500.0,
        aperture: Aperture::Pupil {
            diameter_mm: 500e-6 * 100.0 / (8.0 * 3e-3),
            image_distance_mm: 100.0,
        },
        diffuser_fwhm_deg: 0.55,
        pixel_pitch_um: 3.0,
    }
}

/// The middle of a PSF over its Gaussian envelope, scaled to a mean of 1.
fn flattened(optics: &SpeckleOptics, side: usize, seed: u64) -> Image {
    let psf = speckle_psf(optics, side, side, seed).unwrap();
    let sigma = optics.envelope_fwhm_px() / (8.0 * 2f64.ln()).sqrt();
    let mut image = Image::from_fn(side, side, |y, x| {
        let r = (y as f64 - (side / 2) as f64).hypot(x as f64 - (side / 2) as f64);
        psf.image().at(y, x) * (0.5 * (r / sigma).powi(2)).exp() as f32
    });
    let mean = mean(image.data());
    image.data_mut().iter_mut().for_each(|p| *p /= mean as f32);
    image
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|&p| f64::from(p)).sum::<f64>() / values.len() as f64
}

fn contrast(image: &Image) -> f64 {
    let mean = mean(image.data());
    let square: f64 = image.data().iter().map(|&p| f64::from(p).powi(2)).sum();
    (square / image.data().len() as f64 / (mean * mean) - 1.0).sqrt()
}

#[test]
fn speckle_is_fully_developed() {
    let mut contrasts = 0.0;
    let mut grains = Vec::new();
    for seed in 0..6 {
        let image = flattened(&fine(), 321, seed);
        contrasts += contrast(&image) / 6.0;
        // Two grains apart the intensities are independent.
        for y in (0..321).step_by(16) {
            grains.extend(image.row(y).iter().step_by(16).map(|&p| f64::from(p)));
        }
    }
    assert!((contrasts - 1.0).abs() < 0.05, "contrast {contrasts}");

    grains.sort_by(f64::total_cmp);
    let count = grains.len() as f64;
    let distance = |(i, intensity): (usize, &f64)| {
        let model = 1.0 - (-intensity).exp();
        (model - i as f64 / count)
            .abs()
            .max((model - (i + 1) as f64 / count).abs())
    };
    let distance = grains.iter().enumerate().map(distance).fold(0.0, f64::max);
    println!("contrast {contrasts:.4}, Kolmogorov-Smirnov {distance:.4} of {count}");
    // 1.36/√count is the bound of 95 % for as many independent exponential values.
    assert!(distance < 1.36 / count.sqrt(), "{distance} of {count}");
}

#[test]
fn grain_is_that_of_the_airy_disc() {
    let mut covariance = [0.0; 16];
    for seed in 0..6 {
        let image = flattened(&fine(), 321, seed);
        for (lag, sum) in covariance.iter_mut().enumerate() {
            for y in 0..321 {
                let row = image.row(y);
                for (a, b) in row.iter().zip(&row[lag..]) {
                    *sum += f64::from((a - 1.0) * (b - 1.0)) / (321 - lag) as f64;
                }
            }
        }
    }
    let half = covariance
        .iter()
        .position(|c| *c < 0.5 * covariance[0])
        .unwrap();
    let (above, below) = (covariance[half - 1], covariance[half]);
    let half_width = (half - 1) as f64 + (above - 0.5 * covariance[0]) / (above - below);
    let expected = 0.5 * 1.029 * fine().grain_px();
    println!("half width {half_width:.3} px, Airy disc {expected:.3} px");
    assert!(
        (half_width / expected - 1.0).abs() < 0.1,
        "{half_width} {expected}"
    );
    // The first dark ring, at 1.22 λz/D.
    let ring = covariance[(1.22 * fine().grain_px()).round() as usize] / covariance[0];
    assert!(ring.abs() < 0.05, "{ring}");
}

#[test]
fn envelope_is_that_of_the_diffuser_and_nothing_goes_unscattered() {
    let optics = SpeckleOptics::demo();
    let side = 591;
    let centre = (side / 2) as f64;
    let fwhm = optics.envelope_fwhm_px();
    let (mut energy, mut count) = (vec![0.0; side], vec![0.0; side]);
    let (mut core, mut edge) = (0.0, 0.0);
    for seed in 0..40 {
        let psf = speckle_psf(&optics, side, side, seed).unwrap();
        for y in 0..side {
            for x in 0..side {
                let value = f64::from(psf.image().at(y, x)) / 40.0;
                let radius = (y as f64 - centre).hypot(x as f64 - centre);
                energy[(radius / 6.0) as usize] += value;
                count[(radius / 6.0) as usize] += 1.0;
                core += if radius < 2.0 * optics.grain_px() {
                    value
                } else {
                    0.0
                };
                edge += if radius > 1.9 * fwhm { value } else { 0.0 };
            }
        }
    }
    // ln(mean) = c − r²/(2σ²), weighted by the number of pixels, inside the half maximum.
    let rings = 0..(0.6 * fwhm / 6.0) as usize;
    let point = |i: usize| {
        let radius = 6.0 * (i as f64 + 0.5);
        (count[i], radius * radius, (energy[i] / count[i]).ln())
    };
    let (mut w, mut wx, mut wy, mut wxx, mut wxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (weight, x, y) in rings.map(point) {
        w += weight;
        wx += weight * x;
        wy += weight * y;
        wxx += weight * x * x;
        wxy += weight * x * y;
    }
    let slope = (w * wxy - wx * wy) / (w * wxx - wx * wx);
    let measured = (4.0 * 2f64.ln() / -slope).sqrt();
    println!(
        "envelope {measured:.1} px of {fwhm:.1}, core {core:.2e}, beyond 4.5 sigma {edge:.2e}"
    );
    assert!((measured / fwhm - 1.0).abs() < 0.04, "{measured} {fwhm}");
    // A disc of two grains' radius holds 0.35 % of the scattered light.
    assert!(core < 0.01, "ballistic {core}");
    assert!(edge < 2e-3, "wrap-around {edge}");
}

#[test]
fn pixels_integrate_the_intensity() {
    let (small, large) = (fine_pixels(2.0), fine_pixels(6.0));
    let small = speckle_psf(&small, 99, 99, 3).unwrap();
    let large = speckle_psf(&large, 33, 33, 3).unwrap();
    let ratio = large.at_displacement(0, 0) / block(&small, 0, 0);
    for dy in -16..=16 {
        for dx in -16..=16 {
            let (got, want) = (large.at_displacement(dy, dx), ratio * block(&small, dy, dx));
            assert!(
                (got - want).abs() < 2e-7 + 2e-3 * want,
                "{dy} {dx}: {got} {want}"
            );
        }
    }
}

/// Grains of 4.8 µm.
fn fine_pixels(pixel_pitch_um: f64) -> SpeckleOptics {
    SpeckleOptics {
        wavelength_nm: 480.0,
        aperture: Aperture::ImageNa {
            na: 0.05,
            image_distance_mm: 20.0,
        },
        diffuser_fwhm_deg: 0.6,
        pixel_pitch_um,
    }
}

fn block(psf: &Psf, dy: isize, dx: isize) -> f32 {
    let value = |i: isize| psf.at_displacement(3 * dy + i / 3 - 1, 3 * dx + i % 3 - 1);
    (0..9).map(value).sum()
}

#[test]
fn demo_is_the_size_of_the_paper() {
    let optics = SpeckleOptics::demo();
    assert!(
        (optics.grain_px() - 2.5).abs() < 0.02,
        "{}",
        optics.grain_px()
    );
    assert!((optics.envelope_fwhm_px() - 140.0).abs() < 2.0);
    let psf = speckle_psf(&optics, 215, 215, 1).unwrap();
    assert_eq!((psf.image().rows(), psf.image().columns()), (215, 215));
    let flat = contrast(&flattened(&optics, 141, 1));
    println!("contrast in the demo's pixels {flat:.3}");
    // Goodman, section 4.6: pixels of 1/2.5 of a grain leave 0.938 of it.
    assert!((flat - 0.938).abs() < 0.05, "{flat}");
}

#[test]
fn seeds_decide() {
    let psf = |seed| speckle_psf(&SpeckleOptics::demo(), 31, 40, seed).unwrap();
    assert_eq!(psf(7), psf(7));
    assert_ne!(psf(7), psf(8));
}

#[test]
fn impossible_optics_are_refused() {
    let refused = |change: fn(&mut SpeckleOptics), word: &str| {
        let mut optics = SpeckleOptics::demo();
        change(&mut optics);
        let message = speckle_psf(&optics, 9, 9, 0).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    };
    refused(|o| o.wavelength_nm = 0.0, "wavelength_nm");
    refused(|o| o.wavelength_nm = f64::NAN, "wavelength_nm");
    refused(|o| o.pixel_pitch_um = -6.5, "pixel_pitch_um");
    refused(|o| o.diffuser_fwhm_deg = 90.0, "90");
    refused(|o| o.diffuser_fwhm_deg = f64::NAN, "90");
    refused(|o| o.diffuser_fwhm_deg = 0.01, "grains");
    refused(|o| o.diffuser_fwhm_deg = 60.0, "8192");
    refused(
        |o| {
            o.aperture = Aperture::Pupil {
                diameter_mm: 30.0,
                image_distance_mm: 10.0,
            };
        },
        "below 1",
    );
    refused(
        |o| {
            o.aperture = Aperture::Lens {
                diameter_mm: 3.0,
                focal_length_mm: 10.0,
                magnification: -2.0,
            };
        },
        "magnification",
    );
    assert!(speckle_psf(&SpeckleOptics::demo(), 0, 9, 0).is_err());
    assert!(speckle_psf(&SpeckleOptics::demo(), 9, 99_999, 0).is_err());
}

#[test]
fn a_psf_larger_than_its_window_ends_in_zeros() {
    let psf = speckle_psf(&SpeckleOptics::demo(), 3, 1001, 0).unwrap();
    assert_eq!(psf.at_displacement(0, 400), 0.0);
    assert!(psf.at_displacement(0, 60) > 0.0);
}

/// Standard deviation of the light along an axis, in pixels, and the place of its middle.
fn width(image: &Image, along: fn(usize, usize) -> usize) -> (f64, f64) {
    let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
    for y in 0..image.rows() {
        for x in 0..image.columns() {
            let (value, at) = (f64::from(image.at(y, x)), along(y, x) as f64);
            sum += value;
            first += value * at;
            second += value * at * at;
        }
    }
    let middle = first / sum;
    ((second / sum - middle * middle).sqrt(), middle)
}

#[test]
fn a_smooth_strong_plate_scatters_as_wide_into_caustics() {
    let optics = SpeckleOptics::demo();
    let sigma = optics.envelope_fwhm_px() / (8.0 * 2f64.ln()).sqrt();
    let seeds = 0..12;
    let count = seeds.end as f64;
    let (mut square, mut peaks) = (0.0, [0.0; 2]);
    for seed in seeds {
        let caustic = phase_plate_psf(&optics, 30.0, 601, 601, seed).unwrap();
        // About the axis: the mean slope of a plate with few parts is its own.
        for along in [(|y, _| y) as fn(usize, usize) -> usize, |_, x| x] {
            let (width, middle) = width(caustic.image(), along);
            square += (width * width + (middle - 300.0).powi(2)) / (2.0 * count);
        }
        let speckle = speckle_psf(&optics, 601, 601, seed).unwrap();
        for (peak, psf) in peaks.iter_mut().zip([&speckle, &caustic]) {
            *peak += f64::from(psf.image().max()) / count;
        }
    }
    println!("rms {:.1} of {sigma:.1} px, peaks {peaks:?}", square.sqrt());
    assert!(
        (square.sqrt() / sigma - 1.0).abs() < 0.15,
        "{}",
        square.sqrt()
    );
    assert!(peaks[1] > 1.5 * peaks[0], "caustics are bright: {peaks:?}");
    let again = phase_plate_psf(&optics, 4.0, 31, 40, 7).unwrap();
    assert_eq!(again, speckle_psf(&optics, 31, 40, 7).unwrap());
    for bad in [0.0, 3.9, 101.0, f64::NAN] {
        let error = phase_plate_psf(&optics, bad, 9, 9, 0).unwrap_err();
        assert!(error.to_string().contains("radians"), "{error}");
    }
}
