//! The exact x-step on a support whose bins are seen by several instants.
//!
//! With `B = W A P`, one column for each active voxel, the x-step is
//!
//! ```text
//! y = (r − B s)/ρ,   (BᵀB + ρI) s = Bᵀ r
//! ```
//!
//! (Woodbury; Golub & Van Loan, 4th ed., section 2.1.4). Ordered in time, `BᵀB` is banded, since bins further apart than
//! an exposure have no instant in common (docs/design/025).

use crate::active_gram::ActiveColumns;
use rowburst_core::Support;
use rowburst_core::linop::{LinearOperator, WeightedOperator};
use rowburst_optics::RollingShutter;
use rowburst_solve::block_band::{BandFactor, BlockBand};
use std::sync::Arc;

/// Multiplications of a factor for each voxel of the video, above which conjugate gradients take less time
/// (docs/design/025).
const MAX_COST: f64 = 4e4;

/// Most elements of `B` where an instant reads whole planes, whose columns hold all pixels; more need more memory and time.
const MAX_PLANE_ELEMENTS: usize = 1 << 25;

/// `BᵀB` with its factor.
pub struct ActiveSystem {
    operator: Arc<WeightedOperator<Arc<RollingShutter>>>,
    support: Support,
    /// Indices of the active voxels.
    voxels: Vec<usize>,
    band: BlockBand<f32>,
    /// The factor of the last solve, with its `ρ`.
    factor: Option<(f64, BandFactor<f32>)>,
    previous: Option<Previous>,
}

/// `(B Bᵀ + ρI) y = r` at the last solve.
struct Previous {
    rho: f64,
    r: Vec<f32>,
    y: Vec<f64>,
}

impl ActiveSystem {
    /// The system of `support`; `None` where conjugate gradients take less time.
    pub fn new(
        operator: &Arc<WeightedOperator<Arc<RollingShutter>>>,
        support: &Support,
    ) -> Option<Self> {
        let shutter = operator.inner();
        let shape = shutter.video_shape();
        let bins = (0..shape.bins).map(|bin| support.pixels_of(bin));
        let columns = ActiveColumns {
            operator: shutter,
            weights: operator.weights(),
            instants: 0..shutter.time().instants().len(),
            first_bin: 0,
            pixels: bins.collect::<Option<_>>()?,
        };
        if columns.cost() > MAX_COST * shape.voxels() as f64 {
            return None;
        }
        let active: usize = columns.pixels.iter().map(|pixels| pixels.len()).sum();
        if shutter.convolves_planes() && active * operator.range_len() > MAX_PLANE_ELEMENTS {
            return None;
        }
        let bins = columns.pixels.iter().enumerate();
        let voxels =
            bins.flat_map(|(t, pixels)| pixels.iter().map(move |p| t * shape.pixels() + p));
        Some(Self {
            operator: Arc::clone(operator),
            support: support.clone(),
            voxels: voxels.collect(),
            band: columns.gram(),
            factor: None,
            previous: None,
        })
    }

    /// Makes the next [`Self::solve`] the first one again.
    pub fn reset(&mut self) {
        self.previous = None;
    }

    /// Solves `(B Bᵀ + ρI) y = r` for an `r` that converges over the iterations, and sets `gram_y = B Bᵀ y`. Returns
    /// whether the factor is well conditioned.
    ///
    /// Each call solves for the change of `y` since the last one, so that rounding errors fade with the change.
    pub fn solve(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool {
        let (mut whole, change): (Vec<f64>, Vec<f32>) = match self.previous.take() {
            None => (vec![0.0; r.len()], r.to_vec()),
            Some(previous) => {
                let decrease = previous.rho - rho;
                let pairs = r.iter().zip(&previous.r).zip(&previous.y);
                let change = pairs
                    .map(|((r, p), y)| (f64::from(*r) - f64::from(*p) + decrease * y) as f32)
                    .collect();
                (previous.y, change)
            }
        };
        let operator = Arc::clone(&self.operator);
        let mut video = vec![0.0; operator.domain_len()];
        let weighted = operator.weigh(&change);
        operator
            .inner()
            .adjoint_on(&weighted, &self.support, &mut video);
        let mut values: Vec<f32> = self.voxels.iter().map(|&i| video[i]).collect();
        self.factor(rho).solve(&mut values);
        for (&i, value) in self.voxels.iter().zip(&values) {
            video[i] = *value;
        }
        let mut light = vec![0.0; r.len()];
        operator.apply(&video, &mut light);
        for i in 0..r.len() {
            whole[i] += (f64::from(change[i]) - f64::from(light[i])) / rho;
            y[i] = whole[i] as f32;
            gram_y[i] = (f64::from(r[i]) - rho * whole[i]) as f32;
        }
        self.previous = Some(Previous {
            rho,
            r: r.to_vec(),
            y: whole,
        });
        !self.factor(rho).is_ill_conditioned()
    }

    /// The factor of `BᵀB + ρI`, made anew where `ρ` has changed.
    fn factor(&mut self, rho: f64) -> &BandFactor<f32> {
        let factor = match self.factor.take() {
            Some((of, factor)) if of == rho => factor,
            Some((_, mut factor)) => {
                self.band.refactor(rho, &mut factor);
                factor
            }
            None => self.band.factor(rho),
        };
        &self.factor.insert((rho, factor)).1
    }
}
