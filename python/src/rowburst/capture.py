"""Frames of cameras with their settings: recordings played back, Micro-Manager, and anything that yields arrays.

Tried on emulated cameras alone.

>>> np.save("frames.npy", np.full((3, 24, 30), 100, np.uint16))
>>> camera = rb.capture.open("play:frames.npy?rate=max")
>>> [int(frame.image.max()) for frame in camera]
[100, 100, 100]
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _rowburst
from ._errors import input_error
from ._rowburst import LiveView, Look, WorkError

__all__ = ["Capture", "CapturedFrame", "Property", "from_arrays", "from_mmcore", "open"]


@dataclass(frozen=True)
class Property:
    """A property of a camera, as its driver names it."""

    name: str
    #: ``None`` where it is unknown.
    value: str | None
    #: ``"read"``, ``"calculated"`` or ``"unknown"``.
    origin: str = "read"


@dataclass(frozen=True, repr=False)
class CapturedFrame:
    """A frame of a camera."""

    #: Counts ``[y, x]``, ``uint16``; ``y`` is the axis that the shutter scans.
    image: NDArray[np.uint16]
    #: Number of the frame as the source counts; a gap is a dropped frame.
    number: int
    #: On the clock of the source, in microseconds.
    time_us: int | None
    #: What is wrong with the frame; ``None`` where it is whole.
    incomplete: str | None = None

    def __repr__(self) -> str:
        rows, columns = self.image.shape
        fault = "" if self.incomplete is None else f", incomplete: {self.incomplete}"
        return f"<rowburst.CapturedFrame {self.number}: {rows}×{columns}{fault}>"


#: Number, time, counts, fault and last number, as the extension gives them.
_Delivery = tuple[int, int | None, NDArray[np.uint16] | None, str | None, int]


class Capture(Iterator[CapturedFrame]):
    """The frames of a source, one after the other. :func:`open`, :func:`from_mmcore` and :func:`from_arrays` make it."""

    def __init__(
        self,
        name: str,
        settings: list[Property],
        deliveries: Iterator[_Delivery],
        *,
        camera: str | None = None,
        skip: Callable[[], int] | None = None,
    ) -> None:
        #: What a user calls the source.
        self.name = name
        #: Model and serial number, where they are known.
        self.camera = camera
        #: The settings of the camera at the start.
        self.settings = settings
        #: First number, last number and reason of frames that never arrived.
        self.lost: list[tuple[int, int, str]] = []
        self._deliveries = deliveries
        self._skip = skip

    def __repr__(self) -> str:
        camera = "" if self.camera is None else f", {self.camera}"
        return f"<rowburst.Capture of {self.name}{camera}: {len(self.settings)} settings, {len(self.lost)} gaps so far>"

    def __next__(self) -> CapturedFrame:
        for number, time_us, image, fault, last in self._deliveries:
            if image is None:
                self.lost.append((number, last, fault or ""))
            else:
                return CapturedFrame(image, number, time_us, fault)
        raise StopIteration

    def _tuples(self) -> list[tuple[str, str | None, str]]:
        return [(p.name, p.value, p.origin) for p in self.settings]

    @property
    def reading(self) -> dict[str, Any]:
        """What the settings mean: row time, shutter and so on, with ``provenance`` and ``findings``."""
        reading: dict[str, Any] = json.loads(_rowburst._read_properties(self.name, self._tuples(), self.camera))
        return reading

    @property
    def experiment(self) -> str:
        """The text of an experiment file with these settings; each number says where it comes from."""
        return str(self.reading["experiment"])

    def watch(
        self, live: LiveView, *, time_budget_s: float | None = 0.1
    ) -> Iterator[tuple[CapturedFrame, Look]]:
        """The video of the latest frame, again and again: frames that come while the solver is busy are left out.

        Parameters
        ----------
        live : LiveView
            A live view with the camera and the PSF of the frames.
        time_budget_s : float, optional
            Time of the solver for a frame.

        Yields
        ------
        CapturedFrame, Look
            A whole frame and its video, which goes on from the one before.

        Raises
        ------
        InputError
            The time budget is no number, or a frame is not one of the live view's camera.

        Examples
        --------
        >>> counts = np.rint(1000 * frame / frame.max()).astype(np.uint16)
        >>> source = rb.capture.from_arrays([counts, counts], name="bench")
        >>> live = rb.LiveView(camera, psf)
        >>> [look.video.shape for _, look in source.watch(live)]
        [(12, 24, 30), (12, 24, 30)]
        """
        while True:
            if self._skip is not None:
                self._skip()
            frame = next(self, None)
            if frame is None:
                return
            if frame.incomplete is None:
                yield frame, live.next(frame.image, time_budget_s=time_budget_s)

    def close(self) -> None:
        """End the acquisition.

        Examples
        --------
        >>> camera = rb.capture.from_arrays(np.full((3, 24, 30), 100, np.uint16))
        >>> first = next(camera)
        >>> camera.close()
        """
        close = getattr(self._deliveries, "close", None)
        if close is not None:
            close()

    def record(self, path: str | PathLike[str], count: int | None = None, *, purpose: str = "record") -> dict[str, Any]:
        """Record ``count`` frames, or all, as a 16-bit TIFF stack with ``NAME.json`` beside it.

        Parameters
        ----------
        path : path
            A ``.tif`` that does not exist yet.
        count : int, optional
            Number of frames.
        purpose : str
            ``"record"``; ``"darks"``, ``"flats"``, ``"psf"`` and ``"timing"`` leave incomplete frames out.

        Returns
        -------
        dict
            The record, as in the file: ``written``, ``dropped``, ``incomplete``, ``lost``, ``warnings``.

        Raises
        ------
        InputError
            Settings with which frames are of no use, such as a global shutter, or a file that exists.
        WorkError
            No frame, or a disk that is full: the frames before it are kept.

        Examples
        --------
        >>> camera = rb.capture.from_arrays(np.full((3, 24, 30), 100, np.uint16))
        >>> camera.record("record.tif", 2)["written"]
        2
        """
        recorder = _rowburst._Recorder(path, purpose, self.name, self._tuples(), count, self.camera)
        ended, written = "source", 0
        try:
            while count is None or written < count:
                delivery = next(self._deliveries, None)
                if delivery is None:
                    break
                recorder.take(*delivery)
                written += delivery[2] is not None and (delivery[3] is None or purpose == "record")
            else:
                ended = "complete"
        except (KeyboardInterrupt, Exception) as error:
            try:
                recorder.finish("interrupted" if isinstance(error, KeyboardInterrupt) else str(error))
            except WorkError:
                # Without a frame nothing is kept, and what ended it is the error.
                if written:
                    raise
            raise
        record: dict[str, Any] = json.loads(recorder.finish(ended))
        return record


def open(source: str) -> Capture:  # noqa: A001
    """The frames of ``source``: ``play:PATH`` plays a recording back, ``genicam:ADDRESS`` is a camera on the network.

    Parameters
    ----------
    source : str
        ``play:PATH``: a TIFF stack, ``.npy``, a folder of images, or Zarr, at its own pace. ``play:PATH?rate=HZ`` plays
        it at another, ``?rate=max`` as fast as it goes, ``&loop`` again and again. ``genicam:ADDRESS`` and
        ``genicam:SERIAL`` need a package that was built with ``maturin build --features genicam``.

    Raises
    ------
    InputError
        A kind of source that does not exist, or a recording that cannot be read.

    Returns
    -------
    Capture
        The frames, one after the other, and the camera's settings.

    Examples
    --------
    >>> np.save("frames.npy", np.full((3, 24, 30), 100, np.uint16))
    >>> next(rb.capture.open("play:frames.npy?rate=max")).image.shape
    (24, 30)
    """
    frames = _rowburst._Source(source)
    settings = json.loads(frames.settings())

    def deliveries() -> Iterator[_Delivery]:
        while (delivery := frames.next()) is not None:
            yield delivery

    properties = [Property(**p) for p in settings["properties"]]
    return Capture(source, properties, deliveries(), camera=settings["camera"], skip=frames.skip_to_latest)


def from_arrays(
    frames: Iterable[Any],
    settings: Mapping[str, object] | None = None,
    *,
    name: str = "arrays",
    camera: str | None = None,
) -> Capture:
    """The frames of anything that yields arrays ``[y, x]`` of counts.

    Parameters
    ----------
    frames : iterable of arrays
        Unsigned integers of up to 16 bits.
    settings : mapping, optional
        Names and values of the camera's properties; keys of the experiment file, such as ``row_time_us``, are known, too.
    name : str
        What errors call the source.
    camera : str, optional
        Model and serial number of the camera, for the record.

    Returns
    -------
    Capture
        The frames, one after the other, and the settings.

    Raises
    ------
    InputError
        A frame of another type or shape, when it is taken.

    Examples
    --------
    >>> frames = np.full((2, 24, 30), 100, np.uint16)
    >>> camera = rb.capture.from_arrays(frames, {"row_time_us": 9.6, "shutter": "dual-inside-out"})
    >>> len(list(camera)), camera.reading["row_time_us"]
    (2, 9.6)
    """
    start = time.monotonic()

    def deliveries() -> Iterator[_Delivery]:
        for number, frame in enumerate(frames):
            yield number, int(1e6 * (time.monotonic() - start)), _counts(frame, name, number), None, number

    properties = [_property(key, value) for key, value in (settings or {}).items()]
    return Capture(name, properties, deliveries(), camera=camera)


def from_mmcore(core: Any, *, camera: str | None = None, stream: bool = False) -> Capture:
    """The camera of a Micro-Manager core: ``pymmcore.CMMCore``, ``pymmcore_plus.CMMCorePlus`` or the like.

    The properties of the camera device are its settings: those of Andor SDK3, PCO, Hamamatsu DCAM and PVCAM that give
    row time and readout order are known.

    Parameters
    ----------
    core : CMMCore
        A core whose camera is set up.
    camera : str, optional
        Label of the camera; by default that of the core.
    stream : bool
        Frames of one sequence acquisition, at the camera's own rate, from the first frame that is asked for until
        :meth:`Capture.close`. A gap in the camera's frame numbers, or a full buffer of the core, is told as dropped
        frames. Otherwise every frame is snapped by itself when it is asked for, and none is dropped.

    Returns
    -------
    Capture
        The frames, one after the other, and the camera's settings.

    Raises
    ------
    InputError
        The core has no camera.

    Examples
    --------
    ::

        core = pymmcore_plus.CMMCorePlus.instance()
        core.loadSystemConfiguration("zyla.cfg")
        record = rb.capture.from_mmcore(core).record("run.tif", 100)
    """
    label = camera or core.getCameraDevice()
    if not label:
        rule = "the core has a camera"
        raise input_error("core", "no camera", rule, "Load one: core.setCameraDevice(label).", kind="missing")
    if camera is not None:
        core.setCameraDevice(camera)
    names = core.getDevicePropertyNames(label)
    properties = [_property(str(name), core.getProperty(label, name)) for name in names]
    known = {p.name: p.value for p in properties}
    if "Exposure" not in known:
        properties.append(_property("Exposure", core.getExposure()))
    left, top, columns, rows = core.getROI()
    for key, value in (("rows", rows), ("columns", columns), ("top", top), ("left", left)):
        properties.append(_property(key, value))
    bits = core.getImageBitDepth()
    if "BitDepth" not in known and bits < 16:
        properties.append(_property("BitDepth", bits))
    # Adapter and device, and what tells two cameras of a kind apart.
    parts = [core.getDeviceLibrary(label), core.getDeviceName(label), known.get("CameraID"), known.get("SerialNumber")]
    identity = " ".join(str(part) for part in parts if part)
    if not stream:
        return Capture(f"mmcore:{label}", properties, _snapped(core, label), camera=identity)
    frames = _Streamed(core, label)
    return Capture(f"mmcore:{label}", properties, frames.deliveries(), camera=identity, skip=frames.skip)


def _snapped(core: Any, label: str) -> Iterator[_Delivery]:
    start, number = time.monotonic(), 0
    while True:
        core.snapImage()
        yield number, int(1e6 * (time.monotonic() - start)), _counts(core.getImage(), label, number), None, number
        number += 1


#: Time between two looks for an image of a sequence.
_NAP_S = 0.001


class _Streamed:
    """The images of a sequence acquisition with the camera's numbers."""

    def __init__(self, core: Any, label: str) -> None:
        self.core, self.label = core, label
        self.expected: int | None = None

    def deliveries(self) -> Iterator[_Delivery]:
        core = self.core
        core.startContinuousSequenceAcquisition(0)
        try:
            while True:
                if core.getRemainingImageCount() == 0:
                    if core.isBufferOverflowed():
                        # The sequence has stopped: how many are lost is not known, but that some are.
                        yield from self.restarted()
                    elif not core.isSequenceRunning():
                        return
                    time.sleep(_NAP_S)
                    continue
                yield from self.popped()
        finally:
            if core.isSequenceRunning():
                core.stopSequenceAcquisition()

    def popped(self) -> Iterator[_Delivery]:
        image, tags = _pop(self.core)
        number = int(tags.get("ImageNumber", self.expected or 0))
        if self.expected is not None and number > self.expected:
            yield self.expected, None, None, "dropped", number - 1
        self.expected = number + 1
        elapsed = tags.get("ElapsedTime-ms")
        time_us = None if elapsed is None else int(1e3 * float(elapsed))
        yield number, time_us, _counts(image, self.label, number), None, number

    def restarted(self) -> Iterator[_Delivery]:
        first = self.expected or 0
        yield first, None, None, "the buffer of the core was full: take frames faster or set a larger one", first
        self.core.stopSequenceAcquisition()
        self.expected = None
        self.core.startContinuousSequenceAcquisition(0)

    def skip(self) -> int:
        """Leaves all waiting images out but the last; how many."""
        count = max(0, int(self.core.getRemainingImageCount()) - 1)
        for _ in range(count):
            _, tags = _pop(self.core)
            self.expected = int(tags.get("ImageNumber", self.expected or 0)) + 1
        return count


def _pop(core: Any) -> tuple[Any, Mapping[str, Any]]:
    """The oldest image of a sequence, and its tags."""
    if hasattr(core, "popNextImageAndMD"):
        # pymmcore-plus
        image, tags = core.popNextImageAndMD()
        return image, dict(tags)
    from pymmcore import Metadata

    metadata = Metadata()
    image = core.popNextImageMD(metadata)
    keys = metadata.GetKeys()
    return image, {key: metadata.GetSingleTag(key).GetValue() for key in keys}


def _property(name: str, value: object) -> Property:
    """A property as the driver gives it: read, or calculated by the driver."""
    return Property(name, str(value), _rowburst._property_origin(name))


def _counts(frame: Any, name: str, number: int) -> NDArray[np.uint16]:
    """The frame as counts of 16 bits."""
    array = np.asarray(frame)
    if array.ndim != 2 or array.dtype not in (np.uint8, np.uint16):
        found = f"frame {number} of type {array.dtype} and shape {array.shape}"
        rule = "a frame is an array [y, x] of uint8 or uint16"
        raise input_error(name, found, rule, "Set the camera to 16-bit grey; do not correct or average.", kind="unsupported")
    return np.ascontiguousarray(array, np.uint16)
