//! TIFF: single images, and stacks that ImageJ and Fiji open as a time series.

use crate::fault;
use crate::ome_sizes::{OmeImages, ome_images, ome_sizes};
use crate::pages::{IntegerFrame, Pages, SampleFormat};
use crate::source::{ArrayPath, Source};
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Image, Result, Shape, Video};
use std::fs::File;
use std::io::{BufReader, Read, Seek, Write};
use tiff::decoder::ifd::Value;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::encoder::{Rational, TiffEncoder, TiffKind, colortype::Gray32Float};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

/// Largest file of the classic format, whose offsets have 32 bits; a margin is left
/// for what is not pixels.
const CLASSIC_BYTES: u64 = (1 << 32) - (1 << 26);

/// Reads every page; all must have one size and one kind of pixel.
pub(crate) fn read<R: Read + Seek>(source: &Source, file: BufReader<R>) -> Result<Pages> {
    read_up_to(source, file, usize::MAX)
}

/// Like [`read`], but the data are those of the first page alone.
pub(crate) fn read_first<R: Read + Seek>(source: &Source, file: BufReader<R>) -> Result<Pages> {
    read_up_to(source, file, 1)
}

/// Checks every page, and reads the first `limit` of them.
fn read_up_to<R: Read + Seek>(source: &Source, file: BufReader<R>, limit: usize) -> Result<Pages> {
    let mut pages = decoder(source, file)?;
    let first = kind(source, &mut pages)?;
    let promised = images_of_image_j(&mut pages);
    let images = images_of_ome(source, &mut pages);
    let planes = planes_of_frame(&mut pages);
    let mut count = 1;
    while pages.more_images() {
        pages.next_image().map_err(|e| fault_of(source, e))?;
        check_alike(source, kind(source, &mut pages)?, first, count)?;
        count += 1;
    }
    check_count(source, count, promised)?;
    check_images(source, count, images)?;
    check_planes(source, count, planes)?;
    let (rows, columns, _) = first;
    let read = count.min(limit);
    let mut data = source.reserve_pixels(read, rows, columns)?;
    let mut format = SampleFormat::Float;
    for page in 0..read {
        format = read_page(source, &mut pages, page, &mut data)?;
    }
    Ok(Pages {
        count,
        rows,
        columns,
        data,
        format,
    })
}

/// What the first page says beside its pixels.
#[derive(Debug, Default)]
pub(crate) struct Tags {
    pub description: Option<String>,
    /// Micro-Manager's record of the image, JSON.
    pub micro_manager: Option<String>,
    pub andor_exposure_s: Option<f64>,
    pub andor_cycle_s: Option<f64>,
}

/// Reads the tags of the first page; one that is damaged is left out.
pub(crate) fn tags<R: Read + Seek>(source: &Source, file: BufReader<R>) -> Result<Tags> {
    let mut pages = decoder(source, file)?;
    let mut value = |tag| pages.find_tag(Tag::from_u16_exhaustive(tag)).ok().flatten();
    let text = |value: Value| match value {
        Value::Ascii(text) => Some(text),
        other => {
            let bytes = other.into_u8_vec().ok()?;
            let text = String::from_utf8_lossy(&bytes).into_owned();
            Some(text.trim_end_matches('\0').to_string())
        }
    };
    let number = |value: Value| match value {
        Value::Float(number) => Some(f64::from(number)),
        other => other.into_f64().ok(),
    };
    Ok(Tags {
        description: value(270).and_then(text),
        micro_manager: value(51123).and_then(text),
        andor_exposure_s: value(4876).and_then(number),
        andor_cycle_s: value(4878).and_then(number),
    })
}

/// A stack that is read page by page.
pub(crate) struct Stack {
    pages: Decoder<BufReader<File>>,
    count: usize,
}

impl Stack {
    /// Counts the pages, which may differ in size and kind.
    pub fn open(source: &Source, file: BufReader<File>) -> Result<Self> {
        let mut pages = decoder(source, file)?;
        let promised = images_of_image_j(&mut pages);
        let images = images_of_ome(source, &mut pages);
        let planes = planes_of_frame(&mut pages);
        let mut count = 1;
        while pages.more_images() {
            pages.next_image().map_err(|e| fault_of(source, e))?;
            count += 1;
        }
        check_count(source, count, promised)?;
        check_images(source, count, images)?;
        check_planes(source, count, planes)?;
        Ok(Self { pages, count })
    }
}

impl crate::pages::Stack for Stack {
    fn count(&self) -> usize {
        self.count
    }

    fn name(&self, at: usize) -> String {
        format!("page {}", at + 1)
    }

    fn page(&mut self, source: &Source, page: usize) -> Result<Pages> {
        let seek = self.pages.seek_to_image(page);
        seek.map_err(|e| fault_of(source, e))?;
        let (rows, columns, _) = kind(source, &mut self.pages)?;
        let mut data = source.reserve_pixels(1, rows, columns)?;
        let format = read_page(source, &mut self.pages, page, &mut data)?;
        Ok(Pages {
            count: 1,
            rows,
            columns,
            data,
            format,
        })
    }

    fn integers(&mut self, source: &Source, page: usize) -> Result<IntegerFrame> {
        let seek = self.pages.seek_to_image(page);
        seek.map_err(|e| fault_of(source, e))?;
        let (rows, columns, kind) = kind(source, &mut self.pages)?;
        let wide = if matches!(kind, ColorType::Gray(32 | 64)) {
            drop(source.reserve_pixels(1, rows, columns)?);
            let samples = self.pages.read_image();
            wide_integers(samples.map_err(|e| fault_of(source, e))?)
        } else {
            None
        };
        let Some((data, bits)) = wide else {
            let page = self.page(source, page)?;
            return Ok(IntegerFrame::of_pages(&page));
        };
        if data.len() != rows * columns {
            return Err(source.unreadable("a page has not as many pixels as its size says"));
        }
        Ok(IntegerFrame {
            rows,
            columns,
            data,
            format: SampleFormat::Counts { bits },
        })
    }
}

/// Integers of 32 or 64 bits and how many bits the largest takes; `None`: numbers of another kind.
fn wide_integers(samples: DecodingResult) -> Option<(Vec<i64>, u32)> {
    match samples {
        DecodingResult::U32(s) => Some((s.into_iter().map(i64::from).collect(), 32)),
        DecodingResult::I32(s) => Some((s.into_iter().map(i64::from).collect(), 31)),
        DecodingResult::U64(s) => Some((s.into_iter().map(|v| v as i64).collect(), 64)),
        DecodingResult::I64(s) => Some((s, 63)),
        _ => None,
    }
}

/// How many images ImageJ says that it wrote: beyond 4 GB it has no page for those after the first.
fn images_of_image_j<R: Read + Seek>(pages: &mut Decoder<R>) -> Option<usize> {
    let text = pages.get_tag_ascii_string(Tag::ImageDescription).ok()?;
    let mut lines = text.strip_prefix("ImageJ=")?.lines();
    lines.find_map(|line| line.strip_prefix("images=")?.trim().parse().ok())
}

fn check_count(source: &Source, count: usize, promised: Option<usize>) -> Result<()> {
    match promised {
        Some(promised) if count == 1 && promised > 1 => Err(source.error(
            format!("one page, where ImageJ wrote {promised} images"),
            "every image has a page: ImageJ leaves them out beyond 4 GB",
            "Save it as BigTIFF or OME-TIFF (Bio-Formats), or as .npy from Python.",
        )),
        _ => Ok(()),
    }
}

/// The images that OME-XML puts into this file.
fn images_of_ome<R: Read + Seek>(source: &Source, pages: &mut Decoder<R>) -> Option<OmeImages> {
    let text = pages.get_tag_ascii_string(Tag::ImageDescription).ok()?;
    let file = ArrayPath::of(source.path).file;
    ome_images(&text, &file.file_name()?.to_string_lossy())
}

/// Refuses the pages of several images: positions or other scenes, which OME calls images and other programs series.
fn check_images(source: &Source, count: usize, images: Option<OmeImages>) -> Result<()> {
    match images {
        Some(images) if images.count > 1 && images.planes.is_none_or(|planes| count > planes) => {
            Err(source.error(
                format!("an OME-TIFF of {} images (series)", images.count),
                "the pages of a stack are the frames of one image",
                "Save the image that you mean as a file of its own (in Fiji: open one series by Bio-Formats, and save it).",
            ))
        }
        _ => Ok(()),
    }
}

/// Channels and planes in depth of the frames, as ImageJ or OME-XML says. Channels alone and depth alone are taken for
/// time: programs that know no time call it so.
fn planes_of_frame<R: Read + Seek>(pages: &mut Decoder<R>) -> Option<(usize, usize)> {
    if !matches!(pages.colortype().ok()?, ColorType::Gray(_)) {
        // A page holds all channels.
        return None;
    }
    let text = pages.get_tag_ascii_string(Tag::ImageDescription).ok()?;
    let (channels, depths, frames) = match text.strip_prefix("ImageJ=") {
        Some(text) => {
            let size = |name: &str| {
                let mut lines = text.lines();
                lines.find_map(|line| line.strip_prefix(name)?.trim().parse().ok())
            };
            (size("channels="), size("slices="), size("frames="))
        }
        None => ome_sizes(&text)?,
    };
    let [channels, depths, frames] = [channels, depths, frames].map(|size| size.unwrap_or(1));
    let axes = [channels, depths, frames].map(|size| usize::from(size > 1));
    Some(if axes.iter().sum::<usize>() > 1 {
        (channels, depths)
    } else {
        (1, 1)
    })
}

/// Refuses pages of other channels or depths between those of one frame and the next.
fn check_planes(source: &Source, count: usize, planes: Option<(usize, usize)>) -> Result<()> {
    match planes {
        Some((channels, depths)) if count > 1 && (channels > 1 || depths > 1) => Err(source.error(
            format!("a stack of {channels} channels and {depths} planes in depth"),
            "the pages of a recording are frames of one channel and one depth, one after the other",
            "Save the channel as a file of its own (in Fiji: Image > Color > Split Channels).",
        )),
        _ => Ok(()),
    }
}

fn fault_of(source: &Source, error: TiffError) -> Error {
    match error {
        TiffError::UnsupportedError(kind) => source.unsupported(format!("that TIFF calls {kind}")),
        error => source.unreadable(error),
    }
}

fn decoder<R: Read + Seek>(source: &Source, file: R) -> Result<Decoder<R>> {
    let most = usize::try_from(source.bytes.saturating_mul(4096)).unwrap_or(usize::MAX);
    let mut limits = Limits::default();
    limits.decoding_buffer_size = limits.decoding_buffer_size.max(most);
    limits.intermediate_buffer_size = limits.intermediate_buffer_size.max(most);
    limits.ifd_value_size = most.min(1 << 28);
    let decoder = Decoder::new(file).map_err(|e| fault_of(source, e))?;
    Ok(decoder.with_limits(limits))
}

/// Rows, columns and kind of the page at hand.
type Kind = (usize, usize, ColorType);

fn kind<R: Read + Seek>(source: &Source, pages: &mut Decoder<R>) -> Result<Kind> {
    let (width, height) = pages.dimensions().map_err(|e| fault_of(source, e))?;
    let kind = pages.colortype().map_err(|e| fault_of(source, e))?;
    Ok((height as usize, width as usize, kind))
}

fn check_alike(source: &Source, page: Kind, first: Kind, before: usize) -> Result<()> {
    if page == first {
        return Ok(());
    }
    Err(source.error(
        format!(
            "page {} of {}×{} pixels after pages of {}×{}",
            before + 1,
            page.0,
            page.1,
            first.0,
            first.1
        ),
        "the pages of a stack have one size and one kind of pixel",
        "Save the pages that belong together as one stack.",
    ))
}

/// Appends the pixels of a page.
fn read_page<R: Read + Seek>(
    source: &Source,
    pages: &mut Decoder<R>,
    page: usize,
    data: &mut Vec<f32>,
) -> Result<SampleFormat> {
    let seek = pages.seek_to_image(page);
    seek.map_err(|e| fault_of(source, e))?;
    let (rows, columns, kind) = kind(source, pages)?;
    let channels = match kind {
        ColorType::Gray(8 | 16 | 32 | 64) => 1,
        ColorType::GrayA(8 | 16) => 2,
        ColorType::RGB(8 | 16 | 32) => 3,
        ColorType::RGBA(8 | 16 | 32) => 4,
        other => return Err(source.unsupported(format!("{other:?} in TIFF"))),
    };
    let before = data.len();
    let samples = pages.read_image().map_err(|e| fault_of(source, e))?;
    let format = push(source, data, samples, channels)?;
    if data.len() - before != rows * columns {
        return Err(source.unsupported("of colour planes one after the other"));
    }
    Ok(format)
}

fn push(
    source: &Source,
    data: &mut Vec<f32>,
    samples: DecodingResult,
    channels: usize,
) -> Result<SampleFormat> {
    macro_rules! push {
        ($samples:expr, $format:expr) => {{
            source.push_grey(data, $samples.into_iter().map(|v| v as f32), channels)?;
            Ok($format)
        }};
    }
    let counts = |bits| SampleFormat::Counts { bits };
    match samples {
        DecodingResult::U8(s) => push!(s, counts(8)),
        DecodingResult::I8(s) => push!(s, counts(7)),
        DecodingResult::U16(s) => push!(s, counts(16)),
        DecodingResult::I16(s) => push!(s, counts(15)),
        DecodingResult::U32(s) => push!(s, counts(32)),
        DecodingResult::I32(s) => push!(s, counts(31)),
        DecodingResult::U64(s) => push!(s, counts(64)),
        DecodingResult::I64(s) => push!(s, counts(63)),
        DecodingResult::F32(s) => push!(s, SampleFormat::Float),
        DecodingResult::F64(s) => push!(s, SampleFormat::Float),
        DecodingResult::F16(_) => Err(source.unsupported("16-bit floating point")),
    }
}

/// The line of the description with the time of the first page. ImageJ has no origin of time: it counts from 0, and
/// programs that read the description have this line.
const FIRST_TIME: &str = "time_of_first_frame";

/// The axes of a stack, for ImageJ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TiffScale {
    /// Seconds from one page to the next.
    pub frame_interval_s: f64,
    /// Seconds of the middle of the first page.
    pub first_s: f64,
    /// Pitch of a pixel in micrometres, where it is known.
    pub pixel_pitch_um: Option<f64>,
}

/// Writes an image as one float32 page.
///
/// # Errors
/// A failed write.
pub fn write_tiff_image(w: &mut (impl Write + Seek), image: &Image) -> Result<()> {
    let page = Page {
        rows: image.rows(),
        columns: image.columns(),
        description: String::new(),
        pitch_um: None,
    };
    write(w, &page, std::iter::once(image.data()), image.data().len())
}

/// Writes a video `[t, y, x]` as a float32 stack that ImageJ opens along its time
/// axis, with the frame interval and the pixel pitch; as BigTIFF from 4 GB.
///
/// # Errors
/// A failed write.
pub fn write_tiff_video(
    w: &mut (impl Write + Seek),
    video: &Video,
    scale: TiffScale,
) -> Result<()> {
    let shape = video.shape();
    let finite = || video.data().iter().copied().filter(|v| v.is_finite());
    let (min, max) = finite().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    let mut description = format!(
        "ImageJ=1.54f\nimages={0}\nframes={0}\nhyperstack=true\nmode=grayscale\nloop=false\n\
         finterval={1}\nfps={2}\ntunit=s\n{FIRST_TIME}={3}\n",
        shape.bins,
        scale.frame_interval_s,
        1.0 / scale.frame_interval_s,
        scale.first_s,
    );
    if scale.pixel_pitch_um.is_some() {
        description += "unit=micron\n";
    }
    if min <= max {
        description += &format!("min={min}\nmax={max}\n");
    }
    let page = Page {
        rows: shape.rows,
        columns: shape.columns,
        description,
        pitch_um: scale.pixel_pitch_um,
    };
    let bins = (0..shape.bins).map(|t| video.bin(t));
    write(w, &page, bins, shape.voxels())
}

/// Writes red, green and blue videos of one `shape` as a float32 hyperstack of three channels,
/// which ImageJ opens as one picture in colour along its time axis.
///
/// # Errors
/// A failed write.
///
/// # Panics
/// If a colour has not a value for each voxel.
pub fn write_tiff_colour(
    w: &mut (impl Write + Seek),
    shape: Shape,
    colours: &[Vec<f32>; 3],
    scale: TiffScale,
) -> Result<()> {
    let most = colours.iter().flatten().copied().fold(0.0, f32::max);
    let mut description = format!(
        "ImageJ=1.54f\nimages={}\nchannels=3\nframes={}\nhyperstack=true\nmode=composite\nloop=false\n\
         finterval={}\nfps={}\ntunit=s\n{FIRST_TIME}={}\nmin=0\nmax={most}\n",
        3 * shape.bins,
        shape.bins,
        scale.frame_interval_s,
        1.0 / scale.frame_interval_s,
        scale.first_s,
    );
    if scale.pixel_pitch_um.is_some() {
        description += "unit=micron\n";
    }
    let page = Page {
        rows: shape.rows,
        columns: shape.columns,
        description,
        pitch_um: scale.pixel_pitch_um,
    };
    let pixels = shape.pixels();
    let pages = (0..shape.bins).flat_map(|t| {
        let bin = t * pixels..(t + 1) * pixels;
        colours.iter().map(move |colour| &colour[bin.clone()])
    });
    write(w, &page, pages, 3 * shape.voxels())
}

struct Page {
    rows: usize,
    columns: usize,
    /// ImageJ's keys, in the first page.
    description: String,
    pitch_um: Option<f64>,
}

fn write<'a>(
    w: &mut (impl Write + Seek),
    page: &Page,
    pages: impl Iterator<Item = &'a [f32]>,
    voxels: usize,
) -> Result<()> {
    let written = if (voxels as u64) * 4 < CLASSIC_BYTES {
        TiffEncoder::new(w).and_then(|encoder| write_pages(encoder, page, pages))
    } else {
        TiffEncoder::new_big(w).and_then(|encoder| write_pages(encoder, page, pages))
    };
    written.map_err(|error| match error {
        TiffError::IoError(error) => fault::write_error(&error),
        error => Error::work(
            Subject::named("writing TIFF"),
            error,
            "Write it as .npy instead.",
        )
        .with_kind(ErrorKind::Io),
    })
}

fn write_pages<'a, W: Write + Seek, K: TiffKind>(
    mut encoder: TiffEncoder<W, K>,
    page: &Page,
    pages: impl Iterator<Item = &'a [f32]>,
) -> tiff::TiffResult<()> {
    let (width, height) = (u32::try_from(page.columns)?, u32::try_from(page.rows)?);
    for (index, data) in pages.enumerate() {
        let mut image = encoder.new_image::<Gray32Float>(width, height)?;
        image.rows_per_strip(height)?;
        if index == 0 && !page.description.is_empty() {
            let description = page.description.as_str();
            image
                .encoder()
                .write_tag(Tag::ImageDescription, description)?;
        }
        if let Some(pitch) = page.pitch_um {
            let pixels_per_micron = rational(1.0 / pitch);
            image.x_resolution(pixels_per_micron.clone());
            image.y_resolution(pixels_per_micron);
        }
        image.write_data(data)?;
    }
    Ok(())
}

/// A positive number as a fraction of 32-bit integers.
fn rational(value: f64) -> Rational {
    let scale = 1e9 / value.max(1.0);
    Rational {
        n: (value * scale).round() as u32,
        d: scale.round() as u32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read::{read_colour_image, read_image, read_stack, read_video};
    use std::io::Cursor;
    use std::path::PathBuf;
    use tiff::encoder::colortype::{self, ColorType};
    use tiff::encoder::{Compression, DeflateLevel, TiffKindStandard, TiffValue};

    const SCALE: TiffScale = TiffScale {
        frame_interval_s: 9.6e-6,
        first_s: 4.8e-6,
        pixel_pitch_um: Some(6.5),
    };

    fn page<C: ColorType>(
        encoder: &mut TiffEncoder<&mut Cursor<Vec<u8>>, TiffKindStandard>,
        size: (u32, u32),
        pixels: &[C::Inner],
    ) where
        [C::Inner]: TiffValue,
    {
        encoder.write_image::<C>(size.0, size.1, pixels).unwrap();
    }

    fn saved(bytes: &[u8]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("image.tif");
        std::fs::write(&path, bytes).unwrap();
        (folder, path)
    }

    macro_rules! tif {
        ($($kind:ty, $size:expr, $pixels:expr);+) => {{
            let mut bytes = Cursor::new(Vec::new());
            let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
            $(page::<$kind>(&mut encoder, $size, $pixels);)+
            saved(bytes.get_ref())
        }};
    }

    #[test]
    fn every_kind_of_pixel_is_read() {
        let counts = |bits| SampleFormat::Counts { bits };
        macro_rules! case {
            ($kind:ty, $format:expr) => {
                let (_folder, path) =
                    tif!($kind, (3, 2), &[0, 1, 2, 3, 100, 127].map(|v: u8| v as _));
                let read = read_image(&path).unwrap();
                assert_eq!(read.image.data(), [0., 1., 2., 3., 100., 127.]);
                assert_eq!((read.image.rows(), read.format), (2, $format));
            };
        }
        case!(colortype::Gray8, counts(8));
        case!(colortype::Gray16, counts(16));
        case!(colortype::GrayI16, counts(15));
        case!(colortype::Gray32, counts(32));
        case!(colortype::Gray32Float, SampleFormat::Float);
        case!(colortype::Gray64Float, SampleFormat::Float);
    }

    #[test]
    fn integers_keep_their_digits() {
        let (_folder, path) = tif!(colortype::Gray32, (2, 1), &[16_777_217, u32::MAX]);
        let frame = crate::open_recording(&path)
            .unwrap()
            .read_integers(0)
            .unwrap();
        assert_eq!(frame.data, [16_777_217, 4_294_967_295]);
        assert!(frame.format.exceeds_f32());
        let (_folder, path) = tif!(colortype::Gray16, (2, 1), &[7, u16::MAX]);
        let frame = crate::open_recording(&path)
            .unwrap()
            .read_integers(0)
            .unwrap();
        assert_eq!(frame.data, [7, 65_535]);
    }

    #[test]
    fn colour_is_read_when_it_is_grey_or_asked_for() {
        let (_folder, path) = tif!(colortype::RGB8, (2, 1), &[7, 7, 7, 9, 9, 9]);
        assert_eq!(read_image(&path).unwrap().image.data(), [7., 9.]);
        let (_folder, path) = tif!(colortype::RGB8, (2, 1), &[7, 7, 7, 9, 0, 0]);
        let message = read_image(&path).unwrap_err().to_string();
        assert!(message.contains("red 9, green 0, blue 0"), "{message}");
        assert_eq!(read_colour_image(&path).unwrap().image.data(), [7., 3.]);
    }

    #[test]
    fn a_video_comes_back_with_its_axes() {
        let video = Video::new(
            Shape::new(4, 3, 5),
            (0..60).map(|v| v as f32 - 1.5).collect(),
        );
        let video = video.unwrap();
        let mut bytes = Cursor::new(Vec::new());
        write_tiff_video(&mut bytes, &video, SCALE).unwrap();
        let (_folder, path) = saved(bytes.get_ref());
        assert_eq!(read_video(&path).unwrap(), video);
        assert_eq!(read_stack(&path).unwrap().len(), 4);
        let message = read_image(&path).unwrap_err().to_string();
        assert!(message.contains("a stack of 4 pages"), "{message}");

        bytes.rewind().unwrap();
        let mut decoder = Decoder::new(bytes).unwrap();
        let text = decoder.get_tag_ascii_string(Tag::ImageDescription).unwrap();
        for part in [
            "frames=4\n",
            "hyperstack=true\n",
            "finterval=0.0000096\n",
            "time_of_first_frame=0.0000048\n",
            "unit=micron\n",
            "min=-1.5\nmax=57.5\n",
        ] {
            assert!(text.contains(part), "{text} lacks {part}");
        }
    }

    #[test]
    fn an_image_comes_back() {
        let image = Image::from_fn(7, 3, |y, x| y as f32 / (1 + x) as f32);
        let mut bytes = Cursor::new(Vec::new());
        write_tiff_image(&mut bytes, &image).unwrap();
        let (_folder, path) = saved(bytes.get_ref());
        assert_eq!(read_image(&path).unwrap().image, image);
    }

    #[test]
    fn big_and_compressed_files_are_read() {
        let pixels: Vec<u16> = (0..600).collect();
        let mut bytes = Cursor::new(Vec::new());
        let encoder = TiffEncoder::new_big(&mut bytes).unwrap();
        let mut encoder = encoder.with_compression(Compression::Deflate(DeflateLevel::Best));
        encoder
            .write_image::<colortype::Gray16>(30, 20, &pixels)
            .unwrap();
        let (_folder, path) = saved(bytes.get_ref());
        assert_eq!(read_image(&path).unwrap().image.at(1, 0), 30.0);
    }

    #[test]
    fn images_without_a_page_are_told() {
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
        let mut image = encoder.new_image::<colortype::Gray8>(2, 1).unwrap();
        let text = "ImageJ=1.54f\nimages=9\nframes=9\n";
        image
            .encoder()
            .write_tag(Tag::ImageDescription, text)
            .unwrap();
        image.write_data(&[1, 2]).unwrap();
        let (_folder, path) = saved(bytes.get_ref());
        for error in [
            read_image(&path).unwrap_err(),
            crate::open_recording(&path).err().unwrap(),
        ] {
            let message = error.to_string();
            assert!(message.contains("ImageJ wrote 9 images"), "{message}");
        }
    }

    /// A stack of four grey pages with the text `description`.
    fn described(description: &str) -> (tempfile::TempDir, std::path::PathBuf) {
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
        for page in 0..4u8 {
            let mut image = encoder.new_image::<colortype::Gray8>(2, 1).unwrap();
            if page == 0 {
                let tag = Tag::ImageDescription;
                image.encoder().write_tag(tag, description).unwrap();
            }
            image.write_data(&[page, page]).unwrap();
        }
        saved(bytes.get_ref())
    }

    #[test]
    fn channels_are_not_taken_for_frames() {
        let ome = |c: usize, z: usize, t: usize| {
            format!(
                "<?xml version=\"1.0\"?><OME><Image><Pixels SizeX=\"2\" SizeY=\"1\" SizeC=\"{c}\" \
                 SizeZ=\"{z}\" SizeT=\"{t}\" Type=\"uint8\"/></Image></OME>"
            )
        };
        let image_j = "ImageJ=1.54f\nimages=4\nchannels=2\nframes=2\nhyperstack=true\n";
        for text in [ome(2, 1, 2), ome(1, 2, 2), image_j.into()] {
            let (_folder, path) = described(&text);
            for error in [
                read_video(&path).unwrap_err(),
                crate::open_recording(&path).err().unwrap(),
            ] {
                assert!(error.to_string().contains("channels and"), "{error}");
            }
        }
        for text in [
            ome(1, 1, 4),
            ome(1, 4, 1),
            "ImageJ=1.54f\nslices=4\n".into(),
        ] {
            let (_folder, path) = described(&text);
            assert_eq!(read_video(&path).unwrap().shape().bins, 4);
        }
    }

    #[test]
    fn images_are_not_joined() {
        let image = |frames: usize, file: &str| {
            let data = match file {
                "" => String::new(),
                file => {
                    format!(
                        "<TiffData IFD=\"0\"><UUID FileName=\"{file}\">urn:uuid:1</UUID></TiffData>"
                    )
                }
            };
            format!(
                "<Image><Pixels SizeX=\"2\" SizeY=\"1\" SizeC=\"1\" SizeZ=\"1\" SizeT=\"{frames}\" \
                 Type=\"uint8\"><Channel/>{data}</Pixels></Image>"
            )
        };
        let ome =
            |images: [String; 2]| format!("<?xml version=\"1.0\"?><OME>{}</OME>", images.concat());
        let files = ome([image(2, "image.tif"), image(2, "image.tif")]);
        for text in [ome([image(2, ""), image(2, "")]), files] {
            let (_folder, path) = described(&text);
            for error in [
                read_video(&path).unwrap_err(),
                crate::open_recording(&path).err().unwrap(),
            ] {
                assert!(error.to_string().contains("2 images (series)"), "{error}");
            }
        }
        // The other position is in a file of its own, whatever this one is called by now.
        for [own, other] in [["image.tif", "other.tif"], ["old.tif", "older.tif"]] {
            let (_folder, path) = described(&ome([image(4, own), image(4, other)]));
            assert_eq!(read_video(&path).unwrap().shape().bins, 4);
        }
    }

    #[test]
    fn bad_files_say_what_is_wrong() {
        let (_folder, path) =
            tif!(colortype::Gray8, (2, 1), &[1, 2]; colortype::Gray8, (1, 2), &[1, 2]);
        let message = read_video(&path).unwrap_err().to_string();
        assert!(
            message.contains("page 2 of 2×1 pixels after pages of 1×2"),
            "{message}"
        );

        let (_folder, path) = tif!(colortype::CMYK8, (1, 1), &[1, 2, 3, 4]);
        let message = read_image(&path).unwrap_err().to_string();
        assert!(message.contains("CMYK"), "{message}");

        let (_folder, path) = tif!(colortype::Gray16, (4, 4), &[5; 16]);
        let whole = std::fs::read(&path).unwrap();
        for length in 0..whole.len() {
            std::fs::write(&path, &whole[..length]).unwrap();
            let message = read_image(&path).unwrap_err().to_string();
            assert!(message.contains("image.tif: found"), "{message}");
        }
        // A million times a million pixels, claimed by the tags for width, height and rows of a strip.
        let mut claims = whole;
        for tag in [[0, 1, 4, 0], [1, 1, 4, 0], [0x16, 1, 4, 0]] {
            let at = claims.windows(4).position(|w| w == tag).unwrap();
            claims[at + 8..at + 12].copy_from_slice(&1_000_000u32.to_le_bytes());
        }
        std::fs::write(&path, claims).unwrap();
        let message = read_image(&path).unwrap_err().to_string();
        assert!(message.contains("1 pages of 1000000×1000000"), "{message}");
    }
}
