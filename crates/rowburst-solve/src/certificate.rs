//! What is proved of a video: its objective, and a lower bound of the minimum.
//!
//! [`super::admm`] has the bound that the solver computes along the way (docs/design/009). A strict one, for the
//! reference solvers, is in `crates/rowburst/tests/reference/certifier.rs`.

/// The objective of a video, and a lower bound of its minimum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Certificate {
    /// `F(v)`.
    pub primal: f64,
    /// `D(y) ≤ min F`.
    pub dual: f64,
}

impl Certificate {
    /// `F(v) − D(y)`: the objective exceeds its minimum by at most this.
    pub fn gap(&self) -> f64 {
        self.primal - self.dual
    }

    /// `(F(v) − D(y)) / D(y)`: the objective exceeds its minimum by at most this part of it. Infinite without a
    /// positive bound.
    pub fn excess(&self) -> f64 {
        if self.dual > 0.0 {
            self.gap() / self.dual
        } else if self.primal <= 0.0 {
            0.0
        } else {
            f64::INFINITY
        }
    }
}

impl std::fmt::Display for Certificate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match 100.0 * self.excess().max(0.0) {
            percent if percent < 1e-3 => {
                f.write_str("the objective is within 0.001 % of its minimum")
            }
            percent if percent.is_finite() => {
                let digits = (1.0 - percent.log10().floor()).clamp(0.0, 4.0) as usize;
                // Rounded up, since it is a bound; 1e-6 absorbs errors of the multiplication.
                let unit = 10f64.powi(digits as i32);
                let percent = (percent * unit - 1e-6).ceil() / unit;
                write!(
                    f,
                    "the objective is within {percent:.digits$} % of its minimum"
                )
            }
            _ => f.write_str("no bound on the distance of the objective to its minimum"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn says_what_it_means() {
        let text = |primal, dual| Certificate { primal, dual }.to_string();
        assert_eq!(
            text(1.0012, 1.0),
            "the objective is within 0.12 % of its minimum"
        );
        assert_eq!(
            text(1.25, 1.0),
            "the objective is within 25 % of its minimum"
        );
        assert_eq!(
            text(4.0, 1.0),
            "the objective is within 300 % of its minimum"
        );
        assert!(text(1.0, 0.0).starts_with("no bound"));
        assert!(text(f64::INFINITY, 0.0).starts_with("no bound"));
        assert!(text(0.0, 0.0).contains("0.001 %"));
    }
}
