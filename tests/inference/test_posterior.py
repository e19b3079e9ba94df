"""The posterior on tables whose answer is known, its file, and its command."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from emulated import HIGH, LOW
from scripts import example, refused, run

import curvafit.inference.table as room
from curvafit.geometry.description import BLOCKS
from curvafit.inference.posterior import Architecture, Discriminant, Posterior, load_posterior
from curvafit.inference.table import columns_of, mirror_parameters
from curvafit.scan.measures import Reading

training = example("train")
PLANS, train_posterior, save_posterior = training.PLANS, training.train_posterior, training.save_posterior
SMALL = Architecture(components=4, hidden=(64,), transforms=1, dropout=0.0)
NOISE = 0.2
ONCE = (PLANS[0]._replace(epochs=1), PLANS[1]._replace(epochs=1))
#: Which column of the curvature block tells which parameter; the others are not told.
TOLD = {0: 0, 100: 2}


def table(shapes: int = 400, seed: int = 0):
    """Two views of each shape. The mask's curvature block holds a11 and a10, in deviations, in the noise of a fifth of
    them; the crop's in noise of once their size. Of the others nothing is told."""
    rng = np.random.default_rng(seed)
    parameters = rng.uniform(LOW, HIGH, (shapes, 6))
    standard = (parameters - (LOW + HIGH) / 2) / ((HIGH - LOW) / np.sqrt(12))
    descriptors = np.ones((2 * shapes, sum(BLOCKS.values()))) + 0.01 * rng.standard_normal((2 * shapes, 1))
    for column, k in TOLD.items():
        for first, noise in ((0, NOISE), (shapes, 1.0)):
            told = standard[:, k] + noise * rng.standard_normal(shapes)
            descriptors[first : first + shapes, column : column + 40] = 5 + told[:, None]
    names = np.array([f"s/{i:06d}" for i in range(shapes)])
    views = np.repeat(["mask", "crop"], shapes)
    thickness, amount = rng.uniform(5, 12, shapes), 10 ** rng.uniform(2, 4, shapes)
    columns = (np.tile(parameters, (2, 1)), np.tile(thickness, 2), descriptors, np.tile(amount, 2))
    return training.Table(np.tile(names, 2), views, *columns, {})


def columns(rows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return rows.descriptors, rows.views, rows.amount


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    plans = (PLANS[0]._replace(rate=1e-2, epochs=30), PLANS[1]._replace(epochs=8))
    return train_posterior(table(800), SMALL, members=2, plans=plans)


@pytest.fixture(scope="module")
def raw() -> Posterior:
    """The packaged one: what a file holds, what is refused."""
    return load_posterior()


@pytest.mark.slow
def test_it_tells_what_the_descriptors_hold_and_no_more(posterior: Posterior) -> None:
    """Of a uniform parameter seen in Gaussian noise of a fifth of its deviation nearly all, of the others nothing."""
    fresh, spread = table(200, seed=1), (HIGH - LOW) / np.sqrt(12)
    for view, told in (("mask", (0.15, 0.45)), ("crop", (0.55, 0.85))):
        seen = fresh.select_views([view])
        draws = posterior.sample(*columns(seen), 200)[..., :6]
        width = draws.std(1).mean(0) / spread
        for k in range(6):
            low, high = told if k in TOLD.values() else (0.9, 1.1)
            assert low < width[k] < high, (view, k)
        rank = (draws < seen.parameters[:, None]).mean(1)
        inside = ((rank > 0.05) & (rank < 0.95)).mean()
        assert 0.86 < inside < 0.94  # 1200 ranks: 0.9 ± 0.01, and what 800 shapes leave unlearnt


@pytest.mark.slow
def test_what_tells_the_mass_is_not_hidden_by_dropout() -> None:
    """A line of the descriptors, rising in one view and falling in the other, tells the mass but for a tenth."""
    plans = (PLANS[0]._replace(epochs=20), ONCE[1])
    rows, spread = table(500), (HIGH - LOW)[5] / np.sqrt(12)
    mass = (rows.parameters[:, 5] - (LOW + HIGH)[5] / 2) / spread
    told = np.where(rows.views == "mask", mass, -mass) + 0.1 * np.random.default_rng(3).standard_normal(len(rows))
    rows.descriptors[:, 40:80] = 5 + told[:, None]
    known = np.isin(rows.shapes, np.unique(rows.shapes)[:400])
    learnt = train_posterior(rows.rows(known), dataclasses.replace(SMALL, dropout=0.5), members=1, plans=plans)
    for view in ("mask", "crop"):
        fresh = rows.rows(~known).select_views([view])
        draws = learnt.sample(*columns(fresh), 200)[..., 5]
        assert np.std(draws.mean(1) - fresh.parameters[:, 5]) < 0.2 * spread
        assert draws.std(1).mean() < 0.25 * spread


def test_draws_lie_in_the_box_and_come_back(raw: Posterior) -> None:
    row = table(1, seed=2).select_views(["mask"])
    draws = raw.sample(*columns(row), 500, seed=3)[0]
    low, high = raw.box.T
    rim = 0.025 * (high - low)
    assert draws.shape == (500, 7)
    assert ((draws > low - rim) & (draws < high + rim)).all()
    assert np.array_equal(draws, raw.draw(Reading(row.descriptors, "mask", row.amount[0]), 500, seed=3))
    assert not np.array_equal(draws, raw.sample(*columns(row), 500, seed=4)[0])
    assert raw.from_logits(raw.to_logits(draws)) == pytest.approx(draws, rel=1e-4)


def test_views_that_it_does_not_know_and_descriptors_that_are_not_finite_are_refused(raw: Posterior) -> None:
    rows = table(2, seed=2).select_views(["mask"])
    with pytest.raises(ValueError, match="ghost"):
        raw.sample(rows.descriptors, np.array(["ghost"] * 2), rows.amount)
    rows.descriptors[1, 5] = np.nan
    with pytest.raises(ValueError, match="finite"):
        raw.sample(*columns(rows))


def test_a_file_holds_it(raw: Posterior, tmp_path: Path) -> None:
    path = tmp_path / "posterior.npz"
    weights = np.ones(len(raw.compression.mean), np.float32)
    raw = dataclasses.replace(raw, discriminants={"mask": Discriminant(weights, np.arange(3.0))})
    save_posterior(raw, path)
    again, row = load_posterior(path), columns(table(1, seed=2).select_views(["mask"]))
    assert np.array_equal(again.sample(*row, 50), raw.sample(*row, 50))
    assert again.provenance == raw.provenance
    assert [*again.discriminants] == ["mask"] and again.discriminants["mask"].reference.tolist() == [0, 1, 2]
    assert np.array_equal(again.discriminants["mask"].weights, weights)
    content = path.read_bytes()
    path.write_bytes(content[:1000])
    with pytest.raises(ValueError, match="damaged"):
        load_posterior(path)
    path.write_bytes(content)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BLOCKS, "another", 2)
        with pytest.raises(ValueError, match="train it again"):
            load_posterior(path)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_posterior(tmp_path / "nowhere.npz")


@pytest.mark.parametrize(
    "name", ["mean", "basis", "box", "0.flow.transform.transforms.0.hyper.0.weight", "weights.mask"]
)
def test_a_file_with_arrays_of_other_shapes_is_refused(raw: Posterior, tmp_path: Path, name: str) -> None:
    path = tmp_path / "posterior.npz"
    told = Discriminant(np.ones(len(raw.compression.mean), np.float32), np.arange(3.0))
    save_posterior(dataclasses.replace(raw, discriminants={"mask": told}), path)
    arrays = dict(np.load(path))
    arrays[name] = arrays[name][:-1]
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match="posterior"):
        load_posterior(path)


@pytest.mark.parametrize(
    ("sizes", "word"),
    [({"hidden": (10**9,)}, "whole numbers"), ({"dropout": 1.5}, "dropout")],
)
def test_an_architecture_has_bounds(sizes: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        Architecture(**sizes)


def test_components_are_uncorrelated_and_the_first_are_the_largest() -> None:
    rows = np.random.default_rng(0).random((300, sum(BLOCKS.values()))) + 0.5
    components = training.compression_of(rows, SMALL.components)(rows)
    variance = components.var(0)
    assert variance.mean() == pytest.approx(1, abs=0.02)
    assert (np.diff(variance) < 0).all()
    assert np.corrcoef(components.T) == pytest.approx(np.eye(SMALL.components), abs=0.02)


def test_blocks_are_chosen_by_name() -> None:
    rows, names = np.random.default_rng(0).random((3, sum(BLOCKS.values()))) + 0.5, np.array(room.column_names())
    assert columns_of(rows, ["curvature", "fabric"]) == pytest.approx(rows[:, np.isin(names, ["curvature", "fabric"])])
    assert columns_of(rows, ["fraction"]) == pytest.approx(np.log(rows[:, names == "fraction"]))


def test_shapes_and_flows_that_do_not_do_are_refused() -> None:
    fixed = table(20)
    fixed.parameters[:, 2] = 7.0
    counts = ((table(20), count, "flows") for count in (0, 65))
    for rows, members, word in ((table(7), 1, "8 laws"), (fixed, 1, "a10"), *counts):
        with pytest.raises(ValueError, match=word):
            train_posterior(rows, SMALL, members=members)


@pytest.mark.slow
def test_the_command(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(training, "PLANS", ONCE)
    source, out = tmp_path / "table.npz", tmp_path / "posterior.npz"
    training.save_table(table(130), source)
    run(training, "train", source, "-o", out, "--views", "mask")
    assert capsys.readouterr().out.strip() == str(out)
    assert load_posterior(out).views == ("mask",)


def test_the_command_refuses_and_writes_nothing(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    training.save_table(table(5), "table.npz")
    for words, said in {
        "nothing.npz -o posterior.npz --views mask": "nothing.npz", "table.npz -o posterior.pt --views mask": ".npz",
        "table.npz -o table.npz --views mask": "input", "table.npz -o posterior.npz --views ghost": "ghost",
        "table.npz -o posterior.npz --views mask": "shapes",
    }.items():  # fmt: skip
        refused(training, said, capsys, "train", *words.split())
        assert [path.name for path in tmp_path.iterdir()] == ["table.npz"]


def test_mirrored_parameters_are_those_of_the_mirrored_law() -> None:
    rows = np.random.default_rng(0).uniform(LOW, HIGH, (20, 6))
    assert mirror_parameters(mirror_parameters(rows)) == pytest.approx(rows)
    for row in rows:
        six, mass = room.law_of(row)
        other = six.mirror()
        assert mirror_parameters(row) == pytest.approx(room.parameters_of(other.scale(1 / float(other.a20)), -mass))
