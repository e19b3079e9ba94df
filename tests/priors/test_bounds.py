"""Numbers that are given: NumPy's are taken as Python's, and what is of another kind or out of range is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from curvafit.core.checks import SHOWN, check_float, check_int, quoted
from curvafit.core.runtime import check_memory, device_memory
from curvafit.core.workers import check_workers
from curvafit.data_synth.case import Recipe
from curvafit.data_synth.design import Design, design_around, design_box
from curvafit.data_synth.imaging.modality import MODALITIES
from curvafit.data_synth.sources import Generated
from curvafit.drawing.shapes import Output
from curvafit.generation import Schedule, descend, generate, white_noise
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import orientation
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

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
    assert Output(np.float64(2), tile=(np.int64(1), 2, 3)).tile == (1, 2, 3)
    assert design_box(a11=np.float64(1)).draw(np.int64(1), np.int64(2)) == design_box(a11=1).draw(1, 2)
    assert list(generate(TUBES, MASS, 8, schedule=BRIEF, snapshots=np.array([0, 2])).snapshots) == [0, 2]


def flow(**wrong: Any) -> None:
    generate(**{"law": TUBES, "mass": MASS, "grid": 8, "schedule": BRIEF} | wrong)


def recipe(**wrong: Any) -> None:
    source, confocal = Generated((POINT,), ("tubes",)), MODALITIES["confocal"]
    Recipe(**{"source": source, "modality": confocal, "shape": (16, 16, 16), "voxel": confocal.voxel} | wrong)


NO_GRIDS = [0, -5, True, "64", (64, 64), None, 64.0, (64, 64, 6.5), math.nan, {}, 10**30]
NO_SEEDS = [-1, 2**63, 2**70, 1.5, "a", None, True]
NO_FIELDS = [None, 3, "u", np.zeros((8, 8)), object()]
#: What is called with which wrong argument, and a word of the refusal.
REFUSALS: list[tuple[Callable, dict[str, Any], str]] = [
    *(
        (flow, {"grid": grid}, "^expected a shape of 3 whole numbers, each at least 4.*, got [^\n]*$")
        for grid in NO_GRIDS
    ),
    *((flow, {"seed": seed}, "seed") for seed in NO_SEEDS),
    *((lambda seed: white_noise(Grid((8, 8, 8)), seed), {"seed": seed}, "seed") for seed in NO_SEEDS),
    *((lambda field: descend(field, TUBES, Grid((8, 8, 8))), {"field": field}, "field") for field in NO_FIELDS),
    (flow, {"law": Coefficients(1e300, 0, 1e300)}, "a20"),
    (flow, {"law": Coefficients(1, 0, 1, 1e9)}, "a10"),
    (flow, {"law": Coefficients(1, 0, 1, a00=torch.full((8, 8, 8), 1e20))}, "a00"),
    (flow, {"law": "tube"}, "preset"),
    (flow, {"law": (1, 2, 6)}, "law"),
    (flow, {"epsilon": 1e30}, "epsilon"),
    (flow, {"epsilon": 1e-9}, "epsilon"),
    (flow, {"epsilon": 0.0}, "epsilon"),
    (flow, {"epsilon": math.nan}, "epsilon"),
    (flow, {"epsilon": torch.tensor([0.02, 1e9])}, "epsilon"),
    (flow, {"epsilon": torch.tensor([0.02] * 7 + [0.0])}, "expected epsilon > 0"),
    (flow, {"epsilon": torch.full((2, 8, 8, 8), 0.02)}, "epsilon"),
    (flow, {"law": Coefficients(1, 2, 6, 0, 0, torch.ones(3, 1))}, "a00"),
    (flow, {"blur": 1e3}, "blur"),
    (flow, {"blur": -0.01}, "blur"),
    (flow, {"orientation": orientation((0, 0, 1), 1e30)}, "orientation"),
    (flow, {"orientation": [[1]]}, "orientation"),
    (flow, {"grid": Grid(8, 1e-10)}, "edges"),  # type: ignore[arg-type]
    (flow, {"grid": (10**5,) * 3}, "memory"),
    (flow, {"snapshots": 5}, "snapshots"),
    (flow, {"snapshots": [1.5]}, "snapshots"),
    (flow, {"snapshots": (1, 41)}, "snapshots"),
    (flow, {"callbacks": [3]}, "callbacks"),
    (flow, {"device": "abacus"}, "device"),
    (flow, {"backend": "cuda"}, "expected a backend"),
    (flow, {"backend": "fused", "device": "meta"}, "device"),
    (flow, {"checkpoint_every": math.inf}, "seconds"),
    (flow, {"checkpoint_every": -1}, "seconds"),
    *((flow, {"volume_fraction": share, "mass": None}, "volume fraction") for share in (0.0, 1.0, -0.1, math.nan)),
    *((flow, {"volume_fraction": 0.2, "mass": mass}, "mass") for mass in (1.0, math.nan, torch.full((8, 8, 8), -0.5))),
    *(
        (flow, {"mass": mass}, "mass")
        for mass in ("half", 1.0, -1.5, math.nan, torch.tensor([0.5, 1.5]), torch.ones(7))
    ),
    (flow, {"mass": None}, "neither"),
    (flow, {"schedule": 5}, "schedule"),
    *((lambda spread: design_around(POINT, spread), {"spread": s}, "spread") for s in (1e300, math.nan, -1, "wide")),
    (design_box, {"a10": (0, 1e300)}, "a10"),
    (Generated, {"points": ((*POINT[:5], 1e300, -0.6),), "names": ("far",)}, "a00"),
    (Design, {"sampling": "random", "box": ((0, 1, 2),) * 7}, "interval"),
    (check_workers, {"count": 10**6, "scheduler": None}, "workers"),
    *((Output, {"voxel": edge}, "edge") for edge in (1e300, 1e-300, 0, math.inf)),
    (Output, {"tile": (2, 2, 2.5)}, "repeats"),
    (lambda tile: Output(tile=tile).shape(Grid((8, 8, 8))), {"tile": (10**6, 10**6, 1)}, "memory"),
    (recipe, {"shape": (1, 1, 1)}, "images"),
    (recipe, {"shape": (10**9,) * 3}, "images"),
    (recipe, {"shape": (16, 16, "16")}, "voxels"),
    (recipe, {"voxel": 1e300}, "voxel"),
    (recipe, {"voxel": 1e6}, "1 x 1 x 1"),
    (recipe, {"calibres": (1, 1e300)}, "calibres"),
    (recipe, {"calibres": (1, 500)}, "shapes"),
    (recipe, {"calibres": 1}, "factors"),
    (recipe, {"seed": 2**63}, "seed"),
    (recipe, {"source": None}, "source"),
]


@pytest.mark.parametrize(("make", "wrong", "said"), REFUSALS)
def test_what_is_out_of_range_is_refused(make: Callable, wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make(**wrong)


def test_memory_is_told_before_it_is_taken() -> None:
    room = device_memory()
    assert room > 2**28
    check_memory((1, 1, room), 1, "a line")
    with pytest.raises(ValueError, match="memory"):
        check_memory((1, 2, room), 1, "a line")
