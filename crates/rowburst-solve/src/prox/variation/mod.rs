//! Isotropic spatial total variation, temporal differences and ℓ1, with `v ≥ 0`.
//!
//! ```text
//! R(v) = w_s Σ √((∂y v)² + (∂x v)²) + w_t Σ |∂t v| + w_1 Σ |v|
//! ```
//!
//! The differences `D` are forward differences, zero at the last row, column and bin (Neumann boundary).
//!
//! The prox of `s·R` is solved in the dual (Chambolle 2004; Beck & Teboulle 2009). The dual `p` lies in balls of
//! radius `s·w_s` for each pixel in space and `s·w_t` over time. Its primal point is
//! `z(p) = max(0, q − s·w_1 − Dᵀp)`. It takes projected gradient steps `p ← P(p + step·D z(p))`, and it is kept from
//! call to call. An outer solver changes `q` little between calls. Two plain steps per call are then as good as five
//! accelerated ones, and need no momentum arrays (docs/design/012).
//!
//! All steps of a call share one pass of the video through memory (`wavefront.rs`, docs/design/013).

mod bin;
mod wavefront;

use super::Prox;
use super::rows::Rows;
use bin::{Bin, Dual, DualOrZeros, Duals, Space, StepFactor, Time, add_row, unit};
use rayon::prelude::*;
use rowburst_core::vecmath::{simd, zeros};
use rowburst_core::{Shape, Support};
use std::mem::take;
use std::ops::Range;
use wavefront::{BinView, Previous, SpatialDuals, Stencil, Tile, Wavefront};

/// Dual steps of a sweep, and by default of a call; one takes more iterations in all, three take more time
/// (docs/design/012).
const STEPS_PER_SWEEP: usize = 2;

/// Fewest dual steps of a call that is refined, see [`Prox::set_refined`]; fewer make LEDs take more iterations, more cost time
/// (docs/design/033).
pub(super) const REFINED_STEPS: usize = 6;

/// Length of a dual step over `1/‖D‖²`; larger is faster but must stay below 2 to converge.
const RELATIVE_STEP_LENGTH: f32 = 1.9;

/// Pixels of a strip; larger leaves the nearest cache, smaller wastes vector lanes (docs/design/013).
const PIXELS_PER_STRIP: usize = 12288;

/// The weights of the three parts of [`Variation`]; a part with weight 0 is absent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VariationWeights {
    /// `w_s`: isotropic total variation in space.
    pub space: f64,
    /// `w_t`: absolute differences from bin to bin.
    pub time: f64,
    /// `w_1`: absolute values.
    pub l1: f64,
}

impl VariationWeights {
    /// All parts are absent.
    pub const NONE: Self = Self {
        space: 0.0,
        time: 0.0,
        l1: 0.0,
    };
}

/// The prior `R` over videos of one shape; see the [module](self).
#[derive(Clone)]
pub struct Variation {
    shape: Shape,
    weights: VariationWeights,
    /// Dual steps of a call.
    steps_per_call: usize,
    /// See [`Prox::set_refined`].
    is_refined: bool,
    dual_y: Vec<Dual>,
    dual_x: Vec<Dual>,
    dual_t: Vec<Dual>,
    /// `s` of the last call. The duals are stored as fractions of their radii `s·w`.
    scale: f64,
    support: Option<Support>,
    rows: Rows,
    /// See [`bin::x_weights`].
    x_weights: Vec<f32>,
}

impl Variation {
    /// The prior with all duals at zero.
    pub fn new(shape: Shape, weights: VariationWeights) -> Self {
        let space = if weights.space > 0.0 {
            shape.voxels()
        } else {
            0
        };
        let time = if weights.time > 0.0 {
            shape.voxels()
        } else {
            0
        };
        Self {
            shape,
            weights,
            steps_per_call: STEPS_PER_SWEEP,
            is_refined: false,
            dual_y: zeros(space),
            dual_x: zeros(space),
            dual_t: zeros(time),
            scale: 0.0,
            support: None,
            rows: Rows::all(shape),
            x_weights: bin::x_weights(shape.columns),
        }
    }

    /// The same with `steps` dual steps a call. A prox outside an outer solver needs more than the default; the tests
    /// take 3000.
    #[must_use]
    pub fn with_steps(mut self, steps: usize) -> Self {
        self.steps_per_call = steps;
        self
    }

    pub(super) fn set_scale(&mut self, scale: f64) {
        self.scale = scale;
    }

    /// Computes `z(p)`, the primal point of the dual.
    pub(super) fn primal(&self, q: &[f32], scale: f64, z: &mut [f32]) {
        let pixels = self.shape.pixels();
        let bins = z.par_chunks_exact_mut(pixels).enumerate();
        bins.for_each(|(t, z)| {
            let q = &q[t * pixels..(t + 1) * pixels];
            self.bin(t, scale).write(z, q, self.duals(t));
        });
    }

    /// Takes `steps` dual steps. If `writes_primal`, `z` is the primal point after them; else its content is
    /// unspecified.
    fn sweep(&mut self, q: &[f32], scale: f64, z: &mut [f32], steps: usize, writes_primal: bool) {
        let mut duals = self.take_duals();
        let has_time = !duals[2].is_empty();
        let wavefront = Wavefront {
            shape: self.shape,
            rows_per_strip: (PIXELS_PER_STRIP / self.shape.columns).clamp(1, self.shape.rows),
            last_level: steps,
            is_coupled: has_time,
        };
        let stencil = DualSteps {
            prior: self,
            scale,
            length: RELATIVE_STEP_LENGTH / norm_squared(!duals[0].is_empty(), has_time) as f32,
            last_level: steps,
            writes_primal,
        };
        wavefront.run(q, z, &mut duals, &stencil);
        [self.dual_y, self.dual_x, self.dual_t] = duals;
    }

    fn bin(&self, t: usize, scale: f64) -> Bin<'_> {
        let pixels = self.shape.pixels();
        let mask = self.support.as_ref().map(Support::mask);
        let (in_space, over_time) = self.radii(scale);
        Bin {
            columns: self.shape.columns,
            rows: self.rows.active(t),
            shrink: (scale * self.weights.l1) as f32,
            units: (unit(in_space), unit(over_time)),
            mask: mask.map(|mask| &mask[t * pixels..(t + 1) * pixels]),
        }
    }

    /// The duals that act on bin `t`.
    fn duals(&self, t: usize) -> Duals<'_> {
        let pixels = self.shape.pixels();
        let of = |t: usize| t * pixels..(t + 1) * pixels;
        let time = |t: usize| self.dual_t.get(of(t));
        Duals {
            py: DualOrZeros::new(self.dual_y.get(of(t))),
            px: DualOrZeros::new(self.dual_x.get(of(t))),
            time: DualOrZeros::new(time(t)),
            previous: DualOrZeros::new(t.checked_sub(1).and_then(time)),
        }
    }

    /// Radii of the dual's balls in space and over time.
    fn radii(&self, scale: f64) -> (f32, f32) {
        let VariationWeights { space, time, .. } = self.weights;
        ((scale * space) as f32, (scale * time) as f32)
    }

    /// The spatial dual `(py, px)` of a bin, for steps of length `length` at `scale`.
    fn spatial_step<'s>(
        &'s self,
        py: &'s mut [Dual],
        px: &'s mut [Dual],
        scale: f64,
        length: f32,
    ) -> Space<'s> {
        Space {
            py,
            px,
            step: StepFactor::new(length, self.radii(scale).0),
            columns: self.shape.columns,
            x_weights: &self.x_weights,
        }
    }

    /// The same for `p`, the dual over time between a bin with the primal point `now` and the next bin.
    fn time_step<'s>(
        &self,
        p: &'s mut [Dual],
        now: &'s [f32],
        scale: f64,
        length: f32,
    ) -> Time<'s> {
        let step = StepFactor::new(length, self.radii(scale).1);
        Time { p, now, step }
    }

    /// Whether any part of the prior needs a dual.
    pub(super) fn is_dual(&self) -> bool {
        !self.dual_y.is_empty() || !self.dual_t.is_empty()
    }

    /// An upper bound of `‖D‖²`: 4 for each axis that is differenced.
    pub(super) fn norm_squared(&self) -> f64 {
        norm_squared(!self.dual_y.is_empty(), !self.dual_t.is_empty())
    }

    /// Takes one projected gradient step of length `step` of every dual, from the primal point `z`.
    pub(super) fn step_dual(&mut self, z: &[f32], scale: f64, step: f32) {
        let (pixels, columns) = (self.shape.pixels(), self.shape.columns);
        let bin = |t: usize| &z[t * pixels..(t + 1) * pixels];
        let [mut py, mut px, mut pt] = self.take_duals();
        let duals = py
            .par_chunks_exact_mut(pixels)
            .zip(px.par_chunks_exact_mut(pixels));
        duals.enumerate().for_each(|(t, (py, px))| {
            for run in self.rows.adjacent(t) {
                self.spatial_step(py, px, scale, step)
                    .rows(run.clone(), bin(t));
            }
        });
        // The difference of the last bin is zero.
        let duals = pt.par_chunks_exact_mut(pixels).take(self.shape.bins - 1);
        duals.enumerate().for_each(|(t, p)| {
            for run in self.rows.adjacent(t) {
                let run = run.start * columns..run.end * columns;
                self.time_step(p, bin(t), scale, step)
                    .pixels(run, bin(t + 1));
            }
        });
        [self.dual_y, self.dual_x, self.dual_t] = [py, px, pt];
    }

    fn take_duals(&mut self) -> [Vec<Dual>; 3] {
        [&mut self.dual_y, &mut self.dual_x, &mut self.dual_t].map(take)
    }
}

/// Those of the sorted `runs` that contain one of `rows` or the row above `rows`.
fn runs_near<'r>(runs: &'r [Range<usize>], rows: &Range<usize>) -> &'r [Range<usize>] {
    let first = runs.partition_point(|run| run.end < rows.start);
    let count = runs[first..].partition_point(|run| run.start < rows.end);
    &runs[first..first + count]
}

/// An upper bound of `‖D‖²`: 4 for each axis that is differenced.
fn norm_squared(space: bool, time: bool) -> f64 {
    f64::from(8 * u8::from(space) + 4 * u8::from(time))
}

/// The stencil of [`Variation::sweep`]: a level computes the primal point and takes a dual step.
struct DualSteps<'a> {
    prior: &'a Variation,
    scale: f64,
    length: f32,
    last_level: usize,
    /// Whether the last level writes the primal point.
    writes_primal: bool,
}

impl DualSteps<'_> {
    /// Computes the primal point in `rows` and steps the duals that depend on it.
    ///
    /// These are the spatial dual of the rows above and, if `bin_view.previous` is [`Previous::Update`], the dual over
    /// time from the previous bin.
    fn write_and_step(
        &self,
        bin: &Bin,
        mut bin_view: BinView,
        (py, px): SpatialDuals,
        rows: Range<usize>,
    ) {
        let prior = self.prior;
        let time = DualOrZeros::new(bin_view.time);
        for run in runs_near(bin.rows, &rows) {
            // The dual of a row steps when the row below is known. Below the last row of a run lies a zero row, so the
            // dual steps in the strip that contains this zero row.
            let (start, end) = (run.start.max(rows.start), rows.end.min(run.end + 1));
            let active = start..end.min(run.end);
            let above = |y: usize| y.max(1) - 1;
            let row_above = above(active.end)..above(end);
            let previous = match &mut bin_view.previous {
                Previous::None => bin::Previous::Read(DualOrZeros::new(None)),
                Previous::Read(dual) => bin::Previous::Read(DualOrZeros::new(Some(*dual))),
                Previous::Update(p, now) => {
                    bin::Previous::Update(prior.time_step(p, now, self.scale, self.length))
                }
            };
            let space = prior.spatial_step(py, px, self.scale, self.length);
            bin.write_and_step(active, bin_view.z, bin_view.q, space, time, previous);
            prior
                .spatial_step(py, px, self.scale, self.length)
                .rows(row_above, bin_view.z);
        }
    }

    /// Computes the primal point in `rows`.
    fn write(&self, bin: &Bin, bin_view: BinView, space: Option<SpatialDuals>, rows: Range<usize>) {
        let (py, px) = space.unzip();
        let duals = Duals {
            py: DualOrZeros::new(py.as_deref()),
            px: DualOrZeros::new(px.as_deref()),
            time: DualOrZeros::new(bin_view.time),
            previous: DualOrZeros::new(match bin_view.previous {
                Previous::Read(dual) => Some(dual),
                Previous::None | Previous::Update(..) => None,
            }),
        };
        for run in runs_near(bin.rows, &rows) {
            let active = run.start.max(rows.start)..run.end.min(rows.end);
            bin.write_rows(active, bin_view.z, bin_view.q, duals);
        }
    }
}

impl Stencil for DualSteps<'_> {
    fn update_bin(
        &self,
        tile: &mut Tile,
        t: usize,
        level: usize,
        rows: Range<usize>,
        updates_previous_dual: bool,
    ) {
        let is_last_level = level == self.last_level;
        if is_last_level && !self.writes_primal {
            return;
        }
        let (prior, bin) = (self.prior, self.prior.bin(t, self.scale));
        // On a support the rows of the dual over time are not the active rows, so it takes its step by itself.
        let is_fused =
            updates_previous_dual && prior.weights.space > 0.0 && prior.support.is_none();
        let mut bin_view = tile.bin(t, is_fused);
        if level == 0 {
            bin.zero_inactive_rows(bin_view.z, rows.clone());
        }
        match bin_view.space.take() {
            Some(space) if !is_last_level => {
                self.write_and_step(&bin, bin_view, space, rows.clone());
            }
            space => self.write(&bin, bin_view, space, rows.clone()),
        }
        if updates_previous_dual && !is_fused {
            self.step_time_dual(tile, t - 1, rows);
        }
    }

    fn step_time_dual(&self, tile: &mut Tile, t: usize, rows: Range<usize>) {
        let (p, (now, next)) = tile.time_step(t);
        let columns = self.prior.shape.columns;
        for run in runs_near(self.prior.rows.adjacent(t), &rows) {
            let (start, end) = (run.start.max(rows.start), run.end.min(rows.end));
            let time = self.prior.time_step(p, now, self.scale, self.length);
            time.pixels(start * columns..end * columns, next);
        }
    }
}

impl Prox for Variation {
    fn prox(&mut self, q: &[f32], scale: f64, z: &mut [f32]) {
        assert_eq!(q.len(), self.shape.voxels(), "length of the point");
        assert_eq!(z.len(), self.shape.voxels(), "length of the result");
        self.scale = scale;
        let mut left = match (self.is_dual(), self.is_refined) {
            (false, _) => 0,
            (true, false) => self.steps_per_call,
            (true, true) => self.steps_per_call.max(REFINED_STEPS),
        };
        while left > STEPS_PER_SWEEP {
            self.sweep(q, scale, z, STEPS_PER_SWEEP, false);
            left -= STEPS_PER_SWEEP;
        }
        self.sweep(q, scale, z, left, true);
    }

    fn value(&self, z: &[f32]) -> f64 {
        let (shape, columns) = (self.shape, self.shape.columns);
        let VariationWeights { space, time, l1 } = self.weights;
        let bins = (0..shape.bins).into_par_iter().map(|t| {
            let rows = self.rows.adjacent(t).iter().cloned().flatten();
            let row = |t: usize, y: usize| &z[(t * shape.rows + y) * columns..][..columns];
            let mut sums = [0.0; 3];
            for y in rows {
                // The differences of the last row and the last bin are zero.
                let below = row(t, (y + 1).min(shape.rows - 1));
                let next = row((t + 1).min(shape.bins - 1), y);
                simd(
                    #[inline(always)]
                    || add_row(&mut sums, row(t, y), below, next),
                );
            }
            space * sums[0] + time * sums[1] + l1 * sums[2]
        });
        bins.collect::<Vec<f64>>().iter().sum()
    }

    /// The number of plateaus: the degrees of freedom under a total variation (Tibshirani & Taylor 2012).
    ///
    /// It counts the voxels above `tolerance` that differ from all their predecessors (left, above, previous bin)
    /// along the axes that the prior couples.
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        let (pixels, columns) = (self.shape.pixels(), self.shape.columns);
        let (space, time) = (!self.dual_y.is_empty(), !self.dual_t.is_empty());
        let free: usize = (0..self.shape.bins)
            .into_par_iter()
            .map(|t| {
                let start = t * pixels;
                let is_free = |i: &usize| {
                    let v = z[start + i];
                    let differs = |at: usize| (v - z[at]).abs() > tolerance;
                    v > tolerance
                        && (!space || i.is_multiple_of(columns) || differs(start + i - 1))
                        && (!space || *i < columns || differs(start + i - columns))
                        && (!time || t == 0 || differs(start + i - pixels))
                };
                let active = self.rows.active(t).iter();
                let pixels = active.flat_map(|run| run.start * columns..run.end * columns);
                pixels.filter(is_free).count()
            })
            .sum();
        free as f64
    }

    fn restrict(&mut self, support: &Support) {
        self.rows = Rows::of(support, self.shape);
        self.support = Some(support.clone());
    }

    fn set_refined(&mut self, is_refined: bool) {
        self.is_refined = is_refined;
    }

    fn subtract_dual(&self, v: &mut [f32]) {
        let pixels = self.shape.pixels();
        v.par_chunks_exact_mut(pixels)
            .enumerate()
            .for_each(|(t, v)| self.bin(t, self.scale).subtract_dual(v, self.duals(t)));
    }
}

#[cfg(test)]
mod tests;
