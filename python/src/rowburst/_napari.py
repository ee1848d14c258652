"""The napari plugin: reads results and archives, has a sample, and reconstructs the frame of a layer."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _load, _reconstruct, _rowburst
from ._errors import input_error
from ._extras import need

if TYPE_CHECKING:
    from ._video import VideoResult

# Units of the axes of a video.
_UNITS = ("microsecond", "pixel", "pixel")
# Data, options and kind of a layer, as napari takes it.
Layer = tuple[Any, dict[str, Any], str]


def get_reader(path: str | list[str]) -> Callable[[str | list[str]], list[Layer]] | None:
    """The reader of result folders, their result.json, and archives; None for all other paths."""
    first = _folder(path[0] if isinstance(path, list) else path)
    if (first / "result.json").is_file() and (first / "video.npy").is_file():
        return _of_all(_result_layers)
    if (first / "rowburst" / "job.json").is_file():
        return _of_all(_archive_layers)
    return None


def _of_all(layers: Callable[[Path], list[Layer]]) -> Callable[[str | list[str]], list[Layer]]:
    def read(path: str | list[str]) -> list[Layer]:
        paths = path if isinstance(path, list) else [path]
        return [layer for one in paths for layer in layers(_folder(one))]

    return read


def _folder(path: str) -> Path:
    """The folder of a result that is named by its result.json."""
    return Path(path).parent if Path(path).name == "result.json" else Path(path)


def _axes(result: VideoResult) -> dict[str, Any]:
    """Scale, place, units and labels of the axes of a video. The first is in microseconds; the others are pixels of the
    sensor, on which the layer of the frame lies."""
    time_us = result.time_us
    bin_us = float(time_us[1] - time_us[0]) if len(time_us) > 1 else 1.0
    first_row, first_column = result._first_pixel
    place = (float(time_us[0]), float(first_row), float(first_column))
    return {"scale": (bin_us, 1.0, 1.0), "translate": place, "units": _UNITS, "axis_labels": ("t", "y", "x")}


def _video_layer(result: VideoResult, name: str) -> Layer:
    """A video, whose first axis is in microseconds."""
    options = _axes(result) | {
        "name": name,
        "contrast_limits": (0.0, float(result.video.max()) or 1.0),
        "metadata": {"rowburst": result.numbers},
    }
    return result.video, options, "image"


def _result_layers(folder: Path) -> list[Layer]:
    result = _load.SavedResult(folder)
    layers = [_video_layer(result, f"{folder.name}: video")]
    if (folder / "view-frame.npy").is_file():
        layers.append((result.frame, {"name": f"{folder.name}: frame", "visible": False}, "image"))
    if result.background is not None:
        options = {"name": f"{folder.name}: background", "visible": False} | _axes(result)
        layers.append((result.background, options, "image"))
    return layers


def _archive_layers(folder: Path) -> list[Layer]:
    """The videos ``[frame, t, y, x]`` of a batch, which are read when they are looked at."""
    zarr = need("zarr", "the napari reader")
    group = zarr.open_group(str(folder), mode="r")
    video = group["0"]
    scales = group.attrs["ome"]["multiscales"][0]["datasets"][0]["coordinateTransformations"]
    scale = next(entry["scale"] for entry in scales if entry["type"] == "scale")
    # Archives of 0.1 have none.
    origin = next((entry["translation"] for entry in scales if entry["type"] == "translation"), [0.0] * len(scale))
    job = json.loads((folder / "rowburst" / "job.json").read_text(encoding="utf-8"))
    axes = group.attrs["ome"]["multiscales"][0]["axes"]
    options = {
        "name": folder.stem,
        "scale": scale,
        "translate": origin,
        "units": [axis.get("unit", "pixel") for axis in axes],
        "axis_labels": [axis["name"] for axis in axes],
        "metadata": {"rowburst": job},
    }
    return [(video, options, "image")]


def sample() -> list[Layer]:
    """A simulated frame; its camera and PSF are the metadata of the layer."""
    camera = _rowburst.Camera(rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    made = _rowburst.simulate(camera, "digits")
    metadata = {"rowburst_camera": made.camera, "rowburst_psf": made.psf}
    return [(made.frame, {"name": "simulated frame", "metadata": metadata}, "image")]


def reconstruct_frame(
    frame: Any, metadata: dict[str, Any], experiment: Path | None = None, prior: str = "", name: str = "frame"
) -> Layer:
    """The video of the frame of a layer, by an experiment file or by the camera and PSF of its metadata."""
    if experiment is not None and experiment.is_file():
        camera: Any = _rowburst.Experiment(experiment)
        psf = None
    elif "rowburst_camera" in metadata:
        camera, psf = metadata["rowburst_camera"], metadata["rowburst_psf"]
    else:
        rule = "an experiment file says camera and PSF"
        remedy = "Choose an experiment file, as `rowburst init` writes it."
        raise input_error("experiment", repr(str(experiment)), rule, remedy, kind="missing")
    result = _reconstruct.reconstruct(np.asarray(frame), camera, psf, prior=prior or None)
    return _video_layer(result, f"{name}: video, the fit is {result.fit}")


def reconstruct_widget() -> Any:
    """The widget: a layer, an experiment file, a prior; the run does not block the window."""
    from magicgui import magicgui
    from napari.layers import Image
    from napari.qt.threading import FunctionWorker, thread_worker
    from napari.types import LayerDataTuple

    def reconstruct(frame: Image, experiment: Path = Path("experiment.toml"), prior: str = "") -> Any:
        run = thread_worker(reconstruct_frame, progress=True)
        worker = run(frame.data, frame.metadata, experiment, prior, frame.name)
        worker.start()
        return worker

    reconstruct.__annotations__ = {
        "frame": Image,
        "experiment": Path,
        "prior": str,
        "return": FunctionWorker[LayerDataTuple],
    }
    return magicgui(
        reconstruct,
        call_button="Reconstruct",
        experiment={"filter": "*.toml", "tooltip": "camera, PSF and prior; a sample brings its own"},
        prior={"tooltip": "such as tv; empty: the experiment's, or auto"},
    )
