"""A volume fraction instead of a mass: reached, told of, or told that it was not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from curvafit.generation import loop
from curvafit.generation.flow import choose_base, generate
from curvafit.generation.loop import first_mass
from curvafit.generation.schedule import Schedule, schedule
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset


def share(u: torch.Tensor) -> float:
    return float((u > 0).double().mean())


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["periodic", "replicate"])
@pytest.mark.parametrize(("name", "wanted"), [("tubes", 0.12), ("sponge", 0.4)])
def test_a_volume_fraction_is_reached(name, wanted, boundary):
    """To 0.2 %, by a mass that a shape has: the last constant is small, the mass constant in the end, and it holds."""
    a, grid = preset(name).coefficients, Grid((40, 42, 44), 0.01, boundary)
    flow = generate(a, None, grid, volume_fraction=wanted)
    assert flow.viability.viable
    assert share(flow.field) == pytest.approx(wanted, rel=2e-3)
    assert flow.mass == pytest.approx(float(flow.field.double().mean()), abs=1e-6)
    assert flow.mass == flow.history.mass[-1]
    assert abs(flow.history.mass[-1] - flow.history.mass[-2]) < 0.01
    assert np.ptp(flow.history.mass) > 0.01
    assert "volume fraction" not in flow.status


def test_backends_steer_alike():
    """Chance apart, the mass is a property of the shape's parameters."""
    pytest.importorskip("numba")
    told = {"volume_fraction": 0.3, "schedule": schedule("cosine", steps=100)}
    a, grid = preset("sponge").coefficients, Grid((20, 20, 20))
    ends = [generate(a, None, grid, **told, backend=backend) for backend in ("torch", "fused")]
    assert all(share(end.field) == pytest.approx(0.3, rel=2e-3) for end in ends)
    assert abs(ends[0].mass - ends[1].mass) < 0.1


def test_what_cannot_be_reached_is_told():
    """So much cost on area leaves no shape at any mass."""
    area = Coefficients(1, 2, 1, 0, 0, 50000)
    flow = generate(
        area, None, Grid((16, 16, 16)), volume_fraction=0.1, schedule=Schedule("t", 200, 5e-3, 5e-3, "cosine")
    )
    assert not flow.viability.viable
    assert flow.status.startswith("no shape after 200 steps")
    assert f"volume fraction {share(flow.field):.4f} instead of 0.1000" in flow.status


def test_a_mass_or_a_volume_fraction():
    a, grid = preset("tubes").coefficients, Grid((12, 12, 12))
    with pytest.raises(ValueError, match="neither"):
        generate(a, None, grid)
    for mass in (1.0, float("nan"), torch.full(grid.shape, -0.5)):
        with pytest.raises(ValueError, match="mass"):
            generate(a, mass, grid, volume_fraction=0.2)
    for wanted in (0.0, 1.0, -0.1, float("nan")):
        with pytest.raises(ValueError, match="volume fraction"):
            generate(a, None, grid, volume_fraction=wanted)


@pytest.mark.parametrize(("mass", "first"), [(None, -0.6), (-0.5, -0.5), (-0.9, -0.8), (0.3, -0.4)])
def test_a_flow_begins_with_the_mass_that_is_given(mass, first):
    """As far as a shape of this share may have it."""
    assert first_mass(0.2, mass) == pytest.approx(first)
    a, grid = preset("tubes").coefficients, Grid((16, 16, 16))
    assert choose_base(mass, 0.2, grid) == pytest.approx(first)
    assert generate(a, mass, grid, volume_fraction=0.2, schedule=schedule("cosine", steps=5)).finite


@pytest.mark.parametrize("wanted", [1e-6, 0.001, 0.2, 0.5, 0.999, 1 - 1e-6])
def test_the_last_constant_is_exact(wanted):
    """Counted, with the rounding to whole voxels; at least one voxel on either side."""
    u = torch.rand((20, 21, 22), generator=torch.Generator().manual_seed(0)) - 0.7
    moved = u.double() + loop.last_shift(u, wanted)
    inside = int((moved > 0).sum())
    assert inside == min(max(round(wanted * u.numel()), 1), u.numel() - 1)


def test_corrections_are_bounded_and_point_the_right_way():
    u = torch.linspace(-1, 1, 1000).reshape(10, 10, 10)
    assert loop.correct_mass(u, 0.5, 0.0, 1000) == pytest.approx(0, abs=1e-9)
    up, down = loop.correct_mass(u, 0.55, 0.0, 1000), loop.correct_mass(u, 0.45, 0.0, 1000)
    assert up == pytest.approx(loop.FRACTION_GAIN * 2 * 0.05) == -down
    assert loop.correct_mass(u, 0.55, 0.0, 8000) == pytest.approx(up / 8)
    ends = [mass + loop.correct_mass(u, 0.7, mass, 1000) for mass in (0.0, 0.6, 0.4)]
    assert ends == pytest.approx([0.2, 0.6, 0.44])
    assert loop.correct_mass(u, 0.99, loop.FRACTION_BOUND, 1000) == 0
