"""Numbers that are given: NumPy's are taken as Python's, and what is of another kind or out of range is refused."""

from __future__ import annotations

import math
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
from curvafit.generation import Schedule, descend, generate, generate_batch, white_noise
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.energy import orientation
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset

TUBES, MASS = preset("tubes").coefficients, preset("tubes").mass
BRIEF = Schedule("brief", 2, 1e-3, 1e-3, "constant")
NO_NUMBERS: list[Any] = [None, True, "8", b"8", [8], {}, object(), math.nan, 1j, np.zeros(2), torch.zeros(2)]


@pytest.mark.parametrize("wrong", NO_NUMBERS)
def test_what_is_no_number_is_refused(wrong: Any) -> None:
    for check in (lambda: check_int(wrong, "a count", 0, 9), lambda: check_float(wrong, "a length", 0, 9)):
        with pytest.raises(ValueError, match="^expected a (count|length), got "):
            check()


def test_numbers_of_any_type_are_numbers() -> None:
    for three in (3, np.int8(3), np.int64(3), np.uint64(3), torch.tensor(3)):
        assert check_int(three, "a count", 0, 9) == check_float(three, "a length", 0, 9) == 3
        assert type(check_int(three, "a count", 0, 9)) is int
    assert check_float(np.float32(0.5), "a length") == check_float(torch.tensor(0.5), "a length") == 0.5
    for broken in (3.0, np.float64(3)):
        with pytest.raises(ValueError, match="expected a count, got"):
            check_int(broken, "a count", 0, 9)


def test_a_bound_is_named_where_it_counts() -> None:
    with pytest.raises(ValueError, match="expected a count from 1, got 0$"):
        check_int(0, "a count from 1", 1, 9)
    with pytest.raises(ValueError, match="expected a count from 1, at most 9, got 10$"):
        check_int(10, "a count from 1", 1, 9)
    with pytest.raises(ValueError, match="expected a positive length, at least 0.001, got 1e-09$"):
        check_float(1e-9, "a positive length", 1e-3, 9)
    with pytest.raises(ValueError, match="expected a positive length, got -1$"):
        check_float(-1, "a positive length", 1e-3, 9)
    with pytest.raises(ValueError, match=r"expected a length, got 10{9,}\.\.\.0{9,}$"):
        check_float(10**400, "a length")


def test_quotations_are_one_short_line() -> None:
    assert quoted("a\nb") == r"'a\nb'"
    assert len(quoted("x" * 9999)) <= SHOWN and "\n" not in quoted(torch.zeros(9, 9))


def test_numpy_numbers_make_the_same_shape() -> None:
    eight, two = np.int64(8), np.float64(0.02)
    flow = generate(
        TUBES, np.float64(MASS), eight, schedule=BRIEF, seed=np.int32(3), epsilon=two, blur=np.float64(0.02)
    )
    assert torch.equal(flow.field, generate(TUBES, MASS, 8, schedule=BRIEF, seed=3).field)
    assert flow.grid == Grid((eight, eight, 8), np.float64(0.01)) == Grid(np.array([8, 8, 8]))  # type: ignore[arg-type]
    assert Schedule("x", np.int64(5), np.float32(0.5), 1, "constant").steps == 5
    assert Output(np.float64(2), tile=(np.int64(1), 2, 3)).tile == (1, 2, 3)
    assert design_box(a11=np.float64(1)) == design_box(a11=1) and design_box().draw(
        np.int64(1), np.int64(2)
    ) == design_box().draw(1, 2)
    snapshots = generate(TUBES, MASS, 8, schedule=BRIEF, snapshots=np.array([0, 2])).snapshots
    assert list(snapshots) == [0, 2]


@pytest.mark.parametrize(
    "grid", [0, -5, True, "64", (64, 64), None, 64.0, (64, 64, 6.5), math.nan, {}, 10**30], ids=repr
)
def test_wrong_grids_are_refused_in_one_sentence(grid: Any) -> None:
    with pytest.raises(ValueError, match="^expected a shape of 3 whole numbers, each at least 4.*, got [^\n]*$"):
        generate(TUBES, MASS, grid)


@pytest.mark.parametrize("seed", [-1, 2**63, 2**70, 1.5, "a", None, True])
def test_wrong_seeds_are_refused(seed: Any) -> None:
    for make in (lambda: generate(TUBES, MASS, 8, seed=seed), lambda: white_noise(Grid((8, 8, 8)), seed)):
        with pytest.raises(ValueError, match="seed"):
            make()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"law": Coefficients(1e300, 0, 1e300)}, "a20"),
        ({"law": Coefficients(1, 0, 1, 1e9)}, "a10"),
        ({"law": Coefficients(1, 0, 1, a00=torch.full((8, 8, 8), 1e20))}, "a00"),
        ({"law": "tube"}, "preset"),
        ({"law": (1, 2, 6)}, "law"),
        ({"epsilon": 1e30}, "epsilon"),
        ({"epsilon": 1e-9}, "epsilon"),
        ({"epsilon": torch.tensor([0.02, 1e9])}, "epsilon"),
        ({"blur": 1e3}, "blur"),
        ({"orientation": orientation((0, 0, 1), 1e30)}, "orientation"),
        ({"orientation": [[1]]}, "orientation"),
        ({"grid": Grid(8, 1e-10)}, "edges"),  # type: ignore[arg-type]
        ({"grid": (10**5,) * 3}, "memory"),
        ({"snapshots": 5}, "snapshots"),
        ({"snapshots": [1.5]}, "snapshots"),
        ({"callbacks": [3]}, "callbacks"),
        ({"device": "abacus"}, "device"),
        ({"checkpoint_every": math.inf}, "seconds"),
        ({"volume_fraction": math.nan, "mass": None}, "volume fraction"),
        ({"mass": "half"}, "mass"),
        ({"schedule": 5}, "schedule"),
    ],
)
def test_flows_refuse_what_is_out_of_range(wrong: dict[str, Any], said: str) -> None:
    given = {"law": TUBES, "mass": MASS, "grid": 8, "schedule": BRIEF} | wrong
    with pytest.raises(ValueError, match=said):
        generate(**given)


@pytest.mark.parametrize("field", [None, 3, "u", np.zeros((8, 8)), object()])
def test_a_flow_starts_at_a_field_only(field: Any) -> None:
    with pytest.raises(ValueError, match="field"):
        descend(field, TUBES, Grid((8, 8, 8)))


def test_batches_refuse_what_is_no_sequence() -> None:
    for name, said in (("laws", r"a law \(.*\)"), ("masses", "a sequence of masses"), ("seeds", "a sequence of seeds")):
        given = {"laws": TUBES, "masses": MASS, "seeds": 0} | {name: object()}
        with pytest.raises(ValueError, match=f"expected {said}, got <object object"):
            generate_batch(grid=Grid((8, 8, 8)), **given)  # type: ignore[arg-type]


def test_designs_stay_within_what_a_flow_takes() -> None:
    point = (1.0, 2.0, 6.0, -40.0, -40.0, 400.0, -0.6)
    for spread in (1e300, math.nan, -1, "wide"):
        with pytest.raises(ValueError, match="spread"):
            design_around(point, spread)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="a10"):
        design_box(a10=(0, 1e300))
    with pytest.raises(ValueError, match="a00"):
        Generated(((*point[:5], 1e300, -0.6),), ("far",))
    with pytest.raises(ValueError, match="interval"):
        Design("random", box=((0, 1, 2),) * 7)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="workers"):
        check_workers(10**6, None)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"shape": (1, 1, 1)}, "images"),
        ({"shape": (10**9,) * 3}, "images"),
        ({"shape": (16, 16, "16")}, "voxels"),
        ({"voxel": 1e300}, "voxel"),
        ({"voxel": 1e6}, "1 x 1 x 1"),
        ({"calibres": (1, 1e300)}, "calibres"),
        ({"calibres": (1, 500)}, "shapes"),
        ({"calibres": 1}, "factors"),
        ({"seed": 2**63}, "seed"),
        ({"source": None}, "source"),
    ],
)
def test_recipes_refuse_what_no_case_can_be_made_of(wrong: dict[str, Any], said: str) -> None:
    source, confocal = Generated(((1.0, 2.0, 6.0, -40.0, -40.0, 400.0, -0.6),), ("tubes",)), MODALITIES["confocal"]
    given = {"source": source, "modality": confocal, "shape": (16, 16, 16), "voxel": confocal.voxel} | wrong
    with pytest.raises(ValueError, match=said):
        Recipe(**given)


def test_outputs_have_bounds() -> None:
    for edge in (1e300, 1e-300, 0, math.inf):
        with pytest.raises(ValueError, match="edge"):
            Output(edge)
    with pytest.raises(ValueError, match="repeats"):
        Output(tile=(2, 2, 2.5))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="memory"):
        Output(tile=(10**6, 10**6, 1)).shape(Grid((8, 8, 8)))


def test_memory_is_told_before_it_is_taken() -> None:
    room = device_memory()
    assert room > 2**28
    check_memory((1, 1, room), 1, "a line")
    with pytest.raises(ValueError, match="memory"):
        check_memory((1, 2, room), 1, "a line")
