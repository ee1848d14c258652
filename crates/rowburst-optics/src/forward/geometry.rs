//! Sizes and displacements of sensor and field, and the lengths of the FFTs that convolve on them.

use crate::Camera;
use rowburst_core::linop::Scalar;
use rowburst_core::vecmath::is_portable;
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
    #[inline]
    pub fn row_displacement(&self, r: usize, y: usize) -> isize {
        r as isize - y as isize + self.offset_rows as isize
    }

    /// Column displacement from field column `x'` to sensor column `x`.
    #[inline]
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
