"""Textures that no law makes: fields that repeat, are about a distance near their surface, and look like their name."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scripts import example

mixed = example("mixed")
EDGE, KINDS = mixed.EDGE, mixed.KINDS


def draw(kind: str, seed: int) -> np.ndarray:
    return KINDS[kind](np.random.default_rng(seed))


@pytest.mark.parametrize("kind", KINDS)
def test_a_texture_repeats_and_is_about_a_distance(kind: str) -> None:
    for seed in range(3):
        field = draw(kind, seed)
        assert field.shape == (EDGE,) * 3 and field.dtype == np.float32 and np.isfinite(field).all()
        assert 0.02 < (field > 0).mean() < 0.75
        assert np.array_equal(field, draw(kind, seed))
        for axis in range(3):  # the step across the border is like any other
            steps = np.abs(np.diff(field, axis=axis, append=field.take([0], axis))).mean(tuple({0, 1, 2} - {axis}))
            assert steps[-1] < 1.3 * steps[:-1].max()
        slopes = np.sqrt(sum(np.square((np.roll(field, -1, k) - np.roll(field, 1, k)) / 2) for k in range(3)))
        assert 0.5 < np.median(slopes[np.abs(field) < 1]) < 1.5


def test_walls_part_cells_and_tubes_are_few_pieces() -> None:
    random = np.random.default_rng
    cells, tubes = ndimage.label(mixed.draw_walls(random(1)) < 0)[0], mixed.draw_tubes(random(1)) > 0
    assert (np.bincount(cells.ravel())[1:] > 500).sum() >= 6
    largest = np.bincount(ndimage.label(tubes)[0].ravel())[1:]
    assert largest.max() > 0.05 * tubes.sum()
    thickness = ndimage.distance_transform_edt(tubes)
    assert thickness.max() > 2.5  # stems and twigs
