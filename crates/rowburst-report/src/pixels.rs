//! Small rasters: what panels of a figure are made of.

use rowburst::error::Subject;
use std::borrow::Cow;

use rowburst::{Error, Result};

use crate::colour::{Map, Srgb};

/// Longest side of a raster in the page, in pixels; larger planes are reduced by block means.
pub(crate) const LONGEST_SIDE: usize = 1600;

/// A raster of `rows · columns` pixels.
#[derive(Debug, Clone)]
pub(crate) struct Pixels {
    pub rows: usize,
    pub columns: usize,
    colours: Colours,
}

#[derive(Debug, Clone)]
enum Colours {
    /// An index into 256 colours for each pixel.
    Indexed {
        palette: Vec<u8>,
        index: Vec<u8>,
    },
    Rgb(Vec<u8>),
}

/// A plane `[y, x]` of values, borrowed where it need not be reduced.
pub(crate) struct Plane<'a> {
    pub rows: usize,
    pub columns: usize,
    pub values: Cow<'a, [f32]>,
}

impl<'a> Plane<'a> {
    /// The plane, reduced by block means over finite values so that no side exceeds `limit`.
    pub(crate) fn reduced(rows: usize, columns: usize, values: &'a [f32], limit: usize) -> Self {
        let factor = rows.max(columns).div_ceil(limit);
        if factor <= 1 {
            let values = Cow::Borrowed(values);
            return Self {
                rows,
                columns,
                values,
            };
        }
        let (small_rows, small_columns) = (rows.div_ceil(factor), columns.div_ceil(factor));
        let mean = |y: usize, x: usize| {
            let (mut sum, mut count) = (0.0_f64, 0_u32);
            for y in y * factor..((y + 1) * factor).min(rows) {
                let row = &values[y * columns..(y + 1) * columns];
                for &v in &row[x * factor..((x + 1) * factor).min(columns)] {
                    if v.is_finite() {
                        sum += f64::from(v);
                        count += 1;
                    }
                }
            }
            (sum / f64::from(count)) as f32 // 0/0: no finite value, shown as such
        };
        let values = (0..small_rows * small_columns)
            .map(|i| mean(i / small_columns, i % small_columns))
            .collect();
        Self {
            rows: small_rows,
            columns: small_columns,
            values: Cow::Owned(values),
        }
    }

    /// The plane in the colours of `map`, from `low` to `high`.
    pub(crate) fn coloured(&self, map: Map, low: f32, high: f32) -> Pixels {
        let span = (high - low).max(f32::MIN_POSITIVE);
        let index = |&v: &f32| {
            if v.is_finite() {
                ((v - low) / span * 254.0).round().clamp(0.0, 254.0) as u8
            } else {
                255
            }
        };
        Pixels {
            rows: self.rows,
            columns: self.columns,
            colours: Colours::Indexed {
                palette: map.palette(),
                index: self.values.iter().map(index).collect(),
            },
        }
    }
}

impl Pixels {
    /// A raster from the colour of each pixel, row after row.
    pub(crate) fn from_rgb(rows: usize, columns: usize, pixel: impl Fn(usize) -> Srgb) -> Self {
        Self {
            rows,
            columns,
            colours: Colours::Rgb((0..rows * columns).flat_map(pixel).collect()),
        }
    }

    /// The raster with `colour` in the pixels that hold a 1 of `mask`. The mask has the size `(rows, columns)` of the plane
    /// before its reduction to at most `limit` pixels a side.
    pub(crate) fn marked(
        self,
        mask: &[u8],
        (rows, columns): (usize, usize),
        limit: usize,
        colour: Srgb,
    ) -> Self {
        if !mask.contains(&1) {
            return self;
        }
        let mask: Vec<f32> = mask.iter().map(|&value| f32::from(value)).collect();
        let mask = Plane::reduced(rows, columns, &mask, limit);
        Self::from_rgb(self.rows, self.columns, |i| {
            if mask.values[i] > 0.0 {
                colour
            } else {
                self.at(i / self.columns, i % self.columns)
            }
        })
    }

    /// The colour of pixel `(y, x)`.
    pub(crate) fn at(&self, y: usize, x: usize) -> Srgb {
        let at = y * self.columns + x;
        let (data, at) = match &self.colours {
            Colours::Indexed { palette, index } => (palette, usize::from(index[at])),
            Colours::Rgb(data) => (data, at),
        };
        [data[3 * at], data[3 * at + 1], data[3 * at + 2]]
    }

    /// The raster as a PNG file.
    pub(crate) fn png(&self) -> Result<Vec<u8>> {
        let (colour, data, palette) = match &self.colours {
            Colours::Indexed { palette, index } => (png::ColorType::Indexed, index, Some(palette)),
            Colours::Rgb(data) => (png::ColorType::Rgb, data, None),
        };
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, self.columns as u32, self.rows as u32);
        encoder.set_color(colour);
        if let Some(palette) = palette {
            encoder.set_palette(palette.clone());
        }
        let mut writer = encoder.write_header().map_err(failed)?;
        writer.write_image_data(data).map_err(failed)?;
        writer.finish().map_err(failed)?;
        Ok(file)
    }
}

/// A picture that could not be encoded.
pub(crate) fn failed(reason: impl ToString) -> Error {
    Error::work(
        Subject::named("picture of the report"),
        reason,
        "This is a fault of the program, please report it.",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reduction_takes_means_of_finite_values_and_keeps_partial_blocks() {
        let values = [1.0, 3.0, 5.0, f32::NAN, 3.0, 7.0, 2.0, 2.0, f32::NAN];
        let plane = Plane::reduced(3, 3, &values, 2);
        assert_eq!((plane.rows, plane.columns), (2, 2));
        assert_eq!(plane.values[..3], [7.0 / 3.0, 6.0, 2.0]);
        assert!(plane.values[3].is_nan());
        assert!(matches!(
            Plane::reduced(3, 3, &values, 3).values,
            Cow::Borrowed(_)
        ));
    }

    #[test]
    fn marks_cover_every_pixel_with_a_one_of_the_mask() {
        let values = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0];
        let colour = [9, 8, 7];
        for (limit, mask, expected) in [
            (3, [0, 0, 0, 0, 1, 0, 0, 0, 0], vec![4]),
            (2, [0, 0, 0, 0, 1, 0, 0, 0, 1], vec![0, 3]),
            (2, [0_u8; 9], vec![]),
        ] {
            let pixels = Plane::reduced(3, 3, &values, limit).coloured(Map::Grey, 0.0, 8.0);
            let marked = pixels.clone().marked(&mask, (3, 3), limit, colour);
            for i in 0..pixels.rows * pixels.columns {
                let (y, x) = (i / pixels.columns, i % pixels.columns);
                let is_marked = expected.contains(&i);
                let expected = if is_marked { colour } else { pixels.at(y, x) };
                assert_eq!(marked.at(y, x), expected, "{limit} {i}");
            }
        }
    }

    #[test]
    fn png_decodes_to_the_colours() {
        let plane = Plane::reduced(1, 3, &[0.0, 1.0, f32::INFINITY], 9);
        let pixels = plane.coloured(Map::Grey, 0.0, 1.0);
        assert_eq!(pixels.at(0, 0), [0, 0, 0]);
        assert_eq!(pixels.at(0, 1), [255, 255, 255]);
        assert_eq!(pixels.at(0, 2), crate::colour::NOT_FINITE);
        let file = pixels.png().unwrap();
        let reader = png::Decoder::new(std::io::Cursor::new(file))
            .read_info()
            .unwrap();
        assert_eq!(reader.info().size(), (3, 1));
    }
}
