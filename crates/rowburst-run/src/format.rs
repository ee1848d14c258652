//! Numbers as text.

/// A fraction in percent, with one decimal.
pub(crate) fn percent(fraction: f64) -> String {
    let percent = 100.0 * fraction;
    if percent > 0.0 && percent < 0.1 {
        "under 0.1 %".into()
    } else {
        format!("{percent:.1} %")
    }
}

/// A number with about four significant digits.
pub fn short(value: f64) -> String {
    if value == 0.0 || (1e-3..1e5).contains(&value.abs()) {
        let digits = (3.0 - value.abs().max(1e-3).log10().floor()).clamp(0.0, 6.0) as usize;
        format!("{value:.digits$}")
    } else {
        format!("{value:.3e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_fractions_are_not_zero_percent() {
        assert_eq!(percent(0.0), "0.0 %");
        assert_eq!(percent(1e-6), "under 0.1 %");
        assert_eq!(percent(0.0623), "6.2 %");
        assert_eq!(percent(1.0), "100.0 %");
    }
}
