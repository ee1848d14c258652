"""What users call is pinned: every public name with its parameters, types and defaults.

Where a change is meant, ``UPDATE_SIGNATURES=1 pytest python/tests/test_signatures.py`` renews ``signatures.txt``.
"""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import rowburst as rb

HERE = Path(__file__).parent
PINNED = HERE / "signatures.txt"
PACKAGE = HERE.parent / "src" / "rowburst"


def is_public(name):
    return not name.startswith("_") or name in ("__version__", "__new__", "__init__", "__call__")


def lines_of(body, prefix):
    """A line for each public definition of a module or class, in order of names."""
    lines = []
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and is_public(node.name):
            marks = "".join(f"@{ast.unparse(d)} " for d in node.decorator_list)
            returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
            lines.append(f"{prefix}{node.name}: {marks}({ast.unparse(node.args)}){returns}")
        elif isinstance(node, ast.ClassDef) and is_public(node.name):
            bases = ", ".join(ast.unparse(base) for base in node.bases)
            lines.append(f"{prefix}{node.name}: class({bases})")
            lines += lines_of(node.body, f"{prefix}{node.name}.")
        elif isinstance(node, ast.AnnAssign) and is_public(ast.unparse(node.target)):
            lines.append(f"{prefix}{ast.unparse(node.target)}: {ast.unparse(node.annotation)}")
    return sorted(lines)


def test_signatures_are_those_that_are_pinned():
    lines = [f"rowburst.{name}" for name in sorted(rb.__all__)]
    for path in sorted(PACKAGE.glob("*.py*")):
        if path.suffix in (".py", ".pyi"):
            lines += lines_of(ast.parse(path.read_text()).body, f"{path.stem}.")
    text = "\n".join(lines) + "\n"
    if os.environ.get("UPDATE_SIGNATURES"):
        PINNED.write_text(text)
    assert text == PINNED.read_text()


def test_the_stub_has_what_the_extension_has():
    stub = ast.parse((PACKAGE / "_rowburst.pyi").read_text())
    named = {n.name for n in stub.body if isinstance(n, (ast.FunctionDef, ast.ClassDef)) and is_public(n.name)}
    extension = rb._rowburst
    there = {n for n in dir(extension) if is_public(n) and callable(getattr(extension, n))}
    assert named == there


def test_the_stub_agrees_with_the_extension_in_every_signature(tmp_path):
    pytest.importorskip("mypy")
    done = subprocess.run([sys.executable, "-m", "mypy.stubtest", "rowburst._rowburst"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
