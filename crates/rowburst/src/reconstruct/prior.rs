//! The priors that a user names.
//!
//! | term | `R(v)` | boundary | for |
//! |---|---|---|---|
//! | `l1` | `Σ \|v\|` | none | points |
//! | `tv` | `Σ √((∂y v)² + (∂x v)²)` | Neumann | shapes with edges |
//! | `tdiff` | `Σ \|∂t v\|` | Neumann | light switched on and off |
//! | `tv3d` | `Σ √((∂y v)² + (∂x v)² + (∂t v)²)` | Neumann | moving shapes |
//! | `tv3d-aniso` | `Σ \|∂y v\| + \|∂x v\| + \|∂t v\|` | Neumann | boxy or blinking shapes |
//! | `dct` | `Σ \|DCT-II of each bin\|` | symmetric | smooth or periodic pictures |
//! | `wavelet` | `Σ \|Daubechies-4 details\|`, mean over all shifts | periodic | smooth shapes with some edges |
//! | `group` | `Σ_pixels √(Σ_t v²)` | none | few places, any trace |
//! | `lowrank` | `Σ singular values of time × space` | none | few shapes, each with its trace |
//! | `background` | `√T TV(picture)` of a part that stands still | Neumann | a scene before a still background |
//! | `lowrank-background` | `√N Σ singular values` of a part of its own | none | the same where the background blinks as a whole |
//! | `support` | 0 on bright voxels and their neighbours, else ∞ | – | sparse scenes |
//!
//! With a background the video is the sum of two parts, and all other terms are those of the
//! first one ([`crate::prox::SumPrior`]; `N` is the larger of pixels and bins, as in Candès et al. 2011).
//!
//! Neumann: the difference beyond the last row, column or bin is zero.

use crate::linop::{Background, Cosine, Wavelet};
use crate::prox::{
    Composite, Isotropy, LowRank, Prox, Sparse, SumPrior, Variation, Variation3d, VariationWeights,
};
use crate::solve::admm::{AdmmParams, TauRule};
use crate::{Error, Result, Shape};

/// A prior: weights of the convex parts, and whether the video is restricted to its
/// support.
///
/// Written as terms joined by `+`, each with an optional weight: `l1` (absolute
/// values), `tv` (isotropic total variation in space), `tdiff` (absolute differences
/// in time), `tv3d` and `tv3d-aniso` (total variation in space and time as one), `dct` and
/// `wavelet` (few coefficients in each bin), `group` (few places), `lowrank` (few
/// shapes), `support` (only bright voxels and their neighbours, see
/// [`crate::solve::admm`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Weights of the convex parts that [`Variation`] fuses.
    pub weights: VariationWeights,
    /// Weights of the other convex parts.
    pub further: FurtherWeights,
    /// Whether the video is restricted to its support.
    pub support: bool,
}

/// The weights of the terms beside [`VariationWeights`]; a term with weight 0 is absent.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FurtherWeights {
    /// Isotropic total variation in space and time, `tv3d`.
    pub tv3d: f64,
    /// Anisotropic total variation in space and time, `tv3d-aniso`.
    pub tv3d_aniso: f64,
    /// Absolute cosine coefficients of each bin, `dct`.
    pub dct: f64,
    /// Absolute wavelet coefficients of each bin, `wavelet`.
    pub wavelet: f64,
    /// Norm over time of each pixel, `group`.
    pub group: f64,
    /// Nuclear norm of space × time, `lowrank`.
    pub lowrank: f64,
    /// Total variation of a part that stands still, `background`.
    pub background: f64,
    /// Nuclear norm of a part of its own, `lowrank-background`.
    pub lowrank_background: f64,
}

/// The terms that couple bins.
const OF_TIME: [&str; 7] = [
    "tdiff",
    "tv3d",
    "tv3d-aniso",
    "group",
    "lowrank",
    "background",
    "lowrank-background",
];

const NO_VARIATION: VariationWeights = VariationWeights {
    space: 0.0,
    time: 0.0,
    l1: 0.0,
};
const NONE: FurtherWeights = FurtherWeights {
    tv3d: 0.0,
    tv3d_aniso: 0.0,
    dct: 0.0,
    wavelet: 0.0,
    group: 0.0,
    lowrank: 0.0,
    background: 0.0,
    lowrank_background: 0.0,
};

impl Prior {
    /// What does well on sparse scenes, still or moving: `tv+0.5*tdiff+support`.
    ///
    /// The temporal weight costs digits that change in every bin nothing (48.0 dB with
    /// and without) and gives a moving digit 0.2 dB, without the support 3.7 dB.
    pub const STANDARD: Self = Self {
        weights: VariationWeights {
            space: 1.0,
            time: 0.5,
            l1: 0.0,
        },
        further: NONE,
        support: true,
    };
    /// The same for videos that are found part by part: `tv+support`.
    pub const SEPARABLE: Self = Self {
        weights: VariationWeights {
            time: 0.0,
            ..Self::STANDARD.weights
        },
        ..Self::STANDARD
    };
    /// The names of the terms, in the order in which a prior is written.
    pub const TERMS: [&'static str; 12] = [
        "tv",
        "tdiff",
        "l1",
        "tv3d",
        "tv3d-aniso",
        "dct",
        "wavelet",
        "group",
        "lowrank",
        "background",
        "lowrank-background",
        "support",
    ];

    /// The parameters of the solver for videos of `shape`.
    pub(super) fn admm_params(
        &self,
        shape: Shape,
        rule: TauRule,
        max_iterations: Option<usize>,
    ) -> AdmmParams {
        let defaults = AdmmParams::new(rule);
        AdmmParams {
            support: self.support,
            threshold: defaults.threshold * self.threshold_factor(shape),
            max_iterations: max_iterations.unwrap_or(defaults.max_iterations),
            ..defaults
        }
    }

    /// The prox of the convex parts over videos of `shape`.
    pub fn prox(&self, shape: Shape) -> Box<dyn Prox> {
        let FurtherWeights {
            background,
            lowrank_background,
            ..
        } = self.further;
        let first = self.foreground_prox(shape);
        let voxels = shape.voxels();
        match self.background() {
            Background::None => first,
            Background::Static => {
                let picture = Shape::new(1, shape.rows, shape.columns);
                let weights = VariationWeights {
                    space: 1.0,
                    ..NO_VARIATION
                };
                let second = Variation::new(picture, weights);
                let weight = background * (shape.bins as f64).sqrt();
                Box::new(SumPrior::new(voxels, first, Box::new(second), weight))
            }
            Background::Video => {
                let second =
                    Composite::new(shape, NO_VARIATION, 0.0).with(1.0, LowRank::new(shape));
                let weight = lowrank_background * (shape.pixels().max(shape.bins) as f64).sqrt();
                Box::new(SumPrior::new(voxels, first, Box::new(second), weight))
            }
        }
    }

    /// What stands behind the part that all other terms are for.
    pub fn background(&self) -> Background {
        if self.further.background > 0.0 {
            Background::Static
        } else if self.further.lowrank_background > 0.0 {
            Background::Video
        } else {
            Background::None
        }
    }

    /// Without the backgrounds.
    fn foreground_prox(&self, shape: Shape) -> Box<dyn Prox> {
        let FurtherWeights {
            tv3d,
            tv3d_aniso,
            dct,
            wavelet,
            group,
            lowrank,
            ..
        } = self.further;
        if self.foreground_terms() == NONE {
            return Box::new(Variation::new(shape, self.weights));
        }
        let Shape {
            bins,
            rows,
            columns,
        } = shape;
        let mut sum = Composite::new(shape, self.weights, group);
        for (weight, isotropy) in [
            (tv3d, Isotropy::Isotropic),
            (tv3d_aniso, Isotropy::Anisotropic),
        ] {
            if weight > 0.0 {
                sum = sum.with(weight, Variation3d::new(shape, isotropy));
            }
        }
        if dct > 0.0 {
            sum = sum.with(dct, Sparse::new(bins, Cosine::new(rows, columns)));
        }
        if wavelet > 0.0 {
            sum = sum.with(wavelet, Sparse::new(bins, Wavelet::new(rows, columns)));
        }
        if lowrank > 0.0 {
            sum = sum.with(lowrank, LowRank::new(shape));
        }
        Box::new(sum)
    }

    /// What the solver's threshold `β` is multiplied by: `min_i unit_i/w_i` over the terms,
    /// where `unit_i` is the size of what a lit voxel is a part of.
    ///
    /// `β` is a part of the brightness of a voxel. A trace over `T` bins, a picture's
    /// singular value and a coefficient are larger than that, and a threshold for voxels
    /// would need thousands of iterations to have a say: points blinking in 24 bins
    /// stood after 300 iterations of `group` at 31.8, 38.5, 40.1 and 37.7 dB with `β` times 1,
    /// 3, 10 and 30; textures of `lowrank` at 21.7, 23.0, 23.5 and 23.4 dB with 10, 30, 100 and
    /// 300; soft blobs of `wavelet` at 22.6, 23.5, 23.6 and 23.1 dB with 1, 3, 10 and 30; waves
    /// of `dct` at 20.2, 20.6 and 19.4 dB with 1, 5 and 20.
    /// What [`Variation`] fuses has none: 1.
    pub fn threshold_factor(&self, shape: Shape) -> f64 {
        if self.foreground_terms() == NONE {
            return 1.0;
        }
        let bins = shape.bins as f64;
        // A shape of a hundredth of the field, lit half of the time: √(T·N/200).
        let picture = (bins * shape.pixels() as f64 / 200.0).sqrt();
        Self::TERMS
            .into_iter()
            .filter(|name| self.weight(name) > 0.0 && !name.ends_with("background"))
            .map(|name| {
                let unit = match name {
                    "group" => 2.0 * bins.sqrt(),
                    "lowrank" => 3.0 * picture,
                    "wavelet" => 5.0,
                    "dct" => 3.0,
                    _ => 1.0,
                };
                unit / self.weight(name)
            })
            .fold(f64::INFINITY, f64::min)
    }

    /// The further terms of the first part.
    fn foreground_terms(&self) -> FurtherWeights {
        FurtherWeights {
            background: 0.0,
            lowrank_background: 0.0,
            ..self.further
        }
    }

    /// Checks that a video of `bins` bins has what the terms speak of.
    ///
    /// # Errors
    /// A term over time where there is a single bin. [`Self::STANDARD`] is for any video: its
    /// `tdiff` does nothing there.
    pub fn check_bins(&self, bins: usize) -> Result<()> {
        if bins > 1 || *self == Self::STANDARD {
            return Ok(());
        }
        match OF_TIME.iter().find(|name| self.weight(name) > 0.0) {
            None => Ok(()),
            Some(name) => Err(Error::input(
                "--prior",
                format!("\"{name}\" for a video of 1 bin"),
                format!("{name} compares bins and needs at least 2"),
                "Use auto, or terms of space alone: tv, l1, dct, wavelet. A video of 1 bin comes from shutter = \"global\".",
            )),
        }
    }

    /// Checks that no term couples bins, so that each can be found by itself.
    ///
    /// # Errors
    /// A term over time.
    pub fn check_separable_in_time(&self) -> Result<()> {
        match OF_TIME.iter().find(|name| self.weight(name) > 0.0) {
            None => Ok(()),
            Some(name) => Err(Error::input(
                "--prior",
                format!("\"{name}\" for a video that is found part by part"),
                format!("{name} couples bins, and they would fall into different parts"),
                "Use terms of space alone, such as tv+support, l1, wavelet, or fewer bins (--bins) in one part.",
            )),
        }
    }

    /// The weight of the convex term `name`; 0 where it is absent.
    fn weight(mut self, name: &str) -> f64 {
        self.weight_mut(name).copied().unwrap_or(0.0)
    }

    fn weight_mut(&mut self, name: &str) -> Option<&mut f64> {
        Some(match name {
            "tv" => &mut self.weights.space,
            "tdiff" => &mut self.weights.time,
            "l1" => &mut self.weights.l1,
            "tv3d" => &mut self.further.tv3d,
            "tv3d-aniso" => &mut self.further.tv3d_aniso,
            "dct" => &mut self.further.dct,
            "wavelet" => &mut self.further.wavelet,
            "group" => &mut self.further.group,
            "lowrank" => &mut self.further.lowrank,
            "background" => &mut self.further.background,
            "lowrank-background" => &mut self.further.lowrank_background,
            _ => return None,
        })
    }
}

fn refuse<T>(found: &str, rule: impl Into<String>) -> Result<T> {
    Err(Error::input(
        "--prior",
        format!("\"{found}\""),
        rule,
        format!(
            "Use auto, or terms of {} joined by +, each with a weight if it is not 1: tv+0.5*tdiff.",
            Prior::TERMS.join(", ")
        ),
    ))
}

impl std::str::FromStr for Prior {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let mut prior = Self {
            weights: NO_VARIATION,
            further: NONE,
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
            match (name, prior.weight_mut(name)) {
                (_, Some(place)) => *place = weight,
                ("support", None) if weight == 1.0 => prior.support = true,
                ("support", None) => return refuse(term, "support has no weight"),
                ("auto", None) => {
                    return refuse(text, "auto is a choice of the program and stands alone");
                }
                (_, None) => return refuse(term, unknown(name)),
            }
        }
        if seen == ["support"] {
            return refuse(text, "support needs a convex term beside it");
        }
        if prior.further.tv3d > 0.0 && prior.further.tv3d_aniso > 0.0 {
            return refuse(
                text,
                "tv3d and tv3d-aniso are two forms of one term: one of them stands",
            );
        }
        if prior.further.background > 0.0 && prior.further.lowrank_background > 0.0 {
            return refuse(
                text,
                "a still background is one of low rank: one of background and lowrank-background stands",
            );
        }
        if seen
            .iter()
            .all(|name| name.ends_with("background") || *name == "support")
        {
            return refuse(
                text,
                "a background needs a convex term for what is before it",
            );
        }
        Ok(prior)
    }
}

/// That there is no `name`, and which it may have been meant to be.
fn unknown(name: &str) -> String {
    let near = Prior::TERMS
        .iter()
        .map(|term| (edits(name, term), term))
        .min();
    match near {
        // More than half of the letters wrong is another word.
        Some((edits, term)) if 2 * edits <= name.chars().count() => {
            format!("no prior has this name; the nearest is {term}")
        }
        _ => "no prior has this name".to_string(),
    }
}

/// Levenshtein distance: letters to add, drop or change.
fn edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut diagonal = i;
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let changed = diagonal + usize::from(x != *y);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

impl std::fmt::Display for Prior {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut separator = "";
        for name in Self::TERMS {
            let weight = match name {
                "support" => f64::from(u8::from(self.support)),
                _ => self.weight(name),
            };
            if weight > 0.0 {
                if weight == 1.0 {
                    write!(f, "{separator}{name}")?;
                } else {
                    write!(f, "{separator}{weight}*{name}")?;
                }
                separator = "+";
            }
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
            "tv3d",
            "0.3*l1+tv3d-aniso+support",
            "dct",
            "0.5*tv+wavelet",
            "group+support",
            "tv+0.2*lowrank",
            "tv+0.5*tdiff+background+support",
            "l1+0.5*lowrank-background",
        ] {
            assert_eq!(name.parse::<Prior>().unwrap().to_string(), name);
        }
        assert_eq!(Prior::STANDARD.to_string(), "tv+0.5*tdiff+support");
        assert_eq!(
            " support + tv ".parse::<Prior>().unwrap().to_string(),
            "tv+support"
        );
    }

    #[test]
    fn bad_names_say_what_is_wrong() {
        for (name, rule) in [
            ("tvv", "no prior has this name; the nearest is tv"),
            ("wavelets", "the nearest is wavelet"),
            ("low-rank", "the nearest is lowrank"),
            ("tv3d-anis", "the nearest is tv3d-aniso"),
            ("", "no prior has this name"),
            ("entropy", "no prior has this name. Use"),
            ("tv+", "no prior has this name"),
            ("0*dct", "above zero"),
            ("inf*group", "above zero"),
            ("*lowrank", "above zero"),
            ("tv3d+tv3d-aniso", "two forms of one term"),
            (
                "tv+background+lowrank-background",
                "a still background is one of low rank",
            ),
            ("background", "a background needs a convex term"),
            (
                "lowrank-background+support",
                "a background needs a convex term",
            ),
            ("auto+dct", "stands alone"),
            ("auto", "stands alone"),
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

    #[test]
    fn terms_over_time_need_two_bins() {
        for name in ["tdiff", "tv3d", "tv3d-aniso", "group", "l1+lowrank"] {
            let prior: Prior = name.parse().unwrap();
            assert!(prior.check_bins(2).is_ok());
            let error = prior.check_bins(1).unwrap_err().to_string();
            assert!(error.contains("needs at least 2"), "{error}");
        }
        for name in ["tv+0.5*tdiff+support", "tv", "l1+support", "dct", "wavelet"] {
            assert!(name.parse::<Prior>().unwrap().check_bins(1).is_ok());
        }
    }

    /// A common factor of the weights changes nothing; the fused terms stay as they were.
    #[test]
    fn the_threshold_follows_the_size_of_a_term() {
        let shape = Shape::new(25, 8, 9);
        let factor = |name: &str| name.parse::<Prior>().unwrap().threshold_factor(shape);
        for name in ["tv+0.5*tdiff+support", "tv", "2*tv+l1"] {
            assert_eq!(factor(name), 1.0);
        }
        assert_eq!(factor("group"), 10.0);
        assert_eq!(factor("4*group"), 2.5);
        assert_eq!(factor("group+0.2*l1"), 5.0);
        assert_eq!(factor("tv+wavelet+support"), 1.0);
        // 3·√(25·72/200)
        assert_eq!(factor("lowrank"), 9.0);
    }

    /// Whatever is named is built, and counts: a weight twice as large, a value twice as large.
    #[test]
    fn every_term_has_its_value() {
        let shape = Shape::new(3, 8, 9);
        let video: Vec<f32> = (0..shape.voxels())
            .map(|i| (i as f32 * 0.9).sin().max(0.0))
            .collect();
        for name in Prior::TERMS.iter().filter(|name| **name != "support") {
            // A background stands behind something.
            let before = if name.ends_with("background") {
                "1e-9*l1+"
            } else {
                ""
            };
            let value = |text: String| {
                let prior: Prior = text.parse().unwrap();
                let mut stacked = video.clone();
                stacked.extend_from_slice(&video[..prior.background().len(shape)]);
                prior.prox(shape).value(&stacked)
            };
            let once = value(format!("{before}{name}"));
            let twice = value(format!("{before}2*{name}"));
            assert!(once > 1.0 && (twice / once - 2.0).abs() < 1e-6, "{name}");
            let combined = value(format!(
                "{name}+0.5*{}",
                if *name == "tv" { "l1" } else { "tv" }
            ));
            assert!(combined > once, "{name}");
        }
    }
}
