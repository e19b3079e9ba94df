"""Centrelines of exact tubes and of real vessels and cells: lengths, loops, radii, beside skan on a plain skeleton.

Phantoms lie at three random places, straight and turned, of radii 2 to 6 voxels: a cubic lattice of tubes that the
window cuts, a torus, a tree whose tips are balls. Errors are of the length in percent, where `trace` counts it, of the
number of loops, and of the median radius in voxels. skan gets scikit-image's skeleton, and as a radius the distance to
the nearest voxel outside; its length is that of the whole window. Real masks come from $CURVAFIT_DATA.
"""

from __future__ import annotations

import argparse
import math
import warnings
from functools import partial
from itertools import pairwise, product

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from benchmarks.harness import Cases, Figure, Values, data, show
from curvafit.geometry.topology import betti_numbers
from curvafit.scan.centreline import trace
from curvafit.scan.tiles import measure
from curvafit.volumes.read import load
from curvafit.volumes.volume import Volume

EDGE, RADII, PLACES = 96, (2.0, 3.5, 6.0), 3
CELL = 30.0
#: Most voxels along an axis of a real mask, whose middle is taken.
WIDEST = 160
PHANTOMS = ("lattice", "torus", "tree")
REAL = {
    "vesselexpress": ("vesselexpress_000_mask.tif", {}),
    "minivess": ("minivess_mv68_mask.nii.gz", {}),
    "mitochondria": ("urocell_mito_fib1-0-0-0.nii.gz", {"spacing": 16.0, "unit": "nm"}),
}

Lines = list[tuple[np.ndarray, np.ndarray]]


def lines_of(name: str, place: int) -> Lines:
    """Return the axes of a phantom's tubes; those of a torus are short chords of its circle."""
    random = np.random.default_rng([place, *name.encode()])
    turn = Rotation.random(rng=random).as_matrix() if place else np.eye(3)
    middle = EDGE / 2 + random.uniform(-3, 3, 3)
    if name == "lattice":
        steps, far = CELL * (np.arange(7) - 3), 3 * CELL
        ends = [np.insert([a, b], axis, side * far) for axis in range(3) for a, b in product(steps, steps)
                for side in (-1, 1)]  # fmt: skip
        lines = [(ends[k], ends[k + 1]) for k in range(0, len(ends), 2)]
    elif name == "torus":
        angles = np.linspace(0, 2 * math.pi, 400)
        circle = 30 * np.stack([0 * angles, np.sin(angles), np.cos(angles)], 1)
        lines = list(pairwise(circle))
    else:
        root, fork = np.array([-34.0, 0, 0]), np.array([-10.0, 0, 0])
        sides = [np.array([12.0, 26 * s, 0]) for s in (-1, 1)]
        lines = [(root, fork), *((fork, side) for side in sides)]
        lines += [(side, side + np.array([20.0, 4 * np.sign(side[1]), 18.0 * s])) for side in sides for s in (-1, 1)]
    return [(turn @ a + middle, turn @ b + middle) for a, b in lines]


def fill(lines: Lines, radius: float) -> np.ndarray:
    """Return the voxels of the window whose centres are nearer to a line than the radius."""
    points = np.stack(np.indices((EDGE,) * 3, dtype=float), -1)
    apart = np.full((EDGE,) * 3, np.inf)
    for a, b in lines:
        part = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)[..., None]
        apart = np.minimum(apart, np.linalg.norm(points - a - part * (b - a), axis=-1))
    return apart < radius


def length_inside(lines: Lines, margin: int) -> float:
    """Return the length of lines in the window without so many voxels from its faces."""
    total = 0.0
    for a, b in lines:
        along = a + np.linspace(0, 1, 2001)[:, None] * (b - a)
        total += ((along >= margin - 0.5) & (along <= EDGE - margin - 0.5)).all(1).mean() * np.linalg.norm(b - a)
    return float(total)


def ours(volume: Volume) -> Values:
    measures = measure(volume, kind="mask", maps=True)
    line = trace(measures.convert(volume.unit))
    edges = [of for *_, of in line.graph.edges(data=True)]
    lengths = [of["length"] for of in edges]
    thin = np.concatenate([of["radii"] for of in edges])  # the median leaves out what bulges
    margin = line.margin[0]
    inner = line["length density"].value * float(np.prod(np.subtract(volume.shape, 2 * margin)))
    counts = {name: line[f"N.{name}"].value for name in ("loops", "ends", "branches", "pieces")}
    return {"inner": inner, "margin": margin, "length": sum(lengths), "radius": float(np.median(thin))} | counts


def theirs(volume: Volume) -> Values:
    from skan import Skeleton, summarize
    from skimage.morphology import skeletonize

    mask = volume.values > 0
    distance = ndimage.distance_transform_edt(mask, volume.spacing)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        skeleton = Skeleton(skeletonize(mask) * distance, spacing=volume.spacing)
        table = summarize(skeleton, separator="-")
    nodes = set(table["node-id-src"]) | set(table["node-id-dst"])
    pieces = table["skeleton-id"].nunique()
    places = tuple(np.asarray(skeleton.coordinates).T.astype(int))
    length = float(table["branch-distance"].sum())
    return {"inner": length, "margin": 0, "length": length, "loops": len(table) - len(nodes) + pieces,
            "radius": float(np.median(distance[places])), "ends": int((np.asarray(skeleton.degrees) == 1).sum()),
            "branches": len(table), "pieces": pieces}  # fmt: skip


def phantom(name: str, radius: float, place: int) -> Values:
    """Return the errors of both on a phantom."""
    lines = lines_of(name, place)
    mask = fill(lines, radius)
    truth = {"loops": betti_numbers(mask)[1], "radius": radius}
    found: Values = {}
    for program, trace_by in (("curvafit", ours), ("skan", theirs)):
        row = trace_by(Volume(mask.astype(np.uint8), (1.0, 1.0, 1.0), "um"))
        found[f"{program} length"] = round(100 * (row["inner"] / length_inside(lines, row["margin"]) - 1), 2)
        found[f"{program} loops"] = row["loops"] - truth["loops"]
        found[f"{program} radius"] = round(row["radius"] - truth["radius"], 3)
    return found


def real(name: str) -> Values:
    """Return what both say of a mask."""
    file, reading = REAL[name]
    volume = load(data("scans", file), **reading)
    middle = tuple(slice(max(0, (n - WIDEST) // 2), (n + WIDEST) // 2) for n in volume.shape)
    volume = Volume((volume.values[middle] > 0).astype(np.uint8), volume.spacing, volume.unit)
    pieces, loops, _ = betti_numbers(volume.values > 0)
    found: Values = {"mask loops": loops, "mask pieces": pieces}
    for program, trace_by in (("curvafit", ours), ("skan", theirs)):
        found |= {f"{program} {key}": value for key, value in trace_by(volume).items()}
    return found


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--phantoms", default=",".join(PHANTOMS))


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    names, places = options.phantoms.split(","), 1 if options.quick else PLACES
    keys = list(product(names, RADII[: 1 if options.quick else None], range(places)))
    found = cases.all({f"{name}-{r:g}-{k}": partial(phantom, name, r, k) for name, r, k in keys})
    figures = dict[str, Figure]()
    for name, program in product(names, ("curvafit", "skan")):
        rows = [row for case, row in found.items() if case.startswith(name)]
        for key in ("length", "loops", "radius"):
            values = [row[f"{program} {key}"] for row in rows]
            figures[f"centreline.{name}_{program}.{key}"] = Figure(float(max(values, key=abs)))
    if not options.quick:
        for name, row in cases.all({name: partial(real, name) for name in REAL}).items():
            for key, value in row.items():
                program, _, number = key.partition(" ")
                figures[f"vessels.{name}_{program}.{number}"] = Figure(float(value))
    show(["", ""], list(figures.items()), "greatest errors: length in %, loops, radius in voxels")
    return {} if options.quick else figures
