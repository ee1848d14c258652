//! A place of the field, and its light over time.

use rowburst_core::{Error, ErrorKind, Parameter, Result, Shape};
use rowburst_optics::Video;

/// A rectangle of the field, in its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Region {
    /// First row.
    pub y: usize,
    /// First column.
    pub x: usize,
    /// Number of rows.
    pub rows: usize,
    /// Number of columns.
    pub columns: usize,
}

impl Region {
    /// The square of `side` pixels about `(y, x)`, without what lies outside the field.
    ///
    /// # Panics
    /// If `(y, x)` is not in the field, or `side` is zero.
    pub fn centred_at(y: usize, x: usize, side: usize, shape: Shape) -> Self {
        assert!(
            y < shape.rows && x < shape.columns && side > 0,
            "a pixel of {shape}"
        );
        let reach = side / 2;
        let (top, left) = (y.saturating_sub(reach), x.saturating_sub(reach));
        Self {
            y: top,
            x: left,
            rows: (y + side - reach).min(shape.rows) - top,
            columns: (x + side - reach).min(shape.columns) - left,
        }
    }

    /// Checks that the region lies in the field of `shape`.
    ///
    /// # Errors
    /// A region without a pixel, or one that reaches beyond the field.
    pub fn check(&self, shape: Shape) -> Result<()> {
        let fits = |first: usize, count: usize, side: usize| {
            count > 0 && first.checked_add(count).is_some_and(|end| end <= side)
        };
        if fits(self.y, self.rows, shape.rows) && fits(self.x, self.columns, shape.columns) {
            return Ok(());
        }
        Err(Error::input(
            Parameter::Region,
            format!(
                "row {}, column {}, {}×{} pixels",
                self.y, self.x, self.rows, self.columns
            ),
            format!(
                "a region has at least one pixel and lies in the field of {}×{}",
                shape.rows, shape.columns
            ),
            "Rows and columns are counted from 0, from the top left corner of the field.",
        )
        .with_kind(ErrorKind::Shape))
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.rows * self.columns
    }

    /// Whether the pixel `(y, x)` is in it.
    pub fn contains(&self, y: usize, x: usize) -> bool {
        (self.y..self.y + self.rows).contains(&y) && (self.x..self.x + self.columns).contains(&x)
    }

    /// The region with a margin of `by` pixels, without what lies outside the field.
    #[must_use]
    pub fn dilated(&self, by: usize, shape: Shape) -> Self {
        let (y, x) = (self.y.saturating_sub(by), self.x.saturating_sub(by));
        Self {
            y,
            x,
            rows: (self.y + self.rows + by).min(shape.rows) - y,
            columns: (self.x + self.columns + by).min(shape.columns) - x,
        }
    }

    /// Indices of its pixels in an image of `columns` columns.
    pub fn indices(self, columns: usize) -> impl Iterator<Item = usize> {
        (self.y..self.y + self.rows)
            .flat_map(move |y| (self.x..self.x + self.columns).map(move |x| y * columns + x))
    }

    /// Mean of `video` over the region in every bin.
    ///
    /// # Panics
    /// If the region does not lie in the field.
    pub fn mean_of(&self, video: &Video) -> Vec<f64> {
        let shape = video.shape();
        let mean = |t: usize| {
            let bin = video.bin(t);
            let values = self.indices(shape.columns).map(|i| f64::from(bin[i]));
            values.sum::<f64>() / self.pixels() as f64
        };
        (0..shape.bins).map(mean).collect()
    }
}

/// The mean light of a region in every bin; units of the video.
#[derive(Debug, Clone, PartialEq)]
pub struct Trace {
    /// Where.
    pub region: Region,
    /// Mean of the video.
    pub value: Vec<f64>,
    /// Mean of the refit, which the error belongs to.
    pub debiased: Vec<f64>,
    /// Standard error of `debiased`; NaN in bins where it is not known.
    pub standard_error: Vec<f64>,
}

impl Trace {
    /// The trace of a video whose errors are not known.
    pub fn without_errors(region: Region, video: &Video) -> Self {
        let value = region.mean_of(video);
        Self {
            region,
            debiased: value.clone(),
            standard_error: vec![f64::NAN; value.len()],
            value,
        }
    }

    /// Mean of the standard errors that are known; `None` where none is.
    pub fn mean_standard_error(&self) -> Option<f64> {
        let known = || self.standard_error.iter().filter(|e| e.is_finite());
        let count = known().count();
        (count > 0).then(|| known().sum::<f64>() / count as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: Shape = Shape {
        bins: 2,
        rows: 5,
        columns: 6,
    };

    #[test]
    fn squares_are_cut_at_the_edge() {
        let region = Region::centred_at(0, 5, 3, SHAPE);
        assert_eq!(
            (region.y, region.x, region.rows, region.columns),
            (0, 4, 2, 2)
        );
        assert_eq!(Region::centred_at(2, 2, 3, SHAPE).pixels(), 9);
        assert_eq!(Region::centred_at(2, 2, 1, SHAPE).pixels(), 1);
        assert_eq!(region.indices(6).collect::<Vec<_>>(), [4, 5, 10, 11]);
        assert_eq!(region.dilated(1, SHAPE).pixels(), 9);
        assert!(region.contains(1, 4) && !region.contains(2, 4));
    }

    #[test]
    fn regions_beyond_the_field_are_refused() {
        let region = |y, x, rows, columns| Region {
            y,
            x,
            rows,
            columns,
        };
        assert!(region(4, 5, 1, 1).check(SHAPE).is_ok());
        for bad in [
            region(5, 0, 1, 1),
            region(0, 5, 1, 2),
            region(0, 0, 0, 1),
            region(1, 0, usize::MAX, 1),
        ] {
            let message = bad.check(SHAPE).unwrap_err().to_string();
            assert!(message.contains("5×6"), "{message}");
        }
    }

    #[test]
    fn the_trace_is_the_mean_over_the_region() {
        let video = Video::new(SHAPE, (0..60).map(|i| i as f32).collect()).unwrap();
        let region = Region {
            y: 1,
            x: 2,
            rows: 2,
            columns: 3,
        };
        assert_eq!(region.mean_of(&video), [12.0, 42.0]);
        let trace = Trace::without_errors(region, &video);
        assert_eq!(trace.mean_standard_error(), None);
    }
}
