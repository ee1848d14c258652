//! Counting: how many numbers of an instant speak about the change of a scene.
//!
//! An instant measures `b = B v + n`, with `B` the rows of `A` that it reads and `n` white noise of variance `σ²`. Let the
//! change of the scene be white with variance `s²` in every voxel. In the basis of the eigenvectors of `B Bᵀ`, with
//! eigenvalues `g_i`, a measurement holds signal of variance `s² g_i` and noise of variance `σ²`. The linear estimate of
//! least error keeps the part `s² g_i/(s² g_i + σ²)` of it, so
//!
//! ```text
//! n = Σ_i g_i/(g_i + σ²/s²) = tr G (G + c I)⁻¹,     G = B Bᵀ,  c = σ²/s²
//! ```
//!
//! numbers speak about the change, the effective degrees of freedom of ridge regression (Hoerl & Kennard 1970). The others
//! are noise, whatever the prior: what the change has beyond `n` numbers an instant must come from outside the frame.

use super::RollingShutter;
use super::gram::add_gram_block;
use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};

/// Measurements of an instant above which nothing is counted: the count takes their number cubed.
const MAX_BLOCK: usize = 2048;
/// Part of an instant's numbers below which a change is not to be believed; see docs/design/028.
pub const MIN_INFORMATIVE: f64 = 0.1;

/// How many numbers of an instant speak about a change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChangeCount {
    /// The effective number of measurements.
    pub informative: f64,
    /// The measurements of the instant.
    pub of: usize,
}

impl ChangeCount {
    /// Whether the frame tells too little of the change for it to be believed.
    pub fn is_too_few(&self) -> bool {
        self.informative < MIN_INFORMATIVE * self.of as f64
    }
}

/// Counts for the instant in the middle, at a noise of `sigma` counts and a change of `change_rms` counts in every voxel.
/// `None` for an instant of more than 2048 measurements, and where the operator is not finite.
pub fn count_change(operator: &RollingShutter, sigma: f64, change_rms: f64) -> Option<ChangeCount> {
    let instant = operator.rows_of_instants().len() / 2;
    let size = operator.indices_of(instant).len();
    if size == 0 || size > MAX_BLOCK {
        return None;
    }
    let count = |informative| ChangeCount {
        informative,
        of: size,
    };
    if change_rms <= 0.0 {
        return Some(count(0.0));
    }
    let mut gram = Mat::<f64>::zeros(size, size);
    add_gram_block(operator, instant, None, gram.as_mut());
    let c = (sigma / change_rms).powi(2);
    // Only the upper triangle of the block is written.
    let shifted = Mat::from_fn(size, size, |i, j| {
        let (i, j) = (i.min(j), i.max(j));
        gram[(i, j)] + if i == j { c } else { 0.0 }
    });
    let inverse = shifted.llt(Side::Lower).ok()?.inverse();
    let trace: f64 = (0..size).map(|i| inverse[(i, i)]).sum();
    let informative = size as f64 - c * trace;
    informative.is_finite().then(|| count(informative.max(0.0)))
}
