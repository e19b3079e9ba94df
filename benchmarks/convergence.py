"""F_ε / σ against ∫p dA on the exact torus, monomial by monomial: orders in ε and in Δx, and a limit that fails.

The field is tanh(d / √2 ε) of the exact distance to a torus with radii 2 and 1, sampled on one octant of its box (the
rest is its mirror image) and differenced like any field. Three sweeps:

1. ε → 0 with Δx = ε²: the limit holds, order 2.
2. Δx → 0 at ε = 1/8, against F_ε of the continuous profile: the stencils' order.
3. ε → 0 at ε = 2 Δx: the normal-normal residue of order (Δx/ε)²/ε enters squared, and ∫κ2² does not converge.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import torch

from benchmarks.harness import Cases, Figure, Values, show
from curvafit.priors.curvature import Jet, jet
from curvafit.priors.energy import energy_terms
from curvafit.priors.grid import Grid
from curvafit.priors.profile import SIGMA
from tests.exact import MONOMIALS, Torus, centres, diffuse_integrals, profile

#: Tails beyond this many ε are left out: they hold 1e-6 of the profile's weight.
REACH = 6
TORUS = Torus(2.0, 1.0)
#: Most voxels held at once.
SLAB = 300_000


def grid_integrals(epsilon: float, spacing: float, torus: Torus = TORUS) -> np.ndarray:
    """The six terms of F_ε / σ `(6,)` of the sampled profile, over the whole torus."""
    tall = math.ceil((torus.minor + REACH * epsilon) / spacing)
    wide = math.ceil((torus.major + torus.minor + REACH * epsilon) / spacing)
    thick = max(2, SLAB // (wide + 2) ** 2)
    total = np.zeros(6)
    for start in range(0, tall, thick):
        layers = min(thick, tall - start)
        total += _slab(epsilon, spacing, torus, start, layers, wide)
    return 8 * total / SIGMA


def _slab(epsilon: float, h: float, torus: Torus, start: int, layers: int, wide: int) -> np.ndarray:
    """The octant's voxels start ≤ z < start + layers, with one more on every side to difference with."""
    grid = Grid((layers + 2, wide + 2, wide + 2), (h, h, h), "replicate")
    u = profile(torus, centres(grid, ((start - 1) * h, -h, -h)), epsilon)
    inside = (..., *(slice(1, -1),) * 3)
    whole = jet(u, grid)
    terms = energy_terms(Jet(*(part[inside] for part in whole)), epsilon)
    return (terms.sum((-3, -2, -1)) * h**3).numpy()


def order(steps: list[float], errors: np.ndarray) -> np.ndarray:
    """Slope of log |error| over log step, by least squares, a monomial each."""
    return np.polyfit(np.log(steps), np.log(np.abs(errors)), 1)[0]


def limit_sweep(widths: list[float]) -> tuple[list[tuple[float, float]], np.ndarray]:
    """Sweep 1: (ε, Δx = ε²) and errors against ∫p dA, `(len(widths), 6)`."""
    pairs = [(ε, ε**2) for ε in widths]
    return pairs, np.stack([grid_integrals(*pair) for pair in pairs]) - TORUS.integrals()


def spacing_sweep(epsilon: float, ratios: list[float]) -> tuple[list[tuple[float, float]], np.ndarray]:
    """Sweep 2: (ε, Δx = ε / ratio) and errors against F_ε / σ of the continuous profile."""
    pairs = [(epsilon, epsilon / ratio) for ratio in ratios]
    truth = diffuse_integrals(TORUS, epsilon, REACH * epsilon)
    return pairs, np.stack([grid_integrals(*pair) for pair in pairs]) - truth


def ratio_sweep(widths: list[float], ratio: float = 2.0) -> tuple[list[tuple[float, float]], np.ndarray]:
    """Sweep 3: (ε, Δx = ε / ratio) and errors against ∫p dA."""
    pairs = [(ε, ε / ratio) for ε in widths]
    return pairs, np.stack([grid_integrals(*pair) for pair in pairs]) - TORUS.integrals()


def sweep(kind: str, sizes: list[float]) -> Values:
    """Return the errors `(len(sizes), 6)` of a sweep, and the orders of the last two."""
    with torch.no_grad():
        before = torch.get_default_dtype()
        torch.set_default_dtype(torch.float64)
        try:
            pairs, errors = {
                "limit": lambda: limit_sweep(sizes),
                "spacing": lambda: spacing_sweep(1 / 8, sizes),
                "ratio": lambda: ratio_sweep(sizes),
            }[kind]()
        finally:
            torch.set_default_dtype(before)
    steps = [pair[kind == "spacing"] for pair in pairs]
    return {"pairs": pairs, "errors": errors.tolist(), "orders": order(steps[-2:], errors[-2:]).tolist()}


def options(parser: argparse.ArgumentParser) -> None:
    del parser


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    sizes = {"limit": [1 / 4, 1 / 6, 1 / 8, 1 / 10], "spacing": [2, 3, 4, 6], "ratio": [1 / 4, 1 / 8, 1 / 16, 1 / 32]}
    count = 2 if options.quick else 4
    jobs = {f"{kind}-{count}": lambda k=kind, s=each: sweep(k, s[:count]) for kind, each in sizes.items()}
    found = dict(zip(sizes, cases.all(jobs).values(), strict=True))
    for kind, values in found.items():
        rows = [[f"{ε:.4f}", f"{h:.4f}", *row] for (ε, h), row in zip(values["pairs"], values["errors"], strict=True)]
        show(["ε", "Δx", *MONOMIALS], [*rows, ["order", "", *values["orders"]]], f"error of F_ε / σ: {kind}")
    orders = found["limit"]["orders"]
    return {"convergence.least": Figure(min(orders)), "convergence.most": Figure(max(orders))}
