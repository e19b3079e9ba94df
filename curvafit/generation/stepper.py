"""Making the steps of a flow: what any stepper does, and torch's optimisers on any form, device and cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from curvafit.generation.data import Data
from curvafit.generation.parametrization import Form
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients

#: The number that Adam adds to its root, as published; not the usual 1e-8, and it matters.
ADAM_EPS = 1e-2
#: Pairs of steps and slopes that L-BFGS remembers, as published.
LBFGS_HISTORY = 10
#: Most evaluations in a line search, as published.
LINE_SEARCH = 20
#: The most that any parameter moves where the first line search begins.
FIRST_MOVE = 1e-2


class Statistics(NamedTuple):
    """F_ε, and max and mean of its gradient's modulus over the parameters that are free."""

    energy: float
    gradient_max: float
    gradient_mean: float


class ShapeView(Protocol):
    """What a stepper shows of a shape."""

    def statistics(self) -> Statistics:
        """What the last `step` saw, before it moved."""
        ...

    def field(self) -> Tensor:
        """The u last computed, float32 `(Z, Y, X)` on the processor: no step overwrites it."""
        ...

    def mass(self) -> float:
        """Its mean, in float64."""
        ...

    def shift(self, amount: float) -> None:
        """Add a constant to u from the next step on."""
        ...


class Stepper(Protocol):
    """The state of the flows of one shape or more, stepped in place."""

    #: Whether the optimiser found no lower point: it stays where it is.
    stalled: bool = False

    @property
    def shapes(self) -> Sequence[ShapeView]:
        """The shapes, in order."""
        ...

    def step(self, rate: float | None) -> None:
        """Compute u and the gradient, then step by `rate`; for None the parameters stay, and no step may follow."""
        ...

    def run(self, rates: Sequence[float]) -> int:
        """Steps that nobody looks at; returns how many were made: all, if it does not stall."""
        for count, rate in enumerate(rates):
            if self.stalled:
                return count
            self.step(rate)
        return len(rates)

    def state(self) -> dict[str, Any]:
        """Tensors, numbers, and lists and dictionaries of such, that determine all steps to come."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from such a state."""
        ...


class TorchStepper(Stepper):
    """`torch.optim.Adam` on the parameters of a form.

    `fused` takes the energy's gradient from a fused kernel where there is one, else from autograd: the definition.
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
        orientation: Tensor | None = None,
        fused: bool = False,
        data: Data | None = None,
    ) -> None:
        def here(value):
            return value.to(device, torch.float32) if isinstance(value, Tensor) and value.dim() > 0 else value

        self._form, self._offset = form.to(device), 0.0
        self._data = None if data is None else data.to(device)
        self._cost = (Coefficients(*map(here, coefficients)), form.grid, here(epsilon), here(orientation))
        self._slope_of = kernels.energy_gradient if fused else kernels.plain_energy_gradient
        self._free = None if frozen is None else ~torch.as_tensor(frozen, dtype=torch.bool, device=device)
        self._parameters = start.to(device).clone()
        self._optimiser = self._optimiser_of(betas)
        self._value, self._u, self._slope = 0.0, self._parameters, self._parameters

    @property
    def shapes(self) -> Sequence[ShapeView]:
        return (self,)

    def _optimiser_of(self, betas: tuple[float, float]) -> torch.optim.Optimizer:
        return torch.optim.Adam([self._parameters], betas=betas, eps=ADAM_EPS)

    def _evaluate(self) -> tuple[float, Tensor, Tensor]:
        """What is lowered, u, and the gradient with respect to the parameters, where they are now."""
        u = self._form.field(self._parameters) + self._offset
        value, slope = self._slope_of(u, *self._cost)
        if self._data is not None:
            more, pull = self._data.slope(u, self._form.grid)
            value, slope = value + more, slope + pull
        slope = self._form.pullback(slope)
        return value, u, slope if self._free is None else slope * self._free

    def step(self, rate: float | None) -> None:
        self._value, self._u, self._slope = self._evaluate()
        if rate is not None:
            self._parameters.grad = self._slope
            self._optimiser.param_groups[0]["lr"] = rate
            self._optimiser.step()

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
        mine = {"parameters": self._parameters, "offset": self._offset, "stalled": self.stalled}
        return {**mine, "optimiser": state}

    def restore(self, state: dict[str, Any]) -> None:
        self._parameters.copy_(state["parameters"])
        self._offset, self.stalled = state["offset"], state["stalled"]
        groups = self._optimiser.state_dict()["param_groups"]
        self._optimiser.load_state_dict({"state": state["optimiser"], "param_groups": groups})


class LbfgsStepper(TorchStepper):
    """`torch.optim.LBFGS` on the parameters of a form: a step is one iteration, with its strong Wolfe line search.

    The last point evaluated is kept, since the next iteration begins there. In float32 a line search fails, near the
    minimum, where rounding hides the decrease: the parameters then stay, and the stepper is stalled.
    """

    def _optimiser_of(self, betas: tuple[float, float]) -> torch.optim.Optimizer:
        self._known: tuple[Tensor, tuple[float, Tensor, Tensor]] | None = None
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
        if self._known is None or not torch.equal(self._known[0], self._parameters):
            self._known = self._parameters.clone(), super()._evaluate()
        return self._known[1]

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
        """What undoes torch's guess of the first length, min(1, 1 / Σ|slope|), which float32 loses on large grids."""
        size = self._slope.abs()
        return FIRST_MOVE / max(float(size.max()), 1e-30) * max(1.0, float(size.sum(dtype=torch.float64)))

    def _closure(self) -> float:
        value, _, self._parameters.grad = self._evaluate()
        return value

    def shift(self, amount: float) -> None:
        super().shift(amount)
        self._known = None
