"""From a scan to the working grid: what is structure, on which voxels, seen through which window."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch

from curvafit.core.units import convert_length
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.morphology import local_thickness
from curvafit.geometry.topology import betti_numbers
from curvafit.priors import WORKING_EPSILON, WORKING_SPACING, Grid, Law, phase_field
from curvafit.priors.grid import Boundary
from curvafit.scan import grids, structure
from curvafit.scan.quality import Quality, measure_quality, sample_mask
from curvafit.scan.structure import Kind
from curvafit.volumes.read import Source, load
from curvafit.volumes.volume import Box, Crop, ScanError, Volume

#: Median thickness in voxels that a scan is resampled to; those of isotropic scans whose grid is kept: where a shape is
#: measured, and where a law is read.
WORKING_THICKNESS = 8.0
KEPT, KEPT_FOR_LAWS = (5.0, 16.0), (7.84, 8.16)
#: A structure has no curvature when it is nowhere thicker than this many scan voxels, and why it has not.
THINNEST = 3.0
STAIRS = (
    "curvature is smoothed over a quarter of the thickness, here less than a voxel, so that it is that of the voxels' "
    "stairs; fill the body that a membrane encloses, thicken an open sheet to 6 voxels, or scan finer"
)
#: Longest sides: of a window and of the whole working grid, in working voxels; of what is read, in scan voxels.
LARGEST_WINDOW = 128
LARGEST_BOX = 256
LARGEST_SCAN = 512
#: Bytes that a working voxel takes while it is made.
WORKED = 64
#: A structure that fills more than this part of the volume may be the wrong phase, which a note says.
HALF = 0.5
MOSTLY = "The structure fills {:.0%} of the volume: if the other phase was meant, turn the two round (--dark)."
#: The note on specks and pinholes.
DROPPED = "Dropped what is smaller than a ball of half the median thickness (specks: {}, pinholes: {})."
#: Coarsening stops where a side would have fewer working voxels than this: three thicknesses, as curvature needs some
#: surface that the faces do not cut.
FEWEST = 24
#: Least mean of √(κ1² + κ2²) times the window's edge at which a surface is not flat; a ball that fits has 2.8.
FLATTEST = 2.0
#: First working voxel, number of voxels along (z, y, x), and a note where that is not all of the scan.
_Extent = tuple[tuple[int, int, int], tuple[int, int, int], tuple[str, ...]]
NOISE = "No law: the scan is noise, its voxels have nothing to do with those a few voxels away."


class TooLarge(ScanError):
    """A scan whose working grid is larger than the caller allows."""


class Unresolved(ScanError):
    """A structure that is too thin for its voxels to show its curvature."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scan on the working grid.

    Attributes
    ----------
    kind
        `"field"`, `"mask"` or `"image"`: what the scan was taken for.
    phase
        float32 (Z, Y, X): the scan's own phase field, or the optimal profile of `mask`.
    mask
        bool, same shape: the structure.
    grid
        Working units: spacing 0.01, the boundary periodic or replicate.
    scale
        Working voxel in scan voxels (z, y, x).
    working_voxel
        Edge of a working voxel in `unit`.
    thickness
        Median thickness beneath the surface, in working voxels, of the phase that fills less of the volume.
    window
        The middle box, of at most 128 voxels a side, or that with most surface where the middle has little.
    origin
        Scan voxel coordinates (z, y, x) of the corner of the first working voxel.
    roi
        bool, same shape: the region of interest, None where all counts. Surface within a voxel of its faces is a cut.
    notes
        Sentences on what was decided.
    noise
        Whether the structure's voxels have nothing to do with those a few voxels away.
    quality
        Blur and noise of an image; None of fields and masks.
    one_scale
        Whether it was prepared for a law to be read.
    """

    kind: Kind
    phase: np.ndarray
    mask: np.ndarray
    grid: Grid
    scale: tuple[float, float, float]
    working_voxel: float
    unit: str
    thickness: float
    window: Box
    notes: tuple[str, ...]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roi: np.ndarray | None = None
    noise: bool = False
    quality: Quality | None = None
    one_scale: bool = False

    @property
    def length(self) -> float:
        """Return the length, in `unit`, of 1 working unit."""
        return self.working_voxel / WORKING_SPACING

    @property
    def volume_fraction(self) -> float:
        """Return the fraction of the scan, or of its region of interest, that is structure."""
        return float((self.mask if self.roi is None else self.mask[self.roi]).mean())

    def scan_alike(self, grown: np.ndarray, seed: int) -> Prepared:
        """Scan a simulated periodic shape `(Z, Y, X)`, positive inside, as this scan was made, and prepare the result:
        a field as it is, else with a structure as many voxels thick as here; an image as blurred and noisy as here."""
        if self.kind == "field":
            return prepare(Volume(grown), kind="field", periodic=True, one_scale=self.one_scale)
        mask, quality = grown > 0, self.quality
        thickness = thinner_thickness(mask)
        step = [thickness / (scale * self.thickness) for scale in self.scale]  # of a scan voxel, in the shape's voxels
        z, y, x = (self.working_voxel / scale for scale in self.scale)
        if quality is None:
            values = sample_mask(mask, step, keep_volume=True).astype(np.uint8)
        else:
            values = quality.image(mask, step, seed).astype(np.float32)
        options = {"periodic": self.grid.periodic, "one_scale": self.one_scale, "quality": quality}
        return prepare(Volume(values, (z, y, x), self.unit), kind=self.kind, **options)

    @cached_property
    def true_volume_fraction(self) -> float:
        """Return the structure's volume fraction, corrected for the bias of blur, noise and resampling.

        The bias is estimated by scanning the main window's structure once more (`scan_alike`), after its border was
        moved to where the scan's blur had shifted it from.
        """
        if self.kind == "field":
            return self.volume_fraction
        shift = 0.0 if self.quality is None else self.quality.boundary_shift / max(self.scale)
        inside = grids.centre_distance(self.mask[self.window], (1.0, 1.0, 1.0), 4.0) > shift
        try:
            rescanned = self.scan_alike(inside, 0).volume_fraction
        except ScanError:
            return self.volume_fraction
        corrected = self.volume_fraction * inside.mean() / rescanned
        return corrected if 0 < corrected < 1 else self.volume_fraction

    def part(self, where: Box) -> Grid:
        """Return the grid of a box: it is periodic only where the box is all of a periodic grid."""
        z, y, x = self.mask[where].shape
        whole = (z, y, x) == self.grid.shape
        return Grid((z, y, x), self.grid.spacing, self.grid.boundary if whole else "replicate")

    @property
    def inverted(self) -> Prepared:
        """Return the same scan with structure and background exchanged."""
        mask = ~self.mask if self.roi is None else ~self.mask & self.roi
        return replace(self, mask=mask, phase=-self.phase)


def read_scan(
    scan: Source, *, label: int | None = None, crop: Crop | None = None, whole: bool = False, **reading: Any
) -> tuple[Volume, tuple[int, int, int]]:
    """Return a scan as `load` does, and the shape of all of it; unless `whole`, only the middle of a large file is
    read, as much as `prepare` uses, and a note says so."""
    volume = load(scan, crop=crop, label=label, **reading, lazy=True)
    shape = volume.shape
    if whole or not volume.in_file or max(shape) <= LARGEST_SCAN:
        return volume.load(), shape
    where, notes = grids.bounding_box(shape, None, LARGEST_SCAN)
    try:
        part = volume.crop(where).load()
    except ScanError as error:
        raise ScanError(f"{error}, in the middle of this large scan: name another part with crop") from error
    return replace(part, notes=part.notes + notes), shape


def prepare(
    field: Volume,
    *,
    kind: Kind = "auto",
    periodic: bool = False,
    threshold: Literal["otsu"] | float = "otsu",
    dark: bool = False,
    roi: Source | None = None,
    one_scale: bool = False,
    quality: Quality | None = None,
) -> Prepared:
    """Find the structure of a scan and put it on the working grid, where its median thickness is known in voxels.

    A mask is a volume of two values, a phase field a float volume with plateaus near ±1, anything else an image: it is
    smoothed (Gaussian, one voxel of the finest axis) and thresholded. The grid is kept where it is a phase field's, or
    isotropic with a median thickness of 5 to 16 voxels; else it is resampled to a thickness of 8: images as smoothed
    grey levels, masks as signed distances. Thickness is the median of the local thickness
    (`morphology.local_thickness`) over the structure's surface. Specks and pinholes smaller than a ball of half that
    diameter are dropped. Raises ValueError if a kind or threshold is not valid, and ScanError if there is no structure,
    no background, no surface, or nothing at least 3 voxels thick; or if `roi` or `threshold` do not fit the scan.

    Parameters
    ----------
    field
        The scan.
    kind
        Overrides the guess; a `"mask"` of several values is the structure where it is positive.
    periodic
        The box repeats.
    threshold
        Grey level, or `"otsu"`.
    dark
        The structure is the dark phase (of a mask: its lower value; of a field: where it is negative).
    roi
        Nonzero where the scan counts (array, field or file): see `volumes.volume.lay`.
    one_scale
        Keep no grid but a phase field's: laws are read where structures are of one thickness in voxels.
    quality
        Blur and noise of an image, where they are known; else they are measured.
    """
    structure.check_options(kind, threshold)
    laid, region_notes = (None, ()) if roi is None else structure.read_region(roi, field)
    region = None if laid is None else laid.values != 0
    box, box_notes = grids.bounding_box(field.shape, region, LARGEST_SCAN)
    region = None if region is None else region[box]
    cropped = replace(field, array=field.values[box], affine=None, notes=field.notes + region_notes + box_notes)
    periodic = periodic and cropped.shape == field.shape
    options = {"kind": kind, "threshold": threshold, "dark": dark, "region": region, "periodic": periodic}
    extremes = (field.values.min(), field.values.max())
    detected, signed = structure.find_structure(cropped, extremes=extremes, **options)  # type: ignore[arg-type]
    prepared = _put_on_grid(_Scan(detected, signed, periodic, region, one_scale), _choose_box)
    if detected == "image" and quality is None:
        quality = measure_quality(-cropped.values if dark else cropped.values, signed.values > 0, cropped.spacing)
    origin = tuple(edge.start + start for edge, start in zip(box, prepared.origin, strict=True))
    return replace(prepared, quality=quality, origin=origin)  # type: ignore[arg-type]


def make_start(
    field: Volume, law: Law, boundary: Boundary = "periodic", epsilon: float = WORKING_EPSILON
) -> tuple[Grid, torch.Tensor, tuple[str, ...]]:
    """Return the start of a flow on the voxels of a scan: its grid and ε in working units, u `(Z, Y, X)`, and notes.

    A phase field is u as it is; a mask becomes the profile that belongs to ε. A voxel has the edge of a working voxel,
    but of a fit's where both units are known: the law's lengths are then those of the scan. Raises ScanError for grey
    levels, and for voxels that are not cubes.
    """
    edge, longest = min(field.spacing), max(field.spacing)
    if longest > 1.01 * edge:
        raise ScanError(f"a start must have voxels that are cubes, got {field.spacing}: resample it")
    kind, signed = structure.find_structure(field)
    if kind == "image":
        raise ScanError("a start must be a mask or a phase field, got grey levels: `curvafit segment` makes a mask")
    step = WORKING_SPACING
    if law.working_voxel is not None and "voxel" not in (field.unit, law.length_unit):
        step *= convert_length(edge, field.unit, law.length_unit) / law.working_voxel
    if step > epsilon:
        raise ScanError(f"a voxel of the start is {step / WORKING_SPACING:.2g} of the law's, too coarse: resample it")
    grid = Grid(field.shape, step, boundary)  # type: ignore[arg-type]
    values = torch.from_numpy(signed.values)
    return grid, values if kind == "field" else phase_field(values > 0, grid, epsilon), signed.notes


def prepare_whole(
    kind: Kind, signed: Volume, periodic: bool, most: int, measure: Callable[..., np.ndarray] = local_thickness
) -> Prepared:
    """Put all of a scan on the working grid, without measuring blur and noise; `signed` is above 0 in the structure
    (`structure.find_structure`), whose thickness `measure` returns. Raises TooLarge where that takes more than `most`
    working voxels."""

    def take_all(scan: _Scan, scale: tuple[float, float, float]) -> _Extent:
        shape = count_voxels(scan.field.shape, scale)
        if math.prod(shape) > most:
            raise TooLarge(f"expected at most {most} working voxels in one piece, got {_join_sides(shape)}")
        return (0, 0, 0), shape, ()

    return _put_on_grid(_Scan(kind, signed, periodic, None, one_scale=False, measure=measure), take_all)


@dataclass(frozen=True)
class _Scan:
    """A scan whose structure is known: `field` is above 0 there."""

    kind: Kind
    field: Volume
    periodic: bool
    region: np.ndarray | None
    one_scale: bool
    measure: Callable[..., np.ndarray] = local_thickness

    @property
    def counted(self) -> np.ndarray:
        """Return the structure within the region of interest."""
        mask = self.field.values > 0
        return mask if self.region is None else mask & self.region

    @property
    def thinner(self) -> tuple[np.ndarray, str]:
        """Return the phase that fills less, whose thickness sets the grid, and its name."""
        inside = self.counted
        counted = inside.size if self.region is None else np.count_nonzero(self.region)
        if np.count_nonzero(inside) <= HALF * counted:
            return inside, "structure"
        return (~inside if self.region is None else ~inside & self.region), "background"


def _put_on_grid(scan: _Scan, choose_box: Callable[[_Scan, tuple[float, float, float]], _Extent]) -> Prepared:
    """Put a scan on the working grid: choose the working voxel, resample the box that `choose_box` returns, drop
    specks, make the phase field of the mask, and choose the window."""
    spacing = scan.field.spacing
    noise = scan.kind != "field" and structure.is_noise(scan.field.values > 0)
    keeps_grid = scan.kind == "field" or noise  # a phase field has its ε, and noise no thickness
    thinner, name = scan.thinner
    thickness, thick = grids.median_thickness(thinner, spacing, scan.periodic, scan.measure)
    thickness_note = judge_thickness(name, thickness, thick, spacing, keeps_grid)
    kept = KEPT_FOR_LAWS if scan.one_scale else KEPT
    scale, why = choose_scale(scan.field.shape, spacing, thickness, keeps_grid, kept=kept, periodic=scan.periodic)
    start, shape, cut = choose_box(scan, scale)
    edge = working_edge(scale, spacing)
    values, region = _resample(scan, scale, start, shape)
    grid = Grid(shape, boundary="periodic" if scan.periodic and not cut else "replicate")
    mask, dropped = _clean_mask(scan.kind, values, region, thickness / edge, grid.periodic)
    window = grids.box_by_surface(grids.surface_voxels(mask), LARGEST_WINDOW)
    inverted = note_on_filling(float((mask if region is None else mask[region]).mean()))
    if window is None:
        raise ScanError("expected a surface between structure and background, got none on the working grid")

    def profile(mask: np.ndarray) -> np.ndarray:
        if not scan.one_scale:
            return grids.profile_mask(mask, grid.periodic)
        # The descriptors by which laws are read have one width of smoothing.
        return phase_field(torch.from_numpy(mask), grid, WORKING_EPSILON).numpy()

    if scan.kind != "field":
        phase = profile(mask)
    else:
        phase = values if region is None or region.all() else np.minimum(values, profile(region))
    phase, size = np.ascontiguousarray(phase, dtype=np.float32), (scale, edge, scan.field.unit, thickness / edge)
    notes = (*scan.field.notes, thickness_note, *why, *cut, *dropped, *inverted)
    origin = tuple(first * step for first, step in zip(start, scale, strict=True))
    known = {"roi": region, "noise": noise, "one_scale": scan.one_scale}
    return Prepared(scan.kind, phase, mask, grid, *size, window, notes, origin, **known)  # type: ignore[arg-type]


def note_on_filling(share: float) -> tuple[str, ...]:
    """Return a note where the structure fills more than the background, none elsewhere."""
    return (MOSTLY.format(share),) if share > HALF else ()


def judge_thickness(
    name: str, median: float, thick: float, spacing: tuple[float, float, float], keeps_grid: bool
) -> str:
    """Return a note on a phase's median thickness; raise Unresolved where its 95th percentile, `thick`, is too thin."""
    voxel = math.prod(spacing) ** (1 / 3)
    thin = thick < (THINNEST - 0.5) * voxel  # balls on the grid understate thin tubes
    if thin and not keeps_grid:
        fault = "got one thinner nearly everywhere, whose smoothed surface may have holes"
        raise Unresolved(f"expected a {name} at least {THINNEST:g} voxels thick, {fault}: {STAIRS}")
    if median < THINNEST * voxel:
        return f"Half of the {name} is thinner than {median / voxel:.2g} scan voxels: {STAIRS}."
    return f"Median thickness of the {name} {median / voxel:.3g} scan voxels."


def choose_scale(
    shape: Sequence[int],
    spacing: tuple[float, float, float],
    thickness: float,
    keeps_grid: bool,
    *,
    kept: tuple[float, float] = KEPT,
    periodic: bool = False,
) -> tuple[tuple[float, float, float], tuple[str, ...]]:
    """Return the edges of a working voxel in scan voxels (z, y, x), and notes; all ones where the scan's grid is kept.

    A grid of isotropic voxels is kept if `keeps_grid`, whatever the thickness, or if the median thickness in voxels is
    between the two numbers `kept`.
    """
    finest = min(spacing)
    if max(spacing) <= 1.01 * finest and (keeps_grid or kept[0] <= thickness / finest <= kept[1]):
        return (1.0, 1.0, 1.0), ("The scan's grid is kept.",)
    edge = finest if keeps_grid else thickness / WORKING_THICKNESS
    extent = min(n * h for n, h in zip(shape, spacing, strict=True))
    note = f"Resampled to {thickness / edge:.3g} voxels a thickness"
    if extent < FEWEST * edge and edge > finest:
        edge = max(extent / FEWEST, finest)
        note = f"Resampled as far as leaves {FEWEST} voxels a side"
    scale = [edge / h for h in spacing]
    if periodic:  # a period is a whole number of working voxels
        scale = [n / max(4, round(n / s)) for n, s in zip(shape, scale, strict=True)]
    edges = " x ".join(f"{s:.3g}" for s in scale)
    return (scale[0], scale[1], scale[2]), (f"{note}: a working voxel is {edges} scan voxels (z, y, x).",)


def working_edge(scale: Sequence[float], spacing: Sequence[float]) -> float:
    """Return the edge of a working voxel in the scan's unit: the geometric mean of edges that differ."""
    edges = [s * h for s, h in zip(scale, spacing, strict=True)]
    return edges[0] if max(edges) <= (1 + 1e-9) * min(edges) else math.prod(edges) ** (1 / 3)


def count_voxels(shape: Sequence[int], scale: Sequence[float]) -> tuple[int, int, int]:
    """Return the number of working voxels along each axis of a scan; raise ScanError where there are too few."""
    z, y, x = (math.floor(n / s + 1e-6) for n, s in zip(shape, scale, strict=True))
    if min(z, y, x) < 4:
        raise ScanError(f"expected at least 4 working voxels along each axis, got {_join_sides((z, y, x))}")
    return z, y, x


def _choose_box(scan: _Scan, scale: tuple[float, float, float]) -> _Extent:
    """Return the extent of all of a scan, or the box of a large one that holds most of its surface."""
    shape = count_voxels(scan.field.shape, scale)
    if max(shape) <= LARGEST_BOX:
        return (0, 0, 0), shape, ()
    sides = [min(n, LARGEST_BOX) for n in shape]
    scan_sides = [math.ceil(side * step) for side, step in zip(sides, scale, strict=True)]
    box = grids.box_by_surface(grids.surface_voxels(scan.counted), scan_sides)
    box = box or tuple(slice(0, side) for side in scan_sides)
    latest = [n - side for n, side in zip(shape, sides, strict=True)]  # starts at which the box ends with the scan
    z, y, x = (min(int(edge.start / step), end) for edge, step, end in zip(box, scale, latest, strict=True))
    note = f"Of {_join_sides(shape)} working voxels, {_join_sides(sides)} from {(z, y, x)} on are used."
    return (z, y, x), (sides[0], sides[1], sides[2]), (note,)


def _resample(
    scan: _Scan, scale: tuple[float, float, float], start: tuple[int, int, int], shape: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the scan's values (above 0 in the structure) and its region of interest on the working grid."""
    values, region = scan.field.values, scan.region
    if scale == (1.0, 1.0, 1.0):
        box = tuple(slice(first, first + n) for first, n in zip(start, shape, strict=True))
        return values[box], None if region is None else region[box]
    target: Any = (scale, start, shape)
    if scan.kind == "mask":
        values = grids.resample_mask(values > 0, scan.field.spacing, *target, periodic=scan.periodic)
    else:
        values = grids.resample(values, *target, periodic=scan.periodic)
    if region is not None:
        region = grids.resample(region.astype(np.uint8), *target, periodic=scan.periodic, nearest=True) > 0
    return values, region


def _clean_mask(
    kind: Kind, values: np.ndarray, region: np.ndarray | None, thickness: float, periodic: bool
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the mask of values on the working grid, and notes; except of a phase field, drop specks and pinholes."""
    mask = values > 0 if region is None else (values > 0) & region
    if kind == "field":
        return mask, ()
    cleaned, specks, pinholes = grids.remove_specks(mask, smallest_piece(thickness), periodic)
    if not specks and not pinholes:
        return mask, ()
    note = DROPPED.format(specks, f"{pinholes}, {(cleaned != mask).mean():.2g} of the volume")
    return cleaned if region is None else cleaned & region, (note,)


def thinner_thickness(mask: np.ndarray) -> float:
    """Return the median thickness, in voxels, of the phase of a periodic mask `(Z, Y, X)` that fills less; raise
    ScanError where there is one phase only."""
    if mask.all() or not mask.any():
        raise ScanError("expected a structure and background in a mask, got one of them only")
    return grids.median_thickness(mask if mask.mean() <= HALF else ~mask, (1.0, 1.0, 1.0), periodic=True)[0]


def smallest_piece(thickness: float) -> float:
    """Return the volume of a ball whose diameter is half a thickness: pieces that are smaller are no structure."""
    return math.pi / 6 * (thickness / 2) ** 3


def _join_sides(shape: Iterable[int]) -> str:
    return " x ".join(str(n) for n in shape)


def why_no_texture(prepared: Prepared, diagram: Diagram) -> str:
    """Return a sentence on why no law can be read from a scan's texture; empty where one can."""
    edge = max(s.stop - s.start for s in prepared.window) * prepared.grid.spacing[0]
    curvature = np.average(np.hypot(*np.asarray(diagram.points).T), weights=np.asarray(diagram.weights))
    if curvature * edge < FLATTEST:
        return "No law: the surface is flat, and a flat surface says nothing of how it would bend."
    if is_ball(prepared.mask) or is_ball(~prepared.mask):
        return "No law: the scan shows a single ball-like body, and a texture is many alike."
    return ""


def is_ball(mask: np.ndarray) -> bool:
    """Return whether a structure is one body, away from the box's faces, without handles or cavities."""
    faces = (mask.take(end, axis) for axis in range(3) for end in (0, -1))
    return not any(face.any() for face in faces) and betti_numbers(mask) == (1, 0, 0)
