//! Convolution of only the rows that are read: FFTs along x, sums along y.
//!
//! Row `r` of the convolution needs every field row once:
//! `B_r(f) = Σ_y V_y(f) · P_{r−sy(y)}(f)`, with `V_y`, `P_d` the spectra along x
//! of a field row and of a PSF row. No FFT along y, no padded plane.

use super::engine::Geometry;
use crate::Psf;
use crate::linop::Scalar;
use crate::vecmath::simd;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::num_complex::Complex;
use rustfft::num_traits::Zero;
use std::sync::Arc;

pub(super) struct Rowwise<T: Scalar> {
    geometry: Geometry,
    /// Spectra of the PSF rows, one for each row displacement, smallest first.
    psf: Vec<Complex<T>>,
    frequencies: usize,
    length: usize,
    forward: Arc<dyn RealToComplex<T>>,
    inverse: Arc<dyn ComplexToReal<T>>,
}

pub(super) struct Scratch<T> {
    line: Vec<T>,
    rows: Vec<Complex<T>>,
    one: Vec<Complex<T>>,
    fft: Vec<Complex<T>>,
}

impl<T: Scalar> Rowwise<T> {
    pub fn new(geometry: &Geometry, psf: &Psf) -> Self {
        let length = geometry.fft_columns();
        let mut planner = RealFftPlanner::<T>::new();
        let forward = planner.plan_fft_forward(length);
        let inverse = planner.plan_fft_inverse(length);
        let frequencies = length / 2 + 1;
        let displacements = geometry.rows + geometry.field_rows - 1;
        let mut spectra = vec![Complex::zero(); displacements * frequencies];
        let mut line = vec![T::zero(); length];
        for (d, spectrum) in spectra.chunks_exact_mut(frequencies).enumerate() {
            let dy = d as isize + geometry.row_displacement(0, geometry.field_rows - 1);
            line.fill(T::zero());
            // A field pixel stands at its own index x', so index i of the kernel is the
            // displacement i + ox; negative indices wrap around to the end.
            for (x, value) in line[..geometry.columns].iter_mut().enumerate() {
                *value = psf
                    .at_displacement(dy, geometry.column_displacement(x, 0))
                    .into();
            }
            for x in 1..geometry.field_columns {
                line[length - x] = psf
                    .at_displacement(dy, geometry.column_displacement(0, x))
                    .into();
            }
            forward.process(&mut line, spectrum).expect("lengths match");
            // The transforms are not normalised: the kernel carries 1/length.
            let length = T::nearest(length as f64);
            spectrum.iter_mut().for_each(|c| *c = *c / length);
        }
        Self {
            geometry: geometry.clone(),
            psf: spectra,
            frequencies,
            length,
            forward,
            inverse,
        }
    }

    pub fn scratch(&self) -> Scratch<T> {
        let fft = self
            .forward
            .get_scratch_len()
            .max(self.inverse.get_scratch_len());
        Scratch {
            line: vec![T::zero(); self.length],
            rows: Vec::new(),
            one: vec![Complex::zero(); self.frequencies],
            fft: vec![Complex::zero(); fft],
        }
    }

    /// Spectrum of the PSF row that leads from field row `y` to sensor row `r`.
    fn kernel(&self, r: usize, y: usize) -> &[Complex<T>] {
        let d = r + self.geometry.field_rows - 1 - y;
        &self.psf[d * self.frequencies..(d + 1) * self.frequencies]
    }

    pub fn read(&self, light: &[T], rows: &[usize], values: &mut [T], scratch: &mut Scratch<T>) {
        let Scratch {
            line,
            rows: sums,
            one,
            fft,
        } = scratch;
        sums.clear();
        sums.resize(rows.len() * self.frequencies, Complex::zero());
        for (y, field_row) in light.chunks_exact(self.geometry.field_columns).enumerate() {
            // Recovered scenes are sparse: most rows of most bins are dark.
            if field_row.iter().all(|&v| v == T::zero()) {
                continue;
            }
            line[..field_row.len()].copy_from_slice(field_row);
            line[field_row.len()..].fill(T::zero());
            self.forward
                .process_with_scratch(line, one, fft)
                .expect("lengths match");
            for (&r, sum) in rows.iter().zip(sums.chunks_exact_mut(self.frequencies)) {
                multiply_add(sum, one, self.kernel(r, y));
            }
        }
        let columns = self.geometry.columns;
        for (sum, values) in sums
            .chunks_exact_mut(self.frequencies)
            .zip(values.chunks_exact_mut(columns))
        {
            self.invert(sum, line, fft);
            values.copy_from_slice(&line[..columns]);
        }
    }

    /// Field rows that are dark in `mask` are set to zero; the others are whole.
    pub fn spread(
        &self,
        values: &[T],
        rows: &[usize],
        mask: Option<&[u8]>,
        light: &mut [T],
        scratch: &mut Scratch<T>,
    ) {
        let Scratch {
            line,
            rows: spectra,
            one,
            fft,
        } = scratch;
        spectra.resize(rows.len() * self.frequencies, Complex::zero());
        let columns = self.geometry.columns;
        for (values, spectrum) in values
            .chunks_exact(columns)
            .zip(spectra.chunks_exact_mut(self.frequencies))
        {
            line[..columns].copy_from_slice(values);
            line[columns..].fill(T::zero());
            self.forward
                .process_with_scratch(line, spectrum, fft)
                .expect("lengths match");
        }
        let field_columns = self.geometry.field_columns;
        for (y, field_row) in light.chunks_exact_mut(field_columns).enumerate() {
            let is_lit = |mask: &[u8]| mask[y * field_columns..][..field_columns].contains(&1);
            if !mask.is_none_or(is_lit) {
                field_row.fill(T::zero());
                continue;
            }
            one.fill(Complex::zero());
            for (&r, spectrum) in rows.iter().zip(spectra.chunks_exact(self.frequencies)) {
                multiply_conjugate_add(one, spectrum, self.kernel(r, y));
            }
            self.invert(one, line, fft);
            field_row.copy_from_slice(&line[..field_columns]);
        }
    }

    fn invert(&self, spectrum: &mut [Complex<T>], line: &mut [T], fft: &mut [Complex<T>]) {
        // Sums of products of real signals' spectra: real at both ends up to rounding.
        spectrum[0].im = T::zero();
        spectrum[self.frequencies - 1].im = T::zero();
        self.inverse
            .process_with_scratch(spectrum, line, fft)
            .expect("ends are real");
    }
}

/// `sum += a · b`.
pub(super) fn multiply_add<T: Scalar>(sum: &mut [Complex<T>], a: &[Complex<T>], b: &[Complex<T>]) {
    simd(
        #[inline(always)]
        || {
            for ((s, a), b) in sum.iter_mut().zip(a).zip(b) {
                s.re += a.re * b.re - a.im * b.im;
                s.im += a.re * b.im + a.im * b.re;
            }
        },
    );
}

/// `sum += a · conj(b)`.
pub(super) fn multiply_conjugate_add<T: Scalar>(
    sum: &mut [Complex<T>],
    a: &[Complex<T>],
    b: &[Complex<T>],
) {
    simd(
        #[inline(always)]
        || {
            for ((s, a), b) in sum.iter_mut().zip(a).zip(b) {
                s.re += a.re * b.re + a.im * b.im;
                s.im += a.im * b.re - a.re * b.im;
            }
        },
    );
}
