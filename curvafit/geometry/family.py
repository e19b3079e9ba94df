"""Families named by where a curvature diagram's mass lies: layers, spheres, tubes, sponges."""

from __future__ import annotations

import numpy as np
from scipy.integrate import cumulative_trapezoid

from curvafit.geometry.diagram import Diagram

#: Angles of the ideal points in the (κ1, κ2) plane: sphere (1, 1), tube (1, 0), sponge (1, -1); cavities mirror them.
_ANGLES = {"spheres": 45.0, "tubes": 0.0, "sponge": -45.0, "tubular cavities": -90.0, "bubbles": -135.0}
#: A point is flat where its radii of curvature exceed the structure's half-thickness this many times over.
_FLAT_RADII = 2.5
#: Share of flat area from which a shape is made of layers.
_LAYERS = 0.5
#: All families, in the order in which they are listed.
FAMILIES = ("spheres", "layers", "tubes", "sponge", "tubular cavities", "bubbles")
#: Where the search for a half-thickness ends.
_DEEPEST = 6.0


def family_shares(diagram: Diagram, radius: float) -> dict[str, float]:
    """Return the share of area nearest in direction to each family's ideal point, and the flat share (`layers`).

    Directions after Koenderink's shape index; `radius` is the structure's half-thickness in the diagram's unit.
    """
    areas = np.bincount(families(diagram.points, radius), diagram.weights, minlength=len(FAMILIES))
    shares = dict(zip(FAMILIES, map(float, areas / areas.sum()), strict=True))
    return {"layers": shares.pop("layers")} | shares


def families(points: np.ndarray, radius: float) -> np.ndarray:
    """Return the family, as its number in `FAMILIES`, of each point (κ1, κ2), (N, 2); see `family_shares`."""
    kappa1, kappa2 = points.T
    flat = np.hypot(kappa1, kappa2) * radius * _FLAT_RADII < 1
    angle = np.degrees(np.arctan2(kappa2, kappa1))
    angle = np.where(angle > 45 + 1e-9, angle - 360, angle)
    nearest = np.abs(angle[:, None] - np.array(list(_ANGLES.values()))).argmin(1)
    numbers = np.array([FAMILIES.index(name) for name in _ANGLES])
    return np.where(flat, FAMILIES.index("layers"), numbers[nearest])


def family_of(diagram: Diagram, radius: float) -> str:
    """Return the family's name: the largest share, or layers where at least half the area is flat."""
    return leading_family(family_shares(diagram, radius))


def leading_family(shares: dict[str, float]) -> str:
    """Return the family that shares of area speak for: the largest, or layers where they hold at least half."""
    if shares["layers"] >= _LAYERS:
        return "layers"
    return max(_ANGLES, key=lambda name: shares[name])


def half_thickness(diagram: Diagram, volume: float) -> float:
    """Return the half-thickness of what a surface bounds, from its volume and its diagram alone, in the diagram's unit.

    The depth h at which the inner parallel surfaces have swept the volume: an element of area dA has
    (1 - κ1 t)(1 - κ2 t) dA at depth t, nothing beyond its centres of curvature (Steiner's formula). Exact for plates,
    cylinders and balls; at most `_DEEPEST` times volume / area, where a ball's is 3.
    """
    depths = np.linspace(0, _DEEPEST * volume / diagram.area, 601)
    left = np.clip(1 - diagram.points[:, :, None] * depths, 0, None).prod(axis=1)
    swept = cumulative_trapezoid(diagram.weights @ left, depths, initial=0)
    return float(depths[np.searchsorted(swept, min(volume, swept[-1]) * (1 - 1e-9))])
