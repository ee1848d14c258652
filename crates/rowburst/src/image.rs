//! A two-dimensional array of f32.

use crate::{Error, ErrorKind, Parameter, Result};

/// An image `[y, x]` in C order: a frame, a PSF, a map.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    rows: usize,
    columns: usize,
    data: Vec<f32>,
}

impl Image {
    /// Wraps `data` of length `rows · columns`.
    ///
    /// # Errors
    /// An empty image, or a length that does not match.
    pub fn new(rows: usize, columns: usize, data: Vec<f32>) -> Result<Self> {
        if rows == 0 || columns == 0 || data.len() != rows * columns {
            return Err(Error::input(
                Parameter::Image,
                format!("{} values for {rows}×{columns} pixels", data.len()),
                "an image has at least one pixel and one value for each",
                "Check that the array is two-dimensional and not empty.",
            )
            .with_kind(ErrorKind::Shape));
        }
        Ok(Self {
            rows,
            columns,
            data,
        })
    }

    /// An image of zeros.
    ///
    /// # Panics
    /// If a side is zero.
    pub fn zeros(rows: usize, columns: usize) -> Self {
        assert!(rows > 0 && columns > 0, "an image has at least one pixel");
        Self {
            rows,
            columns,
            data: vec![0.0; rows * columns],
        }
    }

    /// An image whose pixel `(y, x)` is `value(y, x)`.
    ///
    /// # Panics
    /// If a side is zero.
    pub fn from_fn(rows: usize, columns: usize, value: impl Fn(usize, usize) -> f32) -> Self {
        let mut image = Self::zeros(rows, columns);
        for y in 0..rows {
            for x in 0..columns {
                image.data[y * columns + x] = value(y, x);
            }
        }
        image
    }

    /// Number of rows (`y`).
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of columns (`x`).
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// The pixels, row after row.
    pub fn data(&self) -> &[f32] {
        &self.data
    }

    /// The pixels, row after row, to be changed.
    pub fn data_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// The pixels, row after row, without the image.
    pub fn into_data(self) -> Vec<f32> {
        self.data
    }

    /// Row `y`.
    pub fn row(&self, y: usize) -> &[f32] {
        &self.data[y * self.columns..(y + 1) * self.columns]
    }

    /// Pixel `(y, x)`.
    pub fn at(&self, y: usize, x: usize) -> f32 {
        self.data[y * self.columns + x]
    }

    /// Largest pixel.
    pub fn max(&self) -> f32 {
        self.data.iter().copied().fold(f32::NEG_INFINITY, f32::max)
    }

    /// Smallest pixel.
    pub fn min(&self) -> f32 {
        self.data.iter().copied().fold(f32::INFINITY, f32::min)
    }

    /// Mean over `factor × factor` blocks; pixels beyond the last whole block are dropped.
    ///
    /// # Panics
    /// If `factor` is zero or larger than a side.
    pub fn binned(&self, factor: usize) -> Self {
        let (rows, columns) = (self.rows / factor, self.columns / factor);
        let scale = 1.0 / (factor * factor) as f64;
        Self::from_fn(rows, columns, |y, x| {
            let block = (0..factor).flat_map(|dy| {
                let start = (y * factor + dy) * self.columns + x * factor;
                &self.data[start..start + factor]
            });
            (block.map(|&p| f64::from(p)).sum::<f64>() * scale) as f32
        })
    }

    /// Position `(y, x)` of the first pixel that is not finite.
    pub fn first_non_finite(&self) -> Option<(usize, usize)> {
        let at = self.data.iter().position(|p| !p.is_finite())?;
        Some((at / self.columns, at % self.columns))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn binning_takes_the_mean_of_whole_blocks() {
        let image = Image::from_fn(5, 4, |y, x| (10 * y + x) as f32);
        let binned = image.binned(2);
        assert_eq!((binned.rows(), binned.columns()), (2, 2));
        assert_eq!(binned.data(), &[5.5, 7.5, 25.5, 27.5]);
    }

    #[test]
    fn wrong_length_is_an_error() {
        assert!(Image::new(2, 3, vec![0.0; 5]).is_err());
        assert!(Image::new(0, 3, vec![]).is_err());
    }
}
