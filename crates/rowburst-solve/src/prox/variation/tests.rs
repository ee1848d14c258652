use super::bin::inverse_root;
use super::*;
use rand::{RngExt, SeedableRng};
use rowburst_core::vecmath::{distance_squared, dot, norm};

fn random(length: usize, seed: u64) -> Vec<f32> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    (0..length)
        .map(|_| rng.random_range(-0.5f32..1.0))
        .collect()
}

fn prox(shape: Shape, weights: VariationWeights, q: &[f32], scale: f64) -> Vec<f32> {
    let mut z = vec![f32::NAN; shape.voxels()];
    Variation::new(shape, weights)
        .with_steps(3000)
        .prox(q, scale, &mut z);
    z
}

const WEIGHTS: [VariationWeights; 4] = [
    VariationWeights {
        space: 1.0,
        time: 0.0,
        l1: 0.0,
    },
    VariationWeights {
        space: 1.0,
        time: 0.5,
        l1: 0.2,
    },
    VariationWeights {
        space: 0.0,
        time: 1.0,
        l1: 0.0,
    },
    VariationWeights {
        space: 0.0,
        time: 0.0,
        l1: 1.0,
    },
];
const SHAPES: [(usize, usize, usize); 4] = [(3, 5, 7), (1, 8, 6), (4, 1, 5), (2, 6, 1)];

#[test]
fn is_firmly_non_expansive() {
    for weights in WEIGHTS {
        for (bins, rows, columns) in SHAPES {
            let shape = Shape::new(bins, rows, columns);
            let (a, b) = (random(shape.voxels(), 1), random(shape.voxels(), 2));
            let (pa, pb) = (prox(shape, weights, &a, 0.2), prox(shape, weights, &b, 0.2));
            let moved: Vec<f32> = pa.iter().zip(&pb).map(|(x, y)| x - y).collect();
            let apart: Vec<f32> = a.iter().zip(&b).map(|(x, y)| x - y).collect();
            assert!(dot(&moved, &moved) <= dot(&moved, &apart) + 1e-4);
        }
    }
}

/// `z = prox(q)` is the minimiser: no other point of a random bundle is better, and
/// `⟨q − z, z⟩ = scale·R(z)`, which holds for every positively homogeneous `R`
/// (Moreau: `q − z` is in `scale·∂R(z)`).
#[test]
fn is_the_minimiser() {
    for weights in WEIGHTS {
        for (bins, rows, columns) in SHAPES {
            let shape = Shape::new(bins, rows, columns);
            let q = random(shape.voxels(), 3);
            let z = prox(shape, weights, &q, 0.15);
            let prior = Variation::new(shape, weights);
            let cost = |z: &[f32]| 0.5 * distance_squared(z, &q) + 0.15 * prior.value(z);
            let rest: Vec<f32> = q.iter().zip(&z).map(|(q, z)| q - z).collect();
            let gap = dot(&rest, &z) - 0.15 * prior.value(&z);
            assert!(
                gap.abs() < 1e-3 * (1.0 + norm(&q)),
                "{weights:?} {shape}: {gap}"
            );
            let best = cost(&z);
            for seed in 10..30 {
                let direction = random(shape.voxels(), seed);
                let other: Vec<f32> = z
                    .iter()
                    .zip(&direction)
                    .map(|(z, d)| (z + 0.02 * (d - 0.25)).max(0.0))
                    .collect();
                assert!(cost(&other) >= best - 1e-4, "{weights:?} {shape}");
            }
        }
    }
}

/// Level after level over the whole video, as [`Composite`](super::super::Composite) does it.
fn level_by_level(prior: &mut Variation, q: &[f32], scale: f64, z: &mut [f32], steps: usize) {
    prior.set_scale(scale);
    for _ in 0..steps {
        prior.primal(q, scale, z);
        prior.step_dual(z, scale, RELATIVE_STEP_LENGTH / prior.norm_squared() as f32);
    }
    prior.primal(q, scale, z);
}

/// However many threads share the bins, call after call, with and without a support.
#[test]
fn the_wavefront_gives_the_bits_of_level_by_level() {
    let weights = WEIGHTS.iter().take(3);
    for (weights, steps) in weights.flat_map(|w| [(w, 1), (w, 2), (w, 5)]) {
        for threads in [1, 2, 4] {
            // Strips of single rows, of many, and of all that a bin has.
            let shape = match steps {
                1 => Shape::new(6, 12, 4100),
                2 => Shape::new(18, 100, 100),
                _ => Shape::new(29, 5, 7),
            };
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let (mut wavefront, mut plain) = (
                Variation::new(shape, *weights).with_steps(steps),
                Variation::new(shape, *weights),
            );
            let mut last = vec![0.0f32; shape.voxels()];
            let mut bright = random(shape.voxels(), 9);
            let rows = bright.chunks_exact_mut(shape.columns).enumerate();
            rows.filter(|(y, _)| y % 5 != 2)
                .for_each(|(_, row)| row.fill(0.0));
            let support = Support::above(&bright, shape, &vec![0.99; shape.bins]);
            pool.build().unwrap().install(|| {
                for call in 0..6 {
                    if call == 3 {
                        wavefront.restrict(&support);
                        plain.restrict(&support);
                    }
                    let q = random(shape.voxels(), 20 + call);
                    let (mut z, mut expected) = (vec![f32::NAN; q.len()], last.clone());
                    level_by_level(&mut plain, &q, 0.2, &mut expected, steps);
                    wavefront.prox(&q, 0.2, &mut z);
                    let differ = z.iter().zip(&expected).position(|(a, b)| a != b);
                    assert_eq!(differ, None, "{weights:?} {steps} {threads} {call}");
                    last = z;
                }
            });
        }
    }
}

/// What the certificate rests on, whatever went before: `⟨c, w⟩ ≤ s·R(w)` for every `w ≥ 0`.
#[test]
fn the_dual_stays_below_the_prior() {
    let calls = [
        (0.2, 1.0),
        (0.0, 1.0),
        (0.05, 1e6),
        (1e-3, 1.0),
        (1e-30, 1e9),
        (0.3, 50.0),
    ];
    for weights in WEIGHTS {
        for (bins, rows, columns) in SHAPES.into_iter().chain([(7, 9, 40)]) {
            let shape = Shape::new(bins, rows, columns);
            let mut prior = Variation::new(shape, weights);
            let mut z = vec![f32::NAN; shape.voxels()];
            for (call, (scale, size)) in calls.into_iter().cycle().take(12).enumerate() {
                let mut q = random(shape.voxels(), 40 + call as u64);
                q.iter_mut().for_each(|q| *q *= size);
                prior.prox(&q, scale, &mut z);
                assert!(z.iter().all(|z| *z >= 0.0 && z.is_finite()));
                if scale == 0.0 {
                    assert!(z.iter().zip(&q).all(|(z, q)| *z == q.max(0.0)));
                }
                let mut less = vec![0.0f32; q.len()];
                prior.subtract_dual(&mut less);
                for seed in 0..5 {
                    let mut w = random(q.len(), 80 + seed);
                    w.iter_mut().for_each(|w| *w = w.max(0.0));
                    let most = scale * prior.value(&w);
                    let rounding = 1e-6 * scale * w.iter().map(|w| f64::from(*w)).sum::<f64>();
                    let found = -dot(&less, &w);
                    assert!(
                        found <= most + rounding,
                        "{weights:?} {shape}: {found} {most}"
                    );
                }
            }
        }
    }
}

#[test]
fn l1_alone_is_the_non_negative_soft_threshold() {
    let shape = Shape::new(1, 1, 4);
    let z = prox(shape, WEIGHTS[3], &[1.0, 0.3, 0.1, -2.0], 0.2);
    for (z, expected) in z.iter().zip([0.8, 0.1, 0.0, 0.0]) {
        assert!((z - expected).abs() < 1e-6);
    }
}

/// What passes over dark rows against what does not: a point so far below zero that it stays dark.
#[test]
fn skipped_rows_change_nothing() {
    let shape = Shape::new(4, 13, 9);
    let mut bright = vec![0.0f32; shape.voxels()];
    // Neighbouring runs with one dark row between them, at both edges, and in the next bin.
    let voxel = |t: usize, y: usize, x: usize| (t * 13 + y) * 9 + x;
    for (t, y, x) in [(0, 0, 4), (1, 3, 2), (1, 7, 6), (2, 3, 3), (2, 12, 0)] {
        bright[voxel(t, y, x)] = 1.0;
    }
    let support = Support::above(&bright, shape, &[0.5; 4]);
    let q = random(shape.voxels(), 5);
    let far: Vec<f32> = q
        .iter()
        .zip(support.mask())
        .map(|(q, active)| if *active == 1 { *q } else { -1e3 })
        .collect();
    for weights in WEIGHTS {
        let mut whole = Variation::new(shape, weights);
        let mut few = Variation::new(shape, weights);
        few.restrict(&support);
        let (mut expected, mut found) = (vec![f32::NAN; q.len()], vec![f32::NAN; q.len()]);
        for _ in 0..50 {
            whole.prox(&far, 0.15, &mut expected);
            few.prox(&q, 0.15, &mut found);
        }
        assert!(found.iter().any(|z| *z > 0.0));
        assert_eq!(found, expected, "{weights:?}");
        assert!((few.value(&found) - whole.value(&found)).abs() < 1e-6);
        assert_eq!(
            few.degrees_of_freedom(&found, 1e-3),
            whole.degrees_of_freedom(&found, 1e-3)
        );
        let (mut a, mut b) = (q.clone(), q.clone());
        few.subtract_dual(&mut a);
        whole.subtract_dual(&mut b);
        support.zero_outside(&mut a);
        support.zero_outside(&mut b);
        assert_eq!(a, b, "{weights:?}");
    }
}

#[test]
fn inverse_roots_are_those_of_the_library() {
    for exponent in -36..36 {
        for part in 0..100 {
            let a = 10f32.powi(exponent) * (1.0 + 0.09 * part as f32);
            let error = f64::from(inverse_root(a)) * f64::from(a).sqrt() - 1.0;
            assert!(error.abs() < 1e-6, "{a}: {error}");
        }
    }
    assert!(inverse_root(0.0) > 1e15 && inverse_root(0.0).is_finite());
}

#[test]
fn a_constant_video_keeps_its_value() {
    let shape = Shape::new(3, 4, 5);
    let z = prox(
        shape,
        VariationWeights {
            space: 1.0,
            time: 1.0,
            l1: 0.0,
        },
        &vec![0.7; 60],
        5.0,
    );
    assert!(z.iter().all(|v| (v - 0.7).abs() < 1e-5));
}

#[test]
fn plateaus_are_the_degrees_of_freedom() {
    let shape = Shape::new(2, 4, 4);
    let mut z = vec![0.0f32; 32];
    for i in [5, 6, 9, 10] {
        z[i] = 1.0;
        z[16 + i] = 1.0;
    }
    z[15] = 0.5;
    let space = Variation::new(shape, WEIGHTS[0]);
    assert_eq!(space.degrees_of_freedom(&z, 1e-3), 3.0);
    let both = Variation::new(shape, WEIGHTS[1]);
    assert_eq!(both.degrees_of_freedom(&z, 1e-3), 2.0);
}
