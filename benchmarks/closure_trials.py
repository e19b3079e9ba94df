"""Shapes regrown of the laws that methods read from queries, and what is measured of them: for `closure_regrown`."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cache, lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import closure_laws as laws
from benchmarks.level_cut import level_cut
from curvafit.core.files import write_atomically
from curvafit.data_synth.atlas.store import Store
from curvafit.generation.flow import generate
from curvafit.generation.schedule import Schedule
from curvafit.generation.viability import well_formed
from curvafit.geometry.descriptors import descriptors
from curvafit.geometry.morphometry import local_thickness
from curvafit.geometry.pairwise import one_to_many
from curvafit.geometry.topology import betti_numbers
from curvafit.inference.posterior import Posterior
from curvafit.inference.table import PARAMETERS, column_names, law_of, parameters_of
from curvafit.inference.views import View
from curvafit.priors.grid import Grid

#: Shapes regrown of each law, and the first seed of their noise.
SEEDS, FIRST_SEED = 2, 20_000
#: Levels of the quantiles of local thickness.
LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)
#: Kinds of numbers, how many of each there are, and their least deviation between seeds: of a length by 1 %; of the
#: root of a count, half of what chance alone gives it.
NUMBERS = {"thickness": (len(LEVELS), 0.01), "spacing": (len(LEVELS), 0.01), "pieces": (3, 0.25)}
#: How many numbers there are.
COUNT = sum(count for count, _ in NUMBERS.values())
#: The parameters of no law.
NONE = np.full(len(PARAMETERS), np.nan)


class Method(NamedTuple):
    """How a method reads a law (None: it is the null), whether it is asked on the first few queries alone, what it
    knows of ("posterior", "atlas", both or nothing), the only views that it reads, if not all, and whether its shapes
    fill as much of their box as the view shows, whatever the law's mass."""

    law: Callable[[laws.Query], np.ndarray] | None
    slow: bool
    knows: tuple[str, ...]
    views: tuple[str, ...] = ()
    filled: bool = False


#: The methods, in the order of the table.
METHODS = {
    "null": Method(None, False, ()),
    "truth": Method(laws.truth, False, ()),
    "posterior": Method(laws.posterior, False, ("posterior",)),
    "posterior as full": Method(laws.posterior, False, ("posterior",), ("mask", "scan"), filled=True),
    "optimum": Method(laws.best, False, ("posterior",)),
    "match": Method(laws.match, False, ("atlas",)),
    "refined": Method(laws.refined, True, ("posterior",)),
    "refined as full": Method(laws.refined, True, ("posterior",), ("mask", "scan"), filled=True),
    "literal": Method(laws.literal, False, ("posterior",)),
    "stationarity": Method(laws.by_stationarity, True, ("posterior", "atlas"), ("field",)),
    "point match": Method(partial(laws.point, laws.match), True, ("atlas",)),
    "point posterior": Method(partial(laws.point, laws.posterior), True, ("posterior",)),
    "synthetic": Method(laws.synthetic, True, ("atlas",)),
}


class Trial(NamedTuple):
    """What a method's law regrew of a query: parameters `(6,)`, NaN of the null; and of each seed the distance of the
    diagrams, infinite where nothing grew, and the numbers `(seeds, 13)`, NaN there."""

    parameters: np.ndarray
    distances: np.ndarray
    numbers: np.ndarray


class Bench(NamedTuple):
    """What all trials share."""

    store: Store
    posterior: Posterior
    cache: Path
    views: tuple[str, ...]

    def path(self, index: int, *names: str) -> Path:
        stem = "-".join([self.store.path.stem, f"{index:06d}", *names])
        return self.cache / f"{stem.replace(' ', '_')}.npz"

    def trial_path(self, index: int, view: str, name: str) -> Path:
        keys = {"posterior": key_of_posterior(self.posterior), "atlas": key_of_atlas()}
        return self.path(index, view, name, *(keys[each] for each in METHODS[name].knows))

    def clouds(self, index: int) -> list[Path]:
        """Files of shapes of the laws of the atlas's shapes nearest to a query."""
        return [self.path(index, f"law{k}", *self.views, key_of_atlas()) for k in range(laws.LAWS)]

    @property
    def grid(self) -> Grid:
        return Grid(self.store.settings.shape)

    @property
    def schedule(self) -> Schedule:
        return Schedule(**self.store.settings.schedule)


@cache
def key_of_posterior(posterior: Posterior) -> str:
    parts = [value.numpy().tobytes() for member in posterior.members for value in member.state_dict().values()]
    parts += [part.tobytes() for layer in posterior.emulator.mean for part in layer]
    return hashlib.sha256(b"".join(parts)).hexdigest()[:8]


@cache
def key_of_atlas() -> str:
    return hashlib.sha256(laws.packaged_atlas().coefficients.tobytes()).hexdigest()[:8]


# ---- queries and shapes ----------------------------------------------------------------------------------------------


def queries_of(store: Store, count: int) -> list[int]:
    """A store's first well-formed shapes."""
    usable = (i for i in store.indices() if store.viable(i) and well_formed(store.record(i).viability))
    return list(islice(usable, count))


@lru_cache(maxsize=8)
def query_of(bench: Bench, index: int, view: str) -> laws.Query | None:
    """A query, None where its view shows no surface."""
    record = bench.store.record(index)
    parameters = parameters_of(record.coefficients, record.mass)
    seen = laws.sight(bench.store.field(index), bench.grid, view, index)
    return None if seen is None else laws.Query(seen, parameters, bench.posterior, bench.clouds(index), bench.grid)


@lru_cache(maxsize=16)
def grown(bench: Bench, parameters: tuple[float, ...], seed: int, fraction: float | None = None) -> np.ndarray | None:
    """The field that a law grows, by its mass, or by one that fills a part of the box; None where it grows none."""
    law, mass = law_of(parameters)
    flow = generate(
        law,
        mass,
        bench.grid,
        volume_fraction=fraction,
        seed=seed,
        schedule=bench.schedule,
        reject_early=True,
    )
    return flow.field.numpy() if flow.viability.viable else None


def numbers_of(seen: View) -> np.ndarray:
    """Thickness, spacing and pieces `(13,)` of a view."""
    mask = seen.shape > 0
    lengths = [np.quantile(local_thickness(phase)[phase], LEVELS) for phase in (mask, ~mask)]
    counts = betti_numbers(mask, periodic=seen.grid.periodic)
    return np.concatenate([*map(np.log, lengths), np.sqrt(counts)])


# ---- trials ----------------------------------------------------------------------------------------------------------


def itself(bench: Bench, index: int, view: str) -> Trial:
    """The query in a trial's form: one shape, at no distance; none where its view shows no surface."""
    query = query_of(bench, index, view)
    numbers = np.zeros((0, COUNT)) if query is None else numbers_of(query.sight.seen)[None]
    return Trial(NONE if query is None else query.parameters, np.zeros(len(numbers)), numbers)


def trial(bench: Bench, index: int, view: str, method: Method) -> Trial:
    """What a method's law regrows of a query; no shape of a query whose view shows no surface."""
    query = query_of(bench, index, view)
    if query is None:
        return Trial(NONE, np.zeros(0), np.zeros((0, COUNT)))
    parameters = NONE if method.law is None else method.law(query)
    fraction = float((query.sight.seen.shape > 0).mean()) if method.filled else None
    distances, numbers = np.full(SEEDS, np.inf), np.full((SEEDS, COUNT), np.nan)
    for k in range(SEEDS):
        seed = FIRST_SEED + k
        shape = null(bench, index, seed) if method.law is None else grown(bench, tuple(parameters), seed, fraction)
        other = None if shape is None else laws.sight(shape, bench.grid, view, seed)
        if other is not None:
            distances[k] = one_to_many(query.sight.diagram, [other.diagram])[0]
            numbers[k] = numbers_of(other.seen)
    return Trial(parameters, distances, numbers)


@lru_cache(maxsize=SEEDS)
def null(bench: Bench, index: int, seed: int) -> np.ndarray:
    return level_cut(bench.store.field(index) > 0, bench.grid, seed)


def cloud(bench: Bench, index: int, number: int) -> dict[str, np.ndarray]:
    """Rows of descriptors `(n, 351)`, by view, of shapes of the law of an atlas's shape: of the `number`-th nearest to
    the query's mask."""
    query = query_of(bench, index, "mask")
    if query is None:
        return {"parameters": NONE} | {view: np.zeros((0, len(column_names()))) for view in bench.views}
    near = laws.matches(query, laws.LAWS)[number]
    parameters = parameters_of(near.coefficients, near.mass)
    rows: dict[str, list[np.ndarray]] = {view: [] for view in bench.views}
    for seed in range(FIRST_SEED + 100, FIRST_SEED + 100 + laws.SHAPES):
        shape = grown(bench, tuple(parameters), seed)
        for view in bench.views:
            other = None if shape is None else laws.sight(shape, bench.grid, view, seed)
            rows[view].append(
                np.full(len(column_names()), np.nan) if other is None else descriptors(*other.seen).vector()
            )
    return {"parameters": parameters} | {view: np.array(each) for view, each in rows.items()}


class Job(NamedTuple):
    """A file to make, and what makes its content: a trial, or arrays by name."""

    path: Path
    make: Callable[[], Trial | dict[str, np.ndarray]]


def jobs(bench: Bench, queries: Sequence[int], few: int, names: Collection[str] = tuple(METHODS)) -> Iterator[Job]:
    """The files to make for some methods, in their order."""
    for index in queries:
        for view in bench.views:
            yield Job(bench.path(index, view, "itself"), partial(itself, bench, index, view))
        yield from trials(bench, index, names, slow=False)
    for index in queries[:few]:
        for k, path in enumerate(bench.clouds(index) if "synthetic" in names else ()):
            yield Job(path, partial(cloud, bench, index, k))
        yield from trials(bench, index, names, slow=True)


def trials(bench: Bench, index: int, names: Collection[str], *, slow: bool) -> Iterator[Job]:
    """The trials of a query by the slow ones of some methods, or by the others."""
    for name, method in METHODS.items():
        for view in bench.views:
            if name in names and method.slow == slow and view in (method.views or bench.views):
                yield Job(bench.trial_path(index, view, name), partial(trial, bench, index, view, method))


def proceed(work: Iterable[Job], minutes: float) -> int:
    """Make the files that are missing until the time is over; return how many are left."""
    end, left = time.monotonic() + 60 * minutes, 0
    for job in work:
        if job.path.exists():
            continue
        if time.monotonic() > end:
            left += 1
            continue
        content = job.make()
        arrays = content._asdict() if isinstance(content, Trial) else content
        write_atomically(job.path, lambda temporary, arrays=arrays: np.savez(temporary, allow_pickle=False, **arrays))
    return left
