"""Files of this program: a header with arrays in one format, and the rule on what may be written over.

- `Format` names a kind of file. `Format.write` writes a header, alone as JSON or with arrays as NPZ, whole or not at
  all; `Format.read` reads it and refuses what is damaged, of another kind or of another version.
- `can_write` refuses a name that is taken: a program replaces only what it wrote, unless the caller says `overwrite`.
- `parse_json` and `read_archive` read JSON and NPZ files of any origin.
"""

from __future__ import annotations

import importlib.resources
import io
import json
import math
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

import numpy as np

from curvafit.core.checks import quoted
from curvafit.core.files import check_folder, is_empty, is_zarr, write_content
from curvafit.core.runtime import memory

Content = TypeVar("Content")

#: Key, in a Zarr group's attributes, of the kind of a group.
MARK = "curvafit"
#: Bytes of a file in which its mark must stand.
_HEAD = 4096
#: Suffixes of two parts; any other suffix is what follows the last dot.
_DOUBLE = (".nii.gz", ".ome.tif", ".ome.tiff", ".ome.zarr")
#: Seconds by which a file may be newer than its record and still count as written with it. Moving all files to their
#: names takes far less; a file that is newer was changed by somebody, and is not ours to replace.
LATER = 10.0
#: Files of a Zarr group of images that `curvafit.volumes` wrote.
_WRITTEN = re.compile(r"(\d+/)?zarr\.json|\d+/c(/\d+)*")
#: What may be raised where a result is built from a damaged file.
_FAULTS = (KeyError, ValueError, IndexError, TypeError, AttributeError, RuntimeError)
#: The most digits of a whole number in JSON.
_DIGITS = 40


# ---- records ---------------------------------------------------------------------------------------------------------


class Record(NamedTuple):
    """The content of a file: a header of JSON's types, and arrays by name."""

    header: dict[str, Any]
    arrays: dict[str, np.ndarray]


@dataclass(frozen=True)
class Format:
    """A kind of file that this program writes, by the `format` in the file's header.

    A file is JSON, or NPZ where there are arrays: then the member `header` holds the JSON. Nothing in a file runs when
    it is read.

    Parameters
    ----------
    name
        The header's `format`, such as `"curvafit atlas"`.
    version
        The header's `version`; None for a format without one.
    title
        The file in words, for messages: `"an atlas file"`.
    remedy
        What to do about a file of another version, for messages: `"extract it again from its store"`.
    fixed
        Further entries of the header that must be as they are here, such as settings that all content depends on.
    """

    name: str
    version: int | None = None
    title: str = "a file of curvafit"
    remedy: str = "make it again"
    fixed: Mapping[str, Any] = field(default_factory=dict)

    @property
    def _marks(self) -> dict[str, Any]:
        """The entries of the header that must be as they are here."""
        return {**({} if self.version is None else {"version": self.version}), **self.fixed}

    def write(
        self, path: str | Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
    ) -> Path:
        """Write a header alone as JSON, or with arrays as NPZ; the file is whole or not there.

        The header gets the entries `format`, `version` and those of `fixed`. A file of that name is replaced: call
        `can_write` before.
        """
        content = {"format": self.name, **self._marks, **header}
        if arrays is None:
            return write_content(Path(path), json.dumps(content, indent=2, allow_nan=False) + "\n")
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, header=encode_json(content), **arrays)
        return write_content(Path(path), buffer.getbuffer())

    def read(
        self,
        source: str | Path | IO[bytes],
        build: Callable[[dict[str, Any], dict[str, np.ndarray]], Content] = Record,
        *,
        place: str | None = None,
    ) -> Content:
        """Return the header and the arrays of a file, or what `build(header, arrays)` makes of them.

        Messages call the source `place`, by default its path. A file that is damaged (also where `build` fails), of
        another format or version, or with other `fixed` entries is a ValueError.
        """
        source = Path(source) if isinstance(source, str) else source
        place = place or str(source)
        if isinstance(source, Path) and not source.exists():
            raise FileNotFoundError(f"{self.title} is missing: there is no {place}")
        try:
            header, arrays = _read(source)
        except (OSError, *_FAULTS) as error:
            raise ValueError(f"{place} is not {self.title}: it is truncated, damaged or something else") from error
        if header.get("format") != self.name:
            raise ValueError(f"{place} is not {self.title}: it is something else")
        if differing := [name for name, value in self._marks.items() if header.get(name) != value]:
            actual = ", ".join(f"{name} {quoted(header.get(name))}" for name in differing)
            expected = ", ".join(f"{name} {quoted(self._marks[name])}" for name in differing)
            raise ValueError(f"{place} is {self.title} with {actual} instead of {expected}: {self.remedy}")
        try:
            return build(header, arrays)
        except _FAULTS as error:
            reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error)[:200]
            raise ValueError(f"{place} is not {self.title} that can be read: {reason}") from error

    def read_packaged(
        self, room: str, name: str, build: Callable[[dict[str, Any], dict[str, np.ndarray]], Content] = Record
    ) -> Content:
        """Return what `read` does of a file of this package, in the `data` of a room such as `inference`."""
        content = (importlib.resources.files(f"curvafit.{room}") / "data" / name).read_bytes()
        return self.read(io.BytesIO(content), build, place=f"the packaged {name}")

    def owns(self, path: Path) -> bool:
        """Return whether a file, or a Zarr store of images, names this format in its header, whatever its version."""
        if path.is_dir():
            return path.name.lower().endswith(".zarr") and is_own_zarr(path, self.name)
        return _read_header(path).get("format") == self.name

    def companions(self, target: Path) -> list[str]:
        """Return the names of the files written together with `target`, from its record `sibling(target, ".json")`.

        Returns none if the record is missing, is of another format, or does not list `target`. Files that were changed
        after they were written are left out; what is no file has no such time, and stays.
        """
        record = sibling(target, ".json")
        header = _read_header(record)
        names = header.get("files") if header.get("format") == self.name else None
        if not isinstance(names, list) or target.name not in names:
            return []
        newest = record.stat().st_mtime + LATER
        files = {name: target.with_name(str(name)) for name in names}
        return [name for name, file in files.items() if not file.is_file() or file.stat().st_mtime < newest]


def can_write(
    path: str | Path,
    ours: Format | Callable[[Path], bool],
    *,
    more: Iterable[Path] = (),
    inputs: Iterable[str | Path] = (),
    overwrite: bool = False,
) -> Path:
    """Return `path` as a Path if writing it, and the files `more`, loses nothing of others; else raise ValueError.

    Call it before long work, and again before writing.

    Parameters
    ----------
    path
        A file, or a Zarr store, that may exist; nothing is added to a store.
    ours
        The format of the file: an existing `path` may be replaced if it is of this format, and so may its companions
        (`Format.companions`). Or a function that says which existing paths may be replaced.
    inputs
        Files or folders that are read, also as `file.h5::key`: they are never written over, nor anything in them.
    overwrite
        Whether files and folders of another origin may be replaced.
    """
    target = Path(path)
    check_folder(target.parent)
    if target.is_dir() and not (target.name.lower().endswith(".zarr") or is_zarr(target)):
        raise ValueError(f"{target} is a folder: give the name of a file")
    companions = ours.companions(target) if isinstance(ours, Format) else []

    def is_ours(existing: Path) -> bool:
        if not isinstance(ours, Format):
            return ours(existing)
        is_companion = existing.name in companions and (existing.is_file() or is_own_zarr(existing, ours.name))
        return is_companion or (existing == target and ours.owns(existing))

    sources = [source for name in inputs if (source := Path(str(name).partition("::")[0])).exists()]
    for output in (target, *more):
        for source in sources:
            _check_distinct(output, source)
        if output.exists() and not (output.is_file() or output.is_dir()):
            raise ValueError(f"{output} is a device or a pipe: give the name of a file")
        if (output.exists() or output.is_symlink()) and not (overwrite or is_ours(output)):
            kind = "folder" if output.is_dir() else "file"
            raise ValueError(
                f"the name {output} is not free, a {kind} is there that would be lost: choose another "
                "name, or replace it with --overwrite (in Python, overwrite=True)"
            )
    return target


def _check_distinct(output: Path, source: Path) -> None:
    """Raise ValueError if writing `output` would change `source`: if they are the same, or one is within the other."""
    written, read = output.resolve(), source.resolve()
    is_same = output.exists() and output.samefile(source)
    if is_same or written.is_relative_to(read) or read.is_relative_to(written):
        raise ValueError(f"the output {output} would write over the input {source}")


def has_mark(path: Path, mark: str) -> bool:
    """Return whether a file has a text among its first bytes: the mark of a page or a table."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return mark.encode() in file.read(_HEAD)
    except OSError:
        return False


def sibling(path: str | Path, ending: str) -> Path:
    """Return the path with another ending than its suffix; `.nii.gz`, `.ome.tif` and `.ome.zarr` count as one."""
    target = Path(path)
    suffix = next((suffix for suffix in _DOUBLE if target.name.lower().endswith(suffix)), target.suffix)
    return target.with_name(target.name[: len(target.name) - len(suffix)] + ending)


def is_own_zarr(folder: Path, kind: str) -> bool:
    """Return whether a folder is empty, or is a Zarr group of images of this kind, written by us, with nothing else."""
    if folder.is_symlink():
        return False
    if is_empty(folder):
        return True
    try:
        content = parse_json((folder / "zarr.json").read_bytes(), "a Zarr group", folder)
        if content["attributes"][MARK]["kind"] != kind:
            return False
    except (OSError, *_FAULTS):
        return False
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
    return all(_WRITTEN.fullmatch(name) for name in names)


def encode_json(value: Any) -> np.ndarray:
    """Return a value as JSON in an array of bytes."""
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


def _read_header(path: Path) -> dict[str, Any]:
    """Return the header of a file; an empty one where the file is of another kind, or not there."""
    try:
        return _read(path).header
    except (OSError, *_FAULTS):
        return {}


def _read(source: Path | IO[bytes]) -> Record:
    """Return the header and the arrays of a file; if it is of another kind, raise OSError or one of `_FAULTS`."""
    if isinstance(source, Path):
        if not source.is_file():  # a pipe may never end
            raise ValueError(f"{source} is not a file")
        with source.open("rb") as file:
            return _read(file)
    signature = source.read(2)
    source.seek(0)
    if signature != b"PK":  # not a ZIP archive, as NPZ files are
        return Record(dict(parse_json(source.read(), "a header", "it")), {})
    arrays = read_archive(source)
    return Record(dict(parse_json(arrays.pop("header").tobytes(), "a header", "it")), arrays)


# ---- NPZ and JSON ----------------------------------------------------------------------------------------------------


def read_archive(source: Path | IO[bytes]) -> dict[str, np.ndarray]:
    """Return all arrays of an NPZ file by name; raise OSError or ValueError where it is damaged or something else."""
    if isinstance(source, Path) and source.exists() and not source.is_file():
        raise ValueError(f"{source} is not an NPZ file")
    try:
        with zipfile.ZipFile(source) as archive:
            members = [name for name in archive.namelist() if name.endswith(".npy")]
            return {name.removesuffix(".npy"): read_member(archive, name) for name in members}
    except (OSError, ValueError):
        raise
    except Exception as reason:  # zipfile, zlib and numpy raise a dozen types of error
        raise ValueError(f"the NPZ file cannot be read ({quoted(str(reason))})") from reason


def read_member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Return the array of a member of an NPZ file. Bytes after it are refused; at its end the checksum is compared."""
    if archive.getinfo(name).file_size > memory():
        raise ValueError(f"{name} does not fit into memory")
    with archive.open(name) as stream:
        values = np.lib.format.read_array(stream, allow_pickle=False)
        if stream.read(1):
            raise ValueError(f"{name} has more bytes than its header says")
    return values


def parse_json(content: str | bytes, expected: str, place: object) -> Any:
    """Return the value of a JSON text, in UTF-8, with or without a byte order mark.

    A text that is not JSON, is nested too deeply, repeats a key, or has a number that is not finite or has more than 40
    digits is a ValueError, which says what was `expected` and the `place` of the text.
    """
    try:
        text = content.decode() if isinstance(content, bytes) else content
        return json.loads(
            text.removeprefix("\ufeff"),
            parse_int=_parse_int,
            parse_float=_parse_float,
            parse_constant=_parse_float,
            object_pairs_hook=_parse_object,
        )
    except UnicodeDecodeError:
        fault = "which is not text in UTF-8"
    except json.JSONDecodeError as error:
        fault = f"which is not JSON ({error.msg} in line {error.lineno})"
    except RecursionError:
        fault = "which is nested too deeply"
    except ValueError as error:
        fault = f"which holds {error}"
    raise ValueError(f"expected {expected}, got {place}, {fault}")


def _parse_int(text: str) -> int:
    if len(text) > _DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


def _parse_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:_DIGITS]}, which is not a finite number")
    return value


def _parse_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        name = next(name for name, count in Counter(name for name, _ in pairs).items() if count > 1)
        raise ValueError(f"the key {quoted(name)} twice")
    return content
