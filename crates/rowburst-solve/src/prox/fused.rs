//! The terms that [`Variation`] computes, and a static background.

use super::term::{Coupling, TermForm, TermSpec, one_voxel};
use super::variation::{Variation, VariationWeights};
use rowburst_core::Shape;
use rowburst_core::linop::Background;

const FUSED: TermSpec = TermSpec {
    name: "",
    favours: "",
    coupling: Coupling::None,
    excludes: None,
    unit: one_voxel,
    form: TermForm::Fused(|weights| &mut weights.space),
};

/// The term `tv`.
pub const TV: TermSpec = TermSpec {
    name: "tv",
    favours: "shapes with edges",
    ..FUSED
};

/// The term `tdiff`.
pub const TDIFF: TermSpec = TermSpec {
    name: "tdiff",
    favours: "light that is switched on and off",
    coupling: Coupling::Neighbours,
    form: TermForm::Fused(|weights| &mut weights.time),
    ..FUSED
};

/// The term `l1`.
pub const L1: TermSpec = TermSpec {
    name: "l1",
    favours: "points",
    form: TermForm::Fused(|weights| &mut weights.l1),
    ..FUSED
};

/// The term `background`: `tv` of a static background, which has the same picture in every bin.
pub const BACKGROUND: TermSpec = TermSpec {
    name: "background",
    favours: "a scene in front of a static background; alone, a scene at rest",
    coupling: Coupling::All,
    excludes: None,
    unit: one_voxel,
    form: TermForm::Background {
        kind: Background::Static,
        prox: |shape, weight| {
            let picture = Shape::new(1, shape.rows, shape.columns);
            let weights = VariationWeights {
                space: weight * (shape.bins as f64).sqrt(),
                ..VariationWeights::NONE
            };
            Box::new(Variation::new(picture, weights))
        },
    },
};
