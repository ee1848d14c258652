//! Whether this machine has memory for a reconstruction.

use crate::error::to_py_err;
use pyo3::prelude::*;
use rowburst::reconstruct::Model;
use rowburst::{Camera, Parameter, phrase};
use rowburst_run::{check_bytes, check_memory};

/// Bytes up to which nothing is checked: the check would cost more than the work, in a loop of a solver.
const UNCHECKED_BYTES: u64 = 1 << 28;

/// Checks that a reconstruction with `camera` fits into the memory that is available, beside `kept` bytes that stay
/// between runs.
///
/// # Errors
/// Too little memory; the words are those of the command line.
pub fn check(camera: &Camera, kept: u64) -> PyResult<()> {
    check_memory(Parameter::Memory, camera, kept).map_err(to_py_err)
}

/// Checks that one video of `camera`, in numbers of `number_bytes` each, fits into the memory that is available.
///
/// # Errors
/// Too little memory.
pub fn check_video(camera: &Camera, number_bytes: usize) -> PyResult<()> {
    check_videos(camera, 1, number_bytes, 0)
}

/// Checks that the data term of a frame fits into the memory that is available: the sensitivity of each voxel, its mask,
/// and the blocks in f64.
///
/// # Errors
/// Too little memory.
pub fn check_data_term(camera: &Camera) -> PyResult<()> {
    let blocks = if camera.time().is_disjoint() {
        Model::cached_gram_bytes(camera)
    } else {
        0
    };
    check_videos(camera, 2, size_of::<f32>(), blocks)
}

/// Checks that `count` videos of `camera`, in numbers of `number_bytes` each, and `more` bytes fit into the memory that
/// is available.
fn check_videos(camera: &Camera, count: u64, number_bytes: usize, more: u64) -> PyResult<()> {
    let shape = camera.video_shape();
    let sides = [shape.bins, shape.rows, shape.columns, number_bytes];
    let videos = sides
        .iter()
        .try_fold(count, |bytes, &side| bytes.checked_mul(side as u64));
    let needed = videos.and_then(|bytes| bytes.checked_add(more));
    if needed.is_some_and(|bytes| bytes <= UNCHECKED_BYTES) {
        return Ok(());
    }
    let what = format!("a video of {shape}");
    let remedy = phrase![
        "Make ",
        Parameter::Field,
        " smaller, bin the frame, or use a machine with more memory."
    ];
    check_bytes(Parameter::Memory, &what, needed, remedy).map_err(to_py_err)
}
