"""The data term of a flow: its gradient, what it means, and runs that it belongs to."""

from __future__ import annotations

import math
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from curvafit.generation.checkpoint import identity
from curvafit.generation.data import Evidence, Hinge
from curvafit.generation.flow import descend
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.profile import optimal_profile
from curvafit.segmentation.evidence import probability_evidence
from curvafit.segmentation.reconstruct import reconstruct
from curvafit.segmentation.refine import refine
from curvafit.volumes.field import Field

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

WILLMORE = Coefficients.willmore()
GRID = Grid((8, 9, 10), (0.01, 0.012, 0.02), "replicate")


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("kind", [Evidence, Hinge, partial(Hinge, margin=0.2)])
def test_a_data_term_s_gradient(kind) -> None:
    term, u, way = kind(drawn(8, 9, 10)), 1.2 * drawn(8, 9, 10, seed=1), drawn(8, 9, 10, seed=2)
    step = 1e-5
    ahead, behind = (term.slope(u + sign * step * way, GRID)[0] for sign in (1, -1))
    _, slope = term.slope(u, GRID)
    assert (ahead - behind) / (2 * step) == pytest.approx(float((slope * way).sum()), rel=1e-7)


def test_evidence_of_a_mask_is_its_log_likelihood() -> None:
    r, inside = drawn(8, 9, 10), drawn(8, 9, 10, seed=1) > 0
    values = [Evidence(r).slope(torch.where(m, 1.0, -1.0).double(), GRID)[0] for m in (inside, ~inside)]
    gained = float((r * torch.where(inside, 1.0, -1.0)).sum()) * GRID.voxel_volume
    assert values[1] - values[0] == pytest.approx(gained, rel=1e-12)


def test_a_hinge_lets_go_where_it_is_right() -> None:
    ratio, near, short = (torch.full((8, 9, 10), each) for each in (-3.0, -1.1, -0.3))
    for margin, u in ((1.0, near), (0.2, short)):
        value, slope = Hinge(ratio, margin).slope(u, GRID)
        assert value == 0 and not slope.any()
    assert Hinge(ratio).slope(short, GRID)[0] > 0 and Hinge(ratio, 0.2).to("cpu").margin == 0.2
    with pytest.raises(ValueError, match="a margin from 0 to 1"):
        Hinge(ratio, 2.0)


@pytest.mark.parametrize("bad", [torch.full((4, 4, 4), math.nan), torch.zeros(4, 4)])
def test_bad_evidence_is_refused(bad) -> None:
    for kind in (Evidence, Hinge):
        with pytest.raises(ValueError, match="evidence"):
            kind(bad)


def test_evidence_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="ratio"):
        descend(torch.zeros(8, 8, 8), WILLMORE, Grid(8), data=Evidence(torch.ones(7, 8, 8)), steps=1)  # type: ignore[arg-type]


@pytest.mark.parametrize(("flow", "optimiser"), [("l2", "lbfgs"), ("l2", "adam"), ("h-1", "adam")])
def test_every_flow_lowers_energy_and_data_as_plain_torch_does(flow, optimiser) -> None:
    """Adam voxel by voxel. L-BFGS in the energy reached: its line search hangs on the energies' last digits, and
    near the minimum what two searches leave is of second order in what parts them."""
    grid = Grid((12, 12, 12), boundary="replicate")
    start = optimal_profile(0.04 - torch.from_numpy(np.linalg.norm(np.mgrid[:12, :12, :12] - 5.5, axis=0)) * 0.01, 0.02)
    term = Evidence(1e6 * drawn(12, 12, 12))
    options = {"flow": flow, "optimiser": optimiser, "steps": 10, "schedule": "paper", "data": term}
    fast, plain = (descend(start, WILLMORE, grid, backend=each, **options) for each in ("auto", "torch"))
    fall = fast.history.energy[0] - fast.history.energy[-1]
    assert fall > 0
    if optimiser == "adam":
        torch.testing.assert_close(fast.field, plain.field, atol=2e-3, rtol=0)
    else:
        assert abs(fast.history.energy[-1] - plain.history.energy[-1]) < 0.01 * fall
    without = descend(start, WILLMORE, grid, **{**options, "data": None})
    assert not torch.allclose(without.field, fast.field, atol=1e-3)


def test_a_checkpoint_is_its_data_s(tmp_path: Path) -> None:
    one, same, other = (identity(data=Evidence(drawn(4, 4, 4, seed=k))) for k in (0, 0, 1))
    assert one == same != other
    assert one != identity(data=Hinge(drawn(4, 4, 4))) and one != identity(data=None)
    path = tmp_path / "run.pt"
    options = {"steps": 20, "checkpoint": path, "checkpoint_every": 0.0, "optimiser": "adam"}
    start, stop = 0.5 * drawn(8, 8, 8), [lambda made, total, state: made >= 10]
    descend(start, WILLMORE, Grid(8), data=Evidence(drawn(8, 8, 8)), callbacks=stop, **options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="checkpoint"):
        descend(start, WILLMORE, Grid(8), data=Evidence(2 * drawn(8, 8, 8)), **options)
    resumed = descend(start, WILLMORE, Grid(8), data=Evidence(drawn(8, 8, 8)), **options)
    whole = descend(start, WILLMORE, Grid(8), data=Evidence(drawn(8, 8, 8)), **{**options, "checkpoint": None})
    assert torch.equal(resumed.field, whole.field)


# ---- terms on grids that are not the scan's --------------------------------------------------------------------------


#: A grid whose axes all differ, and a ball of radius 7 in it: its signed distance, positive inside.
SHAPE, EDGES = (9, 21, 13), (3.0, 1.0, 1.5)
PLACES = np.meshgrid(*((np.arange(n) - (n - 1) / 2) * h for n, h in zip(SHAPE, EDGES, strict=True)), indexing="ij")
DISTANCE = 7 - np.linalg.norm(PLACES, axis=0)


@pytest.mark.parametrize("along", [0, 1, 2])
def test_known_slices_hold_whatever_the_axis_and_the_spacing(along: int) -> None:
    """The array turned, its spacing with it: nearly the same field, though the network that it starts from knows slices
    from their transposes; and at an ε of our own near the profile of that ε."""
    known, ε, fields = list(range(0, SHAPE[along], (2, 4, 3)[along])), 3.0, []
    for turn in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        truth = Field((DISTANCE > 0).transpose(turn), tuple(EDGES[k] for k in turn))  # type: ignore[arg-type]
        found = reconstruct(truth, WILLMORE, known=known, axis=turn.index(along), epsilon=ε, steps=8, stiffness=1e7)
        assert found.epsilon == ε and any("2-fold" in note for note in found.notes)
        fields.append(found.phase.values.transpose(np.argsort(turn)))
    for other in fields[1:]:
        np.testing.assert_allclose(other, fields[0], atol=0.05)
    assert np.abs(fields[0] - np.tanh(DISTANCE / (math.sqrt(2) * ε))).mean() < 0.1  # 0.15 at the ε of two voxels


@pytest.mark.slow
@pytest.mark.parametrize("epsilon", [1.0, 2.0, 5.0])
def test_evidence_counts_its_nats_once_whatever_the_volume_of_a_part(epsilon: float, monkeypatch) -> None:
    gained = []

    def watched(start, law, grid, *, data, **options):
        ends = [data.slope(torch.full(grid.shape, side), grid)[0] for side in (1.0, -1.0)]
        gained.append(ends[1] - ends[0])
        return descend(start, law, grid, data=data, **options)

    monkeypatch.setattr(import_module("curvafit.segmentation.engine"), "descend", watched)
    noise = np.random.default_rng(0).standard_normal(SHAPE)
    likely = Field((1 / (1 + np.exp(-DISTANCE - noise))).astype(np.float32), EDGES)
    law = Coefficients(1.5, 0.5, 2.5)
    found = refine(likely, law, weight=0.3, epsilon=epsilon, steps=1)
    assert found.epsilon == epsilon
    nats = float(probability_evidence(likely).ratio.sum(dtype=np.float64))
    assert 0.3 * 2 * gained[0] == pytest.approx(nats, rel=1e-4)  # λ times the stiffness, 0.3 (1.5 + 2.5) / 2
