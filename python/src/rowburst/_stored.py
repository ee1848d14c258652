"""What is pickled of a calibration or a design: its numbers, its arrays, and the files that it writes."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ._errors import write, write_error


class Stored:
    """Stands for the native part after pickling."""

    def __init__(self, values: dict[str, Any], files: dict[str, bytes]) -> None:
        self._values, self._files = values, files

    def __getattr__(self, name: str) -> Any:
        values = self.__dict__.get("_values", {})
        if name not in values:
            raise AttributeError(name)
        return values[name]

    def json(self) -> str:
        text: str = self._values["json"]
        return text

    def sections(self) -> Any:
        return self._values["sections"]

    def save(self, folder: str | PathLike[str]) -> None:
        for name, content in self._files.items():
            path = Path(folder) / name
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise write_error(path.parent, error) from error
            write(path, content)

    def __reduce__(self) -> tuple[Any, ...]:
        return Stored, (self._values, self._files)


def stored(native: Any, names: tuple[str, ...]) -> Stored:
    """The numbers and the files of a native calibration or design, with its attributes ``names``."""
    if isinstance(native, Stored):
        return native
    values = {name: getattr(native, name) for name in names} | {"json": native.json()}
    if hasattr(native, "sections"):
        values["sections"] = native.sections()
    with TemporaryDirectory(prefix="rowburst-") as folder:
        native.save(folder)
        paths = [path for path in Path(folder).rglob("*") if path.is_file() and not path.name.startswith(".")]
        files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
    return Stored(values, files)
