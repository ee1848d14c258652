"""reconstruct: the same as the command line, and what Python adds."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import rowburst as rb

PRIOR = "tv+0.5*tdiff+support"


def test_a_result_has_what_is_needed_to_judge_it(result, capture, camera):
    assert result.video.shape == camera.video_shape
    assert result.video.dtype == np.float32
    assert not result.video.flags.writeable
    assert result.video is result.video
    numbers = result.numbers
    assert numbers["prior"] == result.prior == PRIOR
    assert numbers["residual_over_sigma"] == result.residual_over_sigma
    error = np.mean((result.video.astype(float) - capture.truth) ** 2)
    psnr = 10 * np.log10(float(capture.truth.max()) ** 2 / error)
    assert abs(numbers["psnr_db"] - psnr) < 1e-4 and psnr > 25
    assert result.residual.shape == camera.frame_shape
    assert result.fit in ("good", "suspicious", "bad") and result.fit in repr(result)


def test_traces_have_errors(result, camera):
    region, *spots = result.traces([(8, 9), ])
    assert region.region == (7, 8, 3, 3)
    means = result.video[:, 7:10, 8:11].mean(axis=(1, 2))
    np.testing.assert_allclose(region.value, means, rtol=1e-5, atol=1e-4 * means.max())
    assert region.standard_error.shape == region.time_us.shape == (camera.video_shape[0],)
    assert np.isfinite(region.standard_error).all() and region.standard_error.max() > 0
    assert spots
    with pytest.raises(rb.InputError, match="region"):
        result.traces([(99, 0)])


def test_report_and_folder(result, tmp_path):
    report = result.report(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == report
    assert report.startswith("<!") and "iframe" in report._repr_html_()
    # The report plays the video, as that of the command line.
    assert 'id="rowburst-data"' in report and "script-src 'sha256-" in report
    folder = result.save(tmp_path / "out")
    np.testing.assert_array_equal(np.load(folder / "video.npy"), result.video)
    assert json.loads((folder / "result.json").read_text())["tau"] == result.tau
    assert ('id="rowburst-data"' in report) == ('id="rowburst-data"' in (folder / "report.html").read_text(encoding="utf-8"))
    assert (folder / "traces.csv").exists()


def test_bits_are_those_of_the_command_line(capture, camera, psf, tmp_path):
    program = os.environ.get("ROWBURST")
    if not program:
        pytest.skip("ROWBURST does not name the program")
    np.save(tmp_path / "frame.npy", capture.frame)
    np.save(tmp_path / "psf.npy", psf.array)
    (tmp_path / "experiment.toml").write_text(camera.to_toml())
    # Of the file, since scaling to a sum of 1 twice is not the same.
    psf = np.load(tmp_path / "psf.npy")
    for prior in ("auto", "tv"):
        out = tmp_path / prior
        done = subprocess.run(
            [program, "reconstruct", tmp_path / "experiment.toml", "--frame", tmp_path / "frame.npy",
             "--psf", tmp_path / "psf.npy", "--prior", prior, "-o", out, "--json"],
            check=True, capture_output=True)
        direct_call = rb.reconstruct(capture.frame, camera, psf, prior=prior)
        np.testing.assert_array_equal(np.load(out / "video.npy"), direct_call.video)
        theirs, ours = json.loads(done.stdout), direct_call.numbers
        changing = ("run", "seconds", "setup_seconds", "peak_memory_bytes", "history", "trace_errors", "threads")
        for key in set(theirs) - set(changing):
            assert theirs[key] == ours[key], key
    # Integers: the container's end is saturation, and the bias is taken off.
    counts = np.clip(capture.frame / capture.frame.max() * 60000, 0, 65535).astype(np.uint16)
    np.save(tmp_path / "frame.npy", counts)
    camera = rb.Camera(rows=24, columns=30, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6, bias_counts=100)
    (tmp_path / "experiment.toml").write_text(camera.to_toml())
    subprocess.run(
        [program, "reconstruct", tmp_path / "experiment.toml", "--frame", tmp_path / "frame.npy",
         "--psf", tmp_path / "psf.npy", "--prior", "tv", "-o", tmp_path / "counts"], check=True, capture_output=True)
    experiment = rb.Camera.from_file(tmp_path / "experiment.toml")
    assert experiment == camera
    direct_call = rb.reconstruct(counts, experiment, psf, prior="tv")
    np.testing.assert_array_equal(np.load(tmp_path / "counts" / "video.npy"), direct_call.video)


def test_layouts_do_not_matter(capture, camera, psf):
    kwargs = {"prior": "tv", "max_iterations": 15}
    expected = rb.reconstruct(capture.frame, camera, psf, **kwargs).video
    frozen = capture.frame.copy()
    frozen.setflags(write=False)
    for same in (frozen, np.asfortranarray(frozen), np.repeat(frozen, 2, 0)[::2], frozen.astype(np.float64), frozen.tolist()):
        np.testing.assert_array_equal(rb.reconstruct(same, camera, psf, **kwargs).video, expected)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame": np.full((24, 30), np.nan)}, "frame.*NaN"),
        ({"frame": np.ones((24, 30), complex)}, "frame.*complex128"),
        ({"frame": np.ones((24, 30), object)}, "frame.*object"),
        ({"frame": np.ones((2, 24, 30))}, "frame.*two axes"),
        ({"frame": np.ones((30, 24))}, "frame.*24"),
        ({"frame": np.ones((0, 30))}, "frame.*empty"),
        ({"psf": -np.ones((5, 5))}, "PSF.*negative"),
        ({"prior": "tvv"}, "prior"),
        ({"tau": -1.0}, "tau.*above zero"),
        ({"tau": "best"}, "tau.*auto"),
        ({"noise_sigma": 0.0}, "noise_sigma"),
        ({"time_budget_s": 0.0}, "time_budget_s"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"truth": np.ones((3, 3, 3))}, "truth"),
        ({"dark": np.full((24, 30), np.inf)}, "dark"),
        ({"bad_pixels": np.ones((3, 3))}, "bad_pixels"),
    ],
)
def test_mistakes_are_named(change, words, capture, camera, psf):
    given = {"frame": capture.frame, "camera": camera, "psf": psf} | change
    with pytest.raises(rb.InputError, match=words) as raised:
        rb.reconstruct(**given)
    assert isinstance(raised.value, ValueError)
    assert "--" not in str(raised.value)


def test_cameras_that_cannot_be():
    good = {"rows": 4, "columns": 4, "shutter": "top-down", "row_time_us": 10.0, "exposure_us": 10.0}
    for change, words in [
        ({"rows": 0}, "rows"),
        ({"exposure_us": -1.0}, "exposure_us"),
        ({"shutter": "topdown"}, "top-down"),
        ({"shutter": "custom"}, "row_order"),
        ({"row_order": [0, 1, 2, 3]}, "custom"),
        ({"field": (2, 2)}, "field"),
    ]:
        with pytest.raises(rb.InputError, match=words):
            rb.Camera(**(good | change))
    assert rb.Camera(**(good | {"shutter": "custom", "row_order": [3, 0, 1, 2]})).video_shape == (4, 4, 4)


def test_progress_is_seen_and_may_stop_it(capture, camera, psf):
    seen = []
    result = rb.reconstruct(capture.frame, camera, psf, prior=PRIOR, progress=seen.append)
    assert [p.iteration for p in seen] == list(range(1, result.iterations + 1))
    assert seen[-1].residual_over_sigma == pytest.approx(result.residual_over_sigma, rel=0.2)
    stopped = rb.reconstruct(capture.frame, camera, psf, prior=PRIOR, progress=lambda p: p.iteration < 7)
    assert (stopped.iterations, stopped.stop_reason) == (7, "interrupted")

    def fails(_):
        raise LookupError("of the callback")

    with pytest.raises(LookupError, match="of the callback"):
        rb.reconstruct(capture.frame, camera, psf, progress=fails)
    pytest.importorskip("tqdm")
    assert rb.reconstruct(capture.frame, camera, psf, prior=PRIOR, progress=True).iterations == result.iterations


def test_other_threads_run_meanwhile(capture, camera, psf):
    ticks, over = [], threading.Event()

    def tick():
        while not over.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    thread = threading.Thread(target=tick)
    thread.start()
    began = time.perf_counter()
    rb.reconstruct(capture.frame, camera, psf, prior="tv", max_iterations=300)
    ended = time.perf_counter()
    over.set()
    thread.join()
    during = sum(began < t < ended for t in ticks)
    assert during > 3, f"{during} ticks in {ended - began:.2f} s"


def test_ctrl_c_ends_a_run(tmp_path):
    script = """
import signal
import numpy as np, rowburst as rb
# Tests that are started in the background ignore Ctrl-C, and so do their children.
signal.signal(signal.SIGINT, signal.default_int_handler)
camera = rb.Camera(rows=40, columns=40, shutter="top-down", row_time_us=10, exposure_us=10)
rng = np.random.default_rng(1)
def said(p):
    if p.iteration == 3: print("runs", flush=True)
try:
    rb.reconstruct(rng.uniform(1, 2, (40, 40)), camera, rng.exponential(size=(79, 79)), prior="tv",
                   tau=1e-12, max_iterations=10_000_000, progress=said)
except KeyboardInterrupt:
    print("interrupted")
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "runs\n"
        process.send_signal(signal.SIGINT)
        try:
            rest, _ = process.communicate(timeout=20)
        finally:
            process.kill()
    assert rest == "interrupted\n"


def test_simulations_are_those_of_their_seed(camera, psf, capture):
    again = rb.simulate(camera, capture.truth, psf, seed=5)
    same = rb.simulate(camera, capture.truth, psf, seed=5)
    other = rb.simulate(camera, capture.truth, psf, seed=6)
    np.testing.assert_array_equal(again.frame, same.frame)
    assert (again.frame != other.frame).any()
    noiseless = rb.simulate(camera, capture.truth, psf, snr=float("inf"))
    assert noiseless.noise_sigma == 0
    operator = rb.operator(camera, psf)
    np.testing.assert_allclose(noiseless.frame.ravel(), operator.matvec(noiseless.truth.ravel()), rtol=1e-5, atol=1e-5)
    with pytest.raises(rb.InputError, match="digits, leds"):
        rb.simulate(camera, "didgits")
    large = rb.Camera(rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    assert rb.speckle_psf(large, seed=2).shape == (215, 215)
    assert len(rb.simulate(large, "leds").leds) == 3
    with pytest.raises(rb.InputError, match="wavelength_nm"):
        rb.speckle_psf(large, wavelength_nm=-1.0)


def test_experiments_are_read_with_their_files(tmp_path, camera, psf):
    np.save(tmp_path / "psf.npy", psf.array)
    np.save(tmp_path / "dark.npy", np.full(camera.frame_shape, 3, np.uint16))
    text = camera.to_toml() + '\n[calibration]\npsf = "psf.npy"\ndark = "dark.npy"\n[reconstruction]\nprior = "tv"\n'
    (tmp_path / "experiment.toml").write_text(text)
    experiment = rb.Experiment(tmp_path / "experiment.toml")
    assert experiment.camera == camera and experiment.prior == "tv" and experiment.tau == "auto"
    assert experiment.psf == rb.Psf(psf.array)
    np.testing.assert_array_equal(experiment.dark, np.full(camera.frame_shape, 3))
    assert experiment.flat is None
    with pytest.raises(rb.InputError, match="nowhere.toml"):
        rb.Experiment(tmp_path / "nowhere.toml")


def test_a_live_view_warm_starts_each_frame():
    # Of a lens, and with a good fit: where the fit is poor, the count of iterations says little.
    camera = rb.Camera(rows=48, columns=48, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    capture = rb.simulate(camera, "digits", snr=256, seed=1)
    psf = capture.psf
    live = rb.LiveView(camera, psf, prior=PRIOR)
    first = live.next(capture.frame)
    # As in a live view, a run with a time budget does not check the model.
    alone = rb.reconstruct(capture.frame, camera, psf, prior=PRIOR, time_budget_s=60)
    np.testing.assert_array_equal(first.video, alone.video)
    assert not first.went_on and first.iterations == alone.numbers["iterations"]
    again = live.next(capture.frame, time_budget_s=60)
    assert again.went_on and again.iterations < first.iterations
    assert again.fit == first.fit == "good" and 0 < again.seconds < 60
    live.forget()
    np.testing.assert_array_equal(live.next(capture.frame).video, first.video)
    with pytest.raises(rb.InputError, match="frame"):
        live.next(capture.frame[1:])
    with pytest.raises(rb.InputError, match="budget"):
        live.next(capture.frame, time_budget_s=-1)


def test_signed_counts_end_at_the_top_of_their_type(camera, psf, capture):
    scale = 30000 / capture.frame.max()
    frame = (capture.frame * scale).astype(np.int16)
    frame[3, 4] = 32767
    frame[5, 6] = -3
    signed = rb.reconstruct(frame, camera, psf, prior="tv", max_iterations=5)
    assert signed.numbers["saturated_pixels"] == 1
    unsigned = rb.reconstruct(np.abs(frame).astype(np.uint16), camera, psf, prior="tv", max_iterations=5)
    assert unsigned.numbers["saturated_pixels"] == 0
    small = (capture.frame / capture.frame.max() * 120).astype(np.int8)
    small[2, 2] = 127
    found = rb.reconstruct(small, camera, psf, prior="tv", max_iterations=5)
    assert found.numbers["saturated_pixels"] == 1


def test_files_stand_in_for_arrays(camera, psf, capture, tmp_path):
    np.save(tmp_path / "frame.npy", capture.frame)
    np.save(tmp_path / "psf.npy", psf.array)
    array = rb.reconstruct(capture.frame, camera, np.load(tmp_path / "psf.npy"), prior="tv", max_iterations=5)
    for name in (str, lambda path: path):
        file = rb.reconstruct(
            name(tmp_path / "frame.npy"), camera, name(tmp_path / "psf.npy"), prior="tv", max_iterations=5
        )
        np.testing.assert_array_equal(file.video, array.video)
    frames = rb.read_frames(tmp_path / "frame.npy")
    assert frames.shape == (1, *camera.frame_shape) and frames.dtype == np.float32
    with pytest.raises(rb.InputError, match="nowhere.h5"):
        rb.reconstruct(tmp_path / "nowhere.h5", camera, psf)


def test_metadata_fills_an_experiment(camera, tmp_path):
    rows, columns = camera.frame_shape
    np.save(tmp_path / "frame.npy", np.ones((rows, columns)))
    (tmp_path / "metadata.txt").write_text(
        json.dumps({"FrameKey-0-0-0": {"Exposure-ms": 0.0192, "ROI": f"0-0-{columns}-{rows}", "BitDepth": 12}})
    )
    (tmp_path / "experiment.toml").write_text('[camera]\nshutter = "top-down"\nrow_time_us = 9.6\nbit_depth = 16\n')
    with pytest.raises(rb.InputError, match="rows"):
        rb.Experiment(tmp_path / "experiment.toml")
    experiment = rb.Experiment(tmp_path / "experiment.toml", frame=tmp_path / "frame.npy")
    assert experiment.camera.frame_shape == (rows, columns)
    assert set(experiment.metadata_taken) == {"rows", "columns", "exposure_us"}
    assert "bit_depth is 16" in experiment.metadata_warnings[0]
