//! NumPy's `.npy`: a line of text that says what the array is, then its numbers.
//!
//! Read here and not by a library: those that exist allocate, or panic, on what a
//! damaged header claims. Format: `numpy.lib.format`, versions 1 to 3.

use crate::fault;
use crate::pages::{IntegerFrame, Pages, SampleFormat};
use crate::source::Source;
use rowburst::{Image, Result, Shape, Video};
use std::io::{Read, Seek, SeekFrom, Write};

/// An array of any number of dimensions, in C order.
pub(crate) struct Array {
    pub shape: Vec<usize>,
    pub data: Vec<f32>,
    pub format: SampleFormat,
}

/// Reads an image `[y, x]` or a stack `[t, y, x]`.
pub(crate) fn read(source: &Source, mut file: impl Read) -> Result<Pages> {
    let header = Header::read(source, &mut file)?;
    pages_of(source, read_numbers(source, file, header)?)
}

/// Like [`read`], but of a stack of several pages the header alone is read, and the pages have no data.
pub(crate) fn read_first(source: &Source, mut file: impl Read) -> Result<Pages> {
    let header = Header::read(source, &mut file)?;
    if let [count, rows, columns] = header.shape[..]
        && count > 1
    {
        return Ok(Pages {
            count,
            rows,
            columns,
            data: Vec::new(),
            format: header.format,
        });
    }
    pages_of(source, read_numbers(source, file, header)?)
}

fn pages_of(source: &Source, array: Array) -> Result<Pages> {
    let (count, rows, columns) = match array.shape[..] {
        [rows, columns] => (1, rows, columns),
        [count, rows, columns] => (count, rows, columns),
        _ => {
            return Err(source.error(
                format!("an array of shape {:?}", array.shape),
                "an image is [y, x], a stack or video [t, y, x]",
                "Reshape it with numpy.reshape.",
            ));
        }
    };
    Ok(Pages {
        count,
        rows,
        columns,
        data: array.data,
        format: array.format,
    })
}

/// Reads an array of any shape.
pub(crate) fn read_array(source: &Source, mut file: impl Read) -> Result<Array> {
    let header = Header::read(source, &mut file)?;
    read_numbers(source, file, header)
}

/// Reads the numbers behind a header.
fn read_numbers(source: &Source, mut file: impl Read, header: Header) -> Result<Array> {
    let total = header
        .shape
        .iter()
        .try_fold(1usize, |n, &d| n.checked_mul(d));
    let held = source.bytes.saturating_sub(header.bytes) / header.size as u64;
    let claimed = total.filter(|&n| n as u64 <= held);
    let Some(total) = claimed else {
        return Err(source.error(
            format!(
                "room for {held} numbers, where its header claims {:?}",
                header.shape
            ),
            "the file must hold every number of the array",
            "Save or copy it again: it is cut short or damaged.",
        ));
    };
    // Decoded in small runs: no page is held beside the numbers.
    let mut data = source.reserve_pixels(total, 1, 1)?;
    let mut buffer = vec![0; 8192 * header.size];
    while data.len() < total {
        let count = (total - data.len()).min(8192);
        let bytes = &mut buffer[..count * header.size];
        file.read_exact(bytes).map_err(|e| source.unreadable(e))?;
        (header.decode)(bytes, &mut data);
    }
    if header.fortran_order {
        data = c_order(&header.shape, &data);
    }
    Ok(Array {
        shape: header.shape,
        data,
        format: header.format,
    })
}

/// A stack `[frame, y, x]` that is read frame by frame.
#[derive(Debug)]
pub(crate) struct Stack {
    header: Header,
    count: usize,
    rows: usize,
    columns: usize,
}

impl Stack {
    /// Reads the header; an image `[y, x]` is a stack of one.
    pub fn open(source: &Source, mut file: impl Read) -> Result<Self> {
        let header = Header::read(source, &mut file)?;
        let (count, rows, columns) = match header.shape[..] {
            [rows, columns] => (1, rows, columns),
            [count, rows, columns] => (count, rows, columns),
            _ => {
                return Err(source.error(
                    format!("an array of shape {:?}", header.shape),
                    "a recording is [frame, y, x]",
                    "Reshape it with numpy.reshape.",
                ));
            }
        };
        if header.fortran_order && count > 1 {
            return Err(source.error(
                "an array whose first index is the fastest (Fortran order)",
                "a recording is read frame by frame: its frames lie one after the other",
                "Save it again as numpy.save(FILE, numpy.ascontiguousarray(a)).",
            ));
        }
        if count == 0 || rows == 0 || columns == 0 {
            return Err(source.error(
                format!("an array of shape {:?}", header.shape),
                "a recording has at least one frame of at least one pixel",
                "Check how it was saved.",
            ));
        }
        Ok(Self {
            header,
            count,
            rows,
            columns,
        })
    }

    /// Frames, rows and columns.
    pub fn shape(&self) -> Shape {
        Shape::new(self.count, self.rows, self.columns)
    }

    /// Reads one frame; `file` stands anywhere.
    pub fn frame(
        &self,
        source: &Source,
        file: &mut (impl Read + Seek),
        at: usize,
    ) -> Result<Pages> {
        let mut data = source.reserve_pixels(1, self.rows, self.columns)?;
        let buffer = self.bytes(source, file, at)?;
        (self.header.decode)(&buffer, &mut data);
        if self.header.fortran_order {
            data = c_order(&self.header.shape, &data);
        }
        Ok(Pages {
            count: 1,
            rows: self.rows,
            columns: self.columns,
            data,
            format: self.header.format,
        })
    }

    /// Reads one frame of integers, exactly.
    fn integers(
        &self,
        source: &Source,
        file: &mut (impl Read + Seek),
        at: usize,
    ) -> Result<IntegerFrame> {
        drop(source.reserve_pixels(1, self.rows, self.columns)?);
        let buffer = self.bytes(source, file, at)?;
        let mut data = Vec::with_capacity(self.rows * self.columns);
        (self.header.decode_integers)(&buffer, &mut data);
        if self.header.fortran_order {
            data = c_order(&self.header.shape, &data);
        }
        Ok(IntegerFrame {
            rows: self.rows,
            columns: self.columns,
            data,
            format: self.header.format,
        })
    }

    /// The bytes of one frame.
    fn bytes(&self, source: &Source, file: &mut (impl Read + Seek), at: usize) -> Result<Vec<u8>> {
        let bytes = self.rows * self.columns * self.header.size;
        let start = (at as u64)
            .checked_mul(bytes as u64)
            .and_then(|skipped| skipped.checked_add(self.header.bytes));
        let held = start.and_then(|start| source.bytes.checked_sub(start));
        let (Some(start), true) = (start, held.is_some_and(|held| held >= bytes as u64)) else {
            return Err(source.error(
                format!(
                    "a file of {} bytes, which ends before frame {at}",
                    source.bytes
                ),
                format!("its header claims {} frames", self.count),
                "Save or copy it again: it is cut short.",
            ));
        };
        let mut buffer = vec![0; bytes];
        file.seek(SeekFrom::Start(start))
            .and_then(|_| file.read_exact(&mut buffer))
            .map_err(|e| source.unreadable(e))?;
        Ok(buffer)
    }
}

/// A stack with its file.
pub(crate) struct OpenStack<R> {
    stack: Stack,
    file: R,
}

impl<R: Read + Seek> OpenStack<R> {
    /// Reads the header.
    pub fn new(source: &Source, mut file: R) -> Result<Self> {
        let stack = Stack::open(source, &mut file)?;
        Ok(Self { stack, file })
    }
}

impl<R: Read + Seek + Send> crate::pages::Stack for OpenStack<R> {
    fn count(&self) -> usize {
        self.stack.count
    }

    fn page(&mut self, source: &Source, at: usize) -> Result<Pages> {
        self.stack.frame(source, &mut self.file, at)
    }

    fn integers(&mut self, source: &Source, at: usize) -> Result<IntegerFrame> {
        self.stack.integers(source, &mut self.file, at)
    }
}

/// The same array, from the first index fastest to the last index fastest.
fn c_order<T: Copy>(shape: &[usize], data: &[T]) -> Vec<T> {
    let mut index = vec![0; shape.len()];
    let mut next = || {
        let at = (0..shape.len())
            .rev()
            .fold(0, |at, d| at * shape[d] + index[d]);
        for d in (0..shape.len()).rev() {
            index[d] += 1;
            if index[d] < shape[d] {
                break;
            }
            index[d] = 0;
        }
        data[at]
    };
    data.iter().map(|_| next()).collect()
}

#[derive(Debug)]
struct Header {
    shape: Vec<usize>,
    fortran_order: bool,
    format: SampleFormat,
    /// Bytes of one number.
    size: usize,
    /// Appends the numbers of a run of bytes.
    decode: Decode<f32>,
    /// The same in whole numbers.
    decode_integers: Decode<i64>,
    /// Bytes before the first number.
    bytes: u64,
}

type Decode<T> = fn(&[u8], &mut Vec<T>);

impl Header {
    fn read(source: &Source, file: &mut impl Read) -> Result<Self> {
        let mut start = [0; 10];
        let cut = |e| source.unreadable(e);
        file.read_exact(&mut start).map_err(cut)?;
        if &start[..6] != b"\x93NUMPY" || !(1..=3).contains(&start[6]) {
            return Err(source.unreadable("no NumPy signature of version 1 to 3"));
        }
        let mut length = u64::from(u16::from_le_bytes([start[8], start[9]]));
        let mut bytes = 10;
        if start[6] > 1 {
            let mut more = [0; 2];
            file.read_exact(&mut more).map_err(cut)?;
            length += u64::from(u16::from_le_bytes(more)) << 16;
            bytes = 12;
        }
        let mut text = Vec::new();
        let found = file.take(length).read_to_end(&mut text).map_err(cut)?;
        if (found as u64) < length {
            return Err(source.unreadable("its header is cut short"));
        }
        let text = String::from_utf8_lossy(&text);
        let bad = || source.unreadable(format!("its header is {:?}", text.trim_end()));
        let dtype = after(&text, "descr").ok_or_else(bad)?;
        let Some(dtype) = dtype
            .strip_prefix(['\'', '"'])
            .and_then(|d| d.split(['\'', '"']).next())
        else {
            return Err(source.unsupported("of a structured NumPy array"));
        };
        let order = after(&text, "fortran_order").ok_or_else(bad)?;
        let shape = after(&text, "shape")
            .and_then(|s| s.strip_prefix('(')?.split_once(')'))
            .ok_or_else(bad)?;
        let lengths = shape.0.split(',').map(str::trim).filter(|d| !d.is_empty());
        let shape: Option<Vec<usize>> = lengths.map(|d| d.parse().ok()).collect();
        let (size, format, decode, decode_integers) =
            decoder(dtype).ok_or_else(|| source.unsupported(format!("NumPy {dtype}")))?;
        Ok(Self {
            shape: shape.ok_or_else(bad)?,
            fortran_order: order.starts_with("True"),
            format,
            size,
            decode,
            decode_integers,
            bytes: bytes + length,
        })
    }
}

/// What follows `'key':` in the text of a Python dictionary.
fn after<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let (_, rest) = text.split_once(key)?;
    Some(
        rest.trim_start_matches(['\'', '"'])
            .trim_start()
            .strip_prefix(':')?
            .trim_start(),
    )
}

/// Bytes of one number, its kind, and how to read a run of them, in floating-point and in whole numbers.
type Decoder = (usize, SampleFormat, Decode<f32>, Decode<i64>);

fn decoder(dtype: &str) -> Option<Decoder> {
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
        ($t:ty, $format:expr) => {
            Some(if dtype.starts_with('>') {
                (
                    size_of::<$t>(),
                    $format,
                    run!($t, from_be_bytes, f32),
                    run!($t, from_be_bytes, i64),
                )
            } else {
                (
                    size_of::<$t>(),
                    $format,
                    run!($t, from_le_bytes, f32),
                    run!($t, from_le_bytes, i64),
                )
            })
        };
    }
    let counts = |bits| SampleFormat::Counts { bits };
    match dtype.strip_prefix(['<', '>', '|', '='])? {
        "f4" => decode!(f32, SampleFormat::Float),
        "f8" => decode!(f64, SampleFormat::Float),
        "b1" => decode!(u8, counts(1)),
        "u1" => decode!(u8, counts(8)),
        "i1" => decode!(i8, counts(7)),
        "u2" => decode!(u16, counts(16)),
        "i2" => decode!(i16, counts(15)),
        "u4" => decode!(u32, counts(32)),
        "i4" => decode!(i32, counts(31)),
        "u8" => decode!(u64, counts(64)),
        "i8" => decode!(i64, counts(63)),
        _ => None,
    }
}

/// Writes an image as float32 `[y, x]`.
///
/// # Errors
/// A failed write.
pub fn write_npy_image(w: &mut impl Write, image: &Image) -> Result<()> {
    let shape = [image.rows(), image.columns()];
    write(w, "<f4", &shape, image.data(), |v| v.to_le_bytes())
}

/// Writes a video as float32 `[t, y, x]`.
///
/// # Errors
/// A failed write.
pub fn write_npy_video(w: &mut impl Write, video: &Video) -> Result<()> {
    let shape = video.shape();
    let shape = [shape.bins, shape.rows, shape.columns];
    write(w, "<f4", &shape, video.data(), |v| v.to_le_bytes())
}

/// Writes red, green and blue videos of one `shape` as float32 `[t, y, x, colour]`.
///
/// # Errors
/// A failed write.
///
/// # Panics
/// If a colour has not a value for each voxel.
pub fn write_npy_colour(w: &mut impl Write, shape: Shape, colours: &[Vec<f32>; 3]) -> Result<()> {
    let [red, green, blue] = colours;
    let voxels = red.iter().zip(green).zip(blue);
    let data: Vec<f32> = voxels.flat_map(|((r, g), b)| [*r, *g, *b]).collect();
    let shape = [shape.bins, shape.rows, shape.columns, 3];
    write(w, "<f4", &shape, &data, |v| v.to_le_bytes())
}

/// Writes numbers in C order as a float64 array of the given shape.
///
/// # Errors
/// A failed write.
///
/// # Panics
/// If `data` does not have one number for each element of `shape`.
pub fn write_npy_f64(w: &mut impl Write, shape: &[usize], data: &[f64]) -> Result<()> {
    write(w, "<f8", shape, data, |v| v.to_le_bytes())
}

/// Writes integers in C order as an int64 array of the given shape, such as a row order.
///
/// # Errors
/// A failed write.
///
/// # Panics
/// If `data` does not have one number for each element of `shape`.
pub fn write_npy_i64(w: &mut impl Write, shape: &[usize], data: &[i64]) -> Result<()> {
    write(w, "<i8", shape, data, |v| v.to_le_bytes())
}

/// Writes bytes in C order as a uint8 array of the given shape, such as a mask.
///
/// # Errors
/// A failed write.
///
/// # Panics
/// If `data` does not have one number for each element of `shape`.
pub fn write_npy_u8(w: &mut impl Write, shape: &[usize], data: &[u8]) -> Result<()> {
    write(w, "|u1", shape, data, |v| [v])
}

/// What stands before the numbers of an array in C order.
pub(crate) fn header_of(dtype: &str, shape: &[usize]) -> Vec<u8> {
    let lengths: String = shape.iter().map(|d| format!("{d}, ")).collect();
    let text = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({lengths}), }}");
    // The numbers start at a multiple of 64 bytes, after a newline.
    let header = format!("{text:<0$}\n", (text.len() + 11).next_multiple_of(64) - 11);
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes
}

fn write<T: Copy, const N: usize>(
    w: &mut impl Write,
    dtype: &str,
    shape: &[usize],
    data: &[T],
    bytes: impl Fn(T) -> [u8; N],
) -> Result<()> {
    let total: usize = shape.iter().product();
    assert_eq!(data.len(), total, "one number for each of {shape:?}");
    let mut write = || -> std::io::Result<()> {
        w.write_all(&header_of(dtype, shape))?;
        data.iter().try_for_each(|&v| w.write_all(&bytes(v)))
    };
    write().map_err(|e| fault::write_error(&e))
}

#[cfg(test)]
mod tests {
    use crate::pages::SampleFormat;
    use crate::read::{read_image, read_stack, read_video};
    use rowburst::{Image, Shape, Video};
    use std::path::{Path, PathBuf};

    /// A file with the header's `dictionary` and the `data` after it.
    fn file(folder: &Path, version: u8, dictionary: &str, data: &[u8]) -> PathBuf {
        let mut bytes = b"\x93NUMPY".to_vec();
        bytes.extend([version, 0]);
        match version {
            1 => bytes.extend((dictionary.len() as u16).to_le_bytes()),
            _ => bytes.extend((dictionary.len() as u32).to_le_bytes()),
        }
        bytes.extend(dictionary.as_bytes());
        bytes.extend(data);
        let path = folder.join("array.npy");
        std::fs::write(&path, bytes).unwrap();
        path
    }

    fn dictionary(dtype: &str, order: &str, shape: &str) -> String {
        format!("{{'descr': '{dtype}', 'fortran_order': {order}, 'shape': {shape}, }}\n")
    }

    #[test]
    fn every_kind_of_number_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let counts = |bits| SampleFormat::Counts { bits };
        macro_rules! case {
            ($t:ty, $name:expr, $format:expr) => {
                let values: Vec<$t> = [0, 1, 2, 3, 100, 127].map(|v: u8| v as $t).to_vec();
                let little: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                let big: Vec<u8> = values.iter().flat_map(|v| v.to_be_bytes()).collect();
                for (end, data) in [("<", little), (">", big)] {
                    let text = dictionary(&format!("{end}{}", $name), "False", "(2, 3)");
                    for version in [1, 2, 3] {
                        let read = read_image(&file(folder.path(), version, &text, &data)).unwrap();
                        assert_eq!(read.image.data(), [0., 1., 2., 3., 100., 127.]);
                        assert_eq!((read.image.rows(), read.image.columns()), (2, 3));
                        assert_eq!(read.format, $format);
                    }
                }
            };
        }
        case!(f32, "f4", SampleFormat::Float);
        case!(f64, "f8", SampleFormat::Float);
        case!(u8, "u1", counts(8));
        case!(i8, "i1", counts(7));
        case!(u16, "u2", counts(16));
        case!(i16, "i2", counts(15));
        case!(u32, "u4", counts(32));
        case!(i32, "i4", counts(31));
        case!(u64, "u8", counts(64));
        case!(i64, "i8", counts(63));
        let mask = file(
            folder.path(),
            1,
            &dictionary("|b1", "False", "(1, 2)"),
            &[0, 1],
        );
        assert_eq!(read_image(&mask).unwrap().image.data(), [0., 1.]);
    }

    #[test]
    fn integers_keep_their_digits() {
        let folder = tempfile::tempdir().unwrap();
        let values = [16_777_217, u32::MAX, 5, 6];
        let data: Vec<u8> = values.iter().flat_map(|v| v.to_be_bytes()).collect();
        let read = |order: &str, shape: &str| {
            let text = dictionary(">u4", order, shape);
            let path = file(folder.path(), 1, &text, &data);
            let recording = crate::open_recording(&path).unwrap();
            recording.read_integers(0).unwrap().data
        };
        assert_eq!(
            read("False", "(1, 2, 2)"),
            [16_777_217, 4_294_967_295, 5, 6]
        );
        // A single image may have its first index the fastest.
        assert_eq!(read("True", "(2, 2)"), [16_777_217, 5, 4_294_967_295, 6]);
    }

    #[test]
    fn the_first_index_may_be_the_fastest() {
        let folder = tempfile::tempdir().unwrap();
        // v[t, y, x] = 100 t + 10 y + x of shape (2, 3, 2), t fastest.
        let mut data = Vec::new();
        for (x, y, t) in
            (0..2).flat_map(|x| (0..3).flat_map(move |y| (0..2).map(move |t| (x, y, t))))
        {
            data.push(100 * t + 10 * y + x);
        }
        let text = dictionary("|u1", "True", "(2, 3, 2)");
        let video = read_video(&file(folder.path(), 1, &text, &data)).unwrap();
        assert_eq!(video.shape(), Shape::new(2, 3, 2));
        assert_eq!(video.bin(1), [100., 101., 110., 111., 120., 121.]);
    }

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        let image = Image::from_fn(3, 5, |y, x| (y * 7 + x) as f32 - 0.1);
        let mut bytes = Vec::new();
        super::write_npy_image(&mut bytes, &image).unwrap();
        assert_eq!(
            (bytes.len() - image.data().len() * 4) % 64,
            0,
            "numbers start at a multiple of 64 bytes"
        );
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(read_image(&path).unwrap().image, image);
        assert_eq!(read_stack(&path).unwrap(), [image]);

        let video = Video::new(Shape::new(2, 3, 4), (0..24).map(|v| v as f32).collect()).unwrap();
        let mut bytes = Vec::new();
        super::write_npy_video(&mut bytes, &video).unwrap();
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(read_video(&path).unwrap(), video);
        assert_eq!(read_stack(&path).unwrap().len(), 2);
        let message = read_image(&path).unwrap_err().to_string();
        assert!(message.contains("a stack of 2 pages of 3×4"), "{message}");

        let mut bytes = Vec::new();
        super::write_npy_f64(&mut bytes, &[2, 2], &[1.5, 2.5, 3.5, 4.5]).unwrap();
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(
            read_image(&path).unwrap().image.data(),
            [1.5, 2.5, 3.5, 4.5]
        );
    }

    #[test]
    fn bad_files_say_what_is_wrong() {
        let folder = tempfile::tempdir().unwrap();
        let cases = [
            (
                dictionary("<f4", "False", "(2, 2)"),
                15,
                "room for 3 numbers",
            ),
            (
                dictionary("<f4", "False", "(1000000, 1000000)"),
                64,
                "claims [1000000, 1000000]",
            ),
            (
                dictionary("<f4", "False", "(9999999999999, 9999999999)"),
                64,
                "cut short or damaged",
            ),
            (
                dictionary("<f4", "False", "(99999999999999999999999, 2)"),
                64,
                "its header is",
            ),
            (dictionary("<f4", "False", "(-1, 2)"), 64, "its header is"),
            (
                dictionary("<f4", "False", "(0, 2)"),
                64,
                "at least one pixel",
            ),
            (
                dictionary("<f4", "False", "(4,)"),
                16,
                "an array of shape [4]",
            ),
            (dictionary("<f4", "False", "()"), 4, "an array of shape []"),
            (dictionary("<c8", "False", "(1, 1)"), 8, "NumPy <c8"),
            (dictionary("<f2", "False", "(1, 1)"), 2, "NumPy <f2"),
            (dictionary("|O", "False", "(1, 1)"), 2, "NumPy |O"),
            (
                dictionary("", "False", "(1, 1)"),
                2,
                "pixels of the kind NumPy",
            ),
            (
                "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1, 1)}".into(),
                4,
                "structured",
            ),
            ("((((((((".into(), 4, "its header is"),
            ("{'shape': (".into(), 4, "its header is"),
        ];
        for (text, bytes, expected) in cases {
            let path = file(folder.path(), 1, &text, &vec![0; bytes]);
            let message = read_image(&path).unwrap_err().to_string();
            assert!(message.contains("array.npy: found"), "{message}");
            assert!(message.contains(expected), "{message} lacks {expected}");
        }
        let path = file(folder.path(), 1, "", &[]);
        let whole = std::fs::read(file(
            folder.path(),
            2,
            &dictionary("<f4", "False", "(1, 1)"),
            &[0; 4],
        ))
        .unwrap();
        for length in 0..whole.len() {
            std::fs::write(&path, &whole[..length]).unwrap();
            assert!(read_image(&path).is_err(), "{length} bytes");
        }
    }
}
