"""Many scans inferred into one folder: their table, the same command again, and what is wrong with one of them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from found import lattice

from curvafit.report.laws import infer_scans, name_folders
from curvafit.volumes.field import Field
from curvafit.volumes.write import save


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("scans")
    found = []
    for radius in (4.5, 5.5):
        mask = (lattice(56, 28, radius) > 0).astype(np.uint8)
        found.append(str(save(Field(mask, (0.02,) * 3, "mm"), folder / f"r{10 * radius:.0f}.nii.gz")))
    return found


def test_each_scan_has_its_report_and_its_rows(scans: list[str], tmp_path: Path) -> None:
    page = infer_scans(scans, tmp_path / "out", fast=True, command="one")
    rows = list(csv.DictReader((tmp_path / "out" / "laws.csv").read_text(encoding="utf-8").splitlines()))
    assert {row["scan"] for row in rows} == {"r45", "r55"}
    assert all(float(row["low"]) <= float(row["value"]) <= float(row["high"]) for row in rows if row["low"])
    assert 'href="r45/report.html"' in page.read_text(encoding="utf-8")
    times = [(tmp_path / "out" / name / "fit.json").stat().st_mtime_ns for name in ("r45", "r55")]
    infer_scans(scans, tmp_path / "out", fast=True, command="one")
    assert times == [(tmp_path / "out" / name / "fit.json").stat().st_mtime_ns for name in ("r45", "r55")]
    infer_scans(scans[:1], tmp_path / "out", fast=True, command="another", overwrite=True)
    assert times[0] != (tmp_path / "out" / "r45" / "fit.json").stat().st_mtime_ns


def test_what_is_wrong_is_said_with_the_scan(scans: list[str], tmp_path: Path) -> None:
    empty = save(Field(np.zeros((40, 40, 40), np.uint8)), tmp_path / "empty.nii.gz")
    with pytest.raises(ValueError, match="empty.nii.gz"):
        infer_scans([*scans, str(empty)], tmp_path / "out", fast=True, command="one")
    assert not (tmp_path / "out" / "laws.html").exists()


def test_folders_are_named_by_scans() -> None:
    assert name_folders(["a/x.nii.gz", "b/y.tif", "c.h5::raw"]) == ["x", "y", "c"]
    assert name_folders(["a/x.nii.gz", "b/x.tif"]) == ["x.nii.gz", "x.tif"]
    with pytest.raises(ValueError, match="several named x.tif"):
        name_folders(["a/x.tif", "b/x.tif"])
