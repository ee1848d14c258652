//! The certificate, and when a run stops (docs/design/009).

use super::AdmmParams;
use super::brightness::CHUNK;
use super::penalty::Penalty;
use super::variables::Variables;
use crate::prox::Prox;
use crate::{Certificate, DataTerm};
use rayon::prelude::*;
use rowburst_core::Support;
use rowburst_core::vecmath::{distance_squared, dot, norm_squared};

/// Says when the run is to be certified, and stops it.
///
/// A small change of the video proves nothing: ADMM can be slow far from the minimum. So the run stops once a lower
/// bound of the minimum, from the variables that the iteration has anyway, is close to the objective. A bound costs
/// about as much as an iteration, and holds for one problem only: it is computed every few iterations, where `β` is
/// constant, the controllers left `ρ` unchanged and the support is stable.
#[derive(Clone)]
pub(super) struct Stopping {
    /// See [`AdmmParams::tolerance`].
    tolerance: f64,
    check_interval: usize,
    brightness_bound: f64,
}

impl Stopping {
    pub fn new(params: &AdmmParams) -> Self {
        Self {
            tolerance: params.tolerance,
            check_interval: params.tuning.check_interval,
            brightness_bound: params.tuning.brightness_bound,
        }
    }

    pub fn set_tolerance(&mut self, tolerance: f64) {
        self.tolerance = tolerance;
    }

    /// Whether iteration `k` computes the objective: the first one, and one in each interval.
    pub fn computes_objective(&self, k: usize) -> bool {
        (k - 1).is_multiple_of(self.check_interval)
    }

    /// Whether iteration `k` of a settled run computes a certificate.
    pub fn certifies(&self, k: usize) -> bool {
        k.is_multiple_of(self.check_interval)
    }

    /// Whether the certificate proves that the run is done.
    pub fn has_converged(&self, certificate: &Certificate) -> bool {
        certificate.excess() <= self.tolerance
    }

    /// The certificate of the variables; see **Stopping** in the head of [`super`]. Overwrites the scratch buffer.
    pub fn certify(
        &self,
        variables: &mut Variables,
        penalty: &Penalty,
        supports: Supports,
        data: &dyn DataTerm,
        prior: &dyn Prox,
    ) -> Certificate {
        let b = data.measurements();
        let Variables { z, y, scratch, .. } = &mut *variables;
        let brightest = z.par_iter().copied().reduce(|| 0.0, f32::max);
        // Voxels outside the support of the x-step are zero before `subtract_dual`, since `group` reads a pixel's whole
        // trace. Afterwards all outside the support of the video are set to zero.
        data.adjoint_on(y, supports.of_x_step, scratch);
        prior.subtract_dual(scratch);
        if let Some(support) = supports.of_video {
            support.zero_outside(scratch);
        }
        // `y` and `c` are over ρ, and so are the sums: `linear` and `quadratic` scale them.
        let excess: f64 = scratch
            .par_chunks(CHUNK)
            .map(|x| x.iter().map(|v| f64::from(v.max(0.0))).sum::<f64>())
            .collect::<Vec<_>>()
            .iter()
            .sum();
        let rho = penalty.rho();
        let linear = rho * (dot(b, y) - self.brightness_bound * f64::from(brightest) * excess);
        let quadratic = rho * rho * norm_squared(y);
        Certificate {
            primal: objective(variables, penalty.tau(), data, prior),
            dual: best_scaled(linear, quadratic),
        }
    }
}

/// The supports of a certificate; `None`: every voxel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Supports<'a> {
    pub of_video: Option<&'a Support>,
    pub of_x_step: Option<&'a Support>,
}

/// The largest bound `s·linear − s²/2·quadratic`: `sρ·y` with `sρ·c` is a dual point for every `0 ≤ s ≤ 1`.
fn best_scaled(linear: f64, quadratic: f64) -> f64 {
    let s = if quadratic > 0.0 {
        (linear / quadratic).clamp(0.0, 1.0)
    } else {
        0.0
    };
    s * linear - 0.5 * s * s * quadratic
}

/// `½‖b − A z‖² + τ R(z)`.
pub(super) fn objective(
    variables: &Variables,
    tau: f64,
    data: &dyn DataTerm,
    prior: &dyn Prox,
) -> f64 {
    0.5 * distance_squared(data.measurements(), &variables.az) + tau * prior.value(&variables.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admm::TauRule;

    #[test]
    fn the_best_multiple_of_a_dual_point_is_taken() {
        assert_eq!(best_scaled(1.0, 0.0), 0.0);
        assert_eq!(best_scaled(-1.0, 1.0), 0.0);
        assert_eq!(best_scaled(1.0, 4.0), 0.125);
        assert_eq!(best_scaled(4.0, 1.0), 3.5);
    }

    #[test]
    fn checks_come_at_intervals() {
        let mut stopping = Stopping::new(&AdmmParams::new(TauRule::Fixed(1.0)));
        let objectives: Vec<usize> = (1..14)
            .filter(|k| stopping.computes_objective(*k))
            .collect();
        assert_eq!(objectives, [1, 6, 11]);
        let certificates: Vec<usize> = (1..14).filter(|k| stopping.certifies(*k)).collect();
        assert_eq!(certificates, [5, 10]);
        stopping.set_tolerance(0.1);
        let certificate = |primal| Certificate { primal, dual: 1.0 };
        assert!(stopping.has_converged(&certificate(1.05)));
        assert!(!stopping.has_converged(&certificate(1.2)));
    }
}
