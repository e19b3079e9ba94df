"""The result of a flow, what callbacks see while it runs, and the tests of whether a field is a shape."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from curvafit.core.runtime import Pictured
from curvafit.core.schema import Rule
from curvafit.core.units import format_sampling
from curvafit.generation.schedule import Schedule
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energies import cahn_hilliard_parts
from curvafit.priors.grid import Float, Grid

#: Steps between two entries of the history (and two calls of the callbacks).
RECORD_EVERY = 10
#: Greatest discrepancy ratio, and least extent of either phase, of a viable shape (paper, Experiment 4).
DISCREPANCY_LIMIT = 0.75
PHASE_LIMIT = 0.1
#: `is_well_formed` also requires that |u| reaches a value in this interval in both phases. The published tests accept
#: plateaus near 0, whose level set is not an interface, and fragments of a few voxels with |u| up to 7.
FORMED = (0.5, 2.0)


@dataclass(frozen=True)
class Viability:
    """The discrepancy ratio, max u and min u of a field, whether they are those of a shape, and the reason if not."""

    discrepancy: Annotated[float, Rule(unknown=True)]
    highest: Annotated[float, Rule(unknown=True)]
    lowest: Annotated[float, Rule(unknown=True)]
    viable: bool
    reason: str


@dataclass(frozen=True, eq=False)
class History:
    """Figures of a flow at every `RECORD_EVERY`th step and at the end, in arrays `(N,)`.

    They are the number of steps, F_ε, maximum and mean of |∂F_ε/∂A| over free voxels (∂F_ε/∂v in L² flows), and the
    mean of u.
    """

    step: np.ndarray
    energy: np.ndarray
    gradient_max: np.ndarray
    gradient_mean: np.ndarray
    mass: np.ndarray


@dataclass(frozen=True, eq=False)
class State:
    """The argument of a callback: the figures of the history's newest entry, and the field, `(Z, Y, X)`."""

    field: Tensor
    energy: float
    gradient_max: float
    gradient_mean: float
    mass: float


#: A function that a flow calls every `RECORD_EVERY` steps and at the end, with the number of steps so far, the total
#: and the state; True stops the flow.
Callback = Callable[[int, int, State], bool | None]


@dataclass(frozen=True, repr=False, eq=False)
class Flow(Pictured):
    """The result of a flow: the field u, float32 `(Z, Y, X)`, its mean (`mass`), and whether the field is a shape.

    The `status` is a sentence that says how the flow ended. Coefficients are numbers, or tensors that vary in
    space; they and ε are in the unit of the grid's spacing. The seed is None where the flow started from a field.
    """

    field: Tensor
    history: History
    status: str
    grid: Grid
    viability: Viability
    schedule: Schedule
    seed: int | None
    mass: float
    coefficients: Coefficients
    epsilon: float

    def __repr__(self) -> str:
        """Return one line with voxels, energy, viability and status."""
        size = format_sampling(self.grid.shape, self.grid.spacing)
        viable = "viable" if self.viability.viable else "not viable"
        return f"Flow({size}, energy {self.history.energy[-1]:.4g}, {viable}: {self.status})"

    @property
    def finite(self) -> bool:
        """Whether energy, gradient and field stayed finite; where they did not, the field is not a shape."""
        rows = [self.history.energy, self.history.gradient_max, self.history.gradient_mean, self.history.mass]
        extent = [self.viability.highest, self.viability.lowest]
        return bool(np.isfinite(np.concatenate([*rows, extent])).all())


def is_well_formed(end: Viability) -> bool:
    """Return whether a shape is viable and |u| reaches a value within `FORMED` in both phases."""
    return end.viable and all(FORMED[0] < extent < FORMED[1] for extent in (end.highest, -end.lowest))


def viability(u: Float[Tensor, "z y x"], grid: Grid, epsilon: float) -> Viability:
    """Test discrepancy ratio < 0.75, max u > 0.1 and min u < -0.1 (paper, Experiment 4)."""
    highest, lowest = float(u.max()), float(u.min())
    ratio = _discrepancy(u, grid, epsilon)
    reason = _reason(ratio, highest, lowest)
    return Viability(ratio, highest, lowest, not reason, reason)


def _discrepancy(u: Tensor, grid: Grid, epsilon: float) -> float:
    """Return ∫|ε/2 |∇u|² - W(u)/ε| / 𝓐_ε, from 0 (the optimal profile) to 1, a few planes at a time to save memory."""
    Z, Y, X = grid.shape
    difference = total = 0.0
    for planes in torch.arange(Z).tensor_split(max(1, Z // 16)):  # some 16 planes at a time
        padded = torch.arange(int(planes[0]) - 1, int(planes[-1]) + 2)  # with the neighbours that differences need
        padded = padded % Z if grid.periodic else padded.clamp(0, Z - 1)
        slab = Grid((len(padded), Y, X), grid.spacing, grid.boundary)
        densities = cahn_hilliard_parts(u[padded], slab, epsilon)
        slope, well = (density[1:-1].double() for density in densities)
        difference += float((slope - well).abs().sum())
        total += float((slope + well).sum())
    return difference / total if total else math.nan


def _reason(ratio: float, highest: float, lowest: float) -> str:
    """Return the reason why a field is not a shape; empty where it is one."""
    if not (math.isfinite(highest) and math.isfinite(lowest)):
        return "the field is not finite"
    if not highest > PHASE_LIMIT:
        return f"no inside: the field's maximum is {highest:.3g}, not above {PHASE_LIMIT}"
    if not lowest < -PHASE_LIMIT:
        return f"no outside: the field's minimum is {lowest:.3g}, not below {-PHASE_LIMIT}"
    if not ratio < DISCREPANCY_LIMIT:
        return f"no interface profile: the discrepancy ratio is {ratio:.3f}, not below {DISCREPANCY_LIMIT}"
    return ""
