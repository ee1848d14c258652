//! The PSF of captures of a point source: numbers, report and folder.

mod captures;
mod report;
mod summary;

pub use captures::{CaptureFile, read_captures};
pub use summary::{MemorySummary, PsfSummary, RowReach};

use crate::short;
use report::{PsfReportInput, render};
use rowburst::calibrate::psf::{
    Core, MemoryEffect, MergeParams, NamedCapture, PointSourceImage, PositionedCapture, Reach,
    SharpenedCapture, SpeckleStatistics, ballistic_core, centred_psfs, centroid, memory_effect,
    merge, noise_of, patch_set, patches_needed, row_reach, select_patches, span_px, statistics,
    suppress_noise, without_pinhole,
};
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Image, Parameter, PatchSet, Psf, PsfCapture, Result};
use rowburst_io::{Experiment, OutputFolder, psf_capture_json, write_npy_image, write_patch_set};
use summary::{remarks, warnings};

/// Standard deviations of noise above which light is light.
const NOISE_FLOOR_SIGMAS: f64 = 3.0;

/// Captures of one place.
pub struct CaptureGroup {
    /// The captures with their names.
    pub shots: Vec<NamedCapture>,
    /// The count at which their kind of file ends, if it holds integers.
    pub saturation_limit: Option<f64>,
}

impl CaptureGroup {
    /// All captures as those of one place.
    pub fn join(groups: impl IntoIterator<Item = Self>) -> Vec<Self> {
        let joined = groups.into_iter().reduce(|mut all, one| {
            all.shots.extend(one.shots);
            all.saturation_limit = all.saturation_limit.or(one.saturation_limit);
            all
        });
        // No capture at all is an error of the library.
        vec![joined.unwrap_or(Self {
            shots: Vec::new(),
            saturation_limit: None,
        })]
    }
}

impl From<CaptureFile> for CaptureGroup {
    fn from(file: CaptureFile) -> Self {
        Self {
            shots: file.shots,
            saturation_limit: file.saturation_limit,
        }
    }
}

/// Captures of a point source, with all that is known of them.
pub struct PsfInputs {
    /// The captures of each place; of one place where there are no positions.
    pub groups: Vec<CaptureGroup>,
    /// The place `(y, x)` of each group in millimetres.
    pub positions_mm: Option<Vec<(f64, f64)>>,
    /// A frame without light.
    pub dark: Option<Image>,
    /// The exposure of each capture in milliseconds, if they differ.
    pub exposures_ms: Vec<f64>,
    /// The count from which on a pixel is saturated.
    pub saturation_counts: Option<f64>,
    /// Raw pixels along a side of a pixel of the working grid.
    pub binning: usize,
    /// Rows and columns of the field; `None`: the span of the positions.
    pub field: Option<(usize, usize)>,
    /// Rows of the sensor; `None`: those of the captures.
    pub sensor_rows: Option<usize>,
    /// Diffraction-limited grain in pixels, to compare with.
    pub expected_grain_px: Option<f64>,
    /// Diameter of the pinhole in µm, whose blur is removed; `None`: a point.
    pub pinhole_um: Option<f64>,
    /// Size at the object of a pixel of the working grid, in µm; the memory effect takes precedence.
    pub object_pixel_um: Option<f64>,
    /// Whether each position has a patch, not only as many as the field needs.
    pub all_patches: bool,
}

/// The PSF of captures, and its quality.
pub struct PsfCalibration {
    /// The PSF of the reference capture.
    pub psf: Psf,
    /// A PSF for each patch of the field, where there are positions.
    pub patches: Option<PatchSet>,
    /// The memory effect, and the place `(y, x)` of each group in millimetres.
    pub effect: Option<(MemoryEffect, Vec<(f64, f64)>)>,
    /// The content of `psf.json`.
    pub summary: PsfSummary,
    speckle: SpeckleStatistics,
    reach: Reach,
}

/// What a folder of [`PsfCalibration::write`] gets beside the PSF.
pub struct PsfFolder<'a> {
    /// An experiment, of which a copy with the PSF is written. Its dark stays: that of the captures has their exposure.
    pub experiment: Option<Experiment>,
    /// The field of the copy.
    pub field: Option<(usize, usize)>,
    /// The command that repeats the calibration.
    pub reproduce: Option<&'a str>,
}

impl PsfInputs {
    /// The PSF of the captures.
    ///
    /// # Errors
    /// Captures that are too few, too small or of different sizes.
    pub fn calibrate(self) -> Result<PsfCalibration> {
        let lights = self.groups.iter().map(|group| self.light(group));
        let lights = lights.collect::<Result<Vec<PointSourceImage>>>()?;
        let memory = self
            .positions_mm
            .clone()
            .map(|positions| MemoryMeasurement::new(&lights, positions))
            .transpose()?;
        let effect = memory.as_ref().map(|m| &m.effect);
        let index = effect.map_or(0, |e| e.reference);
        let pinhole_px = self.pinhole_px(effect)?;
        let reference = ReferencePsf::new(&lights[index], pinhole_px)?;
        let field = self.field;
        let sensor_rows = self.sensor_rows.unwrap_or(reference.light.image.rows());
        let field_rows = field.map_or(sensor_rows, |f| f.0);
        let reach = reference.reach(sensor_rows, field_rows);
        let row_reach = RowReach::new(&reach, sensor_rows, field_rows);
        let patches = memory
            .as_ref()
            .map(|m| m.patches(&reference, field, self.all_patches))
            .transpose()?;
        let patch_count = patches.as_ref().map_or(0, |p| p.psfs().len());
        let mut warned = warnings(
            reference.light,
            &reference.speckle,
            reference.core.as_ref(),
            &row_reach,
            self.expected_grain_px,
        );
        warned.extend(saturated_captures(&lights, index, &self.groups));
        warned.extend(reference.wide_pinhole(self.pinhole_um));
        let summary = reference.summary(
            &lights,
            self.binning,
            row_reach,
            effect,
            memory.as_ref().map(|m| m.summary(field, patch_count)),
            warned,
        );
        Ok(PsfCalibration {
            psf: reference.psf,
            speckle: reference.speckle,
            patches,
            effect: memory.map(|m| (m.effect, m.positions)),
            summary,
            reach,
        })
    }

    /// Diameter of the pinhole's image in pixels; 0: a point.
    fn pinhole_px(&self, effect: Option<&MemoryEffect>) -> Result<f64> {
        let Some(pinhole_um) = self.pinhole_um else {
            return Ok(0.0);
        };
        let bad = |rule: &'static str, remedy: &'static str| {
            Error::input(Parameter::PinholeUm, pinhole_um, rule, remedy)
        };
        if !(pinhole_um.is_finite() && pinhole_um > 0.0) {
            return Err(bad(
                "the diameter of a pinhole is a number above zero",
                "Leave it out where it is not known.",
            ));
        }
        let px_per_um = effect
            .map(|effect| effect.shift_px_per_mm / 1e3)
            .or(self.object_pixel_um.map(f64::recip));
        let px_per_um = px_per_um.ok_or_else(|| {
            bad(
                "the size of its image on the sensor is known from the camera",
                "Give a camera or an experiment file with pixel_pitch_um and magnification, or captures at several positions.",
            )
        })?;
        Ok(pinhole_um * px_per_um)
    }

    /// The light of one place, on the working grid.
    fn light(&self, group: &CaptureGroup) -> Result<PointSourceImage> {
        let mut light = merge(
            &group.shots,
            &MergeParams {
                dark: self.dark.clone(),
                exposures_ms: self.exposures_ms.clone(),
                saturation_counts: self.saturation_counts.or(group.saturation_limit),
            },
        )?;
        let short = light.image.rows().min(light.image.columns());
        if short < 16 * self.binning {
            return Err(Error::input(
                Subject::item(Parameter::Captures, &group.shots[0].name),
                format!(
                    "{}×{} pixels, binned by {}",
                    light.image.rows(),
                    light.image.columns(),
                    self.binning
                ),
                "a PSF has 16 pixels or more along each side",
                "Record a larger region, or bin less.",
            )
            .with_kind(ErrorKind::Shape));
        }
        if self.binning > 1 {
            light.image = light.image.binned(self.binning);
        }
        Ok(light)
    }
}

impl PsfCalibration {
    /// Writes PSF, patches, report and, with an experiment, a copy of it. `psf.json` is written last: where it is, the result is
    /// whole.
    ///
    /// # Errors
    /// Failed writes, or a field that the experiment's camera cannot have.
    pub fn write(&self, folder: &OutputFolder, beside: PsfFolder) -> Result<()> {
        let patches = self.patches.as_ref();
        let has_experiment = beside.experiment.is_some();
        for stale in ["psf.json", "psf-patches.toml", "psf-patches.npy"] {
            folder.remove(stale)?;
        }
        folder.write("psf.npy", |w| write_npy_image(w, self.psf.image()))?;
        if let Some(set) = patches {
            write_patch_set(folder, "psf-patches", set)?;
        }
        if let Some(mut experiment) = beside.experiment {
            let several = patches.is_some_and(|p| p.psfs().len() > 1);
            let file = if several {
                "psf-patches.toml"
            } else {
                "psf.npy"
            };
            experiment.calibration.psf = Some(folder.path().join(file));
            experiment.params.sensor.binning = self.summary.binning;
            experiment.params.field = beside.field.or(experiment.params.field);
            experiment.camera()?;
            let toml = experiment.to_toml(folder.path());
            folder.write_bytes("experiment.toml", toml.as_bytes())?;
        }
        let input = PsfReportInput {
            psf: &self.psf,
            speckle: &self.speckle,
            reach: &self.reach,
            effect: self
                .effect
                .as_ref()
                .map(|(effect, at)| (effect, at.as_slice())),
            summary: &self.summary,
        };
        let report = render(&input, patches.is_some(), has_experiment, beside.reproduce)?;
        for picture in &report.pictures {
            folder.write_bytes(&picture.name, &picture.png)?;
        }
        folder.write_bytes("report.html", report.html.as_bytes())?;
        folder.remove_stale()?;
        let json = serde_json::to_string_pretty(&self.summary).expect("plain numbers and text");
        folder.write_bytes("psf.json", format!("{json}\n").as_bytes())
    }
}

/// The PSF of the reference capture, and the speckle that it was computed from.
struct ReferencePsf<'a> {
    light: &'a PointSourceImage,
    speckle: SpeckleStatistics,
    core: Option<Core>,
    /// Centroid `(y, x)` of the envelope, which becomes zero displacement.
    centre: (f64, f64),
    psf: Psf,
    capture: PsfCapture,
    /// Diameter in pixels of the largest pinhole's image that loses no detail.
    max_pinhole_px: f64,
}

impl<'a> ReferencePsf<'a> {
    fn new(light: &'a PointSourceImage, pinhole_px: f64) -> Result<Self> {
        let speckle = statistics(&light.image);
        let core = ballistic_core(&light.image, speckle.grain_px);
        let centre = centroid(&speckle.envelope);
        let (rows, columns) = (light.image.rows(), light.image.columns());
        let zero = ((rows / 2) as f64, (columns / 2) as f64);
        let sharp = without_pinhole(&light.image, pinhole_px);
        let cleaned = cleaned(&light.image, &sharp, speckle.grain_px);
        let sum: f64 = cleaned.data().iter().map(|&p| f64::from(p)).sum();
        let moves = (zero.0 - centre.0, zero.1 - centre.1);
        let psf = centred_psfs(&[&cleaned], &[moves])?.remove(0);
        let capture = PsfCapture {
            noise_per_light: sharp.noise_per_light / sum,
            pinhole_px,
        };
        Ok(Self {
            psf: psf.with_capture(Some(capture)),
            capture,
            max_pinhole_px: sharp.max_pinhole_px,
            light,
            speckle,
            core,
            centre,
        })
    }

    /// A warning of a pinhole of `diameter_um` whose image is too wide for its blur to be removed.
    fn wide_pinhole(&self, diameter_um: Option<f64>) -> Option<String> {
        let pinhole_px = self.capture.pinhole_px;
        let diameter_um = diameter_um.filter(|_| pinhole_px > self.max_pinhole_px)?;
        Some(format!(
            "the image of the pinhole is {:.1} px wide: fine detail of the PSF is lost, and no calculation brings it back; take a pinhole of at most {} µm",
            pinhole_px,
            short(diameter_um * self.max_pinhole_px / pinhole_px)
        ))
    }

    /// The light that each sensor row gets from each row of the field.
    fn reach(&self, sensor_rows: usize, field_rows: usize) -> Reach {
        let covered = (
            -self.centre.0.floor() as isize,
            self.light.image.rows() as isize - 1 - self.centre.0.ceil() as isize,
        );
        row_reach(
            &self.psf,
            sensor_rows,
            field_rows,
            self.speckle.grain_px,
            (self.speckle.lit_edge_fraction > 0.02).then_some(covered),
        )
    }

    /// The numbers of `psf.json`; `lights` are those of all captures.
    fn summary(
        &self,
        lights: &[PointSourceImage],
        binning: usize,
        row_reach: RowReach,
        effect: Option<&MemoryEffect>,
        memory: Option<MemorySummary>,
        warnings: Vec<String>,
    ) -> PsfSummary {
        PsfSummary {
            version: env!("CARGO_PKG_VERSION"),
            rows: self.psf.image().rows(),
            columns: self.psf.image().columns(),
            binning,
            captures: lights.iter().map(|l| l.used).sum(),
            left_out: lights
                .iter()
                .flat_map(|l| &l.left_out)
                .map(|o| o.0.clone())
                .collect(),
            contrast: self.speckle.contrast,
            grain_px: self.speckle.grain_px,
            grain_y_px: self.speckle.grain_y_px,
            grain_x_px: self.speckle.grain_x_px,
            ballistic_fraction: self.core.map_or(0.0, |c| c.fraction),
            ballistic_at_px: self.core.map(|c| c.at_px),
            saturated_fraction: self.light.saturated_fraction,
            exponential_distance: self.speckle.exponential_distance,
            noise_part: self.speckle.noise_fraction,
            lit_fraction: self.speckle.lit_fraction,
            floor_counts: self.light.black_level.map(|f| f.counts),
            capture: psf_capture_json(self.capture, self.psf.image()),
            middle_px: self.centre,
            remarks: remarks(self.light, &self.speckle, &row_reach, effect),
            row_reach,
            memory,
            warnings,
        }
    }
}

/// The light of `sharp` without its noise, of which `light` tells how much there is.
fn cleaned(light: &Image, sharp: &SharpenedCapture, grain_px: f64) -> Image {
    let noise = noise_of(light);
    suppress_noise(&sharp.image, grain_px, noise, NOISE_FLOOR_SIGMAS).image
}

/// The memory effect between captures at known positions.
struct MemoryMeasurement {
    /// Positions `(y, x)` in millimetres.
    positions: Vec<(f64, f64)>,
    captures: Vec<PositionedCapture>,
    effect: MemoryEffect,
}

impl MemoryMeasurement {
    fn new(lights: &[PointSourceImage], positions: Vec<(f64, f64)>) -> Result<Self> {
        let rough = statistics(&lights[lights.len() / 2].image).grain_px;
        let captures = lights.iter().zip(&positions);
        let captures: Vec<PositionedCapture> = captures
            .map(|(light, at)| PositionedCapture {
                light: light.image.clone(),
                at_mm: *at,
            })
            .collect();
        let effect = memory_effect(&captures, rough)?;
        Ok(Self {
            positions,
            captures,
            effect,
        })
    }

    /// A PSF for each patch of the field, or for each position if `all` is set.
    fn patches(
        &self,
        reference: &ReferencePsf,
        field: Option<(usize, usize)>,
        all: bool,
    ) -> Result<PatchSet> {
        let kept: Vec<usize> = if all {
            (0..self.positions.len()).collect()
        } else {
            select_patches(&self.positions, &self.effect, field)
        };
        let captures = self.captures.iter();
        let cleaned: Vec<Image> = captures
            .map(|p| {
                let sharp = without_pinhole(&p.light, reference.capture.pinhole_px);
                cleaned(&p.light, &sharp, reference.speckle.grain_px)
            })
            .collect();
        patch_set(
            &cleaned,
            &self.positions,
            &self.effect,
            &kept,
            reference.centre,
        )
    }

    /// The numbers of the memory effect; `patches` is the number of PSFs written.
    fn summary(&self, field: Option<(usize, usize)>, patches: usize) -> MemorySummary {
        let extent = field.map_or_else(
            || span_px(&self.positions, &self.effect),
            |f| (f.0 as f64, f.1 as f64),
        );
        let needed = patches_needed(&self.effect, extent);
        MemorySummary::new(&self.effect, patches, needed)
    }
}

/// Captures besides the reference that are saturated.
fn saturated_captures(
    lights: &[PointSourceImage],
    reference: usize,
    groups: &[CaptureGroup],
) -> Option<String> {
    let others = lights.iter().zip(groups).enumerate();
    let mut names = others
        .filter(|(i, (light, _))| *i != reference && light.saturated_fraction > 1e-3)
        .map(|(_, (_, group))| group.shots[0].name.as_str());
    let first = names.next()?;
    Some(format!(
        "{} more captures are saturated, such as {first}: shorten the exposure",
        names.count() + 1
    ))
}
