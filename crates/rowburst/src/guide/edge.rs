//! The edge: places of the field that a guide does not show, because it is shifted or shows the scene larger.
//!
//! The models continue the guide there by the values of its rim. What is missing is estimated from the frame alone, by a
//! few cosines in time like a video without a guide, but at those places only: they are few, so the frame tells them well.
//! Left out, their light would be explained by motion elsewhere.

use super::affine::{Affine, Field};
use super::frame_fit::FrameFit;
use super::without_guide::rest_at;

/// Part of the field below which the edge is left as it is; smaller takes time for a few pixels.
const MIN_PART: f64 = 0.002;

/// What the edge adds to the video of a model, `[t, y, x]`; `None` without an edge.
#[derive(Clone)]
pub(super) struct Edge(Option<Vec<f32>>);

impl Edge {
    /// The edge beside `video`, the video of a model with the map `affine`, for the fitted pixels of `frame`.
    pub fn new(frame: &FrameFit, video: &[f32], affine: &Affine) -> Self {
        let shape = frame.shape();
        let field = Field {
            rows: shape.rows,
            columns: shape.columns,
        };
        let places = unseen(field, affine);
        let count = places.iter().filter(|p| **p).count();
        let is_visible = count as f64 >= MIN_PART * places.len() as f64;
        Self(is_visible.then(|| rest_at(frame, video, &places)))
    }

    /// The frame without the light of the edge.
    pub fn removed_from<'f>(&self, frame: &FrameFit<'f>) -> FrameFit<'f> {
        match &self.0 {
            Some(video) => frame.without_light_of(video),
            None => frame.clone(),
        }
    }

    /// `video` with the edge, without negative light.
    pub fn added_to(&self, mut video: Vec<f32>) -> Vec<f32> {
        if let Some(edge) = &self.0 {
            let pairs = video.iter_mut().zip(edge);
            pairs.for_each(|(v, e)| *v = (*v + e).max(0.0));
        }
        video
    }
}

/// Whether each pixel of the field lies outside the guide, whose grid is that of the field.
fn unseen(field: Field, affine: &Affine) -> Vec<bool> {
    let (dy, dx) = field.displacement(affine);
    let is_outside = |at: f32, n: usize| at < 0.0 || at > (n - 1) as f32;
    (0..dy.len())
        .map(|i| {
            let (y, x) = ((i / field.columns) as f32, (i % field.columns) as f32);
            is_outside(y + dy[i], field.rows) || is_outside(x + dx[i], field.columns)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shifted_guide_leaves_a_strip_unseen() {
        let field = Field {
            rows: 6,
            columns: 4,
        };
        let parameters = [2.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let places = unseen(field, &Affine { parameters });
        let rows: Vec<bool> = places.chunks(4).map(|row| row[0]).collect();
        assert_eq!(rows, [false, false, false, false, true, true]);
        assert!(unseen(field, &Affine::default()).iter().all(|p| !p));
    }
}
