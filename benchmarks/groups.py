"""Whether `compare` tells groups apart that differ, and only those; its time from the shell.

`--on scans` ($CURVAFIT_DATA): windows of 50³ of the real masks of `completion`, lengths in voxels. A thousand times two
groups of 8 are drawn from the windows of bone: their p should be uniform. Then all windows of bone are compared, half
by half, and with those of other structures. Windows of one volume are no subjects: a small p says that two volumes
differ, not that two tissues do.

`--on shapes`: 20 shapes of 64³ of the preset tubes, and as many of that law with one coefficient lower by a part of the
prior's standard deviation, measured as masks. Groups of 4, 6 and 10 are drawn from them without replacement: 200 times
two laws, 1000 times one. A study finds a difference by

- `diagrams`: p of the curvature diagrams;
- `numbers`: the least family-wise p of all numbers;
- `familiar`: Student's t-tests of BV/TV, Tb.Th and Tb.Sp, the least p by Holm.

Studies are made by the parts of `compare`, of numbers that were measured once; the first of each kind by `compare` as
well, which must give the same p.

`--on command`: 20 noisy scans of 128³ measured, compared and drawn from the shell, by two workers.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from scipy import ndimage, stats
from scipy.spatial.distance import cdist

from benchmarks.completion import shape, sides
from benchmarks.harness import Cases, Figure, Values, run_python, show
from curvafit.core.permutation import correct_by_most, correct_holm, measure_energy, relabel, share_beyond
from curvafit.data_synth.design import INTERVALS
from curvafit.generation.flow import generate
from curvafit.geometry.diagram import Diagram
from curvafit.geometry.distances import sliced_embedding
from curvafit.priors.law import Law
from curvafit.scan.measure import QUANTITIES, Measures, Quantity, measure
from curvafit.studies.compare import LEVEL, compare
from curvafit.studies.scans import FINE
from curvafit.volumes.field import Field, ScanError

WINDOW, EDGE, SUBJECTS = 50, 64, 20
BASE, SHIFTED, SHIFTS = "tubes", ("a10", "a01"), (0.25, 0.5, 0.1)
LAWS = (BASE, *(f"{name}-{shift:g}" for name, shift in product(SHIFTED, SHIFTS)))
COUNTS, STUDIES, NULLS, PERMUTATIONS = (4, 6, 10), 200, 1000, 499
OTHERS = ("mitochondria-32", "felt", "vesselexpress")
TESTS = ("diagrams", "numbers", "familiar")
FAMILIAR = [k for k, (_, symbol, *_) in enumerate(QUANTITIES) if symbol in ("BV/TV", "Tb.Th", "Tb.Sp")]
#: Runs the command line, and prints the peak memory of this process and of its greatest worker, in KiB.
PROGRAM = """
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from curvafit.cli.app import app
try:
    app()
finally:
    print(*(getrusage(each).ru_maxrss for each in (RUSAGE_SELF, RUSAGE_CHILDREN)))
"""


# ---- subjects --------------------------------------------------------------------------------------------------------


def subject(name: str, scan: Callable[[], Field], periodic: bool, cases: Cases) -> list[Measures]:
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


def shapes(law: str, cases: Cases) -> list[Measures]:
    """Return the measures of the shapes of a law; no two laws grow from one noise."""
    known, (name, _, shift) = Law.of(BASE), law.partition("-")
    coefficients = known.coefficients
    if shift:
        deviation = np.ptp(INTERVALS[name]) / np.sqrt(12)
        coefficients = replace(coefficients, **{name: getattr(coefficients, name) - float(shift) * deviation})

    def mask(seed: int) -> Field:
        grown = generate(coefficients, known.mass, EDGE, schedule="deep", seed=seed)
        assert grown.viability.viable, (law, grown.status)
        return Field((grown.field.numpy() > 0).astype(np.uint8))

    seeds = 100 * LAWS.index(law) + np.arange(SUBJECTS)
    return [each for seed in seeds for each in subject(f"{law}-{seed}", partial(mask, int(seed)), True, cases)]


# ---- studies ---------------------------------------------------------------------------------------------------------


def studies(pools: Sequence[Sequence[Measures]], count: int, times: int) -> Values:
    """Return by each test the p of studies of `count` subjects a group, drawn from each pool, or twice from one."""
    random, found = np.random.default_rng(count), []
    subjects, ends = [each for pool in pools for each in pool], np.cumsum([len(pool) for pool in pools])
    embedded = np.stack([sliced_embedding(each.diagram) for each in subjects])
    values = np.array([[each.value for each in scan.quantities] for scan in subjects])
    for seed in range(times):
        drawn = [
            random.permutation(part)[: 2 * count // len(pools)] for part in np.split(np.arange(ends[-1]), ends[:-1])
        ]
        chosen = np.concatenate(drawn)
        rows, numbers = embedded[chosen], values[chosen]
        choices, _ = relabel(np.arange(2 * count) >= count, PERMUTATIONS, seed)
        p = [share_beyond(measure_energy(cdist(rows, rows), choices)), correct_by_most(numbers, choices).min()]
        if seed == 0:
            scans = [subjects[k] for k in chosen]
            whole = compare(scans[:count], scans[count:], permutations=PERMUTATIONS, seed=seed)
            assert np.allclose(p, (whole.p, min(each.family for each in whole.numbers)))
        t: Any = stats.ttest_ind(numbers[:count, FAMILIAR], numbers[count:, FAMILIAR])
        found.append([*map(float, p), float(correct_holm(t.pvalue).min())])
    return {test: np.round(p, 4).tolist() for test, p in zip(TESTS, np.transpose(found), strict=True)}


def share(p: Sequence[float]) -> Figure:
    """Return the share of significant studies, with its binomial interval."""
    count = int(np.sum(np.array(p) <= LEVEL))
    ends = stats.binomtest(count, len(p)).proportion_ci()
    return Figure(count / len(p), float(ends.low), float(ends.high))


def on_scans(quick: bool, cases: Cases) -> dict[str, Figure]:
    def against(first: Sequence[Measures], second: Sequence[Measures]) -> Values:
        found = compare(first, second)
        return {"p": found.p, "energy": found.energy, "windows": len(second)}

    def both(name: str) -> list[Measures]:
        return [*windows(name, 0, cases), *windows(name, 1, cases)]

    jobs = {"bone": lambda: studies([both("bone")], 8, 10 if quick else NULLS)}
    jobs["halves"] = lambda: against(windows("bone", 0, cases), windows("bone", 1, cases))
    jobs |= {name: lambda name=name: against(both("bone"), both(name)) for name in OTHERS}
    null, *others = (found := cases.all(jobs)).values()
    figures = {"groups.windows": share(null["diagrams"])}
    figures["groups.uniform"] = Figure(float(stats.kstest(null["diagrams"], "uniform").statistic))
    figures |= {f"groups_scans.{name}.{key}": Figure(row[key]) for name, row in zip([*found][1:], others, strict=True)
                for key in ("windows", "p", "energy")}  # fmt: skip
    show(["", "figure"], list(figures.items()), "windows of bone")
    return figures


def on_shapes(quick: bool, cases: Cases) -> dict[str, Figure]:
    def job(law: str, count: int) -> Values:
        times = 4 if quick else NULLS if law == BASE else STUDIES
        return studies([shapes(each, cases) for each in dict.fromkeys((BASE, law))], count, times)

    laws, figures = LAWS[:2] if quick else LAWS, dict[str, Figure]()
    found = cases.all({f"{law}-{count}": partial(job, law, count) for law, count in product(laws, COUNTS)})
    for name, row in found.items():
        law, _, count = name.rpartition("-")
        figures |= {f"groups_power.{law}.{test}_{count}": Figure(share(row[test]).value) for test in TESTS}
        if law == BASE:
            figures[f"groups.null_{count}"] = share(row["diagrams"])
    columns = [f"{test}_{count}" for count, test in product(COUNTS, TESTS)]
    rows = [[law, *(figures.get(f"groups_power.{law}.{column}", "") for column in columns)] for law in laws]
    show(["law", *columns], rows, "significant studies")
    return figures


def on_command(quick: bool, cases: Cases) -> dict[str, Figure]:
    def timed() -> Values:
        folder, random = cases.folder / "command", np.random.default_rng(0)
        for number in range(4 if quick else 20):
            place = folder / ("first", "second")[number % 2] / f"{number}.npy"
            place.parent.mkdir(parents=True, exist_ok=True)
            mask = np.roll(
                np.tile(shape("tubes", number % 2, cases), (2, 2, 2)), random.integers(0, EDGE, 3), (0, 1, 2)
            )
            noise = random.standard_normal(mask.shape, dtype=np.float32)
            np.save(place, ndimage.gaussian_filter(mask.astype(np.float32), 1.0) + 0.3 * noise)
        begun, words = time.monotonic(), ("compare", folder / "first", folder / "second", "--workers", 2)
        said = run_python("-c", PROGRAM, *words, "-o", folder / "compared", "--overwrite")
        own, worker = map(int, said.split()[-2:])
        return {"seconds": time.monotonic() - begun, "memory": (own + 2 * worker) * 1024 / 1e9}

    found = cases.all({"command": timed})
    figures = {f"groups.{key}": Figure(value) for row in found.values() for key, value in row.items()}
    show(["from the shell", ""], list(figures.items()))
    return figures


PARTS = {"scans": on_scans, "shapes": on_shapes, "command": on_command}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--on", default="scans,shapes", help="scans, shapes, command")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    return {k: v for part in options.on.split(",") for k, v in PARTS[part](options.quick, cases).items()}
