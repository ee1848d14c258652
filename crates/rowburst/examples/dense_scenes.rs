//! Dense scenes without a guide, and with honest and false ones: the numbers of `docs/dense-scenes.md`, one line for each
//! case.

use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rowburst::camera::CameraParams;
use rowburst::guide::{Guide, GuideExposure, GuideModel, fit};
use rowburst::metrics::psnr_db;
use rowburst::noise::{Noise, SimulatedFrame};
use rowburst::reconstruct::{Options, Problem, Reconstruction};
use rowburst::simulate::scene::{DenseScene, dense, digits};
use rowburst::simulate::{SpeckleOptics, speckle_psf};
use rowburst::{
    Camera, Cancel, Image, LinearOperator, Measurement, Psf, RollingShutter, Sensor, Shape,
    Shutter, Video,
};
use std::ops::ControlFlow;
use std::time::Instant;

const N: usize = 108;
/// Pixels around the field that the guide's camera sees, so that a shifted guide has no edge.
const MARGIN: usize = 12;
/// Shifts at which the object of `bench` is looked for.
const PATH_REACH_PX: f64 = 6.0;
const PATH_STEP_PX: f64 = 0.25;
/// What differs from the still part by more than this part of the greatest light is the object.
const PATH_CONTRAST: f32 = 0.1;

fn main() {
    let mut args = std::env::args().skip(1);
    let scenes = args
        .next()
        .unwrap_or_else(|| "bench,beam,wheel,cells".into());
    let rows: Vec<usize> = numbers(&args.next().unwrap_or_else(|| "1".into()));
    let seeds: Vec<usize> = numbers(&args.next().unwrap_or_else(|| "11".into()));
    let kinds = args.next().unwrap_or_else(|| "honest".into());
    let kinds: Vec<&str> = kinds.split(',').collect();
    println!(
        "scene\trows\tseed\tguide\tused\tmodel\torder\tpsnr_db\tmean_db\theld_out\twithout\tcorrelation\tshift_y\tshift_x\tturn_deg\tmagnification\tpath_px\tseconds\tof_sparse\ttrials"
    );
    for name in scenes.split(',') {
        let scene = DenseScene::ALL.into_iter().find(|s| s.name() == name);
        let scene = scene.expect("a dense scene");
        for &exposure in &rows {
            for &seed in &seeds {
                let case = Case::new(scene, exposure, seed as u64);
                let needs_sparse = kinds.contains(&"none");
                let sparse = needs_sparse.then(|| case.sparse_seconds());
                case.print(&kinds, sparse);
            }
        }
    }
}

fn numbers(text: &str) -> Vec<usize> {
    text.split(',')
        .map(|n| n.parse().expect("a number"))
        .collect()
}

/// A scene with its frame.
struct Case {
    scene: DenseScene,
    exposure: usize,
    seed: u64,
    camera: Camera,
    psf: Psf,
    operator: RollingShutter,
    /// The scene with a margin.
    wide: Video,
    truth: Video,
    measurement: Measurement,
    sigma: f64,
}

fn crop(video: &Video) -> Video {
    let shape = video.shape();
    let mut data = Vec::new();
    for t in 0..shape.bins {
        for y in MARGIN..shape.rows - MARGIN {
            let start = y * shape.columns + MARGIN;
            data.extend_from_slice(&video.bin(t)[start..start + shape.columns - 2 * MARGIN]);
        }
    }
    let side = shape.rows - 2 * MARGIN;
    Video::new(Shape::new(shape.bins, side, side), data).unwrap()
}

impl Case {
    fn new(scene: DenseScene, exposure: usize, seed: u64) -> Self {
        let camera = Camera::new(CameraParams {
            rows: N,
            columns: N,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0 * exposure as f64,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let bins = camera.video_shape().bins;
        let side = N + 2 * MARGIN;
        let wide = dense(scene, Shape::new(bins, side, side), seed).unwrap();
        let truth = crop(&wide);
        let psf = speckle_psf(&SpeckleOptics::demo(), 2 * N - 1, 2 * N - 1, 70 + seed).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let recorded = record(&camera, &operator, &truth, seed);
        let truth_data = truth
            .data()
            .iter()
            .map(|v| (f64::from(*v) * recorded.scale) as f32);
        Self {
            truth: Video::new(truth.shape(), truth_data.collect()).unwrap(),
            measurement: Measurement::new(recorded.frame).unwrap(),
            sigma: recorded.sigma,
            scene,
            exposure,
            seed,
            camera,
            psf,
            operator,
            wide,
        }
    }

    /// The video by the program's own choice, and how long it took.
    fn reconstructed(&self, measurement: &Measurement) -> (Reconstruction, f64) {
        let start = Instant::now();
        let problem = Problem::new(measurement, &self.camera, &self.psf, Options::default());
        let found = problem.unwrap().solve(&mut |_| ControlFlow::Continue(()));
        (found.unwrap(), start.elapsed().as_secs_f64())
    }

    /// Seconds for a sparse scene of the same camera: a digit of 12 px in each bin.
    fn sparse_seconds(&self) -> f64 {
        let scene = digits(self.truth.shape(), 12, self.seed).unwrap();
        let recorded = record(&self.camera, &self.operator, &scene, self.seed);
        self.reconstructed(&Measurement::new(recorded.frame).unwrap())
            .1
    }

    /// The picture of the second camera: the bin `t` of the scene, shifted by 5 px, turned by `degrees` and magnified.
    fn picture(&self, video: &Video, t: usize, degrees: f64, magnification: f64) -> Image {
        let side = video.shape().columns;
        let image = Image::new(side, side, video.bin(t).to_vec()).unwrap();
        let (s, c) = degrees.to_radians().sin_cos();
        let half = 0.5 * (N as f64 - 1.0);
        let angle = self.seed as f64;
        let (shift_y, shift_x) = (5.0 * angle.sin(), 5.0 * angle.cos());
        let mut rng = rand_pcg::Pcg64::seed_from_u64(self.seed ^ 0x6775);
        let noise: Vec<f64> = (0..N * N)
            .map(|_| StandardNormal.sample(&mut rng))
            .collect();
        Image::from_fn(N, N, |row, column| {
            let (y, x) = (row as f64 - half, column as f64 - half);
            let from_y = (c * y - s * x) / magnification + shift_y + 0.5 * (side as f64 - 1.0);
            let from_x = (s * y + c * x) / magnification + shift_x + 0.5 * (side as f64 - 1.0);
            let noise = noise[row * N + column];
            (0.8 * sample(&image, from_y, from_x) + 0.01 * noise) as f32
        })
    }

    fn guide(&self, kind: &str) -> Vec<Guide> {
        let bins = self.truth.shape().bins;
        let other = |scene| {
            let side = N + 2 * MARGIN;
            dense(scene, Shape::new(bins, side, side), self.seed + 500).unwrap()
        };
        let honest = |t| self.picture(&self.wide, t, 2.0, 1.02);
        let middle = bins / 2;
        let rearranged = |f: &dyn Fn(usize, usize) -> (usize, usize)| {
            let image = self.picture(&self.wide, middle, 0.0, 1.0);
            Image::from_fn(N, N, |y, x| {
                let (y, x) = f(y, x);
                image.at(y, x)
            })
        };
        let with_noise = |image: Image, level: f64| {
            let mut rng = rand_pcg::Pcg64::seed_from_u64(self.seed + 9);
            let mut image = image;
            for p in image.data_mut() {
                let n: f64 = StandardNormal.sample(&mut rng);
                *p += (level * n) as f32;
            }
            image
        };
        let row = 10.0;
        let timed = |image: Image, t: usize| Guide {
            image,
            exposure: Some(GuideExposure {
                time_us: (t as f64 + 0.5) * row,
                exposure_us: row,
            }),
        };
        let image = match kind {
            "honest" => honest(middle),
            "timed" => return vec![timed(honest(middle), middle)],
            "keys" => {
                let times = [0, middle, bins - 1];
                return times.iter().map(|&t| timed(honest(t), t)).collect();
            }
            "blurred" => honest(middle).blurred(1.5),
            "dim" => {
                let mut image = honest(middle);
                image
                    .data_mut()
                    .iter_mut()
                    .for_each(|p| *p = (0.05 * *p * 255.0).round());
                image
            }
            "noisy" => with_noise(honest(middle), 0.05),
            "first" => honest(0),
            "last" => honest(bins - 1),
            "exact" => self.picture(&self.wide, middle, 0.0, 1.0),
            "same-kind" => self.picture(&other(self.scene), middle, 0.0, 1.0),
            "other-bench" => self.picture(&other(DenseScene::Bench), middle, 0.0, 1.0),
            "other-cells" => self.picture(&other(DenseScene::Cells), middle, 0.0, 1.0),
            "other-beam" => self.picture(&other(DenseScene::Beam), middle, 0.0, 1.0),
            "mirrored" => rearranged(&|y, x| (y, N - 1 - x)),
            "flipped" => rearranged(&|y, x| (N - 1 - y, x)),
            "turned" => rearranged(&|y, x| (x, N - 1 - y)),
            "half" => rearranged(&|y, x| (N / 4 + y / 2, N / 4 + x / 2)),
            "larger" => self.picture(&self.wide, middle, 0.0, 1.3),
            "smaller" => {
                let image = self.picture(&self.wide, middle, 0.0, 1.0);
                Image::from_fn(N, N, |y, x| image.at((2 * y) % N, (2 * x) % N))
            }
            "overexposed" => {
                let mut image = honest(middle);
                image
                    .data_mut()
                    .iter_mut()
                    .for_each(|p| *p = (3.0 * *p).min(1.0));
                image
            }
            "noise" => with_noise(Image::zeros(N, N), 1.0),
            kind => panic!("no guide {kind}"),
        };
        vec![Guide {
            image,
            exposure: None,
        }]
    }

    fn print(&self, kinds: &[&str], sparse_seconds: Option<f64>) {
        for kind in kinds {
            if let ("none", Some(sparse_seconds)) = (*kind, sparse_seconds) {
                self.print_without_guide(sparse_seconds);
                continue;
            }
            let guides = self.guide(kind);
            let start = Instant::now();
            let model = std::env::var("MODEL").unwrap_or_default();
            let model = GuideModel::ALL.into_iter().find(|m| m.name() == model);
            let found = fit(
                &self.camera,
                &self.operator,
                &self.measurement,
                self.sigma,
                &guides,
                model.unwrap_or_default(),
                &Cancel::default(),
            )
            .unwrap();
            let seconds = start.elapsed().as_secs_f64();
            let trials: Vec<String> = found
                .trials
                .iter()
                .map(|t| {
                    format!(
                        "{}{}:{:.3}/{:.3}",
                        t.model.name(),
                        t.order.unwrap_or(0),
                        t.fitted,
                        t.held_out
                    )
                })
                .collect();
            let half = 0.5 * N as f64;
            println!(
                "{}\t{}\t{}\t{kind}\t{}\t{}\t{}\t{:.2}\t{:.2}\t{:.3}\t{:.3}\t{:.3}\t{:.2}\t{:.2}\t{:.2}\t{:.3}\t{}\t{seconds:.1}\t\t{}",
                self.scene.name(),
                self.exposure,
                self.seed,
                found.used,
                found.model.name(),
                found.best().order.unwrap_or(0),
                psnr_db(found.video.data(), self.truth.data()),
                psnr_db(&still_mean(&self.truth), self.truth.data()),
                found.best().held_out,
                found.held_out_without,
                found.correlation,
                found.affine.shift_px().0,
                found.affine.shift_px().1,
                found.affine.rotation_deg(half),
                found.affine.magnification(half),
                two_digits(self.path_error(&found.video)),
                trials.join(" ")
            );
        }
    }
}

impl Case {
    fn print_without_guide(&self, sparse_seconds: f64) {
        let (found, seconds) = self.reconstructed(&self.measurement);
        let choice = found.choice.as_ref().map(|choice| choice.best());
        println!(
            "{}\t{}\t{}\tnone\tfalse\t{}\t0\t{:.2}\t{:.2}\t{:.3}\t\t\t\t\t\t\t{}\t{seconds:.1}\t{:.1}\t",
            self.scene.name(),
            self.exposure,
            self.seed,
            found.prior,
            psnr_db(found.video.data(), self.truth.data()),
            psnr_db(&still_mean(&self.truth), self.truth.data()),
            choice.map_or(f64::NAN, |best| best.error),
            two_digits(self.path_error(&found.video)),
            seconds / sparse_seconds
        );
    }
}

impl Case {
    /// Rms distance in pixels between the object of `bench` in `video` and in the truth; `None` for other scenes. In each bin
    /// the object of the truth is shifted to where the video is nearest to it, within `PATH_REACH_PX`.
    fn path_error(&self, video: &Video) -> Option<f64> {
        if self.scene != DenseScene::Bench {
            return None;
        }
        let shape = self.truth.shape();
        let still = background(&self.truth);
        let limit = PATH_CONTRAST * self.truth.data().iter().fold(0.0f32, |m, v| m.max(*v));
        let steps = (2.0 * PATH_REACH_PX / PATH_STEP_PX) as usize;
        let shift = |k: usize| k as f64 * PATH_STEP_PX - PATH_REACH_PX;
        let squared_distance = |t: usize| {
            let image = |video: &Video| Image::new(N, N, video.bin(t).to_vec()).unwrap();
            let (truth, found) = (image(&self.truth), image(video));
            let object: Vec<usize> = (0..shape.pixels())
                .filter(|i| (truth.data()[*i] - still[*i]).abs() > limit)
                .collect();
            let error = |dy: f64, dx: f64| -> f64 {
                let at = |i: &usize| sample(&found, (i / N) as f64 + dy, (i % N) as f64 + dx);
                let pixels = object.iter();
                pixels
                    .map(|i| (at(i) - f64::from(truth.data()[*i])).powi(2))
                    .sum()
            };
            let places = (0..=steps).flat_map(|i| (0..=steps).map(move |j| (shift(i), shift(j))));
            let errors = places.map(|(dy, dx)| (error(dy, dx), dy.powi(2) + dx.powi(2)));
            errors.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap().1
        };
        let sum: f64 = (0..shape.bins).map(squared_distance).sum();
        Some((sum / shape.bins as f64).sqrt())
    }
}

/// What the object of `bench` passes before: no pixel is covered in the first and in the last bin, and one that is covered
/// changes from bin to bin.
fn background(video: &Video) -> Vec<f32> {
    let last = video.shape().bins - 1;
    let change = |i: usize, a: usize, b: usize| (video.bin(a)[i] - video.bin(b)[i]).abs();
    let of_pixel = |i: usize| {
        let is_covered_at_first = change(i, 0, 1) > change(i, last - 1, last);
        video.bin(if is_covered_at_first { last } else { 0 })[i]
    };
    (0..video.shape().pixels()).map(of_pixel).collect()
}

/// A number with two digits, or nothing.
fn two_digits(value: Option<f64>) -> String {
    value.map_or_else(String::new, |value| format!("{value:.2}"))
}

/// The frame of `scene` at SNR 256.
fn record(camera: &Camera, operator: &RollingShutter, scene: &Video, seed: u64) -> SimulatedFrame {
    let mut light = vec![0.0; N * N];
    operator.apply(scene.data(), &mut light);
    let image = Image::new(N, N, light).unwrap();
    let noise = Noise::Gaussian { snr: 256.0 };
    noise.apply(&image, camera.sensor(), seed).unwrap()
}

/// The mean of the truth over time, in every bin.
fn still_mean(truth: &Video) -> Vec<f32> {
    let shape = truth.shape();
    let mean = |i: usize| {
        let sum: f64 = (0..shape.bins).map(|t| f64::from(truth.bin(t)[i])).sum();
        (sum / shape.bins as f64) as f32
    };
    let mean: Vec<f32> = (0..shape.pixels()).map(mean).collect();
    mean.repeat(shape.bins)
}

fn sample(image: &Image, y: f64, x: f64) -> f64 {
    let end = image.columns() as f64 - 1.001;
    let (y, x) = (y.clamp(0.0, end), x.clamp(0.0, end));
    let (i, j) = (y as usize, x as usize);
    let (f, g) = (y - i as f64, x - j as f64);
    let p = |y, x| f64::from(image.at(y, x));
    (p(i, j) * (1.0 - g) + p(i, j + 1) * g) * (1.0 - f)
        + (p(i + 1, j) * (1.0 - g) + p(i + 1, j + 1) * g) * f
}
