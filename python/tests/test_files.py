"""Folders that results and simulations leave, and what repeats a run."""

import json
import os
import subprocess

import numpy as np
import pytest

import rowburst as rb

PROGRAM = os.environ.get("ROWBURST")
NEEDS_PROGRAM = pytest.mark.skipif(not PROGRAM, reason="ROWBURST does not name the program")


@pytest.fixture
def folder(capture, camera, psf, tmp_path):
    """An experiment and its frame."""
    np.save(tmp_path / "frame.npy", capture.frame)
    np.save(tmp_path / "psf.npy", psf.array)
    np.save(tmp_path / "truth.npy", capture.truth)
    (tmp_path / "experiment.toml").write_text(camera.to_toml() + '[calibration]\npsf = "psf.npy"\n')
    return tmp_path


def test_formats_are_chosen(result, tmp_path):
    saved = result.save(tmp_path / "a", formats=["mat", "h5"])
    assert {"video.npy", "video.mat", "video.h5"} <= {p.name for p in saved.iterdir()} and not (saved / "video.mp4").exists()
    assert [p.name for p in result.save(tmp_path / "b", formats=[]).glob("video.*")] == ["video.npy"]
    with pytest.raises(rb.InputError, match="avi"):
        result.save(tmp_path / "c", formats=["avi"])


@NEEDS_PROGRAM
def test_a_run_of_files_is_repeated_by_the_program(folder):
    experiment = rb.Experiment(folder / "experiment.toml")
    options = dict(prior="tv", max_iterations=20, truth=folder / "truth.npy", seed=3)
    result = rb.reconstruct(folder / "frame.npy", experiment, **options)
    saved = result.save(folder / "result")
    run = rb.load(saved).numbers["run"]
    assert {i["role"] for i in run["inputs"]} == {"experiment", "frame", "psf", "truth"} and run["options"]["prior"] == "tv"
    done = subprocess.run([PROGRAM, "rerun", saved, "-o", folder / "again"], capture_output=True, text=True)
    assert done.returncode == 0 and "equal to the bit" in done.stdout, done.stdout + done.stderr
    np.testing.assert_array_equal(np.load(folder / "again" / "video.npy"), result.video)


def test_a_run_of_arrays_has_no_record(folder, capture):
    experiment = rb.Experiment(folder / "experiment.toml")
    for frame, camera, more in (
        (capture.frame, experiment, {}),
        (folder / "frame.npy", experiment.camera, {"psf": folder / "psf.npy"}),
        (folder / "frame.npy", experiment, {"truth": capture.truth}),
        (folder / "frame.npy", experiment, {"tuning": {"support_threshold": 0.4}}),
    ):
        result = rb.reconstruct(frame, camera, prior="tv", max_iterations=3, **more)
        result.save(folder / "out", formats=[])
        assert json.loads((folder / "out" / "result.json").read_text())["run"] is None


@NEEDS_PROGRAM
@pytest.mark.parametrize("options", [{"scene": "digits", "background": 0.2}, {"scene": "leds"}])
def test_a_simulation_leaves_the_folder_of_the_command_line(options, tmp_path):
    camera = rb.Camera(
        rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6, bit_depth=16, bias_counts=100.0,
        gain_electrons_per_count=0.5, read_noise_electrons=1.5,
    )  # fmt: skip
    (tmp_path / "camera.toml").write_text(camera.to_toml())
    words = [f"--{name}={value}" for name, value in options.items()]
    subprocess.run(
        [PROGRAM, "simulate", tmp_path / "camera.toml", "--peak-electrons", "20000", "--seed", "3", *words, "-o", tmp_path / "theirs"],
        check=True, capture_output=True)  # fmt: skip
    ours = rb.simulate(camera, peak_electrons=20000, seed=3, **options).save(tmp_path / "ours")
    names = sorted(p.name for p in (tmp_path / "theirs").iterdir() if not p.name.startswith("."))
    assert sorted(p.name for p in ours.iterdir() if not p.name.startswith(".")) == names and "truth.npy" in names
    for name in names:
        assert (ours / name).read_bytes() == (tmp_path / "theirs" / name).read_bytes(), name


def test_metrics_are_those_of_the_result(result, capture):
    assert rb.metrics.psnr(result.video, capture.truth) == result.numbers["psnr_db"]
    assert rb.metrics.ssim(result.video, capture.truth) == result.numbers["ssim"]
    with pytest.raises(rb.InputError, match="truth: found"):
        rb.metrics.psnr(result.video, capture.truth[1:])


def test_a_design_counts_what_a_scene_needs(tmp_path):
    camera = rb.Camera(rows=48, columns=48, shutter="dual-inside-out", row_time_us=10, exposure_us=10, pixel_pitch_um=6.5)
    scene = np.zeros(camera.video_shape, np.float32)
    for t in range(len(scene)):
        scene[t, 10 + t % 20 : 20 + t % 20, 10:20] = 1
    planned = rb.design(camera, trials=False, scene=scene, threads=1)
    without = rb.design(camera, trials=False)
    changed = {name for name in planned.numbers if planned.numbers[name] != without.numbers[name]}
    changed -= {"seconds", "warnings"}
    assert changed and all(without.numbers[name] is None for name in changed)
    if PROGRAM:
        np.save(tmp_path / "scene.npy", scene)
        (tmp_path / "camera.toml").write_text(camera.to_toml())
        done = subprocess.run(
            [PROGRAM, "design", "--experiment", tmp_path / "camera.toml", "--scene", tmp_path / "scene.npy", "--quick", "--json"],
            capture_output=True, text=True)  # fmt: skip
        assert done.returncode == 0, done.stderr
        theirs = json.loads(done.stdout)
        assert all(theirs[name] == planned.numbers[name] for name in changed)
