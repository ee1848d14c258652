//! Anderson acceleration of a settled run (docs/design/033).
//!
//! With constant `β`, `ρ` and support an iteration is a fixed map `q ↦ T(q)`, and the video of its fixed point is the solution.
//! The change `f = T(q) − q` falls slowly along directions that the data hardly determine. The last iterations tell how `f`
//! depends on `q` there. With the differences `ΔF` of their changes and `ΔG` of their `T(q)` the next point is
//!
//! ```text
//! q ← T(q) − ΔG γ,   γ = argmin ‖f − ΔF γ‖
//! ```
//!
//! (Anderson 1965; type II of Walker & Ni, SIAM J. Numer. Anal. 49, 1715, 2011). An exact `T` moves no two points apart, so
//! plain iterations converge from any point. Where `‖f‖` has clearly grown, the memory is cleared and a plain one follows.

use super::variables::Variables;
use rowburst_core::Support;
use rowburst_core::vecmath::{dot, norm_squared, solve_normal};
use std::collections::VecDeque;

/// Most iterations that are remembered; fewer take more iterations with several bins a row, more gain nothing
/// (docs/design/033).
const MEMORY: usize = 7;

/// Largest part of the elements of `q` that may be active; larger takes more memory, which is 2.4 videos here at most.
const MAX_ACTIVE_PART: f64 = 0.125;

/// Growth of `‖f‖²` in an iteration above which the memory is cleared; smaller clears it too often, larger takes more
/// iterations with LEDs (docs/design/033).
const MAX_GROWTH: f64 = 1.44;

/// Added to the diagonal of `ΔFᵀΔF` over its trace; it hardly matters (docs/design/033).
const REGULARISATION: f64 = 1e-6;

/// The memory of the last iterations.
#[derive(Clone, Default)]
pub(super) struct Acceleration {
    /// What the iterations have in common; `None` before the first one.
    map: Option<Map>,
    last: Option<Iterate>,
    steps: VecDeque<Iterate>,
    /// `ΔFᵀΔF`, in the order of `steps`.
    gram: Vec<Vec<f64>>,
}

/// The map that the iterations repeat.
#[derive(Clone)]
struct Map {
    /// Indices of the active elements of `q`; `None` where these are too many.
    active: Option<Vec<usize>>,
    /// The active elements of the `q` that the present iteration began from.
    start: Vec<f32>,
}

/// An iteration, or the difference of two.
#[derive(Clone)]
struct Iterate {
    /// The active elements of `T(q)`.
    q: Vec<f32>,
    /// `A T(q)`.
    aq: Vec<f32>,
    /// `f`.
    change: Vec<f32>,
}

impl Iterate {
    fn minus(&self, other: &Self) -> Self {
        Self {
            q: difference(&self.q, &other.q),
            aq: difference(&self.aq, &other.aq),
            change: difference(&self.change, &other.change),
        }
    }
}

impl Acceleration {
    /// Forgets all iterations: the map has changed.
    pub fn forget(&mut self) {
        *self = Self::default();
    }

    /// Remembers the iteration that ended with `q = T(q')`, where `q'` is the point that the last call left, and replaces `q`
    /// and `A q` by a point nearer to the fixed point. Outside `support` (`None`: every voxel) the video's part of `q` is
    /// zero. Returns whether iterations are accelerated: not where too many elements are active.
    pub fn accelerate(&mut self, variables: &mut Variables, support: Option<&Support>) -> bool {
        let Some(map) = &mut self.map else {
            let active = active_elements(variables.q.len(), support);
            let is_used = active.is_some();
            let start = active
                .as_deref()
                .map_or(Vec::new(), |active| gather(variables, active));
            self.map = Some(Map { active, start });
            return is_used;
        };
        let Some(active) = &map.active else {
            return false;
        };
        let q = gather(variables, active);
        let iterate = Iterate {
            change: difference(&q, &map.start),
            q,
            aq: variables.aq.clone(),
        };
        remember(
            &mut self.steps,
            &mut self.gram,
            self.last.as_ref(),
            &iterate,
        );
        let mut q = iterate.q.clone();
        if let Some(gamma) = combination(&self.steps, &self.gram, &iterate.change) {
            for (step, gamma) in self.steps.iter().zip(gamma) {
                subtract(&mut q, gamma, &step.q);
                subtract(&mut variables.aq, gamma, &step.aq);
            }
            for (i, q) in active.iter().zip(&q) {
                variables.q[*i] = *q;
            }
        }
        map.start = q;
        self.last = Some(iterate);
        true
    }
}

/// Adds the step from `last` to `iterate` to `steps` and their `gram`, or clears them where the change has grown.
fn remember(
    steps: &mut VecDeque<Iterate>,
    gram: &mut Vec<Vec<f64>>,
    last: Option<&Iterate>,
    iterate: &Iterate,
) {
    let Some(last) = last else {
        return;
    };
    if norm_squared(&iterate.change) > MAX_GROWTH * norm_squared(&last.change) {
        steps.clear();
        gram.clear();
        return;
    }
    if steps.len() == MEMORY {
        steps.pop_front();
        gram.remove(0);
        gram.iter_mut().for_each(|row| {
            row.remove(0);
        });
    }
    steps.push_back(iterate.minus(last));
    let newest = &steps[steps.len() - 1].change;
    let row: Vec<f64> = steps.iter().map(|step| dot(&step.change, newest)).collect();
    for (others, product) in gram.iter_mut().zip(&row) {
        others.push(*product);
    }
    gram.push(row);
}

/// `γ`; `None` where no step is remembered or the steps say nothing.
fn combination(steps: &VecDeque<Iterate>, gram: &[Vec<f64>], change: &[f32]) -> Option<Vec<f64>> {
    let trace: f64 = (0..steps.len()).map(|i| gram[i][i]).sum();
    if trace <= 0.0 {
        return None;
    }
    let mut gram = gram.to_vec();
    for (i, row) in gram.iter_mut().enumerate() {
        row[i] += REGULARISATION * trace;
    }
    let rhs: Vec<f64> = steps.iter().map(|step| dot(&step.change, change)).collect();
    solve_normal(&gram, &rhs)
}

/// Indices of the elements of a `q` of `length` in `support`, and of all that follow the video, such as a background; `None`
/// where they are more than [`MAX_ACTIVE_PART`].
fn active_elements(length: usize, support: Option<&Support>) -> Option<Vec<usize>> {
    let mask = support.map_or(&[][..], |support| support.mask());
    let in_support = (0..mask.len()).filter(|i| mask[*i] != 0);
    let count = in_support.clone().count() + length - mask.len();
    let is_few = count as f64 <= MAX_ACTIVE_PART * length as f64;
    is_few.then(|| in_support.chain(mask.len()..length).collect())
}

fn gather(variables: &Variables, active: &[usize]) -> Vec<f32> {
    active.iter().map(|i| variables.q[*i]).collect()
}

fn difference(a: &[f32], b: &[f32]) -> Vec<f32> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

/// `a −= γb`.
fn subtract(a: &mut [f32], gamma: f64, b: &[f32]) {
    let gamma = gamma as f32;
    a.iter_mut().zip(b).for_each(|(a, b)| *a -= gamma * b);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DataTerm;
    use rowburst_core::Shape;
    use rowburst_core::linop::LinearOperator;

    const N: usize = 40;

    /// `A = 2I`, of which the variables take the lengths.
    struct Twice;

    impl LinearOperator for Twice {
        fn domain_len(&self) -> usize {
            N
        }

        fn range_len(&self) -> usize {
            N
        }

        fn apply(&self, x: &[f32], y: &mut [f32]) {
            y.iter_mut().zip(x).for_each(|(y, x)| *y = 2.0 * x);
        }

        fn adjoint(&self, y: &[f32], x: &mut [f32]) {
            self.apply(y, x);
        }
    }

    impl DataTerm for Twice {
        fn operator(&self) -> &dyn LinearOperator {
            self
        }

        fn measurements(&self) -> &[f32] {
            &[0.0; N]
        }

        fn measurement_count(&self) -> usize {
            N
        }

        fn scale(&self) -> f64 {
            1.0
        }

        fn solve_gram(&mut self, _: &[f32], _: f64, _: &mut [f32], _: &mut [f32]) -> bool {
            unreachable!("no solve is asked for")
        }

        fn residual_rms_of_bins(&self, _: &[f32]) -> Vec<f64> {
            unreachable!("no residual is asked for")
        }

        fn restrict(&mut self, _: &Support) {
            unreachable!("no support is asked for")
        }
    }

    /// Four active elements.
    fn support() -> Support {
        let mask = (0..N).map(|i| u8::from(i % 10 == 3)).collect();
        Support::from_mask(mask, Shape::new(1, 4, 10))
    }

    /// The active elements, the fixed point there, and by how much an iteration comes closer to it: most slowly where it is
    /// far.
    const DIRECTIONS: [(usize, f32, f32); 4] = [
        (3, 50.0, 0.98),
        (13, 9.0, 0.9),
        (23, 2.0, -0.5),
        (33, 3.0, 0.2),
    ];

    fn iterate(variables: &mut Variables) {
        for (i, fixed, closer) in DIRECTIONS {
            variables.q[i] = fixed + closer * (variables.q[i] - fixed);
        }
        variables.update_aq(&Twice);
    }

    /// Largest relative distance of `q` to the fixed point.
    fn error(variables: &Variables) -> f32 {
        let errors = DIRECTIONS.map(|(i, fixed, _)| (variables.q[i] / fixed - 1.0).abs());
        errors.into_iter().fold(0.0, f32::max)
    }

    #[test]
    fn a_linear_map_is_solved_in_a_few_iterations() {
        let mut variables = Variables::new(&Twice, 10);
        let mut acceleration = Acceleration::default();
        for _ in 0..14 {
            iterate(&mut variables);
            assert!(acceleration.accelerate(&mut variables, Some(&support())));
        }
        assert!(error(&variables) < 1e-3, "{:?}", variables.q);
        let mut plain = Variables::new(&Twice, 10);
        (0..14).for_each(|_| iterate(&mut plain));
        assert!(error(&plain) > 0.7);
        // `A q` follows `q`, and nothing outside the support has moved.
        for (i, (q, aq)) in variables.q.iter().zip(&variables.aq).enumerate() {
            assert!((aq - 2.0 * q).abs() < 1e-4);
            assert!(i % 10 == 3 || *q == 0.0);
        }
    }

    #[test]
    fn growth_of_the_change_clears_the_memory() {
        let mut variables = Variables::new(&Twice, 10);
        let mut acceleration = Acceleration::default();
        for _ in 0..4 {
            iterate(&mut variables);
            assert!(acceleration.accelerate(&mut variables, Some(&support())));
        }
        assert_eq!(acceleration.steps.len(), 2);
        variables.q[3] += 100.0;
        let before = variables.q.clone();
        acceleration.accelerate(&mut variables, Some(&support()));
        assert_eq!((acceleration.steps.len(), &variables.q), (0, &before));
        acceleration.forget();
        assert!(acceleration.last.is_none() && acceleration.map.is_none());
    }

    #[test]
    fn a_dense_video_is_left_as_it_is() {
        let mut variables = Variables::new(&Twice, 10);
        let mut acceleration = Acceleration::default();
        for _ in 0..8 {
            iterate(&mut variables);
            let before = variables.q.clone();
            assert!(!acceleration.accelerate(&mut variables, None));
            assert_eq!(variables.q, before);
        }
        assert!(acceleration.last.is_none());
    }
}
