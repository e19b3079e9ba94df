"""The numbers of bodies one by one, as of the mitochondria, cells or vessels of a label image."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy import ndimage

from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import Cluster, join_workers
from curvafit.geometry.diagrams import BIN_WIDTH, TAIL_SHARE
from curvafit.geometry.morphology import SOFTENED, local_thickness
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
#: Background that is read around a body, in voxels beyond half its thickness, for the borders of the working grid.
_AROUND = 5
#: Labels below this are counted without sorting the voxels.
_DENSE = 2**20
#: Voxels a side of the blocks in which labels are looked for, the names of the passes, and of the labels in errors.
_BLOCK, _LOOK, _MEASURE, _LABELS = 256, "looking for instances", "measuring instances", "labels of instances"
#: Name, symbol and power of each number of a body, and how it comes from sums.
OF_BODIES: tuple[tuple[str, str, int, Callable[[whole.Sums], np.ndarray]], ...] = (
    ("volume", "V", 3, lambda s: s["inside"]),
    ("surface", "S", 2, lambda s: s["area"]),
    ("sphericity", "Ψ", 0, lambda s: np.where(s["cut"], np.nan, np.cbrt(36 * math.pi * s["inside"] ** 2) / s["area"])),
    ("elongation", "E", 0, lambda s: s["elongation"]),
    ("area at the border", "S.cut", 2, lambda s: s["cut"]),
    *(quantity for quantity in whole.QUANTITIES if quantity[1] not in _OF_TEXTURES),
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
        measured = tuple(body["measures"] for body in bodies)
    if len(measured) == 1:
        label, box = boxes.popitem()
        _, count = ndimage.label(round_labels(volume.read(box)) == label, np.ones((3, 3, 3)))  # type: ignore[misc]
        if count > 1:
            note = f"Label {label} is {count} pieces: if each is a body, number them first (docs: figure/cells)."
            return (replace(measured[0], notes=(*measured[0].notes, note)),)
    return measured


def _look_for_labels(volume: Volume, blocks: Sequence[Box], number: int) -> Record:
    """Return a block's labels but 0 ("names"), the start and stop of each along the axes in the volume ("ends"),
    `count_alike` of the block, and whether it has background ("other")."""
    block = blocks[number]
    values = whole_labels(volume.read(block), _LABELS)
    # find_objects takes small numbers from 1 on: small labels are raised by 1, others are replaced by their rank.
    if values.min() >= 0 and values.max() < _DENSE:
        index = values.astype(np.int32)
        labels, index = np.flatnonzero(np.bincount(index.ravel())).astype(values.dtype), index + 1
    else:
        labels, index = np.unique(values, return_inverse=True)
        index = index.reshape(values.shape) + 1
    boxes = [box for box in ndimage.find_objects(index) if box is not None]
    ends = [[(b.start + e.start, b.start + e.stop) for b, e in zip(block, box, strict=True)] for box in boxes]
    kept = labels != 0
    return {"names": labels[kept], "ends": np.array(ends)[kept], "alike": count_alike(values), "other": not kept.all()}


def _join_boxes(records: Sequence[Record]) -> dict[int, Box]:
    """Return the box of each label of a volume, by ascending label; raise ScanError where the values are no labels."""
    judge_labels(np.sum([record["alike"] for record in records], axis=0), _LABELS)
    labels, index = np.unique(np.concatenate([record["names"] for record in records]), return_inverse=True)
    ends = np.concatenate([record["ends"] for record in records])
    starts, stops = np.full((len(labels), 3), np.iinfo(np.int64).max), np.zeros((len(labels), 3), dtype=np.int64)
    np.minimum.at(starts, index, ends[..., 0])
    np.maximum.at(stops, index, ends[..., 1])
    if len(labels) == 1 and not any(record["other"] for record in records):
        raise ScanError("expected background or several instances, got one that fills the volume")
    rows = zip(labels.tolist(), starts.tolist(), stops.tolist(), strict=True)
    return {label: tuple(map(slice, start, stop)) for label, start, stop in rows}  # type: ignore[misc]


def _measure_body(volume: Volume, boxes: Sequence[tuple[int, Box]], number: int) -> Record:
    """Return the measures of the body number `number` of a list of labels and their boxes."""
    label, box = boxes[number]

    def read(margins: int | Sequence[int]) -> np.ndarray:
        return round_labels(volume.read(grow(box, margins, volume.shape))) == label

    mask = read(SOFTENED)
    thickness = local_thickness(mask, volume.spacing)
    margins = [math.ceil(float(thickness.max()) / 2 / h) + _AROUND for h in volume.spacing]
    try:
        prepared = prepare(Volume(read(margins), volume.spacing, volume.unit), kind="mask")
        (curved, diagram), notes = whole.measure_curvatures(prepared), prepared.notes
        # There may be thousands of bodies: each keeps a binned diagram.
        diagram = diagram.thin(BIN_WIDTH / prepared.working_voxel * WORKING_SPACING, TAIL_SHARE)
    except ValueError as reason:  # too thin, or without a surface away from the image's borders
        curved, diagram, notes = whole.no_curvature(volume.unit, reason)
    surface = whole.measure_surface(mask, volume.spacing, False)
    gap = euler = np.zeros_like(thickness)  # the gap is not measured, and χ not from shares
    maps = whole.Maps(volume.spacing, mask, thickness, gap, euler, surface, curved, diagram, "mask", notes)
    total = dict(zip(whole.SUMS, maps.sum(whole.Blocks(mask.shape, ((0,),) * 3))[0], strict=True))  # type: ignore[arg-type]
    total |= {"χ": euler_number(mask), **_measure_extent(read(0), box, volume)}
    with np.errstate(divide="ignore", invalid="ignore"):  # without curvature
        quantities = tuple(
            whole.Quantity(name, symbol, float(figure(total)), math.nan, power)
            for name, symbol, power, figure in OF_BODIES
        )
    axis, part = whole.find_direction(total), ("instance", label)
    measures = whole.Measures(volume.source, volume.unit, "mask", quantities, axis, diagram, (1, 1, 1), notes, part)
    return {"measures": measures}


def _measure_extent(body: np.ndarray, box: Box, field: Volume) -> dict[str, float]:
    """Return the longest over the middle axis of a body's ellipsoid of moments, and its area in the image's faces."""
    edges = np.array(field.spacing)
    positions = np.argwhere(body) * edges
    # A voxel is a box with moments of its own: without them a row of voxels would have no width.
    moments = np.cov(positions.T, bias=True) + np.diag(edges**2) / 12
    _, middle, longest = np.linalg.eigvalsh(moments)
    cut_area = 0.0
    for axis, (side, n) in enumerate(zip(box, field.shape, strict=True)):
        faces = [0] * (side.start == 0) + [-1] * (side.stop == n)
        cut_area += sum(np.count_nonzero(body.take(face, axis)) for face in faces) * math.prod(np.delete(edges, axis))
    return {"elongation": math.sqrt(longest / middle), "cut": cut_area}
