//! Forward differences of a video along chosen axes.

use super::LinearOperator;
use crate::Shape;

/// An axis of a video `[t, y, x]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// From bin to bin.
    Time,
    /// From row to row.
    Rows,
    /// From column to column.
    Columns,
}

/// `K v`: for each axis in turn a video of `v[i+1] − v[i]`, zero where there is no next
/// voxel (Neumann boundary).
///
/// Adjoint: minus the divergence. Cost: one pass over the video for each axis.
pub struct Differences {
    shape: Shape,
    axes: Vec<Axis>,
}

impl Differences {
    /// Differences of videos of `shape` along `axes`, in their order.
    pub fn new(shape: Shape, axes: Vec<Axis>) -> Self {
        Self { shape, axes }
    }

    /// An upper bound of `‖K‖²`: 4 for each axis.
    pub fn norm_squared_bound(&self) -> f64 {
        4.0 * self.axes.len() as f64
    }

    /// The distance of neighbours along `axis`, and the number of voxels along it.
    fn stride(&self, axis: Axis) -> (usize, usize) {
        let Shape {
            bins,
            rows,
            columns,
        } = self.shape;
        match axis {
            Axis::Time => (rows * columns, bins),
            Axis::Rows => (columns, rows),
            Axis::Columns => (1, columns),
        }
    }
}

impl LinearOperator for Differences {
    fn domain_len(&self) -> usize {
        self.shape.voxels()
    }

    fn range_len(&self) -> usize {
        self.axes.len() * self.shape.voxels()
    }

    fn apply(&self, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), self.domain_len(), "length of the video");
        assert_eq!(y.len(), self.range_len(), "length of the differences");
        for (&axis, y) in self.axes.iter().zip(y.chunks_exact_mut(x.len())) {
            let (stride, count) = self.stride(axis);
            let slabs = y.chunks_exact_mut(stride * count);
            for (y, x) in slabs.zip(x.chunks_exact(stride * count)) {
                let (inner, last) = y.split_at_mut(stride * (count - 1));
                for (y, (now, next)) in inner.iter_mut().zip(x.iter().zip(&x[stride..])) {
                    *y = next - now;
                }
                last.fill(0.0);
            }
        }
    }

    fn adjoint(&self, y: &[f32], x: &mut [f32]) {
        assert_eq!(x.len(), self.domain_len(), "length of the video");
        assert_eq!(y.len(), self.range_len(), "length of the differences");
        x.fill(0.0);
        for (&axis, y) in self.axes.iter().zip(y.chunks_exact(x.len())) {
            let (stride, count) = self.stride(axis);
            let slabs = x.chunks_exact_mut(stride * count);
            for (x, y) in slabs.zip(y.chunks_exact(stride * count)) {
                let inner = &y[..stride * (count - 1)];
                x.iter_mut().zip(inner).for_each(|(x, y)| *x -= y);
                x[stride..].iter_mut().zip(inner).for_each(|(x, y)| *x += y);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linop::{laws, operator_norm};

    #[test]
    fn obey_the_laws_and_their_norm_is_below_its_bound() {
        let all = [Axis::Rows, Axis::Columns, Axis::Time];
        for (bins, rows, columns) in [(3, 5, 7), (1, 4, 6), (4, 1, 3), (2, 6, 1), (9, 10, 11)] {
            for axes in [&all[..], &all[..2], &all[2..]] {
                let operator = Differences::new(Shape::new(bins, rows, columns), axes.to_vec());
                laws::check(&operator, 3);
                let norm = operator_norm(&operator);
                assert!(norm.powi(2) < operator.norm_squared_bound());
            }
        }
    }

    #[test]
    fn a_small_video_by_hand() {
        let operator = Differences::new(Shape::new(2, 1, 3), vec![Axis::Columns, Axis::Time]);
        let mut y = [f32::NAN; 12];
        operator.apply(&[1.0, 3.0, 7.0, 2.0, 2.0, 9.0], &mut y);
        assert_eq!(y[..6], [2.0, 4.0, 0.0, 0.0, 7.0, 0.0]);
        assert_eq!(y[6..], [1.0, -1.0, 2.0, 0.0, 0.0, 0.0]);
    }
}
