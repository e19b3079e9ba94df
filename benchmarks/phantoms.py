"""Thickness of exact phantoms, beside what other packages say of it.

Phantoms are periodic in a box of six thicknesses, at 4, 6, 8 and 16 voxels of thickness (a slab also at 5): slabs with
gaps of their own thickness, upright and oblique; an oblique rod; a ball; a torus. All but the upright slab are drawn at
three random places, from 8 voxels at one. `measure` sees the box as periodic; the others see it continued by a
thickness on each side, and their maps are averaged inside.

- `--packages PYTHON,…`: interpreters that have `localthickness`, `porespy`, `bone_microarchitecture`, `ormir_xct`,
  or `itk` with `itk-bonemorphometry`. Some are under the GPL: each is run in its own environment.

BoneJ is a plugin of a Java program; the rule of its source is rewritten here (`bonej_thickness`).
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numba import njit
from scipy import ndimage

from benchmarks.harness import Cases, Figure, Values, run_python, show
from curvafit.scan.tiles import measure

#: Edge of the box in thicknesses; positions of each phantom by its thickness in voxels.
EDGE = 6
PLACES = {4: 3, 5: 1, 6: 3, 8: 1, 16: 1}
OBLIQUE = np.array([1, 2, 2]) / 3
#: A package's module, and how its map of thickness, or its numbers, come from a mask.
PACKAGES = {
    "localthickness": ("localthickness", "2 * module.local_thickness(mask)"),
    "porespy_bf": ("porespy", "2 * module.filters.local_thickness(mask, method='bf')"),
    "porespy_dt": ("porespy", "2 * module.filters.local_thickness(mask, method='dt')"),
    "bone": ("bone_microarchitecture.thickness", "module.hildebrand_thickness_map(mask, (1, 1, 1), backend='cpu')"),
    "ormir": ("ormir_xct.core.util.hildebrand_thickness", "module.compute_local_thickness_from_mask(mask, 1.0)"),
    "ormir_ipl": (
        "ormir_xct.core.util.hildebrand_thickness",
        "module.compute_local_thickness_from_mask(mask, 1.0, oversample=False)",
    ),
    "itk": ("itk", "stereology(mask).GetTbTh()"),
}
PROGRAM = """
import sys
import numpy as np
import MODULE as module
def stereology(mask):
    image = module.image_from_array(mask.astype(np.float32))
    found = module.BoneMorphometryFeaturesFilter[type(image)].New(image, Threshold=0.5)
    found.Update()
    return found
given, numbers = np.load(sys.argv[1]), []
for name in given.files[1:]:
    mask = given[name]
    found = np.asarray(EXPRESSION)
    if found.ndim == 3:
        found = found[tuple(slice(given["margin"], n - given["margin"]) for n in found.shape)]
        found = found[found > 0].mean()
    numbers.append(found)
np.save(sys.argv[2], numbers)
"""

# ---- phantoms --------------------------------------------------------------------------------------------------------
# Distances are to the surface, positive inside, at points (…, 3) in thicknesses, in a periodic box of EDGE.


def centred(points: np.ndarray) -> np.ndarray:
    return (points + EDGE / 2) % EDGE - EDGE / 2


def slabs(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return 0.5 - np.abs((points @ normal + 1) % 2 - 1)


def rod(points: np.ndarray) -> np.ndarray:
    nearest = np.full(points.shape[:-1], np.inf)
    for shift in np.ndindex(3, 5, 5):
        away = points - EDGE * (np.array(shift) - (1, 2, 2))
        nearest = np.minimum(nearest, (away**2).sum(-1) - (away @ OBLIQUE) ** 2)
    return 0.5 - np.sqrt(np.maximum(nearest, 0))


def ball(points: np.ndarray) -> np.ndarray:
    return 0.5 - np.linalg.norm(centred(points), axis=-1)


def torus(points: np.ndarray) -> np.ndarray:
    z, y, x = np.moveaxis(centred(points), -1, 0)
    return 0.5 - np.hypot(np.hypot(y, x) - 1.5, z)


PHANTOMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "oblique": partial(slabs, normal=OBLIQUE),
    "rod": rod,
    "ball": ball,
    "torus": torus,
}


def masks(thickness: int) -> dict[str, np.ndarray]:
    """Return the phantoms at a thickness in voxels, `NAME-PLACE`; at an odd one the slab alone."""
    random, found = np.random.default_rng(thickness), {}
    points = (np.moveaxis(np.indices((EDGE * thickness,) * 3), 0, -1) + 0.5) / thickness
    found["slab-0"] = slabs(points - 0.5, np.array([1, 0, 0])) > 0
    for name, distance in PHANTOMS.items() if thickness % 2 == 0 else ():
        for place in range(PLACES[thickness]):
            found[f"{name}-{place}"] = distance(points + random.random(3)) > 0
    return found


# ---- what is measured ------------------------------------------------------------------------------------------------


def bonej_thickness(mask: np.ndarray) -> np.ndarray:
    """Return the thickness by BoneJ's rule: balls of 2·EDT; then surface voxels take their inner neighbours' mean."""
    square = np.rint(ndimage.distance_transform_edt(mask) ** 2).astype(np.int64)  # type: ignore[operator]
    found, cube = 2 * np.sqrt(paint_balls(square)) * mask, np.ones((3, 3, 3))
    inner = ndimage.binary_erosion(mask, cube, border_value=1)
    sums, counts = (ndimage.convolve(part, cube, mode="constant") for part in (found * inner, 1.0 * inner))
    return np.where(mask & ~inner & (counts > 0.5), sums / np.maximum(counts, 1), found)


@njit
def paint_balls(square):
    """Return the largest squared radius of the balls that cover each voxel."""
    found = np.zeros_like(square)
    nz, ny, nx = square.shape
    for z, y, x in np.ndindex(square.shape):
        s = square[z, y, x]
        r = int(math.sqrt(s))
        for k in range(max(0, z - r), min(nz, z + r + 1)):
            for j in range(max(0, y - r), min(ny, y + r + 1)):
                for i in range(max(0, x - r), min(nx, x + r + 1)):
                    if (k - z) ** 2 + (j - y) ** 2 + (i - x) ** 2 <= s and found[k, j, i] < s:
                        found[k, j, i] = s
    return found


def run_elsewhere(python: Path, program: str, folder: Path, **arrays: np.ndarray) -> np.ndarray:
    """Return what a program makes of arrays in another interpreter."""
    given, found = folder / "given.npz", folder / "found.npy"
    np.savez(given, allow_pickle=False, **arrays)
    run_python("-c", program, given, found, python=python)
    return np.load(found)


def case(column: str, thickness: int, python: Path | None, cases: Cases) -> Values:
    """Return the mean thickness of each phantom by a package, means over places; or why there is none."""
    given = masks(thickness)
    continued = {name: np.pad(mask, thickness, mode="wrap") for name, mask in given.items()}
    inner = (slice(thickness, -thickness),) * 3
    if column == "curvafit":
        found = (measure(mask.astype(np.uint8), kind="mask", periodic=True) for mask in given.values())
        numbers = [each["thickness"].value for each in found]
    elif column == "bonej":
        numbers = [bonej_thickness(mask)[inner].sum() / mask[inner].sum() for mask in continued.values()]
    else:
        module, expression = PACKAGES[column]
        program = PROGRAM.replace("MODULE", module).replace("EXPRESSION", expression)
        try:
            assert python is not None
            numbers = run_elsewhere(python, program, cases.folder, margin=np.array(thickness), **continued)
        except SystemExit as error:
            return {"failed": str(error).strip().splitlines()[-1]}
    table, names = np.asarray(numbers, dtype=float), [name.partition("-")[0] for name in given]
    means = {name: [float(table[[other == name for other in names]].mean())] for name in dict.fromkeys(names)}
    return means


def interpreter(module: str, pythons: Sequence[Path]) -> Path | None:
    """Return the first interpreter that has a module."""
    for python in pythons:
        with contextlib.suppress(SystemExit):
            run_python("-c", f"import {module}", python=python)
            return python
    return None


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--packages", default="", help="interpreters that have other packages, with commas")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    pythons = [Path(each) for each in options.packages.split(",") if each]
    packages = {column: interpreter(module, pythons) for column, (module, _) in PACKAGES.items()}
    jobs = {f"{column}-{thickness}": partial(case, column, thickness, packages.get(column), cases)
            for thickness in PLACES
            for column in ("curvafit", "bonej", *(n for n in PACKAGES if packages[n]))}  # fmt: skip
    tables = cases.all(dict(list(jobs.items())[:2]) if options.quick else jobs)
    failed = {name: f"no interpreter has {PACKAGES[name][0]}" for name in PACKAGES if not packages[name]}
    failed |= {name: values["failed"] for name, values in tables.items() if "failed" in values}
    figures = {f"phantoms.{phantom}_{name.partition('-')[2]}.{name.partition('-')[0]}": Figure(found[0])
               for name, values in tables.items() if name not in failed
               for phantom, found in values.items()}  # fmt: skip
    show(["case", "why there is none"], list(failed.items()))
    show(["thickness", "found"], list(figures.items()))
    return figures
