"""Boxes of voxels along (z, y, x): how they are written, cut, grown and counted."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from numbers import Integral
from typing import Any

from curvafit.core.checks import quoted
from curvafit.volumes.formats.base import ScanError

#: A box of voxels along (z, y, x).
Box = tuple[slice, slice, slice]
#: A box as a caller gives it: `"z0:z1,y0:y1,x0:x1"`, or three slices.
Crop = str | Sequence[slice]


def parse_box(crop: Crop) -> Box:
    """Return a crop as three slices."""
    parts: Any = list(map(_parse_slice, crop.split(","))) if isinstance(crop, str) else crop
    if not isinstance(parts, Sequence) or len(parts) != 3 or not all(map(_is_plain, parts)):
        raise ScanError(f'crop must be "z0:z1,y0:y1,x0:x1" or three slices, got {quoted(crop)}')
    return parts[0], parts[1], parts[2]


def resolve_box(box: Box, shape: Sequence[int], place: object) -> Box:
    """Return a box in a volume of a shape (z, y, x), with all its ends counted from the first voxel."""
    edges = []
    for name, edge, n in zip("zyx", box, shape, strict=True):
        start, stop = (0 if edge.start is None else edge.start), (n if edge.stop is None else edge.stop)
        first, last = (start + n if start < 0 else start), (stop + n if stop < 0 else stop)
        if not 0 <= first < last <= n:
            raise ScanError(f"crop must lie within 0:{n} along {name} of {place}, got {start}:{stop}")
        edges.append(slice(first, last))
    return edges[0], edges[1], edges[2]


def cut_boxes(shape: Sequence[int], edge: int | Sequence[int]) -> list[Box]:
    """Cut a volume into boxes of an edge, or of one along each axis, z slowest; the last ones may be smaller."""
    edges = (edge,) * 3 if isinstance(edge, int) else edge
    axes = ([slice(a, min(a + e, n)) for a in range(0, n, e)] for n, e in zip(shape, edges, strict=True))
    return [(z, y, x) for z, y, x in product(*axes)]


def grow(box: Box, by: int | Sequence[int], shape: Sequence[int]) -> Box:
    """Return a box with more voxels on every side, as far as the volume has them."""
    more = (by,) * 3 if isinstance(by, int) else by
    z, y, x = (slice(max(0, e.start - m), min(n, e.stop + m)) for e, m, n in zip(box, more, shape, strict=True))
    return z, y, x


def within(inner: Box, outer: Box) -> Box:
    """Return a box in the voxels of another."""
    z, y, x = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(inner, outer, strict=True))
    return z, y, x


def _parse_slice(text: str) -> slice | None:
    """Return the slice of a text such as `"3:7"`, `":7"` or `":"`, None for another text."""
    match = re.fullmatch(r"\s*(-?\d{1,18})?\s*:\s*(-?\d{1,18})?\s*", text)
    return slice(*(None if edge is None else int(edge) for edge in match.groups())) if match else None


def _is_plain(edge: Any) -> bool:
    """Return whether this is a slice that has whole numbers, or nothing, as ends, and no step."""
    if not isinstance(edge, slice) or edge.step not in (None, 1):
        return False
    ends = (edge.start, edge.stop)
    return all(end is None or (isinstance(end, Integral) and not isinstance(end, bool)) for end in ends)
