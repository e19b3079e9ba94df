"""F_ε / σ against ∫p dA on the exact torus, monomial by monomial: orders in ε and in Δx, and a limit that fails.

The field is tanh(d / √2 ε) of the exact distance to a torus with radii 2 and 1, sampled and differenced like any field.

1. `limit`: ε → 0 with Δx = ε²: the limit holds, order 2.
2. `spacing`: Δx → 0 at ε = 1/8, against F_ε of the continuous profile: the stencils' order.
3. `ratio`: ε → 0 at ε = 2 Δx: the normal-normal residue of order (Δx/ε)²/ε enters squared, and ∫κ2² does not converge.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.harness import Cases, Figure, Values, show
from tests.exact import MONOMIALS, Torus, diffuse_integrals, grid_integrals

TORUS = Torus(2.0, 1.0)
#: Pairs (ε, Δx) of each sweep.
SWEEPS = {
    "limit": [(ε, ε**2) for ε in (1 / 4, 1 / 6, 1 / 8, 1 / 10)],
    "spacing": [(1 / 8, 1 / 8 / ratio) for ratio in (2, 3, 4, 6)],
    "ratio": [(ε, ε / 2) for ε in (1 / 4, 1 / 8, 1 / 16, 1 / 32)],
}


def sweep(kind: str, count: int) -> Values:
    """Return the errors `(count, 6)` of the first pairs of a sweep, and the orders of the last two."""
    pairs = SWEEPS[kind][:count]
    truth = diffuse_integrals(TORUS, 1 / 8, 6 / 8) if kind == "spacing" else TORUS.integrals()
    errors = np.stack([grid_integrals(TORUS, *pair) for pair in pairs]) - truth
    steps = [pair[kind == "spacing"] for pair in pairs]
    orders = np.polyfit(np.log(steps[-2:]), np.log(np.abs(errors[-2:])), 1)[0]
    return {"pairs": pairs, "errors": errors.tolist(), "orders": orders.tolist()}


def run(options: argparse.Namespace, cases: Cases) -> dict[str, Figure]:
    count = 2 if options.quick else 4
    found = cases.all({f"{kind}-{count}": lambda kind=kind: sweep(kind, count) for kind in SWEEPS})
    for name, values in found.items():
        rows = [[f"{ε:.4f}", f"{h:.4f}", *row] for (ε, h), row in zip(values["pairs"], values["errors"], strict=True)]
        show(["ε", "Δx", *MONOMIALS], [*rows, ["order", "", *values["orders"]]], f"error of F_ε / σ: {name}")
    orders = found[f"limit-{count}"]["orders"]
    return {"convergence.least": Figure(min(orders)), "convergence.most": Figure(max(orders))}
