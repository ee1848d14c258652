//! Convolution of the whole plane by 2-D FFTs, for instants that read many rows.

use super::geometry::Geometry;
use crate::Psf;
use rayon::prelude::*;
use realfft::{ComplexToReal, RealToComplex};
use rowburst_core::linop::Scalar;
use rustfft::Fft;
use rustfft::num_complex::Complex;
use rustfft::num_traits::Zero;
use std::sync::Arc;

/// The planar engine of one PSF.
pub(super) struct Planar<T: Scalar> {
    geometry: Geometry,
    /// Spectrum of the PSF, `[x-frequency, y-frequency]`, with the transforms' scale.
    psf: Vec<Complex<T>>,
    width: usize,
    height: usize,
    frequencies: usize,
    row_forward: Arc<dyn RealToComplex<T>>,
    row_inverse: Arc<dyn ComplexToReal<T>>,
    column_forward: Arc<dyn Fft<T>>,
    column_inverse: Arc<dyn Fft<T>>,
}

/// Spectra of rows `[y, x-frequency]` and of the plane `[x-frequency, y]`.
pub(super) struct Scratch<T> {
    rows: Vec<Complex<T>>,
    plane: Vec<Complex<T>>,
}

/// `weight·power + ρ` at each spatial frequency of the padded plane.
#[derive(Clone, Copy)]
pub(super) struct Divisor<'a> {
    pub power: &'a [f32],
    pub weight: f64,
    pub rho: f64,
}

impl<T: Scalar> Planar<T> {
    pub fn new(geometry: &Geometry, psf: &Psf) -> Self {
        let (width, height) = (geometry.fft_columns(), geometry.fft_rows());
        let (row_forward, row_inverse) = T::real_transforms(width);
        let (column_forward, column_inverse) = T::complex_transforms(height);
        let mut planar = Self {
            geometry: geometry.clone(),
            psf: Vec::new(),
            width,
            height,
            frequencies: width / 2 + 1,
            row_forward,
            row_inverse,
            column_forward,
            column_inverse,
        };
        planar.psf = planar.kernel_spectrum(psf);
        planar
    }

    /// Spectrum of the PSF on the padded plane, with the transforms' scale.
    fn kernel_spectrum(&self, psf: &Psf) -> Vec<Complex<T>> {
        // A field pixel has its index in the field, so index i of the kernel is the displacement i + offset. Negative
        // indices wrap around to the end.
        let wrapped = |i: usize, positive: usize, length: usize| {
            if i < positive {
                i as isize
            } else {
                i as isize - length as isize
            }
        };
        let g = &self.geometry;
        let mut kernel = vec![T::zero(); self.width * self.height];
        for (y, line) in kernel.chunks_exact_mut(self.width).enumerate() {
            let dy = wrapped(y, g.rows, self.height) + g.offset_rows as isize;
            for (x, value) in line.iter_mut().enumerate() {
                let dx = wrapped(x, g.columns, self.width) + g.offset_columns as isize;
                *value = psf.at_displacement(dy, dx).into();
            }
        }
        let mut scratch = self.scratch();
        let rows: Vec<usize> = (0..self.height).collect();
        self.transform(&kernel, self.width, &rows, &mut scratch);
        let scale = T::nearest(1.0 / (self.width * self.height) as f64);
        scratch.plane.iter().map(|c| c.scale(scale)).collect()
    }

    pub fn field_pixels(&self) -> usize {
        self.geometry.field_rows * self.geometry.field_columns
    }

    pub fn scratch(&self) -> Scratch<T> {
        let size = self.frequencies * self.height;
        Scratch {
            rows: vec![Complex::zero(); size],
            plane: vec![Complex::zero(); size],
        }
    }

    /// Spectrum of the plane whose row `at[i]` is row `i` of `lines`; the rest is zero.
    fn transform(&self, lines: &[T], columns: usize, at: &[usize], scratch: &mut Scratch<T>) {
        let rows = &mut scratch.rows[..at.len() * self.frequencies];
        rows.par_chunks_exact_mut(self.frequencies)
            .zip(lines.par_chunks_exact(columns))
            .for_each_init(
                || {
                    (
                        vec![T::zero(); self.width],
                        self.row_forward.make_scratch_vec(),
                    )
                },
                |(line, fft), (spectrum, values)| {
                    line[..columns].copy_from_slice(values);
                    line[columns..].fill(T::zero());
                    self.row_forward
                        .process_with_scratch(line, spectrum, fft)
                        .expect("lengths match");
                },
            );
        let rows = &scratch.rows;
        scratch
            .plane
            .par_chunks_exact_mut(self.height)
            .enumerate()
            .for_each_init(
                || vec![Complex::zero(); self.column_forward.get_inplace_scratch_len()],
                |fft, (f, column)| {
                    column.fill(Complex::zero());
                    for (i, &y) in at.iter().enumerate() {
                        column[y] = rows[i * self.frequencies + f];
                    }
                    self.column_forward.process_with_scratch(column, fft);
                },
            );
    }

    /// Row `at[i]` of the plane into row `i` of `lines`.
    fn invert(&self, scratch: &mut Scratch<T>, columns: usize, at: &[usize], lines: &mut [T]) {
        scratch
            .plane
            .par_chunks_exact_mut(self.height)
            .for_each_init(
                || vec![Complex::zero(); self.column_inverse.get_inplace_scratch_len()],
                |fft, column| self.column_inverse.process_with_scratch(column, fft),
            );
        let plane = &scratch.plane;
        lines.par_chunks_exact_mut(columns).zip(at).for_each_init(
            || {
                let spectrum = vec![Complex::zero(); self.frequencies];
                (
                    spectrum,
                    vec![T::zero(); self.width],
                    self.row_inverse.make_scratch_vec(),
                )
            },
            |(spectrum, line, fft), (values, &y)| {
                for (f, c) in spectrum.iter_mut().enumerate() {
                    *c = plane[f * self.height + y];
                }
                spectrum[0].im = T::zero();
                spectrum[self.frequencies - 1].im = T::zero();
                self.row_inverse
                    .process_with_scratch(spectrum, line, fft)
                    .expect("ends are real");
                values.copy_from_slice(&line[..columns]);
            },
        );
    }

    /// Sensor rows `rows` of the convolved `light`, one after another in `values`.
    pub fn apply(&self, light: &[T], rows: &[usize], values: &mut [T], scratch: &mut Scratch<T>) {
        let field: Vec<usize> = (0..self.geometry.field_rows).collect();
        self.transform(light, self.geometry.field_columns, &field, scratch);
        let plane = scratch.plane.par_chunks_exact_mut(self.height);
        plane
            .zip(self.psf.par_chunks_exact(self.height))
            .for_each(|(column, kernel)| {
                column.iter_mut().zip(kernel).for_each(|(c, k)| *c *= k);
            });
        self.invert(scratch, self.geometry.columns, rows, values);
    }

    /// The adjoint of [`Self::apply`]: the light of the field.
    pub fn adjoint(&self, values: &[T], rows: &[usize], light: &mut [T], scratch: &mut Scratch<T>) {
        self.transform(values, self.geometry.columns, rows, scratch);
        let plane = scratch.plane.par_chunks_exact_mut(self.height);
        plane
            .zip(self.psf.par_chunks_exact(self.height))
            .for_each(|(column, kernel)| {
                column
                    .iter_mut()
                    .zip(kernel)
                    .for_each(|(c, k)| *c *= k.conj());
            });
        let field: Vec<usize> = (0..self.geometry.field_rows).collect();
        self.invert(scratch, self.geometry.field_columns, &field, light);
    }

    /// Adds `weight·Re(P̂ Q̂*)` of this PSF and that of `other` at every frequency.
    pub fn add_power(&self, other: &Self, weight: f64, power: &mut Vec<f32>) {
        power.resize(self.psf.len(), 0.0);
        // The stored spectra carry 1/size.
        let scale = weight * ((self.width * self.height) as f64).powi(2);
        for ((sum, p), q) in power.iter_mut().zip(&self.psf).zip(&other.psf) {
            *sum += (scale * (p.re * q.re + p.im * q.im).into()) as f32;
        }
    }

    /// Divides `values` by `divisor` at each spatial frequency of the padded plane.
    pub fn divide(
        &self,
        values: &[T],
        rows: &[usize],
        divisor: Divisor,
        out: &mut [T],
        scratch: &mut Scratch<T>,
    ) {
        self.transform(values, self.geometry.columns, rows, scratch);
        let size = (self.width * self.height) as f64;
        let plane = scratch.plane.par_chunks_exact_mut(self.height);
        plane
            .zip(divisor.power.par_chunks_exact(self.height))
            .for_each(|(column, power)| {
                for (c, &power) in column.iter_mut().zip(power) {
                    let power = divisor.weight * f64::from(power.max(0.0));
                    *c = c.scale(T::nearest(1.0 / (size * (power + divisor.rho))));
                }
            });
        self.invert(scratch, self.geometry.columns, rows, out);
    }
}
