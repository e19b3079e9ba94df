"""Four kinds of shapes to train on: straight tubes, Gaussian level cuts, the packaged atlas, inferred textures.

All are phase fields in cubes of `EXTENT` µm, on working voxels of the inferred texture. That is grown as dense as the
scan's structure, as near as it gets; tubes and cuts fill the same share of the volume as it and have its mean
thickness; the atlas's shapes fill the same share within `NEAR`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np
import torch
from rich.progress import track
from torch import Tensor

from curvafit.core.files import write_atomically
from curvafit.data_synth.imaging.randomness import correlated
from curvafit.data_synth.sets.sources import Generated
from curvafit.generation.flow import generate
from curvafit.generation.schedule import LEARNED
from curvafit.generation.viability import well_formed
from curvafit.geometry.diagram import diagram
from curvafit.geometry.morphometry import local_thickness
from curvafit.geometry.transport import wasserstein
from curvafit.inference.atlas import load_atlas
from curvafit.inference.candidates import Candidate
from curvafit.inference.fit import Fit
from curvafit.priors import Prior, read_fit
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import optimal_profile, phase_field

KINDS = ("tubes", "cuts", "atlas", "inferred")
#: Edge of the cubes in µm, the profile's ε in voxels.
EXTENT, EPSILON = 84.0, 2.0
#: Edge, in voxels, of the shapes that candidates are judged by.
TRIED = 80
#: Spread of the straight tubes' radii: standard deviation of their logarithm.
SPREAD = 0.25
#: How far an atlas's shape may be from the inferred textures' share of the volume, relatively.
NEAR = 0.15


def fields(kind: str, fit: Path, folder: Path, count: int) -> np.ndarray:
    """Phase fields `(N, E, E, E)` of a kind, made once; `fit` is the fit.json of the inferred ones."""
    digest = hashlib.sha256(fit.read_bytes()).hexdigest()[:8]
    path = folder / f"{kind}-{fit.stem}-{digest}-{count}.npy"
    if not path.exists():
        found = law(fit)
        make: dict[str, Callable[[], np.ndarray]] = {
            "inferred": lambda: inferred(found, count),
            "atlas": lambda: from_atlas(found, share(fields("inferred", fit, folder, count)), count),
            "tubes": lambda: alike(_tubes, fields("inferred", fit, folder, count), count),
            "cuts": lambda: alike(_cut, fields("inferred", fit, folder, count), count),
        }
        made = make[kind]()
        told = f"share of the volume {share(made):.4f}, radius {radius(made):.2f} voxels"
        print(f"{path.stem}: {told}", flush=True)
        write_atomically(path, lambda temporary: np.save(temporary, made))
    return np.load(path)


def nearest_at_its_density(fit: Fit) -> Fit:
    """The fit that chooses, of its candidates and matches, the law whose shapes lie nearest to the scan when
    they fill as much of the volume as it does: a match is sought by curvature alone, whatever its density."""
    grid, found = Grid((TRIED, TRIED, TRIED)), []
    matches = (Candidate(match.id, match.coefficients, match.mass, {}) for match in fit.matches)
    for each in (*fit.candidates, *matches):
        share = fit.morphometry.volume_fraction
        flow = generate(each.coefficients, None, grid, volume_fraction=share, schedule=LEARNED, reject_early=True)
        if well_formed(flow.viability):
            seen = diagram(phase_field(flow.field > 0, grid, WORKING_EPSILON), grid, WORKING_EPSILON)
            found.append((wasserstein(fit.diagram, seen), each))  # type: ignore[arg-type]
    best, chosen = min(found, key=itemgetter(0))
    print(f"distances at the scan's density: {[round(each, 1) for each, _ in found]}, the least {best:.1f}", flush=True)
    candidates = {each.name: each for each in (*fit.candidates, chosen)}
    return replace(fit, candidates=tuple(candidates.values()), chosen=chosen.name)


def law(fit: Path) -> Prior:
    found = read_fit(fit)
    if found.unit != "um" or found.volume_fraction is None:
        raise ValueError(f"expected a fit in um with a volume fraction, got {found.unit}, {found.volume_fraction}")
    return found


def box(found: Prior) -> tuple[int, int, int]:
    edge = int(np.ceil(EXTENT / found.working_voxel))
    return edge, edge, edge


def inferred(found: Prior, count: int) -> np.ndarray:
    """Textures with inferred coefficients."""
    source = Generated(((*map(float, found.coefficients), found.mass),), ("inferred",), fraction=found.volume_fraction)
    return np.stack([shape(source, found, k) for k in track(range(count), "inferred")])


def from_atlas(found: Prior, wanted: float, count: int) -> np.ndarray:
    """Shapes of the packaged atlas's parameters, chosen at random; those that cannot be so thin are passed over."""
    atlas, made = load_atlas(), []
    for k in np.random.default_rng(0).permutation(len(atlas)):
        point = (*map(float, atlas.coefficients[k]), float(atlas.masses[k]))
        try:
            one = shape(Generated((point,), (atlas.ids[k],), fraction=wanted), found, int(k))
        except ValueError:
            continue
        if abs(share(one) - wanted) > NEAR * wanted:
            continue
        made.append(one)
        print(f"atlas: {len(made)} of {count}", flush=True)
        if len(made) == count:
            break
    return np.stack(made)


def alike(draw: Callable[[tuple[int, ...], float, float, int], np.ndarray], like: np.ndarray, count: int) -> np.ndarray:
    """Shapes that fill the share of others and have their mean radius."""
    fraction, wanted, edges = share(like), radius(like), like.shape[1:]

    def drawn(size: float, count: int) -> np.ndarray:
        return np.stack([draw(edges, fraction, size, k) for k in range(count)])

    size = wanted
    for _ in range(3):
        size *= wanted / radius(drawn(size, 6))
    return drawn(size, count)


def share(shapes: np.ndarray) -> float:
    return float((shapes > 0).mean())


def radius(shapes: np.ndarray) -> float:
    """Mean radius of the largest balls inside, in voxels."""
    return float(np.mean([local_thickness(u > 0, (1.0, 1.0, 1.0))[u > 0].mean() / 2 for u in shapes[:6]]))


def shape(source: Generated, found: Prior, k: int) -> np.ndarray:
    return source.shape(box(found), 0, np.random.default_rng(k)).values


def _tubes(edges: tuple[int, ...], fraction: float, size: float, seed: int) -> np.ndarray:
    """Straight cylinders through random points in random directions, made thinner by the little that the last is over
    the fraction."""
    rng = np.random.default_rng(seed)
    places = torch.stack(torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in edges), indexing="ij"), -1)
    depth = torch.full(edges, -np.inf)
    while float((depth > 0).float().mean()) < fraction:
        point = torch.from_numpy(rng.uniform(0, edges)).float()
        direction = torch.from_numpy(rng.normal(size=3)).float()
        direction /= direction.norm()
        across = places - point
        across = across - (across @ direction)[..., None] * direction
        own = size * float(np.exp(SPREAD * rng.normal()))
        depth = torch.maximum(depth, own - across.norm(dim=-1))
    return optimal_profile(depth - float(np.quantile(depth.numpy(), 1 - fraction)), EPSILON).numpy()


def _cut(edges: tuple[int, ...], fraction: float, size: float, seed: int) -> np.ndarray:
    """A level set of a Gaussian random field."""
    values: Tensor = correlated(torch.zeros(1, 1, *edges), (4 * size,) * 3, [seed], "cut")[0, 0]
    level = np.quantile(values.numpy(), 1 - fraction)
    return phase_field(values > float(level), Grid(edges, (1.0, 1.0, 1.0), "replicate"), EPSILON).numpy()
