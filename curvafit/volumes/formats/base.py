"""The result and the errors of every reader, and the names of length units."""

from __future__ import annotations

import importlib
import logging
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from curvafit.core.checks import quoted
from curvafit.core.runtime import one_line


class ScanError(ValueError):
    """A volume that cannot be used; the message is one sentence on one line."""

    def __init__(self, sentence: str) -> None:
        super().__init__(one_line(sentence))


class Damaged(Exception):
    """A fault of a file, for the sentence that names the file."""


class Raw(NamedTuple):
    """The content of a file: an array with z first, and spacing, unit and affine where the file states them.

    `spacing` has one number per axis of `values`, or three for (z, y, x). `guesses` are sentences on a spacing or unit
    that the file leaves open; they are void where the caller states these. `gaps` are sentences on values that are not
    in the file and were filled in. `channels` is the axis of channels, where the file names one. `whole` is the shape
    of the file's array where `values` are only a part of this array, with as many axes.
    """

    values: np.ndarray
    spacing: tuple[float, ...] | None = None
    unit: str | None = None
    affine: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    guesses: tuple[str, ...] = ()
    gaps: tuple[str, ...] = ()
    channels: int | None = None
    whole: tuple[int, ...] | None = None


@contextmanager
def complaints(logger: str | None = None) -> Iterator[list[str]]:
    """Collect what a library logs in this thread, away from the host's streams, and silence warnings."""
    messages: list[str] = []
    thread, source = threading.get_ident(), logging.getLogger(logger or __name__)
    level = source.level

    def collect(record: logging.LogRecord) -> bool:
        if record.thread == thread:
            messages.append(one_line(record.getMessage()))
        return record.thread != thread

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        source.addFilter(collect)
        if not source.isEnabledFor(logging.WARNING):
            source.setLevel(logging.WARNING)
        try:
            yield messages
        finally:
            source.setLevel(level)
            source.removeFilter(collect)


def pick_key(keys: list[str], key: str | None, path: object) -> str:
    """Return the key, by default the only one, or raise ScanError with a list of the keys."""
    listed = ", ".join(name[:80] for name in keys[:20]) + (", …" if len(keys) > 20 else "")
    if key is None:
        if len(keys) == 1:
            return keys[0]
        raise ScanError(f"expected a key as in {path}::KEY, got none, and {path} has {listed or 'no arrays'}")
    name = key if key in keys else key.strip("/")
    if name not in keys:
        raise ScanError(f"expected a key of {path}, got {quoted(key)}, and it has {listed or 'no arrays'}")
    return name


def stated(attributes: Mapping[str, Any], ndim: int) -> tuple[tuple[Any, ...] | None, Any]:
    """Return spacing and unit of an array's attributes, unchecked; one number counts for all axes."""
    for name, fixed_unit in (("element_size_um", "um"), ("spacing", None), ("voxel_size", None)):
        if name in attributes:
            sizes = _listed(attributes[name])
            unit = fixed_unit or (_listed(attributes.get("unit", attributes.get("units"))) or (None,))[0]
            return sizes * ndim if len(sizes) == 1 else sizes, unit
    return None, None


def _listed(value: Any) -> tuple[Any, ...]:
    """Return the entries of an attribute as a tuple, bytes as text."""
    array = np.asarray(value, dtype=object) if isinstance(value, list | tuple) else np.asarray(value)
    entries = array.ravel()[:99].tolist()
    return tuple(each.decode(errors="replace") if isinstance(each, bytes) else each for each in entries)


def extra(module: str, what: str) -> Any:
    """Return a library of the extra `[io]`, or raise ScanError with the line that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as reason:
        raise ScanError(f'expected {module} for {what}, got none: pip install "curvafit[io]"') from reason
