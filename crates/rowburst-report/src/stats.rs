//! Ranges and moments of values that may hold a few that are not finite.

/// Upper end of a display range: the 99.9th percentile, but never below a quarter of
/// the maximum, so that a lone hot pixel does not darken the picture and a lone true
/// spot still shows. At least a tiny positive number.
pub(crate) fn display_high(values: &[f32]) -> f32 {
    let mut finite: Vec<f32> = values.iter().copied().filter(|v| v.is_finite()).collect();
    if finite.is_empty() {
        return 1.0;
    }
    let max = finite.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let rank = ((finite.len() - 1) as f64 * 0.999) as usize;
    let (_, &mut percentile, _) = finite.select_nth_unstable_by(rank, f32::total_cmp);
    let high = percentile.max(max / 4.0);
    if high > 0.0 { high } else { 1.0 }
}

/// Lower end of a display range: zero, or the least value where that is negative or
/// lies above half of `high` (a frame on a high bias).
pub(crate) fn display_low(values: &[f32], high: f32) -> f32 {
    let finite = values.iter().copied().filter(|v| v.is_finite());
    let min = finite.fold(f32::INFINITY, f32::min);
    if min.is_finite() && (min < 0.0 || min > high / 2.0) && min < high {
        min
    } else {
        0.0
    }
}

/// Moments and tails of a residual.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Moments {
    pub mean: f64,
    pub deviation: f64,
    /// Share of values beyond ±4.
    pub beyond_four: f64,
    /// Number of values that are not finite.
    pub non_finite: usize,
    /// Number of finite values.
    pub finite: usize,
}

/// Moments of the finite values.
pub(crate) fn moments(values: &[f32]) -> Moments {
    let finite = || {
        values
            .iter()
            .map(|&v| f64::from(v))
            .filter(|v| v.is_finite())
    };
    let count = finite().count();
    let n = count.max(1) as f64;
    let mean = finite().sum::<f64>() / n;
    let variance = finite().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    Moments {
        mean,
        deviation: variance.sqrt(),
        beyond_four: finite().filter(|v| v.abs() > 4.0).count() as f64 / n,
        non_finite: values.len() - count,
        finite: count,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_hot_pixel_does_not_set_the_range() {
        let mut values = vec![0.0_f32; 10_000];
        values[..100].fill(1.0);
        values[7] = 3.0;
        assert_eq!(display_high(&values), 1.0);
        assert_eq!(display_high(&[0.0, 8.0, f32::NAN]), 2.0_f32.max(8.0 / 4.0));
        assert_eq!(display_high(&[0.0; 4]), 1.0);
        assert_eq!(display_high(&[f32::NAN]), 1.0);
    }

    #[test]
    fn moments_skip_what_is_not_finite() {
        let m = moments(&[1.0, -1.0, f32::NAN, 5.0, -5.0]);
        assert_eq!((m.mean, m.non_finite, m.finite), (0.0, 1, 4));
        assert!((m.deviation - 13.0_f64.sqrt()).abs() < 1e-12);
        assert_eq!(m.beyond_four, 0.5);
    }
}
