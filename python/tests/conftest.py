"""A small capture that all tests share."""

import numpy as np
import pytest

import rowburst as rb


@pytest.fixture(scope="session")
def camera():
    return rb.Camera(rows=24, columns=30, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)


@pytest.fixture(scope="session")
def psf(camera):
    """A random one: small fields have no room for the envelope of a lens."""
    values = np.random.default_rng(3).exponential(size=(47, 59)).astype(np.float32)
    return rb.Psf(values)


@pytest.fixture(scope="session")
def capture(camera, psf):
    scene = np.zeros(camera.video_shape, np.float32)
    for t in range(len(scene)):
        scene[t, 3 + t : 6 + t, 4 + 2 * (t % 8) : 7 + 2 * (t % 8)] = 1 + t % 3
    return rb.simulate(camera, scene, psf, snr=256, seed=2)


@pytest.fixture(scope="session")
def result(capture, camera, psf):
    return rb.reconstruct(capture.frame, camera, psf, truth=capture.truth, prior="tv+0.5*tdiff+support")
