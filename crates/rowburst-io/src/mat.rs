//! MATLAB's `.mat`: version 5 is read here, version 7.3 is HDF5 (see [`crate::hdf5`]).
//!
//! A file of version 5 is a row of elements of tag (type, bytes) and data; a variable is an
//! element `miMATRIX` of flags, dimensions, name and numbers, alone or deflated by zlib. Numbers
//! lie with the first index fastest, `(rows, columns, frames)`, and may be of a narrower type than
//! the variable's class. Source: "MAT-File Format", The MathWorks.
//!
//! Read here because the crate at hand does not read scipy's files.

use crate::arrays::{ArrayInfo, choose};
use crate::pages::{IntegerFrame, Pages, SampleFormat};
use crate::source::Source;
use flate2::bufread::ZlibDecoder;
use rowburst::Result;
use std::io::{BufReader, Error as IoError, ErrorKind, Read, Seek, SeekFrom};

const HEADER_BYTES: u64 = 128;
const MI_MATRIX: u32 = 14;
const MI_COMPRESSED: u32 = 15;
/// A file has at most so many variables; more is damage.
const MAX_VARIABLES: usize = 10_000;
/// Longest name or list of dimensions.
const MAX_HEADER_BYTES: u64 = 4096;

/// What a `.mat` file is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Version {
    Five,
    SevenThree,
}

/// Looks at the header, which both versions begin with.
pub(crate) fn version(source: &Source, file: &mut (impl Read + Seek)) -> Result<Version> {
    let mut start = [0; HEADER_BYTES as usize];
    let read = file.rewind().and_then(|()| file.read_exact(&mut start));
    read.map_err(|e| source.unreadable(e))?;
    if start.starts_with(b"\x89HDF") {
        return Ok(Version::SevenThree);
    }
    match (&start[126..128], start[124], start[125]) {
        (b"IM", _, 1) | (b"MI", 1, _) => Ok(Version::Five),
        (b"IM", _, 2) | (b"MI", 2, _) => Ok(Version::SevenThree),
        _ => Err(source.unreadable("its header is none of MATLAB's versions 5 to 7.3")),
    }
}

/// A variable of a file of version 5, whole.
pub(crate) struct Variable {
    rows: usize,
    columns: usize,
    count: usize,
    format: SampleFormat,
    /// In the file's order.
    data: Vec<f32>,
    /// The same as whole numbers, where f32 rounds them; else empty.
    integers: Vec<i64>,
}

impl Variable {
    /// Finds the variable and reads it.
    pub fn open<R: Read + Seek>(source: &Source, mut file: BufReader<R>) -> Result<Self> {
        let fault = |e: IoError| source.unreadable(e);
        let order = order_of(&mut file).map_err(fault)?;
        let mut found = Vec::new();
        let mut offsets = Vec::new();
        let mut at = HEADER_BYTES;
        while at + 8 <= source.bytes && offsets.len() < MAX_VARIABLES {
            file.seek(SeekFrom::Start(at)).map_err(fault)?;
            let tag = Tag::read(&mut file, order).map_err(fault)?;
            let end = at + 8 + u64::from(tag.bytes);
            if end > source.bytes {
                return Err(source.error(
                    format!("a file of {} bytes, which ends in a variable", source.bytes),
                    format!("the variable ends at byte {end}"),
                    "Save or copy it again: it is cut short.",
                ));
            }
            if let Some(matrix) = Matrix::begin(&mut file, tag, order).map_err(fault)? {
                found.push(matrix.candidate());
                offsets.push(at);
            }
            at = end;
            // Variables that are not deflated end at a multiple of 8.
            if tag.kind != MI_COMPRESSED {
                at = at.next_multiple_of(8);
            }
        }
        let chosen = choose(source, &found)?;
        file.seek(SeekFrom::Start(offsets[chosen])).map_err(fault)?;
        let tag = Tag::read(&mut file, order).map_err(fault)?;
        let input = file.take(u64::from(tag.bytes));
        match tag.kind {
            MI_COMPRESSED => {
                let mut inner = ZlibDecoder::new(input);
                Tag::read(&mut inner, order).map_err(fault)?;
                Self::numbers(source, &mut inner, order)
            }
            _ => Self::numbers(source, &mut { input }, order),
        }
    }

    fn numbers(source: &Source, file: &mut impl Read, order: Order) -> Result<Self> {
        let fault = |e: IoError| source.unreadable(e);
        let matrix = Matrix::read(file, order).map_err(fault)?;
        let (rows, columns, count) = match matrix.shape[..] {
            [rows, columns] => (rows, columns, 1),
            [rows, columns, count] => (rows, columns, count),
            _ => unreachable!("the choice has two or three axes"),
        };
        let format = matrix.format().unwrap_or(SampleFormat::Float);
        let mut data = source.reserve_pixels(count, rows, columns)?;
        let total = rows * columns * count;
        let tag = Tag::read(file, order).map_err(fault)?;
        let Some((size, decode, decode_integers)) = decoder(tag.kind, order) else {
            return Err(source.unsupported(format!(
                "{} of MATLAB's type {}",
                matrix.kind(),
                tag.kind
            )));
        };
        if u64::from(tag.bytes) != (total * size) as u64 {
            return Err(source.unreadable("a variable has not as many numbers as its size says"));
        }
        let mut integers = Vec::new();
        let mut push = |bytes: &[u8], data: &mut Vec<f32>| {
            decode(bytes, data);
            if format.exceeds_f32() {
                decode_integers(bytes, &mut integers);
            }
        };
        let mut buffer = vec![0; 8192 * size];
        // A short run of numbers lies in the tag itself.
        if let Some(inline) = tag.inline {
            push(&inline[..total * size], &mut data);
        }
        while data.len() < total {
            let bytes = &mut buffer[..(total - data.len()).min(8192) * size];
            file.read_exact(bytes).map_err(fault)?;
            push(bytes, &mut data);
        }
        Ok(Self {
            rows,
            columns,
            count,
            format,
            data,
            integers,
        })
    }
}

/// The frame `at` of numbers in the file's order, `(rows, columns, frames)` with the first the fastest.
fn frame_of<T: Copy>(data: &[T], rows: usize, columns: usize, at: usize) -> Vec<T> {
    let frame = &data[at * rows * columns..(at + 1) * rows * columns];
    let pixels = (0..rows).flat_map(|y| (0..columns).map(move |x| frame[x * rows + y]));
    pixels.collect()
}

impl crate::pages::Stack for Variable {
    fn count(&self) -> usize {
        self.count
    }

    fn page(&mut self, _: &Source, at: usize) -> Result<Pages> {
        let (rows, columns) = (self.rows, self.columns);
        Ok(Pages {
            count: 1,
            rows,
            columns,
            data: frame_of(&self.data, rows, columns, at),
            format: self.format,
        })
    }

    fn integers(&mut self, source: &Source, at: usize) -> Result<IntegerFrame> {
        if self.integers.is_empty() {
            let page = self.page(source, at)?;
            return Ok(IntegerFrame::of_pages(&page));
        }
        let (rows, columns) = (self.rows, self.columns);
        Ok(IntegerFrame {
            rows,
            columns,
            data: frame_of(&self.integers, rows, columns, at),
            format: self.format,
        })
    }
}

/// Order of the bytes of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Order {
    Little,
    Big,
}

fn order_of(file: &mut (impl Read + Seek)) -> std::io::Result<Order> {
    file.seek(SeekFrom::Start(HEADER_BYTES - 2))?;
    let mut mark = [0; 2];
    file.read_exact(&mut mark)?;
    Ok(if &mark == b"IM" {
        Order::Little
    } else {
        Order::Big
    })
}

/// Type and length of an element.
#[derive(Debug, Clone, Copy)]
struct Tag {
    kind: u32,
    bytes: u32,
    /// The data of a small element.
    inline: Option<[u8; 4]>,
}

impl Tag {
    fn read(file: &mut impl Read, order: Order) -> std::io::Result<Self> {
        let mut bytes = [[0; 4]; 2];
        file.read_exact(bytes.as_flattened_mut())?;
        let number = |b: [u8; 4]| match order {
            Order::Little => u32::from_le_bytes(b),
            Order::Big => u32::from_be_bytes(b),
        };
        let first = number(bytes[0]);
        if first >> 16 != 0 {
            let (kind, length) = (first & 0xffff, first >> 16);
            return match length {
                ..=4 => Ok(Self {
                    kind,
                    bytes: length,
                    inline: Some(bytes[1]),
                }),
                _ => Err(IoError::new(ErrorKind::InvalidData, "a damaged tag")),
            };
        }
        Ok(Self {
            kind: first,
            bytes: number(bytes[1]),
            inline: None,
        })
    }

    /// The data of a short element, without the padding after it.
    fn data(self, file: &mut impl Read) -> std::io::Result<Vec<u8>> {
        let length = u64::from(self.bytes);
        if let Some(inline) = self.inline {
            return Ok(inline[..self.bytes as usize].to_vec());
        }
        if length > MAX_HEADER_BYTES {
            return Err(IoError::new(ErrorKind::InvalidData, "a damaged header"));
        }
        let mut data = vec![0; length.next_multiple_of(8) as usize];
        file.read_exact(&mut data)?;
        data.truncate(self.bytes as usize);
        Ok(data)
    }
}

/// What stands before the numbers of a variable.
struct Matrix {
    class: u8,
    is_complex: bool,
    is_logical: bool,
    shape: Vec<usize>,
    name: String,
}

impl Matrix {
    /// The head of the variable whose tag was just read; `None` for other elements.
    fn begin(
        file: &mut impl std::io::BufRead,
        tag: Tag,
        order: Order,
    ) -> std::io::Result<Option<Self>> {
        match tag.kind {
            MI_MATRIX => Self::read(file, order).map(Some),
            MI_COMPRESSED => {
                let mut inner = ZlibDecoder::new(file.take(u64::from(tag.bytes)));
                match Tag::read(&mut inner, order)?.kind {
                    MI_MATRIX => Self::read(&mut inner, order).map(Some),
                    _ => Ok(None),
                }
            }
            _ => Ok(None),
        }
    }

    fn read(file: &mut impl Read, order: Order) -> std::io::Result<Self> {
        let mut part = || -> std::io::Result<Vec<u8>> { Tag::read(file, order)?.data(file) };
        let numbers = |bytes: &[u8]| -> Vec<u32> {
            let words = bytes.as_chunks::<4>().0.iter();
            words
                .map(|&b| match order {
                    Order::Little => u32::from_le_bytes(b),
                    Order::Big => u32::from_be_bytes(b),
                })
                .collect()
        };
        let flags = numbers(&part()?).first().copied().unwrap_or(0);
        let shape = numbers(&part()?);
        let name = part()?;
        Ok(Self {
            class: (flags & 0xff) as u8,
            is_complex: flags & 0x800 != 0,
            is_logical: flags & 0x200 != 0,
            shape: shape.iter().map(|&n| n as usize).collect(),
            name: String::from_utf8_lossy(&name).into_owned(),
        })
    }

    fn format(&self) -> Option<SampleFormat> {
        let counts = |bits| Some(SampleFormat::Counts { bits });
        match self.class {
            _ if self.is_complex => None,
            9 if self.is_logical => counts(1),
            6 | 7 => Some(SampleFormat::Float),
            8 => counts(7),
            9 => counts(8),
            10 => counts(15),
            11 => counts(16),
            12 => counts(31),
            13 => counts(32),
            14 => counts(63),
            15 => counts(64),
            _ => None,
        }
    }

    fn kind(&self) -> &'static str {
        const NAMES: [&str; 16] = [
            "unknown", "cell", "struct", "object", "char", "sparse", "double", "single", "int8",
            "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64",
        ];
        if self.is_complex {
            "complex"
        } else {
            NAMES.get(self.class as usize).copied().unwrap_or("unknown")
        }
    }

    fn candidate(&self) -> ArrayInfo {
        ArrayInfo {
            name: self.name.clone(),
            shape: self.shape.clone(),
            kind: self.kind().into(),
            is_numeric: self.format().is_some(),
        }
    }
}

type Decode<T> = fn(&[u8], &mut Vec<T>);

/// Bytes of a number of a type, and how to read a run of them, in floating-point and in whole numbers.
type Decoder = (usize, Decode<f32>, Decode<i64>);

fn decoder(kind: u32, order: Order) -> Option<Decoder> {
    macro_rules! run {
        ($t:ty, $from:ident, $to:ty) => {{
            let run: Decode<$to> = |bytes, data| {
                let numbers = bytes.as_chunks::<{ size_of::<$t>() }>().0;
                data.extend(numbers.iter().map(|&n| <$t>::$from(n) as $to));
            };
            run
        }};
    }
    macro_rules! decode {
        ($t:ty) => {
            Some(match order {
                Order::Little => (
                    size_of::<$t>(),
                    run!($t, from_le_bytes, f32),
                    run!($t, from_le_bytes, i64),
                ),
                Order::Big => (
                    size_of::<$t>(),
                    run!($t, from_be_bytes, f32),
                    run!($t, from_be_bytes, i64),
                ),
            })
        };
    }
    match kind {
        1 => decode!(i8),
        2 => decode!(u8),
        3 => decode!(i16),
        4 => decode!(u16),
        5 => decode!(i32),
        6 => decode!(u32),
        7 => decode!(f32),
        9 => decode!(f64),
        12 => decode!(i64),
        13 => decode!(u64),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read::{read_image, read_stack};
    use flate2::{Compression, write::ZlibEncoder};
    use std::io::Write;

    /// A variable as an element, big-endian where `big`.
    fn variable(name: &str, class: u8, kind: u32, shape: &[u32], data: &[u8]) -> Vec<u8> {
        let part = |kind: u32, data: &[u8]| {
            let mut bytes = kind.to_le_bytes().to_vec();
            bytes.extend((data.len() as u32).to_le_bytes());
            bytes.extend(data);
            bytes.resize(bytes.len().next_multiple_of(8), 0);
            bytes
        };
        let flags: Vec<u8> = [u32::from(class), 0]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        let shape: Vec<u8> = shape.iter().flat_map(|v| v.to_le_bytes()).collect();
        let name = match name.len() {
            // A small element.
            length @ 1..=4 => {
                let mut bytes = (1u32 | (length as u32) << 16).to_le_bytes().to_vec();
                bytes.extend(name.as_bytes());
                bytes.resize(8, 0);
                bytes
            }
            _ => part(1, name.as_bytes()),
        };
        let inner = [part(6, &flags), part(5, &shape), name, part(kind, data)].concat();
        part(MI_MATRIX, &inner)
    }

    fn deflated(element: &[u8]) -> Vec<u8> {
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(element).unwrap();
        let inner = encoder.finish().unwrap();
        let mut bytes = MI_COMPRESSED.to_le_bytes().to_vec();
        bytes.extend((inner.len() as u32).to_le_bytes());
        bytes.extend(inner);
        bytes
    }

    fn file(elements: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = b"MATLAB 5.0 MAT-file".to_vec();
        bytes.resize(124, b' ');
        bytes.extend(b"\x00\x01IM");
        elements.iter().for_each(|e| bytes.extend(e));
        bytes
    }

    fn doubles(n: usize) -> Vec<u8> {
        (0..n)
            .flat_map(|v| (v as f64 * 0.5).to_le_bytes())
            .collect()
    }

    #[test]
    fn variables_are_read_with_matlabs_axes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mat");
        let stack = variable("video", 6, 9, &[2, 3, 2], &doubles(12));
        // Doubles that are small whole numbers are stored as bytes.
        let narrow = variable("b", 6, 2, &[2, 3], &[0, 1, 2, 3, 4, 5]);
        let signed = variable("int", 10, 3, &[1, 2], &[0xff, 0xff, 2, 0]);
        let text = variable("note", 4, 4, &[1, 2], &[65, 0, 66, 0]);
        for pack in [false, true] {
            let pack = |e: &Vec<u8>| if pack { deflated(e) } else { e.clone() };
            let all = [&narrow, &signed, &text].map(pack);
            std::fs::write(&path, file(&all)).unwrap();
            let read = read_image(&path).unwrap();
            assert_eq!(read.image.data(), [0., 2., 4., 1., 3., 5.]);
            assert_eq!(read.format, SampleFormat::Float);
            let named = read_image(&folder.path().join("a.mat:int")).unwrap();
            assert_eq!(
                (named.image.data(), named.format.saturation_limit()),
                (&[-1., 2.][..], Some(32767.0))
            );
            let message = read_image(&folder.path().join("a.mat:note")).unwrap_err();
            assert!(message.to_string().contains("char"), "{message}");

            std::fs::write(&path, file(&[pack(&stack), pack(&narrow)])).unwrap();
            let message = read_image(&path).unwrap_err().to_string();
            for words in ["several arrays", "video ([2, 3, 2], double)", "a.mat:video"] {
                assert!(message.contains(words), "{message}");
            }
            let read = read_stack(&folder.path().join("a.mat:video")).unwrap();
            assert_eq!((read.len(), read[0].rows(), read[1].at(0, 1)), (2, 2, 4.0));
        }
    }

    #[test]
    fn integers_keep_their_digits() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mat");
        let values = [16_777_217, u32::MAX, 5, 6];
        let data: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        std::fs::write(&path, file(&[variable("n", 13, 6, &[2, 2], &data)])).unwrap();
        let frame = crate::open_recording(&path)
            .unwrap()
            .read_integers(0)
            .unwrap();
        assert_eq!(frame.data, [16_777_217, 5, 4_294_967_295, 6]);
    }

    #[test]
    fn damaged_files_give_an_error_and_no_panic() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mat");
        let variable = variable("video", 6, 9, &[2, 3, 2], &doubles(12));
        for element in [deflated(&variable), variable] {
            let whole = file(&[element]);
            for length in 1..whole.len() {
                std::fs::write(&path, &whole[..length]).unwrap();
                let message = read_stack(&path).unwrap_err().to_string();
                assert!(message.contains("a.mat: found"), "{message}");
            }
            for at in 124..whole.len() {
                let mut bytes = whole.clone();
                bytes[at] ^= 0xff;
                std::fs::write(&path, bytes).unwrap();
                let _ = read_stack(&path);
            }
        }
    }
}
