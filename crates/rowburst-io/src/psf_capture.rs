//! What `calibrate psf` writes beside a PSF of how it was captured: `psf.json` beside `psf.npy`.

use rowburst::{Image, PsfCapture};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use tracing::{info, warn};

/// SHA-256 of the size and the bits of the pixels of `image`.
pub fn hash_image(image: &Image) -> String {
    let mut hash = Sha256::new();
    for side in [image.rows(), image.columns()] {
        hash.update((side as u64).to_le_bytes());
    }
    let values = image.data().iter();
    values.for_each(|v| hash.update(v.to_le_bytes()));
    let digits = hash.finalize();
    let digits = digits.iter().map(|byte| format!("{byte:02x}"));
    format!("sha256:{}", digits.collect::<String>())
}

/// The keys of `psf.json` that [`read_psf_capture`] reads; `psf` is the image that the file is beside.
pub fn psf_capture_json(capture: PsfCapture, psf: &Image) -> Value {
    json!({
        "noise_per_light": capture.noise_per_light,
        "pinhole_px": capture.pinhole_px,
        "psf": hash_image(psf),
    })
}

/// The file beside the PSF of `path` that tells how it was captured.
pub fn psf_capture_path(path: &Path) -> PathBuf {
    path.with_extension("json")
}

/// How the PSF in the file `path` was captured, as the file beside it says; `psf` is its image. `None`: there is no such
/// file, or it is that of another image.
pub fn read_psf_capture(path: &Path, psf: &Image) -> Option<PsfCapture> {
    let beside = psf_capture_path(path);
    let text = std::fs::read_to_string(&beside).ok()?;
    let file: Value = serde_json::from_str(&text).ok()?;
    let capture = file.get("capture")?;
    let number = |key: &str| {
        capture
            .get(key)?
            .as_f64()
            .filter(|v| v.is_finite() && *v >= 0.0)
    };
    let found = PsfCapture {
        noise_per_light: number("noise_per_light")?,
        pinhole_px: number("pinhole_px")?,
    };
    if capture.get("psf")?.as_str()? != hash_image(psf) {
        warn!(
            "{} tells of another PSF than {}: the noise of the capture is estimated from the PSF",
            beside.display(),
            path.display()
        );
        return None;
    }
    info!("read {}: how the PSF was captured", beside.display());
    Some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_capture_belongs_to_its_psf() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("psf.npy");
        let psf = Image::from_fn(4, 5, |y, x| (y * x) as f32);
        let capture = PsfCapture {
            noise_per_light: 1e-6,
            pinhole_px: 1.5,
        };
        assert_eq!(read_psf_capture(&path, &psf), None);
        let file = json!({"contrast": 0.9, "capture": psf_capture_json(capture, &psf)});
        std::fs::write(psf_capture_path(&path), file.to_string()).unwrap();
        assert_eq!(read_psf_capture(&path, &psf), Some(capture));
        let other = Image::from_fn(4, 5, |y, x| (y + x) as f32);
        assert_eq!(read_psf_capture(&path, &other), None);
    }

    #[test]
    fn every_bit_of_an_image_counts() {
        let image =
            |value: f32| Image::from_fn(2, 3, |y, x| if y == 1 && x == 2 { value } else { 1.0 });
        let base = hash_image(&image(1.0));
        assert_eq!(base, hash_image(&image(1.0)));
        assert_ne!(base, hash_image(&image(1.0 + f32::EPSILON)));
        assert_ne!(base, hash_image(&Image::from_fn(3, 2, |_, _| 1.0)));
    }
}
