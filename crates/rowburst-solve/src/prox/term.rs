//! A convex term of which priors are built; [`super::TERMS`] is their table.

use super::Prox;
use super::dual::DualTerm;
use super::variation::VariationWeights;
use rowburst_core::Shape;
use rowburst_core::linop::Background;

/// A convex term `R(v)` of a prior: its name, and how it is computed.
#[derive(Debug, Clone, Copy)]
pub struct TermSpec {
    /// Its name in the text form of a prior.
    pub name: &'static str,
    /// What it favours, in a few words.
    pub favours: &'static str,
    /// Which bins it couples.
    pub coupling: Coupling,
    /// Another term that cannot be combined with it, and why.
    pub excludes: Option<(&'static str, &'static str)>,
    /// Size of what it acts on in videos of a shape, in units of the brightness of a voxel; larger shrinks the term
    /// more in each iteration (docs/design/012).
    pub unit: fn(Shape) -> f64,
    /// How it is computed.
    #[doc(hidden)]
    pub form: TermForm,
}

impl TermSpec {
    /// A term that is computed in its dual, on single voxels or their differences.
    pub const fn dual(
        name: &'static str,
        favours: &'static str,
        build: fn(Shape) -> Box<dyn DualTerm>,
    ) -> Self {
        Self {
            name,
            favours,
            coupling: Coupling::None,
            excludes: None,
            unit: one_voxel,
            form: TermForm::Dual(build),
        }
    }

    /// The kind of background; `None` for a term of the foreground.
    pub fn background(&self) -> Option<Background> {
        match self.form {
            TermForm::Background { kind, .. } => Some(kind),
            _ => None,
        }
    }
}

/// Which bins of a video a term couples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coupling {
    /// None: each bin has a sum of its own.
    None,
    /// Each with those next to it.
    Neighbours,
    /// All of them.
    All,
}

/// How a term is computed.
#[derive(Debug, Clone, Copy)]
#[doc(hidden)]
pub enum TermForm {
    /// In one pass with the other terms of [`super::Variation`]: its weight there.
    Fused(fn(&mut VariationWeights) -> &mut f64),
    /// In closed form by [`super::Composite`]: the norm over time of each pixel.
    Traces,
    /// In its dual by [`super::Composite`].
    Dual(fn(Shape) -> Box<dyn DualTerm>),
    /// On a second unknown, the background, by [`super::SumPrior`].
    Background {
        /// The kind of background.
        kind: Background,
        /// Its prox with a weight.
        prox: fn(Shape, f64) -> Box<dyn Prox>,
    },
}

/// The unit of a term on single voxels or their differences.
pub fn one_voxel(_: Shape) -> f64 {
    1.0
}
