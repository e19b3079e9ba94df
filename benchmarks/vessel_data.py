"""Two-photon stacks of cortical capillaries (Poon et al. 2015, in vesselNN, arXiv:1606.02382), split by place.

The two stacks show one field of view, so a network is fitted on x < 240 of one and tested on x > 272 of the other. Of
the fitting side, y < 368 is fitted on, with labels on three slices only; y >= 384, fully labelled, chooses settings.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
import torch
from torch import Tensor

STACKS = ("noLeakage", "Leakage")
#: Voxel edges in µm.
SPACING = (5.0, 0.994, 0.994)
PARTS = {
    "fit": np.s_[:, :368, :240],
    "validation": np.s_[:, 384:, :240],
    "test": np.s_[:, :, 272:],
    "side": np.s_[:, :, :240],
}
SLICES, UNKNOWN = 3, 2
#: Voxels of a training patch: its depth always holds an annotated slice.
PATCH = (12, 80, 80)


class Part(NamedTuple):
    """Images, standardised logarithms; labels, boolean: `(Z, Y, X)`."""

    image: np.ndarray
    label: np.ndarray


def part(stack: str, name: str) -> Part:
    """A part of a stack."""
    values = np.log1p(raw(stack, name).astype(np.float32))
    return Part((values - values.mean()) / values.std(), raw(stack, name, "label") > 0)


def raw(stack: str, name: str, kind: str = "img") -> np.ndarray:
    """A part's grey values (`"img"`) or `"label"`, as they are in the file."""
    folder = Path(os.environ.get("CURVAFIT_DATA", "")) / "scans" / "vesselNN"
    return tifffile.imread(folder / f"poon2015_BBB_{stack}_{kind}.tif")[PARTS[name]]


def annotated(depth: int) -> list[int]:
    """The slices with labels: the middle ones of three equal parts of the depth."""
    return [(2 * k + 1) * depth // (2 * SLICES) for k in range(SLICES)]


def sparse(label: np.ndarray) -> np.ndarray:
    """Labels on the annotated slices, `UNKNOWN` elsewhere."""
    target = np.full(label.shape, UNKNOWN, np.uint8)
    chosen = annotated(len(label))
    target[chosen] = label[chosen]
    return target


def patch(image: np.ndarray, target: np.ndarray, seed: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """A random patch, turned, mirrored and with its grey values changed: `(1, 1, *PATCH)` each."""
    random = np.random.default_rng(seed)
    corner = [random.integers(n - edge + 1) for n, edge in zip(image.shape, PATCH, strict=True)]
    window = tuple(slice(start, start + edge) for start, edge in zip(corner, PATCH, strict=True))
    turns, mirrors = int(random.integers(4)), tuple(axis for axis, value in enumerate(random.random(3)) if value < 0.5)
    x, y = (np.flip(np.rot90(values[window], turns, (1, 2)), mirrors) for values in (image, target))
    x = random.uniform(0.9, 1.1) * x + random.uniform(-0.1, 0.1) + random.normal(0, random.uniform(0, 0.1), x.shape)
    return torch.from_numpy(x.astype(np.float32))[None, None], torch.from_numpy(y.astype(np.float32))[None, None]
