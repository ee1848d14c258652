//! The two convolution engines, row-wise and planar, and the choice between them.
//!
//! An engine convolves the light of an instant with a PSF and keeps the rows that the instant reads.

use super::geometry::Geometry;
use super::jobs::{AdjointJob, ForwardJob};
use super::{planar::Planar, rowwise::Rowwise};
use crate::Psf;
use crate::psf::Extent;
use rowburst_core::linop::Scalar;

/// A convolution with one PSF.
pub(super) enum Engine<T: Scalar> {
    Rowwise(Rowwise<T>),
    Planar(Planar<T>),
}

/// Buffers of one thread.
pub(super) enum Scratch<T> {
    Rowwise(super::rowwise::Scratch<T>),
    Planar {
        engine: super::planar::Scratch<T>,
        /// Light of the field.
        light: Vec<T>,
    },
}

impl<T: Scalar> Engine<T> {
    /// The engine with the lower operation count for instants that read `sensor_rows_of`, of a PSF that covers all displacements.
    ///
    /// The PSF is zero outside of `extent`.
    pub fn cheapest(
        geometry: &Geometry,
        psf: &Psf,
        extent: &Extent,
        sensor_rows_of: &[Vec<usize>],
    ) -> Self {
        // Real operations per x-frequency: 8 for a complex multiply–add, and 5 n log2 n for each of two complex FFTs
        // of length n.
        let reads: usize = sensor_rows_of.iter().map(Vec::len).sum();
        let rowwise = 8.0 * (reads * geometry.field_rows) as f64;
        let n = geometry.fft_rows() as f64;
        let planar = sensor_rows_of.len() as f64 * 10.0 * n * n.log2();
        if rowwise <= planar {
            Self::Rowwise(Rowwise::new(geometry, psf, extent))
        } else {
            Self::Planar(Planar::new(geometry, psf))
        }
    }

    pub fn scratch(&self) -> Scratch<T> {
        match self {
            Self::Rowwise(engine) => Scratch::Rowwise(engine.scratch()),
            Self::Planar(engine) => Scratch::Planar {
                engine: engine.scratch(),
                light: Vec::new(),
            },
        }
    }

    /// Bytes of PSF spectra that instants in a batch can share; 0 if the engine takes instants one by one.
    pub fn shared_spectrum_bytes(&self) -> usize {
        match self {
            Self::Rowwise(engine) => engine.spectrum_bytes(),
            Self::Planar(_) => 0,
        }
    }

    /// Computes the row values of all `jobs`.
    pub fn apply_batch(&self, jobs: &mut [ForwardJob<T>], scratch: &mut Scratch<T>) {
        match (self, scratch) {
            (Self::Rowwise(engine), Scratch::Rowwise(s)) => engine.apply_batch(jobs, s),
            (Self::Planar(engine), Scratch::Planar { engine: s, .. }) => {
                for job in jobs {
                    let light = job.light.all(engine.field_pixels());
                    engine.apply(&light, job.rows, job.values, s);
                }
            }
            _ => unreachable!("scratch comes from the same engine"),
        }
    }

    /// The adjoint of [`Self::apply_batch`].
    ///
    /// Calls `write(job, start, light)` for pieces of the light of each job: whole field rows from pixel `start` on.
    /// Each row that has an active pixel in the job's mask is written once, in order; other rows may be left out.
    pub fn adjoint_batch(
        &self,
        jobs: &[AdjointJob<T>],
        scratch: &mut Scratch<T>,
        mut write: impl FnMut(usize, usize, &mut [T]),
    ) {
        match (self, scratch) {
            (Self::Rowwise(engine), Scratch::Rowwise(s)) => engine.adjoint_batch(jobs, s, write),
            (Self::Planar(engine), Scratch::Planar { engine: s, light }) => {
                light.resize(engine.field_pixels(), T::zero());
                for (i, job) in jobs.iter().enumerate() {
                    engine.adjoint(job.values, job.rows, light, s);
                    write(i, 0, light);
                }
            }
            _ => unreachable!("scratch comes from the same engine"),
        }
    }
}
