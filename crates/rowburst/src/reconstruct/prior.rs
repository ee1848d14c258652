//! The priors that a user names.

use crate::prox::VariationWeights;
use crate::{Error, Result};

/// A prior: weights of the convex parts, and whether the video is restricted to its
/// support.
///
/// Written as terms joined by `+`, each with an optional weight: `l1` (absolute
/// values), `tv` (isotropic total variation in space), `tdiff` (absolute differences
/// in time), `support` (only bright voxels and their neighbours, see
/// [`crate::solve::admm`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Weights of the convex parts.
    pub weights: VariationWeights,
    /// Whether the video is restricted to its support.
    pub support: bool,
}

impl Prior {
    /// The default: `tv+0.5*tdiff+support`.
    ///
    /// The temporal weight costs digits that change in every bin nothing (48.0 dB with
    /// and without) and gives a moving digit 0.2 dB, without the support 3.7 dB.
    pub const AUTO: Self = Self {
        weights: VariationWeights {
            space: 1.0,
            time: 0.5,
            l1: 0.0,
        },
        support: true,
    };
    /// The names of the terms.
    pub const TERMS: [&'static str; 4] = ["l1", "tv", "tdiff", "support"];
}

impl Default for Prior {
    fn default() -> Self {
        Self::AUTO
    }
}

impl std::str::FromStr for Prior {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        if text.trim() == "auto" {
            return Ok(Self::AUTO);
        }
        let refuse = |found: &str, rule: &str| {
            Err(Error::input(
                "--prior",
                format!("\"{found}\""),
                rule,
                format!(
                    "Use auto, or terms of {} joined by +, each with a weight if it is not 1: tv+0.5*tdiff.",
                    Self::TERMS.join(", ")
                ),
            ))
        };
        let mut prior = Self {
            weights: VariationWeights {
                space: 0.0,
                time: 0.0,
                l1: 0.0,
            },
            support: false,
        };
        let mut seen: Vec<&str> = Vec::new();
        for term in text.split('+').map(str::trim) {
            let (weight, name) = match term.split_once('*') {
                None => (1.0, term),
                Some((weight, name)) => match weight.trim().parse::<f64>() {
                    Ok(weight) if weight.is_finite() && weight > 0.0 => (weight, name.trim()),
                    _ => return refuse(term, "a weight is a finite number above zero"),
                },
            };
            if seen.contains(&name) {
                return refuse(text, "each term stands once");
            }
            seen.push(name);
            match name {
                "l1" => prior.weights.l1 = weight,
                "tv" => prior.weights.space = weight,
                "tdiff" => prior.weights.time = weight,
                "support" if weight == 1.0 => prior.support = true,
                "support" => return refuse(term, "support has no weight"),
                _ => return refuse(term, "no prior has this name"),
            }
        }
        let VariationWeights { space, time, l1 } = prior.weights;
        if space + time + l1 == 0.0 {
            return refuse(text, "support needs a convex term beside it");
        }
        Ok(prior)
    }
}

impl std::fmt::Display for Prior {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let VariationWeights { space, time, l1 } = self.weights;
        let mut separator = "";
        for (name, weight) in [("tv", space), ("tdiff", time), ("l1", l1)] {
            if weight > 0.0 {
                if weight == 1.0 {
                    write!(f, "{separator}{name}")?;
                } else {
                    write!(f, "{separator}{weight}*{name}")?;
                }
                separator = "+";
            }
        }
        if self.support {
            write!(f, "{separator}support")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_and_written() {
        for name in [
            "tv",
            "l1",
            "tv+0.5*tdiff",
            "tv+0.5*tdiff+support",
            "2*tv+tdiff+0.1*l1",
        ] {
            assert_eq!(name.parse::<Prior>().unwrap().to_string(), name);
        }
        assert_eq!("auto".parse::<Prior>().unwrap(), Prior::AUTO);
        assert_eq!(
            " support + tv ".parse::<Prior>().unwrap().to_string(),
            "tv+support"
        );
    }

    #[test]
    fn bad_names_say_what_is_wrong() {
        for (name, rule) in [
            ("tvv", "no prior has this name"),
            ("", "no prior has this name"),
            ("tv+tv", "each term stands once"),
            ("-1*tv", "above zero"),
            ("nan*tv", "above zero"),
            ("support", "needs a convex term"),
            ("tv+2*support", "no weight"),
        ] {
            let error = name.parse::<Prior>().unwrap_err().to_string();
            assert!(error.contains(rule) && error.contains("tdiff"), "{error}");
        }
    }
}
