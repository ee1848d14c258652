//! The adjoint where several instants may see a bin: a bin is a weighted sum of their lights.

use super::engine::Engine;
use super::jobs::{BLOCK, write_sum};
use super::rowwise::{PAIRS_PER_BATCH, Pairs, Rowwise};
use super::{Layer, RollingShutter, lines_of};
use rayon::prelude::*;
use rowburst_core::Support;
use rowburst_core::linop::{Scalar, WritePart};
use rustfft::num_complex::Complex;
use std::ops::Range;

impl<T: Scalar> RollingShutter<T> {
    /// [`Self::adjoint_each`] where several instants may see a bin.
    pub(super) fn adjoint_of_shared_bins(
        &self,
        frame: &[T],
        support: Option<&Support>,
        target: &mut [T],
        write: WritePart<T>,
    ) {
        match self.layers.as_slice() {
            [
                Layer {
                    share: None,
                    engine: Engine::Rowwise(engine),
                    ..
                },
            ] => self.adjoint_by_rows(engine, frame, support, target, write),
            _ => self.adjoint_by_instants(frame, support, target, write),
        }
    }

    /// For some rows of the field at a time, so that the lights of all instants stay in the cache.
    fn adjoint_by_rows(
        &self,
        engine: &Rowwise<T>,
        frame: &[T],
        support: Option<&Support>,
        target: &mut [T],
        write: WritePart<T>,
    ) {
        let (pixels, columns) = (self.video.pixels(), self.video.columns);
        let frame_rows: Vec<usize> = self.frame_rows_of.iter().flatten().copied().collect();
        let spectra = engine.spectra(&lines_of(frame, &frame_rows, self.geometry.columns));
        let size = 2 * PAIRS_PER_BATCH * columns;
        // The same rows of all bins.
        let mut blocks: Vec<Vec<&mut [T]>> = Vec::new();
        blocks.resize_with(pixels.div_ceil(size), Vec::new);
        for bin in target.chunks_exact_mut(pixels) {
            let rows = bin.chunks_mut(size);
            rows.zip(&mut blocks)
                .for_each(|(rows, block)| block.push(rows));
        }
        let blocks = blocks.into_par_iter().enumerate();
        blocks.for_each_init(
            || {
                let lights = vec![T::zero(); size * self.sensor_rows_of.len()];
                (engine.pairs(), lights, vec![T::zero(); size])
            },
            |(pairs, lights, sum), (block, bins)| {
                let start = block * size;
                let end = pixels.min(start + size);
                let field_rows = start / columns..end / columns;
                self.write_lights(engine, &spectra, field_rows, support, pairs, lights);
                for (j, target) in bins.into_iter().enumerate() {
                    let sum = &mut sum[..target.len()];
                    write_sum(sum, &self.terms(j, lights.chunks_exact(size)), 0);
                    let first = j * pixels + start;
                    self.scale_part(j, start, sum);
                    project(sum, support, first);
                    write(first, sum, target);
                }
            },
        );
    }

    /// Writes the light of each instant in some rows of the field to `lights`, in steps of as many pixels as a whole block of rows
    /// has. Rows without an active voxel are zero.
    fn write_lights(
        &self,
        engine: &Rowwise<T>,
        spectra: &[Complex<T>],
        field_rows: Range<usize>,
        support: Option<&Support>,
        pairs: &mut Pairs<T>,
        lights: &mut [T],
    ) {
        let (pixels, columns) = (self.video.pixels(), self.video.columns);
        let is_active = |bin: usize, y: usize| {
            let row_pair = y * columns..pixels.min((y + 2) * columns);
            support.is_none_or(|support| {
                support.mask()[bin * pixels + row_pair.start..bin * pixels + row_pair.end]
                    .contains(&1)
            })
        };
        let mut spectra = spectra;
        let size = lights.len() / self.sensor_rows_of.len();
        let instants = self.time.instants().iter().zip(&self.sensor_rows_of);
        for ((instant, rows), light) in instants.zip(lights.chunks_exact_mut(size)) {
            let of_instant;
            (of_instant, spectra) = spectra.split_at(rows.len() * engine.length());
            let bins = instant.first_bin..instant.first_bin + instant.weights.len();
            let all = field_rows.clone().step_by(2);
            let active = all.filter(|&y| bins.clone().any(|bin| is_active(bin, y)));
            pairs.rows.clear();
            pairs.rows.extend(active);
            let light = &mut light[..field_rows.len() * columns];
            if pairs.rows.len() < field_rows.len().div_ceil(2) {
                light.fill(T::zero());
            }
            engine.write_pairs(rows, of_instant, pairs, field_rows.start, light);
        }
    }

    /// The lights that bin `j` is a sum of, with their weights; `lights` has one of each instant.
    fn terms<'l>(&self, j: usize, lights: impl Iterator<Item = &'l [T]>) -> Vec<(T, &'l [T])> {
        let instants = self.time.instants().iter().zip(lights);
        let terms = instants.filter_map(|(instant, light)| {
            let weight = instant.weights.get(j.checked_sub(instant.first_bin)?)?;
            Some((T::nearest(*weight), light))
        });
        terms.collect()
    }

    /// For an instant at a time.
    fn adjoint_by_instants(
        &self,
        frame: &[T],
        support: Option<&Support>,
        target: &mut [T],
        write: WritePart<T>,
    ) {
        let lights = self.lights(frame);
        let pixels = self.video.pixels();
        let bins = target.par_chunks_exact_mut(pixels).enumerate();
        bins.for_each(|(j, target)| {
            let terms = self.terms(j, lights.iter().map(Vec::as_slice));
            let mut sum = [T::zero(); BLOCK];
            for (i, target) in target.chunks_mut(BLOCK).enumerate() {
                let sum = &mut sum[..target.len()];
                write_sum(sum, &terms, i * BLOCK);
                let first = j * pixels + i * BLOCK;
                self.scale_part(j, i * BLOCK, sum);
                project(sum, support, first);
                write(first, sum, target);
            }
        });
    }

    /// `Sᵀ frame`: the light of each instant.
    fn lights(&self, frame: &[T]) -> Vec<Vec<T>> {
        let instants: Vec<usize> = (0..self.sensor_rows_of.len()).collect();
        let groups = instants.par_chunks(self.batch_size()).map_init(
            || self.scratch(),
            |scratch, group| {
                let lights = group
                    .iter()
                    .map(|_| Vec::with_capacity(self.video.pixels()));
                let mut lights: Vec<Vec<T>> = lights.collect();
                let values = self.values_of(frame, group);
                let jobs = self.adjoint_jobs(group, &values, |_| None);
                // Pieces follow one another.
                self.adjoint_batch(&jobs, scratch, |i, _, light| {
                    lights[i].extend_from_slice(light);
                });
                lights
            },
        );
        groups.flatten_iter().collect()
    }
}

/// Sets voxels outside of the support to zero, in a part of a video from voxel `first` on.
fn project<T: Scalar>(part: &mut [T], support: Option<&Support>, first: usize) {
    if let Some(support) = support {
        let active = part.iter_mut().zip(&support.mask()[first..]);
        active.for_each(|(v, active)| *v *= T::from(f32::from(*active)));
    }
}
