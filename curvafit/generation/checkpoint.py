"""Checkpoints: the state of a flow in a file that is always complete, so that a run survives a kill."""

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

from curvafit.core.files import remove_leftovers, write_content
from curvafit.core.runtime import hold_signals
from curvafit.priors.coefficients import Coefficients

#: First words of a checkpoint, before the SHA-256 of its content.
_HEAD = b"curvafit checkpoint 2 "


class Checkpoint:
    """The file of one run, which is written under another name and then renamed.

    A link is followed and stays; the folder is created. `every` is the least number of seconds between two saves (0
    saves after every step), `run` the run's parameters by name (see `identity`). With `keep`, the file stays at the
    end of the run.
    """

    def __init__(self, path: str | Path, every: float, run: dict[str, str], keep: bool = False) -> None:
        self.path, self._every, self._run, self._keep = resolve_place(path), every, run, keep
        self._last_save = time.monotonic()

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the file against other runs by a file `.NAME.curvafit-lock`; raise ValueError if one uses it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        place = self.path.with_name(f".{self.path.name}.curvafit-lock")
        lock = FileLock(place)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            raise ValueError(
                f"the checkpoint {self.path} is in use by another run: wait for it to end, or name another file"
            ) from None
        try:
            remove_leftovers(self.path)
            yield
        finally:
            with hold_signals():
                # Before the release: a process that waits for the lock then sees that its file is gone.
                with suppress(PermissionError):  # Windows deletes no file that is open
                    place.unlink(missing_ok=True)
                lock.release()

    def load(self) -> dict[str, Any] | None:
        """Return the last content saved, or None where there is no file; raise ValueError if it is not this run's."""
        if not self.path.exists():
            return None
        head, _, payload = self.path.read_bytes().partition(b"\n")
        if head != _HEAD + hashlib.sha256(payload).hexdigest().encode():
            fault = "a damaged one" if head.startswith(_HEAD) else "another kind of file"
            raise ValueError(f"{self.path} is no checkpoint of a flow, but {fault}: delete it to start again")
        record = torch.load(io.BytesIO(payload), weights_only=True)
        other = record["run"]
        names = [name for name in {**other, **self._run} if other.get(name) != self._run.get(name)]
        if names:
            parts = (f"{name} {other.get(name)} instead of {self._run.get(name)}" for name in names)
            raise ValueError(
                f"{self.path} is the checkpoint of another run, with {'; '.join(parts)}: delete or rename it"
            )
        return record["content"]

    def is_due(self) -> bool:
        """Return whether it is time to save."""
        return time.monotonic() - self._last_save >= self._every

    def save(self, content: dict[str, Any]) -> None:
        """Replace the file's content, which consists of tensors, numbers, lists and dictionaries."""
        buffer = io.BytesIO()
        torch.save({"run": self._run, "content": content}, buffer)
        payload = buffer.getbuffer()
        head = _HEAD + hashlib.sha256(payload).hexdigest().encode() + b"\n"
        write_content(self.path, head, payload)
        self._last_save = time.monotonic()

    def close(self) -> None:
        """Remove the file at the end of a run, unless `keep` was set."""
        if not self._keep:
            self.path.unlink(missing_ok=True)


def resolve_place(path: str | Path) -> Path:
    """Return the file to which a checkpoint's path leads; raise ValueError for a folder, a pipe or a loop of links."""
    try:
        place = Path(path).resolve()
        regular = place.is_file() or not place.exists()
    except (OSError, RuntimeError):
        regular = False
    if not regular or (Path(path).is_symlink() and place.is_symlink()):
        raise ValueError(f"the checkpoint {path} is not a regular file: name another file")
    return place


def identity(**parts: object) -> dict[str, str]:
    """Return what must be equal for a run to resume another: its parts as texts, tensors as digests, and versions."""
    texts = {name: _to_text(value) for name, value in parts.items()}
    return {**texts, "curvafit": version("curvafit"), "torch": version("torch")}


def _to_text(value: object) -> str:
    """Return a text that identifies a value."""
    if isinstance(value, Coefficients):
        return f"({', '.join(map(_to_text, value))})"
    if isinstance(value, Tensor):
        values = value.detach().cpu().contiguous().numpy()
        return f"{values.dtype} {values.shape} {hashlib.sha256(values.tobytes()).hexdigest()[:16]}"
    if dataclasses.is_dataclass(value) and any(isinstance(part, Tensor) for part in vars(value).values()):
        return f"{type(value).__name__}({', '.join(map(_to_text, vars(value).values()))})"
    return str(value)
