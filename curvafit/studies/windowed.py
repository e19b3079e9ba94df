"""Where in a scan does its texture differ? Its numbers in windows, as maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from curvafit.core.checks import as_tuple, check_int
from curvafit.core.runtime import Pictured, Progress, silent
from curvafit.core.units import format_length, format_number, format_sampling, unit_name
from curvafit.scan.measures import QUANTITIES, Blocks, Outline, combine, measure_maps
from curvafit.scan.structure import check_options
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import Volume

NAMES = tuple(name for name, *_ in QUANTITIES)
#: Most blocks of a stride's edges.
MOST_BLOCKS = 10**6


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
    grid
        Which windows have all numbers that any window has, uint8; with the spacing, affine and unit of the windows.
    outline
        What was taken for the structure, on three slices.
    """

    kind: str
    size: tuple[int, int, int]
    stride: tuple[int, int, int]
    values: np.ndarray
    grid: Volume
    outline: Outline
    options: dict[str, Any]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        counts = "×".join(map(str, self.grid.shape))
        return f"Windows({counts}, {self.known.sum()} known, of {self.grid.source or 'an array'})"

    def __getitem__(self, name: str) -> Volume:
        """Return the map of a quantity by name or symbol, float32; raise KeyError where there is none."""
        for k, (full_name, symbol, *_) in enumerate(QUANTITIES):
            if name in (full_name, symbol):
                return replace(self.grid, array=self.values[..., k].astype(np.float32))
        raise KeyError(f"expected one of {', '.join(NAMES)}, got {name!r}")

    @property
    def unit(self) -> str:
        """Return the unit of lengths."""
        return self.grid.unit

    @property
    def known(self) -> np.ndarray:
        """Return which windows have all numbers that any window has, bool (nz, ny, nx)."""
        return self.grid.values > 0

    @property
    def centres(self) -> np.ndarray:
        """Return the windows' centres (nz, ny, nx, 3), as (z, y, x) from the centre of the first voxel, in `unit`."""
        indices = np.moveaxis(np.indices(self.grid.shape), 0, -1)
        return (indices + (np.array(self.size) - 1) / 2 / np.array(self.stride)) * self.grid.spacing

    @property
    def status(self) -> str:
        """Return the answer in some sentences: how many windows, and where the thickness is least and greatest."""
        thickness, edges = self.values[..., NAMES.index("thickness")], " x ".join(map(str, self.size))
        extremes = (
            f"{name} window at {', '.join(map(format_number, self.centres[index]))}: "
            f"{format_length(thickness[index], self.unit, 3)}"
            for name, index in zip(("thinnest", "thickest"), self.extremes("thickness"), strict=True)
        )
        return (
            f"{self.known.size} windows of {edges} voxels, {(~self.known).sum()} of them without enough structure. "
            f"By z, y, x in {unit_name(self.unit, 2)}: {'; '.join(extremes)}."
        )

    def extremes(self, name: str) -> tuple[tuple[int, ...], ...]:
        """Return the indices (z, y, x) of the windows where a number is least and greatest; () where it is unknown."""
        values = self[name].values
        if not np.isfinite(values).any():
            return ()
        flat = (np.nanargmin(values), np.nanargmax(values))
        return tuple(tuple(map(int, np.unravel_index(index, values.shape))) for index in flat)


def windows(
    scan: Source,
    size: int | Sequence[int] = 64,
    stride: int | Sequence[int] = 32,
    *,
    kind: Literal["auto", "field", "mask", "image"] = "auto",
    periodic: bool = False,
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    progress: Progress = silent,
    **reading: Any,
) -> Windows:
    """Measure a scan in windows, as `measure` does the whole.

    Thickness, spacing, surface and curvature are measured once in the whole scan, so that no window cuts a ball or a
    surface: a window sums them over its blocks, whose edges are the stride. Raises ValueError where the stride does not
    divide the size, a window is larger than the scan or none has enough structure; and as `measure`.

    Parameters
    ----------
    size, stride
        Of the windows, in voxels: one number, or three (z, y, x).
    kind, periodic, threshold, dark, reading
        As in `measure`.
    """
    check_options(kind, threshold, reading.get("label"))
    field = load(scan, **reading)
    sizes, strides = _check_grid(field.shape, size, stride)
    starts = tuple(tuple(range(0, n, step)) for n, step in zip(field.shape, strides, strict=True))
    options = {"threshold": threshold, "dark": dark, "periodic": periodic}
    sampling = format_sampling(field.shape, field.spacing, field.unit)
    maps, blocks = measure_maps(field, kind, options, progress), Blocks(field.shape, starts)  # type: ignore[arg-type]
    values = _sum_windows(maps.sum(blocks).reshape(*blocks.counts, -1), field, sizes, strides)
    finite = np.isfinite(values)
    known = finite[..., finite.any((0, 1, 2))].all(-1)  # a thin stack has no curvature
    first_centre = field.move_origin([(n - 1) / 2 for n in sizes]).affine
    assert first_centre is not None
    spacing = tuple(h * step for h, step in zip(field.spacing, strides, strict=True))
    affine = first_centre @ np.diag([*strides[::-1], 1])  # an affine's axes are x, y, z
    grid = replace(field, array=known.astype(np.uint8), spacing=spacing, affine=affine)  # type: ignore[arg-type]
    notes = [f"{sampling}.", *maps.notes]
    if any(rest := [n % step for n, step in zip(field.shape, strides, strict=True)]):
        notes.append(f"The last {', '.join(map(str, rest))} voxels along z, y, x are in no window.")
    settings = {"size": sizes, "stride": strides, "kind": kind} | options | reading
    outline = Outline.cut(field, maps.mask.__getitem__)
    return Windows(maps.kind, sizes, strides, values, grid, outline, settings, tuple(notes))


def _check_grid(shape: Sequence[int], *sizes: int | Sequence[int]) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Return the size and the stride along all axes, or raise ValueError where they do not fit the scan."""
    triples = []
    for edges in sizes:
        triple = (edges,) * 3 if isinstance(edges, int) else as_tuple(edges, "three sizes (z, y, x), or one size", 3)
        triples.append(tuple(check_int(n, "one size in voxels, or three", 1, 10**6, of=edges) for n in triple))
    size, stride = triples
    for axis, n, edge, step in zip("zyx", shape, size, stride, strict=True):
        if edge > n:
            raise ValueError(f"expected windows that fit into the scan's {n} voxels along {axis}, got a size of {edge}")
        if edge % step:
            raise ValueError(f"expected a stride that divides the windows' size of {edge} along {axis}, got {step}")
    if math.prod(n // step for n, step in zip(shape, stride, strict=True)) > MOST_BLOCKS:
        raise ValueError(f"expected a longer stride: {stride} voxels give more than {MOST_BLOCKS:,} windows")
    return size, stride


def _sum_windows(sums: np.ndarray, field: Volume, size: Sequence[int], stride: Sequence[int]) -> np.ndarray:
    """Return the numbers (nz, ny, nx, Q) of windows from sums (Z, Y, X, C) over blocks."""
    sums = sums[tuple(slice(n // step) for n, step in zip(field.shape, stride, strict=True))]  # whole blocks only
    for axis in range(3):
        sums = np.lib.stride_tricks.sliding_window_view(sums, size[axis] // stride[axis], axis).sum(-1)
    values = combine(sums)
    # A layer across a window has two faces as large as the window's. With less surface, or none known, it is too small.
    edge = max(n * h for n, h in zip(size, field.spacing, strict=True))
    values[~(values[..., NAMES.index("surface density")] * edge >= 2)] = np.nan
    if np.isnan(values[..., 0]).all():
        raise ValueError(
            f"expected windows with at least the surface of a layer across them, got none among {values[..., 0].size}: "
            "choose a larger size"
        )
    return values
