//! The first map to a guide, by registration on the coarse video without a guide.

use super::affine::{Affine, register};
use super::frame_fit::FrameFit;
use super::motion::KeyFrame;
use super::without_guide::WithoutGuide;
use rowburst_optics::Image;
use std::ops::RangeInclusive;

/// Parts of the video that a guide of unknown time is compared with, beside the whole of it.
const PARTS: usize = 4;

/// A first map.
pub(super) struct Start {
    pub affine: Affine,
    /// Correlation of the registered guide with `picture`.
    pub correlation: f64,
    /// The coarse picture of the scene that the guide resembles most.
    pub picture: Image,
}

impl Start {
    /// Registers `guide` on the coarse video at its time. Where that is unknown, on the mean of the video and on the means of
    /// its parts, of which the best counts.
    pub fn new(frame: &FrameFit, without: &WithoutGuide, guide: &KeyFrame) -> Self {
        let all = coarse_pictures(frame, without, guide)
            .into_iter()
            .map(|picture| {
                let (affine, correlation) = register(&picture, &guide.image);
                Self {
                    affine,
                    correlation,
                    picture,
                }
            });
        let best = all.max_by(|a, b| a.correlation.total_cmp(&b.correlation));
        best.expect("at least one picture")
    }
}

/// The coarse video without a guide at the time of the guide. Where that is unknown, its mean and the means of its parts.
fn coarse_pictures(frame: &FrameFit, without: &WithoutGuide, guide: &KeyFrame) -> Vec<Image> {
    let bins = frame.shape().bins;
    if let Some((from, to)) = guide.bins {
        let bin = |t: f64| t.round().clamp(0.0, (bins - 1) as f64) as usize;
        return vec![mean_picture(frame, without, bin(from)..=bin(to))];
    }
    let parts = PARTS.min(bins);
    let part = |p: usize| p * bins / parts..=((p + 1) * bins / parts - 1);
    std::iter::once(0..=bins - 1)
        .chain((0..parts).map(part))
        .map(|bins| mean_picture(frame, without, bins))
        .collect()
}

/// The mean of the coarse video over `bins`.
fn mean_picture(frame: &FrameFit, without: &WithoutGuide, bins: RangeInclusive<usize>) -> Image {
    let shape = frame.shape();
    let count = bins.clone().count() as f32;
    let mut picture = Image::zeros(shape.rows, shape.columns);
    for t in bins {
        let bin = &without.video[t * shape.pixels()..(t + 1) * shape.pixels()];
        let pixels = picture.data_mut().iter_mut().zip(bin);
        pixels.for_each(|(p, v)| *p += v / count);
    }
    picture
}
