//! The forward model `b = A v` of a rolling-shutter camera behind a diffuser.
//!
//! ```text
//! b[r, x] = Σ_j w[r, j] Σ_{y',x'} v[j, y', x'] · p[r − sy(y'), x − sx(x')]
//! ```
//!
//! (Eqs. 1–4), with `sy(y') = y' − oy`, `sx(x') = x' − ox` the position of a field
//! pixel on the sensor, and no wrap-around. Where the PSF changes over the field
//! (`PatchSet`), `p` is `Σ_c a_c(y', x') p_c`: the light of the field is shared out among
//! the layers `a_c v`, and each is convolved with its own PSF. The row-time weights act through the
//! instant at which a row is read, `w[r, j] = w_{k[r]}[j]`, so `A = S·T`: `T`
//! integrates the video over the exposure of each instant, and `S` convolves each
//! instant's light and keeps the rows that are read then.

mod engine;
pub(crate) mod gram;
mod planar;
mod rowwise;
#[cfg(test)]
mod tests;

use crate::linop::{LinearOperator, Scalar, WritePart, write_parts};
use crate::{Camera, PatchSet, Psf, Shape, Support, TimeGrid};
use engine::{Engine, Geometry};
use planar::Planar;
use rayon::prelude::*;
use std::borrow::Cow;

/// The operator `A`: from a video `[t, y, x]` to a frame `[y, x]`.
///
/// Adjoint: exact, `Aᵀ = Tᵀ Sᵀ`. Cost: for each instant one short complex FFT per
/// two field rows, and a multiply–add over the field for each row that is read; the
/// rows that are not read are never computed. Where an instant reads many rows
/// (`global`), 2-D FFTs take over, whichever needs less arithmetic. All that once for
/// each PSF that a pixel's light is shared out among.
pub struct RollingShutter<T: Scalar = f32> {
    video: Shape,
    time: TimeGrid,
    geometry: Geometry,
    frame_rows: usize,
    /// The sensor's rows that each instant reads, and where they are in the frame.
    rows_of: Vec<Vec<usize>>,
    places_of: Vec<Vec<usize>>,
    layers: Vec<Layer<T>>,
    /// Mean of `|P̂|²` over the field at each frequency of a plane; empty where rows are
    /// convolved one by one.
    plane_power: Vec<f32>,
}

/// A PSF with its part of the field.
struct Layer<T: Scalar> {
    psf: Psf,
    /// `a_c` of every pixel of the field; `None`: 1.
    share: Option<Vec<f32>>,
    engine: Engine<T>,
}

/// Work space of one thread.
struct Scratch<T> {
    engine: engine::Scratch<T>,
    /// Light of the field, and values of the rows, of one of several layers.
    light: Vec<T>,
    values: Vec<T>,
}

impl RollingShutter {
    /// The operator of `camera` behind a diffuser with one PSF (`&Psf`) or with one that
    /// changes over the field (`&PatchSet`), in `f32`.
    pub fn new(camera: &Camera, psf: impl Into<PatchSet>) -> Self {
        Self::in_precision(camera, psf)
    }

    /// `P Aᵀ`, with `P` the projection onto `support`: rows without a place of it cost nothing.
    ///
    /// # Panics
    /// If a length does not match.
    pub fn adjoint_on(&self, frame: &[f32], support: &Support, video: &mut [f32]) {
        self.adjoint_of(frame, Some(support), video);
        support.apply(video);
    }
}

impl<T: Scalar> RollingShutter<T> {
    /// The operator of `camera` behind a diffuser with one PSF (`&Psf`) or with one that
    /// changes over the field (`&PatchSet`).
    pub fn in_precision(camera: &Camera, psf: impl Into<PatchSet>) -> Self {
        let time = camera.time().clone();
        let mut rows_of = vec![Vec::new(); time.instants().len()];
        let mut places_of = rows_of.clone();
        let rows = camera.instants().iter().zip(camera.sensor_rows());
        for (place, (&instant, row)) in rows.enumerate() {
            rows_of[instant].push(row);
            places_of[instant].push(place);
        }
        let geometry = Geometry::new(camera);
        let layers = layers_of(psf.into(), &geometry, &rows_of);
        Self {
            video: camera.video_shape(),
            time,
            plane_power: plane_power(&layers),
            geometry,
            frame_rows: camera.rows(),
            rows_of,
            places_of,
            layers,
        }
    }

    /// Shape of the video.
    pub fn video_shape(&self) -> Shape {
        self.video
    }

    /// Rows and columns of the frame.
    pub fn frame_shape(&self) -> (usize, usize) {
        (self.frame_rows, self.geometry.columns)
    }

    /// The rows of the sensor that each instant reads.
    pub fn rows_of_instants(&self) -> &[Vec<usize>] {
        &self.rows_of
    }

    /// The time axis of the video.
    pub fn time(&self) -> &TimeGrid {
        &self.time
    }

    /// An approximate `(A Aᵀ + ρI)⁻¹ r` for operators that convolve whole planes: as if
    /// the sensor had no edge, where it is a division by `|P̂|² + ρ` (the mean over the
    /// field) at each spatial frequency. Symmetric and positive definite. `None` where rows are convolved one
    /// by one.
    pub fn circulant_inverse(&self, r: &[T], rho: f64) -> Option<Vec<T>> {
        let Engine::Planar(planar) = &self.layers[0].engine else {
            return None;
        };
        let columns = self.geometry.columns;
        let mut scratch = planar.scratch();
        let mut out = vec![T::zero(); r.len()];
        let read = self.rows_of.iter().zip(&self.places_of);
        for ((rows, places), run) in read.zip(self.time.instants()) {
            let values = lines_of(r, places, columns);
            let weight: f64 = run.weights.iter().map(|w| w * w).sum();
            let mut divided = vec![T::zero(); values.len()];
            let power = (self.plane_power.as_slice(), weight);
            planar.divide(&values, rows, power, rho, &mut divided, &mut scratch);
            for (&place, values) in places.iter().zip(divided.chunks_exact(columns)) {
                out[place * columns..(place + 1) * columns].copy_from_slice(values);
            }
        }
        Some(out)
    }

    fn scratch(&self) -> Scratch<T> {
        let several = self.layers.iter().any(|layer| layer.share.is_some());
        Scratch {
            engine: self.layers[0].engine.scratch(),
            light: vec![T::zero(); if several { self.video.pixels() } else { 0 }],
            values: Vec::new(),
        }
    }

    /// `values[i, x]`: row `rows[i]` of the convolved light of a field.
    fn read(&self, light: &[T], rows: &[usize], values: &mut [T], scratch: &mut Scratch<T>) {
        if let [
            Layer {
                share: None,
                engine,
                ..
            },
        ] = self.layers.as_slice()
        {
            return engine.read(light, rows, values, &mut scratch.engine);
        }
        values.fill(T::zero());
        scratch.values.resize(values.len(), T::zero());
        for layer in &self.layers {
            match &layer.share {
                None => scratch.light.copy_from_slice(light),
                Some(share) => {
                    let shared = scratch.light.iter_mut().zip(light).zip(share);
                    shared.for_each(|((s, &v), &a)| *s = v * T::from(a));
                }
            }
            let Scratch {
                engine,
                light,
                values: part,
            } = scratch;
            layer.engine.read(light, rows, part, engine);
            add_scaled(values, part, T::one());
        }
    }

    /// The adjoint of [`Self::read`]; overwrites `light`. Rows that are dark in `mask` may be
    /// anything.
    fn spread(
        &self,
        values: &[T],
        rows: &[usize],
        mask: Option<&[u8]>,
        light: &mut [T],
        scratch: &mut Scratch<T>,
    ) {
        if let [
            Layer {
                share: None,
                engine,
                ..
            },
        ] = self.layers.as_slice()
        {
            return engine.spread(values, rows, mask, light, &mut scratch.engine);
        }
        light.fill(T::zero());
        for layer in &self.layers {
            let (own, engine) = (&mut scratch.light, &mut scratch.engine);
            layer.engine.spread(values, rows, mask, own, engine);
            match &layer.share {
                None => add_scaled(light, &scratch.light, T::one()),
                Some(share) => {
                    let shared = light.iter_mut().zip(&scratch.light).zip(share);
                    shared.for_each(|((v, &s), &a)| *v += s * T::from(a));
                }
            }
        }
    }

    /// The light that instant `i` integrates: `Σ_j w_i[j] v_j`.
    fn integrate<'v>(&self, video: &'v [T], instant: usize) -> Cow<'v, [T]> {
        let run = &self.time.instants()[instant];
        let pixels = self.video.pixels();
        let bin = |j: usize| &video[j * pixels..(j + 1) * pixels];
        if run.weights == [1.0] {
            return Cow::Borrowed(bin(run.first_bin));
        }
        let mut light = vec![T::zero(); pixels];
        for (k, &weight) in run.weights.iter().enumerate() {
            add_scaled(&mut light, bin(run.first_bin + k), T::nearest(weight));
        }
        Cow::Owned(light)
    }
}

impl<T: Scalar> LinearOperator<T> for RollingShutter<T> {
    fn domain_len(&self) -> usize {
        self.video.voxels()
    }

    fn range_len(&self) -> usize {
        self.frame_rows * self.geometry.columns
    }

    fn apply(&self, video: &[T], frame: &mut [T]) {
        assert_eq!(video.len(), self.domain_len(), "length of the video");
        assert_eq!(frame.len(), self.range_len(), "length of the frame");
        let columns = self.geometry.columns;
        let read: Vec<Vec<T>> = (0..self.rows_of.len())
            .into_par_iter()
            .map_init(
                || self.scratch(),
                |scratch, instant| {
                    let rows = &self.rows_of[instant];
                    let mut values = vec![T::zero(); rows.len() * columns];
                    let light = self.integrate(video, instant);
                    self.read(&light, rows, &mut values, scratch);
                    values
                },
            )
            .collect();
        for (places, values) in self.places_of.iter().zip(&read) {
            for (&place, values) in places.iter().zip(values.chunks_exact(columns)) {
                frame[place * columns..(place + 1) * columns].copy_from_slice(values);
            }
        }
    }

    fn adjoint(&self, frame: &[T], video: &mut [T]) {
        self.adjoint_of(frame, None, video);
    }
}

impl<T: Scalar> RollingShutter<T> {
    /// Whether bin `j` is all that instant `j` integrates.
    fn has_one_bin_each(&self) -> bool {
        let instants = self.time.instants();
        self.time.bins() == instants.len() && instants.iter().all(|i| i.weights.len() == 1)
    }

    /// The light that instant `i` sends back from its rows of `frame`.
    fn spread_from(
        &self,
        frame: &[T],
        instant: usize,
        mask: Option<&[u8]>,
        light: &mut [T],
        scratch: &mut Scratch<T>,
    ) {
        let values = lines_of(frame, &self.places_of[instant], self.geometry.columns);
        self.spread(&values, &self.rows_of[instant], mask, light, scratch);
    }

    /// Calls `write(start, part, target)` for parts of `P Aᵀ frame` and of `target` that begin at `start`, with `P` the
    /// projection onto `support` (`None`: every voxel). Rows without a place of it are left out.
    ///
    /// # Panics
    /// If a length does not match.
    pub fn adjoint_each(
        &self,
        frame: &[T],
        support: Option<&Support>,
        target: &mut [T],
        write: WritePart<T>,
    ) {
        assert_eq!(frame.len(), self.range_len(), "length of the frame");
        assert_eq!(target.len(), self.domain_len(), "length of the video");
        let (pixels, columns) = (self.video.pixels(), self.video.columns);
        if !self.has_one_bin_each() {
            let mut video = vec![T::zero(); target.len()];
            self.adjoint(frame, &mut video);
            if let Some(support) = support {
                let lit = video.par_iter_mut().zip(support.mask());
                lit.for_each(|(v, lit)| *v *= T::from(f32::from(*lit)));
            }
            return write_parts(&video, target, write);
        }
        let start = || (self.scratch(), vec![T::zero(); pixels]);
        let bins = target.par_chunks_exact_mut(pixels).enumerate();
        bins.for_each_init(start, |(scratch, light), (bin, target)| {
            let first = bin * pixels;
            let mask = support.map(|s| &s.mask()[first..first + pixels]);
            self.spread_from(frame, bin, mask, light, scratch);
            let weight = T::nearest(self.time.instants()[bin].weights[0]);
            let Some(mask) = mask else {
                if weight != T::one() {
                    light.iter_mut().for_each(|v| *v *= weight);
                }
                return write(first, light, target);
            };
            let rows = light.chunks_exact_mut(columns);
            let rows = rows.zip(mask.chunks_exact(columns));
            let rows = rows.zip(target.chunks_exact_mut(columns)).enumerate();
            for (y, ((light, mask), target)) in rows {
                if mask.contains(&1) {
                    let lit = light.iter_mut().zip(mask);
                    lit.for_each(|(v, lit)| *v *= weight * T::from(f32::from(*lit)));
                    write(first + y * columns, light, target);
                }
            }
        });
    }

    /// The adjoint; rows that are dark in `support` may be anything.
    fn adjoint_of(&self, frame: &[T], support: Option<&Support>, video: &mut [T]) {
        assert_eq!(video.len(), self.domain_len(), "length of the video");
        assert_eq!(frame.len(), self.range_len(), "length of the frame");
        let pixels = self.video.pixels();
        let instants = self.time.instants();
        if self.has_one_bin_each() {
            // Bin j is instant j: no second video is needed.
            let bins = video.par_chunks_exact_mut(pixels).enumerate();
            bins.for_each_init(
                || self.scratch(),
                |scratch, (bin, light)| {
                    let mask = support.map(|s| &s.mask()[bin * pixels..(bin + 1) * pixels]);
                    self.spread_from(frame, bin, mask, light, scratch);
                    let weight = T::nearest(instants[bin].weights[0]);
                    if weight != T::one() {
                        light.iter_mut().for_each(|v| *v *= weight);
                    }
                },
            );
            return;
        }
        let mut lights = vec![T::zero(); instants.len() * pixels];
        lights
            .par_chunks_exact_mut(pixels)
            .enumerate()
            .for_each_init(
                || self.scratch(),
                |scratch, (instant, light)| {
                    self.spread_from(frame, instant, None, light, scratch);
                },
            );
        video
            .par_chunks_exact_mut(pixels)
            .enumerate()
            .for_each(|(j, bin)| {
                bin.fill(T::zero());
                for (run, light) in instants.iter().zip(lights.chunks_exact(pixels)) {
                    if (run.first_bin..run.first_bin + run.weights.len()).contains(&j) {
                        add_scaled(bin, light, T::nearest(run.weights[j - run.first_bin]));
                    }
                }
            });
    }
}

/// Some rows of a frame, one after another.
fn lines_of<T: Scalar>(frame: &[T], places: &[usize], columns: usize) -> Vec<T> {
    let lines = places
        .iter()
        .map(|&place| &frame[place * columns..(place + 1) * columns]);
    lines.flatten().copied().collect()
}

/// The layers of `set` that have a say in the field.
fn layers_of<T: Scalar>(
    set: PatchSet,
    geometry: &Geometry,
    rows_of: &[Vec<usize>],
) -> Vec<Layer<T>> {
    let engine = |psf: &Psf| Engine::cheapest(geometry, psf, rows_of);
    if let [psf] = set.psfs() {
        return vec![Layer {
            engine: engine(psf),
            psf: psf.clone(),
            share: None,
        }];
    }
    let shares = set.shares(geometry.field_rows, geometry.field_columns);
    let layers = set.psfs().iter().zip(shares);
    layers
        .filter(|(_, share)| !share.is_empty())
        .map(|(psf, share)| Layer {
            engine: engine(psf),
            psf: psf.clone(),
            share: Some(share),
        })
        .collect()
}

/// `|Σ_c a_c P̂_c|²`, its mean over the field, at each frequency of a plane.
fn plane_power<T: Scalar>(layers: &[Layer<T>]) -> Vec<f32> {
    let planes: Vec<&Planar<T>> = layers
        .iter()
        .filter_map(|layer| match &layer.engine {
            Engine::Planar(planar) => Some(planar),
            Engine::Rowwise(_) => None,
        })
        .collect();
    let mut power = Vec::new();
    for (i, a) in planes.iter().enumerate() {
        for (j, b) in planes.iter().enumerate().take(i + 1) {
            let together = match (&layers[i].share, &layers[j].share) {
                (Some(a), Some(b)) => crate::vecmath::dot(a, b) / a.len() as f64,
                _ => 1.0,
            };
            // Both orders of a pair.
            let weight = if i == j { together } else { 2.0 * together };
            a.add_power(b, weight, &mut power);
        }
    }
    power
}

fn add_scaled<T: Scalar>(sum: &mut [T], term: &[T], weight: T) {
    crate::vecmath::simd(
        #[inline(always)]
        || {
            for (s, &t) in sum.iter_mut().zip(term) {
                *s += weight * t;
            }
        },
    );
}
