//! Every reader and the experiment file under files that were changed at random.

#[path = "common/mutator.rs"]
mod mutator;

use mutator::fuzz;
use rowburst::{Image, Shape, TimeGrid, Video};
#[cfg(feature = "hdf5")]
use rowburst_io::write_hdf5_video;
use rowburst_io::{
    Experiment, OutputFolder, TiffScale, open_recording, read_colour_image, read_metadata,
    read_patch_set, read_photodiode, read_stack, read_video, write_mat_video, write_npy_image,
    write_npy_video, write_patch_set, write_png16, write_tiff_image, write_tiff_video,
};
use std::path::Path;

fn image() -> Image {
    Image::from_fn(5, 6, |y, x| (100 + 7 * y + x) as f32)
}

fn video() -> Video {
    let shape = Shape::new(3, 4, 5);
    Video::new(shape, (0..60).map(|i| i as f32).collect()).unwrap()
}

fn time() -> TimeGrid {
    TimeGrid::rolling(3, 9.6, 1.0, 1)
}

/// The bytes that `write` writes.
fn written(write: impl FnOnce(&mut std::io::Cursor<Vec<u8>>) -> rowburst::Result<()>) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    write(&mut bytes).unwrap();
    bytes.into_inner()
}

/// Reads a file in all ways in which an array may be read.
fn read(path: &Path) {
    let _ = read_colour_image(path);
    let _ = read_stack(path);
    let _ = read_video(path);
    let _ = read_metadata(path);
    if let Ok(recording) = open_recording(path) {
        let _ = recording.read(recording.count() - 1);
    }
}

/// Checks that the seed can be read, and fuzzes it.
fn fuzz_array(name: &str, seed: &[u8], beside: &[(&str, &[u8])]) {
    let folder = tempfile::tempdir().unwrap();
    for (file, bytes) in beside.iter().copied().chain([(name, seed)]) {
        std::fs::write(folder.path().join(file), bytes).unwrap();
    }
    read_stack(&folder.path().join(name)).unwrap();
    fuzz(name, seed, beside, read);
}

#[test]
fn npy() {
    let seed = written(|w| write_npy_image(w, &image()));
    fuzz_array("a.npy", &seed, &[]);
    let seed = written(|w| write_npy_video(w, &video()));
    fuzz_array("b.npy", &seed, &[]);
}

#[test]
fn tiff() {
    let seed = written(|w| write_tiff_image(w, &image()));
    fuzz_array("a.tif", &seed, &[]);
    let scale = TiffScale {
        frame_interval_s: 1e-5,
        first_s: 0.0,
        pixel_pitch_um: Some(6.5),
    };
    let seed = written(|w| write_tiff_video(w, &video(), scale));
    fuzz_array("b.tif", &seed, &[]);
}

#[test]
fn png() {
    let counts: Vec<u16> = (0..30).map(|i| i * 100).collect();
    let seed = written(|w| write_png16(w, 5, 6, &counts));
    fuzz_array("a.png", &seed, &[]);
}

#[test]
fn bmp() {
    let mut seed = b"BM".to_vec();
    for field in [54 + 32u32, 0, 54, 40, 2, 4] {
        seed.extend(field.to_le_bytes());
    }
    seed.extend([1, 0, 24, 0]);
    seed.extend([0; 24]);
    // Grey pixels in rows that are padded to four bytes.
    for row in 0..4u8 {
        seed.extend([row, row, row, 9, 9, 9, 0, 0]);
    }
    fuzz_array("a.bmp", &seed, &[]);
}

#[test]
fn fits() {
    let cards = [
        "SIMPLE  =                    T",
        "BITPIX  =                   16",
        "NAXIS   =                    3",
        "NAXIS1  =                    3",
        "NAXIS2  =                    2",
        "NAXIS3  =                    2",
        "BZERO   =                32768",
        "EXPTIME =               0.0005",
        "END",
    ];
    let mut seed: Vec<u8> = cards
        .iter()
        .flat_map(|card| format!("{card:<80}").into_bytes())
        .collect();
    seed.resize(2880, b' ');
    seed.extend((0..24).collect::<Vec<u8>>());
    seed.resize(2 * 2880, 0);
    fuzz_array("a.fits", &seed, &[]);
}

#[test]
fn mat() {
    let seed = written(|w| write_mat_video(w, &video(), &time()));
    fuzz_named("a.mat", &seed, "a.mat:video");
}

#[cfg(feature = "hdf5")]
#[test]
fn hdf5() {
    let seed = written(|w| write_hdf5_video(w, &video(), &time()));
    fuzz_named("a.h5", &seed, "a.h5:/video");
}

/// Fuzzes a file that holds several arrays, of which `array` names one.
fn fuzz_named(name: &str, seed: &[u8], array: &str) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join(name), seed).unwrap();
    read_stack(&folder.path().join(array)).unwrap();
    fuzz(name, seed, &[], |path| {
        read(path);
        read(&path.with_file_name(array));
    });
}

#[test]
fn photron() {
    let header = "#Camera Information Header\r\nRecord Rate(fps) : 50000\r\nShutter Speed(s) : 1/200000\r\nTotal Frame : 2\r\nImage Width : 4\r\nImage Height : 2\r\nColor Type : Mono\r\nColor Bit : 8\r\nFile Format : MRaw\r\nEffectiveBit Depth : 8\r\nEffectiveBit Side : Lower\r\n";
    let raw: Vec<u8> = (0..16).collect();
    fuzz_array("a.cih", header.as_bytes(), &[("a.mraw", &raw)]);
    let header = "<cih><frameInfo><totalFrame>2</totalFrame></frameInfo><recordInfo><recordRate>50000</recordRate><shutterSpeed>200000</shutterSpeed></recordInfo><imageDataInfo><resolution><width>4</width><height>2</height></resolution><colorInfo><type>Mono</type><bit>8</bit></colorInfo><effectiveBit><depth>8</depth><side>Lower</side></effectiveBit></imageDataInfo><imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo></cih>";
    fuzz_array("b.cihx", header.as_bytes(), &[("b.mraw", &raw)]);
    fuzz("c.mraw", &raw, &[("c.cihx", header.as_bytes())], read);
}

#[test]
fn photodiode() {
    let seed = b"time_us,value\n0,1.5\n9.6,2\n19.2,1e3\n28.8,-0.5\n";
    fuzz("a.csv", seed, &[], |path| {
        let _ = read_photodiode(path);
    });
}

#[test]
fn metadata() {
    let tiff = written(|w| write_tiff_image(w, &image()));
    let sidecars: [(&str, &str); 2] = [
        (
            "metadata.txt",
            r#"{"Summary": {"Width": 6, "Height": 5}, "Metadata-Default/a.tif": {"FileName": "a.tif", "Exposure-ms": 0.5, "ROI": "100-540-6-5", "Binning": "2", "BitDepth": 12, "Core-Camera": "Zyla", "Width": 6, "Height": 5, "Zyla-LightScanPlus-LineScanSpeed [lines/sec]": "100000"}}"#,
        ),
        (
            "a.txt",
            "Date and Time:\tMon Nov 16\r\nExposure Time (secs):\t0.0001\r\nHorizontal Binning:\t2\r\nVertical Binning:\t2\r\nKinetic Cycle Time (secs):\t0.004\r\n",
        ),
    ];
    for (name, text) in sidecars {
        fuzz(name, text.as_bytes(), &[("a.tif", &tiff)], |path| {
            let _ = read_metadata(&path.with_file_name("a.tif"));
            let _ = read_metadata(path.parent().unwrap());
        });
    }
}

#[test]
fn patches() {
    let place = tempfile::tempdir().unwrap();
    let folder = OutputFolder::create(place.path()).unwrap();
    let psf = |i: usize| {
        let pixel = move |y: usize, x: usize| ((y * 3 + x * 5 + i) % 7) as f32;
        rowburst::Psf::new(Image::from_fn(3, 3, pixel)).unwrap()
    };
    let set = rowburst::PatchSet::new(vec![psf(0), psf(1)], vec![(0.0, 0.0), (4.0, 2.5)]).unwrap();
    write_patch_set(&folder, "set", &set).unwrap();
    let [text, stack] =
        ["set.toml", "set.npy"].map(|name| std::fs::read(place.path().join(name)).unwrap());
    fuzz("set.toml", &text, &[("set.npy", &stack)], |path| {
        let _ = read_patch_set(path);
    });
    fuzz("set.npy", &stack, &[("set.toml", &text)], |path| {
        let _ = read_patch_set(&path.with_file_name("set.toml"));
    });
}

#[test]
fn experiment() {
    let seed = br#"[camera]
rows = 12
columns = 10
shutter = "dual-inside-out"
row_time_us = 9.6
exposure_us = 19.2
bins_per_row = 2
binning = 2
pixel_pitch_um = 6.5
bit_depth = 12
bias_counts = 100
gain_electrons_per_count = 0.5
read_noise_electrons = 2
full_well_counts = 4000

[calibration]
psf = "psf.npy"
dark = "dark.npy"

[field]
rows = 16
columns = 14

[recording]
frame_period_us = 1000

[reconstruction]
prior = "tv"
tau = 0.5

[[guide]]
image = "lens.tif"
time_us = 20
exposure_us = 40
"#;
    fuzz("experiment.toml", seed, &[], |path| {
        if let Ok(experiment) = Experiment::read(path) {
            // Of a file that is read, what is written is read.
            let _ = experiment.camera();
            let text = experiment.to_toml(path.parent().unwrap());
            let again = path.with_file_name("again.toml");
            std::fs::write(&again, text).unwrap();
            if experiment.camera().is_ok() {
                Experiment::read(&again).unwrap();
            }
        }
    });
}
