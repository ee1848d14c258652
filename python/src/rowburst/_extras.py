"""Packages that some functions need and the package does not install."""

from __future__ import annotations

import logging
from importlib import import_module
from typing import Any

from ._errors import input_error

# Name of the module: name on PyPI.
_PACKAGES = {
    "dcimg": "dcimg",
    "deepinv": "deepinv",
    "distributed": "distributed",
    "matplotlib": "matplotlib",
    "ndtiff": "ndtiff",
    "pco_tools": "pco-tools",
    "scico": "scico",
    "sif_parser": "sif_parser",
    "tifffile": "tifffile",
    "torch": "torch",
    "tqdm": "tqdm",
    "xarray": "xarray",
}


def need(module: str, caller: str) -> Any:
    """The module, or an error that says how to install its package.

    Some modules set up Python's logging when they are imported; what the user has set up stays.
    """
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    try:
        return import_module(module)
    except ImportError as error:
        package = _PACKAGES.get(module.split(".")[0], module)
        rule = "it needs this package, which rowburst does not install"
        raise input_error(caller, f"no {package}", rule, f"Install it: pip install {package}", kind="missing") from error
    finally:
        root.setLevel(level)
        root.handlers[:] = handlers
