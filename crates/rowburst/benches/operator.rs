//! Forward plus adjoint of the operator, beside the textbook form of the same
//! convolution, and the cost of a solver iteration.
//!
//! `cargo bench -p rowburst`; the ratio of the two `forward + adjoint` rows of one run
//! is the speed of the operator.

use criterion::{Criterion, criterion_group, criterion_main};
use rayon::prelude::*;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Prior, Problem, Recipe};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::solve::StopReason;
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shutter, Video};
use rustfft::num_complex::Complex32;
use rustfft::{Fft, FftPlanner};
use std::hint::black_box;
use std::ops::ControlFlow;
use std::sync::Arc;

fn camera(size: usize) -> Camera {
    Camera::new(CameraParams {
        rows: size,
        columns: size,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .expect("a valid camera")
}

fn psf(size: usize) -> Psf {
    speckle_psf(&SpeckleOptics::demo(), 2 * size - 1, 2 * size - 1, 1).expect("valid optics")
}

fn digits(camera: &Camera) -> Video {
    scene::digits(camera.video_shape(), 12, 1).expect("the digits fit")
}

/// Every bin padded to twice its size, convolved by 2-D real FFTs, cropped, and the rows
/// of its instant kept; f32, parallel over bins.
struct Textbook {
    camera: Camera,
    length: usize,
    kernel: Vec<Complex32>,
    forward: Arc<dyn RealToComplex<f32>>,
    inverse: Arc<dyn ComplexToReal<f32>>,
    column_forward: Arc<dyn Fft<f32>>,
    column_inverse: Arc<dyn Fft<f32>>,
}

impl Textbook {
    fn new(camera: Camera, psf: &Psf) -> Self {
        // 2·size is 5-smooth for the sizes used here.
        let length = 2 * camera.rows();
        let mut real = RealFftPlanner::<f32>::new();
        let mut complex = FftPlanner::<f32>::new();
        let mut textbook = Self {
            camera,
            length,
            kernel: Vec::new(),
            forward: real.plan_fft_forward(length),
            inverse: real.plan_fft_inverse(length),
            column_forward: complex.plan_fft_forward(length),
            column_inverse: complex.plan_fft_inverse(length),
        };
        let wrapped = |i: usize| {
            if i < length / 2 {
                i as isize
            } else {
                i as isize - length as isize
            }
        };
        let plane: Vec<f32> = (0..length * length)
            .map(|i| psf.at_displacement(wrapped(i / length), wrapped(i % length)))
            .collect();
        let scale = 1.0 / (length * length) as f32;
        textbook.kernel = textbook.spectrum(plane).iter().map(|c| c * scale).collect();
        textbook
    }

    /// `[x-frequency, y-frequency]`.
    fn spectrum(&self, mut plane: Vec<f32>) -> Vec<Complex32> {
        let frequencies = self.length / 2 + 1;
        let mut rows = vec![Complex32::ZERO; frequencies * self.length];
        let lines = plane.chunks_exact_mut(self.length);
        for (line, row) in lines.zip(rows.chunks_exact_mut(frequencies)) {
            self.forward.process(line, row).expect("lengths match");
        }
        let mut columns: Vec<Complex32> = (0..frequencies)
            .flat_map(|f| (0..self.length).map(move |y| (f, y)))
            .map(|(f, y)| rows[y * frequencies + f])
            .collect();
        columns
            .chunks_exact_mut(self.length)
            .for_each(|c| self.column_forward.process(c));
        columns
    }

    fn plane(&self, mut columns: Vec<Complex32>) -> Vec<f32> {
        let frequencies = self.length / 2 + 1;
        columns
            .chunks_exact_mut(self.length)
            .for_each(|c| self.column_inverse.process(c));
        let mut plane = vec![0.0f32; self.length * self.length];
        let mut row = vec![Complex32::ZERO; frequencies];
        for (y, line) in plane.chunks_exact_mut(self.length).enumerate() {
            for (f, c) in row.iter_mut().enumerate() {
                *c = columns[f * self.length + y];
            }
            (row[0].im, row[frequencies - 1].im) = (0.0, 0.0);
            self.inverse.process(&mut row, line).expect("ends are real");
        }
        plane
    }

    fn apply(&self, video: &[f32], frame: &mut [f32]) {
        let size = self.camera.rows();
        let bins: Vec<Vec<f32>> = video
            .par_chunks_exact(size * size)
            .map(|bin| {
                let mut plane = vec![0.0; self.length * self.length];
                for (line, row) in plane
                    .chunks_exact_mut(self.length)
                    .zip(bin.chunks_exact(size))
                {
                    line[..size].copy_from_slice(row);
                }
                let mut spectrum = self.spectrum(plane);
                spectrum
                    .iter_mut()
                    .zip(&self.kernel)
                    .for_each(|(c, k)| *c *= k);
                self.plane(spectrum)
            })
            .collect();
        for (y, row) in frame.chunks_exact_mut(size).enumerate() {
            let plane = &bins[self.camera.instants()[y]];
            row.copy_from_slice(&plane[y * self.length..y * self.length + size]);
        }
    }

    fn adjoint(&self, frame: &[f32], video: &mut [f32]) {
        let size = self.camera.rows();
        video
            .par_chunks_exact_mut(size * size)
            .enumerate()
            .for_each(|(t, bin)| {
                let mut plane = vec![0.0; self.length * self.length];
                for y in (0..size).filter(|&y| self.camera.instants()[y] == t) {
                    plane[y * self.length..y * self.length + size]
                        .copy_from_slice(&frame[y * size..(y + 1) * size]);
                }
                let mut spectrum = self.spectrum(plane);
                spectrum
                    .iter_mut()
                    .zip(&self.kernel)
                    .for_each(|(c, k)| *c *= k.conj());
                let plane = self.plane(spectrum);
                for (row, line) in bin
                    .chunks_exact_mut(size)
                    .zip(plane.chunks_exact(self.length))
                {
                    row.copy_from_slice(&line[..size]);
                }
            });
    }
}

fn operators(c: &mut Criterion) {
    let camera = camera(108);
    let psf = psf(108);
    let ours = RollingShutter::new(&camera, &psf);
    let textbook = Textbook::new(camera.clone(), &psf);
    // No voxel is zero: rows without light, which ours passes over, are not counted on.
    let video: Vec<f32> = digits(&camera).data().iter().map(|v| v + 0.1).collect();
    let (mut frame, mut back) = (vec![0.0; ours.range_len()], vec![0.0; ours.domain_len()]);
    let mut expected = frame.clone();
    ours.apply(&video, &mut frame);
    textbook.apply(&video, &mut expected);
    let error = rowburst::vecmath::distance_squared(&frame, &expected).sqrt()
        / rowburst::vecmath::norm(&expected);
    assert!(error < 1e-5, "the two forms are the same operator: {error}");

    let mut group = c.benchmark_group("forward + adjoint, 108×108×54");
    group.sample_size(20);
    group.bench_function("rowburst", |b| {
        b.iter(|| {
            ours.apply(black_box(&video), &mut frame);
            ours.adjoint(black_box(&frame), &mut back);
        });
    });
    group.bench_function("textbook", |b| {
        b.iter(|| {
            textbook.apply(black_box(&video), &mut frame);
            textbook.adjoint(black_box(&frame), &mut back);
        });
    });
    group.finish();
}

fn solver(c: &mut Criterion) {
    let camera = camera(108);
    let psf = psf(108);
    let operator = RollingShutter::new(&camera, &psf);
    let mut frame = vec![0.0; operator.range_len()];
    operator.apply(digits(&camera).data(), &mut frame);
    let noiseless = Image::new(108, 108, frame).expect("a frame");
    let noise = Noise::Gaussian { snr: 256.0 };
    let recorded = noise.apply(&noiseless, camera.sensor(), 1).expect("light");
    let measurement = Measurement::new(recorded.frame).expect("light");
    let problem = |prior: &str| {
        let recipe = Recipe {
            prior: Some(prior.parse::<Prior>().expect("a prior")),
            ..Recipe::default()
        };
        Problem::new(&measurement, &camera, &psf, recipe).expect("a valid problem")
    };
    let mut group = c.benchmark_group("solver, 108×108×54");
    group.sample_size(10);
    group.bench_function("set-up", |b| b.iter(|| problem("tv")));
    for prior in ["tv", "tv+0.5*tdiff"] {
        group.bench_function(format!("20 iterations, {prior}"), |b| {
            b.iter_batched(
                || problem(prior),
                |problem| {
                    problem.solve(&mut |progress| match progress.iteration {
                        20 => ControlFlow::Break(StopReason::Interrupted),
                        _ => ControlFlow::Continue(()),
                    })
                },
                criterion::BatchSize::PerIteration,
            );
        });
    }
    group.bench_function("whole reconstruction, default prior", |b| {
        b.iter_batched(
            || problem("tv+0.5*tdiff+support"),
            |problem| problem.solve(&mut |_| ControlFlow::Continue(())),
            criterion::BatchSize::PerIteration,
        );
    });
    group.finish();
}

criterion_group!(benches, operators, solver);
criterion_main!(benches);
