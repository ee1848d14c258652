//! One video as an OME-Zarr image `[t, y, x]`.

use crate::Scratch;
use crate::archive::bins_of_chunk;
use crate::array::{ArrayParams, FloatArray};
use crate::ome::{Axis, write_group};
use rowburst::{Result, TimeGrid, Video};
use rowburst_io::write_error;
use serde_json::json;
use std::fs;
use std::path::Path;
use std::sync::Arc;

/// Writes `video` as the OME-Zarr 0.5 image `path`, float32 `[t, y, x]` with the bins of `time` and,
/// where it is known, pixels of `pixel_pitch_um` on the sensor. The field begins `field_offset` rows and columns before
/// the sensor. What was there is replaced by the whole image or stays.
///
/// # Errors
/// Failed writes.
pub fn write_video(
    path: &Path,
    video: &Video,
    time: &TimeGrid,
    pixel_pitch_um: Option<f64>,
    field_offset: (usize, usize),
) -> Result<()> {
    let fault = |e: std::io::Error| write_error(&e).within(path);
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let place = path.with_file_name(format!(".{name}.part"));
    let scratch = Arc::new(Scratch::open(&place)?);
    let (whole, old) = (scratch.folder().join("new"), scratch.folder().join("old"));
    let shape = video.shape();
    let lengths = [shape.bins as u64, shape.rows as u64, shape.columns as u64];
    let array = FloatArray::create(
        &whole.join("0"),
        &ArrayParams {
            shape: &lengths,
            chunks: &[bins_of_chunk(shape), lengths[1], lengths[2]],
            names: &["t", "y", "x"],
            attributes: json!({}),
        },
        &scratch,
    )?;
    // The last chunk may reach beyond the array.
    let length = array.chunks()[0] as usize * shape.pixels();
    let mut values = vec![f32::NAN; length];
    for (chunk, part) in video.data().chunks(length).enumerate() {
        values[..part.len()].copy_from_slice(part);
        values[part.len()..].fill(f32::NAN);
        array.store_chunk(&[chunk as u64, 0, 0], &values)?;
    }
    let t = Axis {
        name: "t",
        kind: Some("time"),
        unit: Some("microsecond"),
        scale: time.bin_duration_us(),
        origin: time.middle_us(0),
    };
    let y = Axis::space("y", pixel_pitch_um, field_offset.0);
    let x = Axis::space("x", pixel_pitch_um, field_offset.1);
    write_group(&whole, &[t, y, x], &json!({}), &scratch)?;
    if path.exists() {
        fs::rename(path, &old).map_err(fault)?;
    }
    fs::rename(&whole, path).map_err(fault)?;
    drop((array, scratch));
    // Another process may be using it.
    let _ = fs::remove_dir(&place);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::Shape;

    #[test]
    fn an_image_takes_the_place_of_an_older_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("video.ome.zarr");
        for bins in [3, 2] {
            let shape = Shape::new(bins, 4, 5);
            let data: Vec<f32> = (0..shape.voxels()).map(|i| (i * bins) as f32).collect();
            let video = Video::new(shape, data).unwrap();
            let time = TimeGrid::rolling(bins, 9.6, 0.5, 1);
            write_video(&path, &video, &time, Some(6.5), (1, 2)).unwrap();
            let read = crate::open_zarr_recording(&path).unwrap();
            assert_eq!(read.count(), bins);
            let names = fs::read_dir(folder.path()).unwrap();
            assert_eq!(names.count(), 1, "nothing else is left");
            let meta = fs::read_to_string(path.join("zarr.json")).unwrap();
            let meta_value: serde_json::Value = serde_json::from_str(&meta).unwrap();
            let dataset = &meta_value["attributes"]["ome"]["multiscales"][0]["datasets"][0];
            let moved = &dataset["coordinateTransformations"][1]["translation"];
            // The first exposure is the second half of bin 0; the field begins before the sensor.
            assert_eq!(*moved, json!([0.0, -6.5, -13.0]));
            assert!(
                meta.contains("9.6") && meta.contains("micrometer"),
                "{meta}"
            );
        }
    }
}
