"""Betti numbers of shapes that have them exactly, in boxes that end and on the torus."""

import numpy as np
import pytest
from scipy import ndimage

from curvafit.geometry.topology import betti_numbers, components, euler_number, euler_of_window


def solid(*boxes: tuple[slice, slice, slice], less: tuple[tuple[slice, slice, slice], ...] = ()) -> np.ndarray:
    mask = np.zeros((10, 11, 12), dtype=bool)
    for box in boxes:
        mask[box] = True
    for box in less:
        mask[box] = False
    return mask


ALL, INNER, CORE = slice(None), slice(3, 8), slice(4, 7)
BALL = (INNER, INNER, INNER)
ROD = (ALL, INNER, INNER)
PLATE = (INNER, ALL, ALL)

#: Betti numbers in a box that ends, and on the torus.
SOLIDS = {
    "ball": (solid(BALL), (1, 0, 0), (1, 0, 0)),
    "shell": (solid(BALL, less=((CORE, CORE, CORE),)), (1, 0, 1), (1, 0, 1)),
    "ring": (solid(BALL, less=((ALL, CORE, CORE),)), (1, 1, 0), (1, 1, 0)),
    "rod": (solid(ROD), (1, 0, 0), (1, 1, 0)),
    "pipe": (solid(ROD, less=((ALL, CORE, CORE),)), (1, 1, 0), (1, 2, 1)),
    "plate": (solid(PLATE), (1, 0, 0), (1, 2, 1)),
    "plate with a hole": (solid(PLATE, less=((ALL, CORE, CORE),)), (1, 1, 0), (1, 2, 0)),
    "two plates": (solid(PLATE, (slice(9, 10), ALL, ALL)), (2, 0, 0), (2, 4, 2)),
    "box without a ball": (~solid(BALL), (1, 0, 1), (1, 3, 3)),
    "box without a rod": (~solid(ROD), (1, 1, 0), (1, 3, 2)),
    "full": (solid((ALL, ALL, ALL)), (1, 0, 0), (1, 3, 3)),
    "empty": (solid(), (0, 0, 0), (0, 0, 0)),
    "across an edge": (np.roll(solid(BALL), (5, 5, 6), (0, 1, 2)), (8, 0, 0), (1, 0, 0)),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_betti_numbers_of_known_solids(name: str) -> None:
    mask, box, torus = SOLIDS[name]
    assert betti_numbers(mask) == box
    assert betti_numbers(mask, periodic=True) == torus


@pytest.mark.parametrize("seed", range(4))
def test_laws_of_random_masks(seed: int) -> None:
    """On the torus a shift changes nothing, and a phase and its complement share the middle number up to theirs."""
    random = np.random.default_rng(seed)
    mask = ndimage.gaussian_filter(random.standard_normal((14, 12, 16)), 1.3, mode="wrap") > random.uniform(-0.1, 0.1)
    b = betti_numbers(mask, periodic=True)
    assert betti_numbers(np.roll(mask, (5, 7, 3), (0, 1, 2)), periodic=True) == b
    assert betti_numbers(mask.transpose(2, 0, 1)[::-1], periodic=True) == b
    assert b[0] - b[1] + b[2] == euler_number(mask, periodic=True) and min(b) >= 0
    box = betti_numbers(mask)
    assert box[0] >= b[0] and box[0] - box[1] + box[2] == euler_number(mask)


def test_windows_add_their_share_of_the_euler_number() -> None:
    """The mean over all places of a window in a box that repeats, exactly; of a structure that it holds, its own."""
    mask = np.random.default_rng(0).random((6, 7, 5)) < 0.4
    shares = [euler_of_window(np.roll(mask, by, (0, 1, 2))[:4, :5, :3]) for by in np.ndindex(*mask.shape)]
    assert np.mean(shares) == pytest.approx(euler_number(mask, periodic=True) * 3 * 4 * 2 / mask.size)
    alone = np.pad(mask, 1)
    assert euler_of_window(alone) == euler_number(alone)
    mask = solid(
        (slice(0, 2), slice(0, 2), slice(0, 2)), (slice(4, 6),) * 3, (slice(9, 10), slice(10, 11), slice(11, 12))
    )
    assert components(mask)[1] == 3
    labels, count = components(mask, periodic=True)
    assert count == 2 and labels.dtype == np.int32
    assert labels[0, 0, 0] == labels[-1, -1, -1] == 1 and labels[4, 4, 4] == 2
    assert components(mask, periodic=True, connectivity=6)[1] == 3  # they touch at a corner only
