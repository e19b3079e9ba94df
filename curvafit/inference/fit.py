"""What an inference found, and the `fit.json` that carries it to the generator and the prior."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.files import write_content
from curvafit.geometry.diagram import Diagram
from curvafit.geometry.morphometry import Morphometry
from curvafit.inference.match import Match
from curvafit.pictures import Pictured
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.fit_file import Prior, fit_bytes, parse_fit, six_of
from curvafit.priors.fit_schema import FORMAT, WHOLE_FIT, violation
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING

_SEEN = {"field": "a phase field", "mask": "a mask", "image": "an image"}


@dataclass(frozen=True, repr=False, eq=False)
class Fit(Pictured):
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

    def __repr__(self) -> str:
        six = ", ".join(f"{value:.4g}" for value in self.coefficients.as_dict().values())
        voxel = f"working voxel {self.working_voxel:.4g} {self.length_unit}"
        return f"Fit({self.family} from {_SEEN[self.kind]}, a = ({six}), mass {self.mass:.3g}, {voxel}: {self.status})"

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
            "morphometry": {name: None if x != x else x for name, x in vars(self.morphometry).items()},
            "notes": list(self.notes),
            "provenance": self.provenance,
            "diagram": None if self.diagram is None else _diagram_dict(self.diagram, self.kind),
        }

    def to_json(self) -> str:
        """Return the text of a `fit.json`: indented, but lists of numbers in one line.

        Raises
        ------
        ValueError
            If the fit is none that `from_json` takes.
        """
        content = self.as_dict()
        if wrong := violation(content, WHOLE_FIT):
            raise ValueError(f"expected {wrong} in a fit")
        text = json.dumps(content, indent=2, allow_nan=False)
        return re.sub(r"\[\n\s+([-+.\de,\s]+?)\n\s+\]", lambda numbers: f"[{' '.join(numbers[1].split())}]", text)

    @classmethod
    def from_json(cls, text: str | bytes) -> Fit:
        """Return the fit of a `fit.json`'s text; its diagram has the digits that the text has.

        Raises
        ------
        ValueError
            If the text is no whole fit of this format (`priors.fit_schema.WHOLE_FIT`).
        """
        return _fit_of(parse_fit(text, "the text", WHOLE_FIT))

    def save(self, path: str | PathLike[str]) -> Path:
        """Write a `fit.json`, whole or not at all, and return its path."""
        return write_content(Path(path), self.to_json())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Fit:
        """Read a `fit.json`.

        Raises
        ------
        FileNotFoundError, ValueError
            If there is no such file, or as `from_json`.
        """
        return _fit_of(parse_fit(fit_bytes(path), path, WHOLE_FIT))


def _fit_of(content: dict[str, Any]) -> Fit:
    """Return the fit of a checked content."""
    same = ("kind", "family", "chosen", "length_unit", "refined", "distances", "status", "provenance")
    measured: dict[str, Any] = {name: math.nan if x is None else x for name, x in content["morphometry"].items()}
    return Fit(
        **{name: content[name] for name in same},
        coefficients=six_of(content["coefficients"]),
        mass=float(content["mass"]),
        uncertainty={name: float(value) for name, value in content["uncertainty"].items()},
        scale=tuple(map(float, content["scale"])),  # type: ignore[arg-type]
        working_voxel=float(content["working_voxel"]),
        matches=tuple(map(_match_of, content["matches"])),
        morphometry=Morphometry(**measured),
        notes=tuple(content["notes"]),
        diagram=None if content["diagram"] is None else _diagram_of(content["diagram"]),
    )


def _diagram_dict(diagram: Diagram, kind: str) -> dict[str, Any]:
    """Curvatures to 2 decimals (bins are 2 wide), shares of area, and which diagrams of an atlas it compares with."""
    return {
        "seen_as": "field" if kind == "field" else "mask",
        "unit": diagram.unit,
        "kappa1": diagram.points[:, 0].round(2).tolist(),
        "kappa2": diagram.points[:, 1].round(2).tolist(),
        "share": diagram.normalised.weights.round(7).tolist(),
        "spread": diagram.spread,
        "excluded": diagram.excluded,
    }


def _diagram_of(content: dict[str, Any]) -> Diagram:
    """Return the diagram of its columns, with the shares of area for weights."""
    columns = [content[name] for name in ("kappa1", "kappa2", "share")]
    if len({len(column) for column in columns}) > 1:
        lengths = ", ".join(str(len(column)) for column in columns)
        raise ValueError(f"expected kappa1, kappa2 and share of one length in a fit's diagram, got {lengths}")
    known = {name: content[name] for name in ("unit", "spread", "excluded") if name in content}
    return Diagram(np.stack(columns[:2], 1), np.array(columns[2]), **known)


def _match_dict(match: Match) -> dict[str, Any]:
    return {**vars(match), "coefficients": match.coefficients.as_dict()}


def _match_of(content: dict[str, Any]) -> Match:
    six, mass = six_of(content["coefficients"]), float(content["mass"])
    return Match(content["id"], float(content["distance"]), six, mass, int(content["seed"]))
