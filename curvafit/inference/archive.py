"""Files of arrays beside a header: one reader and one writer for atlases, tables of descriptors and posteriors."""

from __future__ import annotations

import importlib.resources
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np

from curvafit.core.checks import quoted
from curvafit.core.files import write_content
from curvafit.core.records import parse_json, read_archive

Content = TypeVar("Content")

#: What the assembly of a damaged file's content may raise.
_FAULTS = (KeyError, ValueError, IndexError, TypeError, AttributeError, RuntimeError)


@dataclass(frozen=True)
class Archive:
    """A kind of `.npz` file: arrays and a JSON header with its format and version, nothing that runs when it is read.

    Attributes
    ----------
    name, file
        The content and its file in words: `"an atlas"`, `"an atlas file"`.
    format, version
        What the header says of the kind.
    remedy
        How to replace a file of another version, in words.
    layout
        Further fields of the header that must be this program's.
    """

    name: str
    file: str
    format: str
    version: int
    remedy: str
    layout: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: str | Path, arrays: Mapping[str, np.ndarray], **facts: Any) -> None:
        """Write arrays, compressed, with a header that states `facts` too."""
        header = {"format": self.format, "version": self.version, **self.layout, **facts}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, header=encode(header), **arrays)
        write_content(Path(path), buffer.getvalue())

    def load(self, path: str | Path, assemble: Callable[[dict[str, Any], dict[str, np.ndarray]], Content]) -> Content:
        """Return what `assemble` makes of a file's header and arrays.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            As `parse`.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"expected {self.file}, got {path}, where there is none")
        return self.parse(Path(path), str(path), assemble)

    def parse(
        self,
        source: Path | IO[bytes],
        place: str,
        assemble: Callable[[dict[str, Any], dict[str, np.ndarray]], Content],
    ) -> Content:
        """Return what `assemble` makes of the header and the arrays in a source, which messages call `place`.

        Raises
        ------
        ValueError
            If the source is of another kind, is damaged, or has another version or layout.
        """
        try:
            header, arrays = self._parts(source)
        except (OSError, *_FAULTS) as error:
            raise ValueError(
                f"expected {self.file}, got {place}, which is truncated, damaged or something else"
            ) from error
        if (version := header.get("version")) != self.version:
            wanted = f"expected {self.name} of version {self.version}, got version {quoted(version)}"
            raise ValueError(f"{wanted} in {place}: {self.remedy}")
        if others := [name for name, value in self.layout.items() if header.get(name) != value]:
            words = ", ".join(others)
            raise ValueError(
                f"expected {self.name} with the {words} of this program, got others in {place}: {self.remedy}"
            )
        try:
            return assemble(header, arrays)
        except _FAULTS as error:
            _, _, noun = self.file.partition(" ")
            reason = f"without {error}" if isinstance(error, KeyError) else f"({str(error)[:200]})"
            raise ValueError(f"expected a whole {noun}, got {place} {reason}") from error

    def packaged(self, name: str, assemble: Callable[[dict[str, Any], dict[str, np.ndarray]], Content]) -> Content:
        """Return what `assemble` makes of a file of this package, in `inference/data`."""
        source = importlib.resources.files("curvafit.inference") / "data" / name
        kind = self.name.partition(" ")[2]
        return self.parse(io.BytesIO(source.read_bytes()), f"the packaged {kind}", assemble)

    def bears(self, path: Path) -> bool:
        """Return whether a file bears this format; all else of it may be wrong."""
        try:
            return path.is_file() and bool(self._parts(path))
        except (OSError, *_FAULTS):
            return False

    def _parts(self, source: Path | IO[bytes]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Return the header and the arrays of a file, or raise one of many exceptions where it is of another kind."""
        arrays = read_archive(source)
        header = parse_json(arrays.pop("header").tobytes(), f"the header of {self.file}", source)
        if header["format"] != self.format:
            raise ValueError(f"expected the format {self.format!r}, got {quoted(header['format'])}")
        return header, arrays


def encode(value: Any) -> np.ndarray:
    """Return a value as JSON in an array of bytes."""
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)
