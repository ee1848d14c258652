//! Videos that are the sum of two parts, as one vector of both.

use super::LinearOperator;
use crate::Shape;
use rayon::prelude::*;
use std::borrow::Cow;

/// What the second part of a video is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Background {
    /// There is none.
    #[default]
    None,
    /// One picture that all bins show.
    Static,
    /// A video.
    Video,
}

impl Background {
    /// Numbers that it takes beside those of a video of `shape`.
    pub fn len(self, shape: Shape) -> usize {
        match self {
            Self::None => 0,
            Self::Static => shape.pixels(),
            Self::Video => shape.voxels(),
        }
    }

    /// `out = s + E l`, the video that both parts make, `[t, y, x]`; `stacked` is `[s, l]`.
    ///
    /// # Panics
    /// If a length does not match.
    pub fn sum(self, shape: Shape, stacked: &[f32]) -> Cow<'_, [f32]> {
        let (first, background) = stacked.split_at(shape.voxels());
        assert_eq!(
            background.len(),
            self.len(shape),
            "length of the second part"
        );
        if background.is_empty() {
            return Cow::Borrowed(first);
        }
        let mut sum = first.to_vec();
        sum.par_chunks_mut(shape.pixels())
            .enumerate()
            .for_each(|(t, bin)| {
                let at = t * shape.pixels() % background.len();
                let background = &background[at..at + bin.len()];
                bin.iter_mut().zip(background).for_each(|(b, l)| *b += l);
            });
        Cow::Owned(sum)
    }
}

/// `A [s, l] = A (s + E l)`, where `E` shows a still picture in all bins, or is the identity.
///
/// Adjoint: `[Aᵀy, EᵀAᵀy]`. Cost: that of `A`, and a pass over the video.
pub struct WithBackground<O> {
    operator: O,
    shape: Shape,
    background: Background,
}

impl<O: LinearOperator> WithBackground<O> {
    /// `operator` of videos of `shape`, for both parts.
    ///
    /// # Panics
    /// If the operator does not take videos of this shape.
    pub fn new(operator: O, shape: Shape, background: Background) -> Self {
        let voxels = shape.voxels();
        assert_eq!(operator.domain_len(), voxels, "videos of this shape");
        Self {
            operator,
            shape,
            background,
        }
    }
}

impl<O: LinearOperator> LinearOperator for WithBackground<O> {
    fn domain_len(&self) -> usize {
        self.shape.voxels() + self.background.len(self.shape)
    }

    fn range_len(&self) -> usize {
        self.operator.range_len()
    }

    fn apply(&self, x: &[f32], y: &mut [f32]) {
        self.operator.apply(&self.background.sum(self.shape, x), y);
    }

    fn adjoint(&self, y: &[f32], x: &mut [f32]) {
        let (first, background) = x.split_at_mut(self.shape.voxels());
        self.operator.adjoint(y, first);
        match self.background {
            Background::None => {}
            Background::Static => sum_of_bins(first, background),
            Background::Video => background.copy_from_slice(first),
        }
    }
}

/// `sum = Σ_t v[t]`.
pub fn sum_of_bins(video: &[f32], sum: &mut [f32]) {
    const CHUNK: usize = 1 << 10;
    let pixels = sum.len();
    sum.par_chunks_mut(CHUNK).enumerate().for_each(|(i, sum)| {
        sum.fill(0.0);
        for bin in video.chunks_exact(pixels) {
            let bin = &bin[i * CHUNK..i * CHUNK + sum.len()];
            sum.iter_mut().zip(bin).for_each(|(s, v)| *s += v);
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linop::{Axis, Differences, laws};

    #[test]
    fn keeps_the_laws() {
        for shape in [Shape::new(3, 4, 5), Shape::new(1, 2, 7)] {
            for background in [Background::None, Background::Static, Background::Video] {
                let differences = Differences::new(shape, vec![Axis::Rows, Axis::Columns]);
                laws::check(&WithBackground::new(differences, shape, background), 5);
            }
        }
    }

    #[test]
    fn a_still_picture_is_in_every_bin() {
        let shape = Shape::new(2, 1, 3);
        let stacked = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 10.0, 20.0, 30.0];
        let sum = Background::Static.sum(shape, &stacked);
        assert_eq!(sum[..], [11.0, 22.0, 33.0, 14.0, 25.0, 36.0]);
    }
}
