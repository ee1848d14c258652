use super::*;
use ::tiff::encoder::{TiffEncoder, TiffKindStandard, colortype::Gray16};
use ::tiff::tags::Tag;
use std::io::Cursor;

/// A TIFF of 4×6 pixels with further tags in its first page.
fn tiff_with(
    path: &Path,
    tags: impl Fn(&mut ::tiff::encoder::DirectoryEncoder<&mut Cursor<Vec<u8>>, TiffKindStandard>),
) {
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
    let mut image = encoder.new_image::<Gray16>(6, 4).unwrap();
    tags(image.encoder());
    image.write_data(&[7; 24]).unwrap();
    std::fs::write(path, bytes.into_inner()).unwrap();
}

const RECORD: &str = r#"{"FileName": "a.tif", "Exposure-ms": 0.5, "ROI": "100-540-6-4",
    "Binning": "2", "BitDepth": 12, "PixelSizeUm": 0.0, "Core-Camera": "Zyla",
    "Width": 6, "Height": 4,
    "Zyla-LightScanPlus-SensorReadoutMode": "Centre Out Simultaneous",
    "Zyla-LightScanPlus-ScanSpeedControlEnable": "On",
    "Zyla-LightScanPlus-LineScanSpeed [lines/sec]": "100000"}"#;

#[test]
fn micro_managers_tag_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tif");
    tiff_with(&path, |page| {
        page.write_tag(Tag::Unknown(51123), RECORD).unwrap();
    });
    let found = read_metadata(&path);
    assert_eq!(found.sources, ["Micro-Manager's tag in a.tif"]);
    assert_eq!((found.size, found.origin), (Some((4, 6)), Some((540, 100))));
    assert_eq!(found.exposure_us, Some(500.0));
    assert_eq!(found.row_time_us, Some(10.0));
    assert_eq!(found.shutter, Some(Shutter::DualInsideOut));
    assert_eq!((found.binning, found.bit_depth), (Some(2), Some(12)));
    // Nobody has calibrated the objective.
    assert_eq!(found.pixel_pitch_um, None);
    assert!(found.notes.is_empty());

    tiff_with(&path, |page| {
        page.write_tag(Tag::Unknown(51123), "{\"Exposure-ms\": 0.5")
            .unwrap();
    });
    let found = read_metadata(&path);
    assert_eq!(found.exposure_us, None);
    assert!(found.notes[0].contains("not JSON"), "{:?}", found.notes);
}

#[test]
fn the_exposure_of_pycro_manager_is_read() {
    let record = r#"{"Exposure": "0.5", "Width": 6, "Height": 4}"#;
    let found = micro_manager_metadata(record, "a record");
    assert_eq!(found.exposure_us, Some(500.0));
    // That of Micro-Manager comes first.
    let record = r#"{"Exposure": 7, "Exposure-ms": 0.25}"#;
    let found = micro_manager_metadata(record, "a record");
    assert_eq!(found.exposure_us, Some(250.0));
}

#[test]
fn metadata_txt_is_read_for_the_image_and_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.tif", "b.tif"] {
        tiff_with(&folder.path().join(name), |_| ());
    }
    // As a stopped acquisition leaves it: without the last brace.
    let text = format!(
        r#"{{"Summary": {{"Width": 6, "Height": 4, "PixelSize_um": 0.65,
            "InitialScopeData": {{"PCO-Line Time [us]": {{"type": "STRING", "scalar": "9.17"}}}}}},
        "FrameKey-0-0-0": {{"FileName": "b.tif", "Exposure-ms": 3}},
        "FrameKey-1-0-0": {RECORD},"#
    );
    std::fs::write(folder.path().join("metadata.txt"), text).unwrap();
    let a = read_metadata(&folder.path().join("a.tif"));
    assert_eq!(a.exposure_us, Some(500.0));
    assert_eq!(a.pixel_pitch_um, None);
    let b = read_metadata(&folder.path().join("b.tif"));
    assert_eq!(b.exposure_us, Some(3000.0));
    assert_eq!((b.size, b.pixel_pitch_um), (Some((4, 6)), Some(0.65)));
    assert_eq!(b.row_time_us, Some(9.17));
    assert_eq!(read_metadata(folder.path()), a);
    // An image that it does not list has the first record.
    let other = read_metadata(&folder.path().join("none.png"));
    assert_eq!(other.exposure_us, b.exposure_us);
    let empty = tempfile::tempdir().unwrap();
    assert!(read_metadata(empty.path()).is_empty());
}

#[test]
fn ome_xml_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ome.tif");
    let xml = r#"<?xml version="1.0" encoding="UTF-8"?>
        <OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">
        <Pixels DimensionOrder="XYCZT" ID="Pixels:0" SizeX="6" SizeY="4" SizeC="1" SizeZ="1" SizeT="9"
          Type="uint16" SignificantBits="12" PhysicalSizeX="650" PhysicalSizeXUnit="nm" TimeIncrement="2.5"
          TimeIncrementUnit="ms">
        <Channel ID="Channel:0:0"><DetectorSettings ID="Detector:0" Binning="2x2"/></Channel>
        <Plane TheC="0" TheT="0" TheZ="0" ExposureTime="0.0001"/></Pixels></Image></OME>"#;
    tiff_with(&path, |page| {
        page.write_tag(Tag::ImageDescription, xml).unwrap();
    });
    let found = read_metadata(&path);
    assert_eq!(found.size, Some((4, 6)));
    assert_eq!((found.bit_depth, found.binning), (Some(12), Some(2)));
    let near = |a: Option<f64>, b: f64| (a.unwrap() / b - 1.0).abs() < 1e-12;
    assert!(near(found.exposure_us, 100.0) && near(found.frame_period_us, 2500.0));
    assert!(near(found.pixel_pitch_um, 0.65));
    assert!(found.notes.is_empty());

    let several = xml.replace("SizeZ=\"1\"", "SizeZ=\"3\"");
    tiff_with(&path, |page| {
        page.write_tag(Tag::ImageDescription, &several[..]).unwrap();
    });
    assert!(read_metadata(&path).notes[0].contains("planes in depth"));
    tiff_with(&path, |page| {
        page.write_tag(Tag::ImageDescription, &xml[..200]).unwrap();
    });
    assert!(read_metadata(&path).notes[0].contains("not XML"));
}

#[test]
fn andors_tags_and_text_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tif");
    tiff_with(&path, |page| {
        page.write_tag(Tag::Unknown(4876), 0.00025f64).unwrap();
        page.write_tag(Tag::Unknown(4878), 0.002f32).unwrap();
    });
    let found = read_metadata(&path);
    assert_eq!(found.exposure_us, Some(250.0));
    assert!((found.frame_period_us.unwrap() - 2000.0).abs() < 1e-3);

    tiff_with(&path, |_| ());
    let text = "Date and Time:\tMon Nov 16\r\nExposure Time (secs):\t0.0001\r\nHorizontal Binning:\t2\r\nVertical Binning:\t2\r\nKinetic Cycle Time (secs):\t0.004\r\n";
    std::fs::write(folder.path().join("a.txt"), text).unwrap();
    let found = read_metadata(&path);
    assert_eq!(found.exposure_us, Some(100.0));
    assert_eq!(
        (found.binning, found.frame_period_us),
        (Some(2), Some(4000.0))
    );
    // Any other text is none of Andor's.
    std::fs::write(folder.path().join("a.txt"), "to do: align").unwrap();
    assert!(read_metadata(&path).is_empty());
}
