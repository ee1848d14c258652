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
use rowburst_core::linop::Scalar;
use rowburst_core::vecmath::{add_conjugate_products, add_products, simd};
use rustfft::Fft;
use rustfft::num_complex::Complex;
use rustfft::num_traits::Zero;
use std::sync::Arc;

/// Row pairs of a field in a batch; larger leaves the nearest cache, smaller passes over the sums more often.
const PAIRS_PER_BATCH: usize = 4;

/// The row-wise engine of one PSF.
pub(super) struct Rowwise<T: Scalar> {
    geometry: Geometry,
    /// `Q_d` for each row displacement, smallest first.
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
    /// The row pairs of a batch, packed, or their spectra.
    lines: Vec<Complex<T>>,
    /// First field row of each pair in `lines`.
    pairs: Vec<usize>,
    fft: Vec<Complex<T>>,
}

impl<T: Scalar> Rowwise<T> {
    pub fn new(geometry: &Geometry, psf: &Psf) -> Self {
        let length = geometry.fft_columns();
        let (forward, inverse) = T::complex_transforms(length);
        let displacements = geometry.rows + geometry.field_rows - 1;
        let mut spectra = vec![Complex::zero(); displacements * length];
        // The transforms are not normalised, so the kernels contain the factor 1/length.
        let scale = T::nearest(1.0 / length as f64);
        let mut previous = vec![T::zero(); length];
        for (d, spectrum) in spectra.chunks_exact_mut(length).enumerate() {
            let dy = d as isize + geometry.row_displacement(0, geometry.field_rows - 1);
            let value = |x, field_x| -> T {
                let dx = geometry.column_displacement(x, field_x);
                T::from(psf.at_displacement(dy, dx)) * scale
            };
            // The light of field column x' stands at index x' of a line, and its image at index x. So kernel index
            // `x − x'` holds the displacement `x − x' + ox`. Negative indices wrap around to the end.
            for (x, element) in spectrum[..geometry.columns].iter_mut().enumerate() {
                element.re = value(x, 0);
            }
            for x in 1..geometry.field_columns {
                spectrum[length - x].re = value(0, x);
            }
            for (element, previous) in spectrum.iter_mut().zip(&mut previous) {
                element.im = -*previous;
                *previous = element.re;
            }
        }
        forward.process(&mut spectra);
        Self {
            geometry: geometry.clone(),
            kernels: spectra,
            length,
            forward,
            inverse,
        }
    }

    pub fn scratch(&self) -> Scratch<T> {
        let fft = self
            .forward
            .get_inplace_scratch_len()
            .max(self.inverse.get_inplace_scratch_len());
        Scratch {
            sums: Vec::new(),
            light: vec![T::zero(); 2 * PAIRS_PER_BATCH * self.geometry.field_columns],
            lines: vec![Complex::zero(); PAIRS_PER_BATCH * self.length],
            pairs: Vec::with_capacity(PAIRS_PER_BATCH),
            fft: vec![Complex::zero(); fft],
        }
    }

    /// `Q_d` from the field rows `y` and `y + 1` to sensor row `r`.
    fn kernel(&self, r: usize, y: usize) -> &[Complex<T>] {
        let d = r + self.geometry.field_rows - 1 - y;
        &self.kernels[d * self.length..(d + 1) * self.length]
    }

    /// Bytes of the PSF's spectra.
    pub fn spectrum_bytes(&self) -> usize {
        size_of_val(self.kernels.as_slice())
    }

    /// Computes the row values of all `jobs`.
    pub fn apply_batch(&self, jobs: &mut [ForwardJob<T>], scratch: &mut Scratch<T>) {
        let (columns, field_columns) = (self.geometry.columns, self.geometry.field_columns);
        let lines = jobs.iter().map(|job| job.rows.len()).sum::<usize>();
        scratch.sums.clear();
        scratch.sums.resize(lines * self.length, Complex::zero());
        for first in (0..self.geometry.field_rows).step_by(2 * PAIRS_PER_BATCH) {
            let end = self.geometry.field_rows.min(first + 2 * PAIRS_PER_BATCH);
            let mut offset = 0;
            // All jobs take these rows in turn, since they need nearly the same kernels.
            for job in &*jobs {
                let light = &job.light[first * field_columns..end * field_columns];
                self.add_pairs(light, first, job.rows, offset, scratch);
                offset += job.rows.len() * self.length;
            }
        }
        self.inverse
            .process_with_scratch(&mut scratch.sums, &mut scratch.fft);
        let lines = jobs
            .iter_mut()
            .flat_map(|job| job.values.chunks_exact_mut(columns));
        for (values, sum) in lines.zip(scratch.sums.chunks_exact(self.length)) {
            values.iter_mut().zip(sum).for_each(|(v, s)| *v = s.re);
        }
    }

    /// Adds the contribution of some field rows to the sums of the sensor rows `rows`.
    ///
    /// `light` holds the field rows from row `first` on; the sums begin at `offset` in `scratch.sums`.
    fn add_pairs(
        &self,
        light: &[T],
        first: usize,
        rows: &[usize],
        offset: usize,
        scratch: &mut Scratch<T>,
    ) {
        let field_columns = self.geometry.field_columns;
        scratch.pairs.clear();
        for (i, row_pair) in light.chunks(2 * field_columns).enumerate() {
            // Most rows of a sparse video are zero.
            if !is_dark(row_pair) {
                let start = scratch.pairs.len() * self.length;
                let line = &mut scratch.lines[start..start + self.length];
                pack(row_pair, field_columns, line);
                scratch.pairs.push(first + 2 * i);
            }
        }
        let lines = &mut scratch.lines[..scratch.pairs.len() * self.length];
        self.forward.process_with_scratch(lines, &mut scratch.fft);
        let sums = scratch.sums[offset..].chunks_exact_mut(self.length);
        for (&r, sum) in rows.iter().zip(sums) {
            for (&y, line) in scratch.pairs.iter().zip(lines.chunks_exact(self.length)) {
                add_products(sum, line, self.kernel(r, y));
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
        let lines = jobs.iter().map(|job| job.rows.len()).sum::<usize>();
        scratch.sums.resize(lines * self.length, Complex::zero());
        let values = jobs.iter().flat_map(|job| job.values.chunks_exact(columns));
        for (values, line) in values.zip(scratch.sums.chunks_exact_mut(self.length)) {
            pack(values, columns, line);
        }
        self.forward
            .process_with_scratch(&mut scratch.sums, &mut scratch.fft);
        for first in (0..self.geometry.field_rows).step_by(2 * PAIRS_PER_BATCH) {
            let end = self.geometry.field_rows.min(first + 2 * PAIRS_PER_BATCH);
            let mut offset = 0;
            for (i, job) in jobs.iter().enumerate() {
                scratch.pairs.clear();
                for y in (first..end).step_by(2) {
                    let pixels = y * field_columns..end.min(y + 2) * field_columns;
                    if job.mask.is_none_or(|mask| mask[pixels].contains(&1)) {
                        scratch.pairs.push(y);
                    }
                }
                self.compute_pairs(job.rows, offset, scratch);
                // Neighbouring pairs are written together.
                let mut written_rows = 0;
                let pairs = std::mem::take(&mut scratch.pairs);
                for run in pairs.chunk_by(|a, b| a + 2 == *b) {
                    let start = run[0] * field_columns;
                    let stop = end.min(run[run.len() - 1] + 2) * field_columns;
                    let light = &mut scratch.light[written_rows * field_columns..];
                    write(i, start, &mut light[..stop - start]);
                    written_rows += 2 * run.len();
                }
                scratch.pairs = pairs;
                offset += job.rows.len() * self.length;
            }
        }
    }

    /// Computes the light of the row pairs in `scratch.pairs` from the spectra of the sensor rows `rows`.
    ///
    /// The spectra begin at `offset` in `scratch.sums`; the pairs follow one another in `scratch.light`.
    fn compute_pairs(&self, rows: &[usize], offset: usize, scratch: &mut Scratch<T>) {
        let field_columns = self.geometry.field_columns;
        let lines = &mut scratch.lines[..scratch.pairs.len() * self.length];
        lines.fill(Complex::zero());
        let pairs = scratch.pairs.iter();
        for (&y, line) in pairs.zip(lines.chunks_exact_mut(self.length)) {
            let spectra = scratch.sums[offset..].chunks_exact(self.length);
            for (&r, spectrum) in rows.iter().zip(spectra) {
                add_conjugate_products(line, self.kernel(r, y), spectrum);
            }
        }
        self.inverse.process_with_scratch(lines, &mut scratch.fft);
        let light = scratch.light.chunks_exact_mut(2 * field_columns);
        for (line, light) in lines.chunks_exact(self.length).zip(light) {
            unpack(line, field_columns, light);
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
