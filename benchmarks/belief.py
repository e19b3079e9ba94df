"""The test of a law: how often it rejects shapes of the model, and how often what only looks like them.

Shapes of stores (`--shapes STORE…`), of laws that neither posterior nor discriminants have seen, are asked for as
masks cut open and as images of five qualities; so are their level cuts, as masks: cuts of a Gaussian field with the
same volume fraction and two-point function, which no law made. The p of each is as `infer` states it
(`estimate_law`). `size` is the part of shapes with p below .05, `power` that of level cuts. `left_out` is the part of
textures of a kind that is ruled out where only the other kinds were learned from, by the discriminant alone.

`--teach FILE` writes the packaged posterior, or that of `--posterior`, with what tells shapes of the model from
textures of no law: level cuts, walls of cells, grains, trees of tubes, fibres, `--textures` of each, and such level
cuts of the shapes that `reading` grows by `fast` and by `paper`. They are described once, into
`benchmarks/results/textures.npz`, kind by kind in turn, the last cuts last.
"""

from __future__ import annotations

import argparse
import math
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from scipy import ndimage, optimize, stats

from benchmarks import reading
from benchmarks.harness import RESULTS, Cases, Figure, Values, show, write_whole
from benchmarks.teaching import VIEWS, gather
from curvafit.data_synth.store import Store, find_well_formed
from curvafit.geometry.description import BLOCKS
from curvafit.inference.candidates import Misfit, join_tests
from curvafit.inference.estimate import estimate_law, measure_descriptors, tail_probability
from curvafit.inference.posterior import Discriminant, Posterior, load_posterior
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.scan.preparation import prepare
from curvafit.volumes.volume import ScanError, Volume
from examples.mixed import KINDS
from examples.train import Scanned, Table, keep_laws, measure_view, save_posterior, see_mask, see_scan

SEED, TEXTURES = 7, RESULTS / "textures.npz"


def see_grains(u: np.ndarray, rng: np.random.Generator) -> Scanned:
    """Return {u > 0}, cut open at random, as an image blurred by 1.5 voxels whose noise is correlated as far."""
    scan, kind, periodic = see_scan(u, rng, blur=1.5, thick=1, snr=math.inf)
    noise = ndimage.gaussian_filter(rng.standard_normal(scan.values.shape), 1.5, mode="wrap")
    grey = scan.values + (0.06 / noise.std()) * noise
    return Scanned(Volume(grey.astype(np.float32), scan.spacing, scan.unit), kind, periodic)


#: Ways in which shapes are seen: a mask, and images by blur and slices in voxels, and signal over noise.
SEEN: dict[str, Callable[[np.ndarray, np.random.Generator], Scanned]] = {
    "mask": see_mask,
    "good": partial(see_scan, blur=0.7, thick=1, snr=20.0),
    "blurred": partial(see_scan, blur=1.5, thick=1, snr=20.0),
    "sliced": partial(see_scan, blur=1.0, thick=2, snr=20.0),
    "grainy": see_grains,
    "bad": see_scan,
}
#: Angles at which the integral of `cut_covariance` is tabulated.
ANGLES = 4001
#: Part of the mean variance of a column that is added to each, where a discriminant is learned.
RIDGE = 0.1


# ---- what tells textures of no law -----------------------------------------------------------------------------------


def describe_textures(count: int, cases: Cases) -> np.ndarray:
    """Return the descriptors `(views, n, 351)` of so many textures of each kind; NaN where one cannot be read."""
    if not TEXTURES.exists():
        rows = [cases.array(f"{kind}-{k}", partial(_describe, kind, k)) for k, kind in product(range(count), KINDS)]
        grown = product(("fast", "paper"), (*reading.LAWS, *reading.DRAWN))
        rows += [cases.array(f"cut-{by}-{name}", partial(_describe_cut, name, by, cases)) for by, name in grown]
        write_whole(TEXTURES, partial(np.savez_compressed, descriptors=np.stack(rows, 1).astype(np.float16)))
    with np.load(TEXTURES) as file:
        return file["descriptors"].astype(np.float32)


def _describe(kind: str, number: int) -> np.ndarray:
    texture = KINDS[kind](np.random.default_rng([SEED, *kind.encode(), number]))
    texture = texture if (texture > 0).mean() <= 0.5 else -texture
    return np.array([measure_view(texture, view, number)[0] for view in VIEWS])


def _describe_cut(name: str, by: str, cases: Cases) -> np.ndarray:
    mask = reading.grow(name, by, cases.of("reading"))
    if mask.all() or not mask.any():
        return np.full((len(VIEWS), sum(BLOCKS.values())), np.nan)
    cut = level_cut(mask, Grid(mask.shape), 1)
    return np.array([measure_view(cut, view, 1)[0] for view in VIEWS])


def teach(posterior: Posterior, table: Table, textures: np.ndarray) -> Posterior:
    """Return a posterior with Fisher's discriminants of a table's shapes and of textures `(views, n, 351)`."""
    table, found = table.visible.pooled, {}
    kept = keep_laws(table, posterior.provenance["seed"])
    plain = replace(posterior.compression, basis=np.eye(len(posterior.compression.mean)))
    for view, others in zip(VIEWS, textures, strict=True):
        in_view = table.views == view
        both = plain(table.rows(in_view & ~kept).descriptors), plain(others[np.isfinite(others).all(1)])
        variance = sum(np.cov(rows.T, bias=True) for rows in both) / 2
        ridge = RIDGE * np.diag(variance).mean() * np.eye(len(variance))
        weights = np.linalg.solve(variance + ridge, both[0].mean(0) - both[1].mean(0)).astype(np.float32)
        reference = posterior.discriminate(table.rows(in_view & kept).descriptors, weights)
        found[view] = Discriminant(weights, np.sort(reference))
    return replace(posterior, discriminants=found)


def leave_out(posterior: Posterior, table: Table, textures: np.ndarray) -> dict[str, Figure]:
    """Return which part of the textures of each kind is ruled out by a discriminant that learned from the others."""
    # the last cuts are a kind of their own
    count = textures.shape[1] - 2 * len((*reading.LAWS, *reading.DRAWN))
    kind, figures = np.where(np.arange(textures.shape[1]) < count, np.arange(textures.shape[1]) % len(KINDS), -1), {}
    for number, name in enumerate(KINDS):
        fishers = teach(posterior, table, textures[:, kind != number]).discriminants
        for view, asked in zip(VIEWS, textures[:, kind == number], strict=True):
            values = posterior.discriminate(asked[np.isfinite(asked).all(1)], fishers[view].weights)
            rows = [{"p": join_tests(1.0, tail_probability(-fishers[view].reference, -value))} for value in values]
            figures[f"left_out.{name.replace(' ', '_')}.{view}"] = reading.part_below(rows)
    return figures


# ---- size and power --------------------------------------------------------------------------------------------------


def case(posterior: Posterior, store: Store, index: int, seen: str, cut: bool) -> Values:
    """Return the p of a shape, or of its level cut, as it is seen."""
    field, random = store.field(index), np.random.default_rng([SEED, index, zlib.crc32(seen.encode())])
    scan, kind, _ = SEEN[seen](level_cut(field > 0, Grid(field.shape), index) if cut else field, random)
    try:
        misfit = ask(posterior, scan, kind)
    except ScanError:
        misfit = None
    if misfit is None:
        return {}
    return {"p": misfit.probability, "unexplained": misfit.unexplained, "discriminant": misfit.discriminant}


def ask(posterior: Posterior, scan: object, kind: str) -> Misfit | None:
    """Return the misfit of a scan as `infer` states it; None where it cannot be read."""
    described = measure_descriptors(prepare(scan, kind=kind, one_scale=True))  # type: ignore[arg-type]
    return None if described is None else estimate_law(described, posterior, 0).misfit


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shapes", type=Path, nargs="*", default=[], help="stores of laws that no choice has seen")
    parser.add_argument("--textures", type=int, default=40, help="textures of each kind to learn from")
    parser.add_argument("--posterior", type=Path, help="posterior to teach, instead of the packaged one")
    parser.add_argument("--teach", type=Path, help="write the posterior, taught, to this file")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    posterior, figures = load_posterior(options.posterior), dict[str, Figure]()
    if options.teach is not None:
        lessons = (gather(), describe_textures(options.textures, cases))
        figures |= leave_out(posterior, *lessons)
        posterior = teach(posterior, *lessons)
        save_posterior(posterior, options.teach)
    for path in options.shapes:
        shapes = find_well_formed((path,))[: 1 if options.quick else None]
        edge = shapes[0][0].settings.shape[0]
        for title, cut in (("size", False), ("power", True)):
            for seen in ("mask",) if cut else SEEN:
                names = {f"{edge}-{title}-{seen}-{index}": (store, index) for store, index in shapes}
                jobs = {name: partial(case, posterior, *each, seen, cut) for name, each in names.items()}
                figures[f"belief.{title}_{seen}.{edge}"] = reading.part_below(list(cases.all(jobs, SEED).values()))
    show(["part ruled out", ""], list(figures.items()))
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
