"""Pairs on the fly: by number alone, shared out, none twice; and a pool of shapes that are grown once."""

import dataclasses
import hashlib
import os
import pickle
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from exact_store import exact_field, exact_record, exact_store
from found import made_fit
from torch.utils.data import DataLoader

from curvafit.data_synth import dataset as training
from curvafit.data_synth.dataset import Sample, TextureDataset, as_dict, as_monai
from curvafit.data_synth.imaging.effects import occupancy
from curvafit.data_synth.imaging.modality import Contrast, Imaging, Modality, Noise, Optics
from curvafit.data_synth.sources import Generated, apply_symmetry, choose_voxel, crop_periodic
from curvafit.data_synth.store import open_store
from curvafit.priors import preset
from curvafit.volumes import Volume, save

QUIET = Modality("quiet", "for tests", 1.0, Imaging(optics=Optics(blur=(0.5, 0.5, 0.5)), noise=Noise(gaussian=1.0)))
SHAPE = (12, 16, 20)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exact_store(tmp_path_factory.mktemp("shapes") / "s", 8).path


def brief(sample: Sample) -> str:
    voxels = hashlib.sha256(sample.image.numpy().tobytes()).hexdigest()
    return f"{sample.record['index']} {voxels} {sample.record['source']}"


def numbers(samples: Iterable[str]) -> list[int]:
    return [int(each.split()[0]) for each in samples]


def test_a_pair_is_a_crop_of_a_shape_and_its_image(store):
    dataset = TextureDataset(store, QUIET, SHAPE)
    for number in range(4):
        image, label, spacing, record = dataset[number]
        assert image.shape == label.shape == (1, *SHAPE)
        assert image.dtype == torch.float32 and label.dtype == torch.uint8 and spacing == (1.0, 1.0, 1.0)
        origin = record["source"]
        whole = apply_symmetry(open_store(store).field(int(origin["name"].split()[-1])), origin["symmetry"])
        field = crop_periodic(whole, origin["corner"], SHAPE)
        assert (label[0].numpy() == (field > 0)).all()
        share = occupancy(torch.from_numpy(field))  # of which the image is a blur, with little noise
        assert np.corrcoef(image.numpy().ravel(), share.numpy().ravel())[0, 1] > 0.9


def test_samples_depend_on_seed_and_number_alone(store):
    """Workers share an epoch and see the next: one process here; the pool's tests have workers that stay."""
    first = [brief(TextureDataset(store, QUIET, SHAPE, seed=1)[k]) for k in (0, 1, 7)]
    again = TextureDataset(store, QUIET, SHAPE, seed=1, length=3, transform=brief)
    assert [again[k] for k in (0, 1, 7)] == first
    assert len({each.split()[1] for each in first}) == 3
    assert brief(TextureDataset(store, QUIET, SHAPE, seed=2)[0]) != first[0]
    dataset = TextureDataset(store, QUIET, SHAPE, length=5, transform=brief)
    loader = DataLoader(dataset, batch_size=None)
    assert sorted(loader) == sorted(dataset[k] for k in range(5))
    dataset.set_epoch(3)
    assert sorted(numbers(loader)) == list(range(15, 20))


def test_ranks_share_an_epoch_evenly(store, monkeypatch):
    """Spawned workers are outside the group: the data set brings the rank along; elsewhere the live one counts."""

    def join(rank: int, size: int) -> None:
        answers = {"is_available": True, "is_initialized": True, "get_rank": rank, "get_world_size": size}
        for name, value in answers.items():
            monkeypatch.setattr(torch.distributed, name, lambda value=value: value, raising=False)

    dataset, seen = TextureDataset(store, QUIET, SHAPE, length=7, transform=brief), []
    for rank in range(3):
        join(rank, 3)
        found = numbers(dataset)
        assert len(found) == len(dataset) == 2
        seen += found
    assert sorted(seen) == list(range(6))
    sent = pickle.loads(pickle.dumps(dataset))
    join(0, 1)
    assert numbers(sent) == list(range(7))
    monkeypatch.setattr(training, "get_worker_info", lambda: SimpleNamespace(id=0, num_workers=1))
    assert numbers(sent) == [2, 5]


@pytest.mark.filterwarnings("ignore:NvImgCodec")  # MONAI's, of a reader that is not used
@pytest.mark.parametrize("unit", ["nm", "um", "mm", "voxel"])
def test_monai_s_form_is_that_of_a_file(store, tmp_path, unit):
    """A case on the fly and the same case written and loaded have the same voxels at the same places."""
    transforms = pytest.importorskip("monai.transforms", reason="needs MONAI")
    wide = Modality("wide", "for tests", 1.0, Imaging(spacing=(2.1, 1.3, 0.7), unit=unit))
    sample = TextureDataset(store, wide, (4, 6, 8))[0]
    made = as_monai(sample)
    files = {name: tmp_path / f"{name}.nii.gz" for name in made}
    for name, file in files.items():
        save(Volume(getattr(sample, name)[0].numpy(), sample.spacing, unit), file)
    load = [transforms.LoadImaged(list(made), reader="NibabelReader"), transforms.EnsureChannelFirstd(list(made))]
    read = transforms.Compose(load)(files)
    for name in made:
        assert made[name].shape == read[name].shape == (1, 8, 6, 4)
        assert (made[name].numpy() == read[name].numpy()).all()
        assert torch.equal(made[name].affine, read[name].affine)
        assert made[name].meta["space"] == read[name].meta["space"]


def test_one_number_is_a_cube_and_a_name_a_modality(store, tmp_path):
    """Of several calibres and modalities, samples take turns at random."""
    dataset = TextureDataset(store, "Micro_CT", 12, length=5)
    assert dataset[0].image.shape == (1, 12, 12, 12) and dataset[0].record["modality"] == "micro-ct"
    batch = next(iter(DataLoader(TextureDataset(store, "micro-ct", 12, transform=as_dict), batch_size=3)))
    assert batch["image"].shape == batch["label"].shape == (3, 1, 12, 12, 12)
    dataset = TextureDataset(store, QUIET, SHAPE, calibres=(1.0, 1.5))
    voxels = [dataset.sample(k).record["voxel"] for k in range(4)]
    assert len(set(voxels)) == 4 and 1.5 * QUIET.voxel >= max(voxels) > min(voxels) >= QUIET.voxel
    loud = Modality("loud", "for tests", 1.0, Imaging(contrast=Contrast(foreground=1000.0)))
    pairs = TextureDataset(store, [QUIET, loud], SHAPE)
    assert {pairs[k].record["modality"] for k in range(12)} == {"quiet", "loud"}
    four, record = exact_store(tmp_path / "s", 4), exact_record(4)
    torn = dataclasses.replace(record, viability=dataclasses.replace(record.viability, highest=7.0))
    four.write(torn, exact_field(4))
    assert TextureDataset(four.path, "micro-ct", 12).recipes[0].source.draws == 3  # the well-formed ones of 4


def test_images_are_normalised_as_asked(store):
    plain, score, share, own = (
        TextureDataset(store, QUIET, SHAPE, normalise=how)[0].image for how in (None, "zscore", "percentile", torch.neg)
    )
    assert float(score.mean()) == pytest.approx(0, abs=1e-4) and float(score.std()) == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(score * plain.std() + plain.mean(), plain)
    assert float(share.min()) == 0 and float(share.max()) == 1
    assert 0.985 < float(((share > 0) & (share < 1)).double().mean()) < 0.995
    assert torch.equal(own, -plain)


def test_shapes_of_laws():
    """A few shapes that are generated once, at least one of each law; a law by its name, by its numbers, or both."""
    tubes, sponge = preset("tubes"), preset("sponge")
    for laws in ("tubes", [tubes, "sponge"]):
        dataset = TextureDataset(laws, QUIET, 12, shapes=1, seed=1)
        assert dataset.recipes[0].source.edge == 16
        sample = dataset[0]
        assert 0 < float(sample.label.float().mean()) < 1
        assert sample.record["source"]["parameters"]["a02"] in (tubes.coefficients.a02, sponge.coefficients.a02)
    pool = dataset.recipes[0].source
    assert pool.count == len(pool.shapes) == 2 and pool.generated.names == ("preset tubes", "sponge")
    filled = TextureDataset(tubes.coefficients, QUIET, 12, shapes=1, volume_fraction=0.2)
    assert dataset.recipes[0].voxel == filled.recipes[0].voxel == QUIET.voxel
    assert filled.recipes[0].source.generated.names == ("coefficients",)
    in_um = dataclasses.replace(made_fit(), length_unit="um", working_voxel=0.25)
    in_voxels = dataclasses.replace(in_um, length_unit="voxel")
    kind, of_voxels = Modality("um", "", 0.5, Imaging()), Modality("voxel", "", 0.5, Imaging(unit="voxel"))
    assert choose_voxel([in_um], kind) == choose_voxel([in_voxels], of_voxels) == 0.25
    assert choose_voxel([in_voxels], kind) == 0.5


def test_a_fit_in_doubt_is_repeated_with_its_status():
    doubtful = dataclasses.replace(made_fit(), status="Not tested (nearest match): no shape was grown (p = 0.025).")
    with pytest.warns(UserWarning, match=r"not `Supported`. Not tested .* \(p = 0.025\)"):
        Generated.of([doubtful])


@pytest.mark.slow
@pytest.mark.parametrize("persistent", [False, True])
def test_workers_and_epochs_share_shapes(persistent):
    """Two workers, which stay or are new in each of two epochs, read the shapes that their parent grew; forked ones are
    in tests/priors/test_workers.py, in a process without JAX."""
    pairs = TextureDataset("tubes", QUIET, 12, length=6, shapes=2, transform=brief)
    paths = [path for path, *_ in pairs.recipes[0].source.shapes]
    before, found = [path.stat().st_mtime_ns for path in paths], []
    loader = DataLoader(pairs, None, num_workers=2, multiprocessing_context="spawn", persistent_workers=persistent)
    for epoch in range(2):
        pairs.set_epoch(epoch)
        found += list(loader)
    assert sorted(found) == sorted(pairs[k] for k in range(12))
    assert [path.stat().st_mtime_ns for path in paths] == before  # they end, and the shapes stay


PROGRAM = """
from curvafit.data_synth import TextureDataset
pairs = TextureDataset("tubes", "micro-ct", 16, shapes=1, progress=lambda text, share: print(text))
print(pairs.recipes[0].source.shapes[0][0])
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", ["", "raise KeyboardInterrupt"])
def test_shapes_go_with_their_program(tmp_path, end):
    command, room = [sys.executable, "-c", PROGRAM + end], os.environ | {"TMPDIR": str(tmp_path), "TEMP": str(tmp_path)}
    told, path = subprocess.run(command, env=room, text=True, capture_output=True).stdout.splitlines()
    assert told == "1 of 1 shapes grown" and tmp_path in Path(path).parents and not list(tmp_path.iterdir())
