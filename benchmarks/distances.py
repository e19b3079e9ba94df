"""Distances of all pairs of an atlas's diagrams: time, error, and the nearest match.

python -m benchmarks.distances [--atlas PATH] [--store STORE] [--pairs 200] [--all] [--match] [-o distances]

1. Milliseconds a pair on one thread and on all, beside geomloss on the same diagrams in the same run, and the minutes
   for all pairs of the atlas. The floor: a step takes one exponential a pair of bins, some 20 operations in float32.
   With --all these are computed and timed; where that was stopped, it goes on.
2. Error of bins on random pairs of whole diagrams, half of them fields', half masks', and on every diagram with its
   nearest. Truth: geomloss on diagrams binned to at most 5000 points. What that changes in turn is measured on a few
   pairs of whole diagrams. The store is made where there is none (an hour on two cores), and the truth is kept.
3. With --match: `nearest` against all distances, on fields and masks of 50 shapes held out of the atlas.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch
from rich.progress import track

from curvafit.data_synth.atlas.build import build
from curvafit.data_synth.atlas.store import open_store
from curvafit.generation.viability import well_formed
from curvafit.geometry.diagram import Diagram, diagram
from curvafit.geometry.pairwise import one_to_many, pairwise
from curvafit.geometry.transport import comparable, wasserstein
from curvafit.inference.atlas import VIEWS, Atlas, load_atlas
from curvafit.inference.match import nearest
from curvafit.priors.grid import Grid
from curvafit.priors.profile import phase_field

#: Diagrams and rounds of the timing, and the pairs of them that geomloss takes.
TIMED, ROUNDS, SLOW = 64, 5, 8
#: Shapes that are measured; edge and seed of the store that is made where none is named; points that a diagram of the
#: truth has at most; pairs of whole diagrams; edges of bins.
SHAPES, EDGE, SEED, POINTS, WHOLE, WIDTHS = 40, 56, 77, 5000, 3, (1.0, 1.5, 2.0, 3.0)
#: Shapes held out of the atlas, and lengths of the short list.
HELD, LENGTHS = 50, (5, 10, 20, 40, 80)


def seconds(action: Callable[[], object]) -> np.ndarray:
    """Passed, and used by all of the process's threads, `(2,)`."""
    begun = np.array([time.perf_counter(), time.process_time()])
    action()
    return np.array([time.perf_counter(), time.process_time()]) - begun


def time_table(atlas: Atlas) -> None:
    chosen = np.random.default_rng(0).permutation(len(atlas))[:TIMED]
    bins = comparable([atlas.mask_diagrams[k] for k in chosen], 1.0, 20.0, 2.0)
    pairs, slow = len(bins) * (len(bins) - 1) // 2, np.random.default_rng(1).integers(0, len(bins), (SLOW, 2))
    counts = sorted({1, numba.get_num_threads()})
    times: dict[str, list[np.ndarray]] = {f"threads: {n}": [] for n in counts} | {"geomloss": []}
    for turn in range(ROUNDS + 1):
        for n in counts:
            numba.set_num_threads(n)
            times[f"threads: {n}"].append(seconds(lambda: pairwise(bins, bin_width=0)) / pairs)
        times["geomloss"].append(seconds(lambda: [wasserstein(bins[i], bins[j], bin_width=0) for i, j in slow]) / SLOW)
        if not turn:  # compiles
            times = {name: [] for name in times}
    sizes = np.array([len(d.weights) for d in bins])
    print(f"1. {len(bins)} diagrams of masks, {sizes.mean():.0f} bins ({sizes.min()} to {sizes.max()}), {pairs} pairs")
    print(f"{'':10} {'least ms a pair':>16} {'median':>8} {'processor':>10} {'geomloss':>9} {'atlas':>12} {'1000':>12}")
    reference = np.min(times["geomloss"], axis=0)[0]
    for name, taken in times.items():
        least, used = np.min(taken, axis=0)
        minutes = (f"{least * n * (n - 1) / 120:8.1f} min" for n in (len(atlas), 1000))
        row = f"{name:10} {1e3 * least:16.3f} {1e3 * np.median(taken, axis=0)[0]:8.3f} {1e3 * used:10.3f}"
        print(f"{row} {reference / least:8.0f}× {' '.join(minutes)}")


def all_pairs(atlas: Atlas, folder: Path) -> None:
    for view in VIEWS:
        diagrams, path = atlas.diagrams(view), folder / f"{view}.npz"
        took = seconds(lambda d=diagrams, p=path: pairwise(d, checkpoint=p))
        passed, used = took / 60
        print(f"all pairs of {len(diagrams)} diagrams seen as {view}: {passed:.2f} min, of the processor {used:.2f}")


def whole_diagrams(store: Path) -> list[Diagram]:
    """Of the first well-formed shapes of a store: all fields', then all masks'."""
    if not store.exists():
        print(f"making {SHAPES} shapes of {EDGE}³ in {store}")
        build(store, SHAPES, EDGE, SEED)
    opened = open_store(store)
    grid, epsilon = Grid(opened.settings.shape, opened.settings.spacing), opened.settings.epsilon
    fields, masks = [], []
    viable = [index for index in opened.indices() if well_formed(opened.record(index).viability)]
    for index in track(viable[:SHAPES], "diagrams"):
        u = torch.from_numpy(opened.field(index))
        fields.append(diagram(u, grid, epsilon))
        masks.append(diagram(phase_field(u > 0, grid, epsilon), grid, epsilon))
    return fields + masks


def reduced(whole: Diagram) -> Diagram:
    """The finest bins that leave at most `POINTS`."""
    finer = (whole.binned(width) for width in 0.1 * 1.1 ** np.arange(40))
    return next(found for found in finer if len(found.weights) <= POINTS)


def drawn(whole: list[Diagram], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs `(K, 2)`: at random, half of them fields and half masks; and each diagram with its nearest."""
    half = len(whole) // 2
    every = np.stack(np.triu_indices(half, 1), 1)
    random = np.random.default_rng(2).permutation(every)[: count // 2]
    near = []
    for start in (0, half):
        distances = pairwise(whole[start : start + half])
        np.fill_diagonal(distances, np.inf)
        near += [sorted((start + i, start + int(j))) for i, j in enumerate(distances.argmin(1))]
    return np.concatenate([random, random + half]), np.unique(near, axis=0)


def truth(fine: list[Diagram], pairs: np.ndarray, path: Path) -> np.ndarray:
    """Distances `(K,)` by geomloss; those in the file are not taken again."""
    known = dict(np.load(path)) if path.exists() else {}
    names = [f"{i}-{j}-{len(fine[i].weights)}-{len(fine[j].weights)}" for i, j in pairs]
    for name, (i, j) in track(list(zip(names, pairs, strict=True)), "truth"):
        if name not in known:
            known[name] = np.array(wasserstein(fine[i], fine[j], bin_width=0))
            np.savez(path, **known)
    return np.array([float(known[name]) for name in names])


def error_table(whole: list[Diagram], count: int, path: Path) -> None:
    fine = [reduced(d) for d in whole]
    sets = dict(zip(("random", "nearest"), drawn(whole, count), strict=True))
    exact = {name: truth(fine, pairs, path) for name, pairs in sets.items()}
    sizes, spread = [len(d.weights) for d in fine], max(d.spread for d in fine)
    print(f"2. {len(whole)} whole diagrams; truth on {min(sizes)} to {max(sizes)} points", end=", ")
    print(f"each at most {spread / math.sqrt(2):.2f} from its whole; what that changes:")
    for i, j in sets["random"][:: max(1, count // WHOLE)]:
        before, after = (float(one_to_many(ds[i], [ds[j]], bin_width=0)[0]) for ds in (whole, fine))
        print(f"   {len(whole[i].weights)} and {len(whole[j].weights)} triangles: {before:.4f} to {after:.4f}")
    print(f"{'pairs':>16} {'truth':>14} {'bins':>5} {'mean number':>12} {'median':>8} {'largest':>8} {'under 2':>8}")
    for name, pairs in sets.items():
        for width in WIDTHS:
            bins = comparable(whole, 1.0, 20.0, width)
            found = np.array([one_to_many(bins[i], [bins[j]], bin_width=0)[0] for i, j in pairs])
            error, far = np.abs(found - exact[name]), exact[name] >= 2
            relative, absolute = error / exact[name], f"{error[~far].max():8.3f}" if not far.all() else ""
            row = f"{len(pairs):4} {name:>11} {exact[name].min():6.2f} to {exact[name].max():5.2f} {width:4}"
            number = np.mean([len(d.weights) for d in bins])
            print(f"{row} {number:12.0f} {np.median(relative):8.2%} {relative[far].max():8.2%} {absolute}")


def match_table(atlas: Atlas) -> None:
    order = np.random.default_rng(3).permutation(len(atlas))
    held, kept = order[:HELD], np.sort(order[HELD:])
    rest = dataclasses.replace(
        atlas,
        ids=tuple(atlas.ids[k] for k in kept),
        **{name: getattr(atlas, name)[kept] for name in ("coefficients", "masses", "seeds", "volume_fractions")},
        **{f"{view}_diagrams": tuple(atlas.diagrams(view)[k] for k in kept) for view in VIEWS},
    )
    queries = [(view, atlas.diagrams(view)[k]) for view in VIEWS for k in held]
    first = seconds(lambda: [nearest(queries[k][1], rest, seen_as=view) for k, view in ((0, "field"), (-1, "mask"))])
    best = [one_to_many(query, rest.diagrams(view)).min() for view, query in track(queries, "all distances")]
    print(f"3. {len(queries)} queries against {len(rest)} shapes; the first two took {first[0] / 2:.2f} s each")
    print(f"{'short list':>10} {'recall@1':>9} {'median s':>9} {'most':>6}")
    for length in LENGTHS:
        hits, times = 0, []
        for (view, query), least in zip(queries, best, strict=True):
            begun = time.perf_counter()
            match = nearest(query, rest, seen_as=view, count=1, shortlist=length)[0]
            times.append(time.perf_counter() - begun)
            hits += match.distance <= least + 1e-3
        print(f"{length:10} {hits / len(queries):9.2f} {np.median(times):9.3f} {max(times):6.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--atlas", help="file; the packaged one by default")
    parser.add_argument("--store", type=Path, help="shapes for the errors; made under -o by default")
    parser.add_argument("--pairs", type=int, default=200, help="random pairs whose error is measured; 0 for none")
    parser.add_argument("--all", action="store_true", help="compute all pairs of the atlas")
    parser.add_argument("--match", action="store_true", help="measure the nearest match")
    parser.add_argument("-o", "--output", type=Path, default=Path("distances"), help="what is kept")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    atlas = load_atlas(options.atlas)
    time_table(atlas)
    if options.all:
        all_pairs(atlas, options.output)
    if options.pairs:
        whole = whole_diagrams(options.store or options.output / "store")
        error_table(whole, options.pairs, options.output / "truth.npz")
    if options.match:
        match_table(atlas)


if __name__ == "__main__":
    main()
