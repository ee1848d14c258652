//! Fingerprints: whether two jobs are one.

use rowburst::error::With;
use rowburst::{Error, ErrorKind, Parameter, PatchSet, Result, phrase};
use rowburst_io::hash_image;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

const HASH: &str = "sha256:";

fn hex(hash: Sha256) -> String {
    let digits = hash.finalize();
    let digits = digits.iter().map(|byte| format!("{byte:02x}"));
    HASH.to_string() + &digits.collect::<String>()
}

/// Of all PSFs and their places.
pub(crate) fn hash_psfs(psfs: &PatchSet) -> String {
    let mut hash = Sha256::new();
    for (psf, (y, x)) in psfs.psfs().iter().zip(psfs.offsets_px()) {
        hash.update(hash_image(psf.image()));
        hash.update(y.to_le_bytes());
        hash.update(x.to_le_bytes());
        if let Some(capture) = psf.capture() {
            hash.update(capture.noise_per_light.to_le_bytes());
            hash.update(capture.pinhole_px.to_le_bytes());
        }
    }
    hex(hash)
}

/// Refuses to go on in `out` with another job than the one that it was begun with.
pub(crate) fn check_same(
    out: &Path,
    begun: &BTreeMap<String, String>,
    now: &BTreeMap<String, String>,
) -> Result<()> {
    let is_short = |text: &str| !text.starts_with(HASH) && text.len() <= 80;
    let all: BTreeMap<&String, ()> = begun.keys().chain(now.keys()).map(|k| (k, ())).collect();
    let differences: Vec<String> = all
        .into_keys()
        .filter(|key| begun.get(*key) != now.get(*key))
        .map(|key| {
            let text = |of: &BTreeMap<String, String>| of.get(key).cloned().unwrap_or_default();
            match (text(begun), text(now)) {
                (then, now) if is_short(&then) && is_short(&now) => {
                    format!("{key} was {then}, now {now}")
                }
                _ => format!("another {key}"),
            }
        })
        .collect();
    if differences.is_empty() {
        return Ok(());
    }
    Err(Error::input(
        out,
        format!(
            "a batch that was started with other settings ({})",
            differences.join("; ")
        ),
        "an archive holds the videos of one recording, all reconstructed with the same settings",
        phrase![
            "Choose another folder",
            With(Parameter::Output),
            ", or resume with the settings that this one was started with."
        ],
    )
    .with_kind(ErrorKind::Conflict))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::{Image, Psf, PsfCapture};

    fn parts(pairs: &[(&str, &str)]) -> BTreeMap<String, String> {
        let owned = |(k, v): &(&str, &str)| (k.to_string(), v.to_string());
        pairs.iter().map(owned).collect()
    }

    #[test]
    fn what_differs_is_named() {
        let begun = parts(&[("prior", "tv"), ("PSF", "sha256:aa"), ("tau", "Auto")]);
        assert!(check_same(Path::new("o"), &begun, &begun).is_ok());
        let now = parts(&[("prior", "l1"), ("PSF", "sha256:bb"), ("tau", "Auto")]);
        let message = check_same(Path::new("o"), &begun, &now)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("another PSF; prior was tv, now l1"),
            "{message}"
        );
    }

    #[test]
    fn values_and_captures_of_psfs_count() {
        let psf = |value| Psf::new(Image::from_fn(2, 3, |y, x| value + (y + x) as f32)).unwrap();
        let hash = |psf: Psf| hash_psfs(&PatchSet::from(&psf));
        assert_eq!(hash(psf(1.0)), hash(psf(1.0)));
        assert_ne!(hash(psf(1.0)), hash(psf(2.0)));
        let captured = psf(1.0).with_capture(Some(PsfCapture {
            noise_per_light: 1e-6,
            pinhole_px: 0.0,
        }));
        assert_ne!(hash(psf(1.0)), hash(captured));
    }
}
