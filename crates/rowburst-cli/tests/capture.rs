//! `rowburst capture`, `new` and `status`, over recordings that are played back.

mod common;

use common::{COLUMNS, Lab, ROWS, pattern};
use serde_json::Value;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

/// A folder with `experiment.toml`, `psf.npy` and a frame `raw.png` of 16-bit counts.
fn lab() -> Lab {
    let lab = Lab::new();
    lab.image("raw.png", ROWS, COLUMNS, |y, x| {
        (1000.0 + 500.0 * pattern(y, x)).round()
    });
    lab
}

fn record_of(lab: &Lab, name: &str) -> Value {
    serde_json::from_slice(&lab.read(name)).unwrap()
}

fn errors(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A recording `many.npy` of `count` frames of 100×100 counts.
fn many(lab: &Lab, count: usize) {
    lab.video("many.npy", [count, 100, 100], |i| (i % 5000) as f32);
}

#[test]
fn a_captured_frame_reconstructs_to_the_same_bits() {
    let lab = lab();
    lab.done("reconstruct experiment.toml --frame raw.png -o file");
    lab.done("capture frame --source play:raw.png -o captured/frame.tif");
    lab.done("reconstruct experiment.toml --frame captured/frame.tif -o capture");
    assert!(lab.read("file/video.npy") == lab.read("capture/video.npy"));
    // The settings of the experiment beside the recording are in the record and in the file that is written.
    let record = record_of(&lab, "captured/frame.json");
    assert_eq!(
        (&record["written"], &record["dropped"]),
        (&1.into(), &0.into())
    );
    let text = String::from_utf8(lab.read("captured/experiment.toml")).unwrap();
    assert!(
        text.contains("row_time_us = 9.6  # read: row_time_us = 9.6"),
        "{text}"
    );
    lab.done(
        "reconstruct captured/experiment.toml --frame captured/frame.tif --psf psf.npy -o written",
    );
    assert!(lab.read("file/video.npy") == lab.read("written/video.npy"));
}

#[test]
fn frames_that_are_lost_are_named() {
    let lab = lab();
    many(&lab, 6);
    lab.done("capture record --source play:many.npy -o a.tif");
    let mut record = record_of(&lab, "a.json");
    for (page, number) in [(3, 9), (4, 10), (5, 11)] {
        record["frames"][page]["number"] = number.into();
    }
    record["frames"][5]["incomplete"] = "2 of 80 packets are missing".into();
    lab.write("a.json", record.to_string());
    let output = lab.run("capture record --source play:a.tif -o b.tif");
    assert!(output.status.success(), "{}", errors(&output));
    let told = errors(&output);
    assert!(told.contains("lost: frames 3 to 8: dropped"), "{told}");
    assert!(
        told.contains("incomplete: frame 11, page 5: 2 of 80"),
        "{told}"
    );
    let record = record_of(&lab, "b.json");
    assert_eq!(
        (&record["dropped"], &record["incomplete"]),
        (&6.into(), &1.into())
    );
    // A mean is taken of whole frames alone.
    lab.done("capture darks -n 9 --source play:a.tif -o darks.tif");
    assert_eq!(record_of(&lab, "darks.json")["written"], 5);
}

#[cfg(unix)]
#[test]
fn ctrl_c_keeps_what_was_recorded() {
    let lab = lab();
    many(&lab, 3);
    let mut child = lab
        .command("capture record --source play:many.npy?rate=50&loop -o live.tif")
        .stderr(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    std::thread::sleep(Duration::from_millis(700));
    let id = child.id().to_string();
    Command::new("kill").args(["-INT", &id]).status().unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130));
    let record = record_of(&lab, "live.json");
    let written = record["written"].as_u64().unwrap() as usize;
    assert!(written >= 5 && record["ended"] == "interrupted", "{record}");
    let pages = rowburst_io::read_stack(&lab.path("live.tif")).unwrap();
    assert_eq!(pages.len(), written);
    let hidden: Vec<_> = lab
        .files("")
        .into_iter()
        .filter(|n| n.starts_with('.'))
        .collect();
    assert!(hidden.is_empty(), "{hidden:?}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_loses_no_written_frame() {
    let lab = lab();
    many(&lab, 40);
    for (count, name) in [("-n 40", "classic"), ("", "big")] {
        // Files may have 400 KiB: 40 frames of 20 kB do not fit.
        let script = format!(
            "trap '' XFSZ; ulimit -f 800; exec \"$0\" capture record {count} --source play:many.npy -o {name}.tif"
        );
        let output = Command::new("sh")
            .args(["-c", &script])
            .arg(common::program())
            .current_dir(lab.path(""))
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1), "{}", errors(&output));
        assert!(
            errors(&output).contains("Free space"),
            "{}",
            errors(&output)
        );
        let written = record_of(&lab, &format!("{name}.json"))["written"]
            .as_u64()
            .unwrap();
        let pages = rowburst_io::read_stack(&lab.path(&format!("{name}.tif"))).unwrap();
        assert_eq!((pages.len() as u64, written), (20, 20));
        assert_eq!(pages[19].at(0, 7), (190_007 % 5000) as f32);
    }
}

#[test]
fn settings_that_spoil_frames_are_refused_with_the_remedy() {
    let lab = lab();
    lab.done("capture frame --source play:raw.png -o a.tif");
    let mut record = record_of(&lab, "a.json");
    let properties = record["settings"]["properties"].as_array_mut().unwrap();
    properties.push(
        serde_json::json!({ "name": "SensorShutterMode", "value": "Global", "origin": "read" }),
    );
    lab.write("a.json", record.to_string());
    let output = lab.run("capture frame --source play:a.tif -o b.tif");
    assert_eq!(output.status.code(), Some(2));
    assert!(
        errors(&output).contains("Set the camera's rolling shutter"),
        "{}",
        errors(&output)
    );
    assert!(!lab.path("b.tif").exists());
    // Nothing is replaced, unless it is asked for.
    let output = lab.run("capture frame --source play:raw.png -o a.tif");
    assert_eq!(output.status.code(), Some(2));
    assert!(errors(&output).contains("--replace"), "{}", errors(&output));
    lab.done("capture frame --source play:raw.png -o a.tif --replace");
    assert!(lab.path("a.old.tif").exists() && lab.path("a.old.json").exists());
}

#[test]
fn saturated_pixels_and_unknown_row_times_are_warned_of() {
    let lab = Lab::empty();
    lab.image(
        "bright.png",
        20,
        20,
        |y, _| if y < 4 { 65_535.0 } else { 10.0 },
    );
    let output = lab.run("capture frame --source play:bright.png -o a.tif");
    let told = errors(&output);
    assert!(output.status.success(), "{told}");
    assert!(
        told.contains("20.00 % of a frame's pixels are saturated"),
        "{told}"
    );
    assert!(told.contains("the row time is not known"), "{told}");
    let text = String::from_utf8(lab.read("experiment.toml")).unwrap();
    assert!(
        text.contains("# row_time_us =  # unknown: measure it"),
        "{text}"
    );
    let printed = lab.done("capture settings --source play:a.tif");
    assert!(printed.contains("row_time_us = ?  (unknown)"), "{printed}");
    let output = lab.run("capture settings --source camera:1");
    assert!(errors(&output).contains("play:PATH"), "{}", errors(&output));
}

#[test]
fn a_folder_leads_through_the_experiment() {
    let lab = lab();
    lab.done("new bench --source play:../raw.png");
    let run = |arguments: &str| {
        let mut command = lab.command(arguments);
        let output = command.current_dir(lab.path("bench")).output().unwrap();
        assert!(output.status.success(), "{arguments}: {}", errors(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    let next = || serde_json::from_str::<Value>(&run("status --json")).unwrap()["next"].clone();
    assert_eq!(next(), "rowburst capture frame");
    run("capture frame");
    assert_eq!(next(), "rowburst capture darks -n 50");
    many(&lab, 4);
    lab.image("dark.png", ROWS, COLUMNS, |y, x| {
        (100.0 + 5.0 * pattern(y, x)).round()
    });
    run("capture darks -n 4 --source play:../dark.png?rate=max&loop");
    let status = run("status");
    assert!(
        status.contains("darks             done         4 frames"),
        "{status}"
    );
    assert!(
        status.contains("next: rowburst capture flats -n 20"),
        "{status}"
    );
    // A frame of another region than the darks.
    lab.image("larger.png", ROWS + 2, COLUMNS, |y, x| {
        (1000.0 + 500.0 * pattern(y, x)).round()
    });
    run("capture frame --replace --source play:../larger.png");
    let status = run("status");
    assert!(status.contains("darks             out-of-date"), "{status}");
    assert!(status.contains("size 12×10, not 14×10"), "{status}");
    // The experiment is that of the first frame.
    assert!(status.contains("experiment        out-of-date"), "{status}");
    assert!(status.contains("check             optional"), "{status}");
}

/// `rowburst live` while it runs, asked as its page asks.
#[cfg(all(unix, feature = "view"))]
struct LiveView {
    child: std::process::Child,
    address: String,
    token: String,
}

#[cfg(all(unix, feature = "view"))]
impl LiveView {
    fn start(lab: &Lab, arguments: &str) -> Self {
        use std::io::{BufRead, BufReader};
        let mut child = lab
            .command(&format!("live {arguments} --port 0 --no-open -o kept"))
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let url = lines
            .find_map(|line| Some(line.ok()?.split_once("http://")?.1.trim().to_string()))
            .expect("the address is printed");
        let (address, token) = url.split_once("/?").unwrap();
        Self {
            child,
            address: address.into(),
            token: token.into(),
        }
    }

    /// The body of the answer.
    fn ask(&self, method: &str, path: &str) -> String {
        use std::io::{Read, Write};
        let mut stream = std::net::TcpStream::connect(&self.address).unwrap();
        write!(
            stream,
            "{method} /api/monitor{path}?{} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n",
            self.token, self.address
        )
        .unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        assert!(head.starts_with("HTTP/1.1 2"), "{path}: {head}");
        body.into()
    }

    /// Waits until the state of the page is as wanted.
    fn until(&self, is_reached: impl Fn(&Value) -> bool) -> Value {
        let mut state = Value::Null;
        for _ in 0..600 {
            state = serde_json::from_str(&self.ask("GET", "")).unwrap();
            if is_reached(&state) {
                return state;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("{state}");
    }

    fn stop(mut self) -> Option<i32> {
        let id = self.child.id().to_string();
        Command::new("kill").args(["-INT", &id]).status().unwrap();
        self.child.wait().unwrap().code()
    }
}

#[cfg(all(unix, feature = "view"))]
fn told(state: &Value, words: &str) -> bool {
    state["message"].as_str().is_some_and(|m| m.contains(words))
}

#[cfg(all(unix, feature = "view"))]
#[test]
fn a_recording_ends_with_its_source_and_says_why() {
    let lab = lab();
    many(&lab, 40);
    let live = LiveView::start(&lab, "--source play:many.npy?rate=20");
    live.until(|state| state["frames"].as_u64() > Some(3));
    assert_eq!(live.until(|_| true)["controls"], serde_json::json!([]));
    live.ask("POST", "/request/record");
    live.until(|state| state["recording"].as_u64() > Some(2));
    live.ask("POST", "/set/Gain/2");
    live.until(|state| told(state, "no such control"));
    let state = live.until(|state| state["ended"].is_string());
    assert!(
        told(&state, "kept") && state["recording"].is_null(),
        "{state}"
    );
    let record = record_of(&lab, "kept/recording.json");
    assert_eq!(record["ended"], "end of the source");
    // A recording that the user stops is complete.
    assert_eq!(live.stop(), Some(130));
    let live = LiveView::start(&lab, "--source play:many.npy?rate=50&loop");
    live.ask("POST", "/request/record");
    live.until(|state| state["recording"].as_u64() > Some(1));
    live.ask("POST", "/request/stop");
    live.until(|state| state["recording"].is_null());
    live.ask("POST", "/request/record");
    live.until(|state| state["recording"].as_u64() > Some(1));
    assert_eq!(live.stop(), Some(130));
    let ended = |name: &str| record_of(&lab, name)["ended"].clone();
    assert_eq!(ended("kept/recording-2.json"), "complete");
    assert_eq!(ended("kept/recording-3.json"), "interrupted");
}

#[cfg(all(unix, feature = "view"))]
#[test]
fn ctrl_c_ends_the_full_reconstruction_of_a_live_view() {
    let lab = Lab::empty();
    // Large enough that it takes much longer than the test waits.
    lab.experiment(
        "[camera]\nrows = 128\ncolumns = 128\nshutter = \"top-down\"\nrow_time_us = 10\nexposure_us = 10\n[calibration]\npsf = \"psf.npy\"\n",
    );
    lab.image("psf.npy", 127, 127, |y, x| pattern(y + 50, x).powi(3));
    lab.image("raw.png", 128, 128, |y, x| {
        (1000.0 + 500.0 * pattern(y, x)).round()
    });
    let live = LiveView::start(
        &lab,
        "experiment.toml --time-budget-s 0.05 --source play:raw.png",
    );
    live.until(|state| state["ended"].is_string());
    live.ask("POST", "/request/save");
    live.until(|state| told(state, "reconstructing it in full"));
    let began = std::time::Instant::now();
    assert_eq!(live.stop(), Some(130));
    assert!(
        began.elapsed() < Duration::from_secs(20),
        "{:?}",
        began.elapsed()
    );
}

#[cfg(all(unix, feature = "view"))]
#[test]
fn a_live_view_warns_where_the_camera_is_set_as_the_experiment_is_not() {
    let lab = Lab::empty();
    lab.experiment(
        "[camera]\nrows = 32\ncolumns = 32\nshutter = \"top-down\"\nrow_time_us = 10\nexposure_us = 10\n[calibration]\npsf = \"psf.npy\"\n",
    );
    lab.image("psf.npy", 15, 15, |y, x| pattern(y + 50, x).powi(3));
    lab.image("raw.png", 32, 32, |y, x| {
        (1000.0 + 500.0 * pattern(y, x)).round()
    });
    lab.done("capture frame --source play:raw.png -o other.tif");
    let mut record = record_of(&lab, "other.json");
    record["settings"]["properties"] = serde_json::json!([
        { "name": "row_time_us", "value": "12", "origin": "read" },
        { "name": "exposure_us", "value": "10", "origin": "read" },
    ]);
    lab.write("other.json", record.to_string());
    let live = LiveView::start(
        &lab,
        "experiment.toml --time-budget-s 0.05 --source play:other.tif",
    );
    let state = live.until(|state| state["warnings"].is_array());
    let warnings = state["warnings"].to_string();
    assert!(
        warnings.contains("row_time_us is 10 in")
            && warnings.contains("12 in the metadata (the settings of play:other.tif)"),
        "{warnings}"
    );
    assert!(!warnings.contains("exposure_us"), "{warnings}");
    assert_eq!(live.stop(), Some(130));
}

/// A camera of 64×64 pixels in `experiment.toml`, and one point that blinks at 12.5 kHz in `led.npy`.
fn blinking(lab: &Lab) {
    lab.experiment(
        "[camera]\nrows = 64\ncolumns = 64\nshutter = \"dual-inside-out\"\nrow_time_us = 10\nexposure_us = 10\npixel_pitch_um = 6.5\n",
    );
    // Eight bins a period: 80 µs.
    lab.video("led.npy", [32, 64, 64], |i| {
        let (t, y, x) = (i / 4096, i / 64 % 64, i % 64);
        let is_on = (30..33).contains(&y) && (40..43).contains(&x);
        if is_on {
            1.0 + (t as f32 * std::f32::consts::TAU / 8.0).sin()
        } else {
            0.0
        }
    });
    lab.done("simulate experiment.toml --scene led.npy --snr 200 -o sim");
}

fn failed_checks(output: &Output) -> Vec<String> {
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    let checks = found["checks"].as_array().unwrap();
    let failed = checks.iter().filter(|check| check["passed"] == false);
    failed
        .map(|check| check["name"].as_str().unwrap().to_string())
        .collect()
}

#[test]
fn a_set_up_is_checked_by_a_light_of_known_frequency() {
    let lab = Lab::empty();
    blinking(&lab);
    let check = |experiment: &str| {
        lab.run(&format!(
            "check {experiment} --frame sim/frame.npy --frequency-hz 12500 --json -o check"
        ))
    };
    let good = check("sim/experiment.toml");
    assert!(
        good.status.success(),
        "{}{}",
        errors(&good),
        String::from_utf8_lossy(&good.stdout)
    );
    assert!(failed_checks(&good).is_empty());
    // Every finding has a number and a limit.
    let found: Value = serde_json::from_slice(&good.stdout).unwrap();
    for check in found["checks"].as_array().unwrap() {
        assert!(
            check["value"].is_number() && check["limit"].is_number(),
            "{check}"
        );
    }
    assert_eq!(record_of(&lab, "check/check.json"), found);
    let text = String::from_utf8(lab.read("sim/experiment.toml")).unwrap();
    let slow = text.replace("_us = 10.0", "_us = 10.5");
    assert_ne!(slow, text);
    lab.write("sim/slow.toml", slow);
    let found = check("sim/slow.toml");
    assert_eq!(found.status.code(), Some(1));
    assert_eq!(
        failed_checks(&found),
        ["row-time"],
        "{}",
        String::from_utf8_lossy(&found.stdout)
    );
    // Another order of rows shuffles the light in time; the reverse of the right one does not.
    let with_shutter = |shutter: &str| {
        lab.write("sim/other.toml", text.replace("dual-inside-out", shutter));
        failed_checks(&check("sim/other.toml"))
    };
    assert!(with_shutter("top-down").contains(&"shutter".to_string()));
    assert!(with_shutter("dual-outside-in").is_empty());
    // A PSF of another diffuser explains nothing.
    lab.done("simulate experiment.toml --scene led.npy --seed 2 -o other");
    let found = lab.run(
        "check sim/experiment.toml --frame sim/frame.npy --psf other/psf.npy --frequency-hz 12500 --json",
    );
    assert!(failed_checks(&found).contains(&"model".to_string()));
}
