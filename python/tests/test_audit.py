"""Mistakes that a second look at the Python side found, each with what it was to be."""

import copy
import os
import pickle
import struct
import subprocess
import sys
import threading

import numpy as np
import pytest

import rowburst as rb
from rowburst import _checks, _lazy, _makers

TV = {"prior": "tv", "max_iterations": 5}
CAMERA = {"rows": 24, "columns": 30, "shutter": "dual-inside-out", "row_time_us": 9.6, "exposure_us": 9.6}

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")


@pytest.fixture
def experiment(tmp_path, camera, psf):
    np.save(tmp_path / "psf.npy", psf.array)
    (tmp_path / "experiment.toml").write_text(camera.to_toml() + '[calibration]\npsf = "psf.npy"\n[reconstruction]\nprior = "tv"\n')
    return rb.Experiment(tmp_path / "experiment.toml")


@pytest.fixture(scope="module")
def colour(capture, camera, psf):
    return rb.reconstruct_colour(capture.frame, camera.replace(bayer="grbg"), psf, prior="tv", max_iterations=10)


def refused(call, *words):
    """The error of a call, which names the argument, what was found, and what to do."""
    with pytest.raises(rb.InputError) as info:
        call()
    error = info.value
    for word in words:
        assert word in str(error), (word, str(error))
    assert error.parameter is not None or error.path is not None, str(error)
    assert error.rule and error.remedy and str(error).endswith(f"found {error.value}; {error.rule}. {error.remedy}")
    return error


# Forked processes


def in_child(call):
    """What a call says in a forked process; a process that hangs is ended, and the test fails."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.close(read)
            try:
                said = str(call())
            except Exception as error:
                said = f"{type(error).__name__}: {error}"
            os.write(write, said.encode()[:4000])
        finally:
            os._exit(0)
    os.close(write)
    timer = threading.Timer(60, lambda: os.kill(pid, 9))
    timer.start()
    try:
        with os.fdopen(read, "rb") as pipe:
            said = pipe.read().decode()
        os.waitpid(pid, 0)
    finally:
        timer.cancel()
    return said


@needs_fork
def test_a_value_that_a_thread_was_making_at_the_fork_is_made_anew():
    lazy = _lazy.Lazy()
    begun, may_end = threading.Event(), threading.Event()

    def slow():
        begun.set()
        may_end.wait(60)
        return "of the parent"

    thread = threading.Thread(target=lazy.get, args=(slow,))
    thread.start()
    begun.wait(60)
    try:
        assert in_child(lambda: lazy.get(lambda: "of the child")) == "of the child"
    finally:
        may_end.set()
        thread.join()
    assert lazy.get(lambda: "anew") == "of the parent"


def test_a_value_is_made_once_for_all_threads():
    lazy, made = _lazy.Lazy(), []

    def make():
        made.append(1)
        return len(made)

    threads = [threading.Thread(target=lazy.get, args=(make,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert lazy.get(make) == 1 and made == [1]


@needs_fork
def test_every_set_up_object_raises_in_a_forked_process(camera, psf, capture):
    reconstructor = rb.Reconstructor(camera, psf, **TV)
    operator = rb.operator(camera, psf)
    term = operator.data_term(capture.frame)
    video = np.zeros(operator.shape[1])
    operator @ video
    stored = {name: pickle.dumps(value) for name, value in (("r", reconstructor), ("o", operator), ("t", term))}
    calls = [
        lambda: reconstructor(capture.frame),
        lambda: list(reconstructor.map([capture.frame], workers=2)),
        lambda: reconstructor.live(),
        lambda: pickle.loads(stored["r"])(capture.frame),
        lambda: copy.copy(reconstructor)(capture.frame),
        lambda: operator.matvec(video),
        lambda: pickle.loads(stored["o"]).matvec(video),
        lambda: term(video),
        lambda: pickle.loads(stored["t"]).prox(video, 1.0),
    ]
    for call in calls:
        assert "forkserver" in in_child(call)
    # To be unpickled is no computation: an error there would end a worker of a pool, which would wait for ever.
    for data in stored.values():
        assert in_child(lambda data=data: type(pickle.loads(data)).__name__) in ("Reconstructor", "RollingShutterOperator", "DataTerm")


def test_copies_keep_their_bits(camera, psf, capture):
    operator = rb.operator(camera, psf)
    term = operator.data_term(capture.frame)
    video = capture.truth.ravel()
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        same = pickle.loads(pickle.dumps(operator, protocol))
        np.testing.assert_array_equal(same @ video, operator @ video)
        assert pickle.loads(pickle.dumps(term, protocol))(video) == term(video)


# A recording on disk is a raw capture


def test_the_bias_is_subtracted_from_a_file_of_floats_in_map_too(psf, capture, tmp_path):
    camera = rb.Camera(**CAMERA, bias_counts=100, bit_depth=16)
    counts = (100 + capture.frame / capture.frame.max() * 30000).astype(np.uint16)
    reconstructor = rb.Reconstructor(camera, psf, **TV)
    expected = reconstructor(counts).video
    np.save(tmp_path / "one.npy", counts.astype(np.float32))
    np.save(tmp_path / "stack.npy", np.stack([counts, counts]).astype(np.float32))
    np.save(tmp_path / "whole.npy", np.stack([counts, counts]))
    np.testing.assert_array_equal(reconstructor(tmp_path / "one.npy").video, expected)
    for name in ("one.npy", "stack.npy", "whole.npy"):
        for workers in (1, 2):
            for found in reconstructor.map(tmp_path / name, workers=workers):
                np.testing.assert_array_equal(found.video, expected)
    # An array of floats has no bias, and corrected frames are used as they are.
    subtracted = counts.astype(np.float32) - 100
    np.testing.assert_array_equal(next(reconstructor.map([subtracted])).video, expected)
    np.save(tmp_path / "subtracted.npy", subtracted[None])
    corrected = rb.Reconstructor(camera, psf, corrected=True, **TV)
    np.testing.assert_array_equal(next(corrected.map(tmp_path / "subtracted.npy")).video, corrected(subtracted).video)


# Where the field lies on the sensor


@pytest.mark.parametrize("field", [(24, 30), (25, 31), (26, 33), (27, 34)])
def test_the_axes_of_a_video_are_those_of_the_operator(field, psf, capture):
    """Light of a pixel of the field falls on the pixel of the sensor that the axes name."""
    pytest.importorskip("xarray")
    from rowburst import _napari

    camera = rb.Camera(**CAMERA, field=field)
    point = np.zeros((3, 3), np.float32)
    point[1, 1] = 1
    video = np.zeros(camera.video_shape, np.float32)
    y, x = 7, 11
    video[:, y, x] = 1
    frame = rb.operator(camera, point)(video)
    ((row, column),) = np.argwhere(frame > 0.5 * frame.max())
    result = rb.reconstruct(capture.frame, camera, psf, self_calibrate="off", **TV)
    labelled = result.to_xarray()
    assert (labelled.y.values[y], labelled.x.values[x]) == (row, column)
    assert (labelled.y.values % 1 == 0).all()
    _, options, _ = _napari._video_layer(result, "video")
    place, scale = options["translate"], options["scale"]
    assert (place[1] + scale[1] * y, place[2] + scale[2] * x) == (row, column)


# Errors name the argument, what was found, and what to do


def test_a_damaged_file_of_a_maker_is_named(tmp_path, monkeypatch):
    path = tmp_path / "run.pcoraw"
    path.write_bytes(b"II\x2b\0\x08\0\0\0\x10\0")
    for kind in (struct.error, AssertionError, ZeroDivisionError, UnboundLocalError):
        def fails(path, kind=kind):
            raise kind("unpack requires a buffer")

        monkeypatch.setitem(_makers._READERS, ".pcoraw", fails)
        error = refused(lambda: rb.read_frames(path), "run.pcoraw", "cannot read", kind.__name__)
        assert error.kind == "unreadable"


def test_a_cut_pcoraw_file_is_named(tmp_path):
    pytest.importorskip("tifffile")
    path = tmp_path / "run.pcoraw"
    path.write_bytes(b"II\x2b\0\x08\0\0\0\x10\0")
    refused(lambda: rb.read_frames(path), "run.pcoraw", "cannot read")


def test_a_package_that_is_missing_is_named(camera, psf, capture, monkeypatch):
    import rowburst.dask

    operator = rb.operator(camera, psf)
    term = operator.data_term(capture.frame)
    for name in ("scico", "jax", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "rowburst._scico", raising=False)
    for call in (operator.to_scico, term.to_scico):
        assert refused(call, "pip install scico").kind == "missing"
    run = lambda: rowburst.dask.reconstruct("frames.npy", "out.zarr", "experiment.toml", None)
    refused(run, "pip install distributed")


def test_design_takes_true_for_a_bar():
    for progress in ("x", 1):
        refused(lambda progress=progress: rb.design(trials=False, progress=progress), "progress")
    pytest.importorskip("tqdm")
    for progress in (True, False, np.True_):
        assert round(rb.design(trials=False, progress=progress).numbers["frame_rate_hz"]) == 104167


def test_a_bar_of_parts_ends_at_hundred():
    pytest.importorskip("tqdm")
    from rowburst import _design

    bar, callback = _design._listener(True)
    assert callback is bar
    for part in (0.0, 0.25, 0.251, 1.0):
        assert callback(part) is None
    assert bar.bar.n == 100
    bar.close()


def test_a_port_is_checked(result, tmp_path):
    saved = rb.load(result.save(tmp_path / "result"))
    for port in ("http", -1, 65536, 70000, 8787.5, True):
        for view in (result.view, saved.view):
            error = refused(lambda: view(port=port, open_browser=False), "port: found", "0 for any free port")
            assert error.parameter == "port"


def test_files_that_cannot_be_written_are_named(result, tmp_path):
    nowhere = tmp_path / "none" / "file"
    stored = pickle.loads(pickle.dumps(rb.design(trials=False)))
    (tmp_path / "file").write_text("")
    for call in (
        lambda: result.report(nowhere.with_suffix(".html")),
        lambda: result.report().save(nowhere.with_suffix(".html")),
        lambda: result.figure(nowhere.with_suffix(".svg")),
        lambda: result.figure().save(nowhere.with_suffix(".png")),
        lambda: stored.save(tmp_path / "file"),
    ):
        with pytest.raises(rb.WorkError, match="writing: ") as info:
            call()
        assert info.value.kind == "io" and str(tmp_path) in info.value.path and info.value.remedy in str(info.value)
    refused(lambda: result.report(3), "path: found")
    refused(lambda: result.figure(3), "path: found")


def test_a_ragged_list_is_named(camera, psf, capture, tmp_path):
    ragged = [[1, 2], [3]]
    reconstructor = rb.Reconstructor(camera, psf, **TV)
    for name, call in (
        ("frame", lambda: rb.reconstruct(ragged, camera, psf)),
        ("frame", lambda: reconstructor(ragged)),
        ("frame", lambda: rb.sweep(ragged, camera, psf, tau=[0.1])),
        ("frame", lambda: rb.reconstruct_chunked(ragged, tmp_path / "c", camera, psf, prior="tv")),
        ("frame", lambda: rb.reconstruct_colour(ragged, camera.replace(bayer="rggb"), psf)),
        ("frame", lambda: rb.operator(camera, psf).data_term(ragged)),
        ("psf", lambda: rb.reconstruct(capture.frame, camera, ragged)),
        ("psf", lambda: rb.operator(camera, ragged)),
        ("dark", lambda: rb.reconstruct(capture.frame, camera, psf, dark=ragged)),
        ("bad_pixels", lambda: rb.Reconstructor(camera, psf, bad_pixels=ragged)),
        ("truth", lambda: rb.reconstruct(capture.frame, camera, psf, truth=[[[1]], [[1, 2]]])),
        ("guide", lambda: rb.reconstruct(capture.frame, camera, psf, guide=ragged)),
    ):
        error = refused(call, "lengths")
        assert (error.parameter, error.kind) == (name, "shape")
    # A list whose rows have one length is an array.
    found = rb.reconstruct(capture.frame.tolist(), camera, psf, **TV)
    np.testing.assert_array_equal(found.video, rb.reconstruct(capture.frame, camera, psf, **TV).video)


def test_a_channel_is_a_number(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((2, 3, 4), np.uint16))
    for channel in ("GFP", -1, 1.0, True):
        error = refused(lambda channel=channel: rb.read_frames(tmp_path / "a.npy", channel=channel), "channel: found")
        assert error.parameter == "channel"
    refused(lambda: rb.read_frames(tmp_path / "none.tif", channel=0), "no such file")


def test_a_channel_of_an_ome_zarr_image_is_read(tmp_path):
    zarr = pytest.importorskip("zarr")
    frames = np.random.default_rng(6).integers(0, 60000, (5, 2, 1, 7, 9)).astype(np.uint16)
    axes = [{"name": name} for name in "tczyx"]
    multiscales = [{"axes": axes, "datasets": [{"path": "0"}]}]
    for version, attributes in ((2, {"multiscales": multiscales}), (3, {"ome": {"version": "0.5", "multiscales": multiscales}})):
        path = tmp_path / f"{version}.zarr"
        group = zarr.create_group(str(path), zarr_format=version, attributes=attributes)
        array = group.create_array("0", shape=frames.shape, dtype="uint16")
        array[...] = frames
        for channel in (0, 1):
            np.testing.assert_array_equal(rb.read_frames(path, channel=channel), frames[:, channel, 0])
        refused(lambda path=path: rb.read_frames(path, channel=2), "channel: found 2", "2 channels")
        refused(lambda path=path: rb.read_frames(path / "0", channel=0), "only TIFF")


def test_a_montage_has_a_number_of_frames(result):
    for call in (lambda: result.montage("a"), lambda: result.montage(2.5), lambda: result.montage(True)):
        assert refused(call).parameter == "frames"
    assert refused(lambda: result.montage(3, columns="a")).parameter == "columns"


def test_a_batch_is_of_a_recording_whose_length_is_known(camera, psf, capture, tmp_path):
    run = lambda frames: rb.batch(frames, tmp_path / "out.zarr", camera, psf, prior="tv")
    for frames in (iter([capture.frame]), (frame for frame in [capture.frame]), 3):
        error = refused(lambda frames=frames: run(frames), "frames: found", "Reconstructor.map")
        assert error.parameter == "frames"
    reconstructor = rb.Reconstructor(camera, psf, **TV)
    refused(lambda: list(reconstructor.map(3)), "frames: found 3")


def test_what_is_no_camera_is_named(camera, psf, capture, experiment, tmp_path):
    frame, path = capture.frame, tmp_path / "experiment.toml"
    for call in (
        lambda: rb.reconstruct(frame, str(path)),
        lambda: rb.reconstruct(frame, path),
        lambda: rb.Reconstructor(path),
        lambda: rb.sweep(frame, path, prior=["tv"]),
        lambda: rb.reconstruct_chunked(frame, tmp_path / "c", path),
        lambda: rb.reconstruct_colour(frame, path),
    ):
        error = refused(call, "camera: found", "rb.Experiment(", "experiment.toml")
        assert error.parameter == "camera"
    for call in (
        lambda: rb.operator(experiment, psf),
        lambda: rb.design(experiment, trials=False),
        lambda: rb.calibrate.psf(frame, camera=experiment),
        lambda: rb.calibrate.timing(frame, frequency_hz=2000, camera=experiment),
    ):
        refused(call, "camera: found an object of type Experiment", "it is a Camera", "experiment.camera")
    refused(lambda: rb.operator(path, psf), "camera: found", ".camera")
    refused(lambda: rb.reconstruct(frame, psf, camera), "camera: found an object of type Psf", "Camera or an Experiment")
    refused(lambda: rb.operator(camera, experiment), "psf: found an object of type Experiment", "experiment.psf")
    refused(lambda: rb.reconstruct(frame, camera, experiment), "psf: found an object of type Experiment")
    # Those of the extension itself.
    with pytest.raises((TypeError, rb.InputError), match="(?s)Experiment.*Camera.*camera"):
        rb.simulate(experiment)
    with pytest.raises((TypeError, rb.InputError), match="(?s)Experiment.*Camera.*camera"):
        rb.LiveView(experiment, psf)


def test_the_values_of_a_sweep_are_checked_before_the_first_run(camera, psf, capture):
    seen = []
    for name, values in (
        ("tau", [0.1, -1.0]),
        ("tau", [0.1, "-1"]),
        ("tau", [0.1, "nan"]),
        ("tau", [0.1, np.inf]),
        ("tau", [0.1, True]),
        ("noise_sigma", [1.0, 0.0]),
        ("noise_sigma", [1.0, "a"]),
        ("noise_sigma", [1.0, True]),
        ("max_iterations", [5, 2.5]),
        ("max_iterations", [5, True]),
        ("prior", ["tv", 3]),
    ):
        call = lambda name=name, values=values: rb.sweep(capture.frame, camera, psf, progress=seen.append, **{name: values})
        assert refused(call, f"{name}: found").parameter == name
    assert not seen
    assert refused(lambda: rb.sweep(capture.frame, camera, psf, prior=["tv"], noise_sigma=True)).parameter == "noise_sigma"


def test_no_machine_has_so_many_threads(camera, psf, capture, tmp_path):
    for threads in (20000, 0, -2, True, 1.5, "a"):
        for call in (
            lambda: rb.reconstruct(capture.frame, camera, psf, threads=threads),
            lambda: rb.Reconstructor(camera, psf, threads=threads),
            lambda: rb.sweep(capture.frame, camera, psf, prior=["tv"], threads=threads),
            lambda: rb.batch(capture.frame[None], tmp_path / "out.zarr", camera, psf, threads=threads),
            lambda: rb.reconstruct_chunked(capture.frame, tmp_path / "c", camera, psf, threads=threads),
            lambda: rb.reconstruct_colour(capture.frame, camera.replace(bayer="rggb"), psf, threads=threads),
            lambda: rb.design(trials=False, threads=threads),
            lambda: rb.calibrate.sensor(capture.frame, capture.frame, threads=threads),
            lambda: rb.calibrate.psf(capture.frame, threads=threads),
            lambda: rb.calibrate.timing(capture.frame, frequency_hz=2000, threads=threads),
        ):
            assert refused(call, "threads: found").parameter == "threads"


def test_truth_values_are_no_numbers(camera, psf, capture, tmp_path):
    frame, mosaic = capture.frame, camera.replace(bayer="rggb")
    reconstructor = rb.Reconstructor(camera, psf, **TV)
    live = rb.LiveView(camera, psf)
    counts = np.ones((2, 24, 30), np.uint16)
    for value in (True, False, np.True_):
        for name, call in (
            ("noise_sigma", lambda: rb.reconstruct(frame, camera, psf, noise_sigma=value)),
            ("time_budget_s", lambda: rb.reconstruct(frame, camera, psf, time_budget_s=value)),
            ("noise_sigma", lambda: rb.Reconstructor(camera, psf, noise_sigma=value)),
            ("time_budget_s", lambda: reconstructor(frame, time_budget_s=value)),
            ("noise_sigma", lambda: rb.batch(frame[None], tmp_path / "o.zarr", camera, psf, noise_sigma=value)),
            ("frame_period_us", lambda: rb.batch(frame[None], tmp_path / "o.zarr", camera, psf, frame_period_us=value)),
            ("noise_sigma", lambda: rb.reconstruct_chunked(frame, tmp_path / "c", camera, psf, noise_sigma=value)),
            ("noise_sigma", lambda: rb.reconstruct_colour(frame, mosaic, psf, noise_sigma=value)),
            ("time_budget_s", lambda: rb.reconstruct_colour(frame, mosaic, psf, time_budget_s=value)),
            ("time_budget_s", lambda: next(rb.capture.from_arrays(counts).watch(live, time_budget_s=value))),
            ("wavelength_nm", lambda: rb.design(trials=False, wavelength_nm=value)),
            ("trial_snr", lambda: rb.design(trials=False, trial_snr=[8, value])),
            ("frequency_hz", lambda: rb.calibrate.timing(frame, frequency_hz=value)),
            ("exposures_ms", lambda: rb.calibrate.psf(frame, exposures_ms=[value])),
        ):
            assert refused(call, name, f": found {value}").parameter == name
    for number in (3, 3.0, np.float32(3), np.array(3.0)):
        rb.reconstruct(frame, camera, psf, noise_sigma=number, **TV)
    for snrs in (8, "8", None):
        refused(lambda snrs=snrs: rb.design(trials=False, trial_snr=snrs), "trial_snr: found", "a sequence of numbers")


def test_an_experiment_s_psf_passes_the_type_checker(tmp_path):
    script = tmp_path / "recipe.py"
    script.write_text(
        "import numpy as np\nimport rowburst as rb\n"
        'e = rb.Experiment("experiment.toml")\nf = np.ones((2, 2))\n'
        'A = rb.operator(e.camera, e.psf)\nA.data_term("frame.npy")\nlive = rb.LiveView(e.camera, e.psf)\n'
        "r: rb.Reconstructor = e.reconstructor(threads=1)\nprint(r(f).fit, live.next(f).fit)\n"
        'found = rb.sweep(f, e, prior=["tv", "l1"])\nfirst = found[0]\n'
        "if first is not None:\n    print(first.fit)\nprint(len(found[1:]))\n"
        "colour = rb.reconstruct_colour(f, e)\nprint(colour.planes['red'].tau, colour.fit, colour.video.shape)\n"
    )
    pytest.importorskip("mypy")
    done = subprocess.run([sys.executable, "-m", "mypy", "--strict", script], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stdout


# A result in colour is a result


def test_a_result_in_colour_has_what_a_result_has(colour, tmp_path):
    saved = rb.load(colour.save(tmp_path / "colour"))
    for each in (colour, saved):
        assert each.fit in ("good", "suspicious", "bad") and each.fit_reason and each.prior == "tv"
        assert each.frame_rate_hz == pytest.approx(colour.planes["red"].frame_rate_hz)
        np.testing.assert_allclose(each.time_us, saved.time_us, atol=1e-9)
        residual = each.residual
        assert residual.shape == (24, 30)
        for name, (row, column) in {"green-1": (0, 0), "red": (0, 1), "blue": (1, 0), "green-2": (1, 1)}.items():
            np.testing.assert_array_equal(residual[row::2, column::2], colour.planes[name].residual)
        page = each._repr_html_()
        assert type(each).__name__ in page and "green-2" in page and "maximum over time" in page and "http" not in page
        assert each.figure(plane="blue").svg.startswith("<?xml")
        assert refused(lambda each=each: each.figure(plane="green"), "plane: found 'green'").parameter == "plane"
        assert sorted(each.traces()) == sorted(colour.planes)
        with each.view(port=0, open_browser=False) as view:
            assert view.url.startswith("http://127.0.0.1:")
    numbers, theirs = colour.numbers, saved.numbers
    assert numbers["start_us"] == pytest.approx(theirs["start_us"])
    assert numbers["frame_rate_hz"] == pytest.approx(theirs["frame_rate_hz"])
    assert all(numbers[name] == theirs[name] for name in ("bayer", "frames", "rows", "columns"))
    for ours, written in zip(numbers["planes"], theirs["planes"], strict=True):
        assert all(ours[name] == written[name] for name in ("name", "prior", "tau", "fit"))
        assert ours["residual_over_sigma"] == pytest.approx(written["residual_over_sigma"])
    assert colour.excluded.shape == (24, 30) and colour.excluded.dtype == np.uint8
    assert colour.traces([(4, 5)])["red"][0].region == (3, 4, 3, 3)
    assert colour.report(tmp_path / "report.html", plane="red") == (tmp_path / "report.html").read_text(encoding="utf-8")
    refused(lambda: colour.report(plane=3), "plane: found 3")
    refused(lambda: colour.view(port="a"), "port: found 'a'")


def test_a_result_in_colour_is_copied_whole(colour):
    for same in (pickle.loads(pickle.dumps(colour)), copy.deepcopy(colour), copy.copy(colour)):
        np.testing.assert_array_equal(same.video, colour.video)
        assert not same.video.flags.writeable and same.start_us == colour.start_us and same.bayer == colour.bayer
        assert same.fit == colour.fit and same.numbers == colour.numbers


def test_a_result_in_colour_has_labelled_axes(colour, tmp_path):
    pytest.importorskip("xarray")
    saved = rb.load(colour.save(tmp_path / "colour"))
    for each in (colour, saved):
        video = each.to_xarray()
        assert video.dims == ("time", "y", "x", "colour") and list(video.colour.values) == ["red", "green", "blue"]
        np.testing.assert_array_equal(video.sel(colour="blue").values, colour.planes["blue"].video)
        np.testing.assert_array_equal(video.y, np.arange(12))
        np.testing.assert_allclose(video.time, each.time_us)
        assert video.attrs["fit"] == colour.fit and video.attrs["bayer"] == "grbg"


def test_pictures_of_a_result_in_colour(colour):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    axes = colour.plot()
    brightest = colour.video.max(axis=0)
    np.testing.assert_allclose(axes[0, 0].images[0].get_array(), brightest / brightest.max(), rtol=1e-6)
    np.testing.assert_allclose(axes[1, 0].lines[2].get_ydata(), colour.video[..., 2].sum(axis=(1, 2), dtype=float))
    np.testing.assert_array_equal(axes[1, 1].images[0].get_array(), colour.residual)
    shown = colour.montage(4)
    assert len(shown) == 4
    np.testing.assert_allclose(shown[0].images[0].get_array(), colour.video[0] / colour.video.max(), rtol=1e-6)
    assert colour.time_colour().images[0].get_array().shape == (12, 15, 3)
    refused(lambda: colour.montage("a"), "frames: found 'a'")
    pyplot.close("all")


def test_a_picture_in_colour_is_a_png():
    Image = pytest.importorskip("PIL.Image")
    import io

    from rowburst._display import _png

    picture = np.random.default_rng(1).random((5, 7, 3))
    read = np.asarray(Image.open(io.BytesIO(_png(picture))))
    np.testing.assert_array_equal(read, (255 * picture / picture.max()).astype(np.uint8))


# Values describe themselves


def test_every_value_describes_itself_in_one_line(camera, psf, capture):
    operator = rb.operator(camera, psf)
    counts = np.ones((2, 24, 30), np.uint16)
    source = rb.capture.from_arrays(counts, {"row_time_us": 9.6}, name="bench")
    for value, word in (
        (operator, "RollingShutterOperator"),
        (operator.data_term(capture.frame), "24×30"),
        (source, "bench"),
        (next(source), "24×30"),
    ):
        assert word in repr(value) and len(repr(value)) < 120 and " at 0x" not in repr(value)


def test_a_step_of_nothing_is_named(camera, psf, capture):
    term = rb.operator(camera, psf).data_term(capture.frame)
    for step in (0.0, -1.0, np.nan, True, "a"):
        assert refused(lambda step=step: term.proxdual(np.zeros(camera.video_shape), step), "step: found").parameter == "step"
