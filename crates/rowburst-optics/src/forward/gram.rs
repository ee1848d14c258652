//! The Gram matrix of one instant, `G_i = S_i S_iᵀ`, without operator calls.
//!
//! ```text
//! G[(a,x),(b,x')] = Σ_y d(y)² Σ_ξ p_a(y, x−ξ) p_b(y, x'−ξ)
//! ```
//!
//! `p_a(y, ·)` is the PSF from field row `y` to row `a` of the instant, and `d(y)` the factor of the row, 1 but for an
//! equilibrated operator. Moving both
//! columns `x`, `x'` by one shifts the sum over the field columns `ξ` by one. So a step along a diagonal of a block
//! adds the products of the PSF column that enters the sum and subtracts those of the column that leaves it: two
//! matrix products and a running sum (docs/design/003).
//!
//! A PSF that changes over the field has no such diagonals. Then the columns of `S_i` are formed in batches and
//! multiplied (docs/design/002).

use super::{Layer, RollingShutter};
use crate::Psf;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::mat::AsMatMut;
use faer::reborrow::ReborrowMut;
use faer::{Accum, Mat, MatMut, Par};
use rowburst_core::Support;
use rowburst_core::fft::{FftNumber, smooth_even_length};
use rowburst_core::linop::Scalar;
use rustfft::num_complex::Complex64;

/// Columns of `S_i` held at once; larger takes more memory (docs/design/002).
const COLUMNS_PER_BATCH: usize = 128;

/// Sensor columns from which blocks are built in f32; smaller is faster and limits `ρ` sooner (docs/design/003).
const SINGLE_FROM: usize = 1024;

/// Smallest `ρ` over a diagonal element where blocks are built in f32; smaller solves lose their digits
/// (docs/design/003).
const MIN_RHO_SINGLE: f64 = 1e-5;

/// The same where blocks are built in f64.
const MIN_RHO_DOUBLE: f64 = 1e-9;

/// Largest size in bytes that a block's element has on a sensor with `columns` columns.
pub fn element_bytes(columns: usize) -> usize {
    if columns >= SINGLE_FROM {
        size_of::<f32>()
    } else {
        size_of::<f64>()
    }
}

/// What one or more bins of an instant add to its block.
#[derive(Clone, Copy)]
struct BinPart<'a> {
    /// Sum of the squared weights of the bins.
    weight: f64,
    /// Factors of the field rows; `None`: all 1.
    row_scales: Option<&'a [f32]>,
}

impl BinPart<'_> {
    fn of_weight(weight: f64) -> Self {
        Self {
            weight,
            row_scales: None,
        }
    }

    fn row_scale(&self, y: usize) -> f32 {
        self.row_scales.map_or(1.0, |scales| scales[y])
    }
}

impl RollingShutter {
    /// The upper triangle of `sum += weight · S_i D² S_iᵀ` for instant `i`.
    ///
    /// Column `x` of the instant's `a`-th row has the index `a · columns + x`. The cost is about
    /// `(rows·columns)² · field_rows` multiply–adds, with the number of rows of this instant. They are in f32 from
    /// [`SINGLE_FROM`] sensor columns on.
    fn add_unrestricted_gram<S: Scalar>(&self, instant: usize, part: BinPart, sum: MatMut<S>) {
        match self.layers.as_slice() {
            [
                Layer {
                    psf, share: None, ..
                },
            ] if self.geometry.columns >= SINGLE_FROM => {
                self.add_gram_by_diagonals::<f32, S>(instant, psf, part, sum);
            }
            [
                Layer {
                    psf, share: None, ..
                },
            ] => self.add_gram_by_diagonals::<f64, S>(instant, psf, part, sum),
            _ => {
                let pixels: Vec<usize> = (0..self.video.pixels()).collect();
                self.add_gram_of_pixels(instant, &pixels, part, sum);
            }
        }
    }

    /// The same for one PSF. The products of the PSF columns that enter and leave the sum are computed in `T`.
    fn add_gram_by_diagonals<T: Scalar, S: Scalar>(
        &self,
        instant: usize,
        psf: &Psf,
        part: BinPart,
        mut sum: MatMut<S>,
    ) {
        let g = &self.geometry;
        let rows = &self.sensor_rows_of[instant];
        let columns = g.columns;
        // `[x, y]`: PSF values from the field column that enters to sensor row `r`; beside them, times `sign`, those
        // from the field column that leaves.
        let strips = |r: usize, sign: f32| {
            let mut strips = Mat::<T>::zeros(columns, 2 * g.field_rows);
            let sides = [(1, 0, 1.0), (0, g.field_columns - 1, sign)];
            for (side, (x0, field_x, factor)) in sides.into_iter().enumerate() {
                let dx = g.column_displacement(x0, field_x);
                for y in 0..g.field_rows {
                    let values = psf.row_from(g.row_displacement(r, y), dx);
                    let line = strips.col_as_slice_mut(side * g.field_rows + y);
                    let line = line.iter_mut().skip(values.start).zip(values.values);
                    let factor = factor * part.row_scale(y);
                    line.for_each(|(to, value)| *to = T::from(factor * *value));
                }
            }
            strips
        };
        let edges = self.first_columns(instant, psf, part);
        let strips: Vec<_> = rows
            .iter()
            .map(|&r| (strips(r, 1.0), strips(r, -1.0)))
            .collect();
        let mut steps = Mat::<T>::zeros(columns, columns);
        for (a, b) in (0..rows.len()).flat_map(|a| (a..rows.len()).map(move |b| (a, b))) {
            let structure = if a == b { UPPER } else { WHOLE };
            multiply(
                &mut steps,
                structure,
                Accum::Replace,
                &strips[a].0,
                &strips[b].1,
                T::one(),
            );
            let edge = |a: usize, b: usize| &edges[(a * rows.len() + b) * columns..][..columns];
            // `[x]`: a column of the block of rows `a` and `b`, updated from one column to the next.
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
                pairs.for_each(|(sum, value)| *sum += S::nearest(part.weight * value));
            }
        }
    }

    /// `G[(a,0),(b,x')]`, at index `(a · rows + b) · columns + x'` with the number of rows of the instant.
    fn first_columns(&self, instant: usize, psf: &Psf, part: BinPart) -> Vec<f64> {
        let g = &self.geometry;
        let rows = &self.sensor_rows_of[instant];
        let mut edges = vec![0.0; rows.len() * rows.len() * g.columns];
        // One line per PSF row holds the column displacements of all pairs (x, ξ).
        let first = g.column_displacement(0, g.field_columns - 1);
        let width = g.columns + g.field_columns - 1;
        let line = |r: usize, y: usize| -> Vec<f64> {
            let dy = g.row_displacement(r, y);
            let scale = f64::from(part.row_scale(y));
            (0..width)
                .map(|i| scale * f64::from(psf.at_displacement(dy, first + i as isize)))
                .collect()
        };
        // The sums Σ_ξ a[ξ] b[x + ξ] are correlations. Their spectra are added over the field rows and inverted once.
        // The lags that are kept reach no further than `width`, so nothing wraps around.
        let length = smooth_even_length(width);
        let (forward, inverse) = f64::real_transforms(length);
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
            // The zero and the highest frequency of a real signal are real; rounding errors are removed.
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

/// Adds `weight · a bᵀ` to the `part` of `to`, or replaces it, as `accum` says.
fn multiply<T: Scalar>(
    to: impl AsMatMut<T = T, Rows = usize, Cols = usize>,
    part: BlockStructure,
    accum: Accum,
    a: &Mat<T>,
    b: &Mat<T>,
    weight: T,
) {
    let b = b.transpose();
    triangular::matmul(to, part, accum, a, WHOLE, b, WHOLE, weight, Par::Seq);
}

impl RollingShutter {
    /// Smallest `ρ`, over a typical diagonal element of `G`, at which `(G + ρI)⁻¹` is numerically stable.
    pub fn min_rho(&self) -> f64 {
        if self.geometry.columns >= SINGLE_FROM {
            MIN_RHO_SINGLE
        } else {
            MIN_RHO_DOUBLE
        }
    }

    /// The upper triangle of `sum += weight · S_i D P D S_iᵀ`, with `P` the projection onto `pixels`.
    fn add_gram_of_pixels<T: Scalar>(
        &self,
        instant: usize,
        pixels: &[usize],
        part: BinPart,
        mut sum: MatMut<T>,
    ) {
        let weight = T::nearest(part.weight);
        // In batches, since all columns of a dense bin take the memory of several videos.
        for pixels in pixels.chunks(COLUMNS_PER_BATCH) {
            let mut a = columns_of(self, instant, pixels);
            if part.row_scales.is_some() {
                for (&pixel, mut column) in pixels.iter().zip(a.col_iter_mut()) {
                    column *= faer::Scale(T::from(part.row_scale(pixel / self.video.columns)));
                }
            }
            multiply(sum.rb_mut(), UPPER, Accum::Add, &a, &a, weight);
        }
    }

    /// The diagonal element of `A Aᵀ` at the sensor pixel `(row, column)`.
    ///
    /// # Panics
    /// If no instant reads `row`.
    pub fn pixel_power(&self, row: usize, column: usize) -> f64 {
        let g = &self.geometry;
        let sees = |rows: &Vec<usize>| rows.contains(&row);
        let instant = self
            .sensor_rows_of
            .iter()
            .position(sees)
            .expect("every row is read");
        let run = &self.time.instants()[instant];
        let exposure: f64 = run.weights.iter().map(|w| w * w).sum();
        let scale_of = |y: usize| {
            let of_bin = |(k, weight): (usize, &f64)| {
                (weight * f64::from(self.row_scale(run.first_bin + k, y))).powi(2)
            };
            run.weights.iter().enumerate().map(of_bin).sum::<f64>() / exposure
        };
        let mut power = 0.0;
        for y in 0..g.field_rows {
            let (dy, scale) = (g.row_displacement(row, y), scale_of(y));
            for x in 0..g.field_columns {
                let (pixel, dx) = (y * g.field_columns + x, g.column_displacement(column, x));
                let shares = self.layers.iter().map(|layer| layer.value(pixel, dy, dx));
                power += scale * shares.sum::<f64>().powi(2);
            }
        }
        exposure * power
    }

    /// Frame indices of the pixels in the rows of instant `i`, in the order of its block.
    pub fn indices_of(&self, instant: usize) -> Vec<usize> {
        let columns = self.geometry.columns;
        let frame_rows = self.frame_rows_of[instant].iter();
        frame_rows
            .flat_map(|&row| row * columns..(row + 1) * columns)
            .collect()
    }
}

impl Layer<f32> {
    /// Light from the field pixel `pixel` at the displacement `(dy, dx)` in this layer.
    fn value(&self, pixel: usize, dy: isize, dx: isize) -> f64 {
        let share = self.share.as_ref().map_or(1.0, |share| share[pixel]);
        f64::from(share) * f64::from(self.psf.at_displacement(dy, dx))
    }
}

/// Whether the sums of a block are f64, also where the block is then rounded to f32 for the solve.
pub fn builds_in_f64(shutter: &RollingShutter) -> bool {
    shutter.geometry.columns < SINGLE_FROM || shutter.layers.len() > 1
}

/// Adds to `sum` the diagonal block of `A P Aᵀ` for the rows of instant `i`.
///
/// `P` projects onto `support` (`None`: every voxel). Row and column indices of the block are those of
/// [`RollingShutter::indices_of`]. The block is symmetric; only its upper triangle, with the diagonal, is written.
///
/// Where no bin is seen by two instants, `A P Aᵀ` has no elements outside these blocks.
pub fn add_gram_block<T: Scalar>(
    shutter: &RollingShutter,
    instant: usize,
    support: Option<&Support>,
    mut sum: MatMut<T>,
) {
    let bins = &shutter.time.instants()[instant];
    let mut unrestricted_weight = 0.0;
    for (k, weight) in bins.weights.iter().enumerate() {
        let bin = bins.first_bin + k;
        let part = BinPart {
            weight: weight * weight,
            row_scales: shutter.row_scales_of(bin),
        };
        match support.and_then(|s| s.pixels_of(bin)) {
            None if part.row_scales.is_none() => unrestricted_weight += part.weight,
            None => shutter.add_unrestricted_gram(instant, part, sum.rb_mut()),
            Some(pixels) => shutter.add_gram_of_pixels(instant, &pixels, part, sum.rb_mut()),
        }
    }
    if unrestricted_weight > 0.0 {
        shutter.add_unrestricted_gram(instant, BinPart::of_weight(unrestricted_weight), sum);
    }
}

/// The columns of `A` of the active voxels in `support`, for the rows of instant `i`: the matrix `B` whose `B Bᵀ`
/// is the block of [`add_gram_block`].
///
/// Returns `None` if a bin is unrestricted or if there are more than `max_columns` columns.
pub fn active_columns<T: Scalar>(
    shutter: &RollingShutter,
    instant: usize,
    support: &Support,
    max_columns: usize,
) -> Option<Mat<T>> {
    let run = &shutter.time.instants()[instant];
    let bins = run.first_bin..run.first_bin + run.weights.len();
    let active: Option<Vec<Vec<usize>>> = bins.map(|bin| support.pixels_of(bin)).collect();
    let active =
        active.filter(|active| active.iter().map(Vec::len).sum::<usize>() <= max_columns)?;
    let all: Vec<usize> = active.concat();
    let mut columns = columns_of(shutter, instant, &all);
    let bins = active.iter().zip(&run.weights).enumerate();
    let weights = bins.flat_map(|(k, (active, weight))| {
        let row_scale = move |pixel: &usize| {
            shutter.row_scale(run.first_bin + k, pixel / shutter.video.columns)
        };
        let scales = active.iter().map(row_scale);
        scales.map(move |scale| *weight * f64::from(scale))
    });
    for (mut column, weight) in columns.col_iter_mut().zip(weights) {
        column *= faer::Scale(T::nearest(weight));
    }
    Some(columns)
}

/// The columns of `S_i` for the field pixels `pixels`: shifted cut-outs of the PSF.
///
/// The matrix has one row for each index of [`RollingShutter::indices_of`].
pub fn columns_of<T: Scalar>(shutter: &RollingShutter, instant: usize, pixels: &[usize]) -> Mat<T> {
    let g = &shutter.geometry;
    let rows = &shutter.sensor_rows_of[instant];
    let mut columns = Mat::<T>::zeros(rows.len() * g.columns, pixels.len());
    for (&pixel, column) in pixels.iter().zip(columns.col_iter_mut()) {
        let column = column.try_as_col_major_mut().expect("columns are whole");
        let column = column.as_slice_mut();
        let (y, x) = (pixel / g.field_columns, pixel % g.field_columns);
        let first = g.column_displacement(0, x);
        for layer in shutter.layers.iter() {
            let share: f32 = layer.share.as_ref().map_or(1.0, |share| share[pixel]);
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

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::camera::CameraParams;
    use crate::{Camera, Image, Psf, Sensor, Shutter};
    use rand::{RngExt, SeedableRng};
    use rowburst_core::linop::LinearOperator;

    /// `A P Aᵀ` by operator calls on unit vectors.
    pub fn brute_force(operator: &RollingShutter, support: Option<&Support>) -> Vec<Vec<f32>> {
        (0..operator.range_len())
            .map(|i| {
                let mut unit = vec![0.0; operator.range_len()];
                unit[i] = 1.0;
                let mut video = vec![0.0; operator.domain_len()];
                operator.adjoint(&unit, &mut video);
                if let Some(support) = support {
                    support.zero_outside(&mut video);
                }
                operator.apply(&video, &mut unit);
                unit
            })
            .collect()
    }

    /// A camera with one bin per row and an exposure of one row.
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

    /// Products in f32 and in f64 on a sensor that reads two rows at a time.
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
        operator.add_gram_by_diagonals::<f32, f64>(
            1,
            &psf,
            BinPart::of_weight(1.0),
            single.as_mut(),
        );
        operator.add_gram_by_diagonals::<f64, f64>(
            1,
            &psf,
            BinPart::of_weight(1.0),
            double.as_mut(),
        );
        let error = (&single - &double).norm_max() / double[(0, 0)];
        assert!(0.0 < error && error < 0.1 * MIN_RHO_SINGLE, "{error}");
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
            // Bin 0 is unrestricted; the others have too few active voxels to be.
            let mut thresholds = vec![0.97; shape.bins];
            thresholds[0] = 0.0;
            let some = Support::above(&video, shape, &thresholds);
            for support in [None, Some(&some)] {
                let expected = brute_force(&operator, support);
                for instant in 0..operator.rows_of_instants().len() {
                    let indices = operator.indices_of(instant);
                    let mut gram = Mat::<f64>::zeros(indices.len(), indices.len());
                    add_gram_block(&operator, instant, support, gram.as_mut());
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
