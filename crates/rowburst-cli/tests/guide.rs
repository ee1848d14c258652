//! A dense scene with the picture of a second camera, on the command line.

mod common;

use common::Lab;

const CAMERA: &str = "[camera]
rows = 72
columns = 72
shutter = \"dual-inside-out\"
row_time_us = 10.0
exposure_us = 10.0
";

/// The picture that `simulate` takes makes the video better, and `rerun` repeats it. A picture of another scene is dropped.
#[test]
fn a_guide_makes_a_dense_scene_better() {
    let lab = Lab::empty();
    lab.experiment(CAMERA);
    for (scene, folder) in [("beam", "beam"), ("wheel", "wheel")] {
        lab.done(&format!(
            "simulate experiment.toml --scene {scene} --guide-times-us 180 --seed 11 -o {folder}"
        ));
    }
    let pictures = lab.files("wheel");
    let picture = pictures.iter().find(|name| name.starts_with("guide"));
    let picture = picture.expect("simulate has taken a picture");
    let run = "reconstruct beam/experiment.toml --frame beam/frame.npy --truth beam/truth.npy --prior tv+8*tdiff --max-iterations 60";
    lab.done(&format!("{run} -o guided"));
    let guide = &lab.result("guided")["guide"];
    assert_eq!(guide["used"], true, "{guide:#}");
    assert_eq!(guide["model"], "motion", "{guide:#}");
    assert!(lab.files("guided").contains(&"guide.png".to_string()));
    let said = lab.done("rerun guided -o again");
    assert!(said.contains("equal to the bit"), "{said}");

    lab.done(&format!("{run} --guide wheel/{picture} -o alone"));
    let guide = &lab.result("alone")["guide"];
    assert_eq!(guide["used"], false, "{guide:#}");
    assert!(lab.number("guided", "psnr_db") > lab.number("alone", "psnr_db") + 3.0);
    let said = lab.done("rerun alone -o alone-again");
    assert!(said.contains("equal to the bit"), "{said}");
}

/// A guide of lit places gives each of them a trace with standard errors, which `rerun` repeats.
#[test]
fn the_places_of_a_guide_have_traces() {
    let lab = Lab::empty();
    lab.experiment(CAMERA);
    lab.done("simulate experiment.toml --scene spots --guide-times-us 100 --seed 3 -o spots");
    let run = "reconstruct spots/experiment.toml --frame spots/frame.npy --truth spots/truth.npy --guide-model places";
    lab.done(&format!("{run} -o places"));
    let guide = &lab.result("places")["guide"];
    assert_eq!(guide["used"], true, "{guide:#}");
    let traces = guide["known_places"]["traces"].as_array().unwrap();
    assert!((30..50).contains(&traces.len()), "{}", traces.len());
    assert!(lab.number("places", "psnr_db") > 30.0);
    let files = lab.files("places");
    assert!(files.contains(&"places.csv".to_string()) && files.contains(&"places.npy".to_string()));
    let table = String::from_utf8(lab.read("places/places.csv")).unwrap();
    assert!(
        table.starts_with("time_us,place1,place1_standard_error"),
        "{table}"
    );
    assert_eq!(table.lines().count(), 1 + 36);
    let said = lab.done("rerun places -o again");
    assert!(said.contains("equal to the bit"), "{said}");
    // Without places their files are gone.
    lab.done(
        &format!("{run} --guide-model still -o places --force")
            .replace("--guide-model places ", ""),
    );
    assert!(
        !lab.files("places")
            .iter()
            .any(|name| name.starts_with("places."))
    );
}
