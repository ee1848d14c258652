"""Errors can be handled without reading their text."""

import pickle

import numpy as np
import pytest

import rowburst as rb


def raised(call):
    with pytest.raises((rb.InputError, rb.WorkError)) as info:
        call()
    return info.value


def test_parameter_kind_and_value_are_data(camera, psf, capture, tmp_path):
    bad_frame = capture.frame.astype(np.float32)
    bad_frame[3, 2] = np.nan
    cases = [
        (lambda: rb.reconstruct(capture.frame, camera, psf, tau=-1.0), "tau", "invalid", "-1"),
        (lambda: rb.reconstruct(capture.frame, camera, psf, noise_sigma=0.0), "noise_sigma", "invalid", "0"),
        (lambda: rb.reconstruct(capture.frame[1:], camera, psf), "frame", "shape", None),
        (lambda: rb.reconstruct(bad_frame, camera, psf), "frame", "not-finite", None),
        (lambda: rb.reconstruct(np.zeros_like(bad_frame), camera, psf), "frame", "no-signal", None),
        (lambda: rb.reconstruct(capture.frame, camera, psf, dark=np.zeros((2, 2))), "dark", "shape", None),
        (lambda: rb.reconstruct(capture.frame, camera, psf, prior="tb"), "prior", "invalid", None),
        (lambda: rb.reconstruct(capture.frame, camera, psf, tuning={"rho": 1.0}), "tuning", "invalid", None),
        (lambda: rb.reconstruct(capture.frame, camera, psf, tuning={"decline": 0.0}), "tuning", "invalid", None),
        (lambda: rb.Psf(-np.ones((3, 3))), "psf", "invalid", None),
        (lambda: camera.replace(row_time_us=-1), "row_time_us", "invalid", "-1"),
    ]
    for call, parameter, kind, value in cases:
        error = raised(call)
        assert (type(error), error.parameter, error.kind) == (rb.InputError, parameter, kind), error
        assert value is None or error.value == value
        assert error.rule in str(error) and error.remedy in str(error)
        assert error.path is None


def test_the_file_at_fault_is_named(camera, psf, tmp_path):
    missing = tmp_path / "missing.npy"
    error = raised(lambda: rb.reconstruct(missing, camera, psf))
    assert (error.kind, error.path) == ("not-found", str(missing))
    (tmp_path / "experiment.toml").write_text("[camera]\nrows = 4\nshutter = \"top-down\"\n")
    error = raised(lambda: rb.Camera.from_file(tmp_path / "experiment.toml"))
    assert (error.kind, error.parameter) == ("missing", "columns")
    assert error.path == str(tmp_path / "experiment.toml")


def test_attributes_are_none_by_default_and_survive_pickling(camera, psf, capture):
    assert rb.InputError("words").parameter is None
    assert rb.WorkError("words").kind is None
    error = raised(lambda: rb.reconstruct(capture.frame, camera, psf, tau=-1.0))
    copy = pickle.loads(pickle.dumps(error))
    assert (copy.parameter, copy.kind, copy.value, str(copy)) == ("tau", "invalid", "-1", str(error))


def test_errors_of_the_python_side_are_data_too(camera, psf, capture, tmp_path):
    cases = [
        (lambda: rb.load(tmp_path), None, "missing", str(tmp_path)),
        (lambda: rb.reconstruct(capture.frame, camera, psf, progress="x"), "progress", "invalid", None),
        (lambda: rb.calibrate.psf([capture.frame], positions_mm=[1.0, 2.0]), "positions_mm", "shape", None),
    ]
    for call, parameter, kind, path in cases:
        error = raised(call)
        assert (error.parameter, error.kind, error.path) == (parameter, kind, path), error
        assert str(error).endswith(f"found {error.value}; {error.rule}. {error.remedy}")
