"""Do groups of scans, or of bodies, differ, or change with a number such as dose: in which curvature, by how much?"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy import special
from scipy.spatial.distance import cdist
from scipy.stats import rankdata

from curvafit.core import permutation
from curvafit.core.checks import check_choice, check_int, check_seed
from curvafit.core.runtime import Pictured, Progress, silent, sub_progress
from curvafit.core.units import format_number, format_percent, power_name
from curvafit.drawing.plot import SIGNED, bin_diagram, shared_limits
from curvafit.geometry.diagrams import FAMILIES, Diagram, join_diagrams
from curvafit.geometry.distances import sliced_embedding
from curvafit.scan.instances import OF_BODIES
from curvafit.scan.measures import QUANTITIES, SURE, Measures, find_quantity, interval_reach
from curvafit.scan.structure import check_options
from curvafit.studies.scans import Case, Group, describe_groups, gather_notes, is_body, list_cases, measure_scans

#: Most arrangements of the labels that are tried; all are, where there are no more.
PERMUTATIONS = 9999
#: Greatest p of a difference that is significant.
LEVEL = 1 - SURE
#: The familiar numbers, without those of curvature.
FAMILIAR = ("BV/TV", "Tb.Th", "Tb.Th.SD", "Tb.Sp", "Tb.N", "Conn.D", "χ", "BS/BV", "BS/TV", "DA", "V", "S", "Ψ", "E")
#: What tells that the border cuts a body, which is no number of the body itself.
CUT = "S.cut"
#: Fewest bodies of a subject whose median has an error.
FEWEST_BODIES = 5
#: Most numbers that differ and are named in the answer.
NAMED = 3
#: Bins along each axis of the difference of diagrams, and the width in bins of the Gaussian that smooths it.
BINS, SMOOTH = 48, 2.0


@dataclass(frozen=True)
class Number:
    """How one quantity depends on the labels, in the scans' unit to `power`; NaN, and no means, where there is none.

    Attributes
    ----------
    means, deviations
        Of the subjects of each group.
    difference
        Of two groups, the second mean less the first; by a number, the slope over it, within subjects if paired.
    effect, low, high
        Effect size with a 95 % interval: of two groups Hedges' g, of the differences if paired; by a number, the
        correlation r with its rank. Of more groups the correlation ratio η, without an interval.
    p
        Share of arrangements of the labels with at least that effect.
    family
        p corrected for all quantities, which controls the chance of any false finding: by the greatest effect of all
        quantities in each arrangement.
    known
        The fraction of the variance left by the labels that the scans' own intervals explain.
    """

    name: str
    symbol: str
    power: int
    means: tuple[float, ...]
    deviations: tuple[float, ...]
    difference: float
    effect: float
    low: float
    high: float
    p: float
    family: float
    known: float


@dataclass(frozen=True, repr=False, eq=False)
class Comparison(Pictured):
    """How groups of scans differ, or what changes with a number.

    A *subject* here is a subject in one group, or at one number.

    Attributes
    ----------
    by, groups
        What subjects are compared by, and the names of the groups; none where it is a number.
    measures, cases
        The scans' measures in `unit`, or those of each body; and their names, subjects and labels.
    subjects, labels, blocks
        Label and name of each subject; the index of its group, or its number, (S,); and the index of its name, (S,),
        where subjects are paired, else None.
    values, halves
        Each subject's quantities (S, K), means over its scans, or medians over its bodies; and the halves of their 95 %
        intervals, which follow from the scans' own intervals, or the spread of the bodies; NaN where there are none.
    numbers
        A test of each quantity.
    statistic, p, least
        Energy distance of the groups' curvature diagrams, in 1 / `unit`, or the diagrams' distance correlation with the
        number's rank; the share of arrangements with at least as much, and the least possible share. Of bodies the
        first two are NaN, and there are no `diagrams` and `differences`.
    sides, diagrams
        The index (S,) of each subject's part: its group, or the lower or upper half of the numbers; and the mean
        diagram of each part, of total area 1.
    edges, differences
        Edges (B + 1,) of bins in κ1 and κ2; and over them (κ2, κ1) the second group's mean diagram less the first's, or
        each group's less that of all, or the slope from the least number to the greatest, `(M, B, B)`.
    permutations, exact
        How many arrangements were tried, and whether they are all.
    """

    by: str
    groups: tuple[str, ...]
    unit: str
    cases: tuple[Case, ...]
    measures: tuple[Measures, ...]
    subjects: tuple[tuple[str | float, str], ...]
    labels: np.ndarray
    blocks: np.ndarray | None
    values: np.ndarray
    halves: np.ndarray
    numbers: tuple[Number, ...]
    statistic: float
    p: float
    least: float
    sides: np.ndarray
    diagrams: tuple[Diagram, ...]
    edges: np.ndarray
    differences: np.ndarray
    permutations: int
    exact: bool
    options: dict[str, Any]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        groups = ", ".join(map(repr, self.groups)) or f"by {self.by!r}"
        return f"Comparison({groups}, p {self.p:.3g}, {len(self.cases)} {'bodies' if self.of_bodies else 'scans'})"

    def __getitem__(self, name: str) -> Number:
        """Return the test of a quantity by its name or symbol; raise KeyError where there is none."""
        return find_quantity(self.numbers, name)

    @property
    def of_bodies(self) -> bool:
        """Return whether bodies of label images are compared, not scans."""
        return is_body(self.measures[0])

    @property
    def owners(self) -> np.ndarray:
        """Return the index of the subject of each scan or body."""
        index = {subject: k for k, subject in enumerate(self.subjects)}
        return np.array([index[case.label, case.subject] for case in self.cases])

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the names of the parts of the subjects: the groups, or the halves of the numbers."""
        low, high = self.labels[self.sides == 0].max(), self.labels[self.sides == 1].min()
        return self.groups or (f"{self.by} up to {low:g}", f"{self.by} from {high:g}")

    @property
    def counts(self) -> tuple[int, ...]:
        """Return the number of subjects of each part."""
        return tuple(np.bincount(self.sides).tolist())

    @property
    def effect(self) -> str:
        """Return the name of the numbers' effect: g, η or r."""
        return "r" if not self.groups else "g" if len(self.groups) == 2 else "η"

    @property
    def found(self) -> tuple[Number, ...]:
        """Return the numbers that differ by their family-wise p: familiar ones first, then the largest effects."""
        differing = [number for number in self.numbers if number.family <= LEVEL]
        return tuple(sorted(differing, key=lambda number: (number.symbol not in FAMILIAR, -abs(number.effect))))

    @property
    def status(self) -> str:
        """Return the answer in a few sentences, which name what the tests support and no more."""
        few = f"So few subjects cannot give a p below {format_number(self.least, 2)}: nothing can be shown to differ."
        lines = [few] if self.least > LEVEL else []
        if self.primary:
            lines.append(f"{self.verdict}, named beforehand: {self._describe(self.primary, alone=True)}.")
        found, count, level = self.found, self.count, f"family-wise p at most {LEVEL:.2g}"
        if found:
            rest = f"; and {len(found) - NAMED} more" if len(found) > NAMED else ""
            described, s = "; ".join(map(self._describe, found[:NAMED])), "s" * (len(found) == 1)
            lines.append(f"Of {count} numbers {len(found)} differ{s}, {level}: {described}{rest}.")
        else:
            familiar = (number for number in self.numbers if number.symbol in FAMILIAR)
            strongest = max(familiar, key=lambda number: abs(np.nan_to_num(number.effect)))
            lines.append(
                f"None of {count} numbers is seen to differ ({level}). Of the familiar ones the effect on "
                f"{self._describe(strongest)} is the largest."
            )
        if self.of_bodies:
            return " ".join(lines)
        verdict, p = "differ" if self.p <= LEVEL else "are not told apart", format_number(self.p, 2)
        name, power = ("energy distance", -1) if self.groups else ("distance correlation", 0)
        strength = f"{name} {format_number(self.statistic, 2)} {power_name(self.unit, power)}".rstrip()
        lines.append(f"Curvature diagrams {verdict}: p = {p}, {strength}.")
        return " ".join(lines)

    @property
    def count(self) -> int:
        """Return how many numbers are tested: those that are known of every subject."""
        return sum(math.isfinite(number.p) for number in self.numbers)

    @property
    def primary(self) -> Number | None:
        """Return the number that was named beforehand, whose p alone counts; None where none was."""
        name = self.options.get("primary")
        return self[name] if name else None

    @property
    def verdict(self) -> str:
        """Return whether subjects differ, in a few words: in the number named beforehand, or else in up to two numbers,
        or in their diagrams."""
        differ, alike = ("differ", "are not told apart") if self.groups else ("differ", "are not seen to differ")
        who = join_names(self.groups) if self.groups else f"With {self.by} subjects"
        if self.primary:
            return f"{who} {differ if self.primary.p <= LEVEL else alike} by their {self.primary.name}"
        if self.found:
            return f"{who} {differ}: {', '.join(map(self._summarise, self.found[:2]))}"
        by = f"the numbers of their {len(self.cases)} bodies" if self.of_bodies else "their curvature diagrams"
        return f"{who} {differ if self.p <= LEVEL else alike} by {by}"

    def _summarise(self, number: Number) -> str:
        """Return a number's symbol, and its change in per cent where it cannot be negative."""
        symbol = number.symbol if number.symbol not in FAMILIES else number.name
        return f"{symbol} {self._change(number)}".rstrip()

    def _change(self, number: Number) -> str:
        if len(number.means) != 2 or number.symbol in SIGNED:
            return ""
        sign = "+" if number.difference > 0 else ""
        return f"{sign}{format_percent(number.difference / number.means[0])}"

    def _describe(self, number: Number, alone: bool = False) -> str:
        """Return a number with its means or its slope, its effect and a p, family-wise or `alone`, as text."""
        unit = power_name(self.unit, number.power)
        symbol = [number.symbol] if number.symbol not in FAMILIES else []
        if self.groups:
            change = f"from {' to '.join(map(format_number, number.means))} {unit}".rstrip()
        else:
            change = f"{format_number(number.difference)} {unit}".rstrip() + f" a unit of {self.by}"
        p = f"p = {format_number(number.p, 2)}" if alone else f"family-wise p = {format_number(number.family, 2)}"
        facts = ", ".join([*symbol, change, f"{self.effect} = {format_number(number.effect, 2)}", p])
        return " ".join(filter(None, (number.name, self._change(number), f"({facts})")))


def join_names(names: Sequence[str]) -> str:
    """Return names as text: a, b and c."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def compare(
    *groups: Group,
    by: str | Sequence[Any] | None = None,
    paired: bool = False,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    periodic: bool = False,
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    primary: str | None = None,
    permutations: int = PERMUTATIONS,
    seed: int = 0,
    workers: int = 0,
    progress: Progress = silent,
    **reading: Any,
) -> Comparison:
    """Compare scans by group or by a number: curvature diagrams, and each quantity of `measure`, by permutation.

    Each scan is measured (`curvafit.measure`). Scans of a subject are averaged: the subject is what counts. Diagrams of
    groups are compared by the energy distance of the subjects' diagrams, by a number by their distance correlation with
    its rank; each quantity by its correlation with the labels: all over the same arrangements of the labels. Of bodies
    (`curvafit.measure_instances`, or its tables) the subject's value is the median over them, and there is no diagram.
    Raises ValueError where labels cannot be exchanged (fewer than two groups of two subjects, fewer than three numbers,
    a subject with several labels that is not `paired`, or with one that is), a scan is listed twice, bodies come with
    scans or without subjects, or only some have a physical unit; and as `measure`, with the scan's name.

    Parameters
    ----------
    groups
        Two or more: folders of scans; or sequences of scans, paths or `Measures`; or such sequences by subject. Or one
        CSV table of the columns scan, group and optionally subject and roi, the scan's region, with paths relative to
        it. Or one sequence, with `by`. A scan may be a table that `curvafit measure --labels` wrote, or what
        `measure_instances` returns; such a table may be a group, or all, with columns that `--subjects` gave it.
    by
        The table's column to compare by; or a label for each scan of one sequence. Where all are numbers, such as times
        or doses, what goes with the number is tested; else they name groups.
    paired
        Compare within subjects, each of which is in every group, or at several numbers. A subject has one name in the
        column subject of a table, one file name in folders, and one position in sequences.
    kind, periodic, threshold, dark
        As in `measure`.
    primary
        The symbol or name of the one number that was chosen before the scans were seen: its p needs no correction.
    permutations
        Most arrangements of the labels to try; where there are fewer, all are.
    seed
        Of the arrangements, where not all are tried.
    workers
        Processes that measure (needs `curvafit[synth]`); 0 is this one.
    reading
        Options of reading files: see `curvafit.load`.
    """
    check_options(kind, threshold, reading.get("label"))
    check_int(permutations, "a number of permutations from 99", 99, 10**6)
    check_seed(seed)
    cases, notes = list_cases(groups, by, paired)
    of_bodies = is_body(cases[0].source)
    if primary is not None:
        known = [formula[:2] for formula in (OF_BODIES if of_bodies else QUANTITIES) if formula[1] != CUT]
        check_choice(primary, set(sum(known, ())), f"a primary number of {', '.join(symbol for _, symbol in known)}")
    options = {"kind": kind, "periodic": periodic, "threshold": threshold, "dark": dark}
    stated = kind != "auto" or periodic or threshold != "otsu" or dark
    if of_bodies and (stated or any(value is not None and value is not False for value in reading.values())):
        raise ValueError("bodies of a table are measured: leave out options of scans such as --spacing, --unit, --kind")
    measures, measure_notes = measure_scans(cases, options, reading, workers, sub_progress(progress, 0.0, 0.97))
    progress("comparing", 0.97)
    if of_bodies:
        measures, body_notes = _describe_bodies(measures)
        measure_notes += body_notes
    name = by if isinstance(by, str) else "group" if isinstance(cases[0].label, str) else "the number"
    parameters = {**options, **reading, "by": name, "paired": paired, "primary": primary}
    parameters |= {"permutations": permutations, "seed": seed}
    return _compare_measures(measures, cases, parameters, [*notes, *measure_notes])


def _compare_measures(
    measures: Sequence[Measures], cases: Sequence[Case], options: dict[str, Any], notes: Sequence[str]
) -> Comparison:
    """Test measures of scans by the labels of their subjects, and describe how far apart the groups or halves are."""
    subject_of_scan = [(case.label, case.subject) for case in cases]
    subjects = list(dict.fromkeys(subject_of_scan))
    index = {subject: k for k, subject in enumerate(subjects)}
    positions = np.array([index[subject] for subject in subject_of_scan])
    scans = [np.flatnonzero(positions == k).tolist() for k in range(len(subjects))]
    groups = tuple(dict.fromkeys(label for label, _ in subjects if isinstance(label, str)))
    labels = np.array([groups.index(label) if isinstance(label, str) else label for label, _ in subjects])
    blocks = np.unique([name for _, name in subjects], return_inverse=True)[1] if options["paired"] else None
    # A quantity may depend on a number in a straight line or level off: ranks detect both.
    scores = labels if groups else rankdata(labels)
    arrangements, exact = permutation.relabel(scores, options["permutations"], options["seed"], blocks)
    sides = labels if groups else _halve(labels)
    if is_body(measures[0]):
        of_diagrams = {"statistic": math.nan, "p": math.nan, "diagrams": (), "edges": np.zeros(0)}
        of_diagrams["differences"] = np.zeros((0, 0, 0))
        values, errors, halves = _take_medians(measures, scans)
    else:
        diagrams = [_pool([measures[k].diagram for k in own]) for own in scans]
        of_diagrams = _compare_diagrams(diagrams, labels, sides, arrangements, blocks)
        values, errors, halves = _average(measures, scans)
    notes = [*notes, *_note_unknown(measures[0], values, subjects, options["primary"])]
    # The least possible p is that of a quantity equal to the labels.
    least_p = permutation.share_beyond(permutation.correlate(scores[:, None], arrangements, blocks))[0]
    return Comparison(
        by=options["by"], groups=groups, unit=measures[0].unit, cases=tuple(cases), measures=tuple(measures),
        subjects=tuple(subjects), labels=labels, blocks=blocks, values=values, halves=halves,
        numbers=_compare_numbers(measures[0], values, errors, labels, arrangements, blocks),
        least=float(least_p), sides=sides, permutations=len(arrangements), exact=exact, options=options,
        notes=(*describe_groups(measures, cases), *notes, *gather_notes(measures, cases)), **of_diagrams,
    )  # fmt: skip


def _halve(numbers: np.ndarray) -> np.ndarray:
    """Return which numbers are in the upper half, 0 or 1; neither half is empty."""
    median = np.median(numbers)
    return (numbers > median if median < numbers.max() else numbers >= median).astype(int)


def _compare_diagrams(
    diagrams: Sequence[Diagram], labels: np.ndarray, sides: np.ndarray, arrangements: np.ndarray,
    blocks: np.ndarray | None,
) -> dict[str, Any]:  # fmt: skip
    """Test diagrams of subjects; return `statistic`, `p`, `diagrams`, `edges` and `differences` of a `Comparison`."""
    by_number = np.issubdtype(labels.dtype, np.floating)
    test = permutation.measure_dependence if by_number else permutation.measure_energy
    embeddings = np.stack([sliced_embedding(diagram) for diagram in diagrams])
    statistics = test(cdist(embeddings, embeddings), arrangements, blocks)
    of_side = ([d for d, own in zip(diagrams, sides, strict=True) if own == side] for side in np.unique(sides))
    edges = np.linspace(*shared_limits(diagrams), BINS + 1)
    shares = np.stack([bin_diagram(diagram, edges, SMOOTH) for diagram in diagrams])
    if by_number:  # the change along a line fitted from the lowest label to the highest
        x = permutation.center(labels, blocks)
        differences = np.ptp(labels) * np.tensordot(x, shares, 1)[None] / (x @ x)
    else:
        means = np.stack([shares[labels == group].mean(0) for group in np.unique(labels)])
        differences = means[1:] - means[:1] if len(means) == 2 else means - shares.mean(0)
    tested = {"statistic": float(statistics[0]), "p": float(permutation.share_beyond(statistics))}
    return tested | {"diagrams": tuple(map(_pool, of_side)), "edges": edges, "differences": differences}


def _note_unknown(
    scan: Measures, values: np.ndarray, subjects: Sequence[tuple[str | float, str]], primary: str | None
) -> list[str]:
    """Return notes on the numbers (S, K) that are not known of every subject; ValueError if the primary is one."""
    notes, missing = [], ~np.isfinite(values.T)
    for absent in np.unique(missing[missing.any(1)], axis=0):
        numbers = [each for each, own in zip(scan.quantities, missing, strict=True) if (own == absent).all()]
        who = ", ".join(name for (_, name), lacks in zip(subjects, absent, strict=True) if lacks)
        if primary in [name for each in numbers for name in (each.name, each.symbol)]:
            raise ValueError(f"the primary number {primary} is not known of {who}: leave that out, or name another")
        notes.append(f"Not tested, as not known of {who}: {', '.join(each.symbol for each in numbers)}.")
    return notes


def _pool(diagrams: Sequence[Diagram]) -> Diagram:
    """Return the mean of diagrams, each scaled to total area 1."""
    return join_diagrams([replace(diagram, weights=diagram.normalised.weights / len(diagrams)) for diagram in diagrams])


def _describe_bodies(bodies: Sequence[Measures]) -> tuple[list[Measures], list[str]]:
    """Return bodies without the area that the border cuts, and notes on how many it cuts and how many are thin."""
    count, notes = len(bodies), []
    if cut := sum(body[CUT].value > 0 for body in bodies):
        notes.append(f"The border cuts {cut} of {count} bodies: what lies inside counts, but for sphericity.")
    if thin := sum(math.isnan(body["H"].value) for body in bodies):
        notes.append(f"Curvature is not known of {thin} of {count} bodies, which are too thin for it.")
    kept = [tuple(quantity for quantity in body.quantities if quantity.symbol != CUT) for body in bodies]
    return [replace(body, quantities=own) for body, own in zip(bodies, kept, strict=True)], notes


def _take_medians(bodies: Sequence[Measures], of_subjects: Sequence[Sequence[int]]) -> tuple[np.ndarray, ...]:
    """Return what `_average` does of bodies: medians of subjects, of bodies whose value is known, and their errors.

    The error is that of Maritz & Jarrett (1978), the deviation of the medians of resampled bodies; it takes a subject's
    bodies for independent.
    """
    values = np.array([[quantity.value for quantity in body.quantities] for body in bodies])
    medians, errors = np.full((2, len(of_subjects), values.shape[1]), np.nan)
    for (k, own), column in itertools.product(enumerate(of_subjects), range(values.shape[1])):
        known = np.sort(values[own, column])
        known = known[np.isfinite(known)]
        if len(known):
            medians[k, column] = np.median(known)
        if len(known) >= FEWEST_BODIES:
            half = (len(known) + 1) / 2
            weights = np.diff(special.betainc(half, half, np.linspace(0, 1, len(known) + 1)))
            errors[k, column] = math.sqrt(weights @ (known - weights @ known) ** 2)
    return medians, errors, float(special.ndtri((1 + SURE) / 2)) * errors


def _average(measures: Sequence[Measures], scans: Sequence[Sequence[int]]) -> tuple[np.ndarray, ...]:
    """Return `values` of a `Comparison`, their standard errors, and its `halves`; `scans` are the indices of each
    subject's scans."""
    values = np.array([[quantity.value for quantity in scan.quantities] for scan in measures])
    halves = np.array([[quantity.half for quantity in scan.quantities] for scan in measures])
    errors = halves / np.array([[interval_reach(scan.blocks)] for scan in measures])
    # Errors of a mean of n independent scans add up in squares, over n².
    of_means = (np.sqrt([(widths[own] ** 2).mean(0) / len(own) for own in scans]) for widths in (errors, halves))
    return np.stack([values[own].mean(0) for own in scans]), *of_means


def _compare_numbers(
    scan: Measures, values: np.ndarray, errors: np.ndarray, labels: np.ndarray, arrangements: np.ndarray,
    blocks: np.ndarray | None,
) -> tuple[Number, ...]:  # fmt: skip
    """Test each quantity of subjects' values (S, K); `scan` has the quantities' names, and the first of the
    `arrangements` is that of the labels as they are."""
    finite = np.asarray(np.isfinite(values).all(0))
    p, family = np.full((2, len(finite)), np.nan)
    p[finite] = permutation.share_beyond(permutation.correlate(values[:, finite], arrangements, blocks))
    family[finite] = permutation.correct_by_most(values[:, finite], arrangements, blocks)
    numbers, p_values = [], np.stack([p, family], axis=1).tolist()
    for quantity, column, error, tests in zip(scan.quantities, values.T, errors.T, p_values, strict=True):
        means, deviations, difference, effect, variance = _measure_change(column, labels, arrangements[0], blocks)
        error_share = float((error**2).mean() / variance) if variance > 0 else math.nan
        names = quantity.name, quantity.symbol, quantity.power
        numbers.append(Number(*names, means, deviations, difference, *effect, *tests, error_share))  # type: ignore[call-arg]
    return tuple(numbers)


def _measure_change(
    values: np.ndarray, labels: np.ndarray, ranks: np.ndarray, blocks: np.ndarray | None
) -> tuple[tuple[float, ...], tuple[float, ...], float, tuple[float, float, float], float]:
    """Return the means, deviations, difference and effect of a `Number`, and the variance that the labels leave."""
    if np.issubdtype(labels.dtype, np.floating):
        samples = []
        difference, _ = permutation.measure_slope(values, labels, blocks)
        _, effect = permutation.measure_slope(values, ranks, blocks)
        correlation = effect[0]
    else:
        # Pairs have the same position in both samples.
        order = np.arange(len(labels)) if blocks is None else np.argsort(blocks, kind="stable")
        samples = [values[order][labels[order] == group] for group in np.unique(labels)]
        two_groups = len(samples) == 2
        correlation = float(permutation.correlate(values[:, None], labels[None], blocks)[0, 0])
        difference = float(samples[1].mean() - samples[0].mean()) if two_groups else math.nan
        effect = (
            permutation.measure_effect(*samples, paired=blocks is not None)
            if two_groups
            else (correlation, math.nan, math.nan)
        )
    squares = float((permutation.center(values, blocks) ** 2).sum())
    # Degrees of freedom: subjects, less the mean of each block, less the slope or the differences between groups.
    freedom = len(labels) - (1 if blocks is None else len(np.unique(blocks))) - max(len(samples) - 1, 1)
    effect = effect if squares > 0 else (math.nan, math.nan, math.nan)
    variance_left = squares * (1 - correlation**2) / freedom if freedom > 0 and math.isfinite(effect[0]) else math.nan
    means = tuple(float(sample.mean()) for sample in samples)
    return means, tuple(float(sample.std(ddof=1)) for sample in samples), difference, effect, variance_left
