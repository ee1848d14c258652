//! Pictures on the grid of the field: resampling, and values with gradients at shifted places.

use rowburst_optics::Image;

/// The picture on a grid of `rows` × `columns`, its frame stretched over the field. Finer pictures are blurred first.
pub(super) fn on_grid(picture: &Image, rows: usize, columns: usize) -> Image {
    if (picture.rows(), picture.columns()) == (rows, columns) {
        return picture.clone();
    }
    let scale = |from: usize, to: usize| from as f64 / to as f64;
    let (sy, sx) = (
        scale(picture.rows(), rows),
        scale(picture.columns(), columns),
    );
    let finer = sy.max(sx);
    let blurred = picture.blurred(if finer > 1.0 { 0.5 * finer } else { 0.0 });
    let place = |i: usize, scale: f64| ((i as f64 + 0.5) * scale - 0.5) as f32;
    Image::from_fn(rows, columns, |y, x| {
        at(&blurred, place(y, sy), place(x, sx)).0
    })
}

/// What a voxel takes of a guide.
pub(super) struct GuideSample {
    /// Its place `(y, x)` in the picture of the guide.
    pub at: [f32; 2],
    /// The factor of the picture's value there.
    pub weight: f32,
}

/// The pixels, as indices, that [`at`] interpolates between, with their weights.
pub(super) fn corners(picture: &Image, [y, x]: [f32; 2]) -> [(usize, f32); 4] {
    let (rows, columns) = (picture.rows(), picture.columns());
    let y = y.clamp(0.0, (rows as f32 - 1.001).max(0.0));
    let x = x.clamp(0.0, (columns as f32 - 1.001).max(0.0));
    let (i, j) = (y as usize, x as usize);
    let (f, g) = (y - i as f32, x - j as f32);
    let (lower, right) = ((i + 1).min(rows - 1), (j + 1).min(columns - 1));
    [
        (i * columns + j, (1.0 - f) * (1.0 - g)),
        (i * columns + right, (1.0 - f) * g),
        (lower * columns + j, f * (1.0 - g)),
        (lower * columns + right, f * g),
    ]
}

/// The picture at `(y, x)` by linear interpolation, with its derivatives along y and x. Places outside have the value of
/// the edge, and no derivative away from it.
#[inline]
pub(super) fn at(picture: &Image, y: f32, x: f32) -> (f32, f32, f32) {
    let (rows, columns) = (picture.rows(), picture.columns());
    let is_inside = |at: f32, n: usize| f32::from(u8::from((0.0..=n as f32 - 1.0).contains(&at)));
    let (inside_y, inside_x) = (is_inside(y, rows), is_inside(x, columns));
    let y = y.clamp(0.0, (rows as f32 - 1.001).max(0.0));
    let x = x.clamp(0.0, (columns as f32 - 1.001).max(0.0));
    let (i, j) = (y as usize, x as usize);
    let (f, g) = (y - i as f32, x - j as f32);
    let data = picture.data();
    let (upper, lower) = (
        i * columns,
        if i + 1 < rows {
            (i + 1) * columns
        } else {
            i * columns
        },
    );
    let right = if j + 1 < columns { j + 1 } else { j };
    let (p, q) = (data[upper + j], data[upper + right]);
    let (r, s) = (data[lower + j], data[lower + right]);
    let value = (p * (1.0 - g) + q * g) * (1.0 - f) + (r * (1.0 - g) + s * g) * f;
    let along_y = (r - p) * (1.0 - g) + (s - q) * g;
    let along_x = (q - p) * (1.0 - f) + (s - r) * f;
    (value, inside_y * along_y, inside_x * along_x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_has_its_values_and_gradient_on_any_grid() {
        let ramp = Image::from_fn(20, 30, |y, x| 2.0 * y as f32 + 3.0 * x as f32);
        let (value, dy, dx) = at(&ramp, 4.25, 7.5);
        assert!((value - 31.0).abs() < 1e-4 && (dy - 2.0).abs() < 1e-4 && (dx - 3.0).abs() < 1e-4);
        let (value, dy, dx) = at(&ramp, -2.0, 7.5);
        assert!((value - 22.5).abs() < 1e-4 && dy == 0.0 && (dx - 3.0).abs() < 1e-4);
        let weights = corners(&ramp, [4.25, 7.5]);
        let sum: f32 = weights.iter().map(|(i, w)| w * ramp.data()[*i]).sum();
        assert!((sum - 31.0).abs() < 1e-4);
        let half = on_grid(&ramp, 10, 15);
        // Pixel (5, 7) of the coarse grid lies at (10.5, 14.5) of the fine one.
        assert!((half.at(5, 7) - (21.0 + 43.5)).abs() < 1e-3);
    }
}
