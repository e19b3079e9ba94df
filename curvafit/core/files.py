"""Writing of files and folders that are whole or absent, and reading of the package's own."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from curvafit.core.runtime import hold_signals


def write_atomically(target: Path, write: Callable[[Path], object]) -> Path:
    """Call `write` with a temporary name beside `target`, of the same suffix, and move the result to `target`."""
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{_random_digits()}.{target.name}")
    try:
        write(temporary)
        return move_into_place(temporary, target)
    finally:
        with hold_signals():
            remove(temporary)


def write_content(target: Path, *contents: str | bytes | memoryview) -> Path:
    """Write texts (in UTF-8) or bytes to a file, whole or not at all: the name appears once the content is on disk."""

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            for content in contents:
                file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())

    return write_atomically(target, write)


def remove_leftovers(target: Path) -> None:
    """Delete temporary files of a killed `write_atomically`; for the only process that writes this target."""
    name = re.compile(rf"\.[0-9a-f]{{8}}\.{re.escape(target.name)}")
    for path in target.parent.iterdir():
        if name.fullmatch(path.name):
            remove(path)


@contextmanager
def temporary_folder(target: Path) -> Iterator[Path]:
    """Make a temporary folder beside `target`, and its parents; the folder and its content are deleted at the end."""
    target.parent.mkdir(parents=True, exist_ok=True)
    work = target.parent / f".{target.name[:200]}.{_random_digits()}"
    try:
        work.mkdir()
        yield work
    finally:
        with hold_signals():
            shutil.rmtree(work, ignore_errors=True)


def move_together(parts: Iterable[Path], folder: Path) -> tuple[Path, ...]:
    """Move finished files, or folders, into a folder on the same disk; a signal waits until all are there."""
    with hold_signals():
        return tuple(move_into_place(part, folder / part.name) for part in parts)


def move_into_place(temporary: Path, target: Path) -> Path:
    """Rename a finished file or folder to `target`, on the same disk, and delete the old one after that."""
    backup = target.with_name(f".{_random_digits()}.old.{target.name}")
    with hold_signals():
        if target.is_dir():  # os.replace replaces a file, but no folder
            os.replace(target, backup)
        try:
            os.replace(temporary, target)
        except OSError:
            if backup.exists():
                os.replace(backup, target)
            raise
        remove(backup)
    return target


def remove(path: Path) -> None:
    """Delete a file, a link, or a folder with its content, if there is one; a signal waits until all is gone."""
    if path.is_dir() and not path.is_symlink():
        doomed = path.with_name(f".{_random_digits()}.old.{path.name[:200]}")
        with hold_signals():
            try:  # a program that is killed meanwhile leaves no half-deleted folder under the name
                os.replace(path, doomed)
            except OSError:  # a file in it is open on Windows, or the folder around it is not ours
                doomed = path
            shutil.rmtree(doomed)
    else:
        path.unlink(missing_ok=True)


# ---- folders ---------------------------------------------------------------------------------------------------------


def is_url(path: str) -> bool:
    """Return whether a text is a URL by which a store can be read."""
    return path.lower().startswith(("https://", "http://", "s3://"))


def check_folder(path: str | Path) -> Path:
    """Return the path of a folder that can be written to, or made; raise ValueError where it cannot, or is in a store
    of Zarr, to which nothing is added."""
    folder = Path(path)
    resolved = folder.resolve()
    if (store := next(filter(is_zarr, (resolved, *resolved.parents)), None)) is not None:
        raise ValueError(f"{folder} is in the Zarr store {store}, to which nothing is added: write beside it")
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not existing.is_dir():
        raise ValueError(f"cannot write to the folder {folder}: {existing} is a file")
    try:  # permissions do not say that a disk is read-only
        with tempfile.TemporaryFile(dir=existing):
            return folder
    except OSError as error:
        raise ValueError(f"the folder {existing} cannot be written to: {error.strerror or error}") from None


def is_zarr(folder: Path) -> bool:
    """Return whether a folder is a group or an array of Zarr."""
    return any((folder / name).exists() for name in ("zarr.json", ".zgroup", ".zarray"))


def is_empty(folder: Path) -> bool:
    """Return whether a path is an empty folder, and not a link to one."""
    return folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir())


def _random_digits() -> str:
    """Return eight hexadecimal digits that no other temporary name has."""
    return uuid.uuid4().hex[:8]
