"""The numbers of a scan that need not fit into memory: sums over tiles, each read with what lies around it.

Every number of `measure` follows from sums over blocks. A tile sums what lies in its core, on the finest division that
blocks may need; what surrounds the core is read because balls, distances and pieces of structure reach across its
faces. So a scan in tiles has the numbers of the scan in one piece.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import Any, Literal, NamedTuple

import numpy as np

from curvafit.core.checks import check_int
from curvafit.core.runtime import Progress, check_memory, memory, silent
from curvafit.core.units import format_sampling
from curvafit.core.workers import Cluster
from curvafit.geometry.balls import NEAR, ball_radii, paint_balls, paint_coarse_balls, reaching_radius
from curvafit.geometry.diagrams import BIN_WIDTH, MARGIN, Diagram
from curvafit.geometry.mesh import NoSurface, march
from curvafit.geometry.morphology import SOFTENED, border_weights, connectivity_density, measure_connectivity, soften
from curvafit.geometry.topology import euler_of_window, euler_shares
from curvafit.priors.grid import WORKING_SPACING, Grid
from curvafit.priors.kernels.threads import one_thread
from curvafit.scan import measures as whole
from curvafit.scan.grids import CutOut, distance_reach, profile_mask, remove_specks, resample, resample_mask
from curvafit.scan.measures import Blocks, Measures
from curvafit.scan.preparation import DROPPED, LARGEST_BOX, WORKED, Prepared, TooLarge, note_on_filling, smallest_piece
from curvafit.scan.structure import Kind, Structure, check_options, find_levels, read_labels, read_region
from curvafit.scan.survey import Plan, survey
from curvafit.volumes.read import Source, load
from curvafit.volumes.run import Record, open_run
from curvafit.volumes.volume import Box, ScanError, Volume, cut_boxes, grow, within

#: Radius, in voxels of the finest axis, from which balls are painted on a coarser grid, and the largest ball's.
COARSE, WIDEST = 24, 48
#: Working voxels around a core that its curvature depends on: a profile is made of distances of 20 voxels, blurred by
#: 16, and corrected at thin places.
HALO = 32
#: Voxels of a tile with its surroundings, by default; the shortest edge of a core.
LARGEST_TILE, SHORTEST = 224**3, 32
#: Bytes that a voxel of a tile with its surroundings takes, and those of the program itself.
_EACH, _PROGRAM = 100, 300 * 2**20
#: Bins of the stored curvature diagram, in `diagrams.BIN_WIDTH`.
_BIN = 0.25
#: Parts of a volume: all of it, and its region of interest; the region's labels are others.
_WHOLE, INSIDE = "", "inside"
#: The most labels of a region of interest.
MOST_COMPARTMENTS = 100
#: Names of the passes over tiles.
_FIRST, _AGAIN = "measuring tiles", "measuring wide balls"


def measure(
    scan: Source,
    *,
    kind: Kind = "auto",
    periodic: bool = False,
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    roi: Source | None = None,
    tile: int | None = None,
    workers: Cluster | int | None = None,
    store: str | PathLike[str] | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Measures:
    """Measure the structure in a scan of any size, with an interval for each number.

    Volume fraction, thickness, spacing, connectivity, surface and fabric are those of the structure on the scan's own
    voxels, all of them. Curvature is that of the scan on the working grid, as `infer` reads it. Intervals are 95 %, by
    a jackknife over blocks of a period (thickness and spacing) of the structure (`errors`); a scan with fewer than
    eight has none. A stack of under ten slices may have no curvature (NaN, and a note). A scan with a side of more than
    `LARGEST_BOX` voxels is measured in tiles, which have the numbers of the scan in one piece; of Zarr, HDF5, NPY, RAW
    and uncompressed NIfTI no more than a tile is in memory. Raises ValueError if the scan has no structure, or none
    that the voxels resolve, a region does not fit it or it repeats, or a large scan repeats and does not fit into
    memory; or as `curvafit.load`, and FileNotFoundError if there is no such file.

    Parameters
    ----------
    scan
        The path of a file, a `Volume`, or an array or tensor (Z, Y, X).
    kind, periodic, threshold, dark
        As in `infer`.
    roi
        A region of the scan, nonzero where it counts, laid on it by the affines where both have one (a note says how);
        each of its labels is a compartment of its own. Structure, thickness, surface and curvature are those of the
        whole scan, and what lies inside is summed.
    tile
        Voxels a side of a tile, of a scan of any size; by default a large scan's memory decides.
    workers
        Processes that measure tiles of a file without a region, or dask's workers; by default this process does.
    store
        A folder where finished tiles stay, so that a killed run goes on; by default there is none.
    reading
        Options of reading a file, or the place of an array: see `curvafit.load`.
    """
    check_options(kind, threshold, reading.get("label"))
    check_int(SHORTEST if tile is None else tile, f"a tile of {SHORTEST} or more voxels a side", SHORTEST, 2**31)
    options = {"kind": kind, "threshold": threshold, "dark": dark}
    if periodic and (roi is not None or tile is not None):
        raise ValueError("a scan that repeats is measured in one piece and without a region: leave out tile and roi")
    label, region = reading.pop("label", None), None
    volume = load(scan, label=label, **reading, lazy=True)
    if roi is not None:
        region, laid = read_region(roi, volume, scan, **reading)
        region = replace(region, array=read_labels(region, "a region of interest with labels"))
        if (count := len(np.unique(region.values))) > MOST_COMPARTMENTS:
            raise ScanError(f"expected at most {MOST_COMPARTMENTS} labels in a region of interest, got {count}")
        volume = replace(volume, notes=(*volume.notes, *laid))
    sampling, unit, edge = format_sampling(volume.shape, volume.spacing, volume.unit), volume.unit, min(volume.spacing)
    # Lengths are counted in the finest edge: which of two lengths is greater must not depend on a unit.
    spacing = tuple(round(h / edge, 12) for h in volume.spacing)
    volume = replace(volume, spacing=spacing, unit="voxel", affine=None, notes=(f"{sampling}.", *volume.notes))  # type: ignore[arg-type]
    if periodic or (region is None and tile is None and max(volume.shape) <= LARGEST_BOX):
        check_memory(volume.shape, WORKED, "a scan in one piece")
        try:
            return _measure_whole(volume.load(), periodic, progress, **options).scale(edge, unit)  # type: ignore[arg-type]
        except TooLarge:
            if periodic:
                raise
    structure = Structure(volume, region=region, **options)  # type: ignore[arg-type]
    return _measure_tiles(structure, tile, workers, store, progress).scale(edge, unit)


def _measure_whole(field: Volume, periodic: bool, progress: Progress, kind: Kind, **options: Any) -> Measures:
    """Measure a scan in one piece."""
    most = memory() // WORKED if periodic else LARGEST_BOX**3
    maps = whole.measure_maps(field, kind, {**options, "periodic": periodic}, progress, most)
    connectivity = measure_connectivity(maps.mask, field.spacing, periodic=periodic)
    period = sum(float(phase[phase > 0].mean(dtype=np.float64)) for phase in (maps.thickness, maps.gap))
    blocks = Blocks.divide(maps.mask.shape, field.spacing, period)
    return whole.summarise_sums(field, maps.kind, blocks, maps.sum(blocks), connectivity, maps.diagram, maps.notes)


def _describe_tiles(plan: Plan, processes: int) -> str:
    """Return how many tiles there are, and how much memory they take at most, as a sentence."""
    sides = " x ".join(str(max(core[axis].stop - core[axis].start for core in plan.cores)) for axis in range(3))
    spacing, most = plan.volume.spacing, 0
    reach = _reach(plan.reach, min(spacing))
    for core in plan.cores:
        around = grow(core, [math.ceil(reach / h) + 1 for h in spacing], plan.volume.shape)
        boxes = (around, _around(plan, core)[0])
        most = max(most, *(math.prod(edge.stop - edge.start for edge in box) for box in boxes))
    each, base = processes * _EACH * most, (processes + (processes > 1)) * _PROGRAM
    return f"Measured in {len(plan.cores)} tiles of {sides} voxels, in about {(each + base) / 1e9:.2g} GB of memory."


def _choose_edges(plan: Plan) -> tuple[int, ...]:
    """Return the edges of tiles that are `LARGEST_TILE` voxels with their surroundings, on both grids."""
    side, finest = round(LARGEST_TILE ** (1 / 3)), min(plan.volume.spacing)
    edges = []
    for n, h, scale in zip(plan.volume.shape, plan.volume.spacing, plan.scale, strict=True):
        most = side - 2 * math.ceil(_reach(plan.reach, finest) / h)
        most = max(SHORTEST, min(most, int((side - 2 * HALO) * scale)))
        edges.append(math.ceil(n / math.ceil(n / most)))
    return tuple(edges)


def _reach(radius: float, edge: float) -> float:
    """Return how far around a core voxels are read for balls of a radius: as far as those reach that reach into it."""
    return 2 * radius + (NEAR + 1) * edge


# ---- one tile --------------------------------------------------------------------------------------------------------


def measure_tile(plan: Plan, number: int) -> Record:
    """Return the sums over a tile's core, on the rows of the finest division that it touches, and what else adds up."""
    core = plan.cores[number]
    sums = _Sums(plan, core)
    balls = _measure_balls(plan, core, plan.factors)
    mask, inner = balls.mask, within(core, balls.box)
    voxel = math.prod(plan.volume.spacing)
    sums.add("volume", np.ones(mask[inner].shape, dtype=bool), voxel)
    sums.add("inside", mask[inner], voxel)
    sums.add_thickness(balls.thickness, voxel)
    lower = tuple(slice(edge.start - (edge.start > 0), edge.stop) for edge in inner)
    first = tuple(slice(edge.start - part.start, None) for edge, part in zip(inner, lower, strict=True))
    sums.add("χ", euler_shares(mask[lower])[first], 1.0)
    ends = tuple((edge.start == 0, edge.stop == n) for edge, n in zip(core, plan.volume.shape, strict=True))
    record = {"euler": np.float64(euler_of_window(mask[lower], ends)), "pieces": np.array(balls.pieces)}
    record |= {"widest": np.array(balls.widest), "wide": np.array(balls.wide)}
    with_surface = _measure_surface(plan, mask, balls.box, core)
    if with_surface is not None:
        sums.gather("area", *with_surface)
    del mask, balls
    record |= _measure_curvature(plan, core, sums)
    return {**record, **sums.rows}


def _measure_wide(plan: Plan, number: int) -> Record:
    """Return the sums over a tile's core that balls on a coarser grid change."""
    core = plan.cores[number]
    sums, balls = _Sums(plan, core), _measure_balls(plan, core, plan.factors)
    sums.add_thickness(balls.thickness, math.prod(plan.volume.spacing), *(factor > 1 for factor in plan.factors))
    return sums.rows


class _Sums:
    """Sums of a core on the finest division of a volume: of all of it, and of the parts that a region labels, by name.

    The part of no name is all, `INSIDE` the region, and a number one of its labels.
    """

    def __init__(self, plan: Plan, core: Box) -> None:
        finest, names = plan.finest, [_WHOLE]
        self._finest, self._core, self._near, self._labels = finest, core, core, None
        self._where, starts = [], []
        for edge, all_starts in zip(core, finest.starts, strict=True):
            first, last = (int(np.searchsorted(all_starts, at, side="right")) - 1 for at in (edge.start, edge.stop - 1))
            self._where.append(slice(first, last + 1))
            starts.append(tuple(max(all_starts[k] - edge.start, 0) for k in range(first, last + 1)))
        z, y, x = (edge.stop - edge.start for edge in core)
        self._local = Blocks((z, y, x), tuple(starts))  # type: ignore[arg-type]
        if plan.structure.region is not None:  # surface lies up to a working voxel beyond the core
            self._near = grow(core, [math.ceil(s) + 2 for s in plan.scale], plan.volume.shape)
            self._labels = plan.structure.region.read(self._near)
            names += [INSIDE, *(str(label) for label in np.unique(self._labels).tolist() if label)]
        self.tables = {name: np.zeros((finest.count, len(whole.SUMS))) for name in names}

    def add(self, name: str, values: np.ndarray, each: float) -> None:
        """Add a volume's values on the core."""
        for part, table in self.tables.items():
            column = table[:, whole.SUMS.index(name)].reshape(self._finest.counts)
            own = values if part == _WHOLE else values * self._lie_in(part, within(self._core, self._near))
            column[tuple(self._where)] += each * self._local.sums(own).reshape(self._local.counts)

    def add_thickness(self, of: Sequence[np.ndarray], each: float, structure: bool = True, gaps: bool = True) -> None:
        """Add the thickness of structure and background on the core, or of one of them."""
        if structure:
            self.add("thickness", of[0], each)
            self.add("thickness²", np.square(of[0]), each)
        if gaps:
            self.add("gap", of[1], each)

    def gather(self, name: str, places: np.ndarray, columns: np.ndarray) -> None:
        """Add columns, of which the first is `name`, at places in voxels from the volume's first centre."""
        first = whole.SUMS.index(name)
        for part, table in self.tables.items():
            own = self.select(part, places)
            table[:, first : first + columns.shape[1]] += self._finest.gather(places[own], columns[own])

    def select(self, part: str, places: np.ndarray) -> np.ndarray:
        """Return which places, in voxels from the volume's first centre, lie in a part."""
        if part == _WHOLE:
            return np.ones(len(places), dtype=bool)
        corner, shape = np.array([[edge.start, edge.stop - edge.start] for edge in self._near]).T
        voxels = np.clip(np.rint(places) - corner, 0, shape - 1).astype(np.int64)
        return self._lie_in(part, tuple(voxels.T))

    def _lie_in(self, part: str, where: Any) -> np.ndarray:
        assert self._labels is not None
        labels = self._labels[where]
        return labels != 0 if part == INSIDE else labels == int(part)

    @property
    def rows(self) -> Record:
        """Return the numbers of the rows that hold anything, and the rows, of each part."""
        rows = {part: np.flatnonzero(table.any(axis=1)) for part, table in self.tables.items()}
        sums = {f"sums{part}": self.tables[part][numbers] for part, numbers in rows.items()}
        return {**{f"rows{part}": numbers for part, numbers in rows.items()}, **sums}


class _Balls(NamedTuple):
    """The structure in what was read around a core, specks and pinholes that were dropped, and of both phases the
    thickness on the core, the largest ball's radius, and the voxels around which it is larger than `WIDEST`."""

    box: Box
    mask: np.ndarray
    pieces: tuple[int, int]
    thickness: tuple[np.ndarray, np.ndarray]
    widest: tuple[float, float]
    wide: tuple[int, int]


def _measure_balls(plan: Plan, core: Box, factors: tuple[int, int]) -> _Balls:
    """Measure the thickness of both phases on a core, from as much around it as its balls reach; it is left out (0)
    where balls are wider than `COARSE` and yet to be painted on the finer grid."""
    spacing, finest = plan.volume.spacing, min(plan.volume.spacing)
    reach = _reach(min(plan.reach, WIDEST * finest), finest)
    while True:
        box, mask, pieces = _find_structure(plan, core, reach)
        inner = within(core, box)
        radii = [ball_radii(phase, spacing, WIDEST * finest) for phase in (mask, ~mask)]
        largest = [reaching_radius(radius, spacing, inner) for radius in radii]
        if _reach(max(largest), finest) <= reach * (1 + 1e-6):
            break
        reach = _reach(max(largest), finest)
    thickness, widest, wide = [], [], []
    for most, factor in zip(largest, factors, strict=True):
        radius = radii.pop(0)
        widest.append(float(radius[inner].max()))
        wide.append(int(np.count_nonzero(radius[inner] > (WIDEST - 1e-3) * finest)))
        if factor > 1:
            painted = paint_coarse_balls(radius, spacing, factor)[inner]
        elif most <= COARSE * finest:
            painted = paint_balls(radius, spacing, core=inner)[inner]
        else:
            painted = np.zeros_like(radius[inner])
        thickness.append(2 * painted)
    return _Balls(box, mask, pieces, tuple(thickness), tuple(widest), tuple(wide))  # type: ignore[arg-type]


def _find_structure(plan: Plan, core: Box, reach: float) -> tuple[Box, np.ndarray, tuple[int, int]]:
    """Return a box around a core, the structure there, and how many specks and pinholes were dropped."""
    least = 2 * SOFTENED + 2
    around = grow(core, [max(math.ceil(reach / h), least) for h in plan.volume.spacing], plan.volume.shape)
    # a coarser grid begins with the volume: boxes begin and end where two voxels of it meet
    z, y, x = (
        slice(e.start // 2 * 2, min(-(-e.stop // 2) * 2, n)) for e, n in zip(around, plan.volume.shape, strict=True)
    )
    box, pieces = (z, y, x), (0, 0)
    mask = find_levels(plan.structure, box) > 0
    if plan.smallest:
        mask, *pieces = remove_specks(mask, plan.smallest, False, _cut_out(core, box, plan.volume.shape))
    return box, mask, tuple(pieces)  # type: ignore[return-value]


def _cut_out(core: Box, box: Box, shape: Sequence[int]) -> CutOut:
    return CutOut(within(core, box), [(edge.start > 0, edge.stop < n) for edge, n in zip(box, shape, strict=True)])


# ---- surface and curvature -------------------------------------------------------------------------------------------


def _measure_surface(plan: Plan, mask: np.ndarray, box: Box, core: Box) -> tuple[np.ndarray, np.ndarray] | None:
    """Return what `measures.measure_surface` does, of the cells that begin in a core; None if there are none."""
    shape, spacing = plan.volume.shape, plan.volume.spacing
    own = [(edge.start, min(edge.stop, n - 1)) for edge, n in zip(core, shape, strict=True)]
    if any(start >= stop for start, stop in own):
        return None
    part: Box = tuple(slice(start, stop + 1) for start, stop in own)  # type: ignore[assignment]
    around = grow(part, SOFTENED, shape)
    soft = soften(mask[within(around, box)])[within(part, around)]
    try:
        mesh = march(soft, spacing, 0.5)
    except NoSurface:
        return None
    places, columns = whole.tabulate_surface(mesh, spacing)
    places = places + [edge.start for edge in part]
    return places, columns * border_weights(places, shape)[:, None]


def _around(plan: Plan, core: Box) -> tuple[Box, Box]:
    """Return the working voxels that a core's curvature depends on, and those of the core."""
    owned = []
    for edge, n, scale, count in zip(core, plan.volume.shape, plan.scale, plan.working, strict=True):
        start, stop = (count if at == n else min(count, round(at / scale)) for at in (edge.start, edge.stop))
        owned.append(slice(start, stop))
    z, y, x = owned
    return grow((z, y, x), HALO, plan.working), (z, y, x)


def _measure_curvature(plan: Plan, core: Box, sums: _Sums) -> Record:
    """Sum the curvatures in the working cells that begin in a core; return the bins of the diagram and other counts."""
    box, owned = _around(plan, core)
    record: dict[str, Any] = {"specks": np.zeros(2, np.int64), "changed": np.int64(0), "filled": np.int64(0)}
    if min(plan.working) < whole.FEWEST_SLICES or any(edge.start >= edge.stop for edge in owned):
        return record
    values = _find_working_levels(plan, box)
    mask, inner = values > 0, within(owned, box)
    if plan.structure.kind != "field":
        smallest, cut = smallest_piece(plan.thickness / plan.edge), _cut_out(owned, box, plan.working)
        cleaned, *specks = remove_specks(mask, smallest, False, cut)
        record |= {"specks": np.array(specks), "changed": np.count_nonzero((cleaned != mask)[inner])}
        mask, values = cleaned, values[:0]
        del cleaned
    record["filled"] = np.count_nonzero(mask[inner])
    own = [(max(e.start, MARGIN), min(e.stop, n - 1 - MARGIN)) for e, n in zip(owned, plan.working, strict=True)]
    if any(start >= stop for start, stop in own) or mask.all() or not mask.any():
        return record
    # three cells along an axis at least: fewer make no grid
    stops = [min(max(stop, start + 3), n - 1 - MARGIN) for (start, stop), n in zip(own, plan.working, strict=True)]
    wide = [(max(min(start, stop - 3), MARGIN), stop) for (start, _), stop in zip(own, stops, strict=True)]
    part: Box = tuple(slice(start - MARGIN, stop + MARGIN + 1) for start, stop in wide)  # type: ignore[assignment]
    piece = mask[within(part, box)]
    if piece.all() or not piece.any():
        return record
    if plan.structure.kind != "field":
        values = profile_mask(mask)
    try:
        (places, columns), drawn = whole.measure_curvatures(_prepare_part(plan, values[within(part, box)], piece, part))
    except NoSurface:
        return record
    corner = np.asarray(drawn.places) / WORKING_SPACING + [edge.start for edge in part]
    kept = np.ones(len(places), dtype=bool)
    for at, cells, more in zip(corner.T, own, wide, strict=True):
        kept &= (cells == more) | ((at >= cells[0]) & (at < cells[1]))
    sums.gather("curved", places[kept], columns[kept])
    for name in sums.tables:
        record |= _bin(plan, drawn, kept & sums.select(name, places), name)
    return record


def _find_working_levels(plan: Plan, box: Box) -> np.ndarray:
    """Return a box of the working grid above 0 in the structure, as `preparation.prepare` makes it."""
    if plan.scale == (1.0, 1.0, 1.0):
        return find_levels(plan.structure, box)
    volume = plan.volume
    ends = [(math.floor(e.start * s), math.ceil(e.stop * s)) for e, s in zip(box, plan.scale, strict=True)]
    z, y, x = (slice(min(a, n), min(b, n)) for (a, b), n in zip(ends, volume.shape, strict=True))
    blurred = [math.ceil(4 * max(0.0, (s - 1) / 2)) + 2 for s in plan.scale]
    reach = distance_reach(volume.spacing, plan.scale) if plan.structure.kind == "mask" else None
    far = [0 if reach is None else math.ceil(reach / h) + 1 for h in volume.spacing]
    around = grow((z, y, x), [a + b for a, b in zip(blurred, far, strict=True)], volume.shape)
    values, corner = find_levels(plan.structure, around), [edge.start for edge in around]
    start, shape = [edge.start for edge in box], [edge.stop - edge.start for edge in box]
    if plan.structure.kind == "mask":
        return resample_mask(values > 0, volume.spacing, plan.scale, start, shape, corner=corner)
    return resample(values, plan.scale, start, shape, corner=corner)


def _prepare_part(plan: Plan, phase: np.ndarray, mask: np.ndarray, part: Box) -> Prepared:
    """Return a part of the working grid as if it were a scan of its own, at its place in the volume."""
    phase, grid = np.ascontiguousarray(phase, dtype=np.float32), Grid(phase.shape, boundary="replicate")  # type: ignore[arg-type]
    z, y, x = (slice(0, n) for n in phase.shape)
    size = (plan.scale, plan.edge, plan.volume.unit, plan.thickness / plan.edge)
    origin = tuple(edge.start * s for edge, s in zip(part, plan.scale, strict=True))
    return Prepared(plan.structure.kind, phase, mask, grid, *size, ((z, y, x),), (), origin)  # type: ignore[arg-type]


def _bin(plan: Plan, drawn: Diagram, kept: np.ndarray, part: str) -> Record:
    """Return the bins of a diagram's points that are kept: their indices, and area times 1, κ1, κ2 and κ1² + κ2²; and
    the area without curvature, as one that is `lost`."""
    points, weights = drawn.points[kept], drawn.weights[kept]
    width = _BIN * BIN_WIDTH * WORKING_SPACING / plan.edge
    bins = np.floor(points / width).astype(np.int64)
    first = bins.min(0, initial=0)
    columns = int(bins[:, 1].max(initial=0) - first[1]) + 1
    flat = (bins - first) @ np.array([columns, 1])
    moments = np.column_stack([np.ones(len(points)), points, (points**2).sum(1)]) * weights[:, None]
    areas = np.stack([np.bincount(flat, moment) for moment in moments.T], axis=1)
    occupied = np.flatnonzero(areas[:, 0])
    bins = np.stack(np.divmod(occupied, columns), axis=1) + first
    lost = np.float64(drawn.excluded * weights.sum())
    return {f"bins{part}": bins, f"areas{part}": areas[occupied], f"lost{part}": lost}


# ---- all tiles -------------------------------------------------------------------------------------------------------


def _measure_tiles(
    structure: Structure,
    edge: int | None,
    workers: Cluster | int | None,
    store: str | PathLike[str] | None,
    progress: Progress,
) -> Measures:
    same: dict[str, Any] = {}
    workers = workers if structure.volume.in_file and structure.region is None else None
    if store is not None:  # digests take a while
        same = {"scan": structure.volume.digest, "region": structure.region and structure.region.digest, "tile": edge}
        same |= {name: getattr(structure, name) for name in ("kind", "threshold", "dark")}
    with open_run(workers, store, same, progress, {_FIRST: 0.95, _AGAIN: 1.0}) as run, one_thread():
        plan = survey(structure, run)
        plan = replace(plan, cores=tuple(cut_boxes(plan.volume.shape, edge or _choose_edges(plan))))
        stated = _describe_tiles(plan, run.processes)
        records = run(_FIRST, partial(measure_tile, plan), len(plan.cores), stated)
        # the factors that `morphology.local_thickness` chooses
        widest, finest = np.max([record["widest"] for record in records], axis=0), min(plan.volume.spacing)
        wide = replace(plan, factors=tuple(max(1, math.ceil(each / finest / COARSE)) for each in widest))
        again: list[Record] = []
        if max(wide.factors) > 1:
            again = run(_AGAIN, partial(_measure_wide, wide), len(plan.cores))
    return _summarise(wide, records, again, stated)


def _summarise(plan: Plan, records: Sequence[Record], again: Sequence[Record], stated: str) -> Measures:
    """Return the measures of a volume, and of the parts of its region, from what was found in its tiles."""
    finest, shape = plan.finest, plan.volume.shape
    parts = {name.removeprefix("rows") for record in records for name in record if name.startswith("rows")}
    tables = {part: _sum_tiles(plan, records, again, part) for part in parts}
    total = dict(zip(whole.SUMS, tables[_WHOLE].sum(0), strict=True))
    if not 0 < total["inside"] < total["volume"]:
        raise ScanError("expected a structure and background in the scan, got one of them only")
    curved = total["curved"] > 0
    if not curved and min(shape) >= whole.FEWEST_SLICES:
        raise ScanError("expected a surface between structure and background, got none on the working grid")
    period = total["thickness"] / total["inside"] + total["gap"] / (total["volume"] - total["inside"])
    blocks = Blocks.divide(shape, plan.volume.spacing, period)
    χ = float(sum(record["euler"] for record in records))
    density = connectivity_density(χ, shape, plan.volume.spacing, periodic=False)
    none = whole.no_curvature(plan.volume.unit, whole.TOO_THIN)
    notes = (*_notes(plan, records), *(() if curved else none[2]), *([stated] if len(plan.cores) > 1 else []))

    def summarise(part: str, label: int | None = None) -> Measures:
        drawn = _draw(plan, records, part) if tables[part][:, whole.SUMS.index("curved")].any() else none[1]
        connectivity = (χ, density) if part == _WHOLE else None
        table, named = _merge(tables[part], finest, blocks), None if label is None else ("compartment", label)
        return whole.summarise_sums(
            plan.volume, plan.structure.kind, blocks, table, connectivity, drawn, notes, part=named
        )

    if plan.structure.region is None:
        return summarise(_WHOLE)
    labels = sorted(int(part) for part in parts - {_WHOLE, INSIDE})
    return replace(summarise(INSIDE), compartments={label: summarise(str(label), label) for label in labels})


def _sum_tiles(plan: Plan, records: Sequence[Record], again: Sequence[Record], part: str) -> np.ndarray:
    """Return the sums of all tiles over a part on the finest division."""
    table, rows, sums = np.zeros((plan.finest.count, len(whole.SUMS))), f"rows{part}", f"sums{part}"
    for each in records:
        if rows in each:
            table[each[rows]] += each[sums]
    for factor, names in zip(plan.factors, (("thickness", "thickness²"), ("gap",)), strict=True):
        if factor > 1:
            table[:, [whole.SUMS.index(name) for name in names]] = 0
    for each in again:
        if rows in each:
            table[each[rows]] += each[sums]
    return table


def _merge(table: np.ndarray, finest: Blocks, blocks: Blocks) -> np.ndarray:
    """Return the sums over blocks from those over the finest division."""
    sums = table.reshape(*finest.counts, -1)
    for axis, (fine, starts) in enumerate(zip(finest.starts, blocks.starts, strict=True)):
        sums = np.add.reduceat(sums, np.searchsorted(fine, starts), axis=axis)
    return sums.reshape(blocks.count, -1)


def _draw(plan: Plan, records: Sequence[Record], part: str) -> Diagram:
    """Return the diagram of a part over all tiles: the barycentres of its bins."""
    parts = [record for record in records if f"bins{part}" in record]
    bins, areas = (np.concatenate([each[f"{name}{part}"] for each in parts]) for name in ("bins", "areas"))
    bins, index = np.unique(bins, axis=0, return_inverse=True)
    index = index.reshape(-1)
    area, κ1, κ2, square = (np.bincount(index, column, minlength=len(bins)) for column in areas.T)
    points = np.stack([κ1, κ2], axis=1) / area[:, None]
    spread = max(float((square - area * (points**2).sum(1)).sum() / area.sum()), 0.0)
    lost = float(sum(each[f"lost{part}"] for each in parts)) / float(area.sum())
    return Diagram(points, area, f"1/{plan.volume.unit}", math.sqrt(spread), lost)


def _notes(plan: Plan, records: Sequence[Record]) -> tuple[str, ...]:
    """Return notes on how a volume was measured, as `_measure_whole` gives them."""
    notes = [*plan.notes]
    specks, pinholes = (int(n) for n in np.sum([record["pieces"] for record in records], axis=0))
    if specks or pinholes:
        notes.append(DROPPED.format(specks, pinholes))
    wide = np.sum([record["wide"] for record in records], axis=0)
    for name, count in zip(("structure", "background"), wide, strict=True):
        if count:
            share = f"around {count / math.prod(plan.volume.shape):.2g} of the voxels, in the {name}"
            notes.append(f"Balls wider than {2 * WIDEST} voxels count as that wide: {share}.")
    # The same on the working grid, where curvature is measured.
    more, voxels = [*plan.working_notes], max(1, math.prod(plan.working))
    specks, pinholes = (int(n) for n in np.sum([record["specks"] for record in records], axis=0))
    if specks or pinholes:
        changed = sum(int(record["changed"]) for record in records) / voxels
        more.append(DROPPED.format(specks, f"{pinholes}, {changed:.2g} of the volume"))
    more.extend(note_on_filling(sum(int(record["filled"]) for record in records) / voxels))
    return (*notes, *(f"Of curvature: {note}" for note in more))
