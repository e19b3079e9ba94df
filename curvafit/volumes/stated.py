"""From what a file states to a volume: axes in the order z, y, x, one channel and time, lengths in one unit.

What a file states is used, or refused in a sentence, or said in a note.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from curvafit.core.checks import SEEDS, check_int, quoted
from curvafit.core.units import common_unit, convert_length, is_unit, parse_unit
from curvafit.volumes.formats.base import ScanError, Stated, affine_of
from curvafit.volumes.volume import StoredArray, Volume, positive_triple

#: Cosine of the angle of two axes up to which they count as at right angles: a shear of 2 % turns normals by a degree.
RIGHT = 0.02


def to_volume(
    stated: Stated,
    source: str,
    *,
    spacing: Sequence[float] | float | None = None,
    unit: str | None = None,
    channel: int | None = None,
    time: int | None = None,
) -> Volume:
    """Return the volume that a file states; the options are those of `load`.

    Raises ScanError where the array has no three axes of space, or several channels or times and no choice of one;
    where axes are not at right angles; or where lengths are in no known unit and the caller gives none.
    """
    array = stated.array
    if array.dtype.kind not in "biuf":
        raise ScanError(f"a volume must hold real numbers, got values of type {array.dtype} in {source}")
    order, numbers, notes = _find_axes(array.shape, stated.axes, channel, time, source)
    index = tuple(numbers.get(axis, slice(0, n)) for axis, n in enumerate(array.shape))
    if isinstance(array, np.ndarray):
        turned = array[index].transpose([sorted(order).index(axis) for axis in order])
        array = np.ascontiguousarray(turned, dtype=array.dtype.newbyteorder("="))
    else:
        array = StoredArray(array, index, order)
    edges, name, scale, more = _find_lengths(stated, order, spacing, unit, source)
    affine, origin = stated.affine, _take_three(stated.origin, order, stated.axes)
    if affine is not None:
        affine = np.diag([scale[2]] * 3 + [1.0]) @ affine
        if spacing is not None or stated.steps is None:
            lengths = np.linalg.norm(affine[:3, :3], axis=0)
            affine[:3, :3] *= edges[::-1] / np.where(lengths > 0, lengths, 1)
    elif origin is not None and any(origin):
        affine = affine_of(np.diag(edges[::-1]), (scale * origin)[::-1])
    notes = (*stated.gaps, *stated.notes, *notes, *more)
    notes += stated.guesses if spacing is None and unit is None else ()
    volume = Volume(array, tuple(edges.tolist()), name, affine, source, notes)
    if affine is not None and spacing is None:
        _check_angles(affine[:3, :3], source)
    return volume


def _find_axes(
    shape: Sequence[int], axes: str, channel: int | None, time: int | None, source: str
) -> tuple[tuple[int, int, int], dict[int, int], tuple[str, ...]]:
    """Return the axes z, y and x of an array, the number to take of each other axis, and notes.

    Axes without a name are z, y and x in turn; of four, that of channels is the shorter one of the first and the last.
    An axis of times or channels of slices without a z is taken for z, and one of times by `channel` where there are no
    channels.
    """
    long = [axis for axis, n in enumerate(shape) if n != 1]
    named = {axes[axis]: axis for axis in long if axes[axis] != "?"}
    free = [axis for axis in long if axes[axis] == "?"]
    lacking, taken = [letter for letter in "zyx" if letter not in named], ()
    if len(free) == len(lacking) + 1 and channel is not None and not {"c", "s"} & named.keys():
        named["c"] = free.pop(0 if shape[free[0]] <= shape[free[-1]] else -1)
    if len(free) == len(lacking):
        named |= dict(zip(lacking, free, strict=True))
    elif lacking == ["z"] and not free and (letter := "t" if "t" in named else "c") in named:
        named["z"] = named.pop(letter)
        what = "times" if letter == "t" else "channels"
        taken = (f"The file calls an axis of {shape[named['z']]} {what}: it is taken for slices.",)
    space = [named[letter] for letter in "zyx" if letter in named]
    others = {"channel": named.get("s", named.get("c")), "time": named.get("t")}
    if others["channel"] is None and channel is not None and time is None:
        others = {"channel": others["time"], "time": None}
    numbers = _pick_numbers(shape, others, {"channel": channel, "time": time}, source, len(long))
    if len(space) != 3 or len(long) != 3 + len(numbers) or 0 in shape:
        got = "no values" if 0 in shape else f"{len(long) - len(numbers)}D of shape {tuple(shape)}"
        hint = "; a channel, counted from 0, picks one volume of several" if (len(long), len(numbers)) == (4, 0) else ""
        raise ScanError(f"a volume must be 3D, got {got} in {source}{hint}")
    if missing := {name: shape[axis] for name, axis in others.items() if axis is not None and numbers[axis] is None}:
        held = " of ".join(f"{count} {name}s" for name, count in missing.items())
        asked = " and ".join(f"a {name} from 0 to {count - 1}" for name, count in missing.items())
        raise ScanError(f"{source} holds {held}: choose {asked}")
    used = {"Channel": channel, "Time": time}
    notes = (f"{name} {number} is used." for name, number in used.items() if number is not None)
    single = {axis: 0 for axis, n in enumerate(shape) if n == 1}
    return (space[0], space[1], space[2]), {**single, **numbers}, (*taken, *notes)  # type: ignore[dict-item]


def _pick_numbers(
    shape: Sequence[int],
    axes: Mapping[str, int | None],
    asked: Mapping[str, int | None],
    source: str,
    count: int,
) -> dict[int, int | None]:
    """Return the number to take of the axis of channels and that of times, None where none is asked for."""
    numbers: dict[int, int | None] = {}
    for name, axis in axes.items():
        number = asked[name]
        if number is not None:
            check_int(number, f"a {name} that is a whole number from 0", -SEEDS, SEEDS)
            if axis is None:
                other = " (a channel picks one of several without names)" if name == "time" and count == 4 else ""
                raise ScanError(f"{source} names no axis of {name}s, got {name} {number}{other}")
            if not 0 <= number < shape[axis]:
                raise ScanError(f"{name} must be from 0 to {shape[axis] - 1} for {source}, got {number}")
        if axis is not None:
            numbers[axis] = number
    return numbers


def _take_three(values: Sequence[Any] | None, order: Sequence[int], axes: str) -> Any:
    """Return what is stated along z, y and x, of what is stated along all axes or these three; an axis that is taken
    for z has what is stated of z."""
    if values is None or len(values) != len(axes):
        return values
    z = axes.index("z") if "z" in axes else order[0]
    return values[z], values[order[1]], values[order[2]]


def _find_lengths(
    stated: Stated, order: Sequence[int], spacing: Sequence[float] | float | None, unit: str | None, source: str
) -> tuple[np.ndarray, str, np.ndarray, tuple[str, ...]]:
    """Return voxel edges (z, y, x), their unit, factors from the file's units to it, and a note.

    A caller's unit alone converts lengths in a unit that the file names, and names that of others.
    """
    units = _take_three(stated.units, order, stated.axes)
    own, factors = common_unit([each or stated.custom for each in units])
    if not is_unit(own) and (spacing is None or unit is None):
        raise ScanError(f"{source} states lengths in {quoted(own)}, which is not known: give --spacing and --unit")
    try:
        given, times = parse_unit(own if unit is None else unit)
        edges = None if spacing is None else np.array(positive_triple(spacing))
        steps = None if stated.steps is None or spacing is not None else _take_three(stated.steps, order, stated.axes)
        steps = None if steps is None else positive_triple(steps)
    except ValueError as reason:
        raise ScanError(f"{reason} for {source}") from None
    measured = is_unit(own) and parse_unit(own)[0] != "voxel" and any(units)
    if unit is not None and measured and given == "voxel" and spacing is None:
        raise ScanError(f"lengths of {source} are in {own}, which no --unit voxel converts: give --spacing too")
    by = convert_length(1.0, own, given) if unit is not None and measured else times
    scale, note = np.array(factors) * float(f"{by:.15g}"), ()
    if edges is not None:
        if unit is None and given == "voxel" and edges.min() != 1:  # edges of which the finest is 1 are ratios
            raise ScanError(f"expected the unit of the spacing {quoted(spacing)} of {source}, such as mm, got none")
        edges = edges if unit is None else times * edges
    elif steps is not None:
        edges = scale * steps
    else:
        edges = np.full(3, 1.0 if unit is None else times)
        counted = "counted in voxels" if given == "voxel" else f"those of voxels of 1 {given}"
        note = (f"The file states no spacing: lengths are {counted}.",)
    return edges, given, scale, note


def _check_angles(matrix: np.ndarray, source: str) -> None:
    """Raise ScanError where the axes of voxels, columns of a matrix, are not at right angles."""
    directions = matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    cosine = np.abs(directions.T @ directions - np.eye(3)).max()
    if not np.isfinite(cosine):
        raise ScanError(f"the axes of {source} are no numbers: give --spacing")
    if cosine > RIGHT:
        angle = np.degrees(np.arccos(min(cosine, 1.0)))
        raise ScanError(
            f"the axes of {source} meet at {angle:.3g}°, not at right angles: resample it, or give --spacing"
        )
