"""A volume between known slices that need not fit into memory: filled block by block, from a file into OME-Zarr.

The network reads four known slices for each gap, and no more than `REACH` pixels around each pixel: a block with what
lies around it is filled as the whole is. Three numbers are those of the whole: the thickness of the structure in known
slices, which says how large a pixel is; the probability from which voxels are inside; and the expected Dice. All
follow from sums over slices or blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import expit

from curvafit.core.checks import check_int
from curvafit.core.files import remove
from curvafit.core.runtime import Progress, silent
from curvafit.core.workers import Workers
from curvafit.scan.prepare import LARGEST_BOX
from curvafit.scan.structure import Request
from curvafit.segmentation.filler import (
    REACH,
    SLOPE,
    TILE,
    Raster,
    Taught,
    choose_pixel,
    fill_gaps,
    sum_depths,
    thickness_of_sums,
)
from curvafit.segmentation.flow import choose_epsilon
from curvafit.segmentation.result import (
    FORMAT,
    Segmentation,
    Uncertainty,
    check_mask_target,
    describe_filled,
    describe_run,
    doubt_labels,
    doubt_places,
    finish_mask,
    flow_summary,
    hidden_store,
    map_path,
    note_labelled,
)
from curvafit.segmentation.slices import (
    LABELS,
    Slices,
    choose_labelled,
    find_labelled,
    known_places,
    plane_distances,
    require_labels,
    require_outline,
    turn_axes,
)
from curvafit.segmentation.tiles import check_edge
from curvafit.segmentation.uncertainty import (
    LEAST,
    best_threshold,
    count_probabilities,
    doubt,
    entropy,
    share_by_slices,
    suggest_slices,
)
from curvafit.volumes.boxes import Box, cut_boxes
from curvafit.volumes.formats.zarr import (
    CHUNK,
    cores_of,
    create_zarr,
    halve_level,
    image_of,
    level_of,
    mark,
    open_zarr,
    version_of,
)
from curvafit.volumes.read import load
from curvafit.volumes.run import Record, Run, open_mapped, open_run
from curvafit.volumes.volume import ScanError, Volume

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Most bytes of known slices that are read at once, and slices.
SLAB, THICK = 2**26, CHUNK
#: Slices of a block by default, and voxels a side across them at most.
DEEP, WIDE = 2 * CHUNK, 4 * CHUNK
#: Bytes that a pixel of a slice takes in the network, those of a voxel of a block, and of the program itself.
_EACH, _VOXEL, _PROGRAM = 800, 24, 600 * 2**20
#: Names of the passes, and the share of the work that is done after each.
_LOOK, _READ, _FILL, _CUT = "looking for labels", "reading known slices", "filling blocks", "cutting the mask"
_ENDS = {_LOOK: 0.02, _READ: 0.07, _FILL: 0.9, _CUT: 0.94}
#: The known slices, within the folder of a run.
_KNOWN = "known.npy"


@dataclass(frozen=True)
class Filled:
    """A volume filled into files: their paths, a sentence on how, and sentences on what is doubtful."""

    paths: tuple[Path, ...]
    status: str
    notes: tuple[str, ...]


def fits_blocks(target: str | PathLike[str], shape: Sequence[int], tile: int | None) -> bool:
    """Return whether a volume is filled in blocks: into Zarr, where a side is longer than `LARGEST_BOX` or blocks have
    an edge."""
    path = Path(target)
    zarr = path.name.lower().endswith(".zarr") or image_of(path) is not None
    return zarr and (tile is not None or max(shape) > LARGEST_BOX)


def reconstruct_file(
    source: str | PathLike[str],
    path: str | PathLike[str],
    *,
    every: int | None = None,
    first: int = 0,
    known: Sequence[int] | None = None,
    axis: int = 0,
    suggest: int = 0,
    filler: str | Path | None = None,
    epsilon: float | None = None,
    tile: int | None = None,
    store: str | PathLike[str] | None = None,
    workers: Workers | int | None = None,
    record: Mapping[str, Any] | None = None,
    inputs: Iterable[str | PathLike[str]] = (),
    overwrite: bool = False,
    label: int | None = None,
    progress: Progress = silent,
    **reading: Any,
) -> Filled:
    """Fill a volume between known slices of a file into OME-Zarr, block by block, by the network alone.

    The mask, the probability of each voxel, a picture and a record are those that `reconstruct` and `write_mask` make
    of the whole, but for the order in which sums are taken. They appear together once all are whole. From Zarr, HDF5,
    NPY, RAW and uncompressed NIfTI no more than some slices are read at once.

    Parameters
    ----------
    source
        A mask, or labels, positive inside; only the known slices count.
    path
        The store to write, `mask.zarr`, or labels of an OME-Zarr image, `IMAGE.zarr/labels/NAME`.
    tile
        Voxels a side of a block, up to whole chunks; by default memory decides.
    store
        The folder, on the disk of the path, of finished blocks until all is written: a killed run goes on. By default
        it is beside the path.
    workers
        Processes that fill blocks of a file that is not read at once, or dask's workers; by default this process does.

    The others are those of `reconstruct`, `write_mask` and `curvafit.load`; no input is overwritten.

    Raises
    ------
    ValueError, FileNotFoundError
        As `reconstruct`, `curvafit.load` and `write_mask`; or if the store is another run's or in use.
    """
    target, axis = Path(path), check_int(axis, "an axis 0, 1 or 2 (z, y, x)", 0, 2)
    own: list[str | Path] = [str(source), *map(str, inputs)]
    check_mask_target(target, None, own, overwrite, maps=["probability"])
    frame = load(source, **reading, lazy=True)
    check_mask_target(target, frame, own, overwrite, maps=["probability"])
    request = Request(frame, label, "mask", "otsu", dark=False)
    folder = Path(store) if store is not None else hidden_store(target)
    shape, names = turn_axes(frame.shape, axis), (target.name, map_path(target, "probability").name)
    thick = min(THICK, max(1, SLAB // (shape[1] * shape[2] * frame.dtype.itemsize)))
    job = Job(request, axis, shape, turn_axes(frame.spacing, axis), frame.unit, (), folder, *names, thick)
    places = None if every is None and known is None else known_places(job.shape[0], every, first, known)
    check_int(suggest, "a number of slices from 0", 0, job.shape[0] - len(places or ()))
    width, tile, taught = choose_epsilon(frame, epsilon), check_edge(tile), Taught.load(filler)
    same = {"labels": frame.digest, "label": label, "every": every, "first": first, "known": known, "axis": axis}
    same |= {"filler": taught.digest, "tile": tile}
    with open_run(workers if frame.in_file else None, folder, same, progress, _ENDS) as run:
        which: tuple[str, ...] = ()
        if places is None:
            looked = run(_LOOK, partial(look_at_slab, job), job.slabs)
            places = choose_labelled(there := np.concatenate([each["there"] for each in looked]))
            which = note_labelled(places, there)
        job = replace(job, places=tuple(places), filler=filler)
        job, doubts = _read_known(job, run, every is not None)
        job = job.cut(tile)
        job.create(frame, target)
        filled = _gather(job, run(_FILL, partial(fill_block, job), len(job.cores), job.describe(run.processes)))
        threshold = max(best_threshold(filled["counts"]), LEAST)
        cut = _gather(job, run(_CUT, partial(cut_block, job, threshold), len(job.cores)))
        for name in (job.mask, job.probability):
            for level in range(1, len(group := open_zarr(folder / name))):
                run(f"halving {name} {level}", partial(halve_core, folder / name, level), len(cores_of(group, level)))
        inside, both, told = (float(cut[name]) for name in ("inside", "both", "told"))
        size, depth = math.prod(job.shape), job.shape[0]
        dice = 2 * both / max(told + float(filled["sum"]), 1e-9) if job.slices.between.any() else 1.0
        uncertain = Uncertainty(
            frame, taught.error, suggest_slices(filled["along 0"], places, suggest), dice,
            known_share=share_by_slices(job.slices.inside.mean((1, 2)), places, depth),
            mean_probability=float(filled["total"]) / size,
        )  # fmt: skip
        share = inside / size
        ways = (taught.status, flow_summary(share), share, uncertain)
        status, more = describe_filled(*ways, places, depth, tested="generated shapes")
        notes = (*frame.notes, *which, *doubts, *more)
        result = Segmentation(frame, frame, None, None, width, status, notes, uncertain)
        for name in (job.mask, job.probability):
            mark(folder / name, FORMAT.name)
            for partial_chunk in (folder / name).rglob("*.partial"):  # of a killed process
                remove(partial_chunk)
        content = describe_run(result, record or {}, frame, share)
        figure = job.draw([filled[f"along {k}"] for k in range(3)], frame)
        paths = finish_mask(folder, target, ["probability"], figure, content)
    remove(folder)
    return Filled(paths, status, notes)


@dataclass(frozen=True)
class Job:
    """What processes must know to fill blocks of a volume, whose first axis here is `axis`, that across the slices.
    Known slices at `places`, mask and probability are written into `folder`; `thick` slices are read at once. `pixel`
    is the edge of the network's pixels, `edges` are the voxels of a block along each axis, whole chunks of `chunk`."""

    request: Request
    axis: int
    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    unit: str
    places: tuple[int, ...]
    folder: Path
    mask: str
    probability: str
    thick: int
    filler: str | Path | None = None
    pixel: float = 0.0
    edges: tuple[int, int, int] = (CHUNK, CHUNK, CHUNK)
    chunk: int = CHUNK

    @property
    def slabs(self) -> int:
        """The number of slabs of the volume."""
        return -(-self.shape[0] // self.thick)

    def slab(self, number: int) -> tuple[slice, np.ndarray]:
        """Return the numbers of the slices of a slab, and their values (n, Y, X)."""
        rows = slice(number * self.thick, min((number + 1) * self.thick, self.shape[0]))
        box = self.turn_back((rows, slice(0, self.shape[1]), slice(0, self.shape[2])))
        values = self.request.read(box)
        if values.dtype.kind == "f" and (faults := np.count_nonzero(~np.isfinite(values))):
            raise ScanError(f"a volume must be finite, got {faults} values that are not")
        return rows, np.moveaxis(values, self.axis, 0)

    def turn_back(self, box: Box) -> Box:
        """Return a box of the array, whose axes are z, y and x."""
        rest = list(box)
        rest.insert(self.axis, rest.pop(0))
        return rest[0], rest[1], rest[2]

    @property
    def slices(self) -> Slices:
        """The known slices, in a mapped file."""
        inside = np.load(self.folder / _KNOWN, mmap_mode="r")
        return Slices(inside, self.places, self.shape[0], self.spacing, self.unit)

    @property
    def cores(self) -> list[Box]:
        """The blocks, the first axis slowest."""
        return cut_boxes(self.shape, self.edges)

    def cut(self, tile: int | None) -> Job:
        """Choose the edges of blocks: `tile` rounded up to whole chunks, or as many pixels as the network fills at
        once."""
        if tile is not None:
            count = -(-tile // CHUNK)
            chunk = -(-tile // count)
            return replace(self, edges=(count * chunk,) * 3, chunk=chunk)
        wide = [min(max(int(TILE * self.pixel / h) // CHUNK, 1) * CHUNK, WIDE) for h in self.spacing[1:]]
        return replace(self, edges=(DEEP, *wide))

    def describe(self, processes: int) -> str:
        """Return how many blocks there are, and how much memory they take at most, as a sentence."""
        sides = [min(edge, n) for edge, n in zip(self.edges, self.shape, strict=True)]
        pixels = [min(TILE, n * h / self.pixel) + 2 * REACH for n, h in zip(sides[1:], self.spacing[1:], strict=True)]
        network = _EACH * math.prod(pixels) * (max(np.diff(self.places)) - 1)
        known = math.prod(self.shape[1:]) * len(self.places)
        each = network + _VOXEL * math.prod(sides) + SLAB
        total = processes * each + (processes + (processes > 1)) * _PROGRAM + known
        named = " x ".join(map(str, sides))
        return f"{len(self.cores)} blocks of {named} voxels, in about {total / 1e9:.2g} GB of memory."

    def create(self, frame: Volume, target: Path) -> None:
        """Create the stores of mask and probability, where an earlier run did not."""
        image = image_of(target)
        version = "0.5" if image is None else version_of(image) or ""
        kinds = {self.mask: (np.uint8, version, image is not None), self.probability: (np.float32, "0.5", False)}
        for name, (dtype, which, labels) in kinds.items():
            if (self.folder / f"{name}.created").exists():
                continue
            remove(self.folder / name)
            create_zarr(frame, np.dtype(dtype), self.folder / name, which, labels, self.chunk)
            (self.folder / f"{name}.created").touch()

    def write(self, name: str, core: Box, values: np.ndarray) -> None:
        """Write a core of the finest level of a store."""
        level_of(open_zarr(self.folder / name), 0)[self.turn_back(core)] = np.moveaxis(values, 0, self.axis)

    def draw(self, unsure: Sequence[np.ndarray], frame: Volume) -> Figure:
        """Draw the most uncertain slices across each axis, given the entropy of all slices across the job's axes."""
        from curvafit.drawing.plot import THIN, Sections, draw_sections, grey_limits

        places = [int(each.argmax()) for each in unsure]
        places.insert(self.axis, places.pop(0))
        mask, likely = (open_zarr(self.folder / name) for name in (self.mask, self.probability))
        where = [(*(slice(None),) * axis, place) for axis, place in enumerate(places)]
        outlines, doubts = [np.asarray(mask["0"][at]) for at in where], [entropy(likely["0"][at]) for at in where]
        known = [np.where(e == 0, 2 * m.astype(np.int8) - 1, 0) for e, m in zip(doubts, outlines, strict=True)]
        coarse = next(each for k in range(len(likely)) if max((each := likely[str(k)]).shape) <= THIN)
        rows = {
            "known, filled": Sections(known, outlines, (-1.0, 1.0)),
            "how unsure": Sections(doubts, outlines, grey_limits(entropy(coarse[...]))),
        }
        return draw_sections(rows, frame.spacing, frame.unit, places)


def _read_known(job: Job, run: Run, doubted: bool) -> tuple[Job, tuple[str, ...]]:
    """Read the known slices into a mapped file; return the job with the network's pixel, and what is doubtful: of the
    places too, if they are `doubted`."""
    shape = (len(job.places), *job.shape[1:])
    open_mapped(job.folder / _KNOWN, np.bool_, shape)
    found = run(_READ, partial(read_slab, job), job.slabs)
    values = np.unique(np.concatenate([each["values"] for each in found]))
    if len(values) > LABELS:
        raise ScanError(f"the known slices must be a mask or have at most {LABELS} labels, got {len(values)} values")
    require_outline(sum(int(each["inside"]) for each in found), math.prod(shape), "the known slices")
    depths = [(float(total), int(count)) for each in found for total, count in each["depths"]]
    gap = job.spacing[0] * max(np.diff(job.places))
    pixel = choose_pixel(thickness_of_sums(depths), job.spacing[1:], gap)
    there = np.concatenate([each["there"] for each in found])
    doubts = doubt_places(there, job.places) if doubted else ()
    return replace(job, pixel=pixel), (*doubts, *doubt_labels(values))


def look_at_slab(job: Job, number: int) -> Record:
    """Return which slices of a slab have labels."""
    return {"there": find_labelled(job.slab(number)[1])}


def read_slab(job: Job, number: int) -> Record:
    """Write the known slices of a slab into their file; return which slices have labels, which labels known slices
    have, how many of their voxels are inside, and how deep these lie."""
    rows, values = job.slab(number)
    found = {"there": find_labelled(values), "values": values[:0, 0, 0], "inside": 0, "depths": np.empty((0, 2))}
    which = [k for k, place in enumerate(job.places) if rows.start <= place < rows.stop]
    if not which:
        return found
    values = values[[job.places[k] - rows.start for k in which]]
    inside = require_labels(values, "the known slices") > 0
    kept = np.load(job.folder / _KNOWN, mmap_mode="r+")
    kept[which[0] : which[-1] + 1] = inside
    kept.flush()
    depths = np.array([sum_depths(mask, job.spacing[1:]) for mask in inside])
    return {**found, "values": np.unique(values), "inside": np.count_nonzero(inside), "depths": depths}


def fill_block(job: Job, number: int) -> Record:
    """Write the probabilities of a block; return, of its voxels between known slices, the counts and the sum of
    probabilities, and the entropy of all its slices across each axis."""
    core, slices = job.cores[number], job.slices
    raster = Raster(job.shape[1:], job.spacing[1:], job.pixel, core[1:])
    rows = core[0]
    likely = np.empty([edge.stop - edge.start for edge in core], dtype=np.float32)
    for numbers, logits in fill_gaps(slices, load_filler(job.filler), raster, rows):
        here = (numbers >= rows.start) & (numbers < rows.stop)
        likely[numbers[here] - rows.start] = expit(logits[here])
    for k, outer in ((0, slice(0, job.places[0])), (-1, slice(job.places[-1] + 1, job.shape[0]))):
        here = slice(max(outer.start, rows.start) - rows.start, max(min(outer.stop, rows.stop) - rows.start, 0))
        if here.start < here.stop:
            depth = plane_distances(slices.inside[[k]], job.spacing[1:], slices.gap * job.spacing[0])[0]
            likely[here] = expit((SLOPE / job.pixel) * depth[core[1:]].astype(np.float32))
    far = slices.outside[rows]
    likely[far] = np.minimum(likely[far], 0.5)
    places, inside = slices.known(core)
    likely[places] = inside
    job.write(job.probability, core, likely)
    along = [np.zeros(n) for n in likely.shape]
    for k, plane in enumerate(likely):
        unsure = doubt(plane)
        along[0][k] = unsure.sum()
        along[1] += unsure.sum(1)
        along[2] += unsure.sum(0)
    told = likely[slices.between[rows]]
    sums = {"sum": told.sum(dtype=np.float64), "total": likely[~far].sum(dtype=np.float64)}
    return {"counts": count_probabilities(told), **sums, **{f"along {k}": each for k, each in enumerate(along)}}


def cut_block(job: Job, threshold: float, number: int) -> Record:
    """Write the mask of a block, given the probability from which voxels between known slices are inside; return how
    many are, and between known slices their number and the sum of their probabilities."""
    core = job.cores[number]
    stored = open_zarr(job.folder / job.probability)["0"][job.turn_back(core)]
    likely, between = np.moveaxis(stored, job.axis, 0), job.slices.between[core[0]]
    mask = likely > np.where(between, threshold, 0.5).astype(np.float32)[:, None, None]
    job.write(job.mask, core, mask.view(np.uint8))
    told = mask[between]
    both = likely[between][told].sum(dtype=np.float64)
    return {"inside": np.count_nonzero(mask), "told": np.count_nonzero(told), "both": both}


def halve_core(path: Path, level: int, number: int) -> Record:
    """Write a part of a level of a store from the level before it."""
    halve_level(group := open_zarr(path), level, cores_of(group, level)[number])
    return {}


def _gather(job: Job, found: Iterable[Record]) -> dict[str, Any]:
    """Return the sums over blocks; of what is along an axis, in its slices."""
    total: dict[str, Any] = {f"along {k}": np.zeros(n) for k, n in enumerate(job.shape)}
    for core, each in zip(job.cores, found, strict=True):
        for name, values in each.items():
            if name.startswith("along"):
                total[name][core[int(name[-1])]] += values
            else:
                total[name] = total.get(name, 0) + values
    return total


@cache
def load_filler(path: str | Path | None) -> Taught:
    """Load a filler, once in a process."""
    return Taught.load(path)
