//! Convolution of only the rows that are read: FFTs along x, sums along y.
//!
//! Row `r` of the convolution needs every field row once:
//! `B_r(f) = Σ_y V_y(f) · P_{r−sy(y)}(f)`, with `V_y`, `P_d` the spectra along x
//! of a field row and of a PSF row. No FFT along y, no padded plane.
//!
//! Field rows go in pairs, as the real and the imaginary part of one complex line with the spectrum
//! `Z = V_y + i V_{y+1}`; with `Q_d = P_d − i P_{d−1}` for the pair of PSF rows
//!
//! ```text
//! b_r = Re F⁻¹ Σ_pairs Z Q_d            v_y + i v_{y+1} = F⁻¹ Σ_r B_r Q_d*
//! ```
//!
//! forward and adjoint: `Re F⁻¹` keeps of `Z Q = V_y P_d + V_{y+1} P_{d−1} + i (V_{y+1} P_d − V_y P_{d−1})`
//! what is the spectrum of a real line. One complex transform for two rows, and nothing is ever taken apart.

use super::engine::{AdjointJob, ForwardJob, Geometry, transforms};
use crate::Psf;
use crate::linop::Scalar;
use crate::vecmath::{add_conjugate_products, add_products, simd};
use rustfft::Fft;
use rustfft::num_complex::Complex;
use rustfft::num_traits::Zero;
use std::sync::Arc;

/// Pairs of rows of a field that are transformed at once: their spectra stay in the nearest cache. After them come those of
/// the next field, which need nearly the same spectra of the PSF.
const PAIRS_PER_BATCH: usize = 4;

pub(super) struct Rowwise<T: Scalar> {
    geometry: Geometry,
    /// `Q_d` for each row displacement, smallest first.
    psf: Vec<Complex<T>>,
    length: usize,
    forward: Arc<dyn Fft<T>>,
    inverse: Arc<dyn Fft<T>>,
}

pub(super) struct Scratch<T> {
    /// A line for each sensor row that is read, field after field.
    sums: Vec<Complex<T>>,
    /// Rows of a field.
    light: Vec<T>,
    /// Pairs of field rows, and where they begin.
    lines: Vec<Complex<T>>,
    pairs: Vec<usize>,
    fft: Vec<Complex<T>>,
}

impl<T: Scalar> Rowwise<T> {
    pub fn new(geometry: &Geometry, psf: &Psf) -> Self {
        let length = geometry.fft_columns();
        let (forward, inverse) = transforms::<T>(length);
        let displacements = geometry.rows + geometry.field_rows - 1;
        let mut spectra = vec![Complex::zero(); displacements * length];
        // The transforms are not normalised: the kernel carries 1/length.
        let scale = T::nearest(1.0 / length as f64);
        let mut before = vec![T::zero(); length];
        for (d, spectrum) in spectra.chunks_exact_mut(length).enumerate() {
            let dy = d as isize + geometry.row_displacement(0, geometry.field_rows - 1);
            let value = |x, field_x| -> T {
                let dx = geometry.column_displacement(x, field_x);
                T::from(psf.at_displacement(dy, dx)) * scale
            };
            // A field pixel stands at its own index x', so index i of the kernel is the
            // displacement i + ox; negative indices wrap around to the end.
            for (x, to) in spectrum[..geometry.columns].iter_mut().enumerate() {
                to.re = value(x, 0);
            }
            for x in 1..geometry.field_columns {
                spectrum[length - x].re = value(0, x);
            }
            for (to, before) in spectrum.iter_mut().zip(&mut before) {
                to.im = -*before;
                *before = to.re;
            }
        }
        forward.process(&mut spectra);
        Self {
            geometry: geometry.clone(),
            psf: spectra,
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

    /// `Q_d` that leads from field rows `y` and `y + 1` to sensor row `r`.
    fn kernel(&self, r: usize, y: usize) -> &[Complex<T>] {
        let d = r + self.geometry.field_rows - 1 - y;
        &self.psf[d * self.length..(d + 1) * self.length]
    }

    /// Bytes of the PSF's spectra.
    pub fn bytes(&self) -> usize {
        size_of_val(self.psf.as_slice())
    }

    pub fn read(&self, fields: &mut [ForwardJob<T>], scratch: &mut Scratch<T>) {
        let (columns, field_columns) = (self.geometry.columns, self.geometry.field_columns);
        let lines = fields.iter().map(|field| field.rows.len()).sum::<usize>();
        scratch.sums.clear();
        scratch.sums.resize(lines * self.length, Complex::zero());
        for first in (0..self.geometry.field_rows).step_by(2 * PAIRS_PER_BATCH) {
            let end = self.geometry.field_rows.min(first + 2 * PAIRS_PER_BATCH);
            let mut at = 0;
            for field in &*fields {
                let light = &field.light[first * field_columns..end * field_columns];
                self.add_pairs(light, first, field.rows, at, scratch);
                at += field.rows.len() * self.length;
            }
        }
        self.inverse
            .process_with_scratch(&mut scratch.sums, &mut scratch.fft);
        let lines = fields
            .iter_mut()
            .flat_map(|field| field.values.chunks_exact_mut(columns));
        for (values, sum) in lines.zip(scratch.sums.chunks_exact(self.length)) {
            values.iter_mut().zip(sum).for_each(|(v, s)| *v = s.re);
        }
    }

    /// Adds what some pairs of field rows, from row `first` on, send to `rows`, whose sums begin at `at`.
    fn add_pairs(
        &self,
        light: &[T],
        first: usize,
        rows: &[usize],
        at: usize,
        scratch: &mut Scratch<T>,
    ) {
        let field_columns = self.geometry.field_columns;
        scratch.pairs.clear();
        for (i, row_pair) in light.chunks(2 * field_columns).enumerate() {
            // Recovered scenes are sparse: most rows of most bins are dark.
            if !is_dark(row_pair) {
                let place = scratch.pairs.len() * self.length;
                let line = &mut scratch.lines[place..place + self.length];
                pack(row_pair, field_columns, line);
                scratch.pairs.push(first + 2 * i);
            }
        }
        let lines = &mut scratch.lines[..scratch.pairs.len() * self.length];
        self.forward.process_with_scratch(lines, &mut scratch.fft);
        let sums = scratch.sums[at..].chunks_exact_mut(self.length);
        for (&r, sum) in rows.iter().zip(sums) {
            for (&y, line) in scratch.pairs.iter().zip(lines.chunks_exact(self.length)) {
                add_products(sum, line, self.kernel(r, y));
            }
        }
    }

    /// Calls `write(field, start, light)` for all pairs of rows that are not dark in their mask: some pixels of the
    /// light of a field, from `start` on.
    pub fn spread(
        &self,
        fields: &[AdjointJob<T>],
        scratch: &mut Scratch<T>,
        mut write: impl FnMut(usize, usize, &mut [T]),
    ) {
        let (columns, field_columns) = (self.geometry.columns, self.geometry.field_columns);
        let lines = fields.iter().map(|field| field.rows.len()).sum::<usize>();
        scratch.sums.resize(lines * self.length, Complex::zero());
        let values = fields
            .iter()
            .flat_map(|field| field.values.chunks_exact(columns));
        for (values, line) in values.zip(scratch.sums.chunks_exact_mut(self.length)) {
            pack(values, columns, line);
        }
        self.forward
            .process_with_scratch(&mut scratch.sums, &mut scratch.fft);
        for first in (0..self.geometry.field_rows).step_by(2 * PAIRS_PER_BATCH) {
            let end = self.geometry.field_rows.min(first + 2 * PAIRS_PER_BATCH);
            let mut at = 0;
            for (i, field) in fields.iter().enumerate() {
                scratch.pairs.clear();
                for y in (first..end).step_by(2) {
                    let pixels = y * field_columns..end.min(y + 2) * field_columns;
                    if field.mask.is_none_or(|mask| mask[pixels].contains(&1)) {
                        scratch.pairs.push(y);
                    }
                }
                self.make_pairs(field.rows, at, scratch);
                // Neighbouring pairs are written together.
                let mut made = 0;
                let pairs = std::mem::take(&mut scratch.pairs);
                for run in pairs.chunk_by(|a, b| a + 2 == *b) {
                    let start = run[0] * field_columns;
                    let stop = end.min(run[run.len() - 1] + 2) * field_columns;
                    let light = &mut scratch.light[made * field_columns..];
                    write(i, start, &mut light[..stop - start]);
                    made += 2 * run.len();
                }
                scratch.pairs = pairs;
                at += field.rows.len() * self.length;
            }
        }
    }

    /// The light of the pairs of rows that are waiting, one after another, from the spectra of `rows`, which begin at
    /// `at`.
    fn make_pairs(&self, rows: &[usize], at: usize, scratch: &mut Scratch<T>) {
        let field_columns = self.geometry.field_columns;
        let lines = &mut scratch.lines[..scratch.pairs.len() * self.length];
        lines.fill(Complex::zero());
        let waiting = scratch.pairs.iter();
        for (&y, line) in waiting.zip(lines.chunks_exact_mut(self.length)) {
            let spectra = scratch.sums[at..].chunks_exact(self.length);
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

/// Whether all is zero.
fn is_dark<T: Scalar>(values: &[T]) -> bool {
    let is_zero = |part: &[T]| part.iter().fold(true, |dark, v| dark & (*v == T::zero()));
    values.chunks(32).all(is_zero)
}

/// One or two rows of `columns` values as the real and the imaginary part of `line`, with zeros behind.
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

/// The real and, where there is place for it, the imaginary part of `line` into rows of `columns` values.
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
