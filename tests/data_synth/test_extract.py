"""Views of shapes, and the table of their descriptors: complete, the same however often stopped, refused if damaged."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from exact import Gyroid, centres, profile
from exact_store import exact_record, exact_store
from scripts import example, refused

from curvafit.geometry.description import BLOCKS, descriptors
from curvafit.inference import table as tables
from curvafit.inference.table import column_names, law_of, parameters_of
from curvafit.priors import Coefficients, Grid, preset
from curvafit.scan.measures import read_texture
from curvafit.scan.preparation import WORKING_THICKNESS, prepare, thinner_thickness
from curvafit.volumes.volume import ScanError

script = example("train")
VIEWS, describe, load_table, save_table = dict(script.VIEWS), script.describe, script.load_table, script.save_table
FAST = ("field", "mask")


def see(patch: pytest.MonkeyPatch, *names: str) -> None:
    """Let shapes be seen in some views alone."""
    patch.setattr(script, "VIEWS", {name: VIEWS[name] for name in names})


def gyroid(n: int = 48) -> tuple[np.ndarray, Grid]:
    grid = Grid((n, n, n))
    return profile(Gyroid(0.24), centres(grid), 0.02).float().numpy(), grid


@pytest.mark.parametrize("name", VIEWS)
def test_a_view_shows_the_shape(name: str) -> None:
    """Eight voxels thick, all but a field; and as much of it as there is."""
    u, grid = gyroid()
    seen = VIEWS[name](u, np.random.default_rng(1))
    prepared = prepare(seen.scan, kind=seen.kind, periodic=seen.periodic, one_scale=True)
    reading, whole = read_texture(prepared), descriptors(u, grid)
    assert reading is not None and reading.view == ("mask" if name == "field" else name)  # symmetry leaves few values
    thickness = thinner_thickness(u > 0)
    assert reading.amount == pytest.approx(grid.shape[0] ** 3 / thickness**3, rel=0.35)
    assert prepared.thickness == pytest.approx(thickness if name == "field" else WORKING_THICKNESS, rel=0.03)
    scale = thickness / prepared.thickness
    row, names = reading.descriptors, np.array(column_names())
    assert row[names == "fraction"] == pytest.approx(whole.fraction, abs=0.03)
    assert row[names == "chords"][3:7] * scale == pytest.approx(whole.chords[3:7], abs=0.02)  # 0.01 is a voxel
    area = whole.densities[0]
    assert row[names == "densities"][0] / scale == pytest.approx(area, rel=0.15)


@pytest.mark.parametrize("name", ["mask", "scan"])
def test_a_view_depends_on_its_generator_alone(name: str) -> None:
    u, _ = gyroid()
    first, again, other = (VIEWS[name](u, np.random.default_rng(seed)).scan.values for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_a_scan_is_blurred_and_noisy() -> None:
    """As its grey levels show; slices are two voxels thick."""
    seen = VIEWS["scan"](gyroid()[0], np.random.default_rng(1))
    quality = prepare(seen.scan, kind=seen.kind, one_scale=True).quality
    assert seen.scan.spacing == (2.0, 1.0, 1.0) and quality is not None
    assert quality.blur == pytest.approx(script.BLUR, abs=0.5)
    assert quality.noise == pytest.approx(1 / script.SNR, rel=0.05)


def test_what_is_pooled_is_as_if_one_scan_had_shown_it() -> None:
    """Five shapes of one law and one of another: pairs, and four; means of descriptors, sums of what was seen."""
    rows = small_table(6)
    rows.parameters[:5] = rows.parameters[0]
    pooled = rows.pooled
    assert len(pooled) == 6 + 2 + 1
    assert pooled.descriptors[:6] == pytest.approx(rows.descriptors)
    assert pooled.descriptors[6:8] == pytest.approx(rows.descriptors[:4].reshape(2, 2, -1).mean(1))
    assert pooled.descriptors[8] == pytest.approx(rows.descriptors[:4].mean(0))
    assert pooled.amount[8] == pytest.approx(rows.amount[:4].sum())
    assert (pooled.parameters[6:] == rows.parameters[0]).all()


def test_a_table_has_each_view_of_each_shape(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    see(monkeypatch, *FAST)
    store = exact_store(tmp_path / "store", 8)
    table = describe([store.path], tmp_path / "table.npz")
    viable = [index for index in range(8) if index % 7 != 2]
    rows = [(f"store/{index:06d}", view) for index in viable for view in FAST]
    assert sorted(zip(table.shapes, table.views, strict=True)) == rows
    assert table.descriptors.shape == (2 * len(viable), len(column_names()))
    columns = (table.shapes, table.views, table.parameters, table.descriptors)
    for shape, view, parameters, row in zip(*columns, strict=True):
        index = int(shape[-6:])
        record, u = exact_record(index), store.field(index)
        assert np.array_equal(parameters, parameters_of(record.coefficients, record.mass))
        seen = VIEWS[view](u, np.random.default_rng([record.seed, *view.encode()]))
        reading = read_texture(prepare(seen.scan, kind=seen.kind, periodic=seen.periodic, one_scale=True))
        assert reading is not None and row == pytest.approx(reading.descriptors, rel=1e-5, abs=1e-5)
    assert load_table(tmp_path / "table.npz").provenance["stores"]["store"]["seed"] == store.settings.seed


def test_a_stopped_table_goes_on_and_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    see(monkeypatch, *FAST)
    store = exact_store(tmp_path / "store", 4)
    whole = describe([store.path], tmp_path / "whole.npz")
    measured: list[int] = []

    def stops(u, rng):
        measured.append(1)
        if len(measured) == 2:
            raise KeyboardInterrupt
        return script.see_field(u, rng)

    with monkeypatch.context() as patch:
        patch.setitem(script.VIEWS, "field", stops)
        with pytest.raises(KeyboardInterrupt):
            describe([store.path], tmp_path / "table.npz")
    assert len(load_table(tmp_path / "table.npz")) == 2
    table = describe([store.path], tmp_path / "table.npz")
    for name in ("shapes", "views", "parameters", "descriptors"):
        assert np.array_equal(getattr(table, name), getattr(whole, name)), name
    exact_store(store.path, 6, first=4)
    see(monkeypatch, "scan")
    grown = describe([store.path], tmp_path / "table.npz")
    assert grown.views.tolist() == whole.views.tolist() + ["scan"] * 5
    assert np.array_equal(grown.descriptors[: len(whole)], whole.descriptors)


def test_a_view_without_a_surface_is_a_row_without_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    see(monkeypatch, "mask", "scan")
    monkeypatch.setitem(script.VIEWS, "scan", Mock(side_effect=ScanError("expected a surface, got none")))
    table = describe([exact_store(tmp_path / "store", 2).path], tmp_path / "table.npz")
    assert table.visible.views.tolist() == ["mask", "mask"]
    assert np.isnan(table.descriptors[table.views == "scan"]).all()


def test_parameters_are_those_of_the_law_in_its_gauge() -> None:
    law, mass = preset("trabec").coefficients, -0.5
    assert law.a20 != 1
    parameters = parameters_of(law, mass)
    assert len(parameters) == len(tables.PARAMETERS)
    assert parameters_of(law.scale(3.0), mass) == pytest.approx(parameters)
    back, m = law_of(parameters)
    assert list(back) == pytest.approx(list(law.scale(1 / law.a20)))
    assert m == mass
    for a20, a02 in ((0.0, 1.0), (1.0, 0.0), (1.0, -2.0)):
        with pytest.warns(UserWarning, match="keep the energy bounded below"):
            unbounded = Coefficients(a20, 0.0, a02)
        with pytest.raises(ValueError, match="a20"):
            parameters_of(unbounded, mass)


def small_table(rows: int = 3):
    rng, names = np.random.default_rng(0), np.array([f"s/{k:06d}" for k in range(rows)])
    return script.Table(
        names, np.array(["mask"] * rows), rng.random((rows, 6)), rng.uniform(4, 9, rows),
        rng.random((rows, sum(BLOCKS.values()))), rng.uniform(100, 900, rows), {},
    )  # fmt: skip


def test_descriptors_may_be_stored_as_steps(tmp_path: Path) -> None:
    """Half precision whose bits go up and down, scaled to a range by column."""
    path, table = tmp_path / "table.npz", small_table()
    save_table(table, path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name != "descriptors"}
    halves = np.random.default_rng(1).normal(size=table.descriptors.shape).astype(np.float16)
    steps = np.diff(halves.view(np.uint16).ravel(), prepend=np.uint16(0)).reshape(halves.shape)
    span, least = np.linspace(1, 2, halves.shape[1], dtype=np.float32), np.float32(-3)
    np.savez(path, steps=np.stack([steps & 255, steps >> 8]).astype(np.uint8), span=span, least=least, **arrays)
    assert np.array_equal(load_table(path).descriptors, halves * span + least)


def test_damaged_tables_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table.npz"
    with pytest.raises(FileNotFoundError, match="table"):
        load_table(path)
    save_table(small_table(), path)
    content = path.read_bytes()
    for damage in (
        lambda: path.write_bytes(content[: len(content) // 2]),
        lambda: np.savez(path, descriptors=np.ones(3)),
    ):
        damage()
        with pytest.raises(ValueError, match="table"):
            load_table(path)
    save_table(small_table(), path)
    monkeypatch.setitem(BLOCKS, "another", 2)
    with pytest.raises(ValueError, match="blocks"):
        load_table(path)
    with pytest.raises(ValueError, match="shape"):
        empty = np.zeros((1, 6)), np.ones(1), np.zeros((1, 3)), np.ones(1)
        script.Table(np.array(["s/0"]), np.array(["mask"]), *empty, {})


def test_the_command_refuses_in_one_sentence(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    exact_store(tmp_path / "store", 1)
    np.savez(tmp_path / "mine.npz", a=1)
    for words, key in {
        "store -o table.txt": ".npz",
        "nothing -o table.npz": "store", "store -o mine.npz": "mine.npz",
        "store store -o table.npz": "names",
    }.items():  # fmt: skip
        refused(script, key, capsys, "describe", *words.split())
        assert not (tmp_path / "table.npz").exists()


def test_another_store_of_the_same_name_is_not_taken_for_the_first(tmp_path, monkeypatch) -> None:
    see(monkeypatch, "field")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    first, store = (exact_store(tmp_path / each / "s", 1).path for each in ("a", "b"))
    describe([first], tmp_path / "t.npz")
    header = store / "curvafit.json"
    header.write_text(header.read_text().replace('"seed": 3', '"seed": 4'))
    with pytest.raises(ValueError, match="store"):
        describe([store], tmp_path / "t.npz")
    describe([store], tmp_path / "t.npz", overwrite=True)
    assert load_table(tmp_path / "t.npz").provenance["stores"]["s"]["seed"] == 4
