"""The forms of a field: adjoints, laws, and the flows that move them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from curvafit.generation import stepper
from curvafit.generation.flow import descend
from curvafit.generation.forms import FORMS, DivergenceForm
from curvafit.generation.schedule import Schedule
from curvafit.generation.stepper import LbfgsStepper
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy, orientation
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.priors.profile import SIGMA, optimal_profile
from curvafit.priors.stencils import gaussian_blur

BOUNDARIES = ("periodic", "replicate")
ANISOTROPIC = (0.013, 0.01, 0.008)
TUBES, WILLMORE = preset("tubes").coefficients, Coefficients.willmore()


def rough(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def ball(grid: Grid, radius: float, epsilon: float) -> torch.Tensor:
    axes = [h * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) for n, h in zip(grid.shape, grid.spacing)]  # noqa: B905
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return optimal_profile(radius - (z**2 + y**2 + x**2).sqrt(), epsilon).float()


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_pullback_is_the_adjoint(boundary, name):
    """⟨u(p) - u(0), g⟩ = ⟨p, pullback(g)⟩."""
    grid = Grid((6, 9, 7), ANISOTROPIC, boundary)
    form, start = FORMS[name].start_at(rough(*grid.shape), grid, 0.012, gaussian_blur)
    parameters, slope = rough(*start.shape, seed=1), rough(*grid.shape, seed=2)
    moved = form.field(parameters) - form.field(torch.zeros_like(start))
    there, back = float((moved * slope).sum()), float((parameters * form.pullback(slope)).sum())
    assert abs(there) > 1e-2
    assert there == pytest.approx(back, rel=1e-11)


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_a_form_starts_at_the_blurred_field(boundary, name):
    grid = Grid((6, 9, 7), ANISOTROPIC, boundary)
    field = rough(*grid.shape)
    form, start = FORMS[name].start_at(field, grid, 0.012, gaussian_blur)
    torch.testing.assert_close(form.field(start), gaussian_blur(field, grid, 0.012), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_mass_is_the_forms_own(boundary):
    grid = Grid((6, 9, 7), ANISOTROPIC, boundary)
    u = DivergenceForm(grid, 0.012, -0.3).field(rough(3, *grid.shape))
    assert float(u.mean()) == pytest.approx(-0.3, abs=1e-12)


def test_fused_blur_is_the_blur():
    pytest.importorskip("numba")
    grid = Grid((6, 9, 7), ANISOTROPIC)
    u = rough(*grid.shape)
    torch.testing.assert_close(kernels.gaussian_blur(u.float(), grid, 0.012), gaussian_blur(u, grid, 0.012).float())
    assert torch.equal(kernels.gaussian_blur(u, grid, 0.012), gaussian_blur(u, grid, 0.012))


@pytest.mark.parametrize("optimiser", ["adam", "lbfgs"])
@pytest.mark.parametrize("flow", FORMS)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_every_flow_lowers_the_energy_and_keeps_what_it_keeps(boundary, flow, optimiser):
    grid = Grid((16, 17, 18), 0.01, boundary)
    start = ball(grid, 0.05, 0.02) + 0.1 * rough(*grid.shape).float()
    plan = Schedule("test", 1, 1e-3, 1e-3, "constant")
    end = descend(start, TUBES, grid, flow=flow, optimiser=optimiser, steps=30, schedule=plan)
    history = end.history
    assert history.step.tolist() == [0, 10, 20, 30]
    first = float(energy(gaussian_blur(start, grid, 0.01).double(), TUBES, grid, 0.02))
    assert history.energy[0] == pytest.approx(first, rel=1e-3)
    assert history.energy[-1] < (0.5 if optimiser == "lbfgs" else 0.9) * first
    assert history.energy[-1] == pytest.approx(float(energy(end.field.double(), TUBES, grid, 0.02)), rel=1e-3)
    assert history.gradient_mean[-1] < history.gradient_mean[0]
    drift = np.abs(history.mass - float(start.mean(dtype=torch.float64))).max()
    assert drift > 1e-3 if flow == "l2" else drift < 1e-6
    assert end.mass == history.mass[-1]
    assert end.schedule.steps == 30


def test_backends_descend_alike():
    """Adam step by step. L-BFGS in the energy reached: its line search hangs on the energies' last digits."""
    pytest.importorskip("numba")
    grid = Grid((28, 30, 32), 0.01, "replicate")
    start = ball(grid, 0.09, 0.03)

    def both(**told):
        return (descend(start, WILLMORE, grid, **told, backend=backend) for backend in ("torch", "fused"))

    plain, fused = both(optimiser="adam", steps=10)
    moved = float((plain.field - gaussian_blur(start, grid, 0.01)).abs().max())
    assert moved > 0.02
    assert float((plain.field - fused.field).abs().max()) < 1e-4 * moved
    plain, fused = both(steps=30)
    assert plain.history.energy[-1] < 0.5 * plain.history.energy[0]
    assert plain.history.energy[-1] == pytest.approx(fused.history.energy[-1], rel=0.02)


def test_willmore_flow_of_a_wide_ball_is_a_sphere():
    """16π in the limit ε → 0. The profile, a third too wide at first, is mended."""
    grid, ε = Grid((40, 40, 40), 0.01, "replicate"), 0.02
    end = descend(ball(grid, 0.12, 1.3 * ε), WILLMORE, grid, steps=60, epsilon=ε)
    assert end.history.energy[0] / SIGMA > 100
    assert end.history.energy[-1] / SIGMA == pytest.approx(16 * math.pi, rel=0.02)
    assert end.viability.discrepancy < 0.05


class _Bowl:
    """|p|²/2 - 10: its float32 minimum is reached exactly."""

    grid = Grid((4, 4, 4))

    def field(self, parameters):
        return parameters

    def pullback(self, slope):
        return slope

    def to(self, device):
        return self


def test_lbfgs_stalls_where_nothing_is_lower(monkeypatch):
    count = []

    def bowl(u, *cost):
        count.append(1)
        return float(u.double().square().sum()) / 2 - 10, u.clone()

    monkeypatch.setattr(stepper, "energy_gradient_by_autograd", bowl)
    start = rough(4, 4, 4).float()
    moved = LbfgsStepper(start, _Bowl(), TUBES, 0.02, (0.9, 0.999), None, "cpu")
    for _ in range(30):
        moved.step(1.0)
        if moved.stalled:
            break
    assert moved.stalled
    assert moved.statistics().energy == pytest.approx(-10, abs=1e-6)
    assert len(count) < 100


def test_orientation_tells_layers_from_layers():
    """One across θ flattens until nothing is left; one along θ does not feel it."""
    grid, Q = Grid((16, 16, 16)), orientation((1, 0, 0), 20000.0)
    along = torch.sin(2 * math.pi * (torch.arange(16) + 0.5) / 16).expand(16, 16, 16)
    bent, kept = (descend(u, WILLMORE, grid, steps=30, orientation=Q) for u in (along.permute(2, 0, 1), along))
    free = descend(along, WILLMORE, grid, steps=30)
    assert float(bent.field.std()) < 0.1 * float(kept.field.std())
    assert float((kept.field - free.field).abs().max()) < 1e-3


def test_without_a_blur_the_field_is_what_moves():
    """The field seen is the one before the step, also where it is the parameters themselves."""
    grid, fields = Grid((12, 12, 12)), []
    start, watch = ball(grid, 0.04, 0.02), lambda step, total, state: fields.append(state.field.clone())
    end = descend(start, WILLMORE, grid, blur=0.0, optimiser="adam", steps=10, backend="torch", callbacks=[watch])
    assert torch.equal(fields[0], start)
    assert end.history.energy[-1] < end.history.energy[0]


def test_wrong_flows_are_refused():
    grid = Grid((12, 12, 12))
    field = torch.zeros(grid.shape)
    with pytest.raises(ValueError, match="flow"):
        descend(field, TUBES, grid, flow="h1")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="optimiser"):
        descend(field, TUBES, grid, optimiser="sgd")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="steps"):
        descend(field, TUBES, grid, steps=0)
    with pytest.raises(ValueError, match="field"):
        descend(field[1:], TUBES, grid)
