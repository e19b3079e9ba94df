"""Steppers of flows: their interface, and torch's optimisers on any form, device and cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from curvafit.generation.data import Data
from curvafit.generation.parametrization import Form
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients

#: The number that Adam adds to the root, as published instead of the usual 1e-8; shapes depend on it.
ADAM_EPS = 1e-2
#: Number of steps and slopes that L-BFGS stores, as published.
LBFGS_HISTORY = 10
#: The most evaluations in a line search, as published.
LINE_SEARCH = 20
#: The greatest change of a parameter at the first point of the first line search.
FIRST_MOVE = 1e-2


class Statistics(NamedTuple):
    """F_ε, and maximum and mean of the modulus of its gradient over free parameters."""

    energy: float
    gradient_max: float
    gradient_mean: float


class ShapeView(Protocol):
    """A shape of a stepper, as the loop reads it."""

    def statistics(self) -> Statistics:
        """Return the statistics before the last `step` moved the shape."""
        ...

    def field(self) -> Tensor:
        """Return the last u, float32 `(Z, Y, X)` on the processor, in a tensor that no step overwrites."""
        ...

    def mass(self) -> float:
        """Return the mean of the last u, computed in float64."""
        ...

    def shift(self, amount: float) -> None:
        """Add a constant to u from the next step on."""
        ...


class Stepper(Protocol):
    """The state of the flows of one or more shapes, stepped in place."""

    #: Whether the optimiser found no lower point and therefore stopped.
    stalled: bool = False

    @property
    def shapes(self) -> Sequence[ShapeView]:
        """The shapes, in order."""
        ...

    def step(self, rate: float | None) -> None:
        """Compute u and the gradient, then step by `rate`; None leaves the parameters, and no rate may follow it."""
        ...

    def run(self, rates: Sequence[float]) -> int:
        """Make steps without statistics, and return their number, which is smaller than that of rates after a stall."""
        for count, rate in enumerate(rates):
            if self.stalled:
                return count
            self.step(rate)
        return len(rates)

    def set_betas(self, betas: tuple[float, float]) -> None:
        """Set Adam's decay rates (momentum, memory) from the next step on."""
        ...

    def state(self) -> dict[str, Any]:
        """Return tensors and numbers, in lists and dictionaries, that determine all later steps."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state that `state` returned."""
        ...


class TorchStepper(Stepper):
    """`torch.optim.Adam` on the parameters of a form.

    With `fused` the energy's gradient comes from a fused kernel where there is one, else from autograd, the definition.
    """

    def __init__(
        self,
        start: Tensor,
        form: Form,
        coefficients: Coefficients,
        epsilon: float | Tensor,
        betas: tuple[float, float],
        frozen: Tensor | None,
        device: torch.device | str,
        *,
        orientation: Tensor | None = None,
        fused: bool = False,
        data: Data | None = None,
    ) -> None:
        def on_device(value):
            return value.to(device, torch.float32) if isinstance(value, Tensor) and value.dim() > 0 else value

        self._form, self._offset = form.to(device), 0.0
        self._data = None if data is None else data.to(device)
        self._cost = (
            Coefficients(*map(on_device, coefficients)),
            form.grid,
            on_device(epsilon),
            on_device(orientation),
        )
        self._slope_of = kernels.energy_gradient if fused else kernels.plain_energy_gradient
        self._free = None if frozen is None else ~torch.as_tensor(frozen, dtype=torch.bool, device=device)
        self._parameters = start.to(device).clone()
        self._optimiser = self._optimiser_of(betas)
        self._value, self._u, self._slope = 0.0, self._parameters, self._parameters

    @property
    def shapes(self) -> Sequence[ShapeView]:
        return (self,)

    def _optimiser_of(self, betas: tuple[float, float]) -> torch.optim.Optimizer:
        """Return the optimiser of the parameters."""
        return torch.optim.Adam([self._parameters], betas=betas, eps=ADAM_EPS)

    def _evaluate(self) -> tuple[float, Tensor, Tensor]:
        """Return the energy, u, and the gradient with respect to the parameters."""
        u = self._form.field(self._parameters) + self._offset
        value, slope = self._slope_of(u, *self._cost)
        if self._data is not None:
            data_value, data_slope = self._data.slope(u, self._form.grid)
            value, slope = value + data_value, slope + data_slope
        slope = self._form.pullback(slope)
        return value, u, slope if self._free is None else slope * self._free

    def step(self, rate: float | None) -> None:
        self._value, self._u, self._slope = self._evaluate()
        if rate is not None:
            self._parameters.grad = self._slope
            self._optimiser.param_groups[0]["lr"] = rate
            self._optimiser.step()

    def set_betas(self, betas: tuple[float, float]) -> None:
        self._optimiser.param_groups[0]["betas"] = betas

    def statistics(self) -> Statistics:
        size = self._slope.abs()
        count = size.numel() if self._free is None else int(self._free.expand_as(size).sum())
        return Statistics(self._value, float(size.max()), float(size.sum(dtype=torch.float64)) / max(1, count))

    def field(self) -> Tensor:
        return self._u.to("cpu", torch.float32)

    def mass(self) -> float:
        return float(self._u.mean(dtype=torch.float64))

    def shift(self, amount: float) -> None:
        self._offset += amount

    def state(self) -> dict[str, Any]:
        state = self._optimiser.state_dict()["state"]
        point = {"parameters": self._parameters, "offset": self._offset, "stalled": self.stalled}
        return {**point, "optimiser": state}

    def restore(self, state: dict[str, Any]) -> None:
        self._parameters.copy_(state["parameters"])
        self._offset, self.stalled = state["offset"], state["stalled"]
        groups = self._optimiser.state_dict()["param_groups"]
        self._optimiser.load_state_dict({"state": state["optimiser"], "param_groups": groups})


class LbfgsStepper(TorchStepper):
    """`torch.optim.LBFGS` on the parameters of a form: a step is one iteration with a strong Wolfe line search.

    The last evaluation is cached, since the next iteration begins at that point. Near the minimum a line search fails
    in float32, where rounding hides the decrease: the parameters then stay, and the stepper is stalled.
    """

    def _optimiser_of(self, betas: tuple[float, float]) -> torch.optim.Optimizer:
        self._cached: tuple[Tensor, tuple[float, Tensor, Tensor]] | None = None
        return torch.optim.LBFGS(
            [self._parameters],
            max_iter=1,
            max_eval=1 + LINE_SEARCH,
            history_size=LBFGS_HISTORY,
            tolerance_grad=0,
            tolerance_change=0,
            line_search_fn="strong_wolfe",
        )

    def _evaluate(self) -> tuple[float, Tensor, Tensor]:
        if self._cached is None or not torch.equal(self._cached[0], self._parameters):
            self._cached = self._parameters.clone(), super()._evaluate()
        return self._cached[1]

    def step(self, rate: float | None) -> None:
        self._value, self._u, self._slope = self._evaluate()
        if rate is None:
            return
        first = not self._optimiser.state
        self._optimiser.param_groups[0]["lr"] = rate * self._first_length() if first else rate
        before = self._parameters.clone()
        self._optimiser.step(self._closure)
        self.stalled = torch.equal(before, self._parameters)

    def _first_length(self) -> float:
        """Return a factor that replaces torch's first length, min(1, 1 / Σ|slope|), lost by float32 on large grids."""
        size = self._slope.abs()
        return FIRST_MOVE / max(float(size.max()), 1e-30) * max(1.0, float(size.sum(dtype=torch.float64)))

    def _closure(self) -> float:
        """Return the energy and set the parameters' gradient, as torch's line search asks."""
        value, _, self._parameters.grad = self._evaluate()
        return value

    def shift(self, amount: float) -> None:
        super().shift(amount)
        self._cached = None
