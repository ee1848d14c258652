"""Pickle, copy and spawned processes."""

import copy
import multiprocessing
import pickle

import numpy as np
import pytest

import rowburst as rb

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)
CAMERA = {"rows": 24, "columns": 30, "shutter": "dual-inside-out", "row_time_us": 9.6, "exposure_us": 9.6}


def copies(value):
    """Every way to copy ``value``."""
    yield from (pickle.loads(pickle.dumps(value, protocol)) for protocol in PROTOCOLS)
    yield copy.copy(value)
    yield copy.deepcopy(value)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"shutter": "global"},
        {"shutter": "custom", "row_order": [*range(1, 24), 0]},
        {"bayer": "grbg"},
        {"field": (40, 41), "bins_per_row": 3, "binning": 2, "bit_depth": 12, "bias_counts": 100.25,
         "gain_electrons_per_count": 1 / 3, "read_noise_electrons": 1.6, "full_well_counts": 4000.0, "pixel_pitch_um": 6.5},
    ],
)
def test_cameras(change):
    camera = rb.Camera(**(CAMERA | change))
    for same in copies(camera):
        assert same == camera and same.row_order == camera.row_order and same.bayer == camera.bayer


def test_psfs_bit_by_bit(psf):
    # 1/3 sums to 1 by rounding alone: to scale it again would change it.
    rng = np.random.default_rng(1)
    uneven = [rng.exponential(size=(31, 33)).astype(np.float32) / 3 for _ in range(2)]
    for original in (psf, rb.Psf(uneven[0]), rb.Psf.patches(uneven, [(-5.0, 0.0), (5.5, 0.0)])):
        for same in copies(original):
            assert same == original and same.offsets_px == original.offsets_px
            for a, b in zip(same.arrays, original.arrays, strict=True):
                np.testing.assert_array_equal(a, b)


def test_experiments(tmp_path, camera, psf):
    np.save(tmp_path / "psf.npy", psf.array)
    np.save(tmp_path / "flat.npy", np.full(camera.frame_shape, 3, np.uint16))
    (tmp_path / "experiment.toml").write_text(
        camera.to_toml() + '[calibration]\npsf = "psf.npy"\nflat = "flat.npy"\n[reconstruction]\nprior = "tv"\ntau = 0.5\n'
        "[recording]\nframe_period_us = 1000\n"
    )
    original = rb.Experiment(tmp_path / "experiment.toml")
    for same in copies(original):
        assert (same.camera, same.psf, same.prior, same.tau) == (camera, original.psf, "tv", 0.5)
        assert same.dark is None and same.frame_period_us == 1000 and same.metadata_taken == {}
        np.testing.assert_array_equal(same.flat, original.flat)


def test_simulations(camera, psf, capture):
    biased = rb.simulate(rb.Camera(**CAMERA, bias_counts=100), capture.truth, psf)
    for original in (capture, biased):
        for same in copies(original):
            assert (same.camera, same.psf, same.noise_sigma) == (original.camera, original.psf, original.noise_sigma)
            for name in ("frame", "truth", "direct"):
                np.testing.assert_array_equal(getattr(same, name), getattr(original, name))
            assert same.frame.dtype == original.frame.dtype and same.background is None and same.leds == original.leds


@pytest.mark.parametrize(
    "options", [{"prior": "auto"}, {"prior": "tv+0.5*tdiff+background+support", "tau": 0.3, "max_iterations": 20}]
)
def test_results(options, camera, psf, capture, tmp_path):
    bad = np.zeros(camera.frame_shape, np.uint8)
    bad[3, 4] = 1
    original = rb.reconstruct(capture.frame, camera, psf, truth=capture.truth, bad_pixels=bad, **options)
    numbers, traces = original.numbers, original.traces([(8, 9)])
    for same in (pickle.loads(pickle.dumps(original)), copy.deepcopy(original), copy.copy(original)):
        np.testing.assert_array_equal(same.video, original.video)
        assert not same.video.flags.writeable and same.video.dtype == np.float32
        np.testing.assert_array_equal(same.residual, original.residual)
        np.testing.assert_array_equal(same.excluded, original.excluded)
        np.testing.assert_array_equal(same.coverage, original.coverage)
        assert same.effective_sigma == original.effective_sigma
        assert (same.background is None) == (original.background is None)
        assert same.numbers == numbers and repr(same) == repr(original)
        for a, b in zip(same.traces([(8, 9)]), traces, strict=True):
            np.testing.assert_array_equal(a.debiased, b.debiased)
            np.testing.assert_array_equal(a.standard_error, b.standard_error)
    # The numbers of the stored state itself, which no cache holds.
    stored = pickle.loads(pickle.dumps(original._native))
    again = rb.Result(stored, camera).numbers
    for key in set(numbers) - {"trace_errors"}:
        assert again[key] == numbers[key], key
    rb.Result(stored, camera).save(tmp_path / "out")
    np.testing.assert_array_equal(np.load(tmp_path / "out" / "video.npy"), original.video)


def test_a_refitted_result_stays_refitted(camera, psf, capture):
    prior = "tv+0.5*tdiff+support"
    original = rb.reconstruct(capture.frame, camera, psf, truth=capture.truth, prior=prior, debias=True)
    plain = rb.reconstruct(capture.frame, camera, psf, truth=capture.truth, prior=prior)
    same = pickle.loads(pickle.dumps(original))
    assert same.numbers["debias"] == original.numbers["debias"]
    # The stored state itself, which no cache holds.
    again = rb.Result(pickle.loads(pickle.dumps(original._native)), camera)
    assert again.numbers["debias"] == original.numbers["debias"] and "debias" not in plain.numbers
    # Traces are those of the video before it was refitted, of any region, as on the command line.
    for result in (original, again):
        for a, b in zip(result.traces([(8, 9)]), plain.traces([(8, 9)]), strict=True):
            np.testing.assert_array_equal(a.value, b.value)
            np.testing.assert_array_equal(a.debiased, b.debiased)


def test_joblib_gives_the_same(camera, psf, capture):
    joblib = pytest.importorskip("joblib")
    reconstructor = rb.Reconstructor(camera, psf, prior="tv", max_iterations=10, threads=1)
    frames = [capture.frame, 2 * capture.frame]
    found = joblib.Parallel(n_jobs=2)(joblib.delayed(reconstructor)(frame) for frame in frames)
    for frame, result in zip(frames, found, strict=True):
        np.testing.assert_array_equal(result.video, reconstructor(frame).video)


def test_calibrations_and_designs(tmp_path):
    rng = np.random.default_rng(11)
    light = np.repeat([200.0, 800.0, 3000.0], 4)[:, None, None]
    flats = (rng.normal(100, 3, (12, 32, 32)) + rng.poisson(2 * light, (12, 32, 32)) / 2).round()
    sensor = rb.calibrate.sensor(rng.normal(100, 3, (20, 32, 32)).round(), flats)
    large = rb.Camera(rows=96, columns=96, shutter="top-down", row_time_us=10, exposure_us=10)
    point = rb.calibrate.psf(100 + 4e7 * rb.speckle_psf(large, diffuser_deg=0.4).array)
    row = np.arange(512)[:, None] * 9.6e-6
    stripes = 1000 + 600 * np.sin(2 * np.pi * 2000 * row) + rng.normal(0, 8, (512, 40))
    timing = rb.calibrate.timing(stripes, frequency_hz=2000)
    design = rb.design(trials=False)
    for original in (sensor, point, timing, design):
        written = original.save(tmp_path / type(original).__name__ / "original")
        # A copy of a copy as well.
        once = pickle.loads(pickle.dumps(original))
        for i, same in enumerate((once, copy.deepcopy(once), copy.copy(original))):
            assert type(same) is type(original) and same.numbers == original.numbers and repr(same) == repr(original)
            saved = same.save(tmp_path / type(original).__name__ / str(i))
            names = {p.relative_to(written).as_posix() for p in written.rglob("*") if p.is_file() and p.name[0] != "."}
            assert names == {p.relative_to(saved).as_posix() for p in saved.rglob("*") if p.is_file() and p.name[0] != "."}
            assert all((saved / name).read_bytes() == (written / name).read_bytes() for name in names)
    for name in ("dark", "flat", "response", "read_noise", "bad_pixels"):
        np.testing.assert_array_equal(getattr(pickle.loads(pickle.dumps(sensor)), name), getattr(sensor, name))
    assert pickle.loads(pickle.dumps(sensor)).camera_fields == sensor.camera_fields
    assert pickle.loads(pickle.dumps(point)).psf == point.psf
    assert pickle.loads(pickle.dumps(timing)).camera_fields == timing.camera_fields
    assert str(pickle.loads(pickle.dumps(design))) == str(design)


def test_a_reconstructor_is_copied(camera, psf, capture):
    original = rb.Reconstructor(camera, psf, prior="tv", max_iterations=10)
    expected = original(capture.frame).video
    for same in (copy.deepcopy(original), copy.copy(original)):
        np.testing.assert_array_equal(same(capture.frame).video, expected)


def test_dask_takes_every_value(camera, psf, capture, tmp_path):
    distributed = pytest.importorskip("distributed")
    np.save(tmp_path / "psf.npy", psf.array)
    (tmp_path / "experiment.toml").write_text(camera.to_toml() + '[calibration]\npsf = "psf.npy"\n')
    experiment = rb.Experiment(tmp_path / "experiment.toml")
    expected = made_elsewhere(capture.frame, camera, psf)
    with distributed.Client(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None) as client:
        found = client.submit(rb.reconstruct, capture.frame, camera, psf, prior="tv", max_iterations=10)
        again = client.submit(rb.reconstruct, capture.frame, experiment, prior="tv", max_iterations=10)
        largest = client.submit(lambda result: float(result.video.max()), expected)
        np.testing.assert_array_equal(found.result(timeout=120).video, expected.video)
        np.testing.assert_array_equal(again.result(timeout=120).video, expected.video)
        assert largest.result(timeout=120) == expected.video.max()


def test_operators_and_data_terms(camera, psf, capture):
    operator = rb.operator(camera, psf, dtype=np.float32)
    video = capture.truth.ravel()
    for same in (pickle.loads(pickle.dumps(operator)), copy.deepcopy(operator)):
        assert (same.shape, same.dtype, same.camera) == (operator.shape, operator.dtype, camera)
        np.testing.assert_array_equal(same @ video, operator @ video)
    term = operator.data_term(capture.frame)
    assert pickle.loads(pickle.dumps(term))(video) == term(video)


def test_a_live_view_is_refused(camera, psf):
    live = rb.LiveView(camera, psf)
    for attempt in (pickle.dumps, copy.copy, copy.deepcopy):
        with pytest.raises(TypeError, match="LiveView cannot be pickled.*each process"):
            attempt(live)


def made_elsewhere(frame, camera, psf):
    return rb.reconstruct(frame, camera, psf, prior="tv", max_iterations=10)


def test_a_spawned_process_gives_the_same(camera, psf, capture):
    expected = made_elsewhere(capture.frame, camera, psf)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.apply_async(made_elsewhere, (capture.frame, camera, psf)).get(timeout=120)
    np.testing.assert_array_equal(found.video, expected.video)
    assert found.numbers["seconds"] > 0
