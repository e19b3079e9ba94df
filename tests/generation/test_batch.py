"""Many shapes: each is the one that `generate` makes, whether they share their steps or not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch

from curvafit.generation.batch import generate_batch
from curvafit.generation.flow import generate
from curvafit.generation.fused import together
from curvafit.generation.schedule import Schedule
from curvafit.priors.coefficients import Coefficients, preset
from curvafit.priors.grid import Grid
from curvafit.priors.kernels import cuda

GRID, PLAN = Grid((12, 13, 14)), Schedule("test", 45, 1e-2, 1e-3, "cosine")
TUBES, SPONGE = preset("tubes"), preset("sponge")


def assert_same(one, other) -> None:
    assert torch.equal(one.field, other.field)
    for name in ("step", "energy", "gradient_max", "gradient_mean", "mass"):
        np.testing.assert_allclose(getattr(one.history, name), getattr(other.history, name), rtol=1e-12)
    assert (one.seed, one.status, one.schedule, one.grid) == (other.seed, other.status, other.schedule, other.grid)
    assert one.snapshots.keys() == other.snapshots.keys()


def test_parameters_that_vary_stand_beside_some_that_do_not():
    """Also where a box has six voxels along x, as many as there are coefficients."""
    a = SPONGE.coefficients
    varying = Coefficients(torch.full((4, 5, 6), 7.0), *list(a)[1:])
    both = together((TUBES.coefficients, varying), Grid((4, 5, 6)))
    assert both.shape == (2, 6, 4, 5, 6)
    for one, stated in zip(both, ([*TUBES.coefficients], [7.0, *list(a)[1:]]), strict=True):
        assert torch.equal(one, torch.tensor(stated, dtype=one.dtype).reshape(6, 1, 1, 1).expand(6, 4, 5, 6))
    assert together((a, a), Grid((4, 5, 6))).shape == (2, 6)


def test_one_after_another():
    pairs = [(TUBES.coefficients, TUBES.mass), (SPONGE.coefficients, SPONGE.mass)]
    flows = generate_batch(*zip(*pairs, strict=True), GRID, seeds=(3, 4), schedule=PLAN, snapshots=(7,))
    for flow, (a, mass), seed in zip(flows, pairs, (3, 4), strict=True):
        assert_same(flow, generate(a, mass, GRID, seed=seed, schedule=PLAN, snapshots=(7,)))


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
    with pytest.raises(ValueError, match="expected a mass or a volume fraction, got neither"):
        next(generate_batch(TUBES.coefficients, grid=GRID, schedule=PLAN))


def test_lengths_that_differ_are_refused_at_once():
    with pytest.raises(ValueError, match="of one length, or one for all, got 1, 2, 3"):
        generate_batch(TUBES.coefficients, (-0.5, -0.4), GRID, seeds=(1, 2, 3))
    with pytest.raises(ValueError, match="of one length, or one for all, got 1, 1, 0"):
        generate_batch(TUBES.coefficients, -0.5, GRID, seeds=())
    with pytest.raises(ValueError, match="expected at least one shape at a time, got 0"):
        generate_batch(TUBES.coefficients, -0.5, GRID, together=0)


class _Figures(NamedTuple):
    energy: torch.Tensor
    gradient_max: torch.Tensor
    gradient_mean: torch.Tensor


class _Imitation:
    """What `CudaFlow` does, by one `FusedFlow` a shape."""

    batches: list[int] = []  # noqa: RUF012

    def __init__(self, start, base, a, grid, epsilon, width, frozen=None, *, orientation, betas, adam_eps, device):
        from curvafit.priors.kernels.cpu import FusedFlow

        assert (start.shape[1:], base.shape[0], a.shape[0]) == ((3, *grid.shape), len(start), len(start))
        self.batches.append(len(start))
        rows = zip(start.numpy(), base.double().numpy(), a.tolist(), strict=True)
        self._flows = [
            FusedFlow(A, m, row, grid, epsilon, width, frozen, betas=betas, adam_eps=adam_eps) for A, m, row in rows
        ]

    def run(self, rates, observe=False):
        for rate in rates:
            self._seen = [(flow.evaluate(), *flow.update(rate)) for flow in self._flows]

    def observe(self):
        self.run([0.0])

    def statistics(self):
        return _Figures(*torch.tensor(self._seen, dtype=torch.float64).T)

    @property
    def field(self):
        return torch.stack([torch.from_numpy(flow.field.copy()) for flow in self._flows])


def test_shapes_that_share_steps_are_the_same(monkeypatch):
    """On a device they share a stepper and the loop. An imitation on the processor shows that nothing is mixed up."""
    pytest.importorskip("numba")
    monkeypatch.setattr(cuda, "available", lambda device: True)
    monkeypatch.setattr(cuda, "CudaFlow", _Imitation)
    area = Coefficients(1, 2, 1, 0, 0, 5000)
    each = [TUBES.coefficients, area, SPONGE.coefficients, TUBES.coefficients, SPONGE.coefficients]
    masses = [-0.5, -0.75, -0.25, -0.625, -0.375]
    told = {"schedule": PLAN, "reject_early": True, "snapshots": (7,)}
    _Imitation.batches.clear()
    flows = list(generate_batch(each, masses, GRID, seeds=range(5), together=3, device="cuda", **told))
    assert _Imitation.batches == [3, 2]
    assert len({flow.status for flow in flows}) > 1
    for flow, a, mass in zip(flows, each, masses, strict=True):
        assert_same(flow, generate(a, mass, GRID, seed=flow.seed, **told))
