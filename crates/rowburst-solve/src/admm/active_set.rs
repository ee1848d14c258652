//! The controller that restricts the video to its support, the set of active voxels (docs/design/007).

use super::AdmmParams;
use super::brightness::capped_brightness;
use super::phase::Schedule;
use super::support_estimator::{SupportEstimator, Underfit};
use super::tuning::Tuning;
use super::variables::Variables;
use crate::DataTerm;
use crate::prox::Prox;
use rayon::prelude::*;
use rowburst_core::{Shape, Support};

/// Restricts the variables to the support that a [`SupportEstimator`] finds.
///
/// In a sparse scene few voxels are active, and the data determine these far better if the others are known to be
/// zero. Without a restriction most iterations go into haze that moves slowly out of inactive voxels. The restriction
/// must not cut off light that the video does not show yet, so it begins after the warm-up, and bins that cannot
/// explain their measurements are widened or unrestricted.
#[derive(Clone)]
pub(super) struct ActiveSet {
    shape: Shape,
    estimator: SupportEstimator,
    /// See [`AdmmParams::support`].
    is_used: bool,
    tuning: Tuning,
}

/// What an update of the active set did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Restriction {
    /// Nothing, since the support is stable.
    None,
    /// A support was found, and all voxels were active before.
    Begins,
    /// Another support was found.
    Changes,
}

impl ActiveSet {
    /// All voxels are active.
    pub fn new(data: &dyn DataTerm, shape: Shape, params: &AdmmParams) -> Self {
        Self {
            shape,
            estimator: SupportEstimator::new(shape, data.capabilities().hints, &params.tuning),
            is_used: params.support,
            tuning: params.tuning,
        }
    }

    /// The support; `None`: every voxel.
    pub fn support(&self) -> Option<&Support> {
        self.estimator.support()
    }

    /// The support of the x-step, see [`SupportEstimator::x_step_support`].
    pub fn x_step_support(&self) -> Option<&Support> {
        self.estimator.x_step_support()
    }

    /// See [`AdmmParams::support`].
    pub fn is_used(&self) -> bool {
        self.is_used
    }

    /// Part of the voxels that are active, from 0 to 1.
    pub fn fraction(&self) -> f64 {
        self.estimator.fraction()
    }

    /// Whether a support is used and some bin is unrestricted.
    pub fn has_unrestricted_bin(&self) -> bool {
        self.is_used && self.estimator.has_unrestricted_bin()
    }

    /// Whether the support no longer changes.
    pub fn is_settled(&self) -> bool {
        !self.is_used || self.estimator.is_stable()
    }

    /// Whether an update is due in this iteration.
    pub fn is_due(&self, schedule: &Schedule) -> bool {
        self.is_used
            && !schedule.is_warming_up()
            && schedule.is_multiple_of(self.tuning.support_interval)
    }

    /// Lets the support change again.
    pub fn allow_changes(&mut self) {
        self.estimator.allow_changes();
    }

    /// Forgets which bins their support could not explain.
    pub fn forget_underfit_bins(&mut self) {
        self.estimator.forget_underfit_bins();
    }

    /// Updates the support, and sets the voxels outside it to zero.
    ///
    /// A bin's residual is compared to `reference_rms`.
    pub fn update(
        &mut self,
        variables: &mut Variables,
        data: &mut dyn DataTerm,
        prior: &mut dyn Prox,
        reference_rms: f64,
    ) -> Restriction {
        let mut underfit_bins = Vec::new();
        let was_unrestricted = self.fraction() == 1.0;
        if self.support().is_some() {
            let residual = variables.residual(data);
            let residual_rms = data.residual_rms_of_bins(&residual);
            underfit_bins = self.estimator.underfit_bins(residual_rms, reference_rms);
            if self.estimator.is_stable() && underfit_bins.is_empty() {
                return Restriction::None;
            }
            if !underfit_bins.is_empty() {
                data.operator().adjoint(&residual, &mut variables.scratch);
            }
        }
        let foreground = &variables.z[..self.shape.voxels()];
        let underfit = (!underfit_bins.is_empty()).then(|| Underfit {
            bins: &underfit_bins,
            correlation: &variables.scratch[..self.shape.voxels()],
        });
        let bright = capped_brightness(foreground, self.shape.pixels(), &self.tuning);
        let support = self.estimator.update(foreground, bright, underfit);
        prior.restrict(&support);
        self.restrict(variables, data, &support);
        if was_unrestricted && self.fraction() < 1.0 {
            Restriction::Begins
        } else {
            Restriction::Changes
        }
    }

    /// Sets the variables to zero outside `support`, and restricts the x-step.
    fn restrict(&self, variables: &mut Variables, data: &mut dyn DataTerm, support: &Support) {
        let voxels = self.shape.voxels();
        // In voxels that become inactive `q` and `z` fall alike, so the dual u = q − z stays as it was.
        let active = support
            .mask()
            .par_iter()
            .zip(&mut variables.z[..voxels])
            .zip(&mut variables.q[..voxels]);
        active
            .filter(|((active, _), _)| **active == 0)
            .for_each(|((_, z), q)| {
                *q -= *z;
                *z = 0.0;
            });
        if let Some(x_step_support) = self.x_step_support() {
            data.restrict(x_step_support);
            // Where the x-step is restricted too, the dual becomes zero.
            x_step_support.zero_outside(&mut variables.q);
        }
        variables.update_products(data);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admm::TauRule;
    use crate::prox::{Variation, VariationWeights};
    use rowburst_core::linop::LinearOperator;

    /// A data term with `A = I` whose residuals are those of the noise.
    struct Identity {
        measurements: Vec<f32>,
        support: Option<Support>,
    }

    impl LinearOperator for Identity {
        fn domain_len(&self) -> usize {
            self.measurements.len()
        }

        fn range_len(&self) -> usize {
            self.measurements.len()
        }

        fn apply(&self, x: &[f32], y: &mut [f32]) {
            y.copy_from_slice(x);
        }

        fn adjoint(&self, y: &[f32], x: &mut [f32]) {
            x.copy_from_slice(y);
        }
    }

    impl DataTerm for Identity {
        fn operator(&self) -> &dyn LinearOperator {
            self
        }

        fn measurements(&self) -> &[f32] {
            &self.measurements
        }

        fn measurement_count(&self) -> usize {
            self.measurements.len()
        }

        fn scale(&self) -> f64 {
            1.0
        }

        fn solve_gram(&mut self, _: &[f32], _: f64, _: &mut [f32], _: &mut [f32]) -> bool {
            unreachable!("no solve is asked for")
        }

        fn residual_rms_of_bins(&self, _: &[f32]) -> Vec<f64> {
            vec![1.0]
        }

        fn restrict(&mut self, support: &Support) {
            self.support = Some(support.clone());
        }
    }

    #[test]
    fn variables_are_zero_outside_the_support() {
        let shape = Shape::new(1, 9, 9);
        let mut data = Identity {
            measurements: vec![0.0; 81],
            support: None,
        };
        let params = AdmmParams::new(TauRule::Fixed(1.0));
        let mut prior = Variation::new(shape, VariationWeights::NONE);
        let mut variables = Variables::new(&data, 9);
        variables.z.fill(0.01);
        variables.q.fill(0.5);
        variables.z[40] = 1.0;
        let mut active_set = ActiveSet::new(&data, shape, &params);
        assert!(active_set.has_unrestricted_bin() && !active_set.is_settled());
        let mut update =
            |variables: &mut Variables| active_set.update(variables, &mut data, &mut prior, 1.0);
        assert_eq!(update(&mut variables), Restriction::Begins);
        let active = |values: &[f32]| values.iter().filter(|v| **v != 0.0).count();
        assert_eq!((active(&variables.z), active(&variables.q)), (9, 9));
        assert_eq!((&variables.az, &variables.aq), (&variables.z, &variables.q));
        assert_eq!(update(&mut variables), Restriction::Changes);
        assert_eq!(update(&mut variables), Restriction::None);
        assert!(active_set.is_settled() && !active_set.has_unrestricted_bin());
        assert_eq!(data.support.unwrap().fraction(), active_set.fraction());
    }
}
