"""Writing of files and folders that are whole or absent, and that never replace those of another origin."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from curvafit.core.runtime import undisturbed

#: Key, in a Zarr group's attributes, of the kind of a group.
MARK = "curvafit"
#: Bytes of a file in which its mark must stand.
_HEAD = 4096


# ---- whole or not at all ---------------------------------------------------------------------------------------------


def write_atomically(target: Path, write: Callable[[Path], object]) -> Path:
    """Call `write` with a temporary name beside `target`, of the same suffix, and move the result to `target`."""
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{_some()}.{target.name}")
    try:
        write(temporary)
        return move_into_place(temporary, target)
    finally:
        with undisturbed():
            remove(temporary)


def write_content(target: Path, *contents: str | bytes | memoryview) -> Path:
    """Write texts, in UTF-8, or bytes to a file, whole or not at all; they are on the disk before the name is."""

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            for content in contents:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())

    return write_atomically(target, write)


def sweep(target: Path) -> None:
    """Delete temporary files of a killed `write_atomically`; for the only process that writes this target."""
    name = re.compile(rf"\.[0-9a-f]{{8}}\.{re.escape(target.name)}")
    for path in target.parent.iterdir():
        if name.fullmatch(path.name):
            remove(path)


@contextmanager
def staged(target: Path) -> Iterator[Path]:
    """Make a temporary folder beside `target`, and its parents; the folder and its content are deleted at the end."""
    target.parent.mkdir(parents=True, exist_ok=True)
    work = target.parent / f".{target.name[:200]}.{_some()}"
    try:
        work.mkdir()
        yield work
    finally:
        with undisturbed():
            shutil.rmtree(work, ignore_errors=True)


def move_together(parts: Iterable[Path], folder: Path) -> tuple[Path, ...]:
    """Move finished files, or folders, into a folder on the same disk; a signal waits until all are there."""
    with undisturbed():
        return tuple(move_into_place(part, folder / part.name) for part in parts)


def move_into_place(temporary: Path, target: Path) -> Path:
    """Rename a finished file or folder to `target`, on the same disk, and delete the old one after that."""
    aside = target.with_name(f".{_some()}.old.{target.name}")
    with undisturbed():
        if target.is_dir():
            os.replace(target, aside)
        try:
            os.replace(temporary, target)
        except OSError:
            if aside.exists():
                os.replace(aside, target)
            raise
        remove(aside)
    return target


def remove(path: Path) -> None:
    """Delete a file, a link, or a folder with its content, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# ---- never another's -------------------------------------------------------------------------------------------------


def check_folder(path: str | Path) -> Path:
    """Return the path of a folder that can be written to, or made.

    Raises
    ------
    ValueError
        If a part of the path is a file, or the nearest folder that exists cannot be written to.
    """
    folder = Path(path)
    nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not nearest.is_dir():
        raise ValueError(f"expected a folder to write to, got {folder}, where {nearest} is a file")
    if not os.access(nearest, os.W_OK | os.X_OK) or not _takes_files(nearest):
        raise ValueError(f"expected a folder that can be written to, got {nearest}")
    return folder


def check_free(
    targets: Iterable[Path], ours: Callable[[Path], bool], inputs: Iterable[str | Path] = (), overwrite: bool = False
) -> None:
    """Raise ValueError where writing to a target would replace what this program did not write.

    Parameters
    ----------
    targets
        Files or folders to write or to replace.
    ours
        Returns whether a target that exists may be replaced: a file or folder with this program's mark of the same
        kind, or an empty folder.
    inputs
        Files or folders that are read, also as `file.h5::key`: no target may be an input, lie in one or contain one,
        with or without `overwrite`.
    overwrite
        Whether any other file or folder may be replaced.
    """
    sources = [source for each in inputs if (source := Path(str(each).partition("::")[0])).exists()]
    for target in targets:
        for source in sources:
            _check_apart(target, source)
        if not (target.exists() or target.is_symlink()):
            continue
        if target.exists() and not (target.is_file() or target.is_dir()):
            raise ValueError(f"expected the name of a file or a folder to write, got the device or pipe {target}")
        if not (overwrite or ours(target)):
            what = "folder" if target.is_dir() else "file"
            raise ValueError(
                f"expected a name that is free, got {target}, a {what} that this command did not write: choose another "
                "name (or replace it with --overwrite; in Python, overwrite=True)"
            )


def is_empty(folder: Path) -> bool:
    """Return whether a path is an empty folder, and not a link to one."""
    return folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir())


def own_record(path: Path, kind: str) -> dict:
    """Return the record in a JSON file whose `format` is `kind`; an empty one where there is none."""
    try:
        content = json.loads(path.read_bytes()) if path.is_file() else None
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) and content.get("format") == kind else {}


def bears(path: Path, mark: str) -> bool:
    """Return whether a file has a mark among its first bytes."""
    try:
        with path.open("rb") if path.is_file() else io.BytesIO() as file:
            return mark.encode() in file.read(_HEAD)
    except OSError:
        return False


def _some() -> str:
    """Return eight digits that no other temporary name has."""
    return uuid.uuid4().hex[:8]


def _takes_files(folder: Path) -> bool:
    """Return whether a file can be made in a folder: permissions do not tell of a read-only disk."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _check_apart(target: Path, source: Path) -> None:
    read, place = source.resolve(), target.resolve()
    same = target.exists() and target.samefile(source)
    if same or place.is_relative_to(read) or read.is_relative_to(place):
        raise ValueError(f"expected an output that writes over no input, got {target}, where {source} is read")
