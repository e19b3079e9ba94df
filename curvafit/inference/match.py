"""The shapes of an atlas whose diagrams are nearest to a given one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from curvafit.geometry.diagram import Diagram
from curvafit.geometry.pairwise import one_to_many
from curvafit.geometry.transport import sliced_embedding
from curvafit.inference.atlas import Atlas
from curvafit.priors.coefficients import Coefficients


@dataclass(frozen=True)
class Match:
    """An atlas shape: its id, the Wasserstein distance of its diagram to the query's (1 / working unit), and the
    parameters that made it (coefficients in working units, mass m₀, noise seed)."""

    id: str
    distance: float
    coefficients: Coefficients
    mass: float
    seed: int


def mirrored(match: Match) -> Match:
    """Return a match's shape with inside and outside exchanged, in the gauge a20 = 1."""
    six = match.coefficients.mirrored()
    return replace(match, coefficients=six.scaled(1 / float(six.a20)), mass=-match.mass)


def nearest(
    diagram: Diagram, atlas: Atlas, *, seen_as: str = "field", count: int = 5, shortlist: int = 40
) -> tuple[Match, ...]:
    """Return the `count` shapes nearest to a diagram, nearest first.

    Distances are those of `curvafit.geometry.pairwise`, taken on the `shortlist` shapes nearest in sliced distance.

    Parameters
    ----------
    diagram
        The query's geometric diagram, in 1 / working unit.
    atlas
        Where to search; see `curvafit.inference.atlas.load_atlas`.
    seen_as
        What the query was measured on, `"field"` or `"mask"`: it is compared with diagrams of the same kind.
    count
        How many; all of them where the atlas has fewer.
    shortlist
        How many exact distances to take; at least `count` are. Among 430 diagrams, 10 held the nearest in 99 % and 20
        always; all of the nearest five were among 20 in 99 %, among 40 in 99.95 % (`benchmarks.distances --match`).

    Raises
    ------
    ValueError
        If `count` or `shortlist` is not positive, `seen_as` is another word, or the diagram has no area.
    """
    if count < 1 or shortlist < 1:
        raise ValueError(f"expected a count and a shortlist of at least 1, got {count} and {shortlist}")
    candidates = atlas.diagrams(seen_as)
    if not float(diagram.weights.sum()) > 0:
        raise ValueError("expected a diagram with area, got an empty one")
    near = _shortlist(np.asarray(sliced_embedding(diagram)), atlas.embeddings(seen_as), max(count, shortlist))
    return _sorted(diagram, atlas, candidates, near)[:count]


def _shortlist(query: np.ndarray, embeddings: np.ndarray, length: int) -> list[int]:
    """Return the positions of the embeddings nearest to the query's, nearest first."""
    distances = np.linalg.norm(embeddings - query, axis=1)
    return np.argsort(distances, kind="stable")[:length].tolist()


def _sorted(diagram: Diagram, atlas: Atlas, candidates: tuple[Diagram, ...], near: list[int]) -> tuple[Match, ...]:
    """Return the matches at the given positions of the atlas, by increasing distance."""
    distances = one_to_many(diagram, [candidates[i] for i in near]).tolist()
    matches = (
        Match(
            id=atlas.ids[i],
            distance=distance,
            coefficients=atlas.shape_coefficients(i),
            mass=float(atlas.masses[i]),
            seed=int(atlas.seeds[i]),
        )
        for i, distance in zip(near, distances, strict=True)
    )
    return tuple(sorted(matches, key=lambda match: match.distance))
