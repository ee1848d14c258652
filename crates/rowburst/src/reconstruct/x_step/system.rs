//! The system of the x-step: the operator with its weights, support and background.

use super::super::model::Model;
use faer::reborrow::ReborrowMut;
use faer::{Mat, MatMut, MatRef};
use rowburst_core::linop::{Background, LinearOperator, Scalar, WeightedOperator, WithBackground};
use rowburst_core::{Shape, Support};
use rowburst_optics::camera::CameraParams;
use rowburst_optics::forward::gram::{active_columns, add_gram_block, builds_in_f64};
use rowburst_optics::{Camera, RollingShutter, Shutter};
use rowburst_solve::blocks::{BlockSource, Blocks};
use std::sync::Arc;

/// `B = W A P` of a frame; a source of the diagonal blocks of `B Bᵀ`.
pub struct System {
    camera_model: Model,
    /// The camera's model, or that of a scene at rest.
    model: Model,
    /// That of videos without a background: `A` or [`Model::solved_operator`].
    foreground_operator: Arc<RollingShutter>,
    /// `W A` on the foreground, and on the stacked foreground and background.
    operator: Arc<WeightedOperator<Arc<RollingShutter>>>,
    with_background: WithBackground<Arc<WeightedOperator<Arc<RollingShutter>>>>,
    background: Background,
    /// Operator of a global shutter over the whole field. It preconditions the solve for a static background.
    whole_field_operator: Option<RollingShutter>,
    /// The largest `w²` of the operator.
    max_squared_weight: f64,
    /// The support of the foreground; `None`: all voxels.
    support: Option<Support>,
}

impl System {
    /// The system of all voxels without a background, for `operator`, `A` or [`Model::solved_operator`]. `weights` are those
    /// of the frame's pixels; `None`: all 1.
    pub fn new(model: &Model, shutter: &Arc<RollingShutter>, weights: Option<Vec<f32>>) -> Self {
        let background = Background::None;
        let operator = Arc::new(WeightedOperator::new(Arc::clone(shutter), weights));
        Self {
            camera_model: model.clone(),
            model: model.clone(),
            foreground_operator: Arc::clone(shutter),
            with_background: WithBackground::new(
                Arc::clone(&operator),
                shutter.video_shape(),
                background,
            ),
            max_squared_weight: max_squared(operator.weights()),
            operator,
            background,
            whole_field_operator: None,
            support: None,
        }
    }

    /// The model of the camera.
    pub fn camera_model(&self) -> &Model {
        &self.camera_model
    }

    /// The model of the videos that are solved for: of one bin for a scene at rest ([`Background::Alone`]), else the
    /// camera's.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The operator of what is solved for.
    pub fn shutter(&self) -> &Arc<RollingShutter> {
        match self.background {
            Background::None => &self.foreground_operator,
            _ => self.model.shutter(),
        }
    }

    /// Typical size of a diagonal element of `B Bᵀ` without weights.
    pub fn scale(&self) -> f64 {
        self.model.scale(self.shutter())
    }

    /// The shape of the videos of [`Self::model`].
    pub fn shape(&self) -> Shape {
        self.shutter().video_shape()
    }

    /// See the field.
    pub fn foreground_operator(&self) -> &Arc<RollingShutter> {
        &self.foreground_operator
    }

    /// `W A` on the foreground.
    pub fn operator(&self) -> &Arc<WeightedOperator<Arc<RollingShutter>>> {
        &self.operator
    }

    /// `W A` on the stacked foreground and background.
    pub fn stacked_operator(&self) -> &dyn LinearOperator {
        match self.background {
            Background::None | Background::Alone => &*self.operator,
            Background::Static | Background::PerBin => &self.with_background,
        }
    }

    pub fn background(&self) -> Background {
        self.background
    }

    /// The support of the foreground; `None`: all voxels.
    pub fn support(&self) -> Option<&Support> {
        self.support.as_ref()
    }

    /// See the field.
    pub fn whole_field_operator(&self) -> Option<&RollingShutter> {
        self.whole_field_operator.as_ref()
    }

    /// The largest `w²` of the weights.
    pub fn max_squared_weight(&self) -> f64 {
        self.max_squared_weight
    }

    /// Number of pixels of the frame.
    pub fn measurement_len(&self) -> usize {
        self.operator.range_len()
    }

    /// Sets the weights of the frame's pixels; `None`: all 1.
    pub fn set_weights(&mut self, weights: Option<Vec<f32>>) {
        let shutter = Arc::clone(self.shutter());
        self.operator = Arc::new(WeightedOperator::new(shutter, weights));
        self.with_background =
            WithBackground::new(Arc::clone(&self.operator), self.shape(), self.background);
        self.max_squared_weight = max_squared(self.operator.weights());
    }

    /// Sets the background and all voxels active. [`Self::set_weights`] is to follow.
    pub fn set_background(&mut self, background: Background) {
        self.support = None;
        let (was_at_rest, is_at_rest) = (
            self.background == Background::Alone,
            background == Background::Alone,
        );
        if was_at_rest != is_at_rest {
            self.model = if is_at_rest {
                self.camera_model.at_rest()
            } else {
                self.camera_model.clone()
            };
        }
        self.background = background;
        if background == Background::Static && self.whole_field_operator.is_none() {
            self.whole_field_operator = whole_field_operator(&self.model);
        }
    }

    /// Sets the support; returns the one before.
    pub fn set_support(&mut self, support: &Support) -> Option<Support> {
        self.support.replace(support.clone())
    }

    /// Sets all voxels active; returns the support before.
    pub fn remove_support(&mut self) -> Option<Support> {
        self.support.take()
    }

    /// Whether the support differs from `before` (`None`: all voxels) in the bins of an instant.
    pub fn has_changed_at(&self, instant: usize, before: Option<&Support>) -> bool {
        let run = &self.shutter().time().instants()[instant];
        let bins = run.first_bin..run.first_bin + run.weights.len();
        match (&self.support, before) {
            (Some(support), Some(before)) => !support.equals_in_bins(before, bins),
            _ => true,
        }
    }

    /// The blocks, one for each instant.
    pub fn blocks<T: Scalar>(&self) -> Blocks<T> {
        let shutter = self.shutter();
        let indices = (0..shutter.rows_of_instants().len()).map(|i| shutter.indices_of(i));
        Blocks::new(indices.collect(), self).with_cancel(self.model().cancel())
    }

    /// Adds the block of the foreground and that of a background video.
    fn add_sum_of_blocks<T: Scalar>(&self, instant: usize, mut sum: MatMut<T>) {
        if self.model().cancel().is_cancelled() {
            return;
        }
        let shutter = self.shutter();
        add_gram_block(shutter, instant, self.support(), sum.rb_mut());
        if self.background == Background::PerBin {
            add_gram_block(shutter, instant, None, sum.rb_mut());
        }
    }

    /// Whether all bins of an instant are unrestricted.
    fn is_unrestricted_at(&self, instant: usize) -> bool {
        let run = &self.shutter().time().instants()[instant];
        let mut bins = run.first_bin..run.first_bin + run.weights.len();
        self.support()
            .is_none_or(|s| bins.all(|bin| s.pixels_of(bin).is_none()))
    }
}

/// The largest `w²`; 1 without weights.
fn max_squared(weights: Option<&[f32]>) -> f64 {
    weights.map_or(1.0, |weights| {
        f64::from(weights.iter().copied().fold(0.0, f32::max)).powi(2)
    })
}

/// Operator of a global shutter over the whole field of `model`.
fn whole_field_operator(model: &Model) -> Option<RollingShutter> {
    let (rows, columns) = model.camera().field();
    let whole_field = CameraParams {
        rows,
        columns,
        shutter: Shutter::Global,
        field: None,
        bins_per_row: 1,
        ..model.camera().params().clone()
    };
    // A field too large for a sensor has no preconditioner, so its solve takes more iterations.
    let camera = Camera::new(whole_field).ok()?;
    Some(RollingShutter::new(&camera, model.psfs().clone()))
}

impl<T: Scalar> BlockSource<T> for &System {
    fn write_block(&self, instant: usize, mut sum: MatMut<T>) {
        let shutter = self.shutter();
        let is_cached = self.is_unrestricted_at(instant) && self.background != Background::PerBin;
        match self
            .model
            .cached_block(shutter, instant)
            .filter(|_| is_cached)
        {
            Some(block) => round(block.as_ref(), sum.rb_mut()),
            None if builds_in_f64(shutter) => {
                let mut exact = Mat::<f64>::zeros(sum.nrows(), sum.ncols());
                self.add_sum_of_blocks(instant, exact.as_mut());
                round(exact.as_ref(), sum.rb_mut());
            }
            None => self.add_sum_of_blocks(instant, sum.rb_mut()),
        }
        if let Some(weights) = self.operator.weights() {
            let weights: Vec<T> = shutter
                .indices_of(instant)
                .iter()
                .map(|&i| T::from(weights[i]))
                .collect();
            for (j, column) in sum.col_iter_mut().enumerate() {
                let upper = column.subrows_mut(0, j + 1).iter_mut();
                let weighted = upper.zip(&weights);
                weighted.for_each(|(value, &weight)| *value *= weight * weights[j]);
            }
        }
    }

    fn is_unrestricted(&self, instant: usize) -> bool {
        self.is_unrestricted_at(instant)
    }

    fn columns(&self, instant: usize, max_columns: usize) -> Option<Mat<T>> {
        if self.background == Background::PerBin {
            return None;
        }
        let shutter = self.shutter();
        let mut columns = active_columns::<T>(shutter, instant, self.support()?, max_columns)?;
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
