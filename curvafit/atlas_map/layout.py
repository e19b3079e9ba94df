"""An atlas on the plane: where each shape lies, which cluster it is in, and of which family it is."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from curvafit.core.records import Format
from curvafit.core.runtime import Progress, silent
from curvafit.geometry.diagram import BIN_WIDTH, FAMILIES, Diagram, family_shares, half_thickness, leading_family
from curvafit.geometry.distances import digests, pairwise
from curvafit.inference.atlas import Atlas

#: The paper's settings (Experiment 4): of UMAP, of HDBSCAN on the embedded points, of the distances.
UMAP: dict[str, Any] = {"n_neighbors": 25, "min_dist": 0.05, "spread": 1.0, "random_state": 1}
HDBSCAN: dict[str, Any] = {"min_cluster_size": 10, "min_samples": 10}
DISTANCE: dict[str, Any] = {"blur": 1.0, "reach": 20.0, "bin_width": BIN_WIDTH}
#: Files of distances; the version goes up when distances change.
DISTANCES = Format("curvafit distances", 2, "a file of distances", fixed=DISTANCE)
#: Below this, there is nothing to lay out.
LEAST_SHAPES = 5
#: What HDBSCAN calls a point of no cluster.
NOISE = -1


@dataclass(frozen=True, eq=False)
class AtlasMap:
    """The map of an atlas of N shapes, with the parameters and versions that it was made with (`settings`).

    `distances` `(N, N)` are between the diagrams of the fields, in 1 / working unit; of the `positions` `(N, 2)` only
    nearness has a meaning, not direction; `clusters` `(N,)` are from 0, or `NOISE`. A shape's family is where its
    diagram has its mass, and a cluster's where the normalised diagrams of its shapes, taken together, have theirs.
    """

    atlas: Atlas
    distances: np.ndarray
    positions: np.ndarray
    clusters: np.ndarray
    cluster_families: tuple[str, ...]
    families: tuple[str, ...]
    settings: dict[str, Any]

    def __len__(self) -> int:
        return len(self.atlas)

    def neighbours(self, count: int) -> np.ndarray:
        """Return the indices of each shape's nearest others, nearest first: `(N, count)`, at most `(N, N - 1)`."""
        others = self.distances + np.diag(np.full(len(self), np.inf))
        return np.argsort(others, axis=1, kind="stable")[:, : min(count, len(self) - 1)]


def map_atlas(atlas: Atlas, distances: np.ndarray) -> AtlasMap:
    """Lay an atlas out by its `diagram_distances` `(N, N)`, find and name clusters (paper, Experiment 4, Figure 10).

    Raises ImportError without the extra `[atlas]`, and ValueError for fewer than `LEAST_SHAPES` shapes.
    """
    check_extra()
    check_size(n := len(atlas))
    if distances.shape != (n, n) or not np.isfinite(distances).all() or not np.allclose(distances, distances.T):
        raise ValueError(f"distances must be finite, symmetric and of shape ({n}, {n}), got {distances.shape}")
    positions = embed(distances)
    clusters = find_clusters(positions)
    families, shares = families_of(atlas)
    pooled = [shares[clusters == cluster].mean(0) for cluster in range(max(clusters) + 1)]
    names = tuple(leading_family(dict(zip(FAMILIES, pool, strict=True))) for pool in pooled)
    return AtlasMap(atlas, distances, positions, clusters, names, families, _settings(n))


def diagram_distances(
    diagrams: Sequence[Diagram], *, progress: Progress = silent, saved: Path | None = None
) -> np.ndarray:
    """Return the Wasserstein distances of all pairs `(N, N)`, with the paper's settings.

    The file `saved` (`.npz`) is replaced every half minute and at the end. Distances between these diagrams that it
    holds are taken from it: a run that was stopped goes on, and a longer list costs only its new rows. Diagrams are
    recognised by their content, in any order. A file of another kind or of other settings is a ValueError, one that
    cannot be written an OSError before anything is computed.
    """
    if saved is None:
        return pairwise(diagrams, **DISTANCE, progress=progress)
    keys = digests(diagrams, **DISTANCE)
    known = np.full((len(keys),) * 2, np.nan)
    if saved.exists():
        there, distances = DISTANCES.read(saved, _read_distances)
        place = {key: number for number, key in enumerate(there)}
        mine = [number for number, key in enumerate(keys) if key in place]
        theirs = [place[keys[number]] for number in mine]
        known[np.ix_(mine, mine)] = distances[np.ix_(theirs, theirs)]

    def save(distances: np.ndarray) -> None:
        arrays = {"keys": np.array(keys, dtype="S64"), "distances": distances}
        DISTANCES.write(saved, {}, arrays)

    return pairwise(diagrams, **DISTANCE, known=known, save=save, progress=progress)


def _read_distances(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> tuple[list[str], np.ndarray]:
    """Return the digests and the distances of a file."""
    keys, distances = arrays["keys"].astype(str).tolist(), arrays["distances"]
    if distances.shape != (len(keys),) * 2 or distances.dtype != np.float64:
        raise ValueError(f"distances of shape {distances.shape} for {len(keys)} diagrams")
    return keys, distances


def embed(distances: np.ndarray) -> np.ndarray:
    """Return UMAP's places `(N, 2)` of shapes with distances `(N, N)`."""
    with warnings.catch_warnings():
        # That its neural variant is not installed, that given distances cannot be inverted, that families lie apart.
        warnings.simplefilter("ignore")
        from umap import UMAP as Umap

        places = Umap(n_jobs=1, **_umap_options(len(distances))).fit_transform(distances.astype(np.float32))
    return np.asarray(places, dtype=np.float64)


def _umap_options(count: int) -> dict[str, Any]:
    """Return UMAP's options for so many shapes: of fewer than 26, all are neighbours."""
    return UMAP | {"n_neighbors": min(UMAP["n_neighbors"], count - 1), "metric": "precomputed"}


def find_clusters(positions: np.ndarray) -> np.ndarray:
    """Return HDBSCAN's clusters `(N,)` of places `(N, 2)`, the largest first, `NOISE` for none."""
    if len(positions) < HDBSCAN["min_cluster_size"]:
        return np.full(len(positions), NOISE)
    from sklearn.cluster import HDBSCAN as Hdbscan

    options: dict[str, Any] = HDBSCAN | {"copy": True}
    labels = Hdbscan(**options).fit_predict(positions)
    sizes = np.bincount(labels[labels >= 0], minlength=1)
    rank = np.argsort(np.argsort(-sizes, kind="stable"))
    return np.where(labels >= 0, rank[labels], NOISE)


def check_size(count: int) -> None:
    """Raise ValueError if there are too few shapes for a map."""
    if count < LEAST_SHAPES:
        raise ValueError(f"a map needs at least {LEAST_SHAPES} shapes, got {count}")


def check_extra() -> None:
    """Raise ImportError with the line to type if the extra `[atlas]` is not installed."""
    for module in ("umap", "sklearn"):
        if find_spec(module) is None:
            raise ImportError(f'a map needs {module}: pip install "curvafit[atlas]"')


def families_of(atlas: Atlas) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the family of each shape, and its shares of area in the order of `FAMILIES`, `(N, 6)`."""
    sampling = atlas.provenance["settings"]
    box = float(np.prod(sampling["shape"]) * np.prod(sampling["spacing"]))
    names, shares = [], []
    for diagram, fraction in zip(atlas.field_diagrams, atlas.volume_fractions, strict=True):
        parts = family_shares(diagram, half_thickness(diagram, float(fraction) * box))
        names.append(leading_family(parts))
        shares.append([parts[name] for name in FAMILIES])
    return tuple(names), np.array(shares)


def _settings(count: int) -> dict[str, Any]:
    """Return the parameters and versions that a map of so many shapes is made with."""
    return {
        "distances": {"of": "fields", **DISTANCE},
        "umap": _umap_options(count),
        "hdbscan": HDBSCAN,
        "versions": {name: version(name) for name in ("curvafit", "umap-learn", "scikit-learn", "numpy", "torch")},
    }
