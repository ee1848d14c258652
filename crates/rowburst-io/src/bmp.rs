//! Windows bitmaps: 8 bits with a palette of greys, or 24 and 32 bits of grey colours. Smaller palettes, runs (RLE) and
//! 16 bits of colour are read, too; masks of colours are those of 5-5-5, 5-6-5 and 8-8-8 bits.

use crate::pages::{Pages, SampleFormat};
use crate::source::Source;
use embedded_graphics_core::pixelcolor::{Rgb888, RgbColor};
use rowburst::Result;
use std::io::{self, BufRead, ErrorKind, Seek};
use tinybmp::{Bmp, ParseError};

/// Reads one image of 8-bit counts.
pub(crate) fn read(source: &Source, mut file: impl BufRead + Seek) -> Result<Pages> {
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)
        .map_err(|e| source.unreadable(e))?;
    let bitmap = Bmp::<Rgb888>::from_slice(&bytes).map_err(|e| match e {
        ParseError::UnexpectedEndOfFile => {
            source.unreadable(io::Error::new(ErrorKind::UnexpectedEof, END))
        }
        other => source.unreadable(format_args!("{other:?}")),
    })?;
    let size = bitmap.as_raw().header().image_size;
    let (rows, columns) = (size.height as usize, size.width as usize);
    let mut data = source.reserve_pixels(1, rows, columns)?;
    // Pixels come by rows from the top or from the bottom.
    let mut samples = vec![0; 3 * rows * columns];
    for pixel in bitmap.pixels() {
        let (y, x) = (pixel.0.y as usize, pixel.0.x as usize);
        let at = 3 * (y * columns + x);
        samples[at..at + 3].copy_from_slice(&[pixel.1.r(), pixel.1.g(), pixel.1.b()]);
    }
    source.push_grey(&mut data, samples.into_iter().map(f32::from), 3)?;
    Ok(Pages {
        count: 1,
        rows,
        columns,
        data,
        format: SampleFormat::Counts { bits: 8 },
    })
}

/// The words of the standard library for the end of a file.
const END: &str = "failed to fill whole buffer";

#[cfg(test)]
mod tests {
    use crate::pages::SampleFormat;
    use crate::read::read_image;
    use std::path::Path;

    /// 24-bit pixels (blue, green, red), the bottom row first, rows padded to 4 bytes.
    fn bitmap(width: u32, height: u32, pixels: &[u8]) -> Vec<u8> {
        let mut bytes = b"BM".to_vec();
        for field in [54 + pixels.len() as u32, 0, 54, 40, width, height] {
            bytes.extend(field.to_le_bytes());
        }
        bytes.extend([1, 0, 24, 0]);
        bytes.extend([0; 24]);
        bytes.extend(pixels);
        bytes
    }

    #[test]
    fn grey_colours_are_read_from_the_top() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bmp");
        let pixels = [3, 3, 3, 0, 8, 8, 8, 0];
        std::fs::write(&path, bitmap(1, 2, &pixels)).unwrap();
        let read = read_image(&path).unwrap();
        assert_eq!(read.image.data(), [8., 3.]);
        assert_eq!(read.format, SampleFormat::Counts { bits: 8 });

        std::fs::write(&path, bitmap(1, 2, &[3, 3, 4, 0, 8, 8, 8, 0])).unwrap();
        assert!(
            read_image(&path)
                .unwrap_err()
                .to_string()
                .contains("in colour")
        );
        let cases = [
            (bitmap(1, 2, &pixels[..2]), "ends too early"),
            (bitmap(60_000, 60_000, &pixels), "ends too early"),
            (b"BM and no more".to_vec(), "a text file"),
        ];
        for (bytes, expected) in cases {
            std::fs::write(&path, bytes).unwrap();
            let message = read_image(&path).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    /// A header for `bits` a pixel with a compression, its palette and the pixels' bytes.
    fn with_palette(size: (u32, u32), bits: u8, compression: u8, palette: &[u8], pixels: &[u8]) -> Vec<u8> {
        let start = 54 + palette.len() as u32;
        let mut bytes = b"BM".to_vec();
        for field in [start + pixels.len() as u32, 0, start, 40, size.0, size.1] {
            bytes.extend(field.to_le_bytes());
        }
        bytes.extend([1, 0, bits, 0, compression, 0, 0, 0]);
        bytes.extend((pixels.len() as u32).to_le_bytes());
        bytes.extend([0; 16]);
        bytes.extend(palette);
        bytes.extend(pixels);
        bytes
    }

    #[test]
    fn palettes_runs_and_top_down_rows_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bmp");
        let read = |bytes: Vec<u8>| {
            std::fs::write(&path, bytes).unwrap();
            read_image(&path).unwrap().image.data().to_vec()
        };
        let greys: Vec<u8> = (0..=255).flat_map(|v| [v, v, v, 0]).collect();
        let rows = [1, 2, 3, 0, 4, 5, 6, 0];
        assert_eq!(read(with_palette((3, 2), 8, 0, &greys, &rows)), [4., 5., 6., 1., 2., 3.]);
        // Minus two rows: the first one is the top.
        assert_eq!(read(with_palette((3, 2u32.wrapping_neg()), 8, 0, &greys, &rows)), [1., 2., 3., 4., 5., 6.]);
        // Runs of two 7, one 9; the next row three 4.
        let runs = [2, 7, 1, 9, 0, 0, 3, 4, 0, 1];
        assert_eq!(read(with_palette((3, 2), 8, 1, &greys, &runs)), [4., 4., 4., 7., 7., 9.]);
        // 32 bits: blue, green, red and an unused byte.
        assert_eq!(read(with_palette((1, 1), 32, 0, &[], &[8, 8, 8, 0])), [8.]);
        // One bit: black and white.
        let two = [0, 0, 0, 0, 255, 255, 255, 0];
        assert_eq!(read(with_palette((3, 1), 1, 0, &two, &[0b1010_0000, 0, 0, 0])), [255., 0., 255.]);
    }

    #[test]
    fn damaged_bitmaps_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bmp");
        let greys: Vec<u8> = (0..=255).flat_map(|v| [v, v, v, 0]).collect();
        let whole = with_palette((3, 2), 8, 1, &greys, &[2, 7, 1, 9, 0, 0, 3, 4, 0, 1]);
        for at in 0..54 {
            for value in [0, 1, 0x7f, 0xff] {
                let mut bytes = whole.clone();
                bytes[at] = value;
                std::fs::write(&path, bytes).unwrap();
                // An error or a picture, no panic.
                let _ = read_image(&path);
            }
        }
        for end in [10, 40, 60] {
            std::fs::write(&path, &whole[..end]).unwrap();
            assert!(read_image(&path).is_err(), "{end}");
        }
    }

    #[test]
    fn real_captures_are_read() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"));
        let path = path.join("../../../shared/data/speckle-grits/120.bmp");
        if !path.exists() {
            eprintln!("skipped: no {}", path.display());
            return;
        }
        let image = read_image(&path).unwrap().image;
        assert_eq!((image.rows(), image.columns()), (540, 720));
        assert!(image.max() <= 255.0 && image.max() > 50.0);
    }
}
