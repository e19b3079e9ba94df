"""Many shapes: each is the one that `generate` makes; and the step in plain torch."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from kernel_cases import BLUR, EPSILON, assert_same

from curvafit.generation.cost import Cost
from curvafit.generation.flow import generate, generate_batch
from curvafit.generation.forms import DivergenceForm
from curvafit.generation.schedule import Schedule
from curvafit.generation.stepper import TorchStepper
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

ROOT = Path(__file__).resolve().parents[2]
GRID, PLAN = Grid((12, 13, 14)), Schedule("test", 45, 1e-2, 1e-3, "cosine")
TUBES, SPONGE = preset("tubes"), preset("sponge")


@pytest.mark.parametrize(
    "stated",
    [(["tubes", SPONGE],), ((TUBES.coefficients, SPONGE.coefficients), (TUBES.mass, SPONGE.mass))],
    ids=["the laws' own masses", "masses"],
)
def test_one_after_another(stated):
    flows = generate_batch(*stated, grid=GRID, seeds=(3, 4), schedule=PLAN)
    for flow, law, seed in zip(flows, (TUBES, SPONGE), (3, 4), strict=True):
        assert_same(flow, generate(law.coefficients, law.mass, GRID, seed=seed, schedule=PLAN))


def test_one_for_all():
    flows = list(generate_batch(TUBES.coefficients, TUBES.mass, GRID, seeds=range(3), schedule=PLAN))
    assert [flow.seed for flow in flows] == [0, 1, 2]
    assert float((flows[0].field - flows[1].field).abs().max()) > 0.1
    (flow,) = generate_batch(TUBES.coefficients, torch.full(GRID.shape, -0.5), GRID, schedule=PLAN)
    assert flow.mass == pytest.approx(-0.5, abs=1e-6)
    with pytest.raises(ValueError, match="mass"):
        next(generate_batch(TUBES.coefficients, grid=GRID, schedule=PLAN))


# ---- the step in plain torch, for any device -------------------------------------------------------------------------


def test_the_step_and_its_run_read_nothing_from_the_device() -> None:
    """On the device "meta" nothing can be read: a step that waits for a number fails there."""
    grid = Grid((8, 9, 10))
    start, form = torch.zeros(3, *grid.shape), DivergenceForm(grid, BLUR, -0.6)
    cost = Cost(TUBES.coefficients, grid, EPSILON, None, BLUR)
    stepper = TorchStepper(start, form, cost, (0.9, 0.999), None, "meta")
    stepper.run([1e-3, 2e-3])
    assert stepper.state()["parameters"].shape == (3, *grid.shape)
