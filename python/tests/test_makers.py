"""Files of camera makers. They are written here after the readers' own descriptions of the formats."""

import struct
import sys

import numpy as np
import pytest

import rowburst as rb

FRAMES = np.random.default_rng(7).integers(0, 60000, (3, 6, 8)).astype(np.uint16)


def write_sif(path, frames, exposure_s=3e-05):
    """Andor's header, version 65538, then float32."""
    count, rows, columns = frames.shape
    lines = [
        "Andor Technology Multi-Channel File\n65538 1\n",
        "65538 0 0 1 1540956289 -60 ", " " * 10, f"0 {exposure_s} 0.03 0.03 1 \0 0.03 1e-06 0 1 2 0 0 0 ", "0 " * 16, "750 rest\n",
        f"Zyla\n{columns} {rows} 8\nname.sif \n", "65538 4\nuser\n", "65538 ", " " * 8, "0.01 0.02\n",
        "65539 0 1 0 0\n", "0 1 0 0\n0 1 0 0\nnan\n422\n6.5\n6.5\n", "12\nPixel number6\nCounts12\nPixel number",
        f"65541 1 {rows} {columns} 1 {count} 1 {count * rows * columns} {rows * columns} 65538 1 {rows} {columns} 1 1 1\n",
        "0\n" * count, "0\n",
    ]  # fmt: skip
    path.write_bytes("".join(lines).encode() + frames.astype("<f4").tobytes())


def write_dcimg(path, frames):
    """Hamamatsu's format 0x1000000: the first four pixels of row 1023 stand behind each frame."""
    from dcimg import DCIMGFile

    count, rows, columns = frames.shape
    start, offset, size = 232, 760, 2 * rows * columns
    header, session, crop = (np.zeros(1, kind) for kind in (DCIMGFile.FILE_HDR_DTYPE, DCIMGFile.NEW_SESSION_HEADER_DTYPE, DCIMGFile.NEW_CROP_INFO))
    header["file_format"], header["format_version"], header["header_size"] = b"DCIMG", 0x1000000, start
    session["nfrms"], session["byte_depth"], session["xsize"], session["ysize"] = count, 2, columns, rows
    session["bytes_per_row"], session["bytes_per_img"], session["offset_to_data"] = 2 * columns, size, offset
    crop["xsize"], crop["ysize"] = columns, rows
    data = bytearray(start + offset)
    for position, record in ((0, header), (start, session), (start + 712, crop)):
        data[position : position + record.nbytes] = record.tobytes()
    for i, frame in enumerate(frames):
        first = np.zeros(4, "<u2")
        if rows > 1023:
            first, frame = frame[1023, :4].astype("<u2"), frame.copy()
            frame[1023, :4] = 0
        data += frame.astype("<u2").tobytes() + struct.pack("<III", i, 100 + i, 5) + first.tobytes() + bytes(12)
    path.write_bytes(data)


def write_b16(path, frame):
    rows, columns = frame.shape
    path.write_bytes(struct.pack("<4sIIIII", b"PCO-", 128 + frame.nbytes, 128, columns, rows, 0).ljust(128, b"\0") + frame.tobytes())


def test_frames_of_andor(tmp_path, capture, camera, psf):
    pytest.importorskip("sif_parser")
    write_sif(tmp_path / "run.sif", FRAMES)
    read = rb.read_frames(tmp_path / "run.sif")
    # Counts, though the file holds them as floating-point numbers: the bias is still in them.
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, FRAMES)
    settings = rb.read_settings(tmp_path / "run.sif")
    assert settings == {"rows": 6, "columns": 8, "exposure_us": 30}
    assert rb.Camera(shutter="top-down", row_time_us=10, **settings).frame_shape == (6, 8)
    with pytest.raises(rb.InputError, match="run.sif: found 3 frames"):
        rb.reconstruct(tmp_path / "run.sif", camera, psf)
    counts = (1000 * capture.frame / capture.frame.max()).round()
    write_sif(tmp_path / "one.sif", counts[None])
    found = rb.reconstruct(tmp_path / "one.sif", camera, psf, prior="tv", max_iterations=5)
    expected = rb.reconstruct(counts.astype(np.uint16), camera, psf, prior="tv", max_iterations=5)
    np.testing.assert_array_equal(found.video, expected.video)
    reconstructor = rb.Reconstructor(camera, psf, prior="tv", max_iterations=5)
    np.testing.assert_array_equal(next(reconstructor.map(tmp_path / "one.sif")).video, expected.video)
    write_sif(tmp_path / "half.sif", FRAMES)
    (tmp_path / "half.sif").write_bytes((tmp_path / "half.sif").read_bytes()[:-100])
    with pytest.raises(rb.InputError, match="half.sif: found a file that its reader cannot read"):
        rb.read_frames(tmp_path / "half.sif")
    with pytest.raises(rb.InputError, match="no such file"):
        rb.read_frames(tmp_path / "none.sif")
    with pytest.raises(rb.InputError, match="no such file"):
        rb.read_settings(tmp_path / "one.tif")


def test_frames_of_hamamatsu(tmp_path):
    pytest.importorskip("dcimg")
    write_dcimg(tmp_path / "run.dcimg", FRAMES)
    np.testing.assert_array_equal(rb.read_frames(tmp_path / "run.dcimg"), FRAMES)
    assert rb.read_settings(tmp_path / "run.dcimg") == {"rows": 6, "columns": 8}
    tall = np.arange(2 * 1030 * 8, dtype=np.uint16).reshape(2, 1030, 8)
    write_dcimg(tmp_path / "tall.dcimg", tall)
    np.testing.assert_array_equal(rb.read_frames(tmp_path / "tall.dcimg"), tall)
    (tmp_path / "bad.dcimg").write_bytes(b"DCIMG" + bytes(2000))
    with pytest.raises(rb.InputError, match="bad.dcimg: found a file that its reader cannot read"):
        rb.read_frames(tmp_path / "bad.dcimg")


def test_frames_of_pco(tmp_path, capsys):
    pytest.importorskip("pco_tools")
    tifffile = pytest.importorskip("tifffile")
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, frame in zip(("a_2.b16", "a_10.b16", "a_11.b16"), FRAMES, strict=True):
        write_b16(folder / name, frame)
    np.testing.assert_array_equal(rb.read_frames(folder / "a_2.b16"), FRAMES[:1])
    np.testing.assert_array_equal(rb.read_frames(folder), FRAMES)
    tifffile.imwrite(tmp_path / "run.tif", FRAMES, bigtiff=True, photometric="minisblack")
    (tmp_path / "run.tif").rename(tmp_path / "run.pcoraw")
    np.testing.assert_array_equal(rb.read_frames(tmp_path / "run.pcoraw"), FRAMES)
    tifffile.imwrite(tmp_path / "colour.tif", np.zeros((4, 6, 8, 3), np.uint8), photometric="rgb")
    (tmp_path / "colour.tif").rename(tmp_path / "colour.pcoraw")
    with pytest.raises(rb.InputError, match="colour.pcoraw: found a file that its reader cannot read"):
        rb.read_frames(tmp_path / "colour.pcoraw")
    (folder / "a_3.b16").write_bytes(b"nothing of the kind, but long enough")
    with pytest.raises(rb.InputError, match="a_3.b16: Error: Not a PCO file"):
        rb.read_frames(folder)
    assert capsys.readouterr().out == ""


def test_without_its_reader_the_remedy_is_named(tmp_path, monkeypatch):
    (tmp_path / "run.sif").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "sif_parser", None)
    with pytest.raises(rb.InputError, match="pip install sif_parser"):
        rb.read_frames(tmp_path / "run.sif")


def test_files_of_makers_go_wherever_a_frame_goes(tmp_path, capture, camera, psf):
    pytest.importorskip("sif_parser")
    counts = (1000 * capture.frame / capture.frame.max()).round().astype(np.uint16) + np.uint16(20)
    dark, flat = np.full(counts.shape, 20, np.uint16), np.full(counts.shape, 900, np.uint16)
    paths = {}
    for name, frame in (("frame", counts), ("dark", dark), ("flat", flat)):
        paths[name] = tmp_path / f"{name}.sif"
        write_sif(paths[name], frame[None])
    options = dict(prior="tv", max_iterations=5)
    found = rb.reconstruct(paths["frame"], camera, psf, dark=paths["dark"], flat=paths["flat"], **options)
    expected = rb.reconstruct(counts, camera, psf, dark=dark, flat=flat, **options)
    np.testing.assert_array_equal(found.video, expected.video)
    mosaic = camera.replace(bayer="rggb")
    colour = [rb.reconstruct_colour(frame, mosaic, psf, **options).video for frame in (paths["frame"], counts)]
    np.testing.assert_array_equal(*colour)
    chunked = [
        rb.reconstruct_chunked(frame, tmp_path / str(i), camera, psf, bins_per_chunk=6, **options).video
        for i, frame in enumerate((paths["frame"], counts))
    ]
    np.testing.assert_array_equal(*chunked)
    looks = [rb.LiveView(camera, psf, prior="tv").next(frame).video for frame in (paths["frame"], counts)]
    np.testing.assert_array_equal(*looks)
    data_term = rb.operator(camera, psf).data_term
    assert data_term(paths["frame"])(capture.truth.ravel()) == data_term(counts)(capture.truth.ravel())


def test_files_of_makers_calibrate(tmp_path):
    pytest.importorskip("sif_parser")
    rng = np.random.default_rng(11)
    darks = rng.normal(100, 4, (20, 48, 40)).round().astype(np.uint16)
    light = np.repeat([200.0, 800.0, 2000.0, 5000.0], 4)[:, None, None]
    flats = (rng.normal(100, 4, (16, 48, 40)) + rng.poisson(0.5 * light, (16, 48, 40)) / 0.5).round().astype(np.uint16)
    write_sif(tmp_path / "darks.sif", darks)
    for i, half in enumerate((flats[:8], flats[8:])):
        write_sif(tmp_path / f"flats{i}.sif", half)
    found = rb.calibrate.sensor(tmp_path / "darks.sif", [tmp_path / "flats0.sif", tmp_path / "flats1.sif"])
    assert found.numbers == rb.calibrate.sensor(darks, flats).numbers
    large = rb.Camera(rows=96, columns=96, shutter="top-down", row_time_us=10, exposure_us=10)
    speckle = rb.speckle_psf(large, diffuser_deg=0.4).array
    point = (100 + 40000 * speckle / speckle.max()).astype(np.uint16)
    write_sif(tmp_path / "point.sif", np.stack([point, point]))
    write_sif(tmp_path / "dark.sif", np.full((1, *point.shape), 100, np.uint16))
    of_file = rb.calibrate.psf(tmp_path / "point.sif", dark=tmp_path / "dark.sif")
    of_array = rb.calibrate.psf(np.stack([point, point]), dark=np.full(point.shape, 100, np.uint16))
    np.testing.assert_array_equal(of_file.psf.array, of_array.psf.array)
    row = np.arange(512)[:, None] * 9.6e-6
    led = (1000 + 600 * np.sin(2 * np.pi * 2000 * row) + rng.normal(0, 8, (512, 40))).round().astype(np.uint16)
    write_sif(tmp_path / "led.sif", led[None])
    expected = rb.calibrate.timing(led, frequency_hz=2000).numbers
    for frames in (tmp_path / "led.sif", [tmp_path / "led.sif"]):
        assert rb.calibrate.timing(frames, frequency_hz=2000).numbers == expected


def test_an_experiment_takes_the_metadata_of_makers(tmp_path):
    pytest.importorskip("sif_parser")
    write_sif(tmp_path / "run.sif", FRAMES)
    (tmp_path / "experiment.toml").write_text('[camera]\nshutter = "top-down"\nrow_time_us = 10\n')
    experiment = rb.Experiment(tmp_path / "experiment.toml", frame=tmp_path / "run.sif")
    assert experiment.camera.frame_shape == (6, 8) and experiment.camera.exposure_us == 30.0
    assert set(experiment.metadata_taken) >= {"rows", "columns", "exposure_us"}
    assert rb.read_settings(tmp_path / "run.sif") == {"rows": 6, "columns": 8, "exposure_us": 30.0}


# What Micro-Manager writes into tag 51123 for a frame of a Zyla, after its description of the format.
MICRO_MANAGER = {
    "Width": 8, "Height": 6, "Exposure-ms": 0.03, "BitDepth": 16, "Binning": "2", "PixelSizeUm": 6.5, "Camera": "Andor",
    "Core-Camera": "Andor", "Andor-LightScanPlus-ExposedPixelHeight": "1",
}  # fmt: skip


def test_metadata_of_micro_manager_fill_a_camera(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    import json

    tag = (51123, 2, None, json.dumps(MICRO_MANAGER), True)
    tifffile.imwrite(tmp_path / "run.ome.tif", FRAMES, metadata={"axes": "TYX"}, extratags=[tag])
    settings = rb.read_settings(tmp_path / "run.ome.tif")
    assert settings["exposure_us"] == 30.0 and settings["bit_depth"] == 16 and settings["binning"] == 2
    assert (settings["rows"], settings["columns"]) == (6, 8)
    camera = rb.Camera(**({"shutter": "dual-inside-out", "row_time_us": 9.6} | settings))
    assert camera.frame_shape == (6, 8) and camera.exposure_us == 30.0
    np.save(tmp_path / "plain.npy", FRAMES)
    assert rb.read_settings(tmp_path / "plain.npy") == {}


def write_ndtiff(folder, axes_of):
    """A dataset as Pycro-Manager leaves it: an image for each combination of axes."""
    ndtiff = pytest.importorskip("ndtiff")
    folder.mkdir()
    data = ndtiff.NDTiffDataset(str(folder), summary_metadata={"Prefix": "run"}, writable=True)
    for axes, frame in axes_of:
        data.put_image(axes, frame, MICRO_MANAGER)
    data.finish()
    data.close()


def test_datasets_of_ndtiff(tmp_path, capture, camera, psf):
    pytest.importorskip("ndtiff")
    write_ndtiff(tmp_path / "time", [({"time": i}, frame) for i, frame in enumerate(FRAMES)])
    np.testing.assert_array_equal(rb.read_frames(tmp_path / "time"), FRAMES)
    settings = rb.read_settings(tmp_path / "time")
    assert settings["exposure_us"] == 30.0 and settings["rows"] == 6 and settings["binning"] == 2
    (tmp_path / "experiment.toml").write_text('[camera]\nshutter = "top-down"\nrow_time_us = 10\n')
    assert rb.Experiment(tmp_path / "experiment.toml", frame=tmp_path / "time").camera.exposure_us == 30.0
    both = [({"channel": name, "time": i}, frame + np.uint16(k)) for i, frame in enumerate(FRAMES) for k, name in enumerate("ab")]
    write_ndtiff(tmp_path / "two", both)
    with pytest.raises(rb.InputError, match="2 channels.*channel=0"):
        rb.read_frames(tmp_path / "two")
    for channel in (0, 1):
        np.testing.assert_array_equal(rb.read_frames(tmp_path / "two", channel=channel), FRAMES + np.uint16(channel))
    with pytest.raises(rb.InputError, match="channel: found 2"):
        rb.read_frames(tmp_path / "two", channel=2)
    write_ndtiff(tmp_path / "deep", [({"z": i, "time": 0}, frame) for i, frame in enumerate(FRAMES)])
    with pytest.raises(rb.InputError, match="3 values of the axis z"):
        rb.read_frames(tmp_path / "deep")
    counts = (1000 * capture.frame / capture.frame.max()).round().astype(np.uint16)
    write_ndtiff(tmp_path / "one", [({"time": 0}, counts)])
    options = dict(prior="tv", max_iterations=3)
    video = rb.reconstruct(tmp_path / "one", camera, psf, **options).video
    np.testing.assert_array_equal(video, rb.reconstruct(counts, camera, psf, **options).video)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "NDTiff.index").write_bytes(b"nothing of the kind")
    with pytest.raises(rb.InputError, match="dataset that ndtiff cannot read"):
        rb.read_frames(tmp_path / "bad")
