//! Shapes of videos and the grid of their time axis.

/// Shape of a video: time bins, rows, columns (`[t, y, x]`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Shape {
    /// Number of time bins.
    pub bins: usize,
    /// Number of rows (`y`).
    pub rows: usize,
    /// Number of columns (`x`).
    pub columns: usize,
}

impl Shape {
    /// A shape from its three lengths.
    pub fn new(bins: usize, rows: usize, columns: usize) -> Self {
        Self {
            bins,
            rows,
            columns,
        }
    }

    /// Pixels of one bin.
    pub fn pixels(&self) -> usize {
        self.rows * self.columns
    }

    /// Voxels of the video.
    pub fn voxels(&self) -> usize {
        self.bins * self.pixels()
    }
}

impl std::fmt::Display for Shape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}×{}×{} (t, y, x)", self.bins, self.rows, self.columns)
    }
}

/// How the bins of the video weigh into the instants at which rows are read.
///
/// Row `r` is read out at the end of instant `k[r]`; it integrates the video with
/// the weights of that instant: `w[r, j] = weight(k[r], j)`, the overlap in row
/// times of the row's exposure (Eq. 2) with bin `j`. The weights of an instant
/// are zero outside a short run of bins.
#[derive(Debug, Clone, PartialEq)]
pub struct TimeGrid {
    bins: usize,
    bin_duration_us: f64,
    instants: Vec<InstantWeights>,
}

/// The run of bins that one instant integrates.
#[derive(Debug, Clone, PartialEq)]
pub struct InstantWeights {
    /// First bin with a weight.
    pub first_bin: usize,
    /// Weights of `first_bin, first_bin + 1, …` in row times.
    pub weights: Vec<f64>,
}

impl TimeGrid {
    /// A single bin seen by every row (`global` shutter).
    pub fn single(duration_us: f64) -> Self {
        Self {
            bins: 1,
            bin_duration_us: duration_us,
            instants: vec![InstantWeights {
                first_bin: 0,
                weights: vec![1.0],
            }],
        }
    }

    /// The grid of a rolling shutter.
    ///
    /// `exposure` is in row times; `lead = ceil(exposure) − 1` row times before the
    /// first instant belong to the video, and each row time has `bins_per_row` bins.
    ///
    /// # Panics
    /// If an argument is zero or negative.
    pub fn rolling(instants: usize, row_time_us: f64, exposure: f64, bins_per_row: usize) -> Self {
        assert!(instants > 0 && exposure > 0.0 && bins_per_row > 0 && row_time_us > 0.0);
        // 28.8 µs / 9.6 µs is 3.0000000000000004: a rounding error is no further row.
        let exposure = snap(exposure);
        let lead = exposure.ceil() as usize - 1;
        let bins = (instants + lead) * bins_per_row;
        let width = 1.0 / bins_per_row as f64;
        let weights_of = |instant: usize| {
            let end = (instant + 1 + lead) as f64;
            let start = end - exposure;
            let overlap = |bin: usize| {
                let (from, to) = (bin as f64 * width, (bin + 1) as f64 * width);
                (to.min(end) - from.max(start)).max(0.0)
            };
            let last = (instant + 1 + lead) * bins_per_row;
            let mut first = (start * bins_per_row as f64).floor().max(0.0) as usize;
            while first + 1 < last && overlap(first) < 1e-9 {
                first += 1;
            }
            InstantWeights {
                first_bin: first,
                weights: (first..last).map(overlap).collect(),
            }
        };
        Self {
            bins,
            bin_duration_us: row_time_us * width,
            instants: (0..instants).map(weights_of).collect(),
        }
    }

    /// The grid of the instants `kept` alone, which see only the bins `bins`.
    pub(crate) fn subset(&self, bins: std::ops::Range<usize>, kept: Vec<usize>) -> Self {
        let moved = |i: usize| InstantWeights {
            first_bin: self.instants[i].first_bin - bins.start,
            weights: self.instants[i].weights.clone(),
        };
        Self {
            bins: bins.len(),
            bin_duration_us: self.bin_duration_us,
            instants: kept.into_iter().map(moved).collect(),
        }
    }

    /// Number of bins of the video.
    pub fn bins(&self) -> usize {
        self.bins
    }

    /// Duration of one bin in microseconds.
    pub fn bin_duration_us(&self) -> f64 {
        self.bin_duration_us
    }

    /// Frame rate of the video in hertz.
    pub fn frame_rate_hz(&self) -> f64 {
        1e6 / self.bin_duration_us
    }

    /// The weights of every instant.
    pub fn instants(&self) -> &[InstantWeights] {
        &self.instants
    }

    /// Whether no bin is seen by two instants, so that `A Aᵀ` is block-diagonal.
    pub fn is_disjoint(&self) -> bool {
        let ends = self.instants.iter().map(|i| i.first_bin + i.weights.len());
        let starts = self.instants.iter().skip(1).map(|i| i.first_bin);
        ends.zip(starts).all(|(end, next)| end <= next)
    }
}

fn snap(value: f64) -> f64 {
    let whole = value.round();
    if whole >= 1.0 && (value - whole).abs() < 1e-9 * whole {
        whole
    } else {
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_sum_to_the_exposure() {
        for exposure in [0.3, 0.5, 1.0, 1.7, 2.5, 3.0, 7.25] {
            for bins_per_row in 1..4 {
                let grid = TimeGrid::rolling(6, 9.6, exposure, bins_per_row);
                for instant in grid.instants() {
                    let sum: f64 = instant.weights.iter().sum();
                    assert!((sum - exposure).abs() < 1e-12, "{exposure} {bins_per_row}");
                    assert!(instant.first_bin + instant.weights.len() <= grid.bins());
                }
            }
        }
    }

    #[test]
    fn exposure_that_is_a_whole_number_but_for_rounding_adds_no_bin() {
        assert_eq!(TimeGrid::rolling(8, 9.6, 28.8 / 9.6, 1).bins(), 10);
    }

    #[test]
    fn disjoint_up_to_one_row() {
        assert!(TimeGrid::rolling(5, 9.6, 0.5, 2).is_disjoint());
        assert!(TimeGrid::rolling(5, 9.6, 1.0, 3).is_disjoint());
        assert!(!TimeGrid::rolling(5, 9.6, 1.1, 1).is_disjoint());
    }
}
