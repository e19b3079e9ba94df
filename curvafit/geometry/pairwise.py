"""Distances between many curvature diagrams: every pair of them, or one and all others."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from curvafit.core.checks import quoted
from curvafit.core.files import write_atomically
from curvafit.core.records import parse_json, read_archive
from curvafit.core.runtime import Progress, silent
from curvafit.geometry.diagram import BIN_WIDTH, Diagram
from curvafit.geometry.sinkhorn import Measures, costs, packed, pair_halvings
from curvafit.geometry.transport import comparable

#: Pairs that are taken at once: a few seconds on a processor.
BLOCK = 8192
#: Seconds between two saves.
EVERY = 30.0
FORMAT = "curvafit distances"
#: Goes up when distances change: rows of another version are never reused.
VERSION = 2


def pairwise(
    diagrams: Sequence[Diagram],
    *,
    blur: float = 1.0,
    reach: float | None = 20.0,
    bin_width: float = BIN_WIDTH,
    device: torch.device | str = "cpu",
    checkpoint: str | Path | None = None,
    progress: Progress = silent,
) -> np.ndarray:
    """Return `transport.wasserstein` of every pair of N diagrams: `(N, N)` float64, symmetric, with a zero diagonal.

    `wasserstein` is met to 1e-4 of itself, or 1e-5 where that is less than 0.1: the steps are the same, in float32. A
    diagram's own term of the debiased distance depends on the pair by the number of steps alone, of which there are two
    or three, and is computed once for each. Bins of 2 change the distances of random shapes by 0.3 % in the median and
    1.3 % at most, those to a shape's nearest by 0.7 % and 1.6 %, or 0.05 where they are under 2; bins of 1 a third of
    that, for seven times the time (`benchmarks.distances`).

    Parameters
    ----------
    diagrams
        In one unit.
    blur, reach, bin_width
        As `wasserstein` takes them.
    device
        `"cpu"` runs on numba's threads, half a millisecond a pair; `"cuda"` takes pairs in batches.
    checkpoint
        File (`.npz`) that is replaced every half minute and at the end. Where it exists, what it holds of pairs among
        these diagrams is taken from it: a killed run goes on, a longer list costs its new rows. Diagrams are known by
        their content, so order and position do not matter; rows of diagrams that are not listed any more go.
    progress
        Called after every block of pairs with a sentence and the share done.

    Raises
    ------
    ValueError
        If a diagram is empty, the units differ, a parameter is out of range, or the checkpoint is something else or was
        made with other parameters.
    OSError
        If the checkpoint cannot be written; before anything is computed.
    """
    measures = _measures(diagrams, blur, reach, bin_width)
    file = _File(checkpoint, {"blur": blur, "reach": reach, "bin_width": bin_width}, _keys(measures))
    distances = file.read()
    first, second = np.nonzero(np.triu(np.isnan(distances)))
    order = np.random.default_rng(0).permutation(len(first))  # so that threads get pairs of like sizes
    first, second = first[order], second[order]
    total = len(distances) * (len(distances) - 1) // 2
    file.write(distances)
    blocks = _distances(measures, first, second, blur=blur, reach=reach, device=device)
    try:
        for start, block in zip(range(0, len(first), BLOCK), blocks, strict=True):
            i, j = first[start : start + BLOCK], second[start : start + BLOCK]
            distances[i, j] = distances[j, i] = block
            progress(f"comparing {total} pairs", (total - len(first) + start + len(block)) / total)
            if file.due():
                file.write(distances)
    finally:
        file.write(distances)
    return distances


def one_to_many(
    query: Diagram,
    diagrams: Sequence[Diagram],
    *,
    blur: float = 1.0,
    reach: float | None = 20.0,
    bin_width: float = BIN_WIDTH,
    device: torch.device | str = "cpu",
) -> np.ndarray:
    """Return the distances `(N,)` of one diagram to each of N; `pairwise` says what is taken and raised."""
    measures = _measures([query, *diagrams], blur, reach, bin_width)
    others = np.arange(1, len(diagrams) + 1)
    blocks = _distances(measures, np.zeros_like(others), others, blur=blur, reach=reach, device=device)
    return np.concatenate([np.empty(0), *blocks])


def _measures(diagrams: Sequence[Diagram], blur: float, reach: float | None, bin_width: float) -> Measures:
    reduced = comparable(diagrams, blur, reach, bin_width)
    return packed([d.points for d in reduced], [d.weights for d in reduced])


def _distances(measures: Measures, first: np.ndarray, second: np.ndarray, **options: Any) -> Iterator[np.ndarray]:
    """Yield the distances of the pairs, block by block.

    Half of what a measure costs with itself, in as many steps as the pair's, is what debiasing takes off.
    """
    falls = pair_halvings(measures, first, second, options["blur"])
    keys = np.concatenate([np.stack([ends, falls], axis=1) for ends in (first, second)])
    distinct, places = np.unique(keys, axis=0, return_inverse=True)
    own = costs(measures, distinct[:, 0], distinct[:, 0], distinct[:, 1], **options)
    bias = own[places.reshape(2, -1)].sum(0) / 2
    for start in range(0, len(first), BLOCK):
        block = slice(start, start + BLOCK)
        divergence = costs(measures, first[block], second[block], falls[block], **options) - bias[block]
        yield np.sqrt(np.maximum(divergence, 0))


def _keys(measures: Measures) -> list[str]:
    """Return a digest of each measure's points and weights."""
    rows = np.stack([measures.x, measures.y, measures.log2], axis=1)
    parts = (rows[start:end] for start, end in zip(measures.bounds[:-1], measures.bounds[1:], strict=True))
    return [hashlib.sha256(part.tobytes()).hexdigest() for part in parts]


class _File:
    """Where distances are kept: a header, the digests of N measures, and `(N, N)` distances, NaN where not known yet.

    Without a path nothing is kept.
    """

    def __init__(self, path: str | Path | None, settings: dict[str, Any], keys: list[str]) -> None:
        self._path = None if path is None else Path(path)
        self._header = {"format": FORMAT, "version": VERSION, **settings}
        self._keys, self._written = keys, time.monotonic()

    def read(self) -> np.ndarray:
        """Return what the file knows of the distances between the measures."""
        distances = np.full((len(self._keys),) * 2, np.nan)
        if self._path is not None and self._path.exists():
            keys, known = self._content(self._path)
            place = {key: number for number, key in enumerate(keys)}
            here = [number for number, key in enumerate(self._keys) if key in place]
            there = [place[self._keys[number]] for number in here]
            distances[np.ix_(here, here)] = known[np.ix_(there, there)]
        np.fill_diagonal(distances, 0)
        return distances

    def due(self) -> bool:
        return time.monotonic() - self._written > EVERY

    def write(self, distances: np.ndarray) -> None:
        if self._path is not None:
            write_atomically(self._path, lambda path: self._save(path, distances))
            self._written = time.monotonic()

    def _save(self, path: Path, distances: np.ndarray) -> None:
        header = np.frombuffer(json.dumps(self._header).encode(), dtype=np.uint8)
        with open(path, "wb") as file:
            np.savez(file, header=header, keys=np.array(self._keys, dtype="S64"), distances=distances)
            file.flush()
            os.fsync(file.fileno())

    def _content(self, path: Path) -> tuple[list[str], np.ndarray]:
        """Return the digests and distances of a file that was made with the same settings."""
        try:
            arrays = read_archive(path)
            header = parse_json(arrays["header"].tobytes(), "a file of distances", path)
            keys, distances = arrays["keys"].astype(str).tolist(), arrays["distances"]
            theirs = {name: header.get(name) for name in self._header}
            if distances.shape != (len(keys),) * 2 or distances.dtype != np.float64:
                raise ValueError(f"expected distances of {len(keys)} diagrams, got shape {distances.shape}")
        except (ValueError, KeyError, AttributeError, TypeError) as error:
            raise ValueError(f"expected a file of distances, got {path}, which is something else") from error
        names = [name for name, value in self._header.items() if theirs[name] != value]
        if names:
            parts = (f"{name} {quoted(theirs[name])} instead of {self._header[name]}" for name in names)
            raise ValueError(f"expected distances of this kind, got {path} with {'; '.join(parts)}")
        return keys, distances
