"""The viewer of results, served by this process."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType

from . import _rowburst
from ._checks import check_port

# Views that are open: a view that nobody holds goes on until the end of the process.
_OPEN: set[View] = set()


class View:
    """The viewer's page of results on 127.0.0.1, until :meth:`close` or the end of the process, whether it is kept or not.

    It is what :meth:`Result.view` and :meth:`SavedResult.view` return, and a context manager.
    """

    def __init__(
        self,
        results: Sequence[Path],
        port: int | None = None,
        open_browser: bool = True,
        folder: TemporaryDirectory[str] | None = None,
    ) -> None:
        check_port(port)
        self._native = _rowburst._View(list(results), port)
        self._folder = folder
        _OPEN.add(self)
        if open_browser and _has_screen():
            webbrowser.open(self.url)

    @property
    def url(self) -> str:
        """The address of the page."""
        return self._native.url

    def close(self) -> None:
        """Ends the server and removes its temporary files. A view that is closed already stays closed.

        Examples
        --------
        >>> view = result.view(port=0, open_browser=False)
        >>> view.close()
        """
        self._native.close()
        _OPEN.discard(self)
        if self._folder is not None:
            self._folder.cleanup()

    def __enter__(self) -> View:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<rowburst.View at {self.url}; view.close() ends it>"


def _has_screen() -> bool:
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
