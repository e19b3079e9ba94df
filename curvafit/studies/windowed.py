"""Where in a scan does its texture differ? Its numbers in windows, as maps, and the windows in clusters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.cluster.vq import kmeans, vq

from curvafit.core.checks import as_tuple, check_int, check_seed
from curvafit.core.runtime import Pictured, Progress, silent
from curvafit.core.units import format_length, format_number, format_percent, format_sampling, unit_name
from curvafit.scan.measures import QUANTITIES, Blocks, combine, measure_maps
from curvafit.scan.structure import check_options
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import Volume

NAMES = tuple(name for name, *_ in QUANTITIES)
#: The most clusters, the most blocks of a stride, and the most voxels along an axis that are kept for pictures.
MOST_CLUSTERS, MOST_BLOCKS, MOST_SHOWN = 20, 10**6, 256


@dataclass(frozen=True, repr=False, eq=False)
class Windows(Pictured):
    """A scan's numbers in windows.

    Attributes
    ----------
    kind
        `"field"`, `"mask"` or `"image"`: what the scan was taken for.
    size, stride
        Of the windows, in voxels (z, y, x).
    values
        The numbers of `measure` in each window, `(nz, ny, nx, Q)` in the scan's unit; NaN in a window with less surface
        than a layer across it has, and where a scan is too large for its curvature.
    clusters
        On the grid of windows, with its spacing, affine and unit: 1 to K from the thinnest structure to the thickest,
        0 where a number is not known.
    explained
        The part of the variance of standardised numbers that is between clusters.
    structure
        The structure, for pictures: every n-th voxel, so that at most `MOST_SHOWN` remain along each axis.
    """

    kind: str
    size: tuple[int, int, int]
    stride: tuple[int, int, int]
    values: np.ndarray
    clusters: Volume
    explained: float
    structure: Volume
    options: dict[str, Any]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        grid = "×".join(map(str, self.clusters.shape))
        return f"Windows({grid}, {self.known.sum()} known, of {self.clusters.source or 'an array'})"

    def __getitem__(self, name: str) -> Volume:
        """Return the map of a quantity by name or symbol, float32; raise KeyError where there is none."""
        for k, (word, symbol, *_) in enumerate(QUANTITIES):
            if name in (word, symbol):
                return replace(self.clusters, array=self.values[..., k].astype(np.float32))
        raise KeyError(f"expected one of {', '.join(NAMES)}, got {name!r}")

    @property
    def unit(self) -> str:
        """Return the unit of lengths."""
        return self.clusters.unit

    @property
    def known(self) -> np.ndarray:
        """Return which windows have all the numbers of `measure`, bool (nz, ny, nx)."""
        return self.clusters.values > 0

    @property
    def centres(self) -> np.ndarray:
        """Return the windows' centres (nz, ny, nx, 3), z, y and x from the scan's first voxel's centre, in the unit."""
        steps = np.moveaxis(np.indices(self.clusters.shape), 0, -1)
        return (steps + (np.array(self.size) - 1) / 2 / np.array(self.stride)) * self.clusters.spacing

    @property
    def status(self) -> str:
        """Return the answer in some sentences: how many windows, in which clusters, and where the extremes are."""
        labels, thickness = self.clusters.values, self.values[..., NAMES.index("thickness")]
        edges = " x ".join(map(str, self.size))
        each = (
            f"{k} ({(labels == k).sum()} windows, {format_length(thickness[labels == k].mean(), self.unit)} thick)"
            for k in range(1, labels.max() + 1)
        )
        ends = (
            f"{name} window at {', '.join(map(format_number, self.centres[place]))}: "
            f"{format_length(thickness[place], self.unit, 3)}"
            for name, place in zip(("thinnest", "thickest"), self.extremes("thickness"), strict=True)
        )
        return (
            f"{labels.size} windows of {edges} voxels, {(~self.known).sum()} of them without enough structure. "
            f"Clusters: {', '.join(each)}; {format_percent(self.explained)} of the variance is between them. "
            f"By z, y, x in {unit_name(self.unit, 2)}: {'; '.join(ends)}."
        )

    def extremes(self, name: str) -> tuple[tuple[int, ...], ...]:
        """Return the indices of the windows of the least and the greatest of a number, by name; of none if unknown."""
        values = self[name].values
        if not np.isfinite(values).any():
            return ()
        return tuple(
            tuple(map(int, np.unravel_index(end(values), values.shape))) for end in (np.nanargmin, np.nanargmax)
        )


def windows(
    scan: Source,
    size: int | Sequence[int] = 64,
    stride: int | Sequence[int] = 32,
    *,
    clusters: int = 2,
    seed: int = 0,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    periodic: bool = False,
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    progress: Progress = silent,
    **reading: Any,
) -> Windows:
    """Measure a scan in windows, as `measure` does the whole, and part the windows into clusters by k-means.

    Thickness, spacing, surface and curvature are those of the whole scan: a window sums them over its blocks of a
    stride, and cuts no ball or surface. Raises ValueError where the stride does not divide the size, a window is larger
    than the scan or none has enough structure; and as `measure`.

    Parameters
    ----------
    size, stride
        Of the windows, in voxels: one number, or three (z, y, x).
    clusters
        How many clusters; there always are so many where there are as many windows, however alike these are.
    seed
        Of k-means, which keeps the best of 20 starts.
    kind, periodic, threshold, dark, reading
        As in `measure`.
    """
    check_options(kind, threshold, reading.get("label"))
    check_int(clusters, f"a number of clusters from 1 to {MOST_CLUSTERS}", 1, MOST_CLUSTERS)
    check_seed(seed)
    field = load(scan, **reading)
    sizes, strides = _check_grid(field.shape, size, stride)
    starts = tuple(tuple(range(0, n, step)) for n, step in zip(field.shape, strides, strict=True))
    options = {"threshold": threshold, "dark": dark, "periodic": periodic}
    sampling = format_sampling(field.shape, field.spacing, field.unit)
    maps, blocks = measure_maps(field, kind, options, progress), Blocks(field.shape, starts)  # type: ignore[arg-type]
    values = _sum_windows(maps.sum(blocks).reshape(*blocks.counts, -1), field, sizes, strides)
    labels, explained = _cluster(values, clusters, seed)
    corner = field.move_origin([(n - 1) / 2 for n in sizes]).affine
    assert corner is not None
    spacing = tuple(h * step for h, step in zip(field.spacing, strides, strict=True))
    grid = replace(field, array=labels, spacing=spacing, affine=corner @ np.diag([*strides[::-1], 1]))  # type: ignore[arg-type]
    rest = [n % step for n, step in zip(field.shape, strides, strict=True)]
    thin = tuple(-(-n // MOST_SHOWN) for n in field.shape)
    shown = np.ascontiguousarray(maps.mask[tuple(slice(None, None, step) for step in thin)])
    edges = tuple(h * n for h, n in zip(field.spacing, thin, strict=True))
    structure = replace(field, array=shown, spacing=edges, affine=None)
    left = f"The last {', '.join(map(str, rest))} voxels along z, y, x are in no window."
    settings = {"size": sizes, "stride": strides, "clusters": clusters, "seed": seed, "kind": kind}
    notes = (f"{sampling}.", *maps.notes, *([left] if any(rest) else []))
    return Windows(
        kind=maps.kind, size=sizes, stride=strides, values=values, clusters=grid, explained=explained,
        structure=structure, options=settings | options | reading, notes=notes,
    )  # fmt: skip


def _check_grid(shape: Sequence[int], *edges: int | Sequence[int]) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Return the size and the stride along all axes, or raise ValueError where they do not fit the scan."""
    triples = []
    for each in edges:
        parts = (each,) * 3 if isinstance(each, int) else as_tuple(each, "three sizes (z, y, x)")
        triples.append(tuple(check_int(n, "one size in voxels, or three", 1, 10**6, of=each) for n in parts))
        if len(parts) != 3:
            raise ValueError(f"expected one size in voxels, or three (z, y, x), got {each}")
    size, stride = triples
    for axis, n, edge, step in zip("zyx", shape, size, stride, strict=True):
        if edge > n:
            raise ValueError(f"expected windows that fit into the scan's {n} voxels along {axis}, got a size of {edge}")
        if edge % step:
            raise ValueError(f"expected a stride that divides the windows' size of {edge} along {axis}, got {step}")
    if math.prod(n // step for n, step in zip(shape, stride, strict=True)) > MOST_BLOCKS:
        raise ValueError(f"expected a longer stride: {stride} voxels give more than {MOST_BLOCKS:,} windows")
    return size, stride


def _sum_windows(table: np.ndarray, field: Volume, size: Sequence[int], stride: Sequence[int]) -> np.ndarray:
    """Return the numbers (nz, ny, nx, Q) of windows from sums (Z, Y, X, C) over blocks."""
    table = table[tuple(slice(n // step) for n, step in zip(field.shape, stride, strict=True))]
    for axis in range(3):
        table = np.lib.stride_tricks.sliding_window_view(table, size[axis] // stride[axis], axis).sum(-1)
    values = combine(table)
    # A layer across a window has two faces of it: with less surface there is no period to measure along any edge.
    edge = max(n * h for n, h in zip(size, field.spacing, strict=True))
    values[~(values[..., NAMES.index("surface density")] * edge >= 2)] = np.nan
    if np.isnan(values[..., 0]).all():
        raise ValueError(
            f"expected windows with at least the surface of a layer across them, got none among {values[..., 0].size}: "
            "choose a larger size"
        )
    return values


def _cluster(values: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, float]:
    """Return labels (nz, ny, nx) uint8, and the part of the variance between clusters, of windows that are known."""
    columns = np.logical_or.reduce(np.isfinite(values.reshape(-1, len(NAMES))))  # a thin stack has no curvature
    thickness = int(columns[: NAMES.index("thickness")].sum())
    columns[NAMES.index("Euler number")] = False  # with Conn.D it would count twice
    rows = values[..., columns]
    known = np.isfinite(rows).all(-1)
    labels, rows = np.zeros(known.shape, dtype=np.uint8), rows[known]
    if not len(rows):
        return labels, 0.0
    deviation = rows.std(0)
    scaled = (rows - rows.mean(0)) / np.where(deviation > 0, deviation, 1)
    centres, _ = kmeans(scaled, min(count, len(rows)), seed=np.random.default_rng(seed))  # type: ignore[call-arg]
    centres = centres[np.argsort(centres[:, thickness])]
    numbers, away = vq(scaled, centres)
    labels[known] = numbers + 1
    return labels, float(1 - (away**2).sum() / max((scaled**2).sum(), 1e-30))
