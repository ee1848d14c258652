//! Where the light of a video comes from, when each thing carries its displacement with it.
//!
//! A point `p` of the scene at the reference time lies at `X(p, t) = p + D(p, t)`. A mesh over the points is moved and drawn: a
//! pixel `x` sees the point `p` with `X(p, t) = x`. Where the mesh folds, the part that moves further lies on top; parts that
//! are turned over are not drawn. What a thing leaves behind is the mesh stretched over it. A pixel that the mesh has left, after a
//! move by over a quarter of a side, sees its own point.

use super::picture;
use rowburst_optics::Image;

/// Pixels between nodes of the mesh on a field of 108; larger is faster.
const SPACING_PX: f64 = 2.0;
/// Part of a side by which the mesh is larger than the field, so that it covers the field also where it moves away.
const MARGIN: f64 = 0.25;

/// A node: its point and its displacement, `[y, x]`.
#[derive(Clone, Copy, Default)]
struct Node {
    point: [f32; 2],
    shift: [f32; 2],
    /// Squared length of the displacement; the greater lies on top.
    height: f32,
}

/// Draws the mesh of one bin.
pub(super) struct Mesh {
    rows: usize,
    columns: usize,
    /// Pixels between nodes.
    spacing: f32,
    /// Places of the nodes along y and x.
    along_y: Vec<f32>,
    along_x: Vec<f32>,
}

/// Scratch space of a drawing.
#[derive(Default)]
pub(super) struct Drawing {
    nodes: Vec<Node>,
    heights: Vec<f32>,
}

impl Mesh {
    /// A mesh over a field, with `unit` pixels per pixel of a field of 108.
    pub fn new(rows: usize, columns: usize, unit: f64) -> Self {
        let spacing = SPACING_PX * unit;
        let nodes = |n: usize| {
            let margin = (MARGIN * n as f64 / spacing).ceil();
            let count = ((n as f64 - 1.0) / spacing).ceil() + 2.0 * margin + 1.0;
            (0..count as usize)
                .map(|i| ((i as f64 - margin) * spacing) as f32)
                .collect()
        };
        Self {
            rows,
            columns,
            spacing: spacing as f32,
            along_y: nodes(rows),
            along_x: nodes(columns),
        }
    }

    /// The point that each pixel sees, `(y, x)`, with the displacements of the points of the field along y and x.
    pub fn draw(&self, shifts: &[Image; 2], drawing: &mut Drawing, points: &mut [[f32; 2]]) {
        drawing.heights.clear();
        drawing.heights.resize(points.len(), -1.0);
        for (i, point) in points.iter_mut().enumerate() {
            *point = [(i / self.columns) as f32, (i % self.columns) as f32];
        }
        // Nodes that are too far outside to come into the field are left out.
        let farthest = |shift: &Image| shift.data().iter().fold(0.0f32, |m, s| m.max(s.abs()));
        let reach = [&shifts[0], &shifts[1]].map(|shift| farthest(shift) + self.spacing);
        let near = |line: &[f32], n: usize, reach: f32| -> Vec<f32> {
            let can_enter = |at: &&f32| **at >= -reach && **at <= n as f32 - 1.0 + reach;
            line.iter().filter(can_enter).copied().collect()
        };
        let along_y = near(&self.along_y, self.rows, reach[0]);
        let along_x = near(&self.along_x, self.columns, reach[1]);
        drawing.nodes.clear();
        for &y in &along_y {
            for &x in &along_x {
                let shift = std::array::from_fn(|axis| picture::at(&shifts[axis], y, x).0);
                drawing.nodes.push(Node {
                    point: [y, x],
                    shift,
                    height: shift.iter().map(|s: &f32| s * s).sum(),
                });
            }
        }
        let width = along_x.len();
        for i in 0..along_y.len() - 1 {
            for j in 0..width - 1 {
                let node = |k: usize| drawing.nodes[i * width + j + k];
                let (a, b, c, d) = (node(0), node(1), node(width), node(width + 1));
                self.triangle(&a, &c, &b, &mut drawing.heights, points);
                self.triangle(&b, &c, &d, &mut drawing.heights, points);
            }
        }
    }

    fn triangle(&self, a: &Node, b: &Node, c: &Node, heights: &mut [f32], points: &mut [[f32; 2]]) {
        let place = |n: &Node| [n.point[0] + n.shift[0], n.point[1] + n.shift[1]];
        let (p, q, r) = (place(a), place(b), place(c));
        let cross = |u: [f32; 2], v: [f32; 2], w: [f32; 2]| {
            (v[0] - u[0]) * (w[1] - u[1]) - (v[1] - u[1]) * (w[0] - u[0])
        };
        let area = cross(p, q, r);
        if area.is_nan() || area <= 0.0 {
            return;
        }
        let range = |k: usize, n: usize| {
            let least = p[k].min(q[k]).min(r[k]).ceil().max(0.0);
            let most = p[k].max(q[k]).max(r[k]).floor().min(n as f32 - 1.0);
            (least as usize)..((most + 1.0).max(0.0) as usize)
        };
        for y in range(0, self.rows) {
            for x in range(1, self.columns) {
                let at = [y as f32, x as f32];
                let (u, v) = (cross(at, q, r) / area, cross(at, r, p) / area);
                let w = 1.0 - u - v;
                if u < -1e-4 || v < -1e-4 || w < -1e-4 {
                    continue;
                }
                let height = u * a.height + v * b.height + w * c.height;
                let i = y * self.columns + x;
                if height > heights[i] {
                    heights[i] = height;
                    points[i] =
                        std::array::from_fn(|k| u * a.point[k] + v * b.point[k] + w * c.point[k]);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 40;

    fn drawn_points(shift: impl Fn(usize, usize) -> [f32; 2]) -> Vec<[f32; 2]> {
        let image = |axis: usize| Image::from_fn(SIDE, SIDE, |y, x| shift(y, x)[axis]);
        let mut points = vec![[f32::NAN; 2]; SIDE * SIDE];
        let mesh = Mesh::new(SIDE, SIDE, 1.0);
        mesh.draw(&[image(0), image(1)], &mut Drawing::default(), &mut points);
        points
    }

    #[test]
    fn a_shifted_scene_is_seen_at_its_old_places_beyond_the_field_too() {
        for (i, [y, x]) in drawn_points(|_, _| [2.5, -4.0]).into_iter().enumerate() {
            let expected = ((i / SIDE) as f32 - 2.5, (i % SIDE) as f32 + 4.0);
            assert!((y - expected.0).abs() < 1e-3 && (x - expected.1).abs() < 1e-3);
        }
    }

    #[test]
    fn a_thing_that_moves_covers_what_rests() {
        let is_thing = |y: f32, x: f32| (8.0..=16.0).contains(&y) && (8.0..=16.0).contains(&x);
        let points = drawn_points(|y, x| {
            let moves = is_thing(y as f32, x as f32);
            [0.0, if moves { 14.0 } else { 0.0 }]
        });
        for (i, [y, x]) in points.into_iter().enumerate() {
            let at = ((i / SIDE) as f32, (i % SIDE) as f32);
            if is_thing(at.0, at.1 - 14.0) {
                assert!((y - at.0).abs() < 1e-3 && (x + 14.0 - at.1).abs() < 1e-3);
            } else if at.0 < 6.0 || at.0 > 18.0 || at.1 > 32.0 || at.1 < 6.0 {
                assert!((y - at.0).abs() < 1e-3 && (x - at.1).abs() < 1e-3);
            }
            assert!(y.is_finite() && x.is_finite());
        }
    }
}
