"""What notebooks show of values: small tables and pictures, as HTML that fetches nothing."""

from __future__ import annotations

import struct
import zlib
from base64 import b64encode
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ._colour_video import ColourVideo
    from ._rowburst import Camera, Psf, Simulation
    from ._video import VideoResult

# Largest side of a picture; larger ones are thinned out.
_MAX_SIDE = 240


def _png(picture: NDArray[Any]) -> bytes:
    """An image ``[y, x]`` in grey, or ``[y, x, colour]``, as a PNG of 8 bits, from 0 to its maximum."""
    step = -(-max(picture.shape[:2]) // _MAX_SIDE)
    picture = np.asarray(picture[::step, ::step], float)
    top = picture.max() or 1.0
    values = np.clip(255 * picture / top, 0, 255).astype(np.uint8)
    rows, columns = values.shape[:2]
    lines = np.hstack([np.zeros((rows, 1), np.uint8), values.reshape(rows, -1)]).tobytes()
    # The kind of a PNG: grey, or red, green and blue.
    kind = 0 if values.ndim == 2 else 2

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", columns, rows, 8, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")


def _image(picture: NDArray[Any], caption: str) -> str:
    data = b64encode(_png(picture)).decode()
    return (
        '<figure style="display:inline-block;margin:0.3em 0.6em 0.3em 0">'
        f'<img src="data:image/png;base64,{data}" alt="{escape(caption)}" '
        f'style="min-width:120px;image-rendering:pixelated"><figcaption>{escape(caption)}</figcaption></figure>'
    )


def table_html(title: str, rows: Mapping[Any, object]) -> str:
    """A table of names and values."""
    lines = "".join(
        f'<tr><th style="text-align:left">{escape(str(name))}</th><td style="text-align:left">{escape(str(value))}</td></tr>'
        for name, value in rows.items()
        if value is not None
    )
    return f"<div><strong>{escape(title)}</strong><table>{lines}</table></div>"


def camera_html(camera: Camera) -> str:
    """A camera as a table."""
    bins, rows, columns = camera.video_shape
    rows_of_table = {
        "sensor": f"{camera.rows}×{camera.columns} pixels" + (f", binned by {camera.binning}" if camera.binning > 1 else ""),
        "shutter": camera.shutter,
        "row time": f"{camera.row_time_us:g} µs",
        "exposure": f"{camera.exposure_us:g} µs",
        "video": f"{bins} frames of {rows}×{columns} at {camera.frame_rate_hz:,.0f} fps",
        "mosaic": camera.bayer,
        "pixel pitch": _with_unit(camera.pixel_pitch_um, "µm"),
        "magnification": _with_unit(camera.magnification, "×"),
        "trigger delay": _with_unit(camera.trigger_delay_us, "µs"),
        "bias": _with_unit(camera.bias_counts, "counts"),
        "gain": _with_unit(camera.gain_electrons_per_count, "electrons per count"),
        "read noise": _with_unit(camera.read_noise_electrons, "electrons"),
        "full well": _with_unit(camera.full_well_counts, "counts"),
    }
    return table_html("rowburst.Camera", rows_of_table)


def _with_unit(value: float | None, unit: str) -> str | None:
    return None if value is None else f"{value:g} {unit}"


def psf_html(psf: Psf) -> str:
    """A PSF as a picture."""
    rows, columns = psf.shape
    count = len(psf.offsets_px)
    what = f"{count} patches of {rows}×{columns}" if count > 1 else f"{rows}×{columns}"
    return table_html("rowburst.Psf", {"size": what}) + _image(psf.array, "PSF" if count == 1 else "PSF of the middle")


def simulation_html(simulation: Simulation) -> str:
    """A simulation: its frame and its true video."""
    table = {"noise": f"{simulation.noise_sigma:.4g} counts", "LEDs": len(simulation.leds) or None}
    pictures = _image(simulation.frame, "frame") + _image(simulation.truth.max(axis=0), "truth, maximum over time")
    return table_html("rowburst.Simulation", table) + pictures


def _iterations(numbers: Mapping[str, Any]) -> str:
    """The iterations of a result; a video in chunks has those of each chunk."""
    if "parts" not in numbers:
        return f"{numbers['iterations']} ({numbers['stop_reason']})"
    counts = [part["iterations"] for part in numbers["parts"]]
    return f"{min(counts)} to {max(counts)} in {len(counts)} chunks"


def result_html(result: VideoResult, kind: str) -> str:
    """A result: its main numbers and the maximum over time."""
    numbers = result.numbers
    bins, rows, columns = result.video.shape
    psnr = numbers.get("psnr_db")
    table = {
        "video": f"{bins} frames of {rows}×{columns} at {result.frame_rate_hz:,.0f} fps",
        "fit": f"{numbers['fit']}: {numbers['fit_reason']}",
        "residual/σ": f"{numbers['residual_over_sigma']:.3f}",
        "prior": numbers["prior"],
        "PSNR": None if psnr is None else f"{psnr:.2f} dB",
        "iterations": _iterations(numbers),
        "warnings": "; ".join(numbers.get("warnings", [])) or None,
    }
    return table_html(f"rowburst.{kind}", table) + _image(result.video.max(axis=0), "maximum over time")


def colour_html(result: ColourVideo, kind: str) -> str:
    """A result in colour: its main numbers, the verdict of each plane, and the maximum over time."""
    bins, rows, columns, _ = result.video.shape
    table = {
        "video": f"{bins} frames of {rows}×{columns} in colour at {result.frame_rate_hz:,.0f} fps",
        "mosaic": result.bayer,
        "prior": result.prior,
    }
    for name, plane in result.planes.items():
        table[name] = f"{plane.fit}: {plane.fit_reason}"
    return table_html(f"rowburst.{kind}", table) + _image(result.video.max(axis=0), "maximum over time")
