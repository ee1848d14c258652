//! What is done to a bin of a [`super::Variation`]: its primal point is made, and duals take their steps.
//!
//! All goes by parts of [`PART`] pixels, whatever rows they fall in, and what follows from a part of the primal point is
//! done while that is in registers: the dual over time from the bin before and the spatial dual of the row above, which
//! have waited for nothing else, take their steps.

use super::reached;
use crate::vecmath::simd;
use std::ops::Range;

/// Pixels of a part.
pub(super) const PART: usize = 32;

/// A bin of a video, apart from what is read and made of it.
pub(super) struct Bin<'a> {
    pub columns: usize,
    /// The runs of rows that may be lit.
    pub rows: &'a [Range<usize>],
    /// `s·w_1`.
    pub shrink: f32,
    /// What one of a [`Dual`] is worth, in space and over time.
    pub units: (f32, f32),
    /// 1 where it may be lit, 0 elsewhere.
    pub mask: Option<&'a [u8]>,
}

/// A dual over the radius of the ball that it stays in, in parts of [`FULL`]: half of the memory of f32, which is what
/// a prior of a video beyond the caches waits for. Rounding moves a point by 1e-4 of the radius at most, and that is 1.5 %
/// of the brightness in an iteration.
pub type Dual = i16;

/// The radius in units of a [`Dual`].
const FULL: f32 = 32767.0;

/// What one of a [`Dual`] is worth where the ball has this `radius`.
pub(super) fn unit(radius: f32) -> f32 {
    radius / FULL
}

/// Rounded to the nearest whole number; less than half of one beyond [`FULL`].
#[inline(always)]
fn nearest(value: f32) -> Dual {
    // From here on f32 has no digits behind the point, and the last ones are those of the number.
    const WHOLE: f32 = 12_582_912.0;
    (value + WHOLE).to_bits().wrapping_sub(WHOLE.to_bits()) as i16
}

/// A dual of all pixels of a bin, or zeros.
#[derive(Clone, Copy)]
pub(super) struct Values<'a> {
    values: &'a [Dual],
    /// Which bits of an index count.
    mask: usize,
}

/// The duals that pull at a bin: along y and x, and over time to the next bin and from the one before.
#[derive(Clone, Copy)]
pub(super) struct Duals<'a> {
    pub py: Values<'a>,
    pub px: Values<'a>,
    pub time: Values<'a>,
    pub before: Values<'a>,
}

/// A step of a dual: what a difference moves it by.
#[derive(Clone, Copy)]
pub(super) struct Step(f32);

impl Step {
    /// Of a `length`, for the ball of this `radius`; where that is 0 the dual stays.
    pub fn new(length: f32, radius: f32) -> Self {
        Self(if radius > 0.0 {
            FULL / radius * length
        } else {
            0.0
        })
    }
}

/// The spatial dual of a bin, which is to step.
pub(super) struct Space<'a> {
    pub py: &'a mut [Dual],
    pub px: &'a mut [Dual],
    pub step: Step,
    pub columns: usize,
    /// See [`along`].
    pub along: &'a [f32],
}

/// The dual over time between two bins, which is to step, and the point of the first of them.
pub(super) struct Time<'a> {
    pub p: &'a mut [Dual],
    pub now: &'a [f32],
    pub step: Step,
}

/// What a difference along x counts from each place of a row on: ones, with zero in the last column, which has no
/// neighbour; as many more as a part has.
pub(super) fn along(columns: usize) -> Vec<f32> {
    let is_inner = |i: usize| !(i + 1).is_multiple_of(columns);
    (0..columns + PART)
        .map(|i| f32::from(is_inner(i)))
        .collect()
}

/// What is done to `P` pixels of a bin from `i` on, the first of them in column `x`.
trait Work {
    fn part<const P: usize>(&mut self, i: usize, x: usize);
}

/// Does `work` at the `pixels`, in order. The first pixel of all, which has nothing beside it, is a part of its own, and
/// no part goes over the end of the first row, which has none above.
fn walk<W: Work>(pixels: Range<usize>, columns: usize, mut work: W) -> W {
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

#[inline(always)]
fn part<T: Copy, const P: usize>(values: &[T], i: usize) -> [T; P] {
    values[i..i + P].try_into().expect("so many")
}

/// [`std::array::from_fn`], compiled for the instructions of where it stands.
#[inline(always)]
fn each<T: Copy + Default, const P: usize>(value: impl Fn(usize) -> T) -> [T; P] {
    let mut values = [T::default(); P];
    for (k, v) in values.iter_mut().enumerate() {
        *v = value(k);
    }
    values
}

#[inline(always)]
fn put<T: Copy, const P: usize>(values: &mut [T], i: usize, part: [T; P]) {
    values[i..i + P].copy_from_slice(&part);
}

impl<'a> Values<'a> {
    const NONE: Self = Self {
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

    pub fn new(values: Option<&'a [Dual]>) -> Self {
        values.map_or(Self::NONE, Self::all)
    }

    #[inline(always)]
    fn part<const P: usize>(self, i: usize) -> [Dual; P] {
        part(self.values, i & self.mask)
    }

    /// The part that is `shift` pixels before `i`; zeros if there is none.
    #[inline(always)]
    fn before<const P: usize>(self, i: usize, shift: usize) -> [Dual; P] {
        let values = if i < shift { Self::NONE } else { self };
        values.part(i.wrapping_sub(shift))
    }
}

impl Duals<'_> {
    /// `s·w_1 + Dᵀp` at a part. To the left of a row is the last column of the row before, whose dual along x is zero.
    #[inline(always)]
    fn pull<const P: usize>(&self, i: usize, bin: &Bin) -> [f32; P] {
        let (here, above) = (self.py.part::<P>(i), self.py.before::<P>(i, bin.columns));
        let (right, left) = (self.px.part::<P>(i), self.px.before::<P>(i, 1));
        let (time, before) = (self.time.part::<P>(i), self.before.part::<P>(i));
        let (in_space, over_time) = bin.units;
        each(
            #[inline(always)]
            |k| {
                let less = |a: Dual, b: Dual| i32::from(a) - i32::from(b);
                let space = less(above[k], here[k]) + less(left[k], right[k]);
                let time = less(before[k], time[k]);
                bin.shrink + in_space * space as f32 + over_time * time as f32
            },
        )
    }
}

impl Bin<'_> {
    /// `max(0, q − s·w_1 − Dᵀp)` at a part, and zero where it may not be lit.
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

    /// Sets those of the `rows` of `z` to zero that are not lit.
    pub fn darken_others(&self, z: &mut [f32], rows: Range<usize>) {
        let end = rows.end.min(z.len() / self.columns);
        let mut dark = rows.start;
        for run in reached(self.rows, &rows) {
            if dark < run.start {
                z[dark * self.columns..run.start * self.columns].fill(0.0);
            }
            dark = run.end;
        }
        if dark < end {
            z[dark * self.columns..end * self.columns].fill(0.0);
        }
    }

    /// `z = max(0, q − s·w_1 − Dᵀp)`.
    pub fn write(&self, z: &mut [f32], q: &[f32], duals: Duals) {
        self.darken_others(z, 0..z.len() / self.columns);
        for run in self.rows {
            self.write_rows(run.clone(), (z, q), duals);
        }
    }

    /// Some rows of it.
    pub fn write_rows(&self, rows: Range<usize>, (z, q): (&mut [f32], &[f32]), duals: Duals) {
        let bin = self;
        walk(self.pixels(rows), self.columns, Write { bin, duals, q, z });
    }

    /// Some rows of it, while duals take their steps: along y and x in the rows above, and over time from the bin
    /// before, if that is to step.
    pub fn write_and_step(
        &self,
        rows: Range<usize>,
        (z, q): (&mut [f32], &[f32]),
        space: Space,
        (time, before, to_step): (Values, Values, Option<Time>),
    ) {
        match to_step {
            Some(before) => self.write_and_step_with(rows, (z, q), space, (time, before)),
            None => self.write_and_step_with(rows, (z, q), space, (time, before)),
        }
    }

    fn write_and_step_with(
        &self,
        rows: Range<usize>,
        (z, q): (&mut [f32], &[f32]),
        space: Space,
        (time, before): (Values, impl Before),
    ) {
        let bin = self;
        let work = WriteAndStep {
            bin,
            q,
            z,
            space,
            time,
            before,
        };
        walk(self.pixels(rows), self.columns, work);
    }

    /// `z −= s·w_1 + Dᵀp` of the rows that may be lit.
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

impl Work for Write<'_> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, _: usize) {
        put::<_, P>(self.z, i, self.bin.primal(i, part(self.q, i), self.duals));
    }
}

/// The dual over time from the bin before.
trait Before {
    fn values(&self) -> Values<'_>;
    /// Takes its step at a part, where the bin is at `z` now.
    fn step<const P: usize>(&mut self, i: usize, z: [f32; P]);
}

impl Before for Values<'_> {
    #[inline(always)]
    fn values(&self) -> Values<'_> {
        *self
    }

    #[inline(always)]
    fn step<const P: usize>(&mut self, _: usize, _: [f32; P]) {}
}

impl Before for Time<'_> {
    #[inline(always)]
    fn values(&self) -> Values<'_> {
        Values::all(self.p)
    }

    /// `p ← P(p + step·(next − now))`.
    #[inline(always)]
    fn step<const P: usize>(&mut self, i: usize, next: [f32; P]) {
        let (p, now) = (part::<_, P>(self.p, i), part::<_, P>(self.now, i));
        let moved = each(
            #[inline(always)]
            |k| nearest((f32::from(p[k]) + self.step.0 * (next[k] - now[k])).clamp(-FULL, FULL)),
        );
        put::<_, P>(self.p, i, moved);
    }
}

struct WriteAndStep<'a, B> {
    bin: &'a Bin<'a>,
    q: &'a [f32],
    z: &'a mut [f32],
    space: Space<'a>,
    time: Values<'a>,
    before: B,
}

impl<B: Before> Work for WriteAndStep<'_, B> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, x: usize) {
        let duals = Duals {
            py: Values::all(self.space.py),
            px: Values::all(self.space.px),
            time: self.time,
            before: self.before.values(),
        };
        let z = self.bin.primal::<P>(i, part(self.q, i), duals);
        put(self.z, i, z);
        self.before.step(i, z);
        if let Some(above) = i.checked_sub(self.bin.columns) {
            self.space.part(above, x, self.z, z);
        }
    }
}

struct Subtract<'a> {
    bin: &'a Bin<'a>,
    duals: Duals<'a>,
    z: &'a mut [f32],
}

impl Work for Subtract<'_> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, _: usize) {
        let (z, pull) = (part::<_, P>(self.z, i), self.duals.pull::<P>(i, self.bin));
        put::<_, P>(
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
    /// A step along the differences of `z` at a part, with `below` it, and back into the ball.
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, x: usize, z: &[f32], below: [f32; P]) {
        let step = self.step.0;
        let (here, right) = (part::<_, P>(z, i), part::<_, P>(z, i + 1));
        let along = part::<_, P>(self.along, x);
        let (py, px) = (part::<_, P>(self.py, i), part::<_, P>(self.px, i));
        let y: [f32; P] = each(
            #[inline(always)]
            |k| f32::from(py[k]) + step * (below[k] - here[k]),
        );
        let x: [f32; P] = each(
            #[inline(always)]
            |k| f32::from(px[k]) + step * (along[k] * (right[k] - here[k])),
        );
        // In most of a picture nothing is outside.
        if is_inside(&y, &x) {
            self.put(i, y, x);
        } else {
            let (y, x) = project(y, x);
            self.put(i, y, x);
        }
    }

    #[inline(always)]
    fn put<const P: usize>(&mut self, i: usize, y: [f32; P], x: [f32; P]) {
        put::<_, P>(
            self.py,
            i,
            each(
                #[inline(always)]
                |k| nearest(y[k]),
            ),
        );
        put::<_, P>(
            self.px,
            i,
            each(
                #[inline(always)]
                |k| nearest(x[k]),
            ),
        );
    }

    /// The same of some rows.
    pub fn rows(self, rows: Range<usize>, z: &[f32]) {
        let columns = self.columns;
        // The last row has no row below, and the last column nothing beside: their differences are zero.
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

impl Work for SpaceSteps<'_> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, x: usize) {
        let below = if self.is_last {
            i
        } else {
            i + self.space.columns
        };
        self.space.part::<P>(i, x, self.z, part(self.z, below));
    }
}

impl Time<'_> {
    /// Takes its step at some pixels.
    pub fn pixels(self, pixels: Range<usize>, next: &[f32]) {
        walk(pixels, usize::MAX, TimeSteps { time: self, next });
    }
}

struct TimeSteps<'a> {
    time: Time<'a>,
    next: &'a [f32],
}

impl Work for TimeSteps<'_> {
    #[inline(always)]
    fn part<const P: usize>(&mut self, i: usize, _: usize) {
        self.time.step::<P>(i, part(self.next, i));
    }
}

/// The radius of the ball, from where rounding does not lead out, squared.
const MAX_NORM_SQUARED: f32 = (FULL - 1.0) * (FULL - 1.0);

#[inline(always)]
fn is_inside<const P: usize>(y: &[f32; P], x: &[f32; P]) -> bool {
    let mut outside = 0;
    for (y, x) in y.iter().zip(x) {
        outside |= u32::from(y * y + x * x > MAX_NORM_SQUARED);
    }
    outside == 0
}

/// Into the ball; what is inside stays as it is.
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

/// `1/√a` to 1e-6 of it, and something large for zero: a first guess from the exponent, a Newton step whose constants
/// fit that guess best (Kadlec 2010), and a plain one. Products alone: processors take several times as long for a root
/// and a division.
#[inline(always)]
pub(super) fn inverse_root(a: f32) -> f32 {
    let guess = f32::from_bits(0x5f1f_fff9 - (a.to_bits() >> 1));
    let root = guess * (0.703_952_25 * (2.389_244_6 - a * guess * guess));
    root * (1.5 - 0.5 * a * root * root)
}

/// Adds a row's `√((∂y v)² + (∂x v)²)`, `|∂t v|` and `|v|`.
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
