//! Do the error bars of traces hold the truth as often as they say?
//!
//! One scene and one PSF, and new noise for each seed. On the support (bins in which the place is
//! lit) 95 % intervals are counted for the middle pixel of each spot, for its 3×3 pixels and for
//! the whole of what it belongs to.

use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Options, Prior, Problem};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::traces::{Refit, RefitInput, Region, brightest_regions, frequency_of};
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shape, Shutter, Video};
use std::ops::ControlFlow;

/// Time of a row, and the shortest exposure here.
const ROW_US: f64 = 9.6;

struct Case {
    camera: Camera,
    psf: Psf,
    truth: Video,
    noiseless: Image,
}

/// Intervals that were counted.
#[derive(Default, Clone, Copy)]
struct Count {
    bins: usize,
    covered: usize,
    squares: f64,
    errors: f64,
}

impl Count {
    fn add(&mut self, error: f64, standard_error: f64) {
        self.bins += 1;
        self.covered += usize::from(error.abs() <= 1.96 * standard_error);
        self.squares += error * error;
        self.errors += standard_error * standard_error;
    }

    fn percent(&self) -> f64 {
        100.0 * self.covered as f64 / self.bins as f64
    }
}

impl Case {
    fn new(rows: usize, columns: usize, exposure_us: f64, truth: impl Fn(Shape) -> Video) -> Self {
        let camera = Camera::new(CameraParams {
            rows,
            columns,
            shutter: Shutter::DualInsideOut,
            row_time_us: ROW_US,
            exposure_us,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let optics = SpeckleOptics {
            diffuser_fwhm_deg: rows as f64 / 108.0,
            ..SpeckleOptics::demo()
        };
        let psf = speckle_psf(&optics, 2 * rows - 1, 2 * columns - 1, 1).unwrap();
        let truth = truth(camera.video_shape());
        let operator = RollingShutter::new(&camera, &psf);
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(truth.data(), &mut frame);
        frame.iter_mut().for_each(|b| *b = b.max(0.0));
        Self {
            noiseless: Image::new(rows, columns, frame).unwrap(),
            camera,
            psf,
            truth,
        }
    }

    fn leds(side: usize, exposure_us: f64) -> Self {
        Self::new(side, side, exposure_us, |shape| {
            scene::leds(shape, 9.6, 6.5, 1).unwrap().0
        })
    }

    fn digits(side: usize, height_px: usize, exposure_us: f64) -> Self {
        Self::new(side, side, exposure_us, |shape| {
            scene::digits(shape, height_px, 1).unwrap()
        })
    }

    fn moving(side: usize, height_px: usize, exposure_us: f64) -> Self {
        Self::new(side, side, exposure_us, |shape| {
            scene::moving_digit(shape, height_px, 1, 1).unwrap()
        })
    }

    /// Frame, σ of the reconstruction and video of a noise seed.
    fn reconstructed(&self, seed: u64) -> (Measurement, f64, Video) {
        let noise = Noise::Gaussian { snr: 256.0 };
        let recorded = noise
            .apply(&self.noiseless, self.camera.sensor(), seed)
            .unwrap();
        let measurement = Measurement::new(recorded.frame).unwrap();
        let options = Options {
            prior: Some(Prior::STANDARD),
            // Frames of the model: its check would doubt one in many of such small ones.
            is_preview: true,
            ..Options::default()
        };
        let problem = Problem::new(&measurement, &self.camera, &self.psf, options);
        let found = problem
            .unwrap()
            .solve(&mut |_| ControlFlow::Continue(()))
            .unwrap();
        (measurement, found.sigma, found.video)
    }

    /// Counts over `seeds`, by name, with PSNR before and after debiasing.
    fn count(&self, seeds: u64) -> (Vec<(&'static str, Count)>, f64, f64) {
        let operator = RollingShutter::new(&self.camera, &self.psf);
        let shape = self.truth.shape();
        let mut counts = [
            ("pixel", Count::default()),
            ("3×3", Count::default()),
            ("whole", Count::default()),
        ];
        let (mut before, mut after) = (0.0, 0.0);
        for seed in 1..=seeds {
            let (measurement, sigma, video) = self.reconstructed(seed);
            let refit = Refit::new(RefitInput {
                operator: &operator,
                measured: measurement.image().data(),
                weights: None,
                sigma,
                video: &video,
            })
            .unwrap();
            before += psnr_db(video.data(), self.truth.data()) / seeds as f64;
            after += psnr_db(refit.video().video.data(), self.truth.data()) / seeds as f64;
            let mut places = Vec::new();
            for t in 0..shape.bins {
                // A user looks at the spots of the bin: the brightest there.
                let single = Shape::new(1, shape.rows, shape.columns);
                let bin = Video::new(single, video.bin(t).to_vec()).unwrap();
                for spot in brightest_regions(&bin, 3) {
                    let (y, x) = (spot.y + spot.rows / 2, spot.x + spot.columns / 2);
                    places.extend([
                        (t, Region::centred_at(y, x, 1, shape)),
                        (t, spot),
                        (t, whole(&self.truth, t, y, x)),
                    ]);
                }
            }
            for (k, found) in refit.means(&places).into_iter().enumerate() {
                let (t, region) = places[k];
                let truth = region.mean_of(&self.truth)[t];
                let (value, error) = found.expect("few enough voxels are lit");
                counts[k % 3].1.add(value - truth, error);
            }
        }
        (counts.to_vec(), before, after)
    }
}

/// The box of the light of bin `t` within 8 pixels of `(y, x)`, with a margin of a pixel.
fn whole(truth: &Video, t: usize, y: usize, x: usize) -> Region {
    let shape = truth.shape();
    let near = Region::centred_at(y, x, 17, shape);
    let bin = truth.bin(t);
    let active: Vec<(usize, usize)> = near
        .indices(shape.columns)
        .filter(|&i| bin[i] > 0.01)
        .map(|i| (i / shape.columns, i % shape.columns))
        .collect();
    let range = |of: fn(&(usize, usize)) -> usize, at: usize| {
        let first = active.iter().map(of).min().unwrap_or(at);
        (first, active.iter().map(of).max().unwrap_or(at) + 1 - first)
    };
    let ((y, rows), (x, columns)) = (range(|p| p.0, y), range(|p| p.1, x));
    Region {
        y,
        x,
        rows,
        columns,
    }
    .dilated(1, shape)
}

fn print(scene: &str, counts: &[(&str, Count)], before: f64, after: f64) -> f64 {
    println!("{scene}: {before:.2} dB, debiased {after:.2} dB");
    let (mut covered, mut bins) = (0, 0);
    for (name, count) in counts {
        let n = count.bins as f64;
        println!(
            "  {name:6} {:6} intervals, {:.1} % hold the truth; rms error {:.4}, standard error {:.4}",
            count.bins,
            count.percent(),
            (count.squares / n).sqrt(),
            (count.errors / n).sqrt()
        );
        covered += count.covered;
        bins += count.bins;
    }
    let percent = 100.0 * covered as f64 / bins as f64;
    println!("  all    {percent:.1} %");
    percent
}

/// Small scenes, few seeds: a coarse check of what the long test measures.
#[test]
fn intervals_hold_the_truth_on_small_scenes() {
    // LEDs: measured 89.4 %, single pixels 71 %, since the video itself, at 45 dB, is far from the
    // truth there. Digits seen by 80 pixels a bin are too few data, and the intervals too narrow.
    // The bounds only tell of worse.
    let cases = [
        ("leds", Case::leds(40, ROW_US), 80.0..99.5),
        ("digits", Case::digits(40, 8, ROW_US), 60.0..99.5),
    ];
    for (scene, case, range) in cases {
        let (counts, before, after) = case.count(4);
        let percent = print(scene, &counts, before, after);
        assert!(range.contains(&percent), "{scene}: {percent} %");
    }
}

/// The table of the documentation: `cargo test --release --workspace --test traces -- --ignored --nocapture`.
#[test]
#[ignore = "200 reconstructions of full size of each scene, an hour"]
fn intervals_hold_the_truth_over_200_seeds() {
    let seeds = std::env::var("SEEDS").map_or(200, |s| s.parse().expect("a number of seeds"));
    let mut failed = false;
    let cases = [
        ("leds", Case::leds(108, ROW_US)),
        ("digits", Case::digits(108, 12, ROW_US)),
        ("leds, 2.5 rows", Case::leds(108, 2.5 * ROW_US)),
        ("digits, 2.5 rows", Case::digits(108, 12, 2.5 * ROW_US)),
        ("digits, 6 rows", Case::digits(108, 12, 6.0 * ROW_US)),
        ("moving digit, 6 rows", Case::moving(108, 12, 6.0 * ROW_US)),
    ];
    for (scene, case) in cases {
        let (counts, before, after) = case.count(seeds);
        let percent = print(scene, &counts, before, after);
        failed |= !(92.0..=98.0).contains(&percent);
    }
    assert!(!failed, "a coverage is not between 92 and 98 %");
}

/// LEDs: what the refit is for. Amplitudes and frequencies against the truth's own traces.
#[test]
fn leds_have_their_amplitudes_and_frequencies() {
    let case = Case::leds(48, ROW_US);
    let (measurement, sigma, video) = case.reconstructed(1);
    let operator = RollingShutter::new(&case.camera, &case.psf);
    let input = RefitInput {
        operator: &operator,
        measured: measurement.image().data(),
        weights: None,
        sigma,
        video: &video,
    };
    let refit = Refit::new(input).unwrap();
    let spots = brightest_regions(&video, 3);
    let rate = case.camera.time().frame_rate_hz();
    let mut found = 0;
    for trace in refit.traces(&spots) {
        let truth = trace.region.mean_of(&case.truth);
        let exact = frequency_of(&truth, &vec![1e-4; truth.len()], rate);
        let (Some(f), Some(exact)) = (
            frequency_of(&trace.debiased, &trace.standard_error, rate),
            exact,
        ) else {
            continue;
        };
        found += 1;
        println!("{f:?}\n  truth {exact:?}");
        assert!((f.amplitude / exact.amplitude - 1.0).abs() < 0.03, "{f:?}");
        assert!(
            (f.hertz - exact.hertz).abs() < 4.0 * f.error_hz.max(5.0),
            "{f:?}"
        );
    }
    assert!(found >= 2, "{found} frequencies");
    // The refit is as near to the truth as the video, which knows that most voxels are dark.
    let debiased = refit.video();
    let (before, after) = (
        psnr_db(video.data(), case.truth.data()),
        psnr_db(debiased.video.data(), case.truth.data()),
    );
    println!("{before:.2} dB, debiased {after:.2} dB");
    assert!(after > before - 0.5 && debiased.video.data().iter().all(|v| *v >= 0.0));
}

/// Nothing depends on the units of the frame.
#[test]
fn errors_have_the_units_of_the_video() {
    let case = Case::digits(32, 6, ROW_US);
    let (measurement, sigma, video) = case.reconstructed(1);
    let operator = RollingShutter::new(&case.camera, &case.psf);
    let errors = |by: f32| {
        let times = |values: &[f32]| values.iter().map(|v| by * v).collect::<Vec<f32>>();
        let frame = times(measurement.image().data());
        let video = Video::new(video.shape(), times(video.data())).unwrap();
        let input = RefitInput {
            operator: &operator,
            measured: &frame,
            weights: None,
            sigma: f64::from(by) * sigma,
            video: &video,
        };
        let refit = Refit::new(input).unwrap();
        refit.traces(&brightest_regions(&video, 2))
    };
    let (small, large) = (errors(1.0), errors(4096.0));
    for (a, b) in small.iter().zip(&large) {
        for t in 0..a.value.len() {
            for (a, b) in [
                (a.debiased[t], b.debiased[t]),
                (a.standard_error[t], b.standard_error[t]),
            ] {
                assert!(
                    (4096.0 * a - b).abs() < 1e-3 * b.abs().max(1.0),
                    "{t}: {a} {b}"
                );
            }
        }
    }
}

/// Pixels that hold no information are as if they were not there.
#[test]
fn pixels_of_weight_zero_have_no_say() {
    let case = Case::digits(32, 6, ROW_US);
    let (measurement, sigma, video) = case.reconstructed(1);
    let operator = RollingShutter::new(&case.camera, &case.psf);
    let weights: Vec<f32> = (0..32 * 32)
        .map(|i| if i % 17 == 0 { 0.0 } else { 1.0 })
        .collect();
    let traces = |spoilt: f32| {
        let frame = measurement.image().data().iter().enumerate();
        let frame: Vec<f32> = frame
            .map(|(i, b)| if i % 17 == 0 { spoilt } else { *b })
            .collect();
        let input = RefitInput {
            operator: &operator,
            measured: &frame,
            weights: Some(&weights),
            sigma,
            video: &video,
        };
        Refit::new(input)
            .unwrap()
            .traces(&brightest_regions(&video, 2))
    };
    assert_eq!(traces(0.0), traces(7.0));
}

/// Rows that share bins, which are estimated together.
#[test]
fn intervals_hold_the_truth_on_small_scenes_at_long_exposures() {
    // The bounds only tell of worse, as above.
    let cases = [
        ("leds, 2.5 rows", Case::leds(40, 2.5 * ROW_US), 75.0..99.5),
        (
            "digits, 3 rows",
            Case::digits(40, 8, 3.0 * ROW_US),
            60.0..99.5,
        ),
    ];
    for (scene, case, range) in cases {
        let (counts, before, after) = case.count(2);
        let percent = print(scene, &counts, before, after);
        assert!(range.contains(&percent), "{scene}: {percent} %");
    }
}
