//! Statistics, registration and patches against speckle whose numbers are known.

use rowburst::calibrate::psf::*;
use rowburst::simulate::speckle::{Aperture, SpeckleOptics, speckle_psf};
use rowburst::{Image, Psf};

/// Speckle of a grain of `grain` pixels (λz/D) under an envelope of `width` pixels FWHM.
fn speckle(grain: f64, width: f64, size: (usize, usize), seed: u64) -> Image {
    let distance_mm: f64 = 50.0;
    let pitch = 6.5;
    let na = 0.532 / (2.0 * grain * pitch);
    let angle = 2.0 * (width * pitch / 2e3 / distance_mm).atan();
    let optics = SpeckleOptics {
        wavelength_nm: 532.0,
        aperture: Aperture::ImageNa {
            na,
            image_distance_mm: distance_mm,
        },
        diffuser_fwhm_deg: angle.to_degrees(),
        pixel_pitch_um: pitch,
    };
    let psf = speckle_psf(&optics, size.0, size.1, seed).unwrap();
    let mut image = psf.image().clone();
    let scale = 5e4 / image.max();
    image.data_mut().iter_mut().for_each(|p| *p *= scale);
    image
}

#[test]
fn pure_speckle_has_contrast_one_its_grain_and_no_core() {
    for (grain, width, size) in [
        (4.0, 160.0, (256, 240)),
        (6.0, 900.0, (240, 320)),
        (2.5, 140.0, (215, 215)),
    ] {
        for seed in 1..4 {
            let light = speckle(grain, width, size, seed);
            let s = statistics(&light);
            println!(
                "{grain} {width}: {:.3} {:.2} {:.2} KS {:.3} noise {:.3} lit {:.2} {:.2}",
                s.contrast,
                s.grain_y_px,
                s.grain_x_px,
                s.exponential_distance,
                s.noise_part,
                s.lit_part,
                s.lit_edge_part
            );
            println!("{:?}", ballistic_core(&light, s.grain_px));
        }
    }
}
