"""The build says what it lacks, and the source distribution holds what a build needs."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

BACKEND = Path(__file__).parent.parent / "build_backend"


def hook(path, **environment):
    """The first hook that pip calls, with programs of one folder alone."""
    program = "import rowburst_build; rowburst_build.get_requires_for_build_wheel()"
    environment = {"PATH": str(path), "PYTHONPATH": str(BACKEND), "HOME": os.environ.get("HOME", ""), **environment}
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)


def program_in(folder, name, answer):
    path = folder / name
    path.write_text(f"#!/bin/sh\necho '{answer}'\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)


@pytest.mark.skipif(sys.platform == "win32", reason="programs are shell scripts here")
def test_what_is_missing_is_named_with_its_remedy(tmp_path):
    done = hook(tmp_path)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "found no cargo" in done.stderr and "https://rustup.rs" in done.stderr and "found no compiler" in done.stderr
    assert "wheel" in done.stderr
    program_in(tmp_path, "cargo", "cargo 1.80.1 (2024-07-21)")
    program_in(tmp_path, "c++", "c++ 12")
    done = hook(tmp_path)
    assert "found cargo 1.80" in done.stderr and "rustup update" in done.stderr and "C++" not in done.stderr
    program_in(tmp_path, "cargo", "cargo 1.95.0 (2026-03-01)")
    done = hook(tmp_path)
    assert "lacks" not in done.stderr
    (tmp_path / "c++").unlink()
    program_in(tmp_path, "mine", "mine 1")
    assert "found no compiler" in hook(tmp_path).stderr
    assert "lacks" not in hook(tmp_path, CXX="mine -O2").stderr
