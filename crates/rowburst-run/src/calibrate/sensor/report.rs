//! The page of a calibrated sensor.

use crate::calibrate::verdict;
use crate::short;
use rowburst::calibrate::sensor::SensorCalibration;
use rowburst::{Image, Result};
use rowburst_report::{Curve, Drawing, Ink, Plot, Report, Scale, Sheet};

/// The page and its pictures.
pub(super) fn render(
    calibration: &SensorCalibration,
    has_experiment: bool,
    reproduce: Option<&str>,
) -> Result<Report> {
    let spot = spot_px(calibration);
    let faults = fault_map(calibration, spot);
    let usable = UsablePixels::new(calibration);
    let sections = vec![
        ("Noise", noise_drawings(calibration, &usable)),
        ("Maps", map_drawings(calibration, &usable, &faults, spot)),
    ];
    Sheet {
        title: "Rowburst: sensor",
        summary: format!(
            "{}×{} pixels, from {} darks and {} flats at {} levels of light.",
            calibration.dark.rows(),
            calibration.dark.columns(),
            calibration.dark_drift.len(),
            calibration
                .levels
                .iter()
                .map(|l| l.frames.len())
                .sum::<usize>(),
            calibration.levels.len()
        ),
        verdict: verdict(
            &calibration.warnings,
            "darks and flats agree, and nothing was found against these numbers",
        ),
        warnings: calibration.warnings.clone(),
        notes: Vec::new(),
        headline: headline(calibration),
        sections,
        tables: tables(calibration),
        files: files(has_experiment),
        reproduce,
    }
    .render()
}

/// Values of the pixels that are not bad.
struct UsablePixels {
    dark: Vec<f64>,
    read_noise: Vec<f64>,
    response: Vec<f64>,
}

impl UsablePixels {
    fn new(calibration: &SensorCalibration) -> Self {
        let values = |image: &Image| -> Vec<f64> {
            let pixels = image.data().iter().enumerate();
            let good = pixels.filter(|(i, _)| !calibration.faults.is_bad(*i));
            good.map(|(_, &p)| f64::from(p)).collect()
        };
        Self {
            dark: values(&calibration.dark),
            read_noise: values(&calibration.read_noise),
            response: values(&calibration.response),
        }
    }
}

/// A drawing with its caption and its alternative text.
fn drawing<'a>(name: &'a str, plot: Plot<'a>, caption: &str, alt: &str) -> Drawing<'a> {
    Drawing {
        name,
        plot,
        caption: caption.into(),
        alt: alt.into(),
    }
}

/// A map whose range is the middle 99 % of `values`.
fn map<'a>(image: &'a Image, quantity: &'a str, values: &[f64]) -> Plot<'a> {
    Plot::Map {
        image,
        quantity,
        range: Some(middle(values)),
    }
}

/// Photon transfer, histograms of the dark and read noise, and the row means.
fn noise_drawings(calibration: &SensorCalibration, usable: &UsablePixels) -> Vec<Drawing<'static>> {
    // Means of whole counts over n frames are multiples of 1/n.
    let step = calibration
        .has_integer_counts
        .then(|| 1.0 / calibration.dark_drift.len() as f64);
    vec![
        drawing(
            "photon-transfer",
            photon_transfer(calibration),
            "Variance of a pixel, from differences of two flats of one level, over the light: each ring is a level and a range of the field's brightness. The slope of the line is 1/gain; rings on it mean shot noise only. Excluded ones are saturated, or above 70 % of saturation.",
            "Rings of variance against light, and the fitted line.",
        ),
        drawing(
            "read-noise-histogram",
            histogram(&usable.read_noise, "read noise (electrons)", None),
            "Read noise of the usable pixels: a hump with a short tail. With few darks the hump is wider.",
            "Histogram of the read noise of the pixels.",
        ),
        drawing(
            "dark-histogram",
            histogram(&usable.dark, "dark level (counts)", step),
            "Dark level of the usable pixels, mean over all darks.",
            "Histogram of the dark level of the pixels.",
        ),
        drawing(
            "row-means",
            rows(calibration),
            "Mean of each row of the first dark above the mean dark. The dashed lines are twice the standard deviation expected from pixel noise: rows far outside have row noise (banding).",
            "Row means of one dark frame over the rows.",
        ),
    ]
}

/// Maps of the dark, the response, the read noise and the bad pixels.
fn map_drawings<'a>(
    calibration: &'a SensorCalibration,
    usable: &UsablePixels,
    faults: &'a Image,
    spot: usize,
) -> Vec<Drawing<'a>> {
    vec![
        drawing(
            "dark-map",
            map(&calibration.dark, "dark (counts)", &usable.dark),
            "Mean dark. Subtracting it removes columns, corners and glow. Black and white are the middle 99 %.",
            "Map of the dark level.",
        ),
        drawing(
            "response-map",
            map(&calibration.response, "response", &usable.response),
            "Response to the flats' light, mean 1. Uneven light shows here as well and would be mistaken for the sensor's response.",
            "Map of the response.",
        ),
        drawing(
            "read-noise-map",
            map(
                &calibration.read_noise,
                "read noise (electrons)",
                &usable.read_noise,
            ),
            "Read noise of each pixel: even grain is best.",
            "Map of the read noise.",
        ),
        drawing(
            "bad-pixels-map",
            Plot::Map {
                image: faults,
                quantity: "bad pixels in a spot",
                range: Some((0.0, faults.max().max(1.0))),
            },
            &format!(
                "{} pixels that get no weight, counted in spots of {spot}×{spot}. Isolated pixels at random positions are normal for a sensor; whole rows, columns or corners point to a fault of the frames.",
                calibration.faults.count()
            ),
            "Map of the bad pixels.",
        ),
    ]
}

fn pair(name: &str, value: String) -> (String, String) {
    (name.into(), value)
}

fn headline(calibration: &SensorCalibration) -> Vec<(String, String)> {
    let gain = short(calibration.gain_electrons_per_count);
    let full = calibration.full_well.map_or("not reached".into(), |full| {
        format!("{} counts", short(full.counts))
    });
    vec![
        pair("gain", format!("{gain} electrons per count")),
        pair(
            "read noise",
            format!("{} electrons", short(calibration.read_noise_electrons)),
        ),
        pair("bias", format!("{} counts", short(calibration.bias_counts))),
        pair("full well", full),
        pair("bad pixels", calibration.faults.count().to_string()),
    ]
}

fn tables(calibration: &SensorCalibration) -> Vec<(String, Vec<(String, String)>)> {
    let gain = calibration.gain_electrons_per_count;
    let electrons = |counts: f64| {
        format!(
            "{} counts, {} electrons",
            short(counts),
            short(counts * gain)
        )
    };
    let percent = |part: f64| format!("{:.2} %", 100.0 * part);
    let count = |flags: &[bool]| flags.iter().filter(|f| **f).count().to_string();
    let banding = &calibration.banding;
    let numbers = vec![
        pair("gain, standard error", percent(calibration.gain_error)),
        pair(
            "read noise, median",
            format!("{} electrons", short(calibration.read_noise_electrons)),
        ),
        pair(
            "read noise, rms",
            format!("{} electrons", short(calibration.read_noise_rms_electrons)),
        ),
        pair(
            "response, pixel to pixel",
            percent(calibration.non_uniformity),
        ),
        pair(
            "error of a pixel of the flat",
            percent(calibration.flat_error),
        ),
        pair(
            "banding: noise common to a row",
            electrons(banding.row_counts),
        ),
        pair(
            "row noise expected from pixel noise",
            electrons(banding.expected_counts),
        ),
        pair(
            "banding is significant",
            if banding.is_real { "yes" } else { "no" }.into(),
        ),
        pair(
            "fixed pattern of rows (in the dark)",
            electrons(banding.fixed_counts),
        ),
    ];
    let faults = vec![
        pair("hot: high dark level", count(&calibration.faults.hot)),
        pair(
            "dead: response far from its neighbours'",
            count(&calibration.faults.dead),
        ),
        pair(
            "unstable: noise out of proportion",
            count(&calibration.faults.unstable),
        ),
    ];
    let levels = calibration.levels.iter().map(|level| {
        pair(
            &format!("{} counts of light", short(level.light)),
            format!(
                "{} flats, {} clipped",
                level.frames.len(),
                percent(level.clipped)
            ),
        )
    });
    let remarks = calibration.remarks().into_iter().filter_map(|remark| {
        let (name, text) = remark.split_once(": ")?;
        Some(pair(name, text.into()))
    });
    vec![
        ("Numbers".into(), numbers),
        ("Bad pixels".into(), faults),
        ("Levels of the flats".into(), levels.collect()),
        ("Basis of these numbers".into(), remarks.collect()),
    ]
}

fn photon_transfer(calibration: &SensorCalibration) -> Plot<'static> {
    let points = |used: bool| -> Vec<(f64, f64)> {
        let matching = calibration.transfer.iter().filter(|p| p.used == used);
        matching.map(|p| (p.light, p.variance)).collect()
    };
    let (used, left) = (points(true), points(false));
    let all = || used.iter().chain(&left);
    let far = all().map(|p| p.0).fold(0.0, f64::max);
    let high = all().map(|p| p.1).fold(calibration.line.at(far), f64::max);
    let line = (0..=100).map(|i| far * f64::from(i) / 100.0);
    let mut curves = vec![Curve {
        name: format!(
            "fit: {} electrons per count",
            short(calibration.gain_electrons_per_count)
        ),
        points: line
            .map(|light| (light, calibration.line.at(light)))
            .collect(),
        ink: Ink::Line,
    }];
    curves.push(Curve {
        name: "used".into(),
        points: used.clone(),
        ink: Ink::Dots,
    });
    if !left.is_empty() {
        curves.push(Curve {
            name: "excluded".into(),
            points: left.clone(),
            ink: Ink::Dots,
        });
    }
    Plot::Curves {
        x: ("light (counts above dark)", Scale::Linear(0.0, 1.04 * far)),
        y: ("variance (counts²)", Scale::Linear(0.0, 1.06 * high)),
        curves,
    }
}

/// Ends of the middle 99 % of `values`.
fn middle(values: &[f64]) -> (f32, f32) {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = |part: f64| sorted[((sorted.len() - 1) as f64 * part).round() as usize] as f32;
    let (low, high) = (at(0.005), at(0.995));
    if high > low {
        (low, high)
    } else {
        (low - 0.5, high + 0.5)
    }
}

/// A histogram, each bar of which holds as many multiples of `step` as any other.
fn histogram(values: &[f64], quantity: &'static str, step: Option<f64>) -> Plot<'static> {
    const BARS: usize = 48;
    let (low, high) = middle(values);
    let (low, high) = (f64::from(low), f64::from(high));
    // A margin, so that the tails are seen.
    let (low, high) = (low - 0.15 * (high - low), high + 0.15 * (high - low));
    let mut width = (high - low) / BARS as f64;
    let (mut low, mut high) = (low, high);
    if let Some(step) = step {
        width = (width / step).ceil() * step;
        low = ((low / step).floor() - 0.5) * step;
        high = low + BARS as f64 * width;
    }
    let mut counts = [0.0; BARS];
    for value in values {
        let at = ((value - low) / width).floor();
        if (0.0..BARS as f64).contains(&at) {
            counts[at as usize] += 1.0;
        }
    }
    let most = counts.iter().copied().fold(1.0, f64::max);
    let points = counts.iter().enumerate();
    Plot::Curves {
        x: (quantity, Scale::Linear(low, high)),
        y: ("pixels", Scale::Linear(0.0, 1.05 * most)),
        curves: vec![Curve {
            name: String::new(),
            points: points
                .map(|(i, &n)| (low + (i as f64 + 0.5) * width, n))
                .collect(),
            ink: Ink::Bars,
        }],
    }
}

fn rows(calibration: &SensorCalibration) -> Plot<'static> {
    let banding = &calibration.banding;
    let last = banding.first.len().max(2) as f64 - 1.0;
    let level = |name: &str, value: f64| Curve {
        name: name.into(),
        points: vec![(0.0, value), (last, value)],
        ink: Ink::Expected,
    };
    let bound = 2.0 * banding.expected_counts;
    let most = banding
        .first
        .iter()
        .fold(1.5 * bound, |m, v| m.max(v.abs()));
    let points = banding.first.iter().enumerate();
    Plot::Curves {
        x: ("row", Scale::Linear(0.0, last)),
        y: (
            "mean above dark (counts)",
            Scale::Linear(-1.1 * most, 1.1 * most),
        ),
        curves: vec![
            Curve {
                name: "first dark".into(),
                points: points.map(|(y, &v)| (y as f64, v)).collect(),
                ink: Ink::Line,
            },
            level("pixel noise alone: 19 of 20 rows between these", bound),
            level("", -bound),
        ],
    }
}

/// Longest side of the picture of bad pixels: single ones must stay visible.
const MAX_MAP_SIDE: usize = 130;

/// Side of a spot of that picture, in pixels.
fn spot_px(calibration: &SensorCalibration) -> usize {
    calibration
        .dark
        .rows()
        .max(calibration.dark.columns())
        .div_ceil(MAX_MAP_SIDE)
}

/// Bad pixels counted in spots of `spot` × `spot`.
fn fault_map(calibration: &SensorCalibration, spot: usize) -> Image {
    let (rows, columns) = (calibration.dark.rows(), calibration.dark.columns());
    let mut map = Image::zeros(rows.div_ceil(spot), columns.div_ceil(spot));
    let wide = map.columns();
    for i in (0..rows * columns).filter(|&i| calibration.faults.is_bad(i)) {
        map.data_mut()[(i / columns / spot) * wide + i % columns / spot] += 1.0;
    }
    map
}

fn files(has_experiment: bool) -> Vec<(String, String)> {
    let mut files = vec![
        pair("dark.npy", "mean dark, counts".into()),
        pair("flat.npy", "flat frame, counts, dark level included".into()),
        pair("response.npy", "response to light, mean 1".into()),
        pair(
            "read_noise.npy",
            "read noise of each pixel, electrons".into(),
        ),
        pair("bad_pixels.png", "255 where a pixel is bad".into()),
        pair("sensor.toml", "keys for an experiment file".into()),
    ];
    if has_experiment {
        files.push(pair(
            "experiment.toml",
            "your experiment with these keys".into(),
        ));
    }
    files.push(pair("sensor.json", "the numbers, for programs".into()));
    files
}
