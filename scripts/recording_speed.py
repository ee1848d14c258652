#!/usr/bin/env python3
"""What all cores and Dask make of a recording, beside one core: seconds a frame, in turns.

    PYTHONPATH=… python3 scripts/recording_speed.py target/release/rowburst [--frames 100] [--rounds 1]

A recording of the demo's digits (108×108×54, eight scenes in turn) is reconstructed with the standard prior by
`rowburst batch` on one thread and on two, and by two Dask workers of one thread each on this machine; the
workers run already, and set themselves up for the recording within the time. Prints JSON.
"""

import argparse
import json
import os
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import distributed
import numpy as np
import rowburst as rb
import rowburst.dask

PRIOR = "tv+0.5*tdiff+support"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--only", choices=["one", "all", "dask"], nargs="+", default=["one", "all", "dask"])
    args = parser.parse_args()
    camera = rb.Camera(rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    scenes = [rb.simulate(camera, "digits", seed=seed) for seed in range(1, 9)]
    folder = Path(tempfile.mkdtemp(prefix="rowburst-recording-"))
    # One PSF, as in a laboratory: every scene is seen through that of the first.
    psf = scenes[0].psf.array
    scenes = [rb.simulate(camera, scene.truth, psf=psf, seed=seed) for seed, scene in enumerate(scenes, 1)]
    np.save(folder / "frames.npy", np.stack([scenes[i % len(scenes)].frame for i in range(args.frames)]))
    np.save(folder / "psf.npy", psf)
    (folder / "experiment.toml").write_text(camera.to_toml())
    seconds = {name: [] for name in args.only}
    paths_by_name = {"frames": folder / "frames.npy", "experiment": folder / "experiment.toml"}

    # Dask changes this process's environment for its workers.
    environment = os.environ.copy()

    def batch(threads, out):
        subprocess.run(
            [args.program, "batch", paths_by_name["experiment"], "--frames", paths_by_name["frames"], "--psf", folder / "psf.npy",
             "--prior", PRIOR, "--threads", str(threads), "-o", out], check=True, capture_output=True,
            env=environment)

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with distributed.Client(cluster) as client:
            for i in range(args.rounds):
                for name, took in seconds.items():
                    out = folder / f"{name}-{i}.zarr"
                    began = time.perf_counter()
                    if name == "dask":
                        rowburst.dask.reconstruct(
                            paths_by_name["frames"], out, paths_by_name["experiment"], client, psf=folder / "psf.npy", prior=PRIOR)
                    else:
                        batch(1 if name == "one" else 2, out)
                    took.append((time.perf_counter() - began) / args.frames)
    found = {f"{name}_s_per_frame": statistics.median(took) for name, took in seconds.items()}
    if {"one", "all"} <= seconds.keys():
        found["all_cores_percent_of_twice_one"] = 50 * found["one_s_per_frame"] / found["all_s_per_frame"]
    if {"dask", "all"} <= seconds.keys():
        found["dask_slower_than_batch_percent"] = 100 * (found["dask_s_per_frame"] / found["all_s_per_frame"] - 1)
    print(json.dumps({"frames": args.frames, "rounds": args.rounds} | found, indent=2))


if __name__ == "__main__":
    main()
