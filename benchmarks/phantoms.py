"""Thickness, surface, connectivity and curvature of exact phantoms, beside what other packages say of them.

Phantoms are periodic in a box of six thicknesses, at 4, 6, 8 and 16 voxels of thickness (a slab also at 5): slabs with
gaps of their own thickness, upright and oblique; an oblique rod; a ball; a torus; a sheet around the gyroid; and a
grown shape, whose thickness is extrapolated from two fine grids. All but the upright slab are drawn at three random
places, from 8 voxels at one. `measure` sees the box as periodic; the others see it continued by a thickness on each
side, and their maps are averaged inside.

- `--packages PYTHON,…`: interpreters that have `localthickness`, `porespy`, `bone_microarchitecture`, `ormir_xct`,
  `itk` with `itk-bonemorphometry`, or `pykarambola`. Some are under the GPL: each is run in its own environment.

BoneJ is a plugin of a Java program; the rule of its source is rewritten here (`bonej_thickness`).
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial.transform import Rotation

from benchmarks.harness import Cases, Figure, Values, run_python, show
from benchmarks.rivals import run_elsewhere
from curvafit.generation.flow import generate
from curvafit.geometry.diagram import Diagram, family_shares
from curvafit.geometry.morphometry import local_thickness
from curvafit.scan.measure import measure, measure_surface
from curvafit.scan.prepare import prepare
from curvafit.volumes.field import Field

#: Edge of the box in thicknesses; positions of each phantom by its thickness in voxels.
EDGE = 6
PLACES = {4: 3, 5: 1, 6: 3, 8: 1, 16: 1}
OBLIQUE = np.array([1, 2, 2]) / 3
#: Families whose shares are compared.
SHOWN = ("spheres", "layers", "tubes")
#: Windows of a texture, and the deviations of the Gaussians that make textures, in voxels.
WINDOWS = {"cubes_16": (16, 16, 16), "cubes_32": (32, 32, 32), "slices_8": (8, 96, 96), "slices_16": (16, 96, 96)}
WIDTHS = {"fine": 1.8, "middle": 2.5, "coarse": 4.0}
#: Area of the nodal gyroid in the box, by marching cubes on 160³ points.
GYROID_AREA = 3.0919 * EDGE**2
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
    "bone_number": (
        "bone_microarchitecture.thickness",
        "module.trabecular_number_map(mask, mask | ~mask, (1, 1, 1), backend='cpu')",
    ),
    "itk_number": ("itk", "stereology(mask).GetTbN()"),
    "pykarambola": ("pykarambola", "minkowski(mask)"),
}
#: Columns of numbers other than thickness.
AT_EIGHT = ("bone_number", "itk_number", "pykarambola")
PROGRAM = """
import sys
import numpy as np
import MODULE as module
def stereology(mask):
    image = module.image_from_array(mask.astype(np.float32))
    found = module.BoneMorphometryFeaturesFilter[type(image)].New(image, Threshold=0.5)
    found.Update()
    return found
def minkowski(mask):
    w = module.minkowski_tensors_from_label_image(mask.astype(int), compute=["w100", "w200", "w300"])[1]
    return [3 * w["w100"], w["w200"] / w["w100"], 3 * w["w300"] / (4 * np.pi)]
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


def gyroid_sheet(points: np.ndarray) -> np.ndarray:
    """Return 0.5 less the distance to the nodal gyroid: foot points by Newton's steps along its normals."""
    q = points * 2 * np.pi / EDGE
    foot = q.copy()
    for _ in range(30):
        (s, c), (s2, c2), (s3, c3) = ((np.sin(part), np.cos(part)) for part in np.moveaxis(foot, -1, 0))
        value = s * c2 + s2 * c3 + s3 * c
        slope = np.stack([c * c2 - s3 * s, c2 * c3 - s * s2, c3 * c - s2 * s3], axis=-1)
        square = (slope**2).sum(-1, keepdims=True)
        foot = foot - slope * value[..., None] / square
        offset = q - foot
        foot = foot + 0.5 * (offset - slope * (offset * slope).sum(-1, keepdims=True) / square)
    return 0.5 - np.linalg.norm(q - foot, axis=-1) * EDGE / (2 * np.pi)


PHANTOMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "oblique": partial(slabs, normal=OBLIQUE),
    "rod": rod,
    "ball": ball,
    "torus": torus,
    "gyroid": gyroid_sheet,
}


#: Semi-axes of ellipsoids, in thicknesses.
ELLIPSOIDS = {"rod_like": (0.5, 0.5, 1.5), "plate_like": (0.5, 1.5, 1.5), "between": (0.5, 1.0, 2.0)}


def ellipsoid(axes: tuple[float, float, float], thickness: int) -> np.ndarray:
    """Return an ellipsoid, turned, in a box of `EDGE` thicknesses."""
    turn = Rotation.from_rotvec([0.4, 0.7, -0.3]).as_matrix()
    points = (np.moveaxis(np.indices((EDGE * thickness,) * 3), 0, -1) + 0.5) / thickness - EDGE / 2
    return np.square((points @ turn) / np.array(axes)).sum(-1) < 1


def exact_diagram(name: str) -> Diagram:
    """Return the curvature diagram of a torus or an ellipsoid, in thicknesses, of 400² patches."""
    φ, θ = np.meshgrid((np.arange(400) + 0.5) * 2 * np.pi / 400, (np.arange(400) + 0.5) * np.pi / 400)
    if name == "torus":
        R, r = 1.5, 0.5
        around = np.cos(2 * θ)
        κ1, κ2, area = np.full_like(θ, 1 / r), around / (R + r * around), R + r * around
    else:
        a, b, c = ELLIPSOIDS[name]
        x, y, z = a * np.sin(θ) * np.cos(φ), b * np.sin(θ) * np.sin(φ), c * np.cos(θ)
        p = np.sqrt(x**2 / a**4 + y**2 / b**4 + z**2 / c**4)
        K, H = (a * b * c * p**2) ** -2, (a**2 + b**2 + c**2 - x**2 - y**2 - z**2) / (2 * (a * b * c) ** 2 * p**3)
        root = np.sqrt(np.maximum(H**2 - K, 0))
        κ1, κ2, area = H + root, H - root, a * b * c * p * np.sin(θ)
    area = area * {"torus": 4 * np.pi**2 * 1.5 * 0.5 / area.sum()}.get(name, 2 * np.pi**2 / 400**2)
    return Diagram(np.column_stack([κ1.ravel(), κ2.ravel()]), area.ravel())


def shares(thickness: int) -> Values:
    """Return the shares of families of phantoms: of exact curvatures, at the measured thickness; by `measure`."""
    points = (np.moveaxis(np.indices((EDGE * thickness,) * 3), 0, -1) + 0.5) / thickness
    given = {"oblique": slabs(points, OBLIQUE) > 0, "rod": rod(points) > 0, "ball": ball(points) > 0}
    exact: dict[str, dict[str, float]] = {"oblique": {"layers": 1}, "rod": {"tubes": 1}, "ball": {"spheres": 1}}
    given["torus"] = torus(points) > 0
    given |= {name: ellipsoid(axes, thickness) for name, axes in ELLIPSOIDS.items()}
    found = {}
    for name, mask in given.items():
        measured = measure(mask.astype(np.uint8), kind="mask", periodic=True)
        if name not in exact:
            prepared = prepare(Field(mask), kind="mask", periodic=True)
            radius = prepared.thickness * prepared.working_voxel / 2 / thickness
            exact[name] = family_shares(exact_diagram(name), radius)
        found[name] = [[exact[name].get(family, 0.0), measured[f"share of {family}"].value] for family in SHOWN]
    return found


def windows(width: float) -> Values:
    """Return the surface density of windows over that of all, means over windows and four textures, by their shape.

    Textures of 96³ voxels are level sets of smoothed noise that fill 31 % and do not repeat.
    """
    found: dict[str, list[float]] = {name: [] for name in WINDOWS}
    for seed in range(4):
        noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((108,) * 3), width)[
            (slice(6, -6),) * 3
        ]
        mask = noise > np.quantile(noise, 0.69)
        whole = surface_density(mask)
        for name, shape in WINDOWS.items():
            parts = itertools.product(*(range(0, 96, n) for n in shape))
            boxes = (tuple(slice(a, a + n) for a, n in zip(part, shape, strict=True)) for part in parts)
            found[name].append(float(np.mean([surface_density(mask[box]) for box in boxes]) / whole))
    return {name: float(np.mean(values)) for name, values in found.items()}


def surface_density(mask: np.ndarray) -> float:
    if mask.all() or not mask.any():
        return 0.0
    return float(measure_surface(mask, (1.0, 1.0, 1.0), False)[1][:, 0].sum()) / mask.size


def truths(name: str) -> Values:
    """Return volume, area, χ and ∫H dA of a phantom in the box; of the sheet by Steiner, with ∫K dA = -16π."""
    A, R, r, L, π = GYROID_AREA, 1.5, 0.5, 3 * EDGE, math.pi
    volume, area, χ, bend = {
        "slab": (EDGE**3 / 2, EDGE**3, 0, 0),
        "oblique": (EDGE**3 / 2, EDGE**3, 0, 0),
        "rod": (π * r**2 * L, 2 * π * r * L, 0, π * L),
        "ball": (π / 6, π, 1, 2 * π),
        "torus": (2 * π**2 * R * r**2, 4 * π**2 * R * r, 0, 2 * π**2 * R),
        "gyroid": (A - 4 * π / 3, 2 * A - 8 * π, -8, -16 * π),
    }[name]
    return {"fraction": volume / EDGE**3, "surface": area / EDGE**3, "euler": χ, "bend": bend / area}


def masks(thickness: int, cases: Cases) -> dict[str, np.ndarray]:
    """Return the phantoms at a thickness in voxels, `NAME-PLACE`; at an odd one the slab alone."""
    random, found = np.random.default_rng(thickness), {}
    points = (np.moveaxis(np.indices((EDGE * thickness,) * 3), 0, -1) + 0.5) / thickness
    found["slab-0"] = slabs(points - 0.5, np.array([1, 0, 0])) > 0
    for name, distance in PHANTOMS.items() if thickness % 2 == 0 else ():
        for place in range(PLACES[thickness]):
            found[f"{name}-{place}"] = distance(points + random.random(3)) > 0
    if thickness % 2 == 0:
        found["grown-0"] = grown(round(thickness / grown_thickness(cases)), cases)
    return found


def grown(edge: int, cases: Cases) -> np.ndarray:
    """Return a grown shape, periodic, on `edge` voxels."""
    field = cases.array("grown", lambda: generate("trabec", grid=48, seed=1).field.numpy())
    return np.asarray(ndimage.zoom(field, edge / len(field), order=3, mode="grid-wrap", grid_mode=True)) > 0


@cache
def grown_thickness(cases: Cases) -> float:
    """Return the grown shape's thickness in edges of its box: of two grids, extrapolated to voxels of no size."""
    coarse, fine = (
        float(local_thickness(mask, (1 / n,) * 3, periodic=True)[mask].mean(dtype=np.float64))
        for n, mask in ((n, grown(n, cases)) for n in (72, 144))
    )
    return 2 * fine - coarse


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


def ours(mask: np.ndarray) -> list[float]:
    found = measure(mask.astype(np.uint8), kind="mask", periodic=True)
    return [found[symbol].value for symbol in ("Tb.Th", "Tb.N", "BV/TV", "BS/TV", "χ", "H")]


def case(column: str, thickness: int, python: Path | None, cases: Cases) -> Values:
    """Return the numbers of each phantom by a package, means over places; or why there are none."""
    given = masks(thickness, cases)
    continued = {name: np.pad(mask, thickness, mode="wrap") for name, mask in given.items()}
    if column == "pykarambola":
        given = {name: mask for name, mask in given.items() if name.startswith(("ball", "torus"))}
        continued = {name: np.roll(mask, EDGE * thickness // 2, (0, 1, 2)) for name, mask in given.items()}
    inner = (slice(thickness, -thickness),) * 3
    if column == "curvafit":
        numbers = [ours(mask) for mask in given.values()]
    elif column == "bonej":
        numbers = [bonej_thickness(mask)[inner].sum() / mask[inner].sum() for mask in continued.values()]
    else:
        module, expression = PACKAGES[column]
        program = PROGRAM.replace("MODULE", module).replace("EXPRESSION", expression)
        try:
            assert python is not None
            numbers, _ = run_elsewhere(python, program, cases.folder, margin=np.array(thickness), **continued)
        except SystemExit as error:
            return {"failed": str(error).strip().splitlines()[-1]}
    table = np.asarray(numbers, dtype=float).reshape(len(given), -1)
    names = [name.partition("-")[0] for name in given]
    means = {name: table[[other == name for other in names]].mean(0).tolist() for name in dict.fromkeys(names)}
    if "grown" in means and "number" not in column:
        exact = grown_thickness(cases) * len(given["grown-0"])
        means["grown"][0] += thickness - exact  # its box is a whole number of voxels
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
            for thickness in PLACES for column in ("curvafit", "bonej", *(name for name in PACKAGES if packages[name]))
            if thickness == 8 or column not in AT_EIGHT}  # fmt: skip
    by_family = cases.all({f"shares-{thickness}": partial(shares, thickness) for thickness in (8, 16)})
    in_windows = cases.all({f"windows-{name}": partial(windows, width) for name, width in WIDTHS.items()})
    tables = cases.all(dict(list(jobs.items())[:2]) if options.quick else jobs)
    failed = {name: f"no interpreter has {PACKAGES[name][0]}" for name in PACKAGES if not packages[name]}
    failed |= {name: values["failed"] for name, values in tables.items() if "failed" in values}
    figures = {f"phantom_shares.{phantom}_{family}.{column}": Figure(pair[column != "truth"])
               for name, found in by_family.items() for phantom, pairs in found.items()
               for family, pair in zip(SHOWN, pairs, strict=True)
               for column in ("truth", f"at_{name.removeprefix('shares-')}")}  # fmt: skip
    figures |= {f"phantom_windows.{shape}.{name.removeprefix('windows-')}": Figure(share)
                for name, found in in_windows.items() for shape, share in found.items()}  # fmt: skip
    for name, values in tables.items():
        column, _, thickness = name.partition("-")
        for phantom in {} if name in failed else values:
            if thickness == "8" and phantom != "grown":
                figures |= other_numbers(column, phantom, values[phantom])
            if column not in AT_EIGHT:
                figures[f"phantoms.{phantom}_{thickness}.{column}"] = Figure(values[phantom][0])
    show(["case", "why there is none"], list(failed.items()))
    show(["number", "found"], list(figures.items()))
    return figures


def other_numbers(column: str, phantom: str, found: Sequence[float]) -> dict[str, Figure]:
    """Return numbers at 8 voxels in thicknesses: surface over the true one, mean curvature, χ and Tb.N."""
    truth, t, head = truths(phantom), 8, f"phantom_numbers.{phantom}"
    if column == "curvafit":
        _, number, fraction, surface, euler, bend = found
        numbers = {"number": number * t, "fraction": fraction / truth["fraction"], "euler": euler}
        numbers |= {"surface": surface * t / truth["surface"], "bend": bend * t}
    elif column == "pykarambola":
        area, bend, euler = found
        area /= (EDGE * t) ** 3
        numbers = {"surface": area * t / truth["surface"], "bend": bend * t, "euler": euler}
    else:
        numbers = {"number": found[0] * t} if column.endswith("number") else {}
    return {f"{head}_{key}.{column.removesuffix('_number')}": Figure(float(value)) for key, value in numbers.items()}
