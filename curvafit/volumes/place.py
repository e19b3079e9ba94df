"""Laying a volume on the voxels of another, by where both lie in the world."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from curvafit.core.units import METRES, format_sampling
from curvafit.volumes.volume import ScanError, Volume

#: Voxels by which places may differ that are one.
ASTRAY = 0.1
#: Voxels by which a voxel that lies half way between two others is nearer to the first.
_TIE = 1e-3


def lay(field: Volume, on: Volume, name: str, kind: str, *, exact: bool = False) -> tuple[Volume, tuple[str, ...]]:
    """Return a volume on the voxels of another, and a note on how it was laid where the two differ.

    Where both state where they lie, the affines decide: axes change places and directions, and voxels move. On other
    voxels a value is that of the nearest one, and 0 beyond them; `exact` refuses both. Where one states no place, equal
    shapes are laid voxel by voxel. Messages call the volume `name`, and the other's voxels those of `kind`. Raises
    ScanError where the two do not meet, or have no place and other shapes.
    """
    step, note = _find_step(field, on), f"{name[0].upper()}{name[1:]} is laid on {kind}"
    if step is None:
        if field.shape != on.shape:
            raise ScanError(f"{name} must have the shape of {kind} {on.shape}, got {field.shape} without a place in it")
        neither = field.affine is None and on.affine is None
        both = field.affine is not None and on.affine is not None
        why = "their units do not convert" if both else "one of the two states no place"
        return field, () if neither else (f"{note} voxel by voxel: {why}.",)
    matrix, offset = step
    whole, moved = np.rint(matrix), np.rint(offset)
    corners = np.array(list(product(*((0, n - 1) for n in on.shape))))
    far = np.abs(corners @ (matrix - whole).T + offset - moved).max()
    on_voxels = far < ASTRAY and np.array_equal(whole @ whole.T, np.eye(3))
    if on_voxels and field.shape == on.shape and np.array_equal(whole, np.eye(3)) and not moved.any():
        return field, ()
    sampling = format_sampling(field.shape, field.spacing, field.unit)
    if exact and not on_voxels:
        raise ScanError(f"{name} must have the voxels of {kind}, got {sampling} that lie between them: resample it")
    laid, share = _take_nearest(field.values, *((whole, moved) if on_voxels else step), on.shape)
    if share == 0 or (exact and share < 1):
        what = f"{'shape and ' * exact}place of {kind}"
        raise ScanError(f"{name} must have the {what}, but by the affines covers {share:.0%} of it")
    note += f" by its affine: {'whole voxels are moved' if on_voxels else f'the nearest of its {sampling} counts'}"
    note += "" if share == 1 else f"; {1 - share:.2g} of {kind} lies beyond it, and counts as 0"
    return replace(field, array=laid, spacing=on.spacing, unit=on.unit, affine=on.affine), (f"{note}.",)


def _find_step(field: Volume, on: Volume) -> tuple[np.ndarray, np.ndarray] | None:
    """Return matrix and offset from voxels (z, y, x) of a volume to those of another, None where no place tells it.

    A length in voxels is one in any unit where the voxels are as long: a file may not name its unit.
    """
    if field.affine is None or on.affine is None or not np.linalg.det(field.affine[:3, :3]):
        return None
    factor = 1.0
    if field.unit != on.unit:
        if {field.unit, on.unit} <= METRES.keys():
            factor = METRES[on.unit] / METRES[field.unit]
        elif not np.allclose(sorted(field.spacing), sorted(on.spacing), rtol=1e-3):
            return None
    step = np.linalg.inv(field.affine) @ np.diag([factor] * 3 + [1.0]) @ on.affine
    return step[2::-1, 2::-1], step[2::-1, 3]


def _take_nearest(
    values: np.ndarray, matrix: np.ndarray, offset: np.ndarray, shape: tuple[int, int, int]
) -> tuple[np.ndarray, float]:
    """Return the value nearest to each voxel of a shape, 0 beyond them, and the share of voxels that has one."""
    found, count = np.zeros(shape, values.dtype), 0
    y, x = np.ogrid[: shape[1], : shape[2]]
    for z, plane in enumerate(found):
        at = [
            np.floor(a * z + b * y + c * x + d + 0.5 - _TIE).astype(np.int64)
            for (a, b, c), d in zip(matrix, offset, strict=True)
        ]
        inside = np.logical_and.reduce([(k >= 0) & (k < n) for k, n in zip(at, values.shape, strict=True)])
        plane[inside] = values[tuple(k[inside] for k in at)]
        count += np.count_nonzero(inside)
    return found, count / found.size
