//! Bytes ⇄ values: the files of Rowburst.
//!
//! Reading: [`read_image`] for one frame, PSF or mask, [`read_stack`] and
//! [`read_video`] for several pages, [`open_recording`] for many frames one at a time, [`Experiment::read`] for the experiment file.
//! Writing: one `write_…` function per format, each of which takes any writer,
//! and [`OutputFolder`], which puts a file in place only when it is whole.
//!
//! ```no_run
//! # fn main() -> rowburst::Result<()> {
//! let experiment = rowburst_io::Experiment::read("experiment.toml".as_ref())?;
//! let camera = experiment.camera()?;
//! let frame = rowburst_io::read_image("frame.tif".as_ref())?.image;
//! let folder = rowburst_io::OutputFolder::create("out".as_ref())?;
//! folder.write("frame.npy", |w| rowburst_io::write_npy_image(w, &frame))?;
//! # Ok(())
//! # }
//! ```

mod arrays;
mod bmp;
mod csv;
mod experiment;
mod fault;
mod file_log;
mod fits;
mod folder;
#[cfg(feature = "hdf5")]
mod hdf5;
mod keys;
mod mat;
mod metadata;
#[cfg(feature = "mp4")]
mod mp4;
mod npy;
mod npy_chunked;
mod ome_sizes;
mod pages;
mod patches;
mod photron;
mod png;
mod psf_capture;
mod read;
mod recording;
mod relative;
mod source;
mod stack;
mod stored_video;
mod table;
mod tiff;
mod video_formats;

pub use csv::{read_photodiode, write_csv};
pub use experiment::{
    Calibration, Experiment, FromMetadata, GuideFile, Reconstruction, Recording, experiment_schema,
};
pub use fault::write_error;
pub use file_log::sha256;
pub use folder::{ForeignFiles, OutputFolder};
pub use metadata::{
    CAPTURE_KIND, CameraReading, Finding, Metadata, Origin, Provenance, capture_record_path,
    micro_manager_metadata, origin_of_property, read_capture_record, read_metadata,
    read_properties, reading_of_record,
};
#[cfg(feature = "mp4")]
pub use mp4::{StampRenderer, write_mp4};
pub use npy::{
    write_npy_colour, write_npy_f64, write_npy_i64, write_npy_image, write_npy_u8, write_npy_video,
};
pub use npy_chunked::ChunkedVideoFile;
pub use pages::{Capture, IntegerFrame, SampleFormat};
pub use patches::{is_patch_set, patch_set_stack, read_patch_set, write_patch_set};
pub use png::{write_png8, write_png16};
pub use psf_capture::{hash_image, psf_capture_json, psf_capture_path, read_psf_capture};
pub use read::{
    read_colour_image, read_frames, read_image, read_stack, read_video, read_video_shape,
};
pub use recording::{Frames, gaps, open_recording};
pub use relative::relative_path;
pub use source::{ENDINGS as IMAGE_ENDINGS, is_image};
pub use stored_video::StoredVideo;
pub use tiff::{TiffScale, write_tiff_colour, write_tiff_image, write_tiff_video};
pub use video_formats::{write_hdf5_video, write_mat_video};
