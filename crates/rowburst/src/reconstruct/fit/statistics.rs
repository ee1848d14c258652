//! The numbers of a residual.

use super::{Bands, FitInput, FitStatistics, TrimmedChiSquared};
use rowburst_optics::{Camera, Image, Video};

/// `|r|` of a pixel that stands out: noise passes it in one pixel of 1.7 million.
const OUTLIER: f64 = 5.0;

/// How far the `χ²` of a line of `n` pixels may lie above 1: `(1 + 6√(2/n)) · 1.25`. Six
/// standard deviations for the noise; a quarter for light that is unevenly hard to fit.
fn limit_of_line(n: usize) -> f64 {
    1.25 * (1.0 + 6.0 * (2.0 / n.max(1) as f64).sqrt())
}

/// Mean power that the optics pass in the noise band over that in the passed band, below which the noise band counts
/// as dark: a misfit of 30 σ then leaves 0.3 σ in it.
const MAX_LEAK: f64 = 1e-4;

/// Fewest bins of which it can be said that they are mirrored.
const MIN_MIRRORED_BINS: usize = 16;
/// Nearest bins that are compared: neighbours are alike in any order.
const NEAREST: usize = 6;
/// Largest side of the small pictures that are compared, and pairs for each pair.
const SMALL: usize = 32;
const COMPARISONS: usize = 8;

pub(super) fn of(evidence: &FitInput) -> FitStatistics {
    let (rows, columns) = (
        evidence.normalised_residual.rows(),
        evidence.normalised_residual.columns(),
    );
    let r = evidence.normalised_residual.data();
    let usable = |at: usize| evidence.weights.is_none_or(|w| w[at] > 0.0);
    let pixels: Vec<usize> = (0..r.len()).filter(|&at| usable(at)).collect();
    let m = pixels.len().max(1) as f64;
    let spent = evidence.degrees_of_freedom.min(evidence.max_freedom * m);
    // χ² of a part of the pixels: each has its share of the freedom.
    let chi = |sum: f64, count: usize| sum / (count.max(1) as f64 * (1.0 - spent / m));
    let power = |at: usize| f64::from(r[at]).powi(2);
    let total: f64 = pixels.iter().map(|&at| power(at)).sum();

    let instants = evidence.camera.instants();
    let count = evidence.camera.time().instants().len();
    let of_instants = Lines::new(&pixels, count, |at| instants[at / columns], power);
    let of_columns = Lines::new(&pixels, columns, |at| at % columns, power);
    let stands_out = |at: usize| usable(at) && power(at) > OUTLIER * OUTLIER;
    let lone = |at: usize| {
        let x = at % columns;
        let has_neighbour =
            (x > 0 && stands_out(at - 1)) || (x + 1 < columns && stands_out(at + 1));
        stands_out(at) && !has_neighbour
    };
    let lone: Vec<usize> = pixels.iter().copied().filter(|&at| lone(at)).collect();
    let without_lone = total - lone.iter().map(|&at| power(at)).sum::<f64>();

    let noise_count = evidence.bands.noise_count();
    let value = |at: usize| f64::from(r[at]);
    let correlation = |step: usize, limit: usize| {
        let pairs = (0..r.len() - step.min(r.len()))
            .filter(|&at| (step != 1 || at % columns < limit) && usable(at) && usable(at + step));
        let (mut sum, mut n) = (0.0, 0usize);
        pairs.for_each(|at| {
            sum += value(at) * value(at + step);
            n += 1;
        });
        sum / n.max(1) as f64 / (total / m).max(f64::MIN_POSITIVE)
    };
    FitStatistics {
        chi_squared: chi(total, pixels.len()),
        chi_squared_error: (2.0 / (m - spent)).sqrt(),
        residual_over_frame: total.sqrt()
            / rowburst_core::vecmath::norm(evidence.measured).max(f64::MIN_POSITIVE),
        freedom: evidence.degrees_of_freedom / m,
        noise_floor: (noise_count >= 8)
            .then(|| evidence.bands.noise_rms(value))
            .flatten(),
        // Of a median of exponential powers, as an rms.
        noise_floor_error: 0.72 / (noise_count.max(1) as f64).sqrt(),
        noise_band_is_dark: evidence.bands.leak() < MAX_LEAK,
        passed_level: evidence.bands.passed_rms(value),
        correlation_x: correlation(1, columns - 1),
        correlation_y: if rows > 1 {
            correlation(columns, columns)
        } else {
            0.0
        },
        correlation_with_model: correlation_with_model(evidence, &pixels),
        misfit_instants: (of_instants.misfits.len(), count),
        worst_instant: of_instants.worst(),
        misfit_columns: (of_columns.misfits.len(), columns),
        worst_column: of_columns.worst(),
        chi_squared_without: TrimmedChiSquared {
            instants: chi(of_instants.rest.0, of_instants.rest.1),
            columns: chi(of_columns.rest.0, of_columns.rest.1),
            pixels: chi(without_lone, pixels.len() - lone.len()),
        },
        lone_pixels: lone.len(),
        residual_trend: trend(evidence.residual_history),
        mirrored: mirrored(evidence.camera, evidence.video),
        fine_ratio: fine_ratio_of_frame(
            evidence.measured,
            evidence.weights,
            evidence.camera,
            evidence.bands,
        ),
        tests_timing: tests_timing(evidence.camera),
    }
}

/// See [`FitStatistics::fine_ratio`]; `measured` is `W b/σ` and `weights` is `W`, `[y, x]`.
pub(super) fn fine_ratio_of_frame(
    measured: &[f32],
    weights: Option<&[f32]>,
    camera: &Camera,
    bands: &Bands,
) -> Option<f64> {
    if bands.leak() >= MAX_LEAK || camera.time().instants().len() < 2 {
        return None;
    }
    let usable = |at: usize| weights.is_none_or(|w| w[at] > 0.0);
    fine_ratio(measured, camera.rows(), camera.columns(), usable)
}

fn fine_ratio(
    measured: &[f32],
    rows: usize,
    columns: usize,
    usable: impl Fn(usize) -> bool,
) -> Option<f64> {
    let detail = without_line_means(measured, rows, columns, &usable);
    let weights: Vec<f32> = (0..measured.len())
        .map(|at| f32::from(u8::from(usable(at))))
        .collect();
    let turned = |values: &[f32]| -> Vec<f32> {
        let pixels = (0..columns).flat_map(|x| (0..rows).map(move |y| y * columns + x));
        pixels.map(|at| values[at]).collect()
    };
    let level = |rows, columns, values: Vec<f32>, weights: &[f32]| {
        let image = Image::new(rows, columns, values).ok()?;
        Bands::without_optics(&image, Some(weights)).fine_rms(|at| f64::from(image.data()[at]))
    };
    let across = level(columns, rows, turned(&detail), &turned(&weights))?;
    let along = level(rows, columns, detail, &weights)?;
    Some(across / along.max(f64::MIN_POSITIVE))
}

/// The usable pixels without the mean of their row and of their column; 0 elsewhere.
fn without_line_means(
    measured: &[f32],
    rows: usize,
    columns: usize,
    usable: impl Fn(usize) -> bool,
) -> Vec<f32> {
    let mut values: Vec<f64> = (0..measured.len())
        .map(|at| {
            if usable(at) {
                f64::from(measured[at])
            } else {
                0.0
            }
        })
        .collect();
    let mut subtract_means = |count: usize, line_of: &dyn Fn(usize) -> usize| {
        let mut sums = vec![(0.0, 0usize); count];
        for at in (0..values.len()).filter(|&at| usable(at)) {
            let sum = &mut sums[line_of(at)];
            *sum = (sum.0 + values[at], sum.1 + 1);
        }
        for at in (0..values.len()).filter(|&at| usable(at)) {
            let (sum, n) = sums[line_of(at)];
            values[at] -= sum / n as f64;
        }
    };
    subtract_means(rows, &|at| at / columns);
    subtract_means(columns, &|at| at % columns);
    values.into_iter().map(|v| v as f32).collect()
}

/// Sums of `r²` over instants or columns.
struct Lines {
    mean: Vec<f64>,
    misfits: Vec<usize>,
    /// Sum and number of pixels of all other lines.
    rest: (f64, usize),
}

impl Lines {
    fn new(
        pixels: &[usize],
        lines: usize,
        line_of: impl Fn(usize) -> usize,
        power: impl Fn(usize) -> f64,
    ) -> Self {
        let mut sums = vec![(0.0, 0usize); lines];
        for &at in pixels {
            let sum = &mut sums[line_of(at)];
            *sum = (sum.0 + power(at), sum.1 + 1);
        }
        let is_misfit = |(sum, n): (f64, usize)| n > 0 && sum / n as f64 > limit_of_line(n);
        let (mut misfits, mut rest) = (Vec::new(), (0.0, 0));
        for (line, &sum) in sums.iter().enumerate() {
            if is_misfit(sum) {
                misfits.push(line);
            } else {
                rest = (rest.0 + sum.0, rest.1 + sum.1);
            }
        }
        let mean = sums.iter().map(|(sum, n)| sum / (*n).max(1) as f64);
        Self {
            mean: mean.collect(),
            misfits,
            rest,
        }
    }

    fn worst(&self) -> (usize, f64) {
        let all = self.mean.iter().copied().enumerate();
        all.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0, 0.0))
    }
}

fn correlation_with_model(evidence: &FitInput, pixels: &[usize]) -> f64 {
    let r = evidence.normalised_residual.data();
    let (mut both, mut residual, mut model) = (0.0, 0.0, 0.0);
    for &at in pixels {
        let (r, b) = (f64::from(r[at]), f64::from(evidence.measured[at]));
        let a = b - r;
        both += r * a;
        residual += r * r;
        model += a * a;
    }
    both / (residual * model).sqrt().max(f64::MIN_POSITIVE)
}

fn trend(residual_history: &[f64]) -> f64 {
    let Some(&last) = residual_history.last() else {
        return 1.0;
    };
    let before = residual_history[(residual_history.len() * 4 / 5).min(residual_history.len() - 1)];
    if before > 0.0 { last / before } else { 1.0 }
}

/// Whether two rows see the same bin.
fn tests_timing(camera: &Camera) -> bool {
    !camera.time().is_disjoint() || camera.instants().len() > camera.time().instants().len()
}

/// See [`FitStatistics::mirrored`].
fn mirrored(camera: &Camera, video: &Video) -> Option<f64> {
    // Halves of which one is later have instants of their own.
    let one_row_each =
        !camera.shutter().is_dual() && camera.instants().len() == camera.time().instants().len();
    let bins = video.shape().bins;
    if !one_row_each || bins < MIN_MIRRORED_BINS {
        return None;
    }
    let small: Vec<Vec<f64>> = (0..bins).map(|t| small_picture(video, t)).collect();
    let norms: Vec<f64> = small.iter().map(|p| dot(p, p).sqrt()).collect();
    let brightest = norms.iter().copied().fold(0.0, f64::max);
    let likeness = |a: usize, b: usize| {
        let both_lit = norms[a].min(norms[b]) > 0.05 * brightest;
        both_lit.then(|| dot(&small[a], &small[b]) / (norms[a] * norms[b]))
    };
    let (mut excess, mut pairs) = (0.0, 0usize);
    for a in 0..bins / 2 {
        let lag = bins - 1 - 2 * a;
        let Some(found) = likeness(a, a + lag).filter(|_| lag >= NEAREST) else {
            continue;
        };
        let others: Vec<f64> = (0..bins - lag)
            .filter(|s| s.abs_diff(a) >= NEAREST / 2)
            .step_by(((bins - lag) / COMPARISONS).max(1))
            .filter_map(|s| likeness(s, s + lag))
            .collect();
        if !others.is_empty() {
            excess += found - others.iter().sum::<f64>() / others.len() as f64;
            pairs += 1;
        }
    }
    (pairs >= MIN_MIRRORED_BINS / 4).then(|| excess / pairs as f64)
}

/// Bin `t` in blocks, at most [`SMALL`] along a side.
fn small_picture(video: &Video, t: usize) -> Vec<f64> {
    let shape = video.shape();
    let block = shape.rows.max(shape.columns).div_ceil(SMALL);
    let width = shape.columns.div_ceil(block);
    let mut small = vec![0.0; width * shape.rows.div_ceil(block)];
    let bin = &video.data()[t * shape.pixels()..(t + 1) * shape.pixels()];
    for (y, row) in bin.chunks_exact(shape.columns).enumerate() {
        for (x, &v) in row.iter().enumerate() {
            small[y / block * width + x / block] += f64::from(v);
        }
    }
    small
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_core::Shape;
    use rowburst_optics::camera::CameraParams;
    use rowburst_optics::{Sensor, Shutter};

    fn camera(shutter: Shutter, exposure_us: f64) -> Camera {
        Camera::new(CameraParams {
            rows: 32,
            columns: 8,
            shutter,
            row_time_us: 10.0,
            exposure_us,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap()
    }

    /// A dot in each bin, at `place(t)`.
    fn dots(bins: usize, place: impl Fn(usize) -> usize) -> Video {
        let mut video = Video::zeros(Shape::new(bins, 32, 8));
        for t in 0..bins {
            video.bin_mut(t)[place(t)] = 1.0;
        }
        video
    }

    #[test]
    fn rows_that_are_read_one_after_the_other_differ_across() {
        // Smooth along x, another picture in each row; a strong offset of each column besides.
        let value = |y: usize, x: usize| {
            let phase = (y * y * 37 % 101) as f64;
            (0.2 * x as f64 + phase).sin() + (x * x * 53 % 89) as f64
        };
        let (rows, columns) = (40, 48);
        let noise = |at: usize| 1e-3 * ((at * 7919 % 1009) as f64 / 1009.0 - 0.5);
        let frame: Vec<f32> = (0..rows * columns)
            .map(|at| (value(at / columns, at % columns) + noise(at)) as f32)
            .collect();
        let turned: Vec<f32> = (0..rows * columns)
            .map(|at| frame[at % rows * columns + at / rows])
            .collect();
        assert!(fine_ratio(&frame, rows, columns, |_| true).unwrap() > 10.0);
        assert!(fine_ratio(&turned, columns, rows, |_| true).unwrap() < 0.1);
        let white: Vec<f32> = (0..rows * columns)
            .map(|at| (noise(at) * 1e3) as f32)
            .collect();
        let ratio = fine_ratio(&white, rows, columns, |at| at != 77).unwrap();
        assert!((0.7..1.4).contains(&ratio), "{ratio}");
    }

    #[test]
    fn a_video_that_runs_back_and_forth_is_mirrored() {
        let single = camera(Shutter::TopDown, 10.0);
        let forth = dots(32, |t| 8 * t);
        let back = dots(32, |t| 8 * t.min(31 - t));
        assert_eq!(mirrored(&single, &forth), Some(0.0));
        assert_eq!(mirrored(&single, &back), Some(1.0));
        // Not a sign of anything where nothing moves, or where two rows are read at once.
        let still = dots(32, |_| 77);
        assert!(mirrored(&single, &still).unwrap().abs() < 1e-12);
        let dual = camera(Shutter::DualInsideOut, 10.0);
        assert_eq!(mirrored(&dual, &dots(16, |t| t)), None);
    }

    #[test]
    fn timing_is_tested_where_two_rows_see_a_bin() {
        assert!(!tests_timing(&camera(Shutter::TopDown, 10.0)));
        assert!(tests_timing(&camera(Shutter::TopDown, 15.0)));
        assert!(tests_timing(&camera(Shutter::DualInsideOut, 10.0)));
        assert!(tests_timing(&camera(Shutter::Global, 10.0)));
    }

    #[test]
    fn the_trend_is_that_of_the_last_fifth() {
        assert_eq!(trend(&[]), 1.0);
        let falling: Vec<f64> = (0..10).map(|k| 10.0 - f64::from(k)).collect();
        assert_eq!(trend(&falling), 0.5);
    }

    #[test]
    fn lines_that_stand_out_are_named() {
        let pixels: Vec<usize> = (0..300).collect();
        let power = |at: usize| if at % 30 == 4 { 9.0 } else { 1.0 };
        let lines = Lines::new(&pixels, 30, |at| at % 30, power);
        assert_eq!(lines.misfits, [4]);
        assert_eq!(lines.worst(), (4, 9.0));
        assert_eq!(lines.rest, (290.0, 290));
    }
}
