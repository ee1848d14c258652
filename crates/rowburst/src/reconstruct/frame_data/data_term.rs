//! The data term as the solver sees it.

use super::FrameData;
use crate::reconstruct::x_step;
use rowburst_core::Support;
use rowburst_core::linop::{Background, LinearOperator, WritePart};
use rowburst_solve::{Capabilities, DataTerm, FusedAdjoint};

impl DataTerm for FrameData {
    fn operator(&self) -> &dyn LinearOperator {
        self.system.stacked_operator()
    }

    fn measurements(&self) -> &[f32] {
        &self.measurements
    }

    fn measurement_count(&self) -> usize {
        self.measurement_count
    }

    fn scale(&self) -> f64 {
        self.system.scale()
    }

    fn min_rho(&self) -> f64 {
        x_step::min_rho(&self.system)
    }

    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool {
        let equation = x_step::Equation { r, rho, y, gram_y };
        self.x_step.solve(&self.system, equation)
    }

    fn residual_rms_of_bins(&self, residual: &[f32]) -> Vec<f64> {
        let operator = self.system.shutter();
        let mut sums = vec![(0.0, 0usize); self.shape().bins];
        for (instant, run) in operator.time().instants().iter().enumerate() {
            let indices = operator.indices_of(instant);
            let usable = |i: &&usize| {
                self.system
                    .operator()
                    .weights()
                    .is_none_or(|w| w[**i] > 0.0)
            };
            let count = indices.iter().filter(usable).count();
            let power: f64 = indices
                .iter()
                .map(|&i| f64::from(residual[i]).powi(2))
                .sum();
            for sum in &mut sums[run.first_bin..run.first_bin + run.weights.len()] {
                *sum = (sum.0 + power, sum.1 + count);
            }
        }
        sums.iter()
            .map(|(power, count)| (power / (*count).max(1) as f64).sqrt())
            .collect()
    }

    fn restrict(&mut self, support: &Support) {
        let before = self.system.set_support(support);
        self.x_step.restrict(&self.system, before.as_ref());
    }

    fn adjoint_on(&self, y: &[f32], support: Option<&Support>, video: &mut [f32]) {
        match (self.background(), support) {
            (Background::None, Some(support)) => {
                let weighted = self.system.operator().weigh(y);
                self.system.shutter().adjoint_on(&weighted, support, video);
            }
            (_, None) => self.operator().adjoint(y, video),
            (_, Some(support)) => {
                self.operator().adjoint(y, video);
                support.zero_outside(video);
            }
        }
    }

    fn update_weights(&mut self, video: &[f32]) -> bool {
        let Some(noise) = &self.noise else {
            return false;
        };
        let weights = noise.weights(&self.predicted(video));
        self.weights = Some(super::limited(weights, self.shutter()));
        self.apply_weights();
        self.x_step.rebuild(&self.system);
        true
    }

    fn capabilities(&self) -> Capabilities<'_> {
        let is_fused = matches!(self.background(), Background::None | Background::Alone);
        Capabilities {
            hints: self.x_step.hints(&self.system),
            fused_adjoint: is_fused.then_some(self),
            cancel: Some(self.cancel()),
        }
    }
}

impl FusedAdjoint for FrameData {
    fn adjoint_each(
        &self,
        y: &[f32],
        support: Option<&Support>,
        target: &mut [f32],
        write: WritePart,
    ) {
        let weighted = self.system.operator().weigh(y);
        self.system
            .shutter()
            .adjoint_each(&weighted, support, target, write);
    }
}
