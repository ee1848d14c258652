//! `rowburst calibrate sensor`, run as a user runs it, and what `reconstruct` makes of it.

mod common;

use common::{Lab, pattern};
use rowburst::noise::Noise;
use rowburst::{Image, Sensor};
use rowburst_io::read_image;
use serde_json::Value;

/// A simulated sensor: an offset pattern, PRNU of 1 %, dead and hot pixels.
struct Simulated {
    sensor: Sensor,
    rows: usize,
    columns: usize,
}

const GAIN: f64 = 5.0;
const READ: f64 = 8.0;
const END: f32 = 4095.0;

impl Simulated {
    fn new(rows: usize, columns: usize) -> Self {
        let sensor = Sensor {
            bit_depth: Some(12),
            bias_counts: Some(100.0),
            gain_electrons_per_count: Some(GAIN),
            read_noise_electrons: Some(READ),
            ..Sensor::default()
        };
        Self {
            sensor,
            rows,
            columns,
        }
    }

    /// About 1 in 100.
    fn is_dead(y: usize, x: usize) -> bool {
        pattern(y + 900, x) < 0.01
    }

    /// About 1 in 200.
    fn is_hot(y: usize, x: usize) -> bool {
        pattern(y + 1900, x) < 0.005
    }

    fn response(y: usize, x: usize) -> f32 {
        // A sum of uniform numbers with a standard deviation of 0.01.
        let sum: f32 = (0..3).map(|i| pattern(y + 300 * i, x + 7)).sum();
        if Self::is_dead(y, x) {
            0.0
        } else {
            1.0 + 0.02 * (sum - 1.5)
        }
    }

    fn offset(y: usize, x: usize) -> f32 {
        let hot = if Self::is_hot(y, x) { 300.0 } else { 0.0 };
        hot + (10.0 * pattern(y + 500, x)).round()
    }

    /// A frame of even light of `electrons`.
    fn frame(&self, electrons: f64, seed: u64) -> Image {
        let light = Image::from_fn(self.rows, self.columns, Self::response);
        // Next to no light stands for none, which the noise model refuses.
        let peak_electrons = electrons.max(1e-9);
        let noise = Noise::Camera { peak_electrons };
        let mut image = noise.apply(&light, &self.sensor, seed).unwrap().frame;
        self.add_pattern(&mut image);
        image
    }

    fn add_pattern(&self, image: &mut Image) {
        for y in 0..self.rows {
            for x in 0..self.columns {
                let p = &mut image.data_mut()[y * self.columns + x];
                *p = (*p + Self::offset(y, x)).min(END);
            }
        }
    }

    fn frames(&self, electrons: f64, count: u64) -> Vec<Image> {
        let seed = electrons as u64 * 1000;
        (0..count)
            .map(|i| self.frame(electrons, seed + i))
            .collect()
    }
}

/// An uncompressed multi-page TIFF of 16-bit counts, as cameras write it.
fn tiff16(pages: &[Image]) -> Vec<u8> {
    let mut file = b"II*\0".to_vec();
    let mut link = file.len();
    file.extend([0; 4]);
    for page in pages {
        let strip = file.len() as u32;
        let counts = page.data().iter().flat_map(|&p| (p as u16).to_le_bytes());
        file.extend(counts);
        let start = (file.len() as u32).to_le_bytes();
        file[link..link + 4].copy_from_slice(&start);
        let (rows, columns) = (page.rows() as u32, page.columns() as u32);
        let bytes = rows * columns * 2;
        let tags = [
            (256, columns),
            (257, rows),
            (258, 16),
            (259, 1),
            (262, 1),
            (273, strip),
            (277, 1),
            (278, rows),
            (279, bytes),
        ];
        file.extend((tags.len() as u16).to_le_bytes());
        for (tag, value) in tags {
            file.extend(u16::to_le_bytes(tag));
            file.extend(4u16.to_le_bytes());
            file.extend(1u32.to_le_bytes());
            file.extend(u32::to_le_bytes(value));
        }
        link = file.len();
        file.extend([0; 4]);
    }
    file
}

fn save(lab: &Lab, name: &str, image: &Image) {
    lab.image(name, image.rows(), image.columns(), |y, x| image.at(y, x));
}

fn stack(lab: &Lab, name: &str, pages: &[Image]) {
    let (rows, columns) = (pages[0].rows(), pages[0].columns());
    let pixels = rows * columns;
    lab.video(name, [pages.len(), rows, columns], |i| {
        pages[i / pixels].data()[i % pixels]
    });
}

/// Darks as a 16-bit TIFF stack, flats as a folder of 16-bit PNG and a .npy stack.
fn captures(lab: &Lab, simulated: &Simulated) {
    lab.write("darks.tif", tiff16(&simulated.frames(0.0, 20)));
    std::fs::create_dir(lab.path("flats")).unwrap();
    for (i, flat) in simulated.frames(8000.0, 16).iter().enumerate() {
        save(lab, &format!("flats/flat{i:02}.png"), flat);
    }
    lab.write("flats/notes.txt", "half of the range");
    let mut flats = simulated.frames(3000.0, 8);
    flats.extend(simulated.frames(30_000.0, 2));
    stack(lab, "flats.npy", &flats);
}

const SENSOR: &str = "calibrate sensor --darks darks.tif --flats flats flats.npy -o sensor";

fn number(json: &Value, key: &str) -> f64 {
    json[key]
        .as_f64()
        .unwrap_or_else(|| panic!("{key} in {json:#}"))
}

#[test]
fn files_of_all_kinds_give_keys_and_maps() {
    let lab = Lab::empty();
    let (rows, columns) = (48, 64);
    captures(&lab, &Simulated::new(rows, columns));
    let json: Value = serde_json::from_str(&lab.done(&format!("{SENSOR} --json"))).unwrap();
    let near = |key: &str, expected: f64, part: f64| {
        let found = number(&json, key);
        assert!((found / expected - 1.0).abs() < part, "{key}: {found}");
    };
    near("gain_electrons_per_count", GAIN, 0.03);
    near("read_noise_electrons", READ, 0.05);
    near("bias_counts", 105.0, 0.01);
    near("full_well_counts", f64::from(END), 1e-9);
    let planted = |of: fn(usize, usize) -> bool| {
        let pixels = (0..rows * columns).map(|i| (i / columns, i % columns));
        pixels.filter(|&(y, x)| of(y, x)).count() as f64
    };
    near("dead_pixels", planted(Simulated::is_dead), 0.01);
    near("hot_pixels", planted(Simulated::is_hot), 0.01);
    near("response_non_uniformity", 0.01, 0.2);
    assert_eq!(json["banding_is_real"], false);
    let bad = number(&json, "bad_pixels");
    let expected = planted(|y, x| Simulated::is_dead(y, x) || Simulated::is_hot(y, x));
    assert!(
        (expected..=expected + 3.0).contains(&bad),
        "{bad} of {expected}"
    );

    let written: Value = serde_json::from_slice(&lab.read("sensor/sensor.json")).unwrap();
    assert_eq!(written, json);
    let mask = read_image(&lab.path("sensor/bad_pixels.png"))
        .unwrap()
        .image;
    assert_eq!(
        mask.data().iter().filter(|m| **m != 0.0).count() as f64,
        bad
    );
    assert_eq!((mask.rows(), mask.columns()), (rows, columns));
    let keys = String::from_utf8(lab.read("sensor/sensor.toml")).unwrap();
    assert!(keys.contains("full_well_counts = 4095.0") && keys.contains("flat = \"flat.npy\""));
    assert_eq!(
        lab.files("sensor"),
        [
            "bad-pixels-map.png",
            "bad_pixels.png",
            "dark-histogram.png",
            "dark-map.png",
            "dark.npy",
            "flat.npy",
            "photon-transfer.png",
            "read-noise-histogram.png",
            "read-noise-map.png",
            "read_noise.npy",
            "report.html",
            "response-map.png",
            "response.npy",
            "row-means.png",
            "sensor.json",
            "sensor.toml",
        ]
    );
    let page = String::from_utf8(lab.read("sensor/report.html")).unwrap();
    assert!(page.contains("electrons per count") && page.contains("rowburst calibrate sensor"));
    // The same input gives the same files.
    let before = lab.read("sensor/flat.npy");
    let summary = lab.done(SENSOR);
    assert!(
        summary.contains("gain ") && summary.contains("full well 4095"),
        "{summary}"
    );
    assert_eq!(lab.read("sensor/flat.npy"), before);
}

/// One frame through simulation, a sensor with faults, calibration and reconstruction.
#[test]
fn a_calibrated_frame_loses_less_than_half_a_decibel() {
    let lab = Lab::empty();
    let side = 54;
    let simulated = Simulated::new(side, side);
    let camera = format!(
        "[camera]\nrows = {side}\ncolumns = {side}\nshutter = \"dual-inside-out\"\n\
         row_time_us = 9.6\nexposure_us = 9.6\nbit_depth = 12\n"
    );
    let known = format!(
        "{camera}bias_counts = 100.0\ngain_electrons_per_count = {GAIN:?}\nread_noise_electrons = {READ:?}\n"
    );
    lab.experiment(&known);
    lab.done("simulate experiment.toml --scene digits --peak-electrons 16000 -o sim");
    lab.experiment(&format!(
        "{camera}bias_counts = 100.0\n[calibration]\npsf = \"sim/psf.npy\"\n"
    ));
    captures(&lab, &simulated);
    lab.done(&format!("{SENSOR} --experiment experiment.toml"));
    let text = String::from_utf8(lab.read("sensor/experiment.toml")).unwrap();
    for key in [
        "dark = \"dark.npy\"",
        "bad_pixels = \"bad_pixels.png\"",
        "full_well_counts",
    ] {
        assert!(text.contains(key), "{key} in {text}");
    }

    let clean = read_image(&lab.path("sim/frame.npy")).unwrap().image;
    let mut frame = Image::from_fn(side, side, |y, x| {
        let light = (clean.at(y, x) - 100.0) * Simulated::response(y, x);
        let full = pattern(y + 2900, x) < 0.005;
        if full { END } else { 100.0 + light.round() }
    });
    simulated.add_pattern(&mut frame);
    save(&lab, "frame.npy", &frame);

    let solve = |experiment: &str, frame: &str, out: &str| {
        lab.done(&format!(
            "reconstruct {experiment} --frame {frame} --truth sim/truth.npy -o {out}"
        ));
        lab.number(out, "psnr_db")
    };
    let ideal = solve("sim/experiment.toml", "sim/frame.npy", "ideal");
    let calibrated = solve("sensor/experiment.toml", "frame.npy", "calibrated");
    let left_out =
        lab.number("calibrated", "bad_pixels") + lab.number("calibrated", "saturated_pixels");
    println!("{ideal:.2} dB ideal, {calibrated:.2} dB calibrated, {left_out} pixels left out");
    assert!(
        calibrated > ideal - 0.5,
        "{calibrated} dB instead of {ideal}"
    );
    assert!(left_out >= 0.015 * (side * side) as f64);
    let raw = solve("experiment.toml", "frame.npy --keep-all-pixels", "raw");
    println!("{raw:.2} dB without calibration");
    assert!(
        raw < ideal - 3.0,
        "{raw} dB without calibration, {ideal} ideal"
    );
}

/// Puts captures into the folder.
type Prepare = fn(&Lab, &Simulated);

struct Case {
    name: &'static str,
    prepare: Prepare,
    arguments: &'static str,
    says: [&'static str; 3],
}

const PLAIN: &str = "calibrate sensor --darks d.npy --flats f.npy -o out";

/// Good darks and flats, of which a case changes one.
fn good(lab: &Lab, simulated: &Simulated) {
    stack(lab, "d.npy", &simulated.frames(0.0, 4));
    stack(lab, "f.npy", &simulated.frames(8000.0, 4));
}

fn changed(pages: Vec<Image>, change: impl Fn(usize, &mut Image)) -> Vec<Image> {
    let mut pages = pages;
    pages
        .iter_mut()
        .enumerate()
        .for_each(|(i, page)| change(i, page));
    pages
}

fn scale(image: &mut Image, factor: f32) {
    let pixels = image.data_mut().iter_mut();
    pixels.for_each(|p| *p = (100.0 + (*p - 100.0) * factor).round());
}

#[test]
#[expect(clippy::too_many_lines, reason = "one table of bad inputs")]
fn bad_input_says_what_to_do() {
    let cases = [
        Case {
            name: "one dark",
            prepare: |lab, s| stack(lab, "d.npy", &s.frames(0.0, 1)),
            arguments: PLAIN,
            says: ["--darks", "found 1 frame;", "Record 20"],
        },
        Case {
            name: "one flat",
            prepare: |lab, s| stack(lab, "f.npy", &s.frames(8000.0, 1)),
            arguments: PLAIN,
            says: ["--flats", "found 1 frame;", "Record 20"],
        },
        Case {
            name: "flats of another size",
            prepare: |lab, _| stack(lab, "f.npy", &Simulated::new(20, 24).frames(8000.0, 4)),
            arguments: PLAIN,
            says: ["f.npy page 1", "20×24", "region of interest"],
        },
        Case {
            name: "a folder of mixed sizes",
            prepare: |lab, s| {
                std::fs::create_dir(lab.path("mixed")).unwrap();
                save(lab, "mixed/a.png", &s.frame(0.0, 1));
                save(lab, "mixed/b.png", &Simulated::new(8, 9).frame(0.0, 2));
            },
            arguments: "calibrate sensor --darks mixed --flats f.npy -o out",
            says: ["b.png", "8×9", "a.png: 20×30"],
        },
        Case {
            name: "an empty folder",
            prepare: |lab, _| std::fs::create_dir(lab.path("none")).unwrap(),
            arguments: "calibrate sensor --darks none --flats f.npy -o out",
            says: ["none", "a folder without images", "--darks takes"],
        },
        Case {
            name: "darks and flats swapped",
            prepare: |_, _| {},
            arguments: "calibrate sensor --darks f.npy --flats d.npy -o out",
            says: ["--flats", "the darks are brighter", "not swapped"],
        },
        Case {
            name: "all flats saturated",
            prepare: |lab, s| stack(lab, "f.npy", &s.frames(90_000.0, 4)),
            arguments: PLAIN,
            says: ["--flats", "saturated", "half of the range"],
        },
        Case {
            name: "flats without light",
            prepare: |lab, s| stack(lab, "f.npy", &s.frames(2.0, 4)),
            arguments: PLAIN,
            says: ["--flats", "exceeds the noise", "Check the lamp"],
        },
        Case {
            name: "each flat of its own light",
            prepare: |lab, s| {
                let flats = changed(s.frames(2000.0, 4), |i, f| scale(f, 1.0 + i as f32));
                stack(lab, "f.npy", &flats);
            },
            arguments: PLAIN,
            says: ["--flats", "no two of equal light", "at least two flats"],
        },
        Case {
            name: "the same frame twice",
            prepare: |lab, s| {
                let frame = s.frame(8000.0, 7);
                stack(lab, "f.npy", &[frame.clone(), frame]);
            },
            arguments: PLAIN,
            says: ["f.npy page 2", "the same frame as f.npy page 1", "copies"],
        },
        Case {
            name: "NaN in a dark",
            prepare: |lab, s| {
                let darks = changed(s.frames(0.0, 4), |i, d| {
                    if i == 2 {
                        d.data_mut()[33] = f32::NAN;
                    }
                });
                stack(lab, "d.npy", &darks);
            },
            arguments: PLAIN,
            says: [
                "d.npy page 3",
                "NaN at row 1, column 3",
                "Leave this frame out",
            ],
        },
        Case {
            name: "a flat in colour",
            prepare: |lab, _| lab.write("c.bmp", bmp()),
            arguments: "calibrate sensor --darks d.npy --flats c.bmp f.npy -o out",
            says: ["c.bmp", "in colour", "Convert it to grey"],
        },
        Case {
            name: "an experiment of another size",
            prepare: |lab, _| lab.experiment(common::CAMERA),
            arguments: "calibrate sensor --darks d.npy --flats f.npy --experiment experiment.toml -o out",
            says: [
                "20×30",
                "12×10 raw pixels",
                "correct rows, columns and binning",
            ],
        },
        Case {
            name: "an experiment that would be written over",
            prepare: |lab, _| {
                lab.experiment(&common::CAMERA.replace("12", "20").replace("10", "30"));
            },
            arguments: "calibrate sensor --darks d.npy --flats f.npy --experiment experiment.toml -o .",
            says: ["--experiment", "another folder", "-o"],
        },
        Case {
            name: "no such frame",
            prepare: |_, _| {},
            arguments: "calibrate sensor --darks nowhere.tif --flats f.npy -o out",
            says: ["nowhere.tif", "no such file", "Check the path"],
        },
    ];
    let simulated = Simulated::new(20, 30);
    for case in cases {
        let lab = Lab::empty();
        good(&lab, &simulated);
        (case.prepare)(&lab, &simulated);
        let output = lab.run(case.arguments);
        let text = String::from_utf8_lossy(&output.stderr);
        println!("{}\n    {}", case.name, text.trim_end());
        assert_eq!(output.status.code(), Some(2), "{}: {text}", case.name);
        for part in case.says {
            assert!(
                text.contains(part),
                "{}: no \"{part}\" in {text}",
                case.name
            );
        }
        assert!(output.stdout.is_empty() && !text.contains("panicked"));
        assert!(lab.files("out").is_empty(), "{}", case.name);
    }
}

/// Two pixels, red and green.
fn bmp() -> Vec<u8> {
    let mut bytes = b"BM".to_vec();
    for field in [54 + 8, 0, 54, 40, 2, 1, 24 << 16 | 1, 0, 8, 0, 0, 0, 0] {
        bytes.extend(u32::to_le_bytes(field));
    }
    bytes.extend([0, 0, 200, 0, 200, 0, 0, 0]);
    bytes
}

#[test]
fn poor_captures_are_warned_of() {
    let cases: [(&str, Prepare, &str); 4] = [
        ("few darks", |_, _| {}, "record 10 or more"),
        (
            "a lamp that flickers",
            |lab, s| {
                let flats = changed(s.frames(8000.0, 6), |i, f| {
                    scale(f, 1.0 + 0.04 * (i % 2) as f32);
                });
                stack(lab, "f.npy", &flats);
            },
            "differ in light by 4.0 %",
        ),
        (
            "uneven light",
            |lab, s| {
                let flats = changed(s.frames(8000.0, 6), |_, f| {
                    let columns = f.columns();
                    let pixels = f.data_mut().iter_mut().enumerate();
                    pixels.for_each(|(i, p)| {
                        let part = 0.5 + 0.5 * (i % columns) as f32 / columns as f32;
                        *p = (105.0 + (*p - 105.0) * part).round();
                    });
                });
                stack(lab, "f.npy", &flats);
            },
            "take off the lens",
        ),
        (
            "darks cut off at zero",
            |lab, s| {
                let cut = |_, f: &mut Image| {
                    f.data_mut()
                        .iter_mut()
                        .for_each(|p| *p = (*p - 104.0).max(0.0));
                };
                stack(lab, "d.npy", &changed(s.frames(0.0, 12), cut));
                stack(lab, "f.npy", &changed(s.frames(8000.0, 6), cut));
            },
            "raise the camera's black level",
        ),
    ];
    let simulated = Simulated::new(40, 60);
    for (name, prepare, words) in cases {
        let lab = Lab::empty();
        good(&lab, &simulated);
        prepare(&lab, &simulated);
        let output = lab.run(&format!("{PLAIN} --json"));
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{name}: {text}");
        assert!(text.contains(words), "{name}: {text}");
        let json: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert!(json["warnings"].to_string().contains(words), "{name}");
    }
}
