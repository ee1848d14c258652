"""One frame with several priors and weights: the videos and the table of the command line."""

import csv
import os
import subprocess

import numpy as np
import pytest

import rowburst as rb

PROGRAM = os.environ.get("ROWBURST")


@pytest.fixture(scope="module")
def swept(capture, camera, psf):
    return rb.sweep(capture.frame, camera, psf, prior=["tv", "l1"], tau=["auto", 0.5], max_iterations=20, truth=capture.truth)


def test_points_are_those_of_runs_of_their_own(swept, capture, camera, psf):
    assert len(swept) == 4 and "4 points" in repr(swept)
    for (prior, tau), result, row in zip([("tv", "auto"), ("tv", 0.5), ("l1", "auto"), ("l1", 0.5)], swept, swept.table, strict=True):
        alone = rb.reconstruct(capture.frame, camera, psf, prior=prior, tau=tau, max_iterations=20, truth=capture.truth)
        np.testing.assert_array_equal(result.video, alone.video)
        assert (row["prior"], row["tau"], row["fit"]) == (alone.prior, alone.tau, alone.fit)
        assert row["psnr_db"] == alone.numbers["psnr_db"] and row["error"] is None and row["seconds"] > 0
    assert str(swept).splitlines()[0].split() == ["point", "tau", "residual/σ", "PSNR", "dB", "seconds", "fit"]


def test_the_folder_is_that_of_the_command_line(swept, capture, camera, psf, tmp_path):
    folder = swept.save(tmp_path / "ours")
    rows = list(csv.DictReader((folder / "sweep.csv").open()))
    assert [row["point"] for row in rows] == [row["point"] for row in swept.table]
    for row, result in zip(rows, swept, strict=True):
        np.testing.assert_array_equal(rb.load(row["output"]).video, result.video)
    if PROGRAM:
        np.save(tmp_path / "frame.npy", capture.frame)
        np.save(tmp_path / "psf.npy", psf.array)
        (tmp_path / "experiment.toml").write_text(camera.to_toml())
        subprocess.run(
            [PROGRAM, "reconstruct", "experiment.toml", "--frame", "frame.npy", "--psf", "psf.npy", "--sweep", "prior=tv,l1",
             "--sweep", "tau=auto,0.5", "--max-iterations", "20", "-o", "theirs"],
            cwd=tmp_path, check=True, capture_output=True)  # fmt: skip
        again = rb.sweep(capture.frame, camera, np.load(tmp_path / "psf.npy"), prior=["tv", "l1"], tau=["auto", 0.5], max_iterations=20)
        again.save(tmp_path / "again")
        theirs = list(csv.DictReader((tmp_path / "theirs" / "sweep.csv").open()))
        mine = list(csv.DictReader((tmp_path / "again" / "sweep.csv").open()))
        for a, b in zip(mine, theirs, strict=True):
            assert {k: v for k, v in a.items() if k not in ("seconds", "output")} == {k: v for k, v in b.items() if k not in ("seconds", "output")}
            ours, others = (tmp_path / f / os.path.basename(row["output"]) / "video.npy" for f, row in (("again", a), ("theirs", b)))
            assert ours.read_bytes() == others.read_bytes()


def test_mistakes_are_found_before_the_first_run(capture, camera, psf):
    seen = []
    for options, words in (
        ({"prior": ["tv", "tvv"]}, "tvv"),
        ({"tau": [0.1, "often"]}, "often"),
        ({"max_iterations": [5, 0]}, "max_iterations: found 0"),
        ({"prior": "tv"}, "nothing that is swept"),
        ({"prior": []}, "nothing that is swept"),
    ):
        with pytest.raises(rb.InputError, match=words):
            rb.sweep(capture.frame, camera, psf, progress=seen.append, **options)
    assert not seen


def test_a_point_that_fails_does_not_end_the_others(capture, camera, psf, monkeypatch):
    def result_of(found, camera):
        if found.tau > 1:
            raise rb.WorkError(f"tau {found.tau}: no memory")
        return rb.Result(found, camera)

    monkeypatch.setattr(rb._sweep, "Result", result_of)
    found = rb.sweep(capture.frame, camera, psf, tau=[0.5, 2.0], prior="tv", max_iterations=5)
    assert found[0] is not None and found[1] is None and "tau 2" in found.table[1]["error"]
    with pytest.raises(rb.WorkError, match="tau 2"):
        rb.sweep(capture.frame, camera, psf, tau=[2.0, 3.0], prior="tv", max_iterations=5)
