"""Moves that leave a shape's texture as it is: the cube's 48 symmetries, crops of a periodic box, free rotations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

#: Rotations and reflections of the cube: orders of the three axes times their directions.
SYMMETRIES = 48
_ORDERS = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))


def turned(values: np.ndarray, symmetry: int) -> np.ndarray:
    """Return a volume (…, Z, Y, X) under one of the cube's symmetries, 0 to 47; 0 leaves it as it is. A view.

    Raises
    ------
    ValueError
        If there is no such symmetry.
    """
    if not 0 <= symmetry < SYMMETRIES:
        raise ValueError(f"expected a symmetry from 0 to {SYMMETRIES - 1}, got {symmetry}")
    order, flips = divmod(symmetry, 8)
    lead = values.ndim - 3
    axes = (*range(lead), *(lead + axis for axis in _ORDERS[order]))
    moved = values.transpose(axes)
    return moved[(..., *(slice(None, None, -1 if flips >> axis & 1 else 1) for axis in range(3)))]


def cropped(values: np.ndarray, corner: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    """Return the part (z, y, x) of a periodic volume (Z, Y, X) that begins at a corner, across its faces if need be.

    A part that is larger than the volume repeats it.
    """
    for axis, (first, part) in enumerate(zip(corner, shape, strict=True)):
        values = np.take(values, np.arange(first, first + part) % values.shape[axis], axis)
    return values


def rotated(values: np.ndarray, corner: Sequence[int], shape: Sequence[int], quaternion: Sequence[float]) -> np.ndarray:
    """Return a part as `cropped` does, turned about its middle by any rotation, interpolated linearly.

    Parameters
    ----------
    quaternion
        Of the rotation (x, y, z, w): where the volume's axes go, in the order (z, y, x).
    """
    from kornia.geometry.transform import warp_affine3d

    turn = Rotation.from_quat(quaternion).as_matrix()
    half = (np.array(shape) - 1) / 2
    margin = np.ceil(np.abs(turn.T) @ half - half).astype(int) + 1
    around = cropped(values, np.array(corner) - margin, np.array(shape) + 2 * margin)
    move = np.column_stack([turn, half - turn @ (half + margin)])
    matrix = torch.from_numpy(np.concatenate([move[::-1, 2::-1], move[::-1, 3:]], axis=1)[None]).float()
    volume = torch.from_numpy(around)[None, None].float()
    depth, height, width = (max(int(n), 2) for n in shape)  # grids of one voxel are not defined there
    part = warp_affine3d(volume, matrix, (depth, height, width), align_corners=True)[0, 0].numpy()
    return part[tuple(slice(n) for n in shape)]


def any_crop(
    values: np.ndarray, shape: Sequence[int], rng: np.random.Generator, rotate: bool = False
) -> tuple[np.ndarray, dict[str, Any]]:
    """Return a random crop of a periodic volume under a random symmetry, and which; with `rotate` under any rotation.

    Raises
    ------
    ValueError
        If the crop is larger than the volume.
    """
    symmetry = int(rng.integers(SYMMETRIES))
    moved = turned(values, symmetry)
    if any(part > whole for part, whole in zip(shape, moved.shape, strict=True)):
        raise ValueError(f"expected a crop within the shape's {moved.shape} voxels, got {tuple(shape)}")
    corner = [int(rng.integers(whole)) for whole in moved.shape]
    move = {"symmetry": symmetry, "corner": corner}
    if not rotate:
        return np.ascontiguousarray(cropped(moved, corner, shape)), move
    quaternion = rng.normal(size=4).tolist()
    return rotated(moved, corner, shape, quaternion), move | {"quaternion": quaternion}
