"""The examples of the docstrings are run, and every public function has one."""

import ast
import doctest
import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest

import rowburst as rb

MODULES = ["_batch", "_chunked", "_colour", "_design", "_frames", "_load", "_operator", "_reconstruct", "_reconstructor", "_video"]
MODULES += ["_rowburst", "calibrate"]


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
    np.save("psf.npy", psf.array)
    calibration = '[calibration]\npsf = "psf.npy"\n[reconstruction]\nprior = "tv"\n'
    Path("experiment.toml").write_text(camera.to_toml() + calibration)
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
    functions += [rb.calibrate.sensor, rb.calibrate.psf, rb.calibrate.timing, rb.simulate, rb.speckle_psf]
    wanted = dict.fromkeys(functions, ("Parameters", "Returns", "Raises", "Examples"))
    wanted |= dict.fromkeys([rb.Camera, rb.Psf, rb.Experiment, rb.LiveView, rb.Reconstructor], ("Parameters", "Raises", "Examples"))
    wanted[rb.set_threads] = ("Parameters", "Raises", "Examples")
    wanted[rb.threads] = ("Returns", "Examples")
    for value, sections in wanted.items():
        doc = inspect.getdoc(value) or ""
        for section in sections:
            if f"{section}\n---" not in doc:
                missing.append(f"{value.__name__}: {section}")
    assert not missing and len(functions) >= 12


def test_help_at_run_time_is_that_of_the_stub():
    stub = ast.parse((Path(__file__).parent.parent / "src" / "rowburst" / "_rowburst.pyi").read_text())
    compared, differing = 0, []

    def compare(body, owner, prefix):
        nonlocal compared
        for node in body:
            if not isinstance(node, (ast.ClassDef, ast.FunctionDef)):
                continue
            there = getattr(owner, node.name)
            told = ast.get_docstring(node)
            if told is not None:
                compared += 1
                if inspect.cleandoc(there.__doc__ or "") != told:
                    differing.append(prefix + node.name)
            if isinstance(node, ast.ClassDef):
                compare(node.body, there, f"{node.name}.")

    compare(stub.body, rb._rowburst, "")
    assert not differing and compared > 30
