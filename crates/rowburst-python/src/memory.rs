//! Whether this machine has memory for a reconstruction.

use crate::error::to_py_err;
use pyo3::prelude::*;
use rowburst::{Camera, Error, ErrorKind, Parameter};
use std::path::Path;

/// Copies of the video in f32 that a reconstruction holds at its peak, as in `rowburst_run::inputs`.
const VIDEO_COPIES: u64 = 12;

/// Checks that the video of `camera` fits into the memory that is available. The package's allocator reserves
/// memory without using it, so a reservation alone would always succeed.
///
/// # Errors
/// Too little memory; the words are those of the command line.
pub fn check(camera: &Camera) -> PyResult<()> {
    rowburst_run::inputs::check_memory("the video".as_ref(), camera).map_err(to_py_err)?;
    let shape = camera.video_shape();
    let needed = shape.voxels() as u64 * 4 * VIDEO_COPIES;
    match available() {
        Some(available) if needed > available => Err(to_py_err(Error::work(
            Parameter::Memory,
            format!(
                "no memory for {VIDEO_COPIES} copies of a video of {shape}: {} needed, {} available",
                gibibytes(needed),
                gibibytes(available)
            ),
            "Make field smaller, bin the frame, or use a machine with more memory.",
        ).with_kind(ErrorKind::Memory))),
        _ => Ok(()),
    }
}

fn gibibytes(bytes: u64) -> String {
    format!("{:.1} GiB", bytes as f64 / f64::from(1 << 30))
}

/// Bytes that this process can still use; `None` where the system does not say.
fn available() -> Option<u64> {
    let machine = std::fs::read_to_string("/proc/meminfo").ok();
    let machine = machine.and_then(|text| {
        let free = field(&text, "MemAvailable:")? + field(&text, "SwapFree:").unwrap_or(0);
        Some(1024 * free)
    });
    let group = group_available("/sys/fs/cgroup".as_ref());
    match (machine, group) {
        (Some(machine), Some(group)) => Some(machine.min(group)),
        (machine, group) => machine.or(group),
    }
}

/// Bytes that the control group of a container has left (version 2, then version 1).
fn group_available(folder: &Path) -> Option<u64> {
    let number = |name: &str| -> Option<u64> {
        let text = std::fs::read_to_string(folder.join(name)).ok()?;
        text.trim().parse().ok()
    };
    let files = [
        ("memory.max", "memory.current", "memory.stat"),
        (
            "memory/memory.limit_in_bytes",
            "memory/memory.usage_in_bytes",
            "memory/memory.stat",
        ),
    ];
    files.iter().find_map(|(limit, used, statistics)| {
        let (limit, used) = (number(limit)?, number(used)?);
        // The kernel drops cached files before it ends a process.
        let statistics = std::fs::read_to_string(folder.join(statistics)).unwrap_or_default();
        let cached = field(&statistics, "inactive_file").unwrap_or(0);
        Some(limit.saturating_sub(used.saturating_sub(cached)))
    })
}

/// The number behind `name` in a text of one name and number a line.
fn field(text: &str, name: &str) -> Option<u64> {
    text.lines().find_map(|line| {
        let mut words = line.split_whitespace();
        (words.next() == Some(name)).then(|| words.next()?.parse().ok())?
    })
}
