"""``design``: what a camera, a lens and a diffuser can do before they are bought."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import _rowburst
from ._checks import check_camera, checked_array, checked_psf
from ._display import table_html
from ._errors import input_error
from ._extras import need
from ._rowburst import Camera, Psf
from ._stored import Stored, stored


class Design:
    """A planned set-up and what it can do. :func:`design` makes it."""

    def __init__(self, native: _rowburst._Design | Stored) -> None:
        self._native = native

    @property
    def numbers(self) -> dict[str, Any]:
        """The content of ``design.json`` of the command line."""
        numbers: dict[str, Any] = json.loads(self._native.json())
        return numbers

    @property
    def warnings(self) -> list[str]:
        """What falls short."""
        warnings: list[str] = self.numbers["warnings"]
        return warnings

    def save(self, folder: str | PathLike[str]) -> Path:
        """Writes ``report.html``, its pictures and ``design.json`` into a folder.

        Parameters
        ----------
        folder : path
            The folder, which is made where it is missing.

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
        >>> rb.design(trials=False).save("design").name
        'design'
        """
        self._native.save(folder)
        return Path(folder)

    def __reduce__(self) -> tuple[Any, ...]:
        return Design, (stored(self._native, ()),)

    def __repr__(self) -> str:
        n = self.numbers
        return (
            f"<rowburst.Design: {n['frames']} frames at {n['frame_rate_hz']:.0f} fps, SNR {n['snr_per_pixel']:.0f}, "
            f"{n['recoverable_pixels_per_bin']:.0f} pixels a bin, {len(n['warnings'])} warnings>"
        )

    def __str__(self) -> str:
        lines = []
        for heading, pairs in self._native.sections():
            lines += [heading, *(f"  {name:<31} {value}" for name, value in pairs)]
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])

    def _repr_html_(self) -> str:
        tables = [table_html(heading, dict(pairs)) for heading, pairs in self._native.sections()]
        return "".join(tables) + (table_html("Warnings", dict(enumerate(self.warnings, 1))) if self.warnings else "")


def design(
    camera: Camera | None = None,
    psf: Psf | ArrayLike | PathLike[str] | None = None,
    *,
    wavelength_nm: float = 532.0,
    pupil_mm: float = 1.71,
    focal_length_mm: float = 50.0,
    magnification: float = 1 / 22.5,
    na: float | None = None,
    diffuser_deg: float = 1.0,
    photons: float = 2e7,
    bright_pixels: int = 10,
    quantum_efficiency: float = 0.6,
    read_noise_electrons: float | None = None,
    full_well_electrons: float | None = None,
    source_bandwidth_nm: float = 1.0,
    diffuser_path_rms_nm: float | None = None,
    trials: bool = True,
    trial_snr: Sequence[float] = (),
    seed: int = 1,
    progress: Callable[[float], object] | bool | None = None,
    scene: ArrayLike | PathLike[str] | None = None,
    threads: int | None = None,
) -> Design:
    """What a camera, a lens and a diffuser can do, with the numbers of ``rowburst design``.

    Parameters
    ----------
    camera : Camera, optional
        The camera and its field; by default the paper's.
    psf : Psf, array or path, optional
        A recorded PSF; without one, speckle of these optics is computed.
    wavelength_nm, pupil_mm, focal_length_mm, magnification, na, diffuser_deg : float
        Wavelength, diameter of the pupil, focal length, magnification from scene to sensor, image-side numerical aperture
        (in place of the pupil), and full angle of the diffuser.
    photons : float
        Photons of one bright scene pixel in one bin that pass the lens.
    bright_pixels : int
        Bright pixels of the scene in a bin.
    quantum_efficiency : float
        Electrons per photon.
    read_noise_electrons, full_well_electrons : float, optional
        Of a raw pixel; by default the camera's, or 1.5 and 30000.
    source_bandwidth_nm : float
        Full width of the source's spectrum in nanometres.
    diffuser_path_rms_nm : float, optional
        Rms of the optical path through the diffuser in nanometres; by default 4 radians.
    trials : bool
        Whether trial reconstructions are made, which take most of a minute.
    trial_snr : sequence of float
        SNRs of the trials; by default 8 to 256, each twice the last.
    seed : int
        Seed of speckle, scenes and noise.
    progress : bool or callable, optional
        ``True`` for a tqdm bar, or a function that is called with the part of the trials that is done, from 0 to 1.
        ``False`` from it ends them with an error.
    scene : array or path, optional
        A video ``[t, y, x]`` of the scene, which is fitted to the field: how many numbers of an instant speak about its
        change.
    threads : int, optional
        Threads of this call alone; by default all those of the process (:func:`threads`).

    Returns
    -------
    Design
        The numbers, and what falls short.

    Raises
    ------
    InputError
        An argument breaks a rule.

    Examples
    --------
    >>> planned = rb.design(trials=False)
    >>> round(planned.numbers["frame_rate_hz"])
    104167
    """
    if camera is not None:
        check_camera(camera, takes_experiment=False)
    bar, callback = _listener(progress)
    try:
        native = _rowburst._Design(
            camera,
            checked_psf(psf),
            wavelength_nm=wavelength_nm,
            pupil_mm=pupil_mm,
            focal_length_mm=focal_length_mm,
            magnification=magnification,
            na=na,
            diffuser_deg=diffuser_deg,
            photons=photons,
            bright_pixels=bright_pixels,
            quantum_efficiency=quantum_efficiency,
            read_noise_electrons=read_noise_electrons,
            full_well_electrons=full_well_electrons,
            source_bandwidth_nm=source_bandwidth_nm,
            diffuser_path_rms_nm=diffuser_path_rms_nm,
            trials=trials,
            trial_snrs=trial_snr,
            seed=seed,
            progress=callback,
            scene=checked_array("scene", scene),
            threads=threads,
        )
    finally:
        if bar is not None:
            bar.close()
    return Design(native)


class _PartBar:
    """A tqdm bar of the part that is done, in percent."""

    def __init__(self) -> None:
        self.bar = need("tqdm.auto", "progress=True").tqdm(total=100, unit="%", leave=False)

    def __call__(self, part: float) -> None:
        self.bar.update(round(100 * part) - self.bar.n)

    def close(self) -> None:
        self.bar.close()


def _listener(progress: object) -> tuple[_PartBar | None, Callable[[float], object] | None]:
    """The bar of the trials, if there is one, and what is called with the part that is done."""
    if progress is None or callable(progress):
        return None, progress
    if isinstance(progress, (bool, np.bool_)):
        bar = _PartBar() if progress else None
        return bar, bar
    rule = "it is True for a tqdm bar, or a function of the part that is done, from 0 to 1"
    raise input_error("progress", repr(progress), rule, "Give progress=True, or leave it out.")
