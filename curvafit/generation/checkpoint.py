"""Runs that survive a kill: what determines the rest of a flow, in a file that is always whole."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout
from torch import Tensor

from curvafit.files import sweep, write_content
from curvafit.interrupts import undisturbed
from curvafit.priors.coefficients import Coefficients

#: First line of a checkpoint, before the SHA-256 of what follows.
_HEAD = b"curvafit checkpoint 2 "


class Checkpoint:
    """The file of one run: written to memory, then to the disk under another name, then renamed.

    Parameters
    ----------
    path
        Where; a link stays, and leads there. Its folder is made; beside it stands `.NAME.curvafit-lock` while a run
        holds it.
    every
        Seconds between two saves, at least; 0 saves after every step.
    run
        What identifies the run, by name; see `identity`.
    keep
        Whether the file stays when the run is done.

    Raises
    ------
    ValueError
        If the seconds are negative, or the path is no file's.
    """

    def __init__(self, path: str | Path, every: float, run: dict[str, str], keep: bool = False) -> None:
        if not every >= 0:
            raise ValueError(f"expected seconds between checkpoints, at least 0, got {every}")
        self.path, self._every, self._run, self._keep = place_of(path), every, run, keep
        self._saved = time.monotonic()

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other runs off the file.

        Raises
        ------
        ValueError
            If another run holds it.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        place = self.path.with_name(f".{self.path.name}.curvafit-lock")
        lock = FileLock(place)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            raise ValueError(
                f"expected a checkpoint that no other run uses, got {self.path}, which one does: wait for it, or name "
                "another file"
            ) from None
        try:
            sweep(self.path)
            yield
        finally:
            with undisturbed():
                with suppress(PermissionError):  # Windows deletes no file that is open
                    place.unlink(missing_ok=True)  # while it is held: whoever waits for it sees that it has gone
                lock.release()

    def load(self) -> dict[str, Any] | None:
        """What was saved last, or None where there is no file.

        Raises
        ------
        ValueError
            If the file is not a whole checkpoint or is another run's.
        """
        if not self.path.exists():
            return None
        head, _, payload = self.path.read_bytes().partition(b"\n")
        if head != _HEAD + hashlib.sha256(payload).hexdigest().encode():
            what = "one that is damaged" if head.startswith(_HEAD) else "a file that is something else"
            raise ValueError(f"expected a checkpoint of a flow, got {what}: {self.path}; delete it to begin anew")
        record = torch.load(io.BytesIO(payload), weights_only=True)
        other = record["run"]
        names = [name for name in {**other, **self._run} if other.get(name) != self._run.get(name)]
        if names:
            parts = (f"{name} {other.get(name)} instead of {self._run.get(name)}" for name in names)
            raise ValueError(f"expected a checkpoint of this run, got one with {'; '.join(parts)}: {self.path}")
        return record["content"]

    def due(self) -> bool:
        """Whether it is time to save."""
        return time.monotonic() - self._saved >= self._every

    def save(self, content: dict[str, Any]) -> None:
        """Replace the file by one with this content: tensors, numbers, lists and dictionaries."""
        buffer = io.BytesIO()
        torch.save({"run": self._run, "content": content}, buffer)
        payload = buffer.getbuffer()
        head = _HEAD + hashlib.sha256(payload).hexdigest().encode() + b"\n"
        write_content(self.path, head, payload)
        self._saved = time.monotonic()

    def close(self) -> None:
        """The run is done: remove the file, unless it is to be kept."""
        if not self._keep:
            self.path.unlink(missing_ok=True)


def place_of(path: str | Path) -> Path:
    """The file that a checkpoint's path leads to.

    Raises
    ------
    ValueError
        If it leads to a folder, a device or a pipe, or in a circle.
    """
    try:
        place = Path(path).resolve()
        taken = place.exists() and not place.is_file()
    except (OSError, RuntimeError):
        taken = True
    if taken or (Path(path).is_symlink() and place.is_symlink()):
        raise ValueError(f"expected a file for the checkpoint, got {path}, which is something else")
    return place


def identity(**parts: object) -> dict[str, str]:
    """What makes two runs the same, as text by name: the parts given, tensors by their digest, and the versions."""
    texts = {name: _text(value) for name, value in parts.items()}
    return {**texts, "curvafit": version("curvafit"), "torch": version("torch")}


def _text(value: object) -> str:
    if isinstance(value, Coefficients):
        return f"({', '.join(_text(each) for each in value)})"
    if isinstance(value, Tensor):
        values = value.detach().cpu().contiguous().numpy()
        return f"{values.dtype} {values.shape} {hashlib.sha256(values.tobytes()).hexdigest()[:16]}"
    if dataclasses.is_dataclass(value) and any(isinstance(each, Tensor) for each in vars(value).values()):
        return f"{type(value).__name__}({', '.join(map(_text, vars(value).values()))})"
    return str(value)
