#!/usr/bin/env python3
"""docs/real-frames.md: frames with foreign pixels, a wrong PSF, and a stand-in for a real capture.

    cargo build --release
    python3 scripts/real_frames.py -o docs/real-frames.md         many hours; an interrupted table continues
    python3 scripts/real_frames.py --quick                        a small subset, printed
    python3 scripts/real_frames.py --only faults --match "dense, 1 row"

The parts, in order:

    faults    captions, hot, dead and reflecting pixels in frames of 108x108 pixels: what the search for
              foreign pixels finds, and the PSNR by default, with all pixels and no correction, and with the planted
              pixels masked by hand
    noise     a PSF with noise or of another shape: the PSNR by default, and at fixed noise levels
    priors    --prior auto, and the best of several priors with the planted pixels masked by hand
    stand-in  a dense scene behind a caustic diffuser, 135x160 pixels of 8 bits with a caption

Finished runs are kept in --cache (a folder for each build of the program). A run that fails is a row that
says why. Runs follow one another, so the seconds are those of one program at a time. Needs numpy, scipy and
Pillow: what is missing is installed by pip into a virtual environment. Progress goes to standard error.
"""

import argparse
import datetime
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from types import SimpleNamespace

from common import ROOT, command_line, commit, machine, say, table, with_packages
from quality_table import common as counted
from quality_table import spread

CACHE = ROOT / "target/real-frames"
if __name__ == "__main__":
    # The packages have to be there before the next lines.
    with_packages(CACHE, __file__, ["numpy", "scipy", "PIL"])

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import affine_transform, gaussian_filter

SEEDS = {"faults": 1, "noise": 3, "priors": 1, "stand-in": 5}
SNR = 256
TOO_LARGE = 1.003
SCENES = ["digits", "leds", "moving", "dense"]
PRIORS = ["tv+support", "tv+0.5*tdiff+support", "tv+2*tdiff+support", "group+support", "tv+0.5*tdiff", "tv+2*tdiff", "tv+8*tdiff"]
NOISE_FACTORS = [1, 1.4, 2, 2.8, 4, 5.6, 8, 11, 16]
STAND_IN_PRIORS = ["tv+0.5*tdiff", "tv+2*tdiff", "tv+8*tdiff", "tv+2*tdiff+support", "tv+2*tdiff+background"]
# In counts of 255; rounding alone has 0.29.
STAND_IN_SIGMAS = [0.5, 1, 2, 4, 8]
STAND_IN_SHAPE = (135, 160)
KEEP = "--keep-all-pixels"


# ---------------------------------------------------------------- scenes and PSFs


def spot(shape, y, x, sigma):
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * sigma**2))


def dense(bins, rows, columns, seed):
    """A textured ellipse over 30 % of the field that changes slowly, and a moving spot."""
    rng = np.random.default_rng(seed)
    first, last = (gaussian_filter(rng.standard_normal((rows, columns)), 2.5) for _ in range(2))
    y, x = rng.uniform(0.4, 0.6, 2) * (rows, columns)
    radius = np.sqrt(0.3 / np.pi)
    inside = np.hypot(np.arange(rows)[:, None] - y, (np.arange(columns) - x) * rows / columns) < radius * rows
    start, step = rng.uniform(0.1, 0.3, 2) * (rows, columns), rng.uniform(0.3, 0.6, 2) * (rows, columns)
    video = np.zeros((bins, rows, columns), np.float32)
    for t, time in enumerate(np.linspace(0, 1, bins)):
        texture = first + 0.3 * time * (last - first)
        video[t] = inside * np.clip(0.5 + 0.2 * texture / first.std(), 0.05, 1)
        video[t] += 1.5 * spot((rows, columns), *(start + time * step), 1.5)
    return video


def with_lamp(video, rng, brightness, bins):
    """The video with a spot in some bins, `brightness` times its maximum."""
    lit = video.copy()
    lit[bins] += brightness * video.max() * spot(video.shape[1:], *rng.uniform(0.2, 0.8, 2) * video.shape[1:], 1.2).astype(np.float32)
    return lit


def scaled(psf, factor):
    """The PSF `factor` times as large about zero displacement, with the same sum."""
    centre = np.array([side // 2 for side in psf.shape])
    larger = np.maximum(affine_transform(psf.astype(float), [1 / factor] * 2, centre - centre / factor, order=3), 0)
    return (larger * psf.sum(dtype=float) / larger.sum()).astype(np.float32)


def photographed(psf, electrons, rng):
    """The PSF from a capture whose brightest pixel has so many electrons."""
    unit = electrons / psf.max()
    return (rng.poisson(psf * unit) / unit).astype(np.float32)


def with_other_speckle(psf, other, part):
    """The PSF with this part of its light in the speckle `other`."""
    return ((1 - part) * psf / psf.sum() + part * other / other.sum()).astype(np.float32)


def caustic(rows, columns, seed, rays_per_pixel=5):
    """The caustics of a smooth plate in a round aperture: rays bent by its slopes and counted."""
    side = rays_per_pixel * rows
    height = gaussian_filter(np.random.default_rng(seed).standard_normal((side, side)), 6 * rays_per_pixel, mode="wrap")
    slopes = np.gradient(height)
    grid = (np.arange(side) + 0.5) / rays_per_pixel - rows / 2
    starts = np.meshgrid(grid, grid, indexing="ij")
    lit = np.hypot(*starts) < 0.54 * rows
    # Slopes move a ray by 4 pixels (rms).
    y, x = ((start + 4 * slope / slopes[0].std())[lit] for start, slope in zip(starts, slopes))
    edges = [np.arange(n + 1) - n // 2 - 0.5 for n in (2 * rows - 1, 2 * columns - 1)]
    return gaussian_filter(np.histogram2d(y, x, edges)[0], 0.7).astype(np.float32)


def cropped(psf, rows, columns):
    """The middle of the PSF, zero displacement at (rows // 2, columns // 2), in 255 steps."""
    y, x = psf.shape[0] // 2 - rows // 2, psf.shape[1] // 2 - columns // 2
    return np.round(psf[y : y + rows, x : x + columns] * 255 / psf.max()).astype(np.float32)


# ---------------------------------------------------------------- faults of the frame


def caption(frame, rng, fraction, ink):
    """Lines of printed letters from the top until they cover `fraction` of the pixels; `ink` in units of the maximum."""
    rows, columns = frame.shape
    font, page = ImageFont.load_default(size=11), Image.new("L", (columns, rows))
    drawing = ImageDraw.Draw(page)
    for y in range(2, rows - 12, 12):
        x = 3
        while x < columns - 10:
            cover = np.asarray(page) / 255
            if np.mean(cover > 0) >= fraction:
                return frame + cover * (ink * frame.max() - frame)
            letter = chr(rng.integers(ord("A"), ord("Z") + 1))
            drawing.text((x, y), letter, fill=255, font=font)
            x += round(drawing.textlength(letter, font=font)) + 1
    raise ValueError(f"the letters do not cover {fraction} of the pixels")


def lone_pixels(frame, rng, fraction, value):
    """Random pixels at `value` times the maximum."""
    chosen = rng.permutation(frame.size).reshape(frame.shape) < round(fraction * frame.size)
    return np.where(chosen, value * frame.max(), frame)


def dead_row(frame, rng):
    faulty = frame.copy()
    faulty[rng.integers(len(frame) // 4, 3 * len(frame) // 4)] = 0
    return faulty


def reflection(frame, rng):
    return frame + 0.5 * frame.max() * spot(frame.shape, *rng.uniform(0.3, 0.7, 2) * frame.shape, 10)


FAULTS = {
    "nothing foreign": None,
    **{f"bright caption, {p} %": partial(caption, fraction=p / 100, ink=1.2) for p in (1, 5, 10)},
    **{f"dark caption, {p} %": partial(caption, fraction=p / 100, ink=0) for p in (1, 5, 10)},
    **{f"hot pixels, {p:g} %": partial(lone_pixels, fraction=p / 100, value=1.5) for p in (0.1, 1, 3)},
    **{f"dead pixels, {p:g} %": partial(lone_pixels, fraction=p / 100, value=0) for p in (0.1, 1, 3)},
    "dead row": dead_row,
    "reflection": reflection,
    "nothing foreign, flash": None,
    "nothing foreign, bright LED": None,
    "nothing foreign, 200 electrons": None,
}
# Changes of the scene, which are not foreign.
SCENE_CHANGES = {
    "nothing foreign, flash": partial(with_lamp, brightness=5, bins=slice(20, 21)),
    "nothing foreign, bright LED": partial(with_lamp, brightness=20, bins=slice(None, None, 2)),
}
QUICK_FAULTS = ["nothing foreign", "bright caption, 5 %", "hot pixels, 1 %", "reflection", "nothing foreign, flash"]


def with_noise(light, electrons, rng):
    """The light with shot noise of `electrons` at its maximum, or with Gaussian noise; and sigma."""
    if electrons:
        unit = electrons / light.max()
        return rng.poisson(light * unit) / unit, np.sqrt(light.mean() / unit)
    sigma = np.sqrt(np.mean(light**2)) / SNR
    return light + rng.normal(0, sigma, light.shape), sigma


# ---------------------------------------------------------------- problems and runs


def bins_of(rows, exposure):
    return (rows + 1) // 2 + exposure - 1


def camera(rows, columns, shutter, exposure):
    return (f'[camera]\nrows = {rows}\ncolumns = {columns}\nshutter = "{shutter}"\n'
            f"row_time_us = 9.6\nexposure_us = {round(9.6 * exposure, 6)}\npixel_pitch_um = 6.5\n")


def digest(*things):
    sums = hashlib.sha256()
    for thing in things:
        if isinstance(thing, np.ndarray):
            sums.update(repr(thing.shape).encode() + np.ascontiguousarray(thing, np.float32).tobytes())
        else:
            sums.update(repr(thing).encode())
    return sums.hexdigest()[:20]


class Bench:
    """The program, its simulations and finished runs."""

    def __init__(self, program, cache, timeout):
        self.program, self.timeout = program, timeout
        self.version = self.run("--version").strip()
        self.cache = cache / hashlib.sha256(program.read_bytes()).hexdigest()[:10]

    def run(self, *words):
        words = [str(self.program), *map(str, words)]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=self.timeout)
        except subprocess.TimeoutExpired:
            raise RuntimeError(f"stopped after {self.timeout} s") from None
        if done.returncode:
            said = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            raise RuntimeError(next((line for line in said if line.startswith("error")), said[-1]).removeprefix("error: "))
        return done.stdout

    def simulate(self, camera, scene, seed, psf=None):
        """Frame without noise, PSF and truth of a scene, a name or a video."""
        folder = self.cache / "simulations" / digest(camera, scene, seed, psf)
        if not (folder / "complete").exists():
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "camera.toml").write_text(camera)
            words = ["--scene", scene]
            if isinstance(scene, np.ndarray):
                np.save(folder / "scene.npy", scene.astype(np.float32))
                words = ["--scene", folder / "scene.npy"]
            if psf is not None:
                np.save(folder / "given-psf.npy", psf)
                words += ["--psf", folder / "given-psf.npy"]
            self.run("simulate", folder / "camera.toml", *words, "--snr", "inf", "--seed", seed, "--force", "-o", folder)
            (folder / "complete").touch()
        light, psf, truth = (np.load(folder / f"{n}.npy") for n in ("frame", "psf", "truth"))
        return SimpleNamespace(camera=camera, light=light.astype(float), psf=psf, truth=truth)

    def reconstruct(self, problem, prior, *more, mask=None):
        """What `result.json` says of a run, and how many planted and other pixels were left out."""
        mask = None if mask is None or not mask.any() else mask
        key = digest(problem.camera, problem.frame, problem.psf, problem.truth, problem.planted, prior, more, mask)
        kept = self.cache / "runs" / f"{key}.json"
        if kept.exists():
            return json.loads(kept.read_text())
        with tempfile.TemporaryDirectory(prefix="rowburst-real-") as folder:
            folder = Path(folder)
            bad = "" if mask is None else '[calibration]\nbad_pixels = "bad.png"\n'
            (folder / "experiment.toml").write_text(problem.camera + bad)
            for name in ("frame", "psf", "truth"):
                np.save(folder / f"{name}.npy", getattr(problem, name).astype(np.float32))
            if mask is not None:
                Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "bad.png")
            files = [word for name in ("frame", "psf", "truth") for word in (f"--{name}", folder / f"{name}.npy")]
            result = json.loads(self.run(
                "reconstruct", folder / "experiment.toml", *files, "--prior", prior, *more, "--json", "-o", folder / "out"))
            excluded = folder / "out/excluded.npy"
            left_out = np.load(excluded) > 0 if excluded.exists() else np.zeros(problem.frame.shape, bool)
        result |= {"found": int((left_out & problem.planted).sum()), "false": int((left_out & ~problem.planted).sum())}
        kept.parent.mkdir(parents=True, exist_ok=True)
        partial_file = kept.with_suffix(".part")
        partial_file.write_text(json.dumps(result))
        partial_file.rename(kept)
        say(f"  {prior} {' '.join(more)}{' masked' if mask is not None else ''}: {result['psnr_db']:.2f} dB, {seconds(result):.1f} s")
        return result

    def best(self, problem, choices, sigmas):
        """The run with the highest PSNR, planted pixels masked by hand, and its choices."""
        fixed = lambda sigma: [] if sigma is None else ["--noise-sigma", f"{sigma:g}"]
        runs = [(self.reconstruct(problem, prior, KEEP, *fixed(sigma), mask=problem.planted)["psnr_db"], prior, sigma)
                for prior in choices for sigma in sigmas]
        return max(runs, key=lambda run: run[0])


def seconds(run):
    return run["seconds"] + run["setup_seconds"]


def simulated(bench, scene, exposure, seed, change=None):
    cam = camera(108, 108, "dual-inside-out", exposure)
    video = dense(bins_of(108, exposure), 108, 108, seed) if scene == "dense" else scene
    made = bench.simulate(cam, video, seed)
    if change:
        made = bench.simulate(cam, change(made.truth, np.random.default_rng([seed, 1])), seed)
    return made


def planted_problem(bench, scene, exposure, fault, seed, psf_factor=1):
    """A frame of 108x108 pixels with a fault; a pixel is planted where the fault exceeds the noise."""
    made = simulated(bench, scene, exposure, seed, SCENE_CHANGES.get(fault))
    frame, sigma = with_noise(made.light, 200 if "200 electrons" in fault else None, np.random.default_rng([seed, 2]))
    faulty = FAULTS[fault](frame, np.random.default_rng([seed, 3])) if FAULTS[fault] else frame
    psf = made.psf if psf_factor == 1 else scaled(made.psf, psf_factor)
    return SimpleNamespace(camera=made.camera, frame=faulty, psf=psf, truth=made.truth, planted=abs(faulty - frame) > sigma, sigma=sigma)


def stand_in(bench, exposure, seed, change_psf=None, change_light=None):
    """A problem like a published lensless capture: dense scene, caustic PSF from a picture, 8 bits, caption. The changes, each
    of (array, rng), are faults of the PSF that is given and of the light."""
    rows, columns = STAND_IN_SHAPE
    psf = caustic(rows, columns, seed)
    cam = camera(rows, columns, "dual-outside-in", exposure)
    made = bench.simulate(cam, dense(bins_of(rows, exposure), rows, columns, seed), seed, psf)
    rng = np.random.default_rng([seed, 4])
    poor = cropped(change_psf(psf, rng) if change_psf else psf, rows, columns)
    light = change_light(made.light, rng) if change_light else made.light
    unit = 255 / light.max()
    # The truth in units of the light that the cropped PSF has.
    share = poor.sum() * psf.max() / 255 / psf.sum()
    frame, rng = np.round(light * unit), np.random.default_rng([seed, 3])
    faulty = lone_pixels(np.round(caption(frame, rng, 0.03, 1)), rng, 0.0005, 1)
    return SimpleNamespace(camera=cam, frame=faulty, psf=poor, truth=made.truth * unit * share, planted=faulty != frame)


# ---------------------------------------------------------------- parts


def section(title, text, head, cases, row, options):
    """A table with a row for each case whose name matches, and the number of rows whose target holds."""
    rows = []
    for name, *case in cases:
        if options.match not in name:
            continue
        say(name)
        try:
            rows.append([name, *row(*case)])
        except Exception as error:
            say(f"  failed: {error}")
            rows.append([name, f"failed: {error}".replace("|", "/").replace("\n", " ")] + [""] * (len(head) - 2))
    met = sum(row[-1] == "yes" for row in rows)
    return "\n\n".join([f"## {title}", text, table(head, rows), f"The target holds in {met} of {len(rows)} rows."])


def verdict(holds):
    return "yes" if all(holds) else "no" if len(holds) == 1 else f"no: {sum(holds)} of {len(holds)}"


def fixed_prior(scene, options):
    return options.prior or ("tv+0.5*tdiff" if scene == "dense" else "tv+0.5*tdiff+support")


def exposure_text(exposure):
    return f"{exposure} row" + "s" * (exposure > 1)


def decibels(runs):
    return [run["psnr_db"] for run in runs]


def found_and_false(runs, problems):
    """Cells: planted pixels that were left out, and others."""
    found, false = (sum(run[key] for run in runs) for key in ("found", "false"))
    planted, pixels = sum(int(p.planted.sum()) for p in problems), sum(p.frame.size for p in problems)
    return f"{found} of {planted}", f"{false} ({100 * false / pixels:.2f} %)"


def effective_sigma(runs):
    return spread([run["effective_sigma"] / run["noise_sigma"] for run in runs], 2)


def fault_row(bench, options, scene, exposure, factor, fault):
    prior = fixed_prior(scene, options)
    problems = [planted_problem(bench, scene, exposure, fault, seed, factor) for seed in options.seeds]
    before = [bench.reconstruct(p, prior, KEEP, "--self-calibrate", "off") for p in problems]
    default = [bench.reconstruct(p, prior) for p in problems]
    by_hand = [bench.reconstruct(p, prior, KEEP, mask=p.planted) for p in problems]
    lost = [h - d for h, d in zip(decibels(by_hand), decibels(default))]
    if FAULTS[fault]:
        allowed = 1 if fault == "reflection" or factor != 1 else 0.3
        holds = [loss <= allowed for loss in lost]
    else:
        holds = [loss <= 0.1 and run["false"] <= 0.001 * p.frame.size for loss, run, p in zip(lost, default, problems)]
    return [
        *found_and_false(default, problems), spread(decibels(before)), spread(decibels(default)), spread(decibels(by_hand)), spread([-loss for loss in lost], 2),
        spread([seconds(run) for run in default]), spread([seconds(run) for run in before]), counted([run["fit"] for run in default]),
        verdict(holds)]


def faults_section(bench, options):
    exposures, factors = ([1], [1]) if options.quick else ([1, 6], [1, TOO_LARGE])
    scenes, names = (["digits", "dense"], QUICK_FAULTS) if options.quick else (SCENES, FAULTS)
    cases = [(f"{scene}, {exposure_text(exposure)}, {'right PSF' if factor == 1 else 'PSF 0.3 % too large'}, {fault}", scene, exposure, factor, fault)
             for scene in scenes for exposure in exposures for factor in factors for fault in names]
    head = ["scene, exposure, PSF, fault", "foreign pixels left out", "others left out", "all kept, dB", "default, dB", "with a mask, dB", "default − mask",
            "s, default", "s, all kept", "fit", "target met"]
    prior = f"`{options.prior}`" if options.prior else "`tv+0.5*tdiff+support`, for the dense scene `tv+0.5*tdiff`"
    return section(
        "Foreign pixels",
        f"108×108 pixels, dual-inside-out, SNR {SNR}, prior {prior}. All kept: `{KEEP} --self-calibrate off`. With a mask: the foreign pixels as `--bad-pixels`, and `{KEEP}`. "
        "A pixel is foreign where the fault changes it by more than the noise. Target: within 0.3 dB of the mask, within 1 dB for the "
        "reflection and the wrong PSF; with nothing foreign, for either PSF, at most 0.1 % of the pixels left out and at most 0.1 dB lost.",
        head, cases, partial(fault_row, bench, options), options)


def noise_problem(bench, fault, seed):
    problem = planted_problem(bench, "digits", 1, "nothing foreign", seed)
    rng = np.random.default_rng([seed, 4])
    if "electrons" in fault:
        problem.psf = photographed(problem.psf, int(fault.split()[0]), rng)
    elif "speckle" in fault:
        other = simulated(bench, "digits", 1, seed + 1000).psf
        problem.psf = with_other_speckle(problem.psf, other, int(fault.split()[0]) / 100)
    elif "too large" in fault:
        problem.psf = scaled(problem.psf, TOO_LARGE)
    return problem


def noise_row(bench, options, factors, fault):
    default, fixed, chosen = [], {factor: [] for factor in factors}, []
    for seed in options.seeds:
        problem = noise_problem(bench, fault, seed)
        prior = fixed_prior("digits", options)
        default.append(bench.reconstruct(problem, prior))
        for factor in factors:
            fixed[factor].append(bench.reconstruct(problem, prior, "--noise-sigma", f"{factor * problem.sigma:.6g}")["psnr_db"])
        chosen.append(max(factors, key=lambda factor: fixed[factor][-1]))
    best = [max(each) for each in zip(*fixed.values())]
    lost = [b - d for b, d in zip(best, decibels(default))]
    allowed = 0.2 if fault == "nothing wrong" else 0.3
    return [
        spread(fixed[1]), spread(decibels(default)), spread(best), counted([f"{c:g}" for c in chosen]),
        effective_sigma(default), spread([-loss for loss in lost], 2),
        counted([run["fit"] for run in default]), verdict([loss <= allowed for loss in lost])]


def noise_section(bench, options):
    names = ["nothing wrong", "2000 electrons in the PSF's capture", "200 electrons in the PSF's capture",
             "5 % of the light in other speckle", "PSF 0.3 % too large"]
    factors = NOISE_FACTORS[::2] if options.quick else NOISE_FACTORS
    head = ["fault of the PSF", "at σ, dB", "default, dB", "best fixed σ, dB", "best factor", "effective σ/σ", "default − best", "fit", "target met"]
    return section(
        "Noise that the sensor does not have",
        f"Digits of 12 px, exposure of 1 row, SNR {SNR}, prior `{fixed_prior('digits', options)}`; by default, and with `--noise-sigma` at "
        f"{', '.join(f'{f:g}' for f in factors)} times the sensor's σ. Target: within 0.3 dB of the best fixed σ; with nothing wrong within 0.2 dB.",
        head, [(name, name) for name in names[: 2 if options.quick else None]], partial(noise_row, bench, options, factors), options)


GRID_HEAD = ["scene, exposure, fault", "foreign pixels left out", "others left out", "auto, dB", "prior chosen", "effective σ/σ", "best, dB", "best choice", "auto − best", "s, auto",
             "fit", "target met"]


def grid_row(bench, choices, sigmas, allowed_db, problem_of, seeds, limit_s=np.inf):
    """`--prior auto`, and the best of a grid of priors and sigmas."""
    problems = [problem_of(seed) for seed in seeds]
    auto = [bench.reconstruct(p, "auto") for p in problems]
    best = [bench.best(p, choices, sigmas) for p in problems]
    lost = [b[0] - d for b, d in zip(best, decibels(auto))]
    return [
        *found_and_false(auto, problems), spread(decibels(auto)), counted([f"`{run['prior']}`" for run in auto]), effective_sigma(auto),
        spread([b[0] for b in best]), counted([f"`{b[1]}`" + (f", σ {b[2]:g}" if b[2] else "") for b in best]), spread([-loss for loss in lost], 2),
        spread([seconds(run) for run in auto]), counted([run["fit"] for run in auto]),
        verdict([loss <= allowed_db and seconds(run) <= limit_s for loss, run in zip(lost, auto)])]


def priors_section(bench, options):
    choices, exposures = (["tv+0.5*tdiff+support", "tv+0.5*tdiff"], [1]) if options.quick else (PRIORS, [1, 6])
    cases = [(f"{scene}, {exposure_text(exposure)}, {fault}", partial(planted_problem, bench, scene, exposure, fault), options.seeds)
             for scene in SCENES for exposure in exposures for fault in ("nothing foreign", "bright caption, 5 %")]
    return section(
        "The prior",
        f"`--prior auto`, and the best by the truth of {', '.join(f'`{c}`' for c in choices)}, with the foreign pixels masked. "
        "Target: within 0.5 dB.",
        GRID_HEAD, cases, partial(grid_row, bench, choices, [None], 0.5), options)


def stand_in_section(bench, options):
    choices, sigmas, exposures = (STAND_IN_PRIORS[:2], [1, 4], [3]) if options.quick else (STAND_IN_PRIORS, STAND_IN_SIGMAS, [3, 6])
    rows, columns = STAND_IN_SHAPE
    cases = [(f"stand-in, {exposure_text(exposure)}, seed {seed}", partial(stand_in, bench, exposure), [seed], 30 if exposure == 3 else np.inf)
             for exposure in exposures for seed in options.seeds]
    return section(
        "A stand-in for a real capture",
        f"{rows}×{columns} pixels, dual-outside-in, a dense scene behind a caustic diffuser whose PSF is cropped and has 8 bits; the frame is rounded "
        "to 8 bits and has a caption over 3 % of its pixels and hot pixels. The default, `--prior auto`, and the best by the truth of "
        f"{', '.join(f'`{c}`' for c in choices)} and σ {', '.join(f'{s:g}' for s in sigmas)}, with the foreign pixels masked. "
        f"Target: within 1 dB, and at an exposure of 3 rows ({bins_of(rows, 3)} bins) at most 30 s.",
        GRID_HEAD, cases, partial(grid_row, bench, choices, sigmas, 1), options)


PARTS = {"faults": faults_section, "noise": noise_section, "priors": priors_section, "stand-in": stand_in_section}


def document(options, bench, sections):
    seeds = ", ".join(f"{part} {count}" for part, count in options.seed_counts.items())
    return "\n\n".join([
        "# Faults of real frames, simulated",
        f"Made by `{command_line('real_frames.py')}` with {bench.version} ({commit()}), {datetime.date.today()}, {machine()}, load average "
        f"{os.getloadavg()[2]:.1f} at the end (over 1: its seconds are those of a busy machine). Do not edit: run the command again.",
        f"Every frame is simulated and then spoilt on purpose, so that the truth is known. Number of seeds: {seeds}. PSNR with the truth's maximum as peak; where there are several seeds, median and range. Seconds include set-up.",
        *sections]) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/rowburst")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of finished runs")
    parser.add_argument("-o", "--output", type=Path, help="the Markdown file, such as docs/real-frames.md")
    parser.add_argument("--quick", action="store_true", help="a small subset with one seed")
    parser.add_argument("--only", choices=PARTS, help="one part")
    parser.add_argument("--match", default="", metavar="TEXT", help="only rows whose name contains TEXT")
    parser.add_argument("--seeds", type=int, metavar="N", help=f"seeds 1 to N [default: {', '.join(f'{p} {n}' for p, n in SEEDS.items())}]")
    parser.add_argument("--prior", help="prior of faults and noise, also auto [default: a fixed one for each scene]")
    parser.add_argument("--timeout", type=float, default=1800, help="seconds after which a run is stopped")
    options = parser.parse_args()
    if not options.program.exists():
        parser.error(f"{options.program} is not there: run cargo build --release, or give --program")
    bench = Bench(options.program.resolve(), options.cache.resolve(), options.timeout)
    sections, parts = [], [options.only] if options.only else list(PARTS)
    options.seed_counts = {part: options.seeds or (1 if options.quick else SEEDS[part]) for part in parts}
    for part in parts:
        options.seeds = range(1, options.seed_counts[part] + 1)
        sections.append(PARTS[part](bench, options))
        if options.output:
            options.output.parent.mkdir(parents=True, exist_ok=True)
            options.output.write_text(document(options, bench, sections))
    print(document(options, bench, sections), end="")


if __name__ == "__main__":
    sys.exit(main())
