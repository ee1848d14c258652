//! A video too large for memory, part by part.
//!
//! Where no exposure is longer than a row, each bin is seen by its own rows alone, and `A` falls into
//! blocks. With a prior of space alone the problem does so, too:
//!
//! ```text
//! min Σ_parts ½‖W_k(b_k − A_k v_k)‖² + τ R(v_k),   v ≥ 0
//! ```
//!
//! Each part is a problem of its own, of the rows that read its bins ([`Camera::subset`]). With `τ` given
//! the parts together are the minimiser of the whole; by the discrepancy principle each part has its
//! own `τ`, at which its residual is the noise of the whole frame.

use super::sigma::Bands;
use super::{Model, Options, Prior, Problem, Reconstruction, SigmaSource, noise_of};
use crate::forward::gram::element_bytes;
use crate::measurement::Measurement;
use crate::solve::StopReason;
use crate::solve::admm::Progress;
use crate::{Camera, Error, PatchSet, Result};
use std::ops::{ControlFlow, Range};

/// Memory that a part may take where its size is left open, in bytes: of 2048×2048 pixels with two
/// rows an instant 16 bins, and the process stays below 6 GiB.
const MAX_CHUNK_BYTES: usize = 3 << 30;
/// Bins of a part are a multiple of this where there are as many: threads share them evenly.
const BIN_MULTIPLE: usize = 8;
/// Copies of a part's video that its reconstruction holds.
const VIDEO_COPIES: usize = 6;

/// A frame whose video is found part by part.
pub struct Chunked {
    camera: Camera,
    psfs: PatchSet,
    measurement: Measurement,
    options: Options,
    sigma: f64,
    sigma_source: SigmaSource,
}

impl Chunked {
    /// The parts of `measurement`. The prior is the recipe's, or [`Prior::SEPARABLE`].
    ///
    /// # Errors
    /// A prior that couples bins, exposures longer than a row, and a noise level that cannot be read
    /// from the frame.
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
                "exposure_us",
                camera.params().exposure_us,
                "a video is found part by part where each bin is seen at one instant: by a rolling shutter with exposures of at most a row",
                "Leave --part-bins out, and make [field] smaller or bin the frame if memory is short.",
            ));
        }
        let bands = Bands::new(&measurement, psfs.central());
        let (sigma, sigma_source) = noise_of(&measurement, &bands, &options);
        if sigma_source == SigmaSource::HeldOut && !matches!(options.tau, super::Tau::Given(_)) {
            return Err(Error::input(
                "--noise-sigma",
                "a noise level that cannot be read from the frame",
                "parts share the noise level of the whole frame",
                "Give --noise-sigma, or gain and read noise in [camera].",
            ));
        }
        Ok(Self {
            options: Options {
                prior: Some(prior),
                ..options
            },
            camera,
            psfs,
            measurement,
            sigma,
            sigma_source,
        })
    }

    /// The camera of the whole.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The PSF, or those of the parts of the field.
    pub fn psfs(&self) -> &PatchSet {
        &self.psfs
    }

    /// The frame.
    pub fn measurement(&self) -> &Measurement {
        &self.measurement
    }

    /// The prior of all parts.
    pub fn prior(&self) -> Prior {
        self.options.prior.unwrap_or(Prior::SEPARABLE)
    }

    /// Noise of a pixel with weight 1 in counts, and where it is known from.
    pub fn sigma(&self) -> (f64, SigmaSource) {
        (self.sigma, self.sigma_source)
    }

    /// The parts of `each` bins, or of as many as 3 GiB hold, always the same for the same camera.
    /// Parts begin at a row.
    pub fn ranges(&self, each: Option<usize>) -> Vec<Range<usize>> {
        let (bins, shape) = (self.camera.time().bins(), self.camera.video_shape());
        let instants = self.camera.time().instants().len();
        let per_row = self.camera.params().bins_per_row;
        let block = (self.camera.rows().div_ceil(instants) * self.camera.columns()).pow(2);
        let element = element_bytes(self.camera.columns());
        let bytes = VIDEO_COPIES * size_of::<f32>() * shape.pixels() * per_row + element * block;
        let fitting = (MAX_CHUNK_BYTES / bytes).max(1);
        let even = match fitting > BIN_MULTIPLE {
            true => fitting - fitting % BIN_MULTIPLE,
            false => fitting,
        };
        let each = each.unwrap_or(per_row * even);
        let each = each.next_multiple_of(per_row);
        (0..bins)
            .step_by(each)
            .map(|first| first..bins.min(first + each))
            .collect()
    }

    /// The video of some bins.
    ///
    /// # Errors
    /// Those of [`Camera::subset`], [`Problem::with_model`] and [`Problem::solve`].
    pub fn solve(
        &self,
        bins: Range<usize>,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<Reconstruction> {
        let part = self.camera.subset(bins)?;
        let first = self.camera.sensor_rows().collect::<Vec<_>>();
        let place = |row: usize| {
            first
                .iter()
                .position(|&r| r == row)
                .expect("a row of the whole")
        };
        let rows: Vec<usize> = part.sensor_rows().map(place).collect();
        let measurement = self.measurement.select_rows(&rows);
        let options = Options {
            noise_sigma: Some(self.sigma),
            ..self.options
        };
        let model = Model::new(&part, self.psfs.clone());
        Problem::with_model(&model, &measurement, options)?.solve(observer)
    }
}
