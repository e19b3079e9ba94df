"""Flows whose coefficients, mass and ε vary in space, or that mind a direction; and fields kept on the way."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from kernel_cases import short

from curvafit.generation.flow import generate
from curvafit.generation.forms import white_noise
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import energy, orientation
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.priors.stencils import divergence, gaussian_blur, gradient

TUBES, MASS = preset("tubes").coefficients, preset("tubes").mass
BACKENDS = ("torch", "fused")
EPSILON = BLUR = 0.02


@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
def test_what_is_lowered_may_vary_in_space(boundary):
    """Fields that are constant are numbers; those that are not lower their own energy."""
    grid, ramp = Grid((12, 13, 14), 0.01, boundary), torch.linspace(1, 1.4, 14)
    ones = torch.ones(grid.shape)
    same = Coefficients(1, 2, 6 * ones, -40, -40 * ones[0], 400)
    there = generate(same, MASS, grid, schedule=short(2), epsilon=EPSILON * ones)
    here = generate(TUBES, MASS, grid, schedule=short(2))
    assert float((there.field - here.field).abs().mean()) < 1e-3 * float(here.field.std())
    assert there.history.energy[0] == pytest.approx(here.history.energy[0], rel=1e-5)
    varying = Coefficients(1, 2, 6 * ramp, -40, -40, 400 * ramp)
    flow = generate(varying, MASS, grid, schedule=short(60), epsilon=EPSILON * ramp)
    assert flow.history.energy[-1] < 0.5 * flow.history.energy[0]
    truth = float(energy(flow.field.double(), varying, grid, EPSILON * ramp))
    assert flow.history.energy[-1] == pytest.approx(truth, rel=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_mass_that_varies_in_space(backend):
    """u = k ∗ (div A + m(x)): it starts with m, and keeps m's mean."""
    grid = Grid((16, 16, 32))
    here = -0.45 - 0.3 * torch.cos(2 * math.pi * (torch.arange(32) + 0.5) / 32)
    told = {"schedule": short(20), "backend": backend, "snapshots": (0,)}
    flow, flat = (generate(TUBES, mass, grid, **told) for mass in (here, -0.45))
    assert np.abs(flow.history.mass + 0.45).max() < 1e-6
    assert flow.mass == flow.history.mass[-1]
    difference = gaussian_blur(here.expand(grid.shape), grid, BLUR) + 0.45
    assert float((flow.snapshots[0] - flat.snapshots[0] - difference).abs().max()) < 1e-5


def test_an_orientation_turns_the_shape():
    """Slopes along θ are dear: there are less of them, in all and in proportion."""
    grid, Q = Grid((24, 24, 24)), orientation((0, 1, 0), 3000.0)
    free, held = (generate(TUBES, MASS, grid, schedule=short(150), orientation=each).field for each in (None, Q))
    shares = [gradient(u, grid).square().mean((1, 2, 3)) for u in (free, held)]
    assert float(shares[1][1] / shares[1].sum()) < 0.5 * float(shares[0][1] / shares[0].sum())


@pytest.mark.parametrize("backend", BACKENDS)
def test_snapshots(backend):
    """The field after so many steps, also between two entries of the history; asking changes nothing."""
    grid = Grid((12, 13, 14))
    flow = generate(TUBES, MASS, grid, schedule=short(40), snapshots=(0, 13, 40), backend=backend)
    assert list(flow.snapshots) == [0, 13, 40]
    assert torch.equal(flow.snapshots[40], flow.field)
    assert flow.history.step.tolist() == [0, 10, 20, 30, 40]
    assert torch.equal(flow.field, generate(TUBES, MASS, grid, schedule=short(40), backend=backend).field)
    start = gaussian_blur(divergence(white_noise(grid, 0), grid), grid, BLUR) + MASS
    assert float((flow.snapshots[0] - start).abs().max()) < 1e-5
    with pytest.raises(ValueError, match="snapshots"):
        generate(TUBES, MASS, grid, schedule=short(40), snapshots=(1, 41))


def test_what_does_not_fit_the_voxels_is_refused():
    grid = Grid((12, 12, 12))
    for mass in (torch.tensor([0.5, 1.5]), torch.full((11,), 0.5)):
        with pytest.raises(ValueError, match="mass"):
            generate(TUBES, mass, grid)
    with pytest.raises(ValueError, match="a00"):
        generate(Coefficients(1, 2, 6, 0, 0, torch.ones(3, 1)), MASS, grid)
    with pytest.raises(ValueError, match="epsilon"):
        generate(TUBES, MASS, grid, epsilon=torch.full((2, 12, 12, 12), 0.02))
    with pytest.raises(ValueError, match="expected epsilon > 0"):
        generate(TUBES, MASS, grid, epsilon=torch.tensor([0.02] * 11 + [0.0]))
