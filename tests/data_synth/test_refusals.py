"""What is asked for wrongly is refused, in one sentence that names what is wrong."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from exact_store import FLAT, flat_recipe

from curvafit.data_synth import Contrast, Imaging, Modality, TextureDataset, design_box, labels_of, open_store
from curvafit.data_synth.dataset import Recipe
from curvafit.data_synth.imaging.like import fit_modality
from curvafit.data_synth.samples import fetch
from curvafit.data_synth.sets import SetSpec, build_set, make_case, read_spec
from curvafit.data_synth.sources import Generated, decode_source, random_crop
from curvafit.geometry.centreline import centreline
from curvafit.priors import Grid, preset
from curvafit.volumes.volume import Volume


class Given(NamedTuple):
    """A recipe, its store, and a folder that holds somebody's notes."""

    recipe: Recipe
    store: Path
    taken: Path

    def set(self, *arguments: Any, **options: Any) -> TextureDataset:
        return TextureDataset(self.store, *(arguments or (FLAT, 12)), **options)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Given:
    folder = tmp_path_factory.mktemp("shapes")
    (folder / "taken").mkdir()
    (folder / "taken" / "notes.txt").write_text("mine")
    return Given(flat_recipe(folder / "s"), folder / "s", folder / "taken")


RNG = np.random.default_rng(0)
U, PLAIN = torch.rand((28, 28, 28), generator=torch.Generator().manual_seed(0)) - 0.5, Imaging()
TORN, EMPTY, GREY = torch.where(U > 0.49, torch.nan, U), np.zeros((6, 6, 6)), RNG.normal(size=(12, 12, 12))


def label(field: torch.Tensor, epsilon: float = 1.0, which: str = "mask") -> object:
    return labels_of(field, Grid((28, 28, 28), 1.0, "replicate"), epsilon, which)  # type: ignore[arg-type]


REFUSALS: list[tuple[str, Callable[[Given], object]]] = [
    ("24 voxels .*larger --shape", lambda g: replace(g.recipe, shape=(32, 16, 16))),
    ("calibres", lambda g: replace(g.recipe, calibres=(2.0, 1.0))), ("voxel", lambda g: replace(g.recipe, voxel=0)),
    ("folder", lambda g: build_set(g.taken, SetSpec(g.recipe), 1)), ("taken", lambda g: read_spec(g.taken)),
    ("nowhere", lambda g: make_case(g.taken / "nowhere", 0)),
    *(("voxels", lambda g, size=size: g.set(FLAT, size)) for size in (16.5, "16", (8, 8), (8, 8, 0))),
    *(("voxel", lambda g, edge=edge: g.set(voxel=edge)) for edge in (0, -1)),
    *(("seed", lambda g, seed=seed: g.set(seed=seed)) for seed in (-1, 0.5)),
    ("24 voxels", lambda g: g.set(FLAT, (25, 8, 8))), ("modality", lambda g: g.set([], 8)),
    ("length", lambda g: g.set(length=0)), ("normalis", lambda g: g.set(normalise="minmax")),
    ("volume_fraction", lambda g: g.set(volume_fraction=0.2)),
    ("missing", lambda g: TextureDataset(g.taken / "missing", FLAT, 12)),
    ("mass", lambda g: TextureDataset(preset("tubes").coefficients, FLAT, 12)),
    ("preset", lambda g: TextureDataset("tubez", FLAT, 12)),
    ("3", lambda g: TextureDataset(3, FLAT, 12)),  # type: ignore[arg-type]
    ("fraction", lambda g: Generated(((1.0, 2.0, 6.0, -40.0, -40.0, 400.0, -0.5),), ("tubes",), fraction=1.5)),
    ("seeds", lambda g: Generated(((1, 0, 1, 0, 0, 3000, -0.9),), ("none",)).shape((12, 12, 12), 0, RNG)),
    ("grew", lambda g: decode_source(g.recipe.source.as_dict() | {"draws": 9}).shape((8, 8, 8), 0, RNG)),
    ("crop", lambda g: random_crop(EMPTY, (7, 7, 7), RNG)),
    *(("seed", lambda g, seed=seed: design_box().draw(seed, 0)) for seed in (-1, 0.5, True)),
    *(("index", lambda g, index=index: design_box().draw(0, index)) for index in (-1, "1")),
    ("none", lambda g: open_store(g.taken / "none")), ("store", lambda g: open_store(g.taken)),
    ("moon", lambda g: fetch("moon")), ("shape", lambda g: label(U[1:])), ("0", lambda g: label(U + 1)),
    ("finite", lambda g: label(TORN)), ("epsilon", lambda g: label(U, 0.0)), ("maks", lambda g: label(U, 1.0, "maks")),
    ("shape", lambda g: centreline(EMPTY[1:], EMPTY, (1.0, 1.0, 1.0))),
    ("blurr", lambda g: PLAIN.assign({"blurr": 1})),
    ("detector.gain", lambda g: Modality("m", "", 1.0, PLAIN, {"detector.gain": (2.0, 1.0)})),
    ("optics", lambda g: replace(PLAIN, optics=Contrast())),  # type: ignore[arg-type]
    ("voxel", lambda g: Modality("m", "", 0.0, PLAIN)), ("spacing", lambda g: PLAIN.assign({"spacing": (1, 0, 1)})),
    *(("blur", lambda g, blur=blur: PLAIN.assign({"optics.blur": blur})) for blur in ((1, 1), (1, 1, 1, 1), 1)),
    ("no.blur", lambda g: PLAIN.assign({"no.blur": 1})),
    ("dropout", lambda g: PLAIN.assign({"specimen.dropout": 1.2})),
    ("gain", lambda g: PLAIN.assign({"detector.gain": -1})),
    ("foreground", lambda g: PLAIN.assign({"contrast.foreground": math.nan})),
    ("ceiling", lambda g: PLAIN.assign({"detector.ceiling": 0})), ("unit", lambda g: PLAIN.assign({"unit": "ell"})),
    ("8 voxels", lambda g: fit_modality(Volume(GREY[:4]))),
    ("finite", lambda g: fit_modality(Volume(np.zeros((9, 9, 9))))),
    ("finite", lambda g: fit_modality(Volume(GREY * np.nan))),
    ("shape", lambda g: fit_modality(Volume(GREY), np.ones((3, 3, 3), bool))),
    ("mask", lambda g: fit_modality(Volume(GREY), np.ones(GREY.shape, bool))),
]  # fmt: skip


@pytest.mark.parametrize(("word", "ask"), REFUSALS, ids=[f"{k}-{word}" for k, (word, _) in enumerate(REFUSALS)])
def test_what_is_wrong_is_named(given: Given, word: str, ask: Callable[[Given], object]) -> None:
    before = sorted(given.taken.parent.iterdir())
    with pytest.raises((ValueError, FileNotFoundError), match=word) as error:
        ask(given)
    assert "\n" not in str(error.value) and sorted(given.taken.parent.iterdir()) == before
