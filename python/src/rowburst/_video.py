"""What every reconstructed video offers: pictures of it, and labelled axes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ._checks import checked_whole
from ._extras import need

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import DataArray


def first_pixel(field: int, sensor: int) -> int:
    """The pixel of the sensor, along one side, at which the first pixel of the field lies.

    It is a whole number from 0 down, as in the operator: of an odd difference the smaller half lies before the sensor.
    """
    return -((field - sensor) // 2)


def pixels(count: int, first: int) -> NDArray[np.float64]:
    """The pixels of the sensor, along one side, at which those of the field lie."""
    return np.arange(count, dtype=np.float64) + first


class VideoResult:
    """A video ``[t, y, x]`` in counts with the times of its bins: base of :class:`Result` and :class:`SavedResult`."""

    @property
    def video(self) -> NDArray[np.float32]:
        """The video ``[t, y, x]`` in counts. It may not be written to."""
        raise NotImplementedError

    @property
    def time_us(self) -> NDArray[np.float64]:
        """The middle of each bin in microseconds, from the start of exposure of the row that is read first."""
        raise NotImplementedError

    @property
    def frame_rate_hz(self) -> float:
        """Frames of the video a second."""
        raise NotImplementedError

    @property
    def residual(self) -> NDArray[np.float32]:
        """``W(b - A v) / sigma``, ``[y, x]``; 0 where a pixel holds no information."""
        raise NotImplementedError

    @property
    def numbers(self) -> dict[str, Any]:
        """The content of ``result.json`` of the command line."""
        raise NotImplementedError

    @property
    def _first_pixel(self) -> tuple[int, int]:
        """The pixel ``(y, x)`` of the sensor at which the first of the field lies."""
        raise NotImplementedError

    def to_xarray(self) -> DataArray:
        """The video with the axes ``time`` (microseconds), ``y`` and ``x`` (pixels of the sensor).

        Returns
        -------
        xarray.DataArray
            float32 ``(time, y, x)`` in counts. ``time`` is the middle of each bin, from the start of exposure of the row
            that is read first. ``y`` and ``x`` are whole pixels, and 0 is the first of the sensor; where the field is larger
            than the sensor, they begin below 0. The attributes are prior, tau, noise, fit, frame rate, and the delay of that
            start after the trigger where it is known.

        Raises
        ------
        InputError
            xarray is not installed.

        Examples
        --------
        >>> video = result.to_xarray()
        >>> video.dims, video.time.attrs["units"]
        (('time', 'y', 'x'), 'µs')
        >>> bright = video.sel(time=slice(50, 150)).max("time")
        """
        xarray = need("xarray", "to_xarray")
        _, rows, columns = self.video.shape
        first_row, first_column = self._first_pixel
        numbers = self.numbers
        kept = ("prior", "tau", "noise_sigma", "effective_sigma", "residual_over_sigma", "fit", "frame_rate_hz", "trigger_delay_us", "version")
        array: DataArray = xarray.DataArray(
            self.video,
            dims=("time", "y", "x"),
            coords={
                "time": ("time", self.time_us, {"units": "µs", "long_name": "middle of the bin"}),
                "y": ("y", pixels(rows, first_row), {"units": "px", "long_name": "row of the sensor"}),
                "x": ("x", pixels(columns, first_column), {"units": "px", "long_name": "column of the sensor"}),
            },
            name="video",
            attrs={"units": "counts"} | {name: numbers[name] for name in kept if numbers.get(name) is not None},
        )
        return array

    def plot(self) -> NDArray[Any]:
        """Draws the result on one page: maximum over time, time as colour, light over time, residual.

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
        >>> axes = result.plot()
        >>> axes[0, 0].figure.savefig("result.png", dpi=150)
        """
        from . import _plot

        return _plot.overview(self)

    def montage(self, frames: int = 12, columns: int | None = None, cmap: str = "gray") -> NDArray[Any]:
        """Draws bins of the video side by side, on one scale, each with its time.

        Parameters
        ----------
        frames : int
            Number of bins, evenly spaced from the first to the last.
        columns : int, optional
            Pictures in a row; by default about as many as there are rows, times 1.5.
        cmap : str
            Name of a matplotlib colour map.

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
        >>> len(result.montage(6))
        6
        """
        from . import _plot

        frames = checked_whole("frames", frames, 1)
        columns = None if columns is None else checked_whole("columns", columns, 1)
        return _plot.montage(self, frames, columns, cmap)

    def time_colour(self, ax: Axes | None = None, cmap: str = "turbo") -> Axes:
        """Draws the video as one picture, in which the colour is the time and the brightness the light.

        Each bin is tinted with the colour of its time; each pixel shows the brightest of its tinted bins.

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
        >>> ax = result.time_colour()
        """
        from . import _plot

        return _plot.time_colour(self, ax, cmap)
