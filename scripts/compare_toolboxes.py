#!/usr/bin/env python3
"""Minimises one small objective with Rowburst and with PyProximal, and compares.

    cargo build --release
    python3 -m venv /tmp/toolboxes
    /tmp/toolboxes/bin/pip install numpy pylops pyproximal
    /tmp/toolboxes/bin/python scripts/compare_toolboxes.py target/release/rowburst

`rowburst simulate` makes the problem. A is built from its files as a matrix for each bin, by the
conventions of the README alone, in double precision, and the objective

    F(v) = 1/2 |b - A v|^2 + tau R(v),  v >= 0

of every video is computed by this script, at the same tau: of `rowburst reconstruct`, and of
PyProximal's primal-dual algorithm. Prints objectives, their relative difference and the time;
exit status 1 if one with total variation differs by more than 1e-4 or Rowburst misses A.
Not part of scripts/test.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pylops
import pyproximal

ROWS, COLUMNS = 24, 20
BINS = ROWS // 2
SHAPE = (BINS, ROWS, COLUMNS)
EXPERIMENT = f"""[camera]
rows = {ROWS}
columns = {COLUMNS}
shutter = "dual-inside-out"
row_time_us = 10.0
exposure_us = 10.0
"""
# A part of max(A^T b), above which the l1 minimum is dark.
TAU = 0.01
# tv, tdiff, l1
PRIORS = {"tv+0.5*tdiff": (1.0, 0.5, 0.0), "tv+0.5*tdiff+0.3*l1": (1.0, 0.5, 0.3), "l1": (0, 0, 1.0)}
AGREE = 1e-4


class Bins(pylops.LinearOperator):
    """A: the rows of instant j, from bin j alone."""

    def __init__(self, psf):
        half = ROWS // 2
        self.rows = [(half - 1 - j, half + j) for j in range(BINS)]
        centre = (psf.shape[0] // 2, psf.shape[1] // 2)
        y, x = np.mgrid[:ROWS, :COLUMNS]

        def value(r, c):
            i, j = centre[0] + r - y, centre[1] + c - x
            inside = (i >= 0) & (i < psf.shape[0]) & (j >= 0) & (j < psf.shape[1])
            return np.where(inside, psf[i.clip(0, psf.shape[0] - 1), j.clip(0, psf.shape[1] - 1)], 0.0)

        self.blocks = np.array(
            [[value(r, c).ravel() for r in rows for c in range(COLUMNS)] for rows in self.rows]
        )
        super().__init__(dtype="float64", shape=(ROWS * COLUMNS, BINS * ROWS * COLUMNS))

    def _matvec(self, v):
        seen = np.einsum("jmn,jn->jm", self.blocks, v.reshape(BINS, -1))
        frame = np.empty((ROWS, COLUMNS))
        for j, rows in enumerate(self.rows):
            frame[list(rows)] = seen[j].reshape(2, COLUMNS)
        return frame.ravel()

    def _rmatvec(self, b):
        frame = b.reshape(ROWS, COLUMNS)
        seen = np.array([frame[list(rows)].ravel() for rows in self.rows])
        return np.einsum("jmn,jm->jn", self.blocks, seen).ravel()

    def norm(self):
        return max(np.linalg.norm(block, 2) for block in self.blocks)


def prior(v, weights):
    v = v.reshape(SHAPE)
    dy = np.diff(v, axis=1, append=v[:, -1:])
    dx = np.diff(v, axis=2, append=v[:, :, -1:])
    space, time_weight, l1 = weights
    return space * np.hypot(dy, dx).sum() + time_weight * np.abs(np.diff(v, axis=0)).sum() + l1 * np.abs(v).sum()


def pyproximal_minimum(operator, b, tau, weights, iterations):
    """Every part as one block of a stack, scaled to norm 1, so that the one dual step fits all."""
    norm, voxels = operator.norm(), int(np.prod(SHAPE))
    space, time_weight, l1 = weights
    parts = [((1 / norm) * operator, pyproximal.L2(b=b / norm, sigma=norm**2), b.size)]
    difference = lambda axis: pylops.FirstDerivative(SHAPE, axis=axis, kind="forward", dtype="float64")
    if space:
        c = 8**0.5
        gradient = pylops.VStack([difference(1), difference(2)])
        parts.append(((1 / c) * gradient, pyproximal.L21(ndim=2, sigma=tau * space * c), 2 * voxels))
    if time_weight:
        parts.append(((1 / 2) * difference(0), pyproximal.L1(sigma=tau * time_weight * 2), voxels))
    if l1:
        parts.append((pylops.Identity(voxels), pyproximal.L1(sigma=tau * l1), voxels))
    dual_step = (0.06 if space else 0.005) * norm**2
    return pyproximal.optimization.primaldual.PrimalDual(
        pyproximal.Box(lower=0.0),
        pyproximal.VStack([g for _, g, _ in parts], nn=[n for _, _, n in parts]),
        pylops.VStack([k for k, _, _ in parts]),
        x0=np.zeros(voxels),
        tau=0.99 / (len(parts) * dual_step),
        mu=dual_step,
        niter=iterations,
    )


def main():
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("rowburst", type=Path, help="the program")
    arguments.add_argument("--iterations", type=int, default=10_000, help="of PyProximal")
    arguments.add_argument("--max-iterations", type=int, default=5_000, help="of Rowburst")
    options = arguments.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "experiment.toml").write_text(EXPERIMENT)

        def rowburst(*words):
            subprocess.run([options.rowburst, *map(str, words)], check=True, capture_output=True)

        rowburst("simulate", folder / "experiment.toml", "--scene", "digits", "--digit-px", 8,
                 "--snr", 64, "--diffuser-deg", 0.3, "-o", folder / "problem")
        load = lambda name: np.load(folder / "problem" / name).astype(np.float64)
        psf, frame, truth = load("psf.npy"), load("frame.npy"), load("truth.npy")
        operator, b = Bins(psf / psf.sum()), frame.ravel()
        noise = np.linalg.norm(operator.matvec(truth.ravel()) - b) / np.linalg.norm(b)
        print(f"video {SHAPE}, |A truth - b| / |b| = {noise:.4f} (SNR 64: 0.0156)")
        failed |= not 0.012 < noise < 0.02
        tau = TAU * operator.rmatvec(b).max()
        for name, weights in PRIORS.items():
            out = folder / name
            objective = lambda v: 0.5 * np.sum((operator.matvec(v) - b) ** 2) + tau * prior(v, weights)
            rowburst("reconstruct", folder / "problem/experiment.toml", "--frame", folder / "problem/frame.npy",
                     "--prior", name, "--tau", tau, "--max-iterations", options.max_iterations, "-o", out)
            result = json.loads((out / "result.json").read_text())
            ours = np.load(out / "video.npy").astype(np.float64).ravel()
            began = time.perf_counter()
            theirs = pyproximal_minimum(operator, b, tau, weights, options.iterations)
            seconds = time.perf_counter() - began
            mine, its = objective(ours), objective(np.maximum(theirs, 0))
            difference = (mine - its) / its
            agree = abs(difference) <= AGREE
            failed |= not agree and weights[0] > 0
            print(f"{name}, tau {tau:.4g}\n"
                  f"  rowburst    {mine:.8g}  {result['iterations']} iterations, {result['seconds']:.2f} s, {result['stop_reason']}\n"
                  f"  pyproximal  {its:.8g}  {options.iterations} iterations, {seconds:.2f} s\n"
                  f"  relative difference {difference:+.1e}" + ("" if agree else f", more than {AGREE:g}"))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
