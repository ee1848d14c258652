#!/usr/bin/env python3
"""Runs what README and the pages of docs/ tell a user to run.

    python3 scripts/check_pages.py target/release/rowburst
    python3 scripts/check_pages.py target/release/rowburst --python target/python-venv/bin/python
    python3 scripts/check_pages.py target/release/rowburst README.md docs/tutorial.md

Blocks marked `sh`, `python` and `matlab` are run, a page at a time and in its order, in an empty folder of its own: of
`sh` the lines that run Rowburst, but for `view` and `live`; `python` with --python, `matlab` in GNU Octave where it is installed. The folder has
the first `toml` block of the page as `experiment.toml` (or that of the tutorial) and the files that a page names
without making them, such as `capture.tif` or `darks/`: simulated captures. Write `text` above what cannot run.
Needs numpy and Pillow: what is missing is installed by pip into a virtual environment.
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from common import ROOT, say, with_packages

if __name__ == "__main__":
    # The packages have to be there before the next lines.
    with_packages(ROOT / "target/shown", __file__, ["numpy", "PIL"])

import numpy as np
from PIL import Image

SIDE, ROW_US, LED_HZ = 108, 9.6, 10_000
BIAS, READ_NOISE, GAIN, FULL = 100, 1.5, 0.46, 65_000
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.M | re.S)
STARTS = ("rowburst ", "cargo run --release -- ")
# Made by other scripts, which run their commands.
EXEMPT = ["docs/gallery.md"]


# ---------------------------------------------------------------- captures


def sensor(electrons, rng):
    """Counts that the sensor gives for a mean number of electrons."""
    shot = rng.poisson(np.maximum(electrons, 0)) + rng.normal(0, READ_NOISE, np.shape(electrons))
    return np.clip(np.round(BIAS + shot / GAIN), 0, FULL).astype(np.uint16)


def save(path, counts):
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(counts).save(path)


class Captures:
    """Files that a laboratory would have, from one simulation."""

    def __init__(self, program, folder, experiment):
        self.rng = np.random.default_rng(1)
        (folder / "camera.toml").write_text(experiment)
        for scene, name in (("digits", "one"), ("leds", "two")):
            subprocess.run([program, "simulate", folder / "camera.toml", "--scene", scene, "--peak-electrons", "20000",
                            "-o", folder / name], check=True, capture_output=True)
        self.frames = [np.load(folder / name / "frame.npy").astype(np.uint16) for name in ("one", "two")]
        self.psf = np.load(folder / "one/psf.npy")

    def write(self, name, folder):
        flat = np.ones((SIDE, SIDE))
        if name == "capture.tif":
            save(folder / name, self.frames[0])
        elif name == "recording":
            for i, frame in enumerate(self.frames):
                save(folder / name / f"{i}.tif", frame)
        elif name == "psf.tif":
            save(folder / name, sensor(50_000 * self.psf / self.psf.max(), self.rng))
        elif name == "pinhole":
            # A capture has the size of the sensor.
            y, x = (s // 2 - SIDE // 2 for s in self.psf.shape)
            seen = self.psf[y : y + SIDE, x : x + SIDE]
            for i in range(3):
                save(folder / name / f"{i}.tif", sensor(20_000 * seen / seen.max(), self.rng))
        elif name in ("darks", "dark.tif"):
            for i in range(20 if name == "darks" else 1):
                save(folder / name / f"{i}.tif" if name == "darks" else folder / name, sensor(0 * flat, self.rng))
        elif name == "flats":
            for i, electrons in enumerate([1000, 4000, 9000, 16_000, 25_000, 40_000]):
                for copy in range(3):
                    save(folder / name / f"{i}-{copy}.tif", sensor(electrons * flat, self.rng))
        elif name == "mask.tif":
            save(folder / name, np.zeros((SIDE, SIDE), np.uint8))
        elif name == "led.png":
            # Light of the LED until a time, in periods; each row sees a difference of it.
            until = lambda t: np.floor(t) * 0.5 + np.minimum(t - np.floor(t), 0.5)
            rows = np.arange(SIDE)
            instant = np.where(rows < SIDE // 2, SIDE // 2 - 1 - rows, rows - SIDE // 2)
            period, start = 1e6 / LED_HZ, instant * ROW_US
            light = (until((start + ROW_US) / period) - until(start / period)) * period / ROW_US
            save(folder / name, sensor(20_000 * light[:, None] * flat, self.rng))
        elif name in ("frame.csv", "psf.csv"):
            np.savetxt(folder / name, self.frames[0] if name == "frame.csv" else self.psf, delimiter=",", fmt="%.9g")


NAMES = ["capture.tif", "recording", "psf.tif", "pinhole", "darks", "dark.tif", "flats", "mask.tif", "led.png"]


# ---------------------------------------------------------------- blocks


def run(words, folder, what, program, **more):
    path = os.pathsep.join([str(program.parent), os.environ["PATH"]])
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, env=os.environ | {"PATH": path}, **more)
    if done.returncode:
        sys.exit(f"check_pages.py: {what}\n{(done.stdout[-1500:] + done.stderr[-3000:]).strip()}")
    return done


def shell(block, folder, page, program):
    """The lines of a block that run Rowburst."""
    for line in block.replace("\\\n", " ").splitlines():
        start = next((s for s in STARTS if line.startswith(s)), None)
        if start is None:
            continue
        say(f"  {line}")
        words = shlex.split(line[len(start):], comments=True)
        if words[0] in ("view", "live"):
            # They serve until Ctrl-C; tests run them.
            continue
        run([str(program), *words], folder, f"{page}: {line}", program)
        for option in ("-o", "--output"):
            if option in words and not (folder / words[words.index(option) + 1]).exists():
                sys.exit(f"check_pages.py: {page}: {line}\nleft no {words[words.index(option) + 1]}")
    return 1


def python(block, folder, page, program, interpreter):
    say(f"  python: {len(block.splitlines())} lines")
    run([str(interpreter), "-"], folder, f"{page}: the block of Python", program, input=block)


def matlab(blocks, folder, page, program):
    """All blocks of a page as one script; a block that starts with `function` is a file of its own."""
    script = "frame = uint16(dlmread('frame.csv', ',')); psf = dlmread('psf.csv', ',');\n"
    for block in blocks:
        name = re.match(r"function .*?(\w+)\(", block)
        if name:
            (folder / f"{name[1]}.m").write_text(block, encoding="utf-8")
        else:
            script += block
    (folder / "page_of_docs.m").write_text(script, encoding="utf-8")
    say(f"  octave: {len(blocks)} blocks")
    run(["octave-cli", "--no-gui", "--quiet", "page_of_docs.m"], folder, f"{page}: the blocks of MATLAB", program)


def check(page, program, interpreter, captures, default):
    """Runs a page; the number of its blocks that were run."""
    text = (ROOT / page).read_text(encoding="utf-8").replace("\r\n", "\n")
    blocks = BLOCK.findall(text)
    languages = {language for language, _ in blocks}
    if not languages & {"sh", "python", "matlab"}:
        return 0
    say(page)
    count = 0
    with tempfile.TemporaryDirectory(prefix="rowburst-page-") as folder:
        folder = Path(folder)
        wanted = [name for name in NAMES if re.search(rf"\b{re.escape(name)}\b", text)]
        toml = next((body for language, body in blocks if language == "toml" and "rows" in body), None)
        if toml is None:
            toml = default + ('\n[calibration]\npsf = "psf.tif"\n' if "psf.tif" in wanted else "")
        (folder / "experiment.toml").write_text(toml, encoding="utf-8")
        if "matlab" in languages:
            wanted += ["frame.csv", "psf.csv"]
        for name in wanted:
            captures.write(name, folder)
        for language, body in blocks:
            if language == "sh":
                count += shell(body, folder, page, program)
            elif language == "python" and interpreter:
                count += 1
                python(body, folder, page, program, interpreter)
        if "matlab" in languages:
            if shutil.which("octave-cli"):
                bodies = [body for language, body in blocks if language == "matlab"]
                matlab(bodies, folder, page, program)
                count += len(bodies)
            else:
                say("  skipped: MATLAB, since octave-cli is not installed")
    return count


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", type=Path)
    parser.add_argument("pages", nargs="*", metavar="PAGE", help="README.md and all pages of docs/ where none is named")
    parser.add_argument("--python", type=Path, help="an interpreter that has the package: runs the blocks of Python")
    options = parser.parse_intermixed_args()
    pages = options.pages or ["README.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md"))]
    default = dict(BLOCK.findall((ROOT / "docs/tutorial.md").read_text(encoding="utf-8")))["toml"]
    program = options.program.resolve()
    interpreter = options.python and options.python.absolute()
    with tempfile.TemporaryDirectory(prefix="rowburst-captures-") as folder:
        captures = Captures(program, Path(folder), default)
        count = sum(check(page, program, interpreter, captures, default) for page in pages
                    if page not in EXEMPT and not page.startswith("docs/design/"))
    say(f"{count} blocks of README and site run")


if __name__ == "__main__":
    main()
