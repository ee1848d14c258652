//! Rows that were left out as a whole, since a caption covers a part of them and it is not known which.
//!
//! Such a row is left out where its pixels keep the video of its instant from settling, see [`Residual::unsettled_rows`].
//! The other row of the instant may be too few measurements for a video that predicts any of its pixels, so none comes
//! back. But printed letters are brighter or darker than most of the scene's light. A forward search starts with a part of
//! the row, its brightest pixels and then its darkest, reconstructs, and keeps more and more of those pixels that the video
//! predicts best (Hadi 1992; steps of one size as in FAST-LTS, Rousseeuw and Van Driessen 2006). Rows of dual shutters only
//! (docs/design/020).
//!
//! [`Residual::unsettled_rows`]: super::foreign::Residual::unsettled_rows

use super::exclusion::{Rounds, count, negligible_count};
use super::held_out_check::{HeldOutCheck, MAX_RESIDUAL};
use super::{Observer, Prior, Problem, RunResult};
use tracing::debug;

/// Part of a row's pixels above which it counts as left out as a whole; smaller tries rows again whose instant is known.
const COVERED_PART: f64 = 0.8;
/// Residual of the check over `σ` above which no row is tried: there is something else that the video does not explain.
const MAX_RESIDUAL_BEFORE: f64 = 5.0;
/// Parts of a row that are kept, one after the other; finer steps take longer, larger first ones begin with letters.
const KEPT_PARTS: [f64; 8] = [0.3, 0.3, 0.4, 0.4, 0.5, 0.5, 0.6, 0.7];
/// Least of them that is chosen; a video absorbs fewer pixels whatever they are.
const LEAST_CHOSEN: f64 = 0.4;
/// Least part of a row that comes back in the end, for the same reason.
const MIN_KEPT: f64 = 0.3;
/// Noise level of these steps over `σ`; larger tells the scene's pixels less well, smaller absorbs those of a caption.
const SEARCH_LEVEL: f64 = 4.0;
/// Residual of an instant over that level from which on the video does not explain it.
const MAX_INSTANT_RESIDUAL: f64 = 3.0;
/// Residual of an instant over `σ` up to which the video explains the pixels that are kept.
const MAX_EXPLAINED_RESIDUAL: f64 = 1.6;
/// Most rounds that keep fewer pixels until it does.
const TRIM_ROUNDS: usize = 8;
/// Part of the kept pixels of a row that such a round keeps.
const KEPT_PER_ROUND: f64 = 0.92;
/// Held-out error over that before, at pixels that were kept before, up to which pixels come back. Other pixels are held out, so
/// smaller loses rows by chance.
const MAX_ERROR_RATIO: f64 = 1.1;
/// Factors on the limit of a residual below which further pixels come back at the end.
const READMISSIONS: [f64; 2] = [1.0, 1.0];

/// Pixels of a covered row that may be the scene's.
#[derive(Clone, Copy, Debug)]
enum Guess {
    Brightest,
    Darkest,
}

/// A row most of which is left out.
struct CoveredRow {
    /// Its pixels, without those that have no weight and those of broken lines.
    pixels: Vec<usize>,
    /// The pixels of both rows of its instant, without those that have no weight.
    of_instant: Vec<usize>,
}

impl CoveredRow {
    /// Keeps the pixels with the smallest values of `rank_by` and leaves the others out.
    fn keep(&self, kept: usize, rank_by: &[f64], excluded: &mut [bool]) {
        let mut pixels = self.pixels.clone();
        pixels.sort_unstable_by(|&i, &j| rank_by[i].total_cmp(&rank_by[j]).then(i.cmp(&j)));
        let pixels = pixels.into_iter().enumerate();
        pixels.for_each(|(at, i)| excluded[i] = at >= kept);
    }

    fn leave_out(&self, excluded: &mut [bool]) {
        self.pixels.iter().for_each(|&i| excluded[i] = true);
    }

    fn part(&self, part: f64) -> usize {
        (part * self.pixels.len() as f64) as usize
    }

    fn kept_count(&self, excluded: &[bool]) -> usize {
        self.pixels.iter().filter(|i| !excluded[**i]).count()
    }

    /// Root mean square of the residuals `sizes` at the pixels of the instant that are not `excluded`.
    fn residual_rms(&self, sizes: &[f64], excluded: &[bool]) -> f64 {
        let kept = self.of_instant.iter().filter(|i| !excluded[**i]);
        let (count, sum) = kept.fold((0, 0.0), |(n, sum), &i| (n + 1, sum + sizes[i].powi(2)));
        (sum / f64::from(count.max(1))).sqrt()
    }
}

impl Problem {
    /// Tries the rows again that were left out as a whole. Their pixels stay out unless the model then explains the frame
    /// with more pixels.
    pub(super) fn retry_covered_rows(
        &mut self,
        mut check: HeldOutCheck,
        broken: &[bool],
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        // Where rows share bins each of the checks takes seconds, and other rows see the same light.
        if self.data.is_coupled() {
            return Ok(check);
        }
        for guess in [Guess::Brightest, Guess::Darkest] {
            let before = self.excluded.clone();
            let rows = self.covered_rows(&before, broken);
            if rows.is_empty() || check.residual_rms > MAX_RESIDUAL_BEFORE * self.sigma {
                break;
            }
            let (sigma, effective_sigma, is_dense) =
                (self.sigma, self.effective_sigma, self.is_dense);
            let tried = self.retry_from(guess, &rows, &check, broken, prior, observer);
            self.is_dense = is_dense;
            match tried {
                Ok(Some(next))
                    if next.residual_rms <= MAX_RESIDUAL * self.sigma.min(sigma)
                        && next.held_out_rms_without(&before)
                            <= MAX_ERROR_RATIO * check.held_out_rms
                        && count(&self.excluded) + negligible_count(&before) < count(&before) =>
                {
                    debug!(
                        "{} covered rows from their {guess:?} pixels on: {} pixels left out instead of {}",
                        rows.len(),
                        count(&self.excluded),
                        count(&before)
                    );
                    check = next;
                }
                tried => {
                    self.exclude(before);
                    self.effective_sigma = effective_sigma;
                    tried?;
                }
            }
        }
        Ok(check)
    }

    /// Tries the `rows` again from `guess` on; `None`: no video explains a part of one.
    fn retry_from(
        &mut self,
        guess: Guess,
        rows: &[CoveredRow],
        check: &HeldOutCheck,
        broken: &[bool],
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<Option<HeldOutCheck>, Box<RunResult>> {
        let excluded = self.with_partners_left_out(rows, check);
        let rows = self.covered_rows(&excluded, broken);
        let mut excluded = self.with_more_pixels(guess, &rows, excluded, prior, observer)?;
        self.trim(&mut excluded, &rows, prior, observer)?;
        if rows.iter().all(|row| row.kept_count(&excluded) == 0) {
            return Ok(None);
        }
        self.settle(excluded, &rows, broken, prior, observer)
            .map(Some)
    }

    /// Rows of which most pixels are left out, without broken lines, where the other row of the instant is kept.
    fn covered_rows(&self, excluded: &[bool], broken: &[bool]) -> Vec<CoveredRow> {
        let instants = self.camera.instants();
        let columns = self.excluded.len() / instants.len();
        let weights = self.measurement.weights();
        let pixels_of = |row: usize| {
            let pixels = row * columns..(row + 1) * columns;
            pixels.filter(|&i| weights.is_none_or(|w| w[i] > 0.0))
        };
        let count_of = |row: usize, is_in: &dyn Fn(usize) -> bool| {
            pixels_of(row).filter(|&i| is_in(i)).count() as f64
        };
        let part = |row: usize, mask: &[bool]| {
            count_of(row, &|i| mask[i]) / count_of(row, &|_| true).max(1.0)
        };
        let is_covered =
            |row: usize| part(row, excluded) > COVERED_PART && part(row, broken) < COVERED_PART;
        let is_seen =
            |row: usize| count_of(row, &|i| !excluded[i]) > (1.0 - COVERED_PART) * columns as f64;
        let partner = |row: usize| {
            let mut others =
                (0..instants.len()).filter(|&o| o != row && instants[o] == instants[row]);
            others.next().filter(|_| others.next().is_none())
        };
        (0..instants.len())
            .filter(|&row| is_covered(row))
            .filter_map(|row| partner(row).map(|other| (row, other)))
            .filter(|&(_, other)| is_seen(other))
            .map(|(row, other)| CoveredRow {
                pixels: pixels_of(row).filter(|&i| !broken[i]).collect(),
                of_instant: pixels_of(row).chain(pixels_of(other)).collect(),
            })
            .collect()
    }

    /// The excluded pixels. Where the frame is not explained and the instant of a row has not settled without it, the other row
    /// of the instant is left out in its place: it may be the one with the caption.
    fn with_partners_left_out(&self, rows: &[CoveredRow], check: &HeldOutCheck) -> Vec<bool> {
        let mut excluded = self.excluded.clone();
        if check.residual_rms <= MAX_RESIDUAL * self.sigma {
            return excluded;
        }
        let (_, unsettled) = self.judge_pixels(check, 1.0);
        for row in rows
            .iter()
            .filter(|row| row.of_instant.iter().any(|&i| unsettled[i]))
        {
            row.of_instant.iter().for_each(|&i| excluded[i] = true);
            row.pixels.iter().for_each(|&i| excluded[i] = false);
        }
        excluded
    }

    /// `excluded` without those pixels of `rows` that a video explains best which was found from `guess` on.
    fn with_more_pixels(
        &mut self,
        guess: Guess,
        rows: &[CoveredRow],
        mut excluded: Vec<bool>,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<Vec<bool>, Box<RunResult>> {
        let sign = match guess {
            Guess::Brightest => -1.0,
            Guess::Darkest => 1.0,
        };
        let light = self.measurement.image().data().iter();
        let mut rank_by: Vec<f64> = light.map(|b| sign * f64::from(*b)).collect();
        let mut best = excluded.clone();
        rows.iter().for_each(|row| row.leave_out(&mut best));
        let mut least = vec![MAX_INSTANT_RESIDUAL * SEARCH_LEVEL * self.sigma; rows.len()];
        for part in KEPT_PARTS {
            for row in rows {
                row.keep(row.part(part), &rank_by, &mut excluded);
            }
            rank_by = self.residuals_without(&excluded, SEARCH_LEVEL, prior, observer)?;
            for (row, least) in rows.iter().zip(&mut least) {
                let residual = row.residual_rms(&rank_by, &excluded);
                if part >= LEAST_CHOSEN && residual < *least {
                    *least = residual;
                    row.pixels.iter().for_each(|&i| best[i] = excluded[i]);
                }
            }
        }
        Ok(best)
    }

    /// Adds those pixels of `rows` to `excluded` that keep a video from explaining the others to the noise of the sensor.
    fn trim(
        &mut self,
        excluded: &mut [bool],
        rows: &[CoveredRow],
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<(), Box<RunResult>> {
        let mut rest: Vec<&CoveredRow> = rows.iter().collect();
        rest.retain(|row| row.kept_count(excluded) > 0);
        for round in 0..=TRIM_ROUNDS {
            if rest.is_empty() {
                break;
            }
            let sizes = self.residuals_without(excluded, 1.0, prior, observer)?;
            rest.retain(|row| {
                row.residual_rms(&sizes, excluded) > MAX_EXPLAINED_RESIDUAL * self.sigma
            });
            for row in rest.iter().filter(|_| round < TRIM_ROUNDS) {
                let kept = KEPT_PER_ROUND * row.kept_count(excluded) as f64;
                row.keep(kept as usize, &sizes, excluded);
            }
        }
        rest.iter().for_each(|row| row.leave_out(excluded));
        Ok(())
    }

    /// Checks the model without the pixels `excluded`, judges all pixels again, and leaves those of `rows` out as a whole
    /// whose instant has not settled.
    fn settle(
        &mut self,
        mut excluded: Vec<bool>,
        rows: &[CoveredRow],
        broken: &[bool],
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<HeldOutCheck, Box<RunResult>> {
        // These stay out.
        let mut broken = broken.to_vec();
        loop {
            let rounds = Rounds {
                broken: &broken,
                leaves_rows_out: false,
                readmissions: &READMISSIONS,
            };
            let mut level = self.sigma;
            let check = self.exclude_from_level(&mut level, excluded, rounds, prior, observer)?;
            let check = self.readmit(check, &mut level, rounds, prior, observer)?;
            let (_, unsettled) = self.judge_pixels(&check, 1.0);
            excluded = self.excluded.clone();
            let has_failed = |row: &&CoveredRow| {
                let kept = row.kept_count(&excluded);
                let is_unsettled = row.of_instant.iter().any(|&i| unsettled[i]);
                kept > 0 && (is_unsettled || kept < row.part(MIN_KEPT))
            };
            let failed: Vec<&CoveredRow> = rows.iter().filter(has_failed).collect();
            if failed.is_empty() {
                return Ok(check);
            }
            for row in failed {
                row.leave_out(&mut excluded);
                row.leave_out(&mut broken);
            }
        }
    }

    /// `|W(b − A v)|`, `[y, x]`, after a reconstruction without the pixels `excluded` at `level` times `σ`.
    fn residuals_without(
        &mut self,
        excluded: &[bool],
        level: f64,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<Vec<f64>, Box<RunResult>> {
        self.exclude(excluded.to_vec());
        let check = self.robust_check(level * self.sigma, prior, observer)?;
        let weights = self.measurement.weights();
        let pairs = self.measurement.image().data().iter().zip(&check.light);
        let sizes = pairs.enumerate().map(|(i, (b, a))| {
            let weight = weights.map_or(1.0, |w| w[i]);
            f64::from(weight * (b - a)).abs()
        });
        Ok(sizes.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraParams;
    use crate::linop::LinearOperator;
    use crate::measurement::Measurement;
    use crate::noise::Noise;
    use crate::reconstruct::Options;
    use crate::simulate::{SpeckleOptics, scene, speckle_psf};
    use crate::{Camera, Image, RollingShutter, Sensor, Shutter};
    use std::ops::ControlFlow;

    const ROWS: usize = 64;
    const COLUMNS: usize = 60;
    /// With another row of its instant that is read at the same time.
    const ROW: usize = 20;

    /// Of a row that is left out as a whole, all pixels but those of the letters come back, whether these are dark or bright.
    #[test]
    fn a_row_comes_back_without_the_letters_over_it() {
        let camera = Camera::new(CameraParams {
            rows: ROWS,
            columns: COLUMNS,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let optics = SpeckleOptics {
            diffuser_fwhm_deg: 0.6,
            ..SpeckleOptics::demo()
        };
        let psf = speckle_psf(&optics, 2 * ROWS - 1, 2 * COLUMNS - 1, 5).unwrap();
        let truth = scene::digits(camera.video_shape(), 7, 2).unwrap();
        let mut light = vec![0.0; ROWS * COLUMNS];
        RollingShutter::new(&camera, &psf).apply(truth.data(), &mut light);
        let light = Image::new(ROWS, COLUMNS, light).unwrap();
        let noise = Noise::Gaussian { snr: 256.0 };
        let clean = noise.apply(&light, camera.sensor(), 7).unwrap().frame;
        let is_letter = |y: usize, x: usize| y == ROW && x % 20 < 7;
        for ink in [0.0, 1.3 * clean.max()] {
            let at = |y, x| if is_letter(y, x) { ink } else { clean.at(y, x) };
            let measurement = Measurement::new(Image::from_fn(ROWS, COLUMNS, at)).unwrap();
            let options = Options {
                prior: Some(Prior::STANDARD),
                ..Options::default()
            };
            let mut problem = Problem::new(&measurement, &camera, &psf, options).unwrap();
            let row: Vec<bool> = (0..ROWS * COLUMNS).map(|i| i / COLUMNS == ROW).collect();
            problem.exclude(row);
            let observer: &mut Observer = &mut |_| ControlFlow::Continue(());
            let (sigma, broken) = (problem.sigma, vec![false; ROWS * COLUMNS]);
            let check = problem.robust_check(sigma, Prior::STANDARD, observer);
            let check = check.unwrap_or_else(|_| panic!("stopped"));
            problem
                .retry_covered_rows(check, &broken, Prior::STANDARD, observer)
                .unwrap_or_else(|_| panic!("stopped"));
            let excluded = |x: usize| problem.excluded[ROW * COLUMNS + x];
            let missed = (0..COLUMNS).filter(|&x| is_letter(ROW, x) && !excluded(x));
            let others = (0..COLUMNS).filter(|&x| !is_letter(ROW, x) && excluded(x));
            assert_eq!(missed.count(), 0, "ink {ink}");
            assert!(others.count() <= 2, "ink {ink}");
            assert!(count(&problem.excluded) <= 24, "ink {ink}");
        }
    }
}
