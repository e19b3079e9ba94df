"""Symmetries of the cube and crops of a periodic box."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from curvafit.data_synth.sources import SYMMETRIES, apply_symmetry, crop_periodic, crop_rotated, random_crop

VALUES = np.random.default_rng(0).random((3, 4, 5))


def test_the_48_symmetries_are_a_group_of_which_the_first_is_none():
    """They move the last three axes."""
    cube = np.arange(27).reshape(3, 3, 3)
    moved = [apply_symmetry(cube, k) for k in range(SYMMETRIES)]
    each = {part.tobytes() for part in moved}
    assert len(each) == 48 and (moved[0] == cube).all()
    assert {apply_symmetry(part, k).tobytes() for part in moved for k in range(SYMMETRIES)} == each
    pair = np.stack([VALUES, 2 * VALUES])
    for k in range(0, SYMMETRIES, 7):
        assert (apply_symmetry(pair, k)[1] == 2 * apply_symmetry(VALUES, k)).all()


def test_a_crop_goes_on_across_the_faces():
    tiled = np.tile(VALUES, (2, 2, 2))
    for corner in ((0, 0, 0), (2, 3, 4), (1, 3, 0)):
        z, y, x = corner
        assert (crop_periodic(VALUES, corner, (3, 2, 4)) == tiled[z : z + 3, y : y + 2, x : x + 4]).all()


def test_a_crop_of_the_whole_is_a_shift():
    found, how = random_crop(VALUES, (3, 3, 3), np.random.default_rng(5))
    again, _ = random_crop(VALUES, (3, 3, 3), np.random.default_rng(5))
    assert found.shape == (3, 3, 3) and (found == again).all() and found.flags["C_CONTIGUOUS"]
    assert (crop_periodic(apply_symmetry(VALUES, how["symmetry"]), how["corner"], (3, 3, 3)) == found).all()


def test_a_rotation_by_a_quarter_is_a_symmetry():
    """About the middle of the crop, for each axis; float32 rounds the places of the voxels off."""
    cube = np.random.default_rng(1).random((9, 9, 9))
    half = np.sqrt(0.5)
    for k, plane in enumerate(((1, 2), (2, 0), (0, 1))):
        quaternion = [half * (k == axis) for axis in range(3)] + [half]
        found = crop_rotated(cube, (2, 1, 3), (5, 5, 5), quaternion)
        np.testing.assert_allclose(found, np.rot90(crop_periodic(cube, (2, 1, 3), (5, 5, 5)), 1, plane), atol=1e-4)


def test_a_rotated_plane_is_the_plane_rotated():
    """The profile tanh(d / √2 ε) has |u''| < 0.385 / ε², and linear interpolation is off by up to an eighth of the sum
    over the axes."""
    epsilon, normal = 2.0, np.array([0.6, 0.0, 0.8])
    points = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in (48, 48, 48)), indexing="ij"), -1)
    profile = np.tanh(points @ normal / (np.sqrt(2) * epsilon))
    quaternion, shape = [0.1, -0.4, 0.3, 0.7], (12, 16, 20)
    corner = [(48 - n) // 2 for n in shape]
    turn = Rotation.from_quat(quaternion).as_matrix()
    own = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in shape), indexing="ij"), -1)
    exact = np.tanh(own @ (turn @ normal) / (np.sqrt(2) * epsilon))
    error = np.abs(crop_rotated(profile, corner, shape, quaternion) - exact).max()
    assert error < 0.385 / epsilon**2 / 8 + 1e-3
    assert np.abs(profile[18:30, 16:32, 14:34] - exact).max() > 0.5
    assert crop_rotated(profile, corner, (1, 4, 4), quaternion).shape == (1, 4, 4)
