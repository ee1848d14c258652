"""NDTiff, the datasets of Micro-Manager and Pycro-Manager, read by the package ndtiff of PyPI."""

from __future__ import annotations

import contextlib
import io
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._errors import input_error
from ._extras import need

# An image of several of these is not a frame of one recording.
_SPLIT = ("channel", "z", "position", "row", "column")


@dataclass(frozen=True)
class NdTiff:
    """The frames ``[frame, y, x]`` of a dataset, and the record of Micro-Manager of its first image, as JSON."""

    frames: NDArray[Any]
    record: str


def is_ndtiff(path: Path) -> bool:
    """Whether a path is the folder of an NDTiff dataset."""
    return (path / "NDTiff.index").is_file()


def read_ndtiff(path: Path, channel: int | None = None) -> NdTiff:
    """The frames of a dataset in the order of time, of one channel."""
    ndtiff = need("ndtiff", "an NDTiff dataset")
    try:
        # It prints what it does.
        with contextlib.redirect_stdout(io.StringIO()):
            data = ndtiff.Dataset(str(path))
        try:
            return _read(path, data, channel)
        finally:
            data.close()
    except (OSError, EOFError, struct.error, ValueError, LookupError, TypeError, AttributeError) as error:
        if getattr(error, "kind", None) is not None:
            raise
        found = f"a dataset that ndtiff cannot read ({type(error).__name__}: {error})"
        raise input_error(path, found, "a whole NDTiff dataset is needed", "Copy it again.", kind="unreadable") from error


def _read(path: Path, data: Any, channel: int | None) -> NdTiff:
    axes = {name: sorted(values) for name, values in data.axes.items()}
    fixed: dict[str, Any] = {}
    channels = axes.pop("channel", [None])
    if len(channels) > 1 and channel is None:
        rule = "the frames of a recording are of one channel"
        remedy = "Name one: rb.read_frames(path, channel=0)."
        raise input_error(path, f"{len(channels)} channels", rule, remedy, kind="shape")
    chosen = channel or 0
    if not 0 <= chosen < len(channels):
        raise input_error("channel", channel, f"{path} has {len(channels)} channels, counted from 0", "Give one of them.")
    if channels[chosen] is not None:
        fixed["channel"] = channels[chosen]
    for name, values in axes.items():
        if name in _SPLIT and len(values) > 1:
            rule = "the frames of a recording have one depth and one position"
            remedy = "Save the part that you mean as a dataset of its own."
            raise input_error(path, f"{len(values)} values of the axis {name}", rule, remedy, kind="shape")
    along = [name for name, values in axes.items() if len(values) > 1]
    if len(along) > 1:
        rule = "a recording has one axis beside y and x"
        raise input_error(path, f"the axes {', '.join(along)}", rule, "Save one of them as a dataset of its own.", kind="shape")
    fixed |= {name: values[0] for name, values in axes.items()}
    places = [fixed | {along[0]: value} for value in axes[along[0]]] if along else [fixed]
    places = [place for place in places if data.has_image(**place)]
    frames = np.stack([np.asarray(data.read_image(**place)) for place in places])
    record = {**(data.summary_metadata or {}), **(data.read_metadata(**places[0]) or {})}
    return NdTiff(frames, json.dumps(record, default=str))
