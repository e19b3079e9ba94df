"""A flow whose energy, gradient or field is not finite is no shape, whatever its field looks like: and it says so."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from calling import LAW, call
from exact import Sphere, centres
from kernel_cases import relax
from torch import Tensor

from curvafit.data_synth import atlas
from curvafit.data_synth.store import open_store
from curvafit.generation import SCHEDULES, Schedule, descend
from curvafit.generation.loop import Run
from curvafit.generation.problem import Cost
from curvafit.generation.result import viability
from curvafit.generation.stepper import Statistics, Stepper
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.priors.profile import optimal_profile

TUBES, MASS = preset("tubes").coefficients, preset("tubes").mass
GRID = Grid((26, 26, 26))
COST = Cost(TUBES, GRID, 0.02, None, 0.02)
RUNAWAY = Schedule("fast", 60, 1e6, 1e6, "constant")


def ball() -> Tensor:
    return optimal_profile(Sphere(0.08, (0.13,) * 3).distance(centres(GRID)), 0.02).float()


class Seen(Stepper):
    """A shape that never moves, with figures that are told."""

    def __init__(self, figures: dict[int, Statistics], mass: float = 0.0) -> None:
        self._figures, self._mass, self._made = figures, mass, -1

    def step(self, rate: float | None) -> None:
        self._made += 1

    def statistics(self) -> Statistics:
        return self._figures.get(self._made, Statistics(1.0, 1.0, 1.0))

    def field(self) -> Tensor:
        return ball()

    def mass(self) -> float:
        return self._mass

    def shift(self, amount: float) -> None:
        raise AssertionError("no share of volume is asked for")


@pytest.mark.parametrize("bad", [math.inf, -math.inf, math.nan])
@pytest.mark.parametrize("step", [0, 10, 20])
@pytest.mark.parametrize("part", ["energy", "gradient", "field"])
def test_figures_that_are_not_finite_end_a_flow(part: str, step: int, bad: float) -> None:
    assert viability(ball(), GRID, 0.02).viable
    good, plan = Statistics(1.0, 1.0, 1.0), Schedule("x", 20, 1e-3, 1e-3, "constant")
    fine = Run(Seen({}), COST, plan).flow()
    assert fine.finite and fine.viability.viable
    figures = {"energy": good._replace(energy=bad), "gradient": good._replace(gradient_max=bad)}
    flow = Run(Seen({step: figures.get(part, good)}, bad if part == "field" else 0.0), COST, plan).flow()
    at = 0 if part == "field" else step
    assert not flow.finite and not flow.viability.viable
    assert flow.viability.reason == f"the {part} is not finite"
    assert flow.status == f"stopped after {at} of 20 steps: the {part} is not finite"


def test_every_flow_tells_of_a_field_too_large_for_float32(backend) -> None:
    """Its energy is finite in float64."""
    huge = 1e30 * ball()
    lowered = [descend(huge, TUBES, GRID, method=method, steps=3) for method in ("lbfgs", "adam")]
    for flow in (relax(huge, TUBES, GRID, RUNAWAY), *lowered):
        assert "not finite" in flow.status and not flow.viability.viable and not flow.finite
        assert flow.history.step[-1] < flow.schedule.steps


def test_the_command_writes_nothing_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCHEDULES, "fast", RUNAWAY)
    result = call("generate", *LAW, "--shape", "12", "-o", tmp_path / "out.npy", "--checkpoint", tmp_path / "c.pt")
    assert result.exit_code == 1, (result.output, result.exception)
    assert result.stdout == "" and "not finite; nothing was written" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_atlas_records_it_as_not_viable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(atlas, "BARREN", 1)
    with pytest.raises(ValueError, match="not finite"):
        atlas.build(tmp_path / "s", 1, 12, schedule=RUNAWAY)
    store = open_store(tmp_path / "s")
    records = [store.record(index) for index in store.indices()]
    assert [record.viability.viable for record in records] == [False, False]
    assert all("not finite" in record.viability.reason and not np.isfinite(record.energy) for record in records)
    assert torch.isfinite(torch.tensor([record.mass for record in records])).all()
