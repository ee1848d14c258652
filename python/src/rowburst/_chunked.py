"""``reconstruct_chunked``: a video too large for memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike

from numpy.typing import ArrayLike

from . import _rowburst
from ._checks import checked_array
from ._load import SavedResult
from ._reconstruct import _callback, _constants, _settings_without_guide
from ._rowburst import Camera, Experiment, Progress, Psf


def reconstruct_chunked(
    frame: ArrayLike | PathLike[str],
    folder: str | PathLike[str],
    camera: Camera | Experiment,
    psf: Psf | ArrayLike | PathLike[str] | None = None,
    *,
    bins_per_chunk: int | None = None,
    bins: tuple[int, int] | None = None,
    prior: str | None = None,
    tau: str | float | None = None,
    noise_sigma: float | None = None,
    max_iterations: int | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    progress: Callable[[Progress], object] | bool | None = None,
    threads: int | None = None,
    tuning: Mapping[str, float] | None = None,
    corrected: bool = False,
) -> SavedResult:
    """The video of a frame in chunks of bins, each written to a folder before the next one starts.

    The numbers are those of ``rowburst reconstruct --part-bins``. No term of the prior is over all bins. Called again after Ctrl-C or a crash, it goes on where it was.

    Parameters
    ----------
    frame : array or path
        The frame ``[y, x]``.
    folder : path
        The folder of the result.
    camera : Camera or Experiment
        The camera, or an experiment, which gives each of the arguments that is left out.
    bins_per_chunk : int, optional
        Bins of a chunk; by default as many as 3 GiB hold.
    bins : tuple of int, optional
        The first bin, and the one after the last, of a part of the video.
    psf, prior, tau, noise_sigma, max_iterations, dark, flat, bad_pixels, progress, threads, tuning, corrected
        Those of :func:`reconstruct`. A chunk uses every pixel that is not bad: it has too few to tell foreign ones.

    Returns
    -------
    SavedResult
        The result in its folder. The video is mapped into memory, not read.

    Raises
    ------
    InputError
        An argument breaks a rule, such as a prior with a term over all bins.
    WorkError
        The work failed, a chunk does not fit into memory, or ``progress`` ended it; the chunks that are done are kept.

    Examples
    --------
    >>> saved = rb.reconstruct_chunked(frame, "chunks", camera, psf, bins_per_chunk=4, prior="tv", max_iterations=5)
    >>> saved.video.shape, len(saved.numbers["parts"])
    ((12, 24, 30), 3)
    """
    frame = checked_array("frame", frame)
    more = (psf, prior, tau, dark, flat, bad_pixels, corrected)
    settings = _settings_without_guide("a video in chunks", camera, *more)
    bar, callback = _callback(progress)
    try:
        _rowburst._reconstruct_chunked(
            frame,
            folder=folder,
            bins_per_chunk=bins_per_chunk,
            bins=bins,
            noise_sigma=noise_sigma,
            max_iterations=max_iterations,
            progress=callback,
            threads=threads,
            tuning=_constants(tuning),
            corrected=corrected,
            **settings,
        )
    finally:
        if bar is not None:
            bar.close()
    return SavedResult(folder)
