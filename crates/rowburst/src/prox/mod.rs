//! Proximal operators of the priors.
//!
//! [`Variation`] is the fused one of the default; [`Composite`] adds terms of any kind.

pub mod composite;
pub mod dual;
pub mod lowrank;
pub mod parts;
mod rows;
pub mod sparse;
pub mod variation;
pub mod variation3d;
mod wave;

pub use composite::Composite;
pub use dual::DualTerm;
pub use lowrank::LowRank;
pub use parts::Parts;
pub use sparse::Sparse;
pub use variation::{Variation, VariationWeights};
pub use variation3d::{Isotropy, Variation3d};

use crate::Support;
use crate::vecmath::{pieces, simd};
use rayon::prelude::*;
use std::ops::{AddAssign, Range};

/// How a video has moved.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Moved {
    /// `‖z‖²`.
    pub size: f64,
    /// `‖z − z_last‖²`.
    pub distance: f64,
}

impl AddAssign for Moved {
    fn add_assign(&mut self, other: Self) {
        self.size += other.size;
        self.distance += other.distance;
    }
}

/// A convex prior `R(v)` with the constraint `v ≥ 0` inside.
///
/// An iterative prox may keep its inner state from call to call, so that each call
/// goes on where the last one stopped.
pub trait Prox: Send {
    /// `z = argmin_{z≥0} ½‖z − q‖² + scale·R(z)`; overwrites `z`.
    ///
    /// # Panics
    /// If a length does not match.
    fn prox(&mut self, q: &[f32], scale: f64, z: &mut [f32]);

    /// `z = prox(q)` and then `q −= z`; how far that is from `last`, the last `z`. All outside `runs` is dark.
    ///
    /// # Panics
    /// If a length does not match.
    fn prox_and_rest(
        &mut self,
        q: &mut [f32],
        scale: f64,
        z: &mut [f32],
        last: &[f32],
        runs: &[Range<usize>],
    ) -> Moved {
        self.prox(q, scale, z);
        let steps = pieces(q, runs).into_par_iter().zip(runs);
        let parts: Vec<Moved> = steps
            .map(|(q, run)| subtract(q, &z[run.clone()], &last[run.clone()]))
            .collect();
        let mut sum = Moved::default();
        parts.iter().for_each(|part| sum += *part);
        sum
    }

    /// `R(z)`.
    fn value(&self, z: &[f32]) -> f64;

    /// Estimate of the number of values in `z` that the data are free to choose;
    /// differences below `tolerance` count as none.
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64;

    /// From now on the prox is taken over videos that are zero outside `support`.
    fn restrict(&mut self, support: &Support);

    /// `v −= c` for a `c` with `⟨c, w⟩ ≤ scale·R(w)` for every `w ≥ 0`: the dual point at
    /// which the last call of [`Self::prox`] ended, with its `scale`. Where that is
    /// positive, `v` is more than the prior holds back. Elements below zero may be cut.
    fn subtract_dual(&self, v: &mut [f32]);
}

/// `q −= z`.
fn subtract(q: &mut [f32], z: &[f32], last: &[f32]) -> Moved {
    /// Elements of which sums are f32, in so many lanes.
    const PART: usize = 256;
    const LANES: usize = 16;
    let mut moved = Moved::default();
    let parts = q
        .chunks_mut(PART)
        .zip(z.chunks(PART))
        .zip(last.chunks(PART));
    simd(
        #[inline(always)]
        || {
            for ((q, z), last) in parts {
                let (mut size, mut distance) = ([0.0f32; LANES], [0.0f32; LANES]);
                let (q, q_rest) = q.as_chunks_mut::<LANES>();
                let (z, z_rest) = z.as_chunks::<LANES>();
                let (last, last_rest) = last.as_chunks::<LANES>();
                for ((q, z), last) in q.iter_mut().zip(z).zip(last) {
                    for i in 0..LANES {
                        q[i] -= z[i];
                        size[i] += z[i] * z[i];
                        distance[i] += (z[i] - last[i]) * (z[i] - last[i]);
                    }
                }
                for ((q, z), last) in q_rest.iter_mut().zip(z_rest).zip(last_rest) {
                    *q -= z;
                    size[0] += z * z;
                    distance[0] += (z - last) * (z - last);
                }
                let sum = |lanes: [f32; LANES]| lanes.iter().map(|s| f64::from(*s)).sum::<f64>();
                moved += Moved {
                    size: sum(size),
                    distance: sum(distance),
                };
            }
        },
    );
    moved
}

#[cfg(test)]
mod tests;
