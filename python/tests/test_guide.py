"""Pictures of a second camera: of the experiment file and of the call, with the bits of the command line."""

import copy
import json
import os
import pickle
import subprocess

import numpy as np
import pytest

import rowburst as rb

PROGRAM = os.environ.get("ROWBURST")
PRIOR = "tv+8*tdiff"


@pytest.fixture(scope="module")
def dense(tmp_path_factory):
    """A folder with an experiment of a dense scene and the picture of a second camera."""
    folder = tmp_path_factory.mktemp("dense")
    camera = rb.Camera(rows=72, columns=72, shutter="dual-inside-out", row_time_us=10, exposure_us=10)
    made = rb.simulate(camera, "beam", seed=11)
    np.save(folder / "frame.npy", made.frame)
    np.save(folder / "psf.npy", made.psf.array)
    bin_at = 18
    noise = np.random.default_rng(1).normal(0, 0.01 * made.truth.max(), made.truth[bin_at].shape)
    np.save(folder / "guide.npy", (made.truth[bin_at] + noise).astype(np.float32))
    guide = '[[guide]]\nimage = "guide.npy"\ntime_us = 180\nexposure_us = 10\n'
    (folder / "experiment.toml").write_text(camera.to_toml() + '[calibration]\npsf = "psf.npy"\n' + guide)
    (folder / "without.toml").write_text(camera.to_toml() + '[calibration]\npsf = "psf.npy"\n')
    return folder


@pytest.fixture(scope="module")
def guided(dense):
    experiment = rb.Experiment(dense / "experiment.toml")
    return rb.reconstruct(dense / "frame.npy", experiment, prior=PRIOR, max_iterations=30)


def test_the_pictures_of_the_experiment_are_used(dense, guided, tmp_path):
    assert guided.numbers["guide"]["used"] is True
    if PROGRAM:
        subprocess.run(
            [PROGRAM, "reconstruct", dense / "experiment.toml", "--frame", dense / "frame.npy", "--prior", PRIOR,
             "--max-iterations", "30", "-o", tmp_path / "out"],
            check=True, capture_output=True)  # fmt: skip
        np.testing.assert_array_equal(np.load(tmp_path / "out" / "video.npy"), guided.video)
        written = json.loads((tmp_path / "out" / "result.json").read_text())
        assert written["guide"] == guided.numbers["guide"]


def test_pictures_of_the_call_come_first(dense, guided):
    plain, full = rb.Experiment(dense / "without.toml"), rb.Experiment(dense / "experiment.toml")
    picture = np.load(dense / "guide.npy")
    assert plain.guide == [] and plain.guide_exposures_us == []
    np.testing.assert_array_equal(full.guide[0], picture)
    assert full.guide_exposures_us == [(180.0, 10.0)] and "guide" in repr(full)
    options = dict(prior=PRIOR, max_iterations=30)
    for guide in ([picture], picture, [dense / "guide.npy"]):
        found = rb.reconstruct(dense / "frame.npy", plain, guide=guide, guide_exposures_us=[(180, 10)], **options)
        np.testing.assert_array_equal(found.video, guided.video)
    without = rb.reconstruct(dense / "frame.npy", full, guide=[], **options)
    assert without.numbers["guide"] is None and (without.video != guided.video).any()
    with pytest.raises(rb.InputError, match="guide_exposures_us"):
        rb.reconstruct(dense / "frame.npy", full, guide_exposures_us=[(180, 10)], **options)


def test_pictures_are_pickled_with_the_experiment(dense, guided):
    original = rb.Experiment(dense / "experiment.toml")
    for same in (pickle.loads(pickle.dumps(original)), copy.deepcopy(original)):
        np.testing.assert_array_equal(same.guide[0], original.guide[0])
        assert same.guide_exposures_us == original.guide_exposures_us
    found = rb.reconstruct(dense / "frame.npy", same, prior=PRIOR, max_iterations=30)
    np.testing.assert_array_equal(found.video, guided.video)


def test_calls_that_take_no_pictures_say_so(dense, tmp_path):
    experiment = rb.Experiment(dense / "experiment.toml")
    frame = np.load(dense / "frame.npy")
    for call in (
        lambda: experiment.reconstructor(),
        lambda: rb.Reconstructor(experiment),
        lambda: rb.batch(frame[None], tmp_path / "v.zarr", experiment),
        lambda: rb.reconstruct_chunked(frame, tmp_path / "c", experiment, prior="tv"),
        lambda: rb.reconstruct_colour(frame, experiment),
    ):
        with pytest.raises(rb.InputError, match=r"guide: found \[\[guide\]\].*rb.reconstruct") as error:
            call()
        assert error.value.kind == "unsupported"
    np.save(tmp_path / "frames.npy", frame[None])
    with pytest.raises(rb.InputError, match=r"\[\[guide\]\].*rb.reconstruct"):
        rb._rowburst._Batch(dense / "experiment.toml", tmp_path / "frames.npy", tmp_path / "d.zarr")


def test_known_places_have_traces():
    """Their numbers and labels are kept by a pickle, and are the file's."""
    camera = rb.Camera(rows=72, columns=72, shutter="dual-inside-out", row_time_us=10, exposure_us=10)
    made = rb.simulate(camera, "spots", seed=1)
    found = rb.reconstruct(made.frame, camera, made.psf, guide=made.truth.mean(axis=0), guide_model="places")
    guide = found.numbers["guide"]
    assert guide["used"] is True and guide["model"] == "places"
    traces = guide["known_places"]["traces"]
    assert len(traces) > 30
    place = traces[0]
    assert len(place["value"]) == len(place["standard_error"]) == found.video.shape[0]
    restored = pickle.loads(pickle.dumps(found))
    assert restored.numbers["guide"] == guide
