//! Numbers, times and row lists as text.

/// `value` with about `digits` significant digits and a true minus sign.
pub(crate) fn number(value: f64, digits: usize) -> String {
    if !value.is_finite() {
        return "not finite".into();
    }
    if value == 0.0 {
        return "0".into();
    }
    let exponent = value.abs().log10().floor() as i32;
    let digits = digits.max(1) as i32;
    let text = if (-4..7).contains(&exponent) {
        let text = format!("{value:.*}", (digits - 1 - exponent).max(0) as usize);
        if text.contains('.') {
            text.trim_end_matches('0').trim_end_matches('.').to_string()
        } else {
            text
        }
    } else {
        let mantissa = value / 10_f64.powi(exponent);
        format!(
            "{}·10{}",
            number(mantissa, digits as usize),
            raised(exponent)
        )
    };
    text.replace('-', "−")
}

/// `value` with two decimals, or three digits where that would be long.
pub(crate) fn fixed(value: f64) -> String {
    if value.abs() < 1000.0 {
        format!("{value:.2}").replace('-', "−")
    } else {
        number(value, 3)
    }
}

/// A whole number in groups of three digits: "104,167".
pub(crate) fn grouped(value: f64) -> String {
    if !(1.0..1e15).contains(&value) {
        return number(value, 4);
    }
    let digits = format!("{value:.0}");
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// An exponent in superior digits.
pub(crate) fn raised(exponent: i32) -> String {
    let superior = |c| match c {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        digit => char::from_u32(digit as u32 - '0' as u32 + '⁰' as u32).unwrap_or(digit),
    };
    exponent.to_string().chars().map(superior).collect()
}

/// A unit of time in which a video of given length has readable numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TimeUnit {
    pub name: &'static str,
    /// Microseconds in one of it.
    pub us: f64,
}

impl TimeUnit {
    /// The unit for a video that lasts `total_us`.
    pub(crate) fn of(total_us: f64) -> Self {
        let (name, us) = match total_us {
            t if t >= 2e7 => ("s", 1e6),
            t if t >= 2e4 => ("ms", 1e3),
            _ => ("µs", 1.0),
        };
        Self { name, us }
    }

    /// `time_us` with its unit, as fine as `step_us` asks for.
    pub(crate) fn stamp(&self, time_us: f64, step_us: f64) -> String {
        let step = step_us / self.us;
        let whole = |s: f64| (s - s.round()).abs() < 1e-6 * s;
        let decimals = (0..4).find(|&d| whole(step * 10_f64.powi(d))).unwrap_or(2);
        format!("{:.*} {}", decimals as usize, time_us / self.us, self.name)
    }
}

/// A frequency with its unit.
pub(crate) fn frequency(hertz: f64) -> String {
    match hertz {
        f if f >= 1e6 => format!("{} MHz", number(f / 1e6, 4)),
        f if f >= 1e3 => format!("{} kHz", number(f / 1e3, 4)),
        f => format!("{} Hz", number(f, 4)),
    }
}

/// A frequency with its standard error, both in one unit, as fine as the error has two digits.
pub(crate) fn frequency_with_error(hertz: f64, error_hz: f64) -> String {
    let (name, unit) = match hertz {
        f if f >= 1e6 => ("MHz", 1e6),
        f if f >= 1e3 => ("kHz", 1e3),
        _ => ("Hz", 1.0),
    };
    if !(error_hz.is_finite() && error_hz > 0.0) {
        return frequency(hertz);
    }
    let decimals = (1.0 - (error_hz / unit).log10().floor()).clamp(0.0, 7.0) as usize;
    format!(
        "{:.decimals$} ± {:.decimals$} {name}",
        hertz / unit,
        error_hz / unit
    )
}

/// Row numbers as runs: "rows 3–5, 9". Rows in ascending order.
pub(crate) fn rows(rows: &[usize]) -> String {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for &row in rows {
        match runs.last_mut() {
            Some((_, end)) if *end + 1 == row => *end = row,
            _ => runs.push((row, row)),
        }
    }
    if runs.is_empty() {
        return "no row".into();
    }
    if runs.len() > 2 {
        return format!("{} rows", rows.len());
    }
    let run = |&(from, to): &(usize, usize)| {
        if from == to {
            from.to_string()
        } else {
            format!("{from}–{to}")
        }
    };
    let list: Vec<String> = runs.iter().map(run).collect();
    let noun = if rows.len() == 1 { "row" } else { "rows" };
    format!("{noun} {}", list.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        assert_eq!(number(-0.012_345, 3), "−0.0123");
        assert_eq!(number(1500.0, 3), "1500");
        assert_eq!(number(2.0, 3), "2");
        assert_eq!(number(3.2e-9, 2), "3.2·10⁻⁹");
        assert_eq!(number(f64::NAN, 2), "not finite");
        assert_eq!(frequency(10_417.0), "10.42 kHz");
        assert_eq!(frequency_with_error(20_833.2, 4.24), "20.8332 ± 0.0042 kHz");
        assert_eq!(frequency_with_error(850.0, 120.0), "850 ± 120 Hz");
        assert_eq!(frequency_with_error(850.0, f64::NAN), "850 Hz");
        assert_eq!(grouped(104_166.67), "104,167");
        assert_eq!(grouped(999.6), "1,000");
        assert_eq!(fixed(-0.994), "−0.99");
    }

    #[test]
    fn stamps_are_as_fine_as_a_bin() {
        let unit = TimeUnit::of(518.4);
        assert_eq!(unit.stamp(96.0, 9.6), "96.0 µs");
        assert_eq!(unit.stamp(100.0, 10.0), "100 µs");
        assert_eq!(TimeUnit::of(3e4).stamp(15_000.0, 500.0), "15.0 ms");
    }

    #[test]
    fn rows_become_runs() {
        assert_eq!(rows(&[4]), "row 4");
        assert_eq!(rows(&[53, 54]), "rows 53–54");
        assert_eq!(rows(&[3, 4, 5, 9]), "rows 3–5, 9");
        assert_eq!(rows(&[1, 3, 5]), "3 rows");
        assert_eq!(rows(&[]), "no row");
    }
}
