"""The schema of a `fit.json`, for the law that is read from it, for the whole fit, and for an atlas's page.

The schema is data in the words of JSON Schema; the page receives it as JSON. Both checks, here and in JavaScript, know
`type`, `enum`, `required`, `properties`, `items`, `minItems`, `minimum`, `maximum` and their exclusive forms;
a message says that the `description` was expected.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from curvafit.core.records import parse_json, quoted
from curvafit.core.units import METRES
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.law import FORMAT

_NUMBER = {"type": "number", "description": "a finite number"}
_POSITIVE = {"type": "number", "exclusiveMinimum": 0, "description": "a positive number"}
_TEXT = {"type": "string", "description": "a text"}
_SIX = {
    "type": "object",
    "required": list(NAMES),
    "properties": dict.fromkeys(NAMES, _NUMBER),
    "description": "an object of six coefficients",
}
_CURVATURES = {"type": "array", "items": _NUMBER, "minItems": 1, "description": "a list of numbers"}
_SHARE = {"type": "number", "minimum": 0, "description": "a number from 0"}
_DIAGRAM = {
    "type": ["object", "null"],
    "required": ["kappa1", "kappa2", "share"],
    "properties": {
        "seen_as": {"enum": ["field", "mask"], "description": "field or mask"},
        "unit": _TEXT,
        "spread": _SHARE,
        "excluded": _SHARE,
        "kappa1": _CURVATURES,
        "kappa2": _CURVATURES,
        "share": {"type": "array", "items": _SHARE, "minItems": 1, "description": "a list of numbers"},
    },
    "description": "an object of columns, or null",
}
_MASS = {"type": "number", "exclusiveMinimum": -1, "exclusiveMaximum": 1, "description": "a number between -1 and 1"}
_MATCH = {
    "type": "object",
    "required": ["id", "distance", "coefficients"],
    "properties": {"id": _TEXT, "distance": _SHARE, "coefficients": _SIX, "mass": _MASS, "seed": _SHARE},
    "description": "an object",
}
_OR_NONE = {"type": ["number", "null"], "description": "a number, or null"}
_LENGTH = {"type": ["number", "null"], "minimum": 0, "description": "a number from 0, or null"}
_FILLED = {"type": ["number", "null"], "minimum": 0, "maximum": 1, "description": "a number from 0 to 1, or null"}
_MORPHOMETRY = {
    "type": "object",
    "properties": {
        "volume_fraction": _FILLED,
        "thickness_mean": _LENGTH,
        "thickness_std": _LENGTH,
        "spacing_mean": _LENGTH,
        "connectivity_density": _OR_NONE,
        "euler": _NUMBER,
        "surface_to_volume": _LENGTH,
        "unit": _TEXT,
    },
    "description": "an object",
}
_SIX_OR_NONE = {**_SIX, "type": ["object", "null"], "description": "an object of six coefficients, or null"}
_MASS_OR_NONE = {**_MASS, "type": ["number", "null"], "description": "a number between -1 and 1, or null"}
_DEVIATIONS = {
    "type": "object",
    "properties": dict.fromkeys((*NAMES, "mass"), _SHARE),
    "description": "an object of deviations",
}
_CANDIDATE = {
    "type": "object",
    "required": ["name", "coefficients", "mass", "uncertainty", "distance", "seed_noise", "twins", "status"],
    "properties": {
        "name": _TEXT,
        "coefficients": _SIX,
        "mass": _MASS,
        "uncertainty": _DEVIATIONS,
        "distance": _LENGTH,
        "seed_noise": _LENGTH,
        "twins": {
            "type": "array",
            "items": {**_MORPHOMETRY, "required": list(_MORPHOMETRY["properties"])},
            "description": "a list",
        },
        "status": _TEXT,
    },
    "description": "an object",
}
_COLUMN = {"type": "array", "items": _NUMBER, "minItems": 1, "description": "a list of numbers"}
_DRAWN = (*NAMES[1:], "mass")
_POSTERIOR = {
    "type": ["object", "null"],
    "required": ["view", "method", "draws"],
    "properties": {
        "view": _TEXT,
        "method": _TEXT,
        "draws": {
            "type": "object",
            "required": list(_DRAWN),
            "properties": dict.fromkeys(_DRAWN, _COLUMN),
            "description": "an object of columns",
        },
    },
    "description": "an object, or null",
}
_INTERVALS = {"type": ["object", "null"], "description": "an object, or null"}
_PART = {"type": "number", "minimum": 0, "maximum": 1, "description": "a number from 0 to 1"}
_MISFIT = {
    "type": ["object", "null"],
    "required": ["probability", "blocks", "method"],
    "properties": {"probability": _PART, "blocks": {"type": "object", "description": "an object"}, "method": _TEXT},
    "description": "an object, or null",
}

FIT_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": [
        "format",
        "coefficients",
        "mass",
        "coefficients_physical",
        "epsilon_physical",
        "working_voxel",
        "length_unit",
    ],
    "properties": {
        "format": {"enum": [FORMAT], "description": FORMAT},
        "kind": {"enum": ["field", "mask", "image"], "description": "field, mask or image"},
        "family": _TEXT,
        "coefficients": _SIX_OR_NONE,
        "mass": _MASS_OR_NONE,
        "chosen": {"type": ["string", "null"], "description": "a candidate's name, or null"},
        "uncertainty": _DEVIATIONS,
        "scale": {"type": "array", "items": _POSITIVE, "minItems": 3, "description": "a list of 3 numbers"},
        "coefficients_physical": _SIX_OR_NONE,
        "epsilon_physical": _POSITIVE,
        "working_voxel": _POSITIVE,
        "length_unit": {"enum": ["voxel", *METRES], "description": f"one of voxel, {', '.join(METRES)}"},
        "matches": {"type": "array", "items": _MATCH, "description": "a list"},
        "intervals": _INTERVALS,
        "intervals_physical": _INTERVALS,
        "weak_directions": {"type": "array", "items": _TEXT, "description": "a list of texts"},
        "misfit": _MISFIT,
        "drift": _LENGTH,
        "candidates": {"type": "array", "items": _CANDIDATE, "description": "a list"},
        "posterior": _POSTERIOR,
        "status": _TEXT,
        "notes": {"type": "array", "items": _TEXT, "description": "a list of texts"},
        "morphometry": {**_MORPHOMETRY, "type": ["object", "null"], "description": "an object, or null"},
        "diagram": _DIAGRAM,
        "provenance": {
            "type": "object",
            "properties": {"scan": {"type": ["string", "null"], "description": "a text, or null"}},
            "description": "an object",
        },
    },
    "description": "an object",
}


def _whole(schema: Mapping[str, Any], **others: Any) -> dict[str, Any]:
    """Return an object's schema in which all properties are required and `others` replace some of them."""
    return {**schema, "required": list(schema["properties"]), "properties": {**schema["properties"], **others}}


#: The whole fit of an inference, as `Fit` writes and reads it; a law needs less (`FIT_SCHEMA`).
WHOLE_FIT = _whole(
    FIT_SCHEMA,
    matches={**FIT_SCHEMA["properties"]["matches"], "items": _whole(_MATCH)},
    morphometry=_whole(_MORPHOMETRY),
)

_BOUNDS = {
    "minimum": lambda value, bound: value >= bound,
    "maximum": lambda value, bound: value <= bound,
    "exclusiveMinimum": lambda value, bound: value > bound,
    "exclusiveMaximum": lambda value, bound: value < bound,
}


def violation(value: Any, schema: Mapping[str, Any] = FIT_SCHEMA, name: str = "the content") -> str | None:
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


def _fits(value: Any, schema: Mapping[str, Any]) -> bool:
    """Return whether a value, apart from its items and properties, follows its schema."""
    if "enum" in schema:
        return isinstance(value, str) and value in schema["enum"]
    kind, kinds = _type(value), schema["type"]
    if kind not in ([kinds] if isinstance(kinds, str) else kinds):
        return False
    if kind == "number":
        return all(fits(value, schema[bound]) for bound, fits in _BOUNDS.items() if bound in schema)
    return kind != "array" or len(value) >= schema.get("minItems", 0)


def _type(value: Any) -> str | None:
    """Return JSON's name of a value's type; None where JSON has no such type or the number is not finite."""
    if isinstance(value, bool):
        return "boolean"
    if isinstance(value, (int, float)):
        return "number" if math.isfinite(value) else None
    names = {type(None): "null", str: "string", list: "array", dict: "object"}
    return next((name for kind, name in names.items() if isinstance(value, kind)), None)


def fit_bytes(path: str | PathLike[str]) -> bytes:
    """Return the content of a `fit.json` as bytes.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"expected a fit.json, found no file {path}")
    return Path(path).read_bytes()


def parse_fit(text: str | bytes, place: object, schema: Mapping[str, Any]) -> dict[str, Any]:
    """Parse a `fit.json` and check it against a schema.

    Parameters
    ----------
    place
        Name of the text's file, for messages.

    Raises
    ------
    ValueError
        If the text is not JSON, has another format, or violates the schema.
    """
    expected = "a fit.json written by `curvafit infer`"
    content = parse_json(text, expected, place)
    version = content.get("format", FORMAT) if isinstance(content, dict) else FORMAT
    if version not in schema["properties"]["format"]["enum"]:
        got = f"got {quoted(version)} in {place}: run `curvafit infer` again"
        raise ValueError(f"expected a fit.json of format {FORMAT}, {got}")
    if fault := violation(content, schema):
        raise ValueError(f"expected {expected} with {fault} in {place}")
    return content


def six_of(values: Mapping[str, float]) -> Coefficients:
    """Return coefficients made of six numbers by name."""
    return Coefficients(*(float(values[name]) for name in NAMES))
