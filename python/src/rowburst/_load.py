"""``load``: a result that was written to a folder."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _rowburst
from ._colour_video import ColourVideo
from ._display import result_html
from ._errors import input_error
from ._figure import Figure, save_figure
from ._reconstruct import Trace
from ._video import VideoResult, first_pixel
from ._view import View


class SavedResult(VideoResult):
    """A result from the folder of :meth:`Result.save` or ``rowburst reconstruct``. :func:`load` makes it.

    Arrays are read when they are first used; the video is mapped into memory, not copied.
    """

    def __init__(self, folder: str | PathLike[str]) -> None:
        self.folder = Path(folder)
        self._numbers = _numbers_of(self.folder)
        self._arrays: dict[str, NDArray[Any]] = {}

    def _array(self, name: str) -> NDArray[Any]:
        if name not in self._arrays:
            if "parts" in self._numbers and not (self.folder / name).exists():
                rule = "a video in chunks has video.npy, and its report shows the rest"
                raise input_error(self.folder / name, "no such file", rule, "Open report.html.", kind="missing")
            self._arrays[name] = _mapped(self.folder / name)
        return self._arrays[name]

    def _optional(self, name: str) -> NDArray[Any] | None:
        return self._array(name) if (self.folder / name).is_file() else None

    @property
    def _view(self) -> dict[str, Any]:
        path = self.folder / "view.json"
        view: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        return view

    @property
    def video(self) -> NDArray[np.float32]:
        """The video ``[t, y, x]`` in counts. It may not be written to."""
        return self._array("video.npy")

    @property
    def background(self) -> NDArray[np.float32] | None:
        """The background component of the video ``[t, y, x]``, if the prior has one."""
        return self._optional("background.npy")

    @property
    def excluded(self) -> NDArray[np.uint8] | None:
        """1 at the foreign pixels ``[y, x]`` that were left out; None where the result has no such file."""
        return self._optional("excluded.npy")

    @property
    def stray_light(self) -> NDArray[np.float32] | None:
        """Smooth stray light ``[y, x]`` that was taken away from the frame, in counts; None: none was found."""
        return self._optional("stray-light.npy")

    @property
    def coverage(self) -> NDArray[np.uint8] | None:
        """1 at the voxels ``[t, y, x]`` that the frame observes; None where the result has no such file."""
        return self._optional("coverage.npy")

    @property
    def residual(self) -> NDArray[np.float32]:
        """``W(b - A v) / sigma``, ``[y, x]``; 0 where a pixel holds no information."""
        return self._array("view-residual.npy")

    @property
    def _first_pixel(self) -> tuple[int, int]:
        if "first_row" in self._numbers:
            return int(self._numbers["first_row"]), int(self._numbers["first_column"])
        # Results of 0.1 do not have it, and those in chunks have no residual.
        field = self.video.shape[1:]
        sensor = self.residual.shape if (self.folder / "view-residual.npy").is_file() else field
        return first_pixel(field[0], sensor[0]), first_pixel(field[1], sensor[1])

    @property
    def frame(self) -> NDArray[np.float32]:
        """The corrected frame ``[y, x]`` in counts."""
        return self._array("view-frame.npy")

    @property
    def psf(self) -> NDArray[np.float32]:
        """The PSF of the middle of the field, ``[y, x]``."""
        return self._array("view-psf.npy")

    @property
    def time_us(self) -> NDArray[np.float64]:
        """The middle of each bin in microseconds, from the start of exposure of the row that is read first."""
        duration = float(self._view.get("bin_duration_us", 1e6 / self.frame_rate_hz))
        # Results of 0.1 do not have it.
        start = float(self._numbers.get("start_us", 0.0))
        return start + (np.arange(len(self.video), dtype=np.float64) + 0.5) * duration

    @property
    def frame_rate_hz(self) -> float:
        """Frames of the video a second."""
        return float(self._numbers["frame_rate_hz"])

    @property
    def numbers(self) -> dict[str, Any]:
        """The content of ``result.json``."""
        numbers: dict[str, Any] = json.loads(json.dumps(self._numbers))
        return numbers

    @property
    def fit(self) -> str:
        """good, suspicious or bad: whether the model explains the frame."""
        return str(self._numbers["fit"])

    @property
    def fit_reason(self) -> str:
        """The reason for the verdict ``fit``."""
        return str(self._numbers["fit_reason"])

    @property
    def prior(self) -> str:
        """The prior that was used."""
        return str(self._numbers["prior"])

    def traces(self) -> list[Trace]:
        """The traces that were written: of the requested regions, then of the brightest spots.

        Returns
        -------
        list of Trace
            Light over time, in counts, with standard errors.

        Examples
        --------
        >>> saved.traces()[0].value.shape == saved.time_us.shape
        True
        """
        time_us = self.time_us
        traces = []
        for trace, numbers in zip(self._view.get("traces", []), self._numbers.get("traces", []), strict=True):
            at = trace["region"]
            # Null where it is not known.
            values = {name: np.array(trace[name], float) for name in ("value", "debiased", "standard_error")}
            region = (at["y"], at["x"], at["rows"], at["columns"])
            traces.append(Trace(region=region, time_us=time_us, numbers=numbers, **values))
        return traces

    def figure(self, path: str | PathLike[str] | None = None, layout: str = "fig2") -> Figure:
        """The figure for a paper, as :meth:`Result.figure` draws it.

        Parameters
        ----------
        path : path, optional
            A .svg, .pdf or .png file that is written.
        layout : str
            ``"fig2"`` or ``"fig3"``.

        Returns
        -------
        Figure
            The figure as SVG, PNG and PDF.

        Raises
        ------
        InputError
            The layout is unknown, the file has another ending, or the video is one in chunks.
        WorkError
            The file cannot be written.

        Examples
        --------
        >>> saved.figure(layout="fig3").svg[:5]
        '<?xml'
        """
        if "parts" in self._numbers:
            rule = "a figure is drawn from a result in one piece"
            remedy = "Reconstruct a part of its bins by rb.reconstruct, or use plot()."
            raise input_error(self.folder, "a video in chunks", rule, remedy, kind="missing")
        return save_figure(Figure(*_rowburst._figure_of_folder(self.folder, layout)), path)

    def view(self, port: int | None = None, open_browser: bool = True) -> View:
        """Opens the viewer of ``rowburst view`` on this result, as :meth:`Result.view` does.

        Parameters
        ----------
        port : int, optional
            The port; 0 is any.
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
        >>> with saved.view(port=0, open_browser=False) as view:
        ...     print(view.url[:17])
        http://127.0.0.1:
        """
        return View([self.folder], port, open_browser)

    def __repr__(self) -> str:
        bins, rows, columns = self.video.shape
        return f"<rowburst.SavedResult {str(self.folder)!r}: {bins} frames of {rows}×{columns}, the fit is {self.fit}>"

    def _repr_html_(self) -> str:
        return result_html(self, "SavedResult")


class SavedColour(ColourVideo):
    """A video in colour from the folder of :meth:`ColourResult.save` or ``rowburst reconstruct``. :func:`load` makes it.

    Arrays are read when they are first used.
    """

    def __init__(self, folder: str | PathLike[str]) -> None:
        self.folder = Path(folder)
        self._numbers = _numbers_of(self.folder)
        self._video: NDArray[np.float32] | None = None
        self._planes = {plane["name"]: SavedResult(self.folder / plane["name"]) for plane in self._numbers["planes"]}

    @property
    def planes(self) -> dict[str, SavedResult]:
        """The result of each plane, by its name: ``red``, ``green-1``, ``green-2``, and ``blue``."""
        return self._planes

    @property
    def video(self) -> NDArray[np.float32]:
        """The video ``[t, y, x, colour]`` in counts: red, green and blue. It may not be written to."""
        if self._video is None:
            self._video = _mapped(self.folder / "colour.npy")
        return self._video

    @property
    def start_us(self) -> dict[str, float]:
        """Start of each plane's first bin in microseconds, from the sensor's first exposure."""
        return {plane["name"]: float(plane["start_us"]) for plane in self._numbers["planes"]}

    @property
    def bayer(self) -> str:
        """The mosaic of the sensor, such as ``rggb``."""
        return str(self._numbers["bayer"])

    @property
    def time_us(self) -> NDArray[np.float64]:
        """The middle of each bin in microseconds, of the plane that begins first, from the sensor's first exposure."""
        start = float(self._numbers.get("start_us", 0.0))
        return start + (np.arange(len(self.video), dtype=np.float64) + 0.5) * (1e6 / self.frame_rate_hz)

    @property
    def frame_rate_hz(self) -> float:
        """Frames of the video a second."""
        return float(self._numbers["frame_rate_hz"])

    @property
    def numbers(self) -> dict[str, Any]:
        """The content of ``result.json``."""
        numbers: dict[str, Any] = json.loads(json.dumps(self._numbers))
        return numbers

    def traces(self) -> dict[str, list[Trace]]:
        """The traces of each plane that were written.

        Returns
        -------
        dict of list of Trace
            By the name of the plane. The times are those of the plane.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> sorted(rb.load(colour.save("colour")).traces())
        ['blue', 'green-1', 'green-2', 'red']
        """
        return {name: plane.traces() for name, plane in self.planes.items()}

    def view(self, port: int | None = None, open_browser: bool = True) -> View:
        """Opens the viewer of ``rowburst view`` on the planes, as :meth:`Result.view` does.

        Parameters
        ----------
        port : int, optional
            The port; 0 is any.
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
        >>> with rb.load(colour.save("colour")).view(port=0, open_browser=False) as view:
        ...     print(view.url[:17])
        http://127.0.0.1:
        """
        return View([plane.folder for plane in self.planes.values()], port, open_browser)

    def __repr__(self) -> str:
        bins, rows, columns, _ = self.video.shape
        return f"<rowburst.SavedColour {str(self.folder)!r}: {bins} frames of {rows}×{columns} in colour>"


def _numbers_of(folder: Path) -> dict[str, Any]:
    """The content of ``result.json`` of a folder."""
    if not (folder / "result.json").is_file():
        rule = "a result is a folder that Result.save or `rowburst reconstruct` has written whole"
        remedy = "Check the path, or run the reconstruction again."
        raise input_error(folder, "no result.json", rule, remedy, kind="missing")
    try:
        numbers: dict[str, Any] = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except ValueError as error:
        found = f"a result.json that cannot be read ({error})"
        raise input_error(folder, found, "a whole result has it", "Run the reconstruction again.", kind="unreadable") from error
    return numbers


def _mapped(path: Path) -> NDArray[Any]:
    """The array of a file, mapped into memory."""
    try:
        array: NDArray[Any] = np.load(path, mmap_mode="r")
    except (OSError, ValueError) as error:
        found = f"a file that cannot be read ({error})"
        raise input_error(path, found, "a whole result has it", "Run the reconstruction again.", kind="unreadable") from error
    return array


def load(folder: str | PathLike[str]) -> SavedResult | SavedColour:
    """Opens the folder of a result.

    Parameters
    ----------
    folder : path
        A folder that :meth:`Result.save`, :meth:`ColourResult.save` or ``rowburst reconstruct`` has written.

    Returns
    -------
    SavedResult or SavedColour
        Its video, masks, traces and numbers; of a raw colour frame its video in colour and the result of each plane.

    Raises
    ------
    InputError
        The folder holds no whole result.

    Examples
    --------
    >>> saved = rb.load(result.save("result"))
    >>> bool((saved.video == result.video).all())
    True
    """
    return SavedColour(folder) if "bayer" in _numbers_of(Path(folder)) else SavedResult(folder)
