//! Total variation in space and time as one.
//!
//! ```text
//! isotropic (tv3d):          R(v) = Σ √((∂y v)² + (∂x v)² + (∂t v)²)
//! anisotropic (tv3d-aniso):  R(v) = Σ |∂y v| + |∂x v| + |∂t v|
//! ```
//!
//! with forward differences that are zero at the last row, column and bin (Neumann
//! boundary). For things that move: an edge that travels costs once what it costs in
//! space and in time apart with `tv+tdiff`. The anisotropic form prefers edges along
//! the axes, and is cheaper for light that is switched on and off.

use super::dual::{self, DualTerm};
use super::term::{Coupling, TermSpec};
use rayon::prelude::*;
use rowburst_core::Shape;
use rowburst_core::vecmath::simd;
use std::ops::Range;

/// The term `tv3d`.
pub const TV3D: TermSpec = TermSpec {
    coupling: Coupling::Neighbours,
    ..TermSpec::dual("tv3d", "moving shapes", |shape| {
        Box::new(Variation3d::new(shape, Isotropy::Isotropic))
    })
};

/// The term `tv3d-aniso`.
pub const TV3D_ANISO: TermSpec = TermSpec {
    coupling: Coupling::Neighbours,
    excludes: Some((
        "tv3d",
        "tv3d and tv3d-aniso are two forms of one term: use one of them",
    )),
    ..TermSpec::dual("tv3d-aniso", "boxy or blinking shapes", |shape| {
        Box::new(Variation3d::new(shape, Isotropy::Anisotropic))
    })
};

/// How the three differences at a voxel are put together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Isotropy {
    /// The length of the gradient.
    Isotropic,
    /// The sum of its absolute parts.
    Anisotropic,
}

/// Total variation of a video over its three axes.
#[derive(Clone)]
pub struct Variation3d {
    shape: Shape,
    isotropy: Isotropy,
    dual_y: Vec<f32>,
    dual_x: Vec<f32>,
    dual_t: Vec<f32>,
}

impl Variation3d {
    /// The term with its dual at zero.
    pub fn new(shape: Shape, isotropy: Isotropy) -> Self {
        let zero = || vec![0.0; shape.voxels()];
        Self {
            shape,
            isotropy,
            dual_y: zero(),
            dual_x: zero(),
            dual_t: zero(),
        }
    }

    /// `z[t]` and `z[t+1]`; twice the last bin, whose temporal difference is zero.
    fn now_and_next<'a>(&self, z: &'a [f32], t: usize) -> (&'a [f32], &'a [f32]) {
        let pixels = self.shape.pixels();
        let next = (t + 1).min(self.shape.bins - 1);
        (
            &z[t * pixels..(t + 1) * pixels],
            &z[next * pixels..(next + 1) * pixels],
        )
    }
}

/// A line of a bin, the one below it, and the same line of the next bin; itself, where there is none.
struct Line<'a> {
    now: &'a [f32],
    below: &'a [f32],
    next: &'a [f32],
}

/// Pixels that are worked on together.
const PART: usize = 16;

impl<'a> Line<'a> {
    #[inline(always)]
    fn new(now: &'a [f32], next: &'a [f32], columns: usize, y: usize) -> Self {
        let rows = now.len() / columns;
        let line = |y: usize| y * columns..(y + 1) * columns;
        Self {
            now: &now[line(y)],
            below: &now[line((y + 1).min(rows - 1))],
            next: &next[line(y)],
        }
    }

    /// Calls `work(x, differences)` for parts of the line, with the differences towards below, right and the next bin
    /// from column `x` on; behind the line they are zero.
    #[inline(always)]
    fn parts(&self, mut work: impl FnMut(usize, [[f32; PART]; 3])) {
        let columns = self.now.len();
        let inner = columns - 1;
        let whole = inner - inner % PART;
        for x in (0..whole).step_by(PART) {
            let (now, right) = (part(self.now, x), part(self.now, x + 1));
            let (below, next) = (part(self.below, x), part(self.next, x));
            work(
                x,
                [less(&below, &now), less(&right, &now), less(&next, &now)],
            );
        }
        // The last column has nothing beside it.
        let mut rest = [[0.0; PART]; 3];
        for (i, x) in (whole..columns).enumerate() {
            let v = self.now[x];
            let right = self.now[(x + 1).min(inner)];
            rest[0][i] = self.below[x] - v;
            rest[1][i] = right - v;
            rest[2][i] = self.next[x] - v;
        }
        work(whole, rest);
    }
}

#[inline(always)]
fn part(of: &[f32], x: usize) -> [f32; PART] {
    of[x..x + PART].try_into().expect("so many")
}

#[inline(always)]
fn less(a: &[f32; PART], b: &[f32; PART]) -> [f32; PART] {
    let mut less = *a;
    less.iter_mut().zip(b).for_each(|(a, b)| *a -= b);
    less
}

#[inline(always)]
fn size(isotropy: Isotropy, y: f32, x: f32, t: f32) -> f32 {
    match isotropy {
        Isotropy::Isotropic => (y * y + x * x + t * t).sqrt(),
        Isotropy::Anisotropic => y.abs() + x.abs() + t.abs(),
    }
}

/// Adds the sizes of some differences, lane by lane.
#[inline(always)]
fn add_sizes(sums: &mut [f32; PART], isotropy: Isotropy, [y, x, t]: &[[f32; PART]; 3]) {
    for i in 0..PART {
        sums[i] += size(isotropy, y[i], x[i], t[i]);
    }
}

/// The duals of some voxels, a step along their differences and back into the ball.
#[inline(always)]
fn step_part(
    (py, px, pt): (&mut [f32], &mut [f32], &mut [f32]),
    at: Range<usize>,
    ([y, x, t], isotropy, (step, radius)): (&[[f32; PART]; 3], Isotropy, (f32, f32)),
) {
    let count = at.len();
    let (py, px, pt) = (&mut py[at.clone()], &mut px[at.clone()], &mut pt[at]);
    let (y, x, t) = (&y[..count], &x[..count], &t[..count]);
    for i in 0..count {
        let moved = (
            py[i] + step * y[i],
            px[i] + step * x[i],
            pt[i] + step * t[i],
        );
        (py[i], px[i], pt[i]) = project(isotropy, radius, moved);
    }
}

#[inline(always)]
fn project(isotropy: Isotropy, radius: f32, (y, x, t): (f32, f32, f32)) -> (f32, f32, f32) {
    match isotropy {
        Isotropy::Isotropic => {
            let shrink = radius / radius.max((y * y + x * x + t * t).sqrt());
            (y * shrink, x * shrink, t * shrink)
        }
        Isotropy::Anisotropic => {
            let clamp = |p: f32| p.max(-radius).min(radius);
            (clamp(y), clamp(x), clamp(t))
        }
    }
}

/// `z += a·p`.
#[inline(always)]
fn add(z: &mut [f32], p: &[f32], a: f32) {
    for (z, p) in z.iter_mut().zip(p) {
        *z += a * p;
    }
}

/// `z −= Dᵀp` over one bin: `−(Dᵀp)[y,x] = py[y,x] − py[y−1,x] + px[y,x] − px[y,x−1]`.
#[inline(always)]
fn add_divergence(z: &mut [f32], py: &[f32], px: &[f32], columns: usize) {
    for (y, z) in z.chunks_exact_mut(columns).enumerate() {
        let line = y * columns..(y + 1) * columns;
        add(z, &py[line.clone()], 1.0);
        if y > 0 {
            add(z, &py[line.start - columns..line.start], -1.0);
        }
        add(z, &px[line.clone()], 1.0);
        add(&mut z[1..], &px[line], -1.0);
    }
}

impl DualTerm for Variation3d {
    /// `‖D‖² ≤ 4` for each axis.
    fn norm_squared(&self) -> f64 {
        12.0
    }

    fn subtract_adjoint(&self, z: &mut [f32]) {
        let pixels = self.shape.pixels();
        z.par_chunks_exact_mut(pixels)
            .enumerate()
            .for_each(|(t, z)| {
                let bin = t * pixels..(t + 1) * pixels;
                let (py, px) = (&self.dual_y[bin.clone()], &self.dual_x[bin.clone()]);
                simd(
                    #[inline(always)]
                    || {
                        add_divergence(z, py, px, self.shape.columns);
                        add(z, &self.dual_t[bin.clone()], 1.0);
                        if t > 0 {
                            add(z, &self.dual_t[bin.start - pixels..bin.start], -1.0);
                        }
                    },
                );
            });
    }

    fn step(&mut self, z: &[f32], step: f32, radius: f32) -> f64 {
        let Shape {
            bins,
            rows,
            columns,
        } = self.shape;
        let (pixels, isotropy) = (rows * columns, self.isotropy);
        let duals = self
            .dual_y
            .par_chunks_exact_mut(pixels)
            .zip(self.dual_x.par_chunks_exact_mut(pixels))
            .zip(self.dual_t.par_chunks_exact_mut(pixels));
        let sums: Vec<f64> = duals
            .enumerate()
            .map(|(t, ((py, px), pt))| {
                let next = (t + 1).min(bins - 1);
                let now = &z[t * pixels..(t + 1) * pixels];
                let next = &z[next * pixels..(next + 1) * pixels];
                let mut sum = 0.0f64;
                for y in 0..rows {
                    let (line, at) = (Line::new(now, next, columns, y), y * columns);
                    let sums = simd(
                        #[inline(always)]
                        || {
                            let mut sums = [0.0f32; PART];
                            line.parts(
                                #[inline(always)]
                                |x, differences| {
                                    add_sizes(&mut sums, isotropy, &differences);
                                    let p = (&mut *py, &mut *px, &mut *pt);
                                    let of = (&differences, isotropy, (step, radius));
                                    // Compiled for all of a part, and for the rest.
                                    if x + PART <= columns {
                                        step_part(p, at + x..at + x + PART, of);
                                    } else {
                                        step_part(p, at + x..at + columns, of);
                                    }
                                },
                            );
                            sums
                        },
                    );
                    sum += sums.iter().map(|&s| f64::from(s)).sum::<f64>();
                }
                sum
            })
            .collect();
        sums.iter().sum()
    }

    fn rescale(&mut self, factor: f32) {
        for p in [&mut self.dual_y, &mut self.dual_x, &mut self.dual_t] {
            dual::scale(p, factor);
        }
    }

    fn value(&self, z: &[f32]) -> f64 {
        let columns = self.shape.columns;
        let sums: Vec<f64> = (0..self.shape.bins)
            .into_par_iter()
            .map(|t| {
                let (now, next) = self.now_and_next(z, t);
                let mut sum = 0.0;
                for y in 0..self.shape.rows {
                    let line = Line::new(now, next, columns, y);
                    let sums = simd(
                        #[inline(always)]
                        || {
                            let mut sums = [0.0f32; PART];
                            line.parts(
                                #[inline(always)]
                                |_, differences| add_sizes(&mut sums, self.isotropy, &differences),
                            );
                            sums
                        },
                    );
                    sum += sums.iter().map(|&s| f64::from(s)).sum::<f64>();
                }
                sum
            })
            .collect();
        sums.iter().sum()
    }

    /// The active voxels that differ from the ones left, above and before: the number of
    /// plateaus in space and time (Tibshirani & Taylor 2012).
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        let (pixels, columns) = (self.shape.pixels(), self.shape.columns);
        let is_free = |i: usize| {
            let differs = |at: usize| (z[i] - z[at]).abs() > tolerance;
            let in_bin = i % pixels;
            z[i] > tolerance
                && (in_bin.is_multiple_of(columns) || differs(i - 1))
                && (in_bin < columns || differs(i - columns))
                && (i < pixels || differs(i - pixels))
        };
        (0..z.len()).into_par_iter().filter(|&i| is_free(i)).count() as f64
    }
}
