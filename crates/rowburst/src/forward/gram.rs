//! The Gram matrix of one instant, `G_i = S_i S_iᵀ`, without operator calls.
//!
//! ```text
//! G[(a,x),(b,x')] = Σ_y Σ_ξ p_a(y, x−ξ) p_b(y, x'−ξ)
//! ```
//!
//! Moving both columns by one shifts the sum over field columns `ξ` by one, so a
//! step along a diagonal adds the products of the column that enters and takes away
//! those of the column that leaves: two matrix products and a running sum. A PSF that
//! changes over the field has no such diagonals: there the columns of `S_i` are written
//! out, some at a time, and multiplied.

use super::engine::smooth_length;
use super::{Layer, RollingShutter};
use crate::linop::Scalar;
use crate::{Psf, Support};
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::mat::AsMatMut;
use faer::reborrow::ReborrowMut;
use faer::{Accum, Mat, MatMut, Par};
use realfft::RealFftPlanner;
use rustfft::num_complex::Complex64;

/// Columns of `S_i` that are held at once.
const COLUMNS_PER_BATCH: usize = 128;

/// Columns of a sensor from which on blocks stay f32, and the products of PSF columns are taken in f32, in half of the
/// time. The sums that run along the diagonals are f64 all the same: their error is near 1e-8 of the diagonal in each
/// element, 1e-6 in the norm of the block, where [`MIN_RHO`] is ten times as much.
const SINGLE_FROM: usize = 1024;

/// Smallest `ρ` over a diagonal element of the block, of such sensors and of others, whose f64 factors have no
/// digits left below it.
const MIN_RHO: (f64, f64) = (1e-5, 1e-9);

/// Bytes of an element of a block of a sensor of so many columns, at most.
pub(crate) fn element_bytes(columns: usize) -> usize {
    match columns >= SINGLE_FROM {
        true => size_of::<f32>(),
        false => size_of::<f64>(),
    }
}

impl RollingShutter {
    /// The upper triangle of `sum += weight · S_i S_iᵀ` for the rows of instant `i`, row after row: the index
    /// of column `x` of the instant's `a`-th row is `a · columns + x`.
    ///
    /// Cost: about `(rows·columns)² · field_rows` multiply–adds, with the number of
    /// rows of this instant: in f32 on sensors from [`SINGLE_FROM`] columns on.
    fn add_spatial_gram<S: Scalar>(&self, instant: usize, weight: f64, sum: MatMut<S>) {
        match self.layers.as_slice() {
            [
                Layer {
                    psf, share: None, ..
                },
            ] if self.geometry.columns >= SINGLE_FROM => {
                self.add_shifted::<f32, S>(instant, psf, weight, sum);
            }
            [
                Layer {
                    psf, share: None, ..
                },
            ] => self.add_shifted::<f64, S>(instant, psf, weight, sum),
            _ => {
                let pixels: Vec<usize> = (0..self.video.pixels()).collect();
                self.add_gram_of(instant, &pixels, weight, sum);
            }
        }
    }

    /// The same for one PSF, with the products of the columns that enter and leave in `T`.
    fn add_shifted<T: Scalar, S: Scalar>(
        &self,
        instant: usize,
        psf: &Psf,
        weight: f64,
        mut sum: MatMut<S>,
    ) {
        let g = &self.geometry;
        let rows = &self.rows_of[instant];
        let columns = g.columns;
        // `[x, y]`: PSF values that lead to row `r` from the field column that enters, and, times
        // `sign`, from the one that leaves.
        let strips = |r: usize, sign: f32| {
            let mut strips = Mat::<T>::zeros(columns, 2 * g.field_rows);
            let sides = [(1, 0, 1.0), (0, g.field_columns - 1, sign)];
            for (side, (x0, field_x, factor)) in sides.into_iter().enumerate() {
                let dx = g.column_displacement(x0, field_x);
                for y in 0..g.field_rows {
                    let values = psf.row_from(g.row_displacement(r, y), dx);
                    let line = strips.col_as_slice_mut(side * g.field_rows + y);
                    let line = line.iter_mut().skip(values.start).zip(values.values);
                    line.for_each(|(to, value)| *to = T::from(factor * *value));
                }
            }
            strips
        };
        let edges = self.first_columns(psf, rows);
        let strips: Vec<_> = rows
            .iter()
            .map(|&r| (strips(r, 1.0), strips(r, -1.0)))
            .collect();
        let mut steps = Mat::<T>::zeros(columns, columns);
        for (a, b) in (0..rows.len()).flat_map(|a| (a..rows.len()).map(move |b| (a, b))) {
            let part = if a == b { UPPER } else { WHOLE };
            multiply(
                &mut steps,
                part,
                Accum::Replace,
                (&strips[a].0, &strips[b].1),
                T::one(),
            );
            let edge = |a: usize, b: usize| &edges[(a * rows.len() + b) * columns..][..columns];
            // `[x]`: this column of the block of the two rows, made from the last one.
            let mut line = edge(b, a).to_vec();
            for x2 in 0..columns {
                if x2 > 0 {
                    let steps = steps.col_as_slice(x2 - 1);
                    line.copy_within(..columns - 1, 1);
                    let moved = line[1..].iter_mut().zip(steps);
                    moved.for_each(|(value, step)| *value += (*step).into());
                    line[0] = edge(a, b)[x2];
                }
                let end = if a == b { x2 + 1 } else { columns };
                let column = sum.rb_mut().col_mut(b * columns + x2);
                let column = column.subrows_mut(a * columns, end);
                let pairs = column.iter_mut().zip(&line);
                pairs.for_each(|(sum, value)| *sum += S::nearest(weight * value));
            }
        }
    }

    /// `G[(a,0),(b,x')]`, at `(a · number of rows + b) · columns + x'`.
    fn first_columns(&self, psf: &Psf, rows: &[usize]) -> Vec<f64> {
        let g = &self.geometry;
        let mut edges = vec![0.0; rows.len() * rows.len() * g.columns];
        // All column displacements that any (x, ξ) has, in one line per PSF row.
        let first = g.column_displacement(0, g.field_columns - 1);
        let width = g.columns + g.field_columns - 1;
        let line = |r: usize, y: usize| -> Vec<f64> {
            let dy = g.row_displacement(r, y);
            (0..width)
                .map(|i| f64::from(psf.at_displacement(dy, first + i as isize)))
                .collect()
        };
        // Σ_ξ a[ξ] b[x + ξ] over all field rows: correlations, which add up as spectra. No sum that
        // is wanted reaches beyond `width`, so nothing wraps around.
        let length = smooth_length(width);
        let mut planner = RealFftPlanner::<f64>::new();
        let (forward, inverse) = (
            planner.plan_fft_forward(length),
            planner.plan_fft_inverse(length),
        );
        let spectrum = || vec![Complex64::ZERO; length / 2 + 1];
        let mut sums = vec![spectrum(); rows.len() * rows.len()];
        let (mut short, mut long) = (vec![spectrum(); rows.len()], vec![spectrum(); rows.len()]);
        let mut values = vec![0.0; length];
        for y in 0..g.field_rows {
            for ((&r, short), long) in rows.iter().zip(&mut short).zip(&mut long) {
                let line = line(r, y);
                for (part, to) in [(g.field_columns, short), (width, long)] {
                    values[..part].copy_from_slice(&line[..part]);
                    values[part..].fill(0.0);
                    forward.process(&mut values, to).expect("lengths match");
                }
            }
            let pairs = short.iter().flat_map(|a| long.iter().map(move |b| (a, b)));
            for ((a, b), sum) in pairs.zip(&mut sums) {
                let products = a.iter().zip(b).map(|(a, b)| a.conj() * b);
                sum.iter_mut().zip(products).for_each(|(s, p)| *s += p);
            }
        }
        for (sum, edge) in sums.iter_mut().zip(edges.chunks_exact_mut(g.columns)) {
            // A real signal's constant and highest frequency are real but for rounding.
            sum[0].im = 0.0;
            if length.is_multiple_of(2) {
                sum[length / 2].im = 0.0;
            }
            inverse.process(sum, &mut values).expect("lengths match");
            let scaled = values.iter().map(|v| v / length as f64);
            edge.iter_mut().zip(scaled).for_each(|(e, v)| *e = v);
        }
        edges
    }
}

const WHOLE: BlockStructure = BlockStructure::Rectangular;
const UPPER: BlockStructure = BlockStructure::TriangularUpper;

/// The `part` of `to` plus or replaced by `weight · a bᵀ`.
fn multiply<T: Scalar>(
    to: impl AsMatMut<T = T, Rows = usize, Cols = usize>,
    part: BlockStructure,
    accum: Accum,
    (a, b): (&Mat<T>, &Mat<T>),
    weight: T,
) {
    let b = b.transpose();
    triangular::matmul(to, part, accum, a, WHOLE, b, WHOLE, weight, Par::Seq);
}

impl RollingShutter {
    /// Whether a block is a sum of so many parts that it has to be made in f64.
    pub(crate) fn sums_need_f64(&self) -> bool {
        self.geometry.columns < SINGLE_FROM || self.layers.len() > 1
    }

    /// Smallest `ρ` over the typical size of a diagonal element for which `(G + ρI)⁻¹` has digits.
    pub fn min_rho(&self) -> f64 {
        match self.geometry.columns >= SINGLE_FROM {
            true => MIN_RHO.0,
            false => MIN_RHO.1,
        }
    }

    /// Adds to `sum` the diagonal block of `A P Aᵀ` of the rows of instant `i`,
    /// with `P` the projection onto `support` (`None`: every voxel). Indices as in
    /// [`Self::indices_of`]. The block is symmetric: only what lies on and above its diagonal
    /// is written.
    ///
    /// The blocks are all of `A P Aᵀ` where no bin is seen by two instants.
    pub fn add_gram_block<T: Scalar>(
        &self,
        instant: usize,
        support: Option<&Support>,
        mut sum: MatMut<T>,
    ) {
        let run = &self.time.instants()[instant];
        let mut open_weight = 0.0;
        for (k, weight) in run.weights.iter().enumerate() {
            match support.and_then(|s| s.pixels_of(run.first_bin + k)) {
                None => open_weight += weight * weight,
                Some(pixels) => {
                    self.add_gram_of(instant, &pixels, weight * weight, sum.rb_mut());
                }
            }
        }
        if open_weight > 0.0 {
            self.add_spatial_gram(instant, open_weight, sum);
        }
    }

    /// The columns of `A` that lead from the lit voxels of `support` to the rows of instant `i`: `B` with `B Bᵀ`
    /// the block of [`Self::add_gram_block`]. `None` where a bin is open, or there are more than `max_columns`.
    pub fn active_columns<T: Scalar>(
        &self,
        instant: usize,
        support: &Support,
        max_columns: usize,
    ) -> Option<Mat<T>> {
        let run = &self.time.instants()[instant];
        let bins = run.first_bin..run.first_bin + run.weights.len();
        let active: Option<Vec<Vec<usize>>> = bins.map(|bin| support.pixels_of(bin)).collect();
        let active =
            active.filter(|active| active.iter().map(Vec::len).sum::<usize>() <= max_columns)?;
        let all: Vec<usize> = active.concat();
        let mut columns = self.columns_of(instant, &all);
        let weights = active.iter().zip(&run.weights);
        let weights =
            weights.flat_map(|(active, weight)| std::iter::repeat_n(*weight, active.len()));
        for (mut column, weight) in columns.col_iter_mut().zip(weights) {
            column *= faer::Scale(T::nearest(weight));
        }
        Some(columns)
    }

    /// The upper triangle of `sum += weight · S_i P S_iᵀ`, with `P` the projection onto `pixels`.
    fn add_gram_of<T: Scalar>(
        &self,
        instant: usize,
        pixels: &[usize],
        weight: f64,
        mut sum: MatMut<T>,
    ) {
        let weight = T::nearest(weight);
        // A few columns at a time: those of a crowded bin are several videos' worth.
        for pixels in pixels.chunks(COLUMNS_PER_BATCH) {
            let a = self.columns_of(instant, pixels);
            multiply(sum.rb_mut(), UPPER, Accum::Add, (&a, &a), weight);
        }
    }

    /// The diagonal element of `A Aᵀ` of the sensor's pixel `(row, column)`, in a row that is read.
    pub fn pixel_power(&self, row: usize, column: usize) -> f64 {
        let g = &self.geometry;
        let sees = |rows: &Vec<usize>| rows.contains(&row);
        let instant = self
            .rows_of
            .iter()
            .position(sees)
            .expect("every row is read");
        let exposure: f64 = self.time.instants()[instant]
            .weights
            .iter()
            .map(|w| w * w)
            .sum();
        let mut power = 0.0;
        for pixel in 0..self.video.pixels() {
            let (y, x) = (pixel / g.field_columns, pixel % g.field_columns);
            let (dy, dx) = (g.row_displacement(row, y), g.column_displacement(column, x));
            let shares = self.layers.iter().map(|layer| layer.value(pixel, dy, dx));
            power += shares.sum::<f64>().powi(2);
        }
        exposure * power
    }

    /// Positions in the frame of the rows of instant `i`, in the order of its block.
    pub fn indices_of(&self, instant: usize) -> Vec<usize> {
        let columns = self.geometry.columns;
        let places = self.places_of[instant].iter();
        places
            .flat_map(|&row| row * columns..(row + 1) * columns)
            .collect()
    }

    /// The columns of `S_i` for some pixels of the field: shifted cut-outs of the PSF. Rows as
    /// in [`Self::indices_of`].
    pub fn columns_of<T: Scalar>(&self, instant: usize, pixels: &[usize]) -> Mat<T> {
        let g = &self.geometry;
        let rows = &self.rows_of[instant];
        let mut columns = Mat::<T>::zeros(rows.len() * g.columns, pixels.len());
        for (&pixel, column) in pixels.iter().zip(columns.col_iter_mut()) {
            let column = column.try_as_col_major_mut().expect("columns are whole");
            let column = column.as_slice_mut();
            let (y, x) = (pixel / g.field_columns, pixel % g.field_columns);
            let first = g.column_displacement(0, x);
            for layer in &self.layers {
                let share = layer.share.as_ref().map_or(1.0, |share| share[pixel]);
                if share == 0.0 {
                    continue;
                }
                let lines = column.chunks_exact_mut(g.columns);
                for (&row, line) in rows.iter().zip(lines) {
                    let values = layer.psf.row_from(g.row_displacement(row, y), first);
                    for (sum, value) in line[values.start..].iter_mut().zip(values.values) {
                        *sum += T::from(share) * T::from(*value);
                    }
                }
            }
        }
        columns
    }
}

impl Layer<f32> {
    /// What a pixel of the field sends to the displacement `(dy, dx)` by this layer.
    fn value(&self, pixel: usize, dy: isize, dx: isize) -> f64 {
        let share = self.share.as_ref().map_or(1.0, |share| share[pixel]);
        f64::from(share) * f64::from(self.psf.at_displacement(dy, dx))
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::camera::CameraParams;
    use crate::linop::LinearOperator;
    use crate::{Camera, Image, Psf, Sensor, Shutter};
    use rand::{RngExt, SeedableRng};

    /// `A P Aᵀ` by operator calls on unit vectors.
    pub fn brute_force(operator: &RollingShutter, support: Option<&Support>) -> Vec<Vec<f32>> {
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

    /// A whole sensor with a bin and an exposure of a row.
    pub fn row_by_row(rows: usize, columns: usize, shutter: Shutter) -> Camera {
        Camera::new(CameraParams {
            rows,
            columns,
            shutter,
            row_time_us: 1.0,
            exposure_us: 1.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap()
    }

    /// The two kinds of products, of a sensor that is read two rows at a time.
    #[test]
    fn products_in_f32_stay_far_below_min_rho() {
        let camera = row_by_row(8, 200, Shutter::DualInsideOut);
        let mut rng = rand_pcg::Pcg64::seed_from_u64(2);
        let values = (0..15 * 399)
            .map(|_| rng.random_range(0.0f32..1.0))
            .collect();
        let psf = Psf::new(Image::new(15, 399, values).unwrap()).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let side = operator.indices_of(1).len();
        let (mut single, mut double) = (Mat::zeros(side, side), Mat::zeros(side, side));
        operator.add_shifted::<f32, f64>(1, &psf, 1.0, single.as_mut());
        operator.add_shifted::<f64, f64>(1, &psf, 1.0, double.as_mut());
        let error = (&single - &double).norm_max() / double[(0, 0)];
        assert!(0.0 < error && error < 0.1 * MIN_RHO.0, "{error}");
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
                    let indices = operator.indices_of(instant);
                    let mut gram = Mat::<f64>::zeros(indices.len(), indices.len());
                    operator.add_gram_block(instant, support, gram.as_mut());
                    for (i, &row) in indices.iter().enumerate() {
                        if support.is_none() {
                            let power = operator.pixel_power(row / columns, row % columns);
                            assert!((power - gram[(i, i)]).abs() < 1e-7);
                        }
                        for (j, &column) in indices.iter().enumerate().skip(i) {
                            let error = (gram[(i, j)] - f64::from(expected[row][column])).abs();
                            assert!(error < 1e-7, "{camera:?} {instant} {i} {j}: {error}");
                        }
                    }
                }
            }
        }
    }
}
