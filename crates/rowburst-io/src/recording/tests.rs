use super::*;
use crate::{SampleFormat, write_npy_image, write_npy_video, write_tiff_video};
use rowburst::{Image, Shape, Video};

fn order(names: &[&str]) -> Vec<String> {
    let mut names: Vec<String> = names.iter().map(|n| n.to_string()).collect();
    names.sort_by(|a, b| names::natural(a, b));
    names
}

#[test]
fn names_are_in_natural_order() {
    let sorted = ["a2.tif", "a10.tif", "a010.tif", "b1.tif"];
    let mut shuffled = sorted;
    shuffled.reverse();
    // Equal numbers: fewer letters first.
    assert_eq!(
        order(&shuffled),
        ["a2.tif", "a010.tif", "a10.tif", "b1.tif"]
    );
    let long = [
        "t99999999999999999999998.png",
        "t99999999999999999999999.png",
    ];
    assert_eq!(order(&[long[1], long[0]]), long);
    assert_eq!(order(&["ä2", "ä10", "ä1"]), ["ä1", "ä2", "ä10"]);
}

#[test]
fn numbers_count_the_frames_that_are_missing() {
    let of = |names: &[&str]| numbers(names);
    fn numbers(names: &[&str]) -> Option<Vec<u64>> {
        names::numbers(&order(names))
    }
    assert_eq!(of(&["f7.tif", "f8.tif", "f11.tif"]), Some(vec![0, 1, 4]));
    // Multiples of ten are steps.
    assert_eq!(of(&["f10", "f20", "f50"]), Some(vec![0, 1, 4]));
    // The digits of a date, which all share, do not count.
    let dated = ["2026-11-21_1.png", "2026-11-21_3.png", "2026-11-21_2.png"];
    assert_eq!(of(&dated), Some(vec![0, 1, 2]));
    for no_series in [["a1", "b2"], ["f1", "f01"], ["one", "two"], ["1_1", "2_2"]] {
        assert_eq!(of(&no_series), None, "{no_series:?}");
    }
}

fn saved(folder: &Path, name: &str, values: &[f32]) {
    let image = Image::new(1, values.len(), values.to_vec()).unwrap();
    let mut bytes = Vec::new();
    write_npy_image(&mut bytes, &image).unwrap();
    std::fs::write(folder.join(name), bytes).unwrap();
}

#[test]
fn a_folder_is_read_frame_by_frame() {
    let folder = tempfile::tempdir().unwrap();
    for number in [12, 3, 4] {
        saved(folder.path(), &format!("f{number}.npy"), &[number as f32]);
    }
    std::fs::write(folder.path().join("notes.txt"), "dark was lost").unwrap();
    std::fs::write(folder.path().join(".f5.npy"), "half").unwrap();
    std::fs::write(folder.path().join("f20.npy"), "damaged").unwrap();
    let frames = open_recording(folder.path()).unwrap();
    assert_eq!(frames.count(), 4);
    assert_eq!(frames.name(2), "f12.npy");
    assert_eq!(frames.read(2).unwrap().image.data(), [12.0]);
    assert_eq!(frames.read(0).unwrap().format, SampleFormat::Float);
    let numbers: Vec<u64> = (0..4).map(|i| frames.number(i)).collect();
    assert_eq!(numbers, [0, 1, 9, 17]);
    assert_eq!(gaps(&*frames), [(1, 2, 8), (2, 10, 16)]);
    let message = frames.read(3).unwrap_err().to_string();
    assert!(message.contains("f20.npy"), "{message}");

    std::fs::write(folder.path().join("dark.png"), "x").unwrap();
    let error = open_recording(folder.path()).err().unwrap().to_string();
    assert!(
        error.contains("dark.png") && error.contains("one format"),
        "{error}"
    );
    let empty = tempfile::tempdir().unwrap();
    let error = open_recording(empty.path()).err().unwrap().to_string();
    assert!(error.contains("without images"), "{error}");
}

#[test]
fn stacks_are_read_page_by_page() {
    let folder = tempfile::tempdir().unwrap();
    let shape = Shape::new(5, 3, 4);
    let video = Video::new(shape, (0..60).map(|v| v as f32).collect()).unwrap();
    let (tif, npy) = (folder.path().join("s.tif"), folder.path().join("s.npy"));
    let scale = crate::TiffScale {
        frame_interval_s: 1.0,
        first_s: 0.0,
        pixel_pitch_um: None,
    };
    let mut bytes = std::io::Cursor::new(Vec::new());
    write_tiff_video(&mut bytes, &video, scale).unwrap();
    std::fs::write(&tif, bytes.into_inner()).unwrap();
    let mut bytes = Vec::new();
    write_npy_video(&mut bytes, &video).unwrap();
    std::fs::write(&npy, &bytes).unwrap();
    for path in [&tif, &npy] {
        let frames = open_recording(path).unwrap();
        assert_eq!(frames.count(), 5);
        for index in [4, 0, 2] {
            let image = frames.read(index).unwrap().image;
            assert_eq!((image.rows(), image.columns()), (3, 4));
            assert_eq!(image.data(), video.bin(index), "{}", path.display());
        }
    }

    // The last frame is cut short: the others are still there.
    std::fs::write(&npy, &bytes[..bytes.len() - 4]).unwrap();
    let frames = open_recording(&npy).unwrap();
    assert_eq!(frames.read(3).unwrap().image.data(), video.bin(3));
    let message = frames.read(4).unwrap_err().to_string();
    assert!(message.contains("ends before frame 4"), "{message}");
}

#[test]
fn a_single_image_is_a_recording_of_one() {
    let folder = tempfile::tempdir().unwrap();
    saved(folder.path(), "one.npy", &[1.0, 2.0]);
    let frames = open_recording(&folder.path().join("one.npy")).unwrap();
    assert_eq!((frames.count(), frames.name(0)), (1, "[0]".to_string()));
    assert_eq!(frames.read(0).unwrap().image.data(), [1.0, 2.0]);
    assert!(open_recording(&folder.path().join("none")).is_err());
}
