"""Files and folders that are whole or not there, and that never take the place of anybody else's."""

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

from curvafit.interrupts import undisturbed

#: Key of a Zarr group's attributes under which its kind stands.
MARK = "curvafit"
#: Bytes of a file in which its mark must stand.
_HEAD = 4096


# ---- whole or not at all ---------------------------------------------------------------------------------------------


def write_atomically(target: Path, write: Callable[[Path], object]) -> Path:
    """Call `write` with a temporary name beside `target` (same suffix), then move what it made to `target`."""
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{_some()}.{target.name}")
    try:
        write(temporary)
        return move_into_place(temporary, target)
    finally:
        with undisturbed():
            remove(temporary)


def write_content(target: Path, *contents: str | bytes | memoryview) -> Path:
    """Write texts, in UTF-8, or bytes to a file, whole or not at all, and to the disk before it gets its name."""

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            for content in contents:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())

    return write_atomically(target, write)


def sweep(target: Path) -> None:
    """Delete what `write_atomically` left of a file where the process was killed; for whoever alone writes it."""
    name = re.compile(rf"\.[0-9a-f]{{8}}\.{re.escape(target.name)}")
    for left in target.parent.iterdir():
        if name.fullmatch(left.name):
            remove(left)


@contextmanager
def staged(target: Path) -> Iterator[Path]:
    """A temporary folder beside `target`, whose parent is made; it goes at the end, with what was not moved out."""
    target.parent.mkdir(parents=True, exist_ok=True)
    work = target.parent / f".{target.name[:200]}.{_some()}"
    try:
        work.mkdir()
        yield work
    finally:
        with undisturbed():
            shutil.rmtree(work, ignore_errors=True)


def move_together(made: Iterable[Path], folder: Path) -> tuple[Path, ...]:
    """Move finished files, or folders, into a folder on the same disk; a signal waits until all are there."""
    with undisturbed():
        return tuple(move_into_place(part, folder / part.name) for part in made)


def move_into_place(made: Path, target: Path) -> Path:
    """Rename a finished file or folder to `target`, on the same disk; what stood there goes once the new one is in."""
    aside = target.with_name(f".{_some()}.old.{target.name}")
    with undisturbed():
        if target.is_dir():
            os.replace(target, aside)
        try:
            os.replace(made, target)
        except OSError:
            if aside.exists():
                os.replace(aside, target)
            raise
        remove(aside)
    return target


def remove(path: Path) -> None:
    """Delete a file, a link, or a folder with all in it; none is fine."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# ---- nobody else's ---------------------------------------------------------------------------------------------------


def check_folder(path: str | Path) -> Path:
    """The path, if it is a folder that can be written to, or can be made.

    Raises
    ------
    ValueError
        If a file is in the way, or the nearest folder there is cannot be written to.
    """
    folder = Path(path)
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not there.is_dir():
        raise ValueError(f"expected a folder to write to, got {folder}, where {there} is a file")
    if not os.access(there, os.W_OK | os.X_OK) or not _takes_files(there):
        raise ValueError(f"expected a folder that can be written to, got {there}")
    return folder


def check_free(
    targets: Iterable[Path], ours: Callable[[Path], bool], inputs: Iterable[str | Path] = (), overwrite: bool = False
) -> None:
    """Raise ValueError where writing to a target would take away what this program did not write there before.

    Parameters
    ----------
    targets
        Files or folders that are to be written, or replaced.
    ours
        Whether what stands at a target may go: it bears this program's mark, and the kind's; or, where a folder is to
        be written, is an empty one.
    inputs
        Files or folders that are read, as `file.h5::key` too: no target may be one of them, lie in one or hold one,
        whatever `overwrite` says.
    overwrite
        Whether anything else may go, too.
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
    """Whether there is a folder, and no link to one, with nothing in it."""
    return folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir())


def own_record(path: Path, kind: str) -> dict:
    """The record of this kind in a JSON file: its `format` is `kind`; empty where there is none."""
    try:
        content = json.loads(path.read_bytes()) if path.is_file() else None
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) and content.get("format") == kind else {}


def bears(path: Path, mark: str) -> bool:
    """Whether a file has a mark among its first bytes."""
    try:
        with path.open("rb") if path.is_file() else io.BytesIO() as file:
            return mark.encode() in file.read(_HEAD)
    except OSError:
        return False


def _some() -> str:
    """Eight digits that no other temporary name has."""
    return uuid.uuid4().hex[:8]


def _takes_files(folder: Path) -> bool:
    """Whether a file can be made there: permissions alone do not tell of a disk that is read-only."""
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
