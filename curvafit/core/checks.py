"""Checks of arguments (numbers within bounds, names, sequences) and of packages, and short quotes for messages."""

from __future__ import annotations

import contextlib
import math
import operator
import re
import reprlib
from collections.abc import Iterable
from importlib import import_module
from types import ModuleType
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
    """Return a value as a message shows it: on one line, cut to `SHOWN` characters."""
    text = " ".join(_SHORT.repr(value).split())
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 2]} …"


def check_int(value: Any, expected: str, least: int, most: int, *, of: Any = None) -> int:
    """Return a whole number from `least` to `most` as an int, or raise ValueError; True, text and 64.0 are refused.

    The message says what was `expected` (which should name the least number), adds `most` where the number is above it,
    and quotes the value, or the whole argument `of` that contains the value.
    """
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or not least <= number <= most:
        bound = _broken_bound(number, 0, most)  # `expected` has the least number
        raise ValueError(f"expected {expected}{bound}, got {quoted(value if of is None else of)}")
    return number


def check_float(
    value: Any, expected: str, least: float = -math.inf, most: float = math.inf, *, of: Any = None
) -> float:
    """Return a finite number from `least` to `most` as a float, or raise ValueError as `check_int` does."""
    number = math.nan
    if not isinstance(value, (bool, str, bytes)) and not getattr(value, "shape", ()):
        with contextlib.suppress(TypeError, ValueError, OverflowError, RuntimeError):
            number = float(value)
    if not (math.isfinite(number) and least <= number <= most):
        bound = _broken_bound(number, least, most)
        raise ValueError(f"expected {expected}{bound}, got {quoted(value if of is None else of)}")
    return number


def check_positive(value: Any, expected: str, *, of: Any = None) -> float:
    """Return a positive number, such as a length in any unit, whose cube float32 holds, or raise ValueError."""
    return check_float(value, expected, SHORTEST, LONGEST, of=of)


def check_open_interval(value: Any, expected: str, low: float, high: float) -> float:
    """Return a number above `low` and below `high` as a float, or raise ValueError."""
    number = check_float(value, expected)
    if not low < number < high:
        raise ValueError(f"expected {expected}, got {quoted(value)}")
    return number


def as_tuple(values: Any, name: str, count: int | None = None) -> tuple[Any, ...]:
    """Return the values of a sequence of any type but text, of any length or of `count`, or raise ValueError."""
    try:
        items = None if isinstance(values, (str, bytes)) else tuple(values)
    except TypeError:
        items = None
    if items is None or count not in (None, len(items)):
        raise ValueError(f"expected a sequence of {name}, got {quoted(values)}")
    return items


def check_type(value: Any, kinds: type | tuple[type, ...], expected: str) -> None:
    """Raise ValueError where a value is not an instance of `kinds`; the message says what was `expected`."""
    if not isinstance(value, kinds):
        raise ValueError(f"expected {expected}, got {quoted(value)}")


def check_choice(value: Any, names: Iterable[str], expected: str) -> None:
    """Raise ValueError where a value is not among `names`; the message says what was `expected`."""
    if not isinstance(value, str) or value not in names:
        raise ValueError(f"expected {expected}, got {quoted(value)}")


def simplify_name(name: str) -> str:
    """Return a name in small letters, with `-` for spaces and underscores: `Bilinear_Tubes` is `bilinear-tubes`."""
    return re.sub(r"[\s_-]+", "-", name.strip().casefold())


def check_seed(value: Any) -> int:
    """Return a seed, a whole number from 0 that a signed 64-bit number holds, or raise ValueError."""
    return check_int(value, "a seed that is a whole number from 0", 0, SEEDS - 1)


def _broken_bound(number: float | None, least: float, most: float) -> str:
    """Return words on the bound that a number breaks; none if it is no number, not finite, or not positive."""
    if number is None or not -math.inf < number < math.inf:
        return ""
    if number > most:
        return f", at most {most:g}"
    return f", at least {least:g}" if 0 < number < least else ""


# ---- packages that only some uses need, and links that are no packages -----------------------------------------------


def require(module: str, extra: str, purpose: str) -> ModuleType:
    """Import an optional module, or raise ImportError with the command that installs the `extra` that has it.

    `purpose` says for the message what needs the module: `"reading NRRD files"`. With `extra=""`, where no extra has
    it, the command installs the module by its own name.
    """
    try:
        return import_module(module)
    except ImportError as error:
        if error.name is None or not module.startswith(error.name.partition(".")[0]):
            raise  # the module is installed, but not one that it imports
        install = f'pip install "curvafit[{extra}]"' if extra else f"pip install {module}"
        raise ImportError(f"{purpose} needs {error.name}, which is not installed: {install}", name=error.name) from None


def refuse_link(package: str) -> None:
    """Raise ImportError for `import priors` where the project's root has a link of that name into the package."""
    if not package.startswith("curvafit"):
        here = "the folder at the project's root is a link into the package"
        raise ImportError(f"import curvafit.{package}, not {package}: {here}")
