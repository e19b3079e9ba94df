"""What an inference says of a scan, and the `fit.json` that carries its law to the generator and the prior."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.files import write_content
from curvafit.core.pictures import Pictured
from curvafit.geometry.diagram import Diagram
from curvafit.geometry.morphometry import Morphometry
from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Misfit, content_of, morphometry_of
from curvafit.priors.coefficients import NAMES, POWERS, Coefficients
from curvafit.priors.fit_schema import FORMAT, WHOLE_FIT, fit_bytes, parse_fit, six_of, violation
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.law import Law

_SEEN = {"field": "a phase field", "mask": "a mask", "image": "an image"}
#: What is drawn, in the order of the columns; a20 = 1 is the gauge.
COLUMNS = ("a11", "a02", "a10", "a01", "a00", "mass")
#: Levels of the intervals, in percent.
LEVELS = (50, 90)
#: Significant digits of a draw in a file.
_DIGITS = 6


@dataclass(frozen=True, repr=False, eq=False)
class Fit(Pictured):
    """The law of a scan, in working and in physical units: what is known of it, and what supports it.

    Attributes
    ----------
    candidates
        Laws that may have made the scan, with what grew from each.
    chosen
        Name of the candidate that is best supported; None where none is a law of the scan: `status` says why.
    draws
        Draws from the posterior; None where the scan's descriptors could not be measured.
    weak_directions
        Sentences, one for each direction in which the scan leaves the parameters open.
    misfit
        How the scan's descriptors lie among those that the model makes; None where that is not known.
    drift
        How far, in working voxels (root mean square), a short flow of the chosen law moves the scan's own surface.
    scale
        Working voxel in scan voxels, (z, y, x).
    working_voxel, length_unit
        Edge of a working voxel, and the unit that it and every physical number here is in.
    matches
        The nearest shapes of the atlas.
    status
        The verdict, in a sentence or two.
    diagram
        The scan's curvature diagram, binned as an atlas's are, in 1 / working unit: with it the scan finds its place on
        an atlas's map.
    """

    kind: str
    family: str
    candidates: tuple[Candidate, ...]
    chosen: str | None
    draws: Draws | None
    weak_directions: tuple[str, ...]
    misfit: Misfit | None
    drift: float | None
    scale: tuple[float, float, float]
    working_voxel: float
    length_unit: str
    matches: tuple[Match, ...]
    status: str
    morphometry: Morphometry
    notes: tuple[str, ...]
    provenance: dict[str, Any]
    diagram: Diagram | None = None

    def __repr__(self) -> str:
        six = "none" if self.best is None else f"({', '.join(f'{x:.4g}' for x in self.best.coefficients)})"
        mass = "" if self.best is None else f", mass {self.best.mass:.3g}"
        voxel = f"working voxel {self.working_voxel:.4g} {self.length_unit}"
        return f"Fit({self.family} from {_SEEN[self.kind]}, a = {six}{mass}, {voxel}: {self.status})"

    @property
    def best(self) -> Candidate | None:
        """Return the candidate that was chosen."""
        return next((each for each in self.candidates if each.name == self.chosen), None)

    @property
    def coefficients(self) -> Coefficients | None:
        """Return the chosen coefficients in working units: voxel 0.01, ε 0.02, a20 = 1."""
        return None if self.best is None else self.best.coefficients

    @property
    def mass(self) -> float | None:
        """Return the chosen mass m₀."""
        return None if self.best is None else self.best.mass

    @property
    def uncertainty(self) -> dict[str, float]:
        """Return the standard deviations of the chosen candidate: its own, or none."""
        return {} if self.best is None else self.best.uncertainty

    @property
    def length(self) -> float:
        """λ: a working length of 1 in physical units."""
        return self.working_voxel / WORKING_SPACING

    @property
    def coefficients_physical(self) -> Coefficients | None:
        """The same energy in `length_unit`: quadratic part unchanged, linear / λ, constant / λ²."""
        return None if self.coefficients is None else self.coefficients.in_unit(1 / self.length)

    @property
    def epsilon_physical(self) -> float:
        return WORKING_EPSILON * self.length

    def to_law(self) -> Law:
        """Return what `Law.load` reads from the fit's file: the fit as a law.

        Raises
        ------
        ValueError
            If the fit has none.
        """
        six, mass = self.coefficients, self.mass
        if six is None or mass is None:
            raise ValueError(f"expected a fit with a law, got one without: {self.status}")
        filled = self.morphometry.volume_fraction
        width = self.epsilon_physical * WORKING_SPACING / self.working_voxel
        own = {"working_voxel": self.working_voxel, "length_unit": self.length_unit, "volume_fraction": filled}
        return Law(six, mass, "prior", epsilon=width, schedule="deep", **own)  # type: ignore[arg-type]

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, strings, lists and dicts, as `fit.json` holds them."""
        six, physical, draws = self.coefficients, self.coefficients_physical, self.draws
        return {
            "format": FORMAT,
            "status": self.status,
            "kind": self.kind,
            "family": self.family,
            "coefficients": None if six is None else six.as_dict(),
            "mass": self.mass,
            "uncertainty": self.uncertainty,
            "chosen": self.chosen,
            "scale": list(self.scale),
            "working_voxel": self.working_voxel,
            "length_unit": self.length_unit,
            "coefficients_physical": None if physical is None else physical.as_dict(),
            "epsilon_physical": self.epsilon_physical,
            "intervals": None if draws is None else draws.intervals(),
            "intervals_physical": None if draws is None else draws.intervals(self.length),
            "weak_directions": list(self.weak_directions),
            "misfit": None if self.misfit is None else self.misfit.as_dict(),
            "drift": self.drift,
            "candidates": [each.as_dict() for each in self.candidates],
            "matches": [_match_dict(match) for match in self.matches],
            "morphometry": content_of(self.morphometry),
            "notes": list(self.notes),
            "provenance": self.provenance,
            "posterior": None if draws is None else draws.as_dict(),
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
    same = ("kind", "family", "chosen", "drift", "length_unit", "status", "provenance")
    fit = Fit(
        **{name: content[name] for name in same},
        candidates=tuple(map(Candidate.from_dict, content["candidates"])),
        draws=None if content["posterior"] is None else Draws.from_dict(content["posterior"]),
        weak_directions=tuple(content["weak_directions"]),
        misfit=None if content["misfit"] is None else Misfit.from_dict(content["misfit"]),
        scale=tuple(map(float, content["scale"])),  # type: ignore[arg-type]
        working_voxel=float(content["working_voxel"]),
        matches=tuple(map(_match_of, content["matches"])),
        morphometry=morphometry_of(content["morphometry"]),
        notes=tuple(content["notes"]),
        diagram=None if content["diagram"] is None else _diagram_of(content["diagram"]),
    )
    if (fit.chosen is None) != (fit.best is None):
        raise ValueError(f"expected a chosen law among the fit's candidates, got {fit.chosen!r}")
    return fit


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


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws `(n, 6)` of (a11, a02, a10, a01, a00, m₀) in working units, with a20 = 1.

    Attributes
    ----------
    view
        What the scan was taken for: a kind of view that the posterior was trained on.
    method
        How they were drawn, in words.
    """

    values: np.ndarray
    view: str
    method: str

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(COLUMNS) or not np.isfinite(self.values).all():
            raise ValueError(f"expected finite draws (n, {len(COLUMNS)}), got shape {self.values.shape}")

    @staticmethod
    def of(parameters: np.ndarray, view: str, method: str) -> Draws:
        """Return the draws of parameters `(n, 6)` with log a02 for a02 (`table.PARAMETERS`)."""
        values = np.array(parameters, dtype=np.float64)
        values[:, 1] = np.exp(values[:, 1])
        return Draws(values, view, method)

    @property
    def parameters(self) -> np.ndarray:
        """Return the draws as `table.PARAMETERS` has them, with log a02."""
        values = self.values.copy()
        values[:, 1] = np.log(values[:, 1])
        return values

    @property
    def deviations(self) -> dict[str, float]:
        """Return the standard deviations by name, 0 for a20."""
        return {"a20": 0.0} | {name: float(x) for name, x in zip(COLUMNS, self.values.std(0), strict=True)}

    def middle(self, scale: np.ndarray) -> np.ndarray:
        """Return the row of `parameters` nearest to the medians, in units of `scale` `(6,)`."""
        rows = self.parameters
        return rows[np.square((rows - np.median(rows, 0)) / scale).sum(1).argmin()]

    def intervals(self, length: float = 1.0) -> dict[str, dict[str, Any]]:
        """Return each parameter's median and central intervals, in the unit of which a working length is `length`."""
        parts = {}
        powers = (*(POWERS[name] for name in NAMES[1:]), 0)
        for name, power, column in zip(COLUMNS, powers, self.values.T, strict=True):
            values = column * length**-power
            parts[name] = {"median": float(np.median(values))} | {
                str(level): [float(x) for x in np.percentile(values, (50 - level / 2, 50 + level / 2))]
                for level in LEVELS
            }
        return parts

    def as_dict(self) -> dict[str, Any]:
        """Return the draws in JSON's types, a column for each parameter."""
        columns = {
            name: [float(f"{x:.{_DIGITS}g}") for x in column]
            for name, column in zip(COLUMNS, self.values.T, strict=True)
        }
        return {"view": self.view, "method": self.method, "draws": columns}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Draws:
        """Return what `as_dict` wrote, to its digits.

        Raises
        ------
        ValueError
            If the columns have several lengths.
        """
        columns = [content["draws"][name] for name in COLUMNS]
        if len({len(column) for column in columns}) > 1:
            lengths = ", ".join(str(len(column)) for column in columns)
            raise ValueError(f"expected draws of one length in a fit's posterior, got {lengths}")
        return Draws(np.array(columns, dtype=np.float64).T, content["view"], content["method"])
