//! Videos of many frames as one OME-Zarr image `[frame, t, y, x]`.
//!
//! ```text
//! OUT.zarr/zarr.json            OME-Zarr 0.5: axes, units, scales
//! OUT.zarr/0                    float32 [frame, t, y, x]; frames that failed are NaN
//! OUT.zarr/frame_start_us       float64 [frame], where the frame period is known
//! OUT.zarr/stitched             the same as one time axis: an OME-Zarr image [t, y, x]
//! OUT.zarr/stitched/time_us     float64 [t], middle of each bin
//! OUT.zarr/stitched/frame       float64 [t], the frame a bin comes from; NaN in dead time
//! ```
//!
//! OME-Zarr has one axis of type time, and it comes first: that is `frame`, the clock of the
//! recording. `t`, the time within a frame, has no type but its unit and scale.

use crate::Scratch;
use crate::array::{ArrayParams, FloatArray, write_coordinates};
use crate::ome::{Axis, write_group};
use rowburst::{Result, Shape, Video};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Bytes of a chunk before compression, about: a viewer reads a whole one to show one bin.
const CHUNK_BYTES: usize = 4 << 20;

/// What an archive holds.
#[derive(Debug, Clone, PartialEq)]
pub struct ArchiveParams {
    /// Number of frames.
    pub frames: usize,
    /// Shape of a frame's video.
    pub video: Shape,
    /// Duration of a bin.
    pub bin_us: f64,
    /// Start of a frame's first bin, from the start of exposure of its row that is read first.
    pub first_bin_us: f64,
    /// Pitch of a pixel, where it is known.
    pub pixel_pitch_um: Option<f64>,
    /// Rows and columns by which the field begins before the sensor.
    pub field_offset: (usize, usize),
    /// From the start of a frame to that of the next, where it is known.
    pub frame_period_us: Option<f64>,
    /// Start of each frame, where it is known.
    pub frame_start_us: Option<Vec<f64>>,
    /// What else the group is to say, under `rowburst`.
    pub attributes: Value,
}

impl ArchiveParams {
    /// The axes `y` and `x`.
    fn space(&self) -> [Axis; 2] {
        let (rows, columns) = self.field_offset;
        [("y", rows), ("x", columns)]
            .map(|(name, offset_px)| Axis::space(name, self.pixel_pitch_um, offset_px))
    }
}

/// An archive that is being written.
pub struct VideoArchive {
    path: PathBuf,
    params: ArchiveParams,
    array: FloatArray,
    scratch: Arc<Scratch>,
}

impl VideoArchive {
    /// Makes the archive `path`, or goes on with the one that is there: the caller knows that
    /// it is of the same frames. Nothing but metadata is written.
    ///
    /// # Errors
    /// Failed writes.
    pub fn create(path: &Path, params: ArchiveParams, scratch: &Arc<Scratch>) -> Result<Self> {
        let shape = params.video;
        let [y, x] = params.space();
        let axes = [
            Axis {
                name: "frame",
                kind: Some("time"),
                unit: params.frame_period_us.map(|_| "microsecond"),
                scale: params.frame_period_us.unwrap_or(1.0),
                origin: 0.0,
            },
            Axis {
                name: "t",
                kind: None,
                unit: Some("microsecond"),
                scale: params.bin_us,
                origin: params.first_bin_us + 0.5 * params.bin_us,
            },
            y,
            x,
        ];
        let (rows, columns) = (shape.rows as u64, shape.columns as u64);
        let array = FloatArray::create(
            &path.join("0"),
            &ArrayParams {
                shape: &[params.frames as u64, shape.bins as u64, rows, columns],
                chunks: &[1, bins_of_chunk(shape), rows, columns],
                names: &["frame", "t", "y", "x"],
                attributes: json!({}),
            },
            scratch,
        )?;
        if let Some(starts) = &params.frame_start_us {
            let about = json!({
                "unit": "microsecond",
                "description": "start of exposure of the row of each frame that is read first",
            });
            let place = path.join("frame_start_us");
            write_coordinates(&place, ("frame", about), starts, scratch)?;
        }
        write_group(path, &axes, &params.attributes, scratch)?;
        Ok(Self {
            path: path.into(),
            params,
            array,
            scratch: Arc::clone(scratch),
        })
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What it holds.
    pub fn params(&self) -> &ArchiveParams {
        &self.params
    }

    /// Writes the video of a frame. Killed in the middle, some of its chunks are there, each of
    /// them whole.
    ///
    /// # Errors
    /// Failed writes.
    ///
    /// # Panics
    /// If the video is not of the archive's shape, or there is no such frame.
    pub fn store(&self, frame: usize, video: &Video) -> Result<()> {
        assert_eq!(video.shape(), self.params.video, "shape of the video");
        assert!(frame < self.params.frames, "no frame {frame}");
        let pixels = self.params.video.pixels();
        let length = self.array.chunks()[1] as usize * pixels;
        let mut whole = vec![f32::NAN; length];
        for (chunk, values) in video.data().chunks(length).enumerate() {
            // The last chunk may reach beyond the array.
            whole[..values.len()].copy_from_slice(values);
            whole[values.len()..].fill(f32::NAN);
            let at = [frame as u64, chunk as u64, 0, 0];
            self.array.store_chunk(&at, &whole)?;
        }
        Ok(())
    }

    /// Reads `bins` of the video of a frame; NaN where nothing was written.
    ///
    /// # Errors
    /// A chunk that cannot be read.
    pub fn read(&self, frame: usize, bins: std::ops::Range<usize>) -> Result<Vec<f32>> {
        let (frame, shape) = (frame as u64, self.params.video);
        self.array.read(&[
            frame..frame + 1,
            bins.start as u64..bins.end as u64,
            0..shape.rows as u64,
            0..shape.columns as u64,
        ])
    }
}

/// The bins of a stitched video.
#[derive(Debug, Clone, PartialEq)]
pub struct StitchParams {
    /// Frame and bin of each; `None`: a picture of NaN that stands for dead time.
    pub bins: Vec<Option<(usize, usize)>>,
    /// Middle of each.
    pub time_us: Vec<f64>,
}

/// A stitched video that is being written beside its archive.
pub struct StitchedVideo<'a> {
    archive: &'a VideoArchive,
    params: &'a StitchParams,
    folder: PathBuf,
    array: FloatArray,
}

impl<'a> StitchedVideo<'a> {
    /// Begins an OME-Zarr image `[t, y, x]` in the folder `hidden`, which must be new.
    ///
    /// # Errors
    /// Failed writes.
    ///
    /// # Panics
    /// If there is no bin, or not one time for each.
    pub fn create(
        archive: &'a VideoArchive,
        params: &'a StitchParams,
        hidden: &Path,
    ) -> Result<Self> {
        assert!(!params.bins.is_empty(), "a stitched video has bins");
        assert_eq!(params.bins.len(), params.time_us.len(), "a time for each");
        let (scratch, about) = (&archive.scratch, &archive.params);
        let shape = Shape {
            bins: params.bins.len(),
            ..about.video
        };
        let [y, x] = about.space();
        let axes = [
            Axis {
                name: "t",
                kind: Some("time"),
                unit: Some("microsecond"),
                scale: about.bin_us,
                origin: params.time_us[0],
            },
            y,
            x,
        ];
        let lengths = [shape.bins as u64, shape.rows as u64, shape.columns as u64];
        let array = FloatArray::create(
            &hidden.join("0"),
            &ArrayParams {
                shape: &lengths,
                chunks: &[bins_of_chunk(about.video), lengths[1], lengths[2]],
                names: &["t", "y", "x"],
                attributes: json!({}),
            },
            scratch,
        )?;
        let time = json!({
            "unit": "microsecond",
            "description": "middle of each bin, from the start of exposure of the first frame's row that is read first; in dead time the middle of the dead time",
        });
        let place = hidden.join("time_us");
        write_coordinates(&place, ("t", time), &params.time_us, scratch)?;
        let frames: Vec<f64> = params
            .bins
            .iter()
            .map(|bin| bin.map_or(f64::NAN, |(frame, _)| frame as f64))
            .collect();
        let frame = json!({"description": "the frame that a bin comes from; NaN in dead time"});
        write_coordinates(&hidden.join("frame"), ("t", frame), &frames, scratch)?;
        let note = json!({
            "note": "one time axis: dead time, however long, is one picture of NaN; the time of each bin is in time_us",
            "frame_period_us": about.frame_period_us,
        });
        write_group(hidden, &axes, &note, scratch)?;
        Ok(Self {
            archive,
            params,
            folder: hidden.into(),
            array,
        })
    }

    /// Number of chunks.
    pub fn chunks(&self) -> usize {
        let bins = self.array.chunks()[0] as usize;
        self.params.bins.len().div_ceil(bins)
    }

    /// Copies what belongs into a chunk; no more than the chunk and a frame's part of it is
    /// in memory.
    ///
    /// # Errors
    /// Failed reads and writes.
    pub fn copy_chunk(&self, chunk: usize) -> Result<()> {
        let pixels = self.archive.params.video.pixels();
        let length = self.array.chunks()[0] as usize;
        let end = self.params.bins.len().min((chunk + 1) * length);
        let bins = &self.params.bins[chunk * length..end];
        let mut values = vec![f32::NAN; length * pixels];
        let mut at = 0;
        while at < bins.len() {
            let Some((frame, first)) = bins[at] else {
                at += 1;
                continue;
            };
            // The run of this frame's bins.
            let run = bins[at..].iter().enumerate();
            let run = run.take_while(|(i, bin)| **bin == Some((frame, first + i)));
            let count = run.count();
            let read = self.archive.read(frame, first..first + count)?;
            values[at * pixels..(at + count) * pixels].copy_from_slice(&read);
            at += count;
        }
        self.array.store_chunk(&[chunk as u64, 0, 0], &values)
    }

    /// The folder that it is in.
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}

/// Bins of a chunk, such that all chunks but the last are alike.
pub(crate) fn bins_of_chunk(video: Shape) -> u64 {
    let bytes = video.voxels() * size_of::<f32>();
    let chunks = bytes.div_ceil(CHUNK_BYTES).clamp(1, video.bins);
    video.bins.div_ceil(chunks) as u64
}
