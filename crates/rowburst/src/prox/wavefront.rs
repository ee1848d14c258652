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

use super::variation::Dual;
use crate::Shape;
use rayon::prelude::*;
use std::ops::Range;

/// Levels `0..=steps` over the bins; each brings the duals before the bins to the next one.
pub(super) struct Wavefront {
    pub shape: Shape,
    /// Rows of a strip.
    pub rows_per_strip: usize,
    pub steps: usize,
    /// Whether bins see their neighbours; else each is done by itself.
    pub is_coupled: bool,
}

/// Some neighbouring bins of everything that the steps read and write.
pub(super) struct Tile<'a> {
    bins: Range<usize>,
    pixels: usize,
    q: &'a [f32],
    z: &'a mut [f32],
    /// Two duals in space; empty where there is none.
    space: [&'a mut [Dual]; 2],
    /// The dual over time from each bin to the next; of the last bin, which a neighbour reads
    /// as well, and of the bin before the first it is shared.
    time: &'a mut [Dual],
    last: Option<&'a [Dual]>,
    before: Option<&'a [Dual]>,
}

/// The dual along y and along x.
pub(super) type SpatialDuals<'s> = (&'s mut [Dual], &'s mut [Dual]);

/// A bin of a [`Tile`].
pub(super) struct BinView<'s> {
    pub z: &'s mut [f32],
    pub q: &'s [f32],
    pub space: Option<SpatialDuals<'s>>,
    /// The dual over time of it, and of the bin before, unless that is to step.
    pub time: Option<&'s [Dual]>,
    pub before: Option<&'s [Dual]>,
    /// Else that, and the bin before.
    pub to_step: Option<(&'s mut [Dual], &'s [f32])>,
}

impl Tile<'_> {
    /// Bin `t`, where the dual over time before it is to step if `steps_before`.
    pub fn bin(&mut self, t: usize, steps_before: bool) -> BinView<'_> {
        let at = self.range_of(t);
        let [py, px] = &mut self.space;
        let space = py.get_mut(at.clone()).zip(px.get_mut(at.clone()));
        // What is before the bin, and from it on.
        let (z_before, z) = self.z.split_at_mut(at.start);
        let (p_before, p) = self.time.split_at_mut(at.start.min(self.time.len()));
        let time = p.get(..self.pixels).or(self.last);
        let (mut before, mut to_step) = (None, None);
        if steps_before {
            let start = at.start - self.pixels;
            to_step = Some((&mut p_before[start..], &z_before[start..]));
        } else if at.start == 0 {
            before = self.before;
        } else {
            let p = p_before.get(at.start - self.pixels..);
            before = p.filter(|p| !p.is_empty());
        }
        BinView {
            q: &self.q[at.clone()],
            z: &mut z[..self.pixels],
            space,
            time,
            before,
            to_step,
        }
    }

    /// The dual over time from bin `t` to the next, and the two bins.
    pub fn time_step(&mut self, t: usize) -> (&mut [Dual], (&[f32], &[f32])) {
        let (now, next) = (self.range_of(t), self.range_of(t + 1));
        let p = &mut self.time[now.clone()];
        let z = &*self.z;
        (p, (&z[now], &z[next]))
    }

    fn range_of(&self, t: usize) -> Range<usize> {
        let at = t - self.bins.start;
        at * self.pixels..(at + 1) * self.pixels
    }
}

/// What is done to some rows of a bin at a level, and if `steps_before` to the dual over time before the bin, which is then
/// at the next level; or to that of bin `t` alone. Rows may end one behind the last: what looks at the row above has its
/// turn there.
pub(super) trait Stencil: Sync {
    fn update_bin(
        &self,
        tile: &mut Tile,
        t: usize,
        level: usize,
        rows: Range<usize>,
        steps_before: bool,
    );
    fn step_time_dual(&self, tile: &mut Tile, t: usize, rows: Range<usize>);
}

impl Wavefront {
    /// Takes `stencil` through all bins.
    pub fn run(
        &self,
        q: &[f32],
        z: &mut [f32],
        duals: &mut [Vec<Dual>; 3],
        stencil: &impl Stencil,
    ) {
        let bins = self.shape.bins;
        let blocks = match self.is_coupled {
            true => rayon::current_num_threads().min(bins / (2 * self.steps + 2)),
            // Some may take far longer than others, which are dark.
            false => bins,
        };
        let blocks = blocks.max(1);
        let seams: Vec<usize> = (0..=blocks).map(|i| i * bins / blocks).collect();
        let tiles = self.tiles(&seams, q, z, duals, true);
        let tiles = tiles.into_par_iter();
        tiles.for_each(|mut tile| self.run_interior(&mut tile, stencil));
        if self.is_coupled && blocks > 1 {
            let mut seam_tiles = vec![0];
            seam_tiles.extend((2..blocks).map(|i| (seams[i - 1] + seams[i]) / 2));
            seam_tiles.push(bins);
            let tiles = self.tiles(&seam_tiles, q, z, duals, false);
            let tiles = tiles.into_par_iter().zip(&seams[1..blocks]);
            tiles.for_each(|(mut tile, &seam)| self.run_seam(&mut tile, seam, stencil));
        }
    }

    /// The rows that each level takes of a strip; at the end all have had every row, and the one behind the last.
    fn strips(&self) -> impl Iterator<Item = impl Fn(usize) -> Range<usize>> {
        let (size, end) = (self.rows_per_strip, self.shape.rows + 1);
        let starts = (0..end + self.steps).step_by(size);
        starts.map(move |start| {
            move |level| {
                let row = |y: usize| y.saturating_sub(level).min(end);
                row(start)..row(start + size)
            }
        })
    }

    /// All that can be done without the neighbours of `tile`: level `l` reads what level `l − 1` has made of a
    /// bin and of its neighbours, and writes over it.
    fn run_interior(&self, tile: &mut Tile, stencil: &impl Stencil) {
        let Range { start, end } = tile.bins;
        if !self.is_coupled {
            for t in start..end {
                for rows in self.strips() {
                    let each = 0..=self.steps;
                    each.for_each(|level| stencil.update_bin(tile, t, level, rows(level), false));
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
                    if (low..high).contains(&t) {
                        let steps_before = t > low && level < self.steps;
                        stencil.update_bin(tile, t, level, rows(level), steps_before);
                    }
                }
            }
        }
    }

    /// What [`Self::run_interior`] has left on both sides of `seam`.
    fn run_seam(&self, tile: &mut Tile, seam: usize, stencil: &impl Stencil) {
        for rows in self.strips() {
            for level in 1..=self.steps {
                // Behind it is a bin that its block has brought to the level before.
                stencil.step_time_dual(tile, seam + level - 2, rows(level));
                for t in seam - level..seam + level {
                    stencil.update_bin(tile, t, level, rows(level), level < self.steps);
                }
            }
        }
    }

    fn tiles<'a>(
        &self,
        boundaries: &[usize],
        mut q: &'a [f32],
        z: &'a mut [f32],
        duals: &'a mut [Vec<Dual>; 3],
        is_shared: bool,
    ) -> Vec<Tile<'a>> {
        let [mut py, mut px, mut time] = duals.each_mut().map(Vec::as_mut_slice);
        let (mut z, mut before) = (z, None);
        let mut tiles = Vec::new();
        for (start, end) in boundaries
            .iter()
            .copied()
            .zip(boundaries[1..].iter().copied())
        {
            let size = (end - start) * self.shape.pixels();
            let mut own = split(&mut time, size);
            let mut last = None;
            if is_shared && end < self.shape.bins && !own.is_empty() {
                let (first, shared) = own.split_at_mut(size - self.shape.pixels());
                (own, last) = (first, Some(&*shared));
            }
            tiles.push(Tile {
                bins: start..end,
                pixels: self.shape.pixels(),
                q: q.split_off(..size).expect("as long as the video"),
                z: split(&mut z, size),
                space: [split(&mut py, size), split(&mut px, size)],
                time: own,
                last,
                before: std::mem::replace(&mut before, last),
            });
        }
        tiles
    }
}

/// The first `size` of `values`, which goes on behind them; nothing of nothing.
fn split<'a, T>(values: &mut &'a mut [T], size: usize) -> &'a mut [T] {
    let all = std::mem::take(values);
    let (first, rest) = all.split_at_mut(size.min(all.len()));
    *values = rest;
    first
}
