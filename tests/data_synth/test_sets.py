"""Training sets: the same cases whoever makes them and whenever, whole or not at all, as their readers want them."""

from __future__ import annotations

import errno
import json
from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
from flat_recipe import FLAT, SHAPE, flat_recipe

from curvafit.data_synth import sets
from curvafit.data_synth.card import write_card
from curvafit.data_synth.case import Recipe
from curvafit.data_synth.imaging.modality import Imaging
from curvafit.data_synth.sets import SetSpec, build_set, make_cases, read_spec, write_preview
from curvafit.volumes.read import load, read_values


@pytest.fixture(scope="module")
def order(tmp_path_factory: pytest.TempPathFactory) -> SetSpec:
    return SetSpec(flat_recipe(tmp_path_factory.mktemp("shapes") / "s.zarr"))


def sums(folder: Path) -> dict[str, dict[str, str]]:
    return {path.stem: json.loads(path.read_text())["sha256"] for path in sorted((folder / "cases").glob("*.json"))}


def test_nnunet_s_layout(tmp_path, order):
    folder = build_set(tmp_path / "Dataset007_Flat", order, 3)
    listed = json.loads((folder / "dataset.json").read_text())
    assert listed["numTraining"] == 3 and listed["labels"] == {"background": 0, "structure": 1}
    assert listed["channel_names"] == {"0": "flat"} and listed["file_ending"] == ".nii.gz"
    for index in range(3):
        image = nibabel.load(folder / "imagesTr" / f"case_{index:05d}_0000.nii.gz")
        label = nibabel.load(folder / "labelsTr" / f"case_{index:05d}.nii.gz")
        assert image.shape == label.shape == SHAPE[::-1]
        assert image.header.get_zooms() == label.header.get_zooms() == (0.5, 0.5, 1.0)
        assert (image.affine == label.affine).all() and image.header.get_xyzt_units()[0] == "micron"
        values = np.asanyarray(label.dataobj)
        assert set(np.unique(values)) == {0, 1}
        case = order.recipe.case(index)
        assert ((case.field > 0) == values.T).all() and (case.image == np.asanyarray(image.dataobj).T).all()
        record = json.loads((folder / "cases" / f"case_{index:05d}.json").read_text())
        assert (
            Imaging.from_dict(record["imaging"]).contrast.foreground == case.record["imaging"]["contrast"]["foreground"]
        )
        assert set(record["source"][0]["parameters"]) == {"a20", "a11", "a02", "a10", "a01", "a00", "mass"}


@pytest.mark.parametrize("layout", ["monai", "zarr"])
def test_decathlon_s_list(tmp_path, order, layout):
    folder = build_set(tmp_path / "set", SetSpec(order.recipe, layout), 2)
    listed = json.loads((folder / "dataset.json").read_text())
    assert listed["numTraining"] == len(listed["training"]) == 2
    for index, pair in enumerate(listed["training"]):
        image, label = load(folder / pair["image"]), load(folder / pair["label"])
        case = order.recipe.case(index)
        assert image.spacing == label.spacing == case.spacing and image.unit == "um"
        assert (image.values == case.image).all() and (label.values == (case.field > 0)).all()


@pytest.mark.filterwarnings("ignore:NvImgCodec")
def test_monai_reads_it(tmp_path, order):
    data = pytest.importorskip("monai.data", reason="needs MONAI")
    from monai.transforms import LoadImaged

    folder = build_set(tmp_path / "set", SetSpec(order.recipe, "monai"), 2)
    pairs = data.load_decathlon_datalist(str(folder / "dataset.json"), data_list_key="training")
    read = LoadImaged(keys=("image", "label"))(pairs[1])
    assert read["image"].shape == read["label"].shape == SHAPE[::-1]
    assert np.abs(np.diag(read["image"].affine.numpy()))[:3].tolist() == [0.5, 0.5, 1.0]


def test_a_set_goes_on_and_ends_the_same(tmp_path, order):
    whole = build_set(tmp_path / "whole", order, 4)
    part = build_set(tmp_path / "part", order, 2)
    untouched = (part / "labelsTr" / "case_00000.nii.gz").stat().st_mtime_ns
    reports = []
    build_set(part, order, 4, lambda text, share: reports.append((text, share)))
    assert reports == [("3 of 4 cases", 0.75), ("4 of 4 cases", 1.0)]
    assert sums(whole) == sums(part) and len(sums(part)) == 4
    assert (part / "labelsTr" / "case_00000.nii.gz").stat().st_mtime_ns == untouched
    assert json.loads((part / "dataset.json").read_text())["numTraining"] == 4


def test_what_a_killed_run_left_is_made_anew(tmp_path, order):
    folder = build_set(tmp_path / "set", order, 2)
    before = sums(folder)
    (folder / "cases" / "case_00001.json").unlink()  # killed before the record, which comes last
    (folder / "imagesTr" / "case_00001_0000.nii.gz").write_bytes(b"torn")
    build_set(folder, order, 2)
    assert sums(folder) == before
    assert (read_values(folder / "imagesTr" / "case_00001_0000.nii.gz") == order.recipe.case(1).image).all()


@pytest.mark.slow
def test_a_worker_makes_the_same_set(tmp_path, order):
    pytest.importorskip("distributed", reason="needs dask.distributed")
    from curvafit.data_synth import cluster

    with cluster(1) as crew:
        theirs = build_set(tmp_path / "theirs", order, 3, workers=crew)
    assert sums(theirs) == sums(build_set(tmp_path / "ours", order, 3))


def test_a_disk_that_fills_leaves_a_valid_set(tmp_path, order, monkeypatch):
    save, saved = sets.save, []

    def until_full(field, path):
        if len(saved) == 5:  # the image of the third case: its label is there already
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        saved.append(path)
        return save(field, path)

    monkeypatch.setattr(sets, "save", until_full)
    with pytest.raises(OSError, match="No space left on device"):
        build_set(tmp_path / "set", order, 4)
    there = sorted(path.name for path in (tmp_path / "set" / "labelsTr").iterdir())
    assert there == ["case_00000.nii.gz", "case_00001.nii.gz"]
    assert len(list((tmp_path / "set" / "imagesTr").iterdir())) == 2
    assert json.loads((tmp_path / "set" / "dataset.json").read_text())["numTraining"] == 2
    monkeypatch.setattr(sets, "save", save)
    assert len(sums(build_set(tmp_path / "set", order, 4))) == 4


def test_a_list_that_finds_no_room_is_completed_by_the_next_run(tmp_path, order, monkeypatch):
    folder, write = build_set(tmp_path / "set", order, 1), sets.write_content

    def full(path, content):
        if path.name == "dataset.json":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return write(path, content)

    monkeypatch.setattr(sets, "write_content", full)
    with pytest.raises(OSError, match="No space"):
        build_set(folder, order, 3)
    assert len(sums(folder)) >= 1 and json.loads((folder / "dataset.json").read_text())["numTraining"] == 1
    monkeypatch.undo()
    build_set(folder, order, 3)
    assert len(sums(folder)) == 3 and json.loads((folder / "dataset.json").read_text())["numTraining"] == 3


def test_a_run_that_is_stopped_leaves_the_case_that_another_completed(tmp_path, order, monkeypatch):
    folder = build_set(tmp_path / "set", order, 1)
    monkeypatch.setattr(sets, "save", lambda *_, **__: pytest.fail("made again"))
    make_cases(folder, [0])
    (folder / "cases" / "case_00000.json").rename(tmp_path / "record")

    def stopped(field, path):
        (tmp_path / "record").rename(folder / "cases" / "case_00000.json")  # the other is first
        raise KeyboardInterrupt

    monkeypatch.setattr(sets, "save", stopped)
    with pytest.raises(KeyboardInterrupt):
        make_cases(folder, [0])
    assert len(sums(folder)) == 1 and (folder / "imagesTr" / "case_00000_0000.nii.gz").exists()


def test_labels_besides_the_mask(tmp_path, order):
    asked = SetSpec(order.recipe, parts=("distance", "instances", "kappa1", "betti", "centreline"))
    folder = build_set(tmp_path / "set", asked, 1)
    case = asked.recipe.case(0)
    distance = load(folder / "parts" / "distance" / "case_00000.nii.gz")
    assert distance.values.dtype == np.float32 and distance.spacing == case.spacing
    assert ((distance.values > 0) == (case.field > 0)).all()
    pieces = read_values(folder / "parts" / "instances" / "case_00000.nii.gz")
    assert ((pieces > 0) == (case.field > 0)).all()
    record = json.loads((folder / "cases" / "case_00000.json").read_text())
    assert len(record["betti"]) == 3 and record["betti"][0] >= 1
    assert {path.suffix for path in (folder / "parts" / "centreline").iterdir()} == {".graphml"}


def test_labels_are_what_an_image_shows_where_asked(tmp_path, order):
    modality = order.recipe.modality
    wide = replace(modality, base=modality.base.assign({"optics.blur": (1.5, 1.5, 1.5), "visible": 0.1}))
    asked = SetSpec(replace(order.recipe, modality=wide), parts=("distance",))
    folder, case = build_set(tmp_path / "set", asked, 1), asked.recipe.case(0)
    inside = load(folder / "parts" / "distance" / "case_00000.nii.gz").values > 0
    label = read_values(folder / "labelsTr" / "case_00000.nii.gz") > 0
    assert (label == case.labels).all() and label[inside].all() and label.sum() > 1.1 * inside.sum()
    record = json.loads((folder / "cases" / "case_00000.json").read_text())
    assert (
        record["class_fractions"] == [label.mean()]
        and label.mean() > record["volume_fraction"] > 0
        and record["imaging"]["visible"] == 0.1
    )


def test_bad_input(tmp_path, order):
    recipe = order.recipe
    with pytest.raises(ValueError, match="count"):
        build_set(tmp_path / "none", order, 0)
    assert not (tmp_path / "none").exists()
    with pytest.raises(ValueError, match="24 voxels"):
        Recipe(recipe.source, FLAT, (32, 16, 16), 0.5)
    with pytest.raises(ValueError, match="voxels"):
        Recipe(recipe.source, FLAT, (8, 0, 8), 0.5)
    with pytest.raises(ValueError, match="voxel"):
        Recipe(recipe.source, FLAT, SHAPE, 0)
    with pytest.raises(ValueError, match="layout"):
        SetSpec(recipe, "bids")
    with pytest.raises(ValueError, match="depth"):
        SetSpec(recipe, parts=("depth",))
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="folder"):
        build_set(tmp_path / "taken", order, 1)
    with pytest.raises(ValueError, match="taken"):
        read_spec(tmp_path / "taken")
    folder = build_set(tmp_path / "set", order, 1)
    other = SetSpec(Recipe(recipe.source, FLAT, SHAPE, 0.5, seed=5))
    with pytest.raises(ValueError, match="seed"):
        build_set(folder, other, 1)
    with pytest.raises(ValueError, match="nowhere"):
        make_cases(tmp_path / "nowhere", [0])


def test_what_others_began_is_left_alone(tmp_path, order):
    """A set whose first case is still being made may be another process's."""
    folder, other = build_set(tmp_path / "set", order, 1), SetSpec(replace(order.recipe, seed=5))
    (folder / "cases" / "case_00000.json").unlink()
    with pytest.raises(ValueError, match="seed"):
        build_set(folder, other, 1)
    assert read_spec(folder) == order
    header = json.loads((folder / "curvafit.json").read_text())
    (folder / "curvafit.json").write_text(json.dumps(header | {"version": 1}))
    with pytest.raises(ValueError, match="version 1"):
        build_set(folder, order, 1)
    (folder / "curvafit.json").write_text("{}")
    with pytest.raises(ValueError, match="curvafit.json"):
        build_set(folder, other, 1)
    assert (folder / "curvafit.json").read_text() == "{}"


@pytest.mark.parametrize("blend", [0, 0.2])
def test_a_set_that_states_a_blend_goes_on_where_it_is_none(tmp_path, order, blend):
    folder = build_set(tmp_path / "set", order, 1)
    header = json.loads((folder / "curvafit.json").read_text())
    header["order"]["recipe"]["composition"]["blend"] = blend
    (folder / "curvafit.json").write_text(json.dumps(header))
    if blend:
        with pytest.raises(ValueError, match="blends textures"):
            build_set(folder, order, 2)
    else:
        assert len(sums(build_set(folder, order, 2))) == 2


def test_a_damaged_header_is_one_sentence(tmp_path, order):
    folder = build_set(tmp_path / "set", order, 1)
    header = json.loads((folder / "curvafit.json").read_text())
    for where, value in (("recipe", 7), ("layout", "cubes"), ("parts", None), ("recipe", {"source": []})):
        broken = header | {"order": header["order"] | {where: value}}
        (folder / "curvafit.json").write_text(json.dumps(broken))
        with pytest.raises(ValueError, match="curvafit.json"):
            read_spec(folder)
    for bomb in ("[" * 100_000, '{"version": ' + "9" * 5000 + "}", '{"version": NaN}'):
        (folder / "curvafit.json").write_text(bomb)
        with pytest.raises(ValueError, match="curvafit.json"):
            read_spec(folder)


@pytest.mark.parametrize(
    "text", ["{", "null", "[]", '{"imaging": {"spacing": [1, 2]}, "source": {"name": "x"}}', "NaN"]
)
def test_a_damaged_record_of_a_case_is_one_sentence(tmp_path, order, text):
    folder = build_set(tmp_path / "set", order, 1)
    (folder / "cases" / "case_00000.json").write_text(text)
    with pytest.raises(ValueError, match="case_00000.json"):
        write_preview(folder)


def test_the_card_tells_what_a_set_is_and_spares_another_s(tmp_path, order):
    folder = build_set(tmp_path / "set", order, 2)
    text = write_card(folder, "curvafit synth -o set").read_text(encoding="utf-8")
    recipe = order.recipe
    assert "| cases | 2 |" in text
    assert " x ".join(map(str, recipe.shape)) in text
    assert recipe.modality.name in text and all(name in text for name in recipe.modality.ranges)
    assert "`curvafit synth -o set`" in text
    assert "`` curvafit synth -o 's`t' ``" in write_card(folder, "curvafit synth -o 's`t'").read_text(encoding="utf-8")
    build_set(folder, order, 3)
    assert "| cases | 3 |" in write_card(folder).read_text(encoding="utf-8")
    (folder / "card.md").write_text("my own words")
    assert write_card(folder).read_text(encoding="utf-8") == "my own words"


@pytest.mark.parametrize("text", ["{", "[]", '{"class_fractions": [0.1]}'])
def test_a_card_of_a_damaged_record_is_one_sentence(tmp_path, order, text):
    folder = build_set(tmp_path / "set", order, 1)
    (folder / "cases" / "case_00000.json").write_text(text)
    with pytest.raises(ValueError, match="case_00000.json"):
        write_card(folder)
    assert not (folder / "card.md").exists()
