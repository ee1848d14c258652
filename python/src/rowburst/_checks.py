"""Checks of arguments. Their errors name the argument, what was found, and what it may be.

Numbers that are given to the extension are checked there.
"""

from __future__ import annotations

import math
import operator
from os import PathLike, fspath
from typing import Any

import numpy as np

from ._errors import input_error
from ._rowburst import Camera, Experiment, Psf


def shown(value: object) -> str:
    """What a message says of a value: numbers and text as they are, of anything else its type."""
    if isinstance(value, (str, bytes)):
        return repr(value)
    if isinstance(value, PathLike):
        return repr(fspath(value))
    if value is None or isinstance(value, (bool, int, float, complex, np.generic)):
        return str(value)
    return f"an object of type {type(value).__name__}"


def is_bool(value: object) -> bool:
    """Whether a value is a truth value of Python or numpy."""
    return isinstance(value, (bool, np.bool_))


def checked_whole(name: str, value: Any, least: int, remedy: str = "Leave it out.") -> int:
    """A whole number from ``least`` on."""
    if not is_bool(value):
        try:
            number = operator.index(value)
        except TypeError:
            number = least - 1
        if number >= least:
            return number
    raise input_error(name, shown(value), f"it is a whole number from {least}", remedy)


def check_number(name: str, value: Any, remedy: str = "Leave it out.") -> None:
    """Refuses truth values, text, and whatever else is no number; None is an argument that is left out."""
    if value is None:
        return
    if not is_bool(value) and not isinstance(value, (str, bytes)):
        try:
            float(value)
            return
        except (TypeError, ValueError, OverflowError):
            pass
    raise input_error(name, shown(value), "it is a number", remedy)


def check_positive(name: str, value: Any, remedy: str = "Leave it out.") -> None:
    """Refuses what is no finite number above zero; None is an argument that is left out."""
    check_number(name, value, remedy)
    if value is not None and not (math.isfinite(value) and value > 0):
        raise input_error(name, shown(value), "it is a finite number above zero", remedy)


def check_port(port: Any) -> None:
    """Refuses what is no port; None is an argument that is left out."""
    if port is not None and checked_whole("port", port, 0, "Leave it out, or give 0 for any free port.") > 65535:
        rule = "it is a whole number from 0 to 65535"
        raise input_error("port", shown(port), rule, "Leave it out, or give 0 for any free port.")


def check_camera(camera: Any, takes_experiment: bool) -> None:
    """Refuses what is no camera, and where no experiment is taken, an experiment."""
    if isinstance(camera, Camera) or (takes_experiment and isinstance(camera, Experiment)):
        return
    rule = "it is a Camera or an Experiment" if takes_experiment else "it is a Camera"
    if isinstance(camera, Experiment):
        remedy = "Give the experiment's: experiment.camera, and experiment.psf as the PSF."
    elif isinstance(camera, (str, PathLike)):
        read = f"rb.Experiment({fspath(camera)!r})"
        remedy = f"Read the file: {read}." if takes_experiment else f"Read the file: {read}.camera."
    else:
        remedy = "Give rb.Camera(rows=…, …), or rb.Experiment(path) of an experiment file."
    raise input_error("camera", shown(camera), rule, remedy)


def check_psf(psf: Any) -> None:
    """Refuses a camera or an experiment in the place of a PSF; the values are checked where they are read."""
    if isinstance(psf, (Camera, Experiment)):
        rule = "it is a Psf, an array [y, x] or the path of a file"
        raise input_error("psf", shown(psf), rule, "Give the experiment's: experiment.psf.")


def checked_array(name: str, value: Any) -> Any:
    """A list as an array, whose rows have one length; anything else as it is."""
    if not isinstance(value, (list, tuple)):
        return value
    try:
        return np.asarray(value)
    except ValueError as error:
        rule = "a list that stands for an array has rows of one length"
        remedy = "Give an array: numpy.asarray(list) says what is wrong with the list."
        raise input_error(name, "a list with rows of different lengths", rule, remedy, kind="shape") from error


def checked_psf(psf: Any) -> Any:
    """A PSF after :func:`check_psf`; a list as an array."""
    check_psf(psf)
    return psf if isinstance(psf, Psf) else checked_array("psf", psf)
