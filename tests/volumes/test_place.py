"""`lay`: one volume in every pose, other voxels, no place, and what is refused."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from curvafit.scan.structure import read_region
from curvafit.volumes.field import Field, ScanError
from curvafit.volumes.place import lay

SHAPE, H = (5, 6, 7), 0.02
LABELS = np.random.default_rng(0).integers(0, 2**40, SHAPE) * 2**20 + 1
AFFINE = np.array([[H, 0, 0, 1], [0, H, 0, 2], [0, 0, H, 3], [0, 0, 0, 1.0]])
SCAN = Field(np.zeros(SHAPE, np.uint8), H, "mm", AFFINE)


def world(values: np.ndarray, matrix: np.ndarray, origin: np.ndarray, unit: str = "mm") -> Field:
    """Return values whose voxel i (x, y, z) lies at `matrix` i + `origin`."""
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = matrix, origin
    return Field(values, tuple(np.linalg.norm(matrix, axis=0)[::-1]), unit, affine)


@pytest.mark.parametrize("axes", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=3)))
def test_a_volume_is_itself_in_every_pose(axes: tuple[int, ...], signs: tuple[int, ...]) -> None:
    turned = LABELS.transpose(axes)[tuple(slice(None, None, sign) for sign in signs)]
    columns = []  # where a step along each axis of the turned array leads, x first
    first = np.zeros(3)
    for axis, sign in zip(axes, signs, strict=True):
        columns.append(sign * H * np.eye(3)[2 - axis])
        first += (sign < 0) * (SHAPE[axis] - 1) * H * np.eye(3)[2 - axis]
    field = world(turned, np.array(columns[::-1]).T, AFFINE[:3, 3] + first)
    laid, notes = lay(field, SCAN, "the region", "the scan", exact=True)
    assert (laid.values == LABELS).all()
    assert laid.values.dtype == LABELS.dtype
    assert bool(notes) == (axes != (0, 1, 2) or signs != (1, 1, 1))


def test_a_shift_leaves_zeros_beyond_and_a_unit_converts() -> None:
    origin = AFFINE[:3, 3] + [H, 0, 0]
    for field in (world(LABELS, H * np.eye(3), origin), world(LABELS, 1000 * H * np.eye(3), 1000 * origin, "um")):
        laid, (note,) = lay(field, SCAN, "the region", "the scan")
        assert (laid.values[..., 1:] == LABELS[..., :-1]).all()
        assert not laid.values[..., 0].any()
        assert (laid.unit, laid.spacing) == ("mm", (H, H, H))
        assert "beyond" in note
        with pytest.raises(ScanError, match="covers"):
            lay(field, SCAN, "the image", "the slices", exact=True)
    with pytest.raises(ScanError, match="covers 0%"):
        lay(world(LABELS, H * np.eye(3), AFFINE[:3, 3] + 7 * H), SCAN, "the region", "the scan")


@pytest.mark.parametrize("factor", [2, 0.5])
def test_labels_on_other_voxels_are_those_of_the_nearest(factor: float) -> None:
    """The corners of the two boxes coincide: a coarse voxel is eight fine ones, of fine ones each second counts."""
    fine = LABELS.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    values, shape = (LABELS, fine.shape) if factor == 2 else (fine, SHAPE)
    scan = Field(np.zeros(shape, np.uint8), H, "mm", AFFINE)
    corner = AFFINE[:3, 3] + (factor - 1) / 2 * H
    laid, (note,) = lay(world(values, factor * H * np.eye(3), corner), scan, "the region", "the scan")
    assert (laid.values == (fine if factor == 2 else LABELS)).all()
    assert "nearest" in note
    with pytest.raises(ScanError, match="resample"):
        lay(world(values, factor * H * np.eye(3), corner), scan, "the image", "the slices", exact=True)


def test_a_turn_by_a_few_degrees_takes_the_nearest() -> None:
    """A ball about the middle stays the ball."""
    z, y, x = np.indices((21,) * 3) - 10
    ball = (z**2 + y**2 + x**2 < 50).astype(np.uint8)
    c, s = np.cos(0.2), np.sin(0.2)
    turn = H * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    middle = AFFINE[:3, 3] + 10 * H
    laid, _ = lay(
        world(ball, turn, middle - turn @ [10, 10, 10]), Field(ball, H, "mm", AFFINE), "the region", "the scan"
    )
    assert np.count_nonzero(laid.values != ball) < 0.1 * ball.sum()  # of 1357 voxels 420 lie at the surface


@pytest.mark.parametrize("placed", ["field", "scan", "neither", "voxels"])
def test_without_a_place_equal_shapes_go_voxel_by_voxel(placed: str) -> None:
    """A place in voxels says nothing of one in mm where the voxels are not as long."""
    field = Field(LABELS, H, "mm", AFFINE if placed == "field" else None)
    scan = Field(np.zeros(SHAPE), H, "mm", None if placed in ("field", "neither") else AFFINE)
    if placed == "voxels":
        field = Field(LABELS, 1.0, "voxel", np.eye(4))
    laid, notes = lay(field, scan, "the region", "the scan")
    assert laid.values is field.values
    assert ["voxel by voxel" in note for note in notes] == [True] * (placed != "neither")
    with pytest.raises(ScanError, match="shape"):
        lay(Field(LABELS[1:], field.spacing, field.unit, field.affine), scan, "the region", "the scan")


@pytest.mark.parametrize("placed", ["both", "scan", "region", "neither"])
def test_a_region_of_a_cropped_scan_is_cropped_alike(placed: str) -> None:
    """By the affines, or with the scan where one of them has none; a crop has an affine of its own."""
    scan = replace(SCAN, affine=AFFINE if placed in ("both", "scan") else None)
    region = Field(LABELS, H, "mm", AFFINE if placed in ("both", "region") else None)
    if placed == "both":
        turned = AFFINE @ np.diag([-1.0, 1, 1, 1])
        turned[0, 3] += (SHAPE[2] - 1) * H
        region = Field(LABELS[..., ::-1], H, "mm", turned)
    crop = "1:4,2:,:-1"
    laid, notes = read_region(region, scan.crop(crop), scan, crop)
    assert (laid.values == LABELS[1:4, 2:, :-1]).all()
    assert bool(notes) == (placed != "neither")
