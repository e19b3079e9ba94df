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
    """A record in JSON's types; numbers that are not finite become null."""
    attributes = dataclasses.asdict(record) | {"coefficients": record.coefficients.as_dict()}
    attributes["viability"] = {name: _plain(value) for name, value in attributes["viability"].items()}
    return {name: _plain(value) for name, value in attributes.items()}


def record_of(attributes: dict[str, Any]) -> Record:
    """The inverse of `attributes_of`; further attributes are left out."""
    return Record(
        **{name: attributes[name] for name in ("index", "seed", "status", "versions", "steps")},
        **{name: _number(attributes[name]) for name in ("mass", "energy", "seconds")},
        coefficients=Coefficients(*(attributes["coefficients"][name] for name in NAMES)),
        viability=Viability(**{name: _number(value) for name, value in attributes["viability"].items()}),
    )


def digest(attributes: dict[str, Any], field: np.ndarray | None) -> str:
    """SHA-256 of a record as canonical JSON, and of the field's bytes."""
    kept = {name: value for name, value in attributes.items() if name != "sha256"}
    found = hashlib.sha256(json.dumps(kept, sort_keys=True).encode())
    found.update(b"" if field is None else np.ascontiguousarray(field).tobytes())
    return found.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: Any) -> Any:
    return math.nan if value is None else value
