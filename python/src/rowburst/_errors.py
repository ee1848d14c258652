"""Errors of the Python side, with the data of those of the library."""

import errno
from os import PathLike
from pathlib import Path

from ._rowburst import InputError, WorkError


def input_error(subject: str | Path, found: object, rule: str, remedy: str, *, kind: str = "invalid") -> InputError:
    """The error of an argument or a file: ``subject: found ...; rule. remedy``."""
    error = InputError(f"{subject}: found {found}; {rule}. {remedy}")
    error.kind, error.value, error.rule, error.remedy = kind, str(found), rule, remedy
    if isinstance(subject, Path):
        error.path = str(subject)
    else:
        error.parameter = subject
    return error


def write_error(path: Path, reason: OSError) -> WorkError:
    """The error of a file that cannot be written."""
    is_full = reason.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "Free space on this disk or choose another folder." if is_full else "Check the disk or choose another folder."
    error = WorkError(f"{path}: writing: {reason}. {remedy}")
    error.kind, error.value, error.remedy, error.path = "io", str(reason), remedy, str(path)
    return error


def as_path(path: str | PathLike[str]) -> Path:
    """The path of a file that is to be written."""
    try:
        return Path(path)
    except TypeError as error:
        found = f"an object of type {type(path).__name__}"
        raise input_error("path", found, "it is the path of a file", "Give it as text or as a pathlib.Path.") from error


def write(path: str | PathLike[str], content: str | bytes) -> Path:
    """Writes a file: text as UTF-8.

    Raises
    ------
    InputError
        The path is none.
    WorkError
        The file cannot be written.
    """
    target = as_path(path)
    try:
        target.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
    except OSError as error:
        raise write_error(target, error) from error
    return target
