//! Videos that are a sum of two components, stacked in one vector.

use super::LinearOperator;
use crate::Shape;
use rayon::prelude::*;
use std::borrow::Cow;

/// The kind of the second component `l` of a video `s + E l`, which may be all of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Background {
    /// No second component.
    #[default]
    None,
    /// One picture `[y, x]`, which `E` shows in all bins.
    Static,
    /// A video `[t, y, x]`; `E` is the identity.
    PerBin,
    /// One picture `[y, x]`, which `E` shows in all bins, without a first component: a scene at rest.
    Alone,
}

impl Background {
    /// Length of `l` for videos of `shape`.
    pub fn len(self, shape: Shape) -> usize {
        match self {
            Self::None => 0,
            Self::Static | Self::Alone => shape.pixels(),
            Self::PerBin => shape.voxels(),
        }
    }

    /// Length of `s` for videos of `shape`.
    pub fn first_len(self, shape: Shape) -> usize {
        match self {
            Self::Alone => 0,
            Self::None | Self::Static | Self::PerBin => shape.voxels(),
        }
    }

    /// The video `s + E l`, `[t, y, x]`, for the vector `stacked = [s, l]`; borrowed if there is no `l`.
    ///
    /// # Panics
    /// If a length does not match.
    pub fn sum(self, shape: Shape, stacked: &[f32]) -> Cow<'_, [f32]> {
        let (first, background) = stacked.split_at(self.first_len(shape));
        assert_eq!(
            background.len(),
            self.len(shape),
            "length of the second part"
        );
        if background.is_empty() {
            return Cow::Borrowed(first);
        }
        if self == Self::Alone {
            return Cow::Owned(background.repeat(shape.bins));
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

/// The operator `[s, l] ↦ A (s + E l)` over both components; for `E` see [`Background`].
///
/// The adjoint is `y ↦ [Aᵀy, EᵀAᵀy]`. The cost is that of `A` and a pass over the video.
pub struct WithBackground<O> {
    operator: O,
    shape: Shape,
    background: Background,
}

impl<O: LinearOperator> WithBackground<O> {
    /// The operator of both components, from `operator` on videos of `shape`.
    ///
    /// # Panics
    /// If the domain of `operator` is not the voxels of `shape`.
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
        self.background.first_len(self.shape) + self.background.len(self.shape)
    }

    fn range_len(&self) -> usize {
        self.operator.range_len()
    }

    fn apply(&self, x: &[f32], y: &mut [f32]) {
        self.operator.apply(&self.background.sum(self.shape, x), y);
    }

    fn adjoint(&self, y: &[f32], x: &mut [f32]) {
        let (first, background) = x.split_at_mut(self.background.first_len(self.shape));
        if self.background == Background::Alone {
            let mut video = vec![0.0; self.shape.voxels()];
            self.operator.adjoint(y, &mut video);
            return sum_of_bins(&video, background);
        }
        self.operator.adjoint(y, first);
        match self.background {
            Background::None | Background::Alone => {}
            Background::Static => sum_of_bins(first, background),
            Background::PerBin => background.copy_from_slice(first),
        }
    }
}

/// `sum = Σ_t v[t]`, with `sum` the length of a bin; overwrites `sum`.
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
            for background in [
                Background::None,
                Background::Static,
                Background::PerBin,
                Background::Alone,
            ] {
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
        let alone = Background::Alone.sum(shape, &stacked[6..]);
        assert_eq!(alone[..], [10.0, 20.0, 30.0, 10.0, 20.0, 30.0]);
    }
}
