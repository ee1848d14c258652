//! What is done to a bin of a [`super::Variation`]: its primal point is made, and duals take their steps.
//!
//! All goes by parts of [`PART`] pixels, whatever rows they fall in, and what follows from a part of the primal point is
//! done while that is in registers: the dual over time from the bin before and the spatial dual of the row above, which
//! have waited for nothing else, take their steps, or the point is taken away from where it came from.

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
    /// 1 where it may be lit, 0 elsewhere.
    pub mask: Option<&'a [u8]>,
}

/// Values of all pixels of a bin, or zeros.
#[derive(Clone, Copy)]
pub(super) struct Values<'a> {
    values: &'a [f32],
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

/// The length of a step of a dual, and the radius of the ball that it stays in.
#[derive(Clone, Copy)]
pub(super) struct Step {
    pub length: f32,
    pub radius: f32,
}

/// The spatial dual of a bin, which is to step.
pub(super) struct Space<'a> {
    pub py: &'a mut [f32],
    pub px: &'a mut [f32],
    pub step: Step,
    pub columns: usize,
    /// See [`along`].
    pub along: &'a [f32],
}

/// The dual over time between two bins, which is to step, and the point of the first of them.
pub(super) struct Time<'a> {
    pub p: &'a mut [f32],
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
fn part<const P: usize>(values: &[f32], i: usize) -> [f32; P] {
    values[i..i + P].try_into().expect("so many")
}

/// [`std::array::from_fn`], compiled for the instructions of where it stands.
#[inline(always)]
fn each<const P: usize>(value: impl Fn(usize) -> f32) -> [f32; P] {
    let mut values = [0.0; P];
    for (k, v) in values.iter_mut().enumerate() {
        *v = value(k);
    }
    values
}

#[inline(always)]
fn put<const P: usize>(values: &mut [f32], i: usize, part: [f32; P]) {
    values[i..i + P].copy_from_slice(&part);
}

impl<'a> Values<'a> {
    const NONE: Self = Self {
        values: &[0.0; PART],
        mask: 0,
    };

    #[inline(always)]
    fn all(values: &'a [f32]) -> Self {
        Self {
            values,
            mask: usize::MAX,
        }
    }

    pub fn new(values: Option<&'a [f32]>) -> Self {
        values.map_or(Self::NONE, Self::all)
    }

    #[inline(always)]
    fn part<const P: usize>(self, i: usize) -> [f32; P] {
        part(self.values, i & self.mask)
    }

    /// The part that is `shift` pixels before `i`; zeros if there is none.
    #[inline(always)]
    fn before<const P: usize>(self, i: usize, shift: usize) -> [f32; P] {
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
        each(
            #[inline(always)]
            |k| {
                let space = (above[k] - here[k]) - right[k];
                bin.shrink + space + (before[k] - time[k]) + left[k]
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
                let lit: [u8; P] = mask[i..i + P].try_into().expect("so many");
                each(
                    #[inline(always)]
                    |k| z[k] * f32::from(lit[k]),
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
        (time, before, led): (Values, Values, Option<Time>),
    ) {
        let (bin, pixels) = (self, self.pixels(rows));
        match led {
            Some(led) => {
                let before = led;
                let work = WriteAndStep {
                    bin,
                    q,
                    z,
                    space,
                    time,
                    before,
                };
                walk(pixels, self.columns, work);
            }
            None => {
                let work = WriteAndStep {
                    bin,
                    q,
                    z,
                    space,
                    time,
                    before,
                };
                walk(pixels, self.columns, work);
            }
        }
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
        put::<P>(self.z, i, self.bin.primal(i, part(self.q, i), self.duals));
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
        let Step { length, radius } = self.step;
        let (p, now) = (part::<P>(self.p, i), part::<P>(self.now, i));
        put::<P>(
            self.p,
            i,
            each(
                #[inline(always)]
                |k| {
                    let moved = p[k] + length * (next[k] - now[k]);
                    let moved = if moved < radius { moved } else { radius };
                    if moved > -radius { moved } else { -radius }
                },
            ),
        );
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
        let (z, pull) = (part::<P>(self.z, i), self.duals.pull::<P>(i, self.bin));
        put::<P>(
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
        let Step { length, radius } = self.step;
        let (here, right) = (part::<P>(z, i), part::<P>(z, i + 1));
        let along = part::<P>(self.along, x);
        let (py, px) = (part::<P>(self.py, i), part::<P>(self.px, i));
        let mut py = each(
            #[inline(always)]
            |k| py[k] + length * (below[k] - here[k]),
        );
        let mut px = each(
            #[inline(always)]
            |k| px[k] + length * (along[k] * (right[k] - here[k])),
        );
        project(&mut py, &mut px, radius);
        put::<P>(self.py, i, py);
        put::<P>(self.px, i, px);
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

/// Into the ball of `radius`; what is inside stays as it is. Where all are, as in most of a picture, nothing is to
/// be done.
#[inline(always)]
fn project<const P: usize>(py: &mut [f32; P], px: &mut [f32; P], radius: f32) {
    let most = radius * radius;
    let mut outside = 0;
    for (y, x) in py.iter().zip(&*px) {
        outside |= u32::from(y * y + x * x > most);
    }
    if outside > 0 {
        for (y, x) in py.iter_mut().zip(px) {
            let size = *y * *y + *x * *x;
            let shrink = if size > most {
                radius * inverse_root(size)
            } else {
                1.0
            };
            (*y, *x) = (*y * shrink, *x * shrink);
        }
    }
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
