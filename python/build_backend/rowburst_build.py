"""The build of the package: that of maturin, after a look for what it needs, so that a lack is named with its remedy."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from typing import Any

MIN_RUST = (1, 95)
_CXX = ("c++", "g++", "clang++")


def missing() -> list[str]:
    """What the build lacks, each with its remedy."""
    found = []
    rust = _rust_version()
    wanted = ".".join(map(str, MIN_RUST))
    if rust is None:
        found.append(f"Rust: found no cargo; version {wanted} or later is needed. Install it: https://rustup.rs")
    elif rust < MIN_RUST:
        there = ".".join(map(str, rust))
        found.append(f"Rust: found cargo {there}; version {wanted} or later is needed. Update it: rustup update stable")
    # On Windows the crate cc finds the compiler of Visual Studio, which is not on the path.
    if sys.platform != "win32" and not _has_cxx():
        remedy = "Xcode: xcode-select --install" if sys.platform == "darwin" else "Debian, Ubuntu: sudo apt-get install g++"
        found.append(f"C++: found no compiler ({', '.join(_CXX)}, or $CXX); it builds the MP4 encoder. Install one ({remedy})")
    return found


def _rust_version() -> tuple[int, int] | None:
    cargo = os.environ.get("CARGO") or shutil.which("cargo")
    if cargo is None:
        return None
    try:
        told = subprocess.run([cargo, "--version"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    version = re.search(r"(\d+)\.(\d+)", told)
    return (int(version[1]), int(version[2])) if version else None


def _has_cxx() -> bool:
    named = os.environ.get("CXX", "").split()[:1]
    return any(shutil.which(name) for name in (*named, *_CXX))


def check() -> None:
    """Ends the build with a message where something is missing."""
    lacks = missing()
    if lacks:
        lines = [f"  - {lack}" for lack in lacks]
        told = ["rowburst is built from source, since there is no wheel for this system here, and the build lacks:", *lines]
        told.append("Or install a wheel, which needs none of these: `scripts/wheel` on another machine of this kind makes one.")
        # A text, not a traceback: pip shows it.
        sys.exit("\n".join(told))


def _checked(name: str) -> Callable[..., Any]:
    def hook(*arguments: Any, **options: Any) -> Any:
        check()
        import maturin

        return getattr(maturin, name)(*arguments, **options)

    hook.__name__ = name
    return hook


# The hooks of PEP 517 and PEP 660. The first asks for packages: without cargo maturin would ask for an installer of Rust.
get_requires_for_build_wheel = _checked("get_requires_for_build_wheel")
get_requires_for_build_editable = _checked("get_requires_for_build_editable")
prepare_metadata_for_build_wheel = _checked("prepare_metadata_for_build_wheel")
prepare_metadata_for_build_editable = _checked("prepare_metadata_for_build_editable")
build_wheel = _checked("build_wheel")
build_editable = _checked("build_editable")
get_requires_for_build_sdist = _checked("get_requires_for_build_sdist")
build_sdist = _checked("build_sdist")
