"""Calibration and design from Python: the numbers of the command line, and that they are right."""

import json
import os
import pickle
import subprocess

import numpy as np
import pytest

import rowburst as rb

PROGRAM = os.environ.get("ROWBURST")
NEEDS_PROGRAM = pytest.mark.skipif(not PROGRAM, reason="ROWBURST does not name the program")


def numbers_from_command(arguments):
    done = subprocess.run([PROGRAM, *map(str, arguments), "--json"], check=True, capture_output=True)
    return json.loads(done.stdout)


def without(numbers, *names):
    return {name: value for name, value in numbers.items() if name not in names}


def rounded(value):
    """The same with twelve digits of each number."""
    if isinstance(value, dict):
        return {name: rounded(part) for name, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    return float(f"{value:.12g}") if isinstance(value, float) else value


@pytest.fixture(scope="module")
def captures():
    """20 darks and 16 flats at four levels, with a gain of 0.5 electrons per count, and ten hot pixels."""
    rng = np.random.default_rng(11)
    offset = rng.normal(100, 1, (48, 40))
    offset.flat[rng.choice(offset.size, 10, replace=False)] += 400
    read = lambda n: offset + rng.normal(0, 4, (n, 48, 40))
    darks = read(20).round().astype(np.uint16)
    light = np.repeat([200.0, 800.0, 2000.0, 5000.0], 4)[:, None, None]
    flats = (read(16) + rng.poisson(0.5 * light, (16, 48, 40)) / 0.5).round().astype(np.uint16)
    return darks, flats


@pytest.fixture(scope="module")
def sensor(captures):
    return rb.calibrate.sensor(*captures)


def test_a_sensor_is_what_it_was_simulated_as(sensor, captures):
    darks, flats = captures
    fields = sensor.camera_fields
    assert abs(fields["gain_electrons_per_count"] - 0.5) < 0.03
    assert abs(fields["read_noise_electrons"] - 2) < 0.1 and abs(fields["bias_counts"] - 100) < 0.5
    np.testing.assert_allclose(sensor.dark, darks.mean(axis=0), rtol=1e-5)
    assert sensor.bad_pixels.dtype == bool and sensor.bad_pixels.sum() == sensor.numbers["bad_pixels"] >= 10
    assert sensor.response.shape == sensor.flat.shape == sensor.read_noise.shape == (48, 40)
    camera = rb.Camera(rows=48, columns=40, shutter="top-down", row_time_us=10, exposure_us=10)
    changed = camera.replace(**fields)
    assert changed.bias_counts == fields["bias_counts"] and changed.rows == 48 and camera.bias_counts is None
    with pytest.raises(TypeError):
        camera.replace(bias=3)


def test_frames_of_files_lists_and_arrays_are_the_same(sensor, captures, tmp_path):
    darks, flats = captures
    np.save(tmp_path / "darks.npy", darks)
    (tmp_path / "flats").mkdir()
    for i, flat in enumerate(flats):
        np.save(tmp_path / "flats" / f"{i:02}.npy", flat)
    for given in ((tmp_path / "darks.npy", str(tmp_path / "flats")), (list(darks), [flats[:8], *flats[8:]])):
        assert rb.calibrate.sensor(*given).numbers == sensor.numbers
    if PROGRAM:
        theirs = numbers_from_command(["calibrate", "sensor", "--darks", tmp_path / "darks.npy", "--flats", tmp_path / "flats", "-o", tmp_path / "out"])
        assert theirs == sensor.numbers
        sensor.save(tmp_path / "ours")
        np.testing.assert_array_equal(rb.read_frames(tmp_path / "ours" / "bad_pixels.png")[0] > 0, sensor.bad_pixels)
        for name in ("dark.npy", "flat.npy", "response.npy", "sensor.toml", "sensor.json"):
            assert (tmp_path / "ours" / name).read_bytes() == (tmp_path / "out" / name).read_bytes(), name
        assert "Rowburst: sensor" in (tmp_path / "ours" / "report.html").read_text(encoding="utf-8")
    with pytest.raises(rb.InputError, match="darks: found 1 frame"):
        rb.calibrate.sensor(darks[0], flats)


@pytest.fixture(scope="module")
def speckle():
    """A capture of a point source behind a diffuser, in counts, and its dark."""
    camera = rb.Camera(rows=96, columns=96, shutter="top-down", row_time_us=10, exposure_us=10)
    light = rb.speckle_psf(camera, diffuser_deg=0.4, seed=3).array
    dark = np.full(light.shape, 100, np.uint16)
    return (100 + 40000 * light / light.max()).round().astype(np.uint16), dark


def test_a_psf_is_that_of_the_capture_and_of_the_command_line(speckle, tmp_path):
    capture, dark = speckle
    found = rb.calibrate.psf(capture, dark=dark)
    assert found.numbers["contrast"] > 0.7 and found.psf.shape == capture.shape
    light = capture.astype(float) - 100
    middle = np.array(found.numbers["middle_px"]) - np.array(capture.shape) // 2
    shifted = np.roll(light, (-np.round(middle)).astype(int), axis=(0, 1))
    assert np.corrcoef(shifted.ravel(), found.psf.array.ravel())[0, 1] > 0.8
    # Several captures of one place are averaged.
    twice = rb.calibrate.psf([capture, capture], dark=dark)
    assert twice.numbers["captures"] == 2 and abs(twice.numbers["contrast"] - found.numbers["contrast"]) < 1e-3
    if PROGRAM:
        np.save(tmp_path / "point.npy", capture)
        np.save(tmp_path / "dark.npy", dark)
        theirs = numbers_from_command(["calibrate", "psf", tmp_path / "point.npy", "--dark", tmp_path / "dark.npy", "-o", tmp_path / "out"])
        assert theirs == found.numbers
        np.testing.assert_array_equal(np.load(found.save(tmp_path / "ours") / "psf.npy"), np.load(tmp_path / "out" / "psf.npy"))
    with pytest.raises(rb.InputError, match="expected_grain_px"):
        rb.calibrate.psf(capture, expected_grain_px=-1)
    with pytest.raises(rb.InputError, match="positions_mm"):
        rb.calibrate.psf(capture, positions_mm=[1, 2])


def test_the_blur_of_a_pinhole_is_removed(speckle, tmp_path):
    capture, dark = speckle
    camera = rb.Camera(rows=96, columns=96, shutter="top-down", row_time_us=10, exposure_us=10, pixel_pitch_um=6.5, magnification=0.5)
    found = rb.calibrate.psf(capture, dark=dark, camera=camera, pinhole_um=13)
    assert found.numbers["capture"]["pinhole_px"] == 1.0
    plain = rb.calibrate.psf(capture, dark=dark, camera=camera)
    assert found.psf.array.std() > plain.psf.array.std()
    # How it was captured stays with a PSF: in a file, and when pickled.
    read = rb.Psf.from_file(found.save(tmp_path / "psf") / "psf.npy", camera)
    assert read == found.psf != rb.Psf(found.psf.array)
    assert pickle.loads(pickle.dumps(read)) == read
    with pytest.raises(rb.InputError, match="pinhole_um: found 13.*pixel_pitch_um"):
        rb.calibrate.psf(capture, pinhole_um=13)


def test_positions_give_the_memory_effect(speckle, tmp_path):
    capture, dark = speckle
    steps = np.arange(-2, 3)
    moved = [np.roll(capture, 6 * step, axis=0) for step in steps]
    positions = [(0.1 * step, 0.0) for step in steps]
    found = rb.calibrate.psf(moved, dark=dark, positions_mm=positions)
    assert abs(found.numbers["shift_px_per_mm"] - 60) < 1.5
    with pytest.raises(rb.InputError, match="4 positions; each of the 5 captures"):
        rb.calibrate.psf(moved, positions_mm=positions[1:])
    if PROGRAM:
        for i, one in enumerate(moved):
            np.save(tmp_path / f"{i}.npy", one)
        np.save(tmp_path / "dark.npy", dark)
        (tmp_path / "scan.csv").write_text("".join(f"{i}.npy,{x},{y}\n" for i, (y, x) in enumerate(positions)))
        files = [tmp_path / f"{i}.npy" for i in range(5)]
        theirs = numbers_from_command(["calibrate", "psf", *files, "--dark", tmp_path / "dark.npy", "--positions-mm", tmp_path / "scan.csv", "-o", tmp_path / "out"])
        # The sums of the memory effect differ in the last bit from run to run, on the command line too.
        assert rounded(without(theirs, "left_out")) == rounded(without(found.numbers, "left_out"))


@pytest.fixture(scope="module")
def stripes():
    """A light of 2 kHz on a top-down shutter of 9.6 µs a row."""
    time = np.arange(512)[:, None] * 9.6e-6
    frame = 1000 + 600 * np.sin(2 * np.pi * 2000 * time) + np.random.default_rng(2).normal(0, 8, (512, 40))
    return frame.round().astype(np.uint16)


def test_timing_is_that_of_the_light_and_of_the_command_line(stripes, tmp_path):
    found = rb.calibrate.timing(stripes, frequency_hz=2000)
    assert abs(found.row_time_us - 9.6) < 5 * found.row_time_us_error < 0.05
    assert "top-down" in found.shutters and found.camera_fields["row_time_us"] == found.row_time_us
    several = rb.calibrate.timing([stripes, stripes[:, ::-1]], frequency_hz=2000)
    assert several.numbers["frames"] == 2
    camera = rb.Camera(rows=512, columns=40, shutter="top-down", row_time_us=10, exposure_us=10)
    known = rb.calibrate.timing(stripes, frequency_hz=2000, camera=camera)
    assert abs(camera.replace(**known.camera_fields).row_time_us - 9.6) < 0.01
    times = np.arange(0, 6000, 5.0)
    course = np.column_stack([times, np.sin(2 * np.pi * 2000 * times * 1e-6)])
    by_waveform = rb.calibrate.timing(stripes, signal=course, camera=camera)
    assert abs(by_waveform.row_time_us - 9.6) < 0.05
    if PROGRAM:
        np.save(tmp_path / "led.npy", stripes)
        theirs = numbers_from_command(["calibrate", "timing", tmp_path / "led.npy", "--frequency-hz", "2000"])
        assert theirs == found.numbers
        found.save(tmp_path / "ours")
        assert json.loads((tmp_path / "ours" / "timing.json").read_text()) == theirs
    with pytest.raises(rb.InputError, match="frequency_hz or signal"):
        rb.calibrate.timing(stripes)


def test_a_design_has_the_numbers_from_command_the_command_line(tmp_path):
    plain = rb.design(trials=False)
    assert round(plain.numbers["frame_rate_hz"]) == 104167 and "Speckle" in str(plain)
    camera = rb.Camera(rows=24, columns=24, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    parts = []
    tried = rb.design(camera, trial_snr=[64, 16], diffuser_deg=2.0, progress=parts.append)
    assert tried.numbers["success_map"]["snr"] == [16, 64] and parts == sorted(parts) and parts[-1] <= 1
    page = tried.save(tmp_path / "ours")
    assert "Rowburst: design" in (page / "report.html").read_text(encoding="utf-8")
    assert "Sparsity" in tried._repr_html_() and "warnings" in repr(tried)
    if PROGRAM:
        assert without(numbers_from_command(["design", "--quick"]), "seconds") == without(plain.numbers, "seconds")
        theirs = numbers_from_command(["design", "--rows", "24", "--columns", "24", "--diffuser-deg", "2", "--trial-snr", "16,64"])
        assert without(theirs, "seconds") == without(tried.numbers, "seconds")
    with pytest.raises(rb.InputError, match="trial_snr"):
        rb.design(trial_snr=[-1])
