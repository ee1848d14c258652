"""Messages are in the words of Python, and help at run time is that of the stub."""

import ast
import inspect
from pathlib import Path

import numpy as np
import pytest

import rowburst as rb


def test_messages_do_not_speak_of_the_command_line(camera, psf, capture, result, tmp_path):
    cases = {
        "Set rows and columns in the Camera": lambda: rb.reconstruct(capture.frame[1:], camera, psf),
        "^field: found": lambda: rb.Camera(rows=4, columns=4, shutter="top-down", row_time_us=1, exposure_us=1, field=(2, 2)),
        r"as in \(40, 52\)": lambda: result.traces([(99, 0)]),
        "Add a line `gain_electrons_per_count.*to the Camera, or do without peak_electrons": lambda: rb.simulate(camera, "digits", psf, peak_electrons=100),
        r"`rb.calibrate.psf\(positions_mm=…\)`": lambda: rb.Psf.patches([np.ones((3, 3))], []),
    }
    (tmp_path / "file").write_text("")
    cases["another folder|file"] = lambda: result.save(tmp_path / "file")
    for words, call in cases.items():
        with pytest.raises((rb.InputError, rb.WorkError), match=words) as raised:
            call()
        text = str(raised.value)
        assert " -o" not in text and "[camera]" not in text and "[field]" not in text
        assert "--" not in text or "`rowburst" in text
    # An error of a file keeps the words of the file.
    (tmp_path / "experiment.toml").write_text("[camera]\ncolumns = 4\n")
    with pytest.raises(rb.InputError, match=r"\[camera\]: found no `rows`.*Add a line"):
        rb.Camera.from_file(tmp_path / "experiment.toml")


def test_help_at_run_time_is_that_of_the_stub():
    stub = ast.parse((Path(rb.__file__).parent / "_rowburst.pyi").read_text())
    extension = rb._rowburst
    compared = 0
    for node in stub.body:
        if not isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            continue
        there = getattr(extension, node.name)
        pairs = [(node.name, node, there)]
        if isinstance(node, ast.ClassDef):
            functions = [f for f in node.body if isinstance(f, ast.FunctionDef)]
            assert "__init__" not in [f.name for f in functions]
            pairs += [(f"{node.name}.{f.name}", f, getattr(there, f.name)) for f in functions if not f.name.startswith("_")]
        for name, item, value in pairs:
            if (doc := ast.get_docstring(item)) is not None:
                assert inspect.getdoc(value) == doc, name
                compared += 1
            if isinstance(item, ast.FunctionDef) and inspect.isbuiltin(value) and name != "speckle_psf":
                given = [a.arg for a in item.args.args + item.args.kwonlyargs if a.arg not in ("self", "cls")]
                assert list(inspect.signature(value).parameters) == given, name
    assert compared > 25
