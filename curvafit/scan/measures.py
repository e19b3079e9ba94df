"""The numbers of a scan in seconds: morphometry, fabric and curvature in physical units, each with its interval."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from dataclasses import field as default
from functools import partial
from html import escape
from importlib.metadata import version
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.special import stdtrit

from curvafit.core.runtime import Pictured, Progress, silent
from curvafit.core.units import convert_length, format_number, plain_unit, power_name, unit_name
from curvafit.geometry.description import descriptors
from curvafit.geometry.diagrams import FAMILIES, MARGIN, Diagram, diagram, families
from curvafit.geometry.mesh import NoSurface, Surface, fabric
from curvafit.geometry.morphology import border_weights, smooth_surface
from curvafit.geometry.topology import euler_shares
from curvafit.priors.grid import WORKING_EPSILON, WORKING_SPACING
from curvafit.priors.kernels.threads import count_threads, one_thread
from curvafit.scan import preparation
from curvafit.scan.grids import Thickness, median_thickness, remove_specks
from curvafit.scan.preparation import LARGEST_WINDOW, Prepared
from curvafit.scan.structure import Kind, find_structure, is_rounded
from curvafit.volumes.volume import Box, ScanError, Volume, cut_boxes

#: Columns of a table of measures, with which a CSV file begins, and the version that it states.
COLUMNS = ("scan", "quantity", "symbol", "value", "low", "high", "unit", "direction", "version")
RELEASE = version("curvafit")
#: What is summed over blocks, in powers of the scan's unit; n0 to n5 are the parts zz zy zx yy yx xx of n⊗n.
SUMS = ("volume", "inside", "thickness", "thickness²", "gap", "χ", "area", *(f"n{k}" for k in range(6)))
SUMS += ("curved", "H", "H²", "K", "κ1", "κ2", "C", *FAMILIES)
_UPPER = np.triu_indices(3)
Sums = Mapping[str, np.ndarray]
Formula = tuple[str, str, int, Callable[[Sums], np.ndarray]]
Row = TypeVar("Row", bound=Any)
#: Least edges, in working voxels: of a cube whose descriptors are measured; of the windows of a larger scan, which are
#: about as large as those of training.
SMALLEST_CUBE, READ = 24, 56
#: The fewest blocks, and the most along an axis; the length of a block in periods of the structure.
LEAST, MOST, PERIODS = 8, 6, 1.0
#: Slices from which on a scan without curvature is refused, and why one of fewer has the other numbers alone.
FEWEST_SLICES = 10
TOO_THIN = f"it needs {FEWEST_SLICES} slices or more, or a surface away from the borders of fewer"
#: How sure intervals are.
SURE = 0.95
#: Most voxels of a slice along an axis that are kept for pictures.
SHOWN = 320


@dataclass(frozen=True)
class Quantity:
    """A number of a scan.

    Attributes
    ----------
    name, symbol
        In words, and as the field abbreviates it: `"thickness"`, `"Tb.Th"`.
    value, half
        The number, and half the width of its 95 % interval, in the scan's unit to `power`; NaN where the scan is too
        small to tell.
    power
        Power of length: 0 of a share, 1 of a thickness, -3 of a density.
    """

    name: str
    symbol: str
    value: float
    half: float
    power: int

    def format(self, unit: str) -> tuple[str, str, str]:
        """Return the number, its interval where there is one, and its unit as text, of a scan in `unit`."""
        half = f"± {format_number(self.half, 2)}" if math.isfinite(self.half) else ""
        return format_number(self.value, 4), half, power_name(unit, self.power)


#: Name, symbol, power of quantities, and how they come from sums; of a whole scan `measure_connectivity` has χ, Conn.D.
QUANTITIES: tuple[Formula, ...] = (
    ("volume fraction", "BV/TV", 0, lambda s: s["inside"] / s["volume"]),
    ("thickness", "Tb.Th", 1, lambda s: s["thickness"] / s["inside"]),
    ("thickness deviation", "Tb.Th.SD", 1, lambda s: _deviation(s, "thickness", "thickness²", "inside")),
    ("spacing", "Tb.Sp", 1, lambda s: s["gap"] / (s["volume"] - s["inside"])),
    ("number per length", "Tb.N", -1, lambda s: s["inside"] ** 2 / s["volume"] / s["thickness"]),  # (BV/TV) / Tb.Th
    ("connectivity density", "Conn.D", -3, lambda s: -s["χ"] / s["volume"]),
    ("Euler number", "χ", 0, lambda s: s["χ"]),
    ("surface to volume", "BS/BV", -1, lambda s: s["area"] / s["inside"]),
    ("surface density", "BS/TV", -1, lambda s: s["area"] / s["volume"]),
    ("anisotropy", "DA", 0, lambda s: _anisotropy(s)),
    ("mean curvature", "H", -1, lambda s: s["H"] / s["curved"]),
    ("mean curvature deviation", "H.SD", -1, lambda s: _deviation(s, "H", "H²", "curved")),
    ("Gaussian curvature", "K", -2, lambda s: s["K"] / s["curved"]),
    ("greater curvature", "κ1", -1, lambda s: s["κ1"] / s["curved"]),
    ("smaller curvature", "κ2", -1, lambda s: s["κ2"] / s["curved"]),
    ("curvedness", "C", -1, lambda s: s["C"] / s["curved"]),
    *((f"share of {name}", name, 0, lambda s, name=name: s[name] / s["curved"]) for name in FAMILIES),
)


@dataclass(frozen=True, eq=False)
class Outline:
    """What was taken for the structure, for pictures: the `levels` of three slices of a scan, across z, y and x, and
    what counts `inside` them, bool; every n-th voxel, at most `SHOWN` along an axis, of the edges `spacing` (z, y, x)
    in the scan's unit. `places` are the slices' positions in its voxels."""

    levels: tuple[np.ndarray, ...]
    inside: tuple[np.ndarray, ...]
    places: tuple[int, ...]
    spacing: tuple[float, ...]

    @classmethod
    def cut(
        cls, scan: Volume, find_inside: Callable[[Box], np.ndarray], region: Volume | None = None,
        places: Sequence[int] | None = None,
    ) -> Outline:  # fmt: skip
        """Cut slices of a scan at `places`, by default the middle ones, or those through the middle of a region, in
        which alone structure counts. `find_inside` returns the structure of a box of the scan."""
        places, steps = places or [n // 2 for n in scan.shape], [math.ceil(n / SHOWN) for n in scan.shape]
        if region is not None:
            occupied = [np.flatnonzero(region.values.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
            places = [int(places[0] + places[-1]) // 2 for places in occupied]
        levels, inside = [], []
        for axis, place in enumerate(places):
            z, y, x = (slice(place, place + 1) if k == axis else slice(0, n) for k, n in enumerate(scan.shape))
            thin = tuple(0 if k == axis else slice(None, None, step) for k, step in enumerate(steps))
            structure = find_inside((z, y, x))[thin]
            counts = True if region is None else region.read((z, y, x))[thin] != 0
            levels.append(np.ascontiguousarray(scan.read((z, y, x))[thin]))
            inside.append(structure & counts)
        edges = tuple(h * step for h, step in zip(scan.spacing, steps, strict=True))
        return cls(tuple(levels), tuple(inside), tuple(places), edges)


@dataclass(frozen=True, repr=False, eq=False)
class Measures(Pictured):
    """What a scan measures.

    Attributes
    ----------
    kind
        `"field"`, `"mask"` or `"image"`: what the scan was taken for.
    quantities
        The numbers (`QUANTITIES`).
    direction
        Unit vector (z, y, x) to which the surface is most nearly parallel: the axis of a bundle of tubes.
    diagram
        Areas over (κ1, κ2), in the scan's unit.
    blocks
        Blocks along (z, y, x) over which the intervals are estimated.
    part
        What of the scan this is, by a label: `("compartment", 2)` or `("instance", 7)`; None of all of it.
    compartments
        The measures within each label of the region, by label.
    outline
        What was taken for the structure; None of a compartment or an instance.
    maps
        Where asked for, the `structure` (uint8) and its `thickness` at each voxel (float32, 0 outside), as volumes on
        the scan's voxels and in the scan's own unit.
    """

    source: str
    unit: str
    kind: str
    quantities: tuple[Quantity, ...]
    direction: tuple[float, float, float]
    diagram: Diagram
    blocks: tuple[int, int, int]
    notes: tuple[str, ...]
    part: tuple[str, int] | None = None
    compartments: Mapping[int, Measures] = default(default_factory=dict)
    outline: Outline | None = None
    maps: Mapping[str, Volume] = default(default_factory=dict)

    @property
    def with_intervals(self) -> bool:
        """Return whether the scan was large enough for intervals."""
        return any(math.isfinite(quantity.half) for quantity in self.quantities)

    def __repr__(self) -> str:
        values = ", ".join(f"{quantity.symbol} {quantity.value:.4g}" for quantity in self.quantities[:4])
        return f"Measures({values}, in {unit_name(self.unit)}, of {self.source or 'an array'})"

    def _repr_html_(self) -> str:
        """Return a table, with a column of values for each compartment where there are some."""
        columns = [*self.compartments.values()] or [self]
        titles = [" ".join(map(str, column.part or ("value",))) for column in columns]
        rows = [("", "", *titles, "")]
        for quantities in zip(*(column.quantities for column in columns), strict=True):
            texts = [quantity.format(self.unit) for quantity in quantities]
            name, symbol, unit = quantities[0].name, quantities[0].symbol, texts[0][2]
            rows.append((name, symbol, *(f"{value} {interval}" for value, interval, _ in texts), unit))
        lines = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows)
        return f"<code>{escape(repr(self))}</code><table><tr>{'</tr><tr>'.join(lines)}</tr></table>"

    def rows(self, **more: str | float) -> list[dict[str, Any]]:
        """Return a row for each quantity, as values by column name; a value that is not known is None.

        A compartment or an instance adds a column of that name with its label. `more` adds columns whose value is the
        same in every row.
        """
        shared = dict([self.part] if self.part else []) | more
        return [row | shared for row in list_quantities(self.source, self.unit, self.quantities, self.direction)]

    def __getitem__(self, name: str) -> Quantity:
        """Return the quantity of a name or a symbol; raise KeyError where there is none."""
        return find_quantity(self.quantities, name)

    def convert(self, unit: str) -> Measures:
        """Return the same measures in another unit of length; ValueError if one of the two is the voxel."""
        if unit == self.unit:
            return self
        if "voxel" in (unit, self.unit):
            raise ValueError(f"expected lengths in a unit that converts to {unit}, got {self.unit}")
        return self.scale(convert_length(1.0, self.unit, unit), unit)

    def scale(self, factor: float, unit: str) -> Measures:
        """Return the same measures with every length multiplied by `factor`, in `unit`."""
        powers = [factor**quantity.power for quantity in self.quantities]
        pairs = zip(self.quantities, powers, strict=True)
        quantities = tuple(replace(q, value=q.value * power, half=q.half * power) for q, power in pairs)
        old = self.diagram
        places = None if old.places is None else old.places * factor
        diagram = replace(old, points=old.points / factor, weights=old.weights * factor**2, places=places)
        diagram = replace(diagram, unit=f"1/{unit}", spread=old.spread / factor)
        compartments = {label: measures.scale(factor, unit) for label, measures in self.compartments.items()}
        outline = self.outline and replace(self.outline, spacing=tuple(h * factor for h in self.outline.spacing))
        scaled = {"quantities": quantities, "diagram": diagram, "compartments": compartments, "outline": outline}
        return replace(self, unit=unit, **scaled)


def list_quantities(
    source: str, unit: str, quantities: Sequence[Quantity], direction: Sequence[float] = (math.nan,) * 3
) -> list[dict[str, Any]]:
    """Return a row for each quantity of a scan (`COLUMNS`); the direction is the anisotropy's."""
    rows, (z, y, x) = [], direction
    for quantity in quantities:
        bounds = (quantity.value, quantity.value - quantity.half, quantity.value + quantity.half)
        value, low, high = (bound if math.isfinite(bound) else None for bound in bounds)
        axis = f"{z:.4f} {y:.4f} {x:.4f}" if quantity.symbol == "DA" and math.isfinite(z) else ""
        cells = (source, quantity.name, quantity.symbol, value, low, high, plain_unit(unit, quantity.power), axis)
        rows.append(dict(zip(COLUMNS, (*cells, RELEASE), strict=True)))
    return rows


def find_quantity(rows: Sequence[Row], name: str) -> Row:
    """Return the row of a quantity by its name or symbol; raise KeyError where there is none."""
    for row in rows:
        if name in (row.name, row.symbol):
            return row
    raise KeyError(f"expected one of {', '.join(row.name for row in rows)}, got {name!r}")


def summarise_sums(
    frame: Volume,
    kind: str,
    blocks: Blocks,
    table: np.ndarray,
    connectivity: tuple[float, float] | None,
    diagram: Diagram,
    notes: tuple[str, ...],
    *,
    part: tuple[str, int] | None = None,
) -> Measures:
    """Return the measures of a scan from a table (N, C) of `SUMS` over its blocks; `connectivity` is χ and connectivity
    density of the whole scan, None for a region of it, and `frame` gives source and unit."""
    total = table.sum(0)
    values = combine(total)
    if connectivity is not None:
        names = [name for name, *_ in QUANTITIES]
        values[[names.index("Euler number"), names.index("connectivity density")]] = connectivity
        count, weights = blocks.count, None
    else:
        # Blocks that a region fills only partly count for less: (Σv)² / Σv² is their effective number.
        volumes = table[:, SUMS.index("volume")]
        count, weights = round(volumes.sum() ** 2 / np.square(volumes).sum()), volumes / volumes.mean()
    half_widths = errors(table, blocks, combine, weights) if count >= LEAST else np.full(len(values), np.nan)
    if count < LEAST:
        scope = "scan" if connectivity is not None else " ".join(map(str, part or ("region",)))
        why = f"they need {LEAST} blocks of a period (thickness and spacing), and the {scope} has {count}"
        notes = (*notes, f"No intervals: {why}.")
    quantities = tuple(
        Quantity(name, symbol, float(value), float(half), power)
        for (name, symbol, power, _), value, half in zip(QUANTITIES, values, half_widths, strict=True)
    )
    direction = find_direction(dict(zip(SUMS, total, strict=True)))
    return Measures(frame.source, frame.unit, kind, quantities, direction, diagram, blocks.counts, notes, part)


class Maps(NamedTuple):
    """What is measured at each voxel and triangle of a scan; `combine` turns its sums into the scan's quantities.

    `mask` is the structure on the scan's voxels; `thickness`, `gap` and `euler` (shares of χ) are on them too.
    `surface` and `curved` are positions (M, 3) in voxels from the first centre, and columns (M, C) of area and of
    curvatures times area, as in `SUMS`. `diagram` has the areas of all triangles of `curved`, in the scan's unit.
    """

    spacing: tuple[float, float, float]
    mask: np.ndarray
    thickness: np.ndarray
    gap: np.ndarray
    euler: np.ndarray
    surface: tuple[np.ndarray, np.ndarray]
    curved: tuple[np.ndarray, np.ndarray]
    diagram: Diagram
    kind: str
    notes: tuple[str, ...]

    def sum(self, blocks: Blocks) -> np.ndarray:
        """Return sums (N, C): a row for each block, a column for each of `SUMS`."""
        ones = np.ones(self.mask.shape, dtype=bool)
        integrands = (ones, self.mask, self.thickness, np.square(self.thickness), self.gap)
        sums = (math.prod(self.spacing) * blocks.sums(values) for values in integrands)
        surfaces = (blocks.gather(*triangles) for triangles in (self.surface, self.curved))
        return np.column_stack([*sums, blocks.sums(self.euler), *surfaces])


def measure_maps(
    field: Volume, kind: Kind, options: dict[str, Any], progress: Progress = silent, most: int | None = None
) -> Maps:
    """Measure what is summed over a scan's blocks; `options` are `threshold`, `dark` and `periodic` of `measure`. The
    curvature is that of the box that `preparation.prepare` chooses, or of all, on at most `most` working voxels."""
    periodic: bool = options["periodic"]
    progress("finding the structure", 0.0)
    detected, signed = find_structure(field, kind=kind, **options)  # type: ignore[arg-type]
    progress("measuring thickness and curvature", 0.1)
    alone, thickness = count_threads() == 1, Thickness()
    measure = partial(_measure_voxels, detected, signed, periodic, thickness)
    with one_thread(), ThreadPoolExecutor(1) as pool:  # each of the two works has a thread, where there are two
        others = None if alone else pool.submit(measure)
        try:
            if most is None:
                prepared = preparation.prepare(field, kind=detected, **options)
            else:
                prepared = preparation.prepare_whole(detected, signed, periodic, most, thickness)
            curved, diagram = measure_curvatures(prepared)
            of_curvature, lost = prepared.notes, ()
        except ValueError as reason:
            thin = isinstance(reason, preparation.Unresolved)
            if isinstance(reason, preparation.TooLarge) or (min(field.shape) >= FEWEST_SLICES and not thin):
                raise
            of_curvature, (curved, diagram, lost) = (), no_curvature(field.unit, reason if thin else TOO_THIN)
        (mask, *voxels), notes = others.result() if others else measure()
    notes = (*notes, *(f"Of curvature: {note}" for note in of_curvature if note not in notes), *lost)
    return Maps(field.spacing, mask, *voxels, curved, diagram, detected, notes)  # type: ignore[call-arg]


def _measure_voxels(
    kind: Kind, signed: Volume, periodic: bool, measure: Thickness
) -> tuple[tuple[Any, ...], tuple[str, ...]]:
    """Return mask, thickness, gap, shares of χ and surface of a scan's structure, as `Maps` has them, and notes."""
    mask, notes = _drop_specks(kind, signed, periodic, measure)
    more = bool(mask.mean() > preparation.HALF)  # of the phase that fills more: another thread begins with the other
    thick = {side: measure(mask == side, signed.spacing, periodic=periodic) for side in (more, not more)}
    thickness, gap = thick[True], thick[False]
    surface = measure_surface(mask, signed.spacing, periodic)
    return (mask, thickness, gap, euler_shares(mask, periodic=periodic), surface), notes


def no_curvature(unit: str, reason: object) -> tuple[tuple[np.ndarray, np.ndarray], Diagram, tuple[str, ...]]:
    """Return an empty `Maps.curved`, an empty diagram and a note on why curvature is not known."""
    columns = np.zeros((0, len(SUMS) - SUMS.index("curved")))
    empty = Diagram(np.zeros((0, 2)), np.zeros(0), f"1/{unit}", places=np.zeros((0, 3)))
    return (np.zeros((0, 3)), columns), empty, (f"No curvature: {reason}.",)


def _drop_specks(kind: Kind, signed: Volume, periodic: bool, measure: Thickness) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the structure as a mask on the scan's voxels (of an image, without specks and pinholes), and notes."""
    mask, notes = signed.values > 0, signed.notes
    if kind == "image":
        thickness = median_thickness(mask, signed.spacing, periodic, measure)[0]
        smallest = preparation.smallest_piece(thickness) / math.prod(signed.spacing)
        mask, specks, pinholes = remove_specks(mask, smallest, periodic)
        if specks or pinholes:
            notes = (*notes, preparation.DROPPED.format(specks, pinholes))
    if mask.all() or not mask.any():
        raise ScanError("expected a structure and background in the scan, got one of them only")
    return mask, notes


def measure_surface(
    mask: np.ndarray, spacing: tuple[float, float, float], periodic: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles' positions (M, 3) in voxels, and columns (M, 7): area, and the upper triangle of n⊗n dA.
    Those at a window's faces also count for what lies beyond the outer voxels' centres (`border_weights`)."""
    positions, columns = tabulate_surface(smooth_surface(mask, spacing, periodic=periodic), spacing)
    columns *= 1 if periodic else border_weights(positions, mask.shape)[:, None]
    return positions, columns


def tabulate_surface(mesh: Surface, spacing: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions and the columns of `measure_surface` of a mesh, without its weights."""
    centres, columns = fabric(mesh)
    return centres / np.array(spacing), columns


def measure_curvatures(prepared: Prepared) -> tuple[tuple[np.ndarray, np.ndarray], Diagram]:
    """Return the triangles' positions (M, 3) in the scan's voxels and the columns (M, C) of `SUMS` from "curved" on,
    which are curvatures times area; and the diagram in the scan's unit."""
    working = scan_diagram(prepared)
    length = prepared.length
    points, weights = working.points / length, working.weights * length**2
    physical = replace(working, points=points, weights=weights, unit=f"1/{prepared.unit}")
    from_corner = (np.asarray(working.places) / WORKING_SPACING + 0.5) * np.array(prepared.scale)
    positions = from_corner - 0.5 + np.array(prepared.origin)
    family = families(working.points, prepared.thickness / 2 * WORKING_SPACING)
    return (positions, _tabulate_curvatures(physical.points, physical.weights, family)), physical


@njit(cache=True, nogil=True)
def _tabulate_curvatures(points, weights, family):  # pragma: no cover
    """Return the columns (M, C) of `SUMS` from "curved" on of points (κ1, κ2) with areas and families."""
    columns = np.zeros((len(points), 7 + len(FAMILIES)), np.float32)
    for k in range(len(points)):
        κ1, κ2 = points[k]
        H, area = (κ1 + κ2) / 2, weights[k]
        columns[k, 0], columns[k, 1], columns[k, 2], columns[k, 3] = area, H * area, H * H * area, κ1 * κ2 * area
        columns[k, 4], columns[k, 5] = κ1 * area, κ2 * area
        columns[k, 6] = math.sqrt((κ1 * κ1 + κ2 * κ2) / 2) * area
        columns[k, 7 + family[k]] = area
    return columns


def combine(sums: np.ndarray, names: Sequence[str] = SUMS, quantities: Sequence[Formula] = QUANTITIES) -> np.ndarray:
    """Return the quantities (…, K) that follow from sums (…, C) of these names."""
    named = dict(zip(names, np.moveaxis(sums, -1, 0), strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):  # blocks without surface
        return np.stack([figure(named) for *_, figure in quantities], axis=-1)


def _deviation(sums: Sums, values: str, squares: str, counted: str) -> np.ndarray:
    return np.sqrt(np.maximum(sums[squares] / sums[counted] - (sums[values] / sums[counted]) ** 2, 0))


def _tensor(sums: Sums) -> np.ndarray:
    """Return ∫ n⊗n dA / area, (…, 3, 3)."""
    tensor = np.empty((*np.shape(sums["area"]), 3, 3))
    for k, (i, j) in enumerate(zip(*_UPPER, strict=True)):
        tensor[..., i, j] = tensor[..., j, i] = sums[f"n{k}"] / sums["area"]
    return tensor


def _anisotropy(sums: Sums) -> np.ndarray:
    """Return 1 - smallest / largest eigenvalue of the fabric; NaN without surface."""
    tensor = _tensor(sums)
    finite = np.asarray(np.isfinite(tensor).all(axis=(-1, -2)))[..., None]
    eigenvalues = np.where(finite, np.linalg.eigvalsh(np.where(finite[..., None], tensor, 0)), np.nan)
    return 1 - eigenvalues[..., 0] / eigenvalues[..., 2]


def find_direction(sums: Sums) -> tuple[float, float, float]:
    """Return the unit vector (z, y, x) to which the surface is most nearly parallel; NaN without surface."""
    if not sums["area"] > 0:
        return math.nan, math.nan, math.nan
    axis = np.linalg.eigh(_tensor(sums))[1][:, 0]
    z, y, x = (axis * np.sign(axis[np.abs(axis).argmax()])).tolist()  # the sign makes the largest component positive
    return z, y, x


def scan_diagram(prepared: Prepared) -> Diagram:
    """Measure the geometric curvature diagram of a prepared scan; places are in working units from the centre of the
    grid's first voxel. Raises NoSurface where there is none away from the scan's borders."""
    where = None if prepared.roi is None else ndimage.binary_erosion(prepared.roi, iterations=MARGIN)
    try:
        return diagram(np.ascontiguousarray(prepared.phase), prepared.grid, WORKING_EPSILON, where=where)
    except NoSurface:
        raise NoSurface("expected a surface inside the scan, got none away from its borders") from None


class Reading(NamedTuple):
    """What the windows of a scan showed: the descriptors of each `(k, 351)`, in voxels of which the structure is
    `WORKING_THICKNESS` thick; the kind of view; and how much was seen, in cubes of a thickness."""

    windows: np.ndarray
    view: str
    amount: float

    @property
    def descriptors(self) -> np.ndarray:
        """Return the means over windows `(351,)`."""
        return self.windows.mean(0)

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return descriptors `(1, 351)`, view and amount `(1,)`, as of many readings."""
        return self.descriptors[None], np.array([self.view]), np.array([self.amount])


def read_texture(prepared: Prepared) -> Reading | None:
    """Measure a scan's descriptors in windows of one size, of `READ` voxels or more, that fill its grid; in a single
    one of a scan that repeats, and in the largest cube within a region of interest. Return None where that cube is
    smaller than `SMALLEST_CUBE` voxels, or no window has a surface."""
    view, single = _kind_of_view(prepared), prepared.grid.periodic or prepared.roi is not None
    across = [1 if single else max(n // READ, 1) for n in prepared.grid.shape]
    edges = [n // count for n, count in zip(prepared.grid.shape, across, strict=True)]
    windows = cut_boxes([edge * count for edge, count in zip(edges, across, strict=True)], edges)
    if prepared.roi is not None:
        cube = _largest_cube(prepared.roi)
        windows = [] if cube is None else [cube]
    values, rows = prepared.phase if view == "field" else prepared.mask, []
    for window in windows:
        with contextlib.suppress(NoSurface):
            rows.append(descriptors(np.ascontiguousarray(values[window]), prepared.part(window)).vector())
            size = values[window].size
    return Reading(np.array(rows), view, len(rows) * size / prepared.thickness**3) if rows else None


def _kind_of_view(prepared: Prepared) -> str:
    """Return the kind of view for a posterior: scan of a degraded image, field of a whole periodic one, else mask."""
    if prepared.quality is not None and prepared.quality.degraded:
        return "scan"
    whole = prepared.kind == "field" and prepared.grid.periodic and not is_rounded(prepared.phase)
    return "field" if whole else "mask"


def _largest_cube(region: np.ndarray) -> tuple[slice, slice, slice] | None:
    """Return the largest cube within a region, of at most a window's edge; None where it is too small."""
    # A voxel's chessboard distance to the outside is half the edge of the largest cube centred there.
    distance = np.asarray(ndimage.distance_transform_cdt(np.pad(region, 1), metric="chessboard"))[1:-1, 1:-1, 1:-1]
    half = min(int(distance.max()), LARGEST_WINDOW // 2) - 1
    if 2 * half + 1 < SMALLEST_CUBE:
        return None
    z, y, x = (int(i) for i in np.unravel_index(int(distance.argmax()), distance.shape))
    return slice(z - half, z + half + 1), slice(y - half, y + half + 1), slice(x - half, x + half + 1)


@dataclass(frozen=True)
class Blocks:
    """A division of a volume (Z, Y, X) into blocks: the first voxel of each along (z, y, x)."""

    shape: tuple[int, int, int]
    starts: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]

    @classmethod
    def divide(cls, shape: Sequence[int], spacing: Sequence[float], period: float) -> Blocks:
        """Divide a volume into blocks of `PERIODS` periods of its structure, and at most `MOST` along an axis."""
        counts = [min(max(int(n * h / (PERIODS * period)), 1), MOST) for n, h in zip(shape, spacing, strict=True)]
        starts = [tuple(n * k // count for k in range(count)) for n, count in zip(shape, counts, strict=True)]
        return cls((shape[0], shape[1], shape[2]), (starts[0], starts[1], starts[2]))

    @property
    def counts(self) -> tuple[int, int, int]:
        """Return the number of blocks along each axis."""
        z, y, x = map(len, self.starts)
        return z, y, x

    @property
    def count(self) -> int:
        """Return the number of blocks."""
        return math.prod(self.counts)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of a volume (Z, Y, X) over each block, float64 (N,)."""
        sums, (z, y, x) = np.zeros(self.counts), (self._of_voxels(axis) for axis in range(3))
        _sum_blocks(np.ascontiguousarray(values), z, y, x, sums)
        return sums.ravel()

    def gather(self, positions: np.ndarray, weights: np.ndarray, kept: np.ndarray | None = None) -> np.ndarray:
        """Return sums over blocks, (N, C), of those weights (M, C) that are kept, by default all, at positions (M, 3)
        in voxels from the first centre."""
        kept = np.ones(len(positions), bool) if kept is None else kept
        sums, (z, y, x) = np.zeros((*self.counts, weights.shape[1])), (self._of_voxels(axis) for axis in range(3))
        _sum_positions(positions, weights, kept, z, y, x, sums)
        return sums.reshape(self.count, -1)

    def _of_voxels(self, axis: int) -> np.ndarray:
        """Return the index of each voxel's block along an axis."""
        return np.searchsorted(self.starts[axis], np.arange(self.shape[axis]), side="right") - 1


@njit(cache=True, nogil=True)
def _sum_blocks(values, block_z, block_y, block_x, sums):  # pragma: no cover
    """Add values (Z, Y, X) to sums over blocks, whose indices along each axis are given for each voxel."""
    nz, ny, nx = values.shape
    for z in range(nz):
        for y in range(ny):
            row = sums[block_z[z], block_y[y]]
            for x in range(nx):
                row[block_x[x]] += values[z, y, x]


@njit(cache=True, nogil=True)
def _sum_positions(positions, weights, kept, block_z, block_y, block_x, sums):  # pragma: no cover
    """Add the weights (M, C) that are kept at positions (M, 3) to sums (…, C) over blocks, as `_sum_blocks` does."""
    last_z, last_y, last_x = len(block_z) - 1, len(block_y) - 1, len(block_x) - 1
    for k in np.flatnonzero(kept):
        z, y, x = positions[k]
        z, y, x = min(max(round(z), 0), last_z), min(max(round(y), 0), last_y), min(max(round(x), 0), last_x)
        total = sums[block_z[z], block_y[y], block_x[x]]
        for column in range(weights.shape[1]):
            total[column] += weights[k, column]


def errors(
    sums: np.ndarray, blocks: Blocks, figures: Callable[[np.ndarray], np.ndarray], weights: np.ndarray | None = None
) -> np.ndarray:
    """Return half the width of the `SURE` interval of each figure, (K,), by a jackknife over neighbours that correlate.

    `figures` computes figures (…, K) from sums (…, C); `sums` has those of each block, (N, C). With ψ the change of a
    figure when a block is left out, the variance is ψᵀ W ψ: W has 1 on its diagonal, and ½ for each axis along which
    two blocks are neighbours (Bartlett's kernel, as Newey & West 1987 for series). If blocks were independent, ψᵀ W ψ
    would be σ² tr(P W P) / n², where P subtracts the mean: this sets the scale, and tr² / tr(·²) is the number of
    degrees of freedom of Student's t. A bootstrap over single blocks would take neighbours for independent.

    `weights`, of mean 1, say how much of each block counts; the variance of a block's mean is one over its weight.
    """
    count, total = len(sums), sums.sum(0)
    weights = np.ones(count) if weights is None else weights
    form, kernel = _neighbour_forms(blocks.counts, weights)
    change = (figures(total) - figures(total - sums)) * (1 - weights / count)[:, None]
    variance = (change * (kernel @ change)).sum(0) * count / np.trace(form)
    return _student_quantile(form) * np.sqrt(np.maximum(variance, 0))


def interval_reach(counts: Sequence[int]) -> float:
    """Return half the width of an interval of `errors` in standard errors, given the number of blocks along each axis;
    NaN for a single block."""
    count = math.prod(counts)
    return math.nan if count == 1 else _student_quantile(_neighbour_forms(counts, np.ones(count))[0])


def _student_quantile(form: np.ndarray) -> float:
    return float(stdtrit(np.trace(form) ** 2 / (form**2).sum(), (1 + SURE) / 2))


def _neighbour_forms(counts: Sequence[int], weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices P W P and W of `errors`, (N, N) both; with weights w, P is diag(√w) - w √wᵀ / n."""
    kernel = np.ones((1, 1))
    for n in counts:
        kernel = np.kron(kernel, np.eye(n) + (np.eye(n, k=1) + np.eye(n, k=-1)) / 2)
    centred = np.diag(np.sqrt(weights)) - np.outer(weights, np.sqrt(weights)) / len(kernel)
    return centred.T @ kernel @ centred, kernel
