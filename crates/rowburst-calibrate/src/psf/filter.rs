//! Smoothing and shifting of images.

use rowburst_optics::Image;

/// The Gaussian mean of `image` with standard deviation `sigma` in pixels, taken over
/// what lies inside the image: an even image stays as it is up to its edges.
///
/// Three running means in a row stand in for wide kernels (error below 3 % of the
/// kernel's peak), so that the time does not depend on `sigma`.
pub(super) fn smoothed(image: &Image, sigma: f64) -> Image {
    if sigma < 0.2 {
        return image.clone();
    }
    let across = smooth_rows(image, sigma);
    transposed(&smooth_rows(&transposed(&across), sigma))
}

fn smooth_rows(image: &Image, sigma: f64) -> Image {
    let columns = image.columns();
    let pass = |line: &[f64]| -> Vec<f64> {
        if sigma < 3.0 {
            convolved(line, &gaussian(sigma))
        } else {
            // Variance of three running means of width w: (w² − 1)/4.
            let half = ((4.0 * sigma * sigma + 1.0).sqrt() - 1.0) / 2.0;
            (0..3).fold(line.to_vec(), |line, _| running_sum(&line, half))
        }
    };
    let weight = pass(&vec![1.0; columns]);
    let mut out = Image::zeros(image.rows(), columns);
    for y in 0..image.rows() {
        let line: Vec<f64> = image.row(y).iter().map(|&p| f64::from(p)).collect();
        let target = &mut out.data_mut()[y * columns..(y + 1) * columns];
        for ((t, v), w) in target.iter_mut().zip(pass(&line)).zip(&weight) {
            *t = (v / w) as f32;
        }
    }
    out
}

/// Weights at displacements from 0 on.
fn gaussian(sigma: f64) -> Vec<f64> {
    let reach = (4.0 * sigma).ceil() as usize;
    (0..=reach)
        .map(|i| (-0.5 * (i as f64 / sigma).powi(2)).exp())
        .collect()
}

fn convolved(line: &[f64], kernel: &[f64]) -> Vec<f64> {
    (0..line.len())
        .map(|x| {
            let side = kernel.iter().enumerate().skip(1).map(|(d, k)| {
                let left = x.checked_sub(d).map_or(0.0, |i| line[i]);
                k * (left + line.get(x + d).copied().unwrap_or(0.0))
            });
            kernel[0] * line[x] + side.sum::<f64>()
        })
        .collect()
}

/// Sums over `x − half ..= x + half`, the ends by their fraction.
fn running_sum(line: &[f64], half: f64) -> Vec<f64> {
    let (whole, part) = (half.floor() as usize, half.fract());
    let mut before = vec![0.0; line.len() + 1];
    for (i, v) in line.iter().enumerate() {
        before[i + 1] = before[i] + v;
    }
    let at = |i: Option<usize>| i.and_then(|i| line.get(i)).copied().unwrap_or(0.0);
    (0..line.len())
        .map(|x| {
            let inner = before[(x + whole + 1).min(line.len())] - before[x.saturating_sub(whole)];
            inner + part * (at(x.checked_sub(whole + 1)) + at(Some(x + whole + 1)))
        })
        .collect()
}

fn transposed(image: &Image) -> Image {
    Image::from_fn(image.columns(), image.rows(), |y, x| image.at(x, y))
}

/// `image` on `rows × columns` pixels, moved by `(dy, dx)` pixels: pixel `(y, x)` is the
/// value at `(y − dy, x − dx)` of `image`, zero outside it.
///
/// Separable Lanczos interpolation over 12 pixels: like the ideal (sinc) interpolation it
/// neither blurs grains of two pixels nor takes away noise, and it does not wrap around.
pub(super) fn shifted(image: &Image, rows: usize, columns: usize, dy: f64, dx: f64) -> Image {
    let across = shift_rows(image, columns, dx);
    transposed(&shift_rows(&transposed(&across), rows, dy))
}

fn shift_rows(image: &Image, columns: usize, shift: f64) -> Image {
    let whole = shift.floor();
    let taps = lanczos(shift - whole);
    let whole = whole as isize;
    let mut out = Image::zeros(image.rows(), columns);
    for y in 0..image.rows() {
        let line = image.row(y);
        let target = &mut out.data_mut()[y * columns..(y + 1) * columns];
        for (x, t) in target.iter_mut().enumerate() {
            let first = x as isize - whole - LANCZOS as isize;
            let mut sum = 0.0;
            for (i, tap) in taps.iter().enumerate() {
                let at = first + i as isize;
                if (0..line.len() as isize).contains(&at) {
                    sum += tap * f64::from(line[at as usize]);
                }
            }
            *t = sum as f32;
        }
    }
    out
}

/// Half width of the interpolation's kernel in pixels.
const LANCZOS: usize = 6;

/// Weights of the pixels `x − LANCZOS ..= x + LANCZOS` for the value at `x − part`.
fn lanczos(part: f64) -> [f64; 2 * LANCZOS + 1] {
    let sinc = |x: f64| {
        let x = std::f64::consts::PI * x;
        if x.abs() < 1e-9 { 1.0 } else { x.sin() / x }
    };
    let half = LANCZOS as f64;
    let weight = |i: usize| {
        let x = i as f64 - half + part;
        if x.abs() < half {
            sinc(x) * sinc(x / half)
        } else {
            0.0
        }
    };
    let taps: [f64; 2 * LANCZOS + 1] = std::array::from_fn(weight);
    let sum: f64 = taps.iter().sum();
    taps.map(|t| t / sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_keeps_even_light_and_has_its_width() {
        for sigma in [0.7, 2.0, 5.3, 11.0] {
            let even = smoothed(&Image::from_fn(40, 30, |_, _| 3.0), sigma);
            assert!(even.data().iter().all(|v| (v - 3.0).abs() < 1e-5));
            let mut point = Image::zeros(129, 129);
            point.data_mut()[64 * 129 + 64] = 1.0;
            let spot = smoothed(&point, sigma);
            let mut moments = [0.0f64; 2];
            for x in 0..129 {
                let v = f64::from(spot.at(64, x));
                moments[0] += v;
                moments[1] += v * (x as f64 - 64.0).powi(2);
            }
            let width = (moments[1] / moments[0]).sqrt();
            assert!((width / sigma - 1.0).abs() < 0.03, "{width} for {sigma}");
        }
    }

    #[test]
    fn shifting_moves_a_smooth_spot_without_blur() {
        let spot = |cy: f64, cx: f64| {
            Image::from_fn(48, 40, move |y, x| {
                let r = (y as f64 - cy).powi(2) + (x as f64 - cx).powi(2);
                (-r / 8.0).exp() as f32
            })
        };
        let moved = shifted(&spot(20.0, 18.0), 48, 40, 3.4, -2.7);
        let expected = spot(23.4, 15.3);
        let worst = moved.data().iter().zip(expected.data());
        let worst = worst.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 5e-3, "{worst}");
        let whole = shifted(&spot(20.0, 18.0), 50, 44, 2.0, 3.0);
        assert_eq!(whole.at(22, 21), 1.0);
    }
}
