//! Stray light of single rows in dense scenes, such as the banding of a sensor.
//!
//! A dense scene leaves too few numbers of a frame over for the steps of `step`, and explains banding by light that flickers
//! from row to row. A reconstruction well above the noise of the sensor, with a still part and few changes, does not follow
//! it: the mean of what it leaves of a row, less the mean of the rows around, is then the offset of the row
//! (docs/design/026).
//!
//! Light of the scene that flickers changes all rows of an instant alike, which tells it from banding. So only dual
//! shutters are corrected.

use super::super::frame_data::FrameData;
use super::super::held_out;
use super::super::held_out_check::{DENSE_SUPPORT, HeldOutCheck};
use super::super::held_out_run::HeldOutRun;
use super::super::{Observer, Prior, Problem, RunResult, choose};
use super::Calibration;
use rowburst_optics::Image;
use rowburst_solve::admm::TauRule;
use tracing::info;

/// The prior of the reconstructions: without a still part they follow banding, or leave what moves.
const PRIOR: &str = "tv+2*tdiff+background";
/// Their noise level over that of the sensor; smaller follows banding, larger leaves more of the scene.
const NOISE_LEVEL: f64 = 3.5;
/// Their iterations; fewer leave more of the scene.
const ITERATIONS: usize = 100;
/// Iterations after which a frame without banding is known; the size of the offsets changes little from there on
/// (docs/design/026).
const EARLY_ITERATIONS: usize = 50;
/// Rows on each side of a row whose mean is that of the scene; more leave more of the scene in the offsets.
const NEIGHBOURS: usize = 3;
/// Fewest pixels with weight of a row that has an offset.
const MIN_PIXELS: usize = 10;
/// Root mean square of the offsets over their standard error above which there is banding.
const MIN_SIZE: f64 = 3.0;
/// Correlation of the offsets of rows that are read at one instant, above which they are light of the scene; larger takes
/// flicker away.
const MAX_CORRELATION: f64 = 0.25;
/// Error of held-out pixels less the offsets over that before, below which they are believed.
const MAX_ERROR_RATIO: f64 = 0.95;
/// Standard errors of the paired differences by which their squares must fall.
const MIN_GAIN: f64 = 4.0;

impl Problem {
    /// The offsets of the rows of a dense scene; `check` is the last one of the model. `None`: none are seen, or they may not be
    /// corrected.
    pub(in crate::reconstruct) fn find_row_offsets(
        &self,
        check: &HeldOutCheck,
        observer: &mut Observer,
    ) -> Result<Option<Calibration>, Box<RunResult>> {
        let asked = self.options.self_calibration;
        let may_change = !asked.is_off() && asked.correctable.row_offsets;
        let is_dense = self.is_dense || check.support_fraction > DENSE_SUPPORT;
        let is_open = !self.has_wrong_model && self.calibration.is_none();
        if !(may_change && is_dense && is_open && self.camera.shutter().is_dual()) {
            return Ok(None);
        }
        let Some(fit) = self.loose_fit(observer)?.filter(LooseFit::confirms_offsets) else {
            return Ok(None);
        };
        let columns = self.measurement.image().columns();
        let of_row = |offset: &f64| std::iter::repeat_n(*offset as f32, columns);
        let offset: Vec<f32> = fit.rows.offsets.iter().flat_map(of_row).collect();
        Ok(Some(Calibration {
            parameters: Vec::new(),
            row_offsets: fit.rows.offsets,
            psf_refinement: None,
            psfs: self.data.psfs().clone(),
            gain: vec![1.0; offset.len()],
            offset,
            held_out: None,
            residual_before: None,
        }))
    }

    /// A reconstruction well above the noise of the sensor, if it leaves banding.
    fn loose_fit(&self, observer: &mut Observer) -> Result<Option<LooseFit>, Box<RunResult>> {
        let prior: Prior = PRIOR.parse().expect("a prior");
        let rule = TauRule::Discrepancy {
            sigma: NOISE_LEVEL * self.sigma,
        };
        let settings = self.options.solver_settings().of_a_search();
        // The runs of the problem go on from their own data.
        let mut data = self.data_with(self.data.psfs().clone());
        data.set_frame(&self.measurement.without(&self.excluded));
        let mut run = HeldOutRun::new(&mut data, prior, rule, settings);
        let mut fit = None;
        for iterations in [EARLY_ITERATIONS, ITERATIONS] {
            run.run(&mut data, iterations, observer)?;
            fit = Some(self.fit_of(&run, &data)).filter(|fit| fit.rows.are_banded());
            if fit.is_none() {
                break;
            }
        }
        Ok(fit)
    }

    /// What `run` leaves of the frame.
    fn fit_of(&self, run: &HeldOutRun, data: &FrameData) -> LooseFit {
        let check = HeldOutCheck::of(run, data);
        let image = self.measurement.image();
        let mut weights = match data.weights() {
            Some(weights) => weights.to_vec(),
            None => vec![1.0; image.data().len()],
        };
        let held_out = data.held_out_pixels().iter().zip(&check.held_out);
        let held_out: Vec<HeldOutPixel> = held_out
            .map(|(&pixel, &residual)| HeldOutPixel {
                row: pixel / image.columns(),
                weight: f64::from(weights[pixel]),
                residual,
            })
            .collect();
        for &pixel in data.held_out_pixels() {
            weights[pixel] = 0.0;
        }
        LooseFit {
            rows: Rows::new(image, &check.light, &weights, self.camera.instants()),
            held_out,
        }
    }
}

/// A reconstruction well above the noise of the sensor.
struct LooseFit {
    rows: Rows,
    held_out: Vec<HeldOutPixel>,
}

/// A pixel that the reconstruction has not seen.
struct HeldOutPixel {
    row: usize,
    weight: f64,
    /// Its weighted residual.
    residual: f64,
}

impl LooseFit {
    /// Whether the offsets, which other pixels have told, make the held-out residuals smaller.
    fn confirms_offsets(&self) -> bool {
        let before: Vec<f64> = self.held_out.iter().map(|pixel| pixel.residual).collect();
        let offset = |pixel: &HeldOutPixel| pixel.weight * self.rows.offsets[pixel.row];
        let after: Vec<f64> = self
            .held_out
            .iter()
            .map(|pixel| pixel.residual - offset(pixel))
            .collect();
        let ratio = held_out::rms(&after) / held_out::rms(&before);
        let gain = choose::gain(&before, &after);
        info!(
            "held-out error of a loose reconstruction less the offsets: {ratio:.3} times that before, {gain:.1} standard errors"
        );
        ratio < MAX_ERROR_RATIO && gain > MIN_GAIN
    }
}

/// What a reconstruction leaves of the rows of a frame.
struct Rows {
    /// The mean of each row less that of the rows around, in counts; 0 where a row has too few pixels.
    offsets: Vec<f64>,
    /// Root mean square of their standard errors.
    standard_error: f64,
    /// Correlation of the offsets of rows that are read at one instant.
    correlation: f64,
}

impl Rows {
    /// What `light` leaves of the frame `image` at pixels with `weights` above 0; `instants` are those at which the rows are read.
    fn new(image: &Image, light: &[f32], weights: &[f32], instants: &[usize]) -> Self {
        let columns = image.columns();
        let (mut means, mut variances) = (Vec::with_capacity(image.rows()), Vec::new());
        for y in 0..image.rows() {
            let sample = |i: usize| {
                (
                    f64::from(weights[i]).powi(2),
                    f64::from(image.data()[i]) - f64::from(light[i]),
                )
            };
            let pixels = (y * columns..(y + 1) * columns).filter(|i| weights[*i] > 0.0);
            let samples: Vec<(f64, f64)> = pixels.map(sample).collect();
            if samples.len() < MIN_PIXELS {
                means.push(None);
                continue;
            }
            let total = samples.iter().map(|(weight, _)| weight).sum::<f64>();
            let mean = samples.iter().map(|(w, rest)| w * rest).sum::<f64>() / total;
            let squares = samples.iter().map(|(w, rest)| w * (rest - mean).powi(2));
            variances.push(squares.sum::<f64>() / total / samples.len() as f64);
            means.push(Some(mean));
        }
        let offsets = less_the_rows_around(&means);
        Self {
            correlation: correlation_within(instants, &offsets),
            offsets,
            standard_error: (variances.iter().sum::<f64>() / variances.len().max(1) as f64).sqrt(),
        }
    }

    /// Whether the offsets are clear of noise, and are not light of the scene.
    fn are_banded(&self) -> bool {
        let size = held_out::rms(&self.offsets) / self.standard_error.max(f64::MIN_POSITIVE);
        info!(
            "offsets of the rows: {size:.1} standard errors, correlation within instants {:.2}",
            self.correlation
        );
        size > MIN_SIZE && self.correlation < MAX_CORRELATION
    }
}

/// The means of the rows less those of the rows around each.
fn less_the_rows_around(means: &[Option<f64>]) -> Vec<f64> {
    let around = |y: usize| {
        let last = (y + NEIGHBOURS + 1).min(means.len());
        let rows: Vec<f64> = means[y.saturating_sub(NEIGHBOURS)..last]
            .iter()
            .copied()
            .flatten()
            .collect();
        rows.iter().sum::<f64>() / rows.len().max(1) as f64
    };
    let offset = |(y, mean): (usize, &Option<f64>)| mean.map_or(0.0, |mean| mean - around(y));
    means.iter().enumerate().map(offset).collect()
}

/// Correlation of the offsets of rows that are read at the same one of `instants`; 0 where no two are.
fn correlation_within(instants: &[usize], offsets: &[f64]) -> f64 {
    let (mut product, mut power) = (0.0, 0.0);
    for (y, first) in offsets.iter().enumerate() {
        let same = (0..y).filter(|&other| instants[other] == instants[y]);
        for second in same.map(|other| offsets[other]) {
            product += first * second;
            power += (first * first + second * second) / 2.0;
        }
    }
    product / power.max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_pcg::Pcg64;

    const ROWS: usize = 60;
    const COLUMNS: usize = 80;

    /// The rows of a frame of uneven light, noise of 0.3 counts and `error(y, light)`.
    fn rows_with(error: impl Fn(usize, f32) -> f32) -> Rows {
        let rng = Pcg64::seed_from_u64(1);
        let noise: Vec<f32> = StandardNormal
            .sample_iter(rng)
            .take(2 * ROWS * COLUMNS)
            .collect();
        let (structure, noise) = noise.split_at(ROWS * COLUMNS);
        let light: Vec<f32> = structure.iter().map(|s| 100.0 + 30.0 * s).collect();
        let frame = Image::from_fn(ROWS, COLUMNS, |y, x| {
            let i = y * COLUMNS + x;
            light[i] + error(y, light[i]) + 0.3 * noise[i]
        });
        let instants: Vec<usize> = (0..ROWS).map(instant).collect();
        Rows::new(&frame, &light, &[1.0; ROWS * COLUMNS], &instants)
    }

    /// The instant of a row: both halves are read from the middle on.
    fn instant(y: usize) -> usize {
        y.abs_diff(ROWS / 2) - usize::from(y < ROWS / 2)
    }

    fn changes(count: usize) -> Vec<f32> {
        let rng = Pcg64::seed_from_u64(2);
        StandardNormal.sample_iter(rng).take(count).collect()
    }

    #[test]
    fn the_offsets_of_rows_are_found() {
        let planted = changes(ROWS);
        let rows = rows_with(|y, _| planted[y]);
        assert!(rows.are_banded());
        let left: Vec<f64> = (NEIGHBOURS..ROWS - NEIGHBOURS)
            .map(|y| {
                let around = &planted[y - NEIGHBOURS..=y + NEIGHBOURS];
                let mean = around.iter().sum::<f32>() / around.len() as f32;
                rows.offsets[y] - f64::from(planted[y] - mean)
            })
            .collect();
        assert!(held_out::rms(&left) < 0.1, "{}", held_out::rms(&left));
    }

    #[test]
    fn noise_and_smooth_light_are_no_banding() {
        assert!(!rows_with(|_, _| 0.0).are_banded());
        assert!(!rows_with(|y, _| 0.1 * y as f32).are_banded());
    }

    #[test]
    fn light_that_flickers_is_no_banding() {
        let flicker = changes(ROWS);
        let rows = rows_with(|y, light| 0.01 * flicker[instant(y)] * light);
        assert!(rows.correlation > 0.9, "{}", rows.correlation);
        assert!(!rows.are_banded());
    }

    #[test]
    fn a_row_with_few_pixels_has_no_offset() {
        let offsets = less_the_rows_around(&[Some(1.0), None, Some(3.0)]);
        assert_eq!(offsets, [-1.0, 0.0, 1.0]);
    }
}
