//! The reconstructed or simulated video.

use rowburst_core::{Error, ErrorKind, Parameter, Result, Shape};

/// A video `[t, y, x]` in C order, in counts of the frame: with a PSF of sum 1 those that a place would
/// give in one row time without the diffuser.
#[derive(Debug, Clone, PartialEq)]
pub struct Video {
    shape: Shape,
    data: Vec<f32>,
}

impl Video {
    /// Wraps `data` of length `shape.voxels()`.
    ///
    /// # Errors
    /// An empty shape, or a length that does not match.
    pub fn new(shape: Shape, data: Vec<f32>) -> Result<Self> {
        if shape.voxels() == 0 || data.len() != shape.voxels() {
            return Err(Error::input(
                Parameter::Video,
                format!("{} values for {shape}", data.len()),
                "a video has at least one voxel and one value for each",
                "Check that the array is three-dimensional and not empty.",
            )
            .with_kind(ErrorKind::Shape));
        }
        Ok(Self { shape, data })
    }

    /// A video of zeros.
    ///
    /// # Panics
    /// If a side is zero.
    pub fn zeros(shape: Shape) -> Self {
        assert!(shape.voxels() > 0, "a video has at least one voxel");
        Self {
            shape,
            data: vec![0.0; shape.voxels()],
        }
    }

    /// Its shape.
    #[inline]
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// The voxels, bin after bin.
    #[inline]
    pub fn data(&self) -> &[f32] {
        &self.data
    }

    /// The voxels, bin after bin, to be changed.
    pub fn data_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// The voxels, bin after bin, without the video.
    pub fn into_data(self) -> Vec<f32> {
        self.data
    }

    /// Bin `t`, row after row.
    #[inline]
    pub fn bin(&self, t: usize) -> &[f32] {
        let pixels = self.shape.pixels();
        &self.data[t * pixels..(t + 1) * pixels]
    }

    /// Bin `t`, row after row, to be changed.
    pub fn bin_mut(&mut self, t: usize) -> &mut [f32] {
        let pixels = self.shape.pixels();
        &mut self.data[t * pixels..(t + 1) * pixels]
    }

    /// The value of pixel `(y, x)` in every bin.
    pub fn trace(&self, y: usize, x: usize) -> Vec<f32> {
        let at = y * self.shape.columns + x;
        (0..self.shape.bins).map(|t| self.bin(t)[at]).collect()
    }

    /// Largest voxel.
    pub fn max(&self) -> f32 {
        self.data.iter().copied().fold(f32::NEG_INFINITY, f32::max)
    }
}
