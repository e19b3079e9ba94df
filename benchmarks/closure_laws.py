"""The law that each method reads from a view of a shape, for `benchmarks.closure_regrown`.

- posterior: of 400 draws the one nearest to their medians, as `infer` grows it. optimum: the emulator's best fit.
- refined: by simulations chosen one after another, after `SIMULATIONS` of the draws, as `infer` does; they are seen
  through the query's view.
- stationarity (fields alone): from the posterior's middle and the three nearest shapes, as `infer` starts it.
- match: the packaged atlas's shape whose curvature diagram is nearest.
- point match, point posterior: the fixed point of a short flow (`inference.fixed_point`), started at these two. Its
  mass is the phase field's mean.
- synthetic: a synthetic likelihood of distances between patterns, after Kazarnikov and Haario (2020) and Kazarnikov,
  Scheichl, Haario and Marciniak-Czochra (2023), as a pilot search over `LAWS` laws, those of the atlas's shapes nearest
  to the query's mask, of each of which `SHAPES` shapes are grown. Distances are Euclidean, of three things apart:
  curvature block, volume fraction, two-point function. A shape's vector holds the parts of its distances to the others
  of its law that are below the quantiles `LEVELS` of all distances within laws and to the query; the query's vector,
  those of its distances to a law's shapes. The law of the greatest normal density is taken, by its own mean and a
  covariance that laws share: the pooled scatter of the shapes' vectors, and the rounding of counts.
- literal: the paper's proposal to minimise F_ε[query; a, m₀] over the parameters. F_ε is linear in a, and so falls for
  ever: cut at the posterior's box, with a20 = 1, its minimum is a corner. The mass is the phase field's mean, which is
  the constraint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from curvafit.generation.flow import generate
from curvafit.generation.schedule import LEARNED
from curvafit.geometry.descriptors import Descriptors, descriptors
from curvafit.geometry.diagram import Diagram, diagram
from curvafit.geometry.mesh import NoSurface
from curvafit.inference.atlas import load_atlas
from curvafit.inference.check import STARTS
from curvafit.inference.draws import Draws
from curvafit.inference.emulator import optimum
from curvafit.inference.estimate import DRAWS, POOL, SIMULATIONS
from curvafit.inference.fixed_point import fixed_point
from curvafit.inference.infer import STARTS as MATCHES
from curvafit.inference.match import Match, nearest
from curvafit.inference.posterior import Posterior
from curvafit.inference.sequential import Search
from curvafit.inference.simulation import simulations
from curvafit.inference.stationarity import stationarity
from curvafit.inference.table import column_names, law_of, parameters_of
from curvafit.inference.views import VIEWS, View
from curvafit.priors.curvature import jet
from curvafit.priors.energy import energy_terms
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import phase_field
from curvafit.volumes.scan import ScanError

#: Laws that the synthetic likelihood compares, shapes grown from each, and levels at which distances are counted.
LAWS, SHAPES = 8, 6
LEVELS = (0.2, 0.4, 0.6, 0.8)
#: Blocks of descriptors between which it takes distances.
NORMS = ("curvature", "fraction", "correlation")
#: Least grown shapes of a law that it may choose.
FEWEST = 3


class Sight(NamedTuple):
    """A shape through a view: the view's name, what it shows, its phase field and curvature diagram."""

    name: str
    seen: View
    phase: torch.Tensor
    diagram: Diagram


def sight(field: np.ndarray, grid: Grid, name: str, seed: int) -> Sight | None:
    """See a phase field, which repeats, through a view; None where that shows no surface."""
    try:
        seen = VIEWS[name](field, grid, np.random.default_rng(seed))
        shape = torch.from_numpy(seen.shape)
        phase = phase_field(shape, seen.grid, WORKING_EPSILON) if shape.dtype == torch.bool else shape
        return Sight(name, seen, phase, diagram(phase, seen.grid, WORKING_EPSILON))
    except (ScanError, NoSurface):
        return None


@dataclass(frozen=True, eq=False)
class Query:
    """A shape to read a law from.

    Attributes
    ----------
    sight
        The shape through a view.
    parameters
        `(6,)`: what it was grown from, for `truth` alone.
    posterior
        For the methods that read descriptors.
    clouds
        Files of shapes of other laws, for `synthetic`: `parameters`, and by view their rows of descriptors `(n, 351)`.
    box
        In which shapes are grown.
    """

    sight: Sight
    parameters: np.ndarray
    posterior: Posterior
    clouds: Sequence[Path]
    box: Grid

    @cached_property
    def row(self) -> np.ndarray:
        return descriptors(*self.sight.seen).vector()

    @cached_property
    def draws(self) -> np.ndarray:
        return self.posterior.sample(self.row, self.sight.name, DRAWS)

    @cached_property
    def refined(self) -> np.ndarray:
        """The law that simulations refine."""

        def simulate(parameters: np.ndarray, seed: int) -> Descriptors | None:
            flow = generate(*law_of(parameters), self.box, seed=seed, schedule=LEARNED, reject_early=True)
            seen = sight(flow.field.numpy(), self.box, self.sight.name, seed) if flow.viability.viable else None
            try:
                return None if seen is None else descriptors(*seen.seen)
            except NoSurface:
                return None

        search = Search(self.posterior.emulator, self.sight.name, self.row)
        pool = self.posterior.sample(self.row, self.sight.name, POOL)
        return search.parameters(pool, simulations(self.draws, simulate, SIMULATIONS), simulate)[0]


def truth(query: Query) -> np.ndarray:
    return query.parameters


def posterior(query: Query) -> np.ndarray:
    return Draws.of(query.draws, query.sight.name, "").middle(np.ptp(query.draws, axis=0))


def best(query: Query) -> np.ndarray:
    return optimum(query.posterior.emulator, query.row, query.sight.name, query.draws[:STARTS]).parameters


def refined(query: Query) -> np.ndarray:
    return query.refined


def by_stationarity(query: Query) -> np.ndarray:
    starts = [law_of(posterior(query))[0], *(each.coefficients for each in matches(query, MATCHES))]
    refined = stationarity(query.sight.phase, query.sight.seen.grid, WORKING_EPSILON, starts=starts)
    return parameters_of(refined.coefficients, refined.mass)


def match(query: Query) -> np.ndarray:
    (first,) = matches(query, 1)
    return parameters_of(first.coefficients, first.mass)


def matches(query: Query, count: int) -> tuple[Match, ...]:
    seen_as = "field" if query.sight.name == "field" else "mask"
    return nearest(query.sight.diagram, packaged_atlas(), seen_as=seen_as, count=count)


packaged_atlas = cache(load_atlas)


def point(start: Callable[[Query], np.ndarray], query: Query) -> np.ndarray:
    """The fixed point of a short flow from a method's law."""
    law, _ = law_of(start(query))
    refined = fixed_point(query.sight.phase, query.sight.seen.grid, WORKING_EPSILON, starts=[law])
    return parameters_of(refined.coefficients, refined.mass)


def literal(query: Query) -> np.ndarray:
    """The corner of the box where F_ε of the query is least."""
    grid = query.sight.seen.grid
    terms = energy_terms(jet(query.sight.phase.double(), grid), WORKING_EPSILON).sum((-3, -2, -1)).numpy()
    low, high = query.posterior.box.T
    return np.append(np.where(terms[1:] > 0, low[:-1], high[:-1]), float(query.sight.phase.double().mean()))


def synthetic(query: Query) -> np.ndarray:
    """The law, of those whose shapes are in files, of the greatest synthetic likelihood."""
    contents = [np.load(path) for path in query.clouds]
    clouds = [content[query.sight.name] for content in contents]
    scores = synthetic_scores(query.row, [cloud[np.isfinite(cloud).all(1)] for cloud in clouds], norms())
    return contents[int(np.argmax(scores))]["parameters"]


def norms() -> list[np.ndarray]:
    names = np.array(column_names())
    return [np.flatnonzero(names == name) for name in NORMS]


def synthetic_scores(query: np.ndarray, clouds: Sequence[np.ndarray], norms: Sequence[np.ndarray]) -> np.ndarray:
    """Logarithms `(L,)`, but for a constant, of the densities of a row `(d,)` by laws of which rows `(n, d)` are known.

    `norms` are the columns between which distances are taken, each apart. A law of fewer than `FEWEST` rows has -inf.
    """
    known = [k for k, cloud in enumerate(clouds) if len(cloud) >= FEWEST]
    within = {k: [_apart(clouds[k][:, columns]) for columns in norms] for k in known}
    across = {k: [np.linalg.norm(clouds[k][:, c] - query[c], axis=1) for c in norms] for k in known}
    every = [np.concatenate([np.append(within[k][n].ravel(), across[k][n]) for k in known]) for n in range(len(norms))]
    radii = [np.quantile(each, LEVELS) for each in every]
    vectors = {k: _below(np.stack(within[k], 1), radii) for k in known}
    scatter = sum((v - v.mean(0)).T @ (v - v.mean(0)) for v in vectors.values())
    counts = np.array([len(v) for v in vectors.values()])
    covariance = scatter / (counts - 1).sum() + np.eye(len(radii) * len(LEVELS)) / (12 * np.square(counts - 1).mean())
    scores = np.full(len(clouds), -np.inf)
    for k in known:
        away = _below(np.stack(across[k])[None], radii)[0] - vectors[k].mean(0)
        scores[k] = -away @ np.linalg.solve(covariance, away) / 2
    return scores


def _apart(rows: np.ndarray) -> np.ndarray:
    """Return the distances `(n, n - 1)` of each row to the others."""
    distances = np.linalg.norm(rows[:, None] - rows, axis=-1)
    return distances[~np.eye(len(rows), dtype=bool)].reshape(len(rows), -1)


def _below(distances: np.ndarray, radii: Sequence[np.ndarray]) -> np.ndarray:
    """Return, of distances `(n, norms, k)`, the parts below the radii of each norm, `(n, norms · levels)`."""
    parts = [(distances[:, n, :, None] < each).mean(1) for n, each in enumerate(radii)]
    return np.concatenate(parts, axis=1)
