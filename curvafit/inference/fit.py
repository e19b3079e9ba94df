"""What an inference says of a scan, and the `fit.json` that carries its law to the generator and the prior."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass, fields, make_dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import numpy as np

from curvafit.core.checks import check_int, quoted
from curvafit.core.files import write_content
from curvafit.core.runtime import Pictured
from curvafit.core.schema import Rule, decode, encode
from curvafit.core.units import METRES
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.morphology import Morphometry
from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Deviations, Misfit, NotNegative
from curvafit.inference.posterior import Combination
from curvafit.inference.table import COLUMNS, to_columns
from curvafit.priors.coefficients import POWERS, Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.law import FORMAT, Law, LawLike, Mass, Positive, parse_fit, preset_name, read_fit

#: What a scan was taken for, in words.
KINDS = {"field": "a phase field", "mask": "a mask", "image": "an image"}
#: Levels of the intervals, in percent.
LEVELS = (50, 90)


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
        Draws from the posterior `(n, 7)`, in the order of `table.TARGETS`; None where the scan's descriptors could not
        be measured.
    view
        What the scan was taken for: a kind of view that the posterior was trained on.
    combinations
        What the scan tells of sums of the parameters, the best known first; of the background's where the structure
        fills over half.
    misfit
        How the scan's descriptors lie among those that the model makes; None where that is not known.
    drift
        Root mean square distance, in working voxels, by which a short flow of the chosen law moves the scan's surface.
    scale
        Working voxel in scan voxels, (z, y, x).
    working_voxel, length_unit
        Edge of a working voxel, which is one of the chosen law's shapes where their thickness is the scan's; and the
        unit that it and every physical number here is in.
    thickness
        Median thickness of the scan's structure beneath its surface.
    matches
        The nearest shapes of the atlas.
    status
        The verdict, in a sentence or two.
    diagram
        The scan's curvature diagram, binned as an atlas's are, in 1 / working unit: with it the scan finds its place on
        an atlas's map. Of masks and images a working unit is 100 voxels of which the structure is eight thick.
    """

    kind: Literal[*KINDS]  # type: ignore[valid-type]
    family: str
    scale: tuple[Positive, Positive, Positive]
    working_voxel: Positive
    length_unit: Literal["voxel", *METRES]  # type: ignore[valid-type]
    thickness: Positive
    status: str
    morphometry: Morphometry
    notes: tuple[str, ...]
    provenance: Annotated[dict[str, Any], Rule(keys=(("scan", str | None),))]
    diagram: Diagram | None = None
    candidates: tuple[Candidate, ...] = ()
    chosen: str | None = None
    draws: np.ndarray | None = None
    view: str = ""
    combinations: tuple[Combination, ...] = ()
    misfit: Misfit | None = None
    drift: Annotated[float | None, Rule(least=0)] = None
    matches: tuple[Match, ...] = ()

    def __repr__(self) -> str:
        six = "none" if self.best is None else f"({', '.join(f'{x:.4g}' for x in self.best.coefficients)})"
        mass = "" if self.best is None else f", mass {self.best.mass:.3g}"
        voxel = f"working voxel {self.working_voxel:.4g} {self.length_unit}"
        return f"Fit({self.family} from {KINDS[self.kind]}, a = {six}{mass}, {voxel}: {self.status})"

    @property
    def best(self) -> Candidate | None:
        """Return the candidate that was chosen."""
        return next((candidate for candidate in self.candidates if candidate.name == self.chosen), None)

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
        """Return λ, a working length of 1 in physical units."""
        return self.working_voxel / WORKING_SPACING

    @property
    def coefficients_physical(self) -> Coefficients | None:
        """Return the same energy in `length_unit`: quadratic part unchanged, linear / λ, constant / λ²."""
        return None if self.coefficients is None else self.coefficients.in_unit(1 / self.length)

    @property
    def epsilon_physical(self) -> float:
        """Return the interface width ε in `length_unit`."""
        return WORKING_EPSILON * self.length

    def intervals(self, *, physical: bool = False) -> dict[str, dict[str, Any]] | None:
        """Return the median and the central intervals of each parameter's draws; None without draws.

        Lengths are in the working units of each draw, or physical: a draw's shapes are as thick as the scan's.
        """
        if self.draws is None:
            return None
        parts, columns = {}, to_columns(self.draws)
        lengths = self.thickness / columns[-1] / WORKING_SPACING if physical else 1.0
        for name, column in zip(COLUMNS[:-1], columns[:-1], strict=True):
            values = column * lengths ** -(POWERS | {"mass": 0})[name]
            parts[name] = {"median": float(np.median(values))}
            parts[name] |= {str(n): np.percentile(values, (50 - n / 2, 50 + n / 2)).tolist() for n in LEVELS}
        return parts

    def to_law(self) -> Law:
        """Return the chosen law; raise ValueError if the fit has none."""
        if self.best is None:
            raise ValueError(f"expected a fit with a law, got one without: {self.status}")
        width = self.epsilon_physical * WORKING_SPACING / self.working_voxel
        return replace(self._law(self.best.coefficients, self.best.mass, "prior", self.working_voxel), epsilon=width)

    def _law(self, six: Coefficients, mass: float, origin: str, edge: float) -> Law:
        """Return a law whose working voxel is `edge` long, with what is known of the scan."""
        filled = self.morphometry.volume_fraction
        own = {"length_unit": self.length_unit, "volume_fraction": filled, "status": self.status}
        return Law(six, mass, origin, working_voxel=edge, **own)

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings, lists and dicts, as `fit.json` holds them."""
        own: dict[str, Any] = {"format": FORMAT, "posterior": None, "diagram": None}
        own |= {"intervals": self.intervals(), "intervals_physical": self.intervals(physical=True)}
        if self.draws is not None:
            draws = _Draws(*([float(f"{x:.6g}") for x in column] for column in to_columns(self.draws)))
            own["posterior"] = _Posterior(self.view, "amortised: conditional flows given the descriptors", draws)
        if (seen := self.diagram) is not None:
            (κ1, κ2), shares = seen.points.round(2).T.tolist(), seen.normalised.weights.round(7).tolist()
            columns = {"kappa1": κ1, "kappa2": κ2, "share": shares, "spread": seen.spread, "excluded": seen.excluded}
            own["diagram"] = _Columns(seen_as="field" if self.kind == "field" else "mask", unit=seen.unit, **columns)
        return {name: encode(own[name] if name in own else getattr(self, name)) for name in ENTRIES}

    def to_json(self) -> str:
        """Return the text of a `fit.json`, indented; raise ValueError where `from_json` would not take it."""
        content = self.as_dict()
        try:
            decode(_File, content)
        except ValueError as fault:
            raise ValueError(f"expected {fault} in a fit") from None
        text = json.dumps(content, indent=2, allow_nan=False)
        return re.sub(r"\[\n\s+([-+.\de,\s]+?)\n\s+\]", lambda numbers: f"[{' '.join(numbers[1].split())}]", text)

    @classmethod
    def from_json(cls, text: str | bytes) -> Fit:
        """Return the fit that a `fit.json`'s text states; raise ValueError if it is not whole."""
        return _fit_of(parse_fit(text, "the text", _File))

    def save(self, path: str | PathLike[str]) -> Path:
        """Write a `fit.json`, whole or not at all, and return its path."""
        return write_content(Path(path), self.to_json())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Fit:
        """Read a `fit.json`; raise FileNotFoundError if there is none, ValueError as `from_json`."""
        return _fit_of(read_fit(path, _File))


def draw_laws(law: LawLike, count: int) -> list[Law]:
    """Return `count` laws of the posterior of a fit, an inference or a `fit.json`, evenly from among its draws.

    Each has the voxel in which its shapes are as thick as the scan's structure, and the scan's volume fraction. Raises
    ValueError where there are no draws, or fewer.
    """
    named = preset_name(law) is None and isinstance(law, (str, PathLike))
    fit = Fit.load(law) if named else getattr(law, "fit", law)  # type: ignore[arg-type]
    if not isinstance(fit, Fit) or fit.draws is None:
        raise ValueError(f"expected a fit with draws of a posterior, got {quoted(law)}")
    check_int(count, f"from 1 to {len(fit.draws)} draws", 1, len(fit.draws))
    rows = np.linspace(0, len(fit.draws) - 1, count).round().astype(int).tolist()
    source = f" of {os.fspath(law)}" if named else ""  # type: ignore[arg-type]
    return [
        fit._law(Coefficients(1.0, *five), mass, f"draw {row}{source}", fit.thickness / thickness)
        for row, (*five, mass, thickness) in zip(rows, to_columns(fit.draws[rows]).T.tolist(), strict=True)
    ]


# ---- the file --------------------------------------------------------------------------------------------------------

#: The entries of a `fit.json`, in order.
ENTRIES = (
    "format", "status", "kind", "family", "coefficients", "mass", "uncertainty", "chosen", "scale", "working_voxel",
    "length_unit", "thickness", "coefficients_physical", "epsilon_physical", "intervals", "intervals_physical",
    "combinations", "misfit", "drift", "candidates", "matches", "morphometry", "notes", "provenance", "posterior",
    "diagram",
)  # fmt: skip

Column = Annotated[tuple[float, ...], Rule(filled=True)]

# Draws by parameter; and with what was read, a kind of view, and how.
_Draws: Any = make_dataclass("_Draws", [(name, Column) for name in COLUMNS])
_Posterior: Any = make_dataclass("_Posterior", [("view", str), ("method", str), ("draws", _Draws)])


@dataclass(frozen=True, kw_only=True)
class _Columns:
    """A diagram: curvatures to 2 decimals (bins are 2 wide), shares of area, and its kind in an atlas."""

    seen_as: Literal["field", "mask"] = "mask"
    unit: str = "1/working unit"
    kappa1: Column
    kappa2: Column
    share: Annotated[tuple[NotNegative, ...], Rule(filled=True)]
    spread: NotNegative = 0.0
    excluded: NotNegative = 0.0


# Entries that are no fields of a `Fit` follow from its fields, for other programs, or hold its arrays.
_HINTS = get_type_hints(Fit, include_extras=True) | {
    "format": str, "coefficients": Coefficients | None, "mass": Mass, "uncertainty": Deviations,
    "coefficients_physical": Coefficients | None, "epsilon_physical": Positive, "intervals": dict[str, Any] | None,
    "intervals_physical": dict[str, Any] | None, "posterior": _Posterior | None, "diagram": _Columns | None,
}  # fmt: skip
_File: Any = make_dataclass("_File", [(name, _HINTS[name]) for name in ENTRIES])


def _fit_of(file: Any) -> Fit:
    read = {field.name: getattr(file, field.name) for field in fields(Fit) if field.name in ENTRIES}
    if file.posterior is not None:
        draws = _stack([getattr(file.posterior.draws, name) for name in COLUMNS], "draws", "posterior")
        draws[:, [1, 6]] = np.log(draws[:, [1, 6]])
        read |= {"draws": draws, "view": file.posterior.view}
    if (seen := file.diagram) is not None:
        rows = _stack([seen.kappa1, seen.kappa2, seen.share], "kappa1, kappa2 and share", "diagram")
        read["diagram"] = Diagram(rows[:, :2], rows[:, 2], seen.unit, seen.spread, seen.excluded)
    fit = Fit(**read)
    if (fit.chosen is None) != (fit.best is None):
        raise ValueError(f"expected a chosen law among the fit's candidates, got {fit.chosen!r}")
    return fit


def _stack(columns: list[tuple[float, ...]], names: str, place: str) -> np.ndarray:
    if len({len(column) for column in columns}) > 1:
        lengths = ", ".join(str(len(column)) for column in columns)
        raise ValueError(f"expected {names} of one length in a fit's {place}, got {lengths}")
    return np.stack(columns, 1, dtype=np.float64)
