//! The data term of a rolling-shutter frame: `½‖W(b − A v)‖²`.

use super::held_out::HeldOut;
use super::model::Model;
use crate::camera::CameraParams;
use crate::linop::{
    Background, LinearOperator, Scalar, WeightedOperator, WithBackground, WritePart, sum_of_bins,
    write_parts,
};
use crate::measurement::{Measurement, NoiseModel};
use crate::solve::blocks::{BlockSource, Blocks};
use crate::solve::bordered::Bordered;
use crate::solve::conjugate_gradient::{ConjugateGradient, Preconditioner};
use crate::solve::{DataTerm, GramSolver};
use crate::{Camera, RollingShutter, Shape, Shutter, Support};
use faer::reborrow::ReborrowMut;
use faer::{Mat, MatMut, MatRef};
use std::sync::Arc;

/// Measurements of an instant from which its factor costs more than ten iterations.
const LARGE_BLOCK: usize = 1024;

/// Smallest `ρ` over the typical size of a diagonal element of `A Aᵀ` where no block limits it.
const MIN_RHO: f64 = 1e-9;

/// Where `ρ` is smaller the blocks are f64: the rounding of f32 blocks and factors is near 1e-6 of the diagonal in norm.
const MIN_RHO_SINGLE: f64 = 1e-5;

/// Measurement and operator, with the solver of `W A P Aᵀ W + ρI`.
pub(super) struct FrameData {
    model: Model,
    /// `W A`, and the same of both parts of a video.
    operator: Arc<WeightedOperator<Arc<RollingShutter>>>,
    with_background: WithBackground<Arc<WeightedOperator<Arc<RollingShutter>>>>,
    background: Background,
    /// What convolves the whole field at once, where the second part stands still.
    planes: Option<RollingShutter>,
    /// `b` and `W b`.
    frame: Vec<f32>,
    measured: Vec<f32>,
    /// The weights of all pixels, those held out among them: of the counts, and of the light.
    initial_weights: Option<Vec<f32>>,
    weights: Option<Vec<f32>>,
    noise: Option<NoiseModel>,
    held_out: Option<HeldOut>,
    measurement_count: usize,
    /// The largest `w²`.
    max_squared_weight: f64,
    support: Option<Support>,
    gram: Gram,
    /// Whether blocks are never f32.
    is_double: bool,
}

enum Gram {
    /// No bin is seen by two instants: the blocks are all there is.
    Exact(Precision),
    /// The same, and a part that all bins share.
    Bordered(Blocks<f64>, Bordered),
    Iterative(ConjugateGradient),
}

/// The blocks, in f32 as long as `ρ` stands above its rounding.
enum Precision {
    Single(Blocks<f32>),
    Double(Blocks<f64>),
}

impl Precision {
    /// Writes those that `has_changed` anew, or all with other weights or another second part.
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

    /// A step of an iteration, in which `r` changes less and less; whether `ρ` was not lost in rounding.
    fn solve_incremental(
        &mut self,
        r: &[f32],
        rho: f64,
        y: &mut [f32],
        gram_y: &mut [f32],
    ) -> bool {
        match self {
            Self::Single(blocks) => blocks.solve_incremental(r, rho, y, gram_y),
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
        Self::in_precision(model, measurement, false)
    }

    /// The same with blocks that are never f32.
    pub fn with_f64_blocks(model: &Model, measurement: &Measurement) -> Self {
        Self::in_precision(model, measurement, true)
    }

    fn in_precision(model: &Model, measurement: &Measurement, is_double: bool) -> Self {
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
        let gram = match shutter.time().is_disjoint() && model.gram_bytes().is_some() {
            true => Gram::Exact(all.exact(is_double)),
            false => Gram::Iterative(ConjugateGradient::new(all.preconditioner(), frame.len())),
        };
        let with_background =
            WithBackground::new(Arc::clone(&operator), shutter.video_shape(), background);
        let mut data = Self {
            measured: Vec::new(),
            measurement_count: 0,
            max_squared_weight: 1.0,
            is_double,
            noise: measurement.noise().cloned(),
            held_out: None,
            support: None,
            model: model.clone(),
            planes: None,
            background,
            with_background,
            operator,
            frame,
            initial_weights: weights.clone(),
            weights,
            gram,
        };
        data.apply_weights_to_frame();
        data
    }

    /// `W` of all pixels, if not all 1.
    pub fn weights(&self) -> Option<&[f32]> {
        self.weights.as_deref()
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

    /// A draw of pixels to be held out.
    pub fn held_out(&self) -> HeldOut {
        HeldOut::draw(self.shutter(), self.weights())
    }

    /// Starts afresh, on all voxels of videos with this second part, without the pixels of
    /// `held_out`.
    pub fn start(&mut self, background: Background, held_out: Option<HeldOut>) {
        let is_as_it_was = self.support.is_none() && self.weights == self.initial_weights;
        let is_fresh = match &mut self.gram {
            Gram::Exact(Precision::Single(blocks)) => {
                blocks.reset();
                true
            }
            Gram::Exact(Precision::Double(_)) => self.is_double,
            _ => true,
        };
        if background == self.background && held_out == self.held_out && is_as_it_was && is_fresh {
            return;
        }
        self.held_out = held_out;
        self.weights.clone_from(&self.initial_weights);
        self.support = None;
        self.background = background;
        let is_still = background == Background::Static;
        if is_still && self.planes.is_none() {
            let (rows, columns) = self.model.camera().field();
            let whole = CameraParams {
                rows,
                columns,
                shutter: Shutter::Global,
                field: None,
                bins_per_row: 1,
                ..self.model.camera().params().clone()
            };
            // A field too large for a sensor has no preconditioner, and takes longer.
            let whole = Camera::new(whole).ok();
            self.planes =
                whole.map(|camera| RollingShutter::new(&camera, self.model.psfs().clone()));
        }
        let is_exact = match &self.gram {
            Gram::Exact(_) => is_still || !is_fresh,
            Gram::Bordered(..) => true,
            Gram::Iterative(_) => false,
        };
        self.apply_weights(is_exact);
    }

    /// From now on the data of another frame of the same camera, on the same support. Weights that
    /// follow the light stay those of the last frame where the same pixels hold information.
    pub fn next(&mut self, measurement: &Measurement) {
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
        self.apply_weights(false);
    }

    /// `σ` of a pixel of weight 1 by the law of noise that the weights come from.
    pub fn calibrated_sigma(&self) -> Option<f64> {
        self.noise.as_ref().map(NoiseModel::sigma)
    }

    /// The video that both parts make.
    pub fn sum(&self, stacked: Vec<f32>) -> Vec<f32> {
        match self.background {
            Background::None => stacked,
            background => background.sum(self.shape(), &stacked).into_owned(),
        }
    }

    /// How many pixels are held out now.
    pub fn held_out_count(&self) -> usize {
        self.held_out.as_ref().map_or(0, |h| h.pixels().len())
    }

    /// `W(b − A v)` at the pixels that are held out.
    pub fn held_out_residuals(&self, video: &[f32]) -> Vec<f64> {
        let Some(held_out) = &self.held_out else {
            return Vec::new();
        };
        let mut light = vec![0.0; self.frame.len()];
        self.shutter()
            .apply(&self.background.sum(self.shape(), video), &mut light);
        let pixels = held_out.pixels().iter();
        pixels
            .map(|&i| {
                let weight = self.weights.as_ref().map_or(1.0, |w| f64::from(w[i]));
                weight * (f64::from(self.frame[i]) - f64::from(light[i]))
            })
            .collect()
    }

    /// Operator, Gram blocks and preconditioner with new weights; `replaces_blocks`: with blocks of another kind.
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
            return self.replace_blocks(self.is_double);
        }
        let source = GramSource {
            model: &self.model,
            operator: &self.operator,
            active: (self.support.as_ref(), self.background),
        };
        match &mut self.gram {
            Gram::Exact(blocks) => blocks.rebuild_changed(None, source),
            Gram::Bordered(blocks, _) => blocks.rebuild_all(source),
            Gram::Iterative(solver) => {
                solver.restart(self.support.as_ref(), source.preconditioner());
            }
        }
    }

    /// Blocks of the present weights, support and second part, for those that there are.
    fn replace_blocks(&mut self, is_double: bool) {
        // The old ones go first.
        let nothing = |_: usize, _: MatMut<f64>| {};
        self.gram = Gram::Exact(Precision::Double(Blocks::new(Vec::new(), nothing)));
        let source = GramSource {
            model: &self.model,
            operator: &self.operator,
            active: (self.support.as_ref(), self.background),
        };
        self.gram = match self.background {
            // What all bins share is solved for from other right sides all the time.
            Background::Static => Gram::Bordered(source.blocks(), Bordered::default()),
            _ => Gram::Exact(source.exact(is_double)),
        };
    }

    fn apply_weights_to_frame(&mut self) {
        self.measured = self.frame.clone();
        self.measurement_count = self.frame.len();
        self.max_squared_weight = 1.0;
        if let Some(weights) = self.operator.weights() {
            let pixels = self.measured.iter_mut().zip(weights);
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

    fn measured(&self) -> &[f32] {
        &self.measured
    }

    fn measurement_count(&self) -> usize {
        self.measurement_count
    }

    fn scale(&self) -> f64 {
        self.model.scale()
    }

    fn min_rho(&self) -> f64 {
        // Without blocks nothing is factored.
        let least = match self.model.gram_bytes() {
            Some(_) => self.shutter().min_rho(),
            None => MIN_RHO,
        };
        least * self.scale()
    }

    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool {
        let least = MIN_RHO_SINGLE * self.max_squared_weight * self.scale();
        if matches!(self.gram, Gram::Exact(Precision::Single(..))) && rho < least {
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
            Gram::Bordered(blocks, bordered) => {
                let border = Border(&self.operator);
                let planes = self.planes.as_ref();
                let inverse = |g: &[f32], rho: f64, h: f64| {
                    let divided = planes.and_then(|p| p.circulant_inverse(g, rho / h));
                    divided.unwrap_or_else(|| g.to_vec())
                };
                let mut solve = |r: &[f32], y: &mut [f32]| blocks.solve(r, rho, y);
                let is_good = bordered.solve(&mut solve, &border, &inverse, (r, rho), y, gram_y);
                is_good && !blocks.is_ill_conditioned()
            }
            Gram::Iterative(solver) => {
                let operator: &dyn LinearOperator = match self.background {
                    Background::None => &*self.operator,
                    _ => &self.with_background,
                };
                solver.solve(operator, r, rho, y, gram_y)
            }
        }
    }

    fn misfit_of_bins(&self, residual: &[f32]) -> Vec<f64> {
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

    fn has_large_blocks(&self) -> bool {
        if matches!(self.gram, Gram::Iterative(_)) {
            return false;
        }
        let (rows, (_, columns)) = (
            self.shutter().rows_of_instants(),
            self.shutter().frame_shape(),
        );
        rows.iter().any(|rows| rows.len() * columns > LARGE_BLOCK)
    }

    /// The block of so many voxels takes as long as that of all, which leans on the field's shifts:
    /// `m²` products for each voxel, and 4 for each row of the field.
    fn max_active_voxels(&self) -> usize {
        match self.has_large_blocks() {
            true => 4 * self.shape().rows,
            false => usize::MAX,
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
                .is_none_or(|b| !support.agrees_with(b, bins))
        };
        match &mut self.gram {
            Gram::Exact(blocks) => blocks.rebuild_changed(Some(&has_changed), source),
            Gram::Bordered(blocks, _) => blocks.rebuild_changed(has_changed, source),
            Gram::Iterative(solver) => solver.restrict(support, source.block_preconditioner()),
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
                support.apply(video);
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
        let mut light = vec![0.0; self.frame.len()];
        self.shutter()
            .apply(&self.background.sum(self.shape(), video), &mut light);
        self.weights = Some(noise.weights(&light));
        self.apply_weights(false);
        true
    }
}

/// `W A E`: a picture that all bins show.
struct Border<'a>(&'a WeightedOperator<Arc<RollingShutter>>);

impl LinearOperator for Border<'_> {
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

/// What may be lit: the support of the first part, and the second part.
type ActiveVoxels<'a> = (Option<&'a Support>, Background);

/// The blocks of `W A P Aᵀ W`.
#[derive(Clone, Copy)]
struct GramSource<'a> {
    model: &'a Model,
    operator: &'a Arc<WeightedOperator<Arc<RollingShutter>>>,
    active: ActiveVoxels<'a>,
}

impl GramSource<'_> {
    /// One for each instant.
    fn blocks<T: Scalar>(self) -> Blocks<T> {
        let shutter = self.operator.inner();
        let indices = (0..shutter.rows_of_instants().len()).map(|i| shutter.indices_of(i));
        Blocks::new(indices.collect(), self)
    }

    /// In f32, if not for ever in f64.
    fn exact(self, is_double: bool) -> Precision {
        match is_double {
            true => Precision::Double(self.blocks()),
            false => Precision::Single(self.blocks()),
        }
    }

    /// Adds the blocks of both parts of a video.
    fn add_sum_of_blocks<T: Scalar>(&self, instant: usize, mut sum: MatMut<T>) {
        let (support, background) = self.active;
        let shutter = self.operator.inner();
        shutter.add_gram_block(instant, support, sum.rb_mut());
        if background == Background::Video {
            shutter.add_gram_block(instant, None, sum.rb_mut());
        }
    }

    /// Whether the support leaves all bins of an instant open.
    fn is_unrestricted_at(&self, instant: usize) -> bool {
        let run = &self.model.shutter().time().instants()[instant];
        let mut bins = run.first_bin..run.first_bin + run.weights.len();
        let (support, _) = self.active;
        support.is_none_or(|s| bins.all(|bin| s.pixels_of(bin).is_none()))
    }

    /// Blocks, if they are not too large.
    fn block_preconditioner(self) -> Option<Box<dyn Preconditioner>> {
        self.model.gram_bytes()?;
        Some(Box::new(BlockPreconditioner(self.blocks())))
    }

    /// Blocks where there are some, else what suits whole planes.
    fn preconditioner(self) -> Box<dyn Preconditioner> {
        let plane = PlanePreconditioner {
            shutter: Arc::clone(self.operator.inner()),
            scale: self.model.scale(),
        };
        let blocks = self.block_preconditioner();
        blocks.unwrap_or_else(|| Box::new(plane))
    }
}

impl<T: Scalar> BlockSource<T> for GramSource<'_> {
    fn fill(&self, instant: usize, mut sum: MatMut<T>) {
        let (_, background) = self.active;
        let shutter = self.operator.inner();
        let is_cached = self.is_unrestricted_at(instant) && background != Background::Video;
        match self.model.cached_block(instant).filter(|_| is_cached) {
            Some(block) => round(block.as_ref(), sum.rb_mut()),
            None if shutter.sums_need_f64() => {
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
        if background == Background::Video {
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

/// In f64: here `ρ` may be small.
struct BlockPreconditioner(Blocks<f64>);

impl Preconditioner for BlockPreconditioner {
    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        self.0.solve(r, rho, out);
    }
}

/// Where whole planes are convolved: division in Fourier space; else a constant.
struct PlanePreconditioner {
    shutter: Arc<RollingShutter>,
    scale: f64,
}

impl Preconditioner for PlanePreconditioner {
    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        match self.shutter.circulant_inverse(r, rho) {
            Some(inverse) => out.copy_from_slice(&inverse),
            None => out
                .iter_mut()
                .zip(r)
                .for_each(|(o, r)| *o = r / (self.scale + rho) as f32),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measurement::{Corrections, correct};
    use crate::vecmath::norm;
    use crate::{Image, Psf, Sensor};

    fn data(shutter: Shutter) -> FrameData {
        let camera = Camera::new(CameraParams {
            rows: 12,
            columns: 20,
            shutter,
            row_time_us: 10.0,
            exposure_us: 10.0,
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

    /// What `solve_gram` returns fits the operator that the solver sees: of one right side after another, with `ρ` that
    /// falls below what f32 stands for.
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
        assert!(data.solve_gram(&r, rho, &mut y, &mut gram_y), "{state}");
        let mut video = vec![0.0; data.operator().domain_len()];
        data.operator().adjoint(&y, &mut video);
        if let Some(support) = &data.support {
            support.apply(&mut video);
        }
        let mut seen = vec![0.0; m];
        data.operator().apply(&video, &mut seen);
        let wrong: Vec<f32> = seen.iter().zip(&gram_y).map(|(a, b)| a - b).collect();
        let (error, size) = (norm(&wrong), norm(&gram_y));
        // The rounding of `y` and of the operator, in f32.
        let rounding = 4e-6 * data.max_squared_weight * data.scale() * norm(&y);
        let most = 1e-4 * size + rounding;
        assert!(error < most, "{state}: {error} {most} of {size}");
        let left: Vec<f32> = (0..m)
            .map(|i| gram_y[i] + rho as f32 * y[i] - r[i])
            .collect();
        assert!(norm(&left) < 0.11 * rho * norm(&y), "{state}");
    }

    impl FrameData {
        fn is_iterative(&self) -> bool {
            matches!(self.gram, Gram::Iterative(_))
        }

        fn is_single(&self) -> bool {
            matches!(self.gram, Gram::Exact(Precision::Single(..)))
        }
    }

    /// Blocks that are kept are those that are not, to the bit: of one PSF and of several.
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

    /// Weights make the blocks larger, and their rounding: f32 ends at a larger `ρ`.
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

    /// What went before does not show, to the bit.
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
            used.start(background, None);
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
        for shutter in [Shutter::DualInsideOut, Shutter::Global] {
            let mut data = data(shutter.clone());
            let shape = data.shape();
            for background in [Background::None, Background::Static, Background::Video] {
                if shape.bins == 1 && background != Background::None {
                    continue;
                }
                let state = format!("{} {background:?}", shutter.name());
                data.start(background, None);
                check(&mut data, &state);
                let held_out = data.held_out();
                data.start(background, Some(held_out.clone()));
                assert_eq!(data.measurement_count(), 240 - held_out.pixels().len());
                check(&mut data, &format!("{state}, pixels held out"));
                let bright: Vec<f32> = (0..shape.voxels()).map(|i| (i % 9) as f32).collect();
                data.restrict(&Support::above(&bright, shape, &vec![7.5; shape.bins]));
                check(&mut data, &format!("{state}, on a support"));
            }
        }
    }

    /// Twice the light has the weights of twice the light, and pixels held out keep weight 0.
    #[test]
    fn weights_are_updated_from_the_light() {
        let mut data = data(Shutter::DualInsideOut);
        let held_out = data.held_out();
        data.start(Background::Static, Some(held_out.clone()));
        let n = data.operator().domain_len();
        assert!(data.update_weights(&vec![2.0; n]));
        // Both parts show 2: a light of 4 everywhere.
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
        data.start(Background::Static, Some(held_out.clone()));
        assert_eq!(data.weights(), data.initial_weights.as_deref());
        check(&mut data, "after starting again");
        assert_eq!(
            data.held_out_residuals(&vec![2.0; n]).len(),
            held_out.pixels().len()
        );
    }
}
