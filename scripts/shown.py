#!/usr/bin/env python3
"""Pictures and numbers of README and site: makes them, and tells when the program gives something else.

    python3 scripts/shown.py target/release/rowburst             exit status 1 where something has drifted
    python3 scripts/shown.py target/release/rowburst --renew     makes all anew; commit the difference
    python3 scripts/shown.py target/release/rowburst --only leds

Each scene below is simulated and reconstructed by the commands that the gallery shows. What they give is kept in
docs/shown.json, and README.md and docs/gallery.md repeat it between the lines `<!-- shown: begin -->` and `end`. A
PSNR may differ by 0.3 dB, a residual by 0.03, verdict and prior not at all; pictures have the same size and differ by
at most 3 of 256 levels in the mean. Processor times depend on the machine and are only renewed. The times to a quality
beside those of other toolboxes are those of docs/speed.md. The pictures of docs/raw-frames.md, which
scripts/raw_frames_pictures.py makes, are checked likewise. One cheap row of each long table (quality, self-calibration,
dense scenes) is made again by the table's own script, and with `--only tables` one of the phase transition. Needs numpy, scipy and Pillow: what is missing is installed
by pip into a virtual environment.
"""

import argparse
import csv
import json
import re
import resource
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from common import ROOT, commit, machine, say, table, with_packages

if __name__ == "__main__":
    # The packages have to be there before the next lines.
    with_packages(ROOT / "target/shown", __file__, ["numpy", "scipy", "PIL"])

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageSequence

DOCS = ROOT / "docs"
RECORD = DOCS / "shown.json"
RAW_FRAMES, TABLES = "raw-frames", "tables"
PSNR_TOLERANCE, RESIDUAL_TOLERANCE, LEVELS_TOLERANCE = 0.3, 0.03, 3.0
BEGIN, END = "<!-- shown: begin -->", "<!-- shown: end -->"
SIDE, BINS, BIN_US = 108, 54, 9.6
SCALE, GAP, TOP, BOTTOM = 3, 14, 36, 36
INK, PAPER, YELLOW = "#1b2130", "#ffffff", (255, 214, 0)
# Black, purple, orange, white; and blue, green, yellow, red for time.
HEAT = [(0, 0, 0), (60, 15, 110), (170, 40, 100), (240, 110, 30), (250, 200, 60), (255, 255, 230)]
TIME = [(70, 90, 255), (0, 190, 240), (40, 210, 90), (240, 220, 40), (255, 130, 30), (250, 50, 70)]
TRACES = ["#d55e00", "#0072b2", "#009e73"]

SIMULATE = "rowburst simulate experiment.toml --scene {} -o {}"
RECONSTRUCT = "rowburst reconstruct {0}/experiment.toml --frame {0}/frame.npy --truth {0}/truth.npy{1} -o {0}-result"


def simulated(name, scene, more="", file="experiment.toml"):
    """The commands of a scene that is simulated with the noise of a sensor."""
    return [SIMULATE.format(scene, name).replace("experiment.toml", file, 1), RECONSTRUCT.format(name, more)]


# Name: title, what is seen, commands. The last one leaves the result in the folder of its -o.
SCENES = {
    "digits": ("54 digits", "Fig. 2 of the paper: each digit is lit for one bin of 9.6 µs.",
               ["rowburst demo --scene digits --seed 1 -o digits-result"]),
    "leds": ("Three LEDs", "Fig. 3 of the paper: they blink at 20.8, 34.7 and 52.1 kHz. In the last panel their traces.",
             ["rowburst demo --scene leds --seed 1 -o leds-result"]),
    "moving": ("A moving digit", "It moves by up to 0.8 pixels a bin.",
               ["rowburst demo --scene moving --seed 1 -o moving-result"]),
    "two-moving": ("Two moving digits", "They may cross. Shot and read noise, 20,000 electrons in the brightest pixel.",
                   simulated("two-moving", "two-moving --peak-electrons 20000")),
    "low-light": ("Digits in low light", "2,000 electrons in the brightest pixel of the frame.",
                  simulated("low-light", "digits --peak-electrons 2000")),
    "caustics": ("Digits behind a smooth phase plate", "The PSF is a net of caustics instead of speckle.",
                 simulated("caustics", "digits --diffuser-phase 80 --pupil-mm 6.84 --peak-electrons 20000")),
    "top-down": ("An ordinary rolling shutter", "One row at a time, from the top: half of the measurements in a bin, 108 bins.",
                 simulated("top-down", "moving --peak-electrons 20000", file="top-down.toml")),
    "dense": ("Too dense", "Digits of 36 pixels: too many bright pixels for the 216 measurements of a bin. The video is wrong.",
              simulated("dense", "digits --digit-px 36 --peak-electrons 20000", " --prior tv+0.5*tdiff+support")),
}
# Shown in the tutorial, not in the gallery.
TUTORIAL = {
    "tutorial": ("Tutorial", "", [
        "rowburst simulate experiment.toml --scene digits --peak-electrons 20000 --seed 3 --captures -o tutorial",
        "rowburst calibrate sensor --darks tutorial/darks.npy --flats tutorial/flats.npy --experiment experiment.toml -o sensor",
        "rowburst calibrate psf tutorial/pinhole.npy --dark tutorial/pinhole-dark.npy --experiment sensor/experiment.toml -o psf",
        "rowburst reconstruct psf/experiment.toml --frame tutorial/frame.npy --truth tutorial/truth.npy -o tutorial-result"]),
    "exact-psf": ("Tutorial, PSF of the simulation", "", [
        "rowburst simulate experiment.toml --scene digits --peak-electrons 20000 --seed 3 -o exact-psf",
        RECONSTRUCT.format("exact-psf", "")]),
    "guide": ("A guide", "", [
        "rowburst simulate experiment.toml --scene wheel --seed 31 --guide-times-us 250 -o guide",
        RECONSTRUCT.format("guide", "")]),
    "wrong-psf": ("Tutorial, wrong PSF", "", [
        "rowburst simulate experiment.toml --scene digits --peak-electrons 20000 --seed 3 -o capture",
        "rowburst simulate experiment.toml --scene digits --peak-electrons 20000 --seed 4 -o other",
        "rowburst reconstruct capture/experiment.toml --frame capture/frame.npy --psf other/psf.npy "
        "--truth capture/truth.npy --prior tv+support -o wrong"]),
}


# ---------------------------------------------------------------- runs


class Run:
    """A scene, simulated and reconstructed: its folders and numbers."""

    def __init__(self, program, folder, name, commands):
        self.name = name
        for command in commands:
            words = shlex.split(command)
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            done = subprocess.run([program, *words[1:]], cwd=folder, capture_output=True, text=True)
            if done.returncode:
                sys.exit(f"shown.py: {command}\n{done.stderr.strip()}")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        self.cpu_seconds = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
        self.result = folder / words[words.index("-o") + 1]
        inputs = folder / name if "simulate" in commands[0] else self.result
        self.numbers = json.loads((self.result / "result.json").read_text())
        self.video = np.load(self.result / "video.npy")
        self.frame, self.psf, self.truth = (
            np.load(inputs / f"{n}.npy") if (inputs / f"{n}.npy").exists() else None for n in ("frame", "psf", "truth"))
        direct = inputs / "without-diffuser.tif"
        self.direct = np.asarray(Image.open(direct), float) if direct.exists() else None

    def kept(self):
        """What is recorded of the run."""
        n = self.numbers
        return {"psnr_db": round(n["psnr_db"], 2), "ssim": round(n["ssim"], 4), "fit": n["fit"], "prior": n["prior"],
                "residual_over_sigma": round(n["residual_over_sigma"], 3),
                "cpu_seconds": round(self.cpu_seconds, 1), "bins": n["frames"]}


def drift(name, kept, now):
    """What the record says otherwise."""
    faults = []
    for key, tolerance in [("psnr_db", PSNR_TOLERANCE), ("residual_over_sigma", RESIDUAL_TOLERANCE), ("ssim", 0.002)]:
        if abs(kept[key] - now[key]) > tolerance:
            faults.append(f"{name}: {key} is {now[key]}, shown is {kept[key]}")
    for key in ("fit", "prior", "bins"):
        if kept[key] != now[key]:
            faults.append(f"{name}: {key} is {now[key]}, shown is {kept[key]}")
    return faults


# ---------------------------------------------------------------- pictures


def colours(values, anchors):
    """RGB of values from 0 to 1, by linear interpolation between the anchors."""
    at = np.clip(values, 0, 1) * (len(anchors) - 1)
    channels = np.array(anchors, float).T
    return np.stack([np.interp(at, np.arange(len(anchors)), c) for c in channels], -1).astype(np.uint8)


def grey(image):
    low, high = np.quantile(image, [0.005, 0.998])
    return colours((image - low) / max(high - low, 1e-12), [(0, 0, 0), (255, 255, 255)])


def heat(image, top):
    # A root shows faint light, too.
    return colours(np.sqrt(np.clip(image / top, 0, 1)), HEAT)


def bright(video):
    return max(np.quantile(video, 0.9999), 0.3 * video.max())


def time_colour(video):
    """All bins in one picture: the brightest value of each pixel, in the mean colour of its times."""
    light = np.clip(video / bright(video), 0, 1)
    hue = colours(np.linspace(0, 1, len(video)), TIME)
    mean = np.einsum("tyx,tc->yxc", light, hue) / np.maximum(light.sum(0), 1e-6)[..., None]
    return (mean * light.max(0)[..., None]).astype(np.uint8)


def trace_panel(run):
    """The traces of the three brightest spots, as a picture of the size of a panel."""
    with open(run.result / "traces.csv", newline="") as file:
        heading, *lines = list(csv.reader(file))
    values = np.array(lines, float)
    columns = [i for i, name in enumerate(heading) if name.endswith("_value")][:3]
    side = SIDE * SCALE
    panel = Image.new("RGB", (side, side), "#f4f5f7")
    draw = ImageDraw.Draw(panel)
    first = values[:27]
    for i, (column, colour) in enumerate(zip(columns, TRACES)):
        base, height = (i + 1) * side / 3 - 18, side / 3 - 40
        top = first[:, column].max()
        points = [(12 + (side - 24) * t / (len(first) - 1), base - height * v / top) for t, v in enumerate(first[:, column])]
        draw.line(points, fill=colour, width=2, joint="curve")
    draw.text((side - 12, side - 10), f"0 to {0.027 * BIN_US:.2f} ms", INK, ImageFont.load_default(16), anchor="rm")
    return np.asarray(panel)


def enlarged(pixels):
    """A panel of the right size."""
    side = SIDE * SCALE
    return pixels if pixels.shape[0] == side else np.asarray(Image.fromarray(pixels).resize((side, side), Image.NEAREST))


def row_of(panels, bar=None, notes=()):
    """Panels with their titles; `bar`: the duration that a bar of time colours below the last panel stands for."""
    side, below = SIDE * SCALE, BOTTOM if bar or notes else GAP
    picture = Image.new("RGB", (len(panels) * (side + GAP) + GAP, TOP + side + below), PAPER)
    draw, font, small = ImageDraw.Draw(picture), ImageFont.load_default(20), ImageFont.load_default(16)
    for i, (title, pixels) in enumerate(panels):
        x = GAP + i * (side + GAP)
        draw.text((x + side / 2, TOP / 2), title, INK, font, anchor="mm")
        picture.paste(Image.fromarray(enlarged(pixels)), (x, TOP))
    if bar:
        place, duration = bar
        x, y = GAP + place * (side + GAP), TOP + side + BOTTOM // 2
        strip = colours(np.linspace(0, 1, side - 130), TIME)[None].repeat(10, 0)
        picture.paste(Image.fromarray(strip), (x + 40, y - 5))
        draw.text((x + 32, y), "0", INK, small, anchor="rm")
        draw.text((x + side - 84, y), duration, INK, small, anchor="lm")
    return picture


def stacked(rows):
    picture = Image.new("RGB", (max(r.width for r in rows), sum(r.height for r in rows)), PAPER)
    y = 0
    for row in rows:
        picture.paste(row, (0, y))
        y += row.height
    return picture


def moment(t):
    """The middle of bin t. Pillow's font has no µ."""
    return f"{(t + 0.5) * BIN_US / 1e3:.3f} ms"


def duration(run):
    return f"{1e3 * run.numbers['frames'] / run.numbers['frame_rate_hz']:.2f} ms"


def gallery(run):
    """Frame without and with the diffuser, the video with time as colour, and a bin of it or traces."""
    middle = run.numbers["frames"] // 2
    last = ("traces", trace_panel(run)) if run.name == "leds" else (
        f"bin {middle + 1} of {run.numbers['frames']}", heat(run.video[middle], bright(run.truth)))
    return row_of([("without the diffuser", grey(run.direct)), ("the captured frame", grey(run.frame)),
                   ("the video, time as colour", time_colour(run.video)), last], bar=(2, duration(run)))


def demo(run):
    """docs/demo.png: what is recorded, and what comes out."""
    return row_of([("without the diffuser", grey(run.direct)), ("with it: the captured frame", grey(run.frame)),
                   ("the video from it, time as colour", time_colour(run.video))], bar=(2, duration(run)))


def rows_read(t):
    """The rows that the dual shutter of the paper reads at the end of bin t."""
    return SIDE // 2 - 1 - t, SIDE // 2 + t


def with_rows(pixels, t):
    """A panel with yellow lines beside the rows that are read."""
    panel = enlarged(pixels).copy()
    for row in rows_read(t):
        for y in (SCALE * row - 1, SCALE * (row + 1)):
            if 0 <= y < len(panel):
                panel[y] = YELLOW
    return panel


def method(run):
    """docs/pictures/method.png: one bin of the scene, PSF, light on the sensor, frame."""
    t = BINS // 2
    scene, psf = run.truth[t], run.psf
    shape = [s + p - 1 for s, p in zip(scene.shape, psf.shape)]
    light = np.fft.irfft2(np.fft.rfft2(scene, shape) * np.fft.rfft2(psf, shape), shape)
    y, x = (s // 2 for s in psf.shape)
    light = light[y : y + SIDE, x : x + SIDE]
    middle = psf[y - SIDE // 2 : y + SIDE // 2, x - SIDE // 2 : x + SIDE // 2]
    return row_of([("the scene in one bin", heat(scene, run.truth.max())), ("the PSF", grey(middle)),
                   ("light on the sensor, rows read", with_rows(grey(light), t)),
                   ("the frame: such rows of all bins", grey(run.frame))])


def tutorial(run):
    """docs/pictures/tutorial.png: what an experiment gives, and bins of the video beside the truth."""
    at = [5, 26, 48]
    top = run.truth.max()
    rows = [[("without the diffuser", grey(run.direct)), ("the captured frame", grey(run.frame)),
             ("the video, time as colour", time_colour(run.video))],
            [(f"video at {moment(t)}", heat(run.video[t], top)) for t in at],
            [(f"truth at {moment(t)}", heat(run.truth[t], top)) for t in at]]
    return stacked([row_of(row) for row in rows])


def guided(run):
    """docs/pictures/guide.png: frame and guide, and two bins of the video above those of the truth."""
    at = [4, 50]
    picture = np.load(run.result.parent / "guide/guide-1.npy")
    top = run.truth.max()
    level = lambda image: colours(np.clip(image / top, 0, 1), [(0, 0, 0), (255, 255, 255)])
    rows = [[("the captured frame", grey(run.frame)), *((f"video at {moment(t)}", level(run.video[t])) for t in at)],
            [("the guide", grey(picture)), *((f"truth at {moment(t)}", level(run.truth[t])) for t in at)]]
    return stacked([row_of(row) for row in rows])


def film(run):
    """docs/pictures/demo.gif: the frame with the rows that are read, and the video, bin by bin."""
    side, levels = SIDE * SCALE, 48
    greys = [(v, v, v) for v in np.linspace(0, 255, levels).astype(int)]
    hots = [tuple(c) for c in colours(np.linspace(0, 1, levels), HEAT).tolist()]
    palette = [*greys, *hots, YELLOW, (255, 255, 255), (27, 33, 48)]
    yellow, paper, ink = 2 * levels, 2 * levels + 1, 2 * levels + 2

    def index(image, low, high, first, root=False):
        level = np.clip((image - low) / (high - low), 0, 1)
        level = np.sqrt(level) if root else level
        small = (first + np.round(level * (levels - 1))).astype(np.uint8)
        return small.repeat(SCALE, 0).repeat(SCALE, 1)

    direct, frame = (index(i, *np.quantile(i, [0.005, 0.998]), 0) for i in (run.direct, run.frame))
    titles = ["without the diffuser", "with it: the one frame that is captured", "the video computed from it"]
    font, small = ImageFont.load_default(18), ImageFont.load_default(16)
    pictures, seen = [], np.zeros((SIDE, SIDE))
    # The last picture stays for a moment.
    for t in range(BINS):
        picture = Image.new("P", (3 * (side + GAP) + GAP, TOP + side + BOTTOM), paper)
        picture.putpalette([c for colour in palette for c in colour])
        draw = ImageDraw.Draw(picture)
        draw.fontmode = "1"
        seen = np.maximum(seen, 0.12 * run.video[t])
        shown = index(np.maximum(run.video[t], seen), 0, bright(run.truth), levels, root=True)
        for i, (title, pixels) in enumerate(zip(titles, [direct, frame, shown])):
            x = GAP + i * (side + GAP)
            draw.text((x + side / 2, TOP / 2), title, ink, font, anchor="mm")
            panel = pixels.copy()
            if i < 2:
                for row in rows_read(t):
                    panel[max(SCALE * row - 1, 0) : SCALE * row + 1] = yellow
                    panel[SCALE * (row + 1) - 1 : SCALE * (row + 1) + 1] = yellow
            picture.paste(Image.fromarray(panel, "P"), (x, TOP))
        text = f"{moment(t)}: bin {t + 1} of {BINS}"
        draw.text((GAP + 2 * (side + GAP) + side / 2, TOP + side + BOTTOM / 2), text, ink, small, anchor="mm")
        draw.text((GAP + side + GAP / 2, TOP + side + BOTTOM / 2), "yellow: the two rows that are read", ink, small, anchor="mm")
        pictures.append(picture)
    return pictures


def write(picture, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(picture, list):
        times = [90] * (len(picture) - 1) + [1800]
        clear = max(int(np.asarray(p).max()) for p in picture) + 1
        changed = [picture[0]]
        for before, now in zip(picture, picture[1:]):
            # Pixels that stay are transparent: a tenth of the size.
            pixels = np.where(np.asarray(before) == np.asarray(now), clear, np.asarray(now)).astype(np.uint8)
            changed.append(Image.fromarray(pixels, "P"))
            changed[-1].putpalette(picture[0].getpalette())
        changed[0].save(path, save_all=True, append_images=changed[1:], duration=times, loop=0, optimize=False, disposal=1,
                        transparency=clear)
    else:
        picture.quantize(255, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)


def frames(path):
    return [np.asarray(f.convert("RGB"), float) for f in ImageSequence.Iterator(Image.open(path))]


def picture_drift(path, picture, folder):
    """What a stored picture and that of now differ in."""
    made = folder / path.name
    write(picture, made)
    return difference(path, made)


def difference(path, made):
    """What two pictures differ in."""
    name = path.relative_to(ROOT)
    if not (path.exists() and made.exists()):
        return [f"{name} is missing"]
    before, now = frames(path), frames(made)
    if [f.shape for f in before] != [f.shape for f in now]:
        return [f"{name}: the size or number of pictures is another"]
    levels = max(np.abs(a - b).mean() for a, b in zip(before, now))
    return [f"{name} differs by {levels:.1f} levels in the mean"] if levels > LEVELS_TOLERANCE else []


# Picture, of which scene, by which function.
PICTURES = [
    ("demo.png", "digits", demo), ("pictures/demo.gif", "digits", film), ("pictures/method.png", "digits", method),
    ("pictures/tutorial.png", "tutorial", tutorial), ("pictures/guide.png", "guide", guided),
    *((f"gallery/{name}.png", name, gallery) for name in SCENES),
]


def raw_frames(program, folder):
    """Makes the pictures of docs/raw-frames.md; what the script says of each run, `NAME: words: 47.8 dB, fit good`."""
    script = ROOT / "scripts/raw_frames_pictures.py"
    done = subprocess.run([sys.executable, script, "--program", program, "-o", folder], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"shown.py: {script.name}\n{done.stderr.strip()}")
    runs, name = {}, None
    for line in done.stderr.splitlines():
        if found := re.match(r"  (\S.*): ([\d.-]+) dB, fit (\w+)$", line):
            # The option alone: a value may change in its last digits.
            runs[f"{name}: {found[1].split()[0]}"] = {"psnr_db": round(float(found[2]), 1), "fit": found[3]}
        elif re.fullmatch(r"[\w-]+", line):
            name = line
    return runs


def raw_frames_drift(kept, now, folder):
    faults = [f"raw-frames, {name}: {now.get(name)}, shown is {run}" for name, run in kept.items()
              if name not in now or abs(run["psnr_db"] - now[name]["psnr_db"]) > PSNR_TOLERANCE or run["fit"] != now[name]["fit"]]
    for path in sorted((DOCS / "raw-frames").glob("*.png")):
        faults += difference(path, folder / path.name)
    return faults


# ---------------------------------------------------------------- tables


def cells(text, *begin):
    """The row of a table whose first cells are `begin`, by the headings of its columns."""
    heading = []
    for line in text.splitlines():
        row = [cell.strip() for cell in line.strip("| ").split("|")] if line.startswith("|") else []
        if row[:len(begin)] == list(begin):
            return dict(zip(heading, row))
        if not (heading and row):
            heading = row
    sys.exit(f"shown.py: no row {', '.join(begin)} in the table")


def number(text):
    return float(re.match(r"-?[\d.]+", text)[0])


def of_script(script, program, folder, *words):
    """The table that a script makes of a few of its rows."""
    out = folder / f"{script}.md"
    words = ["--program", program, "--cache", folder / script, "-o", out, *words]
    done = subprocess.run([sys.executable, ROOT / f"scripts/{script}.py", *map(str, words)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"shown.py: {script}.py\n{done.stderr.strip()}")
    return out.read_text(encoding="utf-8")


def quality_row(program, folder):
    text = of_script("quality_table", program, folder, "--only", "moving", "--quick", "--no-grid", "--no-toolbox")
    kept = cells((DOCS / "quality.md").read_text(encoding="utf-8"), "one moving digit")
    return [("a moving digit, dB", number(kept["seed 1"]), number(cells(text, "one moving digit")["PSNR"]), 0.5)]


def self_calibration_row(program, folder):
    text = of_script("self_calibration", program, folder, "--scenes", "digits", "--match", "scale 1 %")
    row = "digits", "scale 1 %"
    kept, now = cells((DOCS / "self-calibration-table.md").read_text(encoding="utf-8"), *row), cells(text, *row)
    return [(f"{', '.join(row)}, {key}", number(kept[key]), number(now[key]), 0.5) for key in ("off, dB", "default, dB")]


def phase_transition_row(program, folder):
    from phase_transition import PSFS, Bench

    found = Bench(program, folder, ROOT, 1).map("speckle", 2)
    key = f"k at m = {found['measurements_per_bin']:.0f}"
    kept = number(cells((DOCS / "phase-transition.md").read_text(encoding="utf-8"), PSFS["speckle"])[key])
    return [(f"speckle, {key}", kept, found["half_success_pixels"][0], 0.1 * kept)]


def dense_scenes_row(program, folder):
    example = program.parent / "examples/dense_scenes"
    given = ["--program", example] if example.exists() else []
    words = ["--scenes", "beam", "--rows", "1", "--seeds", "31", "--guides", "honest", *given]
    done = subprocess.run([sys.executable, ROOT / "scripts/dense_scenes.py", *words], capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        sys.exit(f"shown.py: dense_scenes.py\n{done.stderr.strip()}")
    kept = number(cells((DOCS / "dense-scenes.md").read_text(encoding="utf-8"), "beam", "1")["guide of unknown time"])
    return [("beam, guide of unknown time, dB", kept, number(cells(done.stdout, "beam", "1")["psnr_db"]), 0.5)]


ROWS_OF_TABLES = {"quality": quality_row, "self-calibration-table": self_calibration_row, "dense-scenes": dense_scenes_row}
# Takes two minutes of processor time: with `--only tables` alone.
SLOW_ROWS = {"phase-transition": phase_transition_row}


def tables_drift(program, folder, with_slow):
    """A row of each table is what the program gives now."""
    faults = []
    for name, make in (ROWS_OF_TABLES | (SLOW_ROWS if with_slow else {})).items():
        for what, kept, now, tolerance in make(program, folder):
            say(f"docs/{name}.md: {what}: {now:.1f}, shown {kept:.1f}")
            if abs(now - kept) > tolerance:
                faults.append(f"docs/{name}.md: {what} is {now:.1f}, shown is {kept:.1f}")
    return faults


def prose_drift(scenes):
    """Numbers in the prose of README and tutorial are those of the tables and of the record."""
    row = cells((DOCS / "self-calibration-table.md").read_text(encoding="utf-8"), "digits", "scale 1 %")
    exact = scenes["exact-psf"]["psnr_db"] if "exact-psf" in scenes else 0
    wanted = [(ROOT / "README.md", f"{row['default, dB']} dB instead of {row['off, dB']}"),
              (DOCS / "tutorial.md", f"`--psf lab/psf.npy`, it is {exact:.0f} dB")]
    flat = lambda path: " ".join(path.read_text(encoding="utf-8").split())
    return [f"{path.relative_to(ROOT)} does not say \"{words}\"" for path, words in wanted if words not in flat(path)]


# ---------------------------------------------------------------- text


def readme_table(record):
    """The table of the README: quality and time of the demo's scenes, and the time to a quality of docs/speed.md."""
    rows = []
    for name in ("digits", "leds", "moving"):
        kept = record["scenes"][name]
        rows.append([f"`{name}`: {SCENES[name][0][0].lower()}{SCENES[name][0][1:]}", f"{kept['psnr_db']:.1f} dB",
                     f"{kept['ssim']:.4f}", kept["fit"], f"`{kept['prior']}`", f"{kept['cpu_seconds']:.1f} s"])
    text = table(["scene", "PSNR", "SSIM", "fit", "prior that `auto` chose", "processor time"], rows)
    speed = re.search(r"The best of them, ([^,]+), reaches ([\d.]+) dB in (\d+) s; Rowburst reaches that after ([\d.]+) s "
                      r"\(median\), \*\*(\d+) times sooner", (DOCS / "speed.md").read_text(encoding="utf-8"))
    toolbox, psnr, limit, seconds, _ = speed.groups()
    return (f"{text}\n\nMade by `rowburst demo --scene digits --seed 1` and so on ({record['machine']}). {toolbox}, the best general\n"
            f"toolbox, comes to {psnr} dB within {limit} s, Rowburst [after {seconds} s](docs/speed.md).")


def gallery_page(record):
    parts = []
    for name, (title, words, commands) in SCENES.items():
        kept = record["scenes"][name]
        parts.append(
            f"## {title}\n\n{words}\n\n![Without the diffuser; the captured frame; the video; a bin or traces]"
            f"(gallery/{name}.png)\n\n**{kept['psnr_db']:.1f} dB**, SSIM {kept['ssim']:.4f}, fit {kept['fit']}, prior "
            f"`{kept['prior']}`.\n\n```text\n" + "\n".join(commands) + "\n```")
    return "\n\n".join(parts)


def replaced(path, text):
    """The file with `text` between its two marks."""
    old = path.read_text(encoding="utf-8")
    before, rest = old.split(BEGIN)
    return f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}"


TEXTS = [(ROOT / "README.md", readme_table), (DOCS / "gallery.md", gallery_page)]


def experiments(folder):
    """The experiment files of the gallery: that of its page, and the same with an ordinary shutter."""
    page = (DOCS / "tutorial.md").read_text(encoding="utf-8")
    text = page.split("```toml\n")[1].split("```")[0]
    (folder / "experiment.toml").write_text(text)
    (folder / "top-down.toml").write_text(text.replace("dual-inside-out", "top-down"))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", type=Path)
    parser.add_argument("--renew", action="store_true", help="make numbers, pictures and tables anew")
    parser.add_argument("--only", metavar="SCENE", help="one scene alone")
    options = parser.parse_args()
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {"scenes": {}}
    scenes = {name: scene for name, scene in (SCENES | TUTORIAL).items() if options.only in (None, name)}
    if not scenes and options.only not in (RAW_FRAMES, TABLES):
        parser.error(f"no scene {options.only}; there are {', '.join([*SCENES, *TUTORIAL, RAW_FRAMES, TABLES])}")
    faults = []
    with tempfile.TemporaryDirectory(prefix="rowburst-shown-") as folder:
        folder = Path(folder)
        experiments(folder)
        for name, (_, _, commands) in scenes.items():
            run = Run(options.program.resolve(), folder, name, commands)
            now = run.kept()
            say(f"{name}: {now}")
            if options.renew:
                record["scenes"][name] = now
            else:
                kept = record["scenes"].get(name)
                faults += drift(name, kept, now) if kept else [f"{name} is not in {RECORD.name}"]
            for path, scene, make in PICTURES:
                if scene != name:
                    continue
                if options.renew:
                    write(make(run), DOCS / path)
                    say(f"  {path}: {(DOCS / path).stat().st_size / 1000:.0f} kB")
                else:
                    faults += picture_drift(DOCS / path, make(run), folder)
        if options.only in (None, RAW_FRAMES):
            target = DOCS / RAW_FRAMES if options.renew else folder / RAW_FRAMES
            now = raw_frames(options.program.resolve(), target)
            say(f"{RAW_FRAMES}: {len(now)} runs")
            if options.renew:
                record[RAW_FRAMES] = now
            else:
                faults += raw_frames_drift(record[RAW_FRAMES], now, target)
        if options.only in (None, TABLES):
            faults += tables_drift(options.program.resolve(), folder, with_slow=options.only == TABLES)
    if options.renew:
        record |= {"machine": machine(), "program": f"{commit()}"}
        RECORD.write_text(json.dumps(record, indent=1) + "\n")
    for path, text in TEXTS if set(SCENES) <= set(record["scenes"]) else []:
        wanted = replaced(path, text(record))
        if options.renew:
            path.write_text(wanted, encoding="utf-8")
        elif path.read_text(encoding="utf-8") != wanted:
            faults.append(f"{path.relative_to(ROOT)}: the part that is made is not that of {RECORD.name}")
    faults += prose_drift(record["scenes"])
    if faults:
        sys.exit("shown.py: README and site no longer show what the program gives:\n  " + "\n  ".join(faults)
                 + "\nWhere the change is meant: python3 scripts/shown.py PROGRAM --renew, look at the pictures, commit them.")
    say("all that is shown is what the program gives" if not options.renew else "renewed")


if __name__ == "__main__":
    main()
