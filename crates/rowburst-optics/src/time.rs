//! The time axis of a video.

/// The time axis of a video: its bins, and the weight of each bin in the instants at which rows are read.
///
/// Row `r` is read at the end of instant `k[r]` and integrates the video with the weights of that instant:
/// `w[r, j] = weight(k[r], j)`. A weight is the overlap of the row's exposure (Eq. 2) with bin `j`, in row times
/// (for a `global` shutter in exposures, so it is 1). Only a short run of consecutive bins has weights above zero.
///
/// Zero of time is the start of exposure of the row that is read first. Bin 0 starts at [`Self::start_us`]: at zero where
/// the exposure is a whole number of row times, else by a part of a row time earlier.
#[derive(Debug, Clone, PartialEq)]
pub struct TimeGrid {
    bins: usize,
    bin_duration_us: f64,
    start_us: f64,
    instants: Vec<InstantWeights>,
}

/// The weights of the consecutive bins that one instant integrates.
#[derive(Debug, Clone, PartialEq)]
pub struct InstantWeights {
    /// First of these bins.
    pub first_bin: usize,
    /// Weights of `first_bin, first_bin + 1, …` in row times; in exposures for a `global` shutter, whose only weight
    /// is 1.
    pub weights: Vec<f64>,
}

impl InstantWeights {
    /// The bins that it integrates.
    pub fn bins(&self) -> std::ops::Range<usize> {
        self.first_bin..self.first_bin + self.weights.len()
    }
}

impl TimeGrid {
    /// A single bin of `duration_us` microseconds, which every row integrates with weight 1 (`global` shutter).
    pub fn single(duration_us: f64) -> Self {
        Self {
            bins: 1,
            bin_duration_us: duration_us,
            start_us: 0.0,
            instants: vec![InstantWeights {
                first_bin: 0,
                weights: vec![1.0],
            }],
        }
    }

    /// The grid of a rolling shutter.
    ///
    /// `row_time_us` is in microseconds, `exposure` in row times. The video begins `lead = ceil(exposure) − 1` row
    /// times before the first instant. Each row time has `bins_per_row` bins, `(instants + lead) · bins_per_row` in
    /// all.
    ///
    /// # Panics
    /// If an argument is zero or negative.
    pub fn rolling(instants: usize, row_time_us: f64, exposure: f64, bins_per_row: usize) -> Self {
        assert!(instants > 0 && exposure > 0.0 && bins_per_row > 0 && row_time_us > 0.0);
        // 28.8 µs / 9.6 µs is 3.0000000000000004 in f64; the rounding error must not add a row time.
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
            start_us: (exposure - exposure.ceil()) * row_time_us,
            instants: (0..instants).map(weights_of).collect(),
        }
    }

    /// The grid of a scene at rest: one bin for the whole time, which all rows integrate alike, for their exposure.
    pub(crate) fn at_rest(&self) -> Self {
        Self {
            bins: 1,
            bin_duration_us: self.end_us() - self.start_us,
            start_us: self.start_us,
            instants: vec![InstantWeights {
                first_bin: 0,
                weights: vec![self.instants[0].weights.iter().sum()],
            }],
        }
    }

    /// The grid of `bins` and of the instants `kept`, which integrate only these bins.
    pub(crate) fn subset(&self, bins: std::ops::Range<usize>, kept: Vec<usize>) -> Self {
        let moved = |i: usize| InstantWeights {
            first_bin: self.instants[i].first_bin - bins.start,
            weights: self.instants[i].weights.clone(),
        };
        Self {
            bins: bins.len(),
            bin_duration_us: self.bin_duration_us,
            start_us: self.start_us + bins.start as f64 * self.bin_duration_us,
            instants: kept.into_iter().map(moved).collect(),
        }
    }

    /// The same bins, `width` row times long, seen by other instants: for each of `of` the instant of this grid, and by how
    /// many row times its exposure starts later and ends later. Light before the first bin is taken to be that of the
    /// first, and light after the last that of the last.
    pub(crate) fn retimed(&self, width: f64, of: &[(usize, [f64; 2])]) -> Self {
        let moved = |&(instant, [start_later, end_later]): &(usize, [f64; 2])| {
            let run = &self.instants[instant];
            let read_at = run.bins().end as f64 * width;
            let exposure: f64 = run.weights.iter().sum();
            let (start, end) = (read_at - exposure + start_later, read_at + end_later);
            let weight = |bin: usize| {
                let (from, to) = (bin as f64 * width, (bin + 1) as f64 * width);
                let inside = (to.min(end) - from.max(start)).max(0.0);
                let before = if bin == 0 {
                    (end.min(0.0) - start.min(0.0)).max(0.0)
                } else {
                    0.0
                };
                let last = self.bins as f64 * width;
                let after = if bin + 1 == self.bins {
                    (end.max(last) - start.max(last)).max(0.0)
                } else {
                    0.0
                };
                inside + before + after
            };
            let seen = |bin: &usize| weight(*bin) > 1e-9;
            let first = (0..self.bins).find(seen).unwrap_or(0);
            let last = (first..self.bins).rev().find(seen).unwrap_or(first);
            InstantWeights {
                first_bin: first,
                weights: (first..=last).map(weight).collect(),
            }
        };
        Self {
            instants: of.iter().map(moved).collect(),
            ..self.clone()
        }
    }

    /// Number of bins of the video.
    #[inline]
    pub fn bins(&self) -> usize {
        self.bins
    }

    /// Duration of one bin in microseconds.
    pub fn bin_duration_us(&self) -> f64 {
        self.bin_duration_us
    }

    /// Start of bin 0 in microseconds from the zero of time.
    pub fn start_us(&self) -> f64 {
        self.start_us
    }

    /// End of the last bin in microseconds from the zero of time.
    pub fn end_us(&self) -> f64 {
        self.start_us + self.bins as f64 * self.bin_duration_us
    }

    /// Middle of `bin` in microseconds from the zero of time.
    pub fn middle_us(&self, bin: usize) -> f64 {
        self.start_us + (bin as f64 + 0.5) * self.bin_duration_us
    }

    /// The same grid, whose bin 0 starts at `start_us`.
    #[must_use]
    pub fn starting_at(self, start_us: f64) -> Self {
        Self { start_us, ..self }
    }

    /// Frame rate of the video in hertz.
    pub fn frame_rate_hz(&self) -> f64 {
        1e6 / self.bin_duration_us
    }

    /// The weights of every instant.
    #[inline]
    pub fn instants(&self) -> &[InstantWeights] {
        &self.instants
    }

    /// Whether no two instants integrate the same bin; then `A Aᵀ` is block-diagonal.
    pub fn is_disjoint(&self) -> bool {
        let ends = self.instants.iter().map(|i| i.first_bin + i.weights.len());
        let starts = self.instants.iter().skip(1).map(|i| i.first_bin);
        ends.zip(starts).all(|(end, next)| end <= next)
    }
}

/// Rounds a number that is within rounding errors of a positive integer.
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

    /// Instant `k` integrates from `k` row times after the zero of time on, for the exposure.
    #[test]
    fn zero_is_the_start_of_the_first_exposure() {
        const ROW_US: f64 = 10.0;
        for exposure in [0.3, 1.0, 1.7, 28.8 / 9.6, 7.25] {
            for bins_per_row in 1..4 {
                let grid = TimeGrid::rolling(6, ROW_US, exposure, bins_per_row);
                for (k, instant) in grid.instants().iter().enumerate() {
                    let from = k as f64 * ROW_US;
                    let to = from + exposure * ROW_US;
                    let half = 0.5 * grid.bin_duration_us();
                    for bin in 0..grid.bins() {
                        let middle = grid.middle_us(bin);
                        let overlap = (to.min(middle + half) - from.max(middle - half)).max(0.0);
                        let at = bin.checked_sub(instant.first_bin);
                        let weight = at.and_then(|i| instant.weights.get(i)).unwrap_or(&0.0);
                        assert!(
                            (weight * ROW_US - overlap).abs() < 1e-9,
                            "{exposure} {k} {bin}"
                        );
                    }
                }
                let part = grid.subset(2..4, Vec::new());
                assert!((part.middle_us(0) - grid.middle_us(2)).abs() < 1e-9);
                assert!(
                    (part.end_us() - grid.middle_us(4) + 0.5 * grid.bin_duration_us()).abs() < 1e-9
                );
            }
        }
        assert_eq!(TimeGrid::single(500.0).middle_us(0), 250.0);
    }

    /// A longer exposure starts earlier and ends when it did; its light before the first bin counts to the first.
    #[test]
    fn retimed_instants_keep_the_bins() {
        let grid = TimeGrid::rolling(4, 9.6, 2.0, 2);
        let all = |moved: [f64; 2]| [0, 1, 2, 3].map(|i| (i, moved));
        assert_eq!(grid.retimed(0.5, &all([0.0, 0.0])), grid);
        let longer = grid.retimed(0.5, &all([-0.25, 0.0]));
        let (first, second) = (&longer.instants()[0], &longer.instants()[1]);
        assert_eq!(
            (longer.bins(), first.bins(), second.bins()),
            (10, 0..4, 1..6)
        );
        assert_eq!(first.weights, [0.75, 0.5, 0.5, 0.5]);
        assert_eq!(second.weights, [0.25, 0.5, 0.5, 0.5, 0.5]);
        let later = grid.retimed(0.5, &all([0.25, 0.25]));
        assert_eq!(later.instants()[0].weights, [0.25, 0.5, 0.5, 0.5, 0.25]);
        assert_eq!(later.instants()[3].weights, [0.25, 0.5, 0.5, 0.75]);
    }

    #[test]
    fn disjoint_up_to_one_row() {
        assert!(TimeGrid::rolling(5, 9.6, 0.5, 2).is_disjoint());
        assert!(TimeGrid::rolling(5, 9.6, 1.0, 3).is_disjoint());
        assert!(!TimeGrid::rolling(5, 9.6, 1.1, 1).is_disjoint());
    }
}
