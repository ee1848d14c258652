"""The extension module: see the package for what it is for."""

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "Camera",
    "Experiment",
    "InputError",
    "LiveView",
    "Look",
    "Progress",
    "Psf",
    "Result",
    "Simulation",
    "WorkError",
    "_Batch",
    "_Cancel",
    "_DataTerm",
    "_Design",
    "_Frames",
    "_Operator",
    "_PsfCalibration",
    "_Reconstructor",
    "_Recorder",
    "_SensorCalibration",
    "_Source",
    "_TimingCalibration",
    "_View",
    "__version__",
    "_command",
    "_figure_of_folder",
    "_metadata",
    "_property_origin",
    "_psnr_db",
    "_read_properties",
    "_reconstruct_chunked",
    "_reconstruct_colour",
    "_save_colour",
    "_save_sweep",
    "_ssim",
    "_sweep_lines",
    "_sweep_path",
    "reconstruct",
    "set_threads",
    "simulate",
    "speckle_psf",
    "threads",
]

__version__: str

# number, time, counts, fault, last number
_Delivery: TypeAlias = tuple[int, int | None, NDArray[np.uint16] | None, str | None, int]
# frame, name, whether it has its video, residual/sigma, fit, seconds, message
_Line: TypeAlias = tuple[int, str, bool, float | None, str | None, float, str]

class InputError(ValueError):
    """An input breaks a rule: the message names the input, its value, the rule and the remedy.

    ``kind`` says what is wrong, ``parameter`` and ``path`` which input, ``value`` what was found;
    ``rule`` and ``remedy`` are the words of the message. They are None where they do not apply.
    """

    kind: str | None
    parameter: str | None
    path: str | None
    value: str | None
    rule: str | None
    remedy: str | None

class WorkError(RuntimeError):
    """The work itself failed: a full disk, no memory, numbers that overflowed.

    It has the attributes of :class:`InputError`.
    """

    kind: str | None
    parameter: str | None
    path: str | None
    value: str | None
    rule: str | None
    remedy: str | None

@final
class Camera:
    """A rolling-shutter camera and the field that it is asked to reconstruct.

    The names are the keys of the experiment file. Frames of a sensor with a mosaic (``bayer``) are reconstructed by
    :func:`reconstruct_colour`.

    Parameters
    ----------
    rows, columns : int
        Pixels of the frame on the working grid, after binning.
    shutter : str
        ``"top-down"``, ``"bottom-up"``, ``"dual-inside-out"``, ``"dual-outside-in"``, ``"custom"`` or ``"global"``.
    exposure_us : float
        Exposure of a row in microseconds.
    row_time_us : float, optional
        Time from the readout of one row to that of the next in microseconds; needed unless the shutter is global.
    row_order : sequence of int, optional
        The instant of every row, for the shutter ``"custom"``.
    binning : int
        Raw pixels along a side of a pixel of the working grid.
    bins_per_row : int
        Bins of the video in a row time.
    field : tuple of int, optional
        Rows and columns of the video, if it is larger than the sensor.
    pixel_pitch_um : float, optional
        Width of a pixel in micrometres.
    magnification : float, optional
        Size of an image on the sensor over that of the object.
    trigger_delay_us : float, optional
        From the trigger to the start of exposure of the row that is read first.
    bit_depth : int, optional
        Bits of the converter.
    bias_counts, gain_electrons_per_count, read_noise_electrons, full_well_counts : float, optional
        The numbers of :func:`rowburst.calibrate.sensor`.
    bayer : str, optional
        The mosaic: ``"rggb"``, ``"bggr"``, ``"grbg"`` or ``"gbrg"``.

    Raises
    ------
    InputError
        A value breaks a rule.

    Examples
    --------
    >>> zyla = rb.Camera(rows=108, columns=108, shutter="dual-inside-out", row_time_us=9.6, exposure_us=9.6)
    >>> zyla.video_shape, round(zyla.frame_rate_hz)
    ((54, 108, 108), 104167)
    """

    def __new__(
        cls,
        *,
        rows: int,
        columns: int,
        shutter: Literal["top-down", "bottom-up", "dual-inside-out", "dual-outside-in", "custom", "global"],
        exposure_us: float,
        row_time_us: float | None = None,
        row_order: Sequence[int] | None = None,
        binning: int = 1,
        bins_per_row: int = 1,
        field: tuple[int, int] | None = None,
        pixel_pitch_um: float | None = None,
        magnification: float | None = None,
        trigger_delay_us: float | None = None,
        bit_depth: int | None = None,
        bias_counts: float | None = None,
        gain_electrons_per_count: float | None = None,
        read_noise_electrons: float | None = None,
        full_well_counts: float | None = None,
        bayer: Literal["rggb", "bggr", "grbg", "gbrg"] | None = None,
    ) -> Camera: ...
    def replace(self, **changes: Any) -> Camera:
        """A camera that differs in the given arguments of the constructor.

        After a calibration of the sensor: ``camera.replace(**sensor.camera_fields)``.

        Parameters
        ----------
        **changes
            Arguments of :class:`Camera`.

        Returns
        -------
        Camera
            Another camera; this one stays as it is.

        Raises
        ------
        InputError
            A value breaks a rule.

        Examples
        --------
        >>> camera.replace(exposure_us=19.2).exposure_us
        19.2
        """
    @staticmethod
    def from_file(path: str | PathLike[str]) -> Camera:
        """The camera of an experiment file.

        Parameters
        ----------
        path : path
            The experiment file.

        Returns
        -------
        Camera
            The camera and the field.

        Raises
        ------
        InputError
            The file is missing or breaks a rule.

        Examples
        --------
        >>> rb.Camera.from_file("experiment.toml") == camera
        True
        """
    def to_toml(self) -> str:
        """The text of an experiment file with this camera.

        Returns
        -------
        str
            TOML, which :meth:`from_file` and the command line read.

        Examples
        --------
        >>> "[camera]" in camera.to_toml().splitlines()
        True
        """
    @property
    def rows(self) -> int:
        """Rows of the frame on the working grid."""
    @property
    def columns(self) -> int:
        """Columns of the frame on the working grid."""
    @property
    def shutter(self) -> str:
        """The readout order, such as ``dual-inside-out``."""
    @property
    def row_order(self) -> list[int] | None:
        """The instant of every row for the shutter ``custom``."""
    @property
    def bayer(self) -> str | None:
        """The mosaic of a colour sensor whose frames are raw, such as ``rggb``."""
    @property
    def row_time_us(self) -> float:
        """Time from the readout of one row to that of the next, in microseconds."""
    @property
    def exposure_us(self) -> float:
        """Exposure of a row, in microseconds."""
    @property
    def bins_per_row(self) -> int:
        """Bins of the video in a row time."""
    @property
    def binning(self) -> int:
        """Raw pixels along a side of a pixel of the working grid."""
    @property
    def field(self) -> tuple[int, int]:
        """``(rows, columns)`` of the video."""
    @property
    def pixel_pitch_um(self) -> float | None:
        """Width of a pixel in micrometres; None where it is unknown."""
    @property
    def magnification(self) -> float | None:
        """Size of an image on the sensor over that of the object; None where it is unknown."""
    @property
    def trigger_delay_us(self) -> float | None:
        """From the trigger to the zero of time, in microseconds; None where it is unknown."""
    @property
    def bit_depth(self) -> int | None:
        """Bits of the converter; None where they are unknown."""
    @property
    def bias_counts(self) -> float | None:
        """Counts of a pixel without light; None where they are unknown."""
    @property
    def gain_electrons_per_count(self) -> float | None:
        """Electrons of a count; None where they are unknown."""
    @property
    def read_noise_electrons(self) -> float | None:
        """Standard deviation of the read noise, in electrons; None where it is unknown."""
    @property
    def full_well_counts(self) -> float | None:
        """Counts at which a pixel is full; None where they are unknown."""
    @property
    def video_shape(self) -> tuple[int, int, int]:
        """``(bins, rows, columns)`` of the video."""
    @property
    def frame_shape(self) -> tuple[int, int]:
        """``(rows, columns)`` of the frame on the working grid."""
    @property
    def frame_rate_hz(self) -> float:
        """Frames of the video a second."""
    @property
    def time_us(self) -> NDArray[np.float64]:
        """The middle of each bin of the video, in microseconds from the start of exposure of the row that is read first."""
    def row_time_weights(self) -> NDArray[np.float32]:
        """``w[r, j]``: overlap of the exposure of row ``r`` with bin ``j``, in row times.

        Returns
        -------
        numpy.ndarray
            float32 ``[row, bin]``.

        Examples
        --------
        >>> weights = camera.row_time_weights()
        >>> weights.shape, float(weights[0].sum())
        ((24, 12), 1.0)
        """
    def _repr_html_(self) -> str: ...

@final
class Psf:
    """A point-spread function that sums to 1, or several that share out the field.

    The element at ``(height // 2, width // 2)`` is zero displacement.

    Parameters
    ----------
    values : array
        The PSF ``[y, x]``, not negative; it is scaled to the sum 1.

    Raises
    ------
    InputError
        An element is negative or not finite, or all are zero.

    Examples
    --------
    >>> centred = rb.Psf(np.eye(5))
    >>> centred.shape, float(centred.array.sum())
    ((5, 5), 1.0)
    """

    def __new__(cls, values: ArrayLike) -> Psf: ...
    @staticmethod
    def patches(values: Sequence[ArrayLike], offsets_px: Sequence[tuple[float, float]]) -> Psf:
        """PSFs with the offset ``(dy, dx)`` of each one's source from the middle of the field.

        Parameters
        ----------
        values : sequence of array
            The PSFs ``[y, x]``, of one size.
        offsets_px : sequence of tuple
            The offset of each, in pixels.

        Returns
        -------
        Psf
            PSFs that share out the field.

        Raises
        ------
        InputError
            The numbers of PSFs and offsets differ, or a PSF breaks a rule.

        Examples
        --------
        >>> pair = rb.Psf.patches([np.eye(5), np.eye(5)[::-1]], [(-10, 0), (10, 0)])
        >>> len(pair.arrays), pair.offsets_px
        (2, [(-10.0, 0.0), (10.0, 0.0)])
        """
    @staticmethod
    def from_file(path: str | PathLike[str], camera: Camera) -> Psf:
        """An image, or the patch set of ``rowburst calibrate psf``, as the command line reads it.

        Parameters
        ----------
        path : path
            The file.
        camera : Camera
            The camera that the PSF is for.

        Returns
        -------
        Psf
            The PSF, which sums to 1.

        Raises
        ------
        InputError
            The file is missing, damaged or of another kind.

        Examples
        --------
        >>> rb.Psf.from_file("psf.npy", camera).shape
        (47, 59)
        """
    @property
    def array(self) -> NDArray[np.float32]:
        """The PSF nearest to the middle of the field, ``[y, x]``."""
    @property
    def arrays(self) -> list[NDArray[np.float32]]:
        """The PSF of each patch, ``[y, x]``; each sums to 1."""
    @property
    def offsets_px(self) -> list[tuple[float, float]]:
        """The offset ``(dy, dx)`` of each patch's source from the middle of the field, in pixels."""
    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the PSF nearest to the middle."""
    def _repr_html_(self) -> str: ...
    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]: ...

@final
class Experiment:
    """The content of an experiment file and of the files that it names.

    Parameters
    ----------
    path : path
        The experiment file, as ``rowburst init`` writes it.
    frame : path, optional
        A frame or a recording: keys that the file leaves open are taken from its metadata, also from that of a camera
        maker's file.

    Raises
    ------
    InputError
        The file or one that it names is missing or breaks a rule.

    Examples
    --------
    >>> experiment = rb.Experiment("experiment.toml")
    >>> experiment.prior, experiment.psf.shape
    ('tv', (47, 59))
    >>> experiment.reconstructor(max_iterations=5)(frame).prior
    'tv'
    """

    def __new__(
        cls, path: str | PathLike[str], frame: str | PathLike[str] | None = None
    ) -> Experiment: ...
    @property
    def camera(self) -> Camera:
        """The camera and the field."""
    @property
    def psf(self) -> Psf | None:
        """The PSF, or the PSFs of a patch set; None where the file names none."""
    @property
    def dark(self) -> NDArray[np.float32] | None:
        """The frame without light ``[y, x]``, in counts; None where the file names none."""
    @property
    def flat(self) -> NDArray[np.float32] | None:
        """The frame of even light ``[y, x]``, in counts; None where the file names none."""
    @property
    def bad_pixels(self) -> NDArray[np.float32] | None:
        """The mask ``[y, x]``, not 0 at bad pixels; None where the file names none."""
    @property
    def prior(self) -> str:
        """The prior; ``auto`` where the file names none."""
    @property
    def tau(self) -> str | float:
        """The weight of the prior, ``auto`` or ``held-out``."""
    def reconstructor(self, **options: Any) -> Any:
        """A reconstructor with everything that the file says.

        Parameters
        ----------
        **options
            Arguments of :class:`Reconstructor`, which take precedence.

        Returns
        -------
        Reconstructor
            Set up once, called for each frame.

        Raises
        ------
        InputError
            An argument breaks a rule, or the file names no PSF.

        Examples
        --------
        >>> rb.Experiment("experiment.toml").reconstructor(max_iterations=5)(frame).prior
        'tv'
        """
    @property
    def frame_period_us(self) -> float | None:
        """Time from the start of a frame to that of the next, in microseconds; None where it is unknown."""
    @property
    def guide(self) -> list[NDArray[np.float32]]:
        """The pictures ``[y, x]`` of ``[[guide]]``, by a second camera; :func:`reconstruct` uses them."""
    @property
    def guide_exposures_us(self) -> list[tuple[float, float] | None]:
        """The middle of the exposure of each of these pictures and its length in microseconds; None where they are unknown."""
    @property
    def metadata_taken(self) -> dict[str, str]:
        """Keys that came from metadata, with their values as text."""
    @property
    def metadata_warnings(self) -> list[str]:
        """Contradictions between metadata and file, and metadata that cannot be used."""

@final
class Simulation:
    """A simulated capture with all that is known of it."""

    @property
    def camera(self) -> Camera:
        """The camera that recorded the frame."""
    @property
    def psf(self) -> Psf:
        """The PSF that the frame was made with."""
    @property
    def frame(self) -> NDArray[Any]:
        """The frame as :func:`reconstruct` takes it.

        Integers where the camera has a bias, as a sensor gives them; without noise, floating-point numbers
        without the bias. float32 where the camera has none.
        """
    @property
    def truth(self) -> NDArray[np.float32]:
        """The video ``[t, y, x]``, in counts of the frame."""
    @property
    def direct(self) -> NDArray[np.float32]:
        """The frame of the same camera without the diffuser."""
    @property
    def background(self) -> NDArray[np.float32] | None:
        """The static background ``[y, x]`` in ``truth``, in counts; None without one."""
    @property
    def noise_sigma(self) -> float:
        """Standard deviation of the noise, in counts."""
    @property
    def leds(self) -> list[tuple[float, float, float, float]]:
        """``(y, x, frequency_hz, phase)`` of each LED."""
    def save(self, folder: str | PathLike[str]) -> Path:
        """Writes the files of ``rowburst simulate`` into a folder, which is returned.

        They are ``experiment.toml``, ``frame.npy``, ``psf.npy``, ``truth.npy`` and ``simulation.json``:
        ``rb.reconstruct(folder / "frame.npy", rb.Experiment(folder / "experiment.toml"))`` runs as it stands.

        Parameters
        ----------
        folder : path
            The folder.

        Returns
        -------
        pathlib.Path
            The folder.

        Raises
        ------
        WorkError
            A file cannot be written.

        Examples
        --------
        >>> folder = rb.simulate(camera, "moving", psf).save("simulated")
        >>> rb.Experiment(folder / "experiment.toml").camera == camera
        True
        """
    def _repr_html_(self) -> str: ...

@final
class Progress:
    """An iteration, as a progress callback sees it."""

    @property
    def label(self) -> str:
        """The step that the solver runs for, such as a prior that is tested; empty in the final run."""
    @property
    def iteration(self) -> int:
        """Iterations of this run, from 1."""
    @property
    def max_iterations(self) -> int:
        """Most iterations of this run."""
    @property
    def residual_over_sigma(self) -> float:
        """Rms of the residual over sigma."""
    @property
    def tau(self) -> float:
        """The weight of the prior at this iteration."""
    @property
    def change(self) -> float:
        """Relative change of the video by this iteration."""
    @property
    def seconds(self) -> float:
        """Seconds since the call."""

@final
class LiveView:
    """A live view: frames of one scene, each warm-started from the previous one.

    A frame that was stopped early is not lost: the next one continues from its state. Where the last video explains less
    than half of the variance of the frame, the solver starts from zero. Videos depend on earlier frames: use them for
    display, not for measurement.

    Parameters
    ----------
    camera : Camera
        The camera.
    psf : Psf, array or path
        The point-spread function ``[y, x]``.
    prior : str
        ``"auto"`` is the standard prior ``tv+0.5*tdiff+support`` here.
    tau, noise_sigma, dark, flat, bad_pixels, tuning
        Those of :func:`reconstruct`.
    threads : int, optional
        Threads of this view alone; by default all those of the process (:func:`threads`).

    Raises
    ------
    InputError
        An argument breaks a rule.
    WorkError
        The machine has too little memory.

    Examples
    --------
    >>> live = rb.LiveView(camera, psf)
    >>> look = live.next(frame, time_budget_s=0.1)
    >>> look.video.shape, look.went_on
    ((12, 24, 30), False)
    """

    def __new__(
        cls,
        camera: Camera,
        psf: Psf | ArrayLike | PathLike[str] | None,
        *,
        prior: str = "auto",
        tau: float | str | None = None,
        noise_sigma: float | None = None,
        dark: ArrayLike | PathLike[str] | None = None,
        flat: ArrayLike | PathLike[str] | None = None,
        bad_pixels: ArrayLike | PathLike[str] | None = None,
        tuning: Mapping[str, float] | None = None,
        threads: int | None = None,
    ) -> LiveView: ...
    def next(self, frame: ArrayLike | PathLike[str], *, time_budget_s: float | None = None) -> Look:
        """The video of the next frame; the budget limits the iterations, not the evaluation after them.

        The bias of the camera is subtracted from integers, not from an array of floating-point numbers.

        Parameters
        ----------
        frame : array or path
            The frame ``[y, x]``.
        time_budget_s : float, optional
            Limit of the iterations, in seconds.

        Returns
        -------
        Look
            The video and whether it can be trusted.

        Raises
        ------
        InputError
            The frame breaks a rule.

        Examples
        --------
        >>> rb.LiveView(camera, psf).next(frame, time_budget_s=0.1).video.shape
        (12, 24, 30)
        """
    def forget(self) -> None:
        """The next frame starts from zero.

        Examples
        --------
        >>> live = rb.LiveView(camera, psf)
        >>> first = live.next(frame)
        >>> live.forget()
        >>> live.next(frame).went_on
        False
        """

@final
class Look:
    """A frame of a :class:`LiveView`."""

    @property
    def video(self) -> NDArray[np.float32]:
        """``[t, y, x]``, in counts. It may not be written to."""
    @property
    def residual_over_sigma(self) -> float:
        """Rms of the residual over sigma: about 1 where the video explains the frame."""
    @property
    def iterations(self) -> int:
        """Iterations for this frame."""
    @property
    def went_on(self) -> bool:
        """Whether it was warm-started from the previous frame."""
    @property
    def fit(self) -> str:
        """good, suspicious or bad: whether the model explains the frame."""
    @property
    def seconds(self) -> float:
        """Time of this frame, in seconds."""

@final
class Result:
    @property
    def video(self) -> NDArray[np.float32]: ...
    @property
    def background(self) -> NDArray[np.float32] | None: ...
    @property
    def residual(self) -> NDArray[np.float32]: ...
    @property
    def prior(self) -> str: ...
    @property
    def tau(self) -> float: ...
    @property
    def noise_sigma(self) -> float: ...
    @property
    def effective_sigma(self) -> float: ...
    @property
    def excluded(self) -> NDArray[np.uint8]: ...
    @property
    def excluded_fraction(self) -> float: ...
    @property
    def stray_light(self) -> NDArray[np.float32] | None: ...
    @property
    def stray_light_fraction(self) -> float: ...
    @property
    def corrected_psf(self) -> Psf | None: ...
    @property
    def coverage(self) -> NDArray[np.uint8]: ...
    @property
    def coverage_fraction(self) -> float: ...
    @property
    def residual_over_sigma(self) -> float: ...
    @property
    def iterations(self) -> int: ...
    @property
    def stop_reason(self) -> str: ...
    @property
    def fit(self) -> str: ...
    @property
    def fit_reason(self) -> str: ...
    @property
    def seconds(self) -> float: ...
    @property
    def setup_seconds(self) -> float: ...
    @property
    def frame_rate_hz(self) -> float: ...
    @property
    def _camera(self) -> Camera: ...
    def _json(self) -> str: ...
    def _traces(self, regions: list[str], photodiodes: list[str]) -> tuple[list[dict[str, Any]], str]: ...
    def _report(self, title: str) -> str: ...
    def _figure(self, layout: str) -> tuple[str, bytes, bytes]: ...
    def _save(self, folder: str | PathLike[str], title: str, formats: str | None = None) -> None: ...

@final
class _Reconstructor:
    def __new__(
        cls,
        camera: Camera,
        psf: Psf | ArrayLike | PathLike[str] | None,
        *,
        prior: str = "auto",
        tau: str | float | None = None,
        noise_sigma: float | None = None,
        max_iterations: int | None = None,
        dark: ArrayLike | PathLike[str] | None = None,
        flat: ArrayLike | PathLike[str] | None = None,
        bad_pixels: ArrayLike | PathLike[str] | None = None,
        experiment: Experiment | None = None,
        self_calibrate: str = "auto",
        keep_all_pixels: bool = False,
        threads: int | None = None,
        tuning: Mapping[str, float] | None = None,
        corrected: bool = False,
    ) -> _Reconstructor: ...
    def reconstruct(
        self,
        frame: ArrayLike | PathLike[str],
        *,
        truth: ArrayLike | PathLike[str] | None = None,
        direct: ArrayLike | PathLike[str] | None = None,
        progress: Callable[[Progress], object] | None = None,
        seed: int = ...,
        time_budget_s: float | None = None,
        debias: bool = False,
        cancel: _Cancel | None = None,
        prior: str | None = None,
        tau: str | float | None = None,
        noise_sigma: float | None = None,
        max_iterations: int | None = None,
        raw: bool = False,
    ) -> Result: ...
    def check(
        self,
        *,
        prior: str | None = None,
        tau: str | float | None = None,
        noise_sigma: float | None = None,
        max_iterations: int | None = None,
    ) -> None: ...

@final
class _Cancel:
    def __new__(cls) -> _Cancel: ...
    def cancel(self) -> None: ...

@final
class _Frames:
    def __new__(cls, path: str | PathLike[str]) -> _Frames: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> NDArray[Any]: ...
    def name(self, index: int) -> str: ...
    def read(self) -> NDArray[Any]: ...

@final
class _Source:
    def __new__(cls, name: str) -> _Source: ...
    def settings(self) -> str: ...
    def skip_to_latest(self) -> int: ...
    def next(self) -> _Delivery | None: ...

@final
class _Recorder:
    def __new__(
        cls,
        path: str | PathLike[str],
        purpose: str,
        source: str,
        properties: Sequence[tuple[str, str | None, str]],
        requested: int | None = None,
        camera: str | None = None,
    ) -> _Recorder: ...
    def take(
        self, number: int, time_us: int | None, counts: NDArray[np.uint16] | None, incomplete: str | None, last: int
    ) -> None: ...
    def finish(self, ended: str) -> str: ...

def _property_origin(name: str) -> str: ...
def _read_properties(
    source: str, properties: Sequence[tuple[str, str | None, str]], camera: str | None = None
) -> str: ...

@final
class _View:
    def __new__(cls, results: Sequence[str | PathLike[str]], port: int | None = None) -> _View: ...
    @property
    def url(self) -> str: ...
    def close(self) -> None: ...

@final
class _Operator:
    def __new__(cls, camera: Camera, psf: Psf | ArrayLike | PathLike[str] | None) -> _Operator: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def psf(self) -> Psf: ...
    def apply(self, x: ArrayLike) -> NDArray[np.float32]: ...
    def apply_double(self, x: ArrayLike) -> NDArray[np.float64]: ...
    def adjoint(self, y: ArrayLike) -> NDArray[np.float32]: ...
    def adjoint_double(self, y: ArrayLike) -> NDArray[np.float64]: ...

@final
class _DataTerm:
    def __new__(cls, operator: _Operator, frame: ArrayLike | PathLike[str]) -> _DataTerm: ...
    def value(self, x: ArrayLike) -> float: ...
    def gradient(self, x: ArrayLike) -> NDArray[np.float32]: ...
    def prox(self, x: ArrayLike, step: float) -> NDArray[np.float32]: ...

@final
class _Batch:
    def __new__(
        cls,
        experiment: str | PathLike[str],
        frames: str | PathLike[str],
        out: str | PathLike[str],
        *,
        psf: str | PathLike[str] | None = None,
        dark: str | PathLike[str] | None = None,
        flat: str | PathLike[str] | None = None,
        bad_pixels: str | PathLike[str] | None = None,
        prior: str | None = None,
        tau: str | None = None,
        noise_sigma: float | None = None,
        max_iterations: int | None = None,
        frame_period_us: float | None = None,
        self_calibrate: str = "auto",
        keep_all_pixels: bool = False,
    ) -> _Batch: ...
    @staticmethod
    def of_values(
        camera: Camera,
        psf: Psf | ArrayLike | PathLike[str] | None,
        frames: Any,
        out: str | PathLike[str],
        *,
        dark: ArrayLike | PathLike[str] | None = None,
        flat: ArrayLike | PathLike[str] | None = None,
        bad_pixels: ArrayLike | PathLike[str] | None = None,
        prior: str = "auto",
        tau: str | float | None = None,
        noise_sigma: float | None = None,
        max_iterations: int | None = None,
        frame_period_us: float | None = None,
        self_calibrate: str = "auto",
        keep_all_pixels: bool = False,
        tuning: Mapping[str, float] | None = None,
        threads: int | None = None,
    ) -> _Batch: ...
    @property
    def count(self) -> int: ...
    def left(self, first: int, end: int, retry_failed: bool = False) -> list[int]: ...
    def prior(self) -> tuple[str, str]: ...
    def self_calibration(self) -> str | None: ...
    def run(self, frames: list[int], threads: int | None = None) -> list[_Line]: ...
    def rows(self) -> list[_Line]: ...
    def write_table(self) -> str | PathLike[str]: ...
    def video(self, frame: int) -> NDArray[np.float32]: ...

@final
class _SensorCalibration:
    def __new__(cls, darks: Any, flats: Any, *, threads: int | None = None) -> _SensorCalibration: ...
    def json(self) -> str: ...
    @property
    def dark(self) -> NDArray[np.float32]: ...
    @property
    def flat(self) -> NDArray[np.float32]: ...
    @property
    def response(self) -> NDArray[np.float32]: ...
    @property
    def read_noise(self) -> NDArray[np.float32]: ...
    @property
    def bad_pixels(self) -> NDArray[np.bool_]: ...
    def save(self, folder: str | PathLike[str]) -> None: ...

@final
class _PsfCalibration:
    def __new__(
        cls,
        captures: Any,
        *,
        dark: ArrayLike | PathLike[str] | None = None,
        camera: Camera | None = None,
        exposures_ms: Sequence[float] = ...,
        positions_mm: list[tuple[float, float]] | None = None,
        binning: int | None = None,
        saturation_counts: float | None = None,
        field: tuple[int, int] | None = None,
        expected_grain_px: float | None = None,
        pinhole_um: float | None = None,
        all_patches: bool = False,
        threads: int | None = None,
    ) -> _PsfCalibration: ...
    def json(self) -> str: ...
    @property
    def psf(self) -> Psf: ...
    @property
    def patches(self) -> Psf | None: ...
    def save(self, folder: str | PathLike[str]) -> None: ...

@final
class _TimingCalibration:
    def __new__(
        cls,
        frames: Any,
        *,
        frequency_hz: float | None = None,
        duty: float | None = None,
        signal: Any = None,
        repeat: bool = False,
        dark: ArrayLike | PathLike[str] | None = None,
        flat: ArrayLike | PathLike[str] | None = None,
        camera: Camera | None = None,
        threads: int | None = None,
    ) -> _TimingCalibration: ...
    def json(self) -> str: ...
    @property
    def binning(self) -> int: ...
    def save(self, folder: str | PathLike[str]) -> None: ...

@final
class _Design:
    def __new__(
        cls,
        camera: Camera | None = None,
        psf: Psf | ArrayLike | PathLike[str] | None = None,
        *,
        wavelength_nm: float,
        pupil_mm: float,
        focal_length_mm: float,
        magnification: float,
        na: float | None,
        diffuser_deg: float,
        photons: float,
        bright_pixels: int,
        quantum_efficiency: float,
        read_noise_electrons: float | None,
        full_well_electrons: float | None,
        source_bandwidth_nm: float,
        diffuser_path_rms_nm: float | None,
        trials: bool,
        trial_snrs: Sequence[float],
        seed: int,
        progress: Callable[[float], object] | None = None,
        scene: ArrayLike | PathLike[str] | None = None,
        threads: int | None = None,
    ) -> _Design: ...
    def json(self) -> str: ...
    def sections(self) -> list[tuple[str, list[tuple[str, str]]]]: ...
    def save(self, folder: str | PathLike[str]) -> None: ...

def _command(arguments: list[str]) -> int: ...
def _reconstruct_colour(
    frame: ArrayLike | PathLike[str],
    camera: Camera,
    psf: Psf | ArrayLike | PathLike[str] | None,
    *,
    prior: str = "auto",
    tau: str | float | None = None,
    noise_sigma: float | None = None,
    time_budget_s: float | None = None,
    max_iterations: int | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    progress: Callable[[Progress], object] | None = None,
    seed: int = ...,
    experiment: Experiment | None = None,
    keep_all_pixels: bool = False,
    debias: bool = False,
    threads: int | None = None,
    tuning: Mapping[str, float] | None = None,
    corrected: bool = False,
) -> tuple[NDArray[np.float32], list[tuple[str, float, Result]]]: ...
def _reconstruct_chunked(
    frame: ArrayLike | PathLike[str],
    camera: Camera,
    psf: Psf | ArrayLike | PathLike[str] | None,
    folder: str | PathLike[str],
    *,
    bins_per_chunk: int | None = None,
    bins: tuple[int, int] | None = None,
    prior: str = "auto",
    tau: str | float | None = None,
    noise_sigma: float | None = None,
    max_iterations: int | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    progress: Callable[[Progress], object] | None = None,
    experiment: Experiment | None = None,
    threads: int | None = None,
    tuning: Mapping[str, float] | None = None,
    corrected: bool = False,
) -> str: ...
def _metadata(path: str | PathLike[str]) -> tuple[dict[str, Any], list[str], list[str]]: ...
def _psnr_db(video: ArrayLike | PathLike[str], truth: ArrayLike | PathLike[str]) -> float: ...
def _ssim(video: ArrayLike | PathLike[str], truth: ArrayLike | PathLike[str]) -> float: ...
def _save_colour(
    folder: str | PathLike[str], title: str, bayer: str, planes: Sequence[tuple[str, float, Result]]
) -> None: ...
def _sweep_path(folder: str | PathLike[str], label: str) -> str | PathLike[str]: ...
def _sweep_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]: ...
def _save_sweep(folder: str | PathLike[str], rows: Sequence[Mapping[str, Any]]) -> None: ...
def _figure_of_folder(folder: str | PathLike[str], layout: str) -> tuple[str, bytes, bytes]: ...
def reconstruct(
    frame: ArrayLike | PathLike[str],
    camera: Camera,
    psf: Psf | ArrayLike | PathLike[str] | None,
    *,
    prior: str = "auto",
    tau: str | float | None = None,
    noise_sigma: float | None = None,
    time_budget_s: float | None = None,
    max_iterations: int | None = None,
    dark: ArrayLike | PathLike[str] | None = None,
    flat: ArrayLike | PathLike[str] | None = None,
    bad_pixels: ArrayLike | PathLike[str] | None = None,
    truth: ArrayLike | PathLike[str] | None = None,
    direct: ArrayLike | PathLike[str] | None = None,
    progress: Callable[[Progress], object] | None = None,
    seed: int = 0,
    experiment: Experiment | None = None,
    self_calibrate: str = "auto",
    keep_all_pixels: bool = False,
    debias: bool = False,
    threads: int | None = None,
    tuning: Mapping[str, float] | None = None,
    corrected: bool = False,
    guide: list[ArrayLike] | None = None,
    guide_exposures_us: list[tuple[float, float]] | None = None,
    guide_model: str | None = None,
    files: Mapping[str, Any] | None = None,
) -> Result: ...
def simulate(
    camera: Camera,
    scene: str | PathLike[str] | ArrayLike | None = None,
    psf: Psf | ArrayLike | PathLike[str] | None = None,
    *,
    snr: float = 256.0,
    peak_electrons: float | None = None,
    scene_electrons: float | None = None,
    background: float | None = None,
    seed: int = 1,
    digit_px: int = 12,
    threads: int | None = None,
) -> Simulation:
    """The frame that a camera records of a scene.

    Parameters
    ----------
    camera : Camera
        The camera.
    scene : str, path or array, optional
        ``"digits"`` (the default), ``"leds"``, ``"moving"``, ``"two-moving"``, or a video ``[t, y, x]`` that is fitted to
        the field.
    psf : Psf, array or path, optional
        The point-spread function ``[y, x]``; by default a speckle PSF is computed.
    snr : float
        Rms of the noiseless frame over the noise; ``inf`` for none.
    peak_electrons, scene_electrons : float, optional
        Shot and read noise instead of ``snr``: electrons in the brightest pixel of the frame, or from the brightest pixel
        of the scene in a bin. The camera needs gain and read noise.
    background : float, optional
        Brightness of a static background over that of the scene.
    seed : int
        The seed of scene and noise.
    digit_px : int
        Height of the digits in pixels.
    threads : int, optional
        Threads of this call alone; by default all those of the process (:func:`threads`).

    Returns
    -------
    Simulation
        The frame with the true video.

    Raises
    ------
    InputError
        An argument breaks a rule.
    WorkError
        The machine has too little memory.

    Examples
    --------
    >>> made = rb.simulate(camera, "moving", psf, snr=100)
    >>> made.frame.shape, made.truth.shape
    ((24, 30), (12, 24, 30))
    """

def speckle_psf(
    camera: Camera,
    *,
    wavelength_nm: float = 532.0,
    pupil_mm: float = 1.71,
    focal_length_mm: float = 50.0,
    magnification: float = ...,
    na: float | None = None,
    diffuser_deg: float = 1.0,
    diffuser_phase: float = 4.0,
    seed: int = 1,
) -> Psf:
    """A random speckle PSF of a diffuser behind a lens, for every displacement that a camera sees.

    Parameters
    ----------
    camera : Camera
        The camera; its pixel pitch is that of the paper where it has none.
    wavelength_nm : float
        Wavelength in nanometres.
    pupil_mm, focal_length_mm : float
        Diameter of the pupil and focal length of the lens in millimetres.
    magnification : float
        Size on the sensor over size in the scene.
    na : float, optional
        Numerical aperture on the side of the sensor, instead of the diameter of the pupil.
    diffuser_deg : float
        Full width at half maximum of its scattering in degrees.
    diffuser_phase : float
        Rms of its phase in radians.
    seed : int
        The seed of the diffuser.

    Returns
    -------
    Psf
        The PSF ``[y, x]``.

    Raises
    ------
    InputError
        An argument breaks a rule.

    Examples
    --------
    >>> rb.speckle_psf(camera).shape
    (47, 59)
    """

def set_threads(threads: int) -> None:
    """Sets the number of threads of this process, before anything is computed.

    Later only the number that runs already is accepted.

    Parameters
    ----------
    threads : int
        Number of threads.

    Raises
    ------
    InputError
        The number is below 1.
    WorkError
        Another number runs already, or the process was forked.

    Examples
    --------
    >>> rb.set_threads(rb.threads())
    """

def threads() -> int:
    """Number of threads that computations use.

    Returns
    -------
    int
        Threads of this process.

    Examples
    --------
    >>> rb.threads() >= 1
    True
    """
