//! The page of a PSF: what its numbers look like.

use super::summary::PsfSummary;
use crate::calibrate::verdict;
use crate::short;
use rowburst::calibrate::psf::{HISTOGRAM_BIN_WIDTH, MemoryEffect, Reach, SpeckleStatistics};
use rowburst::{Image, Psf, Result};
use rowburst_report::{Curve, Drawing, Ink, Plot, Report, Scale, Sheet};

/// What the page shows.
pub struct PsfReportInput<'a> {
    pub psf: &'a Psf,
    pub speckle: &'a SpeckleStatistics,
    pub reach: &'a Reach,
    /// The memory effect and the places `(y, x)` in millimetres.
    pub effect: Option<(&'a MemoryEffect, &'a [(f64, f64)])>,
    pub summary: &'a PsfSummary,
}

pub fn render(
    input: &PsfReportInput,
    patches: bool,
    has_experiment: bool,
    reproduce: Option<&str>,
) -> Result<Report> {
    let summary = input.summary;
    let psf = input.psf.image();
    let highest = psf.max();
    let relative = Image::from_fn(psf.rows(), psf.columns(), |y, x| psf.at(y, x) / highest);
    let sensor_rows: Vec<f64> = (0..input.reach.map.columns()).map(|r| r as f64).collect();
    let mut sections = vec![
        (
            "PSF",
            vec![
                psf_map(&relative),
                histogram(input.speckle),
                grain(input.speckle),
            ],
        ),
        ("Reach", vec![reach(input, &sensor_rows)]),
    ];
    if let Some((effect, positions)) = input.effect {
        sections.push((
            "Memory effect",
            vec![memory(effect), shifts(effect, positions)],
        ));
    }
    let mut files = vec![
        ("psf.npy", "the PSF, float32, sums to 1"),
        ("psf.json", "the numbers, for programs"),
    ];
    if patches {
        files.push((
            "psf-patches.toml",
            "the patch set: psf = under [calibration] takes it",
        ));
        files.push(("psf-patches.npy", "its PSFs, float32 [patch, y, x]"));
    }
    if has_experiment {
        files.push(("experiment.toml", "the experiment with this PSF"));
    }
    let files = files
        .into_iter()
        .map(|(n, w)| (n.into(), w.into()))
        .collect();
    Sheet {
        title: "Rowburst: PSF",
        summary: format!(
            "{} captures, {} × {} pixels of the working grid",
            summary.captures, summary.rows, summary.columns
        ),
        verdict: verdict(
            &summary.warnings,
            "contrast, grain and reach of the speckle suit a reconstruction",
        ),
        warnings: summary.warnings.clone(),
        notes: summary.remarks.clone(),
        headline: headline(summary),
        sections,
        tables: tables(summary, input.psf),
        files,
        reproduce,
    }
    .render()
}

fn pair(name: &str, value: impl Into<String>) -> (String, String) {
    (name.into(), value.into())
}

fn headline(summary: &PsfSummary) -> Vec<(String, String)> {
    let mut all = vec![
        pair("contrast", format!("{:.3}", summary.contrast)),
        pair("grain", format!("{:.2} px", summary.grain_px)),
        pair(
            "ballistic light",
            format!("{:.2} %", 100.0 * summary.ballistic_fraction),
        ),
        pair("reach at the far edge", short(summary.row_reach.worst)),
    ];
    if let Some(memory) = &summary.memory {
        all.push(pair(
            "shift",
            format!("{:.1} px/mm", memory.shift_px_per_mm),
        ));
        let range = memory.isoplanatic_range_mm;
        all.push(pair(
            "isoplanatic range",
            range.map_or("beyond the measured positions".into(), |r| {
                format!("{r:.3} mm")
            }),
        ));
    }
    all
}

fn tables(summary: &PsfSummary, psf: &Psf) -> Vec<(String, Vec<(String, String)>)> {
    let mut speckle = vec![
        pair(
            "grain along rows (y)",
            format!("{:.2} px", summary.grain_y_px),
        ),
        pair(
            "grain along columns (x)",
            format!("{:.2} px", summary.grain_x_px),
        ),
        pair(
            "distance to the negative exponential",
            format!("{:.3}", summary.exponential_distance),
        ),
        pair(
            "noise in the variance",
            format!("{:.1} %", 100.0 * summary.noise_part),
        ),
        pair(
            "illuminated fraction of the capture",
            format!("{:.1} %", 100.0 * summary.lit_fraction),
        ),
        pair(
            "saturated pixels",
            format!("{:.2} %", 100.0 * summary.saturated_fraction),
        ),
        pair("binning", summary.binning.to_string()),
    ];
    if let Some(floor) = summary.floor_counts {
        speckle.push(pair("black level", format!("{floor:.2} counts")));
    }
    if let Some(capture) = psf.capture() {
        let noise = (capture.noise_per_light / f64::from(psf.image().max())).sqrt();
        speckle.push(pair(
            "noise of the brightest pixel",
            format!("{:.2} %", 100.0 * noise),
        ));
        if capture.pinhole_px > 0.0 {
            let width = format!("{:.2} px wide, its blur is removed", capture.pinhole_px);
            speckle.push(pair("image of the pinhole", width));
        }
    }
    let reach = &summary.row_reach;
    let mut tables = vec![
        ("Speckle".to_string(), speckle),
        (
            "Reach".to_string(),
            vec![
                pair("sensor rows", reach.sensor_rows.to_string()),
                pair("field rows", reach.field_rows.to_string()),
                pair("light at the far edge over the mean", short(reach.worst)),
                pair("needed", short(reach.least)),
            ],
        ),
    ];
    if let Some(memory) = &summary.memory {
        tables.push((
            "Memory effect".to_string(),
            vec![
                pair(
                    "residual of the linear map",
                    format!("{:.2} px", memory.shift_residual_px),
                ),
                pair("captures in its fit", memory.fitted_captures.to_string()),
                pair(
                    "spacing of patches",
                    format!("{:.3} mm", memory.patch_spacing_mm),
                ),
                pair("patches written", memory.patches.to_string()),
                pair(
                    "patches needed (rows × columns)",
                    format!("{} × {}", memory.patches_needed.0, memory.patches_needed.1),
                ),
            ],
        ));
    }
    tables
}

fn psf_map(relative: &Image) -> Drawing<'_> {
    Drawing {
        name: "psf",
        plot: Plot::Map {
            image: relative,
            quantity: "of the highest",
            range: None,
        },
        caption: "The PSF, zero displacement in the middle. Good: fine grains over the whole picture, no bright spot.".into(),
        alt: "A speckle pattern".into(),
    }
}

fn histogram(speckle: &SpeckleStatistics) -> Drawing<'static> {
    let bins: Vec<(f64, f64)> = speckle
        .histogram
        .iter()
        .enumerate()
        .filter(|(_, density)| **density > 1e-5)
        .map(|(i, &density)| ((i as f64 + 0.5) * HISTOGRAM_BIN_WIDTH, density))
        .collect();
    let end = speckle.histogram.len() as f64 * HISTOGRAM_BIN_WIDTH;
    let expected = (0..=80).map(|i| f64::from(i) / 80.0 * end);
    let curves = vec![
        Curve {
            name: "captured".into(),
            points: bins,
            ink: Ink::Bars,
        },
        Curve {
            name: "negative exponential: a point source behind a strong diffuser".into(),
            points: expected.map(|x| (x, (-x).exp())).collect(),
            ink: Ink::Expected,
        },
    ];
    Drawing {
        name: "histogram",
        plot: Plot::Curves {
            x: ("intensity over its local mean", Scale::Linear(0.0, end)),
            y: ("density", Scale::Log(1e-4, 2.0)),
            curves,
        },
        caption: format!(
            "Intensities of the illuminated region. Good: bars along the line. A hump away from zero means low contrast, a wall at the right means saturation. Kolmogorov–Smirnov distance {:.3}.",
            speckle.exponential_distance
        ),
        alt: "Histogram of intensities against a falling exponential".into(),
    }
}

fn grain(speckle: &SpeckleStatistics) -> Drawing<'static> {
    let end = ((4.0 * speckle.grain_px).ceil() as usize).clamp(6, speckle.autocovariance_y.len());
    let curve = |name: &str, values: &[f64]| Curve {
        name: name.into(),
        points: values[..end.min(values.len())]
            .iter()
            .enumerate()
            .map(|(d, &v)| (d as f64, v))
            .collect(),
        ink: Ink::Line,
    };
    let last = end as f64 - 1.0;
    let curves = vec![
        curve("along y (rows)", &speckle.autocovariance_y),
        curve("along x (columns)", &speckle.autocovariance_x),
        Curve {
            name: "half".into(),
            points: vec![(0.0, 0.5), (last, 0.5)],
            ink: Ink::Expected,
        },
    ];
    Drawing {
        name: "grain",
        plot: Plot::Curves {
            x: ("displacement (px)", Scale::Linear(0.0, last)),
            y: ("autocovariance", Scale::Linear(-0.2, 1.05)),
            curves,
        },
        caption: format!(
            "Autocovariance of the speckle: its width at half is the grain, {:.2} px. Good: both alike, 2 to 4 px on the working grid, and nothing but ripples beyond.",
            speckle.grain_px
        ),
        alt: "Two curves that fall from one to about zero".into(),
    }
}

fn reach<'a>(input: &'a PsfReportInput, sensor_rows: &'a [f64]) -> Drawing<'a> {
    let summary = &input.summary.row_reach;
    Drawing {
        name: "reach",
        plot: Plot::Grid {
            image: &input.reach.map,
            quantity: (
                "light over mean",
                0.0,
                input.reach.map.max().clamp(1.5, 4.0),
            ),
            x: ("sensor row", sensor_rows),
            y: ("source at sensor row", &input.reach.source_rows),
        },
        caption: format!(
            "Light of each part of the field on each sensor row, relative to its mean over the rows. Good: no black corner. Light of the bottom must reach the top row and the other way round: there it is {}{}, {} are needed.",
            short(summary.worst),
            if summary.extrapolated {
                " (continued beyond the capture by a Gaussian)"
            } else {
                ""
            },
            short(summary.least)
        ),
        alt: "A map that is brightest along the diagonal".into(),
    }
}

fn memory(effect: &MemoryEffect) -> Drawing<'static> {
    let end = effect.correlation.last().map_or(1.0, |c| c.0);
    let level = |value: f64| Curve {
        name: String::new(),
        points: vec![(0.0, value), (end, value)],
        ink: Ink::Expected,
    };
    let range = effect
        .range_mm
        .map_or("not reached".into(), |r| format!("{r:.3} mm"));
    Drawing {
        name: "memory-effect",
        plot: Plot::Curves {
            x: ("distance of the source (mm)", Scale::Linear(0.0, end)),
            y: ("correlation", Scale::Linear(-0.1, 1.05)),
            curves: vec![
                level(0.5),
                level(0.7),
                Curve {
                    name: "correlation with the middle, registered".into(),
                    points: effect.correlation.clone(),
                    ink: Ink::Dots,
                },
            ],
        },
        caption: format!(
            "How far the source may move while its speckle only shifts. The isoplanatic range, where the correlation is 0.5: {range}. Patches lie {:.3} mm apart, where it is 0.7.",
            effect.spacing_mm
        ),
        alt: "Dots that fall from one with the distance".into(),
    }
}

fn shifts(effect: &MemoryEffect, positions: &[(f64, f64)]) -> Drawing<'static> {
    let reference = positions[effect.reference];
    let errors = |fitted: bool, along_x: bool| -> Vec<(f64, f64)> {
        (0..positions.len())
            .filter(|&i| effect.fitted[i] == fitted)
            .map(|i| {
                let d = (positions[i].0 - reference.0, positions[i].1 - reference.1);
                let (y, x) = effect.predicted_px(d);
                let error = if along_x {
                    effect.shifts_px[i].1 - x
                } else {
                    effect.shifts_px[i].0 - y
                };
                (d.0.hypot(d.1), error)
            })
            .collect()
    };
    let curve = |name: &str, points| Curve {
        name: name.into(),
        points,
        ink: Ink::Dots,
    };
    let mut curves = vec![
        curve("x, in the fit", errors(true, true)),
        curve("y, in the fit", errors(true, false)),
    ];
    if effect.fitted.iter().any(|f| !f) {
        curves.push(curve("x, beyond the range", errors(false, true)));
        curves.push(curve("y, beyond the range", errors(false, false)));
    }
    Drawing {
        name: "shift-errors",
        plot: Plot::Curves {
            x: ("distance of the source (mm)", Scale::Auto),
            y: ("measured less linear shift (px)", Scale::Auto),
            curves,
        },
        caption: format!(
            "Shift of each capture less that of the linear map, {:.2} px/mm. Good: dots of the fit within a pixel and without a trend; beyond the range the peak is chance within a grain.",
            effect.shift_px_per_mm
        ),
        alt: "Dots about zero".into(),
    }
}
