"""Whether `compare` finds what differs, and only that: two groups, three, pairs, a number.

`--on scans` ($CURVAFIT_DATA): windows of 50³ of the real masks of `completion`, lengths in voxels. A thousand times two
groups of 8 are drawn from the windows of bone: their p should be uniform. Then all windows of bone are compared, half
by half, and with those of other structures. Windows of one volume are no subjects: a small p says that two volumes
differ, not that two tissues do.

`--on shapes`: 20 shapes of 64³ of the preset tubes, and as many of that law with one coefficient lower by a part of the
prior's standard deviation, measured as masks. Groups of 4, 6 and 10 are drawn from them without replacement: 200 times
two laws, 1000 times one.

`--on path`: 12 shapes of 64³ at each of five places between tubes and that law with a lower a01. Of 200 studies two
groups of 6 are from the ends; three also from the middle; 8 pairs from places two apart, wherever the first is; ten
subjects from all places, the number. A thousand times the same designs are drawn from all shapes, wherever they are. A
study finds a difference by

- `diagrams`: p of the curvature diagrams;
- `numbers`: the least family-wise p of all numbers;
- `familiar`: F-tests (of two groups Student's t) of BV/TV, Tb.Th and Tb.Sp, the least p by Holm.

Studies are made by the parts of `compare`, of numbers that were measured once; the first of each kind by `compare` as
well, which must give the same p.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from scipy import stats
from scipy.spatial.distance import cdist

from benchmarks.completion import sides
from benchmarks.harness import Cases, Figure, Values, show
from curvafit.core import permutation as tests
from curvafit.data_synth.design import INTERVALS
from curvafit.generation.flow import generate
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.distances import sliced_embedding
from curvafit.priors.law import Law
from curvafit.scan.measures import QUANTITIES, Measures, Quantity
from curvafit.scan.tiles import measure
from curvafit.studies.comparison import LEVEL, compare
from curvafit.studies.scans import FINE
from curvafit.volumes.volume import ScanError, Volume

WINDOW, EDGE, SUBJECTS = 50, 64, 20
BASE, SHIFTED, SHIFTS = "tubes", ("a10", "a01"), (0.25, 0.5, 0.1)
LAWS = (BASE, *(f"{name}-{shift:g}" for name, shift in product(SHIFTED, SHIFTS)))
PATH, PLACED = (BASE, "a01-0.0625", "a01-0.125", "a01-0.1875", "a01-0.25"), 12
#: Subjects with a label, and the place on the path of each label's law, or how far it is from the pair's first.
DESIGNS = {"two": (6, (0, 4)), "three": (6, (0, 2, 4)), "pairs": (8, (0, 2)), "number": (2, (0, 1, 2, 3, 4))}
COUNTS, STUDIES, NULLS, PERMUTATIONS = (4, 6, 10), 200, 1000, 499
OTHERS = ("mitochondria-32", "felt", "vesselexpress")
TESTS = ("diagrams", "numbers", "familiar")
FAMILIAR = [k for k, (_, symbol, *_) in enumerate(QUANTITIES) if symbol in ("BV/TV", "Tb.Th", "Tb.Sp")]


# ---- subjects --------------------------------------------------------------------------------------------------------


def subject(name: str, scan: Callable[[], Volume], periodic: bool, cases: Cases) -> list[Measures]:
    """Return what `compare` keeps of a mask, measured once; nothing of one without a surface."""

    def numbers() -> np.ndarray:
        try:
            found = measure(scan(), kind="mask", periodic=periodic)
        except ScanError:
            return np.empty((0, 3))
        diagram = found.diagram.bin(FINE / found["thickness"].value)
        values = [(each.value, 0, 0) for each in found.quantities]
        return np.concatenate([values, np.column_stack([diagram.points, diagram.weights])])

    rows = cases.array(f"{name}-{len(QUANTITIES)}", numbers)
    pairs = zip(QUANTITIES, rows[:, 0], strict=False)
    quantities = tuple(Quantity(name, symbol, value, np.nan, power) for (name, symbol, power, _), value in pairs)
    binned = rows[len(QUANTITIES) :]
    diagram = Diagram(binned[:, :2], binned[:, 2], unit="1/voxel")
    return [Measures(name, "voxel", "mask", quantities, (1.0, 0.0, 0.0), diagram, (1, 1, 1), ())] * bool(len(rows))


def windows(name: str, side: int, cases: Cases) -> list[Measures]:
    """Return the measures of the windows of a structure's side."""
    whole = replace(sides(name)[side], spacing=(1.0, 1.0, 1.0), unit="voxel", affine=None)
    found: list[Measures] = []
    for start in product(*(range(0, n - WINDOW + 1, WINDOW) for n in whole.shape)):
        part = partial(whole.crop, tuple(slice(a, a + WINDOW) for a in start))
        found += subject(f"{name}-{side}-{'-'.join(map(str, start))}", part, False, cases)
    return found


def shapes(law: str, cases: Cases, count: int = SUBJECTS, schedule: str = "deep") -> list[Measures]:
    """Return the measures of shapes of a law; no two laws grow from one noise."""
    known, (name, _, shift) = Law.of(BASE), law.partition("-")
    coefficients = known.coefficients
    if shift:
        deviation = np.ptp(INTERVALS[name]) / np.sqrt(12)
        coefficients = replace(coefficients, **{name: getattr(coefficients, name) - float(shift) * deviation})

    def mask(seed: int) -> Volume:
        grown = generate(coefficients, known.mass, EDGE, schedule=schedule, seed=seed)
        assert grown.viability.viable, (law, grown.status)
        return Volume((grown.field.numpy() > 0).astype(np.uint8))

    start = 100 * LAWS.index(law) if schedule == "deep" else 1000 + 100 * PATH.index(law)
    seeds = start + np.arange(count)
    return [each for seed in seeds for each in subject(f"{law}-{seed}", partial(mask, int(seed)), True, cases)]


# ---- studies ---------------------------------------------------------------------------------------------------------


def studies(pools: Sequence[Sequence[Measures]], times: int, design: str, count: int = 0) -> Values:
    """Return by each test the p of studies of a design, of subjects from the pools on the path, or from fewer."""
    usual, steps = DESIGNS[design]
    count, random, found = count or usual, np.random.default_rng(count or usual), []
    subjects, ends = [each for pool in pools for each in pool], np.cumsum([len(pool) for pool in pools])
    embedded = np.stack([sliced_embedding(each.diagram) for each in subjects])
    values = np.array([[each.value for each in scan.quantities] for scan in subjects])
    labels = np.repeat(np.arange(len(steps), dtype=float if design == "number" else int), count)
    blocks = np.tile(np.arange(count), 2) if design == "pairs" else None
    test = tests.measure_dependence if design == "number" else tests.measure_energy
    q = 1 if design == "number" else len(steps) - 1
    free = len(labels) - q - (1 if blocks is None else count)
    for seed in range(times):
        first = random.integers(len(PATH) - 2, size=count) if design == "pairs" and len(pools) > 1 else 0
        places = np.concatenate([np.zeros(count, dtype=int) + first + step for step in steps])
        places, chosen = np.minimum(places, len(pools) - 1), np.empty(len(labels), dtype=int)
        for place, part in enumerate(np.split(np.arange(ends[-1]), ends[:-1])):
            chosen[places == place] = random.permutation(part)[: (places == place).sum()]
        rows, numbers = embedded[chosen], values[chosen]
        arranged, _ = tests.relabel(labels, PERMUTATIONS, seed, blocks)
        p = [
            tests.share_beyond(test(cdist(rows, rows), arranged, blocks)),
            tests.correct_by_most(numbers, arranged, blocks).min(),
        ]
        if seed == 0:
            scans, how = [subjects[k] for k in chosen], {"permutations": PERMUTATIONS, "paired": blocks is not None}
            by = labels if design == "number" else [f"group {label}" for label in labels]
            groups = [scans[k : k + count] for k in range(0, len(scans), count)]
            whole = compare(scans, by=by, **how) if blocks is None else compare(*groups, **how)
            assert np.allclose(p, (whole.p, min(each.family for each in whole.numbers)))
        squares = tests.correlate(numbers[:, FAMILIAR], arranged[:1], blocks)[0] ** 2
        f: Any = stats.f.sf(squares / (1 - squares) * free / q, q, free)
        found.append([*map(float, p), min(float(len(f) * f.min()), 1.0)])
    return {test: np.round(p, 4).tolist() for test, p in zip(TESTS, np.transpose(found), strict=True)}


def share(p: Sequence[float]) -> Figure:
    """Return the share of significant studies, with its binomial interval."""
    count = int(np.sum(np.array(p) <= LEVEL))
    ends = stats.binomtest(count, len(p)).proportion_ci()
    return Figure(count / len(p), float(ends.low), float(ends.high))


def on_scans(quick: bool, cases: Cases) -> dict[str, Figure]:
    def against(name: str) -> Values:
        pair = [windows("bone", k, cases) for k in (0, 1)] if name == "halves" else [both("bone"), both(name)]
        found = compare(*pair)
        return {"p": found.p, "energy": found.statistic, "windows": len(pair[1])}

    def both(name: str) -> list[Measures]:
        return [*windows(name, 0, cases), *windows(name, 1, cases)]

    jobs = {"bone": lambda: studies([both("bone")], 10 if quick else NULLS, "two", 8)}
    found = cases.all(jobs | {name: partial(against, name) for name in ("halves", *OTHERS)})
    figures = {"groups.windows": share(found["bone"]["diagrams"])}
    figures["groups.uniform"] = Figure(float(stats.kstest(found["bone"]["diagrams"], "uniform").statistic))
    figures |= {f"groups_scans.{name}.{key}": Figure(found[name][key]) for name in ("halves", *OTHERS)
                for key in ("windows", "p", "energy")}  # fmt: skip
    show(["", "figure"], list(figures.items()), "windows of bone")
    return figures


def on_shapes(quick: bool, cases: Cases) -> dict[str, Figure]:
    def job(law: str, count: int) -> Values:
        times = 4 if quick else NULLS if law == BASE else STUDIES
        return studies([shapes(each, cases) for each in dict.fromkeys((BASE, law))], times, "two", count)

    laws, figures = LAWS[:2] if quick else LAWS, dict[str, Figure]()
    found = cases.all({f"{law}-{count}": partial(job, law, count) for law, count in product(laws, COUNTS)})
    for name, row in found.items():
        law, _, count = name.rpartition("-")
        figures |= {f"groups_power.{law}.{test}_{count}": Figure(share(row[test]).value) for test in TESTS}
        if law == BASE:
            figures[f"groups.null_{count}"] = share(row["diagrams"])
    show(["", "figure"], list(figures.items()), "significant studies")
    return figures


def on_path(quick: bool, cases: Cases) -> dict[str, Figure]:
    def job(design: str, null: bool) -> Values:
        pools = [shapes(law, cases, PLACED, "fast") for law in PATH]
        pools = [[each for pool in pools for each in pool]] if null else pools
        return studies(pools, 4 if quick else NULLS if null else STUDIES, design)

    kinds = product(DESIGNS, {"path": False, "size": True}.items())
    found = cases.all({f"{kind}-{design}": partial(job, design, null) for design, (kind, null) in kinds})
    figures = {f"groups_{name.replace('-', '.')}.{test}": share(row[test])
               for name, row in found.items() for test in TESTS}  # fmt: skip
    show(["", "figure"], list(figures.items()), "significant studies")
    return figures


PARTS = {"scans": on_scans, "shapes": on_shapes, "path": on_path}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--on", default="scans,shapes,path", help="scans, shapes, path")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    return {k: v for part in options.on.split(",") for k, v in PARTS[part](options.quick, cases).items()}
