//! scratch
#[path = "../tests/common/mod.rs"]
mod common;
use common::*;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::*;
use rowburst::*;
use std::ops::ControlFlow;
use std::time::Instant;

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let dir = std::path::PathBuf::from("/work/shared/problems").join(&args[1]);
    let camera = camera_of(&dir);
    let (s, psf) = read_f32(&dir.join("psf.npy"));
    let psf = Psf::new(Image::new(s[0], s[1], psf).unwrap()).unwrap();
    let (s, b) = read_f32(&dir.join("frame.npy"));
    let (_, truth) = read_f32(&dir.join("truth.npy"));
    let op = RollingShutter::new(&camera, &psf);
    let mut clean = vec![0.0; b.len()];
    op.apply(&truth, &mut clean);
    let m = b.len() as f64;
    let sigma = (vecmath::norm_squared(&clean) / m).sqrt() / 256.0;
    let t0 = Instant::now();
    let prior: Prior = args[2].parse().unwrap();
    let me = Measurement::new(Image::new(s[0], s[1], b).unwrap()).unwrap();
    let p = Problem::new(
        &me,
        &camera,
        &psf,
        Recipe {
            prior,
            ..Recipe::default()
        },
    )
    .unwrap();
    println!(
        "sigma {sigma:.3e} estimated {:.3e}; setup {:?}",
        p.sigma(),
        t0.elapsed()
    );
    let t0 = Instant::now();
    let sigma = p.sigma();
    let r = p.solve(&mut |p| {
        if p.iteration % 20 == 0 {
            println!("{:4} {:.2}s psnr {:.2} res/s {:.3} tau {:.2e} change {:.1e} sup {:.4} obj {:.4e}", p.iteration, t0.elapsed().as_secs_f64(), metrics::psnr_db(p.video, &truth), p.residual_rms / sigma, p.tau, p.change, p.support, p.objective);
        }
        ControlFlow::Continue(())
    }).unwrap();
    println!(
        "{} {:?} {} psnr {:.2} res {:.3} {:.2}s",
        args[1],
        r.stop_reason,
        r.iterations,
        metrics::psnr_db(r.video.data(), &truth),
        r.residual_over_sigma,
        t0.elapsed().as_secs_f64()
    );
}
