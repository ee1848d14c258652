"""Errors of the Python side, with the data of those of the library."""

from pathlib import Path

from ._rowburst import InputError


def input_error(subject: str | Path, found: object, rule: str, remedy: str, *, kind: str = "invalid") -> InputError:
    """The error of an argument or a file: ``subject: found ...; rule. remedy``."""
    error = InputError(f"{subject}: found {found}; {rule}. {remedy}")
    error.kind, error.value, error.rule, error.remedy = kind, str(found), rule, remedy
    if isinstance(subject, Path):
        error.path = str(subject)
    else:
        error.parameter = subject
    return error
