//! Temporal blocking of steps that couple neighbouring bins (docs/design/013).
//!
//! A level of a dual prox has two parts. It computes the primal point of every bin, from the duals over time on both
//! sides of the bin. Then it steps the dual between every two bins, from both primal points. If one level follows the
//! other over the whole video, each of them reads the video from memory.
//!
//! Here the levels advance together through one strip of a few rows after the other. Level `l` stays `l` bins and `l`
//! rows behind level 0, so it finds the results of level `l − 1` in the cache. Where bins are not coupled, each bin
//! takes all levels by itself.
//!
//! Each thread takes a tile of bins. In the interior of a tile level `l` ends `l` bins before a border to another
//! tile. The seam, the few bins around each border, is done after all interiors. With two steps the bins `i` of the
//! interiors and `s` of the seam around the border `|` are
//!
//! ```text
//! level 2   i i s s|s s i i
//! level 1   i i i s|s i i i
//! level 0   i i i i|i i i i
//! ```
//!
//! Every voxel sees the same steps in the same order for any number of tiles, so the bits do not depend on the number
//! of threads.

use super::bin::Dual;
use rayon::prelude::*;
use rowburst_core::Shape;
use std::ops::Range;

/// The levels `0..=last_level` over a video. Each level but the last takes a dual step.
pub(super) struct Wavefront {
    pub shape: Shape,
    /// Rows of a strip.
    pub rows_per_strip: usize,
    /// The dual has taken `l` steps at level `l`, so this is the number of steps.
    pub last_level: usize,
    /// Whether bins depend on their neighbours; if not, each bin is done by itself.
    pub is_coupled: bool,
}

/// Neighbouring bins of all arrays that the steps read and write.
pub(super) struct Tile<'a> {
    bins: Range<usize>,
    pixels: usize,
    q: &'a [f32],
    z: &'a mut [f32],
    /// Spatial duals along y and x; empty if the prior has none.
    space: [&'a mut [Dual]; 2],
    /// Dual over time from each bin to the next, without the one in `last`; empty if the prior has none.
    time: &'a mut [Dual],
    /// Dual over time of the last bin, read-only, where the next tile reads it as well.
    last: Option<&'a [Dual]>,
    /// Dual over time of the bin before the first, read-only.
    before: Option<&'a [Dual]>,
}

/// The duals along y and along x.
pub(super) type SpatialDuals<'s> = (&'s mut [Dual], &'s mut [Dual]);

/// A bin of a [`Tile`].
pub(super) struct BinView<'s> {
    pub z: &'s mut [f32],
    pub q: &'s [f32],
    pub space: Option<SpatialDuals<'s>>,
    /// Dual over time from this bin to the next.
    pub time: Option<&'s [Dual]>,
    pub previous: Previous<'s>,
}

/// The dual over time from the previous bin.
pub(super) enum Previous<'s> {
    /// There is none: the bin is the first, or the prior has no such dual.
    None,
    /// It is only read.
    Read(&'s [Dual]),
    /// It is to step; with the previous bin's primal point.
    Update(&'s mut [Dual], &'s [f32]),
}

impl Tile<'_> {
    /// A view of bin `t`. If `updates_previous_dual`, the dual over time from the previous bin is to step.
    pub fn bin(&mut self, t: usize, updates_previous_dual: bool) -> BinView<'_> {
        let at = self.range_of(t);
        let [py, px] = &mut self.space;
        let space = py.get_mut(at.clone()).zip(px.get_mut(at.clone()));
        let (z_before, z) = self.z.split_at_mut(at.start);
        let (p_before, p) = self.time.split_at_mut(at.start.min(self.time.len()));
        let time = p.get(..self.pixels).or(self.last);
        let previous = if updates_previous_dual {
            let start = at.start - self.pixels;
            Previous::Update(&mut p_before[start..], &z_before[start..])
        } else {
            let dual = if at.start == 0 {
                self.before
            } else {
                let p = p_before.get(at.start - self.pixels..);
                p.filter(|p| !p.is_empty())
            };
            dual.map_or(Previous::None, Previous::Read)
        };
        BinView {
            q: &self.q[at.clone()],
            z: &mut z[..self.pixels],
            space,
            time,
            previous,
        }
    }

    /// The dual over time from bin `t` to the next, and the primal points of both.
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

/// The computation at one bin and level.
///
/// The range `rows` may include one row past the last, since spatial duals step one row behind the primal point.
pub(super) trait Stencil: Sync {
    /// Updates `rows` of bin `t` at `level`.
    ///
    /// If `updates_previous_dual`, it also takes the step to the next level of the dual over time from the previous
    /// bin.
    fn update_bin(
        &self,
        tile: &mut Tile,
        t: usize,
        level: usize,
        rows: Range<usize>,
        updates_previous_dual: bool,
    );
    /// Steps `rows` of the dual over time from bin `t` to the next.
    fn step_time_dual(&self, tile: &mut Tile, t: usize, rows: Range<usize>);
}

impl Wavefront {
    /// Runs all levels of `stencil` over all bins.
    pub fn run(
        &self,
        q: &[f32],
        z: &mut [f32],
        duals: &mut [Vec<Dual>; 3],
        stencil: &impl Stencil,
    ) {
        let bins = self.shape.bins;
        // Without coupling a tile is one bin, since active bins take far longer than dark ones.
        let tile_count = if self.is_coupled {
            rayon::current_num_threads().min(bins / (2 * self.last_level + 2))
        } else {
            bins
        };
        let tile_count = tile_count.max(1);
        let seams: Vec<usize> = (0..=tile_count).map(|i| i * bins / tile_count).collect();
        let tiles = self.tiles(&seams, q, z, duals, true);
        let tiles = tiles.into_par_iter();
        tiles.for_each(|mut tile| self.run_interior(&mut tile, stencil));
        if self.is_coupled && tile_count > 1 {
            let mut seam_tiles = vec![0];
            seam_tiles.extend((2..tile_count).map(|i| (seams[i - 1] + seams[i]) / 2));
            seam_tiles.push(bins);
            let tiles = self.tiles(&seam_tiles, q, z, duals, false);
            let tiles = tiles.into_par_iter().zip(&seams[1..tile_count]);
            tiles.for_each(|(mut tile, &seam)| self.run_seam(&mut tile, seam, stencil));
        }
    }

    /// For each strip, the rows of each level. In the end every level has had all rows and one past the last.
    fn strips(&self) -> impl Iterator<Item = impl Fn(usize) -> Range<usize>> {
        let (size, end) = (self.rows_per_strip, self.shape.rows + 1);
        let starts = (0..end + self.last_level).step_by(size);
        starts.map(move |start| {
            move |level| {
                let row = |y: usize| y.saturating_sub(level).min(end);
                row(start)..row(start + size)
            }
        })
    }

    /// Runs the levels as far as they do not depend on neighbouring tiles.
    ///
    /// Level `l` reads the results of level `l − 1` in a bin and its neighbours, and overwrites them.
    fn run_interior(&self, tile: &mut Tile, stencil: &impl Stencil) {
        let Range { start, end } = tile.bins;
        if !self.is_coupled {
            for t in start..end {
                for rows in self.strips() {
                    let each = 0..=self.last_level;
                    each.for_each(|level| stencil.update_bin(tile, t, level, rows(level), false));
                }
            }
            return;
        }
        let (is_first, is_last) = (start == 0, end == self.shape.bins);
        for rows in self.strips() {
            for front in start..end + self.last_level {
                for level in 0..=self.last_level.min(front - start) {
                    let t = front - level;
                    let low = start + if is_first { 0 } else { level };
                    let high = end - if is_last { 0 } else { level };
                    if (low..high).contains(&t) {
                        let updates_previous_dual = t > low && level < self.last_level;
                        stencil.update_bin(tile, t, level, rows(level), updates_previous_dual);
                    }
                }
            }
        }
    }

    /// Runs the steps that [`Self::run_interior`] has left on both sides of `seam`.
    fn run_seam(&self, tile: &mut Tile, seam: usize, stencil: &impl Stencil) {
        for rows in self.strips() {
            for level in 1..=self.last_level {
                // This dual lies between the seam and the interior; neither has taken its step to this level.
                stencil.step_time_dual(tile, seam + level - 2, rows(level));
                for t in seam - level..seam + level {
                    stencil.update_bin(tile, t, level, rows(level), level < self.last_level);
                }
            }
        }
    }

    /// The tiles between neighbouring `boundaries`; if `is_shared`, two tiles share the dual over time at their
    /// border.
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

/// Splits the first `size` elements off `values`; all of them if there are fewer.
fn split<'a, T>(values: &mut &'a mut [T], size: usize) -> &'a mut [T] {
    let all = std::mem::take(values);
    let (first, rest) = all.split_at_mut(size.min(all.len()));
    *values = rest;
    first
}
