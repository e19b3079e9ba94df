"""What a flow gives back, and what it shows on its way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from torch import Tensor

from curvafit.generation.schedule import Schedule
from curvafit.generation.viability import Viability
from curvafit.pictures import Pictured
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid

#: Steps between two entries of the history (and two calls of the callbacks).
RECORD_EVERY = 10


@dataclass(frozen=True, eq=False)
class History:
    """Figures every `RECORD_EVERY` steps and at the end, arrays `(N,)`: the number of steps made, F_ε, max and mean of
    |∂F_ε/∂A| over free voxels, the mean of u. (For the L² flows the gradient is that of v.)"""

    step: np.ndarray
    energy: np.ndarray
    gradient_max: np.ndarray
    gradient_mean: np.ndarray
    mass: np.ndarray


@dataclass(frozen=True, eq=False)
class State:
    """What a callback sees: the figures of the history's newest entry, and the field, `(Z, Y, X)`."""

    field: Tensor
    energy: float
    gradient_max: float
    gradient_mean: float
    mass: float


class Callback(Protocol):
    def __call__(self, step: int, total: int, state: State, /) -> bool | None:
        """Called every `RECORD_EVERY` steps with the number made, and at the end; returning True stops the flow."""
        ...


@dataclass(frozen=True, repr=False, eq=False)
class Flow(Pictured):
    """The end of a flow: the field, how it came there, and whether it is a shape.

    Attributes
    ----------
    field
        u, float32 `(Z, Y, X)`.
    history
        Figures on the way.
    status
        A sentence.
    coefficients, epsilon
        What was lowered: numbers, or tensors that vary in space, in the unit of the grid's spacing.
    seed
        None where the flow started from a given field.
    mass
        The mean of the field.
    snapshots
        The fields that were asked for, by the number of steps.
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
        cube, energy = len(set(self.grid.spacing)) == 1, self.history.energy[-1]
        edges = " x ".join(f"{h:g}" for h in self.grid.spacing[: 1 if cube else 3])
        voxels = f"{' x '.join(map(str, self.grid.shape))} voxels of {edges}"
        return f"Flow({voxels}, energy {energy:.4g}, {'' if self.viability.viable else 'not '}viable: {self.status})"

    @property
    def finite(self) -> bool:
        """Whether energy, gradient and field stayed finite; the field is no shape where they did not."""
        rows = [self.history.energy, self.history.gradient_max, self.history.gradient_mean, self.history.mass]
        extent = [self.viability.highest, self.viability.lowest]
        return bool(np.isfinite(np.concatenate([*rows, extent])).all())
