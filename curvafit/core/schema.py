"""Dataclasses in JSON: a value from JSON as a dataclass, checked on the way, and a dataclass as JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np

from curvafit.core.checks import quoted


class Rule(NamedTuple):
    """What a field's value must be, beyond its type: `Annotated[float, Rule(least=0)]`.

    Attributes
    ----------
    least, most, above, below
        Bounds of a number, the last two exclusive.
    unknown
        Whether a number may be NaN, which JSON writes as null.
    """

    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    unknown: bool = False


_PLAIN: dict[Any, str] = {str: "a text", bool: "true or false"}


def decode(hint: Any, value: Any, name: str = "") -> Any:
    """Return a value from JSON as the type of `hint`: a dataclass, text, number, `Literal`, tuple, array, dictionary or
    None.

    Raises ValueError with the first fault, such as `"mass as a positive number, got 0"`, in which the value is `name`.
    """
    hint, rule = get_args(hint)[:2] if get_origin(hint) is Annotated else (hint, Rule())
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    # Without tensors, which JSON cannot hold.
    kind: Any = next(kind for kind in kinds if kind is not NoneType and getattr(kind, "__name__", "") != "Tensor")
    nullable = NoneType in kinds or rule.unknown
    expected, is_valid = _check_value(kind, rule, value)
    if not is_valid:
        if value is None and nullable:
            return math.nan if rule.unknown else None
        raise ValueError(f"{name or 'the content'} as {expected}{', or null' * nullable}, got {quoted(value)}")
    if dataclasses.is_dataclass(kind):
        return _decode_fields(kind, value, name)
    if get_origin(kind) is tuple:
        return tuple(decode(get_args(kind)[0], item, f"{name}[{k}]") for k, item in enumerate(value))
    if get_origin(kind) is dict:
        inner = get_args(kind)[1]
        return {k: v if v is None or inner is Any else decode(inner, v, f"{name}.{k}") for k, v in value.items()}
    if kind is np.ndarray:
        return np.array(value, dtype=np.float64)
    return kind(value) if kind in (int, float) else value


def _decode_fields(kind: Any, value: Mapping[str, Any], name: str) -> Any:
    """Return a dataclass from a JSON object. Fields without a default must be there, unknown entries are ignored."""
    prefix, hints = f"{name}." if name else "", get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        if field.default is dataclasses.MISSING and field.name not in value:
            raise ValueError(f"{prefix}{field.name}, got none")
    return kind(**{key: decode(hints[key], value[key], prefix + key) for key in hints if key in value})


def _check_value(kind: Any, rule: Rule, value: Any) -> tuple[str, bool]:
    """Return a description of the values of a type and rule, and whether `value`, but for its items, is one of them."""
    if kind in _PLAIN:
        return _PLAIN[kind], isinstance(value, kind)
    if kind in (int, float):
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        is_number = is_number and (kind is float or value == int(value))
        is_within = is_number and rule.least <= value <= rule.most and rule.above < value < rule.below
        return _describe_number(rule), is_within
    if get_origin(kind) is Literal:
        *others, last = choices = get_args(kind)
        return f"{', '.join(others)} or {last}" if others else last, isinstance(value, str) and value in choices
    if get_origin(kind) is tuple:
        items = get_args(kind)
        count = 0 if items[-1] is Ellipsis else len(items)  # 0: any number of items
        is_list = isinstance(value, (list, tuple)) and (not count or len(value) == count)
        return f"a list of {count} numbers" if count else "a list", is_list
    if kind is np.ndarray:
        items = np.array(value, dtype=object).flat  # lists, where rows differ in length
        is_array = isinstance(value, list) and all(_check_value(float, rule, item)[1] for item in items)
        return "numbers in rows of one length", is_array
    return "an object", isinstance(value, Mapping)


def _describe_number(rule: Rule) -> str:
    """Return a description of the numbers that a rule admits."""
    if rule.above > -math.inf:
        return "a positive number" if rule.below == math.inf else f"a number between {rule.above:g} and {rule.below:g}"
    if rule.least > -math.inf:
        most = f" to below {rule.below:g}" if rule.below < math.inf else f" to {rule.most:g}"
        return f"a number from {rule.least:g}" + ("" if most == " to inf" else most)
    return "a finite number"


def encode(value: Any) -> Any:
    """Return a dataclass and its content as JSON's types: NaN is None, numbers of arrays have six digits."""
    if dataclasses.is_dataclass(value):
        return {field.name: encode(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {name: encode(item) for name, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [encode(item) for item in value]
    if isinstance(value, np.ndarray):
        return np.array([float(f"{x:.6g}") for x in value.flat]).reshape(value.shape).tolist()
    return None if isinstance(value, float) and math.isnan(value) else value
