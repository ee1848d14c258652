use super::*;
use crate::reconstruct::x_step::Method;
use faer::Mat;
use rowburst_core::vecmath::norm;
use rowburst_optics::camera::CameraParams;
use rowburst_optics::measurement::{Corrections, correct};
use rowburst_optics::{Camera, Image, Psf, Sensor, Shutter};
use rowburst_solve::DataTerm;

fn data(shutter: Shutter) -> FrameData {
    data_with_exposure(shutter, 1.0)
}

/// Exposure in rows.
fn data_with_exposure(shutter: Shutter, exposure: f64) -> FrameData {
    let camera = Camera::new(CameraParams {
        rows: 12,
        columns: 20,
        shutter,
        row_time_us: 10.0,
        exposure_us: 10.0 * exposure,
        bins_per_row: 1,
        field: None,
        sensor: Sensor {
            gain_electrons_per_count: Some(2.0),
            read_noise_electrons: Some(1.5),
            ..Sensor::default()
        },
    })
    .unwrap();
    let psf = Psf::new(Image::from_fn(23, 39, |y, x| {
        (1 + (7 * y * y + 13 * x + 3 * x * y) % 17) as f32
    }))
    .unwrap();
    let frame = Image::from_fn(12, 20, |y, x| (5 + (3 * y + 5 * x) % 11) as f32);
    let measurement = correct(&frame, &camera, &Corrections::default()).unwrap();
    FrameData::new(&Model::new(&camera, &psf), &measurement)
}

/// Checks `solve_gram` against the operator that the solver sees, for several right-hand sides and for a `ρ`
/// below the limit of f32.
fn check(data: &mut FrameData, state: &str) {
    let least = if data.is_iterative() { 0.05 } else { 9e-6 };
    for (k, part) in [0.05, 0.05, 0.06, least, 0.05].into_iter().enumerate() {
        check_one(data, part, k, &format!("{state}, {k}"));
    }
}

fn check_one(data: &mut FrameData, part: f64, k: usize, state: &str) {
    let m = data.operator().range_len();
    let r: Vec<f32> = (0..m)
        .map(|i| ((i * (37 + k) % 101) as f32 - 50.0) / 50.0)
        .collect();
    let rho = part * data.scale();
    let (mut y, mut gram_y) = (vec![f32::NAN; m], vec![f32::NAN; m]);
    // Inexact steps go on from the last one; the first 40 of long exposures are coarse.
    assert!(
        (0..60).any(|_| data.solve_gram(&r, rho, &mut y, &mut gram_y)),
        "{state}"
    );
    let mut video = vec![0.0; data.operator().domain_len()];
    data.operator().adjoint(&y, &mut video);
    if let Some(support) = data.system.support() {
        support.zero_outside(&mut video);
    }
    let mut seen = vec![0.0; m];
    data.operator().apply(&video, &mut seen);
    let wrong: Vec<f32> = seen.iter().zip(&gram_y).map(|(a, b)| a - b).collect();
    let (error, size) = (norm(&wrong), norm(&gram_y));
    // The rounding of `y` and of the operator, in f32.
    let gain = match data.background() {
        Background::Static => data.shape().bins as f64,
        _ => 1.0,
    };
    let rounding = 4e-6 * gain * data.system.max_squared_weight() * data.scale() * norm(&y);
    let most = 1e-4 * size + rounding;
    assert!(error < most, "{state}: {error} {most} of {size}");
    let left: Vec<f32> = (0..m)
        .map(|i| gram_y[i] + rho as f32 * y[i] - r[i])
        .collect();
    assert!(norm(&left) < 0.11 * rho * norm(&y), "{state}");
}

impl FrameData {
    fn is_iterative(&self) -> bool {
        matches!(
            self.x_step.method(),
            Method::ConjugateGradients | Method::ActiveSystem
        )
    }

    fn is_single(&self) -> bool {
        self.x_step.method() == Method::SingleBlocks
    }
}

/// Cached blocks equal new ones to the bit, for one PSF and for several.
#[test]
fn cached_blocks_change_nothing() {
    let first = data(Shutter::DualInsideOut);
    let psf = |seed: usize| {
        let value = |y: usize, x: usize| (1 + (7 * y * y + seed * x + 3 * x * y) % 17) as f32;
        Psf::new(Image::from_fn(23, 39, value)).unwrap()
    };
    let places = vec![(0.0, -6.0), (0.0, 6.0)];
    let several = rowburst_optics::PatchSet::new(vec![psf(13), psf(5)], places).unwrap();
    for psfs in [first.psfs().clone(), several] {
        let model = Model::new(first.system.model().camera(), psfs);
        let frame = Image::from_fn(12, 20, |y, x| (5 + (3 * y + 5 * x) % 11) as f32);
        let measurement = correct(&frame, model.camera(), &Corrections::default()).unwrap();
        let solved = |model: &Model| {
            let mut data = FrameData::new(model, &measurement);
            let (mut y, mut gram_y) = (vec![0.0; 240], vec![0.0; 240]);
            data.solve_gram(frame.data(), 0.01 * data.scale(), &mut y, &mut gram_y);
            y
        };
        let alone = solved(&model);
        assert_eq!(solved(&model.with_cached_gram()), alone);
    }
}

/// Larger weights make larger blocks with larger rounding, so f64 is needed at a larger `ρ`.
#[test]
fn large_weights_need_f64_sooner() {
    for (weight, is_single) in [(1.0, true), (10.0, false)] {
        let mut data = data(Shutter::DualInsideOut);
        data.weights = Some(vec![weight; 240]);
        data.apply_weights();
        data.renew_x_step();
        check_one(&mut data, 5e-5, 0, &format!("weights of {weight}"));
        assert_eq!(data.is_single(), is_single, "weights of {weight}");
    }
}

/// After `reset` the result does not depend on earlier solves, to the bit.
#[test]
fn starts_afresh() {
    let solution = |data: &mut FrameData| {
        let m = data.operator().range_len();
        let r: Vec<f32> = (0..m).map(|i| (i * 13 % 7) as f32).collect();
        let (mut y, mut gram_y) = (vec![0.0; m], vec![0.0; m]);
        data.solve_gram(&r, 0.02 * data.scale(), &mut y, &mut gram_y);
        y
    };
    let mut fresh = data(Shutter::DualInsideOut);
    assert!(fresh.is_single());
    let expected = solution(&mut fresh);
    let mut used = data(Shutter::DualInsideOut);
    check(&mut used, "before");
    assert!(!used.is_single(), "ρ was below what f32 stands for");
    for background in [Background::None, Background::Static, Background::None] {
        used.reset(background, None);
        assert_eq!(used.is_single(), background == Background::None);
        if background == Background::None {
            assert_eq!(solution(&mut used), expected);
        }
    }
    // Nor does a support, of few voxels or of so many that its blocks take the place of those of all.
    let shape = used.shape();
    for every in [301, 97] {
        let light: Vec<f32> = (0..shape.voxels()).map(|i| (i % every) as f32).collect();
        let threshold = every as f64 - 1.5;
        used.restrict(&Support::above(&light, shape, &vec![threshold; shape.bins]));
        assert_ne!(solution(&mut used), expected, "every {every}th voxel");
        used.reset(Background::None, None);
        assert_eq!(solution(&mut used), expected, "every {every}th voxel");
    }
    // A static background keeps no solution of an earlier run either.
    let mut first = data(Shutter::DualInsideOut);
    first.reset(Background::Static, None);
    let expected = solution(&mut first);
    assert_ne!(
        solution(&mut first),
        expected,
        "each solve goes on from the last one"
    );
    first.reset(Background::Static, None);
    assert_eq!(solution(&mut first), expected);
    let camera = used.system.model().camera().clone();
    let frame = Image::from_fn(12, 20, |y, x| (5 + (3 * y + 5 * x) % 11) as f32);
    let measurement = correct(&frame, &camera, &Corrections::default()).unwrap();
    assert!(!FrameData::with_f64_blocks(used.system.model(), &measurement).is_single());
}

#[test]
fn solves_with_the_operator_that_is_seen() {
    let cases = [
        (Shutter::DualInsideOut, 1.0),
        (Shutter::Global, 1.0),
        (Shutter::DualOutsideIn, 2.5),
        (Shutter::TopDown, 5.0),
    ];
    for (shutter, exposure) in cases {
        let mut data = data_with_exposure(shutter.clone(), exposure);
        for background in [
            Background::None,
            Background::Static,
            Background::Alone,
            Background::PerBin,
        ] {
            if data.video_shape().bins == 1 && background != Background::None {
                continue;
            }
            let state = format!("{} {exposure} {background:?}", shutter.name());
            data.reset(background, None);
            let shape = data.shape();
            check(&mut data, &state);
            let held_out = data.held_out();
            data.reset(background, Some(held_out.clone()));
            assert_eq!(data.measurement_count(), 240 - held_out.pixels().len());
            check(&mut data, &format!("{state}, pixels held out"));
            let bright: Vec<f32> = (0..shape.voxels()).map(|i| (i % 9) as f32).collect();
            data.restrict(&Support::above(&bright, shape, &vec![7.5; shape.bins]));
            check(&mut data, &format!("{state}, on a support"));
            if background == Background::None {
                let few: Vec<f32> = (0..shape.voxels()).map(|i| (i % 97) as f32).collect();
                data.restrict(&Support::above(&few, shape, &vec![95.5; shape.bins]));
                check(&mut data, &format!("{state}, on a small support"));
                let is_direct = data.x_step.method() == Method::ActiveSystem;
                assert_eq!(is_direct, exposure > 1.0, "{state}");
            }
        }
    }
}

/// A picture alone has the light of the video that shows it in every bin, and what is solved for after it is as new.
#[test]
fn a_scene_at_rest_is_a_video_of_one_picture() {
    for exposure in [1.0, 2.5] {
        let mut data = data_with_exposure(Shutter::DualInsideOut, exposure);
        let shape = data.video_shape();
        let picture: Vec<f32> = (0..shape.pixels()).map(|i| (i % 13) as f32).collect();
        let expected = data.predicted(&picture.repeat(shape.bins));
        data.reset(Background::Alone, None);
        assert_eq!(data.shape(), Shape::new(1, shape.rows, shape.columns));
        let light = data.predicted(&picture);
        let wrong: Vec<f32> = light.iter().zip(&expected).map(|(a, b)| a - b).collect();
        assert!(norm(&wrong) < 1e-5 * norm(&expected), "{exposure}");
        assert_eq!(data.coverage().len(), shape.voxels());
        assert_eq!(data.video(picture.clone()), picture.repeat(shape.bins));
        data.reset(Background::None, None);
        assert_eq!(data.shape(), shape);
        check(&mut data, "after a scene at rest");
    }
}

/// Weights are those of the light of both parts, and held-out pixels keep weight 0.
#[test]
fn weights_are_updated_from_the_light() {
    let mut data = data(Shutter::DualInsideOut);
    let held_out = data.held_out();
    data.reset(Background::Static, Some(held_out.clone()));
    let n = data.operator().domain_len();
    assert!(data.update_weights(&vec![2.0; n]));
    // Foreground and background are 2 everywhere, so the video is 4.
    let mut light = vec![0.0; 240];
    data.shutter()
        .apply(&vec![4.0; data.shape().voxels()], &mut light);
    let (weights, law) = (data.weights().unwrap(), data.noise.clone().unwrap());
    assert_eq!(weights, law.weights(&light));
    for (i, w) in data.system.operator().weights().unwrap().iter().enumerate() {
        let is_held_out = held_out.pixels().contains(&i);
        assert_eq!(*w, if is_held_out { 0.0 } else { weights[i] });
    }
    check(&mut data, "after following");
    data.reset(Background::Static, Some(held_out.clone()));
    assert_eq!(data.weights(), data.initial_weights.as_deref());
    check(&mut data, "after starting again");
    assert_eq!(
        data.held_out_residuals(&vec![2.0; n]).len(),
        held_out.pixels().len()
    );
}

#[test]
fn stray_light_is_fitted_beside_the_video() {
    let patterns = Mat::from_fn(12 * 20, 3, |i, j| {
        ((i / 20 + j * (i % 20)) as f64 / 8.0).cos()
    });
    for shutter in [Shutter::DualInsideOut, Shutter::TopDown] {
        for exposure in [1.0, 3.0] {
            let mut data = data_with_exposure(shutter.clone(), exposure);
            let mut video = vec![0.0; data.operator().domain_len()];
            video[25] = 3.0;
            let (m, scale) = (data.operator().range_len(), data.scale());
            let light = data.predicted(&video);
            let mut data = WithStrayLight::new(&mut data, &patterns);
            rowburst_core::linop::laws::check(data.operator(), 5);
            let mut r: Vec<f32> = (0..m)
                .map(|i| ((i * 37 % 101) as f32 - 50.0) / 50.0)
                .collect();
            // The part that the solver sees.
            let mut seen = vec![0.0; m];
            data.operator().adjoint(&r, &mut video);
            data.operator().apply(&video, &mut seen);
            r.copy_from_slice(&seen);
            let rho = 0.05 * scale;
            let (mut y, mut gram_y) = (vec![0.0; m], vec![0.0; m]);
            assert!((0..60).any(|_| data.solve_gram(&r, rho, &mut y, &mut gram_y)));
            data.operator().adjoint(&y, &mut video);
            data.operator().apply(&video, &mut seen);
            let wrong: Vec<f32> = (0..m).map(|i| seen[i] + rho as f32 * y[i] - r[i]).collect();
            assert!(norm(&wrong) < 0.11 * rho * norm(&y));
            // The rest of the frame beside a video holds no stray light any more.
            video.fill(0.0);
            video[25] = 3.0;
            let fitted = data.fit(&video);
            let frame = (0..m).map(|i| light[i] + fitted.stray_light[i] + fitted.rest[i]);
            let expected = (0..12 * 20).map(|i| (5 + (3 * (i / 20) + 5 * (i % 20)) % 11) as f32);
            assert!(frame.zip(expected).all(|(f, e)| (f - e).abs() < 1e-3));
            assert!(norm(&fitted.stray_light) > 1.0);
        }
    }
}
