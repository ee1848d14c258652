//! The page of a design, its pictures and `design.json`.

use super::{DesignInputs, DesignSummary};
use rowburst::design::sparsity::SuccessMap;
use rowburst::design::{Assessment, LightParams, signal};
use rowburst::{Image, Psf, Result};
use rowburst_io::OutputFolder;
use rowburst_report::{Curve, Drawing, Ink, Plot, Scale, Sheet};

/// What the page is made of.
pub(super) struct Page<'a> {
    /// What is assessed.
    pub inputs: &'a DesignInputs,
    /// The closed forms.
    pub assessment: &'a Assessment,
    /// The trials, if there were some.
    pub map: Option<&'a SuccessMap>,
    /// The PSF that is shown.
    pub psf: Option<&'a Psf>,
    /// The numbers of `design.json`.
    pub summary: &'a DesignSummary,
    /// The command that repeats it.
    pub reproduce: Option<&'a str>,
}

/// Pictures that a run without trials, or without a PSF, does not write.
const OPTIONAL: [&str; 3] = ["success-map.png", "recoverable.png", "psf.png"];

impl Page<'_> {
    /// Writes all files, `design.json` last: where it is, the result is whole.
    pub(super) fn write(&self, folder: &OutputFolder) -> Result<()> {
        // Those of an earlier run would vouch for files that are no longer its own.
        folder.remove("design.json")?;
        for name in OPTIONAL {
            folder.remove(name)?;
        }
        let summary = self.summary;
        let rates = self.map.map(rates_by_snr);
        let steps: Vec<Vec<f64>> = match self.map {
            Some(map) => vec![
                map.params.ks.iter().map(|&k| k as f64).collect(),
                map.params.snrs.clone(),
            ],
            None => vec![Vec::new(), Vec::new()],
        };
        let reach = &self.assessment.spread.rows;
        let camera = &self.inputs.camera;
        let places = |count: usize, of: usize| -> Vec<f64> {
            (0..count).map(|i| (i * of / count) as f64).collect()
        };
        let from = places(reach.rows(), camera.field().0);
        let to = places(reach.columns(), camera.rows());
        let mut sections = Vec::new();
        if let (Some(map), Some(rates)) = (self.map, &rates) {
            sections.push((
                "How much of a scene is recovered",
                vec![success_drawing(map, rates, &steps), self.half_drawing(map)],
            ));
        }
        let mut optics = vec![reach_drawing(reach, &from, &to)];
        if let Some(psf) = self.psf {
            optics.push(self.psf_drawing(psf));
        }
        sections.push(("Where the light goes", optics));
        sections.push((
            "Light and colour",
            vec![self.snr_drawing(), self.colour_drawing()],
        ));
        let mut tables = summary.sections();
        tables.push(("Given".into(), self.given()));
        let report = Sheet {
            title: "Rowburst: design",
            summary: self.title_line(),
            verdict: None,
            warnings: summary.warnings.clone(),
            notes: Vec::new(),
            headline: headline(summary),
            sections,
            tables,
            files: vec![
                ("report.html".into(), "this page".into()),
                ("design.json".into(), "the numbers, for programs".into()),
            ],
            reproduce: self.reproduce,
        }
        .render()?;
        for picture in &report.pictures {
            folder.write_bytes(&picture.name, &picture.png)?;
        }
        folder.write_bytes("report.html", report.html.as_bytes())?;
        folder.write_bytes("design.json", format!("{}\n", summary.json()).as_bytes())
    }

    /// The design in one sentence.
    fn title_line(&self) -> String {
        let (camera, summary) = (&self.inputs.camera, self.summary);
        format!(
            "{} × {} pixels, {}, a diffuser of {:.2}°: {} frames at {:.0} fps from one frame.",
            camera.rows(),
            camera.columns(),
            camera.shutter().name(),
            self.inputs.optics.diffuser_fwhm_deg,
            summary.frames,
            summary.frame_rate_hz
        )
    }

    /// The PSF, measured or simulated.
    fn psf_drawing<'a>(&self, psf: &'a Psf) -> Drawing<'a> {
        Drawing {
            name: "psf",
            plot: Plot::Map {
                image: psf.image(),
                quantity: "part of the light",
                range: None,
            },
            caption: match &self.inputs.psf_file {
                Some(path) => format!("The PSF of {}.", path.display()),
                None => format!(
                    "One random speckle PSF of these optics, of every displacement from field to sensor: grains of {:.1} px in an envelope of {:.0} px. Light that falls outside of it is not shown.",
                    self.summary.grain_fwhm_px, self.summary.envelope_fwhm_px
                ),
            },
            alt: "The point-spread function.".into(),
        }
    }

    fn half_drawing(&self, map: &SuccessMap) -> Drawing<'_> {
        let points = map.params.snrs.iter().copied().zip(map.k50.iter().copied());
        let snr = self.assessment.signal.snr;
        let expected = map.k50_at(snr);
        Drawing {
            name: "recoverable",
            plot: Plot::Curves {
                x: ("SNR of a pixel", Scale::Auto),
                y: (
                    "non-zero pixels a bin",
                    Scale::Linear(0.0, 1.15 * map.k50.iter().copied().fold(1.0, f64::max)),
                ),
                curves: vec![
                    Curve {
                        name: "half of the bins are recovered".into(),
                        points: points.collect(),
                        ink: Ink::Line,
                    },
                    Curve {
                        name: format!("expected SNR {snr:.0}"),
                        points: vec![(
                            snr.clamp(
                                map.params.snrs[0],
                                map.params.snrs[map.params.snrs.len() - 1],
                            ),
                            expected,
                        )],
                        ink: Ink::Dots,
                    },
                ],
            },
            caption: format!(
                "Non-zero pixels per bin at which half of the bins are recovered, over the SNR, on the {}×{} pixels of the trials ({:.0} measurements a bin). The dot is this design; beyond the ends it lies at the nearest SNR tried.",
                map.sensor.0, map.sensor.1, map.measurements_per_bin
            ),
            alt: "Curve of recoverable pixels over SNR.".into(),
        }
    }

    fn snr_drawing(&self) -> Drawing<'_> {
        let light = self.inputs.light;
        // Two decades to either side.
        let points = (-20..=20).map(|i| {
            let photons = light.photons * 10f64.powf(f64::from(i) / 10.0);
            let at = signal(
                &self.inputs.camera,
                &self.assessment.spread,
                &LightParams { photons, ..light },
            );
            (photons, at.snr)
        });
        Drawing {
            name: "snr",
            plot: Plot::Curves {
                x: ("photons of a bright scene pixel in a bin", Scale::Auto),
                y: ("SNR of a sensor pixel", Scale::Auto),
                curves: vec![
                    Curve {
                        name: format!("{} bright pixels a bin", light.bright_pixels),
                        points: points.collect(),
                        ink: Ink::Line,
                    },
                    Curve {
                        name: "this design".into(),
                        points: vec![(light.photons, self.assessment.signal.snr)],
                        ink: Ink::Dots,
                    },
                ],
            },
            caption: "Rms of the noiseless frame over shot, read and rounding noise. Under shot noise ten times the light give 3.2 times the SNR, under read noise ten times. The curve ignores the full well.".into(),
            alt: "Curve of SNR over photons.".into(),
        }
    }

    fn colour_drawing(&self) -> Drawing<'_> {
        let dispersion = &self.assessment.dispersion;
        let end = 3.0 * self.assessment.bandwidth_nm;
        let curve = |of: &dyn Fn(f64) -> f64| -> Vec<(f64, f64)> {
            (0..=60)
                .map(|i| f64::from(i) / 60.0 * end)
                .map(|nm| (nm, of(nm)))
                .collect()
        };
        Drawing {
            name: "colour",
            plot: Plot::Curves {
                x: (
                    "difference in wavelength, bandwidth (nm)",
                    Scale::Linear(0.0, end),
                ),
                y: ("correlation, contrast", Scale::Linear(0.0, 1.05)),
                curves: vec![
                    Curve {
                        name: "correlation of the PSFs of two wavelengths".into(),
                        points: curve(&|nm| dispersion.correlation(nm)),
                        ink: Ink::Line,
                    },
                    Curve {
                        name: "contrast that a source of this bandwidth keeps".into(),
                        points: curve(&|nm| dispersion.contrast_kept(nm.max(1e-3))),
                        ink: Ink::Line,
                    },
                    Curve {
                        name: String::new(),
                        points: vec![(0.0, 0.5), (end, 0.5)],
                        ink: Ink::Expected,
                    },
                ],
            },
            caption: format!(
                "The correlation falls to one half at {:.1} nm: diffraction moves a grain at radius R by RΔλ/λ, and the path through the diffuser takes another phase.",
                self.assessment.bandwidth_nm
            ),
            alt: "Curves of correlation and contrast over wavelength.".into(),
        }
    }

    fn given(&self) -> Vec<(String, String)> {
        let (inputs, params) = (self.inputs, self.inputs.camera.params());
        let field = inputs.camera.field();
        let pair = |name: &str, value: String| (name.to_string(), value);
        vec![
            pair("wavelength_nm", inputs.optics.wavelength_nm.to_string()),
            pair(
                "image-side NA",
                format!("{:.4}", inputs.optics.aperture.na()),
            ),
            pair(
                "image distance",
                format!("{:.1} mm", inputs.optics.aperture.image_distance_mm()),
            ),
            pair("diffuser_deg", inputs.optics.diffuser_fwhm_deg.to_string()),
            pair("pixel_pitch_um", inputs.optics.pixel_pitch_um.to_string()),
            pair("row_time_us", params.row_time_us.to_string()),
            pair("exposure_us", params.exposure_us.to_string()),
            pair("field", format!("{} × {}", field.0, field.1)),
            pair("photons", format!("{:e}", inputs.light.photons)),
            pair("bright_pixels", inputs.light.bright_pixels.to_string()),
            pair(
                "quantum_efficiency",
                inputs.light.quantum_efficiency.to_string(),
            ),
            pair(
                "read_noise_electrons",
                inputs.light.read_noise_electrons.to_string(),
            ),
            pair("seed", inputs.seed.to_string()),
        ]
    }
}

fn headline(summary: &DesignSummary) -> Vec<(String, String)> {
    [
        ("Frame rate", format!("{:.0} fps", summary.frame_rate_hz)),
        ("Frames", summary.frames.to_string()),
        ("Grain", format!("{:.2} px", summary.grain_px)),
        (
            "Smallest diffuser",
            format!("{:.2}°", summary.smallest_diffuser_deg),
        ),
        ("SNR", format!("{:.0}", summary.snr_per_pixel)),
        (
            "Recoverable",
            format!("{:.0} pixels a bin", summary.recoverable_pixels_per_bin),
        ),
    ]
    .map(|(name, value)| (name.to_string(), value))
    .to_vec()
}

/// Light of each sensor row from each row of the field; `from` and `to` are the rows of its axes.
fn reach_drawing<'a>(reach: &'a Image, from: &'a [f64], to: &'a [f64]) -> Drawing<'a> {
    Drawing {
        name: "reach",
        plot: Plot::Grid {
            image: reach,
            quantity: ("light", 0.0, 1.0),
            x: ("sensor row, from the top", to),
            y: ("field row, from the top", from),
        },
        caption: "Light that each sensor row gets from each row of the field, over that of a row level with the source. The corners, from the bottom of the field to the top row and back, need 0.1 or more.".into(),
        alt: "Map of light over sensor row and field row.".into(),
    }
}

fn success_drawing<'a>(map: &SuccessMap, rates: &'a Image, steps: &'a [Vec<f64>]) -> Drawing<'a> {
    Drawing {
        name: "success-map",
        plot: Plot::Grid {
            image: rates,
            quantity: ("success", 0.0, 1.0),
            x: ("non-zero pixels a bin", &steps[0]),
            y: ("SNR of a pixel", &steps[1]),
        },
        caption: format!(
            "Fraction of {} bins that were recovered, over the number of scattered non-zero pixels and the SNR: {} reconstructions with prior l1+support. Recovered means that at the resolution of a grain the error is below {} of the norm. Bright is success; cells far from the edge are not tested and have the value of their neighbour.",
            map.trials, map.reconstructions, map.params.tolerance
        ),
        alt: "Map of success over sparsity and SNR.".into(),
    }
}

fn rates_by_snr(map: &SuccessMap) -> Image {
    Image::from_fn(map.params.snrs.len(), map.params.ks.len(), |s, k| {
        map.rates[s][k] as f32
    })
}
