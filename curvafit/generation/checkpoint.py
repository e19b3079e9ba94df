"""Runs that survive a kill: what determines the rest of a flow, in a file that is always whole."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from curvafit.priors.coefficients import Coefficients


class Checkpoint:
    """The file of one run, written under another name and then renamed.

    Parameters
    ----------
    path
        Where; `path.part` beside it is used while writing. Its folder is made.
    every
        Seconds between two saves, at least; 0 saves after every step.
    run
        What identifies the run, by name; see `identity`.
    keep
        Whether the file stays when the run is done.

    Raises
    ------
    ValueError
        If the seconds are negative.
    """

    def __init__(self, path: str | Path, every: float, run: dict[str, str], keep: bool = False) -> None:
        if not every >= 0:
            raise ValueError(f"expected seconds between checkpoints, at least 0, got {every}")
        self.path, self._every, self._run, self._keep = Path(path), every, run, keep
        self._saved = time.monotonic()

    def load(self) -> dict[str, Any] | None:
        """What was saved last, or None where there is no file.

        Raises
        ------
        ValueError
            If the file is not a checkpoint or is another run's.
        """
        if not self.path.exists():
            return None
        try:
            found = torch.load(self.path, weights_only=True)
            theirs, content = found["run"], found["content"]
        except OSError:
            raise
        except Exception as error:  # torch.load raises many, by what the bytes happen to be
            raise ValueError(f"expected a checkpoint of a flow, got a file that cannot be read: {self.path}") from error
        names = [name for name in {**theirs, **self._run} if theirs.get(name) != self._run.get(name)]
        if names:
            parts = (f"{name} {theirs.get(name)} instead of {self._run.get(name)}" for name in names)
            raise ValueError(f"expected a checkpoint of this run, got one with {'; '.join(parts)}: {self.path}")
        return content

    def due(self) -> bool:
        """Whether it is time to save."""
        return time.monotonic() - self._saved >= self._every

    def save(self, content: dict[str, Any]) -> None:
        """Replace the file by one with this content: tensors, numbers, lists and dictionaries."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self._part, "wb") as file:
            torch.save({"run": self._run, "content": content}, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(self._part, self.path)
        self._saved = time.monotonic()

    def close(self) -> None:
        """The run is done: remove the file, unless it is to be kept."""
        self._part.unlink(missing_ok=True)
        if not self._keep:
            self.path.unlink(missing_ok=True)

    @property
    def _part(self) -> Path:
        return self.path.with_name(self.path.name + ".part")


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
