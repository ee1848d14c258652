"""``reconstruct`` and its result."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from os import PathLike, fspath
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _rowburst
from ._checks import check_camera, check_port, checked_array, checked_psf, is_bool
from ._display import result_html
from ._errors import input_error, write
from ._figure import Figure, save_figure
from ._makers import is_of_maker
from ._rowburst import Camera, Experiment, Progress, Psf
from ._video import VideoResult, first_pixel
from ._view import View

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)
class Trace:
    """The light of a region over time, with standard errors.

    ``value`` is the mean of the video over the region. ``debiased`` is the same from a re-estimate without
    the bias of the prior, and ``standard_error`` (NaN where it is not known) belongs to ``debiased``.
    """

    region: tuple[int, int, int, int]
    """First row, first column, rows, columns."""
    time_us: NDArray[np.float64]
    value: NDArray[np.float64]
    debiased: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    numbers: dict[str, Any]
    """Peak, frequency with its error, harmonics, photodiodes: as in ``result.json``."""

    @property
    def frequency_hz(self) -> float | None:
        """The strongest frequency; None where no frequency is significant."""
        return self.numbers.get("frequency_hz")

    @property
    def frequency_error_hz(self) -> float | None:
        """Its standard error."""
        return self.numbers.get("frequency_error_hz")

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draws the trace over time, with its standard error as a band.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw; by default into a figure of its own.

        Returns
        -------
        matplotlib.axes.Axes
            The axes: microseconds and counts.

        Raises
        ------
        InputError
            matplotlib is not installed.

        Examples
        --------
        >>> ax = result.traces()[0].plot()
        >>> ax.get_xlabel()
        'time (µs)'
        """
        from . import _plot

        return _plot.trace(self, ax)

    def __repr__(self) -> str:
        y, x, rows, columns = self.region
        frequency = "" if self.frequency_hz is None else f", {self.frequency_hz:.0f} Hz"
        return f"<rowburst.Trace of {rows}×{columns} pixels at ({y}, {x}): {len(self.value)} bins{frequency}>"


class Report(str):
    """The report as the text of one HTML page, which fetches nothing; notebooks show it."""

    def save(self, path: str | PathLike[str]) -> Path:
        """Writes the page to a file.

        Parameters
        ----------
        path : path
            The file.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        WorkError
            The file cannot be written.

        Examples
        --------
        >>> result.report().save("report.html").name
        'report.html'
        """
        return write(path, self)

    def __repr__(self) -> str:
        return f"<rowburst.Report: a page of {len(self) / 1000:.0f} kB; report.save(path) writes it>"

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{escape(self)}" style="width:100%;height:45em;border:0"></iframe>'


class Result(VideoResult):
    """A reconstructed video with what is needed to judge it. :func:`reconstruct` makes it."""

    def __init__(self, found: _rowburst.Result, camera: Camera) -> None:
        self._native = found
        self.camera = camera
        self._numbers_text: str | None = None

    @property
    def video(self) -> NDArray[np.float32]:
        """The video ``[t, y, x]`` in counts. No copy: it may not be written to."""
        return self._native.video

    @property
    def background(self) -> NDArray[np.float32] | None:
        """The background component of the video, if the prior has one."""
        return self._native.background

    @property
    def residual(self) -> NDArray[np.float32]:
        """``W(b - A v) / sigma``, ``[y, x]``; 0 where a pixel holds no information."""
        return self._native.residual

    @property
    def time_us(self) -> NDArray[np.float64]:
        """The middle of each bin of the video."""
        return self.camera.time_us

    @property
    def _first_pixel(self) -> tuple[int, int]:
        (rows, columns), (sensor_rows, sensor_columns) = self.camera.field, self.camera.frame_shape
        return first_pixel(rows, sensor_rows), first_pixel(columns, sensor_columns)

    @property
    def frame_rate_hz(self) -> float:
        """Frames of the video a second."""
        return self._native.frame_rate_hz

    @property
    def prior(self) -> str:
        """The prior that was used."""
        return self._native.prior

    @property
    def tau(self) -> float:
        """The weight of the prior at the end."""
        return self._native.tau

    @property
    def noise_sigma(self) -> float:
        """Standard deviation of the noise, in counts."""
        return self._native.noise_sigma

    @property
    def effective_sigma(self) -> float:
        """Noise and error of the model together, in counts.

        It is ``noise_sigma`` where the model explains the frame, and where the frame sees too little of the scene to tell.
        """
        return self._native.effective_sigma

    @property
    def excluded(self) -> NDArray[np.uint8]:
        """1 at the foreign pixels ``[y, x]`` that no video explains and that were left out, such as hot pixels."""
        return self._native.excluded

    @property
    def excluded_fraction(self) -> float:
        """Part of the pixels that are foreign."""
        return self._native.excluded_fraction

    @property
    def stray_light(self) -> NDArray[np.float32] | None:
        """Smooth stray light ``[y, x]`` that was taken away from the frame, such as a reflection, in counts; None: none was
        found."""
        return self._native.stray_light

    @property
    def stray_light_fraction(self) -> float:
        """Part of the light of the frame that is stray light."""
        return self._native.stray_light_fraction

    @property
    def self_calibration(self) -> dict[str, Any] | None:
        """What the frame has corrected of its PSF and camera, as in ``result.json``; None: they were used as given."""
        found: dict[str, Any] | None = self.numbers["self_calibration"]
        return found

    @property
    def corrected_psf(self) -> Psf | None:
        """The PSF as the frame has corrected it, for the next frames of the same set-up; None: it was used as given."""
        return self._native.corrected_psf

    @property
    def coverage(self) -> NDArray[np.uint8]:
        """1 at the voxels ``[t, y, x]`` that the frame observes; the video is zero at all others."""
        return self._native.coverage

    @property
    def coverage_fraction(self) -> float:
        """Part of the voxels that the frame observes."""
        return self._native.coverage_fraction

    @property
    def residual_over_sigma(self) -> float:
        """Rms of the residual over sigma: about 1 where the video explains the frame."""
        return self._native.residual_over_sigma

    @property
    def iterations(self) -> int:
        """Iterations done."""
        return self._native.iterations

    @property
    def stop_reason(self) -> str:
        """converged, iteration-limit, time-budget or interrupted."""
        return self._native.stop_reason

    @property
    def fit(self) -> str:
        """good, suspicious or bad: whether the model explains the frame."""
        return self._native.fit

    @property
    def fit_reason(self) -> str:
        """The reason for the verdict ``fit``."""
        return self._native.fit_reason

    @property
    def seconds(self) -> float:
        """Time of the solver alone."""
        return self._native.seconds

    @property
    def setup_seconds(self) -> float:
        """Time to set up operator, Gram factors and noise level."""
        return self._native.setup_seconds

    @property
    def numbers(self) -> dict[str, Any]:
        """The content of ``result.json`` of the command line."""
        if self._numbers_text is None:
            self._numbers_text = self._native._json()
        numbers: dict[str, Any] = json.loads(self._numbers_text)
        return numbers

    def traces(
        self,
        regions: Iterable[Sequence[int]] = (),
        photodiodes: Iterable[str | PathLike[str]] = (),
    ) -> list[Trace]:
        """Traces of ``regions``, then of the brightest spots.

        Parameters
        ----------
        regions : iterable of sequence of int
            Each is ``(y, x)``, for the 3×3 pixels about it, or ``(y, x, rows, columns)``.
        photodiodes : iterable of path
            CSV files with the columns ``time_us,value``; each is aligned with the trace that fits it best.

        Returns
        -------
        list of Trace
            Light over time, in counts, with standard errors.

        Raises
        ------
        InputError
            A region is outside of the field, or a file is no table.

        Examples
        --------
        >>> first = result.traces([(8, 9)])[0]
        >>> first.region, first.value.shape
        ((7, 8, 3, 3), (12,))
        """
        texts = [_region_text(region) for region in regions]
        found, text = self._native._traces(texts, [fspath(p) for p in photodiodes])
        numbers = json.loads(text)["traces"]
        time_us = self.time_us
        return [Trace(time_us=time_us, numbers=n, **trace) for trace, n in zip(found, numbers, strict=True)]

    def report(self, path: str | PathLike[str] | None = None, title: str = "Rowburst") -> Report:
        """The report of the command line, as a page.

        Parameters
        ----------
        path : path, optional
            A file that is written.
        title : str
            Title of the page.

        Returns
        -------
        Report
            The page as text, which fetches nothing; notebooks show it.

        Raises
        ------
        WorkError
            The file cannot be written, or the film cannot be encoded.

        Examples
        --------
        >>> result.report("report.html")[:15].lower()
        '<!doctype html>'
        """
        report = Report(self._native._report(title))
        if path is not None:
            report.save(path)
        return report

    def save(
        self, folder: str | PathLike[str], title: str = "Rowburst", *, formats: Sequence[str] | None = None
    ) -> Path:
        """Writes the files of ``rowburst reconstruct``: video, traces, report, ``result.json``.

        Where an :class:`Experiment` and files alone went into the result, ``rowburst rerun`` repeats it.

        Parameters
        ----------
        folder : path
            The folder, which is made where it is missing.
        title : str
            Title of the report.
        formats : sequence of str, optional
            Formats of the video: ``"npy"`` (always written), ``"tif"``, ``"zarr"``, ``"mp4"``, ``"mat"``, ``"h5"``; by
            default ``npy``, ``mp4``, and up to 64 MB ``tif``.

        Returns
        -------
        pathlib.Path
            The folder.

        Raises
        ------
        InputError
            A format that does not exist.
        WorkError
            A file cannot be written.

        Examples
        --------
        >>> folder = result.save("folder", formats=["npy", "mat"])
        >>> (folder / "video.mat").exists(), (folder / "video.mp4").exists()
        (True, False)
        """
        self._native._save(folder, title, None if formats is None else ",".join(["npy", *formats]))
        return Path(folder)

    def figure(self, path: str | PathLike[str] | None = None, layout: str = "fig2") -> Figure:
        """Draws the figure of ``rowburst figure``.

        Parameters
        ----------
        path : path, optional
            A .svg or .png file that is written.
        layout : str
            ``"fig2"`` or ``"fig3"``, after the figures of the paper.

        Returns
        -------
        Figure
            The figure as SVG, PNG and PDF; notebooks show it.

        Raises
        ------
        InputError
            The layout is unknown, or the file has another ending.
        WorkError
            The file cannot be written.

        Examples
        --------
        >>> result.figure("figure.svg").save("figure.png").name
        'figure.png'
        """
        return save_figure(Figure(*self._native._figure(layout)), path)

    def view(self, port: int | None = None, open_browser: bool = True) -> View:
        """Opens the viewer of ``rowburst view`` on this result.

        The page is served by this process, on 127.0.0.1 alone, until ``close()`` or the end of the process. The files of
        the result are written to a temporary folder, which goes with the view.

        Parameters
        ----------
        port : int, optional
            The port; by default 8787, or one of the next that is free. 0 is any.
        open_browser : bool
            Whether a browser is opened, where there is a screen.

        Returns
        -------
        View
            Its ``url``, and ``close()``.

        Raises
        ------
        InputError
            The port is no whole number from 0 to 65535.
        WorkError
            The port is taken.

        Examples
        --------
        >>> with result.view(port=0, open_browser=False) as view:
        ...     print(view.url[:17])
        http://127.0.0.1:
        """
        check_port(port)
        folder = TemporaryDirectory(prefix="rowburst-")
        try:
            self.save(folder.name)
            return View([Path(folder.name)], port, open_browser, folder)
        except BaseException:
            folder.cleanup()
            raise

    def _repr_html_(self) -> str:
        return result_html(self, "Result")

    def __repr__(self) -> str:
        bins, rows, columns = self.camera.video_shape
        return (
            f"<rowburst.Result: {bins} frames of {rows}×{columns} at {self.frame_rate_hz:.0f} fps, "
            f"residual/sigma {self.residual_over_sigma:.3f}, the fit is {self.fit}>"
        )


def _region_text(region: object) -> str:
    """The region as the command line takes it; only whole numbers make one."""
    try:
        numbers = list(region)  # type: ignore[call-overload]
        whole = [int(n) for n in numbers]
        if whole == numbers and not any(map(is_bool, numbers)):
            return ",".join(map(str, whole))
    except (TypeError, ValueError, OverflowError):
        pass
    rule = "a region is (y, x) or (y, x, rows, columns) in whole numbers from 0"
    remedy = "Give a list of regions, such as [(40, 52)]; round positions that are not whole."
    raise input_error("regions", repr(region), rule, remedy)


class _Bar:
    """A tqdm bar of a run."""

    def __init__(self) -> None:
        try:
            from tqdm.auto import tqdm
        except ImportError as error:
            rule = "the bar needs tqdm, which is not installed"
            remedy = "Install it: pip install tqdm, or give a function that is called with a rowburst.Progress."
            raise input_error("progress", "True", rule, remedy, kind="missing") from error
        self.bar = tqdm(unit="iteration", leave=False)

    def __call__(self, progress: Progress) -> None:
        if progress.iteration == 1:
            self.bar.reset(total=progress.max_iterations)
        self.bar.set_description(progress.label or "solving", refresh=False)
        self.bar.set_postfix_str(f"residual/σ {progress.residual_over_sigma:.2f}", refresh=False)
        self.bar.update(progress.iteration - self.bar.n)

    def close(self) -> None:
        self.bar.close()


def _callback(progress: object) -> tuple[_Bar | None, Callable[[Progress], object] | None]:
    """The bar of a run, if there is one, and what is called after every iteration."""
    if progress is None or callable(progress):
        return None, progress
    if isinstance(progress, (bool, np.bool_)):
        bar = _Bar() if progress else None
        return bar, bar
    rule = "it is True for a tqdm bar, or a function of a rowburst.Progress"
    raise input_error("progress", repr(progress), rule, "Give progress=True, or leave it out.")


def _settings(
    camera: Camera | Experiment,
    psf: Psf | ArrayLike | PathLike[str] | None,
    prior: str | None,
    tau: str | float | None,
    dark: ArrayLike | PathLike[str] | None,
    flat: ArrayLike | PathLike[str] | None,
    bad_pixels: ArrayLike | PathLike[str] | None,
    corrected: bool = False,
) -> dict[str, Any]:
    """The arguments that an experiment gives where they are left out, and the experiment."""
    check_camera(camera, takes_experiment=True)
    psf = checked_psf(psf)
    dark, flat, bad_pixels = (
        checked_array(name, value) for name, value in (("dark", dark), ("flat", flat), ("bad_pixels", bad_pixels))
    )
    for name, value in ("dark", dark), ("flat", flat):
        if corrected and value is not None:
            rule = "a corrected frame needs no dark and no flat"
            raise input_error(name, f"{name} and corrected=True", rule, f"Leave one of them out: {name} or corrected.")
    experiment = None
    if isinstance(camera, Experiment):
        experiment, camera = camera, camera.camera
        psf = experiment.psf if psf is None else psf
        if not corrected:
            dark = experiment.dark if dark is None else dark
            flat = experiment.flat if flat is None else flat
        bad_pixels = experiment.bad_pixels if bad_pixels is None else bad_pixels
        prior = experiment.prior if prior is None else prior
        tau = experiment.tau if tau is None else tau
    return {
        "camera": camera,
        "psf": psf,
        "prior": "auto" if prior is None else prior,
        "tau": tau,
        "dark": dark,
        "flat": flat,
        "bad_pixels": bad_pixels,
        "experiment": experiment,
    }


def _settings_without_guide(caller: str, camera: Camera | Experiment, *more: Any) -> dict[str, Any]:
    """Those of a call that takes no pictures of a second camera."""
    if isinstance(camera, Experiment) and camera.guide:
        found = f"[[guide]] in the experiment, {len(camera.guide)} of them"
        rule = f"a guide belongs to one frame, and {caller} does not take it"
        remedy = "Call rb.reconstruct for the frame of these pictures, or take [[guide]] out of the experiment file."
        raise input_error("guide", found, rule, remedy, kind="unsupported")
    return _settings(camera, *more)


def _constants(tuning: Mapping[str, float] | None) -> dict[str, float] | None:
    """The constants of the solver as the extension takes them."""
    return None if tuning is None else dict(tuning)


def _files(frame: Any, given: Mapping[str, Any], guide: Any) -> dict[str, Any] | None:
    """The files of a run with an experiment; None where an input is none, or one that the program does not read."""
    guides = list(guide) if isinstance(guide, (list, tuple)) else [] if guide is None else [guide]
    paths = [frame, *guides, *(value for value in given.values() if value is not None)]
    if guide == [] or not all(isinstance(path, (str, PathLike)) and not is_of_maker(Path(path)) for path in paths):
        return None
    names = ", ".join(repr(fspath(path)) for path in paths)
    return {"frame": frame, **given, "guides": guides, "command": f"rowburst.reconstruct of Python, of {names}"}


def _pictures(guide: ArrayLike | Sequence[ArrayLike] | None) -> list[ArrayLike] | None:
    """The pictures of a guide as a list."""
    if guide is None:
        return None
    if isinstance(guide, (list, tuple)):
        pictures = [picture if isinstance(picture, (str, PathLike)) else checked_array("guide", picture) for picture in guide]
        if all(isinstance(picture, (str, PathLike)) or np.ndim(picture) == 2 for picture in pictures):
            return cast("list[ArrayLike]", pictures)
    return [cast("ArrayLike", checked_array("guide", guide))]


def reconstruct(
    frame: ArrayLike | PathLike[str],
    camera: Camera | Experiment,
    psf: Psf | ArrayLike | PathLike[str] | None = None,
    *,
    prior: str | None = None,
    tau: str | float | None = None,
    noise_sigma: float | None = None,
    time_budget_s: float | None = None,
    max_iterations: int | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    truth: ArrayLike | PathLike[str] | None = None,
    direct: ArrayLike | PathLike[str] | None = None,
    progress: Callable[[Progress], object] | bool | None = None,
    seed: int = 0,
    self_calibrate: str = "auto",
    keep_all_pixels: bool = False,
    debias: bool = False,
    threads: int | None = None,
    tuning: Mapping[str, float] | None = None,
    corrected: bool = False,
    guide: ArrayLike | Sequence[ArrayLike] | None = None,
    guide_exposures_us: Sequence[tuple[float, float]] | None = None,
    guide_model: str | None = None,
) -> Result:
    """The video of one raw ``frame``, with the numbers of ``rowburst reconstruct``, bit for bit.

    Other Python threads run meanwhile. Ctrl-C raises ``KeyboardInterrupt`` at once.

    Parameters
    ----------
    frame : array or path
        The frame ``[y, x]``. Integers are a raw capture: dark or bias is subtracted, and the largest value of their type is
        saturation. Floating-point numbers are a frame without bias: ``bias_counts`` of the camera is not subtracted from
        them, while a ``dark`` that is given is. A file is a raw capture, as on the command line, even one of floating-point
        numbers. Masked pixels of masked arrays (frame, dark, flat and bad pixels) are bad pixels, and so is NaN in an
        ``xarray.DataArray``, which makes floating-point numbers of masked integers.
    camera : Camera or Experiment
        The camera. An experiment also gives each of ``psf``, ``dark``, ``flat``, ``bad_pixels``, ``prior``, ``tau`` and
        ``guide`` that is left out.
    psf : Psf, array or path, optional
        The point-spread function ``[y, x]``; needed where there is no experiment. An array of integers is a raw capture.
    prior : str, optional
        The prior, such as ``"tv"`` or ``"tv+0.5*tdiff+support"``; ``"auto"``, the default, chooses one on held-out pixels.
    tau : float or str, optional
        The weight of the prior: a number, ``"auto"`` (the default) or ``"held-out"``.
    noise_sigma : float, optional
        Standard deviation of the noise in counts; by default it is estimated.
    time_budget_s : float, optional
        Limit of set-up and solver together, in seconds.
    max_iterations : int, optional
        Most iterations of each run of the solver.
    dark, flat, bad_pixels : array or path, optional
        A frame without light, a frame of even light (with its dark level) and a mask, ``[y, x]``.
    truth : array or path, optional
        The true video ``[t, y, x]``, for PSNR and SSIM.
    direct : array or path, optional
        A frame of the scene without the diffuser, for the report.
    progress : bool or callable, optional
        ``True`` for a tqdm bar, or a function that is given a :class:`Progress` after every iteration, on the calling
        thread; where it returns ``False`` the run stops with the current result.
    seed : int
        The seed of the simulation that made the frame; only reported.
    self_calibrate : str
        ``"auto"``: where PSF and camera do not explain the frame, the frame corrects them (size, angle, blur and noise of the
        PSF; vignetting, stray light, and timing of the camera), if held-out pixels confirm it: see
        :attr:`Result.corrected_psf` and :attr:`Result.stray_light`. ``"off"``: never; ``"on"``: corrections are looked for
        in every frame. A list such as ``"scale,rotation_deg"`` or ``"on,scale"`` names what may be corrected, by the keys of
        :attr:`Result.self_calibration`, and ``"smooth_stray_light"``.
    keep_all_pixels : bool
        Whether every pixel is used that is not bad. By default foreign pixels, such as hot pixels, dust or a printed
        caption, are looked for where the video does not explain the frame, and are left out: see :attr:`Result.excluded`.
    debias : bool
        Whether the active voxels are estimated anew without the bias of the prior, as by ``--debias`` of the command line.
    threads : int, optional
        Threads of this call alone; by default all those of the process (:func:`threads`). The video is the same.
    tuning : mapping, optional
        Other values for constants of the solver, such as ``{"support_threshold": 0.1}``. Unstable: names, meanings and
        values change between versions. The names are the fields of ``rowburst::solve::admm::Tuning``.
    corrected : bool
        Whether the frame is corrected already, integers as well: neither bias nor dark nor flat of the camera or the
        experiment are applied. ``dark`` and ``flat`` may not be given then.
    guide : array, path, or a sequence of them, optional
        Pictures ``[y, x]`` of the same scene by an ordinary second camera, for dense scenes; by default those of the
        experiment, ``[[guide]]``; an empty list is none. What they gave is ``result.numbers["guide"]``.
    guide_exposures_us : sequence of pairs, optional
        For each picture the middle of its exposure, from the start of the frame's first exposure, and its length, in µs.
        By default the one picture was taken at an unknown time within the frame; several pictures need times.
    guide_model : str, optional
        What the scene does with the light of the guide: ``"auto"`` (the default), ``"motion"``, ``"gain"``, ``"still"``, or
        ``"places"``: each lit place of the guide has a trace, in ``result.numbers["guide"]["known_places"]["traces"]``.

    Returns
    -------
    Result
        The video with the evidence for it.

    Raises
    ------
    InputError
        An argument breaks a rule; the message names it, its value, the rule and the remedy.
    WorkError
        The work failed, such as for lack of memory.

    Examples
    --------
    >>> result = rb.reconstruct(frame, camera, psf, prior="tv+0.5*tdiff+support")
    >>> result.video.shape, result.prior
    ((12, 24, 30), 'tv+0.5*tdiff+support')
    """
    settings = _settings(camera, psf, prior, tau, dark, flat, bad_pixels, corrected)
    frame, truth, direct = (
        checked_array(name, value) for name, value in (("frame", frame), ("truth", truth), ("direct", direct))
    )
    given = dict(psf=psf, dark=dark, flat=flat, bad_pixels=bad_pixels, truth=truth, direct=direct)
    is_plain = not corrected and tuning is None and guide_exposures_us is None
    files = _files(frame, given, guide) if is_plain and isinstance(camera, Experiment) else None
    bar, callback = _callback(progress)
    try:
        found = _rowburst.reconstruct(
            frame,
            files=files,
            noise_sigma=noise_sigma,
            time_budget_s=time_budget_s,
            max_iterations=max_iterations,
            truth=truth,
            direct=direct,
            progress=callback,
            seed=seed,
            self_calibrate=self_calibrate,
            keep_all_pixels=keep_all_pixels,
            debias=debias,
            threads=threads,
            tuning=_constants(tuning),
            corrected=corrected,
            guide=_pictures(guide),
            guide_exposures_us=None if guide_exposures_us is None else list(guide_exposures_us),
            guide_model=guide_model,
            **settings,
        )
    finally:
        if bar is not None:
            bar.close()
    return Result(found, settings["camera"])
