#!/usr/bin/env python3
"""docs/long-exposures.md: what an exposure longer than a row costs in quality and in time.

    cargo build --release
    python3 scripts/long_exposures.py -o docs/long-exposures.md     ten minutes; an interrupted table continues
    python3 scripts/long_exposures.py --quick                       a small subset, printed
    python3 scripts/long_exposures.py --match "moving digit"

Each row is a frame of 108x108 pixels, reconstructed by a named prior with the noise given, by one thread, so that its
seconds are those of the processor. Time is that of the solver with its set-up, until the PSNR stays within 0.5 dB of
its end; it is also given over that of an exposure of one row of the same scene. The certificate is how far the
objective lies above its minimum, at most. A second table asks how much light pays: the same lamp, and so as many times
the electrons as the exposure is rows long.

Finished runs are kept in --cache (a folder for each build of the program). Needs numpy, scipy and Pillow: what is
missing is installed by pip into a virtual environment. Progress goes to standard error.
"""

import argparse
from pathlib import Path
from types import SimpleNamespace

from common import ROOT, command_line, commit, machine, say, table, with_packages

CACHE = ROOT / "target/long-exposures"
if __name__ == "__main__":
    # The packages have to be there before the next lines.
    with_packages(CACHE, __file__, ["numpy", "scipy", "PIL"])

import numpy as np
from real_frames import KEEP, Bench, exposure_text, with_noise

PRIOR = "tv+0.5*tdiff+support"
SCENES = {"moving": "moving digit", "digits": "54 digits", "leds": "three LEDs"}
EXPOSURES = [1, 1.3, 2.5, 6, 20, 48]
# Shutter, bins a row, patches a side.
DUAL = ("dual-inside-out", 1)
VARIANTS = [("top-down", 1), ("dual-outside-in", 1), ("dual-inside-out", 2)]
# Largest certificate, and most iterations, for an exposure of so many rows.
GOALS = [(6, 0.001, {"leds": 300}, 150), (48, 0.02, {}, 300)]
# Electrons in the brightest pixel of the frame at an exposure of one row.
ELECTRONS = [30, 300, 3000]


def camera(exposure, shutter, bins_per_row):
    return (f'[camera]\nrows = 108\ncolumns = 108\nshutter = "{shutter}"\nrow_time_us = 9.6\n'
            f"exposure_us = {round(9.6 * exposure, 6)}\nbins_per_row = {bins_per_row}\npixel_pitch_um = 6.5\n")


def problem(bench, scene, exposure, seed, shutter, bins_per_row, electrons=None):
    """A frame with noise of SNR 256, or with shot noise of these electrons in its brightest pixel."""
    made = bench.simulate(camera(exposure, shutter, bins_per_row), scene, seed)
    frame, sigma = with_noise(made.light, electrons, np.random.default_rng([seed, 2]))
    return SimpleNamespace(camera=made.camera, frame=frame, psf=made.psf, truth=made.truth,
                           planted=np.zeros(frame.shape, bool), sigma=sigma)


def run(bench, made):
    return bench.reconstruct(made, PRIOR, KEEP, "--self-calibrate", "off", "--noise-sigma", f"{made.sigma:.9g}", "--threads", "1")


def seconds_to(result, below_db):
    """Seconds of the solver and its set-up until the PSNR stays within `below_db` of its end, and iterations."""
    history = result["history"]
    # The clock of the history began with the process, that of the solver after the files were read.
    began = history[-1]["seconds"] - result["seconds"] - result["setup_seconds"]
    end = history[-1]["psnr_db"] - below_db
    outside = [k for k, point in enumerate(history) if point["psnr_db"] < end]
    first = history[min(max(outside, default=-1) + 1, len(history) - 1)]
    return first["seconds"] - began, first["iteration"]


def goal(scene, exposure):
    for rows, certificate, iterations, usual in GOALS:
        if exposure <= rows:
            return certificate, iterations.get(scene, usual)
    raise ValueError(f"no goal for {exposure} rows")


def speed_rows(bench, options):
    cases = [(scene, exposure, *DUAL) for scene in SCENES for exposure in options.exposures]
    cases += [(scene, exposure, *variant) for variant in VARIANTS for scene in ("moving", "digits") for exposure in (2.5, 6)]
    one_row = {}
    for scene, exposure, shutter, bins in cases:
        name = f"{SCENES[scene]}, {exposure_text(exposure)}" + f", {shutter}" * (shutter != DUAL[0]) + ", 2 bins a row" * (bins == 2)
        if options.match not in name:
            continue
        say(name)
        result = run(bench, problem(bench, scene, exposure, options.seed, shutter, bins))
        taken, iterations = seconds_to(result, 0.5)
        if exposure == 1:
            one_row[scene] = taken
        ratio = f"{taken / one_row[scene]:.1f}" if scene in one_row and (shutter, bins) == DUAL else ""
        certificate, most = goal(scene, exposure)
        excess = result["objective_excess"] if result["objective_excess"] is not None else np.inf
        met = excess <= certificate and result["iterations"] <= most
        yield [name, f"{result['psnr_db']:.2f}", f"{result['iterations']}", f"{100 * excess:.2f} %",
               f"{iterations}", f"{taken:.2f} s", ratio, f"{result['peak_memory_bytes'] / 2**20:.0f} MiB", "yes" if met else "no"]


def light_rows(bench, options):
    for scene in SCENES:
        for electrons in ELECTRONS:
            if options.match not in f"{SCENES[scene]}, light":
                continue
            say(f"{SCENES[scene]}, {electrons} electrons a row")
            cells = []
            for exposure in options.exposures:
                made = problem(bench, scene, exposure, options.seed, *DUAL, electrons=electrons * exposure)
                cells.append(run(bench, made)["psnr_db"])
            best = max(cells)
            yield [SCENES[scene], str(electrons), *(f"**{c:.1f}**" if c == best else f"{c:.1f}" for c in cells)]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/rowburst")
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--timeout", type=float, default=1800, help="seconds for a run")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--match", default="", help="only the rows whose name holds this")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    options.exposures = [1, 6] if options.quick else EXPOSURES
    if options.quick:
        VARIANTS.clear()
        ELECTRONS[:] = [300]
        SCENES.pop("leds")
    bench = Bench(options.program.resolve(), options.cache, options.timeout)
    speed, light = list(speed_rows(bench, options)), list(light_rows(bench, options))
    met = sum(row[-1] == "yes" for row in speed)
    text = "\n\n".join([
        "# Long exposures in numbers",
        f"Made by `{command_line('long_exposures.py')}` with {bench.version} ({commit()}), {machine()}. Do not edit: run the command again.",
        f"108×108 pixels, dual-inside-out, a row time of 9.6 µs, prior `{PRIOR}`, noise given. What it means for a choice is in "
        "[Long exposures](explanation/long-exposures.md).",
        "## Convergence and time",
        "SNR 256. Certificate: how far the objective lies above its minimum, at most. Time is that of one thread, with set-up, until the PSNR "
        "stays within 0.5 dB of its end; the ratio is to one row of the same scene. Memory is that of the process. Target: up to 6 rows 0.1 % in "
        "150 iterations (LEDs 300), above 2 % in 300.",
        table(["case", "PSNR, dB", "iterations", "certificate", "iterations to 0.5 dB", "time to 0.5 dB", "over one row", "memory", "target"], speed),
        f"The target holds in {met} of {len(speed)} rows.",
        "## Light against speed",
        "The same lamp: the first number is the electrons in the brightest pixel at one row, and an exposure of n rows has n times as many. PSNR "
        "in dB; the best of a row is bold.",
        table(["scene", "electrons at one row", *map(exposure_text, options.exposures)], light),
    ]) + "\n"
    print(text) if options.output is None else options.output.write_text(text)


if __name__ == "__main__":
    main()
