"""The numbers of bodies one by one, as of the mitochondria, cells or vessels of a label image."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy import ndimage

from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import Cluster, join_workers
from curvafit.geometry.diagrams import BIN_WIDTH, TAIL_SHARE
from curvafit.geometry.morphology import local_thickness
from curvafit.geometry.topology import euler_number
from curvafit.priors.grid import WORKING_SPACING
from curvafit.scan import measures as whole
from curvafit.scan.preparation import prepare
from curvafit.scan.structure import count_alike, judge_labels, whole_labels
from curvafit.volumes.read import Source, load
from curvafit.volumes.run import Record, Run
from curvafit.volumes.volume import Box, ScanError, Volume, cut_boxes, grow, round_labels

#: Symbols of the numbers that need a volume around a structure: a body has none.
_OF_TEXTURES = ("BV/TV", "Tb.Sp", "Tb.N", "Conn.D", "BS/TV")
#: Background around a body, in voxels beyond half its thickness, that the working grid's borders take.
_AROUND = 5
#: Labels below this are counted without sorting the voxels.
_DENSE = 2**20
#: Voxels a side of the blocks in which labels are looked for, the names of the passes, and what is looked for.
_BLOCK, _LOOK, _MEASURE, _WHAT = 256, "looking for instances", "measuring instances", "labels of instances"
#: Name, symbol and power of each number of a body, and how it comes from sums.
OF_BODIES: tuple[tuple[str, str, int, Callable[[whole.Sums], np.ndarray]], ...] = (
    ("volume", "V", 3, lambda s: s["inside"]),
    ("surface", "S", 2, lambda s: s["area"]),
    ("sphericity", "Ψ", 0, lambda s: math.pi ** (1 / 3) * (6 * s["inside"]) ** (2 / 3) / (s["area"] + s["cut"])),
    ("elongation", "E", 0, lambda s: s["elongation"]),
    ("area at the border", "S.cut", 2, lambda s: s["cut"]),
    *(each for each in whole.QUANTITIES if each[1] not in _OF_TEXTURES),
)


def measure_instances(
    labels: Source, *, workers: Cluster | int | None = None, progress: Progress = silent, **reading: Any
) -> tuple[whole.Measures, ...]:
    """Measure each body of a label image of any size by itself, whatever it touches.

    The values but 0 are the bodies' labels, `part` of the result is `("instance", label)`, and intervals are NaN. What
    the image's border cuts is no surface. Curvature is NaN of a body that is nowhere 3 voxels thick, and a note says
    so. Of a file that is read in boxes no more than a body is in memory. Raises ValueError if the values are grey
    levels; and as `curvafit.load`.

    Parameters
    ----------
    labels
        The path of a file, a `Volume`, or an array or tensor (Z, Y, X).
    workers
        Processes that measure bodies of a file, or dask's workers; by default this process does.
    reading
        Options of reading a file, or the place of an array: see `curvafit.load`.
    """
    if reading.get("label") is not None:
        raise ValueError("instances are all labels of an image: leave out the label of one")
    volume = load(labels, **reading, lazy=True)
    blocks = cut_boxes(volume.shape, _BLOCK)
    with join_workers(workers if volume.in_file else None) as crew:
        run = Run(crew, progress=progress, ends={_LOOK: 0.1, _MEASURE: 1.0})
        boxes = _join_boxes(run(_LOOK, partial(_look_for_labels, volume, blocks), len(blocks)))
        bodies = run(_MEASURE, partial(_measure_body, volume, list(boxes.items())), len(boxes))
        return tuple(body["measures"] for body in bodies)


def _look_for_labels(volume: Volume, blocks: Sequence[Box], number: int) -> Record:
    """Return the labels of a block, the first and last voxels of each, whether there are others, and `count_alike`."""
    block = blocks[number]
    values = whole_labels(volume.read(block), _WHAT)
    if values.min() >= 0 and values.max() < _DENSE:
        index = values.astype(np.int32)
        names, index = np.flatnonzero(np.bincount(index.ravel())).astype(values.dtype), index + 1
    else:
        names, index = np.unique(values, return_inverse=True)
        index = index.reshape(values.shape) + 1
    boxes = [box for box in ndimage.find_objects(index) if box is not None]
    corner = [edge.start for edge in block]
    ends = [[(c + e.start, c + e.stop) for c, e in zip(corner, box, strict=True)] for box in boxes]
    kept = names != 0
    return {"names": names[kept], "ends": np.array(ends)[kept], "alike": count_alike(values), "other": not kept.all()}


def _join_boxes(looked: Sequence[Record]) -> dict[int, Box]:
    """Return the box of each label of a volume, ascending; raise ScanError where the values are no labels."""
    judge_labels(np.sum([each["alike"] for each in looked], axis=0), _WHAT)
    names, index = np.unique(np.concatenate([each["names"] for each in looked]), return_inverse=True)
    ends = np.concatenate([each["ends"] for each in looked])
    first, last = np.full((len(names), 3), np.iinfo(np.int64).max), np.zeros((len(names), 3), dtype=np.int64)
    np.minimum.at(first, index, ends[..., 0])
    np.maximum.at(last, index, ends[..., 1])
    if len(names) == 1 and not any(each["other"] for each in looked):
        raise ScanError("expected background or several instances, got one that fills the volume")
    rows = zip(names.tolist(), first.tolist(), last.tolist(), strict=True)
    return {name: tuple(map(slice, low, high)) for name, low, high in rows}  # type: ignore[misc]


def _measure_body(volume: Volume, boxes: Sequence[tuple[int, Box]], number: int) -> Record:
    """Return the measures of the body of a label, which lies in a box."""
    label, box = boxes[number]

    def read(margins: int | Sequence[int]) -> np.ndarray:
        return round_labels(volume.read(grow(box, margins, volume.shape))) == label

    mask = read(3)  # the reach of the blur before marching cubes
    thickness = local_thickness(mask, volume.spacing)
    around = [math.ceil(float(thickness.max()) / 2 / h) + _AROUND for h in volume.spacing]
    try:
        prepared = prepare(Volume(read(around), volume.spacing, volume.unit), kind="mask")
        (curved, drawn), notes = whole.measure_curvatures(prepared), prepared.notes
        drawn = drawn.thin(BIN_WIDTH / prepared.working_voxel * WORKING_SPACING, TAIL_SHARE)  # there may be thousands
    except ValueError as reason:  # too thin, or without a surface away from the image's borders
        curved, drawn, notes = whole.no_curvature(volume.unit, reason)
    surface = whole.measure_surface(mask, volume.spacing, False)
    gap = euler = np.zeros_like(thickness)  # of the body alone neither is measured
    maps = whole.Maps(volume.spacing, mask, thickness, gap, euler, surface, curved, drawn, "mask", notes)
    total = dict(zip(whole.SUMS, maps.sum(whole.Blocks(mask.shape, ((0,),) * 3))[0], strict=True))  # type: ignore[arg-type]
    total |= {"χ": euler_number(mask), **_measure_extent(read(0), box, volume)}
    with np.errstate(divide="ignore", invalid="ignore"):  # without curvature
        values = [(name, symbol, float(figure(total)), math.nan, power) for name, symbol, power, figure in OF_BODIES]
    quantities, direction = tuple(whole.Quantity(*value) for value in values), whole.find_direction(total)
    one_block, part = (1, 1, 1), ("instance", label)
    measured = whole.Measures(
        volume.source, volume.unit, "mask", quantities, direction, drawn, one_block, notes, part
    )  # fmt: skip
    return {"measures": measured}


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
