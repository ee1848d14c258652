#!/usr/bin/env python3
"""Runs the notebooks, and keeps them with their outputs for the documentation site.

    target/python-venv/bin/python scripts/run_notebooks.py              all of notebooks/
    target/python-venv/bin/python scripts/run_notebooks.py calibration  those of these names

Each runs in an empty folder. A cell that raises an error ends with its message. The outputs go into
target/docs-notebooks, where scripts/docs finds them for as long as the notebook's source is the same.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

ROOT = Path(__file__).resolve().parent.parent
OUT = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")).absolute() / "docs-notebooks"
TIMEOUT_S = 600


def run(path):
    """Runs a notebook and writes it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="rowburst-notebook-") as folder:
        client = NotebookClient(notebook, timeout=TIMEOUT_S, kernel_name="python3", resources={"metadata": {"path": folder}})
        try:
            client.execute()
        except CellExecutionError as error:
            sys.exit(f"run_notebooks.py: {path.name}\n{error}")
    nbformat.write(notebook, OUT / path.name)
    print(f"{path.name}: {time.monotonic() - began:.1f} s", flush=True)


def main():
    OUT.mkdir(parents=True, exist_ok=True)
    names = sys.argv[1:]
    paths = [ROOT / "notebooks" / f"{name}.ipynb" for name in names] or sorted((ROOT / "notebooks").glob("*.ipynb"))
    # The kernel is this Python, whatever kernels the user has.
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for path in paths:
        run(path)


if __name__ == "__main__":
    main()
