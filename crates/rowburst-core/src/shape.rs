//! The shape of a video.

/// Shape of a video: time bins, rows, columns (`[t, y, x]`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Shape {
    /// Number of time bins.
    pub bins: usize,
    /// Number of rows (`y`).
    pub rows: usize,
    /// Number of columns (`x`).
    pub columns: usize,
}

impl Shape {
    /// A shape from its three lengths.
    #[inline]
    pub fn new(bins: usize, rows: usize, columns: usize) -> Self {
        Self {
            bins,
            rows,
            columns,
        }
    }

    /// Pixels of one bin.
    #[inline]
    pub fn pixels(&self) -> usize {
        self.rows * self.columns
    }

    /// Voxels of the video.
    #[inline]
    pub fn voxels(&self) -> usize {
        self.bins * self.pixels()
    }
}

impl std::fmt::Display for Shape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}×{}×{} (t, y, x)", self.bins, self.rows, self.columns)
    }
}
