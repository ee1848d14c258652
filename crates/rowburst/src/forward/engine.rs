//! The two convolution engines, row-wise and planar, and the choice between them.
//!
//! An engine convolves the light of an instant with a PSF and keeps the rows that the instant reads.

use super::{planar::Planar, rowwise::Rowwise};
use crate::linop::Scalar;
use crate::vecmath::is_portable;
use crate::{Camera, Psf};
use rustfft::{Fft, FftPlanner, FftPlannerScalar};
use std::sync::Arc;

/// Sizes of the whole sensor and of the field, and the offset of the field (see [`Camera::field_offset`]).
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

/// A convolution with one PSF.
pub(super) enum Engine<T: Scalar> {
    Rowwise(Rowwise<T>),
    Planar(Planar<T>),
}

/// Buffers of one thread.
pub(super) enum Scratch<T> {
    Rowwise(super::rowwise::Scratch<T>),
    Planar {
        engine: super::planar::Scratch<T>,
        /// Light of the field.
        light: Vec<T>,
    },
}

/// Forward product of one instant: `values[i, x]` becomes sensor row `rows[i]` of the convolved `light` `[y, x]`.
pub(super) struct ForwardJob<'a, T> {
    pub light: &'a [T],
    pub rows: &'a [usize],
    pub values: &'a mut [T],
}

/// Adjoint product of one instant: from `values[i, x]` in sensor row `rows[i]` to the light of the field.
///
/// Field rows that are zero in `mask` need not be computed.
pub(super) struct AdjointJob<'a, T> {
    pub values: &'a [T],
    pub rows: &'a [usize],
    pub mask: Option<&'a [u8]>,
}

impl<T: Scalar> Engine<T> {
    /// The engine with the lower operation count for instants that read `sensor_rows_of`.
    pub fn cheapest(geometry: &Geometry, psf: &Psf, sensor_rows_of: &[Vec<usize>]) -> Self {
        // Real operations per x-frequency: 8 for a complex multiply–add, and 5 n log2 n for each of two complex FFTs
        // of length n.
        let reads: usize = sensor_rows_of.iter().map(Vec::len).sum();
        let rowwise = 8.0 * (reads * geometry.field_rows) as f64;
        let n = geometry.fft_rows() as f64;
        let planar = sensor_rows_of.len() as f64 * 10.0 * n * n.log2();
        if rowwise <= planar {
            Self::Rowwise(Rowwise::new(geometry, psf))
        } else {
            Self::Planar(Planar::new(geometry, psf))
        }
    }

    pub fn scratch(&self) -> Scratch<T> {
        match self {
            Self::Rowwise(engine) => Scratch::Rowwise(engine.scratch()),
            Self::Planar(engine) => Scratch::Planar {
                engine: engine.scratch(),
                light: Vec::new(),
            },
        }
    }

    /// Bytes of PSF spectra that instants in a batch can share; 0 if the engine takes instants one by one.
    pub fn shared_spectrum_bytes(&self) -> usize {
        match self {
            Self::Rowwise(engine) => engine.spectrum_bytes(),
            Self::Planar(_) => 0,
        }
    }

    /// Computes the row values of all `jobs`.
    pub fn apply_batch(&self, jobs: &mut [ForwardJob<T>], scratch: &mut Scratch<T>) {
        match (self, scratch) {
            (Self::Rowwise(engine), Scratch::Rowwise(s)) => engine.apply_batch(jobs, s),
            (Self::Planar(engine), Scratch::Planar { engine: s, .. }) => {
                for job in jobs {
                    engine.apply(job.light, job.rows, job.values, s);
                }
            }
            _ => unreachable!("scratch comes from the same engine"),
        }
    }

    /// The adjoint of [`Self::apply_batch`].
    ///
    /// Calls `write(job, start, light)` for pieces of the light of each job: whole field rows from pixel `start` on.
    /// Each row that has an active pixel in the job's mask is written once; other rows may be left out.
    pub fn adjoint_batch(
        &self,
        jobs: &[AdjointJob<T>],
        scratch: &mut Scratch<T>,
        mut write: impl FnMut(usize, usize, &mut [T]),
    ) {
        match (self, scratch) {
            (Self::Rowwise(engine), Scratch::Rowwise(s)) => engine.adjoint_batch(jobs, s, write),
            (Self::Planar(engine), Scratch::Planar { engine: s, light }) => {
                light.resize(engine.field_pixels(), T::zero());
                for (i, job) in jobs.iter().enumerate() {
                    engine.adjoint(job.values, job.rows, light, s);
                    write(i, 0, light);
                }
            }
            _ => unreachable!("scratch comes from the same engine"),
        }
    }
}

/// The forward and the inverse complex FFT of a length; scalar code if [`is_portable`].
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

/// Smallest even number ≥ `length` whose only prime factors are 2, 3 and 5: FFTs of such lengths are fast.
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
