"""Training sets: the same cases whoever makes them and whenever, whole or not at all, as their readers want them."""

import errno
import json
import shutil
from dataclasses import replace
from functools import reduce
from pathlib import Path
from unittest.mock import Mock

import nibabel
import numpy as np
import pytest
from exact_store import CROP as SHAPE
from exact_store import flat_recipe

from curvafit.data_synth import sets
from curvafit.data_synth.sets import SetSpec, build_set, describe_set, make_case, read_spec
from curvafit.volumes.read import load


@pytest.fixture(scope="module")
def order(tmp_path_factory: pytest.TempPathFactory) -> SetSpec:
    return SetSpec(flat_recipe(tmp_path_factory.mktemp("shapes") / "s"))


def sums(folder: Path) -> dict[str, dict[str, str]]:
    return {path.stem: json.loads(path.read_text())["sha256"] for path in sorted((folder / "cases").glob("*.json"))}


@pytest.mark.parametrize("layout", ["nnunet", "monai", "zarr"])
def test_a_layout_holds_the_cases(tmp_path, order, layout):
    """Images, labels, spacing and unit as a reader of the layout finds them, in the list that it looks for."""
    folder = build_set(tmp_path / "set", SetSpec(order.recipe, layout), 2)
    listed = json.loads((folder / "dataset.json").read_text())
    assert listed["numTraining"] == 2
    if layout == "nnunet":
        assert listed["labels"] == {"background": 0, "structure": 1}
        assert listed["channel_names"] == {"0": "flat"} and listed["file_ending"] == ".nii.gz"
        pairs = [(f"imagesTr/case_{k:05d}_0000.nii.gz", f"labelsTr/case_{k:05d}.nii.gz") for k in range(2)]
        header = nibabel.load(folder / pairs[0][0]).header
        assert header.get_zooms() == (0.5, 0.5, 1.0) and header.get_xyzt_units()[0] == "micron"
    else:
        pairs = [(pair["image"], pair["label"]) for pair in listed["training"]]
    for index, (image, label) in enumerate(pairs):
        case, image, label = order.recipe.case(index), load(folder / image), load(folder / label)
        assert image.spacing == label.spacing == case.spacing and image.unit == label.unit == "um"
        assert (image.values == case.image).all() and (label.values == (case.field > 0)).all()
    record = json.loads((folder / "cases" / "case_00001.json").read_text())
    assert record["imaging"]["contrast"]["foreground"] == case.record["imaging"]["contrast"]["foreground"]
    assert set(record["source"]["parameters"]) == {"a20", "a11", "a02", "a10", "a01", "a00", "mass"}


def test_a_set_is_described_beside_a_mask(tmp_path, order):
    """Its own label is as thick and fills as much; a plate of four layers of 1 um is 4 um thick."""
    folder = build_set(tmp_path / "set", order, 1)
    label = load(folder / "labelsTr" / "case_00000.nii.gz").values > 0
    (same,) = describe_set(folder, label)
    labels, _, mask = same.partition("; your mask: ")
    assert labels.removeprefix("labels: ").replace(" µm thick", "").removesuffix(" inside") == mask
    assert mask.endswith(f", {100 * label.mean():.1f} %")
    plate = np.zeros((12, 16, 16), bool)
    plate[4:8] = True
    assert describe_set(folder, plate)[0].endswith("; your mask: 4, 33.3 %")
    record = folder / "cases" / "case_00000.json"
    content = json.loads(record.read_text())
    content["source"]["status"] = "still moving after 9 steps: the energy fell by 3 % over the last tenth"
    record.write_text(json.dumps(content))
    assert describe_set(folder) == ["1 of 1 shapes had not come to rest"]


def test_a_set_goes_on_and_ends_the_same(tmp_path, order):
    """As does one of which a killed run left a torn case."""
    whole = build_set(tmp_path / "whole", order, 4)
    part = build_set(tmp_path / "part", order, 2)
    untouched = (part / "labelsTr" / "case_00000.nii.gz").stat().st_mtime_ns
    reports = []
    build_set(part, order, 4, lambda text, share: reports.append((text, share)))
    assert reports == [("3 of 4 cases", 0.75), ("4 of 4 cases", 1.0)]
    assert sums(whole) == sums(part) and len(sums(part)) == 4
    assert (part / "labelsTr" / "case_00000.nii.gz").stat().st_mtime_ns == untouched
    assert json.loads((part / "dataset.json").read_text())["numTraining"] == 4
    torn = whole / "imagesTr" / "case_00001_0000.nii.gz"
    torn.write_bytes(b"torn")
    (whole / "cases" / "case_00001.json").unlink()  # killed before the record, which comes last
    build_set(whole, order, 4)
    assert sums(whole) == sums(part) and (load(torn).values == order.recipe.case(1).image).all()


@pytest.mark.slow
def test_a_worker_makes_the_same_set(tmp_path, order):
    pytest.importorskip("distributed", reason="needs dask.distributed")
    from curvafit.core.workers import cluster

    with cluster(1) as crew:
        theirs = build_set(tmp_path / "theirs", order, 3, workers=crew)
    assert sums(theirs) == sums(build_set(tmp_path / "ours", order, 3))


full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))


def test_a_disk_that_fills_leaves_a_valid_set(tmp_path, order, monkeypatch):
    save, saved = sets.save, []

    def until_full(field, path):
        saved.append(path)
        return full() if len(saved) == 6 else save(field, path)  # an image, whose label is there

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

    def write_others(path, content):
        return full() if path.name == "dataset.json" else write(path, content)

    monkeypatch.setattr(sets, "write_content", write_others)
    with pytest.raises(OSError, match="No space"):
        build_set(folder, order, 3)
    assert len(sums(folder)) >= 1 and json.loads((folder / "dataset.json").read_text())["numTraining"] == 1
    monkeypatch.undo()
    build_set(folder, order, 3)
    assert len(sums(folder)) == 3 and json.loads((folder / "dataset.json").read_text())["numTraining"] == 3


def test_a_run_that_is_stopped_leaves_the_case_that_another_completed(tmp_path, order, monkeypatch):
    folder = build_set(tmp_path / "set", order, 1)
    monkeypatch.setattr(sets, "save", lambda *_, **__: pytest.fail("made again"))
    make_case(folder, 0)
    (folder / "cases" / "case_00000.json").rename(tmp_path / "record")

    def stopped(field, path):
        (tmp_path / "record").rename(folder / "cases" / "case_00000.json")  # the other is first
        raise KeyboardInterrupt

    monkeypatch.setattr(sets, "save", stopped)
    with pytest.raises(KeyboardInterrupt):
        make_case(folder, 0)
    assert len(sums(folder)) == 1 and (folder / "imagesTr" / "case_00000_0000.nii.gz").exists()


@pytest.mark.filterwarnings("ignore:NvImgCodec")
def test_monai_reads_it(folder):
    data = pytest.importorskip("monai.data", reason="needs MONAI")
    from monai.transforms import LoadImaged

    pairs = data.load_decathlon_datalist(str(folder / "dataset.json"), data_list_key="training")
    read = LoadImaged(keys=("image", "label"))(pairs[0])
    assert read["image"].shape == read["label"].shape == SHAPE[::-1]
    assert np.abs(np.diag(read["image"].affine.numpy()))[:3].tolist() == [0.5, 0.5, 1.0]


@pytest.fixture(scope="module")
def wide(order: SetSpec) -> SetSpec:
    """A set with further labels, whose masks are what an image shows."""
    modality = order.recipe.modality
    seen = replace(modality, base=modality.base.assign({"optics.blur": (1.5, 1.5, 1.5), "visible": 0.1}))
    parts = ("distance", "instances", "kappa1", "betti", "centreline")
    return SetSpec(replace(order.recipe, modality=seen), "monai", parts)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, wide: SetSpec) -> Path:
    return build_set(tmp_path_factory.mktemp("wide") / "set", wide, 1)


def test_labels_besides_the_mask_are_of_the_structure_itself(folder, wide):
    """Masks are what an image shows where asked, and wider."""
    case, parts = wide.recipe.case(0), folder / "parts"
    distance = load(parts / "distance" / "case_00000.nii.gz")
    assert distance.values.dtype == np.float32 and distance.spacing == case.spacing
    inside = case.field > 0
    assert ((distance.values > 0) == inside).all()
    assert ((load(parts / "instances" / "case_00000.nii.gz").values > 0) == inside).all()
    assert {path.suffix for path in (parts / "centreline").iterdir()} == {".graphml"}
    label = load(folder / "labelsTr" / "case_00000.nii.gz").values > 0
    assert (label == case.labels).all() and label[inside].all() and label.sum() > 1.1 * inside.sum()
    record = json.loads((folder / "cases" / "case_00000.json").read_text())
    assert len(record["betti"]) == 3 and record["betti"][0] >= 1
    assert record["label_fraction"] == label.mean() and label.mean() > record["volume_fraction"] > 0
    assert record["imaging"]["visible"] == 0.1


def test_what_others_began_is_left_alone(tmp_path, folder, wide):
    """A set whose first case is still being made may be another process's."""
    begun = tmp_path / "set"
    begun.mkdir()
    shutil.copy(folder / "curvafit.json", begun)
    with pytest.raises(ValueError, match="seed"):
        build_set(begun, replace(wide, recipe=replace(wide.recipe, seed=5)), 1)
    assert read_spec(begun) == wide and [each.name for each in begun.iterdir()] == ["curvafit.json"]


#: Headers and records that are refused: as whole texts, or as entries in place of those that are there.
TORN = ("{", "null", "[]", "NaN", "[" * 100_000, '{"version": ' + "9" * 5000 + "}", '{"version": NaN}', "{}")
HEADERS = {"version": 1, "order.recipe": 7, "order.layout": "cubes", "order.parts": None, "order.recipe.source": []}


@pytest.mark.parametrize("wrong", [*TORN, *HEADERS])
def test_a_damaged_header_is_one_sentence(tmp_path, folder, wide, wrong):
    """And is left alone."""
    file, header = tmp_path / "curvafit.json", json.loads((folder / "curvafit.json").read_text())
    if wrong in HEADERS:
        *path, name = wrong.split(".")
        reduce(dict.__getitem__, path, header)[name] = HEADERS[wrong]
    text = json.dumps(header) if wrong in HEADERS else wrong
    file.write_text(text)
    with pytest.raises(ValueError, match="curvafit.json"):
        build_set(tmp_path, wide, 1)
    assert file.read_text() == text
