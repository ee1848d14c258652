//! How many frames are worked on at once, and by how many threads each.
//!
//! A thread for each frame beats all threads on one frame: the steps of a frame wait for each
//! other (see ARCHITECTURE.md). Each frame at work needs its own memory, which is the bound.

use rowburst::reconstruct::Model;
use rowburst_run::available_memory_bytes;

/// Part of the free memory that is used.
const SHARE: f64 = 0.8;

/// A division of the threads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ThreadAllocation {
    /// Frames at once.
    pub concurrent_frames: usize,
    /// Threads for each of them.
    pub threads_per_frame: usize,
}

impl ThreadAllocation {
    /// Divides `threads` among `frames` that each need what `model` needs; never more at once
    /// than `most`, or than fit the memory that is free now.
    pub fn new(threads: usize, frames: usize, model: &Model, most: Option<usize>) -> Self {
        let each = Model::run_bytes(model.camera()).unwrap_or(u64::MAX);
        let fitting = available_memory_bytes().map_or(usize::MAX, |free| {
            (free as f64 * SHARE / each.max(1) as f64) as usize
        });
        Self::divide(threads, frames, fitting, most)
    }

    fn divide(threads: usize, frames: usize, fitting: usize, most: Option<usize>) -> Self {
        let most = most.unwrap_or(threads).min(fitting).min(frames);
        let concurrent_frames = most.clamp(1, threads.max(1));
        Self {
            concurrent_frames,
            threads_per_frame: (threads / concurrent_frames).max(1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_go_to_frames_first() {
        let allocation = |threads, frames, fitting, most| {
            let allocation = ThreadAllocation::divide(threads, frames, fitting, most);
            (allocation.concurrent_frames, allocation.threads_per_frame)
        };
        assert_eq!(allocation(8, 100, 50, None), (8, 1));
        assert_eq!(allocation(8, 2, 50, None), (2, 4));
        assert_eq!(allocation(8, 100, 3, None), (3, 2));
        assert_eq!(allocation(8, 100, 0, None), (1, 8));
        assert_eq!(allocation(8, 100, 50, Some(1)), (1, 8));
        assert_eq!(allocation(2, 100, 50, Some(9)), (2, 1));
        assert_eq!(allocation(2, 0, 50, None), (1, 2));
    }
}
