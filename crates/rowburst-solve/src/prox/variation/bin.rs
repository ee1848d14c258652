//! Loops over one bin of a [`super::Variation`]: its primal point and the steps of its duals.
//!
//! The loops take parts of [`PART`] pixels, across the ends of rows. While a part of the primal point is in
//! registers, two duals take their steps there, since it was the last value that they needed: the dual over time from
//! the previous bin and the spatial dual of the row above (docs/design/013).

use super::runs_near;
use rowburst_core::vecmath::simd;
use std::ops::Range;

/// Pixels worked on together in registers; larger gains nothing (docs/design/013).
pub(super) const PART: usize = 32;

/// Parameters of a bin.
pub(super) struct Bin<'a> {
    pub columns: usize,
    /// Runs of rows with an active voxel.
    pub rows: &'a [Range<usize>],
    /// `s·w_1`.
    pub shrink: f32,
    /// Value of one unit of a [`Dual`], in space and over time.
    pub units: (f32, f32),
    /// 1 for active voxels, 0 for others; `None`: all are active.
    pub mask: Option<&'a [u8]>,
}

/// A dual over its ball's radius in 16 bits: half the memory of f32, with little rounding (docs/design/013).
pub type Dual = i16;

/// The ball's radius in units of a [`Dual`].
const FULL: f32 = 32767.0;

/// Value of one unit of a [`Dual`] in a ball of `radius`.
pub(super) fn unit(radius: f32) -> f32 {
    radius / FULL
}

/// Rounds to the nearest integer. `value` must be less than half a unit beyond ±[`FULL`].
#[inline(always)]
fn nearest(value: f32) -> Dual {
    // Near 1.5·2²³ an f32 has no fractional digits, so the sum's lowest bits are the rounded integer.
    const SHIFT: f32 = 12_582_912.0;
    (value + SHIFT).to_bits().wrapping_sub(SHIFT.to_bits()) as i16
}

/// A dual of all pixels of a bin, or zeros.
#[derive(Clone, Copy)]
pub(super) struct DualOrZeros<'a> {
    values: &'a [Dual],
    /// Mask of an index: all bits, or none if every index gives the same zeros.
    mask: usize,
}

/// The duals that act on a bin: along y and x, over time to the next bin, and over time from the previous bin.
#[derive(Clone, Copy)]
pub(super) struct Duals<'a> {
    pub py: DualOrZeros<'a>,
    pub px: DualOrZeros<'a>,
    pub time: DualOrZeros<'a>,
    pub previous: DualOrZeros<'a>,
}

/// A dual step: units of a [`Dual`] for each unit of a difference of the primal point.
#[derive(Clone, Copy)]
pub(super) struct StepFactor(f32);

impl StepFactor {
    /// A step of `length` in a ball of `radius`. With radius 0 the dual does not change.
    pub fn new(length: f32, radius: f32) -> Self {
        Self(if radius > 0.0 {
            FULL / radius * length
        } else {
            0.0
        })
    }
}

/// The spatial dual of a bin, with its step.
pub(super) struct Space<'a> {
    pub py: &'a mut [Dual],
    pub px: &'a mut [Dual],
    pub step: StepFactor,
    pub columns: usize,
    /// See [`x_weights`].
    pub x_weights: &'a [f32],
}

/// The dual over time `p` from a bin to the next, with its step and the primal point `now` of the first bin.
pub(super) struct Time<'a> {
    pub p: &'a mut [Dual],
    pub now: &'a [f32],
    pub step: StepFactor,
}

/// Weights of the differences along x: 0 in the last column, which has no right neighbour, and 1 elsewhere.
///
/// They continue for [`PART`] pixels beyond a row, so that a part may begin in any column.
pub(super) fn x_weights(columns: usize) -> Vec<f32> {
    let is_inner = |i: usize| !(i + 1).is_multiple_of(columns);
    (0..columns + PART)
        .map(|i| f32::from(is_inner(i)))
        .collect()
}

/// A loop body over the pixels of a bin.
trait PixelLoop {
    /// Works on the pixels `i..i + P`; pixel `i` is in column `x`.
    fn part<const P: usize>(&mut self, i: usize, x: usize);
}

/// Runs `work` over `pixels` in order.
///
/// Pixel 0, which has no left neighbour, is a part of its own. No part crosses the end of row 0, which has no row
/// above.
fn walk<W: PixelLoop>(pixels: Range<usize>, columns: usize, mut work: W) -> W {
    let Range { start, end } = pixels;
    let borders = [1, columns].map(|border| border.clamp(start, end.max(start)));
    let mut x = start % columns;
    simd(
        #[inline(always)]
        move || {
            let mut i = start;
            for end in [borders[0], borders[1], end] {
                while i < end {
                    let size = match end - i {
                        PART.. => {
                            work.part::<PART>(i, x);
                            PART
                        }
                        4.. => {
                            work.part::<4>(i, x);
                            4
                        }
                        _ => {
                            work.part::<1>(i, x);
                            1
                        }
                    };
                    (i, x) = (i + size, x + size);
                    while x >= columns {
                        x -= columns;
                    }
                }
            }
            work
        },
    )
}

/// The `P` values from `i` on.
#[inline(always)]
fn load<T: Copy, const P: usize>(values: &[T], i: usize) -> [T; P] {
    values[i..i + P].try_into().expect("so many")
}

/// [`std::array::from_fn`], inlined so that it is compiled for the caller's instruction set.
#[inline(always)]
fn each<T: Copy + Default, const P: usize>(value: impl Fn(usize) -> T) -> [T; P] {
    let mut values = [T::default(); P];
    for (k, v) in values.iter_mut().enumerate() {
        *v = value(k);
    }
    values
}

/// Writes `part` from `i` on.
#[inline(always)]
fn store<T: Copy, const P: usize>(values: &mut [T], i: usize, part: [T; P]) {
    values[i..i + P].copy_from_slice(&part);
}

impl<'a> DualOrZeros<'a> {
    const ZEROS: Self = Self {
        values: &[0; PART],
        mask: 0,
    };

    #[inline(always)]
    fn all(values: &'a [Dual]) -> Self {
        Self {
            values,
            mask: usize::MAX,
        }
    }

    /// The dual `values`, or zeros.
    pub fn new(values: Option<&'a [Dual]>) -> Self {
        values.map_or(Self::ZEROS, Self::all)
    }

    #[inline(always)]
    fn load<const P: usize>(self, i: usize) -> [Dual; P] {
        load(self.values, i & self.mask)
    }

    /// The part that begins `shift` pixels before `i`; zeros if that is before the bin.
    #[inline(always)]
    fn load_before<const P: usize>(self, i: usize, shift: usize) -> [Dual; P] {
        let values = if i < shift { Self::ZEROS } else { self };
        values.load(i.wrapping_sub(shift))
    }
}

impl Duals<'_> {
    /// `s·w_1 + Dᵀp` at a part.
    ///
    /// The pixel before column 0 is in the last column of the row above, where the dual along x is zero.
    #[inline(always)]
    fn pull<const P: usize>(&self, i: usize, bin: &Bin) -> [f32; P] {
        let (here, above) = (
            self.py.load::<P>(i),
            self.py.load_before::<P>(i, bin.columns),
        );
        let (right, left) = (self.px.load::<P>(i), self.px.load_before::<P>(i, 1));
        let (time, previous) = (self.time.load::<P>(i), self.previous.load::<P>(i));
        let (in_space, over_time) = bin.units;
        each(
            #[inline(always)]
            |k| {
                let difference = |a: Dual, b: Dual| i32::from(a) - i32::from(b);
                let space = difference(above[k], here[k]) + difference(left[k], right[k]);
                let time = difference(previous[k], time[k]);
                bin.shrink + in_space * space as f32 + over_time * time as f32
            },
        )
    }
}

impl Bin<'_> {
    /// `max(0, q − s·w_1 − Dᵀp)` at a part; zero at inactive voxels.
    #[inline(always)]
    fn primal<const P: usize>(&self, i: usize, q: [f32; P], duals: Duals) -> [f32; P] {
        let pull = duals.pull::<P>(i, self);
        let z: [f32; P] = each(
            #[inline(always)]
            |k| (q[k] - pull[k]).max(0.0),
        );
        match self.mask {
            None => z,
            Some(mask) => {
                let active: [u8; P] = mask[i..i + P].try_into().expect("so many");
                each(
                    #[inline(always)]
                    |k| z[k] * f32::from(active[k]),
                )
            }
        }
    }

    /// Sets those of `rows` in `z` to zero that have no active voxel.
    pub fn zero_inactive_rows(&self, z: &mut [f32], rows: Range<usize>) {
        let end = rows.end.min(z.len() / self.columns);
        let mut next = rows.start;
        for run in runs_near(self.rows, &rows) {
            if next < run.start {
                z[next * self.columns..run.start * self.columns].fill(0.0);
            }
            next = run.end;
        }
        if next < end {
            z[next * self.columns..end * self.columns].fill(0.0);
        }
    }

    /// `z = max(0, q − s·w_1 − Dᵀp)` in the whole bin.
    pub fn write(&self, z: &mut [f32], q: &[f32], duals: Duals) {
        self.zero_inactive_rows(z, 0..z.len() / self.columns);
        for run in self.rows {
            self.write_rows(run.clone(), z, q, duals);
        }
    }

    /// The same in `rows`, which have an active voxel each.
    pub fn write_rows(&self, rows: Range<usize>, z: &mut [f32], q: &[f32], duals: Duals) {
        let bin = self;
        walk(self.pixels(rows), self.columns, Write { bin, duals, q, z });
    }

    /// The same, and steps of the duals: along y and x in the rows above, and over time from the previous bin if
    /// `previous` is [`Previous::Update`].
    pub fn write_and_step(
        &self,
        rows: Range<usize>,
        z: &mut [f32],
        q: &[f32],
        space: Space,
        time: DualOrZeros,
        previous: Previous,
    ) {
        match previous {
            Previous::Update(dual) => self.write_and_step_with(rows, z, q, space, time, dual),
            Previous::Read(dual) => self.write_and_step_with(rows, z, q, space, time, dual),
        }
    }

    fn write_and_step_with(
        &self,
        rows: Range<usize>,
        z: &mut [f32],
        q: &[f32],
        space: Space,
        time: DualOrZeros,
        previous: impl PreviousDual,
    ) {
        let bin = self;
        let work = WriteAndStep {
            bin,
            q,
            z,
            space,
            time,
            previous,
        };
        walk(self.pixels(rows), self.columns, work);
    }

    /// `z −= s·w_1 + Dᵀp` in the rows with an active voxel.
    pub fn subtract_dual(&self, z: &mut [f32], duals: Duals) {
        let bin = self;
        for run in self.rows {
            let z = &mut *z;
            walk(
                self.pixels(run.clone()),
                self.columns,
                Subtract { bin, duals, z },
            );
        }
    }

    fn pixels(&self, rows: Range<usize>) -> Range<usize> {
        rows.start * self.columns..rows.end * self.columns
    }
}

struct Write<'a> {
    bin: &'a Bin<'a>,
    duals: Duals<'a>,
    q: &'a [f32],
    z: &'a mut [f32],
}

impl PixelLoop for Write<'_> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, _: usize) {
        store::<_, P>(self.z, i, self.bin.primal(i, load(self.q, i), self.duals));
    }
}

/// The dual over time from the previous bin, for [`Bin::write_and_step`].
pub(super) enum Previous<'a> {
    Read(DualOrZeros<'a>),
    Update(Time<'a>),
}

/// The dual over time from the previous bin: one that steps ([`Time`]), or one that is only read ([`DualOrZeros`]).
trait PreviousDual {
    fn values(&self) -> DualOrZeros<'_>;
    /// Steps the dual at a part, where the bin's primal point is `z`.
    fn step<const P: usize>(&mut self, i: usize, z: [f32; P]);
}

impl PreviousDual for DualOrZeros<'_> {
    #[inline(always)]
    fn values(&self) -> DualOrZeros<'_> {
        *self
    }

    #[inline(always)]
    fn step<const P: usize>(&mut self, _: usize, _: [f32; P]) {}
}

impl PreviousDual for Time<'_> {
    #[inline(always)]
    fn values(&self) -> DualOrZeros<'_> {
        DualOrZeros::all(self.p)
    }

    /// `p ← P(p + step·(next − now))`.
    #[inline(always)]
    fn step<const P: usize>(&mut self, i: usize, next: [f32; P]) {
        let (p, now) = (load::<_, P>(self.p, i), load::<_, P>(self.now, i));
        let moved = each(
            #[inline(always)]
            |k| nearest((f32::from(p[k]) + self.step.0 * (next[k] - now[k])).clamp(-FULL, FULL)),
        );
        store::<_, P>(self.p, i, moved);
    }
}

struct WriteAndStep<'a, B> {
    bin: &'a Bin<'a>,
    q: &'a [f32],
    z: &'a mut [f32],
    space: Space<'a>,
    time: DualOrZeros<'a>,
    previous: B,
}

impl<B: PreviousDual> PixelLoop for WriteAndStep<'_, B> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, x: usize) {
        let duals = Duals {
            py: DualOrZeros::all(self.space.py),
            px: DualOrZeros::all(self.space.px),
            time: self.time,
            previous: self.previous.values(),
        };
        let z = self.bin.primal::<P>(i, load(self.q, i), duals);
        store(self.z, i, z);
        self.previous.step(i, z);
        if let Some(above) = i.checked_sub(self.bin.columns) {
            self.space.step_part(above, x, self.z, z);
        }
    }
}

struct Subtract<'a> {
    bin: &'a Bin<'a>,
    duals: Duals<'a>,
    z: &'a mut [f32],
}

impl PixelLoop for Subtract<'_> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, _: usize) {
        let (z, pull) = (load::<_, P>(self.z, i), self.duals.pull::<P>(i, self.bin));
        store::<_, P>(
            self.z,
            i,
            each(
                #[inline(always)]
                |k| z[k] - pull[k],
            ),
        );
    }
}

impl Space<'_> {
    /// A projected gradient step at a part of the primal point `z`; `below` is the same part of the next row.
    #[inline(always)]
    fn step_part<const P: usize>(&mut self, i: usize, x: usize, z: &[f32], below: [f32; P]) {
        let step = self.step.0;
        let (here, right) = (load::<_, P>(z, i), load::<_, P>(z, i + 1));
        let weights = load::<_, P>(self.x_weights, x);
        let (py, px) = (load::<_, P>(self.py, i), load::<_, P>(self.px, i));
        let y: [f32; P] = each(
            #[inline(always)]
            |k| f32::from(py[k]) + step * (below[k] - here[k]),
        );
        let x: [f32; P] = each(
            #[inline(always)]
            |k| f32::from(px[k]) + step * (weights[k] * (right[k] - here[k])),
        );
        // Most parts need no projection.
        if is_inside(&y, &x) {
            self.store(i, y, x);
        } else {
            let (y, x) = project(y, x);
            self.store(i, y, x);
        }
    }

    #[inline(always)]
    fn store<const P: usize>(&mut self, i: usize, y: [f32; P], x: [f32; P]) {
        store::<_, P>(
            self.py,
            i,
            each(
                #[inline(always)]
                |k| nearest(y[k]),
            ),
        );
        store::<_, P>(
            self.px,
            i,
            each(
                #[inline(always)]
                |k| nearest(x[k]),
            ),
        );
    }

    /// The same in `rows`.
    pub fn rows(self, rows: Range<usize>, z: &[f32]) {
        let columns = self.columns;
        // The last row is compared with itself, so its differences along y are zero. The dual of the last pixel,
        // which has no neighbour, stays zero.
        let last = z.len() / columns - 1;
        let others = rows.start * columns..rows.end.min(last) * columns;
        let steps = SpaceSteps {
            space: self,
            z,
            is_last: false,
        };
        let SpaceSteps { space, .. } = walk(others, columns, steps);
        if rows.contains(&last) {
            let row = last * columns..z.len() - 1;
            walk(
                row,
                columns,
                SpaceSteps {
                    space,
                    z,
                    is_last: true,
                },
            );
        }
    }
}

struct SpaceSteps<'a> {
    space: Space<'a>,
    z: &'a [f32],
    is_last: bool,
}

impl PixelLoop for SpaceSteps<'_> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, x: usize) {
        let below = if self.is_last {
            i
        } else {
            i + self.space.columns
        };
        self.space.step_part::<P>(i, x, self.z, load(self.z, below));
    }
}

impl Time<'_> {
    /// Steps the dual at `pixels`; `next` is the primal point of the next bin.
    pub fn pixels(self, pixels: Range<usize>, next: &[f32]) {
        walk(pixels, usize::MAX, TimeSteps { time: self, next });
    }
}

struct TimeSteps<'a> {
    time: Time<'a>,
    next: &'a [f32],
}

impl PixelLoop for TimeSteps<'_> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, _: usize) {
        self.time.step::<P>(i, load(self.next, i));
    }
}

/// Square of the largest norm without projection: the radius less one unit, so that rounding stays in the ball.
const MAX_NORM_SQUARED: f32 = (FULL - 1.0) * (FULL - 1.0);

#[inline(always)]
fn is_inside<const P: usize>(y: &[f32; P], x: &[f32; P]) -> bool {
    let mut outside = 0;
    for (y, x) in y.iter().zip(x) {
        outside |= u32::from(y * y + x * x > MAX_NORM_SQUARED);
    }
    outside == 0
}

/// Projects onto the ball; points inside do not change.
#[inline(always)]
fn project<const P: usize>(mut y: [f32; P], mut x: [f32; P]) -> ([f32; P], [f32; P]) {
    for (y, x) in y.iter_mut().zip(&mut x) {
        let size = *y * *y + *x * *x;
        let shrink = if size > MAX_NORM_SQUARED {
            (FULL - 1.0) * inverse_root(size)
        } else {
            1.0
        };
        (*y, *x) = (*y * shrink, *x * shrink);
    }
    (y, x)
}

/// `1/√a` with a relative error of 1e-6; a large finite number for zero.
///
/// A first guess from the exponent is followed by a Newton step with constants that fit that guess (Kadlec 2010) and
/// by a plain Newton step. They take products alone, which are several times faster than a root and a division.
#[inline(always)]
pub(super) fn inverse_root(a: f32) -> f32 {
    let guess = f32::from_bits(0x5f1f_fff9 - (a.to_bits() >> 1));
    let root = guess * (0.703_952_25 * (2.389_244_6 - a * guess * guess));
    root * (1.5 - 0.5 * a * root * root)
}

/// Adds the sums of `√((∂y v)² + (∂x v)²)`, `|∂t v|` and `|v|` over a row to `sums`.
#[inline(always)]
pub(super) fn add_row(sums: &mut [f64; 3], row: &[f32], below: &[f32], next: &[f32]) {
    const LANES: usize = 8;
    let last = row.len() - 1;
    let (below, next, right) = (&below[..=last], &next[..=last], &row[1..]);
    let norm = |down: f32, along: f32| f64::from((down * down + along * along).sqrt());
    let whole = last - last % LANES;
    let mut lanes = [[0.0f64; LANES]; 3];
    for first in (0..whole).step_by(LANES) {
        let part = first..first + LANES;
        let (v, right) = (&row[part.clone()], &right[part.clone()]);
        let (below, next) = (&below[part.clone()], &next[part]);
        for i in 0..LANES {
            lanes[0][i] += norm(below[i] - v[i], right[i] - v[i]);
            lanes[1][i] += f64::from((next[i] - v[i]).abs());
            lanes[2][i] += f64::from(v[i].abs());
        }
    }
    for x in whole..=last {
        let along = if x < last { right[x] - row[x] } else { 0.0 };
        lanes[0][0] += norm(below[x] - row[x], along);
        lanes[1][0] += f64::from((next[x] - row[x]).abs());
        lanes[2][0] += f64::from(row[x].abs());
    }
    for (sum, lanes) in sums.iter_mut().zip(lanes) {
        *sum += lanes.iter().sum::<f64>();
    }
}
