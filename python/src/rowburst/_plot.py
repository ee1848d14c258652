"""Pictures of results by matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ._extras import need
from ._rowburst import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ._colour_video import ColourVideo
    from ._reconstruct import Trace
    from ._video import VideoResult


def _pyplot(caller: str) -> Any:
    return need("matplotlib.pyplot", caller)


def overview(result: VideoResult) -> NDArray[Any]:
    """The four pictures of a result."""
    pyplot = _pyplot("plot")
    figure, axes = pyplot.subplots(2, 2, figsize=(9, 7.5), layout="constrained")
    video, numbers = result.video, result.numbers
    brightest = axes[0, 0].imshow(video.max(axis=0), cmap="gray", vmin=0)
    axes[0, 0].set(title="maximum over time", xlabel="x (px)", ylabel="y (px)")
    figure.colorbar(brightest, ax=axes[0, 0], label="light (counts)")
    time_colour(result, axes[0, 1], "turbo")
    axes[0, 1].set_title("time as colour")
    axes[1, 0].plot(result.time_us, video.sum(axis=(1, 2), dtype=float), color="tab:blue")
    axes[1, 0].set(xlabel="time (µs)", ylabel="light of all pixels (counts)", title="light over time")
    axes[1, 0].set_ylim(bottom=0)
    try:
        residual = axes[1, 1].imshow(result.residual, cmap="RdBu", vmin=-4, vmax=4)
        axes[1, 1].set_title(f"residual/σ (rms {numbers['residual_over_sigma']:.2f})")
        figure.colorbar(residual, ax=axes[1, 1], label="residual (σ)")
    except InputError:
        # A video in chunks has none.
        axes[1, 1].set_axis_off()
    bins, rows, columns = video.shape
    figure.suptitle(
        f"{bins} frames of {rows}×{columns} at {result.frame_rate_hz:,.0f} fps, {numbers['prior']}, the fit is {numbers['fit']}"
    )
    return np.asarray(axes)


def _in_colour(picture: NDArray[Any], top: float) -> NDArray[Any]:
    """A picture ``[y, x, colour]`` in counts as matplotlib takes it, ``top`` being white."""
    return np.clip(picture / top, 0, 1)


def colour_overview(result: ColourVideo) -> NDArray[Any]:
    """The four pictures of a result in colour."""
    pyplot = _pyplot("plot")
    figure, axes = pyplot.subplots(2, 2, figsize=(9, 7.5), layout="constrained")
    video, time_us = result.video, result.time_us
    brightest = video.max(axis=0)
    axes[0, 0].imshow(_in_colour(brightest, float(brightest.max()) or 1))
    axes[0, 0].set(title="maximum over time", xlabel="x (cells of 2×2 px)", ylabel="y (cells of 2×2 px)")
    time_colour(result, axes[0, 1], "turbo")
    axes[0, 1].set_title("time as colour")
    for index, colour in enumerate(("red", "green", "blue")):
        axes[1, 0].plot(time_us, video[..., index].sum(axis=(1, 2), dtype=float), color=f"tab:{colour}", label=colour)
    axes[1, 0].set(xlabel="time (µs)", ylabel="light of all pixels (counts)", title="light over time")
    axes[1, 0].set_ylim(bottom=0)
    axes[1, 0].legend()
    residual = axes[1, 1].imshow(result.residual, cmap="RdBu", vmin=-4, vmax=4)
    axes[1, 1].set_title("residual/σ of the raw frame")
    figure.colorbar(residual, ax=axes[1, 1], label="residual (σ)")
    bins, rows, columns, _ = video.shape
    figure.suptitle(
        f"{bins} frames of {rows}×{columns} in colour at {result.frame_rate_hz:,.0f} fps, {result.prior}, the fit is {result.fit}"
    )
    return np.asarray(axes)


def montage(result: VideoResult | ColourVideo, frames: int, columns: int | None, cmap: str) -> NDArray[Any]:
    """Bins side by side."""
    pyplot = _pyplot("montage")
    video, time_us = result.video, result.time_us
    shown = np.unique(np.linspace(0, len(video) - 1, min(frames, len(video))).round().astype(int))
    across = min(columns or round(np.sqrt(1.5 * len(shown)) + 0.5), len(shown))
    down = -(-len(shown) // across)
    height, width = video.shape[1:3]
    top = float(video.max()) or 1
    size = (1.7 * across, 1.7 * down * height / width + 0.3 * down)
    figure, axes = pyplot.subplots(down, across, figsize=size, squeeze=False, layout="constrained")
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, bin_ in zip(axes.flat, shown, strict=False):
        if video.ndim == 4:
            ax.imshow(_in_colour(video[bin_], top))
        else:
            picture = ax.imshow(video[bin_], cmap=cmap, vmin=0, vmax=top)
        ax.set_title(f"{time_us[bin_]:.1f} µs", fontsize=8)
    if video.ndim == 3:
        figure.colorbar(picture, ax=axes, label="light (counts)", shrink=0.8)
    return np.asarray(axes.ravel()[: len(shown)])


def time_colour(result: VideoResult | ColourVideo, ax: Any, cmap: str) -> Axes:
    """The brightest tinted bin of each pixel; of a video in colour, of the mean of its colours."""
    pyplot = _pyplot("time_colour")
    if ax is None:
        ax = pyplot.subplots(layout="constrained")[1]
    video, time_us = result.video, result.time_us
    if video.ndim == 4:
        video = video.mean(axis=-1)
    colours = pyplot.get_cmap(cmap)(np.linspace(0, 1, len(video)))[:, :3]
    picture = np.zeros((*video.shape[1:], 3), np.float32)
    scale = float(video.max()) or 1
    for frame, colour in zip(video, colours, strict=True):
        np.maximum(picture, frame[..., None] / scale * colour, out=picture)
    ax.imshow(np.clip(picture, 0, 1))
    ax.set(xlabel="x (px)", ylabel="y (px)")
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    scale_bar = ScalarMappable(Normalize(time_us[0], time_us[-1]), cmap)
    ax.figure.colorbar(scale_bar, ax=ax, label="time (µs)")
    drawn: Axes = ax
    return drawn


def trace(trace: Trace, ax: Any) -> Axes:
    """A trace with its standard error."""
    if ax is None:
        ax = _pyplot("Trace.plot").subplots(layout="constrained")[1]
    error = np.nan_to_num(trace.standard_error)
    (line,) = ax.plot(trace.time_us, trace.debiased, label="debiased ± standard error")
    ax.fill_between(
        trace.time_us, trace.debiased - error, trace.debiased + error, color=line.get_color(), alpha=0.25, linewidth=0
    )
    ax.plot(trace.time_us, trace.value, linestyle=":", color=line.get_color(), label="mean of the video")
    y, x, rows, columns = trace.region
    title = f"rows {y} to {y + rows - 1}, columns {x} to {x + columns - 1}"
    if trace.frequency_hz is not None:
        title += f": {trace.frequency_hz:,.0f} Hz"
    ax.set(xlabel="time (µs)", ylabel="light (counts)", title=title)
    ax.legend()
    drawn: Axes = ax
    return drawn
