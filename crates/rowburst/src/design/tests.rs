//! Closed forms against the simulation, which knows nothing of them.

use super::sparsity::{SparsityParams, constant, recoverable, success_map, trial_camera};
use super::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rowburst_core::Shape;
use rowburst_core::linop::LinearOperator;
use rowburst_optics::camera::CameraParams;
use rowburst_optics::{Image, RollingShutter, Sensor, Shutter, Video};
use rowburst_simulate::noise::Noise;
use rowburst_simulate::{Aperture, speckle_psf};
use rustfft::num_complex::Complex64;
use std::ops::ControlFlow;

fn camera(rows: usize, columns: usize, field: Option<(usize, usize)>) -> Camera {
    Camera::new(CameraParams {
        rows,
        columns,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field,
        sensor: Sensor::default(),
    })
    .unwrap()
}

fn assessed(camera: &Camera, optics: &SpeckleOptics) -> Assessment {
    assess(camera, optics, &LightParams::default(), None).unwrap()
}

/// The PSF of all displacements and of as much again, so that none of its light is missing.
fn whole_psf(optics: &SpeckleOptics, seed: u64) -> Psf {
    let side = (4.3 * optics.envelope_fwhm_px()) as usize | 1;
    speckle_psf(optics, side, side, seed).unwrap()
}

fn near(got: f64, want: f64, relative: f64, what: &str) {
    println!("{what}: {got:.4} against {want:.4}");
    assert!(
        (got - want).abs() <= relative * want.abs(),
        "{what}: {got} is not within {relative} of {want}"
    );
}

#[test]
fn the_defaults_are_the_paper() {
    let found = assessed(&camera(108, 108, None), &SpeckleOptics::demo());
    assert_eq!(found.frames, 54);
    assert_eq!(found.frame_rate_hz.floor(), 104_166.0);
    assert_eq!(found.measurements_per_bin, 216.0);
    near(
        found.camera_frame_rate_hz,
        1e6 / (55.0 * 9.6),
        1e-9,
        "own rate",
    );
    near(found.grains.grain_px, 2.5, 0.01, "grain");
    assert!(found.grains.is_sampled());
    // The whole chip of the paper's camera, read in 1024 instants: three orders.
    let chip = assessed(&camera(2048, 108, None), &SpeckleOptics::demo());
    near(
        chip.frame_rate_hz / chip.camera_frame_rate_hz,
        1025.0,
        1e-3,
        "gain",
    );
}

#[test]
fn grain_and_contrast_are_those_of_simulated_speckle() {
    for grain_px in [1.2, 2.5, 6.0] {
        let mut optics = SpeckleOptics::demo();
        if let Aperture::Lens { diameter_mm, .. } = &mut optics.aperture {
            *diameter_mm *= 2.5 / grain_px;
        }
        let found = assessed(&camera(108, 108, None), &optics);
        let psf = speckle_psf(&optics, 215, 215, 4).unwrap();
        let what = format!("width of grains of {grain_px} px");
        near(found.grains.fwhm_px(), measured_grain_px(&psf), 0.15, &what);

        // Contrast over the envelope, by the mean square of many seeds.
        let sigma = found.envelope_fwhm_px / 2.3548;
        let (mut sum, mut square, mut count) = (0.0, 0.0, 0.0);
        for seed in 0..6 {
            let psf = speckle_psf(&optics, 101, 101, seed).unwrap();
            for y in 0..101 {
                for x in 0..101 {
                    let r = (y as f64 - 50.0).hypot(x as f64 - 50.0);
                    let p = f64::from(psf.image().at(y, x)) * (0.5 * (r / sigma).powi(2)).exp();
                    (sum, square, count) = (sum + p, square + p * p, count + 1.0);
                }
            }
        }
        let contrast = (square * count / (sum * sum) - 1.0).sqrt();
        let what = format!("contrast of grains of {grain_px} px");
        near(found.grains.contrast(), contrast, 0.08, &what);
    }
}

#[test]
fn the_smallest_angle_just_meets_the_criterion() {
    for (rows, field) in [(108, None), (64, Some((96, 64)))] {
        let camera = camera(rows, 64, field);
        let smallest = assessed(&camera, &SpeckleOptics::demo()).smallest_diffuser_deg;
        let reach = |factor: f64| {
            let optics = SpeckleOptics {
                diffuser_fwhm_deg: factor * smallest,
                ..SpeckleOptics::demo()
            };
            let formula = assessed(&camera, &optics).spread.reach;
            // Grains scatter the light of a few rows by several per cent.
            let simulated: f64 = (0..12)
                .map(|seed| Spread::of_psf(&camera, &whole_psf(&optics, seed)).reach)
                .sum();
            (formula, simulated / 12.0)
        };
        near(reach(1.0).0, MIN_ROW_LIGHT, 1e-3, "at the smallest angle");
        let (formula, simulated) = reach(1.05);
        println!("1.05: {formula:.3} {simulated:.3}");
        assert!(formula > MIN_ROW_LIGHT && simulated > MIN_ROW_LIGHT);
        assert!((simulated - formula).abs() < 0.03);
        let (formula, simulated) = reach(0.8);
        println!("0.8: {formula:.3} {simulated:.3}");
        assert!(formula < MIN_ROW_LIGHT && simulated < MIN_ROW_LIGHT);
        assert!((simulated - formula).abs() < 0.03);
    }
}

#[test]
fn light_lost_is_that_of_simulated_speckle() {
    for field in [None, Some((90, 100))] {
        let camera = camera(60, 70, field);
        for angle in [0.5, 1.0] {
            let optics = SpeckleOptics {
                diffuser_fwhm_deg: angle,
                ..SpeckleOptics::demo()
            };
            let formula = assessed(&camera, &optics).spread;
            let of = |seed| Spread::of_psf(&camera, &whole_psf(&optics, seed));
            let (mut mean, mut worst) = (0.0, 0.0);
            for seed in 0..8 {
                mean += of(seed).lost_mean / 8.0;
                worst += of(seed).lost_worst / 8.0;
            }
            let what = format!("lost at {angle}°, field {field:?}");
            near(formula.lost_mean, mean, 0.05, &what);
            near(formula.lost_worst, worst, 0.05, &format!("worst {what}"));
        }
    }
}

/// `k` pixels of `electrons` at random places in each bin.
fn random_scene(shape: Shape, k: usize, electrons: f32, seed: u64) -> Video {
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut video = Video::zeros(shape);
    for t in 0..shape.bins {
        for _ in 0..k {
            let at = rng.random_range(0..shape.pixels());
            video.bin_mut(t)[at] += electrons;
        }
    }
    video
}

#[test]
fn snr_is_that_of_a_simulated_frame() {
    // With the closed form and with the PSF itself; two field sizes, two exposures.
    for (field, exposure_us) in [(None, 9.6), (Some((120, 120)), 28.8)] {
        let mut params = camera(80, 80, field).params().clone();
        params.exposure_us = exposure_us;
        let camera = Camera::new(params).unwrap();
        let optics = SpeckleOptics::demo();
        let light = LightParams {
            photons: 2e5,
            bright_pixels: 12,
            read_noise_electrons: 6.0,
            ..LightParams::default()
        };
        let psf = whole_psf(&optics, 3);
        let operator = RollingShutter::new(&camera, &psf);
        let electrons = (light.photons * light.quantum_efficiency) as f32;
        let scene = random_scene(camera.video_shape(), light.bright_pixels, electrons, 5);
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(scene.data(), &mut frame);
        frame.iter_mut().for_each(|b| *b = b.max(0.0));
        let noiseless = Image::new(80, 80, frame).unwrap();
        let sensor = Sensor {
            gain_electrons_per_count: Some(1.0),
            read_noise_electrons: Some(light.read_noise_electrons),
            ..Sensor::default()
        };
        let noise = Noise::Camera {
            peak_electrons: f64::from(noiseless.max()),
        };
        let recorded = noise.apply(&noiseless, &sensor, 6).unwrap();
        let (mut signal, mut error) = (0.0, 0.0);
        for (b, raw) in noiseless.data().iter().zip(recorded.frame.data()) {
            signal += f64::from(*b).powi(2);
            error += f64::from(raw - b).powi(2);
        }
        let simulated = (signal / error).sqrt();
        for psf in [None, Some(&psf)] {
            let found = assess(&camera, &optics, &light, psf).unwrap();
            let what = format!("SNR, {field:?}, {exposure_us} us, PSF {}", psf.is_some());
            near(found.signal.snr, simulated, 0.1, &what);
            let outliers = noiseless
                .data()
                .iter()
                .filter(|&&b| f64::from(b) > found.signal.peak);
            assert!(outliers.count() < 40, "peak {}", found.signal.peak);
        }
    }
}

/// Speckle of a diffuser with a fixed relief, at any wavelength, by summing the field of
/// every part of the pupil: no transform, no code of the simulation. Intensity at whole
/// pixels within `reach` of the axis.
fn physical_speckle(
    optics: &SpeckleOptics,
    relief_nm: &[f64],
    samples: usize,
    wavelength_nm: f64,
    reach: isize,
) -> Vec<f64> {
    let z_um = optics.aperture.image_distance_mm() * 1e3;
    let diameter_um = 2.0 * optics.aperture.na() * z_um;
    let step_um = diameter_um / samples as f64;
    let side = (2 * reach + 1) as usize;
    let turn = |x: isize, u: usize| {
        let place = (u as f64 - 0.5 * (samples - 1) as f64) * step_um;
        let path_um = x as f64 * optics.pixel_pitch_um * place / z_um;
        Complex64::cis(-std::f64::consts::TAU * path_um / (wavelength_nm * 1e-3))
    };
    let turns: Vec<Complex64> = (-reach..=reach)
        .flat_map(|x| (0..samples).map(move |u| turn(x, u)))
        .collect();
    let mut rows = vec![Complex64::default(); side * samples];
    for u in 0..samples {
        for v in 0..samples {
            let middle = 0.5 * (samples - 1) as f64;
            if (u as f64 - middle).hypot(v as f64 - middle) > 0.5 * samples as f64 {
                continue;
            }
            let phase = std::f64::consts::TAU * relief_nm[u * samples + v] / wavelength_nm;
            let field = Complex64::cis(phase);
            for x in 0..side {
                rows[x * samples + u] += field * turns[x * samples + v];
            }
        }
    }
    let mut image = Vec::with_capacity(side * side);
    for y in 0..side {
        for x in 0..side {
            let pairs = rows[x * samples..(x + 1) * samples]
                .iter()
                .zip(&turns[y * samples..(y + 1) * samples]);
            image.push(pairs.map(|(r, t)| r * t).sum::<Complex64>().norm_sqr());
        }
    }
    image
}

/// A relief of Gaussian statistics: rms `rms`, correlation length `length` in samples.
fn relief(samples: usize, rms: f64, length: f64, seed: u64) -> Vec<f64> {
    let mut rng = Pcg64::seed_from_u64(seed);
    let waves: Vec<[f64; 3]> = (0..300)
        .map(|_| {
            let mut normal = || -> f64 { rng.sample(rand_distr::StandardNormal) };
            let (fy, fx) = (normal(), normal());
            // exp(−r²/ℓ²) is the mean cosine of wave vectors of variance 2/ℓ² an axis.
            let scale = 2f64.sqrt() / length;
            [
                fy * scale,
                fx * scale,
                rng.random_range(0.0..std::f64::consts::TAU),
            ]
        })
        .collect();
    let amplitude = rms * (2.0 / waves.len() as f64).sqrt();
    (0..samples * samples)
        .map(|i| {
            let (y, x) = ((i / samples) as f64, (i % samples) as f64);
            let sum: f64 = waves
                .iter()
                .map(|w| (w[0] * y + w[1] * x + w[2]).cos())
                .sum();
            amplitude * sum
        })
        .collect()
}

#[test]
fn bandwidth_is_that_of_one_diffuser_in_two_colours() {
    // Weak diffusers keep the sums small: envelopes of 40 and 80 px, grains of 2.5 px. A
    // pupil holds 8 correlation lengths of the relief in both cases.
    let samples = 96;
    for (diffuser_fwhm_deg, phase) in [(0.285, 4.0), (0.57, 8.0)] {
        let optics = SpeckleOptics {
            diffuser_fwhm_deg,
            ..SpeckleOptics::demo()
        };
        let sensor = (140.0 * diffuser_fwhm_deg) as usize;
        let camera = camera(sensor, sensor, None);
        let path_nm = phase / std::f64::consts::TAU * optics.wavelength_nm;
        let light = LightParams {
            diffuser_path_rms_nm: Some(path_nm),
            ..LightParams::default()
        };
        let found = assess(&camera, &optics, &light, None).unwrap();
        // A slope s of the path throws the light to s·z: the rms slope is √2 ℓ_p/ℓ.
        let z_um = optics.aperture.image_distance_mm() * 1e3;
        let sigma_um = found.envelope_fwhm_px / 2.3548 * optics.pixel_pitch_um;
        let step_um = 2.0 * optics.aperture.na() * z_um / samples as f64;
        let length = 2f64.sqrt() * path_nm * 1e-3 * z_um / sigma_um / step_um;
        let sigma = found.envelope_fwhm_px / 2.3548;

        let difference = found.bandwidth_nm;
        let reach = (0.85 * sensor as f64) as isize;
        let side = (2 * reach + 1) as usize;
        let (mut cross, mut own) = (vec![0.0; 3], [0.0; 2]);
        for seed in 0..4 {
            let relief = relief(samples, path_nm, length, seed);
            let of = |nm: f64| physical_speckle(&optics, &relief, samples, nm, reach);
            let first = of(optics.wavelength_nm);
            let envelope = |i: usize| {
                let (y, x) = ((i / side) as f64, (i % side) as f64);
                let r2 = (y - reach as f64).powi(2) + (x - reach as f64).powi(2);
                (-0.5 * r2 / (sigma * sigma)).exp()
            };
            let pairs = |i: usize| {
                let d = |i: usize| (sensor as f64 - (i as f64 - reach as f64).abs()).max(0.0);
                d(i / side) * d(i % side)
            };
            // Fluctuations about the envelope, which is the same for both colours.
            let fluctuation = |image: &[f64]| -> Vec<f64> {
                let (sum, of_envelope): (f64, f64) = (0..image.len())
                    .map(|i| (image[i], envelope(i)))
                    .fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
                let scale = sum / of_envelope;
                (0..image.len())
                    .map(|i| image[i] / scale - envelope(i))
                    .collect()
            };
            let a = fluctuation(&first);
            own[0] += (0..a.len()).map(|i| pairs(i) * a[i] * a[i]).sum::<f64>();
            for (c, factor) in [2.0 / 3.0, 1.0, 1.5].into_iter().enumerate() {
                let b = fluctuation(&of(optics.wavelength_nm + factor * difference));
                cross[c] += (0..a.len()).map(|i| pairs(i) * a[i] * b[i]).sum::<f64>();
            }
        }
        let correlation: Vec<f64> = cross.iter().map(|c| c / own[0]).collect();
        println!(
            "phase {phase}: {difference:.1} nm (diffraction {:.1}, path {:.1}), correlation {correlation:.3?}",
            found.diffraction_bandwidth_nm, found.path_bandwidth_nm
        );
        assert!(difference < found.diffraction_bandwidth_nm.min(found.path_bandwidth_nm));
        // Half is reached within a factor of 1.5 of the stated bandwidth.
        assert!(
            correlation[0] > 0.5 && correlation[2] < 0.5,
            "{correlation:?}"
        );
        assert!((correlation[1] - 0.5).abs() < 0.15, "{correlation:?}");
    }
}

#[test]
fn contrast_falls_with_the_source_bandwidth() {
    let found = assessed(&camera(108, 108, None), &SpeckleOptics::demo());
    let kept = |nm| found.dispersion.contrast_kept(nm);
    assert!(kept(0.1) > 0.999);
    let mut last = 1.0;
    for nm in [5.0, 10.0, 20.0, 40.0, 80.0] {
        assert!(kept(nm) < last);
        last = kept(nm);
    }
    // A triangle of half width B: the contrast is √(2/3) and more where C is at a half.
    let at_half = kept(found.bandwidth_nm);
    assert!((0.8..0.95).contains(&at_half), "{at_half}");
}

fn small_map(seed: u64) -> sparsity::SuccessMap {
    let camera = camera(40, 40, None);
    let optics = SpeckleOptics {
        diffuser_fwhm_deg: 0.5,
        ..SpeckleOptics::demo()
    };
    let psf = speckle_psf(&optics, 79, 79, 1).unwrap();
    let params = SparsityParams {
        ks: vec![2, 4, 6, 9, 13, 20],
        snrs: vec![8.0, 128.0],
        max_iterations: 120,
        ..SparsityParams::for_camera(&camera, 2.6, seed)
    };
    let mut last = 0.0;
    success_map(&camera, &psf, &params, &mut |part| {
        assert!((last..=1.0).contains(&part), "{part} after {last}");
        last = part;
        ControlFlow::Continue(())
    })
    .unwrap()
}

#[test]
fn success_falls_with_k_and_rises_with_snr() {
    let map = small_map(1);
    println!("{:.2?} {:.1?}", map.rates, map.k50);
    assert_eq!(map, small_map(1));
    assert_ne!(map.rates, small_map(2).rates);
    for row in &map.rates {
        for pair in row.windows(2) {
            assert!(pair[1] <= pair[0] + 0.15, "{row:?}");
        }
        assert!(row[0] > 0.9 && row[row.len() - 1] < 0.1, "{row:?}");
    }
    for (noisy, clean) in map.rates[0].iter().zip(&map.rates[1]) {
        assert!(clean + 0.15 >= *noisy);
    }
    assert!(map.k50[1] > map.k50[0] && map.k50[0] > 2.0);
    let between = map.k50_at(32.0);
    assert!(between > map.k50[0] && between < map.k50[1]);
    assert_eq!((map.k50_at(1.0), map.k50_at(1e6)), (map.k50[0], map.k50[1]));
    let c = constant(map.measurements_per_bin, map.k50[1], map.field_pixels);
    assert!((0.8..4.0).contains(&c), "{c}");
    near(
        recoverable(80.0, c, 1600),
        map.k50[1],
        1e-6,
        "k back from C",
    );
}

#[test]
fn a_stopped_map_says_so() {
    let camera = camera(20, 20, None);
    let psf = speckle_psf(&SpeckleOptics::demo(), 39, 39, 1).unwrap();
    let params = SparsityParams::for_camera(&camera, 2.6, 1);
    let error = success_map(&camera, &psf, &params, &mut |_| ControlFlow::Break(())).unwrap_err();
    assert!(!error.is_input(), "{error}");
}

#[test]
fn cameras_with_few_pixels_or_one_bin_have_a_map() {
    let psf = speckle_psf(&SpeckleOptics::demo(), 31, 31, 1).unwrap();
    let mut global = camera(16, 16, None).params().clone();
    global.shutter = Shutter::Global;
    for params in [global, camera(4, 16, None).params().clone()] {
        let camera = Camera::new(params).unwrap();
        let mut params = SparsityParams::for_camera(&camera, 2.6, 1);
        params.snrs = vec![64.0];
        params.max_iterations = 60;
        let map = success_map(&camera, &psf, &params, &mut |_| ControlFlow::Continue(())).unwrap();
        println!("{:?} {:.2?}", params.ks, map.rates);
        assert_eq!(map.rates[0].len(), params.ks.len());
        assert!(map.is_lower_bound_at(64.0));
        assert!(
            params
                .ks
                .iter()
                .all(|k| 16 * k <= camera.video_shape().pixels())
        );
    }
}

#[test]
fn large_cameras_are_tried_on_small_ones_of_their_structure() {
    let mut params = camera(512, 300, Some((600, 300))).params().clone();
    let small = trial_camera(&Camera::new(params.clone()).unwrap()).unwrap();
    assert_eq!((small.rows(), small.columns()), (108, 108));
    assert_eq!(small.field(), (127, 108));
    assert_eq!(small.shutter(), &Shutter::DualInsideOut);
    params.exposure_us = 24.0;
    let coupled = trial_camera(&Camera::new(params.clone()).unwrap()).unwrap();
    assert_eq!((coupled.rows(), coupled.params().exposure_us), (48, 24.0));
    params.exposure_us = 9.6;
    params.shutter = Shutter::Custom((0..512).map(|r| (r * 7) % 512).collect());
    let custom = trial_camera(&Camera::new(params).unwrap()).unwrap();
    assert_eq!(custom.time().bins(), 108);
}

#[test]
fn light_that_cannot_be_is_refused() {
    let refused = |change: fn(&mut LightParams), word: &str| {
        let mut light = LightParams::default();
        change(&mut light);
        let optics = SpeckleOptics::demo();
        let error = assess(&camera(10, 10, None), &optics, &light, None).unwrap_err();
        assert!(error.to_string().contains(word), "{error}");
    };
    refused(|l| l.photons = 0.0, "photons");
    refused(|l| l.photons = f64::NAN, "photons");
    refused(|l| l.bright_pixels = 0, "bright_pixels");
    refused(|l| l.quantum_efficiency = 1.2, "quantum_efficiency");
    refused(|l| l.read_noise_electrons = -1.0, "read_noise");
    refused(|l| l.full_well_electrons = Some(0.0), "full_well");
    refused(|l| l.source_bandwidth_nm = 0.0, "source_bandwidth");
    refused(|l| l.source_bandwidth_nm = 600.0, "wavelength of 532");
    refused(|l| l.diffuser_path_rms_nm = Some(-3.0), "path_rms");
}
