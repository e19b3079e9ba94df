"""Textures like known slices: found by how these look, and taught, without an example."""

import dataclasses

import numpy as np
import pytest
import torch

from curvafit.segmentation import alike
from curvafit.segmentation.alike import COLUMNS, FARTHEST, Looks, describe_planes, overlap, tabulate, tune_alike
from curvafit.segmentation.filler import Taught
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.slices import Slices
from curvafit.segmentation.teach import Mix, draw_texture


def slices_of(kind: str, number: int, thickness: float = 8.0, gap: int = 8) -> Slices:
    """Every `gap`-th slice of a texture that is so many voxels thick."""
    plane = np.arange(96.0)
    axes = (np.arange(0, 41, gap, dtype=float), plane, plane)
    inside = draw_texture(kind, number).cut(np.random.default_rng(5), axes, thickness, Mix())
    return Slices(inside, tuple(range(0, 41, gap)), 41, (1.0, 1.0, 1.0))


def test_the_packaged_numbers_are_those_of_the_textures() -> None:
    with np.load(alike.open_packaged("segmentation", "alike.npz")) as file:
        rows = file["rows"]
    names = [(kind, number) for kind in alike.KINDS for number in range(alike.TEXTURES)]
    assert rows.shape == (len(names), COLUMNS)
    for kind, number in (("cell walls", 2), ("fibres", 0)):
        kept = rows[names.index((kind, number))].astype(float)
        assert tabulate(kind, number) == pytest.approx(kept, abs=0.02, nan_ok=True)


@pytest.mark.parametrize(
    ("kind", "number", "thickness"), [("cell walls", 4, 5.0), ("grains", 3, 8.0), ("fibres", 3, 6.0)]
)
def test_slices_of_a_texture_find_its_kind(kind: str, number: int, thickness: float) -> None:
    looks = Looks.of(slices_of(kind, number, thickness))
    names, distance = looks.find()
    assert distance < FARTHEST and len(names) == alike.NEAREST
    assert looks.count == 7 and looks.gap == pytest.approx(8, rel=0.5)
    kinds = [name for name, _ in names]
    assert kinds.count(kind) > len(kinds) / 2


def test_looks_do_not_depend_on_the_scale_or_the_size_of_slices() -> None:
    """Of discs on a lattice: share, outline, bodies and holes, but for the pixels of rims."""

    def describe(radius: float, edge: int) -> np.ndarray:
        y, x = np.mgrid[:edge, :edge]
        discs = np.hypot(y % (4 * radius) - 2 * radius, x % (4 * radius) - 2 * radius) < radius
        return describe_planes(np.stack([discs, discs]), radius)

    for radius, edge in ((16.0, 128), (8.0, 256)):
        assert describe(radius, edge)[:4] == pytest.approx(describe(8.0, 128)[:4], abs=0.1)
    disc = np.hypot(*np.mgrid[-9:10, -9:10]) < 5
    assert overlap(np.stack([disc, disc])) == 1 and overlap(np.stack([disc, ~disc])) == 0


def test_the_network_stays_where_slices_tell_all_or_are_like_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    taught, slices = Taught.load(), slices_of("cell walls", 4, thickness=4.0)
    monkeypatch.setattr(alike, "FARTHEST", 0.0)
    tuned, notes = tune_alike(taught, slices)
    assert tuned is taught and "No texture" in notes[0]
    whole = np.arange(4)[:, None, None] % 2 * np.ones((1, 24, 24)) > 0  # no slice has an outline
    assert tune_alike(taught, Slices(whole, (0, 8, 16, 24), 25, (1.0, 1.0, 1.0)))[0] is taught
    rod = np.repeat(np.hypot(*np.mgrid[-32:32, -32:32])[None] < 12, 5, axis=0)
    tuned, notes = tune_alike(taught, Slices(rod, (0, 8, 16, 24, 32), 33, (1.0, 1.0, 1.0)))
    assert tuned is taught and "tell the volume well" in notes[0]


def test_a_volume_is_filled_by_a_network_tuned_to_its_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few steps change the weights; the same call gives the same volume; the status says what tuned it."""
    monkeypatch.setattr(alike, "TUNING", 2)
    monkeypatch.setattr(alike, "NEAREST", 3)
    slices = slices_of("cell walls", 4)
    volume = np.zeros((41, 96, 96), dtype=np.uint8)
    volume[::8] = slices.inside
    found = [reconstruct(volume, every=8, example="mixed") for _ in range(2)]
    assert np.array_equal(found[0].mask.values, found[1].mask.values)
    assert "tuned on textures like the slices" in found[0].status
    taught = Taught.load()
    tuned, _ = tune_alike(taught, slices)
    before, after = (torch.cat([each.flatten() for each in net.filler.parameters()]) for net in (taught, tuned))
    assert not torch.equal(before, after) and dataclasses.replace(tuned, filler=taught.filler).error == taught.error
