"""What an inference says of a scan, and the `fit.json` that carries its law to the generator and the prior."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, fields, make_dataclass
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import numpy as np

from curvafit.core.files import write_content
from curvafit.core.runtime import Pictured
from curvafit.core.schema import Rule, decode, encode
from curvafit.core.units import METRES, unit_name
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.morphology import Morphometry
from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Deviations, Misfit, NotNegative
from curvafit.inference.posterior import Combination
from curvafit.inference.table import COLUMNS, to_columns
from curvafit.priors.coefficients import POWERS, Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.law import FORMAT, Law, Mass, Positive, parse_fit, read_fit

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
        What the scan says of sums of the parameters, the best known first; of the background's parameters where the
        structure fills over half.
    misfit
        Test of whether the chosen law can have made the scan's descriptors; None where it was not tested.
    scale
        Working voxel in scan voxels, (z, y, x).
    working_voxel, length_unit
        Edge of a working voxel, with which the chosen law's shapes are as thick as the scan's structure; and its unit,
        which is that of every physical number here.
    thickness
        Median thickness of the scan's structure beneath its surface.
    matches
        The nearest shapes of the atlas.
    status
        The verdict, in a sentence or two.
    diagram
        The scan's curvature diagram, binned as an atlas's are, in 1 / working unit: it locates the scan on an atlas's
        map. Of masks and images a working unit is 100 voxels of which the structure is eight thick.
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
    matches: tuple[Match, ...] = ()

    def __repr__(self) -> str:
        values = "none" if self.best is None else f"({', '.join(f'{a:.4g}' for a in self.best.coefficients)})"
        mass = "" if self.best is None else f", mass {self.best.mass:.3g}"
        voxel = f"working voxel {self.working_voxel:.4g} {unit_name(self.length_unit)}"
        return f"Fit({self.family} from {KINDS[self.kind]}, a = {values}{mass}, {voxel}: {self.status})"

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
        intervals, columns = {}, to_columns(self.draws)
        working_length = self.thickness / columns[-1] / WORKING_SPACING if physical else 1.0
        for name, column in zip(COLUMNS[:-1], columns[:-1], strict=True):
            values = column * working_length ** -(POWERS | {"mass": 0})[name]
            intervals[name] = {"median": float(np.median(values))}
            intervals[name] |= {str(n): np.percentile(values, (50 - n / 2, 50 + n / 2)).tolist() for n in LEVELS}
        return intervals

    def to_law(self) -> Law:
        """Return the chosen law; raise ValueError if the fit has none."""
        if self.best is None:
            raise ValueError(f"expected a fit with a law, got one without: {self.status}")
        width = self.epsilon_physical * WORKING_SPACING / self.working_voxel
        scan = {"working_voxel": self.working_voxel, "length_unit": self.length_unit, "status": self.status}
        scan["volume_fraction"] = self.morphometry.volume_fraction
        return Law(self.best.coefficients, self.best.mass, "prior", epsilon=width, **scan)

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings, lists and dicts, as `fit.json` holds them."""
        derived: dict[str, Any] = {"format": FORMAT, "posterior": None, "diagram": None}
        derived |= {"intervals": self.intervals(), "intervals_physical": self.intervals(physical=True)}
        if self.draws is not None:
            draws = _Draws(*([float(f"{x:.6g}") for x in column] for column in to_columns(self.draws)))
            derived["posterior"] = _Posterior(self.view, "amortised: conditional flows given the descriptors", draws)
        if (diagram := self.diagram) is not None:
            κ1, κ2 = diagram.points.round(2).T.tolist()
            derived["diagram"] = _Columns(
                seen_as="field" if self.kind == "field" else "mask", unit=diagram.unit, kappa1=κ1, kappa2=κ2,
                share=diagram.normalised.weights.round(7).tolist(), spread=diagram.spread, excluded=diagram.excluded,
            )  # fmt: skip
        return {name: encode(derived[name] if name in derived else getattr(self, name)) for name in ENTRIES}

    def to_json(self) -> str:
        """Return the text of a `fit.json`, indented; raise ValueError where `from_json` would not take it."""
        content = self.as_dict()
        try:
            decode(_File, content)
        except ValueError as fault:
            raise ValueError(f"expected {fault} in a fit") from None
        text = json.dumps(content, indent=2, allow_nan=False)
        # Lists of numbers go on one line each, for people to read.
        return re.sub(r"\[\n\s+([-+.\de,\s]+?)\n\s+\]", lambda match: f"[{' '.join(match[1].split())}]", text)

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


# ---- the file --------------------------------------------------------------------------------------------------------

#: The entries of a `fit.json`, in order.
ENTRIES = (
    "format", "status", "kind", "family", "coefficients", "mass", "uncertainty", "chosen", "scale", "working_voxel",
    "length_unit", "thickness", "coefficients_physical", "epsilon_physical", "intervals", "intervals_physical",
    "combinations", "misfit", "candidates", "matches", "morphometry", "notes", "provenance", "posterior",
    "diagram",
)  # fmt: skip

Column = Annotated[tuple[float, ...], Rule(filled=True)]

# The entry `posterior`: the kind of view, how draws were made, and the draws by parameter.
_Draws: Any = make_dataclass("_Draws", [(name, Column) for name in COLUMNS])
_Posterior: Any = make_dataclass("_Posterior", [("view", str), ("method", str), ("draws", _Draws)])


@dataclass(frozen=True, kw_only=True)
class _Columns:
    """The entry `diagram`: curvatures to 2 decimals (bins are 2 wide), shares of area, and its kind in an atlas."""

    seen_as: Literal["field", "mask"] = "mask"
    unit: str = "1/working unit"
    kappa1: Column
    kappa2: Column
    share: Annotated[tuple[NotNegative, ...], Rule(filled=True)]
    spread: NotNegative = 0.0
    excluded: NotNegative = 0.0


# Types of the entries: those that are no fields of a `Fit` follow from its fields, for other programs, or hold arrays.
_HINTS = get_type_hints(Fit, include_extras=True) | {
    "format": str, "coefficients": Coefficients | None, "mass": Mass, "uncertainty": Deviations,
    "coefficients_physical": Coefficients | None, "epsilon_physical": Positive, "intervals": dict[str, Any] | None,
    "intervals_physical": dict[str, Any] | None, "posterior": _Posterior | None, "diagram": _Columns | None,
}  # fmt: skip
_File: Any = make_dataclass("_File", [(name, _HINTS[name]) for name in ENTRIES])


def _fit_of(file: Any) -> Fit:
    entries = {field.name: getattr(file, field.name) for field in fields(Fit) if field.name in ENTRIES}
    if file.posterior is not None:
        draws = _stack([getattr(file.posterior.draws, name) for name in COLUMNS], "draws", "posterior")
        draws[:, [1, 6]] = np.log(draws[:, [1, 6]])  # a02 and thickness, which a `Fit` keeps as logarithms
        entries |= {"draws": draws, "view": file.posterior.view}
    if (columns := file.diagram) is not None:
        rows = _stack([columns.kappa1, columns.kappa2, columns.share], "kappa1, kappa2 and share", "diagram")
        entries["diagram"] = Diagram(rows[:, :2], rows[:, 2], columns.unit, columns.spread, columns.excluded)
    fit = Fit(**entries)
    if (fit.chosen is None) != (fit.best is None):
        raise ValueError(f"expected a chosen law among the fit's candidates, got {fit.chosen!r}")
    return fit


def _stack(columns: list[tuple[float, ...]], names: str, entry: str) -> np.ndarray:
    if len({len(column) for column in columns}) > 1:
        lengths = ", ".join(str(len(column)) for column in columns)
        raise ValueError(f"expected {names} of one length in a fit's {entry}, got {lengths}")
    return np.stack(columns, 1, dtype=np.float64)
