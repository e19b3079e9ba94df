"""The `fit.json` that an inference writes, as far as a generator or a loss needs it."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from curvafit.priors.coefficients import NAMES, PRESETS, Coefficients
from curvafit.priors.grid import METRES, WORKING_SPACING

FORMAT = "curvafit-fit-1"


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


#: What may stand for a prior: coefficients, a preset's name, or the path of a `fit.json`.
Law = Coefficients | str | PathLike[str]


def find_law(law: Law, edge: float) -> Coefficients | Prior:
    """Coefficients, those of a preset with its working voxel of length `edge`, or a `fit.json` that is to be converted.

    Raises
    ------
    FileNotFoundError, ValueError
        If the coefficients vary, there is no preset of that name, or as `read_fit`.
    """
    if isinstance(law, Coefficients):
        if any(isinstance(value, Tensor) and value.dim() > 0 for value in law):
            raise ValueError("expected coefficients that are numbers, got some that vary")
        return law
    if isinstance(law, str) and law in PRESETS:
        return PRESETS[law].coefficients.in_unit(WORKING_SPACING / edge)
    if isinstance(law, str) and not law.endswith(".json"):
        raise ValueError(f"expected a preset among {', '.join(PRESETS)}, or a fit.json, got {law!r}")
    return read_fit(law)


def read_fit(path: str | PathLike[str]) -> Prior:
    """Read a `fit.json`.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such file, or it is not a `fit.json` of this format.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"expected a fit.json, found no file {path}")
    try:
        content = json.loads(path.read_text())
        found = content["format"]
        if found != FORMAT:
            raise ValueError(
                f"expected a fit.json of format {FORMAT}, got {found!r} in {path}: run `curvafit infer` again"
            )
        working, physical = (
            Coefficients(*(content[key][name] for name in NAMES)) for key in ("coefficients", "coefficients_physical")
        )
        mass, epsilon, voxel = (float(content[key]) for key in ("mass", "epsilon_physical", "working_voxel"))
        if not (epsilon > 0 and voxel > 0):
            raise ValueError(f"expected a positive ε and working voxel in {path}, got {epsilon} and {voxel}")
        told = (content.get("morphometry") or {}).get("volume_fraction")
        filled = None if told is None else float(told)
        return Prior(working, mass, physical, epsilon, voxel, str(content["length_unit"]), filled)
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"expected a fit.json written by `curvafit infer`, got {path} ({error!r})") from error
