//! The data term of a rolling-shutter frame, `½‖W(b − A v)‖²`, with the solver of its proximal step.

use super::active_system::ActiveSystem;
use super::held_out::HeldOut;
use super::model::Model;
use super::preconditioner::{MeanFieldPreconditioner, PlanePreconditioner};
use super::prior::Prior;
use crate::camera::CameraParams;
use crate::linop::{
    Background, LinearOperator, Scalar, WeightedOperator, WithBackground, WritePart, sum_of_bins,
    write_parts,
};
use crate::measurement::{Measurement, NoiseModel};
use crate::prox::{Prox, Restricted};
use crate::solve::blocks::{BlockSource, Blocks};
use crate::solve::conjugate_gradient::{ConjugateGradient, Preconditioner, TOLERANCE};
use crate::solve::coupled_blocks::{CoupledBlocks, CoupledSystem};
use crate::solve::{DataTerm, GramSolver};
use crate::{Camera, RollingShutter, Shape, Shutter, Support};
use faer::reborrow::ReborrowMut;
use faer::{Mat, MatMut, MatRef};
use std::sync::Arc;

/// Measurements of an instant above which a factor costs more than ten iterations (docs/design/008).
const LARGE_BLOCK: usize = 1024;

/// Sensitivity of a voxel over the largest one, below which the frame does not observe it; larger leaves more of the
/// edges of a field dark (docs/design/020).
const MIN_SENSITIVITY: f64 = 0.01;

/// Smallest `ρ` over a typical diagonal element of `A Aᵀ` where no blocks are built; smaller is not stable.
const MIN_RHO: f64 = 1e-9;

/// Smallest `ρ` for f32 blocks; smaller is faster, and rounding of the blocks enters the result (docs/design/003).
const MIN_RHO_SINGLE: f64 = 1e-5;

/// Residual over `ρ‖y‖` of conjugate gradients where the solution itself is asked for.
const EXACT_TOLERANCE: f64 = 0.01;

/// Most calls of conjugate gradients for that.
const MAX_EXACT_CALLS: usize = 10;

/// Measurement and operator of a frame, with the solver of `(W A P Aᵀ W + ρI) y = r`; `P` projects on the support.
pub(super) struct FrameData {
    model: Model,
    /// `W A` on the foreground, and on the stacked foreground and background.
    operator: Arc<WeightedOperator<Arc<RollingShutter>>>,
    with_background: WithBackground<Arc<WeightedOperator<Arc<RollingShutter>>>>,
    background: Background,
    /// Operator of a global shutter over the whole field. It preconditions the solve for a static background.
    whole_field_operator: Option<RollingShutter>,
    /// `b`.
    frame: Vec<f32>,
    /// `W b`, 0 at held-out pixels.
    measurements: Vec<f32>,
    /// `W` of all pixels from the counts of the frame; held-out pixels keep their weights here.
    initial_weights: Option<Vec<f32>>,
    /// The present `W` of all pixels; [`DataTerm::update_weights`] computes it from the light of the video.
    weights: Option<Vec<f32>>,
    noise: Option<NoiseModel>,
    held_out: Option<HeldOut>,
    /// Pixels with a weight above zero, without the held-out ones.
    measurement_count: usize,
    /// The largest `w²` of the operator.
    max_squared_weight: f64,
    /// The voxels that the frame observes; `None`: all.
    covered: Option<Support>,
    support: Option<Support>,
    gram: Gram,
    /// Whether blocks are f64 from the start.
    always_f64: bool,
}

/// The solver of the data step.
enum Gram {
    /// Cholesky factors of the blocks, which are all of `G` where no bin is seen by two instants.
    Exact(Precision),
    /// The same, with a static background that couples all blocks.
    Coupled(Blocks<f64>, CoupledBlocks),
    /// Conjugate gradients for everything else, unless an exact step on the support takes less time.
    Iterative(ConjugateGradient, Option<Box<ActiveSystem>>),
}

/// The Gram blocks, in f32 as long as `ρ` is above their rounding.
enum Precision {
    Single(Blocks<f32>),
    Double(Blocks<f64>),
}

impl Precision {
    /// Rebuilds the blocks of the instants that `has_changed` selects; `None`: all, as new weights require.
    fn rebuild_changed(
        &mut self,
        has_changed: Option<&(dyn Fn(usize) -> bool + Sync)>,
        source: GramSource,
    ) {
        match self {
            Self::Single(blocks) => {
                blocks.reset();
                rebuild_changed(blocks, has_changed, source);
            }
            Self::Double(blocks) => rebuild_changed(blocks, has_changed, source),
        }
    }

    /// Solves `(G + ρI) y = r` for an `r` that converges over the iterations, and sets `gram_y = G y`. Returns
    /// whether `ρ` is large enough for the precision of the blocks.
    fn solve_incremental(
        &mut self,
        r: &[f32],
        rho: f64,
        y: &mut [f32],
        gram_y: &mut [f32],
    ) -> bool {
        match self {
            Self::Single(blocks) => {
                blocks.solve_incremental(r, rho, y, gram_y);
                !blocks.is_ill_conditioned()
            }
            Self::Double(blocks) => {
                blocks.solve_with_product(r, rho, y, gram_y);
                !blocks.is_ill_conditioned()
            }
        }
    }
}

fn rebuild_changed<T: Scalar>(
    blocks: &mut Blocks<T>,
    has_changed: Option<&(dyn Fn(usize) -> bool + Sync)>,
    source: GramSource,
) {
    match has_changed {
        Some(has_changed) => blocks.rebuild_changed(has_changed, source),
        None => blocks.rebuild_all(source),
    }
}

impl FrameData {
    pub fn new(model: &Model, measurement: &Measurement) -> Self {
        Self::with_precision(model, measurement, false)
    }

    /// The same with f64 blocks from the start.
    pub fn with_f64_blocks(model: &Model, measurement: &Measurement) -> Self {
        Self::with_precision(model, measurement, true)
    }

    fn with_precision(model: &Model, measurement: &Measurement, always_f64: bool) -> Self {
        let shutter = model.shutter();
        let frame = measurement.image().data().to_vec();
        let weights = measurement.weights().map(<[f32]>::to_vec);
        let operator = Arc::new(WeightedOperator::new(Arc::clone(shutter), weights.clone()));
        let background = Background::None;
        let all = GramSource {
            model,
            operator: &operator,
            active: (None, background),
        };
        let gram = if shutter.time().is_disjoint() && model.gram_bytes().is_some() {
            Gram::Exact(all.exact_blocks(always_f64))
        } else {
            Gram::Iterative(
                ConjugateGradient::new(all.preconditioner(), frame.len()),
                None,
            )
        };
        let with_background =
            WithBackground::new(Arc::clone(&operator), shutter.video_shape(), background);
        let mut data = Self {
            measurements: Vec::new(),
            measurement_count: 0,
            max_squared_weight: 1.0,
            always_f64,
            noise: measurement.noise().cloned(),
            held_out: None,
            covered: None,
            support: None,
            model: model.clone(),
            whole_field_operator: None,
            background,
            with_background,
            operator,
            frame,
            initial_weights: weights.clone(),
            weights,
            gram,
        };
        data.apply_weights_to_frame();
        data.set_coverage();
        data
    }

    fn set_coverage(&mut self) {
        let coverage = self.coverage();
        let shape = self.shape();
        self.covered = coverage
            .contains(&0)
            .then(|| Support::from_mask(coverage, shape));
    }

    /// The present `W` of all pixels; held-out pixels keep their weights here. `None`: all 1.
    pub fn weights(&self) -> Option<&[f32]> {
        self.weights.as_deref()
    }

    /// The background of its videos.
    pub fn background(&self) -> Background {
        self.background
    }

    /// What stops its runs.
    pub fn cancel(&self) -> &crate::Cancel {
        self.model.cancel()
    }

    pub fn psfs(&self) -> &crate::PatchSet {
        self.model.psfs()
    }

    pub fn shutter(&self) -> &RollingShutter {
        self.model.shutter()
    }

    pub fn shape(&self) -> Shape {
        self.shutter().video_shape()
    }

    /// Draws the pixels to be held out.
    pub fn held_out(&self) -> HeldOut {
        self.held_out_set(0)
    }

    /// Draws one of several sets of pixels to be held out.
    pub fn held_out_set(&self, set: u64) -> HeldOut {
        HeldOut::draw(self.shutter(), self.weights(), set)
    }

    /// Resets to the initial weights and to all voxels, for videos with this background, without the
    /// pixels of `held_out`. The results do not depend on earlier calls, to the bit.
    pub fn reset(&mut self, background: Background, held_out: Option<HeldOut>) {
        let is_unchanged = self.support.is_none() && self.weights == self.initial_weights;
        let is_fresh = match &mut self.gram {
            Gram::Exact(Precision::Single(blocks)) => {
                blocks.reset();
                true
            }
            Gram::Exact(Precision::Double(_)) => self.always_f64,
            Gram::Coupled(..) => true,
            Gram::Iterative(..) => false,
        };
        if background == self.background && held_out == self.held_out && is_unchanged && is_fresh {
            return;
        }
        self.held_out = held_out;
        self.weights.clone_from(&self.initial_weights);
        self.support = None;
        self.background = background;
        let is_static = background == Background::Static;
        if is_static && self.whole_field_operator.is_none() {
            let (rows, columns) = self.model.camera().field();
            let whole_field = CameraParams {
                rows,
                columns,
                shutter: Shutter::Global,
                field: None,
                bins_per_row: 1,
                ..self.model.camera().params().clone()
            };
            // A field too large for a sensor has no preconditioner, so its solve takes more iterations.
            let whole_field = Camera::new(whole_field).ok();
            self.whole_field_operator =
                whole_field.map(|camera| RollingShutter::new(&camera, self.model.psfs().clone()));
        }
        let is_exact = match &self.gram {
            Gram::Exact(_) => is_static || !is_fresh,
            Gram::Coupled(..) => true,
            Gram::Iterative(..) => false,
        };
        self.apply_weights(is_exact);
    }

    /// Replaces the frame by another one of the same camera and keeps the support. Weights that were
    /// updated from the light are kept where the same pixels have weights above zero.
    pub fn set_frame(&mut self, measurement: &Measurement) {
        self.frame = measurement.image().data().to_vec();
        let weights = measurement.weights().map(<[f32]>::to_vec);
        let usable = |of: &Option<Vec<f32>>| -> Option<Vec<bool>> {
            of.as_ref().map(|w| w.iter().map(|w| *w > 0.0).collect())
        };
        let uses_noise_law = self.noise.is_some() && measurement.noise().is_some();
        if weights == self.initial_weights
            || (uses_noise_law && usable(&weights) == usable(&self.initial_weights))
        {
            self.apply_weights_to_frame();
            return;
        }
        self.noise = measurement.noise().cloned();
        self.initial_weights = weights.clone();
        self.weights = weights;
        self.set_coverage();
        self.apply_weights(false);
    }

    /// The voxels that the frame observes: their sensitivity, the sum of `Aᵀ1` over the usable pixels, is at least
    /// [`MIN_SENSITIVITY`] of the largest one.
    pub fn coverage(&self) -> Vec<u8> {
        let is_usable = |i: usize| self.initial_weights.as_ref().is_none_or(|w| w[i] > 0.0);
        let usable: Vec<f32> = (0..self.frame.len())
            .map(|i| f32::from(u8::from(is_usable(i))))
            .collect();
        let mut sensitivity = vec![0.0; self.shape().voxels()];
        self.shutter().adjoint(&usable, &mut sensitivity);
        let largest = sensitivity.iter().copied().fold(0.0, f32::max);
        let is_covered = |s: &f32| f64::from(*s) >= MIN_SENSITIVITY * f64::from(largest);
        sensitivity
            .iter()
            .map(|s| u8::from(is_covered(s)))
            .collect()
    }

    /// The proximal operator of `prior`, for videos that are zero in voxels that the frame does not observe: a prior
    /// would fill them with light of their neighbours.
    pub fn prox(&self, prior: &Prior) -> Box<dyn Prox> {
        let prox = prior.prox(self.shape());
        match &self.covered {
            Some(covered) => Box::new(Restricted::new(prox, covered.clone())),
            None => prox,
        }
    }

    /// Replaces `W b` until the next change of frame or weights.
    pub fn set_measurements(&mut self, measurements: Vec<f32>) {
        self.measurements = measurements;
    }

    /// Whether the present weight of each pixel is above zero.
    pub fn usable(&self) -> Vec<bool> {
        let weights = self.operator.weights();
        (0..self.frame.len())
            .map(|i| weights.is_none_or(|w| w[i] > 0.0))
            .collect()
    }

    /// `A v`, the light of foreground and background at all pixels.
    pub fn predicted(&self, video: &[f32]) -> Vec<f32> {
        let mut light = vec![0.0; self.frame.len()];
        self.shutter()
            .apply(&self.background.sum(self.shape(), video), &mut light);
        light
    }

    /// `W values`.
    pub fn weigh(&self, values: &[f32]) -> Vec<f32> {
        self.operator.weigh(values).into_owned()
    }

    /// Solves `(B Bᵀ + ρI) y = r` for an `r` that has nothing to do with the one before; `B` is `W A` on the support.
    pub fn solve_alone(&mut self, r: &[f32], rho: f64) -> Vec<f64> {
        if matches!(self.gram, Gram::Exact(Precision::Single(_))) {
            self.replace_blocks(true);
        }
        let size = crate::vecmath::norm(r).max(f64::MIN_POSITIVE);
        let unit: Vec<f32> = r.iter().map(|r| (f64::from(*r) / size) as f32).collect();
        let (mut y, mut gram_y) = (vec![0.0; r.len()], vec![0.0; r.len()]);
        let solved = match &mut self.gram {
            Gram::Iterative(_, Some(active)) => {
                active.reset();
                active.solve(&unit, rho, &mut y, &mut gram_y)
            }
            _ => false,
        };
        match &mut self.gram {
            Gram::Iterative(solver, _) if !solved => {
                let operator: &dyn LinearOperator = match self.background {
                    Background::None => &*self.operator,
                    _ => &self.with_background,
                };
                solver.forget();
                for _ in 0..MAX_EXACT_CALLS {
                    let tolerance = EXACT_TOLERANCE;
                    if solver.solve(operator, &unit, rho, tolerance, &mut y, &mut gram_y) {
                        break;
                    }
                }
            }
            Gram::Iterative(..) => {}
            _ => {
                self.solve_gram(&unit, rho, &mut y, &mut gram_y);
            }
        }
        y.iter().map(|y| size * f64::from(*y)).collect()
    }

    /// `σ` in counts of a pixel with weight 1 under the noise model of the weights; `None` without a noise model.
    pub fn calibrated_sigma(&self) -> Option<f64> {
        self.noise.as_ref().map(NoiseModel::sigma)
    }

    /// The video: the sum of foreground and background.
    pub fn sum(&self, stacked: Vec<f32>) -> Vec<f32> {
        match self.background {
            Background::None => stacked,
            background => background.sum(self.shape(), &stacked).into_owned(),
        }
    }

    /// `W(b − A v)` at the held-out pixels, with the weights that they would have.
    pub fn held_out_residuals(&self, video: &[f32]) -> Vec<f64> {
        let Some(held_out) = &self.held_out else {
            return Vec::new();
        };
        let light = self.predicted(video);
        let pixels = held_out.pixels().iter();
        pixels
            .map(|&i| {
                let weight = self.weights.as_ref().map_or(1.0, |w| f64::from(w[i]));
                weight * (f64::from(self.frame[i]) - f64::from(light[i]))
            })
            .collect()
    }

    /// Applies the present weights and held-out pixels to operator, frame, Gram blocks and preconditioner.
    /// `replaces_blocks` makes new Gram blocks, as another kind of background requires.
    fn apply_weights(&mut self, replaces_blocks: bool) {
        let mut weights = self.weights.clone();
        if let Some(held_out) = &self.held_out {
            let weights = weights.get_or_insert_with(|| vec![1.0; self.frame.len()]);
            held_out.pixels().iter().for_each(|&i| weights[i] = 0.0);
        }
        self.operator = Arc::new(WeightedOperator::new(
            Arc::clone(self.model.shutter()),
            weights,
        ));
        self.with_background =
            WithBackground::new(Arc::clone(&self.operator), self.shape(), self.background);
        self.apply_weights_to_frame();
        if replaces_blocks {
            return self.replace_blocks(self.always_f64);
        }
        let source = GramSource {
            model: &self.model,
            operator: &self.operator,
            active: (self.support.as_ref(), self.background),
        };
        match &mut self.gram {
            Gram::Exact(blocks) => blocks.rebuild_changed(None, source),
            Gram::Coupled(blocks, _) => blocks.rebuild_all(source),
            Gram::Iterative(solver, active) => {
                solver.restart(self.support.as_ref(), source.preconditioner());
                *active = source.active_system();
            }
        }
    }

    /// Replaces the Gram blocks by new ones for the present weights, support and background.
    fn replace_blocks(&mut self, in_f64: bool) {
        // Frees the old blocks before it builds the new ones.
        let nothing = |_: usize, _: MatMut<f64>| {};
        self.gram = Gram::Exact(Precision::Double(Blocks::new(Vec::new(), nothing)));
        let source = GramSource {
            model: &self.model,
            operator: &self.operator,
            active: (self.support.as_ref(), self.background),
        };
        self.gram = match self.background {
            // Always f64: its right-hand sides do not converge, so incremental solves in f32 do not help.
            Background::Static => Gram::Coupled(source.blocks(), CoupledBlocks::default()),
            _ => Gram::Exact(source.exact_blocks(in_f64)),
        };
    }

    /// Sets `W b` and the other values that follow from the operator's weights.
    fn apply_weights_to_frame(&mut self) {
        self.measurements = self.frame.clone();
        self.measurement_count = self.frame.len();
        self.max_squared_weight = 1.0;
        if let Some(weights) = self.operator.weights() {
            let pixels = self.measurements.iter_mut().zip(weights);
            pixels.for_each(|(b, w)| *b *= w);
            self.measurement_count = weights.iter().filter(|w| **w > 0.0).count();
            let max_weight = weights.iter().copied().fold(0.0, f32::max);
            self.max_squared_weight = f64::from(max_weight).powi(2);
        }
    }
}

impl DataTerm for FrameData {
    fn operator(&self) -> &dyn LinearOperator {
        match self.background {
            Background::None => &*self.operator,
            _ => &self.with_background,
        }
    }

    fn measurements(&self) -> &[f32] {
        &self.measurements
    }

    fn measurement_count(&self) -> usize {
        self.measurement_count
    }

    fn scale(&self) -> f64 {
        self.model.scale()
    }

    fn min_rho(&self) -> f64 {
        // Without blocks there is no factor whose rounding could limit `ρ`.
        let min_rho_ratio = match self.model.gram_bytes() {
            Some(_) => self.shutter().min_rho(),
            None => MIN_RHO,
        };
        min_rho_ratio * self.scale()
    }

    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool {
        let min_rho_single = MIN_RHO_SINGLE * self.max_squared_weight * self.scale();
        if matches!(self.gram, Gram::Exact(Precision::Single(..))) && rho < min_rho_single {
            self.replace_blocks(true);
        }
        match &mut self.gram {
            Gram::Exact(blocks) => {
                let is_good = blocks.solve_incremental(r, rho, y, gram_y);
                if is_good || matches!(blocks, Precision::Double(_)) {
                    return is_good;
                }
                self.replace_blocks(true);
                self.solve_gram(r, rho, y, gram_y)
            }
            Gram::Coupled(blocks, coupled) => {
                let coupling = StaticBackgroundOperator(&self.operator);
                let whole_field_operator = self.whole_field_operator.as_ref();
                let inverse = |g: &[f32], rho: f64, h: f64| {
                    let divided =
                        whole_field_operator.and_then(|p| p.circulant_inverse(g, rho / h));
                    divided.unwrap_or_else(|| g.to_vec())
                };
                let mut solve = |r: &[f32], y: &mut [f32]| blocks.solve(r, rho, y);
                let system = CoupledSystem {
                    blocks: &mut solve,
                    coupling: &coupling,
                    inverse: &inverse,
                };
                let is_good = coupled.solve(system, r, rho, y, gram_y);
                is_good && !blocks.is_ill_conditioned()
            }
            Gram::Iterative(solver, active) => {
                if let Some(system) = active {
                    if system.solve(r, rho, y, gram_y) {
                        return true;
                    }
                    *active = None;
                }
                let operator: &dyn LinearOperator = match self.background {
                    Background::None => &*self.operator,
                    _ => &self.with_background,
                };
                solver.solve(operator, r, rho, TOLERANCE, y, gram_y)
            }
        }
    }

    fn residual_rms_of_bins(&self, residual: &[f32]) -> Vec<f64> {
        let operator = self.shutter();
        let mut sums = vec![(0.0, 0usize); self.shape().bins];
        for (instant, run) in operator.time().instants().iter().enumerate() {
            let indices = operator.indices_of(instant);
            let usable = |i: &&usize| self.operator.weights().is_none_or(|w| w[**i] > 0.0);
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

    fn is_cancelled(&self) -> bool {
        self.model.cancel().is_cancelled()
    }

    fn has_large_blocks(&self) -> bool {
        if matches!(self.gram, Gram::Iterative(..)) {
            return false;
        }
        let (rows, (_, columns)) = (
            self.shutter().rows_of_instants(),
            self.shutter().frame_shape(),
        );
        rows.iter().any(|rows| rows.len() * columns > LARGE_BLOCK)
    }

    /// Above this number the block of all voxels is cheaper than that of the active ones. A block on a
    /// support costs `m²` products for each active voxel; the block of all voxels uses the shifts of the
    /// field and costs `4 m²` for each row of the field.
    fn max_restricted_voxels(&self) -> usize {
        if self.has_large_blocks() {
            4 * self.shape().rows
        } else {
            usize::MAX
        }
    }

    fn restrict(&mut self, support: &Support) {
        let before = self.support.replace(support.clone());
        let source = GramSource {
            model: &self.model,
            operator: &self.operator,
            active: (Some(support), self.background),
        };
        let instants = self.model.shutter().time().instants();
        let has_changed = |i: usize| {
            let run = &instants[i];
            let bins = run.first_bin..run.first_bin + run.weights.len();
            before
                .as_ref()
                .is_none_or(|b| !support.equals_in_bins(b, bins))
        };
        match &mut self.gram {
            Gram::Exact(blocks) => blocks.rebuild_changed(Some(&has_changed), source),
            Gram::Coupled(blocks, _) => blocks.rebuild_changed(has_changed, source),
            Gram::Iterative(solver, active) => {
                solver.restrict(support, source.preconditioner());
                *active = source.active_system();
            }
        }
    }

    fn adjoint_on(&self, y: &[f32], support: Option<&Support>, video: &mut [f32]) {
        match (self.background, support) {
            (Background::None, Some(support)) => {
                let weighted = self.operator.weigh(y);
                self.model.shutter().adjoint_on(&weighted, support, video);
            }
            (_, None) => self.operator().adjoint(y, video),
            (_, Some(support)) => {
                self.operator().adjoint(y, video);
                support.zero_outside(video);
            }
        }
    }

    fn adjoint_each(
        &self,
        y: &[f32],
        support: Option<&Support>,
        target: &mut [f32],
        write: WritePart,
    ) {
        if self.background == Background::None {
            let weighted = self.operator.weigh(y);
            let shutter = self.model.shutter();
            return shutter.adjoint_each(&weighted, support, target, write);
        }
        let mut video = vec![0.0; target.len()];
        self.adjoint_on(y, support, &mut video);
        write_parts(&video, target, write);
    }

    fn update_weights(&mut self, video: &[f32]) -> bool {
        let Some(noise) = &self.noise else {
            return false;
        };
        self.weights = Some(noise.weights(&self.predicted(video)));
        self.apply_weights(false);
        true
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

/// The voxels that may be active: the support of the foreground (`None`: all), and the background.
type ActiveVoxels<'a> = (Option<&'a Support>, Background);

/// Builds the diagonal blocks of `W A P Aᵀ W`.
#[derive(Clone, Copy)]
struct GramSource<'a> {
    model: &'a Model,
    operator: &'a Arc<WeightedOperator<Arc<RollingShutter>>>,
    active: ActiveVoxels<'a>,
}

impl GramSource<'_> {
    /// The blocks, one for each instant.
    fn blocks<T: Scalar>(self) -> Blocks<T> {
        let shutter = self.operator.inner();
        let indices = (0..shutter.rows_of_instants().len()).map(|i| shutter.indices_of(i));
        Blocks::new(indices.collect(), self).with_cancel(self.model.cancel())
    }

    /// The blocks in f32, or in f64 where `in_f64`.
    fn exact_blocks(self, in_f64: bool) -> Precision {
        if in_f64 {
            Precision::Double(self.blocks())
        } else {
            Precision::Single(self.blocks())
        }
    }

    /// Adds the block of the foreground and that of a background video.
    fn add_sum_of_blocks<T: Scalar>(&self, instant: usize, mut sum: MatMut<T>) {
        if self.model.cancel().is_cancelled() {
            return;
        }
        let (support, background) = self.active;
        let shutter = self.operator.inner();
        shutter.add_gram_block(instant, support, sum.rb_mut());
        if background == Background::PerBin {
            shutter.add_gram_block(instant, None, sum.rb_mut());
        }
    }

    /// Whether all bins of an instant are unrestricted.
    fn is_unrestricted_at(&self, instant: usize) -> bool {
        let run = &self.model.shutter().time().instants()[instant];
        let mut bins = run.first_bin..run.first_bin + run.weights.len();
        let (support, _) = self.active;
        support.is_none_or(|s| bins.all(|bin| s.pixels_of(bin).is_none()))
    }

    /// The exact step on the support, where it takes less time than conjugate gradients.
    fn active_system(self) -> Option<Box<ActiveSystem>> {
        let (support, background) = self.active;
        if background != Background::None || self.operator.inner().convolves_planes() {
            return None;
        }
        ActiveSystem::new(self.operator, support?).map(Box::new)
    }

    /// The mean field along the rows, or of whole planes where the operator convolves these.
    fn preconditioner(self) -> Box<dyn Preconditioner> {
        let (support, background) = self.active;
        let shutter = self.operator.inner();
        if shutter.convolves_planes() {
            return Box::new(PlanePreconditioner {
                shutter: Arc::clone(shutter),
                scale: self.model.scale(),
            });
        }
        let mean_field = self.model.mean_field();
        let weights = self.operator.weights();
        Box::new(MeanFieldPreconditioner::new(
            mean_field, shutter, background, support, weights,
        ))
    }
}

impl<T: Scalar> BlockSource<T> for GramSource<'_> {
    fn write_block(&self, instant: usize, mut sum: MatMut<T>) {
        let (_, background) = self.active;
        let shutter = self.operator.inner();
        let is_cached = self.is_unrestricted_at(instant) && background != Background::PerBin;
        match self.model.cached_block(instant).filter(|_| is_cached) {
            Some(block) => round(block.as_ref(), sum.rb_mut()),
            None if shutter.builds_in_f64() => {
                let mut exact = Mat::<f64>::zeros(sum.nrows(), sum.ncols());
                self.add_sum_of_blocks(instant, exact.as_mut());
                round(exact.as_ref(), sum.rb_mut());
            }
            None => self.add_sum_of_blocks(instant, sum.rb_mut()),
        }
        if let Some(weights) = self.operator.weights() {
            let indices = shutter.indices_of(instant);
            for (j, &column) in indices.iter().enumerate() {
                for (i, &row) in indices.iter().enumerate() {
                    sum[(i, j)] *= T::from(weights[row]) * T::from(weights[column]);
                }
            }
        }
    }

    fn is_unrestricted(&self, instant: usize) -> bool {
        self.is_unrestricted_at(instant)
    }

    fn columns(&self, instant: usize, max_columns: usize) -> Option<Mat<T>> {
        let (support, background) = self.active;
        if background == Background::PerBin {
            return None;
        }
        let shutter = self.operator.inner();
        let mut columns = shutter.active_columns::<T>(instant, support?, max_columns)?;
        if let Some(weights) = self.operator.weights() {
            let indices = shutter.indices_of(instant);
            for column in columns.col_iter_mut() {
                let values = column.iter_mut().zip(&indices);
                values.for_each(|(value, &i)| *value *= T::from(weights[i]));
            }
        }
        Some(columns)
    }
}

fn round<T: Scalar>(from: MatRef<f64>, to: MatMut<T>) {
    faer::zip!(to, from).for_each(|faer::unzip!(to, from)| *to = T::nearest(*from));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measurement::{Corrections, correct};
    use crate::vecmath::norm;
    use crate::{Image, Psf, Sensor};

    fn data(shutter: Shutter) -> FrameData {
        data_with_exposure(shutter, 1.0)
    }

    /// Exposure in rows.
    fn data_with_exposure(shutter: Shutter, exposure: f64) -> FrameData {
        let camera = Camera::new(CameraParams {
            rows: 12,
            columns: 20,
            shutter,
            row_time_us: 10.0,
            exposure_us: 10.0 * exposure,
            bins_per_row: 1,
            field: None,
            sensor: Sensor {
                gain_electrons_per_count: Some(2.0),
                read_noise_electrons: Some(1.5),
                ..Sensor::default()
            },
        })
        .unwrap();
        let psf = Psf::new(Image::from_fn(23, 39, |y, x| {
            (1 + (7 * y * y + 13 * x + 3 * x * y) % 17) as f32
        }))
        .unwrap();
        let frame = Image::from_fn(12, 20, |y, x| (5 + (3 * y + 5 * x) % 11) as f32);
        let measurement = correct(&frame, &camera, &Corrections::default()).unwrap();
        FrameData::new(&Model::new(&camera, &psf), &measurement)
    }

    /// Checks `solve_gram` against the operator that the solver sees, for several right-hand sides and for a `ρ`
    /// below the limit of f32.
    fn check(data: &mut FrameData, state: &str) {
        let least = if data.is_iterative() { 0.05 } else { 9e-6 };
        for (k, part) in [0.05, 0.05, 0.06, least, 0.05].into_iter().enumerate() {
            check_one(data, part, k, &format!("{state}, {k}"));
        }
    }

    fn check_one(data: &mut FrameData, part: f64, k: usize, state: &str) {
        let m = data.operator().range_len();
        let r: Vec<f32> = (0..m)
            .map(|i| ((i * (37 + k) % 101) as f32 - 50.0) / 50.0)
            .collect();
        let rho = part * data.scale();
        let (mut y, mut gram_y) = (vec![f32::NAN; m], vec![f32::NAN; m]);
        // Inexact steps go on from the last one.
        assert!(
            (0..20).any(|_| data.solve_gram(&r, rho, &mut y, &mut gram_y)),
            "{state}"
        );
        let mut video = vec![0.0; data.operator().domain_len()];
        data.operator().adjoint(&y, &mut video);
        if let Some(support) = &data.support {
            support.zero_outside(&mut video);
        }
        let mut seen = vec![0.0; m];
        data.operator().apply(&video, &mut seen);
        let wrong: Vec<f32> = seen.iter().zip(&gram_y).map(|(a, b)| a - b).collect();
        let (error, size) = (norm(&wrong), norm(&gram_y));
        // The rounding of `y` and of the operator, in f32.
        let gain = match data.background {
            Background::Static => data.shape().bins as f64,
            _ => 1.0,
        };
        let rounding = 4e-6 * gain * data.max_squared_weight * data.scale() * norm(&y);
        let most = 1e-4 * size + rounding;
        assert!(error < most, "{state}: {error} {most} of {size}");
        let left: Vec<f32> = (0..m)
            .map(|i| gram_y[i] + rho as f32 * y[i] - r[i])
            .collect();
        assert!(norm(&left) < 0.11 * rho * norm(&y), "{state}");
    }

    impl FrameData {
        fn is_iterative(&self) -> bool {
            matches!(self.gram, Gram::Iterative(..))
        }

        fn is_single(&self) -> bool {
            matches!(self.gram, Gram::Exact(Precision::Single(..)))
        }
    }

    /// Cached blocks equal new ones to the bit, for one PSF and for several.
    #[test]
    fn cached_blocks_change_nothing() {
        let first = data(Shutter::DualInsideOut);
        let psf = |seed: usize| {
            let value = |y: usize, x: usize| (1 + (7 * y * y + seed * x + 3 * x * y) % 17) as f32;
            Psf::new(Image::from_fn(23, 39, value)).unwrap()
        };
        let places = vec![(0.0, -6.0), (0.0, 6.0)];
        let several = crate::PatchSet::new(vec![psf(13), psf(5)], places).unwrap();
        for psfs in [first.psfs().clone(), several] {
            let model = Model::new(first.model.camera(), psfs);
            let frame = Image::from_fn(12, 20, |y, x| (5 + (3 * y + 5 * x) % 11) as f32);
            let measurement = correct(&frame, model.camera(), &Corrections::default()).unwrap();
            let solved = |model: &Model| {
                let mut data = FrameData::new(model, &measurement);
                let (mut y, mut gram_y) = (vec![0.0; 240], vec![0.0; 240]);
                data.solve_gram(frame.data(), 0.01 * data.scale(), &mut y, &mut gram_y);
                y
            };
            let alone = solved(&model);
            assert_eq!(solved(&model.with_cached_gram()), alone);
        }
    }

    /// Larger weights make larger blocks with larger rounding, so f64 is needed at a larger `ρ`.
    #[test]
    fn large_weights_need_f64_sooner() {
        for (weight, is_single) in [(1.0, true), (10.0, false)] {
            let mut data = data(Shutter::DualInsideOut);
            data.weights = Some(vec![weight; 240]);
            data.apply_weights(true);
            check_one(&mut data, 5e-5, 0, &format!("weights of {weight}"));
            assert_eq!(data.is_single(), is_single, "weights of {weight}");
        }
    }

    /// After `reset` the result does not depend on earlier solves, to the bit.
    #[test]
    fn starts_afresh() {
        let solution = |data: &mut FrameData| {
            let m = data.operator().range_len();
            let r: Vec<f32> = (0..m).map(|i| (i * 13 % 7) as f32).collect();
            let (mut y, mut gram_y) = (vec![0.0; m], vec![0.0; m]);
            data.solve_gram(&r, 0.02 * data.scale(), &mut y, &mut gram_y);
            y
        };
        let mut fresh = data(Shutter::DualInsideOut);
        assert!(fresh.is_single());
        let expected = solution(&mut fresh);
        let mut used = data(Shutter::DualInsideOut);
        check(&mut used, "before");
        assert!(!used.is_single(), "ρ was below what f32 stands for");
        for background in [Background::None, Background::Static, Background::None] {
            used.reset(background, None);
            assert_eq!(used.is_single(), background == Background::None);
            if background == Background::None {
                assert_eq!(solution(&mut used), expected);
            }
        }
        let camera = used.model.camera().clone();
        let frame = Image::from_fn(12, 20, |y, x| (5 + (3 * y + 5 * x) % 11) as f32);
        let measurement = correct(&frame, &camera, &Corrections::default()).unwrap();
        assert!(!FrameData::with_f64_blocks(&used.model, &measurement).is_single());
    }

    #[test]
    fn solves_with_the_operator_that_is_seen() {
        let cases = [
            (Shutter::DualInsideOut, 1.0),
            (Shutter::Global, 1.0),
            (Shutter::DualOutsideIn, 2.5),
            (Shutter::TopDown, 5.0),
        ];
        for (shutter, exposure) in cases {
            let mut data = data_with_exposure(shutter.clone(), exposure);
            let shape = data.shape();
            for background in [Background::None, Background::Static, Background::PerBin] {
                if shape.bins == 1 && background != Background::None {
                    continue;
                }
                let state = format!("{} {exposure} {background:?}", shutter.name());
                data.reset(background, None);
                check(&mut data, &state);
                let held_out = data.held_out();
                data.reset(background, Some(held_out.clone()));
                assert_eq!(data.measurement_count(), 240 - held_out.pixels().len());
                check(&mut data, &format!("{state}, pixels held out"));
                let bright: Vec<f32> = (0..shape.voxels()).map(|i| (i % 9) as f32).collect();
                data.restrict(&Support::above(&bright, shape, &vec![7.5; shape.bins]));
                check(&mut data, &format!("{state}, on a support"));
                if background == Background::None {
                    let few: Vec<f32> = (0..shape.voxels()).map(|i| (i % 97) as f32).collect();
                    data.restrict(&Support::above(&few, shape, &vec![95.5; shape.bins]));
                    check(&mut data, &format!("{state}, on a small support"));
                    let is_direct = matches!(data.gram, Gram::Iterative(_, Some(_)));
                    assert_eq!(is_direct, exposure > 1.0, "{state}");
                }
            }
        }
    }

    /// Weights are those of the light of both parts, and held-out pixels keep weight 0.
    #[test]
    fn weights_are_updated_from_the_light() {
        let mut data = data(Shutter::DualInsideOut);
        let held_out = data.held_out();
        data.reset(Background::Static, Some(held_out.clone()));
        let n = data.operator().domain_len();
        assert!(data.update_weights(&vec![2.0; n]));
        // Foreground and background are 2 everywhere, so the video is 4.
        let mut light = vec![0.0; 240];
        data.shutter()
            .apply(&vec![4.0; data.shape().voxels()], &mut light);
        let (weights, law) = (data.weights().unwrap(), data.noise.clone().unwrap());
        assert_eq!(weights, law.weights(&light));
        for (i, w) in data.operator.weights().unwrap().iter().enumerate() {
            let is_held_out = held_out.pixels().contains(&i);
            assert_eq!(*w, if is_held_out { 0.0 } else { weights[i] });
        }
        check(&mut data, "after following");
        data.reset(Background::Static, Some(held_out.clone()));
        assert_eq!(data.weights(), data.initial_weights.as_deref());
        check(&mut data, "after starting again");
        assert_eq!(
            data.held_out_residuals(&vec![2.0; n]).len(),
            held_out.pixels().len()
        );
    }
}
