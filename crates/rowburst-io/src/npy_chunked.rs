//! A video that is too large for memory, as an array on disk that is filled bin by bin.

use crate::fault;
use crate::npy::header_of;
use rowburst::{Result, Shape};
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// `NAME.part`, which takes the name once all bins are in it. One that an interrupted run has left is
/// gone on with.
#[derive(Debug)]
pub struct ChunkedVideoFile {
    path: PathBuf,
    partial_path: PathBuf,
    file: File,
    header: usize,
    shape: Shape,
    is_resumed: bool,
}

impl ChunkedVideoFile {
    /// Opens what is there of a float32 array `[t, y, x]` of `shape`, or begins it.
    ///
    /// # Errors
    /// Failed writes; a disk without room for all of it may say so only later.
    pub fn open(path: &Path, shape: Shape) -> Result<Self> {
        let header = header_of("<f4", &[shape.bins, shape.rows, shape.columns]);
        let partial_path = partial_path(path);
        let length = (header.len() + shape.voxels() * size_of::<f32>()) as u64;
        let open = || -> io::Result<(File, bool)> {
            let mut options = OpenOptions::new();
            let mut file = options
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .open(&partial_path)?;
            let mut found = Vec::new();
            (&mut file)
                .take(header.len() as u64)
                .read_to_end(&mut found)?;
            let is_resumed = found == header && file.metadata()?.len() == length;
            if !is_resumed {
                file.set_len(0)?;
                file.rewind()?;
                file.write_all(&header)?;
                // Bins that are not written yet take no room.
                file.set_len(length)?;
            }
            Ok((file, is_resumed))
        };
        let (file, is_resumed) =
            open().map_err(|e| fault::write_error(&e).within(&partial_path))?;
        Ok(Self {
            path: path.into(),
            partial_path,
            file,
            header: header.len(),
            shape,
            is_resumed,
        })
    }

    /// Opens the array of an interrupted run that was complete: it may have its name already, which it gives up again.
    ///
    /// # Errors
    /// Those of [`Self::open`], and a file that cannot be renamed.
    pub fn reopen(path: &Path, shape: Shape) -> Result<Self> {
        let partial_path = partial_path(path);
        if !partial_path.exists() && path.exists() {
            std::fs::rename(path, &partial_path)
                .map_err(|e| fault::write_error(&e).within(path))?;
        }
        Self::open(path, shape)
    }

    /// Whether an interrupted run has left it.
    pub fn is_resumed(&self) -> bool {
        self.is_resumed
    }

    /// Writes whole bins, from `first` on, and waits until they are on disk.
    ///
    /// # Errors
    /// A failed write.
    ///
    /// # Panics
    /// If these are not bins of the video.
    pub fn write(&mut self, first: usize, values: &[f32]) -> Result<()> {
        let pixels = self.shape.pixels();
        assert!(values.len().is_multiple_of(pixels), "whole bins");
        assert!(
            first + values.len() / pixels <= self.shape.bins,
            "bins of the video"
        );
        let start = (self.header + first * pixels * size_of::<f32>()) as u64;
        let mut write = || -> io::Result<()> {
            self.file.seek(SeekFrom::Start(start))?;
            for chunk in values.chunks(1 << 16) {
                let bytes: Vec<u8> = chunk.iter().flat_map(|v| v.to_le_bytes()).collect();
                self.file.write_all(&bytes)?;
            }
            self.file.sync_data()
        };
        write().map_err(|e| fault::write_error(&e).within(&self.partial_path))
    }

    /// Reads a bin.
    ///
    /// # Errors
    /// A failed read.
    pub fn read(&mut self, bin: usize) -> Result<Vec<f32>> {
        let pixels = self.shape.pixels();
        let mut bytes = vec![0u8; pixels * size_of::<f32>()];
        let start = (self.header + bin * bytes.len()) as u64;
        let read = self.file.seek(SeekFrom::Start(start));
        read.and_then(|_| self.file.read_exact(&mut bytes))
            .map_err(|e| fault::read_error(&self.partial_path, &e))?;
        let (values, _) = bytes.as_chunks::<4>();
        Ok(values.iter().map(|v| f32::from_le_bytes(*v)).collect())
    }

    /// All bins are in it: it takes its name.
    ///
    /// # Errors
    /// A file that cannot be renamed.
    pub fn finish(self) -> Result<()> {
        let done = self.file.sync_all();
        done.and_then(|()| std::fs::rename(&self.partial_path, &self.path))
            .map_err(|e| fault::write_error(&e).within(self.path))
    }
}

/// The name of the array `path` until all bins are in it.
fn partial_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".part");
    name.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{read_video, write_npy_video};
    use rowburst::Video;

    #[test]
    fn chunks_make_the_same_file() {
        let folder = tempfile::tempdir().unwrap();
        let shape = Shape::new(5, 3, 4);
        let values: Vec<f32> = (0..60).map(|i| i as f32 * 0.5 - 3.0).collect();
        let path = folder.path().join("video.npy");
        let mut parts = ChunkedVideoFile::open(&path, shape).unwrap();
        assert!(!parts.is_resumed());
        parts.write(3, &values[36..]).unwrap();
        drop(parts);
        assert!(!path.exists());
        let mut parts = ChunkedVideoFile::open(&path, shape).unwrap();
        assert!(parts.is_resumed());
        parts.write(0, &values[..36]).unwrap();
        assert_eq!(parts.read(3).unwrap(), values[36..48]);
        parts.finish().unwrap();
        let video = Video::new(shape, values).unwrap();
        assert_eq!(read_video(&path).unwrap(), video);
        let mut whole = Vec::new();
        write_npy_video(&mut whole, &video).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), whole);
        // One of another shape is begun anew.
        std::fs::rename(&path, folder.path().join("video.npy.part")).unwrap();
        let other = ChunkedVideoFile::open(&path, Shape::new(4, 3, 4)).unwrap();
        assert!(!other.is_resumed());
    }
}
