//! From the light of a source to a PSF with its zero displacement in the middle.

use super::filter::shifted;
use super::memory::MemoryEffect;
use rowburst_core::Result;
use rowburst_optics::{Image, PatchSet, Psf};

/// Middle `(y, x)` in pixels of the light under `envelope` (1 at its highest), from what is
/// above a tenth: a floor that is left far out would pull it to the middle of the image.
///
/// Where the geometric image of the source lies in its speckle no capture tells; another
/// middle shifts the recovered scene as a whole and changes nothing else.
pub fn centroid(envelope: &Image) -> (f64, f64) {
    let (mut sum, mut y_sum, mut x_sum) = (0.0, 0.0, 0.0);
    for y in 0..envelope.rows() {
        for (x, &p) in envelope.row(y).iter().enumerate() {
            let weight = (f64::from(p) - 0.1).max(0.0);
            sum += weight;
            y_sum += weight * y as f64;
            x_sum += weight * x as f64;
        }
    }
    if sum > 0.0 {
        (y_sum / sum, x_sum / sum)
    } else {
        (
            (envelope.rows() / 2) as f64,
            (envelope.columns() / 2) as f64,
        )
    }
}

/// Part of the light that may be cut off at an edge before the PSF is made larger.
const MAX_LOST_FRACTION: f64 = 1e-3;

/// PSFs of `lights`, each moved by its `moves` pixels `(y, x)`, on one grid: that of the
/// lights, or a larger one with the same middle where light would be cut off.
///
/// # Errors
/// A picture without light.
pub fn centred_psfs(lights: &[&Image], moves: &[(f64, f64)]) -> Result<Vec<Psf>> {
    let mut padding = (0usize, 0usize);
    for (light, m) in lights.iter().zip(moves) {
        let (y, x) = lost(light, *m);
        let needed = |lost: f64, m: f64| {
            if lost > MAX_LOST_FRACTION {
                m.abs().ceil() as usize
            } else {
                0
            }
        };
        padding.0 = padding.0.max(needed(y, m.0));
        padding.1 = padding.1.max(needed(x, m.1));
    }
    let psf = |(light, m): (&&Image, &(f64, f64))| {
        let (rows, columns) = (
            light.rows() + 2 * padding.0,
            light.columns() + 2 * padding.1,
        );
        let (dy, dx) = (m.0 + padding.0 as f64, m.1 + padding.1 as f64);
        let mut image = shifted(light, rows, columns, dy, dx);
        image.data_mut().iter_mut().for_each(|p| *p = p.max(0.0));
        Psf::new(image)
    };
    lights.iter().zip(moves).map(psf).collect()
}

/// Parts of the light that leave the image along `y` and along `x`.
fn lost(light: &Image, (dy, dx): (f64, f64)) -> (f64, f64) {
    let total: f64 = light.data().iter().map(|&p| f64::from(p)).sum();
    let leaves = |at: usize, n: usize, d: f64| {
        let to = at as f64 + d;
        to < 0.0 || to > (n - 1) as f64
    };
    let (mut y_lost, mut x_lost) = (0.0, 0.0);
    for y in 0..light.rows() {
        for (x, &p) in light.row(y).iter().enumerate() {
            if leaves(y, light.rows(), dy) {
                y_lost += f64::from(p);
            }
            if leaves(x, light.columns(), dx) {
                x_lost += f64::from(p);
            }
        }
    }
    (y_lost / total, x_lost / total)
}

/// Which captures make the patches, at most `spacing_mm` apart where the captures lie that
/// close: lines of a grid are thinned along each axis, other places covered one after
/// the other from the `reference` on.
///
/// Of places whose geometric image lies farther outside a `field` of `(rows, columns)`
/// pixels than the spacing none is taken: the field's edge has nearer ones.
pub fn select_patches(
    positions: &[(f64, f64)],
    effect: &MemoryEffect,
    field: Option<(usize, usize)>,
) -> Vec<usize> {
    let inside = |&i: &usize| {
        let (y, x) = offset(positions, effect, i);
        let reach = effect.spacing_mm * effect.shift_px_per_mm;
        field.is_none_or(|(rows, columns)| {
            y.abs() <= rows as f64 / 2.0 + reach && x.abs() <= columns as f64 / 2.0 + reach
        })
    };
    let candidates: Vec<usize> = (0..positions.len()).filter(inside).collect();
    let of_candidates: Vec<(f64, f64)> = candidates.iter().map(|&i| positions[i]).collect();
    let reference = candidates.iter().position(|&i| i == effect.reference);
    let reference = reference.expect("the reference lies in the middle of the field");
    let kept = covering(&of_candidates, reference, effect.spacing_mm);
    kept.into_iter().map(|i| candidates[i]).collect()
}

/// Offset of a place's geometric image from the reference's, in pixels.
fn offset(positions: &[(f64, f64)], effect: &MemoryEffect, i: usize) -> (f64, f64) {
    let (p, reference) = (positions[i], positions[effect.reference]);
    effect.predicted_px((p.0 - reference.0, p.1 - reference.1))
}

fn covering(positions: &[(f64, f64)], reference: usize, spacing_mm: f64) -> Vec<usize> {
    let lines = |of: fn(&(f64, f64)) -> f64| {
        let mut values: Vec<f64> = positions.iter().map(of).collect();
        values.sort_by(f64::total_cmp);
        values.dedup_by(|a, b| (*a - *b).abs() < 1e-6);
        values
    };
    let (rows, columns) = (lines(|p| p.0), lines(|p| p.1));
    if rows.len() * columns.len() == positions.len() {
        let keep_y = thin_lines(&rows, positions[reference].0, spacing_mm);
        let keep_x = thin_lines(&columns, positions[reference].1, spacing_mm);
        let on = |lines: &[f64], v: f64| lines.iter().any(|l| (l - v).abs() < 1e-6);
        return (0..positions.len())
            .filter(|&i| on(&keep_y, positions[i].0) && on(&keep_x, positions[i].1))
            .collect();
    }
    let distance = |a: (f64, f64), b: (f64, f64)| (a.0 - b.0).hypot(a.1 - b.1);
    let mut order: Vec<usize> = (0..positions.len()).collect();
    let from_middle = |i: &usize| distance(positions[*i], positions[reference]);
    order.sort_by(|a, b| from_middle(a).total_cmp(&from_middle(b)));
    let mut kept: Vec<usize> = Vec::new();
    for i in order {
        // Covering circles overlap: three quarters keep neighbours within the spacing.
        if kept
            .iter()
            .all(|&k| distance(positions[i], positions[k]) > 0.75 * spacing_mm)
        {
            kept.push(i);
        }
    }
    kept.sort_unstable();
    kept
}

/// Sorted `lines` from `start` outwards in steps of at most `spacing`, with both ends.
fn thin_lines(lines: &[f64], start: f64, spacing: f64) -> Vec<f64> {
    let mut kept = vec![start];
    for sign in [1.0, -1.0] {
        let mut distances: Vec<f64> = lines.iter().map(|l| sign * (l - start)).collect();
        distances.retain(|&d| d > 1e-6);
        distances.sort_by(f64::total_cmp);
        let Some(&end) = distances.last() else {
            continue;
        };
        let mut at = 0.0;
        while at < end {
            let within = |d: &f64| *d > at && *d <= at + spacing + 1e-9;
            let mut beyond = distances.iter().copied().filter(|d| *d > at);
            let next = distances.iter().copied().rfind(within);
            at = next.or_else(|| beyond.next()).unwrap_or(end);
            kept.push(start + sign * at);
        }
    }
    kept
}

/// Extent `(rows, columns)` in pixels that the geometric images of `positions` span.
pub fn span_px(positions: &[(f64, f64)], effect: &MemoryEffect) -> (f64, f64) {
    let offsets: Vec<(f64, f64)> = (0..positions.len())
        .map(|i| offset(positions, effect, i))
        .collect();
    let span = |of: fn(&(f64, f64)) -> f64| {
        let values = || offsets.iter().map(of);
        values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min)
    };
    (span(|o| o.0), span(|o| o.1))
}

/// Patches a field of `(rows, columns)` pixels needs along `y` and `x`, each as wide as
/// the spacing: a source is then at most half of it from a patch. Along a line of places
/// the memory effect is taken to be alike in all directions.
pub fn patches_needed(effect: &MemoryEffect, field: (f64, f64)) -> (usize, usize) {
    let width = (effect.spacing_mm * effect.shift_px_per_mm).max(1.0);
    let count = |pixels: f64| ((pixels / width).ceil() as usize).max(1);
    (count(field.0), count(field.1))
}

/// The patch set of the captures `kept`: lights at `positions`, in which the reference's
/// zero displacement lies at `middle` (pixels of the capture).
///
/// Each is moved back by the shift of the *linear map*, not by its own: then zero
/// displacement is the same geometric point in all, and the offsets are those of the
/// geometric images.
///
/// # Errors
/// A picture without light.
pub fn patch_set(
    lights: &[Image],
    positions: &[(f64, f64)],
    effect: &MemoryEffect,
    kept: &[usize],
    middle: (f64, f64),
) -> Result<PatchSet> {
    let offsets: Vec<(f64, f64)> = kept.iter().map(|&i| offset(positions, effect, i)).collect();
    let moves: Vec<(f64, f64)> = offsets
        .iter()
        .map(|o| {
            let zero = (
                (lights[0].rows() / 2) as f64,
                (lights[0].columns() / 2) as f64,
            );
            (zero.0 - middle.0 - o.0, zero.1 - middle.1 - o.1)
        })
        .collect();
    let kept: Vec<&Image> = kept.iter().map(|&i| &lights[i]).collect();
    PatchSet::new(centred_psfs(&kept, &moves)?, offsets)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_no_closer_than_they_need_be() {
        let lines: Vec<f64> = (-20..=20).map(|i| 0.05 * f64::from(i)).collect();
        let mut kept = thin_lines(&lines, 0.0, 0.19);
        kept.sort_by(f64::total_cmp);
        // Steps of 0.15, and the ends.
        assert_eq!(kept.len(), 15);
        assert!((kept[0] + 1.0).abs() < 1e-9 && (kept[14] - 1.0).abs() < 1e-9);
        assert!(kept.windows(2).all(|w| w[1] - w[0] < 0.19));
        // Lines farther apart than the spacing are all needed.
        assert_eq!(thin_lines(&[-3.0, 0.0, 3.0], 0.0, 1.0).len(), 3);
    }
}
