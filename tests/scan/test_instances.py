"""`measure_instances`: balls and rods of known size, apart, touching and cut; tables, and what is refused."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from calling import call, refused

from curvafit.scan.instances import OF_BODIES, measure_instances
from curvafit.scan.measure import Measures
from curvafit.volumes.field import Field

#: Label, centre and radius of balls: 5 and 9 touch, 8 is half outside.
BALLS = ((5, (20, 20, 18), 12), (9, (20, 20, 40), 10), (300, (20, 20, 64), 8), (8, (0, 20, 64), 9))
ROD, ROW = 11, 2


@pytest.fixture(scope="module")
def labels() -> np.ndarray:
    values = np.zeros((40, 52, 84), np.uint16)
    z, y, x = np.indices(values.shape)
    for label, centre, radius in BALLS:
        values[(z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2 < radius**2] = label
    values[(np.hypot(z - 20, y - 42) < 4) & (x >= 10) & (x < 60)] = ROD
    values[36, 36, 70:80] = ROW
    return values


@pytest.fixture(scope="module")
def bodies(labels: np.ndarray) -> dict[int, Measures]:
    found = measure_instances(Field(labels, (0.5, 0.5, 0.5), "um"))
    assert all(each.part is not None and each.part[0] == "instance" for each in found)
    return {each.part[1]: each for each in found if each.part}


def test_balls_have_their_radius_and_volume(bodies: dict[int, Measures], labels: np.ndarray) -> None:
    assert sorted(bodies) == [ROW, 5, 8, 9, ROD, 300]
    for label, _, radius in BALLS:
        ball, r = bodies[label], radius / 2
        part = 0.5 if label == 8 else 1.0
        assert ball["V"].value == np.count_nonzero(labels == label) * 0.5**3
        assert ball["Tb.Th"].value == pytest.approx(2 * r, rel=0.05)
        assert ball["H"].value == pytest.approx(1 / r, rel=0.1)
        assert ball["χ"].value == 1
        if part == 1:
            assert ball["V"].value == pytest.approx(4 / 3 * math.pi * r**3, rel=0.03)
            assert ball["S"].value == pytest.approx(4 * math.pi * r**2, rel=0.04)
            assert ball["Ψ"].value == pytest.approx(1, abs=0.03)
            assert ball["E"].value == pytest.approx(1, abs=0.01)
            assert ball["S.cut"].value == 0
        else:
            assert ball["S.cut"].value == pytest.approx(math.pi * r**2, rel=0.05)
            assert ball["S"].value == pytest.approx(2 * math.pi * r**2, rel=0.06)


def test_a_rod_is_long_and_thin(bodies: dict[int, Measures]) -> None:
    rod = bodies[ROD]
    assert rod["E"].value == pytest.approx(math.sqrt(50**2 / 12 / (45 / math.pi / 4)), rel=0.02)  # a disk of 45 voxels
    assert rod["Tb.Th"].value == pytest.approx(4, rel=0.1)
    assert rod["share of tubes"].value > 0.7  # the ends have the rest
    assert abs(rod.direction[2]) == pytest.approx(1, abs=0.01)


def test_what_is_too_thin_has_no_curvature(bodies: dict[int, Measures]) -> None:
    row = bodies[ROW]
    assert row["V"].value == 10 * 0.5**3
    assert row["E"].value == pytest.approx(10)
    assert math.isnan(row["H"].value)
    assert "curvature" in row.notes[0]


def test_neighbours_change_nothing(labels: np.ndarray, bodies: dict[int, Measures]) -> None:
    (alone,) = measure_instances(Field(np.where(labels == 9, 1, 0), (0.5, 0.5, 0.5), "um"))
    assert alone.part == ("instance", 1)
    assert [each.value for each in alone.quantities] == [each.value for each in bodies[9].quantities]


def test_a_change_of_unit_scales_each_number_by_its_power(bodies: dict[int, Measures]) -> None:
    ball = bodies[300]
    assert ball.convert("nm")["V"].value == pytest.approx(ball["V"].value * 1e9)
    assert ball["V"].format("um")[2] == "µm³"


def test_the_command_writes_rows_for_each_instance(labels: np.ndarray, tmp_path: Path) -> None:
    path, table = tmp_path / "labels.npy", tmp_path / "table.csv"
    np.save(path, np.where(labels == ROD, 0, labels))
    result = call("measure", path, "--labels", "-o", table)
    assert result.exit_code == 0, result.output
    rows = list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))
    names = [str(label) for label in (ROW, 5, 8, 9, 300)]
    assert [row["instance"] for row in rows] == [name for name in names for _ in OF_BODIES]
    assert rows[0]["unit"] == "voxel^3"
    np.save(tmp_path / "grey.npy", np.random.default_rng(0).integers(0, 200, (20, 20, 20)))
    np.save(tmp_path / "part.npy", labels + 0.5)
    for arguments, word in (
        (("grey.npy", "--labels"), "grey"),
        (("part.npy", "--labels"), "whole"),
        (("labels.npy", "--labels", "--dark"), "--dark"),
        (("labels.npy", "--labels", "--roi", path), "--roi"),
        (("labels.npy", "--labels", "--label", 5), "label"),
    ):
        refused(call("measure", tmp_path / arguments[0], *arguments[1:]), word)
