"""Many shapes: each is the one that `generate` makes, whether they share their steps or not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from curvafit.generation.flow import generate, generate_batch
from curvafit.generation.schedule import Schedule
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

GRID, PLAN = Grid((12, 13, 14)), Schedule("test", 45, 1e-2, 1e-3, "cosine")
TUBES, SPONGE = preset("tubes"), preset("sponge")


def assert_same(one, other) -> None:
    assert torch.equal(one.field, other.field)
    for name in ("step", "energy", "gradient_max", "gradient_mean", "mass"):
        np.testing.assert_allclose(getattr(one.history, name), getattr(other.history, name), rtol=1e-12)
    assert (one.seed, one.status, one.schedule, one.grid) == (other.seed, other.status, other.schedule, other.grid)


def test_one_after_another():
    pairs = [(TUBES.coefficients, TUBES.mass), (SPONGE.coefficients, SPONGE.mass)]
    flows = generate_batch(*zip(*pairs, strict=True), GRID, seeds=(3, 4), schedule=PLAN)
    for flow, (a, mass), seed in zip(flows, pairs, (3, 4), strict=True):
        assert_same(flow, generate(a, mass, GRID, seed=seed, schedule=PLAN))


def test_one_for_all():
    flows = list(generate_batch(TUBES.coefficients, TUBES.mass, GRID, seeds=range(3), schedule=PLAN))
    assert [flow.seed for flow in flows] == [0, 1, 2]
    assert float((flows[0].field - flows[1].field).abs().max()) > 0.1
    field = torch.full(GRID.shape, -0.5)
    (flow,) = generate_batch(TUBES.coefficients, field, GRID, schedule=PLAN)
    assert flow.mass == pytest.approx(-0.5, abs=1e-6)


def test_the_mass_is_the_law_s_own():
    flows = generate_batch(["tubes", SPONGE], grid=GRID, seeds=(3, 4), schedule=PLAN)
    for flow, known, seed in zip(flows, (TUBES, SPONGE), (3, 4), strict=True):
        assert_same(flow, generate(known.coefficients, known.mass, GRID, seed=seed, schedule=PLAN))
    with pytest.raises(ValueError, match="mass"):
        next(generate_batch(TUBES.coefficients, grid=GRID, schedule=PLAN))


def test_lengths_that_differ_are_refused_at_once():
    with pytest.raises(ValueError, match="length"):
        generate_batch(TUBES.coefficients, (-0.5, -0.4), GRID, seeds=(1, 2, 3))
    with pytest.raises(ValueError, match="length"):
        generate_batch(TUBES.coefficients, -0.5, GRID, seeds=())
    with pytest.raises(ValueError, match="at least one"):
        generate_batch(TUBES.coefficients, -0.5, GRID, together=0, backend="torch")


@pytest.mark.parametrize("varying", [False, True])
def test_shapes_that_share_steps_are_the_same(varying):
    """In plain torch several shapes advance in the same steps, some of them stopped early, and none meets another."""
    area = Coefficients(1, 2, 1, 0, 0, 5000)
    laws = [TUBES.coefficients, area, SPONGE.coefficients]
    if varying:
        laws[0] = Coefficients(torch.linspace(1, 2, 12).reshape(12, 1, 1), *list(TUBES.coefficients)[1:])
    masses = [-0.5, -0.75, -0.25]
    options = {"schedule": PLAN, "reject_early": True, "backend": "torch"}
    flows = list(generate_batch(laws, masses, GRID, seeds=range(3), together=2, **options))
    assert len({flow.status for flow in flows}) > 1
    for flow, a, mass in zip(flows, laws, masses, strict=True):
        assert_same(flow, generate(a, mass, GRID, seed=flow.seed, **options))
        assert flow.coefficients is a
