//! Reading images, stacks and videos: the format is that of the file's name.

use crate::pages::{Capture, Pages, SampleFormat, all_pages, first_page, single};
use crate::source::{Colour, Format, open};
use crate::stack::open_stack;
use crate::{bmp, npy, png, tiff};
use rowburst::{Image, Result, Shape, Video};
use std::path::Path;

/// Reads one image: `.npy` (2-D), `.tif`, `.png`, `.bmp`, HDF5, MATLAB, FITS or Photron.
///
/// `FILE.h5:/path`, `FILE.mat:name` and `FILE.fits:EXTENSION` name the array that is meant.
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

/// Reads a video `[t, y, x]`: a 3-D array or a multi-page `.tif`; a single image
/// is a video of one bin.
///
/// # Errors
/// Those of [`read_image`], but for several pages.
pub fn read_video(path: &Path) -> Result<Video> {
    read_frames(path).map(|(video, _)| video)
}

/// Like [`read_video`], with the kind of numbers that the file holds.
///
/// # Errors
/// Those of [`read_video`].
pub fn read_frames(path: &Path) -> Result<(Video, SampleFormat)> {
    let pages = read_pages(path, Colour::Refused)?;
    let shape = Shape::new(pages.count, pages.rows, pages.columns);
    let video = Video::new(shape, pages.data).map_err(|e| e.within(path))?;
    Ok((video, pages.format))
}

/// Bins, rows and columns of a video. Of its pages the first one is read at most.
///
/// # Errors
/// Those of [`read_video`] that the header or the first page shows.
pub fn read_video_shape(path: &Path) -> Result<Shape> {
    let first = read_first(path, Colour::Refused)?;
    Ok(Shape::new(first.count, first.rows, first.columns))
}

fn capture(path: &Path, colour: Colour) -> Result<Capture> {
    // A stack is refused by its header, before its pages are read.
    single(path, read_first(path, colour)?)
}

/// The number of pages and their size; data of the first page at most.
fn read_first(path: &Path, colour: Colour) -> Result<Pages> {
    let (source, file, format) = open(path, colour)?;
    match format {
        Format::Npy => npy::read_first(&source, file),
        Format::Tiff => tiff::read_first(&source, file),
        Format::Png => png::read(&source, file),
        Format::Bmp => bmp::read(&source, file),
        format => first_page(&source, &mut *open_stack(&source, file, format)?),
    }
}

fn read_pages(path: &Path, colour: Colour) -> Result<Pages> {
    let (source, file, format) = open(path, colour)?;
    match format {
        Format::Npy => npy::read(&source, file),
        Format::Tiff => tiff::read(&source, file),
        Format::Png => png::read(&source, file),
        Format::Bmp => bmp::read(&source, file),
        format => all_pages(&source, &mut *open_stack(&source, file, format)?),
    }
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
                "the ending .jpg; images, stacks and videos are read as .npy",
            ),
            ("film.mp4", Some(b"x".as_slice()), "ffmpeg"),
            ("none", Some(b"x".as_slice()), "no ending"),
            ("b.tif", Some(png), "the content of a Png file"),
            ("c.PNG", Some(png), "cannot be read"),
            ("d.npy", None, "no such file"),
            ("e.bmp", Some(b"x".as_slice()), "ends too early"),
        ];
        for (name, content, expected) in cases {
            let path = folder.path().join(name);
            if let Some(content) = content {
                std::fs::write(&path, content).unwrap();
            }
            let error = read_image(&path).unwrap_err();
            assert!(error.is_input(), "{error}");
            let message = error.to_string();
            assert!(
                message.contains(name) && message.contains(expected),
                "{message}"
            );
        }
        let message = read_image(folder.path()).unwrap_err().to_string();
        assert!(message.contains("a folder"), "{message}");
    }

    #[test]
    fn a_stack_is_refused_before_its_pages_are_read() {
        let folder = tempfile::tempdir().unwrap();
        // The numbers of the first page alone follow the header.
        let mut npy = npy::header_of("<u2", &[4000, 2, 3]);
        npy.extend([0; 12]);
        let video = Video::new(Shape::new(2, 5, 7), vec![1.0; 70]).unwrap();
        let mut tiff = std::io::Cursor::new(Vec::new());
        let scale = tiff::TiffScale {
            frame_interval_s: 1.0,
            first_s: 0.0,
            pixel_pitch_um: None,
        };
        tiff::write_tiff_video(&mut tiff, &video, scale).unwrap();
        let files = [
            ("a.npy", npy, "a stack of 4000 pages of 2×3"),
            ("a.tif", tiff.into_inner(), "a stack of 2 pages of 5×7"),
        ];
        for (name, bytes, expected) in files {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let error = read_image(&path).unwrap_err();
            assert_eq!(error.kind(), rowburst::ErrorKind::Shape);
            let message = error.to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn the_shape_of_a_video_is_known_before_its_pages_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        // The header alone.
        std::fs::write(&path, npy::header_of("<f4", &[4000, 2, 3])).unwrap();
        assert_eq!(read_video_shape(&path).unwrap(), Shape::new(4000, 2, 3));
        assert!(read_video(&path).is_err());
        for (name, bytes) in samples() {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let video = read_video(&path).unwrap();
            assert_eq!(read_video_shape(&path).unwrap(), video.shape(), "{name}");
        }
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
