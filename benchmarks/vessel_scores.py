"""Scores of a predicted segmentation by blocks of the image plane, and their bootstrap intervals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from skimage.morphology import skeletonize

#: Pixels (y, x) of a block, which runs through all slices.
BLOCK = (64, 60)
#: A component of fewer voxels, joined by faces, edges or corners, is not counted.
SPECK = 10

COUNTS = ("both", "predicted", "true", "skeleton_hits", "skeleton", "true_skeleton_hits", "true_skeleton")
#: Larger is better in the first two, smaller in the others.
SCORES = ("Dice", "clDice", "Betti-0 error", "with specks")
TOPOLOGY = ("components", "true_components", "components_all", "true_components_all")


def block_counts(predicted: np.ndarray, true: np.ndarray) -> dict[str, list[int]]:
    """What the scores are made of, for every block; masks `(Z, Y, X)`.

    Skeletons are those of the whole volume. Components are counted in each block, once without the specks of the
    whole volume and once (`_all`) with them.
    """
    thin, true_thin = skeletonize(predicted), skeletonize(true)
    volumes = dict(
        zip(
            COUNTS,
            (predicted & true, predicted, true, thin & true, thin, true_thin & predicted, true_thin),
            strict=True,
        )
    )
    found = {name: [int(block.sum()) for block in blocks(volume)] for name, volume in volumes.items()}
    masks = (without_specks(predicted), without_specks(true), predicted, true)
    for name, mask in zip(TOPOLOGY, masks, strict=True):
        found[name] = [components(block)[1] for block in blocks(mask)]
    return found


def blocks(volume: np.ndarray) -> list[np.ndarray]:
    """Columns of the volume; those at the far sides may be smaller."""
    edges = [range(0, n, edge) for n, edge in zip(volume.shape[1:], BLOCK, strict=True)]
    return [volume[:, y : y + BLOCK[0], x : x + BLOCK[1]] for y in edges[0] for x in edges[1]]


def components(mask: np.ndarray) -> tuple[np.ndarray, int]:
    labels, count = ndimage.label(mask, np.ones((3, 3, 3)))  # type: ignore[misc]
    return labels, count


def without_specks(mask: np.ndarray) -> np.ndarray:
    labels, _ = components(mask)
    large = np.bincount(labels.ravel()) >= SPECK
    large[0] = False
    return large[labels]


def scores(counts: Mapping[str, ArrayLike]) -> np.ndarray:
    """`SCORES` of blocks taken together, from counts `(…, blocks)`: `(…, 4)`.

    Dice; clDice (Shit et al. 2021); the Betti-0 error, mean over blocks of the difference in components, without
    specks and with them.
    """
    both, predicted, true, hits, skeleton, true_hits, true_skeleton = (
        np.sum(counts[name], axis=-1, dtype=float) for name in COUNTS
    )
    precision, recall = hits / np.maximum(skeleton, 1), true_hits / np.maximum(true_skeleton, 1)
    errors = [
        np.abs(np.subtract(counts[f"components{end}"], counts[f"true_components{end}"])).mean(-1)
        for end in ("", "_all")
    ]
    dice = 2 * both / np.maximum(predicted + true, 1)
    return np.stack([dice, 2 * precision * recall / np.maximum(precision + recall, 1e-9), *errors], -1)


def bootstrap(runs: dict[str, dict[str, np.ndarray]], base: str, draws: int = 4000) -> dict[str, np.ndarray]:
    """Scores of each loss and their differences to a base, with 95 % intervals.

    Parameters
    ----------
    runs
        For each loss, counts `(seeds, stacks, blocks)`. Block k of all stacks is the same place.
    draws
        Resamples of the places and of the seeds, the same ones for every loss.

    Returns
    -------
    dict
        For each loss `(2, 3, 4)`: its score or difference; mean, lower end, upper end; `SCORES`.
    """
    drawn = resampled(runs, draws)
    return {loss: np.stack([interval(found), interval(found - drawn[base])]) for loss, found in drawn.items()}


def resampled(runs: dict[str, dict[str, np.ndarray]], draws: int = 4000) -> dict[str, np.ndarray]:
    """For each loss the scores `(1 + draws, 4)` of the sample itself and of its resamples, as in `bootstrap`."""
    random = np.random.default_rng(0)
    seeds, _, places = next(iter(next(iter(runs.values())).values())).shape
    picks = [(random.integers(seeds, size=seeds), random.integers(places, size=places)) for _ in range(draws)]
    picks.insert(0, (np.arange(seeds), np.arange(places)))
    return {
        loss: np.array([scores({name: c[s][..., p] for name, c in counts.items()}).mean((0, 1)) for s, p in picks])
        for loss, counts in runs.items()
    }


def interval(drawn: np.ndarray) -> np.ndarray:
    """The value of the sample itself, and the quantiles of its resamples."""
    return np.stack([drawn[0], *np.quantile(drawn[1:], (0.025, 0.975), axis=0)])
