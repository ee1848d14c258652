//! An approximation of `A P Aᵀ` that is banded at each spatial frequency along the rows: its mean field.
//!
//! Under the orthonormal cosine transform `C` along x, `C A Aᵀ Cᵀ` is nearly diagonal in the frequency, since the light
//! of a whole field changes little along a row. The mean field keeps that diagonal alone:
//!
//! ```text
//! M_k[r,r'] = w[r,r'] Σ_y d_r(y) d_r'(y) Σ_ξ h_k(r−y, ξ) h_k(r'−y, ξ),   h_k(d, ξ) = Σ_x C[k,x] p(d, x−ξ),   w = T Tᵀ
//! ```
//!
//! `d_r(y)` is the mean factor of field row `y` in the bins of the instant of row `r`, 1 but for an equilibrated operator. Rows are in the
//! order of their instants. Rows whose instants share no bin have `w = 0`, so each `M_k` is banded, and
//! `(M_k + ρI)⁻¹` costs little (docs/design/025).

use super::RollingShutter;
use rayon::prelude::*;
use rowburst_core::linop::CosineLines;
use rowburst_core::vecmath::simd;
use std::ops::Range;
use std::sync::Arc;

/// Frequencies that are computed side by side, for vector instructions.
const LANES: usize = 16;

/// Field pixels over which the mean of the PSF is taken; fewer make the set-up faster and solves slower.
const SAMPLES: usize = 8192;

/// A value for each of [`LANES`] frequencies.
type Lanes = [f64; LANES];

/// The sums over the field for all pairs of rows in the band; they depend on camera and PSF alone.
pub struct MeanField {
    /// Rows of the frame in the order of their instants.
    frame_rows: Vec<usize>,
    /// The instant of each.
    instants: Vec<usize>,
    /// Rows below the diagonal that the band holds.
    reach: usize,
    columns: usize,
    cosine: CosineLines,
    /// For each group of frequencies `[row][offset]`: the sums for `row` and `row + offset`.
    groups: Vec<Vec<Lanes>>,
}

impl MeanField {
    /// The mean field of an operator.
    pub fn new(shutter: &RollingShutter) -> Self {
        let order: Vec<(usize, usize)> = (0..shutter.sensor_rows_of.len())
            .flat_map(|i| (0..shutter.sensor_rows_of[i].len()).map(move |k| (i, k)))
            .collect();
        let columns = shutter.geometry.columns;
        let cosine = CosineLines::new(columns);
        let sensor_rows: Vec<usize> = order
            .iter()
            .map(|&(i, k)| shutter.sensor_rows_of[i][k])
            .collect();
        let instants: Vec<usize> = order.iter().map(|&(i, _)| i).collect();
        let reach = shutter.reach(&instants);
        let spectra = shutter.spectra(&cosine);
        let groups = (0..columns.div_ceil(LANES)).into_par_iter();
        let rows = RowsOfBand {
            sensor_rows: &sensor_rows,
            instants: &instants,
            reach,
        };
        let groups = groups.map(|group| spectra.band(group, rows));
        Self {
            frame_rows: order
                .iter()
                .map(|&(i, k)| shutter.frame_rows_of[i][k])
                .collect(),
            groups: groups.collect(),
            instants,
            reach,
            columns,
            cosine,
        }
    }
}

impl RollingShutter {
    /// How many rows after a row have an instant that shares a bin with its own, at most.
    fn reach(&self, instants: &[usize]) -> usize {
        let grid = self.time.instants();
        let bins = |i: usize| {
            let run = &grid[instants[i]];
            run.first_bin..run.first_bin + run.weights.len()
        };
        let last = |row: usize| {
            let end = bins(row).end;
            (row..instants.len())
                .rev()
                .find(|&other| bins(other).start < end)
        };
        let reaches = (0..instants.len()).map(|row| last(row).map_or(0, |last| last - row));
        reaches.max().unwrap_or(0)
    }

    /// The cosine transforms of the PSF's rows for some columns of the field.
    fn spectra(&self, cosine: &CosineLines) -> Spectra<'_> {
        let g = &self.geometry;
        let step = (self.video.pixels() / SAMPLES).clamp(1, g.field_columns.div_ceil(4));
        let field_columns: Vec<usize> = (step / 2..g.field_columns).step_by(step).collect();
        let least = g.row_displacement(0, g.field_rows - 1);
        let rows = g.rows + g.field_rows - 1;
        let psfs = self.layers.iter();
        let pairs: Vec<_> = psfs
            .flat_map(|layer| field_columns.iter().map(move |&x| (&layer.psf, x)))
            .collect();
        let groups = g.columns.div_ceil(LANES);
        let lines = pairs.into_par_iter().map(|(psf, field_x)| {
            let first = g.column_displacement(0, field_x);
            let mut lines = vec![0.0; rows * g.columns];
            for (row, line) in lines.chunks_exact_mut(g.columns).enumerate() {
                let values = psf.row_from(least + row as isize, first);
                let covered = line.iter_mut().skip(values.start).zip(values.values);
                covered.for_each(|(to, value)| *to = *value);
            }
            cosine.forward(&mut lines);
            let mut lanes = vec![[0.0f32; LANES]; groups * rows];
            for (row, line) in lines.chunks_exact(g.columns).enumerate() {
                for (group, part) in line.chunks(LANES).enumerate() {
                    lanes[group * rows + row][..part.len()].copy_from_slice(part);
                }
            }
            lanes
        });
        Spectra {
            shutter: self,
            lines: lines.collect(),
            field_columns,
            rows,
        }
    }
}

/// `h_k(d, ξ)` for each layer and some field columns `ξ`.
struct Spectra<'a> {
    shutter: &'a RollingShutter,
    /// For each layer and field column `[group][d]`.
    lines: Vec<Vec<[f32; LANES]>>,
    field_columns: Vec<usize>,
    /// Number of row displacements `d`.
    rows: usize,
}

/// The rows of the frame in the order of their instants.
#[derive(Clone, Copy)]
struct RowsOfBand<'a> {
    sensor_rows: &'a [usize],
    instants: &'a [usize],
    /// See [`MeanField`].
    reach: usize,
}

impl Spectra<'_> {
    /// The sums for a group of frequencies, `[row][offset]`.
    fn band(&self, group: usize, rows: RowsOfBand) -> Vec<Lanes> {
        let RowsOfBand {
            sensor_rows, reach, ..
        } = rows;
        let g = &self.shutter.geometry;
        let mut sums = vec![[0.0; LANES]; sensor_rows.len() * (reach + 1)];
        let part = group * self.rows..(group + 1) * self.rows;
        // The row displacement of field row `y` is the last one minus `y`.
        let last = |r: usize| r + g.field_rows - 1;
        if let [layer] = self.shutter.layers.as_slice()
            && layer.share.is_none()
        {
            for lines in &self.lines {
                let lines = &lines[part.clone()];
                let at = |r: usize, y: usize| &lines[last(sensor_rows[r]) - y];
                self.add_products(&mut sums, rows, at);
            }
        } else {
            for (i, &field_x) in self.field_columns.iter().enumerate() {
                let mixed = self.mixed(i, field_x, part.clone(), sensor_rows);
                let at = |r: usize, y: usize| &mixed[r * g.field_rows + y];
                self.add_products(&mut sums, rows, at);
            }
        }
        let sampled = g.field_columns as f64 / self.field_columns.len() as f64;
        let sums_of_all = sums.iter_mut().flatten();
        sums_of_all.for_each(|sum| *sum *= sampled);
        sums
    }

    /// `h_k(r−y, ξ)` of a PSF that changes over the field, for field column number `i` at `field_x`; `[row][y]`.
    fn mixed(
        &self,
        i: usize,
        field_x: usize,
        part: Range<usize>,
        sensor_rows: &[usize],
    ) -> Vec<[f32; LANES]> {
        let g = &self.shutter.geometry;
        let mut mixed = vec![[0.0; LANES]; sensor_rows.len() * g.field_rows];
        for (l, layer) in self.shutter.layers.iter().enumerate() {
            let lines = &self.lines[l * self.field_columns.len() + i][part.clone()];
            for (to, &r) in mixed.chunks_exact_mut(g.field_rows).zip(sensor_rows) {
                for (y, to) in to.iter_mut().enumerate() {
                    let pixel = y * g.field_columns + field_x;
                    let share = layer.share.as_ref().map_or(1.0, |share| share[pixel]);
                    let line = &lines[r + g.field_rows - 1 - y];
                    to.iter_mut().zip(line).for_each(|(t, v)| *t += share * v);
                }
            }
        }
        mixed
    }
}

impl Spectra<'_> {
    /// `sums[r][o] += Σ_y d_r(y) d_{r+o}(y) at(r, y) at(r + o, y)` in each lane.
    fn add_products<'a>(
        &self,
        sums: &mut [Lanes],
        rows: RowsOfBand,
        at: impl Fn(usize, usize) -> &'a [f32; LANES],
    ) {
        let (shutter, field_rows) = (self.shutter, self.shutter.geometry.field_rows);
        if shutter.is_equilibrated() {
            let scale = |r: usize, y: usize| shutter.mean_row_scale(rows.instants[r], y);
            add_products(sums, rows, field_rows, at, scale);
        } else {
            add_products(sums, rows, field_rows, at, |_, _| 1.0);
        }
    }
}

/// `sums[r][o] += Σ_y scale(r, y) scale(r + o, y) at(r, y) at(r + o, y)` in each lane.
fn add_products<'a>(
    sums: &mut [Lanes],
    rows: RowsOfBand,
    field_rows: usize,
    at: impl Fn(usize, usize) -> &'a [f32; LANES],
    scale: impl Fn(usize, usize) -> f32,
) {
    let (reach, rows) = (rows.reach, rows.sensor_rows.len());
    for r in 0..rows {
        for o in 0..=reach.min(rows - 1 - r) {
            let sum = simd(
                #[inline(always)]
                || {
                    let mut sum = [0.0f32; LANES];
                    for y in 0..field_rows {
                        let (a, b) = (at(r, y), at(r + o, y));
                        let scale = scale(r, y) * scale(r + o, y);
                        for k in 0..LANES {
                            sum[k] += scale * a[k] * b[k];
                        }
                    }
                    sum
                },
            );
            let total = &mut sums[r * (reach + 1) + o];
            for k in 0..LANES {
                total[k] += f64::from(sum[k]);
            }
        }
    }
}

/// The mean field of a weighted operator on a support, with the factors of `M_k + ρI` for the last `ρ`.
pub struct MeanFieldSolver {
    field: Arc<MeanField>,
    /// `w` times the weights of both rows, `[row][offset]`.
    coupling: Vec<f64>,
    /// Factors as [`MeanField::groups`]; the diagonal holds inverses.
    factors: Vec<Vec<Lanes>>,
    rho: Option<f64>,
}

impl MeanFieldSolver {
    /// For videos whose bin `t` has the part `fractions[t]` of its voxels active, and rows of the frame with the
    /// weights `row_weights`.
    pub fn new(
        field: Arc<MeanField>,
        shutter: &RollingShutter,
        fractions: &[f64],
        row_weights: &[f64],
    ) -> Self {
        let grid = shutter.time.instants();
        let (rows, width) = (field.instants.len(), field.reach + 1);
        let mut coupling = vec![0.0; rows * width];
        for r in 0..rows {
            for o in 0..width.min(rows - r) {
                let (a, b) = (&grid[field.instants[r]], &grid[field.instants[r + o]]);
                let shared = |(k, weight): (usize, &f64)| {
                    let bin = a.first_bin + k;
                    let other = bin.checked_sub(b.first_bin)?;
                    Some(weight * b.weights.get(other)? * fractions[bin])
                };
                let sum: f64 = a.weights.iter().enumerate().filter_map(shared).sum();
                let weights =
                    row_weights[field.frame_rows[r]] * row_weights[field.frame_rows[r + o]];
                coupling[r * width + o] = weights * sum;
            }
        }
        Self {
            field,
            coupling,
            factors: Vec::new(),
            rho: None,
        }
    }

    /// Writes the mean field's `(A P Aᵀ + ρI)⁻¹ r` to `out`.
    pub fn solve(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        if self.rho != Some(rho) {
            self.factorise(rho);
        }
        let field = &*self.field;
        let (rows, columns) = (field.frame_rows.len(), field.columns);
        let mut lines: Vec<f32> = Vec::with_capacity(rows * columns);
        for &row in &field.frame_rows {
            lines.extend_from_slice(&r[row * columns..(row + 1) * columns]);
        }
        field.cosine.forward(&mut lines);
        let groups = self.factors.par_iter().enumerate();
        let solved: Vec<Vec<Lanes>> = groups
            .map(|(group, factor)| {
                let first = group * LANES;
                let count = LANES.min(columns - first);
                let mut values = vec![[0.0; LANES]; rows];
                for (value, line) in values.iter_mut().zip(lines.chunks_exact(columns)) {
                    for (v, l) in value[..count].iter_mut().zip(&line[first..]) {
                        *v = f64::from(*l);
                    }
                }
                solve_band(factor, field.reach, &mut values);
                values
            })
            .collect();
        for (group, values) in solved.iter().enumerate() {
            let first = group * LANES;
            let count = LANES.min(columns - first);
            for (value, line) in values.iter().zip(lines.chunks_exact_mut(columns)) {
                for (v, l) in value[..count].iter().zip(&mut line[first..]) {
                    *l = *v as f32;
                }
            }
        }
        field.cosine.inverse(&mut lines);
        for (&row, line) in field.frame_rows.iter().zip(lines.chunks_exact(columns)) {
            out[row * columns..(row + 1) * columns].copy_from_slice(line);
        }
    }

    fn factorise(&mut self, rho: f64) {
        let (reach, coupling) = (self.field.reach, &self.coupling);
        let groups = self.field.groups.par_iter();
        let factors = groups.map(|sums| {
            let weighted = sums.iter().zip(coupling);
            let mut band: Vec<Lanes> = weighted.map(|(s, w)| s.map(|s| s * w)).collect();
            for diagonal in band.iter_mut().step_by(reach + 1) {
                diagonal.iter_mut().for_each(|d| *d += rho);
            }
            factorise_band(&mut band, reach, rho);
            band
        });
        self.factors = factors.collect();
        self.rho = Some(rho);
    }
}

/// Replaces a band matrix by its Cholesky factor `L`, in each lane; the diagonal becomes its inverses.
///
/// `band[r][o]` is the element at row `r + o` and column `r`. A pivot below half of `rho` is wrong by rounding and is
/// replaced by `rho`.
fn factorise_band(band: &mut [Lanes], reach: usize, rho: f64) {
    let width = reach + 1;
    let rows = band.len() / width;
    simd(
        #[inline(always)]
        || {
            for r in 0..rows {
                let (column, rest) = band[r * width..].split_at_mut(width);
                for pivot in &mut column[0] {
                    let safe = if *pivot > 0.5 * rho { *pivot } else { rho };
                    *pivot = 1.0 / safe.sqrt();
                }
                let inverse = column[0];
                let below = reach.min(rows - 1 - r);
                for value in &mut column[1..=below] {
                    for k in 0..LANES {
                        value[k] *= inverse[k];
                    }
                }
                for a in 1..=below {
                    for b in a..=below {
                        let to = &mut rest[(a - 1) * width + b - a];
                        for k in 0..LANES {
                            to[k] -= column[a][k] * column[b][k];
                        }
                    }
                }
            }
        },
    );
}

/// Replaces `values[row]` by `(L Lᵀ)⁻¹ values`, in each lane.
fn solve_band(factor: &[Lanes], reach: usize, values: &mut [Lanes]) {
    let width = reach + 1;
    let rows = values.len();
    simd(
        #[inline(always)]
        || {
            for r in 0..rows {
                let column = &factor[r * width..(r + 1) * width];
                let (current, rest) = values[r..].split_first_mut().expect("r is a row");
                for k in 0..LANES {
                    current[k] *= column[0][k];
                }
                for (to, value) in rest.iter_mut().zip(&column[1..]) {
                    for k in 0..LANES {
                        to[k] -= value[k] * current[k];
                    }
                }
            }
            for r in (0..rows).rev() {
                let column = &factor[r * width..(r + 1) * width];
                let (current, rest) = values[r..].split_first_mut().expect("r is a row");
                for (from, value) in rest.iter().zip(&column[1..]) {
                    for k in 0..LANES {
                        current[k] -= value[k] * from[k];
                    }
                }
                for k in 0..LANES {
                    current[k] *= column[0][k];
                }
            }
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraParams;
    use crate::forward::gram::tests::brute_force;
    use crate::{Camera, Image, PatchSet, Psf, Sensor, Shutter};
    use faer::linalg::solvers::Solve;
    use faer::{Col, Mat, Side};
    use rand::{RngExt, SeedableRng};

    fn psf(seed: u64) -> Psf {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let values = (0..17 * 21).map(|_| rng.random_range(0.0f32..1.0));
        Psf::new(Image::new(17, 21, values.collect()).unwrap()).unwrap()
    }

    fn cameras() -> impl Iterator<Item = Camera> {
        let cases = [
            (Shutter::DualInsideOut, 2.5, None),
            (Shutter::DualOutsideIn, 1.0, Some((9, 13))),
            (Shutter::TopDown, 6.0, Some((8, 12))),
        ];
        cases.into_iter().map(|(shutter, exposure_us, field)| {
            Camera::new(CameraParams {
                rows: 8,
                columns: 10,
                shutter,
                row_time_us: 1.0,
                exposure_us,
                bins_per_row: 1,
                field,
                sensor: Sensor::default(),
            })
            .unwrap()
        })
    }

    /// The mean field is the part of `C A Aᵀ Cᵀ` that does not mix frequencies; its solve is that of the whole matrix.
    #[test]
    fn keeps_what_does_not_mix_frequencies() {
        let several = || PatchSet::new(vec![psf(1), psf(2)], vec![(0.0, -3.0), (0.0, 3.0)]);
        let sets = || [PatchSet::from(&psf(1)), several().unwrap()];
        let operators = cameras().flat_map(|c| sets().map(|psfs| RollingShutter::new(&c, psfs)));
        // One bin for each instant, so that the mean factor of its bins is theirs.
        let values = psf(3).image().data().to_vec();
        let narrow = values.iter().enumerate();
        let narrow = narrow.map(|(i, v)| v * 0.1f32.powi((i as i32 / 21 - 8).abs() / 2));
        let narrow = Psf::new(Image::new(17, 21, narrow.collect()).unwrap()).unwrap();
        let camera = crate::forward::gram::tests::row_by_row(8, 10, Shutter::DualInsideOut);
        let equilibrated = RollingShutter::new(&camera, &narrow).equilibrated();
        for operator in operators.chain([equilibrated.expect("rows are seen weakly")]) {
            let gram = brute_force(&operator, None);
            let field = Arc::new(MeanField::new(&operator));
            let (rows, columns) = operator.frame_shape();
            let fractions = vec![1.0; operator.video_shape().bins];
            let row_weights = vec![1.0; rows];
            let mut solver = MeanFieldSolver::new(field, &operator, &fractions, &row_weights);
            let cosine = CosineLines::new(columns);
            let unit = |k: usize| {
                let mut line = vec![0.0; columns];
                line[k] = 1.0;
                cosine.inverse(&mut line);
                line
            };
            for k in [0, 1, columns - 1] {
                let wave = unit(k);
                // The elements of frequency `k`, for each pair of rows.
                let kept = Mat::<f64>::from_fn(rows, rows, |a, b| {
                    let of = |x: usize, x2: usize| {
                        f64::from(wave[x] * wave[x2] * gram[a * columns + x][b * columns + x2])
                    };
                    (0..columns)
                        .flat_map(|x| (0..columns).map(move |x2| (x, x2)))
                        .map(|(x, x2)| of(x, x2))
                        .sum()
                });
                for rho in [0.1 * kept[(0, 0)], kept[(0, 0)]] {
                    let whole = &kept + Mat::<f64>::identity(rows, rows) * faer::Scale(rho);
                    let right = Col::<f64>::from_fn(rows, |r| (r as f64 * 1.1).sin() + 0.3);
                    let expected = whole.llt(Side::Lower).unwrap().solve(&right);
                    let r: Vec<f32> = (0..rows)
                        .flat_map(|row| wave.iter().map(move |v| (row, *v)))
                        .map(|(row, v)| right[row] as f32 * v)
                        .collect();
                    let mut out = vec![f32::NAN; r.len()];
                    solver.solve(&r, rho, &mut out);
                    for (row, line) in out.chunks_exact(columns).enumerate() {
                        for (value, v) in line.iter().zip(&wave) {
                            let error = (f64::from(*value) - expected[row] * f64::from(*v)).abs();
                            assert!(error < 1e-4 * expected.norm_max(), "{k}: {error}");
                        }
                    }
                }
            }
        }
    }
}
