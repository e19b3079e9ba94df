"""Reports of real scans: what `infer` says of each.

Needs $CURVAFIT_DATA. Of each scan the structure's share, thickness and spacing in working voxels; p and its two parts
(`misfit`); the means of the chosen law's twins over the scan; the verdict.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from benchmarks.harness import Cases, Figure, Values, data, show
from curvafit.inference.candidates import Growth
from curvafit.inference.inference import infer
from curvafit.volumes.read import load
from curvafit.volumes.volume import ScanError, Volume

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
_POON = {"spacing": (5.0, 0.994, 0.994), "unit": "um"}
#: The first ten were in view while the test was made; the last three were looked at once, when its rule stood.
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
    "axons": Scan("trailmap_axons_img.tif", "axons"),
    "leaking": Scan("vesselNN/poon2015_BBB_Leakage_label.tif", "capillaries", _POON, kind="mask"),
    "autophagosome": Scan("autophagosome_labels.tif", "membranes", kind="mask"),
}


def read(name: str) -> Volume:
    return load(data("scans", SCANS[name].file), **SCANS[name].reading)


def report(name: str) -> Values:
    """Return what a whole `infer` says of a scan."""
    try:
        fit = infer(read(name), kind=SCANS[name].kind, growth=Growth()).fit  # type: ignore[arg-type]
    except ScanError as error:
        return {"verdict": f"refused: {error}"}
    own, voxel, twins = fit.morphometry, fit.working_voxel, () if fit.best is None else fit.best.twins
    values: Values = {"verdict": fit.status.partition(":")[0]}
    if own is not None:
        values |= {"share": own.volume_fraction, "thickness": own.thickness_mean / voxel}
        values |= {"spacing": own.spacing_mean / voxel}
        for key in RATIOS if twins else ():
            values[key] = float(np.mean([getattr(each, key) for each in twins]) / getattr(own, key))
    if fit.misfit is not None:
        discriminant = fit.misfit.discriminant
        values |= {"p": fit.misfit.probability, "unexplained": fit.misfit.unexplained}
        values["discriminant"] = np.nan if discriminant is None else discriminant
    return values


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    names = ["capillaries"] if options.quick else [*SCANS]
    found = cases.all({name: lambda name=name: report(name) for name in names})
    columns = ("share", "thickness", "spacing", "p", "unexplained", "discriminant", *RATIOS, "verdict")
    show(["scan", *columns], [[name, *(row.get(key, "") for key in columns)] for name, row in found.items()])
    figures = {f"scans.{name}.{key}": Figure(row[key]) for name, row in found.items()
               for key in columns[:-1] if key in row}  # fmt: skip
    if len(found) == len(SCANS):
        supported = sum(row["verdict"].startswith("Supported") for row in found.values())
        figures["scans.supported"] = Figure(float(supported))
    return figures
