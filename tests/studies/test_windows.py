"""`measure --windows`: maps and clusters of a volume of two textures, sums that agree with the whole, refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from calling import call, refused

from curvafit.report.windows import check_windows
from curvafit.scan.measure import measure
from curvafit.studies.windows import NAMES, Windows, windows
from curvafit.volumes.field import Field
from curvafit.volumes.read import load

N, SIZE, STRIDE = 96, 48, 24
THIN, THICK = 4.0, 6.0


def rods(radius: float, pitch: int) -> np.ndarray:
    """Parallel rods along z on a square lattice, bool (N / 2, N, N)."""
    y, x = np.indices((N, N)) % pitch - pitch // 2
    return np.broadcast_to(np.hypot(y, x) < radius, (N // 2, N, N))


@pytest.fixture(scope="module")
def halves() -> Field:
    """Thin rods below thick ones, along z."""
    return Field(np.concatenate([rods(THIN, 16), rods(THICK, 24)]).astype(np.uint8), (0.5, 0.5, 0.5), "um")


@pytest.fixture(scope="module")
def mapped(halves: Field) -> Windows:
    return windows(halves, SIZE, STRIDE)


def test_a_volume_of_two_halves_gives_its_map_back(mapped: Windows) -> None:
    thickness = mapped["Tb.Th"].values
    assert thickness[0] == pytest.approx(np.full((3, 3), THIN), rel=0.1)  # in um, of 0.5 um a voxel
    assert thickness[2] == pytest.approx(np.full((3, 3), THICK), rel=0.1)
    assert (mapped.clusters.values[0] == 1).all()
    assert (mapped.clusters.values[2] == 2).all()  # the windows between straddle
    assert mapped.explained > 0.5
    assert [place[0] for place in mapped.extremes("thickness")] == [0, 2]
    assert mapped["share of tubes"].values[0].min() > 0.9


def test_disjoint_windows_agree_with_the_whole(halves: Field, mapped: Windows) -> None:
    whole, apart = measure(halves), mapped.values[::2, ::2, ::2].reshape(8, -1)
    fraction, thickness, surface = (
        apart[:, NAMES.index(name)] for name in ("volume fraction", "thickness", "surface density")
    )
    assert fraction.mean() == pytest.approx(whole["BV/TV"].value, rel=1e-9)
    assert surface.mean() == pytest.approx(whole["BS/TV"].value, rel=1e-9)
    assert (fraction * thickness).sum() / fraction.sum() == pytest.approx(whole["Tb.Th"].value, rel=1e-9)


def test_the_grid_has_its_place(halves: Field) -> None:
    affine = np.array([[0, -0.5, 0, 7], [0.5, 0, 0, -3], [0, 0, 0.5, 1], [0, 0, 0, 1]])
    grid = windows(Field(halves.values[:, :49], (0.5, 0.5, 0.5), "um", affine), (96, 48, 48), (48, 48, 24)).clusters
    assert grid.shape == (1, 1, 3)
    assert grid.spacing == (24, 24, 12)
    # columns x, y, z; the first centre lies 47, 23.5, 23.5 steps of a voxel (z, y, x) from the first voxel's
    for index, voxel in (((0, 0, 0), (23.5, 23.5, 47.5)), ((2, 0, 0), (71.5, 23.5, 47.5))):
        assert grid.affine is not None
        assert grid.affine @ [*index, 1] == pytest.approx(affine @ [*voxel, 1])


def test_windows_without_structure_are_unknown(halves: Field) -> None:
    values = halves.values.copy()
    values[:, :, 48:] = 0
    found = windows(values, SIZE, STRIDE)
    assert np.isnan(found.values[:, :, 2]).all()
    assert (found.clusters.values[:, :, 2] == 0).all()
    assert np.isfinite(found.values[:, :, 0]).all()
    assert f" {(~found.known).sum()} of them" in found.status


def test_the_command_writes_maps_table_and_page(halves: Field, mapped: Windows, tmp_path: Path) -> None:
    scan, out = tmp_path / "scan.npy", tmp_path / "maps"
    np.save(scan, halves.values)
    arguments = ("measure", scan, "--windows", SIZE, "--spacing", 0.5, "--unit", "um", "-o", out)
    result = call(*arguments)
    assert result.exit_code == 0, result.output
    labels, thickness = load(out / "clusters.nii.gz"), load(out / "thickness.nii.gz")
    assert (labels.values == mapped.clusters.values).all()
    assert labels.spacing == pytest.approx((12, 12, 12))
    assert thickness.values == pytest.approx(mapped["thickness"].values)
    rows = list(csv.DictReader((out / "windows.csv").read_text(encoding="utf-8").splitlines()))
    assert [float(row["z"]) for row in rows] == pytest.approx(mapped.centres[..., 0].ravel())
    assert [float(row["thickness"]) for row in rows] == pytest.approx(mapped["Tb.Th"].values.ravel())
    record = json.loads((out / "windows.json").read_text(encoding="utf-8"))
    assert record["options"]["seed"] == 0
    assert {path.name for path in out.iterdir()} == set(record["files"])
    assert check_windows(out, scan, command=record["command"]) == out  # its own files
    with pytest.raises(ValueError, match="free"):
        check_windows(out, scan, command="curvafit measure another.npy -o maps")
    (out / "windows.json").write_text("{}", encoding="utf-8")
    refused(call(*arguments), "free")


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    for name, values in (("scan", rods(THICK, 24)), ("flat", np.eye(64))):
        np.save(tmp_path / f"{name}.npy", values.astype(np.uint8))
    scan, flat, out = tmp_path / "scan.npy", tmp_path / "flat.npy", ("-o", tmp_path / "out")
    for words, said in (
        ((scan, "--windows", 32, "--stride", 48, *out), "stride"),
        ((scan, "--windows", 32, "--stride", 12, *out), "divides"),
        ((scan, "--windows", 64, *out), "fit into"),
        ((scan, "--windows", 32, "--clusters", 0, *out), "clusters"),
        ((flat, "--windows", 64, *out), "3D"),
        ((scan, "--stride", 32, *out), "--windows"),
        ((scan, "--windows", 32), "folder"),
        ((scan, "--windows", 32, "-o", tmp_path / "maps.csv"), "folder"),
        ((scan, flat, "--windows", 32, *out), "one scan"),
        ((scan, "--windows", 32, "--tile", 32, *out), "--tile"),
    ):
        refused(call("measure", *words), said, progress=True)
    refused(call("windows", scan, "--size", 32, *out), "--windows 64")
    sparse = np.zeros((48, 48, 48), dtype=np.uint8)
    sparse[20:28, 20:28, 20:28] = 1
    with pytest.raises(ValueError, match="larger"):
        windows(sparse, 24, 24)
    assert not (tmp_path / "out").exists()
