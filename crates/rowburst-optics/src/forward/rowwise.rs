//! Convolution of only the rows that are read: FFTs along x, sums along y (docs/design/001).
//!
//! The spectrum along x of row `r` of the convolution is a sum over the field rows:
//!
//! ```text
//! B_r(f) = Σ_y V_y(f) · P_{r−sy(y)}(f)
//! ```
//!
//! `V_y` is the spectrum of field row `y`, and `P_d` that of the PSF row at the displacement `d`. There is no FFT
//! along y and no padded plane.
//!
//! Two field rows share one complex transform: they are the real and the imaginary part of a line with the spectrum
//! `Z = V_y + i V_{y+1}`. With the kernel `Q_d = P_d − i P_{d−1}` of two PSF rows, where `d = r − sy(y)`, the
//! operator and its adjoint are
//!
//! ```text
//! b_r = Re F⁻¹ Σ_pairs Z Q_d            v_y + i v_{y+1} = F⁻¹ Σ_r B_r Q_d*
//! ```
//!
//! The product is `Z Q_d = V_y P_d + V_{y+1} P_{d−1} + i (V_{y+1} P_d − V_y P_{d−1})`. Its first two terms are the
//! spectrum of a real line, which `Re F⁻¹` keeps. The bracket is also the spectrum of a real line, so its `i`-fold is
//! dropped. The spectra of two rows are never separated.

use super::geometry::Geometry;
use super::jobs::{AdjointJob, ForwardJob};
use crate::Psf;
use crate::psf::Extent;
use rayon::prelude::*;
use rowburst_core::linop::Scalar;
use rowburst_core::vecmath::{add_conjugate_products, add_products, simd};
use rustfft::Fft;
use rustfft::num_complex::Complex;
use rustfft::num_traits::Zero;
use std::ops::Range;
use std::sync::Arc;

/// Row pairs of a field in a batch; larger leaves the nearest cache, smaller passes over the sums more often.
pub(super) const PAIRS_PER_BATCH: usize = 4;

/// The row-wise engine of one PSF.
pub(super) struct Rowwise<T: Scalar> {
    geometry: Geometry,
    /// Row displacements `d` at which `Q_d` is not zero, counted from the smallest one.
    nonzero: Range<usize>,
    /// `Q_d` at these.
    kernels: Vec<Complex<T>>,
    /// Length of an FFT.
    length: usize,
    forward: Arc<dyn Fft<T>>,
    inverse: Arc<dyn Fft<T>>,
}

/// Buffers of one thread.
pub(super) struct Scratch<T> {
    /// A line for each sensor row that is read, job after job.
    sums: Vec<Complex<T>>,
    /// Field rows of a batch.
    light: Vec<T>,
    pairs: Pairs<T>,
}

/// Row pairs of a batch.
pub(super) struct Pairs<T> {
    /// First field row of each pair.
    pub rows: Vec<usize>,
    /// The pairs, packed, or their spectra.
    lines: Vec<Complex<T>>,
    fft: Vec<Complex<T>>,
}

impl<T: Scalar> Rowwise<T> {
    /// The engine of `psf`, which is zero outside of `extent`.
    pub fn new(geometry: &Geometry, psf: &Psf, extent: &Extent) -> Self {
        let length = geometry.fft_columns_for(&extent.columns);
        let (forward, inverse) = T::complex_transforms(length);
        let displacements = geometry.rows + geometry.field_rows - 1;
        let least = geometry.row_displacement(0, geometry.field_rows - 1);
        let index = |dy: isize| (dy - least).clamp(0, displacements as isize) as usize;
        // A kernel holds two rows of the PSF, its own and the one before.
        let nonzero = index(extent.rows.start)..index(extent.rows.end + 1);
        let mut spectra = vec![Complex::zero(); nonzero.len() * length];
        // The transforms are not normalised, so the kernels contain the factor 1/length.
        let scale = T::nearest(1.0 / length as f64);
        for (d, spectrum) in nonzero.clone().zip(spectra.chunks_exact_mut(length)) {
            let dy = d as isize + least;
            // The light of field column x' stands at index x' of a line, and its image at index x. So kernel index
            // `x − x'` holds the displacement `x − x' + ox`. Negative indices wrap around to the end.
            for i in geometry.kernel_columns(&extent.columns) {
                let dx = i + geometry.offset_columns as isize;
                let value = |dy| T::from(psf.at_displacement(dy, dx)) * scale;
                let before = if d == 0 { T::zero() } else { value(dy - 1) };
                spectrum[i.rem_euclid(length as isize) as usize] = Complex::new(value(dy), -before);
            }
        }
        forward.process(&mut spectra);
        Self {
            geometry: geometry.clone(),
            nonzero,
            kernels: spectra,
            length,
            forward,
            inverse,
        }
    }

    pub fn scratch(&self) -> Scratch<T> {
        Scratch {
            sums: Vec::new(),
            light: vec![T::zero(); 2 * PAIRS_PER_BATCH * self.geometry.field_columns],
            pairs: self.pairs(),
        }
    }

    /// Buffers for a batch of row pairs.
    pub fn pairs(&self) -> Pairs<T> {
        let fft = self
            .forward
            .get_inplace_scratch_len()
            .max(self.inverse.get_inplace_scratch_len());
        Pairs {
            rows: Vec::with_capacity(PAIRS_PER_BATCH),
            lines: vec![Complex::zero(); PAIRS_PER_BATCH * self.length],
            fft: vec![Complex::zero(); fft],
        }
    }

    /// `Q_d` from the field rows `y` and `y + 1` to sensor row `r`; `None` where it is zero.
    fn kernel(&self, r: usize, y: usize) -> Option<&[Complex<T>]> {
        let d = r + self.geometry.field_rows - 1 - y;
        let i = d.checked_sub(self.nonzero.start)?;
        self.kernels.get(i * self.length..(i + 1) * self.length)
    }

    /// Bytes of the PSF's spectra.
    pub fn spectrum_bytes(&self) -> usize {
        size_of_val(self.kernels.as_slice())
    }

    /// Computes the row values of all `jobs`.
    pub fn apply_batch(&self, jobs: &mut [ForwardJob<T>], scratch: &mut Scratch<T>) {
        let (columns, field_columns) = (self.geometry.columns, self.geometry.field_columns);
        let lines = jobs.iter().map(|job| job.rows.len()).sum::<usize>();
        let Scratch { sums, light, pairs } = scratch;
        sums.clear();
        sums.resize(lines * self.length, Complex::zero());
        for first in (0..self.geometry.field_rows).step_by(2 * PAIRS_PER_BATCH) {
            let end = self.geometry.field_rows.min(first + 2 * PAIRS_PER_BATCH);
            let mut sums = sums.as_mut_slice();
            // All jobs take these rows in turn, since they need nearly the same kernels and the light of the same bins.
            for job in &*jobs {
                let (sums_of_job, rest) = sums.split_at_mut(job.rows.len() * self.length);
                let light = job
                    .light
                    .at(first * field_columns..end * field_columns, light);
                self.add_pairs(light, first, job.rows, sums_of_job, pairs);
                sums = rest;
            }
        }
        self.inverse.process_with_scratch(sums, &mut pairs.fft);
        let lines = jobs
            .iter_mut()
            .flat_map(|job| job.values.chunks_exact_mut(columns));
        for (values, sum) in lines.zip(sums.chunks_exact(self.length)) {
            values.iter_mut().zip(sum).for_each(|(v, s)| *v = s.re);
        }
    }

    /// Adds the contribution of some field rows, `light` from row `first` on, to the sums of the sensor rows `rows`.
    fn add_pairs(
        &self,
        light: &[T],
        first: usize,
        rows: &[usize],
        sums: &mut [Complex<T>],
        pairs: &mut Pairs<T>,
    ) {
        let field_columns = self.geometry.field_columns;
        pairs.rows.clear();
        for (i, row_pair) in light.chunks(2 * field_columns).enumerate() {
            let y = first + 2 * i;
            let is_seen = || rows.iter().any(|&r| self.kernel(r, y).is_some());
            // Most rows of a sparse video are zero.
            if !is_dark(row_pair) && is_seen() {
                let start = pairs.rows.len() * self.length;
                let line = &mut pairs.lines[start..start + self.length];
                pack(row_pair, field_columns, line);
                pairs.rows.push(y);
            }
        }
        let lines = &mut pairs.lines[..pairs.rows.len() * self.length];
        self.forward.process_with_scratch(lines, &mut pairs.fft);
        for (&r, sum) in rows.iter().zip(sums.chunks_exact_mut(self.length)) {
            for (&y, line) in pairs.rows.iter().zip(lines.chunks_exact(self.length)) {
                if let Some(kernel) = self.kernel(r, y) {
                    add_products(sum, line, kernel);
                }
            }
        }
    }

    /// The adjoint of [`Self::apply_batch`]; see `Engine::adjoint_batch`.
    ///
    /// Row pairs that are zero in the job's mask are left out.
    pub fn adjoint_batch(
        &self,
        jobs: &[AdjointJob<T>],
        scratch: &mut Scratch<T>,
        mut write: impl FnMut(usize, usize, &mut [T]),
    ) {
        let (columns, field_columns) = (self.geometry.columns, self.geometry.field_columns);
        let Scratch { sums, light, pairs } = scratch;
        let lines = jobs.iter().map(|job| job.rows.len()).sum::<usize>();
        sums.resize(lines * self.length, Complex::zero());
        let values = jobs.iter().flat_map(|job| job.values.chunks_exact(columns));
        for (values, line) in values.zip(sums.chunks_exact_mut(self.length)) {
            pack(values, columns, line);
        }
        self.forward.process_with_scratch(sums, &mut pairs.fft);
        for first in (0..self.geometry.field_rows).step_by(2 * PAIRS_PER_BATCH) {
            let end = self.geometry.field_rows.min(first + 2 * PAIRS_PER_BATCH);
            let mut sums = sums.as_slice();
            for (i, job) in jobs.iter().enumerate() {
                pairs.rows.clear();
                for y in (first..end).step_by(2) {
                    let pixels = y * field_columns..end.min(y + 2) * field_columns;
                    if job.mask.is_none_or(|mask| mask[pixels].contains(&1)) {
                        pairs.rows.push(y);
                    }
                }
                let (spectra, rest) = sums.split_at(job.rows.len() * self.length);
                sums = rest;
                let start = first * field_columns;
                let light = &mut light[..end * field_columns - start];
                self.write_pairs(job.rows, spectra, pairs, first, light);
                // Neighbouring pairs are written together.
                for run in pairs.rows.chunk_by(|a, b| a + 2 == *b) {
                    let stop = end.min(run[run.len() - 1] + 2);
                    let of_run = run[0] * field_columns..stop * field_columns;
                    write(
                        i,
                        of_run.start,
                        &mut light[of_run.start - start..of_run.end - start],
                    );
                }
            }
        }
    }

    /// The spectra of sensor rows, one after another.
    pub fn spectra(&self, values: &[T]) -> Vec<Complex<T>> {
        let columns = self.geometry.columns;
        let mut spectra = vec![Complex::zero(); values.len() / columns * self.length];
        let lines = spectra.par_chunks_exact_mut(self.length);
        lines.zip(values.par_chunks_exact(columns)).for_each_init(
            || vec![Complex::zero(); self.forward.get_inplace_scratch_len()],
            |fft, (line, values)| {
                pack(values, columns, line);
                self.forward.process_with_scratch(line, fft);
            },
        );
        spectra
    }

    /// Points of a spectrum.
    pub fn length(&self) -> usize {
        self.length
    }

    /// Writes the light of the row pairs `pairs.rows` to `light`, which begins with field row `first`, from the `spectra` of
    /// the sensor rows `rows`.
    pub fn write_pairs(
        &self,
        rows: &[usize],
        spectra: &[Complex<T>],
        pairs: &mut Pairs<T>,
        first: usize,
        light: &mut [T],
    ) {
        let field_columns = self.geometry.field_columns;
        let lines = &mut pairs.lines[..pairs.rows.len() * self.length];
        lines.fill(Complex::zero());
        for (&y, line) in pairs.rows.iter().zip(lines.chunks_exact_mut(self.length)) {
            let mut is_seen = false;
            for (&r, spectrum) in rows.iter().zip(spectra.chunks_exact(self.length)) {
                if let Some(kernel) = self.kernel(r, y) {
                    add_conjugate_products(line, kernel, spectrum);
                    is_seen = true;
                }
            }
            if is_seen {
                self.inverse.process_with_scratch(line, &mut pairs.fft);
            }
        }
        for (&y, line) in pairs.rows.iter().zip(lines.chunks_exact(self.length)) {
            let from = (y - first) * field_columns;
            let end = light.len().min(from + 2 * field_columns);
            unpack(line, field_columns, &mut light[from..end]);
        }
    }
}

/// Whether all values are zero.
fn is_dark<T: Scalar>(values: &[T]) -> bool {
    let is_zero = |part: &[T]| part.iter().fold(true, |dark, v| dark & (*v == T::zero()));
    values.chunks(32).all(is_zero)
}

/// Writes one or two rows of `columns` values as the real and the imaginary part of `line`, and zeros after them.
fn pack<T: Scalar>(rows: &[T], columns: usize, line: &mut [Complex<T>]) {
    let (first, second) = rows.split_at(columns);
    let (to, rest) = line.split_at_mut(columns);
    simd(
        #[inline(always)]
        || {
            if second.is_empty() {
                let lines = to.iter_mut().zip(first);
                lines.for_each(|(c, a)| *c = Complex::new(*a, T::zero()));
            } else {
                let lines = to.iter_mut().zip(first).zip(second);
                lines.for_each(|((c, a), b)| *c = Complex::new(*a, *b));
            }
        },
    );
    rest.fill(Complex::zero());
}

/// Writes the real and the imaginary part of `line` as two rows of `columns` values.
fn unpack<T: Scalar>(line: &[Complex<T>], columns: usize, rows: &mut [T]) {
    let (first, second) = rows.split_at_mut(columns);
    simd(
        #[inline(always)]
        || {
            first.iter_mut().zip(line).for_each(|(a, c)| *a = c.re);
            second.iter_mut().zip(line).for_each(|(b, c)| *b = c.im);
        },
    );
}
