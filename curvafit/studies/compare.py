"""Do two groups of scans differ, in which direction of curvature, and by how much?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, Literal

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import cdist
from scipy.stats import false_discovery_control

from curvafit.core.checks import check_choice, check_int, check_seed
from curvafit.core.permutation import (
    correct_by_most,
    correct_holm,
    correlate,
    measure_effect,
    measure_energy,
    relabel,
    share_beyond,
)
from curvafit.core.pictures import Pictured
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.units import format_number, format_percent, per_unit, power_name
from curvafit.drawing.plot import shared_limits
from curvafit.geometry.diagram import FAMILIES, Diagram
from curvafit.geometry.distances import sliced_embedding
from curvafit.scan.measure import QUANTITIES, SURE, Measures, find_quantity, interval_reach
from curvafit.scan.structure import check_options
from curvafit.studies.groups import Case, Group, list_cases
from curvafit.studies.scans import gather_notes, measure_scans, stack_numbers

#: Permutations of subjects that are tried: all where there are no more.
PERMUTATIONS = 9999
#: What p must not exceed for a difference that is shown.
LEVEL = 1 - SURE
#: The familiar numbers, without those of curvature.
FAMILIAR = ("BV/TV", "Tb.Th", "Tb.Th.SD", "Tb.Sp", "Tb.N", "Conn.D", "χ", "BS/BV", "BS/TV", "DA")
#: Bins along each axis of the difference of diagrams, and the width in bins of the Gaussian that smooths it.
BINS, SMOOTH = 48, 2.0
#: Bins with less than this part of the fullest one's area are not tested.
LEAST_SHARE = 0.02


@dataclass(frozen=True)
class Number:
    """How one quantity differs between the groups, in the scans' unit to `power`.

    Attributes
    ----------
    means, deviations
        Of the subjects of the first group and of the second.
    difference
        The second mean less the first.
    effect, low, high
        Hedges' g of that difference, and its 95 % interval.
    p
        Share of permutations that differ at least as much.
    family, holm, discovery
        p corrected for all quantities. The first two hold the chance of any false finding: by the most of |r| over all
        quantities in each permutation, and by Holm, whose p cannot be small with few subjects. The third, by Benjamini
        and Hochberg, holds the share of false findings.
    known
        The part of the variance within groups that the scans' own intervals explain.
    """

    name: str
    symbol: str
    power: int
    means: tuple[float, float]
    deviations: tuple[float, float]
    difference: float
    effect: float
    low: float
    high: float
    p: float
    family: float
    holm: float
    discovery: float
    known: float


@dataclass(frozen=True, repr=False, eq=False)
class Comparison(Pictured):
    """How two groups of scans differ.

    Attributes
    ----------
    groups
        Names of the first group and the second.
    measures, cases
        Of each scan, its measures in `unit`, and its name, subject and group.
    subjects
        Group and name of each subject.
    values, errors, halves
        Each subject's quantities (S, K), means over its scans; the standard errors that the scans' own intervals give
        them, and half the widths of their 95 % intervals, NaN where a scan has none.
    numbers
        A test of each quantity.
    energy, p
        Energy distance of the groups' curvature diagrams, in 1 / `unit`, and the share of permutations with at least as
        much.
    apart, within
        Sliced Wasserstein distance of the groups' mean diagrams, and the mean one of two subjects of a group.
    diagrams
        The mean diagram of each group, of total area 1.
    edges, difference, bins_p
        Edges (B + 1,) of bins in κ1 and κ2, the second mean diagram less the first over them (κ2, κ1) `(B, B)`, and the
        family-wise p of each bin, NaN where there is too little area to test.
    permutations, exact
        How many permutations of subjects were tried, and whether they are all.
    """

    groups: tuple[str, str]
    unit: str
    cases: tuple[Case, ...]
    measures: tuple[Measures, ...]
    subjects: tuple[tuple[str, str], ...]
    values: np.ndarray
    errors: np.ndarray
    halves: np.ndarray
    numbers: tuple[Number, ...]
    energy: float
    p: float
    apart: float
    within: float
    diagrams: tuple[Diagram, Diagram]
    edges: np.ndarray
    difference: np.ndarray
    bins_p: np.ndarray
    permutations: int
    exact: bool
    options: dict[str, Any]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        return f"Comparison({self.groups[0]!r}, {self.groups[1]!r}, p {self.p:.3g}, {len(self.cases)} scans)"

    def __getitem__(self, name: str) -> Number:
        """Return the test of a quantity by its name or symbol; raise KeyError where there is none."""
        return find_quantity(self.numbers, name)

    @property
    def counts(self) -> tuple[int, int]:
        """Return the number of subjects of each group."""
        a, b = (sum(group == name for group, _ in self.subjects) for name in self.groups)
        return a, b

    @property
    def level(self) -> float:
        """Return what a p must not exceed for a difference that is significant."""
        return LEVEL

    @property
    def significant(self) -> np.ndarray:
        """Return the bins (κ2, κ1) whose difference is significant among all, bool `(B, B)`."""
        return self.bins_p <= LEVEL

    @property
    def status(self) -> str:
        """Return the answer in a sentence or a few: whether, by how much, in which direction."""
        (a, b), unit = self.groups, per_unit(self.unit, 1)
        least = (1 + (self.counts[0] == self.counts[1])) / self.permutations
        most = max((self[name] for name in FAMILIAR), key=lambda each: abs(np.nan_to_num(each.effect)))
        lines = [f"So few subjects cannot give a p below {format_number(least, 2)}."] if least > LEVEL else []
        if self.primary:
            lines.append(f"{self.verdict}, named beforehand: {self._say(self.primary)}.")
        lines += [
            f"{self._judge(self.p, 'curvature diagrams')}: p = {format_number(self.p, 2)}.",
            f"Of the familiar numbers the one that differs most: {self._say(most)}, "
            f"{format_number(most.family, 2)} among all {len(self.numbers)} numbers.",
            f"In curvature the groups' mean diagrams lie {format_number(self.apart, 2)} {unit} apart, those of two "
            f"subjects of a group {format_number(self.within, 2)} {unit} on average (sliced Wasserstein distance).",
        ]
        shifts = sorted((self[f"share of {name}"].difference, name) for name in FAMILIES)
        (fall, loser), (rise, winner) = shifts[0], shifts[-1]
        if self.p <= LEVEL:
            lines.append(
                f"From {a} to {b} the share of {loser} falls by {format_percent(-fall)} "
                f"of the surface, and that of {winner} rises by {format_percent(rise)}."
            )
        return " ".join(lines)

    @property
    def primary(self) -> Number | None:
        """Return the number that was named beforehand, whose p alone counts; None where none was."""
        name = self.options.get("primary")
        return self[name] if name else None

    @property
    def verdict(self) -> str:
        """Return whether the groups differ, in a few words: in the number named beforehand, or in their diagrams."""
        if self.primary:
            return self._judge(self.primary.p, self.primary.name)
        return self._judge(self.p, "curvature diagrams")

    def _judge(self, p: float, what: str) -> str:
        return f"{' and '.join(self.groups)} {'differ' if p <= LEVEL else 'are not told apart'} by their {what}"

    def _say(self, number: Number) -> str:
        """Return a number with both means and its p as text."""
        means = " to ".join(format_number(mean) for mean in number.means)
        unit = power_name(self.unit, number.power)
        return f"{number.name} ({number.symbol}) goes from {means} {unit}".rstrip() + (
            f", p = {format_number(number.p, 2)} alone"
        )


def compare(
    group_a: Group | None = None,
    group_b: Group | None = None,
    *,
    subjects: str | PathLike[str] | None = None,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    periodic: bool = False,
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    laws: bool = False,
    primary: str | None = None,
    permutations: int = PERMUTATIONS,
    seed: int = 0,
    workers: int = 0,
    progress: Progress = silent,
    **reading: Any,
) -> Comparison:
    """Compare two groups of scans: curvature diagrams, and each quantity of `measure`, by permutation of subjects.

    Each scan is measured (`curvafit.measure`). Scans of a subject are averaged: the subject is what counts. The groups'
    diagrams are compared by the energy distance of the subjects' diagrams, each number by the difference of means, each
    bin of the diagram by its correlation with the group, all over the same choices of subjects for the second group.
    Raises ValueError where there are not two groups of at least two subjects, they share a scan or a subject, or only
    some scans have a physical unit; and as `measure`, with the scan's name.

    Parameters
    ----------
    group_a, group_b
        Folders of scans; or sequences of scans, paths or `Measures`; or such sequences by subject.
    subjects
        A CSV table: with two groups, of the columns scan and subject; alone, of scan, group and optionally subject.
        Paths are relative to the table. Without it each scan is a subject.
    kind, periodic, threshold, dark
        As in `measure`.
    laws
        Compare what each scan tells of its law, too: the six combinations of parameters, where its law can be read.
    primary
        The symbol or name of the one number that was chosen before the scans were seen: its p needs no correction.
    permutations
        Most permutations of subjects to try; where there are fewer, all are.
    seed
        Of the permutations, where not all are tried.
    workers
        Processes that measure (needs `curvafit[synth]`); 0 is this one.
    reading
        Options of reading files: see `curvafit.load`.
    """
    check_options(kind, threshold, reading.get("label"))
    check_int(permutations, "a number of permutations from 99", 99, 10**6)
    check_seed(seed)
    if primary is not None:
        names = {each for name, symbol, *_ in QUANTITIES for each in (name, symbol)}
        check_choice(primary, names, f"a primary number of {', '.join(symbol for _, symbol, *_ in QUANTITIES)}")
    cases, notes = list_cases(group_a, group_b, subjects)
    options = {"kind": kind, "periodic": periodic, "threshold": threshold, "dark": dark}
    measures, more = measure_scans(cases, options, reading, workers, sub_progress(progress, 0.0, 0.97), laws)
    progress("comparing", 0.97)
    parameters = {**options, **reading, "primary": primary, "permutations": permutations, "seed": seed}
    return compare_measures(measures, cases, parameters, [*notes, *more])


def compare_measures(
    measures: Sequence[Measures], cases: Sequence[Case], options: dict[str, Any], notes: Sequence[str] = ()
) -> Comparison:
    """Compare scans that are measured, in one unit, as `compare` does; `options` has `permutations` and `seed`."""
    groups = tuple(dict.fromkeys(case.group for case in cases))
    keys = [(case.group, case.subject) for case in cases]
    subjects = list(dict.fromkeys(keys))
    scans = [[k for k, key in enumerate(keys) if key == subject] for subject in subjects]
    second = np.array([group == groups[1] for group, _ in subjects])
    relabelled, exact = relabel(second, options["permutations"], options["seed"])
    pooled = [_pool([measures[k].diagram for k in own]) for own in scans]
    rows = np.stack([sliced_embedding(each) for each in pooled])
    away = cdist(rows, rows)
    energies = measure_energy(away, relabelled)
    means = tuple(
        _pool([each for each, there in zip(pooled, second, strict=True) if there == side]) for side in (False, True)
    )
    alike = (second[:, None] == second) & ~np.eye(len(second), dtype=bool)
    edges, difference, p = _compare_bins(pooled, second, relabelled)
    values, errors, halves = _average(measures, scans)
    return Comparison(
        groups=groups,  # type: ignore[arg-type]
        unit=measures[0].unit,
        cases=tuple(cases),
        measures=tuple(measures),
        subjects=tuple(subjects),
        values=values,
        errors=errors,
        halves=halves,
        numbers=_compare_numbers(measures[0], values, errors, second, relabelled),
        energy=float(energies[0]),
        p=float(share_beyond(energies)),
        apart=float(np.linalg.norm(np.subtract(*map(sliced_embedding, means)))),
        within=float(away[alike].mean()),
        diagrams=means,  # type: ignore[arg-type]
        edges=edges,
        difference=difference,
        bins_p=p,
        permutations=len(relabelled),
        exact=exact,
        options=options,
        notes=(*notes, *gather_notes(measures, cases)),
    )


def _pool(diagrams: Sequence[Diagram]) -> Diagram:
    """Return the mean of diagrams, each of total area 1."""
    points = np.concatenate([each.points for each in diagrams])
    weights = np.concatenate([each.normalised.weights / len(diagrams) for each in diagrams])
    return Diagram(points, weights, unit=diagrams[0].unit)


def _compare_bins(
    pooled: Sequence[Diagram], second: np.ndarray, choices: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `edges`, `difference` and `bins_p` of a `Comparison`."""
    edges = np.linspace(*shared_limits(pooled), BINS + 1)
    shares = np.stack(
        [
            gaussian_filter(np.histogram2d(*each.points.T[::-1], bins=(edges, edges), weights=each.weights)[0], SMOOTH)
            for each in pooled
        ]
    )
    mean = shares.mean(0)
    tested = (mean >= LEAST_SHARE * mean.max()) & (edges[1:, None] <= edges[None, 1:])
    p = np.full(mean.shape, np.nan)
    p[tested] = correct_by_most(shares[:, tested], choices)
    return edges, shares[second].mean(0) - shares[~second].mean(0), p


def _average(measures: Sequence[Measures], scans: Sequence[Sequence[int]]) -> tuple[np.ndarray, ...]:
    """Return `values`, `errors` and `halves` of a `Comparison`; `scans` are the numbers of each subject's."""
    values, halves = stack_numbers(measures)
    errors = halves / np.array([[interval_reach(scan.blocks)] for scan in measures])
    spread = (np.sqrt([(each[own] ** 2).mean(0) / len(own) for own in scans]) for each in (errors, halves))
    return np.stack([values[own].mean(0) for own in scans]), *spread


def _compare_numbers(
    scan: Measures, values: np.ndarray, errors: np.ndarray, second: np.ndarray, choices: np.ndarray
) -> tuple[Number, ...]:
    """Test each quantity of subjects' values (S, K); `scan` has the quantities' names."""
    told = np.asarray(np.isfinite(values).all(0))
    p, family, holm, discovery = np.full((4, len(told)), np.nan)
    p[told] = share_beyond(correlate(values[:, told], choices))
    holm[told], discovery[told] = correct_holm(p[told]), false_discovery_control(p[told])
    family[told] = correct_by_most(values[:, told], choices)
    rows = []
    for k, quantity in enumerate(scan.quantities):
        parts = values[~second, k], values[second, k]
        a, b = (float(part.mean()) for part in parts)
        effect = measure_effect(*parts) if told[k] else (math.nan, math.nan, math.nan)
        spread = sum(((part - part.mean()) ** 2).sum() for part in parts) / (len(second) - 2)
        rows.append(
            Number(
                quantity.name,
                quantity.symbol,
                quantity.power,
                (a, b),
                tuple(float(part.std(ddof=1)) for part in parts),  # type: ignore[arg-type]
                b - a,
                *effect,
                p=float(p[k]),
                family=float(family[k]),
                holm=float(holm[k]),
                discovery=float(discovery[k]),
                known=float((errors[:, k] ** 2).mean() / spread) if math.isfinite(effect[0]) else math.nan,
            )
        )
    return tuple(rows)
