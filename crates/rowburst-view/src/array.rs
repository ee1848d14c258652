//! A video that is read bin by bin, as 16-bit numbers with their scale.

use rowburst::{Error, ErrorKind, Result, Video};
use rowburst_io::{Frames, open_recording};
use std::path::Path;

/// Stands for a value that is not finite.
const MISSING: u16 = u16::MAX;
/// The number that the largest value becomes.
const TOP: f32 = 65_534.0;

/// A video on disk: `.npy` `[t, y, x]` or a multi-page `.tif`.
pub struct Array {
    frames: Box<dyn Frames>,
    rows: usize,
    columns: usize,
    range: (f32, f32),
}

/// Some bins as 16-bit numbers: `value = low + number·(high − low)/65534`; 65535 is no value.
#[derive(Debug, Clone, PartialEq)]
pub struct QuantisedBins {
    /// Little-endian, bin after bin.
    pub bytes: Vec<u8>,
    /// Value of 0 and value of 65534.
    pub range: (f32, f32),
}

impl Array {
    /// Opens a file; with a `range` that is known no bin is read.
    ///
    /// # Errors
    /// A file that is no video, or (where the range is not known) whose bins cannot be read.
    pub fn open(path: &Path, range: Option<(f32, f32)>) -> Result<Self> {
        if path.is_dir() {
            return Err(Error::input(
                path,
                "a folder",
                "a video is one file, .npy [t, y, x] or multi-page .tif",
                "Give the file, or the folder of a result.",
            ));
        }
        let frames = open_recording(path)?;
        let first = frames.read(0)?.image;
        // A file that was cut short is found before the page is.
        frames.read(frames.count() - 1)?;
        let known = range.filter(|(low, high)| low.is_finite() && high.is_finite() && low < high);
        let mut array = Self {
            rows: first.rows(),
            columns: first.columns(),
            range: known.unwrap_or((0.0, 1.0)),
            frames,
        };
        if known.is_none() {
            array.range = array.scan()?;
        }
        Ok(array)
    }

    /// Bins, rows and columns.
    pub fn shape(&self) -> [usize; 3] {
        [self.frames.count(), self.rows, self.columns]
    }

    /// Smallest and largest value that can be told apart.
    pub fn range(&self) -> (f32, f32) {
        self.range
    }

    /// Bytes of a bin as it is sent.
    pub fn bytes_per_bin(&self) -> usize {
        2 * self.rows * self.columns
    }

    /// The bins from `from` up to, but without, `to`.
    ///
    /// # Errors
    /// A file that is damaged or has changed.
    ///
    /// # Panics
    /// If the bins do not exist.
    pub fn bins(&self, from: usize, to: usize) -> Result<QuantisedBins> {
        assert!(from <= to && to <= self.frames.count(), "bins that exist");
        let mut bytes = Vec::with_capacity((to - from) * self.bytes_per_bin());
        for t in from..to {
            push16(self.bin(t)?.data(), self.range, &mut bytes);
        }
        let range = self.range;
        Ok(QuantisedBins { bytes, range })
    }

    fn bin(&self, t: usize) -> Result<rowburst::Image> {
        let image = self.frames.read(t)?.image;
        if (image.rows(), image.columns()) != (self.rows, self.columns) {
            return Err(Error::input(
                self.frames.path(),
                format!("{}×{} pixels in bin {t}", image.rows(), image.columns()),
                format!("all bins have {}×{}", self.rows, self.columns),
                "Save it again with bins of one size.",
            )
            .with_kind(ErrorKind::Shape));
        }
        Ok(image)
    }

    fn scan(&self) -> Result<(f32, f32)> {
        let mut range = (f32::INFINITY, f32::NEG_INFINITY);
        for t in 0..self.frames.count() {
            let (low, high) = range_of(self.bin(t)?.data());
            range = (range.0.min(low), range.1.max(high));
        }
        Ok(including_zero(range))
    }
}

/// Smallest and largest finite value; (∞, −∞) where there is none.
fn range_of(values: &[f32]) -> (f32, f32) {
    let finite = values.iter().copied().filter(|v| v.is_finite());
    finite.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    })
}

/// A range of which 0 is a part, so that dark is dark, and that is not empty.
fn including_zero((low, high): (f32, f32)) -> (f32, f32) {
    let (low, high) = (low.min(0.0), high.max(0.0));
    if low < high { (low, high) } else { (0.0, 1.0) }
}

fn push16(values: &[f32], (low, high): (f32, f32), bytes: &mut Vec<u8>) {
    let scale = TOP / (high - low);
    bytes.extend(values.iter().flat_map(|&v| {
        let number = if v.is_finite() {
            ((v - low) * scale).clamp(0.0, TOP).round() as u16
        } else {
            MISSING
        };
        number.to_le_bytes()
    }));
}

impl QuantisedBins {
    /// A whole video, such as that of a running reconstruction.
    pub fn of(values: &[f32]) -> Self {
        let range = including_zero(range_of(values));
        let mut bytes = Vec::with_capacity(2 * values.len());
        push16(values, range, &mut bytes);
        Self { bytes, range }
    }
}

/// A video as 8-bit numbers with its scale, `value = low + number·(high − low)/254`; 255 is no
/// value: for a page that has to be one small file.
pub fn quantise8(video: &Video) -> (Vec<u8>, (f32, f32)) {
    let (low, high) = including_zero(range_of(video.data()));
    let scale = 254.0 / (high - low);
    let number = |&v: &f32| {
        if v.is_finite() {
            ((v - low) * scale).clamp(0.0, 254.0).round() as u8
        } else {
            u8::MAX
        }
    };
    (video.data().iter().map(number).collect(), (low, high))
}

/// The range that [`Array::open`] takes for a video that is in memory.
pub fn range_of_video(video: &Video) -> (f32, f32) {
    including_zero(range_of(video.data()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::Shape;
    use rowburst_io::{OutputFolder, write_npy_video};

    fn video() -> Video {
        let data = (0..3 * 4 * 5).map(|i| i as f32 * 0.25 - 2.0).collect();
        Video::new(Shape::new(3, 4, 5), data).unwrap()
    }

    #[test]
    fn bins_come_back_within_half_a_step() {
        let folder = tempfile::tempdir().unwrap();
        let out = OutputFolder::create(folder.path()).unwrap();
        let video = video();
        out.write("v.npy", |w| write_npy_video(w, &video)).unwrap();
        let array = Array::open(&folder.path().join("v.npy"), None).unwrap();
        assert_eq!(array.shape(), [3, 4, 5]);
        assert_eq!(array.range(), (-2.0, 12.75));
        let found = array.bins(1, 3).unwrap();
        let step = (found.range.1 - found.range.0) / TOP;
        let numbers = found.bytes.as_chunks::<2>().0;
        assert_eq!(numbers.len(), 40);
        for (n, wanted) in numbers.iter().zip(&video.data()[20..]) {
            let value = found.range.0 + f32::from(u16::from_le_bytes(*n)) * step;
            assert!((value - wanted).abs() <= 0.51 * step, "{value} {wanted}");
        }
    }

    #[test]
    fn what_is_not_finite_stays_apart() {
        let found = QuantisedBins::of(&[0.0, f32::NAN, 4.0, f32::INFINITY]);
        assert_eq!(found.range, (0.0, 4.0));
        assert_eq!(found.bytes, [0, 0, 255, 255, 254, 255, 255, 255]);
        let (numbers, range) = quantise8(&video());
        assert_eq!(range, (-2.0, 12.75));
        assert_eq!((numbers[0], numbers[59]), (0, 254));
    }

    #[test]
    fn a_file_cut_short_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let out = OutputFolder::create(folder.path()).unwrap();
        out.write("v.npy", |w| write_npy_video(w, &video()))
            .unwrap();
        let path = folder.path().join("v.npy");
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 30]).unwrap();
        let error = Array::open(&path, Some((0.0, 1.0))).err().unwrap();
        assert!(error.to_string().contains("cut short"), "{error}");
    }
}
