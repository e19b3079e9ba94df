"""What an inference found, and the `fit.json` that carries it to the generator and the prior."""

from __future__ import annotations

import dataclasses
import json
import re
from dataclasses import dataclass
from typing import Any

from curvafit.geometry.diagram import Diagram
from curvafit.geometry.morphometry import Morphometry
from curvafit.inference.match import Match
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.fit_file import Prior
from curvafit.priors.fit_schema import FORMAT, violation
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING


@dataclass(frozen=True)
class Fit:
    """The parameters of a scan, in working and in physical units.

    Attributes
    ----------
    coefficients, mass
        The better supported of match and refinement (`chosen`), in working units: voxel 0.01, ε 0.02, a20 = 1.
    uncertainty
        Standard deviation of each refined coefficient; 0 for the one that fixes the scale.
    scale
        Working voxel in scan voxels, (z, y, x).
    working_voxel, length_unit
        Edge of a working voxel, and the unit that it and every physical number here is in.
    matches, refined
        The nearest shapes of the atlas, and what refinement made of them with its own account (`Refinement`).
    distances
        Curvature-diagram distances from the scan to the regenerated `match` and `fit` (None where the shape could not
        be made) and between two seeds of the chosen one (`seed_noise`).
    status
        Which of the two is better supported, and what failed.
    diagram
        The scan's curvature diagram, binned as an atlas's are, in 1 / working unit: with it the scan finds its place on
        an atlas's map.
    """

    kind: str
    family: str
    coefficients: Coefficients
    mass: float
    chosen: str
    uncertainty: dict[str, float]
    scale: tuple[float, float, float]
    working_voxel: float
    length_unit: str
    matches: tuple[Match, ...]
    refined: dict[str, Any]
    distances: dict[str, float | None]
    status: str
    morphometry: Morphometry
    notes: tuple[str, ...]
    provenance: dict[str, Any]
    diagram: Diagram | None = None

    @property
    def length(self) -> float:
        """λ: a working length of 1 in physical units."""
        return self.working_voxel / WORKING_SPACING

    @property
    def coefficients_physical(self) -> Coefficients:
        """The same energy in `length_unit`: quadratic part unchanged, linear / λ, constant / λ²."""
        return self.coefficients.in_unit(1 / self.length)

    @property
    def epsilon_physical(self) -> float:
        return WORKING_EPSILON * self.length

    def to_prior(self) -> Prior:
        """Return what `read_fit` reads from the fit's file: the fit as a law."""
        six, ε = self.coefficients_physical, self.epsilon_physical
        filled = self.morphometry.volume_fraction
        return Prior(self.coefficients, self.mass, six, ε, self.working_voxel, self.length_unit, filled)

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, strings, lists and dicts, as `fit.json` holds them."""
        return {
            "format": FORMAT,
            "kind": self.kind,
            "family": self.family,
            "coefficients": self.coefficients.as_dict(),
            "mass": self.mass,
            "chosen": self.chosen,
            "uncertainty": self.uncertainty,
            "scale": list(self.scale),
            "working_voxel": self.working_voxel,
            "length_unit": self.length_unit,
            "coefficients_physical": self.coefficients_physical.as_dict(),
            "epsilon_physical": self.epsilon_physical,
            "matches": [_match_dict(match) for match in self.matches],
            "refined": self.refined,
            "distances": self.distances,
            "status": self.status,
            "morphometry": dataclasses.asdict(self.morphometry),
            "notes": list(self.notes),
            "provenance": self.provenance,
            "diagram": None if self.diagram is None else _diagram_dict(self.diagram, self.kind),
        }

    def to_json(self) -> str:
        """The text of a `fit.json`: indented, but lists of numbers in one line.

        Raises
        ------
        ValueError
            If the fit is none that `read_fit` takes.
        """
        content = self.as_dict()
        if wrong := violation(content):
            raise ValueError(f"expected {wrong} in a fit")
        text = json.dumps(content, indent=2, allow_nan=False)
        return re.sub(r"\[\s+([-+.\de,\s]+?)\s+\]", lambda found: f"[{' '.join(found[1].split())}]", text)


def _diagram_dict(diagram: Diagram, kind: str) -> dict[str, Any]:
    """Curvatures to 2 decimals (bins are 2 wide), shares of area, and which diagrams of an atlas it compares with."""
    return {
        "seen_as": "field" if kind == "field" else "mask",
        "unit": diagram.unit,
        "kappa1": diagram.points[:, 0].round(2).tolist(),
        "kappa2": diagram.points[:, 1].round(2).tolist(),
        "share": diagram.normalised.weights.round(7).tolist(),
    }


def _match_dict(match: Match) -> dict[str, Any]:
    return {
        "id": match.id,
        "distance": match.distance,
        "coefficients": match.coefficients.as_dict(),
        "mass": match.mass,
        "seed": match.seed,
    }
