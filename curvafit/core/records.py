"""Safe reading of JSON, for every header, record and fit of the package."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from curvafit.core.checks import quoted

#: The most digits of a whole number.
DIGITS = 40


def parse_json(content: str | bytes, expected: str, place: object) -> Any:
    """Return the value of a JSON text, in UTF-8, with or without a byte order mark.

    Parameters
    ----------
    expected, place
        What the text should be, and the name of its file, for messages.

    Raises
    ------
    ValueError
        If the text is not JSON, is nested too deeply, repeats a key, or has a number that is not finite or has more
        than 40 digits.
    """
    try:
        text = content.decode() if isinstance(content, bytes) else content
        return json.loads(
            text.removeprefix("\ufeff"),
            parse_int=_whole,
            parse_float=_finite,
            parse_constant=_constant,
            object_pairs_hook=_single,
        )
    except UnicodeDecodeError:
        fault = "which is not text in UTF-8"
    except json.JSONDecodeError as error:
        fault = f"which is not JSON ({error.msg} in line {error.lineno})"
    except RecursionError:
        fault = "which is nested too deeply"
    except ValueError as error:
        fault = f"which holds {error}"
    raise ValueError(f"expected {expected}, got {place}, {fault}")


def repeated(names: Sequence[Any]) -> Any:
    """Return the first name that occurs more than once, None where there is none."""
    if len(set(names)) == len(names):
        return None
    return next(name for name, count in Counter(names).items() if count > 1)


def _whole(text: str) -> int:
    """Return a whole number of at most `DIGITS` digits."""
    if len(text) > DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


def _finite(text: str) -> float:
    """Return a finite number."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{quoted(text)}, which is not a finite number")
    return value


def _constant(name: str) -> float:
    """Raise ValueError for NaN and the infinities."""
    raise ValueError(f"{name}, which is not a finite number")


def _single(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a dictionary of pairs whose keys all differ."""
    if (name := repeated([name for name, _ in pairs])) is not None:
        raise ValueError(f"the key {quoted(name)} twice")
    return dict(pairs)
