//! Reading images, stacks and videos: the format is that of the file's name.

use crate::{bmp, fault, npy, png, tiff};
use rowburst::{Error, Image, Result, Shape, Video};
use std::fmt::Display;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

/// One image as it was read.
#[derive(Debug, Clone, PartialEq)]
pub struct Capture {
    /// The pixels. Integers beyond 2²⁴ are rounded to the nearest f32.
    pub image: Image,
    /// What kind of numbers the file holds.
    pub level: Level,
}

/// What kind of numbers a file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// Integers: counts of a sensor.
    Counts {
        /// Bits of the container (1, 8, 16, 32 or 64), not of the converter: 12-bit
        /// counts lie in 16 bits.
        bits: u32,
    },
    /// Floating point.
    Float,
}

/// Reads one image: `.npy` (2-D), `.tif`, `.png` or `.bmp`.
///
/// Pixels that are not finite are left to the caller. An image in colour is read
/// only if its channels are equal; see [`read_colour_image`].
///
/// # Errors
/// A file that is missing, damaged, of another format, in colour, or that holds
/// more than one page.
pub fn read_image(path: &Path) -> Result<Capture> {
    capture(path, Colour::Refused)
}

/// Like [`read_image`], but takes the mean of the channels of an image in colour.
///
/// For what depends on position alone, such as the stripes of a flickering light:
/// the channels of a colour camera are not linear in the light.
///
/// # Errors
/// Those of [`read_image`], but for colour.
pub fn read_colour_image(path: &Path) -> Result<Capture> {
    capture(path, Colour::Averaged)
}

/// Reads the pages of a stack, all of one size; a single image is a stack of one.
///
/// # Errors
/// Those of [`read_image`], but for several pages.
pub fn read_stack(path: &Path) -> Result<Vec<Image>> {
    let pages = read_pages(path, Colour::Refused)?;
    let pixels = pages.rows * pages.columns;
    let images = pages.data.chunks_exact(pixels);
    images
        .map(|page| Image::new(pages.rows, pages.columns, page.to_vec()))
        .collect()
}

/// Reads a video `[t, y, x]`: a 3-D `.npy` or a multi-page `.tif`; a single image
/// is a video of one bin.
///
/// # Errors
/// Those of [`read_image`], but for several pages.
pub fn read_video(path: &Path) -> Result<Video> {
    let pages = read_pages(path, Colour::Refused)?;
    let shape = Shape::new(pages.count, pages.rows, pages.columns);
    Video::new(shape, pages.data).map_err(|e| e.within(path.display()))
}

fn capture(path: &Path, colour: Colour) -> Result<Capture> {
    single(path, read_pages(path, colour)?)
}

/// The one image that `pages` must be.
pub(crate) fn single(path: &Path, pages: Pages) -> Result<Capture> {
    if pages.count != 1 {
        return Err(Error::input(
            path.display().to_string(),
            format!(
                "a stack of {} pages of {}×{} pixels",
                pages.count, pages.rows, pages.columns
            ),
            "one image is needed here",
            "Save the page that is meant as a file of its own.",
        ));
    }
    let image = Image::new(pages.rows, pages.columns, pages.data);
    Ok(Capture {
        image: image.map_err(|e| e.within(path.display()))?,
        level: pages.level,
    })
}

/// The pages of a file, all of one size, one after the other.
pub(crate) struct Pages {
    pub count: usize,
    pub rows: usize,
    pub columns: usize,
    pub data: Vec<f32>,
    pub level: Level,
}

/// What to do with an image whose channels differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Colour {
    Refused,
    Averaged,
}

/// The file being read: for the checks and the words of every format.
pub(crate) struct Source<'a> {
    pub path: &'a Path,
    /// Length of the file.
    pub bytes: u64,
    pub colour: Colour,
}

/// Pixels that a byte of a file can stand for. Deflate reaches 1032 bytes for
/// one, LZW 2600, and a bilevel byte has 8 pixels: a file that claims more is damaged.
const PIXELS_PER_BYTE: u64 = 32_768;

impl<'a> Source<'a> {
    /// Opens `path`, which must be a file with something in it.
    pub fn open(path: &'a Path, colour: Colour) -> Result<(Self, BufReader<File>)> {
        let open = || -> std::io::Result<_> { Ok((path.metadata()?, File::open(path)?)) };
        let (metadata, file) = open().map_err(|e| fault::reading(path, &e))?;
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
        Ok((source, BufReader::new(file)))
    }

    /// An [`Error::Input`] about this file.
    pub fn error(
        &self,
        found: impl ToString,
        rule: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Error {
        Error::input(self.path.display().to_string(), found, rule, remedy)
    }

    /// The error of a file that its format's library cannot read.
    pub fn unreadable(&self, reason: impl Display) -> Error {
        self.error(
            format!("a file that cannot be read ({reason})"),
            "the file must be whole and of the format that its name says",
            "Save or copy it again: it may be cut short or damaged.",
        )
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
    pub fn room(&self, count: usize, rows: usize, columns: usize) -> Result<Vec<f32>> {
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
                self.path.display().to_string(),
                format!("no memory for {total} pixels"),
                "Crop or bin the images, or use a machine with more memory.",
            )
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
}

impl Format {
    pub fn of_name(path: &Path) -> Option<Self> {
        let ending = path.extension()?.to_str()?.to_ascii_lowercase();
        match ending.as_str() {
            "npy" => Some(Self::Npy),
            "tif" | "tiff" => Some(Self::Tiff),
            "png" => Some(Self::Png),
            "bmp" => Some(Self::Bmp),
            _ => None,
        }
    }

    fn of_content(start: &[u8]) -> Option<Self> {
        match start {
            [0x93, b'N', b'U', b'M', ..] => Some(Self::Npy),
            [b'I', b'I', 42 | 43, 0] | [b'M', b'M', 0, 42 | 43] => Some(Self::Tiff),
            [0x89, b'P', b'N', b'G'] => Some(Self::Png),
            [b'B', b'M', ..] => Some(Self::Bmp),
            _ => None,
        }
    }
}

fn read_pages(path: &Path, colour: Colour) -> Result<Pages> {
    let (source, file, format) = open(path, colour)?;
    match format {
        Format::Npy => npy::read(&source, file),
        Format::Tiff => tiff::read(&source, file),
        Format::Png => png::read(&source, file),
        Format::Bmp => bmp::read(&source, file),
    }
}

/// Opens `path`, whose content must be what its ending says.
pub(crate) fn open(path: &Path, colour: Colour) -> Result<(Source<'_>, BufReader<File>, Format)> {
    let (source, mut file) = Source::open(path, colour)?;
    let Some(format) = Format::of_name(path) else {
        let ending = path.extension().map_or("no ending".into(), |e| {
            format!("the ending .{}", e.to_string_lossy())
        });
        return Err(source.error(
            ending,
            "images are read as .npy, .tif, .png or .bmp, videos as .npy or multi-page .tif",
            "Convert it; for a film: ffmpeg -i FILM -pix_fmt gray frame%05d.png, then join the frames to one .tif in Fiji or one .npy in Python.",
        ));
    };
    let mut start = Vec::new();
    let sniffed = file.by_ref().take(4).read_to_end(&mut start);
    let back = file.rewind();
    sniffed.and(back).map_err(|e| fault::reading(path, &e))?;
    if let Some(content) = Format::of_content(&start).filter(|&content| content != format) {
        return Err(source.error(
            format!("the content of a {content:?} file"),
            "the ending of the name must be that of the format",
            "Rename the file.",
        ));
    }
    Ok((source, file, format))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_are_no_images_say_so() {
        let folder = tempfile::tempdir().unwrap();
        let png = b"\x89PNG\r\n\x1a\n and more".as_slice();
        let cases = [
            ("a.tif", Some(b"".as_slice()), "an empty file"),
            (
                "a.jpg",
                Some(b"x".as_slice()),
                "the ending .jpg; images are read as .npy",
            ),
            ("film.mp4", Some(b"x".as_slice()), "ffmpeg"),
            ("none", Some(b"x".as_slice()), "no ending"),
            ("b.tif", Some(png), "the content of a Png file"),
            ("c.PNG", Some(png), "cannot be read"),
            ("d.npy", None, "no such file"),
            ("e.bmp", Some(b"x".as_slice()), "cannot be read"),
        ];
        for (name, content, expected) in cases {
            let path = folder.path().join(name);
            if let Some(content) = content {
                std::fs::write(&path, content).unwrap();
            }
            let error = read_image(&path).unwrap_err();
            assert!(matches!(error, Error::Input { .. }), "{error}");
            let message = error.to_string();
            assert!(
                message.contains(name) && message.contains(expected),
                "{message}"
            );
        }
        let message = read_image(folder.path()).unwrap_err().to_string();
        assert!(message.contains("a folder"), "{message}");
    }

    /// A small file of each format.
    fn samples() -> Vec<(&'static str, Vec<u8>)> {
        let image = Image::from_fn(5, 7, |y, x| (y * x) as f32);
        let mut npy = Vec::new();
        npy::write_npy_image(&mut npy, &image).unwrap();
        let mut tiff = std::io::Cursor::new(Vec::new());
        tiff::write_tiff_image(&mut tiff, &image).unwrap();
        let mut png = Vec::new();
        png::write_png16(&mut png, 5, 7, &[77; 35]).unwrap();
        let mut bmp = b"BM".to_vec();
        for field in [54 + 24, 0, 54, 40, 2, 3, 24 << 16 | 1, 0, 24, 0, 0, 0, 0] {
            bmp.extend(u32::to_le_bytes(field));
        }
        bmp.extend([9; 24]);
        vec![
            ("a.npy", npy),
            ("a.tif", tiff.into_inner()),
            ("a.png", png),
            ("a.bmp", bmp),
        ]
    }

    #[test]
    fn samples_are_whole() {
        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in samples() {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            read_image(&path).unwrap();
        }
    }

    proptest::proptest! {
        #[test]
        fn damaged_files_give_an_error_and_no_panic(
            changes in proptest::collection::vec((0usize..4000, 0u8..=255), 1..6),
        ) {
            let folder = tempfile::tempdir().unwrap();
            for (name, mut bytes) in samples() {
                let length = bytes.len();
                changes.iter().for_each(|&(at, value)| bytes[at % length] = value);
                let path = folder.path().join(name);
                std::fs::write(&path, bytes).unwrap();
                if let Err(error) = read_colour_image(&path) {
                    let message = error.to_string();
                    proptest::prop_assert!(message.contains(name), "{}", message);
                }
            }
        }
    }
}
