"""The `fit.json` that an inference writes, as far as a generator or a loss needs it."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from curvafit.priors.coefficients import NAMES, Coefficients

FORMAT = "curvafit-fit-1"


class Prior(NamedTuple):
    """What a `fit.json` says: coefficients and mass in working units, and what ties these to the scan.

    Attributes
    ----------
    physical, epsilon
        The same coefficients, and ε, with lengths in `unit`.
    working_voxel
        Edge of a working voxel in `unit`.
    """

    coefficients: Coefficients
    mass: float
    physical: Coefficients
    epsilon: float
    working_voxel: float
    unit: str


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
        return Prior(working, mass, physical, epsilon, voxel, str(content["length_unit"]))
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"expected a fit.json written by `curvafit infer`, got {path} ({error!r})") from error
