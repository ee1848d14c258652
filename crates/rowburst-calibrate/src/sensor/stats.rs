//! Statistics that a few wild pixels do not move.

/// Ratio of standard deviation to median absolute deviation of a Gaussian.
const SIGMA_PER_MAD: f64 = 1.4826;

/// Standard score that a Gaussian exceeds once in 100,000 draws. A pixel meets four such
/// tests at most, so that false alarms stay far below one in a thousand.
pub const RARE_Z: f64 = 4.265;

/// The middle value; 0 of none. Reorders `values`.
pub fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    let (_, &mut upper, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    if values.len() % 2 == 1 {
        return upper;
    }
    let below = &values[..middle];
    let lower = below.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    0.5 * (lower + upper)
}

/// Median and standard deviation by the median absolute deviation.
pub fn centre_and_sigma(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let mut values: Vec<f64> = values.collect();
    let centre = median(&mut values);
    values.iter_mut().for_each(|v| *v = (*v - centre).abs());
    (centre, SIGMA_PER_MAD * median(&mut values))
}

/// Mean of `values`; 0 of none.
pub fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
    if count > 0.0 { sum / count } else { 0.0 }
}

/// Value of χ²/k with `dof` = k degrees of freedom that a Gaussian's standard score
/// `z` corresponds to (Wilson & Hilferty 1931); a little above the exact value for
/// small k and large z, which is the safe side.
pub fn chi_square_per_dof(dof: f64, z: f64) -> f64 {
    let spread = 2.0 / (9.0 * dof);
    (1.0 - spread + z * spread.sqrt()).max(0.0).powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_even_and_odd_numbers() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&mut [4.0, 1.0, 2.0, 3.0]), 2.5);
        assert_eq!(median(&mut []), 0.0);
    }

    #[test]
    fn wild_values_do_not_move_centre_and_sigma() {
        let values = (0..1001).map(|i| if i % 10 == 0 { 1e6 } else { f64::from(i % 7) });
        let (centre, sigma) = centre_and_sigma(values);
        assert!((2.0..=4.0).contains(&centre) && sigma < 4.0);
    }

    #[test]
    fn chi_square_bounds_are_those_of_the_tables() {
        // χ² at 1e-5: 23.03 with two degrees of freedom, 104.0 (±0.5) with 50.
        assert!((1.0..1.1).contains(&(2.0 * chi_square_per_dof(2.0, RARE_Z) / 23.03)));
        assert!((0.98..1.02).contains(&(50.0 * chi_square_per_dof(50.0, RARE_Z) / 103.0)));
        // The medians, 1.386 and 49.33.
        assert!((2.0 * chi_square_per_dof(2.0, 0.0) / 1.386 - 1.0).abs() < 0.02);
        assert!((50.0 * chi_square_per_dof(50.0, 0.0) / 49.335 - 1.0).abs() < 1e-3);
    }
}
