"""What every video in colour offers: its planes, pictures of it, and labelled axes."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ._checks import checked_whole, shown
from ._display import colour_html
from ._errors import input_error
from ._extras import need
from ._figure import Figure
from ._video import pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import DataArray

    from ._load import SavedResult
    from ._reconstruct import Result

COLOURS = ("red", "green", "blue")
_VERDICTS = ("good", "suspicious", "bad")
Plane = TypeVar("Plane")


class ColourVideo:
    """A video ``[t, y, x, colour]`` in counts, and its planes: base of :class:`ColourResult` and :class:`SavedColour`.

    A pixel of it is a cell of 2×2 pixels of the sensor; the planes have the same pixels.
    """

    @property
    def video(self) -> NDArray[np.float32]:
        """The video ``[t, y, x, colour]`` in counts: red, green (the mean of its two planes) and blue. It may not be
        written to."""
        raise NotImplementedError

    @property
    def planes(self) -> Mapping[str, Result | SavedResult]:
        """The result of each plane, by its name: ``red``, ``green-1``, ``green-2``, and ``blue``."""
        raise NotImplementedError

    @property
    def start_us(self) -> dict[str, float]:
        """Start of each plane's first bin in microseconds, from the sensor's first exposure."""
        raise NotImplementedError

    @property
    def bayer(self) -> str:
        """The mosaic of the sensor, such as ``rggb``."""
        raise NotImplementedError

    @property
    def numbers(self) -> dict[str, Any]:
        """The numbers of the video and of its planes."""
        raise NotImplementedError

    @property
    def time_us(self) -> NDArray[np.float64]:
        """The middle of each bin in microseconds, of the plane that begins first, from the sensor's first exposure."""
        bin_us = 1e6 / self.frame_rate_hz
        return min(self.start_us.values()) + (np.arange(len(self.video), dtype=np.float64) + 0.5) * bin_us

    @property
    def frame_rate_hz(self) -> float:
        """Frames of the video a second."""
        return self._first.frame_rate_hz

    @property
    def prior(self) -> str:
        """The prior of all planes."""
        return self._first.prior

    @property
    def fit(self) -> str:
        """good, suspicious or bad: the worst verdict of the planes."""
        return max((plane.fit for plane in self.planes.values()), key=_VERDICTS.index)

    @property
    def fit_reason(self) -> str:
        """The planes that have the verdict ``fit``, and the reason of the first of them."""
        names = [name for name, plane in self.planes.items() if plane.fit == self.fit]
        return f"{', '.join(names)}: {self.planes[names[0]].fit_reason}"

    @property
    def residual(self) -> NDArray[np.float32]:
        """``W(b - A v) / sigma`` of the raw frame ``[y, x]``; 0 where a pixel holds no information."""
        return _mosaic(self.bayer, {name: plane.residual for name, plane in self.planes.items()})

    @property
    def excluded(self) -> NDArray[np.uint8] | None:
        """1 at the foreign pixels of the raw frame ``[y, x]`` that were left out; None where a plane does not tell."""
        masks = {name: plane.excluded for name, plane in self.planes.items()}
        known = {name: mask for name, mask in masks.items() if mask is not None}
        return _mosaic(self.bayer, known) if len(known) == len(masks) else None

    @property
    def _first(self) -> Result | SavedResult:
        return next(iter(self.planes.values()))

    def to_xarray(self) -> DataArray:
        """The video with the axes ``time`` (microseconds), ``y`` and ``x`` (cells of 2×2 pixels), and ``colour``.

        Returns
        -------
        xarray.DataArray
            float32 ``(time, y, x, colour)`` in counts. ``time`` is that of the plane that begins first. ``y`` and ``x`` count
            the cells of the sensor from 0; where the field is larger than the sensor, they begin below 0. ``colour`` is
            ``"red"``, ``"green"`` and ``"blue"``. The attributes are prior, fit, frame rate and mosaic.

        Raises
        ------
        InputError
            xarray is not installed.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> video = colour.to_xarray()
        >>> video.dims, video.sel(colour="red").shape
        (('time', 'y', 'x', 'colour'), (12, 12, 15))
        """
        xarray = need("xarray", "to_xarray")
        _, rows, columns, _ = self.video.shape
        first_row, first_column = self._first._first_pixel
        array: DataArray = xarray.DataArray(
            self.video,
            dims=("time", "y", "x", "colour"),
            coords={
                "time": ("time", self.time_us, {"units": "µs", "long_name": "middle of the bin"}),
                "y": ("y", pixels(rows, first_row), {"units": "cells", "long_name": "row of cells of the sensor"}),
                "x": ("x", pixels(columns, first_column), {"units": "cells", "long_name": "column of cells of the sensor"}),
                "colour": ("colour", list(COLOURS)),
            },
            name="video",
            attrs={
                "units": "counts",
                "prior": self.prior,
                "fit": self.fit,
                "frame_rate_hz": self.frame_rate_hz,
                "bayer": self.bayer,
            },
        )
        return array

    def plot(self) -> NDArray[Any]:
        """Draws the result on one page: maximum over time, time as colour, light of each colour over time, residual.

        Returns
        -------
        numpy.ndarray
            The four ``matplotlib`` axes, ``[2, 2]``. The figure is ``axes[0, 0].figure``.

        Raises
        ------
        InputError
            matplotlib is not installed.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> colour.plot().shape
        (2, 2)
        """
        from . import _plot

        return _plot.colour_overview(self)

    def montage(self, frames: int = 12, columns: int | None = None) -> NDArray[Any]:
        """Draws bins of the video side by side in colour, on one scale, each with its time.

        Parameters
        ----------
        frames : int
            Number of bins, evenly spaced from the first to the last.
        columns : int, optional
            Pictures in a row; by default about as many as there are rows, times 1.5.

        Returns
        -------
        numpy.ndarray
            The ``matplotlib`` axes, one for each bin that is shown.

        Raises
        ------
        InputError
            matplotlib is not installed, or ``frames`` or ``columns`` is no whole number from 1.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> len(colour.montage(6))
        6
        """
        from . import _plot

        frames = checked_whole("frames", frames, 1)
        columns = None if columns is None else checked_whole("columns", columns, 1)
        return _plot.montage(self, frames, columns, "gray")

    def time_colour(self, ax: Axes | None = None, cmap: str = "turbo") -> Axes:
        """Draws the light of all colours as one picture, in which the colour is the time and the brightness the light.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw; by default into a figure of its own.
        cmap : str
            Name of a matplotlib colour map, from the first bin to the last.

        Returns
        -------
        matplotlib.axes.Axes
            The axes, with a colour bar in microseconds.

        Raises
        ------
        InputError
            matplotlib is not installed.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> ax = colour.time_colour()
        """
        from . import _plot

        return _plot.time_colour(self, ax, cmap)

    def figure(
        self, path: str | PathLike[str] | None = None, layout: str = "fig2", plane: str = "green-1"
    ) -> Figure:
        """Draws the figure of ``rowburst figure`` of one plane.

        Parameters
        ----------
        path : path, optional
            A .svg, .pdf or .png file that is written.
        layout : str
            ``"fig2"`` or ``"fig3"``, after the figures of the paper.
        plane : str
            ``"red"``, ``"green-1"``, ``"green-2"`` or ``"blue"``.

        Returns
        -------
        Figure
            The figure as SVG, PNG and PDF; notebooks show it.

        Raises
        ------
        InputError
            The layout or the plane is unknown, or the file has another ending.
        WorkError
            The file cannot be written.

        Examples
        --------
        >>> colour = rb.reconstruct_colour(frame, camera.replace(bayer="rggb"), psf, prior="tv", max_iterations=5)
        >>> colour.figure(plane="red").svg[:5]
        '<?xml'
        """
        return plane_of(self.planes, plane).figure(path, layout)

    def _repr_html_(self) -> str:
        return colour_html(self, type(self).__name__)


def plane_of(planes: Mapping[str, Plane], name: object) -> Plane:
    """The plane of a name."""
    for known, plane in planes.items():
        if known == name:
            return plane
    rule = f"the planes are {', '.join(planes)}"
    raise input_error("plane", shown(name), rule, "Give the name of one of them.")


def _mosaic(bayer: str, planes: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """The pixels of the raw frame, each from its plane."""
    rows, columns = next(iter(planes.values())).shape
    frame = np.zeros((2 * rows, 2 * columns), next(iter(planes.values())).dtype)
    for site, letter in enumerate(bayer):
        row, column = divmod(site, 2)
        name = {"r": "red", "b": "blue"}.get(letter, f"green-{row + 1}")
        frame[row::2, column::2] = planes[name]
    return frame
