//! A whole video in one picture: time as colour.

use rowburst::Video;

use crate::colour::{srgb, time_hue};
use crate::pixels::{LONGEST_SIDE, Pixels};

/// Projections of a video over time, pixel by pixel `[y, x]`.
pub(crate) struct Projection {
    pub rows: usize,
    pub columns: usize,
    /// Largest value over time, not below zero.
    pub max: Vec<f32>,
    /// `Σ_t v²(t) c(t) / Σ_t v²(t)`, linear-light, `c(t)` the hue of bin `t`.
    tint: Vec<[f32; 3]>,
}

impl Projection {
    /// Projects `video` in one pass. Values below zero or not finite count as dark.
    pub(crate) fn of(video: &Video) -> Self {
        let shape = video.shape();
        let pixels = shape.pixels();
        let mut max = vec![0.0_f32; pixels];
        let mut power = vec![0.0_f32; pixels];
        let mut tint = vec![[0.0_f32; 3]; pixels];
        let last = shape.bins.saturating_sub(1).max(1) as f64;
        for t in 0..shape.bins {
            let hue = time_hue(t as f64 / last);
            for (i, &value) in video.bin(t).iter().enumerate() {
                if value > 0.0 && value.is_finite() {
                    let weight = value * value;
                    max[i] = max[i].max(value);
                    power[i] += weight;
                    for (sum, c) in tint[i].iter_mut().zip(hue) {
                        *sum += weight * c;
                    }
                }
            }
        }
        for (tint, &power) in tint.iter_mut().zip(&power) {
            let scale = if power > 0.0 { power.recip() } else { 0.0 };
            *tint = tint.map(|c| if scale.is_finite() { c * scale } else { 0.0 });
        }
        Self {
            rows: shape.rows,
            columns: shape.columns,
            max,
            tint,
        }
    }

    /// The picture: hue is time, brightness the largest value over time, white point `high`.
    pub(crate) fn picture(&self, high: f32) -> Pixels {
        let factor = self.rows.max(self.columns).div_ceil(LONGEST_SIDE);
        let (rows, columns) = (self.rows.div_ceil(factor), self.columns.div_ceil(factor));
        Pixels::from_rgb(rows, columns, |i| {
            let (y, x) = (i / columns * factor, i % columns * factor);
            let mut sum = [0.0_f32; 3];
            let mut count = 0.0;
            for y in y..(y + factor).min(self.rows) {
                for x in x..(x + factor).min(self.columns) {
                    let at = y * self.columns + x;
                    let brightness = (self.max[at] / high).min(1.0);
                    for (sum, c) in sum.iter_mut().zip(srgb(self.tint[at])) {
                        *sum += brightness * f32::from(c);
                    }
                    count += 1.0;
                }
            }
            sum.map(|s| (s / count).round() as u8)
        })
    }
}

/// The legend: first bin on the left, last on the right.
pub(crate) fn legend(bins: usize) -> Pixels {
    let columns = bins.clamp(1, 256);
    let last = columns.saturating_sub(1).max(1) as f64;
    Pixels::from_rgb(1, columns, |i| srgb(time_hue(i as f64 / last)))
}

#[cfg(test)]
mod tests {
    use rowburst::Shape;

    use super::*;

    #[test]
    fn a_flash_has_the_hue_of_its_bin() {
        let mut video = Video::zeros(Shape::new(5, 1, 3));
        video.bin_mut(0)[0] = 2.0;
        video.bin_mut(4)[1] = 2.0;
        video.bin_mut(2)[2] = f32::NAN;
        let projection = Projection::of(&video);
        assert_eq!(projection.max, [2.0, 2.0, 0.0]);
        let picture = projection.picture(2.0);
        assert_eq!(picture.at(0, 0), srgb(time_hue(0.0)));
        assert_eq!(picture.at(0, 1), srgb(time_hue(1.0)));
        assert_eq!(picture.at(0, 2), [0, 0, 0]);
    }
}
