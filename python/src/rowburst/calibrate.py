"""Calibration: captures of your own into the numbers of a sensor, a PSF and a shutter.

The functions are those of ``rowburst calibrate``, with the same numbers.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowburst
from ._checks import check_camera
from ._errors import input_error
from ._frames import frame_of, frames_of
from ._rowburst import Camera, Psf
from ._stored import stored

__all__ = ["PsfCalibration", "SensorCalibration", "TimingCalibration", "psf", "sensor", "timing"]

_Frames = ArrayLike | str | PathLike[str] | Sequence[Any]


class _Calibration:
    """The numbers of a calibration, and its folder."""

    _native: Any
    # Attributes of the native part, for pickling.
    _kept: tuple[str, ...] = ()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (stored(self._native, self._kept),)

    @property
    def numbers(self) -> dict[str, Any]:
        """The content of the JSON file that the command line writes."""
        numbers: dict[str, Any] = json.loads(self._native.json())
        return numbers

    @property
    def warnings(self) -> list[str]:
        """What to change or to know before trusting the numbers."""
        warnings: list[str] = self.numbers["warnings"]
        return warnings

    def save(self, folder: str | PathLike[str]) -> Path:
        """Writes the files of the command line, with its report, into a folder.

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
        >>> calibration.save("calibration").name
        'calibration'
        """
        self._native.save(folder)
        return Path(folder)


class SensorCalibration(_Calibration):
    """Bias, noise, gain, full well and bad pixels of a sensor. :func:`sensor` makes it."""

    _kept = ("dark", "flat", "response", "read_noise", "bad_pixels")

    def __init__(self, native: _rowburst._SensorCalibration) -> None:
        self._native: _rowburst._SensorCalibration = native

    @property
    def camera_fields(self) -> dict[str, float]:
        """The arguments of a :class:`Camera` that are known now: ``camera.replace(**sensor.camera_fields)``."""
        numbers = self.numbers
        fields = {name: numbers[name] for name in ("gain_electrons_per_count", "read_noise_electrons", "full_well_counts")}
        fields["bias_counts"] = max(numbers["bias_counts"], 0.0)
        return {name: value for name, value in fields.items() if value is not None}

    @property
    def dark(self) -> NDArray[np.float32]:
        """The mean dark frame ``[y, x]`` in counts: ``dark=`` of :func:`reconstruct`."""
        return self._native.dark

    @property
    def flat(self) -> NDArray[np.float32]:
        """A flat frame ``[y, x]`` in counts, dark level included: ``flat=`` of :func:`reconstruct`."""
        return self._native.flat

    @property
    def response(self) -> NDArray[np.float32]:
        """The response to even light ``[y, x]``, mean 1."""
        return self._native.response

    @property
    def read_noise(self) -> NDArray[np.float32]:
        """The read noise of each pixel ``[y, x]`` in electrons."""
        return self._native.read_noise

    @property
    def bad_pixels(self) -> NDArray[np.bool_]:
        """Whether a pixel is bad, ``[y, x]``: ``bad_pixels=`` of :func:`reconstruct`."""
        return self._native.bad_pixels

    def __repr__(self) -> str:
        n = self.numbers
        return (
            f"<rowburst.SensorCalibration: gain {n['gain_electrons_per_count']:.3g} electrons per count, read noise "
            f"{n['read_noise_electrons']:.3g} electrons, {n['bad_pixels']} bad pixels>"
        )


def sensor(darks: _Frames, flats: _Frames, *, threads: int | None = None) -> SensorCalibration:
    """Bias, noise, gain, full well and bad pixels from dark and flat frames.

    Parameters
    ----------
    darks : array, path or list of these
        Twenty frames ``[frame, y, x]`` or more without light, at the exposure and gain of use. Paths are files, stacks or
        folders.
    flats : array, path or list of these
        Raw frames of even, steady light, two or more at each of several levels, from dim to just saturated.
    threads : int, optional
        Threads of this call alone; by default all those of the process.

    Returns
    -------
    SensorCalibration
        Its numbers, its maps and the arguments of a camera.

    Raises
    ------
    InputError
        Too few frames, or frames that show no noise or no light.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> light = np.repeat([200, 800, 3000], 4)[:, None, None]
    >>> noise = lambda n: rng.normal(100, 3, (n, 32, 32))
    >>> found = rb.calibrate.sensor(noise(20).round(), (noise(12) + rng.poisson(2 * light, (12, 32, 32)) / 2).round())
    >>> abs(found.camera_fields["gain_electrons_per_count"] - 2) < 0.2
    True
    """
    return SensorCalibration(_rowburst._SensorCalibration(frames_of(darks), frames_of(flats), threads=threads))


class PsfCalibration(_Calibration):
    """A PSF and its quality. :func:`psf` makes it."""

    _kept = ("psf", "patches")

    def __init__(self, native: _rowburst._PsfCalibration) -> None:
        self._native: _rowburst._PsfCalibration = native

    @property
    def psf(self) -> Psf:
        """The PSF for :func:`reconstruct`: the patches of the field where it needs several, else that of the reference."""
        patches = self._native.patches
        return self._native.psf if patches is None or len(patches.arrays) < 2 else patches

    def __repr__(self) -> str:
        n = self.numbers
        return f"<rowburst.PsfCalibration: contrast {n['contrast']:.2f}, grain {n['grain_px']:.2f} px, {self.psf!r}>"


def psf(
    captures: _Frames,
    *,
    dark: ArrayLike | PathLike[str] | None = None,
    camera: Camera | None = None,
    exposures_ms: Sequence[float] = (),
    positions_mm: ArrayLike | None = None,
    binning: int | None = None,
    saturation_counts: float | None = None,
    field: tuple[int, int] | None = None,
    expected_grain_px: float | None = None,
    pinhole_um: float | None = None,
    all_patches: bool = False,
    threads: int | None = None,
) -> PsfCalibration:
    """The PSF and its quality from captures of a point source; patches from several positions.

    Parameters
    ----------
    captures : array, path or list of these
        Captures of a point source. Those of one position are averaged, or merged with ``exposures_ms``. With
        ``positions_mm`` each file or array of the list has its own position.
    dark : array or path, optional
        A frame without light; by default the black level is that of the darkest parts.
    camera : Camera, optional
        The camera that the PSF is for: sensor, field, binning and saturation.
    exposures_ms : sequence of float
        The exposure of each capture in milliseconds, if they differ.
    positions_mm : array, optional
        The position ``(y, x)`` of the source in millimetres for each capture, ``[capture, 2]``.
    binning : int, optional
        Raw pixels along a side of a pixel of the working grid; by default that of the camera, or 1.
    saturation_counts : float, optional
        Counts from which on a pixel is saturated; by default those of the camera, or the end of the file's integers.
    field : tuple of int, optional
        Rows and columns of the field; by default those of the camera, or the span of the positions.
    expected_grain_px : float, optional
        Diffraction-limited grain in pixels, to compare with.
    pinhole_um : float, optional
        Diameter of the pinhole in µm: its blur is removed. The size of its image is known from the camera's pixel pitch and
        magnification, or from ``positions_mm``.
    all_patches : bool
        Whether every position has a patch, not only as many as the field needs.
    threads : int, optional
        Threads of this call alone; by default all those of the process.

    Returns
    -------
    PsfCalibration
        The PSF and its numbers: contrast, grain, ballistic light, and with positions the memory effect.

    Raises
    ------
    InputError
        Captures that are too few, too small or of different sizes.

    Examples
    --------
    >>> planned = rb.Camera(rows=96, columns=96, shutter="top-down", row_time_us=10, exposure_us=10)
    >>> capture = 100 + 40000 * rb.speckle_psf(planned, diffuser_deg=0.4).array / 1e-3
    >>> found = rb.calibrate.psf(capture, dark=np.full(capture.shape, 100))
    >>> found.psf.shape == capture.shape, found.numbers["contrast"] > 0.6
    (True, True)
    """
    # Of objects: the numbers are checked one by one, as they are given.
    positions = None if positions_mm is None else np.asarray(positions_mm, object)
    if positions is not None and (positions.ndim != 2 or positions.shape[1] != 2):
        found, rule = f"an array of shape {positions.shape}", "it is [capture, 2], a pair (y, x) for each capture"
        raise input_error("positions_mm", found, rule, "Give a list of pairs.", kind="shape")
    if camera is not None:
        check_camera(camera, takes_experiment=False)
    native = _rowburst._PsfCalibration(
        frames_of(captures),
        dark=frame_of(dark),
        camera=camera,
        exposures_ms=exposures_ms,
        positions_mm=None if positions is None else [(y, x) for y, x in positions],
        binning=binning,
        saturation_counts=saturation_counts,
        field=field,
        expected_grain_px=expected_grain_px,
        pinhole_um=pinhole_um,
        all_patches=all_patches,
        threads=threads,
    )
    return PsfCalibration(native)


class TimingCalibration(_Calibration):
    """Row time, shutter and exposure of a camera. :func:`timing` makes it."""

    _kept = ("binning",)

    def __init__(self, native: _rowburst._TimingCalibration) -> None:
        self._native: _rowburst._TimingCalibration = native

    @property
    def row_time_us(self) -> float:
        """Time from one row to the next in microseconds."""
        return float(self.numbers["row_time_us"])

    @property
    def row_time_us_error(self) -> float:
        """Its standard error."""
        return float(self.numbers["row_time_us_error"])

    @property
    def shutters(self) -> list[str]:
        """The shutters that fit the light: one, where the light decides."""
        shutters: list[str] = self.numbers["shutters"]
        return shutters

    @property
    def camera_fields(self) -> dict[str, Any]:
        """The arguments of a :class:`Camera` that are known now: ``camera.replace(**timing.camera_fields)``.

        ``shutter`` is among them where one is left, ``exposure_us`` where the light shows it.
        """
        numbers = self.numbers
        fields: dict[str, Any] = {"row_time_us": numbers["row_time_us"] * self._native.binning}
        if numbers["exposure_us"] is not None:
            fields["exposure_us"] = numbers["exposure_us"]
        if len(numbers["shutters"]) == 1 and numbers["shutters"] != ["custom"]:
            fields["shutter"] = numbers["shutters"][0]
        return fields

    def __repr__(self) -> str:
        return (
            f"<rowburst.TimingCalibration: row time {self.row_time_us:.6g} ± {self.row_time_us_error:.2g} µs, "
            f"{' or '.join(self.shutters)}>"
        )


def _parts(array: Any) -> list[Any]:
    """The frames of an array ``[frame, y, x]``; anything else is one."""
    return list(array) if getattr(array, "ndim", 2) == 3 else [array]


def timing(
    frames: _Frames,
    *,
    frequency_hz: float | None = None,
    duty: float | None = None,
    signal: ArrayLike | PathLike[str] | None = None,
    repeat: bool = False,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    camera: Camera | None = None,
    threads: int | None = None,
) -> TimingCalibration:
    """Row time, shutter and exposure from frames of a light that changes, and lights all rows at once.

    Parameters
    ----------
    frames : array, path or list of these
        Frames of the light, all of one camera setting.
    frequency_hz : float, optional
        The frequency of a light that blinks, in hertz.
    duty : float, optional
        The duty cycle of a square wave, from 0 to 1; the exposure can be measured where it is not one half.
    signal : array or path, optional
        The waveform of the light in place of a frequency: pairs ``(time_us, value)``, or a CSV file of such lines. The light
        is a straight line from each to the next.
    repeat : bool
        Whether the waveform is repeated from its last time on, instead of holding its last value.
    dark, flat : array or path, optional
        A frame without light, and one of even and steady light.
    camera : Camera, optional
        A camera whose row time is right within 30 %: it tells aliases apart.
    threads : int, optional
        Threads of this call alone; by default all those of the process.

    Returns
    -------
    TimingCalibration
        Its numbers, and the arguments of a camera.

    Raises
    ------
    InputError
        Neither a frequency nor a waveform, or frames that do not show the light.

    Examples
    --------
    >>> row = np.arange(512)[:, None] * 9.6e-6
    >>> frame = 1000 + 600 * np.sin(2 * np.pi * 2000 * row) + np.random.default_rng(2).normal(0, 8, (512, 40))
    >>> found = rb.calibrate.timing(frame, frequency_hz=2000)
    >>> abs(found.row_time_us - 9.6) < 0.02
    True
    """
    if camera is not None:
        check_camera(camera, takes_experiment=False)
    points = signal
    if signal is not None and not isinstance(signal, (str, PathLike)):
        array = np.asarray(signal, object)
        if array.ndim != 2 or array.shape[1] != 2:
            found, rule = f"an array of shape {array.shape}", "it is [point, 2], a pair (time_us, value) for each point"
            remedy = "Give a list of pairs, or the name of a CSV file."
            raise input_error("signal", found, rule, remedy, kind="shape")
        points = [(time, value) for time, value in array]
    # A list of numbers is one frame, not a list of frames.
    given: Any = frames_of(frames)
    if not isinstance(given, (str, PathLike)) and not hasattr(given, "ndim"):
        arrays = [frame if isinstance(frame, (str, PathLike)) else np.asarray(frame) for frame in given]
        # A file of several frames among the others.
        given = [part for array in arrays for part in _parts(array)]
    native = _rowburst._TimingCalibration(
        given,
        frequency_hz=frequency_hz,
        duty=duty,
        signal=points,
        repeat=repeat,
        dark=frame_of(dark),
        flat=frame_of(flat),
        camera=camera,
        threads=threads,
    )
    return TimingCalibration(native)
