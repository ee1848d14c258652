//! What all frames of one experiment share.

use crate::forward::RollingShutter;
use crate::forward::gram::element_bytes;
use crate::{Camera, PatchSet};
use faer::Mat;
use rayon::prelude::*;
use std::sync::Arc;

/// Gram blocks larger than this, or in total than that, are not built.
const MAX_BLOCK_SIZE: usize = 4096;
const MAX_GRAM_BYTES: usize = 4 << 30;

/// Camera and PSF with what is computed from them alone: the operator `A` with the spectra of
/// the PSF and, where they are kept, the blocks of `A Aᵀ`.
///
/// Cheap to clone, and shared by all threads.
#[derive(Clone)]
pub struct Model {
    camera: Camera,
    psfs: PatchSet,
    shutter: Arc<RollingShutter>,
    scale: f64,
    gram: Option<Arc<Vec<Mat<f64>>>>,
}

impl Model {
    /// The model of one frame. `psf` is one for the whole field (`&Psf`) or one for each part
    /// of it (`&PatchSet`).
    pub fn new(camera: &Camera, psf: impl Into<PatchSet>) -> Self {
        let psfs = psf.into();
        let shutter = Arc::new(RollingShutter::new(camera, psfs.clone()));
        let (rows, columns) = shutter.frame_shape();
        let row = camera.sensor_rows().nth(rows / 4);
        // Halfway between the middle and the edge of a whole sensor.
        let scale = shutter
            .pixel_power(row.expect("a frame has rows"), columns / 4)
            .max(f64::MIN_POSITIVE);
        Self {
            camera: camera.clone(),
            psfs,
            shutter,
            scale,
            gram: None,
        }
    }

    /// Keeps the blocks of `A Aᵀ` of the whole field for all the frames to come: the same
    /// numbers as without. Cost: the set-up of one frame, and 8 bytes for each element
    /// (20 MB for 108×108×54). Where blocks are too large nothing is kept.
    #[must_use]
    pub fn with_cached_gram(mut self) -> Self {
        if self.gram.is_none() && self.gram_bytes().is_some() {
            let (_, columns) = self.shutter.frame_shape();
            let rows = self.shutter.rows_of_instants().par_iter().enumerate();
            let blocks = rows.map(|(instant, rows)| {
                let size = rows.len() * columns;
                let mut block = Mat::zeros(size, size);
                self.shutter.add_gram_block(instant, None, block.as_mut());
                block
            });
            self.gram = Some(Arc::new(blocks.collect()));
        }
        self
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The PSF, or those of the parts of the field.
    pub fn psfs(&self) -> &PatchSet {
        &self.psfs
    }

    /// `A`.
    pub fn operator(&self) -> &RollingShutter {
        &self.shutter
    }

    /// `A`, to be shared.
    pub(super) fn shutter(&self) -> &Arc<RollingShutter> {
        &self.shutter
    }

    /// Typical size of a diagonal element of `A Aᵀ`.
    pub(super) fn scale(&self) -> f64 {
        self.scale
    }

    /// Memory of the blocks of `A Aᵀ`, which each frame at work has for itself (half of it on sensors of less than 1024
    /// columns as long as f32 is enough; up to three quarters more while bins are found on a support); `None`
    /// where they are too large to be built.
    pub fn gram_bytes(&self) -> Option<usize> {
        let (_, columns) = self.shutter.frame_shape();
        let rows = self.shutter.rows_of_instants().iter();
        let sizes = || rows.clone().map(|rows| rows.len() * columns);
        let bytes: usize = sizes()
            .map(|size| element_bytes(columns) * size * size)
            .sum();
        let is_small = sizes().all(|size| size <= MAX_BLOCK_SIZE) && bytes <= MAX_GRAM_BYTES;
        is_small.then_some(bytes)
    }

    /// The block of `A Aᵀ` of an instant, where it was kept.
    pub(super) fn cached_block(&self, instant: usize) -> Option<&Mat<f64>> {
        self.gram.as_ref()?.get(instant)
    }
}
