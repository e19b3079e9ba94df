"""What an inference says of a scan, and the `fit.json` that carries its law to the generator and the prior."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np

from curvafit.core.files import write_content
from curvafit.core.runtime import Pictured
from curvafit.core.schema import decode, encode
from curvafit.core.units import METRES, unit_name
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.morphology import Morphometry
from curvafit.inference.atlas import Match
from curvafit.inference.candidates import Candidate, Misfit
from curvafit.inference.posterior import Combination
from curvafit.inference.table import COLUMNS, TARGETS, to_columns
from curvafit.priors.coefficients import POWERS, Coefficients
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.law import FORMAT, Law, Positive, parse_fit, read_fit

#: What a scan was taken for, in words.
KINDS = {"field": "a phase field", "mask": "a mask", "image": "an image"}
#: Levels of the intervals, in percent.
LEVELS = (50, 90)
#: The entries of a `fit.json`, in order: the fields of a `Fit`, and for other programs what follows from them.
ENTRIES = (
    "format", "status", "kind", "family", "coefficients", "mass", "uncertainty", "chosen", "scale", "working_voxel",
    "length_unit", "thickness", "coefficients_physical", "epsilon_physical", "intervals", "intervals_physical",
    "combinations", "misfit", "candidates", "matches", "morphometry", "notes", "provenance", "view", "draws", "diagram",
)  # fmt: skip


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
        The scan's curvature diagram, binned as an atlas's are, in 1 / working unit, with shares of the area: it locates
        the scan on an atlas's map. Of masks and images a working unit is 100 voxels of which the structure is eight
        thick.
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
    provenance: dict[str, Any]
    diagram: Diagram | None
    candidates: tuple[Candidate, ...]
    chosen: str | None
    draws: np.ndarray | None
    view: str
    combinations: tuple[Combination, ...]
    misfit: Misfit | None
    matches: tuple[Match, ...]

    def __post_init__(self) -> None:
        if (self.chosen is None) != (self.best is None):
            raise ValueError(f"expected a chosen law among the fit's candidates, got {self.chosen!r}")
        if self.draws is not None and self.draws.shape[1:] != (len(TARGETS),):
            raise ValueError(f"expected draws (n, {len(TARGETS)}), got {self.draws.shape}")

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
        return Law(
            self.best.coefficients, self.best.mass, "prior", working_voxel=self.working_voxel,
            length_unit=self.length_unit, epsilon=width, volume_fraction=self.morphometry.volume_fraction,
            status=self.status,
        )  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings, lists and dicts, as `fit.json` holds them."""
        intervals = {"intervals": self.intervals(), "intervals_physical": self.intervals(physical=True)}
        derived = {"format": FORMAT, **intervals}
        return {name: encode(derived[name] if name in derived else getattr(self, name)) for name in ENTRIES}

    def to_json(self) -> str:
        """Return the text of a `fit.json`, indented; raise ValueError where `from_json` would not take it."""
        content = self.as_dict()
        try:
            decode(Fit, content)
        except ValueError as fault:
            raise ValueError(f"expected {fault} in a fit") from None
        text = json.dumps(content, indent=2, allow_nan=False)
        # Lists of numbers, and of such lists, go on one line each, for people to read.
        return re.sub(r"\[\n[-+.\de,\s\[\]]+\]", lambda match: "".join(match[0].split()).replace(",", ", "), text)

    @classmethod
    def from_json(cls, text: str | bytes) -> Fit:
        """Return the fit that a `fit.json`'s text states; raise ValueError if it is not whole.

        Entries that follow from others, such as `coefficients`, are not read.
        """
        return parse_fit(text, "the text", cls)

    def save(self, path: str | PathLike[str]) -> Path:
        """Write a `fit.json`, whole or not at all, and return its path."""
        return write_content(Path(path), self.to_json())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Fit:
        """Read a `fit.json`; raise FileNotFoundError if there is none, ValueError as `from_json`."""
        return read_fit(path, cls)
