"""``read_frames``: recordings as arrays."""

from __future__ import annotations

import json
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _rowburst
from ._checks import checked_whole
from ._errors import input_error
from ._extras import need
from ._makers import foreign_reader, frame_of_maker, is_of_maker, open_makers
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
        The channel of an OME-TIFF, ImageJ stack, OME-Zarr image or NDTiff dataset that has several; counted from 0. A stack
        needs tifffile, and an OME-Zarr image zarr.

    Returns
    -------
    numpy.ndarray
        ``[frame, y, x]``: integers where the files hold integers, else float32, so that each frame is what it was in the
        file.

    Raises
    ------
    InputError
        The path is missing, damaged or of another kind; the frames differ in size; a stack has several channels and
        ``channel`` is not given; or ``channel`` is none of its channels.
    WorkError
        The frames do not fit into memory.

    Examples
    --------
    >>> np.save("frames.npy", np.stack([frame, frame]))
    >>> rb.read_frames("frames.npy").shape
    (2, 24, 30)
    """
    if channel is not None:
        channel = checked_whole("channel", channel, 0, "Give the number of a channel, counted from 0, not its name.")
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
    """One channel of a TIFF stack or an OME-Zarr image, in the order of time."""
    if not path.exists():
        raise input_error(path, "no such file", "the file must exist", "Check the path.", kind="not-found")
    if path.name.lower().endswith(_TIFF):
        what, remedy = "a TIFF stack is needed", "Save or copy it again."
        tifffile = need("tifffile", "read_frames(channel=)")
        with foreign_reader(path, "tifffile", what, remedy), tifffile.TiffFile(path) as file:
            series = file.series[0]
            axes, array = list(series.axes), series.asarray()
    elif (multiscale := _multiscale(path)) is not None:
        what, remedy = "a whole OME-Zarr image is needed", "Copy it again."
        zarr = need("zarr", "read_frames(channel=)")
        with foreign_reader(path, "zarr", what, remedy):
            axes = [str(axis["name"]).upper() for axis in multiscale["axes"]]
            array = zarr.open_array(str(path / multiscale["datasets"][0]["path"]), mode="r")
    else:
        rule = f"only TIFF stacks, OME-Zarr images and NDTiff datasets have channels here, not {path}"
        raise input_error("channel", channel, rule, "Leave it out.")
    channels = dict(zip(axes, array.shape, strict=False)).get("C", 1)
    if channel >= channels:
        raise input_error("channel", channel, f"{path} has {channels} channels, counted from 0", "Give one of them.")
    with foreign_reader(path, "its reader", what, remedy):
        frames = np.asarray(array[tuple(channel if axis == "C" else slice(None) for axis in axes)])
    axes = [axis for axis in axes if axis != "C"]
    # Beside time, axes such as the depth may have one place.
    if axes[-2:] != ["Y", "X"] or sum(length > 1 for length in frames.shape[:-2]) > 1:
        rule = "the frames of a recording have one channel and one depth"
        remedy = "Save the part that you mean as a file of its own."
        raise input_error(path, f"the axes {' '.join(axes)}", rule, remedy, kind="shape")
    return np.ascontiguousarray(frames.reshape(-1, *frames.shape[-2:]))


def _multiscale(path: Path) -> dict[str, Any] | None:
    """What an OME-Zarr image says of its resolutions, from version 0.4 on; None: the path is no such image."""
    for name, place in (("zarr.json", ("attributes", "ome")), (".zattrs", ())):
        try:
            found: Any = json.loads((path / name).read_text(encoding="utf-8"))
            for key in place:
                found = found[key]
            multiscale: dict[str, Any] = found["multiscales"][0]
        except (OSError, ValueError, LookupError, TypeError):
            continue
        return multiscale
    return None
