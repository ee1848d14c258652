#!/usr/bin/env python3
"""docs/raw-frames/*.png: faults of raw frames, what the program finds of them, and a bin of the video.

    cargo build --release
    python3 scripts/raw_frames_pictures.py

Each picture is one row of four panels. The frames are simulated, and the faults are those of
scripts/real_frames.py. The PSNR of each video goes to standard error. Needs numpy, scipy and Pillow: what is
missing is installed by pip into a virtual environment.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from common import ROOT, say, with_packages

if __name__ == "__main__":
    # The packages have to be there before the next lines.
    with_packages(ROOT / "target/real-frames", __file__, ["numpy", "scipy", "PIL"])

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from real_frames import KEEP, camera, caption, dead_row, lone_pixels, photographed, reflection

SIDE, PANEL, GAP, TOP = 108, 216, 10, 24
SEED, BIN, EARLY_BIN = 1, 26, 4
PRIOR = "tv+0.5*tdiff+support"
# Levels of each scale: a picture has at most 256 colours.
LEVELS = 40
HEAT = [(0, 0, 0), (60, 15, 110), (170, 40, 100), (240, 110, 30), (250, 200, 60), (255, 255, 230)]
SIGNED = [(30, 80, 190), (255, 255, 255), (200, 30, 40)]
YELLOW, SLATE = (255, 220, 0), (95, 110, 130)


# ---------------------------------------------------------------- panels


def shades(values, low, high, anchors):
    """RGB of the values, by linear interpolation between the anchors."""
    level = np.round(np.clip((values - low) / (high - low), 0, 1) * LEVELS) / LEVELS
    at = level * (len(anchors) - 1)
    channels = np.array(anchors, float).T
    return np.stack([np.interp(at, np.arange(len(anchors)), c) for c in channels], -1).astype(np.uint8)


def grey(image):
    return shades(image, 0, np.quantile(image, 0.995), [(0, 0, 0), (255, 255, 255)])


def marked(pixels, mask, colour):
    pixels = pixels.copy()
    pixels[mask] = colour
    return pixels


def left_out(frame, run):
    """The frame, dimmed, with the pixels in yellow that were left out."""
    return marked(grey(frame) // 2, run["excluded"], YELLOW)


def heat(video, truth, at=BIN):
    """A bin of the video, on the scale of the truth."""
    return shades(video[at], 0, truth[at].max(), HEAT)


def save(path, panels):
    """One row of panels with their titles."""
    width = len(panels) * (PANEL + GAP) - GAP
    picture, font = Image.new("RGB", (width, TOP + PANEL), "white"), ImageFont.load_default(13)
    drawing = ImageDraw.Draw(picture)
    for i, (title, pixels) in enumerate(panels):
        x = i * (PANEL + GAP)
        drawing.text((x + PANEL / 2, TOP / 2), title, "#1b2130", font, anchor="mm")
        picture.paste(Image.fromarray(pixels).resize((PANEL, PANEL), Image.NEAREST), (x, TOP))
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    say(f"{path}: {path.stat().st_size / 1000:.0f} kB")


# ---------------------------------------------------------------- runs


class Experiment:
    """A simulated frame, its PSF and its truth, in a folder."""

    def __init__(self, program, folder, *words):
        self.program, self.folder = program, folder
        folder.mkdir()
        (folder / "camera.toml").write_text(camera(SIDE, SIDE, "dual-inside-out", 1))
        self.call("simulate", folder / "camera.toml", "--seed", SEED, *words, "--force", "-o", folder)
        self.frame, self.psf, self.truth = (np.load(folder / f"{n}.npy") for n in ("frame", "psf", "truth"))

    def call(self, *words):
        done = subprocess.run([str(word) for word in (self.program, *words)], capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"raw_frames_pictures.py: {done.stderr.strip()}")
        return done.stdout

    def reconstruct(self, frame, *more, psf=None):
        """What result.json says, with the arrays of the result."""
        out = self.folder / "result"
        np.save(self.folder / "faulty.npy", frame.astype(np.float32))
        np.save(self.folder / "used-psf.npy", self.psf if psf is None else psf)
        result = json.loads(self.call(
            "reconstruct", self.folder / "experiment.toml", "--frame", self.folder / "faulty.npy",
            "--psf", self.folder / "used-psf.npy", "--truth", self.folder / "truth.npy",
            "--prior", PRIOR, *more, "--json", "-o", out))
        say(f"  {' '.join(map(str, more)) or 'default'}: {result['psnr_db']:.2f} dB, fit {result['fit']}")
        say(f"    {100 * result['excluded_fraction']:.2f} % left out, "
            f"{100 * result['coverage_fraction']:.1f} % observed, σ {result['noise_sigma']:.3g}, "
            f"effective σ {result['effective_sigma']:.3g}")
        for warning in result["warnings"]:
            say(f"    {warning}")
        arrays = {name: np.load(out / f"{name}.npy") for name in ("video", "excluded", "coverage", "view-residual")}
        return result | arrays | {name: arrays[name] > 0 for name in ("excluded", "coverage")}


# ---------------------------------------------------------------- pictures


def foreign(made, fault):
    """A fault of the frame: all pixels kept, and by default."""
    frame = fault(made.frame.astype(float), np.random.default_rng(SEED))
    before, after = made.reconstruct(frame, KEEP), made.reconstruct(frame)
    return [("raw frame", grey(frame)), ("left out: yellow", left_out(frame, after)),
            (f"video with {KEEP}", heat(before["video"], made.truth)),
            ("video by default", heat(after["video"], made.truth))]


def hard_caption(frame, rng):
    """A caption whose letters have no soft edges."""
    soft, ink = caption(frame, rng, fraction=0.08, ink=1.2), 1.2 * frame.max()
    return np.where(soft - frame > 0.5 * (ink - frame), ink, frame)


def poor_psf(made):
    """A PSF from a dark capture: used as given, and corrected by the frame."""
    psf = photographed(made.psf, 200, np.random.default_rng(SEED))
    default = made.reconstruct(made.frame, psf=psf)
    given = made.reconstruct(made.frame, "--self-calibrate", "off", psf=psf)
    residual = shades(given["view-residual"], -4, 4, SIGNED)
    return [("PSF from a dark capture", grey(psf)), ("residual with this PSF", residual),
            ("video with this PSF", heat(given["video"], made.truth)),
            ("video by default", heat(default["video"], made.truth))]


def unobserved(made):
    """A diffuser that scatters too little: each bin sees only a part of the scene."""
    result = made.reconstruct(made.frame)
    hidden = ~result["coverage"][EARLY_BIN]
    video = heat(result["video"], made.truth, EARLY_BIN)
    observed = np.where(hidden[..., None], SLATE, 255).astype(np.uint8)
    return [("raw frame", grey(made.frame)), ("white: observed in this bin", observed),
            ("true video", heat(made.truth, made.truth, EARLY_BIN)),
            ("video; slate: not observed", marked(video, hidden, SLATE))]


def smooth(made):
    """A reflection: with PSF and camera as given the video absorbs it."""
    frame = reflection(made.frame.astype(float), np.random.default_rng(SEED))
    given, result = made.reconstruct(frame, "--self-calibrate", "off"), made.reconstruct(frame)
    stray_light = np.load(made.folder / "result/stray-light.npy")
    return [("raw frame", grey(frame)), ("stray light that was found", grey(stray_light)),
            ("video without self-calibration", heat(given["video"], made.truth)),
            ("video by default", heat(result["video"], made.truth))]


PICTURES = {
    "hot-pixels": partial(foreign, fault=partial(lone_pixels, fraction=0.01, value=1.5)),
    "caption": partial(foreign, fault=hard_caption),
    "dead-row": partial(foreign, fault=dead_row),
    "psf-noise": poor_psf,
    "coverage": unobserved,
    "reflection": smooth,
}
# Words for `rowburst simulate`.
SIMULATIONS = {"coverage": ["--scene", "two-moving", "--diffuser-deg", 0.15]}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/rowburst")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/raw-frames", help="folder of the pictures")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rowburst-pictures-") as folder:
        for name, panels_of in PICTURES.items():
            say(name)
            words = SIMULATIONS.get(name, ["--scene", "digits"])
            made = Experiment(options.program.resolve(), Path(folder) / name, *words)
            save(options.output / f"{name}.png", panels_of(made))


if __name__ == "__main__":
    main()
