#!/usr/bin/env python3
"""docs/self-calibration-table.md: frames whose PSF or camera is not quite as given, before and after self-calibration.

    cargo build --release
    python3 scripts/self_calibration.py -o docs/self-calibration-table.md
    python3 scripts/self_calibration.py --quick
    python3 scripts/self_calibration.py --match "digits, scale"

Each row is a frame of 108x108 pixels, simulated without noise and without the fault. The fault is planted here, by
other code than that of the correction: the PSF is resampled by cubic splines in space, its blur is a disc, its noise is
in electrons. Then the program reconstructs with --self-calibrate off and with the default. PSNR is after the best
common factor on the video, since a fault may change the light as a whole.

Finished runs are kept in --cache (a folder for each build of the program). Needs numpy, scipy and Pillow: what is
missing is installed by pip into a virtual environment. Progress goes to standard error.
"""

import argparse
from pathlib import Path
from types import SimpleNamespace

from common import ROOT, command_line, commit, machine, say, table, with_packages

CACHE = ROOT / "target/self-calibration"
if __name__ == "__main__":
    # The packages have to be there before the next lines.
    with_packages(CACHE, __file__, ["numpy", "scipy", "PIL"])

import numpy as np
from real_frames import Bench, photographed, simulated, with_noise
from scipy.ndimage import affine_transform, fourier_shift
from scipy.signal import fftconvolve

SCENES = ["digits", "moving", "leds"]


# ---------------------------------------------------------------- faults of the PSF


def distorted(psf, scale=0.0, rotation_deg=0.0, anisotropy=0.0, shear=0.0):
    """The PSF stretched, turned and sheared about zero displacement."""
    turn = np.deg2rad(rotation_deg)
    matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    matrix = matrix @ np.array([[1 + scale + anisotropy, shear], [shear, 1 + scale - anisotropy]])
    inverse, centre = np.linalg.inv(matrix), np.array([side // 2 for side in psf.shape])
    return np.maximum(affine_transform(psf.astype(float), inverse, centre - inverse @ centre, order=3), 0)


def through_pinhole(psf, rms_px):
    """The PSF of a pinhole: a disc whose radius along an axis has this rms."""
    radius, fine = 2 * rms_px, 16
    half = int(np.ceil(radius + 0.5))
    grid = (np.arange((2 * half + 1) * fine) + 0.5) / fine - half - 0.5
    disc = np.hypot(grid[:, None], grid) <= radius
    kernel = disc.reshape(2 * half + 1, fine, 2 * half + 1, fine).mean((1, 3))
    return np.maximum(fftconvolve(psf.astype(float), kernel / kernel.sum(), mode="same"), 0)


def with_floor(psf, fraction):
    """A capture of 8 bits with even light under it, `fraction` of the maximum."""
    return np.round(psf * 255 / psf.max()) + round(255 * fraction)


def decorrelated(psf, correlation):
    """Speckle of this correlation with `psf`; the turned PSF stands for independent speckle."""
    ratio = np.sqrt(1 / correlation**2 - 1)
    return psf + ratio * psf[::-1, ::-1]


# ---------------------------------------------------------------- faults of the camera


def place(shape):
    rows, columns = (np.linspace(-1, 1, side) for side in shape)
    return rows[:, None], columns[None]


def vignetted(light, part):
    y, x = place(light.shape)
    return light * (1 - part * (x**2 + y**2) / 2)


def with_stray_light(light, part, slope=0.0):
    _, x = place(light.shape)
    return light + part * light.mean() * (1 + slope * x)


def banded(light, part, rng):
    return light + part * light.mean() * rng.standard_normal((len(light), 1))


# Changes of PSF and light, each of (array, rng).
FAULTS = {
    "nothing": (None, None),
    "scale 1 %": (lambda p, r: distorted(p, scale=0.01), None),
    "scale 0.3 %": (lambda p, r: distorted(p, scale=0.003), None),
    "rotation 0.3°": (lambda p, r: distorted(p, rotation_deg=0.3), None),
    "anisotropy 0.5 %": (lambda p, r: distorted(p, anisotropy=0.005), None),
    "shear 0.5 %": (lambda p, r: distorted(p, shear=0.005), None),
    "floor 2 %": (lambda p, r: with_floor(p, 0.02), None),
    "pinhole blur 0.5 px": (lambda p, r: through_pinhole(p, 0.5), None),
    "PSF noise 2000 e": (lambda p, r: photographed(p, 2000, r), None),
    "PSF noise 200 e": (lambda p, r: photographed(p, 200, r), None),
    "decorrelation 0.95": (lambda p, r: decorrelated(p, 0.95), None),
    "vignetting 20 %": (None, lambda b, r: vignetted(b, 0.2)),
    "stray light 5 % with a slope": (None, lambda b, r: with_stray_light(b, 0.05, 1)),
    "banding 1 %": (None, lambda b, r: banded(b, 0.01, r)),
    "many at once": (
        lambda p, r: photographed(distorted(p, scale=0.005, rotation_deg=0.2), 2000, r) + 0.02 * p.max(),
        lambda b, r: with_stray_light(vignetted(b, 0.1), 0.03),
    ),
    "scale 2 %": (lambda p, r: distorted(p, scale=0.02), None),
    "rotation 0.6°": (lambda p, r: distorted(p, rotation_deg=0.6), None),
    "pinhole blur 1 px": (lambda p, r: through_pinhole(p, 1), None),
    "vignetting 40 %": (None, lambda b, r: vignetted(b, 0.4)),
}


def problem(bench, scene, fault, seed, exposure=1):
    """A frame with a planted fault of PSF or camera."""
    made = simulated(bench, scene, exposure, seed)
    change_psf, change_light = FAULTS[fault]
    rng = np.random.default_rng([seed, 4])
    light = change_light(made.light, rng) if change_light else made.light
    _, sigma = with_noise(made.light, None, np.random.default_rng([seed, 2]))
    frame = light + np.random.default_rng([seed, 2]).normal(0, sigma, light.shape)
    psf = change_psf(made.psf, rng) if change_psf else made.psf
    return SimpleNamespace(
        camera=made.camera, frame=frame, psf=psf.astype(np.float32), truth=made.truth, planted=np.zeros(frame.shape, bool))
