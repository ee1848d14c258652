//! Two ways to convolve one instant's light and keep some rows, and the choice.

use super::{planar::Planar, rowwise::Rowwise};
use crate::linop::Scalar;
use crate::vecmath::is_portable;
use crate::{Camera, Psf};
use rustfft::{Fft, FftPlanner, FftPlannerScalar};
use std::sync::Arc;

/// Sizes of the whole sensor and of the field, and how they lie on each other.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Geometry {
    pub rows: usize,
    pub columns: usize,
    pub field_rows: usize,
    pub field_columns: usize,
    pub offset_rows: usize,
    pub offset_columns: usize,
}

impl Geometry {
    pub fn new(camera: &Camera) -> Self {
        let (field_rows, field_columns) = camera.field();
        let (offset_rows, offset_columns) = camera.field_offset();
        Self {
            rows: camera.params().rows,
            columns: camera.columns(),
            field_rows,
            field_columns,
            offset_rows,
            offset_columns,
        }
    }

    /// Row displacement from field row `y` to sensor row `r`.
    pub fn row_displacement(&self, r: usize, y: usize) -> isize {
        r as isize - y as isize + self.offset_rows as isize
    }

    /// Column displacement from field column `x'` to sensor column `x`.
    pub fn column_displacement(&self, x: usize, field_x: usize) -> isize {
        x as isize - field_x as isize + self.offset_columns as isize
    }

    /// FFT length along x at which a circular convolution does not wrap around.
    pub fn fft_columns(&self) -> usize {
        smooth_length(self.columns + self.field_columns - 1)
    }

    /// FFT length along y at which a circular convolution does not wrap around.
    pub fn fft_rows(&self) -> usize {
        smooth_length(self.rows + self.field_rows - 1)
    }
}

/// The cheaper of the two ways for this geometry.
pub(super) enum Engine<T: Scalar> {
    Rowwise(Rowwise<T>),
    Planar(Planar<T>),
}

/// Work space of one thread.
pub(super) enum Scratch<T> {
    Rowwise(super::rowwise::Scratch<T>),
    /// With the light of a field.
    Planar(super::planar::Scratch<T>, Vec<T>),
}

/// The light of a field, and the rows of the sensor that read it: `values[i, x]` is row `rows[i]` of the convolved
/// light.
pub(super) struct ForwardJob<'a, T> {
    pub light: &'a [T],
    pub rows: &'a [usize],
    pub values: &'a mut [T],
}

/// The adjoint: what `values` of some rows send back to a field. Rows of it that are dark in `mask` are not wanted.
pub(super) struct AdjointJob<'a, T> {
    pub values: &'a [T],
    pub rows: &'a [usize],
    pub mask: Option<&'a [u8]>,
}

impl<T: Scalar> Engine<T> {
    pub fn cheapest(geometry: &Geometry, psf: &Psf, rows_of: &[Vec<usize>]) -> Self {
        // Real operations per x-frequency: 8 for a complex multiply–add, 5 n log2 n
        // for a complex FFT of length n, there and back.
        let reads: usize = rows_of.iter().map(Vec::len).sum();
        let rowwise = 8.0 * (reads * geometry.field_rows) as f64;
        let n = geometry.fft_rows() as f64;
        let planar = rows_of.len() as f64 * 10.0 * n * n.log2();
        if rowwise <= planar {
            Self::Rowwise(Rowwise::new(geometry, psf))
        } else {
            Self::Planar(Planar::new(geometry, psf))
        }
    }

    pub fn scratch(&self) -> Scratch<T> {
        match self {
            Self::Rowwise(engine) => Scratch::Rowwise(engine.scratch()),
            Self::Planar(engine) => Scratch::Planar(engine.scratch(), Vec::new()),
        }
    }

    /// Bytes that each field is multiplied by nearly the same of.
    pub fn bytes(&self) -> usize {
        match self {
            Self::Rowwise(engine) => engine.bytes(),
            Self::Planar(_) => 0,
        }
    }

    /// Writes the values of all `fields`.
    pub fn read(&self, fields: &mut [ForwardJob<T>], scratch: &mut Scratch<T>) {
        match (self, scratch) {
            (Self::Rowwise(engine), Scratch::Rowwise(s)) => engine.read(fields, s),
            (Self::Planar(engine), Scratch::Planar(s, _)) => {
                for field in fields {
                    engine.read(field.light, field.rows, field.values, s);
                }
            }
            _ => unreachable!("scratch comes from the same engine"),
        }
    }

    /// The adjoint of [`Self::read`]. Calls `write(field, start, light)` for pieces of the light of each field, in
    /// whole rows from pixel `start` on, until all that is wanted was written.
    pub fn spread(
        &self,
        fields: &[AdjointJob<T>],
        scratch: &mut Scratch<T>,
        mut write: impl FnMut(usize, usize, &mut [T]),
    ) {
        match (self, scratch) {
            (Self::Rowwise(engine), Scratch::Rowwise(s)) => engine.spread(fields, s, write),
            (Self::Planar(engine), Scratch::Planar(s, light)) => {
                light.resize(engine.field_pixels(), T::zero());
                for (i, field) in fields.iter().enumerate() {
                    engine.spread(field.values, field.rows, light, s);
                    write(i, 0, light);
                }
            }
            _ => unreachable!("scratch comes from the same engine"),
        }
    }
}

/// The complex transforms of a length, there and back, by what the processor has.
pub(super) fn transforms<T: Scalar>(length: usize) -> (Arc<dyn Fft<T>>, Arc<dyn Fft<T>>) {
    if is_portable() {
        let mut planner = FftPlannerScalar::new();
        (
            planner.plan_fft_forward(length),
            planner.plan_fft_inverse(length),
        )
    } else {
        let mut planner = FftPlanner::new();
        (
            planner.plan_fft_forward(length),
            planner.plan_fft_inverse(length),
        )
    }
}

/// Smallest even length ≥ `length` whose only prime factors are 2, 3 and 5: the
/// lengths at which the FFT crate is fastest.
pub(super) fn smooth_length(length: usize) -> usize {
    let is_smooth = |mut n: usize| {
        for factor in [2, 3, 5] {
            while n.is_multiple_of(factor) {
                n /= factor;
            }
        }
        n == 1
    };
    (length.max(2)..)
        .find(|&n| n.is_multiple_of(2) && is_smooth(n))
        .expect("a smooth number lies below twice any number")
}
