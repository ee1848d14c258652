"""``reconstruct`` and what it gives."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowburst
from ._rowburst import Camera, Progress, Psf


@dataclass(frozen=True)
class Trace:
    """The light of a region over time, with standard errors.

    ``value`` is the mean of the video over the region, ``debiased`` the same from an estimate that the
    prior does not pull, and ``standard_error`` (NaN where it is not known) belongs to ``debiased``.
    """

    region: tuple[int, int, int, int]
    """First row, first column, rows, columns."""
    time_us: NDArray[np.float64]
    value: NDArray[np.float64]
    debiased: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    numbers: dict[str, Any]
    """Peak, frequency with its error, harmonics, photodiodes: as in ``result.json``."""

    @property
    def frequency_hz(self) -> float | None:
        """What repeats, where something does."""
        return self.numbers.get("frequency_hz")

    @property
    def frequency_error_hz(self) -> float | None:
        """Its standard error."""
        return self.numbers.get("frequency_error_hz")


class Report(str):
    """The report as the text of one HTML page, which fetches nothing; notebooks show it."""

    def save(self, path: str | PathLike[str]) -> Path:
        """Writes the page to a file."""
        target = Path(path)
        target.write_text(self, encoding="utf-8")
        return target

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{escape(self)}" style="width:100%;height:45em;border:0"></iframe>'


class Result:
    """A reconstructed video with what is needed to judge it."""

    def __init__(self, found: _rowburst.Result, camera: Camera) -> None:
        self._native = found
        self.camera = camera

    @property
    def video(self) -> NDArray[np.float32]:
        """The video ``[t, y, x]`` in counts. No copy: it may not be written to."""
        return self._native.video

    @property
    def background(self) -> NDArray[np.float32] | None:
        """The part of the video that the prior has as its background, if it has one."""
        return self._native.background

    @property
    def residual(self) -> NDArray[np.float32]:
        """``W(b - A v) / sigma``, ``[y, x]``; 0 where a pixel holds no information."""
        return self._native.residual

    @property
    def time_us(self) -> NDArray[np.float64]:
        """The middle of each bin of the video."""
        return self.camera.time_us

    @property
    def frame_rate_hz(self) -> float:
        """Frames of the video a second."""
        return self._native.frame_rate_hz

    @property
    def prior(self) -> str:
        """The prior that was used."""
        return self._native.prior

    @property
    def tau(self) -> float:
        """The weight of the prior at the end."""
        return self._native.tau

    @property
    def noise_sigma(self) -> float:
        """Standard deviation of the noise, in counts."""
        return self._native.noise_sigma

    @property
    def residual_over_sigma(self) -> float:
        """1 where the video explains the frame to within the noise."""
        return self._native.residual_over_sigma

    @property
    def iterations(self) -> int:
        """Iterations done."""
        return self._native.iterations

    @property
    def stop_reason(self) -> str:
        """converged, iteration-limit, time-budget or interrupted."""
        return self._native.stop_reason

    @property
    def fit(self) -> str:
        """good, suspicious or bad: whether the model explains the frame."""
        return self._native.fit

    @property
    def fit_reason(self) -> str:
        """Why."""
        return self._native.fit_reason

    @property
    def seconds(self) -> float:
        """The solver alone."""
        return self._native.seconds

    @property
    def setup_seconds(self) -> float:
        """Operator, Gram factors, noise level."""
        return self._native.setup_seconds

    @property
    def numbers(self) -> dict[str, Any]:
        """All that ``result.json`` of the command line says."""
        numbers: dict[str, Any] = json.loads(self._native._json())
        return numbers

    def traces(
        self,
        regions: Iterable[Sequence[int]] = (),
        photodiodes: Iterable[str | PathLike[str]] = (),
    ) -> list[Trace]:
        """Traces of ``regions``, then of the brightest spots.

        A region is ``(y, x)``, for the 3×3 pixels about it, or ``(y, x, rows, columns)``. A photodiode
        is a CSV file with the columns ``time_us,value``, which is laid over the trace that it fits.
        """
        texts = [",".join(str(int(n)) for n in region) for region in regions]
        found, text = self._native._traces(texts, [fspath(p) for p in photodiodes])
        numbers = json.loads(text)["traces"]
        time_us = self.time_us
        return [Trace(time_us=time_us, numbers=n, **trace) for trace, n in zip(found, numbers, strict=True)]

    def report(self, path: str | PathLike[str] | None = None, title: str = "Rowburst") -> Report:
        """The report of the command line, as a page; written to ``path`` if there is one."""
        report = Report(self._native._report(title))
        if path is not None:
            report.save(path)
        return report

    def save(self, folder: str | PathLike[str], title: str = "Rowburst") -> Path:
        """Writes the files of ``rowburst reconstruct``: video, traces, report, ``result.json``."""
        self._native._save(folder, title)
        return Path(folder)

    def __repr__(self) -> str:
        bins, rows, columns = self.camera.video_shape
        return (
            f"<rowburst.Result: {bins} frames of {rows}×{columns} at {self.frame_rate_hz:.0f} fps, "
            f"residual/sigma {self.residual_over_sigma:.3f}, the fit is {self.fit}>"
        )


class _Bar:
    """A tqdm bar of a run."""

    def __init__(self) -> None:
        from tqdm.auto import tqdm

        self.bar = tqdm(unit="iteration", leave=False)

    def __call__(self, progress: Progress) -> None:
        if progress.iteration == 1:
            self.bar.reset(total=progress.max_iterations)
        self.bar.set_description(progress.label or "solving", refresh=False)
        self.bar.set_postfix_str(f"residual/σ {progress.residual_over_sigma:.2f}", refresh=False)
        self.bar.update(progress.iteration - self.bar.n)

    def close(self) -> None:
        self.bar.close()


def reconstruct(
    frame: ArrayLike | PathLike[str],
    camera: Camera,
    psf: Psf | ArrayLike | PathLike[str],
    *,
    prior: str = "auto",
    tau: str | float = "auto",
    noise_sigma: float | None = None,
    time_budget_s: float | None = None,
    max_iterations: int | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    truth: ArrayLike | PathLike[str] | None = None,
    direct: ArrayLike | PathLike[str] | None = None,
    progress: Callable[[Progress], object] | bool | None = None,
    seed: int = 0,
) -> Result:
    """The video of one raw ``frame``, with the numbers of ``rowburst reconstruct``.

    A frame (and a PSF given as an array) of integers is a raw capture: dark or bias are taken off,
    and the end of its type is saturation. The name of a file, in any format that the command line
    reads, may stand in for an array. ``prior`` and ``tau`` are those of the command line.
    ``progress`` is ``True`` for a tqdm bar, or a function that is given a :class:`Progress` after
    every iteration; where it returns ``False`` the best so far is the result. Ctrl-C raises
    ``KeyboardInterrupt``. Other Python threads run meanwhile.
    """
    bar = _Bar() if progress is True else None
    try:
        found = _rowburst.reconstruct(
            frame,
            camera,
            psf,
            prior=prior,
            tau=tau,
            noise_sigma=noise_sigma,
            time_budget_s=time_budget_s,
            max_iterations=max_iterations,
            dark=dark,
            flat=flat,
            bad_pixels=bad_pixels,
            truth=truth,
            direct=direct,
            progress=bar or (progress if callable(progress) else None),
            seed=seed,
        )
    finally:
        if bar is not None:
            bar.close()
    return Result(found, camera)
