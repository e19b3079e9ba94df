"""What tests of the kernels share: grids, a law, a short schedule, a smooth field and its gradient in plain torch."""

import numpy as np
import torch

from curvafit.generation.loop import Run
from curvafit.generation.problem import Cost, DivergenceForm
from curvafit.generation.result import Flow
from curvafit.generation.schedule import Schedule
from curvafit.generation.stepper import FusedStepper, TorchStepper
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.stencils import gaussian_blur

BOUNDARIES = ("periodic", "replicate")
SPACINGS = ((0.01, 0.01, 0.01), (0.013, 0.01, 0.008))
TUBES = Coefficients(1, 2, 6, -40, -40, 400)
BETAS, ADAM_EPS, BLUR, EPSILON = (0.9, 0.999), 1e-2, 0.02, 0.02


def short(steps: int, rate: float = 1e-2) -> Schedule:
    return Schedule("test", steps, rate, rate / 10, "cosine")


def smooth_field(grid: Grid, seed: int = 0, rms: float = 0.8) -> torch.Tensor:
    """A blurred noise in float64, about as rough as a phase field."""
    noise = torch.randn(grid.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    field = gaussian_blur(noise, grid, 0.02)
    return field * rms / field.std() - 0.3


def rough(grid: Grid, seed: int = 0, *batch: int) -> torch.Tensor:
    """A blurred noise with values of order one, `(*batch, Z, Y, X)` float64."""
    noise = torch.randn(*batch, *grid.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    u = gaussian_blur(noise, grid, 1.2 * max(grid.spacing))
    return 0.7 * u / u.std()


def assert_same(one: Flow, other: Flow) -> None:
    """Two flows are one, bit for bit."""
    assert torch.equal(one.field, other.field)
    for name in ("step", "energy", "gradient_max", "gradient_mean", "mass"):
        np.testing.assert_array_equal(getattr(one.history, name), getattr(other.history, name))
    assert (one.seed, one.status, one.schedule, one.grid) == (other.seed, other.status, other.schedule, other.grid)
    assert one.mass == other.mass


def relax(field: torch.Tensor, law: Coefficients, grid: Grid, schedule: Schedule, callbacks=()) -> Flow:
    """The flow of `generate` from a field: u = k ∗ (div A + field) from A = 0, under Adam."""
    form, cost, betas = DivergenceForm.of(grid, BLUR, field), Cost(law, grid, EPSILON, None, BLUR), schedule.betas_at(0)
    start, fused = torch.zeros((3, *grid.shape)), kernels.has_kernel("cpu")
    stepper = FusedStepper(start, form, cost, betas) if fused else TorchStepper(start, form, cost, betas, "cpu")
    return Run(stepper, cost, schedule, callbacks).flow()
