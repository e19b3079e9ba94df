"""The `fit.json` that an inference writes, as far as a generator or a loss needs it."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import NamedTuple

from curvafit.priors.bounds import quoted
from curvafit.priors.coefficients import NAMES, Coefficients
from curvafit.priors.fit_schema import FORMAT, violation
from curvafit.priors.json_text import parse_json
from curvafit.units import METRES


class Prior(NamedTuple):
    """What a `fit.json` says: coefficients and mass in working units, and what ties these to the scan.

    Attributes
    ----------
    physical, epsilon
        The same coefficients, and ε, with lengths in `unit`.
    working_voxel
        Edge of a working voxel in `unit`.
    volume_fraction
        Of the scan's structure, None where the file does not tell.
    """

    coefficients: Coefficients
    mass: float
    physical: Coefficients
    epsilon: float
    working_voxel: float
    unit: str
    volume_fraction: float | None = None

    def in_unit(self, unit: str | None) -> Coefficients:
        """The coefficients with lengths in another unit, or in their own where none is named.

        Raises
        ------
        ValueError
            If the two units cannot be compared.
        """
        if unit is None or unit == self.unit:
            return self.physical
        if unit not in METRES or self.unit not in METRES:
            raise ValueError(f"expected two units among {', '.join(METRES)}, got {unit} and the fit's {self.unit}")
        return self.physical.in_unit(METRES[unit] / METRES[self.unit])


def read_fit(path: str | PathLike[str]) -> Prior:
    """Read a `fit.json`.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such file, or it is not a `fit.json` of this format (`fit_schema`).
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"expected a fit.json, found no file {path}")
    expected = "a fit.json written by `curvafit infer`"
    content = parse_json(path.read_bytes(), expected, path)
    said = content.get("format", FORMAT) if isinstance(content, dict) else FORMAT
    if said != FORMAT:
        got = f"got {quoted(said)} in {path}: run `curvafit infer` again"
        raise ValueError(f"expected a fit.json of format {FORMAT}, {got}")
    if wrong := violation(content):
        raise ValueError(f"expected {expected} with {wrong} in {path}")
    working, physical = (
        Coefficients(*(float(content[key][name]) for name in NAMES))
        for key in ("coefficients", "coefficients_physical")
    )
    mass, epsilon, voxel = (float(content[key]) for key in ("mass", "epsilon_physical", "working_voxel"))
    filled = (content.get("morphometry") or {}).get("volume_fraction")
    return Prior(working, mass, physical, epsilon, voxel, content["length_unit"], filled)
