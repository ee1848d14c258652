"""Files that packages of PyPI read: Andor .sif, Hamamatsu .dcimg, PCO .b16 and .pcoraw, NDTiff of Micro-Manager."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._errors import input_error
from ._extras import need
from ._ndtiff import is_ndtiff, read_ndtiff
from ._rowburst import InputError, WorkError


@dataclass(frozen=True)
class MakersFile:
    """The frames ``[frame, y, x]`` of a file, and what its metadata tell of the camera."""

    frames: NDArray[Any]
    settings: dict[str, Any]
    """Arguments of a Camera, and ``frame_period_us``."""
    record: str | None = None
    """The record of Micro-Manager, as JSON."""


def is_of_maker(path: Path) -> bool:
    """Whether a path is a file of a camera maker, a folder of .b16 files, or an NDTiff dataset."""
    return path.suffix.lower() in _READERS or is_ndtiff(path) or bool(_b16_files(path))


def open_makers(path: Path) -> MakersFile:
    """The content of a file of a camera maker.

    Raises
    ------
    InputError
        The package that reads it is not installed, or the file is missing or damaged.
    """
    if not path.exists():
        raise input_error(path, "no such file", "the file must exist", "Check the path.", kind="not-found")
    if is_ndtiff(path):
        data = read_ndtiff(path)
        _, rows, columns = data.frames.shape
        return MakersFile(data.frames, {"rows": rows, "columns": columns}, data.record)
    reader = _READERS[".b16"] if path.is_dir() else _READERS[path.suffix.lower()]
    what = "whole .b16 files are needed" if path.is_dir() else f"a whole {path.suffix} file is needed"
    remedy = "Copy it again, or save it as TIFF by the camera's software."
    with foreign_reader(path, "its reader", what, remedy):
        found = reader(path)
        _, rows, columns = found.frames.shape
    return MakersFile(found.frames, {"rows": rows, "columns": columns} | found.settings)


@contextlib.contextmanager
def foreign_reader(path: Path, reader: str, rule: str, remedy: str) -> Iterator[None]:
    """Names the file where a package that reads it fails. Packages raise whatever their code meets in a damaged file."""
    try:
        yield
    except (InputError, WorkError, MemoryError):
        raise
    except Exception as error:
        found = f"a file that {reader} cannot read ({type(error).__name__}: {error})"
        raise input_error(path, found, rule, remedy, kind="unreadable") from error


def frame_of_maker(path: Path) -> NDArray[Any]:
    """The one frame ``[y, x]`` of a file of a camera maker."""
    frames = open_makers(Path(path)).frames
    if len(frames) != 1:
        remedy = "Give one of them: rb.read_frames(path)[0]; or use rb.batch."
        raise input_error(Path(path), f"{len(frames)} frames", "a frame is [y, x]", remedy, kind="shape")
    frame: NDArray[Any] = frames[0]
    return frame


def metadata_of_maker(path: Path) -> tuple[dict[str, Any], str | None]:
    """The settings of a file of a camera maker, and the record of Micro-Manager, if there is one."""
    found = open_makers(Path(path))
    return found.settings, found.record


def _counts(values: NDArray[np.floating[Any]]) -> NDArray[Any]:
    """Counts that a file holds as floating-point numbers, as the integers that they are."""
    if values.size and values.min() >= 0 and values.max() <= np.iinfo(np.uint16).max:
        whole = values.astype(np.uint16)
        if np.array_equal(whole, values):
            return whole
    return np.asarray(values, np.float32)


def _read_sif(path: Path) -> MakersFile:
    parser = need("sif_parser", "a .sif file")
    values, info = parser.np_open(str(path))
    settings: dict[str, Any] = {}
    for name, key in ("exposure_us", "ExposureTime"), ("frame_period_us", "CycleTime"):
        seconds = float(info.get(key, 0))
        if seconds > 0:
            settings[name] = round(1e6 * seconds, 6)
    if info.get("xbin", 1) == info.get("ybin", 1) > 1:
        settings["binning"] = int(info["xbin"])
    return MakersFile(_counts(values), settings)


class _Header(np.ndarray[Any, Any]):
    """A header of one record whose fields convert to int, which NumPy 2.4 no longer does."""

    def __int__(self) -> int:
        return int(self.item())


def _read_dcimg(path: Path) -> MakersFile:
    base: Any = need("dcimg", "a .dcimg file").DCIMGFile

    class File(base):  # type: ignore[misc]
        """dcimg 0.6 with the conversions of its headers that NumPy 2.4 refuses."""

        def __setattr__(self, name: str, value: Any) -> None:
            if isinstance(value, np.ndarray):
                if name in ("x0", "y0"):
                    value = int(value.item())
                elif value.dtype.names:
                    value = value.view(_Header)
            super().__setattr__(name, value)

    file = File(path)
    file.deep_copy_enabled = True
    try:
        frames = np.ascontiguousarray(np.asarray(file[:, :, :]).reshape(file.shape))
    finally:
        file.close()
    return MakersFile(frames, {})


def _b16_files(path: Path) -> list[Path]:
    """The .b16 files of a folder, in the natural order of their names."""
    if not path.is_dir():
        return []
    files = [file for file in path.iterdir() if file.suffix.lower() == ".b16"]
    return sorted(files, key=lambda file: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)])


def _read_b16(path: Path) -> MakersFile:
    reader = need("pco_tools.pco_reader", "a .b16 file")
    frames = []
    for file in _b16_files(path) or [path]:
        # It prints what is wrong, and returns None.
        with contextlib.redirect_stdout(io.StringIO()) as words:
            frame = reader.load(str(file))
        if frame is None:
            raise ValueError(f"{file.name}: {words.getvalue().strip()}")
        frames.append(frame)
    return MakersFile(np.stack(frames), {})


def _read_pcoraw(path: Path) -> MakersFile:
    tifffile = need("tifffile", "a .pcoraw file")
    with tifffile.TiffFile(path) as file:
        frames = [page.asarray() for page in file.pages]
    return MakersFile(np.stack(frames), {})


_READERS: dict[str, Callable[[Path], MakersFile]] = {
    ".sif": _read_sif,
    ".dcimg": _read_dcimg,
    ".b16": _read_b16,
    ".pcoraw": _read_pcoraw,
}
