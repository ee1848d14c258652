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
use engine::{AdjointJob, Engine, ForwardJob, Geometry};
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
        let copy = |_: usize, part: &[f32], video: &mut [f32]| video.copy_from_slice(part);
        let bins = video.par_chunks_mut(self.video.pixels());
        bins.for_each(|bin| bin.fill(0.0));
        self.adjoint_each(frame, Some(support), video, &copy);
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

    /// Instants that a thread works on together, so that they share what is read of the PSF's spectra where a cache does
    /// not hold all of them.
    fn batch_size(&self) -> usize {
        /// Bytes of a cache that a thread has for itself.
        const CACHE: usize = 1 << 20;
        const MAX_BATCH: usize = 8;
        match self.layers.as_slice() {
            [layer] if layer.engine.bytes() > CACHE => {
                // All threads have as many groups.
                let (instants, threads) = (self.rows_of.len(), rayon::current_num_threads());
                let rounds = instants.div_ceil(threads * MAX_BATCH);
                instants.div_ceil(threads * rounds)
            }
            _ => 1,
        }
    }

    /// Writes the values of all `fields`.
    fn read(&self, fields: &mut [ForwardJob<T>], scratch: &mut Scratch<T>) {
        if let [
            Layer {
                share: None,
                engine,
                ..
            },
        ] = self.layers.as_slice()
        {
            return engine.read(fields, &mut scratch.engine);
        }
        for field in fields {
            field.values.fill(T::zero());
            scratch.values.resize(field.values.len(), T::zero());
            for layer in &self.layers {
                match &layer.share {
                    None => scratch.light.copy_from_slice(field.light),
                    Some(share) => {
                        let shared = scratch.light.iter_mut().zip(field.light).zip(share);
                        shared.for_each(|((s, &v), &a)| *s = v * T::from(a));
                    }
                }
                let part = ForwardJob {
                    light: &scratch.light,
                    rows: field.rows,
                    values: &mut scratch.values,
                };
                layer.engine.read(&mut [part], &mut scratch.engine);
                add_scaled(field.values, &scratch.values, T::one());
            }
        }
    }

    /// The adjoint of [`Self::read`]; see [`Engine::spread`].
    fn spread(
        &self,
        fields: &[AdjointJob<T>],
        scratch: &mut Scratch<T>,
        mut write: impl FnMut(usize, usize, &mut [T]),
    ) {
        if let [
            Layer {
                share: None,
                engine,
                ..
            },
        ] = self.layers.as_slice()
        {
            return engine.spread(fields, &mut scratch.engine, write);
        }
        let Scratch { engine, light, .. } = scratch;
        for (i, field) in fields.iter().enumerate() {
            light.fill(T::zero());
            for layer in &self.layers {
                let one = std::slice::from_ref(field);
                layer.engine.spread(one, engine, |_, start, part| {
                    let sum = &mut light[start..start + part.len()];
                    match &layer.share {
                        None => add_scaled(sum, part, T::one()),
                        Some(share) => {
                            let shared = sum.iter_mut().zip(part).zip(&share[start..]);
                            shared.for_each(|((v, s), &a)| *v += *s * T::from(a));
                        }
                    }
                });
            }
            write(i, 0, light);
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
        let instants: Vec<usize> = (0..self.rows_of.len()).collect();
        let groups = instants.par_chunks(self.batch_size()).map_init(
            || self.scratch(),
            |scratch, group| {
                let rows = |instant: &usize| self.rows_of[*instant].as_slice();
                let lights: Vec<Cow<[T]>> = group
                    .iter()
                    .map(|&instant| self.integrate(video, instant))
                    .collect();
                let mut values: Vec<Vec<T>> = group
                    .iter()
                    .map(|instant| vec![T::zero(); rows(instant).len() * columns])
                    .collect();
                let fields = group.iter().zip(&lights).zip(&mut values);
                let mut fields: Vec<ForwardJob<T>> = fields
                    .map(|((instant, light), values)| ForwardJob {
                        light,
                        rows: rows(instant),
                        values,
                    })
                    .collect();
                self.read(&mut fields, scratch);
                values
            },
        );
        let read: Vec<Vec<T>> = groups.flatten_iter().collect();
        for (places, values) in self.places_of.iter().zip(&read) {
            for (&place, values) in places.iter().zip(values.chunks_exact(columns)) {
                frame[place * columns..(place + 1) * columns].copy_from_slice(values);
            }
        }
    }

    fn adjoint(&self, frame: &[T], video: &mut [T]) {
        self.adjoint_of(frame, video);
    }
}

impl<T: Scalar> RollingShutter<T> {
    /// Whether bin `j` is all that instant `j` integrates.
    fn has_one_bin_each(&self) -> bool {
        let instants = self.time.instants();
        self.time.bins() == instants.len() && instants.iter().all(|i| i.weights.len() == 1)
    }

    /// Calls `write(instant, start, light, target)` for pieces of the light that each instant sends back from its rows of
    /// `frame`, in whole rows from pixel `start` on, with the same piece of the instant's part of `target`. Rows
    /// that are dark in `mask` may be left out.
    fn spread_from<'m>(
        &self,
        frame: &[T],
        mask: impl Fn(usize) -> Option<&'m [u8]> + Sync,
        target: &mut [T],
        write: impl Fn(usize, usize, &mut [T], &mut [T]) + Sync,
    ) {
        let (pixels, size) = (self.video.pixels(), self.batch_size());
        let groups = target.par_chunks_mut(size * pixels).enumerate();
        groups.for_each_init(
            || self.scratch(),
            |scratch, (group, target)| {
                let first = group * size;
                let instants = first..first + target.len() / pixels;
                let values: Vec<Vec<T>> = instants
                    .clone()
                    .map(|i| lines_of(frame, &self.places_of[i], self.geometry.columns))
                    .collect();
                let fields: Vec<AdjointJob<T>> = instants
                    .zip(&values)
                    .map(|(i, values)| AdjointJob {
                        values,
                        rows: &self.rows_of[i],
                        mask: mask(i),
                    })
                    .collect();
                self.spread(&fields, scratch, |i, start, light| {
                    let at = i * pixels + start;
                    let target = &mut target[at..at + light.len()];
                    write(first + i, start, light, target);
                });
            },
        );
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
                let active = video.par_iter_mut().zip(support.mask());
                active.for_each(|(v, active)| *v *= T::from(f32::from(*active)));
            }
            return write_parts(&video, target, write);
        }
        let mask_of = |bin: usize| support.map(|s| &s.mask()[bin * pixels..(bin + 1) * pixels]);
        self.spread_from(frame, mask_of, target, |bin, start, light, target| {
            let weight = T::nearest(self.time.instants()[bin].weights[0]);
            let first = bin * pixels + start;
            let Some(mask) = mask_of(bin) else {
                if weight != T::one() {
                    light.iter_mut().for_each(|v| *v *= weight);
                }
                return write(first, light, target);
            };
            let rows = light.chunks_exact_mut(columns);
            let rows = rows.zip(mask[start..].chunks_exact(columns));
            let rows = rows.zip(target.chunks_exact_mut(columns)).enumerate();
            for (y, ((light, mask), target)) in rows {
                if mask.contains(&1) {
                    let active = light.iter_mut().zip(mask);
                    active.for_each(|(v, active)| *v *= weight * T::from(f32::from(*active)));
                    write(first + y * columns, light, target);
                }
            }
        });
    }

    fn adjoint_of(&self, frame: &[T], video: &mut [T]) {
        assert_eq!(video.len(), self.domain_len(), "length of the video");
        assert_eq!(frame.len(), self.range_len(), "length of the frame");
        if self.has_one_bin_each() {
            // Bin j is instant j: no second video is needed.
            let copy = |_: usize, part: &[T], video: &mut [T]| video.copy_from_slice(part);
            return self.adjoint_each(frame, None, video, &copy);
        }
        let (pixels, instants) = (self.video.pixels(), self.time.instants());
        let mut lights = vec![T::zero(); instants.len() * pixels];
        self.spread_from(
            frame,
            |_| None,
            &mut lights,
            |_, _, light, target| {
                target.copy_from_slice(light);
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
    let weight_maps = set.weight_maps(geometry.field_rows, geometry.field_columns);
    let layers = set.psfs().iter().zip(weight_maps);
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
