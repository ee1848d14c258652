"""The examples of the docstrings are run, and every public function has one."""

import ast
import doctest
import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest

import rowburst as rb

MODULES = ["_batch", "_chunked", "_colour", "_colour_video", "_design", "_figure", "_frames", "_load", "_operator", "_reconstruct", "_reconstructor", "_video", "_view"]
MODULES += ["_rowburst", "_sweep", "calibrate", "capture", "metrics"]


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
    around["calibration"] = rb.calibrate.timing(stripes(), frequency_hz=2000)
    around["reconstructor"] = rb.Reconstructor(camera, psf, prior="tv+0.5*tdiff+support")
    finder = doctest.DocTestFinder(exclude_empty=True)
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    # The classes of the extension call the package their module.
    within = False if name == "_rowburst" else None
    for test in finder.find(module, module.__name__, module=within, globs=around):
        out = []
        runner.run(test, out=out.append)
        assert not runner.failures, "".join(out)
    assert runner.tries > 0


def stripes():
    """A frame of a light that blinks at 2 kHz."""
    row = np.arange(512)[:, None] * 9.6e-6
    return 1000 + 600 * np.sin(2 * np.pi * 2000 * row) + np.random.default_rng(2).normal(0, 8, (512, 40))


def public():
    """Each public name with its owner and what it is: functions, classes, and the methods and properties of these."""
    import rowburst.dask

    owners = [("rowburst", rb, rb.__all__)]
    for module in (rb.calibrate, rb.capture, rb.metrics, rowburst.dask):
        owners.append((module.__name__, module, module.__all__))
    for prefix, owner, names in owners:
        for name in names:
            value = getattr(owner, name)
            if not callable(value):
                continue
            yield f"{prefix}.{name}", value, "class" if inspect.isclass(value) else "function"
            if inspect.isclass(value) and not issubclass(value, Exception):
                yield from members(f"{prefix}.{name}", value)


def members(prefix, cls):
    """The public methods and properties that a class of ours defines or inherits of ours."""
    for name in dir(cls):
        defining = next((base for base in cls.__mro__ if name in vars(base)), None)
        is_field = name in getattr(cls, "__dataclass_fields__", {})
        if name.startswith("_") or is_field or defining is None or not str(defining.__module__).startswith("rowburst"):
            continue
        found = inspect.getattr_static(cls, name)
        kind = "method" if callable(getattr(cls, name)) else "property"
        yield f"{prefix}.{name}", getattr(found, "__func__", found), kind


def test_every_public_name_has_its_help():
    missing, count = [], 0
    for name, value, kind in public():
        count += 1
        doc = inspect.getdoc(value) or ""
        wanted = {"class": [], "function": ["Examples"], "method": ["Examples"], "property": []}[kind]
        if not doc.strip() or doc == inspect.getdoc(object):
            missing.append(f"{name}: no help")
            continue
        if kind != "property" and kind != "class" and has_arguments(value):
            wanted = ["Parameters", *wanted]
        missing += [f"{name}: {section}" for section in wanted if f"{section}\n---" not in doc]
    assert not missing, "\n".join(missing)
    assert count > 150


def has_arguments(value):
    """Whether a call takes something, beside the object itself."""
    try:
        names = list(inspect.signature(value).parameters)
    except (TypeError, ValueError):
        return False
    return bool([name for name in names if name not in ("self", "cls")])


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
