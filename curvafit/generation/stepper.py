"""Steppers of flows: their interface, Algorithm 1 in fused kernels, and torch's optimisers on any form and device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from curvafit.generation.problem import Cost, DivergenceForm, Form
from curvafit.priors.energies import energy_gradient

#: The number that Adam adds to the root, as published instead of the usual 1e-8; shapes depend on it.
ADAM_EPS = 1e-2
#: Number of earlier steps, and of changes of the gradient, that L-BFGS stores, as published.
LBFGS_HISTORY = 10
#: The most evaluations in a line search, as published.
LINE_SEARCH = 20
#: The greatest change of a parameter at the first point of the first line search.
FIRST_MOVE = 1e-2


class Statistics(NamedTuple):
    """F_ε, and maximum and mean of the modulus of its gradient over the parameters."""

    energy: float
    gradient_max: float
    gradient_mean: float


class Stepper(Protocol):
    """The state of a flow, stepped in place."""

    #: Whether the optimiser found no lower point and therefore stopped.
    stalled: bool = False
    #: Adam's decay rates (momentum, memory) from the next step on.
    betas: tuple[float, float]

    def step(self, rate: float | None) -> None:
        """Compute u and the gradient, then step by `rate`; with None only compute, after which no rate may follow."""
        ...

    def run(self, rates: Sequence[float]) -> int:
        """Make a step at each rate, without statistics, until the stepper stalls; return the number of steps made."""
        for count, rate in enumerate(rates):
            if self.stalled:
                return count
            self.step(rate)
        return len(rates)

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

    def state(self) -> dict[str, Any]:
        """Return the tensors and numbers that determine all later steps, in lists and dictionaries."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state that `state` returned."""
        ...


class FusedStepper(Stepper):
    """The flow of Algorithm 1 on a processor, by fused kernels, for a law of six numbers; `step(None)` advances Adam's
    moments all the same."""

    def __init__(self, start: Tensor, form: DivergenceForm, cost: Cost, betas: tuple[float, float]) -> None:
        from curvafit.priors.kernels.cpu import FusedFlow

        base = form.base.numpy() if isinstance(form.base, Tensor) else form.base
        a = [float(value) for value in cost.coefficients]
        self._flow = FusedFlow(
            start.numpy(), base, a, cost.grid, cost.epsilon, cost.blur, betas=betas, adam_eps=ADAM_EPS
        )
        self.betas, self._statistics = betas, Statistics(0.0, 0.0, 0.0)

    def step(self, rate: float | None) -> None:
        self._flow.betas = self.betas
        self._statistics = Statistics(self._flow.evaluate(), *self._flow.update(rate or 0.0))

    def statistics(self) -> Statistics:
        return self._statistics

    def field(self) -> Tensor:
        return torch.from_numpy(self._flow.field.copy())

    def mass(self) -> float:
        return float(self._flow.field.mean(dtype="float64"))

    def shift(self, amount: float) -> None:
        self._flow.shift(amount)

    def state(self) -> dict[str, Any]:
        state = self._flow.state()
        return {name: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for name, v in state.items()}

    def restore(self, state: dict[str, Any]) -> None:
        self._flow.restore(state)


class TorchStepper(Stepper):
    """Adam on the parameters of a form, on any device, where its whole state stays."""

    def __init__(
        self, start: Tensor, form: Form, cost: Cost, betas: tuple[float, float], device: torch.device | str
    ) -> None:
        def move(value):
            return value.to(device, torch.float32) if isinstance(value, Tensor) and value.dim() > 0 else value

        self._form = replace(form, base=move(form.base)) if isinstance(form, DivergenceForm) else form
        self.betas = betas
        self._data = None if cost.data is None else cost.data.to(device)
        self._cost = [*map(move, cost.coefficients)], cost.grid, cost.epsilon, move(cost.orientation)
        self._parameters = start.to(device).clone()
        self._value: Tensor | float = 0.0
        self._u = self._gradient = self._parameters
        self._offset = torch.zeros((), device=device)
        self._statistics: Statistics | None = None
        self._start_optimiser()

    def _start_optimiser(self) -> None:
        """Set the optimiser's state before its first step."""
        self._moments = torch.zeros_like(self._parameters), torch.zeros_like(self._parameters)
        self._taken = 0

    def _evaluate(self, parameters: Tensor, offset: Tensor) -> tuple[Tensor | float, Tensor, Tensor]:
        """Return the energy, u, and the energy's gradient with respect to the parameters."""
        u = self._form.field(parameters) + offset
        value, gradient_u = energy_gradient(u, *self._cost)
        if self._data is not None:
            data_value, data_gradient = self._data.slope(u, self._form.grid)
            value, gradient_u = value + data_value, gradient_u + data_gradient
        return value, u, self._form.pullback(gradient_u)

    def step(self, rate: float | None) -> None:
        self._statistics = None
        if rate is not None:
            self.run([rate])
        else:
            self._value, self._u, self._gradient = self._evaluate(self._parameters, self._offset)

    def run(self, rates: Sequence[float]) -> int:
        """Make steps of `torch.optim.Adam`, without statistics, and return their number."""
        (momentum, memory), (first, second) = self.betas, self._moments
        taken = range(self._taken + 1, self._taken + len(rates) + 1)
        # Minus a step's length over the first moment's bias correction, and the root of the second's: on the device, so
        # that no step waits for the host.
        factors = [(-rate / (1 - momentum**k), (1 - memory**k) ** 0.5) for rate, k in zip(rates, taken, strict=True)]
        for length, root in torch.tensor(factors, dtype=torch.float32).to(self._parameters.device):
            self._value, self._u, self._gradient = self._evaluate(self._parameters, self._offset)
            first.lerp_(self._gradient, 1 - momentum)
            second.mul_(memory).addcmul_(self._gradient, self._gradient, value=1 - memory)
            self._parameters.addcdiv_(first * length, second.sqrt().div_(root).add_(ADAM_EPS))
        self._taken += len(rates)
        return len(rates)

    def statistics(self) -> Statistics:
        if self._statistics is None:
            moduli = self._gradient.abs()
            mean = float(moduli.mean(dtype=torch.float64))
            self._statistics = Statistics(float(self._value), float(moduli.amax()), mean)
        return self._statistics

    def field(self) -> Tensor:
        return self._u.to("cpu", torch.float32)

    def mass(self) -> float:
        return float(self._u.mean(dtype=torch.float64))

    def shift(self, amount: float) -> None:
        self._offset = self._offset + amount

    def state(self) -> dict[str, Any]:
        point = {"parameters": self._parameters, "offset": self._offset, "stalled": self.stalled}
        return {**point, "optimiser": self._optimiser_state()}

    def restore(self, state: dict[str, Any]) -> None:
        self._parameters.copy_(state["parameters"])
        self._offset, self.stalled = state["offset"].to(self._offset.device), state["stalled"]
        self._restore_optimiser(state["optimiser"])

    def _optimiser_state(self) -> dict[Any, Any]:
        return {"moments": list(self._moments), "taken": self._taken}

    def _restore_optimiser(self, state: dict[Any, Any]) -> None:
        for moment, saved in zip(self._moments, state["moments"], strict=True):
            moment.copy_(saved)
        self._taken = state["taken"]


class LbfgsStepper(TorchStepper):
    """`torch.optim.LBFGS` on the parameters of one shape: a step is one iteration with a strong Wolfe line search.

    The last evaluation is cached, since the next iteration begins at that point. Near the minimum a line search fails
    in float32, where rounding hides the decrease: the parameters then stay, and the stepper is stalled.
    """

    def _start_optimiser(self) -> None:
        self._cached: tuple[Tensor, tuple[Tensor | float, Tensor, Tensor]] | None = None
        self._optimiser = torch.optim.LBFGS(
            [self._parameters], max_iter=1, max_eval=1 + LINE_SEARCH, history_size=LBFGS_HISTORY,
            tolerance_grad=0, tolerance_change=0, line_search_fn="strong_wolfe",
        )  # fmt: skip

    def _evaluate_once(self) -> tuple[Tensor | float, Tensor, Tensor]:
        """Return the evaluation at the parameters, from the cache if they have not moved."""
        if self._cached is None or not torch.equal(self._cached[0], self._parameters):
            self._cached = self._parameters.clone(), self._evaluate(self._parameters, self._offset)
        return self._cached[1]

    def step(self, rate: float | None) -> None:
        self._statistics = None
        self._value, self._u, self._gradient = self._evaluate_once()
        if rate is None:
            return
        first = not self._optimiser.state
        self._optimiser.param_groups[0]["lr"] = rate * self._first_rate() if first else rate
        previous = self._parameters.clone()
        self._optimiser.step(self._closure)
        self.stalled = torch.equal(previous, self._parameters)

    def run(self, rates: Sequence[float]) -> int:
        return Stepper.run(self, rates)

    def _first_rate(self) -> float:
        """Return the rate at which the first step moves no parameter by more than `FIRST_MOVE`."""
        # L-BFGS knows no curvature before its first step, which torch makes along the gradient g, times the rate and
        # min(1, 1 / Σ|g|). Where the energy is steep that would cross the interface, and end in another minimum.
        moduli = self._gradient.abs()
        return FIRST_MOVE / max(float(moduli.max()), 1e-30) * max(1.0, float(moduli.sum(dtype=torch.float64)))

    def _closure(self) -> float:
        """Return the energy and set the parameters' gradient, as torch's line search asks."""
        value, _, self._parameters.grad = self._evaluate_once()
        return float(value)

    def shift(self, amount: float) -> None:
        super().shift(amount)
        self._cached = None

    def _optimiser_state(self) -> dict[Any, Any]:
        return self._optimiser.state_dict()["state"]

    def _restore_optimiser(self, state: dict[Any, Any]) -> None:
        groups = self._optimiser.state_dict()["param_groups"]
        self._optimiser.load_state_dict({"state": state, "param_groups": groups})
