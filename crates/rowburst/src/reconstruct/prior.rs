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
//! ([`rowburst_solve::prox::SumPrior`]). `background` alone is a scene at rest: one picture in all bins.
//!
//! Where some rows of a bin are seen far more weakly than others, `R` acts on `D⁻¹v` in place of `v`, but for priors with a
//! background and a given `τ` ([`RollingShutter::equilibrated`](rowburst_optics::RollingShutter::equilibrated)).
//!
//! Neumann: the difference beyond the last row, column or bin is zero.

use super::SolverSettings;
use rowburst_core::error::Phrase;
use rowburst_core::linop::Background;
use rowburst_core::{Error, ErrorKind, Parameter, Result, Shape, phrase};
use rowburst_solve::admm::{AdmmParams, TauRule};
use rowburst_solve::prox::{
    Composite, Coupling, Prox, SumPrior, TERMS, TermForm, TermSpec, Variation, VariationWeights,
};

/// A prior: the weights of its convex terms, and whether the video is restricted to a support.
///
/// Its text form joins the terms by `+`, each with an optional weight, as in `tv+0.5*tdiff+support`. The convex terms
/// are those of [`TERMS`]; `support` permits only bright voxels and their neighbours, see [`rowburst_solve::admm`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// The weights of [`TERMS`]; a term with weight 0 is absent.
    weights: [f64; TERMS.len()],
    /// Whether the video is restricted to a support, `support`.
    pub support: bool,
}

/// The name of the restriction to a support.
const SUPPORT: &str = "support";

impl Prior {
    /// Default for sparse scenes, static or moving: `tv+0.5*tdiff+support` (`docs/design/012`).
    pub const STANDARD: Self = Self::SEPARABLE.with("tdiff", 0.5);
    /// Default for videos that are reconstructed in chunks, without a term over time: `tv+support`.
    pub const SEPARABLE: Self = Self {
        weights: [0.0; TERMS.len()],
        support: true,
    }
    .with("tv", 1.0);

    /// The prior with another weight of the convex term `name`.
    ///
    /// # Panics
    /// If no convex term has this name.
    #[must_use]
    pub const fn with(mut self, name: &str, weight: f64) -> Self {
        let mut i = 0;
        while !is_same(TERMS[i].name, name) {
            i += 1;
        }
        self.weights[i] = weight;
        self
    }

    /// The prior without a restriction to a support.
    #[must_use]
    pub const fn without_support(mut self) -> Self {
        self.support = false;
        self
    }

    /// The names of the terms, in the order in which a prior is written.
    pub fn names() -> impl Iterator<Item = &'static str> {
        TERMS.iter().map(|term| term.name).chain([SUPPORT])
    }

    /// The weight of the convex term `name`; 0 where it is absent.
    pub fn weight(&self, name: &str) -> f64 {
        self.terms()
            .find(|(term, _)| term.name == name)
            .map_or(0.0, |(_, weight)| weight)
    }

    /// The convex terms with a weight above zero.
    fn terms(&self) -> impl Iterator<Item = (&'static TermSpec, f64)> {
        let weights = self.weights;
        TERMS
            .iter()
            .zip(weights)
            .filter(|(_, weight)| *weight > 0.0)
    }

    /// The parameters of the solver for videos of `shape`.
    pub(super) fn admm_params(
        &self,
        shape: Shape,
        rule: TauRule,
        settings: SolverSettings,
    ) -> AdmmParams {
        let defaults = AdmmParams::with_tuning(rule, settings.tuning);
        AdmmParams {
            support: self.support,
            threshold: defaults.threshold * self.threshold_factor(shape),
            max_iterations: settings.max_iterations.unwrap_or(defaults.max_iterations),
            ..defaults
        }
    }

    /// The proximal operator of the convex terms, for videos of `shape`. Where the prior has a background, its
    /// argument is the foreground followed by the background.
    pub fn prox(&self, shape: Shape) -> Box<dyn Prox> {
        let background = self.terms().find_map(|(term, weight)| match term.form {
            TermForm::Background { prox, .. } => Some(prox(shape, weight)),
            _ => None,
        });
        match background {
            None => self.foreground_prox(shape),
            Some(background) if self.background() == Background::Alone => background,
            Some(background) => {
                let foreground = self.foreground_prox(shape);
                Box::new(SumPrior::new(shape.voxels(), foreground, background))
            }
        }
    }

    /// The kind of background.
    pub fn background(&self) -> Background {
        let mut kinds = self.terms().filter_map(|(term, _)| term.background());
        match kinds.next() {
            Some(Background::Static) if self.terms_of_foreground().next().is_none() => {
                Background::Alone
            }
            kind => kind.unwrap_or(Background::None),
        }
    }

    /// The prox of the foreground alone.
    fn foreground_prox(&self, shape: Shape) -> Box<dyn Prox> {
        let (mut variation, mut traces) = (VariationWeights::NONE, 0.0);
        let mut dual_terms = Vec::new();
        for (term, weight) in self.terms() {
            match term.form {
                TermForm::Fused(weight_of) => *weight_of(&mut variation) = weight,
                TermForm::Traces => traces = weight,
                TermForm::Dual(build) => dual_terms.push((weight, build)),
                TermForm::Background { .. } => {}
            }
        }
        if self.is_fused() {
            return Box::new(Variation::new(shape, variation));
        }
        let sum = Composite::new(shape, variation, traces);
        let terms = dual_terms.into_iter();
        Box::new(terms.fold(sum, |sum, (weight, build)| sum.with(weight, build(shape))))
    }

    /// Whether [`Variation`] alone computes the foreground.
    fn is_fused(&self) -> bool {
        self.terms_of_foreground()
            .all(|(term, _)| matches!(term.form, TermForm::Fused(_)))
    }

    fn terms_of_foreground(&self) -> impl Iterator<Item = (&'static TermSpec, f64)> {
        self.terms().filter(|(term, _)| term.background().is_none())
    }

    /// Factor on the solver's threshold `β`:
    ///
    /// ```text
    /// 1                  if all terms are tv, tdiff or l1, whatever their weights
    /// min_i unit_i/w_i   else, over the terms of the foreground
    /// ```
    ///
    /// `unit_i` is the size of what term `i` acts on, in units of the brightness of a voxel; `w_i` is its weight.
    ///
    /// Without the factor `β` is a fraction of the brightness of a voxel. The norm of a trace, a
    /// singular value and a transform coefficient are larger than that; a threshold for voxels would
    /// need thousands of iterations to act (`docs/design/012`).
    pub(super) fn threshold_factor(&self, shape: Shape) -> f64 {
        if self.is_fused() {
            return 1.0;
        }
        self.terms_of_foreground()
            .map(|(term, weight)| (term.unit)(shape) / weight)
            .fold(f64::INFINITY, f64::min)
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
        match self.temporal_term() {
            None => Ok(()),
            Some(name) => Err(Error::input(
                Parameter::Prior,
                format!("\"{name}\" for a video of 1 bin"),
                format!("{name} compares bins and needs at least 2"),
                "Use auto, or terms of space alone: tv, l1, dct, wavelet. A video of 1 bin comes from shutter = \"global\".",
            ).with_kind(ErrorKind::Unsupported)),
        }
    }

    /// Checks that no term couples all bins, so that a chunk of them can be reconstructed by itself.
    ///
    /// # Errors
    /// A term over all bins.
    pub fn check_chunks(&self) -> Result<()> {
        match self.term_coupling(Coupling::All) {
            None => Ok(()),
            Some(name) => Err(Error::input(
                Parameter::Prior,
                format!("\"{name}\" for a video that is reconstructed in chunks"),
                format!("{name} couples all bins, which would be in different chunks"),
                phrase![
                    "Use terms of space and of neighbouring bins, such as tv+support, tv+0.5*tdiff+support, wavelet, or leave ",
                    Parameter::PartBins,
                    " out."
                ],
            )
            .with_kind(ErrorKind::Unsupported)),
        }
    }

    /// Whether a term couples neighbouring bins.
    pub(super) fn couples_neighbours(&self) -> bool {
        self.term_coupling(Coupling::Neighbours).is_some()
    }

    /// The name of a term that couples these bins.
    fn term_coupling(&self, coupling: Coupling) -> Option<&'static str> {
        let mut terms = self.terms().filter(|(term, _)| term.coupling == coupling);
        terms.next().map(|(term, _)| term.name)
    }

    /// The name of a term that couples bins.
    fn temporal_term(&self) -> Option<&'static str> {
        self.term_coupling(Coupling::Neighbours)
            .or(self.term_coupling(Coupling::All))
    }
}

/// `a == b`, where `==` is not possible yet.
const fn is_same(a: &str, b: &str) -> bool {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    let mut i = 0;
    while i < a.len() && i < b.len() && a[i] == b[i] {
        i += 1;
    }
    i == a.len() && i == b.len()
}

/// The error of a prior's text: `found` breaks `rule`.
fn refuse<T>(found: &str, rule: impl Into<Phrase>) -> Result<T> {
    Err(Error::input(
        Parameter::Prior,
        format!("\"{found}\""),
        rule,
        format!(
            "Use auto, or terms of {} joined by +, each with a weight if it is not 1: tv+0.5*tdiff.",
            Prior::names().collect::<Vec<_>>().join(", ")
        ),
    ))
}

impl std::str::FromStr for Prior {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let mut prior = Self {
            weights: [0.0; TERMS.len()],
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
            let index = TERMS.iter().position(|term| term.name == name);
            match (name, index) {
                (_, Some(index)) => prior.weights[index] = weight,
                (SUPPORT, None) if weight == 1.0 => prior.support = true,
                (SUPPORT, None) => return refuse(term, "support has no weight"),
                ("auto", None) => {
                    return refuse(text, "auto is the program's choice of a prior, not a term");
                }
                (_, None) => return refuse(term, unknown(name)),
            }
        }
        if seen == [SUPPORT] {
            return refuse(text, "support must be combined with a convex term");
        }
        for (term, _) in prior.terms() {
            if let Some((other, rule)) = term.excludes
                && prior.weight(other) > 0.0
            {
                return refuse(text, rule);
            }
        }
        if prior.background() == Background::Alone {
            if prior.support {
                return refuse(text, "support restricts a foreground, and here is none");
            }
        } else if prior.terms_of_foreground().next().is_none() {
            return refuse(
                text,
                "a background of low rank must be combined with a convex term for the foreground",
            );
        }
        Ok(prior)
    }
}

/// The rule that an unknown `name` breaks, with the nearest name where one is similar.
fn unknown(name: &str) -> String {
    let nearest_term = Prior::names()
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
        for name in Self::names() {
            let weight = match name {
                SUPPORT => f64::from(u8::from(self.support)),
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
            "background",
            "2*background",
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
            ("background+support", "support restricts a foreground"),
            (
                "lowrank-background+support",
                "a background of low rank must be combined with a convex term",
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
        for term in TERMS {
            let name = term.name;
            // A background needs a foreground term.
            let before = match term.background() {
                Some(_) => "1e-9*l1+",
                None => "",
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
                if name == "tv" { "l1" } else { "tv" }
            ));
            assert!(combined > once, "{name}");
        }
    }

    #[test]
    fn the_documentation_lists_every_term() {
        let text = include_str!("prior.rs");
        for term in TERMS {
            let row = text
                .lines()
                .find(|line| line.starts_with(&format!("//! | `{}` |", term.name)));
            assert!(row.is_some(), "{}", term.name);
        }
    }
}
