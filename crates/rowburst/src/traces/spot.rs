//! The brightest, well separated spots of a picture.

use super::Region;
use rowburst_optics::Video;

/// Least distance between spots: this part of the field's shorter side, and so many pixels.
const SEPARATION: (f64, f64) = (1.0 / 8.0, 3.0);

/// The 3×3 pixels about up to `count` of the brightest spots of `video` (its largest values over
/// time), brightest first.
pub fn brightest_regions(video: &Video, count: usize) -> Vec<Region> {
    let shape = video.shape();
    let mut largest = vec![0.0f32; shape.pixels()];
    for t in 0..shape.bins {
        for (most, &value) in largest.iter_mut().zip(video.bin(t)) {
            if value.is_finite() {
                *most = most.max(value);
            }
        }
    }
    let side = shape.rows.min(shape.columns) as f64;
    let separation = (side * SEPARATION.0).max(SEPARATION.1);
    let spots = brightest_spots(&largest, shape.columns, count, separation);
    spots
        .iter()
        .map(|spot| Region::centred_at(spot.y, spot.x, 3, shape))
        .collect()
}

/// A local maximum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// Row.
    pub y: usize,
    /// Column.
    pub x: usize,
    /// Mean of the 3×3 pixels about it.
    pub value: f32,
}

/// Picks up to `count` spots of a picture `[y, x]` in C order, brightest first.
///
/// The picture is smoothed by a 3×3 mean (over the pixels that exist). A spot is a
/// maximum of its 3×3 neighbourhood, has at least a fifth of the brightest one's
/// value, and keeps `separation` pixels (Euclidean) from every brighter spot. Values
/// that are not finite count as zero.
///
/// # Panics
/// If `columns` is zero or does not divide the picture.
pub fn brightest_spots(
    picture: &[f32],
    columns: usize,
    count: usize,
    separation: f64,
) -> Vec<Spot> {
    assert!(columns > 0 && picture.len().is_multiple_of(columns));
    let rows = picture.len() / columns;
    let smooth: Vec<f32> = (0..picture.len())
        .map(|i| mean3(picture, columns, i / columns, i % columns))
        .collect();
    let mut candidates: Vec<Spot> = (0..picture.len())
        .filter(|&i| smooth[i] > 0.0)
        .map(|i| Spot {
            y: i / columns,
            x: i % columns,
            value: smooth[i],
        })
        .filter(|spot| {
            let [ys, xs] = [(spot.y, rows), (spot.x, columns)].map(around);
            let no_brighter = |y: usize| {
                let mut row = xs.clone().map(|x| smooth[y * columns + x]);
                row.all(|other| other <= spot.value)
            };
            ys.into_iter().all(no_brighter)
        })
        .collect();
    candidates.sort_by(|a, b| b.value.total_cmp(&a.value));
    let mut spots: Vec<Spot> = Vec::with_capacity(count);
    for spot in candidates {
        let faint = spots.first().is_some_and(|s| spot.value < 0.2 * s.value);
        if spots.len() == count || faint {
            break;
        }
        let distance = |s: &Spot| (spot.y as f64 - s.y as f64).hypot(spot.x as f64 - s.x as f64);
        if spots.iter().all(|s| distance(s) >= separation) {
            spots.push(spot);
        }
    }
    spots
}

/// Mean over the 3×3 pixels about `(y, x)` that exist.
fn mean3(picture: &[f32], columns: usize, y: usize, x: usize) -> f32 {
    let rows = picture.len() / columns;
    let (mut sum, mut count) = (0.0, 0);
    for y in around((y, rows)) {
        for x in around((x, columns)) {
            let value = picture[y * columns + x];
            sum += if value.is_finite() { value } else { 0.0 };
            count += 1;
        }
    }
    sum / count as f32
}

fn around((centre, length): (usize, usize)) -> std::ops::Range<usize> {
    centre.saturating_sub(1)..(centre + 2).min(length)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gaussians(rows: usize, columns: usize, spots: &[(usize, usize, f64)]) -> Vec<f32> {
        let value = |y: usize, x: usize| {
            let one = |&(cy, cx, height): &(usize, usize, f64)| {
                let d2 = (y as f64 - cy as f64).powi(2) + (x as f64 - cx as f64).powi(2);
                height * (-d2 / 8.0).exp()
            };
            spots.iter().map(one).sum::<f64>() as f32
        };
        (0..rows * columns)
            .map(|i| value(i / columns, i % columns))
            .collect()
    }

    #[test]
    fn finds_known_spots_in_order_and_leaves_out_faint_and_close_ones() {
        let truth = [(10, 12, 3.0), (40, 50, 5.0), (40, 20, 2.0), (5, 55, 0.5)];
        let mut picture = gaussians(60, 64, &truth);
        picture[0] = f32::NAN;
        let found: Vec<(usize, usize)> = brightest_spots(&picture, 64, 6, 6.0)
            .iter()
            .map(|s| (s.y, s.x))
            .collect();
        assert_eq!(found, [(40, 50), (10, 12), (40, 20)]);
        assert_eq!(brightest_spots(&picture, 64, 6, 35.0).len(), 2);
        assert_eq!(brightest_spots(&picture, 64, 1, 6.0).len(), 1);
    }

    #[test]
    fn dark_and_one_pixel_pictures() {
        assert!(brightest_spots(&[0.0; 12], 4, 3, 2.0).is_empty());
        assert_eq!(brightest_spots(&[2.0], 1, 3, 2.0).len(), 1);
        assert_eq!(
            brightest_spots(&[0.0, 9.0, 0.0, 0.0, 0.0], 1, 3, 3.0).len(),
            1
        );
    }
}
