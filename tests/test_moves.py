"""Symmetries of the cube and crops of a periodic box."""

from __future__ import annotations

import numpy as np
import pytest

from curvafit.data_synth.sets.moves import SYMMETRIES, any_crop, cropped, turned

VALUES = np.random.default_rng(0).random((3, 4, 5))


def test_the_48_symmetries_differ_and_the_first_is_none():
    cube = np.arange(27).reshape(3, 3, 3)
    moved = {turned(cube, k).tobytes() for k in range(SYMMETRIES)}
    assert len(moved) == 48
    assert (turned(cube, 0) == cube).all()


def test_symmetries_are_a_group():
    cube = np.arange(27).reshape(3, 3, 3)
    all_of_them = {turned(cube, k).tobytes() for k in range(SYMMETRIES)}
    twice = {turned(turned(cube, j), k).tobytes() for j in range(SYMMETRIES) for k in range(SYMMETRIES)}
    assert twice == all_of_them


def test_symmetries_move_the_last_three_axes():
    pair = np.stack([VALUES, 2 * VALUES])
    for k in range(0, SYMMETRIES, 7):
        assert (turned(pair, k)[1] == 2 * turned(VALUES, k)).all()


def test_a_crop_goes_on_across_the_faces():
    tiled = np.tile(VALUES, (2, 2, 2))
    for corner in ((0, 0, 0), (2, 3, 4), (1, 3, 0)):
        z, y, x = corner
        assert (cropped(VALUES, corner, (3, 2, 4)) == tiled[z : z + 3, y : y + 2, x : x + 4]).all()


def test_a_crop_of_the_whole_is_a_shift():
    found, how = any_crop(VALUES, (3, 3, 3), np.random.default_rng(5))
    again, _ = any_crop(VALUES, (3, 3, 3), np.random.default_rng(5))
    assert found.shape == (3, 3, 3) and (found == again).all() and found.flags["C_CONTIGUOUS"]
    assert (cropped(turned(VALUES, how["symmetry"]), how["corner"], (3, 3, 3)) == found).all()


def test_what_cannot_be():
    with pytest.raises(ValueError, match=r"expected a crop within the shape's \(3, 4, 5\) voxels, got \(4, 4, 4\)"):
        cropped(VALUES, (0, 0, 0), (4, 4, 4))
    with pytest.raises(ValueError, match="expected a symmetry from 0 to 47, got 48"):
        turned(VALUES, 48)
