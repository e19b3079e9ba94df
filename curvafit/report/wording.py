"""Words of a report: the sentence that it opens with, and links to the glossary."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from curvafit.core.units import GLOSSARY, length, percent

if TYPE_CHECKING:
    from curvafit.geometry.diagram import Diagram
    from curvafit.inference.infer import Inference

#: tan 22.5°: how far in direction a point may lie from a family's ideal one.
_NARROW = math.tan(math.pi / 8)
_Radii = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
#: For each round family: which points (κ1, κ2) are its own, and the curvature that its radius is one over.
_ROUND: dict[str, _Radii] = {
    "spheres": lambda k1, k2: (k2 > _NARROW * k1, (k1 + k2) / 2),
    "tubes": lambda k1, k2: ((k1 > 0) & (np.abs(k2) < _NARROW * k1), k1),
    "tubular cavities": lambda k1, k2: ((k2 < 0) & (np.abs(k1) < -_NARROW * k2), -k2),
    "bubbles": lambda k1, k2: ((k1 < 0) & (-k1 > -_NARROW * k2), -(k1 + k2) / 2),
}
#: The sentence for each family.
_SIZES = {
    "layers": "{family}, {thickness} thick, {share} of the volume",
    "sponge": "{family}, struts {thickness} thick, {share} of the volume",
    "spheres": "{family}, radius {radius}, {share} of the volume",
    "tubes": "{family}, radius {radius}, {share} of the volume",
    "tubular cavities": "{family}, radius {radius}, in a phase that is {share} of the volume",
    "bubbles": "{family}, radius {radius}, in a phase that is {share} of the volume",
}


def describe(inference: Inference) -> str:
    """Return the sentence that a report opens with: family, size, share of the volume."""
    fit, numbers = inference.fit, inference.fit.morphometry
    radius = None if inference.diagram is None else family_radius(inference.diagram, fit.family)
    physical = numbers.thickness_mean / 2 if radius is None else radius * fit.length
    pattern = _SIZES.get(fit.family, "{family}, {thickness} thick, {share} of the volume")
    return pattern.format(
        family=fit.family.capitalize(),
        radius=length(physical, fit.length_unit),
        thickness=length(numbers.thickness_mean, fit.length_unit),
        share=percent(numbers.volume_fraction),
    )


def glossary_link(word: str, ending: str = "") -> str:
    """Return a word with a special meaning, in the plural perhaps, as a link to its place in the glossary."""
    return f'<a href="{GLOSSARY}#{word.replace(" ", "-")}">{word}{ending}</a>'


def family_radius(diagram: Diagram, family: str) -> float | None:
    """Return the median radius over the area that a round family holds, in the diagram's unit; None for the others."""
    if family not in _ROUND:
        return None
    own, kappa = _ROUND[family](*np.asarray(diagram.points).T)
    own = own & (kappa > 0)
    if not own.any():
        return None
    order = np.argsort(kappa[own])
    cumulated = np.cumsum(np.asarray(diagram.weights)[own][order])
    middle = min(int(np.searchsorted(cumulated, cumulated[-1] / 2)), len(order) - 1)
    return float(1 / kappa[own][order][middle])
