"""The numbers of bodies one by one, as of the mitochondria, cells or vessels of a label image."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import ndimage

from curvafit.core.runtime import Progress, silent
from curvafit.geometry.diagram import BIN_WIDTH, TAIL_SHARE
from curvafit.geometry.morphometry import local_thickness
from curvafit.geometry.topology import euler_number
from curvafit.priors.grid import WORKING_SPACING
from curvafit.scan import measure
from curvafit.scan.prepare import prepare
from curvafit.scan.structure import read_labels
from curvafit.volumes.boxes import Box, grow
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import ScanError, Volume

#: Symbols of the numbers that need a volume around a structure: a body has none.
_OF_TEXTURES = ("BV/TV", "Tb.Sp", "Tb.N", "Conn.D", "BS/TV")
#: Background around a body, in voxels beyond half its thickness, that the working grid's borders take.
_AROUND = 5
#: Name, symbol and power of each number of a body, and how it comes from sums.
OF_BODIES: tuple[tuple[str, str, int, Callable[[measure.Sums], np.ndarray]], ...] = (
    ("volume", "V", 3, lambda s: s["inside"]),
    ("surface", "S", 2, lambda s: s["area"]),
    ("sphericity", "Ψ", 0, lambda s: math.pi ** (1 / 3) * (6 * s["inside"]) ** (2 / 3) / (s["area"] + s["cut"])),
    ("elongation", "E", 0, lambda s: s["elongation"]),
    ("area at the border", "S.cut", 2, lambda s: s["cut"]),
    *(each for each in measure.QUANTITIES if each[1] not in _OF_TEXTURES),
)


def measure_instances(labels: Source, *, progress: Progress = silent, **reading: Any) -> tuple[measure.Measures, ...]:
    """Measure each body of a label image by itself, whatever it touches.

    The values but 0 are the bodies' labels, `part` of the result is `("instance", label)`, and intervals are NaN. What
    the image's border cuts is no surface. Curvature is NaN of a body that is nowhere 3 voxels thick, and a note says
    so. Raises ValueError if the values are grey levels; and as `curvafit.load`.

    Parameters
    ----------
    labels
        The path of a file, a `Volume`, or an array or tensor (Z, Y, X).
    reading
        Options of reading a file, or the place of an array: see `curvafit.load`.
    """
    if reading.get("label") is not None:
        raise ValueError("instances are all labels of an image: leave out the label of one")
    field = load(labels, **reading)
    values = read_labels(field, "labels of instances")
    names = np.unique(values[values != 0])
    if len(names) == 1 and values.all():
        raise ScanError("expected background or several instances, got one that fills the volume")
    numbers = np.where(values != 0, np.searchsorted(names, values) + 1, 0).astype(np.int32)
    found = []
    for k, (name, box) in enumerate(zip(names.tolist(), ndimage.find_objects(numbers), strict=True)):
        progress(f"instance {k + 1} of {len(names)}", k / len(names))
        found.append(_measure_body(field, numbers, k + 1, box, name))
    return tuple(found)


def _measure_body(field: Volume, numbers: np.ndarray, number: int, box: Box, label: int) -> measure.Measures:
    """Return the measures of the body of a number, which lies in a box."""
    mask = numbers[grow(box, 3, numbers.shape)] == number  # the reach of the blur before marching cubes
    thickness = local_thickness(mask, field.spacing)
    around = [math.ceil(float(thickness.max()) / 2 / h) + _AROUND for h in field.spacing]
    try:
        body = numbers[grow(box, around, numbers.shape)] == number
        prepared = prepare(Volume(body, field.spacing, field.unit), kind="mask")
        (curved, drawn), notes = measure.measure_curvatures(prepared), prepared.notes
        drawn = drawn.thin(BIN_WIDTH / prepared.working_voxel * WORKING_SPACING, TAIL_SHARE)  # there may be thousands
    except ValueError as reason:  # too thin, or without a surface away from the image's borders
        curved, drawn, notes = measure.no_curvature(field.unit, reason)
    surface = measure.measure_surface(mask, field.spacing, False)
    empty = np.zeros_like(thickness)
    maps = measure.Maps(field.spacing, False, mask, thickness, empty, empty, surface, curved, drawn, "mask", notes)
    total = dict(zip(measure.SUMS, maps.sum(measure.Blocks(mask.shape, ((0,),) * 3))[0], strict=True))  # type: ignore[arg-type]
    total |= {"χ": euler_number(mask), **_measure_extent(numbers[box] == number, box, field)}
    with np.errstate(divide="ignore", invalid="ignore"):  # without curvature
        values = [(name, symbol, float(figure(total)), math.nan, power) for name, symbol, power, figure in OF_BODIES]
    quantities, direction = tuple(measure.Quantity(*each) for each in values), measure.find_direction(total)
    part = ("instance", label)
    return measure.Measures(field.source, field.unit, "mask", quantities, direction, drawn, (1, 1, 1), notes, part)


def _measure_extent(body: np.ndarray, box: Box, field: Volume) -> dict[str, float]:
    """Return the longest over the middle axis of a body's ellipsoid of moments, and its area in the image's faces."""
    # A voxel's own moments count, so that a row of voxels has a width.
    edges = np.array(field.spacing)
    places = np.argwhere(body) * edges
    moments = np.cov(places.T, bias=True) + np.diag(edges**2) / 12
    _, middle, longest = np.linalg.eigvalsh(moments)
    cut = 0.0
    for axis, (where, n) in enumerate(zip(box, field.shape, strict=True)):
        faces = [0] * (where.start == 0) + [-1] * (where.stop == n)
        cut += sum(np.count_nonzero(body.take(end, axis)) for end in faces) * math.prod(np.delete(edges, axis))
    return {"elongation": math.sqrt(longest / middle), "cut": cut}
