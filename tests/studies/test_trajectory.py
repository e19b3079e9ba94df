"""`trajectory`: known paths come back, what does not move is not said to, its tests' sizes, refusals."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, refused
from scipy import stats

import curvafit
from curvafit.core.permutation import reorder
from curvafit.geometry.diagram import Diagram
from curvafit.report.comparison import describe_measures
from curvafit.report.trajectory import FILES, check_trajectory, describe_series, numbers_figure, write_trajectory
from curvafit.scan.measure import QUANTITIES, Measures, Quantity
from curvafit.studies.trajectory import Trajectory, trajectory
from curvafit.volumes.field import Field

#: Radii of tubes in voxels, the distance between their lines, and an edge of the box.
RADII, CELL, N = (4.0, 4.75, 5.5, 6.25, 7.0), 18, 54
EDGE = 0.01
#: An order that does not go with time: r is 0.3.
OTHER = (2, 0, 4, 1, 3)


def drawn(random: np.random.Generator, shift: float = 0.0) -> Measures:
    """Measures without a scan: a cloud of curvatures about a random centre, and normal numbers of known intervals."""
    points = random.standard_normal((60, 2)) + 0.5 * random.standard_normal(2) + shift
    diagram = Diagram(np.sort(points)[:, ::-1], random.random(60), unit="1/mm")
    rows = zip(QUANTITIES, random.standard_normal(len(QUANTITIES)) + shift, strict=True)
    quantities = tuple(Quantity(name, symbol, float(value), 1.96, power) for (name, symbol, power, _), value in rows)
    return Measures("", "mm", "mask", quantities, (1.0, 0.0, 0.0), diagram, (2, 2, 2), ())


# ---- the tests' own truths -------------------------------------------------------------------------------------------


def test_orders_are_distinct_and_begin_with_the_natural_one() -> None:
    orders, exact = reorder(4, 24)
    assert exact and len(np.unique(orders, axis=0)) == len(orders) == 24 and list(orders[0]) == [0, 1, 2, 3]
    some, exact = reorder(4, 23)
    assert not exact and len(some) == 24 and list(some[0]) == [0, 1, 2, 3] and (np.sort(some) == np.arange(4)).all()


def test_what_does_not_move_is_seldom_said_to() -> None:
    """Of 200 series of one law at most .05 have a number or a diagram that moves: ±.0154, of which 3 are allowed."""
    random = np.random.default_rng(0)
    found = [trajectory([drawn(random) for _ in range(5)]) for _ in range(200)]
    most = 0.05 + 3 * math.sqrt(0.05 * 0.95 / len(found))
    assert np.mean([any(change.moves for change in each.changes) for each in found]) <= most
    assert np.mean([each.p <= 0.05 for each in found]) <= most
    assert np.mean([each.changes[3].p <= 0.05 for each in found]) <= most


def test_the_interval_of_a_change_holds_as_often_as_it_says() -> None:
    """2200 numbers of two scans of one law tell .95 to ±.0046, and 4 of these are allowed."""
    random = np.random.default_rng(1)
    changes = [change for _ in range(100) for change in trajectory([drawn(random), drawn(random)]).changes]
    assert np.mean([not change.significant for change in changes]) == pytest.approx(0.95, abs=0.0186)


def test_correlations_are_with_the_place_in_the_series() -> None:
    found = trajectory([drawn(np.random.default_rng(k)) for k in range(6)], [0, 1, 2, 4, 8, 16])
    for change in found.changes:
        assert change.correlation == pytest.approx(stats.pearsonr(found.table(change.name)[0], range(6)).statistic)
    assert found.permutations == 720 and found.exact


@pytest.mark.parametrize("count", [4, 5])
def test_what_moves_all_the_way_has_the_least_exact_p(count: int) -> None:
    found = trajectory([drawn(np.random.default_rng(7), 50.0 * k) for k in range(count)])
    least = 2 / math.factorial(count)
    assert found.p == pytest.approx(least)
    assert [each.family for each in found.changes] == pytest.approx([least] * len(QUANTITIES))
    assert ("few scans" in found.status) == (least > 0.05)
    assert not found.limit or found.limit in describe_series(found)


def test_a_number_that_a_scan_lacks_has_no_trend() -> None:
    scans = [drawn(np.random.default_rng(k)) for k in range(5)]
    first, *others = scans[2].quantities
    scans[2] = replace(scans[2], quantities=(replace(first, value=math.nan, half=math.nan), *others))
    found = trajectory(scans)
    assert math.isnan(found.changes[0].p) and not found.changes[0].moves and math.isfinite(found.changes[1].p)
    assert len(numbers_figure(found).axes) >= len(QUANTITIES)


# ---- shapes ----------------------------------------------------------------------------------------------------------


def tubes(radius: float, edge: float = EDGE, unit: str = "mm") -> Field:
    y, x = np.indices((N, N)) % CELL - (CELL - 1) / 2
    mask = np.broadcast_to(np.hypot(y, x) < radius, (N, N, N)).astype(np.uint8)
    return Field(mask, (edge,) * 3, unit)


@pytest.fixture(scope="module")
def grown() -> Trajectory:
    """Tubes whose radius grows from 4 to 7 voxels."""
    scans = [*map(tubes, RADII[:-1]), tubes(RADII[-1], 1000 * EDGE, "um")]
    return trajectory(scans, [0, 7, 14, 28, 56], unit_of_time="d", periodic=True, kind="mask")


def test_tubes_that_grow_come_back(grown: Trajectory) -> None:
    """A circle of voxels has the radius of its area, and κ1 is its inverse to 5 %. Balls on the grid are too small: by
    up to half a voxel on either side, and half a voxel more where no ball of the grid fills the circle.
    """
    fractions, _ = grown.table("BV/TV")
    radii = EDGE * CELL * np.sqrt(fractions / math.pi)
    assert radii == pytest.approx(EDGE * np.array(RADII), abs=EDGE / 2)
    assert grown.table("κ1")[0] == pytest.approx(1 / radii, rel=0.05)
    thickness, halves = grown.table("Tb.Th")
    assert (thickness + halves <= 2 * radii + EDGE).all() and (thickness >= 2 * radii - 2 * EDGE).all()
    assert grown["Tb.Th"].difference == pytest.approx(2 * (radii[-1] - radii[0]), abs=EDGE)
    assert grown["Tb.Th"].significant and grown["κ1"].significant and not grown["Euler number"].significant
    assert (grown.table("share of tubes")[0] > 0.9).all()


def test_a_diagram_goes_away_from_the_first_as_far_as_its_curvature(grown: Trajectory) -> None:
    """A shift by s is s / √2 in sliced Wasserstein distance, and bins are a tenth of 1 / thickness."""
    κ1 = grown.table("κ1")[0]
    assert (np.diff(grown.distances) > 0).all() and grown.distances[0] == 0
    assert grown.distances == pytest.approx((κ1[0] - κ1) / math.sqrt(2), rel=0.1, abs=0.1 / grown.table("Tb.Th")[0][0])


def test_what_grows_moves_and_in_another_order_does_not(grown: Trajectory) -> None:
    assert {"Tb.Th", "BV/TV", "κ1"} <= {each.symbol for each in grown.changes if each.p == pytest.approx(2 / 120)}
    assert grown["Tb.Th"].correlation > 0.98 and grown["κ1"].correlation < -0.95
    other = trajectory([grown.measures[k] for k in OTHER])
    assert other.p > 0.1 and not any(each.moves or each.p <= 0.05 for each in other.changes)
    assert "do: none" in other.status


def test_a_constant_series_does_not_change(grown: Trajectory) -> None:
    same = trajectory([grown.measures[1]] * 5)
    assert same.p == 1 and (same.distances == 0).all()
    assert not any(each.significant or each.moves for each in same.changes)
    assert "0 of " in same.status and {each.p for each in same.changes} == {1.0}


def test_units_are_converted(grown: Trajectory) -> None:
    assert grown.unit == "mm" and {each.unit for each in grown.measures} == {"mm"}
    assert any("converted" in note for note in grown.notes)


# ---- files and the command -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_series_writes_itself(grown: Trajectory, tmp_path: Path) -> None:
    page = write_trajectory(grown, tmp_path / "out", command="curvafit trajectory <b>")
    assert {path.name for path in page.parent.iterdir()} == set(FILES)
    text = page.read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:)', text) and "&lt;b&gt;" in text and "<b>" not in text
    record = json.loads((tmp_path / "out" / "trajectory.json").read_text(encoding="utf-8"))
    assert [each["time"] for each in record["scans"]] == [0, 7, 14, 28, 56] and record["unit_of_time"] == "d"
    assert record["methods"] == describe_series(grown) and "120 orders" in record["methods"]
    assert " ".join(describe_measures(grown.measures)) in record["methods"]
    rows = list(csv.DictReader((tmp_path / "out" / "trajectory.csv").read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 5 * len(QUANTITIES) and {row["time"] for row in rows} == {"0.0", "7.0", "14.0", "28.0", "56.0"}
    assert check_trajectory(tmp_path / "out", command=record["command"]) == tmp_path / "out"  # its own files
    (tmp_path / "out" / "trajectory.json").write_text("mine", encoding="utf-8")
    with pytest.raises(ValueError, match="free"):
        write_trajectory(grown, tmp_path / "out")


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, where the test stands, with two tiny scans, one without structure and one with a spacing."""
    monkeypatch.chdir(tmp_path)
    z, y, x = np.indices((24,) * 3) % 12 - 5.5
    for k, radius in enumerate((4.0, 5.0)):
        np.save(tmp_path / f"t{k}.npy", (z**2 + y**2 + x**2 < radius**2).astype(np.uint8))
    np.save(tmp_path / "empty.npy", np.zeros((24,) * 3, np.uint8))
    curvafit.save(Field(np.load(tmp_path / "t0.npy"), (0.01,) * 3, "mm"), tmp_path / "mm.nii.gz")
    return tmp_path


@pytest.mark.slow
def test_the_command_follows_two_scans(scans: Path) -> None:
    result = call(
        "trajectory", "t0.npy", "t1.npy", "--times", "0,2.5", "--unit-of-time", "$d$", "--periodic", "-o", "out"
    )
    assert result.exit_code == 0, (result.output, result.exception)
    assert "2.5 $d$" in result.stdout and "needs 5 scans" in result.stdout
    assert {path.name for path in (scans / "out").iterdir()} == set(FILES)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("t0.npy", "two scans"),
        ("t0.npy t1.npy --times 0", "--times"),
        ("t0.npy t1.npy --times 0,1,2", "--times"),
        ("t0.npy t1.npy --times 1,1", "increase"),
        ("t0.npy t1.npy --times 1,0", "increase"),
        ("t0.npy t1.npy --times 0,nan", "--times"),
        ("t0.npy t1.npy --times soon,later", "--times"),
        ("t0.npy nothing.npy", "nothing.npy"),
        ("t0.npy empty.npy", "empty"),
        ("t0.npy mm.nii.gz", "spacing"),
        ("t0.npy t1.npy --permutations 5", "permutations"),
        ("t0.npy t1.npy --seed -1", "seed"),
        ("t0.npy t1.npy --output t0.npy", "t0.npy"),
    ],
)
def test_bad_input_is_one_sentence_and_nothing_is_written(scans: Path, arguments: str, word: str) -> None:
    before = sorted(scans.rglob("*"))
    refused(call("trajectory", "--output", "out", *arguments.split()), word, progress=True)
    assert sorted(scans.rglob("*")) == before


@pytest.mark.parametrize(
    ("scans", "times"),
    [("t0.npy", None), ([np.zeros((24, 24, 24))], None), (2 * [np.eye(3)], [0, 1, 2]), (2 * [np.eye(3)], "01")],
)
def test_bad_series_are_refused(scans: Sequence[Any], times: Any) -> None:
    with pytest.raises(ValueError):
        trajectory(scans, times)
