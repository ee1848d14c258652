//! Sizes and displacements of sensor and field, and the lengths of the FFTs that convolve on them.

use crate::Camera;
use rowburst_core::fft::smooth_even_length;

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
        smooth_even_length(self.columns + self.field_columns - 1)
    }

    /// FFT length along y at which a circular convolution does not wrap around.
    pub fn fft_rows(&self) -> usize {
        smooth_even_length(self.rows + self.field_rows - 1)
    }
}
