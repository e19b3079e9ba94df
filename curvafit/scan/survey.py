"""What all tiles of a volume must have in common: its kind, threshold, noise and thickness, found box by box.

Three passes read the volume. The first finds its extremes and kind; the second, for images alone, Otsu's threshold (and
before it the padding, where one value fills much of the image); the third counts the structure and finds the box with
most surface. There the thickness is measured that sets the working grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from curvafit.geometry.balls import border_distance
from curvafit.scan import preparation
from curvafit.scan import structure as splitting
from curvafit.scan.grids import MEASURED, candidate_boxes, pick_box, surface_voxels, thickness_beneath
from curvafit.scan.measures import MOST, Blocks
from curvafit.scan.structure import LAGS, Structure, add_records, find_levels
from curvafit.volumes.run import Record, Run
from curvafit.volumes.volume import Box, Volume, cut_boxes, grow, within


@dataclass(frozen=True)
class Plan:
    """What the tiles of a volume have in common.

    `smallest` is the fewest voxels of a piece of an image's structure that is no speck, 0 where all pieces count;
    `scale` is the edges of a working voxel in the volume's voxels, `edge` its edge in the volume's unit, and `working`
    the number of working voxels along (z, y, x); `reach` is the radius of the largest ball where the thickness was
    measured; `unresolved` says why a structure too thin for curvature has none. Tiles have `cores`; balls of structure
    and background are painted on grids coarser by `factors`. With `maps`, structure and thickness are kept at each
    voxel.
    """

    structure: Structure
    noise: bool
    notes: tuple[str, ...]
    smallest: float = 0.0
    thickness: float = 0.0
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    working: tuple[int, int, int] = (0, 0, 0)
    edge: float = 1.0
    reach: float = 0.0
    working_notes: tuple[str, ...] = ()
    unresolved: str = ""
    cores: tuple[Box, ...] = ()
    factors: tuple[int, int] = (1, 1)
    maps: bool = False

    @property
    def volume(self) -> Volume:
        """The volume that is measured."""
        return self.structure.volume

    @property
    def finest(self) -> Blocks:
        """The finest division into blocks: any division into up to `MOST` blocks along an axis joins some of them."""
        shape = self.volume.shape
        starts = (sorted({n * k // count for count in range(1, MOST + 1) for k in range(count)}) for n in shape)
        return Blocks(shape, tuple(map(tuple, starts)))  # type: ignore[arg-type]


def survey(structure: Structure, run: Run) -> Plan:
    """Find what the tiles of a volume have in common; raise ScanError as `tiles.measure`."""
    volume = structure.volume
    structure, note = splitting.find_split(structure, run)
    pieces = cut_boxes(volume.shape, round(splitting.PIECE ** (1 / 3)))
    total = add_records(run("counting the structure", partial(_count_structure, structure, pieces), len(pieces)))
    if structure.kind == "image":
        note = splitting.describe_image(structure, total)
    size, filled = math.prod(volume.shape), int(total["above"][0])
    splitting.check_phases(filled, size)
    noise = structure.kind != "field" and splitting.pairs_of_noise(volume.shape, filled / size, total["pairs"])
    plan = Plan(structure, noise, (*volume.notes, note))
    structure_is_thinner = filled <= preparation.HALF * size
    candidates = candidate_boxes(volume.shape, MEASURED)
    median, thick, plan = _measure_thickness(plan, pick_box(candidates, total["surface"].tolist()), True)
    if structure.kind == "image":
        plan = replace(plan, smallest=preparation.smallest_piece(median) / math.prod(volume.spacing))
    if not structure_is_thinner:
        box = pick_box(candidates, total["other surface"].tolist())
        median, thick, plan = _measure_thickness(plan, box, False)
    # the working grid, as `preparation.prepare` chooses it
    keeps_grid, name = structure.kind == "field" or noise, "structure" if structure_is_thinner else "background"
    try:
        note = preparation.judge_thickness(name, median, thick, volume.spacing, keeps_grid)
    except preparation.Unresolved as reason:
        return replace(plan, thickness=median, unresolved=str(reason))
    scale, why = preparation.choose_scale(volume.shape, volume.spacing, median, keeps_grid)
    working = preparation.count_voxels(volume.shape, scale) if min(volume.shape) > 3 else (0, 0, 0)  # no curvature
    edge = preparation.working_edge(scale, volume.spacing)
    return replace(plan, thickness=median, scale=scale, working=working, edge=edge, working_notes=(note, *why))


def _measure_thickness(plan: Plan, box: Box, inside: bool) -> tuple[float, float, Plan]:
    """Return the median and 95th percentile of a phase's thickness in a box, and the plan with its reach."""
    spacing = plan.volume.spacing
    around = grow(box, 1, plan.volume.shape)  # a voxel is on the surface by its neighbours
    phase = (find_levels(plan.structure, around) > 0) == inside
    mask, surface = (voxels[within(box, around)] for voxels in (phase, surface_voxels(phase)))
    median, thick = thickness_beneath(mask, surface, spacing)
    half = max(n * h for n, h in zip(mask.shape, spacing, strict=True)) / 2
    reach = float(np.abs(border_distance(mask, spacing, half, both=True)).max())
    return median, thick, replace(plan, reach=max(plan.reach, reach))


def _count_structure(structure: Structure, pieces: Sequence[Box], number: int) -> Record:
    """Return a piece's count of structure voxels, surface voxels in `candidate_boxes`, `count_pairs` and extremes."""
    core, shape = pieces[number], structure.volume.shape
    box = grow(core, max(LAGS), shape)
    inner = within(core, box)
    levels = find_levels(structure, box)
    mask = levels > 0
    overlaps = [
        tuple(slice(max(a.start - b.start, 0), max(a.stop - b.start, 0)) for a, b in zip(candidate, core, strict=True))
        for candidate in candidate_boxes(shape, MEASURED)
    ]
    record = splitting.count_levels(structure, levels[inner])
    for name, phase in (("surface", mask), ("other surface", ~mask)):
        surface = surface_voxels(phase)[inner]
        record[name] = np.array([np.count_nonzero(surface[overlap]) for overlap in overlaps], dtype=np.int64)
    record["pairs"] = splitting.count_pairs(mask, inner, core, shape)
    return {name: np.asarray(value) for name, value in record.items()}
