//! The model of a camera with its PSF, which all frames of an experiment share.

use faer::Mat;
use rayon::prelude::*;
use rowburst_core::Cancel;
use rowburst_optics::forward::RollingShutter;
use rowburst_optics::forward::gram::{add_gram_block, element_bytes};
use rowburst_optics::forward::mean_field::MeanField;
use rowburst_optics::{Camera, PatchSet};
use std::sync::{Arc, OnceLock};
use tracing::debug;

/// Measurements of a block above which no blocks are built; then conjugate gradients solve the x-step
/// (docs/design/004).
const MAX_BLOCK_SIZE: usize = 4096;
/// Bytes of all blocks above which none are built; larger allows exact steps on larger sensors (docs/design/004).
const MAX_GRAM_BYTES: usize = 4 << 30;

/// Measurements of an instant from which its rows may have factors; fewer leave the place of light to the prior
/// (docs/design/032).
const MIN_PLACING: usize = 64;

/// Copies of the video in f32 that a reconstruction holds at its peak, beside the blocks.
const VIDEO_COPIES: usize = 8;

/// Memory of the blocks of `A Aᵀ` in bytes; `None` where they are too large to be built.
fn gram_bytes(camera: &Camera) -> Option<usize> {
    let columns = camera.columns();
    let mut row_counts = vec![0; camera.time().instants().len()];
    camera.instants().iter().for_each(|&k| row_counts[k] += 1);
    let sizes = || row_counts.iter().map(|rows| rows * columns);
    let bytes: usize = sizes()
        .map(|size| element_bytes(columns) * size * size)
        .sum();
    let is_small = sizes().all(|size| size <= MAX_BLOCK_SIZE) && bytes <= MAX_GRAM_BYTES;
    is_small.then_some(bytes)
}

/// Camera and PSF, with the values that depend on them alone: the operator `A` with the spectra of the
/// PSF and, if cached, the blocks of `A Aᵀ`.
///
/// Cheap to clone: clones share the operator and the blocks.
#[derive(Clone)]
pub struct Model {
    camera: Camera,
    psfs: PatchSet,
    shutter: Arc<RollingShutter>,
    /// See [`RollingShutter::equilibrated`].
    equilibrated: Option<Arc<RollingShutter>>,
    /// Typical size of a diagonal element of `A Aᵀ`, and of that with the equilibrated operator.
    scale: f64,
    equilibrated_scale: f64,
    /// The cached blocks of `B Bᵀ`, one for each instant; `B` is the equilibrated operator, or `A` where there is none.
    gram: Option<Arc<Vec<Mat<f64>>>>,
    /// Those of `A Aᵀ` and of that with the equilibrated operator.
    mean_fields: Arc<[OnceLock<Arc<MeanField>>; 2]>,
    cancel: Cancel,
}

impl Model {
    /// A model without cached blocks. `psf` is one PSF for the whole field (`&Psf`) or one for each patch
    /// of it (`&PatchSet`).
    pub fn new(camera: &Camera, psf: impl Into<PatchSet>) -> Self {
        let psfs = psf.into();
        let shutter = Arc::new(RollingShutter::new(camera, psfs.clone()));
        let (rows, columns) = shutter.frame_shape();
        // A pixel halfway between the middle and the edge of the sensor stands for a typical one.
        let row = camera.sensor_rows().nth(rows / 4);
        let mut rows_of_instants = shutter.rows_of_instants().iter();
        let places_light = rows_of_instants.any(|rows| rows.len() * columns >= MIN_PLACING);
        let equilibrated = places_light.then(|| shutter.equilibrated()).flatten();
        let equilibrated = equilibrated.map(Arc::new);
        let row = row.expect("a frame has rows");
        let scale_of = |operator: &RollingShutter| {
            let power = operator.pixel_power(row, columns / 4);
            power.max(f64::MIN_POSITIVE)
        };
        let scale = scale_of(&shutter);
        let equilibrated_scale = equilibrated.as_deref().map_or(scale, scale_of);
        debug!(
            "set up the operator: video of {}, frame of {rows}×{columns}, PSFs: {}",
            shutter.video_shape(),
            psfs.psfs().len()
        );
        Self {
            camera: camera.clone(),
            psfs,
            shutter,
            equilibrated,
            scale,
            equilibrated_scale,
            gram: None,
            mean_fields: Arc::default(),
            cancel: Cancel::default(),
        }
    }

    /// The same model, for runs that `cancel` stops, their set-up included.
    #[must_use]
    pub fn with_cancel(self, cancel: &Cancel) -> Self {
        Self {
            cancel: cancel.clone(),
            ..self
        }
    }

    /// The model of a scene at rest, see [`Camera::at_rest`].
    pub(super) fn at_rest(&self) -> Self {
        Self::new(&self.camera.at_rest(), self.psfs.clone()).with_cancel(&self.cancel)
    }

    /// What stops its runs.
    pub fn cancel(&self) -> &Cancel {
        &self.cancel
    }

    /// Caches the blocks of `A Aᵀ` for all voxels, so that later frames are set up faster. The numbers
    /// stay the same. Costs the set-up of one frame, and 8 bytes for each element of the blocks. Blocks
    /// that are too large (see [`Self::gram_bytes`]) are not cached.
    #[must_use]
    pub fn with_cached_gram(mut self) -> Self {
        if self.gram.is_none() && self.gram_bytes().is_some() {
            let solved = self.solved_operator();
            let (_, columns) = solved.frame_shape();
            let rows = solved.rows_of_instants().par_iter().enumerate();
            let blocks = rows.map(|(instant, rows)| {
                let size = rows.len() * columns;
                let mut block = Mat::zeros(size, size);
                if !self.cancel.is_cancelled() {
                    add_gram_block(solved, instant, None, block.as_mut());
                }
                block
            });
            let blocks: Vec<_> = blocks.collect();
            // Those of a cancelled set-up are not complete.
            self.gram = (!self.cancel.is_cancelled()).then(|| Arc::new(blocks));
        }
        self
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The PSF, or one PSF for each patch of the field.
    pub fn psfs(&self) -> &PatchSet {
        &self.psfs
    }

    /// The operator `A`.
    pub fn operator(&self) -> &RollingShutter {
        &self.shutter
    }

    /// The operator `A`, shared.
    pub(super) fn shutter(&self) -> &Arc<RollingShutter> {
        &self.shutter
    }

    /// The operator of what the solver looks for where the video has no background: `A D`, see
    /// [`RollingShutter::equilibrated`], or `A`.
    pub(super) fn solved_operator(&self) -> &Arc<RollingShutter> {
        self.equilibrated.as_ref().unwrap_or(&self.shutter)
    }

    /// Typical size of a diagonal element of `B Bᵀ`, with `B` the `operator`: `A` or [`Self::solved_operator`].
    pub(super) fn scale(&self, operator: &RollingShutter) -> f64 {
        if operator.is_equilibrated() {
            self.equilibrated_scale
        } else {
            self.scale
        }
    }

    /// Memory of the blocks of `A Aᵀ` in bytes; `None` where they are too large to be built.
    ///
    /// Each frame that is being reconstructed has blocks of its own. On sensors of less than 1024 columns
    /// they take half of this memory as long as f32 suffices. A support takes up to three quarters more.
    pub fn gram_bytes(&self) -> Option<usize> {
        gram_bytes(&self.camera)
    }

    /// Memory in bytes that [`Self::with_cached_gram`] keeps; 0 where it caches nothing.
    pub fn cached_gram_bytes(camera: &Camera) -> u64 {
        let elements =
            gram_bytes(camera).map_or(0, |bytes| bytes / element_bytes(camera.columns()));
        (elements * size_of::<f64>()) as u64
    }

    /// Typical peak memory of a reconstruction in bytes, before anything is allocated; `None` where the number itself is
    /// too large.
    pub fn run_bytes(camera: &Camera) -> Option<u64> {
        let shape = camera.video_shape();
        let sides = [shape.bins, shape.rows, shape.columns, VIDEO_COPIES, 4];
        let sides = sides.iter().map(|&side| side as u64);
        let videos = sides.reduce(|a, b| a.saturating_mul(b))?;
        let has_blocks = camera.time().is_disjoint();
        let gram = gram_bytes(camera).filter(|_| has_blocks).unwrap_or(0) as u64;
        // Blocks begin in f32.
        let gram = gram / element_bytes(camera.columns()) as u64 * 4;
        videos.checked_add(gram).filter(|bytes| *bytes < u64::MAX)
    }

    /// The mean field of `operator`, `A` or [`Self::solved_operator`]; the first call computes it.
    pub(super) fn mean_field(&self, operator: &RollingShutter) -> Arc<MeanField> {
        let mean_field = &self.mean_fields[usize::from(operator.is_equilibrated())];
        Arc::clone(mean_field.get_or_init(|| Arc::new(MeanField::new(operator))))
    }

    /// The cached block of an instant for `operator`, `A` or [`Self::solved_operator`].
    pub(super) fn cached_block(
        &self,
        operator: &Arc<RollingShutter>,
        instant: usize,
    ) -> Option<&Mat<f64>> {
        let is_cached = Arc::ptr_eq(operator, self.solved_operator());
        self.gram.as_ref().filter(|_| is_cached)?.get(instant)
    }
}
