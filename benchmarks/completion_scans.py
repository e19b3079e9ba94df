"""The volume between known slices of real structures: plain interpolations and F_ε.

    CURVAFIT_DATA=… python -m benchmarks.completion_scans [--only mitochondria-32,bone,…] [--every 8] [-o …]

CURVAFIT_DATA names the folder with `scans/`. A structure has two sides: two volumes, or the lower and the upper half of
one. Its targets are the fullest blocks of each side (`BLOCKS` says how many, and of which voxels); the law is inferred
from the mask of the whole *other* side by `infer --fast`, and the other side's fullest block is the example. Slices
follow the first axis, or the second where the first has fewer than 48.

- `spline`, `linear`, `nearest`, `ITK` (its morphological contour interpolation, where its package is installed): the
  best of them *in hindsight*, by Dice, is what the others are held to (`best`).
- `example`: `reconstruct`, tried out on the example; `whole`: on all of the other side; `left out`: on slices left out;
  a star where it said that no prior helps.

Between the first and the last known slice: Dice, the sum of the Betti numbers' errors, the error of the mean thickness
in voxels, and that of the connectivity density in loops a million voxels. The last rows are medians of a structure.

Finished cases stay in the folder, with their masks: a second run goes on. `--seconds` ends a run early. `--picture
CASE` draws three slices of a case's truth, start and completed volume in place of the table.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu
from skimage.segmentation import find_boundaries

from benchmarks.completion_ways import ITK, baselines, draw, interpolated, scores, stored
from curvafit.core.files import write_atomically, write_content
from curvafit.geometry.morphometry import local_thickness
from curvafit.geometry.topology import euler_of_window
from curvafit.inference.fit import Fit
from curvafit.inference.infer import infer
from curvafit.segmentation.completion import reconstruct
from curvafit.segmentation.slices import WAYS, Slices
from curvafit.volumes.scan import Field, load

#: Ways that are tried out.
TRIED = ("example", "whole", "left out")
FIGURES = ("dice", "betti", "thickness", "connectivity")
#: Slices of a block along its first axis below which those along the second are known.
FEW = 48


class Structure(NamedTuple):
    """Two files, or one that is cut in two along its last axis; how they are read, made a mask and cut into blocks.

    A gap is left out between the halves, in voxels of the file.
    """

    files: tuple[str, ...]
    blocks: tuple[int, int, int]
    reading: Mapping[str, Any] = {}
    mask: str = "labels"
    coarser: int = 1
    gap: int = 0


_CELL = ("urocell_mito_fib1-0-0-0.nii.gz", "urocell_mito_fib1-3-2-1.nii.gz")
_NANOMETRES = {"spacing": 16.0, "unit": "nm"}
#: The two stacks of Poon show one field of view: one is enough.
_POON = ("vesselNN/poon2015_BBB_noLeakage_label.tif",)
STRUCTURES = {
    "mitochondria-32": Structure(_CELL, (128, 64, 64), _NANOMETRES, coarser=2),
    "mitochondria-16": Structure(_CELL, (128, 64, 64), _NANOMETRES),
    "bone": Structure(("lhdl_trabecular_200_otsu_mask.tif",), (100, 100, 100)),
    "minivess": Structure(("minivess_mv68_mask.nii.gz",), (106, 64, 64), {"spacing": (2, 0.994, 0.994), "unit": "um"}),
    "membranes": Structure(("plantseg_sample_ovule.h5",), (32, 128, 64), {"key": "label"}, "boundaries"),
    "felt": Structure(("fiberform_100.tif",), (100, 50, 50), {"spacing": 1.0, "unit": "voxel"}, "grey"),
    "poon": Structure(_POON, (25, 96, 64), {"spacing": (5, 0.994, 0.994), "unit": "um"}, gap=32),
}
#: Targets a side.
BLOCKS = {"mitochondria-32": 4, "mitochondria-16": 3, "bone": 2, "minivess": 2, "membranes": 1, "felt": 2, "poon": 2}


@cache
def sides(name: str) -> tuple[Field, Field]:
    """The masks of a structure's sides."""
    structure = STRUCTURES[name]
    folder = Path(os.environ["CURVAFIT_DATA"]) / "scans"
    volumes = [_mask(load(folder / file, **structure.reading), structure) for file in structure.files]
    if len(volumes) == 1:
        (whole,) = volumes
        middle, margin = whole.shape[2] // 2, structure.gap // 2
        volumes = [
            whole.crop((slice(None), slice(None), half))
            for half in (slice(middle - margin), slice(-middle + margin, None))
        ]
    return volumes[0], volumes[1]


def _mask(volume: Field, structure: Structure) -> Field:
    """The mask of a file; coarser voxels are inside where half of them is."""
    values = volume.values
    if structure.mask == "grey":
        smooth = ndimage.gaussian_filter(values.astype(np.float32), 1.0)
        values = smooth > threshold_otsu(smooth)
    elif structure.mask == "boundaries":
        values = find_boundaries(values)
    n = structure.coarser
    parts = np.asarray(values > 0).reshape([m for size in values.shape for m in (size // n, n)])
    inside = parts.mean(axis=(1, 3, 5)) >= 0.5
    return replace(volume, values=inside.astype(np.uint8), spacing=tuple(n * h for h in volume.spacing), affine=None)


@cache
def blocks(name: str, side: int) -> list[Field]:
    """The blocks of a side, the fullest first."""
    whole, size = sides(name)[side], STRUCTURES[name].blocks
    starts = product(*(range(0, n - m + 1, m) for n, m in zip(whole.shape, size, strict=True)))
    boxes = [tuple(slice(a, a + m) for a, m in zip(start, size, strict=True)) for start in starts]
    return sorted((whole.crop(box) for box in boxes), key=lambda block: -int(block.values.sum()))


def fitted(name: str, side: int, folder: Path) -> Fit:
    """The fit of a side's mask, made once."""
    path = folder / f"fit-{name}-{side}.json"
    if not path.exists():
        write_content(path, infer(sides(name)[side], kind="mask", fast=True).fit.to_json())
    return Fit.load(path)


class Case(NamedTuple):
    """A block of a structure's side, and every how many slices are known."""

    name: str
    side: int
    block: int
    every: int

    def __str__(self) -> str:
        return "-".join(map(str, self))

    @property
    def target(self) -> Field:
        """The block, whole."""
        return blocks(self.name, self.side)[self.block]

    @property
    def axis(self) -> int:
        """The axis that the slices follow."""
        return int(self.target.shape[0] < FEW)

    @property
    def between(self) -> tuple[slice, ...]:
        """The box between the first and the last known slice."""
        last = (self.target.shape[self.axis] - 1) // self.every * self.every
        return (*[slice(None)] * self.axis, slice(0, last + 1))


def completed(case: Case, way: str, folder: Path) -> tuple[np.ndarray, str]:
    """A way's mask, and what it says of itself."""
    target, axis = case.target, case.axis
    if way in (*WAYS, ITK):
        first = np.moveaxis(target.values > 0, axis, 0)
        edges = (target.spacing[axis], *(h for k, h in enumerate(target.spacing) if k != axis))
        places = range(0, len(first), case.every)
        slices = Slices(first[places], tuple(places), len(first), edges, target.unit)
        return np.moveaxis(interpolated(slices, way), 0, axis), ""
    examples = {"example": blocks(case.name, 1 - case.side)[0], "whole": sides(case.name)[1 - case.side]}
    known = {"every": case.every, "axis": axis, "example": examples.get(way)}
    found = reconstruct(target, fitted(case.name, 1 - case.side, folder), **known)
    return found.mask.values > 0, found.status


def measured(mask: np.ndarray, truth: np.ndarray, spacing: tuple[float, float, float]) -> dict[str, float]:
    """The scores, and the errors of the mean thickness (in the smallest edges) and of the connectivity density."""
    edges = tuple(h / min(spacing) for h in spacing)
    thickness = [float(local_thickness(each, edges)[each].mean()) for each in (mask, truth)]
    loops = [-euler_of_window(each) / each.size * 1e6 for each in (mask, truth)]
    apart = {"thickness": abs(thickness[0] - thickness[1]), "connectivity": abs(loops[0] - loops[1])}
    return {**scores(mask, truth), **apart}


def scored(case: Case, way: str, folder: Path) -> dict:
    """A way's scores between the first and the last known slice, made once."""

    def make() -> dict:
        begun = time.process_time()
        mask, status = completed(case, way, folder)
        seconds = time.process_time() - begun
        write_atomically(masks_of(case, way, folder), lambda temporary: np.save(temporary, np.packbits(mask)))
        found = measured(mask[case.between], case.target.values[case.between] > 0, case.target.spacing)
        return {**found, "status": status, "seconds": seconds}

    return stored(folder / f"case-{case}-{way.replace(' ', '-')}.json", make)


def masks_of(case: Case, way: str, folder: Path) -> Path:
    """The file of a way's mask."""
    return folder / f"mask-{case}-{way.replace(' ', '-')}.npy"


def table(found: Mapping[Case, Mapping[str, dict]]) -> None:
    """A row a case, and the medians of each structure at each distance of the slices."""
    if not found:
        return
    tried = [way for way in TRIED if way in next(iter(found.values()))]
    plain = [way for way in next(iter(found.values())) if way not in TRIED]
    columns, width = ("spline", "best", *tried), 9 * (2 + len(tried))
    print(
        f"\n{'':32}{'Dice':{8 * len(plain)}}{'gain':{9 * len(tried)}}", *(f"{figure:{width}}" for figure in FIGURES[1:])
    )
    print(f"{'':32}" + "".join(f"{way:>8}" for way in plain) + "".join(f"{way:>9}" for way in tried), end=" ")
    print(" ".join(["".join(f"{way:>9}" for way in columns)] * 3))
    for name, every in dict.fromkeys((case.name, case.every) for case in found):
        rows = {case: _row(each) for case, each in found.items() if (case.name, case.every) == (name, every)}
        for case, row in rows.items():
            stars = ["*" if found[case][way]["status"].startswith("no prior") else " " for way in tried]
            _print(str(case), plain, dict(zip(tried, stars, strict=True)), row)
        middle = {key: float(np.median([row[key] for row in rows.values()])) for key in next(iter(rows.values()))}
        _print(f"{name}, every {every}: median", plain, dict.fromkeys(tried, " "), middle)


def _row(ways: Mapping[str, dict]) -> dict[tuple[str, str], float]:
    """A case's figures by way and figure; the tried ways' Dice as a gain on the best plain one."""
    best = max((way for way in ways if way not in TRIED), key=lambda way: ways[way]["dice"])
    row = {(way, figure): each[figure] for way, each in ways.items() for figure in FIGURES}
    row |= {("best", figure): ways[best][figure] for figure in FIGURES}
    return row | {(way, "gain"): 100 * (ways[way]["dice"] - ways[best]["dice"]) for way in TRIED if way in ways}


def _print(title: str, plain: list[str], stars: Mapping[str, str], row: Mapping[tuple[str, str], float]) -> None:
    cells = "".join(f"{row[way, 'dice']:8.3f}" for way in plain)
    gains = "".join(f"{row[way, 'gain']:+8.1f}{star}" for way, star in stars.items())
    others = ["".join(f"{row[way, key]:9.2f}" for way in ("spline", "best", *stars)) for key in FIGURES[1:]]
    print(f"{title:32}{cells}{gains}", *others, flush=True)


def picture(case: Case, folder: Path) -> None:
    """Draw a case's spline and, where they were made, its completed volumes."""

    def mask(way: str) -> np.ndarray:
        packed = np.unpackbits(np.load(masks_of(case, way, folder)), count=case.target.values.size)
        return np.moveaxis(packed.reshape(case.target.shape) > 0, case.axis, 0)

    masks = {way: mask(way) for way in ("spline", *TRIED) if masks_of(case, way, folder).exists()}
    draw(np.moveaxis(case.target.values > 0, case.axis, 0), masks, case.every, folder / f"{case}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(STRUCTURES))
    parser.add_argument("--every", default="8")
    parser.add_argument("--ways", default=",".join(TRIED), help="besides the interpolations")
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--picture", metavar="CASE", help="as bone-0-1-8: structure, side, block, every")
    parser.add_argument("-o", "--output", type=Path, default=Path("completion_scans"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    if options.picture:
        name, *numbers = options.picture.rsplit("-", 3)
        picture(Case(name, *map(int, numbers)), options.output)
        return
    found, begun = {}, time.monotonic()
    ways = (*baselines(), *filter(None, options.ways.split(",")))
    for every, name in product(map(int, options.every.split(",")), options.only.split(",")):
        for case in (Case(name, side, block, every) for side in (0, 1) for block in range(BLOCKS[name])):
            if time.monotonic() - begun > options.seconds:
                break
            found[case] = {way: scored(case, way, options.output) for way in ways}
            print(f"{case}: " + ", ".join(f"{way} {each['dice']:.4f}" for way, each in found[case].items()), flush=True)
    table(found)


if __name__ == "__main__":
    main()
