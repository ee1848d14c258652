"""``reconstruct_colour``: a raw frame of a colour sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowburst
from ._reconstruct import Result, _callback, _constants, _settings_without_guide
from ._rowburst import Camera, Experiment, Progress, Psf


class ColourResult:
    """A video in colour, and the planes that it is of. :func:`reconstruct_colour` makes it."""

    def __init__(self, video: NDArray[np.float32], planes: dict[str, Result], start_us: dict[str, float], bayer: str) -> None:
        video.setflags(write=False)
        self.video = video
        """The video ``[t, y, x, colour]`` in counts: red, green (the mean of its two planes) and blue."""
        self.planes = planes
        """The result of each plane, by its name: ``red``, ``green-1``, ``green-2``, and ``blue``."""
        self.start_us = start_us
        """Start of each plane's first bin in microseconds, from the sensor's first exposure."""
        self.bayer = bayer
        """The mosaic of the sensor, such as ``rggb``."""

    def save(self, folder: str | PathLike[str], title: str = "Rowburst") -> Path:
        """Writes the files of ``rowburst reconstruct``: ``colour.npy``, ``colour.tif``, a folder for each plane, ``result.json``.

        Parameters
        ----------
        folder : path
            The folder, which is made where it is missing.
        title : str
            Title of the planes' reports, before their names.

        Returns
        -------
        pathlib.Path
            The folder, which :func:`load` opens.

        Raises
        ------
        WorkError
            A file cannot be written.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> saved = rb.load(colour.save("colour"))
        >>> bool((saved.video == colour.video).all())
        True
        """
        planes = [(name, self.start_us[name], plane._native) for name, plane in self.planes.items()]
        _rowburst._save_colour(folder, title, self.bayer, planes)
        return Path(folder)

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
    corrected: bool = False,
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
    debias, threads, tuning, corrected
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
    more = (psf, prior, tau, dark, flat, bad_pixels, corrected)
    settings = _settings_without_guide("a raw colour frame", camera, *more)
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
            corrected=corrected,
            **settings,
        )
    finally:
        if bar is not None:
            bar.close()
    results = {name: Result(found, found._camera) for name, _, found in planes}
    bayer: str = settings["camera"].bayer
    return ColourResult(video, results, {name: start for name, start, _ in planes}, bayer)
