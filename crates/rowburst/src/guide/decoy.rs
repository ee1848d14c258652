//! Decoys: rearrangements of a guide that show something else for sure, to be compared with the guide.
//!
//! A picture of another scene explains a frame as badly as its own mirror image does. So an honest guide is one that
//! predicts the held-out pixels better than the best of its decoys, by more than chance, when all are fitted alike: one
//! registration on the same coarse picture and a few steps of a coarse fit.

use super::affine::register;
use super::frame_fit::FrameFit;
use super::gain_field::GainModel;
use super::motion::{KeyFrame, MotionModel};
use super::{GuideModel, ORDERS};
use rowburst_optics::Image;
use rowburst_simulate::metrics::paired_gain;

/// Blurs of a coarse motion in pixels of a field of 108, and steps at each.
const BLURS_PX: [f64; 2] = [4.0, 2.0];
const STEPS: usize = 3;

/// How far `guide`, registered on `coarse`, predicts held-out pixels better than the best of its decoys under `model`, in
/// standard errors of the paired differences.
pub(super) fn gain_over_decoys(
    frame: &FrameFit,
    coarse: &Image,
    guide: &KeyFrame,
    model: GuideModel,
) -> f64 {
    let errors = |image: Image| coarse_errors(frame, coarse, image, guide.bins, model);
    let sum = |errors: &[f64]| -> f64 { errors.iter().map(|e| e * e).sum() };
    let decoys = decoys(&guide.image).map(errors);
    let best = decoys.iter().min_by(|a, b| sum(a).total_cmp(&sum(b)));
    let best = best.expect("there are decoys");
    paired_gain(best, &errors(guide.image.clone()))
}

/// Held-out residuals of a coarse fit of `image`.
fn coarse_errors(
    frame: &FrameFit,
    coarse: &Image,
    image: Image,
    bins: Option<(f64, f64)>,
    model: GuideModel,
) -> Vec<f64> {
    let (affine, _) = register(coarse, &image);
    let video = if model == GuideModel::Gain {
        let model = GainModel::new(frame, &image, affine);
        model.video(&model.coarse_fit())
    } else {
        let order = ORDERS[0].min(frame.shape().bins - 1);
        let model = MotionModel::new(frame, &[KeyFrame { image, bins }], affine, order);
        let mut motion = model.at_rest();
        model.fit(&mut motion, &BLURS_PX, STEPS);
        model.video(&motion)
    };
    frame.held_out_residuals(&video)
}

/// The picture mirrored, upside down, and turned by a quarter or, where it is not square, by a half.
fn decoys(guide: &Image) -> [Image; 3] {
    let (rows, columns) = (guide.rows(), guide.columns());
    let (bottom, right) = (rows - 1, columns - 1);
    let turned = |y: usize, x: usize| {
        if rows == columns {
            guide.at(x, right - y)
        } else {
            guide.at(bottom - y, right - x)
        }
    };
    [
        Image::from_fn(rows, columns, |y, x| guide.at(y, right - x)),
        Image::from_fn(rows, columns, |y, x| guide.at(bottom - y, x)),
        Image::from_fn(rows, columns, turned),
    ]
}
