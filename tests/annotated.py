"""Shapes for tests that fill between known slices, a network with random weights, and what is known of a shape."""

import numpy as np
import torch

from curvafit.segmentation.filler import Filler
from curvafit.segmentation.slices import Slices

EDGES = (1.0, 1.0, 1.0)


def ball(n: int = 32, radius: float | None = None) -> np.ndarray:
    return np.linalg.norm(np.mgrid[:n, :n, :n] - (n - 1) / 2, axis=0) < (radius or n / 3)


def leaning(n: int = 32, away: float = 9) -> np.ndarray:
    """A leaning tube, and a ball that lies so far off the middle in y and x."""
    z, y, x = np.mgrid[:n, :n, :n] - n / 2 + 0.5
    return (np.hypot(y - 0.3 * z, x - 4) < 4) | (z**2 + (y + away) ** 2 + (x + away) ** 2 < 25)


def organelles(shift: int = 0) -> np.ndarray:
    """Two tubes along z that lean towards each other, labels 2 and 7, uint8 (25, 24, 32)."""
    z, y, x = np.indices((25, 24, 32))
    lean = (z + shift) / 8
    one, other = (np.hypot(y - 12, x - at) < 5 for at in (7 + lean, 25 - lean))
    return np.where(one, 2, np.where(other, 7, 0)).astype(np.uint8)


def known(mask: np.ndarray, every: int = 6, spacing=EDGES) -> Slices:
    places = tuple(range(0, len(mask), every))
    return Slices(mask[list(places)], places, len(mask), spacing)


def stirred() -> Filler:
    """A filler whose weights are all random, also the last ones."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        filler = Filler(8).eval()
        for weight in filler.parameters():
            torch.nn.init.normal_(weight, std=0.1)
    return filler
