"""``batch``: a recording into an archive of videos."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from os import PathLike, fspath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowburst
from ._checks import shown
from ._errors import input_error
from ._extras import need
from ._frames import recording_of
from ._reconstruct import _constants, _settings_without_guide
from ._rowburst import Camera, Experiment, Psf, _Batch, __version__


def batch(
    frames: Any,
    out: str | PathLike[str],
    camera: Camera | Experiment | str | PathLike[str],
    psf: Psf | ArrayLike | PathLike[str] | None = None,
    *,
    prior: str | None = None,
    tau: str | float | None = None,
    noise_sigma: float | None = None,
    max_iterations: int | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    self_calibrate: str = "auto",
    keep_all_pixels: bool = False,
    frame_period_us: float | None = None,
    threads: int | None = None,
    retry_failed: bool = False,
    progress: Callable[[int, int], object] | bool | None = None,
    tuning: Mapping[str, float] | None = None,
    corrected: bool = False,
) -> dict[str, Any]:
    """Reconstructs every frame of a recording into one OME-Zarr archive, on this machine.

    The archive is that of ``rowburst batch``, bit for bit. A frame counts as done once its line is written, after its
    video: called again after Ctrl-C or a crash, it goes on where it was.

    Parameters
    ----------
    frames : path or array
        A recording as :func:`read_frames` takes it, or an array ``[frame, y, x]`` of numpy, Dask, Zarr or HDF5. One frame
        at a time is in memory for each thread. Pixels of a masked array that are masked in any frame are bad in all.
    out : path
        The archive, ``[frame, t, y, x]``, float32 counts. Its videos open with ``zarr`` or napari.
    camera : Camera, Experiment or path
        The camera; or an experiment, or its file, which gives each of the arguments that is left out.
    psf, prior, tau, noise_sigma, max_iterations, dark, flat, bad_pixels, self_calibrate, keep_all_pixels
        Those of :func:`reconstruct`. A prior ``"auto"`` is chosen once, and one correction of PSF and camera found from
        four frames together, for all frames.
    frame_period_us : float, optional
        Time from one frame to the next in microseconds.
    threads : int, optional
        Number of threads; by default all.
    retry_failed : bool
        Whether frames that failed before are tried again.
    progress : bool or callable, optional
        ``True`` for a tqdm bar, or a function that is called as ``progress(done, of)`` after each group of frames.
    tuning : mapping, optional
        Other values for constants of the solver, such as ``{"support_threshold": 0.1}``: see :func:`reconstruct`.
    corrected : bool
        Whether the frames are corrected already: neither bias nor dark nor flat are applied.

    Returns
    -------
    dict
        ``archive``, ``table`` (a CSV file with a line for each frame), ``frames``, ``done``, ``failed``, ``left``,
        ``frames_this_run``, ``prior``, ``prior_reason``, ``self_calibration``, ``warnings``, ``version``.

    Raises
    ------
    InputError
        An argument breaks a rule, or the archive was begun with other settings.
    WorkError
        The work failed, such as by a full disk.

    Examples
    --------
    >>> summary = rb.batch(np.stack([frame, frame]), "videos.zarr", camera, psf, prior="tv", max_iterations=20)
    >>> summary["done"], summary["left"]
    (2, 0)
    """
    if isinstance(camera, (str, PathLike)):
        camera = Experiment(camera, frames if isinstance(frames, (str, PathLike)) else None)
    if isinstance(camera, Experiment) and frame_period_us is None:
        frame_period_us = camera.frame_period_us
    settings = _settings_without_guide("a batch", camera, psf, prior, tau, dark, flat, bad_pixels, corrected)
    if corrected:
        settings["camera"] = settings["camera"].replace(bias_counts=None)
    settings.pop("experiment")
    frames = recording_of(frames)
    if not (hasattr(frames, "__len__") and hasattr(frames, "__getitem__")):
        rule = "a recording is a path, or an array [frame, y, x] whose length is known"
        remedy = "Give numpy.stack(list(frames)); Reconstructor.map takes frames one after another."
        raise input_error("frames", shown(frames), rule, remedy)
    if np.ma.isMaskedArray(frames):
        settings["bad_pixels"] = _with_masked(settings["bad_pixels"], np.asarray(np.ma.getmaskarray(frames).any(axis=0)))
        frames = np.ma.filled(frames, 0)
    job = _Batch.of_values(
        frames=frames,
        out=out,
        noise_sigma=noise_sigma,
        max_iterations=max_iterations,
        self_calibrate=self_calibrate,
        keep_all_pixels=keep_all_pixels,
        frame_period_us=frame_period_us,
        tuning=_constants(tuning),
        threads=threads,
        **settings,
    )
    bar, callback = _listener(progress)
    try:
        return _run(job, fspath(out), threads or _rowburst.threads(), retry_failed, callback)
    finally:
        if bar is not None:
            bar.close()


def _with_masked(bad_pixels: ArrayLike | PathLike[str] | None, mask: NDArray[np.bool_]) -> Any:
    """The bad pixels and the masked ones."""
    if bad_pixels is None:
        return mask
    path = isinstance(bad_pixels, (str, PathLike))
    given = recording_of(bad_pixels)[0] if path else np.asarray(bad_pixels)
    if given.shape != mask.shape:
        rule = f"the frames have {mask.shape[0]}×{mask.shape[1]} pixels, some of them masked"
        remedy = "Give a mask of their size, or fill the masked pixels."
        raise input_error("bad_pixels", f"a mask of shape {given.shape}", rule, remedy, kind="shape")
    return (given != 0) | mask


class _FrameBar:
    """A tqdm bar of frames."""

    def __init__(self) -> None:
        self.bar = need("tqdm.auto", "progress=True").tqdm(unit="frame", leave=False)

    def __call__(self, done: int, of: int) -> None:
        self.bar.total = of
        self.bar.update(done - self.bar.n)

    def close(self) -> None:
        self.bar.close()


def _listener(progress: object) -> tuple[_FrameBar | None, Callable[[int, int], object] | None]:
    """The bar of a batch, if there is one, and what is called after each group of frames."""
    if progress is None or callable(progress):
        return None, progress
    if isinstance(progress, (bool, np.bool_)):
        bar = _FrameBar() if progress else None
        return bar, bar
    rule = "it is True for a tqdm bar, or a function of two numbers, done and of"
    raise input_error("progress", repr(progress), rule, "Give progress=True, or leave it out.")


def _run(
    job: _Batch, out: str, threads: int, retry_failed: bool, progress: Callable[[int, int], object] | None
) -> dict[str, Any]:
    """Runs what is left of a batch."""
    left = job.left(0, job.count, retry_failed)
    prior, reason = job.prior()
    # Without a listener one group, since the threads wait for each other at its end.
    group = 4 * threads if progress is not None else max(len(left), 1)
    made = 0
    for start in range(0, len(left), group):
        made += len(job.run(left[start : start + group]))
        if progress is not None:
            progress(made, len(left))
    table, rows = job.write_table(), job.rows()
    found = job.self_calibration()
    failed = [row for row in rows if not row[2]]
    return {
        "version": __version__,
        "archive": str(out),
        "table": str(table),
        "frames": job.count,
        "done": len(rows) - len(failed),
        "failed": len(failed),
        "left": job.count - len(rows),
        "frames_this_run": made,
        "prior": prior,
        "prior_reason": reason,
        "self_calibration": None if found is None else json.loads(found),
        "warnings": [f"no video of {row[1]}: {row[6]}" for row in failed[:10]],
    }
