//! The formats in which a video is written.

use rowburst::{Camera, Error, ErrorKind, Parameter, Result, Video};
use rowburst_io::{OutputFolder, TiffScale, write_hdf5_video, write_mat_video, write_tiff_video};
use serde::{Deserialize, Serialize};

/// Largest video of which `video.tif` is written unasked; larger fills disks with copies.
const MAX_TIFF_BYTES: usize = 64 << 20;

/// A format of the video.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum VideoFormat {
    /// `video.npy`. It is written in any case: viewer, figures and Python read it.
    Npy,
    /// `video.tif`, a time stack for Fiji.
    Tif,
    /// `video.ome.zarr`.
    Zarr,
    /// `video.mp4`.
    Mp4,
    /// `video.mat`, of version 5.
    Mat,
    /// `video.h5`.
    H5,
}

impl VideoFormat {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self::Npy,
        Self::Tif,
        Self::Zarr,
        Self::Mp4,
        Self::Mat,
        Self::H5,
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Npy => "npy",
            Self::Tif => "tif",
            Self::Zarr => "zarr",
            Self::Mp4 => "mp4",
            Self::Mat => "mat",
            Self::H5 => "h5",
        }
    }

    /// The formats of a list such as `npy,tif`.
    ///
    /// # Errors
    /// A name that is none.
    pub fn parse_list(text: &str) -> Result<Vec<Self>> {
        let words = text.split(',').map(str::trim);
        words.map(Self::parse).collect()
    }

    fn parse(word: &str) -> Result<Self> {
        let known = Self::ALL.into_iter().find(|format| format.name() == word);
        known.ok_or_else(|| {
            Error::input(
                Parameter::Write,
                format!("\"{word}\""),
                format!(
                    "a video is written as {}",
                    Self::ALL.map(Self::name).join(", ")
                ),
                "Name one or more of them.",
            )
            .with_kind(ErrorKind::Unknown)
        })
    }
}

/// Whether a video of `voxels` voxels is written as `format`. Without a choice `npy`, `mp4` and up to 64 MB `tif` are.
pub(crate) fn is_written(
    chosen: Option<&[VideoFormat]>,
    format: VideoFormat,
    voxels: usize,
) -> bool {
    match (chosen, format) {
        (_, VideoFormat::Npy) => true,
        (Some(chosen), _) => chosen.contains(&format),
        (None, VideoFormat::Tif) => 4 * voxels <= MAX_TIFF_BYTES,
        (None, _) => format == VideoFormat::Mp4,
    }
}

/// Writes `video` in all formats but `.npy` and `.mp4`.
pub(crate) fn write_formats(
    folder: &OutputFolder,
    chosen: Option<&[VideoFormat]>,
    video: &Video,
    camera: &Camera,
) -> Result<()> {
    let time = camera.time();
    let pixel_pitch_um = camera.sensor().pixel_pitch_um;
    let writes = |format| is_written(chosen, format, video.shape().voxels());
    if writes(VideoFormat::Tif) {
        let scale = TiffScale {
            frame_interval_s: time.bin_duration_us() * 1e-6,
            first_s: time.middle_us(0) * 1e-6,
            pixel_pitch_um,
        };
        folder.write("video.tif", |w| write_tiff_video(w, video, scale))?;
    }
    if writes(VideoFormat::Mat) {
        folder.write("video.mat", |w| write_mat_video(w, video, time))?;
    }
    if writes(VideoFormat::H5) {
        folder.write("video.h5", |w| write_hdf5_video(w, video, time))?;
    }
    if writes(VideoFormat::Zarr) {
        #[cfg(not(feature = "zarr"))]
        return Err(Error::input(
            Parameter::Write,
            "zarr",
            "this program was built without Zarr",
            "Write npy or h5 instead, or build it in: cargo install --locked --path crates/rowburst-cli --features batch.",
        )
        .with_kind(ErrorKind::Unsupported));
        #[cfg(feature = "zarr")]
        {
            folder.list("video.ome.zarr")?;
            let path = folder.path().join("video.ome.zarr");
            let field_offset = camera.field_offset();
            rowburst_zarr::write_video(&path, video, time, pixel_pitch_um, field_offset)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_parsed_and_large_stacks_wait_until_asked_for() {
        let list = VideoFormat::parse_list("npy, tif,mat").unwrap();
        assert_eq!(list, [VideoFormat::Npy, VideoFormat::Tif, VideoFormat::Mat]);
        let message = VideoFormat::parse_list("avi").unwrap_err().to_string();
        assert!(message.contains("npy, tif, zarr"), "{message}");
        let is_default = |format, voxels| is_written(None, format, voxels);
        assert!(is_default(VideoFormat::Tif, 16 << 20));
        assert!(!is_default(VideoFormat::Tif, (16 << 20) + 1));
        assert!(is_default(VideoFormat::Mp4, 1) && !is_default(VideoFormat::Zarr, 1));
        assert!(is_written(Some(&[]), VideoFormat::Npy, 1));
        assert!(!is_written(Some(&[]), VideoFormat::Mp4, 1));
    }
}
