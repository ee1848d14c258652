//! A simulated sensor with known answers.

use super::*;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Poisson, StandardNormal};
use rand_pcg::Pcg64;

/// A sensor and its faults.
#[derive(Clone)]
struct Simulated {
    rows: usize,
    columns: usize,
    gain: f64,
    read: f64,
    bias: f64,
    end: f64,
    /// Standard deviation of each row's own offset in a frame, counts.
    banding: f64,
    offset: Vec<f64>,
    response: Vec<f64>,
    hot: Vec<usize>,
    dead: Vec<usize>,
    unstable: Vec<usize>,
    rng: Pcg64,
}

impl Simulated {
    fn new(rows: usize, columns: usize, seed: u64) -> Self {
        let mut rng = Pcg64::seed_from_u64(seed);
        let pixels = rows * columns;
        let mut normal = |sigma: f64| -> Vec<f64> {
            let draw = |_| sigma * rng.sample::<f64, _>(StandardNormal);
            (0..pixels).map(draw).collect()
        };
        let offset = normal(3.0);
        let response = normal(0.01).iter().map(|r| 1.0 + r).collect();
        Self {
            rows,
            columns,
            gain: 0.45,
            read: 2.5,
            bias: 100.0,
            end: 65535.0,
            banding: 0.0,
            offset,
            response,
            hot: Vec::new(),
            dead: Vec::new(),
            unstable: Vec::new(),
            rng,
        }
    }

    /// Plants faults in every 80th pixel or so, no two in one place.
    fn with_faults(mut self) -> Self {
        let pixels = self.rows * self.columns;
        self.hot = (7..pixels).step_by(331).collect();
        self.dead = (50..pixels).step_by(293).collect();
        self.dead.retain(|i| !self.hot.contains(i));
        self.unstable = (100..pixels).step_by(499).collect();
        self.unstable
            .retain(|i| !self.hot.contains(i) && !self.dead.contains(i));
        self
    }

    /// A frame of `electrons` of mean light, in whole counts.
    fn frame(&mut self, electrons: f64) -> Image {
        let shot = |mean: f64| (mean > 0.0).then(|| Poisson::new(mean).unwrap());
        let mut image = Image::zeros(self.rows, self.columns);
        for y in 0..self.rows {
            let row = self.banding * self.rng.sample::<f64, _>(StandardNormal);
            for x in 0..self.columns {
                let i = y * self.columns + x;
                let mut mean = electrons * self.response[i];
                if self.dead.contains(&i) {
                    mean = 0.0;
                }
                let mut read = self.read;
                if self.unstable.contains(&i) {
                    read = 40.0 * self.read;
                }
                let draw: f64 = self.rng.sample(StandardNormal);
                let seen = shot(mean).map_or(0.0, |s| s.sample(&mut self.rng));
                let mut count = self.bias + self.offset[i] + row + (seen + read * draw) / self.gain;
                if self.hot.contains(&i) {
                    count += 120.0;
                }
                image.data_mut()[i] = count.round().clamp(0.0, self.end) as f32;
            }
        }
        image
    }

    fn stack(&mut self, kind: Parameter, electrons: &[f64]) -> Stack {
        let frames = electrons.iter().enumerate();
        let frames = frames.map(|(i, &e)| (format!("{kind}{i}.tif"), self.frame(e)));
        Stack::new(kind, frames.collect()).unwrap()
    }

    fn darks(&mut self, count: usize) -> Stack {
        self.stack(Parameter::Darks, &vec![0.0; count])
    }

    /// `count` flats at each of `levels`.
    fn flats(&mut self, levels: &[f64], count: usize) -> Stack {
        let all: Vec<f64> = levels.iter().flat_map(|&e| vec![e; count]).collect();
        self.stack(Parameter::Flats, &all)
    }
}

fn near(found: f64, expected: f64, part: f64, what: &str) {
    let off = found / expected - 1.0;
    println!("{what}: {found:.4} ({expected:.4}, {:+.2} %)", 100.0 * off);
    assert!(off.abs() < part, "{what}: {found} instead of {expected}");
}

/// The known answers of issue 3: gain to 2 % and read noise to 5 % from 50 pairs.
#[test]
fn fifty_pairs_of_one_level_give_gain_and_read_noise() {
    for (seed, gain, read) in [(1, 0.45, 2.5), (2, 2.0, 1.5), (3, 6.0, 20.0)] {
        let mut sensor = Simulated::new(60, 80, seed).with_faults();
        (sensor.gain, sensor.read) = (gain, read);
        let (darks, flats) = (sensor.darks(50), sensor.flats(&[4000.0], 100));
        let found = calibrate(&darks, &flats).unwrap();
        near(found.gain_electrons_per_count, gain, 0.02, "gain");
        near(found.read_noise_electrons, read, 0.05, "read noise");
        near(found.bias_counts, 100.0, 0.005, "bias");
        assert!(found.gain_error < 0.02);
        assert_eq!(found.full_well, None);
        assert!(found.warnings.is_empty(), "{:?}", found.warnings);
        assert!((0.008..0.012).contains(&found.non_uniformity));
    }
}

#[test]
fn a_series_of_levels_ends_at_saturation() {
    let mut sensor = Simulated::new(60, 80, 4).with_faults();
    sensor.end = 4095.0;
    let levels = [100.0, 300.0, 600.0, 1000.0, 1400.0, 1600.0, 2500.0];
    let (darks, flats) = (sensor.darks(20), sensor.flats(&levels, 4));
    let found = calibrate(&darks, &flats).unwrap();
    near(found.gain_electrons_per_count, 0.45, 0.02, "gain");
    near(found.read_noise_electrons, 2.5, 0.05, "read noise");
    let full = found.full_well.unwrap();
    assert_eq!((full.counts, full.sign), (4095.0, FullSign::Clipped));
    // Up to 70 % of the range; the saturated level gives nothing.
    assert!(
        found
            .transfer
            .iter()
            .all(|p| p.used == (p.light < 0.7 * 3995.0))
    );
    assert_eq!(found.levels.len(), levels.len());
}

/// Fifty pairs, each of a light of its own in steps finer than levels are told apart by.
#[test]
fn a_fine_series_of_pairs_gives_the_gain() {
    let mut sensor = Simulated::new(60, 80, 23).with_faults();
    sensor.end = 4095.0;
    let lights: Vec<f64> = (1..=50).map(|i| 36.0 * f64::from(i)).collect();
    let (darks, flats) = (sensor.darks(50), sensor.flats(&lights, 2));
    let found = calibrate(&darks, &flats).unwrap();
    near(found.gain_electrons_per_count, 0.45, 0.02, "gain");
    near(found.read_noise_electrons, 2.5, 0.05, "read noise");
    assert!(found.warnings.is_empty(), "{:?}", found.warnings);
    assert_eq!(
        found.faults.unstable.iter().filter(|u| **u).count(),
        sensor.unstable.len()
    );
}

/// A pixel that is full before the converter ends: no pile-up, but less and less noise.
#[test]
fn a_variance_that_falls_is_a_full_well() {
    let mut sensor = Simulated::new(40, 50, 5);
    let darks = sensor.darks(20);
    let mut frames = Vec::new();
    for (level, smooth) in [(500.0, 1.0), (1000.0, 1.0), (1500.0, 1.0), (1800.0, 0.2)] {
        for i in 0..4 {
            let mut image = sensor.frame(level);
            let mean = 100.0 + level / 0.45;
            let data = image.data_mut().iter_mut();
            data.for_each(|p| *p = (mean + smooth * (f64::from(*p) - mean)).round() as f32);
            frames.push((format!("{level}-{i}"), image));
        }
    }
    let found = calibrate(&darks, &Stack::new(Parameter::Flats, frames).unwrap()).unwrap();
    let full = found.full_well.unwrap();
    assert_eq!(full.sign, FullSign::Turnover);
    near(full.counts, 100.0 + 1500.0 / 0.45, 0.01, "full well");
    near(found.gain_electrons_per_count, 0.45, 0.04, "gain");
}

/// At least 99 % of the planted pixels found, at most 0.1 % of the others.
#[test]
fn planted_pixels_are_found_and_hardly_any_other() {
    for (darks, flats, seed) in [(50, 20, 6), (10, 4, 7), (3, 2, 8), (2, 2, 9)] {
        let mut sensor = Simulated::new(120, 160, seed).with_faults();
        let stacks = (sensor.darks(darks), sensor.flats(&[3000.0], flats));
        let found = calibrate(&stacks.0, &stacks.1).unwrap().faults;
        let part = |planted: &[usize], of: &[bool]| {
            planted.iter().filter(|&&i| of[i]).count() as f64 / planted.len() as f64
        };
        assert!(part(&sensor.hot, &found.hot) >= 0.99, "hot of {darks}");
        assert!(part(&sensor.dead, &found.dead) >= 0.99, "dead of {flats}");
        if darks >= 10 {
            assert!(part(&sensor.unstable, &found.unstable) >= 0.99);
        }
        let planted: Vec<usize> = [&sensor.hot[..], &sensor.dead, &sensor.unstable].concat();
        let pixels = 120 * 160;
        let others = (0..pixels).filter(|i| !planted.contains(i));
        let alarms = others.filter(|&i| found.is_bad(i)).count();
        println!("{darks} darks, {flats} flats: {alarms} false alarms in {pixels}");
        assert!(
            alarms as f64 <= 1e-3 * pixels as f64,
            "{alarms} false alarms"
        );
    }
}

/// Faint light, column offsets and a vignette are no faults of single pixels.
#[test]
fn what_good_sensors_do_is_no_fault() {
    let mut sensor = Simulated::new(120, 160, 10);
    for i in 0..sensor.offset.len() {
        let (y, x) = ((i / 160) as f64, (i % 160) as f64);
        sensor.offset[i] += 30.0 * (x * 1.7).sin() + 0.2 * y;
        sensor.response[i] *=
            1.0 - 0.5 * ((y / 60.0 - 1.0).powi(2) + (x / 80.0 - 1.0).powi(2)) / 2.0;
    }
    for light in [12.0, 2000.0] {
        let stacks = (sensor.darks(4), sensor.flats(&[light], 4));
        let found = calibrate(&stacks.0, &stacks.1).unwrap();
        let alarms = found.faults.count();
        assert!(alarms <= 19, "{alarms} at {light} electrons");
        assert!(found.warnings.iter().any(|w| w.contains("varies by")));
    }
}

#[test]
fn banding_is_found_where_it_is_and_only_there() {
    let of = |banding: f64, seed: u64| {
        let mut sensor = Simulated::new(60, 80, seed).with_faults();
        sensor.banding = banding;
        let stacks = (sensor.darks(12), sensor.flats(&[3000.0], 4));
        calibrate(&stacks.0, &stacks.1).unwrap()
    };
    let warned = |c: &SensorCalibration| c.warnings.iter().any(|w| w.contains("banding"));
    for seed in 11..16 {
        let found = of(0.0, seed);
        assert!(!found.banding.is_real && !warned(&found), "seed {seed}");
        assert!(found.banding.row_counts < 0.2);
    }
    for (banding, seed) in [(1.0, 16), (3.0, 17)] {
        let found = of(banding, seed);
        near(found.banding.row_counts, banding, 0.1, "banding");
        assert!(found.banding.is_real && warned(&found));
        // The gain does not take row noise for shot noise.
        near(found.gain_electrons_per_count, 0.45, 0.05, "gain");
    }
}

/// A lamp that flickers between frames, and along the rows within one.
#[test]
fn flicker_leaves_the_gain() {
    let mut sensor = Simulated::new(60, 80, 18);
    let darks = sensor.darks(20);
    let mut frames = Vec::new();
    for i in 0..40 {
        let mut image = sensor.frame(3000.0 * (1.0 + 0.02 * f64::from(i % 3)));
        for y in 0..60 {
            let along = 1.0 + 0.02 * (0.4 * y as f64 + f64::from(i)).sin();
            for p in &mut image.data_mut()[80 * y..80 * (y + 1)] {
                *p = (100.0 + (f64::from(*p) - 100.0) * along).round() as f32;
            }
        }
        frames.push((format!("flat{i}"), image));
    }
    let found = calibrate(&darks, &Stack::new(Parameter::Flats, frames).unwrap()).unwrap();
    near(found.gain_electrons_per_count, 0.45, 0.03, "gain");
    assert!(found.warnings.iter().any(|w| w.contains("differ in light")));
    assert_eq!(found.faults.count(), 0);
}

/// A bias that drifts from frame to frame is no noise of the pixels.
#[test]
fn drift_leaves_the_read_noise() {
    let mut sensor = Simulated::new(60, 80, 22);
    let (darks, flats) = (sensor.darks(20), sensor.flats(&[3000.0], 10));
    let drifted = |i: usize| {
        let mut image = darks.image(i).clone();
        image.data_mut().iter_mut().for_each(|p| *p += i as f32);
        (format!("dark{i}"), image)
    };
    let drifted = Stack::new(Parameter::Darks, (0..20).map(drifted).collect()).unwrap();
    let found = calibrate(&drifted, &flats).unwrap();
    near(found.read_noise_electrons, 2.5, 0.05, "read noise");
    assert!(found.warnings.iter().any(|w| w.contains("drifts by 9.5")));
}

#[test]
fn the_flat_is_a_frame_with_its_dark() {
    let mut sensor = Simulated::new(40, 50, 19).with_faults();
    let stacks = (sensor.darks(30), sensor.flats(&[3000.0], 60));
    let found = calibrate(&stacks.0, &stacks.1).unwrap();
    let good: Vec<usize> = (0..2000).filter(|&i| !found.faults.is_bad(i)).collect();
    let mean = stats::mean(good.iter().map(|&i| f64::from(found.response.data()[i])));
    assert!((mean - 1.0).abs() < 1e-6);
    for &i in &good {
        let response = f64::from(found.response.data()[i]);
        assert!((response - sensor.response[i]).abs() < 0.03);
        let light = f64::from(found.flat.data()[i] - found.dark.data()[i]);
        assert!((light / (response * 3000.0 / 0.45) - 1.0).abs() < 0.01);
    }
}

/// Counts that float files give, in units of their own.
#[test]
fn units_do_not_matter() {
    let mut sensor = Simulated::new(60, 80, 20).with_faults();
    let (darks, flats) = (sensor.darks(20), sensor.flats(&[500.0, 3000.0], 10));
    let scaled = |kind, stack: &Stack| {
        let frame = |i: usize| {
            let mut image = stack.image(i).clone();
            image.data_mut().iter_mut().for_each(|p| *p /= 65536.0);
            (stack.name(i).to_string(), image)
        };
        Stack::new(kind, (0..stack.len()).map(frame).collect()).unwrap()
    };
    let counts = calibrate(&darks, &flats).unwrap();
    let units = calibrate(
        &scaled(Parameter::Darks, &darks),
        &scaled(Parameter::Flats, &flats),
    )
    .unwrap();
    let gain = units.gain_electrons_per_count / 65536.0;
    near(gain, counts.gain_electrons_per_count, 1e-3, "gain");
    assert_eq!(units.faults.count(), counts.faults.count());
    assert_eq!(units.full_well, None);
}

#[test]
fn bad_stacks_are_refused() {
    let mut sensor = Simulated::new(20, 30, 21);
    let (darks, flats) = (sensor.darks(4), sensor.flats(&[3000.0], 4));
    let changed = |stack: &Stack, change: &dyn Fn(usize, &mut f32)| {
        let frame = |i: usize| {
            let mut image = stack.image(i).clone();
            image.data_mut().iter_mut().for_each(|p| change(i, p));
            (format!("frame{i}"), image)
        };
        Stack::new(Parameter::Flats, (0..stack.len()).map(frame).collect()).unwrap()
    };
    let says = |result: Result<SensorCalibration>, words: &str| {
        let message = result.unwrap_err().to_string();
        println!("{message}");
        assert!(message.contains(words), "{message}");
    };
    says(calibrate(&flats, &darks), "the darks are brighter");
    says(calibrate(&darks, &sensor.darks(4)), "exceeds the noise");
    let full = changed(&flats, &|_, p| *p = 4095.0);
    says(calibrate(&darks, &full), "saturated");
    // A dead pixel does not make them copies of one frame.
    let with_dead = changed(&flats, &|i, p| *p = if i == 7 { 0.0 } else { 4095.0 });
    says(calibrate(&darks, &with_dead), "saturated");
    // Each flat brighter than the one before.
    let ramp = changed(&flats, &|i, p| *p *= 1.0 + i as f32);
    says(calibrate(&darks, &ramp), "two flats of equal light");
    // One flat with a little of a second: as good as no noise.
    let copied = changed(&flats, &|i, p| {
        *p = if i % 2 == 0 { 3000.0 } else { 3000.01 }
    });
    says(calibrate(&darks, &copied), "the variance must grow");
    let small = Simulated::new(20, 28, 1).flats(&[3000.0], 2);
    says(calibrate(&darks, &small), "20×28");

    let image = darks.image(0);
    let mut nan = image.clone();
    nan.data_mut()[33] = f32::NAN;
    let other = darks.image(1);
    for (second, words) in [
        (None, "at least two"),
        (Some(nan), "row 1, column 3"),
        (Some(image.clone()), "the same frame as a"),
        (Some(Image::zeros(3, 4)), "3×4 pixels"),
    ] {
        let frames = [("a", Some(image.clone())), ("b", second)];
        let frames = frames
            .into_iter()
            .filter_map(|(n, i)| Some((n.to_string(), i?)));
        let error = Stack::new(Parameter::Darks, frames.collect()).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
    }
    assert_ne!(image, other);
}
