"""Combinations of parameters: the sums that a texture tells best come first, in words for what they do to shapes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy import linalg

from curvafit.core.schema import Rule
from curvafit.core.units import format_number
from curvafit.inference.table import LEAST, PARAMETERS, column_names

#: A combination is known where its draws have at most the other part of its variance among laws.
KNOWN = 0.5
#: What tells shapes apart, with the words for little and for much of it, and how many of them describe an end.
LOOKS = {
    "filled": ("sparse", "full"),
    "roundness": ("flat", "round"),
    "bend": ("hollow", "bulging"),
    "bodies": ("joined by tunnels", "in separate bodies"),
    "thickness": ("even in thickness", "uneven in thickness"),
    "gaps": ("even in spacing", "uneven in spacing"),
}
NAMED = 2
#: An end is described by no look whose correlation with the combination is less.
FAINT = 0.18


@dataclass(frozen=True)
class Combination:
    """A sum of parameters, in deviations among laws, and what a scan tells of it.

    Attributes
    ----------
    low, high
        What shapes look like at its ends, in words; empty where it hardly changes how they look.
    weights
        What is added for each parameter's distance from the laws' mean, by name (`table.PARAMETERS`).
    median, interval
        Median, and central 90 % interval, of the posterior's draws.
    known
        Part of its variance among laws that the scan takes away.
    """

    low: str
    high: str
    weights: dict[str, float]
    median: float
    interval: tuple[float, float]
    known: Annotated[float, Rule(least=0, most=1)]

    def __str__(self) -> str:
        low, high = (format_number(end, 2) for end in self.interval)
        value = format_number(self.median, 2) if self.known >= KNOWN else "not known"
        if not self.low:
            return f"A sum that hardly changes how shapes look: {value} ({low} to {high})."
        return f"From {self.low} (-2) to {self.high} (+2): {value} ({low} to {high})."


@dataclass(frozen=True, eq=False)
class Combinations:
    """Six sums of the parameters, uncorrelated among laws.

    `weights` `(6, 6)` has a row for each, `centre` `(6,)` the laws' mean; a sum's deviation among laws is 1. `ends` has
    the words for its low and its high end, empty where it hardly changes how shapes look.
    """

    weights: np.ndarray
    centre: np.ndarray
    ends: tuple[tuple[str, str], ...]

    def __call__(self, parameters: np.ndarray) -> np.ndarray:
        """Return the sums `(…, 6)` of parameters `(…, 6)`."""
        return (parameters - self.centre) @ self.weights.T

    def read(self, draws: np.ndarray, *, background: bool = False) -> tuple[Combination, ...]:
        """Return what draws `(n, 6)` tell of each, the best known first; of the background's shapes where that is what
        was described."""
        found, of = self(draws), " (the background)" if background else ""
        ranges = np.quantile(found, (0.05, 0.5, 0.95), axis=0).T
        read = [
            Combination(low and low + of, high and high + of, dict(zip(PARAMETERS, map(float, weights), strict=True)),
                        float(middle), (float(least), float(most)), float(np.clip(1 - column.var(), 0, 1)))
            for (low, high), weights, (least, middle, most), column in zip(
                self.ends, self.weights, ranges, found.T, strict=True)
        ]  # fmt: skip
        return tuple(sorted(read, key=lambda each: -each.known))


def find_combinations(errors: np.ndarray, parameters: np.ndarray, descriptors: np.ndarray) -> Combinations:
    """Return the combinations whose mean square error, against their variance among laws, is least, then next.

    `errors` `(N, 6)` are what a posterior's means miss of laws that it has not learnt, `parameters` `(N, 6)` theirs,
    and `descriptors` `(N, 351)` those of their shapes.
    """
    centre = parameters.mean(0)
    away = parameters - centre
    weights = linalg.eigh(errors.T @ errors / len(errors), away.T @ away / len(away))[1].T
    scores, looks = away @ weights.T, np.array(list(LOOKS.values()), dtype=object)
    looked = _look(descriptors)
    alike = scores.T @ ((looked - looked.mean(0)) / np.maximum(looked.std(0), 1e-9)) / len(scores)
    signs = np.sign(np.take_along_axis(alike, np.abs(alike).argmax(1)[:, None], 1))
    ends = []
    for row in signs * alike:
        chosen = [k for k in np.argsort(-np.abs(row))[:NAMED] if np.abs(row[k]) >= FAINT]
        ends.append(tuple(", ".join(looks[k, int((row[k] > 0) == high)] for k in chosen) for high in (False, True)))
    return Combinations(signs * weights, centre, tuple(ends))


def _look(descriptors: np.ndarray) -> np.ndarray:
    """Return the numbers `(N, 6)` of `LOOKS` of descriptors `(N, 351)`."""
    names = np.array(column_names())
    fraction, (area, bend, euler), depths, gaps = (
        np.maximum(descriptors[:, names == name].T, LEAST if name != "densities" else -np.inf)
        for name in ("fraction", "densities", "depths", "clearances")
    )

    def spread(lengths: np.ndarray) -> np.ndarray:
        return np.log(lengths[8] / lengths[5])

    area = np.maximum(area, LEAST)
    return np.column_stack([
        np.log(fraction[0]), np.log(area / fraction[0]), np.arcsinh(bend / area / 10), np.arcsinh(euler / area),
        spread(depths), spread(gaps),
    ])  # fmt: skip
