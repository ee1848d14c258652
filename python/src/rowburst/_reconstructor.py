"""``Reconstructor``: set up once, call many times."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from os import PathLike
from typing import Any

from numpy.typing import ArrayLike

from . import _rowburst
from ._checks import checked_array, checked_whole, shown
from ._errors import input_error
from ._frames import recording_of
from ._lazy import Lazy
from ._reconstruct import Result, _callback, _constants, _settings_without_guide
from ._rowburst import Camera, Experiment, LiveView, Progress, Psf


class Reconstructor:
    """The reconstruction of frames of one camera: set up once, called for each frame.

    The operator, the PSF's spectra and the Gram blocks are computed once. A call gives the video of :func:`reconstruct`,
    bit for bit, and any number of Python threads may call at once. It can be pickled; the copy is set up at its first call.

    Parameters
    ----------
    camera : Camera or Experiment
        The camera, or an experiment, which gives each of the arguments that is left out.
    psf : Psf, array or path, optional
        The point-spread function; needed where there is no experiment.
    prior, tau, noise_sigma, max_iterations, dark, flat, bad_pixels, self_calibrate, keep_all_pixels
        Those of :func:`reconstruct`.
    threads : int, optional
        Threads of this reconstructor alone; by default all those of the process (:func:`threads`).
    tuning, corrected
        Those of :func:`reconstruct`.

    Raises
    ------
    InputError
        An argument breaks a rule.
    WorkError
        The machine has too little memory.

    Examples
    --------
    >>> reconstructor = rb.Reconstructor(camera, psf, prior="tv", max_iterations=20)
    >>> reconstructor(frame).video.shape
    (12, 24, 30)
    >>> [r.fit for r in reconstructor.map(np.stack([frame, frame]))] == 2 * [reconstructor(frame).fit]
    True
    """

    def __init__(
        self,
        camera: Camera | Experiment,
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
        threads: int | None = None,
        tuning: Mapping[str, float] | None = None,
        corrected: bool = False,
    ) -> None:
        given = dict(
            psf=psf,
            prior=prior,
            tau=tau,
            noise_sigma=noise_sigma,
            max_iterations=max_iterations,
            dark=dark,
            flat=flat,
            bad_pixels=bad_pixels,
            self_calibrate=self_calibrate,
            keep_all_pixels=keep_all_pixels,
            threads=threads,
            tuning=tuning,
            corrected=corrected,
        )
        self._set(camera, given)
        self._set_up()

    def _set(self, camera: Camera | Experiment, given: dict[str, Any]) -> None:
        """Keeps the arguments; nothing is computed."""
        shared = ("psf", "prior", "tau", "dark", "flat", "bad_pixels", "corrected")
        settings = _settings_without_guide("a Reconstructor", camera, *(given[name] for name in shared))
        self._source, self._given, self._settings = camera, given, settings
        self.camera: Camera = settings["camera"]
        self._lazy: Lazy[_rowburst._Reconstructor] = Lazy()

    def _set_up(self) -> _rowburst._Reconstructor:
        """Operator, spectra and Gram blocks, computed once. A copy computes them at its first call, not while it is
        unpickled: an error there would end a worker of a multiprocessing.Pool, and the pool would wait for ever."""
        own = ("noise_sigma", "max_iterations", "self_calibrate", "keep_all_pixels", "threads", "corrected")
        options = {name: self._given[name] for name in own} | {"tuning": _constants(self._given["tuning"])}
        return self._lazy.get(lambda: _rowburst._Reconstructor(**self._settings, **options))

    def __call__(
        self,
        frame: ArrayLike | PathLike[str],
        *,
        truth: ArrayLike | PathLike[str] | None = None,
        direct: ArrayLike | PathLike[str] | None = None,
        time_budget_s: float | None = None,
        progress: Callable[[Progress], object] | bool | None = None,
        seed: int = 0,
        debias: bool = False,
    ) -> Result:
        """The video of one frame.

        Parameters
        ----------
        frame, truth, direct, time_budget_s, progress, seed, debias
            Those of :func:`reconstruct`.

        Returns
        -------
        Result
            The video of :func:`reconstruct`, bit for bit.

        Raises
        ------
        InputError
            An argument breaks a rule.
        WorkError
            The work failed, such as for lack of memory or in a process that was forked after something was computed.

        Examples
        --------
        >>> reconstructor(frame, truth=np.zeros((12, 24, 30))).video.shape
        (12, 24, 30)
        """
        return self._call(frame, None, truth, direct, time_budget_s, progress, seed, debias)

    def _call(
        self,
        frame: Any,
        cancel: _rowburst._Cancel | None = None,
        truth: ArrayLike | PathLike[str] | None = None,
        direct: ArrayLike | PathLike[str] | None = None,
        time_budget_s: float | None = None,
        progress: Callable[[Progress], object] | bool | None = None,
        seed: int = 0,
        debias: bool = False,
        raw: bool = False,
    ) -> Result:
        frame, truth = checked_array("frame", frame), checked_array("truth", truth)
        native = self._set_up()
        bar, callback = _callback(progress)
        try:
            found = native.reconstruct(
                frame,
                truth=truth,
                direct=direct,
                progress=callback,
                seed=seed,
                time_budget_s=time_budget_s,
                debias=debias,
                cancel=cancel,
                raw=raw,
            )
        finally:
            if bar is not None:
                bar.close()
        return Result(found, self.camera)

    def map(
        self,
        frames: str | PathLike[str] | Iterable[Any],
        *,
        workers: int = 1,
        debias: bool = False,
    ) -> Iterator[Result]:
        """The videos of many frames, one after the other.

        Parameters
        ----------
        frames : path, array or iterable
            A recording as :func:`read_frames` takes it, read frame by frame; an array ``[frame, y, x]`` of numpy, Dask,
            Zarr or HDF5; or anything that gives frames. A recording on disk is a raw capture, as a file is for
            :func:`reconstruct`: the bias is subtracted from floating-point numbers as well.
        workers : int
            Frames that are reconstructed at the same time, by Python threads. More than one is faster on small sensors,
            and takes the memory of as many reconstructions.
        debias : bool
            That of :func:`reconstruct`.

        Yields
        ------
        Result
            In the order of the frames. At most ``workers`` frames are ahead of the one that is taken.

        Raises
        ------
        InputError
            A frame breaks a rule, or ``workers`` is below 1.
        WorkError
            The work failed.

        Examples
        --------
        >>> for result in reconstructor.map("frames.npy"):
        ...     print(result.video.shape)
        (12, 24, 30)
        (12, 24, 30)
        """
        workers = checked_whole("workers", workers, 1)
        # A frame of a file is a raw capture, of whatever numbers it is.
        call = partial(self._call, debias=debias, raw=isinstance(frames, (str, PathLike)))
        return _mapped(call, _each(recording_of(frames)), workers)

    def live(self) -> LiveView:
        """A live view with the camera, PSF, corrections, prior, tau and threads of this reconstructor.

        Returns
        -------
        LiveView
            Its ``next(frame)`` gives a video.

        Raises
        ------
        WorkError
            The machine has too little memory.

        Examples
        --------
        >>> reconstructor.live().next(frame).video.shape
        (12, 24, 30)
        """
        settings = {name: value for name, value in self._settings.items() if name != "experiment"}
        given = self._given
        tuning = _constants(given["tuning"])
        return LiveView(**settings, noise_sigma=given["noise_sigma"], tuning=tuning, threads=given["threads"])

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (self._source, self._given)

    def __repr__(self) -> str:
        bins, rows, columns = self.camera.video_shape
        return f"<rowburst.Reconstructor: {bins} frames of {rows}×{columns}, prior {self._settings['prior']}>"


def _again(camera: Camera | Experiment, given: dict[str, Any]) -> Reconstructor:
    copy = Reconstructor.__new__(Reconstructor)
    copy._set(camera, given)
    return copy


def _each(frames: Any) -> Iterator[Any]:
    """The frames of an array or an iterable, without an array's copy as a whole."""
    if hasattr(frames, "__getitem__") and hasattr(frames, "__len__"):
        return (frames[index] for index in range(len(frames)))
    try:
        return iter(frames)
    except TypeError as error:
        rule = "it is a path, an array [frame, y, x], or anything that gives frames"
        raise input_error("frames", shown(frames), rule, "Give a list of frames, such as [frame].") from error


def _mapped(call: Callable[..., Result], frames: Iterator[Any], workers: int) -> Iterator[Result]:
    """``call`` of each frame, in their order, of as many at a time as there are workers."""
    if workers == 1:
        yield from map(call, frames)
        return
    pending: deque[Future[Result]] = deque()
    # Only the main thread hears Ctrl-C; the token ends the frames that other threads work at.
    cancel = _rowburst._Cancel()
    pool = ThreadPoolExecutor(workers, thread_name_prefix="rowburst")
    try:
        for frame in frames:
            pending.append(pool.submit(call, frame, cancel))
            if len(pending) >= workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        cancel.cancel()
        pool.shutdown(wait=False, cancel_futures=True)
