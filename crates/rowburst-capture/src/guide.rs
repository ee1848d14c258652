//! What is wrong with a capture, each finding with its remedy: told when it ends, so that it can be taken again at once.

use crate::exposure::{Exposure, saturation_counts};
use crate::source::Frame;

/// Blocks along each side over which a picture is averaged.
const BLOCKS: usize = 8;

/// Part of the pixels of a dark that may be 0: more of them say that the black level is cut off.
const MAX_ZEROS: f64 = 1e-3;
/// Difference between blocks of a dark over the noise of a pixel: fixed patterns are smaller, light that leaks in larger.
const MAX_LEAK: f64 = 3.0;
/// Difference between the means of darks over the noise of a pixel.
const MAX_DRIFT: f64 = 1.0;
/// Level of flats as a part of the range of the converter.
const FLAT_LEVEL: (f64, f64) = (0.1, 0.8);
/// Darkest over brightest block of a flat: below, the corrected corners are mostly noise.
const MIN_EVENNESS: f64 = 0.5;
/// Contrast of a PSF: one point of one colour gives 0.9 to 1.
const MIN_PSF_CONTRAST: f64 = 0.5;
/// Width of a speckle grain in pixels: finer ones are averaged away by the pixels.
const MIN_GRAIN_PX: f64 = 2.0;
/// Brightest pixel of a PSF as a part of the range.
const MIN_PSF_PEAK: f64 = 0.25;
/// Contrast of a frame of a scene: a frame without speckle holds no picture.
const MIN_FRAME_CONTRAST: f64 = 0.02;
/// Brightest pixel of a frame as a part of the range.
const MIN_FRAME_PEAK: f64 = 0.05;

/// What the frames of a capture look like, gathered as they come.
#[derive(Debug, Default)]
pub(crate) struct Guide {
    /// Bits of the converter; levels are judged where they are known.
    bit_depth: Option<u32>,
    /// Level without light; unknown: the darkest pixel, so that contrast is not judged too low.
    dark_counts: Option<f64>,
    first: Option<Frame>,
    /// Standard deviation of a pixel between the first two frames.
    noise: Option<f64>,
    /// Sums over frames of the means of the blocks.
    blocks: Vec<f64>,
    means: Vec<f64>,
}

impl Guide {
    /// A guide before the first frame.
    pub fn new(bit_depth: Option<u32>) -> Self {
        Self {
            bit_depth,
            ..Self::default()
        }
    }

    /// With the level of the darks, where it is known.
    pub fn with_dark_counts(self, dark_counts: Option<f64>) -> Self {
        Self {
            dark_counts,
            ..self
        }
    }

    /// Bits of the converter.
    pub fn bit_depth(&self) -> Option<u32> {
        self.bit_depth
    }

    /// Looks at a frame.
    pub fn add(&mut self, frame: &Frame, mean: f64) {
        self.means.push(mean);
        self.blocks.resize(BLOCKS * BLOCKS, 0.0);
        for (sum, block) in self.blocks.iter_mut().zip(block_means(frame)) {
            *sum += block;
        }
        match &self.first {
            None => self.first = Some(frame.clone()),
            Some(first) if self.noise.is_none() => self.noise = Some(noise_between(first, frame)),
            Some(_) => {}
        }
    }

    /// What is wrong with a capture for `purpose`.
    pub fn findings(&self, purpose: &str) -> Vec<String> {
        let Some(first) = &self.first else {
            return Vec::new();
        };
        match purpose {
            "darks" => self.of_darks(first),
            "flats" => self.of_flats(first),
            "psf" | "psf-again" => self.of_psf(first),
            "frame" => self.of_frame(first),
            _ => Vec::new(),
        }
    }

    fn of_darks(&self, first: &Frame) -> Vec<String> {
        let mut found = Vec::new();
        let zeros = first.counts.iter().filter(|&&count| count == 0).count();
        let zeros = zeros as f64 / first.counts.len().max(1) as f64;
        if zeros > MAX_ZEROS {
            found.push(format!(
                "{:.1} % of the pixels of a dark are 0, so the black level is cut off: raise the camera's offset",
                100.0 * zeros
            ));
        }
        let Some(noise) = self.noise else {
            found.push("one dark shows no noise: record 20 or more".into());
            return found;
        };
        if noise == 0.0 {
            found.push(
                "the darks are equal, so they show no noise: turn averaging and filters of the camera off".into(),
            );
            return found;
        }
        let (low, high) = range(self.block_levels());
        if high - low > MAX_LEAK * noise {
            found.push(format!(
                "one part of the darks is {:.1} counts brighter than another (noise {noise:.1}), so light leaks in: cover the sensor and switch lamps off",
                high - low
            ));
        }
        let (low, high) = range(self.means.iter().copied());
        if high - low > MAX_DRIFT * noise {
            found.push(format!(
                "the level of the darks differs by {:.1} counts from frame to frame (noise {noise:.1}): keep light out and let the camera warm up",
                high - low
            ));
        }
        found
    }

    fn of_flats(&self, first: &Frame) -> Vec<String> {
        let mut found = Vec::new();
        let dark = self.dark_level(first);
        if let (Some(range), Some(dark)) = (self.range_above(self.dark_counts), self.dark_counts) {
            let mean = self.means.iter().sum::<f64>() / self.means.len() as f64;
            let level = (mean - dark) / range;
            let remedy = if level < FLAT_LEVEL.0 {
                Some("make the light brighter or the exposure longer")
            } else if level > FLAT_LEVEL.1 {
                Some("make the light dimmer or the exposure shorter")
            } else {
                None
            };
            if let Some(remedy) = remedy {
                found.push(format!(
                    "the flats are at {:.0} % of the range, outside {:.0} to {:.0} %: {remedy}",
                    100.0 * level,
                    100.0 * FLAT_LEVEL.0,
                    100.0 * FLAT_LEVEL.1
                ));
            }
        }
        let dark = self.dark_counts.unwrap_or(dark.min(0.0));
        let (low, high) = range(self.block_levels());
        let evenness = (low - dark) / (high - dark);
        if evenness < MIN_EVENNESS {
            found.push(format!(
                "the darkest part of the flats has {:.0} % of the light of the brightest, below {:.0} %: light the sensor evenly, without the lens, through white paper or from further away",
                100.0 * evenness,
                100.0 * MIN_EVENNESS
            ));
        }
        found
    }

    fn of_psf(&self, first: &Frame) -> Vec<String> {
        let mut found = Vec::new();
        let exposure = self.exposure_of(first);
        if let Some(contrast) = exposure.contrast.filter(|&c| c < MIN_PSF_CONTRAST) {
            found.push(format!(
                "the speckle contrast of the PSF is {contrast:.2}, below {MIN_PSF_CONTRAST}: use a smaller point or a spectral filter, darken the room, and check that nothing vibrates"
            ));
        }
        if let Some(grain) = exposure.grain_px.filter(|&g| g < MIN_GRAIN_PX) {
            found.push(format!(
                "a speckle grain is {grain:.1} px wide, below {MIN_GRAIN_PX}: move the diffuser away from the sensor or close its aperture"
            ));
        }
        self.judge_peak(
            &exposure,
            first,
            MIN_PSF_PEAK,
            "the PSF",
            "lengthen the exposure, which is free for a PSF",
            &mut found,
        );
        found
    }

    fn of_frame(&self, first: &Frame) -> Vec<String> {
        let mut found = Vec::new();
        let exposure = self.exposure_of(first);
        if let Some(contrast) = exposure.contrast.filter(|&c| c < MIN_FRAME_CONTRAST) {
            found.push(format!(
                "the contrast of the frame is {contrast:.3}, below {MIN_FRAME_CONTRAST}: darken the room, and show fewer or smaller lights"
            ));
        }
        self.judge_peak(
            &exposure,
            first,
            MIN_FRAME_PEAK,
            "the frame",
            "make the light brighter or raise the gain",
            &mut found,
        );
        found
    }

    fn judge_peak(
        &self,
        exposure: &Exposure,
        first: &Frame,
        limit: f64,
        what: &str,
        remedy: &str,
        found: &mut Vec<String>,
    ) {
        let dark = self.dark_level(first);
        let Some(range) = self.range_above(Some(dark)) else {
            return;
        };
        let peak = (f64::from(exposure.max) - dark) / range;
        if peak < limit {
            found.push(format!(
                "the brightest pixel of {what} uses {:.1} % of the range, below {:.0} %: {remedy}",
                100.0 * peak,
                100.0 * limit
            ));
        }
    }

    fn exposure_of(&self, frame: &Frame) -> Exposure {
        Exposure::of(frame, self.bit_depth, self.dark_level(frame))
    }

    fn dark_level(&self, frame: &Frame) -> f64 {
        let darkest = || frame.counts.iter().copied().min().map_or(0.0, f64::from);
        self.dark_counts.unwrap_or_else(darkest)
    }

    /// Counts from the level without light to saturation, where the converter is known.
    fn range_above(&self, dark: Option<f64>) -> Option<f64> {
        self.bit_depth?;
        Some((f64::from(saturation_counts(self.bit_depth)) - dark?).max(1.0))
    }

    fn block_levels(&self) -> impl Iterator<Item = f64> {
        let frames = self.means.len().max(1) as f64;
        self.blocks.iter().map(move |sum| sum / frames)
    }
}

fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    })
}

/// The means of the blocks of a frame, row after row. A frame of fewer rows or columns than blocks is one block.
fn block_means(frame: &Frame) -> Vec<f64> {
    let (rows, columns) = (frame.rows, frame.columns);
    if rows < BLOCKS || columns < BLOCKS {
        let sum: f64 = frame.counts.iter().map(|&c| f64::from(c)).sum();
        return vec![sum / frame.counts.len().max(1) as f64; BLOCKS * BLOCKS];
    }
    let mut sums = vec![(0u64, 0u64); BLOCKS * BLOCKS];
    for (y, row) in frame.counts.chunks_exact(columns).enumerate() {
        let above = y * BLOCKS / rows * BLOCKS;
        for (x, &count) in row.iter().enumerate() {
            let (sum, pixels) = &mut sums[above + x * BLOCKS / columns];
            *sum += u64::from(count);
            *pixels += 1;
        }
    }
    sums.into_iter()
        .map(|(sum, pixels)| sum as f64 / pixels as f64)
        .collect()
}

/// The standard deviation of a pixel, from the difference of two frames.
fn noise_between(a: &Frame, b: &Frame) -> f64 {
    let differences = || {
        let pairs = a.counts.iter().zip(&b.counts);
        pairs.map(|(&a, &b)| f64::from(a) - f64::from(b))
    };
    let count = a.counts.len().max(1) as f64;
    let mean = differences().sum::<f64>() / count;
    let squares: f64 = differences().map(|d| (d - mean).powi(2)).sum();
    (squares / count / 2.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 64;

    fn random(i: usize, seed: usize) -> f64 {
        let mut bits = (i + seed * 7_777_777 + 1) as u32;
        for _ in 0..3 {
            bits = (bits ^ (bits >> 15)).wrapping_mul(0x2c1b_3c6d);
        }
        f64::from(bits >> 8) / 16_777_216.0
    }

    /// Findings about four frames of 12 bits; `count(y, x, frame)`.
    fn found(
        purpose: &str,
        dark: Option<f64>,
        count: impl Fn(usize, usize, usize) -> f64,
    ) -> String {
        let mut guide = Guide::new(Some(12)).with_dark_counts(dark);
        for number in 0..4 {
            let counts = (0..SIDE * SIDE).map(|i| count(i / SIDE, i % SIDE, number) as u16);
            let counts: Vec<_> = counts.collect();
            let mean = counts.iter().map(|&c| f64::from(c)).sum::<f64>() / counts.len() as f64;
            let frame = Frame {
                rows: SIDE,
                columns: SIDE,
                counts,
                number: number as u64,
                time_us: None,
            };
            guide.add(&frame, mean);
        }
        guide.findings(purpose).join("; ")
    }

    #[test]
    fn darks_show_light_noise_and_offset() {
        let dark = |y: usize, x: usize, n: usize| 100.0 + 6.0 * random(y * SIDE + x, n);
        assert_eq!(found("darks", None, dark), "");
        let leak = found("darks", None, |y, x, n| dark(y, x, n) + y as f64 / 2.0);
        assert!(leak.contains("light leaks in"), "{leak}");
        let drift = found("darks", None, |y, x, n| dark(y, x, n) + 4.0 * n as f64);
        assert!(drift.contains("from frame to frame"), "{drift}");
        let equal = found("darks", None, |y, x, _| dark(y, x, 0));
        assert!(equal.contains("the darks are equal"), "{equal}");
        let cut = found("darks", None, |y, x, n| dark(y, x, n) - 102.0);
        assert!(cut.contains("raise the camera's offset"), "{cut}");
    }

    #[test]
    fn flats_are_bright_and_even() {
        let flat =
            |level: f64| move |y: usize, x: usize, n: usize| level + 20.0 * random(y * SIDE + x, n);
        assert_eq!(found("flats", Some(100.0), flat(2000.0)), "");
        let dim = found("flats", Some(100.0), flat(200.0));
        assert!(dim.contains("brighter"), "{dim}");
        let bright = found("flats", Some(100.0), flat(3900.0));
        assert!(bright.contains("dimmer"), "{bright}");
        let uneven = found("flats", Some(100.0), |y, x, n| {
            flat(1000.0)(y, x, n) + 30.0 * x as f64
        });
        assert!(uneven.contains("evenly"), "{uneven}");
    }

    #[test]
    fn a_psf_has_contrast_grains_and_a_peak() {
        let speckle = |grain: usize, peak: f64| {
            move |y: usize, x: usize, _: usize| {
                let part = random(y / grain * SIDE + x / grain, 0);
                100.0 + (-peak / 5.0 * (1.0 - part).ln()).min(peak)
            }
        };
        assert_eq!(found("psf", Some(100.0), speckle(4, 3000.0)), "");
        let fine = found("psf", Some(100.0), speckle(1, 3000.0));
        assert!(fine.contains("move the diffuser away"), "{fine}");
        let dim = found("psf", Some(100.0), speckle(4, 400.0));
        assert!(dim.contains("lengthen the exposure"), "{dim}");
        let light = found("psf", Some(100.0), |y, x, n| {
            speckle(4, 1500.0)(y, x, n) + 1500.0
        });
        assert!(light.contains("smaller point"), "{light}");
    }

    #[test]
    fn a_frame_has_contrast() {
        let flat = |y: usize, x: usize, _: usize| 2000.0 + 4.0 * random(y * SIDE + x, 0);
        let found_flat = found("frame", Some(100.0), flat);
        assert!(found_flat.contains("darken the room"), "{found_flat}");
        let good = |y: usize, x: usize, _: usize| 500.0 + 400.0 * random(y / 3 * SIDE + x / 3, 0);
        assert_eq!(found("frame", Some(100.0), good), "");
        let dark = found("frame", Some(100.0), |y, x, _| {
            102.0 + 40.0 * random(y / 3 * SIDE + x / 3, 0)
        });
        assert!(dark.contains("make the light brighter"), "{dark}");
    }
}
