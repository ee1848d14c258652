//! Windows bitmaps: 8 bits with a palette of greys, or 24 and 32 bits of grey colours.

use crate::pages::{Pages, SampleFormat};
use crate::source::Source;
use image::codecs::bmp::BmpDecoder;
use image::{ColorType, ImageDecoder};
use rowburst::Result;
use std::io::{BufRead, Seek};

/// Reads one image of 8-bit counts.
pub(crate) fn read(source: &Source, file: impl BufRead + Seek) -> Result<Pages> {
    let decoder = BmpDecoder::new(file).map_err(|e| source.unreadable(e))?;
    let (width, height) = decoder.dimensions();
    let (rows, columns) = (height as usize, width as usize);
    let channels = match decoder.color_type() {
        ColorType::L8 => 1,
        ColorType::Rgb8 => 3,
        ColorType::Rgba8 => 4,
        other => return Err(source.unsupported(format!("{other:?} in BMP"))),
    };
    let mut data = source.reserve_pixels(1, rows, columns)?;
    let mut bytes = vec![0; rows * columns * channels];
    decoder
        .read_image(&mut bytes)
        .map_err(|e| source.unreadable(e))?;
    source.push_grey(&mut data, bytes.into_iter().map(f32::from), channels)?;
    Ok(Pages {
        count: 1,
        rows,
        columns,
        data,
        format: SampleFormat::Counts { bits: 8 },
    })
}

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
            (bitmap(60_000, 60_000, &pixels), "60000×60000"),
            (b"BM and no more".to_vec(), "a text file"),
        ];
        for (bytes, expected) in cases {
            std::fs::write(&path, bytes).unwrap();
            let message = read_image(&path).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
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
