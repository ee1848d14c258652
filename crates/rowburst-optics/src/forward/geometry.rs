//! Sizes and displacements of sensor and field, and the lengths of the FFTs that convolve on them.

use crate::Camera;
use rowburst_core::fft::{fast_length, smooth_even_length};
use std::ops::Range;

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

    /// The same for a PSF that is zero outside of the column displacements `extent`: wrapped light falls where no pixel of the
    /// sensor is read from one of the field.
    pub fn fft_columns_for(&self, extent: &Range<isize>) -> usize {
        let (columns, field_columns) = (self.columns as isize, self.field_columns as isize);
        let kernel = self.kernel_columns(extent);
        // Pixels are `1 − field_columns` to `columns − 1` apart; one period further the kernel has to be zero.
        let least = (columns - kernel.start).max(field_columns + kernel.end - 1);
        let least = least.max(columns).max(field_columns);
        self.fft_columns().min(fast_length(least as usize))
    }

    /// Differences `x − x'` of a sensor and a field column whose displacement is in `extent`.
    pub fn kernel_columns(&self, extent: &Range<isize>) -> Range<isize> {
        let (first, end) = (1 - self.field_columns as isize, self.columns as isize);
        let of =
            |displacement: isize| (displacement - self.offset_columns as isize).clamp(first, end);
        of(extent.start)..of(extent.end)
    }

    /// FFT length along y at which a circular convolution does not wrap around.
    pub fn fft_rows(&self) -> usize {
        smooth_even_length(self.rows + self.field_rows - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transforms_are_as_short_as_the_psf_allows() {
        let geometry = Geometry {
            rows: 1,
            columns: 160,
            field_rows: 1,
            field_columns: 160,
            offset_rows: 0,
            offset_columns: 0,
        };
        assert_eq!(geometry.fft_columns(), 320);
        let lengths = [
            (-80..80, 240),
            (-159..160, 320),
            (-500..500, 320),
            // 300 points are fewer, and take longer.
            (-140..140, 320),
            (0..1, 160),
            (-159..-150, 320),
            (100..120, 288),
            (200..210, 320),
            (-210..-200, 320),
        ];
        for (extent, length) in lengths {
            assert_eq!(geometry.fft_columns_for(&extent), length, "{extent:?}");
        }
    }
}
