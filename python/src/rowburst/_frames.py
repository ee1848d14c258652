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
from ._makers import frame_of_maker, is_of_maker, open_makers
from ._ndtiff import is_ndtiff, read_ndtiff

_TIFF = (".tif", ".tiff", ".btf", ".tf8")


def read_frames(path: str | PathLike[str], *, channel: int | None = None) -> NDArray[Any]:
    """The frames of a recording.

    Parameters
    ----------
    path : path
        A stack (.tif, .npy, .h5, .mat, .fits, Photron .cihx), a folder of images or of stacks in the natural order of their
        names, a Zarr array ``[frame, y, x]`` or an OME-Zarr image. ``run.h5:/frames`` names an array of a file. Andor .sif,
        Hamamatsu .dcimg, PCO .b16 (a file or a folder of them) and .pcoraw need ``pip install rowburst[cameras]``; the
        folder of an NDTiff dataset needs ``pip install rowburst[ndtiff]``.
    channel : int, optional
        The channel of an OME-TIFF, ImageJ stack or NDTiff dataset that has several; counted from 0. A stack needs tifffile.

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
    if is_ndtiff(Path(path)):
        return read_ndtiff(Path(path), channel).frames
    if channel is not None:
        return _channel(Path(path), channel)
    if is_of_maker(Path(path)):
        return open_makers(Path(path)).frames
    return _rowburst._Frames(path).read()


def read_settings(path: str | PathLike[str]) -> dict[str, Any]:
    """What the metadata of a frame or a recording tell of the camera.

    Known are Micro-Manager (TIFF tags, ``metadata.txt``, NDTiff), OME-XML, Andor (TIFF tags, Solis text, .sif), FITS,
    Photron, and the records of ``rowburst capture``.

    Parameters
    ----------
    path : path
        A file, or a folder of them.

    Returns
    -------
    dict
        Arguments of :class:`Camera`, as far as they are known: ``rows``, ``columns``, ``shutter``, ``row_time_us``,
        ``exposure_us``, ``binning``, ``bit_depth``, ``pixel_pitch_um``, ``bayer``. Empty where the file says nothing.

    Raises
    ------
    InputError
        A file of a camera maker that is missing or damaged, or whose reader is not installed.

    Examples
    --------
    >>> np.save("frames.npy", np.stack([frame, frame]))
    >>> rb.read_settings("frames.npy")
    {}

    The settings fill a camera; what they lack is given beside them::

        camera = rb.Camera(**rb.read_settings("run.ome.tif"))
        camera = rb.Camera(shutter="dual-inside-out", row_time_us=9.6, **rb.read_settings("run.sif"))
    """
    if not Path(path).exists():
        raise input_error(Path(path), "no such file", "the file must exist", "Check the path.", kind="not-found")
    settings, _, _ = _rowburst._metadata(path)
    settings.pop("frame_period_us", None)
    return settings


def recording_of(frames: Any) -> Any:
    """A recording that is read frame by frame: of a path; anything else is one already."""
    if not isinstance(frames, (str, PathLike)):
        return frames
    if is_of_maker(Path(frames)):
        return open_makers(Path(frames)).frames
    return _rowburst._Frames(fspath(frames))


def frames_of(value: Any) -> Any:
    """Paths of camera makers' files as arrays, also in a list; anything else is left as it is."""
    if isinstance(value, (str, PathLike)):
        return open_makers(Path(value)).frames if is_of_maker(Path(value)) else value
    if isinstance(value, (list, tuple)):
        return [frames_of(part) for part in value]
    return value


def frame_of(frame: Any) -> Any:
    """The one frame of a camera maker's file; anything else is left as it is."""
    is_path = isinstance(frame, (str, PathLike))
    return frame_of_maker(Path(frame)) if is_path and is_of_maker(Path(frame)) else frame


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
