//! The places of a guide: lit pixels that touch, each with its shape, and the rest.

use rowburst_optics::Image;

/// Fewest pixels of a place; smaller takes noise of the guide for places.
const MIN_PIXELS: usize = 4;
/// Pixels around a place whose light above the rest is its own: a soft edge; larger gives places light that is not theirs.
const EDGE_PX: usize = 2;
/// Brighter pixels than this part of all count as one of that rank for the threshold; larger lets hot pixels hide places.
const BRIGHTEST: f64 = 0.995;
/// Standard deviation of the smoothing of the rest, in pixels; smaller leaves noise of the guide in it, larger its structure
/// out.
const REST_BLUR_PX: f64 = 1.5;

/// The guide as a sum: its light above the rest, place by place, and the rest.
pub(super) struct Shapes {
    /// The place of each lit pixel, from 1; 0: none.
    pub labels: Vec<u32>,
    /// The same with the soft edges around each place.
    pub owners: Vec<u32>,
    /// Number of places.
    pub count: usize,
    /// The light above the rest, 0 where no place is.
    pub above: Vec<f32>,
    pub rest: Vec<f32>,
}

impl Shapes {
    /// The places of `picture`, whose values are not negative.
    pub fn new(picture: &Image) -> Self {
        let (labels, count) = places_of(picture.data(), picture.columns());
        let owners = with_edges(&labels, picture.columns());
        let rest = rest_of(picture, &owners);
        let pixels = picture.data().iter().zip(&rest).zip(&owners);
        let above = pixels
            .map(|((g, rest), owner)| if *owner > 0 { (g - rest).max(0.0) } else { 0.0 })
            .collect();
        Self {
            labels,
            owners,
            count,
            above,
            rest,
        }
    }

    /// Both parts together.
    pub fn sum(&self) -> Vec<f32> {
        let pixels = self.above.iter().zip(&self.rest);
        pixels.map(|(a, r)| a + r).collect()
    }
}

/// The labels with the pixels around each place, which go to the nearest one; of two as near to the later one.
fn with_edges(labels: &[u32], columns: usize) -> Vec<u32> {
    let mut owners = labels.to_vec();
    for _ in 0..EDGE_PX {
        let before = owners.clone();
        for (i, owner) in owners.iter_mut().enumerate().filter(|(_, o)| **o == 0) {
            let neighbour = neighbours(i, before.len(), columns).map(|at| before[at]);
            *owner = neighbour.max().unwrap_or(0);
        }
    }
    owners
}

/// The picture without places, smooth, and as bright under them as around them.
fn rest_of(picture: &Image, owners: &[u32]) -> Vec<f32> {
    let (rows, columns) = (picture.rows(), picture.columns());
    let is_rest = |y: usize, x: usize| owners[y * columns + x] == 0;
    let part = |y, x| if is_rest(y, x) { 1.0 } else { 0.0 };
    let light = Image::from_fn(rows, columns, |y, x| part(y, x) * picture.at(y, x));
    let weight = Image::from_fn(rows, columns, part);
    let mean = light.data().iter().sum::<f32>() / weight.data().iter().sum::<f32>().max(1.0);
    let mut rest = vec![mean; owners.len()];
    // Under a large place a wider smoothing reaches its edges.
    for blur in [8.0 * REST_BLUR_PX, REST_BLUR_PX] {
        let (light, weight) = (light.blurred(blur), weight.blurred(blur));
        for ((rest, light), weight) in rest.iter_mut().zip(light.data()).zip(weight.data()) {
            *rest = (light + 0.1 * *rest) / (weight + 0.1);
        }
    }
    rest
}

/// Pixels that share an edge with the pixel `i`.
fn neighbours(i: usize, pixels: usize, columns: usize) -> impl Iterator<Item = usize> {
    let x = i % columns;
    let all = [
        i.checked_sub(columns),
        (i + columns < pixels).then_some(i + columns),
        (x > 0).then(|| i - 1),
        (x + 1 < columns).then_some(i + 1),
    ];
    all.into_iter().flatten()
}

/// The place of each pixel, from 1 in the order of rows, and their number: lit pixels that touch along an edge.
fn places_of(picture: &[f32], columns: usize) -> (Vec<u32>, usize) {
    let threshold = otsu_threshold(picture);
    let mut labels = vec![0; picture.len()];
    let mut is_open: Vec<bool> = picture.iter().map(|v| *v > threshold).collect();
    let mut count = 0;
    for first in 0..labels.len() {
        if !std::mem::take(&mut is_open[first]) {
            continue;
        }
        let mut pixels = vec![first];
        let mut next = 0;
        while next < pixels.len() {
            let place = pixels[next];
            next += 1;
            for at in neighbours(place, picture.len(), columns) {
                if std::mem::take(&mut is_open[at]) {
                    pixels.push(at);
                }
            }
        }
        if pixels.len() >= MIN_PIXELS {
            count += 1;
            pixels.iter().for_each(|&i| labels[i] = count);
        }
    }
    (labels, count as usize)
}

/// The value that parts light from dark with the greatest variance between the two (Otsu, IEEE Trans. Syst. Man Cybern. 9,
/// 62, 1979). It is that of the roots of the values, so that dim places count beside bright ones.
fn otsu_threshold(values: &[f32]) -> f32 {
    let mut sorted: Vec<f64> = values.iter().map(|v| f64::from(*v).sqrt()).collect();
    sorted.sort_by(f64::total_cmp);
    let brightest = sorted[(BRIGHTEST * (sorted.len() - 1) as f64) as usize];
    sorted.iter_mut().for_each(|v| *v = v.min(brightest));
    let (count, total) = (sorted.len() as f64, sorted.iter().sum::<f64>());
    let (mut below, mut best) = (0.0, (0.0, f64::INFINITY));
    for (i, pair) in sorted.windows(2).enumerate() {
        below += pair[0];
        let dark = (i + 1) as f64;
        let bright = count - dark;
        let between = dark * bright * (below / dark - (total - below) / bright).powi(2);
        if between > best.0 {
            best = (between, 0.5 * (pair[0] + pair[1]));
        }
    }
    best.1.powi(2) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lit_pixels_that_touch_are_a_place() {
        let lit = |y: usize, x: usize| {
            let first = (1..4).contains(&y) && (1..3).contains(&x);
            let second = (5..8).contains(&y) && (4..8).contains(&x);
            // Too small for a place.
            first || second || (y, x) == (0, 8)
        };
        let picture: Vec<f32> = (0..81)
            .map(|i| {
                if lit(i / 9, i % 9) {
                    0.8 + 0.01 * (i % 9) as f32
                } else {
                    0.1
                }
            })
            .collect();
        let (labels, count) = places_of(&picture, 9);
        assert_eq!(count, 2);
        assert_eq!(
            (labels[9 + 1], labels[5 * 9 + 4], labels[8], labels[0]),
            (1, 2, 0, 0)
        );
        assert_eq!(labels.iter().filter(|l| **l == 2).count(), 12);
    }

    /// A soft edge belongs to its place, and under a place the rest goes on.
    #[test]
    fn places_have_their_edges_and_the_rest_is_smooth() {
        let height = |y: usize, x: usize| {
            let distance = (y as f64 - 10.0).hypot(x as f64 - 12.0);
            0.1 + 0.9 / (1.0 + ((distance - 4.0) / 0.4).exp())
        };
        let picture = Image::from_fn(24, 24, |y, x| height(y, x) as f32);
        let shapes = Shapes::new(&picture);
        assert_eq!(shapes.count, 1);
        assert!(
            shapes.rest.iter().all(|r| (r - 0.1).abs() < 0.01),
            "{:?}",
            shapes.rest
        );
        let lost = picture
            .data()
            .iter()
            .zip(shapes.sum())
            .map(|(a, b)| (a - b).abs());
        assert!(lost.sum::<f32>() < 1.0);
        let lit = shapes.labels.iter().filter(|l| **l > 0).count();
        let owned = shapes.owners.iter().filter(|l| **l > 0).count();
        assert!(lit > 40 && owned > lit + 30, "{lit} {owned}");
    }
}
