"""Parameters recovered from the author's volumes, against those that made them: from fields, and from their masks.

    CURVAFIT_DATA=… python -m benchmarks.refine [--fields sponge,tubes,bilayers] [--masks tubes,sponge,exp-0366]

1. Fields, by stationarity: the whole periodic box, a crop of 64³, and the whole box rounded to 1/100 for comparison.
2. Masks {u > 0}, a crop of 64³, by the fixed point of a short flow from the nearest shapes of the packaged atlas. The
   residual (voxels) is given at the truth, at each start, and at the end.

`±` is the deviation that the method states.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.gallery import author_volume
from curvafit.geometry.diagram import diagram
from curvafit.inference.atlas import load_atlas
from curvafit.inference.fixed_point import ShortFlow, _parameters, fixed_point
from curvafit.inference.match import nearest
from curvafit.inference.refinement import Refinement
from curvafit.inference.stationarity import stationarity
from curvafit.priors.coefficients import NAMES, Coefficients, preset
from curvafit.priors.grid import WORKING_EPSILON, Grid
from curvafit.priors.profile import phase_field

CROP = 64
STARTS = 3


def cropped(u: torch.Tensor) -> tuple[torch.Tensor, Grid]:
    """The middle 64³ of a volume."""
    inner = tuple(slice((n - CROP) // 2, (n + CROP) // 2) for n in u.shape)
    return u[inner].contiguous(), Grid((CROP,) * 3, boundary="replicate")


def row(label: str, coefficients: Coefficients, mass: float, extra: str = "") -> None:
    values = " ".join(f"{float(value):9.2f}" for value in list(coefficients)[1:])
    print(f"  {label:26} {values} {mass:8.3f}  {extra}", flush=True)


def found_rows(label: str, found: Refinement, seconds: float, unit: str) -> None:
    row(label, found.coefficients, found.mass, f"{found.residual:.2e} {unit}, {seconds:.0f} s")
    print(f"  {'±':26} " + " ".join(f"{found.uncertainty[name]:9.2f}" for name in NAMES[1:]), flush=True)


def field_table(folder: Path, name: str) -> None:
    u = author_volume(folder, name)
    truth = preset(name).coefficients
    print(
        f"{name}: stationarity of the field (a20 = 1; a11 a02 a10 a01 a00, mass; field error that explains the misfit)"
    )
    row("truth", truth.scaled(1 / truth.a20), preset(name).mass)
    cases = {
        "whole box": (u, Grid(tuple(u.shape))),
        f"crop of {CROP}³": cropped(u),
        "rounded to 1/100": (torch.floor(100 * u) / 100, Grid(tuple(u.shape))),
    }
    for label, (values, grid) in cases.items():
        begin = time.perf_counter()
        found = stationarity(values, grid, WORKING_EPSILON)
        found_rows(label, found, time.perf_counter() - begin, "rms")
        if label == "whole box":
            print("  singular values            " + " ".join(f"{value:.3g}" for value in found.singular_values))


def mask_table(folder: Path, name: str) -> None:
    u, grid = cropped(author_volume(folder, name))
    phase = phase_field(u > 0, grid, WORKING_EPSILON)
    truth = preset(name).coefficients.scaled(1 / preset(name).coefficients.a20)
    matches = nearest(diagram(phase, grid, WORKING_EPSILON), load_atlas(), seen_as="mask", count=STARTS)
    starts = [match.coefficients for match in matches]
    flow = ShortFlow(phase, grid, WORKING_EPSILON, starts[0])
    print(f"{name}: fixed point of a short flow from the mask (a20 = 1; a11 a02 a10 a01 a00, mass; residual)")
    row("truth", truth, preset(name).mass, _residual(flow, truth))
    for k, match in enumerate(matches):
        row(f"match {k + 1}", match.coefficients, match.mass, _residual(flow, match.coefficients))
    begin = time.perf_counter()
    found = fixed_point(phase, grid, WORKING_EPSILON, starts=starts)
    found_rows("fit", found, time.perf_counter() - begin, f"voxels, {found.evaluations} flows")
    print("  ends from the starts       " + " ".join(f"{residual:.2f}" for _, residual in found.starts))
    print("  singular values            " + " ".join(f"{value:.3g}" for value in found.singular_values))


def _residual(flow: ShortFlow, coefficients: Coefficients) -> str:
    return f"{np.linalg.norm(flow.residual(_parameters(coefficients))):.2f} voxels"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fields", default="sponge,tubes,bilayers")
    parser.add_argument("--masks", default="tubes,sponge,exp-0366")
    options = parser.parse_args()
    folder = Path(os.environ.get("CURVAFIT_DATA", "")) / "gallery"
    if not folder.is_dir():
        parser.error(f"expected $CURVAFIT_DATA to hold a folder gallery/, found none at {folder}")
    for name in filter(None, options.fields.split(",")):
        field_table(folder, name)
    for name in filter(None, options.masks.split(",")):
        mask_table(folder, name)


if __name__ == "__main__":
    main()
