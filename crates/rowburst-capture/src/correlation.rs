//! Whether two captures of a PSF are alike: a diffuser that has moved or drifted gives another speckle.

use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Image, Result};
use rowburst_io::read_stack;
use std::path::Path;

/// Largest shift that is looked for, in pixels.
const MAX_SHIFT: isize = 6;

/// Longest side of the part of a capture that is correlated.
const MAX_SIDE: usize = 256;

/// How much two captures are alike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CaptureCorrelation {
    /// Pearson's correlation of their means, at the shift at which it is largest.
    pub correlation: f64,
    /// That shift `(y, x)` of the second, in pixels.
    pub shift_px: (isize, isize),
}

/// The correlation of two captures of the PSF: of the means over their frames, in the middle of the field.
///
/// # Errors
/// Captures that cannot be read or have different sizes.
pub fn correlation_of_captures(first: &Path, second: &Path) -> Result<CaptureCorrelation> {
    let (a, b) = (mean_of(first)?, mean_of(second)?);
    if (a.rows(), a.columns()) != (b.rows(), b.columns()) {
        return Err(Error::input(
            Subject::from(second),
            format!("{}×{} pixels", b.rows(), b.columns()),
            format!("the first capture has {}×{}", a.rows(), a.columns()),
            "Take both captures with the same region.",
        )
        .with_kind(ErrorKind::Shape));
    }
    let mut best = CaptureCorrelation {
        correlation: f64::NEG_INFINITY,
        shift_px: (0, 0),
    };
    for dy in -MAX_SHIFT..=MAX_SHIFT {
        for dx in -MAX_SHIFT..=MAX_SHIFT {
            let correlation = correlation_at(&a, &b, dy, dx);
            if correlation > best.correlation {
                best = CaptureCorrelation {
                    correlation,
                    shift_px: (dy, dx),
                };
            }
        }
    }
    Ok(best)
}

fn mean_of(path: &Path) -> Result<Image> {
    let pages = read_stack(path)?;
    let (rows, columns) = (pages[0].rows(), pages[0].columns());
    let count = pages.len() as f32;
    Ok(Image::from_fn(rows, columns, |y, x| {
        pages.iter().map(|page| page.at(y, x)).sum::<f32>() / count
    }))
}

/// Pearson's correlation of `a` with `b` displaced by `(dy, dx)`, over the middle of both.
fn correlation_at(a: &Image, b: &Image, dy: isize, dx: isize) -> f64 {
    let range = |side: usize| {
        let margin = (MAX_SHIFT as usize).min(side / 4);
        let inner = (side - 2 * margin).min(MAX_SIDE);
        let start = (side - inner) / 2;
        (start, start + inner)
    };
    let ((top, bottom), (left, right)) = (range(a.rows()), range(a.columns()));
    let shifted =
        |at: usize, by: isize, side: usize| at.checked_add_signed(by).filter(|&i| i < side);
    let [mut n, mut sa, mut sb, mut saa, mut sbb, mut sab] = [0.0f64; 6];
    for y in top..bottom {
        let Some(by) = shifted(y, dy, b.rows()) else {
            continue;
        };
        for x in left..right {
            let Some(bx) = shifted(x, dx, b.columns()) else {
                continue;
            };
            let (p, q) = (f64::from(a.at(y, x)), f64::from(b.at(by, bx)));
            n += 1.0;
            sa += p;
            sb += q;
            saa += p * p;
            sbb += q * q;
            sab += p * q;
        }
    }
    let variance = (saa - sa * sa / n) * (sbb - sb * sb / n);
    (sab - sa * sb / n) / variance.max(f64::MIN_POSITIVE).sqrt()
}
