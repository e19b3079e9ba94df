"""The test of a law: how often it rejects shapes of the model, and how often what only looks like them.

Shapes of stores (`--shapes STORE…`), laws that no choice has seen, as masks cut open, go through the whole of `infer`,
which tests the law that it found itself. So do their level cuts: cuts of a Gaussian field with the same volume
fraction and two-point function, which no law made. The p of each is as `infer` states it (`compare_windows`): of the
rank of its departure (`Misfit.departure`) among those of the packaged posterior, and of the rank of its discriminant.
`size` is the part of shapes with p at most .05, `power` that of level cuts; a cut that has not gone through `infer` is
counted by its discriminant alone, which can only reject fewer. `law_error` is how far the law that `infer` chooses
lies from the shape's own, `medians_error` the posterior's medians: the mean over the six parameters and the laws, in
deviations of the box of `curvafit atlas build`.

`--teach STORE…` learns the discriminant from shapes of other laws, as masks, and their level cuts. `--calibrate FILE`
writes the packaged posterior with it and with the departures of all shapes; each law's is then ranked among the others.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy import optimize, stats

from benchmarks.closure import PRIOR, TABLE
from benchmarks.harness import Cases, Figure, Values, bootstrap, show
from curvafit.data_synth.store import Store, find_well_formed
from curvafit.inference.candidates import join_tests
from curvafit.inference.estimate import measure_descriptors, rank_level_cut, tail_probability
from curvafit.inference.inference import infer
from curvafit.inference.posterior import Posterior, load_posterior, save_posterior
from curvafit.inference.simulate import Growth
from curvafit.inference.table import column_names, load_table, parameters_of
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.scan.preparation import prepare
from curvafit.volumes.volume import Volume

KINDS = ("shape", "cut")
LEVEL = 0.05
#: Angles at which the integral of `cut_covariance` is tabulated.
ANGLES = 4001
#: Part of the mean variance of a column that is added to each, where the discriminant is learned.
RIDGE = 0.1


def masked(store: Store, index: int, cut: bool) -> Volume:
    """Return a shape, or its level cut, as a mask that is cut open at another place."""
    mask, random = store.field(index) > 0, np.random.default_rng(index)
    if cut:
        mask = level_cut(mask, Grid(mask.shape), index) > 0
    return Volume(np.roll(mask, random.integers(mask.shape[0], size=3), (0, 1, 2)).astype(np.uint8))


def case(store: Store, index: int, cut: bool) -> Values:
    """Return p, of all descriptors and by block, the departure and the verdict of a shape or of its level cut."""
    fit = infer(masked(store, index, cut), kind="mask", growth=Growth(), seed=index).fit
    found: Values = {"status": fit.status.partition(":")[0]}
    if not cut and (best := fit.best) is not None and fit.draws is not None:
        truth, law = (parameters_of(each.coefficients, each.mass) for each in (store.record(index), best))
        for name, parameters in (("law", law), ("medians", np.median(fit.draws[:, :-1], 0))):
            found[f"{name} error"] = float(np.mean(np.abs(parameters - truth) / PRIOR))
    if (misfit := fit.misfit) is not None:
        found |= {"p": misfit.probability, "departure": misfit.departure, **misfit.blocks}
    return found


def describe(store: Store, index: int, cut: bool) -> np.ndarray:
    """Return the descriptors `(k, 351)` of windows of a shape, or of its level cut, as `infer` measures them."""
    try:
        found = measure_descriptors(prepare(masked(store, index, cut), kind="mask", one_scale=True))
    except ValueError:  # such as of one ball, which is a few voxels wide at the thickness of the training
        found = None
    return np.zeros((0, len(column_names()))) if found is None else found.reading.windows


def describe_all(shapes: Sequence[tuple[Store, int]], cases: Cases) -> dict[str, list[np.ndarray]]:
    """Return the descriptors of windows `(k, 351)` of shapes, and of their level cuts, by kind."""
    return {kind: [cases.array(name_of(*each, kind), partial(describe, *each, kind == "cut")) for each in shapes]
            for kind in KINDS}  # fmt: skip


def name_of(store: Store, index: int, kind: str) -> str:
    return f"{store.settings.shape[0]}-{store.name}-{index}-{kind}"


def teach(posterior: Posterior, rows: Mapping[str, Sequence[np.ndarray]]) -> Posterior:
    """Return a posterior with Fisher's discriminant of windows `(k, 351)` of shapes and of their level cuts."""
    plain = replace(posterior.compression, basis=np.eye(len(posterior.compression.mean)))
    shapes, cuts = (np.array([plain(each).mean(0) for each in rows[kind] if len(each)]) for kind in KINDS)
    variance = np.cov(np.concatenate([shapes, cuts]).T, bias=True)
    ridge = RIDGE * np.diag(variance).mean() * np.eye(len(variance))
    weights = np.linalg.solve(variance + ridge, shapes.mean(0) - cuts.mean(0))
    taught = replace(posterior, discriminant=weights.astype(np.float32))
    table = load_table(TABLE)
    values = {view: taught.discriminate(table.rows(table.views == view).descriptors) for view in posterior.views}
    return replace(taught, discriminants={view: np.sort(each) for view, each in values.items()})


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shapes", type=Path, nargs="+", required=True, help="stores of laws that no choice has seen")
    parser.add_argument("--count", type=int, default=100, help="shapes of each store, and as many level cuts")
    parser.add_argument(
        "--teach", type=Path, nargs="+", help="stores of other laws, from which to learn what tells cuts"
    )
    parser.add_argument("--calibrate", type=Path, help="write the packaged posterior with the departures found")


def level_cuts(posterior: Posterior, windows: Sequence[np.ndarray]) -> np.ndarray:
    """Return `rank_level_cut` `(n,)` of windows `(k, 351)` of n masks, NaN where there are none."""
    return np.array([rank_level_cut(posterior, "mask", each) if len(each) else np.nan for each in windows])


def rank(
    usual: np.ndarray | None, departures: Mapping[str, Mapping[int, float]], cuts: Mapping[str, np.ndarray]
) -> dict[str, dict[int, float]]:
    """Return p by kind and number of the law, of departures by both and of `level_cuts` by kind `(laws,)`.

    Departures are ranked among usual ones `(n,)`; where these are None, among those of the other laws' shapes. A shape
    without a departure is left out; a cut without one stands with the rank of its discriminant.
    """
    found: dict[str, dict[int, float]] = {}
    for kind, mine in departures.items():
        own = {} if kind == "shape" else dict.fromkeys(range(len(cuts[kind])), 1.0)
        for law, departure in mine.items():
            others = np.array([each for other, each in departures["shape"].items() if other != law])
            own[law] = tail_probability(others if usual is None else usual, departure)
        both = {law: (p, cuts[kind][law]) for law, p in own.items()}
        found[kind] = {law: join_tests(*each) for law, each in both.items() if np.isfinite(each[1])}
    return found


def figures_of(
    tested: Mapping[str, Mapping[int, float]], errors: Mapping[int, Values], edges: np.ndarray
) -> dict[str, Figure]:
    """Return the part that is rejected, by kind, and mean errors of `infer`, by edge of the laws' shapes `(laws,)`."""
    figures = {}
    for edge in dict.fromkeys(edges):
        for (_, found), title in zip(tested.items(), ("size", "power"), strict=True):
            p = np.array([p for law, p in found.items() if edges[law] == edge])
            hits = int(np.sum(p <= LEVEL))
            interval = stats.binomtest(hits, len(p)).proportion_ci(method="wilson") if len(p) else (np.nan, np.nan)
            figures[f"belief.{edge}.{title}"] = Figure(hits / max(len(p), 1), *map(float, interval))
        for name in ("law", "medians"):
            away = [values[f"{name} error"] for law, values in errors.items() if edges[law] == edge]
            figures |= {f"belief.{edge}.{name}_error": bootstrap(away, np.mean)} if away else {}
    show([f"part with p at most {LEVEL}; mean errors", ""], list(figures.items()))
    return figures


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if options.quick and options.calibrate is not None:
        raise SystemExit("--quick makes two shapes only: no test is calibrated by them")
    posterior, most = load_posterior(), 2 if options.quick else None
    if options.teach is not None:
        posterior = teach(posterior, describe_all(find_well_formed(tuple(options.teach))[:most], cases))
    stores = [find_well_formed((path,))[: most or options.count] for path in options.shapes]
    shapes = [shape for store in stores for shape in store]
    cuts = {kind: level_cuts(posterior, windows) for kind, windows in describe_all(shapes, cases).items()}
    departures: dict[str, dict[int, float]] = {kind: {} for kind in KINDS}
    errors: dict[int, Values] = {}
    for number, (store, index) in enumerate(shapes):
        for kind, found in departures.items():
            job = partial(case, store, index, kind == "cut")
            for values in cases.all({name_of(store, index, kind): job}, seed=index).values():
                if "departure" in values:
                    found[number] = values["departure"]
                if "law error" in values:
                    errors[number] = values
    edges = np.array([store.settings.shape[0] for store, _ in shapes])
    p = rank(None if options.calibrate else posterior.departures, departures, cuts)
    figures = figures_of(p, errors, edges)
    if options.calibrate is not None:
        found = np.sort(np.array([*departures["shape"].values()], dtype=np.float32))
        save_posterior(replace(posterior, departures=found), options.calibrate)
    return {} if options.quick else figures


# ---- level cuts ------------------------------------------------------------------------------------------------------


def level_cut(mask: np.ndarray, grid: Grid, seed: int) -> np.ndarray:
    """Return a phase field (float32), which repeats, whose {u > 0} is a null of a mask `(Z, Y, X)` that repeats.

    The two-point function is the mask's, averaged over directions, as nearly as a cut of a Gaussian field comes. The
    profile is tanh(d / √2 ε), d being the Gaussian field over its mean slope at the cut, and has its level sets.
    """
    spectrum = gaussian_spectrum(mask)
    noise = np.fft.fftn(np.random.default_rng(seed).standard_normal(mask.shape))
    values = np.fft.ifftn(noise * np.sqrt(spectrum)).real
    height = values - np.quantile(values, 1 - mask.mean())
    slope = np.sqrt(sum(np.square((np.roll(height, -1, k) - np.roll(height, 1, k)) / 2) for k in range(3)))
    near = np.abs(height) < slope.mean()
    voxel = grid.spacing[0]
    return np.tanh(height * voxel / (math.sqrt(2) * WORKING_EPSILON * slope[near].mean())).astype(np.float32)


def gaussian_spectrum(mask: np.ndarray) -> np.ndarray:
    """Return the power spectrum, alike in all directions, of a Gaussian field of variance 1 whose cut has a mask's
    fraction and two-point function up to half of the box: by non-negative least squares over shells of frequencies."""
    shells = _shells(mask.shape)
    covariance = _means(np.fft.ifftn(np.abs(np.fft.fftn(mask - mask.mean())) ** 2).real / mask.size, shells)
    told, correlation = cut_covariance(float(stats.norm.isf(mask.mean())))
    read = min(mask.shape) // 2
    target = np.interp(covariance[:read], told, correlation)
    waves = np.array([_means(np.fft.ifftn(shells == k).real * mask.size, shells)[:read] for k in range(1, read)])
    power, _ = optimize.nnls(waves.T, target)
    spectrum = np.concatenate([[0], power, np.zeros(shells.max() + 1 - read)])[shells]
    return spectrum / spectrum.mean()


def cut_covariance(level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances of {g > level} at two points, increasing, and the correlations of a normal g there:
    ∫ exp(-level² / (1 + sin θ)) dθ / 2π from 0 to arcsin of the correlation (Sheppard)."""
    angles = np.linspace(-math.pi / 2, math.pi / 2, ANGLES)[1:]
    density = np.exp(-(level**2) / (1 + np.sin(angles))) / (2 * math.pi)
    steps = np.diff(angles) * (density[1:] + density[:-1]) / 2
    total = np.concatenate([[0], np.cumsum(steps)])
    return total - np.interp(0, angles, total), np.sin(angles)


def _shells(shape: tuple[int, ...]) -> np.ndarray:
    """Return the lengths, rounded, of the offsets or frequencies of a box that repeats."""
    axes = [np.minimum(np.arange(n), n - np.arange(n)) for n in shape]
    return np.rint(np.sqrt(axes[0][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[2] ** 2.0)).astype(int)


def _means(values: np.ndarray, shells: np.ndarray) -> np.ndarray:
    """Return the means of values over shells."""
    return np.bincount(shells.ravel(), values.ravel()) / np.bincount(shells.ravel())
