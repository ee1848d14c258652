#!/usr/bin/env python3
"""The traces of known places in numbers, for docs/dense-scenes.md: discs that flicker, each with a trace of its own.

    cargo build --release
    python3 scripts/known_places.py

Each case is a frame of 108x108 pixels, dual shutter, SNR 256 unless it says otherwise, made here and not by the program. The
guide is the mean of the video with noise. The program gives each place of the guide a trace with standard errors. "Covered" is the part of all
places and bins whose truth lies within 1.96 standard errors, "error" the rms error over the rms light. Needs numpy and
scipy: what is missing is installed by pip into a virtual environment. Progress goes to standard error.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

from common import ROOT, command_line, say, table, with_packages

CACHE = ROOT / "target/self-calibration"
if __name__ == "__main__":
    # The packages have to be there before the next lines.
    with_packages(CACHE, __file__, ["numpy", "scipy", "PIL"])

import subprocess

import numpy as np
from real_frames import scaled
from scipy.ndimage import gaussian_filter, shift
from scipy.signal import fftconvolve

SIDE, BINS, RADIUS, DARK = 108, 54, 3.0, 0.02
CAMERA = '[camera]\nrows = 108\ncolumns = 108\nshutter = "dual-inside-out"\nrow_time_us = 10.0\n'
CASES = [
    ("5 % lit", 20, {}),
    ("10 % lit", 41, {}),
    ("20 % lit", 82, {}),
    ("5 % lit, 6 rows", 20, {"rows": 6}),
    ("10 % lit, 6 rows", 41, {"rows": 6}),
    ("20 % lit, 6 rows", 82, {"rows": 6}),
    ("10 % lit, guide shifted by 4 px", 41, {"moved": (3.4, -2.2)}),
    ("10 % lit, guide with 5 % noise", 41, {"noise": 0.05}),
    ("10 % lit, guide blurred by 1 px", 41, {"blur": 1.0}),
    ("10 % lit, PSF noise 2000 e", 41, {"electrons": 2000}),
    ("10 % lit, PSF 0.3 % too large", 41, {"scale": 1.003}),
    ("10 % lit, PSF 1 % too large", 41, {"scale": 1.01}),
    ("10 % lit, guide of one bin", 41, {"bin": 20}),
    ("10 % lit, SNR 32", 41, {"snr": 32}),
    ("10 % lit, SNR 8", 41, {"snr": 8}),
    ("10 % lit, SNR 8, guide of one bin", 41, {"snr": 8, "bin": 20}),
]


def speckle(rng):
    """A speckle PSF twice as large as the sensor."""
    side = 2 * SIDE
    y, x = np.mgrid[-SIDE:SIDE, -SIDE:SIDE]
    pupil = (np.hypot(y, x) < 0.18 * side) * np.exp(2j * np.pi * rng.random((side, side)))
    field = np.abs(np.fft.fftshift(np.fft.fft2(pupil))) ** 2
    field *= np.exp(-(y**2 + x**2) / (2 * (0.35 * side) ** 2))
    psf = gaussian_filter(field, 0.6)[:-1, :-1]
    return psf / psf.sum()


def flickering(rng, count, bins):
    """Discs that do not touch, each with a tone of its own."""
    centres = []
    while len(centres) < count:
        centre = rng.uniform(RADIUS + 2, SIDE - RADIUS - 3, 2)
        if all(np.hypot(*(centre - other)) > 2 * RADIUS + 2.5 for other in centres):
            centres.append(centre)
    y, x = np.mgrid[:SIDE, :SIDE]
    video = np.full((bins, SIDE, SIDE), DARK)
    for row, column in centres:
        distance = np.hypot(y - row, x - column)
        tone = 1 + 0.7 * np.sin(np.arange(bins) * rng.uniform(0.2, 1.2) + rng.uniform(0, 6))
        brightness = (0.6 + 0.2 * rng.uniform(-1, 1)) * tone
        video += brightness[:, None, None] / (1 + np.exp((distance - RADIUS) / 0.35))
    return video


def recorded(video, psf, rows):
    """The frame of a dual shutter that starts in the middle, without noise; an exposure ends when its row is read."""
    light = [fftconvolve(bin, psf)[SIDE - 1 : 2 * SIDE - 1, SIDE - 1 : 2 * SIDE - 1] for bin in video]
    frame = np.zeros((SIDE, SIDE))
    for instant in range(BINS):
        exposed = sum(light[instant : instant + rows])
        for row in (SIDE // 2 - 1 - instant, SIDE // 2 + instant):
            frame[row] = exposed[row]
    return frame


def case(program, folder, count, seed, rows=1, moved=(0, 0), noise=0.01, blur=0.0, electrons=None, scale=1.0, bin=None, snr=256):
    """Runs the program on a case. Returns covered, error, χ² and seconds."""
    rng = np.random.default_rng(seed)
    video = flickering(rng, count, BINS + rows - 1)
    psf = speckle(rng)
    frame = recorded(video, psf, rows)
    frame += rng.normal(0, frame.max() / snr, frame.shape)
    picture = video.mean(0) if bin is None else video[bin]
    guide = gaussian_filter(shift(picture, moved, order=1, mode="nearest"), blur)
    guide += rng.normal(0, noise * guide.max(), guide.shape)
    if electrons:
        psf = rng.poisson(psf * electrons / psf.max()).astype(float)
    psf = scaled(psf, scale)
    for name, image in [("frame", frame), ("psf", psf), ("guide", 200 * guide)]:
        np.save(folder / f"{name}.npy", image.astype(np.float32))
    experiment = folder / "experiment.toml"
    experiment.write_text(f'{CAMERA}exposure_us = {10.0 * rows}\n\n[calibration]\npsf = "psf.npy"\n')
    result = folder / "result"
    words = [program, "reconstruct", experiment, "--frame", folder / "frame.npy", "--guide", folder / "guide.npy"]
    words += ["--guide-model", "places", "-o", result, "--force"]
    subprocess.run(words, check=True, capture_output=True)
    numbers = json.loads((result / "result.json").read_text())
    if not numbers["guide"]["used"]:
        return [np.nan] * 3 + [numbers["seconds"]]
    places, found = numbers["guide"]["known_places"], np.load(result / "places.npy")
    covered, error, power = [], 0.0, 0.0
    for place in places["traces"]:
        pixels = found == place["label"]
        truth = (video[:, pixels].mean(1) - DARK)[: len(place["value"])]
        deviation = np.array(place["value"]) - truth
        covered.extend(np.abs(deviation) <= 1.96 * np.array(place["standard_error"]))
        error, power = error + (deviation**2).sum(), power + (truth**2).sum()
    return np.mean(covered), np.sqrt(error / power), places["chi_squared"], numbers["seconds"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/rowburst")
    parser.add_argument("--seeds", default="1,2,3")
    args = parser.parse_args()
    rows = []
    for name, count, options in CASES:
        with TemporaryDirectory() as folder:
            runs = [case(args.program, Path(folder), count, int(seed), **options) for seed in args.seeds.split(",")]
        covered, error, chi_squared, seconds = np.array(runs).T
        percent = ", ".join("dropped" if np.isnan(part) else f"{100 * part:.1f}" for part in covered)
        rows.append([name, str(count), percent, f"{100 * np.nanmean(error):.1f}", f"{np.nanmean(chi_squared):.2f}", f"{seconds.max():.1f}"])
        say(" | ".join(map(str, rows[-1])))
    heading = ["scene", "places", "covered in %", "error in %", "χ²", "seconds"]
    print(table(heading, rows))
    print(f"\nMade by\n\n```text\n{command_line('known_places.py')}\n```")


if __name__ == "__main__":
    main()
