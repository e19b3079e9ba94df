"""What numbers that are given must be, whole or real and within which bounds; and how a message quotes what came."""

from __future__ import annotations

import contextlib
import math
import operator
import reprlib
from collections.abc import Iterable
from typing import Any

#: Seeds are below this: what a signed 64-bit number holds.
SEEDS = 2**63
#: Lengths, in any unit, whose cubes float32 holds.
SHORTEST, LONGEST = 1e-12, 1e12
#: Characters of a value that a message shows.
SHOWN = 80

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother, _SHORT.maxlong = 3, SHOWN, SHOWN, SHOWN // 2


def quoted(value: Any) -> str:
    """A value as a message shows it: on one line, and no longer than fits on it, however much it holds."""
    text = " ".join(_SHORT.repr(value).split())
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 2]} …"


def whole(value: Any, said: str, least: int, most: int, *, of: Any = None) -> int:
    """A whole number from `least` to `most`, of Python's or NumPy's types.

    Parameters
    ----------
    said
        What was expected, for the message: its kind, and where it starts; the other bound is added where it counts.
    of
        What came, where the value is a part of it.

    Raises
    ------
    ValueError
        If it is none: a truth value, text and 64.0 are no whole numbers.
    """
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or not least <= number <= most:
        raise ValueError(f"expected {said}{_beyond(number, 0, most)}, got {quoted(value if of is None else of)}")
    return number


def real(value: Any, said: str, least: float = -math.inf, most: float = math.inf, *, of: Any = None) -> float:
    """A finite number from `least` to `most`, of any numeric type; the other parameters are `whole`'s.

    Raises
    ------
    ValueError
        If it is none: truth values and text are no numbers.
    """
    number = math.nan
    if not isinstance(value, (bool, str, bytes)) and not getattr(value, "shape", ()):
        with contextlib.suppress(TypeError, ValueError, OverflowError, RuntimeError):
            number = float(value)
    if not (math.isfinite(number) and least <= number <= most):
        raise ValueError(f"expected {said}{_beyond(number, least, most)}, got {quoted(value if of is None else of)}")
    return number


def inside(value: Any, said: str, low: float, high: float) -> float:
    """A number between two others, neither of them; as `real`.

    Raises
    ------
    ValueError
        If it is none.
    """
    number = real(value, said)
    if not low < number < high:
        raise ValueError(f"expected {said}, got {quoted(value)}")
    return number


def several(values: Any, name: str) -> tuple[Any, ...]:
    """The values of a sequence, of any type but text.

    Raises
    ------
    ValueError
        If it is none.
    """
    try:
        parts = None if isinstance(values, (str, bytes)) else tuple(values)
    except TypeError:
        parts = None
    if parts is None:
        raise ValueError(f"expected a sequence of {name}, got {quoted(values)}")
    return parts


def instance(value: Any, kinds: type | tuple[type, ...], said: str) -> None:
    """Raise ValueError where a value is of another kind than it must be; `said` is what was expected."""
    if not isinstance(value, kinds):
        raise ValueError(f"expected {said}, got {quoted(value)}")


def named(value: Any, names: Iterable[str], said: str) -> None:
    """Raise ValueError where a value is none of some names; `said` is what was expected."""
    if not isinstance(value, str) or value not in names:
        raise ValueError(f"expected {said}, got {quoted(value)}")


def seed_of(value: Any) -> int:
    """A seed: a whole number from 0 that 64 bits hold.

    Raises
    ------
    ValueError
        If it is none.
    """
    return whole(value, "a seed that is a whole number from 0", 0, SEEDS - 1)


def _beyond(number: float | None, least: float, most: float) -> str:
    """The bound that a number of the right kind and sign is beyond."""
    if number is None or not -math.inf < number < math.inf or (number <= most and not 0 < number < least):
        return ""
    return f", at most {most:g}" if number > most else f", at least {least:g}"
