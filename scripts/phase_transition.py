#!/usr/bin/env python3
"""docs/phase-transition.md: how many non-zero pixels a bin may have, over its measurements.

    cargo build --release
    python3 scripts/phase_transition.py              about a quarter of an hour
    python3 scripts/phase_transition.py --quick      coarser, three sensors instead of five

For three PSFs, speckle and a caustic as `rowburst simulate` makes them and speckle measured behind
ground glass, `rowburst design` reconstructs scenes of k random pixels a bin at an SNR of 256 until the
edge of success is found. The measurements of a bin, m, are changed by the number of rows that a custom
shutter reads at a time: 1 to 6 rows of 108 pixels, as far apart as they can be. Each PSF gets its C of
m = C k ln(n/k), the median over m, and the figure shows success beside that line.

Finished runs are kept in --cache (a folder for each build of the program). Needs numpy, Pillow and
matplotlib: what is missing is installed by pip into a virtual environment in the cache folder. Where the
measured speckle (../shared/data/speckle-grits) is absent its panel is left out, with a message.
"""

import argparse
import datetime
import hashlib
import json
import statistics
import subprocess
import sys
from pathlib import Path

from common import ROOT, command_line, commit, machine, say, table, with_packages
from quality_table import CAMERA, COLUMNS, ROWS, measured_psf

ROWS_AT_A_TIME = [1, 2, 3, 4, 6]
SNR = 256
# A smooth plate in a pupil four times as wide as the speckle's: enough of its parts fill the pupil that
# the folds cover the field.
CAUSTIC = ["--diffuser-phase", 80, "--pupil-mm", 6.84]
PSFS = {
    "speckle": "synthetic speckle",
    "measured": "measured speckle (220 grit ground glass)",
    "caustic": "caustic of a smooth phase plate",
}


class Bench:
    def __init__(self, program, cache, shared, seed):
        self.program, self.shared, self.seed = program, shared, seed
        digest = hashlib.sha256(program.read_bytes()).hexdigest()[:10]
        self.version = self.run("--version").strip()
        self.cache = cache / digest / "phase-transition" / f"seed-{seed}"
        self.cache.mkdir(parents=True, exist_ok=True)

    def run(self, *words):
        done = subprocess.run([str(self.program), *map(str, words)], capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"rowburst {' '.join(map(str, words))}\n{done.stderr.strip()}")
        return done.stdout

    def psf(self, name):
        """The file of a PSF."""
        path = self.cache / f"{name}.npy"
        if path.exists():
            return path
        if name == "measured":
            measured_psf(self.shared, path)
            return path
        experiment, folder = self.cache / "camera.toml", self.cache / f"{name}-simulation"
        experiment.write_text(CAMERA)
        options = CAUSTIC if name == "caustic" else []
        self.run("simulate", experiment, "--scene", "moving", *options, "--seed", self.seed, "-o", folder)
        path.write_bytes((folder / "psf.npy").read_bytes())
        return path

    def map(self, name, rows_at_a_time):
        """`success_map` and grain of a design whose shutter reads so many rows at a time."""
        import numpy as np

        kept = self.cache / f"{name}-{rows_at_a_time}.json"
        if kept.exists():
            return json.loads(kept.read_text())
        # Instant i reads the rows i, i + bins, i + 2 bins, ...
        bins = ROWS // rows_at_a_time
        order = self.cache / f"order-{rows_at_a_time}.npy"
        np.save(order, np.arange(ROWS, dtype=np.int64) % bins)
        experiment = self.cache / f"camera-{rows_at_a_time}.toml"
        camera = CAMERA.replace('"dual-inside-out"', f'"custom"\nrow_order = "{order.name}"')
        experiment.write_text(camera)
        design = json.loads(self.run(
            "design", "--experiment", experiment, "--psf", self.psf(name), "--trial-snr", SNR, "--seed", self.seed, "--json"))
        found = {**design["success_map"], "grain_px": design["measured_grain_px"], "seconds": design["seconds"]}
        kept.write_text(json.dumps(found))
        say(f"  {name}, {found['measurements_per_bin']:.0f} measurements: half of the bins are recovered at "
            f"{found['half_success_pixels'][0]:.1f} pixels, {found['seconds']:.0f} s")
        return found


def constant(found):
    """C at half success, or None where the edge was not met."""
    k = found["half_success_pixels"][0]
    return found["sparsity_constants"][0] if 0 < k < found["nonzero_pixels"][-1] else None


def needed(c, k, n):
    import numpy as np

    return c * k * np.log(n / k)


def psf_panel(axes, psf):
    import numpy as np

    cy, cx = psf.shape[0] // 2, psf.shape[1] // 2
    middle = psf[cy - ROWS + 1 : cy + ROWS, cx - COLUMNS + 1 : cx + COLUMNS]
    axes.imshow(middle, cmap="inferno", vmax=np.percentile(middle, 99.8), interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])


def draw(maps, psfs, constants, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    figure, axes = plt.subplots(
        2, len(maps), figsize=(3.6 * len(maps) + 0.8, 6.2), height_ratios=[1, 1.5], squeeze=False, layout="constrained")
    n = ROWS * COLUMNS
    for column, (name, found) in enumerate(maps.items()):
        psf_panel(axes[0, column], psfs[name])
        axes[0, column].set_title(PSFS[name], fontsize=10)
        panel = axes[1, column]
        ms = [f["measurements_per_bin"] for f in found]
        edges = between(ms)
        for f, low, high in zip(found, edges, edges[1:]):
            mesh = panel.pcolormesh(between(f["nonzero_pixels"]), [low, high], np.array(f["success"]), vmin=0, vmax=1, cmap="cividis")
        halves = [(f["half_success_pixels"][0], f["measurements_per_bin"]) for f in found if constant(f)]
        panel.plot(*zip(*halves), "o", color="white", markeredgecolor="black", markersize=5, label="half of the bins")
        ks = np.geomspace(1, n / np.e, 300)
        panel.plot(ks, needed(constants[name], ks, n), color="#e0662f", linewidth=2,
                   label=f"m = {constants[name]:.2f} k ln(n/k)")
        panel.set(xscale="log", yscale="log", ylim=(edges[0], edges[-1]),
                  xlim=(min(between(f["nonzero_pixels"])[0] for f in found), max(between(f["nonzero_pixels"])[-1] for f in found)),
                  xlabel="non-zero pixels in a bin, k")
        panel.set_yticks(ms, [f"{m:.0f}" for m in ms])
        panel.minorticks_off()
        panel.set_xticks(ticks := [t for t in (2, 5, 10, 20, 50, 100, 200) if panel.get_xlim()[0] <= t <= panel.get_xlim()[1]], ticks)
        panel.legend(loc="lower right", fontsize=8, framealpha=0.9)
    axes[1, 0].set_ylabel("measurements of a bin, m")
    figure.colorbar(mesh, ax=axes[1, :], label="fraction of bins that were recovered")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    shrink(path)


def shrink(path):
    """255 colours are enough and keep the file small."""
    from PIL import Image

    Image.open(path).convert("RGB").quantize(255).save(path, optimize=True)


def between(values):
    """Edges of cells about values, in equal ratios."""
    import numpy as np

    logs = np.log(np.asarray(values, float))
    if len(logs) == 1:
        return [values[0] / 1.3, values[0] * 1.3]
    inner = (logs[1:] + logs[:-1]) / 2
    return list(np.exp([2 * logs[0] - inner[0], *inner, 2 * logs[-1] - inner[-1]]))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/rowburst")
    parser.add_argument("--cache", type=Path, default=ROOT / "target/quality", help="folder of finished runs")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared", help="folder of the real recordings")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/phase-transition.md")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="1, 2 and 4 rows at a time alone")
    options = parser.parse_args()
    if not options.program.exists():
        parser.error(f"{options.program} is not there: run cargo build --release, or give --program")
    options.cache = options.cache.resolve()
    options.cache.mkdir(parents=True, exist_ok=True)
    with_packages(options.cache, __file__, ["numpy", "PIL", "matplotlib"])
    import numpy as np

    bench = Bench(options.program.resolve(), options.cache, options.shared, options.seed)
    steps = [1, 2, 4] if options.quick else ROWS_AT_A_TIME
    maps, psfs, constants, rows, left_out = {}, {}, {}, [], ""
    for name in PSFS:
        if name == "measured" and not (options.shared / "data/speckle-grits/220.bmp").exists():
            say(f"measured speckle: skipped, {options.shared / 'data/speckle-grits'} is not here")
            left_out = "The measured speckle is omitted: its recording was not found."
            continue
        say(PSFS[name])
        found = [bench.map(name, step) for step in steps]
        of_edges = [c for c in map(constant, found) if c]
        if not of_edges:
            sys.exit(f"{name}: no sensor met the edge of success")
        maps[name], psfs[name] = found, np.load(bench.psf(name))
        constants[name] = statistics.median(of_edges)
        rows.append([
            PSFS[name], f"{found[0]['grain_px']:.1f}", f"**{constants[name]:.2f}**", f"{min(of_edges):.2f} to {max(of_edges):.2f}",
            *[f"{f['half_success_pixels'][0]:.1f}" if constant(f) else "none" for f in found],
        ])
    picture = options.output.with_suffix(".png")
    draw(maps, psfs, constants, picture)
    trials = [f["trials"] for f in next(iter(maps.values()))]
    text = [
        "# How many pixels of a bin can be recovered",
        f"Made by `{command_line('phase_transition.py')}` with {bench.version} ({commit()}), {datetime.date.today()}, {machine()}. Do not edit: run the command again.",
        f"![Success over non-zero pixels and measurements for {len(maps)} PSFs; above each its PSF]({picture.name})",
        f"Compressed sensing promises k non-zero pixels of n from m ≥ C·k·ln(n/k) random measurements, and leaves C open. Here C is measured: "
        f"scenes of k isolated pixels at random positions in each bin of {ROWS}×{COLUMNS} pixels (n = {ROWS * COLUMNS:,}), SNR {SNR}, reconstructed with `l1+support`; a bin is "
        f"recovered where it differs from its truth, at the resolution of a grain, by less than {100 * next(iter(maps.values()))[0]['largest_relative_error']:.0f} % of the norm. "
        f"The measurements of a bin are those of the {', '.join(map(str, steps))} rows that the shutter reads at a time; a cell of the figure is "
        f"{trials[-1]} to {trials[0]} bins (cells far from the edge are not tested and have their neighbour's value; white: outside the tested range). Above each map, the middle of its PSF.",
        table(
            ["PSF", "grain, px", "C, median", "C, range", *[f"k at m = {f['measurements_per_bin']:.0f}" for f in next(iter(maps.values()))]],
            rows,
        ),
        "k is the number of non-zero pixels at which half of the bins are recovered. Connected shapes such as digits need fewer measurements "
        "than as many scattered pixels. A single row (m = 108) receives little light from pixels beyond the envelope of a PSF, which the line does "
        "not take into account. A larger grain needs fewer measurements: positions within a grain need not be resolved.",
        f"The caustic is the far field of a smooth random phase plate of the same scattering angle, {CAUSTIC[1]} radians rms instead of the speckle's 4, "
        f"in a pupil four times as wide (`rowburst simulate {' '.join(map(str, CAUSTIC))}`).",
        left_out,
    ]
    options.output.write_text("\n\n".join(t for t in text if t) + "\n")
    say(f"written: {options.output}, {picture} ({picture.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    main()
