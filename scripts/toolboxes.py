#!/usr/bin/env python3
"""One reconstruction by a general toolbox, for time_to_quality.py, which runs this once for each.

    python3 scripts/toolboxes.py METHOD FOLDER --seconds 120 --settings '{"lambda": 1e-8}'

All minimise 1/2 |b - A v|^2 + lambda TV(v) with isotropic total variation in each bin, where the method
can with v >= 0. A is given in the form that Rowburst itself uses: transforms along x of all rows at once,
and sums over y for the rows that are read, in float32 on all cores; in jax.numpy for SCICO, in numpy and
scipy.fft for PyProximal. The camera is that of quality_table.py. Prints, as JSON, points of (seconds, iterations,
PSNR of max(v, 0)) until the time is over. The clock starts with the first iteration, with imports, A and its norm
ready, and stands while v is compared with the truth. What JAX needs to compile is in it: `compile_seconds`, the
first iterations' time beyond that of later ones.
"""

import argparse
import json
import os
import statistics
import sys
import time
import warnings
from pathlib import Path

import numpy as np

from quality_table import BINS, COLUMNS, DATA_STEP, DIFFERENCE_NORM, ROWS, Bins

SHAPE = (BINS, ROWS, COLUMNS)
# Points at least this much later than the one before.
NEXT_POINT = 1.03
# PyProximal makes arrays of this length.
MOST_ITERATIONS = 100_000


class TimeIsOver(Exception):
    pass


class Watch:
    """Sees every iteration; compares with the truth now and then, on its own time."""

    def __init__(self, truth, seconds):
        self.truth, self.limit = truth.ravel().astype(np.float64), seconds
        self.peak = float(truth.max())
        self.points, self.laps = [], []
        self.iterations, self.aside = 0, 0.0
        self.start = self.last = time.perf_counter()

    def __call__(self, video):
        """`video`: an array, or a function that gives it."""
        now = time.perf_counter()
        seconds = now - self.start - self.aside
        self.laps.append(now - self.last)
        self.iterations += 1
        over = seconds >= self.limit
        if over or not self.points or seconds >= self.points[-1][0] * NEXT_POINT:
            video = video() if callable(video) else video
            error = np.maximum(np.asarray(video, np.float64).ravel(), 0) - self.truth
            mean = float(error @ error) / error.size
            self.points.append((seconds, self.iterations, 10 * float(np.log10(self.peak**2 / mean))))
        self.last = time.perf_counter()
        self.aside += self.last - now
        if over:
            raise TimeIsOver

    def compile_seconds(self):
        """The first three iterations' time beyond that of three others."""
        return max(0.0, sum(self.laps[:3]) - 3 * statistics.median(self.laps[3:])) if len(self.laps) > 6 else 0.0


# ---------------------------------------------------------------- SCICO


class Scico:
    """A, b and the differences as SCICO's own objects."""

    def __init__(self, bins, frame):
        import jax.numpy as jnp
        import scico.numpy as snp
        from scico import linop

        kernels, n = jnp.asarray(bins.kernels), bins.n

        def forward(v):
            seen = jnp.einsum("jkyf,jyf->jkf", kernels, jnp.fft.rfft(v, n))
            return jnp.fft.irfft(seen, n)[..., :COLUMNS]

        def adjoint(b):
            spectra = jnp.einsum("jkyf,jkf->jyf", kernels.conj(), jnp.fft.rfft(b, n))
            return jnp.fft.irfft(spectra, n)[..., :COLUMNS]

        def operator(scale):
            return linop.LinearOperator(
                input_shape=SHAPE, output_shape=(BINS, 2, COLUMNS), input_dtype=np.float32, output_dtype=np.float32,
                eval_fn=lambda v: scale * forward(v), adj_fn=lambda b: scale * adjoint(b))

        self.operator = operator
        self.b = snp.array(frame[bins.rows])
        self.x0 = snp.zeros(SHAPE, dtype=np.float32)
        self.norm = bins.norm()

    def differences(self):
        from scico import linop

        return linop.FiniteDifference(SHAPE, input_dtype=np.float32, axes=(1, 2), append=0)

    def run(self, solver, watch, shown=lambda solver: solver.minimizer()):
        watch.start = watch.last = time.perf_counter()
        while True:
            solver.step()
            video = shown(solver).block_until_ready()
            watch(lambda: np.asarray(video))


def scico_apgm(bins, frame, watch, settings):
    from scico import functional, loss
    from scico.optimize import AcceleratedPGM

    s = Scico(bins, frame)
    tv = functional.IsotropicTVNorm(axes=(1, 2), input_shape=SHAPE, input_dtype=np.float32)
    s.run(AcceleratedPGM(
        f=loss.SquaredL2Loss(y=s.b, A=s.operator(1.0)), g=settings["lambda"] * tv,
        L0=settings["step"] * s.norm**2, x0=s.x0), watch)


def scico_pdhg(bins, frame, watch, settings):
    """Parts of the stack are scaled, so that the one dual step fits all, as for PyProximal."""
    from scico import functional, linop, loss
    from scico.optimize import PDHG

    s = Scico(bins, frame)
    c = 8**0.5 / DIFFERENCE_NORM
    sigma = settings["step"] * s.norm**2
    s.run(PDHG(
        f=functional.NonNegativeIndicator(),
        g=functional.SeparableFunctional([
            loss.SquaredL2Loss(y=s.b / s.norm, scale=0.5 * s.norm**2),
            settings["lambda"] * c * functional.L21Norm()]),
        C=linop.VerticalStack([s.operator(1 / s.norm), (1 / c) * s.differences()]),
        tau=0.99 / ((1 + DIFFERENCE_NORM**2) * sigma), sigma=sigma, x0=s.x0), watch)


def scico_admm(bins, frame, watch, settings):
    from scico import functional, linop, loss
    from scico.optimize.admm import ADMM, LinearSubproblemSolver

    s = Scico(bins, frame)
    rho = settings["step"] * s.norm**2
    # The part that is not negative.
    s.run(ADMM(
        f=loss.SquaredL2Loss(y=s.b, A=s.operator(1.0)),
        g_list=[settings["lambda"] * functional.L21Norm(), functional.NonNegativeIndicator()],
        C_list=[s.differences(), linop.Identity(SHAPE, input_dtype=np.float32)], rho_list=[rho, rho], x0=s.x0,
        subproblem_solver=LinearSubproblemSolver(cg_kwargs={"tol": 1e-4, "maxiter": settings["cg"]}, cg_function="scico")),
        watch, lambda solver: solver.z_list[1])


def scico_proximal_admm(bins, frame, watch, settings):
    """The split of `scico_pdhg`: C x = z, with no equations to solve."""
    from scico import functional, linop, loss
    from scico.optimize import ProximalADMM

    s = Scico(bins, frame)
    c = 8**0.5 / DIFFERENCE_NORM
    s.run(ProximalADMM(
        f=functional.NonNegativeIndicator(),
        g=functional.SeparableFunctional([
            loss.SquaredL2Loss(y=s.b / s.norm, scale=0.5 * s.norm**2),
            settings["lambda"] * c * functional.L21Norm()]),
        A=linop.VerticalStack([s.operator(1 / s.norm), (1 / c) * s.differences()]), B=None,
        rho=settings["step"] * s.norm**2, mu=1.01 * (1 + DIFFERENCE_NORM**2), nu=1.0, x0=s.x0), watch)


# ---------------------------------------------------------------- PyProximal


def pyproximal_primal_dual(bins, frame, watch, settings):
    """As `quality_table.pyproximal_run`, with its steps to choose."""
    import pylops
    import pyproximal

    norm, b, voxels = bins.norm(), frame.ravel(), int(np.prod(SHAPE))
    data = pylops.FunctionOperator(
        lambda v: bins.forward(v) / norm, lambda f: bins.adjoint(f) / norm, b.size, voxels, dtype="float32")
    c = 8**0.5 / DIFFERENCE_NORM
    differences = [pylops.FirstDerivative(SHAPE, axis=a, kind="forward", dtype="float32") for a in (1, 2)]
    step = settings["step"] * norm**2
    watch.start = watch.last = time.perf_counter()
    pyproximal.optimization.primaldual.PrimalDual(
        pyproximal.Box(lower=0.0),
        pyproximal.VStack(
            [pyproximal.L2(b=b / norm, sigma=norm**2), pyproximal.L21(ndim=2, sigma=settings["lambda"] * c)],
            nn=[b.size, 2 * voxels]),
        pylops.VStack([data, (1 / c) * pylops.VStack(differences)]),
        x0=np.zeros(voxels, np.float32), tau=0.99 / ((1 + DIFFERENCE_NORM**2) * step), mu=step,
        niter=MOST_ITERATIONS, callback=watch)


def pyproximal_apg(bins, frame, watch, settings):
    """Its TV is isotropic over all axes that it is given: bins stand below each other in one tall picture, whose
    seams lie in the dark."""
    import pylops
    import pyproximal

    norm, b, voxels = bins.norm(), frame.ravel(), int(np.prod(SHAPE))
    data = pylops.FunctionOperator(bins.forward, bins.adjoint, b.size, voxels, dtype="float32")
    watch.start = watch.last = time.perf_counter()
    pyproximal.optimization.primal.ProximalGradient(
        Residual(data, b), pyproximal.TV(dims=(BINS * ROWS, COLUMNS), sigma=settings["lambda"], niter=settings["inner"]),
        x0=np.zeros(voxels, np.float32), tau=settings["step"] / norm**2, niter=MOST_ITERATIONS, acceleration="fista",
        callback=watch)


def Residual(data, b):
    """1/2 |A v - b|^2, of which the method asks the gradient alone: PyProximal's own L2 makes it from A^T A v and A^T b."""
    import pyproximal

    class Half(pyproximal.ProxOperator):
        def __init__(self):
            super().__init__(None, True)

        def __call__(self, x):
            r = data.matvec(x) - b
            return 0.5 * float(r @ r)

        def grad(self, x):
            return data.rmatvec(data.matvec(x) - b)

    return Half()


METHODS = {
    "scico-apgm": scico_apgm,
    "scico-pdhg": scico_pdhg,
    "scico-admm": scico_admm,
    "scico-proximal-admm": scico_proximal_admm,
    "pyproximal-primal-dual": pyproximal_primal_dual,
    "pyproximal-apg": pyproximal_apg,
}


def main():
    began = time.perf_counter()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("folder", type=Path, help="of psf.npy, frame.npy and truth.npy")
    parser.add_argument("--seconds", type=float, default=120)
    parser.add_argument("--settings", type=json.loads, default={})
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    settings = {"lambda": 1e-8, "step": DATA_STEP} | options.settings
    frame, psf, truth = (np.load(options.folder / f"{n}.npy").astype(np.float32) for n in ("frame", "psf", "truth"))
    if truth.shape != SHAPE:
        sys.exit(f"{options.folder / 'truth.npy'}: {truth.shape}, but this camera gives {SHAPE}")
    bins = Bins(psf / psf.sum(dtype=np.float64))
    left = np.linalg.norm(bins.forward(truth) - frame.ravel()) / np.linalg.norm(frame)
    if left > 0.05:
        sys.exit(f"{options.folder}: A built from the files does not explain the frame ({left:.2f} of it is left)")
    watch = Watch(truth, options.seconds)
    try:
        METHODS[options.method](bins, frame, watch, settings)
    except TimeIsOver:
        pass
    compiled = options.method.startswith("scico")
    json.dump({
        "method": options.method, "settings": settings, "points": watch.points, "iterations": watch.iterations,
        "compile_seconds": watch.compile_seconds() if compiled else 0.0,
        "ready_seconds": watch.start - began, "load": os.getloadavg()[0],
    }, sys.stdout)


if __name__ == "__main__":
    main()
