//! `rowburst batch`: recordings, resumed jobs, and what can go wrong.

#![cfg(feature = "batch")]

mod common;

use common::{COLUMNS, Lab, ROWS, pattern, program};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Options that make a frame a matter of milliseconds.
const QUICK: [&str; 4] = ["--prior", "tv+0.5*tdiff", "--max-iterations", "40"];

/// Frame `number` of the recording.
fn frame(lab: &Lab, name: &str, number: usize) {
    lab.image(name, ROWS, COLUMNS, |y, x| {
        100.0 + 50.0 * pattern(y + 31 * number, x)
    });
}

/// An experiment with `count` frames in the folder `rec`.
fn lab_of(count: usize) -> Lab {
    let lab = Lab::new();
    std::fs::create_dir(lab.path("rec")).unwrap();
    (0..count).for_each(|i| frame(&lab, &format!("rec/f{i}.npy"), i));
    lab
}

fn command(lab: &Lab, out: &str, more: &[&str]) -> Command {
    let mut command = Command::new(program());
    command.args(["batch", "experiment.toml", "--frames", "rec", "-o", out]);
    command.args(more).current_dir(lab.path(""));
    command.stdin(Stdio::null());
    command
}

fn output(mut command: Command) -> (i32, String, String) {
    let Output {
        status,
        stdout,
        stderr,
    } = command.output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (status.code().unwrap_or(-1), text(stdout), text(stderr))
}

/// Runs a batch that ends with the exit status `code`, and returns its summary.
fn ended(lab: &Lab, out: &str, more: &[&str], code: i32) -> Value {
    let mut command = command(lab, out, more);
    command.arg("--json");
    let (found, stdout, stderr) = output(command);
    assert_eq!(found, code, "{stderr}");
    serde_json::from_str(&stdout).unwrap()
}

/// Runs a batch all of whose frames have videos, and returns its summary.
fn done(lab: &Lab, out: &str, more: &[&str]) -> Value {
    ended(lab, out, more, 0)
}

/// Runs a batch of which some frames fail, and returns its summary.
fn done_in_part(lab: &Lab, out: &str, more: &[&str]) -> Value {
    ended(lab, out, more, 1)
}

fn quick(more: &[&'static str]) -> Vec<&'static str> {
    [&QUICK[..], more].concat()
}

/// A preview: one frame after another by the standard prior, and its archive is not gone on with by a job
/// that has no budget.
#[test]
fn a_preview_warm_starts_each_frame() {
    let lab = lab_of(4);
    let summary = done(&lab, "preview.zarr", &["--time-budget-s", "0.2"]);
    assert_eq!(
        (&summary["done"], &summary["frames_at_once"]),
        (&4.into(), &1.into())
    );
    assert_eq!(summary["prior"], "tv+0.5*tdiff+support");
    let refused = [
        (&["--time-budget-s", "-1"][..], "budget"),
        (
            &["--time-budget-s", "0.2", "--at-once", "2"],
            "concurrent-frames",
        ),
        (&["--prior", "tv+0.5*tdiff+support"], "time budget"),
    ];
    for (more, word) in refused {
        let (code, _, stderr) = output(command(&lab, "preview.zarr", more));
        assert_eq!(code, 2, "{stderr}");
        assert!(stderr.contains(word), "{stderr}");
    }
}

/// All files below `folder` with their content; without locks, and without the seconds that
/// frames took.
fn content(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            if path.extension().is_some_and(|e| e == "lock") || path.ends_with("lock") {
                continue;
            }
            let mut bytes = std::fs::read(&path).unwrap();
            if path.extension().is_some_and(|e| e == "csv") {
                bytes = without_seconds(std::str::from_utf8(&bytes).unwrap()).into();
            } else if path.parent().unwrap().ends_with("rowburst/frames") {
                let mut row: Value = serde_json::from_slice(&bytes).unwrap();
                row["seconds"] = Value::Null;
                bytes = row.to_string().into();
            }
            files.insert(path.strip_prefix(folder).unwrap().to_path_buf(), bytes);
        }
    }
    files
}

fn lines(csv: &str) -> Vec<Vec<String>> {
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .from_reader(csv.as_bytes());
    let line = |line: csv::StringRecord| line.iter().map(str::to_string).collect();
    reader.records().map(|l| line(l.unwrap())).collect()
}

fn without_seconds(csv: &str) -> String {
    let lines = lines(csv);
    let at = lines[0].iter().position(|name| name == "seconds").unwrap();
    let mut text = String::new();
    for mut line in lines {
        line.remove(at);
        text += &(line.join(",") + "\n");
    }
    text
}

/// A column of the table.
fn column(lab: &Lab, out: &str, name: &str) -> Vec<String> {
    let csv = String::from_utf8(lab.read(&format!("{out}/rowburst/frames.csv"))).unwrap();
    let lines = lines(&csv);
    let at = lines[0].iter().position(|n| n == name).unwrap();
    lines[1..].iter().map(|line| line[at].clone()).collect()
}

fn assert_same(lab: &Lab, one: &str, other: &str) {
    let (one, other) = (content(&lab.path(one)), content(&lab.path(other)));
    let names = |files: &BTreeMap<PathBuf, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&one), names(&other));
    for (name, bytes) in &one {
        assert!(bytes == &other[name], "{} differs", name.display());
    }
}

#[test]
fn a_recording_has_a_video_and_a_line_for_each_frame() {
    let lab = lab_of(11);
    let summary = done(&lab, "out.zarr", &QUICK);
    assert_eq!(
        (&summary["frames"], &summary["done"]),
        (&11.into(), &11.into())
    );
    assert_eq!(column(&lab, "out.zarr", "name")[10], "f10.npy");
    assert_eq!(column(&lab, "out.zarr", "status"), vec!["done"; 11]);
    for number in ["tau", "noise_sigma", "residual_over_sigma", "seconds"] {
        let values = column(&lab, "out.zarr", number);
        assert!(
            values.iter().all(|v| v.parse::<f64>().unwrap() > 0.0),
            "{number}"
        );
    }
    // By one thread, all threads on one frame, or in parts: the same to the bit.
    done(&lab, "one.zarr", &quick(&["--threads", "1"]));
    done(
        &lab,
        "each.zarr",
        &quick(&["--threads", "2", "--at-once", "1"]),
    );
    assert_same(&lab, "out.zarr", "one.zarr");
    assert_same(&lab, "out.zarr", "each.zarr");
    // A job that is through does nothing again.
    let before = std::fs::metadata(lab.path("out.zarr/0/c/3/0/0/0")).unwrap();
    let again = done(&lab, "out.zarr", &QUICK);
    assert_eq!(again["frames_this_run"], 0);
    let after = std::fs::metadata(lab.path("out.zarr/0/c/3/0/0/0")).unwrap();
    assert_eq!(before.modified().unwrap(), after.modified().unwrap());
}

#[test]
fn killed_at_random_it_resumes_and_ends_the_same() {
    let lab = lab_of(60);
    done(&lab, "whole.zarr", &QUICK);
    let run = |limit: Option<Duration>| -> bool {
        let mut command = command(&lab, "killed.zarr", &QUICK);
        command.stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        let started = Instant::now();
        loop {
            if let Some(status) = child.try_wait().unwrap() {
                assert!(status.success());
                return true;
            }
            if limit.is_some_and(|limit| started.elapsed() > limit) {
                // SIGKILL.
                child.kill().unwrap();
                child.wait().unwrap();
                return false;
            }
            std::thread::sleep(Duration::from_micros(200));
        }
    };
    let rows = || match std::fs::read_dir(lab.path("killed.zarr/rowburst/frames")) {
        Ok(entries) => entries.count(),
        Err(_) => 0,
    };
    let (mut kills, mut seen) = (0, 0);
    let mut in_the_middle = 0;
    for round in 0..200 {
        // Whatever the machine's speed: short and long runs, the longer the later.
        let random = f64::from(pattern(round, kills));
        let limit = Duration::from_secs_f64(random * 0.003 * 1.06f64.powi(round as i32));
        if run(Some(limit)) {
            break;
        }
        kills += 1;
        // Nothing is lost.
        let now = rows();
        assert!(now >= seen);
        in_the_middle += usize::from(now > seen && now < 60);
        seen = now;
    }
    assert!(run(None));
    assert!(
        kills >= 10 && in_the_middle >= 2,
        "{kills} kills, {in_the_middle} in the middle"
    );
    assert_same(&lab, "whole.zarr", "killed.zarr");
    let left = std::fs::read_dir(lab.path("killed.zarr/rowburst/tmp")).unwrap();
    assert_eq!(left.count(), 0, "nothing is left over of the kills");
    println!("{kills} kills, {in_the_middle} of them with frames done");
}

#[cfg(unix)]
#[test]
fn an_interrupt_is_reported_and_the_job_resumes() {
    let lab = lab_of(300);
    let mut command = command(&lab, "out.zarr", &quick(&[]));
    let child: Child = command
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let first = lab.path("out.zarr/rowburst/frames/000000.json");
    let started = Instant::now();
    while !first.exists() && started.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(1));
    }
    let id = child.id().to_string();
    Command::new("kill").args(["-INT", &id]).status().unwrap();
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    let stderr = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(130), "{stderr}");
    assert!(
        stderr.contains("Run the same command to resume"),
        "{stderr}"
    );
    let through = column(&lab, "out.zarr", "frame").len();
    assert!((1..300).contains(&through), "{through}");
    let summary = done(&lab, "out.zarr", &QUICK);
    assert_eq!(summary["frames_this_run"], 300 - through);
    assert_eq!(summary["done"], 300);
}

#[test]
fn parts_of_a_job_run_side_by_side() {
    let lab = lab_of(30);
    done(&lab, "whole.zarr", &QUICK);
    let ranges = ["0:10", "10:20", "20:"];
    let children = ranges.map(|range| {
        let mut command = command(&lab, "parts.zarr", &quick(&["--frames-range"]));
        command
            .arg(range)
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        command.spawn().unwrap()
    });
    for child in children {
        let output = child.wait_with_output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{stderr}");
    }
    assert_same(&lab, "whole.zarr", "parts.zarr");

    // Frames beyond the last are named.
    let mut beyond = command(&lab, "parts.zarr", &quick(&["--frames-range", "3:99"]));
    beyond.arg("--json");
    let (code, _, stderr) = output(beyond);
    assert_eq!(code, 0, "{stderr}");
    assert!(
        stderr.contains("3:99 ends beyond the last of the 30"),
        "{stderr}"
    );

    for (range, out) in [("5:5", "x"), ("30:", "x"), ("a:b", "x"), ("7", "x")] {
        let mut command = command(&lab, out, &quick(&["--frames-range"]));
        command.arg(range);
        let (code, _, stderr) = output(command);
        assert_eq!(code, 2, "{range}");
        assert!(stderr.contains("--frames-range"), "{stderr}");
    }
}

/// Two processes without ranges would make every frame twice: the second one is refused, and says what to do.
#[test]
fn a_second_process_without_a_range_is_refused() {
    let lab = lab_of(300);
    let mut first = command(&lab, "out.zarr", &QUICK);
    first.stdout(Stdio::null()).stderr(Stdio::null());
    let mut first = first.spawn().unwrap();
    let row = lab.path("out.zarr/rowburst/frames/000000.json");
    let started = Instant::now();
    while !row.exists() && started.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(1));
    }
    let (code, _, stderr) = output(command(&lab, "out.zarr", &QUICK));
    first.kill().unwrap();
    first.wait().unwrap();
    assert_eq!(code, 2, "{stderr}");
    assert!(
        stderr.contains("--frames-range") && stderr.contains("0:300"),
        "{stderr}"
    );
    // Killed, the first one keeps nobody out.
    let rest = quick(&["--frames-range", "0:20"]);
    assert_eq!(done(&lab, "out.zarr", &rest)["failed"], 0);
}

#[test]
fn frames_that_cannot_be_used_are_recorded_and_skipped() {
    let lab = lab_of(8);
    lab.write("rec/f1.npy", "no array");
    lab.truncate("rec/f2.npy", 0.7, "rec/f2.npy");
    lab.image("rec/f4.npy", ROWS + 1, COLUMNS, |_, _| 100.0);
    lab.image("rec/f5.npy", ROWS, COLUMNS, |y, x| {
        if y == x { f32::NAN } else { 100.0 }
    });
    // Counts of a camera among floats.
    let counts: Vec<u8> = (0..ROWS * COLUMNS).map(|i| 100 + (i % 50) as u8).collect();
    let counts = ndarray::Array2::from_shape_vec((ROWS, COLUMNS), counts).unwrap();
    ndarray_npy::write_npy(lab.path("rec/f6.npy"), &counts).unwrap();
    let mut failing = command(&lab, "out.zarr", &QUICK);
    failing.arg("--json");
    let (code, stdout, stderr) = output(failing);
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("5 frames failed"), "{stderr}");
    let summary: Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(
        (&summary["done"], &summary["failed"]),
        (&3.into(), &5.into())
    );
    let (status, message) = (
        column(&lab, "out.zarr", "status"),
        column(&lab, "out.zarr", "message"),
    );
    assert_eq!(
        status,
        [
            "done", "failed", "failed", "done", "failed", "failed", "failed", "done"
        ]
    );
    for (frame, words) in [
        (1, "f1.npy"),
        (2, "cut short"),
        (4, "13×10"),
        (5, "NaN"),
        (6, "integers of 8 bits"),
    ] {
        assert!(message[frame].contains(words), "{}", message[frame]);
        assert!(!lab.path(&format!("out.zarr/0/c/{frame}")).exists());
    }
    let warnings = summary["warnings"].to_string();
    assert!(warnings.contains("no video of 5 frames"), "{warnings}");

    // Mended, it is done when asked for, and only then.
    frame(&lab, "rec/f1.npy", 1);
    let again = done_in_part(&lab, "out.zarr", &QUICK);
    assert_eq!(again["frames_this_run"], 0);
    let summary = done_in_part(&lab, "out.zarr", &quick(&["--retry-failed"]));
    assert_eq!(
        (&summary["done"], &summary["failed"]),
        (&4.into(), &4.into())
    );
}

#[test]
fn a_recording_without_a_good_frame_is_an_error() {
    let lab = lab_of(3);
    (0..3).for_each(|i| lab.write(&format!("rec/f{i}.npy"), "no array"));
    let (code, _, stderr) = output(command(&lab, "out.zarr", &QUICK));
    assert_eq!(code, 1, "{stderr}");
    assert!(
        stderr.contains("none of its 3 frames can be used"),
        "{stderr}"
    );
    assert!(!lab.path("out.zarr").exists());
    // All frames of a part.
    let lab = lab_of(3);
    lab.write("rec/f1.npy", "no array");
    let (code, _, stderr) = output(command(
        &lab,
        "out.zarr",
        &quick(&["--frames-range", "1:2"]),
    ));
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("all 1 frames failed"), "{stderr}");
}

#[test]
fn an_archive_of_another_job_is_left_alone() {
    let lab = lab_of(3);
    done(&lab, "out.zarr", &QUICK);
    let before = content(&lab.path("out.zarr"));
    let refused = |more: &[&str], words: &str| {
        let (code, _, stderr) = output(command(&lab, "out.zarr", more));
        assert_eq!(code, 2, "{stderr}");
        assert!(stderr.contains(words), "{stderr}");
        assert!(content(&lab.path("out.zarr")) == before, "{words}");
    };
    refused(
        &["--prior", "l1", "--max-iterations", "40"],
        "prior was tv+0.5*tdiff, now l1",
    );
    refused(&quick(&["--tau", "0.1"]), "tau was Auto");
    lab.image("psf2.npy", 9, 7, |y, x| pattern(y + 51, x).powi(2));
    refused(&quick(&["--psf", "psf2.npy"]), "another PSF");
    lab.image("dark.npy", ROWS, COLUMNS, |_, _| 1.0);
    refused(&quick(&["--dark", "dark.npy"]), "another dark");
    frame(&lab, "rec/f0.npy", 7);
    refused(&QUICK, "other frames");
    frame(&lab, "rec/f0.npy", 0);
    frame(&lab, "rec/f3.npy", 3);
    refused(&QUICK, "number of frames was 3, now 4");

    for (name, words) in [
        ("rec", "something else in it"),
        ("psf.npy", "a file where a folder"),
    ] {
        let (code, _, stderr) = output(command(&lab, name, &QUICK));
        assert_eq!(code, 2, "{stderr}");
        assert!(stderr.contains(words), "{stderr}");
    }
    assert!(!lab.path("rec/rowburst").exists());
}

/// A file that may not grow beyond a block: each write fails as on a full disk.
#[cfg(target_os = "linux")]
#[test]
fn a_file_that_cannot_be_written_stops_it_and_nothing_is_corrupt() {
    let lab = lab_of(4);
    done(&lab, "whole.zarr", &QUICK);
    let mut limited = Command::new("bash");
    // With the signal ignored the write returns an error.
    let line = "trap '' XFSZ; ulimit -f 1; exec \"$@\"";
    limited.args(["-c", line, "bash"]).arg(program());
    limited.args([
        "batch",
        "experiment.toml",
        "--frames",
        "rec",
        "-o",
        "out.zarr",
    ]);
    limited.args(QUICK).current_dir(lab.path(""));
    let (code, _, stderr) = output(limited);
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("Free space"), "{stderr}");
    done(&lab, "out.zarr", &QUICK);
    assert_same(&lab, "whole.zarr", "out.zarr");
}

/// The same on a real disk that is full in mid-run, where this test may mount one.
#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_leaves_a_job_that_resumes() {
    struct Disk(PathBuf);
    impl Drop for Disk {
        fn drop(&mut self) {
            let _ = Command::new("umount").arg(&self.0).status();
        }
    }
    let lab = lab_of(60);
    let place = lab.path("disk");
    std::fs::create_dir(&place).unwrap();
    let mount = |options: &str| {
        let mut mount = Command::new("mount");
        mount
            .args(["-t", "tmpfs", "-o", options, "none"])
            .arg(&place);
        mount
            .stderr(Stdio::null())
            .status()
            .is_ok_and(|s| s.success())
    };
    if !mount("size=320k") {
        println!("skipped: mounting a small disk needs to be root");
        return;
    }
    let _disk = Disk(place.clone());
    let (code, _, stderr) = output(command(&lab, "disk/out.zarr", &QUICK));
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("Free space"), "{stderr}");
    let rows = std::fs::read_dir(place.join("out.zarr/rowburst/frames"))
        .unwrap()
        .count();
    assert!((1..60).contains(&rows), "{rows} frames fitted");
    assert!(mount("remount,size=16m"));
    let summary = done(&lab, "disk/out.zarr", &QUICK);
    assert_eq!(summary["frames_this_run"], 60 - rows);
    done(&lab, "whole.zarr", &QUICK);
    assert_same(&lab, "whole.zarr", "disk/out.zarr");
}

#[test]
fn memory_does_not_grow_with_the_recording() {
    let peak = |count: usize| {
        let lab = Lab::new();
        // One file with the frames one after the other.
        let video = [count, ROWS, COLUMNS];
        lab.video("rec.npy", video, |i| {
            100.0 + 50.0 * pattern(i / COLUMNS, i % COLUMNS)
        });
        let mut command = Command::new(program());
        command.args([
            "batch",
            "experiment.toml",
            "--frames",
            "rec.npy",
            "-o",
            "out.zarr",
        ]);
        command.args(QUICK).arg("--json").current_dir(lab.path(""));
        let (code, stdout, stderr) = output(command);
        assert_eq!(code, 0, "{stderr}");
        let summary: Value = serde_json::from_str(&stdout).unwrap();
        summary["peak_memory_bytes"].as_f64().unwrap()
    };
    if !cfg!(target_os = "linux") {
        return;
    }
    let (short, long) = (peak(20), peak(200));
    // 180 more videos are 0.5 MB, 180 more lines a tenth of it.
    assert!(
        long < short + 2e6,
        "{short} bytes for 20 frames, {long} for 200"
    );
}

#[test]
fn one_prior_is_chosen_for_all_frames_and_kept() {
    let lab = Lab::new();
    std::fs::create_dir(lab.path("rec")).unwrap();
    // Large enough for a choice.
    let camera = common::CAMERA
        .replace("rows = 12", "rows = 32")
        .replace("columns = 10", "columns = 40");
    lab.experiment(&format!("{camera}[calibration]\npsf = \"psf.npy\"\n"));
    for i in 0..4 {
        let light = [1.0, 1.0, 3.0, 1.0][i];
        lab.image(&format!("rec/f{i}.npy"), 32, 40, |y, x| {
            light * (100.0 + 50.0 * pattern(y + 91 * i, x))
        });
    }
    let auto = ["--max-iterations", "20"];
    let summary = done(&lab, "out.zarr", &auto);
    assert_eq!(summary["prior_frame"], 2, "the brightest");
    let reason = summary["prior_reason"].as_str().unwrap();
    assert!(reason.contains("held-out pixels"), "{reason}");
    let prior = summary["prior"].as_str().unwrap();
    assert_eq!(column(&lab, "out.zarr", "prior"), vec![prior; 4]);
    // A part that begins elsewhere takes the same choice.
    done(
        &lab,
        "parts.zarr",
        &["--max-iterations", "20", "--frames-range", "3:"],
    );
    done(&lab, "parts.zarr", &auto);
    assert_same(&lab, "out.zarr", "parts.zarr");
}

#[test]
fn dead_time_and_missing_frames_are_in_the_times() {
    let lab = lab_of(4);
    std::fs::remove_file(lab.path("rec/f2.npy")).unwrap();
    lab.write("rec/f1.npy", "no array");
    // A video of 6 bins of 9.6 µs.
    let (code, _, stderr) = output(command(&lab, "out.zarr", &quick(&["--stitch"])));
    assert_eq!(code, 2, "{stderr}");
    assert!(stderr.contains("no frame period"), "{stderr}");
    let short = quick(&["--frame-period-us", "50"]);
    let (code, _, stderr) = output(command(&lab, "out.zarr", &short));
    assert_eq!(code, 2, "{stderr}");
    assert!(stderr.contains("57.600 µs"), "{stderr}");

    let summary = done_in_part(
        &lab,
        "out.zarr",
        &quick(&["--frame-period-us", "100", "--stitch"]),
    );
    assert_eq!(summary["frame_period_us"], 100.0);
    assert!((summary["dead_us"].as_f64().unwrap() - 42.4).abs() < 1e-9);
    let warnings = summary["warnings"].to_string();
    assert!(warnings.contains("1 frames are missing"), "{warnings}");
    assert_eq!(
        column(&lab, "out.zarr", "start_us"),
        ["0.0", "100.0", "300.0"]
    );
    let json = |name: &str| -> Value { serde_json::from_slice(&lab.read(name)).unwrap() };
    // Six bins, one picture of dead time, six bins.
    assert_eq!(
        json("out.zarr/stitched/0/zarr.json")["shape"],
        serde_json::json!([13, 12, 10])
    );
    assert_eq!(
        json("out.zarr/zarr.json")["attributes"]["rowburst"]["frame_period_us"],
        100.0
    );
    // Again, from what is there, with the period of before.
    let before = content(&lab.path("out.zarr/stitched"));
    std::fs::remove_dir_all(lab.path("out.zarr/stitched")).unwrap();
    done_in_part(&lab, "out.zarr", &quick(&["--stitch"]));
    assert!(content(&lab.path("out.zarr/stitched")) == before);
}

#[test]
fn a_scheduler_needs_the_python_package_and_says_so() {
    let lab = lab_of(2);
    let mut command = command(&lab, "out.zarr", &["--scheduler", "tcp://127.0.0.1:9"]);
    command.args(QUICK).env("ROWBURST_PYTHON", "no-such-python");
    let (code, stdout, stderr) = output(command);
    assert_eq!((code, stdout.as_str()), (1, ""), "{stderr}");
    for words in [
        "--scheduler",
        "no-such-python",
        "pip install 'rowburst[dask]'",
    ] {
        assert!(stderr.contains(words), "{stderr}");
    }
}

#[test]
fn a_scheduler_takes_no_threads_of_this_machine() {
    let lab = lab_of(2);
    for (option, number) in [("--threads", "2"), ("--concurrent-frames", "2")] {
        let words = ["--scheduler", "tcp://127.0.0.1:9", option, number];
        let (code, stdout, stderr) = output(command(&lab, "out.zarr", &words));
        assert_eq!((code, stdout.as_str()), (2, ""), "{stderr}");
        assert!(
            stderr.contains("--scheduler") && stderr.contains(option),
            "{stderr}"
        );
    }
    assert!(!lab.path("out.zarr").exists());
}

#[test]
fn an_archive_of_other_numbers_is_not_continued() {
    let lab = lab_of(2);
    let mut begin = command(&lab, "out.zarr", &[]);
    begin.args(QUICK);
    assert_eq!(output(begin).0, 0);
    let path = lab.path("out.zarr/rowburst/job.json");
    let job = std::fs::read_to_string(&path).unwrap();
    let key = "\"numbers of the algorithm\":";
    let at = job.find(key).unwrap() + key.len();
    let at = at + job[at..].find('"').unwrap() + 1;
    let other = format!("{}0{}", &job[..at], &job[at..]);
    std::fs::write(&path, other).unwrap();
    let mut again = command(&lab, "out.zarr", &[]);
    again.args(QUICK);
    let (code, _, stderr) = output(again);
    assert_eq!(code, 2, "{stderr}");
    assert!(
        stderr.contains("numbers of the algorithm was 0"),
        "{stderr}"
    );
}

#[test]
fn a_sweep_makes_an_archive_for_each_point_and_one_table() {
    let lab = lab_of(3);
    let sweep = ["--sweep", "prior=tv,l1", "--max-iterations", "20", "--json"];
    let (code, stdout, stderr) = output(command(&lab, "out", &sweep));
    assert_eq!(code, 0, "{stderr}");
    let rows: Value = serde_json::from_str(&stdout).unwrap();
    let rows = rows.as_array().unwrap();
    assert_eq!(rows.len(), 2);
    for (row, prior) in rows.iter().zip(["tv", "l1"]) {
        assert_eq!(row["prior"], prior);
        assert!(row["tau"].as_f64().unwrap() > 0.0);
        assert!(row["fit"].as_str().unwrap().ends_with("of 3 good"));
        assert!(
            lab.path(&format!("out/prior={prior}.zarr/rowburst/frames.csv"))
                .exists()
        );
    }
    let table = String::from_utf8(lab.read("out/sweep.csv")).unwrap();
    assert_eq!(table.lines().count(), 3);
    // Again: all is there.
    let (code, _, stderr) = output(command(&lab, "out", &sweep));
    assert_eq!(code, 0, "{stderr}");
}
