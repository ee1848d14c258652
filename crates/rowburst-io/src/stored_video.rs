//! A video on disk that is read bin by bin.

use crate::npy::Stack;
use crate::source::{Colour, Source};
use rowburst::{Image, Result, Shape};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// The video `[t, y, x]` of a result, in counts: read bin by bin, so that it need not fit into memory.
#[derive(Debug)]
pub struct StoredVideo {
    path: PathBuf,
    bytes: u64,
    file: BufReader<File>,
    stack: Stack,
}

impl StoredVideo {
    /// Opens a `.npy` file.
    ///
    /// # Errors
    /// A file that is missing or damaged, or an array of another shape.
    pub fn open(path: &Path) -> Result<Self> {
        let (source, mut file) = Source::open(path, Colour::Refused)?;
        Ok(Self {
            path: path.into(),
            bytes: source.bytes,
            stack: Stack::open(&source, &mut file)?,
            file,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bins, rows and columns.
    pub fn shape(&self) -> Shape {
        self.stack.shape()
    }

    /// The picture of bin `t`.
    ///
    /// # Errors
    /// There is no such bin, or the file ends before it.
    pub fn bin(&mut self, t: usize) -> Result<Image> {
        let source = Source {
            path: &self.path,
            bytes: self.bytes,
            colour: Colour::Refused,
        };
        let page = self.stack.frame(&source, &mut self.file, t)?;
        Image::new(page.rows, page.columns, page.data)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::write_npy_video;
    use rowburst::Video;

    #[test]
    fn bins_are_those_of_the_video() {
        let shape = Shape::new(3, 2, 4);
        let values: Vec<f32> = (0..24).map(|i| i as f32 * 0.25).collect();
        let mut bytes = Vec::new();
        write_npy_video(&mut bytes, &Video::new(shape, values.clone()).unwrap()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("video.npy");
        std::fs::write(&path, &bytes).unwrap();
        let mut stored = StoredVideo::open(&path).unwrap();
        assert_eq!((stored.shape(), stored.path()), (shape, path.as_path()));
        for t in [2, 0, 1] {
            assert_eq!(stored.bin(t).unwrap().data(), &values[8 * t..][..8]);
        }
        assert!(stored.bin(3).unwrap_err().to_string().contains("video.npy"));
    }
}
