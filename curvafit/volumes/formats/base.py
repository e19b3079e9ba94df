"""What every reader returns and raises, and the names of length units."""

from __future__ import annotations

import importlib
import logging
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from curvafit.messages import one_line
from curvafit.priors.bounds import quoted
from curvafit.units import METRES

#: Suffixes of what a name may state as a unit -> (our name, factor to it).
_UNITS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(("", "voxel", "voxels", "pixel", "pixels", "px", "unknown", "none", "null"), ("voxel", 1.0)),
    **dict.fromkeys(("nm", "nanometer", "nanometers", "nanometre", "nanometres"), ("nm", 1.0)),
    **dict.fromkeys(("a", "å", "angstrom", "angstroms", "ångström"), ("nm", 0.1)),
    **dict.fromkeys(
        ("um", "µm", "μm", "\\u00b5m", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"),
        ("um", 1.0),
    ),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), ("mm", 1.0)),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), ("mm", 10.0)),
    **dict.fromkeys(("inch", "inches", "in"), ("mm", 25.4)),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), ("m", 1.0)),
}


class ScanError(ValueError):
    """A volume that cannot be used, said in one sentence on one line."""

    def __init__(self, sentence: str) -> None:
        super().__init__(one_line(sentence))


class Damaged(Exception):
    """What is wrong with a file, for the sentence that names it."""


class Raw(NamedTuple):
    """What a file holds: an array with z first, and spacing, unit and affine where it states them.

    `spacing` has one number per axis of `values`, or three for (z, y, x). `guesses` are sentences on a spacing or unit
    that the file leaves open: void where the caller states it. `gaps` are sentences on values that are not in the file
    and were filled in. `channels` is the axis of channels, where the file says that there is one. `whole` is the shape
    of the file's array where `values` are but the part that was asked for, with as many axes.
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
    """What a library logs meanwhile, kept from the host's streams; its warnings go unsaid."""
    said: list[str] = []
    here, speaker = threading.get_ident(), logging.getLogger(logger or __name__)
    level = speaker.level

    def kept(record: logging.LogRecord) -> bool:
        if record.thread == here:
            said.append(one_line(record.getMessage()))
        return record.thread != here

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        speaker.addFilter(kept)
        if not speaker.isEnabledFor(logging.WARNING):
            speaker.setLevel(logging.WARNING)
        try:
            yield said
        finally:
            speaker.setLevel(level)
            speaker.removeFilter(kept)


def normalise_unit(unit: str | None) -> tuple[str, float]:
    """Our name of a length unit and the factor that turns a number in `unit` into it: `"cm"` -> `("mm", 10.0)`.

    Raises
    ------
    ScanError
        If the name is of no known unit.
    """
    name = "" if unit is None else unit.strip().casefold() if isinstance(unit, str) else None
    if name not in _UNITS:
        raise ScanError(f"expected a unit of voxel, nm, um, mm or m, got {quoted(unit)}")
    return _UNITS[name]


def convert_length(length: float, unit: str | None, to: str | None) -> float:
    """A length in `unit`, in `to`; a unit on either side that is no physical one counts as the other."""
    (name, factor), (target, target_factor) = normalise_unit(unit), normalise_unit(to)
    if "voxel" in (name, target):
        return length * factor
    return length * factor * METRES[name] / (METRES[target] * target_factor)


def pick_key(keys: list[str], key: str | None, path: object) -> str:
    """The key asked for, or the only one; else a sentence that lists what there is."""
    listed = ", ".join(name[:80] for name in keys[:20]) + (", …" if len(keys) > 20 else "")
    if key is None:
        if len(keys) == 1:
            return keys[0]
        raise ScanError(f"expected a key as in {path}::KEY, got none, and {path} has {listed or 'no arrays'}")
    found = key if key in keys else key.strip("/")
    if found not in keys:
        raise ScanError(f"expected a key of {path}, got {quoted(key)}, and it has {listed or 'no arrays'}")
    return found


def stated(attributes: Mapping[str, Any], ndim: int) -> tuple[tuple[Any, ...] | None, Any]:
    """Spacing and unit of an array's attributes, as they stand; one number counts for all axes."""
    for name, known in (("element_size_um", "um"), ("spacing", None), ("voxel_size", None)):
        if name in attributes:
            sizes = _listed(attributes[name])
            unit = known or (_listed(attributes.get("unit", attributes.get("units"))) or (None,))[0]
            return sizes * ndim if len(sizes) == 1 else sizes, unit
    return None, None


def _listed(value: Any) -> tuple[Any, ...]:
    """What an attribute holds: numbers, texts, or what it is."""
    held = np.ravel(np.asarray(value, dtype=object) if isinstance(value, list | tuple) else np.asarray(value)).tolist()
    return tuple(each.decode(errors="replace") if isinstance(each, bytes) else each for each in held[:99])


def extra(module: str, what: str) -> Any:
    """A library of the extra `[io]`, or the line that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as reason:
        raise ScanError(f'expected {module} for {what}, got none: pip install "curvafit[io]"') from reason
