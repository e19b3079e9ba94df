"""How results are said: lengths with a fitting unit, numbers with a fitting number of digits, the first sentence."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from curvafit.priors.grid import METRES

if TYPE_CHECKING:
    from curvafit.geometry.diagram import Diagram
    from curvafit.inference.infer import Inference

#: tan 22.5°: how far in direction a point may lie from a family's ideal one.
_NARROW = math.tan(math.pi / 8)
#: A space that no line breaks at.
_GLUE = "\u00a0"

_Radii = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
#: For each round family: which points (κ1, κ2) are its own, and the curvature that its radius is one over.
_ROUND: dict[str, _Radii] = {
    "spheres": lambda k1, k2: (k2 > _NARROW * k1, (k1 + k2) / 2),
    "tubes": lambda k1, k2: ((k1 > 0) & (np.abs(k2) < _NARROW * k1), k1),
    "tubular cavities": lambda k1, k2: ((k2 < 0) & (np.abs(k1) < -_NARROW * k2), -k2),
    "bubbles": lambda k1, k2: ((k1 < 0) & (-k1 > -_NARROW * k2), -(k1 + k2) / 2),
}
#: How each family's size is said.
_SIZES = {
    "layers": "{family}, {thickness} thick, {share} of the volume",
    "sponge": "{family}, struts {thickness} thick, {share} of the volume",
    "spheres": "{family}, radius {radius}, {share} of the volume",
    "tubes": "{family}, radius {radius}, {share} of the volume",
    "tubular cavities": "{family}, radius {radius}, in a phase that is {share} of the volume",
    "bubbles": "{family}, radius {radius}, in a phase that is {share} of the volume",
}


def describe(inference: Inference) -> str:
    """The sentence that a report opens with: family, size, share of the volume."""
    fit, numbers = inference.fit, inference.fit.morphometry
    radius = family_radius(inference.diagram, fit.family)
    said = numbers.thickness_mean / 2 if radius is None else radius * fit.length
    pattern = _SIZES.get(fit.family, "{family}, {thickness} thick, {share} of the volume")
    return pattern.format(
        family=fit.family.capitalize(),
        radius=length(said, fit.length_unit),
        thickness=length(numbers.thickness_mean, fit.length_unit),
        share=percent(numbers.volume_fraction),
    )


def family_radius(diagram: Diagram, family: str) -> float | None:
    """Median radius over the area that a round family holds, in the diagram's unit; None for the others."""
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


def number(value: float | None, digits: int = 3) -> str:
    """A number to so many significant digits, without an exponent where it reads well; a dash for none."""
    if value is None or math.isnan(value):
        return "–"
    if value == 0 or math.isinf(value):
        return f"{value:g}"
    rounded = f"{value:.{digits - 1}e}"
    power = int(rounded.partition("e")[2])
    if -4 <= power <= 6:
        rounded = f"{float(rounded):,.{max(0, digits - 1 - power)}f}".replace(",", "\u202f")
    return rounded.replace("-", "−")


def percent(share: float) -> str:
    return f"{number(100 * share, 2)}{_GLUE}%"


def length(value: float, unit: str, digits: int = 2) -> str:
    """A length in the unit in which it is 1 to 1000."""
    if unit not in METRES or not math.isfinite(value) or value <= 0:
        return f"{number(value, digits)}{_GLUE}{unit_name(unit, value)}"
    metres = value * METRES[unit]
    fitting = [name for name, size in METRES.items() if metres / size >= 0.9995]
    best = fitting[-1] if fitting else "nm"
    return f"{number(metres / METRES[best], digits)}{_GLUE}{unit_name(best)}"


def density(value: float, unit: str, power: int, digits: int = 3) -> str:
    """A number per unit of length to a power; another unit where it would be tiny or huge."""
    names = [unit, *(name for name in ("mm", "um", "nm", "m") if unit in METRES and name != unit)]
    scaled = {name: value * (METRES[name] / METRES[unit]) ** power if name != unit else value for name in names}
    best = next((name for name in names if 0.1 <= abs(scaled[name]) < 1e4), unit)
    return f"{number(scaled[best], digits)}{_GLUE}{per_unit(best, power)[1:]}"


def per_unit(unit: str, power: int) -> str:
    """1/µm, 1/µm², 1/µm³."""
    return f"1/{unit_name(unit)}{ {1: '', 2: '²', 3: '³'}[power] }"


def unit_name(unit: str, count: float = 1) -> str:
    """How a unit is written: µm for `um`, voxels for several."""
    if unit == "um":
        return "µm"
    return "voxels" if unit == "voxel" and count != 1 else unit
