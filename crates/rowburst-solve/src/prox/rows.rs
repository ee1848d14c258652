//! The rows of a video with active voxels, the only ones that a prox works on.
//!
//! On a support most rows of most bins have none. Their voxels stay zero, and so does the dual between two inactive
//! voxels.

use rowburst_core::{Shape, Support};
use std::ops::Range;

/// Runs of neighbouring rows in each bin.
#[derive(Clone)]
pub(super) struct Rows {
    /// Rows with an active voxel.
    active: Vec<Vec<Range<usize>>>,
    /// Those, and the rows whose differences along y or t reach one of them.
    adjacent: Vec<Vec<Range<usize>>>,
}

impl Rows {
    pub fn all(shape: Shape) -> Self {
        let whole = std::iter::once(0..shape.rows).collect();
        let all: Vec<Vec<Range<usize>>> = vec![whole; shape.bins];
        Self {
            adjacent: all.clone(),
            active: all,
        }
    }

    pub fn of(support: &Support, shape: Shape) -> Self {
        let active = support.active_rows();
        let is_active =
            |t: usize, y: usize| t < shape.bins && y < shape.rows && active[t * shape.rows + y];
        let is_adjacent = |t, y| is_active(t, y) || is_active(t, y + 1) || is_active(t + 1, y);
        let bins = 0..shape.bins;
        Self {
            active: bins
                .clone()
                .map(|t| runs(shape.rows, |y| is_active(t, y)))
                .collect(),
            adjacent: bins
                .map(|t| runs(shape.rows, |y| is_adjacent(t, y)))
                .collect(),
        }
    }

    pub fn active(&self, t: usize) -> &[Range<usize>] {
        &self.active[t]
    }

    pub fn adjacent(&self, t: usize) -> &[Range<usize>] {
        &self.adjacent[t]
    }
}

fn runs(rows: usize, is_in: impl Fn(usize) -> bool) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for y in (0..rows).filter(|&y| is_in(y)) {
        match runs.last_mut() {
            Some(run) if run.end == y => run.end += 1,
            _ => runs.push(y..y + 1),
        }
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_hold_active_and_adjacent_rows() {
        let shape = Shape::new(3, 8, 9);
        let mut video = vec![0.0f32; shape.voxels()];
        video[72 + 4 * 9 + 4] = 1.0;
        let support = Support::above(&video, shape, &[0.5; 3]);
        let rows = Rows::of(&support, shape);
        let flat = |runs: &[Range<usize>]| runs.iter().cloned().flatten().collect::<Vec<_>>();
        assert_eq!(flat(rows.active(1)), [3, 4, 5]);
        assert_eq!(flat(rows.adjacent(1)), [2, 3, 4, 5]);
        assert_eq!(flat(rows.adjacent(0)), [3, 4, 5]);
        assert!(rows.active(0).is_empty() && rows.adjacent(2).is_empty());
        assert_eq!(flat(Rows::all(shape).adjacent(2)), [0, 1, 2, 3, 4, 5, 6, 7]);
    }
}
