"""What a store keeps of a draw, in Python's types and in JSON's."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from curvafit.generation.viability import Viability
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.fit_schema import violation


@dataclass(frozen=True)
class Settings:
    """What all draws of a store share: sampling (z, y, x), ε and blur in spacing's unit, the design (`Design.as_dict`)
    and its seed, and the schedule's fields (name, steps, rates)."""

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    epsilon: float
    blur: float
    design: dict[str, Any]
    seed: int
    schedule: dict[str, Any]


@dataclass(frozen=True)
class Record:
    """One draw: its index, parameters, noise seed, the steps made (fewer where rejected early), viability figures,
    final energy F_ε, the flow's status sentence, the software versions and the seconds it took."""

    index: int
    coefficients: Coefficients
    mass: float
    seed: int
    steps: int
    viability: Viability
    energy: float
    status: str
    versions: dict[str, str]
    seconds: float


def attributes_of(record: Record) -> dict[str, Any]:
    """Return a record in JSON's types; numbers that are not finite become null."""
    attributes = dataclasses.asdict(record) | {"coefficients": record.coefficients.as_dict()}
    attributes["viability"] = {name: _plain(value) for name, value in attributes["viability"].items()}
    return {name: _plain(value) for name, value in attributes.items()}


_NUMBER = {"type": ["number", "null"], "description": "a number or null"}
_COUNT = {"type": "number", "minimum": 0, "maximum": 2**63 - 1, "description": "a whole number from 0"}
_TEXT = {"type": "string", "description": "a text"}
#: What a record's attributes hold, in the words of `priors.fit_schema`.
_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": [field.name for field in dataclasses.fields(Record)],
    "properties": {
        **dict.fromkeys(("index", "seed", "steps"), _COUNT),
        **dict.fromkeys(("mass", "energy", "seconds"), _NUMBER),
        "status": _TEXT,
        "versions": {"type": "object", "description": "an object"},
        "coefficients": {
            "type": "object",
            "required": list(NAMES),
            "properties": {name: {"type": "number", "description": "a finite number"} for name in NAMES},
            "description": "an object of six coefficients",
        },
        "viability": {
            "type": "object",
            "required": [field.name for field in dataclasses.fields(Viability)],
            "properties": {
                **{field.name: _NUMBER for field in dataclasses.fields(Viability)},
                "viable": {"type": "boolean", "description": "true or false"},
                "reason": _TEXT,
            },
            "description": "an object of figures",
        },
    },
    "description": "an object",
}


def record_of(attributes: dict[str, Any]) -> Record:
    """Return the record that `attributes_of` wrote; further attributes are left out.

    Raises
    ------
    ValueError
        If an attribute is missing or of another type.
    """
    if wrong := violation(attributes, _SCHEMA):
        raise ValueError(wrong)
    if not all(isinstance(attributes[name], int) for name in ("index", "seed", "steps")):
        raise ValueError("index, seed or steps as no whole number")
    return Record(
        **{name: attributes[name] for name in ("index", "seed", "status", "versions", "steps")},
        **{name: _number(attributes[name]) for name in ("mass", "energy", "seconds")},
        coefficients=Coefficients(*(attributes["coefficients"][name] for name in NAMES)),
        viability=Viability(**{name: _number(value) for name, value in attributes["viability"].items()}),
    )


def digest(attributes: dict[str, Any], field: np.ndarray | None) -> str:
    """Return the SHA-256 of a record as canonical JSON, and of the field's bytes."""
    content = {name: value for name, value in attributes.items() if name != "sha256"}
    checksum = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    checksum.update(b"" if field is None else np.ascontiguousarray(field).tobytes())
    return checksum.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: Any) -> Any:
    return math.nan if value is None else value
