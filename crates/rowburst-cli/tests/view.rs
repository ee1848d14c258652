//! Figures of a result, and folders that are none, as a user meets them. The page itself is looked at
//! by `scripts/check_view`.

mod common;

use common::Lab;
use serde_json::Value;

fn small() -> Lab {
    let lab = Lab::new();
    lab.done("reconstruct experiment.toml --frame frame.npy --prior tv --max-iterations 20 -o out");
    lab
}

#[test]
fn a_result_keeps_what_the_viewer_shows() {
    let lab = small();
    let view: Value = serde_json::from_slice(&lab.read("out/view.json")).unwrap();
    // A mask is named where it marks anything.
    for (key, marked) in [("excluded", 1), ("coverage", 0)] {
        let bytes = lab.read(&format!("out/{key}.npy"));
        let header = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        let is_marked = bytes[10 + header..].contains(&marked);
        assert_eq!(view.get(key).is_some(), is_marked, "{key}");
    }
    assert_eq!(view["bin_duration_us"], 9.6);
    assert_eq!(view["truth"], Value::Null);
    // The middle rows are read first.
    assert_eq!(view["row_bins"][5], serde_json::json!([0usize, 0]));
    assert_eq!(view["row_bins"][0], serde_json::json!([5usize, 5]));
    assert_eq!(view["row_bins"].as_array().unwrap().len(), common::ROWS);
    assert!(lab.path("out/view-frame.npy").is_file());
    assert!(!lab.path("out/view-truth.npy").exists());
    // A truth that lies elsewhere is copied, and goes with the next result that has none.
    std::fs::copy(lab.path("out/video.npy"), lab.path("t.npy")).unwrap();
    let line =
        "reconstruct experiment.toml --frame frame.npy --prior tv --max-iterations 20 -o out";
    lab.done(&format!("{line} --truth t.npy"));
    assert_eq!(lab.read("out/view-truth.npy"), lab.read("t.npy"));
    lab.done(line);
    assert!(!lab.path("out/view-truth.npy").exists());
}

#[test]
fn figures_are_svg_with_text_or_png() {
    let lab = small();
    lab.done("figure out --layout fig2 -o figures/two.svg");
    let svg = String::from_utf8(lab.read("figures/two.svg")).unwrap();
    assert!(
        svg.starts_with("<?xml") && svg.contains(">a</text>"),
        "{}",
        &svg[..200]
    );
    lab.done("figure out --layout fig3 -o three.png");
    lab.done("figure out --width-mm 86 --panels frame,frames --bins 1,4 -o column.svg");
    let column = std::fs::read_to_string(lab.path("column.svg")).unwrap();
    assert!(column.contains("width=\"86mm\"") && column.contains(">b</text>"));
    assert!(lab.read("three.png").starts_with(b"\x89PNG"));
    for (line, word) in [
        ("figure out --layout fig2 -o two.eps", ".svg, .pdf or .png"),
        ("figure nothing --layout fig2 -o two.svg", "no result.json"),
    ] {
        let (status, said) = run(&lab, line);
        assert_eq!(status, Some(2), "{line}: {said}");
        assert!(said.contains(word), "{line}: {said}");
    }
    lab.write("out/view.json", "{}");
    let (status, said) = run(&lab, "figure out --layout fig2 -o two.svg");
    assert!(status == Some(2) && said.contains("view.json"), "{said}");
}

#[cfg(feature = "view")]
#[test]
fn folders_without_a_result_are_refused() {
    let lab = small();
    std::fs::remove_file(lab.path("out/result.json")).unwrap();
    for (line, word) in [
        ("view .", "no result.json"),
        ("view out", "but no result.json"),
        ("view nothing", "nothing"),
        ("view experiment.toml", "experiment.toml"),
        ("view out out out", "no more were expected"),
        ("view out --port 99999", "port"),
    ] {
        let (status, said) = run(&lab, &format!("{line} --no-open"));
        assert_eq!(status, Some(2), "{line}: {said}");
        assert!(said.contains(word), "{line}: {said}");
    }
}

fn run(lab: &Lab, line: &str) -> (Option<i32>, String) {
    let output = std::process::Command::new(common::program())
        .args(line.split_whitespace())
        .current_dir(lab.path(""))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    (output.status.code(), said)
}
