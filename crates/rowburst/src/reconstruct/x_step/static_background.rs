//! The exact x-step with a static background, which couples all blocks (docs/design/012).

use super::exact_blocks::block_hints;
use super::{Equation, System, XStep};
use rowburst_core::Support;
use rowburst_core::linop::{Background, LinearOperator, WeightedOperator, sum_of_bins};
use rowburst_optics::RollingShutter;
use rowburst_solve::DataHints;
use rowburst_solve::blocks::Blocks;
use rowburst_solve::coupled_blocks::{CoupledBlocks, CoupledSystem};
use std::sync::Arc;

/// The blocks of the foreground, with the Schur complement of the background.
pub struct StaticBackground {
    /// Always f64: its right-hand sides do not converge, so incremental solves in f32 do not help.
    blocks: Blocks<f64>,
    coupled: CoupledBlocks,
}

impl StaticBackground {
    pub fn new(system: &System) -> Self {
        Self {
            blocks: system.blocks(),
            coupled: CoupledBlocks::default(),
        }
    }
}

impl XStep for StaticBackground {
    fn solve(&mut self, system: &System, equation: Equation) -> bool {
        let Equation { r, rho, y, gram_y } = equation;
        let coupling = StaticBackgroundOperator(system.operator());
        let inverse = |g: &[f32], rho: f64, h: f64| {
            let divided = system
                .whole_field_operator()
                .and_then(|whole_field| whole_field.circulant_inverse(g, rho / h));
            divided.unwrap_or_else(|| g.to_vec())
        };
        let blocks = &mut self.blocks;
        let mut solve = |r: &[f32], y: &mut [f32]| blocks.solve(r, rho, y);
        let coupled_system = CoupledSystem {
            blocks: &mut solve,
            coupling: &coupling,
            inverse: &inverse,
        };
        let is_good = self.coupled.solve(coupled_system, r, rho, y, gram_y);
        is_good && !self.blocks.is_ill_conditioned()
    }

    fn solve_alone(&mut self, system: &System, equation: Equation) {
        self.coupled.reset();
        self.solve(system, equation);
    }

    fn restrict(&mut self, system: &System, before: Option<&Support>) {
        let has_changed = |instant| system.has_changed_at(instant, before);
        self.blocks.rebuild_changed(has_changed, system);
    }

    fn rebuild(&mut self, system: &System) {
        self.blocks.rebuild_all(system);
    }

    fn reset(&mut self) -> bool {
        self.coupled.reset();
        true
    }

    fn is_renewed_by_rebuild(&self, background: Background) -> bool {
        background == Background::Static
    }

    fn hints(&self, system: &System) -> DataHints {
        block_hints(system)
    }

    #[cfg(test)]
    fn method(&self) -> super::Method {
        super::Method::StaticBackground
    }
}

/// `W A E`, where `E` repeats a picture in all bins: the operator of a static background.
struct StaticBackgroundOperator<'a>(&'a WeightedOperator<Arc<RollingShutter>>);

impl LinearOperator for StaticBackgroundOperator<'_> {
    fn domain_len(&self) -> usize {
        self.0.inner().video_shape().pixels()
    }

    fn range_len(&self) -> usize {
        self.0.range_len()
    }

    fn apply(&self, picture: &[f32], light: &mut [f32]) {
        let bins = self.0.inner().video_shape().bins;
        self.0.apply(&picture.repeat(bins), light);
    }

    fn adjoint(&self, light: &[f32], picture: &mut [f32]) {
        let mut video = vec![0.0; self.0.domain_len()];
        self.0.adjoint(light, &mut video);
        sum_of_bins(&video, picture);
    }
}
