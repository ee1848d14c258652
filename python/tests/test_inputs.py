"""What users give by mistake, and what they may give: each refused in clear words, or taken for what it is."""

import os
import subprocess
import sys

import numpy as np
import pytest

import rowburst as rb

TV = {"prior": "tv", "max_iterations": 8}
CAMERA = {"rows": 24, "columns": 30, "shutter": "dual-inside-out", "row_time_us": 9.6, "exposure_us": 9.6}


def program():
    found = os.environ.get("ROWBURST")
    if not found:
        pytest.skip("ROWBURST does not name the program")
    return found


@pytest.fixture
def counts(capture):
    """A raw capture of 16 bits with a bias of 100 and without saturated pixels."""
    return (100 + capture.frame / capture.frame.max() * 30000).astype(np.uint16)


# Colour


def test_a_mosaic_is_refused_and_kept(tmp_path, camera, psf, capture):
    file = tmp_path / "experiment.toml"
    file.write_text(camera.to_toml().replace("exposure_us", 'bayer = "rggb"\nexposure_us'))
    for mosaic in (rb.Camera.from_file(file), rb.Experiment(file).camera, rb.Camera(**CAMERA, bayer="rggb")):
        assert mosaic.bayer == "rggb" and 'bayer = "rggb"' in mosaic.to_toml() and mosaic != camera
        for call in (
            lambda: rb.reconstruct(capture.frame, mosaic, psf),
            lambda: rb.operator(mosaic, psf),
            lambda: rb.LiveView(mosaic, psf),
        ):
            with pytest.raises(rb.InputError, match="bayer: found \"rggb\".*rowburst.reconstruct_colour"):
                call()
    with pytest.raises(rb.InputError, match="bayer.*rggb, bggr"):
        rb.Camera(**CAMERA, bayer="rgb")


# Frames that are no captures


def test_frames_of_two_values_are_refused(camera, psf, capture, tmp_path):
    frame = capture.frame
    thresholded = np.where(frame > frame.mean(), 255, 0).astype(np.uint8)
    with pytest.raises(rb.InputError, match="frame: found only the values 0 and 255.*after a threshold"):
        rb.reconstruct(thresholded, camera, psf)
    with pytest.raises(rb.InputError, match="frame: found an array of bool.*counts"):
        rb.reconstruct(frame > frame.mean(), camera, psf)
    dark = (frame / frame.max() * 1000).astype(np.uint16)
    with pytest.raises(rb.InputError, match="frame.*zero in every pixel.*dark"):
        rb.reconstruct(dark, camera, psf, dark=dark)
    with pytest.raises(rb.InputError, match="frame: found only the values 0 and 1"):
        rb.reconstruct((frame > frame.mean()).astype(np.float32), camera, psf)


def test_the_command_line_refuses_them_too(camera, psf, capture, tmp_path):
    np.save(tmp_path / "psf.npy", psf.array)
    (tmp_path / "experiment.toml").write_text(camera.to_toml() + '[calibration]\npsf = "psf.npy"\n')
    for name, frame in {
        "bytes": np.where(capture.frame > capture.frame.mean(), 255, 0).astype(np.uint8),
        "words": np.where(capture.frame > capture.frame.mean(), 65535, 0).astype(np.uint16),
    }.items():
        np.save(tmp_path / f"{name}.npy", frame)
        done = subprocess.run(
            [program(), "reconstruct", tmp_path / "experiment.toml", "--frame", tmp_path / f"{name}.npy", "-o", tmp_path / name],
            capture_output=True, text=True)
        assert done.returncode == 2 and f"{name}.npy: frame: found only the values 0" in done.stderr, done.stderr


# Bias


def test_the_bias_is_subtracted_from_integers_alone(psf, counts, tmp_path):
    camera = rb.Camera(**CAMERA, bias_counts=100, bit_depth=16)
    flat = np.full(camera.frame_shape, 1100, np.float32)
    flat[5, 6] = 900
    corrected = counts.astype(np.float32) - 100
    for options in ({}, {"flat": flat}):
        raw = rb.reconstruct(counts, camera, psf, **options, **TV)
        done = rb.reconstruct(corrected, camera, psf, **options, **TV)
        np.testing.assert_array_equal(done.video, raw.video)
    # A dark that is given is subtracted from whatever numbers.
    dark = np.full(camera.frame_shape, 100, np.float32)
    raw = rb.reconstruct(counts, camera, psf, **TV)
    explicit = rb.reconstruct(counts.astype(np.float32), camera, psf, dark=dark, **TV)
    np.testing.assert_array_equal(explicit.video, raw.video)
    # A file is a raw capture, as for the command line.
    np.save(tmp_path / "frame.npy", counts.astype(np.float32))
    np.testing.assert_array_equal(rb.reconstruct(tmp_path / "frame.npy", camera, psf, **TV).video, raw.video)
    # Frames that were read have the numbers of their file.
    for dtype in (np.uint16, np.int16, np.uint8, np.int8, np.float32):
        np.save(tmp_path / "frames.npy", np.stack([counts // 300] * 2).astype(dtype))
        frames = rb.read_frames(tmp_path / "frames.npy")
        assert frames.dtype == dtype
        np.testing.assert_array_equal(frames[1], (counts // 300).astype(dtype))
    saturated = corrected.copy()
    saturated[2, 3] = 65535 - 100
    assert rb.reconstruct(saturated, camera, psf, **TV).numbers["saturated_pixels"] == 1
    look = rb.LiveView(camera, psf).next(corrected)
    np.testing.assert_array_equal(look.video, rb.LiveView(camera, psf).next(counts).video)


def test_simulated_frames_are_what_reconstruct_takes(psf, capture):
    camera = rb.Camera(**CAMERA, bias_counts=100, bit_depth=12)
    made = rb.simulate(camera, capture.truth, psf, snr=256, seed=2)
    assert made.frame.dtype == np.uint16 and made.frame.min() >= 90
    clean = rb.simulate(camera, capture.truth, psf, snr=float("inf"))
    predicted = rb.operator(camera, psf) @ clean.truth.ravel()
    np.testing.assert_allclose(clean.frame.ravel(), predicted, rtol=1e-4, atol=1e-4 * predicted.max())
    plain = rb.Camera(**CAMERA, bit_depth=12)
    assert rb.simulate(plain, capture.truth, psf).frame.dtype == np.float32
    found = rb.reconstruct(made.frame, camera, psf, truth=made.truth, prior="tv+0.5*tdiff+support")
    assert found.numbers["psnr_db"] > 25


# Experiments


@pytest.fixture
def experiment(tmp_path, camera, psf, capture):
    """With everything that a file can say."""
    rng = np.random.default_rng(3)
    bad = np.zeros(camera.frame_shape, np.uint8)
    bad[4, 5] = bad[20, 2] = 1
    np.save(tmp_path / "psf.npy", psf.array)
    np.save(tmp_path / "dark.npy", rng.integers(95, 105, camera.frame_shape).astype(np.uint16))
    np.save(tmp_path / "flat.npy", rng.uniform(900, 1100, camera.frame_shape).astype(np.float32))
    np.save(tmp_path / "bad.npy", bad)
    (tmp_path / "experiment.toml").write_text(
        camera.to_toml() + '[calibration]\npsf = "psf.npy"\ndark = "dark.npy"\nflat = "flat.npy"\nbad_pixels = "bad.npy"\n'
        '[reconstruction]\nprior = "l1+support"\ntau = 123.5\n'
    )
    return tmp_path / "experiment.toml"


def test_an_experiment_is_used_whole(experiment, counts, tmp_path):
    np.save(tmp_path / "frame.npy", counts)
    read = rb.Experiment(experiment)
    found = rb.reconstruct(counts, read)
    assert (found.prior, found.tau, found.numbers["bad_pixels"]) == ("l1+support", 123.5, 2)
    spelled_out = rb.reconstruct(
        counts, read.camera, read.psf, dark=read.dark, flat=read.flat, bad_pixels=read.bad_pixels, prior=read.prior, tau=read.tau)
    np.testing.assert_array_equal(found.video, spelled_out.video)
    subprocess.run(
        [program(), "reconstruct", experiment, "--frame", tmp_path / "frame.npy", "-o", tmp_path / "out"],
        check=True, capture_output=True)
    np.testing.assert_array_equal(found.video, np.load(tmp_path / "out" / "video.npy"))
    # What is given takes precedence.
    given = rb.reconstruct(counts, read, prior="tv", tau="auto", bad_pixels=np.zeros_like(counts), max_iterations=5)
    assert given.prior == "tv" and given.tau != 123.5 and given.numbers["bad_pixels"] == 0


def test_an_experiment_without_a_psf_says_so(tmp_path, camera, capture):
    (tmp_path / "experiment.toml").write_text(camera.to_toml())
    read = rb.Experiment(tmp_path / "experiment.toml")
    for call in (
        lambda: rb.reconstruct(capture.frame, read),
        lambda: rb.reconstruct(capture.frame, read.camera, read.psf),
        lambda: rb.operator(read.camera, read.psf),
        lambda: rb.LiveView(read.camera, read.psf),
    ):
        with pytest.raises(rb.InputError, match=r"psf: found None.*point-spread function.*\[calibration\]"):
            call()


def test_a_recipe_passes_the_type_checker(tmp_path):
    script = tmp_path / "recipe.py"
    script.write_text(
        "import numpy as np\nimport rowburst as rb\n"
        'e = rb.Experiment("experiment.toml")\nf = np.ones((2, 2))\n'
        "rb.reconstruct(f, e)\nrb.reconstruct(f, e.camera, e.psf, dark=e.dark, tau=e.tau)\nrb.reconstruct(f, e, tau=None)\n"
        'rb.simulate(e.camera, "scene.npy")\n'
    )
    pytest.importorskip("mypy")
    done = subprocess.run([sys.executable, "-m", "mypy", "--strict", script], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stdout


# Masked arrays


def test_masked_pixels_are_bad_pixels(camera, psf, capture):
    mask = np.zeros(camera.frame_shape, bool)
    mask[3, 4] = mask[10, 20] = True
    spoiled = capture.frame.copy()
    spoiled[mask] = np.nan
    masked = np.ma.masked_invalid(spoiled)
    expected = rb.reconstruct(np.where(mask, 0, capture.frame), camera, psf, bad_pixels=mask, **TV)
    found = rb.reconstruct(masked, camera, psf, **TV)
    np.testing.assert_array_equal(found.video, expected.video)
    assert found.numbers["bad_pixels"] == 2
    # With others, and of a correction.
    more = np.zeros_like(mask)
    more[3, 4] = more[7, 7] = True
    assert rb.reconstruct(masked, camera, psf, bad_pixels=more, **TV).numbers["bad_pixels"] == 3
    dark = np.ma.array(np.zeros(camera.frame_shape), mask=more)
    assert rb.reconstruct(masked, camera, psf, dark=dark, **TV).numbers["bad_pixels"] == 3
    unmasked = np.ma.array(capture.frame)
    plain = rb.reconstruct(capture.frame, camera, psf, **TV)
    np.testing.assert_array_equal(rb.reconstruct(unmasked, camera, psf, **TV).video, plain.video)
    with pytest.raises(rb.InputError, match="PSF.*masked array with 1 masked"):
        rb.reconstruct(capture.frame, camera, np.ma.array(psf.array, mask=psf.array == psf.array.max()))
    # The raw pixels of a binned frame.
    binned = rb.Camera(rows=12, columns=15, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6, binning=2)
    small = np.ones((12, 15), bool)
    small[1:] = False
    with_raw = rb.reconstruct(masked, binned, psf.array[::2, ::2], bad_pixels=more, **TV)
    assert with_raw.numbers["bad_pixels"] == 3
    frame = np.ma.array(capture.frame[::2, ::2], mask=small)
    assert rb.reconstruct(frame, binned, psf.array[::2, ::2], bad_pixels=more, **TV).numbers["bad_pixels"] == 15 + 2


# Cameras


def test_a_custom_shutter_survives_its_file(tmp_path):
    order = [*range(12, 24), *range(12)]
    custom = rb.Camera(**(CAMERA | {"shutter": "custom", "row_order": np.array(order)}))
    assert custom.row_order == order and rb.Camera(**CAMERA).row_order is None
    (tmp_path / "experiment.toml").write_text(custom.to_toml())
    for same in (rb.Camera.from_file(tmp_path / "experiment.toml"), rb.Experiment(tmp_path / "experiment.toml").camera):
        assert same == custom and same.row_order == order


@pytest.mark.parametrize(
    "change",
    [{"rows": -1}, {"columns": -7}, {"binning": -1}, {"bins_per_row": 1 << 80}, {"bit_depth": -8}, {"field": (-24, 30)}, {"rows": True},
     {"shutter": "custom", "row_order": [-1, *range(23)]}],
)
def test_numbers_below_zero_name_their_argument(change):
    name = "row_order" if "row_order" in change else next(iter(change))
    with pytest.raises(rb.InputError, match=f"^{name}: found .*whole number"):
        rb.Camera(**(CAMERA | change))


def test_other_numbers_below_zero(camera, psf, capture):
    with pytest.raises(rb.InputError, match="max_iterations: found -1"):
        rb.reconstruct(capture.frame, camera, psf, max_iterations=-1)
    with pytest.raises(rb.InputError, match="seed: found -1"):
        rb.simulate(camera, "digits", seed=-1)
    with pytest.raises(rb.InputError, match="digit_px: found -2"):
        rb.simulate(camera, "digits", digit_px=-2)
    with pytest.raises(rb.InputError, match="threads: found -2"):
        rb.set_threads(-2)
    assert rb.Camera(**(CAMERA | {"rows": np.int64(24)})) == camera
    with pytest.raises(rb.InputError, match="rows: found 24.5"):
        rb.Camera(**(CAMERA | {"rows": 24.5}))


# Options of a run


def test_mistaken_options_are_refused(camera, psf, capture, result, monkeypatch):
    for tau in (True, False, np.True_):
        with pytest.raises(rb.InputError, match="tau: found (True|False).*above zero"):
            rb.reconstruct(capture.frame, camera, psf, tau=tau)
    for progress in ("x", 1, [print]):
        with pytest.raises(rb.InputError, match="progress: found .*function"):
            rb.reconstruct(capture.frame, camera, psf, progress=progress)
    monkeypatch.setitem(sys.modules, "tqdm", None)
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(rb.InputError, match="pip install tqdm"):
        rb.reconstruct(capture.frame, camera, psf, progress=True)
    for regions in ([(1.7, 2.2)], [("a", 2)], (8, 9), [(np.nan, 1)], [8]):
        with pytest.raises(rb.InputError, match="regions: found .*whole numbers"):
            result.traces(regions)
    assert result.traces([np.array([8.0, 9.0])])[0].region == (7, 8, 3, 3)


@pytest.mark.parametrize("answer", [False, np.False_, np.bool_(0)])
def test_a_false_of_numpy_stops_a_run(answer, camera, psf, capture):
    stopped = rb.reconstruct(capture.frame, camera, psf, prior="tv", progress=lambda p: answer if p.iteration == 4 else np.True_)
    assert (stopped.iterations, stopped.stop_reason) == (4, "interrupted")
    others = rb.reconstruct(capture.frame, camera, psf, **TV, progress=lambda p: 0)
    assert others.stop_reason != "interrupted"


def test_a_scene_may_be_a_file(camera, psf, capture, tmp_path):
    np.save(tmp_path / "scene.npy", capture.truth)
    expected = rb.simulate(camera, capture.truth, psf).frame
    for name in (tmp_path / "scene.npy", str(tmp_path / "scene.npy")):
        np.testing.assert_array_equal(rb.simulate(camera, name, psf).frame, expected)
    with pytest.raises(rb.InputError, match="nowhere.npy.*no such file"):
        rb.simulate(camera, "nowhere.npy", psf)
    with pytest.raises(rb.InputError, match="digits, leds"):
        rb.simulate(camera, "didgits", psf)


# Memory


def test_a_video_beyond_the_memory_is_refused_at_once():
    vast = rb.Camera(rows=4096, columns=4096, shutter="top-down", row_time_us=10, exposure_us=10)
    frame = np.random.default_rng(1).uniform(1, 2, (4096, 4096)).astype(np.float32)
    psf = np.ones((3, 3))
    for call in (lambda: rb.reconstruct(frame, vast, psf), lambda: rb.LiveView(vast, psf), lambda: rb.simulate(vast, "digits", psf)):
        with pytest.raises(rb.WorkError, match="no memory for a video of .* needed.*Make field smaller"):
            call()


def test_arrays_that_are_not_aligned_are_read(capture, camera, psf):
    """Dask's workers unpack arrays at any byte."""
    def misaligned(array):
        raw = np.empty(array.nbytes + 1, np.uint8)
        view = raw[1:].view(array.dtype).reshape(array.shape)
        view[...] = array
        assert not view.flags.aligned
        return view

    options = dict(prior="tv", max_iterations=3)
    found = rb.reconstruct(misaligned(capture.frame), camera, misaligned(psf.array), truth=misaligned(capture.truth), **options)
    expected = rb.reconstruct(capture.frame, camera, psf.array, truth=capture.truth, **options)
    np.testing.assert_array_equal(found.video, expected.video)
