"""The flow: what it keeps, what it lowers, when it stops, and that its two ways of stepping are one."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from exact import Sphere, centres
from found import made_fit
from kernel_cases import relax, short

from curvafit.generation import loop
from curvafit.generation.flow import choose_base, generate
from curvafit.generation.loop import first_mass
from curvafit.generation.problem import DivergenceForm, white_noise
from curvafit.generation.result import RECORD_EVERY, viability
from curvafit.generation.schedule import SCHEDULES, Phase, Schedule, choose_schedule, schedule
from curvafit.geometry.topology import betti_numbers
from curvafit.priors import kernels
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energies import energy, energy_gradient_by_autograd, orientation, turn_slope
from curvafit.priors.grid import Grid
from curvafit.priors.law import Law, preset
from curvafit.priors.profile import optimal_profile, phase_field
from curvafit.priors.stencils import divergence, gaussian_blur, gradient

TUBES, MASS = preset("tubes").coefficients, preset("tubes").mass
EPSILON = BLUR = 0.02
backends = pytest.mark.usefixtures("backend")
boundaries = pytest.mark.parametrize("boundary", ["periodic", "replicate"])


def gyroid(grid: Grid) -> torch.Tensor:
    """A smooth field that has no flat phase, where rounding would decide the gradient's direction."""
    axes = (2 * math.pi * (torch.arange(n, dtype=torch.float64) + 0.5) / n for n in grid.shape)
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return (torch.sin(z) * torch.cos(y) + torch.sin(y) * torch.cos(x) + torch.sin(x) * torch.cos(z)).float()


@backends
@boundaries
def test_mass_is_exact_the_energy_falls_and_history_tells_it(boundary):
    grid = Grid((16, 18, 20), 0.01, boundary)
    flow = generate(TUBES, MASS, grid, schedule=short(75))
    history = flow.history
    assert history.step.tolist() == [*range(0, 80, RECORD_EVERY), 75]
    assert np.abs(history.mass - MASS).max() < 1e-6
    assert float(flow.field.double().mean()) == pytest.approx(MASS, abs=1e-6)
    assert history.energy[-1] < 0.2 * history.energy[0]
    assert history.gradient_mean[-1] < 0.5 * history.gradient_mean[0]
    assert (history.gradient_max >= history.gradient_mean).all()
    assert history.energy[-1] == pytest.approx(float(energy(flow.field.double(), TUBES, grid, EPSILON)), rel=1e-4)


def test_backends_agree_step_by_step(monkeypatch):
    """From a field without flat phases the two stay together over twenty steps to some 1e-5 of what moves. (Later, and
    at once from noise, rounding decides the direction where X is near zero, and any two float32 programs part.)"""
    grid, plan = Grid((20, 22, 24)), Schedule("test", 20, 1e-3, 1e-3, "constant")
    fused = relax(gyroid(grid), TUBES, grid, plan)
    monkeypatch.setattr(kernels, "has_kernel", lambda device: False)
    plain = relax(gyroid(grid), TUBES, grid, plan)
    moved = float((plain.field - gaussian_blur(gyroid(grid), grid, BLUR)).abs().max())
    assert moved > 0.1
    assert float((plain.field - fused.field).abs().max()) < 1e-4 * moved
    # Energies part by the fields' distance times the slope: by that share of what the energy falls by.
    fall = float(np.ptp(plain.history.energy))
    assert np.allclose(plain.history.energy, fused.history.energy, rtol=0, atol=1e-5 * fall)
    assert np.allclose(plain.history.gradient_mean, fused.history.gradient_mean, rtol=1e-3)


@backends
def test_a_seed_is_a_shape():
    torch.manual_seed(0)
    first, other = (generate(TUBES, MASS, (12, 13, 14), schedule=short(20), seed=k) for k in (3, 4))
    torch.rand(7)
    state = torch.get_rng_state()
    again = generate(TUBES, MASS, (12, 13, 14), schedule=short(20), seed=3)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(first.field, again.field)
    assert first.seed == 3
    assert float((first.field - other.field).abs().max()) > 0.1


def test_start_is_the_published_one():
    noise = white_noise(Grid((30, 31, 32)), 0)
    assert noise.dtype == torch.float32
    assert noise.shape == (3, 30, 31, 32)
    assert 0 <= float(noise.min()) < 1e-3 < 0.399 < float(noise.max()) < 0.4
    assert float(noise.mean()) == pytest.approx(0.2, abs=1e-3)
    assert abs(float(white_noise(Grid((30, 31, 32), 0.01, "replicate"), 0).mean())) < 1e-3  # type: ignore[arg-type]


@backends
def test_callbacks_see_and_stop():
    """Each tenth field, from the published start on, and the end; to watch changes nothing."""
    grid, seen, fields = Grid((12, 13, 14)), [], {}

    def watch(step, total, state):
        seen.append((step, total, state.energy, float(state.field.mean())))
        return step >= 20

    flow = generate(TUBES, MASS, grid, schedule=short(50), callbacks=[watch, lambda *_: None])
    assert [row[:2] for row in seen] == [(0, 50), (10, 50), (20, 50)]
    assert [row[2] for row in seen] == flow.history.energy.tolist()
    assert all(row[3] == pytest.approx(MASS, abs=1e-6) for row in seen)
    assert flow.status == "stopped by a callback after 20 of 50 steps"
    watched = [lambda step, total, state: fields.update({step: state.field})]
    flow = generate(TUBES, MASS, grid, schedule=short(15), callbacks=watched)
    assert [*fields] == [0, 10, 15] and torch.equal(fields[15], flow.field)
    assert torch.equal(flow.field, generate(TUBES, MASS, grid, schedule=short(15)).field)
    start = gaussian_blur(divergence(white_noise(grid, 0), grid), grid, BLUR) + MASS
    assert float((fields[0] - start).abs().max()) < 1e-5


@pytest.mark.parametrize(
    ("early", "steps", "said"),
    [(True, 100, "stopped after 100 of 200 steps: no inside"), (False, 200, "no shape after 200 steps")],
)
def test_early_rejection_saves_the_rest(early, steps, said):
    """A cost on area alone, from little mass, leaves no shape."""
    flow = generate(Coefficients(1, 2, 1, 0, 0, 5000), -0.75, 16, schedule=short(200, 3e-3), reject_early=early)
    assert flow.history.step[-1] == steps and not flow.viability.viable
    assert flow.status.startswith(said)


def test_viability_is_the_published_predicate():
    grid = Grid((32, 32, 32))
    ball = optimal_profile(Sphere(0.09, (0.16,) * 3).distance(centres(grid)), EPSILON)
    wave = 0.2 * torch.sin(2 * math.pi * centres(grid)[..., 0] / 0.32)
    for field, reason in (
        (ball, ""),
        (torch.full(grid.shape, -0.5), "no inside"),
        (torch.full(grid.shape, 0.5), "no outside"),
        (wave, "no interface profile"),
        (ball * math.nan, "not finite"),
    ):
        found = viability(field, grid, EPSILON)
        assert found.viable == (field is ball) == (found.reason == "")
        assert reason in found.reason


def test_schedules():
    paper, cosine = SCHEDULES["paper"], SCHEDULES["cosine"]
    assert (paper.steps, paper.rate(0), paper.rate(7999), paper.checks) == (8000, 1e-3, 1e-3, (500, 1000, 5000))
    assert paper.betas_at(0) == (0.9, 0.999)
    rates = [cosine.rate(step) for step in range(cosine.steps)]
    assert (rates[0], rates[-1]) == pytest.approx((cosine.start, cosine.stop))
    assert rates == sorted(rates, reverse=True)
    assert cosine.checks == (cosine.steps // 2,)
    assert schedule("paper", steps=700).checks == (500,)
    assert schedule(cosine) is cosine
    fit, tubes = made_fit().to_law(), preset("tubes")
    assert [choose_schedule(laws).name for laws in ((fit, fit), (tubes,), (fit, tubes))] == ["deep", "fast", "fast"]
    assert choose_schedule([fit], "paper").name == "paper"


#: 3 steps of 1e-3, 5 from 1e-3 to 2e-2, and 12 from 2e-2 to 1e-3, each with other decay rates.
PHASES = Schedule(
    "phases", 20, 2e-2, 1e-3, "cosine", 0.98, 0.99,
    (Phase(0.15, 1e-3, 1e-3, "constant"), Phase(0.25, 1e-3, 2e-2, "cosine", 0.95, 0.995)),
)  # fmt: skip


def test_phases_follow_each_other():
    assert PHASES.bounds == (3, 8)
    assert [PHASES.rate(step) for step in (0, 2, 3, 7, 8, 19)] == pytest.approx([1e-3, 1e-3, 1e-3, 2e-2, 2e-2, 1e-3])
    middle = (0.95, 0.995)
    assert [PHASES.betas_at(step) for step in (2, 3, 7, 8)] == [(0.9, 0.999), middle, middle, (0.98, 0.99)]
    assert dataclasses.replace(PHASES, steps=200).bounds == (30, 80)
    lengths = [dataclasses.replace(PHASES, steps=steps).rate(steps - 1) for steps in (1, 2, 3)]
    assert all(1e-3 <= length <= 2e-2 for length in lengths)
    fast, paper = SCHEDULES["fast"], SCHEDULES["paper"]
    assert fast.steps <= 1.5 * SCHEDULES["cosine"].steps
    assert fast.betas_at(0) == paper.betas_at(0) and fast.rate(fast.bounds[0] - 1) == paper.rate(0)


def test_records_hold_schedules():
    for plan in (*SCHEDULES.values(), PHASES):
        assert Schedule(**json.loads(json.dumps(plan.as_dict()))) == plan


@boundaries
def test_steps_are_those_of_torch_s_adam_bit_for_bit(boundary, monkeypatch):
    """Whose length and decay rates are set by hand before each step; on the processor."""
    monkeypatch.setattr(kernels, "has_kernel", lambda device: False)
    grid = Grid((8, 9, 10), boundary=boundary)
    form, vector = DivergenceForm(grid, 0.02, MASS), white_noise(grid, 3)
    adam = torch.optim.Adam([vector], eps=1e-2)
    for step in range(PHASES.steps):
        _, slope = energy_gradient_by_autograd(form.field(vector), TUBES, grid, 0.02)
        vector.grad = form.pullback(slope)
        adam.param_groups[0].update(lr=PHASES.rate(step), betas=PHASES.betas_at(step))
        adam.step()
    flow = generate(TUBES, MASS, grid, schedule=PHASES, seed=3)
    assert torch.equal(flow.field, form.field(vector))


@backends
@boundaries
def test_relax_starts_at_the_field(boundary):
    grid, fields = Grid((16, 17, 18), 0.01, boundary), []
    watch = [lambda step, total, state: fields.append(state.field.clone())]
    flow = generate(TUBES, gyroid(grid), grid, seed=None, schedule=short(20, 1e-3), callbacks=watch)
    assert float((fields[0] - gaussian_blur(gyroid(grid), grid, BLUR)).abs().max()) < 1e-5
    assert float((flow.field - fields[0]).abs().max()) > 0.01
    assert flow.history.energy[-1] < flow.history.energy[0]
    assert np.abs(flow.history.mass - float(gyroid(grid).double().mean())).max() < 1e-6
    assert flow.seed is None


def test_spontaneous_curvature_splits_a_disc():
    """Of one body come several, with its mass."""
    grid, law = Grid((40, 40, 40)), Coefficients.helfrich(2, 0, 40)
    z, y, x = centres(grid, origin=(-0.2, -0.2, -0.2)).unbind(-1)
    disc = phase_field((torch.hypot(z, y) < 0.15) & (x.abs() < 0.035), grid, EPSILON)
    flow = generate(law, disc, grid, seed=None, schedule=schedule("cosine", 400))
    assert flow.mass == pytest.approx(float(disc.double().mean()), abs=1e-6)
    assert [betti_numbers((u > 0).numpy())[0] > 1 for u in (disc, flow.field)] == [False, True]


def test_fast_makes_a_shape():
    """By the published predicate: which shape comes hangs on the processor. Ten seeds' ratios are 0.07 to 0.28 against
    its 0.75, their highest values 0.57 to 0.89 against its 0.1."""
    flow = generate(TUBES, MASS, Grid((24, 24, 24)), schedule=schedule("fast", steps=400))
    assert flow.viability.viable
    assert "after 400 steps" in flow.status


def test_every_law_grows_the_same_shape(tmp_path) -> None:
    """However it is stated, with its own mass unless another is."""
    brief, path, tubes = Schedule("brief", 3, 1e-3, 1e-3, "constant"), tmp_path / "fit.json", preset("tubes")
    fit = made_fit()
    path.write_text(fit.to_json(), encoding="utf-8")
    for law, same in ((fit, (fit, path, str(path), Law.load(path))), (tubes, ("tubes", "Tubes"))):
        stated = generate(law.coefficients, law.mass, 12, schedule=brief).field
        assert all(torch.equal(generate(each, grid=12, schedule=brief).field, stated) for each in same)
    assert generate("tubes", -0.3, (12, 10, 8), schedule=brief).mass == pytest.approx(-0.3, abs=1e-6)


# ---- what varies in space, and directions ----------------------------------------------------------------------------


@boundaries
def test_what_is_lowered_may_vary_in_space(boundary):
    """Fields that are constant are numbers; those that are not lower their own energy."""
    grid, ramp = Grid((12, 13, 14), 0.01, boundary), torch.linspace(1, 1.4, 14)
    ones = torch.ones(grid.shape)
    same = Coefficients(1, 2, 6 * ones, -40, -40 * ones[0], 400)
    there = generate(same, MASS, grid, schedule=short(2))
    here = generate(TUBES, MASS, grid, schedule=short(2))
    assert float((there.field - here.field).abs().mean()) < 1e-3 * float(here.field.std())
    assert there.history.energy[0] == pytest.approx(here.history.energy[0], rel=1e-5)
    varying = Coefficients(1, 2, 6 * ramp, -40, -40, 400 * ramp)
    flow = generate(varying, MASS, grid, schedule=short(60))
    assert flow.history.energy[-1] < 0.5 * flow.history.energy[0]
    truth = float(energy(flow.field.double(), varying, grid, EPSILON))
    assert flow.history.energy[-1] == pytest.approx(truth, rel=1e-4)


@backends
def test_a_mass_that_varies_in_space():
    """u = k ∗ (div A + m(x)): it starts with m, and keeps m's mean."""
    grid = Grid((16, 16, 32))
    here = -0.45 - 0.3 * torch.cos(2 * math.pi * (torch.arange(32) + 0.5) / 32)
    fields = []
    watched = [lambda step, total, state: fields.append(state.field)]
    flow, _ = (generate(TUBES, mass, grid, schedule=short(20), callbacks=watched) for mass in (here, -0.45))
    assert np.abs(flow.history.mass + 0.45).max() < 1e-6
    assert flow.mass == flow.history.mass[-1]
    difference = gaussian_blur(here.expand(grid.shape), grid, BLUR) + 0.45
    assert float((fields[0] - fields[3] - difference).abs().max()) < 1e-5


def test_an_orientation_turns_the_shape():
    """Slopes along θ are dear: there are less of them, in all and in proportion."""
    grid, Q = Grid((24, 24, 24)), orientation((0, 1, 0), 3000.0)
    free, held = (generate(TUBES, MASS, grid, schedule=short(150), orientation=each).field for each in (None, Q))
    shares = [gradient(u, grid).square().mean((1, 2, 3)) for u in (free, held)]
    assert float(shares[1][1] / shares[1].sum()) < 0.5 * float(shares[0][1] / shares[0].sum())


def test_tubes_lie_along_a_direction_that_turns():
    """By 90°, along circles about an edge of a box with walls, where the structure tensor's least eigenvector is θ; and
    maps of one direction are that direction, bit for bit."""
    grid, ones = Grid((28, 16, 28), boundary="replicate"), torch.ones(28, 16, 28)
    z, _, x = (centres(grid) / 0.01).unbind(-1)
    along, plan = orientation((-x, 0, z), 3000.0), short(150)
    even, number, turned, free = (
        generate(TUBES, MASS, grid, schedule=plan, orientation=each).field
        for each in (orientation((2 * ones, 0, ones), 3000 * ones), orientation((2, 0, 1), 3000.0), along, None)
    )
    assert torch.equal(even, number)
    slopes = gradient(turned, grid)
    paid, all_paid = (float((turn_slope(gradient(u, grid), along) * gradient(u, grid)).sum()) for u in (turned, free))
    assert paid < 0.2 * all_paid
    angle = torch.atan2(z, x)
    for low in (0, 30, 60):
        part = slopes[:, (angle > math.radians(low)) & (angle < math.radians(low + 30))]
        _, vectors = torch.linalg.eigh(part @ part.T)
        θ = torch.tensor([math.cos(math.radians(low + 15)), 0, -math.sin(math.radians(low + 15))])
        assert float((vectors[:, 0] @ θ).abs()) > math.cos(math.radians(25))


# ---- a volume fraction instead of a mass: reached, told of, or told that it was not ----------------------------------


def share(u: torch.Tensor) -> float:
    return float((u > 0).double().mean())


@pytest.mark.slow
@pytest.mark.parametrize(("name", "wanted", "boundary"), [("tubes", 0.12, "periodic"), ("sponge", 0.4, "replicate")])
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


def test_what_cannot_be_reached_is_told():
    """So much cost on area leaves no shape at any mass."""
    area = Coefficients(1, 2, 1, 0, 0, 50000)
    plan = Schedule("t", 200, 5e-3, 5e-3, "cosine")
    flow = generate(area, None, Grid((16, 16, 16)), volume_fraction=0.1, schedule=plan)
    assert not flow.viability.viable
    assert flow.status.startswith("no shape after 200 steps")
    assert f"volume fraction {share(flow.field):.4f} instead of 0.1000" in flow.status


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
