//! Reconstruction of a video too large for memory, in chunks of bins.
//!
//! Where no exposure is longer than a row time, each bin is seen by its own rows alone, so `A` is block-diagonal
//! in time. With a prior of space alone the problem separates, too:
//!
//! ```text
//! min Σ_k ½‖W_k(b_k − A_k v_k)‖² + τ R(v_k),   v ≥ 0
//! ```
//!
//! Each chunk `k` is a problem of its own, with the rows that read its bins ([`Camera::subset`]). With `τ`
//! given, the chunks together are the minimiser of the whole problem. Under the discrepancy principle each
//! chunk has its own `τ`, at which its residual matches the noise level of the whole frame.

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
/// Copies of a chunk's video that its reconstruction holds.
const VIDEO_COPIES: usize = 6;

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
    /// A prior that couples bins, exposures longer than a row time, a video of one bin, a flat PSF
    /// ([`PatchSet::check_contrast`]), or a noise level that only held-out pixels could determine.
    pub fn new(
        camera: Camera,
        psfs: PatchSet,
        measurement: Measurement,
        options: Options,
    ) -> Result<Self> {
        let prior = options.prior.unwrap_or(Prior::SEPARABLE);
        prior.check_separable_in_time()?;
        let time = camera.time();
        if !time.is_disjoint() || time.bins() == 1 {
            return Err(Error::input(
                Parameter::ExposureUs,
                camera.params().exposure_us,
                "reconstruction in chunks needs each bin to be exposed at one instant: a rolling shutter with exposures of at most one row time",
                phrase![
                    "Leave ",
                    Parameter::PartBins,
                    " out, and make ",
                    Parameter::Field,
                    " smaller or bin the frame if memory is short."
                ],
            ).with_kind(ErrorKind::Unsupported));
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
        let block = (self.camera.rows().div_ceil(instants) * self.camera.columns()).pow(2);
        let element = element_bytes(self.camera.columns());
        VIDEO_COPIES * size_of::<f32>() * shape.pixels() * per_row + element * block
    }

    /// Bytes that a chunk of these bins takes while it is reconstructed.
    pub fn chunk_bytes(&self, bins: &Range<usize>) -> u64 {
        let rows = bins.len().div_ceil(self.camera.params().bins_per_row);
        (rows as u64).saturating_mul(self.row_bytes() as u64)
    }

    /// The bins of each chunk, in order. A chunk has `bins_per_chunk` bins, rounded up to whole rows; `None`:
    /// as many as 3 GiB hold. The ranges depend on camera and `bins_per_chunk` alone.
    pub fn ranges(&self, bins_per_chunk: Option<usize>) -> Vec<Range<usize>> {
        let bins = self.camera.time().bins();
        let per_row = self.camera.params().bins_per_row;
        let fitting = (MAX_CHUNK_BYTES / self.row_bytes()).max(1);
        let fitting_multiple = if fitting > BIN_MULTIPLE {
            fitting - fitting % BIN_MULTIPLE
        } else {
            fitting
        };
        let bins_per_chunk = bins_per_chunk.unwrap_or(per_row * fitting_multiple);
        let bins_per_chunk = bins_per_chunk.next_multiple_of(per_row);
        (0..bins)
            .step_by(bins_per_chunk)
            .map(|first| first..bins.min(first + bins_per_chunk))
            .collect()
    }

    /// Reconstructs the bins of one chunk. `observer` is called after every iteration and may stop the run.
    ///
    /// # Errors
    /// Those of [`Camera::subset`], [`Problem::with_model`] and [`Problem::solve`].
    pub fn solve(
        &self,
        bins: Range<usize>,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<Reconstruction> {
        let part = self.camera.subset(bins)?;
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
        Problem::with_model(&model, &measurement, options)?.solve(observer)
    }
}
