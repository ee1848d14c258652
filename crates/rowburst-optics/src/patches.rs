//! Point-spread functions at several places of a field that one alone does not describe.
//!
//! A diffuser's speckle only shifts while the source moves within the memory effect's
//! range; beyond it the pattern changes. With PSFs `p_c` recorded at places `c` the PSF
//! at any place `s` is taken as `Σ_c a_c(s) p_c` with `a_c ≥ 0`, `Σ_c a_c = 1`, so that
//! (Eq. 1) becomes `I = Σ_c (a_c O) ⊛ p_c`.

use crate::Psf;
use rowburst_core::error::Tool;
use rowburst_core::{Error, ErrorKind, Parameter, Result, phrase};

/// PSFs with the places that they were recorded at.
#[derive(Debug, Clone, PartialEq)]
pub struct PatchSet {
    psfs: Vec<Psf>,
    offsets_px: Vec<(f64, f64)>,
    grid: Option<Grid>,
}

/// Places that make up a full grid (or a line, or a point).
#[derive(Debug, Clone, PartialEq)]
struct Grid {
    rows: Vec<f64>,
    columns: Vec<f64>,
    /// Index of the PSF at each crossing, `[row, column]`.
    at: Vec<usize>,
}

/// Contrast of a PSF, `(max − min)/max`, below which it shows no place; larger refuses blurred PSFs.
const FLAT_CONTRAST: f64 = 0.05;
/// Pixels of a PSF from which its contrast counts; smaller ones are made by hand.
const MIN_FLAT_PIXELS: usize = 64;

/// Places closer than this, in pixels, are one row or one column of a grid: captures at
/// nominal positions scatter by the registration's error.
const SAME_LINE_PX: f64 = 1.0;

impl PatchSet {
    /// PSFs with the offset `(dy, dx)` of each one's source from the middle of the field,
    /// in pixels of the working grid.
    ///
    /// # Errors
    /// No PSF, numbers of PSFs and offsets that differ, PSFs of different sizes, offsets
    /// that are not finite, two PSFs at one place.
    pub fn new(psfs: Vec<Psf>, offsets_px: Vec<(f64, f64)>) -> Result<Self> {
        let remedy = phrase!["Write the patch set anew by ", Tool::CalibratePatches, "."];
        let error = |found: String, rule: &'static str| {
            Err(Error::input(
                Parameter::PatchSet,
                found,
                rule,
                remedy.clone(),
            ))
        };
        if psfs.is_empty() || psfs.len() != offsets_px.len() {
            return error(
                format!("{} PSFs and {} offsets", psfs.len(), offsets_px.len()),
                "a patch set has at least one PSF, and one offset for each",
            );
        }
        let size = |psf: &Psf| (psf.image().rows(), psf.image().columns());
        if let Some(other) = psfs.iter().find(|p| size(p) != size(&psfs[0])) {
            return error(
                format!(
                    "PSFs of {}×{} and of {}×{} pixels",
                    size(&psfs[0]).0,
                    size(&psfs[0]).1,
                    size(other).0,
                    size(other).1
                ),
                "all PSFs of a set have one size",
            );
        }
        if let Some(bad) = offsets_px
            .iter()
            .find(|o| !(o.0.is_finite() && o.1.is_finite()))
        {
            return error(format!("the offset {bad:?}"), "every offset is finite");
        }
        for (i, a) in offsets_px.iter().enumerate() {
            if let Some(j) = offsets_px[..i].iter().position(|b| b == a) {
                return error(
                    format!("PSFs {} and {} at one position, {a:?}", j + 1, i + 1),
                    "each PSF has its own position",
                );
            }
        }
        let grid = Grid::of(&offsets_px);
        Ok(Self {
            psfs,
            offsets_px,
            grid,
        })
    }

    /// The PSFs.
    pub fn psfs(&self) -> &[Psf] {
        &self.psfs
    }

    /// The offset `(dy, dx)` of each PSF's source from the middle of the field, in pixels.
    pub fn offsets_px(&self) -> &[(f64, f64)] {
        &self.offsets_px
    }

    /// The PSF whose source is nearest to the middle of the field.
    pub fn central(&self) -> &Psf {
        let distance = |i: &usize| self.offsets_px[*i].0.hypot(self.offsets_px[*i].1);
        let nearest = (0..self.psfs.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        &self.psfs[nearest.expect("a set has a PSF")]
    }

    /// Refuses PSFs that show no place: nothing can be reconstructed with them.
    ///
    /// # Errors
    /// A PSF of nearly the same value everywhere.
    pub fn check_contrast(&self) -> Result<()> {
        for psf in &self.psfs {
            let image = psf.image();
            let (low, high) = (f64::from(image.min()), f64::from(image.max()));
            if image.data().len() >= MIN_FLAT_PIXELS && high - low < FLAT_CONTRAST * high {
                return Err(Error::input(
                    Parameter::Psf,
                    format!("a contrast of {:.1} %: it is flat", 100.0 * (high - low) / high),
                    "a PSF is bright in few places, by which it shows where light comes from",
                    "Check that the capture is of a point source through the diffuser, and not a flat or an empty frame.",
                )
                .with_kind(ErrorKind::NoSignal));
            }
        }
        Ok(())
    }

    /// The weights `a_c` at the offset `(dy, dx)` from the middle of the field, those that
    /// are not zero: bilinear between the places of a grid (linear along a line), else by
    /// the inverse square of the distance. Beyond the outermost places the nearest counts.
    pub fn weights_at(&self, dy: f64, dx: f64) -> Vec<(usize, f64)> {
        if let Some(grid) = &self.grid {
            return grid.weights_at(dy, dx);
        }
        let squares: Vec<f64> = self
            .offsets_px
            .iter()
            .map(|o| (o.0 - dy).powi(2) + (o.1 - dx).powi(2))
            .collect();
        if let Some(hit) = squares.iter().position(|&s| s < 1e-12) {
            return vec![(hit, 1.0)];
        }
        let sum: f64 = squares.iter().map(|s| 1.0 / s).sum();
        let weights = squares.iter().map(|s| 1.0 / s / sum);
        weights.enumerate().collect()
    }
}

impl PatchSet {
    /// The weight `a_c` of PSF `c` at every pixel of a field, `[c, y, x]`; PSFs that have
    /// no say anywhere in it have an empty map.
    pub fn weight_maps(&self, field_rows: usize, field_columns: usize) -> Vec<Vec<f32>> {
        let mut weight_maps = vec![Vec::new(); self.psfs.len()];
        for y in 0..field_rows {
            let dy = y as f64 - (field_rows / 2) as f64;
            for x in 0..field_columns {
                let dx = x as f64 - (field_columns / 2) as f64;
                for (c, weight) in self.weights_at(dy, dx) {
                    if weight_maps[c].is_empty() {
                        weight_maps[c] = vec![0.0f32; field_rows * field_columns];
                    }
                    weight_maps[c][y * field_columns + x] = weight as f32;
                }
            }
        }
        weight_maps
    }
}

impl From<Psf> for PatchSet {
    /// One PSF for the whole field.
    fn from(psf: Psf) -> Self {
        let offsets_px = vec![(0.0, 0.0)];
        Self {
            psfs: vec![psf],
            grid: Grid::of(&offsets_px),
            offsets_px,
        }
    }
}

impl From<&Psf> for PatchSet {
    fn from(psf: &Psf) -> Self {
        psf.clone().into()
    }
}

impl From<&PatchSet> for PatchSet {
    fn from(set: &PatchSet) -> Self {
        set.clone()
    }
}

impl Grid {
    /// The grid of `places`; `None` if a crossing is empty or doubly taken.
    fn of(places: &[(f64, f64)]) -> Option<Self> {
        let (rows, row_of) = lines(places.iter().map(|p| p.0));
        let (columns, column_of) = lines(places.iter().map(|p| p.1));
        if rows.len() * columns.len() != places.len() {
            return None;
        }
        let mut at = vec![usize::MAX; places.len()];
        for i in 0..places.len() {
            at[row_of[i] * columns.len() + column_of[i]] = i;
        }
        let full = at.iter().all(|&i| i != usize::MAX);
        full.then_some(Self { rows, columns, at })
    }

    fn weights_at(&self, dy: f64, dx: f64) -> Vec<(usize, f64)> {
        let mut weights = Vec::with_capacity(4);
        for (row, a) in linear(&self.rows, dy) {
            for (column, b) in linear(&self.columns, dx) {
                if a * b > 0.0 {
                    weights.push((self.at[row * self.columns.len() + column], a * b));
                }
            }
        }
        weights
    }
}

/// The lines that coordinates lie on, ascending, and the line of each.
fn lines(values: impl Iterator<Item = f64>) -> (Vec<f64>, Vec<usize>) {
    let values: Vec<f64> = values.collect();
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[a].total_cmp(&values[b]));
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for i in order {
        match groups.last_mut() {
            Some(group) if values[i] - values[group[0]] <= SAME_LINE_PX => group.push(i),
            _ => groups.push(vec![i]),
        }
    }
    let mut line_of = vec![0; values.len()];
    let mut means = Vec::new();
    for (line, group) in groups.iter().enumerate() {
        group.iter().for_each(|&i| line_of[i] = line);
        means.push(group.iter().map(|&i| values[i]).sum::<f64>() / group.len() as f64);
    }
    (means, line_of)
}

/// The two lines around `value` with their weights.
fn linear(lines: &[f64], value: f64) -> [(usize, f64); 2] {
    let after = lines.partition_point(|&l| l <= value);
    if after == 0 {
        return [(0, 1.0), (0, 0.0)];
    }
    if after == lines.len() {
        return [(after - 1, 1.0), (after - 1, 0.0)];
    }
    let part = (value - lines[after - 1]) / (lines[after] - lines[after - 1]);
    [(after - 1, 1.0 - part), (after, part)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Image;

    fn set(offsets: &[(f64, f64)]) -> PatchSet {
        let psf = |i: usize| Psf::new(Image::from_fn(3, 3, |y, x| (1 + y * x + i) as f32)).unwrap();
        PatchSet::new((0..offsets.len()).map(psf).collect(), offsets.to_vec()).unwrap()
    }

    #[test]
    fn weights_are_bilinear_on_a_grid() {
        let set = set(&[(10.0, -20.0), (-10.2, 20.0), (-10.0, -20.0), (10.0, 20.3)]);
        let mut weights = [0.0; 4];
        for (i, w) in set.weights_at(5.0, -10.0) {
            weights[i] = w;
        }
        let (row, column) = (15.1 / 20.1, 10.0 / 40.15);
        let expected = [
            row * (1.0 - column),
            (1.0 - row) * column,
            (1.0 - row) * (1.0 - column),
            row * column,
        ];
        for (w, e) in weights.iter().zip(expected) {
            assert!((w - e).abs() < 1e-3, "{weights:?} {expected:?}");
        }
        // Beyond the corner that corner alone.
        assert_eq!(set.weights_at(99.0, 99.0), [(3, 1.0)]);
    }

    #[test]
    fn weights_are_linear_on_a_line_and_sum_to_one_anywhere() {
        let line = set(&[(0.0, -8.0), (0.0, 0.0), (0.0, 8.0)]);
        assert_eq!(line.weights_at(55.0, 2.0), [(1, 0.75), (2, 0.25)]);
        let scattered = set(&[(0.0, 0.0), (3.0, 9.0), (-7.0, 4.0)]);
        assert_eq!(scattered.weights_at(3.0, 9.0), [(1, 1.0)]);
        for at in [(1.0, 1.0), (-50.0, 3.0)] {
            let sum: f64 = scattered.weights_at(at.0, at.1).iter().map(|w| w.1).sum();
            assert!((sum - 1.0).abs() < 1e-12);
        }
        let one = PatchSet::from(line.psfs()[0].clone());
        assert_eq!(one.weights_at(3.0, 4.0), [(0, 1.0)]);
    }

    #[test]
    fn sets_that_contradict_themselves_are_refused() {
        let psf = |n: usize| Psf::new(Image::from_fn(n, n, |_, _| 1.0)).unwrap();
        for (psfs, offsets) in [
            (vec![], vec![]),
            (vec![psf(3)], vec![(0.0, 0.0), (1.0, 1.0)]),
            (vec![psf(3), psf(4)], vec![(0.0, 0.0), (1.0, 1.0)]),
            (vec![psf(3), psf(3)], vec![(1.0, 1.0), (1.0, 1.0)]),
            (vec![psf(3)], vec![(f64::NAN, 0.0)]),
        ] {
            assert!(PatchSet::new(psfs, offsets).is_err());
        }
    }
}
