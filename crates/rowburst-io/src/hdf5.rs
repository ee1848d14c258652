//! HDF5: a dataset `[y, x]` or `[frame, y, x]`, found or named; MATLAB v7.3 files are such.
//!
//! MATLAB's first axis is the fastest, so its `(rows, columns, frames)` is HDF5's
//! `[frame, column, row]`: frames lie one after the other, each transposed.

use crate::arrays::{ArrayInfo, choose};
use crate::pages::{Axes, IntegerFrame, Pages, SampleFormat};
use crate::source::{ArrayPath, Source};
use hdf5_pure::{DType, Dataset, File, Group};
use rowburst::Result;

/// Groups in groups that are searched, and datasets that are looked at.
const MAX_DEPTH: usize = 16;
const MAX_DATASETS: usize = 10_000;

/// A dataset that is read frame by frame.
pub(crate) struct Stack {
    dataset: Dataset,
    kind: DType,
    format: SampleFormat,
    axes: Axes,
    count: usize,
    is_single: bool,
    rows: usize,
    columns: usize,
}

impl Stack {
    /// Finds the dataset.
    pub fn open(source: &Source, axes: Axes) -> Result<Self> {
        let fault = |e: hdf5_pure::Error| source.unreadable(e);
        let file = File::open_streaming(ArrayPath::of(source.path).file).map_err(fault)?;
        let mut found = Vec::new();
        search(&file.root(), "", 0, &mut found).map_err(fault)?;
        let chosen = choose(source, &found)?;
        let ArrayInfo { name, shape, .. } = &found[chosen];
        let dataset = file.dataset(name).map_err(fault)?;
        let kind = dataset.dtype().map_err(fault)?;
        let Some(format) = format_of(&kind) else {
            return Err(source.unsupported(format!("{kind} in HDF5")));
        };
        let (count, first, second) = match shape[..] {
            [first, second] => (1, first, second),
            [count, first, second] => (count, first, second),
            _ => unreachable!("the choice has two or three axes"),
        };
        let (rows, columns) = match axes {
            Axes::Plain => (first, second),
            Axes::Matlab => (second, first),
        };
        // The shape is a claim until the numbers are there.
        drop(source.reserve_pixels(1, rows, columns)?);
        Ok(Self {
            is_single: shape.len() == 2,
            dataset,
            kind,
            format,
            axes,
            count,
            rows,
            columns,
        })
    }

    /// The first row of frame `at` in the dataset, and how many it takes.
    fn row_range(&self, at: usize) -> std::result::Result<(u64, u64), hdf5_pure::Error> {
        Ok(if self.is_single {
            (0, self.dataset.shape()?[0])
        } else {
            (at as u64, 1)
        })
    }

    /// The integers of frame `at` where they have 32 or 64 bits; `None`: numbers of another kind.
    fn wide_integers(&self, at: usize) -> std::result::Result<Option<Vec<i64>>, hdf5_pure::Error> {
        let (first, rows) = self.row_range(at)?;
        macro_rules! read {
            ($read:ident) => {
                self.dataset
                    .$read(first, rows)?
                    .into_iter()
                    .map(|v| v as i64)
                    .collect()
            };
        }
        Ok(Some(match self.kind {
            DType::U32 => read!(read_u32_rows),
            DType::I32 => read!(read_i32_rows),
            DType::U64 => read!(read_u64_rows),
            DType::I64 => self.dataset.read_i64_rows(first, rows)?,
            _ => return Ok(None),
        }))
    }

    /// The numbers of frame `at`.
    fn numbers(&self, at: usize) -> std::result::Result<Vec<f32>, hdf5_pure::Error> {
        let (first, rows) = self.row_range(at)?;
        macro_rules! read {
            ($read:ident) => {
                self.dataset
                    .$read(first, rows)?
                    .into_iter()
                    .map(|v| v as f32)
                    .collect()
            };
        }
        Ok(match self.kind {
            DType::F32 => self.dataset.read_f32_rows(first, rows)?,
            DType::F64 => read!(read_f64_rows),
            DType::U8 => read!(read_u8_rows),
            DType::U16 => read!(read_u16_rows),
            DType::I16 => read!(read_i16_rows),
            DType::U32 => read!(read_u32_rows),
            DType::I32 => read!(read_i32_rows),
            DType::U64 => read!(read_u64_rows),
            DType::I64 => read!(read_i64_rows),
            // A mask of h5py is an enumeration of int8.
            _ => read!(read_i8_rows),
        })
    }
}

impl crate::pages::Stack for Stack {
    fn count(&self) -> usize {
        self.count
    }

    fn page(&mut self, source: &Source, at: usize) -> Result<Pages> {
        let mut data = self.numbers(at).map_err(|e| source.unreadable(e))?;
        let (rows, columns) = (self.rows, self.columns);
        if data.len() != rows * columns {
            return Err(source.unreadable("a frame is not whole"));
        }
        if self.axes == Axes::Matlab {
            data = transposed(&data, rows, columns);
        }
        Ok(Pages {
            count: 1,
            rows,
            columns,
            data,
            format: self.format,
        })
    }

    fn integers(&mut self, source: &Source, at: usize) -> Result<IntegerFrame> {
        let wide = self.wide_integers(at).map_err(|e| source.unreadable(e))?;
        let Some(mut data) = wide else {
            let page = self.page(source, at)?;
            return Ok(IntegerFrame::of_pages(&page));
        };
        let (rows, columns) = (self.rows, self.columns);
        if data.len() != rows * columns {
            return Err(source.unreadable("a frame is not whole"));
        }
        if self.axes == Axes::Matlab {
            data = transposed(&data, rows, columns);
        }
        Ok(IntegerFrame {
            rows,
            columns,
            data,
            format: self.format,
        })
    }
}

/// `[y, x]` from numbers whose first index, `y`, is the fastest.
pub(crate) fn transposed<T: Copy>(data: &[T], rows: usize, columns: usize) -> Vec<T> {
    let pixels = (0..rows).flat_map(|y| (0..columns).map(move |x| data[x * rows + y]));
    pixels.collect()
}

fn format_of(kind: &DType) -> Option<SampleFormat> {
    let counts = |bits| Some(SampleFormat::Counts { bits });
    match kind {
        DType::F32 | DType::F64 => Some(SampleFormat::Float),
        DType::U8 => counts(8),
        DType::I8 => counts(7),
        DType::U16 => counts(16),
        DType::I16 => counts(15),
        DType::U32 => counts(32),
        DType::I32 => counts(31),
        DType::U64 => counts(64),
        DType::I64 => counts(63),
        DType::Enum(names) if names == &["FALSE", "TRUE"] => counts(1),
        _ => None,
    }
}

/// All datasets under `group`, in the order of their names.
fn search(
    group: &Group,
    path: &str,
    depth: usize,
    found: &mut Vec<ArrayInfo>,
) -> std::result::Result<(), hdf5_pure::Error> {
    let mut names = group.datasets()?;
    names.sort();
    for name in names {
        if found.len() >= MAX_DATASETS {
            return Ok(());
        }
        let dataset = group.dataset(&name)?;
        let kind = dataset.dtype();
        let shape = dataset.shape()?;
        found.push(ArrayInfo {
            name: format!("{path}/{name}"),
            shape: shape.iter().map(|&n| n as usize).collect(),
            is_numeric: kind.as_ref().is_ok_and(|k| format_of(k).is_some()),
            kind: kind.map_or("unknown".into(), |k| k.to_string()),
        });
    }
    let mut groups = group.groups()?;
    groups.sort();
    for name in groups {
        // What MATLAB's cells and objects point to.
        let is_internal = name.starts_with('#');
        if depth < MAX_DEPTH && !is_internal {
            let inner = group.group(&name)?;
            search(&inner, &format!("{path}/{name}"), depth + 1, found)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use crate::pages::SampleFormat;
    use crate::read::{read_image, read_stack};
    use crate::recording::open_recording;
    use hdf5_pure::FileBuilder;
    use std::path::{Path, PathBuf};

    fn saved(folder: &Path, name: &str, build: impl Fn(&mut FileBuilder)) -> PathBuf {
        let mut file = FileBuilder::new();
        build(&mut file);
        let path = folder.join(name);
        file.write(&path).unwrap();
        path
    }

    fn counts(n: u16) -> Vec<u16> {
        (0..n).map(|v| v * 7 % 4096).collect()
    }

    #[test]
    fn the_only_image_is_found_and_others_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = saved(folder.path(), "a.h5", |file| {
            file.create_dataset("frames")
                .with_u16_data(&counts(24))
                .with_shape(&[2, 3, 4]);
            file.create_dataset("exposure")
                .with_f64_data(&[9.6])
                .with_shape(&[1, 1]);
        });
        let stack = read_stack(&path).unwrap();
        assert_eq!(
            (stack.len(), stack[0].rows(), stack[0].columns()),
            (2, 3, 4)
        );
        assert_eq!(stack[1].at(0, 0), 84.0);
        let frames = open_recording(&path).unwrap();
        assert_eq!((frames.count(), frames.name(1)), (2, "[1]".to_string()));
        let frame = frames.read(1).unwrap();
        assert_eq!(
            (&frame.image, frame.format),
            (&stack[1], SampleFormat::Counts { bits: 16 })
        );

        let path = saved(folder.path(), "b.h5", |file| {
            let mut group = file.create_group("run");
            group
                .create_dataset("frame")
                .with_i16_data(&[-1, 2, 3, 4, 5, 6])
                .with_shape(&[2, 3]);
            file.add_group(group.finish());
            file.create_dataset("dark")
                .with_f32_data(&[0.5; 6])
                .with_shape(&[2, 3]);
        });
        let message = read_image(&path).unwrap_err().to_string();
        for words in [
            "/dark ([2, 3], f32)",
            "/run/frame ([2, 3], i16)",
            "b.h5:/dark",
        ] {
            assert!(message.contains(words), "{message}");
        }
        let named = |name: &str| read_image(&folder.path().join(format!("b.h5:{name}")));
        for name in ["/run/frame", "run/frame"] {
            let read = named(name).unwrap();
            assert_eq!(read.image.data(), [-1., 2., 3., 4., 5., 6.]);
            assert_eq!(read.format.saturation_limit(), Some(32767.0));
        }
        let message = named("/run/frames").unwrap_err().to_string();
        assert!(message.contains("no array \"/run/frames\""), "{message}");
    }

    #[test]
    fn integers_keep_their_digits() {
        let folder = tempfile::tempdir().unwrap();
        let path = saved(folder.path(), "a.h5", |file| {
            file.create_dataset("frames")
                .with_u32_data(&[1, 2, 3, 4, 16_777_217, u32::MAX, 5, 6])
                .with_shape(&[2, 2, 2]);
        });
        let frame = open_recording(&path).unwrap().read_integers(1).unwrap();
        assert_eq!(frame.data, [16_777_217, 4_294_967_295, 5, 6]);
    }

    #[test]
    fn matlabs_axes_are_turned() {
        let folder = tempfile::tempdir().unwrap();
        // MATLAB's array of 2 rows, 3 columns and 2 frames.
        let path = saved(folder.path(), "a.mat", |file| {
            file.create_dataset("video")
                .with_f64_data(&(0..12).map(f64::from).collect::<Vec<_>>())
                .with_shape(&[2, 3, 2]);
        });
        let stack = read_stack(&path).unwrap();
        assert_eq!((stack[0].rows(), stack[0].columns()), (2, 3));
        assert_eq!(stack[0].data(), [0., 2., 4., 1., 3., 5.]);
        assert_eq!(stack[1].at(0, 0), 6.0);
    }

    #[test]
    fn damaged_files_give_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = saved(folder.path(), "a.h5", |file| {
            file.create_dataset("frame")
                .with_u16_data(&counts(48))
                .with_shape(&[6, 8]);
        });
        let whole = std::fs::read(&path).unwrap();
        for length in (1..whole.len()).step_by(7) {
            std::fs::write(&path, &whole[..length]).unwrap();
            let message = read_image(&path).unwrap_err().to_string();
            assert!(message.contains("a.h5: found"), "{message}");
        }
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0xff;
            std::fs::write(&path, bytes).unwrap();
            // Some bytes are pixels, or nothing: no panic is all that is asked.
            let _ = read_image(&path);
        }
    }
}
