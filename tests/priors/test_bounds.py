"""Numbers that are given: NumPy's are taken as Python's, and what is of another kind or out of range is refused."""

import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from curvafit.core.checks import SHOWN, check_float, check_int, quoted
from curvafit.core.runtime import check_memory, device_memory
from curvafit.core.workers import check_workers
from curvafit.data_synth.dataset import Recipe
from curvafit.data_synth.design import Design, design_around, design_box
from curvafit.data_synth.imaging.modality import MODALITIES
from curvafit.data_synth.sources import Generated
from curvafit.drawing.shapes import Output
from curvafit.generation import Execution, Schedule, descend, generate, white_noise
from curvafit.generation.problem import Evidence, Hinge
from curvafit.generation.schedule import Phase, schedule
from curvafit.priors import kernels, stencils
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energies import energy, orientation
from curvafit.priors.grid import Grid
from curvafit.priors.law import Law, preset

TUBES, MASS = preset("tubes").coefficients, preset("tubes").mass
POINT = (1.0, 2.0, 6.0, -40.0, -40.0, 400.0, -0.6)
BRIEF = Schedule("brief", 2, 1e-3, 1e-3, "constant")
NO_NUMBERS: list[Any] = [None, True, "8", b"8", [8], {}, object(), math.nan, 1j, np.zeros(2), torch.zeros(2)]


@pytest.mark.parametrize("wrong", NO_NUMBERS)
def test_what_is_no_number_is_refused(wrong: Any) -> None:
    for check in (check_int, check_float):
        with pytest.raises(ValueError, match="^expected a count, got "):
            check(wrong, "a count", 0, 9)


def test_numbers_of_any_type_are_numbers() -> None:
    for three in (3, np.int8(3), np.int64(3), np.uint64(3), torch.tensor(3)):
        assert check_int(three, "a count", 0, 9) == check_float(three, "a count", 0, 9) == 3
        assert type(check_int(three, "a count", 0, 9)) is int
    assert check_float(np.float32(0.5), "a length") == check_float(torch.tensor(0.5), "a length") == 0.5


@pytest.mark.parametrize(
    ("check", "value", "bounds", "said"),
    [
        (check_int, 3.0, (0, 9), "expected a count, got 3.0$"),
        (check_int, 0, (1, 9), "expected a count, got 0$"),
        (check_int, 10, (1, 9), "expected a count, at most 9, got 10$"),
        (check_float, 1e-9, (1e-3, 9), "expected a count, at least 0.001, got 1e-09$"),
        (check_float, -1, (1e-3, 9), "expected a count, got -1$"),
        (check_float, 10**400, (), r"expected a count, got 10{9,}\.\.\.0{9,}$"),
    ],
)
def test_a_bound_is_named_where_it_counts(check: Callable, value: float, bounds: tuple, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        check(value, "a count", *bounds)


def test_quotations_are_one_short_line() -> None:
    assert quoted("a\nb") == r"'a\nb'"
    assert len(quoted("x" * 9999)) <= SHOWN and "\n" not in quoted(torch.zeros(9, 9))


def test_numpy_numbers_make_the_same_shape() -> None:
    eight, two = np.int64(8), np.float64(0.02)
    flow = generate(TUBES, np.float64(MASS), eight, schedule=BRIEF, seed=np.int32(3), epsilon=two, blur=two)
    assert torch.equal(flow.field, generate(TUBES, MASS, 8, schedule=BRIEF, seed=3).field)
    assert flow.grid == Grid((eight, eight, 8), np.float64(0.01)) == Grid(np.array([8, 8, 8]))  # type: ignore[arg-type]
    assert Schedule("x", np.int64(5), np.float32(0.5), 1, "constant").steps == 5
    assert design_box(a11=np.float64(1)).draw(np.int64(1), np.int64(2)) == design_box(a11=1).draw(1, 2)


def flow(**wrong: Any) -> None:
    options = {"law": TUBES, "mass": MASS, "grid": 8, "schedule": BRIEF} | wrong
    stated = {field.name: options.pop(field.name) for field in fields(Execution) if field.name in options}
    generate(**options, execution=Execution(**stated))


def lower(**wrong: Any) -> None:
    descend(**{"field": torch.zeros(8, 8, 8), "law": TUBES, "grid": BOX} | wrong)


def plan(**wrong: Any) -> None:
    Schedule(**{"name": "x", "steps": 10, "start": 1e-3, "stop": 1e-3, "shape": "cosine"} | wrong)


def blurred(width: float, spacing: float = 1.0) -> None:
    grid = Grid((8, 8, 8), (spacing, 1.0, 1.0))
    with pytest.raises(ValueError, match="blur"):
        kernels.gaussian_blur(torch.zeros(8, 8, 8), grid, width)
    stencils.gaussian_blur(torch.zeros(8, 8, 8), grid, width)


def recipe(**wrong: Any) -> None:
    source, confocal = Generated((POINT,), ("tubes",)), MODALITIES["confocal"]
    Recipe(**{"source": source, "modality": confocal, "shape": (16, 16, 16), "voxel": confocal.voxel} | wrong)


BOX, CUBE = Grid((8, 8, 8)), torch.zeros(8, 8, 8)
NO_GRIDS = [0, -5, True, "64", (64, 64), None, 64.0, (64, 64, 6.5), math.nan, {}, 10**30]
NO_SEEDS = [-1, 2**63, 2**70, 1.5, "a", True]
NO_FIELDS = [None, 3, "u", np.zeros((8, 8)), torch.zeros(8, 8, 7), object()]
NO_SHARES, NO_MASSES = (0.0, 1.0, -0.1, math.nan), (1.0, math.nan, torch.full((8, 8, 8), -0.5))
phase = partial(Phase, start=1e-3, stop=1e-3, shape="constant")
NO_EPSILONS = (1e30, 1e-9, 0.0, math.nan, torch.tensor([0.02, 0.03]))
#: What is called, an argument and what it may not be, and a word of the refusal.
REFUSALS: list[tuple[Callable, str, Sequence[Any], str]] = [
    (flow, "grid", NO_GRIDS, "^expected a shape of 3 whole numbers, each at least 4.*, got [^\n]*$"),
    (flow, "grid", [Grid(8, 1e-10)], "edges"),  # type: ignore[arg-type]
    (flow, "grid", [(10**5,) * 3], "memory"), (Grid, "shape", [(3, 5, 5), (5, 5)], "each at least 4"),
    (Grid, "shape", [(4.5, 5, 5)], "whole numbers"),
    (partial(Grid, 5), "spacing", [(0.2, 0, 0.2), (1, 1, math.nan)], r"positive numbers \(z, y, x\), got"),
    (partial(Grid, 5), "boundary", ["mirror"], "'periodic' or 'replicate', got 'mirror'"),
    (flow, "seed", NO_SEEDS, "seed"), (partial(white_noise, BOX), "seed", [*NO_SEEDS, None], "seed"),
    (lower, "field", NO_FIELDS, "field"), (lower, "field", [torch.full((8, 8, 8), math.inf)], "finite"),
    (lower, "method", ["sgd"], "method"), (lower, "steps", [0], "steps"), (lower, "callbacks", [[3]], "callbacks"),
    (lower, "execution", ["cuda"], "an Execution"),
    (lower, "data", [Evidence(torch.ones(7, 8, 8))], "ratio"),
    (Evidence, "ratio", [torch.full((4, 4, 4), math.nan), torch.zeros(4, 4)], "evidence"),
    (Hinge, "ratio", [torch.full((4, 4, 4), math.nan)], "evidence"),
    (partial(Hinge, CUBE), "margin", [2.0], "a margin from 0 to 1"),
    (flow, "law", [Coefficients(1e300, 0, 1e300)], "a20"), (flow, "law", [Coefficients(1, 0, 1, 1e9)], "a10"),
    (flow, "law", [Coefficients(1, 0, 1, a00=each) for each in (torch.full((8, 8, 8), 1e20), torch.ones(3, 1))], "a00"),
    (flow, "law", ["tube"], "preset"), (flow, "law", [(1, 2, 6)], "law"),
    (Law.of, "law", ["tube", "x" * 5000, 7, None], "preset"), (preset, "name", ["tube"], "preset"),
    (partial(Coefficients, 1, a02=1), "a11", [math.nan], "a11"), (Coefficients(1, 0, 1).in_unit, "unit", [0], "unit"),
    (flow, "epsilon", NO_EPSILONS, "epsilon"),
    (flow, "blur", [1e3, -0.01], "blur"), (blurred, "width", [-1.0, 8.1, 1e6, math.inf, math.nan], "blur"),
    (partial(blurred, 1.0), "spacing", [1e-6], "blur"),
    (partial(stencils.gradient, grid=BOX), "u", [torch.zeros(8, 8, 7)], "axes"),
    (flow, "orientation", [orientation((0, 0, 1), 1e30), [[1]], torch.zeros(3, 3, 8, 8, 7)], "orientation"),
    (partial(orientation, strength=1.0), "direction", [(0, 0, 0), (1, 2), (1, math.nan, 0)], "direction"),
    (partial(orientation, (1, 0, 0)), "strength", [math.inf], "strength"),
    (partial(energy, CUBE, TUBES, BOX, 0.02), "orientation", [torch.arange(9.0).reshape(3, 3)], "symmetric"),
    (flow, "callbacks", [[3], 5], "callbacks"), (flow, "device", ["abacus"], "device"),
    (flow, "checkpoint_every", [math.inf, -1], "seconds"),
    (partial(flow, mass=None), "volume_fraction", NO_SHARES, "volume fraction"),
    (partial(flow, volume_fraction=0.2), "mass", NO_MASSES, "mass"),
    (flow, "mass", ["half", 1.0, -1.5, math.nan, torch.tensor([0.5, 1.5]), torch.ones(7)], "mass"),
    (flow, "mass", [None], "neither"), (flow, "schedule", [5], "schedule"), (schedule, "name", ["slow"], "schedule"),
    (plan, "steps", [0], "steps"), (plan, "start", [0.0], "positive step"), (plan, "shape", ["linear"], "shape"),
    (plan, "momentum", [1], "momentum in"), (plan, "memory", [1], "memory in"),
    (phase, "share", [0.0, 1.0, -0.5], "share"), (plan, "opening", [(phase(share=0.5),) * 2], "share"),
    (plan, "opening", [(3,)], "opening"),
    (partial(design_around, POINT), "spread", [1e300, math.nan, -1, "wide"], "spread"),
    (design_box, "a10", [(0, 1e300)], "a10"),
    (partial(Generated, names=("far",)), "points", [((*POINT[:5], 1e300, -0.6),)], "a00"),
    (partial(Design, "random"), "box", [((0, 1, 2),) * 7], "interval"),
    (partial(check_workers, scheduler=None), "count", [10**6], "workers"),
    (Output, "voxel", [1e300, 1e-300, 0, math.inf], "edge"),
    (Output, "unit", ["x"], "unit"),
    (recipe, "shape", [(1, 1, 1), (10**9,) * 3], "images"), (recipe, "shape", [(16, 16, "16")], "voxels"),
    (recipe, "voxel", [1e300], "voxel"), (recipe, "voxel", [1e6], "1 x 1 x 1"),
    (recipe, "calibres", [(1, 1e300)], "calibres"), (recipe, "calibres", [(1, 500)], "shapes"),
    (recipe, "calibres", [1], "factors"), (recipe, "seed", [2**63], "seed"), (recipe, "source", [None], "source"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "argument", "values", "said"), REFUSALS)
def test_what_is_out_of_range_is_refused(make: Callable, argument: str, values: Sequence[Any], said: str) -> None:
    for value in values:
        with pytest.raises(ValueError, match=said):
            make(**{argument: value})


def test_memory_is_told_before_it_is_taken() -> None:
    room = device_memory()
    assert room > 2**28
    check_memory((1, 1, room), 1, "a line")
    with pytest.raises(ValueError, match="memory"):
        check_memory((1, 2, room), 1, "a line")
