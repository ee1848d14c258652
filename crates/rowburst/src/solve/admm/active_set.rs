//! The active set: the voxels to which the video is restricted (docs/design/007).

use super::AdmmParams;
use super::brightness::brightness;
use super::phase::Schedule;
use super::support_estimator::SupportEstimator;
use super::variables::Variables;
use crate::prox::Prox;
use crate::solve::DataTerm;
use crate::{Shape, Support};
use rayon::prelude::*;

/// Restricts the variables to the support that a [`SupportEstimator`] finds.
///
/// In a sparse scene few voxels are active, and the data determine these far better if the others are known to be
/// zero. Without a restriction most iterations go into haze that moves slowly out of inactive voxels. The restriction
/// must not cut off light that the video does not show yet, so it begins after the warm-up, and bins that cannot
/// explain their measurements are widened.
pub(super) struct ActiveSet {
    shape: Shape,
    estimator: SupportEstimator,
    /// See [`AdmmParams::support`].
    is_used: bool,
    interval: usize,
}

/// What an update of the active set did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Restriction {
    /// Nothing, since the support is stable.
    None,
    /// The first support with inactive voxels was found.
    First,
    /// Another support was found.
    Later,
}

impl ActiveSet {
    /// All voxels are active.
    pub fn new(data: &dyn DataTerm, shape: Shape, params: &AdmmParams) -> Self {
        let max_restricted = data.hints().max_restricted_voxels;
        Self {
            shape,
            estimator: SupportEstimator::new(shape, max_restricted, &params.tuning),
            is_used: params.support,
            interval: params.tuning.support_interval,
        }
    }

    /// The support; `None`: every voxel.
    pub fn support(&self) -> Option<&Support> {
        self.estimator.support()
    }

    /// The support of the x-step, see [`SupportEstimator::data_support`].
    pub fn data_support(&self) -> Option<&Support> {
        self.estimator.data_support()
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
        self.is_used && schedule.is_past_warm_up() && schedule.is_multiple_of(self.interval)
    }

    /// Prepares for another frame, which starts from the support of the last one.
    pub fn reset(&mut self) {
        self.estimator.reset();
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
                // `Aᵀ(b − A v)` is largest where the video lacks light.
                data.operator().adjoint(&residual, &mut variables.scratch);
            }
        }
        let foreground = &variables.z[..self.shape.voxels()];
        let correlation = &variables.scratch[..self.shape.voxels()];
        let bright = brightness(foreground);
        let support = self
            .estimator
            .update(foreground, bright, correlation, &underfit_bins);
        prior.restrict(&support);
        self.restrict(variables, data, &support);
        if was_unrestricted && self.fraction() < 1.0 {
            Restriction::First
        } else {
            Restriction::Later
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
        if let Some(data_support) = self.data_support() {
            data.restrict(data_support);
            // Where the x-step is restricted too, the dual becomes zero.
            data_support.zero_outside(&mut variables.q);
        }
        variables.update_products(data);
    }
}
