"""Set up once, call many times: the same numbers, from several threads and after pickling; recordings and archives."""

import json
import os
import pickle
import subprocess
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import rowburst as rb

PRIOR = "tv+0.5*tdiff+support"


@pytest.fixture(scope="module")
def frames(capture):
    """Three frames of one scene, of different brightness."""
    return np.stack([capture.frame, 1.5 * capture.frame, 0.5 * capture.frame])


@pytest.fixture(scope="module")
def videos(frames, camera, psf):
    return [rb.reconstruct(frame, camera, psf, prior=PRIOR).video for frame in frames]


@pytest.fixture(scope="module")
def reconstructor(camera, psf):
    return rb.Reconstructor(camera, psf, prior=PRIOR)


def test_videos_are_those_of_reconstruct(reconstructor, frames, videos, tmp_path):
    for frame, video in zip(frames, videos):
        np.testing.assert_array_equal(reconstructor(frame).video, video)
    np.save(tmp_path / "frames.npy", frames)
    dask_array = pytest.importorskip("dask.array").from_array(frames, chunks=(1, -1, -1))
    for stack in (frames, list(frames), iter(frames), dask_array, tmp_path / "frames.npy"):
        for workers in (1, 2):
            if workers == 2 and not hasattr(stack, "__len__"):
                continue
            found = list(reconstructor.map(stack, workers=workers))
            assert len(found) == 3
            for result, video in zip(found, videos):
                np.testing.assert_array_equal(result.video, video)


def test_threads_may_call_at_once(reconstructor, frames, videos):
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(reconstructor, [frames[i % 3] for i in range(9)]))
    for i, result in enumerate(found):
        np.testing.assert_array_equal(result.video, videos[i % 3])


def test_own_threads_give_the_same_video(camera, psf, frames, videos):
    one = rb.Reconstructor(camera, psf, prior=PRIOR, threads=1)(frames[0])
    np.testing.assert_array_equal(one.video, videos[0])
    assert one.numbers["threads"] == 1
    assert rb.reconstruct(frames[0], camera, psf, prior=PRIOR, threads=2).numbers["threads"] == 2
    with pytest.raises(rb.InputError, match="threads: found 0"):
        rb.Reconstructor(camera, psf, threads=0)


def test_it_can_be_pickled(reconstructor, frames, videos):
    again = pickle.loads(pickle.dumps(reconstructor))
    np.testing.assert_array_equal(again(frames[0]).video, videos[0])
    assert "24×30" in repr(again)


def test_an_experiment_gives_what_is_left_out(camera, psf, frames, videos, tmp_path):
    np.save(tmp_path / "psf.npy", psf.array)
    (tmp_path / "experiment.toml").write_text(
        camera.to_toml() + f'\n[calibration]\npsf = "psf.npy"\n[reconstruction]\nprior = "{PRIOR}"\n'
    )
    experiment = rb.Experiment(tmp_path / "experiment.toml")
    expected = rb.reconstruct(frames[0], experiment).video
    np.testing.assert_array_equal(rb.Reconstructor(experiment)(frames[0]).video, expected)
    look = rb.Reconstructor(experiment).live().next(frames[0])
    assert look.video.shape == camera.video_shape


def test_progress_is_on_the_calling_thread_and_may_stop(reconstructor, frames):
    import threading

    seen = []

    def stop_at_three(progress):
        seen.append(threading.get_ident())
        return progress.iteration < 3

    result = reconstructor(frames[0], progress=stop_at_three)
    assert result.stop_reason == "interrupted" and set(seen) == {threading.get_ident()}

    def fails(progress):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        reconstructor(frames[0], progress=fails)


def test_mistakes_are_named(reconstructor, camera):
    with pytest.raises(rb.InputError, match="workers: found 0"):
        reconstructor.map([], workers=0)
    with pytest.raises(rb.InputError, match="psf"):
        rb.Reconstructor(camera)
    with pytest.raises(rb.InputError, match="frame"):
        reconstructor(np.zeros((3, 3, 3)))


def test_debias_gives_the_refitted_video(capture, camera, psf, tmp_path):
    result = rb.reconstruct(capture.frame, camera, psf, prior=PRIOR, truth=capture.truth, debias=True)
    plain = rb.reconstruct(capture.frame, camera, psf, prior=PRIOR, truth=capture.truth)
    numbers = result.numbers
    assert numbers["debias"]["psnr_db_before"] == plain.numbers["psnr_db"] != numbers["psnr_db"]
    assert plain.numbers.get("debias") is None and (result.video != plain.video).any()
    program = os.environ.get("ROWBURST")
    if program:
        np.save(tmp_path / "frame.npy", capture.frame)
        np.save(tmp_path / "psf.npy", psf.array)
        (tmp_path / "experiment.toml").write_text(camera.to_toml())
        subprocess.run(
            [program, "reconstruct", tmp_path / "experiment.toml", "--frame", tmp_path / "frame.npy", "--psf",
             tmp_path / "psf.npy", "--prior", PRIOR, "--debias", "-o", tmp_path / "out"],
            check=True, capture_output=True)  # fmt: skip
        ours = rb.reconstruct(capture.frame, camera, np.load(tmp_path / "psf.npy"), prior=PRIOR, debias=True)
        np.testing.assert_array_equal(np.load(tmp_path / "out" / "video.npy"), ours.video)
        written = json.loads((tmp_path / "out" / "result.json").read_text())["debias"]
        assert written["light_ratio"] == ours.numbers["debias"]["light_ratio"]


def test_a_batch_resumes_and_has_the_videos_of_reconstruct(frames, videos, camera, psf, tmp_path):
    zarr = pytest.importorskip("zarr")
    dask_array = pytest.importorskip("dask.array").from_array(frames, chunks=(1, -1, -1))
    np.save(tmp_path / "frames.npy", frames)
    for i, stack in enumerate((frames, dask_array, tmp_path / "frames.npy")):
        seen = []
        out = tmp_path / f"{i}.zarr"
        report = lambda done, of: seen.append((done, of))
        summary = rb.batch(stack, out, camera, psf, prior=PRIOR, progress=report)
        assert (summary["done"], summary["left"], summary["frames_this_run"]) == (3, 0, 3)
        assert seen[-1] == (3, 3) and summary["prior"] == PRIOR
        np.testing.assert_array_equal(zarr.open(str(out))["0"][...].reshape(3, *camera.video_shape), videos)
        # The line of a frame is removed, as if the process had been killed before it was written.
        (out / "rowburst" / "frames" / "000001.json").unlink()
        assert rb.batch(stack, out, camera, psf, prior=PRIOR)["frames_this_run"] == 1
    with pytest.raises(rb.InputError, match="other settings"):
        rb.batch(frames, out, camera, psf, prior="tv")


def test_a_batch_with_a_bias_takes_integers_alone(frames, camera, psf, tmp_path):
    biased = rb.Camera(rows=24, columns=30, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6, bias_counts=100)
    with pytest.raises(rb.WorkError, match="floating-point.*Give integers"):
        rb.batch(frames + 100, tmp_path / "videos.zarr", biased, psf, prior="tv", max_iterations=3)
    whole = (1000 * frames / frames.max() + 100).astype(np.uint16)
    assert rb.batch(whole, tmp_path / "whole.zarr", biased, psf, prior="tv", max_iterations=3)["done"] == 3


def test_a_batch_takes_masked_frames_and_shows_a_bar(frames, camera, psf, tmp_path, capsys):
    pytest.importorskip("tqdm")
    masked = np.ma.masked_array(frames, np.zeros(frames.shape, bool))
    masked[0, 3, 4] = np.ma.masked
    bad = np.zeros(camera.frame_shape, np.uint8)
    bad[5, 6] = 1
    options = dict(prior="tv", max_iterations=5)
    rb.batch(masked, tmp_path / "masked.zarr", camera, psf, bad_pixels=bad, progress=True, **options)
    assert "frame" in capsys.readouterr().err
    bad[3, 4] = 1
    rb.batch(frames, tmp_path / "bad.zarr", camera, psf, bad_pixels=bad, progress=False, **options)
    assert capsys.readouterr().err == ""
    zarr = pytest.importorskip("zarr")
    found = [zarr.open(str(tmp_path / f"{name}.zarr"))["0"][...] for name in ("masked", "bad")]
    np.testing.assert_array_equal(*found)
    with pytest.raises(rb.InputError, match="progress: found 'x'"):
        rb.batch(frames, tmp_path / "no.zarr", camera, psf, progress="x", **options)


def test_own_threads_of_every_call(camera, psf, capture):
    one = rb.LiveView(camera, psf, prior="tv", threads=1).next(capture.frame)
    np.testing.assert_array_equal(one.video, rb.LiveView(camera, psf, prior="tv").next(capture.frame).video)
    made = rb.simulate(camera, "moving", psf, digit_px=8, threads=1)
    np.testing.assert_array_equal(made.frame, rb.simulate(camera, "moving", psf, digit_px=8).frame)
    rng = np.random.default_rng(11)
    stripes = 1000 + 600 * np.sin(2 * np.pi * 2000 * np.arange(512)[:, None] * 9.6e-6) + rng.normal(0, 8, (512, 40))
    timing = rb.calibrate.timing(stripes, frequency_hz=2000, threads=1)
    assert timing.numbers == rb.calibrate.timing(stripes, frequency_hz=2000).numbers
    for call in (
        lambda: rb.LiveView(camera, psf, threads=0),
        lambda: rb.simulate(camera, "moving", psf, threads=0),
        lambda: rb.design(trials=False, threads=0),
        lambda: rb.calibrate.timing(stripes, frequency_hz=2000, threads=0),
        lambda: rb.calibrate.psf(capture.frame, threads=0),
        lambda: rb.calibrate.sensor(stripes, stripes, threads=0),
    ):
        with pytest.raises(rb.InputError, match="threads: found 0"):
            call()


def test_a_live_view_takes_dark_flat_and_bad_pixels(camera, psf, capture):
    rng = np.random.default_rng(4)
    dark = rng.uniform(50, 150, capture.frame.shape).astype(np.float32)
    response = rng.uniform(0.8, 1.2, capture.frame.shape).astype(np.float32)
    raw = capture.frame * response + dark
    raw[3, 4] = 50 * raw.max()
    bad = np.zeros(raw.shape, np.uint8)
    bad[3, 4] = 1
    plain = rb.LiveView(camera, psf, prior="tv").next(capture.frame)
    mended = rb.LiveView(camera, psf, prior="tv", dark=dark, flat=1000 * response + dark, bad_pixels=bad).next(raw)
    spoilt = rb.LiveView(camera, psf, prior="tv").next(raw)
    error = lambda look: np.abs(look.video - plain.video).sum() / plain.video.sum()
    assert error(mended) < 0.05 < 0.5 < error(spoilt)


def test_constants_of_the_solver_are_taken_everywhere(capture, camera, psf, tmp_path):
    constants = {"support_threshold": 0.4}
    expected = rb.reconstruct(capture.frame, camera, psf, prior=PRIOR, tuning=constants).video
    standard = rb.reconstruct(capture.frame, camera, psf, prior=PRIOR).video
    assert np.abs(expected - standard).max() > 0
    reconstructor = rb.Reconstructor(camera, psf, prior=PRIOR, tuning=constants)
    np.testing.assert_array_equal(reconstructor(capture.frame).video, expected)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(reconstructor))(capture.frame).video, expected)
    rb.batch(capture.frame[None], tmp_path / "videos.zarr", camera, psf, prior=PRIOR, tuning=constants)
    archive = rb._rowburst._Batch.of_values(
        camera, psf, capture.frame[None], tmp_path / "videos.zarr", prior=PRIOR, tuning=constants
    )
    np.testing.assert_array_equal(archive.video(0), expected)
    with pytest.raises(rb.InputError, match="other|begun"):
        rb.batch(capture.frame[None], tmp_path / "videos.zarr", camera, psf, prior=PRIOR)
    wrong = {"no_such_constant": 1.0}
    mosaic = camera.replace(bayer="rggb")
    for call in (
        lambda: rb.Reconstructor(camera, psf, tuning=wrong),
        lambda: rb.LiveView(camera, psf, tuning=wrong),
        lambda: rb.batch(capture.frame[None], tmp_path / "no.zarr", camera, psf, tuning=wrong),
        lambda: rb.reconstruct_chunked(capture.frame, tmp_path / "no", camera, psf, prior="tv", tuning=wrong),
        lambda: rb.reconstruct_colour(capture.frame, mosaic, psf, tuning=wrong),
    ):
        with pytest.raises(rb.InputError, match="no_such_constant"):
            call()


def test_a_corrected_frame_is_used_as_it_is(camera, psf, tmp_path):
    biased = camera.replace(bit_depth=16, bias_counts=100.0, gain_electrons_per_count=0.5, read_noise_electrons=1.0)
    counts = rb.simulate(biased, "moving", psf, peak_electrons=20000, digit_px=8).frame
    assert counts.dtype == np.uint16 and counts.min() >= 100
    np.save(tmp_path / "psf.npy", psf.array)
    np.save(tmp_path / "dark.npy", np.full(camera.frame_shape, 100, np.uint16))
    files = '[calibration]\npsf = "psf.npy"\ndark = "dark.npy"\n[reconstruction]\nprior = "tv"\n'
    (tmp_path / "experiment.toml").write_text(biased.to_toml() + files)
    experiment = rb.Experiment(tmp_path / "experiment.toml")
    raw = rb.reconstruct(counts, experiment, max_iterations=10).video
    subtracted = counts - np.uint16(100)
    for frame in (subtracted, subtracted.astype(np.float64)):
        result = rb.reconstruct(frame, experiment, corrected=True, max_iterations=10)
        np.testing.assert_allclose(result.video, raw, rtol=1e-5, atol=1e-4 * raw.max())
    reconstructor = experiment.reconstructor(corrected=True, max_iterations=10, threads=1)
    assert isinstance(reconstructor, rb.Reconstructor)
    np.testing.assert_array_equal(reconstructor(subtracted).video, result.video)
    rb.batch(subtracted[None].astype(float), tmp_path / "v.zarr", experiment, corrected=True, max_iterations=10)
    with pytest.raises(rb.InputError, match="dark: found dark and corrected=True"):
        rb.reconstruct(counts, experiment, dark=counts, corrected=True)
    with pytest.raises(rb.WorkError, match="corrected=True"):
        rb.batch(subtracted[None].astype(float), tmp_path / "w.zarr", biased, psf)
