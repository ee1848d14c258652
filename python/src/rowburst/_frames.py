"""``read_frames``: recordings as arrays."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _rowburst
from ._errors import input_error
from ._extras import need
from ._makers import is_of_maker, open_makers

_TIFF = (".tif", ".tiff", ".btf", ".tf8")


def read_frames(path: str | PathLike[str], *, channel: int | None = None) -> NDArray[Any]:
    """The frames of a recording.

    Parameters
    ----------
    path : path
        A stack (.tif, .npy, .h5, .mat, .fits, Photron .cihx), a folder of images or of stacks in the natural order of their
        names, a Zarr array ``[frame, y, x]`` or an OME-Zarr image. ``run.h5:/frames`` names an array of a file. Andor .sif,
        Hamamatsu .dcimg, PCO .b16 (a file or a folder of them) and .pcoraw need ``pip install rowburst[cameras]``.
    channel : int, optional
        The channel of an OME-TIFF or ImageJ stack that has several; counted from 0. It needs tifffile.

    Returns
    -------
    numpy.ndarray
        ``[frame, y, x]``: integers where the files hold integers, else float32, so that each frame is what it was in the
        file.

    Raises
    ------
    InputError
        The path is missing, damaged or of another kind; the frames differ in size; or a stack has several channels and
        ``channel`` is not given.
    WorkError
        The frames do not fit into memory.

    Examples
    --------
    >>> np.save("frames.npy", np.stack([frame, frame]))
    >>> rb.read_frames("frames.npy").shape
    (2, 24, 30)
    """
    if channel is not None:
        return _channel(Path(path), channel)
    if is_of_maker(Path(path)):
        return open_makers(Path(path)).frames
    return _rowburst._Frames(path).read()


def read_settings(path: str | PathLike[str]) -> dict[str, float]:
    """What the metadata of a camera maker's file tell of the camera.

    Parameters
    ----------
    path : path
        An Andor .sif, Hamamatsu .dcimg, PCO .b16 or .pcoraw file. Of all other files :class:`Experiment` takes the metadata.

    Returns
    -------
    dict
        Arguments of :class:`Camera`: ``rows``, ``columns``, and of .sif files ``exposure_us``.

    Raises
    ------
    InputError
        The file is of another kind, missing or damaged, or its reader is not installed.

    Examples
    --------
    ::

        camera = rb.Camera(shutter="dual-inside-out", row_time_us=9.6, **rb.read_settings("run.sif"))
    """
    if not is_of_maker(Path(path)):
        remedy = "Give the file to rb.Experiment as frame=, which takes its metadata."
        raise input_error(Path(path), "another kind of file", "it is a .sif, .dcimg, .b16 or .pcoraw file", remedy)
    return open_makers(Path(path)).settings


def recording_of(frames: Any) -> Any:
    """A recording that is read frame by frame: of a path; anything else is one already."""
    if not isinstance(frames, (str, PathLike)):
        return frames
    if is_of_maker(Path(frames)):
        return open_makers(Path(frames)).frames
    return _rowburst._Frames(fspath(frames))


def frame_of(frame: Any) -> Any:
    """The one frame of a camera maker's file; anything else is left as it is."""
    if not (isinstance(frame, (str, PathLike)) and is_of_maker(Path(frame))):
        return frame
    frames = open_makers(Path(frame)).frames
    if len(frames) != 1:
        remedy = "Give one of them: rb.read_frames(path)[0]; or use rb.batch."
        raise input_error(Path(frame), f"{len(frames)} frames", "a frame is [y, x]", remedy, kind="shape")
    return frames[0]


def _channel(path: Path, channel: int) -> NDArray[Any]:
    """One channel of a TIFF stack, in the order of time."""
    if not path.name.lower().endswith(_TIFF):
        raise input_error("channel", channel, f"only TIFF stacks have channels here, not {path}", "Leave it out.")
    tifffile = need("tifffile", "read_frames(channel=)")
    try:
        with tifffile.TiffFile(path) as file:
            series = file.series[0]
            axes, array = series.axes, series.asarray()
    except (OSError, ValueError) as error:
        found = f"a file that tifffile cannot read ({error})"
        raise input_error(path, found, "a TIFF stack is needed", "Save or copy it again.", kind="unreadable") from error
    channels = dict(zip(axes, array.shape, strict=True)).get("C", 1)
    if not 0 <= channel < channels:
        raise input_error("channel", channel, f"{path} has {channels} channels, counted from 0", "Give one of them.")
    if "C" in axes:
        array = np.take(array, channel, axis=axes.index("C"))
        axes = axes.replace("C", "")
    if array.ndim > 3 or not axes.endswith("YX"):
        rule = "the frames of a recording have one channel and one depth"
        remedy = "Save the part that you mean as a file of its own."
        raise input_error(path, f"the axes {axes}", rule, remedy, kind="shape")
    return np.ascontiguousarray(array.reshape(-1, *array.shape[-2:]))
