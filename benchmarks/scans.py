"""Reports of real scans in one table, and whether the halves of a scan tell the same law.

    CURVAFIT_DATA=… python -m benchmarks.scans [-o scans] [--only bone] [--fast]

Each scan of CURVAFIT_DATA/scans has a folder with its report; what is there is not computed again. A scan takes some
minutes on 2 cores, its halves seconds.

First table: the structure's share, thickness and spacing in working voxels; p of `misfit`; the means of the chosen
law's twins over the scan, for the share, thickness, spacing, connectivity density and surface; the verdict by today's
rules.
Second table: the halves along the scan's longest axis, by posterior alone (`fast`), in working units, in deviations of
the prior: the distance between their means (root mean square over the six parameters), its p-value if they were draws
of two posteriors of one law (χ² with 6 degrees), and the distance to the nearest half of another tissue.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from curvafit.inference.fit import Fit
from curvafit.inference.infer import Inference, infer
from curvafit.inference.posterior import load_posterior
from curvafit.inference.verdict import FAMILIAR, verdict
from curvafit.report.page import write_inference
from curvafit.volumes.scan import Field, ScanError, load

#: Familiar numbers whose ratios are shown.
SHOWN = ("volume_fraction", *FAMILIAR.values(), "surface_to_volume")


class Scan(NamedTuple):
    """A file of CURVAFIT_DATA/scans, what it shows, and how it is read and inferred."""

    file: str
    tissue: str
    reading: Mapping[str, Any] = {}
    kind: str = "auto"


#: The voxels of UroCell, whose headers state others.
NANOMETRES = {"spacing": 16.0, "unit": "nm"}
SCANS = {
    "bone": Scan("lhdl_trabecular_200.tif", "bone"),
    "mitochondria-1": Scan("urocell_mito_fib1-0-0-0.nii.gz", "mitochondria", NANOMETRES, kind="mask"),
    "mitochondria-2": Scan("urocell_mito_fib1-3-2-1.nii.gz", "mitochondria", NANOMETRES, kind="mask"),
    "felt": Scan("fiberform_100.tif", "felt"),
    "polymer": Scan("quanfima_polymer3d_8bit_128x128x128.raw", "polymer", {"raw_shape": (128, 128, 128)}),
    "membranes": Scan("plantseg_sample_ovule.h5", "membranes", {"key": "raw"}),
    "capillaries": Scan("vesselexpress_000_mask.tif", "capillaries", kind="mask"),
    "minivess": Scan("minivess_mv68_mask.nii.gz", "capillaries", kind="mask"),
    "sandstone": Scan("openpnm_berea_100_to_300.npz", "sandstone"),
    "vessel-tree": Scan("poreture_h61_vessel_tree.nii.gz", "vessel tree", kind="mask"),
}


def halves(field: Field) -> tuple[Field, Field]:
    """Return the two halves of a scan along its longest axis."""
    axis = int(np.argmax([n * h for n, h in zip(field.shape, field.spacing, strict=True)]))
    middle = field.shape[axis] // 2
    ranges = [(None, middle), (middle, None)]
    whole = [slice(None)] * 3
    first, second = (field.crop((*whole[:axis], slice(*each), *whole[axis + 1 :])) for each in ranges)
    return first, second


def fit_of(folder: Path, scan: Field, kind: str, fast: bool) -> Fit | str:
    """Return the fit of a scan, from its folder where it is there; why there is none, where it was refused."""
    path, refusal = folder / "fit.json", folder / "refused.txt"
    if refusal.exists():
        return refusal.read_text()
    if not path.exists():
        try:
            inference: Inference = infer(scan, kind=kind, fast=fast)  # type: ignore[arg-type]
        except ScanError as error:
            folder.mkdir(parents=True, exist_ok=True)
            refusal.write_text(str(error))
            return str(error)
        write_inference(inference, folder)
    return Fit.load(path)


def row(name: str, fit: Fit | str) -> str:
    """Return a line of the first table."""
    if isinstance(fit, str):
        return f"{name:15} refused: {fit}"
    own, best, voxel = fit.morphometry, fit.best, fit.working_voxel
    sizes = f"{own.volume_fraction:6.3f} {own.thickness_mean / voxel:6.1f} {own.spacing_mean / voxel:6.1f}"
    p = "     -" if fit.misfit is None else f"{fit.misfit.probability:6.3f}"
    twins = () if best is None else best.twins
    ratios = [np.mean([getattr(each, key) for each in twins]) / getattr(own, key) if twins else np.nan for key in SHOWN]
    status = verdict(fit.candidates, fit.misfit, own)[1] if fit.candidates else fit.status
    return f"{name:15}{sizes} {p} " + " ".join(f"{ratio:6.2f}" for ratio in ratios) + f"  {status.split(':')[0]}"


def agreement(fits: Mapping[tuple[str, int], Fit], scale: np.ndarray) -> None:
    """Print the second table."""
    draws = {key: fit.draws.parameters / scale for key, fit in fits.items() if fit.draws is not None}
    mean = {key: each.mean(0) for key, each in draws.items()}
    print(f"\n{'halves of':15}{'apart':>7}{'p':>8}   nearest half of another tissue")
    for name in dict.fromkeys(key[0] for key in draws):
        if (name, 0) not in draws or (name, 1) not in draws:
            continue
        away = mean[name, 0] - mean[name, 1]
        spread = np.cov(draws[name, 0].T) + np.cov(draws[name, 1].T)
        p = stats.chi2.sf(away @ np.linalg.solve(spread, away), len(away))
        others = {
            other: min(float(np.sqrt(np.square(mean[other] - mean[name, k]).mean())) for k in (0, 1))
            for other in draws
            if SCANS[other[0]].tissue != SCANS[name].tissue
        }
        nearest = min(others, key=others.__getitem__, default=None)
        other = "-" if nearest is None else f"{others[nearest]:.2f} ({nearest[0]})"
        print(f"{name:15}{np.sqrt(np.square(away).mean()):7.2f}{p:8.3f}   {other}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("scans"))
    parser.add_argument("--only", choices=SCANS)
    parser.add_argument("--fast", action="store_true", help="the halves alone")
    options = parser.parse_args()
    folder = Path(os.environ["CURVAFIT_DATA"]) / "scans"
    chosen = {name: scan for name, scan in SCANS.items() if options.only in (None, name)}
    fields = {name: load(folder / scan.file, **scan.reading) for name, scan in chosen.items()}
    if not options.fast:
        print(
            f"{'scan':15}{'share':>6} {'thick':>6} {'apart':>6} {'p':>6} {'share':>6} {'thick':>6} {'apart':>6}",
            end=" ",
        )
        print(f"{'conn':>6} {'area':>6}  verdict")
        for name, scan in chosen.items():
            print(row(name, fit_of(options.output / name, fields[name], scan.kind, False)), flush=True)
    parts = {
        (name, k): fit_of(options.output / f"{name}-half-{k}", half, chosen[name].kind, True)
        for name in chosen
        for k, half in enumerate(halves(fields[name]))
    }
    known = {key: fit for key, fit in parts.items() if isinstance(fit, Fit)}
    agreement(known, np.ptp(load_posterior().box, axis=1) / np.sqrt(12))


if __name__ == "__main__":
    main()
