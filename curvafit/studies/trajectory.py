"""What does a series of scans of one thing do over time? Its numbers with bands, its curvature diagram, its trends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.distance import cdist

from curvafit.core.checks import as_tuple, check_float, check_int, check_seed, check_type, quoted
from curvafit.core.permutation import TIE, correct_by_most, correlate, reorder, share_beyond
from curvafit.core.pictures import Pictured
from curvafit.core.runtime import Progress, silent, sub_progress
from curvafit.core.units import format_number, per_unit, power_name
from curvafit.geometry.distances import sliced_embedding
from curvafit.scan.measure import Measures, find_quantity
from curvafit.scan.structure import check_options
from curvafit.studies.compare import LEVEL, PERMUTATIONS
from curvafit.studies.groups import list_series
from curvafit.studies.scans import gather_notes, measure_scans, stack_numbers
from curvafit.volumes.read import Source

#: The fewest scans whose order is tested, and the fewest whose p can be as small as `LEVEL`.
FEWEST, ENOUGH = 4, 5
#: Numbers that the status names.
NAMED = 3


@dataclass(frozen=True)
class Change:
    """How one quantity changes over a series, in the scans' unit to `power`.

    Attributes
    ----------
    difference, half
        The last scan's number less the first's, and half the width of its 95 % interval: the root of the summed squares
        of the two scans' own.
    correlation
        With the scan's place in the series; NaN, as p is, of fewer than four scans.
    p, family
        Share of the scans' orders with at least that correlation or its negative; and the same corrected for all
        quantities, by the most of |correlation| over them in each order.
    """

    name: str
    symbol: str
    power: int
    difference: float
    half: float
    correlation: float
    p: float
    family: float

    @property
    def significant(self) -> bool:
        """Return whether the interval of the difference is without 0."""
        return abs(self.difference) > self.half

    @property
    def moves(self) -> bool:
        """Return whether the quantity moves with time, among all quantities."""
        return self.family <= LEVEL


@dataclass(frozen=True, repr=False, eq=False)
class Trajectory(Pictured):
    """What a series of N scans of one thing does over time.

    Attributes
    ----------
    times, unit_of_time
        Of the scans, in order.
    measures
        Of each scan, in `unit`.
    changes
        Of each quantity, from the first scan to the last.
    embeddings, distances
        The diagrams' sliced quantiles (N, 288), in 1 / `unit`, and their sliced Wasserstein distances (N,) from the
        first.
    p
        Share of orders in which the distance of two diagrams goes at least as much with how far apart they are in the
        series (Mantel 1967); NaN of fewer than four scans.
    permutations, exact
        How many orders of the scans were tried, and whether they are all.
    """

    unit: str
    times: tuple[float, ...]
    unit_of_time: str
    measures: tuple[Measures, ...]
    changes: tuple[Change, ...]
    embeddings: np.ndarray
    distances: np.ndarray
    p: float
    permutations: int
    exact: bool
    options: dict[str, Any]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        return f"Trajectory({len(self.times)} scans, {' to '.join(self.ends)})"

    def __getitem__(self, name: str) -> Change:
        """Return the change of a quantity by its name or symbol; raise KeyError where there is none."""
        return find_quantity(self.changes, name)

    @property
    def ends(self) -> tuple[str, str]:
        """Return the first time and the last as text."""
        first, last = (f"{time:g} {self.unit_of_time}".rstrip() for time in self.times[:: len(self.times) - 1])
        return first, last

    def table(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return a quantity over time, and half the widths of its 95 % intervals, both (N,)."""
        rows = [each[name] for each in self.measures]
        return np.array([each.value for each in rows]), np.array([each.half for each in rows])

    @property
    def status(self) -> str:
        """Return what happens in a few sentences: which numbers change, how far the diagram goes, what moves."""
        changed = sorted(
            (each for each in self.changes if each.significant), key=lambda each: each.half / abs(each.difference)
        )
        count, unit = len(self.changes), per_unit(self.unit, 1)
        some = ", ".join(f"{each.name} {say_change(each, self.unit)}" for each in changed[:NAMED])
        told = f"{len(changed)} of {count} numbers change by more than their intervals"
        if all(math.isnan(each.half) for each in self.changes):
            told = "the numbers have no intervals: scans need eight blocks of a period (thickness and spacing)"
        lines = [
            f"From {' to '.join(self.ends)}, {told}" + (f", most clearly {some}." if changed else "."),
            f"The curvature diagram goes {format_number(self.distances[-1], 2)} {unit} from the first.",
        ]
        if math.isnan(self.p):
            return " ".join([*lines, f"Whether anything moves with time needs {ENOUGH} scans."])
        p = format_number(self.p, 2)
        if self.limit:
            return " ".join([*lines, self.limit, f"The diagram has p = {p}."])
        word = "moves" if self.p <= LEVEL else "is not seen to move"
        moving = ", ".join(each.symbol for each in self.changes if each.moves) or "none"
        return " ".join([*lines, f"It {word} with time (p = {p}); numbers that do: {moving}."])

    @property
    def limit(self) -> str:
        """Return why nothing can be said to move, as a sentence; empty where it can."""
        least = 2 / self.permutations
        if math.isnan(self.p) or least <= LEVEL:
            return ""
        steady = ", ".join(each.symbol for each in self.changes if each.p <= least * (1 + TIE))
        return (
            f"So few scans cannot give a p below {format_number(least, 2)}, so nothing can be said to move with time, "
            f"which needs {ENOUGH}; numbers that have this p: {steady or 'none'}."
        )


def say_change(change: Change, unit: str = "") -> str:
    """Return a change with its interval as text, and with its unit where the scans' is given."""
    name = power_name(unit, change.power) if unit else ""
    sign = "+" if change.difference > 0 else ""
    return f"{sign}{format_number(change.difference)} ± {format_number(change.half, 2)} {name}".rstrip()


def trajectory(
    scans: Sequence[Source | Measures],
    times: Sequence[float] | None = None,
    *,
    unit_of_time: str = "",
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    periodic: bool = False,
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    laws: bool = False,
    permutations: int = PERMUTATIONS,
    seed: int = 0,
    workers: int = 0,
    progress: Progress = silent,
    **reading: Any,
) -> Trajectory:
    """Follow one thing through scans at several times: each number of `measure` with its interval, and the diagram.

    Of four scans or more, each number's correlation with the scan's place is tested over orders of the scans. Raises
    ValueError where there are fewer than two scans, times do not increase, or only some scans have a physical unit; and
    as `measure`, with the scan's name.

    Parameters
    ----------
    scans
        Paths, fields, arrays or `Measures`, from the first to the last.
    times, unit_of_time
        When each scan was made, by default 0, 1, 2 …; and the unit's name, any text.
    kind, periodic, threshold, dark
        As in `measure`.
    laws
        Follow what each scan tells of its law, too: the six combinations of parameters, where its law can be read.
    permutations
        Most orders of the scans to try; where there are fewer, all are.
    seed
        Of the orders, where not all are tried.
    workers
        Processes that measure (needs `curvafit[synth]`); 0 is this one.
    reading
        Options of reading files: see `curvafit.load`.
    """
    check_options(kind, threshold, reading.get("label"))
    check_int(permutations, "a number of permutations from 99", 99, 10**6)
    check_seed(seed)
    check_type(unit_of_time, str, "a unit of time as text")
    cases = list_series(scans)
    moments = check_times(times, len(cases))
    options = {"kind": kind, "periodic": periodic, "threshold": threshold, "dark": dark}
    measures, notes = measure_scans(cases, options, reading, workers, sub_progress(progress, 0.0, 0.97), laws)
    orders, exact = reorder(len(cases), permutations, seed)
    embeddings = np.stack([sliced_embedding(each.diagram) for each in measures])
    away = cdist(embeddings, embeddings)
    return Trajectory(
        unit=measures[0].unit,
        times=moments,
        unit_of_time=unit_of_time,
        measures=tuple(measures),
        changes=_follow_numbers(measures, orders),
        embeddings=embeddings,
        distances=away[0],
        p=_test_distances(away, orders),
        permutations=len(orders),
        exact=exact,
        options={**options, **reading, "permutations": permutations, "seed": seed},
        notes=(*notes, *gather_notes(measures, cases)),
    )


def check_times(times: Sequence[float] | None, count: int) -> tuple[float, ...]:
    """Return the times of `count` scans, or raise ValueError where they are not as many or do not increase."""
    if count < 2:
        raise ValueError(f"expected two scans or more, got {count}")
    if times is None:
        return tuple(map(float, range(count)))
    moments = tuple(check_float(time, "times that are finite numbers", of=times) for time in as_tuple(times, "times"))
    if len(moments) != count:
        raise ValueError(f"expected a time for each of {count} scans, got {len(moments)}")
    if not (np.diff(moments) > 0).all():
        raise ValueError(f"expected times that increase from scan to scan, got {quoted(moments)}")
    return moments


def _test_distances(away: np.ndarray, orders: np.ndarray) -> float:
    """Return the p of distances (N, N) that go with those in the series, over orders (m, N)."""
    if len(away) < FEWEST:
        return math.nan
    i, j = np.triu_indices(len(away), 1)
    return float(share_beyond(correlate(away[i, j][:, None], np.abs(orders[:, i] - orders[:, j])))[0])


def _follow_numbers(measures: Sequence[Measures], orders: np.ndarray) -> tuple[Change, ...]:
    """Return the change of each quantity, tested over orders (m, N) of the scans."""
    values, halves = stack_numbers(measures)
    correlation, p, family = np.full((3, values.shape[1]), np.nan)
    if len(measures) >= FEWEST:
        told = np.isfinite(values).all(0)
        every = correlate(values[:, told], orders)
        p[told], family[told] = share_beyond(every), correct_by_most(values[:, told], orders)
        correlation[told] = every[0] * np.sign((orders[0] - orders[0].mean()) @ values[:, told])
    differences, reach = values[-1] - values[0], np.hypot(halves[0], halves[-1])
    columns = np.stack([differences, reach, correlation, p, family], axis=1).tolist()
    return tuple(
        Change(each.name, each.symbol, each.power, *row)
        for each, row in zip(measures[0].quantities, columns, strict=True)
    )
