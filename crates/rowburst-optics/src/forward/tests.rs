//! A PSF that changes over the field: brute force, laws, Gram blocks.

use super::engine::Engine;
use super::gram::add_gram_block;
use super::gram::tests::{brute_force as gram_by_calls, row_by_row};
use crate::camera::CameraParams;
use crate::{Camera, Image, PatchSet, Psf, RollingShutter, Sensor, Shutter, TimingChange};
use faer::Mat;
use rand::{RngExt, SeedableRng};
use rowburst_core::Support;
use rowburst_core::linop::{LinearOperator, laws};
use rowburst_core::vecmath::dot;

fn random_psf(rows: usize, columns: usize, rng: &mut rand_pcg::Pcg64) -> Psf {
    let values = (0..rows * columns).map(|_| rng.random_range(0.0f32..1.0));
    Psf::new(Image::new(rows, columns, values.collect()).unwrap()).unwrap()
}

fn cases() -> Vec<(Camera, PatchSet)> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(12);
    let line: &[(f64, f64)] = &[(0.0, -4.0), (0.0, 0.5), (0.0, 4.0)];
    let grid: &[(f64, f64)] = &[(-3.0, -3.0), (-3.0, 3.0), (3.0, -3.0), (3.0, 3.0)];
    let scattered: &[(f64, f64)] = &[(-3.0, 2.0), (0.0, 0.0), (4.0, -4.0)];
    let cases = [
        (Shutter::DualInsideOut, (8, 7), Some((10, 11)), 1.0, line),
        (Shutter::TopDown, (5, 6), None, 2.5, grid),
        (Shutter::Global, (9, 8), Some((12, 12)), 1.0, scattered),
        (Shutter::Global, (24, 26), Some((30, 29)), 1.0, grid),
    ];
    let mut cases: Vec<(Camera, PatchSet)> = cases
        .into_iter()
        .map(|(shutter, (rows, columns), field, exposure_us, offsets)| {
            let camera = Camera::new(CameraParams {
                rows,
                columns,
                shutter,
                row_time_us: 1.0,
                exposure_us,
                bins_per_row: 1,
                field,
                sensor: Sensor::default(),
            });
            let psfs = offsets.iter().map(|_| random_psf(11, 13, &mut rng));
            let set = PatchSet::new(psfs.collect(), offsets.to_vec()).unwrap();
            (camera.unwrap(), set)
        })
        .collect();
    for (exposure_rows, half_delay_rows) in [(0.0, 0.3), (0.5, -0.2)] {
        let (camera, set) = &cases[0];
        let change = TimingChange {
            exposure_rows,
            half_delay_rows,
        };
        cases.push((camera.retimed(change), set.clone()));
    }
    cases
}

/// Every light path, one by one, in float64.
fn brute_force(camera: &Camera, set: &PatchSet, video: &[f32]) -> Vec<f32> {
    let shape = camera.video_shape();
    let (oy, ox) = camera.field_offset();
    let mut frame = vec![0.0f64; camera.rows() * camera.columns()];
    for y in 0..shape.rows {
        for field_x in 0..shape.columns {
            let offset = |i: usize, side: usize| i as f64 - (side / 2) as f64;
            let weights = set.weights_at(offset(y, shape.rows), offset(field_x, shape.columns));
            for r in 0..camera.rows() {
                let run = &camera.time().instants()[camera.instants()[r]];
                for x in 0..camera.columns() {
                    let dy = r as isize + oy as isize - y as isize;
                    let dx = x as isize + ox as isize - field_x as isize;
                    let value = |c: usize| f64::from(set.psfs()[c].at_displacement(dy, dx));
                    let psf: f64 = weights.iter().map(|&(c, a)| a * value(c)).sum();
                    for (k, weight) in run.weights.iter().enumerate() {
                        let at = ((run.first_bin + k) * shape.rows + y) * shape.columns + field_x;
                        frame[r * camera.columns() + x] += weight * f64::from(video[at]) * psf;
                    }
                }
            }
        }
    }
    frame.into_iter().map(|b| b as f32).collect()
}

#[test]
fn patches_agree_with_brute_force_and_obey_the_laws() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(13);
    for (camera, set) in cases() {
        let operator = RollingShutter::new(&camera, &set);
        let video: Vec<f32> = (0..operator.domain_len()).map(|_| rng.random()).collect();
        let mut frame = vec![f32::NAN; operator.range_len()];
        operator.apply(&video, &mut frame);
        let expected = brute_force(&camera, &set, &video);
        let error = rowburst_core::vecmath::distance_squared(&frame, &expected).sqrt()
            / rowburst_core::vecmath::norm(&expected);
        assert!(error < 1e-6, "{camera:?}: relative error {error}");
        laws::check(&operator, 3);
    }
}

/// PSFs whose light lies in a part of their pixels, in the middle or at a side; patches each in another part.
#[test]
fn psfs_with_dark_edges_agree_with_brute_force_and_obey_the_laws() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(17);
    let parts = [
        (6..11, 7..12),
        (0..4, 0..3),
        (14..17, 16..19),
        (8..9, 9..10),
        (0..17, 3..16),
        (16..17, 0..1),
    ];
    let mut shorter = [0; 2];
    for (camera, set) in cases() {
        for i in 0..parts.len() {
            let mut psf = |k: usize| {
                let (rows, columns) = &parts[(i + k) % parts.len()];
                let whole = random_psf(17, 19, &mut rng);
                let image = Image::from_fn(17, 19, |y, x| {
                    let is_inside = rows.contains(&y) && columns.contains(&x);
                    if is_inside {
                        whole.image().at(y, x)
                    } else {
                        0.0
                    }
                });
                Psf::new(image).unwrap()
            };
            let one = PatchSet::from(&psf(0));
            let psfs = (0..set.psfs().len()).map(|k| psf(2 * (k % 2)));
            let many = PatchSet::new(psfs.collect(), set.offsets_px().to_vec()).unwrap();
            for (set, shorter) in [one, many].into_iter().zip(&mut shorter) {
                let operator = RollingShutter::new(&camera, &set);
                if let Engine::Rowwise(engine) = &operator.layers[0].engine {
                    *shorter += usize::from(engine.length() < operator.geometry.fft_columns());
                }
                let video: Vec<f32> = (0..operator.domain_len()).map(|_| rng.random()).collect();
                let mut frame = vec![f32::NAN; operator.range_len()];
                operator.apply(&video, &mut frame);
                let expected = brute_force(&camera, &set, &video);
                let error = rowburst_core::vecmath::distance_squared(&frame, &expected).sqrt();
                // No light reaches some sensors.
                let light = rowburst_core::vecmath::norm(&expected);
                let limit = 1e-6 * light.max(0.1);
                assert!(error < limit, "{camera:?}, part {i}: {error} of {limit}");
                if light > 0.0 {
                    laws::check(&operator, 3);
                }
                let shape = operator.video_shape();
                let support = Support::above(&video, shape, &vec![0.9; shape.bins]);
                let mut expected = vec![f32::NAN; video.len()];
                operator.adjoint(&frame, &mut expected);
                support.zero_outside(&mut expected);
                let mut found = vec![f32::NAN; video.len()];
                operator.adjoint_on(&frame, &support, &mut found);
                assert_eq!(found, expected, "{camera:?}, part {i}");
            }
        }
    }
    assert!(shorter.iter().all(|count| *count > 3), "{shorter:?}");
}

/// One PSF and several, rows one by one and whole planes, exposures of a row and longer.
#[test]
fn adjoint_on_a_support_is_the_adjoint_and_then_the_support() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(15);
    for (camera, set) in cases() {
        let psf = random_psf(11, 13, &mut rng);
        for operator in [
            RollingShutter::new(&camera, &set),
            RollingShutter::new(&camera, &psf),
        ] {
            let shape = operator.video_shape();
            let video: Vec<f32> = (0..shape.voxels()).map(|_| rng.random()).collect();
            let support = Support::above(&video, shape, &vec![0.98; shape.bins]);
            let active = support
                .active_rows()
                .iter()
                .filter(|active| **active)
                .count();
            assert!(
                active > 0 && support.fraction() < 1.0,
                "{camera:?}: {active} active rows"
            );
            let frame: Vec<f32> = (0..operator.range_len()).map(|_| rng.random()).collect();
            let mut expected = vec![f32::NAN; video.len()];
            operator.adjoint(&frame, &mut expected);
            support.zero_outside(&mut expected);
            let mut found = vec![1.0; video.len()];
            operator.adjoint_on(&frame, &support, &mut found);
            assert_eq!(found, expected, "{camera:?}");
            // Part by part, added to what there was.
            let add = |start: usize, part: &[f32], target: &mut [f32]| {
                for (i, (t, p)) in target.iter_mut().zip(part).enumerate() {
                    *t += p * (1.0 + 0.0 * video[start + i]);
                }
            };
            found.fill(0.0);
            operator.adjoint_each(&frame, Some(&support), &mut found, &add);
            assert_eq!(found, expected, "{camera:?}");
            operator.adjoint(&frame, &mut expected);
            found.fill(0.0);
            operator.adjoint_each(&frame, None, &mut found, &add);
            assert_eq!(found, expected, "{camera:?}");
        }
    }
}

/// Instants that go through rows together, in groups of all sizes: spectra of more than a cache, an odd number of
/// rows, a short last group. The bits do not depend on the threads.
#[test]
fn batched_instants_give_the_bits_of_single_ones() {
    let camera = row_by_row(17, 3300, Shutter::TopDown);
    let mut rng = rand_pcg::Pcg64::seed_from_u64(16);
    // Its edges are dark.
    let operator = RollingShutter::new(&camera, random_psf(33, 1501, &mut rng));
    let shape = operator.video_shape();
    let video: Vec<f32> = (0..shape.voxels()).map(|_| rng.random()).collect();
    let frame: Vec<f32> = (0..operator.range_len()).map(|_| rng.random()).collect();
    let support = Support::above(&video, shape, &vec![0.9999; shape.bins]);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build().unwrap().install(|| {
            let (mut read, mut spread) = (vec![0.0; frame.len()], vec![0.0; video.len()]);
            operator.apply(&video, &mut read);
            operator.adjoint(&frame, &mut spread);
            let mut active = vec![f32::NAN; video.len()];
            operator.adjoint_on(&frame, &support, &mut active);
            (operator.batch_size(), [read, spread, active])
        })
    };
    let (alone, expected) = run(17);
    assert_eq!(alone, 1);
    let mut masked = expected[1].clone();
    support.zero_outside(&mut masked);
    assert_eq!(masked, expected[2]);
    for (threads, together) in [(1, 6), (2, 5), (5, 4)] {
        assert_eq!(
            run(threads),
            (together, expected.clone()),
            "{threads} threads"
        );
    }
    let (a, b) = (dot(&expected[0], &frame), dot(&video, &expected[1]));
    assert!((a - b).abs() < 1e-5 * a, "{a} {b}");
}

#[test]
fn equal_patches_are_one_psf() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(14);
    let (camera, set) = cases().swap_remove(0);
    let psf = random_psf(9, 9, &mut rng);
    let same = vec![psf.clone(); set.psfs().len()];
    let same = PatchSet::new(same, set.offsets_px().to_vec()).unwrap();
    let (one, many) = (
        RollingShutter::new(&camera, &psf),
        RollingShutter::new(&camera, &same),
    );
    let video: Vec<f32> = (0..one.domain_len()).map(|_| rng.random()).collect();
    let (mut a, mut b) = (vec![0.0; one.range_len()], vec![0.0; one.range_len()]);
    one.apply(&video, &mut a);
    many.apply(&video, &mut b);
    assert!(
        rowburst_core::vecmath::distance_squared(&a, &b).sqrt()
            < 1e-5 * rowburst_core::vecmath::norm(&a)
    );
}

#[test]
fn blocks_of_patches_agree_with_operator_calls() {
    for (camera, set) in cases().into_iter().take(3) {
        let operator = RollingShutter::new(&camera, &set);
        let shape = operator.video_shape();
        let video: Vec<f32> = (0..shape.voxels()).map(|i| (i * 37 % 100) as f32).collect();
        let some = Support::above(&video, shape, &vec![97.0; shape.bins]);
        for support in [None, Some(&some)] {
            let gram = gram_by_calls(&operator, support);
            for instant in 0..operator.rows_of_instants().len() {
                let indices = operator.indices_of(instant);
                let mut block = Mat::<f64>::zeros(indices.len(), indices.len());
                add_gram_block(&operator, instant, support, block.as_mut());
                for (i, &row) in indices.iter().enumerate() {
                    if support.is_none() {
                        let columns = camera.columns();
                        let power = operator.pixel_power(row / columns, row % columns);
                        assert!((power - block[(i, i)]).abs() < 1e-7);
                    }
                    for (j, &column) in indices.iter().enumerate().skip(i) {
                        let error = (block[(i, j)] - f64::from(gram[row][column])).abs();
                        assert!(error < 1e-7, "{camera:?} {instant} {i} {j}: {error}");
                    }
                }
            }
        }
    }
}

/// The whole readout is made of its parts: operator, adjoint, blocks, measurement.
#[test]
fn a_subset_of_the_readout_equals_the_whole() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
    for shutter in [Shutter::DualInsideOut, Shutter::BottomUp] {
        for (field, bins_per_row) in [(None, 1), (Some((12, 13)), 2)] {
            let camera = Camera::new(CameraParams {
                rows: 10,
                columns: 9,
                shutter: shutter.clone(),
                row_time_us: 1.0,
                exposure_us: 1.0,
                bins_per_row,
                field,
                sensor: Sensor::default(),
            })
            .unwrap();
            let psf = random_psf(11, 13, &mut rng);
            let whole = RollingShutter::new(&camera, &psf);
            let shape = camera.video_shape();
            let video: Vec<f32> = (0..shape.voxels())
                .map(|_| rng.random_range(0.0..1.0))
                .collect();
            let mut frame = vec![0.0; whole.range_len()];
            whole.apply(&video, &mut frame);
            let mut back = vec![0.0; shape.voxels()];
            whole.adjoint(&frame, &mut back);
            let frame = Image::new(10, 9, frame).unwrap();
            let measurement = crate::measurement::Measurement::new(frame).unwrap();
            let mut read = Vec::new();
            for bins in [0..2, 2..shape.bins] {
                let part = camera.subset(bins.clone()).unwrap();
                assert_eq!(part.first_bin(), bins.start);
                // A cut of a cut is a cut.
                let again = part.subset(0..bins.len()).unwrap();
                assert_eq!(
                    again.sensor_rows().collect::<Vec<_>>(),
                    part.sensor_rows().collect::<Vec<_>>()
                );
                assert_eq!(again.first_bin(), part.first_bin());
                let operator = RollingShutter::new(&part, &psf);
                let rows: Vec<usize> = part.sensor_rows().collect();
                let seen = measurement.select_rows(&rows);
                let own = bins.start * shape.pixels()..bins.end * shape.pixels();
                let mut values = vec![0.0; operator.range_len()];
                operator.apply(&video[own.clone()], &mut values);
                assert_eq!(values, seen.image().data());
                let mut light = vec![0.0; operator.domain_len()];
                operator.adjoint(&values, &mut light);
                assert_eq!(light, back[own]);
                for instant in 0..operator.rows_of_instants().len() {
                    let of_whole = whole
                        .rows_of_instants()
                        .iter()
                        .position(|rows| *rows == operator.rows_of_instants()[instant])
                        .unwrap();
                    let block = |operator: &RollingShutter, i: usize| {
                        let size = operator.indices_of(i).len();
                        let mut block = Mat::<f64>::zeros(size, size);
                        add_gram_block(operator, i, None, block.as_mut());
                        block
                    };
                    assert_eq!(block(&operator, instant), block(&whole, of_whole));
                }
                read.extend(rows);
            }
            read.sort_unstable();
            assert_eq!(read, (0..10).collect::<Vec<_>>());
        }
    }
}

/// One bin of a scene at rest has the light of a video that shows it throughout.
#[test]
fn a_scene_at_rest_is_seen_as_its_video() {
    for (camera, set) in cases() {
        let shape = camera.video_shape();
        let picture: Vec<f32> = (0..shape.pixels()).map(|i| (i % 7) as f32).collect();
        let seen = |camera: &Camera, video: &[f32]| {
            let mut frame = vec![f32::NAN; camera.rows() * camera.columns()];
            RollingShutter::new(camera, &set).apply(video, &mut frame);
            frame
        };
        let expected = seen(&camera, &picture.repeat(shape.bins));
        let at_rest = camera.at_rest();
        assert_eq!(at_rest.video_shape().bins, 1);
        assert_eq!(at_rest.time().end_us(), camera.time().end_us());
        for (a, b) in seen(&at_rest, &picture).iter().zip(&expected) {
            assert!((a - b).abs() < 1e-4 * (1.0 + b.abs()), "{a} {b}");
        }
        laws::check(&RollingShutter::new(&at_rest, &set), 4);
    }
}

fn top_down(exposure_us: f64, bins_per_row: usize) -> Camera {
    Camera::new(CameraParams {
        rows: 10,
        columns: 9,
        shutter: Shutter::TopDown,
        row_time_us: 1.0,
        exposure_us,
        bins_per_row,
        field: None,
        sensor: Sensor::default(),
    })
    .unwrap()
}

/// The rows that are exposed to some bins alone see a video of these bins as the whole camera does.
#[test]
fn rows_within_bins_see_their_video() {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(9);
    let psf = random_psf(11, 13, &mut rng);
    for (exposure_us, bins_per_row, bins, rows) in [
        (2.5, 1, 3..9, 3..7),
        (2.5, 1, 0..12, 0..10),
        (1.7, 2, 4..12, 2..5),
        (1.0, 1, 4..7, 4..7),
    ] {
        let camera = top_down(exposure_us, bins_per_row);
        let part = camera.within(bins.clone()).unwrap();
        assert_eq!(
            part.sensor_rows().collect::<Vec<_>>(),
            rows.clone().collect::<Vec<_>>()
        );
        let shape = camera.video_shape();
        let of_bins = bins.start * shape.pixels()..bins.end * shape.pixels();
        let mut video = vec![0.0; shape.voxels()];
        video[of_bins.clone()].fill_with(|| rng.random_range(0.0..1.0));
        let seen = |camera: &Camera, video: &[f32]| {
            let mut frame = vec![0.0; camera.rows() * camera.columns()];
            RollingShutter::new(camera, &psf).apply(video, &mut frame);
            frame
        };
        let whole = &seen(&camera, &video)[rows.start * 9..rows.end * 9];
        for (a, b) in seen(&part, &video[of_bins]).iter().zip(whole) {
            assert!((a - b).abs() < 1e-5 * (1.0 + b.abs()), "{a} {b}");
        }
    }
    let message = top_down(2.5, 1).within(3..5).unwrap_err().to_string();
    assert!(message.contains("at least one row"), "{message}");
}

#[test]
fn subsets_that_split_an_exposure_are_refused() {
    let camera = |exposure_us| top_down(exposure_us, 1);
    assert!(camera(1.0).subset(0..3).is_ok());
    for (exposure, bins, word) in [
        (2.5, 0..3, "exposed"),
        (1.0, 3..3, "range"),
        (1.0, 8..11, "0..10"),
    ] {
        let message = camera(exposure).subset(bins).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
}
