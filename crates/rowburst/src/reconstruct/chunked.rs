//! Reconstruction of a video too large for memory, in chunks of bins.
//!
//! Where no exposure is longer than a row time, each bin is seen by its own rows alone, so `A` is block-diagonal
//! in time. With a prior of space alone the problem separates, too:
//!
//! ```text
//! min Σ_k ½‖W_k(b_k − A_k v_k)‖² + τ R(v_k),   v ≥ 0
//! ```
//!
//! Each chunk `k` is a problem of its own, with the rows that read its bins ([`Camera::within`]). With `τ`
//! given, the chunks together are the minimiser of the whole problem. Under the discrepancy principle each
//! chunk has its own `τ`, at which its residual matches the noise level of the whole frame.
//!
//! Exposures longer than a row time, and a prior over neighbouring bins, couple a bin with others, the less the farther
//! they are. So a chunk is reconstructed with more bins on both sides, which are left out of the result. Where exposures share
//! bins, the videos of two chunks fade into one another at their border.

use super::sigma::Bands;
use super::{
    Model, Options, Prior, Problem, Reconstruction, SelfCalibration, SigmaSource, noise_of,
};
use rowburst_core::{Cancel, Error, ErrorKind, Parameter, Result, phrase};
use rowburst_optics::forward::gram::element_bytes;
use rowburst_optics::measurement::Measurement;
use rowburst_optics::{Camera, PatchSet};
use rowburst_solve::StopReason;
use rowburst_solve::admm::Progress;
use std::ops::{ControlFlow, Range};

/// Bytes of a chunk where its size is left open; smaller makes more chunks (docs/design/008).
const MAX_CHUNK_BYTES: usize = 3 << 30;
/// Rows of a chunk are a multiple of this where more fit, so that threads share its bins evenly.
const BIN_MULTIPLE: usize = 8;
/// Exposures on each side of a chunk that it is solved with; more are more exact and take longer (docs/design/008).
const OVERLAP_EXPOSURES: usize = 6;
/// Bins on each side for a prior over neighbouring bins; more are more exact and take longer (docs/design/008).
const OVERLAP_BINS: usize = 8;
/// Copies of a chunk's video that its reconstruction holds.
const VIDEO_COPIES: usize = 6;
/// The same of exposures longer than a row.
const COUPLED_VIDEO_COPIES: usize = 8;

/// A frame whose video is reconstructed in chunks of bins.
pub struct Chunked {
    camera: Camera,
    psfs: PatchSet,
    measurement: Measurement,
    options: Options,
    sigma: f64,
    sigma_source: SigmaSource,
    cancel: Cancel,
}

impl Chunked {
    /// Sets up the reconstruction of `measurement`. The prior is that of the options, or
    /// [`Prior::SEPARABLE`].
    ///
    /// # Errors
    /// A prior that couples all bins, a video of one bin, a flat PSF
    /// ([`PatchSet::check_contrast`]), or a noise level that only held-out pixels could determine.
    pub fn new(
        camera: Camera,
        psfs: PatchSet,
        measurement: Measurement,
        options: Options,
    ) -> Result<Self> {
        let prior = options.prior.unwrap_or(Prior::SEPARABLE);
        prior.check_chunks()?;
        if camera.time().bins() == 1 {
            return Err(Error::input(
                Parameter::PartBins,
                "a video of 1 bin",
                "reconstruction in chunks divides a video of several bins",
                phrase![
                    "Leave it out, and make ",
                    Parameter::Field,
                    " smaller or bin the frame if memory is short."
                ],
            )
            .with_kind(ErrorKind::Unsupported));
        }
        psfs.check_contrast()?;
        let bands = Bands::new(&measurement, psfs.central());
        let (sigma, sigma_source) = noise_of(&measurement, &bands, &options);
        if sigma_source == SigmaSource::HeldOut && !matches!(options.tau, super::Tau::Given(_)) {
            return Err(Error::input(
                Parameter::NoiseSigma,
                "a noise level that cannot be estimated from the frame",
                "all chunks use the noise level of the whole frame",
                phrase![
                    "Give ",
                    Parameter::NoiseSigma,
                    ", or gain and read noise in ",
                    Parameter::Camera,
                    "."
                ],
            ));
        }
        Ok(Self {
            options: Options {
                prior: Some(prior),
                // A chunk alone has too few pixels to tell foreign ones, and all chunks have the same PSF.
                keep_all_pixels: true,
                self_calibration: SelfCalibration::OFF,
                ..options
            },
            camera,
            psfs,
            measurement,
            sigma,
            sigma_source,
            cancel: Cancel::default(),
        })
    }

    /// The same, whose runs `cancel` stops.
    #[must_use]
    pub fn with_cancel(self, cancel: &Cancel) -> Self {
        Self {
            cancel: cancel.clone(),
            ..self
        }
    }

    /// What stops its runs.
    pub fn cancel(&self) -> &Cancel {
        &self.cancel
    }

    /// The camera of the whole frame.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The PSF, or one PSF for each patch of the field.
    pub fn psfs(&self) -> &PatchSet {
        &self.psfs
    }

    /// The whole frame, corrected.
    pub fn measurement(&self) -> &Measurement {
        &self.measurement
    }

    /// The prior, the same for all chunks.
    pub fn prior(&self) -> Prior {
        self.options.prior.unwrap_or(Prior::SEPARABLE)
    }

    /// Noise of a pixel with weight 1 in counts, and its source.
    pub fn sigma(&self) -> (f64, SigmaSource) {
        (self.sigma, self.sigma_source)
    }

    /// Bytes that the bins of one instant take.
    fn row_bytes(&self) -> usize {
        let shape = self.camera.video_shape();
        let instants = self.camera.time().instants().len();
        let per_row = self.camera.params().bins_per_row;
        let rows = self.camera.rows().div_ceil(instants);
        let columns = self.camera.columns();
        let video = size_of::<f32>() * shape.pixels() * per_row;
        if self.exposure_bins() == 0 {
            let block = (rows * columns).pow(2);
            return VIDEO_COPIES * video + element_bytes(columns) * block;
        }
        let coupled_rows = rows * self.exposure_bins() / per_row;
        let mean_field = 2 * size_of::<f64>() * (columns / 2 + 1) * rows * coupled_rows;
        COUPLED_VIDEO_COPIES * video + mean_field
    }

    /// Bytes that a chunk of these bins takes while it is reconstructed, with those that it is solved with.
    pub fn chunk_bytes(&self, bins: &Range<usize>) -> u64 {
        let solved = self.solved_bins(bins);
        let rows = solved.len().div_ceil(self.camera.params().bins_per_row);
        (rows as u64).saturating_mul(self.row_bytes() as u64)
    }

    /// The bins of each chunk, in order. A chunk has `bins_per_chunk` bins, rounded up to whole rows, and two exposures at
    /// least where these share bins; `None`: as many as 3 GiB hold, but about as many as it is solved with on one side at
    /// least. The last one has the rest. The ranges depend on camera, prior and `bins_per_chunk` alone.
    pub fn ranges(&self, bins_per_chunk: Option<usize>) -> Vec<Range<usize>> {
        let bins = self.camera.time().bins();
        let per_row = self.camera.params().bins_per_row;
        let overlap = self.overlap_bins() / per_row;
        let fitting = (MAX_CHUNK_BYTES / self.row_bytes()).saturating_sub(2 * overlap);
        let fitting = fitting.max(overlap).max(1);
        let fitting_multiple = if fitting > BIN_MULTIPLE {
            fitting - fitting % BIN_MULTIPLE
        } else {
            fitting
        };
        let bins_per_chunk = bins_per_chunk.unwrap_or(per_row * fitting_multiple);
        let least = 2 * self.faded_bins();
        let bins_per_chunk = bins_per_chunk
            .min(bins)
            .next_multiple_of(per_row)
            .max(least);
        // Bins that are too few for a chunk belong to the one before.
        let last_start = bins.saturating_sub(least.max(1));
        let starts: Vec<usize> = (0..=last_start).step_by(bins_per_chunk).collect();
        let ends = starts.iter().skip(1).copied().chain([bins]);
        starts
            .iter()
            .zip(ends)
            .map(|(&first, end)| first..end)
            .collect()
    }

    /// Bins of an exposure that shares bins with others, in whole row times; 0 where none does.
    fn exposure_bins(&self) -> usize {
        let time = self.camera.time();
        if time.is_disjoint() {
            return 0;
        }
        let longest = time.instants().iter().map(|i| i.weights.len()).max();
        longest.map_or(0, |bins| {
            bins.next_multiple_of(self.camera.params().bins_per_row)
        })
    }

    /// The bins on each side of a chunk that it is solved with: whole row times.
    fn overlap_bins(&self) -> usize {
        let per_row = self.camera.params().bins_per_row;
        let of_exposure = OVERLAP_EXPOSURES * self.exposure_bins();
        let of_prior = if self.prior().couples_neighbours() {
            OVERLAP_BINS.next_multiple_of(per_row)
        } else {
            0
        };
        of_exposure + of_prior
    }

    /// The bins on each side of a border between chunks over which one video fades into the next: a row that is exposed on
    /// both sides sees bins of both.
    pub fn faded_bins(&self) -> usize {
        self.exposure_bins()
    }

    /// The bins that those of a chunk are solved with, these included.
    pub fn solved_bins(&self, bins: &Range<usize>) -> Range<usize> {
        let overlap = self.overlap_bins();
        bins.start.saturating_sub(overlap)..self.camera.time().bins().min(bins.end + overlap)
    }

    /// Reconstructs the bins of one chunk. `observer` is called after every iteration and may stop the run.
    ///
    /// # Errors
    /// Those of [`Camera::within`], [`Problem::with_model`] and [`Problem::solve`].
    pub fn solve(
        &self,
        bins: Range<usize>,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<SolvedChunk> {
        let solved_bins = self.solved_bins(&bins);
        let part = self.camera.within(solved_bins.clone())?;
        let all_rows = self.camera.sensor_rows().collect::<Vec<_>>();
        let index_of = |row: usize| {
            all_rows
                .iter()
                .position(|&r| r == row)
                .expect("a row of the whole")
        };
        let rows: Vec<usize> = part.sensor_rows().map(index_of).collect();
        let measurement = self.measurement.select_rows(&rows);
        let options = Options {
            noise_sigma: Some(self.sigma),
            ..self.options
        };
        let model = Model::new(&part, self.psfs.clone()).with_cancel(&self.cancel);
        let reconstruction = Problem::with_model(&model, &measurement, options)?.solve(observer)?;
        Ok(SolvedChunk {
            bins,
            solved_bins,
            faded_bins: self.faded_bins(),
            reconstruction,
        })
    }
}

/// A chunk of the video, with the bins that it was solved with.
pub struct SolvedChunk {
    /// The bins of the chunk.
    bins: Range<usize>,
    /// The bins of [`Self::reconstruction`].
    pub solved_bins: Range<usize>,
    /// See [`Chunked::faded_bins`].
    faded_bins: usize,
    /// The reconstruction from the rows that are exposed to [`Self::solved_bins`] alone.
    pub reconstruction: Reconstruction,
}

impl SolvedChunk {
    /// The video of the chunk by itself, `[t, y, x]`.
    pub fn video(&self) -> &[f32] {
        self.video_of(self.bins.clone())
    }

    /// Its video of the [`Chunked::faded_bins`] before and after its end, for the next chunk.
    ///
    /// # Panics
    /// If it is the last chunk and has such bins.
    pub fn end_border(&self) -> &[f32] {
        self.video_of(self.bins.end - self.faded_bins..self.bins.end + self.faded_bins)
    }

    /// The video of the [`Chunked::faded_bins`] before and after its start, which fades from `before`, the
    /// [`Self::end_border`] of the chunk before, to its own.
    ///
    /// # Panics
    /// If `before` has another size.
    pub fn faded_from(&self, before: &[f32]) -> Vec<f32> {
        let first = self.bins.start - self.faded_bins;
        let after = self.video_of(first..self.bins.start + self.faded_bins);
        assert_eq!(before.len(), after.len(), "the same bins");
        let pixels = self.reconstruction.video.shape().pixels();
        let bins = before.chunks_exact(pixels).zip(after.chunks_exact(pixels));
        let mixed = bins.enumerate().flat_map(|(bin, (before, after))| {
            let share = (bin as f32 + 0.5) / (2 * self.faded_bins) as f32;
            before
                .iter()
                .zip(after)
                .map(move |(b, a)| (1.0 - share) * b + share * a)
        });
        mixed.collect()
    }

    /// Its video of some of the bins that it was solved with.
    fn video_of(&self, bins: Range<usize>) -> &[f32] {
        let video = &self.reconstruction.video;
        let pixels = video.shape().pixels();
        let first = bins.start - self.solved_bins.start;
        &video.data()[first * pixels..][..bins.len() * pixels]
    }
}
