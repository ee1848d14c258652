//! The point-spread function.

use crate::Image;
use rowburst_core::{Error, ErrorKind, Parameter, Result};
use std::ops::Range;
use std::sync::Arc;

/// Largest distance from 1 of the sum of a stored PSF; larger admits PSFs that were never normalized.
const MAX_STORED_SUM_ERROR: f64 = 1e-3;

/// A non-negative point-spread function that sums to 1.
///
/// The element at `(rows/2, columns/2)` (integer division) is zero displacement;
/// displacements that it does not cover are zero (Eq. 1: true convolution, no
/// wrap-around). It may be smaller or larger than the sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct Psf {
    /// Shared by all clones: operators and patch sets hold their own.
    image: Arc<Image>,
    capture: Option<PsfCapture>,
}

/// How a PSF was captured: what it may be wrong by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PsfCapture {
    /// Variance of the noise of a pixel of the capture over its light, where the light sums to 1.
    pub noise_per_light: f64,
    /// Diameter in pixels of the image of the pinhole whose blur was removed; 0: none was.
    pub pinhole_px: f64,
}

impl Psf {
    /// Checks `image` and scales it to sum to 1.
    ///
    /// # Errors
    /// A value that is not finite or negative, or an image that is zero everywhere.
    pub fn new(mut image: Image) -> Result<Self> {
        if let Some((y, x)) = image.first_non_finite() {
            return Err(Error::input(
                Parameter::Psf,
                format!("{} at row {y}, column {x}", image.at(y, x)),
                "every value of a PSF is a finite number",
                "Replace the pixel by the mean of its neighbours, or record the PSF again.",
            )
            .with_kind(ErrorKind::NotFinite));
        }
        if let Some(at) = image.data().iter().position(|&p| p < 0.0) {
            let (y, x) = (at / image.columns(), at % image.columns());
            return Err(Error::input(
                Parameter::Psf,
                format!("{} at row {y}, column {x}", image.at(y, x)),
                "a PSF is an intensity and never negative",
                "Subtract a smaller background, and set what is left below zero to zero.",
            ));
        }
        let sum: f64 = image.data().iter().map(|&p| f64::from(p)).sum();
        if sum <= 0.0 || !sum.is_finite() {
            return Err(Error::input(
                Parameter::Psf,
                format!("a sum of {sum}"),
                "a PSF holds light",
                "Check the exposure of the capture, and that the background taken from it is not too large.",
            ));
        }
        for p in image.data_mut() {
            *p = (f64::from(*p) / sum) as f32;
        }
        Ok(Self {
            image: Arc::new(image),
            capture: None,
        })
    }

    /// The PSF with the values of [`Psf::image`], bit for bit: they are not scaled again. For stored PSFs.
    ///
    /// # Errors
    /// Those of [`Psf::new`], and values that do not sum to 1.
    pub fn from_normalized(image: Image) -> Result<Self> {
        let sum: f64 = image.data().iter().map(|&p| f64::from(p)).sum();
        if (sum - 1.0).abs() > MAX_STORED_SUM_ERROR {
            return Err(Error::input(
                Parameter::Psf,
                format!("a sum of {sum}"),
                "a stored PSF sums to 1",
                "Read the PSF again from its capture.",
            ));
        }
        Self::new(image.clone())?;
        Ok(Self {
            image: Arc::new(image),
            capture: None,
        })
    }

    /// The values, summing to 1.
    #[inline]
    pub fn image(&self) -> &Image {
        &self.image
    }

    /// The same PSF, of which `capture` is known.
    #[must_use]
    pub fn with_capture(mut self, capture: Option<PsfCapture>) -> Self {
        self.capture = capture;
        self
    }

    /// What is known of its capture.
    #[inline]
    pub fn capture(&self) -> Option<PsfCapture> {
        self.capture
    }

    /// The value at displacement `(dy, dx)` in pixels; zero where it is not covered.
    #[inline]
    pub fn at_displacement(&self, dy: isize, dx: isize) -> f32 {
        let y = dy + (self.image.rows() / 2) as isize;
        let x = dx + (self.image.columns() / 2) as isize;
        let inside = (0..self.image.rows() as isize).contains(&y)
            && (0..self.image.columns() as isize).contains(&x);
        if inside {
            self.image.at(y as usize, x as usize)
        } else {
            0.0
        }
    }

    /// The smallest ranges of displacements that hold all of its light.
    pub(crate) fn extent(&self) -> Extent {
        let (rows, columns) = (self.image.rows(), self.image.columns());
        let (mut in_rows, mut in_columns) = (rows..0, columns..0);
        for (y, row) in self.image.data().chunks_exact(columns).enumerate() {
            let Some(first) = row.iter().position(|v| *v != 0.0) else {
                continue;
            };
            let last = row.iter().rposition(|v| *v != 0.0).unwrap_or(first);
            in_rows = in_rows.start.min(y)..y + 1;
            in_columns = in_columns.start.min(first)..in_columns.end.max(last + 1);
        }
        let about_centre = |range: Range<usize>, length: usize| {
            let centre = (length / 2) as isize;
            range.start as isize - centre..range.end as isize - centre
        };
        Extent {
            rows: about_centre(in_rows, rows),
            columns: about_centre(in_columns, columns),
        }
    }
}

/// Displacements outside of which a PSF is zero.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Extent {
    pub rows: Range<isize>,
    pub columns: Range<isize>,
}

/// A stretch of a row of a PSF.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowSlice<'a> {
    /// How many displacements that the PSF does not cover lie before it.
    pub start: usize,
    /// The values from there on to the end of the row; displacements beyond are zero.
    pub values: &'a [f32],
}

impl Psf {
    /// The values at the displacements `(dy, dx)`, `(dy, dx + 1)`, … that it covers.
    #[inline]
    pub fn row_from(&self, dy: isize, dx: isize) -> RowSlice<'_> {
        let columns = self.image.columns();
        let y = dy + (self.image.rows() / 2) as isize;
        let x = dx + (columns / 2) as isize;
        if !(0..self.image.rows() as isize).contains(&y) || x >= columns as isize {
            return RowSlice {
                start: 0,
                values: &[],
            };
        }
        let row = &self.image.data()[y as usize * columns..(y as usize + 1) * columns];
        RowSlice {
            start: (-x).max(0) as usize,
            values: &row[x.max(0) as usize..],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_to_one_and_is_centred_by_integer_division() {
        let psf = Psf::new(Image::from_fn(4, 5, |y, x| (y * 5 + x) as f32)).unwrap();
        let sum: f32 = psf.image().data().iter().sum();
        assert!((sum - 1.0).abs() < 1e-6);
        assert_eq!(psf.at_displacement(0, 0), psf.image().at(2, 2));
        assert_eq!(psf.at_displacement(2, 0), 0.0);
        assert_eq!(psf.at_displacement(-2, 2), psf.image().at(0, 4));
    }

    #[test]
    fn extent_leaves_out_dark_edges_alone() {
        let light = |y: usize, x: usize| f32::from(matches!((y, x), (1, 3) | (2, 1)));
        let extent = |value: &dyn Fn(usize, usize) -> f32| {
            let extent = Psf::new(Image::from_fn(4, 5, value)).unwrap().extent();
            (extent.rows, extent.columns)
        };
        assert_eq!(extent(&light), (-1..1, -1..2));
        assert_eq!(extent(&|_, _| 1.0), (-2..2, -2..3));
    }

    #[test]
    fn rows_are_runs_of_displacements() {
        let psf = Psf::new(Image::from_fn(4, 5, |y, x| (y * 5 + x) as f32)).unwrap();
        for dy in -4..5 {
            for dx in -9..9 {
                let stretch = psf.row_from(dy, dx);
                for i in 0..12usize {
                    let value = i
                        .checked_sub(stretch.start)
                        .and_then(|i| stretch.values.get(i));
                    let expected = psf.at_displacement(dy, dx + i as isize);
                    assert_eq!(value.copied().unwrap_or(0.0), expected, "{dy} {dx} {i}");
                }
            }
        }
    }

    #[test]
    fn bad_values_are_refused() {
        for bad in [f32::NAN, f32::INFINITY, -1e-3] {
            let mut image = Image::from_fn(3, 3, |_, _| 1.0);
            image.data_mut()[4] = bad;
            let message = Psf::new(image).unwrap_err().to_string();
            assert!(message.contains("row 1, column 1"), "{message}");
        }
        assert!(Psf::new(Image::zeros(3, 3)).is_err());
    }
}
