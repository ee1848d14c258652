"""The examples of the docstrings are run, and every public function has one."""

import doctest
import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest

import rowburst as rb

MODULES = ["_batch", "_chunked", "_colour", "_design", "_frames", "_load", "_operator", "_reconstruct", "_reconstructor", "_video"]
MODULES += ["calibrate"]


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name, camera, psf, capture, result, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib").use("Agg")
    pytest.importorskip("xarray")
    monkeypatch.chdir(tmp_path)
    frame = capture.frame
    np.save("frames.npy", np.stack([frame, frame]))
    module = importlib.import_module(f"rowburst.{name}")
    around = {"rb": rb, "np": np, "camera": camera, "psf": psf, "frame": frame, "result": result}
    around["saved"] = rb.load(result.save(tmp_path / "saved"))
    around["reconstructor"] = rb.Reconstructor(camera, psf, prior="tv+0.5*tdiff+support")
    finder = doctest.DocTestFinder(exclude_empty=True)
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for test in finder.find(module, module.__name__, globs=around):
        out = []
        runner.run(test, out=out.append)
        assert not runner.failures, "".join(out)
    assert runner.tries > 0


def test_every_public_function_has_an_example():
    missing = []
    functions = [getattr(rb, name) for name in rb.__all__ if inspect.isfunction(getattr(rb, name))]
    functions += [rb.calibrate.sensor, rb.calibrate.psf, rb.calibrate.timing]
    for function in functions:
        doc = inspect.getdoc(function) or ""
        for section in ("Parameters", "Returns", "Raises", "Examples"):
            if f"{section}\n---" not in doc:
                missing.append(f"{function.__name__}: {section}")
    assert not missing and len(functions) >= 10
