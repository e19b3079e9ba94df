"""Labels that an image tells from the background, but not from each other."""

from __future__ import annotations

import numpy as np
import pytest
from skimage import measure

from curvafit.segmentation.reconstruct import are_instances, reconstruct_labels, split_structure
from curvafit.segmentation.trials import dice

EVERY = 6


def cells() -> np.ndarray:
    """Five cells, of which two touch, labels 10 to 50."""
    z, y, x = np.mgrid[:31, :44, :44]
    labels = np.zeros(z.shape, np.uint8)
    for k, (c, b, a, r) in enumerate(
        ((14, 12, 12, 9), (16, 12, 28, 8), (15, 33, 12, 8), (9, 32, 32, 7), (23, 31, 33, 6))
    ):
        labels[((z - c) ** 2 + (y - b) ** 2 + (x - a) ** 2 < r**2) & (labels == 0)] = 10 * (k + 1)
    return labels


def photograph(levels: np.ndarray, noise: float = 0.3) -> np.ndarray:
    return levels + noise * np.random.default_rng(0).standard_normal(levels.shape).astype(np.float32)


# ---- what are instances ----------------------------------------------------------------------------------------------


def classes(shown: bool) -> tuple[np.ndarray, np.ndarray]:
    """A nucleus in a cell, each one piece in a slice, and their image, in which they look different, or not."""
    y, x = np.mgrid[:40, :40] - 20
    plane = np.where(np.hypot(y, x) < 8, 2, np.where(np.hypot(y, x) < 16, 1, 0))
    labels = np.stack([plane] * 4)
    return labels, photograph(labels if shown else (labels > 0).astype(int))


def test_instances_are_told_from_classes() -> None:
    labels = cells()[::EVERY] // 10
    assert are_instances(labels, photograph(labels > 0), 5)
    assert are_instances(*classes(False), 2) and not are_instances(*classes(True), 2)
    scattered = labels.copy()
    scattered[:, ::4, ::4] = np.where(labels[:, ::4, ::4], 0, 1)
    scattered[:, 2::4, 2::4] = np.where(labels[:, 2::4, 2::4], 0, 2)
    assert not are_instances(scattered, photograph(labels > 0), 5)  # two of five are many specks


# ---- splitting -------------------------------------------------------------------------------------------------------


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


# ---- filling ---------------------------------------------------------------------------------------------------------


def test_cells_with_their_image_are_each_one_piece_and_better() -> None:
    pytest.importorskip("sklearn")
    truth, image = cells(), photograph(cells() > 0)
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
