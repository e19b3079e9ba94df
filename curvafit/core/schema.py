"""Dataclasses in JSON: the schema of a dataclass, the first fault of a value under it, and conversion in both ways.

A schema is plain data in the words of JSON Schema, so that a page in a browser can check the same: `type`, `enum`,
`required`, `properties`, `items`, `minItems`, `minimum`, `maximum` and their exclusive forms. Messages use the
`description`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from curvafit.core.checks import quoted


class Rule(NamedTuple):
    """What a field's value must be, beyond its type: `Annotated[float, Rule(least=0)]`.

    Attributes
    ----------
    least, most, above, below
        Bounds of a number, the last two exclusive.
    unknown
        Whether a number may be NaN, which JSON writes as null.
    filled
        Whether a list has at least one item.
    keys
        Keys of some entries of a dictionary, with their types.
    """

    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None
    unknown: bool = False
    filled: bool = False
    keys: tuple[tuple[str, Any], ...] = ()


_BOUNDS = {
    "minimum": (lambda value, bound: value >= bound, "least"),
    "maximum": (lambda value, bound: value <= bound, "most"),
    "exclusiveMinimum": (lambda value, bound: value > bound, "above"),
    "exclusiveMaximum": (lambda value, bound: value < bound, "below"),
}
_PLAIN: dict[Any, dict[str, Any]] = {
    str: {"type": "string", "description": "a text"},
    bool: {"type": "boolean", "description": "true or false"},
}


def schema_of(hint: Any, rule: Rule | None = None) -> dict[str, Any]:
    """Return the schema of a dataclass, text, number, `Literal`, tuple or dictionary, or of one of these or None."""
    rule = rule or Rule()
    if get_origin(hint) is Annotated:
        return schema_of(*get_args(hint)[:2])
    kinds = _kinds(hint)
    schema = _schema_of_one(next(kind for kind in kinds if kind is not NoneType), rule)
    if len(kinds) == 1 and not rule.unknown:
        return schema
    return {**schema, "type": [schema["type"], "null"], "description": f"{schema['description']}, or null"}


def _schema_of_one(hint: Any, rule: Rule) -> dict[str, Any]:
    """Return the schema of a type that is no union."""
    if hint in _PLAIN:
        return _PLAIN[hint]
    if hint in (int, float):
        bounds = {name: getattr(rule, end) for name, (_, end) in _BOUNDS.items() if getattr(rule, end) is not None}
        return {"type": "number", **bounds, "description": _number_words(rule)}
    if get_origin(hint) is Literal:
        *some, last = get_args(hint)
        words = f"{', '.join(some)} or {last}" if some else last
        return {"type": "string", "enum": [*some, last], "description": words}
    if get_origin(hint) is tuple:
        items = get_args(hint)
        count = 0 if items[-1] is Ellipsis else len(items)
        words = f"a list of {count} numbers" if count else "a list"
        least = count or int(rule.filled)
        return {"type": "array", "items": schema_of(items[0]), "minItems": least, "description": words}
    if dataclasses.is_dataclass(hint):
        fields, hints = dataclasses.fields(hint), get_type_hints(hint, include_extras=True)
        required = [field.name for field in fields if field.default is dataclasses.MISSING]
        properties = {field.name: schema_of(hints[field.name]) for field in fields}
        return {"type": "object", "required": required, "properties": properties, "description": "an object"}
    properties = {name: schema_of(inner) for name, inner in rule.keys}
    return {"type": "object", "required": [], "properties": properties, "description": "an object"}


def violation(value: Any, schema: Mapping[str, Any], name: str = "the content") -> str | None:
    """Return the first fault of a value under a schema, such as `"mass as a positive number, got 0"`, or None."""
    if not _fits(value, schema):
        return f"{name} as {schema['description']}, got {quoted(value)}"
    prefix = "" if name == "the content" else f"{name}."
    if isinstance(value, Mapping):
        for key in schema.get("required", ()):
            if key not in value:
                return f"{prefix}{key}, got none"
        for key, inner in schema.get("properties", {}).items():
            if key in value and (fault := violation(value[key], inner, prefix + key)):
                return fault
    if isinstance(value, list) and "items" in schema:
        for k, item in enumerate(value):
            if fault := violation(item, schema["items"], f"{name}[{k}]"):
                return fault
    return None


def decode(hint: Any, value: Any) -> Any:
    """Return a value of a type from JSON that follows the type's schema: see `violation`."""
    if get_origin(hint) is Annotated:
        hint, rule = get_args(hint)[:2]
        if value is None and rule.unknown:
            return math.nan
    if value is None:
        return None
    hint = next(kind for kind in _kinds(hint) if kind is not NoneType)
    if dataclasses.is_dataclass(hint):
        hints = get_type_hints(hint, include_extras=True)
        return hint(**{name: decode(hints[name], value[name]) for name in hints if name in value})  # type: ignore[operator]
    if get_origin(hint) is tuple:
        return tuple(decode(get_args(hint)[0], item) for item in value)
    if get_origin(hint) is dict:
        return {name: decode(get_args(hint)[1], item) for name, item in value.items()}
    return hint(value) if hint in (int, float) else value


def encode(value: Any) -> Any:
    """Return a dataclass, and all in it, in JSON's types; NaN becomes None."""
    if dataclasses.is_dataclass(value):
        return {field.name: encode(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {name: encode(item) for name, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [encode(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _kinds(hint: Any) -> tuple[Any, ...]:
    """Return the types of a union, without tensors, which JSON cannot hold."""
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return tuple(kind for kind in kinds if getattr(kind, "__name__", "") != "Tensor")


def _number_words(rule: Rule) -> str:
    """Return what a number must be, in words."""
    if rule.above is not None:
        return "a positive number" if rule.below is None else f"a number between {rule.above:g} and {rule.below:g}"
    if rule.least is not None:
        return f"a number from {rule.least:g}" + ("" if rule.most is None else f" to {rule.most:g}")
    return "a finite number"


def _fits(value: Any, schema: Mapping[str, Any]) -> bool:
    """Return whether a value follows its schema; its items and properties are not looked at."""
    kind, kinds = _json_type(value), schema["type"]
    if kind not in ([kinds] if isinstance(kinds, str) else kinds):
        return False
    if "enum" in schema:
        return value in schema["enum"]
    if kind == "number":
        return all(holds(value, schema[bound]) for bound, (holds, _) in _BOUNDS.items() if bound in schema)
    return kind != "array" or len(value) >= schema.get("minItems", 0)


def _json_type(value: Any) -> str | None:
    """Return JSON's name of a value's type; None where JSON has no such type or the number is not finite."""
    if isinstance(value, bool):
        return "boolean"
    if isinstance(value, (int, float)):
        return "number" if math.isfinite(value) else None
    names = {type(None): "null", str: "string", list: "array", dict: "object"}
    return next((name for kind, name in names.items() if isinstance(value, kind)), None)
