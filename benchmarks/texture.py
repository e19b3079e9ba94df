"""Textures of the default schedule against the published one's, and against the author's volumes.

For each preset, by geometric curvature diagrams: `noise`, the mean distance between two seeds of `paper`; `bias`, the
distance between the pooled diagrams of `fast` and of `paper` (all seeds' surfaces together), over the noise, some
0.6 between twice three shapes of one schedule; `author`, where $CURVAFIT_DATA has the author's volume of the preset,
√(d² - noise²) / noise of the mean distance d of our seeds to it, and the noise between the schedule's own seeds (two
draws of one law are a noise apart, so 0 is no fault). Where the author's file is floored to 1/100 our fields are too.
`--first` is the first seed: choose a schedule on some, report it on others.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import Cases, Figure, Values, show
from curvafit.generation.flow import generate
from curvafit.generation.schedule import SCHEDULES
from curvafit.geometry.diagrams import Diagram, diagram
from curvafit.geometry.distances import wasserstein
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.law import preset_name

#: Tubes of three kinds, layers, spheres of two kinds, sponges of two kinds, trabeculae, metatubes, the paper's flow.
PRESETS = (
    "tubes", "seeds", "bilinear-tubes", "bilayers", "bilinear-spheres", "pearls", "sponge", "sieve", "trabec",
    "metatubes", "flow",
)  # fmt: skip
#: The author's volumes: 100³.
EDGE = 100


def author_volumes() -> dict[str, Path]:
    """Return the author's files by preset."""
    folder = Path(os.environ.get("CURVAFIT_DATA", "")) / "gallery"
    names = {path: preset_name(path.name.partition(" coeffs")[0]) for path in sorted(folder.glob("*coeffs*.nii.gz"))}
    return {name: path for path, name in names.items() if name is not None}


def author_field(name: str) -> torch.Tensor:
    from curvafit.volumes.read import load

    return torch.from_numpy(load(author_volumes()[name]).values.astype(np.float32))


def load(name: str, schedule: str, seed: int, edge: int) -> torch.Tensor:
    """Return a grown field, rounded down to 1/100 where the author's is."""
    u = generate(name, grid=Grid((edge,) * 3), schedule=schedule, seed=seed).field
    hundred = 100 * author_field(name) if edge == EDGE and name in author_volumes() else u
    return torch.floor(100 * u) / 100 if bool((hundred - hundred.round()).abs().max() < 1e-3) else u


def diagram_of(name: str, schedule: str, seed: int, edge: int, cases: Cases) -> Diagram:
    """Return the diagram of a grown shape, from its file where it is there."""

    def make() -> np.ndarray:
        found = diagram(load(name, schedule, seed, edge), Grid((edge,) * 3), WORKING_EPSILON)
        return np.column_stack([found.points, found.weights])

    plan = hashlib.sha256(repr(SCHEDULES[schedule]).encode()).hexdigest()[:8]
    table = cases.array(f"{name}-{schedule}-{plan}-{edge}-{seed}", make)
    return Diagram(table[:, :2], table[:, 2])


def seed_noise_of(diagrams: list[Diagram]) -> float:
    """Return the mean distance between two seeds."""
    return float(np.mean([wasserstein(a, b) for a, b in combinations(diagrams, 2)]))


def pooled(diagrams: list[Diagram]) -> Diagram:
    parts = [each.normalised for each in diagrams]
    return Diagram(np.concatenate([d.points for d in parts]), np.concatenate([d.weights for d in parts]))


def compare(name: str, seeds: range, edge: int, cases: Cases) -> Values:
    """Compare shapes by `fast` with those by `paper`, and with the author's volume."""
    paper, other = ([diagram_of(name, plan, seed, edge, cases) for seed in seeds] for plan in ("paper", "fast"))
    found = {"noise": seed_noise_of(paper), "own_noise": seed_noise_of(other)}
    found["bias"] = wasserstein(pooled(other), pooled(paper)) / found["noise"]
    if edge == EDGE and name in author_volumes():
        author = diagram(author_field(name), Grid((EDGE,) * 3), WORKING_EPSILON)
        for key, mine, noise in (("paper", paper, found["noise"]), ("excess", other, found["own_noise"])):
            distance = float(np.mean([wasserstein(author, each) for each in mine]))
            found[key] = math.sqrt(max((distance / noise) ** 2 - 1, 0))
    return {key: float(value) for key, value in found.items()}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--first", type=int, default=10)


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    names, edge, count = (("tubes",), 32, 2) if options.quick else (PRESETS, EDGE, 3)
    first = options.first
    jobs = {f"{n}-{edge}-{first}-{count}": partial(compare, n, range(first, first + count), edge, cases) for n in names}
    found = cases.all(jobs, first)
    keys = ("noise", "bias", "paper", "excess")
    show(["preset", "noise", "bias / noise", "author: paper", "author: fast"],
         [[name, *(row.get(key, "") for key in keys)] for name, row in found.items()])  # fmt: skip
    within = {key: float(sum(row.get(key, 2) <= 1 for row in found.values())) for key in keys[1:]}
    if first == 20:
        return {"author_fresh.within": Figure(within["excess"])}
    if len(found) < len(PRESETS):
        return {}
    most = max(row["bias"] for row in found.values())
    return {"texture.within": Figure(within["bias"]), "texture.most": Figure(most),
            "author.paper": Figure(within["paper"]), "author.fast": Figure(within["excess"])}  # fmt: skip
