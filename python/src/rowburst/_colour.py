"""``reconstruct_colour``: a raw frame of a colour sensor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowburst
from ._checks import check_port, checked_array
from ._colour_video import ColourVideo, plane_of
from ._reconstruct import Report, Result, Trace, _callback, _constants, _settings_without_guide
from ._rowburst import Camera, Experiment, Progress, Psf
from ._view import View


class ColourResult(ColourVideo):
    """A video in colour, and the planes that it is of. :func:`reconstruct_colour` makes it."""

    def __init__(self, video: NDArray[np.float32], planes: dict[str, Result], start_us: dict[str, float], bayer: str) -> None:
        video.setflags(write=False)
        self._video, self._planes, self._start_us, self._bayer = video, planes, start_us, bayer

    @property
    def video(self) -> NDArray[np.float32]:
        """The video ``[t, y, x, colour]`` in counts: red, green (the mean of its two planes) and blue. It may not be
        written to."""
        return self._video

    @property
    def planes(self) -> dict[str, Result]:
        """The result of each plane, by its name: ``red``, ``green-1``, ``green-2``, and ``blue``."""
        return self._planes

    @property
    def start_us(self) -> dict[str, float]:
        """Start of each plane's first bin in microseconds, from the sensor's first exposure."""
        return self._start_us

    @property
    def bayer(self) -> str:
        """The mosaic of the sensor, such as ``rggb``."""
        return self._bayer

    @property
    def numbers(self) -> dict[str, Any]:
        """The numbers of the video and of its planes, by their names in ``result.json``. What a plane has beside them is in
        ``planes[name].numbers``."""
        bins, rows, columns, _ = self.video.shape
        planes = [
            {
                "name": name,
                "start_us": self.start_us[name],
                "prior": plane.prior,
                "tau": plane.tau,
                "residual_over_sigma": plane.residual_over_sigma,
                "excluded_fraction": plane.excluded_fraction,
                "fit": plane.fit,
                "seconds": plane.seconds,
            }
            for name, plane in self.planes.items()
        ]
        return {
            "bayer": self.bayer,
            "frames": bins,
            "rows": rows,
            "columns": columns,
            "frame_rate_hz": self.frame_rate_hz,
            "start_us": min(self.start_us.values()),
            "planes": planes,
        }

    def traces(
        self,
        regions: Iterable[Sequence[int]] = (),
        photodiodes: Iterable[str | PathLike[str]] = (),
    ) -> dict[str, list[Trace]]:
        """The traces of each plane: of ``regions``, then of its brightest spots.

        Parameters
        ----------
        regions : iterable of sequence of int
            Each is ``(y, x)``, for the 3×3 pixels about it, or ``(y, x, rows, columns)``, in pixels of the video.
        photodiodes : iterable of path
            CSV files with the columns ``time_us,value``; each is aligned with the trace that fits it best.

        Returns
        -------
        dict of list of Trace
            By the name of the plane. The times are those of the plane.

        Raises
        ------
        InputError
            A region is outside of the field, or a file is no table.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> colour.traces([(4, 5)])["red"][0].region
        (3, 4, 3, 3)
        """
        regions, photodiodes = list(regions), list(photodiodes)
        return {name: plane.traces(regions, photodiodes) for name, plane in self.planes.items()}

    def report(
        self, path: str | PathLike[str] | None = None, title: str = "Rowburst", plane: str = "green-1"
    ) -> Report:
        """The report of one plane, as a page.

        Parameters
        ----------
        path : path, optional
            A file that is written.
        title : str
            Title of the page.
        plane : str
            ``"red"``, ``"green-1"``, ``"green-2"`` or ``"blue"``.

        Returns
        -------
        Report
            The page as text, which fetches nothing; notebooks show it.

        Raises
        ------
        InputError
            The plane is unknown.
        WorkError
            The file cannot be written, or the film cannot be encoded.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> colour.report(plane="blue")[:15].lower()
        '<!doctype html>'
        """
        return plane_of(self.planes, plane).report(path, title)

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

    def view(self, port: int | None = None, open_browser: bool = True) -> View:
        """Opens the viewer of ``rowburst view`` on the planes, as :meth:`Result.view` does.

        Parameters
        ----------
        port : int, optional
            The port; by default 8787, or one of the next that is free. 0 is any.
        open_browser : bool
            Whether a browser is opened, where there is a screen.

        Returns
        -------
        View
            Its ``url``, and ``close()``.

        Raises
        ------
        InputError
            The port is no whole number from 0 to 65535.
        WorkError
            The port is taken.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> with colour.view(port=0, open_browser=False) as view:
        ...     print(view.url[:17])
        http://127.0.0.1:
        """
        check_port(port)
        folder = TemporaryDirectory(prefix="rowburst-")
        try:
            self.save(folder.name)
            return View([Path(folder.name) / name for name in self.planes], port, open_browser, folder)
        except BaseException:
            folder.cleanup()
            raise

    def __reduce__(self) -> tuple[Any, ...]:
        return ColourResult, (self.video, self.planes, self.start_us, self.bayer)

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
    frame = checked_array("frame", frame)
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
