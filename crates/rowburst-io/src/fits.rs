//! FITS: simple images and cubes, in the primary unit or an `IMAGE` extension.
//!
//! Units of 2880-byte blocks: cards of 80 letters up to `END`, then numbers, big-endian, `NAXIS1`
//! (columns) the fastest. Value = `BZERO + BSCALE · number`; `BLANK` is NaN. The first row of the
//! file is the frame's top row, as astropy has it, but for `ROWORDER = 'BOTTOM-UP'`. Source: FITS
//! Standard 4.0. Compressed images are not read.

use crate::arrays::{ArrayInfo, choose};
use crate::pages::{IntegerFrame, Pages, SampleFormat};
use crate::source::Source;
use rowburst::Result;
use std::io::{Read, Seek, SeekFrom};

const BLOCK: u64 = 2880;
const CARD: usize = 80;
/// Blocks of a header, and units of a file, beyond which it is damaged.
const MAX_HEADER_BLOCKS: usize = 1000;
const MAX_UNITS: usize = 1000;

/// Keywords of a unit and their values, without quotes.
#[derive(Debug, Clone, Default)]
pub(crate) struct Cards(Vec<(String, String)>);

impl Cards {
    pub fn text(&self, key: &str) -> Option<&str> {
        let found = self.0.iter().find(|(name, _)| name == key);
        found.map(|(_, value)| value.as_str())
    }

    pub fn number(&self, key: &str) -> Option<f64> {
        // Fortran writes exponents with a D.
        self.text(key)?.replace(['D', 'd'], "E").parse().ok()
    }

    fn whole(&self, key: &str) -> Option<i64> {
        self.text(key)?.parse().ok()
    }
}

/// One header with its numbers.
struct Unit {
    cards: Cards,
    /// Where its numbers begin.
    data: u64,
    /// NAXIS1, NAXIS2, …
    axes: Vec<usize>,
    bitpix: i64,
}

/// A unit that is read frame by frame.
pub(crate) struct Stack<R> {
    file: R,
    unit: Unit,
    count: usize,
    rows: usize,
    columns: usize,
    format: SampleFormat,
}

impl<R: Read + Seek> Stack<R> {
    /// Finds the unit: named by `EXTNAME` or its index, or the only image.
    pub fn open(source: &Source, mut file: R) -> Result<Self> {
        let mut units = units(source, &mut file)?;
        let all: Vec<ArrayInfo> = units
            .iter()
            .enumerate()
            .map(|(i, u)| candidate(i, u))
            .collect();
        let unit = units.swap_remove(choose(source, &all)?);
        let (columns, rows, count) = match unit.axes[..] {
            [columns, rows] => (columns, rows, 1),
            [columns, rows, count] => (columns, rows, count),
            _ => unreachable!("the choice has two or three axes"),
        };
        let format = format_of(&unit);
        Ok(Self {
            file,
            unit,
            count,
            rows,
            columns,
            format,
        })
    }

    /// Keywords of the unit.
    pub fn cards(&self) -> &Cards {
        &self.unit.cards
    }

    /// Rows and columns of a frame.
    pub fn size(&self) -> (usize, usize) {
        (self.rows, self.columns)
    }

    /// The bytes of frame `at`.
    fn bytes(&mut self, source: &Source, at: usize) -> Result<Vec<u8>> {
        let size = self.unit.bitpix.unsigned_abs() as usize / 8;
        let bytes = self.rows * self.columns * size;
        let start = (at as u64).checked_mul(bytes as u64);
        let start = start.and_then(|skipped| skipped.checked_add(self.unit.data));
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
        self.file
            .seek(SeekFrom::Start(start))
            .and_then(|_| self.file.read_exact(&mut buffer))
            .map_err(|e| source.unreadable(e))?;
        Ok(buffer)
    }

    /// The pixels of a frame, with its top row first.
    fn top_first<T: Copy>(&self, data: Vec<T>) -> Vec<T> {
        if self.unit.cards.text("ROWORDER") != Some("BOTTOM-UP") {
            return data;
        }
        let rows = data.chunks_exact(self.columns).rev();
        rows.flatten().copied().collect()
    }
}

impl<R: Read + Seek + Send> crate::pages::Stack for Stack<R> {
    fn count(&self) -> usize {
        self.count
    }

    fn page(&mut self, source: &Source, at: usize) -> Result<Pages> {
        let mut data = source.reserve_pixels(1, self.rows, self.columns)?;
        let buffer = self.bytes(source, at)?;
        decode(&self.unit, &buffer, &mut data);
        Ok(Pages {
            count: 1,
            rows: self.rows,
            columns: self.columns,
            data: self.top_first(data),
            format: self.format,
        })
    }

    fn integers(&mut self, source: &Source, at: usize) -> Result<IntegerFrame> {
        if !self.format.exceeds_f32() {
            let page = self.page(source, at)?;
            return Ok(IntegerFrame::of_pages(&page));
        }
        drop(source.reserve_pixels(1, self.rows, self.columns)?);
        let buffer = self.bytes(source, at)?;
        Ok(IntegerFrame {
            rows: self.rows,
            columns: self.columns,
            data: self.top_first(decode_integers(&self.unit, &buffer)),
            format: self.format,
        })
    }
}

/// Integers that BZERO alone shifts keep their bits; all else is floating point.
fn format_of(unit: &Unit) -> SampleFormat {
    let scale = unit.cards.number("BSCALE").unwrap_or(1.0);
    let zero = unit.cards.number("BZERO").unwrap_or(0.0);
    let counts = |bits| SampleFormat::Counts { bits };
    match (unit.bitpix, zero) {
        _ if scale != 1.0 => SampleFormat::Float,
        (8, 0.0) => counts(8),
        (8, -128.0) => counts(7),
        (bits @ (16 | 32 | 64), 0.0) => counts(bits as u32 - 1),
        (bits @ (16 | 32 | 64), zero) if zero == f64::from(bits as u32 - 1).exp2() => {
            counts(bits as u32)
        }
        _ => SampleFormat::Float,
    }
}

fn decode(unit: &Unit, bytes: &[u8], data: &mut Vec<f32>) {
    let scale = unit.cards.number("BSCALE").unwrap_or(1.0);
    let zero = unit.cards.number("BZERO").unwrap_or(0.0);
    let blank = unit.cards.whole("BLANK");
    macro_rules! integers {
        ($t:ty) => {
            data.extend(bytes.as_chunks::<{ size_of::<$t>() }>().0.iter().map(|&b| {
                let number = <$t>::from_be_bytes(b);
                match blank {
                    Some(blank) if i128::from(number) == i128::from(blank) => f32::NAN,
                    _ => (zero + scale * number as f64) as f32,
                }
            }))
        };
    }
    macro_rules! floats {
        ($t:ty) => {
            data.extend(
                bytes
                    .as_chunks::<{ size_of::<$t>() }>()
                    .0
                    .iter()
                    .map(|&b| (zero + scale * f64::from(<$t>::from_be_bytes(b))) as f32),
            )
        };
    }
    match unit.bitpix {
        8 => integers!(u8),
        16 => integers!(i16),
        32 => integers!(i32),
        64 => integers!(i64),
        -32 => floats!(f32),
        _ => floats!(f64),
    }
}

/// The numbers of a unit of 32 or 64 bits that BZERO alone shifts, if anything; 0 where they are BLANK.
fn decode_integers(unit: &Unit, bytes: &[u8]) -> Vec<i64> {
    let is_shifted = unit.cards.number("BZERO").unwrap_or(0.0) != 0.0;
    let blank = unit.cards.whole("BLANK");
    let known = |number: i64| (Some(number) != blank).then_some(number);
    if unit.bitpix == 32 {
        let shift = if is_shifted { 1 << 31 } else { 0 };
        let numbers = bytes.as_chunks::<4>().0.iter();
        let numbers = numbers.map(|&b| known(i64::from(i32::from_be_bytes(b))));
        numbers.map(|n| n.map_or(0, |n| n + shift)).collect()
    } else {
        // 2⁶³ more is another highest bit, in numbers without a sign.
        let shift = if is_shifted { i64::MIN } else { 0 };
        let numbers = bytes.as_chunks::<8>().0.iter();
        let numbers = numbers.map(|&b| known(i64::from_be_bytes(b)));
        numbers.map(|n| n.map_or(0, |n| n ^ shift)).collect()
    }
}

fn candidate(index: usize, unit: &Unit) -> ArrayInfo {
    let is_compressed = unit.cards.text("ZIMAGE") == Some("T");
    let kind = unit.cards.text("XTENSION").unwrap_or("IMAGE");
    let name = unit.cards.text("EXTNAME").unwrap_or_default();
    ArrayInfo {
        name: match name {
            "" => index.to_string(),
            name => name.into(),
        },
        shape: unit.axes.iter().rev().copied().collect(),
        kind: match (is_compressed, kind) {
            (true, _) => "a compressed image: unpack it by funpack".into(),
            (_, "IMAGE") => format!("BITPIX {}", unit.bitpix),
            (_, other) => other.into(),
        },
        is_numeric: kind == "IMAGE"
            && !is_compressed
            && [8, 16, 32, 64, -32, -64].contains(&unit.bitpix),
    }
}

/// The headers of all units.
fn units(source: &Source, file: &mut (impl Read + Seek)) -> Result<Vec<Unit>> {
    let mut found = Vec::new();
    let mut at = 0;
    while at + BLOCK <= source.bytes && found.len() < MAX_UNITS {
        let seek = file.seek(SeekFrom::Start(at));
        seek.map_err(|e| source.unreadable(e))?;
        let Some((cards, blocks)) = header(source, file)? else {
            // What follows the last unit is of no concern, what should be the first is.
            if found.is_empty() {
                return Err(source.unreadable("no FITS header"));
            }
            break;
        };
        let data = at + blocks as u64 * BLOCK;
        let naxis = cards.whole("NAXIS").unwrap_or(0);
        let axes: Option<Vec<usize>> = (1..=naxis.clamp(0, 999))
            .map(|i| usize::try_from(cards.whole(&format!("NAXIS{i}"))?).ok())
            .collect();
        let axes = axes.ok_or_else(|| source.unreadable("NAXISn is missing"))?;
        let bitpix = cards.whole("BITPIX").unwrap_or(0);
        let also = cards.whole("PCOUNT").unwrap_or(0).max(0) as u64;
        let size = bitpix.unsigned_abs() / 8;
        let numbers = axes
            .iter()
            .try_fold(1u64, |n, &side| n.checked_mul(side as u64));
        let bytes = if axes.is_empty() {
            Some(0)
        } else {
            numbers.and_then(|n| n.checked_add(also)?.checked_mul(size))
        };
        let bytes = bytes.ok_or_else(|| source.unreadable("sizes beyond all bounds"))?;
        found.push(Unit {
            cards,
            data,
            axes,
            bitpix,
        });
        let Some(next) = bytes
            .checked_next_multiple_of(BLOCK)
            .and_then(|b| b.checked_add(data))
        else {
            break;
        };
        at = next;
    }
    if found.is_empty() {
        Err(source.unreadable("no FITS header"))
    } else {
        Ok(found)
    }
}

/// The cards up to END, and the blocks that they take; `None` where there is no header.
fn header(source: &Source, file: &mut impl Read) -> Result<Option<(Cards, usize)>> {
    let mut cards = Cards::default();
    let mut block = [0; BLOCK as usize];
    for blocks in 1..=MAX_HEADER_BLOCKS {
        file.read_exact(&mut block)
            .map_err(|e| source.unreadable(e))?;
        if blocks == 1 && !block.starts_with(b"SIMPLE  =") && !block.starts_with(b"XTENSION=") {
            return Ok(None);
        }
        for card in block.chunks_exact(CARD) {
            let card = String::from_utf8_lossy(card);
            let (key, rest) = card.split_at_checked(8).unwrap_or((&card, ""));
            if key.trim() == "END" {
                return Ok(Some((cards, blocks)));
            }
            if let Some(value) = rest.strip_prefix("= ") {
                cards.0.push((key.trim().into(), value_of(value)));
            }
        }
    }
    Err(source.unreadable("its header has no end"))
}

/// The value of a card, without its quotes and its comment.
fn value_of(text: &str) -> String {
    let text = text.trim();
    match text.strip_prefix('\'') {
        Some(quoted) => quoted.split('\'').next().unwrap_or("").trim_end().into(),
        None => text.split('/').next().unwrap_or("").trim().into(),
    }
}

#[cfg(test)]
mod tests {
    use crate::metadata::read_metadata;
    use crate::pages::SampleFormat;
    use crate::read::{read_image, read_stack};

    fn block(cards: &[&str]) -> Vec<u8> {
        let mut bytes: Vec<u8> = cards
            .iter()
            .flat_map(|c| format!("{c:<80}").into_bytes())
            .collect();
        bytes.extend(format!("{:<80}", "END").into_bytes());
        bytes.resize(bytes.len().next_multiple_of(2880), b' ');
        bytes
    }

    fn unit(cards: &[&str], data: &[u8]) -> Vec<u8> {
        let mut bytes = block(cards);
        bytes.extend(data);
        bytes.resize(bytes.len().next_multiple_of(2880), 0);
        bytes
    }

    const CUBE: [&str; 8] = [
        "SIMPLE  =                    T / a standard file",
        "BITPIX  =                   16",
        "NAXIS   =                    3",
        "NAXIS1  =                    3",
        "NAXIS2  =                    2",
        "NAXIS3  =                    2",
        "BZERO   =                32768 / unsigned",
        "EXPTIME =               0.0005 / seconds",
    ];

    fn numbers() -> Vec<u8> {
        let values = (0..12).map(|v: i16| (v * 100).wrapping_sub(32767).wrapping_sub(1));
        values.flat_map(|v| v.to_be_bytes()).collect()
    }

    #[test]
    fn cubes_of_unsigned_counts_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.fits");
        std::fs::write(&path, unit(&CUBE, &numbers())).unwrap();
        let stack = read_stack(&path).unwrap();
        assert_eq!(
            (stack.len(), stack[0].rows(), stack[0].columns()),
            (2, 2, 3)
        );
        assert_eq!(stack[1].data(), [600., 700., 800., 900., 1000., 1100.]);
        let metadata = read_metadata(&path);
        assert_eq!(
            (metadata.exposure_us, metadata.size),
            (Some(500.0), Some((2, 3)))
        );

        let mut flipped = CUBE.to_vec();
        flipped.push("ROWORDER= 'BOTTOM-UP'");
        std::fs::write(&path, unit(&flipped, &numbers())).unwrap();
        assert_eq!(
            read_stack(&path).unwrap()[0].data(),
            [300., 400., 500., 0., 100., 200.]
        );
    }

    #[test]
    fn integers_keep_their_digits() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.fits");
        let cube = |bits: &'static str, zero: &'static str| {
            let mut cards = CUBE.to_vec();
            (cards[1], cards[6]) = (bits, zero);
            cards
        };
        let read = || {
            let recording = crate::open_recording(&path).unwrap();
            recording.read_integers(0).unwrap().data
        };
        let values = [16_777_217, i64::from(u32::MAX), 0, 1, 2, 3];
        let data: Vec<u8> = values
            .iter()
            .cycle()
            .take(12)
            .flat_map(|v| ((v - (1_i64 << 31)) as i32).to_be_bytes())
            .collect();
        let cards = cube("BITPIX  = 32", "BZERO   = 2147483648");
        std::fs::write(&path, unit(&cards, &data)).unwrap();
        assert_eq!(read(), values);
        let values = [9_007_199_254_740_993, -1, 0, 1, 2, 3];
        let data: Vec<u8> = values
            .iter()
            .cycle()
            .take(12)
            .flat_map(|v: &i64| v.to_be_bytes())
            .collect();
        std::fs::write(&path, unit(&cube("BITPIX  = 64", "BZERO   = 0"), &data)).unwrap();
        assert_eq!(read(), values);
    }

    #[test]
    fn kinds_of_numbers_and_extensions() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.fit");
        let primary = unit(&["SIMPLE  = T", "BITPIX  = 8", "NAXIS   = 0"], &[]);
        let image = |bitpix: &str, more: &[&str], data: &[u8]| {
            let mut cards = vec![
                "XTENSION= 'IMAGE   '".to_string(),
                format!("BITPIX  = {bitpix}"),
            ];
            cards.extend(
                ["NAXIS   = 2", "NAXIS1  = 2", "NAXIS2  = 1", "PCOUNT  = 0"].map(String::from),
            );
            cards.extend(more.iter().map(|m| m.to_string()));
            unit(&cards.iter().map(String::as_str).collect::<Vec<_>>(), data)
        };
        let named = |name: &str| read_image(&folder.path().join(format!("a.fit:{name}")));
        let counts = |bits| SampleFormat::Counts { bits };
        let check =
            |bitpix: &str, more: &[&str], data: &[u8], format: SampleFormat, expected: [f32; 2]| {
                let bytes = [primary.clone(), image(bitpix, more, data)].concat();
                std::fs::write(&path, bytes).unwrap();
                let read = named("1").unwrap();
                assert_eq!(read.format, format);
                let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                assert_eq!(bits(read.image.data()), bits(&expected), "{bitpix}");
            };
        check("8", &[], &[7, 255], counts(8), [7., 255.]);
        let blank = ["BLANK   = -1"];
        check(
            "16",
            &blank,
            &[0, 5, 0xff, 0xff],
            counts(15),
            [5., f32::NAN],
        );
        let unsigned = ["BZERO   = 2147483648"];
        check(
            "32",
            &unsigned,
            &[0x80, 0, 0, 1, 0x80, 0, 0, 0],
            counts(32),
            [1., 0.],
        );
        let floats: Vec<u8> = [1.5f32, -2.0]
            .iter()
            .flat_map(|v| v.to_be_bytes())
            .collect();
        check(
            "-32",
            &["BSCALE  = 2.0D0"],
            &floats,
            SampleFormat::Float,
            [3., -4.],
        );
        let doubles: Vec<u8> = [1.5f64, 1e30]
            .iter()
            .flat_map(|v| v.to_be_bytes())
            .collect();
        check("-64", &[], &doubles, SampleFormat::Float, [1.5, 1e30]);

        let science = image("8", &["EXTNAME = 'SCI'"], &[1, 2]);
        let mask = image("8", &["EXTNAME = 'MASK'"], &[0, 1]);
        std::fs::write(&path, [primary, science, mask].concat()).unwrap();
        assert_eq!(named("MASK").unwrap().image.data(), [0., 1.]);
        let message = read_image(&path).unwrap_err().to_string();
        assert!(message.contains("SCI ([1, 2], BITPIX 8)"), "{message}");
    }

    #[test]
    fn damaged_files_give_an_error_and_no_panic() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.fits");
        let whole = unit(&CUBE, &numbers());
        for length in [1, 79, 2879, 2880, 2890, 2903] {
            std::fs::write(&path, &whole[..length]).unwrap();
            let message = read_stack(&path).unwrap_err().to_string();
            assert!(message.contains("a.fits: found"), "{message}");
        }
        for at in 0..9 * 80 {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x1f;
            std::fs::write(&path, bytes).unwrap();
            let _ = read_stack(&path);
        }
    }
}
