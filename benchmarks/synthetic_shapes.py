"""Four kinds of shapes to train on: straight tubes, Gaussian level cuts, the packaged atlas, inferred textures.

All are phase fields on cubic voxels of `EDGE` µm. The first two have the volume fraction and the mean thickness of the
last, so that they differ in shape alone; the atlas's shapes are as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.progress import track
from torch import Tensor

from curvafit.data_synth.degrade import sample
from curvafit.data_synth.randomness import correlated
from curvafit.data_synth.sources import Generated
from curvafit.index import load_atlas
from curvafit.morphometry import local_thickness
from curvafit.priors import read_fit
from curvafit.priors.grid import Grid
from curvafit.priors.profile import optimal_profile, phase_field

KINDS = ("tubes", "cuts", "atlas", "inferred")
#: Edge of a voxel in µm, voxels of a field, the profile's ε in voxels, fields of a kind.
EDGE, BOX, EPSILON, COUNT = 0.994, (72, 96, 96), 2.0, 16
#: Spread of the straight tubes' radii: standard deviation of their logarithm.
SPREAD = 0.25


def fields(kind: str, fit: Path, folder: Path, count: int = COUNT) -> np.ndarray:
    """Phase fields `(N, Z, Y, X)` of a kind, made once; `fit` is the fit.json of the inferred ones."""
    path = folder / f"{kind}-{fit.stem}-{count}.npy"
    if not path.exists():
        make: dict[str, Callable[[], np.ndarray]] = {
            "inferred": lambda: inferred(fit, count),
            "atlas": lambda: from_atlas(count),
            "tubes": lambda: tubes(*measures(fields("inferred", fit, folder, count)), count),
            "cuts": lambda: cuts(*measures(fields("inferred", fit, folder, count)), count),
        }
        made = make[kind]()
        np.save(path, made)
    return np.load(path)


def inferred(fit: Path, count: int) -> np.ndarray:
    """Textures with inferred coefficients, at their own scale."""
    found = read_fit(fit)
    if found.unit != "um":
        raise ValueError(f"expected a fit in um, got {found.unit}")
    source = Generated(((*map(float, found.coefficients), found.mass),), ("inferred",))  # type: ignore[arg-type]
    voxels = [int(np.ceil(n * EDGE / found.working_voxel)) for n in BOX]
    return np.stack([resampled(shape(source, voxels, k), found.working_voxel) for k in track(range(count), "inferred")])


def from_atlas(count: int) -> np.ndarray:
    """Shapes of the packaged atlas, chosen at random and grown anew in a larger box; a working voxel is a voxel."""
    atlas = load_atlas()
    chosen = np.random.default_rng(0).permutation(len(atlas))[:count]
    points = tuple((*map(float, atlas.coefficients[k]), float(atlas.masses[k])) for k in chosen)
    source = Generated(points, tuple(atlas.ids[k] for k in chosen))
    return np.stack([shape(source, BOX, k) for k in track(range(count), "atlas")])


def tubes(fraction: float, radius: float, count: int) -> np.ndarray:
    """Straight cylinders through random points in random directions until they hold the fraction."""
    return np.stack([_tubes(fraction, radius, np.random.default_rng(k)) for k in range(count)])


def cuts(fraction: float, radius: float, count: int) -> np.ndarray:
    """Level sets of Gaussian random fields; their correlation's length is the one that gives the mean radius."""
    length = 4.0 * radius
    for _ in range(3):
        length *= radius / measures(np.stack([_cut(fraction, length, k) for k in range(3)]))[1]
    return np.stack([_cut(fraction, length, k) for k in range(count)])


def measures(shapes: np.ndarray) -> tuple[float, float]:
    """Volume fraction, and mean radius of the largest balls inside, in voxels."""
    radii = [local_thickness(u > 0, 1.0)[u > 0].mean() / 2 for u in shapes[:6]]
    return float((shapes > 0).mean()), float(np.mean(radii))


def shape(source: Generated, voxels: list[int] | tuple[int, ...], k: int) -> np.ndarray:
    return source.shape(voxels, k, np.random.default_rng(k)).field


def resampled(field: np.ndarray, edge: float) -> np.ndarray:
    """A field of voxels of `edge` µm on those of `EDGE`."""
    u = sample(torch.from_numpy(field)[None, None], edge, (EDGE,) * 3)[0, 0]
    return u[: BOX[0], : BOX[1], : BOX[2]].numpy()


def _tubes(fraction: float, radius: float, rng: np.random.Generator) -> np.ndarray:
    places = torch.stack(torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in BOX), indexing="ij"), -1)
    depth = torch.full(BOX, -np.inf)
    while float((depth > 0).float().mean()) < fraction:
        point = torch.from_numpy(rng.uniform(0, BOX)).float()
        direction = torch.from_numpy(rng.normal(size=3)).float()
        direction /= direction.norm()
        across = places - point
        across = across - (across @ direction)[..., None] * direction
        size = radius * float(np.exp(SPREAD * rng.normal()))
        depth = torch.maximum(depth, size - across.norm(dim=-1))
    return optimal_profile(depth, EPSILON).numpy()


def _cut(fraction: float, length: float, seed: int) -> np.ndarray:
    values: Tensor = correlated(torch.zeros(1, 1, *BOX), (length,) * 3, [seed], "cut")[0, 0]
    level = np.quantile(values.numpy(), 1 - fraction)
    return phase_field(values > float(level), Grid(BOX, (1.0,) * 3, "replicate"), EPSILON).numpy()
