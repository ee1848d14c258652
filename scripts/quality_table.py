#!/usr/bin/env python3
"""docs/quality.md: how good the program's own choices are, and a general toolbox beside them.

    cargo build --release
    python3 scripts/quality_table.py                 seeds 1 to 5, an hour or two
    python3 scripts/quality_table.py --quick         seed 1 alone
    python3 scripts/quality_table.py --only leds --no-toolbox

Problems are drawn anew for each seed by `rowburst simulate` (108x108 pixels, 54 bins,
dual-inside-out, 9.6 us), and solved by `rowburst reconstruct --prior auto --tau auto`. For four
kinds a grid of priors and tau says how much better a choice by hand would have been. For seed 1
PyProximal's primal-dual method minimises 1/2 |b - A v|^2 + lambda R(v), v >= 0, with A built from
the problem's files by the conventions of the README alone, at the lambda that is best by the truth.

Every finished run is kept in --cache (a folder for each build of the program), so an interrupted
table goes on where it stopped, and a new build starts afresh. Needs numpy, and for the toolbox and
the measured PSF scipy, pylops, pyproximal and Pillow: what is missing is installed by pip into a
virtual environment in the cache folder. Progress goes to standard error.
"""

import argparse
import datetime
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import ROOT, command_line, commit, machine, say, table, with_packages

ROWS = COLUMNS = 108
BINS = ROWS // 2
BIN_US = 9.6
CAMERA = f"""[camera]
rows = {ROWS}
columns = {COLUMNS}
shutter = "dual-inside-out"
row_time_us = {BIN_US}
exposure_us = {BIN_US}
pixel_pitch_um = 6.5
"""
# A scientific CMOS sensor; used by the kinds that count electrons.
SENSOR = """bias_counts = 100
gain_electrons_per_count = 0.5
read_noise_electrons = 1.0
"""

SPACE, SPACE_TIME = (1.0, 0.0), (1.0, 0.5)
# name: what it is called, options of `simulate`, dB to reach, weights of tv and tdiff of the toolbox
KINDS = {
    "digits-12": ("digits, 12 px", ["--scene", "digits"], 46, SPACE),
    "digits-18": ("digits, 18 px", ["--scene", "digits", "--digit-px", 18], 39, SPACE),
    "leds": ("three LEDs", ["--scene", "leds"], 57, SPACE_TIME),
    "moving": ("one moving digit", ["--scene", "moving"], 46, SPACE_TIME),
    "digits-snr-32": ("digits, 12 px, SNR 32", ["--scene", "digits", "--snr", 32], None, SPACE),
    "digits-snr-8": ("digits, 12 px, SNR 8", ["--scene", "digits", "--snr", 8], None, SPACE),
    "leds-snr-32": ("three LEDs, SNR 32", ["--scene", "leds", "--snr", 32], None, SPACE_TIME),
    "leds-snr-8": ("three LEDs, SNR 8", ["--scene", "leds", "--snr", 8], None, SPACE_TIME),
    "moving-snr-32": ("one moving digit, SNR 32", ["--scene", "moving", "--snr", 32], None, SPACE_TIME),
    "moving-snr-8": ("one moving digit, SNR 8", ["--scene", "moving", "--snr", 8], None, SPACE_TIME),
    "two-moving": ("two moving digits", ["--scene", "two-moving"], None, SPACE_TIME),
    "beads": ("beads, measured PSF", ["--scene", "BEADS", "--psf", "MEASURED"], None, SPACE_TIME),
    "background": ("a moving digit, static background 3 times as bright", ["--scene", "moving", "--background", 3], None, SPACE_TIME),
    "electrons-200": ("digits, 12 px, 200 electrons a bright scene pixel", ["--scene", "digits", "--scene-electrons", 200], None, SPACE),
    "electrons-20000": ("digits, 12 px, 20,000 electrons a bright scene pixel", ["--scene", "digits", "--scene-electrons", 20000], None, SPACE),
}
GRID_KINDS = ["digits-12", "digits-18", "leds", "moving"]
# Each with the tau that the program finds for it; the best few of these also with other tau.
GRID_PRIORS = [
    "tv+support", "tv+0.5*tdiff+support", "tv+2*tdiff+support", "l1+support", "tv3d+support",
    "group+support", "tv+0.5*tdiff",
]
GRID_FACTORS = [0.25, 0.5, 2.0, 4.0]
GRID_BEST = 3
# Changed with what `measured` finds: kept runs without it are made again.
MEASURES = "v1"


# ---------------------------------------------------------------- problems


def measured_psf(shared, path):
    """The speckle behind 220 grit glass: its darkest pixel taken as dark, 2x2 pixels binned, so that a
    grain is 4 px wide and all displacements of the camera are covered."""
    import numpy as np
    from PIL import Image

    raw = np.asarray(Image.open(shared / "data/speckle-grits/220.bmp").convert("L"), dtype=np.float32)
    raw = raw - raw.min()
    rows, columns = (s // 2 for s in raw.shape)
    np.save(path, raw[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean((1, 3)))


def beads(shared, path, seed):
    """54 frames of 108x108 pixels of the microscope's video at a place that the seed chooses: beads
    are dark there, so their light is what lies more than 8 counts below the frame's surroundings."""
    import numpy as np

    frames = np.load(shared / "data/beads/bulk_water_64x256x256.npz")["frames"].astype(np.float32)
    rng = np.random.default_rng(seed)
    y, x = rng.integers(0, 256 - ROWS, 2)
    # Means over 33x33 pixels by sums along both axes.
    even = frames
    for axis in (1, 2):
        padded = np.pad(even, [(0, 0)] + [(17, 16) if a == axis else (0, 0) for a in (1, 2)], mode="edge")
        sums = np.cumsum(padded, axis=axis, dtype=np.float64)
        even = (np.take(sums, range(33, 33 + 256), axis) - np.take(sums, range(256), axis)) / 33
    light = np.maximum(even - frames - 8.0, 0)[:BINS, y : y + ROWS, x : x + COLUMNS]
    np.save(path, light.astype(np.float32))


class Bench:
    """The program, its cache and what has been run."""

    def __init__(self, program, cache, shared):
        self.program, self.shared = program, shared
        digest = hashlib.sha256(program.read_bytes()).hexdigest()[:10]
        self.version = subprocess.run([program, "--version"], check=True, capture_output=True, text=True).stdout.strip()
        self.help = subprocess.run([program, "reconstruct", "--help"], check=True, capture_output=True, text=True).stdout
        self.cache = cache / digest
        self.toolbox_cache = cache / "toolbox"

    def run(self, *words):
        done = subprocess.run([str(self.program), *map(str, words)], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"rowburst {' '.join(map(str, words))}\n{done.stderr.strip()}")
        return done.stdout

    def problem(self, kind, seed):
        """The folder of a problem, simulated where it is not there yet."""
        folder = self.cache / kind / f"seed-{seed}" / "problem"
        if (folder / "complete").exists():
            return folder
        folder.mkdir(parents=True, exist_ok=True)
        options = [str(o) for o in KINDS[kind][1]]
        experiment = folder.parent / "camera.toml"
        experiment.write_text(CAMERA + (SENSOR if "--scene-electrons" in options else ""))
        if "BEADS" in options:
            beads(self.shared, folder.parent / "beads.npy", seed)
            measured_psf(self.shared, folder.parent / "measured.npy")
            swap = {"BEADS": folder.parent / "beads.npy", "MEASURED": folder.parent / "measured.npy"}
            options = [str(swap.get(o, o)) for o in options]
        self.run("simulate", experiment, *options, "--seed", seed, "-o", folder)
        (folder / "complete").touch()
        return folder

    def reconstruct(self, kind, seed, prior="auto", tau="auto", more=()):
        """`result.json` of a run, with `leds` or `moving_psnr_db` where the problem has them."""
        folder = self.problem(kind, seed)
        name = "_".join([prior.replace("*", "x"), str(tau), *more, MEASURES])
        kept = folder.parent / "runs" / f"{name}.json"
        if kept.exists():
            return json.loads(kept.read_text())
        with tempfile.TemporaryDirectory(prefix="rowburst-quality-") as out:
            result = json.loads(self.run(
                "reconstruct", folder / "experiment.toml", "--frame", folder / "frame.npy", "--truth", folder / "truth.npy",
                "--prior", prior, "--tau", tau, *more, "--json", "-o", out))
            result["measured_here"] = measured(folder, Path(out) / "video.npy", result)
        kept.parent.mkdir(parents=True, exist_ok=True)
        partial = kept.with_suffix(".part")
        partial.write_text(json.dumps(result))
        partial.rename(kept)
        say(f"  {kind} seed {seed} {prior} tau {tau} {' '.join(more)}: {result['psnr_db']:.2f} dB, "
            f"{result['seconds'] + result['setup_seconds']:.1f} s")
        return result


# ---------------------------------------------------------------- what is measured


def measured(folder, video_file, result):
    """Errors that need more than a PSNR."""
    import numpy as np

    notes = json.loads((folder / "simulation.json").read_text())
    truth = np.load(folder / "truth.npy")
    found = {"dark_psnr_db": 10 * float(np.log10(truth.max() ** 2 / np.mean(truth.astype(float) ** 2)))}
    if notes.get("leds"):
        video = np.load(video_file)
        found["leds"] = [led_errors(led, truth, video, result.get("traces")) for led in notes["leds"]]
    moving = folder / "truth-moving.npy"
    if moving.exists():
        part = np.load(moving)
        found["moving_psnr_db"] = result["psnr_db"] - 20 * float(np.log10(truth.max() / part.max()))
    return found


def led_errors(led, truth, video, traces):
    """Relative errors of amplitude and frequency, in per cent.

    Amplitude: the slope of the reconstruction's trace over the true one, mean over 3x3 pixels about the
    LED. Frequency: of `traces` of result.json where one lies at the LED, else of a square wave of duty
    1/2, integrated over the bins, fitted to the trace."""
    import numpy as np

    y, x = round(led["row"]), round(led["column"])
    here = np.s_[:, max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
    want, got = (v[here].mean((1, 2)).astype(float) for v in (truth, video))
    slope = np.polyfit(want, got, 1)[0]
    hertz, source = None, "traces of result.json"
    for trace in traces or []:
        centre = centre_of(trace.get("region", trace))
        if centre and abs(centre[0] - y) <= 2 and abs(centre[1] - x) <= 2:
            hertz = trace.get("frequency_hz")
    if hertz is None:
        hertz, source = square_wave_frequency(got), "square wave fitted by this script"
    return {
        "amplitude_percent": 100 * abs(slope - 1),
        "frequency_percent": 100 * abs(hertz / led["frequency_hz"] - 1),
        "frequency_source": source,
    }


def centre_of(region):
    """Row and column of the middle of a region, as an object or as [y, x, rows, columns], or None."""
    if isinstance(region, list):
        region = dict(zip(("y", "x", "rows", "columns"), region))
    if not isinstance(region, dict):
        return None
    y, x = region.get("y", region.get("row")), region.get("x", region.get("column"))
    if y is None or x is None:
        return None
    # `columns` of a region, `column` of a place.
    return (y + (region.get("rows", 1) - 1) / 2, x + (region.get("columns", 1) - 1) / 2)


def square_wave_frequency(trace):
    """The frequency whose square wave explains most of the trace, by ever finer grids."""
    import numpy as np

    bin_s = BIN_US * 1e-6
    edges = np.arange(len(trace) + 1) * bin_s
    centred = trace - trace.mean()
    nyquist = 0.5 / bin_s

    def explained(hertz, phases):
        u = hertz * edges[None, :] + phases[:, None]
        light_integral = 0.5 * np.floor(u) + np.minimum(u - np.floor(u), 0.5)
        model = np.diff(light_integral, axis=1)
        model -= model.mean(1, keepdims=True)
        norm = np.sqrt((model**2).sum(1))
        return np.where(norm > 1e-9, model @ centred / np.maximum(norm, 1e-9), 0)

    def best_of(frequencies, phases):
        scores = [explained(f, phases) for f in frequencies]
        i = max(range(len(scores)), key=lambda i: scores[i].max())
        return frequencies[i], phases[scores[i].argmax()]

    width = 1 / (len(trace) * bin_s)
    hertz, phase = best_of(np.arange(width, nyquist + width / 2, width / 8), np.arange(0, 1, 1 / 64))
    step, phase_step = width / 8, 1 / 64
    for _ in range(10):
        around = np.linspace(-1, 1, 17)
        hertz, phase = best_of(hertz + step * around, phase + phase_step * around)
        step, phase_step = step / 4, phase_step / 4
    return float(hertz)


# ---------------------------------------------------------------- toolbox


class Bins:
    """A of a dual-inside-out shutter with an exposure of a row: the two rows of instant j see bin j.

    b[r, x] = sum over y, x' of v[j, y, x'] p[H/2 + r - y, W/2 + x - x'], by real transforms along x,
    long enough that nothing wraps into what is kept."""

    def __init__(self, psf):
        import numpy as np
        import scipy.fft

        self.np, self.fft = np, scipy.fft
        self.n = 2 * COLUMNS
        kernel = np.zeros((2 * ROWS - 1, self.n), np.float32)
        cy, cx = psf.shape[0] // 2, psf.shape[1] // 2
        for dy in range(1 - ROWS, ROWS):
            for dx in range(1 - COLUMNS, COLUMNS):
                if 0 <= cy + dy < psf.shape[0] and 0 <= cx + dx < psf.shape[1]:
                    kernel[dy + ROWS - 1, dx % self.n] = psf[cy + dy, cx + dx]
        lines = self.rfft(kernel)
        self.rows = np.array([(BINS - 1 - j, BINS + j) for j in range(BINS)])
        at = self.rows[:, :, None] - np.arange(ROWS)[None, None, :] + ROWS - 1
        self.kernels = lines[at]  # [bin, row, y, frequency]

    def rfft(self, values):
        return self.fft.rfft(values, self.n, axis=-1, workers=2)

    def forward(self, video):
        spectra = self.rfft(video.reshape(BINS, ROWS, COLUMNS))
        seen = self.np.einsum("jkyf,jyf->jkf", self.kernels, spectra)
        frame = self.np.empty((ROWS, COLUMNS), self.np.float32)
        frame[self.rows] = self.fft.irfft(seen, self.n, axis=-1)[..., :COLUMNS]
        return frame.ravel()

    def adjoint(self, frame):
        seen = self.rfft(frame.reshape(ROWS, COLUMNS)[self.rows].astype(self.np.float32))
        spectra = self.np.einsum("jkyf,jkf->jyf", self.kernels.conj(), seen)
        return self.fft.irfft(spectra, self.n, axis=-1, workers=2)[..., :COLUMNS].ravel().astype(self.np.float32)

    def norm(self):
        v = self.np.ones(BINS * ROWS * COLUMNS, self.np.float32)
        for _ in range(30):
            v /= self.np.linalg.norm(v)
            v = self.adjoint(self.forward(v))
        return float(self.np.linalg.norm(v)) ** 0.5


# Steps of PyProximal: the dual step of the data over its strength, and the norm that differences are
# scaled to. Found by trial: 0.06 and 1 end 10 dB lower after 600 iterations on digits.
DATA_STEP, DIFFERENCE_NORM = 0.002, 0.3


def pyproximal_run(bins, norm, b, weight, weights, iterations):
    """As in compare_toolboxes.py: parts are scaled, so that the one dual step fits all."""
    import numpy as np
    import pylops
    import pyproximal

    shape, voxels = (BINS, ROWS, COLUMNS), BINS * ROWS * COLUMNS
    operator = pylops.FunctionOperator(
        lambda v: bins.forward(v) / norm, lambda f: bins.adjoint(f) / norm, b.size, voxels, dtype="float32")
    parts = [(operator, pyproximal.L2(b=b / norm, sigma=norm**2), b.size)]
    difference = lambda axis: pylops.FirstDerivative(shape, axis=axis, kind="forward", dtype="float32")
    space, in_time = weights
    c = 8**0.5 / DIFFERENCE_NORM
    gradient = pylops.VStack([difference(1), difference(2)])
    parts.append(((1 / c) * gradient, pyproximal.L21(ndim=2, sigma=weight * space * c), 2 * voxels))
    if in_time:
        c = 2 / DIFFERENCE_NORM
        parts.append(((1 / c) * difference(0), pyproximal.L1(sigma=weight * in_time * c), voxels))
    step = DATA_STEP * norm**2
    square = 1 + (len(parts) - 1) * DIFFERENCE_NORM**2
    return pyproximal.optimization.primaldual.PrimalDual(
        pyproximal.Box(lower=0.0),
        pyproximal.VStack([g for _, g, _ in parts], nn=[n for _, _, n in parts]),
        pylops.VStack([k for k, _, _ in parts]),
        x0=np.zeros(voxels, np.float32), tau=0.99 / (square * step), mu=step, niter=iterations)


def toolbox(bench, kind, seed, start, iterations):
    """The best lambda of a grid of steps of 3 about `start`, climbed until both neighbours are worse."""
    import numpy as np

    folder = bench.problem(kind, seed)
    frame, psf, truth = (np.load(folder / f"{n}.npy").astype(np.float32) for n in ("frame", "psf", "truth"))
    weights = KINDS[kind][3]
    notes = json.loads((folder / "simulation.json").read_text())
    bias = 100.0 if notes["noise"]["model"] != "gaussian" else 0.0
    key = hashlib.sha256(frame.tobytes() + psf.tobytes() + repr((weights, iterations, DATA_STEP, DIFFERENCE_NORM)).encode()).hexdigest()[:16]
    kept = bench.toolbox_cache / f"{kind}-{key}.json"
    runs = json.loads(kept.read_text()) if kept.exists() else {}
    bins = Bins(psf / psf.sum(dtype=np.float64))
    b = (frame - bias).ravel()
    told = np.linalg.norm(bins.forward(truth) - b) / np.linalg.norm(b)
    if told > 0.3 and "electrons" not in kind:
        raise RuntimeError(f"{kind}: A built from the files does not explain the frame ({told:.2f} of it is left)")
    norm = bins.norm()

    def psnr(step):
        # Whole powers of 3, so that a run with another start finds the same ones.
        weight = 3.0**step
        if str(step) not in runs:
            began = time.perf_counter()
            video = np.maximum(pyproximal_run(bins, norm, b, weight, weights, iterations), 0)
            error = float(((video.astype(np.float64) - truth.ravel()) ** 2).mean())
            runs[str(step)] = {
                "weight": weight,
                "psnr_db": float(10 * np.log10(float(truth.max()) ** 2 / error)),
                "seconds": time.perf_counter() - began,
            }
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(runs))
            say(f"  {kind} seed {seed} PyProximal lambda {weight:.3g}: {runs[str(step)]['psnr_db']:.2f} dB, "
                f"{runs[str(step)]['seconds']:.0f} s")
        return runs[str(step)]["psnr_db"]

    best = round(np.log(start) / np.log(3))
    for _ in range(12):
        higher = max((best - 1, best, best + 1), key=psnr)
        if higher == best:
            break
        best = higher
    return runs[str(best)]


# ---------------------------------------------------------------- tables


def grid(bench, kind, seed):
    """The best run of the grid."""
    runs = []
    for prior in GRID_PRIORS:
        run = bench.reconstruct(kind, seed, prior)
        runs.append((run["psnr_db"], prior, 1.0, run["tau"]))
    for _, prior, _, tau in sorted(runs, reverse=True)[:GRID_BEST]:
        for factor in GRID_FACTORS:
            run = bench.reconstruct(kind, seed, prior, tau=f"{factor * tau:.6g}")
            runs.append((run["psnr_db"], prior, factor, tau))
    return max(runs)


def spread(values, digits=1):
    low, high = min(values), max(values)
    middle = f"{statistics.median(values):.{digits}f}"
    return middle if len(values) == 1 else f"{middle} ({low:.{digits}f} to {high:.{digits}f})"


def common(values):
    """What was said how often."""
    counts = {v: values.count(v) for v in dict.fromkeys(values)}
    return next(iter(counts)) if len(counts) == 1 else ", ".join(f"{n} {v}" for v, n in counts.items())


def describe(options, bench, results, grids, tools, led_runs, skipped):
    """docs/quality.md."""
    seeds = f"seeds {options.seeds[0]} to {options.seeds[-1]}" if len(options.seeds) > 1 else f"seed {options.seeds[0]}"
    rows = []
    for kind, runs in results.items():
        name, _, goal, _ = KINDS[kind]
        tool = tools.get(kind)
        rows.append([
            name,
            spread([r["psnr_db"] for r in runs]),
            "" if goal is None else f"≥ {goal}",
            f"{statistics.median(r['measured_here']['dark_psnr_db'] for r in runs):.1f}",
            spread([r["residual_over_sigma"] for r in runs], 3),
            common([r["fit"] for r in runs]),
            common([f"`{r['prior']}`" for r in runs]),
            spread([r["seconds"] + r["setup_seconds"] for r in runs]),
            *([f"{runs[0]['psnr_db']:.1f}", f"{tool['psnr_db']:.1f}, {tool['seconds']:.0f} s" if tool else ""] if tools else []),
        ])
    text = [
        "# Quality",
        f"Made by `{options.command}` with {bench.version} ({commit()}), {datetime.date.today()}, {machine()}, load average "
        f"{os.getloadavg()[2]:.1f} at the end (over 1: its seconds are those of a busy machine). Do not edit: run the command again.",
        f"Problems of 108×108 pixels and 54 bins (dual-inside-out, 9.6 µs, simulated speckle with a grain of 2.5 px, "
        f"SNR 256 unless stated otherwise), simulated for {seeds}; solved with `--prior auto --tau auto`. "
        f"PSNR in dB with the truth's maximum as peak, median and range; \"dark\" is the PSNR of a video of zeros, since "
        f"zeros dominate the PSNR of a sparse scene; `seconds` includes set-up. Electrons are those that "
        f"the brightest scene pixel sends to the sensor in a bin: less than a hundredth of them falls on the two rows that are read in that bin "
        f"(read noise 1 electron). The brightest pixel of the static background "
        f"is three times as bright as the digit, and its total light is some 50 to 100 times the digit's. Beads: 108×108 pixels of a microscope's video, background "
        f"subtracted, through the speckle measured behind 220 grit glass.",
        f"The last two columns are for seed {options.seeds[0]} only: the program, and PyProximal's primal–dual method with total variation "
        f"(`tv`; with `0.5*tdiff` where the scene is static or moves), {options.toolbox_iterations} iterations, "
        f"at the λ with the highest PSNR on a grid of steps of 3; its time is that of one run.",
        table(["problem", "PSNR", "to reach", "dark", "residual/σ", "fit", "prior chosen", "seconds",
               *([f"seed {options.seeds[0]}", "PyProximal"] if tools else [])], rows),
    ]
    if not tools:
        del text[3]
    if grids:
        rows = []
        for kind, best in grids.items():
            own = [r["psnr_db"] for r in results[kind]]
            lost = [b[0] - o for b, o in zip(best, own)]
            winners = common([f"`{b[1]}`, τ × {b[2]:g}" for b in best])
            rows.append([KINDS[kind][0], spread(own), spread([b[0] for b in best]), spread(lost, 2), winners])
        text += [
            "## The choice of prior and τ",
            f"Compared with the best of {', '.join(f'`{p}`' for p in GRID_PRIORS)}, each at its automatic τ, and the best "
            f"{GRID_BEST} of them at {', '.join(f'{f:g}' for f in GRID_FACTORS)} times that τ; best by PSNR, for each seed. To reach: within 0.5 dB.",
            table(["problem", "chosen by the program", "best of the grid", "lost, dB", "the best"], rows),
        ]
    if led_runs:
        rows = []
        for name, runs in led_runs.items():
            leds = [led for run in runs for led in run["measured_here"]["leds"]]
            rows.append([
                name,
                f"{statistics.median(l['amplitude_percent'] for l in leds):.2f}", f"{max(l['amplitude_percent'] for l in leds):.2f}",
                f"{statistics.median(l['frequency_percent'] for l in leds):.4f}", f"{max(l['frequency_percent'] for l in leds):.4f}",
                common([l["frequency_source"] for l in leds]),
            ])
        text += [
            "## LED traces",
            "Errors in per cent over all LEDs and seeds: amplitude is the slope of the reconstructed over the true trace "
            "(mean of 3×3 pixels). To reach: amplitude within 1 %, frequency within 0.1 %.",
            table(["problem", "amplitude, median", "largest", "frequency, median", "largest", "frequency by"], rows),
        ]
    moving = [r["measured_here"]["moving_psnr_db"] for r in results.get("background", [])]
    if moving:
        text.append(f"With the peak of the moving digit instead of the background's, the PSNR of the foreground is {spread(moving)} dB.")
    text += [f"Left out: {reason}." for reason in skipped]
    return "\n\n".join(text) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/rowburst")
    parser.add_argument("--cache", type=Path, default=ROOT / "target/quality", help="folder of finished runs")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared", help="folder of the real recordings")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/quality.md")
    parser.add_argument("--quick", action="store_true", help="seed 1 alone")
    parser.add_argument("--only", help="kinds, with commas between: " + ", ".join(KINDS))
    parser.add_argument("--no-grid", action="store_true", help="leave out the grid of priors and tau")
    parser.add_argument("--no-toolbox", action="store_true", help="leave out PyProximal")
    parser.add_argument("--toolbox-iterations", type=int, default=600)
    options = parser.parse_args()
    options.seeds = [1] if options.quick else [1, 2, 3, 4, 5]
    options.command = command_line("quality_table.py")
    chosen = options.only.split(",") if options.only else list(KINDS)
    unknown = [k for k in chosen if k not in KINDS]
    if unknown:
        parser.error(f"no kind {', '.join(unknown)}; there are {', '.join(KINDS)}")
    if not options.program.exists():
        parser.error(f"{options.program} is not there: run cargo build --release, or give --program")
    options.cache = options.cache.resolve()
    options.cache.mkdir(parents=True, exist_ok=True)
    modules = ["numpy"] + ([] if options.no_toolbox else ["scipy", "pylops", "pyproximal"]) + (["PIL"] if "beads" in chosen else [])
    with_packages(options.cache, __file__, modules)

    bench = Bench(options.program.resolve(), options.cache, options.shared)
    results, grids, tools, led_runs, skipped = {}, {}, {}, {}, []
    for kind in chosen:
        if kind == "beads" and not (options.shared / "data/beads").exists():
            say(f"beads: skipped, {options.shared / 'data'} is not here")
            skipped.append(f"beads, whose recordings are not in {options.shared}")
            continue
        say(kind)
        try:
            results[kind] = [bench.reconstruct(kind, seed) for seed in options.seeds]
            if kind.startswith("leds"):
                led_runs[KINDS[kind][0]] = results[kind]
                if "--debias" in bench.help:
                    led_runs[f"{KINDS[kind][0]}, `--debias`"] = [
                        bench.reconstruct(kind, seed, more=("--debias",)) for seed in options.seeds]
            if kind in GRID_KINDS and not options.no_grid:
                grids[kind] = [grid(bench, kind, seed) for seed in options.seeds]
            if not options.no_toolbox:
                # After so few iterations the best lambda is some ten times the tau of the minimum.
                start = 10 * bench.reconstruct(kind, options.seeds[0], "tv+0.5*tdiff")["tau"]
                tools[kind] = toolbox(bench, kind, options.seeds[0], start, options.toolbox_iterations)
        except RuntimeError as error:
            say(f"{kind} failed: {error}")
            skipped.append(f"{kind} is not whole: {str(error).splitlines()[-1]}")
        if results:
            whole = {k: v for k, v in results.items() if len(v) == len(options.seeds)}
            options.output.parent.mkdir(parents=True, exist_ok=True)
            options.output.write_text(describe(options, bench, whole, grids, tools, led_runs, skipped))
    say(f"written: {options.output}")
    return 1 if any("not whole" in reason for reason in skipped) else 0


if __name__ == "__main__":
    sys.exit(main())
