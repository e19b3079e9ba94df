"""Building resumes to the same draws; atlas files come back within their rounding; a shape that is sought is itself."""

import dataclasses
import json
import types
from pathlib import Path

import numpy as np
import pytest
import torch

from curvafit.data_synth import atlas as building
from curvafit.data_synth.atlas import extract
from curvafit.data_synth.design import INTERVALS, Design, design_box
from curvafit.data_synth.store import open_store
from curvafit.generation.result import Viability
from curvafit.generation.schedule import LEARNED, schedule
from curvafit.geometry.diagrams import Diagram
from curvafit.geometry.distances import one_to_many, wasserstein
from curvafit.inference import atlas as matching
from curvafit.inference.atlas import ARRAYS, Atlas, load_atlas, nearest, save_atlas
from curvafit.priors.coefficients import Coefficients
from curvafit.priors.grid import Grid
from curvafit.priors.profile import optimal_profile

SHAPE = 20


def ball(radius: float) -> torch.Tensor:
    """The phase field of a ball (radius in working units) in the middle of a box of `SHAPE` voxels."""
    axes = (torch.arange(SHAPE) - SHAPE / 2 + 0.25) * 0.01
    z, y, x = torch.meshgrid(axes, axes, axes, indexing="ij")
    return optimal_profile(radius - (z**2 + y**2 + x**2).sqrt(), 0.02).float()


class Balls:
    """Stands for `generate`: a ball sized by the mass, viable where a11 > 0; remembers, may be stopped."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.seeds: list[int] = []
        self.stop_after = stop_after
        self.highest = 1.0

    def __call__(self, coefficients, mass, grid, *, seed, reject_early, **options):
        assert reject_early
        if len(self.seeds) == self.stop_after:
            raise KeyboardInterrupt
        self.seeds.append(seed)
        viable = coefficients.a11 > 0
        history = types.SimpleNamespace(step=np.array([1, 9]), energy=np.array([2.0, 1.0]))
        viability = Viability(0.1, self.highest, -1.0, viable, "" if viable else "a11 is negative")
        field = ball(0.05 + 0.03 * mass)
        return types.SimpleNamespace(field=field, history=history, viability=viability, status="converged")


@pytest.fixture
def balls(monkeypatch):
    stand_in = Balls()
    monkeypatch.setattr(building, "generate", stand_in)
    return stand_in


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> building.Store:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "generate", Balls())
        return building.build(tmp_path_factory.mktemp("balls") / "s", 6, SHAPE, seed=2)


@pytest.fixture(scope="module")
def atlas(store) -> Atlas:
    return extract([store], command=["then this"])


@pytest.fixture(scope="module")
def saved(atlas, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("atlas") / "a.npz"
    save_atlas(atlas, path)
    return path


def test_building_draws_in_order_until_enough_are_viable(tmp_path, balls):
    said = []
    store = building.build(tmp_path / "s", 5, SHAPE, seed=1, progress=lambda *news: said.append(news))
    records = [store.record(index) for index in store.indices()]
    assert store.indices() == list(range(len(records)))
    assert sum(record.viability.viable for record in records) == 5 and records[-1].viability.viable
    assert any(not record.viability.viable for record in records)
    assert [(r.coefficients, r.mass, r.seed) for r in records] == [design_box().draw(1, i) for i in store.indices()]
    assert balls.seeds == [record.seed for record in records]
    viable = np.cumsum([record.viability.viable for record in records])
    assert said == [(f"{n} viable of {i} draws", n / 5) for i, n in enumerate(viable, 1)]
    assert (records[0].steps, records[0].energy) == (9, 1.0)
    assert store.settings.schedule == schedule("fast").as_dict()


def test_an_interrupted_build_resumes_to_the_same_store_and_makes_no_draw_twice(tmp_path, monkeypatch):
    whole, first, second = Balls(), Balls(stop_after=4), Balls()
    monkeypatch.setattr(building, "generate", whole)
    straight = building.build(tmp_path / "straight", 5, SHAPE)
    monkeypatch.setattr(building, "generate", first)
    with pytest.raises(KeyboardInterrupt):
        building.build(tmp_path / "s", 5, SHAPE)
    monkeypatch.setattr(building, "generate", second)
    resumed = building.build(tmp_path / "s", 5, SHAPE)
    assert len(first.seeds) == 4 and first.seeds + second.seeds == whole.seeds
    assert resumed.indices() == straight.indices()
    for index in straight.indices():
        one, other = (dataclasses.replace(s.record(index), seconds=0) for s in (straight, resumed))
        assert one == other
    building.build(tmp_path / "s", 5, SHAPE)
    assert first.seeds + second.seeds == whole.seeds  # a finished store asks for nothing


@pytest.mark.slow
def test_a_real_draw_is_what_its_record_says(tmp_path):
    quick = dataclasses.replace(schedule("fast"), name="quick", steps=30)
    grid = Grid((16,) * 3)
    store = open_store(tmp_path / "s", _settings(grid, quick))
    record = building.make_draw(store.path, 0)
    assert store.record(0) == record and record.versions == building.versions()
    assert 0 < record.steps <= 30 and np.isfinite(record.energy)
    if record.viability.viable:
        assert float(store.field(0).mean()) == pytest.approx(record.mass, abs=1e-6)


def test_wrong_counts_and_other_settings_are_refused(tmp_path, balls):
    with pytest.raises(ValueError, match="count"):
        building.build(tmp_path / "s", 0, SHAPE)
    with pytest.raises(ValueError, match="seed"):
        building.build(tmp_path / "s", 1, SHAPE, seed=-1)
    assert not list(tmp_path.iterdir())
    building.build(tmp_path / "s", 1, SHAPE)
    with pytest.raises(ValueError, match="seed"):
        building.build(tmp_path / "s", 1, SHAPE, seed=3)


def test_an_atlas_holds_what_the_store_does(store, atlas):
    viable = [r for r in map(store.record, store.indices()) if r.viability.viable]
    assert atlas.ids == tuple(f"s-{r.index:05d}" for r in viable)
    assert atlas.coefficients[:6].tolist() == [list(r.coefficients) for r in viable]
    np.testing.assert_array_equal(atlas.masses, [r.mass for r in viable])
    np.testing.assert_array_equal(atlas.seeds, [r.seed for r in viable])
    np.testing.assert_allclose(atlas.volume_fractions[0], np.mean(store.field(viable[0].index) > 0))
    for measured in atlas.diagrams("field"):  # balls: κ1 and κ2 are 1/R all over, the area 4πR²
        κ = np.average(measured.points, axis=0, weights=measured.weights)
        assert measured.weights.sum() * κ[0] * κ[1] == pytest.approx(4 * np.pi, rel=0.12)
    assert atlas.provenance["command"] == ["then this"]
    assert atlas.provenance["settings"]["shape"] == (SHAPE,) * 3
    assert atlas.provenance["stores"]["s"]["seed"] == 2


def test_an_atlas_of_two_stores_holds_both(tmp_path, balls):
    one, other = (building.build(tmp_path / f"{name}", 2, SHAPE, seed=4) for name in ("one", "other"))
    both = extract([one, tmp_path / "other"])
    alone = [extract([store]) for store in (one, other)]
    assert both.ids == alone[0].ids + alone[1].ids and len(set(both.ids)) == 4
    np.testing.assert_array_equal(both.masses, np.concatenate([each.masses for each in alone]))
    assert list(both.provenance["stores"]) == ["one", "other"]


def test_stores_of_one_name_of_two_grids_or_without_shapes_make_no_atlas(tmp_path, balls):
    one = building.build(tmp_path / "one", 1, SHAPE)
    with pytest.raises(ValueError, match="names"):
        extract([one, one])
    larger = open_store(tmp_path / "larger", _settings(Grid((24, 20, 20)), schedule("fast")))
    with pytest.raises(ValueError, match="grid"):
        extract([one, larger])
    with pytest.raises(ValueError, match="well-formed"):
        extract([larger])


def test_faint_and_over_sharp_shapes_stay_in_the_store_and_out_of_the_atlas(tmp_path, balls):
    for count, highest in enumerate((1.0, 0.4, 4.0, 1.5), 1):
        balls.highest = highest
        store = building.build(tmp_path / "s", count, SHAPE)
    assert len(extract([store])) == 2 and sum(map(store.viable, store.indices())) == 4


def test_an_atlas_file_comes_back_within_its_stated_rounding(saved, atlas):
    back = load_atlas(saved)
    assert back.ids == atlas.ids
    assert back.provenance == json.loads(json.dumps(atlas.provenance))
    for name in ("coefficients", "masses", "seeds", "volume_fractions"):
        np.testing.assert_array_equal(getattr(back, name), getattr(atlas, name))
    for view in ("field", "mask"):
        for one, other in zip(atlas.diagrams(view), back.diagrams(view), strict=True):
            assert np.all(np.abs(one.points - other.points) <= 2**-11 * np.abs(one.points) + 2**-24)
            np.testing.assert_allclose(other.weights, one.weights, rtol=2**-23)
            assert other.spread == pytest.approx(one.spread)
    assert [path.name for path in saved.parent.iterdir()] == ["a.npz"]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("masses", lambda values: values + 2), ("coefficients", lambda values: values * np.nan),
        ("mask_offsets", lambda values: values[::-1]), ("field_points", lambda values: values[:-1]),
        ("mask_areas", lambda values: values.astype("S9")),
        ("header", lambda values: np.frombuffer(b"[" * 100_000, np.uint8)),
        ("header", lambda values: np.frombuffer(b'{"format": "another"}', np.uint8)),
        ("header", lambda values: np.frombuffer(values.tobytes().replace(b'"version": 2', b'"version": 3'), np.uint8)),
        ("header", None),
    ],
)  # fmt: skip
def test_an_atlas_with_damaged_arrays_is_one_sentence(tmp_path, saved, name, change):
    with np.load(saved) as archive:
        arrays = dict(archive)
    header = arrays.pop(name)
    np.savez(tmp_path / "atlas.npz", **arrays | ({} if change is None else {name: change(header)}))
    with pytest.raises(ValueError, match=r"^[^\n]*atlas[^\n]{1,400}$"):
        load_atlas(tmp_path / "atlas.npz")


def test_a_damaged_atlas_is_refused_wherever_it_is_cut_and_other_files_are_none(tmp_path, saved):
    whole, path = saved.read_bytes(), tmp_path / "cut.npz"
    parts = [whole[:length] for length in (0, 1, 50, len(whole) // 2, len(whole) - 1)]
    parts += [whole[:k] + bytes(64) + whole[k + 64 :] for k in range(100, len(whole) - 100, len(whole) // 20)]
    for content in parts:
        path.write_bytes(content)
        with pytest.raises(ValueError, match="atlas"):
            load_atlas(path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(ValueError, match="something else"):
        load_atlas(tmp_path / "array.npy")
    for place, word in ((tmp_path / "none.npz", "none.npz"), (tmp_path, "folder")):
        with pytest.raises(FileNotFoundError, match=word):
            load_atlas(place)


def test_arrays_and_requests_that_do_not_fit_are_refused(atlas):
    with pytest.raises(ValueError, match="masses"):
        dataclasses.replace(atlas, masses=atlas.masses[1:])
    with pytest.raises(ValueError, match="diagram"):
        dataclasses.replace(atlas, mask_diagrams=atlas.mask_diagrams[1:])
    empty = Diagram(np.zeros((0, 2)), np.zeros(0))
    for query, options, word in (
        (blob(30), {"count": 0}, "count"),
        (blob(30), {"seen_as": "image"}, "image"),
        (empty, {}, "empty"),
    ):
        with pytest.raises(ValueError, match=word):
            nearest(query, atlas, **options)


def test_the_packaged_atlas_is_of_its_designs_and_small():
    atlas = load_atlas()
    file = building.Path(__file__).parents[2] / "curvafit" / "inference" / "data" / "atlas.npz"
    assert file.stat().st_size < 7e6
    assert len(atlas) >= 800 and len(set(atlas.ids)) == len(atlas)
    stores = atlas.provenance["stores"]
    assert all(store["settings"]["schedule"]["name"] == LEARNED for store in stores.values())
    assert min(atlas.provenance["settings"]["shape"]) >= 64
    for position, name in enumerate(atlas.ids):
        store, index = name.split("-")
        settings = stores[store]["settings"]
        point = (Coefficients(*atlas.coefficients[position]), atlas.masses[position], atlas.seeds[position])
        assert Design.from_dict(settings["design"]).draw(settings["seed"], int(index)) == point
    assert atlas.masses.min() > -0.85 and atlas.masses.max() < INTERVALS["mass"][1]
    assert all(np.isfinite(d.points).all() and d.weights.min() > 0 for d in atlas.diagrams("mask"))
    assert all(line.startswith("curvafit atlas ") for line in atlas.provenance["command"])


# ---- matching --------------------------------------------------------------------------------------------------------


def blob(centre: float) -> Diagram:
    """A cloud of width 5 about a centre (κ1, 0), with κ1 ≥ κ2."""
    points = np.random.default_rng(0).normal((centre, 0.0), 5, (60, 2))
    return Diagram(np.sort(points, axis=1)[:, ::-1].copy(), np.full(60, 0.1)).bin(2.0)


def atlas_of(fields: tuple[Diagram, ...], masks: tuple[Diagram, ...]) -> Atlas:
    n = len(fields)
    numbers = (np.arange(6.0 * n).reshape(n, 6) + 1, -0.1 * np.arange(n), np.arange(n) + 100, np.full(n, 0.3))
    return Atlas(tuple(f"0-{i:05d}" for i in range(n)), *numbers, np.full(n, 8.0), fields, masks, {})


@pytest.fixture(scope="module")
def packaged() -> Atlas:
    return load_atlas()


def test_matches_come_by_distance_with_the_parameters_of_their_shape():
    fields = tuple(blob(30.0 + 10 * k) for k in (3, 0, 2, 1))
    atlas = atlas_of(fields, fields)
    found = nearest(blob(30.0), atlas, count=3)
    assert [match.id for match in found] == ["0-00001", "0-00003", "0-00002"]
    assert found[0].distance == pytest.approx(0, abs=1e-3)
    assert found[1].distance == pytest.approx(wasserstein(blob(30.0), fields[3]), rel=1e-4)
    assert list(found[1].coefficients) == list(atlas.coefficients[3])
    assert (found[1].mass, found[1].seed) == (atlas.masses[3], 103)


def test_a_query_meets_shapes_seen_as_it_is_and_no_fewer_than_it_asks_for(monkeypatch):
    monkeypatch.setattr(matching, "SHORT", 1)
    near, far = blob(30.0), blob(60.0)
    atlas = atlas_of((near, far), (far, near))
    assert nearest(near, atlas, seen_as="field")[0].id == "0-00000"
    assert nearest(near, atlas, seen_as="mask")[0].id == "0-00001"
    assert len(nearest(near, atlas, count=9)) == len(nearest(near, atlas, count=2)) == 2


@pytest.mark.parametrize("seen_as", ["field", "mask"])
def test_every_shape_looked_up_in_the_packaged_atlas_is_itself(packaged, seen_as, monkeypatch):
    monkeypatch.setattr(matching, "SHORT", 2)
    for position in range(0, len(packaged), len(packaged) // 6):
        first, second = nearest(packaged.diagrams(seen_as)[position], packaged, seen_as=seen_as, count=2)
        assert first.id == packaged.ids[position]
        assert first.distance < 0.05 < second.distance


@pytest.mark.slow
def test_the_short_list_keeps_the_true_nearest(packaged, monkeypatch):
    """Against the distances to every third shape, with a third of the default short list: the nearest, and 4 of 5."""
    monkeypatch.setattr(matching, "SHORT", matching.SHORT // 3 + 1)
    names, kept = ("ids", *ARRAYS, "field_diagrams", "mask_diagrams"), 0
    part = dataclasses.replace(packaged, **{name: getattr(packaged, name)[::3] for name in names})
    positions = range(1, len(packaged), len(packaged) // 15 * 3)  # these leave 1 when divided by 3: not in the part
    for position in positions:
        query = packaged.mask_diagrams[position]
        distances = one_to_many(query, part.mask_diagrams)
        truth = [part.ids[i] for i in np.argsort(distances)[:5]]
        matches = [match.id for match in nearest(query, part, seen_as="mask", count=5)]
        assert matches[0] == truth[0]
        kept += len(set(truth) & set(matches))
    assert kept >= 4 * len(positions)


def _settings(grid: Grid, plan) -> building.Settings:
    epsilon, blur = building.WORKING_EPSILON, building.WORKING_BLUR
    return building.Settings(grid.shape, grid.spacing, epsilon, blur, design_box().as_dict(), 0, plan.as_dict())
