//! The file that is being read: where it is, what format it has, and the words of its errors.

use crate::fault;
use rowburst::error::Phrase;
use rowburst::{Error, ErrorKind, Result};
use std::fmt::Display;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

/// What to do with an image whose channels differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Colour {
    Refused,
    Averaged,
}

/// The file being read: for the checks and the words of every format.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Source<'a> {
    /// As it was given, with the name of the array where it has one.
    pub path: &'a Path,
    /// Length of the file.
    pub bytes: u64,
    pub colour: Colour,
}

/// A file, and the array in it that is meant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ArrayPath {
    pub file: PathBuf,
    /// What follows the colon in `FILE.h5:/path` or `FILE.mat:name`.
    pub array: Option<String>,
}

impl ArrayPath {
    /// Takes `path` apart; a file of exactly that name is one without a colon.
    pub fn of(path: &Path) -> Self {
        let whole = || Self {
            file: path.into(),
            array: None,
        };
        let Some(text) = path.to_str() else {
            return whole();
        };
        let mut colons = text.match_indices(':').map(|(at, _)| at);
        let found = colons.find(|&at| {
            let file = Path::new(&text[..at]);
            Format::of_name(file).is_some_and(Format::has_names) && !path.exists()
        });
        match found {
            Some(at) => Self {
                file: text[..at].into(),
                array: Some(text[at + 1..].into()),
            },
            None => whole(),
        }
    }
}

/// Pixels that a byte of a file can stand for. Deflate reaches 1032 bytes for
/// one, LZW 2600, and a bilevel byte has 8 pixels: a file that claims more is damaged.
const PIXELS_PER_BYTE: u64 = 32_768;
/// Bytes by which a file of text is known, and how few may look like text by chance.
const TEXT_BYTES: u64 = 256;
const MIN_TEXT_BYTES: usize = 8;

impl<'a> Source<'a> {
    /// Opens `path`, which must be a file with something in it.
    pub fn open(path: &'a Path, colour: Colour) -> Result<(Self, BufReader<File>)> {
        let file = ArrayPath::of(path).file;
        let metadata = file.metadata().map_err(|e| fault::read_error(path, &e))?;
        let bytes = metadata.len();
        let source = Self {
            path,
            bytes,
            colour,
        };
        if metadata.is_dir() {
            let remedy = "Name a file in it.";
            return Err(source.error("a folder", "a file is needed here", remedy));
        }
        if bytes == 0 {
            let remedy = "Save or copy it again: the writing may have been cut short.";
            return Err(source.error("an empty file", "an image has pixels", remedy));
        }
        let file = File::open(&file).map_err(|e| fault::read_error(path, &e))?;
        Ok((source, BufReader::new(file)))
    }

    /// An error of this file, [`ErrorKind::Unreadable`].
    pub fn error(
        &self,
        found: impl ToString,
        rule: impl Into<Phrase>,
        remedy: impl Into<Phrase>,
    ) -> Error {
        Error::input(self.path, found, rule, remedy).with_kind(ErrorKind::Unreadable)
    }

    /// The error of a file that its format's library cannot read.
    pub fn unreadable(&self, reason: impl Display) -> Error {
        if let Some(line) = self.text_line() {
            return self.error(
                format!("a text file (\"{line}\")"),
                "the file must be of the format that its name says",
                "Save the numbers in this format, or give the file its own ending.",
            );
        }
        let reason = reason.to_string();
        // The words of the standard library for the end of a file.
        if reason.contains("failed to fill whole buffer") {
            return self.error(
                format!("a file that ends too early, after {} bytes", self.bytes),
                "the file must be whole",
                "Save or copy it again: it is cut short.",
            );
        }
        self.error(
            format!("a file that cannot be read ({reason})"),
            "the file must be whole and of the format that its name says",
            "Save or copy it again: it may be cut short or damaged.",
        )
    }

    /// The begin of the first line where the file is one of text.
    fn text_line(&self) -> Option<String> {
        let mut start = Vec::new();
        let file = File::open(ArrayPath::of(self.path).file).ok()?;
        file.take(TEXT_BYTES).read_to_end(&mut start).ok()?;
        let text = String::from_utf8(start).ok()?;
        let is_text = |c: char| !c.is_control() || c.is_ascii_whitespace();
        if text.len() < MIN_TEXT_BYTES || !text.chars().all(is_text) {
            return None;
        }
        let line = text.lines().find(|line| !line.trim().is_empty())?;
        Some(line.trim().chars().take(24).collect())
    }

    /// The error of a kind of pixel that is not read.
    pub fn unsupported(&self, pixels: impl Display) -> Error {
        self.error(
            format!("pixels of the kind {pixels}"),
            "pixels are grey: integers of 8, 16 or 32 bits, or floating point of 32 or 64",
            "Convert the file, for example to 16-bit grey TIFF or a float32 .npy.",
        )
    }

    /// An empty vector with room for the pixels, if a file this long can hold them.
    pub fn reserve_pixels(&self, count: usize, rows: usize, columns: usize) -> Result<Vec<f32>> {
        if count.min(rows).min(columns) == 0 {
            return Err(self.error(
                "an empty array",
                "an image has at least one pixel",
                "Check what was saved: nothing was in it.",
            ));
        }
        let total = rows.checked_mul(columns).and_then(|p| p.checked_mul(count));
        let most = self.bytes.saturating_mul(PIXELS_PER_BYTE);
        let total =
            match total {
                Some(total) if total > 0 && total as u64 <= most => total,
                _ => {
                    return Err(self.error(
                    format!("{count} pages of {rows}×{columns} pixels in {} bytes", self.bytes),
                    "a file of this length cannot hold them, and there must be at least one pixel",
                    "Save or copy it again: its header is damaged.",
                ));
                }
            };
        let mut data = Vec::new();
        // The decoders' own buffer of a page, up to 16 bytes a pixel, is tried out first:
        // they would end the program where there is no memory for it.
        let page = Vec::<[u32; 4]>::new().try_reserve_exact(total / count);
        page.and(data.try_reserve_exact(total)).map_err(|_| {
            Error::work(
                self.path,
                format!("no memory for {total} pixels"),
                "Crop or bin the images, or use a machine with more memory.",
            )
            .with_kind(ErrorKind::Memory)
        })?;
        Ok(data)
    }

    /// Appends the grey values of interleaved `samples` of 1 (grey), 2 (grey, alpha),
    /// 3 (RGB) or 4 (RGBA) channels; alpha is ignored.
    pub fn push_grey(
        &self,
        data: &mut Vec<f32>,
        samples: impl Iterator<Item = f32>,
        channels: usize,
    ) -> Result<()> {
        if channels < 3 {
            data.extend(samples.step_by(channels));
            return Ok(());
        }
        let mut samples = samples;
        while let (Some(r), Some(g), Some(b)) = (samples.next(), samples.next(), samples.next()) {
            if channels == 4 {
                samples.next();
            }
            if self.colour == Colour::Refused && (r != g || g != b) {
                return Err(self.error(
                    format!("an image in colour (a pixel with red {r}, green {g}, blue {b})"),
                    "one value per pixel is needed: colour channels must be equal",
                    "Convert it to grey, or save the camera's raw monochrome frame.",
                ));
            }
            data.push(((f64::from(r) + f64::from(g) + f64::from(b)) / 3.0) as f32);
        }
        Ok(())
    }
}

/// A format of images, by the ending of a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Format {
    Npy,
    Tiff,
    Png,
    Bmp,
    Hdf5,
    Matlab,
    Fits,
    Photron,
}

/// Endings that are read, for messages.
pub const ENDINGS: &str = ".npy, .tif, .png, .bmp, .h5, .mat, .fits or .cihx";

impl Format {
    pub fn of_name(path: &Path) -> Option<Self> {
        let ending = path.extension()?.to_str()?.to_ascii_lowercase();
        match ending.as_str() {
            "npy" => Some(Self::Npy),
            "tif" | "tiff" => Some(Self::Tiff),
            "png" => Some(Self::Png),
            "bmp" => Some(Self::Bmp),
            "h5" | "hdf5" | "hdf" | "he5" => Some(Self::Hdf5),
            "mat" => Some(Self::Matlab),
            "fits" | "fit" | "fts" => Some(Self::Fits),
            "cihx" | "cih" | "mraw" => Some(Self::Photron),
            _ => None,
        }
    }

    /// Whether a file of this format holds arrays by name.
    pub fn has_names(self) -> bool {
        matches!(self, Self::Hdf5 | Self::Matlab | Self::Fits)
    }

    fn of_content(start: &[u8]) -> Option<Self> {
        match start {
            [0x93, b'N', b'U', b'M', ..] => Some(Self::Npy),
            [b'I', b'I', 42 | 43, 0] | [b'M', b'M', 0, 42 | 43] => Some(Self::Tiff),
            [0x89, b'P', b'N', b'G'] => Some(Self::Png),
            [b'B', b'M', ..] => Some(Self::Bmp),
            [0x89, b'H', b'D', b'F'] => Some(Self::Hdf5),
            b"MATL" => Some(Self::Matlab),
            b"SIMP" => Some(Self::Fits),
            _ => None,
        }
    }
}

/// Whether a file of this name is read as an image, by its ending.
pub fn is_image(path: &Path) -> bool {
    // The raw frames of Photron are read by their header.
    let is_raw = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("mraw"));
    Format::of_name(path).is_some() && !is_raw
}

/// Opens `path`, whose content must be what its ending says.
pub(crate) fn open(path: &Path, colour: Colour) -> Result<(Source<'_>, BufReader<File>, Format)> {
    let (source, mut file) = Source::open(path, colour)?;
    let Some(format) = Format::of_name(&ArrayPath::of(path).file) else {
        let ending = path.extension().map_or("no ending".into(), |e| {
            format!("the ending .{}", e.to_string_lossy())
        });
        return Err(source.error(
            ending,
            format!("images, stacks and videos are read as {ENDINGS}"),
            "Convert it; for a film: ffmpeg -i FILM -pix_fmt gray frame%05d.png, then join the frames to one .tif in Fiji or one .npy in Python.",
        ));
    };
    let mut start = Vec::new();
    let sniffed = file.by_ref().take(4).read_to_end(&mut start);
    let back = file.rewind();
    sniffed.and(back).map_err(|e| fault::read_error(path, &e))?;
    // A .mat file of version 7.3 may do without MATLAB's header.
    let is_same =
        |content| content == format || (content, format) == (Format::Hdf5, Format::Matlab);
    if let Some(content) = Format::of_content(&start).filter(|&content| !is_same(content)) {
        return Err(source.error(
            format!("the content of a {content:?} file"),
            "the ending of the name must be that of the format",
            "Rename the file.",
        ));
    }
    Ok((source, file, format))
}
