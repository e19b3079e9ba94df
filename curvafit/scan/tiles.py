"""The numbers of a scan that need not fit into memory: sums over tiles, each read with its surroundings.

Every number of `measure` follows from sums over blocks. A tile sums over the voxels of its core, in the finest blocks
that may be needed; its surroundings are read because balls, distances and pieces of structure reach across the core's
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
from curvafit.core.units import format_sampling, power_name
from curvafit.core.workers import Cluster
from curvafit.geometry.balls import NEAR, border_distance, paint_balls, paint_coarse_balls, reaching_radius
from curvafit.geometry.diagrams import BIN_WIDTH, MARGIN, Diagram
from curvafit.geometry.mesh import NoSurface, march
from curvafit.geometry.morphology import SOFTENED, border_weights, connectivity_density, measure_connectivity, soften
from curvafit.geometry.topology import euler_of_window, euler_shares
from curvafit.priors.grid import WORKING_SPACING, Grid
from curvafit.priors.kernels.threads import one_thread
from curvafit.scan import measures as whole
from curvafit.scan.grids import CutOut, distance_reach, profile_mask, remove_specks, resample, resample_mask
from curvafit.scan.measures import Blocks, Measures, Outline
from curvafit.scan.preparation import DROPPED, LARGEST_BOX, WORKED, Prepared, TooLarge, note_on_filling, smallest_piece
from curvafit.scan.structure import Kind, Structure, check_options, find_levels, read_labels, read_region
from curvafit.scan.survey import Plan, survey
from curvafit.volumes.read import Source, load
from curvafit.volumes.run import Record, open_run
from curvafit.volumes.volume import Box, ScanError, Volume, cut_boxes, grow, within

#: Radius, in voxels of the finest axis, from which balls are painted on a coarser grid, and the largest ball's.
COARSE, WIDEST = 24, 48
#: Working voxels around a core that its curvature depends on, to a millionth: a profile is made of distances of 20
#: voxels, blurred by 16, and corrected at thin places.
HALO = 28
#: Voxels of a tile with its surroundings, by default; the shortest edge of a core.
LARGEST_TILE, SHORTEST = 264**3, 32
#: Least tiles of a process, so that none waits long for the others at the end.
FEWEST_TILES = 4
#: Bytes that a voxel of a tile with its surroundings takes, and those of the program itself.
_VOXEL_BYTES, _PROGRAM_BYTES = 30, 350 * 2**20
#: What is kept at each voxel where it is asked for, and the bytes that a voxel then takes, with its tile's.
MAPS, KEPT = {"structure": np.uint8, "thickness": np.float32}, 12
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
    maps: bool = False,
    progress: Progress = silent,
    **reading: Any,
) -> Measures:
    """Measure the structure in a scan of any size, with an interval for each number.

    Volume fraction, thickness, spacing, connectivity, surface and fabric are those of the structure on the scan's own
    voxels, all of them. Curvature is that of the scan on the working grid, as `infer` reads it. Intervals are 95 %, by
    a jackknife over blocks of a period (thickness and spacing) of the structure (`errors`); a scan with fewer than
    eight has none. A stack of under ten slices may have no curvature (NaN, and a note), a structure that is nowhere 3
    voxels thick has none. A scan of more than `LARGEST_BOX`³ voxels is measured in tiles, which have the
    numbers of the scan in one piece; of Zarr, HDF5, NPY, RAW and uncompressed NIfTI no more than a tile is in memory.
    Raises ValueError if the scan has no structure, a region does not fit it or it repeats, or a large scan repeats and
    does not fit into memory; or as `curvafit.load`, and FileNotFoundError if there is no such file.

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
    maps
        Whether structure and thickness are kept at each voxel (`Measures.maps`), in memory.
    reading
        Options of reading a file, or the place of an array: see `curvafit.load`.
    """
    check_options(kind, threshold, reading.get("label"))
    check_int(SHORTEST if tile is None else tile, f"a tile of {SHORTEST} or more voxels a side", SHORTEST, 2**31)
    options = {"kind": kind, "threshold": threshold, "dark": dark}
    if periodic and (roi is not None or tile is not None):
        raise ValueError("a scan that repeats is measured in one piece and without a region: leave out tile and roi")
    label, region = reading.pop("label", None), None
    frame = volume = load(scan, label=label, **reading, lazy=True)
    if roi is not None:
        region, region_notes = _read_compartments(roi, volume, scan, reading)
        volume = replace(volume, notes=(*volume.notes, *region_notes))
    volume, unit, edge = _count_in_edges(volume, region), volume.unit, min(volume.spacing)
    if periodic or (region is None and tile is None and math.prod(volume.shape) <= LARGEST_BOX**3):
        check_memory(volume.shape, WORKED, "a scan in one piece")
        try:
            found, arrays = _measure_whole(volume.load(), periodic, progress, **options)  # type: ignore[arg-type]
            return _keep_maps(found.scale(edge, unit), arrays if maps else {}, frame, edge, None)
        except TooLarge:
            if periodic:
                raise
    if maps:
        check_memory(volume.shape, KEPT, "structure and thickness at each voxel, maps,")
    structure = Structure(volume, region=region, **options)  # type: ignore[arg-type]
    found, arrays = _measure_tiles(structure, tile, workers, store, maps, progress)
    return _keep_maps(found.scale(edge, unit), arrays, frame, edge, region)


def _count_in_edges(volume: Volume, region: Volume | None) -> Volume:
    """Return a volume whose lengths are counted in its finest edge, with a note on its voxels and its region: which of
    two lengths is greater must not depend on a unit."""
    spacing, unit, finest = volume.spacing, volume.unit, min(volume.spacing)
    note = format_sampling(volume.shape, spacing, unit)
    if region is not None:
        size, power = np.count_nonzero(region.values) * math.prod(spacing), power_name(unit, 3)
        size, power = (1e-9 * size, "mm³") if unit == "um" and size >= 1e6 else (size, power)
        note += f", measured within a region of interest of {float(f'{size:.3g}'):.15g} {power}"
    edges: Any = tuple(round(h / finest, 12) for h in spacing)
    return replace(volume, spacing=edges, unit="voxel", affine=None, notes=(f"{note}.", *volume.notes))


def _read_compartments(
    roi: Source, volume: Volume, scan: Source, reading: dict[str, Any]
) -> tuple[Volume, tuple[str, ...]]:
    """Return a region of interest with its labels, on a scan's voxels, and notes on how it was laid."""
    region, notes = read_region(roi, volume, scan, **reading)
    region = replace(region, array=read_labels(region, "a region of interest with labels"))
    if (count := len(np.unique(region.values))) > MOST_COMPARTMENTS:
        raise ScanError(f"expected at most {MOST_COMPARTMENTS} labels in a region of interest, got {count}")
    return region, notes


def _keep_maps(
    measures: Measures, arrays: dict[str, np.ndarray], frame: Volume, edge: float, region: Volume | None
) -> Measures:
    """Return measures with arrays (Z, Y, X) as maps on a scan's voxels, 0 outside a region; lengths were in `edge`."""
    volumes = {}
    for name, values in arrays.items():
        counted = values if region is None else np.where(region.values != 0, values, 0)
        scaled = counted * np.float32(edge) if name == "thickness" else counted
        volumes[name] = replace(frame, array=scaled.astype(MAPS[name], copy=False), notes=())
    return replace(measures, maps=volumes)


def _measure_whole(
    field: Volume, periodic: bool, progress: Progress, kind: Kind, **options: Any
) -> tuple[Measures, dict[str, np.ndarray]]:
    """Measure a scan in one piece; return its structure and thickness at each voxel as well."""
    most = memory() // WORKED if periodic else LARGEST_BOX**3
    maps = whole.measure_maps(field, kind, {**options, "periodic": periodic}, progress, most)
    connectivity = measure_connectivity(maps.mask, field.spacing, periodic=periodic)
    period = sum(float(phase[phase > 0].mean(dtype=np.float64)) for phase in (maps.thickness, maps.gap))
    blocks = Blocks.divide(maps.mask.shape, field.spacing, period)
    found = whole.summarise_sums(field, maps.kind, blocks, maps.sum(blocks), connectivity, maps.diagram, maps.notes)
    found = replace(found, outline=Outline.cut(field, maps.mask.__getitem__))
    return found, {"structure": maps.mask, "thickness": maps.thickness}


def _describe_tiles(plan: Plan, processes: int) -> str:
    """Return a sentence on the number of tiles and the memory that they take at most."""
    sides = " x ".join(str(max(core[axis].stop - core[axis].start for core in plan.cores)) for axis in range(3))
    spacing, largest = plan.volume.spacing, 0
    margin = [math.ceil(_read_distance(plan.reach, min(spacing)) / h) + 1 for h in spacing]
    for core in plan.cores:
        boxes = (grow(core, margin, plan.volume.shape), _working_boxes(plan, core)[0])
        largest = max(largest, *(math.prod(edge.stop - edge.start for edge in box) for box in boxes))
    programs = processes + (processes > 1)  # workers, and the process that waits for them
    size = (processes * _VOXEL_BYTES * largest + programs * _PROGRAM_BYTES) / 1e9
    return f"Measured in {len(plan.cores)} tiles of {sides} voxels, in about {size:.2g} GB of memory."


def _choose_edges(plan: Plan, processes: int) -> tuple[int, ...]:
    """Return the edges of tiles, in voxels, of at most `LARGEST_TILE` voxels with their surroundings, on both grids; or
    of more where balls are so wide that a core would be less than half of its tile's edge, and memory allows it."""
    side, finest, shape = round(LARGEST_TILE ** (1 / 3)), min(plan.volume.spacing), plan.volume.shape
    distance = _read_distance(min(plan.reach, WIDEST * finest), finest)
    affordable = (memory() / (4 * processes * WORKED)) ** (1 / 3)
    wide = max(side, int(min(4 * distance / finest, affordable)))
    margins, scale = [math.ceil(distance / h) for h in plan.volume.spacing], np.array(plan.scale)
    longest = np.minimum(wide - 2 * np.array(margins), ((side - 2 * HALO) * scale).astype(int)).clip(SHORTEST)
    counts = np.ceil(shape / longest).astype(int)

    def fits(counts: np.ndarray) -> bool:
        cores, sides = np.ceil(shape / counts), np.minimum(counts - 1, 2)  # with neighbours
        read, worked = cores + sides * margins, cores / scale + sides * HALO
        return read.prod() <= wide**3 and worked.prod() <= LARGEST_TILE and counts.prod() >= FEWEST_TILES * processes

    # Cubes are a start: surroundings are read once less along an axis on which a tile can be longer.
    while fewer := [less for less in counts - np.eye(3, dtype=int) if less.all() and fits(less)]:
        counts = min(fewer, key=lambda less: less.max() - less.min())
    return tuple(np.ceil(shape / counts).astype(int).tolist())


def _read_distance(radius: float, edge: float) -> float:
    """Return how far around a core voxels are read, so that all balls of a radius that overlap the core are whole."""
    return 2 * radius + (NEAR + 1) * edge


# ---- one tile --------------------------------------------------------------------------------------------------------


def measure_tile(plan: Plan, number: int) -> Record:
    """Return the sums over a tile's core, for the finest blocks that it overlaps, and counts that add up over tiles."""
    core = plan.cores[number]
    sums = _Sums(plan, core)
    balls = _measure_balls(plan, core, plan.factors)
    mask, inner = balls.mask, within(core, balls.box)
    voxel = math.prod(plan.volume.spacing)
    sums.add("volume", np.ones(mask[inner].shape, dtype=bool), voxel)
    sums.add("inside", mask[inner], voxel)
    sums.add_thickness(balls, voxel)
    maps = {"structure": mask[inner].copy(), "thickness": balls.thickness[0]} if plan.maps else {}
    # A voxel's share of χ depends on the voxels before it: a layer before the core is taken along, where there is one.
    extended = tuple(slice(edge.start - (edge.start > 0), edge.stop) for edge in inner)
    in_core = tuple(slice(edge.start - outer.start, None) for edge, outer in zip(inner, extended, strict=True))
    sums.add("χ", euler_shares(mask[extended])[in_core], 1.0)
    ends = tuple((edge.start == 0, edge.stop == n) for edge, n in zip(core, plan.volume.shape, strict=True))
    record = {"euler": np.float64(euler_of_window(mask[extended], ends)), "pieces": np.array(balls.pieces)}
    record |= {"widest": np.array(balls.widest), "wide": np.array(balls.wide)}
    surface = _measure_surface(plan, mask, balls.box, core)
    if surface is not None:
        sums.gather("area", *surface)
    del mask, balls
    return {**record, **_measure_curvature(plan, core, sums), **sums.rows, **maps}


def _measure_wide(plan: Plan, number: int) -> Record:
    """Return the sums over a tile's core of thickness whose balls are painted on a coarser grid."""
    core = plan.cores[number]
    sums, balls = _Sums(plan, core), _measure_balls(plan, core, plan.factors)
    sums.add_thickness(balls, math.prod(plan.volume.spacing), *(factor > 1 for factor in plan.factors))
    wide = plan.maps and plan.factors[0] > 1
    return {**sums.rows, **({"thickness": balls.thickness[0]} if wide else {})}


class _Sums:
    """Sums over a core, in a table for each part of the volume: a row for each of the finest blocks, columns `SUMS`.

    The part named "" is all of the volume, `INSIDE` its region of interest, and a number one of the region's labels.
    """

    def __init__(self, plan: Plan, core: Box) -> None:
        finest, parts = plan.finest, [_WHOLE]
        self._finest, self._core, self._labels_box, self._labels = finest, core, core, None
        overlapped, starts = [], []
        for edge, block_starts in zip(core, finest.starts, strict=True):
            first = int(np.searchsorted(block_starts, edge.start, side="right")) - 1
            stop = int(np.searchsorted(block_starts, edge.stop - 1, side="right"))
            overlapped.append(slice(first, stop))
            starts.append(tuple(max(start - edge.start, 0) for start in block_starts[first:stop]))
        z, y, x = (edge.stop - edge.start for edge in core)
        # The finest blocks that the core overlaps, as slices of all blocks and as a division of the core.
        self._overlapped, self._core_blocks = tuple(overlapped), Blocks((z, y, x), tuple(starts))  # type: ignore[arg-type]
        if plan.structure.region is not None:  # surface lies up to a working voxel beyond the core
            self._labels_box = grow(core, [math.ceil(s) + 2 for s in plan.scale], plan.volume.shape)
            self._labels = plan.structure.region.read(self._labels_box)
            parts += [INSIDE, *(str(label) for label in np.unique(self._labels).tolist() if label)]
        self.tables = {part: np.zeros((finest.count, len(whole.SUMS))) for part in parts}

    def add(self, name: str, values: np.ndarray, factor: float) -> None:
        """Add values on the core's voxels, times a factor, to the column `name` of each part."""
        for part, table in self.tables.items():
            column = table[:, whole.SUMS.index(name)].reshape(self._finest.counts)
            inside = values if part == _WHOLE else values * self._is_in(part, within(self._core, self._labels_box))
            column[self._overlapped] += factor * self._core_blocks.sums(inside).reshape(self._core_blocks.counts)

    def add_thickness(self, balls: _Balls, factor: float, structure: bool = True, gaps: bool = True) -> None:
        """Add the thickness of structure and background on the core, or of one of them."""
        thickness, gap = balls.thickness
        if structure:
            self.add("thickness", thickness, factor)
            self.add("thickness²", np.square(thickness), factor)
        if gaps:
            self.add("gap", gap, factor)

    def gather(self, name: str, positions: np.ndarray, columns: np.ndarray, kept: np.ndarray | bool = True) -> None:
        """Add those columns (M, C) that are kept, the first of which is `name`, at positions (M, 3) in voxels from the
        first centre."""
        first = whole.SUMS.index(name)
        for part, table in self.tables.items():
            inside = self.select(part, positions) & kept
            table[:, first : first + columns.shape[1]] += self._finest.gather(positions, columns, inside)

    def select(self, part: str, positions: np.ndarray) -> np.ndarray:
        """Return which positions (M, 3), in voxels from the volume's first centre, lie in a part, bool (M,)."""
        if part == _WHOLE:
            return np.ones(len(positions), dtype=bool)
        corner, shape = np.array([[edge.start, edge.stop - edge.start] for edge in self._labels_box]).T
        voxels = np.clip(np.rint(positions) - corner, 0, shape - 1).astype(np.int64)
        return self._is_in(part, tuple(voxels.T))

    def _is_in(self, part: str, index: Any) -> np.ndarray:
        assert self._labels is not None
        labels = self._labels[index]
        return labels != 0 if part == INSIDE else labels == int(part)

    @property
    def rows(self) -> Record:
        """Return, for each part, the indices of the blocks whose sums are not all 0, and those blocks' sums."""
        rows = {part: np.flatnonzero(table.any(axis=1)) for part, table in self.tables.items()}
        sums = {f"sums{part}": self.tables[part][index] for part, index in rows.items()}
        return {**{f"rows{part}": index for part, index in rows.items()}, **sums}


class _Balls(NamedTuple):
    """The structure in a box around a core, and how many specks and pinholes were dropped; then of structure and
    background the thickness on the core, the largest radius, and the voxels whose radius is about `WIDEST`."""

    box: Box
    mask: np.ndarray
    pieces: tuple[int, int]
    thickness: tuple[np.ndarray, np.ndarray]
    widest: tuple[float, float]
    wide: tuple[int, int]


def _measure_balls(plan: Plan, core: Box, factors: tuple[int, int]) -> _Balls:
    """Measure the thickness of both phases on a core. It stays 0 where balls are wider than `COARSE` but the factor is
    1: such a phase is measured again, with the factor that the widest ball of all tiles asks for."""
    spacing, finest = plan.volume.spacing, min(plan.volume.spacing)
    distance = _read_distance(min(plan.reach, WIDEST * finest), finest)
    while True:  # until all balls that overlap the core are whole
        box, mask, pieces = _find_structure(plan, core, distance)
        inner = within(core, box)
        signed = border_distance(mask, spacing, WIDEST * finest, both=True)
        radii = [np.maximum(signed, 0), np.maximum(-signed, 0)]
        del signed
        largest = [reaching_radius(radius, spacing, inner) for radius in radii]
        needed = _read_distance(max(largest), finest)
        if needed <= distance * (1 + 1e-6):
            break
        distance = needed
    thickness, widest, wide = [], [], []
    for largest_radius, factor in zip(largest, factors, strict=True):
        radius = radii.pop(0)  # so that its memory is freed before the next phase is painted
        widest.append(float(radius[inner].max()))
        wide.append(int(np.count_nonzero(radius[inner] > (WIDEST - 1e-3) * finest)))
        if factor > 1:
            painted = paint_coarse_balls(radius, spacing, factor)[inner]
        elif largest_radius <= COARSE * finest:
            least = largest_radius + (NEAR + 1) * finest  # so far from the core is what counts there
            near = grow(inner, [math.ceil(least / h) for h in spacing], radius.shape)
            place = within(inner, near)
            painted = paint_balls(radius[near], spacing, core=place)[place]
        else:
            painted = np.zeros_like(radius[inner])
        thickness.append(2 * painted)
    return _Balls(box, mask, pieces, tuple(thickness), tuple(widest), tuple(wide))  # type: ignore[arg-type]


def _find_structure(plan: Plan, core: Box, distance: float) -> tuple[Box, np.ndarray, tuple[int, int]]:
    """Return the box up to a distance around a core, its mask, and how many specks and pinholes were dropped."""
    least, shape = 2 * SOFTENED + 2, plan.volume.shape  # the surface needs some voxels around the core, too
    around = grow(core, [max(math.ceil(distance / h), least) for h in plan.volume.spacing], shape)
    # A coarser grid begins with the volume, and its factor is 2: boxes begin and end at even voxels.
    z, y, x = (slice(e.start // 2 * 2, min(-(-e.stop // 2) * 2, n)) for e, n in zip(around, shape, strict=True))
    box, pieces = (z, y, x), (0, 0)
    mask = find_levels(plan.structure, box) > 0
    if plan.smallest:
        mask, *pieces = remove_specks(mask, plan.smallest, False, _cut_out(core, box, shape))
    return box, mask, tuple(pieces)  # type: ignore[return-value]


def _cut_out(core: Box, box: Box, shape: Sequence[int]) -> CutOut:
    return CutOut(within(core, box), [(edge.start > 0, edge.stop < n) for edge, n in zip(box, shape, strict=True)])


# ---- surface and curvature -------------------------------------------------------------------------------------------


def _measure_surface(plan: Plan, mask: np.ndarray, box: Box, core: Box) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the surface of the cells that begin in a core, as `measures.measure_surface` does; None without any."""
    shape, spacing = plan.volume.shape, plan.volume.spacing
    # A cell lies between voxels and their next neighbours: the last voxels of the volume begin none.
    cells = [slice(edge.start, min(edge.stop, n - 1)) for edge, n in zip(core, shape, strict=True)]
    if any(edge.start >= edge.stop for edge in cells):
        return None
    corners: Box = tuple(slice(edge.start, edge.stop + 1) for edge in cells)  # type: ignore[assignment]
    around = grow(corners, SOFTENED, shape)
    soft = soften(mask[within(around, box)])[within(corners, around)]
    try:
        mesh = march(soft, spacing, 0.5)
    except NoSurface:
        return None
    positions, columns = whole.tabulate_surface(mesh, spacing)
    positions = positions + [edge.start for edge in corners]
    columns *= border_weights(positions, shape)[:, None]
    return positions, columns


def _working_boxes(plan: Plan, core: Box) -> tuple[Box, Box]:
    """Return two boxes of the working grid: the voxels that a core's curvature depends on, and those of the core."""
    edges = []
    for edge, n, scale, count in zip(core, plan.volume.shape, plan.scale, plan.working, strict=True):
        start, stop = (count if end == n else min(count, round(end / scale)) for end in (edge.start, edge.stop))
        edges.append(slice(start, stop))
    z, y, x = edges
    return grow((z, y, x), HALO, plan.working), (z, y, x)


def _measure_curvature(plan: Plan, core: Box, sums: _Sums) -> Record:
    """Sum the curvatures in the working cells that begin in a core; return the bins of the diagram and other counts."""
    box, working_core = _working_boxes(plan, core)
    record: dict[str, Any] = {"specks": np.zeros(2, np.int64), "changed": np.int64(0), "filled": np.int64(0)}
    if min(plan.working) < whole.FEWEST_SLICES or any(edge.start >= edge.stop for edge in working_core):
        return record
    values = _find_working_levels(plan, box)
    mask, inner = values > 0, within(working_core, box)
    if plan.structure.kind != "field":
        smallest, cut = smallest_piece(plan.thickness / plan.edge), _cut_out(working_core, box, plan.working)
        cleaned, *specks = remove_specks(mask, smallest, False, cut)
        record |= {"specks": np.array(specks), "changed": np.count_nonzero((cleaned != mask)[inner])}
        mask, values = cleaned, np.empty(0)  # frees the levels: the profile of the mask takes over
        del cleaned
    record["filled"] = np.count_nonzero(mask[inner])
    bounds = [(MARGIN, n - 1 - MARGIN) for n in plan.working]  # of the cells that are measured at all
    cells = [(max(e.start, low), min(e.stop, high)) for e, (low, high) in zip(working_core, bounds, strict=True)]
    if any(start >= stop for start, stop in cells) or mask.all() or not mask.any():
        return record
    # A grid has at least three cells along an axis: a thin core takes neighbours along, whose triangles are not kept;
    # along other axes all triangles are the core's, also those on its end.
    stops = [min(max(stop, start + 3), high) for (start, stop), (_, high) in zip(cells, bounds, strict=True)]
    wide = [(max(min(start, stop - 3), MARGIN), stop) for (start, _), stop in zip(cells, stops, strict=True)]
    window: Box = tuple(slice(start - MARGIN, stop + MARGIN + 1) for start, stop in wide)  # type: ignore[assignment]
    cropped = mask[within(window, box)]
    if cropped.all() or not cropped.any():
        return record
    if plan.structure.kind != "field":
        values = profile_mask(mask)
    try:
        prepared = _prepare_window(plan, values[within(window, box)], cropped, window)
        (positions, columns), diagram = whole.measure_curvatures(prepared)
    except NoSurface:
        return record
    working_positions = np.asarray(diagram.places) / WORKING_SPACING + [edge.start for edge in window]
    kept = np.ones(len(positions), dtype=bool)
    for position, (start, stop), widened in zip(working_positions.T, cells, wide, strict=True):
        kept &= ((start, stop) == widened) | ((position >= start) & (position < stop))
    sums.gather("curved", positions, columns, kept)
    del columns
    for part in sums.tables:
        record |= _bin(plan, diagram, kept & sums.select(part, positions), part)
    return record


def _find_working_levels(plan: Plan, box: Box) -> np.ndarray:
    """Return the values of a box of the working grid, above 0 in the structure, as `preparation.prepare` has them."""
    if plan.scale == (1.0, 1.0, 1.0):
        return find_levels(plan.structure, box)
    volume, is_mask = plan.volume, plan.structure.kind == "mask"
    ends = [(math.floor(e.start * s), math.ceil(e.stop * s)) for e, s in zip(box, plan.scale, strict=True)]
    z, y, x = (slice(min(start, n), min(stop, n)) for (start, stop), n in zip(ends, volume.shape, strict=True))
    margins = [math.ceil(4 * max(0.0, (s - 1) / 2)) + 2 for s in plan.scale]  # of the blur in `resample`
    if is_mask:
        reach = distance_reach(volume.spacing, plan.scale)
        margins = [margin + math.ceil(reach / h) + 1 for margin, h in zip(margins, volume.spacing, strict=True)]
    around = grow((z, y, x), margins, volume.shape)
    values, corner = find_levels(plan.structure, around), [edge.start for edge in around]
    start, shape = [edge.start for edge in box], [edge.stop - edge.start for edge in box]
    if is_mask:
        return resample_mask(values > 0, volume.spacing, plan.scale, start, shape, corner=corner)
    return resample(values, plan.scale, start, shape, corner=corner)


def _prepare_window(plan: Plan, phase: np.ndarray, mask: np.ndarray, window: Box) -> Prepared:
    """Return a window of the working grid as a scan of its own, with its origin in the volume."""
    phase, grid = np.ascontiguousarray(phase, dtype=np.float32), Grid(phase.shape, boundary="replicate")  # type: ignore[arg-type]
    z, y, x = (slice(0, n) for n in phase.shape)
    size = (plan.scale, plan.edge, plan.volume.unit, plan.thickness / plan.edge)
    origin = tuple(edge.start * s for edge, s in zip(window, plan.scale, strict=True))
    return Prepared(plan.structure.kind, phase, mask, grid, *size, (z, y, x), (), origin)  # type: ignore[arg-type]


def _bin(plan: Plan, diagram: Diagram, kept: np.ndarray, part: str) -> Record:
    """Return the bins of a part's points: for each its two indices ("bins"), and the area times 1, κ1, κ2 and κ1² + κ2²
    ("areas"); and an estimate of the part's area whose curvature is not resolved ("lost")."""
    points, weights = diagram.points[kept], diagram.weights[kept]
    width = _BIN * BIN_WIDTH * WORKING_SPACING / plan.edge  # a part of a diagram's bin, in working units, in 1 / length
    bins = np.floor(points / width).astype(np.int64)
    first = bins.min(0, initial=0)
    columns = int(bins[:, 1].max(initial=0) - first[1]) + 1
    flat = (bins - first) @ np.array([columns, 1])  # one number for each bin, for bincount
    moments = np.column_stack([np.ones(len(points)), points, (points**2).sum(1)]) * weights[:, None]
    areas = np.stack([np.bincount(flat, moment) for moment in moments.T], axis=1)
    occupied = np.flatnonzero(areas[:, 0])
    bins = np.stack(np.divmod(occupied, columns), axis=1) + first
    lost = np.float64(diagram.excluded * weights.sum())
    return {f"bins{part}": bins, f"areas{part}": areas[occupied], f"lost{part}": lost}


# ---- all tiles -------------------------------------------------------------------------------------------------------


def _measure_tiles(
    structure: Structure,
    edge: int | None,
    workers: Cluster | int | None,
    store: str | PathLike[str] | None,
    maps: bool,
    progress: Progress,
) -> tuple[Measures, dict[str, np.ndarray]]:
    options: dict[str, Any] = {}
    workers = workers if structure.volume.in_file and structure.region is None else None
    if store is not None:  # digests take a while
        region = structure.region and structure.region.digest
        options = {"scan": structure.volume.digest, "region": region, "tile": edge, "maps": maps}
        options |= {name: getattr(structure, name) for name in ("kind", "threshold", "dark")}
    with open_run(workers, store, options, progress, {_FIRST: 0.95, _AGAIN: 1.0}) as run, one_thread():
        plan = survey(structure, run)
        cores = cut_boxes(plan.volume.shape, edge or _choose_edges(plan, run.processes))
        plan = replace(plan, cores=tuple(cores), maps=maps)
        tiles_note = _describe_tiles(plan, run.processes)
        records = run(_FIRST, partial(measure_tile, plan), len(plan.cores), tiles_note)
        # The factors that `morphology.local_thickness` would choose for the whole volume.
        widest, finest = np.max([record["widest"] for record in records], axis=0), min(plan.volume.spacing)
        plan = replace(plan, factors=tuple(max(1, math.ceil(radius / finest / COARSE)) for radius in widest))
        wide_records: list[Record] = []
        if max(plan.factors) > 1:
            wide_records = run(_AGAIN, partial(_measure_wide, plan), len(plan.cores))
    arrays = {name: np.zeros(plan.volume.shape, kind) for name, kind in MAPS.items()} if maps else {}
    for some in (records, wide_records):
        for core, record in zip(plan.cores, some, strict=False):
            for name in arrays.keys() & record.keys():
                arrays[name][core] = record[name]
    return _summarise(plan, records, wide_records, tiles_note), arrays


def _summarise(plan: Plan, records: Sequence[Record], wide_records: Sequence[Record], tiles_note: str) -> Measures:
    """Return the measures of a volume, and of the compartments of its region, from the records of its tiles."""
    volume, finest = plan.volume, plan.finest
    parts = {name.removeprefix("rows") for record in records for name in record if name.startswith("rows")}
    tables = {part: _sum_tiles(plan, records, wide_records, part) for part in parts}
    total = dict(zip(whole.SUMS, tables[_WHOLE].sum(0), strict=True))
    if not 0 < total["inside"] < total["volume"]:
        raise ScanError("expected a structure and background in the scan, got one of them only")
    has_curvature = total["curved"] > 0
    reason = plan.unresolved or (whole.TOO_THIN if min(volume.shape) < whole.FEWEST_SLICES else "")
    if not has_curvature and not reason:
        raise ScanError("expected a surface between structure and background, got none on the working grid")
    period = total["thickness"] / total["inside"] + total["gap"] / (total["volume"] - total["inside"])
    blocks = Blocks.divide(volume.shape, volume.spacing, period)
    χ = float(sum(record["euler"] for record in records))
    density = connectivity_density(χ, volume.shape, volume.spacing, periodic=False)
    _, empty, why = whole.no_curvature(volume.unit, reason)
    notes = (*_notes(plan, records), *(() if has_curvature else why), *([tiles_note] if len(plan.cores) > 1 else []))

    def summarise(part: str, label: int | None = None) -> Measures:
        curved = tables[part][:, whole.SUMS.index("curved")].any()
        diagram = _join_bins(plan, records, part) if curved else empty
        connectivity = (χ, density) if part == _WHOLE else None
        table, name = _merge(tables[part], finest, blocks), None if label is None else ("compartment", label)
        return whole.summarise_sums(volume, plan.structure.kind, blocks, table, connectivity, diagram, notes, part=name)

    outline = Outline.cut(volume, lambda box: find_levels(plan.structure, box) > 0, plan.structure.region)
    if plan.structure.region is None:
        return replace(summarise(_WHOLE), outline=outline)
    labels = sorted(int(part) for part in parts - {_WHOLE, INSIDE})
    compartments = {label: summarise(str(label), label) for label in labels}
    return replace(summarise(INSIDE), compartments=compartments, outline=outline)


def _sum_tiles(plan: Plan, records: Sequence[Record], wide_records: Sequence[Record], part: str) -> np.ndarray:
    """Return the sums of all tiles over a region, whose keys end in `part`, for each of the finest blocks."""
    table, rows, sums = np.zeros((plan.finest.count, len(whole.SUMS))), f"rows{part}", f"sums{part}"
    for record in records:
        if rows in record:
            table[record[rows]] += record[sums]
    for factor, names in zip(plan.factors, (("thickness", "thickness²"), ("gap",)), strict=True):
        if factor > 1:  # measured again, in `wide_records`
            table[:, [whole.SUMS.index(name) for name in names]] = 0
    for record in wide_records:  # their other columns are 0
        if rows in record:
            table[record[rows]] += record[sums]
    return table


def _merge(table: np.ndarray, finest: Blocks, blocks: Blocks) -> np.ndarray:
    """Return the sums over blocks from those over the finest blocks."""
    sums = table.reshape(*finest.counts, -1)
    for axis, (fine_starts, starts) in enumerate(zip(finest.starts, blocks.starts, strict=True)):
        sums = np.add.reduceat(sums, np.searchsorted(fine_starts, starts), axis=axis)
    return sums.reshape(blocks.count, -1)


def _join_bins(plan: Plan, records: Sequence[Record], part: str) -> Diagram:
    """Return the diagram of a part over all tiles: the barycentres of its bins."""
    binned = [record for record in records if f"bins{part}" in record]
    bins, areas = (np.concatenate([record[f"{name}{part}"] for record in binned]) for name in ("bins", "areas"))
    bins, index = np.unique(bins, axis=0, return_inverse=True)
    index = index.reshape(-1)
    area, κ1, κ2, square = (np.bincount(index, column, minlength=len(bins)) for column in areas.T)
    points = np.stack([κ1, κ2], axis=1) / area[:, None]
    spread = max(float((square - area * (points**2).sum(1)).sum() / area.sum()), 0.0)
    lost = float(sum(record[f"lost{part}"] for record in binned)) / float(area.sum())
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
    working_notes, voxels = [*plan.working_notes], max(1, math.prod(plan.working))
    specks, pinholes = (int(n) for n in np.sum([record["specks"] for record in records], axis=0))
    if specks or pinholes:
        changed = sum(int(record["changed"]) for record in records) / voxels
        working_notes.append(DROPPED.format(specks, f"{pinholes}, {changed:.2g} of the volume"))
    working_notes.extend(note_on_filling(sum(int(record["filled"]) for record in records) / voxels))
    return (*notes, *(f"Of curvature: {note}" for note in working_notes))
