//! Where the light of a field point lands: reach, loss, and the mean square of the PSF.
//!
//! Field row `y'` lies at sensor position `y' − o`; from there the light goes to sensor
//! row `r` by the displacement `d = r − (y' − o)`. The two displacements that count are
//! those from the bottom row of the field to the top row of the sensor and back.
//!
//! Without a PSF the envelope is the Gaussian of [`rowburst_simulate::speckle`], which is
//! separable, `p(dy, dx) = g(dy) g(dx)` with `g(d) = exp(−d²/2σ²)/(σ√2π)`; with one, its
//! values are summed themselves.

use rowburst_optics::{Camera, Image, Psf};

/// Full width at half maximum of a Gaussian over its standard deviation, `√(8 ln 2)`.
pub(super) const FWHM_PER_SIGMA: f64 = 2.354_820_045;

/// Where the light lands.
#[derive(Debug, Clone, PartialEq)]
pub struct Spread {
    /// Rows from the far end of the field to the far end of the sensor.
    pub needed_px: usize,
    /// Light that the worst row gets from the other end of the field, over that of a row
    /// level with the source.
    pub reach: f64,
    /// Light of each sensor row over that of a row level with the source,
    /// `[source row, sensor row]`; of long sides, up to 256 rows evenly spaced.
    pub rows: Image,
    /// Part of the light that misses the sensor: mean over the field.
    pub lost_mean: f64,
    /// The same for the worst place of the field.
    pub lost_worst: f64,
    /// Mean of the PSF over all pairs of field point and pixel.
    pub(super) mean: f64,
    /// Mean of its square over the same.
    pub(super) mean_square: f64,
    /// Mean over the pixels of the square of the mean over the field.
    pub(super) square_of_mean: f64,
}

/// Rows of the map from source to sensor.
const MAX_MAP_ROWS: usize = 256;

/// Field and sensor along one axis.
struct Axis {
    field: usize,
    sensor: usize,
    offset: usize,
}

impl Axis {
    /// Displacement from field pixel `from` to sensor pixel `to`.
    fn displacement(&self, from: usize, to: usize) -> isize {
        to as isize + self.offset as isize - from as isize
    }

    /// The largest displacements, to the start and to the end of the sensor.
    fn ends(&self) -> (isize, isize) {
        (
            self.displacement(self.field - 1, 0),
            self.displacement(0, self.sensor - 1),
        )
    }

    /// Mean of `g`, of `g²`, and mean over the sensor of the squared mean over the field;
    /// mean and smallest sum over the sensor.
    fn means(&self, g: impl Fn(isize) -> f64) -> [f64; 5] {
        let (field, sensor) = (self.field as f64, self.sensor as f64);
        // Running sums of g over all displacements make every sum a difference.
        let (first, last) = self.ends();
        let mut running = vec![0.0];
        let mut square = 0.0;
        for d in first..=last {
            let value = g(d);
            square += value * value * self.pairs(d);
            running.push(running[running.len() - 1] + value);
        }
        let over = |from: isize, count: usize| {
            let start = (from - first) as usize;
            running[start + count] - running[start]
        };
        let shares = (0..self.field).map(|from| over(self.displacement(from, 0), self.sensor));
        let (total, smallest) = shares.fold((0.0, f64::INFINITY), |(sum, least), share| {
            (sum + share, f64::min(least, share))
        });
        let from_field =
            (0..self.sensor).map(|to| over(self.displacement(self.field - 1, to), self.field));
        let of_mean: f64 = from_field.map(|sum| (sum / field).powi(2)).sum();
        [
            total / (field * sensor),
            square / (field * sensor),
            of_mean / sensor,
            total / field,
            smallest,
        ]
    }

    /// `g` over source and sensor, thinned out where there are many.
    fn map(&self, g: impl Fn(isize) -> f64) -> Image {
        let sides = [self.field, self.sensor].map(|n| n.min(MAX_MAP_ROWS));
        Image::from_fn(sides[0], sides[1], |i, j| {
            let (from, to) = (i * self.field / sides[0], j * self.sensor / sides[1]);
            g(self.displacement(from, to)) as f32
        })
    }

    /// Pairs of field and sensor pixel that lie `d` apart.
    fn pairs(&self, d: isize) -> f64 {
        let first = 0.max(d - self.offset as isize);
        let last = (self.sensor as isize).min(d - self.offset as isize + self.field as isize);
        (last - first).max(0) as f64
    }
}

fn axes(camera: &Camera) -> [Axis; 2] {
    let (field_rows, field_columns) = camera.field();
    let (oy, ox) = camera.field_offset();
    [
        Axis {
            field: field_rows,
            sensor: camera.rows(),
            offset: oy,
        },
        Axis {
            field: field_columns,
            sensor: camera.columns(),
            offset: ox,
        },
    ]
}

/// The larger of the two displacements across field and sensor, in rows.
pub fn needed_rows(camera: &Camera) -> usize {
    let (up, down) = axes(camera)[0].ends();
    up.unsigned_abs().max(down.unsigned_abs())
}

impl Spread {
    /// That of a Gaussian envelope of speckle of the given contrast in the pixels.
    pub fn gaussian(camera: &Camera, fwhm_px: f64, contrast: f64) -> Self {
        let sigma = fwhm_px / FWHM_PER_SIGMA;
        let relative = |d: isize| (-0.5 * (d as f64 / sigma).powi(2)).exp();
        let scale = 1.0 / (sigma * std::f64::consts::TAU.sqrt());
        let [y, x] = axes(camera);
        let needed_px = needed_rows(camera);
        let rows = y.map(relative);
        let [y, x] = [&y, &x].map(|axis| axis.means(|d| scale * relative(d)));
        Self {
            needed_px,
            reach: relative(needed_px as isize),
            rows,
            lost_mean: (1.0 - y[3] * x[3]).max(0.0),
            lost_worst: (1.0 - y[4] * x[4]).max(0.0),
            mean: y[0] * x[0],
            mean_square: y[1] * x[1] * (1.0 + contrast * contrast),
            square_of_mean: y[2] * x[2],
        }
    }

    /// That of a PSF. Light that misses its image is not known and not counted as lost.
    pub fn of_psf(camera: &Camera, psf: &Psf) -> Self {
        let [y, x] = axes(camera);
        let needed_px = needed_rows(camera);
        let profile = RowProfile::new(psf, needed_px);
        let (up, down) = y.ends();
        let rows = y.map(|d| profile.at(d));

        let sums = Sums::new(psf);
        // The displacements from one field point to the whole sensor, and from the whole
        // field to one pixel.
        let onto = |axis: &Axis, from| {
            let first = axis.displacement(from, 0);
            (first, first + axis.sensor as isize)
        };
        let into = |axis: &Axis, to| {
            let first = axis.displacement(axis.field - 1, to);
            (first, first + axis.field as isize)
        };
        let (mut total, mut smallest) = (0.0, f64::INFINITY);
        for from_y in 0..y.field {
            for from_x in 0..x.field {
                let share = sums.over(onto(&y, from_y), onto(&x, from_x));
                total += share;
                smallest = f64::min(smallest, share);
            }
        }
        let field = (y.field * x.field) as f64;
        let pixels = (y.sensor * x.sensor) as f64;
        let mut of_mean = 0.0;
        for to_y in 0..y.sensor {
            for to_x in 0..x.sensor {
                of_mean += (sums.over(into(&y, to_y), into(&x, to_x)) / field).powi(2);
            }
        }
        Self {
            needed_px,
            reach: profile.at(up).min(profile.at(down)),
            rows,
            lost_mean: (1.0 - total / field).max(0.0),
            lost_worst: (1.0 - smallest).max(0.0),
            mean: total / (field * pixels),
            mean_square: mean_square(psf, &y, &x) / (field * pixels),
            square_of_mean: of_mean / pixels,
        }
    }
}

/// Sum over all pairs of field point and pixel of the square of the PSF between them.
fn mean_square(psf: &Psf, y: &Axis, x: &Axis) -> f64 {
    let image = psf.image();
    let (middle_y, middle_x) = (image.rows() as isize / 2, image.columns() as isize / 2);
    let across: Vec<f64> = (0..image.columns() as isize)
        .map(|i| x.pairs(i - middle_x))
        .collect();
    (0..image.rows())
        .map(|i| {
            let row = image.row(i).iter().zip(&across);
            let sum: f64 = row.map(|(&p, n)| f64::from(p).powi(2) * n).sum();
            sum * y.pairs(i as isize - middle_y)
        })
        .sum()
}

/// Light of each row of a PSF, smoothed and over the brightest.
struct RowProfile {
    values: Vec<f64>,
    middle: isize,
}

/// Rows of smoothing for each row of displacement that is needed: enough to level the
/// grains, too few to change the envelope.
const SMOOTHING: f64 = 0.05;

impl RowProfile {
    fn new(psf: &Psf, needed: usize) -> Self {
        let image = psf.image();
        let sums: Vec<f64> = (0..image.rows())
            .map(|y| image.row(y).iter().map(|&p| f64::from(p)).sum())
            .collect();
        let reach = (SMOOTHING * needed as f64).round() as usize;
        let smooth = |y: usize| {
            let window = &sums[y.saturating_sub(reach)..(y + reach + 1).min(sums.len())];
            window.iter().sum::<f64>() / window.len() as f64
        };
        let mut values: Vec<f64> = (0..sums.len()).map(smooth).collect();
        let peak = values.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        values.iter_mut().for_each(|v| *v /= peak);
        Self {
            values,
            middle: image.rows() as isize / 2,
        }
    }

    fn at(&self, d: isize) -> f64 {
        usize::try_from(d + self.middle)
            .ok()
            .and_then(|i| self.values.get(i))
            .copied()
            .unwrap_or(0.0)
    }
}

/// Sums of a PSF over rectangles of displacements, by its running sums.
struct Sums {
    rows: isize,
    columns: isize,
    running: Vec<f64>,
}

impl Sums {
    fn new(psf: &Psf) -> Self {
        let image = psf.image();
        let wide = image.columns() + 1;
        let mut running = vec![0.0; (image.rows() + 1) * wide];
        for y in 0..image.rows() {
            let mut row = 0.0;
            for (x, &p) in image.row(y).iter().enumerate() {
                row += f64::from(p);
                running[(y + 1) * wide + x + 1] = running[y * wide + x + 1] + row;
            }
        }
        Self {
            rows: image.rows() as isize,
            columns: image.columns() as isize,
            running,
        }
    }

    /// Over displacements from the first (inclusive) to the second (exclusive) of each.
    fn over(&self, dy: (isize, isize), dx: (isize, isize)) -> f64 {
        let y = |d: isize| (d + self.rows / 2).clamp(0, self.rows) as usize;
        let x = |d: isize| (d + self.columns / 2).clamp(0, self.columns) as usize;
        let at = |y: usize, x: usize| self.running[y * (self.columns as usize + 1) + x];
        let (y0, y1, x0, x1) = (y(dy.0), y(dy.1), x(dx.0), x(dx.1));
        at(y1, x1) - at(y0, x1) - at(y1, x0) + at(y0, x0)
    }
}
