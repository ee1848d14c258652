//! Smooth stray light: a reflection, or a lamp that shines past the diffuser.
//!
//! It is a part of the frame that belongs to no scene, and a video absorbs it as far as it can. So both are fitted at once,
//! as in [`WithStrayLight`]: first with smooth stray light everywhere, which shows where there is any, then with splines at
//! these places alone, since light that varies from row to row only may also be that of a scene that changes. The stray
//! light is taken away from the frame if the video then predicts held-out pixels better (docs/design/020).

use super::frame_data::{StrayLightFit, WithStrayLight};
use super::held_out_check::{DENSE_SUPPORT, HeldOutCheck};
use super::{Observer, Prior, Problem, RunResult, foreign};
use faer::linalg::solvers::SolveLstsq;
use faer::{Col, Mat};
use rowburst_core::linop::Background;
use rowburst_core::vecmath::norm_squared;
use rowburst_optics::Image;
use rowburst_optics::measurement::Measurement;
use rowburst_solve::StopReason;
use rowburst_solve::admm::{Admm, Progress, TauRule};
use std::f64::consts::PI;
use tracing::{debug, info};

/// Cosines along each side of the frame of which the first fit makes the stray light; more take scenes for stray light.
const COSINES: usize = 12;
/// Splines along the shorter side of the frame; more follow sharper reflections and leave less of the scene.
const SPLINES: f64 = 15.0;
/// Fewest pixels between two splines; fewer follow single pixels.
const MIN_SPACING: f64 = 4.0;
/// Iterations of a fit; in more a video of few places gives its light to the stray light.
const ITERATIONS: usize = 40;
/// Iterations of the last fit where that does not explain the frame; fewer leave stray light beside a few bright places.
const REFIT_ITERATIONS: usize = 80;
/// Most fits with splines; more find few further places.
const MAX_FITS: usize = 4;
/// Brightness over the scale of all pixels above which a pixel has stray light; smaller takes errors of the fit for it.
const MIN_LIGHT: f64 = 4.0;
/// Brightness over that of the brightest pixel above which a pixel has stray light; smaller takes light of dense scenes for it.
const MIN_PART: f64 = 0.1;
/// The same where no pixel exceeds the scale, which wide stray light raises; smaller takes errors of the fit for it.
const MIN_PART_OF_WIDE: f64 = 0.5;
/// The same of what a fit with splines leaves, where splines are added; larger leaves the edges of a reflection.
const MIN_PART_LEFT: f64 = 0.02;
/// Brightness of the brightest pixel over the held-out error above which stray light may cause that error; smaller searches
/// where the PSF is wrong.
const MIN_BRIGHTEST: f64 = 3.0;
/// Part of the stray light that is below 0 at most, in absolute values: light adds to the frame, and what foreign pixels and
/// a wrong PSF leave has both signs. Larger takes that for stray light.
const MAX_NEGATIVE_PART: f64 = 0.15;
/// Held-out error without the stray light over that before, below which it is believed; larger believes in what explains
/// little.
const MAX_ERROR_RATIO: f64 = 0.75;
/// The same before PSF and camera have been corrected; larger takes a wrong gain for stray light.
const MAX_EARLY_ERROR_RATIO: f64 = 0.4;
/// The same of a dense scene, whose error is mostly that of the video.
const MAX_DENSE_ERROR_RATIO: f64 = 0.95;
/// Most corrections of the stray light by what a check leaves of it.
const MAX_CORRECTIONS: usize = 8;
/// Held-out error after such a correction over the least before, above which it was in vain; larger corrects longer.
const MIN_CORRECTION: f64 = 0.98;
/// Corrections in vain, one after the other, after which no more are made: the error falls unevenly.
const MAX_IN_VAIN: usize = 2;
/// Most elements of a fit's patterns, 256 MiB; frames with more pixels are too large for the search.
const MAX_ELEMENTS: usize = 1 << 25;
/// Shortest side of a frame for the search, in pixels; in smaller ones the patterns are as many as the details of the scene.
const MIN_SIDE: usize = 24;
/// Fewest pixels with weight for each spline; fewer are fitted whatever they show.
const MIN_PIXELS: usize = 4;
/// Power of a spline at pixels with weight over its whole power, below which it is left out: no pixel tells its strength.
const MIN_OBSERVED: f64 = 1e-5;

impl Problem {
    /// Looks for smooth stray light, where `before` is the check of a model that does not explain the frame. Takes it away
    /// from the frame and returns whether it is believed. `is_bright`: a loose fit has shown that there may be much of it.
    ///
    /// The error is the last check of a run that the observer stopped; the frame is then as it was.
    pub(super) fn take_stray_light(
        &mut self,
        before: &HeldOutCheck,
        is_bright: bool,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        if !self.looks_for_stray_light() || self.is_explained(before) {
            return Ok(false);
        }
        let (measurement, was_dense) = (self.measurement.clone(), self.is_dense);
        let last_check = self.last_check.take();
        let tried = self.try_stray_light(before, is_bright, prior, observer);
        if matches!(tried, Ok(true)) {
            return tried;
        }
        self.stray_light = None;
        self.is_dense = was_dense;
        self.set_measurement(measurement);
        match (tried, last_check) {
            (Err(stopped), Some(mut check)) => {
                // The residual of a fit lacks the stray light, so it is no measure of a result.
                check.solution.stop_reason = stopped.solution.stop_reason;
                Err(check)
            }
            (tried, last_check) => {
                self.last_check = last_check;
                tried
            }
        }
    }

    /// Whether smooth stray light may be looked for: once, in frames for which the patterns have room.
    pub(super) fn looks_for_stray_light(&self) -> bool {
        self.options.self_calibration.finds_stray_light()
            && self.stray_light.is_none()
            && Frame::of(self).is_suitable()
    }

    fn try_stray_light(
        &mut self,
        before: &HeldOutCheck,
        is_bright: bool,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<bool, Box<RunResult>> {
        let least = if is_bright {
            0.0
        } else {
            MIN_BRIGHTEST * before.held_out_rms
        };
        let Some(mut found) = self.find_stray_light(least, prior, observer)? else {
            return Ok(false);
        };
        let may_be_dense = is_bright && before.support_fraction > DENSE_SUPPORT;
        let max_ratio = if self.is_dense || may_be_dense {
            MAX_DENSE_ERROR_RATIO
        } else if is_bright {
            MAX_EARLY_ERROR_RATIO
        } else {
            MAX_ERROR_RATIO
        };
        let light = std::mem::take(&mut found.light);
        found.light.resize(light.len(), 0.0);
        self.stray_light = Some(found);
        self.subtract(&light);
        self.add_stray_light(&light);
        let mut after = self.held_out_check(prior, observer)?;
        if after.held_out_rms < max_ratio * before.held_out_rms {
            after = self.refit_stray_light(after, prior, observer)?;
            after = self.correct_stray_light(after, prior, observer)?;
        }
        let ratio = after.held_out_rms / before.held_out_rms;
        let mut light = self
            .stray_light
            .as_ref()
            .map_or_else(Vec::new, |found| found.light.clone());
        darken(&mut light, &self.is_usable());
        let negative = negative_part(&light);
        info!(
            "without smooth stray light, {:.1} % of it below 0: held-out error {:.3} σ, {ratio:.3} times that before",
            100.0 * negative,
            after.held_out_rms / self.sigma
        );
        Ok(ratio < max_ratio && negative <= MAX_NEGATIVE_PART)
    }

    /// Takes `light` away from the frame.
    fn subtract(&mut self, light: &[f32]) {
        self.set_measurement(self.measurement.without_light(light));
    }

    /// Replaces the frame by one with other counts and the same weights.
    pub(super) fn set_measurement(&mut self, measurement: Measurement) {
        self.measurement = measurement;
        let kept = self.measurement.without(&self.excluded);
        self.data.set_noise(kept.noise().cloned());
        self.exclude(self.excluded.clone());
    }

    /// Whether each pixel has a weight and is not left out.
    fn is_usable(&self) -> Vec<bool> {
        let weights = self.measurement.weights();
        let has_weight = |i: usize| weights.is_none_or(|w| w[i] > 0.0);
        let pixels = self.excluded.iter().enumerate();
        pixels.map(|(i, e)| !e && has_weight(i)).collect()
    }

    /// The stray light; `None`: there is none.
    fn find_stray_light(
        &mut self,
        least_brightest: f64,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<Option<StrayLight>, Box<RunResult>> {
        let frame = Frame::of(self);
        let is_usable = self.is_usable();
        let usable_count = is_usable.iter().filter(|usable| **usable).count();
        let cosines = frame.cosines();
        let everywhere = self.fit_stray_light(&cosines, ITERATIONS, prior, observer)?;
        let mut map = frame.without_row_levels(&everywhere.stray_light);
        darken(&mut map, &is_usable);
        let brightest = largest(&map);
        if brightest < least_brightest {
            return Ok(None);
        }
        let mut has_light = brightest_places(&map);
        let mut found: Option<StrayLight> = None;
        for _ in 0..MAX_FITS {
            let knots = frame.knots(&has_light, &is_usable);
            let area = has_light.iter().filter(|has| **has).count();
            debug!("stray light at {area} pixels, {} splines", knots.len());
            if found.as_ref().is_some_and(|found| found.knots == knots) {
                break;
            }
            if knots.is_empty()
                || MIN_PIXELS * knots.len() > usable_count
                || has_light.len() * knots.len() > MAX_ELEMENTS
            {
                return Ok(None);
            }
            let fit = self.fit_stray_light(&frame.splines(&knots), ITERATIONS, prior, observer)?;
            if fit.stray_light.iter().any(|light| !light.is_finite()) {
                return Ok(None);
            }
            let mut seen = fit.stray_light.clone();
            darken(&mut seen, &is_usable);
            // The first places may be errors of the fit beside the stray light.
            if found.is_some() && negative_part(&seen) > MAX_NEGATIVE_PART {
                return Ok(None);
            }
            let brightest = largest(&seen);
            let left = frame.without_row_levels(&smooth_part(&cosines, &fit.rest));
            has_light = bright_pixels(&left, MIN_PART_LEFT * brightest);
            for (light, has_light) in seen.iter().zip(&mut has_light) {
                *has_light |= f64::from(*light) > MIN_PART * brightest;
            }
            found = Some(StrayLight {
                frame,
                light: fit.stray_light,
                knots,
            });
        }
        Ok(found)
    }

    /// Fits a video and stray light of `patterns`, `[pixel, pattern]`, to the frame. The held-out pixels belong to it: they are
    /// many more than the patterns, and without weights of their own the solver is faster.
    fn fit_stray_light(
        &mut self,
        patterns: &Mat<f64>,
        iterations: usize,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<StrayLightFit, Box<RunResult>> {
        let prior = match prior.background() {
            Background::None => prior,
            _ => Prior::STANDARD,
        };
        self.data.reset(prior.background(), None);
        let shape = self.data.shape();
        let rule = TauRule::Discrepancy { sigma: self.sigma };
        let params = prior.admm_params(shape, rule, self.options.solver_settings().of_a_search());
        let mut prox = self.data.prox(&prior);
        let video_form = self.data.video_form(prior.background());
        let mut data = WithStrayLight::new(&mut self.data, patterns);
        let mut run = Admm::new(&data, shape, params);
        let reason = run.run(&mut data, &mut *prox, iterations, &mut |progress| {
            let progress = Progress {
                label: "looking for stray light",
                max_iterations: iterations,
                ..*progress
            };
            video_form.observe(&progress, observer)
        });
        if matches!(reason, StopReason::TimeBudget | StopReason::Interrupted) {
            let solution = run.into_solution(&data, &*prox, reason);
            return Err(Box::new(RunResult::new(prior, solution)));
        }
        Ok(data.fit(run.video()))
    }

    /// Where `check` does not explain the frame, fits what is left of the stray light in more iterations: a few bright places
    /// settle slowly. Returns the check that holds then.
    fn refit_stray_light(
        &mut self,
        check: HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let Some(found) = self.stray_light.as_ref() else {
            return Ok(check);
        };
        if self.is_explained(&check) {
            return Ok(check);
        }
        let patterns = found.patterns();
        let more = self.fit_stray_light(&patterns, REFIT_ITERATIONS, prior, observer)?;
        let before = self.measurement.clone();
        self.subtract(&more.stray_light);
        let refitted = self.held_out_check(prior, observer)?;
        debug!(
            "stray light fitted again: held-out error {:.3} σ",
            refitted.held_out_rms / self.sigma
        );
        if refitted.held_out_rms < check.held_out_rms {
            self.add_stray_light(&more.stray_light);
            return Ok(refitted);
        }
        self.set_measurement(before);
        Ok(check)
    }

    /// Adds to the stray light what the video of `check` leaves of it, as long as the held-out error falls: a fit has
    /// not settled, and the model may have been corrected since. Returns the check that holds then.
    pub(super) fn correct_stray_light(
        &mut self,
        mut check: HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        let Some(found) = self.stray_light.as_ref() else {
            return Ok(check);
        };
        let patterns = found.patterns();
        let is_usable = self.is_usable();
        let part = |i: usize| f64::from(u8::from(is_usable[i]));
        let factors = Mat::from_fn(patterns.nrows(), patterns.ncols(), |i, j| {
            part(i) * patterns[(i, j)]
        })
        .qr();
        // The frame of `check`, and what was taken away since.
        let mut best = (self.measurement.clone(), vec![0.0; patterns.nrows()]);
        let (mut light, mut taken) = (check.light.clone(), best.1.clone());
        let mut in_vain = 0;
        for _ in 0..MAX_CORRECTIONS {
            if self.is_explained(&check) || in_vain >= MAX_IN_VAIN {
                break;
            }
            let measured = self.measurement.image().data();
            let left = |i: usize| part(i) * f64::from(measured[i] - light[i]);
            let strengths = factors.solve_lstsq(Col::from_fn(measured.len(), left));
            let more: Vec<f32> = (&patterns * strengths).iter().map(|m| *m as f32).collect();
            self.subtract(&more);
            taken.iter_mut().zip(&more).for_each(|(t, m)| *t += m);
            let next = match self.held_out_check(prior, observer) {
                Ok(next) => next,
                Err(stopped) => {
                    self.set_measurement(best.0);
                    self.add_stray_light(&best.1);
                    return Err(stopped);
                }
            };
            debug!(
                "stray light corrected: held-out error {:.3} σ",
                next.held_out_rms / self.sigma
            );
            light.clone_from(&next.light);
            let falls = next.held_out_rms < MIN_CORRECTION * check.held_out_rms;
            in_vain = if falls { 0 } else { in_vain + 1 };
            if next.held_out_rms < check.held_out_rms || self.is_explained(&next) {
                best = (self.measurement.clone(), taken.clone());
                check = next;
            }
        }
        self.set_measurement(best.0);
        self.add_stray_light(&best.1);
        Ok(check)
    }

    /// Adds light of the corrected frame to the stray light of the frame as given.
    fn add_stray_light(&mut self, more: &[f32]) {
        let gain = self.calibration.as_ref().map(|c| c.gain.as_slice());
        let light = self.stray_light.iter_mut().flat_map(|s| &mut s.light);
        for (i, (light, more)) in light.zip(more).enumerate() {
            *light += gain.map_or(1.0, |g| g[i]) * more;
        }
    }
}

/// Smooth stray light of a frame.
pub(super) struct StrayLight {
    frame: Frame,
    /// In counts, `[y, x]`.
    light: Vec<f32>,
    /// The splines of which it is made.
    knots: Vec<Knot>,
}

impl StrayLight {
    /// In counts, `[y, x]`.
    pub fn image(&self) -> Image {
        let Frame { rows, columns } = self.frame;
        Image::new(rows, columns, self.light.clone()).expect("the size of the frame")
    }

    /// Its patterns, `[pixel, spline]`.
    fn patterns(&self) -> Mat<f64> {
        self.frame.splines(&self.knots)
    }
}

/// Part of the power of `residual`, `[y, x]`, that may be smooth stray light.
pub(super) fn smooth_part_of(residual: &[f32], shape: (usize, usize)) -> f64 {
    let (rows, columns) = shape;
    let frame = Frame { rows, columns };
    if residual.is_empty() || !frame.is_suitable() {
        return 0.0;
    }
    let smooth = frame.without_row_levels(&smooth_part(&frame.cosines(), residual));
    norm_squared(&smooth) / norm_squared(residual).max(f64::MIN_POSITIVE)
}

/// Row and column of a spline.
type Knot = (i32, i32);

/// The pixels of a frame.
#[derive(Clone, Copy)]
struct Frame {
    rows: usize,
    columns: usize,
}

impl Frame {
    fn of(problem: &Problem) -> Self {
        let (rows, columns) = problem.data.shutter().frame_shape();
        Self { rows, columns }
    }

    /// Whether the frame is large enough for the search and its patterns have room.
    fn is_suitable(self) -> bool {
        self.rows.min(self.columns) >= MIN_SIDE
            && self.rows * self.columns * COSINES * COSINES <= MAX_ELEMENTS
    }

    /// The lowest cosines over the frame, `[pixel, cosine]`.
    fn cosines(self) -> Mat<f64> {
        let wave = |frequency: usize, at: usize, length: usize| {
            (PI * frequency as f64 * (at as f64 + 0.5) / length as f64).cos()
        };
        self.products(COSINES * COSINES, |j| {
            (
                move |y, rows| wave(j / COSINES, y, rows),
                move |x, columns| wave(j % COSINES, x, columns),
            )
        })
    }

    /// Cubic B-splines at `knots`, `[pixel, spline]`.
    fn splines(self, knots: &[Knot]) -> Mat<f64> {
        let spacing = self.spacing();
        let at = move |knot: i32, at: usize| cubic_b_spline(at as f64 / spacing - f64::from(knot));
        self.products(knots.len(), |j| {
            let (row, column) = knots[j];
            (move |y, _| at(row, y), move |x, _| at(column, x))
        })
    }

    /// `count` patterns, each a product of a function of the row and one of the column.
    fn products<Y: Fn(usize, usize) -> f64, X: Fn(usize, usize) -> f64>(
        self,
        count: usize,
        functions: impl Fn(usize) -> (Y, X),
    ) -> Mat<f64> {
        let mut patterns = Mat::zeros(self.rows * self.columns, count);
        for (j, mut pattern) in patterns.col_iter_mut().enumerate() {
            let (of_row, of_column) = functions(j);
            let line: Vec<f64> = (0..self.columns)
                .map(|x| of_column(x, self.columns))
                .collect();
            for y in 0..self.rows {
                let factor = of_row(y, self.rows);
                for (x, value) in line.iter().enumerate() {
                    pattern[y * self.columns + x] = factor * value;
                }
            }
        }
        patterns
    }

    /// Pixels between two splines.
    fn spacing(self) -> f64 {
        (self.rows.min(self.columns) as f64 / SPLINES).max(MIN_SPACING)
    }

    /// The splines with a centre less than a spacing from a pixel with light, and with enough of their power at usable pixels.
    fn knots(self, has_light: &[bool], is_usable: &[bool]) -> Vec<Knot> {
        let spacing = self.spacing();
        let last = |length: usize| (length as f64 / spacing).ceil() as i32 + 1;
        let near = |knot: i32, length: usize| {
            // A spline beyond the edge is one of the edge.
            let centre = (f64::from(knot) * spacing).clamp(0.0, length as f64 - 1.0);
            let from = (centre - spacing).floor() as i64 + 1;
            let to = (centre + spacing).ceil() as i64;
            from.max(0) as usize..to.min(length as i64) as usize
        };
        let all =
            (-1..=last(self.rows)).flat_map(|a| (-1..=last(self.columns)).map(move |b| (a, b)));
        let is_near_light = |(a, b): &Knot| {
            near(*a, self.rows).any(|y| {
                let line = &has_light[y * self.columns..][..self.columns];
                line[near(*b, self.columns)].contains(&true)
            })
        };
        let near_light: Vec<Knot> = all.filter(is_near_light).collect();
        let splines = self.splines(&near_light);
        let whole = (151.0 / 315.0 * spacing).powi(2);
        let observed = |j: usize| {
            let pairs = splines.col(j).iter().zip(is_usable);
            pairs
                .filter(|(_, usable)| **usable)
                .map(|(b, _)| b * b)
                .sum::<f64>()
        };
        let kept = (0..near_light.len()).filter(|&j| observed(j) > MIN_OBSERVED * whole);
        kept.map(|j| near_light[j]).collect()
    }

    /// `light` without the median of each row: what all of a row has may also be light of the scene at its instant.
    fn without_row_levels(self, light: &[f32]) -> Vec<f32> {
        let mut result = light.to_vec();
        for row in result.chunks_exact_mut(self.columns) {
            let mut sorted = row.to_vec();
            let middle = self.columns / 2;
            let median = *sorted.select_nth_unstable_by(middle, f32::total_cmp).1;
            row.iter_mut().for_each(|light| *light -= median);
        }
        result
    }
}

/// The central B-spline of degree three.
fn cubic_b_spline(x: f64) -> f64 {
    let x = x.abs();
    if x < 1.0 {
        2.0 / 3.0 - x * x + x * x * x / 2.0
    } else {
        (2.0 - x).max(0.0).powi(3) / 6.0
    }
}

/// The part of `values` in the span of `cosines`, which are orthogonal.
fn smooth_part(cosines: &Mat<f64>, values: &[f32]) -> Vec<f32> {
    let values = Col::from_fn(values.len(), |i| f64::from(values[i]));
    let mut strengths = cosines.transpose() * values;
    for (strength, cosine) in strengths.iter_mut().zip(cosines.col_iter()) {
        *strength /= cosine.squared_norm_l2();
    }
    (cosines * strengths).iter().map(|v| *v as f32).collect()
}

/// Where the fit with stray light everywhere shows some.
fn brightest_places(map: &[f32]) -> Vec<bool> {
    let bright = bright_pixels(map, MIN_PART * largest(map));
    if bright.contains(&true) {
        bright
    } else {
        brighter(map, MIN_PART_OF_WIDE * largest(map))
    }
}

/// The pixels with more than `least` light that are brighter than the scale of all allows.
fn bright_pixels(light: &[f32], least: f64) -> Vec<bool> {
    let mut sizes: Vec<f64> = light.iter().map(|l| f64::from(l.abs())).collect();
    brighter(
        light,
        (MIN_LIGHT * foreign::robust_scale(&mut sizes)).max(least),
    )
}

fn brighter(light: &[f32], limit: f64) -> Vec<bool> {
    light.iter().map(|l| f64::from(*l) > limit).collect()
}

/// Sets `light` to 0 at pixels that are not usable.
fn darken(light: &mut [f32], is_usable: &[bool]) {
    let pixels = light.iter_mut().zip(is_usable);
    pixels
        .filter(|(_, usable)| !**usable)
        .for_each(|(light, _)| *light = 0.0);
}

/// The part of `light` below 0, in absolute values.
fn negative_part(light: &[f32]) -> f64 {
    let sum = |of: fn(f32) -> f32| light.iter().map(|l| f64::from(of(*l))).sum::<f64>();
    let (negative, all) = (sum(|l| (-l).max(0.0)), sum(f32::abs));
    negative / all.max(f64::MIN_POSITIVE)
}

fn largest(light: &[f32]) -> f64 {
    f64::from(light.iter().copied().fold(0.0, f32::max))
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME: Frame = Frame {
        rows: 45,
        columns: 60,
    };

    fn close(found: &[f32], expected: &[f32]) {
        let pairs = found.iter().zip(expected);
        let worst = pairs.map(|(f, e)| (f - e).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-4, "{worst}");
    }

    #[test]
    fn splines_add_up_to_even_light() {
        let everywhere = vec![true; FRAME.rows * FRAME.columns];
        let splines = FRAME.splines(&FRAME.knots(&everywhere, &everywhere));
        let sum = &splines * Col::<f64>::ones(splines.ncols());
        assert!(sum.iter().all(|s| (s - 1.0).abs() < 1e-12));
    }

    #[test]
    fn splines_follow_a_reflection() {
        let spot: Vec<f32> = (0..FRAME.rows * FRAME.columns)
            .map(|i| {
                let (y, x) = (i / FRAME.columns, i % FRAME.columns);
                let square = (y as f32 - 20.0).powi(2) + (x as f32 - 25.0).powi(2);
                (-square / 50.0).exp()
            })
            .collect();
        let all = vec![true; spot.len()];
        let knots = FRAME.knots(&bright_pixels(&spot, MIN_PART_LEFT), &all);
        assert!(knots.len() < FRAME.knots(&all, &all).len());
        let splines = FRAME.splines(&knots);
        let values = Col::from_fn(spot.len(), |i| f64::from(spot[i]));
        let fitted = &splines * splines.qr().solve_lstsq(values);
        let errors = fitted.iter().zip(&spot).map(|(f, s)| *f as f32 - s);
        let worst = errors.map(f32::abs).fold(0.0, f32::max);
        assert!(worst < 0.01, "{worst}");
    }

    #[test]
    fn the_smooth_part_is_that_of_the_lowest_cosines() {
        let wave = |f: f64, at: usize, n: usize| (PI * f * (at as f64 + 0.5) / n as f64).cos();
        let light = |f: f64, g: f64| -> Vec<f32> {
            let at = |i: usize| {
                let (y, x) = (i / FRAME.columns, i % FRAME.columns);
                (wave(f, y, FRAME.rows) * wave(g, x, FRAME.columns)) as f32
            };
            (0..FRAME.rows * FRAME.columns).map(at).collect()
        };
        let cosines = FRAME.cosines();
        let (low, high) = (light(3.0, 11.0), light(12.0, 2.0));
        let sum: Vec<f32> = low.iter().zip(&high).map(|(l, h)| l + h).collect();
        close(&smooth_part(&cosines, &sum), &low);
        let shape = (FRAME.rows, FRAME.columns);
        assert!((smooth_part_of(&sum, shape) - 0.5).abs() < 0.01);
        // What all of a row has may be light of the scene.
        assert!(smooth_part_of(&light(3.0, 0.0), shape) < 1e-6);
        assert_eq!(smooth_part_of(&[], shape), 0.0);
    }

    #[test]
    fn places_of_narrow_and_of_wide_light_are_found() {
        let spot = |width: f32| -> Vec<f32> {
            let square = |i: usize| ((i as f32 - 50.0) / width).powi(2);
            (0..100).map(|i| (-square(i) / 2.0).exp()).collect()
        };
        let count = |map: &[f32]| brightest_places(map).iter().filter(|b| **b).count();
        assert_eq!(count(&spot(4.0)), 17);
        assert_eq!(count(&spot(30.0)), 71);
        assert_eq!(count(&[0.0; 100]), 0);
    }

    #[test]
    fn light_below_zero_has_a_part() {
        assert_eq!(negative_part(&[1.0, -1.0, 2.0]), 0.25);
        assert_eq!(negative_part(&[0.0, 3.0]), 0.0);
        assert_eq!(negative_part(&[]), 0.0);
    }

    /// A spline without a pixel with weight has no strength that a fit could find.
    #[test]
    fn splines_of_pixels_without_weight_are_left_out() {
        for (rows, columns) in [(100, 134), (84, 90), (45, 60)] {
            let frame = Frame { rows, columns };
            let all = vec![true; rows * columns];
            let is_usable: Vec<bool> = (0..all.len()).map(|i| i % columns < columns / 2).collect();
            for usable in [&all, &is_usable] {
                let splines = frame.splines(&frame.knots(&all, usable));
                for spline in splines.col_iter() {
                    let values = spline.iter().zip(usable);
                    assert!(values.filter(|(_, u)| **u).any(|(b, _)| *b > 1e-4));
                }
            }
        }
    }
}
