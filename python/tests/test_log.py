"""Every step in Python's logging, under the name rowburst; nothing without it."""

import logging

import numpy as np
import pytest

import rowburst as rb


def capture() -> tuple[np.ndarray, rb.Camera, rb.Psf]:
    camera = rb.Camera(rows=54, columns=54, shutter="dual-inside-out", row_time_us=10, exposure_us=10)
    simulation = rb.simulate(camera, "digits", seed=1)
    return simulation.frame, camera, simulation.psf


def test_steps_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="rowburst"):
        rb.reconstruct(*capture())
    logged = [(record.name, record.levelno) for record in caplog.records]
    assert set(logged) == {("rowburst", logging.INFO)}
    for step in ["set up a frame", "check of the model", "tried prior", "final run"]:
        assert step in caplog.text


def test_details_are_logged_on_request(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, logger="rowburst"):
        rb.reconstruct(*capture(), prior="tv")
    assert "set up the operator" in caplog.text


def test_nothing_is_logged_by_default(caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]) -> None:
    # Packages that other tests import have set up the root logger.
    with caplog.at_level(logging.WARNING):
        rb.reconstruct(*capture())
    assert not caplog.records
    assert capfd.readouterr() == ("", "")
