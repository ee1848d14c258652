"""Mistakes that an audit found in the extension: what is refused, what is read, and in which words."""

import os
import subprocess
import sys

import numpy as np
import pytest

import rowburst as rb
from rowburst import _makers

TV = dict(prior="tv", max_iterations=5)


def refused(call, *words):
    """The error of a call, whose message has the words."""
    with pytest.raises((rb.InputError, rb.WorkError)) as raised:
        call()
    for word in words:
        assert word in str(raised.value), raised.value
    return raised.value


def said(program, *arguments):
    """What a program prints; one that hangs or is killed fails the test."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    return done.stdout


# Memory


@pytest.mark.skipif(sys.platform != "linux", reason="the size of the memory is asked of Linux")
@pytest.mark.parametrize("call", ["A.rmatvec(frame)", "A.rmatvec(frame.astype(np.float64))", "A.data_term(frame.reshape(A.frame_shape))"])
def test_an_operator_asks_for_the_memory(call):
    """The limit ends a program that allocates unasked, before the machine suffers."""
    program = f"""
import resource
import numpy as np, rowburst as rb
resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
vast = rb.Camera(rows=4096, columns=4096, shutter="top-down", row_time_us=10, exposure_us=10, bins_per_row=8)
A = rb.operator(vast, np.eye(3))
frame = np.random.default_rng(1).uniform(1, 2, 4096 * 4096).astype(np.float32)
try:
    {call}
except rb.WorkError as error:
    print(error.kind, error)
"""
    found = said(program)
    assert found.startswith("memory") and "no memory for a video of 32768×4096×4096" in found


def test_a_stack_in_the_place_of_a_frame_is_refused_by_its_header(camera, psf, tmp_path):
    path = tmp_path / "stack.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<u2", "fortran_order": False, "shape": (4000, 2048, 2048)})
    error = refused(lambda: rb.reconstruct(path, camera, psf), "a stack of 4000 pages of 2048×2048")
    assert (error.kind, error.path) == ("shape", str(path))


def test_a_truth_of_another_shape_is_refused_by_its_header(camera, psf, capture, tmp_path):
    path = tmp_path / "truth.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (4000, 24, 30)})
    for call in (
        lambda: rb.reconstruct(capture.frame, camera, psf, truth=path, **TV),
        lambda: rb.Reconstructor(camera, psf, **TV)(capture.frame, truth=str(path)),
    ):
        error = refused(call, "found 4000×24×30", "the camera gives a video of 12×24×30")
        assert (error.parameter, error.path) == ("truth", str(path))
    np.save(path, capture.truth)
    by_path, by_array = (rb.reconstruct(capture.frame, camera, psf, truth=truth, **TV) for truth in (path, capture.truth))
    assert by_path.numbers["psnr_db"] == by_array.numbers["psnr_db"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_other_threads_run_while_a_frame_is_read(tmp_path):
    """A pipe is opened once the other thread opens it, too."""
    os.mkfifo(tmp_path / "frame.npy")
    found = said(
        """
import sys, threading, time
import numpy as np, rowburst as rb
def write():
    time.sleep(0.3)
    open(sys.argv[1], "wb").close()
camera = rb.Camera(rows=4, columns=4, shutter="top-down", row_time_us=10, exposure_us=10)
threading.Thread(target=write, daemon=True).start()
try:
    rb.reconstruct(sys.argv[1], camera, np.eye(3))
except rb.InputError as error:
    print(error)
""",
        tmp_path / "frame.npy",
    )
    assert "an empty file" in found


# Masks of Dask


@pytest.fixture(scope="module")
def masked(camera, capture):
    """Frames with masks, of which the first one is spoiled where it is masked."""
    masks = np.zeros((2, *camera.frame_shape), bool)
    masks[0, 3, 4] = masks[0, 10, 20] = True
    frames = np.stack([capture.frame, capture.frame])
    frames[masks] = 50 * frames.max()
    return frames, masks


def test_masked_pixels_of_a_dask_frame_are_bad(camera, psf, capture, masked):
    da = pytest.importorskip("dask.array")
    frames, masks = masked
    theirs = da.ma.masked_array(da.from_array(frames, chunks=(1, 12, -1)), mask=da.from_array(masks, chunks=(1, 12, -1)))
    expected = rb.reconstruct(np.ma.masked_array(frames[0], masks[0]), camera, psf, **TV).video
    reconstructor = rb.Reconstructor(camera, psf, **TV)
    for found in (rb.reconstruct(theirs[0], camera, psf, **TV), reconstructor(theirs[0]), next(reconstructor.map(theirs))):
        np.testing.assert_array_equal(found.video, expected)
    # A mask in the dark is one of bad pixels as well.
    dark, plain = np.zeros(camera.frame_shape, np.float32), capture.frame
    by_dask = da.ma.masked_array(da.from_array(dark), mask=da.from_array(masks[0]))
    by_numpy = np.ma.masked_array(dark, masks[0])
    np.testing.assert_array_equal(
        rb.reconstruct(plain, camera, psf, dark=by_dask, **TV).video,
        rb.reconstruct(plain, camera, psf, dark=by_numpy, **TV).video,
    )
    refused(lambda: rb.Psf(da.ma.masked_equal(da.from_array(np.eye(3)), 0)), "a masked array with 6 masked values")


def test_masked_pixels_of_a_dask_recording_are_bad(camera, psf, masked, tmp_path):
    da, zarr = pytest.importorskip("dask.array"), pytest.importorskip("zarr")
    frames, masks = masked
    theirs = da.ma.masked_array(da.from_array(frames, chunks=(1, -1, -1)), mask=da.from_array(masks, chunks=(1, -1, -1)))
    for name, recording in (("numpy", np.ma.masked_array(frames, masks)), ("dask", theirs)):
        assert rb.batch(recording, tmp_path / f"{name}.zarr", camera, psf, **TV)["done"] == 2
    found = [zarr.open(str(tmp_path / f"{name}.zarr"))["0"][...] for name in ("numpy", "dask")]
    np.testing.assert_array_equal(*found)


def test_masked_pixels_of_xarray_are_bad(camera, psf, masked):
    """xarray replaces masked values by NaN, in older versions when Dask computes them."""
    da, xarray = pytest.importorskip("dask.array"), pytest.importorskip("xarray")
    frames, masks = masked
    dims = ("frame", "y", "x")
    by_dask = da.ma.masked_array(da.from_array(frames, chunks=(1, 12, -1)), mask=da.from_array(masks, chunks=(1, 12, -1)))
    expected = rb.reconstruct(np.ma.masked_array(frames[0], masks[0]), camera, psf, **TV).video
    reconstructor = rb.Reconstructor(camera, psf, **TV)
    for theirs in (xarray.DataArray(by_dask, dims=dims), xarray.DataArray(np.ma.masked_array(frames, masks), dims=dims)):
        for found in (rb.reconstruct(theirs[0], camera, psf, **TV), reconstructor(theirs[0]), next(reconstructor.map(theirs))):
            np.testing.assert_array_equal(found.video, expected)
    # Nothing is masked: the integers of a raw capture stay integers.
    counts = np.rint(1000 * frames[1] / frames[1].max()).astype(np.uint16)
    biased = camera.replace(bias_counts=10)
    raw = xarray.DataArray(da.from_array(counts), dims=dims[1:])
    np.testing.assert_array_equal(
        rb.reconstruct(raw, biased, psf, **TV).video, rb.reconstruct(counts, biased, psf, **TV).video
    )
    refused(lambda: rb.Psf(xarray.DataArray([[1.0, np.nan]])), "a masked array with 1 masked values")


# Integers of many digits


@pytest.mark.parametrize("dtype", ["uint32", "int32", "uint64", "int64"])
def test_integers_keep_all_their_digits(dtype, tmp_path):
    top = np.iinfo(dtype).max
    frames = np.array([[[2**24 + 1, top], [3, 4]], [[top - 1, 2**24 + 3], [5, 6]]], dtype)
    np.save(tmp_path / "stack.npy", frames)
    (tmp_path / "folder").mkdir()
    for i, frame in enumerate(frames):
        np.save(tmp_path / "folder" / f"{i}.npy", np.asfortranarray(frame))
    paths = [tmp_path / "stack.npy", tmp_path / "folder"]
    try:
        import zarr

        array = zarr.create_array(str(tmp_path / "stack.zarr"), shape=frames.shape, chunks=(1, 2, 2), dtype=dtype)
        array[...] = frames
        paths.append(tmp_path / "stack.zarr")
    except ImportError:
        pass
    try:
        import tifffile

        if dtype.endswith("32"):
            tifffile.imwrite(tmp_path / "stack.tif", frames, photometric="minisblack")
            paths.append(tmp_path / "stack.tif")
    except ImportError:
        pass
    for path in paths:
        found = rb.read_frames(path)
        assert found.dtype == dtype, path
        np.testing.assert_array_equal(found, frames)
        one = rb._rowburst._Frames(path)[1]
        assert one.dtype == dtype
        np.testing.assert_array_equal(one, frames[1])


# Batches


def test_a_batch_of_no_frame_is_refused(camera, psf, tmp_path):
    error = refused(lambda: rb.batch(np.zeros((0, 24, 30)), tmp_path / "out.zarr", camera, psf), "at least one frame", "length 0")
    assert (type(error), error.parameter) == (rb.InputError, "frames")


def test_a_frame_that_fails_is_named_once(camera, psf, capture, tmp_path):
    lines = [np.ones(5), np.ones(5)]
    error = refused(lambda: rb.batch(lines, tmp_path / "none.zarr", camera, psf, **TV), "none of its 2 frames", "two axes")
    assert str(error).count("frame 0") == 1 and ".." not in str(error)
    summary = rb.batch([capture.frame, np.ones(5), capture.frame], tmp_path / "some.zarr", camera, psf, **TV)
    assert summary["failed"] == 1
    (warning,) = summary["warnings"]
    assert warning.startswith("no video of frame 1: found an array") and warning.count("frame 1") == 1


# Words


def test_words_are_those_of_python(camera, psf, capture, result, tmp_path):
    error = refused(lambda: rb.design(progress=lambda part: False), "trials=False")
    assert "Use trials for" not in str(error)
    error = refused(lambda: result.save(tmp_path / "saved", formats=["avi"]), '"avi"', "npy, tif")
    assert error.parameter == "formats" and "no spaces" not in str(error)
    chunked = lambda camera, **options: rb.reconstruct_chunked(capture.frame, tmp_path / "chunks", camera, psf, prior="tv", **options)
    error = refused(lambda: chunked(camera, bins=(5, 3)), "bins=(FIRST, END)")
    assert "FIRST..END" not in str(error) and error.parameter == "bins"
    error = refused(lambda: chunked(camera.replace(shutter="global")), "Call `rb.reconstruct`")
    assert "bins_per_chunk" not in error.remedy
    error = refused(lambda: rb.simulate(camera, "digits", psf, digit_px=0), "digit_px: found 0")
    assert str(error).count("digit_px") == 1


def test_the_parameter_at_fault_is_data(camera, psf, capture):
    for name, call in (
        ("seed", lambda: rb.simulate(camera, "digits", psf, seed=-1)),
        ("seed", lambda: rb.reconstruct(capture.frame, camera, psf, seed=-1)),
        ("digit_px", lambda: rb.simulate(camera, "digits", psf, digit_px=-1)),
        ("saturation_counts", lambda: rb.calibrate.psf(capture.frame, saturation_counts=-1.0)),
        ("expected_grain_px", lambda: rb.calibrate.psf(capture.frame, expected_grain_px=-1.0)),
        ("psf", lambda: rb.Psf(np.ones(3))),
    ):
        error = refused(call, "found")
        assert (type(error), error.parameter) == (rb.InputError, name), error
    native = rb._rowburst
    error = refused(lambda: native.reconstruct(capture.frame, camera, psf, guide_exposures_us=[(0.0, 1.0)]))
    assert error.parameter == "guide_exposures_us"
    error = refused(lambda: native._reconstruct_chunked(capture.frame, camera, psf, "none", bins_per_chunk=-1, prior="tv"))
    assert error.parameter == "bins_per_chunk"


# Values


def test_a_truth_value_is_no_number(camera, psf, capture):
    native = rb._rowburst
    for value in (True, np.True_, False):
        for name, call in (
            ("row_time_us", lambda: camera.replace(row_time_us=value)),
            ("exposure_us", lambda: camera.replace(exposure_us=value)),
            ("bias_counts", lambda: camera.replace(bias_counts=value)),
            ("pixel_pitch_um", lambda: camera.replace(pixel_pitch_um=value)),
            ("noise_sigma", lambda: native.reconstruct(capture.frame, camera, psf, noise_sigma=value)),
            ("time_budget_s", lambda: native.reconstruct(capture.frame, camera, psf, time_budget_s=value)),
            ("noise_sigma", lambda: native._Reconstructor(camera, psf, noise_sigma=value)),
            ("noise_sigma", lambda: rb.LiveView(camera, psf, noise_sigma=value)),
            ("time_budget_s", lambda: rb.LiveView(camera, psf).next(capture.frame, time_budget_s=value)),
            ("snr", lambda: rb.simulate(camera, "digits", psf, snr=value)),
            ("background", lambda: rb.simulate(camera, "digits", psf, background=value)),
            ("wavelength_nm", lambda: rb.speckle_psf(camera, wavelength_nm=value)),
        ):
            error = refused(call, f"{name}: found {value}", "not a truth value")
            assert (type(error), error.parameter) == (rb.InputError, name)
    assert camera.replace(row_time_us=10).row_time_us == camera.replace(row_time_us=np.float32(10)).row_time_us == 10
    refused(lambda: camera.replace(row_time_us="ten"), "row_time_us: found 'ten'")


@pytest.mark.parametrize("value", [True, np.True_, "a"])
def test_no_list_and_no_mapping_takes_a_truth_value_for_a_number(value, camera, psf, capture, result):
    frame, pair = capture.frame, [np.eye(5), np.eye(5)[::-1]]
    for name, call in (
        ("tuning[support_threshold]", lambda: rb.reconstruct(frame, camera, psf, tuning={"support_threshold": value})),
        ("tuning[support_threshold]", lambda: rb.Reconstructor(camera, psf, tuning={"support_threshold": value})),
        ("tuning[support_threshold]", lambda: rb.LiveView(camera, psf, tuning={"support_threshold": value})),
        ("guide_exposures_us[1]", lambda: rb.reconstruct(frame, camera, psf, guide=[frame, frame], guide_exposures_us=[(1, 5), (2, value)])),
        ("offsets_px[0]", lambda: rb.Psf.patches(pair, [(value, 0), (10, 0)])),
        ("positions_mm[2]", lambda: rb.calibrate.psf([frame] * 3, positions_mm=[(0, 0), (1, 1), (value, 2)])),
        ("signal[0]", lambda: rb.calibrate.timing(frame, signal=[(value, 1.0), (10, 2.0)])),
        ("exposures_ms[1]", lambda: rb._rowburst._PsfCalibration([frame, frame], exposures_ms=[1.0, value])),
        ("regions", lambda: result.traces([(8, value)])),
    ):
        error = refused(call, f"{name}: found")
        assert type(error) is rb.InputError
    for name, call in (
        ("rows", lambda: camera.replace(rows=value)),
        ("bit_depth", lambda: camera.replace(bit_depth=value)),
        ("field", lambda: camera.replace(field=(24, value))),
        ("row_order", lambda: camera.replace(shutter="custom", row_order=[value, *range(1, 24)])),
        ("threads", lambda: rb.LiveView(camera, psf, threads=value)),
        ("threads", lambda: rb.set_threads(value)),
        ("seed", lambda: rb.simulate(camera, "digits", psf, seed=value)),
    ):
        assert refused(call, f"{name}: found", "whole number from 0").parameter == name


def test_no_machine_has_so_many_threads(camera, psf, capture):
    for call in (
        lambda: rb.set_threads(20000),
        lambda: rb.LiveView(camera, psf, threads=20000),
        lambda: rb.simulate(camera, "digits", psf, threads=20000),
        lambda: rb._rowburst.reconstruct(capture.frame, camera, psf, threads=20000),
    ):
        error = refused(call, "threads: found 20000", "at most")
        assert (type(error), error.parameter) == (rb.InputError, "threads")


def test_values_that_no_frame_makes_right_are_found_without_a_run(camera, psf):
    reconstructor = rb._rowburst._Reconstructor(camera, psf)
    for name, value in (("tau", -1.0), ("tau", "nan"), ("noise_sigma", 0.0), ("noise_sigma", np.inf)):
        assert refused(lambda: reconstructor.check(**{name: value}), "above zero").parameter == name
    reconstructor.check(prior="tv", tau=1e300, noise_sigma=1.0)


# Files


def test_the_images_of_an_ome_tiff_are_not_joined(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    frames = np.random.default_rng(1).integers(0, 4000, (3, 6, 7)).astype(np.uint16)
    for count in (1, 2):
        path = tmp_path / f"{count}.ome.tif"
        with tifffile.TiffWriter(path, ome=True) as file:
            for _ in range(count):
                file.write(frames, photometric="minisblack", metadata={"axes": "TYX"})
    np.testing.assert_array_equal(rb.read_frames(tmp_path / "1.ome.tif"), frames)
    error = refused(lambda: rb.read_frames(tmp_path / "2.ome.tif"), "2 images (series)", "a file of its own")
    assert error.path == str(tmp_path / "2.ome.tif")


def test_a_psf_may_be_a_file_of_a_camera_maker(monkeypatch, camera, psf, tmp_path):
    counts = np.round(1000 * psf.array / psf.array.max()).astype(np.uint16)
    monkeypatch.setattr(_makers, "frame_of_maker", lambda path: counts)
    for name in ("psf.b16", "psf.sif"):
        np.testing.assert_array_equal(rb.Psf.from_file(tmp_path / name, camera).array, rb.Psf(counts).array)
