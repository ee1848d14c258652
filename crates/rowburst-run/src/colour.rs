//! A raw Bayer frame: four planes, each with a reconstruction of its own, and one video in colour.

use crate::summary::MetadataNumbers;
use rowburst::bayer::{Bayer, Colour, PlaneCamera, Site, plane_camera, plane_image, plane_psfs};
use rowburst::measurement::Corrections;
use rowburst::{Camera, Error, Image, PatchSet, Result, Video};
use serde::Serialize;

/// What the planes of a frame share.
pub struct ColourInputs {
    /// The raw frame.
    pub raw: Image,
    /// The camera of the raw frame.
    pub camera: Camera,
    /// The order of the colours.
    pub mosaic: Bayer,
    /// The PSFs of the raw frame.
    pub psfs: PatchSet,
    /// Dark, flat and bad pixels of the raw frame.
    pub corrections: Corrections,
}

/// A plane of a frame, still to be corrected.
pub struct Plane {
    /// Its place in the cell.
    pub site: Site,
    /// Its camera.
    pub camera: PlaneCamera,
    /// Its PSFs.
    pub psfs: PatchSet,
    /// Its pixels.
    pub raw: Image,
    /// Its corrections.
    pub corrections: Corrections,
}

impl ColourInputs {
    /// Checks that the corrections have the size of the frame.
    ///
    /// # Errors
    /// Another size; the error names `dark`, `flat` or `bad_pixels`.
    pub fn check_corrections(&self) -> Result<()> {
        let raw = &self.raw;
        let corrections = &self.corrections;
        for (name, image) in [
            ("dark", &corrections.dark),
            ("flat", &corrections.flat),
            ("bad_pixels", &corrections.bad_pixels),
        ] {
            let size = image.as_ref().map(|i| (i.rows(), i.columns()));
            if size.is_some_and(|size| size != (raw.rows(), raw.columns())) {
                return Err(Error::input(
                    name,
                    format!("{size:?} pixels"),
                    format!("it has the frame's {}×{} pixels", raw.rows(), raw.columns()),
                    "Record it with the camera settings of the frame.",
                ));
            }
        }
        Ok(())
    }

    /// The planes in the order of their reconstruction. Green comes first, since it has half of the pixels: the prior is
    /// chosen on it, for all.
    pub fn sites(&self) -> Vec<Site> {
        let mut sites = self.mosaic.sites().to_vec();
        sites.sort_by_key(|site| (site.colour != Colour::Green, site.row));
        sites
    }

    /// The camera of a plane.
    ///
    /// # Errors
    /// Those of [`plane_camera`].
    pub fn plane_camera(&self, site: Site) -> Result<PlaneCamera> {
        plane_camera(&self.camera, site)
    }

    /// A plane with its `camera`.
    ///
    /// # Errors
    /// Those of [`plane_psfs`].
    pub fn plane(&self, site: Site, camera: PlaneCamera) -> Result<Plane> {
        let of = |image: &Option<Image>| image.as_ref().map(|image| plane_image(image, site));
        Ok(Plane {
            site,
            camera,
            psfs: plane_psfs(&self.psfs, site)?,
            raw: plane_image(&self.raw, site),
            corrections: Corrections {
                dark: of(&self.corrections.dark),
                flat: of(&self.corrections.flat),
                bad_pixels: of(&self.corrections.bad_pixels),
                saturation_counts: self.corrections.saturation_counts,
            },
        })
    }
}

/// Checks that a raw frame has the size of the sensor. `subject` names it in errors.
///
/// # Errors
/// Another size.
pub fn check_raw_frame(subject: &str, raw: &Image, camera: &Camera) -> Result<()> {
    if (raw.rows(), raw.columns()) == (camera.rows(), camera.columns()) {
        return Ok(());
    }
    Err(Error::input(
        subject,
        format!("{}×{} pixels", raw.rows(), raw.columns()),
        format!("the camera has {}×{}", camera.rows(), camera.columns()),
        "Give the raw frame, before any colours are made of it.",
    ))
}

/// The videos of red, green (the mean of its two planes) and blue; `None` where the planes differ in length.
pub fn merge_planes(planes: &[(Site, &Video)]) -> Option<[Vec<f32>; 3]> {
    let shape = planes.first()?.1.shape();
    if planes.iter().any(|(_, video)| video.shape() != shape) {
        return None;
    }
    Some([Colour::Red, Colour::Green, Colour::Blue].map(|colour| {
        // In the order of the mosaic, which decides the last bit of the mean.
        let mut sites: Vec<&(Site, &Video)> = planes
            .iter()
            .filter(|(site, _)| site.colour == colour)
            .collect();
        sites.sort_by_key(|(site, _)| (site.row, site.column));
        match sites[..] {
            [(_, one), (_, other)] => {
                let pairs = one.data().iter().zip(other.data());
                pairs.map(|(a, b)| 0.5 * (a + b)).collect()
            }
            _ => sites[0].1.data().to_vec(),
        }
    }))
}

/// The content of `result.json` of a video in colour; each plane has one of its own.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[allow(missing_docs, reason = "the fields are the keys of result.json")]
pub struct ColourSummary {
    #[cfg_attr(test, schemars(extend("const" = crate::RESULT_SCHEMA_VERSION)))]
    pub schema_version: u32,
    pub version: &'static str,
    pub bayer: &'static str,
    pub frames: usize,
    pub rows: usize,
    pub columns: usize,
    pub frame_rate_hz: f64,
    pub metadata: MetadataNumbers,
    pub planes: Vec<PlaneSummary>,
    pub warnings: Vec<String>,
}

/// A plane, whose own `result.json` says more.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[allow(missing_docs, reason = "the fields are the keys of result.json")]
pub struct PlaneSummary {
    pub name: String,
    pub folder: String,
    /// From the start of the sensor's first instant to that of the plane's.
    pub start_us: f64,
    pub prior: String,
    pub tau: f64,
    pub residual_over_sigma: f64,
    /// Part of the plane's pixels that are foreign and were left out.
    pub excluded_fraction: f64,
    pub fit: &'static str,
    pub seconds: f64,
}
