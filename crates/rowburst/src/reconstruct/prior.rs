//! Priors `R(v)`, and their names.
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
//! | `group` | `Σ_pixels √(Σ_t v²)` | none | few active pixels, any trace |
//! | `lowrank` | `Σ singular values of time × space` | none | few shapes, each with its own trace |
//! | `background` | `√T TV(picture)` of a static background | Neumann | a scene in front of a static background |
//! | `lowrank-background` | `√N Σ singular values` of a background | none | a background that blinks as a whole |
//! | `support` | 0 on bright voxels and their neighbours, else ∞ | – | sparse scenes |
//!
//! `T` is the number of bins, and `N` is the larger of pixels and bins, as in Candès et al. (2011). With a
//! background the video is the sum of foreground and background, and all other terms act on the foreground
//! ([`crate::prox::SumPrior`]).
//!
//! Neumann: the difference beyond the last row, column or bin is zero.

use crate::ErrorKind;
use crate::error::Phrase;
use crate::linop::{Background, Cosine, Wavelet};
use crate::phrase;
use crate::prox::{
    Composite, Isotropy, LowRank, Prox, Sparse, SumPrior, Variation, Variation3d, VariationWeights,
};
use crate::solve::admm::{AdmmParams, TauRule};
use crate::{Error, Parameter, Result, Shape};

/// A prior: the weights of its convex terms, and whether the video is restricted to a support.
///
/// Its text form joins the terms by `+`, each with an optional weight, as in `tv+0.5*tdiff+support`:
/// `l1` (absolute values), `tv` (isotropic total variation in space), `tdiff` (absolute differences
/// in time), `tv3d` and `tv3d-aniso` (total variation in space and time), `dct` and `wavelet` (few
/// coefficients in each bin), `group` (few active pixels), `lowrank` (few shapes), `background` and
/// `lowrank-background` (a static background, and a background video of low rank), `support` (only
/// bright voxels and their neighbours, see [`crate::solve::admm`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Weights of the terms that [`Variation`] computes together: `tv`, `tdiff` and `l1`.
    pub variation: VariationWeights,
    /// Weights of all other convex terms, which are not fused into one loop.
    pub unfused: UnfusedWeights,
    /// Whether the video is restricted to a support, `support`.
    pub support: bool,
}

/// Weights of the terms that [`Variation`] does not compute; a term with weight 0 is absent.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct UnfusedWeights {
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
    /// Total variation of a static background, `background`.
    pub background: f64,
    /// Nuclear norm of a background video, `lowrank-background`.
    pub lowrank_background: f64,
}

/// The terms that couple bins.
const TEMPORAL_TERMS: [&str; 7] = [
    "tdiff",
    "tv3d",
    "tv3d-aniso",
    "group",
    "lowrank",
    "background",
    "lowrank-background",
];

/// Units of `β` in [`Prior::threshold_factor`], in units of the brightness of a voxel; larger shrinks the term more in
/// each iteration (docs/design/012). That of `group` is multiplied by `√T`, that of `lowrank` by the singular value of a
/// typical picture.
const GROUP_UNIT: f64 = 2.0;
const LOWRANK_UNIT: f64 = 3.0;
const WAVELET_UNIT: f64 = 5.0;
const DCT_UNIT: f64 = 3.0;

const NO_VARIATION: VariationWeights = VariationWeights {
    space: 0.0,
    time: 0.0,
    l1: 0.0,
};
const NO_UNFUSED_TERMS: UnfusedWeights = UnfusedWeights {
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
    /// Default for sparse scenes, static or moving: `tv+0.5*tdiff+support` (`docs/design/012`).
    pub const STANDARD: Self = Self {
        variation: VariationWeights {
            space: 1.0,
            time: 0.5,
            l1: 0.0,
        },
        unfused: NO_UNFUSED_TERMS,
        support: true,
    };
    /// Default for videos that are reconstructed in chunks, without a term over time: `tv+support`.
    pub const SEPARABLE: Self = Self {
        variation: VariationWeights {
            time: 0.0,
            ..Self::STANDARD.variation
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

    /// The proximal operator of the convex terms, for videos of `shape`. Where the prior has a background, its
    /// argument is the foreground followed by the background.
    pub fn prox(&self, shape: Shape) -> Box<dyn Prox> {
        let UnfusedWeights {
            background,
            lowrank_background,
            ..
        } = self.unfused;
        let foreground = self.foreground_prox(shape);
        let voxels = shape.voxels();
        match self.background() {
            Background::None => foreground,
            Background::Static => {
                let picture = Shape::new(1, shape.rows, shape.columns);
                let weights = VariationWeights {
                    space: 1.0,
                    ..NO_VARIATION
                };
                let background_part = Variation::new(picture, weights);
                let weight = background * (shape.bins as f64).sqrt();
                Box::new(SumPrior::new(
                    voxels,
                    foreground,
                    Box::new(background_part),
                    weight,
                ))
            }
            Background::PerBin => {
                let background_part =
                    Composite::new(shape, NO_VARIATION, 0.0).with(1.0, LowRank::new(shape));
                let weight = lowrank_background * (shape.pixels().max(shape.bins) as f64).sqrt();
                Box::new(SumPrior::new(
                    voxels,
                    foreground,
                    Box::new(background_part),
                    weight,
                ))
            }
        }
    }

    /// The kind of background.
    pub fn background(&self) -> Background {
        if self.unfused.background > 0.0 {
            Background::Static
        } else if self.unfused.lowrank_background > 0.0 {
            Background::PerBin
        } else {
            Background::None
        }
    }

    /// The prox of the foreground alone.
    fn foreground_prox(&self, shape: Shape) -> Box<dyn Prox> {
        let UnfusedWeights {
            tv3d,
            tv3d_aniso,
            dct,
            wavelet,
            group,
            lowrank,
            ..
        } = self.unfused;
        if self.unfused_foreground_weights() == NO_UNFUSED_TERMS {
            return Box::new(Variation::new(shape, self.variation));
        }
        let Shape {
            bins,
            rows,
            columns,
        } = shape;
        let mut sum = Composite::new(shape, self.variation, group);
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

    /// Factor on the solver's threshold `β`: `min_i unit_i/w_i` over the terms. `unit_i` is the size
    /// of what term `i` acts on, in units of the brightness of a voxel; `w_i` is its weight.
    ///
    /// Without the factor `β` is a fraction of the brightness of a voxel. The norm of a trace, a
    /// singular value and a transform coefficient are larger than that; a threshold for voxels would
    /// need thousands of iterations to act (`docs/design/012`). The factor is 1 for the terms of
    /// [`Variation`] alone.
    pub fn threshold_factor(&self, shape: Shape) -> f64 {
        if self.unfused_foreground_weights() == NO_UNFUSED_TERMS {
            return 1.0;
        }
        let bins = shape.bins as f64;
        // Singular value of a shape on a hundredth of `P` pixels of the field, active half of the time at
        // brightness 1: √(T·P/200).
        let picture = (bins * shape.pixels() as f64 / 200.0).sqrt();
        Self::TERMS
            .into_iter()
            .filter(|name| self.weight(name) > 0.0 && !name.ends_with("background"))
            .map(|name| {
                let unit = match name {
                    "group" => GROUP_UNIT * bins.sqrt(),
                    "lowrank" => LOWRANK_UNIT * picture,
                    "wavelet" => WAVELET_UNIT,
                    "dct" => DCT_UNIT,
                    _ => 1.0,
                };
                unit / self.weight(name)
            })
            .fold(f64::INFINITY, f64::min)
    }

    /// The unfused terms without the backgrounds.
    fn unfused_foreground_weights(&self) -> UnfusedWeights {
        UnfusedWeights {
            background: 0.0,
            lowrank_background: 0.0,
            ..self.unfused
        }
    }

    /// Checks that the prior suits a video of `bins` bins.
    ///
    /// # Errors
    /// A term over time and a single bin. [`Self::STANDARD`] is permitted: its `tdiff` is zero for a
    /// single bin.
    pub fn check_bins(&self, bins: usize) -> Result<()> {
        if bins > 1 || *self == Self::STANDARD {
            return Ok(());
        }
        match TEMPORAL_TERMS.iter().find(|name| self.weight(name) > 0.0) {
            None => Ok(()),
            Some(name) => Err(Error::input(
                Parameter::Prior,
                format!("\"{name}\" for a video of 1 bin"),
                format!("{name} compares bins and needs at least 2"),
                "Use auto, or terms of space alone: tv, l1, dct, wavelet. A video of 1 bin comes from shutter = \"global\".",
            ).with_kind(ErrorKind::Unsupported)),
        }
    }

    /// Checks that no term couples bins, so that bins can be reconstructed separately.
    ///
    /// # Errors
    /// A term over time.
    pub fn check_separable_in_time(&self) -> Result<()> {
        match TEMPORAL_TERMS.iter().find(|name| self.weight(name) > 0.0) {
            None => Ok(()),
            Some(name) => Err(Error::input(
                Parameter::Prior,
                format!("\"{name}\" for a video that is reconstructed in chunks"),
                format!("{name} couples bins, which would be in different chunks"),
                phrase![
                    "Use terms of space alone, such as tv+support, l1, wavelet, or fewer bins (",
                    Parameter::Bins,
                    ") in one chunk."
                ],
            )
            .with_kind(ErrorKind::Unsupported)),
        }
    }

    /// The weight of the convex term `name`; 0 where it is absent.
    fn weight(mut self, name: &str) -> f64 {
        self.weight_mut(name).copied().unwrap_or(0.0)
    }

    /// The weight of the convex term `name`; `None` where no convex term has this name.
    fn weight_mut(&mut self, name: &str) -> Option<&mut f64> {
        Some(match name {
            "tv" => &mut self.variation.space,
            "tdiff" => &mut self.variation.time,
            "l1" => &mut self.variation.l1,
            "tv3d" => &mut self.unfused.tv3d,
            "tv3d-aniso" => &mut self.unfused.tv3d_aniso,
            "dct" => &mut self.unfused.dct,
            "wavelet" => &mut self.unfused.wavelet,
            "group" => &mut self.unfused.group,
            "lowrank" => &mut self.unfused.lowrank,
            "background" => &mut self.unfused.background,
            "lowrank-background" => &mut self.unfused.lowrank_background,
            _ => return None,
        })
    }
}

/// The error of a prior's text: `found` breaks `rule`.
fn refuse<T>(found: &str, rule: impl Into<Phrase>) -> Result<T> {
    Err(Error::input(
        Parameter::Prior,
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
            variation: NO_VARIATION,
            unfused: NO_UNFUSED_TERMS,
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
                return refuse(text, "each term may appear once");
            }
            seen.push(name);
            match (name, prior.weight_mut(name)) {
                (_, Some(slot)) => *slot = weight,
                ("support", None) if weight == 1.0 => prior.support = true,
                ("support", None) => return refuse(term, "support has no weight"),
                ("auto", None) => {
                    return refuse(text, "auto is the program's choice of a prior, not a term");
                }
                (_, None) => return refuse(term, unknown(name)),
            }
        }
        if seen == ["support"] {
            return refuse(text, "support must be combined with a convex term");
        }
        if prior.unfused.tv3d > 0.0 && prior.unfused.tv3d_aniso > 0.0 {
            return refuse(
                text,
                "tv3d and tv3d-aniso are two forms of one term: use one of them",
            );
        }
        if prior.unfused.background > 0.0 && prior.unfused.lowrank_background > 0.0 {
            return refuse(
                text,
                "a static background has low rank: use either background or lowrank-background",
            );
        }
        if seen
            .iter()
            .all(|name| name.ends_with("background") || *name == "support")
        {
            return refuse(
                text,
                "a background must be combined with a convex term for the foreground",
            );
        }
        Ok(prior)
    }
}

/// The rule that an unknown `name` breaks, with the nearest name where one is similar.
fn unknown(name: &str) -> String {
    let nearest_term = Prior::TERMS
        .iter()
        .map(|term| (edit_distance(name, term), term))
        .min();
    match nearest_term {
        // A name that differs in more than half of its letters is not similar.
        Some((edit_distance, term)) if 2 * edit_distance <= name.chars().count() => {
            format!("no prior has this name; the nearest is {term}")
        }
        _ => "no prior has this name".to_string(),
    }
}

/// Levenshtein distance: the number of letters to add, drop or change.
fn edit_distance(a: &str, b: &str) -> usize {
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
                "a static background has low rank",
            ),
            (
                "background",
                "a background must be combined with a convex term",
            ),
            (
                "lowrank-background+support",
                "a background must be combined with a convex term",
            ),
            ("auto+dct", "not a term"),
            ("auto", "not a term"),
            ("tv+tv", "each term may appear once"),
            ("-1*tv", "above zero"),
            ("nan*tv", "above zero"),
            ("support", "must be combined with a convex term"),
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

    /// The factor is the size of a term over its weight, and 1 for the terms of `Variation`.
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

    /// Every named term adds to the value, in proportion to its weight.
    #[test]
    fn every_term_has_its_value() {
        let shape = Shape::new(3, 8, 9);
        let video: Vec<f32> = (0..shape.voxels())
            .map(|i| (i as f32 * 0.9).sin().max(0.0))
            .collect();
        for name in Prior::TERMS.iter().filter(|name| **name != "support") {
            // A background needs a foreground term.
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
