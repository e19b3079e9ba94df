"""Views of shapes, and the table of their descriptors: complete, the same however often stopped, refused if damaged."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from exact import Gyroid, centres
from exact_store import exact_record, exact_store
from typer.testing import CliRunner

from curvafit.atlas_map.extract import describe
from curvafit.cli.app import app
from curvafit.core.workers import cluster
from curvafit.geometry.descriptors import BLOCKS, descriptors
from curvafit.geometry.mesh import NoSurface
from curvafit.inference.table import (
    BLUR,
    PARAMETERS,
    SNR,
    VIEWS,
    Table,
    View,
    column_names,
    law_of,
    load_table,
    parameters_of,
    save_table,
)
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.law import preset
from curvafit.priors.profile import optimal_profile
from curvafit.volumes.field import ScanError

FAST = ("field", "mask")


def gyroid(n: int = 48) -> tuple[np.ndarray, Grid]:
    grid = Grid((n, n, n))
    return optimal_profile(Gyroid(0.24).distance(centres(grid)), 0.02).float().numpy(), grid


@pytest.mark.parametrize("name", VIEWS)
def test_a_view_shows_the_shape(name: str) -> None:
    u, grid = gyroid()
    view = VIEWS[name](u, grid, np.random.default_rng(1))
    assert view.shape.shape == view.grid.shape
    assert view.grid.spacing == grid.spacing
    assert (view.grid.shape == grid.shape) == (name in FAST) == view.grid.periodic
    assert view.shape.dtype == (np.float32 if name == "field" else bool)
    seen, whole = descriptors(view.shape, view.grid), descriptors(u, grid)
    assert seen.fraction == pytest.approx(whole.fraction, abs=0.03)
    assert seen.densities == pytest.approx(whole.densities, rel=0.3, abs=0.3 * whole.densities[0])  # κ is up to 20
    assert seen.chords[3:7] == pytest.approx(whole.chords[3:7], abs=0.012)  # 0.01 is a voxel


@pytest.mark.parametrize("n", [20, 36, 46])
def test_a_window_may_have_an_odd_number_of_planes(n: int) -> None:
    u, grid = gyroid(n)
    assert VIEWS["scan"](u, grid, np.random.default_rng(1)).shape.shape == (round(0.75 * n),) * 3


@pytest.mark.parametrize("name", ["crop", "resampled", "scan"])
def test_a_window_without_a_structure_is_refused(name: str) -> None:
    u = np.full((24, 24, 24), -1.0, np.float32)
    with pytest.raises(ScanError, match="inside"):
        VIEWS[name](u, Grid(u.shape), np.random.default_rng(1))


@pytest.mark.parametrize("name", ["crop", "resampled", "scan"])
def test_a_view_depends_on_its_generator_alone(name: str) -> None:
    u, grid = gyroid()
    first, again, other = (VIEWS[name](u, grid, np.random.default_rng(seed)).shape for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_scan_is_blurred_and_noisy() -> None:
    """Half of what Otsu gets wrong lies at the surface, as blur and slices of two voxels do it."""
    assert BLUR > 0
    assert SNR > 0
    u, grid = gyroid()
    rng = np.random.default_rng
    scan, crop = VIEWS["scan"](u, grid, rng(1)).shape, VIEWS["crop"](u, grid, rng(1)).shape
    assert 0.005 < (scan != crop).mean() < 0.1


def test_a_table_has_each_view_of_each_shape(tmp_path: Path) -> None:
    store = exact_store(tmp_path / "store.zarr", 8)
    table = describe([store.path], tmp_path / "table.npz", FAST)
    viable = [index for index in range(8) if index % 7 != 2]
    assert sorted(zip(table.shapes, table.views, strict=True)) == [
        (f"store/{index:06d}", view) for index in viable for view in FAST
    ]
    assert table.descriptors.shape == (2 * len(viable), len(column_names()))
    for shape, view, parameters, row in zip(
        table.shapes, table.views, table.parameters, table.descriptors, strict=True
    ):
        index = int(shape[-6:])
        record, u = exact_record(index), store.field(index)
        assert np.array_equal(parameters, parameters_of(record.coefficients, record.mass))
        seen = descriptors(u if view == "field" else u > 0, Grid(u.shape))
        assert row == pytest.approx(seen.vector(), rel=1e-5, abs=1e-5)
    assert load_table(tmp_path / "table.npz").provenance["stores"]["store"]["seed"] == store.settings.seed


def test_a_stopped_table_goes_on_and_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = exact_store(tmp_path / "store.zarr", 4)
    whole = describe([store.path], tmp_path / "whole.npz", FAST)
    measured: list[int] = []

    def stops(u, grid, rng):
        measured.append(1)
        if len(measured) == 2:
            raise KeyboardInterrupt
        return View(u, grid)

    with monkeypatch.context() as patch:
        patch.setitem(VIEWS, "field", stops)
        with pytest.raises(KeyboardInterrupt):
            describe([store.path], tmp_path / "table.npz", FAST)
    assert len(load_table(tmp_path / "table.npz")) == 2
    table = describe([store.path], tmp_path / "table.npz", FAST)
    for name in ("shapes", "views", "parameters", "descriptors"):
        assert np.array_equal(getattr(table, name), getattr(whole, name)), name
    exact_store(store.path, 6, first=4)
    grown = describe([store.path], tmp_path / "table.npz", ("crop",))
    assert grown.views.tolist() == whole.views.tolist() + ["crop"] * 5
    assert np.array_equal(grown.descriptors[: len(whole)], whole.descriptors)


def test_a_shape_that_is_removed_meanwhile_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = exact_store(tmp_path / "store.zarr", 4)

    def thief(u, grid, rng):
        shutil.rmtree(store.path / "draws" / "000001", ignore_errors=True)
        return View(u, grid)

    monkeypatch.setitem(VIEWS, "field", thief)
    table = describe([store.path], tmp_path / "table.npz", ("field",))
    assert table.shapes.tolist() == ["store/000000", "store/000003"]


@pytest.mark.slow
def test_workers_measure_the_same(tmp_path: Path) -> None:
    store = exact_store(tmp_path / "store.zarr", 6)
    alone = describe([store.path], tmp_path / "alone.npz", ("mask", "crop"))
    with cluster(2) as workers:
        table = describe([store.path], tmp_path / "table.npz", ("mask", "crop"), workers=workers)
    order, other = (np.lexsort((each.views, each.shapes)) for each in (table, alone))
    assert np.array_equal(table.shapes[order], alone.shapes[other])
    expected = alone.descriptors[other]  # a worker has one thread, which sums in another order
    assert table.descriptors[order] == pytest.approx(expected, rel=1e-3, abs=1e-3, nan_ok=True)


def test_a_view_without_a_surface_is_a_row_without_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def empty(u, grid, rng):
        raise NoSurface("expected a surface, got none")

    monkeypatch.setitem(VIEWS, "crop", empty)
    table = describe([exact_store(tmp_path / "store.zarr", 2).path], tmp_path / "table.npz", ("mask", "crop"))
    assert table.visible.views.tolist() == ["mask", "mask"]
    assert np.isnan(table.descriptors[table.views == "crop"]).all()


def test_parameters_are_those_of_the_law_in_its_gauge() -> None:
    law, mass = preset("trabec").coefficients, -0.5
    assert law.a20 != 1
    parameters = parameters_of(law, mass)
    assert len(parameters) == len(PARAMETERS)
    assert parameters_of(law.scale(3.0), mass) == pytest.approx(parameters)
    back, m = law_of(parameters)
    assert list(back) == pytest.approx(list(law.scale(1 / law.a20)))
    assert m == mass
    for a20, a02 in ((0.0, 1.0), (1.0, 0.0), (1.0, -2.0)):
        with pytest.warns(UserWarning, match="keep the energy bounded below"):
            unbounded = Coefficients(a20, 0.0, a02)
        with pytest.raises(ValueError, match="a20"):
            parameters_of(unbounded, mass)


def small_table(rows: int = 3) -> Table:
    rng, names = np.random.default_rng(0), np.array([f"s/{k:06d}" for k in range(rows)])
    return Table(names, np.array(["mask"] * rows), rng.random((rows, 6)), rng.random((rows, sum(BLOCKS.values()))), {})


def test_damaged_tables_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table.npz"
    with pytest.raises(FileNotFoundError, match="table"):
        load_table(path)
    save_table(small_table(), path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="table"):
        load_table(path)
    np.savez(path, descriptors=np.ones(3))
    with pytest.raises(ValueError, match="table"):
        load_table(path)
    save_table(small_table(), path)
    monkeypatch.setitem(BLOCKS, "another", 2)
    with pytest.raises(ValueError, match="blocks"):
        load_table(path)
    with pytest.raises(ValueError, match="shape"):
        Table(np.array(["s/0"]), np.array(["mask"]), np.zeros((1, 6)), np.zeros((1, 3)), {})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["store.zarr", "-o", "table.txt"], ".npz"),
        (["store.zarr", "-o", "table.npz", "--views", "mask,ghost"], "views"),
        (["nothing.zarr", "-o", "table.npz"], "store"),
        (["store.zarr", "-o", "mine.npz"], "mine.npz"),
        (["store.zarr", "store.zarr", "-o", "table.npz"], "names"),
    ],
)
def test_the_command_refuses_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    exact_store(tmp_path / "store.zarr", 1)
    np.savez(tmp_path / "mine.npz", a=1)
    result = CliRunner().invoke(app, ["atlas", "describe", *arguments, "--workers", "0"])
    assert result.exit_code == 2
    assert words in " ".join(result.stderr.split())
    assert not (tmp_path / "table.npz").exists()


def test_the_command_writes_a_table(tmp_path: Path) -> None:
    exact_store(tmp_path / "store.zarr", 2)
    out = tmp_path / "new" / "table.npz"
    options = ["-o", str(out), "--views", "mask", "--workers", "0"]
    result = CliRunner().invoke(app, ["atlas", "describe", str(tmp_path / "store.zarr"), *options])
    assert result.exit_code == 0, result.stderr
    assert result.stdout.strip() == str(out)
    assert len(load_table(out)) == 2


def test_another_store_of_the_same_name_is_not_taken_for_the_first(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    stores = [exact_store(tmp_path / each / "s.zarr", 1) for each in ("a", "b")]
    describe([stores[0].path], tmp_path / "t.npz", ("field",))
    header = stores[1].path / "zarr.json"
    header.write_text(header.read_text().replace('"seed": 3', '"seed": 4'))
    with pytest.raises(ValueError, match="store"):
        describe([stores[1].path], tmp_path / "t.npz", ("field",))
    describe([stores[1].path], tmp_path / "t.npz", ("field",), overwrite=True)
    assert load_table(tmp_path / "t.npz").provenance["stores"]["s"]["seed"] == 4
