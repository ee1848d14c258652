"""The command ``rowburst``, also as ``python -m rowburst``: that of the Rust program, in this process."""

from __future__ import annotations

import os
import sys

from ._rowburst import _command


def main() -> int:
    """Runs the command with the arguments of this process; the exit status."""
    # A Dask batch starts this Python again, which has the package.
    os.environ.setdefault("ROWBURST_PYTHON", sys.executable)
    return _command(["rowburst", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
