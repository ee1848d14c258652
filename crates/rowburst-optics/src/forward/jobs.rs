//! Products of one instant, which an engine computes in batches.

use rowburst_core::linop::Scalar;
use rowburst_core::vecmath::simd;
use std::borrow::Cow;
use std::ops::Range;

/// The light that an instant integrates: a weighted sum of planes `[y, x]`.
pub(super) struct Light<'a, T> {
    pub terms: Vec<(T, &'a [T])>,
    /// A factor for each row of each term.
    pub row_scales: Option<RowScales<'a>>,
}

/// Factors of the rows of some planes.
pub(super) struct RowScales<'a> {
    /// One for each row of a plane.
    pub of_planes: Vec<&'a [f32]>,
    /// Pixels of a row.
    pub columns: usize,
}

impl<'a, T: Scalar> Light<'a, T> {
    /// The light of one plane.
    pub fn of(plane: &'a [T]) -> Self {
        Self {
            terms: vec![(T::one(), plane)],
            row_scales: None,
        }
    }

    /// The plane that it is, if it is one as it stands.
    fn plane(&self) -> Option<&'a [T]> {
        match self.terms.as_slice() {
            [(weight, plane)] if *weight == T::one() && self.row_scales.is_none() => Some(plane),
            _ => None,
        }
    }

    /// Its values at the pixels of some whole rows, which are written to `buffer` unless they are those of a plane.
    pub fn at<'b>(&'b self, pixels: Range<usize>, buffer: &'b mut [T]) -> &'b [T] {
        if let Some(plane) = self.plane() {
            return &plane[pixels];
        }
        let buffer = &mut buffer[..pixels.len()];
        self.write(buffer, pixels.start);
        buffer
    }

    /// Its values at all of so many pixels.
    pub fn all(&self, pixels: usize) -> Cow<'_, [T]> {
        if let Some(plane) = self.plane() {
            return Cow::Borrowed(plane);
        }
        let mut light = vec![T::zero(); pixels];
        self.write(&mut light, 0);
        Cow::Owned(light)
    }

    /// Writes its values from pixel `start` on, where a row begins.
    fn write(&self, values: &mut [T], start: usize) {
        let Some(RowScales { of_planes, columns }) = &self.row_scales else {
            for (i, block) in values.chunks_mut(BLOCK).enumerate() {
                write_sum(block, &self.terms, start + i * BLOCK);
            }
            return;
        };
        let mut terms = self.terms.clone();
        for (i, row) in values.chunks_mut(*columns).enumerate() {
            let first = start + i * columns;
            let weights = self.terms.iter().zip(of_planes);
            for ((scaled, _), ((weight, _), scales)) in terms.iter_mut().zip(weights) {
                *scaled = *weight * T::from(scales[first / columns]);
            }
            write_sum(row, &terms, first);
        }
    }
}

/// Forward product of one instant: `values[i, x]` becomes sensor row `rows[i]` of the convolved `light`.
pub(super) struct ForwardJob<'a, T> {
    pub light: Light<'a, T>,
    pub rows: &'a [usize],
    pub values: &'a mut [T],
}

/// Adjoint product of one instant: from `values[i, x]` in sensor row `rows[i]` to the light of the field.
///
/// Field rows that are zero in `mask` need not be computed.
pub(super) struct AdjointJob<'a, T> {
    pub values: &'a [T],
    pub rows: &'a [usize],
    pub mask: Option<&'a [u8]>,
}

/// Elements of a sum of lights that stay in the nearest cache from one use to the next.
pub(super) const BLOCK: usize = 1024;

/// `sum = Σ weight · term`, of each term the elements from `start` on.
pub(super) fn write_sum<T: Scalar>(sum: &mut [T], terms: &[(T, &[T])], start: usize) {
    /// Elements that stay in registers from one term to the next.
    const REGISTERS: usize = 64;
    simd(
        #[inline(always)]
        || {
            let (parts, rest) = sum.as_chunks_mut::<REGISTERS>();
            let rest_start = start + parts.len() * REGISTERS;
            for (i, part) in parts.iter_mut().enumerate() {
                let start = start + i * REGISTERS;
                let mut sum = [T::zero(); REGISTERS];
                for (weight, term) in terms {
                    for (s, &t) in sum.iter_mut().zip(&term[start..start + REGISTERS]) {
                        *s += *weight * t;
                    }
                }
                *part = sum;
            }
            rest.fill(T::zero());
            for (weight, term) in terms {
                for (s, &t) in rest.iter_mut().zip(&term[rest_start..]) {
                    *s += *weight * t;
                }
            }
        },
    );
}

/// `sum += weight · term`.
pub(super) fn add_scaled<T: Scalar>(sum: &mut [T], term: &[T], weight: T) {
    simd(
        #[inline(always)]
        || {
            for (s, &t) in sum.iter_mut().zip(term) {
                *s += weight * t;
            }
        },
    );
}
