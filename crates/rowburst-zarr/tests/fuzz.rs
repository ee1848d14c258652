//! A Zarr recording under files that were changed at random.

#[path = "../../rowburst-io/tests/common/mutator.rs"]
mod mutator;

use mutator::fuzz;
use rowburst_zarr::open_zarr_recording;
use std::path::Path;

/// An array `[2, 3, 4]` of u16 in one chunk.
const ARRAY: &str = r#"{"zarr_format": 3, "node_type": "array", "shape": [2, 3, 4], "data_type": "uint16",
"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2, 3, 4]}},
"chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}}, "fill_value": 0,
"codecs": [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "gzip", "configuration": {"level": 1}}]}"#;
const IMAGE: &str = r#"{"zarr_format": 3, "node_type": "group", "attributes": {"ome": {"version": "0.5",
"multiscales": [{"axes": [{"name": "t", "type": "time"}, {"name": "y", "type": "space"}, {"name": "x", "type": "space"}],
"datasets": [{"path": "0"}]}]}}}"#;

/// `data` in one stored block of gzip.
fn gzip(data: &[u8]) -> Vec<u8> {
    let mut crc = !0u32;
    for byte in data {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = (crc >> 1) ^ (0xedb8_8320 * (crc & 1));
        }
    }
    let length = data.len() as u16;
    let mut bytes = vec![0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 255, 1];
    bytes.extend(length.to_le_bytes());
    bytes.extend((!length).to_le_bytes());
    bytes.extend(data);
    bytes.extend((!crc).to_le_bytes());
    bytes.extend(u32::from(length).to_le_bytes());
    bytes
}

fn read(folder: &Path) -> rowburst::Result<()> {
    let recording = open_zarr_recording(folder)?;
    recording.read(recording.count() - 1)?;
    Ok(())
}

#[test]
fn zarr() {
    let chunk = gzip(&(0..48).collect::<Vec<u8>>());
    let files: [(&str, &[u8]); 3] = [
        ("a.zarr/zarr.json", IMAGE.as_bytes()),
        ("a.zarr/0/zarr.json", ARRAY.as_bytes()),
        ("a.zarr/0/c/0/0/0", &chunk),
    ];
    for (at, (name, seed)) in files.iter().enumerate() {
        let folder = |path: &Path| path.ancestors().nth([1, 2, 5][at]).unwrap().to_path_buf();
        let place = tempfile::tempdir().unwrap();
        for (file, bytes) in &files {
            let path = place.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, bytes).unwrap();
        }
        read(&folder(&place.path().join(name))).unwrap();
        let beside: Vec<(&str, &[u8])> = files.iter().copied().filter(|(n, _)| n != name).collect();
        fuzz(name, seed, &beside, |path| {
            let _ = read(&folder(path));
        });
    }
}
