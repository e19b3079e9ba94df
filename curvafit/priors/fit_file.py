"""The law in a `fit.json`: the part of an inference's file that a generator or a loss needs."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from curvafit.core.checks import quoted
from curvafit.core.records import parse_json
from curvafit.core.units import METRES
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.fit_schema import FIT_SCHEMA, FORMAT, violation


class Prior(NamedTuple):
    """The law of a `fit.json`: coefficients and mass in working units, and the lengths that relate them to the scan.

    Attributes
    ----------
    physical, epsilon
        The same coefficients, and ε, with lengths in `unit`.
    working_voxel
        Edge of a working voxel, in `unit`.
    volume_fraction
        Share of the scan's volume inside the structure; None where the file does not have it.
    """

    coefficients: Coefficients
    mass: float
    physical: Coefficients
    epsilon: float
    working_voxel: float
    unit: str
    volume_fraction: float | None = None

    def in_unit(self, unit: str | None) -> Coefficients:
        """Return the coefficients with lengths in another unit, or in the fit's where `unit` is None.

        Raises
        ------
        ValueError
            If the two units cannot be compared.
        """
        if unit is None or unit == self.unit:
            return self.physical
        if unit not in METRES or self.unit not in METRES:
            mend = ": run `curvafit infer` again with --spacing and --unit" if self.unit not in METRES else ""
            raise ValueError(
                f"expected two units among {', '.join(METRES)}, got {unit} and the fit's {self.unit}{mend}"
            )
        return self.physical.in_unit(METRES[unit] / METRES[self.unit])


def read_fit(path: str | PathLike[str]) -> Prior:
    """Read the law of a `fit.json`.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such file, it is not a `fit.json` of this format or the one before (`fit_schema`), or it has no
        law.
    """
    content = parse_fit(fit_bytes(path), path, FIT_SCHEMA)
    if any(content[name] is None for name in ("coefficients", "mass", "coefficients_physical")):
        raise ValueError(f"expected a fit.json with a law, got none in {path}: {content.get('status', 'no reason')}")
    working, physical = (six_of(content[key]) for key in ("coefficients", "coefficients_physical"))
    mass, epsilon, voxel = (float(content[key]) for key in ("mass", "epsilon_physical", "working_voxel"))
    filled = (content.get("morphometry") or {}).get("volume_fraction")
    return Prior(working, mass, physical, epsilon, voxel, content["length_unit"], filled)


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
