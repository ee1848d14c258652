//! Raw frames behind a Bayer mosaic, as four planes that are cameras of their own.
//!
//! A site `(p, q)` of the 2×2 cell sees the pixels `(2i + p, 2j + q)`. On a scene grid of whole cells,
//! the same for all sites, its plane is a frame of half the size,
//! `b_pq[i, j] = Σ_{I,J} v[I, J] · p_pq(i − I, j − J)`, with
//! `p_pq(d, e) = Σ_{a,b ∈ {0,1}} p(2d + p − a, 2e + q − b)`:
//! each displacement of the PSF is in it once, so that it sums to 1 as well.
//!
//! Row `i` of the plane is sensor row `2i + p`, and read when that is. Where the sensor's order
//! gives a plane every second instant (`top-down`), its row time is twice the sensor's, and the two
//! row parities are a row time apart; a dual shutter whose halves meet in different parities gives
//! every plane a row in each instant, and nothing is lost in time.

use crate::camera::CameraParams;
use crate::{Camera, Image, PatchSet, Psf, Sensor, Shutter};
use rowburst_core::{Error, ErrorKind, Parameter, Result, phrase};

/// Which colour stands where in a cell of 2×2 pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bayer {
    /// Red and green in the first row, green and blue in the second.
    Rggb,
    /// Blue and green, green and red.
    Bggr,
    /// Green and red, blue and green.
    Grbg,
    /// Green and blue, red and green.
    Gbrg,
}

/// What a plane sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Colour {
    /// Red.
    Red,
    /// Green; there are two of it.
    Green,
    /// Blue.
    Blue,
}

/// A site of the cell: a plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Site {
    /// Its row in the cell, 0 or 1.
    pub row: usize,
    /// Its column in the cell, 0 or 1.
    pub column: usize,
    /// What it sees.
    pub colour: Colour,
}

impl Site {
    /// A name that no other site of the cell has, such as "green-1".
    pub fn name(&self) -> String {
        match self.colour {
            Colour::Red => "red".into(),
            Colour::Blue => "blue".into(),
            Colour::Green => format!("green-{}", self.row + 1),
        }
    }
}

impl Bayer {
    /// Names, as the experiment file spells them.
    pub const NAMES: [&'static str; 4] = ["rggb", "bggr", "grbg", "gbrg"];

    /// The mosaic of a name, in small or capital letters.
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name.to_ascii_lowercase().as_str() {
            "rggb" => Self::Rggb,
            "bggr" => Self::Bggr,
            "grbg" => Self::Grbg,
            "gbrg" => Self::Gbrg,
            _ => return None,
        })
    }

    /// The name in the experiment file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rggb => "rggb",
            Self::Bggr => "bggr",
            Self::Grbg => "grbg",
            Self::Gbrg => "gbrg",
        }
    }

    /// The four sites, row by row.
    pub fn sites(self) -> [Site; 4] {
        let mut at = 0;
        let colours = self.name().as_bytes();
        [(0, 0), (0, 1), (1, 0), (1, 1)].map(|(row, column)| {
            let colour = match colours[at] {
                b'r' => Colour::Red,
                b'g' => Colour::Green,
                _ => Colour::Blue,
            };
            at += 1;
            Site {
                row,
                column,
                colour,
            }
        })
    }
}

/// A plane as a camera, and when it is.
#[derive(Debug, Clone, PartialEq)]
pub struct PlaneCamera {
    /// Half the sensor's rows and columns, read when those rows are.
    pub camera: Camera,
    /// Start of the plane's bin 0, from the start of exposure of the sensor's row that is read first.
    pub start_us: f64,
}

/// The camera that the plane of a site is.
///
/// # Errors
/// An odd number of rows or columns, binning, a field that does not hold whole cells, an order of
/// rows that reads the plane's rows at uneven times.
pub fn plane_camera(camera: &Camera, site: Site) -> Result<PlaneCamera> {
    let params = camera.params();
    let (field_rows, field_columns) = camera.field();
    let (row_offset, column_offset) = camera.field_offset();
    for (key, value) in [
        ("rows", params.rows),
        ("columns", params.columns),
        ("rows of the field", field_rows),
        ("columns of the field", field_columns),
        ("rows of the field above the sensor", row_offset),
        ("columns of the field beside the sensor", column_offset),
    ] {
        if !value.is_multiple_of(2) {
            return Err(Error::input(
                Parameter::Bayer,
                format!("{value} {key}"),
                "sensor and field hold whole cells of 2×2 pixels",
                phrase![
                    "Leave out the last row or column, or ",
                    Parameter::Field,
                    "."
                ],
            ));
        }
    }
    if params.sensor.binning != 1 {
        return Err(Error::input(
            Parameter::Bayer,
            format!("binning = {}", params.sensor.binning),
            "binning would mix the colours of the mosaic",
            "Leave binning out.",
        )
        .with_kind(ErrorKind::Unsupported));
    }
    let mut delay_us = 0.0;
    let (shutter, row_time_us) = match params.shutter {
        Shutter::Global => (Shutter::Global, params.row_time_us),
        _ => {
            let instants = camera.instants().iter().skip(site.row).step_by(2);
            let instants: Vec<usize> = instants.copied().collect();
            let (order, first, step) = evenly(&instants)?;
            // Instant k of the plane ends with the sensor's instant first + step·k, and exposures are equal.
            delay_us = first as f64 * params.row_time_us;
            (Shutter::Custom(order), params.row_time_us * step as f64)
        }
    };
    let camera = Camera::new(CameraParams {
        rows: params.rows / 2,
        columns: params.columns / 2,
        shutter,
        row_time_us,
        field: params.field.map(|(rows, columns)| (rows / 2, columns / 2)),
        sensor: Sensor {
            pixel_pitch_um: params.sensor.pixel_pitch_um.map(|pitch| 2.0 * pitch),
            ..params.sensor.clone()
        },
        ..params.clone()
    })?;
    let start_us = camera.time().start_us() + delay_us;
    let camera = camera.starting_at(start_us);
    Ok(PlaneCamera { camera, start_us })
}

/// Instants counted from the first in steps, such that none is left out: the order, the first and
/// the step.
fn evenly(instants: &[usize]) -> Result<(Vec<usize>, usize, usize)> {
    let first = instants.iter().copied().min().unwrap_or(0);
    let gcd = |mut a: usize, mut b: usize| {
        while b != 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let step = instants.iter().fold(0, |g, &k| gcd(g, k - first)).max(1);
    let order: Vec<usize> = instants.iter().map(|&k| (k - first) / step).collect();
    let mut read = vec![false; order.iter().max().map_or(0, |last| last + 1)];
    order.iter().for_each(|&k| read[k] = true);
    match read.iter().position(|read| !read) {
        None => Ok((order, first, step)),
        Some(k) => Err(Error::input(
            Parameter::Bayer,
            format!(
                "an order of rows in which a colour is not read at instant {}",
                first + step * k
            ),
            "the rows of each colour are read at even steps of time",
            "Check row_order.",
        )),
    }
}

/// Every second pixel of every second row, from that of the site on: a frame, a dark, a flat or a
/// mask of the plane.
///
/// # Panics
/// If `image` is smaller than a cell.
pub fn plane_image(image: &Image, site: Site) -> Image {
    Image::from_fn(image.rows() / 2, image.columns() / 2, |i, j| {
        image.at(2 * i + site.row, 2 * j + site.column)
    })
}

/// The PSF from the grid of cells to the pixels of a site, see the module.
///
/// # Errors
/// Those of [`Psf::new`].
pub fn plane_psf(psf: &Psf, site: Site) -> Result<Psf> {
    let image = psf.image();
    // Displacements 2d + p − a from −rows/2 to rows/2 have d within (rows/2 + 1)/2 of zero.
    let half = |side: usize| (side / 2 + 1).div_ceil(2);
    let (y, x) = (half(image.rows()), half(image.columns()));
    Psf::new(Image::from_fn(2 * y + 1, 2 * x + 1, |i, j| {
        let d = 2 * (i as isize - y as isize) + site.row as isize;
        let e = 2 * (j as isize - x as isize) + site.column as isize;
        let cell = [(0, 0), (0, 1), (1, 0), (1, 1)];
        cell.iter()
            .map(|(a, b)| psf.at_displacement(d - a, e - b))
            .sum()
    }))
}

/// [`plane_psf`] of all PSFs of a set.
///
/// # Errors
/// Those of [`Psf::new`].
pub fn plane_psfs(psfs: &PatchSet, site: Site) -> Result<PatchSet> {
    let planes = psfs.psfs().iter().map(|psf| plane_psf(psf, site));
    let offsets = psfs.offsets_px().iter().map(|(y, x)| (y / 2.0, x / 2.0));
    PatchSet::new(planes.collect::<Result<_>>()?, offsets.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RollingShutter, Video};
    use rowburst_core::Shape;
    use rowburst_core::linop::LinearOperator;

    fn camera(shutter: Shutter, rows: usize, exposure_us: f64) -> Camera {
        Camera::new(CameraParams {
            rows,
            columns: 10,
            shutter,
            row_time_us: 10.0,
            exposure_us,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap()
    }

    fn noise(i: usize) -> f32 {
        (i as f32 * 12.9898).sin().abs()
    }

    #[test]
    fn sites_have_their_colours() {
        let names = |b: Bayer| b.sites().map(|s| s.name());
        assert_eq!(names(Bayer::Rggb), ["red", "green-1", "green-2", "blue"]);
        assert_eq!(names(Bayer::Gbrg), ["green-1", "blue", "red", "green-2"]);
        for name in Bayer::NAMES {
            assert_eq!(Bayer::from_name(&name.to_uppercase()).unwrap().name(), name);
        }
    }

    #[test]
    fn planes_of_a_psf_sum_to_one() {
        for (rows, columns) in [(7, 9), (8, 6), (1, 1), (2, 3)] {
            let psf = Psf::new(Image::from_fn(rows, columns, |y, x| noise(y * 31 + x + 1)));
            let psf = psf.unwrap();
            for site in Bayer::Rggb.sites() {
                // Not by the scaling of Psf::new: before it.
                let half = |side: usize| (side / 2 + 1).div_ceil(2) as isize;
                let mut sum = 0.0;
                for d in -half(rows)..=half(rows) {
                    for e in -half(columns)..=half(columns) {
                        for (a, b) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                            let (y, x) = (
                                2 * d + site.row as isize - a,
                                2 * e + site.column as isize - b,
                            );
                            sum += psf.at_displacement(y, x);
                        }
                    }
                }
                assert!((sum - 1.0).abs() < 1e-5, "{rows}×{columns}: {sum}");
                plane_psf(&psf, site).unwrap();
            }
        }
    }

    /// A row of a plane is exposed when the sensor's row is, by the sensor's zero of time.
    #[test]
    fn planes_have_the_clock_of_the_sensor() {
        for exposure_us in [4.0, 10.0, 17.0, 30.0] {
            for shutter in [Shutter::TopDown, Shutter::BottomUp, Shutter::DualInsideOut] {
                let whole = camera(shutter, 8, exposure_us);
                for site in Bayer::Rggb.sites() {
                    let plane = plane_camera(&whole, site).unwrap();
                    let time = plane.camera.time();
                    assert_eq!(time.start_us(), plane.start_us);
                    for (row, &instant) in plane.camera.instants().iter().enumerate() {
                        let run = &time.instants()[instant];
                        let end = run.first_bin + run.weights.len();
                        let end_us = time.start_us() + end as f64 * time.bin_duration_us();
                        let on_sensor = whole.instants()[2 * row + site.row] as f64;
                        assert!((end_us - (on_sensor * 10.0 + exposure_us)).abs() < 1e-9);
                    }
                }
            }
        }
    }

    #[test]
    fn times_of_the_planes_are_those_of_their_rows() {
        let sites = Bayer::Rggb.sites();
        let plane = |shutter, rows, site| plane_camera(&camera(shutter, rows, 10.0), site).unwrap();
        // Every second instant: twice the row time. The first of the plane ends with the
        // sensor's, and begins one row time before it.
        let red = plane(Shutter::TopDown, 8, sites[0]);
        assert_eq!(red.camera.instants(), [0, 1, 2, 3]);
        assert_eq!(
            (red.camera.params().row_time_us, red.start_us),
            (20.0, -10.0)
        );
        let blue = plane(Shutter::TopDown, 8, sites[3]);
        assert_eq!((blue.camera.instants()[3], blue.start_us), (3, 0.0));
        // [3, 2, 1, 0, 0, 1, 2, 3]: rows 0, 2, 4, 6 at 3, 1, 0, 2.
        let dual = plane(Shutter::DualInsideOut, 8, sites[0]);
        assert_eq!(dual.camera.instants(), [3, 1, 0, 2]);
        assert_eq!(
            (dual.camera.params().row_time_us, dual.start_us),
            (10.0, 0.0)
        );
        let global = plane(Shutter::Global, 8, sites[0]);
        assert_eq!(global.camera.shutter(), &Shutter::Global);

        let uneven = Shutter::Custom(vec![0, 1, 2, 3, 6, 4, 5, 7]);
        assert!(plane_camera(&camera(uneven, 8, 10.0), sites[0]).is_err());
        assert!(plane_camera(&camera(Shutter::TopDown, 7, 10.0), sites[0]).is_err());
    }

    /// The planes of a simulated frame are what the planes' cameras see of the same scene.
    #[test]
    fn planes_agree_with_the_whole_sensor() {
        for (shutter, exposure_us) in [
            (Shutter::DualInsideOut, 10.0),
            (Shutter::DualOutsideIn, 15.0),
            (Shutter::TopDown, 20.0),
            (Shutter::BottomUp, 10.0),
            (Shutter::Global, 10.0),
        ] {
            let whole = camera(shutter, 12, exposure_us);
            let psf = Psf::new(Image::from_fn(7, 8, |y, x| noise(y * 8 + x + 3))).unwrap();
            for site in Bayer::Rggb.sites() {
                let PlaneCamera { camera, start_us } = plane_camera(&whole, site).unwrap();
                let shape = camera.video_shape();
                let step = (camera.params().row_time_us / 10.0).round() as usize;
                let data = (0..shape.voxels()).map(noise).collect();
                let scene = Video::new(shape, data).unwrap();
                // The same scene on the sensor's grid: cells of 2×2 pixels, and its bins at
                // their time.
                let fine = whole.video_shape();
                let mut on_sensor = Vec::new();
                for t in 0..fine.bins {
                    let from_first_bin_us = whole.time().middle_us(t) - start_us;
                    let bin =
                        (from_first_bin_us / camera.time().bin_duration_us()).floor() as isize;
                    for y in 0..fine.rows {
                        for x in 0..fine.columns {
                            let seen = (0..shape.bins as isize).contains(&bin);
                            let pixels = (y / 2) * shape.columns + x / 2;
                            let place = bin.max(0) as usize * shape.pixels() + pixels;
                            on_sensor.push(if seen { scene.data()[place] } else { 0.0 });
                        }
                    }
                }
                let see = |camera: &Camera, psf: &Psf, video: &[f32]| {
                    let operator = RollingShutter::new(camera, psf);
                    let mut frame = vec![0.0; camera.rows() * camera.columns()];
                    operator.apply(video, &mut frame);
                    Image::new(camera.rows(), camera.columns(), frame).unwrap()
                };
                assert_eq!(Shape::new(fine.bins, fine.rows, fine.columns), fine);
                let expected = plane_image(&see(&whole, &psf, &on_sensor), site);
                let found = see(&camera, &plane_psf(&psf, site).unwrap(), scene.data());
                // The plane counts exposures in its own row times.
                let scale = step as f32;
                for (a, b) in found.data().iter().zip(expected.data()) {
                    assert!(
                        (a * scale - b).abs() < 1e-4 * b.abs().max(1.0),
                        "{whole:?} {site:?}: {a} {b}"
                    );
                }
            }
        }
    }
}
