//! Which sensor rows the light of each part of the field reaches.
//!
//! Each instant reads one or two rows: light that does not reach them is lost. So the
//! diffuser must spread light from the bottom of the field to the top row and the other
//! way round (Weinberg & Katz, Opt. Express 28, 30616, 2020). A source at sensor position
//! `s` sends the share `P[r − s]` of its light to row `r`, with `P` the sums of the PSF
//! along its rows.

use rowburst_core::vecmath::solve_normal;
use rowburst_optics::{Image, Psf};

/// Shares of light by source row and sensor row.
#[derive(Debug, Clone, PartialEq)]
pub struct Reach {
    /// Share of the source's light on each sensor row relative to its mean over the rows,
    /// `[source row, sensor row]`.
    pub map: Image,
    /// Field position, in sensor rows, of each row of the map.
    pub source_rows: Vec<f64>,
    /// Smaller of the two: light of the field's bottom on the top row, of its top on the
    /// bottom row, relative to the mean over the rows.
    pub worst: f64,
    /// Whether the PSF does not cover these displacements, so that they were continued
    /// by a Gaussian.
    pub extrapolated: bool,
}

/// Least [`Reach::worst`] that is enough: a row with a tenth of the mean light still
/// tells its instant apart from noise where the others have an SNR of some tens.
pub const MIN_REACH: f64 = 0.1;

/// Most source rows of the map.
const MAX_SOURCES: usize = 96;

/// Reach of `psf` on a sensor of `rows` rows for a field of `field_rows`, both in pixels
/// of the PSF; rows are averaged over `2·grain_px + 1`, since a row between two grains is
/// dark by chance. `measured` is the range of displacements (from, to) in rows that the
/// capture covered; `None` if the capture shows the whole pattern.
pub fn row_reach(
    psf: &Psf,
    rows: usize,
    field_rows: usize,
    grain_px: f64,
    measured: Option<(isize, isize)>,
) -> Reach {
    let profile = Profile::new(psf, grain_px, measured);
    let offset = (field_rows as f64 - rows as f64) / 2.0;
    let sources = field_rows.min(MAX_SOURCES);
    let source_rows: Vec<f64> = (0..sources)
        .map(|i| {
            let part = i as f64 / (sources - 1).max(1) as f64;
            part * (field_rows - 1) as f64 - offset
        })
        .collect();
    let mut map = Image::zeros(sources, rows);
    let mut extrapolated = false;
    for (i, source) in source_rows.iter().enumerate() {
        let shares: Vec<f64> = (0..rows).map(|r| profile.at(r as f64 - source)).collect();
        let mean = shares.iter().sum::<f64>() / rows as f64;
        let line = &mut map.data_mut()[i * rows..(i + 1) * rows];
        for (to, share) in line.iter_mut().zip(shares) {
            *to = if mean > 0.0 {
                (share / mean) as f32
            } else {
                0.0
            };
        }
    }
    let worst = map.at(0, rows - 1).min(map.at(sources - 1, 0));
    for d in [
        rows as f64 - 1.0 - source_rows[0],
        -source_rows[sources - 1],
    ] {
        extrapolated |= measured.is_some() && !profile.covers(d);
    }
    Reach {
        map,
        source_rows,
        worst: f64::from(worst),
        extrapolated,
    }
}

struct Profile {
    first: isize,
    shares: Vec<f64>,
    /// `ln P = a + b d + c d²` outside; without it nothing is there.
    extrapolation: Option<[f64; 3]>,
}

impl Profile {
    fn new(psf: &Psf, grain_px: f64, measured: Option<(isize, isize)>) -> Self {
        let image = psf.image();
        let middle = (image.rows() / 2) as isize;
        let (from, to) = measured.unwrap_or((isize::MIN, isize::MAX));
        let from = from.max(-middle);
        let to = to.min(image.rows() as isize - 1 - middle).max(from);
        let sums: Vec<f64> = (from..=to)
            .map(|d| {
                let row = image.row((d + middle) as usize);
                row.iter().map(|&p| f64::from(p)).sum()
            })
            .collect();
        let half = (grain_px.round() as usize).max(1);
        let shares: Vec<f64> = (0..sums.len())
            .map(|i| {
                let window = &sums[i.saturating_sub(half)..(i + half + 1).min(sums.len())];
                window.iter().sum::<f64>() / window.len() as f64
            })
            .collect();
        let extrapolation = measured.map(|_| log_parabola(from, &shares));
        Self {
            first: from,
            shares,
            extrapolation,
        }
    }

    fn covers(&self, d: f64) -> bool {
        d >= self.first as f64 - 0.5 && d <= (self.first + self.shares.len() as isize) as f64 - 0.5
    }

    fn at(&self, d: f64) -> f64 {
        if self.covers(d) {
            let i = (d - self.first as f64).round() as usize;
            return self.shares[i.min(self.shares.len() - 1)];
        }
        self.extrapolation
            .map_or(0.0, |[a, b, c]| (a + b * d + c * d * d).exp())
    }
}

/// Weighted fit of a Gaussian that falls off: `c ≤ 0`. Weights are the shares, so that
/// the dark ends, where a floor may be left, count little.
fn log_parabola(first: isize, shares: &[f64]) -> [f64; 3] {
    let (mut normal, mut right) = ([[0.0f64; 3]; 3], [0.0f64; 3]);
    let scale = shares.len() as f64;
    for (i, &share) in shares.iter().enumerate() {
        if share > 0.0 {
            let d = (first + i as isize) as f64 / scale;
            let terms = [1.0, d, d * d];
            for ((row, right), a) in normal.iter_mut().zip(&mut right).zip(terms) {
                for (to, b) in row.iter_mut().zip(terms) {
                    *to += share * a * b;
                }
                *right += share * a * share.ln();
            }
        }
    }
    let flat = || {
        let mean = shares.iter().sum::<f64>() / scale;
        [mean.max(f64::MIN_POSITIVE).ln(), 0.0, 0.0]
    };
    // Fewer than three lit rows leave a term open.
    let lit = shares.iter().filter(|&&share| share > 0.0).count();
    let Some(found) = solve_normal(&normal, &right).filter(|_| lit >= 3) else {
        return flat();
    };
    let [a, b, c] = [found[0], found[1] / scale, found[2] / (scale * scale)];
    // A profile that rises outwards says nothing of what lies beyond.
    if c < 0.0 { [a, b, c] } else { flat() }
}
