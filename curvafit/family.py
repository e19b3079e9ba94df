"""Families named by where a curvature diagram's mass lies: layers, spheres, tubes, sponges."""

from __future__ import annotations

import numpy as np

from curvafit.diagram import Diagram

#: Angles of the ideal points in the (κ1, κ2) plane: sphere (1, 1), tube (1, 0), sponge (1, -1); cavities mirror them.
_ANGLES = {"spheres": 45.0, "tubes": 0.0, "sponge": -45.0, "tubular cavities": -90.0, "bubbles": -135.0}
#: A point belongs to a flat piece where its curvedness is under this share of the diagram's root mean square ...
_FLAT = 0.35
#: ... and the shape is made of layers where such pieces carry at least this share of the area.
_LAYERS = 0.5


def family_shares(diagram: Diagram) -> dict[str, float]:
    """The share of the area nearest in direction to each family's ideal point, and the flat share (`layers`).

    Directions after Koenderink's shape index; flatness is relative to the diagram's own root-mean-square curvedness.
    """
    kappa1, kappa2 = diagram.points.T
    weights = diagram.weights / diagram.weights.sum()
    curvedness = np.hypot(kappa1, kappa2)
    flat = curvedness < _FLAT * np.sqrt((weights * curvedness**2).sum())
    angle = np.degrees(np.arctan2(kappa2, kappa1))
    angle = np.where(angle > 45 + 1e-9, angle - 360, angle)
    names = list(_ANGLES)
    nearest = np.abs(angle[:, None] - np.array(list(_ANGLES.values()))).argmin(1)
    shares = {name: float(weights[(nearest == k) & ~flat].sum()) for k, name in enumerate(names)}
    return {"layers": float(weights[flat].sum())} | shares


def family_of(diagram: Diagram) -> str:
    """The family's name: the largest share, or layers where at least half the area is flat."""
    shares = family_shares(diagram)
    if shares["layers"] >= _LAYERS:
        return "layers"
    return max((name for name in shares if name != "layers"), key=lambda name: shares[name])
