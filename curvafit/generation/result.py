"""The result of a flow, and the state that callbacks see while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from torch import Tensor

from curvafit.core.pictures import Pictured
from curvafit.core.units import format_sampling
from curvafit.generation.schedule import Schedule
from curvafit.generation.viability import Viability
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid

#: Steps between two entries of the history (and two calls of the callbacks).
RECORD_EVERY = 10


@dataclass(frozen=True, eq=False)
class History:
    """Figures every `RECORD_EVERY` steps and at the end, in arrays `(N,)`: the number of steps, F_ε, maximum and mean
    of |∂F_ε/∂A| over free voxels, and the mean of u. (In L² flows the gradient is with respect to v.)"""

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


class Callback(Protocol):
    """A function that a flow calls every `RECORD_EVERY` steps and at the end."""

    def __call__(self, step: int, total: int, state: State, /) -> bool | None:
        """Receive the number of steps so far, the total and the state; return True to stop the flow."""
        ...


@dataclass(frozen=True, repr=False, eq=False)
class Flow(Pictured):
    """The result of a flow: the field, the history, and whether the field is a shape.

    Attributes
    ----------
    field
        u, float32 `(Z, Y, X)`.
    history
        Figures at regular steps.
    status
        A sentence that says how the flow ended.
    coefficients, epsilon
        Parameters of the energy: numbers, or tensors that vary in space, in the unit of the grid's spacing.
    seed
        Seed of the start; None where the flow started from a field.
    mass
        The mean of the field.
    snapshots
        Fields by the number of steps after which they were taken.
    """

    field: Tensor
    history: History
    status: str
    grid: Grid
    viability: Viability
    schedule: Schedule
    seed: int | None
    mass: float
    snapshots: Mapping[int, Tensor]
    coefficients: Coefficients
    epsilon: float | Tensor

    def __repr__(self) -> str:
        """Return one line with voxels, energy, viability and status."""
        size, viable = (
            format_sampling(self.grid.shape, self.grid.spacing),
            "viable" if self.viability.viable else "not viable",
        )
        return f"Flow({size}, energy {self.history.energy[-1]:.4g}, {viable}: {self.status})"

    @property
    def finite(self) -> bool:
        """Whether energy, gradient and field stayed finite; where they did not, the field is not a shape."""
        rows = [self.history.energy, self.history.gradient_max, self.history.gradient_mean, self.history.mass]
        extent = [self.viability.highest, self.viability.lowest]
        return bool(np.isfinite(np.concatenate([*rows, extent])).all())
