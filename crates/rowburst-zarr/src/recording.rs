//! A Zarr array `[frame, y, x]` as a recording.

use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Image, Result};
use rowburst_io::{Capture, Frames, IntegerFrame, SampleFormat};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::array::chunk_cache::{ChunkCache, ChunkCacheDecodedLruChunkLimit};

use zarrs::array::{Array, ArraySubset, CodecOptions};
use zarrs::filesystem::FilesystemStore;
use zarrs::storage::ReadableStorageTraits;

/// Decoded chunks that are kept: a chunk of several frames is decoded once for all of them, also
/// where several threads are on both sides of its end.
const CHUNKS_KEPT: u64 = 2;

/// Whether `path` is a Zarr array or group, of version 2 or 3.
pub fn is_zarr(path: &Path) -> bool {
    let has = |name| path.join(name).is_file();
    has("zarr.json") || has(".zarray") || has(".zgroup")
}

/// Opens the array `[frame, y, x]` at `path`, or the first resolution of the OME-Zarr image.
/// Axes of length 1 (a channel, a depth) are left out.
///
/// # Errors
/// What is no array of three axes of numbers, or cannot be read.
pub fn open_zarr_recording(path: &Path) -> Result<Box<dyn Frames>> {
    let array_path = array_of(path)?;
    let error = |found: String, rule: &'static str, remedy: &'static str| {
        Error::input(&array_path, found, rule, remedy).with_kind(ErrorKind::Unreadable)
    };
    let unreadable = |reason: &dyn std::fmt::Display| {
        error(
            format!("data that cannot be read as a Zarr array ({reason})"),
            "a recording is a Zarr array [frame, y, x], or an OME-Zarr image of it",
            "Name the array inside the group, such as GROUP.zarr/0.",
        )
    };
    let store = FilesystemStore::new(&array_path).map_err(|e| unreadable(&e))?;
    let store: Arc<dyn ReadableStorageTraits> = Arc::new(store);
    let array = Array::open(store, "/").map_err(|e| unreadable(&e))?;
    let shape = array.shape().to_vec();
    let kind = Kind::of(&array).ok_or_else(|| {
        error(
            format!("elements of type {:?}", array.data_type()),
            "pixels are integers of 8 to 64 bits or floating point of 32 or 64",
            "Convert the array with numpy.astype and save it again.",
        )
    })?;
    // The first axis is that of the frames, also where there is but one.
    let sides = shape.len().checked_sub(2).filter(|&rest| rest >= 1);
    let is_recording =
        |y: &usize| shape.iter().all(|&n| n > 0) && shape[1..*y].iter().all(|&n| n == 1);
    let sides = sides.filter(is_recording).map(|y| [y, y + 1]);
    let Some(sides) = sides else {
        return Err(error(
            format!("an array of shape {shape:?}"),
            "a recording has the axes [frame, y, x], none of them empty; others have length 1",
            "Save that part as a separate array.",
        ));
    };
    Ok(Box::new(ZarrRecording {
        path: path.into(),
        kind,
        rows: shape[sides[0]] as usize,
        columns: shape[sides[1]] as usize,
        cache: ChunkCacheDecodedLruChunkLimit::new(Arc::new(array), CHUNKS_KEPT),
        shape,
    }))
}

/// The array that `path` is, or the first resolution of the image that the group is.
fn array_of(path: &Path) -> Result<PathBuf> {
    let json = |name: &str| -> Option<Value> {
        let text = std::fs::read_to_string(path.join(name)).ok()?;
        serde_json::from_str(&text).ok()
    };
    let (group, is_array) = match json("zarr.json") {
        Some(metadata) => {
            let is_array = metadata["node_type"] == "array";
            (Some(metadata["attributes"]["ome"].clone()), is_array)
        }
        None => (json(".zattrs"), path.join(".zarray").is_file()),
    };
    if is_array {
        return Ok(path.into());
    }
    let image = group.and_then(|ome| {
        let first = ome["multiscales"][0]["datasets"][0]["path"].as_str();
        first.map(|first| path.join(first))
    });
    image.ok_or_else(|| {
        Error::input(
            path,
            "a Zarr group that is no OME-Zarr image",
            "a recording is a Zarr array [frame, y, x], or an OME-Zarr image of it",
            "Name the array inside the group, such as GROUP.zarr/frames.",
        )
    })
}

struct ZarrRecording {
    path: PathBuf,
    kind: Kind,
    shape: Vec<u64>,
    rows: usize,
    columns: usize,
    cache: ChunkCacheDecodedLruChunkLimit,
}

impl ZarrRecording {
    /// Where frame `index` is in the array.
    fn subset(&self, index: usize) -> ArraySubset {
        let (index, sides) = (index as u64, self.shape[1..].iter());
        let ranges: Vec<_> = std::iter::once(index..index + 1)
            .chain(sides.map(|&n| 0..n))
            .collect();
        ArraySubset::new_with_ranges(&ranges)
    }

    /// The error of a frame that cannot be read.
    fn damaged(&self, index: usize, reason: &str) -> Error {
        Error::input(
            Subject::in_file(&self.path, format!("frame {index}")),
            format!("a frame that cannot be read ({reason})"),
            "every chunk of the array must be whole",
            "Copy or save the array again: a chunk is damaged.",
        )
    }
}

impl Frames for ZarrRecording {
    fn path(&self) -> &Path {
        &self.path
    }

    fn count(&self) -> usize {
        self.shape[0] as usize
    }

    fn name(&self, index: usize) -> String {
        format!("[{index}]")
    }

    fn read(&self, index: usize) -> Result<Capture> {
        let data = self.kind.read(&self.cache, &self.subset(index));
        let data = data.map_err(|reason| self.damaged(index, &reason))?;
        Ok(Capture {
            image: Image::new(self.rows, self.columns, data)?,
            format: self.kind.format(),
        })
    }

    fn read_integers(&self, index: usize) -> Result<IntegerFrame> {
        let data = self.kind.read_wide(&self.cache, &self.subset(index));
        match data.map_err(|reason| self.damaged(index, &reason))? {
            Some(data) => Ok(IntegerFrame {
                rows: self.rows,
                columns: self.columns,
                data,
                format: self.kind.format(),
            }),
            None => self.read(index).map(IntegerFrame::from),
        }
    }
}

/// Kinds of numbers that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl Kind {
    fn of(array: &Array<dyn ReadableStorageTraits>) -> Option<Self> {
        use zarrs::array::data_type as known;
        let kinds = [
            (known::uint8(), Self::U8),
            (known::int8(), Self::I8),
            (known::uint16(), Self::U16),
            (known::int16(), Self::I16),
            (known::uint32(), Self::U32),
            (known::int32(), Self::I32),
            (known::uint64(), Self::U64),
            (known::int64(), Self::I64),
            (known::float32(), Self::F32),
            (known::float64(), Self::F64),
        ];
        let mut kinds = kinds.into_iter();
        kinds.find_map(|(known, kind)| (known == *array.data_type()).then_some(kind))
    }

    fn format(self) -> SampleFormat {
        let counts = |bits| SampleFormat::Counts { bits };
        match self {
            Self::U8 => counts(8),
            Self::I8 => counts(7),
            Self::U16 => counts(16),
            Self::I16 => counts(15),
            Self::U32 => counts(32),
            Self::I32 => counts(31),
            Self::U64 => counts(64),
            Self::I64 => counts(63),
            Self::F32 | Self::F64 => SampleFormat::Float,
        }
    }

    fn read(
        self,
        cache: &ChunkCacheDecodedLruChunkLimit,
        subset: &ArraySubset,
    ) -> std::result::Result<Vec<f32>, String> {
        // Decoding on the thread that asks: the others have frames of their own.
        let options = CodecOptions::default().with_concurrent_target(1);
        macro_rules! read {
            ($t:ty) => {
                cache
                    .retrieve_array_subset::<Vec<$t>>(subset, &options)
                    .map(|values| values.into_iter().map(|v| v as f32).collect())
                    .map_err(|e| e.to_string())
            };
        }
        match self {
            Self::U8 => read!(u8),
            Self::I8 => read!(i8),
            Self::U16 => read!(u16),
            Self::I16 => read!(i16),
            Self::U32 => read!(u32),
            Self::I32 => read!(i32),
            Self::U64 => read!(u64),
            Self::I64 => read!(i64),
            Self::F32 => read!(f32),
            Self::F64 => read!(f64),
        }
    }

    /// Integers of 32 or 64 bits, exactly; `None`: numbers of another kind.
    fn read_wide(
        self,
        cache: &ChunkCacheDecodedLruChunkLimit,
        subset: &ArraySubset,
    ) -> std::result::Result<Option<Vec<i64>>, String> {
        let options = CodecOptions::default().with_concurrent_target(1);
        macro_rules! read {
            ($t:ty) => {
                cache
                    .retrieve_array_subset::<Vec<$t>>(subset, &options)
                    .map(|values| Some(values.into_iter().map(|v| v as i64).collect()))
                    .map_err(|e| e.to_string())
            };
        }
        match self {
            Self::U32 => read!(u32),
            Self::I32 => read!(i32),
            Self::U64 => read!(u64),
            Self::I64 => read!(i64),
            _ => Ok(None),
        }
    }
}
