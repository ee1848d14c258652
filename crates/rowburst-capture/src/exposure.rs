//! How well a frame is exposed: histogram, saturation, and contrast and grain of the speckle.

use crate::source::Frame;
use rowburst::Image;
use rowburst::calibrate::psf::statistics;

/// Bins of a histogram.
pub const HISTOGRAM_BINS: usize = 64;

/// Longest side of the part of a frame from which contrast and grain are computed: more takes longer and says no more.
const MAX_SIDE: usize = 512;

/// Smallest side from which they can be computed.
const MIN_SIDE: usize = 16;

/// The exposure of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Exposure {
    /// Pixels in each of [`HISTOGRAM_BINS`] equal ranges from 0 to `saturation_counts`.
    pub histogram: Vec<u64>,
    /// The count from which on a pixel is saturated.
    pub saturation_counts: u16,
    /// Part of the pixels that are saturated.
    pub saturated_fraction: f64,
    /// Mean count.
    pub mean: f64,
    /// Largest count.
    pub max: u16,
    /// Standard deviation over mean of the speckle; `None` where the frame is too small or dark.
    pub contrast: Option<f64>,
    /// Width of a speckle grain in pixels.
    pub grain_px: Option<f64>,
}

/// The count at which a converter of `bit_depth` ends, or else the container.
pub(crate) fn saturation_counts(bit_depth: Option<u32>) -> u16 {
    match bit_depth {
        Some(bits @ 1..=15) => (1 << bits) - 1,
        _ => u16::MAX,
    }
}

/// Part of the pixels of `frame` that are saturated.
pub(crate) fn saturated_fraction(frame: &Frame, bit_depth: Option<u32>) -> f64 {
    let limit = saturation_counts(bit_depth);
    let saturated = frame.counts.iter().filter(|&&count| count >= limit);
    saturated.count() as f64 / frame.counts.len().max(1) as f64
}

impl Exposure {
    /// The exposure of `frame` of a camera with `bit_depth` and a level of `bias` without light.
    pub fn of(frame: &Frame, bit_depth: Option<u32>, bias: f64) -> Self {
        let saturation_counts = saturation_counts(bit_depth);
        let mut histogram = vec![0; HISTOGRAM_BINS];
        let (mut sum, mut max) = (0u64, 0);
        let width = f64::from(saturation_counts) + 1.0;
        for &count in &frame.counts {
            let bin = (f64::from(count) / width * HISTOGRAM_BINS as f64) as usize;
            histogram[bin.min(HISTOGRAM_BINS - 1)] += 1;
            sum += u64::from(count);
            max = max.max(count);
        }
        let speckle = speckle_of(frame, bias);
        Self {
            histogram,
            saturation_counts,
            saturated_fraction: saturated_fraction(frame, bit_depth),
            mean: sum as f64 / frame.counts.len().max(1) as f64,
            max,
            contrast: speckle.map(|s| s.0),
            grain_px: speckle.map(|s| s.1),
        }
    }
}

/// Contrast and grain of the middle of a frame.
fn speckle_of(frame: &Frame, bias: f64) -> Option<(f64, f64)> {
    let (rows, columns) = (frame.rows.min(MAX_SIDE), frame.columns.min(MAX_SIDE));
    if rows < MIN_SIDE || columns < MIN_SIDE {
        return None;
    }
    let (top, left) = ((frame.rows - rows) / 2, (frame.columns - columns) / 2);
    let light = Image::from_fn(rows, columns, |y, x| {
        let count = frame.counts[(top + y) * frame.columns + left + x];
        (f32::from(count) - bias as f32).max(0.0)
    });
    if light.max() <= 0.0 {
        return None;
    }
    let found = statistics(&light);
    let is_finite = found.contrast.is_finite() && found.grain_px.is_finite();
    is_finite.then_some((found.contrast, found.grain_px))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(side: usize, count: impl Fn(usize, usize) -> u16) -> Frame {
        let pixels = (0..side * side).map(|i| count(i / side, i % side));
        Frame {
            rows: side,
            columns: side,
            counts: pixels.collect(),
            number: 0,
            time_us: None,
        }
    }

    #[test]
    fn saturation_is_that_of_the_converter() {
        let half = frame(32, |y, _| if y < 16 { 4095 } else { 100 });
        let found = Exposure::of(&half, Some(12), 0.0);
        assert_eq!((found.saturated_fraction, found.max), (0.5, 4095));
        assert_eq!(found.histogram[HISTOGRAM_BINS - 1], 512);
        assert_eq!(found.histogram.iter().sum::<u64>(), 1024);
        assert_eq!(Exposure::of(&half, None, 0.0).saturated_fraction, 0.0);
    }

    #[test]
    fn the_grain_of_squares_is_their_width() {
        let noise = |y: usize, x: usize| {
            let mut bits = (y * 1009 + x + 1) as u32;
            for _ in 0..3 {
                bits = (bits ^ (bits >> 15)).wrapping_mul(0x2c1b_3c6d);
            }
            // A negative exponential, as fully developed speckle has.
            let part = f64::from(bits >> 8) / 16_777_216.0;
            (-2000.0 * (1.0 - part).ln()) as u16
        };
        let fine = Exposure::of(&frame(128, |y, x| noise(y / 3, x / 3)), None, 0.0);
        let coarse = Exposure::of(&frame(128, |y, x| noise(y / 6, x / 6)), None, 0.0);
        let (fine_px, coarse_px) = (fine.grain_px.unwrap(), coarse.grain_px.unwrap());
        assert!((2.0..4.5).contains(&fine_px), "{fine_px}");
        assert!((1.5..2.6).contains(&(coarse_px / fine_px)), "{coarse_px}");
        assert!((0.8..1.2).contains(&fine.contrast.unwrap()), "{fine:?}");
        let dark = Exposure::of(&frame(64, |_, _| 100), None, 100.0);
        assert_eq!(dark.contrast, None);
    }
}
