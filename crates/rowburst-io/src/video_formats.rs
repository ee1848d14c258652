//! A video for programs that read no `.npy`: MATLAB's `.mat` of version 5 and HDF5.
//!
//! A `.mat` file is a header of 128 bytes and one element `miMATRIX` for each variable. Numbers lie with the first index
//! fastest, so the video is `(rows, columns, frames)`. Source: "MAT-File Format", The MathWorks.

use crate::fault;
use rowburst::{Error, ErrorKind, Parameter, Result, TimeGrid, Video};
use std::io::{self, Write};

const MI_INT8: u32 = 1;
const MI_INT32: u32 = 5;
const MI_UINT32: u32 = 6;
const MI_SINGLE: u32 = 7;
const MI_DOUBLE: u32 = 9;
const MI_MATRIX: u32 = 14;
/// MATLAB's classes of float64 and float32 arrays.
const MX_DOUBLE: u32 = 6;
const MX_SINGLE: u32 = 7;

/// Type and class of a variable's numbers, and the bytes of one.
type Numbers = (u32, u32, u32);
const SINGLE: Numbers = (MI_SINGLE, MX_SINGLE, 4);
const DOUBLE: Numbers = (MI_DOUBLE, MX_DOUBLE, 8);

/// Largest variable of version 5.
const MAX_MAT_BYTES: u64 = (1 << 31) - 1024;

/// Writes the variables `video`, single `(rows, columns, frames)`, `bin_duration_us`, and `time_us`, the middle of each
/// frame from the start of the first exposure.
///
/// # Errors
/// A video of 2 GiB or more, which version 5 cannot hold, and failed writes.
pub fn write_mat_video(w: &mut impl Write, video: &Video, time: &TimeGrid) -> Result<()> {
    let shape = video.shape();
    let bytes = 4 * shape.voxels() as u64;
    if bytes > MAX_MAT_BYTES {
        return Err(Error::input(
            Parameter::Write,
            format!("a video of {bytes} bytes"),
            "a .mat file of version 5 holds variables below 2 GiB",
            "Write h5, which MATLAB reads too.",
        )
        .with_kind(ErrorKind::Unsupported));
    }
    let mut write = || -> io::Result<()> {
        let mut header = [b' '; 128];
        let text = b"MATLAB 5.0 MAT-file, written by Rowburst";
        header[..text.len()].copy_from_slice(text);
        header[116..124].fill(0);
        header[124..].copy_from_slice(&[0, 1, b'I', b'M']);
        w.write_all(&header)?;
        let columns_first = |pixels: &[f32]| -> Vec<u8> {
            let at = |x: usize, y: usize| pixels[y * shape.columns + x];
            let order = (0..shape.columns).flat_map(|x| (0..shape.rows).map(move |y| (x, y)));
            order.flat_map(|(x, y)| at(x, y).to_le_bytes()).collect()
        };
        let frames = video.data().chunks_exact(shape.pixels());
        let size = [shape.rows, shape.columns, shape.bins];
        write_variable(w, ("video", SINGLE), &size, frames.map(columns_first))?;
        let duration = (time.bin_duration_us() as f32).to_le_bytes().to_vec();
        let name = ("bin_duration_us", SINGLE);
        write_variable(w, name, &[1, 1], [duration].into_iter())?;
        let middles = (0..shape.bins).map(|bin| time.middle_us(bin).to_le_bytes().to_vec());
        write_variable(w, ("time_us", DOUBLE), &[1, shape.bins], middles)
    };
    write().map_err(|e| fault::write_error(&e))
}

/// Writes a variable, whose numbers `parts` hold as bytes.
fn write_variable(
    w: &mut impl Write,
    (name, (kind, class, bytes)): (&str, Numbers),
    size: &[usize],
    parts: impl Iterator<Item = Vec<u8>>,
) -> io::Result<()> {
    let data = bytes * size.iter().product::<usize>() as u32;
    let (sides, letters) = (4 * size.len() as u32, name.len() as u32);
    let padded = |bytes: u32| bytes.next_multiple_of(8);
    let pad =
        |w: &mut dyn Write, bytes: u32| w.write_all(&[0; 8][..(padded(bytes) - bytes) as usize]);
    let tag = |w: &mut dyn Write, kind: u32, bytes: u32| {
        w.write_all(&kind.to_le_bytes())?;
        w.write_all(&bytes.to_le_bytes())
    };
    let total = 16 + 8 + padded(sides) + 8 + padded(letters) + 8 + padded(data);
    tag(w, MI_MATRIX, total)?;
    tag(w, MI_UINT32, 8)?;
    w.write_all(&class.to_le_bytes())?;
    w.write_all(&[0; 4])?;
    tag(w, MI_INT32, sides)?;
    for side in size {
        w.write_all(&(*side as i32).to_le_bytes())?;
    }
    pad(w, sides)?;
    tag(w, MI_INT8, letters)?;
    w.write_all(name.as_bytes())?;
    pad(w, letters)?;
    tag(w, kind, data)?;
    for part in parts {
        w.write_all(&part)?;
    }
    pad(w, data)
}

/// Writes the datasets `video`, float32 `[t, y, x]`, `bin_duration_us`, and `time_us`, the middle of each bin from the
/// start of the first exposure, of an HDF5 file.
///
/// # Errors
/// Failed writes, and a program that was built without HDF5.
#[cfg(feature = "hdf5")]
pub fn write_hdf5_video(w: &mut impl Write, video: &Video, time: &TimeGrid) -> Result<()> {
    let shape = video.shape();
    let sides = [shape.bins, shape.rows, shape.columns].map(|n| n as u64);
    let mut file = hdf5_pure::FileBuilder::new();
    file.create_dataset("video")
        .with_f32_data(video.data())
        .with_shape(&sides);
    file.create_dataset("bin_duration_us")
        .with_f64_data(&[time.bin_duration_us()])
        .with_shape(&[1]);
    let middles: Vec<f64> = (0..shape.bins).map(|bin| time.middle_us(bin)).collect();
    file.create_dataset("time_us")
        .with_f64_data(&middles)
        .with_shape(&[shape.bins as u64]);
    let bytes = file.finish().map_err(|error| {
        Error::work(
            rowburst::error::Subject::named("HDF5"),
            error,
            "Write npy instead.",
        )
    })?;
    w.write_all(&bytes).map_err(|e| fault::write_error(&e))
}

/// The error of a program that was built without HDF5.
///
/// # Errors
/// Always.
#[cfg(not(feature = "hdf5"))]
pub fn write_hdf5_video(_: &mut impl Write, _: &Video, _: &TimeGrid) -> Result<()> {
    Err(Error::input(
        Parameter::Write,
        "h5",
        "this program was built without HDF5",
        "Write npy or mat instead.",
    )
    .with_kind(ErrorKind::Unsupported))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read::read_video;
    use rowburst::Shape;

    #[test]
    fn videos_come_back_from_mat_and_hdf5() {
        let shape = Shape::new(3, 4, 5);
        let video = Video::new(shape, (0..60).map(|v| v as f32).collect()).unwrap();
        let time = TimeGrid::rolling(3, 9.6, 1.0, 1);
        let base = tempfile::tempdir().unwrap();
        let mat = base.path().join("v.mat");
        write_mat_video(&mut std::fs::File::create(&mat).unwrap(), &video, &time).unwrap();
        let named = format!("{}:video", mat.display());
        assert_eq!(read_video(named.as_ref()).unwrap(), video);
        assert_eq!(read_video(&mat).unwrap(), video);
        let middles: Vec<f64> = (0..3).map(|bin| time.middle_us(bin)).collect();
        let named = format!("{}:time_us", mat.display());
        let times = crate::read::read_image(named.as_ref()).unwrap().image;
        let expected: Vec<f32> = middles.iter().map(|us| *us as f32).collect();
        assert_eq!(times.data(), expected);
        #[cfg(feature = "hdf5")]
        {
            let h5 = base.path().join("v.h5");
            write_hdf5_video(&mut std::fs::File::create(&h5).unwrap(), &video, &time).unwrap();
            let named = format!("{}:/video", h5.display());
            assert_eq!(read_video(named.as_ref()).unwrap(), video);
            // The video is the only image, so that it needs no name.
            assert_eq!(read_video(&h5).unwrap(), video);
            let file = hdf5_pure::File::open_streaming(&h5).unwrap();
            let times = file.dataset("time_us").unwrap().read_f64().unwrap();
            assert_eq!(times, middles);
        }
    }
}
