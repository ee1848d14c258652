//! The video of a motion and its derivative.
//!
//! ```text
//! v(x, t) = Σ_i w_i(p, t) G_i(x_i + d(x_i)),   x_i = X(p, t_i),   X(p, t) = x
//! X(p, t) = p + Σ_k (τ_k(t) − τ_k(t₀)) θ_k(p)
//! ```
//!
//! Each point `p` of the scene carries its displacements `θ_k` with it, so that a thing before a still background moves as a
//! whole. `G_i` are the guides, `d` is the affine map from the field to them, `t_i` are their times, and `t₀` is the time of the
//! guide that is nearest to the middle. Guides that do not see the point have no weight `w_i`; the others have that of their
//! share, which passes from one guide to the next. `τ_k` are the modes of a free beam. Where the time of a single guide is
//! unknown, `τ_k(t_i)` and `τ_k(t₀)` are left out and `k` begins at 0.
//!
//! The derivative is `δv = −∇v · δX(p, t) + Σ_i w_i ∇G_i · (δX(p, t_i) + δd(p))`, where the small `∇d` is left out beside 1, and
//! points are rounded to pixels.

use super::affine::{Affine, Field};
use super::basis::{Spline, beam_mode};
use super::key_frames::{KeyFrame, nearest_to_middle, shares, time_of};
use super::mesh::{Drawing, Mesh};
use super::picture::{self, GuideSample};
use rayon::prelude::*;
use rowburst_core::Shape;
use rowburst_core::vecmath::norm_squared;
use rowburst_optics::Image;

/// Pixels between control points on a field of 108; larger is smoother.
const SPACING_PX: f64 = 6.0;
/// Parts of the bins whose sums are formed in parallel.
const PARTS: usize = 8;
/// A point is hidden where the point that is drawn at its place is at least so far from it, in pixels of a field of 108.
const VISIBLE_PX: f32 = 3.0;
/// Share of a guide of another time, for points that the guides before and after do not see.
const MIN_SHARE: f32 = 1e-3;

/// The motion without its parameters, which are `[axis][value]`, y before x: the sets of control points of `θ_k`, then the three
/// parameters of the affine map's change.
pub(super) struct Flow {
    shape: Shape,
    field: Field,
    spline: Spline,
    mesh: Mesh,
    /// `τ_k(t) − τ_k(t₀)` of each bin, `[k][t]`, and of each guide, `[i][k]`.
    times: Vec<Vec<f32>>,
    guide_times: Vec<Vec<f32>>,
    /// Share of each guide, `[i][t]`.
    shares: Vec<Vec<f32>>,
    start: Affine,
    /// Width of the margin of the guides' pictures in pixels.
    margin: f32,
}

/// A video, and the point that each voxel shows.
pub(super) struct DrawnVideo {
    pub video: Vec<f32>,
    /// The point `(y, x)` of each voxel.
    points: Vec<[f32; 2]>,
    /// Whether each of several guides sees each point, `[i][p]`.
    visible: Vec<Vec<bool>>,
}

/// The derivative of the video. Its terms are the video and each of the guides.
pub(super) struct Derivative<'f> {
    flow: &'f Flow,
    /// The point of each voxel as an index of the field.
    indices: Vec<u32>,
    /// `−∇v`, then `w_i ∇G_i` of each guide, `[axis][term][t, y, x]`.
    gradients: [Vec<Vec<f32>>; 2],
}

impl Flow {
    /// Motions with the modes `orders` in time, from the affine map `start`.
    pub fn new(
        shape: Shape,
        guides: &[KeyFrame],
        start: Affine,
        orders: std::ops::RangeInclusive<usize>,
        margin: usize,
    ) -> Self {
        let field = Field::of(shape);
        let unit = field.half_side() / 54.0;
        let reference = nearest_to_middle(guides, shape.bins);
        let at_start = |k: usize| time_of(&guides[reference], k, shape.bins);
        let bin_times = |k: usize| {
            let line = (0..shape.bins).map(|t| beam_mode(k, t as f64, shape.bins) - at_start(k));
            line.map(|time| time as f32).collect()
        };
        let guide_times = |guide: &KeyFrame| {
            let times = orders.clone();
            let times = times.map(|k| time_of(guide, k, shape.bins) - at_start(k));
            times.map(|time| time as f32).collect()
        };
        Self {
            shape,
            spline: Spline::new(shape.rows, shape.columns, SPACING_PX * unit),
            mesh: Mesh::new(shape.rows, shape.columns, unit),
            times: orders.clone().map(bin_times).collect(),
            guide_times: guides.iter().map(guide_times).collect(),
            shares: shares(guides, shape.bins),
            field,
            start,
            margin: margin as f32,
        }
    }

    /// The splines of the displacements.
    pub fn spline(&self) -> &Spline {
        &self.spline
    }

    /// Number of displacement fields `θ_k`.
    pub fn modes(&self) -> usize {
        self.times.len()
    }

    /// Parameters along one axis.
    pub fn axis_len(&self) -> usize {
        self.modes() * self.spline.points() + 3
    }

    /// The control points along y and x.
    pub fn control<'v>(&self, values: &'v [f32]) -> [&'v [f32]; 2] {
        let (y, x) = values.split_at(self.axis_len());
        let length = self.modes() * self.spline.points();
        [&y[..length], &x[..length]]
    }

    /// Factor of the affine parameters, which gives them the curvature of a control point's.
    pub fn affine_scale(&self) -> f32 {
        2.0 / (self.spline.points() as f32).sqrt()
    }

    /// The affine map, its change included.
    pub fn affine(&self, values: &[f32]) -> Affine {
        let (n, scale) = (self.axis_len(), f64::from(self.affine_scale()));
        let change = |k: usize| {
            let axis = &values[(k / 3) * n..(k / 3 + 1) * n];
            scale * f64::from(axis[n - 3 + k % 3])
        };
        let parameters = std::array::from_fn(|k| self.start.parameters[k] + change(k));
        Affine { parameters }
    }

    /// The values `known` of a flow with the modes from 1 on and a guide at the place `bin`, for this one, whose modes begin at 0
    /// and whose guide has no time: `θ_0 = −Σ_k τ_k(bin) θ_k`.
    pub fn of_known_time(&self, known: &[f32], bin: f64) -> Vec<f32> {
        let points = self.spline.points();
        let axes = known.chunks_exact(known.len() / 2);
        let values = axes.flat_map(|axis| {
            let (modes, affine) = axis.split_at(axis.len() - 3);
            let mut still = vec![0.0f32; points];
            for (k, mode) in modes.chunks_exact(points).enumerate() {
                let time = beam_mode(1 + k, bin, self.shape.bins) as f32;
                still.iter_mut().zip(mode).for_each(|(s, m)| *s -= time * m);
            }
            [&still, modes, affine].concat()
        });
        values.collect()
    }

    fn pixels(&self) -> usize {
        self.field.rows * self.field.columns
    }

    fn image(&self) -> Image {
        Image::zeros(self.field.rows, self.field.columns)
    }

    /// Images of the displacement along each axis, `[axis][mode, y, x]`; the last mode is the affine change.
    fn displacements(&self, values: &[f32]) -> [Vec<f32>; 2] {
        let (n, pixels) = (self.axis_len(), self.pixels());
        std::array::from_fn(|axis| {
            let values = &values[axis * n..(axis + 1) * n];
            let (control, affine) = values.split_at(n - 3);
            let mut images = self.spline.expand(control);
            let scale = self.affine_scale();
            images.extend((0..pixels).map(|i| {
                let (eta, xi) = self.field.place(i);
                scale * (affine[0] + affine[1] * eta + affine[2] * xi)
            }));
            images
        })
    }

    /// Factor of mode `m` in the displacement of the points in bin `t` (term 0) or at the time of guide `i` (term `1 + i`). The
    /// last mode is the affine change, of the guides alone.
    fn factor(&self, term: usize, m: usize, t: usize) -> f32 {
        match (term, m == self.modes()) {
            (0, true) => 0.0,
            (_, true) => 1.0,
            (0, false) => self.times[m][t],
            (i, false) => self.guide_times[i - 1][m],
        }
    }

    /// Sum of the displacement images with the factors of `term` in bin `t`.
    fn displacement(&self, images: &[f32], term: usize, t: usize, out: &mut [f32]) {
        out.fill(0.0);
        for (m, image) in images.chunks_exact(out.len()).enumerate() {
            let factor = self.factor(term, m, t);
            if factor != 0.0 {
                out.iter_mut()
                    .zip(image)
                    .for_each(|(d, u)| *d += factor * u);
            }
        }
    }

    /// Displacements of the points at the time of each guide, along y and x; `None` at rest, as at `t₀`.
    fn guide_shifts(&self, images: &[Vec<f32>; 2]) -> Vec<Option<[Image; 2]>> {
        let shift = |i: usize, axis: usize| {
            let mut shift = self.image();
            let modes = &images[axis][..self.modes() * self.pixels()];
            self.displacement(modes, 1 + i, 0, shift.data_mut());
            shift
        };
        let is_at_rest = |i: usize| self.guide_times[i].iter().all(|time| *time == 0.0);
        (0..self.guide_times.len())
            .map(|i| (!is_at_rest(i)).then(|| std::array::from_fn(|axis| shift(i, axis))))
            .collect()
    }

    /// The place of a point in a guide.
    fn place_in_guide(
        &self,
        affine: &Affine,
        shifts: Option<&[Image; 2]>,
        [y, x]: [f32; 2],
    ) -> [f32; 2] {
        let [y, x] = match shifts {
            Some([shift_y, shift_x]) => [
                y + picture::at(shift_y, y, x).0,
                x + picture::at(shift_x, y, x).0,
            ],
            None => [y, x],
        };
        let [dy, dx] = self.field.displacement_at(affine, y, x);
        [y + dy + self.margin, x + dx + self.margin]
    }

    /// Whether each of several guides sees each point, `[i][p]`: the point is what is drawn at its place.
    fn visible(&self, shifts: &[Option<[Image; 2]>]) -> Vec<Vec<bool>> {
        if shifts.len() == 1 {
            return Vec::new();
        }
        let columns = self.field.columns;
        let limit = VISIBLE_PX * self.field.half_side() as f32 / 54.0;
        let of_guide = |shifts: &Option<[Image; 2]>| {
            let Some(shifts) = shifts else {
                return vec![true; self.pixels()];
            };
            let mut points = vec![[0.0; 2]; self.pixels()];
            self.mesh.draw(shifts, &mut Drawing::default(), &mut points);
            let is_visible = |p: usize| {
                let (y, x) = ((p / columns) as f32, (p % columns) as f32);
                let at = self.index([y + shifts[0].data()[p], x + shifts[1].data()[p]]);
                let [found_y, found_x] = points[at as usize];
                (found_y - y).hypot(found_x - x) < limit
            };
            (0..self.pixels()).map(is_visible).collect()
        };
        shifts.iter().map(of_guide).collect()
    }

    /// Index of the pixel of the field that is nearest to a place.
    fn index(&self, [y, x]: [f32; 2]) -> u32 {
        let Field { rows, columns } = self.field;
        let y = y.round().clamp(0.0, rows as f32 - 1.0) as usize;
        let x = x.round().clamp(0.0, columns as f32 - 1.0) as usize;
        (y * columns + x) as u32
    }

    /// Weight of guide `i` for the point `p` in bin `t`: its share among the guides that see the point.
    fn weight(&self, visible: &[Vec<bool>], i: usize, p: [f32; 2], t: usize) -> f32 {
        if visible.is_empty() {
            return 1.0;
        }
        let p = self.index(p) as usize;
        let part = |j: usize| {
            let is_visible = visible[j][p];
            (self.shares[j][t] + MIN_SHARE) * f32::from(u8::from(is_visible))
        };
        // The guide at t₀ sees every point.
        part(i) / (0..visible.len()).map(part).sum::<f32>()
    }

    /// What a voxel that shows a point in a bin takes of guide `i`, whose points are displaced by `shifts`.
    fn sampler<'a>(
        &'a self,
        affine: Affine,
        shifts: Option<&'a [Image; 2]>,
        visible: &'a [Vec<bool>],
        i: usize,
    ) -> impl Fn([f32; 2], usize) -> GuideSample + Sync + 'a {
        move |point, t| GuideSample {
            at: self.place_in_guide(&affine, shifts, point),
            weight: self.weight(visible, i, point, t),
        }
    }

    /// The video of the parameters `values`.
    pub fn draw(&self, values: &[f32], guides: &[Image]) -> DrawnVideo {
        let images = self.displacements(values);
        let affine = self.affine(values);
        let guide_shifts = self.guide_shifts(&images);
        let visible = self.visible(&guide_shifts);
        let mut video = vec![0.0; self.shape.voxels()];
        let mut points = vec![[0.0; 2]; video.len()];
        let bins = video
            .par_chunks_mut(self.pixels())
            .zip(points.par_chunks_mut(self.pixels()))
            .enumerate();
        let scratch = || ([self.image(), self.image()], Drawing::default());
        bins.for_each_init(scratch, |(shifts, drawing), (t, (bin, points))| {
            for (shift, images) in shifts.iter_mut().zip(&images) {
                self.displacement(images, 0, t, shift.data_mut());
            }
            self.mesh.draw(shifts, drawing, points);
            for (i, guide) in guides.iter().enumerate() {
                let sample = self.sampler(affine, guide_shifts[i].as_ref(), &visible, i);
                for (v, p) in bin.iter_mut().zip(&*points) {
                    let GuideSample { at: [y, x], weight } = sample(*p, t);
                    *v += weight * picture::at(guide, y, x).0;
                }
            }
        });
        DrawnVideo {
            video,
            points,
            visible,
        }
    }

    /// What each voxel of a drawn video takes of guide `i`.
    pub fn samples<'d>(
        &'d self,
        values: &[f32],
        drawn: &'d DrawnVideo,
        i: usize,
    ) -> impl Fn(usize) -> GuideSample + Sync + 'd {
        let affine = self.affine(values);
        let mut shifts = self.guide_shifts(&self.displacements(values));
        let shifts = shifts.swap_remove(i);
        move |v| {
            let sample = self.sampler(affine, shifts.as_ref(), &drawn.visible, i);
            sample(drawn.points[v], v / self.pixels())
        }
    }

    /// The derivative at `values`, where the video is `drawn`.
    pub fn derivative(
        &self,
        values: &[f32],
        drawn: &DrawnVideo,
        guides: &[Image],
    ) -> Derivative<'_> {
        let indices: Vec<u32> = drawn.points.par_iter().map(|p| self.index(*p)).collect();
        let mut gradients = self.gradients(&drawn.video).map(|gradient| vec![gradient]);
        let affine = self.affine(values);
        let guide_shifts = self.guide_shifts(&self.displacements(values));
        for (i, (guide, shifts)) in guides.iter().zip(&guide_shifts).enumerate() {
            let sample = self.sampler(affine, shifts.as_ref(), &drawn.visible, i);
            let gradient = |(v, p): (usize, &[f32; 2])| {
                let GuideSample { at: [y, x], weight } = sample(*p, v / self.pixels());
                let (_, along_y, along_x) = picture::at(guide, y, x);
                (weight * along_y, weight * along_x)
            };
            let (along_y, along_x) = drawn.points.par_iter().enumerate().map(gradient).unzip();
            gradients[0].push(along_y);
            gradients[1].push(along_x);
        }
        Derivative {
            flow: self,
            indices,
            gradients,
        }
    }

    /// `−∇v` by differences of neighbours, along y and x.
    fn gradients(&self, video: &[f32]) -> [Vec<f32>; 2] {
        let Field { rows, columns } = self.field;
        let along = |stride: usize, place: fn(usize, usize) -> usize, end: usize| -> Vec<f32> {
            let difference = |v: usize| {
                let at = place(v % (rows * columns), columns);
                let (before, after) = (usize::from(at > 0), usize::from(at + 1 < end));
                let change = video[v - before * stride] - video[v + after * stride];
                change / ((before + after).max(1) as f32)
            };
            (0..video.len()).into_par_iter().map(difference).collect()
        };
        let along_y = along(columns, |p, columns| p / columns, rows);
        [along_y, along(1, |p, columns| p % columns, columns)]
    }

    /// Root mean square displacement over the field and the bins, in pixels.
    pub fn rms_displacement_px(&self, values: &[f32]) -> f64 {
        let mut shift = vec![0.0; self.pixels()];
        let mut sum = 0.0;
        for images in self.displacements(values) {
            for t in 0..self.shape.bins {
                self.displacement(&images, 0, t, &mut shift);
                sum += norm_squared(&shift);
            }
        }
        (sum / self.shape.voxels() as f64).sqrt()
    }
}

impl Derivative<'_> {
    /// Change of the video under the change `d` of the parameters.
    pub fn apply(&self, d: &[f32]) -> Vec<f32> {
        let (flow, pixels) = (self.flow, self.flow.pixels());
        let images = flow.displacements(d);
        // The displacements at the times of the guides are those of every bin.
        let of_guides: [Vec<Vec<f32>>; 2] = std::array::from_fn(|axis| {
            let shift = |term: usize| {
                let mut shift = vec![0.0f32; pixels];
                flow.displacement(&images[axis], term, 0, &mut shift);
                shift
            };
            (1..self.gradients[axis].len()).map(shift).collect()
        });
        let mut video = vec![0.0; flow.shape.voxels()];
        let bins = video.par_chunks_mut(pixels).enumerate();
        bins.for_each_init(
            || vec![0.0f32; pixels],
            |shift, (t, bin)| {
                let range = t * pixels..(t + 1) * pixels;
                let indices = &self.indices[range.clone()];
                for axis in 0..2 {
                    flow.displacement(&images[axis], 0, t, shift);
                    let shifts = std::iter::once(&*shift).chain(&of_guides[axis]);
                    for (shift, gradient) in shifts.zip(&self.gradients[axis]) {
                        let values = gradient[range.clone()].iter().zip(indices);
                        for (v, (g, p)) in bin.iter_mut().zip(values) {
                            *v += g * shift[*p as usize];
                        }
                    }
                }
            },
        );
        video
    }

    /// The adjoint of [`Self::apply`].
    pub fn adjoint(&self, video: &[f32]) -> Vec<f32> {
        let flow = self.flow;
        let mut out = Vec::with_capacity(2 * flow.axis_len());
        let bins: Vec<usize> = (0..flow.shape.bins).collect();
        for gradients in &self.gradients {
            let parts: Vec<Vec<f32>> = bins
                .par_chunks(flow.shape.bins.div_ceil(PARTS))
                .map(|bins| self.sums(bins, video, gradients))
                .collect();
            let mut images = vec![0.0f32; (flow.modes() + 1) * flow.pixels()];
            for part in parts {
                images.iter_mut().zip(&part).for_each(|(s, p)| *s += p);
            }
            let (modes, affine) = images.split_at(flow.modes() * flow.pixels());
            out.extend(flow.spline.reduce(modes));
            let mut sums = [0.0f64; 3];
            for (i, value) in affine.iter().enumerate() {
                let (eta, xi) = flow.field.place(i);
                let value = f64::from(*value);
                sums[0] += value;
                sums[1] += value * f64::from(eta);
                sums[2] += value * f64::from(xi);
            }
            let scale = f64::from(flow.affine_scale());
            out.extend(sums.map(|s| (scale * s) as f32));
        }
        out
    }

    /// `Σ_t Σ_term factor · gradient · video` of the points, for the given bins and every mode.
    fn sums(&self, bins: &[usize], video: &[f32], gradients: &[Vec<f32>]) -> Vec<f32> {
        let (flow, pixels) = (self.flow, self.flow.pixels());
        let mut sums = vec![0.0f32; (flow.modes() + 1) * pixels];
        let mut product = vec![0.0f32; pixels];
        let add_bin = |term: usize, t: usize, product: &mut [f32]| {
            let range = t * pixels..(t + 1) * pixels;
            let values = video[range.clone()]
                .iter()
                .zip(&gradients[term][range.clone()]);
            for ((v, g), p) in values.zip(&self.indices[range]) {
                product[*p as usize] += v * g;
            }
        };
        let mut add_modes = |term: usize, t: usize, product: &[f32]| {
            for (m, sums) in sums.chunks_exact_mut(pixels).enumerate() {
                let factor = flow.factor(term, m, t);
                if factor != 0.0 {
                    let pairs = sums.iter_mut().zip(product);
                    pairs.for_each(|(s, p)| *s += factor * p);
                }
            }
        };
        for &t in bins {
            product.fill(0.0);
            add_bin(0, t, &mut product);
            add_modes(0, t, &product);
        }
        // The factors of the guides are those of every bin.
        for term in 1..gradients.len() {
            product.fill(0.0);
            bins.iter().for_each(|&t| add_bin(term, t, &mut product));
            add_modes(term, 0, &product);
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::super::margin::Margin;
    use super::*;
    use rowburst_core::vecmath::dot;

    const SHAPE: Shape = Shape {
        bins: 9,
        rows: 30,
        columns: 42,
    };

    /// Two pictures of soft waves, with times.
    fn guides() -> Vec<KeyFrame> {
        let picture = |phase: f32| {
            Image::from_fn(SHAPE.rows, SHAPE.columns, |y, x| {
                1.0 + (0.25 * y as f32 + phase).sin() + (0.2 * x as f32).cos()
            })
        };
        [(0.0, 2.0), (0.4, 7.0)]
            .map(|(phase, bin)| KeyFrame {
                image: picture(phase),
                bins: Some((bin, bin)),
            })
            .into()
    }

    fn ripple(flow: &Flow, step: f32, size: f32) -> Vec<f32> {
        let points = flow.spline.points();
        // Smooth over the control points.
        let value =
            |i: usize| size * ((i % points) as f32 * 0.01 + i as f32 / points as f32 * step).sin();
        (0..2 * flow.axis_len()).map(value).collect()
    }

    fn images(guides: &[KeyFrame]) -> Vec<Image> {
        guides.iter().map(|g| g.image.clone()).collect()
    }

    #[test]
    fn the_derivative_is_that_of_the_video_and_has_an_adjoint() {
        let guides = guides();
        let start = Affine {
            parameters: [0.5, 0.2, -0.1, -0.3, 0.1, 0.2],
        };
        let flow = Flow::new(SHAPE, &guides, start, 1..=3, 0);
        let pictures = images(&guides);
        let (values, d) = (ripple(&flow, 0.9, 0.4), ripple(&flow, 1.7, 1.0));
        let derivative = flow.derivative(&values, &flow.draw(&values, &pictures), &pictures);
        let change = derivative.apply(&d);
        let drawn = |step: f32| {
            let moved: Vec<f32> = values.iter().zip(&d).map(|(v, d)| v + step * d).collect();
            flow.draw(&moved, &pictures).video
        };
        let (after, before) = (drawn(0.05), drawn(-0.05));
        // Away from the border, beyond which a picture has the value of its edge.
        let is_inner = |v: usize| {
            let (y, x) = (v / SHAPE.columns % SHAPE.rows, v % SHAPE.columns);
            (4..SHAPE.rows - 4).contains(&y) && (4..SHAPE.columns - 4).contains(&x)
        };
        let (mut error, mut power) = (0.0, 0.0);
        for v in (0..change.len()).filter(|v| is_inner(*v)) {
            let difference = (after[v] - before[v]) / 0.1;
            error += (difference - change[v]).powi(2);
            power += difference.powi(2);
        }
        assert!((error / power).sqrt() < 0.2, "{error} {power}");
        let video: Vec<f32> = (0..change.len()).map(|i| (0.37 * i as f32).sin()).collect();
        let (forward, back) = (dot(&change, &video), dot(&d, &derivative.adjoint(&video)));
        assert!(
            (forward - back).abs()
                < 1e-3 * norm_squared(&change).sqrt() * norm_squared(&video).sqrt()
        );
    }

    #[test]
    fn the_samples_of_the_guides_make_the_video() {
        let (guides, margin) = (guides(), Margin { width: 5 });
        let padded: Vec<Image> = guides.iter().map(|g| margin.around(&g.image)).collect();
        let flow = Flow::new(SHAPE, &guides, Affine::default(), 1..=3, margin.width);
        let values = ripple(&flow, 0.9, 0.4);
        let drawn = flow.draw(&values, &padded);
        let samples = [0, 1].map(|i| flow.samples(&values, &drawn, i));
        for (v, expected) in drawn.video.iter().enumerate() {
            let of_guide = |i: usize| {
                let sample = samples[i](v);
                sample.weight * picture::at(&padded[i], sample.at[0], sample.at[1]).0
            };
            assert!((of_guide(0) + of_guide(1) - expected).abs() < 1e-4);
        }
    }

    #[test]
    fn the_video_at_the_time_of_a_guide_is_the_guide() {
        let guides = guides();
        // The second camera is shifted, turned and magnified.
        let start = Affine {
            parameters: [0.5, 0.6, -0.5, -0.3, 0.5, 0.6],
        };
        let flow = Flow::new(SHAPE, &guides, start, 1..=3, 0);
        let mut values = ripple(&flow, 0.9, 0.4);
        let n = flow.axis_len();
        values
            .chunks_exact_mut(n)
            .for_each(|axis| axis[n - 3..].fill(0.0));
        let video = flow.draw(&values, &images(&guides)).video;
        let pixels = SHAPE.rows * SHAPE.columns;
        for (guide, bin) in guides.iter().zip([2, 7]) {
            let registered = flow.field.warp(&guide.image, &start);
            for y in 3..SHAPE.rows - 3 {
                for x in 3..SHAPE.columns - 3 {
                    let value = video[bin * pixels + y * SHAPE.columns + x];
                    assert!(
                        (value - registered.at(y, x)).abs() < 0.03,
                        "bin {bin}, {y}, {x}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_motion_of_known_time_has_the_same_video_without_it() {
        let mut guide = guides().remove(1);
        let start = Affine {
            parameters: [0.5, 0.2, -0.1, -0.3, 0.1, 0.2],
        };
        let known = Flow::new(SHAPE, &[guide.clone()], start, 1..=2, 0);
        let pictures = [guide.image.clone()];
        guide.bins = None;
        let unknown = Flow::new(SHAPE, &[guide], start, 0..=2, 0);
        let values = ripple(&known, 0.9, 0.4);
        let expected = known.draw(&values, &pictures).video;
        let converted = unknown.of_known_time(&values, 7.0);
        assert_eq!(converted.len(), 2 * unknown.axis_len());
        // The affine parameters are scaled by the number of control points alone, the same in both.
        let found = unknown.draw(&converted, &pictures).video;
        let worst = expected.iter().zip(&found).map(|(a, b)| (a - b).abs());
        assert!(worst.fold(0.0, f32::max) < 1e-3);
    }
}
