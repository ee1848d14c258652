#!/usr/bin/env python3
"""What a reconstruction from Python costs beside the same one by the command line, alternately.

    PYTHONPATH=… python3 scripts/python_overhead.py target/release/rowburst [--runs 10]

Both solve the same frame (the demo's digits by default) with the standard prior, and both give set-up and
solver time themselves; the rest of the Python call (arrays in and out, callbacks, signals) is what the call
takes beyond that. Prints medians as JSON.
"""

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import rowburst as rb


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--prior", default="tv+0.5*tdiff+support")
    args = parser.parse_args()
    camera = rb.Camera(rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    capture = rb.simulate(camera, "digits", seed=1)
    folder = Path(tempfile.mkdtemp(prefix="rowburst-overhead-"))
    np.save(folder / "frame.npy", capture.frame)
    np.save(folder / "psf.npy", capture.psf.array)
    psf = np.load(folder / "psf.npy")
    (folder / "experiment.toml").write_text(camera.to_toml())
    theirs, ours, rest = [], [], []
    for _ in range(args.runs):
        done = subprocess.run(
            [args.program, "reconstruct", folder / "experiment.toml", "--frame", folder / "frame.npy", "--psf",
             folder / "psf.npy", "--prior", args.prior, "--json", "-o", folder / "out"],
            check=True, capture_output=True)
        numbers = json.loads(done.stdout)
        theirs.append(numbers["setup_seconds"] + numbers["seconds"])
        began = time.perf_counter()
        result = rb.reconstruct(capture.frame, camera, psf, prior=args.prior, progress=lambda p: None)
        video = result.video
        whole = time.perf_counter() - began
        ours.append(result.setup_seconds + result.seconds)
        rest.append(whole - ours[-1])
    assert (video == np.load(folder / "out" / "video.npy")).all(), "the bits differ"
    median = statistics.median
    print(json.dumps({
        "command_line_s": median(theirs),
        "python_s": median(ours),
        "outside_solver_s": median(rest),
        "outside_solver_percent": 100 * median(rest) / median(theirs),
        "python_over_command_line_percent": 100 * ((median(ours) + median(rest)) / median(theirs) - 1),
        "fastest_percent": 100 * ((min(ours) + min(rest)) / min(theirs) - 1),
        "bits": "equal",
    }, indent=2))


if __name__ == "__main__":
    main()
