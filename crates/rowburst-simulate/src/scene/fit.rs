//! Any video as a scene: resampled to the field and the bins of a camera.
//!
//! Every axis follows one rule. Fewer samples than before: each is the mean over the
//! part of the old axis that it covers (in time, what an exposure of the longer bin
//! sees). More: linear interpolation between the centres of the old samples, constant
//! beyond the first and the last. As many: unchanged.

use rowburst_core::{Error, ErrorKind, Parameter, Result, Shape};
use rowburst_optics::Video;

/// `video` resampled to `shape`.
///
/// The picture is scaled as large as it goes whole into the field, with its aspect
/// ratio kept to the nearest pixel, and centred; the field around it is zero. The
/// duration of the video becomes that of the scene. Values keep their scale.
///
/// # Errors
/// A value that is negative or not finite, an empty shape.
pub fn fit(video: &Video, shape: Shape) -> Result<Video> {
    let from = video.shape();
    super::require_field_size(shape, 1, 1, "a scene")?;
    check_values(video)?;
    let scale = f64::min(
        shape.rows as f64 / from.rows as f64,
        shape.columns as f64 / from.columns as f64,
    );
    let scaled =
        |side: usize, limit: usize| ((side as f64 * scale).round() as usize).clamp(1, limit);
    let rows = scaled(from.rows, shape.rows);
    let columns = scaled(from.columns, shape.columns);
    let (top, left) = ((shape.rows - rows) / 2, (shape.columns - columns) / 2);
    let along_t = resampling(from.bins, shape.bins);
    let along_y = resampling(from.rows, rows);
    let along_x = resampling(from.columns, columns);

    let mut scene = Video::zeros(shape);
    let mut mixed = vec![0.0f64; from.pixels()];
    let mut line = vec![0.0f64; from.columns];
    for (t, times) in along_t.iter().enumerate() {
        mixed.fill(0.0);
        for &(source, weight) in times {
            for (sum, &value) in mixed.iter_mut().zip(video.bin(source)) {
                *sum += weight * f64::from(value);
            }
        }
        let bin = scene.bin_mut(t);
        for (y, heights) in along_y.iter().enumerate() {
            line.fill(0.0);
            for &(source, weight) in heights {
                let row = &mixed[source * from.columns..(source + 1) * from.columns];
                for (sum, value) in line.iter_mut().zip(row) {
                    *sum += weight * value;
                }
            }
            let start = (top + y) * shape.columns + left;
            for (pixel, widths) in bin[start..start + columns].iter_mut().zip(&along_x) {
                *pixel = widths.iter().map(|&(x, w)| w * line[x]).sum::<f64>() as f32;
            }
        }
    }
    Ok(scene)
}

/// Sources and weights, which sum to 1, of each of `to` samples made from `from`.
fn resampling(from: usize, to: usize) -> Vec<Vec<(usize, f64)>> {
    let step = from as f64 / to as f64;
    let shrink = |i: usize| {
        let (start, end) = (i as f64 * step, (i + 1) as f64 * step);
        let last = (end.ceil() as usize).min(from);
        let overlap = |s: usize| (end.min((s + 1) as f64) - start.max(s as f64)) / step;
        let covered = (start as usize..last).map(|s| (s, overlap(s)));
        covered.filter(|&(_, weight)| weight > 1e-12).collect()
    };
    let grow = |i: usize| {
        let centre = ((i as f64 + 0.5) * step - 0.5).clamp(0.0, (from - 1) as f64);
        let first = centre.floor() as usize;
        let part = centre - first as f64;
        if part == 0.0 {
            vec![(first, 1.0)]
        } else {
            vec![(first, 1.0 - part), (first + 1, part)]
        }
    };
    if to < from {
        (0..to).map(shrink).collect()
    } else {
        (0..to).map(grow).collect()
    }
}

fn check_values(video: &Video) -> Result<()> {
    let bad = |v: &f32| !v.is_finite() || *v < 0.0;
    let Some(at) = video.data().iter().position(bad) else {
        return Ok(());
    };
    let shape = video.shape();
    let (t, pixel) = (at / shape.pixels(), at % shape.pixels());
    Err(Error::input(
        Parameter::Scene,
        format!(
            "{} at bin {t}, row {}, column {}",
            video.data()[at],
            pixel / shape.columns,
            pixel % shape.columns
        ),
        "light is a finite number and never negative",
        "Subtract the background of the video and set what is left below zero to zero.",
    )
    .with_kind(ErrorKind::NotFinite))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(shape: Shape) -> Video {
        Video::new(
            shape,
            (0..shape.voxels()).map(|i| (i % 97) as f32).collect(),
        )
        .unwrap()
    }

    #[test]
    fn the_same_shape_changes_nothing() {
        let video = ramp(Shape::new(3, 5, 7));
        assert_eq!(fit(&video, video.shape()).unwrap(), video);
    }

    #[test]
    fn shrinking_takes_means() {
        let video = ramp(Shape::new(4, 4, 6));
        let small = fit(&video, Shape::new(2, 2, 3)).unwrap();
        let mut want = 0.0;
        for t in 2..4 {
            for y in 0..2 {
                want += video.bin(t)[6 * y + 4] + video.bin(t)[6 * y + 5];
            }
        }
        assert!((small.bin(1)[2] - want / 8.0).abs() < 1e-5);
    }

    #[test]
    fn growing_interpolates_between_centres() {
        let video = Video::new(Shape::new(2, 1, 2), vec![0.0, 4.0, 8.0, 12.0]).unwrap();
        let large = fit(&video, Shape::new(4, 2, 4)).unwrap();
        assert_eq!(large.bin(0), &[0.0, 1.0, 3.0, 4.0, 0.0, 1.0, 3.0, 4.0]);
        assert_eq!(large.bin(1)[..4], [2.0, 3.0, 5.0, 6.0]);
    }

    #[test]
    fn the_aspect_ratio_is_kept_and_the_rest_is_zero() {
        let video = Video::new(Shape::new(1, 10, 30), vec![2.0; 300]).unwrap();
        let scene = fit(&video, Shape::new(1, 20, 15)).unwrap();
        for y in 0..20 {
            let want = if (7..12).contains(&y) { 2.0 } else { 0.0 };
            for x in 0..15 {
                assert!((scene.bin(0)[15 * y + x] - want).abs() < 1e-6, "{y} {x}");
            }
        }
    }

    #[test]
    fn weights_sum_to_one() {
        for (from, to) in [(7, 3), (3, 7), (10, 9), (1, 5), (5, 1), (54, 53)] {
            for weights in resampling(from, to) {
                let sum: f64 = weights.iter().map(|w| w.1).sum();
                assert!((sum - 1.0).abs() < 1e-12, "{from} {to}");
            }
        }
    }

    #[test]
    fn bad_values_are_refused() {
        for bad in [f32::NAN, f32::INFINITY, -0.5] {
            let mut video = ramp(Shape::new(2, 3, 4));
            video.data_mut()[12 + 6] = bad;
            let message = fit(&video, Shape::new(2, 3, 4)).unwrap_err().to_string();
            assert!(message.contains("bin 1, row 1, column 2"), "{message}");
        }
        assert!(fit(&ramp(Shape::new(2, 3, 4)), Shape::new(0, 3, 4)).is_err());
    }
}
