#!/usr/bin/env python3
"""docs/speed.md, "Time to quality": how long it takes to 38 and 44 dB, and general toolboxes beside.

    cargo build --release
    python3 scripts/time_to_quality.py               about an hour the first time, then half of that
    python3 scripts/time_to_quality.py --no-climb    with the settings where the climb starts: those that served best before
    python3 scripts/time_to_quality.py --quick       one round of 30 s each, with the settings where the climb starts
    python3 scripts/time_to_quality.py --fresh       the timed runs again, the toolboxes' settings kept
    python3 scripts/time_to_quality.py --report      the page again from the runs that there are

The problem is ../shared/problems/digits12. `rowburst reconstruct --truth` writes its PSNR against the time since
its process started (`history` of result.json; comparing with the truth is not counted). SCICO and PyProximal
(scripts/toolboxes.py) get the operator in the same efficient form and first their best settings: lambda and step
are climbed by the truth on a grid of steps of 3, with --tuning-seconds for each. Then, in rounds, each runs for --seconds,
with runs of the program before, between and after, so that a machine that is busy for a while is so for
all. Finished runs are kept in --cache, so an interruption loses one run. Needs numpy, scipy, matplotlib, scico, pylops and
pyproximal: what is missing is installed by pip into a virtual environment in the cache folder.
"""

import argparse
import datetime
import hashlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import ROOT, command_line, commit, machine, say, table, with_packages

MARKS = ("<!-- time to quality: begin -->", "<!-- time to quality: end -->")
GOALS = [38.0, 44.0]
PRIORS = {"tv+0.5*tdiff+support": "Rowburst", "auto": "Rowburst, `--prior auto`"}
# Runs of the program before and after each toolbox; auto takes several times as long.
RUNS = {"tv+0.5*tdiff+support": 3, "auto": 1}
# Title, what is fixed, exponents of 3 where the climb starts.
TOOLBOXES = {
    "scico-apgm": ("SCICO accelerated proximal gradient", {}, {"lambda": -16, "step": 0}),
    "scico-pdhg": ("SCICO PDHG", {}, {"lambda": -19, "step": -8}),
    "scico-admm": ("SCICO ADMM, data step by CG", {"cg": 10}, {"lambda": -15, "step": -7}),
    "scico-proximal-admm": ("SCICO proximal ADMM", {}, {"lambda": -19, "step": -7}),
    "pyproximal-primal-dual": ("PyProximal primal–dual", {}, {"lambda": -17, "step": -6}),
    "pyproximal-apg": ("PyProximal accelerated proximal gradient", {"inner": 1}, {"lambda": -15, "step": 0}),
}
# A toolbox has come to its best quality when it is this close.
SLACK_DB = 0.1


class Bench:
    def __init__(self, options):
        self.options, self.program = options, options.program.resolve()
        self.problem = options.shared / "problems/digits12"
        self.version = self.run(self.program, "--version").strip()
        digest = lambda *parts: hashlib.sha256(b"".join(parts)).hexdigest()[:10]
        data = b"".join((self.problem / f"{n}.npy").read_bytes() for n in ("frame", "psf", "truth"))
        scripts = b"".join((ROOT / "scripts" / n).read_bytes() for n in ("toolboxes.py", "quality_table.py"))
        self.tuning = options.cache / f"tuning-{digest(data, scripts)}-{options.tuning_seconds:g}s.json"
        self.session = options.cache / f"session-{digest(data, scripts, self.program.read_bytes())}-{options.seconds:g}s.json"

    @staticmethod
    def run(*words):
        done = subprocess.run([str(w) for w in words], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{' '.join(map(str, words))}\n{done.stderr.strip()}")
        return done.stdout

    def toolbox(self, method, settings, seconds):
        return json.loads(self.run(
            sys.executable, ROOT / "scripts/toolboxes.py", method, self.problem,
            "--seconds", seconds, "--settings", json.dumps(settings)))

    def launch_seconds(self):
        """What the clock of the program does not see: until its first line runs, and to its end."""
        def once():
            began = time.perf_counter()
            self.run(self.program, "--version")
            return time.perf_counter() - began
        return min(once() for _ in range(10))

    def ours(self, prior):
        """Points of (seconds since the start of the process, PSNR), and the whole time to its end."""
        taken, launch = busy(), self.launch_seconds()
        with tempfile.TemporaryDirectory(prefix="rowburst-speed-") as out:
            began = time.perf_counter()
            result = json.loads(self.run(
                self.program, "reconstruct", self.problem / "experiment.toml", "--frame", self.problem / "frame.npy",
                "--psf", self.problem / "psf.npy", "--truth", self.problem / "truth.npy", "--prior", prior, "--json", "-o", out))
            whole = time.perf_counter() - began
        return {
            "points": [(launch + p["seconds"], p["iteration"], p["psnr_db"]) for p in result["history"]],
            "end_seconds": result["history"][-1]["seconds"] + launch, "whole_seconds": whole,
            "setup_seconds": result["setup_seconds"], "psnr_db": result["psnr_db"], "prior": result["prior"],
            "launch_seconds": launch, "busy": taken,
        }


def kept(path):
    return json.loads(path.read_text()) if path.exists() else {}


def keep(path, value):
    partial = path.with_suffix(".part")
    partial.write_text(json.dumps(value))
    partial.rename(path)


def busy():
    """The part of the processors' time that others take just now, from 0 to 1; None where the system does not tell."""
    def ticks():
        values = [int(v) for v in Path("/proc/stat").read_text().split("\n")[0].split()[1:]]
        return sum(values), values[3] + values[4]
    try:
        all_before, idle_before = ticks()
        time.sleep(0.5)
        all_now, idle_now = ticks()
    except (OSError, IndexError, ValueError):
        return None
    return 1 - (idle_now - idle_before) / max(all_now - all_before, 1)


def settings_of(method, exponents):
    return TOOLBOXES[method][1] | {name: 3.0**e for name, e in exponents.items()}


def tuned(bench, method):
    """Exponents of the best settings: each of them a step up and down is worse."""
    say(f"settings of {method}")
    runs = kept(bench.tuning)
    best = dict(TOOLBOXES[method][2])

    def quality(exponents):
        key = f"{method} {json.dumps(exponents)}"
        if key not in runs:
            run = bench.toolbox(method, settings_of(method, exponents), bench.options.tuning_seconds)
            finite = [p[2] for p in run["points"] if p[2] == p[2]]
            runs[key] = max(finite, default=0.0)
            keep(bench.tuning, runs)
            say(f"  {key}: {runs[key]:.2f} dB, {run['iterations']} iterations")
        return runs[key]

    for _ in range(10):
        before = dict(best)
        for name in best:
            best = max(({**best, name: best[name] + d} for d in (0, 1, -1)), key=quality)
        if best == before:
            break
    return best


def first(points, db):
    """The first time at which the quality is reached, or None."""
    return next((p[0] for p in points if p[2] >= db), None)


def seconds(value):
    return "–" if value is None else f"{value:.1f} s" if value >= 10 else f"{value:.2f} s"


def spread(values):
    """Median and least; runs that do not get there count as never."""
    there = [v for v in values if v is not None]
    if not there:
        return "–"
    middle = statistics.median([float("inf") if v is None else v for v in values])
    return f"{seconds(middle) if middle < float('inf') else '–'} ({seconds(min(there))})"


def middle_time(runs, db):
    times = [first(r["points"], db) for r in runs]
    return None if None in times else statistics.median(times)


def summary(runs):
    """Of a toolbox: the best quality of its runs, the least time to it, with and without compiling."""
    best = max(p[2] for r in runs for p in r["points"])
    times = [(t, r["compile_seconds"]) for r in runs if (t := first(r["points"], best - SLACK_DB)) is not None]
    at = min(times)
    return {"best": best, "seconds": at[0], "without": min(t - c for t, c in times)}


def describe(bench, session, figure):
    options = bench.options
    ours = {p: session.get(f"ours {p}", []) for p in PRIORS}
    boxes = {m: session[m] for m in TOOLBOXES if session.get(m)}
    taken = [r["busy"] for runs in ours.values() for r in runs if r.get("busy") is not None]
    standard = ours["tv+0.5*tdiff+support"]
    rows = []
    for prior, runs in ours.items():
        if runs:
            rows.append([
                f"`{prior}`", str(len(runs)), *(spread([first(r["points"], db) for r in runs]) for db in GOALS),
                f"{statistics.median(r['psnr_db'] for r in runs):.1f} dB, {spread([r['end_seconds'] for r in runs])}",
                spread([r["whole_seconds"] for r in runs])])
    text = [
        "## Time to quality",
        f"Made by `{options.command}` with {bench.version} ({commit()}), {datetime.date.today()}, {machine()}. "
        f"Do not edit: run the command again.",
        "The problem is `problems/digits12`: 108×108 pixels, 54 bins, SNR 256. All times are of one session. "
        + (f"Before our runs other programs took {statistics.median(taken):.0%} of the processors (median; {max(taken):.0%} at most)." if taken else "")
        + (" **The machine was busy: on a quiet one all are faster.**" if taken and statistics.median(taken) > 0.1 else ""),
        "Rowburst, from the start of the process, reading the files and set-up included; median and, in brackets, minimum. "
        "The last column is until the process ends, with video, report and figures written.",
        table(["prior", "runs", *(f"to {db:g} dB" for db in GOALS), "at the end", "files written"], rows),
    ]
    if boxes:
        climbed = ("λ and step were tuned in an earlier run." if options.no_climb else
                   f"λ and step give the highest PSNR on a grid of steps of 3, {options.tuning_seconds:g} s each.")
        found = {m: summary(runs) for m, runs in boxes.items()}
        rows = []
        for m, s in sorted(found.items(), key=lambda f: -f[1]["best"]):
            mine, least = middle_time(standard, s["best"]), min((t for r in standard if (t := first(r["points"], s["best"])) is not None), default=None)
            rows.append([
                TOOLBOXES[m][0], f"{s['best']:.1f} dB", seconds(s["seconds"]), seconds(s["without"]),
                str(max(r["iterations"] for r in boxes[m])), ", ".join(f"{k} {v:.2g}" for k, v in boxes[m][0]["settings"].items()),
                f"{seconds(mine)} ({seconds(least)})", "–" if mine is None else f"{s['without'] / mine:.0f}",
                "–" if mine is None else f"{s['seconds'] / mine:.0f}"])
        top = max(found, key=lambda m: found[m]["best"])
        mine = middle_time(standard, found[top]["best"])
        verdict = "" if mine is None else (
            f"The best of them, {TOOLBOXES[top][0]}, reaches {found[top]['best']:.1f} dB in {options.seconds:g} s; "
            f"Rowburst reaches that after {seconds(mine)} (median), **{found[top]['without'] / mine:.0f} times sooner** "
            f"(target: 100).")
        to_44 = middle_time(standard, 44.0)
        verdict += "" if to_44 is None else f" 44 dB take {seconds(to_44)} (target: 0.5 s)."
        text += [
            f"Toolboxes, {options.seconds:g} s each, from their first iteration; imports, the operator and its norm are not "
            f"counted: the highest PSNR that they reach with v ≥ 0, and the time to {SLACK_DB} dB below it, with and without JAX's "
            f"compilation. Isotropic TV in each bin. {climbed} "
            f"Then Rowburst's time to the same PSNR from the start of the process (median, and minimum in brackets), and the ratio of the toolbox's time to it, without and with compilation.",
            table(["toolbox", "best", "after", "without compiling", "iterations", "settings", "Rowburst", "ratio", "with compiling"], rows),
            verdict,
            "deepinv is omitted: it needs PyTorch, which PyPI has for Linux on x86-64 only with CUDA.",
        ]
    if figure:
        text.append(f"![PSNR against time since the start, logarithmic]({figure.name})")
    return "\n\n".join(t for t in text if t) + "\n"


def draw(session, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(9, 5.2), dpi=110)
    colours = ["#0b5fa5", "#d9822b", "#3a8f5c", "#b0413e", "#7b5ea7", "#6b6b6b"]
    ends = []
    for prior, style in zip(PRIORS, [dict(color="black", lw=2.4), dict(color="black", lw=1.4, ls="--")]):
        for i, run in enumerate(sorted(session.get(f"ours {prior}", []), key=lambda r: r["end_seconds"])[:1]):
            axes.plot([p[0] for p in run["points"]], [p[2] for p in run["points"]], **style)
            ends.append((run["points"][-1], PRIORS[prior].replace("`", ""), "black"))
    for method, colour in zip(TOOLBOXES, colours):
        if session.get(method):
            run = max(session[method], key=lambda r: max(p[2] for p in r["points"]))
            times = [(p[0] - run["compile_seconds"], p[2]) for p in run["points"]]
            times = [t for t in times if t[0] > 0.03]
            axes.plot(*zip(*times), color=colour, lw=1.4)
            ends.append(((times[-1][0], 0, times[-1][1]), TOOLBOXES[method][0], colour))
    for db in GOALS:
        axes.axhline(db, color="#bbbbbb", lw=0.8, zorder=0)
        axes.text(0.031, db + 0.2, f"{db:g} dB", color="#777777", fontsize=8)
    # Labels at the ends of the curves, pushed apart.
    low = -1e9
    for (x, _, y), name, colour in sorted(ends, key=lambda e: e[0][2]):
        low = max(y, low + 0.95)
        axes.annotate(name, (x, y), (x * 1.12 if x < 60 else 135, low), color=colour, fontsize=8, va="center",
                      arrowprops=dict(arrowstyle="-", color=colour, lw=0.5) if low - y > 0.3 else None)
    axes.set(xscale="log", xlim=(0.03, 1500), xlabel="seconds", ylabel="PSNR (dB)")
    axes.set_xticks([0.03, 0.1, 0.3, 1, 3, 10, 30, 120], ["0.03", "0.1", "0.3", "1", "3", "10", "30", "120"])
    axes.minorticks_off()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def write(options, bench, session):
    figure = options.output.with_name("time-to-quality.png")
    draw(session, figure)
    body = f"{MARKS[0]}\n{describe(bench, session, figure)}{MARKS[1]}\n"
    page = options.output.read_text() if options.output.exists() else "# Speed\n\n" + "\n".join(MARKS) + "\n"
    if MARKS[0] not in page:
        page += "\n" + "\n".join(MARKS) + "\n"
    before, rest = page.split(MARKS[0], 1)
    options.output.write_text(before + body + rest.split(MARKS[1], 1)[1].lstrip("\n"))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/rowburst")
    parser.add_argument("--cache", type=Path, default=ROOT / "target/time-to-quality", help="folder of finished runs")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared", help="folder of the reference problems")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs/speed.md")
    parser.add_argument("--seconds", type=float, default=120, help="of a toolbox's run")
    parser.add_argument("--tuning-seconds", type=float, default=40, help="of a run that looks for settings")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--only", help="toolboxes, with commas between: " + ", ".join(TOOLBOXES))
    parser.add_argument("--quick", action="store_true", help="one round, 30 s each, no climb")
    parser.add_argument("--no-climb", action="store_true", help="the settings where the climb starts")
    parser.add_argument("--fresh", action="store_true", help="make the timed runs again")
    parser.add_argument("--report", action="store_true", help="write the page from the runs that are kept")
    options = parser.parse_args()
    # Writing the page again is not what made the runs.
    options.command = command_line("time_to_quality.py").replace(" --report", "").replace(" --fresh", "")
    if options.quick:
        options.seconds, options.rounds, options.no_climb = 30.0, 1, True
    chosen = options.only.split(",") if options.only else list(TOOLBOXES)
    unknown = [m for m in chosen if m not in TOOLBOXES]
    if unknown:
        parser.error(f"no toolbox {', '.join(unknown)}; there are {', '.join(TOOLBOXES)}")
    if not options.program.exists():
        parser.error(f"{options.program} is not there: run cargo build --release, or give --program")
    if not (options.shared / "problems/digits12").exists():
        say(f"skipped: {options.shared / 'problems/digits12'} is not here")
        return 0
    options.cache = options.cache.resolve()
    options.cache.mkdir(parents=True, exist_ok=True)
    with_packages(options.cache, __file__, ["numpy", "scipy", "matplotlib", "scico", "pylops", "pyproximal"])

    bench = Bench(options)
    if options.fresh:
        bench.session.unlink(missing_ok=True)
    session = kept(bench.session)
    if options.report:
        if not session:
            parser.error(f"{bench.session} is not there: no run of this program is kept")
        write(options, bench, session)
        return 0
    exponents = {}
    for method in chosen:
        exponents[method] = TOOLBOXES[method][2] if options.no_climb else tuned(bench, method)

    def ours(stage):
        for prior, runs in RUNS.items():
            done = session.setdefault(f"ours {prior}", [])
            for i in range(runs):
                if all(r["stage"] != [*stage, i] for r in done):
                    done.append(bench.ours(prior) | {"stage": [*stage, i]})
                    keep(bench.session, session)
                    say(f"  {prior}: 44 dB after {seconds(first(done[-1]['points'], 44.0))}")

    for turn in range(options.rounds):
        for method in chosen:
            ours([turn, method])
            done = session.setdefault(method, [])
            if len(done) <= turn:
                done.append(bench.toolbox(method, settings_of(method, exponents[method]), options.seconds))
                keep(bench.session, session)
                say(f"  {method}: {max(p[2] for p in done[-1]['points']):.2f} dB, {done[-1]['iterations']} iterations")
    ours(["after", ""])
    write(options, bench, session)
    say(f"written: {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
