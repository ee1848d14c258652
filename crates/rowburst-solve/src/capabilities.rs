//! What a data term may offer a solver beside its mathematics.

use super::DataTerm;
use rowburst_core::linop::{WritePart, write_parts};
use rowburst_core::{Cancel, Support};

/// What a data term offers beside its mathematics. A solver works without any of it.
#[derive(Clone, Copy, Default)]
pub struct Capabilities<'a> {
    /// What a step costs.
    pub hints: DataHints,
    /// `P Aᵀ` without memory for a whole video.
    pub fused_adjoint: Option<&'a dyn FusedAdjoint>,
    /// A request to stop. Once it is made, [`DataTerm::solve_gram`] may return early with a wrong solution.
    pub cancel: Option<&'a Cancel>,
}

/// What a solver may know of the cost of a data term. It chooses constants of the iteration, and with them, where the
/// support makes the problem non-convex, which of its solutions is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DataHints {
    /// Which constants it takes.
    pub kind: ProblemKind,
    /// Most active voxels of a bin for which a restricted x-step takes less time than an unrestricted one.
    ///
    /// A bin with more is unrestricted in the x-step; the prior alone keeps its inactive voxels at zero.
    pub max_restricted_voxels: usize,
}

impl Default for DataHints {
    fn default() -> Self {
        Self {
            kind: ProblemKind::Small,
            max_restricted_voxels: usize::MAX,
        }
    }
}

/// What a new factor of the x-step costs, and whether bins depend on each other; it chooses the values of [`super::admm::KindTuning`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ProblemKind {
    /// A new factor costs about as much as an iteration, or no factor is needed.
    #[default]
    Small,
    /// A wide sensor, whose blocks have thousands of measurements: a new factor costs more than ten iterations.
    Wide,
    /// Exposures longer than a row: rows share bins, and light in a wrong bin is found more slowly.
    Coupled,
}

/// A data term that computes `P Aᵀ y` part by part.
pub trait FusedAdjoint {
    /// Calls `write(start, part, target)` for each part of [`DataTerm::adjoint_on`], in any order and in parallel:
    /// `part` is the result from element `start` on, and `target` has the same elements of the argument `target`.
    /// Parts without an active voxel may be left out.
    fn adjoint_each(
        &self,
        y: &[f32],
        support: Option<&Support>,
        target: &mut [f32],
        write: WritePart,
    );
}

/// [`FusedAdjoint::adjoint_each`] of any data term.
pub(crate) fn write_adjoint(
    data: &dyn DataTerm,
    y: &[f32],
    support: Option<&Support>,
    target: &mut [f32],
    write: WritePart,
) {
    if let Some(fused) = data.capabilities().fused_adjoint {
        return fused.adjoint_each(y, support, target, write);
    }
    let mut video = vec![0.0; target.len()];
    data.adjoint_on(y, support, &mut video);
    write_parts(&video, target, write);
}
