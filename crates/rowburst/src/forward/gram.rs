//! The Gram matrix of one instant, `G_i = S_i S_iᵀ`, without operator calls.
//!
//! ```text
//! G[(a,x),(b,x')] = Σ_y Σ_ξ p_a(y, x−ξ) p_b(y, x'−ξ)
//! ```
//!
//! Moving both columns by one shifts the sum over field columns `ξ` by one, so a
//! step along a diagonal adds the products of the column that enters and takes away
//! those of the column that leaves: two matrix products and a running sum.

use super::RollingShutter;
use crate::solve::Support;
use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, Par};

impl RollingShutter {
    /// `S_i S_iᵀ` in f64 for the rows of instant `i`, row after row: the index of
    /// column `x` of the instant's `a`-th row is `a · columns + x`.
    ///
    /// Cost: about `2 (rows·columns)² · field_rows` multiply–adds, with the number of
    /// rows of this instant.
    fn spatial_gram(&self, instant: usize) -> Mat<f64> {
        let g = &self.geometry;
        let rows = &self.rows_of[instant];
        let columns = g.columns;
        let size = rows.len() * columns;
        let psf = |r: usize, y: usize, dx: isize| {
            f64::from(self.psf.at_displacement(g.row_displacement(r, y), dx))
        };
        let enters = Mat::from_fn(size, g.field_rows, |i, y| {
            psf(
                rows[i / columns],
                y,
                g.column_displacement(i % columns + 1, 0),
            )
        });
        let leaves = Mat::from_fn(size, g.field_rows, |i, y| {
            psf(
                rows[i / columns],
                y,
                g.column_displacement(i % columns, g.field_columns - 1),
            )
        });
        let mut gram = Mat::<f64>::zeros(size, size);
        matmul(
            &mut gram,
            Accum::Replace,
            &enters,
            enters.transpose(),
            1.0,
            Par::Seq,
        );
        matmul(
            &mut gram,
            Accum::Add,
            &leaves,
            leaves.transpose(),
            -1.0,
            Par::Seq,
        );
        // `gram` holds at (x, x') the step to (x+1, x'+1). First each row's edge x = 0 …
        let edges = self.first_columns(rows);
        // … then running sums down every diagonal of every pair of rows.
        for (a, b) in (0..rows.len()).flat_map(|a| (0..rows.len()).map(move |b| (a, b))) {
            for diagonal in -(columns as isize - 1)..columns as isize {
                let (mut x, mut x2) = ((-diagonal).max(0) as usize, diagonal.max(0) as usize);
                let mut value = if diagonal >= 0 {
                    edges[(a * columns, b * columns + x2)]
                } else {
                    edges[(b * columns, a * columns + x)]
                };
                while x < columns && x2 < columns {
                    let step = gram[(a * columns + x, b * columns + x2)];
                    gram[(a * columns + x, b * columns + x2)] = value;
                    value += step;
                    (x, x2) = (x + 1, x2 + 1);
                }
            }
        }
        gram
    }

    /// `G[(a,0),(b,x')]`, at row `a · columns` of the matrix returned.
    fn first_columns(&self, rows: &[usize]) -> Mat<f64> {
        let g = &self.geometry;
        let columns = g.columns;
        let mut edges = Mat::<f64>::zeros(rows.len() * columns, rows.len() * columns);
        // All column displacements that any (x, ξ) has, in one line per PSF row.
        let first = g.column_displacement(0, g.field_columns - 1);
        let width = columns + g.field_columns - 1;
        let line = |r: usize, y: usize| -> Vec<f64> {
            let dy = g.row_displacement(r, y);
            (0..width)
                .map(|i| f64::from(self.psf.at_displacement(dy, first + i as isize)))
                .collect()
        };
        for y in 0..g.field_rows {
            let lines: Vec<Vec<f64>> = rows.iter().map(|&r| line(r, y)).collect();
            for (a, line_a) in lines.iter().enumerate() {
                for (b, line_b) in lines.iter().enumerate() {
                    for x in 0..columns {
                        let pairs = line_a[..g.field_columns].iter().zip(&line_b[x..]);
                        edges[(a * columns, b * columns + x)] += lanes_dot(pairs);
                    }
                }
            }
        }
        edges
    }
}

fn lanes_dot<'a>(pairs: impl Iterator<Item = (&'a f64, &'a f64)>) -> f64 {
    pairs.map(|(a, b)| a * b).sum()
}

impl RollingShutter {
    /// The diagonal block of `A P Aᵀ` of the rows of instant `i`, in f64, with `P` the
    /// projection onto `support` (`None`: every voxel). Indices as in
    /// [`Self::indices_of`].
    ///
    /// The blocks are all of `A P Aᵀ` where no bin is seen by two instants.
    pub fn gram_block(&self, instant: usize, support: Option<&Support>) -> Mat<f64> {
        let run = &self.time.instants()[instant];
        let mut gram = Mat::<f64>::zeros(0, 0);
        let mut open_weight = 0.0;
        for (k, weight) in run.weights.iter().enumerate() {
            match support.and_then(|s| s.pixels_of(run.first_bin + k)) {
                None => open_weight += weight * weight,
                Some(pixels) => add_outer(
                    &mut gram,
                    &self.columns_of(instant, &pixels),
                    weight * weight,
                ),
            }
        }
        if open_weight > 0.0 {
            let full = self.spatial_gram(instant);
            if gram.nrows() == 0 {
                gram = full * open_weight;
            } else {
                gram += full * open_weight;
            }
        }
        gram
    }

    /// Positions in the frame of the rows of instant `i`, in the order of its block.
    pub fn indices_of(&self, instant: usize) -> Vec<usize> {
        let columns = self.geometry.columns;
        let rows = self.rows_of[instant].iter();
        rows.flat_map(|&row| row * columns..(row + 1) * columns)
            .collect()
    }

    /// The columns of `S_i` for some pixels of the field: shifted cut-outs of the PSF.
    fn columns_of(&self, instant: usize, pixels: &[usize]) -> Mat<f64> {
        let g = &self.geometry;
        let rows = &self.rows_of[instant];
        Mat::from_fn(rows.len() * g.columns, pixels.len(), |i, p| {
            let (y, x) = (pixels[p] / g.field_columns, pixels[p] % g.field_columns);
            let dy = g.row_displacement(rows[i / g.columns], y);
            f64::from(
                self.psf
                    .at_displacement(dy, g.column_displacement(i % g.columns, x)),
            )
        })
    }
}

/// `gram += weight · a aᵀ`, from nothing if `gram` is still empty.
fn add_outer(gram: &mut Mat<f64>, a: &Mat<f64>, weight: f64) {
    if gram.nrows() == 0 {
        *gram = Mat::zeros(a.nrows(), a.nrows());
    }
    matmul(gram, Accum::Add, a, a.transpose(), weight, Par::Seq);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraParams;
    use crate::linop::LinearOperator;
    use crate::{Camera, Image, Psf, Sensor, Shutter};
    use rand::{RngExt, SeedableRng};

    /// `A P Aᵀ` by operator calls on unit vectors.
    fn brute_force(operator: &RollingShutter, support: Option<&Support>) -> Vec<Vec<f32>> {
        (0..operator.range_len())
            .map(|i| {
                let mut unit = vec![0.0; operator.range_len()];
                unit[i] = 1.0;
                let mut video = vec![0.0; operator.domain_len()];
                operator.adjoint(&unit, &mut video);
                if let Some(support) = support {
                    support.apply(&mut video);
                }
                operator.apply(&video, &mut unit);
                unit
            })
            .collect()
    }

    #[test]
    fn blocks_agree_with_operator_calls() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
        let cases = [
            (Shutter::DualInsideOut, (6, 5), None, 1.0, 1),
            (Shutter::DualOutsideIn, (7, 4), Some((9, 8)), 0.5, 2),
            (Shutter::TopDown, (5, 6), Some((5, 9)), 2.5, 1),
            (Shutter::Global, (4, 3), Some((6, 6)), 1.0, 1),
        ];
        for (shutter, (rows, columns), field, exposure, bins_per_row) in cases {
            let camera = Camera::new(CameraParams {
                rows,
                columns,
                shutter,
                row_time_us: 1.0,
                exposure_us: exposure,
                bins_per_row,
                field,
                sensor: Sensor::default(),
            })
            .unwrap();
            let values = (0..11 * 9).map(|_| rng.random_range(0.0f32..1.0)).collect();
            let psf = Psf::new(Image::new(11, 9, values).unwrap()).unwrap();
            let operator = RollingShutter::new(&camera, &psf);
            let shape = operator.video_shape();
            let video: Vec<f32> = (0..shape.voxels())
                .map(|_| rng.random_range(0.0..1.0))
                .collect();
            // Few enough lit voxels that no bin counts as open; bin 0 is opened on purpose.
            let mut thresholds = vec![0.97; shape.bins];
            thresholds[0] = 0.0;
            let some = Support::above(&video, shape, &thresholds);
            for support in [None, Some(&some)] {
                let expected = brute_force(&operator, support);
                for instant in 0..operator.rows_of_instants().len() {
                    let gram = operator.gram_block(instant, support);
                    let indices = operator.indices_of(instant);
                    for (i, &row) in indices.iter().enumerate() {
                        for (j, &column) in indices.iter().enumerate() {
                            let error = (gram[(i, j)] - f64::from(expected[row][column])).abs();
                            assert!(error < 1e-7, "{camera:?} {instant} {i} {j}: {error}");
                        }
                    }
                }
            }
        }
    }
}
