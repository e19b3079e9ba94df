"""What an image says of a volume, a filler that weighs it, and labels that it does not tell from each other."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from annotated import known, stirred
from scripts import example
from skimage import measure

import curvafit.segmentation.image as room
from curvafit.segmentation.filler import Filler, Gaps, Taught, fill
from curvafit.segmentation.image import read_image
from curvafit.segmentation.labels import are_instances, reconstruct_labels, split_structure
from curvafit.segmentation.reconstruction import reconstruct
from curvafit.segmentation.trials import dice
from curvafit.volumes.volume import Volume

pytest.importorskip("sklearn", reason="reading an image needs scikit-learn")

script = example("teach")
EVERY = 6


def rods(n: int = 37) -> np.ndarray:
    """A leaning rod from end to end, and a ball that no known slice meets."""
    z, y, x = np.mgrid[:n, :n, :n]
    return (np.hypot(y - 10 - 0.3 * z, x - 9) < 4) | ((z - 15) ** 2 + (y - 12) ** 2 + (x - 26) ** 2 < 7)


def photograph(mask: np.ndarray, noise: float = 0.4, seed: int = 0) -> np.ndarray:
    return mask + noise * np.random.default_rng(seed).standard_normal(mask.shape).astype(np.float32)


def test_the_inside_is_found_bright_or_dark_in_any_unit_and_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    mask, grey = rods(), photograph(rods())
    whole, other, dark = (read_image(values, known(mask))[0] for values in (grey, 64 * grey, -grey))
    assert dice(whole > 0, mask) > 0.85 and dice(dark > 0, mask) > 0.85
    assert np.array_equal(whole, other)
    monkeypatch.setattr(room, "HELD", 5 * 37 * 37)
    parts = read_image(grey, known(mask))[0]
    assert np.median(np.abs(parts - whole)) < 1e-6 and ((parts > 0) == (whole > 0)).mean() > 0.995


def test_a_filler_that_takes_images_begins_as_a_plain_one() -> None:
    plain, generator = stirred(), torch.Generator().manual_seed(0)
    distances = 3 * torch.randn(2, 4, 24, 24, generator=generator)
    gaps = Gaps(distances, torch.ones(2), torch.zeros(2, 3, 24, 24))
    with torch.no_grad():
        wider = script.see_images(plain)(replace(gaps, evidence=torch.zeros(2, 3, 24, 24)))
        assert torch.allclose(wider, plain(gaps), atol=1e-6)


def test_background_around_an_image_changes_nothing() -> None:
    mask = rods()
    said = np.where(mask, 3, -3).astype(np.float32)
    filler = script.see_images(stirred()).eval()
    torch.nn.init.normal_(filler.up_fine.first.weight, std=0.1, generator=torch.Generator().manual_seed(0))
    taught = Taught(filler, np.array([[4.0, 16.0], [1.0, 1.0]]), {}, 0.0)
    border = ((0, 0), (60, 60), (60, 60))
    wide = fill(known(np.pad(mask, border)), taught, evidence=np.pad(said, border, mode="edge"))
    narrow = fill(known(mask), taught, evidence=said)
    assert np.abs(wide[:, 60:-60, 60:-60] - narrow).max() < 1e-5


def test_the_packaged_filler_finds_what_only_the_image_shows_across_any_axis() -> None:
    mask, grey, turn = rods(), photograph(rods()), (1, 2, 0)
    shown = Volume(mask.astype(np.uint8))
    alone = reconstruct(shown, every=EVERY).mask.values
    straight = reconstruct(shown, every=EVERY, image=grey)
    found, ball = straight.mask.values, np.s_[13:18, 9:16, 23:30]
    assert dice(found, mask) > dice(alone, mask) + 0.02
    assert not alone[ball].any() and dice(found[ball], mask[ball]) > 0.8
    assert np.array_equal(found[::EVERY], mask[::EVERY])
    turned = Volume(np.ascontiguousarray(mask.transpose(turn)).astype(np.uint8))
    other = reconstruct(turned, every=EVERY, axis=2, image=grey.transpose(turn)).probability.values
    assert np.abs(other.transpose(np.argsort(turn)) - straight.probability.values).max() < 1e-3
    blank = reconstruct(shown, every=EVERY, image=photograph(np.zeros_like(mask)))  # of something else: left out
    assert np.array_equal(blank.mask.values, alone)
    assert any("image" in note for note in blank.notes) and "image" not in blank.status


def texture():
    z, y, x = np.mgrid[:24, :24, :24] * (2 * np.pi / 24)
    return script.Texture((np.sin(z) * np.cos(y) + np.sin(y) * np.cos(x) + np.sin(x) * np.cos(z)).astype(np.float32))


def test_imaged_shapes_depend_on_their_seed_alone() -> None:
    mix = script.ImageMix(edge=24, gap=(3, 4))
    one, same, other = (script.image_shape([[texture()]], mix, (0, k)) for k in (1, 1, 2))
    assert np.array_equal(one.distances, same.distances) and np.array_equal(one.evidence, same.evidence)
    assert one.distances.shape != other.distances.shape or not np.array_equal(one.evidence, other.evidence)
    assert (len(one.distances) - 1) % one.gap == 0 and one.evidence.shape == one.distances.shape


@pytest.mark.slow
def test_teaching_with_images_makes_a_filler_for_images_and_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(script, "JUDGED", 6)
    plain = Taught(Filler(4).eval(), np.array([[2.0, 16.0], [1.0, 1.0]]), {"name": "plain"}, 0.0)
    taught = script.teach([[texture()]], {}, first=plain, steps=2, volumes=2, workers=0)
    assert taught.filler.image and taught.card["first"] == {"name": "plain"} and taught.card["volumes"] == 2
    assert set(taught.card["losses"]) and np.isfinite(taught.card["held_out_loss"])
    imaged, image_shape = [], script.image_shape

    def image_two(textures: object, mix: object, seed: tuple[int, int]) -> object:
        if len(imaged) == 2:
            raise KeyboardInterrupt
        imaged.append(seed[1])
        return image_shape(textures, mix, seed)

    monkeypatch.setattr(script, "image_shape", image_two)
    options: dict[str, Any] = {"first": plain, "steps": 2, "volumes": 2, "workers": 0, "checkpoint": tmp_path / "steps"}
    with pytest.raises(KeyboardInterrupt):
        script.teach([[texture()]], {}, **options)
    imaged[:] = imaged[1:]
    assert script.teach([[texture()]], {}, **options).card["losses"] == taught.card["losses"] and imaged == [1, 2]


def cells() -> np.ndarray:
    """Five cells, of which two touch, labels 10 to 50."""
    z, y, x = np.mgrid[:31, :44, :44]
    labels = np.zeros(z.shape, np.uint8)
    places = ((14, 12, 12, 9), (16, 12, 28, 8), (15, 33, 12, 8), (9, 32, 32, 7), (23, 31, 33, 6))
    for k, (c, b, a, r) in enumerate(places):
        labels[((z - c) ** 2 + (y - b) ** 2 + (x - a) ** 2 < r**2) & (labels == 0)] = 10 * (k + 1)
    return labels


def classes(shown: bool) -> tuple[np.ndarray, np.ndarray]:
    """A nucleus in a cell, each one piece in a slice, and their image, in which they look different, or not."""
    y, x = np.mgrid[:40, :40] - 20
    plane = np.where(np.hypot(y, x) < 8, 2, np.where(np.hypot(y, x) < 16, 1, 0))
    labels = np.stack([plane] * 4)
    return labels, photograph(labels if shown else (labels > 0).astype(int), 0.3)


def test_instances_are_told_from_classes() -> None:
    labels = cells()[::EVERY] // 10
    assert are_instances(labels, photograph(labels > 0, 0.3), 5)
    assert are_instances(*classes(False), 2) and not are_instances(*classes(True), 2)
    scattered = labels.copy()
    scattered[:, ::4, ::4] = np.where(labels[:, ::4, ::4], 0, 1)
    scattered[:, 2::4, 2::4] = np.where(labels[:, 2::4, 2::4], 0, 2)
    assert not are_instances(scattered, photograph(labels > 0, 0.3), 5)  # two of five are many specks


def test_each_label_is_one_piece_and_known_voxels_stay() -> None:
    labels = np.zeros((3, 8, 20), dtype=np.int16)
    labels[:, 2:6, 1:6], labels[:, 2:6, 12:17] = 1, 2
    known = np.zeros(labels.shape, dtype=bool)
    known[0] = known[2] = True
    mask = labels > 0
    mask[1, 2:6, 6:12] = True  # a bridge, split in the middle
    mask[1, 0, 19] = True  # touches none
    labels[1, 3, 14] = 1  # a lost bit
    found = split_structure(mask, labels, known, (1, 1, 1))
    assert np.array_equal(found[known], labels[known])
    assert (found[1, 2:6, 1:8] == 1).all() and (found[1, 2:6, 11:17] == 2).all() and found[1, 0, 19] == 0
    assert found[1, 3, 14] == 2 and measure.label(found, connectivity=3).max() == 2


def test_cells_with_their_image_are_each_one_piece_and_better() -> None:
    truth, image = cells(), photograph(cells() > 0, 0.3)
    alone, found = (reconstruct_labels(truth, every=EVERY, image=seen, suggest=2) for seen in (None, image))

    def mean_dice(values: np.ndarray) -> float:
        return float(np.mean([dice(values == k, truth == k) for k in range(10, 60, 10)]))

    values = found.labels.values  # type: ignore[union-attr]
    assert measure.label(values, connectivity=3).max() == 5 and np.array_equal(values[::EVERY], truth[::EVERY])
    assert mean_dice(values) > mean_dice(alone.labels.values) + 0.01  # type: ignore[union-attr]
    assert any("instances of one structure" in note for note in found.notes) and "instances" in found.status
    assert not any("image" in note for note in alone.notes)
    told = found.uncertainty
    assert told is not None and set(told.dice_of_labels) == {10, 20, 30, 40, 50} and len(told.suggestions) == 2
    assert abs(np.mean(list(told.dice_of_labels.values())) - mean_dice(values)) < 0.1
    likely = told.probability.values
    assert likely.min() >= 0 and likely.max() <= 1 and (likely[::EVERY] == 1).all()
    assert likely[values == truth].mean() > likely[values != truth].mean() + 0.1
