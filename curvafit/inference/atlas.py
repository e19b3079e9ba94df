"""An atlas's diagrams with their parameters, in one file, ready to be searched."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from curvafit.core.records import Format
from curvafit.core.schema import Rule
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.distances import one_to_many, sliced_embedding, wasserstein
from curvafit.priors.coefficients import Coefficients
from curvafit.scan.preparation import WORKING_THICKNESS

VERSION = 2
ATLAS_FILE = Format("curvafit atlas", VERSION, "an atlas file", remedy="extract it again from its store")
#: What is known of each shape.
ARRAYS = ("coefficients", "masses", "seeds", "volume_fractions", "thicknesses")
#: Shapes, nearest in sliced distance, whose Wasserstein distance is computed.
SHORT = 40
#: How a shape can be seen: as its phase field, or as the mask {u > 0} re-profiled.
SEEN_AS = ("field", "mask")


@dataclass(frozen=True, eq=False)
class Atlas:
    """N generated shapes: parameters in working units, and their geometric diagrams, binned.

    `ids` name the shapes; `coefficients` is float64 (N, 6) in the order of `curvafit.priors.coefficients.NAMES`,
    `masses` m₀, `volume_fractions` of {u > 0} and `thicknesses` in voxels float64 (N,), `seeds` int64 (N,) those of the
    noise each shape grew from. Masks are measured as scans are, on voxels with which they are eight thick. `provenance`
    says how they were made: grid, schedule, law, versions, command, date.
    """

    ids: tuple[str, ...]
    coefficients: np.ndarray
    masses: np.ndarray
    seeds: np.ndarray
    volume_fractions: np.ndarray
    thicknesses: np.ndarray
    field_diagrams: tuple[Diagram, ...]
    mask_diagrams: tuple[Diagram, ...]
    provenance: dict[str, Any]
    _embedded: dict[str, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.ids)
        for name in ARRAYS:
            shape = (n, 6) if name == "coefficients" else (n,)
            if getattr(self, name).shape != shape:
                raise ValueError(f"expected {name} of shape {shape}, got {getattr(self, name).shape}")
        if not n or len(self.field_diagrams) != n or len(self.mask_diagrams) != n:
            counts = f"{len(self.field_diagrams)} and {len(self.mask_diagrams)} for {n} shapes"
            raise ValueError(f"expected a field and a mask diagram for each of at least one shape, got {counts}")

    def __len__(self) -> int:
        return len(self.ids)

    def diagrams(self, seen_as: str) -> tuple[Diagram, ...]:
        """Return the diagrams of the shapes seen as `"field"` or as `"mask"`.

        Raises ValueError if `seen_as` is another word.
        """
        if seen_as not in SEEN_AS:
            raise ValueError(f"expected shapes seen as 'field' or 'mask', got {seen_as!r}")
        return self.field_diagrams if seen_as == "field" else self.mask_diagrams

    def embeddings(self, seen_as: str) -> np.ndarray:
        """Return the sliced-quantile embeddings (N, 288) of those diagrams; computed once."""
        if seen_as not in self._embedded:
            rows = [np.asarray(sliced_embedding(diagram)) for diagram in self.diagrams(seen_as)]
            self._embedded[seen_as] = np.stack(rows)
        return self._embedded[seen_as]


def save_atlas(atlas: Atlas, path: str | Path) -> None:
    """Write an atlas as one compressed `.npz`: arrays, and a JSON header with format, version and provenance.

    Points are stored in float16: κ has a relative error of at most 2⁻¹¹ (0.03 at 100), far below the bins' width of 2.
    Weights are stored in float32, divided by the diagram's area.
    """
    arrays = {name: getattr(atlas, name) for name in ARRAYS}
    for view in SEEN_AS:
        diagrams = atlas.diagrams(view)
        areas = np.array([d.weights.sum() for d in diagrams])
        packed = {
            "points": np.concatenate([d.points for d in diagrams]).astype(np.float16, order="F"),  # so it packs
            "weights": np.concatenate([d.weights / a for d, a in zip(diagrams, areas, strict=True)]).astype(np.float32),
            "offsets": np.cumsum([0] + [len(d.weights) for d in diagrams]),  # diagram i has rows offsets[i:i + 2]
            "areas": areas,
            "spreads": np.array([d.spread for d in diagrams]),
            "excluded": np.array([d.excluded for d in diagrams]),
        }
        arrays |= {f"{view}_{name}": value for name, value in packed.items()}
    ATLAS_FILE.write(path, {"ids": list(atlas.ids), "provenance": atlas.provenance}, arrays)


def load_atlas(path: str | Path | None = None) -> Atlas:
    """Read an atlas file; by default the packaged one.

    Raises FileNotFoundError if there is no such file, and ValueError if it is not an atlas, is truncated, or has
    another format version.
    """
    if path is None:
        return ATLAS_FILE.read_packaged("inference", "atlas.npz", _from_arrays)
    if Path(path).is_dir():
        raise FileNotFoundError(f"expected an atlas file, got the folder {path}: `curvafit atlas extract` makes one")
    return ATLAS_FILE.read(path, _from_arrays)


def _from_arrays(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Atlas:
    finite = all(array.dtype.kind in "iuf" and np.isfinite(array).all() for array in arrays.values())
    if not (finite and (np.abs(arrays["masses"]) < 1).all() and all(isinstance(name, str) for name in header["ids"])):
        raise ValueError("expected finite numbers, masses in (-1, 1) and ids that are texts, got others")
    diagrams = (_unpack_diagrams(arrays, view) for view in SEEN_AS)
    return Atlas(tuple(header["ids"]), *(arrays[name] for name in ARRAYS), *diagrams, header["provenance"])  # type: ignore[call-arg]


def _unpack_diagrams(arrays: dict[str, np.ndarray], view: str) -> tuple[Diagram, ...]:
    """Return the diagrams whose points and weights `save_atlas` wrote one after the other."""
    points, weights = (arrays[f"{view}_{name}"].astype(np.float64) for name in ("points", "weights"))
    offsets = arrays[f"{view}_offsets"].astype(np.int64)
    if list(offsets[[0, -1]]) != [0, len(points)] or (np.diff(offsets) < 0).any():
        raise ValueError(f"expected offsets from 0 to {len(points)}, got others")
    columns = (arrays[f"{view}_{name}"] for name in ("areas", "spreads", "excluded"))
    return tuple(
        Diagram(points[start:end], weights[start:end] * area, spread=float(spread), excluded=float(excluded))
        for start, end, area, spread, excluded in zip(offsets[:-1], offsets[1:], *columns, strict=True)
    )


@dataclass(frozen=True)
class Match:
    """A shape of an atlas, and the Wasserstein distance of its diagram to the query's (1 / working unit).

    `coefficients` (working units), `mass` m₀ and the noise `seed` made the shape; `thickness` is in its own voxels.
    """

    id: str
    distance: Annotated[float, Rule(least=0)]
    coefficients: Coefficients
    mass: Annotated[float, Rule(above=-1, below=1)]
    seed: Annotated[int, Rule(least=0)]
    thickness: Annotated[float, Rule(above=0)] = WORKING_THICKNESS


def mirror_match(match: Match) -> Match:
    """Return a match's shape with inside and outside exchanged, in the gauge a20 = 1."""
    mirrored = match.coefficients.mirror()
    return replace(match, coefficients=mirrored.scale(1 / float(mirrored.a20)), mass=-match.mass)


def nearest(
    diagram: Diagram, atlas: Atlas, *, seen_as: str = "field", count: int = 5, exact: bool = False
) -> tuple[Match, ...]:
    """Return the `count` shapes nearest to a diagram, nearest first.

    Raises ValueError if `count` is not positive, `seen_as` is another word, or the diagram has no area.

    Parameters
    ----------
    diagram
        The query's geometric diagram, in 1 / working unit.
    seen_as
        What the query was measured on, `"field"` or `"mask"`: it is compared with diagrams of the same kind.
    exact
        Compute the distances of the matches by geomloss in float64 (`wasserstein`), in place of float32.
    """
    if count < 1:
        raise ValueError(f"expected a count of at least 1, got {count}")
    candidates = atlas.diagrams(seen_as)
    if not float(diagram.weights.sum()) > 0:
        raise ValueError("expected a diagram with area, got an empty one")
    sliced = np.linalg.norm(atlas.embeddings(seen_as) - np.asarray(sliced_embedding(diagram)), axis=1)
    shortlist = np.argsort(sliced, kind="stable")[: max(count, SHORT)].tolist()
    distances = one_to_many(diagram, [candidates[position] for position in shortlist])
    matches = []
    for k in np.argsort(distances, kind="stable")[:count]:
        position = shortlist[k]
        distance = wasserstein(diagram, candidates[position]) if exact else float(distances[k])
        others = (column[position].item() for column in (atlas.masses, atlas.seeds, atlas.thicknesses))
        law = Coefficients(*atlas.coefficients[position].tolist())
        matches.append(Match(atlas.ids[position], distance, law, *others))
    # Exact distances may give another order than those in float32.
    return tuple(sorted(matches, key=lambda match: match.distance))
