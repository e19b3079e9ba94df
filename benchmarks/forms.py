"""𝓔_ε, 𝓔̃_ε and F_ε on generated fields: how far apart the forms are that agree on optimal profiles.

    python -m benchmarks.forms [--edge 64] [--presets tubes,sponge,bilayers,trabec]

Gaps are to F_ε, over the energy's absolute density summed.
"""

from __future__ import annotations

import argparse

from curvafit.generation.flow import generate
from curvafit.priors.coefficients import preset
from curvafit.priors.curvature import jet
from curvafit.priors.energy import curvature_density, discrepancy_ratio, energy_terms, unsimplified_density
from curvafit.priors.grid import WORKING_EPSILON, Grid


def gaps(name: str, edge: int) -> tuple[float, float, float, float]:
    """F_ε, the gaps of 𝓔_ε and of 𝓔̃_ε to it, and the discrepancy ratio."""
    shape, grid = preset(name), Grid((edge, edge, edge))
    u = generate(shape.coefficients, shape.mass, grid).field.double()
    field = jet(u, grid)
    simplified = (energy_terms(field, WORKING_EPSILON) * shape.coefficients.tensor()[:, None, None, None]).sum(0)
    size = simplified.abs().sum()
    first, second = (
        float((density(field, shape.coefficients, WORKING_EPSILON) - simplified).sum() / size)
        for density in (curvature_density, unsimplified_density)
    )
    energy = float(simplified.sum() * grid.voxel_volume)
    return energy, first, second, float(discrepancy_ratio(u, grid, WORKING_EPSILON))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=int, default=64)
    parser.add_argument("--presets", default="tubes,sponge,bilayers,trabec")
    options = parser.parse_args()
    print(f"{'preset':10} {'F_ε':>9} {'(𝓔 - F)/|F|':>13} {'(𝓔~ - F)/|F|':>13} {'discrepancy':>12}")
    for name in options.presets.split(","):
        energy, first, second, ratio = gaps(name, options.edge)
        print(f"{name:10} {energy:9.2f} {first:13.4f} {second:13.4f} {ratio:12.3f}", flush=True)


if __name__ == "__main__":
    main()
