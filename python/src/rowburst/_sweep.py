"""``sweep``: one frame with several priors and weights, and a table that compares them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import product
from os import PathLike
from pathlib import Path
from typing import Any, overload

from numpy.typing import ArrayLike

from . import _rowburst
from ._checks import checked_array, shown
from ._errors import input_error
from ._reconstruct import Result, _callback, _constants, _settings
from ._rowburst import Camera, Experiment, InputError, Progress, Psf, WorkError


class Sweep(Sequence[Result | None]):
    """The results of a sweep, in the order of its points. :func:`sweep` makes it."""

    def __init__(self, results: Sequence[Result | None], table: Sequence[dict[str, Any]]) -> None:
        self.results = list(results)
        """The result of each point; None where it failed."""
        self.table = list(table)
        """A dict for each point: ``point``, ``prior``, ``tau``, ``residual_over_sigma``, ``psnr_db``, ``ssim``, ``fit``,
        ``seconds``, ``error``; None where a value does not apply."""

    def save(self, folder: str | PathLike[str]) -> Path:
        """Writes ``sweep.csv``, and the folder of each result, as ``rowburst reconstruct --sweep`` does.

        Parameters
        ----------
        folder : path
            The folder, which is made where it is missing.

        Returns
        -------
        pathlib.Path
            The folder.

        Raises
        ------
        WorkError
            A file cannot be written.

        Examples
        --------
        >>> folder = rb.sweep(frame, camera, psf, prior=["tv"], tau=[0.1, 1.0], max_iterations=[5]).save("sweep")
        >>> sorted(path.name for path in folder.iterdir() if path.name.startswith("prior"))
        ['prior=tv_tau=0.1_max-iterations=5', 'prior=tv_tau=1.0_max-iterations=5']
        """
        rows = []
        for result, row in zip(self.results, self.table, strict=True):
            output = Path(_rowburst._sweep_path(folder, row["point"]))
            if result is not None:
                result.save(output)
            rows.append(row | {"output": str(output)})
        _rowburst._save_sweep(folder, rows)
        return Path(folder)

    @overload
    def __getitem__(self, index: int) -> Result | None: ...
    @overload
    def __getitem__(self, index: slice) -> list[Result | None]: ...
    def __getitem__(self, index: int | slice) -> Result | None | list[Result | None]:
        return self.results[index]

    def __len__(self) -> int:
        return len(self.results)

    def __iter__(self) -> Iterator[Result | None]:
        return iter(self.results)

    def _lines(self) -> list[str]:
        return _rowburst._sweep_lines([row | {"output": ""} for row in self.table])

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def __repr__(self) -> str:
        failed = sum(result is None for result in self.results)
        return f"<rowburst.Sweep of {len(self.results)} points" + (f", {failed} failed>" if failed else ">")

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


def sweep(
    frame: ArrayLike | PathLike[str],
    camera: Camera | Experiment,
    psf: Psf | ArrayLike | PathLike[str] | None = None,
    *,
    prior: str | Iterable[str] | None = None,
    tau: str | float | Iterable[str | float] | None = None,
    noise_sigma: float | Iterable[float] | None = None,
    max_iterations: int | Iterable[int] | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    truth: ArrayLike | PathLike[str] | None = None,
    progress: Callable[[Progress], object] | bool | None = None,
    self_calibrate: str = "auto",
    keep_all_pixels: bool = False,
    threads: int | None = None,
    tuning: Mapping[str, float] | None = None,
    corrected: bool = False,
) -> Sweep:
    """Reconstructs a frame once for each combination of values, with the videos of ``rowburst reconstruct --sweep``.

    Operator and Gram blocks are set up once, for all.

    Parameters
    ----------
    frame : array or path
        The frame ``[y, x]``.
    camera : Camera or Experiment
        The camera, or an experiment, which gives each of the arguments that is left out.
    prior, tau, noise_sigma, max_iterations
        Those of :func:`reconstruct`. A sequence is swept, the last argument fastest; a single value is that of all points.
    psf, dark, flat, bad_pixels, truth, progress, self_calibrate, keep_all_pixels, threads, tuning, corrected
        Those of :func:`reconstruct`.

    Returns
    -------
    Sweep
        The results, and a table. A point that fails has the result None, and its error in the table.

    Raises
    ------
    InputError
        An argument breaks a rule, or nothing is swept. All values are checked before the first run.
    WorkError
        All points failed.

    Examples
    --------
    >>> found = rb.sweep(frame, camera, psf, prior=["tv", "l1"], tau=[0.1, "auto"], max_iterations=5)
    >>> [row["point"] for row in found.table]
    ['prior=tv tau=0.1', 'prior=tv tau=auto', 'prior=l1 tau=0.1', 'prior=l1 tau=auto']
    >>> found[0].prior
    'tv'
    """
    given: dict[str, Any] = {"prior": prior, "tau": tau, "noise_sigma": noise_sigma, "max_iterations": max_iterations}
    swept: dict[str, list[Any]] = {name: list(value) for name, value in given.items() if _is_list(value)}
    fixed = {name: None if name in swept else value for name, value in given.items()}
    points: list[dict[str, Any]] = [dict(zip(swept, values, strict=True)) for values in product(*swept.values())]
    if not swept or not points:
        rule = "a sweep has at least one sequence with a value in it"
        raise input_error("prior", "nothing that is swept", rule, 'Give for example prior=["tv", "tv+l1"], tau=[0.1, 1.0].')
    for one in swept.get("prior", [prior]):
        if one is not None and not isinstance(one, str):
            raise input_error("prior", shown(one), 'it is the text of a prior, such as "tv"', 'Leave it out for "auto".')
    frame, truth = checked_array("frame", frame), checked_array("truth", truth)
    settings = _settings(camera, psf, fixed["prior"], fixed["tau"], dark, flat, bad_pixels, corrected)
    native = _rowburst._Reconstructor(
        **settings,
        noise_sigma=fixed["noise_sigma"],
        max_iterations=fixed["max_iterations"],
        self_calibrate=self_calibrate,
        keep_all_pixels=keep_all_pixels,
        threads=threads,
        tuning=_constants(tuning),
        corrected=corrected,
    )
    # Priors and τ as text, which the library reads.
    for point in points:
        native.check(**point)
    results: list[Result | None] = []
    table: list[dict[str, Any]] = []
    errors: list[InputError | WorkError] = []
    for point in points:
        began = time.monotonic()
        bar, callback = _callback(progress)
        row: dict[str, Any] = {"point": _label(point)} | dict.fromkeys(_COLUMNS)
        result: Result | None = None
        try:
            result = Result(native.reconstruct(frame, truth=truth, progress=callback, **point), settings["camera"])
            numbers = result.numbers
            row |= {name: numbers.get(name) for name in _COLUMNS if name != "error"}
        except (InputError, WorkError) as error:
            errors.append(error)
            row["error"] = str(error)
        finally:
            if bar is not None:
                bar.close()
        results.append(result)
        table.append(row | {"seconds": time.monotonic() - began})
    if len(errors) == len(points):
        raise errors[0]
    return Sweep(results, table)


# What the table has of a result, beside its point and its time.
_COLUMNS = ("prior", "tau", "residual_over_sigma", "psnr_db", "ssim", "fit", "error")


def _is_list(value: object) -> bool:
    return isinstance(value, Iterable) and not isinstance(value, str) and getattr(value, "ndim", 1) > 0


def _label(point: Mapping[str, Any]) -> str:
    """The point as the command line writes it."""
    return " ".join(f"{name.replace('_', '-')}={value}" for name, value in point.items())
