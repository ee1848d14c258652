//! Tests of the experiment file.

use super::*;
use crate::metadata::Metadata;
use proptest::prelude::*;

const CAMERA: &str = "[camera]\nrows = 4\ncolumns = 6\nshutter = \"top-down\"\nrow_time_us = 9.6\nexposure_us = 10\n";

fn parse(text: &str) -> Result<Experiment> {
    Experiment::parse(Path::new("lab/run.toml"), text, &Metadata::default())
}

#[test]
fn paths_and_defaults_are_resolved() {
    let text = format!(
        "{CAMERA}[calibration]\npsf = \"psf.tif\"\ndark = \"/d/dark.tif\"\n[reconstruction]\ntau = \"auto\"\nprior = \"tv\"\n"
    );
    let experiment = parse(&text).unwrap();
    assert_eq!(experiment.calibration.psf, Some("lab/psf.tif".into()));
    assert_eq!(experiment.calibration.dark, Some("/d/dark.tif".into()));
    assert_eq!(experiment.calibration.flat, None);
    assert_eq!(experiment.reconstruction.tau, Some(Tau::Auto));
    assert_eq!(experiment.reconstruction.prior.as_deref(), Some("tv"));
    let camera = experiment.camera().unwrap();
    assert_eq!((camera.rows(), camera.sensor().binning), (4, 1));
    assert_eq!(camera.params().exposure_us, 10.0);
}

#[test]
fn a_global_shutter_needs_no_row_time() {
    let text = "[camera]\nrows = 2\ncolumns = 2\nshutter = \"global\"\nexposure_us = 50\n";
    assert_eq!(parse(text).unwrap().params.row_time_us, 50.0);
}

#[test]
fn mistakes_name_the_place_and_the_remedy() {
    let camera = |from: &str, to: &str| CAMERA.replace(from, to);
    let cases: [(String, &[&str]); 19] = [
        (
            camera("row_time_us", "rowtime_us"),
            &[
                "line 5",
                "`rowtime_us` in [camera]",
                "Did you mean `row_time_us`?",
            ],
        ),
        (
            format!("{CAMERA}[calibraton]\npsf = \"a\""),
            &["line 7", "`calibraton` in the file", "`calibration`"],
        ),
        (
            format!("{CAMERA}[calibration]\npfs = \"a\""),
            &["line 8", "[calibration]", "`psf`"],
        ),
        (format!("{CAMERA}[field]\nrow = 4"), &["[field]", "`rows`"]),
        (
            format!("{CAMERA}[field]\nrows = 4"),
            &["[field]", "no `columns`"],
        ),
        (
            camera("rows = 4\n", ""),
            &["[camera]", "no `rows`", "required"],
        ),
        (camera("row_time_us = 9.6\n", ""), &["no `row_time_us`"]),
        (camera("exposure_us = 10\n", ""), &["no `exposure_us`"]),
        (String::new(), &["[camera]", "no `rows`"]),
        (
            camera("4", "4.5"),
            &["line 2", "[camera] rows", "float 4.5", "whole number"],
        ),
        (camera("4", "-4"), &["integer -4", "whole number"]),
        (
            camera("9.6", "\"9.6\""),
            &["row_time_us", "string \"9.6\"", "a number"],
        ),
        (
            camera("top-down", "top-dwon"),
            &["line 4", "\"top-dwon\"", "Did you mean \"top-down\"?"],
        ),
        (camera("top-down", "custom"), &["no `row_order`"]),
        (
            format!("{CAMERA}row_order = \"o.npy\""),
            &["line 7", "row_order", "\"custom\" alone"],
        ),
        (
            format!("{CAMERA}[reconstruction]\ntau = -1"),
            &["line 8", "tau", "-1", "above zero"],
        ),
        (
            format!("{CAMERA}[reconstruction]\ntau = \"none\""),
            &["\"none\"", "tau = \"auto\""],
        ),
        (
            "camera = 3".into(),
            &["integer 3", "a table, written [camera]"],
        ),
        (camera("= 4", "4"), &["lab/run.toml: line 2", "valid TOML"]),
    ];
    for (text, parts) in cases {
        let error = parse(&text).unwrap_err();
        assert!(error.is_input());
        let message = error.to_string();
        for part in ["lab/run.toml"].iter().chain(parts) {
            assert!(message.contains(part), "{message} lacks {part}");
        }
    }
    let zero = parse(&CAMERA.replace("9.6", "0")).unwrap();
    let message = zero.camera().unwrap_err().to_string();
    assert!(
        message.starts_with("lab/run.toml: row_time_us"),
        "{message}"
    );
    let bits = parse(&format!("{CAMERA}bit_depth = 5000000000")).unwrap();
    assert!(bits.camera().unwrap_err().to_string().contains("bit_depth"));
}

#[test]
fn a_custom_order_is_read_and_written() {
    let folder = tempfile::tempdir().unwrap();
    let order = |name: &str, values: &[i64]| {
        let mut file = std::fs::File::create(folder.path().join(name)).unwrap();
        npy::write_npy_i64(&mut file, &[values.len()], values).unwrap();
    };
    let path = folder.path().join("run.toml");
    let text = CAMERA.replace("top-down", "custom") + "row_order = \"order.npy\"\n";
    std::fs::write(&path, &text).unwrap();
    let message = Experiment::read(&path).unwrap_err().to_string();
    assert!(
        message.contains("order.npy: found no such file"),
        "{message}"
    );
    order("order.npy", &[0, -1, 1, 2]);
    let message = Experiment::read(&path).unwrap_err().to_string();
    assert!(message.contains("the instant -1"), "{message}");
    order("order.npy", &[2, 0, 1, 0]);
    let experiment = Experiment::read(&path).unwrap();
    assert_eq!(experiment.camera().unwrap().instants(), [2, 0, 1, 0]);
    std::fs::write(&path, experiment.to_toml(folder.path())).unwrap();
    assert_eq!(Experiment::read(&path).unwrap(), experiment);
    assert!(
        std::fs::read_to_string(&path)
            .unwrap()
            .contains("row_order = \"order.npy\"")
    );
    let listed = Experiment {
        row_order: None,
        ..experiment
    };
    let text = listed.to_toml(folder.path());
    assert!(text.contains("row_order = [2, 0, 1, 0]"), "{text}");
    std::fs::write(&path, &text).unwrap();
    assert_eq!(Experiment::read(&path).unwrap(), listed);
    for bad in ["[0, -1, 1, 2]", "[0, 1.5]", "3", "[\"a\"]"] {
        std::fs::write(&path, text.replace("[2, 0, 1, 0]", bad)).unwrap();
        let message = Experiment::read(&path).unwrap_err().to_string();
        assert!(message.contains("a list of whole numbers"), "{message}");
    }
}

#[test]
fn files_that_are_no_experiment_say_so() {
    let folder = tempfile::tempdir().unwrap();
    let message = Experiment::read(folder.path()).unwrap_err().to_string();
    assert!(message.contains("a folder"), "{message}");
    let path = folder.path().join("frame.npy");
    assert!(
        Experiment::read(&path)
            .unwrap_err()
            .to_string()
            .contains("no such file")
    );
    std::fs::write(&path, b"\x93NUMPY").unwrap();
    assert!(
        Experiment::read(&path)
            .unwrap_err()
            .to_string()
            .contains("not UTF-8")
    );
}

#[test]
fn the_shared_experiments_are_read() {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared");
    for kind in ["oracle", "problems"] {
        let Ok(cases) = std::fs::read_dir(shared.join(kind)) else {
            eprintln!("skipped: no {}", shared.join(kind).display());
            continue;
        };
        for case in cases {
            let path = case.unwrap().path().join("experiment.toml");
            let camera = Experiment::read(&path).unwrap().camera().unwrap();
            let frame = crate::read_image(&path.with_file_name("frame.npy"))
                .unwrap()
                .image;
            assert_eq!(
                (camera.rows(), camera.columns()),
                (frame.rows(), frame.columns())
            );
        }
    }
}

fn positive() -> impl Strategy<Value = f64> {
    prop_oneof![1e-9..1e9f64, Just(1.0), Just(1e-300), Just(1e300)]
}

#[test]
fn magnification_and_trigger_delay_are_checked() {
    let with = |line: &str| parse(&CAMERA.replace("[camera]\n", &format!("[camera]\n{line}\n")));
    let sensor = |line: &str| with(line).unwrap().camera().unwrap().sensor().clone();
    assert_eq!(sensor("magnification = 0.5").magnification, Some(0.5));
    assert_eq!(sensor("trigger_delay_us = 0").trigger_delay_us, Some(0.0));
    for (line, key) in [
        ("magnification = 0", "magnification"),
        ("magnification = -2.0", "magnification"),
        ("trigger_delay_us = -1", "trigger_delay_us"),
    ] {
        let read = with(line).and_then(|experiment| experiment.camera());
        let message = read.unwrap_err().to_string();
        assert!(
            message.contains("run.toml") && message.contains(key),
            "{message}"
        );
    }
}

/// Names of files; on Windows `\` separates them.
const NAME: &str = if cfg!(windows) {
    "[a-zé ']{1,8}"
} else {
    "[a-zé \"\\\\']{1,8}"
};

proptest! {
    #[test]
    fn what_is_written_is_read(
        size in (1usize..5000, 1usize..5000),
        times in (positive(), positive()),
        shutter in 0usize..5,
        sensor in (1usize..9, 1usize..9, prop::option::of(1u32..33)),
        values in prop::collection::vec(prop::option::of(positive()), 7),
        field in prop::option::of((1usize..9999, 1usize..9999)),
        files in prop::collection::vec(prop::option::of(NAME), 5),
        tau in prop_oneof![Just(None), Just(Some(Tau::Auto)), Just(Some(Tau::HeldOut)), positive().prop_map(|t| Some(Tau::Given(t)))],
    ) {
        let shutters = [
            Shutter::TopDown, Shutter::BottomUp, Shutter::DualInsideOut,
            Shutter::DualOutsideIn, Shutter::Global,
        ];
        let file = |i: usize| files[i].as_ref().map(|name| Path::new("lab").join(name));
        let mut experiment = Experiment::new(CameraParams {
            rows: size.0,
            columns: size.1,
            shutter: shutters[shutter].clone(),
            row_time_us: times.0,
            exposure_us: times.1,
            bins_per_row: sensor.1,
            field,
            sensor: Sensor {
                binning: sensor.0,
                bit_depth: sensor.2,
                pixel_pitch_um: values[0],
                bias_counts: values[1],
                gain_electrons_per_count: values[2],
                read_noise_electrons: values[3],
                full_well_counts: values[4],
                magnification: values[5],
                trigger_delay_us: values[6],
            },
        });
        experiment.path = "lab/run.toml".into();
        experiment.calibration = Calibration {
            psf: file(0), dark: file(1), flat: file(2), bad_pixels: file(3),
        };
        experiment.reconstruction = Reconstruction { prior: files[4].clone(), tau };
        let text = experiment.to_toml(Path::new("lab"));
        prop_assert_eq!(parse(&text).unwrap(), experiment, "{}", text);
    }

    #[test]
    fn any_text_is_an_experiment_or_an_error(text in "[a-z\\[\\]=\"\n0-9 ._{}#]{0,60}") {
        let _ = parse(&text);
        let _ = parse(&format!("{CAMERA}{text}"));
    }
}

/// An experiment with what `metadata` adds.
fn parse_with(text: &str, metadata: &Metadata) -> rowburst::Result<Experiment> {
    Experiment::parse(Path::new("lab/run.toml"), text, metadata)
}

fn metadata() -> Metadata {
    Metadata {
        sources: vec!["metadata.txt".into()],
        size: Some((108, 120)),
        shutter: Some(Shutter::DualInsideOut),
        row_time_us: Some(9.6),
        exposure_us: Some(19.2),
        binning: Some(1),
        bit_depth: Some(12),
        pixel_pitch_um: Some(6.5),
        ..Metadata::default()
    }
}

#[test]
fn what_the_file_leaves_open_comes_from_metadata() {
    let experiment = parse_with("[camera]\n", &metadata()).unwrap();
    let camera = experiment.camera().unwrap();
    assert_eq!((camera.rows(), camera.columns()), (108, 120));
    assert_eq!(camera.shutter(), &Shutter::DualInsideOut);
    assert_eq!(camera.params().exposure_us, 19.2);
    assert_eq!(camera.params().row_time_us, 9.6);
    assert_eq!(camera.sensor().bit_depth, Some(12));
    let from_metadata = experiment.from_metadata;
    assert!(
        from_metadata.warnings.is_empty(),
        "{:?}",
        from_metadata.warnings
    );
    let summary = from_metadata.summary_line().unwrap();
    for words in ["rows = 108", "exposure_us = 19.2", "from metadata.txt"] {
        assert!(summary.contains(words), "{summary}");
    }
    // Without metadata the keys are asked for as before.
    let error = parse_with("[camera]\n", &Metadata::default()).unwrap_err();
    assert!(error.to_string().contains("no `rows`"), "{error}");
}

#[test]
fn the_file_counts_and_contradictions_are_told() {
    let text = "[camera]\nrows = 108\ncolumns = 120\nshutter = \"top-down\"\nrow_time_us = 9.65\nexposure_us = 9.6\nbit_depth = 16\npixel_pitch_um = 11.0\n";
    let experiment = parse_with(text, &metadata()).unwrap();
    assert_eq!(experiment.params.exposure_us, 9.6);
    let warnings = experiment.from_metadata.warnings.join("\n");
    for words in [
        "exposure_us is 9.6 in lab/run.toml and 19.2 in the metadata (metadata.txt): the experiment file takes precedence",
        "bit_depth is 16",
        "shutter is \"top-down\"",
    ] {
        assert!(warnings.contains(words), "{warnings}");
    }
    // 9.65 is within a percent of 9.6; pitches at object and sensor are not compared.
    assert_eq!(experiment.from_metadata.warnings.len(), 3, "{warnings}");

    let error = parse_with(&text.replace("120", "130"), &metadata()).unwrap_err();
    let message = error.to_string();
    assert!(
        message.contains("[camera] columns: found 130") && message.contains("has 120 columns"),
        "{message}"
    );
}

#[test]
fn binning_by_the_program_and_by_the_camera_are_told_apart() {
    let timing = "row_time_us = 9.6\nexposure_us = 9.6\nshutter = \"top-down\"\n";
    let read = |keys: &str, binning| {
        let found = Metadata {
            binning,
            ..metadata()
        };
        let experiment = parse_with(&format!("[camera]\n{keys}{timing}"), &found).unwrap();
        let (params, from_metadata) = (experiment.params, experiment.from_metadata);
        let sensor = params.sensor;
        let warnings = from_metadata
            .warnings
            .iter()
            .filter(|w| w.starts_with("binning"));
        (
            params.rows,
            params.columns,
            sensor.binning,
            sensor.pixel_pitch_um,
            warnings.count(),
        )
    };
    // The camera has binned.
    assert_eq!(read("", Some(2)), (108, 120, 2, Some(6.5), 0));
    // The program is to bin.
    assert_eq!(read("binning = 2\n", Some(1)), (54, 60, 2, Some(13.0), 0));
    assert_eq!(read("binning = 2\n", None), (54, 60, 2, Some(13.0), 0));
    let given = "rows = 54\ncolumns = 60\nbinning = 2\n";
    assert_eq!(read(given, Some(1)), (54, 60, 2, Some(13.0), 0));
    assert_eq!(read("binning = 3\n", Some(2)), (108, 120, 3, Some(6.5), 1));
}
