"""Reports of real scans: the verdict on each, and how far the laws of a scan's halves lie apart.

Needs $CURVAFIT_DATA. Of each scan by `infer`: the structure's share, thickness and spacing in working voxels; p of
`misfit`; the means of the chosen law's twins over the scan; the verdict. Of the halves along the longest axis, by the
posterior alone (`--halves`), in working units and deviations of the prior: the distance between the means of their
posteriors (root mean square over the six parameters), and the distance to the nearest half of another tissue. Means
move less than posteriors are wide, so a small distance alone says nothing: compare the two.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness import Cases, Figure, Values, show
from curvafit.inference.infer import infer
from curvafit.inference.posterior import load_posterior
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.read import load

#: Numbers of a scan's twins over those of the scan.
RATIOS = ("volume_fraction", "thickness_mean", "spacing_mean", "connectivity_density", "surface_to_volume")


class Scan(NamedTuple):
    """A file of CURVAFIT_DATA/scans, what it shows, and how it is read and inferred."""

    file: str
    tissue: str
    reading: Mapping[str, Any] = {}
    kind: str = "auto"


#: The voxels of UroCell, whose headers state others.
_NANOMETRES = {"spacing": 16.0, "unit": "nm"}
SCANS = {
    "bone": Scan("lhdl_trabecular_200.tif", "bone"),
    "mitochondria-1": Scan("urocell_mito_fib1-0-0-0.nii.gz", "mitochondria", _NANOMETRES, kind="mask"),
    "mitochondria-2": Scan("urocell_mito_fib1-3-2-1.nii.gz", "mitochondria", _NANOMETRES, kind="mask"),
    "felt": Scan("fiberform_100.tif", "felt"),
    "polymer": Scan("quanfima_polymer3d_8bit_128x128x128.raw", "polymer", {"raw_shape": (128, 128, 128)}),
    "membranes": Scan("plantseg_sample_ovule.h5", "membranes", {"key": "raw"}),
    "capillaries": Scan("vesselexpress_000_mask.tif", "capillaries", kind="mask"),
    "minivess": Scan("minivess_mv68_mask.nii.gz", "capillaries", kind="mask"),
    "sandstone": Scan("openpnm_berea_100_to_300.npz", "sandstone"),
    "vessel-tree": Scan("poreture_h61_vessel_tree.nii.gz", "vessel tree", kind="mask"),
}


def field_of(name: str) -> Field:
    return load(Path(os.environ["CURVAFIT_DATA"]) / "scans" / SCANS[name].file, **SCANS[name].reading)


def report(name: str) -> Values:
    """Return what a whole `infer` says of a scan."""
    try:
        fit = infer(field_of(name), kind=SCANS[name].kind).fit  # type: ignore[arg-type]
    except ScanError as error:
        return {"verdict": f"refused: {error}"}
    own, voxel, twins = fit.morphometry, fit.working_voxel, () if fit.best is None else fit.best.twins
    values: Values = {"verdict": fit.status.partition(":")[0]}
    if own is not None:
        values |= {"share": own.volume_fraction, "thickness": own.thickness_mean / voxel}
        values |= {"spacing": own.spacing_mean / voxel}
        for key in RATIOS if twins else ():
            values[key] = float(np.mean([getattr(each, key) for each in twins]) / getattr(own, key))
    return values | ({} if fit.misfit is None else {"p": fit.misfit.probability})


def halves(name: str) -> Values:
    """Return the means of the posteriors of a scan's two halves, in deviations of the prior."""
    field, scale = field_of(name), np.ptp(load_posterior().box, axis=1) / np.sqrt(12)
    axis = int(np.argmax([n * h for n, h in zip(field.shape, field.spacing, strict=True)]))
    middle, found = field.shape[axis] // 2, {}
    for k, part in enumerate((slice(None, middle), slice(middle, None))):
        box = tuple(part if axis == n else slice(None) for n in range(3))
        fit = infer(field.crop(box), kind=SCANS[name].kind, fast=True).fit  # type: ignore[arg-type]
        if fit.draws is not None:
            found[str(k)] = (fit.draws / scale).mean(0).tolist()
    return found


def distance(one: list[float], other: list[float]) -> float:
    return float(np.sqrt(np.square(np.subtract(one, other)).mean()))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", default=",".join(SCANS))
    parser.add_argument("--halves", action="store_true", help="the halves in place of whole reports")


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    if "CURVAFIT_DATA" not in os.environ:
        raise SystemExit("set CURVAFIT_DATA to the folder that holds scans/")
    names = ["capillaries"] if options.quick else options.only.split(",")
    if options.halves or options.quick:
        found = cases.all({f"halves-{name}": lambda name=name: halves(name) for name in names})
        return compare_halves({name.removeprefix("halves-"): means for name, means in found.items()})
    found = cases.all({name: lambda name=name: report(name) for name in names})
    columns = ("share", "thickness", "spacing", "p", *RATIOS, "verdict")
    show(["scan", *columns], [[name, *(row.get(key, "") for key in columns)] for name, row in found.items()])
    figures = {f"scans.{name}.{key}": Figure(row[key]) for name, row in found.items()
               for key in columns[:-1] if key in row}  # fmt: skip
    if len(found) == len(SCANS):
        supported = sum(row["verdict"] == "Supported" for row in found.values())
        figures["scans.supported"] = Figure(float(supported))
    return figures


def compare_halves(means: Mapping[str, Values]) -> dict[str, Figure]:
    rows, figures = [], {}
    for name, mine in means.items():
        if len(mine) < 2:
            continue
        own = distance(mine["0"], mine["1"])
        others = {
            other: min(distance(a, b) for a in mine.values() for b in each.values())
            for other, each in means.items()
            if SCANS[other].tissue != SCANS[name].tissue and each
        }
        nearest = min(others, key=others.__getitem__, default="")
        rows.append([name, own, others.get(nearest, ""), nearest])
        figures[f"halves.{name}.apart"] = Figure(own)
        if nearest:
            figures[f"halves.{name}.other"] = Figure(others[nearest])
    show(["halves of", "apart", "nearest half of another tissue", ""], rows)
    return figures
