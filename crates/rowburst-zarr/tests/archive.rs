//! What is written is read again, and what others write is read.

use rowburst::{Shape, Video};
use rowburst_io::SampleFormat;
use rowburst_zarr::{
    ArchiveParams, Scratch, StitchParams, StitchedVideo, VideoArchive, is_zarr, open_zarr_recording,
};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;

fn params(frames: usize, video: Shape) -> ArchiveParams {
    ArchiveParams {
        frames,
        video,
        bin_us: 9.6,
        first_bin_us: 0.0,
        pixel_pitch_um: Some(6.5),
        field_offset: (2, 0),
        frame_period_us: Some(1000.5),
        frame_start_us: Some((0..frames).map(|i| 1000.5 * i as f64).collect()),
        attributes: json!({"values": "counts"}),
    }
}

fn video(shape: Shape, seed: usize) -> Video {
    let value = |i: usize| ((i * 7919 + seed * 104_729) % 1013) as f32 / 7.0;
    Video::new(shape, (0..shape.voxels()).map(value).collect()).unwrap()
}

fn json_of(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn a_video_comes_back_to_the_bit() {
    // One chunk, and several of which the last is not full.
    for shape in [Shape::new(7, 5, 6), Shape::new(35, 200, 201)] {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("o.zarr");
        let scratch = Arc::new(Scratch::open(&folder.path().join("tmp")).unwrap());
        let archive = VideoArchive::create(&out, params(3, shape), &scratch).unwrap();
        let (first, last) = (video(shape, 0), video(shape, 2));
        archive.store(2, &last).unwrap();
        archive.store(0, &first).unwrap();
        // Another process opens it again.
        let again = VideoArchive::create(&out, params(3, shape), &scratch).unwrap();
        assert_eq!(again.read(0, 0..shape.bins).unwrap(), first.data());
        assert_eq!(
            again.read(2, 3..5).unwrap(),
            last.data()[3 * shape.pixels()..5 * shape.pixels()]
        );
        assert!(again.read(1, 0..1).unwrap().iter().all(|v| v.is_nan()));

        let ome = &json_of(&out.join("zarr.json"))["attributes"]["ome"];
        let image = &ome["multiscales"][0];
        assert_eq!(
            image["datasets"][0]["coordinateTransformations"][0]["scale"],
            json!([1000.5, 9.6, 6.5, 6.5])
        );
        assert_eq!(
            image["datasets"][0]["coordinateTransformations"][1]["translation"],
            json!([0.0, 4.8, -13.0, 0.0])
        );
        assert_eq!(
            image["axes"][1],
            json!({"name": "t", "unit": "microsecond"})
        );
        let chunk =
            &json_of(&out.join("0/zarr.json"))["chunk_grid"]["configuration"]["chunk_shape"];
        assert_eq!(chunk[1], if shape.bins == 7 { 7 } else { 18 });
    }
}

#[test]
fn frames_are_stitched_across_chunks() {
    let shape = Shape::new(35, 200, 201);
    let folder = tempfile::tempdir().unwrap();
    let scratch = Arc::new(Scratch::open(&folder.path().join("tmp")).unwrap());
    let archive =
        VideoArchive::create(&folder.path().join("o.zarr"), params(2, shape), &scratch).unwrap();
    let videos = [video(shape, 0), video(shape, 1)];
    (0..2).for_each(|i| archive.store(i, &videos[i]).unwrap());
    let bins: Vec<_> = (0..35)
        .map(|bin| Some((0, bin)))
        .chain([None])
        .chain((2..35).map(|bin| Some((1, bin))))
        .collect();
    let time_us = (0..bins.len()).map(|i| i as f64).collect();
    let about = StitchParams { bins, time_us };
    let hidden = folder.path().join("stitched");
    let stitched = StitchedVideo::create(&archive, &about, &hidden).unwrap();
    assert_eq!(stitched.chunks(), 4);
    (0..4).for_each(|chunk| stitched.copy_chunk(chunk).unwrap());
    // Read back as a recording of its bins.
    let frames = open_zarr_recording(&hidden).unwrap();
    assert_eq!(frames.count(), 69);
    for (at, bin) in about.bins.iter().enumerate() {
        let read = frames.read(at).unwrap().image;
        match bin {
            None => assert!(read.data().iter().all(|v| v.is_nan())),
            Some((frame, bin)) => assert_eq!(read.data(), videos[*frame].bin(*bin), "{at}"),
        }
    }
}

/// A Zarr 2 array without compression, chunk by chunk.
fn write_v2(
    path: &Path,
    shape: &[usize],
    chunks: &[usize],
    dtype: &str,
    files: &[(&str, Vec<u8>)],
) {
    std::fs::create_dir_all(path).unwrap();
    let metadata = json!({
        "zarr_format": 2, "shape": shape, "chunks": chunks, "dtype": dtype,
        "compressor": null, "filters": null, "fill_value": 0, "order": "C",
    });
    std::fs::write(path.join(".zarray"), metadata.to_string()).unwrap();
    for (name, bytes) in files {
        std::fs::write(path.join(name), bytes).unwrap();
    }
}

#[test]
fn recordings_of_version_2_are_read_frame_by_frame() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.zarr");
    let counts = |from: u16| {
        (from..from + 12)
            .flat_map(u16::to_le_bytes)
            .collect::<Vec<u8>>()
    };
    let files = [("0.0.0", counts(100)), ("1.0.0", counts(500))];
    write_v2(&path, &[3, 2, 3], &[2, 2, 3], "<u2", &files);
    assert!(is_zarr(&path) && !is_zarr(folder.path()));
    let frames = open_zarr_recording(&path).unwrap();
    assert_eq!(frames.count(), 3);
    for (at, first) in [(2, 500.0), (0, 100.0), (1, 106.0)] {
        let read = frames.read(at).unwrap();
        assert_eq!(read.format, SampleFormat::Counts { bits: 16 });
        assert_eq!((read.image.rows(), read.image.columns()), (2, 3));
        assert_eq!(read.image.data()[0], first);
        assert_eq!(read.image.data()[5], first + 5.0);
    }
    // A damaged chunk takes its own frames with it.
    std::fs::write(path.join("1.0.0"), "cut").unwrap();
    let frames = open_zarr_recording(&path).unwrap();
    assert_eq!(frames.read(1).unwrap().image.data()[0], 106.0);
    let message = frames.read(2).err().unwrap().to_string();
    assert!(message.contains("a.zarr: frame 2"), "{message}");
}

#[test]
fn other_axes_must_have_length_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.zarr");
    let bytes: Vec<u8> = (0..12).collect();
    let files = [("0.0.0.0.0", bytes)];
    write_v2(&path, &[2, 1, 1, 2, 3], &[2, 1, 1, 2, 3], "|u1", &files);
    let frames = open_zarr_recording(&path).unwrap();
    assert_eq!(frames.read(1).unwrap().image.data()[0], 6.0);
    for shape in [vec![2, 3, 2, 2], vec![2, 2], vec![0, 2, 2]] {
        let path = folder
            .path()
            .join(format!("b{}.zarr", shape.len() * 10 + shape[0]));
        write_v2(&path, &shape, &vec![1; shape.len()], "|u1", &[]);
        let message = open_zarr_recording(&path).err().unwrap().to_string();
        assert!(message.contains("[frame, y, x]"), "{message}");
    }
    let path = folder.path().join("c.zarr");
    write_v2(&path, &[2, 2, 2], &[1, 2, 2], "<c8", &[]);
    let message = open_zarr_recording(&path).err().unwrap().to_string();
    assert!(message.contains("c.zarr"), "{message}");
    // A group that is no image.
    let path = folder.path().join("g.zarr");
    std::fs::create_dir(&path).unwrap();
    std::fs::write(path.join(".zgroup"), "{\"zarr_format\": 2}").unwrap();
    let message = open_zarr_recording(&path).err().unwrap().to_string();
    assert!(message.contains("no OME-Zarr image"), "{message}");
}
