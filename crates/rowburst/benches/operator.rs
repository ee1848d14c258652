//! Forward and adjoint of the operator, beside what no operator can do without and beside the
//! textbook form of the same convolution: `cargo bench --workspace --bench operator`.

use rayon::prelude::*;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::{Camera, Psf, RollingShutter, Sensor, Shutter, Video};
use rustfft::num_complex::Complex32;
use rustfft::{Fft, FftPlanner};
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

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

/// Fastest of several runs, in ms: what the machine can do where nothing else runs.
fn fastest(runs: usize, mut work: impl FnMut()) -> f64 {
    let time = |work: &mut dyn FnMut()| {
        let begin = Instant::now();
        work();
        begin.elapsed().as_secs_f64() * 1e3
    };
    work();
    (0..runs).map(|_| time(&mut work)).fold(f64::MAX, f64::min)
}

/// The FFTs that a forward and an adjoint cannot do without, and nothing else: one there for
/// each row of the video and one back, padded to twice the width, all that a bin needs in cache.
/// The faster of real transforms one by one, and of two rows in one complex transform.
fn fft_lower_bound(bins: usize, size: usize, runs: usize) -> f64 {
    let length = 2 * size;
    let mut real = RealFftPlanner::<f32>::new();
    let (forward, inverse) = (real.plan_fft_forward(length), real.plan_fft_inverse(length));
    let mut complex = FftPlanner::<f32>::new();
    let (there, back) = (
        complex.plan_fft_forward(length),
        complex.plan_fft_inverse(length),
    );
    let one_by_one = fastest(runs, || {
        (0..bins).into_par_iter().for_each_init(
            || {
                (
                    forward.make_input_vec(),
                    forward.make_output_vec(),
                    forward.make_scratch_vec(),
                )
            },
            |(line, row, scratch), _| {
                for _ in 0..size {
                    line.fill(1.0);
                    forward
                        .process_with_scratch(line, row, scratch)
                        .expect("lengths match");
                    inverse
                        .process_with_scratch(row, line, scratch)
                        .expect("ends are real");
                }
                black_box(line);
            },
        );
    });
    let in_pairs = fastest(runs, || {
        (0..bins).into_par_iter().for_each_init(
            || (vec![Complex32::ZERO; length], vec![Complex32::ZERO; length]),
            |(line, scratch), _| {
                scratch.resize(
                    there
                        .get_inplace_scratch_len()
                        .max(back.get_inplace_scratch_len()),
                    Complex32::ZERO,
                );
                for _ in 0..size / 2 {
                    line.fill(Complex32::new(1.0, 1.0));
                    there.process_with_scratch(line, scratch);
                    back.process_with_scratch(line, scratch);
                }
                black_box(line);
            },
        );
    });
    one_by_one.min(in_pairs)
}

/// The video read once and written once.
fn memory_lower_bound(video: &[f32], back: &mut [f32], runs: usize) -> f64 {
    let chunk = 1 << 16;
    fastest(runs, || {
        let sum: f32 = video
            .par_chunks(chunk)
            .map(|c| {
                let mut lanes = [0.0f32; 32];
                for c in c.as_chunks::<32>().0 {
                    lanes.iter_mut().zip(c).for_each(|(l, v)| *l += v);
                }
                lanes.iter().sum::<f32>()
            })
            .sum();
        black_box(sum);
        back.par_chunks_mut(chunk).for_each(|c| c.fill(sum));
    })
}

/// The table of `docs/speed.md`.
fn operators() {
    println!(
        "| video | forward | adjoint | both | FFT bound | memory bound | over the FFT bound | textbook | times as fast |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    for (size, runs) in [(108, 60), (256, 12), (512, 4)] {
        let camera = camera(size);
        let psf = psf(size);
        let ours = RollingShutter::new(&camera, &psf);
        // No voxel is zero: rows without light, which ours passes over, are not counted on.
        let video: Vec<f32> = digits(&camera).data().iter().map(|v| v + 0.1).collect();
        let (mut frame, mut back) = (vec![0.0; ours.range_len()], vec![0.0; ours.domain_len()]);
        let forward = fastest(runs, || ours.apply(black_box(&video), &mut frame));
        let adjoint = fastest(runs, || ours.adjoint(black_box(&frame), &mut back));
        let fft = fft_lower_bound(camera.video_shape().bins, size, runs);
        let memory = memory_lower_bound(&video, &mut back, runs);
        let textbook = Textbook::new(camera.clone(), &psf);
        let mut expected = frame.clone();
        textbook.apply(&video, &mut expected);
        ours.apply(&video, &mut frame);
        let error = rowburst::vecmath::distance_squared(&frame, &expected).sqrt()
            / rowburst::vecmath::norm(&expected);
        assert!(error < 1e-5, "the two forms are the same operator: {error}");
        let slow = fastest(runs / 4, || {
            textbook.apply(black_box(&video), &mut expected);
        }) + fastest(runs / 4, || textbook.adjoint(black_box(&frame), &mut back));
        let both = forward + adjoint;
        println!(
            "| {size}×{size}×{} | {forward:.2} ms | {adjoint:.2} ms | {both:.2} ms | {fft:.2} ms | {memory:.2} ms | {:.2} | {slow:.1} ms | {:.1} |",
            size / 2,
            both / fft.max(memory),
            slow / both
        );
    }
}

fn main() {
    operators();
}
