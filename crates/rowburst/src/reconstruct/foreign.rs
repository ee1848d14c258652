//! Foreign pixels: pixels of the frame that no video explains, such as hot pixels, dust or a printed caption.
//!
//! A fit to the noise level absorbs them, and then no residual stands out. A loose fit cannot: so the noise level of
//! the discrepancy principle falls from half the light of the frame to a twentieth of it, each run continues from the
//! last one, and a pixel with a large residual is replaced by what the video predicts. All pixels are judged anew every
//! few iterations, so a pixel may come back. Other large residuals are bounded, as in a robust fit (Hampel 1974):
//! foreign pixels that are not found yet would force a loose fit to absorb them, too. Fainter ones are found by the
//! rounds of `exclusion` (docs/design/020).

use super::SolverSettings;
use super::frame_data::FrameData;
use super::{Prior, RunResult};
use rowburst_optics::measurement::Measurement;
use rowburst_solve::DataTerm;
use rowburst_solve::StopReason;
use rowburst_solve::admm::{Admm, AdmmParams, Progress, TauRule};
use std::ops::ControlFlow;

/// Last noise level over the light of the frame; smaller takes what has not settled for foreign.
const LAST_LEVEL: f64 = 0.05;
/// Noise level over the light of the frame below which a video must reach it; larger stops before faint pixels are found,
/// smaller takes what has not settled for foreign.
const FINE_LEVEL: f64 = 0.2;
/// Scale of the residual over the noise level up to which the video has reached it.
const REACHED_RATIO: f64 = 1.2;
/// Noise level over the residual that the last one left; smaller absorbs foreign pixels.
const LEVEL_RATIO: f64 = 0.5;
/// Iterations between two looks at the residual.
const STEP_ITERATIONS: usize = 5;
/// Such steps at each level; fewer judge videos that have not settled.
const LEVEL_STEPS: usize = 4;
/// Residual over its scale above which its influence on the fit no longer grows; larger lets foreign pixels pull.
const BOUNDED_RESIDUAL: f64 = 2.0;
/// Residual over its scale from which a pixel is foreign; smaller takes the tails of a wrong PSF for foreign pixels.
const FOREIGN_RESIDUAL: f64 = 5.0;
/// Least scale of the residual over the noise level of the run; smaller judges by what a run has overfitted.
const MIN_SCALE: f64 = 0.3;
/// Groups of pixels of similar predicted light, each with its own scale; more follow the noise of few pixels.
const LIGHT_GROUPS: usize = 8;
/// Foreign neighbours of a foreign pixel from which its other neighbours are left out, too; fewer grow hot pixels.
const MIN_FOREIGN_NEIGHBOURS: usize = 2;
/// Part of an instant's pixels above which its light is new to the video rather than foreign; smaller misses large
/// captions.
const MAX_EXCLUDED_OF_INSTANT: f64 = 0.4;
/// Part of the pixels above which the model is wrong rather than the pixels.
const MAX_EXCLUDED: f64 = 0.3;
/// Standard deviation of Gaussian noise over its median magnitude.
const SIGMA_OVER_MEDIAN: f64 = 1.4826;
/// Part of an instant's pixels whose residuals give its scale; smaller stands more foreign pixels and is less exact.
const LOW_QUANTILE: f64 = 0.3;
/// That quantile of the magnitude of Gaussian noise over its standard deviation.
const LOW_QUANTILE_OVER_SIGMA: f64 = 0.3853;
/// Part of a row's pixels that is darker than its light is judged by; smaller stands more bright pixels, larger dark ones.
const DARK_PART: f64 = 0.2;
/// That quantile over the median light of the frame from which a row is bright; smaller takes more rows for bright, in
/// which faint foreign pixels are missed.
const BRIGHT_ROW: f64 = 2.0;
/// Scale of an instant over the noise level above which its video has not settled; larger bounds the light of the scene.
const UNSETTLED_RATIO: f64 = 3.0;
/// Fewest pixels of an instant that give it a scale.
const MIN_INSTANT_PIXELS: usize = 20;

/// The prior of the search: it assumes little, so that it suits any scene.
const PRIOR: Prior = Prior::STANDARD.without_support();

/// Foreign pixels, and the noise level at which they were found.
pub(super) struct Foreign {
    /// Whether each pixel is foreign.
    pub pixels: Vec<bool>,
    /// In counts.
    pub level: f64,
    /// Whether the video followed the noise level to the end: foreign pixels may be all that is wrong.
    pub is_followed: bool,
    /// What the loosest fit leaves, weighted, `[y, x]`; empty: none was made.
    pub loose_residual: Vec<f32>,
}

/// Finds the bright foreign pixels of the frame in `data`, down to the noise level `least_level`, with the faint pixels
/// at their edges. `instants` has the instant of each row. The error is the result so far of a run that the observer stopped.
pub(super) fn find(
    data: &mut FrameData,
    instants: &[usize],
    lines: &BrokenLines,
    least_level: f64,
    observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
) -> Result<Foreign, Box<RunResult>> {
    data.reset(PRIOR.background(), None);
    let shape = data.shape();
    let measured = data.measurements().to_vec();
    let (is_usable, columns) = (data.usable(), data.shutter().frame_shape().1);
    let factors = row_factors(&measured, columns, &is_usable);
    let pixels = Pixels {
        measured: &measured,
        is_usable: &is_usable,
        instants,
    };
    let judge = |fitted: &[f32], excluded: &[bool], level: f64| {
        let scales = Scales::Loose {
            level,
            factors: &factors,
        };
        let mut residual = Residual::new(pixels, fitted, excluded, scales);
        keep_bright_instants(&mut residual.is_foreign, pixels);
        lines.apply(&mut residual.is_foreign);
        residual
    };
    let mut robust = judge(&vec![0.0; measured.len()], &lines.is_broken, 0.0);
    let light = SIGMA_OVER_MEDIAN * median_light(&measured, &is_usable);
    let last_level = least_level.max(LAST_LEVEL * light);
    let mut level = last_level.max(LEVEL_RATIO * light);
    let rule = |sigma: f64| TauRule::Discrepancy { sigma };
    let params = AdmmParams {
        // Each level is another problem, so no certificate stops a run.
        tolerance: 0.0,
        ..PRIOR.admm_params(shape, rule(level), SolverSettings::default().of_a_search())
    };
    let mut prox = data.prox(&PRIOR);
    let mut run = Admm::new(data, shape, params);
    let video_form = data.video_form(PRIOR.background());
    // The last level that the video could follow: the scale of its residual and the foreign pixels.
    let mut best = (f64::INFINITY, lines.is_broken.clone());
    let mut is_first = true;
    let mut loose_residual = None;
    let is_followed = loop {
        if !is_first {
            run.set_tau_rule(rule(level), data);
            // As for another frame: the threshold follows the brightness of the new level's video.
            run.warm_start(data);
        }
        is_first = false;
        for step in 1..=LEVEL_STEPS {
            data.set_measurements(robust.bounded());
            let reason = run.run(data, &mut *prox, step * STEP_ITERATIONS, &mut |progress| {
                let progress = Progress {
                    label: "looking for foreign pixels",
                    ..*progress
                };
                video_form.observe(&progress, observer)
            });
            if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
                let solution = run.into_solution(data, &*prox, reason);
                return Err(Box::new(RunResult::new(PRIOR, solution)));
            }
            robust = judge(run.fitted(), &robust.is_foreign, level);
        }
        loose_residual.get_or_insert_with(|| difference(&measured, run.fitted()));
        let has_diverged = robust.typical_scale > best.0.max(level);
        let is_unsettled =
            robust.typical_scale > REACHED_RATIO * level && level < FINE_LEVEL * light;
        if has_diverged || is_unsettled {
            break false;
        }
        best = (robust.typical_scale, robust.is_foreign.clone());
        if level <= last_level {
            break true;
        }
        level = last_level.max(LEVEL_RATIO * level.min(robust.typical_scale));
    };
    data.set_measurements(measured.clone());
    let (level, found) = best;
    Ok(Foreign {
        pixels: plausible(&found, columns),
        level,
        is_followed,
        loose_residual: loose_residual.unwrap_or_default(),
    })
}

/// The foreign pixels with their edges; none where they are too many to be foreign.
fn plausible(found: &[bool], columns: usize) -> Vec<bool> {
    let count = found.iter().filter(|foreign| **foreign).count();
    if count as f64 > MAX_EXCLUDED * found.len() as f64 {
        vec![false; found.len()]
    } else {
        with_edges(found, columns)
    }
}

fn difference(minuend: &[f32], subtrahend: &[f32]) -> Vec<f32> {
    minuend.iter().zip(subtrahend).map(|(m, s)| m - s).collect()
}

/// Takes the pixels of instants back of which most are foreign: a loose fit has not reached the light of a flash.
fn keep_bright_instants(is_foreign: &mut [bool], pixels: Pixels) {
    let instants = pixels.instants;
    let columns = is_foreign.len() / instants.len();
    let count = instants.iter().max().map_or(0, |last| last + 1);
    let (mut foreign, mut usable) = (vec![0usize; count], vec![0usize; count]);
    for (i, is_foreign) in is_foreign.iter().enumerate() {
        foreign[instants[i / columns]] += usize::from(*is_foreign);
        usable[instants[i / columns]] += usize::from(pixels.is_usable[i]);
    }
    for (i, is_foreign) in is_foreign.iter_mut().enumerate() {
        let instant = instants[i / columns];
        if foreign[instant] as f64 > MAX_EXCLUDED_OF_INSTANT * usable[instant] as f64 {
            *is_foreign = false;
        }
    }
}

/// Adds the neighbours of foreign pixels that are not alone: the edges of printed letters are faint.
fn with_edges(is_foreign: &[bool], columns: usize) -> Vec<bool> {
    let rows = is_foreign.len() / columns;
    let mut grown = is_foreign.to_vec();
    for i in (0..is_foreign.len()).filter(|&i| is_grouped(is_foreign, columns, i)) {
        neighbours(i, rows, columns).for_each(|n| grown[n] = true);
    }
    grown
}

/// Whether the foreign pixels are mostly not alone.
fn are_grouped(is_foreign: &[bool], columns: usize) -> bool {
    let foreign = (0..is_foreign.len()).filter(|&i| is_foreign[i]);
    let (grouped, alone): (Vec<usize>, Vec<usize>) =
        foreign.partition(|&i| is_grouped(is_foreign, columns, i));
    grouped.len() > alone.len()
}

/// Whether pixel `i` is foreign and not alone.
fn is_grouped(is_foreign: &[bool], columns: usize, i: usize) -> bool {
    let near = neighbours(i, is_foreign.len() / columns, columns);
    is_foreign[i] && near.filter(|n| is_foreign[*n]).count() >= MIN_FOREIGN_NEIGHBOURS
}

/// The up to eight neighbours of pixel `i`.
fn neighbours(i: usize, rows: usize, columns: usize) -> impl Iterator<Item = usize> {
    let (y, x) = (i / columns, i % columns);
    let near_rows = y.saturating_sub(1)..(y + 2).min(rows);
    let near = near_rows.flat_map(move |y| {
        (x.saturating_sub(1)..(x + 2).min(columns)).map(move |x| y * columns + x)
    });
    near.filter(move |n| *n != i)
}

/// How much brighter than the typical light each row is as a whole, at least 1: in a flash whole rows are bright. A bright
/// caption leaves the darkest pixels of a row as they are.
fn row_factors(measured: &[f32], columns: usize, is_usable: &[bool]) -> Vec<f64> {
    let bright = BRIGHT_ROW * median_light(measured, is_usable);
    let rows = measured.chunks(columns).zip(is_usable.chunks(columns));
    let factor = |(values, usable): (&[f32], &[bool])| {
        let usable = values.iter().zip(usable).filter(|(_, usable)| **usable);
        let mut light: Vec<f64> = usable.map(|(b, _)| f64::from(b.abs())).collect();
        (quantile(&mut light, DARK_PART) / bright.max(f64::MIN_POSITIVE)).max(1.0)
    };
    rows.map(factor).collect()
}

/// Median of the light of the usable pixels.
fn median_light(measured: &[f32], is_usable: &[bool]) -> f64 {
    let usable = measured
        .iter()
        .zip(is_usable)
        .filter(|(_, usable)| **usable);
    let mut light: Vec<f64> = usable.map(|(b, _)| f64::from(b.abs())).collect();
    quantile(&mut light, 0.5)
}

/// `W(b − A v)` with its scale at each pixel.
pub(super) struct Residual<'a> {
    measured: &'a [f32],
    /// `W(b − A v)`.
    residual: Vec<f64>,
    scale: Vec<f64>,
    /// The scale of all pixels together.
    typical_scale: f64,
    /// The scale of each instant.
    of_instants: Vec<f64>,
    /// Whether each pixel is foreign: its residual is far above its scale.
    pub is_foreign: Vec<bool>,
}

/// A weighted frame.
#[derive(Clone, Copy)]
pub(super) struct Pixels<'a> {
    /// `W b`.
    pub measured: &'a [f32],
    /// Whether each pixel has a weight above zero.
    pub is_usable: &'a [bool],
    /// The instant of each row.
    pub instants: &'a [usize],
}

/// How the scale of a residual depends on the place of its pixel.
#[derive(Clone, Copy)]
pub(super) enum Scales<'a> {
    /// Of a loose fit: at least [`MIN_SCALE`] of the noise level `level`, times the factor of the row.
    Loose { level: f64, factors: &'a [f64] },
    /// Of a fit to the noise level `level`: at least [`MIN_SCALE`] of it, and that of the pixels of the same instant;
    /// infinite where the video of the instant has not settled.
    Fitting { level: f64 },
    /// Of a video that has settled: at least that of the same instant, and for excluded pixels `excluded_scale`, since a
    /// video predicts pixels that it has not seen less exactly. The scale of excluded pixels is multiplied by `factor`.
    Settled { excluded_scale: f64, factor: f64 },
}

impl<'a> Residual<'a> {
    /// The scale of a pixel is that of the pixels of similar light that are not `excluded`, adapted to its place.
    pub fn new(pixels: Pixels<'a>, fitted: &[f32], excluded: &[bool], scales: Scales) -> Self {
        let Pixels {
            measured,
            is_usable,
            instants,
        } = pixels;
        let columns = measured.len() / instants.len();
        let pairs = measured.iter().zip(fitted);
        let residual: Vec<f64> = pairs.map(|(b, a)| f64::from(*b) - f64::from(*a)).collect();
        let sizes_of = |pixels: &mut dyn Iterator<Item = usize>| -> Vec<f64> {
            let kept = pixels.filter(|&i| is_usable[i] && !excluded[i]);
            kept.map(|i| residual[i].abs()).collect()
        };
        let (mut scale, typical_scale) = scales_by_light(fitted, is_usable, &sizes_of);
        let of_instants = scales_of_instants(instants, columns, &sizes_of);
        for (i, scale) in scale.iter_mut().enumerate() {
            let row = i / columns;
            *scale = match scales {
                Scales::Loose { level, factors } => scale.max(MIN_SCALE * level) * factors[row],
                Scales::Fitting { level } => match of_instants[instants[row]] {
                    of_instant if of_instant > UNSETTLED_RATIO * level => f64::INFINITY,
                    of_instant => scale.max(MIN_SCALE * level).max(of_instant),
                },
                Scales::Settled {
                    excluded_scale,
                    factor,
                } if excluded[i] => {
                    factor * scale.max(of_instants[instants[row]]).max(excluded_scale)
                }
                Scales::Settled { .. } => scale.max(of_instants[instants[row]]),
            };
        }
        let is_foreign = (0..residual.len())
            .map(|i| is_usable[i] && residual[i].abs() > FOREIGN_RESIDUAL * scale[i]);
        Self {
            is_foreign: is_foreign.collect(),
            measured,
            residual,
            scale,
            typical_scale,
            of_instants,
        }
    }

    /// Of each instant whose video has not settled, the pixels of the row with the most foreign and `excluded` ones: its other
    /// rows may tell what the scene was like. None where most foreign pixels are alone: a caption has more pixels than are
    /// found, and where lone ones are found, it is something else that has not settled.
    pub fn unsettled_rows(&self, instants: &[usize], excluded: &[bool]) -> Vec<bool> {
        let columns = excluded.len() / instants.len();
        let foreign = self.is_foreign.iter().zip(excluded);
        let is_foreign: Vec<bool> = foreign.map(|(foreign, e)| *foreign || *e).collect();
        let mut is_in_row = vec![false; excluded.len()];
        if !are_grouped(&is_foreign, columns) {
            return is_in_row;
        }
        let pixels_of = |row: usize| row * columns..(row + 1) * columns;
        let count = |row: usize| pixels_of(row).filter(|&i| is_foreign[i]).count();
        for (instant, scale) in self.of_instants.iter().enumerate() {
            if *scale <= UNSETTLED_RATIO * self.typical_scale {
                continue;
            }
            let rows = (0..instants.len()).filter(|&row| instants[row] == instant);
            let mut counts: Vec<(usize, usize)> = rows.map(|row| (count(row), row)).collect();
            counts.sort_unstable();
            if let [.., (second, _), (most, row)] = counts[..]
                && most > second
            {
                is_in_row[pixels_of(row)].fill(true);
            }
        }
        is_in_row
    }

    /// The measurements with the influence of large residuals bounded (Hampel 1974), and foreign ones replaced by what
    /// the video predicts. A fit to these is a robust fit to the measurements.
    pub fn bounded(&self) -> Vec<f32> {
        let bounded = |i: usize| {
            let (size, scale) = (self.residual[i].abs(), self.scale[i]);
            // All of a small residual counts, less of a larger one, nothing of a foreign one.
            let fading = (FOREIGN_RESIDUAL * scale - size) / (FOREIGN_RESIDUAL - BOUNDED_RESIDUAL);
            let counted = if self.is_foreign[i] || size >= FOREIGN_RESIDUAL * scale {
                0.0
            } else {
                size.min(BOUNDED_RESIDUAL * fading.min(scale))
            };
            let excess = (size - counted) * self.residual[i].signum();
            self.measured[i] - excess as f32
        };
        (0..self.measured.len()).map(bounded).collect()
    }
}

/// The scale of each instant by a low quantile of its residuals; 0 where it has few pixels.
fn scales_of_instants(
    instants: &[usize],
    columns: usize,
    sizes_of: &dyn Fn(&mut dyn Iterator<Item = usize>) -> Vec<f64>,
) -> Vec<f64> {
    let count = instants.iter().max().map_or(0, |last| last + 1);
    let scale_of = |instant: usize| {
        let rows = (0..instants.len()).filter(|&row| instants[row] == instant);
        let mut sizes = sizes_of(&mut rows.flat_map(|row| row * columns..(row + 1) * columns));
        match sizes.len() {
            0..MIN_INSTANT_PIXELS => 0.0,
            _ => quantile(&mut sizes, LOW_QUANTILE) / LOW_QUANTILE_OVER_SIGMA,
        }
    };
    (0..count).map(scale_of).collect()
}

/// The scale of each pixel by those of similar light, and that of all pixels. It grows at most with the root of the
/// light, as shot noise does: a caption that a video has begun to fit would raise its own scale.
fn scales_by_light(
    light: &[f32],
    is_usable: &[bool],
    sizes_of: &dyn Fn(&mut dyn Iterator<Item = usize>) -> Vec<f64>,
) -> (Vec<f64>, f64) {
    let mut order: Vec<usize> = (0..light.len()).filter(|&i| is_usable[i]).collect();
    order.sort_unstable_by(|&i, &j| light[i].total_cmp(&light[j]).then(i.cmp(&j)));
    let scale_of = |pixels: &[usize]| robust_scale(&mut sizes_of(&mut pixels.iter().copied()));
    let light_of = |pixels: &[usize]| {
        pixels
            .get(pixels.len() / 2)
            .map_or(0.0, |&i| f64::from(light[i]))
    };
    let (typical_scale, typical_light) = (scale_of(&order), light_of(&order));
    let mut scale = vec![0.0; light.len()];
    for group in order.chunks(order.len().div_ceil(LIGHT_GROUPS).max(1)) {
        let relative_light = light_of(group) / typical_light.max(f64::MIN_POSITIVE);
        let max_scale = typical_scale * relative_light.max(1.0).sqrt();
        let of_group = scale_of(group).clamp(typical_scale, max_scale);
        group.iter().for_each(|&i| scale[i] = of_group);
    }
    (scale, typical_scale)
}

/// Lines that no scene makes: rows and columns with the same value in every pixel, or with the values of their
/// neighbour, as dead and dropped lines have.
pub(super) struct BrokenLines {
    /// Whether each pixel is in such a line.
    pub is_broken: Vec<bool>,
    /// Whether each pixel is in another row of the same instant: its bins have too few rows to tell foreign pixels.
    has_broken_partner: Vec<bool>,
}

impl BrokenLines {
    /// Finds them in `measurement`; `instants` has the instant of each row. A dark row is one only where another row of
    /// its instant sees light.
    pub fn new(measurement: &Measurement, instants: &[usize]) -> Self {
        let image = measurement.image();
        let (rows, columns) = (image.rows(), image.columns());
        let row = |y: usize| (0..columns).map(move |x| y * columns + x);
        let column = |x: usize| (0..rows).map(move |y| y * columns + x);
        let is_usable = |i: &usize| measurement.weights().is_none_or(|w| w[*i] > 0.0);
        let is_constant = |line: &mut dyn Iterator<Item = usize>| {
            let mut values = line.filter(is_usable).map(|i| image.data()[i]);
            let first = values.next();
            let mut rest = values.peekable();
            rest.peek().is_some() && rest.all(|v| Some(v) == first)
        };
        let constant_rows: Vec<bool> = (0..rows).map(|y| is_constant(&mut row(y))).collect();
        let partners = |y: usize| (0..rows).filter(move |&p| p != y && instants[p] == instants[y]);
        let is_copy = |y: usize| {
            y > 0
                && !constant_rows[y]
                && row(y).all(|i| image.data()[i] == image.data()[i - columns])
        };
        let is_broken_row =
            |y: usize| is_copy(y) || constant_rows[y] && partners(y).any(|p| !constant_rows[p]);
        let (mut is_broken, mut has_broken_partner) =
            (vec![false; rows * columns], vec![false; rows * columns]);
        for y in (0..rows).filter(|&y| is_broken_row(y)) {
            row(y).for_each(|i| is_broken[i] = true);
            partners(y)
                .flat_map(row)
                .for_each(|i| has_broken_partner[i] = true);
        }
        for x in (0..columns).filter(|&x| is_constant(&mut column(x))) {
            column(x).for_each(|i| is_broken[i] = true);
        }
        Self {
            is_broken,
            has_broken_partner,
        }
    }

    /// Adds the broken lines to the foreign pixels, and takes those of rows with a broken partner away.
    fn apply(&self, is_foreign: &mut [bool]) {
        for (i, foreign) in is_foreign.iter_mut().enumerate() {
            *foreign = self.is_broken[i] || *foreign && !self.has_broken_partner[i];
        }
    }
}

/// Standard deviation of Gaussian residuals of these `sizes`, by their median.
pub(super) fn robust_scale(sizes: &mut [f64]) -> f64 {
    SIGMA_OVER_MEDIAN * quantile(sizes, 0.5)
}

/// The value below which this part of `values` lies; 0 without values.
fn quantile(values: &mut [f64], part: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((part * values.len() as f64) as usize).min(values.len() - 1);
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_optics::Image;

    const COLUMNS: usize = 40;

    /// A pattern without outliers: 0.5 to 1.5.
    fn speckle(i: usize) -> f32 {
        0.5 + (i * 7919 % 101) as f32 / 100.0
    }

    #[test]
    fn dead_and_copied_lines_are_broken() {
        let instants = [1, 0, 0, 1];
        let frame = |y: usize, x: usize| match (y, x) {
            (1, _) | (_, 7) => 0.0,
            (3, x) => speckle(2 * COLUMNS + x),
            (y, x) => speckle(y * COLUMNS + x),
        };
        let measurement = Measurement::new(Image::from_fn(4, COLUMNS, frame)).unwrap();
        let lines = BrokenLines::new(&measurement, &instants);
        for y in 0..4 {
            for x in 0..COLUMNS {
                let is_broken = y == 1 || y == 3 || x == 7;
                assert_eq!(lines.is_broken[y * COLUMNS + x], is_broken, "{y}, {x}");
            }
        }
        // Rows 0 and 2 are the partners of rows 3 and 1: nothing else is judged there.
        let mut foreign = vec![true; 4 * COLUMNS];
        lines.apply(&mut foreign);
        assert_eq!(foreign, lines.is_broken);
        // Both rows of an instant without light are a dark bin, not dead lines.
        let dark = Image::from_fn(4, COLUMNS, |y, x| match y {
            1 | 2 => 0.0,
            _ => speckle(y * COLUMNS + x),
        });
        let dark = BrokenLines::new(&Measurement::new(dark).unwrap(), &instants);
        assert!(!dark.is_broken.contains(&true));
    }

    #[test]
    fn large_residuals_are_foreign_and_bounded() {
        let rows = 20;
        let mut measured: Vec<f32> = (0..rows * COLUMNS).map(speckle).collect();
        // A flash lights a whole row; a hot pixel stands out.
        measured[5 * COLUMNS..6 * COLUMNS]
            .iter_mut()
            .for_each(|b| *b *= 20.0);
        measured[3 * COLUMNS + 11] = 30.0;
        let is_usable = vec![true; measured.len()];
        let factors = row_factors(&measured, COLUMNS, &is_usable);
        assert!(factors[5] > 3.0 && factors.iter().enumerate().all(|(y, f)| y == 5 || *f == 1.0));
        let scales = Scales::Loose {
            level: 0.0,
            factors: &factors,
        };
        let none = vec![false; measured.len()];
        let dark = vec![0.0; measured.len()];
        let pixels = Pixels {
            measured: &measured,
            is_usable: &is_usable,
            instants: &[0; 20],
        };
        let residual = Residual::new(pixels, &dark, &none, scales);
        let found: Vec<usize> = (0..measured.len())
            .filter(|&i| residual.is_foreign[i])
            .collect();
        assert_eq!(found, [3 * COLUMNS + 11]);
        let bounded = residual.bounded();
        assert_eq!(bounded[3 * COLUMNS + 11], 0.0);
        assert_eq!(bounded[0], measured[0]);
        assert!(bounded.iter().zip(&measured).all(|(b, m)| b <= m));
    }

    #[test]
    fn the_most_covered_row_of_an_unsettled_instant_is_doubtful() {
        // Rows 1 and 2 see instant 0, whose residuals are ten times those of the others.
        let (rows, instants) = (6, [2, 0, 0, 1, 1, 2]);
        let factor = |row: usize| if instants[row] == 0 { 10.0 } else { 1.0 };
        let measured: Vec<f32> = (0..rows * COLUMNS)
            .map(|i| speckle(i) * factor(i / COLUMNS))
            .collect();
        let pixels = Pixels {
            measured: &measured,
            is_usable: &vec![true; rows * COLUMNS],
            instants: &instants,
        };
        let scales = Scales::Settled {
            excluded_scale: 0.0,
            factor: 1.0,
        };
        let doubtful_rows = |is_excluded: &dyn Fn(usize) -> bool| -> Vec<usize> {
            let excluded: Vec<bool> = (0..rows * COLUMNS).map(is_excluded).collect();
            let residual = Residual::new(pixels, &vec![0.0; rows * COLUMNS], &excluded, scales);
            let found = residual.unsettled_rows(&instants, &excluded);
            let is_left_out =
                |row: &usize| found[row * COLUMNS..(row + 1) * COLUMNS].iter().all(|f| *f);
            (0..rows).filter(is_left_out).collect()
        };
        // Letters in row 2 and, where all has settled, in row 4.
        assert_eq!(
            doubtful_rows(&|i| matches!(i / COLUMNS, 2 | 4) && i % COLUMNS < 6),
            [2]
        );
        // As many in both rows of the instant: none is more doubtful.
        assert!(doubtful_rows(&|i| matches!(i / COLUMNS, 1 | 2) && i % COLUMNS < 6).is_empty());
        // Lone pixels in row 2.
        assert!(doubtful_rows(&|i| i / COLUMNS == 2 && i % 6 == 0).is_empty());
    }

    #[test]
    fn a_flash_is_not_foreign_and_the_edges_of_letters_are() {
        let rows = 6;
        let (measured, is_usable) = (vec![1.0; rows * COLUMNS], vec![true; rows * COLUMNS]);
        let pixels = Pixels {
            measured: &measured,
            is_usable: &is_usable,
            instants: &[2, 1, 0, 0, 1, 2],
        };
        // Both rows of instant 1 are lit; a letter stands in row 0, a hot pixel in row 5.
        let mut is_foreign: Vec<bool> = (0..rows * COLUMNS)
            .map(|i| matches!(i / COLUMNS, 1 | 4) || (8..11).contains(&i) || i == 5 * COLUMNS + 30)
            .collect();
        keep_bright_instants(&mut is_foreign, pixels);
        let found: Vec<usize> = (0..is_foreign.len()).filter(|&i| is_foreign[i]).collect();
        assert_eq!(found, [8, 9, 10, 5 * COLUMNS + 30]);
        let grown = with_edges(&is_foreign, COLUMNS);
        let found: Vec<usize> = (0..grown.len()).filter(|&i| grown[i]).collect();
        let below = [COLUMNS + 8, COLUMNS + 9, COLUMNS + 10];
        assert_eq!(
            found,
            [&[8, 9, 10], &below[..], &[5 * COLUMNS + 30]].concat()
        );
    }

    #[test]
    fn quantiles_are_of_sorted_values() {
        let mut values = vec![5.0, 1.0, 4.0, 2.0, 3.0];
        assert_eq!(quantile(&mut values, 0.5), 3.0);
        assert_eq!(quantile(&mut values, 0.0), 1.0);
        assert_eq!(quantile(&mut values, 1.0), 5.0);
        assert_eq!(quantile(&mut [], 0.5), 0.0);
    }
}
