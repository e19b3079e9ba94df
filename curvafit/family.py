"""Families named by where a curvature diagram's mass lies: layers, spheres, tubes, sponges."""

from __future__ import annotations

import numpy as np

from curvafit.diagram import Diagram

#: Angles of the ideal points in the (κ1, κ2) plane: sphere (1, 1), tube (1, 0), sponge (1, -1); cavities mirror them.
_ANGLES = {"spheres": 45.0, "tubes": 0.0, "sponge": -45.0, "tubular cavities": -90.0, "bubbles": -135.0}
#: A point is flat where its radii of curvature exceed the structure's half-thickness this many times over.
_FLAT_RADII = 2.5
#: Share of flat area from which a shape is made of layers.
_LAYERS = 0.5
#: Half-thickness of each family's ideal, times its area over its volume: a plate's is 1, a cylinder's 2, a ball's 3.
_SLENDER = {"layers": 1, "spheres": 3, "tubes": 2, "sponge": 2, "tubular cavities": 2, "bubbles": 3}
#: All families, in the order in which they are listed.
FAMILIES = ("spheres", "layers", "tubes", "sponge", "tubular cavities", "bubbles")


def family_shares(diagram: Diagram, radius: float) -> dict[str, float]:
    """The share of area nearest in direction to each family's ideal point, and the flat share (`layers`).

    Directions after Koenderink's shape index; `radius` is the structure's half-thickness in the diagram's unit.
    """
    kappa1, kappa2 = diagram.points.T
    weights = diagram.weights / diagram.weights.sum()
    flat = np.hypot(kappa1, kappa2) * radius * _FLAT_RADII < 1
    angle = np.degrees(np.arctan2(kappa2, kappa1))
    angle = np.where(angle > 45 + 1e-9, angle - 360, angle)
    nearest = np.abs(angle[:, None] - np.array(list(_ANGLES.values()))).argmin(1)
    shares = {name: float(weights[(nearest == k) & ~flat].sum()) for k, name in enumerate(_ANGLES)}
    return {"layers": float(weights[flat].sum())} | shares


def family_of(diagram: Diagram, radius: float) -> str:
    """The family's name: the largest share, or layers where at least half the area is flat."""
    return leading_family(family_shares(diagram, radius))


def leading_family(shares: dict[str, float]) -> str:
    """The family that shares of area speak for: the largest, or layers where they hold at least half."""
    if shares["layers"] >= _LAYERS:
        return "layers"
    return max(_ANGLES, key=lambda name: shares[name])


def half_thickness(diagram: Diagram, volume: float) -> float:
    """Half-thickness of what a surface bounds, from its volume and its diagram alone, in the diagram's unit.

    Volume over area, times 1, 2 or 3 as the area is that of plates, cylinders or balls. Found from below: the more area
    counts as curved, the thicker the structure, and the more area counts as curved.
    """
    thin = volume / diagram.area
    radius = thin
    for _ in range(4):
        radius = thin * sum(_SLENDER[name] * share for name, share in family_shares(diagram, radius).items())
    return radius
