//! A two-dimensional array of f32.

use rowburst_core::{Error, ErrorKind, Parameter, Result};

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
    #[inline]
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of columns (`x`).
    #[inline]
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// The pixels, row after row.
    #[inline]
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
    #[inline]
    pub fn row(&self, y: usize) -> &[f32] {
        &self.data[y * self.columns..(y + 1) * self.columns]
    }

    /// Pixel `(y, x)`.
    #[inline]
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

    /// Convolution with a Gaussian of standard deviation `sigma_px`; the image is mirrored at its edges.
    #[must_use]
    pub fn blurred(&self, sigma_px: f64) -> Self {
        if sigma_px <= 0.0 {
            return self.clone();
        }
        let reach = (4.0 * sigma_px).ceil() as isize;
        let tap = |d: isize| (-0.5 * (d as f64 / sigma_px).powi(2)).exp();
        let sum: f64 = (-reach..=reach).map(tap).sum();
        let taps: Vec<(isize, f64)> = (-reach..=reach).map(|d| (d, tap(d) / sum)).collect();
        let along = |n: usize, i: usize, value: &dyn Fn(usize) -> f32| -> f32 {
            let terms = taps
                .iter()
                .map(|&(d, w)| w * f64::from(value(mirrored(i as isize + d, n))));
            terms.sum::<f64>() as f32
        };
        let (rows, columns) = (self.rows, self.columns);
        let lines = Self::from_fn(rows, columns, |y, x| along(columns, x, &|x| self.at(y, x)));
        Self::from_fn(rows, columns, |y, x| along(rows, y, &|y| lines.at(y, x)))
    }

    /// Position `(y, x)` of the first pixel that is not finite.
    pub fn first_non_finite(&self) -> Option<(usize, usize)> {
        let at = self.data.iter().position(|p| !p.is_finite())?;
        Some((at / self.columns, at % self.columns))
    }
}

/// Index of the element at `i` of a line of `n` that is mirrored at its edges.
fn mirrored(i: isize, n: usize) -> usize {
    let period = 2 * n as isize;
    let at = i.rem_euclid(period);
    at.min(period - 1 - at) as usize
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

    #[test]
    fn a_blur_keeps_the_light_and_has_its_width() {
        let point = Image::from_fn(41, 31, |y, x| f32::from(y == 20 && x == 15));
        let blurred = point.blurred(2.0);
        let total: f64 = blurred.data().iter().map(|v| f64::from(*v)).sum();
        assert!((total - 1.0).abs() < 1e-5);
        let variance: f64 = (0..41)
            .map(|y| f64::from(blurred.row(y).iter().sum::<f32>()) * (y as f64 - 20.0).powi(2))
            .sum();
        assert!((variance - 4.0).abs() < 0.05);
        let flat = Image::from_fn(5, 4, |_, _| 3.0).blurred(6.0);
        assert!(flat.data().iter().all(|v| (v - 3.0).abs() < 1e-5));
    }
}
