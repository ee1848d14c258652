"""Colour, videos in chunks, and the command of the package: the bits of the command line."""

import json
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

import rowburst as rb

PROGRAM = os.environ.get("ROWBURST")


@pytest.fixture(scope="module")
def files(capture, camera, psf, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    np.save(folder / "frame.npy", capture.frame)
    np.save(folder / "psf.npy", psf.array)
    (folder / "experiment.toml").write_text(camera.to_toml())
    (folder / "colour.toml").write_text(camera.replace(bayer="grbg").to_toml())
    return folder


def command(files, experiment, *options):
    subprocess.run(
        [PROGRAM, "reconstruct", files / experiment, "--frame", files / "frame.npy", "--psf", files / "psf.npy", *map(str, options)],
        check=True, capture_output=True)  # fmt: skip


@pytest.mark.parametrize("prior", ["auto", "tv"])
def test_colour_is_that_of_the_command_line(prior, files, camera, tmp_path):
    psf = np.load(files / "psf.npy")
    frame = np.load(files / "frame.npy")
    colour = rb.reconstruct_colour(frame, camera.replace(bayer="grbg"), psf, prior=prior, max_iterations=20)
    bins = colour.planes["red"].video.shape[0]
    assert colour.video.shape == (bins, 12, 15, 3) and not colour.video.flags.writeable
    planes = colour.planes
    assert sorted(planes) == ["blue", "green-1", "green-2", "red"]
    np.testing.assert_array_equal(colour.video[..., 0], planes["red"].video)
    np.testing.assert_allclose(colour.video[..., 1], (planes["green-1"].video + planes["green-2"].video) / 2)
    assert len({plane.prior for plane in planes.values()}) == 1
    assert planes["red"].camera.frame_shape == (12, 15)
    saved = colour.save(tmp_path / "ours")
    np.testing.assert_array_equal(np.load(saved / "red" / "video.npy"), planes["red"].video)
    if PROGRAM:
        out = tmp_path / "out"
        command(files, "colour.toml", "--prior", prior, "--max-iterations", 20, "-o", out)
        np.testing.assert_array_equal(np.load(out / "colour.npy"), colour.video)
        np.testing.assert_array_equal(np.load(saved / "colour.npy"), np.load(out / "colour.npy"))
        listed = json.loads((out / "result.json").read_text())["planes"]
        assert {p["name"]: p["start_us"] for p in listed} == colour.start_us
        assert {p["name"]: p["tau"] for p in listed} == {name: plane.tau for name, plane in planes.items()}


def test_a_folder_in_colour_is_loaded(files, camera, tmp_path):
    psf, frame = np.load(files / "psf.npy"), np.load(files / "frame.npy")
    colour = rb.reconstruct_colour(frame, camera.replace(bayer="grbg"), psf, prior="tv", max_iterations=20)
    folders = [colour.save(tmp_path / "ours")]
    # Again, after the videos went to numpy and through pickle.
    folders.append(pickle.loads(pickle.dumps(colour)).save(tmp_path / "again"))
    if PROGRAM:
        command(files, "colour.toml", "--prior", "tv", "--max-iterations", 20, "-o", tmp_path / "out")
        folders.append(tmp_path / "out")
    for folder in folders:
        saved = rb.load(folder)
        assert isinstance(saved, rb.SavedColour) and "in colour" in repr(saved)
        np.testing.assert_array_equal(saved.video, colour.video)
        assert saved.start_us == colour.start_us and saved.bayer == colour.bayer == "grbg"
        assert saved.frame_rate_hz == pytest.approx(colour.planes["red"].frame_rate_hz) and len(saved.time_us) == len(saved.video)
        for name, plane in colour.planes.items():
            np.testing.assert_array_equal(saved.planes[name].video, plane.video)
            np.testing.assert_allclose(saved.planes[name].time_us, plane.time_us, atol=1e-9)
        assert {"schema_version", "planes", "warnings"} <= saved.numbers.keys() and (folder / "colour.tif").exists()
    ours, theirs = (rb.load(folder).numbers for folder in (folders[0], folders[-1]))
    for numbers in (ours, theirs):
        numbers.pop("run")
        for plane in numbers["planes"]:
            plane.pop("seconds"), plane.pop("folder")
    assert ours == theirs


def test_corrected_frames_in_colour_and_in_chunks(files, camera, tmp_path):
    psf, frame = np.load(files / "psf.npy"), np.load(files / "frame.npy")
    biased = camera.replace(bias_counts=100.0)
    counts = np.round(1000 * frame / frame.max()).astype(np.uint16)
    options = dict(prior="tv", max_iterations=5)
    colour = [
        rb.reconstruct_colour(value, biased.replace(bayer="grbg"), psf, corrected=corrected, **options).video
        for value, corrected in ((counts, True), (counts + np.uint16(100), False))
    ]
    np.testing.assert_allclose(colour[0], colour[1], rtol=1e-5, atol=1e-4 * colour[1].max())
    chunks = [
        rb.reconstruct_chunked(value, tmp_path / str(corrected), biased, psf, bins_per_chunk=4, corrected=corrected, **options).video
        for value, corrected in ((counts, True), (counts + np.uint16(100), False))
    ]
    np.testing.assert_allclose(chunks[0], chunks[1], rtol=1e-5, atol=1e-4 * chunks[1].max())


def test_colour_needs_a_mosaic_and_grey_has_none(files, camera, psf):
    with pytest.raises(rb.InputError, match="bayer: found None"):
        rb.reconstruct_colour(files / "frame.npy", camera, psf)
    with pytest.raises(rb.InputError, match="reconstruct_colour"):
        rb.reconstruct(files / "frame.npy", camera.replace(bayer="rggb"), psf)
    with pytest.raises(rb.InputError, match="raw frame"):
        rb.reconstruct_colour(np.zeros((10, 10)), camera.replace(bayer="rggb"), psf)


def test_chunks_are_those_of_the_command_line_and_go_on(files, camera, tmp_path):
    psf = np.load(files / "psf.npy")
    frame = np.load(files / "frame.npy")
    options = dict(bins_per_chunk=4, prior="tv", max_iterations=20)

    def stop_in_the_second(progress, seen=[]):
        seen.append(progress.iteration)
        return seen.count(1) < 2

    with pytest.raises(rb.WorkError, match="4 of 12 bins"):
        rb.reconstruct_chunked(frame, tmp_path / "ours", camera, psf, progress=stop_in_the_second, **options)
    saved = rb.reconstruct_chunked(frame, tmp_path / "ours", camera, psf, **options)
    assert saved.video.shape == camera.video_shape and len(saved.numbers["parts"]) == 3
    assert "good" in repr(saved) or saved.fit != "good"
    part = rb.reconstruct_chunked(frame, tmp_path / "part", camera, psf, bins=(2, 8), **options)
    assert part.video.shape[0] == 6 and part.numbers["first_bin"] == 2
    if PROGRAM:
        command(files, "experiment.toml", "--prior", "tv", "--max-iterations", 20, "--part-bins", 4, "-o", tmp_path / "out")
        np.testing.assert_array_equal(np.load(tmp_path / "out" / "video.npy"), saved.video)
    with pytest.raises(rb.InputError, match="group couples all bins"):
        rb.reconstruct_chunked(frame, tmp_path / "no", camera, psf, prior="group")
    pytest.importorskip("matplotlib").use("Agg")
    saved.plot()
    saved.montage(3)
    page = saved._repr_html_()
    assert "20 to 20 in 3 chunks" in page and saved.fit in page
    for absent in (lambda: saved.residual, saved.figure):
        with pytest.raises(rb.InputError, match="a video in chunks|a result in one piece"):
            absent()


@pytest.mark.parametrize("field", [(26, 33), (25, 30)])
def test_a_saved_video_has_the_axes_of_the_one_in_memory(field, files, camera, tmp_path):
    pytest.importorskip("xarray")
    psf, frame = np.load(files / "psf.npy"), np.load(files / "frame.npy")
    wide = camera.replace(field=field, pixel_pitch_um=6.5)
    options = dict(prior="tv", max_iterations=3)
    result = rb.reconstruct(frame, wide, psf, self_calibrate="off", **options)
    expected = result.to_xarray()
    first = [-((field[0] - 24) // 2), -((field[1] - 30) // 2)]
    assert [expected.y.values[0], expected.x.values[0]] == first
    assert [result.numbers["first_row"], result.numbers["first_column"]] == first
    folder = result.save(tmp_path / "whole", formats=["zarr"])
    saved = [rb.load(folder), rb.reconstruct_chunked(frame, tmp_path / "chunks", wide, psf, bins_per_chunk=4, **options)]
    if PROGRAM:
        # The frame of a part of the bins has the rows that these expose.
        (tmp_path / "wide.toml").write_text(wide.to_toml())
        command(files, tmp_path / "wide.toml", "--prior", "tv", "--max-iterations", 3, "--bins", "2..8", "-o", tmp_path / "part")
        saved.append(rb.load(tmp_path / "part"))
    for found in (one.to_xarray() for one in saved):
        for axis in ("y", "x"):
            np.testing.assert_array_equal(found[axis].values, expected[axis].values)
    pytest.importorskip("zarr")
    rb.batch(frame[None], tmp_path / "videos.zarr", wide, psf, **options)
    for image in (folder / "video.ome.zarr", tmp_path / "videos.zarr"):
        ome = json.loads((image / "zarr.json").read_text())["attributes"]["ome"]
        scale, origin = ome["multiscales"][0]["datasets"][0]["coordinateTransformations"]
        assert origin["translation"][-2:] == [6.5 * first[0], 6.5 * first[1]] and scale["scale"][-2:] == [6.5, 6.5]


def test_the_command_of_the_package_checks_the_memory(tmp_path):
    large = rb.Camera(rows=4096, columns=4096, shutter="top-down", row_time_us=9.6, exposure_us=9.6)
    (tmp_path / "experiment.toml").write_text(large.to_toml())
    np.save(tmp_path / "frame.npy", np.resize(np.arange(251, dtype=np.uint8), large.frame_shape))
    np.save(tmp_path / "psf.npy", np.ones((3, 3)))
    words = ["reconstruct", tmp_path / "experiment.toml", "--frame", tmp_path / "frame.npy", "--psf", tmp_path / "psf.npy"]
    done = subprocess.run([sys.executable, "-m", "rowburst", *words, "-o", tmp_path / "out"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and "no memory for a video of 4096×4096×4096" in done.stderr


@pytest.mark.parametrize("start", [[sys.executable, "-m", "rowburst"], [os.path.join(os.path.dirname(sys.executable), "rowburst")]])
def test_the_command_comes_with_the_package(start, files, tmp_path):
    version = subprocess.run([*start, "--version"], capture_output=True, text=True)
    assert version.returncode == 0 and version.stdout.split() == ["rowburst", rb.__version__]
    wrong = subprocess.run([*start, "reconstruct", "none.toml", "--frame", "none.npy", "-o", tmp_path], capture_output=True, text=True)
    assert wrong.returncode == 2 and "none.toml" in wrong.stderr
    done = subprocess.run(
        [*start, "reconstruct", files / "experiment.toml", "--frame", files / "frame.npy", "--psf", files / "psf.npy", "--prior", "tv",
         "--max-iterations", "20", "-o", tmp_path / "out", "--json"], capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = rb.reconstruct(
        np.load(files / "frame.npy"), rb.Camera.from_file(files / "experiment.toml"), np.load(files / "psf.npy"), prior="tv", max_iterations=20)  # fmt: skip
    np.testing.assert_array_equal(np.load(tmp_path / "out" / "video.npy"), result.video)
    assert json.loads(done.stdout)["tau"] == result.tau
    # A design's page repeats what was typed.
    designed = subprocess.run([*start, "design", "--quick", "-o", tmp_path / "design"], capture_output=True)
    assert designed.returncode == 0
    assert "rowburst design --quick -o" in (tmp_path / "design" / "report.html").read_text(encoding="utf-8")
