"""A part of a file's array: one channel and one time of several, and a box of voxels."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from numbers import Integral
from typing import Any

import numpy as np

from curvafit.core.checks import SEEDS, check_int, quoted
from curvafit.volumes.formats.base import UNNAMED, Axes, Raw, ScanError, check_array

#: A box of voxels along (z, y, x).
Box = tuple[slice, slice, slice]
#: A box as a caller gives it: `"z0:z1,y0:y1,x0:x1"`, or three slices.
Crop = str | Sequence[slice]


@dataclass(frozen=True)
class Part:
    """A channel and a time, counted from 0, and a box of a file's array; None stands for all."""

    channel: int | None = None
    time: int | None = None
    crop: Box | None = None

    def index(self, shape: Sequence[int], axes: Axes, place: object) -> tuple[tuple[slice, ...], tuple[int, ...]]:
        """Return the slices, one per axis, that take this part of an array in a file, and the axes z, y and x.

        Among four axes that the file does not name, that of channels is the shorter one of the first and the last.
        """
        picked = self._pick(shape, axes, place)
        space = [axis for axis, n in enumerate(shape) if n != 1 and axis not in picked]
        if len(space) != 3:
            got = "no values" if 0 in shape else f"{len(space)}D of shape {tuple(shape)}"
            hint = "; a channel, counted from 0, picks one volume of several" if len(space) == 4 and not picked else ""
            raise ScanError(f"a volume must be 3D, got {got} in {place}{hint}")
        missing = {name: shape[axis] for axis, (name, number) in picked.items() if number is None and shape[axis] > 1}
        if missing:
            held = " of ".join(f"{count} {name}s" for name, count in missing.items())
            asked = " and ".join(f"a {name} from 0 to {count - 1}" for name, count in missing.items())
            raise ScanError(f"{place} holds {held}: choose {asked}")
        index = [slice(0, n) for n in shape]
        for axis, (_, number) in picked.items():
            index[axis] = slice(number or 0, (number or 0) + 1)
        box = resolve_box(self.crop, [shape[axis] for axis in space], place)
        for axis, edge in zip(space, box, strict=True):
            index[axis] = edge
        return tuple(index), tuple(space)

    def _pick(self, shape: Sequence[int], axes: Axes, place: object) -> dict[int, tuple[str, int | None]]:
        """Return the axes that are not of space, each with its name and the number that is asked for, if one is."""
        channel, time = axes
        long = [axis for axis, n in enumerate(shape) if n != 1]
        if channel is None and self.channel is not None:
            if time is not None and self.time is None:  # the channels are the times
                channel, time = time, None
            elif len(rest := [axis for axis in long if axis != time]) == 4:
                channel = rest[0] if shape[rest[0]] <= shape[rest[-1]] else rest[-1]
        picked: dict[int, tuple[str, int | None]] = {}
        for name, axis, number in (("channel", channel, self.channel), ("time", time, self.time)):
            if axis is None and number is not None:
                other = " (a channel picks one of several without names)" if name == "time" and len(long) == 4 else ""
                raise ScanError(f"{place} names no axis of {name}s, got {name} {quoted(number)}{other}")
            count = 1 if axis is None else shape[axis]
            number_or_first = check_int(number or 0, f"a {name} that is a whole number from 0", -SEEDS, SEEDS)
            if not 0 <= number_or_first < max(count, 1):
                raise ScanError(f"{name} must be from 0 to {count - 1} for {place}, got {number}")
            if axis is not None:
                picked[axis] = name, number
        return picked


def name_axes(names: Sequence[str], place: object) -> Axes:
    """Return the axes `c` and `t` of an array whose axes have names; ScanError where x, y and z are in other order."""
    space = [name for name in names if name in ("z", "y", "x")]
    if space != sorted(space, reverse=True):
        raise ScanError(f"axes must be in the order z, y, x, got {''.join(names)[:20]} in {place}")
    channel, time = (names.index(name) if name in names else None for name in "ct")
    return Axes(channel, time)


def read_part(array: Any, part: Part | None, place: object, axes: Axes = UNNAMED) -> Raw:
    """Read an array that is not in memory (a dataset, a mapped file), or a part of it."""
    values = array[index_of(array, part, place, axes)]
    if isinstance(values, np.memmap):
        values = np.array(values)
    return Raw(np.asarray(values), axes=axes, whole=None if part is None else tuple(array.shape))


def index_of(array: Any, part: Part | None, place: object, axes: Axes = UNNAMED) -> Any:
    """Return the index of a part of an array, or of the whole; raise ScanError if it does not fit into memory."""
    if part is None:
        check_array(array.shape, array.dtype, place)
        return ...
    index, _ = part.index(array.shape, axes, place)
    check_array([edge.stop - edge.start for edge in index], array.dtype, place)
    return index


def take_part(raw: Raw, part: Part, place: object) -> tuple[Raw, tuple[int, ...]]:
    """Return a part of a file's content, with three axes and their spacing, and its first voxel (z, y, x)."""
    if raw.values.dtype.kind not in "biuf":
        raise ScanError(f"a volume must hold real numbers, got values of type {raw.values.dtype} in {place}")
    shape = raw.values.shape if raw.whole is None else raw.whole
    index, space = part.index(shape, raw.axes, place)
    values, spacing = raw.values[index] if raw.whole is None else raw.values, raw.spacing
    if spacing is not None and len(spacing) == len(shape):
        spacing = tuple(spacing[axis] for axis in space)
    volume = values.reshape([values.shape[axis] for axis in space])
    numbers = {"Channel": part.channel, "Time": part.time}
    notes = (*raw.notes, *(f"{name} {n} is used." for name, n in numbers.items() if n is not None))
    return raw._replace(values=volume, spacing=spacing, notes=notes), tuple(index[axis].start for axis in space)


def parse_box(crop: Crop | None) -> Box | None:
    """Return a crop as three slices."""
    if crop is None:
        return None
    parts: Any = list(map(_parse_slice, crop.split(","))) if isinstance(crop, str) else crop
    if not isinstance(parts, Sequence) or len(parts) != 3 or not all(map(_is_plain, parts)):
        raise ScanError(f'crop must be "z0:z1,y0:y1,x0:x1" or three slices, got {quoted(crop)}')
    return parts[0], parts[1], parts[2]


def resolve_box(box: Box | None, shape: Sequence[int], place: object) -> Box:
    """Return a box in a volume of a shape (z, y, x), with all its ends counted from the first voxel."""
    if box is None:
        return slice(0, shape[0]), slice(0, shape[1]), slice(0, shape[2])
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
