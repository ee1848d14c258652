"""``reconstruct_colour``: a raw frame of a colour sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowburst
from ._reconstruct import Result, _callback, _constants, _settings
from ._rowburst import Camera, Experiment, Progress, Psf


class ColourResult:
    """A video in colour, and the planes that it is of. :func:`reconstruct_colour` makes it."""

    def __init__(self, video: NDArray[np.float32], planes: dict[str, Result], start_us: dict[str, float]) -> None:
        video.setflags(write=False)
        self.video = video
        """The video ``[t, y, x, colour]`` in counts: red, green (the mean of its two planes) and blue."""
        self.planes = planes
        """The result of each plane, by its name: ``red``, ``green-1``, ``green-2``, and ``blue``."""
        self.start_us = start_us
        """From the start of the sensor's first instant to that of each plane's, in microseconds."""

    def save(self, folder: str | PathLike[str]) -> Path:
        """Writes ``colour.npy``, and the files of each plane into a folder of its name."""
        target = Path(folder)
        for name, plane in self.planes.items():
            plane.save(target / name, f"Rowburst: {name}")
        np.save(target / "colour.npy", self.video)
        return target

    def __repr__(self) -> str:
        bins, rows, columns, _ = self.video.shape
        fits = ", ".join(f"{name} {plane.fit}" for name, plane in self.planes.items())
        return f"<rowburst.ColourResult: {bins} frames of {rows}×{columns} in colour; {fits}>"


def reconstruct_colour(
    frame: ArrayLike | PathLike[str],
    camera: Camera | Experiment,
    psf: Psf | ArrayLike | PathLike[str] | None = None,
    *,
    prior: str | None = None,
    tau: str | float | None = None,
    noise_sigma: float | None = None,
    time_budget_s: float | None = None,
    max_iterations: int | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    progress: Callable[[Progress], object] | bool | None = None,
    seed: int = 0,
    keep_all_pixels: bool = False,
    debias: bool = False,
    threads: int | None = None,
    tuning: Mapping[str, float] | None = None,
) -> ColourResult:
    """The video in colour of a raw frame of a sensor with a mosaic, with the numbers of ``rowburst reconstruct``.

    Each of the four planes is reconstructed by itself. A prior ``"auto"`` is chosen on the first green plane, for all.

    Parameters
    ----------
    frame : array or path
        The raw frame ``[y, x]``, before any colours are made of it.
    camera : Camera or Experiment
        The camera, with ``bayer``.
    psf, prior, tau, noise_sigma, max_iterations, dark, flat, bad_pixels, progress, seed, keep_all_pixels
        Those of :func:`reconstruct`, on the raw pixels.
    debias, threads, tuning
        Those of :func:`reconstruct`.
    time_budget_s : float, optional
        Limit for all planes together, in seconds.

    Returns
    -------
    ColourResult
        The video ``[t, y, x, colour]``, and the result of each plane.

    Raises
    ------
    InputError
        An argument breaks a rule, or the camera has no mosaic.
    WorkError
        The planes differ in length.

    Examples
    --------
    >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
    >>> colour.video.shape, sorted(colour.planes)
    ((12, 12, 15, 3), ['blue', 'green-1', 'green-2', 'red'])
    """
    settings = _settings(camera, psf, prior, tau, dark, flat, bad_pixels)
    bar, callback = _callback(progress)
    try:
        video, planes = _rowburst._reconstruct_colour(
            frame,
            noise_sigma=noise_sigma,
            time_budget_s=time_budget_s,
            max_iterations=max_iterations,
            progress=callback,
            seed=seed,
            keep_all_pixels=keep_all_pixels,
            debias=debias,
            threads=threads,
            tuning=_constants(tuning),
            **settings,
        )
    finally:
        if bar is not None:
            bar.close()
    results = {name: Result(found, found._camera) for name, _, found in planes}
    return ColourResult(video, results, {name: start for name, start, _ in planes})
