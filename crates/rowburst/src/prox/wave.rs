//! Steps that couple neighbouring bins, taken through a video as a wave.
//!
//! A dual prox makes the primal point of every bin, which reads the dual over time before and behind it, then steps
//! the dual between every two bins, which reads both points, and so on, level after level. Done so, the whole video
//! passes the cache for each. Here level `l` follows `l` bins and `l` rows behind the first one, through a strip
//! of a few rows of all bins after the other, so what a level has made is at hand for the next one. Where bins do not see
//! each other, each takes all levels by itself.
//!
//! Threads take blocks of bins each. What level `l` may do there ends `l` bins from a border that blocks
//! share; what is left, a few bins around each border, is done after all blocks. Every voxel sees the
//! same steps in the same order however many blocks there are, so the bits do not depend on the threads.

use super::{Moved, subtract};
use crate::Shape;
use rayon::prelude::*;
use std::ops::Range;

/// Levels `0..=steps` over the bins: first between the bins, except at level 0, then at the bins.
pub(super) struct Wave {
    pub shape: Shape,
    /// Rows of a strip.
    pub rows_at_once: usize,
    pub steps: usize,
    /// Whether bins see their neighbours; else each is done by itself.
    pub is_coupled: bool,
}

/// The point whose prox is taken.
pub(super) enum Point<'a> {
    Kept(&'a [f32]),
    /// Less the prox in the end, by [`Point::take_away`]; and the last prox.
    Reduced(&'a mut [f32], &'a [f32]),
}

impl Point<'_> {
    pub fn values(&self) -> &[f32] {
        match self {
            Point::Kept(q) => q,
            Point::Reduced(q, _) => q,
        }
    }

    fn part(&mut self, at: Range<usize>) -> Point<'_> {
        match self {
            Point::Kept(q) => Point::Kept(&q[at]),
            Point::Reduced(q, last) => Point::Reduced(&mut q[at.clone()], &last[at]),
        }
    }

    /// Takes the prox `z` away `at` these places, if it is [`Point::Reduced`].
    pub fn take_away(&mut self, at: Range<usize>, z: &[f32]) -> Moved {
        match self {
            Point::Kept(_) => Moved::default(),
            Point::Reduced(q, last) => subtract(&mut q[at.clone()], &z[at.clone()], &last[at]),
        }
    }

    pub fn kept(&self) -> Point<'_> {
        Point::Kept(self.values())
    }
}

/// Some neighbouring bins of everything that the steps read and write.
pub(super) struct Slab<'a> {
    bins: Range<usize>,
    pixels: usize,
    q: Point<'a>,
    z: &'a mut [f32],
    /// Two duals in space; empty where there is none.
    space: [&'a mut [f32]; 2],
    /// The dual over time from each bin to the next; of the last bin, which a neighbour reads
    /// as well, and of the bin before the first it is shared.
    time: &'a mut [f32],
    last: Option<&'a [f32]>,
    before: Option<&'a [f32]>,
    moved: Vec<(usize, Moved)>,
}

/// A bin of a [`Slab`].
pub(super) struct Parts<'s> {
    pub z: &'s mut [f32],
    pub q: Point<'s>,
    pub space: (&'s mut [f32], &'s mut [f32]),
    /// The dual over time of it, and of the bin before.
    pub time: (Option<&'s [f32]>, Option<&'s [f32]>),
    pub moved: &'s mut Vec<(usize, Moved)>,
}

impl Slab<'_> {
    pub fn bin(&mut self, t: usize) -> Parts<'_> {
        let at = self.place(t);
        let part =
            |of: &'_ mut [f32]| -> Range<usize> { if of.is_empty() { 0..0 } else { at.clone() } };
        let [py, px] = &mut self.space;
        let (in_y, in_x) = (part(py), part(px));
        let first = self.bins.start;
        let time = |t: usize| -> Option<&[f32]> {
            if t < first {
                return self.before;
            }
            let at = (t - first) * self.pixels..(t + 1 - first) * self.pixels;
            self.time.get(at).or(self.last)
        };
        let times = (time(t), t.checked_sub(1).and_then(time));
        Parts {
            q: self.q.part(at.clone()),
            z: &mut self.z[at],
            space: (&mut py[in_y], &mut px[in_x]),
            time: times,
            moved: &mut self.moved,
        }
    }

    /// The dual over time from bin `t` to the next, and the two bins.
    pub fn time_step(&mut self, t: usize) -> (&mut [f32], (&[f32], &[f32])) {
        let (now, next) = (self.place(t), self.place(t + 1));
        let p = &mut self.time[now.clone()];
        let z = &*self.z;
        (p, (&z[now], &z[next]))
    }

    fn place(&self, t: usize) -> Range<usize> {
        let at = t - self.bins.start;
        at * self.pixels..(at + 1) * self.pixels
    }
}

/// What is done to some rows of a bin, or of the dual between a bin and the next one, at a level. Rows may end one
/// behind the last: what looks at the row above has its turn there.
pub(super) trait Levels: Sync {
    fn at(&self, slab: &mut Slab, t: usize, level: usize, rows: Range<usize>);
    fn between(&self, slab: &mut Slab, t: usize, rows: Range<usize>);
}

impl Wave {
    /// Takes `levels` through all bins.
    pub fn run(
        &self,
        mut q: Point,
        z: &mut [f32],
        duals: &mut [Vec<f32>; 3],
        levels: &impl Levels,
    ) -> Moved {
        let bins = self.shape.bins;
        let blocks = match self.is_coupled {
            true => (2 * rayon::current_num_threads()).min(bins / (2 * self.steps + 2)),
            // Some may take far longer than others, which are dark.
            false => bins,
        };
        let blocks = blocks.max(1);
        let borders: Vec<usize> = (0..=blocks).map(|i| i * bins / blocks).collect();
        let slabs = self.slabs(&borders, &mut q, z, duals, true);
        let done = slabs.into_par_iter().flat_map_iter(|mut slab| {
            self.climb(&mut slab, levels);
            slab.moved
        });
        let mut moved: Vec<(usize, Moved)> = done.collect();
        if self.is_coupled && blocks > 1 {
            let mut middles = vec![0];
            middles.extend((2..blocks).map(|i| (borders[i - 1] + borders[i]) / 2));
            middles.push(bins);
            let slabs = self.slabs(&middles, &mut q, z, duals, false);
            let slabs = slabs.into_par_iter().zip(&borders[1..blocks]);
            moved.par_extend(slabs.flat_map_iter(|(mut slab, &border)| {
                self.fill(&mut slab, border, levels);
                slab.moved
            }));
        }
        // Strips of a bin stay in their order.
        moved.sort_by_key(|(t, _)| *t);
        let mut sum = Moved::default();
        moved.iter().for_each(|(_, bin)| sum += *bin);
        sum
    }

    /// The rows that each level takes of a strip; at the end all have had every row, and the one behind the last.
    fn strips(&self) -> impl Iterator<Item = impl Fn(usize) -> Range<usize>> {
        let (size, end) = (self.rows_at_once, self.shape.rows + 1);
        let starts = (0..end + self.steps).step_by(size);
        starts.map(move |start| {
            move |level| {
                let row = |y: usize| y.saturating_sub(level).min(end);
                row(start)..row(start + size)
            }
        })
    }

    /// All that can be done without the neighbours of `slab`: level `l` reads what level `l − 1` has made of a
    /// bin and of its neighbours, and writes over it.
    fn climb(&self, slab: &mut Slab, levels: &impl Levels) {
        let Range { start, end } = slab.bins;
        if !self.is_coupled {
            for t in start..end {
                for rows in self.strips() {
                    (0..=self.steps).for_each(|level| levels.at(slab, t, level, rows(level)));
                }
            }
            return;
        }
        let (is_first, is_last) = (start == 0, end == self.shape.bins);
        for rows in self.strips() {
            for front in start..end + self.steps {
                for level in 0..=self.steps.min(front - start) {
                    let t = front - level;
                    let low = start + if is_first { 0 } else { level };
                    let high = end - if is_last { 0 } else { level };
                    let low_between = low - usize::from(!is_first && level > 0);
                    if level > 0 && (low_between..high).contains(&t) && t + 1 < self.shape.bins {
                        levels.between(slab, t, rows(level));
                    }
                    if (low..high).contains(&t) {
                        levels.at(slab, t, level, rows(level));
                    }
                }
            }
        }
    }

    /// What [`Self::climb`] has left on both sides of `border`.
    fn fill(&self, slab: &mut Slab, border: usize, levels: &impl Levels) {
        for rows in self.strips() {
            for level in 1..=self.steps {
                (border - level..border + level - 1)
                    .for_each(|t| levels.between(slab, t, rows(level)));
                (border - level..border + level)
                    .for_each(|t| levels.at(slab, t, level, rows(level)));
            }
        }
    }

    fn slabs<'a>(
        &self,
        cuts: &[usize],
        q: &'a mut Point,
        z: &'a mut [f32],
        duals: &'a mut [Vec<f32>; 3],
        is_shared: bool,
    ) -> Vec<Slab<'a>> {
        let mut q = match q {
            Point::Kept(q) => Point::Kept(q),
            Point::Reduced(q, last) => Point::Reduced(q, last),
        };
        let [mut py, mut px, mut time] = duals.each_mut().map(Vec::as_mut_slice);
        let (mut z, mut before) = (z, None);
        let mut slabs = Vec::new();
        for (start, end) in cuts.iter().copied().zip(cuts[1..].iter().copied()) {
            let size = (end - start) * self.shape.pixels();
            let mut own = split(&mut time, size);
            let mut last = None;
            if is_shared && end < self.shape.bins && !own.is_empty() {
                let (first, shared) = own.split_at_mut(size - self.shape.pixels());
                (own, last) = (first, Some(&*shared));
            }
            slabs.push(Slab {
                bins: start..end,
                pixels: self.shape.pixels(),
                q: match &mut q {
                    Point::Kept(q) => {
                        let (own, rest) = q.split_at(size);
                        *q = rest;
                        Point::Kept(own)
                    }
                    Point::Reduced(q, last) => {
                        let (own, rest) = last.split_at(size);
                        *last = rest;
                        Point::Reduced(split(q, size), own)
                    }
                },
                z: split(&mut z, size),
                space: [split(&mut py, size), split(&mut px, size)],
                time: own,
                last,
                before: std::mem::replace(&mut before, last),
                moved: Vec::new(),
            });
        }
        slabs
    }
}

/// The first `size` of `values`, which goes on behind them; nothing of nothing.
fn split<'a>(values: &mut &'a mut [f32], size: usize) -> &'a mut [f32] {
    let all = std::mem::take(values);
    let (first, rest) = all.split_at_mut(size.min(all.len()));
    *values = rest;
    first
}
