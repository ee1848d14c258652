//! A static, textured background: soft discs with a nucleus, and bars.
//!
//! What lies behind a moving thing on a microscope's slide or an optical bench. The picture
//! is smooth with few edges and covers about a tenth of the field, so that it is sparse in
//! total variation and not in pixels:
//!
//! ```text
//! v'[t, y, x] = v[t, y, x] + times · max(v) · p[y, x],      max(p) = 1
//! ```

use super::require_field_size;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rowburst_core::error::Place;
use rowburst_core::{Error, ErrorKind, Parameter, Result, Shape};
use rowburst_optics::{Image, Video};

/// Smallest side of a field: the smallest disc is then a pixel across.
const MIN_SIDE: usize = 12;

/// Discs and bars. With their sizes they cover 8 to 15 % of a square field.
const DISCS: usize = 3;
const BARS: usize = 2;

/// Radius of a disc, and width and length of a bar, over the field's shorter side.
const RADIUS: std::ops::Range<f64> = 0.07..0.11;
const WIDTH: std::ops::Range<f64> = 0.025..0.04;
const LENGTH: std::ops::Range<f64> = 0.25..0.4;

/// A disc outside its nucleus over the nucleus.
const BODY: f64 = 0.55;

/// Width of an edge (logistic) over the field's shorter side, and the least in pixels: that
/// of an image in focus.
const EDGE: f64 = 0.008;
const MIN_EDGE_PX: f64 = 0.7;

/// What is fainter is dark: an edge that never ends would leave no dark pixel.
const MIN_BRIGHTNESS: f64 = 0.01;

/// Tells the background's random numbers from those of the scene of the same seed, so that
/// a scene is the same with and without.
const STREAM: u64 = 0x6261_636b;

/// A thing of the background.
enum Part {
    Disc { radius: f64, nucleus: (f64, f64) },
    Bar { along: (f64, f64), half_width: f64 },
}

/// A picture of the pixels of `shape`, its brightest pixel 1, most of them 0.
///
/// # Errors
/// A field with a side below 12 pixels.
pub fn background(shape: Shape, seed: u64) -> Result<Image> {
    require_field_size(shape, MIN_SIDE, MIN_SIDE, "a background")?;
    let mut rng = Pcg64::seed_from_u64(seed ^ STREAM);
    let side = shape.rows.min(shape.columns) as f64;
    let edge = (EDGE * side).max(MIN_EDGE_PX);
    let mut picture = Image::zeros(shape.rows, shape.columns);
    for i in 0..DISCS + BARS {
        let margin = RADIUS.end * side;
        let mut within =
            |length: usize| margin + (length as f64 - 2.0 * margin).max(0.0) * rng.random::<f64>();
        let centre = (within(shape.rows), within(shape.columns));
        let brightness = rng.random_range(0.6..1.0);
        let angle = rng.random_range(0.0..std::f64::consts::TAU);
        let part = if i < DISCS {
            let radius = side * rng.random_range(RADIUS);
            let nucleus = (0.35 * radius * angle.sin(), 0.35 * radius * angle.cos());
            Part::Disc { radius, nucleus }
        } else {
            let half = 0.5 * side * rng.random_range(LENGTH);
            Part::Bar {
                along: (half * angle.sin(), half * angle.cos()),
                half_width: 0.5 * side * rng.random_range(WIDTH),
            }
        };
        for y in 0..shape.rows {
            for x in 0..shape.columns {
                let offset = (y as f64 - centre.0, x as f64 - centre.1);
                let value = brightness * part.at(offset, edge);
                if value >= MIN_BRIGHTNESS {
                    let pixel = &mut picture.data_mut()[y * shape.columns + x];
                    *pixel = pixel.max(value as f32);
                }
            }
        }
    }
    let peak = picture.max();
    picture.data_mut().iter_mut().for_each(|p| *p /= peak);
    Ok(picture)
}

impl Part {
    /// Brightness, 0 to 1, at an offset `(y, x)` from the centre.
    fn at(&self, (y, x): (f64, f64), edge: f64) -> f64 {
        let inside = |depth: f64| 1.0 / (1.0 + (-depth / edge).exp());
        match *self {
            Self::Disc { radius, nucleus } => {
                let body = inside(radius - y.hypot(x));
                let core = inside(0.4 * radius - (y - nucleus.0).hypot(x - nucleus.1));
                body * (BODY + (1.0 - BODY) * core)
            }
            Self::Bar { along, half_width } => {
                let square = along.0 * along.0 + along.1 * along.1;
                let part = ((y * along.0 + x * along.1) / square).clamp(-1.0, 1.0);
                inside(half_width - (y - part * along.0).hypot(x - part * along.1))
            }
        }
    }
}

/// Adds `picture` to every bin of `video`, scaled so that its brightest pixel is `times` as
/// bright as the brightest voxel was; gives the picture as it was added.
///
/// # Errors
/// `times` that is not a number above zero, a dark video, a picture that is dark.
///
/// # Panics
/// If the picture has not the size of a bin.
pub fn add_background(video: &mut Video, picture: &Image, times: f64) -> Result<Image> {
    let shape = video.shape();
    assert_eq!(
        (picture.rows(), picture.columns()),
        (shape.rows, shape.columns),
        "a background has the size of the field"
    );
    if !(times.is_finite() && times > 0.0) {
        return Err(Error::input(
            Parameter::Background,
            times,
            "a background is a number of times as bright as the scene, above zero",
            "Leave it out for none.",
        ));
    }
    let (brightest, peak) = (f64::from(video.max()), f64::from(picture.max()));
    if !(brightest > 0.0 && peak > 0.0) {
        return Err(Error::input(
            Parameter::Scene,
            format!("a brightest value of {brightest}"),
            "a background is as bright in proportion to a scene that has light",
            "Take a scene that is not dark, or leave the background out.",
        )
        .with_kind(ErrorKind::NoSignal)
        .within(Place::Setting(Parameter::Background, times.to_string())));
    }
    let scale = times * brightest / peak;
    let scaled = |p: &f32| (scale * f64::from(*p)) as f32;
    let values: Vec<f32> = picture.data().iter().map(scaled).collect();
    for t in 0..shape.bins {
        for (voxel, value) in video.bin_mut(t).iter_mut().zip(&values) {
            *voxel += value;
        }
    }
    Image::new(shape.rows, shape.columns, values)
}

#[cfg(test)]
mod tests {
    use super::super::moving_digit;
    use super::*;

    const SHAPE: Shape = Shape {
        bins: 6,
        rows: 60,
        columns: 90,
    };

    #[test]
    fn covers_a_part_of_the_field_smoothly() {
        for seed in 0..30 {
            let picture = background(Shape::new(1, 108, 108), seed).unwrap();
            assert_eq!(picture.max(), 1.0);
            let lit = picture.data().iter().filter(|&&p| p > 0.0).count() as f64 / 11_664.0;
            let mean = picture.data().iter().sum::<f32>() / 11_664.0;
            assert!((0.05..0.25).contains(&lit), "{seed}: {lit}");
            assert!((0.02..0.12).contains(&mean), "{seed}: {mean}");
            let step = |a: f32, b: f32| (a - b).abs();
            let steepest = (0..107 * 108)
                .map(|i| step(picture.data()[i], picture.data()[i + 108]))
                .fold(0.0, f32::max);
            // Of a hard edge it would be the brightness of the part, 0.6 or more.
            assert!(steepest < 0.5, "{seed}: {steepest}");
        }
    }

    #[test]
    fn is_as_bright_as_asked_and_the_same_in_every_bin() {
        let scene = moving_digit(SHAPE, 12, 1, 4).unwrap();
        let picture = background(SHAPE, 4).unwrap();
        let mut whole = scene.clone();
        let added = add_background(&mut whole, &picture, 3.0).unwrap();
        assert!((added.max() - 3.0 * scene.max()).abs() < 1e-5);
        for t in 0..SHAPE.bins {
            let pairs = whole.bin(t).iter().zip(scene.bin(t)).zip(added.data());
            for ((whole, moving), still) in pairs {
                assert!((whole - moving - still).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn seeds_decide() {
        assert_eq!(background(SHAPE, 1), background(SHAPE, 1));
        assert_ne!(background(SHAPE, 1), background(SHAPE, 2));
    }

    #[test]
    fn bad_input_is_refused() {
        assert!(background(Shape::new(1, 11, 90), 0).is_err());
        let picture = background(SHAPE, 0).unwrap();
        for times in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let mut scene = moving_digit(SHAPE, 12, 1, 4).unwrap();
            let error = add_background(&mut scene, &picture, times).unwrap_err();
            assert!(error.to_string().contains("background"), "{error}");
        }
        assert!(add_background(&mut Video::zeros(SHAPE), &picture, 1.0).is_err());
    }
}
