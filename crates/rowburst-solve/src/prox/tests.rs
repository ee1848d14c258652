//! The laws of the dual terms and of their sums.

use super::*;
use rand::{RngExt, SeedableRng};
use rowburst_core::linop::{Cosine, LinearOperator, OverBins, Wavelet};
use rowburst_core::vecmath::{distance_squared, dot, norm, norm_squared};
use rowburst_core::{Shape, Support};

const SHAPES: [(usize, usize, usize); 4] = [(3, 5, 7), (2, 8, 6), (4, 1, 5), (2, 6, 1)];
const NONE: VariationWeights = VariationWeights {
    space: 0.0,
    time: 0.0,
    l1: 0.0,
};
/// Dual steps of a prox that is taken as exact.
const STEPS: usize = 500;

fn shapes() -> impl Iterator<Item = Shape> {
    SHAPES.iter().map(|&(t, y, x)| Shape::new(t, y, x))
}

fn random(length: usize, seed: u64) -> Vec<f32> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    (0..length)
        .map(|_| rng.random_range(-0.5f32..1.0))
        .collect()
}

/// All terms, and the example of CONTRIBUTING.md.
fn all_terms() -> impl Iterator<Item = TermSpec> {
    TERMS.iter().copied().chain([example::TCURVE])
}

/// The names of all terms that are solved in their dual.
fn dual_terms() -> impl Iterator<Item = &'static str> {
    let is_dual = |spec: &TermSpec| matches!(spec.form, TermForm::Dual(_));
    all_terms().filter(is_dual).map(|spec| spec.name)
}

fn term(name: &str, shape: Shape) -> Box<dyn DualTerm> {
    let spec = all_terms().find(|spec| spec.name == name).unwrap();
    let TermForm::Dual(build) = spec.form else {
        panic!("{name} is not solved in its dual");
    };
    build(shape)
}

/// Priors of every kind, alone and together.
fn priors(shape: Shape) -> Vec<(&'static str, Composite)> {
    let all = VariationWeights {
        space: 0.7,
        time: 0.4,
        l1: 0.1,
    };
    let mut priors: Vec<_> = dual_terms()
        .map(|name| {
            (
                name,
                Composite::new(shape, NONE, 0.0).with(1.0, term(name, shape)),
            )
        })
        .collect();
    priors.push(("group", Composite::new(shape, NONE, 1.0)));
    priors.push(("group + variation", Composite::new(shape, all, 0.6)));
    let mut sum = Composite::new(shape, all, 0.3);
    // Of the terms that a prior can have: the example is in no table.
    let is_in_table = |name: &&str| TERMS.iter().any(|spec| spec.name == *name);
    for name in dual_terms().filter(is_in_table) {
        sum = sum.with(0.5, term(name, shape));
    }
    priors.push(("all", sum));
    priors
}

/// `K v` of the differences over three axes by their definition.
fn differences(shape: Shape, v: &[f32]) -> Vec<[f64; 3]> {
    let (pixels, columns) = (shape.pixels(), shape.columns);
    let difference = |i: usize, is_last: bool, stride: usize| {
        if is_last {
            0.0
        } else {
            f64::from(v[i + stride]) - f64::from(v[i])
        }
    };
    (0..v.len())
        .map(|i| {
            let (t, y, x) = (i / pixels, i % pixels / columns, i % columns);
            [
                difference(i, y + 1 == shape.rows, columns),
                difference(i, x + 1 == columns, 1),
                difference(i, t + 1 == shape.bins, pixels),
            ]
        })
        .collect()
}

/// With the dual at `K a` (one step from zero into a ball that is everything),
/// `⟨b, Kᵀ K a⟩ = ⟨K b, K a⟩`, and `‖K a‖² ≤ bound·‖a‖²`.
#[test]
fn adjoints_are_adjoint_and_norms_are_bounds() {
    for shape in shapes() {
        let (a, b) = (random(shape.voxels(), 1), random(shape.voxels(), 2));
        for name in dual_terms() {
            let mut term = term(name, shape);
            term.step(&a, 1.0, f32::MAX);
            let mut gram = vec![0.0; shape.voxels()];
            term.subtract_adjoint(&mut gram);
            let left = -dot(&b, &gram);
            let (right, energy) = if name.starts_with("tv3d") {
                let (ka, kb) = (differences(shape, &a), differences(shape, &b));
                let sum = |p: &[[f64; 3]], q: &[[f64; 3]]| -> f64 {
                    let pairs = p.as_flattened().iter().zip(q.as_flattened());
                    pairs.map(|(p, q)| p * q).sum()
                };
                (sum(&ka, &kb), sum(&ka, &ka))
            } else {
                let analyse = |v: &[f32]| match name {
                    "dct" => {
                        let k = OverBins::new(shape.bins, Cosine::new(shape.rows, shape.columns));
                        let mut c = vec![0.0; k.range_len()];
                        k.apply(v, &mut c);
                        c
                    }
                    "wavelet" => {
                        let k = OverBins::new(shape.bins, Wavelet::new(shape.rows, shape.columns));
                        let mut c = vec![0.0; k.range_len()];
                        k.apply(v, &mut c);
                        c
                    }
                    "tcurve" => example::Curvature::new(shape).differences(v).collect(),
                    _ => v.to_vec(),
                };
                (dot(&analyse(&a), &analyse(&b)), norm_squared(&analyse(&a)))
            };
            let size = norm(&a) * norm(&b);
            assert!(
                (left - right).abs() < 1e-5 * size,
                "{name} {shape}: {left} {right}"
            );
            assert!(
                energy <= term.norm_squared() * norm_squared(&a) * (1.0 + 1e-6),
                "{name}"
            );
        }
    }
}

#[test]
fn values_are_what_their_formulas_say() {
    for shape in shapes() {
        let v = random(shape.voxels(), 5);
        let gradient = differences(shape, &v);
        let isotropic: f64 = gradient
            .iter()
            .map(|g| g.iter().map(|d| d * d).sum::<f64>().sqrt())
            .sum();
        let anisotropic: f64 = gradient.as_flattened().iter().map(|d| d.abs()).sum();
        let traces: f64 = (0..shape.pixels())
            .map(|i| {
                let trace = (0..shape.bins).map(|t| f64::from(v[t * shape.pixels() + i]));
                trace.map(|v| v * v).sum::<f64>().sqrt()
            })
            .sum();
        let matrix = faer::Mat::from_fn(shape.bins, shape.pixels(), |t, i| {
            f64::from(v[t * shape.pixels() + i])
        });
        let nuclear: f64 = matrix.singular_values().unwrap().iter().sum();
        let group = Composite::new(shape, NONE, 1.0).value(&v);
        for (found, expected) in [
            (term("tv3d", shape).value(&v), isotropic),
            (term("tv3d-aniso", shape).value(&v), anisotropic),
            (term("lowrank", shape).value(&v), nuclear),
            (group, traces),
        ] {
            assert!(
                (found - expected).abs() < 1e-5 * expected,
                "{found} {expected}"
            );
        }
        // A step returns the value at the point it starts from.
        for name in dual_terms() {
            let mut term = term(name, shape);
            let value = term.value(&v);
            assert!(
                (term.step(&v, 0.1, 0.2) - value).abs() <= 1e-5 * value,
                "{name}"
            );
        }
    }
}

fn prox(prior: Composite, q: &[f32], scale: f64) -> Vec<f32> {
    let mut z = vec![f32::NAN; q.len()];
    prior.with_steps(STEPS).prox(q, scale, &mut z);
    z
}

#[test]
fn every_prox_is_firmly_non_expansive() {
    for shape in shapes().take(2) {
        let (a, b) = (random(shape.voxels(), 1), random(shape.voxels(), 2));
        for ((name, one), (_, other)) in priors(shape).into_iter().zip(priors(shape)) {
            let (pa, pb) = (prox(one, &a, 0.2), prox(other, &b, 0.2));
            let moved: Vec<f32> = pa.iter().zip(&pb).map(|(x, y)| x - y).collect();
            let apart: Vec<f32> = a.iter().zip(&b).map(|(x, y)| x - y).collect();
            assert!(
                dot(&moved, &moved) <= dot(&moved, &apart) + 1e-4,
                "{name} {shape}"
            );
        }
    }
}

/// Moreau: `q − z` is in `scale·∂R(z)`, so `⟨q − z, z⟩ = scale·R(z)`, and for every other
/// point `y ≥ 0`: `⟨q − z, y⟩ ≤ scale·R(y)`. The two together are the optimality condition.
#[test]
fn every_prox_is_the_minimiser() {
    let scale = 0.15;
    for shape in shapes() {
        let q = random(shape.voxels(), 3);
        for ((name, solver), (_, prior)) in priors(shape).into_iter().zip(priors(shape)) {
            let z = prox(solver, &q, scale);
            assert!(z.iter().all(|v| *v >= 0.0), "{name}");
            let rest: Vec<f32> = q.iter().zip(&z).map(|(q, z)| q - z).collect();
            let gap = scale * prior.value(&z) - dot(&rest, &z);
            assert!(
                (-1e-4..2e-4 * norm(&q)).contains(&gap),
                "{name} {shape}: gap {gap}"
            );
            for seed in 10..25 {
                let y: Vec<f32> = random(q.len(), seed).iter().map(|y| y.max(0.0)).collect();
                let near: Vec<f32> = y.iter().zip(&z).map(|(y, z)| z + 0.1 * y).collect();
                for y in [y, near] {
                    let bound = scale * prior.value(&y);
                    assert!(dot(&rest, &y) <= bound + 1e-3, "{name} {shape}");
                }
            }
            let best = 0.5 * distance_squared(&z, &q) + scale * prior.value(&z);
            for factor in [0.0, 0.9, 1.1] {
                let other: Vec<f32> = z.iter().map(|z| factor * z).collect();
                let cost = 0.5 * distance_squared(&other, &q) + scale * prior.value(&other);
                assert!(cost >= best - 1e-5, "{name} {shape} {factor}");
            }
        }
    }
}

/// Where `v ≥ 0` does not bite, the prox of an orthogonal transform is a soft threshold
/// of its coefficients, that of the nuclear norm one of the singular values, and the
/// group's a shortening of every trace.
#[test]
fn closed_forms_are_met() {
    let shape = Shape::new(3, 5, 7);
    let q: Vec<f32> = random(shape.voxels(), 4).iter().map(|v| v + 4.0).collect();
    let alone = |name: &str| Composite::new(shape, NONE, 0.0).with(1.0, term(name, shape));
    let soft = |c: f32| c.signum() * (c.abs() - 0.3).max(0.0);

    let cosine = OverBins::new(3, Cosine::new(5, 7));
    let mut coefficients = vec![0.0; q.len()];
    cosine.apply(&q, &mut coefficients);
    coefficients.iter_mut().for_each(|c| *c = soft(*c));
    let mut expected = vec![0.0; q.len()];
    cosine.adjoint(&coefficients, &mut expected);
    let found = prox(alone("dct"), &q, 0.3);
    assert!(distance_squared(&found, &expected).sqrt() < 1e-3);

    let matrix = faer::Mat::from_fn(3, 35, |t, i| f64::from(q[t * 35 + i]));
    let svd = matrix.thin_svd().unwrap();
    let s = svd.S().column_vector();
    let rebuilt: Vec<f32> = (0..105)
        .map(|i| {
            let value =
                |k: usize| svd.U()[(i / 35, k)] * (s[k] - 0.3).max(0.0) * svd.V()[(i % 35, k)];
            (0..3).map(value).sum::<f64>() as f32
        })
        .collect();
    let found = prox(alone("lowrank"), &q, 0.3);
    assert!(distance_squared(&found, &rebuilt).sqrt() < 1e-3);

    let mut found = vec![f32::NAN; q.len()];
    Composite::new(shape, NONE, 1.0).prox(&q, 0.3, &mut found);
    for (i, found) in found.iter().enumerate() {
        let trace: f32 = (0..3).map(|t| q[t * 35 + i % 35].powi(2)).sum::<f32>();
        assert!((found - q[i] * (1.0 - 0.3 / trace.sqrt())).abs() < 1e-5);
    }
}

/// With no further term it is the fused prior to the bit.
#[test]
fn without_terms_it_is_the_variation() {
    let shape = Shape::new(3, 5, 7);
    let weights = VariationWeights {
        space: 1.0,
        time: 0.5,
        l1: 0.2,
    };
    let q = random(shape.voxels(), 6);
    let mut fused = vec![0.0; q.len()];
    Variation::new(shape, weights)
        .with_steps(20)
        .prox(&q, 0.2, &mut fused);
    let mut sum = vec![0.0; q.len()];
    Composite::new(shape, weights, 0.0)
        .with_steps(20)
        .prox(&q, 0.2, &mut sum);
    assert_eq!(fused, sum);
}

/// The same point again and again needs more and more accuracy; a jump needs little.
#[test]
fn accuracy_follows_the_outer_movement() {
    let shape = Shape::new(4, 12, 12);
    let q = random(shape.voxels(), 7);
    let mut prior = Composite::new(shape, NONE, 0.0).with(1.0, term("tv3d", shape));
    let mut z = vec![0.0; q.len()];
    prior.prox(&q, 0.3, &mut z);
    assert_eq!(
        prior.steps_taken(),
        2,
        "a first call is no place for accuracy"
    );
    let near: Vec<f32> = q.iter().map(|q| q + 1e-4).collect();
    prior.prox(&near, 0.3, &mut z);
    let few = prior.steps_taken();
    assert!(few > 2, "{few}");
    let mut exact = vec![0.0; q.len()];
    Composite::new(shape, NONE, 0.0)
        .with(1.0, term("tv3d", shape))
        .with_steps(5000)
        .prox(&near, 0.3, &mut exact);
    let error = |z: &[f32]| distance_squared(z, &exact).sqrt() / norm(&exact);
    let first = error(&z);
    for _ in 0..400 {
        prior.prox(&near, 0.3, &mut z);
    }
    assert!(error(&z) < 0.002 && first > 0.02, "{first} {}", error(&z));
    let far: Vec<f32> = random(shape.voxels(), 8).iter().map(|v| 10.0 * v).collect();
    prior.prox(&far, 0.3, &mut z);
    assert_eq!(prior.steps_taken(), 2);
}

#[test]
fn it_is_zero_outside_the_support() {
    let shape = Shape::new(3, 6, 6);
    let q: Vec<f32> = random(shape.voxels(), 9).iter().map(|v| v + 0.5).collect();
    let mut bright = vec![0.0; q.len()];
    bright[7] = 1.0;
    let support = Support::above(&bright, shape, &[0.5; 3]);
    for (name, mut prior) in priors(shape) {
        prior.restrict(&support);
        let mut z = vec![f32::NAN; q.len()];
        prior.prox(&q, 0.1, &mut z);
        let dark = z
            .iter()
            .zip(support.mask())
            .filter(|(_, active)| **active == 0);
        assert!(
            dark.clone().count() > 0 && dark.clone().all(|(z, _)| *z == 0.0),
            "{name}"
        );
        assert!(z.iter().any(|z| *z > 0.0), "{name}");
    }
}

#[test]
fn freedom_is_counted_by_the_strictest_term() {
    // A square of 4 pixels that is lit in both bins, and a point in one.
    let shape = Shape::new(2, 8, 8);
    let mut z = vec![0.0f32; 128];
    for i in [9, 10, 17, 18] {
        z[i] = 1.0;
        z[64 + i] = 1.0;
    }
    z[44] = 0.5;
    assert_eq!(term("tv3d", shape).degrees_of_freedom(&z, 1e-3), 2.0);
    // Rank 2 over 5 places: 2·(2 + 5 − 2).
    assert_eq!(term("lowrank", shape).degrees_of_freedom(&z, 1e-3), 10.0);
    let group = Composite::new(shape, NONE, 1.0);
    assert_eq!(group.degrees_of_freedom(&z, 1e-3), 9.0);
    let sum = Composite::new(shape, NONE, 1.0)
        .with(1.0, term("tv3d", shape))
        .with(1.0, term("lowrank", shape));
    assert_eq!(sum.degrees_of_freedom(&z, 1e-3), 2.0);
    // One plane wave is one coefficient a bin.
    let wave: Vec<f32> = (0..128)
        .map(|i| (std::f32::consts::PI * ((i % 8) as f32 + 0.5) * 3.0 / 8.0).cos())
        .collect();
    assert_eq!(term("dct", shape).degrees_of_freedom(&wave, 1e-3), 2.0);
    // A constant has no details: the approximation is all that is free.
    assert_eq!(
        term("wavelet", shape).degrees_of_freedom(&[0.5; 128], 1e-3),
        2.0
    );
}
