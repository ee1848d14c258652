//! The forward model `b = A v` of a rolling-shutter camera behind a diffuser.
//!
//! ```text
//! b[r, x] = Σ_j w[r, j] Σ_{y',x'} v[j, y', x'] · p[r − sy(y'), x − sx(x')]
//! ```
//!
//! These are Eqs. 1–4 in the head of the crate. `v` is the video `[t, y, x]`, `b` the frame `[y, x]`, `p` the PSF, and
//! `w[r, j]` the weight of bin `j` in row `r`. The field pixel `(y', x')` lies at `sy(y') = y' − oy`,
//! `sx(x') = x' − ox` on the sensor. The convolution does not wrap around.
//!
//! A PSF that changes over the field ([`PatchSet`]) is a sum of layers, `p = Σ_c a_c(y', x') p_c`. Each layer
//! convolves its share `a_c v` of the light with its own PSF `p_c` (docs/design/002).
//!
//! All rows of an instant have the same weights, `w[r, j] = w_{k[r]}[j]`, so `A = S·T`. `T` integrates the video over
//! the exposure of each instant. `S` convolves the light of each instant and keeps the rows that the instant reads
//! (docs/design/001). A solver may look for `D⁻¹v`, with `D` a factor for each row of each bin
//! ([`RollingShutter::equilibrated`]).

mod engine;
mod equilibrated;
mod geometry;
pub mod gram;
mod jobs;
pub mod mean_field;
mod planar;
pub mod psf_map;
mod rowwise;
mod shared_bins;
#[cfg(test)]
mod tests;

use crate::psf::Extent;
use crate::{Camera, PatchSet, Psf, TimeGrid};
use engine::Engine;
use geometry::Geometry;
use jobs::{AdjointJob, ForwardJob, Light, RowScales, add_scaled};
use planar::{Divisor, Planar};
use rayon::prelude::*;
use rowburst_core::linop::{LinearOperator, Scalar, WritePart};
use rowburst_core::{Shape, Support};
use std::sync::Arc;

/// The operator `A`: from a video `[t, y, x]` to a frame `[y, x]`.
///
/// The adjoint is exact: `Aᵀ = Tᵀ Sᵀ`.
///
/// An instant costs one short complex FFT for every two field rows, and for each row that is read a multiply–add over
/// the field rows that the PSF reaches. Rows that are not read are not computed. Where an instant reads many rows
/// (`global`), the operator uses 2-D FFTs instead; it selects the way that needs fewer operations. With several PSFs it
/// does all this once for each.
pub struct RollingShutter<T: Scalar = f32> {
    video: Shape,
    time: TimeGrid,
    geometry: Geometry,
    frame_row_count: usize,
    /// Sensor rows that each instant reads.
    sensor_rows_of: Vec<Vec<usize>>,
    /// The same rows as row indices of the frame.
    frame_rows_of: Vec<Vec<usize>>,
    layers: Arc<Vec<Layer<T>>>,
    /// Mean of `|P̂|²` over the field at each frequency of the padded plane; empty with row-wise engines.
    plane_power: Vec<f32>,
    /// A factor for each row of each bin, if it is [`Self::equilibrated`].
    row_scales: Option<Vec<f32>>,
}

/// A PSF with its share of the field's light.
struct Layer<T: Scalar> {
    psf: Psf,
    /// `a_c` of every field pixel; `None`: 1 everywhere.
    share: Option<Vec<f32>>,
    engine: Engine<T>,
}

/// Buffers of one thread.
struct Scratch<T> {
    engine: engine::Scratch<T>,
    /// Light of the field in one of several layers.
    light: Vec<T>,
    /// Row values of one of several layers.
    values: Vec<T>,
}

impl RollingShutter {
    /// The operator of `camera` behind a diffuser, in `f32`. The PSF is constant (`&Psf`) or changes over the field
    /// (`&PatchSet`).
    pub fn new(camera: &Camera, psf: impl Into<PatchSet>) -> Self {
        Self::with_precision(camera, psf)
    }

    /// `video = P Aᵀ frame`, with `P` the projection onto `support`; overwrites `video`.
    ///
    /// Rows without an active voxel are skipped.
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
    /// The operator of `camera` behind a diffuser, in the precision `T`. The PSF is constant (`&Psf`) or changes over
    /// the field (`&PatchSet`).
    pub fn with_precision(camera: &Camera, psf: impl Into<PatchSet>) -> Self {
        let time = camera.time().clone();
        let mut sensor_rows_of = vec![Vec::new(); time.instants().len()];
        let mut frame_rows_of = sensor_rows_of.clone();
        let rows = camera.instants().iter().zip(camera.sensor_rows());
        for (frame_row, (&instant, sensor_row)) in rows.enumerate() {
            sensor_rows_of[instant].push(sensor_row);
            frame_rows_of[instant].push(frame_row);
        }
        let geometry = Geometry::new(camera);
        let layers = layers_of(psf.into(), &geometry, &sensor_rows_of);
        Self {
            video: camera.video_shape(),
            time,
            plane_power: plane_power(&layers),
            geometry,
            frame_row_count: camera.rows(),
            sensor_rows_of,
            frame_rows_of,
            layers: Arc::new(layers),
            row_scales: None,
        }
    }

    /// Shape of the video.
    pub fn video_shape(&self) -> Shape {
        self.video
    }

    /// Rows and columns of the frame.
    pub fn frame_shape(&self) -> (usize, usize) {
        (self.frame_row_count, self.geometry.columns)
    }

    /// The sensor rows that each instant reads.
    pub fn rows_of_instants(&self) -> &[Vec<usize>] {
        &self.sensor_rows_of
    }

    /// The time axis of the video.
    pub fn time(&self) -> &TimeGrid {
        &self.time
    }

    /// Whether it convolves whole planes, and not the rows that are read alone.
    pub fn convolves_planes(&self) -> bool {
        matches!(self.layers[0].engine, Engine::Planar(_))
    }

    /// An approximate `(A Aᵀ + ρI)⁻¹ r`, as if the sensor had no edge: a preconditioner.
    ///
    /// For each instant it divides by `w·|P̂|² + ρ` at each spatial frequency, with `w` the sum of the instant's
    /// squared weights and `|P̂|²` the mean over the field. The map is symmetric and positive definite. `r` and the
    /// result have the length of a frame. Returns `None` where the operator convolves row by row.
    pub fn circulant_inverse(&self, r: &[T], rho: f64) -> Option<Vec<T>> {
        let Engine::Planar(planar) = &self.layers[0].engine else {
            return None;
        };
        let columns = self.geometry.columns;
        let mut scratch = planar.scratch();
        let mut out = vec![T::zero(); r.len()];
        let rows_of_instants = self.sensor_rows_of.iter().zip(&self.frame_rows_of);
        for ((rows, frame_rows), instant) in rows_of_instants.zip(self.time.instants()) {
            let values = lines_of(r, frame_rows, columns);
            let weight: f64 = instant.weights.iter().map(|w| w * w).sum();
            let mut divided = vec![T::zero(); values.len()];
            let divisor = Divisor {
                power: &self.plane_power,
                weight,
                rho,
            };
            planar.divide(&values, rows, divisor, &mut divided, &mut scratch);
            for (&row, values) in frame_rows.iter().zip(divided.chunks_exact(columns)) {
                out[row * columns..(row + 1) * columns].copy_from_slice(values);
            }
        }
        Some(out)
    }

    /// Whether instants are processed together.
    fn is_batched(&self, layer: &Layer<T>) -> bool {
        /// Cache of a thread in bytes; larger spectra are shared by several instants.
        const CACHE: usize = 1 << 20;
        let bytes = layer.engine.shared_spectrum_bytes();
        bytes > CACHE || (bytes > 0 && !self.has_one_bin_each())
    }

    fn scratch(&self) -> Scratch<T> {
        let several = self.layers.iter().any(|layer| layer.share.is_some());
        Scratch {
            engine: self.layers[0].engine.scratch(),
            light: vec![T::zero(); if several { self.video.pixels() } else { 0 }],
            values: Vec::new(),
        }
    }

    /// Instants that a thread processes together.
    ///
    /// Where the PSF's spectra exceed the cache, or instants share bins, these instants share each part of them that is read
    /// from memory.
    fn batch_size(&self) -> usize {
        /// Most instants that share the PSF's rows; larger takes more memory for less gain (docs/design/001).
        const MAX_BATCH: usize = 8;
        match self.layers.as_slice() {
            [layer] if self.is_batched(layer) => {
                // Every thread gets the same number of groups.
                let (instants, threads) = (self.sensor_rows_of.len(), rayon::current_num_threads());
                let rounds = instants.div_ceil(threads * MAX_BATCH);
                instants.div_ceil(threads * rounds)
            }
            _ => 1,
        }
    }

    /// Computes the row values of all `jobs`, `S` applied to their light.
    fn apply_batch(&self, jobs: &mut [ForwardJob<T>], scratch: &mut Scratch<T>) {
        if let [
            Layer {
                share: None,
                engine,
                ..
            },
        ] = self.layers.as_slice()
        {
            return engine.apply_batch(jobs, &mut scratch.engine);
        }
        for job in jobs {
            job.values.fill(T::zero());
            scratch.values.resize(job.values.len(), T::zero());
            let light = job.light.all(self.video.pixels());
            for layer in self.layers.iter() {
                match &layer.share {
                    None => scratch.light.copy_from_slice(&light),
                    Some(share) => {
                        let shares = scratch.light.iter_mut().zip(&*light).zip(share);
                        shares.for_each(|((s, &v), &a)| *s = v * T::from(a));
                    }
                }
                let layer_job = ForwardJob {
                    light: Light::of(&scratch.light),
                    rows: job.rows,
                    values: &mut scratch.values,
                };
                layer
                    .engine
                    .apply_batch(&mut [layer_job], &mut scratch.engine);
                add_scaled(job.values, &scratch.values, T::one());
            }
        }
    }

    /// The adjoint of [`Self::apply_batch`]; see [`Engine::adjoint_batch`].
    fn adjoint_batch(
        &self,
        jobs: &[AdjointJob<T>],
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
            return engine.adjoint_batch(jobs, &mut scratch.engine, write);
        }
        let Scratch { engine, light, .. } = scratch;
        for (i, job) in jobs.iter().enumerate() {
            light.fill(T::zero());
            for layer in self.layers.iter() {
                let one = std::slice::from_ref(job);
                layer.engine.adjoint_batch(one, engine, |_, start, part| {
                    let sum = &mut light[start..start + part.len()];
                    match &layer.share {
                        None => add_scaled(sum, part, T::one()),
                        Some(share) => {
                            let shares = sum.iter_mut().zip(part).zip(&share[start..]);
                            shares.for_each(|((v, s), &a)| *v += *s * T::from(a));
                        }
                    }
                });
            }
            write(i, 0, light);
        }
    }

    /// The light that an instant integrates, `Σ_j w_i[j] v_j`.
    fn light<'v>(&'v self, video: &'v [T], instant: usize) -> Light<'v, T> {
        let instant = &self.time.instants()[instant];
        let seen = instant.first_bin..instant.first_bin + instant.weights.len();
        let of_planes: Option<Vec<_>> = seen.map(|bin| self.row_scales_of(bin)).collect();
        let columns = self.video.columns;
        let row_scales = of_planes.map(|of_planes| RowScales { of_planes, columns });
        let pixels = self.video.pixels();
        let bins = video[instant.first_bin * pixels..].chunks_exact(pixels);
        let terms = instant.weights.iter().zip(bins);
        Light {
            terms: terms.map(|(&w, bin)| (T::nearest(w), bin)).collect(),
            row_scales,
        }
    }
}

impl<T: Scalar> LinearOperator<T> for RollingShutter<T> {
    fn domain_len(&self) -> usize {
        self.video.voxels()
    }

    fn range_len(&self) -> usize {
        self.frame_row_count * self.geometry.columns
    }

    fn apply(&self, video: &[T], frame: &mut [T]) {
        assert_eq!(video.len(), self.domain_len(), "length of the video");
        assert_eq!(frame.len(), self.range_len(), "length of the frame");
        let columns = self.geometry.columns;
        let instants: Vec<usize> = (0..self.sensor_rows_of.len()).collect();
        let groups = instants.par_chunks(self.batch_size()).map_init(
            || self.scratch(),
            |scratch, group| {
                let rows = |instant: &usize| self.sensor_rows_of[*instant].as_slice();
                let mut values: Vec<Vec<T>> = group
                    .iter()
                    .map(|instant| vec![T::zero(); rows(instant).len() * columns])
                    .collect();
                let jobs = group.iter().zip(&mut values);
                let mut jobs: Vec<ForwardJob<T>> = jobs
                    .map(|(instant, values)| ForwardJob {
                        light: self.light(video, *instant),
                        rows: rows(instant),
                        values,
                    })
                    .collect();
                self.apply_batch(&mut jobs, scratch);
                values
            },
        );
        let values_of: Vec<Vec<T>> = groups.flatten_iter().collect();
        for (frame_rows, values) in self.frame_rows_of.iter().zip(&values_of) {
            for (&row, values) in frame_rows.iter().zip(values.chunks_exact(columns)) {
                frame[row * columns..(row + 1) * columns].copy_from_slice(values);
            }
        }
    }

    fn adjoint(&self, frame: &[T], video: &mut [T]) {
        assert_eq!(video.len(), self.domain_len(), "length of the video");
        assert_eq!(frame.len(), self.range_len(), "length of the frame");
        let copy = |_: usize, part: &[T], video: &mut [T]| video.copy_from_slice(part);
        self.adjoint_each(frame, None, video, &copy);
    }
}

impl<T: Scalar> RollingShutter<T> {
    /// Whether every instant `j` integrates bin `j` alone.
    fn has_one_bin_each(&self) -> bool {
        let instants = self.time.instants();
        self.time.bins() == instants.len() && instants.iter().all(|i| i.weights.len() == 1)
    }

    /// The values of the rows that each of these instants reads.
    fn values_of(&self, frame: &[T], instants: &[usize]) -> Vec<Vec<T>> {
        let rows = instants.iter().map(|&i| &self.frame_rows_of[i]);
        rows.map(|rows| lines_of(frame, rows, self.geometry.columns))
            .collect()
    }

    /// The adjoint products of these instants.
    fn adjoint_jobs<'j, 'm: 'j>(
        &'j self,
        instants: &[usize],
        values: &'j [Vec<T>],
        mask: impl Fn(usize) -> Option<&'m [u8]>,
    ) -> Vec<AdjointJob<'j, T>> {
        let jobs = instants.iter().zip(values);
        jobs.map(|(&i, values)| AdjointJob {
            values,
            rows: &self.sensor_rows_of[i],
            mask: mask(i),
        })
        .collect()
    }

    /// Calls `write(instant, start, light, target)` for pieces of `Sᵀ frame`, the light of each instant.
    ///
    /// The argument `target` has one plane per instant. `write` gets the light of some whole field rows from pixel
    /// `start` on, and the same pixels of the instant's plane. Rows that are zero in `mask(instant)` may be left out.
    fn for_each_light<'m>(
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
                let instants: Vec<usize> = (first..first + target.len() / pixels).collect();
                let values = self.values_of(frame, &instants);
                let jobs = self.adjoint_jobs(&instants, &values, &mask);
                self.adjoint_batch(&jobs, scratch, |i, start, light| {
                    let at = i * pixels + start;
                    let target = &mut target[at..at + light.len()];
                    write(first + i, start, light, target);
                });
            },
        );
    }

    /// Calls `write(start, part, target)` for each part of `P Aᵀ frame`, in any order and in parallel.
    ///
    /// `part` is the result from voxel `start` on, and `target` has the same voxels of the argument `target`. `P`
    /// projects onto `support` (`None`: every voxel). Rows without an active voxel may be left out.
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
        if !self.has_one_bin_each() {
            return self.adjoint_of_shared_bins(frame, support, target, write);
        }
        let (pixels, columns) = (self.video.pixels(), self.video.columns);
        let mask_of = |bin: usize| support.map(|s| &s.mask()[bin * pixels..(bin + 1) * pixels]);
        self.for_each_light(frame, mask_of, target, |bin, start, light, target| {
            let weight = T::nearest(self.time.instants()[bin].weights[0]);
            let first = bin * pixels + start;
            self.scale_part(bin, start, light);
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
}

/// The rows `frame_rows` of `frame`, one after another.
fn lines_of<T: Scalar>(frame: &[T], frame_rows: &[usize], columns: usize) -> Vec<T> {
    let lines = frame_rows
        .iter()
        .map(|&row| &frame[row * columns..(row + 1) * columns]);
    lines.flatten().copied().collect()
}

/// The layers of `set` that have a share of the field's light.
fn layers_of<T: Scalar>(
    set: PatchSet,
    geometry: &Geometry,
    sensor_rows_of: &[Vec<usize>],
) -> Vec<Layer<T>> {
    let mut extents: Vec<Extent> = set.psfs().iter().map(Psf::extent).collect();
    // Engines share their buffers, so all have one length of transforms.
    let start = extents.iter().map(|e| e.columns.start).min().unwrap_or(0);
    let end = extents.iter().map(|e| e.columns.end).max().unwrap_or(0);
    extents.iter_mut().for_each(|e| e.columns = start..end);
    let engine = |psf: &Psf, extent| Engine::cheapest(geometry, psf, extent, sensor_rows_of);
    if let [psf] = set.psfs() {
        return vec![Layer {
            engine: engine(psf, &extents[0]),
            psf: psf.clone(),
            share: None,
        }];
    }
    let weight_maps = set.weight_maps(geometry.field_rows, geometry.field_columns);
    let layers = set.psfs().iter().zip(&extents).zip(weight_maps);
    layers
        .filter(|(_, share)| !share.is_empty())
        .map(|((psf, extent), share)| Layer {
            engine: engine(psf, extent),
            psf: psf.clone(),
            share: Some(share),
        })
        .collect()
}

/// Mean of `|Σ_c a_c P̂_c|²` over the field at each frequency of the padded plane; empty with row-wise engines.
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
            let mean_product = match (&layers[i].share, &layers[j].share) {
                (Some(a), Some(b)) => rowburst_core::vecmath::dot(a, b) / a.len() as f64,
                _ => 1.0,
            };
            // A pair counts in both orders.
            let weight = if i == j {
                mean_product
            } else {
                2.0 * mean_product
            };
            a.add_power(b, weight, &mut power);
        }
    }
    power
}
