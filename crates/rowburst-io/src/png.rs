//! PNG: grey images of 8 and 16 bits.

use crate::fault;
use crate::pages::{Pages, SampleFormat};
use crate::source::Source;
use png::{BitDepth, ColorType, Decoder, Encoder, EncodingError, Limits, Transformations};
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Result};
use std::io::{BufRead, Seek, Write};

/// Reads one image; grey below 8 bits is stretched to 8.
pub(crate) fn read(source: &Source, file: impl BufRead + Seek) -> Result<Pages> {
    let fault = |error| source.unreadable(error);
    let mut decoder = Decoder::new(file);
    decoder.set_transformations(Transformations::EXPAND);
    decoder.set_limits(Limits { bytes: usize::MAX });
    let (width, height) = decoder.read_header_info().map_err(fault)?.size();
    let (rows, columns) = (height as usize, width as usize);
    let mut data = source.reserve_pixels(1, rows, columns)?;
    let mut reader = decoder.read_info().map_err(fault)?;
    let (colour, depth) = reader.output_color_type();
    let mut row_after_row = || -> Result<SampleFormat> {
        let mut format = SampleFormat::Counts { bits: 8 };
        let channels = colour.samples();
        let length = reader.output_buffer_size();
        let length = length.ok_or_else(|| source.unreadable("more pixels than memory"))?;
        let mut bytes = vec![0; length];
        reader.next_frame(&mut bytes).map_err(fault)?;
        if depth == BitDepth::Sixteen {
            format = SampleFormat::Counts { bits: 16 };
            let samples = bytes.as_chunks().0.iter();
            let samples = samples.map(|&s| f32::from(u16::from_be_bytes(s)));
            source.push_grey(&mut data, samples, channels)?;
        } else {
            source.push_grey(&mut data, bytes.into_iter().map(f32::from), channels)?;
        }
        Ok(format)
    };
    let format = row_after_row()?;
    Ok(Pages {
        count: 1,
        rows,
        columns,
        data,
        format,
    })
}

/// Writes 8-bit grey pixels, row after row.
///
/// # Errors
/// A failed write.
///
/// # Panics
/// If `data` does not have `rows · columns` pixels.
pub fn write_png8(w: &mut impl Write, rows: usize, columns: usize, data: &[u8]) -> Result<()> {
    write(w, rows, columns, BitDepth::Eight, data)
}

/// Writes 16-bit grey pixels, row after row.
///
/// # Errors
/// A failed write.
///
/// # Panics
/// If `data` does not have `rows · columns` pixels.
pub fn write_png16(w: &mut impl Write, rows: usize, columns: usize, data: &[u16]) -> Result<()> {
    let bytes: Vec<u8> = data.iter().flat_map(|v| v.to_be_bytes()).collect();
    write(w, rows, columns, BitDepth::Sixteen, &bytes)
}

fn write(
    w: &mut impl Write,
    rows: usize,
    columns: usize,
    depth: BitDepth,
    bytes: &[u8],
) -> Result<()> {
    let size = if depth == BitDepth::Sixteen { 2 } else { 1 };
    assert_eq!(
        bytes.len(),
        rows * columns * size,
        "{rows}×{columns} pixels"
    );
    let write = || -> std::result::Result<(), EncodingError> {
        let mut encoder = Encoder::new(w, columns as u32, rows as u32);
        encoder.set_color(ColorType::Grayscale);
        encoder.set_depth(depth);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(bytes)?;
        writer.finish()
    };
    write().map_err(|error| match error {
        EncodingError::IoError(error) => fault::write_error(&error),
        error => Error::work(
            Subject::named("writing PNG"),
            error,
            "Write it as .npy instead.",
        )
        .with_kind(ErrorKind::Io),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read::{read_colour_image, read_image};

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let mut bytes = Vec::new();
        write_png8(&mut bytes, 2, 3, &[0, 1, 2, 3, 4, 255]).unwrap();
        std::fs::write(&path, bytes).unwrap();
        let read = read_image(&path).unwrap();
        assert_eq!(read.image.data(), [0., 1., 2., 3., 4., 255.]);
        assert_eq!(
            (read.image.rows(), read.format),
            (2, SampleFormat::Counts { bits: 8 })
        );

        let mut bytes = Vec::new();
        write_png16(&mut bytes, 3, 1, &[0, 258, 65535]).unwrap();
        std::fs::write(&path, bytes).unwrap();
        let read = read_image(&path).unwrap();
        assert_eq!(read.image.data(), [0., 258., 65535.]);
        assert_eq!(
            (read.image.rows(), read.format),
            (3, SampleFormat::Counts { bits: 16 })
        );
    }

    #[test]
    fn bad_files_say_what_is_wrong() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let mut whole = Vec::new();
        write_png8(&mut whole, 4, 4, &[9; 16]).unwrap();
        // The last 12 bytes are the mark of the end, which the pixels do not need.
        for length in 0..whole.len() - 12 {
            std::fs::write(&path, &whole[..length]).unwrap();
            let message = read_image(&path).unwrap_err().to_string();
            assert!(message.contains("a.png: found"), "{message}");
        }
        let mut header = Vec::new();
        Encoder::new(&mut header, 1_000_000, 1_000_000)
            .write_header()
            .unwrap();
        std::fs::write(&path, header).unwrap();
        let message = read_image(&path).unwrap_err().to_string();
        assert!(message.contains("1000000×1000000"), "{message}");
    }

    #[test]
    fn colours_of_a_real_camera_are_averaged_where_asked_for() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let path = path.join("../../../shared/data/led-rolling-shutter/frame_example.png");
        if !path.exists() {
            eprintln!("skipped: no {}", path.display());
            return;
        }
        let message = read_image(&path).unwrap_err().to_string();
        assert!(message.contains("an image in colour"), "{message}");
        let image = read_colour_image(&path).unwrap().image;
        assert_eq!((image.rows(), image.columns()), (1080, 1920));
        let sum: f64 = image.data().iter().map(|&v| f64::from(v)).sum();
        let mean = sum / image.data().len() as f64;
        assert!((mean - 79.96).abs() < 0.01, "{mean}");
    }
}
