"""The figure for a paper."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from ._errors import as_path, input_error, write


@dataclass(frozen=True, repr=False)
class Figure:
    """A figure as text and as picture; notebooks show it."""

    svg: str
    """The figure as SVG."""
    png: bytes
    """The figure as PNG."""
    pdf: bytes
    """The figure as PDF."""

    def save(self, path: str | PathLike[str]) -> Path:
        """Writes the figure to a file.

        Parameters
        ----------
        path : path
            A file whose name ends in .svg, .pdf or .png.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        InputError
            The file has another ending.
        WorkError
            The file cannot be written.

        Examples
        --------
        >>> result.figure().save("figure.svg").name
        'figure.svg'
        """
        forms: dict[str, str | bytes] = {".svg": self.svg, ".png": self.png, ".pdf": self.pdf}
        target = as_path(path)
        ending = target.suffix.lower()
        if ending not in forms:
            raise input_error("path", repr(str(path)), "a figure is an .svg, .pdf or .png file", "Give the file one of these endings.")
        return write(target, forms[ending])

    def __repr__(self) -> str:
        return f"<rowburst.Figure: SVG of {len(self.svg) / 1000:.0f} kB; figure.save(path) writes it>"

    def _repr_png_(self) -> bytes:
        return self.png


def save_figure(figure: Figure, path: str | PathLike[str] | None) -> Figure:
    """Writes the figure where there is a path."""
    if path is not None:
        figure.save(path)
    return figure
