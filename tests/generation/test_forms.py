"""The forms of a field, and data terms: adjoints, laws, and the flows that move them."""

import math
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from loss_cases import noise

from curvafit.generation import stepper
from curvafit.generation.flow import Execution, descend
from curvafit.generation.loop import identity
from curvafit.generation.problem import Cost, DirectForm, DivergenceForm, Evidence, Hinge
from curvafit.generation.schedule import Schedule
from curvafit.generation.stepper import LbfgsStepper, TorchStepper
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energies import energy
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.priors.profile import SIGMA, optimal_profile
from curvafit.priors.stencils import gaussian_blur
from curvafit.segmentation.evidence import probability_evidence
from curvafit.segmentation.flow import Working
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.segmentation import segment
from curvafit.volumes.volume import Volume

boundaries = pytest.mark.parametrize("boundary", ["periodic", "replicate"])
ANISOTROPIC = (0.013, 0.01, 0.008)
TUBES, WILLMORE = preset("tubes").coefficients, Coefficients.willmore()


def ball(grid: Grid, radius: float, epsilon: float) -> torch.Tensor:
    axes = [h * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) for n, h in zip(grid.shape, grid.spacing)]  # noqa: B905
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return optimal_profile(radius - (z**2 + y**2 + x**2).sqrt(), epsilon).float()


#: Forms that start at a field, and their parameters there.
FORMS = {
    "h-1": lambda field, grid: (DivergenceForm.of(grid, 0.012, field), field.new_zeros((3, *grid.shape))),
    "l2": lambda field, grid: (DirectForm(grid, 0.012), field),
}


@pytest.mark.parametrize("name", FORMS)
@boundaries
def test_pullback_is_the_adjoint_and_a_form_starts_at_the_blurred_field(boundary, name):
    """⟨u(p) - u(0), g⟩ = ⟨p, pullback(g)⟩; the mass of a divergence is its own."""
    grid = Grid((6, 9, 7), ANISOTROPIC, boundary)
    field = noise(*grid.shape)
    form, start = FORMS[name](field, grid)
    torch.testing.assert_close(form.field(start), gaussian_blur(field, grid, 0.012), rtol=1e-10, atol=1e-12)
    parameters, slope = noise(*start.shape, seed=1), noise(*grid.shape, seed=2)
    moved = form.field(parameters) - form.field(torch.zeros_like(start))
    there, back = float((moved * slope).sum()), float((parameters * form.pullback(slope)).sum())
    assert abs(there) > 1e-2
    assert there == pytest.approx(back, rel=1e-11)
    u = DivergenceForm(grid, 0.012, -0.3).field(noise(3, *grid.shape))
    assert float(u.mean()) == pytest.approx(-0.3, abs=1e-12)


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
@boundaries
def test_every_flow_lowers_the_energy_and_keeps_what_it_keeps(boundary, method):
    grid = Grid((16, 17, 18), 0.01, boundary)
    start = ball(grid, 0.05, 0.02) + 0.1 * noise(*grid.shape).float()
    plan = Schedule("test", 1, 1e-3, 1e-3, "constant")
    end = descend(start, TUBES, grid, method=method, steps=30, schedule=plan)
    history = end.history
    assert history.step.tolist() == [0, 10, 20, 30]
    first = float(energy(gaussian_blur(start, grid, 0.01).double(), TUBES, grid, 0.02))
    assert history.energy[0] == pytest.approx(first, rel=1e-3)
    assert history.energy[-1] < (0.5 if method == "lbfgs" else 0.9) * first
    assert history.energy[-1] == pytest.approx(float(energy(end.field.double(), TUBES, grid, 0.02)), rel=1e-3)
    assert history.gradient_mean[-1] < history.gradient_mean[0]
    assert np.ptp(history.mass) > 1e-3
    assert end.mass == history.mass[-1]
    assert end.schedule.steps == 30


def test_willmore_flow_of_a_wide_ball_is_a_sphere():
    """16π in the limit ε → 0. The profile, a third too wide at first, is mended."""
    grid, ε = Grid((40, 40, 40), 0.01, "replicate"), 0.02
    end = descend(ball(grid, 0.12, 1.3 * ε), WILLMORE, grid, steps=60, epsilon=ε)
    assert end.history.energy[0] / SIGMA > 100
    assert end.history.energy[-1] / SIGMA == pytest.approx(16 * math.pi, rel=0.02)
    assert end.viability.discrepancy < 0.05


def test_lbfgs_stalls_where_nothing_is_lower(monkeypatch):
    """At the minimum of |u|²/2 - 10, which float32 reaches exactly."""
    count = []

    def bowl(u, *cost):
        count.append(1)
        return float(u.double().square().sum()) / 2 - 10, u.clone()

    monkeypatch.setattr(stepper, "energy_gradient", bowl)
    start = noise(4, 4, 4).float()
    cost = Cost(TUBES, Grid((4, 4, 4)), 0.02, None, 0.0)
    moved = LbfgsStepper(start, DirectForm(cost.grid, 0.0), cost, (0.9, 0.999), "cpu")
    moved.run([1.0] * 30)
    assert moved.stalled
    assert moved.statistics().energy == pytest.approx(-10, abs=1e-6)
    assert len(count) < 100


def test_without_a_blur_the_field_is_what_moves():
    """The field seen is the one before the step, also where it is the parameters themselves."""
    grid, fields = Grid((12, 12, 12)), []
    start, watch = ball(grid, 0.04, 0.02), lambda step, total, state: fields.append(state.field.clone())
    end = descend(start, WILLMORE, grid, method="adam", steps=10, blur=0.0, callbacks=[watch])
    assert torch.equal(fields[0], start)
    assert end.history.energy[-1] < end.history.energy[0]


# ---- data terms: their gradient, what they mean, and runs that they belong to ----------------------------------------


pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")

GRID = Grid((8, 9, 10), (0.01, 0.012, 0.02), "replicate")


@pytest.mark.parametrize("kind", [Evidence, Hinge, partial(Hinge, margin=0.2)])
def test_a_data_term_s_gradient(kind) -> None:
    term, u, way = kind(noise(8, 9, 10)), 1.2 * noise(8, 9, 10, seed=1), noise(8, 9, 10, seed=2)
    step = 1e-5
    ahead, behind = (term.slope(u + sign * step * way, GRID)[0] for sign in (1, -1))
    _, slope = term.slope(u, GRID)
    assert (ahead - behind) / (2 * step) == pytest.approx(float((slope * way).sum()), rel=1e-7)


def test_evidence_of_a_mask_is_its_log_likelihood() -> None:
    r, inside = noise(8, 9, 10), noise(8, 9, 10, seed=1) > 0
    values = [Evidence(r).slope(torch.where(m, 1.0, -1.0).double(), GRID)[0] for m in (inside, ~inside)]
    gained = float((r * torch.where(inside, 1.0, -1.0)).sum()) * GRID.voxel_volume
    assert values[1] - values[0] == pytest.approx(gained, rel=1e-12)


def test_a_hinge_lets_go_where_it_is_right() -> None:
    ratio, near, short = (torch.full((8, 9, 10), each) for each in (-3.0, -1.1, -0.3))
    for margin, u in ((1.0, near), (0.2, short)):
        value, slope = Hinge(ratio, margin).slope(u, GRID)
        assert value == 0 and not slope.any()
    assert Hinge(ratio).slope(short, GRID)[0] > 0 and Hinge(ratio, 0.2).to("cpu").margin == 0.2


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
def test_every_flow_lowers_energy_and_data_as_plain_torch_does(method, monkeypatch) -> None:
    """Adam voxel by voxel. L-BFGS in the energy reached: its line search hangs on the energies' last digits, and
    near the minimum what two searches leave is of second order in what parts them."""
    grid = Grid((12, 12, 12), boundary="replicate")
    start = optimal_profile(0.04 - torch.from_numpy(np.linalg.norm(np.mgrid[:12, :12, :12] - 5.5, axis=0)) * 0.01, 0.02)
    term = Evidence(1e6 * noise(12, 12, 12))
    lower = partial(descend, start, WILLMORE, grid, method=method, steps=10, schedule="paper")
    fast, without = lower(data=term), lower()
    assert not torch.allclose(without.field, fast.field, atol=1e-3)
    monkeypatch.setattr(kernels, "has_kernel", lambda device: False)
    plain = lower(data=term)
    fall = fast.history.energy[0] - fast.history.energy[-1]
    assert fall > 0
    if method == "adam":
        torch.testing.assert_close(fast.field, plain.field, atol=2e-3, rtol=0)
    else:
        assert abs(fast.history.energy[-1] - plain.history.energy[-1]) < 0.01 * fall


def test_a_checkpoint_is_its_data_s(tmp_path: Path) -> None:
    one, same, other = (identity(data=Evidence(noise(4, 4, 4, seed=k))) for k in (0, 0, 1))
    assert one == same != other
    assert one != identity(data=Hinge(noise(4, 4, 4))) and one != identity(data=None)
    r, saved = noise(8, 8, 8), {"execution": Execution(checkpoint=tmp_path / "run.pt", checkpoint_every=0.0)}
    run = partial(descend, 0.5 * r, WILLMORE, Grid(8), method="adam", steps=20)  # type: ignore[arg-type]
    run(data=Evidence(r), callbacks=[lambda made, total, state: made >= 10], **saved)
    with pytest.raises(ValueError, match="checkpoint"):
        run(data=Evidence(2 * r), **saved)
    assert torch.equal(run(data=Evidence(r), **saved).field, run(data=Evidence(r)).field)


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
        truth = Volume((DISTANCE > 0).transpose(turn), tuple(EDGES[k] for k in turn))  # type: ignore[arg-type]
        found = reconstruct(
            truth, WILLMORE, known=known, axis=turn.index(along), working=Working(epsilon=ε, steps=8, stiffness=1e7)
        )
        assert found.epsilon == ε and any("2-fold" in note for note in found.notes)
        kept = (found.mask.values == truth.values).all(tuple(k for k in range(3) if k != turn.index(along)))
        assert kept[known].all()
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

    monkeypatch.setattr(import_module("curvafit.segmentation.flow"), "descend", watched)
    errors = np.random.default_rng(0).standard_normal(SHAPE)
    likely = Volume((1 / (1 + np.exp(-DISTANCE - errors))).astype(np.float32), EDGES)
    law = Coefficients(1.5, 0.5, 2.5)
    found = segment(likely, law, weight=0.3, probabilities=True, working=Working(epsilon=epsilon, steps=1))
    assert found.epsilon == epsilon
    nats = float(probability_evidence(likely).ratio.sum(dtype=np.float64))
    assert 0.3 * 2 * gained[0] == pytest.approx(nats, rel=1e-4)  # λ times the stiffness, 0.3 (1.5 + 2.5) / 2


def test_the_step_and_its_run_read_nothing_from_the_device() -> None:
    """On the device "meta" nothing can be read: a step that waits for a number fails there."""
    grid = Grid((8, 9, 10))
    start, form = torch.zeros(3, *grid.shape), DivergenceForm(grid, 0.01, -0.6)
    cost = Cost(TUBES, grid, 0.02, None, 0.01)
    stepper = TorchStepper(start, form, cost, (0.9, 0.999), "meta")
    stepper.run([1e-3, 2e-3])
    assert stepper.state()["parameters"].shape == (3, *grid.shape)
